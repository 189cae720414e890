"""From the candidates to the answer: suppression, shapes, counts and status."""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from jaxbox import descriptors, hull, vehicles
from jaxbox.config import DetectorConfig
from jaxbox.masked import compact, map_rows, take
from jaxbox.steps.boxes import HULL_CHUNK, Fits, max_slab_points, trace_hulls
from jaxbox.steps.decision import Candidates
from jaxbox.steps.points import Heights, Obstacles, Sweep
from jaxbox.steps.proposals import Proposals
from jaxbox.types import Counts, Descriptors, Detections, Hulls, PointCloud, Status

OWNED_SHARE = 4
"""Detections mostly own less than this part of the obstacle points."""

OWNER_CHUNK = 4096
"""Points whose detections are looked up at a time."""

INSIDE_TOLERANCE_M = 1e-3
"""A point on the face of its box is inside."""


def conclude(
    cloud: PointCloud,
    sweep: Sweep,
    heights: Heights,
    obstacles: Obstacles,
    proposals: Proposals,
    fits: Fits,
    candidates: Candidates,
    config: DetectorConfig,
) -> Detections:
    """Suppresses overlapping boxes, describes the points of the others, and counts everything."""
    settings = config.vehicles
    keep = vehicles.suppress(candidates.rectangle, candidates.valid, max_overlap=settings.max_overlap)
    row, num = compact(keep, settings.max_detections)
    kept = jax.tree.map(lambda a: take(a, row), dataclasses.replace(candidates, num=keep))
    valid = row < keep.shape[0]
    owner = _owners(kept, valid, obstacles, proposals)
    num_points, hulls, shapes = _describe(owner, kept, num, obstacles, config)
    center = jnp.concatenate([kept.rectangle[:, :2], (kept.bottom + kept.height / 2)[:, None]], axis=1)
    size = jnp.concatenate([kept.rectangle[:, 2:4], kept.height[:, None]], axis=1)
    largest_hull = jnp.maximum(jnp.max(hulls.num_vertices), fits.hull_vertices)
    counts = _counts(cloud, sweep, heights, obstacles, proposals, candidates, num, largest_hull, config)

    def per_point(value: jax.Array, absent: int) -> jax.Array:
        everywhere = jnp.full(sweep.xyz.shape[0], absent, jnp.int32)
        return everywhere.at[obstacles.row].set(value.astype(jnp.int32), mode="drop")

    return Detections(
        center=jnp.where(valid[:, None], center, 0),
        size=jnp.where(valid[:, None], size, 0),
        yaw=kept.rectangle[:, 4],
        score=kept.score,
        label=kept.label,
        valid=valid,
        num_points=num_points,
        hulls=hulls,
        descriptors=shapes,
        ground=heights.plane,
        ground_mask=sweep.inlier & (heights.height <= config.ground.min_height_m),
        point_component=per_point(proposals.maps[0].component, -1),
        point_detection=per_point(jnp.where(owner < settings.max_detections, owner, -1), -1),
        status=_status(counts, sweep, heights, obstacles, proposals, config),
        counts=counts,
    )


def _describe(
    owner: jax.Array, kept: Candidates, num: jax.Array, obstacles: Obstacles, config: DetectorConfig
) -> tuple[jax.Array, Hulls, Descriptors]:
    """How many points each detection has, and their hull and shape."""
    size, capacity = config.vehicles.max_detections, owner.shape[0]
    trace = functools.partial(trace_hulls, max_vertices=config.hull.max_vertices)
    row, num_owned = compact(owner < size, capacity)

    def describe(row: jax.Array) -> tuple[jax.Array, Hulls, Descriptors]:
        of, xy = take(owner, row, size), take(obstacles.xy, row)
        outline = hull.extreme_points(of, xy, num_clusters=size, num_slices=config.hull.num_slices)
        vertices, num_vertices = map_rows(
            functools.partial(trace, xy), outline, num_rows=num, chunk=HULL_CHUNK
        )
        num_points = jnp.zeros(size, jnp.int32).at[of].add(1, mode="drop")
        area = hull.polygon_area(vertices)
        shapes = descriptors.shape_descriptors(of, xy, kept.rectangle[:, :2], area, num_vertices)
        return num_points, Hulls(vertices, num_vertices), shapes

    # Few points belong to a detection as a rule, and the work is in proportion to their list.
    few = capacity // OWNED_SHARE
    return jax.lax.cond(num_owned <= few, lambda: describe(row[:few]), lambda: describe(row))


def _owners(kept: Candidates, valid: jax.Array, obstacles: Obstacles, proposals: Proposals) -> jax.Array:
    """(O,) the detection each point belongs to, K for none: the best of its clusters' boxes that hold it."""
    num_detections, num_clusters = valid.shape[0], proposals.num_points.shape[0]
    rank = jnp.where(valid, jnp.arange(num_detections), num_detections)
    of_cluster = jnp.full(num_clusters, num_detections).at[kept.cluster].min(rank, mode="drop")
    x, y, length, width, yaw = kept.rectangle.T
    frame = jnp.stack([x, y, jnp.cos(yaw), jnp.sin(yaw), length / 2, width / 2], axis=1)
    of_point = [take(of_cluster, cluster, num_detections) for cluster in proposals.cluster]
    asked, num_asked = compact(
        functools.reduce(jnp.minimum, of_point) < num_detections, obstacles.row.shape[0]
    )

    def own(row: jax.Array) -> jax.Array:
        xy = take(obstacles.xy, row)
        owner = jnp.full(row.shape, num_detections)
        for each in of_point:
            detection = take(each, row, num_detections)
            x, y, cos, sin, half_length, half_width = take(frame, detection).T
            dx, dy = xy[:, 0] - x, xy[:, 1] - y
            inside = jnp.abs(dx * cos + dy * sin) <= half_length + INSIDE_TOLERANCE_M
            inside = inside & (jnp.abs(dy * cos - dx * sin) <= half_width + INSIDE_TOLERANCE_M)
            owner = jnp.minimum(owner, jnp.where(inside, detection, num_detections))
        return owner

    owner = map_rows(own, asked, num_rows=num_asked, chunk=OWNER_CHUNK)
    return jnp.full(obstacles.row.shape, num_detections).at[asked].set(owner, mode="drop")


def _counts(
    cloud: PointCloud,
    sweep: Sweep,
    heights: Heights,
    obstacles: Obstacles,
    proposals: Proposals,
    candidates: Candidates,
    num_detections: jax.Array,
    largest_hull: jax.Array,
    config: DetectorConfig,
) -> Counts:
    num = functools.partial(jnp.sum, dtype=jnp.int32)
    clustered = num(jnp.any(proposals.cluster < proposals.num_points.shape[0], axis=0) & obstacles.present)
    num_obstacles = num(obstacles.present)
    above = heights.height > config.ground.min_height_m
    return Counts(
        dropped_points=cloud.num_points - num(sweep.present),
        nonfinite_points=num(sweep.present & ~sweep.finite),
        out_of_range_points=num(sweep.finite & ~sweep.valid),
        outlier_points=num(sweep.valid & ~sweep.inlier),
        ground_points=num(sweep.inlier & ~above),
        overhead_points=num(sweep.inlier & above & (heights.height >= config.ground.max_height_m)),
        dropped_obstacles=obstacles.count - num_obstacles,
        clustered_points=clustered,
        unclustered_points=num_obstacles - clustered,
        obstacles=obstacles.count,
        slab_points=proposals.num_slab,
        cells=jnp.stack([m.num_cells for m in proposals.maps]),
        clusters=jnp.stack([m.num_clusters for m in proposals.maps]),
        large_clusters=proposals.num_large,
        candidates=candidates.num,
        detections=num_detections,
        hull_vertices=largest_hull,
    )


def _status(
    counts: Counts,
    sweep: Sweep,
    heights: Heights,
    obstacles: Obstacles,
    proposals: Proposals,
    config: DetectorConfig,
) -> jax.Array:
    settings = config.vehicles
    capacity = sweep.xyz.shape[0]
    max_clusters = jnp.array([m.max_clusters for m in config.clustering.maps])
    max_cells = jnp.array([m.max_cells for m in config.clustering.maps])
    bits = {
        Status.EMPTY: ~jnp.any(sweep.valid),
        Status.NONFINITE_POINTS: counts.nonfinite_points > 0,
        Status.POINT_OVERFLOW: counts.dropped_points > 0,
        Status.NO_GROUND: ~heights.plane.found,
        Status.OBSTACLE_OVERFLOW: (counts.dropped_obstacles > 0)
        | ((config.box.fit_to == "slab") & (counts.slab_points > max_slab_points(capacity, config))),
        Status.CELL_OVERFLOW: jnp.any(counts.cells > max_cells),
        Status.CLUSTER_OVERFLOW: jnp.any(counts.clusters > max_clusters)
        | (counts.large_clusters > settings.max_large),
        Status.CANDIDATE_OVERFLOW: counts.candidates > settings.max_candidates,
        Status.DETECTION_OVERFLOW: counts.detections > settings.max_detections,
        Status.HULL_OVERFLOW: counts.hull_vertices > config.hull.max_vertices,
    }
    return sum((jnp.where(is_set, jnp.int32(bit), 0) for bit, is_set in bits.items()), jnp.int32(0))
