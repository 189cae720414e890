"""Pairs of rows and columns of a table of costs."""

import jax
import jax.numpy as jnp


def assign_greedily(cost: jax.Array, allowed: jax.Array) -> jax.Array:
    """Matches rows with columns greedily, each in one pair at most, least cost first.

    Law: as taking the pair of the least allowed cost and removing its row and column, until none is left.

    Each round takes all pairs that are the least of their row and of their column: where costs tie, of the
    first row and then of the first column. The least of all is one, so that every round takes a pair; two or
    three rounds are usual.

    Args:
      cost: (T, D) float32, finite.
      allowed: (T, D) bool, which pairs may be taken.

    Returns:
      (T,) int32: column of each row, D for none.
    """
    num_rows, num_columns = cost.shape
    rows = jnp.arange(num_rows, dtype=jnp.int32)
    nothing = jnp.full(num_rows, num_columns, jnp.int32)
    if num_columns == 0:
        return nothing

    def is_any_left(state: tuple[jax.Array, jax.Array]) -> jax.Array:
        return jnp.any(state[0] < jnp.inf)

    def take_pairs(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        cost, column_of = state
        column = jnp.argmin(cost, axis=1).astype(jnp.int32)
        row = jnp.argmin(cost, axis=0).astype(jnp.int32)
        is_pair = (row[column] == rows) & (jnp.min(cost, axis=1) < jnp.inf)
        taken = (
            jnp.zeros(num_columns, bool).at[jnp.where(is_pair, column, num_columns)].set(True, mode="drop")
        )
        cost = jnp.where(is_pair[:, None] | taken[None], jnp.inf, cost)
        return cost, jnp.where(is_pair, column, column_of)

    return jax.lax.while_loop(is_any_left, take_pairs, (jnp.where(allowed, cost, jnp.inf), nothing))[1]
