"""What the ground and the evidence share: sums over neighbouring cells of a grid."""

import functools

import jax
import jax.numpy as jnp


def sum_of_neighbours(grid: jax.Array, axis: int, reach: int) -> jax.Array:
    """Each cell with the ones before and after it along an axis; beyond the border there are none.

    Args:
      grid: any shape.
      axis: along which.
      reach: cells on either side.

    Returns:
      As the grid.
    """
    n = grid.shape[axis]
    padded = jnp.pad(grid, [(reach, reach) if a == axis else (0, 0) for a in range(grid.ndim)])
    shifted = (jax.lax.slice_in_dim(padded, k, k + n, axis=axis) for k in range(2 * reach + 1))
    return functools.reduce(jnp.add, shifted)
