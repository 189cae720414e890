"""Folds over runs of neighbouring rows, and several counts packed in the bits of one word."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox.xla import chunks
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.barriers import materialize
from jaxbox.xla.indexing import scatter
from jaxbox.xla.loops import for_chunks
from jaxbox.xla.rows import prefix_max, prefix_sum, split_index

COUNT_BITS = chunks.RUN_ROWS.bit_length()
"""Bits that hold a count of the rows of a block."""

COUNTS_PER_WORD = 5
"""Such counts that a word of 32 bits holds."""

WORD_COUNT_BITS = COUNTS_PER_WORD * COUNT_BITS
"""Bits of a word that hold counts."""


def fold_runs(
    update: Callable[[Any, jax.Array, jax.Array, list[jax.Array]], Any],
    state: Any,
    first: jax.Array,
    length: jax.Array,
    columns: Sequence[jax.Array],
) -> Any:
    """Folds runs of neighbouring rows into a state. Law: each row of each run is seen once, with its owner.

    Args:
      update: maps the state, the owners (B,) of blocks of rows, which rows of them are of the run (B, L), and
        the columns (B, L) each, to the next state. A block without a row of a run changes nothing.
      state: pytree of arrays.
      first: (C, R) int32, where each of the R runs of each owner begins.
      length: (C, R) int32, rows of each run, 0 for none.
      columns: (N,) arrays, with room for a block after the last row of any run.

    Returns:
      The state after the last row.
    """
    runs = first.shape[1]
    first, length = first.reshape(-1), length.reshape(-1)
    num_places = chunks.RUN_BLOCKS_ON_ACCELERATOR if on_accelerator() else chunks.RUN_BLOCKS
    num_blocks = (length + chunks.RUN_ROWS - 1) // chunks.RUN_ROWS
    end = prefix_sum(num_blocks)
    begin = end - num_blocks

    def step(start: jax.Array, state: Any) -> Any:
        # The run of each block: that which begins last, before it or with it.
        place = start.astype(jnp.int32) + jnp.arange(num_places, dtype=jnp.int32)
        is_met = (num_blocks > 0) & (end > place[0]) & (begin <= place[-1])
        at = jnp.where(is_met, jnp.maximum(begin - place[0], 0), num_places)
        index = jnp.arange(end.shape[0], dtype=jnp.int32)
        run = prefix_max(scatter("max", jnp.zeros(num_places, jnp.int32), at, index))
        offset = (place - begin[run]) * chunks.RUN_ROWS
        left = jnp.where(place < end[-1], length[run] - offset, 0)
        owner, _ = split_index(run, runs)

        def block(column: jax.Array) -> jax.Array:
            def piece(start: jax.Array) -> jax.Array:
                return jax.lax.dynamic_slice_in_dim(column, start, chunks.RUN_ROWS)

            return jax.vmap(piece)(first[run] + offset)

        valid = jnp.arange(chunks.RUN_ROWS, dtype=jnp.int32)[None] < left[:, None]
        return update(state, owner, valid, [block(column) for column in columns])

    return for_chunks(end[-1], num_places, step, state)


def count_kinds(kinds: Sequence[jax.Array], level: jax.Array, num_levels: int) -> jax.Array:
    """Counts several kinds of rows, and a histogram, over blocks of rows. Law: sums of each kind and level.

    Each word holds five counts, each in bits of its own, so that one sum counts five kinds.

    Args:
      kinds: five (B, L) bool.
      level: (B, L) int32, in [0, num_levels], the latter for none.
      num_levels: static, a multiple of five.

    Returns:
      (B, 5 + num_levels) int32.
    """
    digits = [jnp.where(kind, jnp.int32(1 << k * COUNT_BITS), 0) for k, kind in enumerate(kinds)]
    first = functools.reduce(jnp.add, digits)
    # Stored, or each word would work it out anew; a division by the counts of a word takes as long again.
    bit = materialize(level * COUNT_BITS)
    word = jnp.arange(num_levels // COUNTS_PER_WORD, dtype=jnp.int32)[:, None, None]
    # Bits of the words before are negative, and so too large without a sign.
    bit = (bit[None] - word * WORD_COUNT_BITS).astype(jnp.uint32)
    others = jnp.where(bit < WORD_COUNT_BITS, jnp.uint32(1) << bit, 0).astype(jnp.int32)
    sums = jnp.sum(first, axis=1, dtype=jnp.int32), jnp.sum(others, axis=2, dtype=jnp.int32)
    words = jnp.concatenate([sums[0][:, None], sums[1].T], axis=1)
    digit = jnp.arange(COUNTS_PER_WORD, dtype=jnp.int32)[None, None]
    counts = (words[:, :, None] >> digit * COUNT_BITS) & (2**COUNT_BITS - 1)
    return counts.reshape(counts.shape[0], -1)


def maximum_nonnegative(values: jax.Array) -> jax.Array:
    """The greatest of each row. Law: `jnp.max` along the last axis of numbers that are not negative.

    The bits of such numbers are in their order, and maxima of integers vectorise.

    Args:
      values: (B, L) float32, none negative, none NaN.

    Returns:
      (B,) float32.
    """
    bits = jax.lax.bitcast_convert_type(values, jnp.int32)
    return jax.lax.bitcast_convert_type(jnp.max(bits, axis=1), jnp.float32)
