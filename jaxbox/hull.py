"""Convex hulls of many clusters at a fixed shape (paper, section 3.3)."""

import jax
import jax.numpy as jnp

from jaxbox.masked import take

MIN_EXTENT_M = 1e-6
"""Clusters narrower than this are cut as if they were so wide: all their points are in one slice."""


def extreme_points(slot: jax.Array, xy: jax.Array, *, num_clusters: int, num_slices: int) -> jax.Array:
    """The points of each cluster that can reach its hull: the extremes of thin slices.

    The cluster's bounding box is cut into slices along x, and along y; each slice keeps its two extreme
    points across. A point left out lies between two kept ones of its slice, so the hull of the kept
    points is nowhere farther than one slice's width from the true hull, plus a rounding of at most
    extent / 2^11 for sweeps of up to a million points.

    Args:
      slot: (N,) int32 cluster of each point, `num_clusters` for none.
      xy: (N, 2) float32, m.
      num_clusters: static, K.
      num_slices: static, S.

    Returns:
      (K, 4 S) int32: indices of the points, some of them twice; N where a slice is empty.

    Reference: tested against cv2.convexHull of all points.
    """
    size = xy.shape[0]
    place = [_place_in_bounds(slot, xy[:, axis], num_clusters) for axis in (0, 1)]
    best = []
    for along, across in (place, place[::-1]):
        piece = jnp.clip((along * num_slices).astype(jnp.int32), 0, num_slices - 1)
        cell = slot * num_slices + piece
        for value in (across, 1 - across):
            best.append(_argmax_per_cell(cell, value, num_clusters * num_slices))
    index = jnp.concatenate([b.reshape(num_clusters, num_slices) for b in best], axis=1)
    return jnp.where(index < 0, size, index)


def _place_in_bounds(slot: jax.Array, values: jax.Array, num_clusters: int) -> jax.Array:
    """(N,) in [0, 1]: where each value lies between the least and the greatest of its cluster."""
    low = jnp.full(num_clusters, jnp.inf).at[slot].min(values, mode="drop")
    high = jnp.full(num_clusters, -jnp.inf).at[slot].max(values, mode="drop")
    scale = 1 / jnp.maximum(high - low, MIN_EXTENT_M)
    return jnp.clip((values - take(low, slot)) * take(scale, slot), 0, 1)


def _argmax_per_cell(cell: jax.Array, value: jax.Array, num_cells: int) -> jax.Array:
    """(cells,) int32: the point with the largest value, in [0, 1], of each cell; -1 where it is empty.

    One scatter finds the largest value and where it is: the value's leading bits stand above the
    point's index in one word.
    """
    size = cell.shape[0]
    index_bits = size.bit_length()
    # More bits than float32 holds would round the largest value up, out of the word.
    value_bits = min(32 - index_bits, 24)
    quantised = (value * (2**value_bits - 1)).astype(jnp.uint32)
    key = (quantised << index_bits) | (jnp.arange(size, dtype=jnp.uint32) + 1)
    best = jnp.zeros(num_cells, jnp.uint32).at[cell].max(key, mode="drop")
    return (best & (2**index_bits - 1)).astype(jnp.int32) - 1


def convex_hull(xy: jax.Array, valid: jax.Array, *, max_vertices: int) -> tuple[jax.Array, jax.Array]:
    """Convex hull of one cluster, counter-clockwise from its leftmost point.

    A point is on the lower hull if every slope to a point on its left is below every slope to a point on
    its right, and likewise, turned round, on the upper one: no order and no loop is needed.

    Args:
      xy: (M, 2) float32, m.
      valid: (M,) bool.
      max_vertices: static, H.

    Returns:
      vertices: (H, 2) float32, m, padded by repeating the last; where there are more than H, every so
        many are kept, evenly round the hull; zeros where no point is valid.
      num_vertices: () int32, the true number, which may exceed H.

    Reference: paper, section 3.3 and equation 6; oracle cv2.convexHull.
    """
    lower, upper = _on_hull(xy, valid)
    x, y = xy[:, 0], xy[:, 1]
    # Along the lower hull x rises, along the upper one it falls.
    part = jnp.where(lower, 0, jnp.where(upper, 1, 2))
    _, _, x, y = jax.lax.sort((part, jnp.where(lower, x, -x), x, y), num_keys=2, is_stable=False)
    count = jnp.sum(lower | upper)
    j = jnp.arange(max_vertices)
    pick = jnp.where(count > max_vertices, j * count // max_vertices, jnp.minimum(j, count - 1))
    pick = jnp.clip(pick, 0, xy.shape[0] - 1)
    return jnp.where(count > 0, jnp.stack([x[pick], y[pick]], axis=1), 0), count


def _on_hull(xy: jax.Array, valid: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Which points are vertices of the lower hull and which, beside those, of the upper, (M,) bool each."""
    x, y = xy[:, 0], xy[:, 1]
    index = jnp.arange(xy.shape[0])

    def see(i: jax.Array, slopes: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        # The point i as seen from all others: a loop over points vectorises, a table of pairs does not.
        lowest_right, lowest_left, highest_left, highest_right = slopes
        dx, dy = x[i] - x, y[i] - y
        slope = dy / jnp.where(dx == 0, 1, dx)
        left, right, same = valid[i] & (dx < 0), valid[i] & (dx > 0), valid[i] & (dx == 0)
        # Of points above one another only the lowest and the highest count, and of equal ones the first.
        twin = (dy == 0) & (i < index)
        return (
            jnp.minimum(lowest_right, _least(right, slope, same & ((dy < 0) | twin))),
            jnp.minimum(lowest_left, _least(left, slope, same & ((dy > 0) | twin))),
            jnp.maximum(highest_left, jnp.where(left, slope, -jnp.inf)),
            jnp.maximum(highest_right, jnp.where(right, slope, -jnp.inf)),
        )

    far = jnp.full_like(x, jnp.inf)
    slopes = jax.lax.fori_loop(0, xy.shape[0], see, (far, far, -far, -far))
    lowest_right, lowest_left, highest_left, highest_right = slopes
    lower = valid & (highest_left < lowest_right)
    upper = valid & (highest_right < lowest_left)
    return lower, upper & ~lower


def _least(side: jax.Array, slope: jax.Array, barred: jax.Array) -> jax.Array:
    """(M,) slopes to a point on a side, infinite if it is not; minus infinity where it bars the other."""
    return jnp.where(barred, -jnp.inf, jnp.where(side, slope, jnp.inf))


def polygon_area(vertices: jax.Array) -> jax.Array:
    """Area of polygons, counter-clockwise positive (shoelace formula).

    Args:
      vertices: (..., H, 2) float32, m; repeated vertices add nothing.

    Returns:
      (...) float32, m^2.

    >>> float(polygon_area(jnp.array([[0.0, 0], [2, 0], [2, 1], [0, 1]])))
    2.0
    """
    # About the first vertex, so that far polygons keep their digits.
    p = vertices - vertices[..., :1, :]
    q = jnp.roll(p, -1, axis=-2)
    return 0.5 * jnp.sum(p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0], axis=-1)
