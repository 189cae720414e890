"""Range cells of a polar grid as the bits of words, each with what lies before or beyond its block."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.barriers import materialize
from jaxbox.xla.bits import count_bits, join_bits, lowest_bit
from jaxbox.xla.indexing import lookup, scatter
from jaxbox.xla.rows import running_sum

BLOCK_BITS = 4


BLOCK = 2**BLOCK_BITS
"""Range cells of one word of the evidence: a bit of its low half each; the high half tells of the others."""


NEVER = 2**BLOCK - 1
"""Range cell of the next hit where there is none."""


def count_changes(size: int, first: jax.Array, last: jax.Array) -> jax.Array:
    """Intervals that begin in each cell less those that end there. Law: ``bincount(first) - bincount(last)``.

    Args:
      size: static, number of cells.
      first: (N,) int32 cells; those beyond the last are ignored.
      last: (N,) int32, likewise.

    Returns:
      (size,) int32.
    """
    beams, ends = jnp.zeros(size, jnp.int32), (first, last)
    if on_accelerator():
        # One scatter reads and writes the cells once, which counts in a batch.
        return scatter("add", beams, jnp.stack(ends), jnp.array([[1], [-1]], jnp.int32))
    return beams.at[ends[0]].add(1, mode="drop").at[ends[1]].add(-1, mode="drop")


def draw_beams(
    column: jax.Array,
    hit: tuple[Sequence[jax.Array], jax.Array],
    free: tuple[jax.Array, jax.Array, jax.Array],
    *,
    num_columns: int,
    num_cells: int,
) -> tuple[jax.Array, jax.Array]:
    """Draws beams into a polar grid, each into one column.

    Law: `covered_words` of ``first <= cell < last`` of any beam, and `next_words` of the cells that are hit.

    Args:
      column: (N,) int32, of each beam; it is stored once for the three scatters that read it.
      hit: for each of H kinds of hits (N,) bool, whether a beam hits a cell, and (N,) int32, that cell, in
        [0, num_cells).
      free: (N,) bool, whether a beam is free anywhere, and (N,) int32 twice, the first cell where it is and
        the first beyond, in [0, num_cells].
      num_columns: static, A.
      num_cells: static, R; B blocks cover them and one more.

    Returns:
      free: (B, A) uint32, see `covered_words`.
      hit: (B, H A) uint32, see `next_words`: all columns of the first kind, then of the next.
    """
    num_blocks = num_cells // BLOCK + 1
    size = num_blocks * BLOCK * num_columns
    column = materialize(column)

    def place(valid: jax.Array, cell: jax.Array) -> jax.Array:
        return jnp.where(valid, cell * num_columns + column, size)

    is_free, first, last = free
    beams = count_changes(size, place(is_free, first), place(is_free, last))
    is_hit, hit_cell = hit
    hits = [scatter("set", jnp.zeros(size, bool), place(valid, hit_cell), True) for valid in is_hit]
    shape = num_blocks, BLOCK, num_columns
    kinds = jnp.concatenate([each.reshape(shape) for each in hits], axis=2)
    return covered_words(beams.reshape(shape)), next_words(kinds)


def covered_words(beams: jax.Array) -> jax.Array:
    """Words of the cells that intervals cover. Law: bit k is ``cumsum(beams) > 0``; see `set_before`.

    Args:
      beams: (B, 16, A) int32, how many more intervals begin than end in each cell, along the first two axes.

    Returns:
      (B, A) uint32: which cells of a block are covered, and, from bit 16 on, how many before the block.
    """
    running = _sum_before(functools.reduce(jnp.add, (beams[:, k] for k in range(BLOCK))))
    covered = []
    for k in range(BLOCK):
        running = running + beams[:, k]
        covered.append(running > 0)
    free = join_bits(covered)
    before = _sum_before(count_bits(free))
    return free | (before.astype(jnp.uint32) << BLOCK)


def _sum_before(blocks: jax.Array) -> jax.Array:
    """Sums of the rows before each row. A scan over few wide rows is the fastest of its kind (XLA, CPU)."""
    if on_accelerator():
        return running_sum(blocks, axis=0) - blocks
    return jax.lax.scan(lambda total, row: (total + row, total), jnp.zeros_like(blocks[0]), blocks)[1]


def next_words(hits: jax.Array) -> jax.Array:
    """Words that tell of the next flag. Law: `next_set` is the first flag at a cell or beyond.

    Args:
      hits: (B, 16, A) bool, along the first two axes.

    Returns:
      (B, A) uint32: which cells of a block are flagged, and, from bit 16 on, the first flagged cell beyond
      the block, or `NEVER`.
    """
    hit = join_bits([hits[:, k] for k in range(BLOCK)])
    start = jnp.arange(hits.shape[0], dtype=jnp.uint32)[:, None] * BLOCK
    first = jnp.where(hit > 0, start + lowest_bit(hit), NEVER)

    def step(beyond: jax.Array, first: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.minimum(beyond, first), beyond

    if on_accelerator():
        least = jax.lax.cummin(first, axis=0, reverse=True)
        beyond = jnp.pad(least[1:], ((0, 1), (0, 0)), constant_values=NEVER)
    else:
        beyond = jax.lax.scan(step, jnp.full_like(first[0], NEVER), first, reverse=True)[1]
    return hit | (beyond << BLOCK)


def flagged_cells(words: jax.Array | np.ndarray) -> np.ndarray:
    """Which cells of the blocks are set, for pictures and tests. Law: what the words were made of.

    Args:
      words: (B, A) uint32.

    Returns:
      (16 B, A) bool, by range and azimuth.
    """
    bits = np.asarray(words)[:, None] >> np.arange(BLOCK, dtype=np.uint32)[:, None]
    return (bits & 1).astype(bool).reshape(-1, words.shape[1])


def next_set(words: jax.Array, cell: jax.Array) -> jax.Array:
    """The first flagged cell at a cell or beyond. Law: as a search cell by cell.

    Args:
      words: of the block of the cell, see `words_at`.
      cell: (...) int32.

    Returns:
      (...) int32, `NEVER` where there is none.
    """
    bit = (cell & (BLOCK - 1)).astype(jnp.uint32)
    rest = (words & NEVER) >> bit
    return jnp.where(rest > 0, cell + lowest_bit(rest).astype(jnp.int32), (words >> BLOCK).astype(jnp.int32))


def set_before(words: jax.Array, cell: jax.Array) -> jax.Array:
    """How many cells before one are covered. Law: ``cumsum(covered) - covered``.

    Args:
      words: of the block of the cell, see `words_at`.
      cell: (...) int32.

    Returns:
      (...) int32.
    """
    below = (jnp.uint32(1) << (cell & (BLOCK - 1)).astype(jnp.uint32)) - 1
    return (words >> BLOCK).astype(jnp.int32) + count_bits(words & below)


def words_at(
    tables: Sequence[jax.Array], cells: Sequence[jax.Array], columns: Sequence[jax.Array]
) -> list[jax.Array]:
    """The words of cells. Law: ``table[cell // 16, column]`` of each table.

    Args:
      tables: (B, columns) uint32 each.
      cells: (...) int32 of each.
      columns: (...) int32 of each.

    Returns:
      (...) uint32 of each table.
    """
    # What a look-up has to work out first does not vectorise.
    cells = materialize(tuple(cells))
    of_each = zip(tables, cells, columns, strict=True)
    places = materialize([(cell >> BLOCK_BITS) * table.shape[1] + column for table, cell, column in of_each])
    return [lookup(table.reshape(-1), place) for table, place in zip(tables, places, strict=True)]


def shared_cells(words: jax.Array, others: jax.Array) -> jax.Array:
    """How many cells of a block are set in both. Law: ``count_bits`` of the low halves, bit by bit.

    Args:
      words: (...) uint32, of `covered_words` or `next_words`.
      others: (...) uint32, likewise.

    Returns:
      (...) int32.

    >>> shared_cells(jnp.uint32(0b0110), jnp.uint32(0x10000 | 0b1100)).item()
    1
    """
    return count_bits(words & others & jnp.uint32(2**BLOCK - 1))
