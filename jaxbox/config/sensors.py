"""What of the settings depends on the sensor: the number of beams that meet a vehicle.

The presets were chosen on sweeps of 64 beams. With fewer, the same car holds fewer points, and the rings on
the ground lie farther apart. Which settings that moves, and how far, was measured on KITTI sweeps thinned to
every second and every fourth beam (`jaxbox.evaluation.thin_beams`): what is kept gains on both of two sets of
frames, which share eight of their drives: ``python -m benchmarks.bench_beams``.
"""

import dataclasses
import math
from collections.abc import Mapping

TUNED_BEAMS = 64
"""The presets were chosen on a sensor of that many beams, KITTI's HDL-64E."""
TUNED_SPACING_DEG = 0.37
"""Mean step in elevation between that sensor's beams from -10 to 0 degrees, which meet the vehicles."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorChanges:
    """What to change in a preset for a sensor."""

    changes: Mapping[str, Mapping[str, float]]
    """Values by stage and field."""
    cells: float = 1.0
    """Occupied cells relative to those of 64 beams: the capacity of each map is multiplied by it."""


SENSORS: Mapping[int, SensorChanges] = {
    16: SensorChanges(
        changes={
            # From ring to ring the ground is not seen, so it is smoothed farther and rises less steeply.
            "ground": {"smoothing_m": 2.0, "max_grade": 0.03},
            # A few beams meet a car: take those on its windows' edge too.
            # Rings one above the other lie far apart, but on one car.
            "clustering": {"adaptive_start_m": 5.0, "adaptive_growth": 0.07},
            "box": {"slab_max_height_m": 1.0},
            "vehicles": {"top_grade": 0.015, "saturation_points": 25.0},
        },
        cells=0.5,
    ),
    32: SensorChanges(
        changes={
            "ground": {"smoothing_m": 3.0},
            "clustering": {"adaptive_start_m": 5.0, "adaptive_growth": 0.04},
            "box": {"slab_max_height_m": 1.0},
            "vehicles": {"top_grade": 0.015, "saturation_points": 50.0},
        },
        cells=0.75,
    ),
    64: SensorChanges(changes={}),
    128: SensorChanges(changes={}, cells=1.5),
}
"""By the number of beams, over a field of view like that of the HDL-64E; see `fitting_sensor` for others."""


def sensor_changes(num_beams: int) -> SensorChanges:
    """What a sensor changes in a preset.

    Args:
      num_beams: one of `SENSORS`.

    Returns:
      What to change in a preset.

    Raises:
      ValueError: for another number.
    """
    if num_beams not in SENSORS:
        raise ValueError(
            f"{num_beams}: there are no settings for that many beams; choose one of {_choices()}."
        )
    return SENSORS[num_beams]


def _choices() -> str:
    return ", ".join(map(str, SENSORS))


def fitting_sensor(spacing_deg: float) -> int:
    """The sensor whose beams lie as far apart, for one of any number of beams and field of view.

    What counts is how many beams meet a vehicle: 32 beams over 40 degrees see it as 16 over 27 do.

    Args:
      spacing_deg: mean step in elevation between neighbouring beams below the horizon, above 0.

    Returns:
      The nearest of `SENSORS`, by the ratio.

    >>> fitting_sensor(0.4), fitting_sensor(1.33), fitting_sensor(0.1)
    (64, 16, 128)
    """
    return min(SENSORS, key=lambda num: abs(math.log(TUNED_BEAMS / num * TUNED_SPACING_DEG / spacing_deg)))
