"""A Kalman filter of position and velocity whose two axes share one 2 x 2 covariance.

Noise is the same in every direction, so the filter is a few multiplications and needs no inverse, and no
turn of the frame changes its covariance.
"""

import jax
import jax.numpy as jnp

from jaxbox.config import Scalar


def predict_covariance(covariance: jax.Array, dt: jax.Array, acceleration_mps2: Scalar) -> jax.Array:
    """Covariance after a time at constant velocity with white acceleration.

    Args:
      covariance: (..., 3) float32: of position, of position and velocity, of velocity.
      dt: () float32, s.
      acceleration_mps2: () float32, its standard deviation.

    Returns:
      (..., 3) float32.
    """
    pp, pv, vv = covariance[..., 0], covariance[..., 1], covariance[..., 2]
    q = acceleration_mps2**2
    return jnp.stack(
        [
            pp + 2 * dt * pv + dt**2 * vv + dt**4 / 4 * q,
            pv + dt * vv + dt**3 / 2 * q,
            vv + dt**2 * q,
        ],
        axis=-1,
    )


def update(
    position: jax.Array,
    velocity: jax.Array,
    covariance: jax.Array,
    measured: jax.Array,
    variance: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Position, velocity and covariance after a measurement of the position.

    Args:
      position: (..., 2) float32, m, predicted.
      velocity: (..., 2) float32, m/s.
      covariance: (..., 3) float32, predicted.
      measured: (..., 2) float32, m.
      variance: (...) float32, m^2, of the measurement along each axis; positive.

    Returns:
      The same three, updated.
    """
    pp, pv, vv = covariance[..., 0], covariance[..., 1], covariance[..., 2]
    total = pp + variance
    position_gain, velocity_gain = pp / total, pv / total
    innovation = measured - position
    after = jnp.stack([pp * (1 - position_gain), pv * (1 - position_gain), vv - velocity_gain * pv], axis=-1)
    return (
        position + position_gain[..., None] * innovation,
        velocity + velocity_gain[..., None] * innovation,
        after,
    )
