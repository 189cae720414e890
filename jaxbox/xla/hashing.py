"""Pseudo-random numbers by hashing."""

import math

import jax
import jax.numpy as jnp

from jaxbox.xla.bits import WORD_BITS

GOLDEN_RATIO_BITS = 0x9E3779B9
"""2^32 over the golden ratio: its multiples fill the 32 bits evenly."""

PLASTIC_RATIO_BITS = 0xC13FA9A9
"""2^32 over the plastic ratio, likewise."""


def lattice_numbers(i: jax.Array, j: jax.Array, size: int) -> jax.Array:
    """Numbers of the cells of a plane: those below any bound are spread evenly over it (Kronecker lattice).

    Law: ``size * ((i / golden ratio + j / plastic ratio) % 1)``, rounded down.

    Args:
      i: (...) int32.
      j: (...) int32.
      size: static, a power of 2.

    Returns:
      (...) int32, in [0, size).

    >>> lattice_numbers(jnp.array([0, 1, 2, 0]), jnp.array([0, 0, 0, 1]), 16).tolist()
    [0, 9, 3, 12]
    """
    # As fractions of 2^32, whose sums wrap round.
    ratios = jnp.uint32(GOLDEN_RATIO_BITS), jnp.uint32(PLASTIC_RATIO_BITS)
    place = i.astype(jnp.uint32) * ratios[0] + j.astype(jnp.uint32) * ratios[1]
    return (place >> (WORD_BITS + 1 - size.bit_length())).astype(jnp.int32)


def hashed_uniform(key: jax.Array, round_index: int, shape: tuple[int, ...]) -> jax.Array:
    """Numbers in [0, 1) from a key. Law: another key or round gives others, each value as likely as another.

    They are hashes of the key, even enough for RANSAC and far cheaper than `jax.random`.

    Args:
      key: JAX random key.
      round_index: static; another round draws other numbers.
      shape: static.

    Returns:
      (shape) float32.
    """
    state = jnp.uint32(round_index)
    for word in jax.random.key_data(key).reshape(-1):
        state = _scramble(state ^ word)
    counter = jnp.arange(math.prod(shape), dtype=jnp.uint32).reshape(shape)
    # The upper 24 bits: float32 holds no more.
    return (_scramble(counter * jnp.uint32(GOLDEN_RATIO_BITS) + state) >> 8).astype(jnp.float32) / 2**24


def _scramble(word: jax.Array) -> jax.Array:
    """A bijection of 32 bits in which each bit depends on all: the last step of MurmurHash3."""
    word = (word ^ (word >> 16)) * jnp.uint32(0x85EBCA6B)
    word = (word ^ (word >> 13)) * jnp.uint32(0xC2B2AE35)
    return word ^ (word >> 16)
