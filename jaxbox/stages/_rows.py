"""Vehicles that stand side by side in a row: each hides the sides of the next from the sensor."""

import jax
import jax.numpy as jnp

from jaxbox.config import ClassPrior, CompletionConfig
from jaxbox.stages._assignments import Assignments
from jaxbox.stages.state import RayFractions
from jaxbox.xla.indexing import take
from jaxbox.xla.pairs import join_pairs
from jaxbox.xla.rows import compact

NARROWEST, WIDEST = 0.8, 1.15
"""The visible end of a vehicle is so wide, as a fraction of the class's width."""


NEAREST = 1.1
"""Two ends are at least so far apart, as a fraction of that width; else they are readings of one vehicle."""


MAX_SINE = 0.2
"""Sine of the angle between vehicles that stand side by side."""


MIN_REACHED = 0.05
"""At least this fraction of the rays reaches a box: a few rays must not give an extreme fraction."""


LEFT, SECOND_LEFT, RIGHT, SECOND_RIGHT = 1, 2, 4, 8
"""Where a neighbour stands, as a flag."""


def visible_ends(sides: Assignments, prior: ClassPrior) -> tuple[jax.Array, jax.Array]:
    """The ends of vehicles that face the sensor, if the rectangles may be vehicles seen end on.

    Args:
      sides: C of them.
      prior: fields of (C,) float32.

    Returns:
      ends: (C, 4) float32: the middle of the end, x and y (m), and the cosine and sine of the yaw.
      may_be: (C,) bool: as wide as a vehicle, and to one side of the sensor.
    """
    (low, high), across = sides.along, (sides.across[0] + sides.across[1]) / 2
    width = sides.measured[1] / prior.width_m
    may_be = (width > NARROWEST) & (width < WIDEST) & (low * high > 0)
    near = jnp.where(low + high > 0, low, high)
    cos, sin = jnp.cos(sides.yaw), jnp.sin(sides.yaw)
    place = cos * near - sin * across, sin * near + cos * across
    return jnp.stack([*place, cos, sin], axis=1), may_be


def find_rows(
    ends: jax.Array, may_be: jax.Array, width_m: jax.Array | float, config: CompletionConfig
) -> jax.Array:
    """Which ends are in a row of three or more vehicles side by side.

    Two alone are not: pieces of a wall often look like that.

    Args:
      ends: (C, 4), see `visible_ends`.
      may_be: (C,) bool, those that count.
      width_m: of the class.
      config: how far apart neighbours stand, and how much farther or nearer.

    Returns:
      (C,) bool: between two neighbours, or beside one that has another one behind it.

    Reference: oracle `jaxbox.reference.find_rows`.
    """

    def place_of(own: jax.Array, other: jax.Array) -> jax.Array:
        (x, y, cos, sin), (other_x, other_y, other_cos, other_sin) = own, other
        dx, dy = other_x - x, other_y - y
        shift, side = jnp.abs(dx * cos + dy * sin), dy * cos - dx * sin
        distance = jnp.abs(side)
        parallel = jnp.abs(other_sin * cos - other_cos * sin) < MAX_SINE
        first = (distance > NEAREST * width_m) & (distance <= config.row_distance_m)
        second = (distance > config.row_distance_m) & (distance <= 2 * config.row_distance_m)
        first = first & parallel & (shift <= config.row_shift_m)
        second = second & parallel & (shift <= 2 * config.row_shift_m)
        on_left = jnp.where(
            first, jnp.uint32(LEFT), jnp.where(second, jnp.uint32(SECOND_LEFT), jnp.uint32(0))
        )
        return jnp.where(side > 0, on_left, RIGHT * on_left)

    index, num = compact(may_be, may_be.shape[0])
    places = join_pairs(take(ends, index), num, place_of)
    in_row = jnp.zeros(may_be.shape[0], bool)
    for two in (LEFT | RIGHT, LEFT | SECOND_LEFT, RIGHT | SECOND_RIGHT):
        in_row = in_row | ((places & two) == two)
    return jnp.zeros_like(may_be).at[index].set(in_row, mode="drop")


def hit_share(rays: RayFractions, in_row: jax.Array) -> jax.Array:
    """The fraction of rays that hit a box: in a row, of those that its neighbours let through.

    Args:
      rays: fractions (..., P).
      in_row: (P,) bool.

    Returns:
      (..., P) float32 in [0, 1].

    Reference: oracle `jaxbox.reference.hit_share`.
    """
    reached = jnp.maximum(1 - rays.occluded, MIN_REACHED)
    return jnp.where(in_row, jnp.minimum(rays.hit / reached, 1), rays.hit)
