"""Where the sensor was at each sweep, and how it moved from one to the next.

A world is any frame that stands still; positions in it may be millions of metres, so poses are float64 on the
host, and only the motion from sweep to sweep, which is metres, is handed to the tracker in float32.
"""

import dataclasses
import enum

import numpy as np

from jaxbox.geometry.rigid import move_along, nearest_rotation, relative_rigid

ROTATION_TOLERANCE = 1e-3
"""How far R^T R of a pose may be from the identity: the rounding of files with three digits, where a scale or
a wrong matrix is farther."""


class PoseSource(enum.StrEnum):
    """Where poses are from; the value is its name in words."""

    OXTS = "oxts"
    """KITTI's inertial and satellite navigation."""
    POSE_FILE = "pose file"
    """A text file of poses."""
    ODOMETRY = "odometry"
    """``nav_msgs/Odometry`` of a recording."""
    TF = "tf"
    """Transforms, ``/tf``, of a recording."""
    NUSCENES = "nuscenes"
    """Ego poses of nuScenes."""
    ARGOVERSE2 = "argoverse2"
    """Vehicle poses of Argoverse 2."""
    KISS_ICP = "kiss-icp"
    """Registration of the points."""
    BOXES = "boxes"
    """Registration of the detector's boxes."""
    NONE = "none"
    """Not known: the sensor is taken to stand still."""


@dataclasses.dataclass(frozen=True)
class Poses:
    """The sensor's poses at the sweeps of one sequence."""

    T_world_sensor: np.ndarray
    """(F, 4, 4) float64, m: from the frame of each sweep's points to the world."""
    source: PoseSource
    """Where they are from."""
    times_ns: np.ndarray | None = None
    """(F,) int64, ns: when each sweep was taken; None where that is not known."""
    origin: str = ""
    """File, topic or method that they are from, in words."""

    def __len__(self) -> int:
        """Number of sweeps."""
        return len(self.T_world_sensor)

    def __post_init__(self) -> None:
        """Checks shapes.

        Raises:
          ValueError: where they do not belong together.
        """
        shape = np.shape(self.T_world_sensor)
        if shape[1:] != (4, 4):
            raise ValueError(f"T_world_sensor has the shape {shape}; poses are (F, 4, 4).")
        if self.times_ns is not None and np.shape(self.times_ns) != shape[:1]:
            raise ValueError(f"{shape[0]} poses, and times of the shape {np.shape(self.times_ns)}.")


def no_poses(num_sweeps: int) -> Poses:
    """Poses of a sensor that is taken to stand still.

    Args:
      num_sweeps: F.

    Returns:
      Identities.

    >>> no_poses(3).source.value, len(no_poses(3))
    ('none', 3)
    """
    return Poses(np.tile(np.eye(4), (num_sweeps, 1, 1)), PoseSource.NONE, origin="the sensor's frame")


def check_pose(T: np.ndarray) -> str | None:
    """Says what is wrong with a pose.

    Args:
      T: what may be a rigid transform.

    Returns:
      The reason why it is not rigid: its shape, a number that is not finite, a last row other than 0 0 0 1, a
      rotation that is off by more than `ROTATION_TOLERANCE`, or a mirror image; None where it is one.

    >>> check_pose(np.eye(4)) is None
    True
    >>> check_pose(np.diag([1.0, 1.0, -1.0, 1.0]))
    'its rotation is a mirror image (determinant -1)'
    """
    if np.shape(T) != (4, 4):
        return f"it has the shape {np.shape(T)}, not (4, 4)"
    T = np.asarray(T, np.float64)
    if not np.isfinite(T).all():
        return "it has numbers that are not finite"
    if np.abs(T[3] - [0, 0, 0, 1]).max() > ROTATION_TOLERANCE:
        return f"its last row is {T[3].tolist()}, not 0 0 0 1"
    R = T[:3, :3]
    # Numbers whose squares are beyond float64 are off as well.
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(R.T @ R - np.eye(3)).max()
    if not error <= ROTATION_TOLERANCE:
        return f"its rotation is off by {error:.2g} (R'R against the identity)"
    if np.linalg.det(R) < 0:
        return "its rotation is a mirror image (determinant -1)"
    return None


def orthonormal_pose(T: np.ndarray) -> np.ndarray:
    """Poses whose rotations are exact, of those that `check_pose` accepts.

    Args:
      T: (..., 4, 4) real.

    Returns:
      (..., 4, 4) float64, each with the nearest rotation.
    """
    exact = np.array(T, np.float64)
    exact[..., :3, :3] = nearest_rotation(exact[..., :3, :3])
    exact[..., 3, :] = 0.0, 0.0, 0.0, 1.0
    return exact


def ego_motions(poses: Poses) -> np.ndarray:
    """How the sensor moved from each sweep to the next: T_previous_current = T_world_previous^-1
    T_world_current.

    A world of UTM coordinates loses nothing, see `relative_rigid`.

    Args:
      poses: of F sweeps.

    Returns:
      (F, 4, 4) float32, m; the identity for the first sweep.

    >>> T = np.tile(np.eye(4), (2, 1, 1))
    >>> T[:, 0, 3] = 5e5, 5e5 + 1.25
    >>> ego_motions(Poses(T, PoseSource.NONE))[1, :3, 3].tolist()
    [1.25, 0.0, 0.0]
    """
    T = np.asarray(poses.T_world_sensor, np.float64)
    motions = np.tile(np.eye(4), (len(T), 1, 1))
    motions[1:] = relative_rigid(T[:-1], T[1:])
    return motions.astype(np.float32)


def deskew(
    xyz: np.ndarray, time_s: np.ndarray, T_start_end: np.ndarray, *, duration_s: float | None = None
) -> np.ndarray:
    """Removes the distortion of a sweep that was taken while the sensor moved.

    Each point is moved to where the sensor would have seen it at the sweep's time, by `move_along`: linear
    and angular velocity are constant. What moves itself stays distorted by its own motion.

    Args:
      xyz: (n, 3) float32, m, each in the sensor's frame at its own time.
      time_s: (n,) real, when each point was taken, s from the sweep's time; where it is not finite, the point
        stays where it is.
      T_start_end: (4, 4) float64, the sensor `duration_s` after the sweep's time, seen from that time.
      duration_s: how long that motion takes; None for as long as the sweep, from its first point to its last.

    Returns:
      (n, 3) float32, m, in the sensor's frame at the sweep's time; points that are not finite stay so, and
      all stay where they are where no duration is given and all were taken at once.

    Raises:
      ValueError: for a motion that is not rigid, or a duration that is not positive.

    >>> T = np.eye(4)
    >>> T[:3, 3] = 2, 0, 0
    >>> deskew(np.float32([[9, 1, 0], [9, 1, 0]]), np.array([0.0, 0.1]), T)[:, 0].tolist()
    [9.0, 11.0]
    """
    if problem := check_pose(T_start_end):
        raise ValueError(f"T_start_end is not a rigid motion: {problem}.")
    if duration_s is not None and not duration_s > 0:
        raise ValueError(f"duration_s is {duration_s}; it must be positive.")
    moved = np.array(xyz, np.float32)
    known = np.isfinite(time_s) & np.isfinite(moved).all(axis=1)
    if duration_s is None:
        duration_s = float(np.ptp(time_s[known])) if known.any() else 0.0
    if not duration_s:
        return moved
    moved[known] = move_along(xyz[known], T_start_end, np.asarray(time_s)[known] / duration_s)
    return moved
