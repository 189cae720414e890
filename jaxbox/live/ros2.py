"""ROS 2: clouds of a topic as a source; boxes as ``vision_msgs`` and ``visualization_msgs`` as a sink.

Their modules come with an installation of ROS 2 and not from PyPI, so they are imported where they are used.
"""

import collections
import contextlib
import importlib
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from jaxbox.io import InputError
from jaxbox.io.foxglove import caption_of, color_of
from jaxbox.io.pointcloud2 import decode_timed_pointcloud2, stamp_ns
from jaxbox.io.results import SweepResult
from jaxbox.live.loop import LiveResult
from jaxbox.live.sinks import Sink
from jaxbox.live.sweep import IDLE_S, Fault, LiveSweep, now_ns

DETECTIONS_TOPIC = "/jaxbox/detections"
"""Topic of ``vision_msgs/Detection3DArray``."""
MARKERS_TOPIC = "/jaxbox/markers"
"""Topic of ``visualization_msgs/MarkerArray``, which RViz draws."""
_ALPHA, _HIDDEN_ALPHA = 0.35, 0.12
_TEXT_M, _LINE_M, _GAP_M = 0.6, 0.08, 0.5
_QUEUE = 10
_NS_PER_S = 10**9


def ros_module(name: str) -> Any:
    """Imports a module of ROS 2.

    Args:
      name: dotted.

    Returns:
      The module.

    Raises:
      ImportError: saying where it is from.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise ImportError(
            f"ROS 2 needs {package}, which pip cannot install: source the setup.bash of a ROS 2 installation "
            f"that has it (apt install ros-DISTRO-{package.replace('_', '-')}), and run jaxbox in its Python."
        ) from error


def _node(name: str) -> Any:
    rclpy = ros_module("rclpy")
    if not rclpy.ok():
        # Ctrl-C stays with who called.
        rclpy.init(signal_handler_options=ros_module("rclpy.signals").SignalHandlerOptions.NO)
    return rclpy.create_node(name)


class Ros2Source:
    """The clouds of a ROS 2 topic; a `jaxbox.live.Source`."""

    can_wait, is_open = False, False

    def __init__(self, topic: str) -> None:
        """Subscribes.

        Args:
          topic: of ``sensor_msgs/PointCloud2``.

        Raises:
          ImportError: outside an installation of ROS 2.
        """
        self._topic = topic
        self.name = f"ros2:/{topic}"
        self.hint = f"does `ros2 topic hz {topic}` count messages?"
        self._messages: collections.deque[tuple[Any, int]] = collections.deque(maxlen=1)
        self._node = _node("jaxbox_live")
        self._node.create_subscription(
            ros_module("sensor_msgs.msg").PointCloud2,
            topic,
            lambda message: self._messages.append((message, now_ns())),
            ros_module("rclpy.qos").qos_profile_sensor_data,
        )

    def __iter__(self) -> Iterator[LiveSweep | Fault | None]:
        """A sweep a message."""
        rclpy, number = ros_module("rclpy"), 0
        try:
            while rclpy.ok():
                rclpy.spin_once(self._node, timeout_sec=IDLE_S)
                if not self._messages:
                    yield None
                    continue
                message, arrived_ns = self._messages.popleft()
                yield self._sweep(message, number, arrived_ns)
                number += 1
        finally:
            self._node.destroy_node()

    def _sweep(self, message: Any, number: int, arrived_ns: int) -> LiveSweep | Fault:
        try:
            points = decode_timed_pointcloud2(message, self.name)
        except InputError as error:
            return Fault(str(error))
        return LiveSweep(
            name=f"{number:06d}",
            frame=number,
            timestamp_ns=stamp_ns(message.header.stamp) or arrived_ns,
            arrived_ns=arrived_ns,
            points=points,
            frame_id=message.header.frame_id,
        )


@contextlib.contextmanager
def open_ros2() -> Iterator[Sink]:
    """Publishes results while the context is open, on `DETECTIONS_TOPIC` and `MARKERS_TOPIC`.

    Yields:
      What takes each result.

    Raises:
      ImportError: outside an installation of ROS 2 with ``vision_msgs``.
    """
    vision, visual = ros_module("vision_msgs.msg"), ros_module("visualization_msgs.msg")
    node = _node("jaxbox_boxes")
    detections = node.create_publisher(vision.Detection3DArray, DETECTIONS_TOPIC, _QUEUE)
    markers = node.create_publisher(visual.MarkerArray, MARKERS_TOPIC, _QUEUE)

    def publish(live: LiveResult, result: SweepResult) -> None:
        time_ns, frame_id = live.sweep.timestamp_ns, live.sweep.frame_id
        detections.publish(detection_array(result.record, time_ns=time_ns, frame_id=frame_id))
        markers.publish(marker_array(result, time_ns=time_ns, frame_id=frame_id))

    try:
        yield publish
    finally:
        node.destroy_node()


def detection_array(record: Mapping[str, Any], *, time_ns: int, frame_id: str) -> Any:
    """A sweep's boxes as ``vision_msgs/Detection3DArray``.

    Args:
      record: as `jaxbox.io.detections_record` or `jaxbox.io.tracks_record` makes it.
      time_ns: of the sweep, ns since 1970.
      frame_id: of the frame that the boxes are in.

    Returns:
      The message; ``id`` is that of a track, or empty.
    """
    vision = ros_module("vision_msgs.msg")
    message = vision.Detection3DArray()
    _set_header(message.header, time_ns, frame_id)
    for box in record["boxes"]:
        detection = vision.Detection3D()
        _set_header(detection.header, time_ns, frame_id)
        detection.id = str(box.get("id", ""))
        _set_pose(detection.bbox.center, box["center"], box.get("heading", box["yaw"]))
        _set_xyz(detection.bbox.size, box["size"])
        hypothesis = vision.ObjectHypothesisWithPose()
        hypothesis.hypothesis.class_id = box["label"]
        hypothesis.hypothesis.score = float(box["score"])
        hypothesis.pose.pose = detection.bbox.center
        detection.results.append(hypothesis)
        message.detections.append(detection)
    return message


def marker_array(result: SweepResult, *, time_ns: int, frame_id: str) -> Any:
    """A sweep's boxes, captions and trails as ``visualization_msgs/MarkerArray``.

    Args:
      result: of the sweep.
      time_ns: of the sweep, ns since 1970.
      frame_id: of the frame that the boxes are in.

    Returns:
      The message, which takes the markers of the sweep before away.
    """
    visual = ros_module("visualization_msgs.msg")
    message = visual.MarkerArray()

    def add(kind: int, number: int, color: tuple[float, ...], scale: tuple[float, ...]) -> Any:
        marker = visual.Marker()
        _set_header(marker.header, time_ns, frame_id)
        marker.ns, marker.id, marker.type, marker.action = "jaxbox", number, kind, visual.Marker.ADD
        marker.color.r, marker.color.g, marker.color.b, marker.color.a = color
        _set_xyz(marker.scale, scale)
        marker.pose.orientation.w = 1.0
        message.markers.append(marker)
        return marker

    clear = visual.Marker()
    clear.action = visual.Marker.DELETEALL
    message.markers.append(clear)
    for number, box in enumerate(result.record["boxes"]):
        color = color_of(box)
        alpha = _ALPHA if box.get("sight", "seen") == "seen" else _HIDDEN_ALPHA
        cube = add(visual.Marker.CUBE, 3 * number, (*color, alpha), box["size"])
        _set_pose(cube.pose, box["center"], box.get("heading", box["yaw"]))
        text = add(visual.Marker.TEXT_VIEW_FACING, 3 * number + 1, (*color, 1.0), (0.0, 0.0, _TEXT_M))
        x, y, z = box["center"]
        _set_xyz(text.pose.position, (x, y, z + box["size"][2] / 2 + _GAP_M))
        text.text = caption_of(box)
        trail = (result.trails or {}).get(box.get("id", -1), np.zeros((0, 3)))
        if len(trail) > 1:
            line = add(visual.Marker.LINE_STRIP, 3 * number + 2, (*color, 1.0), (_LINE_M, 0.0, 0.0))
            line.points.extend(_point(place) for place in trail)
    return message


def _point(place: Any) -> Any:
    point = ros_module("geometry_msgs.msg").Point()
    _set_xyz(point, place)
    return point


def _set_header(header: Any, time_ns: int, frame_id: str) -> None:
    header.stamp.sec, header.stamp.nanosec = divmod(time_ns, _NS_PER_S)
    header.frame_id = frame_id


def _set_xyz(message: Any, xyz: Any) -> None:
    message.x, message.y, message.z = (float(value) for value in xyz)


def _set_pose(pose: Any, center: Any, yaw: float) -> None:
    _set_xyz(pose.position, center)
    pose.orientation.z, pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
