"""LAS and LAZ, the survey formats, by way of laspy: for sweeps that were saved in their sensor's frame."""

import os

import numpy as np

from jaxbox.io._extras import require
from jaxbox.io._files import InputError
from jaxbox.io.points import PointFormat, Points, check_num_bytes, check_num_points, named_points

MAP_DISTANCE_M = 10_000.0
"""Points whose median is farther from the origin than this are on a map, not round a sensor."""


def read_las(path: str | os.PathLike[str]) -> Points:
    """Reads a LAS or LAZ file, scaled and offset as its header says.

    Args:
      path: the file.

    Returns:
      As `jaxbox.io.read_points`.

    Raises:
      InputError: where it is no such file, is cut short, or holds map coordinates.
      ImportError: without the extra ``las``.
    """
    laspy = require("laspy", extra="las", what="LAS and LAZ files")
    try:
        size = os.stat(path).st_size
        with laspy.open(path) as reader:
            header = reader.header
            check_num_points(header.point_count, str(path))
            if not header.are_points_compressed:
                needed = header.point_count * header.point_format.size
                check_num_bytes(needed, size - header.offset_to_point_data, str(path))
            points = reader.read()
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file; check the path.") from error
    except InputError:
        raise
    # laspy and its decoders raise whatever the bytes lead them to; lazrs even its own Rust errors.
    except Exception as error:
        raise InputError(f"{path}: no readable LAS or LAZ file ({error}); copy it again.") from error
    columns = {name: np.asarray(getattr(points, name)) for name in ("x", "y", "z", "intensity")}
    _check_frame(columns, str(path))
    return named_points(columns, str(path))


def _check_frame(columns: dict[str, np.ndarray], where: str) -> None:
    for name in "xy":
        middle = float(np.median(columns[name])) if len(columns[name]) else 0.0
        if abs(middle) > MAP_DISTANCE_M:
            raise InputError(
                f"{where}: {name} is about {middle:.0f} m: these are map coordinates. Subtract the sensor's "
                "position first: the detector looks from the origin."
            )


LAS = PointFormat(name="LAS and LAZ", suffixes=(".las", ".laz"), read=read_las)
