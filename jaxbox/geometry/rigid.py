"""Rigid motions in NumPy and float64: rotations from quaternions, interpolation, constant-velocity motion.

Positions on a map are millions of metres, of which float32 keeps half a metre: poses stay in float64 until
one is seen from another.

References: Bar-Itzhack, "New method for extracting the quaternion from a rotation matrix", J. Guidance
23(6), 2000; Murray, Li, Sastry, "A Mathematical Introduction to Robotic Manipulation", 1994, chapter 2 (the
exponential of a twist).
"""

import numpy as np

_SMALL_ANGLE = 1e-9
"""rad: below it a motion turns points by less than a micrometre, and has no axis."""


def rotation_about_z(angle: float) -> np.ndarray:
    """The rotation that turns +x towards +y.

    Args:
      angle: rad.

    Returns:
      (3, 3) float64.

    >>> (rotation_about_z(np.pi / 2) @ [1, 0, 0]).round(3).tolist()
    [0.0, 1.0, 0.0]
    """
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def inverse_rigid(T_a_b: np.ndarray) -> np.ndarray:
    """Inverts rigid transforms: T^-1 = [[R^T, -R^T t], [0, 1]].

    Args:
      T_a_b: (..., 4, 4) float64.

    Returns:
      (..., 4, 4) float64, ``T_b_a``.

    >>> T = np.eye(4)
    >>> T[:3, 3] = 1, 2, 3
    >>> inverse_rigid(T)[:3, 3].tolist()
    [-1.0, -2.0, -3.0]
    """
    T_b_a = np.zeros_like(T_a_b)
    T_b_a[..., :3, :3] = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a[..., :3, 3] = -(T_b_a[..., :3, :3] @ T_a_b[..., :3, 3, None])[..., 0]
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def relative_rigid(T_w_a: np.ndarray, T_w_b: np.ndarray) -> np.ndarray:
    """Poses seen from others: T_a_b = T_w_a^-1 T_w_b.

    Positions are subtracted before they are turned, so that far from the world's origin nothing is lost.

    Args:
      T_w_a: (..., 4, 4) float64.
      T_w_b: (..., 4, 4) float64.

    Returns:
      (..., 4, 4) float64, ``T_a_b``.

    >>> T = np.tile(np.eye(4), (2, 1, 1))
    >>> T[:, 0, 3] = 5e6, 5e6 + 1.25
    >>> relative_rigid(T[0], T[1])[:3, 3].tolist()
    [1.25, 0.0, 0.0]
    """
    R_a_w = np.swapaxes(T_w_a[..., :3, :3], -1, -2)
    T_a_b = np.zeros(np.broadcast_shapes(T_w_a.shape, T_w_b.shape))
    T_a_b[..., :3, :3] = R_a_w @ T_w_b[..., :3, :3]
    T_a_b[..., :3, 3] = (R_a_w @ (T_w_b[..., :3, 3] - T_w_a[..., :3, 3])[..., None])[..., 0]
    T_a_b[..., 3, 3] = 1.0
    return T_a_b


def rigid_from_quaternion(wxyz: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Rigid transforms of quaternions and translations.

    Args:
      wxyz: (..., 4) unit quaternions, the real part first.
      translation: (..., 3) m.

    Returns:
      (..., 4, 4) float64.

    >>> rigid_from_quaternion(np.array([0, 0, 0, 1.0]), np.zeros(3))[:2, :2].tolist()
    [[-1.0, 0.0], [0.0, -1.0]]
    """
    w, x, y, z = np.moveaxis(np.asarray(wxyz, np.float64), -1, 0)
    T = np.zeros((*w.shape, 4, 4))
    T[..., 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=-1)
    T[..., 1, :3] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=-1)
    T[..., 2, :3] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    T[..., :3, 3] = translation
    T[..., 3, 3] = 1.0
    return T


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """Quaternions of rotation matrices: the eigenvector of Bar-Itzhack's matrix with the largest eigenvalue.

    Args:
      rotation: (..., 3, 3) rotations; of one that is a little off, the quaternion is that of the nearest.

    Returns:
      (..., 4) float64, unit, the real part first and not negative.

    >>> quaternion_of(np.diag([1.0, -1.0, -1.0])).tolist()
    [0.0, 1.0, 0.0, 0.0]
    """
    R = np.asarray(rotation, np.float64)
    symmetric = np.zeros((*R.shape[:-2], 4, 4))
    trace = np.trace(R, axis1=-2, axis2=-1)
    symmetric[..., 0, 0] = trace
    symmetric[..., 1:, 1:] = R + np.swapaxes(R, -1, -2) - trace[..., None, None] * np.eye(3)
    symmetric[..., 0, 1] = R[..., 2, 1] - R[..., 1, 2]
    symmetric[..., 0, 2] = R[..., 0, 2] - R[..., 2, 0]
    symmetric[..., 0, 3] = R[..., 1, 0] - R[..., 0, 1]
    symmetric[..., 1:, 0] = symmetric[..., 0, 1:]
    quaternion = np.linalg.eigh(symmetric)[1][..., -1]
    # Of a half turn the real part is 0, and the first other part that is not is made positive.
    leading = np.take_along_axis(quaternion, np.abs(quaternion).argmax(axis=-1)[..., None], axis=-1)
    real = quaternion[..., :1]
    return quaternion * np.where(np.where(np.abs(real) > _SMALL_ANGLE, real, leading) < 0, -1.0, 1.0)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotations nearest to matrices that are nearly such, by the polar decomposition.

    Args:
      matrix: (..., 3, 3) real, with a positive determinant.

    Returns:
      (..., 3, 3) float64, orthonormal.

    >>> nearest_rotation(1.001 * np.eye(3)).tolist() == np.eye(3).tolist()
    True
    """
    U, _, Vt = np.linalg.svd(np.asarray(matrix, np.float64))
    return U @ Vt


def interpolate_rigid(T_w_a: np.ndarray, T_w_b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Poses between two others: positions along the line (lerp), rotations along the least turn (slerp).

    Args:
      T_w_a: (..., 4, 4) float64, where share is 0.
      T_w_b: (..., 4, 4) float64, where it is 1.
      share: (...,) real; outside [0, 1] the motion goes on.

    Returns:
      (..., 4, 4) float64.

    >>> T = np.eye(4)
    >>> T[:3, 3] = 2, 0, 0
    >>> interpolate_rigid(np.eye(4), T, np.array(0.25))[:3, 3].tolist()
    [0.5, 0.0, 0.0]
    """
    R_w_a = T_w_a[..., :3, :3]
    w, axis = _split(quaternion_of(np.swapaxes(R_w_a, -1, -2) @ T_w_b[..., :3, :3]))
    norm = np.linalg.norm(axis, axis=-1)
    half = share * np.arctan2(norm, w)
    unit = axis / np.where(norm > 0, norm, 1.0)[..., None]
    turned = np.concatenate([np.cos(half)[..., None], np.sin(half)[..., None] * unit], axis=-1)
    T = rigid_from_quaternion(turned, np.zeros(3))
    T[..., :3, :3] = R_w_a @ T[..., :3, :3]
    start, end = T_w_a[..., :3, 3], T_w_b[..., :3, 3]
    T[..., :3, 3] = start + np.asarray(share)[..., None] * (end - start)
    return T


def _split(wxyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Real part and axis of quaternions."""
    return wxyz[..., 0], wxyz[..., 1:]


def move_along(xyz: np.ndarray, T_start_end: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Moves each point by its share of a motion at constant linear and angular velocity.

    T(s) = exp(s log T_start_end): the sensor drives an arc, and its velocity in its own frame stays the same.

    Args:
      xyz: (n, 3) real, m, each in the sensor's frame at its own share of the motion.
      T_start_end: (4, 4) float64, the sensor at share 1 seen from share 0.
      share: (n,) real.

    Returns:
      (n, 3) float64, m, in the sensor's frame at share 0.

    >>> T = np.eye(4)
    >>> T[:3, 3] = 2, 0, 0
    >>> move_along(np.zeros((2, 3)), T, np.array([0.5, 1.0])).tolist()
    [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]
    """
    points, s = np.asarray(xyz, np.float64), np.asarray(share, np.float64)[:, None]
    w, axis = _split(quaternion_of(T_start_end[:3, :3]))
    angle = 2 * float(np.arctan2(np.linalg.norm(axis), w))
    if angle < _SMALL_ANGLE:
        return points + s * T_start_end[:3, 3]
    x, y, z = axis / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # The twist's linear part, from V(angle) rho = t.
    V = np.eye(3) + (1 - np.cos(angle)) / angle * K + (1 - np.sin(angle) / angle) * (K @ K)
    rho = np.linalg.solve(V, T_start_end[:3, 3])
    sine, versine = np.sin(s * angle), 1 - np.cos(s * angle)
    turned = points + sine * (points @ K.T) + versine * (points @ (K @ K).T)
    drift = s * rho + versine / angle * (K @ rho) + (s - sine / angle) * (K @ K @ rho)
    return turned + drift


def partial_motion(T_start_end: np.ndarray, share: float) -> np.ndarray:
    """A share of a motion at constant linear and angular velocity: exp(share log T_start_end).

    Args:
      T_start_end: (4, 4) float64.
      share: any; negative ones go back.

    Returns:
      (4, 4) float64.

    >>> T = np.diag([-1.0, -1.0, 1.0, 1.0])
    >>> np.round(partial_motion(T, 0.5)[:2, :2], 6).tolist()
    [[0.0, -1.0], [1.0, 0.0]]
    """
    corners = np.vstack([np.zeros(3), np.eye(3)])
    origin, *axes = move_along(corners, T_start_end, np.full(len(corners), share))
    T = np.eye(4)
    T[:3, :3] = np.stack(axes, axis=1) - origin[:, None]
    T[:3, 3] = origin
    return T
