"""Which of the lowest returns others support as ground: what lies below the road is a reflection in it."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.config import GroundConfig
from jaxbox.xla.grids import margin_cells, window_counts
from jaxbox.xla.indexing import lookup

SUPPORT_SQUARE_M = 2.0
"""Edge of the squares in which points support each other as ground."""


SUPPORT_LEVELS_PER_M, SUPPORT_LEVELS = 20, 24
"""Points are compared in levels of .05 m, and a level with so many from it on."""


SENSOR_LEVELS, PLANE_LEVELS = range(-200, 56), range(-26, 22)
"""Such levels about the sensor, in which the ground is sought, and about the plane."""


AREA_LEVELS_PER_M, AREA_LEVELS = 10, range(-13, 11)
"""Cells are compared in levels of .1 m about the plane."""


AT_PLANE_LEVELS = 3
"""What is within so many of these of the plane lies at its height; what is lower lies deep below it."""


PIT_DEPTH_M = 0.5
"""What is higher than a cell by more than this is a thing beside it, no road round a pit."""


def least_supported(
    z: jax.Array,
    xy: jax.Array,
    mask: jax.Array,
    halves_m: tuple[float, float],
    levels: range,
    config: GroundConfig,
    may_be_ground: jax.Array | None = None,
) -> jax.Array:
    """How low a point may be to be ground: where others near by are about as low.

    Returns from below the road (a beam that a puddle or glass reflects goes on past the road) are few and
    spread in height, the road's are many and close together. In each square with the eight round it, the
    lowest level is sought that holds, together with the next, enough of the points up to 1.2 m above it.
    Levels are thin, since the one just below the road has the road's own support.

    Args:
      z: (N,) float32, m.
      xy: (N, 2) float32, m.
      mask: (N,) bool, points that count.
      halves_m: the squares cover |x| and |y| below these.
      levels: which levels there are; lower and higher points are in the first and the last.
      config: the least share of those points, and their least number.
      may_be_ground: (A, cells) bool, of levels twice as thick, see `levels_with_area`; None for all.

    Returns:
      (N,) float32, m: minus infinity where the lowest level has support, infinity where none has.

    Reference: oracle `jaxbox.reference.least_supported`.
    """
    num_levels = len(levels)
    shape = _num_squares(halves_m[0]), _num_squares(halves_m[1])
    row, column = (
        jnp.clip(jnp.floor((xy[:, a] + halves_m[a]) / SUPPORT_SQUARE_M).astype(jnp.int32), 0, shape[a] - 1)
        for a in (0, 1)
    )
    square = margin_cells(row, column, shape)
    level = jnp.floor(z * SUPPORT_LEVELS_PER_M).astype(jnp.int32) - levels.start
    level = jnp.clip(level, 0, num_levels - 1)
    count = window_counts(
        level, square, mask, num_levels=num_levels, num_above=SUPPORT_LEVELS - 1, shape=shape
    )
    two = count[:-1] + count[1:]
    four = two[:-2] + two[2:]
    eight = four[:-4] + four[4:]
    all_above = eight[:-16] + eight[8:-8] + eight[16:]
    needed = jnp.maximum(config.min_support_share * all_above, config.min_support_points)
    supported = two[:num_levels] >= needed
    if may_be_ground is not None:
        supported &= jnp.repeat(may_be_ground, num_levels // len(may_be_ground), axis=0)
    least = np.array(levels, np.float32) / np.float32(SUPPORT_LEVELS_PER_M)
    least[0] = -np.inf
    return lookup(jnp.min(jnp.where(supported, least[:, None], jnp.inf), axis=0), square)


def levels_with_area(lowest: jax.Array, half_m: float, config: GroundConfig) -> jax.Array:
    """Which levels about the plane may be ground, by how many cells have their lowest point there.

    Mirror images in a wet road lie as deep below it as things stand above. Below far cars they are more than
    the few returns of the road, but under the cars alone, and at all depths. So what lies deep below the
    plane has to be lowest in as many cells as what lies at the plane, .2 m of heights against the fullest
    .2 m. Where the ground is lower than the plane, things on it reach the plane's height, but are lowest in
    few cells there.

    The plane may lie below the road, and a few returns from below the road at the plane. So what lies at the
    plane has to be lowest in a share of the cells that the fullest .2 m above it has, up to .3 m above the
    plane.

    Args:
      lowest: (n, n) float32, m above the plane: the lowest point of each cell, infinite where it is empty.
      half_m: the cells cover |x| and |y| below this.
      config: the shares of cells.

    Returns:
      (A, cells) bool for `AREA_LEVELS`, see `margin_cells`; of cells of the margin anything.

    Reference: oracle `jaxbox.reference.levels_with_area`.
    """
    n, num_levels, plane_row = lowest.shape[0], len(AREA_LEVELS), -AREA_LEVELS.start
    shape = _num_squares(half_m), _num_squares(half_m)
    middle_m = (np.arange(n) + 0.5) * (2 * half_m / n)
    line = jnp.array(np.floor(middle_m / SUPPORT_SQUARE_M), jnp.int32)
    square = margin_cells(line[:, None], line[None], shape)
    is_occupied = jnp.isfinite(lowest)
    level = jnp.floor(jnp.where(is_occupied, lowest, 0) * AREA_LEVELS_PER_M).astype(jnp.int32)
    level = jnp.clip(level + plane_row, 0, num_levels - 1)
    count = window_counts(
        level.reshape(-1),
        square.reshape(-1),
        is_occupied.reshape(-1),
        num_levels=num_levels,
        num_above=1,
        shape=shape,
    )
    two = count[:-1] + count[1:]
    at_plane = range(plane_row - AT_PLANE_LEVELS, plane_row + AT_PLANE_LEVELS - 1)

    def fullest_from(row: int) -> jax.Array:
        return jnp.max(two[row : at_plane.stop], axis=0)

    deep = config.min_deep_ratio * fullest_from(at_plane.start)
    low = [config.min_low_ratio * fullest_from(row + 2) for row in at_plane[:-2]]
    needed = jnp.stack([deep] * at_plane.start + low)
    high = jnp.ones((num_levels - len(needed), two.shape[1]), bool)
    return jnp.concatenate([two[: len(needed)] >= needed, high])


def in_pits(lowest: jax.Array, config: GroundConfig) -> jax.Array:
    """Cells that lie alone below the road: lower than all their neighbours, of which several are near.

    A few returns from below the road pass as support of each other where the road is lower some metres
    away. A cell of the road has another next to it at its height; or things there, which are higher.

    Args:
      lowest: (n, n) float32, m above the plane: the lowest point of each cell, infinite where it is empty.
      config: by how much lower, and the least number of neighbours up to `PIT_DEPTH_M` higher.

    Returns:
      (n, n) bool.

    Reference: oracle `jaxbox.reference.in_pits`.
    """
    n = lowest.shape[0]
    padded = jnp.pad(lowest, 1, constant_values=jnp.inf)
    offsets = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    neighbours = [padded[i : i + n, j : j + n] for i, j in offsets]

    def num_below(height: jax.Array) -> jax.Array:
        return functools.reduce(jnp.add, [(each < height).astype(jnp.float32) for each in neighbours])

    is_lowest = num_below(lowest + config.envelope_margin_m) == 0
    return is_lowest & (num_below(lowest + PIT_DEPTH_M) >= config.min_pit_neighbours)


def _num_squares(half_m: float) -> int:
    return math.ceil(2 * half_m / SUPPORT_SQUARE_M)
