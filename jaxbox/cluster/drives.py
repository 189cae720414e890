"""track_dataset(): the drives of an archive to tracks, on the workers of a Ray cluster."""

import os
from collections.abc import Callable, Sequence

import jax

from jaxbox import io
from jaxbox.cluster.reports import DatasetReport, DriveReport
from jaxbox.cluster.run import Run, absolute, check_counts, joined_ray
from jaxbox.cluster.sources import group_refs, is_remote, listed
from jaxbox.cluster.track_worker import TrackTask, TrackWorker
from jaxbox.config import DetectorConfig, TrackConfig
from jaxbox.config.checks import check_config, check_ranges
from jaxbox.io.poses import AUTO
from jaxbox.run.arguments import as_config
from jaxbox.run.cache import CacheFolders
from jaxbox.run.pose_providers import ESTIMATED, Clock, estimated_source, make_pose_provider
from jaxbox.run.tracking import MAX_TRACKS, RATE_HZ
from jaxbox.run.versions import versions


def track_dataset(
    sources: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    config: DetectorConfig | str | None = None,
    track_config: TrackConfig | None = None,
    *,
    poses: str | os.PathLike[str] = AUTO,
    rate_hz: float = RATE_HZ,
    max_tracks: int = MAX_TRACKS,
    smooth: bool = False,
    confirmed: bool = False,
    min_score: float = 0.0,
    capacity: int | None = None,
    topic: str | None = None,
    address: str | None = None,
    workers: int | None = None,
    cpus_per_worker: int = 1,
    resume: bool = False,
    on_report: Callable[[DriveReport, int], None] | None = None,
) -> DatasetReport[DriveReport]:
    """Tracks the vehicles of all drives of an archive, on the workers of a Ray cluster.

    A partition is one drive, because the tracker needs the sweeps before: one worker takes it from its first
    sweep to its last, and writes one Parquet file with the drive's name, whose rows are those of
    ``jaxbox track --format parquet``, bit for bit. Everything else is as in `detect_dataset`; a drive on
    which two workers died is given up.

    Args:
      sources: as `detect_dataset`. A recording is a drive, and so are the point files of a folder.
      output: a folder, local or a URL.
      config: the detector's settings, or the name of a preset; None for the default preset.
      track_config: the tracker's settings; None for the defaults.
      poses: "auto" for what the data set or recording holds, else kiss-icp (extra ``track``) where this
        process has it, else the boxes; "kiss-icp", "boxes" or "none"; or a file, or a folder with one a
        drive, on a disk that all nodes have. Poses next to points at URLs are not fetched, so "auto"
        estimates there.
      rate_hz: sweeps a second, where nothing says when they were taken.
      max_tracks: capacity for vehicles at a time.
      smooth: whether each drive is smoothed, `jaxbox.run.tracking.smooth_tracks`, before it is written.
      confirmed: whether only confirmed tracks are written.
      min_score: tracks with lower scores are not written.
      capacity: points that every sweep is padded to; None for the bucket that holds it.
      topic: of the points in recordings of several.
      address: as `detect_dataset`.
      workers: processes that track; None for as many as there are cores. More than there are drives are idle.
      cpus_per_worker: cores of each; one is what pays.
      resume: whether drives of an earlier run that are complete and without failures are kept.
      on_report: told of each drive when it is done, and of how many there are to do.

    Returns:
      What became of every drive. Sweeps that failed are in it by name, with the reason; the rest of their
      drive is in its file.

    Raises:
      InputError: for sources without sweeps, an output that holds another run's partitions, poses that are
        not there, or a file of poses for points at URLs.
      ValueError: for settings that contradict each other, a number below 1, or a rate that is not positive.
      ImportError: without the extra ``ray``, or without ``track`` where kiss-icp is asked for.
      ClusterError: where Ray cannot be reached, or cannot go on.
    """
    check_counts(cpus_per_worker=cpus_per_worker, workers=workers, max_tracks=max_tracks)
    # It refuses a rate that is not positive.
    Clock(rate_hz, None)
    config = as_config(config)
    check_config(config)
    track_config = TrackConfig() if track_config is None else track_config
    check_ranges(track_config)
    given = listed(sources)
    task = TrackTask(
        output=absolute(output),
        config=jax.tree.map(float, config),
        track_config=jax.tree.map(float, track_config),
        poses=_checked_poses(os.fspath(poses), given),
        estimator=estimated_source(),
        rate_hz=rate_hz,
        max_tracks=max_tracks,
        smooth=smooth,
        confirmed=confirmed,
        min_score=min_score,
        capacity=capacity,
        topic=topic,
        num_threads=cpus_per_worker,
        cache_folders=CacheFolders.of_this_process(),
        versions=versions(formats=True),
    )
    with joined_ray(address, workers, cpus_per_worker) as ray:
        run = Run(task, TrackWorker, group_refs, given, ray, cpus_per_worker)
        return run.run(workers, resume, on_report)


def _checked_poses(asked: str, sources: Sequence[str]) -> str:
    """What was asked for, a path so that workers find it."""
    if asked == AUTO:
        return asked
    if asked in ESTIMATED:
        # Without what it needs every drive would fail.
        make_pose_provider(asked)
        return asked
    if remote := [source for source in sources if is_remote(source)]:
        raise io.InputError(
            f"{asked}: poses of a file are for points on a disk, and {remote[0]} is not; copy the points, or "
            f"choose one of {', '.join([AUTO, *ESTIMATED])}."
        )
    if not os.path.exists(asked):
        raise io.InputError(
            f"{asked}: no such file or folder of poses; check it, or choose one of "
            f"{', '.join([AUTO, *ESTIMATED])}."
        )
    return os.path.abspath(asked)
