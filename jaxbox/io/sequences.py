"""Sweeps in sequences: those of one drive, in the order of time."""

import collections
import pathlib
from collections.abc import Sequence

from jaxbox.io.levelled import LevelSweeps
from jaxbox.io.recordings import RecordedSweeps
from jaxbox.io.sweep import Sweep
from jaxbox.io.sweeps import ChainedSweeps, distinct_names

_UNNAMED = "sequence"
"""Of sweeps whose folder has no name, as the root of a file system."""

_Group = tuple[pathlib.Path, str, Sequence[Sweep]]
"""What tells apart sequences of one name, the name, and the sweeps."""


def group_sequences(sweeps: Sequence[Sweep]) -> list[tuple[str, Sequence[Sweep]]]:
    """Groups sweeps by the drive that they belong to.

    Nothing is read: a recording is one sequence, and stays what it is.

    Args:
      sweeps: as `jaxbox.io.open_sweeps` finds them, level or not.

    Returns:
      Name and sweeps of each sequence, in the order of their first sweeps. Names differ; two drives of one
      name have their folders' names before it. Where all sweeps of a sequence have times they are sorted by
      them, and keep their order otherwise; sweeps of one time stay side by side.
    """
    groups = _groups(sweeps)
    names = distinct_names([(path, name) for path, name, _ in groups])
    return [(name, group) for name, (_, _, group) in zip(names, groups, strict=True)]


def _groups(sweeps: Sequence[Sweep]) -> list[_Group]:
    if isinstance(sweeps, LevelSweeps):
        return [
            (path, name, LevelSweeps(part, sweeps.mounting)) for path, name, part in _groups(sweeps.sweeps)
        ]
    if isinstance(sweeps, ChainedSweeps):
        return [group for part in sweeps.parts for group in _groups(part)]
    if isinstance(sweeps, RecordedSweeps):
        return [(sweeps.path, sweeps.path.stem, sweeps)]
    found: dict[tuple[pathlib.Path, str], list[Sweep]] = collections.defaultdict(list)
    for sweep in sweeps:
        # A recording is one sequence; files are of one where they lie in one folder.
        place = sweep.points_path.parent if sweep.decode is None else sweep.points_path
        found[place, sweep.sequence or _UNNAMED].append(sweep)
    return [(place, name, tuple(_by_time(group))) for (place, name), group in found.items()]


def _by_time(sweeps: list[Sweep]) -> list[Sweep]:
    if any(sweep.timestamp_ns is None for sweep in sweeps):
        return sweeps
    return sorted(sweeps, key=lambda sweep: sweep.timestamp_ns or 0)
