"""Points as text, one a line."""

import array
import math
import os
from typing import NamedTuple

import numpy as np

from jaxbox._files import InputError, read_text
from jaxbox.io.point_times import TIME_NAMES, point_times_s
from jaxbox.io.points import INTENSITY_NAMES, PointFormat, Points, TimedPoints, check_num_points

_VALUES_PER_POINT = 4


def read_text_points(path: str | os.PathLike[str]) -> Points:
    """Reads text points: ``x y z [intensity]`` a line, between them blanks or commas.

    Empty lines and lines that begin with ``#`` are skipped. A first line of column names, x y z and any
    others, says which column is the intensity (`INTENSITY_NAMES`) and which the time of
    `read_timed_text_points`; other columns are ignored.

    Args:
      path: the file; one without points is a sweep without points.

    Returns:
      xyz: (n, 3) float32, m, sensor frame.
      intensity: (n,) float32; 0 where there is no fourth column, or none of those named is the intensity.

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


class _Columns(NamedTuple):
    """Which columns hold what, besides x, y, z in the first three."""

    intensity: int | None = 3
    time: int | None = None
    num_named: float = math.inf


def _read_rows(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray | None]:
    """x, y, z and intensity (n, 4) float32, and the column of times, if any."""
    num_columns, columns = 0, _Columns()
    values, times = array.array("d"), array.array("d")
    for number, line in enumerate(read_text(path).replace(",", " ").splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if not num_columns and _is_header(words):
            columns = _named_columns(words)
            continue
        num_columns = num_columns or len(words)
        where = f"{path}, line {number}"
        if num_columns > columns.num_named:
            raise InputError(
                f"{where}: {num_columns} columns, and the first line names {columns.num_named}. Write no "
                "column before x, as pandas does without index=False, and no comma within a number."
            )
        values.extend(_parse_point(words, num_columns, columns.intensity, where))
        if columns.time is not None:
            times.append(_parse_time(words, columns.time, where))
    points = np.array(values).reshape(-1, _VALUES_PER_POINT)
    check_num_points(len(points), str(path))
    # A number beyond float32's range becomes infinite, and is counted by the detector.
    with np.errstate(over="ignore"):
        points = points.astype(np.float32)
    return points, None if columns.time is None else np.array(times)


def _names(words: list[str]) -> list[str]:
    return [word.strip('"').lower() for word in words]


def _is_header(words: list[str]) -> bool:
    return _names(words[:3]) == ["x", "y", "z"]


def _named_columns(words: list[str]) -> _Columns:
    names = _names(words)
    place = {name: names.index(name) for name in names}
    intensity, time = (
        next((place[name] for name in wanted if name in place), None)
        for wanted in (INTENSITY_NAMES, TIME_NAMES)
    )
    return _Columns(intensity, time, len(names))


def _parse_point(words: list[str], columns: int, intensity: int | None, where: str) -> list[float]:
    if len(words) != columns or columns < _VALUES_PER_POINT - 1:
        raise InputError(
            f"{where}: {len(words)} columns; each line needs x y z [intensity], and all lines as many."
        )
    point = words[:3] if intensity is None or intensity >= columns else [*words[:3], words[intensity]]
    try:
        values = [float(word) for word in point]
    except ValueError as error:
        raise InputError(f"{where}: {' '.join(point)[:60]!r} is not x y z [intensity] in numbers.") from error
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
