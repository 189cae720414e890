"""Text files of poses: KITTI's 12 numbers a line, TUM's 8, or whole matrices of 16.

- 12: the upper three rows of T, row by row, as of KITTI's odometry benchmark; a line is a frame.
- 8: ``timestamp tx ty tz qx qy qz qw``, seconds and metres, as of TUM's RGB-D benchmark.
- 16: T, row by row.

References: Geiger, Lenz, Urtasun, "Are we ready for autonomous driving?", CVPR 2012; Sturm et al., "A
benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

import dataclasses
import enum
import os

import numpy as np

from jaxbox._files import InputError, finite_number, read_text
from jaxbox.geometry.rigid import rigid_from_quaternion
from jaxbox.tracking.poses import ROTATION_TOLERANCE, check_pose, orthonormal_pose

KITTI_COLUMNS, TUM_COLUMNS, MATRIX_COLUMNS = 12, 8, 16
_KINDS = {KITTI_COLUMNS: "KITTI", TUM_COLUMNS: "TUM", MATRIX_COLUMNS: "4 x 4 matrices"}
_NS_PER_S = 1e9
_CLOCK_NS = 1e17
"""Times beyond this are nanoseconds since 1970, whatever the format says."""
_MAX_TIME_NS = 9.2e18
_MAX_POSITION_M = 1e9
"""Farther than any place on earth from any other."""


class PoseFrame(enum.StrEnum):
    """Whose poses a file holds."""

    SENSOR = "sensor"
    """The LiDAR's, in the frame of its points."""
    CAMERA = "camera"
    """KITTI's left grey camera's, x right and z forward."""


@dataclasses.dataclass(frozen=True)
class PoseFile:
    """What a file of poses holds."""

    T: np.ndarray
    """(M, 4, 4) float64, m, one a line."""
    columns: int
    """Numbers a line: 8, 12 or 16."""
    times_ns: np.ndarray | None
    """(M,) int64, ns; None where the format has no times."""

    @property
    def kind(self) -> str:
        """The format in words."""
        return _KINDS[self.columns]


def read_pose_file(path: str | os.PathLike[str]) -> PoseFile:
    """Reads a text file of poses; the format is known by the numbers a line.

    Args:
      path: text; blanks or commas between the numbers; empty lines and what follows a "#" are skipped.

    Returns:
      The poses, whose rotations are made orthonormal.

    Raises:
      InputError: naming file and line, for another number of columns, a number that is not finite, or a pose
        that is no rigid transform; and for a file without poses.
    """
    poses, times, columns = [], [], 0
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        where = f"{path}, line {number}"
        columns = columns or len(words)
        if columns not in _KINDS or len(words) != columns:
            raise InputError(
                f"{where}: {len(words)} numbers; each line needs 12 (KITTI), 8 (TUM: time, position, "
                "quaternion) or 16 (matrix), and all lines as many."
            )
        values = np.array([finite_number(word, f"number {i}", where) for i, word in enumerate(words, 1)])
        if columns == TUM_COLUMNS:
            times.append(_time_ns(values[0], where))
        poses.append(_tum_pose(values[1:], where) if columns == TUM_COLUMNS else _matrix_pose(values, where))
    if not poses:
        raise InputError(f"{path}: it holds no pose.")
    return PoseFile(np.array(poses), columns, np.array(times, np.int64) if times else None)


def rigid_or_error(T: np.ndarray, where: str) -> np.ndarray:
    """A pose of a file, with an exact rotation.

    Args:
      T: (4, 4) real.
      where: file and line, for the error.

    Returns:
      (4, 4) float64.

    Raises:
      InputError: where it is no rigid transform, or is farther away than any place on earth.
    """
    problem = check_pose(T)
    if problem is None and np.abs(T[:3, 3]).max() > _MAX_POSITION_M:
        problem = f"its position is {np.abs(T[:3, 3]).max():.3g} m away"
    if problem is not None:
        raise InputError(f"{where}: no pose: {problem}. Correct or remove it.")
    return orthonormal_pose(T)


def quaternion_pose(wxyz: np.ndarray, translation: np.ndarray, where: str) -> np.ndarray:
    """A pose of a file that is given as a quaternion and a position.

    Args:
      wxyz: (4,) real, the real part first.
      translation: (3,) real, m.
      where: file and line, for the error.

    Returns:
      (4, 4) float64.

    Raises:
      InputError: where the quaternion's length is not 1, or a number is not finite.
    """
    norm = float(np.linalg.norm(wxyz))
    if not abs(norm - 1.0) <= ROTATION_TOLERANCE:
        raise InputError(
            f"{where}: no pose: its quaternion has length {norm:.4g}, not 1. Correct or remove it."
        )
    return rigid_or_error(rigid_from_quaternion(np.asarray(wxyz) / norm, translation), where)


def _matrix_pose(values: np.ndarray, where: str) -> np.ndarray:
    if len(values) == KITTI_COLUMNS:
        values = np.append(values, [0.0, 0.0, 0.0, 1.0])
    return rigid_or_error(values.reshape(4, 4), where)


def _tum_pose(values: np.ndarray, where: str) -> np.ndarray:
    return quaternion_pose(np.roll(values[3:], 1), values[:3], where)


def _time_ns(value: float, where: str) -> int:
    time_ns = value if abs(value) > _CLOCK_NS else value * _NS_PER_S
    if not abs(time_ns) < _MAX_TIME_NS:
        raise InputError(f"{where}: the time {value:g} is neither seconds nor nanoseconds of this age.")
    return round(time_ns)
