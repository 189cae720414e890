"""Truth values as the bits of words. One layout: bit k of a word is the k-th flag.

Two functions write it, as XLA stores sums and fuses all else. `pack_bits` is a sum, computed once for all
readers; `join_bits` is a chain of ors, computed within each reader, without the flags being stored. With
chains for both `detect` takes 6 to 11 % longer on a CPU; with sums for both the words of `range_bits` take
three times as long (docs/notes/kernels_on_cpu.md).
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp

WORD_BITS = 32
"""Bits of a word of a set of flags."""


def join_bits(flags: Sequence[jax.Array]) -> jax.Array:
    """Joins up to 32 arrays of truth values to words. Law: bit k of each word is ``flags[k]``.

    Args:
      flags: (...) bool or uint8, 0 or 1, each.

    Returns:
      (...) uint32.

    >>> join_bits([jnp.array([True, False]), jnp.array([True, True])]).tolist()
    [3, 2]
    """
    return functools.reduce(jnp.bitwise_or, [_bit(flag, jnp.uint32(k)) for k, flag in enumerate(flags)])


def pack_bits(flags: jax.Array, *, axis: int = -1) -> jax.Array:
    """Packs truth values along an axis. Law: bit b of word w is flag 32 w + b.

    Args:
      flags: (..., N, ...) bool or uint8, 0 or 1.
      axis: static, along which N lies.

    Returns:
      (..., ceil(N / 32), ...) uint32.

    >>> pack_bits(jnp.array([True, False, True])).tolist()
    [5]
    """
    axis %= flags.ndim
    before, size, after = flags.shape[:axis], flags.shape[axis], flags.shape[axis + 1 :]
    if size % WORD_BITS:
        flags = jnp.pad(flags, [(0, -size % WORD_BITS) if a == axis else (0, 0) for a in range(flags.ndim)])
    place = jnp.arange(WORD_BITS, dtype=jnp.uint32).reshape(*[1] * (axis + 1), WORD_BITS, *[1] * len(after))
    bits = _bit(flags.reshape(*before, -1, WORD_BITS, *after), place)
    return jnp.sum(bits, axis=axis + 1, dtype=jnp.uint32)


def _bit(flags: jax.Array, place: jax.Array) -> jax.Array:
    return flags.astype(jnp.uint32) << place


def count_bits(words: jax.Array) -> jax.Array:
    """Counts the bits that are set in each word. Law: the sum of the flags that `pack_bits` packed.

    Args:
      words: (...) uint32.

    Returns:
      (...) int32.
    """
    return jax.lax.population_count(words).astype(jnp.int32)


def lowest_bit(words: jax.Array) -> jax.Array:
    """Finds the place of the lowest bit that is set. Law: the first True of the flags.

    Args:
      words: (...) uint32, not zero.

    Returns:
      (...) uint32, in [0, 32).
    """
    return jax.lax.population_count((words & -words) - 1)


def sum_packed(counts: Sequence[jax.Array], most: Sequence[int], *, axis: int) -> list[jax.Array]:
    """Sums of several small counts along an axis, side by side in words. Law: `jnp.sum` of each.

    Args:
      counts: (...) bool or int32 each, not negative.
      most: static, the greatest that each may be; no sum takes more than 32 bits.
      axis: static.

    Returns:
      int32 each.

    >>> [int(each) for each in sum_packed([jnp.array([1, 0, 1]), jnp.array([7, 5, 0])], [1, 7], axis=0)]
    [2, 12]
    """
    widths = [(each * counts[0].shape[axis]).bit_length() for each in most]
    sums = []
    for word in _fitting(widths):
        places = [sum(widths[word.start : k]) for k in word]
        packed = [_bit(counts[k], jnp.uint32(place)) for k, place in zip(word, places, strict=True)]
        total = jnp.sum(functools.reduce(jnp.bitwise_or, packed), axis=axis, dtype=jnp.uint32)
        sums += [
            total >> place & jnp.uint32(2 ** widths[k] - 1) for k, place in zip(word, places, strict=True)
        ]
    return [each.astype(jnp.int32) for each in sums]


def _fitting(widths: Sequence[int]) -> list[range]:
    """Neighbours that fit into a word each, by their number."""
    words, first = [], 0
    for k in range(len(widths)):
        if sum(widths[first : k + 1]) > WORD_BITS:
            words.append(range(first, k))
            first = k
    return [*words, range(first, len(widths))]
