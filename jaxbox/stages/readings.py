"""Several readings of one sweep, each turned about the sensor: the best boxes, with the mean scores.

Where the cells of a map, the azimuths of the evidence and the angles of rectangles lie is chance: a car that
one reading splits, or joins to a hedge, may be whole in another, and a hedge that passes for a car in one may
pass for none in another.
"""

import dataclasses

import chex
import jax
import jax.numpy as jnp

from jaxbox.config import DetectorConfig, RegionConfig
from jaxbox.geometry.planar import rotate, wrap_turn, wrap_yaw
from jaxbox.stages._suppression import non_max_suppression
from jaxbox.types import Counts, Detections, PointCloud, combine_bits
from jaxbox.xla.indexing import take
from jaxbox.xla.rows import compact
from jaxbox.xla.sorting import best_first

TURN_DEG = 7.3
"""Each reading is turned so much farther about +z: no grid or angle step divides it."""

SAME_VEHICLE_M = 1.4
"""Boxes of two readings with nearer centres are of one vehicle; cars side by side are farther apart."""


def turn_sweep(cloud: PointCloud, angle: jax.Array, region: RegionConfig) -> PointCloud:
    """The sweep as if the sensor had been turned.

    Points outside the region are left out first, so that a turned reading sees no others. The maps lie over
    the unturned region: what is turned out of them, in its corners, is not in that reading.

    Args:
      cloud: of N rows.
      angle: () float32, rad, about +z; 0 leaves the cloud as it is, bit for bit.
      region: what is looked at.

    Returns:
      The cloud.
    """
    xyz1 = jnp.asarray(cloud.xyz1)
    chex.assert_shape(xyz1, (None, 4))
    within = (jnp.abs(xyz1[:, 0]) < region.half_x_m) & (jnp.abs(xyz1[:, 1]) < region.half_y_m)
    turned = jnp.concatenate([rotate(xyz1[:, :2], angle), xyz1[:, 2:]], axis=1)
    turned = jnp.where(within[:, None], turned, 0)
    return dataclasses.replace(cloud, xyz1=jnp.where(angle == 0, xyz1, turned))


def turn_back(detections: Detections, angle: jax.Array) -> Detections:
    """Boxes of a turned reading as they stand in the sweep.

    Args:
      detections: of the turned cloud.
      angle: () float32, rad, that it was turned by.

    Returns:
      The detections with the boxes and hulls turned; the ground plane is as it was.
    """
    center, hulls = detections.center, detections.hulls
    xy = rotate(center[:, :2], -angle)
    return dataclasses.replace(
        detections,
        center=jnp.concatenate([xy, center[:, 2:]], axis=1),
        yaw=wrap_yaw(detections.yaw - angle),
        heading=wrap_turn(detections.heading - angle),
        hulls=dataclasses.replace(hulls, vertices=rotate(hulls.vertices, -angle)),
    )


def merge_readings(found: Detections, config: DetectorConfig) -> Detections:
    """The best boxes of all readings that overlap no better one, with the mean of their scores.

    A reading without a box of a vehicle scores it 0. A point belongs to the best box that has it in its own
    reading; hulls and descriptors are those of that reading. What is said of the sweep, and where its points
    went, is that of the first reading.

    Args:
      found: of R readings, turned back; all arrays have a leading axis R.
      config: the overlap, and the capacities.

    Returns:
      K rows, as one reading has. Of boxes with equal scores the earlier reading's is kept.

    Reference: oracle `jaxbox.reference.merge_readings`.
    """
    first = jax.tree.map(lambda a: a[0], found)
    num_kept = first.valid.shape[0]
    row, score, num = _best_rows(found, config)
    counts = _most_needed(found.counts, first.counts, num)
    overflows = counts.overflows(config, first.ground_mask.shape[0])
    status = (first.status & ~sum(map(int, overflows))) | combine_bits(overflows)
    point_detection = _owners(found.point_detection, row, num_kept)
    num_points = jnp.zeros(num_kept + 1, jnp.int32).at[point_detection].add(1)[:num_kept]

    def best(rows: jax.Array, fill: float = 0) -> jax.Array:
        return take(_flat(rows), row, fill)

    # Rows without a box are as in one reading: their front is not known, and they are round.
    eccentricity = best(found.descriptors.eccentricity, 1)
    return dataclasses.replace(
        first,
        center=best(found.center),
        size=best(found.size),
        yaw=best(found.yaw),
        heading=best(found.heading),
        front_probability=best(found.front_probability, 0.5),
        score=score,
        label=best(found.label),
        valid=best(found.valid),
        num_points=num_points,
        hulls=jax.tree.map(best, found.hulls),
        descriptors=dataclasses.replace(jax.tree.map(best, found.descriptors), eccentricity=eccentricity),
        point_detection=point_detection,
        status=status,
        counts=counts,
    )


def _flat(rows: jax.Array) -> jax.Array:
    """Rows (R, K, ...) of all readings, one reading after the other."""
    return rows.reshape(-1, *rows.shape[2:])


def _best_rows(found: Detections, config: DetectorConfig) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The boxes that overlap no better one.

    Args:
      found: of R readings of K rows.
      config: the overlap.

    Returns:
      row: (K,) int32, best mean score first, the number of all rows beyond the last box.
      score: (K,) float32, the mean scores.
      num: () int32, how many boxes there are.
    """
    scores = jnp.where(found.valid, found.score, 0)
    num_rows = scores.size
    order = best_first(_flat(scores), jnp.int32(num_rows))
    flat = jnp.concatenate([found.center[..., :2], found.size[..., :2], found.yaw[..., None]], axis=2)
    boxes = take(_flat(flat), order)
    keep = non_max_suppression(boxes, order < num_rows, max_overlap=config.vehicles.max_overlap)
    place, num = compact(keep, found.valid.shape[1])
    row, kept = take(order, place, num_rows), take(boxes, place)
    score = jnp.where(row < num_rows, _mean_scores(kept[:, :2], found.center[..., :2], scores), 0)
    order = best_first(score, jnp.int32(score.size))
    return take(row, order, num_rows), take(score, order), num


def _mean_scores(xy: jax.Array, centers: jax.Array, scores: jax.Array) -> jax.Array:
    """The mean over all readings of the best score that each gives a box.

    Args:
      xy: (K, 2) m, centres of the boxes.
      centers: (R, K, 2) m, of the boxes of each reading.
      scores: (R, K), of the same.

    Returns:
      (K,) float32.
    """
    apart_m = jnp.linalg.norm(centers[:, None] - xy[None, :, None], axis=3)
    best = jnp.max(jnp.where(apart_m < SAME_VEHICLE_M, scores[:, None], 0), axis=2)
    return jnp.mean(best, axis=0)


def _owners(point_detection: jax.Array, row: jax.Array, num_kept: int) -> jax.Array:
    """(N,) int32: the best kept box that has each point in its own reading, -1 for none.

    Args:
      point_detection: (R, N) int32, row within each reading, -1 for none.
      row: (K,) int32, rows of all readings that are kept.
      num_kept: K.
    """
    num_readings = point_detection.shape[0]
    rank = jnp.full((num_readings * num_kept,), num_kept, jnp.int32)
    rank = rank.at[row].set(jnp.arange(num_kept, dtype=jnp.int32), mode="drop")
    # The last column is that of -1, for points of no box.
    rank = jnp.pad(rank.reshape(num_readings, num_kept), ((0, 0), (0, 1)), constant_values=num_kept)
    best = jnp.min(jnp.take_along_axis(rank, point_detection % (num_kept + 1), axis=1), axis=0)
    return jnp.where(best < num_kept, best, -1)


def _most_needed(counts: Counts, first: Counts, num: jax.Array) -> Counts:
    """Where the points went in the first reading, and the most that any reading needs of each capacity."""
    most = jax.tree.map(lambda a: jnp.max(a, axis=0), counts)
    return dataclasses.replace(
        first,
        obstacles=most.obstacles,
        slab_points=most.slab_points,
        cells=most.cells,
        clusters=most.clusters,
        large_clusters=most.large_clusters,
        assignments=most.assignments,
        candidates=most.candidates,
        detections=jnp.maximum(most.detections, num),
        hull_vertices=most.hull_vertices,
    )
