"""Ground removal: RANSAC planes (paper, Algorithm I), and a ground grid for uneven roads."""

import functools
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.config import DetectorConfig, GroundConfig
from jaxbox.config.capacities import obstacle_capacity
from jaxbox.config.schema import GROUND_CANDIDATE_CELL_M
from jaxbox.geometry.planar import plane_residual
from jaxbox.stages._sheets import on_sheets
from jaxbox.stages._support import PLANE_LEVELS, SENSOR_LEVELS, in_pits, least_supported, levels_with_area
from jaxbox.stages.state import Ground, Obstacles, Sweep
from jaxbox.types import GroundPlane
from jaxbox.xla import chunks
from jaxbox.xla.barriers import store
from jaxbox.xla.hashing import hashed_uniform
from jaxbox.xla.indexing import lookup_corners, take
from jaxbox.xla.least_squares import refit_plane
from jaxbox.xla.loops import apply_in_turn, map_batches, repeat
from jaxbox.xla.rows import compact, count_true, maximum
from jaxbox.xla.segments import segment_minima

FAR_FILL_WIDTH = 4
"""How much wider the wide Gaussian is, which fills where the narrow one has no ground cell."""


FAR_FILL_WEIGHT, FAR_FILL_PRIOR = 0.02, 0.015
"""Weight of the wide Gaussian where the narrow one has no ground cell, and of the plane itself where the wide
Gaussian has none either."""


POOL_CELLS = 2
"""The ground is smoothed on squares of that many cells: twice a cell is still no wider than the Gaussian."""


WIDE_POOL_CELLS = 8
"""The wide Gaussian works on squares of that many cells."""


GAUSSIAN_TRUNCATION = 3.0
"""Gaussians reach that many standard deviations, as in scipy.ndimage.gaussian_filter(truncate=3)."""


def remove_ground(sweep: Sweep, config: GroundConfig, key: jax.Array) -> Ground:
    """Fits the ground, and measures every point's height above it.

    Args:
      sweep: of N rows.
      config: of the ground.
      key: JAX random key; the same key gives the same bits.

    Returns:
      The ground and the heights.
    """
    chex.assert_shape([sweep.xyz1, sweep.inlier], [(None, 4), sweep.xyz1.shape[:1]])
    if config.candidates == "cell_minima":
        candidates, valid = cell_minima(sweep.xyz, sweep.inlier, config)
    else:
        candidates, valid = spread_points(sweep.xyz, sweep.inlier, sweep.num_points, config)
    plane, planes = fit_ground_planes(candidates, valid, key, config)
    surface = None
    if config.surface:
        surface = fit_ground_surface(sweep.xyz, sweep.inlier, planes, config)
    height = height_above_ground(sweep.xyz, planes, surface, config)
    return Ground(plane, planes, surface, height)


def gather_obstacles(sweep: Sweep, ground: Ground, config: DetectorConfig) -> Obstacles:
    """Compacts the points between the ground and the height of the tallest vehicle.

    Args:
      sweep: of N rows.
      ground: below them.
      config: of the detector: the heights, and the capacity O.

    Returns:
      The points, in the sweep's order; those beyond the capacity are dropped, and counted.
    """
    chex.assert_shape([sweep.inlier, ground.height], sweep.xyz.shape[:1])
    low_m, high_m = config.ground.min_height_m, config.ground.max_height_m
    between = (ground.height > low_m) & (ground.height < high_m)
    row, count = compact(sweep.inlier & between, obstacle_capacity(config, sweep.xyz.shape[0]))
    xyz, height = take(sweep.xyz, row), take(ground.height, row)
    *xy, z, height = store((*xyz.T, height))
    return Obstacles(row, jnp.stack(xy, axis=1), z, height, count, sweep.xyz.shape[0])


def height_above_ground(
    xyz: jax.Array, planes: jax.Array, surface: jax.Array | None, config: GroundConfig
) -> jax.Array:
    """Height above the planes, or above the ground grid where there is one.

    Args:
      xyz: (N, 3) float32, m.
      planes: (rounds, 3) float32.
      surface: (G, G) float32, m, or None.
      config: of the ground.

    Returns:
      (N,) float32, m.
    """
    height = height_above_planes(xyz, planes, tolerance_m=config.min_height_m)
    if surface is None:
        return height
    return height - surface_height(surface, xyz[:, :2], config)


def ground_elevation(
    xyz: jax.Array, planes: jax.Array, surface: jax.Array | None, config: GroundConfig
) -> jax.Array:
    """z of the ground under points: of the planes, and the ground grid over them.

    Args:
      xyz: (N, 3) float32, m; z only matters with several planes.
      planes: (rounds, 3) float32.
      surface: (G, G) float32, m, or None.
      config: of the ground.

    Returns:
      (N,) float32, m.

    Reference: oracle `jaxbox.reference.ground_elevation`.
    """
    return xyz[:, 2] - height_above_ground(xyz, planes, surface, config)


def cell_minima(xyz: jax.Array, mask: jax.Array, config: GroundConfig) -> tuple[jax.Array, jax.Array]:
    """The lowest point of each 1 m cell round the sensor: candidates for the ground.

    Args:
      xyz: (N, 3) float32, m, sensor frame.
      mask: (N,) bool, points that count.
      config: how far the cells reach.

    Returns:
      candidates: (C, 3) float32, m: the cell's centre and its lowest z; 0 where it is empty.
      occupied: (C,) bool.

    Reference: oracle `jaxbox.reference.cell_minima`.
    """
    half_x_m, half_y_m = config.candidate_half_x_m, config.candidate_half_y_m
    columns = round(2 * half_y_m / GROUND_CANDIDATE_CELL_M)
    rows = round(2 * half_x_m / GROUND_CANDIDATE_CELL_M)
    inside = mask & (jnp.abs(xyz[:, 0]) < half_x_m) & (jnp.abs(xyz[:, 1]) < half_y_m)
    i = jnp.floor((xyz[:, 0] + half_x_m) / GROUND_CANDIDATE_CELL_M).astype(jnp.int32)
    j = jnp.floor((xyz[:, 1] + half_y_m) / GROUND_CANDIDATE_CELL_M).astype(jnp.int32)
    halves_m = half_x_m, half_y_m
    inside &= xyz[:, 2] >= least_supported(xyz[:, 2], xyz[:, :2], inside, halves_m, SENSOR_LEVELS, config)
    lowest = segment_minima(xyz[:, 2], i * columns + j, inside, num_segments=rows * columns)
    occupied = jnp.isfinite(lowest)
    i, j = np.indices((rows, columns), np.float32).reshape(2, -1)
    x = (i + 0.5) * GROUND_CANDIDATE_CELL_M - half_x_m
    y = (j + 0.5) * GROUND_CANDIDATE_CELL_M - half_y_m
    candidates = jnp.stack([x, y, jnp.where(occupied, lowest, 0)], axis=1)
    return candidates, occupied


def spread_points(
    xyz: jax.Array, mask: jax.Array, num_points: jax.Array, config: GroundConfig
) -> tuple[jax.Array, jax.Array]:
    """Points spread evenly over the sweep: the paper's candidates for the ground.

    Args:
      xyz: (N, 3) float32, m, sensor frame.
      mask: (N,) bool, points that count.
      num_points: () int32, rows that are not padding.
      config: `num_candidates` is C.

    Returns:
      candidates: (C, 3) float32, m.
      chosen: (C,) bool: those that count.
    """
    # Quotient and remainder apart, so that the product stays within int32.
    num_candidates = config.num_candidates
    rows = jnp.minimum(num_points, xyz.shape[0])
    j = jnp.arange(num_candidates, dtype=jnp.int32)
    index = j * (rows // num_candidates) + j * (rows % num_candidates) // num_candidates
    return xyz[index], mask[index] & (rows > 0)


def fit_ground_plane(
    candidates: jax.Array, mask: jax.Array, key: jax.Array, config: GroundConfig, *, round_index: int = 0
) -> GroundPlane:
    """The plane with the most support: RANSAC, all hypotheses in parallel, then refits on all inliers.

    A hypothesis is the plane z = a x + b y + c through three random candidates; its support is the
    number of candidates within the tolerance of it. Planes steeper than the gate have none.

    Args:
      candidates: (C, 3) float32, m.
      mask: (C,) bool.
      key: JAX random key; the same key gives the same bits.
      config: R hypotheses, the tolerance, and the gates.
      round_index: another round draws other samples from the same key.

    Returns:
      The plane; `found` is False, and the plane level through the lowest candidate (or z = 0 where
      there is none), when too few candidates agree.

    Reference: paper, Algorithm I; oracle `jaxbox.reference.fit_ground_plane`.
    """
    max_grade = jnp.tan(jnp.deg2rad(config.max_slope_deg))

    def is_near(plane: jax.Array) -> jax.Array:
        return mask & (jnp.abs(plane_residual(candidates, plane)) < config.tolerance_m)

    def support_of(plane: jax.Array) -> jax.Array:
        return jnp.sum(is_near(plane), dtype=jnp.float32)

    index, num = compact(mask, mask.shape[0])
    draws = hashed_uniform(key, round_index, (config.num_hypotheses, 3)) * num.astype(jnp.float32)
    picks = index[jnp.minimum(draws.astype(jnp.int32), jnp.maximum(num - 1, 0))]
    planes = jax.vmap(_plane_through)(candidates[jnp.minimum(picks, mask.shape[0] - 1)])
    support = map_batches(support_of, planes, chunk=chunks.PLANES)
    support = jnp.where(_is_level(planes.T, max_grade), support, 0)
    best = planes[jax.lax.argmax(support, 0, jnp.int32)]
    plane = repeat(lambda plane: refit_plane(candidates, is_near(plane), plane), best, config.num_refits)
    num_inliers = jnp.where(_is_level(plane, max_grade), count_true(is_near(plane)), 0)
    needed = config.min_inlier_fraction * num.astype(jnp.float32)
    found = (num_inliers >= 3) & (num_inliers.astype(jnp.float32) >= needed)
    lowest = -maximum(jnp.where(mask, -candidates[:, 2], -jnp.inf), -jnp.inf)
    level = jnp.array([0, 0, 1], jnp.float32) * jnp.where(jnp.isfinite(lowest), lowest, 0)
    return GroundPlane(jnp.where(found, plane, level), found, jnp.where(found, num_inliers, 0))


def fit_ground_planes(
    candidates: jax.Array, mask: jax.Array, key: jax.Array, config: GroundConfig
) -> tuple[GroundPlane, jax.Array]:
    """Fits plane after plane, each to the candidates that the ones before leave over.

    Args:
      candidates: (C, 3) float32, m.
      mask: (C,) bool.
      key: JAX random key.
      config: `max_planes` rounds (Algorithm I, "repeat ... until all the points are covered").

    Returns:
      first: the first plane, which carries the most support.
      planes: (max_planes, 3) float32: all of them; the first again where a round found none.
    """
    fits: list[GroundPlane] = []
    planes = []
    for i in range(config.max_planes):
        plane = fit_ground_plane(candidates, mask, key, config, round_index=i)
        fits.append(plane)
        planes.append(jnp.where(plane.found, plane.coefficients, fits[0].coefficients))
        covered = jnp.abs(plane_residual(candidates, plane.coefficients)) < config.tolerance_m
        mask = mask & ~(covered & plane.found)
    return fits[0], jnp.stack(planes)


def height_above_planes(xyz: jax.Array, planes: jax.Array, *, tolerance_m: jax.Array | float) -> jax.Array:
    """Height over the highest plane that a point is not below (by more than the tolerance).

    Args:
      xyz: (N, 3) float32, m.
      planes: (P, 3) float32.
      tolerance_m: m.

    Returns:
      (N,) float32, m; a point below all planes gets its height over the lowest one there.
    """
    if planes.shape[0] == 1:
        return plane_residual(xyz, planes[0])
    residual = jnp.stack([plane_residual(xyz, plane) for plane in planes])
    above = jnp.min(jnp.where(residual >= -tolerance_m, residual, jnp.inf), axis=0)
    return jnp.where(jnp.isfinite(above), above, jnp.max(residual, axis=0))


def _plane_through(corners: jax.Array) -> jax.Array:
    """Plane (a, b, c) through three points (3, 3); not finite where they are in a vertical plane."""
    normal = jnp.cross(corners[1] - corners[0], corners[2] - corners[0])
    a, b = -normal[0] / normal[2], -normal[1] / normal[2]
    return jnp.stack([a, b, corners[0, 2] - a * corners[0, 0] - b * corners[0, 1]])


def _is_level(plane: jax.Array, max_grade: jax.Array) -> jax.Array:
    # A plane that is not finite compares False, and so has no support.
    return jnp.hypot(plane[0], plane[1]) <= max_grade


def fit_ground_surface(xyz: jax.Array, mask: jax.Array, planes: jax.Array, config: GroundConfig) -> jax.Array:
    """Height of the ground over the planes, on a grid, where the road is not flat.

    The lowest height of each cell, where it lies near a plane, is ground if no ground cell near by
    is so much lower that the slope between would pass the limit; the rest is filled by Gaussians, on
    squares of cells.

    Args:
      xyz: (N, 3) float32, m.
      mask: (N,) bool, points that count.
      planes: (rounds, 3) float32; with several, a point is compared with the one under it.
      config: the grid, the band round a plane, the slope limit and the Gaussian.

    Returns:
      (G, G) float32, m: height of the ground over the planes at the centres of squares of 2 x 2 cells.

    Reference: oracle `jaxbox.reference.fit_ground_surface`.
    """
    cell_m, half_m = config.surface_cell_m, config.surface_half_m
    n = round(2 * half_m / cell_m)
    height = height_above_planes(xyz, planes, tolerance_m=config.min_height_m)
    rho = jnp.sqrt(xyz[:, 0] ** 2 + xyz[:, 1] ** 2)
    above_band = height >= config.band_above_m + config.band_above_grade * rho
    in_band = (height > -config.band_below_m - config.band_below_grade * rho) & ~above_band
    i, j = (jnp.floor((xyz[:, axis] + half_m) / cell_m).astype(jnp.int32) for axis in (0, 1))
    inside = (i >= 0) & (i < n) & (j >= 0) & (j < n)
    counted = mask & inside & (rho > config.blind_radius_m)
    of_band = counted & in_band
    lowest = segment_minima(height, i * n + j, of_band, num_segments=n * n).reshape(n, n)
    levels = levels_with_area(lowest, half_m, config)
    least = least_supported(height, xyz[:, :2], of_band, (half_m, half_m), PLANE_LEVELS, config, levels)
    may_be_sheet = above_band & (height < config.band_above_m + config.sheet_band_grade * rho)
    may_be_ground = counted & ((in_band & (height >= least)) | may_be_sheet)
    lowest = segment_minima(height, i * n + j, may_be_ground, num_segments=n * n).reshape(n, n)
    lowest = jnp.where(in_pits(lowest, config), jnp.inf, lowest)
    middle = jnp.arange(n, dtype=jnp.float32) * cell_m + (cell_m / 2 - half_m)
    rho = jnp.sqrt(middle[:, None] ** 2 + middle[None] ** 2)
    low = jnp.where(lowest < config.band_above_m + config.band_above_grade * rho, lowest, jnp.inf)
    envelope = _lower_envelope(low, config.max_grade * cell_m, config.num_envelope_rounds)
    ground = jnp.isfinite(low) & (low < envelope + config.envelope_margin_m)
    ground = ground | on_sheets(lowest, config)
    return _smooth(jnp.where(ground, lowest, 0), ground.astype(jnp.float32), config.smoothing_m / cell_m)


def _lower_envelope(lowest: jax.Array, step_m: jax.Array | float, num_rounds: int) -> jax.Array:
    """The highest surface below the cells that rises by at most `step_m` from cell to cell."""

    def spread(jump: int, envelope: jax.Array) -> jax.Array:
        size = envelope.shape[0] - 2 * jump
        at = [
            [envelope[i : i + size, j : j + size] for j in (0, jump, 2 * jump)] for i in (0, jump, 2 * jump)
        ]
        straight = jnp.minimum(jnp.minimum(at[0][1], at[2][1]), jnp.minimum(at[1][0], at[1][2]))
        diagonal = jnp.minimum(jnp.minimum(at[0][0], at[0][2]), jnp.minimum(at[2][0], at[2][2]))
        rise = jump * step_m
        return jnp.minimum(at[1][1], jnp.minimum(straight + rise, diagonal + math.sqrt(2) * rise))

    # Each jump cuts off part of the margin. No shortest path between two cells leads through it.
    envelope = jnp.pad(lowest, num_rounds, constant_values=jnp.inf)
    jumps = [functools.partial(spread, jump) for jump in _jumps(num_rounds)]
    return apply_in_turn(jumps, envelope)


def _jumps(num_rounds: int) -> list[int]:
    """Straight or diagonal jumps that reach all cells that as many single steps reach, at the same cost.

    >>> _jumps(10)
    [1, 1, 2, 2, 4]
    """
    jumps: list[int] = []
    while sum(jumps) < num_rounds:
        jumps.append(min(2 ** (len(jumps) // 2), num_rounds - sum(jumps)))
    return jumps


def _smooth(height: jax.Array, weight: jax.Array, sigma_cells: jax.Array | float) -> jax.Array:
    """Weighted Gaussian mean of the heights on pooled cells, filled by a wider one where cells are empty."""
    grids = [_pool(grid, POOL_CELLS) for grid in (height, weight)]
    ratio = WIDE_POOL_CELLS // POOL_CELLS
    near, near_weight = _blur(grids, sigma_cells / POOL_CELLS)
    far, far_weight = _blur(
        [_pool(grid, ratio) for grid in grids], FAR_FILL_WIDTH * sigma_cells / WIDE_POOL_CELLS
    )
    far = _enlarge(far / (far_weight + FAR_FILL_PRIOR), near.shape[0], ratio)
    return (near + FAR_FILL_WEIGHT * far) / (near_weight + FAR_FILL_WEIGHT)


def _pool(grid: jax.Array, size: int) -> jax.Array:
    """Means over squares of cells; cells beyond the border count as 0."""
    grid = jnp.pad(grid, (0, -grid.shape[0] % size))
    rows = functools.reduce(jnp.add, [grid[i::size] for i in range(size)])
    return functools.reduce(jnp.add, [rows[:, i::size] for i in range(size)]) / size**2


def _blur(grids: list[jax.Array], sigma_cells: jax.Array | float) -> tuple[jax.Array, jax.Array]:
    """Both grids blurred along both axes; cells beyond the border count as 0.

    The Gaussian is separable: a product with a matrix along each axis.
    """
    n = grids[0].shape[0]
    taps = _gaussian_taps(n, sigma_cells)
    index = jnp.arange(n, dtype=jnp.int32)
    matrix = taps[index[None] - index[:, None] + n - 1]
    product = functools.partial(jnp.matmul, precision="highest")
    rows = product(matrix, jnp.concatenate(grids, axis=1))
    blurred = product(rows.reshape(2 * n, n), matrix).reshape(n, 2, n)
    return blurred[:, 0], blurred[:, 1]


def _gaussian_taps(n: int, sigma: jax.Array | float) -> jax.Array:
    """(2 n - 1,) float32: the Gaussian from n - 1 cells before its middle to as many after."""
    offset = jnp.arange(-(n - 1), n, dtype=jnp.float32)
    reach = jnp.floor(GAUSSIAN_TRUNCATION * sigma + 0.5)
    taps = jnp.where(jnp.abs(offset) <= reach, jnp.exp(-0.5 * (offset / sigma) ** 2), 0)
    return taps / jnp.sum(taps)


def _enlarge(grid: jax.Array, size: int, ratio: int) -> jax.Array:
    """The grid on cells smaller by the ratio, bilinear between its own; its border holds beyond it."""
    n = grid.shape[0]
    row, own = jnp.arange(size, dtype=jnp.float32), jnp.arange(n, dtype=jnp.float32)
    at = jnp.clip((row + 0.5) / ratio - 0.5, 0, n - 1)
    matrix = jnp.maximum(1 - jnp.abs(at[:, None] - own[None]), 0)
    product = functools.partial(jnp.matmul, precision="highest")
    return product(product(matrix, grid), matrix.T)


def surface_height(surface: jax.Array, xy: jax.Array, config: GroundConfig) -> jax.Array:
    """Height of the ground grid over the planes, bilinear between the centres of its squares.

    Args:
      surface: (G, G) float32, m.
      xy: (..., 2) float32, m; beyond the grid its border holds.
      config: as `fit_ground_surface` had it.

    Returns:
      (...) float32, m.
    """
    n = surface.shape[0]
    half_m, square_m = config.surface_half_m, POOL_CELLS * config.surface_cell_m
    at = [jnp.clip((xy[..., a] + half_m) / square_m - 0.5, 0, n - 1.001) for a in (0, 1)]
    i, j = (value.astype(jnp.int32) for value in at)
    u, v = at[0] - i.astype(jnp.float32), at[1] - j.astype(jnp.float32)
    corners = lookup_corners(surface, i, j)
    near, far = (first * (1 - v) + second * v for first, second in (corners[:2], corners[2:]))
    return near * (1 - u) + far * u
