"""A sweep that has just come in, and what a source of them is."""

import dataclasses
import time
from collections.abc import Iterator
from typing import Protocol

import numpy as np

from jaxbox.io.mcap_results import FRAME_ID
from jaxbox.io.points import TimedPoints


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class LiveSweep:
    """One sweep with its points, as a source hands it over."""

    name: str
    """Of the sweep, for the results."""
    frame: int
    """Number of the sweep among all that the source had, from 0; those that were skipped are counted."""
    timestamp_ns: int
    """When it was taken, ns: by its own clock where it has one, else since 1970 by this machine's."""
    arrived_ns: int
    """When its last point was there, ns since 1970 by this machine's clock."""
    points: TimedPoints
    """The points, and when each was measured."""
    frame_id: str = FRAME_ID
    """Name of the coordinate frame of the points."""

    @property
    def num_points(self) -> int:
        """Of the sweep."""
        return len(self.points.xyz)

    def read_points(self) -> tuple[np.ndarray, np.ndarray | None]:
        """The points: (n, 3) m, and (n,) intensity."""
        return self.points.xyz, self.points.intensity

    def read_timed_points(self) -> TimedPoints:
        """The points with their times."""
        return self.points

    def arriving_now(self) -> "LiveSweep":
        """The same sweep, as if it came in now."""
        return dataclasses.replace(self, arrived_ns=now_ns())


def now_ns() -> int:
    """The time by this machine's clock, ns since 1970."""
    return time.time_ns()


@dataclasses.dataclass(frozen=True)
class Fault:
    """Something that came in and is no sweep: a broken file, a packet that cannot be read."""

    reason: str
    """In words."""


class Source(Protocol):
    """Where sweeps come from. A thread of its own goes through it."""

    name: str
    """For the results and messages."""
    can_wait: bool
    """Whether it holds its sweeps back while nobody is ready, as a recording does and a sensor does not."""
    hint: str
    """What to look at where nothing comes."""
    is_open: bool
    """Whether whoever reaches this machine may send points."""

    def __iter__(self) -> Iterator[LiveSweep | Fault | None]:
        """The sweeps as they come; None several times a second while there is none."""
        ...


IDLE_S = 0.2
"""A source that waits says so at least as often as this, so that it can be ended, s."""
