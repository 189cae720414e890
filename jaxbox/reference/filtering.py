"""Selection of the points to look at, and statistical filtering (paper, 3.1)."""

import numpy as np
from scipy import ndimage

from jaxbox.config import FilterConfig, RegionConfig
from jaxbox.reference.state import Sweep

MAX_ABS_Z_M = 100.0
"""No road or vehicle in range is this far above or below the sensor."""


def select_points(xyz: np.ndarray, config: FilterConfig, region: RegionConfig) -> Sweep:
    """Picks the finite points in the region, and those of them that are not outliers.

    Args:
      xyz: (n, 3) m, sensor frame; NaN and infinity allowed.
      config: of the filter.
      region: |x| and |y| below its halves; |z| is below 100 m.

    Returns:
      The points, and what each of them is.
    """
    finite = np.isfinite(xyz).all(axis=1).astype(bool)
    within = (np.abs(xyz[:, 0]) < region.half_x_m) & (np.abs(xyz[:, 1]) < region.half_y_m)
    in_region = finite & within & (np.abs(xyz[:, 2]) < MAX_ABS_Z_M)
    inlier = in_region.copy()
    if config.enabled:
        inlier[in_region] = filter_outliers(xyz[in_region], config, region)
    return Sweep(xyz, finite, in_region, inlier)


def filter_outliers(xyz: np.ndarray, config: FilterConfig, region: RegionConfig) -> np.ndarray:
    """Mean shift on a grid; points far from their converged centroid, or alone, are outliers.

    The window of a point is its cell and the 26 cells around, weighted (w, 1, w) along each axis
    with w = exp(-(cell / bandwidth)^2 / 2). A point moves to its window's centroid, then to the
    centroid of the window there, and so on; d is how far it got. Inliers have at least min_density of
    weight in their own window, and d <= mean(d) + num_std std(d) over all points with such a window.

    Args:
      xyz: (n, 3) finite, m, sensor frame, within the region.
      config: t of the paper is `num_std`; the grid's levels in height are centred on z = 0, and points
        beyond join the end levels.
      region: that the grid covers.

    Returns:
      (n,) bool, True for inliers.
    """
    if len(xyz) == 0:
        return np.zeros(0, bool)
    cell_m, num_levels = config.cell_m, config.num_levels
    half_x_m, half_y_m = region.half_x_m, region.half_y_m
    shape = np.array([round(2 * half_x_m / cell_m), round(2 * half_y_m / cell_m), num_levels])
    half = np.array([half_x_m, half_y_m, num_levels * cell_m / 2])

    def cell_of(points: np.ndarray) -> tuple[np.ndarray, ...]:
        index = np.clip(np.floor((points + half) / cell_m), 0, shape - 1).astype(int)
        return tuple(index.T)

    xyz = xyz.astype(np.float64)
    side_weight = float(np.exp(-0.5 * (cell_m / config.bandwidth_m) ** 2))
    centroid, density = _window_means(xyz, cell_of(xyz), tuple(shape), side_weight)
    mode = centroid[cell_of(xyz)]
    for _ in range(config.num_iterations - 1):
        mode = centroid[cell_of(mode)]
    distance = np.linalg.norm(xyz - mode, axis=1)
    inlier = density[cell_of(xyz)] >= config.min_density
    if inlier.any():
        inlier &= distance <= distance[inlier].mean() + config.num_std * distance[inlier].std()
    return inlier


def _window_means(
    xyz: np.ndarray, cell: tuple[np.ndarray, ...], shape: tuple[int, ...], side_weight: float
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted centroid (X, Y, Z, 3) and weight (X, Y, Z) of the points in each cell's window."""
    sums = np.zeros((*shape, 4))
    np.add.at(sums, cell, np.column_stack([xyz, np.ones(len(xyz))]))
    for axis in range(3):
        sums = ndimage.correlate1d(sums, [side_weight, 1.0, side_weight], axis=axis, mode="constant")
    density = sums[..., 3]
    occupied = density > 0
    centroid = sums[..., :3] / np.where(occupied, density, 1.0)[..., None]
    return centroid, density
