"""From the clusters to boxes, completed where the sensor does not see."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox import box, completion, evidence, hull
from jaxbox.config import CompletionConfig, DetectorConfig
from jaxbox.masked import compact, largest_first, map_by_size, map_rows, take
from jaxbox.steps.common import class_values, stage_options
from jaxbox.steps.points import Heights, Obstacles, Sweep
from jaxbox.steps.proposals import Proposals, Trials, list_trials, longest_side
from jaxbox.types import NOT_A_BOX, Boxes, Rectangles

INSISTENCE = 5.0
"""How often the scene's direction counts for the second reading of a cluster: it bends a closeness only."""

PROPOSAL_CHUNK = 128
"""Proposals held against the evidence at a time: a loop over their points has few, wide steps."""


HULL_CHUNK = 32
"""Clusters whose hulls are traced at a time."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Fits:
    """All rotations of all clusters, and the points that they were fitted to."""

    curve: jax.Array  # (P, A), the clusters with most points first
    extents: box.Extents  # likewise
    place: jax.Array  # (P,) where each cluster is in those
    points: jax.Array  # (P, M, 2) m
    count: jax.Array  # (P,)
    hull_vertices: jax.Array  # () of the largest hull that was fitted to; 0 where none was


def fit_rectangles(obstacles: Obstacles, proposals: Proposals, config: DetectorConfig) -> Fits:
    """Rectangles of all clusters at all rotations, and the points that they were fitted to."""
    settings = config.box
    outline = _hull_points if settings.fit_to == "hull" else _slab_points
    points, count, hull_vertices = outline(obstacles, proposals, config)
    order, place = largest_first(count, points.shape[1])
    curve, extents = box.try_rotations(
        points[order],
        count[order],
        proposals.num_clusters,
        criterion=settings.criterion,
        num_angles=settings.num_angles,
        min_distance_m=settings.min_distance_m,
    )
    return Fits(curve, extents, place, points, count, hull_vertices)


def best_rectangles(fits: Fits, preference: jax.Array, insistence: float = 1.0) -> Rectangles:
    """The rectangle of each cluster at its best rotation, see `box.best_rectangles`."""
    rectangles = box.best_rectangles(fits.curve, fits.extents, preference, insistence=insistence)
    return jax.tree.map(lambda a: a[fits.place], rectangles)


def _hull_points(
    obstacles: Obstacles, proposals: Proposals, config: DetectorConfig
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The hull of each cluster, as the points that its rectangle is fitted to (the paper)."""
    num_maps, num_obstacles = proposals.cluster.shape
    index = hull.extreme_points(
        proposals.cluster.reshape(-1),
        jnp.tile(jnp.arange(num_obstacles), num_maps),
        jnp.int32(proposals.cluster.size),
        obstacles.xy,
        num_clusters=proposals.num_points.shape[0],
        num_slices=config.hull.num_slices,
    )
    trace = functools.partial(trace_hulls, obstacles.xy, max_vertices=config.hull.max_vertices)
    vertices, count = map_rows(trace, index, num_rows=proposals.num_clusters, chunk=HULL_CHUNK)
    return vertices, jnp.minimum(count, config.hull.max_vertices), jnp.max(count)


def trace_hulls(xy: jax.Array, index: jax.Array, *, max_vertices: int) -> tuple[jax.Array, jax.Array]:
    """Hulls of the clusters whose points are listed: (C, H, 2) m, and their true numbers of vertices."""
    return hull.convex_hulls(take(xy, index), index < xy.shape[0], max_vertices=max_vertices)


def _slab_points(
    obstacles: Obstacles, proposals: Proposals, config: DetectorConfig
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The points of each cluster between the slab's heights, or all where those are few."""
    num_maps, num_obstacles = proposals.cluster.shape
    num_clusters = proposals.num_points.shape[0]
    # The points of all maps in one list, without gaps: it is sorted as far as it is filled.
    entry, _ = compact(proposals.fitted.reshape(-1), num_maps * max_slab_points(obstacles.num_rows, config))
    cluster = take(proposals.cluster.reshape(-1), entry, num_clusters)
    index, count = box.sample_points(cluster, num_clusters=num_clusters, max_points=config.box.max_points)

    def gather(index: jax.Array) -> jax.Array:
        place = take(entry, index, num_maps * num_obstacles)
        row = jnp.where(place < num_maps * num_obstacles, place % num_obstacles, num_obstacles)
        return take(obstacles.xy, row)

    points = map_rows(gather, index, num_rows=proposals.num_clusters, chunk=box.TABLE_CHUNK)
    return points, count, jnp.int32(0)


def max_slab_points(capacity: int, config: DetectorConfig) -> int:
    """Capacity for the points that boxes are fitted to, from that of the cloud unless it is set."""
    return config.box.max_slab_points or -(-capacity // 4)


def build_evidence(sweep: Sweep, heights: Heights, config: DetectorConfig) -> evidence.Evidence | None:
    """What the beams saw, or None where the preset does not ask."""
    if not config.evidence.enabled:
        return None
    sensor_height = -heights.plane.coefficients[2]
    return evidence.build_evidence(
        sweep.xyz, heights.height, sweep.inlier, sensor_height, **stage_options(config.evidence, "enabled")
    )


def complete_boxes(
    fits: Fits, proposals: Proposals, seen: evidence.Evidence | None, config: DetectorConfig
) -> tuple[Trials, Boxes]:
    """The completed box of every trial, with the scene's direction preferred where the preset asks."""
    preference = jnp.zeros(config.box.num_angles)
    if config.box.scene_direction and seen is not None:
        preference = _scene_preference(fits, proposals, seen, config)
    readings = [best_rectangles(fits, preference)]
    if config.box.scene_direction and config.completion.along_scene:
        readings.append(best_rectangles(fits, preference, INSISTENCE))
    trials = list_trials(proposals, readings, config)
    return trials, _complete(trials, readings, fits, seen, config)


def _scene_preference(
    fits: Fits, proposals: Proposals, seen: evidence.Evidence, config: DetectorConfig
) -> jax.Array:
    """The direction that the first map's boxes, fitted without a preference, vote for."""
    settings = config.box
    size = config.clustering.maps[0].max_clusters
    rectangles = jax.tree.map(lambda a: a[:size], best_rectangles(fits, jnp.zeros(settings.num_angles)))
    long = longest_side(rectangles) >= settings.direction_min_extent_m
    cluster, num = compact(long & (jnp.arange(size) < proposals.num_first), size)
    boxes = _complete(Trials(cluster, jnp.zeros_like(cluster), num), [rectangles], fits, seen, config)
    rays = cast_rays(boxes, num, seen, config)
    voting = (jnp.arange(size) < num) & (boxes.objective > NOT_A_BOX)
    voting = voting & (rays.free_length <= settings.direction_max_free)
    return box.scene_preference(
        boxes.yaw,
        jnp.max(boxes.measured, axis=1),
        take(proposals.num_points, cluster),
        voting,
        num_angles=settings.num_angles,
        weight=settings.direction_weight,
        sigma_deg=settings.direction_sigma_deg,
    )


def _complete(
    trials: Trials,
    readings: Sequence[Rectangles],
    fits: Fits,
    seen: evidence.Evidence | None,
    config: DetectorConfig,
) -> Boxes:
    settings = config.completion
    limits = {name: class_values(config, name, trials.label) for name in ("max_length_m", "max_width_m")}
    usual = tuple(class_values(config, name, trials.label) for name in ("length_m", "width_m"))

    def complete(rows: tuple[jax.Array, dict[str, jax.Array], tuple[jax.Array, jax.Array]]) -> Boxes:
        cluster, limits, usual = rows
        each = [jax.tree.map(lambda a: take(a, cluster), rectangles) for rectangles in readings]
        if settings.mode == "none":
            return completion.keep_measured(each[0], **limits)
        likely = functools.partial(
            completion.likely_sizes, length_m=usual[0], width_m=usual[1], **_fields(settings, _SIDE_FIELDS)
        )
        if settings.mode == "away":
            return completion.extend_away(each[0], likely(each[0]), **limits)
        assert seen is not None  # see check_settings
        judged = _hypotheses(each, [completion.usual_sizes(r, *usual) for r in each], limits)
        answers = _hypotheses(each, [likely(r) for r in each], limits)
        rays = _cast_chunk(judged, settings.num_rays, seen, config)
        points, count = take(fits.points, cluster), take(fits.count, cluster)
        inside, near = completion.point_agreement(judged, points, count)
        return completion.choose_hypothesis(
            judged,
            answers,
            jnp.repeat(jnp.stack([r.worth for r in each], axis=1), judged.yaw.shape[1] // len(each), axis=1),
            hit=rays.hit,
            free=rays.free,
            free_length=rays.free_length,
            inside=inside,
            near=near,
            **_fields(settings, _OBJECTIVE_FIELDS),
        )

    return map_by_size(
        complete,
        (trials.cluster, limits, usual),
        take(fits.count, trials.cluster),
        max_size=fits.points.shape[1],
        num_rows=trials.num,
        chunk=PROPOSAL_CHUNK,
    )


_SIDE_FIELDS = ("seen_length", "seen_width", "seen_weight", "length_margin_m", "width_margin_m")
_OBJECTIVE_FIELDS = (
    "free_weight", "free_length_weight", "inside_weight", "near_weight", "closeness_weight", "not_away_cost",
)  # fmt: skip


def _fields(settings: CompletionConfig, names: Sequence[str]) -> dict[str, Any]:
    return {name: getattr(settings, name) for name in names}


def _hypotheses(
    readings: Sequence[Rectangles], sizes: Sequence[jax.Array], limits: dict[str, jax.Array]
) -> Boxes:
    """(P, S) the hypotheses of all readings of each cluster, side by side."""
    boxes = [completion.box_hypotheses(r, size, **limits) for r, size in zip(readings, sizes, strict=True)]
    return jax.tree.map(lambda *of_each: jnp.concatenate(of_each, axis=1), *boxes)


def _cast_chunk(
    boxes: Boxes, num_rays: int, seen: evidence.Evidence, config: DetectorConfig
) -> evidence.RayFractions:
    return evidence.cast_rays(
        seen,
        boxes.center,
        boxes.length,
        boxes.width,
        boxes.yaw,
        num_rays=num_rays,
        range_cell_m=config.evidence.range_cell_m,
    )


def cast_rays(
    boxes: Boxes, num: jax.Array, seen: evidence.Evidence, config: DetectorConfig
) -> evidence.RayFractions:
    """What the rays over each box met, finely enough for its score."""
    cast = functools.partial(_cast_chunk, num_rays=config.completion.num_final_rays, seen=seen, config=config)
    return map_rows(cast, boxes, num_rows=num, chunk=PROPOSAL_CHUNK)
