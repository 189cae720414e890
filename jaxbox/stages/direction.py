"""The scene's direction: vehicles stand along or across one road, so that their boxes share a yaw."""

import functools

import chex
import jax
import jax.numpy as jnp

from jaxbox.config import BoxConfig, DetectorConfig, VehicleConfig
from jaxbox.stages._assignments import NUM_ASSIGNMENTS, assign_length_axis, extend_away
from jaxbox.stages._priors import prior_of, size_score
from jaxbox.stages.state import NOT_A_BOX, Boxes, CastRays, Clusters, RayFractions, Rectangles, longest_side
from jaxbox.xla import chunks
from jaxbox.xla.indexing import take
from jaxbox.xla.loops import fold_rows, map_rows
from jaxbox.xla.rows import compact, rows_in_use

VOTE_POINTS, VOTE_EXTENT_M = 150.0, 6.0
"""A vote for the scene's direction counts min(points, 150) x min(extent, 6 m) x the score as a car."""


def scene_preference(
    rectangles: Rectangles, clusters: Clusters, cast_rays: CastRays, config: DetectorConfig
) -> jax.Array:
    """The direction that the first map's rectangles, fitted without a preference, vote for.

    Args:
      rectangles: (P,) of the clusters, fitted without a preference.
      clusters: of P rows.
      cast_rays: asks the evidence.
      config: of the detector.

    Returns:
      (A,) float32, to be added to the curves; zero where no rectangle votes.
    """
    chex.assert_shape(rectangles.rows, (*clusters.num_points.shape, 6))
    size = config.clustering.maps[0].max_clusters
    rectangles = Rectangles(rectangles.rows[:size])
    long = longest_side(rectangles) >= config.box.direction_min_extent_m
    cluster, num = compact(long & (jnp.arange(size, dtype=jnp.int32) < clusters.num_first), size)
    voters = Rectangles(take(rectangles.rows, cluster))

    def complete(voter: Rectangles) -> Boxes:
        """Both assignments of its length, completed away from the sensor."""
        number = jnp.arange(NUM_ASSIGNMENTS, dtype=jnp.int32)[:, None]
        sides = assign_length_axis(voter, number)
        prior = prior_of(config.vehicles.classes, jnp.zeros_like(sides.yaw, jnp.int32))
        boxes = extend_away(sides, prior, config.completion)
        return jax.tree.map(lambda a: jnp.moveaxis(a, 0, 1), boxes)

    boxes = map_rows(complete, voters, num_rows=num)
    one_list = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), boxes)
    cast = functools.partial(cast_rays, num_rays=config.completion.num_final_rays)
    rays = map_rows(cast, one_list, num_rows=num * NUM_ASSIGNMENTS, chunk=chunks.RAYS)
    rays = jax.tree.map(lambda a: a.reshape(boxes.objective.shape), rays)

    def rate(rows: tuple[Boxes, RayFractions]) -> jax.Array:
        return _vote_scores(*rows, config.vehicles)

    score = map_rows(rate, (boxes, rays), num_rows=num)
    free = jnp.min(jnp.where(boxes.objective > NOT_A_BOX, rays.free_length, jnp.inf), axis=1)
    voting = (jnp.arange(size, dtype=jnp.int32) < num) & (free <= config.box.direction_max_free)
    num_points = take(clusters.num_points, cluster)
    return count_votes(voters.angle, longest_side(voters), num_points, score, voting, config.box)


def _vote_scores(boxes: Boxes, rays: RayFractions, config: VehicleConfig) -> jax.Array:
    """(P,) how much each voter looks like a car by rays and size, at the better of its assignments.

    Fences, hedges and walls are opaque too, but longer than a car, or seen through where a car is.
    """
    prior = prior_of(config.classes, jnp.zeros(boxes.length.shape, jnp.int32))
    by_size = size_score(boxes.length, boxes.width, prior)
    score = rays.hit * jnp.exp(-((rays.free_length / config.free_scale) ** 2)) * by_size
    return jnp.max(jnp.where(boxes.objective > NOT_A_BOX, score, 0), axis=1)


def count_votes(
    yaw: jax.Array,
    extent: jax.Array,
    num_points: jax.Array,
    score: jax.Array,
    voting: jax.Array,
    config: BoxConfig,
) -> jax.Array:
    """Prefers the direction that most boxes share: vehicles stand along or across one road.

    Args:
      yaw: (K,) float32, rad, of the voting boxes.
      extent: (K,) float32, m, the longest measured extent of each.
      num_points: (K,) int32.
      score: (K,) float32, in [0, 1], how much each looks like a car.
      voting: (K,) bool.
      config: A angles, the height of the preference, and the width of a vote.

    Returns:
      (A,) float32, to be added to the curves; zero where no box votes.

    Reference: oracle `jaxbox.reference.count_votes`.
    """
    num_angles, sigma_deg = config.num_angles, config.direction_sigma_deg
    bins = jnp.arange(num_angles, dtype=jnp.float32) * (90.0 / num_angles)

    def closeness(angle_deg: jax.Array) -> jax.Array:
        difference = (bins[None] - angle_deg[:, None] % 90 + 45) % 90 - 45
        return jnp.exp(-((difference / sigma_deg) ** 2))

    def add(votes: jax.Array, _: jax.Array, rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        yaw, power = rows
        return votes + power @ closeness(jnp.rad2deg(yaw))

    power = jnp.minimum(num_points.astype(jnp.float32), VOTE_POINTS) * jnp.minimum(extent, VOTE_EXTENT_M)
    ballots = yaw, jnp.where(voting, power * score, 0)
    votes = jnp.zeros(num_angles, jnp.float32)
    votes = fold_rows(
        add, votes, ballots, num_rows=rows_in_use(voting), chunk=chunks.VOTES, absent=(0.0, 0.0)
    )
    direction = bins[jax.lax.argmax(votes, 0, jnp.int32)]
    return jnp.where(jnp.max(votes) > 0, config.direction_weight * closeness(direction[None])[0], 0)
