"""Correction for occluded vehicles: hidden sides are completed by the class prior, as the evidence says."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import chex
import jax
import jax.numpy as jnp

from jaxbox.config import ClassPrior, CompletionConfig, DetectorConfig, VehicleConfig
from jaxbox.stages._assignments import (
    NUM_ASSIGNMENTS,
    NUM_PLACEMENTS,
    Assignments,
    assign_length_axis,
    blend_boxes,
    extend,
    extend_away,
    fits,
    keep_measured,
    likely_size,
    likely_sizes,
    longer_side,
    place,
    share_of_length_seen,
)
from jaxbox.stages._priors import closed_free_length, is_raised, prior_of
from jaxbox.stages._rows import find_rows, hit_share, visible_ends
from jaxbox.stages.state import (
    NOT_A_BOX,
    Boxes,
    CastRays,
    ClassHypotheses,
    Clusters,
    Completed,
    RayFractions,
    Rectangles,
    longest_side,
)
from jaxbox.xla import chunks
from jaxbox.xla.arithmetic import fast_max, fast_min
from jaxbox.xla.indexing import take
from jaxbox.xla.loops import fold_rows, map_rows
from jaxbox.xla.ragged import PointLists, fold_points
from jaxbox.xla.rows import compact, first_argmax, split_index
from jaxbox.xla.sorting import sort_by_group

INSIDE_MARGIN_M = 0.1
"""A point this far outside a hypothesis still counts as inside."""


NEAR_M = 0.1
"""A point nearer than this to a visible face counts as on it."""


FACE_OVERHANG_M = 0.3
"""Faces reach this far beyond their corners when points are compared with them."""


FAR_M = 1e9
"""Farther away than any point."""


LOWER_PART_M = 0.5
"""A cluster may be so much lower than its vehicle: the rest is another cluster, or outside the map."""


def complete_boxes(
    candidates: Sequence[Rectangles],
    points: PointLists,
    clusters: Clusters,
    cast_rays: CastRays | None,
    config: DetectorConfig,
) -> Completed:
    """The completed box of every class hypothesis.

    Args:
      candidates: rectangles (P,) of the clusters, one or four of each.
      points: that those were fitted to.
      clusters: of P rows.
      cast_rays: asks the evidence; None where there is none.
      config: of the detector.

    Returns:
      The hypotheses and their boxes.
    """
    chex.assert_shape([each.rows for each in candidates], (*clusters.num_points.shape, 6))
    hypotheses = list_hypotheses(clusters, candidates, config.vehicles)
    if config.completion.mode == "evidence":
        assert cast_rays is not None  # see check_config
        boxes, num = _complete_by_evidence(hypotheses, candidates, points, cast_rays, config)
        return Completed(hypotheses, boxes, num)

    def complete(rows: tuple[jax.Array, jax.Array]) -> Boxes:
        cluster, label = rows
        prior = prior_of(config.vehicles.classes, label)
        sides = longer_side(Rectangles(take(candidates[0].rows, cluster)))
        if config.completion.mode == "none":
            return keep_measured(sides, prior)
        return extend_away(sides, prior, config.completion)

    boxes = map_rows(complete, (hypotheses.cluster, hypotheses.label), num_rows=hypotheses.num)
    return Completed(hypotheses, boxes, jnp.int32(0))


def list_hypotheses(
    clusters: Clusters, candidates: Sequence[Rectangles], config: VehicleConfig
) -> ClassHypotheses:
    """Lists the first class of all clusters, then the others of the large ones, without gaps.

    Only those are listed that a gate would not refuse anyway.

    Args:
      clusters: of P rows.
      candidates: rectangles (P,) of the clusters.
      config: the classes.

    Returns:
      P + (classes - 1) max_large rows.
    """
    capacity, num_classes = clusters.num_points.shape[0], len(config.classes)
    is_large = fold_rows(
        lambda flags, _, row: flags.at[row].set(True, mode="drop"),
        jnp.zeros(capacity, bool),
        clusters.large,
        num_rows=clusters.num_large,
        absent=capacity,
    )

    def may_be(rows: tuple[jax.Array, ...]) -> jax.Array:
        is_large, high, *each = rows
        rectangles = [Rectangles(rows) for rows in each]
        # Only the first class stands in rows.
        least = [config.row_extent * config.min_extent_m, *[config.min_extent_m] * (num_classes - 1)]
        sizes_fit = [_may_fit(prior, rectangles, m) for prior, m in zip(config.classes, least, strict=True)]
        tried = jnp.stack([sizes_fit[0], *(is_large & other for other in sizes_fit[1:])], axis=1)
        return tried & _may_be_high_enough(high[:, 2], rectangles[0], config)[:, None]

    rows = is_large, clusters.high, *(rectangles.rows for rectangles in candidates)
    listed = map_rows(may_be, rows, num_rows=clusters.num).T
    listed = listed & (jnp.arange(capacity, dtype=jnp.int32) < clusters.num)[None]
    index, num = compact(listed.reshape(-1), capacity + (num_classes - 1) * clusters.large.shape[0])
    label, cluster = split_index(index, capacity)
    is_row = index < listed.size
    return ClassHypotheses(jnp.where(is_row, cluster, capacity), jnp.where(is_row, label, 0), num)


def _may_fit(
    prior: ClassPrior, candidates: Sequence[Rectangles], min_extent_m: jax.Array | float
) -> jax.Array:
    """(P,) whether some rectangle of a cluster fits into a class, and is large enough to be judged."""
    fits = jnp.zeros_like(candidates[0].angle, bool)
    for rectangles in candidates:
        long, short = longest_side(rectangles), jnp.min(rectangles.high - rectangles.low, axis=1)
        small = (long <= prior.max_length_m) & (short <= prior.max_width_m)
        fits = fits | (small & (long >= min_extent_m))
    return fits


def _may_be_high_enough(high: jax.Array, rectangles: Rectangles, config: VehicleConfig) -> jax.Array:
    """(P,) whether a cluster can be (the lower part of) the lowest class, given the beams' spacing."""
    rho = jnp.linalg.norm((rectangles.low + rectangles.high) / 2, axis=1)
    lowest = functools.reduce(jnp.minimum, [prior.min_height_m for prior in config.classes])
    return high + config.top_grade * rho > lowest - LOWER_PART_M


def _complete_by_evidence(
    hypotheses: ClassHypotheses,
    candidates: Sequence[Rectangles],
    points: PointLists,
    cast_rays: CastRays,
    config: DetectorConfig,
) -> tuple[Boxes, jax.Array]:
    """The box (Q,) of each hypothesis whose length axis and placement explain the evidence best.

    And how many assignments the evidence had to weigh.
    """
    *judged, num = _judge_assignments(hypotheses, candidates, points, cast_rays, config)

    def complete(of_hypothesis: tuple[jax.Array, ...]) -> Boxes:
        cluster, label, *judged = of_hypothesis
        shape = judged[0].shape
        placement, objective, in_row = (a.reshape(-1) for a in judged)
        number = jnp.tile(jnp.arange(shape[1], dtype=jnp.int32), shape[0])
        cluster, label = jnp.repeat(cluster, shape[1]), jnp.repeat(label, shape[1])
        sides = _assign(candidates, number, cluster)
        sizes = likely_sizes(sides, prior_of(config.vehicles.classes, label), config.completion)
        boxes = dataclasses.replace(place(sides, sizes, placement, objective), in_row=in_row)
        boxes = jax.tree.map(lambda a: a.reshape(*shape, *a.shape[1:]), boxes)
        return blend_boxes(boxes, max_loss=config.completion.blend_objective)

    rows = hypotheses.cluster, hypotheses.label, *judged
    return map_rows(complete, rows, num_rows=hypotheses.num, chunk=chunks.PROPOSALS), num


def _assign(candidates: Sequence[Rectangles], number: jax.Array, cluster: jax.Array) -> Assignments:
    """An assignment of each cluster, by its number: both of the first candidate, then of the second."""
    which, side = split_index(number, NUM_ASSIGNMENTS)
    rows = take(candidates[0].rows, cluster)
    for i, rectangles in enumerate(candidates[1:], start=1):
        rows = jnp.where(which[:, None] == i, take(rectangles.rows, cluster), rows)
    return assign_length_axis(Rectangles(rows), side)


def _judge_assignments(
    hypotheses: ClassHypotheses,
    candidates: Sequence[Rectangles],
    points: PointLists,
    cast_rays: CastRays,
    config: DetectorConfig,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The best placement of each assignment of each hypothesis, its J, and whether it is in a row: (Q, W)
    each; their number.
    """
    num_each = NUM_ASSIGNMENTS * len(candidates)
    entry, num = _largest_first(hypotheses, candidates, points, config.vehicles)
    num_entries, entry = entry.shape[0], entry[: config.completion.max_assignments]

    def prepare(entry: jax.Array) -> tuple[Any, ...]:
        hypothesis, number = split_index(entry, num_each)
        cluster, label = take(hypotheses.cluster, hypothesis), take(hypotheses.label, hypothesis)
        sides = _assign(candidates, number, cluster)
        prior = prior_of(config.vehicles.classes, label)
        ends, may_be = visible_ends(sides, prior)
        return ends, may_be & (label == 0), (place_widths(sides, prior), sides.score, cluster, label)

    def judge(rows: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
        (boxes, score, cluster, label), in_row = rows
        prior = prior_of(config.vehicles.classes, label)
        raised = is_raised(prior)[None]
        rays = cast_rays(boxes, num_rays=config.completion.num_rays, raised=raised)
        closed = closed_free_length(rays, prior)
        rays = dataclasses.replace(rays, hit=hit_share(rays, in_row), free_length=closed)
        agreement = point_agreement(boxes, *points.table(cluster), config.completion)
        return first_argmax(placement_objectives(score, agreement, rays, config.completion))

    def note(tables: Any, _: jax.Array, rows: tuple[jax.Array, ...]) -> Any:
        entry, *found = rows
        return tuple(a.at[entry].set(value, mode="drop") for a, value in zip(tables, found, strict=True))

    ends, may_be, prepared = map_rows(prepare, entry, num_rows=num, chunk=chunks.PROPOSALS)
    may_be = may_be & (jnp.arange(may_be.shape[0], dtype=jnp.int32) < num)
    in_row = find_rows(ends, may_be, config.vehicles.classes[0].width_m, config.completion)
    judged = map_rows(judge, (prepared, in_row), num_rows=num, chunk=chunks.PROPOSALS)
    nothing = (
        jnp.zeros(num_entries, jnp.int32),
        jnp.full(num_entries, NOT_A_BOX, jnp.float32),
        jnp.zeros(num_entries, bool),
    )
    rows, absent = (entry, *judged, in_row), (num_entries, 0, 0.0, False)
    of_entry = fold_rows(note, nothing, rows, num_rows=num, absent=absent)
    placement, objective, in_row = (a.reshape(-1, num_each) for a in of_entry)
    # The other side of a rectangle is the length of a box along the row.
    along_row = in_row.reshape(-1, len(candidates), NUM_ASSIGNMENTS)[..., ::-1].reshape(in_row.shape)
    objective = objective - config.completion.along_row_cost * along_row.astype(jnp.float32)
    return placement, objective, in_row, num


def _largest_first(
    hypotheses: ClassHypotheses, candidates: Sequence[Rectangles], points: PointLists, config: VehicleConfig
) -> tuple[jax.Array, jax.Array]:
    """The possible assignments of all hypotheses, those of clusters with many points first; their number.

    A loop over the points of a chunk of them ends with the largest: so like sizes belong together.
    """
    sides = [jnp.int32(side) for side in range(NUM_ASSIGNMENTS)]

    def rank(rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        cluster, label = rows
        rectangles = [Rectangles(take(each.rows, cluster)) for each in candidates]
        prior = prior_of(config.classes, label)
        # A candidate at the angle of an earlier one has nothing to add.
        possible = [
            is_new & fits(assign_length_axis(rectangle, side), prior)
            for rectangle, is_new in zip(rectangles, _first_of_angle(rectangles), strict=True)
            for side in sides
        ]
        missing = points.max_points - points.count_of(cluster)
        return jnp.where(jnp.stack(possible, axis=1), missing[:, None], points.max_points)

    ranks = map_rows(rank, (hypotheses.cluster, hypotheses.label), num_rows=hypotheses.num)
    num_entries = hypotheses.num * ranks.shape[1]
    entry, begin, _ = sort_by_group(lambda i: i, ranks.reshape(-1), num_entries, points.max_points + 1)
    # Clusters have points, so that only what is not possible comes last.
    return entry, begin[points.max_points]


def _first_of_angle(rectangles: Sequence[Rectangles]) -> list[jax.Array]:
    """(P,) bool each: whether no earlier one is at the same angle."""
    new = jnp.ones_like(rectangles[0].angle, bool)
    return [
        functools.reduce(jnp.logical_and, [each.angle != before.angle for before in rectangles[:i]], new)
        for i, each in enumerate(rectangles)
    ]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Placements:
    """What each assignment may be: the width goes away from the sensor, towards it, or both ways."""

    yaw: jax.Array
    """(C,) rad"""
    u: jax.Array
    """(C,) m: centre along the box, from the sensor."""
    v: jax.Array
    """(C, 3) m: centre across it."""
    length: jax.Array
    """(C,) m"""
    width: jax.Array
    """(C,) m"""

    @property
    def center(self) -> jax.Array:
        """(3, C, 2) m, sensor frame."""
        cos, sin = jnp.cos(self.yaw)[None], jnp.sin(self.yaw)[None]
        u, v = self.u[None], self.v.T
        return jnp.stack([cos * u - sin * v, sin * u + cos * v], axis=-1)


def place_widths(sides: Assignments, prior: ClassPrior) -> Placements:
    """Completes boxes to the class's size, or the measured where that is larger, or may be the whole length.

    Args:
      sides: C of them.
      prior: fields of (C,) float32.

    Returns:
      The placements: the length is completed away from the sensor.

    Reference: oracle `jaxbox.reference.place_widths`.
    """
    measured_length, measured_width = sides.measured
    whole = share_of_length_seen(measured_length, prior, 1.0)
    length = likely_size(measured_length, prior.length_m, whole)
    width = jnp.maximum(prior.width_m, measured_width)
    return Placements(
        yaw=sides.yaw,
        u=extend(sides.along, length)[0],
        v=jnp.stack(extend(sides.across, width), axis=1),
        length=length,
        width=width,
    )


def point_agreement(
    boxes: Placements,
    x: jax.Array,
    y: jax.Array,
    count: jax.Array,
    config: CompletionConfig,
) -> jax.Array:
    """How well boxes hold the points they were made from, and how close these are to visible faces.

    Args:
      boxes: C times three placements.
      x: (M, C) float32, m.
      y: (M, C) float32, m.
      count: (C,) int32, points of each.
      config: weights of the fraction of the points inside the box, give or take 10 cm, and of the mean of
        .1 / max(d, .1), d the distance to the nearest visible face.

    Returns:
      (3, C) float32: the weighted sum of both.
    """
    half_l, half_w, box_v = boxes.length / 2, boxes.width[None] / 2, boxes.v.T
    # The sensor, at the origin, sees the faces on its side of the box; the others are far from all points.
    face_u = jnp.where(jnp.abs(boxes.u) > half_l, -jnp.sign(boxes.u) * half_l, FAR_M)
    face_v = jnp.where(jnp.abs(box_v) > half_w, -jnp.sign(box_v) * half_w, FAR_M)

    cos, sin = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)

    def update(total: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
        u, v = x * cos + y * sin - boxes.u, (y * cos - x * sin)[None] - box_v
        out_u, out_v = (jnp.abs(u) - half_l)[None], jnp.abs(v) - half_w
        inside = (out_u < INSIDE_MARGIN_M) & (out_v < INSIDE_MARGIN_M)
        to_u = jnp.where(out_v < FACE_OVERHANG_M, jnp.abs(u - face_u)[None], FAR_M)
        to_v = jnp.where(out_u < FACE_OVERHANG_M, jnp.abs(v - face_v), FAR_M)
        near = NEAR_M / fast_max(fast_min(to_u, to_v), NEAR_M)
        return total + config.inside_weight * inside.astype(jnp.float32) + config.near_weight * near

    # Points that are absent are far from all boxes.
    total = fold_points(x, y, count, jnp.zeros_like(box_v), update, absent=(FAR_M, FAR_M))
    return total / jnp.maximum(count, 1).astype(jnp.float32)[None]


def placement_objectives(
    score: jax.Array, agreement: jax.Array, rays: RayFractions, config: CompletionConfig
) -> jax.Array:
    """How well the placements of each assignment explain the evidence; the first of the best is chosen.

    J = hit - wf free - wl free_length + agreement + wc score - cost [width not away].

    Args:
      score: (C,) float32, of the rectangle.
      agreement: (3, C) float32, see `point_agreement`.
      rays: (3, C) fractions.
      config: wf, wl, wc and the cost.

    Returns:
      (3, C) float32: J.
    """
    number = jnp.arange(NUM_PLACEMENTS, dtype=jnp.int32)[:, None]
    cost = config.not_away_cost * (number > 0).astype(jnp.float32)
    objective = rays.hit - config.free_weight * rays.free - config.free_length_weight * rays.free_length
    objective = objective + agreement
    return objective + config.closeness_weight * score[None] - cost
