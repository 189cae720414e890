"""Assembly of the answer: which points each detection has, the counts of everything, and the status."""

import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxbox.config import DetectorConfig, HealthConfig
from jaxbox.stages.state import (
    Candidates,
    Clusters,
    Completed,
    Ground,
    Health,
    Kept,
    Obstacles,
    Outlines,
    Owners,
    Sweep,
)
from jaxbox.types import (
    GROUND_ABOVE_M,
    Counts,
    Descriptors,
    Detections,
    GroundPlane,
    Hulls,
    PointCloud,
    Status,
    combine_bits,
)
from jaxbox.xla import chunks
from jaxbox.xla.barriers import single_kernel
from jaxbox.xla.indexing import lookup, scatter, take
from jaxbox.xla.loops import fold_rows
from jaxbox.xla.rows import count_each, map_selected, maximum


def assign_points(kept: Kept, obstacles: Obstacles, clusters: Clusters) -> Owners:
    """The points of clusters that have a detection, and the detection that each belongs to.

    Args:
      kept: K detections.
      obstacles: O points.
      clusters: of the points.

    Returns:
      The points that may belong to one, and to which.
    """
    chex.assert_shape([obstacles.xy, clusters.of_point], [(None, 2), (None, *obstacles.height.shape)])
    num_detections, num_clusters = kept.valid.shape[0], clusters.num_points.shape[0]
    rank = jnp.where(kept.valid, jnp.arange(num_detections, dtype=jnp.int32), num_detections)
    of_cluster = jnp.full(num_clusters + 1, num_detections, jnp.int32).at[kept.cluster].min(rank, mode="drop")
    # No point is inside the box of no detection.
    frame = jnp.pad(kept.frame, ((0, 1), (0, 0)), constant_values=-1)
    clusters_of_point = list(clusters.of_point)

    def own(rows: tuple[jax.Array, list[jax.Array]]) -> jax.Array:
        xy, clusters = rows
        owner = jnp.full(xy.shape[0], num_detections, jnp.int32)
        for cluster in clusters:
            detection = lookup(of_cluster, cluster)
            x, y, cos, sin, half_length, half_width = (lookup(column, detection) for column in frame.T)
            dx, dy = xy[:, 0] - x, xy[:, 1] - y
            inside = jnp.abs(dx * cos + dy * sin) <= half_length
            inside = inside & (jnp.abs(dy * cos - dx * sin) <= half_width)
            owner = jnp.minimum(owner, jnp.where(inside, detection, num_detections))
        return owner

    def may_have_one() -> jax.Array:
        best = functools.reduce(jnp.minimum, [lookup(of_cluster, cluster) for cluster in clusters_of_point])
        return best < num_detections

    rows, absent = (obstacles.xy, clusters_of_point), (0, [num_clusters] * len(clusters_of_point))
    return Owners(
        *map_selected(own, rows, may_have_one, num_rows=obstacles.count, absent=absent, chunk=chunks.OWNERS)
    )


class Found(NamedTuple):
    """What all stages found, of which the answer is made."""

    sweep: Sweep
    ground: Ground
    obstacles: Obstacles
    clusters: Clusters
    outlines: Outlines
    completed: Completed
    candidates: Candidates
    kept: Kept
    health: Health


def assemble(
    cloud: PointCloud,
    found: Found,
    owners: Owners,
    hulls: Hulls,
    num_points: jax.Array,
    descriptors: Descriptors,
    fronts: tuple[jax.Array, jax.Array],
    first_return_m: jax.Array,
    config: DetectorConfig,
) -> Detections:
    """Counts where everything went, and gathers the answer.

    Args:
      cloud: of N rows.
      found: by all stages.
      owners: which points may belong to a detection, and to which.
      hulls: of the points of K detections.
      num_points: (K,) int32, how many they are.
      descriptors: of their shapes.
      fronts: (K,) float32 each: where they point, rad, and P(front).
      first_return_m: (A,) float32, see `Detections`.
      config: of the detector.

    Returns:
      The detections.
    """
    sweep, ground, kept = found.sweep, found.ground, found.kept
    largest_hull = jnp.maximum(maximum(hulls.num_vertices, 0), found.outlines.hull_vertices)
    points = _count_points(found, config)

    def account() -> tuple[Counts, jax.Array]:
        counts = _counts(points, cloud, found, largest_hull)
        return counts, _status(cloud, counts, ground, config)

    counts, status = single_kernel(account)
    nowhere = jnp.full(sweep.xyz.shape[0], -1, jnp.int32)
    return Detections(
        center=kept.center,
        size=kept.size,
        yaw=kept.yaw,
        heading=fronts[0],
        front_probability=fronts[1],
        score=kept.score,
        label=kept.label,
        valid=kept.valid,
        num_points=num_points,
        hulls=hulls,
        descriptors=descriptors,
        ground=ground.plane,
        ground_mask=sweep.inlier & (ground.height <= config.ground.min_height_m),
        point_component=scatter("set", nowhere, found.obstacles.row, found.clusters.component),
        point_detection=_claim_points(nowhere, owners, found.obstacles, kept.valid.shape[0]),
        first_return_m=first_return_m,
        status=status,
        counts=counts,
    )


def _claim_points(nowhere: jax.Array, owners: Owners, obstacles: Obstacles, num_detections: int) -> jax.Array:
    """(N,) int32: the detection of each point of the sweep, -1 for none."""

    def claim(of_point: jax.Array, _: jax.Array, rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        index, owner = rows
        row = take(obstacles.row, index, obstacles.num_rows)
        return scatter("set", of_point, row, jnp.where(owner < num_detections, owner, -1))

    absent = owners.row.shape[0], num_detections
    return fold_rows(claim, nowhere, (owners.row, owners.owner), num_rows=owners.num, absent=absent)


def _count_points(found: Found, config: DetectorConfig) -> jax.Array:
    """Points that are not padding, finite, in the region, no outliers, ground, overhead, and of a cluster."""
    sweep, height, clusters = found.sweep, found.ground.height, found.clusters
    above = height > config.ground.min_height_m
    overhead = above & (height >= config.ground.max_height_m)
    clustered = jnp.min(clusters.of_point, axis=0) < clusters.num_points.shape[0]
    kinds = sweep.inlier, sweep.inlier & ~above, sweep.inlier & overhead
    return count_each(sweep.is_point, sweep.finite, sweep.in_region, *kinds, clustered)


def _counts(points: jax.Array, cloud: PointCloud, found: Found, largest_hull: jax.Array) -> Counts:
    is_point, finite, in_region, inliers, ground, overhead, clustered = points
    obstacles, clusters, health = found.obstacles, found.clusters, found.health
    num_obstacles = jnp.minimum(obstacles.count, obstacles.row.shape[0])
    return Counts(
        # Of a cloud that was made by hand, and says that it has fewer points than rows, none were dropped.
        dropped_points=jnp.maximum(cloud.num_points - is_point, 0),
        nonfinite_points=is_point - finite,
        out_of_range_points=finite - in_region,
        outlier_points=in_region - inliers,
        ground_points=ground,
        overhead_points=overhead,
        dropped_obstacles=obstacles.count - num_obstacles,
        clustered_points=clustered,
        unclustered_points=num_obstacles - clustered,
        obstacles=obstacles.count,
        slab_points=clusters.num_slab,
        cells=clusters.num_runs,
        clusters=clusters.num_found,
        large_clusters=clusters.num_large,
        assignments=found.completed.num_assignments,
        candidates=found.candidates.num,
        detections=found.kept.num,
        hull_vertices=largest_hull,
        far_points=health.far_points,
        scattered_azimuths=health.scattered_azimuths,
        near_ground_points=health.near_ground_points,
        rough_points=health.rough_points,
        points_under=health.points_under,
        points_below=health.points_below,
    )


def _status(cloud: PointCloud, counts: Counts, ground: Ground, config: DetectorConfig) -> jax.Array:
    in_region = counts.outlier_points + counts.ground_points + counts.overhead_points + counts.obstacles
    found, plane = ground.plane.found, ground.plane
    bits = {
        Status.EMPTY: in_region == 0,
        Status.NONFINITE_POINTS: counts.nonfinite_points > 0,
        Status.POINT_OVERFLOW: counts.dropped_points > 0,
        Status.NO_GROUND: ~found,
        Status.GROUND_ABOVE: found & (plane.coefficients[2] > GROUND_ABOVE_M),
        Status.DEGRADED: found & _is_degraded(counts, in_region, config),
        Status.DOUBTFUL_GROUND: found & _is_doubtful(plane, counts, in_region, config.health),
    } | counts.overflows(config, cloud.capacity)
    return combine_bits(bits)


def _exceeds(part: jax.Array, share: jax.Array | float, whole: jax.Array | int) -> jax.Array:
    """() bool: whether a count is a larger share of another."""
    return part.astype(jnp.float32) > share * jnp.asarray(whole, jnp.float32)


def _is_degraded(counts: Counts, in_region: jax.Array, config: DetectorConfig) -> jax.Array:
    """() bool: whether the returns are those of bad weather or of a failing sensor."""
    limits = config.health
    # What exceeded the cloud's capacity was the farthest.
    finite = in_region + counts.out_of_range_points + counts.dropped_points
    near = finite - counts.far_points - counts.dropped_points
    return (
        _exceeds(near, 1 - limits.min_far_share, finite)
        | _exceeds(counts.scattered_azimuths, limits.max_scattered_share, config.evidence.num_azimuths)
        | _exceeds(counts.rough_points, limits.max_rough_share, counts.near_ground_points)
    )


def _is_doubtful(plane: GroundPlane, counts: Counts, in_region: jax.Array, limits: HealthConfig) -> jax.Array:
    """() bool: whether no road lies so under a vehicle's sensor, or much lies below it."""
    a, b, c = plane.coefficients
    steep = jnp.hypot(a, b) > jnp.tan(jnp.deg2rad(limits.max_tilt_deg))
    under = _exceeds(counts.points_under, limits.max_under_share, in_region)
    # Under ground above the sensor lies every point; GROUND_ABOVE says that already.
    below = _exceeds(counts.points_below, limits.max_below_share, in_region) & (c <= GROUND_ABOVE_M)
    return (-c > limits.max_sensor_height_m) | steep | under | below
