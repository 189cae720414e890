"""Files that take the results of a whole run, one sweep after the other: what they share.

Each writer is a context that lends a function; the file takes its name when the context has ended well, and
is complete then, or is not there. A new format is a module with a `ResultFile` and a line in
`jaxbox.cli.results`.
"""

import contextlib
import dataclasses
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxbox.types import Calibration

SWEEP_PERIOD_NS = 10**8
"""Time between sweeps whose own times are unknown: most sensors turn ten times a second."""

_NS_PER_S = 10**9


@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepResult:
    """What is written of one sweep."""

    record: Mapping[str, Any]
    """As `jaxbox.io.detections_record` or `jaxbox.io.tracks_record` makes it: name, time, boxes, status,
    counts."""
    xyz: np.ndarray | None = None
    """(n, 3) float32, m, sensor frame; None leaves the points out."""
    intensity: np.ndarray | None = None
    """(n,) float32; None where the points are not written."""
    calibration: Calibration | None = None
    """Of the camera; None where there is none."""
    image: np.ndarray | None = None
    """(h, w, 3) uint8, RGB; None where there is none."""
    trails: Mapping[int, np.ndarray] | None = None
    """Of tracks: for each id (m, 3) m, where it was lately, in this sweep's sensor frame; else None."""

    def time_ns(self, index: int) -> int:
        """Its time, ns since 1970; for sweeps without one, from 0 as a tracker took them, or ten a second.

        Args:
          index: position among the sweeps of the file.
        """
        known, time_s = self.record.get("timestamp_ns"), self.record.get("time_s")
        if known is not None:
            return int(known)
        return index * SWEEP_PERIOD_NS if time_s is None else round(time_s * _NS_PER_S)


WriteResult = Callable[[SweepResult], None]
"""Adds one sweep to a file."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResultFile:
    """A kind of file that holds the boxes of many sweeps."""

    name: str
    """Of the file within the output folder."""
    open: Callable[[pathlib.Path, bool], contextlib.AbstractContextManager[WriteResult]]
    """Opens one for writing; with True, what an earlier one of that path holds is carried over."""
    finished: Callable[[pathlib.Path], frozenset[str]] | None = None
    """Names of the sweeps that a file holds; None where it cannot be continued."""
    wants_points: bool = False
    """Whether points, calibration and image are written."""
