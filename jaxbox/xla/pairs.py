"""What rows are to each other, at a fixed shape."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxbox.xla import chunks
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.barriers import reduce_pairs
from jaxbox.xla.indexing import scatter, take
from jaxbox.xla.loops import for_chunks, whole_chunks
from jaxbox.xla.rows import compact

Relation = Callable[[jax.Array, jax.Array], jax.Array]
"""What one row is to another, (): a truth value, or flags as uint32."""


def join_pairs(rows: jax.Array, mask: jax.Array, relation: Relation) -> jax.Array:
    """What each row is to any other. Law: word i has the bits of all ``relation(rows[i], rows[j])``.

    Args:
      rows: (P, ...).
      mask: (P,) bool, which rows count.
      relation: of two rows, or of a row to itself.

    Returns:
      (P,) uint32; 0 for rows that do not count.
    """
    if on_accelerator():
        return _join(relation, rows, rows, mask[:, None] & mask[None])
    index, num = compact(mask, mask.shape[0])
    words = _join_chunks(take(rows, index), num, relation)
    return scatter("set", jnp.zeros_like(words), index, words)


def _join_chunks(rows: jax.Array, num_rows: jax.Array, relation: Relation) -> jax.Array:
    """The same of the first rows, chunk after chunk of those that count."""
    capacity, chunk = rows.shape[0], chunks.PAIRS
    rows = whole_chunks(rows, chunk)
    row, num = jnp.arange(chunk, dtype=jnp.uint32), jnp.uint32(num_rows)

    def add(i: jax.Array, j: jax.Array, words: jax.Array) -> jax.Array:
        first, second = (jax.lax.dynamic_slice_in_dim(rows, k, chunk) for k in (i, j))
        new = _join(relation, first, second, (i + row[:, None] < num) & (j + row[None] < num))
        before = jax.lax.dynamic_slice_in_dim(words, i, chunk)
        return jax.lax.dynamic_update_slice(words, before | new, (i,))

    def add_row(i: jax.Array, words: jax.Array) -> jax.Array:
        return for_chunks(num_rows, chunk, functools.partial(add, i), words)

    words = for_chunks(num_rows, chunk, add_row, jnp.zeros(rows.shape[0], jnp.uint32), capacity=capacity)
    return words[:capacity]


def all_pairs(relation: Relation, first: jax.Array, second: jax.Array) -> jax.Array:
    """What each row is to each other one. Law: element i, j is ``relation(first[i], second[j])``.

    Args:
      relation: of two rows.
      first: (P, ...).
      second: (Q, ...).

    Returns:
      (P, Q).
    """
    return jax.vmap(jax.vmap(relation, (None, 0)), (0, None))(first, second)


def _join(relation: Relation, first: jax.Array, second: jax.Array, counts: jax.Array) -> jax.Array:
    # Reductions along the first axis vectorise on a CPU.
    each = all_pairs(lambda other, own: relation(own, other), second, first)
    each = jnp.where(counts.T, each, jnp.uint32(0))
    return reduce_pairs(each, jax.lax.bitwise_or, axis=0)
