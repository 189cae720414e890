"""What the commands say about a sweep, a run and its boxes, in words and tables."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from rich.table import Table

from jaxbox.cli.console import printable
from jaxbox.config import DEFAULT_SCORE_THRESHOLD
from jaxbox.config.class_priors import classes_in_words
from jaxbox.types import Detections, Status

SHOWN_MIN_SCORE = DEFAULT_SCORE_THRESHOLD
"""Boxes that score less are written but not drawn or counted as found: most of them are not vehicles."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrameReport:
    """One sweep that went through."""

    name: str
    """Name of the sweep."""
    num_points: int
    """Points of the sweep."""
    detections: Detections
    """What was found."""
    detect_s: float
    """Seconds in the detector, without compiling."""
    other_s: float
    """Seconds of reading, writing and drawing."""


@dataclasses.dataclass(frozen=True)
class FrameOutcome:
    """What is kept of a sweep until the end of the run: its detections would fill the memory."""

    detect_s: float
    """Seconds in the detector, without compiling."""
    other_s: float
    """Seconds of reading, writing and drawing."""
    status: Status
    """What happened."""

    @classmethod
    def of(cls, report: FrameReport) -> "FrameOutcome":
        """The outcome of a sweep that went through."""
        return cls(report.detect_s, report.other_s, Status(int(report.detections.status)))


@dataclasses.dataclass
class RunReport:
    """All sweeps of a run."""

    frames: list[FrameOutcome] = dataclasses.field(default_factory=list)
    """Those that went through."""
    failures: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    """Name and reason of those that did not."""
    num_skipped: int = 0
    """Sweeps that an earlier run had finished."""
    interrupted: bool = False
    """Whether the run was ended before its last sweep."""
    repeated: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    """Name and reason of those whose worker process died, and that were tried once more."""
    jobs: int = 1
    """Processes at work."""
    elapsed_s: float = 0.0
    """Seconds from the first sweep to the last, compiling included."""
    compile_s: dict[int, float] = dataclasses.field(default_factory=dict)
    """Seconds that each capacity took to compile, in the slowest process."""

    def add_compile_times(self, seconds: Mapping[int, float]) -> None:
        """Takes in what one process says.

        Args:
          seconds: by capacity.
        """
        for capacity, value in seconds.items():
            self.compile_s[capacity] = max(value, self.compile_s.get(capacity, 0.0))


def describe_frame(report: FrameReport, *, min_score: float = SHOWN_MIN_SCORE) -> list[str]:
    """One line of counts and time, then one line a status bit.

    Args:
      report: the sweep.
      min_score: boxes from this score on are counted by class.

    Returns:
      At least one line.
    """
    found = count_classes(report.detections, min_score=min_score)
    total = int(np.asarray(report.detections.valid).sum())
    line = (
        f"{report.name}: {report.num_points} points, {found} of score >= {min_score:g} "
        f"({total} in all), {report.detect_s * 1e3:.0f} ms"
    )
    return [line, *(f"  {text}" for text in Status(int(report.detections.status)).describe())]


def count_classes(detections: Detections, *, min_score: float) -> str:
    """Boxes a class, in words: '3 cars, 1 van', or 'no vehicle'."""
    keep = np.asarray(detections.valid) & (np.asarray(detections.score) >= min_score)
    return classes_in_words(np.asarray(detections.label)[keep]) or "no vehicle"


def describe_run(run: RunReport) -> list[str]:
    """The summary: sweeps, times without compiling, and which status bits occurred how often.

    Args:
      run: what happened.

    Returns:
      A few lines.
    """
    skipped = f", {run.num_skipped} done before" if run.num_skipped else ""
    lines = [f"{len(run.frames)} sweeps done, {len(run.failures)} failed{skipped}"]
    if run.compile_s:
        parts = [f"{seconds:.1f} s for {capacity} points" for capacity, seconds in run.compile_s.items()]
        each = f" in each of {run.jobs} processes" if run.jobs > 1 else ""
        lines.append(f"compiled (or loaded from the cache) once{each}: {', '.join(parts)}")
    if run.frames:
        rate = len(run.frames) / max(run.elapsed_s, 1e-9)
        lines.append(f"took {run.elapsed_s:.1f} s in all, {rate:.1f} sweeps a second")
        detect_ms = np.array([frame.detect_s for frame in run.frames]) * 1e3
        other_ms = np.array([frame.other_s for frame in run.frames]) * 1e3
        lines.append(
            f"detector: median {np.median(detect_ms):.0f} ms, slowest {detect_ms.max():.0f} ms a sweep; "
            f"reading, writing and drawing: median {np.median(other_ms):.0f} ms"
        )
    for bit in Status:
        count = sum(bit in frame.status for frame in run.frames) if bit else 0
        if count:
            lines.append(f"{bit.name} in {count} of {len(run.frames)} sweeps")
    lines.extend(f"tried again: {name}: its process ended ({reason})" for name, reason in run.repeated)
    lines.extend(f"failed: {name}: {reason}" for name, reason in run.failures)
    return lines


def make_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A table whose first column is text and the others are numbers, to the right."""
    table = Table(title=title, title_justify="left")
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index == 0 else "right")
    for row in rows:
        table.add_row(*map(printable, row))
    return table
