"""Times a step of the tracker next to detect() on real sequences, and watches its memory for an hour.

    NPROC=1 python -m benchmarks.bench_tracking_step [--preset fast] [--quick] [--json FILE]

The sweeps of each sequence of `kitti_tracking` go in their order, and each first through detect() and then
through `track_step` on what was found, each timed until its result is ready: their ratio is of one run. The
step is the whole of 128 slots and of the detections' rows, however many count.

The hour is 36,000 steps of simulated traffic at 10 Hz. Arrays that JAX holds and resident memory are read on
the way: neither may grow, all numbers stay finite, and each birth takes the next id.

For an accelerator the step has one loop whose condition its host fetches, the rounds of the assignment: two
or three turns. It is counted in the traced program.
"""

import argparse
import functools
import os
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxbox
from benchmarks import common
from benchmarks.bench_memory import resident_mb
from jaxbox import DetectorConfig, PointCloud
from jaxbox.io import Sweep, open_sweeps
from jaxbox.tracking import Observations, TrackerState, observe, track_step

STEPS = ("detect", "observe", "track_step")
"""What is timed, in turn."""
SLOTS = 128
"""Capacity for vehicles."""
HOUR, QUICK_HOUR = 36_000, 2_000
"""An hour at 10 Hz."""
PASSES, QUICK_PASSES = 5, 1
"""Times that each sequence is gone through, the first untimed."""
SAMPLES = 20
"""Times that memory is read in the hour."""
SETTLED_SHARE = 0.2
"""Growth is counted from this share of the hour on: pools fill up before."""
DT_S = 0.1
ROWS, CARS, AZIMUTHS = 128, 60, 1440
"""Rows of detections of simulated traffic, cars about the sensor, and azimuth cells."""
REACH_M, TURN_RAD = 60.0, 0.01
"""Cars come and go at this distance, and the ego vehicle turns by so much a sweep."""


def sequences(quick: bool) -> list[list[Sweep]]:
    """The real sequences, each in its order."""
    root = common.data_folder("kitti_tracking") / "training" / "velodyne"
    found = [list(open_sweeps(folder)) for folder in sorted(root.iterdir()) if folder.is_dir()]
    return [sweeps[:8] for sweeps in found[:1]] if quick else found


def time_sequences(config: DetectorConfig, quick: bool) -> dict[str, Any]:
    """Milliseconds of detect(), of what a tracker reads of it, and of a step, sweep by sweep in turn."""
    passes = QUICK_PASSES if quick else PASSES
    step, look, stay = jax.jit(track_step), jax.jit(observe), jnp.eye(4)
    spent, vehicles = [], []
    for sweeps in sequences(quick):
        clouds = [jax.device_put(PointCloud.from_numpy(*sweep.read_points())) for sweep in sweeps]
        for _ in range(1 + passes):
            state = TrackerState.empty(SLOTS)
            for cloud in clouds:
                detect_ms, found = common.milliseconds(functools.partial(jaxbox.detect, cloud, config))
                observe_ms, seen = common.milliseconds(functools.partial(look, found))
                step_ms, (state, tracks) = common.milliseconds(
                    functools.partial(step, state, seen, DT_S, stay)
                )
                spent.append((len(sweeps), detect_ms, observe_ms, step_ms))
                vehicles.append(int(tracks.counts.tracks))
    return summarise(np.array(spent), passes) | {"slots": SLOTS, "median_tracks": float(np.median(vehicles))}


def summarise(spent: np.ndarray, passes: int) -> dict[str, Any]:
    """Spread of each step's times, and the median over the sweeps of the best of all passes.

    Args:
      spent: a row a sweep and pass: sweeps of its sequence, and ms of each step.
      passes: passes that count; the one before them compiles.

    Returns:
      The figures.
    """
    figures: dict[str, Any] = {"num_sweeps": 0, "ms": {name: [] for name in STEPS}}
    best: dict[str, list[float]] = {name: [] for name in STEPS}
    for length in np.unique(spent[:, 0]).astype(int):
        rows = spent[spent[:, 0] == length, 1:].reshape(-1, length, len(STEPS))
        # Sequences of the same length follow one another.
        for sequence in rows.reshape(-1, 1 + passes, length, len(STEPS)):
            figures["num_sweeps"] += int(length)
            for name, ms in zip(STEPS, np.moveaxis(sequence[1:], -1, 0), strict=True):
                figures["ms"][name] += ms.ravel().tolist()
                best[name] += ms.min(axis=0).tolist()
    figures["ms"] = {
        name: common.spread(values) | {"median_of_best": float(np.median(best[name]))}
        for name, values in figures["ms"].items()
    }
    return figures


def simulated(rng: np.random.Generator) -> Iterator[tuple[Observations, np.ndarray]]:
    """Detections of cars that drive past a turning ego vehicle, and its motion, without end."""
    cos, sin = np.cos(TURN_RAD), np.sin(TURN_RAD)
    motion = np.eye(4, dtype=np.float32)
    motion[:2, :2] = [[cos, -sin], [sin, cos]]
    xy = rng.uniform(-REACH_M, REACH_M, (CARS, 2))
    velocity = rng.normal(0, 6, (CARS, 2))
    while True:
        xy, velocity = (xy + DT_S * velocity) @ motion[:2, :2], velocity @ motion[:2, :2]
        gone = np.linalg.norm(xy, axis=1) > 1.5 * REACH_M
        xy[gone], velocity[gone] = (
            rng.uniform(-REACH_M, REACH_M, (gone.sum(), 2)),
            rng.normal(0, 6, (gone.sum(), 2)),
        )
        yield _look(rng, xy, velocity), motion


def _look(rng: np.random.Generator, xy: np.ndarray, velocity: np.ndarray) -> Observations:
    """What is seen of the cars in one sweep: nine of ten, with noise."""
    center, yaw = np.zeros((ROWS, 3)), np.zeros(ROWS)
    center[:CARS, :2] = xy + rng.normal(0, 0.05, xy.shape)
    yaw[:CARS] = np.arctan2(velocity[:, 1], velocity[:, 0]) + rng.normal(0, 0.03, CARS)
    size = rng.normal([4.2, 1.8, 1.5], 0.1, (ROWS, 3))
    valid = (np.arange(ROWS) < CARS) & (rng.random(ROWS) < 0.9)
    rows: dict[str, Any] = {
        "center": center.astype(np.float32),
        "size": size.astype(np.float32),
        "yaw": yaw.astype(np.float32),
        "score": rng.uniform(0.05, 1, ROWS).astype(np.float32),
        "label": np.zeros(ROWS, np.int32),
        "num_points": rng.integers(1, 500, ROWS, dtype=np.int32),
        "extent": size[:, :2].astype(np.float32),
        "front_log_odds": rng.normal(2, 1, ROWS).astype(np.float32),
        "valid": valid,
        "first_return_m": np.full(AZIMUTHS, 2 * REACH_M, np.float32),
    }
    return Observations(**rows)


def watch_hour(num_steps: int) -> dict[str, Any]:
    """Arrays and memory on the way through an hour of traffic, and whether ids and numbers are sane."""
    step, state, samples = jax.jit(track_step), TrackerState.empty(SLOTS), []
    births, tracks = jnp.zeros((), jnp.int32), None
    traffic, most = simulated(np.random.default_rng(0)), 0
    for number in range(num_steps):
        seen, motion = next(traffic)
        state, tracks = step(state, seen, DT_S, motion)
        births = births + tracks.counts.births
        if (number + 1) % (num_steps // SAMPLES) == 0:
            jax.block_until_ready(state)
            memory = resident_mb(os.getpid()) or (0.0, 0.0)
            samples.append((number + 1, memory[0], len(jax.live_arrays())))
            most = max(most, int(tracks.counts.tracks))
    done, resident, arrays = np.array(samples).T
    settled = done > SETTLED_SHARE * num_steps
    finite = all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves((state, tracks)))
    return {
        "steps": num_steps,
        "resident_mb": resident.tolist(),
        "growth_mb_an_hour": float(np.polyfit(done[settled], resident[settled], 1)[0] * HOUR),
        "live_arrays_grow_by": int(arrays[-1] - arrays[0]),
        "next_id": int(state.next_id),
        "births": int(births),
        "most_tracks": most,
        "finite": finite,
    }


def count_loops() -> int:
    """Loops of the traced step, at any depth."""
    seen, motion = next(simulated(np.random.default_rng(0)))
    traced = jax.jit(track_step).trace(TrackerState.empty(SLOTS), seen, DT_S, motion)
    return str(traced.jaxpr).count("while[") + str(traced.jaxpr).count("scan[")


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the figures and writes the report; status 1 where the hour was not flat or not sane."""
    parser = common.parser(__doc__ or "", quick=f"a few sweeps and {QUICK_HOUR} steps")
    options: argparse.Namespace = parser.parse_args(arguments)
    config = jax.tree.map(float, common.chosen_config(options))
    times = time_sequences(config, options.quick)
    columns = ("min", "median_of_best", "median", "p90", "p99", "runs")
    common.print_table(
        ["ms", *columns], [(name, *(values[c] for c in columns)) for name, values in times["ms"].items()]
    )
    print(f"\n{times['num_sweeps']} sweeps, {times['median_tracks']:.0f} tracks in {SLOTS} slots")
    hour = watch_hour(QUICK_HOUR if options.quick else HOUR)
    loops = count_loops()
    print(f"{hour['steps']} steps: {hour['growth_mb_an_hour']:+.1f} MB an hour, next id {hour['next_id']}")
    print(f"{loops} loop, {jax.devices()[0].device_kind}")
    common.write_report(times | {"hour": hour, "loops": loops}, options)
    if not hour["finite"] or hour["next_id"] != hour["births"] or hour["live_arrays_grow_by"] > 0:
        raise SystemExit("The hour was not flat, or its numbers are not sane: see the report.")


if __name__ == "__main__":
    main()
