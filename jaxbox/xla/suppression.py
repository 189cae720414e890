"""Greedy suppression of rows by better ones, at a fixed shape."""

import functools

import jax
import jax.numpy as jnp

from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.bits import WORD_BITS, pack_bits
from jaxbox.xla.loops import for_chunks, whole_chunks
from jaxbox.xla.pairs import Relation, all_pairs
from jaxbox.xla.rows import count_true

ROUNDS = 6
"""Rounds on an accelerator before the host looks whether they were enough."""


def suppress_conflicts(rows: jax.Array, valid: jax.Array, conflict: Relation) -> jax.Array:
    """Keeps each row that is in conflict with no earlier row that is kept. Law: the greedy loop.

    A row depends on earlier ones only: after k rounds over all rows the first k are right, and where nothing
    changes all are. A few rounds do, as chains of rows in conflict one after the other are short.

    Args:
      rows: (P, ...), best first.
      valid: (P,) bool, rows that count, all before the others.
      conflict: of two rows; symmetric.

    Returns:
      (P,) bool.
    """
    rivals = _rivals(rows, valid, conflict)

    def without_rivals(keep: jax.Array) -> jax.Array:
        return valid & ~jnp.any((rivals & keep[None]) != 0, axis=1)

    def step(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return state[1], pack_bits(without_rivals(state[1]))

    def rounds(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return functools.reduce(lambda state, _: step(state), range(ROUNDS), state)

    every = pack_bits(valid)
    turn, state = step, (jnp.zeros_like(every), every)
    if on_accelerator():
        # The first rounds without a look: for that the host would wait.
        turn, state = rounds, rounds(state)
    keep = jax.lax.while_loop(lambda state: jnp.any(state[0] != state[1]), turn, state)[1]
    return without_rivals(keep)


def _rivals(rows: jax.Array, valid: jax.Array, conflict: Relation) -> jax.Array:
    """(P, P / 32) uint32: which earlier rows each one is in conflict with, as bits."""
    if on_accelerator():
        row = jnp.arange(valid.shape[0], dtype=jnp.int32)
        return pack_bits(all_pairs(conflict, rows, rows) & (row[None] < row[:, None]))
    return _rivals_by_words(rows, count_true(valid), conflict)[: valid.shape[0]]


def _rivals_by_words(rows: jax.Array, num_rows: jax.Array, conflict: Relation) -> jax.Array:
    """As `_rivals`, one word of each of 32 rows at a time, and only words of rows that come earlier."""
    rows = whole_chunks(rows, WORD_BITS)
    row = jnp.arange(WORD_BITS, dtype=jnp.uint32)

    def fill(i: jax.Array, j: jax.Array, bits: jax.Array) -> jax.Array:
        first, second = (jax.lax.dynamic_slice_in_dim(rows, k, WORD_BITS) for k in (i, j))
        earlier = j + row[None] < i + row[:, None]
        new = pack_bits(all_pairs(conflict, first, second) & earlier)
        return jax.lax.dynamic_update_slice(bits, new, (i, j // WORD_BITS))

    def fill_row(i: jax.Array, bits: jax.Array) -> jax.Array:
        return for_chunks(i + 1, WORD_BITS, functools.partial(fill, i), bits)

    bits = jnp.zeros((rows.shape[0], rows.shape[0] // WORD_BITS), jnp.uint32)
    return for_chunks(num_rows, WORD_BITS, fill_row, bits)
