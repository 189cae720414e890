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


@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepResult:
    """What is written of one sweep."""

    record: Mapping[str, Any]
    """As `jaxbox.io.detections_record` makes it: name, time, boxes, status, counts."""
    xyz: np.ndarray | None = None
    """(n, 3) float32, m, sensor frame; None leaves the points out."""
    intensity: np.ndarray | None = None
    """(n,) float32; None where the points are not written."""
    calibration: Calibration | None = None
    """Of the camera; None where there is none."""
    image: np.ndarray | None = None
    """(h, w, 3) uint8, RGB; None where there is none."""

    def time_ns(self, index: int) -> int:
        """Its time, ns since 1970; for sweeps without one, as if ten a second had begun at 0.

        Args:
          index: position among the sweeps of the file.
        """
        known = self.record.get("timestamp_ns")
        return index * SWEEP_PERIOD_NS if known is None else int(known)


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
