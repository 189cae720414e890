"""Segments and points through a pinhole camera, cut at a plane in front of it."""

import numpy as np

NEAR_M = 0.1
"""Depth of the plane that edges are cut at: nothing nearer is drawn."""


def cut_segments(segments: np.ndarray, *, near_m: float = NEAR_M) -> np.ndarray:
    """Cuts segments at the plane z = near, so that nothing behind the camera is drawn.

    Args:
      segments: (n, 2, 3) real numbers, m, camera frame (z is depth): start and end.
      near_m: depth of the plane, m.

    Returns:
      (m, 2, 3), m <= n: the parts with z >= near; segments wholly nearer are gone.

    >>> cut_segments(np.array([[[0.0, 0, -1], [0, 0, 1]]]), near_m=0.5)[0, :, 2].tolist()
    [0.5, 1.0]
    """
    depth = segments[..., 2] - near_m
    keep = (depth > 0).any(axis=1)
    segments, depth = segments[keep], depth[keep]
    crossing = (depth < 0).any(axis=1)
    span = np.where(crossing, depth[:, 0] - depth[:, 1], 1.0)
    share = (depth[:, 0] / span)[:, None]
    cut = segments[:, 0] + share * (segments[:, 1] - segments[:, 0])
    return np.where((depth < 0)[..., None], cut[:, None], segments)


def project(xyz: np.ndarray, projection: np.ndarray) -> np.ndarray:
    """Projects points by a 3 x 4 matrix, u = p_u / p_w and v = p_v / p_w (paper, equation 1).

    Args:
      xyz: (..., 3) real numbers, m, camera frame, with positive depth.
      projection: (3, 4).

    Returns:
      (..., 2), px: column, row.
    """
    homogeneous = xyz @ projection[:, :3].T + projection[:, 3]
    return homogeneous[..., :2] / homogeneous[..., 2:]


def transform(xyz: np.ndarray, T_target_source: np.ndarray) -> np.ndarray:
    """Moves points (..., 3) from the source to the target frame by a 4 x 4 rigid transform."""
    return xyz @ T_target_source[:3, :3].T + T_target_source[:3, 3]
