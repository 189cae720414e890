"""Correction for occluded vehicles: hypotheses for the sides that are out of sight."""

import dataclasses
import itertools
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from jaxbox.config import ClassPrior, CompletionConfig, DetectorConfig, Scalar, VehicleConfig
from jaxbox.reference.evidence import cast_rays, closed_free_length, is_raised
from jaxbox.reference.rows import find_rows, hit_share, visible_end
from jaxbox.reference.state import (
    Assignment,
    ClassHypothesis,
    Cluster,
    Completed,
    CompletedBox,
    Evidence,
    RayFractions,
    Rectangle,
)
from jaxbox.types import Label

CERTAIN = np.inf
"""Objective of a box without evidence: it passes every gate."""
INSIDE_MARGIN_M = 0.1
"""A fitted point this far outside a hypothesis still counts as inside."""
FACE_OVERHANG_M = 0.3
"""A face speaks for the points up to this beyond its ends."""
NEAR_M = 0.1
"""Fitted points nearer to a visible face than this count as on it."""
AWAY, TOWARDS, BOTH = 0, 1, 2
"""Placements: which way a completed side extends, as seen from the sensor."""
SEEN_RAMP = 0.05
"""Share of the usual size over which a side goes from partly hidden to seen whole."""
BLEND_FROM_DEG, BLEND_ALL_DEG, BLEND_TO_DEG = 8, 12, 30.5
"""Boxes turned against each other by more than the first are blended, by the second and more in full, up to
the third."""
MIN_LOSS = 1e-6
"""Objectives nearer than this are equal."""
LOWER_PART_M = 0.5
"""A cluster may be so much lower than its vehicle."""


def complete_boxes(
    candidates: Sequence[Sequence[Rectangle]],
    outlines: Sequence[np.ndarray],
    clusters: Sequence[Cluster],
    evidence: Evidence | None,
    config: DetectorConfig,
) -> Completed:
    """The completed box of every class hypothesis that has one.

    Args:
      candidates: rectangles of the clusters, one or four lists of them.
      outlines: (n, 2) m, the points that those were fitted to.
      clusters: of all maps.
      evidence: of the sweep, or None.
      config: of the detector.

    Returns:
      The hypotheses and their boxes.
    """
    listed = list_hypotheses(clusters, candidates[0], config.vehicles)
    in_row: set[tuple[int, int, int]] = set()
    if config.completion.mode == "evidence":
        may_be = [hypothesis.cluster for hypothesis in listed if hypothesis.label == 0]
        in_row = sides_in_rows(may_be, candidates, config.vehicles.classes[0], config.completion)
    hypotheses, boxes, num_assignments = [], [], 0
    for hypothesis in listed:
        prior = config.vehicles.classes[hypothesis.label]
        rectangles = [each[hypothesis.cluster] for each in candidates]
        if config.completion.mode == "evidence":
            num_assignments += count_assignments(rectangles, prior)
        sides = [(i, side) for row, i, side in in_row if (row, 0) == (hypothesis.cluster, hypothesis.label)]
        box = complete_box(
            outlines[hypothesis.cluster], rectangles, prior, evidence, config.completion, in_row=sides
        )
        if box is not None:
            hypotheses.append(hypothesis)
            boxes.append(box)
    return Completed(hypotheses, boxes, num_assignments)


def sides_in_rows(
    clusters: Sequence[int],
    candidates: Sequence[Sequence[Rectangle]],
    prior: ClassPrior,
    config: CompletionConfig,
) -> set[tuple[int, int, int]]:
    """Which sides of rectangles are the lengths of vehicles in a row, see `find_rows`.

    Args:
      clusters: those that may be of the class.
      candidates: rectangles of all clusters, one or four lists of them.
      prior: of the class.
      config: of the rows.

    Returns:
      Cluster, list and side of each.
    """
    ends = {}
    for cluster, (i, rectangles), side in itertools.product(clusters, enumerate(candidates), (0, 1)):
        sides = assign_length_axis(rectangles[cluster], side)
        end = visible_end(sides, prior) if fits(sides, prior) else None
        if end is not None:
            ends[cluster, i, side] = end
    found = find_rows(np.array(list(ends.values())).reshape(-1, 3), float(prior.width_m), config)
    return set(itertools.compress(ends, found))


def list_hypotheses(
    clusters: Sequence[Cluster], rectangles: Sequence[Rectangle], config: VehicleConfig
) -> list[ClassHypothesis]:
    """Lists the first class of all clusters, then each other class of the large ones.

    Args:
      clusters: of all maps.
      rectangles: of the clusters.
      config: the classes, and what large clusters are.

    Returns:
      The hypotheses, but for clusters that are too low for any class.
    """
    every = list(range(len(clusters)))
    large = [row for row in every if is_large(clusters[row], config)][: config.max_large]
    return [
        ClassHypothesis(row, label)
        for label in Label
        for row in (large if label else every)
        if _may_be_high_enough(clusters[row], rectangles[row], config)
    ]


def is_large(cluster: Cluster, config: VehicleConfig) -> bool:
    """Whether a cluster is tried as other classes than the first: high, and standing on the ground.

    Args:
      cluster: of any map.
      config: how high, from where on, and of how many points.

    Returns:
      True for those.
    """
    stands = cluster.bottom_m < config.large_clearance_m
    enough = len(cluster.members) >= config.large_min_points
    return bool(stands and enough and cluster.top_m > config.large_height_m)


def _may_be_high_enough(cluster: Cluster, rectangle: Rectangle, config: VehicleConfig) -> bool:
    """Whether a cluster can be (the lower part of) a vehicle of the lowest class."""
    u0, u1, v0, v1 = rectangle.extents
    allowance = config.top_grade * np.hypot((u0 + u1) / 2, (v0 + v1) / 2)
    lowest = min(float(prior.min_height_m) for prior in config.classes)
    return bool(cluster.top_m + allowance > lowest - LOWER_PART_M)


def count_assignments(rectangles: Sequence[Rectangle], prior: ClassPrior) -> int:
    """Sides of the rectangles that may be the length of a class; those at one rotation count once.

    Args:
      rectangles: of a cluster.
      prior: of the class.

    Returns:
      None to two a rectangle.
    """
    distinct = {rectangle.angle: rectangle for rectangle in rectangles}.values()
    return sum(fits(assign_length_axis(rectangle, side), prior) for rectangle in distinct for side in (0, 1))


def complete_box(
    xy: np.ndarray,
    rectangles: Sequence[Rectangle],
    prior: ClassPrior,
    evidence: Evidence | None,
    config: CompletionConfig,
    *,
    in_row: Collection[tuple[int, int]] = (),
) -> CompletedBox | None:
    """Completes a rectangle round a cluster to the size of a vehicle class.

    "evidence" tries each side of each rectangle as the length, extended away from the sensor, with the
    width extended away from it, towards it, or both ways, and takes the largest objective (see
    `placement_objectives`), blended with others (see `blend_boxes`). Boxes are judged at the class's size,
    and answered at their likely size (see `likely_sizes`). "away" takes the longer side of the first
    rectangle as the length and extends both away; "none" changes nothing.

    Args:
      xy: (n, 2) m, sensor frame: the fitted points.
      rectangles: of the cluster, at one rotation or more.
      prior: of the class.
      evidence: of the sweep; None only where the mode is another.
      config: the mode and its weights.
      in_row: the rectangles and sides that are in a row of vehicles, see `find_rows`.

    Returns:
      The box, or None where the measured sides are too long for the class.
    """
    if config.mode != "evidence":
        sides = longer_side(rectangles[0])
        return keep_measured(sides, prior) if config.mode == "none" else extend_away(sides, prior, config)
    assert evidence is not None
    assignments = complete_assignments(xy, rectangles, prior, evidence, config, in_row=in_row)
    boxes = [max(placed, key=lambda box: box.objective) for placed in assignments]
    return blend_boxes(boxes, max_loss=config.blend_objective) if boxes else None


def complete_assignments(
    xy: np.ndarray,
    rectangles: Sequence[Rectangle],
    prior: ClassPrior,
    evidence: Evidence,
    config: CompletionConfig,
    *,
    in_row: Collection[tuple[int, int]] = (),
) -> list[list[CompletedBox]]:
    """What `complete_box` chooses from: the placements of each length-axis assignment, not blended.

    Args:
      xy: (n, 2) m, sensor frame: the fitted points.
      rectangles: of the cluster; one at the angle of an earlier one has nothing to add.
      prior: of the class.
      evidence: of the sweep.
      config: the weights.
      in_row: the rectangles and sides that are in a row of vehicles, see `find_rows`.

    Returns:
      Three boxes for each side that fits the class, of the first rectangle before those of the second.
    """
    assignments: list[list[CompletedBox]] = []
    for i, rectangle in enumerate(rectangles):
        if any(rectangle.angle == before.angle for before in rectangles[:i]):
            continue
        for side in (0, 1):
            sides = assign_length_axis(rectangle, side)
            if not fits(sides, prior):
                continue
            between = (i, side) in in_row
            placed = place_widths(sides, prior)
            rays = cast_rays(evidence, placed, num_rays=config.num_rays, raised=is_raised(prior))
            free_length, hit = closed_free_length(rays, prior), hit_share(rays, between)
            rays = dataclasses.replace(rays, hit=hit, free_length=free_length)
            agreement = point_agreement(placed, xy, config)
            objectives = placement_objectives(rectangle.score, agreement, rays, config)
            if (i, 1 - side) in in_row:
                objectives -= float(config.along_row_cost)
            sizes = likely_sizes(sides, prior, config)
            boxes = [place(sides, sizes, number, float(worth)) for number, worth in enumerate(objectives)]
            assignments.append([dataclasses.replace(box, in_row=between) for box in boxes])
    return assignments


def blend_boxes(boxes: Sequence[CompletedBox], *, max_loss: Scalar) -> CompletedBox:
    """The best of a cluster's boxes, blended with those turned from it that are nearly as good.

    Args:
      boxes: at least one, with finite objectives.
      max_loss: by how much less an objective may be; the weight falls to 0 there.

    Returns:
      The box, with the objective, and all else, of the first of the best.
    """
    best = max(boxes, key=lambda box: box.objective)
    weights, turns = [], []
    for box in boxes:
        turn = (box.box[4] - best.box[4] + np.pi / 2) % np.pi - np.pi / 2
        degrees = abs(np.degrees(turn))
        near = np.clip(1 - (best.objective - box.objective) / max(float(max_loss), MIN_LOSS), 0, 1)
        apart = np.clip((degrees - BLEND_FROM_DEG) / (BLEND_ALL_DEG - BLEND_FROM_DEG), 0, 1)
        weights.append(1.0 if box is best else near * apart * (degrees < BLEND_TO_DEG))
        turns.append(turn)

    def mean(values: Sequence[Any]) -> Any:
        return np.average(np.array(values), axis=0, weights=weights)

    return dataclasses.replace(
        best,
        box=np.append(mean([box.box[:4] for box in boxes]), best.box[4] + mean(turns)),
        measured_length_m=float(mean([box.measured_length_m for box in boxes])),
        measured_width_m=float(mean([box.measured_width_m for box in boxes])),
    )


def assign_length_axis(rectangle: Rectangle, side: int) -> Assignment:
    """Takes one side of a rectangle as its length: 0 that along u, 1 that along v."""
    u0, u1, v0, v1 = rectangle.extents
    if side == 0:
        return Assignment((u0, u1), (v0, v1), rectangle.angle)
    # Turning the axes by a quarter turn takes (u, v) to (v, -u).
    return Assignment((v0, v1), (-u1, -u0), rectangle.angle + np.pi / 2)


def longer_side(rectangle: Rectangle) -> Assignment:
    """The assignment with the longer side as length."""
    along_u, along_v = rectangle.sides_m
    return assign_length_axis(rectangle, int(along_v > along_u))


def fits(sides: Assignment, prior: ClassPrior) -> bool:
    """Whether the measured sides fit into the largest vehicle of the class."""
    length, width = sides.measured
    return bool(length <= prior.max_length_m and width <= prior.max_width_m)


def keep_measured(sides: Assignment, prior: ClassPrior) -> CompletedBox | None:
    """The rectangle as measured (the paper); None where it is too large for the class."""
    return place(sides, sides.measured, AWAY, CERTAIN) if fits(sides, prior) else None


def extend_away(sides: Assignment, prior: ClassPrior, config: CompletionConfig) -> CompletedBox | None:
    """Both sides completed away from the sensor to their likely sizes; None where they are too long."""
    return place(sides, likely_sizes(sides, prior, config), AWAY, CERTAIN) if fits(sides, prior) else None


def share_seen(measured_m: float, usual_m: Scalar, seen: Scalar) -> float:
    """How sure it is that a side is seen whole: from 0 at the fraction `seen` of its usual size to 1 soon."""
    return float(np.clip((measured_m / usual_m - seen) / SEEN_RAMP, 0, 1))


def share_of_length_seen(measured_m: float, prior: ClassPrior, seen: Scalar) -> float:
    """How sure it is that a length is seen whole: from less than `seen` on where a class's lengths differ."""
    least = min(float(seen), float(prior.whole_from_m / prior.length_m))
    return share_seen(measured_m, prior.length_m, least)


def likely_size(
    measured_m: float, usual_m: Scalar, whole: float, *, weight: Scalar = 1.0, margin_m: Scalar = 0.0
) -> float:
    """The usual size of a side that may be hidden in part, the measured one of a side that is seen whole.

    Args:
      measured_m: m, how much of it shows.
      usual_m: m, of the class.
      whole: how sure it is that it is seen whole.
      weight: of the measured size then.
      margin_m: by how much measured sides read short.

    Returns:
      m, at least as measured.
    """
    return float(max(usual_m + weight * whole * (measured_m + margin_m - usual_m), measured_m))


def likely_sizes(sides: Assignment, prior: ClassPrior, config: CompletionConfig) -> tuple[float, float]:
    """The class's size for sides that may be hidden in part; between it and the measured for the others.

    Args:
      sides: as measured.
      prior: of the class.
      config: from which share of the class's size on a side may be seen whole, what its measured size
        weighs then, and by how much measured sides read short.

    Returns:
      Length and width, m, at least as measured.
    """
    length, width = sides.measured
    whole = (
        share_of_length_seen(length, prior, config.seen_length),
        share_seen(width, prior.width_m, config.seen_width),
    )
    weight, margins_m = config.seen_weight, (config.length_margin_m, config.width_margin_m)
    return (
        likely_size(length, prior.length_m, whole[0], weight=weight, margin_m=margins_m[0]),
        likely_size(width, prior.width_m, whole[1], weight=weight, margin_m=margins_m[1]),
    )


def extend(side: tuple[float, float], size_m: float) -> tuple[tuple[float, float, float], float]:
    """Grows an interval to a size, if it is shorter: away from the sensor, towards it, and both ways.

    Args:
      side: m, along an axis through the sensor.
      size_m: the size.

    Returns:
      The three middles, in the order of the placements, and the size, m.

    >>> extend((5.0, 7.0), 4.0)
    ((7.0, 5.0, 6.0), 4.0)
    """
    low, high = side
    size_m = max(size_m, high - low)
    from_low, from_high = low + size_m / 2, high - size_m / 2
    # The nearer end is the lower one where the middle is positive, also for an interval of no length.
    away, towards = (from_low, from_high) if low + high > 0 else (from_high, from_low)
    return (away, towards, (low + high) / 2), size_m


def place(sides: Assignment, sizes: tuple[float, float], placement: int, objective: float) -> CompletedBox:
    """A box of a size: the length away from the sensor, the width where the placement says."""
    (along, _, _), length = extend(sides.along, sizes[0])
    middles, width = extend(sides.across, sizes[1])
    cos, sin = np.cos(sides.yaw), np.sin(sides.yaw)
    across = middles[placement]
    box = np.array([cos * along - sin * across, sin * along + cos * across, length, width, sides.yaw])
    return CompletedBox(box, objective, *sides.measured)


def place_widths(sides: Assignment, prior: ClassPrior) -> np.ndarray:
    """Completes boxes to the class's size, or the measured where that is larger, or may be the whole length.

    Args:
      sides: as measured.
      prior: of the class.

    Returns:
      (3, 5) boxes, one a placement; the length is completed away from the sensor.
    """
    whole = share_of_length_seen(sides.measured[0], prior, 1.0)
    sizes = likely_size(sides.measured[0], prior.length_m, whole), float(prior.width_m)
    return np.array([place(sides, sizes, placement, CERTAIN).box for placement in (AWAY, TOWARDS, BOTH)])


def point_agreement(boxes: np.ndarray, xy: np.ndarray, config: CompletionConfig) -> np.ndarray:
    """How well boxes hold the points they were made from, and how close these are to visible faces.

    Args:
      boxes: (B, 5): x, y, length, width in m and yaw in rad.
      xy: (n, 2) m, sensor frame, n >= 1.
      config: weights of the share of the points within the box and its margin, and of the mean of
        .1 / max(d, .1), d the distance to the nearest visible face.

    Returns:
      (B,) weighted sum of both.
    """
    inside, near = np.zeros(len(boxes)), np.zeros(len(boxes))
    for row, (x, y, length, width, yaw) in enumerate(boxes):
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        local, sensor = (xy - [x, y]) @ turn, np.array([-x, -y]) @ turn
        half = np.array([length, width]) / 2
        inside[row] = np.mean((np.abs(local) < half + INSIDE_MARGIN_M).all(axis=1))
        distance = np.full(len(xy), np.inf)
        for axis in range(2):
            facing = np.abs(local[:, 1 - axis]) < half[1 - axis] + FACE_OVERHANG_M
            if abs(sensor[axis]) > half[axis]:
                face = half[axis] if sensor[axis] > 0 else -half[axis]
                to_face = np.where(facing, np.abs(local[:, axis] - face), np.inf)
                distance = np.minimum(distance, to_face)
        near[row] = np.mean(NEAR_M / np.maximum(distance, NEAR_M))
    return float(config.inside_weight) * inside + float(config.near_weight) * near


def placement_objectives(
    score: float, agreement: np.ndarray, rays: RayFractions, config: CompletionConfig
) -> np.ndarray:
    """How well the placements of an assignment explain the evidence; the first of the best is chosen.

    J = hit - wf free - wl free_length + agreement + wc score - cost [width not away].

    Args:
      score: of the rectangle.
      agreement: (3,), see `point_agreement`.
      rays: (3,) fractions.
      config: wf, wl, wc and the cost.

    Returns:
      (3,) J.
    """
    objective = rays.hit - config.free_weight * rays.free - config.free_length_weight * rays.free_length
    objective = objective + agreement + config.closeness_weight * score
    return objective - config.not_away_cost * np.array([0, 1, 1])
