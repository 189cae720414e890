"""A whole archive by Ray's workers: sweeps a second and core, bytes a sweep, and what starting costs.

    python -m benchmarks.bench_cluster [--preset fast] [--sweeps 480] [--repeats 3] [--quick] [--json FILE]

Links to the real sweeps, over and over, are an archive; `jaxbox.cluster.detect_dataset` goes over it with one
worker, two, and so on up to the cores, in turns, each run with workers of its own. A worker's rate is that
of its partitions, from the first byte read to the file written; starting and compiling are apart. Beside
it `jaxbox.stream` over as many processes: what the cluster's bookkeeping costs is the difference.
"""

import argparse
import collections
import os
import pathlib
import statistics
import tempfile
import time
from collections.abc import Sequence
from typing import Any

import jaxbox
from benchmarks import common
from jaxbox import DetectorConfig
from jaxbox.cluster import DatasetReport, detect_dataset
from jaxbox.io import open_sweeps

SWEEPS, QUICK_SWEEPS = 480, 80
REPEATS = 3
PARTITIONS_PER_CORE = 6
"""So that no worker waits long for the last one."""
ARCHIVES = (10**6, 10**9)
"""Sizes of archives, sweeps, for which the work is worked out."""
SECONDS_PER_HOUR = 3600


def link_sweeps(folder: pathlib.Path, count: int) -> None:
    """A folder with links to the real sweeps, repeated up to a number of them."""
    paths = [sweep.points_path for sweep in common.kitti_sweeps()]
    for number in range(count):
        (folder / f"{number:06d}.bin").symlink_to(paths[number % len(paths)])


def worker_counts(cores: int) -> list[int]:
    """One, two, four and so on, and all cores.

    >>> worker_counts(6)
    [1, 2, 4, 6]
    """
    return sorted({*(2**k for k in range(cores.bit_length()) if 2**k <= cores), cores})


def summarise(report: DatasetReport, num_bytes_out: int) -> dict[str, float]:
    """One run in numbers; the rate of a worker is over its own time, without starting and compiling."""
    parts = report.partitions
    busy: collections.defaultdict[str, float] = collections.defaultdict(float)
    for part in parts:
        busy[part.worker] += part.seconds
    sweeps = sum(part.num_sweeps for part in parts)
    working = sum(busy.values())
    return {
        "sweeps_per_second_per_worker": sweeps / working,
        "sweeps_per_second": len(busy) * sweeps / working,
        "waiting_for_detector_share": sum(part.detect_s for part in parts) / working,
        "compile_s": max(part.compile_s for part in parts),
        "start_and_end_s": report.elapsed_s - max(busy.values()) - max(part.compile_s for part in parts),
        "peak_mb_per_worker": max(part.peak_mb for part in parts),
        "bytes_read_per_sweep": sum(part.num_bytes for part in parts) / sweeps,
        "bytes_written_per_sweep": num_bytes_out / sweeps,
        "boxes_per_sweep": report.num_boxes / sweeps,
    }


def run_cluster(
    archive: pathlib.Path, config: DetectorConfig, workers: int, partition: int
) -> dict[str, float]:
    """One run over the archive, with a Ray and an output of its own."""
    with tempfile.TemporaryDirectory() as output:
        report = detect_dataset(archive, output, config, workers=workers, sweeps_per_partition=partition)
        if report.failures:
            raise SystemExit(f"{len(report.failures)} sweeps failed: {report.failures[0]}")
        written = sum(path.stat().st_size for path in pathlib.Path(output).glob("*.parquet"))
        return summarise(report, written)


def run_stream(archive: pathlib.Path, config: DetectorConfig, workers: int) -> float:
    """Sweeps a second of `jaxbox.stream`, from the time when each process has had its first ones."""
    sweeps, warm_up = open_sweeps(archive), 4 * workers
    results = jaxbox.stream(sweeps, config, workers=workers)
    for _ in range(warm_up):
        next(results)
    start = time.perf_counter()
    count = sum(1 for _ in results)
    return count / (time.perf_counter() - start)


def median_of(runs: Sequence[dict[str, float]]) -> dict[str, float]:
    """The median of each figure."""
    return {name: statistics.median(run[name] for run in runs) for name in runs[0]}


def archives(figures: dict[str, float]) -> dict[str, dict[str, float]]:
    """What archives of some sizes take, at the rate of a worker that has a core to itself.

    Args:
      figures: of a run, as `summarise`.

    Returns:
      By size: core-hours, terabytes read, gigabytes written, and hours on 1,000 cores.
    """
    core_s = 1 / figures["sweeps_per_second_per_worker"]
    return {
        str(size): {
            "core_hours": size * core_s / SECONDS_PER_HOUR,
            "terabytes_read": size * figures["bytes_read_per_sweep"] / 1e12,
            "gigabytes_written": size * figures["bytes_written_per_sweep"] / 1e9,
            "hours_on_1000_cores": size * core_s / SECONDS_PER_HOUR / 1000,
        }
        for size in ARCHIVES
    }


def measure(config: DetectorConfig, sweeps: int, repeats: int) -> dict[str, Any]:
    """All runs, those that are compared one after the other."""
    counts = worker_counts(os.cpu_count() or 1)
    partition = max(1, sweeps // (PARTITIONS_PER_CORE * counts[-1]))
    runs: dict[int, list[dict[str, float]]] = {count: [] for count in counts}
    streams: dict[int, list[float]] = {count: [] for count in counts}
    with tempfile.TemporaryDirectory() as folder:
        archive = pathlib.Path(folder)
        link_sweeps(archive, sweeps)
        for _ in range(repeats):
            for count in counts:
                runs[count].append(run_cluster(archive, config, count, partition))
                streams[count].append(run_stream(archive, config, count))
    figures = {count: median_of(runs[count]) for count in counts}
    return {
        "sweeps": sweeps,
        "sweeps_per_partition": partition,
        "workers": {str(count): figures[count] for count in counts},
        "stream_sweeps_per_second": {str(count): statistics.median(streams[count]) for count in counts},
        # With all cores at work, as on a cluster.
        "archives": archives(figures[counts[-1]]),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the figures and writes the report."""
    parser = common.parser(__doc__ or "", quick=f"{QUICK_SWEEPS} sweeps, once")
    parser.add_argument("--sweeps", type=common.at_least(1), default=SWEEPS)
    parser.add_argument("--repeats", type=common.at_least(1), default=REPEATS)
    options: argparse.Namespace = parser.parse_args(arguments)
    config = common.chosen_config(options)
    sweeps, repeats = (QUICK_SWEEPS, 1) if options.quick else (options.sweeps, options.repeats)
    report = measure(config, sweeps, repeats)
    names = list(next(iter(report["workers"].values())))
    common.print_table(
        ["workers", *report["workers"]],
        [(name, *(run[name] for run in report["workers"].values())) for name in names]
        + [("stream: sweeps_per_second", *report["stream_sweeps_per_second"].values())],
    )
    print()
    columns = list(next(iter(report["archives"].values())))
    common.print_table(
        ["sweeps of the archive", *columns],
        [(f"{int(size):.0e}", *row.values()) for size, row in report["archives"].items()],
    )
    common.write_report(report, options)


if __name__ == "__main__":
    main()
