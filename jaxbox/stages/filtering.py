"""Statistical filtering by mean shift and standard deviation (paper, section 3.1)."""

import chex
import jax
import jax.numpy as jnp

from jaxbox.config import FilterConfig, RegionConfig
from jaxbox.stages.state import Sweep
from jaxbox.types import PointCloud
from jaxbox.xla import chunks
from jaxbox.xla.grids import map_cells, sum_cells, window_at, window_sums
from jaxbox.xla.rows import keep_rows, masked_mean, masked_std

MAX_ABS_Z_M = 100.0
"""Points farther above or below the sensor are errors of measurement: one alone would inflate the
deviation by which outliers are found, and beyond 1e19 m its square overflows."""


MIN_DENSITY = 1e-6
"""Windows with less weight are empty; the smallest of one point in a corner is exp(-1.5) or so."""


def select_points(cloud: PointCloud, config: FilterConfig, region: RegionConfig) -> Sweep:
    """Picks the finite points in the region, and those of them that are not outliers.

    Args:
      cloud: of N rows.
      config: of the filter.
      region: what is looked at.

    Returns:
      The points, and what each of them is.
    """
    chex.assert_shape([cloud.xyz1, cloud.num_points], [(None, 4), ()])
    xyz1, is_point, finite, in_region = _in_region(jnp.asarray(cloud.xyz1), region)
    inlier = filter_outliers(xyz1, config, region) if config.enabled else in_region
    return Sweep(xyz1, jnp.asarray(cloud.num_points), is_point, finite, in_region, inlier)


def _in_region(xyz1: jax.Array, region: RegionConfig) -> tuple[jax.Array, ...]:
    """The points within the region, and which are not padding, are finite, are within."""
    is_point = xyz1[:, 3] > 0
    finite = valid = is_point
    for axis, limit in enumerate((region.half_x_m, region.half_y_m, MAX_ABS_Z_M)):
        finite &= jnp.isfinite(xyz1[:, axis])
        valid &= jnp.abs(xyz1[:, axis]) < limit
    return keep_rows(xyz1, valid), is_point, finite, valid


def filter_outliers(xyz1: jax.Array, config: FilterConfig, region: RegionConfig) -> jax.Array:
    """Keeps the points that lie close to the dense region they shift to.

    Each point is shifted to the mean of the points around it, again and again, on a grid: all points
    of a cell share the Gaussian-weighted mean of the 3 x 3 x 3 cells round it. A point is an outlier where
    the weight of its window is below `min_density`, or where d > mean(d) + t std(d), with d the distance of
    a point to where its shift ends; mean and deviation are those of the other points.

    Args:
      xyz1: (N, 4) float32: x, y, z in m, sensor frame, and 1; zero where there is no point.
      config: t is `num_std`; the end levels of the grid in height are open.
      region: that the grid covers.

    Returns:
      (N,) bool: a point, and no outlier.

    Reference: paper, section 3.1 and figure 2; oracle `jaxbox.reference.filter_outliers`.
    """
    cell_m, num_levels = config.cell_m, config.num_levels
    num_x, num_y = round(2 * region.half_x_m / cell_m), round(2 * region.half_y_m / cell_m)
    half = (region.half_x_m, region.half_y_m, num_levels * cell_m / 2)
    # A line of cells along y for each x and level, with an empty cell before and some after it. Between the
    # lines of two x lies an empty one, which is margin to both.
    stride, margin = num_levels + 1, num_levels + 2
    width = -(-(num_y + 2) // chunks.FILTER_BLOCK_CELLS) * chunks.FILTER_BLOCK_CELLS

    def cell_of(points: jax.Array) -> jax.Array:
        x, y, z = (
            jnp.clip(jnp.floor((points[:, axis] + half[axis]) / cell_m).astype(jnp.int32), 0, size - 1)
            for axis, size in enumerate((num_x, num_y, num_levels))
        )
        return ((x * stride + z + margin) * width + y + 1).astype(jnp.uint32)

    valid = xyz1[:, 3] > 0
    # One sum for the places and the counts: a point ends with 1.
    cells, sums = sum_cells(cell_of, xyz1, num_cells=(num_x * stride + 2 * margin) * width)
    weight = jnp.exp(-0.5 * (cell_m / jnp.asarray(config.bandwidth_m, jnp.float32)) ** 2)
    windows = window_sums(sums.reshape(-1, 4 * width), stride, weight)

    def window_of(cell: jax.Array) -> jax.Array:
        return window_at(windows, (cell // width - margin) * (width - 2) + cell % width - 1)

    def shift(cell: jax.Array) -> jax.Array:
        """Where the points of a cell end; infinitely far if their window is too light."""
        window = window_of(cell)
        is_light = window[:, 3:] < config.min_density
        for _ in range(config.num_iterations - 1):
            window = window_of(cell_of(_mean(window)))
        return jnp.pad(jnp.where(is_light, jnp.inf, _mean(window)), ((0, 0), (0, 1)))

    ends = map_cells(shift, cells, sums)
    gap = [xyz1[:, axis] - ends[axis] for axis in range(3)]
    distance = jnp.sqrt(gap[0] ** 2 + gap[1] ** 2 + gap[2] ** 2)
    is_dense = valid & (distance < jnp.inf)
    threshold = masked_mean(distance, is_dense) + config.num_std * masked_std(distance, is_dense)
    return is_dense & (distance <= threshold)


def _mean(window: jax.Array) -> jax.Array:
    return window[:, :3] / jnp.maximum(window[:, 3:], MIN_DENSITY)
