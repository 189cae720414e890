"""Rectangles by trying all rotations (paper, section 3.4, Algorithm III)."""

import math
from collections.abc import Callable, Sequence

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.config import BoxConfig, DetectorConfig, Scalar
from jaxbox.stages.state import Outlines, Rectangles, Rotations
from jaxbox.xla import chunks
from jaxbox.xla.arithmetic import arctan2, fast_max, fast_min
from jaxbox.xla.indexing import take
from jaxbox.xla.loops import map_rows
from jaxbox.xla.ragged import PointLists, PointTable, fold_points
from jaxbox.xla.rows import first_argmax
from jaxbox.xla.sorting import largest_first

PREFERENCE_GAIN = 5.0
"""How often the scene's direction counts for the second candidate of a cluster: it bends a closeness only."""

AXIS_APART_DEG = 5.0
"""A rectangle along the principal axis differs by more from the best rotation: else it says nothing new."""

PEAKS_APART_DEG, MIN_PEAK_POINTS = 6.0, 30
"""A second peak differs by so much from the best rotation, and is looked for where a rectangle is fitted to
so many points: to weigh it takes time."""

FAR_M = 1e12
"""Farther away than any point."""

SAME_DISTANCE_M = 1e-4
"""Distances to two edges that differ by less are the same: a corner's point is on both, as it is rounded."""


def fit_rectangles(outlines: Outlines, num_clusters: jax.Array, config: BoxConfig) -> Rotations:
    """Rectangles of all clusters at all rotations.

    Args:
      outlines: the points of P clusters.
      num_clusters: () int32, how many count.
      config: criterion and rotations.

    Returns:
      The rectangles, of the clusters with most points first.
    """
    points = outlines.points
    chex.assert_equal_shape([points.start, points.total])
    order, place = largest_first(points.count, points.max_points)
    curve, extents, principal = try_rotations(points, order, num_clusters, config)
    return Rotations(curve, extents, take(points.count, order), order, place, principal)


def choose_rectangles(rotations: Rotations, num_clusters: jax.Array, preference: jax.Array) -> Rectangles:
    """The rectangle of each cluster at its best rotation, see `best_rectangles`.

    Args:
      rotations: of P clusters.
      num_clusters: () int32, how many count.
      preference: (A,) float32, added to every curve.

    Returns:
      (P,) rectangles.
    """
    columns = _best_columns(rotations, num_clusters, preference)
    return Rectangles(columns.T[rotations.place])


def _best_columns(rotations: Rotations, num_clusters: jax.Array, preference: jax.Array) -> jax.Array:
    """(6, P) rows of `Rectangles`, of the clusters with most points first."""

    def best(rotations: tuple[jax.Array, jax.Array]) -> jax.Array:
        return best_rectangles(*rotations, preference).rows.T

    num_angles, num_columns = rotations.curve.shape
    chex.assert_shape([preference, rotations.extents], [(num_angles,), (4, num_angles, num_columns)])
    columns = rotations.curve, rotations.extents
    return map_rows(best, columns, num_rows=num_clusters, chunk=chunks.PROPOSALS, axis=-1)


def rectangle_candidates(
    rotations: Rotations,
    points: PointLists,
    num_clusters: jax.Array,
    preference: jax.Array,
    config: DetectorConfig,
) -> list[Rectangles]:
    """The rectangles of each cluster that the evidence is to choose from.

    Args:
      rotations: of P clusters.
      points: that those were fitted to.
      num_clusters: () int32, how many count.
      preference: (A,) float32, for the scene's direction.
      config: of the detector.

    Returns:
      That at the best rotation, bent to the scene's direction; where the preset asks, four: one that knows
      nothing of that direction, one that keeps to it, one at a second peak of the curve, and one along the
      principal axis of the points. Those fitted to the points themselves are without strays.
    """
    columns = _candidate_columns(rotations, num_clusters, preference, config)
    if config.box.fit_to == "slab":
        columns = _without_strays(columns, rotations, points, num_clusters, config.box)
    return [Rectangles(each.T[rotations.place]) for each in columns]


def _candidate_columns(
    rotations: Rotations, num_clusters: jax.Array, preference: jax.Array, config: DetectorConfig
) -> list[jax.Array]:
    """(6, P) each: the rows of the candidates, of the clusters with most points first."""
    if not (config.box.scene_direction and config.completion.along_scene):
        return [_best_columns(rotations, num_clusters, preference)]

    def bound(columns: tuple[jax.Array, ...]) -> list[jax.Array]:
        curve, extents, num_points, principal = columns
        best, _ = first_argmax(curve)
        low_u, high_u, low_v, high_v = extents
        narrow = jnp.minimum(high_u - low_u, high_v - low_v) <= config.vehicles.classes[0].max_width_m
        peak = second_peak(curve, narrow, num_points[0], max_loss=config.box.second_peak_loss)
        along = along_axis(best, principal[0], num_points[0], curve.shape[0], config.box.min_axis_points)
        found = [
            rectangles_at(best, curve, extents, preference),
            best_rectangles(curve, extents, preference, gain=PREFERENCE_GAIN),
            best_rectangles(peak, extents, preference, gain=0),
            rectangles_at(along, curve, extents, preference),
        ]
        return [each.rows.T for each in found]

    columns = rotations.curve, rotations.extents, rotations.num_points[None], rotations.principal[None]
    return map_rows(bound, columns, num_rows=num_clusters, chunk=chunks.PROPOSALS, axis=-1)


def _without_strays(
    candidates: Sequence[jax.Array],
    rotations: Rotations,
    points: PointLists,
    num_clusters: jax.Array,
    config: BoxConfig,
) -> list[jax.Array]:
    """(6, P) each: the candidates of clusters with many points, which come first, by `trim_strays`."""
    many = rotations.num_points.astype(jnp.float32) >= config.min_stray_points

    def trim(columns: tuple[jax.Array, jax.Array]) -> jax.Array:
        rows, cluster = columns
        return trim_strays(rows, points.table(cluster), config.stray_m)

    rows = jnp.stack(candidates, axis=1)
    num_many = jnp.minimum(num_clusters, jnp.sum(many, dtype=jnp.int32))
    columns = rows, rotations.cluster
    trimmed = map_rows(trim, columns, num_rows=num_many, chunk=chunks.PROPOSALS, axis=-1)
    trimmed = jnp.where(many[None, None], trimmed, rows)
    return [trimmed[:, i] for i in range(len(candidates))]


def trim_strays(rectangles: jax.Array, clusters: PointTable, stray_m: Scalar) -> jax.Array:
    """Moves edges that a single point carries ahead of the others up to those.

    A mirror, or a return from between two surfaces, lies ahead of a vehicle's side. Only the two edges nearer
    to the sensor move: points thin out towards the others, and the last one says where the vehicle ends.

    Args:
      rectangles: (6, K, C) float32, rows of `Rectangles`, of each cluster K.
      clusters: the points of C clusters.
      stray_m: () m, how far ahead of all others the point on such an edge may lie.

    Returns:
      As `rectangles`; an edge that two points lie on, or all of them, stays.

    Reference: oracle `jaxbox.reference.trim_strays`.
    """
    low, high, angle = rectangles[:2], rectangles[2:4], rectangles[4]
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    # Along u and along v, (2, K, C), with coordinates that grow towards the sensor.
    is_low = jnp.abs(low) < jnp.abs(high)
    sign = 1 - 2 * is_low.astype(jnp.float32)
    edge = sign * jnp.where(is_low, low, high)
    to_x, to_y = sign * jnp.stack([cos, -sin]), sign * jnp.stack([sin, cos])
    inside = edge - SAME_DISTANCE_M

    def update(reach: tuple[jax.Array, ...], x: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
        along = x[None, None] * to_x + y[None, None] * to_y
        across, is_inside = along[::-1], along < inside
        here = (
            jnp.where(is_inside, along, -jnp.inf),
            jnp.where(is_inside, -jnp.inf, across),
            jnp.where(is_inside, -jnp.inf, -across),
        )
        return tuple(fast_max(before, to) for before, to in zip(reach, here, strict=True))

    x, y, count = clusters
    nothing = (jnp.full_like(edge, -jnp.inf),) * 3
    others, left, right = fold_points(x, y, count, nothing, update, absent=(x[0], y[0]), operation="max")
    is_stray = (left + right < SAME_DISTANCE_M) & (others > -jnp.inf)
    edge = jnp.where(is_stray, fast_min(edge, others + stray_m), edge)
    low, high = jnp.where(is_low, -edge, low), jnp.where(is_low, high, edge)
    return jnp.concatenate([low, high, rectangles[4:]])


def along_axis(
    best: jax.Array, principal: jax.Array, num_points: jax.Array, num_angles: int, min_points: Scalar
) -> jax.Array:
    """The rotations along the principal axes of clusters with many points.

    The rounded front of a car seen end-on fits best at 10 to 20 degrees to either side, which noise decides;
    its points lie symmetrically about its axis at any noise.

    Args:
      best: (P,) int32, the best rotation.
      principal: (P,) int32, see `principal_rotations`.
      num_points: (P,) int32, that they are of.
      num_angles: static, A.
      min_points: (), clusters of fewer keep their best rotation, and those with an axis next to it.

    Returns:
      (P,) int32.

    Reference: oracle `jaxbox.reference.along_axis`.
    """
    apart_deg = _apart_deg(principal, best, num_angles)
    is_tried = (num_points.astype(jnp.float32) >= min_points) & (apart_deg >= AXIS_APART_DEG)
    return jnp.where(is_tried, principal, best)


def _apart_deg(first: jax.Array, second: jax.Array, num_angles: int) -> jax.Array:
    """Degrees between two rotations, which repeat every quarter turn."""
    turn = jnp.abs(first - second)
    return jnp.minimum(turn, num_angles - turn).astype(jnp.float32) * (90 / num_angles)


def second_peak(curve: jax.Array, narrow: jax.Array, num_points: jax.Array, *, max_loss: Scalar) -> jax.Array:
    """The peaks of curves apart from their best rotation, where one of them is nearly as good.

    A vehicle that is seen in part, or is near and rounded, may fit nearly as well at two rotations or three,
    and a little noise decides. The best may be askew: too wide for any car.

    Args:
      curve: (A, P) float32, see `try_rotations`.
      narrow: (A, P) bool, whether the rectangle is no wider than a car at most: peaks elsewhere count only
        where it is so at no rotation.
      num_points: (P,) int32, that they are of.
      max_loss: () of the curve's value, from the best of those rotations to a peak that is nearly as good.

    Returns:
      (A, P) float32: minus infinity but at peaks apart from the best rotation. The curve itself of few
      points, and where no other peak is nearly as good.

    Reference: oracle `jaxbox.reference.second_peak`.
    """
    num_angles = curve.shape[0]
    best, _ = first_argmax(curve)
    allowed = jnp.where(narrow | ~jnp.any(narrow, axis=0, keepdims=True), curve, -jnp.inf)
    apart_deg = _apart_deg(jnp.arange(num_angles, dtype=jnp.int32)[:, None], best[None], num_angles)
    is_peak = (curve >= jnp.roll(curve, 1, axis=0)) & (curve >= jnp.roll(curve, -1, axis=0))
    others = jnp.where(is_peak & (apart_deg >= PEAKS_APART_DEG), allowed, -jnp.inf)
    greatest = jnp.max(allowed, axis=0)
    has_other = (num_points >= MIN_PEAK_POINTS) & (jnp.max(others, axis=0) > greatest - max_loss)
    return jnp.where(has_other[None], others, curve)


def try_rotations(
    points: PointLists, cluster: jax.Array, num_clusters: jax.Array, config: BoxConfig
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Bounds each cluster by a rectangle at every rotation, and rates them (larger is better).

    With d the distance of a point to the nearest edge of its rectangle:
    area: minus the area (the paper). closeness: mean of d0 / max(d, d0) (Zhang et al. 2017).
    visible_closeness: the same, to the two edges that face the sensor only. variance: minus the
    variances of the distances to the nearest edges along u and along v (Zhang et al. 2017).

    Args:
      points: of the clusters.
      cluster: (P,) int32, the clusters to bound. Those of like size best lie side by side.
      num_clusters: () int32, how many of them count.
      config: one of the criteria above; A rotations by i * 90 / A degrees; d0 is `min_distance_m`.

    Returns:
      curve: (A, P) float32.
      extents: (4, A, P) float32, m: lower and upper bounds of u, then of v; 0 without points.
      principal: (P,) int32, see `principal_rotations`.

    Reference: paper, Algorithm III; oracles `jaxbox.reference.try_rotations`, cv2.minAreaRect.
    """
    num_angles = config.num_angles
    angle = (np.arange(num_angles) * (math.pi / 2 / num_angles))[:, None]
    cos, sin = jnp.asarray(np.cos(angle), jnp.float32), jnp.asarray(np.sin(angle), jnp.float32)

    def rate(cluster: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        clusters = points.table(cluster)
        extents = _extents(clusters, cos, sin)
        curve = _CRITERIA[config.criterion](clusters, cos, sin, extents, config.min_distance_m)
        return curve, extents, principal_rotations(clusters, num_angles)

    return map_rows(rate, cluster, num_rows=num_clusters, chunk=chunks.ROTATIONS, axis=-1)


def principal_rotations(clusters: PointTable, num_angles: int) -> jax.Array:
    """The rotations along the principal axes of clusters, about which their moments of inertia differ most.

    Args:
      clusters: the points of C clusters.
      num_angles: static, A.

    Returns:
      (C,) int32, in [0, A): the nearest of the rotations by i * 90 / A degrees; 0 without points.

    Reference: paper, section 3.5 (moment of inertia); oracle `jaxbox.reference.principal_rotations`.
    """
    x, y, count = clusters
    valid = jnp.arange(x.shape[0], dtype=jnp.int32)[:, None] < count[None]
    # About the first point, so that squares do not cancel.
    x, y = jnp.where(valid, x - x[:1], 0), jnp.where(valid, y - y[:1], 0)
    num = jnp.maximum(count, 1).astype(jnp.float32)
    mean_x, mean_y = jnp.sum(x, axis=0) / num, jnp.sum(y, axis=0) / num
    difference = jnp.sum(x**2 - y**2, axis=0) / num - (mean_x**2 - mean_y**2)
    product = jnp.sum(x * y, axis=0) / num - mean_x * mean_y
    turns = arctan2(2 * product, difference) * (num_angles / math.pi)
    return jnp.round(turns).astype(jnp.int32) % num_angles


def _extents(clusters: PointTable, cos: jax.Array, sin: jax.Array) -> jax.Array:
    # Along -u and -v: what is computed along u and v as well, an accelerator would store for all points.
    minus_cos, minus_sin = -cos, -sin

    def update(reach: tuple[jax.Array, ...], x: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
        back, aside = _along(x, y, minus_cos, minus_sin), _along(x, y, sin, minus_cos)
        return tuple(
            fast_max(before, to) for before, to in zip(reach, (back, -back, aside, -aside), strict=True)
        )

    x, y, count = clusters
    # A point that is absent is seen as the first once more; a cluster without any has a first one anyhow.
    nearest = jnp.full((cos.shape[0], x.shape[1]), -jnp.inf, jnp.float32)
    reach = fold_points(x, y, count, (nearest,) * 4, update, absent=(x[0], y[0]), operation="max")
    low_u, high_u, low_v, high_v = (jnp.where(count > 0, to, 0) for to in reach)
    return jnp.stack([-low_u, high_u, -low_v, high_v])


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
        is_point = (jnp.abs(x) < FAR_M / 2)[None]
        along_u = is_point & (du < dv - SAME_DISTANCE_M)
        along_v = is_point & ~along_u
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
    curve: jax.Array, extents: jax.Array, preference: jax.Array, *, gain: float = 1.0
) -> Rectangles:
    """The rectangle at each cluster's best rotation.

    Args:
      curve: (A, P) float32, see `try_rotations`.
      extents: (4, A, P) float32, m, likewise.
      preference: (A,) float32, added to every curve.
      gain: how often the preference counts when the rotation is chosen; the score counts it once.

    Returns:
      The rectangles; of equally good rotations the first.
    """
    best, _ = first_argmax(curve + (gain * preference)[:, None])
    return rectangles_at(best, curve, extents, preference)


def rectangles_at(
    index: jax.Array, curve: jax.Array, extents: jax.Array, preference: jax.Array
) -> Rectangles:
    """The rectangle of each cluster at a rotation.

    Args:
      index: (P,) int32, in [0, A).
      curve: (A, P) float32, see `try_rotations`.
      extents: (4, A, P) float32, m, likewise.
      preference: (A,) float32, added to the scores.

    Returns:
      The rectangles.
    """
    u0, u1, v0, v1 = jnp.take_along_axis(extents, index[None, None], axis=1)[:, 0]
    score = jnp.take_along_axis(curve, index[None], axis=0)[0]
    angle = index.astype(jnp.float32) * (math.pi / 2 / curve.shape[0])
    return Rectangles(jnp.stack([u0, v0, u1, v1, angle, score + preference[index]], axis=1))
