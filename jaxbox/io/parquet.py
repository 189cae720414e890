"""Detections as Apache Parquet, one row a box, for tables and clusters: pandas, DuckDB, Spark.

Columns: ``sweep`` (its name), ``timestamp_ns`` (int64, ns since 1970, or null), ``label`` (a
`Label.word`, such as "car"), ``score``, ``center_x``, ``center_y``, ``center_z``, ``length``, ``width``,
``height`` (m, sensor frame), ``yaw`` (rad), all float32, and ``num_points`` (int32). A sweep without boxes
has no row; the names of all sweeps are a JSON list in the file's metadata under ``jaxbox.sweeps``.
"""

import contextlib
import json
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

from jaxbox._extras import require
from jaxbox._files import InputError, atomic_path, reason
from jaxbox.io.results import ResultFile, SweepResult, WriteResult

PARQUET_COLUMNS: Mapping[str, str] = {
    "sweep": "string", "timestamp_ns": "int64", "label": "string", "score": "float32",
    "center_x": "float32", "center_y": "float32", "center_z": "float32",
    "length": "float32", "width": "float32", "height": "float32", "yaw": "float32", "num_points": "int32",
}  # fmt: skip
"""The columns and Arrow's names of their types."""

SWEEPS_KEY = "jaxbox.sweeps"
"""Key of the file's metadata that lists every sweep."""

_BATCH_ROWS = 16384


@contextlib.contextmanager
def open_parquet(
    path: pathlib.Path, resume: bool = False, *, metadata: Mapping[str, str] | None = None
) -> Iterator[WriteResult]:
    """Opens a Parquet file for the boxes of a run; see the module for its columns.

    Args:
      path: the file; its folder is made where it is missing.
      resume: whether the rows of an earlier file of that name come first.
      metadata: more of the file's metadata, taken when it ends.

    Yields:
      What adds a sweep. Rows are held until there are enough for a batch.

    Raises:
      InputError: where the earlier file cannot be read.
      ImportError: without the extra ``arrow``.
    """
    arrow = require("pyarrow", extra="arrow", what="Parquet files")
    parquet = require("pyarrow.parquet", extra="arrow", what="Parquet files")
    schema = arrow.schema([(name, getattr(arrow, kind)()) for name, kind in PARQUET_COLUMNS.items()])
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
      record: as `jaxbox.io.detections_record` makes it.

    Returns:
      One dictionary a box, with the keys `PARQUET_COLUMNS`.
    """
    return [
        {
            "sweep": record["name"],
            "timestamp_ns": record.get("timestamp_ns"),
            "label": box["label"],
            "score": box["score"],
            **dict(zip(("center_x", "center_y", "center_z"), box["center"], strict=True)),
            **dict(zip(("length", "width", "height"), box["size"], strict=True)),
            "yaw": box["yaw"],
            "num_points": box["num_points"],
        }
        for box in record["boxes"]
    ]


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
