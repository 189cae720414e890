"""Convex hulls of many clusters at a fixed shape (paper, section 3.3)."""

import chex
import jax
import jax.numpy as jnp

from jaxbox.config import DetectorConfig, HullConfig
from jaxbox.config.capacities import slab_capacity
from jaxbox.stages.state import Clusters, Kept, Obstacles, Outlines, Owners
from jaxbox.types import Hulls
from jaxbox.xla import chunks
from jaxbox.xla.hulls import lower_hulls
from jaxbox.xla.indexing import lookup_each, scatter, take
from jaxbox.xla.loops import fold_rows, map_rows
from jaxbox.xla.ragged import PointLists, list_points
from jaxbox.xla.rows import compact
from jaxbox.xla.segments import argmax_key, argmax_row, fold_segments

MIN_EXTENT_M = 1e-6
"""Clusters narrower than this are cut as if they had this width: all their points are in one slice."""


def outline_clusters(obstacles: Obstacles, clusters: Clusters, config: DetectorConfig) -> Outlines:
    """The points of each cluster that its rectangle is fitted to: its hull (the paper), or those of the slab.

    Args:
      obstacles: O points.
      clusters: of the points.
      config: of the detector: which points, and how many.

    Returns:
      Lists of points.
    """
    of_point = len(config.clustering.maps), obstacles.height.shape[0]
    chex.assert_shape([clusters.of_point, clusters.fitted], of_point)
    if config.box.fit_to == "hull":
        return _hull_points(obstacles, clusters, config.hull)
    return _slab_points(obstacles, clusters, config)


def _hull_points(obstacles: Obstacles, clusters: Clusters, config: HullConfig) -> Outlines:
    """The hull of each cluster."""
    num_clusters = clusters.num_points.shape[0]
    listed, capacity = clusters.of_point < num_clusters, clusters.of_point.size
    cluster, row, num = _list_rows(obstacles, clusters, listed, capacity)
    bounds = clusters.low[:, :2], clusters.high[:, :2]
    index = extreme_points(cluster, row, num, obstacles.xy, *bounds, num_slices=config.num_slices)
    x, y, count = trace_hulls(obstacles.xy, index, clusters.num, config)
    capacity = x.shape[0]
    start, total = jnp.arange(num_clusters, dtype=jnp.int32) * capacity, jnp.minimum(count, capacity)
    points = PointLists(x.T.reshape(-1), y.T.reshape(-1), start, total, capacity)
    return Outlines(points, jnp.max(count))


def _slab_points(obstacles: Obstacles, clusters: Clusters, config: DetectorConfig) -> Outlines:
    """The points of each cluster between the slab's heights, or all where those are few."""
    capacity = clusters.of_point.shape[0] * slab_capacity(config, obstacles.num_rows)
    lists = list_points(
        *_list_rows(obstacles, clusters, clusters.fitted, capacity),
        obstacles.xy,
        num_clusters=clusters.num_points.shape[0],
        max_points=config.box.max_points,
    )
    return Outlines(lists, jnp.int32(0))


def _list_rows(
    obstacles: Obstacles, clusters: Clusters, listed: jax.Array, capacity: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The points (maps, O) of all maps that are to be listed, in one list without gaps.

    Returns:
      cluster: (capacity,) int32.
      row: (capacity,) int32 of the obstacle.
      num: () int32; how many rows count, from the first on.
    """
    num_maps, num_obstacles = clusters.of_point.shape
    entry, num = compact(listed, capacity, num=obstacles.count)
    # The remainder by the number of obstacles, without the division.
    maps_before = [(entry >= num_obstacles * i).astype(jnp.int32) for i in range(1, num_maps)]
    row = entry - num_obstacles * sum(maps_before)
    return jnp.take(clusters.of_point.reshape(-1), entry, mode="clip"), row, num


def trace_hulls(
    xy: jax.Array, index: jax.Array, num_clusters: jax.Array, config: HullConfig
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Hulls of the clusters whose points are listed.

    Args:
      xy: (N, 2) float32, m.
      index: (M, C) int32 rows of the points that can reach the hull; N for none, see `extreme_points`.
      num_clusters: () int32, how many count.
      config: the capacity H.

    Returns:
      As `convex_hulls`.
    """

    def trace(index: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        valid = index < xy.shape[0]
        x, y = lookup_each((xy[:, 0], xy[:, 1]), jnp.minimum(index, xy.shape[0] - 1))
        return convex_hulls(x, y, valid, max_vertices=config.max_vertices)

    return map_rows(trace, index, num_rows=num_clusters, chunk=chunks.HULLS, axis=-1)


def trace_owned(owners: Owners, xy: jax.Array, kept: Kept, config: HullConfig) -> tuple[Hulls, jax.Array]:
    """Hulls of the points that each detection has.

    Args:
      owners: the points of K detections.
      xy: (O, 2) float32, m, of the obstacles.
      kept: the detections.
      config: capacity and slices.

    Returns:
      hulls: of K detections.
      area: (K,) float32, m^2.
    """
    chex.assert_shape([xy, owners.row, owners.owner], [(None, 2), xy.shape[:1], xy.shape[:1]])
    rows = owners.owner, owners.row, owners.num, xy
    bounds = find_bounds(*rows, num_clusters=kept.valid.shape[0])
    index = extreme_points(*rows, *bounds, num_slices=config.num_slices)
    x, y, num_vertices = trace_hulls(xy, index, kept.num, config)
    vertices = jnp.stack([x.T, y.T], axis=2)
    return Hulls(vertices, num_vertices), polygon_area(vertices)


def find_bounds(
    slot: jax.Array, row: jax.Array, num_rows: jax.Array, xy: jax.Array, *, num_clusters: int
) -> tuple[jax.Array, jax.Array]:
    """Least and greatest x and y of each cluster.

    Args:
      slot: (L,) int32 cluster of each point of a list, `num_clusters` for none.
      row: (L,) int32 rows of those points.
      num_rows: () int32; how many of the list count, from the first on.
      xy: (N, 2) float32, m.
      num_clusters: static, K.

    Returns:
      low: (K, 2) float32, m; infinite where a cluster has no point.
      high: (K, 2) float32, m; likewise, minus infinity.
    """

    def reach(_: jax.Array, row: jax.Array) -> jax.Array:
        # Low bounds are high ones of the points turned by half a turn.
        point = take(xy, row)
        return jnp.concatenate([point, -point], axis=1)

    bounds = fold_segments(
        "max", reach, slot, row, num_rows=num_rows, num_segments=num_clusters, absent=xy.shape[0]
    )
    return -bounds[:, 2:], bounds[:, :2]


def extreme_points(
    slot: jax.Array,
    row: jax.Array,
    num_rows: jax.Array,
    xy: jax.Array,
    low: jax.Array,
    high: jax.Array,
    *,
    num_slices: int,
) -> jax.Array:
    """The points of each cluster that can reach its hull: the extremes of thin slices.

    The cluster's bounding box is cut into slices along x, and along y; each slice keeps its two extreme
    points across. A dropped point lies between two kept ones of its slice, so the hull of the kept
    points is nowhere farther than one slice's width from the true hull, plus a rounding of at most
    extent / 2^11 for sweeps of up to a million points.

    Args:
      slot: (L,) int32 cluster of each point of a list, K for none.
      row: (L,) int32 rows of those points.
      num_rows: () int32; how many of the list count, from the first on.
      xy: (N, 2) float32, m.
      low: (K, 2) float32, m, least x and y of each cluster.
      high: (K, 2) float32, m, greatest x and y.
      num_slices: static, S.

    Returns:
      (4 S, K) int32: rows of points, some of them twice; N where a slice is empty.

    Reference: tested against cv2.convexHull of all points.
    """
    num_clusters, num_listed = low.shape[0], row.shape[0]
    frame = jnp.concatenate([low, 1 / jnp.maximum(high - low, MIN_EXTENT_M)], axis=1)

    def keep_extremes(
        best: list[jax.Array], index: jax.Array, rows: tuple[jax.Array, jax.Array]
    ) -> list[jax.Array]:
        slot, row = rows
        # Where each point lies between the least and the greatest of its cluster, in [0, 1].
        point, (low_x, low_y, per_x, per_y) = take(xy, row), take(frame, slot).T
        x, y = jnp.clip((point[:, 0] - low_x) * per_x, 0, 1), jnp.clip((point[:, 1] - low_y) * per_y, 0, 1)
        directions = ((x, y), (x, 1 - y), (y, x), (y, 1 - x))
        new = []
        for before, (along, across) in zip(best, directions, strict=True):
            piece = jnp.minimum((along * num_slices).astype(jnp.int32), num_slices - 1)
            key = argmax_key(across, index, num_listed)
            # Beyond the table where the point has no cluster.
            cell = jnp.where(slot < num_clusters, piece * num_clusters + slot, num_slices * num_clusters)
            new.append(scatter("max", before, cell, key))
        return new

    none = [jnp.zeros(num_slices * num_clusters, jnp.uint32)] * 4
    absent = num_clusters, xy.shape[0]
    best = fold_rows(
        keep_extremes, none, (slot, row), num_rows=num_rows, chunk=chunks.HULL_POINTS, absent=absent
    )
    best = jnp.concatenate(best).reshape(-1, num_clusters)
    index = argmax_row(best, num_listed)
    return jnp.where(index >= 0, take(row, jnp.maximum(index, 0)), xy.shape[0])


def convex_hulls(
    x: jax.Array, y: jax.Array, valid: jax.Array, *, max_vertices: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Convex hulls of clusters, counter-clockwise from their leftmost points (gift wrapping).

    From a vertex of the lower hull, the next is the point on its right at the least slope. The upper hull
    is the lower one of the points turned by half a turn, so that all chains grow side by side.

    Args:
      x: (M, C) float32, m, finite where valid.
      y: (M, C) float32, m, likewise.
      valid: (M, C) bool.
      max_vertices: static, H.

    Returns:
      x: (H, C) float32, m, of the vertices, padded by repeating the last; where there are more than H,
        every n-th is kept, evenly round the hull; zeros where no point is valid.
      y: (H, C) float32, m, likewise.
      num_vertices: (C,) int32, the true number, which may exceed H.

    Reference: paper, section 3.3 and equation 6; oracle cv2.convexHull.
    """
    size = valid.shape[1]
    x = jnp.where(valid, x, jnp.nan)
    chain_x, chain_y, count = lower_hulls(_both_ways(x), _both_ways(y))
    has_points = count[:size] > 0
    # A chain that ends where the other begins leaves that point to it.
    end = jnp.maximum(count - 1, 0), jnp.arange(2 * size, dtype=jnp.int32)
    closes_x, closes_y = (chain[end] == -jnp.roll(chain[0], size) for chain in (chain_x, chain_y))
    count = count - (closes_x & closes_y & (count > 0)).astype(jnp.int32)
    # Points all in one place close both chains.
    num_lower = jnp.maximum(count[:size], has_points.astype(jnp.int32))[None]
    num = num_lower + count[None, size:]
    j, column = jnp.arange(max_vertices, dtype=jnp.int32)[:, None], jnp.arange(size, dtype=jnp.int32)[None]
    pick = jnp.where(num > max_vertices, j * num // max_vertices, jnp.maximum(jnp.minimum(j, num - 1), 0))
    is_lower = pick < num_lower
    place = jnp.where(is_lower, pick, pick - num_lower), jnp.where(is_lower, column, column + size)
    x, y = lookup_each((chain_x, chain_y), *place)
    return jnp.where(is_lower, x, -x), jnp.where(is_lower, y, -y), num[0]


def _both_ways(values: jax.Array) -> jax.Array:
    """(M, 2 C): values (M, C) and their negatives."""
    sign = jnp.array([1, -1], values.dtype)[None, :, None]
    return (values[:, None] * sign).reshape(values.shape[0], -1)


def polygon_area(vertices: jax.Array) -> jax.Array:
    """Area of polygons, counter-clockwise positive (shoelace formula).

    Args:
      vertices: (..., H, 2) float32, m; repeated vertices add nothing.

    Returns:
      (...) float32, m^2.

    >>> float(polygon_area(jnp.array([[0.0, 0], [2, 0], [2, 1], [0, 1]])))
    2.0
    """
    # About the first vertex: far polygons keep their digits, and the edge that closes them adds nothing.
    x, y = jnp.moveaxis(vertices - vertices[..., :1, :], (-1, -2), (0, 1))
    return 0.5 * jnp.sum(x[:-1] * y[1:] - y[:-1] * x[1:], axis=0)
