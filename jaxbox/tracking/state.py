"""The state of a tracker, and what it reads of a sweep: frozen pytrees of a fixed shape.

The memory is in the sensor frame of the last sweep, and moves with it: no world enters, so that a recording
of an hour, or one in UTM coordinates, loses nothing in float32.

Axis letters: T slots, D detections, A azimuth cells, L classes, M remembered moments.
"""

import dataclasses

import jax
import jax.numpy as jnp

from jaxbox.config import Label
from jaxbox.tracking.tracks import FREE
from jaxbox.types import Detections

MOMENT_S = 0.1
"""Time between the moments of a path, s,"""
NUM_MOMENTS = 51
"""and how many are remembered: 5 s, over which a change of lanes is seen."""
MAX_FRONT_PROBABILITY = 1 - 1e-6
"""A detection's front is never surer than this."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Observations:
    """What a tracker reads of one sweep: boxes of any detector, in any order."""

    center: jax.Array
    """(D, 3) float32, m, sensor frame."""
    size: jax.Array
    """(D, 3) float32, m: length >= width, height."""
    yaw: jax.Array
    """(D,) float32, rad: length axis, not wrapped."""
    score: jax.Array
    """(D,) float32, in [0, 1]."""
    label: jax.Array
    """(D,) int32: a `jaxbox.Label`."""
    num_points: jax.Array
    """(D,) int32: points of the box; the more, the more its yaw and size count."""
    extent: jax.Array
    """(D, 2) float32, m: what was seen of it, along and across; 0 where that is unknown."""
    front_log_odds: jax.Array
    """(D,) float32: log odds that the front is where the yaw points, and not opposite; 0 where that is
    unknown."""
    valid: jax.Array
    """(D,) bool."""
    first_return_m: jax.Array
    """(A,) float32, m: range of the first return in each azimuth cell, from -pi on; large where unknown."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Slots:
    """The vehicles that are tracked, a row each; what a row of a free slot holds means nothing."""

    id: jax.Array
    """(T,) int32, -1 for a free slot."""
    position: jax.Array
    """(T, 2) float32, m, sensor frame of the last sweep: centre of the box."""
    z: jax.Array
    """(T,) float32, m: centre of the box."""
    velocity: jax.Array
    """(T, 2) float32, m/s, over ground, along the axes of that frame."""
    covariance: jax.Array
    """(T, 3) float32: see `Tracks.covariance`."""
    yaw_vote: jax.Array
    """(T, 2) float32: weighted sum of (cos, sin) of twice the yaw."""
    turn_rate: jax.Array
    """(T,) float32, rad/s."""
    front_vote: jax.Array
    """(T, 2) float32: weighted sum of the directions in which it moved."""
    profile_vote: jax.Array
    """(T, 2) float32: sum of the directions in which its detections saw a front, each times its log odds."""
    size_sum: jax.Array
    """(T, 4) float32: weighted sums of length, width and height (m), and of the weights."""
    extent: jax.Array
    """(T, 2) float32, m: quantile of the extents seen, along and across."""
    score_sum: jax.Array
    """(T,) float32: sum of the scores of its detections, each by how well it lay where it was expected."""
    label_score: jax.Array
    """(T, L) float32: sum of the scores of its detections by class."""
    hits: jax.Array
    """(T,) int32: sweeps in which it was detected."""
    age: jax.Array
    """(T,) int32: sweeps since its first detection."""
    misses: jax.Array
    """(T,) int32: sweeps since its last detection,"""
    hidden: jax.Array
    """(T,) int32: and those of them in which it was hidden."""
    hidden_now: jax.Array
    """(T,) bool: whether the last sweep was one of those."""
    moving: jax.Array
    """(T,) bool."""
    path: jax.Array
    """(T, M, 4) float32: position (m) and velocity (m/s) at the last moments, newest first."""
    path_moving: jax.Array
    """(T, M) bool: whether it moved then."""
    path_length: jax.Array
    """(T,) int32: how many moments of the path count."""

    @property
    def alive(self) -> jax.Array:
        """(T,) bool: whether the slot holds a vehicle."""
        return self.id > FREE

    @property
    def yaw(self) -> jax.Array:
        """(T,) float32, rad, in [-pi/2, pi/2]: what the votes agree on."""
        return jnp.arctan2(self.yaw_vote[:, 1], self.yaw_vote[:, 0]) / 2

    @property
    def speed(self) -> jax.Array:
        """(T,) float32, m/s."""
        return jnp.linalg.norm(self.velocity, axis=1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrackerState:
    """All that a tracker remembers between two sweeps. Begin with `empty`."""

    slots: Slots
    """T vehicles."""
    moment_age_s: jax.Array
    """(M,) float32, s: how long ago the moments of all paths were, newest first."""
    next_id: jax.Array
    """() int32: of the next track."""
    started: jax.Array
    """() bool: whether there was a sweep before."""

    @classmethod
    def empty(cls, max_tracks: int = 128) -> "TrackerState":
        """A tracker that knows no vehicle yet.

        Args:
          max_tracks: T, capacity for vehicles at a time.

        Returns:
          The state.

        Raises:
          ValueError: for a capacity below 1.
        """
        if max_tracks < 1:
            raise ValueError(f"max_tracks is {max_tracks}; it must be at least 1.")
        return cls(
            slots=empty_slots(max_tracks),
            moment_age_s=jnp.zeros(NUM_MOMENTS, jnp.float32),
            next_id=jnp.zeros((), jnp.int32),
            started=jnp.zeros((), bool),
        )


def empty_slots(num_slots: int) -> Slots:
    """Slots without vehicles.

    Args:
      num_slots: T.

    Returns:
      The slots: all free, every other number 0.
    """

    def zeros(*shape: int, dtype: type = jnp.float32) -> jax.Array:
        return jnp.zeros((num_slots, *shape), dtype)

    return Slots(
        id=jnp.full(num_slots, FREE, jnp.int32),
        position=zeros(2),
        z=zeros(),
        velocity=zeros(2),
        covariance=zeros(3),
        yaw_vote=zeros(2),
        turn_rate=zeros(),
        front_vote=zeros(2),
        profile_vote=zeros(2),
        size_sum=zeros(4),
        extent=zeros(2),
        score_sum=zeros(),
        label_score=zeros(len(Label)),
        hits=zeros(dtype=jnp.int32),
        age=zeros(dtype=jnp.int32),
        misses=zeros(dtype=jnp.int32),
        hidden=zeros(dtype=jnp.int32),
        hidden_now=zeros(dtype=jnp.bool_),
        moving=zeros(dtype=jnp.bool_),
        path=zeros(NUM_MOMENTS, 4),
        path_moving=zeros(NUM_MOMENTS, dtype=jnp.bool_),
        path_length=zeros(dtype=jnp.int32),
    )


def observe(detections: Detections) -> Observations:
    """What a tracker reads of the detections of a sweep.

    Args:
      detections: K of them, of `jaxbox.detect`.

    Returns:
      The observations, whose seen extents are those of the hulls along and across each box, and whose log
      odds of the front are those of its profile.
    """
    yaw = detections.yaw
    along = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
    across = jnp.stack([-along[..., 1], along[..., 0]], axis=-1)
    axes = jnp.stack([along, across], axis=-1)
    places = detections.hulls.vertices @ axes
    extent = jnp.max(places, axis=-2) - jnp.min(places, axis=-2)
    ahead = jnp.cos(detections.heading - yaw) >= 0
    # Probabilities are rounded to 1 long before their log odds end.
    front = jnp.minimum(detections.front_probability, MAX_FRONT_PROBABILITY)
    log_odds = jnp.log(front) - jnp.log1p(-front)
    return Observations(
        center=detections.center,
        size=detections.size,
        yaw=yaw,
        score=detections.score,
        label=detections.label,
        num_points=detections.num_points,
        extent=extent,
        front_log_odds=jnp.where(ahead, log_odds, -log_odds),
        valid=detections.valid,
        first_return_m=detections.first_return_m,
    )
