"""Length-axis assignments: either side of a rectangle may be the length of the vehicle."""

import dataclasses
import math

import jax
import jax.numpy as jnp

from jaxbox.config import ClassPrior, CompletionConfig
from jaxbox.stages.state import NOT_A_BOX, Boxes, Rectangles

NUM_ASSIGNMENTS = 2
"""Either side of a rectangle may be the length."""


NUM_PLACEMENTS = 3
"""Where a completed width goes: away from the sensor, towards it, or both ways."""


SEEN_RAMP = 0.05
"""Fraction of the usual size over which a side goes from partly hidden to seen whole."""


MIN_LOSS = 1e-6
"""Objectives nearer than this are equal."""


BLEND_FROM_DEG, BLEND_ALL_DEG, BLEND_TO_DEG = 8, 12, 30.5
"""Boxes turned against each other by more than the first are blended, by the second and more in full: less
makes little difference. Beyond the last they are of different things. (Rotations are a degree apart.)"""


CERTAIN = 1e3
"""Objective of a box that no evidence weighs: it passes any gate on the objective."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Assignments:
    """Rectangles, each with one of its sides taken as the length."""

    along: tuple[jax.Array, jax.Array]
    """(...) m: where the length begins and ends, along the box and from the sensor."""
    across: tuple[jax.Array, jax.Array]
    """(...) m: the same of the width, across the box."""
    yaw: jax.Array
    """(...) rad, not wrapped."""
    score: jax.Array
    """(...) of the rectangle."""

    @property
    def measured(self) -> tuple[jax.Array, jax.Array]:
        """(...) m: length and width."""
        return self.along[1] - self.along[0], self.across[1] - self.across[0]


def assign_length_axis(rectangle: Rectangles, side: jax.Array) -> Assignments:
    """Takes one side of each rectangle as its length: a length-axis assignment.

    Args:
      rectangle: of any shape.
      side: int32, broadcasts with them: 0 where the length is along u, 1 where it is along v.

    Returns:
      Assignments of the shape of both.
    """
    (u0, v0), (u1, v1) = (jnp.moveaxis(bounds, -1, 0) for bounds in (rectangle.low, rectangle.high))
    along_v = side > 0
    # With the length along v the frame turns by a quarter: across it lies -u.
    return Assignments(
        along=(jnp.where(along_v, v0, u0), jnp.where(along_v, v1, u1)),
        across=(jnp.where(along_v, -u1, v0), jnp.where(along_v, -u0, v1)),
        yaw=jnp.where(along_v, rectangle.angle + math.pi / 2, rectangle.angle),
        score=jnp.broadcast_to(rectangle.score, jnp.broadcast_shapes(rectangle.score.shape, side.shape)),
    )


def fits(sides: Assignments, prior: ClassPrior) -> jax.Array:
    """(...) bool: whether the measured sides fit into the largest vehicle of the class."""
    length, width = sides.measured
    return (length <= prior.max_length_m) & (width <= prior.max_width_m)


def share_seen(measured: jax.Array, usual: jax.Array | float, seen: jax.Array | float) -> jax.Array:
    """How sure it is that a side is seen whole.

    Args:
      measured: (...) float32, m, how much of it shows.
      usual: m, size of the class.
      seen: fraction of that from which on it may be seen whole.

    Returns:
      (...) float32, from 0 where it may be hidden in part to 1.
    """
    return jnp.clip((measured / usual - seen) / SEEN_RAMP, 0, 1)


def share_of_length_seen(measured: jax.Array, prior: ClassPrior, seen: jax.Array | float) -> jax.Array:
    """How sure it is that a length is seen whole: from less on in classes whose lengths differ.

    Args:
      measured: (...) float32, m, how much of it shows.
      prior: fields of (...) float32.
      seen: fraction of the usual length from which on it may be seen whole in classes of one length.

    Returns:
      (...) float32, in [0, 1], see `share_seen`.
    """
    return share_seen(measured, prior.length_m, jnp.minimum(seen, prior.whole_from_m / prior.length_m))


def likely_size(
    measured: jax.Array,
    usual: jax.Array | float,
    whole: jax.Array,
    *,
    weight: jax.Array | float = 1.0,
    margin_m: jax.Array | float = 0.0,
) -> jax.Array:
    """The usual size of a side that may be hidden in part, the measured one of a side that is seen whole.

    Args:
      measured: (...) float32, m.
      usual: m, size of the class.
      whole: (...) float32, how sure it is that it is seen whole.
      weight: of the measured size then.
      margin_m: by how much measured sides read short.

    Returns:
      (...) float32, m, between them, and at least as measured.
    """
    return jnp.maximum(usual + weight * whole * (measured + margin_m - usual), measured)


def likely_sizes(
    sides: Assignments, prior: ClassPrior, config: CompletionConfig
) -> tuple[jax.Array, jax.Array]:
    """The class's size for sides that may be hidden in part; between it and the measured for the others.

    Args:
      sides: of any shape.
      prior: fields of (...) float32.
      config: from which fraction of the class's size on a side may be seen whole, what its measured size
        weighs then, and by how much measured sides read short.

    Returns:
      Length and width (...) float32, m, at least as measured.

    Reference: oracle `jaxbox.reference.likely_sizes`.
    """
    length, width = sides.measured
    whole = (
        share_of_length_seen(length, prior, config.seen_length),
        share_seen(width, prior.width_m, config.seen_width),
    )
    weight, margins_m = config.seen_weight, (config.length_margin_m, config.width_margin_m)
    return (
        likely_size(length, prior.length_m, whole[0], weight=weight, margin_m=margins_m[0]),
        likely_size(width, prior.width_m, whole[1], weight=weight, margin_m=margins_m[1]),
    )


def extend(side: tuple[jax.Array, jax.Array], size: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Centres of an interval grown to `size`: away from the sensor, towards it, both sides."""
    low, high = side
    from_low, from_high = low + size / 2, high - size / 2
    # The same as |low| < |high|, but right for a side without extent too: it grows away.
    low_is_near = low + high > 0
    away = jnp.where(low_is_near, from_low, from_high)
    towards = jnp.where(low_is_near, from_high, from_low)
    return away, towards, (low + high) / 2


def longer_side(rectangle: Rectangles) -> Assignments:
    """Assignments (P,) with the longer side as length."""
    along_u, along_v = jnp.moveaxis(rectangle.high - rectangle.low, -1, 0)
    return assign_length_axis(rectangle, (along_v > along_u).astype(jnp.int32))


def keep_measured(sides: Assignments, prior: ClassPrior) -> Boxes:
    """The rectangles as measured (the paper).

    Args:
      sides: of any shape.
      prior: fields of (...) float32.

    Returns:
      Boxes (...); no box where a measured side is too long.
    """
    return _place_unweighed(sides, sides.measured, prior)


def extend_away(sides: Assignments, prior: ClassPrior, config: CompletionConfig) -> Boxes:
    """Completes both sides away from the sensor to their likely sizes.

    The sensor sees the near ends of both sides; what is missing is behind them.

    Args:
      sides: of any shape.
      prior: fields of (...) float32.
      config: see `likely_sizes`.

    Returns:
      Boxes (...); no box where a measured side is too long.
    """
    return _place_unweighed(sides, likely_sizes(sides, prior, config), prior)


def _place_unweighed(sides: Assignments, sizes: tuple[jax.Array, jax.Array], prior: ClassPrior) -> Boxes:
    """Boxes of a size, away from the sensor, that no evidence weighs: each that fits its class is certain."""
    objective = jnp.where(fits(sides, prior), jnp.float32(CERTAIN), NOT_A_BOX)
    return place(sides, sizes, jnp.zeros_like(objective, jnp.int32), objective)


def place(
    sides: Assignments, sizes: tuple[jax.Array, jax.Array], placement: jax.Array, objective: jax.Array
) -> Boxes:
    """Boxes of a size: the length away from the sensor, the width where `placement` says.

    Args:
      sides: of any shape.
      sizes: length and width (...) float32, m, at least as measured.
      placement: (...) int32, in [0, NUM_PLACEMENTS).
      objective: (...) float32.

    Returns:
      Boxes (...).
    """
    u, across = extend(sides.along, sizes[0])[0], extend(sides.across, sizes[1])
    v = jax.lax.select_n(placement, *across)
    cos, sin = jnp.cos(sides.yaw), jnp.sin(sides.yaw)
    return Boxes(
        center=jnp.stack([cos * u - sin * v, sin * u + cos * v], axis=-1),
        length=sizes[0],
        width=sizes[1],
        yaw=sides.yaw,
        measured=jnp.stack(sides.measured, axis=-1),
        objective=objective,
        in_row=jnp.zeros_like(objective, bool),
    )


def blend_boxes(boxes: Boxes, *, max_loss: jax.Array | float) -> Boxes:
    """The best of several boxes of each thing, blended with those turned from it that are nearly as good.

    A thing seen in part may fit two rotations nearly as well. A little noise decides which is better, and the
    box would jump by what they differ.

    Args:
      boxes: (C, W).
      max_loss: by how much less an objective may be; the weight falls to 0 there.

    Returns:
      The boxes (C,), with the objective, and all else, of the best.

    Reference: oracle `jaxbox.reference.blend_boxes`.
    """
    best = jax.lax.argmax(boxes.objective, 1, jnp.int32)[:, None]

    def of_best(values: jax.Array) -> jax.Array:
        index = best.reshape(-1, *[1] * (values.ndim - 1))
        return jnp.take_along_axis(values, index, axis=1)[:, 0]

    chosen = jax.tree.map(of_best, boxes)
    turn = boxes.yaw - chosen.yaw[:, None]
    turn = turn - math.pi * jnp.round(turn / math.pi)
    degrees = jnp.abs(turn) * (180 / math.pi)
    loss = chosen.objective[:, None] - boxes.objective
    weight = jnp.clip(1 - loss / jnp.maximum(max_loss, MIN_LOSS), 0, 1)
    weight = weight * jnp.clip((degrees - BLEND_FROM_DEG) / (BLEND_ALL_DEG - BLEND_FROM_DEG), 0, 1)
    weight = jnp.where(degrees < BLEND_TO_DEG, weight, 0)
    weight = jnp.where(jnp.arange(weight.shape[1], dtype=jnp.int32)[None] == best, 1, weight)
    share = weight / jnp.sum(weight, axis=1, keepdims=True)

    def mean(values: jax.Array) -> jax.Array:
        return jnp.sum(share.reshape(*share.shape, *[1] * (values.ndim - 2)) * values, axis=1)

    return dataclasses.replace(
        chosen,
        center=mean(boxes.center),
        length=mean(boxes.length),
        width=mean(boxes.width),
        measured=mean(boxes.measured),
        yaw=chosen.yaw + mean(turn),
    )
