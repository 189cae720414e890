"""Poses of the sweeps of a recording: ``nav_msgs/Odometry``, or transforms of ``/tf`` and ``/tf_static``.

Frames are as in REP 105: a sensor is fixed to ``base_link``, whose pose in ``odom`` is smooth, where that of
``odom`` in ``map`` may jump.

References: REP 105 and the messages nav_msgs/Odometry, geometry_msgs/TransformStamped and tf2_msgs/TFMessage.
"""

import dataclasses
import itertools
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from jaxbox._files import InputError
from jaxbox.geometry.rigid import inverse_rigid
from jaxbox.io.pointcloud2 import stamp_ns
from jaxbox.io.pose_files import rigid_from_quaternions
from jaxbox.io.pose_track import PoseTrack, UnusableSource
from jaxbox.io.recordings import PoseMessage

SMOOTH_FRAME = "odom"
"""The frame above the vehicle whose transform does not jump; above it there may be ``map`` or ``utm``."""

_STATIC = "tf_static"
"""How topics of transforms that hold for the whole recording end."""


@dataclasses.dataclass
class _Samples:
    """Poses of one frame in another, as they come."""

    topic: str
    """That they are from."""
    stamps_ns: list[int] = dataclasses.field(default_factory=list)
    """By the messages' headers."""
    recorded_ns: list[int] = dataclasses.field(default_factory=list)
    """By the recording."""
    rows: list[tuple[float, ...]] = dataclasses.field(default_factory=list)
    """Quaternion, the real part first, and position, m."""
    poses: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 4, 4)))
    """(M, 4, 4) float64, m, once all have come."""

    def add(self, stamp: int, recorded: int, rotation: Any, place: Any) -> None:
        self.stamps_ns.append(stamp)
        self.recorded_ns.append(recorded)
        turn = (rotation.w, rotation.x, rotation.y, rotation.z)
        self.rows.append((*turn, place.x, place.y, place.z))

    def check(self, path: pathlib.Path) -> None:
        """Makes poses of the numbers, in one go: there may be a hundred a second."""
        rows = np.array(self.rows, np.float64).reshape(-1, 7)
        self.poses = rigid_from_quaternions(
            rows[:, :4], rows[:, 4:], lambda index: f"{path}, {self.topic} at {self.recorded_ns[index]}"
        )

    def track(self, *, by_stamp: bool) -> PoseTrack:
        return PoseTrack.sorted(self.stamps_ns if by_stamp else self.recorded_ns, self.poses)


@dataclasses.dataclass(frozen=True)
class RecordedPoses:
    """All that a recording says of where things are."""

    path: pathlib.Path
    """The recording."""
    odometry: dict[tuple[str, str], _Samples] = dataclasses.field(default_factory=dict)
    """By topic and the frame whose pose it is."""
    transforms: dict[str, dict[str, _Samples]] = dataclasses.field(default_factory=dict)
    """Transforms by the child's frame and its parent's, T_parent_child."""
    static: dict[str, tuple[str, _Samples]] = dataclasses.field(default_factory=dict)
    """Those that hold for the whole recording, by the child's frame: the parent, and T_parent_child, of
    which the last counts."""

    def all_samples(self) -> Iterator[_Samples]:
        """Whatever was gathered."""
        yield from self.odometry.values()
        yield from (samples for parents in self.transforms.values() for samples in parents.values())
        yield from (samples for _, samples in self.static.values())


def collect_poses(messages: Iterable[PoseMessage], path: pathlib.Path) -> RecordedPoses:
    """Gathers odometry and transforms of a recording.

    Args:
      messages: as `RecordingFormat.read_poses` gives them.
      path: of the recording, for errors.

    Returns:
      What they say.

    Raises:
      InputError: naming recording, topic and time, for an invalid pose.
    """
    found = RecordedPoses(path)
    for topic, recorded, message in messages:
        if hasattr(message, "transforms"):
            for item in message.transforms:
                samples = _samples_of(found, topic, _frame(item.child_frame_id), _frame(item.header.frame_id))
                stamp, T = stamp_ns(item.header.stamp), item.transform
                samples.add(stamp, recorded, T.rotation, T.translation)
        else:
            body = topic, _frame(message.child_frame_id)
            samples = found.odometry.setdefault(body, _Samples(topic))
            place = message.pose.pose
            samples.add(stamp_ns(message.header.stamp), recorded, place.orientation, place.position)
    for samples in found.all_samples():
        samples.check(path)
    return found


def _samples_of(found: RecordedPoses, topic: str, child: str, parent: str) -> _Samples:
    """Where transforms of two frames are gathered."""
    if not topic.endswith(_STATIC):
        return found.transforms.setdefault(child, {}).setdefault(parent, _Samples(topic))
    if child not in found.static or found.static[child][0] != parent:
        found.static[child] = parent, _Samples(topic)
    return found.static[child][1]


def _frame(name: str) -> str:
    # ROS 1 allowed a slash before it.
    return name.strip("/")


class Transforms:
    """The tree of a recording's frames, at the times of the sweeps."""

    def __init__(self, recorded: RecordedPoses, times_ns: np.ndarray, *, by_stamp: bool) -> None:
        """Looks at a recording.

        Args:
          recorded: what it says.
          times_ns: (F,) int64 of the sweeps.
          by_stamp: whether these are of the messages' headers, or of the recording.
        """
        self._recorded, self._times_ns, self._by_stamp = recorded, times_ns, by_stamp

    def parent(self, child: str) -> str | None:
        """The frame above another; of several the one that is said most often."""
        if child in self._recorded.static:
            return self._recorded.static[child][0]
        parents = self._recorded.transforms.get(child)
        return max(parents, key=lambda name: len(parents[name].rows)) if parents else None

    def ancestors(self, frame: str) -> list[str]:
        """A frame and all above it, up to the root.

        Raises:
          InputError: where they go round in a circle.
        """
        chain, parent = [frame], self.parent(frame)
        while parent is not None:
            if parent in chain:
                circle = " < ".join([*chain, parent])
                raise InputError(
                    f"{self._recorded.path}: frames {circle} go round in a circle; correct the transforms."
                )
            chain.append(parent)
            parent = self.parent(parent)
        return chain

    def up(self, chain: list[str]) -> np.ndarray:
        """T_last_first of a chain of frames, each above the one before: (F, 4, 4) float64.

        Raises:
          UnusableSource: where a transform does not cover the sweeps.
        """
        T = np.tile(np.eye(4), (len(self._times_ns), 1, 1))
        for child, parent in itertools.pairwise(chain):
            T = self._step(child, parent) @ T
        return T

    def _step(self, child: str, parent: str) -> np.ndarray:
        if child in self._recorded.static:
            return self._recorded.static[child][1].poses[-1:]
        track = self._recorded.transforms[child][parent].track(by_stamp=self._by_stamp)
        try:
            return track.at(self._times_ns)
        except UnusableSource as error:
            raise UnusableSource(f"of {child} in {parent}, {error}") from error

    def is_static(self, child: str) -> bool:
        """Whether a frame keeps its place in the one above."""
        return child in self._recorded.static

    def between(self, target: str, source: str) -> np.ndarray | None:
        """T_target_source by way of the nearest frame above both; None where there is none."""
        above_target, above_source = self.ancestors(target), self.ancestors(source)
        common = next((frame for frame in above_source if frame in above_target), None)
        if common is None:
            return None
        T_common_source = self.up(above_source[: above_source.index(common) + 1])
        T_common_target = self.up(above_target[: above_target.index(common) + 1])
        return inverse_rigid(T_common_target) @ T_common_source


def odometry_poses(
    recorded: RecordedPoses, times_ns: np.ndarray, sensor: str, *, by_stamp: bool, topic: str | None = None
) -> Iterator[tuple[np.ndarray, str] | UnusableSource]:
    """The sensor's poses by each topic of odometry.

    Args:
      recorded: what the recording says.
      times_ns: (F,) int64 of the sweeps.
      sensor: frame of the points.
      by_stamp: whether these are of the messages' headers, or of the recording.
      topic: the only one to look at; None for all.

    Yields:
      (F, 4, 4) float64 T_world_sensor and a description, or why a topic cannot serve.

    Raises:
      InputError: where frames go round in a circle.
    """
    tree = Transforms(recorded, times_ns, by_stamp=by_stamp)
    for (name, body), samples in sorted(recorded.odometry.items()):
        if topic not in (None, name):
            continue
        try:
            T_world_body = samples.track(by_stamp=by_stamp).at(times_ns)
            T_body_sensor = tree.between(body, sensor)
        except UnusableSource as error:
            yield UnusableSource(f"{name}: {error}")
            continue
        if T_body_sensor is None:
            note = f"; no transform from {sensor!r} to {body!r}, which are taken for one"
            yield T_world_body, f"{name}{note}"
        else:
            yield T_world_body @ T_body_sensor, name


def tf_poses(
    recorded: RecordedPoses, times_ns: np.ndarray, sensor: str, *, by_stamp: bool
) -> tuple[np.ndarray, str]:
    """The sensor's poses by the tree of transforms: in ``odom``, or else in the root.

    Args:
      recorded: what the recording says.
      times_ns: (F,) int64 of the sweeps.
      sensor: frame of the points.
      by_stamp: whether these are of the messages' headers, or of the recording.

    Returns:
      (F, 4, 4) float64 T_world_sensor, and a description.

    Raises:
      UnusableSource: where nothing above the sensor moves, or transforms do not cover the sweeps.
      InputError: where frames go round in a circle.
    """
    tree = Transforms(recorded, times_ns, by_stamp=by_stamp)
    chain = tree.ancestors(sensor)
    smooth = next((i for i, name in enumerate(chain) if name.rpartition("/")[2] == SMOOTH_FRAME), None)
    chain = chain if smooth is None else chain[: smooth + 1]
    if all(tree.is_static(child) for child in chain[:-1]):
        raise UnusableSource(f"/tf: no transform moves above the frame {sensor!r} of the points")
    try:
        return tree.up(chain), f"/tf, {sensor} in {chain[-1]}"
    except UnusableSource as error:
        raise UnusableSource(f"/tf: {error}") from error
