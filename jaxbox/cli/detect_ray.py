"""``jaxbox detect --engine ray``: the sweeps of an archive by the workers of a Ray cluster, to Parquet."""

import dataclasses
import json
from collections.abc import Sequence

from rich.progress import Progress

from jaxbox.cli.console import ExitCode, make_progress, print_error, stderr, stdout, stoppable
from jaxbox.cli.results import ResultFormat
from jaxbox.cluster import ClusterError, DatasetReport, PartitionReport, detect_dataset
from jaxbox.config import DetectorConfig
from jaxbox.io import InputError


@dataclasses.dataclass(frozen=True, kw_only=True)
class RayOptions:
    """The options of ``jaxbox detect`` that this engine takes; the command's help explains them."""

    output: str
    """Folder or URL of the results."""
    config: DetectorConfig
    """The detector's settings."""
    formats: frozenset[ResultFormat]
    """What was asked for; only Parquet can be written."""
    pictures: bool
    """Whether pictures were asked for; none can be drawn."""
    points: bool | None
    """Whether the points were asked for; None where nothing was said, as Parquet holds none."""
    address: str | None
    """Of the cluster; None to start one here."""
    jobs: int | None
    """Workers; None for as many as there are cores."""
    sweeps_per_partition: int
    """Size of the partitions."""
    topic: str | None
    """Topic of the points in recordings."""
    capacity: int | None
    """Points a sweep is padded to, or None for what it needs."""
    min_score: float
    """Boxes with lower scores are dropped."""
    resume: bool
    """Whether finished partitions are kept."""
    quiet: bool
    """Whether only errors are printed."""
    json: bool
    """Whether stdout is JSON Lines."""

    def check(self) -> None:
        """Refuses what the workers cannot do.

        Raises:
          InputError: naming the option.
        """
        if other := self.formats - {ResultFormat.PARQUET}:
            raise InputError(
                f"--format {min(other).value}: the workers of --engine ray write parquet; leave it out."
            )
        if self.pictures:
            raise InputError("--pictures: the workers of --engine ray draw none; leave the option out.")
        if self.points is not None:
            raise InputError(
                "--points and --no-points: the parquet of --engine ray holds no points; leave the option out."
            )


def run_detect_ray(paths: Sequence[str], options: RayOptions) -> ExitCode:
    """Detects in all sweeps of some paths and URLs.

    Args:
      paths: what `jaxbox.cluster.detect_dataset` takes.
      options: the command's options.

    Returns:
      `ExitCode.FRAME_FAILED` where a sweep failed, it was interrupted, or Ray gave up.

    Raises:
      InputError: where there are no sweeps, or the options cannot be used.
      ImportError: without the extra ``ray``.
    """
    options.check()
    speaks = not (options.quiet or options.json)
    try:
        with stoppable(), make_progress(shown=speaks) as progress:
            report = _run(paths, options, progress, speaks)
    except ClusterError as error:
        print_error(f"{error} The partitions that are done stay; the same command with --resume goes on.")
        return ExitCode.FRAME_FAILED
    _tell_end(report, options, speaks)
    return ExitCode.FRAME_FAILED if report.failures or report.interrupted else ExitCode.OK


def _run(paths: Sequence[str], options: RayOptions, progress: Progress, speaks: bool) -> DatasetReport:
    task = progress.add_task("partitions", total=None)

    def on_report(part: PartitionReport, total: int) -> None:
        progress.update(task, total=total, advance=1)
        _tell(part, options, speaks)

    return detect_dataset(
        paths,
        options.output,
        options.config,
        address=options.address,
        workers=options.jobs,
        sweeps_per_partition=options.sweeps_per_partition,
        capacity=options.capacity,
        min_score=options.min_score,
        topic=options.topic,
        resume=options.resume,
        on_report=on_report,
    )


def _tell(part: PartitionReport, options: RayOptions, speaks: bool) -> None:
    """One partition: what went wrong to stderr, and what was done to stdout."""
    if part.num_deaths:
        workers = "a worker" if part.num_deaths == 1 else f"{part.num_deaths} workers"
        print_error(f"{part.name}: {workers} died on it; it was begun again.")
    for failure in part.failures:
        print_error(f"sweep {failure['sweep']}: {failure['reason']}")
    if part.error is not None:
        print_error(f"{part.name}: {part.error}")
    if options.json:
        stdout().out(json.dumps(dataclasses.asdict(part), allow_nan=False), highlight=False)
    elif speaks:
        failed = f", {len(part.failures)} failed" if part.failures else ""
        stdout().print(
            f"{part.name}: {part.num_done} of {part.num_sweeps} sweeps{failed}, {part.num_boxes} boxes, "
            f"{part.seconds:.1f} s",
            markup=False,
        )


def _tell_end(report: DatasetReport, options: RayOptions, speaks: bool) -> None:
    if report.interrupted:
        stderr().print("interrupted; the same command with --resume goes on.", markup=False)
    if options.json:
        summary = {
            "done": report.num_done,
            "skipped": report.num_skipped,
            "interrupted": report.interrupted,
            "failures": [{"sweep": item["sweep"], "reason": item["reason"]} for item in report.failures],
            "repeated": [{"partition": name, "deaths": deaths} for name, deaths in report.deaths.items()],
        }
        stdout().out(json.dumps({"summary": summary}, allow_nan=False), highlight=False)
    elif speaks:
        num_done = report.num_done - report.num_done_before
        rate = num_done / max(report.elapsed_s, 1e-9)
        before = f", {report.num_done_before} done before" if report.num_skipped else ""
        stdout().print(
            f"{num_done} sweeps done, {len(report.failures)} failed{before}\n"
            f"{report.num_boxes} boxes in {len(report.partitions)} partitions by {report.workers} workers, "
            f"{report.elapsed_s:.1f} s in all with starting and compiling, {rate:.1f} sweeps a second",
            markup=False,
        )
