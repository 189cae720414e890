"""The same bits: repeated, in other processes, with other threads, in batches; and what another key changes.

    python -m quality.determinism --json quality/results/determinism.json

Each answer is reduced to a digest of all its arrays. RANSAC draws its planes by a random key, so another key
may give other boxes: how much they move is measured over many keys on every real sweep.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np

import jaxbox
from benchmarks import bench_sensors, common
from jaxbox import Detections, DetectorConfig, PointCloud, Tracks
from jaxbox.evaluation import pairwise_overlaps
from jaxbox.io import open_sweeps
from jaxbox.run.processes import THREADS_VARIABLE
from jaxbox.tracking.poses import PoseSource
from quality.bad_input import PRESETS, street

REPEATS, QUICK_REPEATS = 100, 10
KEYS, QUICK_KEYS = 50, 5
NUM_SWEEPS = 3
"""Sweeps whose bits are compared; the keys are tried on all."""
SAME_OBJECT_OVERLAP = 0.1
"""Boxes of two keys that overlap more are of one object; within one answer none overlap so much."""
OFTEN = 0.9
"""An object is often there where that many of the keys find it."""
TIMEOUT_S = 3600

TRACKS = "tracks"
"""What is asked of another process instead of a preset's answers."""
TRACK_SET, TRACK_SWEEPS = "kitti_tracking", 40
"""The drive that is tracked: its first sweeps."""

NO_CACHE = {"JAXBOX_CACHE_DIR": "", "JAX_ENABLE_COMPILATION_CACHE": "false"}
PROCESSES: Mapping[str, Mapping[str, str]] = {
    "another process": {},
    "compiled again": NO_CACHE,
    "NPROC=1": {THREADS_VARIABLE: "1"},
    "NPROC=2": {THREADS_VARIABLE: "2"},
    "--xla_cpu_multi_thread_eigen=false": {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"},
    "on one core": {"ONE_CORE": "1"},
}
"""Environments whose answers have to be the same."""
OTHER_PROGRAMS: Mapping[str, Mapping[str, str]] = {
    "--xla_cpu_max_isa=AVX2": {"XLA_FLAGS": "--xla_cpu_max_isa=AVX2"},
}
"""Environments in which the compiler makes another program, as it does for another processor."""


@dataclasses.dataclass(frozen=True)
class Given:
    """Points of a sweep in memory, as `stream` takes them too."""

    name: str
    xyz: np.ndarray

    def read_points(self) -> tuple[np.ndarray, None]:
        """The points, and no intensities."""
        return self.xyz, None


def digest(detections: Detections | Tracks) -> str:
    """Of every bit of an answer, with the shapes and types of its arrays."""
    code = hashlib.sha256()
    for leaf in jax.tree.leaves(jax.device_get(detections)):
        code.update(f"{leaf.shape}{leaf.dtype}".encode())
        code.update(np.ascontiguousarray(leaf).tobytes())
    return code.hexdigest()


def sweeps_to_compare(quick: bool) -> list[Given]:
    """Real sweeps, or with --quick small synthetic ones, which need no data."""
    if quick:
        return [Given(f"street {seed}", street(seed)) for seed in range(NUM_SWEEPS)]
    return [Given(sweep.name, sweep.read_points()[0]) for sweep in common.kitti_sweeps(NUM_SWEEPS)]


def sweeps_for_keys(quick: bool) -> Iterator[tuple[str, np.ndarray]]:
    """Every real sweep of every sensor, one after the other; with --quick the small ones."""
    if quick:
        yield from ((sweep.name, sweep.xyz) for sweep in sweeps_to_compare(quick))
        return
    yield from ((sweep.name, sweep.read_points()[0]) for sweep in common.kitti_sweeps())
    for read in (
        bench_sensors.argoverse2_sweeps,
        bench_sensors.pandaset_sweeps,
        bench_sensors.classed_sweeps,
    ):
        yield from ((sweep.name, sweep.xyz) for sweep in read())


def digests(sweeps: Iterable[Given], config: DetectorConfig) -> list[str]:
    """Of each sweep, by `jaxbox.detect`."""
    return [digest(jaxbox.detect(PointCloud.from_numpy(sweep.xyz), config)) for sweep in sweeps]


# The same bits.


def repeat(sweeps: Sequence[Given], config: DetectorConfig, times: int) -> int:
    """How many different answers the sweeps have, beyond one each, when they take turns so often."""
    answers = {tuple(digests(sweeps, config)) for _ in range(times)}
    return len(answers) - 1


def by_batch(sweeps: Sequence[Given], config: DetectorConfig) -> dict[str, list[str]]:
    """Digests of the same sweeps by everything that takes many."""
    capacity = max(PointCloud.from_numpy(sweep.xyz).capacity for sweep in sweeps)
    clouds = [PointCloud.from_numpy(sweep.xyz, capacity=capacity) for sweep in sweeps]
    found: dict[str, list[str]] = {"one by one": [digest(jaxbox.detect(cloud, config)) for cloud in clouds]}
    batch = jax.vmap(lambda cloud: jaxbox.detect(cloud, config))
    for turn in range(len(clouds)):
        turned = clouds[turn:] + clouds[:turn]
        many = jax.device_get(batch(jaxbox.stack_clouds(turned)))
        rows = [digest(jax.tree.map(lambda leaf, i=i: leaf[i], many)) for i in range(len(clouds))]
        found[f"vmap, turned by {turn}"] = rows[len(rows) - turn :] + rows[: len(rows) - turn]
    found["detect_batch"] = [digest(d) for d in jaxbox.detect_batch(clouds, config)]
    for workers in (1, 2):
        streamed = jaxbox.stream(sweeps, config, capacity=capacity, workers=workers)
        found[f"stream, {workers} process{'es' * (workers - 1)}"] = [_streamed(result) for result in streamed]
    return found


def _streamed(result: jaxbox.StreamedSweep) -> str:
    if result.detections is None:
        raise SystemExit(f"{result.name}: {result.error}")
    return digest(result.detections)


def by_process(environment: Mapping[str, str], options: argparse.Namespace, preset: str) -> list[str]:
    """Digests of the sweeps from a process of its own."""
    command = [sys.executable, "-m", "quality.determinism", "--digests-of", preset]
    command += ["--quick"] if options.quick else []
    command += [word for change in options.set for word in ("--set", change)]
    done = subprocess.run(
        command, cwd=common.PROJECT, env=os.environ | environment, capture_output=True, text=True,
        check=False, timeout=TIMEOUT_S,
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} ended with exit code {done.returncode}:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def _print_digests(options: argparse.Namespace) -> None:
    """What the processes of `by_process` do."""
    if "ONE_CORE" in os.environ:
        # Before the first computation, when XLA counts the cores.
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if options.digests_of == TRACKS:
        print(json.dumps(track_digests(options)))
        return
    config = common.chosen_config(options, preset=options.digests_of)
    print(json.dumps(digests(sweeps_to_compare(options.quick), config)))


# Tracks.


def track_digests(options: argparse.Namespace, *, workers: int = 1) -> list[str]:
    """Of the tracks of each sweep of a drive, poses from the boxes."""
    if options.quick:
        sweeps: Sequence[Any] = sweeps_to_compare(options.quick)
    else:
        sweeps = open_sweeps(common.data_folder(TRACK_SET))[:TRACK_SWEEPS]
    config = common.chosen_config(options, preset="default")
    found = jaxbox.track(sweeps, config, poses=PoseSource.BOXES, workers=workers)
    return [_tracked(result) for result in found]


def _tracked(result: jaxbox.TrackedSweep) -> str:
    if result.tracks is None:
        raise SystemExit(f"{result.name}: {result.error}")
    return digest(result.tracks)


def compare_tracks(options: argparse.Namespace) -> dict[str, bool]:
    """Whether the tracks of a drive are the same however they come about."""
    expected = track_digests(options)
    processes = dict(list(PROCESSES.items())[:1]) if options.quick else PROCESSES
    return {
        "again": track_digests(options) == expected,
        "detected by 2 processes": track_digests(options, workers=2) == expected,
        **{name: by_process(env, options, TRACKS) == expected for name, env in processes.items()},
    }


def compare(options: argparse.Namespace, preset: str) -> dict[str, Any]:
    """Whether the bits of one preset are the same however they come about."""
    config = common.chosen_config(options, preset=preset)
    sweeps = sweeps_to_compare(options.quick)
    repeats = QUICK_REPEATS if options.quick else REPEATS
    expected = digests(sweeps, config)
    batches = by_batch(sweeps, config)
    one_by_one = batches.pop("one by one")
    processes = dict(list(PROCESSES.items())[:1]) if options.quick else PROCESSES
    others = {} if options.quick else OTHER_PROGRAMS
    return {
        "sweeps": [sweep.name for sweep in sweeps],
        "repeats": repeats,
        "different_answers": repeat(sweeps, config, repeats),
        "same_in_batches": {name: found == one_by_one for name, found in batches.items()},
        "same_in_processes": {
            name: by_process(environment, options, preset) == expected
            for name, environment in processes.items()
        },
        "same_in_other_programs": {
            name: by_process(environment, options, preset) == expected for name, environment in others.items()
        },
    }


# Other keys.


def boxes_of(detections: Detections) -> np.ndarray:
    """(k, 8): centre, size, yaw, score of the valid boxes."""
    d = jax.device_get(detections)
    return np.column_stack([d.center, d.size, d.yaw, d.score])[d.valid].astype(float)


def follow_objects(answers: Sequence[np.ndarray]) -> np.ndarray:
    """Which boxes of several answers are of one object.

    Args:
      answers: of each key (k, 8) boxes, see `boxes_of`.

    Returns:
      (objects, keys, 8) float64; NaN where a key has no box of the object.
    """
    objects: list[np.ndarray] = []
    for key, boxes in enumerate(answers):
        anchors = np.array([rows[np.flatnonzero(~np.isnan(rows[:, 0]))[0]] for rows in objects]).reshape(
            -1, 8
        )
        overlap, _ = pairwise_overlaps(boxes[:, :7], anchors[:, :7])
        for row, box in enumerate(boxes):
            best = int(overlap[row].argmax()) if overlap.shape[1] else -1
            if best < 0 or overlap[row, best] <= SAME_OBJECT_OVERLAP:
                objects.append(np.full((len(answers), 8), np.nan))
                best = len(objects) - 1
            else:
                # Boxes come best first: the better one keeps the object.
                overlap[:, best] = 0
            objects[best][key] = box
    return np.array(objects).reshape(-1, len(answers), 8)


def deviations(rows: np.ndarray) -> dict[str, np.ndarray]:
    """How far each box of one object is from the object's median box: (keys,) each."""
    median = np.median(rows, axis=0)
    turn = (rows[:, 6] - rows[0, 6] + np.pi / 2) % np.pi - np.pi / 2
    return {
        "centre, m": np.linalg.norm(rows[:, :2] - median[:2], axis=1),
        "height of the centre, m": np.abs(rows[:, 2] - median[2]),
        "yaw, degrees": np.degrees(np.abs(turn - np.median(turn))),
        "length, m": np.abs(rows[:, 3] - median[3]),
        "width, m": np.abs(rows[:, 4] - median[4]),
        "height, m": np.abs(rows[:, 5] - median[5]),
        "score": np.abs(rows[:, 7] - median[7]),
    }


def spread_over_keys(
    sweeps: Iterable[tuple[str, np.ndarray]], config: DetectorConfig, num_keys: int
) -> dict[str, Any]:
    """How often each object that some key puts above the cut is there, and how far its boxes move."""
    keys = [jax.random.key(seed) for seed in range(num_keys)]
    above, anywhere, scores, moves, names = [], [], [], [], []
    for name, xyz in sweeps:
        names.append(name)
        cloud = PointCloud.from_numpy(xyz)
        for rows in follow_objects([boxes_of(jaxbox.detect(cloud, config, key)) for key in keys]):
            there = ~np.isnan(rows[:, 7])
            is_above = there & (np.nan_to_num(rows[:, 7]) >= jaxbox.DEFAULT_SCORE_THRESHOLD)
            if is_above.any():
                above.append(is_above.mean())
                anywhere.append(there.mean())
                scores.append(float(np.median(rows[there, 7])))
                moves.append(deviations(rows[is_above]))
    return {
        "keys": num_keys,
        "sweeps": len(names),
        **_presence(np.array(above), np.array(anywhere)),
        "by_median_score": {
            f"{low:g} to {high:g}": _presence(np.array(above)[chosen], np.array(anywhere)[chosen])
            for low, high in ((0, 0.15), (0.15, 0.2), (0.2, 0.3), (0.3, 1))
            for chosen in [(np.array(scores) >= low) & (np.array(scores) < high)]
        },
        "moves": _move_table(moves),
    }


def _presence(above: np.ndarray, anywhere: np.ndarray) -> dict[str, Any]:
    return {
        "objects": len(above),
        "above_cut_with_every_key": int((above == 1).sum()),
        "above_cut_with_nine_of_ten_keys": int((above >= OFTEN).sum()),
        "with_every_key_at_some_score": int((anywhere == 1).sum()),
    }


def _move_table(moves: Sequence[Mapping[str, np.ndarray]]) -> dict[str, dict[str, float]]:
    table = {}
    for name in moves[0] if moves else ():
        values = np.concatenate([move[name] for move in moves])
        table[name] = dict(
            zip(
                ("median", "p95", "p99", "max"),
                np.percentile(values, [50, 95, 99, 100]).tolist(),
                strict=True,
            )
        )
    return table


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the tables and writes the report; ends with exit code 1 where bits differ that must not."""
    parser = common.parser(__doc__ or "", preset=False, quick="small synthetic sweeps, few repeats and keys")
    presets = sorted(DetectorConfig.presets())
    parser.add_argument("--digests-of", choices=[*presets, TRACKS], help=argparse.SUPPRESS)
    parser.add_argument("--presets", nargs="+", choices=presets, default=PRESETS)
    parser.add_argument("--keys", type=common.at_least(1), help=f"random keys to try, {KEYS} by default")
    options: argparse.Namespace = parser.parse_args(arguments)
    if options.digests_of:
        _print_digests(options)
        return
    keys = options.keys or (QUICK_KEYS if options.quick else KEYS)
    report: dict[str, Any] = {"same_bits": {}, "keys": {}}
    for preset in options.presets:
        report["same_bits"][preset] = compare(options, preset)
        config = common.chosen_config(options, preset=preset)
        report["keys"][preset] = spread_over_keys(sweeps_for_keys(options.quick), config, keys)
        _print(preset, report["same_bits"][preset], report["keys"][preset])
    report["same_tracks"] = compare_tracks(options)
    common.print_table(["same tracks", ""], list(report["same_tracks"].items()))
    common.write_report(report, options)
    bits = report["same_bits"].values()
    if any(_differs(same) for same in bits) or not all(report["same_tracks"].values()):
        sys.exit(1)


def _differs(same: Mapping[str, Any]) -> bool:
    required = (*same["same_in_batches"].values(), *same["same_in_processes"].values())
    return bool(same["different_answers"]) or not all(required)


def _print(preset: str, same: Mapping[str, Any], keys: Mapping[str, Any]) -> None:
    print(f"{preset}: {len(same['sweeps'])} sweeps, {same['repeats']} repeats")
    print(f"different answers: {same['different_answers']}")
    for group in ("same_in_batches", "same_in_processes", "same_in_other_programs"):
        common.print_table([group.replace("_", " "), ""], list(same[group].items()))
    print(f"\n{keys['keys']} keys on {keys['sweeps']} sweeps; objects above the cut with some key:")
    groups = {"all": keys, **keys["by_median_score"]}
    names = (
        "objects",
        "above_cut_with_every_key",
        "above_cut_with_nine_of_ten_keys",
        "with_every_key_at_some_score",
    )
    common.print_table(
        ["median score", *names], [(group, *(row[n] for n in names)) for group, row in groups.items()]
    )
    common.print_table(
        ["distance from the median box", "median", "p95", "p99", "max"],
        [(name, *row.values()) for name, row in keys["moves"].items()],
    )
    print()


if __name__ == "__main__":
    main()
