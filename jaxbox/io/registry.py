"""The formats of one sweep a file. A new one is a module with a `PointFormat`, and a line here.

Recordings, which hold many sweeps in one file, are listed in `jaxbox.io.sweeps`.
"""

import os
import pathlib

from jaxbox._files import InputError
from jaxbox.io.argoverse2 import FEATHER
from jaxbox.io.las import LAS
from jaxbox.io.npy import NPY, NPZ
from jaxbox.io.nuscenes import NUSCENES
from jaxbox.io.parquet_points import PARQUET_POINTS
from jaxbox.io.pcd import PCD
from jaxbox.io.ply import PLY
from jaxbox.io.points import BIN, PointFormat, Points, TimedPoints
from jaxbox.io.text_points import TEXT

POINT_FORMATS: tuple[PointFormat, ...] = (
    BIN,
    NUSCENES,
    PCD,
    PLY,
    LAS,
    NPY,
    NPZ,
    FEATHER,
    PARQUET_POINTS,
    TEXT,
)
"""Formats in the order in which a folder is searched for them."""

POINT_SUFFIXES: tuple[str, ...] = tuple(
    suffix for point_format in POINT_FORMATS for suffix in point_format.suffixes
)
"""Suffixes that `read_points` knows."""


def suffix_of(path: str | os.PathLike[str], suffixes: tuple[str, ...]) -> str | None:
    """The longest of some suffixes that a file's name ends in, or None.

    >>> suffix_of("LIDAR_TOP.PCD.BIN", (".bin", ".pcd.bin", ".pcd"))
    '.pcd.bin'
    """
    name = pathlib.Path(path).name.lower()
    return max((suffix for suffix in suffixes if name.endswith(suffix)), key=len, default=None)


def format_of(path: str | os.PathLike[str]) -> PointFormat | None:
    """The format that a file's name says, or None.

    >>> format_of("n015__LIDAR_TOP__1532402927647951.pcd.bin").name
    'nuScenes'
    """
    suffix = suffix_of(path, POINT_SUFFIXES)
    return next((f for f in POINT_FORMATS if suffix in f.suffixes), None)


def read_points(path: str | os.PathLike[str]) -> Points:
    """Reads one sweep, in the format that its suffix says.

    Args:
      path: a file of one of `POINT_FORMATS`.

    Returns:
      xyz: (n, 3) float32, m, sensor frame; NaN and infinity are kept for the detector to count.
      intensity: (n,) float32, the file's own unit; 0 where the file has none.

    Raises:
      InputError: for another suffix, or naming the file and the fix where it cannot be read.
      ImportError: naming the extra that the format needs, where that is not installed.
    """
    return _known_format(path).read(pathlib.Path(path))


def read_timed_points(path: str | os.PathLike[str]) -> TimedPoints:
    """Reads one sweep and when each of its points was measured, in the format that its suffix says.

    Args:
      path: a file of one of `POINT_FORMATS`.

    Returns:
      The points, without times where the file has none; see `jaxbox.io.point_times` for names and units.

    Raises:
      InputError: as `read_points`, and where the unit of the times is not clear.
      ImportError: naming the extra that the format needs, where that is not installed.
    """
    found = _known_format(path)
    if found.read_timed is None:
        return TimedPoints(*found.read(pathlib.Path(path)))
    return found.read_timed(pathlib.Path(path))


def _known_format(path: str | os.PathLike[str]) -> PointFormat:
    found = format_of(path)
    if found is None:
        raise InputError(
            f"{path}: not a known kind of points; give one of {', '.join(POINT_SUFFIXES)}, or a recording "
            "to open_sweeps."
        )
    return found
