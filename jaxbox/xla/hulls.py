"""Lower convex hulls of many point sets side by side."""

import jax
import jax.numpy as jnp

from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.barriers import materialize


def lower_hulls(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Lower hulls of point sets, from left to right. Law: as Andrew's monotone chain, set by set.

    A CPU wraps all sets side by side, vertex after vertex; an accelerator compares all pairs of points.

    Args:
      x: (M, C) float32, m; NaN where a point is absent. Of points above one another only the lowest counts.
      y: (M, C) float32, m.

    Returns:
      x: (M + 1, C) float32, m, of the vertices. Rows beyond the last vertex repeat it, or are minus infinity;
        the first row of an empty set is zero.
      y: (M + 1, C) float32, m, likewise.
      num_vertices: (C,) int32.
    """
    if on_accelerator():
        return _lower_hulls_parallel(x, y)
    far = jnp.inf
    x, y = materialize((x, y))  # Each iteration of the loop reads them.

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
    has_points = left < far
    # One row more, for the step that finds that no chain grows.
    chain = jnp.full((x.shape[0] + 1, x.shape[1]), -far, jnp.float32)
    chains = (chain.at[0].set(jnp.where(has_points, of_left, 0)) for of_left in (left, lowest))
    *_, chain_x, chain_y = jax.lax.while_loop(
        lambda state: state[1], step, (jnp.int32(0), jnp.any(has_points), *chains)
    )
    num_more = jnp.sum(chain_x[1:] > chain_x[:-1], axis=0, dtype=jnp.int32)
    return chain_x, chain_y, has_points.astype(jnp.int32) + num_more


def _lower_hulls_parallel(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """As `lower_hulls`, by all pairs of points, which is one kernel on an accelerator.

    A point is a vertex where the largest slope to it from the left is less than the smallest slope on to the
    right. From a point below the slope is infinite; of points in one place the first counts.
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
