"""Ground removal: RANSAC planes (paper, Algorithm I), and a ground grid for uneven roads."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.config.schema import GROUND_CANDIDATE_CELL_M
from jaxbox.types import GroundPlane
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.loops import store
from jaxbox.xla.masked import compact, count, greatest, lookup

HYPOTHESES_AT_A_TIME = 32
"""Planes tried together: few enough for their residuals to stay in the cache."""

MIN_SPREAD = 1e-4
"""Least determinant of the inliers' covariance, over the square of its trace, that tells a plane."""

FAR_FILL_WIDTH = 4
"""How much wider the wide Gaussian is, which fills where the narrow one has no ground cell."""

FAR_FILL_WEIGHT = 0.02
"""Weight of the wide Gaussian where the narrow one has no ground cell."""

FAR_FILL_PRIOR = 0.015
"""Weight of the plane itself where the wide Gaussian has none either."""

GOLDEN_RATIO_BITS = 0x9E3779B9
"""2^32 over the golden ratio: its multiples fill the 32 bits evenly."""

MINIMA_TABLES = 4
"""Tables of the lowest points, which the points take turns with: neighbours lie in one cell, and a processor
waits for what it has just written."""

POOL_CELLS = 2
"""The ground is smoothed on squares of so many cells: twice a cell is still no wider than the Gaussian."""

WIDE_POOL_CELLS = 8
"""The wide Gaussian works on squares of so many cells."""

GAUSSIAN_TRUNCATION = 3.0
"""Gaussians reach so many standard deviations, as in scipy.ndimage.gaussian_filter(truncate=3)."""


def cell_minima(
    xyz: jax.Array, mask: jax.Array, *, half_x_m: float, half_y_m: float
) -> tuple[jax.Array, jax.Array]:
    """The lowest point of each 1 m cell round the sensor: candidates for the ground.

    Args:
      xyz: (N, 3) float32, m, sensor frame.
      mask: (N,) bool, points that count.
      half_x_m: static, cells cover |x| below it.
      half_y_m: static, cells cover |y| below it.

    Returns:
      candidates: (C, 3) float32, m: the cell's centre and its lowest z; 0 where it is empty.
      occupied: (C,) bool.

    Reference: oracle `jaxbox.reference.cell_minima`.
    """
    columns = round(2 * half_y_m / GROUND_CANDIDATE_CELL_M)
    rows = round(2 * half_x_m / GROUND_CANDIDATE_CELL_M)
    inside = mask & (jnp.abs(xyz[:, 0]) < half_x_m) & (jnp.abs(xyz[:, 1]) < half_y_m)
    i = jnp.floor((xyz[:, 0] + half_x_m) / GROUND_CANDIDATE_CELL_M).astype(jnp.int32)
    j = jnp.floor((xyz[:, 1] + half_y_m) / GROUND_CANDIDATE_CELL_M).astype(jnp.int32)
    cell, num_cells = i * columns + j, rows * columns
    table = jnp.arange(xyz.shape[0], dtype=jnp.int32) % MINIMA_TABLES
    # What rounding puts past the last cell would be another table's.
    place = jnp.where(inside & (cell < num_cells), table * num_cells + cell, MINIMA_TABLES * num_cells)
    lowest = jnp.full(MINIMA_TABLES * num_cells, jnp.inf, jnp.float32).at[place].min(xyz[:, 2], mode="drop")
    lowest = jnp.min(lowest.reshape(MINIMA_TABLES, -1), axis=0)
    occupied = jnp.isfinite(lowest)
    i, j = np.indices((rows, columns), np.float32).reshape(2, -1)
    x = (i + 0.5) * GROUND_CANDIDATE_CELL_M - half_x_m
    y = (j + 0.5) * GROUND_CANDIDATE_CELL_M - half_y_m
    candidates = jnp.stack([x, y, jnp.where(occupied, lowest, 0)], axis=1)
    return candidates, occupied


def spread_points(
    xyz: jax.Array, mask: jax.Array, num_points: jax.Array, *, num_candidates: int
) -> tuple[jax.Array, jax.Array]:
    """Points spread evenly over the sweep: the paper's candidates for the ground.

    Args:
      xyz: (N, 3) float32, m, sensor frame.
      mask: (N,) bool, points that count.
      num_points: () int32, rows that are no padding.
      num_candidates: static, C.

    Returns:
      candidates: (C, 3) float32, m.
      chosen: (C,) bool: those that count.
    """
    # Quotient and remainder apart, so that the product stays within int32.
    rows = jnp.minimum(num_points, xyz.shape[0])
    j = jnp.arange(num_candidates, dtype=jnp.int32)
    index = j * (rows // num_candidates) + j * (rows % num_candidates) // num_candidates
    return xyz[index], mask[index] & (rows > 0)


def fit_ground_plane(
    candidates: jax.Array,
    mask: jax.Array,
    key: jax.Array,
    *,
    num_hypotheses: int,
    num_refits: int,
    tolerance_m: jax.Array | float,
    max_slope_deg: jax.Array | float,
    min_inlier_fraction: jax.Array | float,
    round_index: int = 0,
) -> GroundPlane:
    """The plane with the most support: RANSAC, all hypotheses at once, then refits on all inliers.

    A hypothesis is the plane z = a x + b y + c through three random candidates; its support is the
    number of candidates within the tolerance of it. Planes steeper than the gate have none.

    Args:
      candidates: (C, 3) float32, m.
      mask: (C,) bool.
      key: JAX random key; the same key gives the same bits.
      num_hypotheses: static, R.
      num_refits: static, least-squares refits of the best plane.
      tolerance_m: m.
      max_slope_deg: degrees.
      min_inlier_fraction: of the candidates.
      round_index: another round draws other samples from the same key.

    Returns:
      The plane; `found` is False, and the plane level through the lowest candidate (or z = 0 where
      there is none), when too few candidates agree.

    Reference: paper, Algorithm I; oracle `jaxbox.reference.fit_ground_plane`.
    """
    max_grade = jnp.tan(jnp.deg2rad(max_slope_deg))

    def is_near(plane: jax.Array) -> jax.Array:
        return mask & (jnp.abs(plane_residual(candidates, plane)) < tolerance_m)

    def support_of(plane: jax.Array) -> jax.Array:
        # In float32: sums of integers are several times slower (XLA, CPU).
        return jnp.sum(is_near(plane), dtype=jnp.float32)

    index, num = compact(mask, mask.shape[0])
    draws = _draw(key, round_index, (num_hypotheses, 3)) * num.astype(jnp.float32)
    picks = index[jnp.minimum(draws.astype(jnp.int32), jnp.maximum(num - 1, 0))]
    planes = jax.vmap(_plane_through)(candidates[jnp.minimum(picks, mask.shape[0] - 1)])
    support = (
        jax.vmap(support_of)(planes)
        if on_accelerator()
        else jax.lax.map(support_of, planes, batch_size=HYPOTHESES_AT_A_TIME)
    )
    support = jnp.where(_is_level(planes.T, max_grade), support, 0)
    best = planes[jax.lax.argmax(support, 0, jnp.int32)]
    refit = functools.partial(_refit, candidates)
    if on_accelerator():
        plane = functools.reduce(lambda p, _: refit(is_near(p), p), range(num_refits), best)
    else:
        plane, _ = jax.lax.scan(lambda p, _: (refit(is_near(p), p), None), best, length=num_refits)
    num_inliers = jnp.where(_is_level(plane, max_grade), count(is_near(plane)), 0)
    needed = min_inlier_fraction * num.astype(jnp.float32)
    found = (num_inliers >= 3) & (num_inliers.astype(jnp.float32) >= needed)
    lowest = -greatest(jnp.where(mask, -candidates[:, 2], -jnp.inf), -jnp.inf)
    level = jnp.array([0, 0, 1], jnp.float32) * jnp.where(jnp.isfinite(lowest), lowest, 0)
    return GroundPlane(jnp.where(found, plane, level), found, jnp.where(found, num_inliers, 0))


def fit_ground_planes(
    candidates: jax.Array,
    mask: jax.Array,
    key: jax.Array,
    *,
    max_planes: int,
    tolerance_m: jax.Array | float,
    **options: Any,
) -> tuple[GroundPlane, jax.Array]:
    """Fits plane after plane, each to the candidates that the ones before leave over.

    Args:
      candidates: (C, 3) float32, m.
      mask: (C,) bool.
      key: JAX random key.
      max_planes: static, rounds (Algorithm I, "repeat ... until all the points are covered").
      tolerance_m: m, see `fit_ground_plane`.
      **options: see `fit_ground_plane`.

    Returns:
      first: the first plane, which carries the most support.
      planes: (max_planes, 3) float32: all of them; the first again where a round found none.
    """
    fits: list[GroundPlane] = []
    planes = []
    for i in range(max_planes):
        plane = fit_ground_plane(candidates, mask, key, round_index=i, tolerance_m=tolerance_m, **options)
        fits.append(plane)
        planes.append(jnp.where(plane.found, plane.coefficients, fits[0].coefficients))
        covered = jnp.abs(plane_residual(candidates, plane.coefficients)) < tolerance_m
        mask = mask & ~(covered & plane.found)
    return fits[0], jnp.stack(planes)


def plane_residual(xyz: jax.Array, plane: jax.Array) -> jax.Array:
    """Height over a plane: z - (a x + b y + c).

    Args:
      xyz: (..., 3) float32, m.
      plane: (3,) float32: a, b, c.

    Returns:
      (...) float32, m.
    """
    return xyz[..., 2] - (plane[0] * xyz[..., 0] + plane[1] * xyz[..., 1] + plane[2])


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


def _draw(key: jax.Array, round_index: int, shape: tuple[int, int]) -> jax.Array:
    """Numbers in [0, 1), even enough for RANSAC: hashes of the key, far cheaper than `jax.random`."""
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


def _plane_through(corners: jax.Array) -> jax.Array:
    """Plane (a, b, c) through three points (3, 3); not finite where they are in a vertical plane."""
    normal = jnp.cross(corners[1] - corners[0], corners[2] - corners[0])
    a, b = -normal[0] / normal[2], -normal[1] / normal[2]
    return jnp.stack([a, b, corners[0, 2] - a * corners[0, 0] - b * corners[0, 1]])


def _is_level(plane: jax.Array, max_grade: jax.Array) -> jax.Array:
    # A plane that is not finite compares False, and so has no support.
    return jnp.hypot(plane[0], plane[1]) <= max_grade


def _refit(candidates: jax.Array, inliers: jax.Array, plane: jax.Array) -> jax.Array:
    """Least-squares plane through the inliers, about their mean: float32 sums would cancel else."""
    if on_accelerator():
        return _refit_residuals(candidates, inliers, plane)
    rows = candidates.T
    num = jnp.maximum(count(inliers), 1).astype(jnp.float32)
    mean = jnp.sum(jnp.where(inliers, rows, 0), axis=1) / num
    centred = jnp.where(inliers, rows - mean[:, None], 0)
    cov = jnp.sum(centred[:, None] * centred[None], axis=-1) / num
    determinant = cov[0, 0] * cov[1, 1] - cov[0, 1] ** 2
    a = (cov[0, 2] * cov[1, 1] - cov[1, 2] * cov[0, 1]) / determinant
    b = (cov[1, 2] * cov[0, 0] - cov[0, 2] * cov[0, 1]) / determinant
    refit = jnp.stack([a, b, mean[2] - a * mean[0] - b * mean[1]])
    # Inliers on one line leave the plane open: keep the one that they came from.
    spread = determinant > MIN_SPREAD * (cov[0, 0] + cov[1, 1]) ** 2
    return jnp.where(spread, refit, plane)


def _refit_residuals(candidates: jax.Array, inliers: jax.Array, plane: jax.Array) -> jax.Array:
    """As `_refit`, by one sum of all moments: of the residuals, which are small, none cancels."""
    x, y = candidates[:, 0], candidates[:, 1]
    r = plane_residual(candidates, plane)
    moments = jnp.stack([jnp.ones_like(x), x, y, r, x * x, x * y, y * y, x * r, y * r])
    num, *sums = jnp.sum(jnp.where(inliers, moments, 0), axis=1)
    mean_x, mean_y, mean_r, xx, xy, yy, xr, yr = (total / jnp.maximum(num, 1) for total in sums)
    xx, xy, yy = xx - mean_x**2, xy - mean_x * mean_y, yy - mean_y**2
    xr, yr = xr - mean_x * mean_r, yr - mean_y * mean_r
    determinant = xx * yy - xy**2
    a, b = (xr * yy - yr * xy) / determinant, (yr * xx - xr * xy) / determinant
    change = jnp.stack([a, b, mean_r - a * mean_x - b * mean_y])
    spread = determinant > MIN_SPREAD * (xx + yy) ** 2
    return plane + jnp.where(spread, change, 0)


def fit_ground_surface(
    xyz: jax.Array,
    mask: jax.Array,
    plane: jax.Array,
    *,
    cell_m: float,
    half_m: float,
    num_envelope_rounds: int,
    max_grade: jax.Array | float,
    band_below_m: jax.Array | float,
    band_below_grade: jax.Array | float,
    band_above_m: jax.Array | float,
    band_above_grade: jax.Array | float,
    blind_radius_m: jax.Array | float,
    envelope_margin_m: jax.Array | float,
    smoothing_m: jax.Array | float,
) -> jax.Array:
    """Height of the ground over the plane, on a grid, where the road is not flat.

    The lowest residual of each cell, where it lies near the plane, is ground if no ground cell near by
    is so much lower that the slope between would pass the limit; the rest is filled by Gaussians, on
    squares of cells.

    Args:
      xyz: (N, 3) float32, m.
      mask: (N,) bool, points that count.
      plane: (3,) float32.
      cell_m: static, edge of the cells.
      half_m: static, the grid covers |x|, |y| below it.
      num_envelope_rounds: static, cells over which the slope limit spreads.
      max_grade: the slope limit, m/m.
      band_below_m: how far below the plane a ground point may be, m.
      band_below_grade: growth of that with range, m/m.
      band_above_m: how far above, m.
      band_above_grade: growth of that with range, m/m.
      blind_radius_m: nearer points are the carrier vehicle, m.
      envelope_margin_m: how far above the envelope a ground cell may be, m.
      smoothing_m: standard deviation of the narrow Gaussian, m.

    Returns:
      (G, G) float32, m: height of the ground over the plane at the centres of squares of 2 x 2 cells.

    Reference: oracle `jaxbox.reference.fit_ground_surface`.
    """
    n = round(2 * half_m / cell_m)
    residual = plane_residual(xyz, plane)
    rho = jnp.sqrt(xyz[:, 0] ** 2 + xyz[:, 1] ** 2)
    near_plane = (residual > -band_below_m - band_below_grade * rho) & (
        residual < band_above_m + band_above_grade * rho
    )
    # Axis by axis: the compiler vectorises along the points, not along so short a row.
    i, j = (jnp.floor((xyz[:, axis] + half_m) / cell_m).astype(jnp.int32) for axis in (0, 1))
    inside = (i >= 0) & (i < n) & (j >= 0) & (j < n)
    cell = jnp.where(mask & near_plane & inside & (rho > blind_radius_m), i * n + j, n * n)
    lowest = jnp.full(n * n, jnp.inf, jnp.float32).at[cell].min(residual, mode="drop").reshape(n, n)
    envelope = _lower_envelope(lowest, max_grade * cell_m, num_envelope_rounds)
    ground = jnp.isfinite(lowest) & (lowest < envelope + envelope_margin_m)
    return _smooth(jnp.where(ground, lowest, 0), ground.astype(jnp.float32), smoothing_m / cell_m)


def _lower_envelope(lowest: jax.Array, step_m: jax.Array | float, num_rounds: int) -> jax.Array:
    """The highest surface below the cells that rises by at most `step_m` a cell, near each cell."""

    def spread(jump: int, envelope: jax.Array) -> jax.Array:
        size = envelope.shape[0] - 2 * jump
        at = [
            [envelope[i : i + size, j : j + size] for j in (0, jump, 2 * jump)] for i in (0, jump, 2 * jump)
        ]
        beside = jnp.minimum(jnp.minimum(at[0][1], at[2][1]), jnp.minimum(at[1][0], at[1][2]))
        across = jnp.minimum(jnp.minimum(at[0][0], at[0][2]), jnp.minimum(at[2][0], at[2][2]))
        rise = jump * step_m
        return jnp.minimum(at[1][1], jnp.minimum(beside + rise, across + math.sqrt(2) * rise))

    # The margin wears off jump by jump. No way between two cells is shorter for leading through it.
    envelope = jnp.pad(lowest, num_rounds, constant_values=jnp.inf)
    for jump in _jumps(num_rounds):
        # Stored, or the compiler works out each cell nine times for the next jump.
        envelope = store(spread(jump, envelope))
    return envelope


def _jumps(num_rounds: int) -> list[int]:
    """Jumps straight or across that lead wherever so many single steps do, at the same cost.

    >>> _jumps(10)
    [1, 1, 2, 2, 4]
    """
    jumps: list[int] = []
    while sum(jumps) < num_rounds:
        jumps.append(min(2 ** (len(jumps) // 2), num_rounds - sum(jumps)))
    return jumps


def _smooth(height: jax.Array, weight: jax.Array, sigma_cells: jax.Array | float) -> jax.Array:
    """Weighted Gaussian mean of the heights, filled from one so much wider, on pooled cells."""
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

    The Gaussian is separable, and a product with a matrix is the fastest convolution of a grid so small.
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


def surface_height(surface: jax.Array, xy: jax.Array, *, cell_m: float, half_m: float) -> jax.Array:
    """Height of the ground grid over the plane, bilinear between the centres of its squares.

    Args:
      surface: (G, G) float32, m.
      xy: (..., 2) float32, m; beyond the grid its border holds.
      cell_m: static, edge of the cells of `fit_ground_surface`.
      half_m: static, the grid covers |x|, |y| below it.

    Returns:
      (...) float32, m.
    """
    n = surface.shape[0]
    # Axis by axis: the compiler vectorises along the points, not along so short a row.
    at = [jnp.clip((xy[..., a] + half_m) / (POOL_CELLS * cell_m) - 0.5, 0, n - 1.001) for a in (0, 1)]
    i, j = (value.astype(jnp.int32) for value in at)
    u, v = at[0] - i.astype(jnp.float32), at[1] - j.astype(jnp.float32)
    near = lookup(surface, i, j) * (1 - v) + lookup(surface, i, j + 1) * v
    far = lookup(surface, i + 1, j) * (1 - v) + lookup(surface, i + 1, j + 1) * v
    return near * (1 - u) + far * u
