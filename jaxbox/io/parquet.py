"""Detections, or tracks, as Apache Parquet, one row a box, for pandas, DuckDB and Spark.

Columns: ``sweep`` (its name), ``timestamp_ns`` (int64, ns since 1970, or null), ``label`` (a
`Label.word`, such as "car"), ``score``, ``center_x``, ``center_y``, ``center_z``, ``length``, ``width``,
``height`` (m, sensor frame), ``yaw`` and ``heading`` (rad), ``front_probability``, all float32, and
``num_points`` (int32). A sweep without boxes has no row; the names of all sweeps are a JSON list in the
file's metadata under ``jaxbox.sweeps``. Tracks have more columns, `TRACK_COLUMNS`.
"""

import contextlib
import json
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from jaxbox._extras import require
from jaxbox._files import InputError, atomic_path, reason
from jaxbox.io.results import ResultFile, SweepResult, WriteResult

PARQUET_COLUMNS: Mapping[str, str] = {
    "sweep": "string", "timestamp_ns": "int64", "label": "string", "score": "float32",
    "center_x": "float32", "center_y": "float32", "center_z": "float32",
    "length": "float32", "width": "float32", "height": "float32", "yaw": "float32", "heading": "float32",
    "front_probability": "float32", "num_points": "int32",
}  # fmt: skip
"""The columns and Arrow's names of their types."""

TRACK_COLUMNS: Mapping[str, str] = {
    "sequence": "string", "frame": "int32", "time_s": "float64", "id": "int32", **PARQUET_COLUMNS,
    "state": "string", "sight": "string", "confirmed": "bool_", "age": "int32", "hits": "int32",
    "velocity_x": "float32", "velocity_y": "float32",
    "speed": "float32", "turn_rate": "float32", "lateral_shift_m": "float32",
    "world_x": "float64", "world_y": "float64", "world_z": "float64",
}  # fmt: skip
"""Those of tracks, one row a track and sweep; the last three are the centre in the world of the poses, m."""

SWEEPS_KEY = "jaxbox.sweeps"
"""Key of the file's metadata that lists every sweep."""

_BATCH_ROWS = 16384


@contextlib.contextmanager
def open_parquet(
    path: pathlib.Path,
    resume: bool = False,
    *,
    metadata: Mapping[str, str] | None = None,
    columns: Mapping[str, str] = PARQUET_COLUMNS,
) -> Iterator[WriteResult]:
    """Opens a Parquet file for the boxes of a run; see the module for its columns.

    Args:
      path: the file; its folder is made where it is missing.
      resume: whether the rows of an earlier file of that name come first.
      metadata: more of the file's metadata, taken when it ends.
      columns: `PARQUET_COLUMNS`, or `TRACK_COLUMNS` for tracks.

    Yields:
      What adds a sweep. Rows are held until there are enough for a batch.

    Raises:
      InputError: where the earlier file cannot be read.
      ImportError: without the extra ``arrow``.
    """
    arrow = require("pyarrow", extra="arrow", what="Parquet files")
    parquet = require("pyarrow.parquet", extra="arrow", what="Parquet files")
    schema = arrow.schema([(name, getattr(arrow, kind)()) for name, kind in columns.items()])
    names = sorted(finished_parquet(path)) if resume else []
    rows: list[dict[str, Any]] = []
    with atomic_path(path) as temporary, parquet.ParquetWriter(temporary, schema) as writer:
        if resume and path.is_file():
            _copy(path, writer)

        def flush() -> None:
            if rows:
                writer.write_batch(arrow.RecordBatch.from_pylist(rows, schema=schema))
                rows.clear()

        def write(result: SweepResult) -> None:
            names.append(result.record["name"])
            rows.extend(box_rows(result.record))
            if len(rows) >= _BATCH_ROWS:
                flush()

        yield write
        flush()
        writer.add_key_value_metadata({SWEEPS_KEY: json.dumps(names), **(metadata or {})})


def _copy(path: pathlib.Path, writer: Any) -> None:
    """Carries the rows of an earlier file over."""
    arrow = require("pyarrow", extra="arrow", what="Parquet files")
    parquet = require("pyarrow.parquet", extra="arrow", what="Parquet files")
    try:
        with parquet.ParquetFile(path) as earlier:
            for batch in earlier.iter_batches():
                batch.validate(full=True)
                writer.write_batch(batch)
    # Bytes that are not such a table, or a table with other columns.
    except (arrow.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: its rows cannot be read ({reason(error)}); move it away.") from error


def box_rows(record: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The rows of one sweep.

    Args:
      record: as `jaxbox.io.detections_record` or `jaxbox.io.tracks_record` makes it.

    Returns:
      One dictionary a box, with the keys `PARQUET_COLUMNS`, and of a track `TRACK_COLUMNS`.
    """
    return [
        {
            "sweep": record["name"],
            "timestamp_ns": record.get("timestamp_ns"),
            "label": box["label"],
            "score": box["score"],
            **dict(zip(("center_x", "center_y", "center_z"), box["center"], strict=True)),
            **dict(zip(("length", "width", "height"), box["size"], strict=True)),
            **{name: box[name] for name in ("yaw", "heading", "front_probability")},
            "num_points": box["num_points"],
            **(_track_columns(record, box) if "id" in box else {}),
        }
        for box in record["boxes"]
    ]


def _track_columns(record: Mapping[str, Any], box: Mapping[str, Any]) -> dict[str, Any]:
    """What the row of a track has besides that of a box."""
    same = ("id", "state", "sight", "confirmed", "age", "hits", "speed")
    world = np.array(record["T_world_sensor"]) @ [*box["center"], 1.0]
    return {
        **{name: record[name] for name in ("sequence", "frame", "time_s")},
        **{name: box[name] for name in (*same, "turn_rate", "lateral_shift_m")},
        **dict(zip(("velocity_x", "velocity_y"), box["velocity"], strict=True)),
        **dict(zip(("world_x", "world_y", "world_z"), world.tolist()[:3], strict=True)),
    }


def finished_parquet(path: pathlib.Path) -> frozenset[str]:
    """Names of the sweeps that a file of `open_parquet` holds.

    Args:
      path: the file; where there is none, it holds none.

    Returns:
      The names, also of sweeps without boxes.

    Raises:
      InputError: where it is not such a file.
      ImportError: without the extra ``arrow``.
    """
    if not path.is_file():
        return frozenset()
    arrow = require("pyarrow", extra="arrow", what="Parquet files")
    parquet = require("pyarrow.parquet", extra="arrow", what="Parquet files")
    try:
        metadata = parquet.read_metadata(path).metadata or {}
        names = json.loads(metadata[SWEEPS_KEY.encode()])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{SWEEPS_KEY} is not a list of names")
        return frozenset(names)
    except (arrow.ArrowException, OSError, KeyError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: no Parquet file of jaxbox ({reason(error)}); move it away.") from error


PARQUET = ResultFile(name="detections.parquet", open=open_parquet, finished=finished_parquet)
