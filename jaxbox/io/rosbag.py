"""Recordings of ROS 1 (``.bag``) and ROS 2 (a folder with ``metadata.yaml``, or ``.db3``), without ROS.

`rosbags` reads the messages; their definition is the library's own, as PointCloud2 is the same in every
distribution, and many bags hold none.
"""

import contextlib
import pathlib
from collections.abc import Iterator
from typing import Any

from jaxbox.io._extras import require
from jaxbox.io._files import InputError
from jaxbox.io.pointcloud2 import MESSAGE_TYPES, decode_pointcloud2
from jaxbox.io.points import Points
from jaxbox.io.recordings import Message, RecordedSweeps, RecordingFormat, choose_topic

_TYPE = MESSAGE_TYPES[0]


def open_rosbag(path: pathlib.Path, topic: str | None = None) -> RecordedSweeps:
    """Opens the sweeps of a bag.

    Args:
      path: a ``.bag`` or ``.db3`` file, or a folder with ``metadata.yaml``.
      topic: of the points; None where there is only one.

    Returns:
      The sweeps, with the time at which each was recorded.

    Raises:
      InputError: where it is no bag, or the topic has to be named.
      ImportError: without the extra ``ros``.
    """
    with _reader(path) as reader:
        counts = {name: info.msgcount for name, info in reader.topics.items() if info.msgtype == _TYPE}
        chosen = choose_topic(path, topic, counts, [name for name in reader.topics if name not in counts])

    def messages() -> Iterator[Message]:
        with _reader(path) as reader:
            connections = [c for c in reader.connections if c.topic == chosen and c.msgtype == _TYPE]
            for _, timestamp_ns, data in reader.messages(connections):
                yield (
                    timestamp_ns,
                    MessageDecoder(data, f"{path}, {chosen} at {timestamp_ns}", _is_ros1(path)),
                )

    return RecordedSweeps(path, chosen, counts[chosen], messages)


def _is_ros1(path: pathlib.Path) -> bool:
    return path.suffix.lower() == ".bag"


@contextlib.contextmanager
def _reader(path: pathlib.Path) -> Iterator[Any]:
    """The bag, with whatever `rosbags` and its decoders raise on broken bytes as one kind of error."""
    module = require("rosbags.rosbag1" if _is_ros1(path) else "rosbags.rosbag2", extra="ros", what="ROS bags")
    try:
        with module.Reader(path) as reader:
            yield reader
    except (InputError, ImportError):
        raise
    except Exception as error:
        raise InputError(
            f"{path}: the bag cannot be read ({error}). Copy it again; `rosbag reindex` or "
            "`ros2 bag reindex` mends a recording that was cut short."
        ) from error


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
        typesys = require("rosbags.typesys", extra="ros", what="ROS messages")
        stores = typesys.Stores
        store = typesys.get_typestore(stores.ROS1_NOETIC if self._is_ros1 else stores.ROS2_HUMBLE)
        deserialize = store.deserialize_ros1 if self._is_ros1 else store.deserialize_cdr
        try:
            message = deserialize(self._data, _TYPE)
        # The library's own errors, or what generated code meets in too few bytes.
        except Exception as error:
            raise InputError(
                f"{self._where}: the message cannot be read ({error}); it is damaged."
            ) from error
        return decode_pointcloud2(message, self._where)


def is_rosbag2(path: pathlib.Path) -> bool:
    """Whether a folder is a recording of ROS 2."""
    return (path / "metadata.yaml").is_file()


ROSBAG = RecordingFormat(
    name="ROS 1 and ROS 2 bags", suffixes=(".bag", ".db3"), open=open_rosbag, is_folder=is_rosbag2
)
