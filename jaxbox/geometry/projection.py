"""Calibration and projection: from the LiDAR frame through the camera to the image (paper, 3.6).

A point goes to the image as  w (u, v, 1)^T = P_rect T_rect_velo (x, y, z, 1)^T  (paper, equation 3),
where w is its depth. Only points in front of the camera have an image, so a box that is partly behind
is cut at a near plane w = near_m *before* the division: its edges are clipped, it is neither dropped
nor turned inside out.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.geometry.planar import rectangle_corners
from jaxbox.types import Calibration

NEAR_M = 0.1
"""Default depth of the near plane: nearer than any object, far enough for float32 pixels."""

BOX_EDGES = (
    (0, 1), (1, 2), (2, 3), (3, 0),
    (4, 5), (5, 6), (6, 7), (7, 4),
    (0, 4), (1, 5), (2, 6), (3, 7),
)  # fmt: skip
"""The 12 edges of a box as pairs of `box_corners` rows: bottom, top, uprights."""

_RANK_TOLERANCE = 1e-6
"""Singular values below this times the largest count as zero: calibrations are written to 7 digits."""

_EXACT = jax.lax.Precision.HIGHEST
"""Accelerators would otherwise multiply matrices with 8 to 11 bits, which is pixels at 80 m."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ProjectedBoxes:
    """What a camera sees of K boxes. Every number is finite, also for boxes behind the camera."""

    corners_uv: jax.Array
    """(K, 8, 2) float32, px: the corners in the order of `box_corners`; see ``corner_valid``."""
    corner_valid: jax.Array
    """(K, 8) bool: the corner is beyond the near plane; others have no image, and their uv no meaning."""
    edges_uv: jax.Array
    """(K, 12, 2, 2) float32, px: both ends of each of `BOX_EDGES`, clipped at the near plane: draw these."""
    edge_valid: jax.Array
    """(K, 12) bool: some of the edge is beyond the near plane."""
    boxes_px: jax.Array
    """(K, 4) float32, px: left, top, right, bottom, clipped to the image; 0 where not visible."""
    visible: jax.Array
    """(K,) bool: some of the box is beyond the near plane, and its 2D box meets the image."""
    visible_fraction: jax.Array
    """(K,) float32, in [0, 1]: area of the clipped over the unclipped 2D box; 0 where not visible."""


def intrinsic_matrix(
    fx: jax.Array | float, fy: jax.Array | float, cx: jax.Array | float, cy: jax.Array | float,
    skew: jax.Array | float = 0.0,
) -> jax.Array:  # fmt: skip
    """Camera matrix K = [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] (paper, equation 1).

    Args:
      fx: () focal length along u, px.
      fy: () focal length along v, px.
      cx: () principal point, u, px.
      cy: () principal point, v, px.
      skew: () px; not 0 where the sensor's axes are not perpendicular.

    Returns:
      (3, 3) float32.

    >>> intrinsic_matrix(700.0, 710.0, 600.0, 170.0, 0.5)[0].tolist()
    [700.0, 0.5, 600.0]
    """
    return jnp.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], jnp.float32)


def rigid_transform(R: jax.Array, t: jax.Array) -> jax.Array:
    """Homogeneous transform T = [[R, t], [0, 1]] (paper, equations 2 and 4).

    Args:
      R: (3, 3) rotation from source to target axes.
      t: (3,) m, origin of the source in the target frame.

    Returns:
      (4, 4) float32, ``T_target_source``.

    >>> rigid_transform(jnp.eye(3), jnp.array([1.0, 2.0, 3.0]))[1].tolist()
    [0.0, 1.0, 0.0, 2.0]
    """
    rows = jnp.concatenate([jnp.asarray(R), jnp.asarray(t)[:, None]], axis=1)
    return jnp.concatenate([rows, jnp.array([[0.0, 0.0, 0.0, 1.0]])]).astype(jnp.float32)


def compose_transforms(T_rect_cam: jax.Array, T_cam_velo: jax.Array) -> jax.Array:
    """Chains LiDAR-to-camera and camera-to-camera: the T_2 R_1 T_1 of the paper's equation 3.

    Args:
      T_rect_cam: (4, 4) from the reference camera to the rectified camera frame.
      T_cam_velo: (4, 4) from the LiDAR to the reference camera frame.

    Returns:
      (4, 4) float32, ``T_rect_velo``.
    """
    return jnp.matmul(T_rect_cam, T_cam_velo, precision=_EXACT)


def check_full_rank(matrix: np.ndarray, name: str) -> None:
    """Checks on the host that a calibration matrix is not singular (paper, equation 5).

    Args:
      matrix: (n, n) real; a rigid transform must have rank 4, a camera matrix rank 3.
      name: how the error calls it.

    Raises:
      ValueError: where a number is not finite, or the rank is below n.

    >>> check_full_rank(np.zeros((4, 4)), "T_rect_velo")
    Traceback (most recent call last):
    ...
    ValueError: T_rect_velo has rank 0, not 4: it is singular. Check the calibration's numbers.
    """
    matrix = np.asarray(matrix, np.float64)
    if not np.all(np.isfinite(matrix)):
        raise ValueError(f"{name} has numbers that are not finite. Check the calibration's numbers.")
    singular_values = np.linalg.svd(matrix, compute_uv=False)
    rank = int(np.sum(singular_values > _RANK_TOLERANCE * singular_values[0]))
    if rank < len(matrix):
        raise ValueError(
            f"{name} has rank {rank}, not {len(matrix)}: it is singular. Check the calibration's numbers."
        )


def project_points(
    xyz_velo: jax.Array, calibration: Calibration, *, near_m: jax.Array | float = NEAR_M
) -> tuple[jax.Array, jax.Array]:
    """Projects points into the image (paper, equation 3).

    Args:
      xyz_velo: (..., 3) float32, m, sensor frame.
      calibration: the camera.
      near_m: () m; points with less depth are divided by this instead, so that uv stays finite.

    Returns:
      uv: (..., 2) float32, px, not clipped; without meaning where depth < near_m.
      depth: (...) float32, m; negative behind the camera.
    """
    uvw = _to_homogeneous_pixels(xyz_velo, calibration)
    return _divide(uvw, near_m), uvw[..., 2]


def _to_homogeneous_pixels(xyz_velo: jax.Array, calibration: Calibration) -> jax.Array:
    """(..., 3): (w u, w v, w), linear in the point, so that edges may be cut before the division."""
    matrix = jnp.matmul(calibration.P_rect, calibration.T_rect_velo, precision=_EXACT)
    turned = jnp.matmul(xyz_velo, matrix[:, :3].T, precision=_EXACT)
    return turned + jnp.broadcast_to(matrix[:, 3], turned.shape)


def _divide(uvw: jax.Array, near_m: jax.Array | float) -> jax.Array:
    return uvw[..., :2] / jnp.maximum(uvw[..., 2:], near_m)


def box_corners(center: jax.Array, size: jax.Array, yaw: jax.Array) -> jax.Array:
    """Corners of oriented boxes.

    Args:
      center: (..., 3) m.
      size: (..., 3) m: length, width, height.
      yaw: (...) rad.

    Returns:
      (..., 8, 3) m: the bottom's front left, rear left, rear right, front right, then the top's.

    >>> box_corners(jnp.zeros(3), jnp.array([4.0, 2.0, 1.0]), jnp.array(0.0))[4].tolist()
    [2.0, 1.0, 0.5]
    """
    xy = rectangle_corners(center, size, yaw)
    half_height = size[..., 2] / 2
    bottom = jnp.broadcast_to((center[..., 2] - half_height)[..., None, None], (*xy.shape[:-1], 1))
    top = jnp.broadcast_to((center[..., 2] + half_height)[..., None, None], (*xy.shape[:-1], 1))
    faces = [jnp.concatenate([xy, z], axis=-1) for z in (bottom, top)]
    return jnp.concatenate(faces, axis=-2)


def project_boxes(
    center: jax.Array,
    size: jax.Array,
    yaw: jax.Array,
    calibration: Calibration,
    *,
    near_m: jax.Array | float = NEAR_M,
) -> ProjectedBoxes:
    """Projects boxes into the image: corners, edges and 2D boxes.

    The 2D box bounds the projection of the part of the box beyond the near plane. That part is the
    convex hull of its corners there and of the points where edges cross the plane, so their extremes
    are the 2D box's. It is clipped to [0, w - 1] x [0, h - 1], as KITTI's labels are.

    Args:
      center: (K, 3) float32, m, sensor frame.
      size: (K, 3) float32, m: length, width, height.
      yaw: (K,) float32, rad.
      calibration: the camera.
      near_m: () m, > 0, depth of the near plane. The *unclipped* 2D box of a box that crosses it, and so
        `visible_fraction`, depends on this; the clipped one does so only where nothing nearer than
        near_m lies in the image.

    Returns:
      A `ProjectedBoxes`.
    """
    uvw = _to_homogeneous_pixels(box_corners(center, size, yaw), calibration)
    corners_uv, corner_valid = _divide(uvw, near_m), uvw[..., 2] >= near_m
    edges_uv, edge_valid = _clip_edges(uvw, near_m)
    # Every corner ends an edge, so the clipped edges' ends hold all extremes.
    bounds = _bounding_box(edges_uv, edge_valid)
    limit = jnp.tile(calibration.image_size_px.astype(jnp.float32) - 1, 2)[None]
    clipped = jnp.clip(bounds, 0, limit)
    visible = edge_valid.any(-1) & _meets(bounds, limit)
    area = _area(bounds)
    fraction = jnp.where(area > 0, _area(clipped) / jnp.where(area > 0, area, 1), 0)
    return ProjectedBoxes(
        corners_uv=corners_uv,
        corner_valid=corner_valid,
        edges_uv=edges_uv,
        edge_valid=edge_valid,
        boxes_px=jnp.where(visible[:, None], clipped, 0),
        visible=visible,
        visible_fraction=jnp.where(visible, jnp.clip(fraction, 0, 1), 0),
    )


def _clip_edges(uvw: jax.Array, near_m: jax.Array | float) -> tuple[jax.Array, jax.Array]:
    """Cuts each edge at the near plane: (K, 12, 2, 2) px and whether any of it is left, (K, 12)."""
    ends = uvw[:, jnp.array(BOX_EDGES), :]
    depth = ends[..., 2]
    in_front = depth >= near_m
    # Both ends' cut is the same point; the guarded divisor matters only where it is not used.
    rise = depth[..., 1] - depth[..., 0]
    crosses = in_front[..., 0] != in_front[..., 1]
    along = jnp.where(crosses, (near_m - depth[..., 0]) / jnp.where(crosses, rise, 1), 0)
    cut = ends[..., 0, :] + along[..., None] * (ends[..., 1, :] - ends[..., 0, :])
    clipped = jnp.where(in_front[..., None], ends, cut[..., None, :])
    return _divide(clipped, near_m), in_front.any(-1)


def _bounding_box(edges_uv: jax.Array, edge_valid: jax.Array) -> jax.Array:
    """(K, 4) left, top, right, bottom of the valid edges; 0 where there are none."""
    mask = edge_valid[..., None, None]
    low = jnp.where(mask, edges_uv, jnp.inf).min((1, 2))
    high = jnp.where(mask, edges_uv, -jnp.inf).max((1, 2))
    return jnp.where(edge_valid.any(-1)[:, None], jnp.concatenate([low, high], -1), 0)


def _meets(bounds: jax.Array, limit: jax.Array) -> jax.Array:
    return jnp.all((bounds[:, 2:] > 0) & (bounds[:, :2] < limit[:, :2]), axis=-1)


def _area(boxes: jax.Array) -> jax.Array:
    return (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
