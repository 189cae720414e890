"""Detections, or tracks, as JSON Lines: one sweep a line, in the sensor frame, which needs no calibration."""

import contextlib
import dataclasses
import json
import os
import pathlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from jaxbox._files import InputError, atomic_writer, parse_json, read_text
from jaxbox.io.results import ResultFile, WriteResult
from jaxbox.run.tracking import TrackedSweep
from jaxbox.tracking.tracks import Sight, TrackCounts, Tracks, TrackStatus
from jaxbox.types import Counts, Detections, Label, Motion, Status


def detections_record(
    name: str, detections: Detections, *, min_score: float = 0.0, timestamp_ns: int | None = None
) -> dict[str, Any]:
    """Gathers what one sweep's line says.

    Args:
      name: of the sweep.
      detections: of one sweep, not a batch.
      min_score: boxes with lower scores are not written.
      timestamp_ns: when the sweep was taken, ns since 1970; None where it is unknown.

    Returns:
      ``name``; ``timestamp_ns``, or None; ``boxes``, best first, each with ``label`` (a
      `Label.word`, such as "car"), ``score``, ``center`` (3, m), ``size`` (3, m: length, width, height),
      ``yaw`` (rad), ``heading`` (rad, to the front), ``front_probability`` and ``num_points``; ``status``,
      one sentence a bit, empty for a clean run; ``counts``, as `Counts`.
    """
    keep = np.asarray(detections.valid) & (np.asarray(detections.score) >= min_score)
    return {
        "name": name,
        "timestamp_ns": timestamp_ns,
        "boxes": [_box(detections, int(row)) for row in np.flatnonzero(keep)],
        "status": Status(int(detections.status)).describe(),
        "counts": _counts(detections.counts),
    }


def _box(detections: Detections, row: int) -> dict[str, Any]:
    return {
        "label": Label(int(detections.label[row])).word,
        "score": float(detections.score[row]),
        "center": np.asarray(detections.center[row]).tolist(),
        "size": np.asarray(detections.size[row]).tolist(),
        "yaw": float(detections.yaw[row]),
        "heading": float(detections.heading[row]),
        "front_probability": float(detections.front_probability[row]),
        "num_points": int(detections.num_points[row]),
    }


def tracks_record(
    tracked: TrackedSweep,
    *,
    sequence: str,
    frame: int,
    time_s: float,
    min_score: float = 0.0,
    confirmed: bool = False,
) -> dict[str, Any]:
    """Gathers what one sweep's line says of its tracks.

    Args:
      tracked: a sweep that went through.
      sequence: name of the sweep's drive.
      frame: number of the sweep in it.
      time_s: since the first sweep of the drive, s.
      min_score: tracks that score less are left out.
      confirmed: whether tracks that are not confirmed are left out.

    Returns:
      What `detections_record` has, with `TrackStatus` and `TrackCounts`, and: ``sequence``, ``frame``,
      ``time_s``, ``T_world_sensor`` (4 x 4, m) and ``pose_source``; in each box ``id``, ``state`` (a `Motion`
      in words), ``sight`` ("seen", "hidden" or "coasting"), ``confirmed``, and the other fields of `Tracks`,
      in metres, radians and seconds, sensor frame of the sweep. ``num_points`` is 0 without a detection. A
      sweep that was passed over (`TrackStatus.TIME_NOT_LATER`) has no boxes.

    Raises:
      ValueError: for a sweep that failed.
    """
    tracks = tracked.tracks
    if tracks is None or tracked.detections is None or tracked.T_world_sensor is None:
        raise ValueError(f"{tracked.name} failed ({tracked.error}); it has no tracks.")
    keep = np.asarray(tracks.valid) & (np.asarray(tracks.score) >= min_score)
    keep &= np.asarray(tracks.confirmed) | (not confirmed)
    keep &= TrackStatus.TIME_NOT_LATER not in tracked.status
    rows = sorted(np.flatnonzero(keep).tolist(), key=lambda row: int(tracks.id[row]))
    num_points = np.append(np.asarray(tracked.detections.num_points), 0)
    # Once a sweep, as the speed is computed when it is asked for.
    listed = {name: np.asarray(getattr(tracks, name)) for name in _LISTED}
    return {
        "name": tracked.name,
        "sequence": sequence,
        "frame": frame,
        "timestamp_ns": getattr(tracked.sweep, "timestamp_ns", None),
        "time_s": time_s,
        "T_world_sensor": tracked.T_world_sensor.tolist(),
        "pose_source": str(tracked.pose_source),
        "boxes": [_track_box(tracks, listed, row, int(num_points[tracks.detection[row]])) for row in rows],
        "status": tracked.status.describe(),
        "counts": _counts(tracks.counts),
    }


_LISTED = (
    "score", "center", "size", "yaw", "age", "hits", "detection", "lateral_shift_m", "heading",
    "front_probability", "velocity", "speed", "turn_rate", "covariance", "filtered_center", "filtered_size",
    "filtered_yaw",
)  # fmt: skip


def _track_box(tracks: Tracks, listed: Mapping[str, np.ndarray], row: int, num_points: int) -> dict[str, Any]:
    return {
        "id": int(tracks.id[row]),
        "label": Label(int(tracks.label[row])).word,
        "state": Motion(int(tracks.motion[row])).word,
        "sight": Sight(int(tracks.sight[row])).name.lower(),
        "confirmed": bool(tracks.confirmed[row]),
        "num_points": num_points,
        **{name: values[row].tolist() for name, values in listed.items()},
        "label_probability": {
            label.word: float(tracks.label_probability[row][label.value]) for label in Label
        },
    }


def _counts(counts: Counts | TrackCounts) -> dict[str, Any]:
    names = [field.name for field in dataclasses.fields(counts)]
    return {name: np.asarray(getattr(counts, name)).tolist() for name in names}


def write_jsonl(path: str | os.PathLike[str], records: Iterable[dict[str, Any]]) -> None:
    """Writes records, one a line, whole or not at all.

    Args:
      path: the file; its folder is made where it is missing.
      records: what `json` can hold.

    Raises:
      ValueError: for NaN or infinity, which JSON does not know.
    """
    with atomic_writer(path) as handle:
        handle.writelines(json.dumps(record, allow_nan=False) + "\n" for record in records)


def read_jsonl(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Reads what `write_jsonl` wrote.

    Args:
      path: the file.

    Returns:
      One record a line; empty lines are skipped.

    Raises:
      InputError: naming file and line, where a line is not a JSON object.
    """
    lines = enumerate(read_text(path, max_bytes=None).splitlines(), start=1)
    return [_parse_line(line, f"{path}, line {number}") for number, line in lines if line.strip()]


def _parse_line(line: str, where: str) -> dict[str, Any]:
    record = parse_json(line, where)
    if not isinstance(record, dict):
        raise InputError(f"{where}: not a JSON object; each line must be one sweep's {{...}}.")
    return record


@contextlib.contextmanager
def open_jsonl(path: pathlib.Path, resume: bool = False) -> Iterator[WriteResult]:
    """Opens a JSON Lines file for the results of a run.

    Args:
      path: the file; its folder is made where it is missing.
      resume: whether the lines of an earlier file of that name come first.

    Yields:
      What adds a sweep.

    Raises:
      InputError: where the earlier file cannot be read.
    """
    earlier = read_jsonl(path) if resume and path.is_file() else []
    with atomic_writer(path) as handle:

        def write(record: Mapping[str, Any]) -> None:
            handle.write(json.dumps(record, allow_nan=False) + "\n")

        for record in earlier:
            write(record)
        yield lambda result: write(result.record)


def finished_jsonl(path: pathlib.Path) -> frozenset[str]:
    """Names of the sweeps that a file of `open_jsonl` holds.

    Args:
      path: the file; where there is none, it holds none.

    Returns:
      The names.

    Raises:
      InputError: where it is not such a file.
    """
    return (
        frozenset(str(record.get("name")) for record in read_jsonl(path)) if path.is_file() else frozenset()
    )


JSONL = ResultFile(name="detections.jsonl", open=open_jsonl, finished=finished_jsonl)
