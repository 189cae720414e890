"""Reductions of rows by segment: by component, by cell, by slice."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.xla import chunks
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.barriers import store
from jaxbox.xla.bits import WORD_BITS
from jaxbox.xla.indexing import Operation, scatter
from jaxbox.xla.loops import fold_rows

Columns = Sequence[jax.Array]
"""What is reduced of a row: numbers () each, or (N,) of all rows."""

HALF_BITS = 16
MAX_HALF = 2 ** (HALF_BITS - 1) - 1
"""Bits of half a word, and the greatest count that either half holds: the sign takes one."""

_NEUTRAL = {"add": 0, "max": -jnp.inf, "min": jnp.inf}
_JOIN = {"add": jnp.add, "max": jnp.maximum, "min": jnp.minimum}


def reduce_segments(
    describe: Callable[[Any], tuple[Columns, Columns]],
    rows: Any,
    segment: jax.Array,
    *,
    num_rows: jax.Array,
    num_segments: int,
) -> jax.Array:
    """Maxima and counts over the rows of each segment. Law: `jax.ops.segment_max`, and `segment_sum`.

    Args:
      describe: gives the numbers of rows whose maxima are sought, and the flags that are counted, 0 or 1.
      rows: pytree of (N, ...) arrays.
      segment: (maps, N) int32, of each row on each map, in [0, S).
      num_rows: () int32; how many rows count, from the first on.
      num_segments: static, S.

    Returns:
      (S, maxima + flags) float32: minus infinity and 0 where a segment has no row; float32 counts exactly up
      to 2^24.
    """
    num_rows = jnp.minimum(num_rows, segment.shape[1])
    reduce = _reduce_parallel if on_accelerator() else _reduce_sequential
    return reduce(describe, rows, segment, num_rows, num_segments)


def _reduce_sequential(
    describe: Callable[[Any], tuple[Columns, Columns]],
    rows: Any,
    segment: jax.Array,
    num_rows: jax.Array,
    num_segments: int,
) -> jax.Array:
    """Row after row: XLA compiles so small a loop to native code, which adds a whole row at a time."""
    maxima, flags = jax.eval_shape(describe, rows)
    is_maximum = np.arange(len(maxima) + len(flags)) < len(maxima)
    none = jnp.where(is_maximum, jnp.float32(-jnp.inf), 0)
    table = jnp.broadcast_to(none, (num_segments, is_maximum.size))

    def add(maps: range, i: jax.Array, table: jax.Array) -> jax.Array:
        own = _as_row(describe(jax.tree.map(lambda a: a[i], rows)))
        for on_map in maps:
            row = segment[on_map, i]
            before = table[row]
            joined = jnp.where(is_maximum, jnp.maximum(before, own), before + own)
            table = jax.lax.dynamic_update_index_in_dim(table, joined, row, 0)
        return table

    maps = range(segment.shape[0])
    for first in maps[:: chunks.STATISTICS_MAPS]:
        some = maps[first : first + chunks.STATISTICS_MAPS]
        table = jax.lax.fori_loop(0, num_rows, functools.partial(add, some), table)
    return table


def _reduce_parallel(
    describe: Callable[[Any], tuple[Columns, Columns]],
    rows: Any,
    segment: jax.Array,
    num_rows: jax.Array,
    num_segments: int,
) -> jax.Array:
    valid = jnp.arange(segment.shape[1], dtype=jnp.int32) < num_rows
    row = jnp.where(valid, segment, num_segments)
    maxima, flags = describe(rows)
    own = jnp.broadcast_to(_as_row((maxima, [])), (*row.shape, len(maxima)))
    greatest = _scatter_privatized("max", row, own, num_segments=num_segments)
    counts = _count_privatized(row, flags, num_segments=num_segments)
    return jnp.concatenate([greatest, counts.astype(jnp.float32)], axis=1)


def _count_privatized(segment: jax.Array, flags: Columns, *, num_segments: int) -> jax.Array:
    """(S, flags) int32: how many rows of each segment have each flag.

    Whole numbers: ordered scatters of floats cost accelerators more. Two counts share a word where none of a
    private table can be too large for half of it.
    """
    num_tables = _num_tables(num_segments, len(flags))
    most = math.prod(segment.shape[:-1]) * -(-segment.shape[-1] // num_tables)
    if len(flags) != 2 or most > MAX_HALF:
        own = jnp.broadcast_to(_as_row((flags, [])), (*segment.shape, len(flags))).astype(jnp.int32)
        return _scatter_privatized("add", segment, own, num_segments=num_segments)
    low, high = (flag.astype(jnp.int32) for flag in flags)
    words = jnp.broadcast_to(low | high << HALF_BITS, segment.shape)[..., None]
    words = _fill_tables("add", segment, words, num_segments, num_tables)[..., 0]
    counts = words & 2**HALF_BITS - 1, words >> HALF_BITS
    return jnp.stack(store([jnp.sum(each, axis=0, dtype=jnp.int32) for each in counts]), axis=1)


def _scatter_privatized(
    operation: Literal["add", "max", "min"],
    segment: jax.Array,
    values: jax.Array,
    *,
    num_segments: int,
    num_tables: int | None = None,
) -> jax.Array:
    """Sums, maxima or minima of the rows of each segment.

    Updates of one address wait for each other, atomic ones of an accelerator most of all (contention), and
    neighbouring rows are often of one segment: they go to several private tables in turn, which are reduced.

    Args:
      operation: what to do with the rows.
      segment: (..., N) int32, not negative; num_segments and above for none.
      values: (..., N, C), float32 for maxima and minima.
      num_segments: static, S.
      num_tables: static; None for as many as cost an accelerator little.

    Returns:
      (S, C): 0, or infinite, where a segment has no row.
    """
    if num_tables is None:
        num_tables = _num_tables(num_segments, values.shape[-1])
    tables = _fill_tables(operation, segment, values, num_segments, num_tables)
    if not on_accelerator():
        # Table by table: a reduction along the first axis goes to YNNPACK, which takes ten times as long.
        return functools.reduce(_JOIN[operation], tables)
    if operation == "add":
        return store(jnp.sum(tables, axis=0, dtype=values.dtype))
    return store((jnp.max if operation == "max" else jnp.min)(tables, axis=0))


def _num_tables(num_segments: int, columns: int) -> int:
    """As many private tables as cost an accelerator little."""
    return max(min(chunks.MAX_TABLES, chunks.TABLE_NUMBERS // max(num_segments * columns, 1)), 1)


def _fill_tables(
    operation: Operation, segment: jax.Array, values: jax.Array, num_segments: int, num_tables: int
) -> jax.Array:
    """(tables, S, C), see `_scatter_privatized`: the rows go to one after the other."""
    columns = values.shape[-1]
    table = jax.lax.broadcasted_iota(jnp.int32, segment.shape, segment.ndim - 1) % num_tables
    # What lies past the last segment would be another table's.
    place = jnp.where(segment < num_segments, table * num_segments + segment, num_tables * num_segments)
    tables = jnp.full((num_tables * num_segments, columns), _NEUTRAL[operation], values.dtype)
    return scatter(operation, tables, place, values).reshape(num_tables, num_segments, columns)


def _as_row(columns: tuple[Columns, Columns]) -> jax.Array:
    """(..., columns) of a row alone. Chosen column by column, as a stack does not vectorise."""
    values = [*columns[0], *columns[1]]
    column = np.arange(len(values))
    row = values[-1][..., None]
    for k, value in enumerate(values[:-1]):
        row = jnp.where(column == k, value[..., None], row)
    return row


def fold_segments(
    operation: Literal["add", "max"],
    describe: Callable[[jax.Array, jax.Array], jax.Array],
    segment: jax.Array,
    row: jax.Array,
    *,
    num_rows: jax.Array,
    num_segments: int,
    absent: int,
) -> jax.Array:
    """Sums or maxima over the rows of each segment. Law: `jax.ops.segment_sum`, `segment_max`.

    Args:
      operation: static, sums or maxima.
      describe: gives the numbers (N, C) of rows, of their segments and themselves, (N,) each.
      segment: (N,) int32, in [0, S]; the latter for none.
      row: (N,) int32, what `describe` looks up.
      num_rows: () int32; how many rows count, from the first on.
      num_segments: static, S.
      absent: static, a row that `describe` finds nothing at.

    Returns:
      (S, C) float32: 0, or minus infinity, where a segment has no row.
    """
    shape = jax.eval_shape(describe, segment, row).shape
    none = jnp.full((num_segments, shape[1]), _NEUTRAL[operation], jnp.float32)

    def fold(table: jax.Array, _: jax.Array, rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        values = describe(*rows)
        if on_accelerator():  # Of all rows: there is nothing in the table yet.
            return _scatter_privatized(operation, rows[0], values, num_segments=num_segments)
        return scatter(operation, table, rows[0], values)

    return fold_rows(fold, none, (segment, row), num_rows=num_rows, absent=(num_segments, absent))


def segment_minima(
    values: jax.Array, segment: jax.Array, valid: jax.Array, *, num_segments: int
) -> jax.Array:
    """The least value of each segment. Law: `jax.ops.segment_min` of the valid values.

    Args:
      values: (N,) float32.
      segment: (N,) int32, not negative where valid; values beyond the last segment are ignored.
      valid: (N,) bool, values that count.
      num_segments: static, S.

    Returns:
      (S,) float32, infinite where there is none.
    """
    num_tables = None if on_accelerator() else chunks.MINIMA_TABLES
    segment, own = jnp.where(valid, segment, num_segments), values[:, None]
    lowest = _scatter_privatized("min", segment, own, num_segments=num_segments, num_tables=num_tables)
    return lowest[:, 0]


def argmax_key(value: jax.Array, index: jax.Array, num_rows: int) -> jax.Array:
    """Words whose maximum tells where a value is greatest. Law: `argmax_row` of it, but for quantisation.

    The value's leading bits stand above the index in one word, so that one scatter finds both. The value is
    quantised to at least 2^-11 for up to a million rows.

    Args:
      value: (...) float32, in [0, 1].
      index: (...) int32, in [0, num_rows).
      num_rows: static.

    Returns:
      (...) uint32, above 0.
    """
    index_bits = num_rows.bit_length()
    # More bits than float32 holds would round the largest value up, out of the word.
    value_bits = min(WORD_BITS - index_bits, 24)
    # Conversions to int32 vectorise, those to uint32 do not.
    quantised = (value * (2**value_bits - 1)).astype(jnp.int32).astype(jnp.uint32)
    return (quantised << index_bits) | (index.astype(jnp.uint32) + 1)


def argmax_row(key: jax.Array, num_rows: int) -> jax.Array:
    """The index of an `argmax_key`. Law: ``argmax_row(argmax_key(value, index, n), n) == index``.

    Args:
      key: (...) uint32, 0 for none.
      num_rows: static, as `argmax_key` was given it.

    Returns:
      (...) int32, -1 for none.
    """
    return (key & (2 ** num_rows.bit_length() - 1)).astype(jnp.int32) - 1
