"""Argoverse 2 sensor data: sweeps, annotated boxes and ground flags.

Sweeps are read as the data set has them, Feather tables named by their time, and as they come from plain
copies: x, y, z and intensity as KITTI's binary points. Annotations are a JSON list of records with the
table's own column names, ground flags one byte a point.

All of them are in the vehicle's frame, whose origin is the middle of the rear axle. What a beam passed
through on its way can only be told from the sensor, so everything is moved to the upper LiDAR's frame.

Reference: Wilson et al., "Argoverse 2: Next generation datasets for self-driving perception and
forecasting", NeurIPS Datasets and Benchmarks 2021.
"""

import dataclasses
import os
import pathlib
import struct
from typing import Any

import numpy as np

from jaxbox._extras import require
from jaxbox._files import InputError, parse_json, read_bytes, read_text, reason
from jaxbox.io._arrow_sizes import unpacked_bytes
from jaxbox.io.labelled import LabelledBoxes, check_count, finite_number, labelled_boxes
from jaxbox.io.point_times import TIME_NAMES, timed_points
from jaxbox.io.points import (
    PointFormat,
    Points,
    TimedPoints,
    check_num_points,
    check_unpacked,
    named_points,
    read_bin,
    seen_from,
)

SENSOR_XYZ_M = (1.35, 0.0, 1.64)
"""The upper LiDAR in the vehicle's frame; cars of the fleet differ by centimetres."""

CAR_CLASSES = frozenset({"REGULAR_VEHICLE"})
"""Cars, with vans and pickups: the data set does not tell them apart."""

VEHICLE_CLASSES = CAR_CLASSES | {
    "ARTICULATED_BUS", "BOX_TRUCK", "BUS", "LARGE_VEHICLE", "MESSAGE_BOARD_TRAILER", "SCHOOL_BUS", "TRUCK",
    "TRUCK_CAB", "VEHICULAR_TRAILER",
}  # fmt: skip
"""Everything on four wheels or more."""

_CENTER = ("tx_m", "ty_m", "tz_m")
_SIZE = ("length_m", "width_m", "height_m")
_ROTATION = ("qw", "qx", "qy", "qz")
_MIN_NORM = 0.5
_COLUMNS = ("x", "y", "z", "intensity")
_OFFSET = "offset_ns"
"""The data set's own name for the time of a point."""


def read_argoverse2_points(
    path: str | os.PathLike[str], *, sensor_xyz_m: tuple[float, float, float] = SENSOR_XYZ_M
) -> tuple[np.ndarray, np.ndarray]:
    """Reads a sweep and moves it to the sensor.

    Args:
      path: float32 x, y, z, intensity in the vehicle's frame, as `read_bin`.
      sensor_xyz_m: where the sensor is in that frame.

    Returns:
      xyz: (n, 3) float32, m, sensor frame.
      intensity: (n,) float32, 0 to 255.

    Raises:
      InputError: as `read_bin`.
    """
    xyz, intensity = read_bin(path)
    return seen_from(sensor_xyz_m, xyz), intensity


def read_feather(path: str | os.PathLike[str]) -> Points:
    """Reads a Feather table of points, and moves a sweep of a calibrated log to the sensor.

    A sweep of the data set as it comes, ``LOG/sensors/lidar/*.feather``, is in the vehicle's frame; the upper
    LiDAR's place is taken from ``LOG/calibration/egovehicle_SE3_sensor.feather``. Any other table, or one
    whose log has no calibration, is taken as it is.

    Args:
      path: a Feather table with x, y and z.

    Returns:
      As `jaxbox.io.read_points`.

    Raises:
      InputError: where it is not such a table.
      ImportError: without the extra ``arrow``.
    """
    xyz, intensity = named_points(read_table(path, _COLUMNS), str(path))
    return seen_from(log_sensor_xyz_m(path), xyz), intensity


def read_timed_feather(path: str | os.PathLike[str]) -> TimedPoints:
    """Reads a Feather table as `read_feather`, with the times of its points.

    Args:
      path: as `read_feather`; the data set's own tables have a column ``offset_ns``, from the time in the
        file's name, and their points have been compensated for the motion.

    Returns:
      The points; "We have egomotion-compensated the lidar sensor data to the egovehicle reference timestamp"
      (the data set's own library, on its sweeps).

    Raises:
      InputError: as `read_feather`, and where the unit of the times is not clear.
      ImportError: without the extra ``arrow``.
    """
    columns = read_table(path, (*_COLUMNS, *TIME_NAMES))
    points = timed_points(columns, str(path))
    xyz = seen_from(log_sensor_xyz_m(path), points.xyz)
    return dataclasses.replace(points, xyz=xyz, is_compensated=_OFFSET in columns)


def log_sensor_xyz_m(path: str | os.PathLike[str]) -> np.ndarray:
    """Where the upper LiDAR is in the frame of a table's points.

    Args:
      path: a table, ``LOG/sensors/lidar/*.feather`` where it is a sweep of the data set.

    Returns:
      (3,) float64, m: by the log's calibration, or the origin where there is none.

    Raises:
      InputError: where there is a calibration that cannot be read.
      ImportError: without the extra ``arrow``.
    """
    folder = pathlib.Path(os.path.abspath(path)).parent
    if (folder.parent.name, folder.name) != ("sensors", "lidar"):
        return np.zeros(3)
    file = folder.parents[1] / "calibration" / "egovehicle_SE3_sensor.feather"
    return _sensor_xyz_m(file) if file.is_file() else np.zeros(3)


def _sensor_xyz_m(path: pathlib.Path) -> np.ndarray:
    table = read_table(path, ("sensor_name", *_CENTER))
    rows = [i for i, name in enumerate(table.get("sensor_name", [])) if name == "up_lidar"]
    if not rows or any(name not in table for name in _CENTER):
        raise InputError(f"{path}: no row up_lidar with tx_m, ty_m, tz_m; restore the file, or remove it.")
    return np.array([table[name][rows[0]] for name in _CENTER], float)


def read_table(path: str | os.PathLike[str], columns: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Reads those of the columns that a Feather table has.

    Args:
      path: the table.
      columns: names.

    Returns:
      The columns that are there.

    Raises:
      InputError: where it is not such a table.
      ImportError: without the extra ``arrow``.
    """
    arrow = require("pyarrow", extra="arrow", what="Feather files")
    data = read_bytes(path)
    try:
        check_unpacked(unpacked_bytes(data), str(path))
        names = arrow.ipc.open_file(data).schema.names
        wanted = [index for index, name in enumerate(names) if name in columns]
        options = arrow.ipc.IpcReadOptions(included_fields=wanted, use_threads=False)
        table = arrow.ipc.open_file(data, options=options).read_all()
        check_num_points(table.num_rows, str(path))
        # Arrow believes the offsets within a column, and would read wherever they point.
        table.validate(full=True)
        return {name: table[name].to_numpy() for name in table.column_names}
    except InputError:
        raise
    # A type that is not known is a KeyError or NotImplementedError, and a name may be no text.
    except (
        arrow.ArrowException,
        struct.error,
        OSError,
        ValueError,
        LookupError,
        NotImplementedError,
    ) as error:
        raise InputError(f"{path}: no readable Feather table ({reason(error)}); copy it again.") from error


def feather_timestamp_ns(path: pathlib.Path) -> int | None:
    """The time in a file's name.

    >>> feather_timestamp_ns(pathlib.Path("315966265259836000.feather"))
    315966265259836000
    """
    return int(path.stem) if path.stem.isdecimal() else None


def read_argoverse2_boxes(
    path: str | os.PathLike[str], *, sensor_xyz_m: tuple[float, float, float] = SENSOR_XYZ_M
) -> LabelledBoxes:
    """Reads the annotations of one sweep and moves them to the sensor.

    Args:
      path: a JSON list of records with category, tx_m, ty_m, tz_m, length_m, width_m, height_m and the
        rotation qw, qx, qy, qz; other fields are ignored.
      sensor_xyz_m: where the sensor is in the vehicle's frame.

    Returns:
      The boxes, in the file's order.

    Raises:
      InputError: naming file and entry, where it is not such a list, or a field is missing or no number.
    """
    entries = _read_records(path)
    named = [(entry, f"{path}, entry {index}") for index, entry in enumerate(entries)]
    rotation = np.array([_rotation(*item) for item in named]).reshape(-1, 4)
    w, x, y, z = rotation.T
    return labelled_boxes(
        [_category(*item) for item in named],
        np.array([_fields(*item, _CENTER) for item in named]).reshape(-1, 3) - sensor_xyz_m,
        np.array([_fields(*item, _SIZE) for item in named]),
        # The turn about z of a rotation quaternion; boxes stand upright.
        np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)),
    )


def read_argoverse2_ground(path: str | os.PathLike[str], *, num_points: int | None = None) -> np.ndarray:
    """Reads which points are on the ground of the data set's map.

    Args:
      path: one byte a point, 1 for ground and 0 for not.
      num_points: points of the sweep, to check that the two belong together.

    Returns:
      (n,) bool.

    Raises:
      InputError: for another number of bytes, or a byte that is neither 0 nor 1.
    """
    flags = np.frombuffer(read_bytes(path), np.uint8)
    check_count(path, len(flags), num_points, what="ground flags")
    if flags.size and flags.max() > 1:
        raise InputError(f"{path}: byte {int(np.argmax(flags > 1))} is {flags.max()}; flags are 0 or 1.")
    return flags.astype(bool)


def _read_records(path: str | os.PathLike[str]) -> list[Any]:
    entries = parse_json(read_text(path), str(path))
    if not isinstance(entries, list):
        raise InputError(f"{path}: holds no list; give the annotations as a JSON list of records.")
    return entries


def _category(entry: Any, where: str) -> str:
    name = entry.get("category") if isinstance(entry, dict) else None
    if not isinstance(name, str):
        raise InputError(f"{where}: category is {name!r}; it must be a class name such as REGULAR_VEHICLE.")
    return name


def _fields(entry: Any, where: str, names: tuple[str, ...]) -> list[float]:
    values = entry if isinstance(entry, dict) else {}
    return [finite_number(values.get(name), name, where) for name in names]


def _rotation(entry: Any, where: str) -> np.ndarray:
    rotation = np.array(_fields(entry, where, _ROTATION))
    norm = np.linalg.norm(rotation)
    if norm < _MIN_NORM:
        raise InputError(f"{where}: qw, qx, qy, qz are {rotation.tolist()}; a rotation has length 1.")
    return rotation / norm


FEATHER = PointFormat(
    name="Argoverse 2",
    suffixes=(".feather",),
    read=read_feather,
    read_timed=read_timed_feather,
    timestamp_ns=feather_timestamp_ns,
)
