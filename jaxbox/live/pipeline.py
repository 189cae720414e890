"""From a sweep to its boxes and tracks in one call, compiled before the first one."""

import dataclasses

import numpy as np

from jaxbox.config import DetectorConfig, TrackConfig
from jaxbox.live.sweep import LiveSweep
from jaxbox.run.arguments import ReadSweep
from jaxbox.run.compiled import detect
from jaxbox.run.pose_providers import PoseProvider, make_pose_provider
from jaxbox.run.streaming import StreamedSweep
from jaxbox.run.tracking import MAX_TRACKS, TrackedSweep, Tracker
from jaxbox.tracking.poses import PoseSource
from jaxbox.types import Detections, PointCloud

_NS_PER_S = 10**9


@dataclasses.dataclass(frozen=True, kw_only=True)
class LiveConfig:
    """What is done with each sweep."""

    detector: DetectorConfig = dataclasses.field(default_factory=DetectorConfig)
    """The detector's settings."""
    tracker: TrackConfig | None = dataclasses.field(default_factory=TrackConfig)
    """The tracker's settings; None for boxes without tracks."""
    poses: PoseSource | str | None = None
    """How the sensor's poses are estimated: "kiss-icp", "boxes" or "none"; None for kiss-icp where it is
    installed, else the boxes."""
    max_tracks: int = MAX_TRACKS
    """Vehicles at a time."""


class Pipeline:
    """Detector, poses and tracker of one run, for sweeps of one capacity."""

    def __init__(self, config: LiveConfig, *, capacity: int) -> None:
        """Compiles.

        Args:
          config: the settings.
          capacity: points that every sweep is padded to.

        Raises:
          ValueError: for settings that contradict each other, or an unknown source of poses.
          ImportError: for "kiss-icp" without the extra ``track``.
        """
        self.capacity = capacity
        """Points that every sweep is padded to; of larger ones the farthest points are left out."""
        self.detector = config.detector
        """The detector's settings; others, of the same structure, take effect without compiling."""
        self._config = config
        self._follower = self._begin()
        # An empty sweep has a program of the same shape; what it leaves behind is forgotten.
        no_points = ReadSweep("", np.zeros((0, 3), np.float32), None)
        detections = self._detect(no_points)
        if self._follower is not None:
            self._follower.tracker.step(detections, 0, np.eye(4))
            self._follower = self._begin()

    def __call__(self, sweep: LiveSweep) -> StreamedSweep:
        """Finds the vehicles of the next sweep.

        Args:
          sweep: later than the one before.

        Returns:
          What was found, on the host: a `TrackedSweep` where tracks are on.
        """
        follower = self._follower
        if follower is None:
            return StreamedSweep(sweep.name, sweep.num_points, self._detect(sweep), None)
        readable = follower.prepare(sweep)
        return follower.follow(sweep, self._detect(readable))

    def _begin(self) -> "_Follower | None":
        return None if self._config.tracker is None else _Follower(self._config)

    def _detect(self, sweep: LiveSweep | ReadSweep) -> Detections:
        xyz, intensity = sweep.read_points()
        cloud = PointCloud.from_numpy(xyz, intensity, capacity=self.capacity)
        return detect(cloud, self.detector).on_host()


class _Follower:
    """The tracker and its poses, which begin anew after a gap that no track lives through."""

    def __init__(self, config: LiveConfig) -> None:
        assert config.tracker is not None
        self._poses, self._max_gap_ns = config.poses, float(config.tracker.max_gap_s) * _NS_PER_S
        self._provider: PoseProvider = make_pose_provider(config.poses)
        self.tracker = Tracker(config.tracker, self._provider.source, config.max_tracks)
        self._T_world_begin = self._T_world_last = np.eye(4)
        self._last_ns: int | None = None

    def prepare(self, sweep: LiveSweep) -> LiveSweep | ReadSweep:
        """The sweep as the detector is to see it; where a skipped one lies between, its poses know."""
        if self._last_ns is not None and abs(sweep.timestamp_ns - self._last_ns) > self._max_gap_ns:
            self._provider = make_pose_provider(self._poses)
            self._T_world_begin = self._T_world_last
        self._last_ns = sweep.timestamp_ns
        return self._provider.prepare(sweep.frame, sweep)  # pyright: ignore[reportReturnType]

    def follow(self, sweep: LiveSweep, detections: Detections) -> TrackedSweep:
        """The tracks after the sweep."""
        T_world_sensor = self._T_world_begin @ self._provider.locate(sweep.frame, detections)
        tracks, self._T_world_last = self.tracker.step(detections, sweep.timestamp_ns, T_world_sensor)
        return TrackedSweep(
            name=sweep.name,
            num_points=sweep.num_points,
            detections=detections,
            error=None,
            sweep=sweep,
            time_ns=sweep.timestamp_ns,
            tracks=tracks,
            T_world_sensor=self._T_world_last,
            pose_source=self._provider.source,
        )
