"""Detections, or tracks, as text with commas, one row a box, for spreadsheets: the columns of Parquet."""

import contextlib
import csv
import pathlib
from collections.abc import Iterator, Mapping

from jaxbox._files import InputError, atomic_writer, read_text
from jaxbox.io.parquet import PARQUET_COLUMNS, box_rows
from jaxbox.io.results import ResultFile, WriteResult


@contextlib.contextmanager
def open_csv(
    path: pathlib.Path, resume: bool = False, *, columns: Mapping[str, str] = PARQUET_COLUMNS
) -> Iterator[WriteResult]:
    """Opens a text file with a header and commas for the boxes of a run.

    Args:
      path: the file; its folder is made where it is missing.
      resume: whether the rows of an earlier file of that name come first.
      columns: `PARQUET_COLUMNS`, or `TRACK_COLUMNS` for tracks.

    Yields:
      What adds a sweep.

    Raises:
      InputError: where the earlier file has other columns.
    """
    earlier = _read_rows(path, columns) if resume and path.is_file() else []
    with atomic_writer(path) as handle:
        writer = csv.DictWriter(handle, list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(earlier)
        yield lambda result: writer.writerows(box_rows(result.record))


def finished_csv(path: pathlib.Path) -> frozenset[str]:
    """Names of the sweeps that a file of `open_csv` holds boxes of.

    Args:
      path: the file; where there is none, it holds none.

    Returns:
      The names. A sweep without boxes has no row, and is done again when a run is resumed.

    Raises:
      InputError: where it is not such a file.
    """
    return (
        frozenset(row["sweep"] for row in _read_rows(path, PARQUET_COLUMNS))
        if path.is_file()
        else frozenset()
    )


def _read_rows(path: pathlib.Path, columns: Mapping[str, str]) -> list[dict[str, str]]:
    reader = csv.DictReader(read_text(path, max_bytes=None).splitlines())
    if list(reader.fieldnames or ()) != list(columns):
        raise InputError(f"{path}: its columns are not those of jaxbox; move it away.")
    rows = list(reader)
    if any(None in row or None in row.values() for row in rows):
        raise InputError(f"{path}: a row has more or fewer columns than the header; move it away.")
    return rows


CSV = ResultFile(name="detections.csv", open=open_csv, finished=finished_csv)
