"""Where the sweeps of an archive lie: listed by the driver and its tasks, read by the workers."""

import contextlib
import dataclasses
import itertools
import os
import pathlib
import tempfile
import threading
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from jaxbox import io
from jaxbox._extras import require
from jaxbox.io.points import Points, TimedPoints
from jaxbox.io.registry import POINT_FORMATS, format_of
from jaxbox.io.sweeps import distinct_names, sweep_of

_NOWHERE = pathlib.Path("/no/such/folder")
"""Remote paths are named as if they lay below it, where no local file can be taken for theirs."""


@dataclasses.dataclass(frozen=True)
class SweepRef:
    """Where one sweep lies."""

    name: str
    """As `jaxbox detect` names it."""
    url: str
    """A local path, or a URL that fsspec knows."""
    index: int | None = None
    """Its number within a recording; None where the file is one sweep."""


@dataclasses.dataclass(frozen=True)
class ReadSweep:
    """One sweep that was read."""

    points: Points
    """As `jaxbox.io.read_points`."""
    timestamp_ns: int | None
    """When it was taken, ns since 1970; None where that is unknown."""
    num_bytes: int
    """Of its file, or of its points where it is in a recording."""


Tasks = Callable[[Callable[[Any], Any], Sequence[Any]], Sequence[Any]]
"""Calls a function with each of some arguments, in parallel."""


def is_remote(source: str) -> bool:
    """Whether a source has to be fetched, so that it cannot be opened by its path.

    >>> is_remote("s3://bucket/drive"), is_remote("file:///drive"), is_remote("zip://*.bin::drive.zip")
    (True, False, True)
    """
    return ("://" in source and not source.startswith("file://")) or "::" in source


def listed(sources: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]) -> list[str]:
    """One source or several, as texts.

    >>> listed(pathlib.Path("drive"))
    ['drive']
    """
    given = [sources] if isinstance(sources, str | os.PathLike) else sources
    return [os.fspath(source) for source in given]


def list_sweeps(sources: Sequence[str], topic: str | None, tasks: Tasks) -> list[SweepRef]:
    """Lists the sweeps of local paths and of URLs; the folders of a URL are listed in parallel.

    Args:
      sources: local paths as `jaxbox.io.open_sweeps` takes them, URLs of point files, or of folders or
        patterns of them.
      topic: of the points in recordings.
      tasks: what calls in parallel.

    Returns:
      At least one, first those of local paths, in the order and with the names of `open_sweeps`.

    Raises:
      InputError: where there is none, or two would have one name.
      ImportError: without the extra ``ray``, or what fsspec needs for the URL.
    """
    local = [source.removeprefix("file://") for source in sources if not is_remote(source)]
    remote = [source for source in sources if is_remote(source)]
    refs = _list_local(local, topic) if local or not remote else []
    for source in remote:
        found = [item for part in tasks(_find, _units(source)) for item in part]
        if not found:
            raise io.InputError(
                f"{source}: no points there; recordings have to be on a local or mounted disk."
            )
        # As in a local folder: all of one format, because text may be the calibration next to the points.
        first = min(number for number, _ in found)
        refs += [_named(url) for number, url in sorted(found) if number == first]
    return _distinct(refs) if remote else refs


def _list_local(paths: list[str], topic: str | None) -> list[SweepRef]:
    found = io.open_sweeps(paths, topic=topic)
    refs = []
    for part in getattr(found, "parts", (found,)):
        if isinstance(part, io.RecordedSweeps):
            refs += [SweepRef(part.name_of(index), str(part.path), index) for index in range(len(part))]
        else:
            refs += [SweepRef(sweep.name, str(sweep.points_path)) for sweep in part]
    return refs


def _units(source: str) -> list[tuple[str, bool]]:
    """A URL as URLs of files and folders that can be listed separately, and which are known to be files."""
    system, path = _open_system(source)
    if "*" in path or "?" in path:
        return [(_url_of(source, system, found), False) for found in system.glob(path)]
    if not system.isdir(path):
        return [(source, True)]
    found = [(str(item["name"]), item["type"] == "file") for item in system.ls(path, detail=True)]
    # A server that lists pages may give a folder without its slash, but not one that is named as points are.
    return [
        (_url_of(source, system, name), is_file and format_of(_path_of(name)) is not None)
        for name, is_file in found
    ]


def _find(unit: tuple[str, bool]) -> list[tuple[int, str]]:
    """Point files of one of `_units`, each with the rank of its format."""
    url, is_file = unit
    system, path = _open_system(url)
    # Over HTTP to ask whether a file is a folder fetches it.
    paths = system.find(path) if not is_file and system.isdir(path) else [path]
    found = []
    for file in paths:
        point_format = format_of(_path_of(str(file)))
        if point_format is not None and not _path_of(str(file)).name.startswith("."):
            found.append((POINT_FORMATS.index(point_format), _url_of(url, system, file)))
    return found


def _open_system(url: str) -> tuple[Any, str]:
    files: Any = require("fsspec.core", extra="ray", what="archives")
    try:
        return files.url_to_fs(url)
    except (ValueError, OSError) as error:
        raise io.InputError(f"{url}: cannot be opened ({error}); check the URL.") from error


def _url_of(source: str, system: Any, path: str) -> str:
    """The URL of a path of the file system that a source is on."""
    own, chain, rest = source.partition("::")
    if chain:
        return f"{own.partition('://')[0]}://{path}::{rest}"
    return system.unstrip_protocol(path)


def _path_of(url: str) -> pathlib.PurePosixPath:
    """The path within a URL, relative, without steps upwards: fit for names and for a local copy.

    >>> str(_path_of("https://host/drive/../velodyne/1.bin?signature=3"))
    'host/drive/velodyne/1.bin'
    """
    parts = urllib.parse.urlsplit(url.partition("::")[0])
    steps = [step for step in f"{parts.netloc}/{parts.path}".split("/") if step not in ("", ".", "..")]
    return pathlib.PurePosixPath(*steps)


def group_refs(refs: Sequence[SweepRef]) -> list[tuple[str, tuple[SweepRef, ...]]]:
    """Groups sweeps by the drive that they belong to, as `jaxbox.io.group_sequences`; nothing is read.

    Args:
      refs: as `list_sweeps` gives them. Those at URLs are of one drive where they lie in one folder.

    Returns:
      Name and sweeps of each drive, in the order of their first sweeps; names differ.

    >>> [(name, len(group)) for name, group in group_refs([SweepRef("1", "s3://b/day/1.bin")])]
    [('day', 1)]
    """
    sweeps = [listed_sweep(ref) for ref in refs]
    # The messages of a recording share its path.
    refs_of = {(sweep.points_path, sweep.name): ref for sweep, ref in zip(sweeps, refs, strict=True)}
    groups = io.group_sequences(sweeps)
    return [(name, tuple(refs_of[item.points_path, item.name] for item in group)) for name, group in groups]


def listed_sweep(ref: SweepRef) -> io.Sweep:
    """What is known of a sweep without fetching it.

    Args:
      ref: where it lies.

    Returns:
      Its name, drive, frame and time, as far as its path says. That of a URL has no points.
    """
    if ref.index is not None:
        path = pathlib.Path(ref.url)
        return io.Sweep(ref.name, path, sequence=path.stem, decode=_Unread(ref.url))
    return dataclasses.replace(sweep_of(_place_of(ref.url)), name=ref.name)


def _place_of(url: str) -> pathlib.Path:
    """The path of a file, or of a URL as if it lay below a folder: another one for each archive and store."""
    if not is_remote(url):
        return pathlib.Path(url)
    inside_out = url.split("::")
    scheme = inside_out[0].partition("://")[0]
    return _NOWHERE.joinpath(scheme, *(_path_of(part) for part in reversed(inside_out)))


@dataclasses.dataclass(frozen=True)
class _Unread:
    """Stands for the points of a message that was not read."""

    path: str

    def __call__(self) -> Points:
        raise io.InputError(f"{self.path}: its messages have not been read.")

    def timed(self) -> TimedPoints:
        raise io.InputError(f"{self.path}: its messages have not been read.")

    def header(self) -> tuple[int, str]:
        return 0, ""


def _named(url: str) -> SweepRef:
    return SweepRef(sweep_of(_NOWHERE / _path_of(url)).name, url)


def _distinct(refs: list[SweepRef]) -> list[SweepRef]:
    """As `jaxbox.io.open_sweeps`: where several have one name, folders stand before it."""
    names = distinct_names([(_path_of(ref.url).parent, ref.name) for ref in refs])
    named = [dataclasses.replace(ref, name=name) for ref, name in zip(refs, names, strict=True)]
    first: dict[str, str] = {}
    for ref in named:
        if ref.name in first:
            raise io.InputError(
                f"{ref.url}: its sweep would be named {ref.name}, as that of {first[ref.name]}. "
                "Rename one, or go over the two one after the other, with an output of its own each."
            )
        first[ref.name] = ref.url
    return named


class SweepReader:
    """Reads sweeps by their location; several threads may read concurrently."""

    def __init__(self, topic: str | None) -> None:
        """Reads nothing yet.

        Args:
          topic: of the points in recordings.
        """
        self._topic = topic
        self._companions: dict[str, bytes | None] = {}
        self._lock = threading.Lock()
        self._place: tuple[str, int] | None = None
        self._messages: Iterator[io.Sweep] = iter(())

    def read(self, ref: SweepRef) -> ReadSweep:
        """Reads one sweep.

        Args:
          ref: where it lies.

        Returns:
          Its points and time.

        Raises:
          InputError: naming where it lies, where it cannot be read.
          OSError: where it cannot be fetched.
        """
        if ref.index is not None:
            with self._lock:
                sweep = self._next_message(ref.url, ref.index)
            points = sweep.read_points()
            return ReadSweep(points, sweep.timestamp_ns, sum(array.nbytes for array in points))
        if not is_remote(ref.url):
            return _read_file(sweep_of(pathlib.Path(ref.url)))
        with self.copied(ref.url) as sweep:
            return _read_file(sweep)

    def open_drive(self, refs: Sequence[SweepRef]) -> Sequence["io.Sweep | FetchedSweep"]:
        """The sweeps of a drive, for `jaxbox.track`; nothing is read before it is asked for.

        Args:
          refs: all of one drive, as `group_refs` gives them.

        Returns:
          Those of a recording in the one pass that it takes; those at URLs are fetched one by one.

        Raises:
          InputError: where a recording cannot be opened.
        """
        first = refs[0]
        if first.index is not None:
            return io.open_sweeps(first.url, topic=self._topic)
        if is_remote(first.url):
            return [FetchedSweep(ref, self) for ref in refs]
        return [listed_sweep(ref) for ref in refs]

    def _next_message(self, path: str, index: int) -> io.Sweep:
        """The sweep of a number in a recording; going on from the one before costs no new pass."""
        if self._place is None or self._place[0] != path or self._place[1] > index:
            self._messages, self._place = iter(io.open_sweeps(path, topic=self._topic)), (path, 0)
        try:
            sweep = next(itertools.islice(self._messages, index - self._place[1], None))
        except StopIteration:
            self._place = None
            raise io.InputError(f"{path}: it ends before its message {index}; copy it again.") from None
        except Exception:
            self._place = None
            raise
        self._place = (path, index + 1)
        return sweep

    @contextlib.contextmanager
    def copied(self, url: str) -> Iterator[io.Sweep]:
        """Fetches a sweep, and what says more of it, for as long as the block lasts.

        Args:
          url: of its points.

        Yields:
          The sweep, on the local disk.

        Raises:
          InputError: of the block, naming the URL.
          OSError: where it cannot be fetched.
        """
        system, source = _open_system(url)
        with tempfile.TemporaryDirectory(prefix="jaxbox-") as folder:
            # Its own path below: format, name and time of a sweep follow from it.
            path = pathlib.Path(folder) / _path_of(url)
            path.parent.mkdir(parents=True)
            self._copy_companion(system, source, path)
            system.get_file(source, str(path))
            try:
                yield sweep_of(path)
            except io.InputError as error:
                raise io.InputError(str(error).replace(str(path), url)) from error

    def _copy_companion(self, system: Any, source: str, path: pathlib.Path) -> None:
        companion = _companion(path)
        if companion is None:
            return
        levels, name = companion
        remote = f"{source.rsplit('/', levels)[0]}/{name}"
        with self._lock:
            if remote not in self._companions:
                self._companions[remote] = system.cat_file(remote) if system.exists(remote) else None
            content = self._companions[remote]
        if content is not None:
            copy = path.parents[levels - 1] / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(content)


class FetchedSweep:
    """A sweep at a URL, as `jaxbox.track` takes it: it is fetched when its points are asked for."""

    def __init__(self, ref: SweepRef, reader: SweepReader) -> None:
        """Fetches nothing yet.

        Args:
          ref: where it lies.
          reader: fetches it.
        """
        known = listed_sweep(ref)
        self._url, self._reader = ref.url, reader
        self.name = ref.name
        """Of the sweep."""
        self.frame = known.frame
        """Within its drive; None where its path does not say."""
        self.timestamp_ns = known.timestamp_ns
        """When it was taken, ns since 1970; known for some formats once it has been fetched."""
        self.num_bytes = 0
        """Of its file, once it has been fetched."""

    def read_points(self) -> Points:
        """Fetches the points; as `jaxbox.io.Sweep.read_points`."""
        return self._read(io.Sweep.read_points)

    def read_timed_points(self) -> TimedPoints:
        """Fetches the points; as `jaxbox.io.Sweep.read_timed_points`."""
        return self._read(io.Sweep.read_timed_points)

    def _read(self, read: Callable[[io.Sweep], Any]) -> Any:
        with self._reader.copied(self._url) as sweep:
            points = read(sweep)
            self.timestamp_ns = sweep.timestamp_ns
            self.num_bytes = os.path.getsize(sweep.points_path)
        return points


def _read_file(sweep: io.Sweep) -> ReadSweep:
    points = sweep.read_points()
    return ReadSweep(points, sweep.timestamp_ns, os.path.getsize(sweep.points_path))


def _companion(path: pathlib.Path) -> tuple[int, str] | None:
    """A file about the points or times of all files next to this: how many folders up, and its name there."""
    match path.parent.parent.name, path.parent.name:
        case "sensors", "lidar":
            return 3, "calibration/egovehicle_SE3_sensor.feather"
        case "velodyne_points", "data":
            return 2, "timestamps.txt"
    return None
