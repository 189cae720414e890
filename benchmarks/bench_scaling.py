"""How the time of a sweep goes with its points, with the batch, and with devices and processes.

    python -m benchmarks.bench_scaling [--preset paper] [--quick] [--parts batches ...] [--json FILE]

Sweeps of 16,384 to 1,048,576 points are real ones: thinned out, or several turned about the sensor and laid
over each other, which no scene is, so some capacities overflow (status). A batch is a loop over `detect`, a
`detect_batch`, and a `jax.vmap`, whose bits are compared with the singles'. Throughput is measured in
processes of their own: `detect_batch` of sweeps in memory, by a process that may use one core, all cores,
or a device a core; and `jaxbox.stream`, which reads the files too, with one core, all cores, and a device
or a worker a core.
"""

import argparse
import concurrent.futures
import functools
import itertools
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

import jaxbox
from benchmarks import common
from jaxbox import DetectorConfig, PointCloud
from jaxbox._padding import CAPACITY_BUCKETS
from jaxbox.evaluation.copies import Copy, turn_points
from jaxbox.io import Sweep

BATCHES, QUICK_BATCHES = (1, 2, 4, 8, 16, 32, 64), (1, 4)
VMAPPED, QUICK_VMAPPED = (4, 64), (4,)
"""Batches that are vmapped too: each compiles once more."""
QUICK_CAPACITIES = (2**14, 2**17)
RUNS, QUICK_RUNS = 20, 5
STREAMED, QUICK_STREAMED = 160, 24
"""Sweeps of a measurement of throughput."""
PARTS: dict[str, dict[str, str]] = {
    "sizes": {
        "points": "points", "median": "median ms", "p90": "p90 ms", "ns_per_point": "ns a point",
        "first_call_s": "first call s", "status": "status",
    },
    "batches": {n: n for n in ("batch", "loop", "detect_batch", "vmap", "vmap_same_bits", "vmap_scratch_mb")},
    "throughput": {
        "call": "", "on": "on", "sweeps_per_s": "sweeps a second", "times_the_first": "times the first"
    },
}  # fmt: skip
"""Parts that can be measured, with the columns of their tables."""
ROUNDS = 5
"""Measurements of throughput of each kind."""
TURN_DEG = 17.3
"""Between sweeps that are laid over each other."""


def resize(clouds: Sequence[np.ndarray], num_points: int) -> np.ndarray:
    """(num_points, 3) of a sweep thinned out, or of several laid over each other."""
    turned = (turn_points(xyz, Copy(TURN_DEG * i)) for i, xyz in enumerate(itertools.cycle(clouds)))
    parts, count = [], 0
    while count < num_points:
        parts.append(next(turned))
        count += len(parts[-1])
    together = np.concatenate(parts)
    return together[np.linspace(0, len(together) - 1, num_points).astype(int)]


def time_sizes(
    clouds: Sequence[np.ndarray], capacities: Sequence[int], config: DetectorConfig, runs: int
) -> list[dict[str, Any]]:
    """Time of a sweep that fills its capacity, for each capacity."""
    rows = []
    for capacity in capacities:
        cloud = jax.device_put(PointCloud.from_numpy(resize(clouds, capacity), capacity=capacity))
        run = functools.partial(jaxbox.detect, cloud, config)
        compile_ms, found = common.milliseconds(run)
        spent = [common.milliseconds(run)[0] for _ in range(runs)]
        rows.append(
            {
                "points": capacity,
                "first_call_s": compile_ms / 1e3,
                **common.spread(spent),
                "ns_per_point": 1e6 * float(np.median(spent)) / capacity,
                "status": common.status_names([int(found.status)]),
            }
        )
    return rows


def same_bits(batch: Any, singles: Sequence[Any]) -> bool:
    """Whether row i of every array of a batch has the bits of single i."""
    return all(
        np.array_equal(leaf[i], single_leaf)
        for i, single in enumerate(singles)
        for leaf, single_leaf in zip(jax.tree.leaves(batch), jax.tree.leaves(single), strict=True)
    )


def time_batches(
    clouds: Sequence[PointCloud], config: DetectorConfig, *, quick: bool
) -> list[dict[str, Any]]:
    """Milliseconds a sweep of a loop, of `detect_batch` and of `jax.vmap`, by the size of the batch."""
    rows = []
    for size in QUICK_BATCHES if quick else BATCHES:
        batch = list(itertools.islice(itertools.cycle(clouds), size))
        row: dict[str, Any] = {"batch": size}
        ways: dict[str, Callable[[], Any]] = {
            "loop": lambda batch=batch: [jax.block_until_ready(jaxbox.detect(c, config)) for c in batch],
            "detect_batch": lambda batch=batch: jaxbox.detect_batch(batch, config),
        }
        if size in (QUICK_VMAPPED if quick else VMAPPED):
            stacked = jaxbox.stack_clouds(batch)
            vmapped = jax.jit(jax.vmap(lambda cloud: jaxbox.detect(cloud, config))).lower(stacked).compile()
            ways["vmap"] = functools.partial(vmapped, stacked)
            memory: Any = vmapped.memory_analysis()
            row["vmap_scratch_mb"] = memory.temp_size_in_bytes / 1e6
        answers = {name: jax.device_get(jax.block_until_ready(way())) for name, way in ways.items()}
        spent: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(2 if quick else 5):
            for name, way in ways.items():
                spent[name].append(common.milliseconds(way)[0] / size)
        row |= {name: float(np.median(ms)) for name, ms in spent.items()}
        if "vmap" in answers:
            row["vmap_same_bits"] = same_bits(answers["vmap"], answers["loop"])
        rows.append(row)
    return rows


def repeated(sweeps: Sequence[Sweep], count: int) -> Iterator[Sweep]:
    return itertools.islice(itertools.cycle(sweeps), count)


def use(cores: int, devices: int) -> Sequence[Any]:
    """Holds this process to that many cores, and to that many devices, which it returns."""
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:cores]))
    # Devices of a CPU: as many as JAX is asked for when it starts.
    jax.config.update("jax_num_cpu_devices", devices)
    return jax.local_devices()[:devices]


def rate_of_batch(sweeps: Sequence[Sweep], preset: str, count: int, cores: int, num_devices: int) -> float:
    """Sweeps a second of `detect_batch`, from arrays on the device, with that many cores and devices."""
    devices = use(cores, num_devices)
    config = DetectorConfig.presets()[preset]
    clouds = [PointCloud.from_numpy(*sweep.read_points()) for sweep in sweeps]
    placed = [jax.device_put(c, device) for c, device in zip(clouds, itertools.cycle(devices))]
    jax.block_until_ready(jaxbox.detect_batch(placed, config, devices=devices))
    batch = list(itertools.islice(itertools.cycle(placed), count))
    start = time.perf_counter()
    jax.block_until_ready(jaxbox.detect_batch(batch, config, devices=devices))
    return count / (time.perf_counter() - start)


def rate_of_stream(
    sweeps: Sequence[Sweep], preset: str, count: int, cores: int, num_devices: int, workers: int
) -> float:
    """Sweeps a second of `jaxbox.stream`, from files to boxes, once all devices or workers are at work."""
    devices = use(cores, num_devices) if workers == 1 else None
    start_up = 4 * workers * num_devices
    results = jaxbox.stream(
        repeated(sweeps, start_up + count),
        DetectorConfig.presets()[preset],
        workers=workers,
        devices=devices,
    )
    for _ in range(start_up):
        next(results)
    start = time.perf_counter()
    errors = [result.error for result in results if result.error]
    if errors:
        raise SystemExit("\n".join(errors))
    return count / (time.perf_counter() - start)


Way = tuple[str, str, Callable[..., float], tuple[int, ...]]


def ways_on_a_cpu(cores: int) -> list[Way]:
    """What works, on what, by which function, and its cores, devices and processes."""
    return [
        ("detect_batch", "one core", rate_of_batch, (1, 1)),
        ("detect_batch", "all cores", rate_of_batch, (cores, 1)),
        ("detect_batch", f"{cores} devices", rate_of_batch, (cores, cores)),
        ("stream", "one core", rate_of_stream, (1, 1, 1)),
        ("stream", "all cores", rate_of_stream, (cores, 1, 1)),
        ("stream", f"{cores} devices", rate_of_stream, (cores, cores, 1)),
        ("stream", f"{cores} workers", rate_of_stream, (cores, 1, cores)),
    ]


def ways_on_accelerators(cores: int, num_devices: int) -> list[Way]:
    """Likewise; no processes, of which each would want a device of its own."""
    counts = sorted({1, num_devices})
    return [
        *(("detect_batch", f"devices: {n}", rate_of_batch, (cores, n)) for n in counts),
        *(("stream", f"devices: {n}", rate_of_stream, (cores, n, 1)) for n in counts),
    ]


def throughput(sweeps: Sequence[Sweep], preset: str, count: int, rounds: int) -> list[dict[str, Any]]:
    """Sweeps a second by what works at them, and how many times that of the same call's first way.

    A ratio is taken within a round, in which all take their turn, and the median of the rounds' is given.
    """
    cores = len(os.sched_getaffinity(0))
    kind, num_devices = in_a_process(describe_devices, ())
    ways = ways_on_a_cpu(cores) if kind == "cpu" else ways_on_accelerators(cores, num_devices)
    calls = [call for call, *_ in ways]
    # Without a second way of any call there is no ratio that rounds would steady.
    rounds = rounds if len(set(calls)) < len(calls) else 1
    rates = [
        [in_a_process(function, (sweeps, preset, count, *arguments)) for *_, function, arguments in ways]
        for _ in range(rounds)
    ]
    return [
        {
            "call": call,
            "on": on,
            "sweeps_per_s": float(np.median([measured[i] for measured in rates])),
            "times_the_first": float(
                np.median([measured[i] / measured[calls.index(call)] for measured in rates])
            ),
        }
        for i, (call, on, *_) in enumerate(ways)
    ]


def describe_devices() -> tuple[str, int]:
    """What JAX computes on, and how many of it there are."""
    return jax.default_backend(), jax.local_device_count()


def in_a_process(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Calls it in a process of its own: cores and devices cannot be changed once JAX runs."""
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, spawn) as pool:
        return pool.submit(_call, function, arguments).result()


def _call(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    common.enable_cache()
    return function(*arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the tables and writes the report."""
    parser = common.parser(__doc__ or "", quick="few sizes, batches and sweeps")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    options: argparse.Namespace = parser.parse_args(arguments)
    if options.set:
        raise SystemExit("--set: scaling is measured with a preset as it is.")
    config, quick, report = common.chosen_config(options), options.quick, {}
    sweeps = common.kitti_sweeps(8)
    points = [sweep.read_points()[0] for sweep in sweeps]
    # Throughput before this process has an accelerator's memory, which it would not share.
    if "throughput" in options.parts:
        count, rounds = (QUICK_STREAMED, 1) if quick else (STREAMED, ROUNDS)
        report["throughput"] = throughput(sweeps, options.preset, count, rounds)
    if "sizes" in options.parts:
        capacities = QUICK_CAPACITIES if quick else CAPACITY_BUCKETS
        report["sizes"] = time_sizes(points, capacities, config, QUICK_RUNS if quick else RUNS)
    if "batches" in options.parts:
        clouds = [jax.device_put(PointCloud.from_numpy(xyz)) for xyz in points]
        report["batches"] = time_batches(clouds, config, quick=quick)
    print_tables(report)
    common.write_report(report, options)


def print_tables(report: dict[str, Any]) -> None:
    """Prints a table of each part that was measured."""
    for part, columns in PARTS.items():
        if part in report:
            print(f"\n{part}" + (", ms a sweep of 131,072 points" if part == "batches" else ""))
            found = [[row.get(c) for c in columns] for row in report[part]]
            rows = [[", ".join(v) if isinstance(v, list) else v for v in row] for row in found]
            common.print_table(list(columns.values()), rows)


if __name__ == "__main__":
    main()
