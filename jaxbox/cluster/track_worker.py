"""A partition that is one drive: its vehicles are followed from its first sweep to its last, to one file."""

import contextlib
import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from jaxbox import io
from jaxbox.cluster.reports import DriveReport
from jaxbox.cluster.sources import FetchedSweep, is_remote
from jaxbox.cluster.worker import MAX_DEATHS, Attempt, Partition, PartitionWorker, Task
from jaxbox.config import TrackConfig
from jaxbox.config.fields import all_fields
from jaxbox.io.drive_records import DriveRecords
from jaxbox.io.parquet import TRACK_COLUMNS
from jaxbox.io.poses import AUTO, choose_poses
from jaxbox.run.pose_providers import without_points
from jaxbox.run.tracking import TrackedSweep, smooth_tracks, track
from jaxbox.tracking.poses import Poses, PoseSource

_POINT_BYTES = 16
"""Of a decoded point: x, y, z and intensity as float32."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackTask(Task):
    """What is the same for all drives."""

    track_config: TrackConfig
    """The tracker's settings."""
    poses: str
    """As `jaxbox.io.poses.choose_poses` takes them."""
    estimator: PoseSource
    """How poses are estimated where that is not said: the same for all drives, whatever a node has."""
    rate_hz: float
    """Sweeps a second where nothing says when they were taken."""
    max_tracks: int
    """Vehicles at a time."""
    smooth: bool
    """Whether the whole drive is looked at before anything is written."""
    confirmed: bool
    """Whether only confirmed tracks are written."""

    @property
    def options(self) -> dict[str, Any]:
        """What the results depend on besides the detector's settings, as JSON can hold it."""
        names = ("poses", "rate_hz", "max_tracks", "smooth", "confirmed")
        own = {name: getattr(self, name) for name in names} | {"track": all_fields(self.track_config)}
        return {**super().options, **own, "estimator": str(self.estimator) if self.poses == AUTO else None}


class TrackWorker(PartitionWorker[TrackTask, DriveReport]):
    """Tracks drives, one after the other, each by itself."""

    columns = TRACK_COLUMNS

    @classmethod
    def report_type(cls) -> type[DriveReport]:
        """The kind of its reports."""
        return DriveReport

    def _records(
        self, partition: Partition, attempt: Attempt, report: DriveReport
    ) -> Iterator[Mapping[str, Any]]:
        if attempt.gives_up(partition.name):
            attempt.end()
            raise RuntimeError(f"its worker died {MAX_DEATHS} times, with this drive alone")
        attempt.begin(partition.name)
        task, ids = self._task, set[int]()
        records = DriveRecords(partition.name, min_score=task.min_score, confirmed=task.confirmed)
        for index, tracked in self._in_order(partition, report):
            assert tracked.detections is not None
            report.status[tracked.name] = int(tracked.detections.status)
            report.track_status[tracked.name] = int(tracked.status)
            record = records.record(index, tracked)
            ids.update(box["id"] for box in record["boxes"])
            report.num_tracks = len(ids)
            yield record
        if not report.status:
            raise io.InputError("none of its sweeps went through, so there are no tracks")

    def _in_order(self, partition: Partition, report: DriveReport) -> Iterator[tuple[int, TrackedSweep]]:
        """The sweeps that went through with their numbers, smoothed where that was asked for."""
        found = self._track(partition, report)
        if not self._task.smooth:
            yield from found
            return
        kept = [(index, _light(tracked)) for index, tracked in found]
        smoothed = smooth_tracks([tracked for _, tracked in kept], self._task.track_config)
        yield from zip([index for index, _ in kept], smoothed, strict=True)

    def _track(self, partition: Partition, report: DriveReport) -> Iterator[tuple[int, TrackedSweep]]:
        task, urls = self._task, {ref.name: ref.url for ref in partition.refs}
        sweeps = self._reader.open_drive(partition.refs)
        source = track(
            sweeps,
            task.config,
            task.track_config,
            poses=self._poses(partition, sweeps, report),
            capacity=task.capacity,
            max_tracks=task.max_tracks,
            rate_hz=task.rate_hz,
        )
        with contextlib.closing(source):
            try:
                for index, tracked in enumerate(source):
                    report.pose_source = str(tracked.pose_source)
                    if tracked.error is None:
                        report.num_bytes += _num_bytes(tracked)
                        yield index, tracked
                    else:
                        report.add_failure(tracked.name, urls.get(tracked.name, ""), tracked.error)
            except io.InputError as error:
                # A recording breaks off: what came before stands.
                report.add_failure(partition.name, partition.refs[0].url, str(error))

    def _poses(self, partition: Partition, sweeps: Sequence[Any], report: DriveReport) -> Poses | PoseSource:
        asked, tell = self._task.poses, report.notes.append
        if asked == AUTO and is_remote(partition.refs[0].url):
            tell("Poses are estimated: those next to points at a URL are not fetched.")
            return self._task.estimator
        found = choose_poses(sweeps, asked, report=tell, warn=tell)
        return self._task.estimator if found is None else found


def _light(tracked: TrackedSweep) -> TrackedSweep:
    """A sweep that can be kept until its drive is over: without points, and without its message."""
    assert tracked.detections is not None
    sweep = tracked.sweep
    if isinstance(sweep, io.Sweep):
        sweep = dataclasses.replace(sweep, decode=None)
    return dataclasses.replace(tracked, sweep=sweep, detections=without_points(tracked.detections))


def _num_bytes(tracked: TrackedSweep) -> int:
    """Bytes of the points of a sweep: of its file, or as they were decoded."""
    sweep = tracked.sweep
    if isinstance(sweep, FetchedSweep):
        return sweep.num_bytes
    assert isinstance(sweep, io.Sweep)
    return os.path.getsize(sweep.points_path) if sweep.decode is None else tracked.num_points * _POINT_BYTES
