"""From what a user names to a source: a path, or the address of a sensor."""

import pathlib
import urllib.parse
from collections.abc import Callable, Mapping

from jaxbox import io
from jaxbox.io import InputError
from jaxbox.live.ouster import OusterSource
from jaxbox.live.recorded import RecordedSource
from jaxbox.live.ros2 import Ros2Source
from jaxbox.live.sweep import Source
from jaxbox.live.velodyne import PORT, UdpAddress, VelodyneSource
from jaxbox.run.tracking import RATE_HZ


def is_sensor(source: str) -> bool:
    """Whether a source is named by an address, and not by a path.

    >>> is_sensor("udp://:2368"), is_sensor("drive.mcap")
    (True, False)
    """
    return "://" in source


def open_source(
    source: str, *, topic: str | None = None, rate_hz: float = RATE_HZ, loop: bool = False
) -> Source:
    """Opens what is named.

    Args:
      source: a path as `jaxbox.io.open_sweeps` takes it; ``udp://[HOST][:PORT]`` for packets of a Velodyne
        sensor, with ``?from=``, ``model=`` and ``calibration=`` as `UdpAddress` has them; ``ouster://HOST``;
        ``ros2://TOPIC``.
      topic: of the points in recordings.
      rate_hz: sweeps a second of recordings without times.
      loop: whether a recording begins again where it ends.

    Returns:
      The source.

    Raises:
      InputError: where it cannot be opened, or is not known.
      ImportError: naming the extra that it needs.
    """
    if is_sensor(source):
        return open_sensor(source)
    sweeps = io.open_sweeps(source, topic=topic)
    return RecordedSource(sweeps, name=pathlib.Path(source).stem, rate_hz=rate_hz, loop=loop)


def open_sensor(source: str) -> Source:
    """Opens a sensor by its address.

    Args:
      source: as `open_source`.

    Returns:
      The source.

    Raises:
      InputError: as `open_source`.
      ImportError: as `open_source`.
    """
    scheme = source.partition("://")[0]
    if scheme not in SENSORS:
        known = ", ".join(f"{name}://" for name in SENSORS)
        raise InputError(f"{source}: not a known kind of address; give {known}, or a path.")
    return SENSORS[scheme](source)


def parse_udp(source: str) -> UdpAddress:
    """Takes a ``udp://`` address apart.

    Args:
      source: ``udp://[HOST][:PORT][?from=HOST&model=NAME&calibration=PATH]``.

    Returns:
      Its parts.

    Raises:
      InputError: for another form.

    >>> parse_udp("udp://0.0.0.0?model=VLP16")
    UdpAddress(host='0.0.0.0', port=2368, sender=None, model='VLP16', calibration=None)
    """
    try:
        parts = urllib.parse.urlsplit(source)
        port = PORT if parts.port is None else parts.port
        options = dict(urllib.parse.parse_qsl(parts.query, strict_parsing=bool(parts.query)))
    except ValueError as error:
        raise InputError(f"{source}: {error}; give udp://HOST:PORT, such as udp://0.0.0.0:{PORT}.") from error
    unknown = [*({*options} - {"from", "model", "calibration"}), *([parts.path] if parts.path else [])]
    if unknown:
        raise InputError(
            f"{source}: {', '.join(unknown)} is not known; after a ? come from, model, calibration."
        )
    calibration = options.get("calibration")
    return UdpAddress(
        host=parts.hostname or UdpAddress.host,
        port=port,
        sender=options.get("from"),
        model=options.get("model"),
        calibration=None if calibration is None else pathlib.Path(calibration),
    )


SENSORS: Mapping[str, Callable[[str], Source]] = {
    "ouster": lambda source: OusterSource(source.partition("://")[2].strip("/")),
    "ros2": lambda source: Ros2Source("/" + source.partition("://")[2].lstrip("/")),
    "udp": lambda source: VelodyneSource(parse_udp(source)),
}
"""What opens an address, by what stands before ``://``."""
