"""Whether something nearer hides a track from the sensor."""

import jax
import jax.numpy as jnp

from jaxbox.config import TrackConfig
from jaxbox.geometry.planar import rectangle_corners, rotate

NUM_RAYS = 24
"""Azimuths over a box at which the nearest return is looked up."""
TURN = 2 * jnp.pi


def is_hidden(
    center: jax.Array, size: jax.Array, yaw: jax.Array, first_return_m: jax.Array, config: TrackConfig
) -> jax.Array:
    """Whether more than a share of the azimuths over a box have a return well before it.

    Args:
      center: (T, 2) float32, m, sensor frame.
      size: (T, 2) float32, m: length, width.
      yaw: (T,) float32, rad.
      first_return_m: (A,) float32, m, from azimuth -pi on.
      config: of the tracker.

    Returns:
      (T,) bool.
    """
    num_azimuths = first_return_m.shape[0]
    corners = rectangle_corners(center, size, yaw)
    middle = jnp.arctan2(center[:, 1], center[:, 0])
    offset = jnp.arctan2(corners[..., 1], corners[..., 0]) - middle[:, None]
    offset = offset - TURN * jnp.round(offset / TURN)
    low, high = jnp.min(offset, axis=1), jnp.max(offset, axis=1)
    share = jnp.linspace(0.0, 1.0, NUM_RAYS, dtype=jnp.float32)
    azimuth = middle[:, None] + low[:, None] + (high - low)[:, None] * share[None]
    cell = jnp.floor((azimuth / TURN + 0.5) * num_azimuths).astype(jnp.int32) % num_azimuths
    # Of the whole outline: a long vehicle next to the sensor is much nearer than its corners.
    outside = jnp.maximum(jnp.abs(rotate(-center, -yaw)) - size / 2, 0)
    nearest = jnp.linalg.norm(outside, axis=1)
    is_before = first_return_m[cell] < nearest[:, None] - config.hidden_gap_m
    return jnp.mean(is_before.astype(jnp.float32), axis=1) > config.hidden_share
