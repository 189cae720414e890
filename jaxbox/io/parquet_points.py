"""Points as Apache Parquet: a table with the columns x, y, z and, as far as there are, intensity and time."""

import os
import pathlib
from collections.abc import Mapping

import numpy as np

from jaxbox._extras import require
from jaxbox._files import InputError, read_bytes, reason
from jaxbox.io.parquet import PARQUET_COLUMNS
from jaxbox.io.point_times import TIME_NAMES, timed_reader
from jaxbox.io.points import (
    INTENSITY_NAMES,
    PointFormat,
    Points,
    check_num_points,
    check_unpacked,
    named_points,
)

_WANTED = frozenset((*"xyz", *INTENSITY_NAMES, *TIME_NAMES))
_BOX_COLUMNS = frozenset(name for name in PARQUET_COLUMNS if name.startswith("center_"))


def read_parquet_points(path: str | os.PathLike[str]) -> Points:
    """Reads a sweep from a Parquet table.

    Args:
      path: a table with x, y and z, in m, a row a point; names in any case.

    Returns:
      As `jaxbox.io.read_points`; a missing value is NaN.

    Raises:
      InputError: where it is not such a table, or one of boxes, as jaxbox writes them.
      ImportError: without the extra ``arrow``.
    """
    return named_points(_read_columns(pathlib.Path(path)), str(path))


def _read_columns(path: pathlib.Path) -> Mapping[str, np.ndarray]:
    arrow = require("pyarrow", extra="arrow", what="Parquet files")
    parquet = require("pyarrow.parquet", extra="arrow", what="Parquet files")
    data = read_bytes(path)
    try:
        with parquet.ParquetFile(arrow.BufferReader(data)) as file:
            names = file.schema_arrow.names
            if set(names) >= _BOX_COLUMNS:
                raise InputError(
                    f"{path}: holds boxes, as jaxbox writes its results, and no points; give the sweeps."
                )
            check_num_points(file.metadata.num_rows, str(path))
            groups = map(file.metadata.row_group, range(file.metadata.num_row_groups))
            check_unpacked(sum(group.total_byte_size for group in groups), str(path))
            wanted = [name for name in names if name.lower() in _WANTED]
            table = file.read(columns=wanted, use_threads=False)
            table.validate(full=True)
            return {name: table[name].to_numpy() for name in table.column_names}
    except InputError:
        raise
    # What the library raises on broken bytes, on types that it cannot convert, and on names that are no text.
    except (arrow.ArrowException, OSError, ValueError, LookupError, NotImplementedError) as error:
        raise InputError(f"{path}: no readable Parquet table ({reason(error)}); copy it again.") from error


PARQUET_POINTS = PointFormat(
    name="Parquet", suffixes=(".parquet",), read=read_parquet_points, read_timed=timed_reader(_read_columns)
)
