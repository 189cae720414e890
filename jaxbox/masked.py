"""The fixed-shape toolbox: compaction, masked statistics, sets of cells, work in chunks.

Every function keeps static shapes. A row that is absent is marked by the sentinel index N, one past
the last; `take` reads zeros there and scatters with ``mode="drop"`` ignore it.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

BLOCK = 512
"""Columns of the two-level prefix sum: XLA's CPU cumulative sum slows down with its length."""

WORD_BITS = 32
"""Bits of a word of a `CellSet`."""


def prefix_sum(values: jax.Array) -> jax.Array:
    """Inclusive prefix sum of a vector of integers, in two levels.

    Args:
      values: (N,) bool or int32.

    Returns:
      (N,) int32.

    >>> prefix_sum(jnp.array([1, 0, 2])).tolist()
    [1, 1, 3]
    """
    size = values.shape[0]
    blocks = jnp.pad(values.astype(jnp.int32), (0, -size % BLOCK)).reshape(-1, BLOCK)
    inside = jnp.cumsum(blocks, axis=1)
    before = jnp.cumsum(inside[:, -1]) - inside[:, -1]
    return (inside + before[:, None]).reshape(-1)[:size]


def compact(mask: jax.Array, capacity: int) -> tuple[jax.Array, jax.Array]:
    """Indices of the True entries, in order, at a fixed capacity.

    Args:
      mask: (N,) bool.
      capacity: static; entries beyond it are left out.

    Returns:
      index: (capacity,) int32, ascending; N where there is no entry.
      count: () int32, the true number of entries, which may exceed the capacity.

    >>> compact(jnp.array([False, True, True]), 4)[0].tolist()
    [1, 2, 3, 3]
    """
    size = mask.shape[0]
    order = prefix_sum(mask)
    target = jnp.where(mask, order - 1, capacity)
    index = jnp.full(capacity, size, jnp.int32)
    index = index.at[target].set(jnp.arange(size, dtype=jnp.int32), mode="drop")
    return index, order[-1]


def take(rows: jax.Array, index: jax.Array, fill: Any = 0) -> jax.Array:
    """Rows at the indices, and `fill` at the sentinel or any other index beyond.

    Args:
      rows: (N, ...).
      index: (...) int32, not negative.
      fill: what an absent row holds.

    Returns:
      (..., ...) of the type of `rows`.
    """
    return rows.at[index].get(mode="fill", fill_value=fill)


def lookup(table: jax.Array, *index: jax.Array) -> jax.Array:
    """Entries of a table at indices that are known to lie inside.

    One flat index: several would first be joined to rows, which costs more than the look-up (XLA, CPU).

    Args:
      table: (A, B, ...), as many axes as there are indices.
      *index: int32 arrays of one shape, each within its axis.

    Returns:
      The shape of the indices.
    """
    flat = index[0]
    for size, along in zip(table.shape[1:], index[1:], strict=True):
        flat = flat * size + along
    return jnp.take(table.reshape(-1), flat, mode="clip")


def store(values: Any, proof: jax.Array) -> Any:
    """Has values computed once and stored, where the compiler would compute them in every reader.

    XLA fuses a producer into each of its consumers; a conditional is a wall that fusion does not cross.

    Args:
      values: pytree of arrays.
      proof: () bool, True whenever the values are wanted; the compiler must not know that it is.

    Returns:
      The values, or zeros where `proof` is False.
    """
    return jax.lax.cond(proof, lambda v: v, lambda v: jax.tree.map(jnp.zeros_like, v), values)


def masked_mean(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean of the masked values along the last axis; 0 where there are none.

    Args:
      values: (..., N) float32.
      mask: (..., N) bool.

    Returns:
      (...) float32.
    """
    total = jnp.sum(jnp.where(mask, values, 0), axis=-1)
    return total / jnp.maximum(jnp.sum(mask, axis=-1), 1)


def masked_std(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Population standard deviation of the masked values along the last axis.

    The mean is taken off first: E[v^2] - E[v]^2 would cancel in float32.

    Args:
      values: (..., N) float32.
      mask: (..., N) bool.

    Returns:
      (...) float32; 0 where there are none.
    """
    centred = values - masked_mean(values, mask)[..., None]
    return jnp.sqrt(masked_mean(centred**2, mask))


def map_rows(function: Callable[[Any], Any], rows: Any, *, num_rows: jax.Array, chunk: int) -> Any:
    """Applies a batched function to the first `num_rows` rows, a chunk at a time.

    Work is proportional to the rows that are there, not to the capacity, and what a chunk needs
    stays in the cache.

    Args:
      function: maps a pytree of (chunk, ...) arrays to another one.
      rows: pytree of (P, ...) arrays.
      num_rows: () int32, how many rows count.
      chunk: static, rows at a time.

    Returns:
      Pytree of (P, ...) arrays; rows of chunks beyond `num_rows` are zero.
    """
    capacity = jax.tree.leaves(rows)[0].shape[0]
    padded = jax.tree.map(lambda a: jnp.pad(a, [(0, -capacity % chunk)] + [(0, 0)] * (a.ndim - 1)), rows)

    def part(i: jax.Array) -> Any:
        return jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, i * chunk, chunk), padded)

    def step(i: jax.Array, out: Any) -> Any:
        new = function(part(i))
        return jax.tree.map(lambda o, n: jax.lax.dynamic_update_slice_in_dim(o, n, i * chunk, 0), out, new)

    shapes = jax.eval_shape(function, jax.eval_shape(part, 0))
    size = capacity + -capacity % chunk
    out = jax.tree.map(lambda s: jnp.zeros((size, *s.shape[1:]), s.dtype), shapes)
    num_chunks = (jnp.minimum(num_rows, capacity) + chunk - 1) // chunk
    out = jax.lax.fori_loop(0, num_chunks, step, out)
    return jax.tree.map(lambda a: a[:capacity], out)


def group_by(group: jax.Array, num_groups: int) -> tuple[jax.Array, jax.Array]:
    """Orders rows by group, keeping their order within one.

    Args:
      group: (N,) int32, in [0, num_groups], the latter for rows of no group, which come last.
      num_groups: static, K.

    Returns:
      order: (N,) int32 row indices.
      start: (K + 1,) int32: group k is order[start[k]:start[k + 1]].

    >>> order, start = group_by(jnp.array([1, 0, 2, 1]), 2)
    >>> order.tolist(), start.tolist()
    ([1, 0, 3, 2], [0, 1, 3])
    """
    size = group.shape[0]
    index_bits, group_bits = size.bit_length(), num_groups.bit_length()
    index = jnp.arange(size, dtype=jnp.uint32)
    if index_bits + group_bits <= WORD_BITS:
        # One packed word sorts several times faster than a key with its value.
        packed = jax.lax.sort((group.astype(jnp.uint32) << index_bits) | index, is_stable=False)
        order = packed & (2**index_bits - 1)
    else:
        order = jax.lax.sort((group, index), num_keys=1, is_stable=True)[1]
    count = jnp.zeros(num_groups, jnp.int32).at[group].add(1, mode="drop")
    end = prefix_sum(count)
    return order.astype(jnp.int32), jnp.concatenate([jnp.zeros(1, jnp.int32), end])


def fold_points(
    points: jax.Array, count: jax.Array, init: Any, update: Callable[[Any, jax.Array, jax.Array], Any]
) -> Any:
    """Folds the points of many clusters into a wide state, one point of each cluster at a time.

    A loop over points with a wide carry vectorises; a reduction over an inner axis does not (XLA, CPU).
    The loop ends with the largest cluster of the batch.

    Args:
      points: (C, M, 2) float32.
      count: (C,) int32, points of each cluster.
      init: pytree of (C, ...) arrays, the state before the first point.
      update: maps the state and x (C, 1), y (C, 1) to the next state.

    Returns:
      The state after the last point of each cluster.
    """
    by_point = jnp.swapaxes(points, 0, 1)

    def step(m: jax.Array, state: Any) -> Any:
        xy = by_point[m]
        new = update(state, xy[:, :1], xy[:, 1:])
        return jax.tree.map(lambda n, o: jnp.where((m < count)[:, None], n, o), new, state)

    return jax.lax.fori_loop(0, jnp.minimum(jnp.max(count), points.shape[1]), step, init)
