"""Whether a sweep can be trusted: what weather, a failing sensor, wrong units or a wrong origin do to it.

None of it changes a box; the status doubts the sweep where the figures pass the limits of `HealthConfig`.
"""

import chex
import jax
import jax.numpy as jnp

from jaxbox.config import GroundConfig, HealthConfig
from jaxbox.stages.state import Evidence, Ground, Health, Sweep
from jaxbox.xla.range_bits import shared_cells
from jaxbox.xla.rows import count_each, count_true

NEAR_M = (3.0, 12.0)
"""Ranges at which the ground is compared with its surface: noise blurs it there, slopes hardly do."""

GROUND_BAND_M, ROUGH_M = 0.3, 0.05
"""What is nearer to the ground than the first is compared with it, and is rough beyond the second, as roads
are flatter; what lies lower than the first is below the ground."""

LOW_M, MIN_HEIGHT_M = 0.8, 0.2
"""A sensor between these heights sees less far over the ground, and what is far is nearer. Ground that is
nearer to the origin, or none at all, says nothing."""

UNDER_RATIO = 0.6
"""Nearer than this share of its height no vehicle's sensor sees the road: that is 59 degrees below level."""


def measure_health(
    sweep: Sweep, ground: Ground, evidence: Evidence | None, config: HealthConfig, ground_config: GroundConfig
) -> Health:
    """Counts what good sweeps have much of, or nothing.

    Fog and rain take the far points; drops, flakes and dust return from the air near the sensor, where other
    beams pass; noise blurs the ground. Where the origin is not the sensor's, there is ground right under it.
    Where the road is not the ground that was found, much lies below the ground.

    Args:
      sweep: of N rows.
      ground: below them.
      evidence: what the beams saw; None where the preset does not ask for it.
      config: what is far.
      ground_config: up to which height a point is on the ground.

    Returns:
      The counts.

    Reference: oracle `jaxbox.reference.measure_health`.
    """
    chex.assert_shape([sweep.inlier, ground.height], sweep.xyz.shape[:1])
    rho = jnp.sqrt(sweep.xyz[:, 0] ** 2 + sweep.xyz[:, 1] ** 2)
    off_ground = jnp.abs(ground.height)
    # Without its grid the ground is a plane, and no road is.
    follows_road = ground.surface is not None
    near = sweep.inlier & (rho > NEAR_M[0]) & (rho < NEAR_M[1]) & (off_ground < GROUND_BAND_M) & follows_road
    under = sweep.inlier & (off_ground < ground_config.min_height_m)
    sensor_height_m = -ground.plane.coefficients[2]
    under &= rho < UNDER_RATIO * sensor_height_m
    share = jnp.where(sensor_height_m < MIN_HEIGHT_M, 1, jnp.minimum(sensor_height_m / LOW_M, 1))
    far = sweep.finite & (~sweep.in_region | (rho > config.far_m * share))
    below = sweep.inlier & (ground.height <= -GROUND_BAND_M) & follows_road
    far, near, rough, under, below = count_each(far, near, near & (off_ground > ROUGH_M), under, below)
    return Health(far, _scattered_azimuths(evidence), near, rough, under, below)


def _scattered_azimuths(evidence: Evidence | None) -> jax.Array:
    """() int32: azimuth cells in which a cell of the nearest block was both hit and seen through."""
    if evidence is None:
        return jnp.int32(0)
    return count_true(shared_cells(evidence.low_hit[0], evidence.free[0]) > 0)
