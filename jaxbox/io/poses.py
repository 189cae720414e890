"""Which poses belong to sweeps: a file that is named, or what the data set or recording holds."""

import dataclasses
import os
import pathlib
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from jaxbox._files import InputError
from jaxbox.geometry.rigid import inverse_rigid
from jaxbox.io.argoverse2_poses import argoverse2_poses
from jaxbox.io.kitti_poses import camera_from_velo, odometry_pose_file, oxts_poses, sensor_poses
from jaxbox.io.levelled import LevelSweep
from jaxbox.io.nuscenes_poses import nuscenes_poses
from jaxbox.io.points import RecordedPoints
from jaxbox.io.pose_files import KITTI_COLUMNS, PoseFile, PoseFrame, read_pose_file
from jaxbox.io.pose_track import PoseTrack, UnusableSource
from jaxbox.io.recorded_poses import collect_poses, odometry_poses, tf_poses
from jaxbox.io.sweep import Sweep
from jaxbox.io.sweeps import recording_format
from jaxbox.run.pose_providers import ESTIMATED
from jaxbox.tracking.poses import Poses, PoseSource, orthonormal_pose

AUTO = "auto"
"""Asks for poses that the data set or recording holds, and estimated ones where there are none."""
Report = Callable[[str], None]
"""Is told, in a sentence, which source was used, and why others were not."""


def choose_poses(
    sweeps: Sequence[Sweep], asked: str, *, report: Report | None = None, warn: Report
) -> Poses | PoseSource | None:
    """The poses of one sequence by what was asked for, as the programs that track take it.

    Args:
      sweeps: as `find_poses` takes them.
      asked: `AUTO`, a word of `jaxbox.run.pose_providers.ESTIMATED`, or a file or folder.
      report: as `find_poses` takes it.
      warn: is told why poses of the data set or recording cannot be used.

    Returns:
      The poses, or how they are to be estimated; None where it is not said how.

    Raises:
      InputError: as `find_poses`, where a file or folder is asked for, and where that holds none.

    >>> choose_poses([], "boxes", warn=print)
    <PoseSource.BOXES: 'boxes'>
    """
    if asked in ESTIMATED:
        return PoseSource(asked)
    if asked != AUTO:
        found = find_poses(sweeps, poses_path=asked, report=report)
        if found is None:
            raise InputError(f"{asked}: no poses of these sweeps there.")
        return found
    try:
        return find_poses(sweeps, report=report)
    except (InputError, ImportError) as error:
        # Poses of its own are a convenience: without them it goes as for a recording that has none.
        warn(f"{error} Poses are estimated instead.")
        return None


@dataclasses.dataclass(frozen=True)
class _Listed:
    """What poses are looked up by: the sweeps without their points."""

    sweeps: tuple[Sweep, ...]
    """Without messages."""
    recorded_ns: np.ndarray | None
    """(F,) int64: the sweeps' times; None where they have none."""
    stamps_ns: np.ndarray | None
    """(F,) int64: by the messages' headers; None where they have none."""
    is_recorded: bool
    """Whether they are messages of a recording."""
    frame_id: str
    """Of the points by the first message's header, or empty."""

    @property
    def clocks(self) -> list[tuple[np.ndarray, bool]]:
        """The sweeps' times and whether they are of headers, best first: a sensor's own are the truer."""
        known = [(self.stamps_ns, True), (self.recorded_ns, False)]
        return [(times, by_stamp) for times, by_stamp in known if times is not None]


def find_poses(
    sweeps: Sequence[Sweep],
    *,
    poses_path: str | os.PathLike[str] | None = None,
    frame: PoseFrame | None = None,
    topic: str | None = None,
    report: Report | None = None,
) -> Poses | None:
    """Finds the poses of the sweeps of one sequence.

    In this order: the file that is named; KITTI's oxts, next to tracking sequences and raw drives; ``poses``
    of KITTI's odometry benchmark; of a recording ``nav_msgs/Odometry``, then ``/tf``; nuScenes' tables;
    Argoverse 2's ``city_SE3_egovehicle.feather``. Between poses of other times than the sweeps' it is
    interpolated, up to 0.1 s beyond their ends. A recording is passed twice, and its points are not decoded.

    Args:
      sweeps: of one sequence, as `group_sequences` gives them.
      poses_path: a text file, see `jaxbox.io.pose_files`, or a folder with one of the sequence's name, such
        as ``0000.txt``. Where it has as many lines as there are sweeps, or no times, a line is a sweep: by
        its order, or else by the sweep's number.
      frame: whose poses that file holds; None for the camera's where it has 12 numbers a line and the sweeps
        have KITTI's calibration, and the sensor's otherwise.
      topic: of odometry, where a recording has several; None for the first by name that covers the sweeps.
      report: is told which source is used, and why one that is there is not.

    Returns:
      The poses, at the points' own frame: level where the sweeps are. None where there are none.

    Raises:
      InputError: naming file and line, or recording and topic, for an invalid pose, and where the file that
        is named does not fit the sweeps.
      ImportError: naming the extra that a source needs, where that is not installed.
      ValueError: for sweeps of several sequences.

    >>> find_poses([Sweep("a", pathlib.Path("a.bin"))]) is None
    True
    """
    listed = _list(sweeps)
    told = report or (lambda _: None)
    if not listed.sweeps:
        return None
    for found in _candidates(listed, poses_path, frame, topic):
        if isinstance(found, UnusableSource):
            told(f"Not used: {found}.")
            continue
        first = listed.sweeps[0]
        T = orthonormal_pose(_levelled(first.convention.world_poses(found.T_world_sensor), first))
        told(f"Poses: {found.source}, {found.origin}.")
        return dataclasses.replace(found, T_world_sensor=T)
    return None


def _list(sweeps: Sequence[Sweep]) -> _Listed:
    """One pass over the sweeps, which keeps none of their messages."""
    kept, headers = [], []
    for sweep in sweeps:
        if sweep.decode is not None:
            headers.append(_header(sweep.decode))
        kept.append(dataclasses.replace(sweep, decode=None))
    if len({(sweep.sequence, sweep.points_path.parent) for sweep in kept}) > 1:
        raise ValueError("the sweeps are of several sequences; see group_sequences.")
    times = [sweep.timestamp_ns for sweep in kept]
    recorded = None if None in times else np.array(times, np.int64)
    stamps = _stamps(headers, recorded) if headers else None
    frame_id = next((frame_id for _, frame_id in headers if frame_id), "")
    return _Listed(tuple(kept), recorded, stamps, bool(headers), frame_id.strip("/"))


def _header(points: RecordedPoints) -> tuple[int, str]:
    try:
        return points.header()
    except InputError:
        # A damaged message will be reported in its turn.
        return 0, ""


def _stamps(headers: list[tuple[int, str]], recorded: np.ndarray | None) -> np.ndarray | None:
    """Times of the headers, None where most have none; those of damaged messages by the usual delay."""
    stamps = np.array([stamp for stamp, _ in headers], np.int64)
    known = stamps > 0
    if known.all() or recorded is None or 2 * known.sum() < len(stamps):
        return stamps if known.all() else None
    delay = int(np.median((recorded - stamps)[known]))
    return np.where(known, stamps, recorded - delay)


def _levelled(T_world_sensor: np.ndarray, first: Sweep) -> np.ndarray:
    if not isinstance(first, LevelSweep):
        return T_world_sensor
    return T_world_sensor @ inverse_rigid(first.mounting.T_level_points)


def _candidates(
    listed: _Listed,
    poses_path: str | os.PathLike[str] | None,
    frame: PoseFrame | None,
    topic: str | None,
) -> Iterator[Poses | UnusableSource]:
    """Sources that are there, in their order."""
    if poses_path is not None:
        yield _from_file(listed, _file_of(pathlib.Path(poses_path), listed.sweeps[0]), frame)
        return
    for source, read in (
        (PoseSource.OXTS, oxts_poses),
        (PoseSource.NUSCENES, nuscenes_poses),
        (PoseSource.ARGOVERSE2, argoverse2_poses),
    ):
        try:
            found = read(listed.sweeps)
        except UnusableSource as unusable:
            yield unusable
            continue
        if found is not None:
            yield Poses(found[0], source, listed.recorded_ns, found[1])
    if (path := odometry_pose_file(listed.sweeps[0])) is not None:
        yield _from_file(listed, path, PoseFrame.CAMERA)
    if listed.is_recorded:
        yield from _recorded(listed, topic)


def _recorded(listed: _Listed, topic: str | None) -> Iterator[Poses | UnusableSource]:
    """Odometry and transforms of a recording, by the headers' clock and else by the recording's."""
    path = listed.sweeps[0].points_path
    kind = recording_format(path)
    if kind is None:
        return
    recorded = collect_poses(kind.read_poses(path), path)
    if topic is not None and topic not in {name for name, _ in recorded.odometry}:
        known = ", ".join(sorted({name for name, _ in recorded.odometry})) or "none"
        raise InputError(f"{path}: no odometry on {topic}; topics of nav_msgs/Odometry: {known}.")
    for times, by_stamp in listed.clocks:
        for item in odometry_poses(recorded, times, listed.frame_id, by_stamp=by_stamp, topic=topic):
            yield _named(item, PoseSource.ODOMETRY, times, path, by_stamp=by_stamp)
    if topic is not None:
        raise InputError(f"{path}: odometry on {topic} does not cover the sweeps, or they have no times.")
    for times, by_stamp in listed.clocks if recorded.transforms else ():
        try:
            item = tf_poses(recorded, times, listed.frame_id, by_stamp=by_stamp)
        except UnusableSource as unusable:
            item = unusable
        yield _named(item, PoseSource.TF, times, path, by_stamp=by_stamp)


def _named(
    found: tuple[np.ndarray, str] | UnusableSource,
    source: PoseSource,
    times: np.ndarray,
    path: pathlib.Path,
    *,
    by_stamp: bool,
) -> Poses | UnusableSource:
    clock = "" if by_stamp else ", by the times of recording"
    if isinstance(found, UnusableSource):
        return UnusableSource(f"{path}, {found}{clock}")
    return Poses(found[0], source, times, f"{path}, {found[1]}{clock}")


def _file_of(path: pathlib.Path, first: Sweep) -> pathlib.Path:
    return path / f"{first.sequence}.txt" if path.is_dir() else path


def _from_file(listed: _Listed, path: pathlib.Path, frame: PoseFrame | None) -> Poses:
    """Poses of a text file; whatever does not fit is an error, as the file was named."""
    found = read_pose_file(path)
    T_cam_velo = camera_from_velo(listed.sweeps[0])
    if frame is None:
        is_camera = found.columns == KITTI_COLUMNS and T_cam_velo is not None
        frame = PoseFrame.CAMERA if is_camera else PoseFrame.SENSOR
    T_world, times, how = _assigned(listed, found, path)
    if frame is PoseFrame.CAMERA:
        if T_cam_velo is None:
            raise InputError(
                f"{path}: poses of KITTI's camera need the sweeps' calibration, and there is none; add "
                "it, or give poses of the sensor."
            )
        T_world = sensor_poses(T_world, T_cam_velo)
    origin = f"{path} ({found.kind}, of the {frame}, {how})"
    return Poses(T_world, PoseSource.POSE_FILE, times, origin)


def _assigned(
    listed: _Listed, found: PoseFile, path: pathlib.Path
) -> tuple[np.ndarray, np.ndarray | None, str]:
    """The pose of each sweep, the sweeps' times, and by what they were found."""
    times = listed.clocks[0][0] if listed.clocks else None
    if found.times_ns is not None:
        problem: object = "the sweeps have no times"
        for clock, _ in listed.clocks:
            try:
                return PoseTrack.sorted(found.times_ns, found.T).at(clock), clock, "by time"
            except UnusableSource as error:
                problem = error
        if len(found.T) != len(listed.sweeps):
            raise InputError(
                f"{path}: {problem}. Give poses of these times, or one line for each of the "
                f"{len(listed.sweeps)} sweeps; there are {len(found.T)}."
            )
        return found.T, times, f"a line a sweep, as {problem}"
    return found.T[_lines(listed.sweeps, len(found.T), path)], times, "a line a sweep"


def _lines(sweeps: Sequence[Sweep], count: int, path: pathlib.Path) -> np.ndarray:
    """The line of each sweep: its place where there are as many, and its number otherwise."""
    if count == len(sweeps):
        return np.arange(count)
    numbers = [_number(sweep) for sweep in sweeps]
    known = [number for number in numbers if number is not None]
    if len(known) < len(numbers) or max(known) >= count:
        raise InputError(
            f"{path}: {count} lines for {len(sweeps)} sweeps up to {sweeps[-1].name}; a line is needed for "
            "each, or for each number that names one, from 0."
        )
    return np.array(known)


def _number(sweep: Sweep) -> int | None:
    if sweep.frame is not None:
        return sweep.frame
    stem = sweep.points_path.stem
    return int(stem) if stem.isdecimal() else None
