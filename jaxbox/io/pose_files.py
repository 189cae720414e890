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
from collections.abc import Callable

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
        that is not a rigid transform; and for a file without poses.
    """
    rows, lines, columns = [], [], 0
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
        rows.append([finite_number(word, f"number {i}", where) for i, word in enumerate(words, 1)])
        lines.append(where)
    if not rows:
        raise InputError(f"{path}: it holds no pose.")
    values = np.array(rows)
    if columns == TUM_COLUMNS:
        times = [_time_ns(value, where) for value, where in zip(values[:, 0], lines, strict=True)]
        T = rigid_from_quaternions(np.roll(values[:, 4:], 1, axis=1), values[:, 1:4], lines.__getitem__)
        return PoseFile(T, columns, np.array(times, np.int64))
    if columns == KITTI_COLUMNS:
        values = np.hstack([values, np.tile([0.0, 0.0, 0.0, 1.0], (len(values), 1))])
    return PoseFile(rigid_or_error(values.reshape(-1, 4, 4), lines.__getitem__), columns, None)


def rigid_or_error(T: np.ndarray, where: Callable[[int], str]) -> np.ndarray:
    """The poses of a file, with exact rotations.

    Args:
      T: (n, 4, 4) real.
      where: file and line of a pose by its number, for the error.

    Returns:
      (n, 4, 4) float64.

    Raises:
      InputError: for the first that is not a rigid transform, or is farther away than any place on earth.
    """
    for index in np.flatnonzero(~_are_near_rigid(T)):
        problem = check_pose(T[index]) or f"its position is {np.abs(T[index, :3, 3]).max():.3g} m away"
        raise InputError(f"{where(int(index))}: no pose: {problem}. Correct or remove it.")
    return orthonormal_pose(T)


def _are_near_rigid(T: np.ndarray) -> np.ndarray:
    """Which poses `check_pose` accepts and are on earth: in one go, as there may be a hundred a second."""
    R = T[:, :3, :3]
    # Numbers that are not finite, or whose squares are not, fail every comparison.
    with np.errstate(over="ignore", invalid="ignore"):
        is_rotation = np.abs(R.swapaxes(1, 2) @ R - np.eye(3)).max(axis=(1, 2)) <= ROTATION_TOLERANCE
        is_row = np.abs(T[:, 3] - [0, 0, 0, 1]).max(axis=1) <= ROTATION_TOLERANCE
        is_near = np.abs(T[:, :3, 3]).max(axis=1) <= _MAX_POSITION_M
        return is_rotation & is_row & is_near & (np.linalg.det(R) > 0)


def rigid_from_quaternions(
    wxyz: np.ndarray, translation: np.ndarray, where: Callable[[int], str]
) -> np.ndarray:
    """The poses of a file that are given as quaternions and positions.

    Args:
      wxyz: (n, 4) real, the real part first.
      translation: (n, 3) real, m.
      where: file and line of a pose by its number, for the error.

    Returns:
      (n, 4, 4) float64.

    Raises:
      InputError: for the first whose quaternion's length is not 1, or that has a number that is not finite.
    """
    norm = np.linalg.norm(wxyz, axis=1)
    for index in np.flatnonzero(~(np.abs(norm - 1.0) <= ROTATION_TOLERANCE)):
        raise InputError(
            f"{where(int(index))}: no pose: its quaternion has length {norm[index]:.4g}, not 1. "
            "Correct or remove it."
        )
    return rigid_or_error(rigid_from_quaternion(wxyz / norm[:, None], translation), where)


def _time_ns(value: float, where: str) -> int:
    time_ns = value if abs(value) > _CLOCK_NS else value * _NS_PER_S
    if not abs(time_ns) < _MAX_TIME_NS:
        raise InputError(f"{where}: the time {value:g} is neither seconds nor nanoseconds of this age.")
    return round(time_ns)
