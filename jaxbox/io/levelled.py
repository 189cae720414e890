"""Sweeps seen upright from their sensor: points and calibration in the level frame of a mounting."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import overload

import numpy as np

from jaxbox._files import InputError
from jaxbox.geometry.mounting import Mounting, measure_mounting
from jaxbox.io.points import Points, TimedPoints
from jaxbox.io.sweep import Sweep, seen_from_frame
from jaxbox.types import Calibration

NUM_MEASURED = 5
"""Sweeps that a mounting is measured on, spread over all there are."""


@dataclasses.dataclass(frozen=True)
class LevelSweep(Sweep):
    """A sweep whose points, and whose camera, are moved into the level frame of its mounting."""

    mounting: Mounting = dataclasses.field(default_factory=Mounting)
    """How the sensor stands in the frame of the file."""

    def read_points(self) -> Points:
        """Reads the points; as `Sweep.read_points`, in the level frame."""
        xyz, intensity = super().read_points()
        return self.mounting.level(xyz), intensity

    def read_timed_points(self) -> TimedPoints:
        """Reads the points with their times; as `Sweep.read_timed_points`, in the level frame."""
        points = super().read_timed_points()
        return dataclasses.replace(points, xyz=self.mounting.level(points.xyz))

    def read_calibration(self) -> Calibration | None:
        """Reads the camera; as `Sweep.read_calibration`, seen from the level frame."""
        calibration = super().read_calibration()
        return None if calibration is None else seen_from_frame(calibration, self.mounting.T_level_points)


class LevelSweeps(Sequence[LevelSweep]):
    """Sweeps of one sensor, each in the level frame; read as the sweeps themselves are, one by one."""

    def __init__(self, sweeps: Sequence[Sweep], mounting: Mounting) -> None:
        self.mounting = mounting
        """How the sensor stands, such as `measure_sweeps` finds."""
        self.sweeps = sweeps
        """The sweeps as they are."""

    def __len__(self) -> int:
        """As many as there were."""
        return len(self.sweeps)

    def __iter__(self) -> Iterator[LevelSweep]:
        """One pass over the sweeps."""
        return map(self._level, self.sweeps)

    @overload
    def __getitem__(self, index: int) -> LevelSweep: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[LevelSweep, ...]: ...
    def __getitem__(self, index: int | slice) -> LevelSweep | tuple[LevelSweep, ...]:
        """A sweep by its number, or several."""
        if isinstance(index, slice):
            return tuple(map(self._level, self.sweeps[index]))
        return self._level(self.sweeps[index])

    def _level(self, sweep: Sweep) -> LevelSweep:
        fields = {field.name: getattr(sweep, field.name) for field in dataclasses.fields(Sweep)}
        return LevelSweep(**fields, mounting=self.mounting)


def measure_sweeps(
    sweeps: Sequence[Sweep],
    *,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Mounting:
    """Measures how a sensor is mounted: the middle of a few of its sweeps, so that no bump or slope counts.

    Where the ground is at the origin, the points are in a vehicle's frame: the sensor is taken to stand over
    the origin at a roof's height. Where that is not so, say where it stands.

    Args:
      sweeps: of one sensor.
      position: x, y, z of the sensor in the frame of the points, m.

    Returns:
      The mounting.

    Raises:
      InputError: where none of them can be read and shows a ground, or it lies above the sensor.
    """
    # Every n-th sweep: a recording is passed once.
    some = sweeps[:: -(-len(sweeps) // NUM_MEASURED)]
    found = [_measured(sweep, position) for sweep in some]
    seen = [mounting for mounting in found if mounting is not None]
    if not seen:
        raise InputError(
            f"{sweeps[0].name}: no ground round the sensor in {len(some)} sweeps, so the mounting cannot be "
            "measured. Is z up, and the position of the sensor right?"
        )
    up = np.median([mounting.up for mounting in seen], axis=0)
    x, y, z = (float(value) for value in up / np.linalg.norm(up))
    heights_m = [mounting.height_m for mounting in seen if mounting.height_m is not None]
    height_m = float(np.median(heights_m))
    mounting = Mounting(position, (x, y, z), height_m)
    if mounting.is_upside_down:
        raise InputError(
            f"{sweeps[0].name}: the ground lies {-height_m:.2f} m above the sensor. Does it hang upside "
            "down, or does z point down? Turn the points over first."
        )
    # A position that was given is meant.
    return mounting if any(position) else mounting.raised()


def _measured(sweep: Sweep, position: tuple[float, float, float]) -> Mounting | None:
    try:
        return measure_mounting(sweep.read_points()[0], position=position)
    except InputError:
        # It will be reported in its turn; the others tell how the sensor stands.
        return None
