"""Correction for occluded vehicles: hidden sides are completed by the class prior, away from the sensor."""

import math

import jax
import jax.numpy as jnp

from jaxbox.masked import fold_points
from jaxbox.types import NOT_A_BOX, Boxes, Rectangles

INSIDE_MARGIN_M = 0.1
"""A point this far outside a hypothesis still counts as inside."""

NEAR_M = 0.1
"""A point nearer than this to a visible face counts as on it."""

FACE_OVERHANG_M = 0.3
"""Faces reach this far beyond their corners when points are held against them."""

NUM_PLACEMENTS = 3
"""Where a completed width goes: away from the sensor, towards it, or both ways."""

SEEN_RAMP = 0.05
"""Fraction of the usual size over which a side goes from partly hidden to seen whole."""

CERTAIN = 1e3
"""Objective of a box that was not held against evidence: it passes any gate on the objective."""


def _sides(rectangle: Rectangles) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The two ways to call one side the length: low and high (P, 2 ways, 2 sides) and yaw (P, 2)."""
    u0, v0 = rectangle.low[:, 0], rectangle.low[:, 1]
    u1, v1 = rectangle.high[:, 0], rectangle.high[:, 1]
    # With the length along v the frame turns by a quarter: across it lies -u.
    low = jnp.stack([jnp.stack([u0, v0], 1), jnp.stack([v0, -u1], 1)], axis=1)
    high = jnp.stack([jnp.stack([u1, v1], 1), jnp.stack([v1, -u0], 1)], axis=1)
    yaw = jnp.stack([rectangle.angle, rectangle.angle + math.pi / 2], axis=1)
    return low, high, yaw


def usual_sizes(rectangle: Rectangles, length_m: jax.Array, width_m: jax.Array) -> jax.Array:
    """The class's size, or the measured where that is larger.

    Args:
      rectangle: P rectangles.
      length_m: (P,) float32, m, of the class.
      width_m: (P,) float32, m, of the class.

    Returns:
      (P, 2 ways, 2) float32, m: length and width, with either side as the length.
    """
    low, high, _ = _sides(rectangle)
    return jnp.maximum(jnp.stack([length_m, width_m], axis=-1)[:, None], high - low)


def likely_sizes(
    rectangle: Rectangles,
    length_m: jax.Array,
    width_m: jax.Array,
    *,
    seen_length: jax.Array | float,
    seen_width: jax.Array | float,
    seen_weight: jax.Array | float,
    length_margin_m: jax.Array | float,
    width_margin_m: jax.Array | float,
) -> jax.Array:
    """The class's size for sides that may be hidden in part; between it and the measured for the others.

    Args:
      rectangle: P rectangles.
      length_m: (P,) float32, m, of the class.
      width_m: (P,) float32, m, of the class.
      seen_length: fraction of the class's length from which a side may be seen whole.
      seen_width: the same of its width.
      seen_weight: what the measured size of such a side weighs against the class's.
      length_margin_m: measured lengths read short by this, m.
      width_margin_m: measured widths read short by this, m.

    Returns:
      (P, 2 ways, 2) float32, m: as `usual_sizes`; at least as measured.

    Reference: oracle `jaxbox.reference.likely_size`.
    """
    low, high, _ = _sides(rectangle)
    measured = high - low
    usual = jnp.stack([length_m, width_m], axis=-1)[:, None]
    seen, margin = jnp.array([seen_length, seen_width]), jnp.array([length_margin_m, width_margin_m])
    whole = jnp.clip((measured / usual - seen) / SEEN_RAMP, 0, 1)
    return jnp.maximum(usual + seen_weight * whole * (measured + margin - usual), measured)


def _extend(low: jax.Array, high: jax.Array, size: jax.Array) -> jax.Array:
    """Centres (..., 3) of an interval grown to `size`: from the near end, the far end, both."""
    from_low, from_high, middle = low + size / 2, high - size / 2, (low + high) / 2
    # The same as |low| < |high|, but right for a side without extent too: it grows away.
    low_is_near = low + high > 0
    away = jnp.where(low_is_near, from_low, from_high)
    towards = jnp.where(low_is_near, from_high, from_low)
    return jnp.stack([away, towards, middle], axis=-1)


def keep_measured(rectangle: Rectangles, *, max_length_m: jax.Array, max_width_m: jax.Array) -> Boxes:
    """The rectangles as measured, the longer side as length (the paper).

    Args:
      rectangle: P rectangles.
      max_length_m: (P,) float32, m.
      max_width_m: (P,) float32, m.

    Returns:
      Boxes (P,); no box where a measured side is too long.
    """
    low, high, _ = _sides(rectangle)
    return extend_away(rectangle, high - low, max_length_m=max_length_m, max_width_m=max_width_m)


def extend_away(
    rectangle: Rectangles, sizes: jax.Array, *, max_length_m: jax.Array, max_width_m: jax.Array
) -> Boxes:
    """Completes both sides away from the sensor, the longer side as length.

    The sensor sees the near ends of both sides; what is missing is behind them.

    Args:
      rectangle: P rectangles.
      sizes: (P, 2 ways, 2) float32, m, see `likely_sizes`.
      max_length_m: (P,) float32, m.
      max_width_m: (P,) float32, m.

    Returns:
      Boxes (P,); no box where a measured side is too long.
    """
    boxes = box_hypotheses(rectangle, sizes, max_length_m=max_length_m, max_width_m=max_width_m)
    way = (boxes.measured[:, NUM_PLACEMENTS, 0] > boxes.measured[:, 0, 0]).astype(jnp.int32)
    first = jax.tree.map(lambda a: a[jnp.arange(a.shape[0]), way * NUM_PLACEMENTS], boxes)
    objective = jnp.where(first.objective > NOT_A_BOX, CERTAIN, NOT_A_BOX)
    return Boxes(first.center, first.length, first.width, first.yaw, first.measured, objective)


def box_hypotheses(
    rectangle: Rectangles, sizes: jax.Array, *, max_length_m: jax.Array, max_width_m: jax.Array
) -> Boxes:
    """The vehicles that may hide behind each rectangle: which side is the length, where the width goes.

    The length is completed away from the sensor; the width away from it, towards it, or both ways.

    Args:
      rectangle: P rectangles.
      sizes: (P, 2 ways, 2) float32, m, at least as measured: see `usual_sizes`, `likely_sizes`.
      max_length_m: (P,) float32, m, longest measured length.
      max_width_m: (P,) float32, m, widest measured width.

    Returns:
      Boxes (P, 6) with objective 0, or `NOT_A_BOX` where a measured side is too long.

    Reference: oracle `jaxbox.reference.complete_box`.
    """
    low, high, yaw = _sides(rectangle)
    centre_u = _extend(low[..., 0], high[..., 0], sizes[..., 0])
    v = _extend(low[..., 1], high[..., 1], sizes[..., 1])
    u = centre_u[..., :1]
    cos, sin = jnp.cos(yaw)[..., None], jnp.sin(yaw)[..., None]
    center = jnp.stack([cos * u - sin * v, sin * u + cos * v], axis=-1)
    measured = high - low
    fits = (measured[..., 0] <= max_length_m[:, None]) & (measured[..., 1] <= max_width_m[:, None])

    def flat(a: jax.Array) -> jax.Array:
        placed = jnp.broadcast_to(a[:, :, None], (a.shape[0], 2, NUM_PLACEMENTS, *a.shape[2:]))
        return placed.reshape(a.shape[0], 2 * NUM_PLACEMENTS, *a.shape[2:])

    return Boxes(
        center=center.reshape(-1, 2 * NUM_PLACEMENTS, 2),
        length=flat(sizes[..., 0]),
        width=flat(sizes[..., 1]),
        yaw=flat(yaw),
        measured=flat(measured),
        objective=jnp.where(flat(fits), 0, NOT_A_BOX),
    )


def point_agreement(boxes: Boxes, points: jax.Array, count: jax.Array) -> tuple[jax.Array, jax.Array]:
    """How well boxes hold the points they were made from, and how close these are to visible faces.

    Args:
      boxes: (P, S) hypotheses.
      points: (P, M, 2) float32, m.
      count: (P,) int32, points of each.

    Returns:
      inside: (P, S) float32 in [0, 1]: fraction of the points inside the box, give or take 10 cm.
      near: (P, S) float32 in [0, 1]: mean of .1 / max(d, .1), d the distance to the nearest visible face.
    """
    cos, sin = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    x0, y0 = boxes.center[..., 0], boxes.center[..., 1]
    half_l, half_w = boxes.length / 2, boxes.width / 2
    # The sensor at the origin, in the box's frame: it sees the faces on its side of the box.
    sensor_u, sensor_v = -(x0 * cos + y0 * sin), x0 * sin - y0 * cos
    face_u = jnp.where(sensor_u > 0, half_l, -half_l)
    face_v = jnp.where(sensor_v > 0, half_w, -half_w)
    sees_u, sees_v = jnp.abs(sensor_u) > half_l, jnp.abs(sensor_v) > half_w

    def update(state: tuple[jax.Array, jax.Array], x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        u, v = (x - x0) * cos + (y - y0) * sin, (y - y0) * cos - (x - x0) * sin
        out_u, out_v = jnp.abs(u) - half_l, jnp.abs(v) - half_w
        inside = (out_u < INSIDE_MARGIN_M) & (out_v < INSIDE_MARGIN_M)
        to_u = jnp.where(sees_u & (out_v < FACE_OVERHANG_M), jnp.abs(u - face_u), jnp.inf)
        to_v = jnp.where(sees_v & (out_u < FACE_OVERHANG_M), jnp.abs(v - face_v), jnp.inf)
        near = NEAR_M / jnp.maximum(jnp.minimum(to_u, to_v), NEAR_M)
        return state[0] + inside, state[1] + near

    zero = jnp.zeros_like(boxes.yaw)
    inside, near = fold_points(points, count, (zero, zero), update)
    total = jnp.maximum(count, 1)[:, None]
    return inside / total, near / total


def choose_hypothesis(
    boxes: Boxes,
    likely: Boxes,
    worth: jax.Array,
    *,
    hit: jax.Array,
    free: jax.Array,
    free_length: jax.Array,
    inside: jax.Array,
    near: jax.Array,
    free_weight: jax.Array | float,
    free_length_weight: jax.Array | float,
    inside_weight: jax.Array | float,
    near_weight: jax.Array | float,
    closeness_weight: jax.Array | float,
    not_away_cost: jax.Array | float,
) -> Boxes:
    """The hypothesis that explains the evidence best.

    J = hit - wf free - wl free_length + wi inside + wn near + wc worth - cost [width not away].

    Args:
      boxes: (P, S) hypotheses, see `box_hypotheses`, as the evidence judges them: a box of the class's
        size asks more of it.
      likely: (P, S) the same at their likely sizes, which are answered.
      worth: (P, S) float32, of the rectangle.
      hit: (P, S) float32, fraction of rays.
      free: (P, S) float32, fraction of rays.
      free_length: (P, S) float32, fraction of the rays' length.
      inside: (P, S) float32, fraction of points.
      near: (P, S) float32, closeness to visible faces.
      free_weight: wf.
      free_length_weight: wl.
      inside_weight: wi.
      near_weight: wn.
      closeness_weight: wc.
      not_away_cost: cost.

    Returns:
      Boxes (P,) with their J; `NOT_A_BOX` where no hypothesis is left.
    """
    placement = jnp.arange(boxes.yaw.shape[1]) % NUM_PLACEMENTS
    objective = hit - free_weight * free - free_length_weight * free_length
    objective = objective + inside_weight * inside + near_weight * near
    objective = objective + closeness_weight * worth - not_away_cost * (placement > 0)
    objective = jnp.where(boxes.objective > NOT_A_BOX, objective, NOT_A_BOX)
    best = jnp.argmax(objective, axis=1)
    rows = jnp.arange(best.shape[0])
    chosen = jax.tree.map(lambda a: a[rows, best], likely)
    return Boxes(
        chosen.center, chosen.length, chosen.width, chosen.yaw, chosen.measured, objective[rows, best]
    )
