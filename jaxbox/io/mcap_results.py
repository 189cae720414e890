"""Detections, or tracks, as an MCAP file that Foxglove plays: boxes, points where wanted, and the records.

Topics: ``/jaxbox/boxes`` (``foxglove.SceneUpdate``), ``/jaxbox/points`` (``foxglove.PointCloud``), both in
the frame ``lidar``, and ``/jaxbox/detections``, the line that JSON Lines would have, as JSON. Of tracks it is
``/jaxbox/tracks``, and ``/jaxbox/pose`` (``foxglove.FrameTransform``) says where the sensor is in ``world``.
"""

import contextlib
import json
import pathlib
from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from jaxbox._extras import require
from jaxbox._files import InputError, atomic_path
from jaxbox.io.foxglove import frame_transform, point_cloud, scene_update
from jaxbox.io.mcap_file import open_mcap_file
from jaxbox.io.results import ResultFile, SweepResult, WriteResult

BOXES_TOPIC = "/jaxbox/boxes"
"""Topic of the boxes."""
POINTS_TOPIC = "/jaxbox/points"
"""Topic of the points."""
RECORDS_TOPIC = "/jaxbox/detections"
"""Topic of the records."""
TRACKS_TOPIC = "/jaxbox/tracks"
"""Topic of the records of tracks."""
POSE_TOPIC = "/jaxbox/pose"
"""Topic of the poses of the sensor, of tracks."""
FRAME_ID = "lidar"
"""Coordinate frame of boxes and points."""
WORLD_ID = "world"
"""Coordinate frame of the poses."""

_TITLES = {RECORDS_TOPIC: "jaxbox.Detections", TRACKS_TOPIC: "jaxbox.Tracks"}


def record_schema(topic: str) -> dict[str, str]:
    """The JSON schema of a topic of records.

    >>> record_schema(RECORDS_TOPIC)
    {'title': 'jaxbox.Detections', 'type': 'object'}
    """
    return {"title": _TITLES[topic], "type": "object"}


@contextlib.contextmanager
def open_mcap_results(path: pathlib.Path, resume: bool = False) -> Iterator[WriteResult]:
    """Opens an MCAP file for the results of a run; see the module for its topics.

    Args:
      path: the file; its folder is made where it is missing.
      resume: whether the messages of an earlier file of that name come first.

    Yields:
      What adds a sweep.

    Raises:
      InputError: where the earlier file cannot be read.
      ImportError: without the extra ``mcap``.
    """
    module = require("mcap.writer", extra="mcap", what="MCAP files")
    schemas = require("mcap_protobuf.schema", extra="mcap", what="MCAP files")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        writer = module.Writer(file)
        writer.start(library="jaxbox")
        channels = _Channels(writer, schemas)
        index = _copy(path, channels) if resume and path.is_file() else 0

        def write(result: SweepResult) -> None:
            nonlocal index
            add_result(channels, result, result.time_ns(index))
            index += 1

        yield write
        writer.finish()


class ResultChannels(Protocol):
    """What takes messages by topic: a file, or a server."""

    def add_message(self, topic: str, message: Any, time_ns: int) -> None:
        """Adds a protobuf message."""
        ...

    def add_record(self, topic: str, record: Any, time_ns: int) -> None:
        """Adds a record as JSON."""
        ...


def add_result(channels: ResultChannels, result: SweepResult, time_ns: int) -> None:
    """Adds the messages of one sweep; see the module for the topics.

    Args:
      channels: what takes them.
      result: of the sweep.
      time_ns: of the sweep, ns since 1970.

    Raises:
      ImportError: without the extra ``mcap``.
    """
    common = {"timestamp_ns": time_ns, "frame_id": FRAME_ID}
    if result.xyz is not None:
        intensity = np.zeros(len(result.xyz)) if result.intensity is None else result.intensity
        channels.add_message(POINTS_TOPIC, point_cloud(result.xyz, intensity, **common), time_ns)
    if result.trails is not None:
        pose = np.array(result.record["T_world_sensor"])
        channels.add_message(POSE_TOPIC, _transform(pose, time_ns), time_ns)
    channels.add_message(BOXES_TOPIC, scene_update(result.record, trails=result.trails, **common), time_ns)
    channels.add_record(RECORDS_TOPIC if result.trails is None else TRACKS_TOPIC, result.record, time_ns)


def _transform(T_world_sensor: np.ndarray, time_ns: int) -> Any:
    return frame_transform(
        T_world_sensor, timestamp_ns=time_ns, parent_frame_id=WORLD_ID, child_frame_id=FRAME_ID
    )


class _Channels:
    """The topics of a file, each opened with its first message."""

    def __init__(self, writer: Any, schemas: Any) -> None:
        self._writer, self._schemas = writer, schemas
        self._ids: dict[str, int] = {}

    def add_message(self, topic: str, message: Any, time_ns: int) -> None:
        """Adds a protobuf message."""
        if topic not in self._ids:
            schema = self._schemas.register_schema(self._writer, type(message))
            self._ids[topic] = self._writer.register_channel(topic, "protobuf", schema)
        self._writer.add_message(self._ids[topic], time_ns, message.SerializeToString(), time_ns)

    def add_record(self, topic: str, record: Any, time_ns: int) -> None:
        """Adds a record as JSON."""
        if topic not in self._ids:
            title = _TITLES[topic]
            schema = json.dumps(record_schema(topic)).encode()
            schema = self._writer.register_schema(title, "jsonschema", schema)
            self._ids[topic] = self._writer.register_channel(topic, "json", schema)
        data = json.dumps(record, allow_nan=False).encode()
        self._writer.add_message(self._ids[topic], time_ns, data, time_ns)

    def add_raw(self, schema: Any, channel: Any, message: Any) -> None:
        """Adds a message of another file as it is."""
        if channel.topic not in self._ids:
            schema_id = self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._ids[channel.topic] = self._writer.register_channel(
                channel.topic, channel.message_encoding, schema_id
            )
        self._writer.add_message(
            self._ids[channel.topic], message.log_time, message.data, message.publish_time
        )


def _copy(path: pathlib.Path, channels: _Channels) -> int:
    """Copies an earlier file; returns how many sweeps it holds."""
    count = 0
    with open_mcap_file(path) as reader:
        for schema, channel, message in reader.iter_messages():
            channels.add_raw(schema, channel, message)
            count += channel.topic == RECORDS_TOPIC
    return count


def finished_mcap(path: pathlib.Path) -> frozenset[str]:
    """Names of the sweeps that a file of `open_mcap_results` holds.

    Args:
      path: the file; where there is none, it holds none.

    Returns:
      The names, also of sweeps without boxes.

    Raises:
      InputError: where it is not such a file.
      ImportError: without the extra ``mcap``.
    """
    if not path.is_file():
        return frozenset()
    with open_mcap_file(path) as reader:
        names = [json.loads(message.data)["name"] for _, _, message in reader.iter_messages([RECORDS_TOPIC])]
    if not names or not all(isinstance(name, str) for name in names):
        raise InputError(f"{path}: no MCAP file of jaxbox, as it has no {RECORDS_TOPIC}; move it away.")
    return frozenset(names)


MCAP_RESULTS = ResultFile(
    name="detections.mcap", open=open_mcap_results, finished=finished_mcap, wants_points=True
)
