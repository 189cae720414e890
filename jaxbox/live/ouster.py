"""An Ouster sensor on the network, by the library ``ouster-sdk``: it is told to send its packets here."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxbox._extras import require
from jaxbox._files import reason
from jaxbox.io import InputError, TimedPoints
from jaxbox.live.sweep import IDLE_S, Fault, LiveSweep, now_ns

_NS = 1e-9


class OusterSource:
    """An Ouster sensor; a `jaxbox.live.Source`."""

    can_wait = False

    def __init__(self, host: str) -> None:
        """Connects, and has the sensor send its packets to this machine.

        Args:
          host: name or address of the sensor.

        Raises:
          InputError: where there is no such sensor.
          ImportError: without the extra ``ouster``.
        """
        sensors = require("ouster.sdk.sensor", extra="ouster", what="Ouster sensors")
        core = require("ouster.sdk.core", extra="ouster", what="Ouster sensors")
        self.name = f"ouster://{host}"
        self.hint = "is the sensor on, and may its packets pass this machine's firewall?"
        try:
            self._source = sensors.SensorFrameSetSource(host)
            self._project = core.XYZLut(self._source.sensor_info[0], False)
        except (RuntimeError, ValueError, OSError) as error:
            raise InputError(
                f"{self.name}: no Ouster sensor answers there ({reason(error)}). Is it on, and is the name "
                "that of its label, such as os-122224000123.local?"
            ) from error
        self._timeouts = (TimeoutError, sensors.ClientTimeout)

    def __iter__(self) -> Iterator[LiveSweep | Fault | None]:
        """A sweep with the packet that ends its frame."""
        number = 0
        try:
            while True:
                found = self._next()
                if found is None:
                    yield None
                    continue
                points = frame_points(found, self._project)
                yield LiveSweep(
                    name=f"{number:06d}",
                    frame=number,
                    timestamp_ns=_start_ns(found),
                    arrived_ns=now_ns(),
                    points=points,
                )
                number += 1
        finally:
            self._source.close()

    def _next(self) -> Any:
        """A frame, or None where none came."""
        try:
            found = self._source.get_frame(IDLE_S)
        except self._timeouts:
            return None
        return None if found is None else found[1]


def frame_points(frame: Any, project: Any) -> TimedPoints:
    """The points of a frame that saw something.

    Args:
      frame: of the library, (H, W) beams and columns.
      project: makes (H, W, 3) coordinates of it, m.

    Returns:
      The points, beam by beam; times from the first column's.
    """
    seen = np.asarray(frame.field("RANGE")) > 0
    name = next((name for name in ("REFLECTIVITY", "SIGNAL") if name in set(frame.fields)), None)
    intensity = np.zeros(seen.shape) if name is None else np.asarray(frame.field(name))
    column_s = (np.asarray(frame.timestamp).astype(np.int64) - _start_ns(frame)) * _NS
    return TimedPoints(
        np.asarray(project(frame))[seen].astype(np.float32),
        intensity[seen].astype(np.float32),
        np.broadcast_to(column_s, seen.shape)[seen],
    )


def _start_ns(frame: Any) -> int:
    """The time of the first column that was measured, by the sensor's clock; columns without have 0."""
    times = np.asarray(frame.timestamp)
    return int(times[times > 0].min()) if (times > 0).any() else 0
