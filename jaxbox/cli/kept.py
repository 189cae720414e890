"""A sweep that remembers its points: results and pictures show what was read for the detector."""

import dataclasses
from typing import Any

from jaxbox import io
from jaxbox.io.points import Points


@dataclasses.dataclass
class KeptSweep:
    """A sweep and, between the detector and the results, its points; in another process they stay there."""

    sweep: io.Sweep
    """The sweep."""
    keeps: bool = True
    """Whether its points are kept."""
    points: Points | None = None
    """x, y, z and intensity, once they have been read."""

    @property
    def name(self) -> str:
        """Of the sweep."""
        return self.sweep.name

    @property
    def frame(self) -> int | None:
        """Of the sweep."""
        return self.sweep.frame

    @property
    def timestamp_ns(self) -> int | None:
        """Of the sweep."""
        return self.sweep.timestamp_ns

    def read_points(self) -> Points:
        """Reads the points; as `jaxbox.io.Sweep.read_points`."""
        return self._keep(self.sweep.read_points())

    def read_timed_points(self) -> Any:
        """Reads the points; as `jaxbox.io.Sweep.read_timed_points`."""
        points = self.sweep.read_timed_points()
        self._keep((points.xyz, points.intensity))
        return points

    def take_points(self) -> Points:
        """The points, which are read again where they are not at hand, and forgotten here."""
        points = self.sweep.read_points() if self.points is None else self.points
        self.forget_points()
        return points

    def forget_points(self) -> None:
        """Lets go of the points."""
        self.points = None

    def _keep(self, points: Points) -> Points:
        self.points = points if self.keeps else None
        return points
