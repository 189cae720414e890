"""From the boxes to the candidates: the score."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox.config import DetectorConfig
from jaxbox.geometry.planar import wrap_yaw
from jaxbox.stages import evidence
from jaxbox.stages import scoring as vehicles
from jaxbox.steps.boxes import cast_rays
from jaxbox.steps.common import class_values, stage_options
from jaxbox.steps.points import Heights, Obstacles, height_above_ground
from jaxbox.steps.proposals import Proposals, Trials
from jaxbox.types import NOT_A_BOX, Boxes
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.loops import for_chunks, map_rows
from jaxbox.xla.masked import compact, take

RANK_STEP = 16
"""Rows that all others are compared with in one step."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Candidates:
    """The trials that pass the gates, best score first: C rows."""

    rectangle: jax.Array  # (C, 5) x, y, length, width, yaw
    bottom: jax.Array  # (C,) m, sensor frame
    height: jax.Array  # (C,) m
    score: jax.Array  # (C,)
    label: jax.Array  # (C,)
    cluster: jax.Array  # (C,)
    valid: jax.Array  # (C,)
    num: jax.Array  # () true number


def score_boxes(
    trials: Trials,
    boxes: Boxes,
    proposals: Proposals,
    obstacles: Obstacles,
    heights: Heights,
    seen: evidence.Evidence | None,
    config: DetectorConfig,
) -> Candidates:
    """Scores the boxes by rays and size, then the best of them by what surrounds them."""
    score = _early_scores(trials, boxes, proposals, seen, config)
    chosen, num = _choose(score, config.vehicles.max_candidates, config.vehicles.min_score)

    def pick(chosen: jax.Array) -> tuple[jax.Array, ...]:
        box = jax.tree.map(lambda a: take(a, chosen), boxes)
        size = jnp.stack([box.length, box.width, wrap_yaw(box.yaw)], axis=1)
        rectangle = jnp.concatenate([box.center, size], axis=1)
        return rectangle, take(trials.label, chosen), take(trials.cluster, chosen), take(score, chosen)

    picked = map_rows(pick, chosen, num_rows=num)
    rectangle, label, cluster, _ = picked
    around = _look_around(rectangle, label, cluster, num, proposals, obstacles, config)
    finish = functools.partial(_finish, proposals=proposals, heights=heights, config=config)
    candidates = map_rows(finish, (*picked, around), num_rows=num)
    order = _best_first(candidates.score, num)
    ordered = map_rows(lambda row: jax.tree.map(lambda a: take(a, row), candidates), order, num_rows=num)
    return dataclasses.replace(ordered, num=num)


def _finish(
    rows: tuple[Any, ...], proposals: Proposals, heights: Heights, config: DetectorConfig
) -> Candidates:
    """Candidates with their score and height, in the order that they came in."""
    rectangle, label, cluster, score, around = rows
    settings = config.vehicles
    prior = functools.partial(class_values, config, label=label)
    late = vehicles.surroundings_score(
        around,
        jnp.linalg.norm(rectangle[:, :2], axis=1),
        top_grade=settings.top_grade,
        ring_weight=settings.ring_weight,
        overhead_weight=settings.overhead_weight,
        recess_share=settings.recess_share,
        upright_worth=settings.upright_worth,
        **{
            name: prior(name)
            for name in ("height_m", "height_below_m", "height_above_m", "min_height_m", "max_height_m")
        },
    )
    height = jnp.maximum(around.top + settings.top_margin_m, prior("min_box_height_m"))
    above = jnp.zeros_like(height)
    if not settings.surroundings:
        # The paper keeps the height of the cluster itself.
        above = take(proposals.low[:, 2], cluster)
        height = take(proposals.high[:, 2], cluster) - above
    flat = jnp.concatenate([rectangle[:, :2], jnp.zeros_like(rectangle[:, :1])], axis=1)
    bottom = above - height_above_ground(flat, heights.planes, heights.surface, config)
    total = score * late
    total = jnp.where(total > settings.min_score, total, 0)
    return Candidates(rectangle, bottom, height, total, label, cluster, total > 0, jnp.zeros_like(label))


def _look_around(
    rectangle: jax.Array,
    label: jax.Array,
    cluster: jax.Array,
    num: jax.Array,
    proposals: Proposals,
    obstacles: Obstacles,
    config: DetectorConfig,
) -> vehicles.Surroundings:
    """What there is in and round each box: its cluster alone where the preset does not look round."""
    settings = config.vehicles
    if not settings.surroundings:
        num_points = take(proposals.num_points, cluster).astype(jnp.float32)
        return vehicles.cluster_alone(num_points, take(proposals.high[:, 2], cluster))
    return vehicles.count_points_around(
        rectangle,
        class_values(config, "count_max_height_m", label),
        class_values(config, "recess_m", label),
        num,
        obstacles.xy,
        obstacles.height,
        obstacles.count,
        **stage_options(config.region),
        margin_m=settings.margin_m,
        ring_m=settings.ring_m,
        upper_height_m=settings.upper_height_m,
        stray_share=settings.stray_share,
    )


def _early_scores(
    trials: Trials,
    boxes: Boxes,
    proposals: Proposals,
    seen: evidence.Evidence | None,
    config: DetectorConfig,
) -> jax.Array:
    """(Q,) the part of the score that needs no look at the surroundings; no other part exceeds 1."""
    rays = None if seen is None else cast_rays(boxes, trials.num, seen, config)

    def score(rows: tuple[Boxes, jax.Array, jax.Array, evidence.RayFractions | None]) -> jax.Array:
        boxes, label, cluster, rays = rows
        ones = jnp.ones_like(boxes.yaw)
        hit, free_length, support = ones, 0 * ones, config.vehicles.support_points * ones
        if seen is not None and rays is not None:
            hit, free_length = rays.hit, rays.free_length
            support = evidence.ground_support(seen, boxes.center)
        return _early_score(
            boxes, label, take(proposals.num_points, cluster), hit, free_length, support, config
        )

    scores = map_rows(score, (boxes, trials.label, trials.cluster, rays), num_rows=trials.num)
    return jnp.where(jnp.arange(scores.shape[0], dtype=jnp.int32) < trials.num, scores, 0)


def _early_score(
    boxes: Boxes,
    label: jax.Array,
    num_points: jax.Array,
    hit: jax.Array,
    free_length: jax.Array,
    support: jax.Array,
    config: DetectorConfig,
) -> jax.Array:
    settings = config.vehicles
    prior = functools.partial(class_values, config, label=label)
    score = vehicles.evidence_score(
        num_points=num_points,
        hit=hit,
        free_length=free_length,
        support=support,
        objective=boxes.objective,
        **{
            name: getattr(settings, name)
            for name in (
                "saturation_points",
                "sparseness_power",
                "free_scale",
                "support_points",
                "objective_gate",
                "objective_softness",
            )
        },
    )
    score = score * vehicles.size_score(
        jnp.stack([boxes.length, boxes.width], axis=1),
        jnp.stack([prior("length_m"), prior("width_m")], axis=1),
        **{name: prior(name) for name in ("length_below_m", "length_above_m", "width_tolerance_m")},
    )
    score = score * prior("prior_weight")
    large_enough = jnp.max(boxes.measured, axis=1) >= settings.min_extent_m
    return jnp.where((boxes.objective > NOT_A_BOX) & large_enough, score, 0)


def _choose(score: jax.Array, capacity: int, min_score: jax.Array | float) -> tuple[jax.Array, jax.Array]:
    """Rows with scores above the least, the highest where they are too many, and their true number."""
    above = score > min_score
    if on_accelerator():
        above_and_high = above & (_num_better(score) < capacity)
        return compact(above_and_high, capacity)[0], jnp.sum(above, dtype=jnp.int32)
    row, num = compact(above, capacity)

    def highest() -> jax.Array:
        row = jnp.arange(score.shape[0], dtype=jnp.int32)
        _, order = jax.lax.sort((-score, row), num_keys=1, is_stable=True)
        return jnp.sort(order[:capacity])

    if capacity >= score.shape[0]:
        return row, num
    return jax.lax.cond(num > capacity, highest, lambda: row), num


def _num_better(score: jax.Array) -> jax.Array:
    """(P,) int32: how many rows have a higher score, or the same and come before."""
    row = jnp.arange(score.shape[0], dtype=jnp.int32)
    comes_first = (score[None] == score[:, None]) & (row[None] < row[:, None])
    better = (score[None] > score[:, None]) | comes_first
    return jnp.sum(better, axis=1, dtype=jnp.int32)


def _best_first(score: jax.Array, num: jax.Array) -> jax.Array:
    """Rows with positive scores, which are among the first `num`, best first (ties by row); then their size.

    The place of a row is the number of rows before it: for the few that are there, counting beats a sort.
    """
    size = score.shape[0]
    row = jnp.arange(size, dtype=jnp.int32)
    padded = jnp.pad(score, (0, -size % RANK_STEP))

    def step(start: jax.Array, place: jax.Array) -> jax.Array:
        for k in range(RANK_STEP):
            other = start + k
            rival = padded[other]
            better = (rival > score) | ((rival == score) & (other.astype(jnp.int32) < row))
            place = place + better.astype(jnp.int32)
        return place

    if on_accelerator():
        place = _num_better(score)
    else:
        place = for_chunks(num, RANK_STEP, step, jnp.zeros_like(row), capacity=size)
    return jnp.full(size, size, jnp.int32).at[jnp.where(score > 0, place, size)].set(row, mode="drop")
