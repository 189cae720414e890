"""How the sensor moved since the last sweep, and whether time and pose are plausible."""

import dataclasses
import math

import jax
import jax.numpy as jnp

from jaxbox.config import TrackConfig
from jaxbox.geometry.planar import rotate
from jaxbox.tracking.state import Slots
from jaxbox.tracking.tracks import TrackStatus
from jaxbox.types import combine_bits

RIGID_TOLERANCE = 1e-3
"""Entries of R R^T may differ from those of the identity by this."""
MAX_TURN_RAD_PER_S = math.radians(180)
"""No vehicle turns faster."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Interval:
    """From the last sweep to this one."""

    dt: jax.Array
    """() float32, s, positive."""
    rotation: jax.Array
    """(3, 3) float32: from the current sensor frame to the previous one."""
    translation: jax.Array
    """(3,) float32, m: the current sensor in the previous frame."""
    skipped: jax.Array
    """() bool: the sweep is skipped."""
    restarts: jax.Array
    """() bool: all tracks end."""
    status: jax.Array
    """() int32: `TrackStatus` bits."""

    @property
    def turn(self) -> jax.Array:
        """() float32, rad: by which the sensor turned about +z."""
        return jnp.arctan2(self.rotation[1, 0], self.rotation[0, 0])


def check_interval(
    dt: jax.Array, T_previous_current: jax.Array, started: jax.Array, config: TrackConfig
) -> Interval:
    """Checks time and pose: what is not plausible is replaced, and a status bit is set.

    Args:
      dt: () float32, s since the last sweep; not read for the first one.
      T_previous_current: (4, 4) float32: from this sweep's sensor frame to the last one's.
      started: () bool, whether there was a last one.
      config: of the tracker.

    Returns:
      The interval. Without a last sweep it is 0.1 s, and the sensor stood.
    """
    is_later = jnp.isfinite(dt) & (dt > 0)
    is_gap = is_later & (dt > config.max_gap_s)
    rotation, translation = T_previous_current[:3, :3], T_previous_current[:3, 3]
    is_rigid = _is_rigid(rotation) & jnp.all(jnp.isfinite(translation))
    dt = jnp.where(started & is_later, dt, 0.1)
    distance, turn = jnp.linalg.norm(translation), _angle(rotation)
    is_jump = (distance > config.max_ego_speed_mps * dt) | (turn > MAX_TURN_RAD_PER_S * dt)
    usable = started & is_rigid & ~is_jump & ~is_gap
    skipped = started & ~is_later
    bits = {
        TrackStatus.TIME_NOT_LATER: ~is_later,
        TrackStatus.TIME_GAP: is_gap,
        TrackStatus.POSE_INVALID: ~is_rigid,
        # Without a time there is no speed, and of a sweep that is passed over no track ends.
        TrackStatus.POSE_JUMP: is_rigid & is_jump & is_later & ~is_gap,
    }
    return Interval(
        dt=dt,
        rotation=jnp.where(usable, rotation, jnp.eye(3, dtype=jnp.float32)),
        translation=jnp.where(usable, translation, 0.0),
        skipped=skipped,
        restarts=started & ~skipped & (is_gap | (is_rigid & is_jump)),
        status=jnp.where(started, combine_bits(bits), 0),
    )


def _is_rigid(rotation: jax.Array) -> jax.Array:
    error = jnp.abs(rotation @ rotation.T - jnp.eye(3, dtype=jnp.float32))
    # Anything compared with NaN is False.
    return jnp.all(error < RIGID_TOLERANCE) & (jnp.linalg.det(rotation) > 0)


def _angle(rotation: jax.Array) -> jax.Array:
    """() float32, rad: by which a rotation turns about its axis."""
    return jnp.arccos(jnp.clip((jnp.trace(rotation) - 1) / 2, -1, 1))


def to_current_frame(slots: Slots, interval: Interval) -> Slots:
    """Transforms the state of all tracks to the current sensor frame.

    The covariance is the same in any frame.

    Args:
      slots: in the sensor frame of the last sweep.
      interval: since then.

    Returns:
      The slots in the sensor frame of this sweep.
    """
    turn = -interval.turn
    center = jnp.concatenate([slots.position, slots.z[:, None]], axis=1) - interval.translation[None]
    center = center @ interval.rotation
    # The path is flat: it is moved by what the sensor did in the plane.
    place = rotate(slots.path[..., :2] - interval.translation[None, None, :2], turn)
    return dataclasses.replace(
        slots,
        position=center[:, :2],
        z=center[:, 2],
        velocity=rotate(slots.velocity, turn),
        yaw_vote=rotate(slots.yaw_vote, 2 * turn),
        front_vote=rotate(slots.front_vote, turn),
        profile_vote=rotate(slots.profile_vote, turn),
        path=jnp.concatenate([place, rotate(slots.path[..., 2:], turn)], axis=-1),
    )
