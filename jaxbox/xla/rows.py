"""Rows at a fixed shape: compaction, prefix sums, counts, masked statistics.

A row that is absent is marked by the sentinel index N, one past the last: see `jaxbox.xla.indexing`.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.xla import chunks
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.barriers import materialize, store
from jaxbox.xla.bits import WORD_BITS, count_bits, pack_bits
from jaxbox.xla.indexing import scatter, take
from jaxbox.xla.loops import for_chunks, map_rows


def prefix_sum(values: jax.Array) -> jax.Array:
    """Inclusive prefix sum of a vector of integers. Law: `jnp.cumsum`.

    Args:
      values: (N,) bool or int32.

    Returns:
      (N,) int32.

    >>> prefix_sum(jnp.array([1, 0, 2])).tolist()
    [1, 1, 3]
    """
    return _sum_in_blocks(values) if on_accelerator() else _scan_sequential(jnp.add, values)


def running_sum(values: jax.Array, axis: int) -> jax.Array:
    """Inclusive prefix sums along an axis, for an accelerator. Law: `jnp.cumsum`.

    The sums of windows that end at each number, of which XLA makes a tree. For a GPU jax 0.12 writes
    `jnp.cumsum` otherwise, and what is exported has a loop over all numbers for it.

    Args:
      values: int32 or uint32.
      axis: static.

    Returns:
      As the values.

    >>> running_sum(jnp.array([[1, 0], [2, 5]]), axis=1).tolist()
    [[1, 1], [2, 7]]
    """
    window, padding = [1] * values.ndim, [(0, 0)] * values.ndim
    window[axis], padding[axis] = values.shape[axis], (values.shape[axis] - 1, 0)
    none, strides = values.dtype.type(0), [1] * values.ndim
    return jax.lax.reduce_window(values, none, jax.lax.add, window, strides, padding)


def prefix_max(values: jax.Array) -> jax.Array:
    """The greatest up to each number of a vector of integers. Law: `jax.lax.cummax`.

    Args:
      values: (N,) int32, not negative.

    Returns:
      (N,) int32.

    >>> prefix_max(jnp.array([1, 0, 2])).tolist()
    [1, 1, 2]
    """
    return jax.lax.cummax(values) if on_accelerator() else _scan_sequential(jnp.maximum, values)


def _scan_sequential(combine: Callable[..., jax.Array], values: jax.Array) -> jax.Array:
    def step(i: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        total, totals = state
        total = combine(total, values[i].astype(jnp.int32))
        return total, totals.at[i].set(total, mode="promise_in_bounds")

    size = values.shape[0]
    return _sequential(size, step, (jnp.int32(0), jnp.zeros(size, jnp.int32)))[1]


def _sequential(
    size: int,
    step: Callable[[jax.Array, Any], Any],
    state: Any,
    *,
    rows: int = 1,
    num: jax.Array | None = None,
) -> Any:
    """Calls a step with each index, () uint32, and the state: XLA compiles so small a loop to native code.

    Of several rows one after the other, and no farther than the first `num` of each, or little more.
    """
    unroll = next(k for k in chunks.UNROLLED if size % k == 0)
    in_use = jnp.uint32(size if num is None else (jnp.minimum(num, size) + unroll - 1) // unroll * unroll)

    def steps(start: jax.Array, state: Any) -> Any:
        rows_before = sum((start >= row * in_use).astype(jnp.uint32) for row in range(1, rows))
        first = start + rows_before * (size - in_use)
        for k in range(unroll):
            state = step(first + k, state)
        return state

    return for_chunks(rows * in_use, unroll, steps, state)


def count_true(mask: jax.Array) -> jax.Array:
    """How many entries of a short mask are True; see `count_each` for long ones. Law: `jnp.sum`.

    Args:
      mask: (N,) bool, some thousand at most: a CPU takes them one by one, in one kernel instead of three.

    Returns:
      () int32.

    >>> int(count_true(jnp.array([True, False, True])))
    2
    """
    if on_accelerator():
        return jnp.sum(mask, dtype=jnp.int32)
    return _fold_sequential(jnp.add, 0, mask.astype(jnp.int32))


def maximum(values: jax.Array, initial: float) -> jax.Array:
    """The greatest of a short vector of numbers, see `count_true`. Law: ``jnp.max(values, initial=initial)``.

    Args:
      values: (N,) int32 or float32, no NaN.
      initial: static, no number is less.

    Returns:
      () of the type of the values.

    >>> int(maximum(jnp.array([1, 3, 2]), 0))
    3
    """
    if on_accelerator():
        return jnp.max(values, initial=initial)
    return _fold_sequential(jnp.maximum, initial, values)


def _fold_sequential(combine: Callable[..., jax.Array], initial: float, values: jax.Array) -> jax.Array:
    init = jnp.asarray(initial, values.dtype)
    return _sequential(values.shape[0], lambda i, state: combine(state, values[i]), init)


def _sum_in_blocks(values: jax.Array) -> jax.Array:
    size = values.shape[0]
    if values.dtype == bool and size > chunks.SUM_BLOCK:
        return _count_before(values)
    blocks = jnp.pad(values.astype(jnp.int32), (0, -size % chunks.SUM_BLOCK)).reshape(-1, chunks.SUM_BLOCK)
    inside = running_sum(blocks, axis=1)
    before = running_sum(inside[:, -1], axis=0) - inside[:, -1]
    return (inside + before[:, None]).reshape(-1)[:size]


def _count_before(mask: jax.Array) -> jax.Array:
    """(N,) prefix sum of truth values, as the bits of words: a sum over words, and bits counted in one."""
    size = mask.shape[0]
    bit = jnp.arange(WORD_BITS, dtype=jnp.uint32)
    words = pack_bits(mask)
    population = count_bits(words)
    before = _sum_in_blocks(population) - population
    up_to = (jnp.uint32(2) << bit) - 1
    inside = count_bits(words[:, None] & up_to[None])
    return (before[:, None] + inside).reshape(-1)[:size]


def compact(mask: jax.Array, capacity: int, *, num: jax.Array | None = None) -> tuple[jax.Array, jax.Array]:
    """Indices of the True entries, in order, at a fixed capacity. Law: `jnp.flatnonzero`.

    Args:
      mask: (N,) bool, or (M, N), whose rows are gone through one after the other.
      capacity: static; entries beyond it are dropped.
      num: () int32: no entry of a row is True beyond this many, which may be more than N.
        A CPU does not look at them.

    Returns:
      index: (capacity,) int32, ascending, into all M N entries; M N where there is no entry.
      count: () int32, the true number of entries, which may exceed the capacity.

    >>> compact(jnp.array([False, True, True]), 4)[0].tolist()
    [1, 2, 3, 3]
    """
    if on_accelerator():
        return _compact_parallel(mask.reshape(-1), capacity)
    every = jnp.int32(mask.shape[-1])
    return _compact_sequential(jnp.atleast_2d(mask), every if num is None else num, capacity)


def _compact_parallel(mask: jax.Array, capacity: int) -> tuple[jax.Array, jax.Array]:
    order = prefix_sum(mask)
    target = jnp.where(mask, order - 1, capacity)
    index = jnp.full(capacity, mask.size, jnp.int32)
    return scatter("set", index, target, jnp.arange(mask.size, dtype=jnp.int32)), order[-1]


def _compact_sequential(mask: jax.Array, num: jax.Array, capacity: int) -> tuple[jax.Array, jax.Array]:
    """Each index is written, and the next one over it unless it counts."""
    rows, size = mask.shape
    flags = mask.reshape(-1)

    def step(i: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        index, count = state
        # Beyond the capacity the place is moved back, to the room at the end.
        index = jax.lax.dynamic_update_slice(index, i.astype(jnp.int32)[None], (count,))
        return index, count + flags[i].astype(jnp.uint32)

    none = jnp.full(capacity + 1, mask.size, jnp.int32)
    index, count = _sequential(size, step, (none, jnp.uint32(0)), rows=rows, num=num)
    # Over what the last index wrote if it does not count.
    index = jax.lax.dynamic_update_slice(index, none[:1], (count,))
    return index[:capacity], count.astype(jnp.int32)


def rows_in_use(present: jax.Array) -> jax.Array:
    """How many rows there are up to the last one that is present. Law: ``max(flatnonzero(present)) + 1``.

    Args:
      present: (N,) bool.

    Returns:
      () int32.

    >>> int(rows_in_use(jnp.array([False, True, False])))
    2
    """
    number = jnp.arange(1, present.shape[0] + 1, dtype=jnp.int32)
    return maximum(jnp.where(present, number, 0), 0)


def keep_rows(rows: jax.Array, keep: jax.Array) -> jax.Array:
    """Rows to keep, and zeros in place of the others. Law: ``jnp.where(keep[:, None], rows, 0)``.

    Args:
      rows: (N, C).
      keep: (N,) bool.

    Returns:
      (N, C), stored once for all that read it.
    """
    if on_accelerator():
        # Column by column: most readers ask for one or two.
        columns = [jnp.where(keep, rows[:, k], 0) for k in range(rows.shape[1])]
        return jnp.stack(store(columns), axis=1)
    return materialize(jnp.where(keep[:, None], rows, 0))


def stored_columns(rows: jax.Array) -> tuple[jax.Array, ...]:
    """The columns of a table, each stored by itself. Law: ``tuple(rows.T)``.

    What is computed from one number of each row, at some length, does not vectorise on a CPU.

    Args:
      rows: (N, C).

    Returns:
      C of (N,).
    """
    return materialize(tuple(rows[:, k] for k in range(rows.shape[1])))


def split_index(index: jax.Array, size: int) -> tuple[jax.Array, jax.Array]:
    """Row and column of flat indices into a table of rows of a size. Law: `divmod`.

    Args:
      index: int32, not negative: `//` and `%` of numbers that may be take several times as much code.
      size: static.

    Returns:
      The quotients and the remainders.

    >>> [part.tolist() for part in split_index(jnp.array([1, 7]), 3)]
    [[0, 2], [1, 1]]
    """
    return jax.lax.div(index, jnp.int32(size)), jax.lax.rem(index, jnp.int32(size))


def count_each(*masks: jax.Array) -> jax.Array:
    """How many entries of each mask are True. Law: `jnp.sum` of each.

    A sum of words counts five masks, each in bits of its own. The sums of those are of floats, since XLA
    makes a tree of kernels of each long sum of integers.

    Args:
      *masks: (N,) bool each, of any sizes up to 2^24.

    Returns:
      (number of masks,) int32.

    >>> count_each(jnp.array([True, False]), jnp.array([True, True, True])).tolist()
    [1, 3]
    """
    bits = WORD_BITS.bit_length()
    per_word = WORD_BITS // bits
    size = max(mask.shape[0] for mask in masks)
    size += -size % WORD_BITS
    of_mask = [
        jnp.where(jnp.pad(mask, (0, size - mask.shape[0])), jnp.int32(1 << k % per_word * bits), 0)
        for k, mask in enumerate(masks)
    ]
    words = [functools.reduce(jnp.add, of_mask[k : k + per_word]) for k in range(0, len(masks), per_word)]
    # A sum does not vectorise what it has to work out first.
    words = materialize(words)
    sums = jnp.stack([jnp.sum(word.reshape(-1, WORD_BITS), axis=1, dtype=jnp.int32) for word in words])
    place = jnp.arange(per_word, dtype=jnp.int32)[None, :, None] * bits
    counts = (sums[:, None] >> place) & (2**bits - 1)
    return jnp.sum(counts.astype(jnp.float32), axis=-1).astype(jnp.int32).reshape(-1)[: len(masks)]


def masked_mean(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean of the masked values along the last axis; 0 where there are none. Law: ``mean(values[mask])``.

    Args:
      values: (..., N) float32.
      mask: (..., N) bool.

    Returns:
      (...) float32.
    """
    total = jnp.sum(jnp.where(mask, values, 0), axis=-1)
    # Counted in float32, exact to 2^24: a sum of integers is several times slower (XLA, CPU).
    return total / jnp.maximum(jnp.sum(mask, axis=-1, dtype=jnp.float32), 1)


def masked_std(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Population standard deviation along the last axis. Law: ``std(values[mask])``.

    The mean is taken off first: E[v^2] - E[v]^2 would cancel in float32.

    Args:
      values: (..., N) float32.
      mask: (..., N) bool.

    Returns:
      (...) float32; 0 where there are none.
    """
    centred = values - masked_mean(values, mask)[..., None]
    return jnp.sqrt(masked_mean(centred**2, mask))


def first_argmax(values: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The greatest of each column and the first row that has it. Law: `jnp.argmax` and `jnp.max`.

    An argmax does not vectorise on a CPU; a minimum of integers takes several kernels, one of floats one.

    Args:
      values: (R, C) float32, no NaN, at most 2^24 rows.

    Returns:
      row: (C,) int32.
      greatest: (C,) float32.
    """
    greatest = jnp.max(values, axis=0)
    row = jnp.arange(values.shape[0], dtype=jnp.float32)[:, None]
    first = jnp.min(jnp.where(values >= greatest[None], row, values.shape[0] - 1), axis=0)
    return first.astype(jnp.int32), greatest


def map_selected(
    function: Callable[[Any], Any],
    rows: Any,
    selected: Callable[[], jax.Array],
    *,
    num_rows: jax.Array,
    absent: Any,
    chunk: int,
) -> tuple[jax.Array, Any, jax.Array]:
    """Applies a batched function to selected rows. Law: on them, ``function(rows)`` at the index.

    A CPU lists them first; to list them takes an accelerator longer than to take all.

    Args:
      function: maps a pytree of (chunk, ...) arrays to an array; what it makes of rows that are not selected
        must be such that nothing comes of it.
      rows: pytree of (P, ...) arrays.
      selected: gives (P,) bool, none of them beyond `num_rows`.
      num_rows: () int32, how many rows count.
      absent: pytree of numbers, what rows beyond the last hold.
      chunk: static, rows at a time on a CPU.

    Returns:
      index: (P,) int32 of the selected rows, P beyond.
      values: (P, ...) of those rows.
      num: () int32; how many of both count, from the first on.
    """
    size = jax.tree.leaves(rows)[0].shape[0]
    if on_accelerator():
        return jnp.arange(size, dtype=jnp.int32), function(rows), num_rows
    index, num = compact(materialize(selected()), size, num=num_rows)

    def at(index: jax.Array) -> Any:
        # Look-ups do not vectorise within the write of a chunk.
        return materialize(function(jax.tree.map(lambda a, fill: take(a, index, fill), rows, absent)))

    return index, map_rows(at, index, num_rows=num, chunk=chunk), num


def sum_after(values: jax.Array) -> jax.Array:
    """Sums of the columns after each. Law: ``sum(values) - cumsum(values)``, exact for whole numbers.

    A product is one kernel on a CPU, a cumulative sum several.

    Args:
      values: (P, C) float32.

    Returns:
      (P, C) float32.
    """
    after = np.tri(values.shape[1], k=-1, dtype=np.float32)
    # An accelerator would otherwise round whole numbers first.
    return jnp.dot(values, after, precision=jax.lax.Precision.HIGHEST)
