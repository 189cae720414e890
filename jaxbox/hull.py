"""Convex hulls of many clusters at a fixed shape (paper, section 3.3)."""

import jax
import jax.numpy as jnp

from jaxbox.masked import take


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
    low, extent = _bounds(slot, xy, num_clusters)
    place = (xy - take(low, slot)) / jnp.maximum(take(extent, slot), 1e-6)
    keys = []
    for axis in (0, 1):
        piece = jnp.clip((place[:, axis] * num_slices).astype(jnp.int32), 0, num_slices - 1)
        across = place[:, 1 - axis]
        for value in (across, 1 - across):
            keys.append(_argmax_per_slice(slot, piece, value, num_clusters, num_slices))
    index = jnp.concatenate(keys, axis=1)
    return jnp.where(index < 0, size, index)


def _bounds(slot: jax.Array, xy: jax.Array, num_clusters: int) -> tuple[jax.Array, jax.Array]:
    """Lower corner and extent of each cluster, (K, 2) m each; 0 for an empty one."""
    rows = jnp.concatenate([xy, -xy], axis=1)
    upper = jnp.full((num_clusters, 4), -jnp.inf).at[slot].max(rows, mode="drop")
    upper = jnp.where(jnp.isfinite(upper), upper, 0)
    return -upper[:, 2:], upper[:, :2] + upper[:, 2:]


def _argmax_per_slice(
    slot: jax.Array, piece: jax.Array, value: jax.Array, num_clusters: int, num_slices: int
) -> jax.Array:
    """(K, S) int32: the point with the largest value, in [0, 1], of each slice; -1 where it is empty.

    One scatter finds the largest value and where it is: the value's leading bits stand above the
    point's index in one word.
    """
    size = slot.shape[0]
    index_bits = size.bit_length()
    value_bits = 32 - index_bits
    quantised = (jnp.clip(value, 0, 1) * (2**value_bits - 1)).astype(jnp.uint32)
    key = (quantised << index_bits) | (jnp.arange(size, dtype=jnp.uint32) + 1)
    best = jnp.zeros((num_clusters, num_slices), jnp.uint32).at[slot, piece].max(key, mode="drop")
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
    x = xy[:, 0]
    num_lower = jnp.sum(lower)
    upper = upper & ~lower
    # Along the lower hull x rises, along the upper one it falls; no two vertices of one share x.
    rank_lower = jnp.sum(lower[:, None] & (x[:, None] < x[None, :]), axis=0)
    rank_upper = num_lower + jnp.sum(upper[:, None] & (x[:, None] > x[None, :]), axis=0)
    count = num_lower + jnp.sum(upper)
    size = xy.shape[0]
    rank = jnp.where(lower, rank_lower, jnp.where(upper, rank_upper, size))
    ordered = jnp.zeros_like(xy).at[rank].set(xy, mode="drop")
    j = jnp.arange(max_vertices)
    pick = jnp.where(count > max_vertices, j * count // max_vertices, jnp.minimum(j, count - 1))
    return ordered[jnp.clip(pick, 0, size - 1)], count


def _on_hull(xy: jax.Array, valid: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Which points are vertices of the lower and of the upper hull, (M,) bool each."""
    x, y = xy[:, 0], xy[:, 1]
    index = jnp.arange(xy.shape[0])
    dx = x[None, :] - x[:, None]
    slope = (y[None, :] - y[:, None]) / jnp.where(dx == 0, 1, dx)
    left, right = valid[:, None] & (dx > 0), valid[:, None] & (dx < 0)

    def largest(side: jax.Array, sign: int) -> jax.Array:
        return jnp.max(jnp.where(side, sign * slope, -jnp.inf), axis=0)

    # Points above one another: only the lowest and the highest count, and of equal ones the first.
    same = valid[:, None] & (dx == 0)
    first = (y[:, None] == y[None, :]) & (index[:, None] < index[None, :])
    is_lowest = ~jnp.any(same & ((y[:, None] < y[None, :]) | first), axis=0)
    is_highest = ~jnp.any(same & ((y[:, None] > y[None, :]) | first), axis=0)
    lower = valid & is_lowest & (largest(left, 1) < -largest(right, -1))
    upper = valid & is_highest & (-largest(left, -1) > largest(right, 1))
    return lower, upper


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
