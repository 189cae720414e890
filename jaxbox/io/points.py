"""Points as the formats share them, and KITTI's binary, the format without a header."""

import dataclasses
import os
import pathlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, BinaryIO, Protocol

import numpy as np

from jaxbox._files import MAX_SWEEP_BYTES, InputError, atomic_path, read_bytes, reason
from jaxbox.io.columns import told_columns

_VALUES_PER_POINT = 4
_BYTES_PER_POINT = _VALUES_PER_POINT * np.dtype("<f4").itemsize

Points = tuple[np.ndarray, np.ndarray]
"""xyz (n, 3) float32, m, and intensity (n,) float32."""

MAX_POINTS = 2**24
"""Sixteen times the largest capacity; a file that claims more is broken, and is refused before it is read."""

INTENSITY_NAMES = ("intensity", "reflectivity", "reflectance", "remission", "scalar_intensity", "i")
"""Names that the formats give to the strength of a return; the first that is there is taken."""


@dataclasses.dataclass(frozen=True)
class TimedPoints:
    """The points of one sweep, and when each was measured."""

    xyz: np.ndarray
    """(n, 3) float32, m, sensor frame; NaN and infinity are kept."""
    intensity: np.ndarray
    """(n,) float32, the file's own unit; 0 where unknown."""
    time_s: np.ndarray | None = None
    """(n,) float64, s from the sweep's own time, or from its first point where the points' clock is another
    one; None where the source does not say."""
    is_compensated: bool = False
    """Whether the source has removed the sensor's own motion, as Argoverse 2 has: then it is not to be
    removed again."""


class RecordedPoints(Protocol):
    """The points of one message of a recording, decoded when they are asked for."""

    def __call__(self) -> Points:
        """Decodes the points."""
        ...

    def timed(self) -> TimedPoints:
        """Decodes the points, and when each was measured."""
        ...

    def header(self) -> tuple[int, str]:
        """The time by the message's own header, ns since 1970 or 0, and the name of the points' frame."""
        ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointFormat:
    """A kind of file that holds one sweep."""

    name: str
    """In words, for the documentation and errors."""
    suffixes: tuple[str, ...]
    """Lower-case ends of its file names."""
    read: Callable[[pathlib.Path], Points]
    """Reads a file, as `jaxbox.io.read_points`."""
    read_timed: Callable[[pathlib.Path], TimedPoints] | None = None
    """Reads a file, as `jaxbox.io.read_timed_points`; None where the format has no times of points."""
    timestamp_ns: Callable[[pathlib.Path], int | None] = lambda _: None
    """When the sweep of a file was taken, ns since 1970, as far as the file's name says; None where it
    does not."""


def named_points(columns: Mapping[str, np.ndarray], where: str) -> Points:
    """Picks coordinates and intensity out of named columns.

    Args:
      columns: n values each; names in any case.
      where: the file, for the error.

    Returns:
      As `jaxbox.io.read_points`.

    Raises:
      InputError: where x, y or z is missing or is not a number, or fields have different numbers of values.
    """
    known = {name.lower(): values for name, values in columns.items()}
    if missing := [name for name in "xyz" if name not in known]:
        raise InputError(
            f"{where}: no field {' or '.join(missing)} among {', '.join(columns) or 'none'}; "
            "points need x, y and z. Rename the fields, or convert the file."
        )
    if wrong := [name for name in "xyz" if known[name].dtype.kind not in "fiu" or known[name].ndim != 1]:
        raise InputError(f"{where}: field {wrong[0]} is not one real number a point.")
    fields = {name: known[name] for name in "xyz"}
    intensity = next((known[name] for name in INTENSITY_NAMES if name in known), None)
    if intensity is None or intensity.dtype.kind not in "fiu" or intensity.ndim != 1:
        intensity = np.zeros(len(known["x"]), np.float32)
    fields["intensity"] = intensity
    if len({len(values) for values in fields.values()}) > 1:
        sizes = ", ".join(f"{len(values)} of {name}" for name, values in fields.items())
        raise InputError(f"{where}: {sizes}; each point needs one of each. Save them again.")
    # A number beyond float32's range becomes infinite, and is counted by the detector, as NaN of any kind.
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z, intensity = (values.astype(np.float32) for values in fields.values())
    return np.stack([x, y, z], axis=1), intensity


def seen_from(place: Sequence[float] | np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """Points from the place of a sensor with the same axes.

    Args:
      place: x, y and z, m.
      xyz: (n, 3) float32, m.

    Returns:
      (n, 3) float32, m.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return xyz - np.asarray(place, np.float32)


def record_dtype(layout: Mapping[str, Any], where: str) -> np.dtype:
    """The type of a point, from names, formats, offsets and itemsize.

    Args:
      layout: as `numpy.dtype` takes it.
      where: the message, for the error.

    Returns:
      The type.

    Raises:
      InputError: where NumPy knows no such type, as of points of gigabytes.
    """
    try:
        # NumPy checks the names and types of the layout itself.
        return np.dtype(dict(layout))  # pyright: ignore[reportArgumentType, reportCallIssue]
    except (ValueError, TypeError) as error:
        raise InputError(f"{where}: the layout of a point makes no sense ({reason(error)}).") from error


def check_num_points(claimed: int, where: str) -> None:
    """Refuses what cannot be the size of a sweep, before memory is asked for.

    Args:
      claimed: number of points that a header claims.
      where: the file, for the error.

    Raises:
      InputError: for a negative number, or more than `MAX_POINTS`.
    """
    if not 0 <= claimed <= MAX_POINTS:
        raise InputError(
            f"{where}: the header claims {claimed} points; a sweep has at most {MAX_POINTS}. "
            "The file is damaged: copy or convert it again."
        )


def check_unpacked(num_bytes: int, where: str) -> None:
    """Refuses what would unpack to more than any sweep takes, before it is unpacked.

    Args:
      num_bytes: unpacked, as far as is known.
      where: the file, for the error.

    Raises:
      InputError: for more than `MAX_SWEEP_BYTES`.
    """
    if num_bytes > MAX_SWEEP_BYTES:
        raise InputError(
            f"{where}: it unpacks to {num_bytes} bytes or more; at most {MAX_SWEEP_BYTES} are read. "
            "The file is damaged, or made to fill the memory."
        )


def check_num_bytes(needed: int, there: int, where: str) -> None:
    """Refuses a body that is shorter than its header says.

    Args:
      needed: bytes that the header's points take.
      there: bytes that follow the header.
      where: the file, for the error.

    Raises:
      InputError: where some are missing.
    """
    if there < needed:
        raise InputError(
            f"{where}: {there} bytes of points, and the header promises {needed}. "
            "The file was cut short: copy it again."
        )


def read_number_lines(file: BinaryIO, count: int, columns: int, where: str) -> np.ndarray:
    """Reads lines of numbers, as the text bodies of PCD and PLY are.

    Args:
      file: where the lines begin.
      count: lines that the header promises.
      columns: numbers a line.
      where: the file, for the error.

    Returns:
      (count, columns) float64.

    Raises:
      InputError: for other lines than these.
    """
    if count == 0:
        return np.zeros((0, columns))
    try:
        with warnings.catch_warnings():
            # That there are none is an error here.
            warnings.simplefilter("ignore")
            rows = np.loadtxt(file, ndmin=2, max_rows=count)
    except ValueError as error:
        raise InputError(
            f"{where}: {reason(error)}; each line of a point needs {columns} numbers."
        ) from error
    if rows.shape != (count, columns):
        raise InputError(
            f"{where}: {rows.shape[0]} lines of {rows.shape[1]} numbers; the header promises {count} of "
            f"{columns}. Copy the file again if it was cut short."
        )
    return rows


def read_bin(path: str | os.PathLike[str], *, columns: int | None = None) -> Points:
    """Reads KITTI's binary points: little-endian float32 x, y, z, intensity, and no header.

    Args:
      path: the file; an empty one is a sweep without points.
      columns: values a point, 4 or more, of which the first four are used; None to tell 4, 5 and 6 by the
        numbers themselves, see `jaxbox.io.columns`.

    Returns:
      xyz: (n, 3) float32, m, sensor frame.
      intensity: (n,) float32.

    Raises:
      InputError: where the file is missing, its size is no whole number of points, or the number of columns
        is not clear.
    """
    points = read_float_rows(path, columns, "x, y, z, intensity, ...")
    return points[:, :3], points[:, 3]


def read_float_rows(path: str | os.PathLike[str], columns: int | None, names: str) -> np.ndarray:
    """Reads rows of little-endian float32 without a header.

    Args:
      path: the file; an empty one has no rows.
      columns: values a row; None to tell it by the numbers.
      names: of the columns, for the error.

    Returns:
      (n, columns) float32.

    Raises:
      InputError: where the file is missing, or its size is not a whole number of rows.
    """
    data = read_bytes(path)
    if columns is None:
        columns = told_columns(data, path)
    row = columns * np.dtype("<f4").itemsize
    if len(data) % row:
        raise InputError(
            f"{path}: {len(data)} bytes is not a multiple of {row} (float32 {names}). "
            f"Copy the file again if it was cut short, or convert it to {columns} columns."
        )
    return np.frombuffer(data, "<f4").astype(np.float32).reshape(-1, columns)


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


BIN = PointFormat(name="KITTI binary", suffixes=(".bin",), read=read_bin)
