"""Vehicle decision: the score of a box, what surrounds it, and non-maximum suppression."""

import dataclasses
import math
from typing import Any

import chex
import jax
import jax.numpy as jnp

from jaxbox.config import ClassPrior, CompletionConfig, DetectorConfig, VehicleConfig
from jaxbox.geometry.planar import wrap_yaw
from jaxbox.stages._assignments import share_of_length_seen
from jaxbox.stages._priors import asymmetric_gaussian, closed_free_length, prior_of, size_score
from jaxbox.stages._rows import find_lines, hit_share
from jaxbox.stages._suppression import non_max_suppression
from jaxbox.stages._surroundings import (
    cluster_alone,
    count_points_around,
    sensor_from,
    sensor_outside,
    stand_on_ground,
)
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
from jaxbox.xla.indexing import take
from jaxbox.xla.loops import map_rows
from jaxbox.xla.rows import compact
from jaxbox.xla.sorting import best_first, select_highest

PSEUDO_COUNT = 5
"""Upper points that are added before the share behind the faces is taken, at the share of the full score, so
that a few points cannot give an extreme share."""


CUT_SLACK_M, NOT_CUT_M = 0.1, 1e6
"""Tops from so much below the highest beam on are cut off by it, less so the lower they are; and where it
passes when nothing is known of it."""


UPRIGHT_RAMP_M = 0.1
"""So much above the least height of an upright rear it is one in full."""

BUMPER_RAMP_M = 10.0
"""What is seen of a far vehicle is more and more often a bumper alone: over so much range."""

NEARLY_WIDE = 0.6, 0.8
"""Between these measured fractions of the class's width a bumper is believed to be one, and a rear whole."""


WIDE = 0.4
"""From this fraction of the class's width on a box has two faces, as walls seldom have."""


INSIDE_TOLERANCE_M = 1e-3
"""A point on the face of its box is inside."""


MAX_END_MARGIN_M = 0.4
"""Beams that graze a side lie farther apart, but say little of its end."""


def score_boxes(
    completed: Completed,
    rays: RayFractions | None,
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
      rays: what the rays over each box met; None without evidence.
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
        is_open = jnp.ones_like(box.yaw) if rays is None else take(rays.open, chosen)
        return rectangle, *of_hypothesis, take(score, chosen), box.measured, box.in_row, is_open

    picked = map_rows(pick, chosen, num_rows=num)
    rectangle, label, cluster, early, _, in_row, _ = picked
    in_threes = in_row
    if settings.neighbourhood:
        in_threes = in_threes | find_lines(rectangle, early, label == 0, settings)
    around = _look_around(rectangle, label, cluster, early, in_threes, num, clusters, obstacles, config)

    def finish(rows: tuple[Any, ...]) -> Candidates:
        rectangle, label, cluster, score, measured, in_row, is_open, around, in_threes = rows
        # Slivers stand in rows and lines, or are none: the others there show how long they are.
        is_sliver = jnp.max(measured, axis=1) < settings.min_extent_m
        score = jnp.where(is_sliver & ~in_threes, 0, score)
        if config.vehicles.neighbourhood and config.completion.mode != "none":
            ended, seen = _end_where_seen(rectangle, label, measured[:, 0], around, config)
            rectangle = jnp.where(in_row[:, None], rectangle, ended)
            seen = jnp.where(is_sliver, 1, seen)
            score = score * (seen + settings.hidden_length_score * (1 - seen))
        z = jnp.zeros_like(rectangle[:, 0]) if lowest_z is None else take(lowest_z, cluster)
        ground, lower = stand_on_ground(rectangle, z, ground_elevation, settings)
        nearest = jnp.hypot(*sensor_outside(rectangle))
        reach = NOT_CUT_M * jnp.ones_like(ground) if steepest is None else steepest * nearest - ground
        row = rectangle, label, cluster, score, measured[:, 1], is_open, around, in_threes
        candidates = _finish(row, reach, clusters, settings)
        bottom, height = candidates.bottom + ground - lower, candidates.height + lower
        return dataclasses.replace(candidates, bottom=bottom, height=height)

    # Many at a time where they are looked up in the ground grid, see `map_rows`.
    chunk = chunks.BOXES if config.ground.surface else 1
    candidates = map_rows(finish, (*picked, around, in_threes), num_rows=num, chunk=chunk)
    order = best_first(candidates.score, num)
    ordered = map_rows(lambda row: jax.tree.map(lambda a: take(a, row), candidates), order, num_rows=num)
    return dataclasses.replace(ordered, num=num)


def _early_scores(
    completed: Completed,
    rays: RayFractions | None,
    clusters: Clusters,
    config: VehicleConfig,
) -> jax.Array:
    """(Q,) the part of the score that needs no look at the surroundings; no other part exceeds 1."""
    hypotheses = completed.hypotheses

    def score(rows: tuple[Boxes, jax.Array, jax.Array, RayFractions | None]) -> jax.Array:
        boxes, label, cluster, rays = rows
        prior = prior_of(config.classes, label)
        ones = jnp.ones_like(boxes.yaw)
        hit, free_length = ones, 0 * ones
        if rays is not None:
            hit, free_length = hit_share(rays, boxes.in_row), closed_free_length(rays, prior)
        num_points = take(clusters.num_points, cluster)
        rho = jnp.linalg.norm(boxes.center, axis=1)
        by_evidence = evidence_score(num_points, hit, free_length, boxes.objective, config)
        by_size = size_score(boxes.length, boxes.width, prior)
        score = by_evidence * by_size * prior.prior_weight * far_score(rho, prior, config)
        large_enough = jnp.max(boxes.measured, axis=1) >= config.row_extent * config.min_extent_m
        return jnp.where((boxes.objective > NOT_A_BOX) & large_enough, score, 0)

    rows = completed.boxes, hypotheses.label, hypotheses.cluster, rays
    scores = map_rows(score, rows, num_rows=hypotheses.num)
    return jnp.where(jnp.arange(scores.shape[0], dtype=jnp.int32) < hypotheses.num, scores, 0)


def _look_around(
    rectangle: jax.Array,
    label: jax.Array,
    cluster: jax.Array,
    early: jax.Array,
    in_threes: jax.Array,
    num: jax.Array,
    clusters: Clusters,
    obstacles: Obstacles,
    config: DetectorConfig,
) -> NeighbourhoodCounts:
    """Counts of the points in and round each box; of its cluster alone where the preset asks for no more.

    Between neighbours what is round a box is theirs: the surer the box is, the less it counts.
    """
    num_points = take(clusters.num_points, cluster).astype(jnp.float32)
    if not config.vehicles.neighbourhood:
        return cluster_alone(num_points, take(clusters.high[:, 2], cluster))
    prior = prior_of(config.vehicles.classes, label)
    sure = early * jnp.minimum(num_points / config.vehicles.saturation_points, 1) ** 2
    around = count_points_around(rectangle, prior, sure, num, obstacles, config.vehicles, config.region)
    return around.with_ring(jnp.where(in_threes, 1 - sure, 1) * around.num_ring)


def _end_where_seen(
    rectangles: jax.Array,
    label: jax.Array,
    measured_m: jax.Array,
    around: NeighbourhoodCounts,
    config: DetectorConfig,
) -> tuple[jax.Array, jax.Array]:
    """The rectangles (P, 5) with their ends where they are seen, and how sure their length is (P,)."""
    prior = prior_of(config.vehicles.classes, label)
    beam_angle = 2 * math.pi / config.evidence.num_azimuths
    ended, seen = end_where_seen(rectangles, around, prior, config.completion, beam_angle)
    return ended, jnp.maximum(seen, share_of_length_seen(measured_m, prior, config.completion.seen_length))


def _finish(rows: tuple[Any, ...], reach: jax.Array, clusters: Clusters, config: VehicleConfig) -> Candidates:
    """Candidates with their score and height, bottoms above the ground, in the order that they came in."""
    rectangle, label, cluster, score, seen_width_m, is_open, around, in_threes = rows
    prior = prior_of(config.classes, label)
    rho = jnp.linalg.norm(rectangle[:, :2], axis=1)
    where = rho, reach, seen_width_m, is_open, in_threes
    late, top_unseen = neighbourhood_score(around, *where, prior, config)
    height = jnp.maximum(around.top + config.top_margin_m, prior.min_box_height_m)
    height = jnp.where(top_unseen, jnp.maximum(height, prior.height_m), height)
    bottom = jnp.zeros_like(height)
    if not config.neighbourhood:
        # The paper keeps the height of the cluster itself.
        bottom = take(clusters.low[:, 2], cluster)
        height = take(clusters.high[:, 2], cluster) - bottom
    total = score * late * own_score(around, take(clusters.num_points, cluster), prior)
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


def evidence_score(
    num_points: jax.Array,
    hit: jax.Array,
    free_length: jax.Array,
    objective: jax.Array,
    config: VehicleConfig,
) -> jax.Array:
    """The part of the score that the rays and the cluster decide.

    Args:
      num_points: (P,) int32, points of the cluster.
      hit: (P,) float32, fraction of rays.
      free_length: (P,) float32, fraction of the rays' length.
      objective: (P,) float32, J of the box.
      config: (points / saturation)^power, exp(-(free_length / scale)^2), and
        1 / (1 + exp(-(J - gate) / softness)).

    Returns:
      (P,) float32 in [0, 1].
    """
    dense = jnp.minimum(num_points.astype(jnp.float32) / config.saturation_points, 1)
    dense = dense**config.sparseness_power
    gate = jax.nn.sigmoid((objective - config.objective_gate) / config.objective_softness)
    return dense * jnp.exp(-((free_length / config.free_scale) ** 2)) * hit * gate


def far_score(rho: jax.Array, prior: ClassPrior, config: VehicleConfig) -> jax.Array:
    """The part of the score that falls with the range, as fewer beams meet a vehicle.

    Args:
      rho: (P,) float32, m, range of the box.
      prior: fields of (P,) float32.
      config: the power.

    Returns:
      (P,) float32 in [0, 1].

    Reference: oracle `jaxbox.reference.far_score`.
    """
    from_m = prior.far_score_from_m
    return (from_m / jnp.maximum(rho, from_m)) ** config.far_score_power


def end_where_seen(
    rectangles: jax.Array,
    around: NeighbourhoodCounts,
    prior: ClassPrior,
    config: CompletionConfig,
    beam_angle: float,
) -> tuple[jax.Array, jax.Array]:
    """Moves the far end of boxes to where all points inside say that it is, as far as the sensor sees it.

    The sides of a box are fitted to a sample of the points of one cluster, which seldom holds the far end:
    few points lie there. A side's end shows where the beams meet the side at a steep angle; it lies beyond
    the farthest point, by half the distance of two beams on the side in the mean.

    Args:
      rectangles: (P, 5) float32: x, y, length, width (m), yaw (rad).
      around: all points inside; those as far apart as the class is long, and more, show the end.
      prior: fields of (P,) float32.
      config: from which fraction of the class's length on the points may show the end, at which slope of
        the beams against the side it is sure, and how many points make it half so.
      beam_angle: rad, between neighbouring beams: an azimuth cell of the evidence.

    Returns:
      boxes: (P, 5) float32: the near ends stay.
      seen: (P,) float32, in [0, 1]: how sure it is that the end is seen.

    Reference: oracle `jaxbox.reference.end_where_seen`.
    """
    x, y, length, width, yaw = rectangles.T
    along, across = sensor_outside(rectangles)
    steep = jnp.minimum(across / jnp.maximum(along, 1e-3) / config.end_slope, 1)
    whole = share_of_length_seen(around.deepest, prior, config.end_length)
    dense = around.num_inside / (around.num_inside + config.end_points)
    spacing_m = beam_angle * (along**2 + across**2) / jnp.maximum(across, 1e-3)
    seen_m = around.deepest + jnp.minimum(spacing_m / 2, MAX_END_MARGIN_M)
    sure = steep * whole * dense
    answered = length + sure * (seen_m - length)
    shift = jnp.sign(sensor_from(rectangles)[0]) * (length - answered) / 2
    ended = jnp.stack([x + shift * jnp.cos(yaw), y + shift * jnp.sin(yaw), answered, width, yaw], axis=1)
    return ended, sure


def neighbourhood_score(
    around: NeighbourhoodCounts,
    rho: jax.Array,
    reach: jax.Array,
    seen_width_m: jax.Array,
    is_open: jax.Array,
    in_threes: jax.Array,
    prior: ClassPrior,
    config: VehicleConfig,
) -> tuple[jax.Array, jax.Array]:
    """The part of the score that the points in and round the box decide.

    The true top lies between the top of the points and that plus the beams' spacing; it is compared with the
    class at the place in between that suits it best. Where the highest beam cuts the box off, or where far
    vehicles return from a bumper alone, it may lie anywhere above: then the height says nothing, and counts
    less.

    Facades and walls end where a truck may end, but no beam passes below them: what is cut off, or has no
    known width, counts as such a class as far as rays see free space in the box.

    Args:
      around: see `count_points_around`.
      rho: (P,) float32, m, range of the box.
      reach: (P,) float32, m above the ground: height of the highest beam where the box begins.
      seen_width_m: (P,) float32, m: what was measured of the width. Of one long face nothing is known but its
        length, which walls have too: only from half the usual width on may the top be out of sight.
      is_open: (P,) float32, fraction of the rays that see free space inside.
      in_threes: (P,) bool, whether vehicles stand on both sides, or it is at the end of such a row or line:
        they hide all but one face, and nothing is seen to lie behind it.
      prior: fields of (P,) float32.
      config: exp(-(ring weight x ring + overhead weight x above) / inside), and what upright boxes lose:
        those with few upper points come near to the full score. Points above count as far as they are
        connected: from a gap of `overhead_gap_m` on less and less, from twice that on not at all.

    Returns:
      score: (P,) float32 in [0, 1]; 0 where a gate fails.
      top_unseen: (P,) bool, whether it is that of a box whose top is out of sight.
    """
    highest = around.top + config.top_grade * rho
    clearance = prior.count_max_height_m - highest
    connected = jnp.clip(2 - clearance / config.overhead_gap_m, 0, 1)
    overhead = config.overhead_weight * connected * around.num_above
    clutter = (config.ring_weight * around.num_ring + overhead) / jnp.maximum(around.num_inside, 1)
    seen_width, too_few = seen_width_m / prior.width_m, is_open < prior.min_open
    cut = jnp.clip(1 + (around.top - reach) / CUT_SLACK_M, 0, 1)
    no_wall = jnp.where(too_few, is_open / jnp.where(too_few, prior.min_open, 1), 1)
    unseen = _unseen_top_score(around.top, rho, cut * no_wall, seen_width, prior, config)
    seen = _height_score(around.top, highest, prior)
    seen = seen * jnp.maximum(no_wall, (1 - cut) * jnp.minimum(seen_width / WIDE, 1))
    score, top_unseen = jnp.maximum(seen, unseen), unseen > seen
    score = score * jnp.exp(-clutter)
    recessed = around.num_recessed + PSEUDO_COUNT * config.recess_share
    recessed = recessed / (around.num_upper + PSEUDO_COUNT)
    least = _upright_score(around.top, seen_width, in_threes, prior, config)
    upright = least + (1 - least) * jnp.minimum(recessed / config.recess_share, 1)
    return score * upright, top_unseen


def _upright_score(
    top: jax.Array, seen_width: jax.Array, in_threes: jax.Array, prior: ClassPrior, config: VehicleConfig
) -> jax.Array:
    """(P,) the factor of what is upright all over; `seen_width` is a fraction of the class's."""
    tall = jnp.clip((top - prior.upright_from_m) / UPRIGHT_RAMP_M, 0, 1) * _nearly_wide(seen_width)
    may_be = jnp.where(in_threes, 1, tall)
    return config.upright_score + (config.tall_upright_score - config.upright_score) * may_be


def own_score(around: NeighbourhoodCounts, num_points: jax.Array, prior: ClassPrior) -> jax.Array:
    """What boxes count that are filled by other points than those of their cluster: part of a hedge, say.

    Args:
      around: see `count_points_around`.
      num_points: (P,) int32, points of the cluster.
      prior: fields of (P,) float32: the least share of the points inside that counts in full.

    Returns:
      (P,) float32 in [0, 1]: the share of the points inside that are its cluster's, over the least.

    Reference: oracle `jaxbox.reference.own_score`.
    """
    own = num_points.astype(jnp.float32) / jnp.maximum(around.num_inside, 1)
    return jnp.where(own < prior.own_share, own / jnp.maximum(prior.own_share, own), 1)


def _nearly_wide(seen_width: jax.Array) -> jax.Array:
    """(P,) in [0, 1]: whether nearly the class's width was measured."""
    narrow, wide = NEARLY_WIDE
    return jnp.clip((seen_width - narrow) / (wide - narrow), 0, 1)


def _height_score(top: jax.Array, highest: jax.Array, prior: ClassPrior) -> jax.Array:
    """(P,) how well tops suit the class, as high as they may be."""
    widths = prior.height_below_m, prior.height_above_m
    score = asymmetric_gaussian(jnp.clip(prior.height_m, top, highest), prior.height_m, *widths)
    return jnp.where((highest > prior.min_height_m) & (top < prior.max_height_m), score, 0)


def _unseen_top_score(
    top: jax.Array,
    rho: jax.Array,
    cut: jax.Array,
    seen_width: jax.Array,
    prior: ClassPrior,
    config: VehicleConfig,
) -> jax.Array:
    """(P,) the same where the top is out of sight; `seen_width` is a fraction of the class's."""
    cut = cut * jnp.clip(2 * seen_width, 0, 1)
    cut = jnp.where(top > prior.min_cut_height_m, cut, 0)
    bumper = jnp.clip((rho - config.bumper_from_m) / BUMPER_RAMP_M, 0, 1) * _nearly_wide(seen_width)
    bumper = jnp.where(top > prior.min_bumper_m, bumper, 0)
    widths = prior.height_below_m, prior.height_above_m
    score = asymmetric_gaussian(jnp.maximum(prior.height_m, top), prior.height_m, *widths)
    score = config.unseen_top_score * jnp.maximum(cut, bumper) * score
    return jnp.where(top < prior.max_height_m, score, 0)
