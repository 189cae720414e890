"""MCAP recordings: ``sensor_msgs/PointCloud2`` of ROS 2 (CDR) or ROS 1, and Foxglove's own point clouds.

The `mcap` library finds the messages; those of ROS are decoded as in `jaxbox.io.rosbag`.
"""

import contextlib
import functools
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

from jaxbox.io._extras import require
from jaxbox.io._files import InputError
from jaxbox.io.foxglove import POINT_CLOUD, decode_point_cloud
from jaxbox.io.pointcloud2 import MESSAGE_TYPES
from jaxbox.io.points import Points
from jaxbox.io.recordings import Message, RecordedSweeps, RecordingFormat, choose_topic
from jaxbox.io.rosbag import MessageDecoder

_RECORD_LIMIT_BYTES = 2**30


def open_mcap(path: pathlib.Path, topic: str | None = None) -> RecordedSweeps:
    """Opens the sweeps of an MCAP file.

    Args:
      path: the file.
      topic: of the points; None where there is only one.

    Returns:
      The sweeps, with the time at which each was recorded.

    Raises:
      InputError: where it is no such file, or the topic has to be named.
      ImportError: without the extra ``mcap``.
    """
    with open_mcap_reader(path) as reader:
        counts, others = _count_messages(reader)
    chosen = choose_topic(path, topic, counts, others)

    def messages() -> Iterator[Message]:
        with open_mcap_reader(path) as reader:
            for schema, channel, message in reader.iter_messages(topics=[chosen]):
                decoder = _decoder_of(schema, channel)
                if decoder is not None:
                    where = f"{path}, {chosen} at {message.log_time}"
                    yield message.log_time, decoder(message.data, where)

    return RecordedSweeps(path, chosen, counts[chosen], messages)


@contextlib.contextmanager
def open_mcap_reader(path: pathlib.Path) -> Iterator[Any]:
    """Opens an MCAP file; what library and decompressors raise on broken bytes becomes one kind of error.

    Args:
      path: the file.

    Yields:
      The library's reader.

    Raises:
      InputError: naming the file, where it cannot be read.
      ImportError: without the extra ``mcap``.
    """
    module = require("mcap.reader", extra="mcap", what="MCAP files")
    try:
        with path.open("rb") as file:
            yield module.SeekingReader(file, record_size_limit=_RECORD_LIMIT_BYTES)
    except (InputError, ImportError):
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file; check the path.") from error
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise InputError(
            f"{path}: the MCAP file cannot be read ({reason}). Copy it again; `mcap recover` mends a "
            "recording that was cut short."
        ) from error


def _count_messages(reader: Any) -> tuple[dict[str, int], list[str]]:
    """Messages by topic of points, by the index or else by one pass; and the names of other topics."""
    summary = reader.get_summary()
    if summary is None or summary.statistics is None:
        counts: dict[str, int] = {}
        others = set()
        for schema, channel, _ in reader.iter_messages():
            if _decoder_of(schema, channel) is None:
                others.add(channel.topic)
            else:
                counts[channel.topic] = counts.get(channel.topic, 0) + 1
        return counts, sorted(others - counts.keys())
    counts, others = {}, []
    for channel in summary.channels.values():
        if _decoder_of(summary.schemas.get(channel.schema_id), channel) is None:
            others.append(channel.topic)
        else:
            number = summary.statistics.channel_message_counts.get(channel.id, 0)
            counts[channel.topic] = counts.get(channel.topic, 0) + number
    return counts, others


def _decoder_of(schema: Any, channel: Any) -> Callable[[bytes, str], Callable[[], Points]] | None:
    """What decodes the messages of a channel; None where they are no points."""
    name = None if schema is None else schema.name
    if name in MESSAGE_TYPES and channel.message_encoding in ("cdr", "ros1"):
        is_ros1 = channel.message_encoding == "ros1"
        return lambda data, where: MessageDecoder(data, where, is_ros1)
    if name == POINT_CLOUD and channel.message_encoding == "protobuf":
        return lambda data, where: functools.partial(decode_point_cloud, data, where)
    return None


MCAP = RecordingFormat(name="MCAP", suffixes=(".mcap",), open=open_mcap)
