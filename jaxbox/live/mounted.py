"""A sensor with other axes, tilted, or not at the origin: its sweeps in the level frame of its mounting."""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from jaxbox import io
from jaxbox.geometry.mounting import Mounting
from jaxbox.io.levelled import NUM_MEASURED
from jaxbox.live.sweep import Fault, LiveSweep, Source


class MountedSource:
    """A source, seen upright from its sensor; a `jaxbox.live.Source`."""

    def __init__(
        self,
        source: Source,
        *,
        position: tuple[float, float, float],
        level: bool,
        convention: io.PointConvention = io.ORDINARY,
        report: Callable[[Mounting], None],
    ) -> None:
        """Takes a source.

        Args:
          source: of the sweeps as they are.
          position: x, y, z of the sensor in the frame of the points, m.
          level: whether the tilt is measured on the first sweeps, which are not handed on.
          convention: unit and axes of the points.
          report: is told how the sensor stands.
        """
        self.name, self.can_wait, self.hint = source.name, source.can_wait, source.hint
        self.is_open = source.is_open
        self._source, self._convention = source, convention
        self._position, self._level, self._report = position, level, report

    def __iter__(self) -> Iterator[LiveSweep | Fault | None]:
        """The sweeps in the level frame.

        Raises:
          InputError: where the first sweeps show no ground.
        """
        is_moved = any(self._position)
        mounting = None if self._level else Mounting(self._position)
        first: list[LiveSweep] = []
        for came in self._source:
            if not isinstance(came, LiveSweep):
                yield came
                continue
            item = _moved(came, self._convention.apply)
            if mounting is None:
                first.append(item)
                if len(first) == NUM_MEASURED:
                    # It asks a sweep for no more than its name and points.
                    mounting = io.measure_sweeps(first, position=self._position)  # pyright: ignore[reportArgumentType]
                    self._report(mounting)
                    is_moved = True
                    first.clear()
            else:
                yield _moved(item, mounting.level) if is_moved else item


def _moved(sweep: LiveSweep, move: Callable[[np.ndarray], np.ndarray]) -> LiveSweep:
    points = dataclasses.replace(sweep.points, xyz=move(sweep.points.xyz))
    return dataclasses.replace(sweep, points=points)
