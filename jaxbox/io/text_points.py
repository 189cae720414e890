"""Points as text, one a line."""

import array
import math
import os

import numpy as np

from jaxbox._files import InputError, read_text
from jaxbox.io.point_times import TIME_NAMES, point_times_s
from jaxbox.io.points import PointFormat, Points, TimedPoints, check_num_points

_VALUES_PER_POINT = 4


def read_text_points(path: str | os.PathLike[str]) -> Points:
    """Reads text points: ``x y z [intensity]`` a line, between them blanks or commas.

    Empty lines and lines that begin with ``#`` are skipped, and so is a first line of column names.
    Columns after the fourth are ignored, but for the times of `read_timed_text_points`.

    Args:
      path: the file; one without points is a sweep without points.

    Returns:
      xyz: (n, 3) float32, m, sensor frame.
      intensity: (n,) float32; 0 where there is no fourth column.

    Raises:
      InputError: naming file and line, for a line that is not numbers, or has fewer than three columns,
        another number than the first, or more than a first line of names.
    """
    points, _ = _read_rows(path)
    return points[:, :3], points[:, 3]


def read_timed_text_points(path: str | os.PathLike[str]) -> TimedPoints:
    """Reads text points, and their times where the first line names a column of `TIME_NAMES`.

    Args:
      path: as `read_text_points`.

    Returns:
      The points, without times where no column is named so.

    Raises:
      InputError: as `read_text_points`, and where the unit of the times is not clear.
    """
    points, times = _read_rows(path)
    time_s = None if times is None else point_times_s({"time": times}, len(times), str(path))
    return TimedPoints(points[:, :3], points[:, 3], time_s)


def _read_rows(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray | None]:
    """x, y, z and intensity (n, 4) float32, and the column of times, if any."""
    columns, num_named, values = 0, math.inf, array.array("d")
    time_column, times = None, array.array("d")
    for number, line in enumerate(read_text(path).replace(",", " ").splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if not columns and _is_header(words):
            time_column, num_named = _time_column(words), len(words)
            continue
        columns = columns or len(words)
        where = f"{path}, line {number}"
        if columns > num_named:
            raise InputError(
                f"{where}: {columns} columns, and the first line names {num_named}. Write no column before "
                "x, as pandas does without index=False, and no comma within a number."
            )
        values.extend(_parse_point(words, columns, where))
        if time_column is not None:
            times.append(_parse_time(words, time_column, where))
    points = np.array(values).reshape(-1, _VALUES_PER_POINT)
    check_num_points(len(points), str(path))
    # A number beyond float32's range becomes infinite, and is counted by the detector.
    with np.errstate(over="ignore"):
        points = points.astype(np.float32)
    return points, None if time_column is None else np.array(times)


def _names(words: list[str]) -> list[str]:
    return [word.strip('"').lower() for word in words]


def _is_header(words: list[str]) -> bool:
    return _names(words[:3]) == ["x", "y", "z"]


def _time_column(words: list[str]) -> int | None:
    names = _names(words)
    return next((names.index(name) for name in TIME_NAMES if name in names), None)


def _parse_point(words: list[str], columns: int, where: str) -> list[float]:
    if len(words) != columns or columns < _VALUES_PER_POINT - 1:
        raise InputError(
            f"{where}: {len(words)} columns; each line needs x y z [intensity], and all lines as many."
        )
    try:
        values = [float(word) for word in words[:_VALUES_PER_POINT]]
    except ValueError as error:
        raise InputError(f"{where}: {' '.join(words)[:60]!r} is not x y z [intensity] in numbers.") from error
    return values if len(values) == _VALUES_PER_POINT else [*values, 0.0]


def _parse_time(words: list[str], column: int, where: str) -> float:
    try:
        return float(words[column])
    except (ValueError, IndexError) as error:
        raise InputError(
            f"{where}: no number in column {column + 1}, which the first line names as time."
        ) from error


TEXT = PointFormat(
    name="text",
    suffixes=(".txt", ".csv", ".xyz"),
    read=read_text_points,
    read_timed=read_timed_text_points,
)
