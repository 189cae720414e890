"""Ground: RANSAC plane (paper, Algorithm I), and the grid that follows uneven roads."""

import numpy as np
from scipy import ndimage

DIAGONAL_STEP = np.sqrt(2)
"""Diagonal neighbours are this many cells away."""
WIDE_FACTOR = 4.0
"""The grid is filled where it is empty by a Gaussian this many times wider."""
WIDE_WEIGHT = 0.015
"""Weight of "no deviation from the plane" in the wide Gaussian."""
NARROW_WEIGHT = 0.02
"""Weight of the wide Gaussian in the narrow one."""
POOL_CELLS = 2
"""The grid is smoothed on squares of so many cells, and is theirs."""
WIDE_POOL_CELLS = 8
"""So many for the wide Gaussian."""
TRUNCATE = 3.0
"""The Gaussians end at this many standard deviations."""
MIN_PLANE_POINTS = 3
"""A plane has three degrees of freedom."""


def cell_minima(xyz: np.ndarray, *, half_x_m: float, half_y_m: float, cell_m: float = 1.0) -> np.ndarray:
    """Lowest point of each occupied cell: the candidates for the ground.

    Args:
      xyz: (n, 3) finite, m, sensor frame.
      half_x_m: cells cover |x| below this.
      half_y_m: cells cover |y| below this.
      cell_m: edge of the cells.

    Returns:
      (m, 3) m: x and y of the cell's centre, and its lowest z; cells in row-major order.
    """
    xyz = xyz[(np.abs(xyz[:, 0]) < half_x_m) & (np.abs(xyz[:, 1]) < half_y_m)].astype(np.float64)
    half = np.array([half_x_m, half_y_m])
    index = np.floor((xyz[:, :2] + half) / cell_m).astype(int)
    shape = np.ceil(2 * half / cell_m).astype(int) + 1
    lowest = np.full(shape, np.inf)
    np.minimum.at(lowest, tuple(index.T), xyz[:, 2])
    row, column = np.nonzero(np.isfinite(lowest))
    center = (np.column_stack([row, column]) + 0.5) * cell_m - half
    return np.column_stack([center, lowest[row, column]])


def spread_candidates(xyz: np.ndarray, inlier: np.ndarray, *, num_candidates: int) -> np.ndarray:
    """Inliers among points spread evenly over the sweep.

    Args:
      xyz: (n, 3) m, the whole sweep.
      inlier: (n,) bool.
      num_candidates: rows looked at: floor(j n / num_candidates).

    Returns:
      (m, 3) m, m <= num_candidates; rows repeat where n is smaller.
    """
    rows = np.arange(num_candidates) * len(xyz) // num_candidates if len(xyz) else np.zeros(0, int)
    return xyz[rows[inlier[rows]]].astype(np.float64)


def fit_ground_plane(
    candidates: np.ndarray,
    *,
    rng: np.random.Generator,
    num_hypotheses: int,
    num_refits: int,
    tolerance_m: float,
    max_slope_deg: float,
    min_inlier_fraction: float,
) -> tuple[np.ndarray, bool, int]:
    """The plane z = a x + b y + c with the most candidates within the tolerance (RANSAC).

    Args:
      candidates: (m, 3) m.
      rng: source of the samples of three.
      num_hypotheses: samples drawn.
      num_refits: least-squares refits of the best plane on its inliers.
      tolerance_m: vertical distance of an inlier, exclusive.
      max_slope_deg: steeper planes are not considered.
      min_inlier_fraction: share of the candidates that the plane must hold.

    Returns:
      (a, b, c), whether such a plane was found, and its number of inliers. Where none was found
      the plane is level, at the lowest candidate (0 without candidates).

    Reference:
      Fischler and Bolles 1981; paper, Algorithm I.
    """
    max_slope = np.tan(np.radians(max_slope_deg))
    level = np.array([0.0, 0.0, candidates[:, 2].min() if len(candidates) else 0.0])
    best, best_support = None, -1
    for _ in range(num_hypotheses if len(candidates) else 0):
        plane = _plane_through(candidates[rng.integers(0, len(candidates), 3)])
        if plane is None or np.hypot(plane[0], plane[1]) > max_slope:
            continue
        support = int(_inliers(candidates, plane, tolerance_m).sum())
        if support > best_support:
            best, best_support = plane, support
    if best is None:
        return level, False, int(_inliers(candidates, level, tolerance_m).sum())
    for _ in range(num_refits):
        best = _refit(candidates[_inliers(candidates, best, tolerance_m)], best)
    num_inliers = int(_inliers(candidates, best, tolerance_m).sum())
    enough = num_inliers >= max(MIN_PLANE_POINTS, min_inlier_fraction * len(candidates))
    if not enough or np.hypot(best[0], best[1]) > max_slope:
        return level, False, int(_inliers(candidates, level, tolerance_m).sum())
    return best, True, num_inliers


def _plane_through(triangle: np.ndarray) -> np.ndarray | None:
    """The plane through three points, or None where they do not span one over x, y."""
    normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
    # Twice the triangle's area in the bird's-eye view, m^2: below it the slopes are noise.
    if abs(normal[2]) < 1e-9:
        return None
    slopes = -normal[:2] / normal[2]
    return np.append(slopes, triangle[0, 2] - slopes @ triangle[0, :2])


def _inliers(candidates: np.ndarray, plane: np.ndarray, tolerance_m: float) -> np.ndarray:
    return np.abs(candidates[:, 2] - candidates[:, :2] @ plane[:2] - plane[2]) < tolerance_m


def _refit(points: np.ndarray, plane: np.ndarray) -> np.ndarray:
    if len(points) < MIN_PLANE_POINTS:
        return plane
    mean = points.mean(axis=0)
    centred = points - mean
    slopes = np.linalg.lstsq(centred[:, :2], centred[:, 2], rcond=None)[0]
    return np.append(slopes, mean[2] - slopes @ mean[:2])


def fit_ground_planes(
    candidates: np.ndarray, *, max_planes: int, tolerance_m: float, **options
) -> list[tuple[np.ndarray, bool, int]]:
    """Repeats `fit_ground_plane` on the candidates that no plane holds yet (Algorithm I, "repeat").

    Args:
      candidates: (m, 3) m.
      max_planes: rounds, at least 1.
      tolerance_m: as in `fit_ground_plane`.
      **options: as in `fit_ground_plane`.

    Returns:
      The first plane, found or not, and each further plane that was found.
    """
    fits = [fit_ground_plane(candidates, tolerance_m=tolerance_m, **options)]
    while fits[-1][1] and len(fits) < max_planes:
        candidates = candidates[~_inliers(candidates, fits[-1][0], tolerance_m)]
        fits.append(fit_ground_plane(candidates, tolerance_m=tolerance_m, **options))
    return fits[:1] + [fit for fit in fits[1:] if fit[1]]


def plane_elevation(xyz: np.ndarray, coefficients: np.ndarray, *, min_height_m: float = 0.0) -> np.ndarray:
    """z of the plane under each point: the highest that is at most min_height_m above it.

    Args:
      xyz: (n, 3) m.
      coefficients: (3,) or (planes, 3).
      min_height_m: slack for points of the ground itself; of no effect with one plane.

    Returns:
      (n,) m. Below all planes it is the lowest of them.
    """
    planes = np.atleast_2d(coefficients)
    elevation = planes[:, :2] @ xyz[:, :2].T + planes[:, 2:]
    under = elevation <= xyz[:, 2] + min_height_m
    highest = np.where(under, elevation, -np.inf).max(axis=0)
    return np.where(under.any(axis=0), highest, elevation.min(axis=0))


def fit_ground_surface(
    xyz: np.ndarray,
    coefficients: np.ndarray,
    *,
    cell_m: float,
    half_m: float,
    num_envelope_rounds: int,
    max_grade: float,
    band_below_m: float,
    band_below_grade: float,
    band_above_m: float,
    band_above_grade: float,
    blind_radius_m: float,
    envelope_margin_m: float,
    smoothing_m: float,
    min_height_m: float = 0.0,
) -> np.ndarray:
    """Deviation of the ground from the plane on a grid.

    Cell minima of the points near the plane, kept where they are within the margin of their lower
    envelope of limited slope, then smoothed on squares of cells; empty ones are filled from 4 times
    farther away and, beyond that, with the plane itself.

    Args:
      xyz: (n, 3) finite, m, sensor frame.
      coefficients: (3,) or (planes, 3).
      cell_m: edge of the grid's cells.
      half_m: the grid covers |x|, |y| below this.
      num_envelope_rounds: cells over which the slope limit spreads.
      max_grade: steepest slope of the envelope, m/m.
      band_below_m: points lower than this below the plane, plus the grade times the range, are no ground.
      band_below_grade: see there.
      band_above_m: points higher than this above the plane, plus the grade times the range, are no ground.
      band_above_grade: see there.
      blind_radius_m: nearer points are no ground.
      envelope_margin_m: highest ground above the envelope, exclusive.
      smoothing_m: standard deviation of the Gaussian.
      min_height_m: as in `plane_elevation`.

    Returns:
      (X, Y) m, at the centres of squares of 2 x 2 cells.
    """
    num_cells = int(2 * half_m / cell_m)
    deviation = xyz[:, 2] - plane_elevation(xyz, coefficients, min_height_m=min_height_m)
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    index = np.floor((xyz[:, :2] + half_m) / cell_m).astype(int)
    ground = ((index >= 0) & (index < num_cells)).all(axis=1) & (rho > blind_radius_m)
    ground &= deviation > -(band_below_m + band_below_grade * rho)
    ground &= deviation < band_above_m + band_above_grade * rho
    lowest = np.full((num_cells, num_cells), np.inf)
    np.minimum.at(lowest, tuple(index[ground].T), deviation[ground])
    envelope = _lower_envelope(lowest, step=max_grade * cell_m, num_rounds=num_envelope_rounds)
    # Empty cells are inf on both sides, which is not below.
    return _fill_and_smooth(lowest, lowest < envelope + envelope_margin_m, sigma=smoothing_m / cell_m)


def _lower_envelope(lowest: np.ndarray, *, step: float, num_rounds: int) -> np.ndarray:
    """Lowers each cell to at most one step above its lowest neighbour, round after round."""
    far = DIAGONAL_STEP * step
    rise = np.array([[far, step, far], [step, 0.0, step], [far, step, far]])
    envelope = lowest
    for _ in range(num_rounds):
        padded = np.pad(envelope, 1, constant_values=np.inf)
        windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
        envelope = (windows + rise).min(axis=(2, 3))
    return envelope


def _fill_and_smooth(lowest: np.ndarray, valid: np.ndarray, *, sigma: float) -> np.ndarray:
    value, weight = _pool(np.where(valid, lowest, 0.0), POOL_CELLS), _pool(valid, POOL_CELLS)
    ratio = WIDE_POOL_CELLS // POOL_CELLS

    def narrow(grid: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(grid, sigma / POOL_CELLS, truncate=TRUNCATE, mode="constant")

    def wide(grid: np.ndarray) -> np.ndarray:
        sigma_squares = WIDE_FACTOR * sigma / WIDE_POOL_CELLS
        return ndimage.gaussian_filter(_pool(grid, ratio), sigma_squares, truncate=TRUNCATE, mode="constant")

    at = (np.arange(len(value)) + 0.5) / ratio - 0.5
    fill = ndimage.map_coordinates(
        wide(value) / (wide(weight) + WIDE_WEIGHT),
        np.meshgrid(at, at, indexing="ij"),
        order=1,
        mode="nearest",
    )
    return (narrow(value) + NARROW_WEIGHT * fill) / (narrow(weight) + NARROW_WEIGHT)


def _pool(grid: np.ndarray, size: int) -> np.ndarray:
    """Means over squares of cells; 0 beyond the border."""
    grid = np.pad(grid.astype(np.float64), (0, -len(grid) % size))
    return grid.reshape(len(grid) // size, size, -1, size).mean(axis=(1, 3))


def surface_deviation(xy: np.ndarray, grid: np.ndarray, *, cell_m: float, half_m: float) -> np.ndarray:
    """Bilinear interpolation of the grid; its border value holds beyond it.

    Args:
      xy: (n, 2) m.
      grid: (X, Y) m, at the centres of the cells.
      cell_m: edge of the cells.
      half_m: the grid covers |x|, |y| below this.

    Returns:
      (n,) m.
    """
    position = ((xy + half_m) / cell_m - 0.5).T
    return ndimage.map_coordinates(grid, position, order=1, mode="nearest")


def ground_elevation(
    xyz: np.ndarray,
    coefficients: np.ndarray,
    grid: np.ndarray | None,
    *,
    cell_m: float,
    half_m: float,
    min_height_m: float = 0.0,
) -> np.ndarray:
    """z of the ground under points: the plane and the surface's deviation from it.

    Args:
      xyz: (n, 3) m; z only matters with several planes.
      coefficients: (3,) or (planes, 3).
      grid: (X, Y) m, or None for the plane alone.
      cell_m: edge of the cells of `fit_ground_surface`.
      half_m: the grid covers |x|, |y| below this.
      min_height_m: as in `plane_elevation`.

    Returns:
      (n,) m.
    """
    elevation = plane_elevation(xyz, coefficients, min_height_m=min_height_m)
    if grid is None:
        return elevation
    return elevation + surface_deviation(xyz[:, :2], grid, cell_m=POOL_CELLS * cell_m, half_m=half_m)


def height_above_ground(
    xyz: np.ndarray,
    coefficients: np.ndarray,
    grid: np.ndarray | None,
    *,
    cell_m: float,
    half_m: float,
    min_height_m: float = 0.0,
) -> np.ndarray:
    """Height of points above the ground; the arguments are those of `ground_elevation`.

    Returns:
      (n,) m.
    """
    elevation = ground_elevation(
        xyz, coefficients, grid, cell_m=cell_m, half_m=half_m, min_height_m=min_height_m
    )
    return xyz[:, 2] - elevation
