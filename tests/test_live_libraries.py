"""What `jaxbox live` asks of libraries that cannot be here: ROS 2 and a sensor of Ouster, by stand-ins."""

import itertools
import sys
import types

import numpy as np
import pytest
from test_live import RECORD, RESULT, live_result

from jaxbox.io import InputError
from jaxbox.live import Fault, LiveSweep, open_source, ouster, ros2


class Message:
    """A ROS message whose fields come into being when they are named, as stand-ins for all their types."""

    def __init__(self, **fields):
        vars(self).update(fields)

    def __getattr__(self, name):
        if name.startswith("_"):
            raise AttributeError(name)
        # Lists in ROS end in s, but for those of numbers.
        value = [] if name in ("detections", "results", "markers", "points") else Message()
        setattr(self, name, value)
        return value


class Marker(Message):
    ADD, DELETEALL = 0, 3
    CUBE, LINE_STRIP, TEXT_VIEW_FACING = 1, 4, 9


class Node:
    """Keeps what was subscribed to and published."""

    def __init__(self):
        self.callbacks, self.published, self.destroyed = {}, {}, False

    def create_subscription(self, _kind, topic, callback, _qos):
        self.callbacks[topic] = callback

    def create_publisher(self, _kind, topic, _depth):
        return types.SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def destroy_node(self):
        self.destroyed = True


def cloud(num_points, *, frame_id="roof", stamp=(5, 25)):
    field = {"datatype": 7, "count": 1}
    return Message(
        header=Message(stamp=Message(sec=stamp[0], nanosec=stamp[1]), frame_id=frame_id),
        height=1,
        width=num_points,
        fields=[Message(name=name, offset=4 * index, **field) for index, name in enumerate("xyz")],
        is_bigendian=False,
        point_step=12,
        row_step=12 * num_points,
        data=np.arange(3 * num_points, dtype="<f4").tobytes(),
    )


@pytest.fixture
def ros(monkeypatch):
    """An installation of ROS 2: its node, and what `spin_once` hands over."""
    found = types.SimpleNamespace(node=Node(), incoming=[])

    def spin_once(node, *, timeout_sec):
        assert timeout_sec > 0
        for message in found.incoming.pop(0) if found.incoming else ():
            node.callbacks["/points"](message)

    modules = {
        "rclpy": {
            "ok": lambda: bool(found.incoming),
            "init": lambda **options: found.__dict__.update(options),
            "create_node": lambda _: found.node,
            "spin_once": spin_once,
        },
        "rclpy.signals": {"SignalHandlerOptions": types.SimpleNamespace(NO="no handlers")},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "sensor_msgs.msg": {"PointCloud2": None},
        "vision_msgs.msg": {
            name: Message for name in ("Detection3DArray", "Detection3D", "ObjectHypothesisWithPose")
        },
        "visualization_msgs.msg": {"MarkerArray": Message, "Marker": Marker},
        "geometry_msgs.msg": {"Point": Message},
    }
    for name, contents in modules.items():
        monkeypatch.setitem(sys.modules, name, types.SimpleNamespace(**contents))
    return found


def test_clouds_of_a_topic_are_sweeps_in_their_own_frame_and_time(ros):
    broken = cloud(4)
    broken.data = b"cut off"
    ros.incoming = []
    source = open_source("ros2://points")
    assert ros.signal_handler_options == "no handlers"
    ros.incoming = [[], [cloud(4)], [cloud(1), cloud(5, stamp=(0, 0))], [broken]]
    none, first, second, fault = source
    assert none is None
    assert (first.num_points, first.timestamp_ns, first.frame_id) == (4, 5_000_000_025, "roof")
    np.testing.assert_array_equal(first.points.xyz[1], [3, 4, 5])
    # Of two that wait, the newest; without a stamp, its time is that of its arrival.
    assert (second.num_points, second.timestamp_ns) == (5, second.arrived_ns)
    assert isinstance(fault, Fault)
    assert "ros2://points" in fault.reason
    assert ros.node.destroyed


def test_boxes_are_published_as_detections_and_markers(ros):
    with ros2.open_ros2() as publish:
        publish(live_result(timestamp_ns=RECORD["timestamp_ns"], frame_id="roof"), RESULT)
    (detections,) = ros.node.published[ros2.DETECTIONS_TOPIC]
    (detection,) = detections.detections
    assert (detections.header.frame_id, detections.header.stamp.nanosec) == ("roof", 500_000_000)
    assert detection.id == "3"
    assert vars(detection.bbox.size) == {"x": 4.0, "y": 2.0, "z": 1.5}
    # A turn about z by the heading.
    assert detection.bbox.center.orientation.z == pytest.approx(np.sin(0.25))
    assert detection.results[0].hypothesis.class_id == "car"
    (markers,) = ros.node.published[ros2.MARKERS_TOPIC]
    clear, cube, text, line = markers.markers
    assert clear.action == Marker.DELETEALL
    assert [cube.type, text.type, line.type] == [1, 9, 4]
    assert len({cube.id, text.id, line.id}) == 3
    assert text.text == "3 moving 5.0 m/s"
    assert [(point.x, point.y) for point in line.points] == [(0, 2), (1, 2)]
    assert ros.node.destroyed


def test_boxes_without_tracks_have_no_id_and_no_trail(ros):
    box = {name: value for name, value in RECORD["boxes"][0].items() if name not in ("id", "sight")}
    record = {**RECORD, "boxes": [box]}
    message = ros2.detection_array(record, time_ns=0, frame_id="a")
    assert message.detections[0].id == ""
    result = types.SimpleNamespace(record=record, trails=None)
    assert len(ros2.marker_array(result, time_ns=0, frame_id="a").markers) == 3


def test_without_ros_the_error_says_where_it_is_from(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(ImportError, match=r"rclpy, which pip cannot install: source the setup\.bash"):
        open_source("ros2://points")


# Ouster.


class ClientTimeout(Exception):
    """As the library's, it is no TimeoutError."""


class Frame:
    """Two beams of three columns, the first of which was not measured."""

    fields = ("RANGE", "REFLECTIVITY")
    timestamp = np.array([0, 2_000_000_000, 2_050_000_000], np.uint64)
    packet_timestamp = np.array([7_000_000_000, 7_050_000_000], np.uint64)

    def field(self, name):
        return np.array([[0, 5, 0], [0, 6, 7]]) * (1000 if name == "RANGE" else 1)


@pytest.fixture
def sensors(monkeypatch):
    """The library, with a sensor that hands over what is in a list."""
    found = types.SimpleNamespace(frames=[], closed=False, hosts=[])

    class SensorFrameSetSource:
        sensor_info = (types.SimpleNamespace(to_json_string=lambda: "{}"),)

        def __init__(self, host):
            if host == "nobody":
                raise RuntimeError("CurlClient: could not connect")
            found.hosts.append(host)

        def get_frame(self, timeout):
            item = found.frames.pop(0)
            if isinstance(item, Exception):
                raise item
            return 0, item

        def close(self):
            found.closed = True

    core = types.SimpleNamespace(
        SensorInfo=lambda text: text, XYZLut=lambda info, use_extrinsics: lambda ranges: np.ones((2, 3, 3))
    )
    sensor = types.SimpleNamespace(SensorFrameSetSource=SensorFrameSetSource, ClientTimeout=ClientTimeout)
    for name, module in {"ouster.sdk.sensor": sensor, "ouster.sdk.core": core}.items():
        monkeypatch.setitem(sys.modules, name, module)
    return found


def test_a_frame_is_a_sweep_of_what_its_beams_saw(sensors):
    source = open_source("ouster://os-1.local")
    sensors.frames = [ClientTimeout("late"), None, Frame()]
    none, nothing, item = itertools.islice(source, 3)
    assert sensors.hosts == ["os-1.local"]
    assert none is nothing is None
    assert isinstance(item, LiveSweep)
    assert item.timestamp_ns == 7_050_000_000
    assert item.points.intensity.tolist() == [5, 6, 7]
    assert item.points.xyz.tolist() == [[1, 1, 1]] * 3
    np.testing.assert_allclose(item.points.time_s, [-0.05, -0.05, 0])


def test_a_sensor_that_does_not_answer_is_named(sensors):
    with pytest.raises(InputError, match="ouster://nobody: no Ouster sensor answers there"):
        ouster.OusterSource("nobody")
