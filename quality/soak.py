"""A soak: thousands of sweeps through `jaxbox.stream`; recompiles, memory, and the slowest frames.

    python -m quality.soak --json quality/results/soak.json

Three runs in processes of their own: the real sweeps over and over, at one capacity; sweeps of wildly
varying size, from none to a million points, over all capacity buckets; and drives over and over through the
tracker, poses from the boxes. After a warm-up, in which each
capacity compiles, the interval between results is the time of a frame. ``--quick`` takes 200 small synthetic
frames, and two buckets.
"""

import argparse
import concurrent.futures
import dataclasses
import functools
import itertools
import multiprocessing
import pathlib
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

import jaxbox
from benchmarks import common
from jaxbox import DetectorConfig
from jaxbox._padding import CAPACITY_BUCKETS, fitting_capacity
from jaxbox.io import open_sweeps
from jaxbox.run import compiled
from jaxbox.tracking.poses import PoseSource
from quality.bad_input import street

FRAMES, QUICK_FRAMES = 20_000, 200
SIZE_FRAMES = 2_000
"""Frames of varying size, which take several times as long."""
TRACK_SET = "kitti_tracking"
"""Drives for the tracker."""
MAX_POINTS, QUICK_MAX_POINTS = 1_000_000, 2 * CAPACITY_BUCKETS[0]
CAPACITY = 2**17
"""Of the real sweeps, which have some 65,000 to 125,000 points."""
SWEEP_SETS = (*common.SWEEP_SETS, "argoverse2", "pandaset", "semantic_kitti")
SETTLED_SHARE = 0.1
"""Growth is counted from this share of the frames on: buffers and pools fill up before."""
MEMORY_EVERY = 10
"""Frames between two readings of the memory."""
JITTER_M = 0.01
"""Points that are repeated to make a sweep larger are moved by so much."""
COMPILE_EVENT = "/jax/core/compile/backend_compile_duration"
"""What JAX's monitoring calls each compile, or load from the cache."""


@dataclasses.dataclass(frozen=True)
class Resized:
    """A sweep with that many points, made of another's when it is its turn."""

    name: str
    base: np.ndarray
    size: int
    seed: int

    def read_points(self) -> tuple[np.ndarray, None]:
        """Points chosen at random, each moved a little, as most may be chosen several times."""
        rng = np.random.default_rng(self.seed)
        xyz = self.base[rng.integers(0, len(self.base), self.size)]
        return xyz + rng.normal(0, JITTER_M, xyz.shape).astype(np.float32), None


@dataclasses.dataclass(frozen=True)
class Untimed:
    """A sweep of a drive that goes round in circles: its place says when it was taken."""

    sweep: Any

    @property
    def name(self) -> str:
        """Of the sweep."""
        return self.sweep.name

    def read_points(self) -> tuple[np.ndarray, np.ndarray]:
        """The points and their intensities."""
        return self.sweep.read_points()


def real_sweeps() -> list[Any]:
    """All real sweeps of all sensors."""
    root = common.data_folder(SWEEP_SETS[0]).parent
    return [sweep for name in SWEEP_SETS if (root / name).is_dir() for sweep in open_sweeps(root / name)]


def varied_sweeps(base: np.ndarray, max_points: int, count: int) -> list[Resized]:
    """Sweeps of all sizes: the first fill each bucket, the others fall into them about as often."""
    buckets = [bucket for bucket in CAPACITY_BUCKETS if bucket < 2 * max_points]
    rng = np.random.default_rng(0)
    sizes = [min(bucket, max_points) for bucket in buckets] + [0, 1]
    low, high = np.log(buckets[0] / 2), np.log(max_points)
    sizes += np.exp(rng.uniform(low, high, count - len(sizes))).astype(int).tolist()
    # One in ten is tiny or empty.
    sizes[9::10] = rng.integers(0, 100, len(sizes[9::10])).tolist()
    return [Resized(f"{size} points", base, size, seed) for seed, size in enumerate(sizes)]


def resident_kb() -> tuple[int, int]:
    """Resident memory now, and its peak, of this process."""
    lines = pathlib.Path("/proc/self/status").read_text().splitlines()
    fields = dict(line.split(":", 1) for line in lines)
    now, peak = (int(fields[name].split()[0]) for name in ("VmRSS", "VmHWM"))
    return now, peak


class CompileCounter:
    """Counts what JAX compiles, or loads from its cache, from now on: the detector and all else."""

    def __init__(self) -> None:
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **kwargs: Any) -> None:
        self.count += event == COMPILE_EVENT


def soak(
    sweeps: Iterable[Any],
    warm_up: Sequence[Any],
    config: DetectorConfig,
    capacity: int | None,
    *,
    run: Callable[..., Iterable[jaxbox.StreamedSweep]] = jaxbox.stream,
) -> dict[str, Any]:
    """Streams sweeps, after some that compile whatever there is to compile."""
    counter = CompileCounter()
    # One device, so that the time between two results is that of one sweep.
    stream = functools.partial(run, config=config, capacity=capacity, devices=jax.local_devices()[:1])
    for result in stream([*warm_up] * 2):
        _check(result)
    warm_compiles, programs = counter.count, compiled.count_compilations()
    intervals, capacities, points, memory = [], [], [], []
    last = time.perf_counter()
    for frame, result in enumerate(stream(sweeps)):
        now = time.perf_counter()
        intervals.append(1e3 * (now - last))
        last = now
        _check(result)
        capacities.append(capacity or fitting_capacity(result.num_points))
        points.append(result.num_points)
        if frame % MEMORY_EVERY == 0:
            memory.append((frame, resident_kb()[0]))
    return {
        "frames": len(intervals),
        "points": {"minimum": min(points), "median": float(np.median(points)), "maximum": max(points)},
        "compiles_in_warm_up": warm_compiles,
        "programs": programs,
        "recompiles": counter.count - warm_compiles + compiled.count_compilations() - programs,
        "frame_ms": latency(intervals),
        "frame_ms_by_capacity": {
            str(bucket): latency(np.array(intervals)[np.array(capacities) == bucket])
            for bucket in sorted(set(capacities))
        },
        **growth(memory, len(intervals)),
        "peak_mb": resident_kb()[1] / 1e3,
    }


def _check(result: jaxbox.StreamedSweep) -> None:
    if result.detections is None:
        raise SystemExit(f"{result.name}: {result.error}")
    if result.detections.counts.num_points != result.num_points:
        raise SystemExit(f"{result.name}: {result.num_points} points went in, and others came out.")


def latency(intervals: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Median, tail and worst, ms."""
    names = ("p50", "p99", "p99.9", "max")
    return dict(zip(names, np.percentile(intervals, [50, 99, 99.9, 100]).tolist(), strict=True))


def growth(memory: Sequence[tuple[int, int]], frames: int) -> dict[str, Any]:
    """Straight line through the resident memory once it has settled, and its medians of tenths of the run.

    A step in one tenth makes a slope as well as a leak does, which grows in each.
    """
    frame, kilobytes = np.array(memory, float).T
    settled = frame >= SETTLED_SHARE * frames
    slope, _ = np.polyfit(frame[settled], kilobytes[settled], 1)
    # A short run has fewer readings than tenths.
    tenths = np.array_split(kilobytes, min(10, len(kilobytes)))
    return {
        "growth_kb_per_1000_frames": float(1000 * slope),
        "median_mb_of_tenths": [float(np.median(part) / 1e3) for part in tenths],
    }


def run_real(options: argparse.Namespace) -> dict[str, Any]:
    """The same capacity throughout, as on one sensor."""
    config = common.chosen_config(options)
    if options.quick:
        sweeps = [Resized(f"street {seed}", street(seed), 15_000, seed) for seed in range(4)]
        return soak(_cycle(sweeps, options.frames), sweeps, config, CAPACITY_BUCKETS[0])
    sweeps = real_sweeps()
    return soak(_cycle(sweeps, options.frames), sweeps[:2], config, CAPACITY)


def run_varied(options: argparse.Namespace) -> dict[str, Any]:
    """Another number of points in each sweep, each in the bucket that fits."""
    config = common.chosen_config(options)
    base = street() if options.quick else real_sweeps()[0].read_points()[0]
    most = QUICK_MAX_POINTS if options.quick else MAX_POINTS
    sweeps = varied_sweeps(base, most, options.size_frames)
    buckets = [bucket for bucket in CAPACITY_BUCKETS if bucket < 2 * most]
    return soak(sweeps, sweeps[: len(buckets)], config, None)


def run_tracked(options: argparse.Namespace) -> dict[str, Any]:
    """The detector and the tracker, on drives that follow each other."""
    config = common.chosen_config(options)
    track = functools.partial(jaxbox.track, poses=PoseSource.BOXES)
    if options.quick:
        sweeps = [Resized(f"street {seed}", street(seed), 15_000, seed) for seed in range(4)]
        return soak(_cycle(sweeps, options.frames), sweeps, config, CAPACITY_BUCKETS[0], run=track)
    sweeps = [Untimed(sweep) for sweep in open_sweeps(common.data_folder(TRACK_SET))]
    return soak(_cycle(sweeps, options.frames), sweeps[:2], config, CAPACITY, run=track)


def _cycle(sweeps: Sequence[Any], frames: int) -> Iterator[Any]:
    return itertools.islice(itertools.cycle(sweeps), frames)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the figures and writes the report."""
    parser = common.parser(__doc__ or "", quick=f"{QUICK_FRAMES} small synthetic frames, which need no data")
    parser.add_argument(
        "--frames", type=common.at_least(1), help=f"of real sweeps and of drives, {FRAMES:,} by default"
    )
    parser.add_argument(
        "--size-frames", type=common.at_least(1), help=f"of varying size, {SIZE_FRAMES:,} by default"
    )
    options: argparse.Namespace = parser.parse_args(arguments)
    options.frames = options.frames or (QUICK_FRAMES if options.quick else FRAMES)
    options.size_frames = options.size_frames or (QUICK_FRAMES if options.quick else SIZE_FRAMES)
    report = {}
    for name, run in {"real": run_real, "varied": run_varied, "tracked": run_tracked}.items():
        # Of a process of its own, the peak is its own too.
        spawn = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(1, spawn) as pool:
            report[name] = pool.submit(run, options).result()
    print_report(report)
    common.write_report(report, options)


def print_report(report: dict[str, Any]) -> None:
    """The figures of the runs side by side."""
    names = [name for name, value in report["real"].items() if isinstance(value, int | float)]
    rows = [(name, *(report[run][name] for run in report)) for name in names]
    medians = itertools.zip_longest(*(report[run]["median_mb_of_tenths"] for run in report), fillvalue="")
    rows += [(f"median_mb_of_tenth_{k}", *values) for k, values in enumerate(medians, 1)]
    for name in report["real"]["frame_ms"]:
        rows.append((f"{name} of a frame, ms", *(report[run]["frame_ms"][name] for run in report)))
    common.print_table(["", *report], rows)
    print()
    by_capacity = report["varied"]["frame_ms_by_capacity"]
    common.print_table(
        ["capacity", *report["varied"]["frame_ms"]],
        [(capacity, *values.values()) for capacity, values in by_capacity.items()],
    )


if __name__ == "__main__":
    main()
