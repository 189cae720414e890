"""Which of the lowest returns others support as ground: what lies below the road is a reflection in it."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.config import GroundConfig
from jaxbox.xla.grids import margin_cells, window_counts
from jaxbox.xla.indexing import lookup

SUPPORT_SQUARE_M = 2.0
"""Edge of the squares in which points support each other as ground."""


SUPPORT_LEVELS_PER_M, SUPPORT_LEVELS = 10.0, 12
"""Heights are compared in levels of .1 m, and a level with so many from it on."""


SENSOR_LEVELS, PLANE_LEVELS = range(-100, 28), range(-13, 11)
"""Levels about the sensor, in which the ground is sought, and about the plane."""


AT_PLANE_LEVELS = 3
"""What is within so many levels of the plane lies at its height; what is lower lies deep below it."""


def least_supported(
    z: jax.Array,
    xy: jax.Array,
    mask: jax.Array,
    halves_m: tuple[float, float],
    levels: range,
    config: GroundConfig,
    *,
    about_plane: bool = False,
) -> jax.Array:
    """How low a point may be to be ground: where others near by are about as low.

    Returns from below the road (a beam that a puddle or glass reflects goes on past the road) are few and
    spread in height, the road's are many and close together. In each square with the eight round it, the
    lowest level is sought that holds, together with the next, enough of the points up to 1.2 m above it, and
    deep below the plane enough for those at the plane: below far cars their mirror images outnumber the road.

    Args:
      z: (N,) float32, m.
      xy: (N, 2) float32, m.
      mask: (N,) bool, points that count.
      halves_m: the squares cover |x| and |y| below these.
      levels: which levels there are; lower and higher points are in the first and the last.
      config: the least shares of those points, and their least number.
      about_plane: heights are above the plane.

    Returns:
      (N,) float32, m: minus infinity where the lowest level has support, infinity where none has.

    Reference: oracle `jaxbox.reference.least_supported`.
    """
    num_levels = len(levels)
    shape = math.ceil(2 * halves_m[0] / SUPPORT_SQUARE_M), math.ceil(2 * halves_m[1] / SUPPORT_SQUARE_M)
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
    twelve = four[:-8] + four[4:-4] + four[8:]
    needed = jnp.maximum(config.min_support_share * twelve, config.min_support_points)
    if about_plane:
        plane_row = -levels.start
        at_plane = jnp.max(two[plane_row - AT_PLANE_LEVELS : plane_row + AT_PLANE_LEVELS - 1], axis=0)
        is_deep = np.array(levels)[:, None] < -AT_PLANE_LEVELS
        needed = jnp.maximum(needed, jnp.where(is_deep, config.min_deep_share * at_plane, 0))
    supported = two[:num_levels] >= needed
    least = np.array(levels, np.float32) / np.float32(SUPPORT_LEVELS_PER_M)
    least[0] = -np.inf
    return lookup(jnp.min(jnp.where(supported, least[:, None], jnp.inf), axis=0), square)
