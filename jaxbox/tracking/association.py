"""Assigns detections to tracks: squared Mahalanobis distance, in two stages, best pairs first."""

import jax
import jax.numpy as jnp

from jaxbox.config import TrackConfig
from jaxbox.tracking.state import Observations, Slots
from jaxbox.xla.assignment import assign_greedily

STAGE_COST = 1e3
"""Added for detections of a low score: more than any other difference, so that they come second."""


def position_variance(center: jax.Array, config: TrackConfig) -> jax.Array:
    """Variance of detected positions along each axis, which grows with range.

    Args:
      center: (..., 2 or 3) float32, m, sensor frame.
      config: of the tracker.

    Returns:
      (...) float32, m^2.
    """
    range_m = jnp.linalg.norm(center[..., :2], axis=-1)
    return (config.position_sd_m + config.position_sd_grade * range_m) ** 2


def associate(slots: Slots, seen: Observations, usable: jax.Array, config: TrackConfig) -> jax.Array:
    """The detection of each track.

    The cost of a pair is d^2 + log det S with the squared Mahalanobis distance d^2 of the positions; pairs
    are taken in the order of cost, which at 10 Hz nearly always is the optimal assignment.

    Args:
      slots: T predicted tracks, in the sensor frame of the sweep.
      seen: D detections.
      usable: (D,) bool, those to match.
      config: of the tracker.

    Returns:
      (T,) int32: row of the detection, D for none.
    """
    # The two axes by name: a sum over an axis of two takes several times as long.
    gap_x = seen.center[None, :, 0] - slots.position[:, None, 0]
    gap_y = seen.center[None, :, 1] - slots.position[:, None, 1]
    variance = position_variance(seen.center, config) + config.placement_sd_m**2
    variance = slots.covariance[:, None, 0] + variance[None]
    distance_sq = (gap_x**2 + gap_y**2) / variance
    allowed = slots.alive[:, None] & usable[None] & (distance_sq < config.gate)
    stage_cost = jnp.where(seen.score < config.high_score, STAGE_COST, 0.0)
    cost = distance_sq + 2 * jnp.log(variance) + stage_cost[None]
    return assign_greedily(cost, allowed)
