"""What the commands that run on a Ray cluster have in common: their options, and what they say."""

import dataclasses
import json
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rich.progress import Progress

from jaxbox._interrupts import stoppable
from jaxbox.cli.console import ExitCode, counted, exit_code, make_progress, print_error, stderr, stdout
from jaxbox.cluster import ClusterError, DatasetReport, DriveReport, PartitionReport
from jaxbox.config import DetectorConfig
from jaxbox.io import InputError, PointConvention
from jaxbox.io.convention import ORDINARY

_PARQUET = "parquet"
OnReport = Callable[[PartitionReport, int], None]
"""Is told of each partition that is done, and of how many there are to do."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RayOptions:
    """Options of ``jaxbox detect`` and ``track`` that this engine takes; the commands' help explains them."""

    output: str
    """Folder or URL of the results."""
    config: DetectorConfig
    """The detector's settings."""
    address: str | None
    """Of the cluster; None to start one here."""
    jobs: int | None
    """Workers; None for as many as there are cores."""
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

    @property
    def speaks(self) -> bool:
        """Whether sentences are printed."""
        return not (self.quiet or self.json)

    def common(self) -> dict[str, Any]:
        """Options that the functions of `jaxbox.cluster` have in common, by name."""
        return {
            "address": self.address,
            "workers": self.jobs,
            "capacity": self.capacity,
            "min_score": self.min_score,
            "topic": self.topic,
            "resume": self.resume,
        }


def check_ray(
    options: Mapping[str, object],
    *,
    formats: Iterable[str] | None,
    points: bool | None,
    convention: PointConvention,
) -> None:
    """Refuses what is not for this engine.

    Args:
      options: by name, what else was given that the workers cannot do.
      formats: what is to be written; None where nothing was said.
      points: whether the points are to be written; None where nothing was said.
      convention: how the numbers of the points are to be taken.

    Raises:
      InputError: naming the first that was given.
    """
    given = {
        **{f"--format {name}": name != _PARQUET for name in formats or ()},
        "--points and --no-points": points is not None,
        "--scale, --axes, --flip and --columns": convention != ORDINARY,
        **options,
    }
    for name, value in given.items():
        if value:
            raise InputError(
                f"{name}: the workers of --engine ray write parquet, all boxes of sweeps as they are and no "
                "points, and draw nothing; leave it out."
            )


def check_local(output: str, address: str | None) -> None:
    """Refuses what is for this engine alone where it was not asked for.

    Raises:
      InputError: naming the option.
    """
    if address is not None:
        raise InputError("--address: only --engine ray has one; add it, or leave the address out.")
    if "://" in output:
        raise InputError(f"--output {output}: only --engine ray writes to a URL; add it, or give a folder.")


def run_on_ray(options: RayOptions, start: Callable[[OnReport], DatasetReport[Any]]) -> ExitCode:
    """Runs over an archive, and says how it goes.

    Args:
      options: the command's options.
      start: does it.

    Returns:
      `ExitCode.INTERRUPTED`, or `FRAME_FAILED` where a sweep failed or Ray gave up.

    Raises:
      InputError: where there are no sweeps, or those of OUTPUT are others.
      ImportError: without the extra ``ray``.
    """
    try:
        with stoppable(), make_progress(shown=options.speaks) as progress:
            report = start(_teller(options, progress))
    except ClusterError as error:
        print_error(f"{error} The partitions that are done stay; the same command with --resume goes on.")
        return ExitCode.FRAME_FAILED
    _tell_end(report, options)
    return exit_code(failed=bool(report.failures), interrupted=report.interrupted)


def _teller(options: RayOptions, progress: Progress) -> OnReport:
    task = progress.add_task("partitions", total=None)

    def on_report(part: PartitionReport, total: int) -> None:
        progress.update(task, total=total, advance=1)
        _tell(part, options)

    return on_report


def _tell(part: PartitionReport, options: RayOptions) -> None:
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
    elif options.speaks:
        failed = f", {len(part.failures)} failed" if part.failures else ""
        stdout().print(
            f"{part.name}: {part.num_done} of {part.num_sweeps} sweeps{failed}, {_found(part)}, "
            f"{part.seconds:.1f} s",
            markup=False,
        )
        for note in part.notes if isinstance(part, DriveReport) else ():
            stdout().print(f"{part.name}: {note}", markup=False)


def _found(part: PartitionReport) -> str:
    if isinstance(part, DriveReport):
        return f"{part.num_tracks} tracks, poses: {part.pose_source or 'none'}"
    return f"{part.num_boxes} boxes"


def _tell_end(report: DatasetReport[Any], options: RayOptions) -> None:
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
    elif options.speaks:
        num_done = report.num_done - report.num_done_before
        rate = num_done / max(report.elapsed_s, 1e-9)
        before = f", {report.num_done_before} done before" if report.num_skipped else ""
        stdout().print(f"{num_done} sweeps done, {report.num_failed} failed{before}", markup=False)
        stdout().print(
            f"{report.num_boxes} boxes in {counted(len(report.partitions), 'partition')} by "
            f"{counted(report.workers, 'worker')}, "
            f"{report.elapsed_s:.1f} s in all with starting and compiling, {rate:.1f} sweeps a second",
            markup=False,
        )
