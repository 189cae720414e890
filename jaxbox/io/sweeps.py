"""From a path to sweeps: which points, calibration, labels and image belong together.

Layouts are known at the dataset's root or any folder below:

- KITTI object: ``training/{velodyne,calib,label_2,image_2}/000001.*``
- KITTI tracking: ``training/velodyne/0000/000001.bin``, ``training/{calib,label_02}/0000.txt``,
  ``training/image_02/0000/000001.png``
- KITTI raw: ``2011_09_26/2011_09_26_drive_0052_sync/{velodyne_points,image_02}/data/0000000001.*``, with the
  calibration files next to the drive, and the times in ``velodyne_points/timestamps.txt``
- Argoverse 2: ``LOG/sensors/lidar/315966265259836000.feather``
- nuScenes: ``samples/LIDAR_TOP/*.pcd.bin``
- annotation tools: ``pointclouds`` or ``lidar_point_cloud_0`` with labels beside them, see
  `jaxbox.io.annotations`
- plain: a folder of point files, or one, without anything else; or recordings, which hold many sweeps.

What belongs to a sweep follows from where its points lie, so it is the same however it was reached.
"""

import bisect
import collections
import dataclasses
import datetime
import functools
import glob
import itertools
import os
import pathlib
from collections.abc import Iterable, Iterator, Sequence
from typing import overload

from jaxbox._files import InputError, check_file, read_text
from jaxbox.io.annotations import POINT_FOLDERS, find_annotations
from jaxbox.io.convention import ORDINARY, PointConvention
from jaxbox.io.kitti import tracking_name
from jaxbox.io.kitti_calibration import RAW_CALIBRATION_FILES
from jaxbox.io.mcap import MCAP
from jaxbox.io.ouster import OSF
from jaxbox.io.parquet_points import PARQUET_POINTS
from jaxbox.io.points import PointFormat
from jaxbox.io.recordings import RecordedSweeps, RecordingFormat
from jaxbox.io.registry import POINT_FORMATS, POINT_SUFFIXES, format_of, suffix_of
from jaxbox.io.rosbag import ROSBAG
from jaxbox.io.sweep import Sweep
from jaxbox.io.text_points import TEXT
from jaxbox.io.velodyne import CAPTURE

RECORDING_FORMATS: tuple[RecordingFormat, ...] = (MCAP, ROSBAG, CAPTURE, OSF)
"""The recordings that `open_sweeps` knows; a folder of ROS 2 whose storage is MCAP is read as MCAP."""

RECORDING_SUFFIXES: tuple[str, ...] = tuple(
    suffix for recording_format in RECORDING_FORMATS for suffix in recording_format.suffixes
)
"""Suffixes of their files."""

_FOLDERS = (
    "velodyne", "velodyne/*", "*",
    "training/velodyne", "training/velodyne/*",
    "data", "velodyne_points/data", "*/velodyne_points/data", "*/*/velodyne_points/data",
    "sensors/lidar", "*/sensors/lidar", "LIDAR_TOP", "samples/LIDAR_TOP",
    "pointclouds", "lidar_point_cloud_0", "*/lidar_point_cloud_0",
)  # fmt: skip
"""Where points may lie below a given folder, after the folder itself."""

_LAST = (PARQUET_POINTS, TEXT)
"""Formats after which a folder is searched when nothing else is in it: they may be results, or notes."""

_SEARCHED = tuple(folder for folder in _FOLDERS if folder != "*")

_IMAGE_SUFFIXES = (".png", ".jpg")

PathLike = str | os.PathLike[str]


def open_sweeps(
    path: PathLike | Sequence[PathLike], *, topic: str | None = None, convention: PointConvention = ORDINARY
) -> Sequence[Sweep]:
    """Finds the sweeps at a path; see the module for the layouts.

    Nothing but folders, and the index of recordings, is read before it is asked for; a pass over a
    recording holds one message at a time.

    Args:
      path: a point file, a recording (ROS bag, MCAP, a capture of packets), a folder of either, a KITTI,
        Argoverse 2 or nuScenes folder, a pattern such as ``"drive/*.pcd"``, or several of them.
      topic: of the points in recordings, in captures sender and port; None where each has only one.
      convention: how the numbers are to be taken, where they are not metres with x forward, y left, z up.

    Returns:
      At least one sweep, files sorted by path, and recordings by time; their names differ.

    Raises:
      InputError: where there is no such path, no points in it, or the topic has to be named.
      ImportError: naming the extra that a recording needs, where that is not installed.
    """
    paths = [path] if isinstance(path, str | os.PathLike) else list(path)
    if not paths:
        raise InputError("no path was given; name at least one file or folder.")
    parts = [part for item in paths for found in expand(item) for part in _open_path(found, topic)]
    if convention != ORDINARY:
        parts = [_taken_as(part, convention) for part in parts]
    files = _distinct([sweep for part in parts if isinstance(part, tuple) for sweep in part])
    if all(isinstance(part, tuple) for part in parts):
        return files
    renamed = iter(files)
    parts = [
        tuple(itertools.islice(renamed, len(part))) if isinstance(part, tuple) else part for part in parts
    ]
    return parts[0] if len(parts) == 1 else ChainedSweeps(parts)


def _taken_as(sweeps: Sequence[Sweep], convention: PointConvention) -> Sequence[Sweep]:
    if isinstance(sweeps, RecordedSweeps):
        sweeps.convention = convention
        return sweeps
    return tuple(dataclasses.replace(sweep, convention=convention) for sweep in sweeps)


def sweep_of(file: pathlib.Path) -> Sweep:
    """The sweep of one point file: its name, its time and what belongs to it follow from its path.

    Args:
      file: of any of the layouts; it need not be there.

    Returns:
      The sweep.

    >>> sweep_of(pathlib.Path("training/velodyne/0000/000001.bin")).name
    '0000_000001'
    """
    return _sweep_at(file)


def expand(path: PathLike) -> list[pathlib.Path]:
    """The paths that a pattern matches, or the path itself.

    Args:
      path: as `open_sweeps` takes it.

    Returns:
      Absolute, sorted.

    Raises:
      InputError: for a pattern that nothing matches.
    """
    # Not `resolve`: datasets are often put together from links, and the layout is in the links' names.
    text = os.path.abspath(path)
    if os.path.exists(text) or not glob.has_magic(text):
        return [pathlib.Path(text)]
    if found := sorted(glob.glob(text, recursive=True)):
        return [pathlib.Path(item) for item in found]
    raise InputError(f"{path}: no file or folder is of this pattern; check it.")


def _open_path(path: pathlib.Path, topic: str | None) -> list[Sequence[Sweep]]:
    """The sweeps of one path: point files as a tuple, recordings each by itself."""
    if recording := recording_format(path):
        return [recording.open(path, topic)]
    if path.is_file():
        if format_of(path) is None:
            known = ", ".join((*POINT_SUFFIXES, *RECORDING_SUFFIXES))
            raise InputError(f"{path}: not a known kind of points; give one of {known}.")
        return [(_sweep_at(path),)]
    if not path.is_dir():
        if path.exists():
            check_file(path, max_bytes=None)
        raise InputError(f"{path}: there is no such file or folder; check the path.")
    if files := _find_points(path, [kind for kind in POINT_FORMATS if kind not in _LAST]):
        return [tuple(_sweep_at(file) for file in files)]
    if recordings := [file for file in sorted(path.iterdir()) if recording_format(file)]:
        return [part for file in recordings for part in _open_path(file, topic)]
    if files := _find_points(path, _LAST):
        return [tuple(_sweep_at(file) for file in files)]
    raise InputError(
        f"{path}: no points there. Give a point file ({', '.join(POINT_SUFFIXES)}), a recording "
        f"({', '.join(RECORDING_SUFFIXES)}), a folder of them, or a folder that holds {', '.join(_SEARCHED)}."
    )


def recording_format(path: pathlib.Path) -> RecordingFormat | None:
    """The kind of recording that a file or folder is.

    Args:
      path: of either.

    Returns:
      The format, or None where it is not a recording.
    """
    if path.name.startswith("."):
        return None
    suffix = suffix_of(path, RECORDING_SUFFIXES) if path.is_file() else None
    for recording in RECORDING_FORMATS:
        if suffix in recording.suffixes or (path.is_dir() and recording.is_folder(path)):
            return recording
    return None


def _distinct(sweeps: list[Sweep]) -> tuple[Sweep, ...]:
    """The sweeps; where several have one name, as in different folders, these stand before it."""
    paths = [sweep.points_path for sweep in sweeps]
    names = distinct_names([(path.parent, sweep.name) for path, sweep in zip(paths, sweeps, strict=True)])
    _check_distinct(zip(names, paths, strict=True))
    return tuple(dataclasses.replace(sweep, name=name) for sweep, name in zip(sweeps, names, strict=True))


def distinct_names(places: Sequence[tuple[pathlib.PurePath, str]]) -> list[str]:
    """The names; where several are the same, as many folders before them as tell them apart.

    Args:
      places: folder and name of each.

    Returns:
      The names, in this order. They differ, unless places are the same, or their folders read alike once they
      are joined, as ``a_b`` and ``a/b``.

    >>> distinct_names([(pathlib.PurePath(folder), "1") for folder in ("a/velodyne", "b/velodyne")])
    ['a_velodyne_1', 'b_velodyne_1']
    """
    names, depth = [name for _, name in places], 0
    while len(set(names)) < len(names) and depth < max(len(path.parts) for path, _ in places):
        depth += 1
        counts = collections.Counter(names)
        names = [
            "_".join([*path.parts[-depth:], given]).replace("/", "") if counts[name] > 1 else name
            for name, (path, given) in zip(names, places, strict=True)
        ]
    return names


def _check_distinct(places: Iterable[tuple[str, pathlib.Path]]) -> None:
    """Refuses two sweeps of one name, by the name and file of each."""
    first: dict[str, pathlib.Path] = {}
    for name, path in places:
        if path == first.get(name):
            raise InputError(f"{path}: given twice, by itself or by a folder that holds it; name it once.")
        if name in first:
            raise InputError(
                f"{path}: its sweep would be named {name}, as that of {first[name]}, and share its results. "
                "Rename one, or go over the two one after the other, with an output of its own each."
            )
        first[name] = path


def _names_in(part: Sequence[Sweep]) -> Iterator[tuple[str, pathlib.Path]]:
    """Name and file of each sweep that is known without reading one."""
    if isinstance(part, RecordedSweeps):
        return ((part.name_of(index), part.path) for index in range(len(part)))
    return ((sweep.name, sweep.points_path) for sweep in (part if isinstance(part, tuple) else ()))


class ChainedSweeps(Sequence[Sweep]):
    """Several recordings, or recordings and files, one after the other."""

    def __init__(self, parts: Sequence[Sequence[Sweep]]) -> None:
        _check_distinct([named for part in parts for named in _names_in(part)])
        self.parts = parts
        """The recordings, and the files as tuples."""
        self._ends = list(itertools.accumulate(len(part) for part in parts))

    def __len__(self) -> int:
        return self._ends[-1]

    def __iter__(self) -> Iterator[Sweep]:
        return itertools.chain.from_iterable(self.parts)

    @overload
    def __getitem__(self, index: int) -> Sweep: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Sweep, ...]: ...
    def __getitem__(self, index: int | slice) -> Sweep | tuple[Sweep, ...]:
        wanted = range(len(self))[index]
        if isinstance(wanted, int):
            part = bisect.bisect_right(self._ends, wanted)
            return self.parts[part][wanted - (self._ends[part - 1] if part else 0)]
        return tuple(self[i] for i in wanted)


def _find_points(path: pathlib.Path, formats: Sequence[PointFormat]) -> list[pathlib.Path]:
    """The point files of the first place that has any, all of one format."""
    layouts = list(_layout_folders(path))
    for point_format in formats:
        # Points are taken where they lie, but .txt files next to a known layout are its calibration.
        places = [*layouts, [path]] if point_format is TEXT else [[path], *layouts]
        for folders in places:
            if files := _point_files(point_format, folders):
                return files
    return []


def _layout_folders(path: pathlib.Path) -> Iterator[list[pathlib.Path]]:
    """Sets of folders that may hold the points, by layout."""
    for pattern in _FOLDERS:
        # Any subfolder of "velodyne" is a sequence; elsewhere it could be anything, such as labels.
        if pattern != "*" or path.name == "velodyne":
            yield sorted(folder for folder in path.glob(pattern) if folder.is_dir())


def _point_files(point_format: PointFormat, folders: list[pathlib.Path]) -> list[pathlib.Path]:
    # Hidden files are other programs' leftovers.
    files = [file for folder in folders for file in sorted(folder.iterdir()) if not file.name.startswith(".")]
    files = [file for file in files if format_of(file) is point_format]
    if point_format is TEXT and files:
        # One kind of text only: a .csv next to .xyz files is something else.
        suffix = min((file.suffix.lower() for file in files), key=TEXT.suffixes.index)
        return [file for file in files if file.suffix.lower() == suffix]
    return files


def _sweep_at(file: pathlib.Path) -> Sweep:
    folder = file.parent
    if folder.name == "velodyne":
        return _object_sweep(file, folder.parent)
    if folder.parent.name == "velodyne" and file.stem.isdecimal():
        return _tracking_sweep(file, folder.parent.parent)
    if folder.name == "data" and folder.parent.name == "velodyne_points":
        return _raw_sweep(file, folder.parent.parent)
    found = format_of(file)
    suffix = suffix_of(file, POINT_SUFFIXES) or ""
    timestamp_ns = None if found is None else found.timestamp_ns(file)
    return Sweep(
        name=file.name[: len(file.name) - len(suffix)],
        points_path=file,
        labels_path=find_annotations(file) if file.parent.name in POINT_FOLDERS else None,
        timestamp_ns=timestamp_ns,
        sequence=_sequence_of(file),
    )


def _sequence_of(file: pathlib.Path) -> str | None:
    """The drive of a file that is not KITTI's: nuScenes' or Argoverse 2's log, or the folder."""
    log, _, channel = file.name.partition("__")
    if channel.startswith("LIDAR_TOP"):
        return log
    folder = file.parent
    if (folder.parent.name, folder.name) == ("sensors", "lidar"):
        folder = folder.parent.parent
    elif folder.name in POINT_FOLDERS:
        folder = folder.parent
    # The root of a file system has no name.
    return folder.name or None


def _object_sweep(file: pathlib.Path, root: pathlib.Path) -> Sweep:
    return Sweep(
        name=file.stem,
        points_path=file,
        calibration_path=_existing(root / "calib" / f"{file.stem}.txt"),
        labels_path=_existing(root / "label_2" / f"{file.stem}.txt"),
        image_path=_image(root / "image_2", file.stem),
        sequence=root.name or None,
    )


def _tracking_sweep(file: pathlib.Path, root: pathlib.Path) -> Sweep:
    sequence, frame = file.parent.name, int(file.stem)
    return Sweep(
        name=tracking_name(sequence, frame),
        points_path=file,
        calibration_path=_existing(root / "calib" / f"{sequence}.txt"),
        labels_path=_existing(root / "label_02" / f"{sequence}.txt"),
        image_path=_image(root / "image_02" / sequence, file.stem),
        frame=frame,
        sequence=sequence,
    )


def _raw_sweep(file: pathlib.Path, drive: pathlib.Path) -> Sweep:
    # One of the two alone is a mistake, which reading them will name.
    calibrated = any((drive.parent / name).is_file() for name in RAW_CALIBRATION_FILES)
    return Sweep(
        name=f"{drive.name}_{file.stem}",
        points_path=file,
        calibration_path=drive.parent if calibrated else None,
        image_path=_image(drive / "image_02" / "data", file.stem),
        timestamp_ns=_raw_time_ns(file),
        sequence=drive.name or None,
    )


def _raw_time_ns(file: pathlib.Path) -> int | None:
    """The time of a sweep of a raw drive; its files are numbered by the lines of ``timestamps.txt``."""
    times = file.parent.parent / "timestamps.txt"
    if not file.stem.isdecimal() or not times.is_file():
        return None
    lines = _read_lines(times, times.stat().st_mtime_ns)
    return _parse_time_ns(lines[int(file.stem)]) if int(file.stem) < len(lines) else None


@functools.lru_cache(maxsize=4)
def _read_lines(path: pathlib.Path, _changed_ns: int) -> list[str]:
    """Lines of a file that each sweep of a drive asks for, read once while it stays as it is."""
    return read_text(path).splitlines()


def _parse_time_ns(line: str) -> int | None:
    """Nanoseconds of a line such as ``2011-09-26 13:02:25.594360375``; KITTI names no zone, so UTC is taken.

    >>> _parse_time_ns("1970-01-01 00:01:00.000000005")
    60000000005
    """
    whole, _, fraction = line.strip().partition(".")
    try:
        moment = datetime.datetime.fromisoformat(whole).replace(tzinfo=datetime.UTC)
        return int(moment.timestamp()) * 10**9 + int(fraction[:9].ljust(9, "0"))
    except ValueError:
        return None


def _existing(path: pathlib.Path) -> pathlib.Path | None:
    return path if path.is_file() else None


def _image(folder: pathlib.Path, stem: str) -> pathlib.Path | None:
    paths = (folder / f"{stem}{suffix}" for suffix in _IMAGE_SUFFIXES)
    return next((path for path in paths if path.is_file()), None)
