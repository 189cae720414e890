"""Vehicle decision: the score of a box, what surrounds it, and non-maximum suppression."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import chex
import jax
import jax.numpy as jnp

from jaxbox.config import ClassPrior, DetectorConfig, RegionConfig, VehicleConfig
from jaxbox.geometry.planar import rectangle_iou, wrap_yaw
from jaxbox.stages._priors import asymmetric_gaussian, closed_free_length, prior_of, size_score
from jaxbox.stages.state import (
    NOT_A_BOX,
    Boxes,
    Candidates,
    Clusters,
    Completed,
    GroundElevation,
    Kept,
    NeighbourhoodCounts,
    Obstacles,
    RayFractions,
)
from jaxbox.xla import chunks
from jaxbox.xla.loops import map_rows
from jaxbox.xla.rows import compact, sum_after, take
from jaxbox.xla.runs import count_kinds, fold_runs, maximum_nonnegative
from jaxbox.xla.sorting import best_first, select_highest, sort_by_group
from jaxbox.xla.suppression import suppress_conflicts

NEARBY_CELL_M = 1.0
"""Points are looked up by cells of this size."""


MAX_CELL_ROWS = 24
"""Rows of cells round a box: a vehicle of 18 m, the longest that passes the gates, with its ring."""


NUM_KINDS = 5
"""Kinds of points that are counted, see `NeighbourhoodCounts`."""


NUM_LEVELS = 20
"""Levels of height in which the points inside are counted, up to the highest that a vehicle's may have."""


LOWEST_LEVEL = 0.4
"""Where the levels begin, as a share of that height: no vehicle's top is lower."""


PSEUDO_COUNT = 5
"""Upper points that are added before the share behind the faces is taken, at the share of the full score, so
that a few points cannot give an extreme share."""


SIDE_DEPTH_M, SIDE_HALF_M = 0.1, 0.25
"""Points beyond the far end whose depth behind the long side that the sensor sees is the first, give or take
the second, go on along that side: they are of what the box holds a part of."""


CUT_SLACK_M, NOT_CUT_M = 0.1, 1e6
"""Tops from so much below the highest beam on are cut off by it, less so the lower they are; and where it
passes when nothing is known of it."""


INSIDE_TOLERANCE_M = 1e-3
"""A point on the face of its box is inside."""


def score_boxes(
    completed: Completed,
    rays: tuple[RayFractions, jax.Array] | None,
    clusters: Clusters,
    obstacles: Obstacles,
    ground_elevation: GroundElevation,
    lowest_z: jax.Array | None,
    steepest: jax.Array | None,
    config: DetectorConfig,
) -> Candidates:
    """Scores the boxes by rays and size, then the best of them by what surrounds them.

    Args:
      completed: Q boxes.
      rays: what the rays over each box met, and the ground support round it; None without evidence.
      clusters: of P rows.
      obstacles: all points above the ground.
      ground_elevation: asks for the ground under points.
      lowest_z: (P,) float32, m, of each cluster's points: it tells which of several planes a vehicle stands
        on; None with one plane.
      steepest: () float32, m/m, rise of the highest beam: it may cut vehicles off; None without evidence.
      config: of the detector.

    Returns:
      The boxes with a score, best first.
    """
    hypotheses, boxes, settings = completed.hypotheses, completed.boxes, config.vehicles
    chex.assert_shape([boxes.center, boxes.yaw], [(*hypotheses.label.shape, 2), hypotheses.label.shape])
    score = _early_scores(completed, rays, clusters, settings)
    chosen, num = select_highest(score, settings.max_candidates, settings.min_score)

    def pick(chosen: jax.Array) -> tuple[jax.Array, ...]:
        box = jax.tree.map(lambda a: take(a, chosen), boxes)
        size = jnp.stack([box.length, box.width, wrap_yaw(box.yaw)], axis=1)
        rectangle = jnp.concatenate([box.center, size], axis=1)
        of_hypothesis = take(hypotheses.label, chosen), take(hypotheses.cluster, chosen)
        return rectangle, *of_hypothesis, take(score, chosen)

    picked = map_rows(pick, chosen, num_rows=num)
    rectangle, label, cluster, early = picked
    around = _look_around(rectangle, label, cluster, early, num, clusters, obstacles, config)

    def finish(rows: tuple[Any, ...]) -> Candidates:
        rectangle, _, cluster, *_ = rows
        z = jnp.zeros_like(rectangle[:, 0]) if lowest_z is None else take(lowest_z, cluster)
        ground = ground_elevation(jnp.concatenate([rectangle[:, :2], z[:, None]], axis=1))
        nearest = jnp.linalg.norm(rectangle[:, :2], axis=1) - rectangle[:, 2] / 2
        reach = NOT_CUT_M * jnp.ones_like(ground) if steepest is None else steepest * nearest - ground
        candidates = _finish(rows, reach, clusters, settings)
        return dataclasses.replace(candidates, bottom=candidates.bottom + ground)

    candidates = map_rows(finish, (*picked, around), num_rows=num)
    order = best_first(candidates.score, num)
    ordered = map_rows(lambda row: jax.tree.map(lambda a: take(a, row), candidates), order, num_rows=num)
    return dataclasses.replace(ordered, num=num)


def _early_scores(
    completed: Completed,
    rays: tuple[RayFractions, jax.Array] | None,
    clusters: Clusters,
    config: VehicleConfig,
) -> jax.Array:
    """(Q,) the part of the score that needs no look at the surroundings; no other part exceeds 1."""
    hypotheses = completed.hypotheses

    def score(rows: tuple[Boxes, jax.Array, jax.Array, tuple[RayFractions, jax.Array] | None]) -> jax.Array:
        boxes, label, cluster, rays = rows
        ones = jnp.ones_like(boxes.yaw)
        hit, free_length, support = ones, 0 * ones, config.support_points * ones
        if rays is not None:
            hit, free_length, support = rays[0].hit, rays[0].free_length, rays[1]
        num_points = take(clusters.num_points, cluster)
        prior = prior_of(config.classes, label)
        if rays is not None:
            free_length = closed_free_length(rays[0], prior)
        by_evidence = evidence_score(num_points, hit, free_length, support, boxes.objective, config)
        by_size = size_score(boxes.length, boxes.width, prior)
        score = by_evidence * by_size * prior.prior_weight
        large_enough = jnp.max(boxes.measured, axis=1) >= config.min_extent_m
        return jnp.where((boxes.objective > NOT_A_BOX) & large_enough, score, 0)

    rows = completed.boxes, hypotheses.label, hypotheses.cluster, rays
    scores = map_rows(score, rows, num_rows=hypotheses.num)
    return jnp.where(jnp.arange(scores.shape[0], dtype=jnp.int32) < hypotheses.num, scores, 0)


def _look_around(
    rectangle: jax.Array,
    label: jax.Array,
    cluster: jax.Array,
    early: jax.Array,
    num: jax.Array,
    clusters: Clusters,
    obstacles: Obstacles,
    config: DetectorConfig,
) -> NeighbourhoodCounts:
    """Counts of the points in and round each box; of its cluster alone where the preset asks for no more."""
    if not config.vehicles.neighbourhood:
        num_points = take(clusters.num_points, cluster).astype(jnp.float32)
        return cluster_alone(num_points, take(clusters.high[:, 2], cluster))
    prior, num_points = prior_of(config.vehicles.classes, label), take(clusters.num_points, cluster)
    dense = jnp.minimum(num_points.astype(jnp.float32) / config.vehicles.saturation_points, 1)
    sure = early * dense**2
    return count_points_around(rectangle, prior, sure, num, obstacles, config.vehicles, config.region)


def _finish(rows: tuple[Any, ...], reach: jax.Array, clusters: Clusters, config: VehicleConfig) -> Candidates:
    """Candidates with their score and height, bottoms above the ground, in the order that they came in."""
    rectangle, label, cluster, score, around = rows
    prior = prior_of(config.classes, label)
    rho = jnp.linalg.norm(rectangle[:, :2], axis=1)
    late, is_cut = neighbourhood_score(around, rho, reach, prior, config)
    height = jnp.maximum(around.top + config.top_margin_m, prior.min_box_height_m)
    height = jnp.where(is_cut, jnp.maximum(height, prior.height_m), height)
    bottom = jnp.zeros_like(height)
    if not config.neighbourhood:
        # The paper keeps the height of the cluster itself.
        bottom = take(clusters.low[:, 2], cluster)
        height = take(clusters.high[:, 2], cluster) - bottom
    total = score * late
    total = jnp.where(total > config.min_score, total, 0)
    return Candidates(rectangle, bottom, height, total, label, cluster, total > 0, jnp.zeros_like(label))


def keep_best(candidates: Candidates, config: VehicleConfig) -> Kept:
    """The candidates that overlap no better one.

    Args:
      candidates: C rows, best score first.
      config: the overlap, and the capacity K.

    Returns:
      K rows; the lowest-scoring beyond the capacity are dropped, and counted.
    """
    chex.assert_shape(candidates.rectangle, (*candidates.valid.shape, 5))
    keep = non_max_suppression(candidates.rectangle, candidates.valid, max_overlap=config.max_overlap)
    row, num = compact(keep, config.max_detections)

    def pick(row: jax.Array) -> tuple[jax.Array, ...]:
        x, y, length, width, yaw = take(candidates.rectangle, row).T
        bottom, height = take(candidates.bottom, row), take(candidates.height, row)
        half_length, half_width = length / 2 + INSIDE_TOLERANCE_M, width / 2 + INSIDE_TOLERANCE_M
        return (
            jnp.stack([x, y, bottom + height / 2], axis=1),
            jnp.stack([length, width, height], axis=1),
            yaw,
            take(candidates.score, row),
            take(candidates.label, row),
            take(candidates.cluster, row),
            jnp.stack([x, y, jnp.cos(yaw), jnp.sin(yaw), half_length, half_width], axis=1),
        )

    return Kept(*map_rows(pick, row, num_rows=num), valid=row < keep.shape[0], num=num)


def count_points_around(
    boxes: jax.Array,
    prior: ClassPrior,
    sure: jax.Array,
    num_boxes: jax.Array,
    obstacles: Obstacles,
    config: VehicleConfig,
    region: RegionConfig,
) -> NeighbourhoodCounts:
    """Counts the points of the whole sweep in and round each box.

    Args:
      boxes: (P, 5) float32: x, y, length, width (m), yaw (rad).
      prior: fields of (P,) float32: points lower than `count_max_height_m` belong to the vehicle, and
        those farther than `recess_m` behind the faces that the sensor sees are recessed; the ring reaches
        `past_ends_m` farther past the ends.
      sure: (P,) float32, in [0, 1]: how sure it is that the box ends where it does. Points beyond a face that
        the sensor does not see are of another thing, and not counted: from the ring's end on where nothing is
        sure, from the margin before the face where all is.
      num_boxes: () int32, rows that hold a box.
      obstacles: all points above the ground.
      config: margin, ring, and what upper points and strays are. A `top_quantile` of 0 makes the highest
        point the top.
      region: that the points lie in.

    Returns:
      The counts; zero for chunks of boxes beyond `num_boxes`.

    Reference: oracle `jaxbox.reference.count_points_around`.
    """
    halves_m, xy, ring_m = (region.half_x_m, region.half_y_m), obstacles.xy, config.ring_m
    shape = [math.ceil(2 * half_m / NEARBY_CELL_M) for half_m in halves_m]

    def cell(position: jax.Array, axis: int) -> jax.Array:
        index = jnp.floor((position + halves_m[axis]) / NEARBY_CELL_M)
        return jnp.clip(index, 0, shape[axis] - 1).astype(jnp.int32)

    cell_of_point = cell(xy[:, 0], 0) * shape[1] + cell(xy[:, 1], 1)
    order, begin, end = sort_by_group(
        lambda i: i, cell_of_point, obstacles.count, shape[0] * shape[1], room=chunks.RUN_ROWS
    )
    points = [jnp.take(values, order, mode="clip") for values in (xy[:, 0], xy[:, 1], obstacles.height)]

    def prepare(rows: tuple[jax.Array, ...]) -> tuple[jax.Array, list[jax.Array], list[jax.Array]]:
        boxes, *others = rows
        frames = _frames(boxes, *others)
        reach = jnp.abs(frames[:, 2:4]) * (frames[:, 6:7] + ring_m)
        reach = reach + jnp.abs(frames[:, 3:1:-1]) * (frames[:, 5:6] + ring_m)
        low = [cell(boxes[:, axis] - reach[:, axis], axis) for axis in (0, 1)]
        return frames, low, [cell(boxes[:, axis] + reach[:, axis], axis) for axis in (0, 1)]

    def look(rows: tuple[jax.Array, list[jax.Array], list[jax.Array]]) -> jax.Array:
        frames, low, high = rows
        i = low[0][:, None] + jnp.arange(MAX_CELL_ROWS, dtype=jnp.int32)[None]
        row = jnp.minimum(i, shape[0] - 1) * shape[1]
        first, after = begin[row + low[1][:, None]], end[row + high[1][:, None]]
        length = jnp.where(i <= high[0][:, None], after - first, 0)
        counts, highest = _count_runs(frames, first, length, points, config)
        inside, above, ring, upper, recessed = counts[:, :NUM_KINDS].T
        top = _top(highest, config.top_quantile * inside, counts[:, NUM_KINDS:], frames[:, -1])
        return jnp.stack([inside, top, above, ring, upper, recessed], axis=1)

    behind_m = ring_m - (ring_m + config.margin_m) * sure
    columns = boxes, prior.count_max_height_m, prior.recess_m, prior.past_ends_m, behind_m
    rows = map_rows(prepare, columns, num_rows=num_boxes)
    return NeighbourhoodCounts(map_rows(look, rows, num_rows=num_boxes, chunk=chunks.BOXES))


def cluster_alone(num_points: jax.Array, top: jax.Array) -> NeighbourhoodCounts:
    """What surrounds boxes of which only the clusters are looked at: nothing.

    Args:
      num_points: (P,) float32, of the clusters.
      top: (P,) float32, m above the ground, of the clusters.

    Returns:
      The counts.
    """
    none = jnp.zeros_like(top)
    return NeighbourhoodCounts(jnp.stack([num_points, top, none, none, none, none], axis=1))


def _frames(
    boxes: jax.Array,
    count_max_height_m: jax.Array,
    recess_m: jax.Array,
    past_ends_m: jax.Array,
    behind_m: jax.Array,
) -> jax.Array:
    """(P, 15) the frames that points round a box are compared in, see `_judge`."""
    x, y, length, width, yaw = boxes.T
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    half_l, half_w = length / 2, width / 2
    # The sensor at the origin, in the box's frame: it sees the faces on its side of the box.
    sensor_u, sensor_v = -(x * cos + y * sin), x * sin - y * cos
    sides = (sensor_u, half_l), (sensor_v, half_w)
    near = [jnp.where(jnp.abs(sensor) > half, half - recess_m, jnp.inf) for sensor, half in sides]
    far = [jnp.where(jnp.abs(sensor) > half, -half - behind_m, -jnp.inf) for sensor, half in sides]
    facing = jnp.sign(sensor_u), jnp.sign(sensor_v)
    side_v = jnp.where(jnp.abs(sensor_v) > half_w, half_w - SIDE_DEPTH_M, jnp.inf)
    half = half_l, half_w, half_l + past_ends_m
    columns = x, y, cos, sin, *half, *facing, *near, *far, side_v, count_max_height_m
    return jnp.stack(columns, axis=1)


def _count_runs(
    frames: jax.Array,
    first: jax.Array,
    length: jax.Array,
    points: Sequence[jax.Array],
    config: VehicleConfig,
) -> tuple[jax.Array, jax.Array]:
    """Counts over runs of neighbouring points, some for each box, (C, runs).

    Returns:
      counts: (C, kinds + levels) float32.
      highest: (C,) float32, m.
    """

    def update(
        state: tuple[jax.Array, jax.Array], box: jax.Array, valid: jax.Array, columns: list[jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        counts, highest = _judge(frames[box], valid, columns, config)
        return state[0].at[box].add(counts), state[1].at[box].max(highest)

    num_boxes = first.shape[0]
    none = jnp.zeros((num_boxes, NUM_KINDS + NUM_LEVELS), jnp.int32), jnp.zeros(num_boxes, jnp.float32)
    counts, highest = fold_runs(update, none, first, length, points)
    return counts.astype(jnp.float32), highest


def _judge(
    frames: jax.Array, valid: jax.Array, points: Sequence[jax.Array], config: VehicleConfig
) -> tuple[jax.Array, jax.Array]:
    """Counts of each kind and level of points in blocks (B, L) of them, and the highest inside (B,)."""
    columns = [frames[:, k, None] for k in range(frames.shape[1])]
    box_x, box_y, cos, sin, half_l, half_w, ring_half_l, facing_u, facing_v, *faces, max_height = columns
    near_u, near_v, far_u, far_v, side_v = faces
    x, y, height = points
    dx, dy = x - box_x, y - box_y
    u, v = dx * cos + dy * sin, dy * cos - dx * sin
    toward_u, toward_v = facing_u * u, facing_v * v
    is_along = jnp.abs(toward_v - side_v) < SIDE_HALF_M
    is_behind = (toward_v < far_v) | (toward_u < far_u) & ~is_along
    out_u, out_v = jnp.abs(u), jnp.where(valid & ~is_behind, jnp.abs(v) - half_w, jnp.inf)
    inside, low = jnp.maximum(out_u - half_l, out_v) < config.margin_m, height < max_height
    upper = inside & low & (height > config.upper_height_m)
    recessed = upper & (toward_u < near_u) & (toward_v < near_v)
    ring = ~inside & low & (jnp.maximum(out_u - ring_half_l, out_v) < config.ring_m)
    kinds = inside & low, inside & ~low, ring, upper, recessed
    share = height / max_height - LOWEST_LEVEL
    level = jnp.minimum(share * (NUM_LEVELS / (1 - LOWEST_LEVEL)), NUM_LEVELS - 1).astype(jnp.int32)
    level = jnp.where(inside & low & (share > 0), level, NUM_LEVELS)
    counts = count_kinds(kinds, level, NUM_LEVELS)
    return counts, maximum_nonnegative(jnp.where(inside & low, height, 0))


def _top(highest: jax.Array, num_stray: jax.Array, levels: jax.Array, max_height: jax.Array) -> jax.Array:
    """(P,) the height that that many points exceed, evenly spread within their level (P, levels)."""
    higher = sum_after(levels)
    num_stray = num_stray[:, None]
    is_top = (higher <= num_stray) & (num_stray < higher + levels)
    above = jnp.arange(NUM_LEVELS, 0, -1, dtype=jnp.float32)[None] - 1
    above = above + (num_stray - higher) / jnp.maximum(levels, 1)
    share = jnp.sum(jnp.where(is_top, 1 - above * ((1 - LOWEST_LEVEL) / NUM_LEVELS), 0), axis=1)
    return jnp.where(jnp.any(is_top, axis=1), jnp.minimum(share * max_height, highest), highest)


def evidence_score(
    num_points: jax.Array,
    hit: jax.Array,
    free_length: jax.Array,
    support: jax.Array,
    objective: jax.Array,
    config: VehicleConfig,
) -> jax.Array:
    """The part of the score that the rays and the cluster decide.

    Args:
      num_points: (P,) int32, points of the cluster.
      hit: (P,) float32, fraction of rays.
      free_length: (P,) float32, fraction of the rays' length.
      support: (P,) float32, ground points round the box.
      objective: (P,) float32, J of the box.
      config: (points / saturation)^power, exp(-(free_length / scale)^2), full score from that many ground
        points, and 1 / (1 + exp(-(J - gate) / softness)).

    Returns:
      (P,) float32 in [0, 1].
    """
    dense = jnp.minimum(num_points.astype(jnp.float32) / config.saturation_points, 1)
    dense = dense**config.sparseness_power
    grounded = jnp.minimum((support + 0.5) / config.support_points, 1)
    gate = jax.nn.sigmoid((objective - config.objective_gate) / config.objective_softness)
    return dense * jnp.exp(-((free_length / config.free_scale) ** 2)) * hit * grounded * gate


def neighbourhood_score(
    around: NeighbourhoodCounts, rho: jax.Array, reach: jax.Array, prior: ClassPrior, config: VehicleConfig
) -> tuple[jax.Array, jax.Array]:
    """The part of the score that the points in and round the box decide.

    The true top lies between the top of the points and that plus the beams' spacing; it is compared with the
    class at the place in between that suits it best. Where the highest beam cuts the box off, it may lie
    anywhere above: then the height says nothing, and counts less.

    Args:
      around: see `count_points_around`.
      rho: (P,) float32, m, range of the box.
      reach: (P,) float32, m above the ground: height of the highest beam where the box begins.
      prior: fields of (P,) float32.
      config: exp(-(ring weight x ring + overhead weight x above) / inside), and what upright boxes lose:
        those with few upper points come near to the full score. Points above count as far as they are
        connected: from a gap of `overhead_gap_m` on less and less, from twice that on not at all.

    Returns:
      score: (P,) float32 in [0, 1]; 0 where a gate fails.
      is_cut: (P,) bool, whether it is that of a box that the highest beam cuts off.
    """
    highest = around.top + config.top_grade * rho
    clearance = prior.count_max_height_m - highest
    connected = jnp.clip(2 - clearance / config.overhead_gap_m, 0, 1)
    overhead = config.overhead_weight * connected * around.num_above
    clutter = (config.ring_weight * around.num_ring + overhead) / jnp.maximum(around.num_inside, 1)
    score, is_cut = _height_score(around.top, highest, reach, prior, config)
    score = score * jnp.exp(-clutter)
    recessed = around.num_recessed + PSEUDO_COUNT * config.recess_share
    recessed = recessed / (around.num_upper + PSEUDO_COUNT)
    upright = config.upright_score + (1 - config.upright_score) * jnp.minimum(
        recessed / config.recess_share, 1
    )
    return score * upright, is_cut


def _height_score(
    top: jax.Array, highest: jax.Array, reach: jax.Array, prior: ClassPrior, config: VehicleConfig
) -> tuple[jax.Array, jax.Array]:
    """(P,) how well tops suit the class, and whether that is as the highest beam cuts the boxes off."""
    widths = prior.height_below_m, prior.height_above_m
    seen = asymmetric_gaussian(jnp.clip(prior.height_m, top, highest), prior.height_m, *widths)
    seen = jnp.where(highest > prior.min_height_m, seen, 0)
    cut = config.cut_score * jnp.clip(1 + (top - reach) / CUT_SLACK_M, 0, 1)
    cut = cut * asymmetric_gaussian(jnp.maximum(prior.height_m, top), prior.height_m, *widths)
    cut = jnp.where(top > prior.min_cut_height_m, cut, 0)
    return jnp.where(top < prior.max_height_m, jnp.maximum(seen, cut), 0), cut > seen


def non_max_suppression(boxes: jax.Array, valid: jax.Array, *, max_overlap: jax.Array | float) -> jax.Array:
    """Keeps each box that overlaps no better one that is kept (greedy non-maximum suppression).

    Args:
      boxes: (P, 5) float32: x, y, length, width, yaw; best first.
      valid: (P,) bool, rows that hold a box, all before the others.
      max_overlap: largest bird's-eye view IoU of two boxes that are both kept.

    Returns:
      (P,) bool.

    Reference: oracle `jaxbox.reference.non_max_suppression`.
    """
    return suppress_conflicts(boxes, valid, lambda a, b: rectangle_iou(a, b) > max_overlap)
