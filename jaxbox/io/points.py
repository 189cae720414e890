"""Sweeps as plain files: KITTI's binary points, and points as text."""

import os
import pathlib

import numpy as np

from jaxbox.io._files import InputError, atomic_path, read_bytes, read_text

_VALUES_PER_POINT = 4
_BYTES_PER_POINT = _VALUES_PER_POINT * np.dtype("<f4").itemsize

TEXT_SUFFIXES = (".txt", ".csv", ".xyz")
"""Suffixes that are read as text points."""

POINT_SUFFIXES = (".bin", *TEXT_SUFFIXES)
"""Suffixes that `read_points` knows, in the order in which a folder is searched for them."""


def read_points(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Reads one sweep, in the format that its suffix says.

    Args:
      path: a ``.bin`` file, or a ``.txt``, ``.csv`` or ``.xyz`` file of text points.

    Returns:
      xyz: (n, 3) float32, m, sensor frame; NaN and infinity are kept for the detector to count.
      intensity: (n,) float32, the file's own unit; 0 where the file has none.

    Raises:
      InputError: for another suffix, or as `read_bin` and `read_text_points`.
    """
    suffix = pathlib.Path(path).suffix.lower()
    if suffix not in POINT_SUFFIXES:
        raise InputError(f"{path}: not a known kind of points; give one of {', '.join(POINT_SUFFIXES)}.")
    return read_bin(path) if suffix == ".bin" else read_text_points(path)


def read_bin(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Reads KITTI's binary points: little-endian float32 x, y, z, intensity, and no header.

    Args:
      path: the file; an empty one is a sweep without points.

    Returns:
      xyz: (n, 3) float32, m, sensor frame.
      intensity: (n,) float32.

    Raises:
      InputError: where the file is missing, or its size is no multiple of 16 bytes.
    """
    data = read_bytes(path)
    if len(data) % _BYTES_PER_POINT:
        raise InputError(
            f"{path}: {len(data)} bytes is no multiple of {_BYTES_PER_POINT} (float32 x, y, z, intensity). "
            "Copy the file again if it was cut short, or convert it to four columns."
        )
    points = np.frombuffer(data, "<f4").astype(np.float32).reshape(-1, _VALUES_PER_POINT)
    return points[:, :3].copy(), points[:, 3].copy()


def write_bin(path: str | os.PathLike[str], xyz: np.ndarray, intensity: np.ndarray | None = None) -> None:
    """Writes KITTI's binary points.

    Args:
      path: the file; its folder is made where it is missing.
      xyz: (n, 3) real, m, sensor frame.
      intensity: (n,) real, or None for zeros.
    """
    points = np.zeros((len(xyz), _VALUES_PER_POINT), "<f4")
    points[:, :3] = xyz
    if intensity is not None:
        points[:, 3] = intensity
    with atomic_path(path) as temporary:
        temporary.write_bytes(points.tobytes())


def read_text_points(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Reads text points: ``x y z [intensity]`` a line, between them blanks or commas.

    Empty lines and lines that begin with ``#`` are skipped, and so is a first line of column names.
    Columns after the fourth are ignored.

    Args:
      path: the file; one without points is a sweep without points.

    Returns:
      xyz: (n, 3) float32, m, sensor frame.
      intensity: (n,) float32; 0 where there is no fourth column.

    Raises:
      InputError: naming file and line, for a line that is not numbers, or has fewer than three columns
        or another number than the first.
    """
    lines = read_text(path).replace(",", " ").splitlines()
    rows = [(number, line.split()) for number, line in enumerate(lines, start=1)]
    rows = [(number, words) for number, words in rows if words and not words[0].startswith("#")]
    if rows and _is_header(rows[0][1]):
        rows = rows[1:]
    if not rows:
        return np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    columns = len(rows[0][1])
    points = np.array([_parse_point(words, columns, f"{path}, line {number}") for number, words in rows])
    # A number beyond float32's range becomes infinite, and is counted by the detector.
    with np.errstate(over="ignore"):
        points = points.astype(np.float32)
    return points[:, :3].copy(), points[:, 3].copy()


def _is_header(words: list[str]) -> bool:
    return [word.strip('"').lower() for word in words[:3]] == ["x", "y", "z"]


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
