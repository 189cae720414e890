"""The files that `jaxbox track` writes of one sequence: result files, pictures and the video."""

import contextlib
import dataclasses
import enum
import functools
import pathlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxbox.cli.inputs import PICTURE_FOLDER
from jaxbox.cli.results import written
from jaxbox.io.annotation_results import open_cvat, open_labelcloud, open_xtreme1
from jaxbox.io.csv_table import open_csv
from jaxbox.io.jsonl import open_jsonl
from jaxbox.io.kitti_tracking import open_track_text
from jaxbox.io.mcap_results import open_mcap_results
from jaxbox.io.parquet import TRACK_COLUMNS, open_parquet
from jaxbox.io.rerun import open_rerun
from jaxbox.io.results import SweepResult, WriteResult
from jaxbox.viz import BirdEyeFrame, open_gif, open_video, save_png
from jaxbox.viz.video import AddPicture


class TrackFormat(enum.StrEnum):
    """What `track` writes."""

    KITTI = "kitti"
    JSONL = "jsonl"
    PARQUET = "parquet"
    CSV = "csv"
    MCAP = "mcap"
    RERUN = "rerun"
    CVAT = "cvat"
    LABELCLOUD = "labelcloud"
    XTREME1 = "xtreme1"


OpenResults = Callable[[pathlib.Path], contextlib.AbstractContextManager[WriteResult]]


class _Kind(NamedTuple):
    suffix: str
    open: OpenResults
    wants_points: bool = False
    takes_coasting: bool = False
    takes_min_score: bool = False


_KINDS: Mapping[TrackFormat, _Kind] = {
    TrackFormat.KITTI: _Kind(".txt", open_track_text, takes_coasting=True, takes_min_score=True),
    TrackFormat.JSONL: _Kind(".jsonl", open_jsonl),
    TrackFormat.PARQUET: _Kind(".parquet", functools.partial(open_parquet, columns=TRACK_COLUMNS)),
    TrackFormat.CSV: _Kind(".csv", functools.partial(open_csv, columns=TRACK_COLUMNS)),
    TrackFormat.MCAP: _Kind(".mcap", open_mcap_results, wants_points=True),
    TrackFormat.RERUN: _Kind(".rrd", open_rerun, wants_points=True),
    TrackFormat.CVAT: _Kind("_cvat", open_cvat, wants_points=True, takes_coasting=True),
    TrackFormat.LABELCLOUD: _Kind("_labelcloud", open_labelcloud, wants_points=True, takes_coasting=True),
    TrackFormat.XTREME1: _Kind(
        "_xtreme1", functools.partial(open_xtreme1, scene=True), wants_points=True, takes_coasting=True
    ),
}
VIDEO_SUFFIX, GIF_SUFFIX = ".mp4", ".gif"
GIF_PICTURES = 100
"""At most so many of a drive, evenly chosen, which play as long as the drive took."""
GIF_FRAME = BirdEyeFrame(width_px=480)
"""What each picture shows: some 50 kB."""
_NS_PER_S = 10**9


class SequenceFiles:
    """The files of one sequence, as a context: each takes its name when it is whole."""

    def __init__(
        self,
        output: pathlib.Path,
        sequence: str,
        formats: frozenset[TrackFormat],
        *,
        coasting: bool,
        text_min_score: float,
        points: bool,
        pictures: bool,
        video: bool,
        gif: bool,
    ) -> None:
        """Opens nothing yet: a sequence of which no sweep can be read leaves no file."""
        self._output, self._sequence, self._formats = output, sequence, formats
        self._coasting, self._text_min_score = coasting, text_min_score
        self._points, self._pictures, self._video = points, pictures, video
        self._gif, self._gif_step = gif, 1
        self._stack = contextlib.ExitStack()
        self._writers: list[tuple[_Kind, WriteResult]] | None = None
        self._films: dict[str, _Film] = {}
        self.has_camera = True
        """Whether KITTI text was written, where it was asked for; else JSON Lines were, in its place."""

    @property
    def wants_points(self) -> bool:
        """Whether a result file, a picture or the video shows the points."""
        in_files = self._points and any(_KINDS[name].wants_points for name in self._formats)
        return in_files or self.wants_pictures or self._gif

    @property
    def wants_image(self) -> bool:
        """Whether one of them shows the camera's image."""
        return TrackFormat.RERUN in self._formats or self.wants_pictures or self._gif

    @property
    def wants_pictures(self) -> bool:
        """Whether sweeps are drawn."""
        return self._pictures or self._video

    @property
    def wants_trails(self) -> bool:
        """Whether one of them shows where tracks were."""
        return self.wants_pictures or self._gif or bool(self._formats & {TrackFormat.MCAP, TrackFormat.RERUN})

    def expect(self, num_sweeps: int) -> None:
        """Is told how many sweeps there will be, of which the GIF shows at most `GIF_PICTURES`."""
        self._gif_step = max(1, -(-num_sweeps // GIF_PICTURES))

    def wants_gif(self, index: int) -> bool:
        """Whether the sweep of that index within the drive is drawn for the GIF, of `GIF_FRAME`."""
        return self._gif and index % self._gif_step == 0

    def are_there(self, *, has_camera: bool) -> bool:
        """Whether all files of a sequence, with or without a camera, are there from an earlier run."""
        suffixes = [_KINDS[name].suffix for name in self._written_formats(has_camera)]
        suffixes += [VIDEO_SUFFIX] * self._video + [GIF_SUFFIX] * self._gif
        return all(self._path(suffix).exists() for suffix in suffixes)

    def _written_formats(self, has_camera: bool) -> set[TrackFormat]:
        """KITTI text needs a camera; JSON Lines are written in its place."""
        if TrackFormat.KITTI in self._formats and not has_camera:
            return {*self._formats - {TrackFormat.KITTI}, TrackFormat.JSONL}
        return set(self._formats)

    def __enter__(self) -> "SequenceFiles":
        return self

    def __exit__(self, *error: Any) -> None:
        with written(self._output):
            if error[0] is None:
                for film in self._films.values():
                    film.end()
            self._stack.__exit__(*error)

    def write(self, result: SweepResult) -> None:
        """Adds a sweep to the result files."""
        with written(self._output):
            if self._writers is None:
                self._writers = self._open(has_camera=result.calibration is not None)
            for kind, write in self._writers:
                shown = result
                if not (kind.wants_points and self._points):
                    shown = dataclasses.replace(result, xyz=None, intensity=None)
                write(shown)

    def add_pictures(
        self, name: str, picture: np.ndarray | None, small: np.ndarray | None, time_ns: int
    ) -> None:
        """Writes a sweep's picture and adds it to the video, and the small one to the GIF."""
        with written(self._output):
            if picture is not None and self._pictures:
                save_png(self._output / PICTURE_FOLDER / f"{name}_tracks.png", picture)
            if picture is not None and self._video:
                self._film(VIDEO_SUFFIX, open_video).add(picture, time_ns)
            if small is not None:
                self._film(GIF_SUFFIX, open_gif).add(small, time_ns)

    def _film(self, suffix: str, begin: Callable[..., Any]) -> "_Film":
        if suffix not in self._films:
            open_film = functools.partial(begin, self._path(suffix))
            self._films[suffix] = _Film(lambda rate_hz: self._stack.enter_context(open_film(rate_hz=rate_hz)))
        return self._films[suffix]

    def _open(self, *, has_camera: bool) -> list[tuple[_Kind, WriteResult]]:
        formats, writers = self._written_formats(has_camera), []
        self.has_camera = has_camera or TrackFormat.KITTI not in self._formats
        for name, kind in _KINDS.items():
            if name in formats:
                options: dict[str, Any] = {"coasting": self._coasting} if kind.takes_coasting else {}
                options |= {"min_score": self._text_min_score} if kind.takes_min_score else {}
                begin = functools.partial(kind.open, **options)
                writers.append((kind, self._stack.enter_context(begin(self._path(kind.suffix)))))
        return writers

    def _path(self, suffix: str) -> pathlib.Path:
        return self._output / f"{self._sequence}{suffix}"


_RATES_HZ = (1.0, 60.0)
"""Pictures a second that a video may have."""


class _Film:
    """Holds the first picture back: two times tell how many a second there are."""

    def __init__(self, begin: Callable[[float], AddPicture]) -> None:
        self._begin = begin
        self._add: AddPicture | None = None
        self._first: tuple[int, np.ndarray] | None = None

    def add(self, picture: np.ndarray, time_ns: int) -> None:
        """Adds a picture."""
        if self._add is None and self._first is None:
            self._first = time_ns, picture
            return
        self._begun(time_ns)(picture)

    def end(self) -> None:
        """Adds the only picture, where there was but one."""
        if self._add is None and self._first is not None:
            self._begun(self._first[0] + _NS_PER_S)

    def _begun(self, time_ns: int) -> AddPicture:
        if self._add is None:
            assert self._first is not None
            first_ns, picture = self._first
            rate_hz = _NS_PER_S / max(time_ns - first_ns, 1)
            self._add = self._begin(float(np.clip(rate_hz, *_RATES_HZ)))
            self._add(picture)
        return self._add
