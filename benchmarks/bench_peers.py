"""Whole sweeps through jaxbox and through other libraries' chains, interleaved, with what each found.

    python -m benchmarks.bench_peers [--quick] [--only jaxbox reference] [--json FILE]

Host array in, host boxes out. On every sweep each chain runs once before the next sweep, so that a slow
minute of the machine is everybody's. Those that are not slow first take the sweep before for a tenth of a
second, untimed: threads that another chain has left spinning, what it has left in the caches, and what a rest
would cost, are not their own time.
A faster but worse answer shows: what a chain kept, how many clusters and boxes it made of it, and which share
of the labelled cars it found. Compiling and reading are not timed.
A peer that is not installed is named with the command that installs it.

    python -m benchmarks.bench_peers --quick --only jaxbox reference --guard benchmarks/results/guard.json

fails where jaxbox is less ahead of the reference, within this one run, than a share of what was recorded.
"""

import argparse
import json
import pathlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

import jaxbox
from benchmarks import common
from benchmarks.peers.chains import PEERS, Answer, Chain, PclProcess, make_peers
from jaxbox import DEFAULT_SCORE_THRESHOLD, DetectorConfig, PointCloud, reference
from jaxbox.evaluation.copies import Frame, label_points, labelled_frames
from jaxbox.io import boxes_from_objects, open_sweeps

QUICK_SWEEPS = 6
ROUNDS, QUICK_ROUNDS = 3, 2
"""Times that all sweeps are gone through; slow peers run in the first only."""
SLOW_MS = 400.0
"""A chain that takes longer for its first sweep is slow."""
WARM_UP_S = 0.1
"""So long do threads of linear algebra libraries spin after their last work."""

MIN_LABEL_POINTS, MAX_OCCLUSION = 30, 1
"""Cars that everybody should find."""
FOUND_IOU = 0.5
"""Overlap from above from which a car is found."""

GUARD_SHARE = 0.6
"""CI fails where the ratio to the reference falls below this share of the recorded one. Within one run the
ratio of two idle cores and of two busy ones differ by a quarter; a lost trick costs more."""

PEER_PACKAGES = ("open3d", "pypatchworkpp", "scikit-learn", "numba")


def jaxbox_chain(config: DetectorConfig) -> Chain:
    """jaxbox: padding, transfer, detection, and the boxes on the host."""

    def run(xyz: np.ndarray) -> Answer:
        found = jaxbox.detect(PointCloud.from_numpy(xyz), config)
        wanted = (found.center, found.size, found.yaw, found.score, found.valid)
        center, size, yaw, score, valid = (np.asarray(array) for array in wanted)
        keep = valid & (score >= DEFAULT_SCORE_THRESHOLD)
        boxes = np.column_stack([center[:, :2], size[:, :2], yaw])[keep]
        return Answer(int(found.counts.obstacles), int(np.max(found.counts.clusters)), boxes)

    return run


def reference_chain(config: DetectorConfig) -> Chain:
    """The same pipeline in NumPy, SciPy and OpenCV."""

    def run(xyz: np.ndarray) -> Answer:
        found = reference.detect(xyz, config)
        boxes = np.column_stack([found.center[:, :2], found.size[:, :2], found.yaw])
        return Answer(
            int(found.counts["obstacles"]),
            int(np.max(found.counts["clusters"])),
            boxes[found.score >= DEFAULT_SCORE_THRESHOLD],
        )

    return run


def our_chains() -> dict[str, Callable[[], Chain]]:
    presets = DetectorConfig.presets()
    chains = {
        f"jaxbox {name}": lambda config=config: jaxbox_chain(config) for name, config in presets.items()
    }
    return chains | {"reference": lambda: reference_chain(DetectorConfig())}


def chosen_chains(only: Sequence[str]) -> tuple[dict[str, Chain], dict[str, str]]:
    """The chains whose names begin with one of the words, or all; and what is missing."""

    def wanted(name: str) -> bool:
        return not only or any(name.lower().startswith(word.lower()) for word in only)

    ours = {name: make() for name, make in our_chains().items() if wanted(name)}
    peers, missing = make_peers([name for name in PEERS if wanted(name)])
    return ours | peers, missing


def in_region(frame: Frame) -> np.ndarray:
    """(n, 3) float32 points that every chain is given."""
    region = DetectorConfig().region
    half = np.array([region.half_x_m, region.half_y_m])
    return np.ascontiguousarray(frame.xyz[(np.abs(frame.xyz[:, :2]) < half).all(axis=1)])


def wanted_cars(frame: Frame) -> np.ndarray:
    """(k, 5) labelled cars that count for recall: x, y, length, width, yaw."""
    points = label_points(frame)
    cars = [
        label
        for label, count in zip(frame.labels, points, strict=True)
        if label.type == "Car" and count >= MIN_LABEL_POINTS and label.occlusion <= MAX_OCCLUSION
    ]
    center, size, yaw = boxes_from_objects(cars, frame.calibration)
    return np.column_stack([center[:, :2], size[:, :2], yaw])


def overlap(box: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two rectangles: x, y, length, width, yaw."""
    turned: list[Any] = [((b[0], b[1]), (b[2], b[3]), float(np.degrees(b[4]))) for b in (box, other)]
    kind, corners = cv2.rotatedRectangleIntersection(turned[0], turned[1])
    if kind == cv2.INTERSECT_NONE:
        return 0.0
    common_area = cv2.contourArea(cv2.convexHull(corners))
    return common_area / (box[2] * box[3] + other[2] * other[3] - common_area)


def count_found(cars: np.ndarray, boxes: np.ndarray) -> int:
    """Cars that some box covers well."""
    return sum(any(overlap(car, box) >= FOUND_IOU for box in boxes) for car in cars)


def time_chain(chain: Chain, xyz: np.ndarray) -> tuple[float, Answer]:
    spent_ms, answer = common.milliseconds(lambda: chain(xyz))
    return (chain.spent_ms if isinstance(chain, PclProcess) else spent_ms), answer


def warm_up(chain: Chain, xyz: np.ndarray) -> None:
    end = time.perf_counter() + WARM_UP_S
    while time.perf_counter() < end:
        chain(xyz)


def run_all(chains: Mapping[str, Chain], frames: Sequence[Frame], rounds: int) -> dict[str, dict[str, Any]]:
    """Times and answers of every chain, sweep by sweep."""
    clouds = [in_region(frame) for frame in frames]
    first_ms = {
        name: min(time_chain(chain, clouds[0])[0] for _ in range(2)) for name, chain in chains.items()
    }
    spent: dict[str, list[float]] = {name: [] for name in chains}
    answers: dict[str, list[Answer]] = {name: [] for name in chains}
    for turn in range(rounds):
        for before, xyz in zip(clouds[-1:] + clouds[:-1], clouds, strict=True):
            for name, chain in chains.items():
                is_slow = first_ms[name] > SLOW_MS
                if turn and is_slow:
                    continue
                if not is_slow:
                    warm_up(chain, before)
                spent_ms, answer = time_chain(chain, xyz)
                spent[name].append(spent_ms)
                if not turn:
                    answers[name].append(answer)
    cars = [wanted_cars(frame) for frame in frames]
    return {name: summarise(spent[name], answers[name], cars) for name in chains}


def summarise(
    spent: Sequence[float], answers: Sequence[Answer], cars: Sequence[np.ndarray]
) -> dict[str, Any]:
    found = sum(count_found(wanted, a.boxes) for wanted, a in zip(cars, answers, strict=True))
    return {
        **common.spread(spent),
        "kept": float(np.median([a.kept for a in answers])),
        "clusters": float(np.median([a.clusters for a in answers])),
        "boxes": float(np.median([len(a.boxes) for a in answers])),
        "recall": found / max(sum(map(len, cars)), 1),
        "cars": sum(map(len, cars)),
    }


def ratios(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """How often a preset's median goes into the reference's, where both ran."""
    if "reference" not in rows:
        return {}
    slow = rows["reference"]["median"]
    return {name: slow / row["median"] for name, row in rows.items() if name.startswith("jaxbox")}


def check_guard(measured: Mapping[str, float], path: pathlib.Path) -> list[str]:
    """What has become slower than the recorded ratios allow, in words."""
    recorded = json.loads(path.read_text())["times_faster_than_reference"]
    return [
        f"{name}: {measured[name]:.1f} times as fast as the reference, recorded {ratio:.1f}; "
        f"at least {GUARD_SHARE * ratio:.1f} is asked for"
        for name, ratio in recorded.items()
        if name in measured and measured[name] < GUARD_SHARE * ratio
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = common.parser(__doc__ or "", preset=False, quick="few sweeps and rounds")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="chains whose names begin so")
    parser.add_argument("--guard", type=pathlib.Path, metavar="FILE", help="fail where slower than recorded")
    options: argparse.Namespace = parser.parse_args(arguments)
    common.enable_cache()
    frames = labelled_frames(open_sweeps(common.data_folder("kitti_object")))
    frames = frames[:: len(frames) // QUICK_SWEEPS][:QUICK_SWEEPS] if options.quick else frames
    chains, missing = chosen_chains(options.only)
    rows = run_all(chains, frames, QUICK_ROUNDS if options.quick else ROUNDS)
    columns = ("median", "p90", "p99", "runs", "kept", "clusters", "boxes", "recall")
    header = ["", "median ms", "p90 ms", "p99 ms", *columns[3:]]
    common.print_table(header, [[name, *(row[c] for c in columns)] for name, row in rows.items()])
    for name, command in missing.items():
        print(f"{name}: missing; {command}")
    cars = next(iter(rows.values()))["cars"]
    print(
        f"\n{len(frames)} sweeps; recall of {cars} cars with {MIN_LABEL_POINTS} points, overlap {FOUND_IOU}"
    )
    measured = ratios(rows)
    for name, ratio in measured.items():
        print(f"{name}: {ratio:.1f} times as fast as the reference")
    versions = {name: common.installed_version(name) for name in PEER_PACKAGES}
    report = {"chains": rows, "missing": missing, "times_faster_than_reference": measured}
    common.write_report(report | {"num_sweeps": len(frames), "peer_versions": versions}, options)
    failures = check_guard(measured, options.guard) if options.guard else []
    if failures:
        raise SystemExit("\n".join(failures))


if __name__ == "__main__":
    main()
