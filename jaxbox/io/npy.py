"""NumPy's own files: an array of points in .npy, or the array of that name in .npz."""

import lzma
import math
import os
import pathlib
import tokenize
import warnings
import zipfile
import zlib
from typing import Any, BinaryIO

import numpy as np

from jaxbox._files import InputError, check_file, reason
from jaxbox._padding import MAX_COLUMNS
from jaxbox.io.point_times import TIME_NAMES, timed_reader
from jaxbox.io.points import (
    PointFormat,
    Points,
    check_num_points,
    check_unpacked,
    named_points,
)

ARRAY_NAMES = ("points", "xyz", "pointcloud", "data", "arr_0")
"""Arrays that are looked for in a .npz file of several, in this order; its only one needs no name."""

_COLUMNS = ("x", "y", "z", "intensity")
_READ_ERRORS = (
    ValueError, OSError, EOFError, KeyError, MemoryError, NotImplementedError, OverflowError, RuntimeError,
    SyntaxError, lzma.LZMAError, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What NumPy and its parsers raise on broken bytes. What they warn of, Python 2 and old names of types,
does no harm to the values."""


def read_npy(path: str | os.PathLike[str]) -> Points:
    """Reads a .npy file: (n, 3 or more) numbers x, y, z, intensity, or records with such fields.

    Args:
      path: the file.

    Returns:
      As `jaxbox.io.read_points`.

    Raises:
      InputError: where it is not such an array, or is cut short.
    """
    return named_points(_npy_columns(path), str(path))


def _npy_columns(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    check_file(path)
    try:
        # A map, so that a header that claims more than the file holds asks for no memory; and not
        # `np.load`, which takes archives and pickles too.
        with warnings.catch_warnings(action="ignore"):
            points = np.lib.format.open_memmap(path, mode="r")
    except _READ_ERRORS as error:
        if _is_empty_array(path):
            return {name: np.zeros(0, np.float32) for name in "xyz"}
        raise InputError(
            f"{path}: no readable .npy array ({reason(error)}); save it again with np.save."
        ) from error
    return _array_columns(points, str(path))


def _is_empty_array(path: str | os.PathLike[str]) -> bool:
    """Whether this is a whole file of an array without values, which cannot be mapped."""
    try:
        with pathlib.Path(path).open("rb") as file, warnings.catch_warnings(action="ignore"):
            return 0 in _read_header(file)[0]
    except _READ_ERRORS:
        return False


def read_npz(path: str | os.PathLike[str]) -> Points:
    """Reads a .npz file: its only array, or the one named points, xyz, pointcloud, data or arr_0.

    Arrays named x, y and z (and intensity) of n values each are taken too.

    Args:
      path: the file.

    Returns:
      As `jaxbox.io.read_points`.

    Raises:
      InputError: where it is not such a file, or holds no such array.
    """
    return named_points(_npz_columns(path), str(path))


def _npz_columns(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    check_file(path)
    try:
        with (
            warnings.catch_warnings(action="ignore"),
            pathlib.Path(path).open("rb") as file,
            np.load(file, allow_pickle=False) as arrays,
        ):
            if {"x", "y", "z"} <= set(arrays.files):
                names = [name for name in (*_COLUMNS, *TIME_NAMES) if name in arrays.files]
            else:
                names = [_array_name(arrays.files, str(path))]
            for name in names:
                _check_member(arrays.zip, f"{name}.npy", str(path))
            found = {name: arrays[name] for name in names}
    except InputError:
        raise
    # A file of another kind is not an archive, which shows as the lack of an attribute, or of a context.
    except (*_READ_ERRORS, AttributeError, TypeError) as error:
        raise InputError(
            f"{path}: no readable .npz file ({reason(error)}); save it again with np.savez."
        ) from error
    if len(found) > 1:
        return found
    return _array_columns(next(iter(found.values())), str(path))


def _array_name(names: list[str], where: str) -> str:
    if len(names) == 1:
        return names[0]
    for name in ARRAY_NAMES:
        if name in names:
            return name
    raise InputError(
        f"{where}: holds {', '.join(names) or 'no array'}; name the points one of {', '.join(ARRAY_NAMES)}."
    )


def _check_member(archive: Any, member: str, where: str) -> None:
    """Refuses an array larger than what the archive says it unpacks to."""
    with archive.open(member) as file:
        shape, dtype = _read_header(file)
    num_bytes = math.prod(shape) * dtype.itemsize
    check_unpacked(num_bytes, where)
    if num_bytes > archive.getinfo(member).file_size:
        raise InputError(f"{where}: {member} claims the shape {shape}, more than is there; save it again.")


def _read_header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of an array."""
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in read:
        raise ValueError(f"version {version} of the format")
    shape, _, dtype = read[version](file)
    return shape, dtype


def _array_columns(points: np.ndarray, where: str) -> dict[str, np.ndarray]:
    check_num_points(len(points) if points.ndim else 0, where)
    if points.dtype.names and points.ndim == 1:
        return {name: points[name] for name in points.dtype.names}
    if points.ndim != 2 or points.shape[1] < len("xyz") or points.dtype.kind not in "fiu":
        raise InputError(
            f"{where}: the array is {points.dtype} of shape {points.shape}; points are (n, 3 or more) real "
            "numbers: x, y, z, intensity."
        )
    if points.shape[1] > MAX_COLUMNS:
        raise InputError(
            f"{where}: the array has shape {points.shape}, and points are rows of x, y, z, intensity: save "
            "it transposed, points.T."
        )
    return dict(zip(_COLUMNS, points.T, strict=False))


NPY = PointFormat(
    name="NumPy array", suffixes=(".npy",), read=read_npy, read_timed=timed_reader(_npy_columns)
)
NPZ = PointFormat(
    name="NumPy archive", suffixes=(".npz",), read=read_npz, read_timed=timed_reader(_npz_columns)
)
