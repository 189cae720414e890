"""Plane geometry that several layers share: angles, rectangles and their overlap."""

import math
from typing import Any

import jax
import jax.numpy as jnp

HALF_TURN = jnp.pi


def wrap_yaw(yaw: jax.Array) -> jax.Array:
    """Wraps an angle of an axis, which has no front, to [-pi/2, pi/2).

    Args:
      yaw: any shape, rad.

    Returns:
      The same shape, rad, in [-pi/2, pi/2).
    """
    wrapped = yaw - HALF_TURN * jnp.floor(yaw / HALF_TURN + 0.5)
    # Rounding can land on the open end.
    return jnp.where(wrapped >= HALF_TURN / 2, -HALF_TURN / 2, wrapped)


def wrap_turn(angle: Any) -> Any:
    """Wraps an angle to the nearest turn, [-pi, pi].

    Args:
      angle: a NumPy or JAX array of any shape, rad.

    Returns:
      The same kind and shape, rad, in [-pi, pi].
    """
    return angle - 2 * math.pi * (angle / (2 * math.pi)).round()


def rotate(xy: jax.Array, yaw: jax.Array) -> jax.Array:
    """Turns points about the origin.

    Args:
      xy: (..., 2), m.
      yaw: (...), rad, counter-clockwise.

    Returns:
      (..., 2), m.
    """
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    x, y = xy[..., 0], xy[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def plane_residual(xyz: jax.Array, plane: jax.Array) -> jax.Array:
    """Height over a plane: z - (a x + b y + c).

    Args:
      xyz: (..., 3) float32, m.
      plane: (3,) float32: a, b, c.

    Returns:
      (...) float32, m.
    """
    return xyz[..., 2] - (plane[0] * xyz[..., 0] + plane[1] * xyz[..., 1] + plane[2])


def rectangle_corners(center: jax.Array, size: jax.Array, yaw: jax.Array) -> jax.Array:
    """Corners of oriented rectangles, counter-clockwise from front left.

    Args:
      center: (..., 2 or more), m: x, y.
      size: (..., 2 or more), m: length along the yaw axis, width across it.
      yaw: (...), rad.

    Returns:
      (..., 4, 2), m: front left, rear left, rear right, front right.
    """
    signs = jnp.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], size.dtype)
    local = jnp.broadcast_to(signs, (*size.shape[:-1], 4, 2)) * size[..., None, :2] / 2
    return center[..., None, :2] + rotate(local, yaw[..., None])


def rectangle_intersection(box_a: jax.Array, box_b: jax.Array) -> jax.Array:
    """Area that two oriented rectangles share.

    In the frame of b, where b is the window |x| <= L, |y| <= W, Green's theorem gives the area as
    -sum over the edges of a of the integral of clamp(y, -W, W) dx over |x| <= L. Unlike clipping
    polygons it needs no sorting, and it is continuous: coincident edges and equal boxes need no special case.

    Args:
      box_a: (5,) float, m and rad: x, y, length, width, yaw. Sizes are not negative.
      box_b: (5,), likewise. Batch both with `jax.vmap`.

    Returns:
      () m^2, in [0, area of the smaller]; about 1e-6 of the areas is rounding.

    >>> box = jnp.array([10.0, 5.0, 4.0, 2.0, 0.3])
    >>> round(float(rectangle_intersection(box, box)), 4)
    8.0
    """
    cos_a, sin_a = jnp.cos(box_a[4]), jnp.sin(box_a[4])
    cos_b, sin_b = jnp.cos(box_b[4]), jnp.sin(box_b[4])
    # The difference of the angles by products: under two vmaps the sines are of K boxes, not of K^2 pairs.
    cos, sin = cos_a * cos_b + sin_a * sin_b, sin_a * cos_b - cos_a * sin_b
    # Relative to the centre of b, so that float32 holds at any distance from the sensor.
    dx, dy = box_a[0] - box_b[0], box_a[1] - box_b[1]
    x, y = cos_b * dx + sin_b * dy, cos_b * dy - sin_b * dx
    ux, uy = cos * box_a[2] / 2, sin * box_a[2] / 2
    vx, vy = -sin * box_a[3] / 2, cos * box_a[3] / 2
    half_x, half_y = box_b[2] / 2, box_b[3] / 2
    # The corners counter-clockwise, each with the edge that leaves it.
    signed = (
        _clamped_integral(x + ux + vx, y + uy + vy, -2 * ux, -2 * uy, half_x=half_x, half_y=half_y)
        + _clamped_integral(x - ux + vx, y - uy + vy, -2 * vx, -2 * vy, half_x=half_x, half_y=half_y)
        + _clamped_integral(x - ux - vx, y - uy - vy, 2 * ux, 2 * uy, half_x=half_x, half_y=half_y)
        + _clamped_integral(x + ux - vx, y + uy - vy, 2 * vx, 2 * vy, half_x=half_x, half_y=half_y)
    )
    return jnp.clip(-signed, 0, jnp.minimum(box_a[2] * box_a[3], box_b[2] * box_b[3]))


# Steps shorter than this (m) count as this long: the part of the edge inside the window then is wrong,
# but its integral, a product with the step, is not.
_MIN_STEP = 1e-12


def _clamped_integral(
    x: jax.Array, y: jax.Array, dx: jax.Array, dy: jax.Array, *, half_x: jax.Array, half_y: jax.Array
) -> jax.Array:
    """Integral of clamp(y, +-half_y) dx along the part within |x| <= half_x of the edge from (x, y)."""
    per_dx = 1 / jnp.where(jnp.abs(dx) < _MIN_STEP, _MIN_STEP, dx)
    per_dy = 1 / jnp.where(jnp.abs(dy) < _MIN_STEP, _MIN_STEP, dy)
    left, right = jnp.clip((-half_x - x) * per_dx, 0, 1), jnp.clip((half_x - x) * per_dx, 0, 1)
    start, end = jnp.minimum(left, right), jnp.maximum(left, right)
    # clamp(y) is constant up to one crossing, linear between the two, then constant: only their sum enters.
    crossings = jnp.clip((-half_y - y) * per_dy, start, end) + jnp.clip((half_y - y) * per_dy, start, end)
    first, last = jnp.clip(y + start * dy, -half_y, half_y), jnp.clip(y + end * dy, -half_y, half_y)
    return dx * (first * (crossings - 2 * start) + last * (2 * end - crossings)) / 2


def rectangle_iou(box_a: jax.Array, box_b: jax.Array) -> jax.Array:
    """Intersection over union of two oriented rectangles: the bird's-eye overlap of two boxes.

    Args:
      box_a: (5,) float, m and rad: x, y, length, width, yaw. Sizes are not negative.
      box_b: (5,), likewise. Batch both with `jax.vmap`.

    Returns:
      () in [0, 1]: symmetric to rounding, 1 for equal boxes, 0 where a box has no area.

    >>> box = jnp.array([10.0, 5.0, 4.0, 2.0, 0.0])
    >>> round(float(rectangle_iou(box, box.at[0].add(2.0))), 4)
    0.3333
    """
    shared = rectangle_intersection(box_a, box_b)
    union = box_a[2] * box_a[3] + box_b[2] * box_b[3] - shared
    return jnp.where(union > 0, shared / jnp.where(union > 0, union, 1), 0)
