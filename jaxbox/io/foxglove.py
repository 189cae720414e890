"""Foxglove's messages, which its viewer and others draw: scenes of boxes, and point clouds, in protobuf.

Reference: the schemas ``foxglove.SceneUpdate`` and ``foxglove.PointCloud``, docs.foxglove.dev.
"""

import colorsys
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxbox._extras import require
from jaxbox._files import InputError, reason
from jaxbox.io.point_times import timed_points
from jaxbox.io.points import Points, TimedPoints, check_num_points, named_points, record_dtype
from jaxbox.types import Label

GOLDEN_TURN = 0.61803398875
"""Hues that advance by this share of the circle never come close."""

POINT_CLOUD = "foxglove.PointCloud"
"""Name of the schema of points."""

_CHOSEN_COLORS = {
    Label.CAR: (1.0, 0.85, 0.1),
    Label.VAN: (1.0, 0.5, 0.1),
    Label.TRUCK: (1.0, 0.25, 0.35),
}
COLORS: Mapping[str, tuple[float, float, float]] = {
    label.word: _CHOSEN_COLORS.get(label, colorsys.hsv_to_rgb(label * GOLDEN_TURN % 1, 0.8, 1))
    for label in Label
}
"""Red, green, blue of each class, 0 to 1."""

_ALPHA = 0.35
_TEXT_SIZE_M = 0.6
_TEXT_GAP_M = 0.5
_NS_PER_S = 10**9
_DTYPES = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
_FLOAT32 = 7


def scene_update(record: Mapping[str, Any], *, timestamp_ns: int, frame_id: str) -> Any:
    """A sweep's boxes as one ``foxglove.SceneUpdate``, which takes the place of the sweep's before it.

    Args:
      record: as `jaxbox.io.detections_record` makes it.
      timestamp_ns: ns since 1970.
      frame_id: of the coordinate frame that the boxes are in.

    Returns:
      The protobuf message: one entity, a cube and a caption a box.

    Raises:
      ImportError: without the extra ``mcap``.
    """
    schema = _schema("SceneUpdate")
    update = schema.SceneUpdate()
    entity = update.entities.add(id="jaxbox", frame_id=frame_id)
    _set_time(entity.timestamp, timestamp_ns)
    entity.metadata.add(key="sweep", value=str(record["name"]))
    for box in record["boxes"]:
        red, green, blue = COLORS.get(box["label"], (1.0, 1.0, 1.0))
        cube = entity.cubes.add()
        _set_xyz(cube.pose.position, box["center"])
        cube.pose.orientation.z = math.sin(box["yaw"] / 2)
        cube.pose.orientation.w = math.cos(box["yaw"] / 2)
        _set_xyz(cube.size, box["size"])
        _set_color(cube.color, red, green, blue, _ALPHA)
        text = entity.texts.add(text=f"{box['label']} {box['score']:.2f}", billboard=True)
        text.font_size = _TEXT_SIZE_M
        x, y, z = box["center"]
        _set_xyz(text.pose.position, (x, y, z + box["size"][2] / 2 + _TEXT_GAP_M))
        text.pose.orientation.w = 1.0
        _set_color(text.color, red, green, blue, 1.0)
    return update


def point_cloud(xyz: np.ndarray, intensity: np.ndarray, *, timestamp_ns: int, frame_id: str) -> Any:
    """A sweep's points as one ``foxglove.PointCloud``.

    Args:
      xyz: (n, 3) real, m.
      intensity: (n,) real.
      timestamp_ns: ns since 1970.
      frame_id: of their coordinate frame.

    Returns:
      The protobuf message, four float32 a point.

    Raises:
      ImportError: without the extra ``mcap``.
    """
    cloud = _schema("PointCloud").PointCloud(frame_id=frame_id, point_stride=16)
    _set_time(cloud.timestamp, timestamp_ns)
    cloud.pose.orientation.w = 1.0
    for index, name in enumerate(("x", "y", "z", "intensity")):
        cloud.fields.add(name=name, offset=4 * index, type=_FLOAT32)
    cloud.data = np.column_stack([xyz, intensity]).astype("<f4").tobytes()
    return cloud


def decode_point_cloud(data: bytes, where: str) -> Points:
    """Reads a ``foxglove.PointCloud``, in the frame that it is given in.

    Args:
      data: the protobuf message.
      where: recording, topic and time, for the error.

    Returns:
      As `jaxbox.io.read_points`.

    Raises:
      InputError: where the message is damaged, or has no x, y, z.
      ImportError: without the extra ``mcap``.
    """
    return named_points(_columns(_parsed(data, where), where), where)


class PointCloudDecoder:
    """A serialised ``foxglove.PointCloud``, decoded when it is called."""

    def __init__(self, data: bytes, where: str) -> None:
        self._data, self._where = data, where

    def __call__(self) -> Points:
        """Decodes the points; raises as `decode_point_cloud`."""
        return decode_point_cloud(self._data, self._where)

    def timed(self) -> TimedPoints:
        """Decodes the points, and when each was measured; raises also where the times' unit is not clear."""
        cloud = _parsed(self._data, self._where)
        return timed_points(_columns(cloud, self._where), self._where, sweep_ns=_time_ns(cloud) or None)

    def header(self) -> tuple[int, str]:
        """The message's time, ns since 1970 or 0, and the name of the points' frame."""
        cloud = _parsed(self._data, self._where)
        return _time_ns(cloud), cloud.frame_id


def _time_ns(cloud: Any) -> int:
    return cloud.timestamp.seconds * _NS_PER_S + cloud.timestamp.nanos


def _parsed(data: bytes, where: str) -> Any:
    cloud = _schema("PointCloud").PointCloud()
    try:
        cloud.ParseFromString(data)
    except Exception as error:  # protobuf's own error, whose module differs between its versions
        raise InputError(f"{where}: the message cannot be read ({reason(error)}); it is damaged.") from error
    return cloud


def _columns(cloud: Any, where: str) -> dict[str, np.ndarray]:
    fields = {field.name: (_DTYPES.get(field.type, ""), field.offset) for field in cloud.fields}
    fields = {name: (kind, offset) for name, (kind, offset) in fields.items() if kind}
    ends = [offset + np.dtype(kind).itemsize for kind, offset in fields.values()]
    if max(ends, default=0) > cloud.point_stride or cloud.point_stride == 0:
        raise InputError(f"{where}: the fields do not fit in points of {cloud.point_stride} bytes.")
    count = len(cloud.data) // cloud.point_stride
    check_num_points(count, where)
    layout = {
        "names": list(fields),
        "formats": [kind for kind, _ in fields.values()],
        "offsets": [offset for _, offset in fields.values()],
        "itemsize": cloud.point_stride,
    }
    points = np.frombuffer(cloud.data, record_dtype(layout, where), count)
    return {name: points[name] for name in fields}


def _schema(name: str) -> Any:
    return require(f"foxglove_schemas_protobuf.{name}_pb2", extra="mcap", what="Foxglove messages")


def _set_time(message: Any, timestamp_ns: int) -> None:
    message.seconds, message.nanos = divmod(timestamp_ns, _NS_PER_S)


def _set_xyz(message: Any, xyz: Any) -> None:
    message.x, message.y, message.z = (float(value) for value in xyz)


def _set_color(message: Any, red: float, green: float, blue: float, alpha: float) -> None:
    message.r, message.g, message.b, message.a = red, green, blue, alpha
