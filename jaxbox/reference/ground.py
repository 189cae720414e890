"""Ground: RANSAC plane (paper, Algorithm I), and the grid that follows uneven roads."""

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from jaxbox.config import DetectorConfig, GroundConfig
from jaxbox.config.schema import GROUND_CANDIDATE_CELL_M
from jaxbox.reference.state import Ground, Obstacles, Sweep
from jaxbox.reference.support import PLANE_LEVELS, SENSOR_LEVELS, in_pits, least_supported, levels_with_area

DIAGONAL_STEP = np.sqrt(2)
"""Diagonal neighbours are this many cells away."""
WIDE_FACTOR = 4.0
"""The grid is filled where it is empty by a Gaussian this many times wider."""
WIDE_WEIGHT = 0.015
"""Weight of "no deviation from the plane" in the wide Gaussian."""
NARROW_WEIGHT = 0.02
"""Weight of the wide Gaussian in the narrow one."""
POOL_CELLS = 2
"""The grid is smoothed on squares of that many cells, and is theirs."""
WIDE_POOL_CELLS = 8
"""The wide Gaussian works on squares of that many cells."""
TRUNCATE = 3.0
"""The Gaussians end at this many standard deviations."""
SHEET_HALF_M, SHEET_REACH, MIN_SHEET_SQUARES = 40.0, 2, 17
"""Sheets are looked for this near, in windows of 5 x 5 squares of which so many are not empty."""
SHEET_STEP_M, SQUARE_TOLERANCE_M = 0.2, 0.1
"""Cells of a square are on its sheet up to the first above it, and a square on that of its window up to the
second off it."""
MIN_PLANE_POINTS = 3
"""A plane has three degrees of freedom."""


def remove_ground(sweep: Sweep, config: GroundConfig, rng: np.random.Generator) -> Ground:
    """Fits the ground, and measures the height of every inlier above it.

    Args:
      sweep: of n points.
      config: of the ground.
      rng: source of the samples of RANSAC.

    Returns:
      The ground and the heights.
    """
    xyz, inlier = sweep.xyz, sweep.inlier
    if config.candidates == "cell_minima":
        candidates = cell_minima(xyz[inlier], config)
    else:
        candidates = spread_points(xyz, inlier, config)
    fits = fit_ground_planes(candidates, config, rng=rng)
    planes = np.array([plane for plane, _, _ in fits])
    surface = fit_ground_surface(xyz[inlier], planes, config) if config.surface else None
    height = np.full(len(xyz), np.nan)
    height[inlier] = height_above_ground(xyz[inlier], planes, surface, config)
    return Ground(planes, fits[0][1], fits[0][2], surface, height)


def gather_obstacles(sweep: Sweep, ground: Ground, config: DetectorConfig) -> Obstacles:
    """Picks the points between the ground and the height of the tallest vehicle.

    Args:
      sweep: of n points.
      ground: below them.
      config: of the detector: the heights, both exclusive, and how many points at most.

    Returns:
      The points, in sweep order.
    """
    # NaN, the height of points that do not count, compares False.
    between = (ground.height > config.ground.min_height_m) & (ground.height < config.ground.max_height_m)
    rows = np.flatnonzero(sweep.inlier & between)
    return index_obstacles(sweep.xyz, ground.height, rows, max_obstacles=config.clustering.max_obstacles)


def index_obstacles(
    xyz: np.ndarray, height: np.ndarray, rows: np.ndarray, *, max_obstacles: int | None = None
) -> Obstacles:
    """Gathers points and indexes them by place.

    Args:
      xyz: (n, 3) m, the sweep.
      height: (n,) m above the ground.
      rows: (m,) int, the obstacles among them.
      max_obstacles: only the first of them are taken, as many as this; None takes all.

    Returns:
      The obstacles.
    """
    taken = rows[:max_obstacles]
    tree = KDTree(xyz[taken, :2]) if len(taken) else None
    return Obstacles(taken, xyz[taken], height[taken], len(rows), tree)


def cell_minima(xyz: np.ndarray, config: GroundConfig) -> np.ndarray:
    """Lowest point of each occupied cell of 1 m: the candidates for the ground.

    Args:
      xyz: (n, 3) finite, m, sensor frame.
      config: how far the cells reach.

    Returns:
      (m, 3) m: x and y of the cell's centre, and its lowest z; cells in row-major order.
    """
    half, cell_m = np.array([config.candidate_half_x_m, config.candidate_half_y_m]), GROUND_CANDIDATE_CELL_M
    xyz = xyz[(np.abs(xyz[:, :2]) < half).all(axis=1)].astype(np.float64)
    xyz = xyz[xyz[:, 2] >= least_supported(xyz[:, 2], xyz[:, :2], half, SENSOR_LEVELS, config)]
    index = np.floor((xyz[:, :2] + half) / cell_m).astype(int)
    shape = np.ceil(2 * half / cell_m).astype(int) + 1
    lowest = np.full(shape, np.inf)
    np.minimum.at(lowest, tuple(index.T), xyz[:, 2])
    row, column = np.nonzero(np.isfinite(lowest))
    center = (np.column_stack([row, column]) + 0.5) * cell_m - half
    return np.column_stack([center, lowest[row, column]])


def spread_points(xyz: np.ndarray, inlier: np.ndarray, config: GroundConfig) -> np.ndarray:
    """Inliers among points spread evenly over the sweep: the paper's candidates for the ground.

    Args:
      xyz: (n, 3) m, the whole sweep.
      inlier: (n,) bool.
      config: rows looked at are floor(j n / num_candidates).

    Returns:
      (m, 3) m, m <= num_candidates; rows repeat where n is smaller.
    """
    num = config.num_candidates
    rows = np.arange(num) * len(xyz) // num if len(xyz) else np.zeros(0, int)
    return xyz[rows[inlier[rows]]].astype(np.float64)


def fit_ground_plane(
    candidates: np.ndarray, config: GroundConfig, *, rng: np.random.Generator
) -> tuple[np.ndarray, bool, int]:
    """The plane z = a x + b y + c with the most candidates within the tolerance (RANSAC).

    Args:
      candidates: (m, 3) m.
      config: samples, refits on the inliers, the tolerance, which is exclusive, and the gates.
      rng: source of the samples of three.

    Returns:
      (a, b, c), whether such a plane was found, and its number of inliers. Where none was found
      the plane is level, at the lowest candidate (0 without candidates).

    Reference:
      Fischler and Bolles 1981; paper, Algorithm I.
    """
    tolerance_m = float(config.tolerance_m)
    max_slope = np.tan(np.radians(config.max_slope_deg))
    level = np.array([0.0, 0.0, candidates[:, 2].min() if len(candidates) else 0.0])
    best, best_support = None, -1
    for _ in range(config.num_hypotheses if len(candidates) else 0):
        plane = _plane_through(candidates[rng.integers(0, len(candidates), 3)])
        if plane is None or np.hypot(plane[0], plane[1]) > max_slope:
            continue
        support = int(_inliers(candidates, plane, tolerance_m).sum())
        if support > best_support:
            best, best_support = plane, support
    if best is None:
        return level, False, int(_inliers(candidates, level, tolerance_m).sum())
    for _ in range(config.num_refits):
        best = _refit(candidates[_inliers(candidates, best, tolerance_m)], best)
    num_inliers = int(_inliers(candidates, best, tolerance_m).sum())
    enough = num_inliers >= max(MIN_PLANE_POINTS, config.min_inlier_fraction * len(candidates))
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
    candidates: np.ndarray, config: GroundConfig, *, rng: np.random.Generator
) -> list[tuple[np.ndarray, bool, int]]:
    """Repeats `fit_ground_plane` on the candidates that no plane holds yet (Algorithm I, "repeat").

    Args:
      candidates: (m, 3) m.
      config: as in `fit_ground_plane`; at most `max_planes` rounds.
      rng: source of the samples.

    Returns:
      The first plane, found or not, and each further plane that was found.
    """
    fits = [fit_ground_plane(candidates, config, rng=rng)]
    while fits[-1][1] and len(fits) < config.max_planes:
        candidates = candidates[~_inliers(candidates, fits[-1][0], float(config.tolerance_m))]
        fits.append(fit_ground_plane(candidates, config, rng=rng))
    return fits[:1] + [fit for fit in fits[1:] if fit[1]]


def height_above_planes(xyz: np.ndarray, planes: np.ndarray, *, tolerance_m: float = 0.0) -> np.ndarray:
    """Height of points over the plane under each; the arguments are those of `plane_elevation`.

    Returns:
      (n,) m.
    """
    return xyz[:, 2] - plane_elevation(xyz, planes, tolerance_m=tolerance_m)


def plane_elevation(xyz: np.ndarray, planes: np.ndarray, *, tolerance_m: float = 0.0) -> np.ndarray:
    """z of the plane under each point: the highest that is at most the tolerance above it.

    Args:
      xyz: (n, 3) m.
      planes: (3,) or (planes, 3).
      tolerance_m: slack for points of the ground itself; of no effect with one plane.

    Returns:
      (n,) m. Below all planes it is the lowest of them.
    """
    planes = np.atleast_2d(planes)
    elevation = planes[:, :2] @ xyz[:, :2].T + planes[:, 2:]
    under = elevation <= xyz[:, 2] + tolerance_m
    highest = np.where(under, elevation, -np.inf).max(axis=0)
    return np.where(under.any(axis=0), highest, elevation.min(axis=0))


def fit_ground_surface(xyz: np.ndarray, planes: np.ndarray, config: GroundConfig) -> np.ndarray:
    """Deviation of the ground from the plane on a grid.

    Cell minima of the points near the plane, kept where they are within the margin of their lower
    envelope of limited slope, then smoothed on squares of cells; empty ones are filled from 4 times
    farther away and, beyond that, with the plane itself.

    Args:
      xyz: (n, 3) finite, m, sensor frame.
      planes: (3,) or (planes, 3).
      config: the grid, the band round the plane, the slope limit and the Gaussian.

    Returns:
      (X, Y) m, at the centres of squares of 2 x 2 cells.
    """
    cell_m, half_m = config.surface_cell_m, config.surface_half_m
    num_cells = int(2 * half_m / cell_m)
    deviation = height_above_planes(xyz, planes, tolerance_m=float(config.min_height_m))
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    index = np.floor((xyz[:, :2] + half_m) / cell_m).astype(int)
    counted = ((index >= 0) & (index < num_cells)).all(axis=1) & (rho > config.blind_radius_m)
    index, xy, deviation, rho = index[counted], xyz[counted, :2], deviation[counted], rho[counted]
    above_band = deviation >= config.band_above_m + config.band_above_grade * rho
    in_band = (deviation > -(config.band_below_m + config.band_below_grade * rho)) & ~above_band
    # Higher returns can only be of sheets.
    ground = above_band & (deviation < config.band_above_m + config.sheet_band_grade * rho)
    lowest = np.full((num_cells, num_cells), np.inf)
    np.minimum.at(lowest, tuple(index[in_band].T), deviation[in_band])
    levels = levels_with_area(lowest, half_m, config)
    least = least_supported(deviation[in_band], xy[in_band], np.full(2, half_m), PLANE_LEVELS, config, levels)
    ground[in_band] = deviation[in_band] >= least
    lowest = np.full((num_cells, num_cells), np.inf)
    np.minimum.at(lowest, tuple(index[ground].T), deviation[ground])
    lowest[in_pits(lowest, config)] = np.inf
    step = float(config.max_grade * cell_m)
    middle = (np.arange(num_cells) + 0.5) * cell_m - half_m
    band_m = config.band_above_m + config.band_above_grade * np.hypot(*np.meshgrid(middle, middle))
    low = np.where(lowest < band_m, lowest, np.inf)
    envelope = _lower_envelope(low, step=step, num_rounds=config.num_envelope_rounds)
    # Empty cells are inf on both sides, which is not below.
    valid = (low < envelope + config.envelope_margin_m) | on_sheets(lowest, config)
    return _fill_and_smooth(lowest, valid, sigma=float(config.smoothing_m / cell_m))


def on_sheets(lowest: np.ndarray, config: GroundConfig) -> np.ndarray:
    """Cells that lie on a smooth sheet of 5 x 5 squares of 2 x 2 cells, such as a ramp.

    Args:
      lowest: (X, Y) m above the plane, infinite where a cell is empty.
      config: how far the lowest of the squares may deviate from their plane in the mean, and the steepest.

    Returns:
      (X, Y) bool; none farther than 40 m along x or y.
    """
    reach = min(len(lowest) // 2, round(SHEET_HALF_M / config.surface_cell_m))
    middle = slice(len(lowest) // 2 - reach, len(lowest) - len(lowest) // 2 + reach)
    near = lowest[middle, middle]
    padded = np.pad(near, (0, -len(near) % POOL_CELLS), constant_values=np.inf)
    size = len(padded) // POOL_CELLS
    square = padded.reshape(size, POOL_CELLS, size, POOL_CELLS).min(axis=(1, 3))
    num, level, rise, rms = planes_through_windows(square)
    sheet = (num >= MIN_SHEET_SQUARES) & (rms < config.sheet_tolerance_m)
    sheet &= rise < config.max_sheet_grade * POOL_CELLS * config.surface_cell_m
    sheet &= np.abs(square - level) < SQUARE_TOLERANCE_M
    above = np.kron(np.where(sheet, level, -np.inf), np.ones((POOL_CELLS, POOL_CELLS)))
    found = np.zeros(lowest.shape, bool)
    found[middle, middle] = near < above[: len(near), : len(near)] + SHEET_STEP_M
    return found


def planes_through_windows(square: np.ndarray) -> tuple[np.ndarray, ...]:
    """Least-squares planes through windows of 5 x 5 squares round each.

    Args:
      square: (S, S) m, infinite where there is nothing.

    Returns:
      Squares with anything in them; height m of the plane in the middle; its rise, m a square; and the root
      mean square deviation, m; each (S, S). Without three squares of one plane: 0, infinity, and 0.
    """
    offset = np.arange(-SHEET_REACH, SHEET_REACH + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(offset, offset, indexing="ij"))
    around = np.pad(square, SHEET_REACH, constant_values=np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(around, (len(offset), len(offset)))
    windows = windows.reshape(*square.shape, -1)
    there = np.isfinite(windows)
    level, rise, rms = np.zeros(square.shape), np.full(square.shape, np.inf), np.zeros(square.shape)
    num = there.sum(axis=-1)
    design = np.stack([x, y, np.ones_like(x)], axis=1).astype(np.float64)
    normal = np.einsum("xyk,ki,kj->xyij", there, design, design, optimize=True)
    spans = np.linalg.matrix_rank(normal, hermitian=True) == MIN_PLANE_POINTS
    value = np.where(there, windows, 0.0)[spans]
    fit = np.linalg.solve(normal[spans], (value @ design)[..., None])[..., 0]
    error = (fit @ design.T - value) * there[spans]
    level[spans], rise[spans] = fit[:, 2], np.hypot(fit[:, 0], fit[:, 1])
    rms[spans] = np.sqrt((error**2).sum(axis=-1) / num[spans])
    return num, level, rise, rms


def _lower_envelope(lowest: np.ndarray, *, step: float, num_rounds: int) -> np.ndarray:
    """Lowers each cell to at most one step above its lowest neighbour, round after round."""
    far = DIAGONAL_STEP * step
    rise = np.array([[far, step, far], [step, 0.0, step], [far, step, far]])
    envelope = lowest
    for _ in range(num_rounds):
        envelope = ndimage.grey_erosion(envelope, structure=-rise, mode="constant", cval=np.inf)
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


def surface_height(surface: np.ndarray, xy: np.ndarray, config: GroundConfig) -> np.ndarray:
    """Height of the ground grid over the planes, bilinear between the centres of its squares.

    Args:
      surface: (X, Y) m.
      xy: (n, 2) m; beyond the grid its border holds.
      config: as `fit_ground_surface` had it.

    Returns:
      (n,) m.
    """
    square_m = POOL_CELLS * config.surface_cell_m
    position = ((xy + config.surface_half_m) / square_m - 0.5).T
    return ndimage.map_coordinates(surface, position, order=1, mode="nearest")


def ground_elevation(
    xyz: np.ndarray, planes: np.ndarray, surface: np.ndarray | None, config: GroundConfig
) -> np.ndarray:
    """z of the ground under points: the plane and the grid's height over it.

    Args:
      xyz: (n, 3) m; z only matters with several planes.
      planes: (3,) or (planes, 3).
      surface: (X, Y) m, or None for the planes alone.
      config: of the ground.

    Returns:
      (n,) m.
    """
    elevation = plane_elevation(xyz, planes, tolerance_m=float(config.min_height_m))
    return elevation if surface is None else elevation + surface_height(surface, xyz[:, :2], config)


def height_above_ground(
    xyz: np.ndarray, planes: np.ndarray, surface: np.ndarray | None, config: GroundConfig
) -> np.ndarray:
    """Height of points above the ground; the arguments are those of `ground_elevation`.

    Returns:
      (n,) m.
    """
    return xyz[:, 2] - ground_elevation(xyz, planes, surface, config)
