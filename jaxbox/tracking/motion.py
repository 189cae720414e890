"""What a vehicle does: standing, starting, moving, stopping, turning or changing lanes, without a map."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxbox.config import TrackConfig
from jaxbox.geometry.planar import wrap_turn
from jaxbox.tracking.state import MOMENT_S, NUM_MOMENTS, Slots
from jaxbox.types import Motion

MEMORY_S = 1.0
"""Speed and course are compared with those this long ago, s."""
LANE_S = 5.0
"""A lane change is looked for in a path of this duration, s;"""
LANE_END_S = 0.8
"""the course at either end is that of a piece of this duration, s,"""
LANE_END_M = 2.0
"""and at least this length, m."""
MATURE_HITS = 10
"""Detections after which a velocity is good enough to be compared with an earlier one."""
FIRST_MOMENTS = 3
"""The velocity at a path's first moments, which begins at 0, is compared with none."""
SPEED_SDS = 3.0
"""A vehicle that moves is faster than this many standard deviations of its speed, which grow with the time
between sweeps: a start at 1.5 m/s2 is detected after 1.4 s at 10 Hz and after 2.2 s at 2.5 Hz."""
STARTING_SPEED_MPS, STOPPING_SPEED_MPS, TURNING_SPEED_MPS = 3.0, 4.0, 1.5
"""A vehicle starts from below the first, stops below the second, and turns above the third."""
AGE_TOLERANCE = 0.25
"""A moment stands for another whose age differs by less than this share."""


def is_moving(slots: Slots, config: TrackConfig) -> jax.Array:
    """Whether tracks move: with hysteresis, so that a slow one does not flicker.

    Args:
      slots: T tracks.
      config: of the tracker.

    Returns:
      (T,) bool.
    """
    speed, sd = slots.speed, jnp.sqrt(slots.covariance[:, 2])
    begins = (speed > config.moving_speed_mps) & (speed > SPEED_SDS * sd)
    return jnp.where(slots.moving, speed >= config.standing_speed_mps, begins)


def remember(slots: Slots, moment_age_s: jax.Array, dt: jax.Array) -> tuple[Slots, jax.Array]:
    """Adds where tracks are to their paths, where the newest moment is old enough.

    Args:
      slots: T tracks.
      moment_age_s: (M,) float32, s, before this sweep.
      dt: () float32, s.

    Returns:
      The slots and the ages.
    """
    age = moment_age_s + dt
    is_due = age[0] > (1 - AGE_TOLERANCE) * MOMENT_S
    now = jnp.concatenate([slots.position, slots.velocity], axis=1)

    def push(newest: jax.Array, moments: jax.Array) -> jax.Array:
        pushed = jnp.concatenate([newest[:, None], moments[:, :-1]], axis=1)
        return jnp.where(is_due, pushed, moments)

    length = jnp.minimum(slots.path_length + is_due.astype(jnp.int32), NUM_MOMENTS)
    pushed_age = jnp.concatenate([jnp.zeros(1, jnp.float32), age[:-1]])
    return dataclasses.replace(
        slots,
        path=push(now, slots.path),
        path_moving=push(slots.moving, slots.path_moving),
        path_length=length,
    ), jnp.where(is_due, pushed_age, age)


def classify(slots: Slots, moment_age_s: jax.Array, config: TrackConfig) -> tuple[jax.Array, jax.Array]:
    """What tracks do, and how far they shifted to the side where they change lanes.

    Args:
      slots: T tracks, whose paths end now.
      moment_age_s: (M,) float32, s.
      config: of the tracker.

    Returns:
      motion: (T,) int32, a `Motion`: a change of lanes before a turn before starting and stopping.
      lateral_shift_m: (T,) float32, m, to the left; 0 where no lanes are changed.
    """
    starting, stopping, turning = _compare_with_earlier(slots, moment_age_s, config)
    shift = _lateral_shift(slots, moment_age_s, config)
    motion = jnp.where(slots.moving, Motion.MOVING.value, Motion.STANDING.value)
    for found, name in (
        (starting, Motion.STARTING),
        (stopping, Motion.STOPPING),
        (turning, Motion.TURNING),
        (shift != 0, Motion.LANE_CHANGE),
    ):
        motion = jnp.where(found, name.value, motion)
    return motion.astype(jnp.int32), shift


def _moment(moment_age_s: jax.Array, ago_s: float) -> tuple[jax.Array, jax.Array]:
    """The moment at a time ago, and whether the path has one."""
    index = jnp.argmin(jnp.abs(moment_age_s - ago_s))
    return index, jnp.abs(moment_age_s[index] - ago_s) < AGE_TOLERANCE * ago_s


def _moved_since(slots: Slots, index: jax.Array) -> jax.Array:
    """(T,) bool: whether tracks have moved at all moments since one."""
    later = jnp.arange(NUM_MOMENTS) > index
    return jnp.all(slots.path_moving | later[None], axis=1) & (slots.path_length > index)


def _course(direction: jax.Array) -> jax.Array:
    return jnp.arctan2(direction[:, 1], direction[:, 0])


def _compare_with_earlier(
    slots: Slots, moment_age_s: jax.Array, config: TrackConfig
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Whether tracks start, stop and turn: three of (T,) bool."""
    index, exists = _moment(moment_age_s, MEMORY_S)
    age = jnp.maximum(moment_age_s[index], MOMENT_S)
    known = exists & slots.moving & (slots.hits > MATURE_HITS) & (slots.path_length > index + FIRST_MOMENTS)
    earlier = slots.path[:, index, 2:]
    speed, earlier_speed = slots.speed, jnp.linalg.norm(earlier, axis=1)
    acceleration = (speed - earlier_speed) / age
    starting = known & (acceleration > config.starting_mps2) & (earlier_speed < STARTING_SPEED_MPS)
    stopping = known & (acceleration < -config.starting_mps2) & (speed < STOPPING_SPEED_MPS)
    rate_deg = jnp.rad2deg(jnp.abs(wrap_turn(_course(slots.velocity) - _course(earlier)))) / age
    turning = known & _moved_since(slots, index) & (rate_deg > config.turning_deg_per_s)
    return starting, stopping, turning & (speed > TURNING_SPEED_MPS)


def _offset(way: jax.Array, direction: jax.Array) -> jax.Array:
    """(T,) float32, m: how far displacements end to the left of lines in some directions."""
    across = direction[:, 0] * way[:, 1] - direction[:, 1] * way[:, 0]
    return across / jnp.maximum(jnp.linalg.norm(direction, axis=1), 1e-6)


def _lateral_shift(slots: Slots, moment_age_s: jax.Array, config: TrackConfig) -> jax.Array:
    """(T,) float32, m: shift across the courses of both ends, 0 where lanes are not changed."""
    first, exists = _moment(moment_age_s, LANE_S)
    first_end, _ = _moment(moment_age_s, LANE_S - LANE_END_S)
    last_start, _ = _moment(moment_age_s, LANE_END_S)
    place = slots.path[..., :2]
    before = place[:, first_end] - place[:, first]
    after = place[:, 0] - place[:, last_start]
    way = place[:, 0] - place[:, first]
    left_of_before, left_of_after = _offset(way, before), _offset(way, after)
    far = jnp.minimum(jnp.linalg.norm(before, axis=1), jnp.linalg.norm(after, axis=1)) > LANE_END_M
    straight = jnp.abs(wrap_turn(_course(after) - _course(before))) < jnp.deg2rad(config.lane_course_deg)
    # Where a curve begins or ends, the path is left of one course and right of the other.
    aside = jnp.minimum(jnp.abs(left_of_before), jnp.abs(left_of_after)) > config.lane_change_m
    aside = aside & (left_of_before * left_of_after > 0)
    found = exists & _moved_since(slots, first) & far & straight & aside
    shift = (left_of_before + left_of_after) / 2
    return jnp.where(found, shift, 0.0)
