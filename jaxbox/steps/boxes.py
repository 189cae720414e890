"""From the clusters to boxes, completed where the sensor does not see."""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from jaxbox import box, completion, evidence, hull
from jaxbox.config import DetectorConfig
from jaxbox.masked import compact, map_rows, take
from jaxbox.steps.common import class_values, stage_options
from jaxbox.steps.points import Heights, Obstacles, Sweep
from jaxbox.steps.proposals import Proposals, Trials, list_trials
from jaxbox.types import NOT_A_BOX, Boxes, Rectangles

PROPOSAL_CHUNK = 512
"""Proposals held against the evidence at a time: a loop over their points has few, wide steps."""


HULL_CHUNK = 16
"""Clusters whose hulls are traced at a time: each compares all pairs of its points."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Fits:
    """All rotations of all clusters, and the points that they were fitted to."""

    curve: jax.Array  # (P, A)
    extents: box.Extents
    points: jax.Array  # (P, M, 2) m
    count: jax.Array  # (P,)
    hull_vertices: jax.Array  # () of the largest hull that was fitted to; 0 where none was


def fit_rectangles(obstacles: Obstacles, proposals: Proposals, config: DetectorConfig) -> Fits:
    """Rectangles of all clusters at all rotations, and the points that they were fitted to."""
    settings = config.box
    outline = _hull_points if settings.fit_to == "hull" else _slab_points
    points, count, hull_vertices = outline(obstacles, proposals, config)
    curve, extents = box.try_rotations(
        points,
        count,
        proposals.num_clusters,
        criterion=settings.criterion,
        num_angles=settings.num_angles,
        min_distance_m=settings.min_distance_m,
    )
    return Fits(curve, extents, points, count, hull_vertices)


def _hull_points(
    obstacles: Obstacles, proposals: Proposals, config: DetectorConfig
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The hull of each cluster, as the points that its rectangle is fitted to (the paper)."""
    num_obstacles = obstacles.xy.shape[0]
    index = hull.extreme_points(
        proposals.cluster.reshape(-1),
        jnp.tile(obstacles.xy, (len(proposals.maps), 1)),
        num_clusters=proposals.num_points.shape[0],
        num_slices=config.hull.num_slices,
    )
    index = jnp.where(index < proposals.cluster.size, index % num_obstacles, num_obstacles)
    trace = functools.partial(trace_hulls, obstacles.xy, config.hull.max_vertices)
    vertices, count = map_rows(trace, index, num_rows=proposals.num_clusters, chunk=HULL_CHUNK)
    return vertices, jnp.minimum(count, config.hull.max_vertices), jnp.max(count)


def trace_hulls(xy: jax.Array, max_vertices: int, index: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Hulls of the clusters whose points are listed: (C, H, 2) m, and their true numbers of vertices."""
    one = functools.partial(hull.convex_hull, max_vertices=max_vertices)
    return jax.vmap(one)(take(xy, index), index < xy.shape[0])


def _slab_points(
    obstacles: Obstacles, proposals: Proposals, config: DetectorConfig
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The points of each cluster between the slab's heights, or all where those are few."""
    num_clusters, num_obstacles = proposals.num_points.shape[0], obstacles.row.shape[0]
    rows, clusters = [], []
    for cluster, used in zip(proposals.cluster, proposals.fitted, strict=True):
        row, _ = compact(used, max_slab_points(obstacles.num_rows, config))
        rows.append(row)
        clusters.append(take(cluster, row, num_clusters))
    index, count = box.sample_points(
        jnp.concatenate(clusters), num_clusters=num_clusters, max_points=config.box.max_points
    )
    row = take(jnp.concatenate(rows), index, num_obstacles)
    return take(obstacles.xy, row), count, jnp.int32(0)


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
    trials = list_trials(proposals)
    preference = jnp.zeros(config.box.num_angles)
    if config.box.scene_direction and seen is not None:
        preference = _scene_preference(fits, proposals, seen, config)
    rectangles = box.best_rectangles(fits.curve, fits.extents, preference)
    return trials, _complete(trials, rectangles, fits, seen, config)


def _scene_preference(
    fits: Fits, proposals: Proposals, seen: evidence.Evidence, config: DetectorConfig
) -> jax.Array:
    """The direction that the first map's boxes, fitted without a preference, vote for."""
    settings = config.box
    size = proposals.maps[0].num_points.shape[0]
    first = jax.tree.map(lambda a: a[:size] if a.ndim else a, fits)
    j = jnp.arange(size)
    trials = Trials(
        jnp.where(j < proposals.num_first, j, size), jnp.zeros(size, jnp.int32), proposals.num_first
    )
    rectangles = box.best_rectangles(first.curve, first.extents, jnp.zeros(settings.num_angles))
    boxes = _complete(trials, rectangles, first, seen, config)
    rays = cast_rays(boxes, trials.num, seen, config)
    extent = jnp.max(boxes.measured, axis=1)
    voting = (j < trials.num) & (boxes.objective > NOT_A_BOX)
    voting = voting & (extent >= settings.direction_min_extent_m)
    voting = voting & (rays.free_length <= settings.direction_max_free)
    return box.scene_preference(
        boxes.yaw,
        extent,
        proposals.num_points[:size],
        voting,
        num_angles=settings.num_angles,
        weight=settings.direction_weight,
        sigma_deg=settings.direction_sigma_deg,
    )


def _complete(
    trials: Trials,
    rectangles: Rectangles,
    fits: Fits,
    seen: evidence.Evidence | None,
    config: DetectorConfig,
) -> Boxes:
    settings = config.completion
    limits = ("max_length_m", "max_width_m")
    prior = {name: class_values(config, name, trials.label) for name in ("length_m", "width_m", *limits)}

    def complete(rows: tuple[jax.Array, dict[str, jax.Array]]) -> Boxes:
        cluster, prior = rows
        rectangle = jax.tree.map(lambda a: take(a, cluster), rectangles)
        if settings.mode == "none":
            return completion.keep_measured(rectangle, **{name: prior[name] for name in limits})
        if settings.mode == "away":
            return completion.extend_away(rectangle, **prior)
        assert seen is not None  # see check_settings
        hypotheses = completion.box_hypotheses(rectangle, **prior)
        rays = _cast_chunk(hypotheses, settings.num_rays, seen, config)
        inside, near = completion.point_agreement(
            hypotheses, take(fits.points, cluster), take(fits.count, cluster)
        )
        return completion.choose_hypothesis(
            hypotheses,
            rectangle.worth,
            hit=rays.hit,
            free=rays.free,
            free_length=rays.free_length,
            inside=inside,
            near=near,
            **stage_options(settings, "mode", "num_rays", "num_final_rays"),
        )

    return map_rows(complete, (trials.cluster, prior), num_rows=trials.num, chunk=PROPOSAL_CHUNK)


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
