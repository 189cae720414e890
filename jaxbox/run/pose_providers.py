"""Where the sensor was and when, sweep by sweep: from given poses, the points, the boxes, or nowhere.

A source of poses is asked for each sweep twice: before it is detected, when it may read the points or take
their distortion away, and after it, when the boxes are there.
"""

import dataclasses
import importlib.util
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np

from jaxbox.geometry.rigid import relative_rigid
from jaxbox.run.arguments import ReadSweep, dropped_points
from jaxbox.run.streaming import ReadableSweep
from jaxbox.tracking.odometry import KissIcp, ego_motion_from_boxes
from jaxbox.tracking.poses import Poses, PoseSource, check_pose, deskew, orthonormal_pose
from jaxbox.types import Detections

_NS_PER_S = 10**9
_LONGER_THAN_SWEEP = 1.5
"""Of so many times a sweep's length, a motion is taken to be over missing sweeps."""


class PoseProvider(Protocol):
    """A source of poses for the sweeps of one sequence."""

    source: PoseSource
    """Where the poses are from."""
    T_world_first: np.ndarray
    """(4, 4) float64, m: what is believed of the pose until a valid one comes."""

    def prepare(self, index: int, sweep: ReadableSweep) -> ReadableSweep:
        """The sweep as it is to be read for the detector; called in the order of the sweeps, some ahead."""
        ...

    def locate(self, index: int, detections: Detections) -> np.ndarray:
        """T_world_sensor, (4, 4) float64; called in the order of the sweeps, for those that were read."""
        ...


def estimated_source() -> PoseSource:
    """How poses are estimated where nobody says how: kiss-icp where it is installed, else the boxes."""
    return PoseSource.KISS_ICP if importlib.util.find_spec("kiss_icp") else PoseSource.BOXES


def make_pose_provider(poses: Poses | np.ndarray | PoseSource | str | None) -> PoseProvider:
    """The source of poses that was asked for.

    Args:
      poses: those of all sweeps, (F, 4, 4) T_world_sensor or `Poses`; or "kiss-icp", "boxes" or "none"; None
        for kiss-icp where it is installed, else the boxes.

    Returns:
      The source.

    Raises:
      ValueError: for another word, or another shape.
      ImportError: for "kiss-icp" without the extra ``track``.
    """
    if poses is None:
        poses = estimated_source()
    if isinstance(poses, str):
        if poses not in ESTIMATED:
            raise ValueError(f"poses is {poses!r}; give an array, or one of {', '.join(ESTIMATED)}.")
        return ESTIMATED[PoseSource(poses)]()
    return GivenPoses(poses if isinstance(poses, Poses) else Poses(poses, PoseSource.POSE_FILE))


class GivenPoses:
    """Poses that are known, one a sweep; points that carry times lose their distortion by them."""

    def __init__(self, poses: Poses) -> None:
        self.source = poses.source
        self._T_world_sensor = np.asarray(poses.T_world_sensor, np.float64)
        self._times_ns = None if poses.times_ns is None else [int(time) for time in poses.times_ns]
        valid = (orthonormal_pose(T) for T in self._T_world_sensor if check_pose(T) is None)
        # Elsewhere, in a world of map coordinates, the first sweeps would be thousands of kilometres away.
        self.T_world_first = next(valid, np.eye(4))

    def check_number(self, count: int) -> None:
        """Refuses poses that are not one a sweep.

        Raises:
          ValueError: for sweeps of another number.
        """
        if count != len(self._T_world_sensor):
            raise ValueError(f"{len(self._T_world_sensor)} poses for {count} sweeps; give one each.")

    def prepare(self, index: int, sweep: ReadableSweep) -> ReadableSweep:
        """The sweep, whose points are moved to where they were at its own time.

        Raises:
          ValueError: for more sweeps than poses.
        """
        count = len(self._T_world_sensor)
        if index >= count:
            raise ValueError(f"{count} poses for more sweeps than that, such as {sweep.name}; give one each.")
        first = min(index, max(count - 2, 0))
        pair = self._T_world_sensor[first : first + 2]
        if len(pair) < 2 or any(check_pose(T) for T in pair):
            return sweep
        times_ns = None if self._times_ns is None else self._times_ns[first : first + 2]
        return Deskewed(sweep, relative_rigid(pair[0], pair[1]), _seconds_between(times_ns))

    def locate(self, index: int, detections: Detections) -> np.ndarray:
        """The pose as it was given, which may be invalid."""
        return self._T_world_sensor[index]


class RegisteredPoints:
    """Poses from the points, by kiss-icp. It reads each sweep before its turn."""

    source = PoseSource.KISS_ICP
    T_world_first = np.eye(4)

    def __init__(self) -> None:
        self._odometry = KissIcp()
        self._T_world_sensor: dict[int, np.ndarray] = {}
        self._last_ns: int | None = None

    def prepare(self, index: int, sweep: ReadableSweep) -> ReadableSweep:
        """The sweep with its points, which are read and registered now; a broken one is read again later."""
        times_ns = self._last_ns, getattr(sweep, "timestamp_ns", None)
        self._last_ns = times_ns[1]
        try:
            xyz, intensity, time_s = read_timed(sweep)
            before = self._T_world_sensor.get(index - 1)
            T_world_sensor = self._odometry.register(xyz, time_s)
        except Exception:
            # Reading it for the detector, with its times as here, says why, and the others go on.
            return Deskewed(sweep, np.eye(4))
        self._T_world_sensor[index] = T_world_sensor
        if time_s is not None and before is not None:
            motion, motion_s = relative_rigid(before, T_world_sensor), _seconds_between(times_ns)
            xyz = deskew(xyz, time_s, motion, duration_s=_duration(time_s, motion_s))
        return ReadSweep(sweep.name, xyz, intensity, dropped_points(sweep))

    def locate(self, index: int, detections: Detections) -> np.ndarray:
        """The pose that was found, which is then forgotten; of NaN where the registration failed."""
        T_world_sensor = self._T_world_sensor.get(index, np.full((4, 4), np.nan))
        for earlier in [item for item in self._T_world_sensor if item < index]:
            del self._T_world_sensor[earlier]
        return T_world_sensor


class RegisteredBoxes:
    """Poses from the detector's own boxes, most of which stand."""

    source = PoseSource.BOXES
    T_world_first = np.eye(4)

    def __init__(self) -> None:
        self._motion = self._T_world_sensor = np.eye(4)
        self._before: Detections | None = None

    def prepare(self, index: int, sweep: ReadableSweep) -> ReadableSweep:
        """The sweep as it is."""
        return sweep

    def locate(self, index: int, detections: Detections) -> np.ndarray:
        """The previous pose, and the motion since then."""
        if self._before is not None:
            self._motion, _ = ego_motion_from_boxes(self._before, detections, self._motion)
            self._T_world_sensor = self._T_world_sensor @ self._motion
        self._before = without_points(detections)
        return self._T_world_sensor


class Standing:
    """No poses: the sensor is taken to stand."""

    source = PoseSource.NONE
    T_world_first = np.eye(4)

    def prepare(self, index: int, sweep: ReadableSweep) -> ReadableSweep:
        """The sweep as it is."""
        return sweep

    def locate(self, index: int, detections: Detections) -> np.ndarray:
        """The identity."""
        return np.eye(4)


ESTIMATED = {
    PoseSource.KISS_ICP: RegisteredPoints,
    PoseSource.BOXES: RegisteredBoxes,
    PoseSource.NONE: Standing,
}
"""Sources other than files, by the words that ask for them."""


@dataclasses.dataclass(frozen=True)
class Deskewed:
    """A sweep whose points are moved to where they were at its own time, where they carry times."""

    sweep: ReadableSweep
    """As it lies in its file."""
    T_start_end: np.ndarray
    """(4, 4) float64: the motion of the sensor to the next sweep."""
    motion_s: float | None = None
    """How long that motion takes, where it is known: longer than a sweep, where sweeps are missing."""

    @property
    def name(self) -> str:
        """Of the sweep."""
        return self.sweep.name

    @property
    def num_dropped(self) -> int:
        """As the sweep's."""
        return dropped_points(self.sweep)

    def read_points(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Reads the points and moves them."""
        xyz, intensity, time_s = read_timed(self.sweep)
        if time_s is None:
            return xyz, intensity
        duration_s = _duration(time_s, self.motion_s)
        return deskew(xyz, time_s, self.T_start_end, duration_s=duration_s), intensity


def _seconds_between(times_ns: Sequence[int | None] | None) -> float | None:
    """From the first time to the second; None where one is not known."""
    if times_ns is None or len(times_ns) < 2 or times_ns[0] is None or times_ns[1] is None:
        return None
    return (times_ns[1] - times_ns[0]) / _NS_PER_S


def _duration(time_s: np.ndarray, motion_s: float | None) -> float | None:
    """What `deskew` is told of a motion: how long it takes, where it is clearly longer than the sweep.

    Otherwise it is taken to last as long as the sweep, because times of recording jitter.
    """
    span_s = float(np.ptp(time_s[np.isfinite(time_s)])) if np.isfinite(time_s).any() else 0.0
    return motion_s if motion_s is not None and motion_s > _LONGER_THAN_SWEEP * span_s > 0 else None


def read_timed(sweep: Any) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Reads the points of a sweep and, where it has them, their times.

    Args:
      sweep: of any kind.

    Returns:
      xyz, intensity, and (n,) s since the sweep's time; None for the latter where the points carry no times,
      or are compensated.
    """
    if not hasattr(sweep, "read_timed_points"):
        return *sweep.read_points(), None
    points = sweep.read_timed_points()
    return points.xyz, points.intensity, None if points.is_compensated else points.time_s


def without_points(detections: Detections) -> Detections:
    """Detections without what they say of each point, so that sweeps of any capacity are one shape.

    Args:
      detections: on the host.

    Returns:
      The same boxes.
    """
    none = np.zeros(0, np.int32)
    return dataclasses.replace(
        detections, ground_mask=none.astype(bool), point_component=none, point_detection=none
    )


class Clock:
    """When sweeps were taken: by their own times, else by the poses', else by their number."""

    def __init__(self, rate_hz: float, times_ns: Iterable[int] | None) -> None:
        """Starts at 0.

        Raises:
          ValueError: for a rate that is not positive or not finite.
        """
        if not 0 < rate_hz < np.inf:
            raise ValueError(f"rate_hz is {rate_hz}; it must be positive and finite.")
        self._period_ns = _NS_PER_S / rate_hz
        self._times_ns = None if times_ns is None else [int(time) for time in times_ns]
        self._offset_ns = 0

    def read(self, index: int, sweep: Any) -> int:
        """The time of a sweep.

        Args:
          index: of the sweep in its sequence.
          sweep: with a ``timestamp_ns``, or a ``frame`` that counts the sweeps of its sequence, or neither.

        Returns:
          ns. A sweep without a time comes as many periods after the last one with a time as numbers say.
        """
        known = getattr(sweep, "timestamp_ns", None)
        if known is None and self._times_ns is not None:
            known = self._times_ns[index]
        frame = getattr(sweep, "frame", None)
        counted = round((index if frame is None else frame) * self._period_ns)
        if known is None:
            return self._offset_ns + counted
        self._offset_ns = known - counted
        return known


def prepared(sweeps: Iterable[ReadableSweep], provider: PoseProvider, begun: Any) -> Iterator[ReadableSweep]:
    """Hands sweeps out as they are to be read, and notes the sweeps themselves.

    Args:
      sweeps: of one sequence.
      provider: source of the poses.
      begun: a deque, to which each sweep is added when it is handed out.

    Yields:
      What `stream` reads.
    """
    for index, sweep in enumerate(sweeps):
        begun.append(sweep)
        yield provider.prepare(index, sweep)
