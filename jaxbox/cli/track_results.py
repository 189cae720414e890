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
from jaxbox.io.jsonl import open_jsonl
from jaxbox.io.kitti_tracking import open_track_text
from jaxbox.io.mcap_results import open_mcap_results
from jaxbox.io.parquet import TRACK_COLUMNS, open_parquet, open_track_csv
from jaxbox.io.rerun import open_rerun
from jaxbox.io.results import SweepResult, WriteResult
from jaxbox.viz import open_video, save_png


class TrackFormat(enum.StrEnum):
    """What `track` writes."""

    KITTI = "kitti"
    JSONL = "jsonl"
    PARQUET = "parquet"
    CSV = "csv"
    MCAP = "mcap"
    RERUN = "rerun"


OpenResults = Callable[[pathlib.Path], contextlib.AbstractContextManager[WriteResult]]


class _Kind(NamedTuple):
    suffix: str
    open: OpenResults
    wants_points: bool = False


_KINDS: Mapping[TrackFormat, _Kind] = {
    TrackFormat.KITTI: _Kind(".txt", open_track_text),
    TrackFormat.JSONL: _Kind(".jsonl", open_jsonl),
    TrackFormat.PARQUET: _Kind(".parquet", functools.partial(open_parquet, columns=TRACK_COLUMNS)),
    TrackFormat.CSV: _Kind(".csv", open_track_csv),
    TrackFormat.MCAP: _Kind(".mcap", open_mcap_results, wants_points=True),
    TrackFormat.RERUN: _Kind(".rrd", open_rerun, wants_points=True),
}
VIDEO_SUFFIX = ".mp4"
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
        points: bool,
        pictures: bool,
        video: bool,
    ) -> None:
        """Opens nothing yet: a sequence of which no sweep can be read leaves no file."""
        self._output, self._sequence, self._formats = output, sequence, formats
        self._coasting, self._points, self._pictures, self._video = coasting, points, pictures, video
        self._stack = contextlib.ExitStack()
        self._writers: list[tuple[_Kind, WriteResult]] | None = None
        self._add_to_video: Callable[[np.ndarray], None] | None = None
        self._first_picture: tuple[int, np.ndarray] | None = None
        self.has_camera = True
        """Whether KITTI text was written, where it was asked for; else JSON Lines were, in its place."""

    @property
    def wants_points(self) -> bool:
        """Whether a result file, a picture or the video shows the points."""
        in_files = self._points and any(_KINDS[name].wants_points for name in self._formats)
        return in_files or self.wants_pictures

    @property
    def wants_image(self) -> bool:
        """Whether one of them shows the camera's image."""
        return TrackFormat.RERUN in self._formats or self.wants_pictures

    @property
    def wants_pictures(self) -> bool:
        """Whether sweeps are drawn."""
        return self._pictures or self._video

    @property
    def wants_trails(self) -> bool:
        """Whether one of them shows where tracks were."""
        return self.wants_pictures or bool(self._formats & {TrackFormat.MCAP, TrackFormat.RERUN})

    def are_there(self, *, has_camera: bool) -> bool:
        """Whether all files of a sequence, with or without a camera, are there from an earlier run."""
        suffixes = [_KINDS[name].suffix for name in self._written_formats(has_camera)]
        suffixes += [VIDEO_SUFFIX] if self._video else []
        return all(self._path(suffix).is_file() for suffix in suffixes)

    def _written_formats(self, has_camera: bool) -> set[TrackFormat]:
        """KITTI text needs a camera; JSON Lines are written in its place."""
        if TrackFormat.KITTI in self._formats and not has_camera:
            return {*self._formats - {TrackFormat.KITTI}, TrackFormat.JSONL}
        return set(self._formats)

    def __enter__(self) -> "SequenceFiles":
        return self

    def __exit__(self, *error: Any) -> None:
        with written(self._output):
            if self._first_picture is not None and error[0] is None:
                self._begin_video(self._first_picture[0] + _NS_PER_S)
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

    def add_picture(self, name: str, picture: np.ndarray, time_ns: int) -> None:
        """Writes a sweep's picture, and adds it to the video, where they are wanted."""
        with written(self._output):
            if self._pictures:
                save_png(self._output / PICTURE_FOLDER / f"{name}_tracks.png", picture)
            if self._add_to_video is not None:
                self._add_to_video(picture)
            elif self._video and self._first_picture is None:
                # Two times tell how many pictures a second the video has.
                self._first_picture = time_ns, picture
            elif self._video:
                self._begin_video(time_ns)(picture)

    def _begin_video(self, time_ns: int) -> Callable[[np.ndarray], None]:
        assert self._first_picture is not None
        (first_ns, picture), self._first_picture = self._first_picture, None
        rate_hz = _NS_PER_S / max(time_ns - first_ns, 1)
        context = open_video(self._path(VIDEO_SUFFIX), rate_hz=float(np.clip(rate_hz, *_RATES_HZ)))
        self._add_to_video = self._stack.enter_context(context)
        self._add_to_video(picture)
        return self._add_to_video

    def _open(self, *, has_camera: bool) -> list[tuple[_Kind, WriteResult]]:
        formats, writers = self._written_formats(has_camera), []
        self.has_camera = has_camera or TrackFormat.KITTI not in self._formats
        for name, kind in _KINDS.items():
            if name in formats:
                is_text = name is TrackFormat.KITTI
                begin = functools.partial(open_track_text, coasting=self._coasting) if is_text else kind.open
                writers.append((kind, self._stack.enter_context(begin(self._path(kind.suffix)))))
        return writers

    def _path(self, suffix: str) -> pathlib.Path:
        return self._output / f"{self._sequence}{suffix}"


_RATES_HZ = (1.0, 60.0)
"""Pictures a second that a video may have."""
