"""KITTI's calibration files: of the object and tracking benchmarks, and of raw recordings.

Reference: Geiger, Lenz, Urtasun, "Are we ready for autonomous driving?", CVPR 2012, and the readme
files of the object, tracking and raw development kits.
"""

import math
import os
import pathlib

import jax.numpy as jnp
import numpy as np

from jaxbox._files import InputError, atomic_writer, finite_number, read_text
from jaxbox.geometry.projection import check_full_rank, compose_transforms, rigid_transform
from jaxbox.tracking.poses import check_pose, orthonormal_pose
from jaxbox.types import Calibration

IMAGE_SIZE_PX = (1242, 375)
"""Width and height of most rectified images, for sweeps that come without one."""

CAMERA = 2
"""The left colour camera, in whose image the object and tracking labels are."""

RAW_CALIBRATION_FILES = ("calib_velo_to_cam.txt", "calib_cam_to_cam.txt")
"""In a raw recording's folder of the day."""

_ROTATION_VALUES = 9
_MAX_VALUE = 1e9
"""Products of three values have to stay within float32's range."""


def read_calibration(
    path: str | os.PathLike[str], *, camera: int = CAMERA, image_size_px: tuple[int, int] = IMAGE_SIZE_PX
) -> Calibration:
    """Reads an object or tracking ``calib/*.txt`` (the two spell two of the keys differently).

    Args:
      path: the file.
      camera: 0 to 3, whose P matrix is taken.
      image_size_px: width and height, which the file does not hold.

    Returns:
      The camera, with T_rect_velo = R0_rect Tr_velo_to_cam.

    Raises:
      InputError: naming file and key, where one is missing, has a wrong number of values or a value
        that is not a finite number, or a matrix is singular.
    """
    entries = _read_entries(path)
    rectification = _matrix(entries, ("R0_rect", "R_rect"), (3, 3), path)
    extrinsics = _matrix(entries, ("Tr_velo_to_cam", "Tr_velo_cam"), (3, 4), path)
    projection = _matrix(entries, (f"P{camera}",), (3, 4), path)
    return _calibration(projection, rectification, extrinsics, image_size_px, path)


def write_calibration(
    path: str | os.PathLike[str], calibration: Calibration, *, camera: int = CAMERA
) -> None:
    """Writes a calibration as KITTI's ``calib/*.txt``, whole or not at all.

    Args:
      path: the file; its folder is made where it is missing.
      calibration: its T_rect_velo is written as Tr_velo_to_cam, next to the identity as rectification.
      camera: 0 to 3.
    """
    rows = {
        f"P{camera}": np.asarray(calibration.P_rect),
        "R0_rect": np.eye(3),
        "Tr_velo_to_cam": np.asarray(calibration.T_rect_velo)[:3],
    }
    with atomic_writer(path) as handle:
        handle.writelines(f"{key}: {' '.join(f'{v:.9e}' for v in m.ravel())}\n" for key, m in rows.items())


def read_raw_calibration(
    folder: str | os.PathLike[str],
    *,
    camera: int = CAMERA,
    image_size_px: tuple[int, int] | None = None,
) -> Calibration:
    """Reads a raw recording's ``calib_velo_to_cam.txt`` and ``calib_cam_to_cam.txt``.

    Args:
      folder: the day's folder, which holds both.
      camera: 0 to 3.
      image_size_px: width and height; None takes the file's ``S_rect``.

    Returns:
      The camera, with T_rect_velo = R_rect_00 T_velo_to_cam: all cameras are rectified to camera 0.

    Raises:
      InputError: as `read_calibration`.
    """
    velo_path, cam_path = (pathlib.Path(folder) / name for name in RAW_CALIBRATION_FILES)
    velo, cam = _read_entries(velo_path), _read_entries(cam_path)
    rotation = _matrix(velo, ("R",), (3, 3), velo_path)
    translation = _matrix(velo, ("T",), (3, 1), velo_path)
    rectification = _matrix(cam, ("R_rect_00",), (3, 3), cam_path)
    projection = _matrix(cam, (f"P_rect_{camera:02d}",), (3, 4), cam_path)
    if image_size_px is None:
        width, height = _matrix(cam, (f"S_rect_{camera:02d}",), (2,), cam_path)
        image_size_px = (int(width), int(height))
    extrinsics = np.hstack([rotation, translation])
    return _calibration(projection, rectification, extrinsics, image_size_px, folder)


def read_transform(path: str | os.PathLike[str], *spellings: str) -> np.ndarray:
    """Reads one rigid transform of a calibration file, in float64.

    Args:
      path: an object, tracking or odometry calibration, or ``calib_cam_to_cam.txt``.
      spellings: of its key, such as Tr_velo_to_cam; nine numbers are a rotation.

    Returns:
      (4, 4) float64, m.

    Raises:
      InputError: naming file and key, where it is missing, or no rigid transform.
    """
    entries = _read_entries(path)
    key = next((spelling for spelling in spellings if spelling in entries), "")
    is_rotation = len(entries.get(key, ())) == _ROTATION_VALUES
    matrix = _matrix(entries, spellings, (3, 3) if is_rotation else (3, 4), path)
    return _rigid(matrix[:, :3], np.zeros(3) if is_rotation else matrix[:, 3], f"{path}, {key}")


def read_raw_transform(path: str | os.PathLike[str]) -> np.ndarray:
    """Reads ``calib_velo_to_cam.txt`` or ``calib_imu_to_velo.txt`` of a raw recording, in float64.

    Args:
      path: the file.

    Returns:
      (4, 4) float64, m: T_cam_velo or T_velo_imu.

    Raises:
      InputError: as `read_transform`.
    """
    entries = _read_entries(path)
    R, t = _matrix(entries, ("R",), (3, 3), path), _matrix(entries, ("T",), (3,), path)
    return _rigid(R, t, str(path))


def _rigid(R: np.ndarray, t: np.ndarray, where: str) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    if problem := check_pose(T):
        raise InputError(f"{where}: no rigid transform: {problem}. Give KITTI's calibration file.")
    return orthonormal_pose(T)


def _read_entries(path: str | os.PathLike[str]) -> dict[str, list[str]]:
    """Words after each line's key; the tracking files write some keys without the colon."""
    lines = (line.split() for line in read_text(path).splitlines())
    return {words[0].rstrip(":"): words[1:] for words in lines if words}


def _matrix(
    entries: dict[str, list[str]],
    spellings: tuple[str, ...],
    shape: tuple[int, ...],
    path: str | os.PathLike[str],
) -> np.ndarray:
    key = next((spelling for spelling in spellings if spelling in entries), None)
    if key is None:
        present = ", ".join(entries) or "nothing"
        raise InputError(
            f"{path}: no key {' or '.join(spellings)}; it holds {present}. Give KITTI's calibration file."
        )
    words = entries[key]
    if len(words) != math.prod(shape):
        raise InputError(f"{path}: {key} has {len(words)} values; it must have {math.prod(shape)}.")
    values = np.array([finite_number(word, key, str(path)) for word in words]).reshape(shape)
    if np.abs(values).max() > _MAX_VALUE:
        raise InputError(f"{path}: {key} holds {np.abs(values).max():g}, which no camera has.")
    return values


def _calibration(
    projection: np.ndarray,
    rectification: np.ndarray,
    extrinsics: np.ndarray,
    image_size_px: tuple[int, int],
    path: str | os.PathLike[str],
) -> Calibration:
    T_rect_cam = rigid_transform(jnp.asarray(rectification), jnp.zeros(3))
    T_cam_velo = rigid_transform(jnp.asarray(extrinsics[:, :3]), jnp.asarray(extrinsics[:, 3]))
    try:
        check_full_rank(np.asarray(T_rect_cam), "the rectifying rotation")
        check_full_rank(np.asarray(T_cam_velo), "the LiDAR-to-camera transform")
        check_full_rank(projection[:, :3], "the camera matrix")
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    return Calibration(
        P_rect=jnp.asarray(projection, jnp.float32),
        T_rect_velo=compose_transforms(T_rect_cam, T_cam_velo),
        image_size_px=jnp.asarray(image_size_px, jnp.int32),
    )
