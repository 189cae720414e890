"""A sensor that is tilted, or not at the origin: its sweeps in the level frame of its mounting."""

import dataclasses
from collections.abc import Callable, Iterator

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
        report: Callable[[Mounting], None],
    ) -> None:
        """Takes a source.

        Args:
          source: of the sweeps as they are.
          position: x, y, z of the sensor in the frame of the points, m.
          level: whether the tilt is measured on the first sweeps, which are not handed on.
          report: is told how the sensor stands.
        """
        self.name, self.can_wait, self.hint = source.name, source.can_wait, source.hint
        self._source, self._position, self._level, self._report = source, position, level, report

    def __iter__(self) -> Iterator[LiveSweep | Fault | None]:
        """The sweeps in the level frame.

        Raises:
          InputError: where the first sweeps show no ground.
        """
        mounting = None if self._level else Mounting(self._position)
        first: list[LiveSweep] = []
        for item in self._source:
            if not isinstance(item, LiveSweep):
                yield item
            elif mounting is None:
                first.append(item)
                if len(first) == NUM_MEASURED:
                    # It asks a sweep for no more than its name and points.
                    mounting = io.measure_sweeps(first, position=self._position)  # pyright: ignore[reportArgumentType]
                    self._report(mounting)
            else:
                points = dataclasses.replace(item.points, xyz=mounting.level(item.points.xyz))
                yield dataclasses.replace(item, points=points)
