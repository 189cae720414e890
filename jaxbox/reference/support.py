"""Which of the lowest returns others support as ground."""

import numpy as np
from scipy import ndimage

from jaxbox.config import GroundConfig

SUPPORT_SQUARE_M = 2.0
"""Points support each other as ground in squares of this edge, and the eight round them."""
SUPPORT_LEVELS_PER_M = 20
"""Points are compared in levels of .05 m."""
SUPPORT_LEVELS = 24
"""Two levels are compared with this many from the lower of them up."""
SENSOR_LEVELS, PLANE_LEVELS = range(-200, 56), range(-26, 22)
"""Levels about the sensor, and about the plane."""
AREA_LEVELS_PER_M, AREA_LEVELS = 10, range(-13, 11)
"""Cells are compared in levels of .1 m about the plane."""
AT_PLANE_LEVELS = 3
"""What is within so many of these of the plane lies at its height; what is lower lies deep below it."""
PIT_DEPTH_M = 0.5
"""What is higher than a cell by more than this is a thing beside it, no road round a pit."""


def least_supported(
    z: np.ndarray,
    xy: np.ndarray,
    halves_m: np.ndarray,
    levels: range,
    config: GroundConfig,
    may_be_ground: np.ndarray | None = None,
) -> np.ndarray:
    """How low a point may be to be ground: where others near by are about as low.

    Args:
      z: (n,) m.
      xy: (n, 2) m.
      halves_m: (2,) m: the squares cover |x| and |y| below these.
      levels: which levels of .05 m there are; lower and higher points are in the first and the last.
      config: the least share, and the least number, of the points in 3 x 3 squares.
      may_be_ground: (rows, columns, levels of .1 m) bool; None for all.

    Returns:
      (n,) m: minus infinity where the lowest level has support, infinity where none has.
    """
    rows, columns = np.ceil(2 * halves_m / SUPPORT_SQUARE_M).astype(int)
    square = np.floor((xy + halves_m) / SUPPORT_SQUARE_M).astype(int).clip(0, (rows - 1, columns - 1))
    # In float32, like the points: many sensors report millimetres, which lie on the borders of levels.
    level = np.floor(z.astype(np.float32) * np.float32(SUPPORT_LEVELS_PER_M)).astype(int)
    level = level.clip(levels.start, levels.stop - 1) - levels.start
    count = np.zeros((rows, columns, len(levels)))
    np.add.at(count, (*square.T, level), 1)
    count = ndimage.convolve(count, np.ones((3, 3, 1)), mode="constant")

    def up_to(num: int) -> np.ndarray:
        """Sums over each level and the ones above it, this many in all."""
        padded = np.pad(count, ((0, 0), (0, 0), (0, num - 1)))
        return np.lib.stride_tricks.sliding_window_view(padded, num, axis=2).sum(axis=-1)

    # In float32 as well: a share of whole numbers is often a whole number, which either rounding may miss.
    share = np.float32(config.min_support_share) * up_to(SUPPORT_LEVELS).astype(np.float32)
    needed = np.maximum(share, config.min_support_points)
    supported = up_to(2) >= needed
    if may_be_ground is not None:
        supported &= may_be_ground.repeat(2, axis=2)
    least = (np.array(levels) / SUPPORT_LEVELS_PER_M).astype(np.float32)
    least[0] = -np.inf
    lowest = np.where(supported.any(axis=2), least[supported.argmax(axis=2)], np.inf)
    return lowest[tuple(square.T)]


def levels_with_area(lowest: np.ndarray, half_m: float, config: GroundConfig) -> np.ndarray:
    """Which levels about the plane may be ground: low ones that are lowest in enough cells.

    Args:
      lowest: (n, n) m above the plane, infinite where a cell is empty.
      half_m: the cells cover |x| and |y| below this.
      config: in two levels deep below the plane `min_deep_ratio` cells are asked for each cell in the fullest
        two at the plane, and in two at the plane `min_low_ratio` for each in the fullest two above them.

    Returns:
      (rows, columns, levels of .1 m) bool, of 3 x 3 squares.
    """
    num_squares = int(np.ceil(2 * half_m / SUPPORT_SQUARE_M))
    row, column = np.nonzero(np.isfinite(lowest))
    cell_m = 2 * half_m / len(lowest)
    square = np.floor((np.stack([row, column]) + 0.5) * cell_m / SUPPORT_SQUARE_M).astype(int)
    level = np.floor(lowest[row, column] * AREA_LEVELS_PER_M).astype(int)
    level = level.clip(AREA_LEVELS.start, AREA_LEVELS.stop - 1) - AREA_LEVELS.start
    count = np.zeros((num_squares, num_squares, len(AREA_LEVELS) + 1))
    np.add.at(count, (*square, level), 1)
    count = ndimage.convolve(count, np.ones((3, 3, 1)), mode="constant")
    pairs = count[..., :-1] + count[..., 1:]
    levels = np.array(AREA_LEVELS)
    is_deep = levels < -AT_PLANE_LEVELS
    at_plane = np.where(is_deep | (levels >= AT_PLANE_LEVELS - 1), 0, pairs)
    # The fullest two levels at the plane that have none in common with these.
    above = np.maximum.accumulate(at_plane[..., ::-1], axis=2)[..., ::-1][..., 2:]
    above = np.pad(above, ((0, 0), (0, 0), (0, 2)))
    deep = at_plane.max(axis=2, keepdims=True)
    return pairs >= np.where(is_deep, config.min_deep_ratio * deep, config.min_low_ratio * above)


def in_pits(lowest: np.ndarray, config: GroundConfig) -> np.ndarray:
    """Cells that lie alone below the road: lower than all their neighbours, of which several are near.

    Args:
      lowest: (X, Y) m above the plane, infinite where a cell is empty.
      config: lower by `envelope_margin_m`, and `min_pit_neighbours` up to .5 m higher.

    Returns:
      (X, Y) bool.
    """
    padded = np.pad(lowest, 1, constant_values=np.inf)
    window = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(*lowest.shape, 9)
    neighbours = np.delete(window, 4, axis=2)
    is_lowest = neighbours.min(axis=2) >= lowest + config.envelope_margin_m
    num_near = (neighbours < lowest[..., None] + PIT_DEPTH_M).sum(axis=2)
    return is_lowest & (num_near >= config.min_pit_neighbours)
