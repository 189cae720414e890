"""Vehicle decision: points round a box, score, suppression."""

import dataclasses

import cv2
import numpy as np
from scipy.special import expit

from jaxbox.config.class_priors import ClassPrior

DOUBT_POINTS = 5
"""So many upper points, with the share of full worth behind the faces, are taken for granted."""

NUM_LEVELS = 20
"""Levels of height by which the top is found,"""

LOWEST_LEVEL = 0.4
"""from this share of the highest that points of the vehicle may have."""


@dataclasses.dataclass(frozen=True)
class PointsAround:
    """Points of the whole cloud in and round a box."""

    inside: int
    """Points of the vehicle's heights within the box and its margin."""
    top_m: float
    """As high above the ground as all but a few of them, see `top_of`; 0 without any."""
    overhead: int
    """Higher points within the box and its margin."""
    ring: int
    """Points of the vehicle's heights in the ring round the margin."""
    upper: int = 0
    """Points inside as high as glass, bonnet and roof."""
    recessed: int = 0
    """Those of them behind the faces that the sensor sees."""


def distance_outside(xy: np.ndarray, box: np.ndarray) -> np.ndarray:
    """How far points lie outside a box, along its worse axis; negative inside.

    Args:
      xy: (n, 2) m.
      box: (5,): x, y, length, width in m and yaw in rad.

    Returns:
      (n,) m.
    """
    x, y, length, width, yaw = box
    dx, dy = xy[:, 0] - x, xy[:, 1] - y
    along = np.abs(dx * np.cos(yaw) + dy * np.sin(yaw)) - length / 2
    across = np.abs(-dx * np.sin(yaw) + dy * np.cos(yaw)) - width / 2
    return np.maximum(along, across)


def count_points_around(
    box: np.ndarray,
    xyz: np.ndarray,
    height: np.ndarray,
    *,
    margin_m: float,
    ring_m: float,
    min_height_m: float,
    count_max_height_m: float,
    max_height_m: float,
    recess_m: float,
    upper_height_m: float,
    top_quantile: float,
) -> PointsAround:
    """Counts the points in and round a box.

    Args:
      box: (5,): x, y, length, width in m and yaw in rad.
      xyz: (n, 3) m, sensor frame.
      height: (n,) m above the ground.
      margin_m: a point less than this outside counts as inside.
      ring_m: a point farther outside than the margin but less than this is in the ring.
      min_height_m: lower points are ground.
      count_max_height_m: points from this on are overhead,
      max_height_m: and from this on they are left out.
      recess_m: recessed points lie farther than this behind each face that the sensor sees.
      upper_height_m: points higher than this are glass, bonnet and roof.
      top_quantile: share of the points inside that may lie above the top.

    Returns:
      The counts.
    """
    outside = distance_outside(xyz[:, :2], box)
    within = outside < margin_m
    counted = (height > min_height_m) & (height < count_max_height_m)
    above = (height >= count_max_height_m) & (height < max_height_m)
    upper = within & counted & (height > upper_height_m)
    return PointsAround(
        inside=int((within & counted).sum()),
        top_m=top_of(height[within & counted], count_max_height_m, top_quantile),
        overhead=int((within & above).sum()),
        ring=int((~within & (outside < ring_m) & counted).sum()),
        upper=int(upper.sum()),
        recessed=int((upper & (depth_behind_faces(xyz[:, :2], box) > recess_m)).sum()),
    )


def top_of(height: np.ndarray, max_height_m: float, top_quantile: float) -> float:
    """The height that a share of the points of a vehicle exceed, so that a stray return is no roof.

    Args:
      height: (n,) m above the ground, below the next.
      max_height_m: highest that they may have; points above 0.4 of it are counted in 20 levels.
      top_quantile: of the points; those of a level count as spread evenly over it.

    Returns:
      m; at most the highest, and that where no point is in a level.
    """
    if len(height) == 0:
        return 0.0
    edges = np.linspace(LOWEST_LEVEL * max_height_m, max_height_m, NUM_LEVELS + 1)
    left = top_quantile * len(height)
    counts, _ = np.histogram(height, edges)
    for count, low, high in zip(counts[::-1], edges[-2::-1], edges[:0:-1], strict=True):
        if count > left:
            return float(min(high - (high - low) * left / count, height.max()))
        left -= count
    return float(height.max())


def depth_behind_faces(xy: np.ndarray, box: np.ndarray) -> np.ndarray:
    """How far points lie behind the nearest face that a sensor at the origin sees; negative in front.

    Args:
      xy: (n, 2) m.
      box: (5,): x, y, length, width in m and yaw in rad.

    Returns:
      (n,) m; infinite where the sensor is inside the box.
    """
    x, y, length, width, yaw = box
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    local, sensor = (xy - [x, y]) @ turn, np.array([-x, -y]) @ turn
    depth = np.full(len(xy), np.inf)
    for axis, half in enumerate((length / 2, width / 2)):
        if abs(sensor[axis]) > half:
            depth = np.minimum(depth, half - np.sign(sensor[axis]) * local[:, axis])
    return depth


def score_box(
    box: np.ndarray,
    prior: ClassPrior,
    *,
    around: PointsAround,
    objective: float,
    measured_length_m: float,
    measured_width_m: float,
    num_members: int,
    hit: float,
    free_length: float,
    support: float | None,
    top_grade: float,
    min_extent_m: float,
    saturation_points: float,
    sparseness_power: float,
    free_scale: float,
    ring_weight: float,
    overhead_weight: float,
    support_points: float,
    objective_gate: float,
    objective_softness: float,
    recess_share: float,
    upright_score: float,
) -> float:
    """How much a box looks like a vehicle of a class: a product of factors in [0, 1].

    Args:
      box: (5,): x, y, length, width in m and yaw in rad.
      prior: the class.
      around: points in and round the box.
      objective: J of the completion.
      measured_length_m: extent of the fitted points along the box.
      measured_width_m: extent of the fitted points across the box.
      num_members: points of the cluster.
      hit: share of the rays that end at the box.
      free_length: share of the box seen to be free.
      support: ground points round the box, or None where they were not counted.
      top_grade: a vehicle may be higher than its top by this times the range.
      min_extent_m: 0 where both measured extents are shorter.
      saturation_points: factor min(1, members / this)^power.
      sparseness_power: see there.
      free_scale: factor exp(-(free_length / this)^2).
      ring_weight: factor exp(-weight ring / inside).
      overhead_weight: factor exp(-weight overhead / inside).
      support_points: factor min(1, (support + 1/2) / this).
      objective_gate: factor 1 / (1 + exp(-(J - gate) / softness)).
      objective_softness: see there.
      recess_share: factor from `upright_score`, where no upper point is recessed, to 1 from this share on.
      upright_score: see there.

    Returns:
      The score; 0 where a gate of the class closes.
    """
    allowance = top_grade * np.hypot(box[0], box[1])
    top = around.top_m
    if not (prior.min_height_m < top + allowance and top < prior.max_height_m):
        return 0.0
    if measured_length_m < min_extent_m and measured_width_m < min_extent_m:
        return 0.0
    height = min(max(float(prior.height_m), top), top + allowance)
    score = _bell(box[2], prior.length_m, prior.length_below_m, prior.length_above_m)
    score *= _bell(box[3], prior.width_m, prior.width_tolerance_m, prior.width_tolerance_m)
    score *= _bell(height, prior.height_m, prior.height_below_m, prior.height_above_m)
    score *= prior.prior_weight * min(1.0, num_members / saturation_points) ** sparseness_power
    score *= hit * np.exp(-((free_length / free_scale) ** 2))
    clutter = ring_weight * around.ring + overhead_weight * around.overhead
    score *= np.exp(-clutter / max(around.inside, 1))
    share = (around.recessed + DOUBT_POINTS * recess_share) / (around.upper + DOUBT_POINTS)
    score *= upright_score + (1 - upright_score) * min(1.0, share / recess_share)
    if support is not None:
        score *= min(1.0, (support + 0.5) / support_points)
    return float(score * expit((objective - objective_gate) / objective_softness))


def _bell(value, center, below, above) -> float:
    """exp(-(d / w)^2), with another width on either side."""
    return float(np.exp(-(((value - center) / (below if value < center else above)) ** 2)))


def bev_iou(first: np.ndarray, second: np.ndarray) -> float:
    """Overlap of two rectangles in the bird's-eye view: intersection over union.

    Args:
      first: (5,): x, y, length, width in m and yaw in rad.
      second: (5,).

    Returns:
      In [0, 1]; 0 for two boxes without area.
    """
    # OpenCV works in float32: keep the numbers small.
    offset = second[:2] - first[:2]
    rectangles = [
        ((0.0, 0.0), (first[2], first[3]), np.degrees(first[4])),
        ((offset[0], offset[1]), (second[2], second[3]), np.degrees(second[4])),
    ]
    kind, corners = cv2.rotatedRectangleIntersection(*rectangles)
    if kind == cv2.INTERSECT_NONE or corners is None:
        return 0.0
    shared = cv2.contourArea(cv2.convexHull(corners))
    union = first[2] * first[3] + second[2] * second[3] - shared
    return float(np.clip(shared / union, 0.0, 1.0)) if union > 0 else 0.0


def suppress(boxes: np.ndarray, scores: np.ndarray, *, max_overlap: float) -> np.ndarray:
    """Greedy suppression: of two overlapping boxes the one with the higher score stays.

    Args:
      boxes: (k, 5): x, y, length, width in m and yaw in rad.
      scores: (k,); of equal ones the first goes first.
      max_overlap: a larger IoU with a better box that stays suppresses.

    Returns:
      (d,) int, rows of the boxes that stay, best score first.
    """
    kept: list[int] = []
    reach = np.hypot(boxes[:, 2], boxes[:, 3]) / 2
    for row in np.argsort(-scores, kind="stable"):
        gap = np.hypot(*(boxes[kept, :2] - boxes[row, :2]).T)
        rivals = np.array(kept, int)[gap <= reach[kept] + reach[row]]
        if all(bev_iou(boxes[row], boxes[rival]) <= max_overlap for rival in rivals):
            kept.append(int(row))
    return np.array(kept, int)
