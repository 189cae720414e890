"""Correction for occluded vehicles: hidden sides are completed by the class prior, away from the sensor."""

import dataclasses
import math

import jax
import jax.numpy as jnp

from jaxbox.types import NOT_A_BOX, Boxes, Rectangles
from jaxbox.xla.loops import fast_max, fast_min, fold_points

INSIDE_MARGIN_M = 0.1
"""A point this far outside a hypothesis still counts as inside."""

NEAR_M = 0.1
"""A point nearer than this to a visible face counts as on it."""

FACE_OVERHANG_M = 0.3
"""Faces reach this far beyond their corners when points are held against them."""

FAR_M = 1e9
"""Farther away than any point."""

NUM_PLACEMENTS = 3
"""Where a completed width goes: away from the sensor, towards it, or both ways."""

SEEN_RAMP = 0.05
"""Fraction of the usual size over which a side goes from partly hidden to seen whole."""

NUM_WAYS = 2
"""Either side of a rectangle may be the length."""

CERTAIN = 1e3
"""Objective of a box that was not held against evidence: it passes any gate on the objective."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Ways:
    """Rectangles, each with one of its sides taken as the length."""

    along: tuple[jax.Array, jax.Array]
    """(...) m: where the length begins and ends, along the box and from the sensor."""
    across: tuple[jax.Array, jax.Array]
    """(...) m: the same of the width, across the box."""
    yaw: jax.Array
    """(...) rad, not wrapped."""
    worth: jax.Array
    """(...) of the rectangle."""

    @property
    def measured(self) -> tuple[jax.Array, jax.Array]:
        """(...) m: length and width."""
        return self.along[1] - self.along[0], self.across[1] - self.across[0]


def way_to_lie(rectangle: Rectangles, side: jax.Array) -> Ways:
    """Takes one side of each rectangle as its length.

    Args:
      rectangle: of any shape.
      side: int32, broadcasts with them: 0 where the length is along u, 1 where it is along v.

    Returns:
      Ways of the shape of both.
    """
    (u0, v0), (u1, v1) = (jnp.moveaxis(bounds, -1, 0) for bounds in (rectangle.low, rectangle.high))
    along_v = side > 0
    # With the length along v the frame turns by a quarter: across it lies -u.
    return Ways(
        along=(jnp.where(along_v, v0, u0), jnp.where(along_v, v1, u1)),
        across=(jnp.where(along_v, -u1, v0), jnp.where(along_v, -u0, v1)),
        yaw=jnp.where(along_v, rectangle.angle + math.pi / 2, rectangle.angle),
        worth=jnp.broadcast_to(rectangle.worth, jnp.broadcast_shapes(rectangle.worth.shape, side.shape)),
    )


def fits(ways: Ways, max_length_m: jax.Array, max_width_m: jax.Array) -> jax.Array:
    """(...) bool: whether the measured sides are no longer than those of the class."""
    length, width = ways.measured
    return (length <= max_length_m) & (width <= max_width_m)


def likely_sizes(
    ways: Ways,
    length_m: jax.Array,
    width_m: jax.Array,
    *,
    seen_length: jax.Array | float,
    seen_width: jax.Array | float,
    seen_weight: jax.Array | float,
    length_margin_m: jax.Array | float,
    width_margin_m: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """The class's size for sides that may be hidden in part; between it and the measured for the others.

    Args:
      ways: of any shape.
      length_m: (...) float32, m, of the class.
      width_m: (...) float32, m, of the class.
      seen_length: fraction of the class's length from which a side may be seen whole.
      seen_width: the same of its width.
      seen_weight: what the measured size of such a side weighs against the class's.
      length_margin_m: measured lengths read short by this, m.
      width_margin_m: measured widths read short by this, m.

    Returns:
      Length and width (...) float32, m, at least as measured.

    Reference: oracle `jaxbox.reference.likely_size`.
    """

    def likely(
        measured: jax.Array, usual: jax.Array, seen: jax.Array | float, margin_m: jax.Array | float
    ) -> jax.Array:
        whole = jnp.clip((measured / usual - seen) / SEEN_RAMP, 0, 1)
        return jnp.maximum(usual + seen_weight * whole * (measured + margin_m - usual), measured)

    length, width = ways.measured
    return (
        likely(length, length_m, seen_length, length_margin_m),
        likely(width, width_m, seen_width, width_margin_m),
    )


def _extend(side: tuple[jax.Array, jax.Array], size: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Centres of an interval grown to `size`: away from the sensor, towards it, both ways."""
    low, high = side
    from_low, from_high = low + size / 2, high - size / 2
    # The same as |low| < |high|, but right for a side without extent too: it grows away.
    low_is_near = low + high > 0
    away = jnp.where(low_is_near, from_low, from_high)
    towards = jnp.where(low_is_near, from_high, from_low)
    return away, towards, (low + high) / 2


def longer_side(rectangle: Rectangles) -> Ways:
    """Ways (P,) with the longer side as length."""
    along_u, along_v = jnp.moveaxis(rectangle.high - rectangle.low, -1, 0)
    return way_to_lie(rectangle, (along_v > along_u).astype(jnp.int32))


def keep_measured(ways: Ways, *, max_length_m: jax.Array, max_width_m: jax.Array) -> Boxes:
    """The rectangles as measured (the paper).

    Args:
      ways: of any shape.
      max_length_m: (...) float32, m.
      max_width_m: (...) float32, m.

    Returns:
      Boxes (...); no box where a measured side is too long.
    """
    certain = jnp.where(fits(ways, max_length_m, max_width_m), jnp.float32(CERTAIN), NOT_A_BOX)
    return place(ways, ways.measured, jnp.zeros_like(certain, jnp.int32), certain)


def extend_away(
    ways: Ways,
    length_m: jax.Array,
    width_m: jax.Array,
    *,
    max_length_m: jax.Array,
    max_width_m: jax.Array,
    **sides: jax.Array | float,
) -> Boxes:
    """Completes both sides away from the sensor to their likely sizes.

    The sensor sees the near ends of both sides; what is missing is behind them.

    Args:
      ways: of any shape.
      length_m: (...) float32, m, of the class.
      width_m: (...) float32, m, of the class.
      max_length_m: (...) float32, m.
      max_width_m: (...) float32, m.
      **sides: the other arguments of `likely_sizes`.

    Returns:
      Boxes (...); no box where a measured side is too long.
    """
    certain = jnp.where(fits(ways, max_length_m, max_width_m), jnp.float32(CERTAIN), NOT_A_BOX)
    sizes = likely_sizes(ways, length_m, width_m, **sides)
    return place(ways, sizes, jnp.zeros_like(certain, jnp.int32), certain)


def place(
    ways: Ways, sizes: tuple[jax.Array, jax.Array], placement: jax.Array, objective: jax.Array
) -> Boxes:
    """Boxes of a size: the length away from the sensor, the width where `placement` says.

    Args:
      ways: of any shape.
      sizes: length and width (...) float32, m, at least as measured.
      placement: (...) int32, in [0, NUM_PLACEMENTS).
      objective: (...) float32.

    Returns:
      Boxes (...).
    """
    u, across = _extend(ways.along, sizes[0])[0], _extend(ways.across, sizes[1])
    v = jax.lax.select_n(placement, *across)
    cos, sin = jnp.cos(ways.yaw), jnp.sin(ways.yaw)
    return Boxes(
        center=jnp.stack([cos * u - sin * v, sin * u + cos * v], axis=-1),
        length=sizes[0],
        width=sizes[1],
        yaw=ways.yaw,
        measured=jnp.stack(ways.measured, axis=-1),
        objective=objective,
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Hypotheses:
    """The vehicles that may hide behind each way: the width goes away from the sensor, towards it, or both
    ways."""

    yaw: jax.Array
    """(C,) rad"""
    u: jax.Array
    """(C,) m: centre along the box, from the sensor."""
    v: jax.Array
    """(C, 3) m: centre across it."""
    length: jax.Array
    """(C,) m"""
    width: jax.Array
    """(C,) m"""

    @property
    def center(self) -> jax.Array:
        """(3, C, 2) m, sensor frame."""
        cos, sin = jnp.cos(self.yaw)[None], jnp.sin(self.yaw)[None]
        u, v = self.u[None], self.v.T
        return jnp.stack([cos * u - sin * v, sin * u + cos * v], axis=-1)


def hypotheses(ways: Ways, length_m: jax.Array, width_m: jax.Array) -> Hypotheses:
    """Completes boxes to the class's size, or the measured where that is larger.

    Args:
      ways: C of them.
      length_m: (C,) float32, m, of the class.
      width_m: (C,) float32, m, of the class.

    Returns:
      The hypotheses: the length is completed away from the sensor.

    Reference: oracle `jaxbox.reference.complete_box`.
    """
    length, width = (jnp.maximum(a, b) for a, b in zip((length_m, width_m), ways.measured, strict=True))
    return Hypotheses(
        yaw=ways.yaw,
        u=_extend(ways.along, length)[0],
        v=jnp.stack(_extend(ways.across, width), axis=1),
        length=length,
        width=width,
    )


def point_agreement(
    boxes: Hypotheses,
    x: jax.Array,
    y: jax.Array,
    count: jax.Array,
    *,
    inside_weight: jax.Array | float,
    near_weight: jax.Array | float,
) -> jax.Array:
    """How well boxes hold the points they were made from, and how close these are to visible faces.

    Args:
      boxes: C times three hypotheses.
      x: (M, C) float32, m.
      y: (M, C) float32, m.
      count: (C,) int32, points of each.
      inside_weight: of the fraction of the points inside the box, give or take 10 cm.
      near_weight: of the mean of .1 / max(d, .1), d the distance to the nearest visible face.

    Returns:
      (3, C) float32: the weighted sum of both.
    """
    half_l, half_w, box_v = boxes.length / 2, boxes.width[None] / 2, boxes.v.T
    # The sensor, at the origin, sees the faces on its side of the box; the others are far from all points.
    face_u = jnp.where(jnp.abs(boxes.u) > half_l, -jnp.sign(boxes.u) * half_l, FAR_M)
    face_v = jnp.where(jnp.abs(box_v) > half_w, -jnp.sign(box_v) * half_w, FAR_M)

    cos, sin = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)

    def update(total: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
        u, v = x * cos + y * sin - boxes.u, (y * cos - x * sin)[None] - box_v
        out_u, out_v = (jnp.abs(u) - half_l)[None], jnp.abs(v) - half_w
        inside = (out_u < INSIDE_MARGIN_M) & (out_v < INSIDE_MARGIN_M)
        to_u = jnp.where(out_v < FACE_OVERHANG_M, jnp.abs(u - face_u)[None], FAR_M)
        to_v = jnp.where(out_u < FACE_OVERHANG_M, jnp.abs(v - face_v), FAR_M)
        near = NEAR_M / fast_max(fast_min(to_u, to_v), NEAR_M)
        return total + inside_weight * inside.astype(jnp.float32) + near_weight * near

    # Points that are absent are far from all boxes.
    total = fold_points(x, y, count, jnp.zeros_like(box_v), update, absent=(FAR_M, FAR_M))
    return total / jnp.maximum(count, 1).astype(jnp.float32)[None]


def choose_placement(
    worth: jax.Array,
    agreement: jax.Array,
    *,
    hit: jax.Array,
    free: jax.Array,
    free_length: jax.Array,
    free_weight: jax.Array | float,
    free_length_weight: jax.Array | float,
    closeness_weight: jax.Array | float,
    not_away_cost: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """The hypothesis of each way that explains the evidence best.

    J = hit - wf free - wl free_length + agreement + wc worth - cost [width not away].

    Args:
      worth: (C,) float32, of the rectangle.
      agreement: (3, C) float32, see `point_agreement`.
      hit: (3, C) float32, fraction of rays.
      free: (3, C) float32, fraction of rays.
      free_length: (3, C) float32, fraction of the rays' length.
      free_weight: wf.
      free_length_weight: wl.
      closeness_weight: wc.
      not_away_cost: cost.

    Returns:
      Its placement (C,) int32, the first of equally good ones, and its J (C,) float32.
    """
    number = jnp.arange(NUM_PLACEMENTS, dtype=jnp.int32)[:, None]
    cost = not_away_cost * (number > 0).astype(jnp.float32)
    objective = hit - free_weight * free - free_length_weight * free_length + agreement
    objective = objective + closeness_weight * worth[None] - cost
    best = jnp.max(objective, axis=0)
    # An argmax does not vectorise (XLA, CPU).
    placement = jnp.where(objective >= best[None], number, NUM_PLACEMENTS)
    return jnp.min(placement, axis=0), best
