"""Rectangles by trying all rotations (paper, section 3.4, Algorithm III), and the scene direction."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxbox.masked import fold_points, group_by, map_rows
from jaxbox.types import Rectangles

CHUNK = 128
"""Clusters at a time: their extents at all rotations stay in the cache."""

TABLE_CHUNK = 256
"""Clusters whose points are listed at a time."""

VOTE_POINTS, VOTE_EXTENT_M = 150.0, 6.0
"""A vote for the scene direction counts min(points, 150) x min(extent, 6 m)."""

Extents = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
"""Lower and upper bounds of u, then of v, each (C, A)."""

PointTable = tuple[jax.Array, jax.Array]
"""Points (C, M, 2) m and how many of them count (C,)."""


def sample_points(cluster: jax.Array, *, num_clusters: int, max_points: int) -> tuple[jax.Array, jax.Array]:
    """Gathers the points of each cluster in a table, spread evenly over it where there are too many.

    Args:
      cluster: (N,) int32, in [0, num_clusters], the latter for none.
      num_clusters: static, K.
      max_points: static, M.

    Returns:
      index: (K, M) int32 rows of the points, in their order: all of them, or every (count / M)-th; N beyond.
      count: (K,) int32, entries of the table, at most M.
    """
    order, start = group_by(cluster, num_clusters)
    total = jnp.diff(start)
    j = jnp.arange(max_points)

    def pick(rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        first, total = (a[:, None] for a in rows)
        spread = j * (total // max_points) + j * (total % max_points) // max_points
        offset = jnp.where(total > max_points, spread, j)
        index = order[jnp.minimum(first + offset, cluster.shape[0] - 1)]
        return jnp.where(j < total, index, cluster.shape[0])

    num_present = jnp.max(jnp.where(total > 0, jnp.arange(1, num_clusters + 1), 0), initial=0)
    index = map_rows(pick, (start[:-1], total), num_rows=num_present, chunk=TABLE_CHUNK)
    present = jnp.arange(num_clusters) < num_present
    return jnp.where(present[:, None], index, cluster.shape[0]), jnp.minimum(total, max_points)


def try_rotations(
    points: jax.Array,
    count: jax.Array,
    num_clusters: jax.Array,
    *,
    criterion: str,
    num_angles: int,
    min_distance_m: jax.Array | float,
) -> tuple[jax.Array, Extents]:
    """Bounds each cluster by a rectangle at every rotation, and rates them (larger is better).

    With d the distance of a point to the nearest edge of its rectangle:
    area: minus the area (the paper). closeness: mean of d0 / max(d, d0) (Zhang et al. 2017).
    visible_closeness: the same, to the two edges that face the sensor only. variance: minus the
    variances of the distances to the nearest edges along u and along v (Zhang et al. 2017).

    Args:
      points: (P, M, 2) float32, m, sensor frame.
      count: (P,) int32, points of each cluster.
      num_clusters: () int32, rows that hold a cluster.
      criterion: static, one of the above.
      num_angles: static, A; rotations by i * 90 / A degrees.
      min_distance_m: d0, m.

    Returns:
      curve: (P, A) float32.
      extents: four (P, A) float32, m: lower and upper bounds of u, then of v.

    Reference: paper, Algorithm III; oracles `jaxbox.reference.criterion_curve`, cv2.minAreaRect.
    """
    angle = jnp.arange(num_angles) * (math.pi / 2 / num_angles)
    cos, sin = jnp.cos(angle), jnp.sin(angle)

    def rate(clusters: PointTable) -> tuple[jax.Array, Extents]:
        extents = _extents(*clusters, cos, sin)
        return _CRITERIA[criterion](clusters, cos, sin, extents, min_distance_m), extents

    return map_rows(rate, (points, count), num_rows=num_clusters, chunk=CHUNK)


def _extents(points: jax.Array, count: jax.Array, cos: jax.Array, sin: jax.Array) -> Extents:
    def update(state: Extents, x: jax.Array, y: jax.Array) -> Extents:
        u, v = x * cos + y * sin, y * cos - x * sin
        u0, u1, v0, v1 = state
        return jnp.minimum(u0, u), jnp.maximum(u1, u), jnp.minimum(v0, v), jnp.maximum(v1, v)

    far = jnp.full((points.shape[0], cos.shape[0]), jnp.inf)
    extents = fold_points(points, count, (far, -far, far, -far), update, twice=True)
    return jax.tree.map(lambda e: jnp.where((count > 0)[:, None], e, 0), extents)


def _area(
    clusters: PointTable, cos: jax.Array, sin: jax.Array, extents: Extents, d0: jax.Array | float
) -> jax.Array:
    u0, u1, v0, v1 = extents
    return -(u1 - u0) * (v1 - v0)


def _closeness(
    clusters: PointTable, cos: jax.Array, sin: jax.Array, extents: Extents, d0: jax.Array | float
) -> jax.Array:
    u0, u1, v0, v1 = extents

    def distance(u: jax.Array, v: jax.Array) -> jax.Array:
        return jnp.minimum(jnp.minimum(u - u0, u1 - u), jnp.minimum(v - v0, v1 - v))

    return _mean_closeness(clusters, cos, sin, distance, d0)


def _visible_closeness(
    clusters: PointTable, cos: jax.Array, sin: jax.Array, extents: Extents, d0: jax.Array | float
) -> jax.Array:
    u0, u1, v0, v1 = extents
    # The sensor is the origin: of two opposite edges it sees the one nearer to 0.
    u_near = jnp.where(jnp.abs(u0) < jnp.abs(u1), u0, u1)
    v_near = jnp.where(jnp.abs(v0) < jnp.abs(v1), v0, v1)

    def distance(u: jax.Array, v: jax.Array) -> jax.Array:
        return jnp.minimum(jnp.abs(u - u_near), jnp.abs(v - v_near))

    return _mean_closeness(clusters, cos, sin, distance, d0)


def _mean_closeness(
    clusters: PointTable,
    cos: jax.Array,
    sin: jax.Array,
    distance: Callable[[jax.Array, jax.Array], jax.Array],
    d0: jax.Array | float,
) -> jax.Array:
    def update(total: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
        return total + d0 / jnp.maximum(distance(x * cos + y * sin, y * cos - x * sin), d0)

    points, count = clusters
    zero = jnp.zeros((points.shape[0], cos.shape[0]))
    return fold_points(points, count, zero, update) / jnp.maximum(count, 1)[:, None]


def _variance(
    clusters: PointTable, cos: jax.Array, sin: jax.Array, extents: Extents, d0: jax.Array | float
) -> jax.Array:
    u0, u1, v0, v1 = extents

    def update(state: tuple[jax.Array, ...], x: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
        u, v = x * cos + y * sin, y * cos - x * sin
        du, dv = jnp.minimum(u - u0, u1 - u), jnp.minimum(v - v0, v1 - v)
        along_u = du < dv
        nu, su, ssu, nv, sv, ssv = state
        du, dv = jnp.where(along_u, du, 0), jnp.where(along_u, 0, dv)
        return nu + along_u, su + du, ssu + du**2, nv + ~along_u, sv + dv, ssv + dv**2

    points, count = clusters
    zero = jnp.zeros((points.shape[0], cos.shape[0]))
    nu, su, ssu, nv, sv, ssv = fold_points(points, count, (zero,) * 6, update)

    def spread(n: jax.Array, s: jax.Array, ss: jax.Array) -> jax.Array:
        n = jnp.maximum(n, 1)
        return ss / n - (s / n) ** 2

    return -(spread(nu, su, ssu) + spread(nv, sv, ssv))


_CRITERIA = {
    "area": _area,
    "variance": _variance,
    "closeness": _closeness,
    "visible_closeness": _visible_closeness,
}


def best_rectangles(
    curve: jax.Array, extents: Extents, preference: jax.Array, *, insistence: float = 1.0
) -> Rectangles:
    """The rectangle at each cluster's best rotation.

    Args:
      curve: (P, A) float32, see `try_rotations`.
      extents: see `try_rotations`.
      preference: (A,) float32, added to every curve.
      insistence: how often the preference counts when the rotation is chosen; its worth counts it once.

    Returns:
      The rectangles; of equally good rotations the first.
    """
    total = curve + preference
    best = jnp.argmax(curve + insistence * preference, axis=1)[:, None]
    u0, u1, v0, v1 = (jnp.take_along_axis(e, best, axis=1)[:, 0] for e in extents)
    return Rectangles(
        angle=best[:, 0] * (math.pi / 2 / curve.shape[1]),
        low=jnp.stack([u0, v0], axis=1),
        high=jnp.stack([u1, v1], axis=1),
        worth=jnp.take_along_axis(total, best, axis=1)[:, 0],
    )


def scene_preference(
    yaw: jax.Array,
    extent: jax.Array,
    num_points: jax.Array,
    voting: jax.Array,
    *,
    num_angles: int,
    weight: jax.Array | float,
    sigma_deg: jax.Array | float,
) -> jax.Array:
    """Prefers the direction that most boxes share: vehicles stand along or across one road.

    Args:
      yaw: (K,) float32, rad, of the voting boxes.
      extent: (K,) float32, m, the longest measured extent of each.
      num_points: (K,) int32.
      voting: (K,) bool.
      num_angles: static, A.
      weight: height of the preference.
      sigma_deg: width of a vote, and of the preference, exp(-(d / sigma)^2).

    Returns:
      (A,) float32, to be added to the curves; zero where no box votes.

    Reference: oracle `jaxbox.reference.scene_direction`.
    """
    bins = jnp.arange(num_angles) * (90.0 / num_angles)

    def closeness(angle_deg: jax.Array) -> jax.Array:
        difference = (bins - angle_deg[..., None] % 90 + 45) % 90 - 45
        return jnp.exp(-((difference / sigma_deg) ** 2))

    power = jnp.minimum(num_points, VOTE_POINTS) * jnp.minimum(extent, VOTE_EXTENT_M)
    votes = jnp.where(voting, power, 0) @ closeness(jnp.rad2deg(yaw))
    direction = bins[jnp.argmax(votes)]
    return jnp.where(jnp.max(votes) > 0, weight * closeness(direction), 0)
