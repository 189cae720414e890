"""Smooth sheets among the lowest returns, wider than any vehicle: ramps, which rise faster than roads do."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxbox.config import GroundConfig
from jaxbox.xla.grids import enlarge_cells

SHEET_HALF_M, SHEET_REACH, MIN_SHEET_SQUARES = 40.0, 2, 17
"""Sheets are looked for this near, in windows of 5 x 5 squares of which so many are not empty."""


SHEET_STEP_M, SQUARE_TOLERANCE_M = 0.2, 0.1
"""Cells of a square are on its sheet up to the first above it: a square of a ramp is not level. And a square
is on the sheet of its window up to the second off it."""


SQUARE_CELLS = 2
"""Sheets are looked for among squares of so many cells."""


def on_sheets(lowest: jax.Array, config: GroundConfig) -> jax.Array:
    """Cells that lie on a smooth sheet, wider than any vehicle: ramps, which the envelope takes for things.

    Squares of 2 x 2 cells stand for their lowest. Where most of 5 x 5 are within a tolerance of a plane, in
    the mean, and the plane is no steeper than `max_sheet_grade`, the one in the middle is on a sheet. Roofs
    and bonnets are too small for that, hedges too rough.

    Args:
      lowest: (X, Y) float32, m above the plane; infinite where a cell is empty.
      config: the tolerance and the steepest sheet.

    Returns:
      (X, Y) bool; False farther than 40 m along x or y, where returns are too far apart.

    Reference: oracle `jaxbox.reference.on_sheets`.
    """
    n = lowest.shape[0]
    margin = max(n // 2 - round(SHEET_HALF_M / config.surface_cell_m), 0)
    near = lowest[margin : n - margin, margin : n - margin]
    near = jnp.pad(near, (0, -near.shape[0] % SQUARE_CELLS), constant_values=jnp.inf)
    steps = range(SQUARE_CELLS)
    square = functools.reduce(
        jnp.minimum, [near[i::SQUARE_CELLS, j::SQUARE_CELLS] for i in steps for j in steps]
    )
    num, level, rise, rms = planes_through_windows(square)
    is_sheet = (num >= MIN_SHEET_SQUARES) & (rms < config.sheet_tolerance_m)
    is_sheet = is_sheet & (rise < config.max_sheet_grade * SQUARE_CELLS * config.surface_cell_m)
    is_sheet = is_sheet & (jnp.abs(square - level) < SQUARE_TOLERANCE_M)
    level = enlarge_cells(jnp.where(is_sheet, level, -jnp.inf), SQUARE_CELLS)
    level = level[: n - 2 * margin, : n - 2 * margin]
    return lowest < jnp.pad(level, margin, constant_values=-jnp.inf) + SHEET_STEP_M


def planes_through_windows(square: jax.Array) -> tuple[jax.Array, ...]:
    """Least-squares planes through the squares of windows of 5 x 5.

    Args:
      square: (S, S) float32, m; infinite where there is nothing.

    Returns:
      num: (S, S) float32, squares in the window that are not empty.
      level: (S, S) float32, m: of the plane in the middle of the window; 0 where no plane is determined.
      rise: (S, S) float32, m a square: of the plane; infinite there.
      rms: (S, S) float32, m: deviations from it; nothing where no plane is determined.

    Reference: oracle `jaxbox.reference.planes_through_windows`.
    """
    there = jnp.isfinite(square)
    z = jnp.where(there, square, 0)

    def moments(grid: jax.Array, powers: Sequence[tuple[int, int]]) -> list[jax.Array]:
        rows = [moment_of_neighbours(grid, 0, SHEET_REACH, p) for p in range(3)]
        return [moment_of_neighbours(rows[p], 1, SHEET_REACH, q) for p, q in powers]

    num, x, y, xx, xy, yy = moments(
        there.astype(jnp.float32), ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    )
    s, xs, ys = moments(z, ((0, 0), (1, 0), (0, 1)))
    (ss,) = moments(z * z, ((0, 0),))
    count = jnp.maximum(num, 1)
    xx, xy, yy = xx - x * x / count, xy - x * y / count, yy - y * y / count
    xs, ys, ss = xs - x * s / count, ys - y * s / count, ss - s * s / count
    det = xx * yy - xy * xy
    is_plane = det > 0.25
    det = jnp.where(is_plane, det, 1)
    a, b = (yy * xs - xy * ys) / det, (xx * ys - xy * xs) / det
    rms = jnp.sqrt(jnp.maximum(ss - a * xs - b * ys, 0) / count)
    level = (s - a * x - b * y) / count
    return num, jnp.where(is_plane, level, 0), jnp.where(is_plane, jnp.hypot(a, b), jnp.inf), rms


def moment_of_neighbours(grid: jax.Array, axis: int, reach: int, power: int) -> jax.Array:
    """Each cell with the ones before and after it along an axis, each times its offset to a power.

    Beyond the border there are none.

    Args:
      grid: any shape, float32.
      axis: along which.
      reach: cells on either side.
      power: of the offset in cells.

    Returns:
      As the grid.
    """
    offsets = range(-reach, reach + 1)
    weighted = [k**power * cells for k, cells in zip(offsets, _shifted(grid, axis, reach), strict=True)]
    return functools.reduce(jnp.add, weighted)


def _shifted(grid: jax.Array, axis: int, reach: int) -> list[jax.Array]:
    n = grid.shape[axis]
    padded = jnp.pad(grid, [(reach, reach) if a == axis else (0, 0) for a in range(grid.ndim)])
    return [jax.lax.slice_in_dim(padded, k, k + n, axis=axis) for k in range(2 * reach + 1)]
