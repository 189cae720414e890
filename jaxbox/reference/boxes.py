"""Convex hull, rectangle (paper, 3.3, 3.4, Algorithm III) and shape descriptors (3.5, 4.4)."""

import dataclasses

import cv2
import numpy as np

MIN_AXIS_SQ = 1e-6
"""m^2: second moments below (1 mm)^2 are rounding; keeps the eccentricity of a line finite."""


def convex_hull(xy: np.ndarray) -> np.ndarray:
    """Vertices of the convex hull.

    Args:
      xy: (n, 2) m; rounded to float32.

    Returns:
      (h, 2) m, counter-clockwise; (0, 2) without points, one or two points where all are in line.
    """
    if len(xy) == 0:
        return np.zeros((0, 2))
    index = cv2.convexHull(np.ascontiguousarray(xy, np.float32), returnPoints=False).reshape(-1).astype(int)
    hull = np.asarray(xy, np.float64)[index]
    return hull if signed_area(hull) >= 0 else hull[::-1]


def signed_area(polygon: np.ndarray) -> float:
    """Area of a polygon, positive where it turns counter-clockwise.

    Args:
      polygon: (h, 2) m.

    Returns:
      m^2.
    """
    if len(polygon) == 0:
        return 0.0
    x, y = (polygon - polygon[0]).T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2)


def min_area_rectangle(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """The rectangle of smallest area round points, by rotating calipers.

    Args:
      xy: (n, 2) m, n >= 1.

    Returns:
      Centre (2,) m, length and width (2,) m with length >= width, and yaw in [-pi/2, pi/2).
    """
    # Near the origin float32 costs nothing.
    origin = np.mean(xy, axis=0)
    center, (along, across), angle_deg = cv2.minAreaRect(np.ascontiguousarray(xy - origin, np.float32))
    yaw = np.radians(angle_deg) + (0.0 if along >= across else np.pi / 2)
    return origin + center, np.array([max(along, across), min(along, across)]), wrap_yaw(yaw)


def wrap_yaw(yaw: float) -> float:
    """Wraps the angle of an axis, which has no front, to [-pi/2, pi/2)."""
    return float((yaw + np.pi / 2) % np.pi - np.pi / 2)


def criterion_curve(
    xy: np.ndarray, *, criterion: str, num_angles: int, min_distance_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """How well the rectangle round the points fits, for every rotation over 90 degrees.

    At angle t the coordinates are u = x cos t + y sin t and v = -x sin t + y cos t.

    - "area": minus the rectangle's area.
    - "variance": minus the variances of the distances to the nearer edge of each pair of edges,
      over the points nearer to that pair.
    - "closeness": mean of min_distance / max(distance to the nearest edge, min_distance).
    - "visible_closeness": the same with the two edges nearer to the sensor only.

    Args:
      xy: (n, 2) m, sensor frame, n >= 1.
      criterion: one of those.
      num_angles: A, rotations.
      min_distance_m: nearer points count as on the edge.

    Returns:
      (A,) values, larger is better, and (A, 4) m: smallest and largest u, smallest and largest v.

    Raises:
      ValueError: for another criterion.

    Reference:
      Zhang et al. 2017, "Efficient L-Shape Fitting for Vehicle Detection Using Laser Scanners".
    """
    angle = (np.arange(num_angles) * np.pi / 2 / num_angles)[:, None]
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = xy.astype(np.float64).T
    u, v = x * cos + y * sin, -x * sin + y * cos
    extents = np.column_stack([u.min(axis=1), u.max(axis=1), v.min(axis=1), v.max(axis=1)])
    u0, u1, v0, v1 = extents.T[..., None]
    if criterion == "area":
        return -((u1 - u0) * (v1 - v0))[:, 0], extents
    if criterion == "visible_closeness":
        to_u = np.abs(u - np.where(np.abs(u0) < np.abs(u1), u0, u1))
        to_v = np.abs(v - np.where(np.abs(v0) < np.abs(v1), v0, v1))
    else:
        to_u, to_v = np.minimum(u - u0, u1 - u), np.minimum(v - v0, v1 - v)
    if criterion == "variance":
        return -_variance(to_u, to_u < to_v) - _variance(to_v, to_v <= to_u), extents
    if criterion not in ("closeness", "visible_closeness"):
        raise ValueError(
            f"criterion is {criterion!r}; it must be area, variance, closeness or visible_closeness."
        )
    distance = np.maximum(np.minimum(to_u, to_v), min_distance_m)
    return (min_distance_m / distance).mean(axis=1), extents


def _variance(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Population variance along rows over the chosen values; 0 where there are none."""
    count = np.maximum(where.sum(axis=1), 1)
    mean = np.sum(values, axis=1, where=where) / count
    return np.sum((values - mean[:, None]) ** 2, axis=1, where=where) / count


def fit_points(
    members: np.ndarray,
    height: np.ndarray,
    *,
    min_height_m: float,
    max_height_m: float,
    min_slab_points: float,
    max_points: int,
) -> np.ndarray:
    """The members of a cluster that its rectangle is fitted to.

    Args:
      members: (m,) int, rows of the cluster's points in sweep order.
      height: (n,) m above the ground, of all points.
      min_height_m: members between these heights are taken,
      max_height_m: exclusive,
      min_slab_points: unless they are fewer than this; then all are.
      max_points: at most so many, spread evenly: the floor(j count / max_points)-th.

    Returns:
      (k,) int, k <= max_points.
    """
    slab = members[(height[members] > min_height_m) & (height[members] < max_height_m)]
    chosen = slab if len(slab) >= min_slab_points else members
    if len(chosen) <= max_points:
        return chosen
    return chosen[np.arange(max_points) * len(chosen) // max_points]


@dataclasses.dataclass(frozen=True)
class ShapeDescriptors:
    """Shape descriptors of one cluster's points in the bird's-eye view."""

    moment_of_inertia: np.ndarray
    """(2,) m^2: second central moments per point, larger first."""
    eccentricity: float
    """Length of the major over length of the minor axis, >= 1."""
    density: float
    """Points per m^2 of hull area; 0 where the hull has none."""
    complexity: float
    """Hull vertices / points (paper, equation 7); 0 without points."""


def shape_descriptors(xy: np.ndarray, hull: np.ndarray) -> ShapeDescriptors:
    """Moments of inertia, eccentricity, density and complexity.

    Args:
      xy: (n, 2) m.
      hull: (h, 2) m, its convex hull.

    Returns:
      The descriptors; a single point has eccentricity 1, no points give zeros.
    """
    if len(xy) == 0:
        return ShapeDescriptors(np.zeros(2), 1.0, 0.0, 0.0)
    centred = xy - xy.mean(axis=0)
    minor, major = np.linalg.eigvalsh(centred.T @ centred / len(xy))
    moments = np.maximum([major, minor], 0.0)
    area = abs(signed_area(hull))
    return ShapeDescriptors(
        moment_of_inertia=moments,
        eccentricity=float(np.sqrt(max(moments[0], MIN_AXIS_SQ) / max(moments[1], MIN_AXIS_SQ))),
        density=len(xy) / area if area > 0 else 0.0,
        complexity=len(hull) / len(xy),
    )
