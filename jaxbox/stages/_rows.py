"""Vehicles that stand in a row, side by side or nose to tail: what is round one is of its neighbours."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxbox.config import ClassPrior, CompletionConfig, VehicleConfig
from jaxbox.stages._assignments import Assignments
from jaxbox.stages.state import RayFractions
from jaxbox.xla.pairs import join_pairs

NARROWEST, WIDEST = 0.8, 1.15
"""The visible end of a vehicle is so wide, as a fraction of the class's width."""


NEAREST = 1.1
"""Two ends are at least so far apart, as a fraction of that width; else they are readings of one vehicle."""


MAX_SINE = 0.2
"""Sine of the angle between vehicles that stand side by side."""


NEAREST_LENGTHS = 0.95
"""The middles of two vehicles nose to tail are at least so far apart, as a fraction of their length."""


MAX_ASIDE_M, MAX_LINE_SINE = 0.35, 0.12
"""How far one stands to the side of the other, and the sine of the angle between them."""


MIN_EARLY = 0.3
"""What scores less by rays and size makes no line."""


MIN_REACHED = 0.05
"""At least this fraction of the rays reaches a box: a few rays must not give an extreme fraction."""


ONE_SIDE, SECOND, OTHER_SIDE, OTHER_SECOND = 1, 2, 4, 8
"""Where a neighbour stands, as a flag: on one side or the other, next to it or behind that one."""


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
        return _place(first, second, side > 0)

    return _in_threes(ends, may_be, place_of)


def find_lines(boxes: jax.Array, early: jax.Array, may_be: jax.Array, config: VehicleConfig) -> jax.Array:
    """Which boxes are in a line of three or more vehicles nose to tail.

    Args:
      boxes: (P, 5) float32: x, y, length, width (m), yaw (rad).
      early: (P,) float32, their scores by rays and size.
      may_be: (P,) bool, those that count.
      config: how many lengths apart neighbours stand.

    Returns:
      (P,) bool: between two neighbours, or before one that has another one before it.

    Reference: oracle `jaxbox.reference.find_lines`.
    """

    def place_of(own: jax.Array, other: jax.Array) -> jax.Array:
        (x, y, length, cos, sin), (other_x, other_y, other_length, other_cos, other_sin) = own, other
        dx, dy = other_x - x, other_y - y
        ahead, aside = dx * cos + dy * sin, jnp.abs(dy * cos - dx * sin)
        lengths = jnp.abs(ahead) / ((length + other_length) / 2)
        aligned = (aside < MAX_ASIDE_M) & (jnp.abs(other_sin * cos - other_cos * sin) < MAX_LINE_SINE)
        first = (lengths > NEAREST_LENGTHS) & (lengths < config.line_lengths)
        second = (lengths > 2 * NEAREST_LENGTHS) & (lengths < 2 * config.line_lengths)
        return _place(aligned & first, aligned & second, ahead > 0)

    # By products, as for rows: the sines are of P boxes, not of P^2 pairs.
    x, y, length, _, yaw = boxes.T
    rows = jnp.stack([x, y, length, jnp.cos(yaw), jnp.sin(yaw)], axis=1)
    return _in_threes(rows, may_be & (early > MIN_EARLY), place_of)


def _place(first: jax.Array, second: jax.Array, on_one_side: jax.Array) -> jax.Array:
    flag = jnp.where(first, jnp.uint32(ONE_SIDE), jnp.where(second, jnp.uint32(SECOND), jnp.uint32(0)))
    return jnp.where(on_one_side, flag, OTHER_SIDE * flag)


def _in_threes(
    rows: jax.Array, may_be: jax.Array, place_of: Callable[[jax.Array, jax.Array], jax.Array]
) -> jax.Array:
    """(P,) bool: rows (P, ...) between two neighbours, or beside one that has another one behind it."""
    places = join_pairs(rows, may_be, place_of)
    pairs = ONE_SIDE | OTHER_SIDE, ONE_SIDE | SECOND, OTHER_SIDE | OTHER_SECOND
    return functools.reduce(jnp.logical_or, [(places & two) == two for two in pairs])


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
