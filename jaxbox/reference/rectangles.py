"""Rectangles by trying all rotations (paper, section 3.4, Algorithm III)."""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from jaxbox.config import BoxConfig, DetectorConfig
from jaxbox.reference.state import Rectangle, Rotations

PREFERENCE_GAIN = 5.0
"""How often the scene's direction counts for the second candidate of a cluster."""

SAME_DISTANCE_M = 1e-4
"""Distances to two edges that differ by less are the same: a corner's point is on both, as it is rounded."""


def fit_rectangles(outlines: Sequence[np.ndarray], config: BoxConfig) -> list[Rotations]:
    """Rectangles of all clusters at all rotations.

    Args:
      outlines: (n, 2) m, the points of each cluster.
      config: criterion and rotations.

    Returns:
      The rectangles of each cluster.
    """
    principal = principal_rotations(outlines, config.num_angles)
    return [
        Rotations(*try_rotations(xy, config), len(xy), along)
        for xy, along in zip(outlines, principal, strict=True)
    ]


def best_rectangles(
    rotations: Sequence[Rotations], preference: np.ndarray, *, gain: float = 1.0
) -> list[Rectangle]:
    """The rectangle of each cluster at its best rotation.

    Args:
      rotations: of the clusters.
      preference: (A,), added to every curve.
      gain: how often the preference counts when the rotation is chosen; the score counts it once.

    Returns:
      The rectangles; of equally good rotations the first.
    """

    best = [int(np.argmax(each.curve + gain * preference)) for each in rotations]
    return rectangles_at(best, rotations, preference)


def rectangles_at(
    index: Sequence[int], rotations: Sequence[Rotations], preference: np.ndarray
) -> list[Rectangle]:
    """The rectangle of each cluster at a rotation.

    Args:
      index: in [0, A), of each.
      rotations: of the clusters.
      preference: (A,), added to the scores.

    Returns:
      The rectangles.
    """
    step = np.pi / 2 / len(preference)
    return [
        Rectangle(each.extents[i], i * step, float(each.curve[i] + preference[i]))
        for i, each in zip(index, rotations, strict=True)
    ]


def rectangle_candidates(
    rotations: Sequence[Rotations],
    outlines: Sequence[np.ndarray],
    preference: np.ndarray,
    config: DetectorConfig,
) -> list[list[Rectangle]]:
    """The rectangles of each cluster that the evidence is to choose from.

    Args:
      rotations: of the clusters.
      outlines: (n, 2) m, the points of each that those were fitted to.
      preference: (A,), for the scene's direction.
      config: of the detector.

    Returns:
      Those at the best rotation, bent to the scene's direction; where the preset asks, those that know
      nothing of it, those that keep to it, those at a second peak of the curve, and those along the
      principal axis of the points: a list each. Those fitted to the points themselves are without strays.
    """
    candidates = _with_strays(rotations, preference, config)
    if config.box.fit_to == "hull":
        return candidates
    return [
        [trim_strays(each, xy, config.box) for each, xy in zip(rectangles, outlines, strict=True)]
        for rectangles in candidates
    ]


def _with_strays(
    rotations: Sequence[Rotations], preference: np.ndarray, config: DetectorConfig
) -> list[list[Rectangle]]:
    """Those candidates, with each edge at its outermost point."""
    along_scene = config.box.scene_direction and config.completion.along_scene
    if not along_scene:
        return [best_rectangles(rotations, preference)]
    widest, max_loss = float(config.vehicles.classes[0].max_width_m), float(config.box.second_peak_loss)
    second = [
        dataclasses.replace(
            each, curve=second_peak(each.curve, each.short_m <= widest, each.num_points, max_loss=max_loss)
        )
        for each in rotations
    ]
    return [
        best_rectangles(rotations, preference, gain=0),
        best_rectangles(rotations, preference, gain=PREFERENCE_GAIN),
        best_rectangles(second, preference, gain=0),
        rectangles_at([along_axis(each, config.box) for each in rotations], rotations, preference),
    ]


def trim_strays(rectangle: Rectangle, xy: np.ndarray, config: BoxConfig) -> Rectangle:
    """Moves an edge that a single point carries ahead of the others up to those.

    Args:
      rectangle: of a cluster.
      xy: (n, 2) m, its points.
      config: of `min_stray_points` or more the one on one of the two edges nearer to the sensor lies at most
        `stray_m` ahead of all others.

    Returns:
      The rectangle; as it is of fewer points.
    """
    if len(xy) < config.min_stray_points:
        return rectangle
    extents = rectangle.extents.copy()
    cos, sin = np.cos(rectangle.angle), np.sin(rectangle.angle)
    u, v = xy @ [cos, sin], xy @ [-sin, cos]
    for axis, (along, across) in enumerate([(u, v), (v, u)]):
        low, high = extents[2 * axis : 2 * axis + 2]
        edge, sign = (2 * axis, -1) if abs(low) < abs(high) else (2 * axis + 1, 1)
        ahead = sign * along
        inside = ahead < ahead.max() - SAME_DISTANCE_M
        if inside.any() and np.ptp(across[~inside]) < SAME_DISTANCE_M:
            extents[edge] = sign * min(ahead.max(), ahead[inside].max() + float(config.stray_m))
    return dataclasses.replace(rectangle, extents=extents)


def principal_rotations(outlines: Sequence[np.ndarray], num_angles: int) -> list[int]:
    """The rotations along the principal axes of clusters, about which their moments of inertia differ most.

    Args:
      outlines: (n, 2) m, the points of each cluster, n >= 1.
      num_angles: A.

    Returns:
      i in [0, A) of each, the nearest of the rotations by i * 90 / A degrees.
    """

    def along(xy: np.ndarray) -> int:
        _, axes = np.linalg.eigh(np.cov(xy.T, bias=True))
        turn_deg = np.degrees(np.arctan2(axes[1, 1], axes[0, 1])) % 90
        return round(turn_deg * num_angles / 90) % num_angles

    return [along(xy) for xy in outlines]


def along_axis(rotations: Rotations, config: BoxConfig) -> int:
    """The rotation along the principal axes of a cluster, or its best rotation.

    Args:
      rotations: of the cluster.
      config: the principal axes are tried of `min_axis_points` or more, where they are 5 degrees or more
        from the best rotation.

    Returns:
      In [0, A).
    """
    best, num_angles = int(np.argmax(rotations.curve)), len(rotations.curve)
    apart_deg = _apart_deg(rotations.principal, best, num_angles)
    is_tried = rotations.num_points >= config.min_axis_points and apart_deg >= 5
    return rotations.principal if is_tried else best


def _apart_deg(first: int | np.ndarray, second: int, num_angles: int) -> np.ndarray:
    """Degrees between two rotations, which repeat every quarter turn."""
    turn = np.abs(first - second)
    return np.minimum(turn, num_angles - turn) * 90 / num_angles


def second_peak(curve: np.ndarray, narrow: np.ndarray, num_points: int, *, max_loss: float) -> np.ndarray:
    """The peaks of a curve that are 6 degrees or more from its best rotation.

    Args:
      curve: (A,) larger is better.
      narrow: (A,) bool, rotations at which the rectangle is no wider than a car; others count only if all
        are wider.
      num_points: that it is of.
      max_loss: how much worse another peak may be.

    Returns:
      (A,); the curve itself of less than 30 points, or where no peak farther comes so near to the best.
    """
    apart_deg = _apart_deg(np.arange(len(curve)), int(np.argmax(curve)), len(curve))
    is_peak = curve >= np.maximum(np.roll(curve, 1), np.roll(curve, -1))
    allowed = np.where(narrow | ~narrow.any(), curve, -np.inf)
    others = np.where(is_peak & (apart_deg >= 6), allowed, -np.inf)
    return others if num_points >= 30 and others.max() > allowed.max() - max_loss else curve


def try_rotations(xy: np.ndarray, config: BoxConfig) -> tuple[np.ndarray, np.ndarray]:
    """Bounds a cluster by a rectangle at every rotation over 90 degrees, and rates them (larger is better).

    At angle t the coordinates are u = x cos t + y sin t and v = -x sin t + y cos t.

    - "area": minus the rectangle's area.
    - "variance": minus the variances of the distances to the nearer edge of each pair of edges,
      over the points nearer to that pair.
    - "closeness": mean of min_distance / max(distance to the nearest edge, min_distance).
    - "visible_closeness": the same with the two edges nearer to the sensor only.

    Args:
      xy: (n, 2) m, sensor frame, n >= 1.
      config: one of those criteria, the number of rotations A, and the distance below which points count as
        on the edge.

    Returns:
      (A,) values, and (A, 4) m: smallest and largest u, smallest and largest v.

    Raises:
      ValueError: for another criterion.

    Reference:
      Zhang et al. 2017, "Efficient L-Shape Fitting for Vehicle Detection Using Laser Scanners".
    """
    criterion = config.criterion
    angle = (np.arange(config.num_angles) * np.pi / 2 / config.num_angles)[:, None]
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
        nearer_u = to_u < to_v - SAME_DISTANCE_M
        return -_variance(to_u, nearer_u) - _variance(to_v, ~nearer_u), extents
    if criterion not in ("closeness", "visible_closeness"):
        raise ValueError(
            f"criterion is {criterion!r}; it must be area, variance, closeness or visible_closeness."
        )
    min_distance_m = float(config.min_distance_m)
    distance = np.maximum(np.minimum(to_u, to_v), min_distance_m)
    return (min_distance_m / distance).mean(axis=1), extents


def _variance(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Population variance along rows over the chosen values; 0 where there are none."""
    count = np.maximum(where.sum(axis=1), 1)
    mean = np.sum(values, axis=1, where=where) / count
    return np.sum((values - mean[:, None]) ** 2, axis=1, where=where) / count


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
