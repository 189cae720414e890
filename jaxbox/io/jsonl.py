"""Detections as JSON Lines: one sweep a line, in the sensor frame, so that no calibration is needed."""

import dataclasses
import json
import os
from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxbox.io._files import InputError, atomic_writer, read_text
from jaxbox.types import Counts, Detections, Label, Status


def detections_record(name: str, detections: Detections, *, min_score: float = 0.0) -> dict[str, Any]:
    """Gathers what one sweep's line says.

    Args:
      name: of the sweep.
      detections: of one sweep, not a batch.
      min_score: boxes that score less are left out.

    Returns:
      ``name``; ``boxes``, best first, each with ``label`` ("car", "van", "truck"), ``score``, ``center``
      (3, m), ``size`` (3, m: length, width, height), ``yaw`` (rad) and ``num_points``; ``status``, one
      sentence a bit, empty for a clean run; ``counts``, as `Counts`.
    """
    keep = np.asarray(detections.valid) & (np.asarray(detections.score) >= min_score)
    return {
        "name": name,
        "boxes": [_box(detections, int(row)) for row in np.flatnonzero(keep)],
        "status": Status(int(detections.status)).describe(),
        "counts": _counts(detections.counts),
    }


def _box(detections: Detections, row: int) -> dict[str, Any]:
    return {
        "label": Label(int(detections.label[row])).name.lower(),
        "score": float(detections.score[row]),
        "center": np.asarray(detections.center[row]).tolist(),
        "size": np.asarray(detections.size[row]).tolist(),
        "yaw": float(detections.yaw[row]),
        "num_points": int(detections.num_points[row]),
    }


def _counts(counts: Counts) -> dict[str, Any]:
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
      InputError: naming file and line, where a line is no JSON object.
    """
    lines = enumerate(read_text(path).splitlines(), start=1)
    return [_parse_line(line, f"{path}, line {number}") for number, line in lines if line.strip()]


def _parse_line(line: str, where: str) -> dict[str, Any]:
    try:
        record = json.loads(line)
    except json.JSONDecodeError as error:
        raise InputError(f"{where}: not JSON ({error.msg} at column {error.colno}).") from error
    if not isinstance(record, dict):
        raise InputError(f"{where}: not a JSON object; each line must be one sweep's {{...}}.")
    return record
