"""MCAP recordings: ``sensor_msgs/PointCloud2`` of ROS 2 (CDR) or ROS 1, and Foxglove's own point clouds.

A file, or a folder of ROS 2 whose storage is MCAP. `jaxbox.io.mcap_file` finds the messages; those of ROS are
decoded as in `jaxbox.io.rosbag`.
"""

import collections
import dataclasses
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

from jaxbox.io.foxglove import POINT_CLOUD, PointCloudDecoder
from jaxbox.io.mcap_file import McapFile, open_mcap_file
from jaxbox.io.pointcloud2 import MESSAGE_TYPES
from jaxbox.io.points import RecordedPoints
from jaxbox.io.recordings import (
    POSE_TYPES,
    Message,
    PoseMessage,
    RecordedSweeps,
    RecordingFormat,
    choose_topic,
)
from jaxbox.io.rosbag import METADATA_NAME, SCAN_TYPES, MessageDecoder, ScanDecoder, decode_message
from jaxbox.io.velodyne import ANY_MODEL, VelodyneSensor, calibrated_sensor

_SUFFIX = ".mcap"
_ROS_ENCODINGS = ("cdr", "ros1")


def open_mcap(path: pathlib.Path, topic: str | None = None) -> RecordedSweeps:
    """Opens the sweeps of an MCAP file, or of a folder of them that is one recording of ROS 2.

    Args:
      path: the file or folder.
      topic: of the points; None where there is only one.

    Returns:
      The sweeps, with the time at which each was recorded.

    Raises:
      InputError: where it is not such a file, or the topic has to be named.
      ImportError: without the extra ``mcap``.
    """
    files, topics = _index(path)
    others = sorted(topics.others - topics.counts.keys())
    chosen = choose_topic(path, topic, topics.counts, others, topics.packets)
    sensor = calibrated_sensor(path) if chosen in topics.packets else ANY_MODEL

    def messages() -> Iterator[Message]:
        for file in files:
            with open_mcap_file(file) as reader:
                for schema, channel, message in reader.iter_messages([chosen]):
                    decoder = _decoder_of(schema, channel, sensor)
                    if decoder is not None:
                        where = f"{file}, {chosen} at {message.log_time}"
                        yield message.log_time, decoder(message.data, where)

    return RecordedSweeps(path, chosen, topics.counts[chosen], messages)


def read_mcap_poses(path: pathlib.Path) -> Iterator[PoseMessage]:
    """Reads odometry and transforms of ROS from an MCAP file, or from a folder of them.

    Args:
      path: as `open_mcap`.

    Yields:
      Those of `POSE_TYPES`, in the order of time.

    Raises:
      InputError: where it is not such a file, or a message is damaged.
      ImportError: without the extra ``mcap``.
    """
    # The order of a folder's files is that of their messages, which a single file need not be read for.
    for file in _index(path)[0] if path.is_dir() else [path]:
        with open_mcap_file(file) as reader:
            for schema, channel, message in reader.iter_messages(_pose_topics(reader)):
                name = None if schema is None else POSE_TYPES.get(schema.name)
                if name is not None and channel.message_encoding in _ROS_ENCODINGS:
                    where = f"{file}, {channel.topic} at {message.log_time}"
                    is_ros1 = channel.message_encoding == "ros1"
                    decoded = decode_message(message.data, name, where, is_ros1=is_ros1)
                    yield channel.topic, message.log_time, decoded


def _pose_topics(reader: McapFile) -> set[str] | None:
    """Topics with odometry or transforms, by the index; None where the file has none."""
    summary = reader.summary
    if summary is None or not summary.channels:
        return None
    names = {key: schema.name for key, schema in summary.schemas.items()}
    return {c.topic for c in summary.channels.values() if names.get(c.schema_id) in POSE_TYPES}


@dataclasses.dataclass(frozen=True)
class _Topics:
    """What a recording has, by topic."""

    counts: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)
    """Messages of points, or of a sensor's packets."""
    packets: set[str] = dataclasses.field(default_factory=set)
    """Those of packets."""
    others: set[str] = dataclasses.field(default_factory=set)
    """Topics with messages of other kinds."""

    def add(self, schema: Any, channel: Any, number: int) -> None:
        if _decoder_of(schema, channel) is None:
            self.others.add(channel.topic)
            return
        self.counts[channel.topic] += number
        if schema.name in SCAN_TYPES:
            self.packets.add(channel.topic)


def _index(path: pathlib.Path) -> tuple[list[pathlib.Path], _Topics]:
    """The files of a recording in the order of time, and its topics."""
    topics = _Topics()
    starts = {}
    for file in sorted(_storage_files(path)) if path.is_dir() else [path]:
        with open_mcap_file(file) as reader:
            starts[file] = _count_messages(reader, topics)
    # The names of a long recording's files are numbered, 10 before 2.
    return sorted(starts, key=lambda file: starts[file]), topics


def _storage_files(folder: pathlib.Path) -> list[pathlib.Path]:
    return [file for file in folder.iterdir() if file.suffix.lower() == _SUFFIX and file.is_file()]


def is_mcap_folder(path: pathlib.Path) -> bool:
    """Whether a folder is a recording of ROS 2 whose storage is MCAP."""
    return (path / METADATA_NAME).is_file() and bool(_storage_files(path))


def _count_messages(reader: McapFile, topics: _Topics) -> int:
    """Adds messages by topic, by the index or else one pass; answers the first time."""
    summary = reader.summary
    if summary is None or summary.statistics is None:
        start = 0
        for schema, channel, message in reader.iter_messages():
            start = min(start or message.log_time, message.log_time)
            topics.add(schema, channel, 1)
        return start
    for channel in summary.channels.values():
        number = summary.statistics.channel_message_counts.get(channel.id, 0)
        topics.add(summary.schemas.get(channel.schema_id), channel, number)
    return summary.statistics.message_start_time


def _decoder_of(
    schema: Any, channel: Any, sensor: VelodyneSensor = ANY_MODEL
) -> Callable[[bytes, str], RecordedPoints] | None:
    """What decodes the messages of a channel; None where they hold something else than points."""
    name = None if schema is None else schema.name
    is_ros1 = channel.message_encoding == "ros1"
    if channel.message_encoding in _ROS_ENCODINGS:
        if name in MESSAGE_TYPES:
            return lambda data, where: MessageDecoder(data, where, is_ros1)
        if name in SCAN_TYPES:
            return lambda data, where: ScanDecoder(data, where, is_ros1, sensor)
    if name == POINT_CLOUD and channel.message_encoding == "protobuf":
        return PointCloudDecoder
    return None


MCAP = RecordingFormat(
    name="MCAP",
    suffixes=(_SUFFIX,),
    open=open_mcap,
    read_poses=read_mcap_poses,
    is_folder=is_mcap_folder,
)
