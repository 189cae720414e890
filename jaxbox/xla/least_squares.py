"""Least-squares planes through masked points."""

import jax
import jax.numpy as jnp

from jaxbox.geometry.planar import plane_residual
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.rows import count_true

MIN_SPREAD = 1e-4
"""Least determinant of the inliers' covariance, over the square of its trace, that tells a plane."""


def refit_plane(candidates: jax.Array, inliers: jax.Array, plane: jax.Array) -> jax.Array:
    """Least-squares plane through the inliers. Law: as `numpy.linalg.lstsq`, to rounding.

    About the inliers' mean, or else float32 sums would cancel.

    Args:
      candidates: (C, 3) float32, m.
      inliers: (C,) bool.
      plane: (3,) float32, the plane z = a x + b y + c that they are inliers of.

    Returns:
      (3,) float32; `plane` itself where the inliers lie on one line, which leaves the plane open.
    """
    if on_accelerator():
        return _refit_residuals(candidates, inliers, plane)
    rows = candidates.T
    num = jnp.maximum(count_true(inliers), 1).astype(jnp.float32)
    mean = jnp.sum(jnp.where(inliers, rows, 0), axis=1) / num
    centred = jnp.where(inliers, rows - mean[:, None], 0)
    cov = jnp.sum(centred[:, None] * centred[None], axis=-1) / num
    determinant = cov[0, 0] * cov[1, 1] - cov[0, 1] ** 2
    a = (cov[0, 2] * cov[1, 1] - cov[1, 2] * cov[0, 1]) / determinant
    b = (cov[1, 2] * cov[0, 0] - cov[0, 2] * cov[0, 1]) / determinant
    refit = jnp.stack([a, b, mean[2] - a * mean[0] - b * mean[1]])
    spread = determinant > MIN_SPREAD * (cov[0, 0] + cov[1, 1]) ** 2
    return jnp.where(spread, refit, plane)


def _refit_residuals(candidates: jax.Array, inliers: jax.Array, plane: jax.Array) -> jax.Array:
    """As `refit_plane`, by one sum of all moments: of the residuals, which are small, none cancels."""
    x, y = candidates[:, 0], candidates[:, 1]
    r = plane_residual(candidates, plane)
    moments = jnp.stack([jnp.ones_like(x), x, y, r, x * x, x * y, y * y, x * r, y * r])
    num, *sums = jnp.sum(jnp.where(inliers, moments, 0), axis=1)
    mean_x, mean_y, mean_r, xx, xy, yy, xr, yr = (total / jnp.maximum(num, 1) for total in sums)
    xx, xy, yy = xx - mean_x**2, xy - mean_x * mean_y, yy - mean_y**2
    xr, yr = xr - mean_x * mean_r, yr - mean_y * mean_r
    determinant = xx * yy - xy**2
    a, b = (xr * yy - yr * xy) / determinant, (yr * xx - xr * xy) / determinant
    change = jnp.stack([a, b, mean_r - a * mean_x - b * mean_y])
    spread = determinant > MIN_SPREAD * (xx + yy) ** 2
    return plane + jnp.where(spread, change, 0)
