"""Yaw, size and front of a track from all its detections: votes and evidence, no filter.

A filter of the yaw would lock on to a reading that is a quarter turn off; votes are outvoted. Sizes are
means, but never shorter than what was seen.
"""

import math

import jax
import jax.numpy as jnp

from jaxbox.config import TrackConfig
from jaxbox.geometry.planar import rotate, wrap_yaw
from jaxbox.tracking.state import Observations, Slots

MAX_YAW_POINTS = 300.0
"""More points than this add nothing to the weight of a detection's yaw,"""
MAX_SIZE_POINTS = 500.0
"""and more than this nothing to that of its size."""
CROSSED_WEIGHT = 1e-3
"""Weight of the size of a detection whose length lies across the track's, and of one without points."""
MATURE_HITS = 3
"""From more detections on, velocity and extents are believed."""
SEEN_QUANTILE = 0.9
"""Quantile of the seen extents that a track is at least as long as."""
SEEN_STEP_M = 0.5
"""First step of the search for that quantile, m; it shrinks with the number of detections,"""
SEEN_MIN_STEP_M = 0.05
"""to this."""
MAX_GROWTH = 1.25
"""What was seen makes a box longer than the mean by this factor at most."""
SEEN_SHARE = 0.8
"""A side of which a sweep saw more than this share of the track's is as long as that sweep says."""
TRACK_WEIGHT = 0.5
"""What the box of a track counts next to that of its detection, where both score alike."""
MAX_COURSE_SD = 0.15
"""The course is believed where the velocity's standard deviation is below this share of the speed."""
FULL_FRONT_SPEED_MPS = 3.0
"""Speed from which a sweep's motion counts as one whole vote for the front."""
PROFILE_CORRELATION = 0.15
"""Correlation of the log odds that two sweeps see of one vehicle's front. Chosen on two real and six ray-cast
drives, each left out in turn: .05 to .15 predict fronts equally well, and the largest is the least sure."""
MAX_PROFILE_LOG_ODDS = 6.0
"""However many sweeps agree on a profile, it is outvoted by this many whole votes of motion."""
MAX_TURN_RATE = math.pi / 2
"""No vehicle turns faster, rad/s; a rate beyond it is of two sweeps with nearly the same time."""


def doubled(yaw: jax.Array) -> jax.Array:
    """(..., 2): cos and sin of twice an angle, which are the same for both ends of an axis."""
    return jnp.stack([jnp.cos(2 * yaw), jnp.sin(2 * yaw)], axis=-1)


def yaw_weight(seen: Observations) -> jax.Array:
    """(D,) float32: what the yaw of each detection counts: its score times the root of its points.

    A detection whose points were not counted has one.
    """
    return seen.score * jnp.sqrt(jnp.clip(seen.num_points.astype(jnp.float32), 1, MAX_YAW_POINTS))


def size_sums(seen: Observations, is_crossed: jax.Array) -> jax.Array:
    """(D, 4) float32: what each detection adds to `Slots.size_sum`."""
    points = jnp.clip(seen.num_points.astype(jnp.float32), 0, MAX_SIZE_POINTS)
    weight = points * jnp.where(is_crossed, CROSSED_WEIGHT, 1.0) + CROSSED_WEIGHT
    return jnp.concatenate([seen.size * weight[:, None], weight[:, None]], axis=1)


def is_course_sure(slots: Slots, config: TrackConfig) -> jax.Array:
    """(T,) bool: whether a track is fast enough, and long enough known, that its course is its axis."""
    variance = 2 * slots.covariance[:, 2]
    fast = (slots.speed > config.course_speed_mps) & (slots.hits > MATURE_HITS)
    return fast & (variance < (MAX_COURSE_SD * slots.speed) ** 2)


def update_yaw(
    slots: Slots, seen: Observations, dt: jax.Array, config: TrackConfig
) -> tuple[jax.Array, jax.Array]:
    """Votes for the yaw, and the turn rate, after a detection.

    Args:
      slots: T tracks, whose votes are already turned to where they are expected.
      seen: T rows, the detection of each.
      dt: () float32, s.
      config: of the tracker.

    Returns:
      vote: (T, 2) float32.
      turn_rate: (T,) float32, rad/s; 0 for a vehicle that does not move.
    """
    moving = slots.moving & (slots.hits > MATURE_HITS)
    memory = jnp.where(moving, config.yaw_memory_moving, config.yaw_memory)
    vote = slots.yaw_vote * memory[:, None]
    innovation = wrap_yaw(seen.yaw - slots.yaw)
    # A larger one is another face that was taken for the side, and no turn.
    correction = jnp.where(jnp.abs(innovation) < jnp.pi / 8, config.turn_gain * innovation / dt, 0.0)
    turn_rate = jnp.clip(slots.turn_rate + correction, -MAX_TURN_RATE, MAX_TURN_RATE)
    turn_rate = jnp.where(moving, turn_rate, 0.0)
    vote = vote + yaw_weight(seen)[:, None] * doubled(seen.yaw)
    course = jnp.arctan2(slots.velocity[:, 1], slots.velocity[:, 0])
    course_weight = jnp.where(is_course_sure(slots, config), config.course_weight, 0.0)
    return vote + course_weight[:, None] * doubled(course), turn_rate


def update_front(slots: Slots) -> jax.Array:
    """(T, 2) float32: votes for the front, after a sweep in which a moving vehicle was detected."""
    speed = slots.speed[:, None]
    direction = slots.velocity / jnp.maximum(speed, 1e-6)
    weight = jnp.minimum(speed / FULL_FRONT_SPEED_MPS, 1.0)
    return slots.front_vote + jnp.where(slots.moving[:, None], weight * direction, 0.0)


def profile_votes(seen: Observations) -> jax.Array:
    """(D, 2) float32: what each detection adds to `Slots.profile_vote`."""
    axis = jnp.stack([jnp.cos(seen.yaw), jnp.sin(seen.yaw)], axis=-1)
    return seen.front_log_odds[:, None] * axis


def profile_log_odds(axis: jax.Array, slots: Slots) -> jax.Array:
    """Log odds that the front is where a direction points, by the profiles of all n detections.

    With the same correlation rho between any two of them, and normal errors, they are the sum of theirs over
    1 + (n - 1) rho: n alike are never worth more than 1 / rho of them.

    Args:
      axis: (T, 2) float32, of length 1.
      slots: T tracks.

    Returns:
      (T,) float32.
    """
    num_more = jnp.maximum(slots.hits.astype(jnp.float32) - 1, 0)
    log_odds = jnp.sum(axis * slots.profile_vote, axis=-1) / (1 + num_more * PROFILE_CORRELATION)
    return jnp.clip(log_odds, -MAX_PROFILE_LOG_ODDS, MAX_PROFILE_LOG_ODDS)


def update_extent(slots: Slots, seen: Observations, is_crossed: jax.Array) -> jax.Array:
    """Quantile of the seen extents by stochastic approximation (Robbins and Monro, 1951).

    Each extent moves the estimate up by q or down by 1 - q of a step, so that it rests where a share q is
    below.

    Args:
      slots: T tracks.
      seen: T rows, the detection of each.
      is_crossed: (T,) bool, whose length lies across the track's; they are left out.

    Returns:
      (T, 2) float32, m.
    """
    hits = slots.hits[:, None].astype(jnp.float32)
    step = jnp.maximum(SEEN_STEP_M / jnp.maximum(hits, 1), SEEN_MIN_STEP_M)
    is_longer = seen.extent > slots.extent
    moved = slots.extent + step * jnp.where(is_longer, SEEN_QUANTILE, SEEN_QUANTILE - 1)
    return jnp.where(is_crossed[:, None], slots.extent, jnp.maximum(moved, 0))


def track_size(slots: Slots) -> jax.Array:
    """Length, width and height of tracks: the weighted means, and never shorter than what was seen.

    Args:
      slots: T tracks.

    Returns:
      (T, 3) float32, m.
    """
    mean = slots.size_sum[:, :3] / jnp.maximum(slots.size_sum[:, 3:], 1e-6)
    seen = jnp.minimum(slots.extent, MAX_GROWTH * mean[:, :2])
    seen = jnp.where((slots.hits > MATURE_HITS)[:, None], seen, 0.0)
    return jnp.concatenate([jnp.maximum(mean[:, :2], seen), mean[:, 2:]], axis=1)


def keep_visible_faces(center: jax.Array, size: jax.Array, yaw: jax.Array, new_size: jax.Array) -> jax.Array:
    """Centre of a box of another size whose faces towards the sensor stay where they are.

    Args:
      center: (T, 2) float32, m, sensor frame.
      size: (T, 2) float32, m: along and across.
      yaw: (T,) float32, rad.
      new_size: (T, 2) float32, m.

    Returns:
      (T, 2) float32, m.
    """
    sensor = rotate(-center, -yaw)
    face = jnp.where(jnp.abs(sensor) > size / 2, jnp.sign(sensor), 0.0)
    return center + rotate(face * (size - new_size) / 2, yaw)


def refine_boxes(slots: Slots, seen: Observations) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The boxes of this sweep's detections with what only the track knows: which side is the length, and,
    where this sweep did not see it, how long it is.

    The visible faces stay where this sweep saw them, so that errors of the poses do not matter. Width and
    height are its own too, as they are seen more often than not; but for the width of a box across the track.

    Args:
      slots: T tracks.
      seen: T rows, the detection of each.

    Returns:
      Centre (T, 3) m, size (T, 3) m and yaw (T,) rad, those of the detection for tracks of few detections.
    """
    crossed = is_crossed(seen.yaw, slots.yaw)[:, None]
    flat = jnp.where(crossed, seen.size[:, 1::-1], seen.size[:, :2])
    size = track_size(slots)
    length, width = size[:, 0], size[:, 1]
    is_seen = ~crossed[:, 0] & (seen.extent[:, 0] > SEEN_SHARE * length)
    # The length of a box that lies across the track is not its width.
    sides = jnp.where(is_seen, flat[:, 0], length), jnp.where(crossed[:, 0], width, flat[:, 1])
    new = jnp.stack(sides, axis=1)
    center = keep_visible_faces(seen.center[:, :2], flat, slots.yaw, new)
    known = slots.hits > MATURE_HITS
    return (
        jnp.where(known[:, None], jnp.concatenate([center, seen.center[:, 2:]], axis=1), seen.center),
        jnp.where(known[:, None], jnp.concatenate([new, seen.size[:, 2:]], axis=1), seen.size),
        wrap_yaw(jnp.where(known, slots.yaw, seen.yaw)),
    )


def track_share(slots: Slots, track_score: jax.Array, own_score: jax.Array) -> jax.Array:
    """How far from the box of its detection to its own a track is shown: the farther the less that scores.

    What one sweep got wrong of a box most others got right, and where the track is expected lags behind.

    Args:
      slots: T tracks.
      track_score: (T,) float32, in [0, 1].
      own_score: (T,) float32, in [0, 1], of the detections of this sweep.

    Returns:
      (T,) float32, in [0, 1]; 0 for tracks of few detections.
    """
    weight = TRACK_WEIGHT * track_score
    share = weight / jnp.maximum(weight + own_score, 1e-6)
    return jnp.where(slots.hits > MATURE_HITS, share, 0.0)


def is_crossed(seen_yaw: jax.Array, yaw: jax.Array) -> jax.Array:
    """(T,) bool: whether the length of a detection lies across that of its track."""
    return jnp.abs(wrap_yaw(seen_yaw - yaw)) > jnp.pi / 4


def front_of(yaw: jax.Array, slots: Slots) -> tuple[jax.Array, jax.Array]:
    """Finds where the front of a box points, and with what probability, by motion and profile.

    Args:
      yaw: (T,) float32, rad, in [-pi/2, pi/2), of the length axis.
      slots: T tracks.

    Returns:
      heading: (T,) float32, rad, in [-pi, pi): yaw, or half a turn further.
      probability: (T,) float32, in [.5, 1]: the logistic function of the votes of motion along the axis, a
        whole one a unit, and the log odds of the profile.
    """
    axis = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
    votes = jnp.sum(axis * slots.front_vote, axis=-1) + profile_log_odds(axis, slots)
    heading = jnp.where(votes >= 0, yaw, yaw + jnp.pi)
    # Compared and not divided, so that no rounding leaves the interval.
    heading = jnp.where(heading >= jnp.pi, heading - 2 * jnp.pi, heading)
    return heading, jax.nn.sigmoid(jnp.abs(votes))
