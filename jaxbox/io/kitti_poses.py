"""Poses of KITTI's drives: its inertial and satellite navigation (oxts), and those of the odometry benchmark.

A line of oxts has latitude, longitude (deg), altitude (m), roll, pitch, yaw (rad) and 24 numbers more.
Positions are by the Mercator projection at the scale of the first latitude, as `convertOxtsToPose` of the raw
development kit has them: x = s r lon, y = s r ln tan(pi/4 + lat/2), s = cos(lat_0), r = 6378137 m. The world
is east, north and up from the first position.

Reference: Geiger, Lenz, Stiller, Urtasun, "Vision meets robotics: The KITTI dataset", IJRR 2013.
"""

import os
import pathlib
from collections.abc import Sequence

import numpy as np

from jaxbox._files import InputError, finite_number, read_text
from jaxbox.geometry.rigid import inverse_rigid
from jaxbox.io.kitti_calibration import read_raw_transform, read_transform
from jaxbox.io.pose_track import UnusableSource
from jaxbox.io.sweep import Sweep

EARTH_RADIUS_M = 6378137.0
"""As the development kit has it: the equator's."""

IMU_CALIBRATION_FILE = "calib_imu_to_velo.txt"
"""In a raw recording's folder of the day."""

_COLUMNS = 30
_USED = ("latitude", "longitude", "altitude", "roll", "pitch", "yaw")
_MAX_LATITUDE_DEG = 89.0
"""The projection has no poles."""


def read_oxts(path: str | os.PathLike[str]) -> np.ndarray:
    """Reads the navigation of a sequence of the tracking benchmark, one frame a line.

    Args:
      path: ``oxts/0000.txt``.

    Returns:
      (n, 4, 4) float64 T_world_imu, m; the world is east, north, up, from the first line's position.

    Raises:
      InputError: naming file and line, for other than 30 numbers, or one of the first six that is not finite.
    """
    lines = read_text(path).rstrip().splitlines()
    if not lines:
        raise InputError(f"{path}: it holds no pose.")
    return _project([_parse(line, f"{path}, line {number}") for number, line in enumerate(lines, start=1)])


def read_raw_oxts(paths: Sequence[pathlib.Path]) -> np.ndarray:
    """Reads the navigation of frames of a raw drive, one file a frame.

    Args:
      paths: ``oxts/data/*.txt``, at least one.

    Returns:
      As `read_oxts`; the world begins at the first frame's position.

    Raises:
      InputError: naming the file, where it is missing, or as `read_oxts`.
    """
    return _project([_parse(read_text(path), str(path)) for path in paths])


def _parse(line: str, where: str) -> list[float]:
    words = line.split()
    if len(words) != _COLUMNS:
        raise InputError(
            f"{where}: {len(words)} numbers; KITTI's oxts has {_COLUMNS} a frame. Copy the file again."
        )
    values = [finite_number(word, name, where) for word, name in zip(words, _USED, strict=False)]
    if abs(values[0]) > _MAX_LATITUDE_DEG:
        raise InputError(f"{where}: latitude is {values[0]:g}; it must be within {_MAX_LATITUDE_DEG:g} deg.")
    return values


def _project(rows: list[list[float]]) -> np.ndarray:
    """T_world_imu of latitude, longitude, altitude, roll, pitch and yaw."""
    latitude, longitude, altitude, roll, pitch, yaw = np.array(rows).T
    radius = EARTH_RADIUS_M * np.cos(np.radians(latitude[0]))
    # Taken from the first one before the projection: of 6000 km float64 would keep a nanometre as well.
    east = radius * np.radians(longitude - longitude[0])
    north = radius * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3] = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    T[:, :3, 3] = np.stack([east, north - north[0], altitude - altitude[0]], axis=1)
    return T


def _about(axis: int, angle: np.ndarray) -> np.ndarray:
    """Rotations about a coordinate axis, (n, 3, 3)."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    R = np.tile(np.eye(3), (len(angle), 1, 1))
    R[:, first, first] = R[:, second, second] = np.cos(angle)
    R[:, first, second], R[:, second, first] = -np.sin(angle), np.sin(angle)
    return R


def oxts_poses(sweeps: Sequence[Sweep]) -> tuple[np.ndarray, str] | None:
    """Poses of sweeps of a tracking sequence or a raw drive, by the navigation data next to them.

    Args:
      sweeps: of one sequence, at least one.

    Returns:
      (F, 4, 4) float64 T_world_velo, m, and the file or folder; None where the layout is another one, or has
      no navigation.

    Raises:
      InputError: naming file and line, where it is bad or ends before the sweeps do.
      UnusableSource: where there is no calibration from the IMU to the LiDAR.
    """
    first = sweeps[0]
    folder = first.points_path.parent
    if first.frame is not None and folder.parent.name == "velodyne":
        return _tracking_poses(sweeps, folder.parent.parent)
    if folder.name == "data" and folder.parent.name == "velodyne_points":
        return _raw_poses(sweeps, folder.parent.parent)
    return None


def _tracking_poses(sweeps: Sequence[Sweep], root: pathlib.Path) -> tuple[np.ndarray, str] | None:
    path = root / "oxts" / f"{sweeps[0].points_path.parent.name}.txt"
    if not path.is_file():
        return None
    if sweeps[0].calibration_path is None:
        raise UnusableSource(f"{path}: no calibration next to it says where the IMU is")
    T_velo_imu = read_transform(sweeps[0].calibration_path, "Tr_imu_to_velo", "Tr_imu_velo")
    T_world_imu = read_oxts(path)
    frames = np.array([sweep.frame or 0 for sweep in sweeps])
    if frames.max() >= len(T_world_imu):
        raise InputError(
            f"{path}: {len(T_world_imu)} lines, and {sweeps[int(frames.argmax())].name} needs line "
            f"{frames.max() + 1}. Copy the file again, or name another file of poses."
        )
    return T_world_imu[frames] @ inverse_rigid(T_velo_imu), str(path)


def _raw_poses(sweeps: Sequence[Sweep], drive: pathlib.Path) -> tuple[np.ndarray, str] | None:
    folder = drive / "oxts" / "data"
    if not folder.is_dir():
        return None
    calibration = drive.parent / IMU_CALIBRATION_FILE
    if not calibration.is_file():
        raise UnusableSource(f"{folder}: no {calibration.name} in {calibration.parent} says where the IMU is")
    T_world_imu = read_raw_oxts([folder / f"{sweep.points_path.stem}.txt" for sweep in sweeps])
    return T_world_imu @ inverse_rigid(read_raw_transform(calibration)), str(folder)


def odometry_pose_file(sweep: Sweep) -> pathlib.Path | None:
    """The file of poses of a sweep of the odometry benchmark, or of SemanticKITTI.

    Args:
      sweep: ``sequences/00/velodyne/000000.bin``.

    Returns:
      ``poses/00.txt`` next to ``sequences``, or the sequence's own ``poses.txt``; None where there is
      neither, or the layout is another one.
    """
    sequence = sweep.points_path.parent.parent
    if sweep.points_path.parent.name != "velodyne" or sequence.parent.name != "sequences":
        return None
    files = (sequence.parent.parent / "poses" / f"{sequence.name}.txt", sequence / "poses.txt")
    return next((file for file in files if file.is_file()), None)


def camera_from_velo(sweep: Sweep) -> np.ndarray | None:
    """Where the LiDAR is seen from the camera that KITTI's poses are of: the rectified left grey one.

    Args:
      sweep: of any of KITTI's layouts.

    Returns:
      (4, 4) float64 T_cam_velo, m; None where it has no calibration.

    Raises:
      InputError: where the calibration cannot be read.
    """
    of_sequence = sweep.points_path.parent.parent / "calib.txt"
    path = sweep.calibration_path
    if path is None:
        return read_transform(of_sequence, "Tr") if of_sequence.is_file() else None
    if path.is_dir():
        rectification = read_transform(path / "calib_cam_to_cam.txt", "R_rect_00")
        return rectification @ read_raw_transform(path / "calib_velo_to_cam.txt")
    return read_transform(path, "R0_rect", "R_rect") @ read_transform(path, "Tr_velo_to_cam", "Tr_velo_cam")


def sensor_poses(T_world_cam: np.ndarray, T_cam_velo: np.ndarray) -> np.ndarray:
    """The LiDAR's poses from those of the camera.

    The world of the camera's poses has y down; here it is the LiDAR's frame at the camera's origin, with z
    up.

    Args:
      T_world_cam: (F, 4, 4) float64, m.
      T_cam_velo: (4, 4) float64, m.

    Returns:
      (F, 4, 4) float64 T_world_velo, m.
    """
    return inverse_rigid(T_cam_velo) @ T_world_cam @ T_cam_velo
