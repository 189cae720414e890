"""Statistical filtering by mean shift and standard deviation (paper, section 3.1)."""

import functools
import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.loops import for_chunks, store
from jaxbox.xla.masked import compact, masked_mean, masked_std

MIN_DENSITY = 1e-6
"""Windows with less weight are empty; the smallest of one point in a corner is exp(-1.5) or so."""

BLOCK_CELLS = 4
"""Cells side by side that are shifted together: it is their blocks that are looked for."""

CHUNK_BLOCKS = 1024
"""Occupied blocks shifted at a time; a sweep of 64 beams has some 1,500 to 3,000."""


def filter_outliers(
    xyz1: jax.Array,
    *,
    half_x_m: float,
    half_y_m: float,
    cell_m: float,
    num_levels: int,
    num_iterations: int,
    bandwidth_m: jax.Array | float,
    num_std: jax.Array | float,
    min_density: jax.Array | float,
) -> jax.Array:
    """Keeps the points that lie close to the dense region they shift to.

    Each point is shifted to the mean of the points around it, again and again, on a grid: all points
    of a cell share the Gaussian-weighted mean of the 3 x 3 x 3 cells round it. A point is an outlier where
    the weight of its window is below `min_density`, or where d > mean(d) + t std(d), with d the distance of
    a point to where its shift ends; mean and deviation are those of the other points.

    Args:
      xyz1: (N, 4) float32: x, y, z in m, sensor frame, and 1; zero where there is no point.
      half_x_m: static, the grid covers |x| below it.
      half_y_m: static, the grid covers |y| below it.
      cell_m: static, edge of the cells.
      num_levels: static, cells in height, centred on the sensor; the end levels are open.
      num_iterations: static, mean shift iterations.
      bandwidth_m: standard deviation of the Gaussian window, m.
      num_std: t.
      min_density: least weight of a dense region; a point alone weighs 1.

    Returns:
      (N,) bool: a point, and no outlier.

    Reference: paper, section 3.1 and figure 2; oracle `jaxbox.reference.filter_outliers`.
    """
    num_x, num_y = round(2 * half_x_m / cell_m), round(2 * half_y_m / cell_m)
    half = (half_x_m, half_y_m, num_levels * cell_m / 2)
    # A line of cells along y for each x and level, with an empty cell before and some after it. Between the
    # lines of two x lies an empty one, which is margin to both.
    stride, margin = num_levels + 1, num_levels + 2
    width = -(-(num_y + 2) // BLOCK_CELLS) * BLOCK_CELLS

    def cell_of(points: jax.Array) -> jax.Array:
        x, y, z = (
            jnp.clip(jnp.floor((points[:, axis] + half[axis]) / cell_m).astype(jnp.int32), 0, size - 1)
            for axis, size in enumerate((num_x, num_y, num_levels))
        )
        # Unsigned: none is counted from the end.
        return ((x * stride + z + margin) * width + y + 1).astype(jnp.uint32)

    valid = xyz1[:, 3] > 0
    cells = store(cell_of(xyz1))
    # One scatter for the sums and the counts: a point is what is added.
    num_cells = (num_x * stride + 2 * margin) * width
    sums = jnp.zeros((num_cells, 4), jnp.float32).at[cells].add(xyz1, mode="promise_in_bounds")
    weight = jnp.exp(-0.5 * (cell_m / jnp.asarray(bandwidth_m, jnp.float32)) ** 2)
    windows = _window_sums(sums.reshape(-1, 4 * width), stride, weight)

    def window_of(cell: jax.Array) -> jax.Array:
        row = (cell // width - margin) * (width - 2) + cell % width - 1
        return windows.reshape(-1, 4).at[row].get(mode="clip")

    def shift(cell: jax.Array) -> jax.Array:
        """Where the points of a cell end; infinitely far if their window is too light."""
        window = window_of(cell)
        is_light = window[:, 3:] < min_density
        for _ in range(num_iterations - 1):
            window = window_of(cell_of(_mean(window)))
        return jnp.pad(jnp.where(is_light, jnp.inf, _mean(window)), ((0, 0), (0, 1)))

    if on_accelerator():
        # Point by point: to list the occupied cells takes as many kernels as the rest.
        of_point = shift(cells)
        gap = [xyz1[:, axis] - of_point[:, axis] for axis in range(3)]
    else:
        ends = _of_occupied(shift, sums).reshape(-1)
        gap = [xyz1[:, axis] - ends[4 * cells + axis] for axis in range(3)]
    distance = jnp.sqrt(gap[0] ** 2 + gap[1] ** 2 + gap[2] ** 2)
    is_dense = valid & (distance < jnp.inf)
    threshold = masked_mean(distance, is_dense) + num_std * masked_std(distance, is_dense)
    return is_dense & (distance <= threshold)


def _mean(window: jax.Array) -> jax.Array:
    return window[:, :3] / jnp.maximum(window[:, 3:], MIN_DENSITY)


def _of_occupied(function: Callable[[jax.Array], jax.Array], sums: jax.Array) -> jax.Array:
    """(C, 4) a function of the cells that hold points; anything in the others."""
    size = BLOCK_CELLS * 4
    blocks = sums.reshape(-1, size)
    # A product, since it is computed once: the compiler would count again in each reader.
    count = blocks @ jnp.tile(jnp.array([0, 0, 0, 1], jnp.float32), BLOCK_CELLS)
    occupied, num = compact(count > 0, blocks.shape[0])

    def step(start: jax.Array, ends: jax.Array) -> jax.Array:
        block = jax.lax.dynamic_slice_in_dim(occupied, start, min(CHUNK_BLOCKS, blocks.shape[0]))
        cell = block[:, None] * BLOCK_CELLS + jnp.arange(BLOCK_CELLS, dtype=jnp.int32)[None]
        return ends.at[block].set(function(cell.reshape(-1)).reshape(-1, size), mode="drop")

    return for_chunks(num, CHUNK_BLOCKS, step, blocks)


def _window_sums(sums: jax.Array, stride: int, weight: jax.Array) -> jax.Array:
    """Sums over the 3 x 3 x 3 windows of all cells but the margins; one pass along each axis does."""
    if on_accelerator():
        # Both passes over whole lines of cells in one kernel.
        size = sums.shape[0] - 2 * (stride + 1)
        corners = itertools.product((0, 1, 2), repeat=2)
        starts = [(i * stride + k, weight ** (abs(i - 1) + abs(k - 1))) for i, k in corners]
        sums = functools.reduce(jnp.add, [each * sums[start : start + size] for start, each in starts])
    else:
        for step in (stride, 1):
            sums = sums[step:-step] + weight * (sums[: -2 * step] + sums[2 * step :])
    return sums[:, 4:-4] + weight * (sums[:, :-8] + sums[:, 8:])
