"""Shape descriptors: moment of inertia, eccentricity, density, complexity (paper, 3.5 and 4.4)."""

import chex
import jax
import jax.numpy as jnp

from jaxbox.stages.state import Kept, Owners
from jaxbox.types import Descriptors, Hulls
from jaxbox.xla.indexing import take
from jaxbox.xla.loops import map_rows
from jaxbox.xla.segments import fold_segments

MIN_VARIANCE = 1e-6
"""m^2: points on a line have a minor axis of a millimetre rather than none."""


def describe(
    owners: Owners, xy: jax.Array, kept: Kept, hulls: Hulls, hull_area: jax.Array
) -> tuple[jax.Array, Descriptors]:
    """How many points each detection has, and their shape.

    Args:
      owners: the points of K detections.
      xy: (O, 2) float32, m, of the obstacles.
      kept: the detections.
      hulls: of those points.
      hull_area: (K,) float32, m^2.

    Returns:
      num_points: (K,) int32.
      descriptors: of K detections.
    """
    chex.assert_shape([xy, owners.row, owners.owner], [(None, 2), xy.shape[:1], xy.shape[:1]])
    moments = point_moments(owners.owner, owners.row, owners.num, xy, kept.center[:, :2])
    shape, every = (moments, hull_area, hulls.num_vertices), jnp.int32(kept.valid.shape[0])
    shapes = map_rows(lambda rows: shape_descriptors(*rows), shape, num_rows=every)
    return moments[:, 0].astype(jnp.int32), shapes


def point_moments(
    slot: jax.Array, row: jax.Array, num_rows: jax.Array, xy: jax.Array, origin: jax.Array
) -> jax.Array:
    """Sums over the points of each cluster, from which their shape follows.

    Args:
      slot: (L,) int32 cluster of each point of a list, K for none.
      row: (L,) int32 rows of those points.
      num_rows: () int32; how many of the list count, from the first on.
      xy: (N, 2) float32, m.
      origin: (K, 2) float32, m, a point near each cluster: moments about it do not cancel.

    Returns:
      (K, 6) float32: the sums of 1, x, y, x^2, y^2 and x y, about the origin.
    """

    def powers(slot: jax.Array, row: jax.Array) -> jax.Array:
        point, at = take(xy, row), take(origin, slot)
        x, y = point[:, :1] - at[:, :1], point[:, 1:] - at[:, 1:]
        return jnp.concatenate([jnp.ones_like(x), x, y, x * x, y * y, x * y], axis=1)

    size = origin.shape[0]
    return fold_segments("add", powers, slot, row, num_rows=num_rows, num_segments=size, absent=xy.shape[0])


def shape_descriptors(moments: jax.Array, hull_area: jax.Array, num_vertices: jax.Array) -> Descriptors:
    """Describes the shape of each cluster, seen from above.

    With l1 >= l2 the eigenvalues of the covariance of the points, which are their moments of inertia per
    point about the minor and the major axis: eccentricity = sqrt(l1 / l2), the ratio of the axes' lengths;
    density = points / hull area; complexity kappa = hull vertices / points (equation 7).

    Args:
      moments: (K, 6) float32, see `point_moments`.
      hull_area: (K,) float32, m^2.
      num_vertices: (K,) int32.

    Returns:
      The descriptors; 1 for the eccentricity, and 0 for all else, of an empty cluster.

    Reference: paper, sections 3.5 and 4.4; oracle `jaxbox.reference.shape_descriptors`.
    """
    count = moments[:, 0]
    x, y, xx, yy, xy = (moments[:, 1:] / jnp.maximum(count, 1)[:, None]).T
    major, minor = _eigenvalues(xx - x * x, yy - y * y, xy - x * y)
    has_points = count > 0
    ratio = jnp.maximum(major, MIN_VARIANCE) / jnp.maximum(minor, MIN_VARIANCE)
    has_area = has_points & (hull_area > 0)
    return Descriptors(
        moment_of_inertia=jnp.stack([major, minor], axis=1),
        eccentricity=jnp.sqrt(ratio),
        density=jnp.where(has_area, count / jnp.where(has_area, hull_area, 1), 0),
        complexity=jnp.where(has_points, num_vertices.astype(jnp.float32) / jnp.maximum(count, 1), 0),
    )


def _eigenvalues(a: jax.Array, b: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Eigenvalues of the symmetric matrices [[a, c], [c, b]], larger first, not negative."""
    middle, radius = (a + b) / 2, jnp.hypot((a - b) / 2, c)
    return jnp.maximum(middle + radius, 0), jnp.maximum(middle - radius, 0)
