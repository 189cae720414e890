"""Front and back: a car's bonnet is lower than its rear, and so is a van's nose."""

import chex
import jax
import jax.numpy as jnp

from jaxbox.config import Label
from jaxbox.geometry.planar import wrap_turn
from jaxbox.stages.state import Kept, Obstacles, Owners
from jaxbox.xla.indexing import take
from jaxbox.xla.loops import map_rows
from jaxbox.xla.segments import reduce_segments

NUM_PARTS = len(Label.CAR.front_profile)
"""Parts of the box along its length, of each of which the top is sought."""
MIN_PART_POINTS = 3
"""A part with fewer points has no top."""
MIN_HEIGHT_M, MAX_HEIGHT_M = 1.2, 2.0
"""Tops are shares of the box's height within these: a higher one is a completed box's, or a tree's."""
PROFILE_SD = 0.15
"""Standard deviation of a top, as a share of the height."""
MAX_PART_COST = 4.0
"""A part counts no more than a top that is two standard deviations off: roof racks, occluded parts."""
LOG_ODDS_PER_COST = 0.3
"""Tops of neighbouring parts are not independent: a unit of cost counts less than the 1/2 of independent
normal errors."""


def find_fronts(owners: Owners, obstacles: Obstacles, kept: Kept) -> tuple[jax.Array, jax.Array]:
    """Finds where the front of each detection points, and with what probability.

    Args:
      owners: the points of K detections.
      obstacles: O points.
      kept: the detections.

    Returns:
      heading: (K,) float32, rad, in [-pi, pi]: ``kept.yaw``, or half a turn further.
      front_probability: (K,) float32, in [.5, 1].

    Reference: oracle `jaxbox.reference.find_fronts`.
    """
    top_m = profile_tops(owners, obstacles, kept)
    height_m = jnp.clip(kept.size[:, 2], MIN_HEIGHT_M, MAX_HEIGHT_M)
    log_odds = front_log_odds(top_m / height_m[:, None], _profiles(kept.label))
    heading = jnp.where(log_odds < 0, wrap_turn(kept.yaw + jnp.pi), kept.yaw)
    return heading, jax.nn.sigmoid(jnp.abs(log_odds))


def profile_tops(owners: Owners, obstacles: Obstacles, kept: Kept) -> jax.Array:
    """Finds the highest point in each part of a box, from the end opposite to its yaw on.

    Args:
      owners: the points of K detections.
      obstacles: O points.
      kept: the detections.

    Returns:
      (K, parts) float32, m above the ground; minus infinity for parts with too few points.
    """
    chex.assert_shape([obstacles.xy, owners.row, owners.owner], [(None, 2), *2 * [obstacles.height.shape]])
    num = kept.valid.shape[0]
    per_m = 1 / jnp.maximum(kept.size[:, 0], 1e-3)
    along = jnp.stack([jnp.cos(kept.yaw) * per_m, jnp.sin(kept.yaw) * per_m], axis=1)
    frame = jnp.concatenate([kept.center[:, :2], along], axis=1)

    def place(rows: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        row, owner = rows
        box = take(frame, owner)
        point, (x, y, to_x, to_y) = take(obstacles.xy, row), box.T
        share = (point[:, 0] - x) * to_x + (point[:, 1] - y) * to_y + 0.5
        part = jnp.clip(jnp.floor(share * NUM_PARTS).astype(jnp.int32), 0, NUM_PARTS - 1)
        return owner * NUM_PARTS + part, take(obstacles.height, row)

    part, height = map_rows(place, (owners.row, owners.owner), num_rows=owners.num)
    # The points of no detection are in a row of their own, which is dropped.
    part = jnp.minimum(part, num * NUM_PARTS)
    table = reduce_segments(
        lambda height: ([height], [jnp.ones_like(height)]),
        height,
        part[None],
        num_rows=owners.num,
        num_segments=num * NUM_PARTS + 1,
    )
    top, count = table[:-1].T.reshape(2, num, NUM_PARTS)
    return jnp.where(count >= MIN_PART_POINTS, top, -jnp.inf)


def front_log_odds(tops: jax.Array, profile: jax.Array) -> jax.Array:
    """Log odds that the front is where the box's yaw points, and not opposite.

    Args:
      tops: (K, parts) float32, shares of the height; minus infinity where unknown.
      profile: (K, parts) float32, of the class.

    Returns:
      (K,) float32; 0 where nothing is known.
    """

    def cost(profile: jax.Array) -> jax.Array:
        cost = jnp.minimum(((tops - profile) / PROFILE_SD) ** 2, MAX_PART_COST)
        return jnp.sum(jnp.where(jnp.isfinite(tops), cost, 0), axis=1)

    return LOG_ODDS_PER_COST * (cost(profile[:, ::-1]) - cost(profile))


def _profiles(label: jax.Array) -> jax.Array:
    """(K, parts) float32: the usual tops of the class of each label, from rear to front."""
    is_of = label[:, None] == jnp.arange(len(Label), dtype=label.dtype)[None]
    profiles = jnp.array([one.front_profile for one in Label], jnp.float32)
    return jnp.sum(jnp.where(is_of[..., None], profiles[None], 0), axis=1)
