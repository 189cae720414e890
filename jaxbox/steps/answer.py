"""From the candidates to the answer: suppression, shapes, counts and status."""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxbox.config import DetectorConfig
from jaxbox.stages import descriptors, hull
from jaxbox.stages import scoring as vehicles
from jaxbox.steps.boxes import Fits, max_slab_points, trace_hulls
from jaxbox.steps.decision import Candidates
from jaxbox.steps.points import Heights, Obstacles, Sweep
from jaxbox.steps.proposals import Proposals
from jaxbox.types import GROUND_ABOVE_M, Counts, Descriptors, Detections, Hulls, PointCloud, Status
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.loops import at_once, fold_rows, map_rows, store
from jaxbox.xla.masked import compact, count_true, greatest, lookup, take

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
    num_assignments: jax.Array,
    config: DetectorConfig,
) -> Detections:
    """Suppresses overlapping boxes, describes the points of the others, and counts everything."""
    settings = config.vehicles
    keep = vehicles.suppress(candidates.rectangle, candidates.valid, max_overlap=settings.max_overlap)
    row, num = compact(keep, settings.max_detections)
    kept = map_rows(functools.partial(_keep, candidates), row, num_rows=num)
    valid = row < keep.shape[0]
    asked, owner, num_asked = _owners(kept, valid, obstacles, proposals)
    num_points, hulls, shapes = _describe(owner, asked, num_asked, obstacles.xy, kept, num, config)
    largest_hull = jnp.maximum(greatest(hulls.num_vertices, 0), fits.hull_vertices)
    points = _count_points(sweep, heights, proposals, config)

    def account() -> tuple[Counts, jax.Array]:
        counts = _counts(points, cloud, obstacles, proposals, num_assignments, candidates, num, largest_hull)
        return counts, _status(cloud, counts, heights, config)

    counts, status = at_once(account)

    nowhere = jnp.full(sweep.xyz.shape[0], -1, jnp.int32)
    return Detections(
        center=kept.center,
        size=kept.size,
        yaw=kept.yaw,
        score=kept.score,
        label=kept.label,
        valid=valid,
        num_points=num_points,
        hulls=hulls,
        descriptors=shapes,
        ground=heights.plane,
        ground_mask=sweep.inlier & (heights.height <= config.ground.min_height_m),
        point_component=nowhere.at[obstacles.row].set(proposals.component, mode="drop"),
        point_detection=_claim_points(nowhere, asked, owner, num_asked, obstacles, valid.shape[0]),
        status=status,
        counts=counts,
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Kept:
    """The candidates that suppression leaves: K rows, zero where there is none."""

    center: jax.Array  # (K, 3) m
    size: jax.Array  # (K, 3) m
    yaw: jax.Array  # (K,) rad
    score: jax.Array  # (K,)
    label: jax.Array  # (K,)
    cluster: jax.Array  # (K,)
    frame: jax.Array  # (K, 6) centre, direction and half the size, m, that a point of the box lies within


def _keep(candidates: Candidates, row: jax.Array) -> Kept:
    x, y, length, width, yaw = take(candidates.rectangle, row).T
    bottom, height = take(candidates.bottom, row), take(candidates.height, row)
    half_length, half_width = length / 2 + INSIDE_TOLERANCE_M, width / 2 + INSIDE_TOLERANCE_M
    return Kept(
        center=jnp.stack([x, y, bottom + height / 2], axis=1),
        size=jnp.stack([length, width, height], axis=1),
        yaw=yaw,
        score=take(candidates.score, row),
        label=take(candidates.label, row),
        cluster=take(candidates.cluster, row),
        frame=jnp.stack([x, y, jnp.cos(yaw), jnp.sin(yaw), half_length, half_width], axis=1),
    )


def _claim_points(
    nowhere: jax.Array,
    asked: jax.Array,
    owner: jax.Array,
    num_asked: jax.Array,
    obstacles: Obstacles,
    num_detections: int,
) -> jax.Array:
    """(N,) int32: the detection of each point of the sweep, -1 for none, from those of `_owners`."""

    def claim(of_point: jax.Array, _: jax.Array, rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        index, owner = rows
        row = take(obstacles.row, index, obstacles.num_rows)
        return of_point.at[row].set(jnp.where(owner < num_detections, owner, -1), mode="drop")

    absent = asked.shape[0], num_detections
    return fold_rows(claim, nowhere, (asked, owner), num_rows=num_asked, absent=absent)


def _describe(
    owner: jax.Array,
    row: jax.Array,
    num_rows: jax.Array,
    xy: jax.Array,
    kept: Kept,
    num: jax.Array,
    config: DetectorConfig,
) -> tuple[jax.Array, Hulls, Descriptors]:
    """How many points each detection has, and their hull and shape."""
    rows = owner, row, num_rows, xy
    bounds = hull.find_bounds(*rows, num_clusters=config.vehicles.max_detections)
    outline = hull.extreme_points(*rows, *bounds, num_slices=config.hull.num_slices)
    x, y, num_vertices = trace_hulls(xy, outline, num, config)
    vertices = jnp.stack([x.T, y.T], axis=2)
    moments = descriptors.point_moments(*rows, kept.center[:, :2])
    shape = moments, hull.polygon_area(vertices), num_vertices
    every = jnp.int32(num_vertices.shape[0])
    shapes = map_rows(lambda rows: descriptors.shape_descriptors(*rows), shape, num_rows=every)
    return moments[:, 0].astype(jnp.int32), Hulls(vertices, num_vertices), shapes


def _owners(
    kept: Kept, valid: jax.Array, obstacles: Obstacles, proposals: Proposals
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The points of clusters that have a detection, and the detection that each belongs to.

    Returns:
      index: (O,) int32 of the obstacle, O beyond.
      owner: (O,) int32, the best of the point's clusters' boxes that hold it, K for none.
      num: () int32; only the first so many rows count.
    """
    num_detections, num_clusters = valid.shape[0], proposals.num_points.shape[0]
    rank = jnp.where(valid, jnp.arange(num_detections, dtype=jnp.int32), num_detections)
    of_cluster = jnp.full(num_clusters + 1, num_detections, jnp.int32).at[kept.cluster].min(rank, mode="drop")
    # No point is inside the box of no detection.
    frame = jnp.pad(kept.frame, ((0, 1), (0, 0)), constant_values=-1)

    def own(xy: jax.Array, clusters: Sequence[jax.Array]) -> jax.Array:
        owner = jnp.full(xy.shape[0], num_detections, jnp.int32)
        for cluster in clusters:
            detection = lookup(of_cluster, cluster)
            x, y, cos, sin, half_length, half_width = jnp.take(frame, detection, axis=0, mode="clip").T
            dx, dy = xy[:, 0] - x, xy[:, 1] - y
            inside = jnp.abs(dx * cos + dy * sin) <= half_length
            inside = inside & (jnp.abs(dy * cos - dx * sin) <= half_width)
            owner = jnp.minimum(owner, jnp.where(inside, detection, num_detections))
        return owner

    if on_accelerator():
        # To list those that are asked takes longer there than to ask all.
        every = jnp.arange(obstacles.row.shape[0], dtype=jnp.int32)
        return every, own(obstacles.xy, list(proposals.cluster)), obstacles.count
    best = functools.reduce(jnp.minimum, [lookup(of_cluster, cluster) for cluster in proposals.cluster])
    asked, num_asked = compact(store(best < num_detections), best.shape[0], num=obstacles.count)

    def own_at(index: jax.Array) -> jax.Array:
        clusters = [take(cluster, index, num_clusters) for cluster in proposals.cluster]
        # Look-ups do not vectorise within the write of a chunk (XLA, CPU).
        return store(own(take(obstacles.xy, index), clusters))

    return asked, map_rows(own_at, asked, num_rows=num_asked, chunk=OWNER_CHUNK), num_asked


def _count_points(sweep: Sweep, heights: Heights, proposals: Proposals, config: DetectorConfig) -> jax.Array:
    """Points that are there, finite, in the region, no outliers, ground, overhead, and of a cluster."""
    above = heights.height > config.ground.min_height_m
    overhead = above & (heights.height >= config.ground.max_height_m)
    clustered = jnp.min(proposals.cluster, axis=0) < proposals.num_points.shape[0]
    kinds = sweep.inlier, sweep.inlier & ~above, sweep.inlier & overhead
    return count_true(sweep.present, sweep.finite, sweep.valid, *kinds, clustered)


def _counts(
    points: jax.Array,
    cloud: PointCloud,
    obstacles: Obstacles,
    proposals: Proposals,
    num_assignments: jax.Array,
    candidates: Candidates,
    num_detections: jax.Array,
    largest_hull: jax.Array,
) -> Counts:
    present, finite, valid, inliers, ground, overhead, clustered = points
    num_obstacles = jnp.minimum(obstacles.count, obstacles.row.shape[0])
    return Counts(
        dropped_points=cloud.num_points - present,
        nonfinite_points=present - finite,
        out_of_range_points=finite - valid,
        outlier_points=valid - inliers,
        ground_points=ground,
        overhead_points=overhead,
        dropped_obstacles=obstacles.count - num_obstacles,
        clustered_points=clustered,
        unclustered_points=num_obstacles - clustered,
        obstacles=obstacles.count,
        slab_points=proposals.num_slab,
        cells=proposals.num_runs,
        clusters=proposals.num_found,
        large_clusters=proposals.num_large,
        assignments=num_assignments,
        candidates=candidates.num,
        detections=num_detections,
        hull_vertices=largest_hull,
    )


def _status(cloud: PointCloud, counts: Counts, heights: Heights, config: DetectorConfig) -> jax.Array:
    settings = config.vehicles
    not_valid = counts.dropped_points + counts.nonfinite_points + counts.out_of_range_points
    max_clusters = jnp.array([m.max_clusters for m in config.clustering.maps], jnp.int32)
    max_cells = jnp.array([m.max_cells for m in config.clustering.maps], jnp.int32)
    bits = {
        Status.EMPTY: cloud.num_points == not_valid,
        Status.NONFINITE_POINTS: counts.nonfinite_points > 0,
        Status.POINT_OVERFLOW: counts.dropped_points > 0,
        Status.NO_GROUND: ~heights.plane.found,
        Status.OBSTACLE_OVERFLOW: (counts.dropped_obstacles > 0)
        | ((config.box.fit_to == "slab") & (counts.slab_points > max_slab_points(cloud.capacity, config))),
        Status.CELL_OVERFLOW: jnp.any(counts.cells > max_cells),
        Status.CLUSTER_OVERFLOW: jnp.any(counts.clusters > max_clusters)
        | (counts.large_clusters > settings.max_large),
        Status.ASSIGNMENT_OVERFLOW: counts.assignments > config.completion.max_assignments,
        Status.CANDIDATE_OVERFLOW: counts.candidates > settings.max_candidates,
        Status.DETECTION_OVERFLOW: counts.detections > settings.max_detections,
        Status.HULL_OVERFLOW: counts.hull_vertices > config.hull.max_vertices,
        Status.GROUND_ABOVE: heights.plane.found & (heights.plane.coefficients[2] > GROUND_ABOVE_M),
    }
    return sum((jnp.where(is_set, jnp.int32(bit), 0) for bit, is_set in bits.items()), jnp.int32(0))
