"""Plane geometry that several layers share: angles, rectangles and their overlap."""

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


def rectangle_corners(center: jax.Array, size: jax.Array, yaw: jax.Array) -> jax.Array:
    """Corners of oriented rectangles, counter-clockwise from front left.

    Args:
      center: (..., 2 or more), m: x, y.
      size: (..., 2 or more), m: length along the yaw axis, width across it.
      yaw: (...), rad.

    Returns:
      (..., 4, 2), m: front left, rear left, rear right, front right.
    """
    signs = jnp.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    local = signs * size[..., None, :2] / 2
    return center[..., None, :2] + rotate(local, yaw[..., None])
