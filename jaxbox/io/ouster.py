"""Recordings of Ouster sensors: captures (``.pcap``) with their metadata beside them, and ``.osf``.

`ouster-sdk` reads both. Points are in the sensor's own frame: x away from the connector, z up.
"""

import contextlib
import functools
import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxbox._extras import require
from jaxbox._files import InputError, check_file, read_text, reason
from jaxbox.io.points import Points, TimedPoints
from jaxbox.io.recordings import Message, RecordedSweeps, RecordingFormat, choose_topic

_METADATA_KEY = "beam_altitude_angles"
"""What the metadata of all firmware have, and no other file."""
_INTENSITIES = ("REFLECTIVITY", "SIGNAL")
_NS = 1e-9
_WHAT = "Ouster's recordings, which want an environment of their own (docs/install.md),"


def ouster_metadata(path: pathlib.Path) -> pathlib.Path | None:
    """The metadata of an Ouster sensor that belongs to a capture.

    Args:
      path: the capture.

    Returns:
      The ``.json`` beside it whose name is the capture's, or as much of its beginning as possible, as of
      ``drive-000.pcap`` and ``drive.json``; None where there is none.
    """
    named = [file for file in path.parent.glob("*.json") if path.stem.startswith(file.stem)]
    found = [file for file in named if file.is_file() and _METADATA_KEY in read_text(file)]
    return max(found, key=lambda file: len(file.stem), default=None)


def open_ouster(
    path: pathlib.Path, topic: str | None = None, *, metadata: pathlib.Path | None = None
) -> RecordedSweeps:
    """Opens the sweeps of an Ouster sensor.

    Args:
      path: a capture, or an ``.osf`` file.
      topic: serial number of the sensor; None where there is only one.
      metadata: of a capture's sensor.

    Returns:
      The sweeps, each with the time of its last packet.

    Raises:
      InputError: where it cannot be read, or the sensor has to be named.
      ImportError: without the extra ``ouster``.
    """
    options = {} if metadata is None else {"meta": [str(metadata)]}
    with _source(path, index=True, **options) as source:
        names = [str(info.sn) for info in source.sensor_info]
        counts = dict(zip(names, source.frames_num, strict=True))
    if not any(counts.values()):
        raise InputError(f"{path}: no sweep of the sensor {', '.join(names)}; is it the right metadata?")
    chosen = choose_topic(path, topic, counts, [])

    def messages() -> Iterator[Message]:
        with _source(path, sensor_idx=names.index(chosen), **options) as source:
            (info,) = source.sensor_info
            text = info.to_json_string()
            for frame in (frame for frames in source for frame in frames if frame is not None):
                points = OusterPoints(text, frame)
                yield points.header()[0], points

    return RecordedSweeps(path, chosen, counts[chosen], messages)


@contextlib.contextmanager
def _source(path: pathlib.Path, **options: Any) -> Iterator[Any]:
    """The recording, with whatever the library raises on broken bytes as one kind of error."""
    library = require("ouster.sdk", extra="ouster", what=_WHAT)
    check_file(path, max_bytes=None)
    try:
        with contextlib.closing(library.open_source(str(path), collate=False, **options)) as source:
            yield source
    except (InputError, ImportError):
        raise
    # Its errors are RuntimeError, ValueError and some of its own.
    except Exception as error:
        told = str(error).replace("\n", ": ")
        raise InputError(
            f"{path}: the Ouster recording cannot be read ({reason(ValueError(told))}). Copy it again, with "
            "its metadata."
        ) from error


class OusterPoints:
    """The ranges of one sweep, which become points when it is called."""

    def __init__(self, metadata: str, frame: Any) -> None:
        """Keeps what is needed of a frame of the library.

        Args:
          metadata: of the sensor, JSON.
          frame: its ranges (H, W) in mm, a row a beam.
        """
        self._metadata = metadata
        self._range_mm = np.array(frame.field("RANGE"))
        name = next((name for name in _INTENSITIES if name in frame.fields), None)
        strength = np.zeros(self._range_mm.shape) if name is None else frame.field(name)
        self._intensity = np.array(strength, np.float32)
        self._column_ns = np.array(frame.timestamp)
        # The sensor's own clock may count from when it was switched on.
        self._time_ns = int(max(frame.packet_timestamp.max(initial=0), 0)) or int(self._column_ns.max())

    def __call__(self) -> Points:
        """Computes the points.

        Raises:
          ImportError: without the extra ``ouster``.
        """
        points = self.timed()
        return points.xyz, points.intensity

    def timed(self) -> TimedPoints:
        """Computes the points, and when each was measured, from the last; raises as a call."""
        seen = self._range_mm > 0
        xyz = _ray_table(self._metadata)(self._range_mm)[seen].astype(np.float32)
        since_last = self._column_ns.astype(np.int64) - int(self._column_ns.max())
        time_s = np.broadcast_to(since_last * _NS, seen.shape)[seen]
        return TimedPoints(xyz, self._intensity[seen], time_s)

    def header(self) -> tuple[int, str]:
        """The time of the last packet, ns since 1970, and no name of a frame."""
        return self._time_ns, ""


@functools.lru_cache(maxsize=4)
def _ray_table(metadata: str) -> Any:
    core = require("ouster.sdk.core", extra="ouster", what=_WHAT)
    return core.XYZLut(core.SensorInfo(metadata), use_extrinsics=False)


OSF = RecordingFormat(name="Ouster OSF", suffixes=(".osf",), open=open_ouster)
