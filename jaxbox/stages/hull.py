"""Convex hulls of many clusters at a fixed shape (paper, section 3.3)."""

import jax
import jax.numpy as jnp

from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.loops import fold_rows, store
from jaxbox.xla.masked import WORD_BITS, lookup, take

MIN_EXTENT_M = 1e-6
"""Clusters narrower than this are cut as if they were so wide: all their points are in one slice."""

CHUNK_POINTS = 4096
"""Points put into slices at a time on a CPU: both cores share so large a chunk."""


def find_bounds(
    slot: jax.Array, row: jax.Array, num_rows: jax.Array, xy: jax.Array, *, num_clusters: int
) -> tuple[jax.Array, jax.Array]:
    """Least and greatest x and y of each cluster.

    Args:
      slot: (L,) int32 cluster of each point of a list, `num_clusters` for none.
      row: (L,) int32 rows of those points.
      num_rows: () int32; only the first so many of the list count.
      xy: (N, 2) float32, m.
      num_clusters: static, K.

    Returns:
      low: (K, 2) float32, m; infinite where a cluster has no point.
      high: (K, 2) float32, m; likewise, minus infinity.
    """

    def widen(bounds: jax.Array, _: jax.Array, rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        slot, row = rows
        # Low bounds are high ones of the points turned by half a turn.
        point = take(xy, row)
        return bounds.at[slot].max(jnp.concatenate([point, -point], axis=1), mode="drop")

    none = jnp.full((num_clusters, 4), -jnp.inf, jnp.float32)
    absent = num_clusters, xy.shape[0]
    bounds = fold_rows(widen, none, (slot, row), num_rows=num_rows, absent=absent)
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
    points across. A point left out lies between two kept ones of its slice, so the hull of the kept
    points is nowhere farther than one slice's width from the true hull, plus a rounding of at most
    extent / 2^11 for sweeps of up to a million points.

    Args:
      slot: (L,) int32 cluster of each point of a list, K for none.
      row: (L,) int32 rows of those points.
      num_rows: () int32; only the first so many of the list count.
      xy: (N, 2) float32, m.
      low: (K, 2) float32, m, least x and y of each cluster.
      high: (K, 2) float32, m, greatest x and y.
      num_slices: static, S.

    Returns:
      (4 S, K) int32: rows of points, some of them twice; N where a slice is empty.

    Reference: tested against cv2.convexHull of all points.
    """
    num_clusters = low.shape[0]
    index_bits = row.shape[0].bit_length()
    # More bits than float32 holds would round the largest value up, out of the word.
    value_bits = min(WORD_BITS - index_bits, 24)
    frame = jnp.concatenate([low, 1 / jnp.maximum(high - low, MIN_EXTENT_M)], axis=1)

    def keep_extremes(
        best: list[jax.Array], index: jax.Array, rows: tuple[jax.Array, jax.Array]
    ) -> list[jax.Array]:
        slot, row = rows
        # Where each point lies between the least and the greatest of its cluster, in [0, 1].
        place = (take(xy, row) - take(frame[:, :2], slot)) * take(frame[:, 2:], slot)
        x, y = jnp.clip(place[:, 0], 0, 1), jnp.clip(place[:, 1], 0, 1)
        directions = ((x, y), (x, 1 - y), (y, x), (y, 1 - x))
        new = []
        for before, (along, across) in zip(best, directions, strict=True):
            piece = jnp.minimum((along * num_slices).astype(jnp.int32), num_slices - 1)
            # One scatter finds the largest value and where it is: the value's leading bits stand above
            # the point's index in one word. (Conversions to int32 vectorise, those to uint32 do not.)
            quantised = (across * (2**value_bits - 1)).astype(jnp.int32).astype(jnp.uint32)
            key = (quantised << index_bits) | (index.astype(jnp.uint32) + 1)
            # Beyond the table where the point has no cluster.
            cell = jnp.where(slot < num_clusters, piece * num_clusters + slot, num_slices * num_clusters)
            new.append(before.at[cell].max(key, mode="drop"))
        return new

    none = [jnp.zeros(num_slices * num_clusters, jnp.uint32)] * 4
    absent = num_clusters, xy.shape[0]
    best = fold_rows(keep_extremes, none, (slot, row), num_rows=num_rows, chunk=CHUNK_POINTS, absent=absent)
    best = jnp.concatenate(best).reshape(-1, num_clusters)
    index = (best & (2**index_bits - 1)).astype(jnp.int32)
    return jnp.where(index > 0, take(row, jnp.maximum(index - 1, 0)), xy.shape[0])


def convex_hulls(
    x: jax.Array, y: jax.Array, valid: jax.Array, *, max_vertices: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Convex hulls of clusters, counter-clockwise from their leftmost points (gift wrapping).

    From a vertex of the lower hull, the next is the point on its right at the least slope. The upper hull
    is the lower one of the points turned by half a turn, so that all chains grow side by side. Clusters lie
    along the last axis: reductions along the other vectorise (XLA, CPU).

    Args:
      x: (M, C) float32, m, finite where valid.
      y: (M, C) float32, m, likewise.
      valid: (M, C) bool.
      max_vertices: static, H.

    Returns:
      x: (H, C) float32, m, of the vertices, padded by repeating the last; where there are more than H,
        every so many are kept, evenly round the hull; zeros where no point is valid.
      y: (H, C) float32, m, likewise.
      num_vertices: (C,) int32, the true number, which may exceed H.

    Reference: paper, section 3.3 and equation 6; oracle cv2.convexHull.
    """
    size = valid.shape[1]
    x = jnp.where(valid, x, jnp.nan)
    chain_x, chain_y, count = _lower_hulls(*store([_both_ways(x), _both_ways(y)]))
    present = count[:size] > 0
    # A chain that ends where the other begins leaves that point to it.
    end = jnp.maximum(count - 1, 0), jnp.arange(2 * size, dtype=jnp.int32)
    closes_x, closes_y = (chain[end] == -jnp.roll(chain[0], size) for chain in (chain_x, chain_y))
    count = count - (closes_x & closes_y & (count > 0)).astype(jnp.int32)
    # Points all in one place close both chains.
    num_lower = jnp.maximum(count[:size], present.astype(jnp.int32))[None]
    num = num_lower + count[None, size:]
    j, column = jnp.arange(max_vertices, dtype=jnp.int32)[:, None], jnp.arange(size, dtype=jnp.int32)[None]
    pick = jnp.where(num > max_vertices, j * num // max_vertices, jnp.maximum(jnp.minimum(j, num - 1), 0))
    is_lower = pick < num_lower
    place = jnp.where(is_lower, pick, pick - num_lower), jnp.where(is_lower, column, column + size)
    # Stored: a look-up vectorises neither with what finds its place, nor within the write of a chunk (XLA).
    place = store(place)
    x, y = store([lookup(chain, *place) for chain in (chain_x, chain_y)])
    return jnp.where(is_lower, x, -x), jnp.where(is_lower, y, -y), num[0]


def _both_ways(values: jax.Array) -> jax.Array:
    """(M, 2 C): values (M, C) and their negatives. A product, since a concatenation does not vectorise."""
    sign = jnp.array([1, -1], values.dtype)[None, :, None]
    return (values[:, None] * sign).reshape(values.shape[0], -1)


def _lower_hulls(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Lower hulls of point sets (M, C), from left to right, and how many vertices each has, (C,).

    Of points above one another only the lowest counts; those whose x is not a number are absent. Rows
    beyond the last vertex repeat it, or are minus infinity; the first row of an empty set is zero.
    """
    if on_accelerator():
        return _lower_hulls_at_once(x, y)
    far = jnp.inf

    def step(state: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        i, _, chain_x, chain_y = state
        at_x, at_y = chain_x[i], chain_y[i]
        slope = jnp.where(x > at_x[None], (y - at_y[None]) / (x - at_x[None]), far)
        least = jnp.min(slope, axis=0)
        # Of points on a line the farthest.
        is_least = slope == least[None]
        next_x = jnp.max(jnp.where(is_least, x, -far), axis=0)
        next_y = jnp.min(jnp.where(is_least & (x == next_x[None]), y, far), axis=0)
        grows = least < far
        chain_x = chain_x.at[i + 1].set(jnp.where(grows, next_x, at_x))
        chain_y = chain_y.at[i + 1].set(jnp.where(grows, next_y, at_y))
        return i + 1, jnp.any(grows), chain_x, chain_y

    left = jnp.min(jnp.where(x > -far, x, far), axis=0)
    lowest = jnp.min(jnp.where(x == left[None], y, far), axis=0)
    present = left < far
    # One row more, for the step that finds that no chain grows.
    chain = jnp.full((x.shape[0] + 1, x.shape[1]), -far, jnp.float32)
    chains = (chain.at[0].set(jnp.where(present, of_left, 0)) for of_left in (left, lowest))
    *_, chain_x, chain_y = jax.lax.while_loop(
        lambda state: state[1], step, (jnp.int32(0), jnp.any(present), *chains)
    )
    num_more = jnp.sum(chain_x[1:] > chain_x[:-1], axis=0, dtype=jnp.int32)
    return chain_x, chain_y, present.astype(jnp.int32) + num_more


def _lower_hulls_at_once(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """As `_lower_hulls`, by all pairs of points, which is one kernel on an accelerator.

    A point is a vertex where the steepest way to it from the left is less steep than the flattest way on to
    the right. From a point below the way is infinitely steep; of points in one place the first counts.
    """
    far, num_points = jnp.float32(jnp.inf), x.shape[0]
    index, row = (jnp.arange(size, dtype=jnp.int32)[:, None] for size in (num_points, num_points + 1))
    # The points (M, 1, C), against all others (1, M, C). Each reduction over those compares on its own, by
    # the places or by the differences: what two of them share would be stored for all pairs.
    at_x, at_y, at_index = x[:, None], y[:, None], index[:, None]
    to_x, to_y, to_index = x[None], y[None], index[None]
    is_again = jnp.any((to_x == at_x) & (to_y == at_y) & (to_index < at_index), axis=1)
    ahead, up = to_x - at_x, to_y - at_y
    slope = up / ahead  # Not a number only where it is not taken.
    steepest = jnp.where((ahead == 0) & (up < 0), far, -far)
    arriving = jnp.max(jnp.where(ahead < 0, slope, steepest), axis=1)
    leaving = jnp.min(jnp.where(ahead > 0, slope, far), axis=1)
    is_vertex = (x > -far) & ~is_again & (arriving < leaving)
    place = jnp.sum(is_vertex[None] & (to_x < at_x), axis=1, dtype=jnp.int32)
    # Vertex k of each chain, by its place among the vertices.
    is_in_row = is_vertex[None] & (place[None] == row[:, None])
    chain_x, chain_y = (jnp.max(jnp.where(is_in_row, values, -far), axis=1) for values in (to_x, to_y))
    count = jnp.sum(is_vertex, axis=0, dtype=jnp.int32)
    is_empty = (row == 0) & (count == 0)[None]
    return jnp.where(is_empty, 0, chain_x), jnp.where(is_empty, 0, chain_y), count


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
    # Vertices along the leading axis: sums along it vectorise (XLA, CPU).
    x, y = jnp.moveaxis(vertices - vertices[..., :1, :], (-1, -2), (0, 1))
    return 0.5 * jnp.sum(x[:-1] * y[1:] - y[:-1] * x[1:], axis=0)
