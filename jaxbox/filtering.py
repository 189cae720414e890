"""Statistical filtering by mean shift and standard deviation (paper, section 3.1)."""

import math

import jax
import jax.numpy as jnp

from jaxbox.masked import masked_mean, masked_std

MIN_DENSITY = 1e-6
"""Windows with less weight are empty; the smallest of one point in a corner is exp(-1.5) or so."""


def filter_outliers(
    xyz: jax.Array,
    valid: jax.Array,
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
    of a cell share the Gaussian-weighted mean of the 3 x 3 x 3 cells round it. With d the distance of a
    point to where its shift ends, the point is an outlier where d > mean(d) + t std(d), or where the
    weight of its window is below `min_density`.

    Args:
      xyz: (N, 3) float32, m, sensor frame; zero where not valid.
      valid: (N,) bool.
      half_x_m: static, the grid covers |x| below it.
      half_y_m: static, the grid covers |y| below it.
      cell_m: static, edge of the cells.
      num_levels: static, cells in height, centred on the sensor; the end levels are open.
      num_iterations: static, mean shift iterations.
      bandwidth_m: standard deviation of the Gaussian window, m.
      num_std: t.
      min_density: least weight of a dense region; a point alone weighs 1.

    Returns:
      (N,) bool: valid and no outlier.

    Reference: paper, section 3.1 and figure 2; oracle `jaxbox.reference.filter_outliers`.
    """
    shape = (num_levels, round(2 * half_x_m / cell_m), round(2 * half_y_m / cell_m))
    origin = jnp.array([num_levels * cell_m / 2, half_x_m, half_y_m])

    def cell_of(points: jax.Array) -> jax.Array:
        z_x_y = (points[:, axis] for axis in (2, 0, 1))
        cell = jnp.zeros(points.shape[0], jnp.int32)
        for value, start, size in zip(z_x_y, origin, shape, strict=True):
            index = jnp.floor((value + start) / cell_m).astype(jnp.int32)
            cell = cell * size + jnp.clip(index, 0, size - 1)
        return cell

    neighbour_weight = jnp.exp(-0.5 * (cell_m / jnp.asarray(bandwidth_m)) ** 2)
    cells = cell_of(xyz)
    window = _window_means(xyz, valid, cells, shape, neighbour_weight)

    mode = window
    for _ in range(num_iterations - 1):
        there = window[cell_of(mode)]
        mode = jnp.where(there[:, 3:] > 0, there, mode)

    end = mode[cells]
    distance = jnp.sqrt(sum((xyz[:, axis] - end[:, axis]) ** 2 for axis in range(3)))
    threshold = masked_mean(distance, valid) + num_std * masked_std(distance, valid)
    return valid & (distance <= threshold) & (window[cells, 3] >= min_density)


def _window_means(
    xyz: jax.Array, valid: jax.Array, cells: jax.Array, shape: tuple[int, int, int], weight: jax.Array
) -> jax.Array:
    """(cells, 4): mean position (m) of the 3 x 3 x 3 window of every cell, and its weight."""
    rows = jnp.concatenate([xyz, jnp.ones_like(xyz[:, :1])], axis=1) * valid[:, None]
    sums = jnp.zeros((math.prod(shape), 4)).at[cells].add(rows).reshape(*shape, 4)
    for axis in range(3):
        # The window is a product over the axes: three passes of three taps give all 27.
        padded = jnp.pad(sums, [(1, 1) if a == axis else (0, 0) for a in range(4)])
        size = sums.shape[axis]
        before = jax.lax.slice_in_dim(padded, 0, size, axis=axis)
        after = jax.lax.slice_in_dim(padded, 2, size + 2, axis=axis)
        sums = sums + weight * (before + after)
    sums = sums.reshape(-1, 4)
    density = sums[:, 3:]
    return jnp.concatenate([sums[:, :3] / jnp.maximum(density, MIN_DENSITY), density], axis=1)
