"""Whether a sweep can be trusted: the figures by which the status doubts it."""

import numpy as np

from jaxbox.config import GroundConfig, HealthConfig
from jaxbox.reference.state import Evidence, Ground, Sweep

NEAR_CELLS = 16
"""Range cells of the evidence that are near."""
NEAR_M, FAR_M = 3.0, 12.0
"""Between these ranges the ground is compared with its surface."""
GROUND_BAND_M = 0.3
"""Points nearer to the ground are compared, lower ones are below it,"""
ROUGH_M = 0.05
"""and are rough where they are farther than this."""
LOW_M, MIN_HEIGHT_M = 0.8, 0.2
"""What is far is nearer in proportion for a sensor between these heights."""
UNDER_RATIO = 0.6
"""Ground nearer than this share of the sensor's height is right under it."""


def measure_health(
    sweep: Sweep, ground: Ground, evidence: Evidence | None, config: HealthConfig, ground_config: GroundConfig
) -> dict[str, int]:
    """Counts what good sweeps have much of, or nothing.

    Args:
      sweep: of n points.
      ground: below them.
      evidence: None where the preset does not ask for it.
      config: what is far.
      ground_config: up to which height a point is on the ground.

    Returns:
      The last fields of `jaxbox.types.Counts`.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        rho = np.hypot(sweep.xyz[:, 0], sweep.xyz[:, 1])
    # NaN, the height of points that do not count, compares False.
    off_ground = np.abs(ground.height)
    near = (rho > NEAR_M) & (rho < FAR_M) & (off_ground < GROUND_BAND_M)
    below = ground.height <= -GROUND_BAND_M
    if ground.surface is None:
        near[:], below[:] = False, False
    sensor_height_m = -ground.planes[0, 2]
    under = (off_ground < ground_config.min_height_m) & (rho < UNDER_RATIO * sensor_height_m)
    is_low = MIN_HEIGHT_M <= sensor_height_m < LOW_M
    far_m = config.far_m * (sensor_height_m / LOW_M if is_low else 1)
    scattered = 0
    if evidence is not None:
        hit, free = (
            np.diff(sums[:, : NEAR_CELLS + 1], axis=1) for sums in (evidence.hit_sums, evidence.free_sums)
        )
        scattered = int(((hit > 0) & (free > 0)).any(axis=1).sum())
    return {
        "far_points": int((sweep.finite & (~sweep.in_region | (rho > far_m))).sum()),
        "scattered_azimuths": scattered,
        "near_ground_points": int(near.sum()),
        "rough_points": int((near & (off_ground > ROUGH_M)).sum()),
        "points_under": int(under.sum()),
        "points_below": int(below.sum()),
    }
