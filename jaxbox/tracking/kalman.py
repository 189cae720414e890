"""A Kalman filter of position and velocity whose two axes share one 2 x 2 covariance.

Noise is the same in every direction, so the filter is a few multiplications and needs no inverse, and no
turn of the frame changes its covariance.
"""

import jax
import jax.numpy as jnp

from jaxbox.config import Scalar

OUTLIER_SDS = 3.0
"""A measured position that lies more standard deviations than this from the expected one is an outlier."""


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


def squared_distance(position: jax.Array, measured: jax.Array) -> jax.Array:
    """(...) float32, m^2: of measured places (..., 2) from those that are predicted, m."""
    gap = measured - position
    # The two axes by name: a sum over an axis of two takes several times as long.
    return gap[..., 0] ** 2 + gap[..., 1] ** 2


def outlier_variance(
    position: jax.Array, covariance: jax.Array, measured: jax.Array, variance: jax.Array
) -> jax.Array:
    """Variance of a measured position, raised for an outlier until it is none: d^2 = 9 for any beyond.

    A box of another face, or of a part of a vehicle, may lie metres aside: taken at its word, it changes the
    velocity by metres a second, and the track is lost. Raising the measurement's variance by its innovation
    is the usual robust Kalman filter (Huber, 1964; Chang, 2014, doi:10.1007/s00190-013-0690-8).

    Args:
      position: (..., 2) float32, m, predicted.
      covariance: (..., 3) float32, predicted.
      measured: (..., 2) float32, m.
      variance: (...) float32, m^2, of the measurement along each axis; positive.

    Returns:
      (...) float32, m^2: `variance`, or more.
    """
    distance_sq = squared_distance(position, measured)
    beyond = distance_sq / OUTLIER_SDS**2 - (covariance[..., 0] + variance)
    return variance + jnp.maximum(beyond, 0)


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
