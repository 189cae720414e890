"""Sums over windows of a grid's cells, and functions of the cells that are occupied."""

import functools
import itertools
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp

from jaxbox.xla import chunks
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.barriers import materialize, store
from jaxbox.xla.indexing import gather, scatter
from jaxbox.xla.loops import for_chunks
from jaxbox.xla.rows import compact


def sum_cells(
    cell_of: Callable[[jax.Array], jax.Array], rows: jax.Array, *, num_cells: int
) -> tuple[jax.Array, jax.Array]:
    """Sums rows by cell. Law: ``cell_of(rows)``, and `jax.ops.segment_sum` by those.

    Args:
      cell_of: maps rows (N, C) to their cells, (N,) uint32, below `num_cells`.
      rows: (N, C) float32.
      num_cells: static.

    Returns:
      cells: (N,) uint32, stored once for the sum and for whatever reads them next.
      sums: (num_cells, C) float32.
    """
    cells = materialize(cell_of(rows))
    zeros = jnp.zeros((num_cells, rows.shape[1]), rows.dtype)
    if on_accelerator():
        return cells, scatter("add", zeros, cells.astype(jnp.int32), rows)
    return cells, zeros.at[cells].add(rows, mode="promise_in_bounds")


def map_cells(
    function: Callable[[jax.Array], jax.Array], cells: jax.Array, sums: jax.Array
) -> list[jax.Array]:
    """Looks up for each point a function of its cell. Law: the columns of ``function(cells)``.

    A CPU applies the function once to each block of neighbouring cells that holds points; to list those takes
    as many kernels on an accelerator as all else.

    Args:
      function: maps cells (C,) to (C, 4).
      cells: (N,) uint32, of each point.
      sums: (cells, 4) float32; the last column counts the points of each cell.

    Returns:
      The first three columns, (N,) each; anything finite or infinite for points whose cell counts none.
    """
    if on_accelerator():
        of_point = function(cells)
        return [of_point[:, axis] for axis in range(3)]
    of_cell = _of_occupied(function, sums).reshape(-1)
    return [of_cell[4 * cells + axis] for axis in range(3)]


def _of_occupied(function: Callable[[jax.Array], jax.Array], sums: jax.Array) -> jax.Array:
    """(C, 4) a function of the cells that hold points; anything in the others."""
    size = chunks.FILTER_BLOCK_CELLS * 4
    blocks = sums.reshape(-1, size)
    # A product, since it is computed once: the compiler would count again in each reader.
    count = blocks @ jnp.tile(jnp.array([0, 0, 0, 1], jnp.float32), chunks.FILTER_BLOCK_CELLS)
    occupied, num = compact(count > 0, blocks.shape[0])

    def step(start: jax.Array, ends: jax.Array) -> jax.Array:
        block = jax.lax.dynamic_slice_in_dim(occupied, start, min(chunks.FILTER_BLOCKS, blocks.shape[0]))
        cell = (
            block[:, None] * chunks.FILTER_BLOCK_CELLS
            + jnp.arange(chunks.FILTER_BLOCK_CELLS, dtype=jnp.int32)[None]
        )
        return ends.at[block].set(function(cell.reshape(-1)).reshape(-1, size), mode="drop")

    return for_chunks(num, chunks.FILTER_BLOCKS, step, blocks)


def margin_cells(row: jax.Array, column: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """Cells of a grid with an empty column after each row. Law: ``row * (num_columns + 1) + column``.

    Args:
      row: (N,) int32.
      column: (N,) int32.
      shape: static, rows and columns.

    Returns:
      (N,) int32, stored once for all that read it.
    """
    return materialize(row * (shape[1] + 1) + column)


def window_counts(
    level: jax.Array,
    cell: jax.Array,
    valid: jax.Array,
    *,
    num_levels: int,
    num_above: int,
    shape: tuple[int, int],
) -> jax.Array:
    """Counts points by level in the 3 x 3 cells round each. Law: a histogram, and sums of shifted grids.

    The margin is one empty column after each row and one empty row after each level, so that neighbours are a
    fixed distance apart in one long vector: sums of shifted slices of it vectorise, whatever the columns.

    Args:
      level: (N,) int32, in [0, num_levels).
      cell: (N,) int32, see `margin_cells`.
      valid: (N,) bool, points that count.
      num_levels: static, L.
      num_above: static, empty levels above those.
      shape: static, rows and columns of the grid.

    Returns:
      (L + num_above, cells) float32, whole numbers; of cells of the margin anything finite.
    """
    width = shape[1] + 1
    size, before = (shape[0] + 1) * width, width + 1
    length = (num_levels + num_above) * size + 2 * before
    place = jnp.where(valid, level * size + cell + before, length)
    count = scatter("add", jnp.zeros(length, jnp.int32), place, 1)
    for step in (width, 1):
        count = count[: -2 * step] + count[step:-step] + count[2 * step :]
    return materialize(count.reshape(-1, size).astype(jnp.float32))


def enlarge_cells(grid: jax.Array, times: int) -> jax.Array:
    """Squares of cells in place of each. Law: ``grid.repeat(times, 0).repeat(times, 1)``.

    Args:
      grid: (X, Y), stored first: else each cell of a square would compute it again (XLA, CPU).
      times: static, cells along an edge of a square.

    Returns:
      (times X, times Y).
    """
    return materialize(grid).repeat(times, 0).repeat(times, 1)


def window_sums(sums: jax.Array, stride: int, weight: jax.Array) -> jax.Array:
    """Weighted sums over the 3 x 3 x 3 windows of all cells but the margins. Law: a separable convolution.

    Args:
      sums: (lines, 4 width) float32: four numbers a cell, lines of cells side by side.
      stride: static, lines from one x to the next; neighbouring lines are levels.
      weight: () float32, of a neighbour along each axis; the cell itself weighs 1.

    Returns:
      (lines - 2 stride - 2, 4 width - 8) float32.
    """
    if on_accelerator():
        # All passes in one kernel, which reads and writes the cells once.
        size = sums.shape[0] - 2 * (stride + 1), sums.shape[1] - 8
        return store(functools.reduce(jnp.add, _neighbours(sums, stride, weight, size)))
    for step in (stride, 1):
        sums = sums[step:-step] + weight * (sums[: -2 * step] + sums[2 * step :])
    # Stored, or each of three neighbours would add the same nine cells up.
    sums = materialize(sums)
    return sums[:, 4:-4] + weight * (sums[:, :-8] + sums[:, 8:])


def _neighbours(
    sums: jax.Array, stride: int, weight: jax.Array, size: tuple[int, int]
) -> Iterator[jax.Array]:
    """The weighted sums of each of 3 x 3 x 3 neighbours, (lines, 4 width) of a size each."""
    for x, level, y in itertools.product((0, 1, 2), repeat=3):
        neighbour = jax.lax.slice(sums[x * stride + level :, 4 * y :], (0, 0), size)
        yield weight ** (abs(x - 1) + abs(level - 1) + abs(y - 1)) * neighbour


def window_at(windows: jax.Array, cell: jax.Array) -> jax.Array:
    """The four numbers of cells. Law: ``windows.reshape(-1, 4)[cell]``.

    Args:
      windows: (lines, 4 width) float32, see `window_sums`.
      cell: (...) uint32 or int32.

    Returns:
      (..., 4) float32.
    """
    if not on_accelerator():
        return windows.reshape(-1, 4).at[cell].get(mode="clip")
    first, numbers = 4 * cell.astype(jnp.int32), windows.reshape(-1)
    return jnp.stack([gather(numbers, first + k) for k in range(4)], axis=-1)
