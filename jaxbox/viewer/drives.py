"""The drives of a timeline, and the tracks of their vehicles: computed once, sweep by sweep, and kept."""

import bisect
import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import jax
import numpy as np

from jaxbox import io
from jaxbox.config import DetectorConfig
from jaxbox.io.sweeps import ChainedSweeps
from jaxbox.run.tracking import TrackedSweep, track
from jaxbox.tracking.poses import Poses, PoseSource
from jaxbox.tracking.tracks import Tracks, TrackStatus
from jaxbox.tracking.trails import Trails

_NS_PER_S = 10**9


def split_drives(
    sweeps: Sequence[io.Sweep],
) -> tuple[Sequence[io.Sweep], tuple[Sequence[io.Sweep], ...]]:
    """Puts the sweeps of each drive side by side, in the order of time.

    Args:
      sweeps: what `jaxbox.io.open_sweeps` answers.

    Returns:
      All sweeps, drive by drive, and the sweeps of each drive.
    """
    drives = tuple(drive for _, drive in io.group_sequences(sweeps))
    if all(isinstance(drive, tuple) for drive in drives):
        return tuple(itertools.chain.from_iterable(drives)), drives
    return ChainedSweeps(drives), drives


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackedFrame:
    """The tracks after one sweep, as a page shows them."""

    tracks: Tracks
    """The vehicles, without free slots, in arrays of the host; none of a sweep that was passed over."""
    trails: Mapping[int, np.ndarray]
    """By id: (m, 3) float64, m, where it was lately, in the sensor frame of this sweep."""
    pose_source: PoseSource
    """Where the poses are from."""

    @classmethod
    def of(cls, tracked: TrackedSweep, trails: Mapping[int, np.ndarray]) -> "TrackedFrame":
        """What a page shows of a sweep: some kilobytes.

        Args:
          tracked: a sweep that went through.
          trails: as the field.

        Returns:
          Its tracks.
        """
        assert tracked.tracks is not None
        is_new = TrackStatus.TIME_NOT_LATER not in tracked.status
        # A sweep that was passed over has the tracks of the one before, in the frame of that one.
        rows = np.flatnonzero(tracked.tracks.valid & is_new)
        vehicles = jax.tree.map(lambda field: field[rows] if np.ndim(field) else field, tracked.tracks)
        return cls(tracks=vehicles, trails=trails, pose_source=tracked.pose_source)

    @property
    def status(self) -> TrackStatus:
        """What happened in the tracker."""
        return TrackStatus(int(self.tracks.status))


class TrackMemory:
    """The tracks of every sweep that was asked for, and of those before it in its drive.

    A sweep's tracks depend on all sweeps before it, so each drive is tracked from its beginning, and goes on
    from the last sweep that was tracked. Another setting of the detector forgets all.
    """

    def __init__(self, drives: Sequence[Sequence[io.Sweep]], *, capacity: int | None = None) -> None:
        """Begins without tracks.

        Args:
          drives: sweeps of each drive; the timeline is one after the other.
          capacity: points that a sweep is padded to; None for what it needs.
        """
        self._drives, self._capacity = tuple(drives), capacity
        self._ends = list(itertools.accumulate(len(drive) for drive in self._drives))
        self._config: DetectorConfig | None = None
        self._followed: dict[int, _FollowedDrive] = {}

    def progress(self, index: int, config: DetectorConfig) -> tuple[int, int]:
        """How far a drive is tracked.

        Args:
          index: of the sweep that is wanted, on the timeline.
          config: settings of the detector; where they are not those of before, all tracks are forgotten.

        Returns:
          Sweeps of its drive that are done, and how many have to be for the tracks of this one.
        """
        number, place = self._place(index)
        drive = self._drive(number, config)
        return min(drive.num_done, place + 1), place + 1

    def step(self, index: int, config: DetectorConfig) -> None:
        """Tracks one more sweep of the drive that a sweep is part of.

        Args:
          index: as for `progress`.
          config: as for `progress`.
        """
        self._drive(self._place(index)[0], config).step()

    def find(self, index: int, config: DetectorConfig) -> tuple[TrackedFrame | None, list[str]]:
        """What is known of a sweep.

        Args:
          index: as for `progress`.
          config: as for `progress`.

        Returns:
          Its tracks, or None where there are none; and what went wrong, a sentence each.
        """
        number, place = self._place(index)
        drive = self._drive(number, config)
        found = drive.found[place] if place < len(drive.found) else None
        return found, drive.problems

    def close(self) -> None:
        """Forgets all tracks, and closes the recordings that were being read for them."""
        for drive in self._followed.values():
            drive.close()
        self._followed.clear()

    def _place(self, index: int) -> tuple[int, int]:
        """Number of the drive, and of the sweep in it."""
        number = bisect.bisect_right(self._ends, index)
        return number, index - (self._ends[number - 1] if number else 0)

    def _drive(self, number: int, config: DetectorConfig) -> "_FollowedDrive":
        if config != self._config:
            self.close()
            self._config = config
        if number not in self._followed:
            self._followed[number] = _FollowedDrive(self._drives[number], config, self._capacity)
        return self._followed[number]


class _FollowedDrive:
    """A drive, tracked up to some sweep."""

    def __init__(self, sweeps: Sequence[io.Sweep], config: DetectorConfig, capacity: int | None) -> None:
        self.found: list[TrackedFrame | None] = []
        self.problems: list[str] = []
        self._num_sweeps, self._is_over = len(sweeps), False
        self._trails = Trails()
        self._start_ns: int | None = None
        poses = self._find_poses(sweeps)
        self._source = track(iter(sweeps), config, poses=poses, capacity=capacity)

    @property
    def num_done(self) -> int:
        """Sweeps of which nothing more will be known."""
        return self._num_sweeps if self._is_over else len(self.found)

    def step(self) -> None:
        """Tracks the next sweep; a recording that breaks off ends here, and what there is of it stays."""
        try:
            tracked = next(self._source, None)
        except (io.InputError, ImportError, OSError, ValueError) as error:
            tracked = None
            self.problems.append(f"tracking ended after {len(self.found)} sweeps: {error}")
        self._is_over = tracked is None
        if tracked is not None:
            self.found.append(self._keep(tracked))

    def close(self) -> None:
        """Ends the reading."""
        self._source.close()

    def _find_poses(self, sweeps: Sequence[io.Sweep]) -> Poses | None:
        try:
            return io.find_poses(sweeps)
        except (io.InputError, ImportError) as error:
            # Poses of its own are a convenience: without them it goes as for a drive that has none.
            self.problems.append(f"{error} Poses are estimated instead.")
            return None

    def _keep(self, tracked: TrackedSweep) -> TrackedFrame | None:
        """What a page shows of a sweep; None for one that could not be read."""
        if tracked.tracks is None or tracked.T_world_sensor is None:
            return None
        if self._start_ns is None:
            self._start_ns = tracked.time_ns
        time_s = (tracked.time_ns - self._start_ns) / _NS_PER_S
        trails = self._trails.add(tracked.tracks, tracked.T_world_sensor, time_s)
        return TrackedFrame.of(tracked, trails)
