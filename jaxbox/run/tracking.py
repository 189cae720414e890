"""track(): recorded sweeps to vehicles that have a history: `stream`, then one step of the tracker each."""

import collections
import contextlib
import dataclasses
from collections.abc import Generator, Iterable, Sequence
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from jaxbox.config import DetectorConfig, TrackConfig
from jaxbox.config.checks import check_ranges
from jaxbox.geometry.rigid import partial_motion, relative_rigid
from jaxbox.run.arguments import as_sweeps
from jaxbox.run.pose_providers import (
    Clock,
    GivenPoses,
    PoseProvider,
    make_pose_provider,
    prepared,
    without_points,
)
from jaxbox.run.streaming import ReadableSweep, StreamedSweep, stream
from jaxbox.tracking.poses import Poses, PoseSource, check_pose, orthonormal_pose
from jaxbox.tracking.smoothing import smooth
from jaxbox.tracking.state import Observations, TrackerState, observe
from jaxbox.tracking.step import track_step
from jaxbox.tracking.tracks import Tracks, TrackStatus
from jaxbox.types import Detections, PointCloud

RATE_HZ = 10.0
"""Sweeps a second of most sensors, where nothing says when sweeps were taken."""
MAX_TRACKS = 128
"""Vehicles at a time that are tracked unless more are asked for."""
_NS_PER_S = 10**9
_SOURCE_BITS = {
    PoseSource.BOXES: TrackStatus.POSE_FROM_BOXES,
    PoseSource.NONE: TrackStatus.POSE_UNKNOWN,
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class TrackedSweep(StreamedSweep):
    """One sweep that went through detector and tracker, or did not."""

    sweep: ReadableSweep
    """The sweep itself, as it was given."""
    time_ns: int
    """When it was taken, ns: by its own time, or since the first sweep as far as ``rate_hz`` tells."""
    tracks: Tracks | None
    """The vehicles, in arrays of the host; None where the sweep failed."""
    T_world_sensor: np.ndarray | None
    """(4, 4) float64, m: from the sweep's frame to a world that stands, as far as ``pose_source`` knows; None
    where the sweep failed."""
    pose_source: PoseSource
    """Where the pose is from."""

    def __repr__(self) -> str:
        """The name, and the tracks or why there are none."""
        return f"{type(self).__name__} {self.name}: {self.error or self.tracks}"

    @property
    def status(self) -> TrackStatus:
        """What happened in the tracker; `OK` where the sweep failed."""
        return TrackStatus.OK if self.tracks is None else TrackStatus(int(self.tracks.status))


def track(
    sweeps: Iterable[ReadableSweep | PointCloud | ArrayLike],
    config: DetectorConfig | str | None = None,
    track_config: TrackConfig | None = None,
    *,
    poses: Poses | np.ndarray | PoseSource | str | None = None,
    key: jax.Array | int | None = None,
    capacity: int | None = None,
    max_tracks: int = MAX_TRACKS,
    rate_hz: float = RATE_HZ,
    workers: int = 1,
    devices: Sequence[Any] | None = None,
) -> Generator[TrackedSweep, None, None]:
    """Finds the vehicles of one recorded drive and follows them from sweep to sweep.

    Time is that of the sweeps (``timestamp_ns``), else of the poses, else their ``frame`` or place over
    `rate_hz`. Where points carry times, poses also take the distortion by the sensor's own motion away.

    Args:
      sweeps: of one sequence in the order of time, such as `jaxbox.io.open_sweeps` gives of one drive, or
        arrays as `stream` takes them.
      config: the settings of the detector, or the name of a preset; None for the default preset.
      track_config: those of the tracker; None for the defaults.
      poses: T_world_sensor of each sweep, (F, 4, 4) or `Poses`; or where to take them from: "kiss-icp" (extra
        ``track``), "boxes" or "none". None for kiss-icp where it is installed, else the boxes.
      key: the JAX random key of all, or an integer, its seed; None for 0.
      capacity: points that every sweep is padded to; None for the bucket that holds it.
      max_tracks: capacity for vehicles at a time.
      rate_hz: sweeps a second, where nothing says when they were taken.
      workers: processes that detect, see `stream`; the results do not depend on it.
      devices: as `stream` takes them.

    Yields:
      Each sweep in its order. One that cannot be read comes with an error, and makes the next step longer.
      One that is not later than the sweep before has `TrackStatus.TIME_NOT_LATER`, and changes no track.
      Where the time goes back by more than ``max_gap_s``, as at the start of another recording, all tracks
      end with `TrackStatus.TIME_GAP`.

    Raises:
      ValueError: as `stream`; for poses of another shape, fewer than sweeps, or more than a list, tuple or
        array of them has; for a rate that is not positive and finite, or no slots.
      ImportError: for "kiss-icp" without the extra ``track``.
    """
    provider = make_pose_provider(poses)
    clock = Clock(rate_hz, poses.times_ns if isinstance(poses, Poses) else None)
    track_config = TrackConfig() if track_config is None else track_config
    check_ranges(track_config)
    readable = as_sweeps(sweeps, called="jaxbox.track")
    if isinstance(provider, GivenPoses) and isinstance(sweeps, list | tuple | np.ndarray):
        provider.check_number(len(sweeps))
    tracker = Tracker(track_config, provider.source, max_tracks, T_world_first=provider.T_world_first)
    begun: collections.deque[ReadableSweep] = collections.deque()
    streamed = stream(
        prepared(readable, provider, begun), config, key, capacity=capacity, workers=workers, devices=devices
    )
    return _track(streamed, begun, provider, clock, tracker)


def _track(
    streamed: Any,
    begun: collections.deque[ReadableSweep],
    provider: PoseProvider,
    clock: Clock,
    tracker: "Tracker",
) -> Generator[TrackedSweep, None, None]:
    # Where the caller stops early, the workers end now, and not with the last reference to them.
    with contextlib.closing(streamed):
        for index, found in enumerate(streamed):
            sweep = begun.popleft()
            time_ns = clock.read(index, sweep)
            tracks = T_world_sensor = None
            if found.detections is not None:
                given = provider.locate(index, found.detections)
                tracks, T_world_sensor = tracker.step(found.detections, time_ns, given)
            yield TrackedSweep(
                **vars(found),
                sweep=sweep,
                time_ns=time_ns,
                tracks=tracks,
                T_world_sensor=T_world_sensor,
                pose_source=provider.source,
            )


def smooth_tracks(
    tracked: Sequence[TrackedSweep], track_config: TrackConfig | None = None
) -> list[TrackedSweep]:
    """The tracks of a whole drive, each sweep in the light of all others: `jaxbox.tracking.smooth`.

    Args:
      tracked: all sweeps of `track`, in their order.
      track_config: as for `track`.

    Returns:
      The sweeps with their smoothed tracks; those that failed, or were passed over, are as they were.
    """
    used = [
        index
        for index, sweep in enumerate(tracked)
        if sweep.tracks is not None and TrackStatus.TIME_NOT_LATER not in sweep.status
    ]
    chosen = [tracked[index] for index in used]
    if not chosen:
        return list(tracked)
    # A clock that was set back is taken to have gone on as long.
    steps_ns = np.abs(np.diff([sweep.time_ns for sweep in chosen], prepend=chosen[0].time_ns))
    smoothed = smooth(
        [sweep.tracks for sweep in chosen if sweep.tracks is not None],
        [_observed(sweep.detections) for sweep in chosen if sweep.detections is not None],
        np.array([sweep.T_world_sensor for sweep in chosen]).reshape(-1, 4, 4),
        np.cumsum(steps_ns) / _NS_PER_S,
        track_config,
    )
    result = list(tracked)
    for index, tracks in zip(used, smoothed, strict=True):
        result[index] = dataclasses.replace(tracked[index], tracks=tracks)
    return result


def _observed(detections: Detections) -> Observations:
    return jax.tree.map(np.asarray, _observe(without_points(detections)))


_observe = jax.jit(observe)


@jax.jit
def _step(
    state: TrackerState, detections: Detections, dt: Any, T_previous_current: Any, config: TrackConfig
) -> tuple[TrackerState, Tracks]:
    return track_step(state, observe(detections), dt, T_previous_current, config)


class Tracker:
    """The tracker's memory, and the last sweep and pose that it accepted: one step a sweep."""

    def __init__(
        self,
        config: TrackConfig,
        source: PoseSource,
        max_tracks: int,
        *,
        T_world_first: np.ndarray | None = None,
    ) -> None:
        """Begins without tracks.

        Args:
          config: the tracker's settings.
          source: where the poses are from.
          max_tracks: capacity for vehicles at a time.
          T_world_first: (4, 4) float64, m: the pose until a valid one comes; None for the identity.
        """
        self._T_world_first = np.eye(4) if T_world_first is None else T_world_first
        self._config = jax.tree.map(float, config)
        self._bits = _SOURCE_BITS.get(source, TrackStatus.OK)
        self._state = TrackerState.empty(max_tracks)
        self._last_ns: int | None = None
        self._T_world_last: np.ndarray | None = None
        self._last_motion: tuple[np.ndarray, float] | None = None

    def step(
        self, detections: Detections, time_ns: int, T_world_sensor: np.ndarray
    ) -> tuple[Tracks, np.ndarray]:
        """Takes the next sweep.

        Args:
          detections: on the host.
          time_ns: of the sweep, ns.
          T_world_sensor: (4, 4) float64, m; invalid where it is not known.

        Returns:
          The tracks on the host; and the pose: where it is invalid, that of a sensor which goes on as it did,
          and before any valid one the first of these.
        """
        is_pose, dt = check_pose(T_world_sensor) is None, self._seconds_to(time_ns)
        T_now = orthonormal_pose(T_world_sensor) if is_pose else self._carried_on(float(dt))
        motion = self._motion_to(T_now)
        self._state, tracks = _step(self._state, without_points(detections), dt, motion, self._config)
        tracks = tracks.on_host()
        status = TrackStatus(int(tracks.status)) | self._bits
        # The first sweep has no motion yet, so the step has not checked its pose.
        status |= TrackStatus.OK if is_pose else TrackStatus.POSE_INVALID
        if TrackStatus.TIME_NOT_LATER not in status:
            self._last_ns = time_ns
            is_motion = is_pose and self._T_world_last is not None and TrackStatus.POSE_JUMP not in status
            if is_motion and dt > 0:
                self._last_motion = motion.astype(np.float64), float(dt)
            # Where the sensor cannot be carried on, the next pose gives the motion since the last one.
            self._T_world_last = self._T_world_last if T_now is None else T_now
        T_believed = self._T_world_first if self._T_world_last is None else self._T_world_last
        return dataclasses.replace(tracks, status=np.asarray(int(status), np.int32)), T_believed

    def _carried_on(self, dt: float) -> np.ndarray | None:
        """The pose of a sensor that goes on as in the last interval; None where that is not known."""
        if self._T_world_last is None or self._last_motion is None or not 0 < dt <= self._config.max_gap_s:
            return None
        motion, seconds = self._last_motion
        return self._T_world_last @ partial_motion(motion, dt / seconds)

    def _motion_to(self, T_world_now: np.ndarray | None) -> np.ndarray:
        """(4, 4) float32: T_previous_current, of NaN where there is no pose."""
        if T_world_now is None:
            return np.full((4, 4), np.nan, np.float32)
        if self._T_world_last is None:
            return np.eye(4, dtype=np.float32)
        return relative_rigid(self._T_world_last, T_world_now).astype(np.float32)

    def _seconds_to(self, time_ns: int) -> np.float32:
        """Since the last sweep; where the time jumps back by more than the longest gap, as long forward."""
        if self._last_ns is None:
            return np.float32(0)
        seconds = (time_ns - self._last_ns) / _NS_PER_S
        # One wrong time would otherwise make every later sweep too early.
        return np.float32(-seconds if seconds < -self._config.max_gap_s else seconds)
