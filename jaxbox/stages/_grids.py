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
    return functools.reduce(jnp.add, _shifted(grid, axis, reach))


def moment_of_neighbours(grid: jax.Array, axis: int, reach: int, power: int) -> jax.Array:
    """Sums over the same cells as `sum_of_neighbours`, each times its offset to a power.

    Args:
      grid: any shape, float32.
      axis: along which.
      reach: cells on either side.
      power: of the offset in cells.

    Returns:
      As the grid.
    """
    offsets = range(-reach, reach + 1)
    weighted = [k**power * cells for k, cells in zip(offsets, _shifted(grid, axis, reach), strict=True)]
    return functools.reduce(jnp.add, weighted)


def _shifted(grid: jax.Array, axis: int, reach: int) -> list[jax.Array]:
    n = grid.shape[axis]
    padded = jnp.pad(grid, [(reach, reach) if a == axis else (0, 0) for a in range(grid.ndim)])
    return [jax.lax.slice_in_dim(padded, k, k + n, axis=axis) for k in range(2 * reach + 1)]
