"""Shape descriptors: moment of inertia, eccentricity, density, complexity (paper, 3.5 and 4.4)."""

import jax
import jax.numpy as jnp

from jaxbox.types import Descriptors

MIN_VARIANCE = 1e-6
"""m^2: points on a line have a minor axis of a millimetre rather than none."""


def shape_descriptors(
    slot: jax.Array,
    xy: jax.Array,
    origin: jax.Array,
    hull_area: jax.Array,
    num_vertices: jax.Array,
) -> Descriptors:
    """Describes the shape of each cluster, seen from above.

    With l1 >= l2 the eigenvalues of the covariance of the points, which are their moments of inertia per
    point about the minor and the major axis: eccentricity = sqrt(l1 / l2), the ratio of the axes' lengths;
    density = points / hull area; complexity kappa = hull vertices / points (equation 7).

    Args:
      slot: (N,) int32 cluster of each point, K for none.
      xy: (N, 2) float32, m.
      origin: (K, 2) float32, m, a point near each cluster: moments about it do not cancel.
      hull_area: (K,) float32, m^2.
      num_vertices: (K,) int32.

    Returns:
      The descriptors; 1 for the eccentricity, and 0 else, of an empty cluster.

    Reference: paper, sections 3.5 and 4.4; oracle `jaxbox.reference.shape_descriptors`.
    """
    size = origin.shape[0]
    d = xy - origin[jnp.minimum(slot, size - 1)]
    dx, dy = d[:, 0], d[:, 1]

    def total(values: jax.Array) -> jax.Array:
        # A scatter each: one of rows would first have to be built, which costs more (XLA, CPU).
        return jnp.zeros(size).at[slot].add(values, mode="drop")

    count = total(jnp.ones_like(dx))
    x, y, xx, yy, xy_ = (total(v) / jnp.maximum(count, 1) for v in (dx, dy, dx * dx, dy * dy, dx * dy))
    major, minor = _eigenvalues(xx - x * x, yy - y * y, xy_ - x * y)
    present = count > 0
    ratio = jnp.maximum(major, MIN_VARIANCE) / jnp.maximum(minor, MIN_VARIANCE)
    has_area = present & (hull_area > 0)
    return Descriptors(
        moment_of_inertia=jnp.stack([major, minor], axis=1),
        eccentricity=jnp.sqrt(ratio),
        density=jnp.where(has_area, count / jnp.where(has_area, hull_area, 1), 0),
        complexity=jnp.where(present, num_vertices / jnp.maximum(count, 1), 0),
    )


def _eigenvalues(a: jax.Array, b: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Eigenvalues of the symmetric matrices [[a, c], [c, b]], larger first, not negative."""
    middle, radius = (a + b) / 2, jnp.hypot((a - b) / 2, c)
    return jnp.maximum(middle + radius, 0), jnp.maximum(middle - radius, 0)
