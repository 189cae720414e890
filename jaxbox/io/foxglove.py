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
from jaxbox.geometry.rigid import quaternion_of
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
_HIDDEN_ALPHA = 0.12
"""Of tracks without a detection in the sweep."""
_LINE_PX = 2.0
_ARROW_M = 0.15
_ARROW_S = 1.0
"""An arrow is as long as the distance covered in this time."""
_TEXT_SIZE_M = 0.6
_TEXT_GAP_M = 0.5
_NS_PER_S = 10**9
_DTYPES = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
_FLOAT32 = 7


def color_of(box: Mapping[str, Any]) -> tuple[float, float, float]:
    """Red, green, blue of a record's box, 0 to 1: of its track where it has one, else of its class.

    >>> color_of({"label": "car"})
    (1.0, 0.85, 0.1)
    """
    if "id" in box:
        return colorsys.hsv_to_rgb(box["id"] * GOLDEN_TURN % 1, 0.7, 1)
    return COLORS.get(box["label"], (1.0, 1.0, 1.0))


def caption_of(box: Mapping[str, Any]) -> str:
    """What stands at a record's box: class and score, or of a track its id, state and speed.

    >>> caption_of({"label": "car", "score": 0.5})
    'car 0.50'
    """
    if "id" in box:
        return f"{box['id']} {box['state']} {box['speed']:.1f} m/s"
    return f"{box['label']} {box['score']:.2f}"


def scene_update(
    record: Mapping[str, Any],
    *,
    timestamp_ns: int,
    frame_id: str,
    trails: Mapping[int, np.ndarray] | None = None,
) -> Any:
    """A sweep's boxes as one ``foxglove.SceneUpdate``, which takes the place of the sweep's before it.

    Args:
      record: as `jaxbox.io.detections_record` or `jaxbox.io.tracks_record` makes it.
      timestamp_ns: ns since 1970.
      frame_id: of the coordinate frame that the boxes are in.
      trails: of tracks: for each id (m, 3) m, where it was lately.

    Returns:
      The protobuf message: one entity with a cube and a caption a box; or an entity a track, whose id is the
      track's, with its trail and, where it moves, an arrow as long as its way in a second.

    Raises:
      ImportError: without the extra ``mcap``.
    """
    schema = _schema("SceneUpdate")
    update = schema.SceneUpdate()

    def add_entity(name: str) -> Any:
        entity = update.entities.add(id=name, frame_id=frame_id)
        _set_time(entity.timestamp, timestamp_ns)
        entity.metadata.add(key="sweep", value=str(record["name"]))
        return entity

    if trails is None:
        entity = add_entity("jaxbox")
        for box in record["boxes"]:
            _add_box(entity, box)
        return update
    # Tracks that have ended are not named again, so all of the sweep before are taken away first.
    deletion = update.deletions.add(type=_schema("SceneEntityDeletion").SceneEntityDeletion.ALL)
    _set_time(deletion.timestamp, timestamp_ns)
    for box in record["boxes"]:
        entity = add_entity(str(box["id"]))
        _add_box(entity, box)
        _add_motion(entity, box, trails.get(box["id"], np.zeros((0, 3))))
    return update


def _add_box(entity: Any, box: Mapping[str, Any]) -> None:
    red, green, blue = color_of(box)
    cube = entity.cubes.add()
    _set_xyz(cube.pose.position, box["center"])
    _set_turn(cube.pose.orientation, box.get("heading", box["yaw"]))
    _set_xyz(cube.size, box["size"])
    _set_color(cube.color, red, green, blue, _ALPHA if box.get("sight", "seen") == "seen" else _HIDDEN_ALPHA)
    text = entity.texts.add(text=caption_of(box), billboard=True)
    text.font_size = _TEXT_SIZE_M
    x, y, z = box["center"]
    _set_xyz(text.pose.position, (x, y, z + box["size"][2] / 2 + _TEXT_GAP_M))
    text.pose.orientation.w = 1.0
    _set_color(text.color, red, green, blue, 1.0)


def _add_motion(entity: Any, box: Mapping[str, Any], trail: np.ndarray) -> None:
    """The trail of a track, and the arrow of its velocity."""
    line = entity.lines.add(type=_schema("LinePrimitive").LinePrimitive.LINE_STRIP, scale_invariant=True)
    line.thickness = _LINE_PX
    line.pose.orientation.w = 1.0
    for place in trail:
        _set_xyz(line.points.add(), place)
    _set_color(line.color, *color_of(box), 1.0)
    if box["state"] == "standing":
        return
    arrow = entity.arrows.add(shaft_length=box["speed"] * _ARROW_S, shaft_diameter=_ARROW_M)
    arrow.head_length, arrow.head_diameter = 4 * _ARROW_M, 3 * _ARROW_M
    _set_xyz(arrow.pose.position, box["center"])
    _set_turn(arrow.pose.orientation, math.atan2(box["velocity"][1], box["velocity"][0]))
    _set_color(arrow.color, *color_of(box), 1.0)


def frame_transform(
    T_parent_child: np.ndarray, *, timestamp_ns: int, parent_frame_id: str, child_frame_id: str
) -> Any:
    """A pose as one ``foxglove.FrameTransform``, so that a viewer can show the boxes in a world that stands.

    Args:
      T_parent_child: (4, 4) float64, m.
      timestamp_ns: ns since 1970.
      parent_frame_id: of the one coordinate frame.
      child_frame_id: of the other.

    Returns:
      The protobuf message.

    Raises:
      ImportError: without the extra ``mcap``.
    """
    message = _schema("FrameTransform").FrameTransform(
        parent_frame_id=parent_frame_id, child_frame_id=child_frame_id
    )
    _set_time(message.timestamp, timestamp_ns)
    _set_xyz(message.translation, T_parent_child[:3, 3])
    turn = message.rotation
    turn.w, turn.x, turn.y, turn.z = quaternion_of(T_parent_child[:3, :3]).tolist()
    return message


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


class PointCloudDecoder:
    """A serialised ``foxglove.PointCloud``, decoded when it is called, in the frame that it is given in."""

    def __init__(self, data: bytes, where: str) -> None:
        """Takes a message as it is.

        Args:
          data: the protobuf message.
          where: recording, topic and time, for the error.
        """
        self._data, self._where = data, where

    def __call__(self) -> Points:
        """Decodes the points.

        Raises:
          InputError: where the message is damaged, or has no x, y, z.
          ImportError: without the extra ``mcap``.
        """
        return named_points(_columns(_parsed(self._data, self._where), self._where), self._where)

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


def _set_turn(orientation: Any, yaw: float) -> None:
    orientation.z, orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)


def _set_color(message: Any, red: float, green: float, blue: float, alpha: float) -> None:
    message.r, message.g, message.b, message.a = red, green, blue, alpha
