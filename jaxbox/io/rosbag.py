"""Recordings of ROS 1 (``.bag``) and ROS 2 (a folder with ``metadata.yaml``, or ``.db3``), without ROS.

`rosbags` reads the messages; their definition is the library's own, as PointCloud2 is the same in every
distribution, and many bags hold none.
"""

import contextlib
import functools
import pathlib
import re
import sqlite3
import urllib.parse
from collections.abc import Iterator
from typing import Any

from jaxbox._extras import require
from jaxbox._files import InputError, check_file, reason
from jaxbox.io._unpack import open_zstd, unpack
from jaxbox.io.pointcloud2 import MESSAGE_TYPES, decode_pointcloud2, decode_timed_pointcloud2, stamp_ns
from jaxbox.io.points import Points, TimedPoints
from jaxbox.io.recordings import (
    POSE_TYPES,
    TF_MESSAGE,
    Message,
    PoseMessage,
    RecordedSweeps,
    RecordingFormat,
    choose_topic,
)
from jaxbox.io.velodyne import PACKET_BYTES, VelodynePoints, VelodyneSensor, calibrated_sensor

METADATA_NAME = "metadata.yaml"
"""What a folder of ROS 2 holds besides its storage."""

SCAN_TYPES = ("velodyne_msgs/msg/VelodyneScan", "velodyne_msgs/VelodyneScan")
"""The packets of a turn, by the names of ROS 2 and ROS 1."""

_TYPE, _SCAN = MESSAGE_TYPES[0], SCAN_TYPES[0]
_SCAN_DEFINITIONS = {
    "velodyne_msgs/msg/VelodynePacket": f"builtin_interfaces/Time stamp\nuint8[{PACKET_BYTES}] data",
    _SCAN: "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets",
}
_DATABASE = ".db3"
_MAX_METADATA_BYTES = 2**24
_PACKED_MESSAGES = "message"
_MAX_PACKED_RATIO = 100
_PIECE_BYTES = 2**20


def open_rosbag(path: pathlib.Path, topic: str | None = None) -> RecordedSweeps:
    """Opens the sweeps of a bag.

    Args:
      path: a ``.bag`` or ``.db3`` file, or a folder with ``metadata.yaml``.
      topic: of the points; None where there is only one.

    Returns:
      The sweeps, with the time at which each was recorded.

    Raises:
      InputError: where it is not a bag, or the topic has to be named.
      ImportError: without the extra ``ros``.
    """
    with _reader(path) as reader:
        topics = reader.topics.items()
        counts = {name: info.msgcount for name, info in topics if info.msgtype in (_TYPE, _SCAN)}
        scans = {name for name, info in topics if info.msgtype == _SCAN}
        others = [name for name in reader.topics if name not in counts]
        chosen = choose_topic(path, topic, counts, others, scans)
    sensor = calibrated_sensor(path) if chosen in scans else None

    def messages() -> Iterator[Message]:
        with _reader(path) as reader:
            kind = _TYPE if sensor is None else _SCAN
            connections = [c for c in reader.connections if c.topic == chosen and c.msgtype == kind]
            for _, timestamp_ns, data, where in _messages(reader, connections, path):
                is_ros1 = _is_ros1(path)
                if sensor is None:
                    yield timestamp_ns, MessageDecoder(data, where, is_ros1)
                else:
                    yield timestamp_ns, ScanDecoder(data, where, is_ros1, sensor)

    return RecordedSweeps(path, chosen, counts[chosen], messages)


def read_rosbag_poses(path: pathlib.Path) -> Iterator[PoseMessage]:
    """Reads odometry and transforms of a bag.

    Args:
      path: as `open_rosbag`.

    Yields:
      Those of `POSE_TYPES`, in the order of time.

    Raises:
      InputError: where it is not a bag, or a message is damaged.
      ImportError: without the extra ``ros``.
    """
    with _reader(path) as reader:
        connections = [c for c in reader.connections if c.msgtype in POSE_TYPES]
        for connection, timestamp_ns, data, where in _messages(reader, connections, path):
            name = POSE_TYPES[connection.msgtype]
            message = decode_message(data, name, where, is_ros1=_is_ros1(path))
            yield connection.topic, timestamp_ns, message


def _is_ros1(path: pathlib.Path) -> bool:
    return path.suffix.lower() == ".bag"


@contextlib.contextmanager
def _reader(path: pathlib.Path) -> Iterator[Any]:
    """The bag, with whatever `rosbags` and its decoders raise on broken bytes as one kind of error."""
    module = require("rosbags.rosbag1" if _is_ros1(path) else "rosbags.rosbag2", extra="ros", what="ROS bags")
    _check_files(path)
    try:
        _check_packed_files(path)
        _check_schemas(path)
        with module.Reader(path) as reader:
            if _is_ros1(path):
                _bound_chunks(reader, str(path))
            yield reader
    except (InputError, ImportError):
        raise
    except Exception as error:
        raise InputError(
            f"{path}: the bag cannot be read ({reason(error)}). Copy it again; `rosbag reindex` or "
            "`ros2 bag reindex` fixes a recording that was cut short."
        ) from error


def _check_files(path: pathlib.Path) -> None:
    """Refuses pipes and devices; of a folder, whatever its metadata may name."""
    for file in [file for file in path.iterdir() if not file.is_dir()] if path.is_dir() else [path]:
        check_file(file, max_bytes=_MAX_METADATA_BYTES if file.name == METADATA_NAME else None)


def _check_schemas(path: pathlib.Path) -> None:
    """Refuses databases of ROS 2 with views or virtual tables: those may be queries without end."""
    for file in path.glob(f"*{_DATABASE}") if path.is_dir() else [path] * (path.suffix == _DATABASE):
        uri = f"file:{urllib.parse.quote(str(file))}?immutable=1"
        with contextlib.closing(sqlite3.connect(uri, uri=True)) as database:
            rows = database.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
        for name, text in rows:
            if not re.match(r"CREATE\s+(TABLE|(UNIQUE\s+)?INDEX)\s", str(text), re.IGNORECASE):
                raise InputError(
                    f"{file}: {name!r} is not a plain table; export the recording with ros2 bag."
                )


def _bound_chunks(reader: Any, where: str) -> None:
    """Lets chunks of ROS 1 be unpacked with a bound in place of the library's own functions."""
    known = require("rosbags.rosbag1.reader", extra="ros", what="ROS bags").decompressors
    names = {function: name for name, function in known.items()}
    for position, chunk in reader.chunks.items():
        bounded = functools.partial(unpack, compression=names[chunk.decompressor], where=where)
        reader.chunks[position] = chunk._replace(decompressor=bounded)


def _messages(reader: Any, connections: Any, path: pathlib.Path) -> Iterator[tuple[Any, int, bytes, str]]:
    """Connection, time and bytes of a bag's messages, and where each is, for errors.

    Packed messages of ROS 2 are unpacked here: the library would do so without a bound.
    """
    is_packed = getattr(reader, "compression_mode", None) == _PACKED_MESSAGES
    if is_packed:
        reader.storage.metadata = reader.storage.metadata._replace(compression_mode=None)
    # The library takes an empty list for all connections.
    for connection, timestamp_ns, data in reader.messages(connections) if connections else ():
        where = f"{path}, {connection.topic} at {timestamp_ns}"
        yield connection, timestamp_ns, unpack(data, "zstd", where) if is_packed else data, where


def _check_packed_files(path: pathlib.Path) -> None:
    """Refuses a ROS 2 folder whose packed files would fill the disk, where the library unpacks them."""
    for file in path.glob("*.zstd") if path.is_dir() else ():
        size, bound = 0, _MAX_PACKED_RATIO * file.stat().st_size
        with file.open("rb") as handle, open_zstd(handle) as packed:
            while piece := packed.read(_PIECE_BYTES):
                size += len(piece)
                if size > bound:
                    raise InputError(
                        f"{file}: it unpacks to more than {_MAX_PACKED_RATIO} times its size. "
                        "The file is damaged, or made to fill the disk."
                    )


class MessageDecoder:
    """A serialised PointCloud2, decoded when it is called."""

    def __init__(self, data: bytes, where: str, is_ros1: bool) -> None:
        self._data, self._where, self._is_ros1 = data, where, is_ros1

    def __call__(self) -> Points:
        """Decodes the points.

        Raises:
          InputError: naming recording, topic and time.
          ImportError: without the extra ``ros``.
        """
        return decode_pointcloud2(self._message(), self._where)

    def timed(self) -> TimedPoints:
        """Decodes the points, and when each was measured; raises as a call."""
        return decode_timed_pointcloud2(self._message(), self._where)

    def header(self) -> tuple[int, str]:
        """The header's time, ns since 1970 or 0, and the name of the points' frame; raises as a call."""
        header = self._message().header
        return stamp_ns(header.stamp), header.frame_id

    def _message(self) -> Any:
        return decode_message(self._data, _TYPE, self._where, is_ros1=self._is_ros1)


class ScanDecoder:
    """A serialised VelodyneScan, decoded when it is called."""

    def __init__(self, data: bytes, where: str, is_ros1: bool, sensor: VelodyneSensor) -> None:
        self._data, self._where, self._is_ros1, self._sensor = data, where, is_ros1, sensor

    def __call__(self) -> Points:
        """Decodes the points.

        Raises:
          InputError: naming recording, topic and time.
          ImportError: without the extra ``ros`` or ``velodyne``.
        """
        return self._points()()

    def timed(self) -> TimedPoints:
        """Decodes the points, and when each was measured; raises as a call."""
        return self._points().timed()

    def header(self) -> tuple[int, str]:
        """The header's time, ns since 1970 or 0, and the name of the points' frame; raises as a call."""
        return self._points().header()

    def _points(self) -> VelodynePoints:
        message = decode_message(self._data, _SCAN, self._where, is_ros1=self._is_ros1)
        packets = [(stamp_ns(packet.stamp), packet.data.tobytes()) for packet in message.packets]
        header = (stamp_ns(message.header.stamp), message.header.frame_id)
        return VelodynePoints(packets, self._sensor, self._where, header)


def decode_message(data: bytes, name: str, where: str, *, is_ros1: bool) -> Any:
    """Decodes a message by the library's own definition.

    Args:
      data: serialised.
      name: of its type in ROS 2, as ``sensor_msgs/msg/PointCloud2``.
      where: recording, topic and time, for the error.
      is_ros1: whether it is serialised as in ROS 1, or in CDR as in ROS 2.

    Returns:
      The message as the library has it.

    Raises:
      InputError: where it is damaged.
      ImportError: without the extra ``ros``.
    """
    store = _typestore(is_ros1)
    deserialize = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    try:
        return deserialize(data, name)
    # The library's own errors, or what generated code meets in too few bytes.
    except Exception as error:
        raise InputError(f"{where}: the message cannot be read ({reason(error)}); it is damaged.") from error


@functools.cache
def _typestore(is_ros1: bool) -> Any:
    """The definitions of all messages, which take longer to gather than a message to decode."""
    typesys = require("rosbags.typesys", extra="ros", what="ROS messages")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if is_ros1 else typesys.Stores.ROS2_HUMBLE)
    if TF_MESSAGE not in store.types:
        # tf2_msgs is not among the library's definitions of ROS 1.
        store.register(typesys.get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_MESSAGE))
    for name, definition in _SCAN_DEFINITIONS.items():
        store.register(typesys.get_types_from_msg(definition, name))
    return store


def is_rosbag2(path: pathlib.Path) -> bool:
    """Whether a folder is a recording of ROS 2."""
    return (path / METADATA_NAME).is_file()


ROSBAG = RecordingFormat(
    name="ROS 1 and ROS 2 bags",
    suffixes=(".bag", _DATABASE),
    open=open_rosbag,
    read_poses=read_rosbag_poses,
    is_folder=is_rosbag2,
)
