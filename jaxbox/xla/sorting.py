"""Rows by group and by score, at a fixed shape."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxbox.xla import chunks
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.barriers import materialize, reduce_pairs, single_kernel
from jaxbox.xla.bits import WORD_BITS
from jaxbox.xla.indexing import lookup, scatter
from jaxbox.xla.loops import for_chunks
from jaxbox.xla.rows import compact, prefix_sum


def largest_first(size: jax.Array, max_size: int) -> tuple[jax.Array, jax.Array]:
    """Orders rows by descending size, keeping their order within one. Law: a stable sort of ``-size``.

    Args:
      size: (P,) int32, in [0, max_size].
      max_size: static.

    Returns:
      order: (P,) int32 row indices.
      place: (P,) int32: row i is order[place[i]].

    >>> order, place = largest_first(jnp.array([1, 3, 1]), 4)
    >>> order.tolist(), place.tolist()
    ([1, 0, 2], [1, 0, 2])
    """
    num = jnp.int32(size.shape[0])
    order, *_ = sort_by_group(lambda i: i, max_size - size, num, max_size + 1)
    return order, jnp.zeros_like(order).at[order].set(jnp.arange(order.shape[0], dtype=order.dtype))


def sort_by_group(
    read: Callable[[jax.Array], Any], group: jax.Array, num_rows: jax.Array, num_groups: int, *, room: int = 0
) -> tuple[Any, jax.Array, jax.Array]:
    """Sorts rows by group, keeping their order within one. Law: a stable sort of the rows that count.

    Args:
      read: gives the values of rows, a pytree of arrays, by their indices.
      group: (N,) int32, in [0, num_groups).
      num_rows: () int32; how many rows count, from the first on.
      num_groups: static, K.
      room: static, rows added at the end.

    Returns:
      values: pytree of (N + room,) arrays, sorted; anything finite beyond `num_rows`.
      begin: (K,) int32: group k is rows begin[k] to end[k].
      end: (K,) int32.

    >>> letters = jnp.array([5, 6, 7])
    >>> values, begin, end = sort_by_group(lambda i: letters[i], jnp.array([1, 0, 1]), jnp.int32(3), 2)
    >>> values.tolist(), begin.tolist(), end.tolist()
    ([6, 5, 7], [0, 1], [1, 3])
    """
    size = group.shape[0]
    num_rows = jnp.minimum(num_rows, size)
    group = materialize(jnp.where(jnp.arange(size, dtype=jnp.int32) < num_rows, group, num_groups))
    count = scatter("add", jnp.zeros(num_groups, jnp.int32), group, 1)
    end = prefix_sum(count)

    if on_accelerator():
        values = _place_sorted(read, group, num_groups, room)
    else:
        values = _place_sequential(read, group, num_rows, end - count, room)
    return values, end - count, end


def _place_sequential(
    read: Callable[[jax.Array], Any], group: jax.Array, num_rows: jax.Array, begin: jax.Array, room: int
) -> Any:
    """Counting sort: XLA compiles so small a loop to native code on the CPU."""

    def step(i: jax.Array, state: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        # The count goes up before it is read: the other way round the whole array would be copied.
        after, placed = state
        after = after.at[group[i]].add(1, mode="promise_in_bounds")
        place = after.at[group[i]].get(mode="promise_in_bounds") - 1
        return after, jax.tree.map(lambda p, v: p.at[place].set(v, mode="promise_in_bounds"), placed, read(i))

    shapes = jax.eval_shape(read, jax.ShapeDtypeStruct((), jnp.int32))
    empty = jax.tree.map(lambda s: jnp.zeros(group.shape[0] + room, s.dtype), shapes)
    return jax.lax.fori_loop(0, num_rows, step, (begin, empty))[1]


def _place_sorted(read: Callable[[jax.Array], Any], group: jax.Array, num_groups: int, room: int) -> Any:
    order = _stable_order(group, num_groups)
    return jax.tree.map(lambda v: jnp.pad(v, (0, room)), read(order))


def _stable_order(group: jax.Array, num_groups: int) -> jax.Array:
    """(N,) int32 rows by group, in [0, num_groups], keeping their order within one."""
    size = group.shape[0]
    index_bits, group_bits = size.bit_length(), num_groups.bit_length()
    index = jnp.arange(size, dtype=jnp.uint32)
    if index_bits + group_bits > WORD_BITS:
        return jax.lax.sort((group, index), num_keys=1, is_stable=True)[1].astype(jnp.int32)
    # One packed word sorts several times faster than a key with its value.
    packed = jax.lax.sort((group.astype(jnp.uint32) << index_bits) | index, is_stable=False)
    return (packed & (2**index_bits - 1)).astype(jnp.int32)


class GroupedRows(NamedTuple):
    """Rows of several groups in one list, group by group, without gaps."""

    row: jax.Array
    """(N,) int32: where each row is in the list, P where it is not."""
    member: jax.Array
    """(P,) int32: which row is there, N beyond the last."""
    found: jax.Array
    """(G,) int32: rows of each group, true number."""
    kept: jax.Array
    """(G,) int32: those in the list."""
    num: jax.Array
    """() int32: rows in the list."""


def compact_groups(keep: jax.Array, first: jax.Array, capacities: Sequence[int]) -> GroupedRows:
    """Lists the rows to keep, at a fixed capacity for each group. Law: `compact` of each group, joined.

    Args:
      keep: (N,) bool; none before the first group or after the last.
      first: (G + 1,) int32: first row of each group, at least 1, and one past the last.
      capacities: static, of the G groups; P in all.

    Returns:
      The list.

    >>> listed = compact_groups(jnp.array([False, True, True, True]), jnp.array([1, 3, 4]), [1, 2])
    >>> listed.row.tolist(), listed.member.tolist(), listed.found.tolist()
    ([3, 0, 3, 1], [1, 3, 4], [2, 1])
    """
    keep, order = materialize((keep, prefix_sum(keep)))

    def count() -> tuple[list[jax.Array], jax.Array, list[jax.Array], list[jax.Array]]:
        end = [lookup(order, first[i] - 1) for i in range(len(capacities) + 1)]
        found = [after - before for before, after in itertools.pairwise(end)]
        kept = [jnp.minimum(each, capacity) for each, capacity in zip(found, capacities, strict=True)]
        return end, jnp.stack(found), kept, list(itertools.accumulate(kept))

    end, found, kept, kept_up_to = single_kernel(count)
    row = jnp.full_like(order, sum(capacities))
    for before, num, up_to in zip(end, kept, kept_up_to, strict=False):
        place = order - before
        row = jnp.where(keep & (place > 0) & (place <= num), place - 1 + up_to - num, row)
    size, itself = keep.shape[0], jnp.arange(keep.shape[0], dtype=jnp.int32)
    member = scatter("set", jnp.full(sum(capacities), size, jnp.int32), row, itself)
    return GroupedRows(row, member, found, jnp.stack(kept), kept_up_to[-1])


def select_highest(
    score: jax.Array, capacity: int, min_score: jax.Array | float
) -> tuple[jax.Array, jax.Array]:
    """Rows with scores above a threshold. Law: in their order, and where they are too many the highest.

    Args:
      score: (P,) float32, no NaN.
      capacity: static.
      min_score: () float32.

    Returns:
      row: (capacity,) int32, ascending, P beyond; of equal scores at the end the first rows.
      num: () int32, the true number.
    """
    above = score > min_score
    if on_accelerator():
        above_and_high = above & (_num_better(score) < capacity)
        return compact(above_and_high, capacity)[0], jnp.sum(above, dtype=jnp.int32)
    row, num = compact(above, capacity)

    def highest() -> jax.Array:
        row = jnp.arange(score.shape[0], dtype=jnp.int32)
        _, order = jax.lax.sort((-score, row), num_keys=1, is_stable=True)
        return jnp.sort(order[:capacity])

    if capacity >= score.shape[0]:
        return row, num
    return jax.lax.cond(num > capacity, highest, lambda: row), num


def _num_better(score: jax.Array) -> jax.Array:
    """(P,) int32: how many rows have a higher score, or the same and come before."""
    row = jnp.arange(score.shape[0], dtype=jnp.int32)
    comes_first = (score[None] == score[:, None]) & (row[None] < row[:, None])
    better = (score[None] > score[:, None]) | comes_first
    return reduce_pairs(better.astype(jnp.int32), jax.lax.add, axis=1)


def best_first(score: jax.Array, num: jax.Array) -> jax.Array:
    """Rows with positive scores by descending score. Law: a stable sort of them.

    The place of a row is the number of rows before it: for the few that are there, counting beats a sort.

    Args:
      score: (P,) float32, no NaN.
      num: () int32; rows beyond this many score nothing.

    Returns:
      (P,) int32 rows, P beyond the last.
    """
    size = score.shape[0]
    row = jnp.arange(size, dtype=jnp.int32)
    padded = jnp.pad(score, (0, -size % chunks.RANKS))

    def step(start: jax.Array, place: jax.Array) -> jax.Array:
        for k in range(chunks.RANKS):
            other = start + k
            rival = padded[other]
            better = (rival > score) | ((rival == score) & (other.astype(jnp.int32) < row))
            place = place + better.astype(jnp.int32)
        return place

    if on_accelerator():
        place = _num_better(score)
    else:
        place = for_chunks(num, chunks.RANKS, step, jnp.zeros_like(row), capacity=size)
    return scatter("set", jnp.full(size, size, jnp.int32), jnp.where(score > 0, place, size), row)
