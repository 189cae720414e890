"""An Ouster sensor on the network, by the library ``ouster-sdk``: it is told to send its packets here."""

from collections.abc import Iterator
from typing import Any

from jaxbox._extras import require
from jaxbox._files import reason
from jaxbox.io import InputError
from jaxbox.io.ouster import OusterPoints
from jaxbox.live.sweep import IDLE_S, Fault, LiveSweep, now_ns


class OusterSource:
    """An Ouster sensor; a `jaxbox.live.Source`."""

    can_wait, is_open = False, False

    def __init__(self, host: str) -> None:
        """Connects, and has the sensor send its packets to this machine.

        Args:
          host: name or address of the sensor.

        Raises:
          InputError: where there is no such sensor.
          ImportError: without the extra ``ouster``.
        """
        sensors = require("ouster.sdk.sensor", extra="ouster", what="Ouster sensors")
        self.name = f"ouster://{host}"
        self.hint = "is the sensor on, and may its packets pass this machine's firewall?"
        try:
            self._source = sensors.SensorFrameSetSource(host)
            self._metadata = self._source.sensor_info[0].to_json_string()
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
                arrived_ns, points = now_ns(), OusterPoints(self._metadata, found)
                yield LiveSweep(
                    name=f"{number:06d}",
                    frame=number,
                    timestamp_ns=points.header()[0],
                    arrived_ns=arrived_ns,
                    points=points.timed(),
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
