"""Look-ups and updates by index, which on an accelerator see a batch as one long table.

`jax.vmap` makes two indices of one, the sweep's and its own, and XLA stores both for each reader. This rule
numbers the rows of all sweeps in one go: a twelfth of the bytes of 64 sweeps less.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.barriers import materialize

Operation = Literal["add", "max", "min", "set"]
"""What an update does with the number that is there."""

MAX_ROWS = 2**31 - 1
"""More rows than these have no index of 32 bits: larger batches keep two indices."""

FEW_COLUMNS = 8
"""Tables with no more columns are looked up column by column on an accelerator."""


def gather(rows: jax.Array, index: jax.Array) -> jax.Array:
    """Rows at indices that are known to lie inside. Law: ``rows[index]``.

    Args:
      rows: (N, ...).
      index: (...) int32, in [0, N).

    Returns:
      (..., ...) of the type of `rows`.
    """
    return _gather(rows, index) if on_accelerator() else _take(rows, index)


def scatter(operation: Operation, rows: jax.Array, index: jax.Array, values: Any) -> jax.Array:
    """Updates rows. Law: ``rows.at[index].add(values, mode="drop")``, or whichever the operation is.

    Args:
      operation: static.
      rows: (N, ...).
      index: (...) int32, not negative; N and above for none.
      values: what broadcasts to (..., ...).

    Returns:
      (N, ...).
    """
    if not on_accelerator():
        return _update(operation, rows, index, values)
    values = jnp.broadcast_to(jnp.asarray(values, rows.dtype), index.shape + rows.shape[1:])
    return _scatter(operation)(rows, index, values)


def take(rows: jax.Array, index: jax.Array, fill: Any = 0) -> jax.Array:
    """Rows at the indices, and a fill at the sentinel or any beyond. Law: ``rows[i] if i < N else fill``.

    Args:
      rows: (N, ...).
      index: (...) int32, not negative.
      fill: what an absent row holds.

    Returns:
      (..., ...) of the type of `rows`.
    """
    if not on_accelerator():
        return rows.at[index].get(mode="fill", fill_value=fill)
    if rows.ndim == 2 and rows.shape[1] <= FEW_COLUMNS:
        # XLA computes a column's entries where they are read, and stores rows.
        return jnp.stack([take(column, index, fill) for column in rows.T], axis=-1)
    inside = (index < rows.shape[0]).reshape(*jnp.shape(index), *[1] * (rows.ndim - 1))
    return jnp.where(inside, gather(rows, index), jnp.asarray(fill, rows.dtype))


def lookup(table: jax.Array, *index: jax.Array) -> jax.Array:
    """Entries of a table at indices that are known to lie inside. Law: ``table[index]``.

    One flat index: several would first be joined to rows, which costs more than the look-up (XLA, CPU). A
    single entry is looked up as it is, since a loop that has another view of a table is not a native one.

    Args:
      table: (A, B, ...), as many axes as there are indices.
      *index: int32 arrays of one shape, each within its axis.

    Returns:
      The shape of the indices.
    """
    if index[0].size == 1 and table.ndim > 1:
        return table.at[index].get(mode="clip")
    flat = index[0]
    for size, along in zip(table.shape[1:], index[1:], strict=True):
        flat = flat * size + along
    return gather(table.reshape(-1), flat)


def lookup_each(tables: Sequence[jax.Array], *index: jax.Array) -> list[jax.Array]:
    """Looks up the same entries of several tables. Law: ``[table[index] for table in tables]``.

    The indices are stored before the look-ups, and so is what those find: on a CPU what a look-up has to work
    out first does not vectorise, nor does what comes of it.

    Args:
      tables: arrays of one shape, see `lookup`.
      *index: int32 arrays of one shape, each within its axis.

    Returns:
      The shape of the indices, of each table.
    """
    index = materialize(index)
    return materialize([lookup(table, *index) for table in tables])


def lookup_corners(table: jax.Array, i: jax.Array, j: jax.Array) -> tuple[jax.Array, ...]:
    """The entries of 2 x 2 cells, row by row. Law: ``table[i + k, j + l]`` for k and l of 0 and 1.

    For many look-ups on a CPU, each corner has a table of its own, so that all have one place.

    Args:
      table: (A, B).
      i: (...) int32, in [0, A - 1).
      j: (...) int32, in [0, B - 1).

    Returns:
      (...) each.
    """
    width = table.shape[1]
    if on_accelerator() or i.size < table.size:
        return tuple(lookup(table, i + down, j + right) for down in (0, 1) for right in (0, 1))
    flat, place = table.reshape(-1), i * width + j
    corners = materialize([jnp.roll(flat, -first) for first in (0, 1, width, width + 1)])
    return tuple(lookup(corner, place) for corner in corners)


def pack_pairs(number: jax.Array, small: jax.Array, num_bits: int) -> jax.Array:
    """Packs two numbers in one word, so that one look-up finds both. Law: see `lookup_pair`.

    Args:
      number: (N,) int32, in [0, 2^(31 - num_bits)).
      small: (N,) int32, in [0, 2^num_bits).
      num_bits: static.

    Returns:
      (N,) int32.
    """
    return (number << num_bits) + small


def lookup_pair(pairs: jax.Array, index: jax.Array, num_bits: int) -> tuple[jax.Array, jax.Array]:
    """Numbers that `pack_pairs` packed. Law: ``number[index], small[index]``.

    Args:
      pairs: (N,) int32.
      index: (...) int32, in [0, N).
      num_bits: static, as they were packed.

    Returns:
      (...) int32 each.

    >>> pairs = pack_pairs(jnp.array([5, 7]), jnp.array([1, 0]), 1)
    >>> [part.tolist() for part in lookup_pair(pairs, jnp.array([1, 0]), 1)]
    [[7, 5], [0, 1]]
    """
    found = lookup(pairs, index)
    return found >> num_bits, found & (2**num_bits - 1)


def _take(rows: jax.Array, index: jax.Array) -> jax.Array:
    return jnp.take(rows, index, axis=0, mode="clip")


def _update(operation: Operation, rows: jax.Array, index: jax.Array, values: Any) -> jax.Array:
    return getattr(rows.at[index], operation)(values, mode="drop")


_gather = custom_vmap(_take)


@_gather.def_vmap
def _gather_batch(
    size: int, is_batched: list[bool], rows: jax.Array, index: jax.Array
) -> tuple[jax.Array, bool]:
    if not is_batched[0]:
        return _gather(rows, index), True
    index = index if is_batched[1] else jnp.broadcast_to(index, (size, *index.shape))
    num = rows.shape[1]
    if size * num > MAX_ROWS:
        return jax.vmap(_take)(rows, index), True
    return _gather(_joined(rows), _first_rows(size, num, index.ndim) + jnp.clip(index, 0, num - 1)), True


@functools.cache
def _scatter(operation: Operation) -> Callable[[jax.Array, jax.Array, jax.Array], jax.Array]:
    update = custom_vmap(functools.partial(_update, operation))

    @update.def_vmap
    def _update_batch(size: int, is_batched: list[bool], *operands: jax.Array) -> tuple[jax.Array, bool]:
        rows, index, values = (
            a if batched else jnp.broadcast_to(a, (size, *a.shape))
            for a, batched in zip(operands, is_batched, strict=True)
        )
        num = rows.shape[1]
        if size * num > MAX_ROWS:
            return jax.vmap(functools.partial(_update, operation))(rows, index, values), True
        index = jnp.where(index < num, _first_rows(size, num, index.ndim) + index, size * num)
        return update(_joined(rows), index, values).reshape(rows.shape), True

    return update


def _joined(rows: jax.Array) -> jax.Array:
    """(B N, ...) of (B, N, ...)."""
    return rows.reshape(-1, *rows.shape[2:])


def _first_rows(size: int, num: int, ndim: int) -> jax.Array:
    """(B, 1, ...) int32: where the rows of each sweep begin."""
    return jnp.arange(0, size * num, num, dtype=jnp.int32).reshape(size, *[1] * (ndim - 1))
