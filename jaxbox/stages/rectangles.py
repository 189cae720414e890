"""Rectangles by trying all rotations (paper, section 3.4, Algorithm III), and the scene direction."""

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.types import Rectangles
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.loops import fast_max, fast_min, fold_points, fold_rows, map_rows, store
from jaxbox.xla.masked import rows_in_use, take
from jaxbox.xla.sorting import sort_by_group

CHUNK = 64
"""Clusters at a time: their extents at all rotations stay in the cache."""

VOTE_CHUNK = 64
"""Votes at a time: few boxes of a sweep vote."""

VOTE_POINTS, VOTE_EXTENT_M = 150.0, 6.0
"""A vote for the scene direction counts min(points, 150) x min(extent, 6 m)."""

FAR_M = 1e12
"""Farther away than any point."""

PointTable = tuple[jax.Array, jax.Array, jax.Array]
"""x and y of points (M, C) m, and how many of them count (C,)."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PointLists:
    """The points of each cluster, one list after the other."""

    x: jax.Array
    """(E,) float32, m."""
    y: jax.Array
    """(E,) float32, m."""
    start: jax.Array
    """(K,) int32, where the points of each cluster begin."""
    total: jax.Array
    """(K,) int32, how many they are."""
    max_points: int = dataclasses.field(metadata={"static": True})
    """static, M: so many of a cluster are looked at."""

    @property
    def count(self) -> jax.Array:
        """(K,) int32, points of each cluster that are looked at."""
        return jnp.minimum(self.total, self.max_points)

    def table(self, cluster: jax.Array) -> PointTable:
        """The points of some clusters, spread evenly over all they have: every (total / M)-th.

        Args:
          cluster: (C,) int32, in [0, K]; the latter has none.

        Returns:
          The points, in their order; those beyond the count may be anything finite.
        """
        start, total = take(self.start, cluster), take(self.total, cluster)
        index = jnp.arange(self.max_points, dtype=jnp.int32)
        if on_accelerator():
            # Cluster by cluster, as the points lie in the lists and as `fold_points` reads them there.
            row = self._row(start[:, None], total[:, None], index[None])
            xy = jnp.take(jnp.stack([self.x, self.y], axis=1), row, axis=0, mode="clip")
            x, y = xy[:, :, 0].T, xy[:, :, 1].T
        else:
            # Stored, since what a look-up has to work out first does not vectorise.
            row = store(self._row(start[None], total[None], index[:, None]))
            x, y = (jnp.take(values, row, mode="clip") for values in (self.x, self.y))
        return x, y, jnp.minimum(total, self.max_points)

    def _row(self, start: jax.Array, total: jax.Array, j: jax.Array) -> jax.Array:
        """The row of the j-th point that is looked at of each cluster."""
        spread = j * (total // self.max_points) + j * (total % self.max_points) // self.max_points
        return start + jnp.where(total > self.max_points, spread, j)


def list_points(
    cluster: jax.Array,
    row: jax.Array,
    num_entries: jax.Array,
    xy: jax.Array,
    *,
    num_clusters: int,
    max_points: int,
) -> PointLists:
    """Lists the points of each cluster.

    Args:
      cluster: (E,) int32, in [0, num_clusters).
      row: (E,) int32, of the point in `xy`.
      num_entries: () int32; only the first so many entries count.
      xy: (N, 2) float32, m.
      num_clusters: static, K.
      max_points: static, M.

    Returns:
      The lists, each in the order of its entries.
    """

    def read(i: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, y = (values.at[row[i]].get(mode="promise_in_bounds") for values in columns)
        return x, y

    def read_pair(i: jax.Array) -> jax.Array:
        return jnp.take(xy, row[i], axis=0, mode="clip")

    columns = xy[:, 0], xy[:, 1]
    if on_accelerator():
        # In pairs, as `PointLists.table` looks them up.
        pairs, begin, end = sort_by_group(read_pair, cluster, num_entries, num_clusters)
        x, y = pairs[:, 0], pairs[:, 1]
    else:
        (x, y), begin, end = sort_by_group(read, cluster, num_entries, num_clusters)
    return PointLists(x, y, begin, end - begin, max_points)


def try_rotations(
    points: PointLists,
    cluster: jax.Array,
    num_clusters: jax.Array,
    *,
    criterion: str,
    num_angles: int,
    min_distance_m: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """Bounds each cluster by a rectangle at every rotation, and rates them (larger is better).

    With d the distance of a point to the nearest edge of its rectangle:
    area: minus the area (the paper). closeness: mean of d0 / max(d, d0) (Zhang et al. 2017).
    visible_closeness: the same, to the two edges that face the sensor only. variance: minus the
    variances of the distances to the nearest edges along u and along v (Zhang et al. 2017).

    Args:
      points: of the clusters.
      cluster: (P,) int32, the clusters to bound. Those of like size best lie side by side.
      num_clusters: () int32, how many of them count.
      criterion: static, one of the above.
      num_angles: static, A; rotations by i * 90 / A degrees.
      min_distance_m: d0, m.

    Returns:
      curve: (A, P) float32.
      extents: (4, A, P) float32, m: lower and upper bounds of u, then of v; 0 without points.

    Reference: paper, Algorithm III; oracles `jaxbox.reference.criterion_curve`, cv2.minAreaRect.
    """
    angle = (np.arange(num_angles) * (math.pi / 2 / num_angles))[:, None]
    cos, sin = jnp.asarray(np.cos(angle), jnp.float32), jnp.asarray(np.sin(angle), jnp.float32)

    def rate(cluster: jax.Array) -> tuple[jax.Array, jax.Array]:
        clusters = points.table(cluster)
        extents = _extents(clusters, cos, sin)
        return _CRITERIA[criterion](clusters, cos, sin, extents, min_distance_m), extents

    return map_rows(rate, cluster, num_rows=num_clusters, chunk=CHUNK, axis=-1)


def _extents(clusters: PointTable, cos: jax.Array, sin: jax.Array) -> jax.Array:
    # How far the cluster reaches along -u, u, -v and v: one kernel, and one array.
    to_x, to_y = jnp.concatenate([-cos, cos, sin, -sin]), jnp.concatenate([-sin, sin, -cos, cos])

    def update(reach: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
        return fast_max(reach, _along(x, y, to_x, to_y))

    x, y, count = clusters
    # A point that is absent is seen as the first once more; a cluster without any has a first one anyhow.
    nearest = jnp.full((to_x.shape[0], x.shape[1]), -jnp.inf, jnp.float32)
    reach = fold_points(x, y, count, nearest, update, absent=(x[0], y[0]), reduce=jnp.max)
    sign = jnp.array([-1, 1, -1, 1], jnp.float32)[:, None, None]
    return sign * jnp.where(count > 0, reach, 0).reshape(4, -1, x.shape[1])


def _along(x: jax.Array, y: jax.Array, to_x: jax.Array, to_y: jax.Array) -> jax.Array:
    # Written alike wherever it is needed, so that it is rounded alike: the outermost point lies on the edge.
    # (With the minus of -sin inside the loop it would be a difference, which rounds otherwise; and sines
    # that are computed twice may differ.)
    return x[None] * to_x + y[None] * to_y


def _absent(num_angles: int) -> tuple[float, float]:
    """A point far from all edges at all rotations: it lies between two of them."""
    angle = math.pi / 4 / num_angles
    return FAR_M * math.cos(angle), FAR_M * math.sin(angle)


def _area(
    clusters: PointTable, cos: jax.Array, sin: jax.Array, extents: jax.Array, d0: jax.Array | float
) -> jax.Array:
    u0, u1, v0, v1 = extents
    return -(u1 - u0) * (v1 - v0)


def _closeness(
    clusters: PointTable, cos: jax.Array, sin: jax.Array, extents: jax.Array, d0: jax.Array | float
) -> jax.Array:
    u0, u1, v0, v1 = extents

    def distance(u: jax.Array, v: jax.Array) -> jax.Array:
        return fast_min(_to_edge(u, u0, u1), _to_edge(v, v0, v1))

    return _mean_closeness(clusters, cos, sin, distance, d0)


def _to_edge(u: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Distance to the nearer of two edges, from between them or beyond."""
    return fast_min(jnp.abs(u - low), jnp.abs(high - u))


def _visible_closeness(
    clusters: PointTable, cos: jax.Array, sin: jax.Array, extents: jax.Array, d0: jax.Array | float
) -> jax.Array:
    u0, u1, v0, v1 = extents
    # The sensor is the origin: of two opposite edges it sees the one nearer to 0.
    u_near = jnp.where(jnp.abs(u0) < jnp.abs(u1), u0, u1)
    v_near = jnp.where(jnp.abs(v0) < jnp.abs(v1), v0, v1)

    def distance(u: jax.Array, v: jax.Array) -> jax.Array:
        return fast_min(jnp.abs(u - u_near), jnp.abs(v - v_near))

    return _mean_closeness(clusters, cos, sin, distance, d0)


def _mean_closeness(
    clusters: PointTable,
    cos: jax.Array,
    sin: jax.Array,
    distance: Callable[[jax.Array, jax.Array], jax.Array],
    d0: jax.Array | float,
) -> jax.Array:
    minus_sin = -sin

    def update(total: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
        return total + d0 / fast_max(distance(_along(x, y, cos, sin), _along(x, y, minus_sin, cos)), d0)

    x, y, count = clusters
    zero = jnp.zeros((cos.shape[0], x.shape[1]), jnp.float32)
    total = fold_points(x, y, count, zero, update, absent=_absent(cos.shape[0]))
    return total / jnp.maximum(count, 1).astype(jnp.float32)[None]


def _variance(
    clusters: PointTable, cos: jax.Array, sin: jax.Array, extents: jax.Array, d0: jax.Array | float
) -> jax.Array:
    u0, u1, v0, v1 = extents
    minus_sin = -sin

    def update(state: tuple[jax.Array, ...], x: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
        du, dv = _to_edge(_along(x, y, cos, sin), u0, u1), _to_edge(_along(x, y, minus_sin, cos), v0, v1)
        there = (jnp.abs(x) < FAR_M / 2)[None]
        along_u = there & (du < dv)
        along_v = there & ~along_u
        nu, su, ssu, nv, sv, ssv = state
        du, dv = jnp.where(along_u, du, 0), jnp.where(along_v, dv, 0)
        num_u, num_v = along_u.astype(jnp.float32), along_v.astype(jnp.float32)
        return nu + num_u, su + du, ssu + du**2, nv + num_v, sv + dv, ssv + dv**2

    x, y, count = clusters
    zero = jnp.zeros((cos.shape[0], x.shape[1]), jnp.float32)
    nu, su, ssu, nv, sv, ssv = fold_points(x, y, count, (zero,) * 6, update, absent=_absent(cos.shape[0]))

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
    curve: jax.Array, extents: jax.Array, preference: jax.Array, *, insistence: float = 1.0
) -> Rectangles:
    """The rectangle at each cluster's best rotation.

    Args:
      curve: (A, P) float32, see `try_rotations`.
      extents: (4, A, P) float32, m, likewise.
      preference: (A,) float32, added to every curve.
      insistence: how often the preference counts when the rotation is chosen; its worth counts it once.

    Returns:
      The rectangles; of equally good rotations the first.
    """
    num_angles = curve.shape[0]
    total = curve + (insistence * preference)[:, None]
    # An argmax does not vectorise; a minimum of integers takes several kernels, one of floats one (XLA, CPU).
    is_best = total >= jnp.max(total, axis=0)[None]
    angle = jnp.arange(num_angles, dtype=jnp.float32)[:, None]
    best = jnp.min(jnp.where(is_best, angle, num_angles - 1), axis=0).astype(jnp.int32)
    u0, u1, v0, v1 = jnp.take_along_axis(extents, best[None, None], axis=1)[:, 0]
    worth = jnp.take_along_axis(curve, best[None], axis=0)[0]
    angle = best.astype(jnp.float32) * (math.pi / 2 / num_angles)
    return Rectangles(jnp.stack([u0, v0, u1, v1, angle, worth + preference[best]], axis=1))


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
    bins = jnp.arange(num_angles, dtype=jnp.float32) * (90.0 / num_angles)

    def closeness(angle_deg: jax.Array) -> jax.Array:
        difference = (bins[None] - angle_deg[:, None] % 90 + 45) % 90 - 45
        return jnp.exp(-((difference / sigma_deg) ** 2))

    def add(votes: jax.Array, _: jax.Array, rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        yaw, power = rows
        return votes + power @ closeness(jnp.rad2deg(yaw))

    power = jnp.minimum(num_points.astype(jnp.float32), VOTE_POINTS) * jnp.minimum(extent, VOTE_EXTENT_M)
    ballots = yaw, jnp.where(voting, power, 0)
    votes = jnp.zeros(num_angles, jnp.float32)
    votes = fold_rows(add, votes, ballots, num_rows=rows_in_use(voting), chunk=VOTE_CHUNK, absent=(0.0, 0.0))
    direction = bins[jax.lax.argmax(votes, 0, jnp.int32)]
    return jnp.where(jnp.max(votes) > 0, weight * closeness(direction[None])[0], 0)
