"""What `jaxbox detect` writes: the formats, which sweeps are done already, and the account of the run."""

import contextlib
import dataclasses
import datetime
import enum
import json
import os
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from jaxbox import io
from jaxbox.cli.console import OutputError
from jaxbox.config import DetectorConfig
from jaxbox.config.fields import differing_names, recorded_options
from jaxbox.geometry.mounting import Mounting
from jaxbox.io.annotation_results import CVAT, LABELCLOUD, XTREME1
from jaxbox.io.csv_table import CSV
from jaxbox.io.jsonl import JSONL
from jaxbox.io.mcap_results import MCAP_RESULTS
from jaxbox.io.parquet import PARQUET
from jaxbox.io.points import Points
from jaxbox.io.rerun import RERUN
from jaxbox.io.results import ResultFile, SweepResult, WriteResult
from jaxbox.run.versions import versions
from jaxbox.types import Calibration, Detections

CONFIG_NAME = "config.toml"
"""The exact settings, next to the results."""
RUN_NAME = "run.json"
"""Versions, options, how the sensor stands, and outcome, next to the results."""
_TRANSFORM_DECIMALS = 6


class ResultFormat(enum.StrEnum):
    """What `detect` writes."""

    KITTI = "kitti"
    JSONL = "jsonl"
    BOTH = "both"
    PARQUET = "parquet"
    CSV = "csv"
    MCAP = "mcap"
    RERUN = "rerun"
    CVAT = "cvat"
    LABELCLOUD = "labelcloud"
    XTREME1 = "xtreme1"


FILES: Mapping[ResultFormat, ResultFile] = {
    ResultFormat.JSONL: JSONL,
    ResultFormat.PARQUET: PARQUET,
    ResultFormat.CSV: CSV,
    ResultFormat.MCAP: MCAP_RESULTS,
    ResultFormat.RERUN: RERUN,
    ResultFormat.CVAT: CVAT,
    ResultFormat.LABELCLOUD: LABELCLOUD,
    ResultFormat.XTREME1: XTREME1,
}
"""Formats of one file a run; KITTI text is one a sweep."""


_RESUME_ADVICE = "and run the same command with --resume; or choose another --output."


@contextlib.contextmanager
def written(path: pathlib.Path, *, advice: str = _RESUME_ADVICE) -> Iterator[None]:
    """Tells failures to write from failures to read: after the first a run cannot go on.

    Args:
      path: the file or folder, for the error.
      advice: what else to do than to free space or fix the permissions.

    Raises:
      OutputError: in place of an OSError of the block.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error}). Free space or fix the permissions, "
            f"{advice}"
        ) from error


class Results:
    """The result files of a run, as a context: they take their names when it ends."""

    def __init__(
        self,
        output: pathlib.Path,
        formats: frozenset[ResultFormat],
        *,
        resume: bool,
        min_score: float,
        points: bool,
    ) -> None:
        """Looks at what an earlier run left, where it is to be resumed.

        Raises:
          InputError: where a format cannot be continued, or an earlier file cannot be read.
        """
        self._output, self._min_score, self._resume, self._points = output, min_score, resume, points
        self._kitti = bool(formats & {ResultFormat.KITTI, ResultFormat.BOTH})
        if ResultFormat.BOTH in formats:
            formats |= {ResultFormat.JSONL}
        self._files = [FILES[name] for name in FILES if name in formats]
        self._finished = {file.name: self._look(file) for file in {JSONL, *self._files}} if resume else {}
        self._open: dict[str, WriteResult] = {}
        self._stack = contextlib.ExitStack()
        self.without_camera: list[str] = []

    def _look(self, file: ResultFile) -> frozenset[str]:
        if file.finished is None:
            raise io.InputError(f"{file.name} cannot be continued; leave out --resume, or its --format.")
        return file.finished(self._output / file.name)

    def __enter__(self) -> "Results":
        return self

    def __exit__(self, *error: Any) -> None:
        with written(self._output):
            self._stack.__exit__(*error)

    @property
    def wants_image(self) -> bool:
        """Whether a format holds the camera's image."""
        return RERUN in self._files

    @property
    def wants_points(self) -> bool:
        """Whether a format holds the points."""
        return self._points and any(file.wants_points for file in self._files)

    def is_finished(self, name: str) -> bool:
        """Whether every format holds a sweep already, from the run that is resumed."""
        if not self._resume:
            return False
        text = not self._kitti or self._text_path(name).is_file() or name in self._finished[JSONL.name]
        return text and all(name in self._finished[file.name] for file in self._files)

    def write(
        self,
        sweep: io.Sweep,
        detections: Detections,
        *,
        calibration: Calibration | None,
        points: Points | None,
        image: np.ndarray | None,
    ) -> Mapping[str, Any]:
        """Adds a sweep to every file: KITTI text where there is a camera, or JSON Lines in its place.

        Returns:
          What JSON Lines say of it.
        """
        record = io.detections_record(
            sweep.name, detections, min_score=self._min_score, timestamp_ns=sweep.timestamp_ns
        )
        files = list(self._files)
        if self._kitti and calibration is not None:
            objects = io.objects_from_detections(detections, calibration, min_score=self._min_score)
            with written(self._text_path(sweep.name)):
                io.write_labels(self._text_path(sweep.name), objects)
        elif self._kitti:
            self.without_camera.append(sweep.name)
            files += [] if JSONL in files else [JSONL]
        for file in files:
            xyz, intensity = points if points is not None and file.wants_points else (None, None)
            result = SweepResult(
                record=record, xyz=xyz, intensity=intensity, calibration=calibration, image=image
            )
            if sweep.name not in self._finished.get(file.name, ()):
                with written(self._output / file.name):
                    self._writer(file)(result)
        return record

    def _writer(self, file: ResultFile) -> WriteResult:
        # Opened with its first sweep: a run without any leaves an earlier file as it was.
        if file.name not in self._open:
            context = file.open(self._output / file.name, self._resume)
            self._open[file.name] = self._stack.enter_context(context)
        return self._open[file.name]

    def _text_path(self, name: str) -> pathlib.Path:
        return self._output / f"{name}.txt"


@dataclasses.dataclass
class RunAccount:
    """The account of a run, next to its results: `CONFIG_NAME` and `RUN_NAME`."""

    output: pathlib.Path
    """Folder of the results."""
    config: DetectorConfig
    """The detector's settings."""
    options: Mapping[str, Any]
    """Other options that the results depend on, as JSON can hold them."""
    inputs: tuple[str, ...]
    """Paths that were given."""
    mounting: Mounting | None = None
    """How the sensor stands; None where the sweeps are taken as they are."""

    def check_resumable(self) -> None:
        """Refuses to go on with other settings or sweeps than those of the results that are there.

        Raises:
          InputError: naming what differs, or what is missing to tell.
        """
        if not (self.output / CONFIG_NAME).is_file():
            return
        earlier = io.read_config(self.output / CONFIG_NAME, base=self.config)
        try:
            account = (self.output / RUN_NAME).read_bytes()
            recorded = recorded_options(account)
        except (OSError, ValueError) as error:
            raise io.InputError(
                f"{self.output / RUN_NAME}: --resume needs the options of the earlier run "
                f"({getattr(error, 'strerror', error)}). Put the file back, or give another --output."
            ) from error
        differing = differing_names(self.config, self.options, earlier=earlier, recorded=recorded)
        if differing:
            raise io.InputError(
                f"{self.output / CONFIG_NAME}: --resume needs the settings of the earlier run, and "
                f"{', '.join(differing)} differ. Give that file with --config, and the options in "
                f"{RUN_NAME}, or another --output."
            )
        self._check_inputs(json.loads(account).get("inputs"))

    def _check_inputs(self, earlier: Any) -> None:
        """Refuses to leave out a path of the earlier run: another drive has sweeps of the same names."""
        given = {os.path.abspath(path) for path in self.inputs}
        paths = map(str, earlier if isinstance(earlier, list) else [])
        missing = [path for path in paths if os.path.abspath(path) not in given]
        if missing:
            raise io.InputError(
                f"{self.output / RUN_NAME}: the earlier run was of {', '.join(missing)}, too, and --resume "
                "knows sweeps by their names alone. Give the paths of that run, and any more, or another "
                "--output."
            )

    def earlier_mounting(self) -> Mounting | None:
        """How the sensor stood in the run that is resumed; None where there is none.

        Raises:
          InputError: where its account does not say.
        """
        if not (self.output / CONFIG_NAME).is_file():
            return None
        path = self.output / RUN_NAME
        try:
            recorded = json.loads(path.read_bytes())["mounting"]
            x, y, z = map(float, recorded["position"])
            up_x, up_y, up_z = map(float, recorded["up"])
            return Mounting((x, y, z), (up_x, up_y, up_z), float(recorded["height_m"]))
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise io.InputError(
                f"{path}: it does not say how the sensor stood (mounting), which --resume with --level goes "
                "by; give another --output."
            ) from error

    def earlier_incomplete(self) -> frozenset[str] | None:
        """Sequences that the run that is resumed has begun or was to do, and not finished.

        Returns:
          Their names; None where there is no earlier run.

        Raises:
          InputError: where its account does not say.
        """
        if not (self.output / CONFIG_NAME).is_file():
            return None
        path = self.output / RUN_NAME
        try:
            return frozenset(map(str, json.loads(path.read_bytes())["incomplete"]))
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            raise io.InputError(
                f"{path}: it does not say which sequences are incomplete, which --resume goes by; give "
                "another --output."
            ) from error

    def earlier_num_sweeps(self) -> Mapping[str, int]:
        """How many sweeps each sequence had in the run that is resumed, as far as its account says."""
        try:
            recorded = json.loads((self.output / RUN_NAME).read_bytes())["num_sweeps"]
            return {str(name): int(count) for name, count in recorded.items()}
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return {}

    def write(self, **outcome: Any) -> None:
        """Writes the two files; before the run without an outcome, and after it."""
        account = {
            "versions": versions(),
            "inputs": list(self.inputs),
            "options": dict(self.options),
            "mounting": None if self.mounting is None else _mounting_record(self.mounting),
            "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            **outcome,
        }
        with written(self.output / RUN_NAME):
            # The settings last: where they are, a run that was killed here left its options too.
            with io.atomic_writer(self.output / RUN_NAME) as handle:
                handle.write(json.dumps(account, indent=2) + "\n")
            io.write_config(self.output / CONFIG_NAME, self.config)


def chosen_by_run(folder: pathlib.Path) -> list[str]:
    """By what the run that wrote a folder chose among the boxes; empty where nothing says that it did."""
    try:
        options = recorded_options((folder / RUN_NAME).read_bytes())
    except (OSError, ValueError):
        return []
    names = "min_score", "min_scores", "classes", "within"
    return [f"{name} {options[name]}" for name in names if options.get(name)]


def _mounting_record(mounting: Mounting) -> dict[str, Any]:
    """The exact numbers, and the transform for whoever reads the boxes."""
    T_level_points = mounting.T_level_points.round(_TRANSFORM_DECIMALS).tolist()
    return dataclasses.asdict(mounting) | {"T_level_points": T_level_points}
