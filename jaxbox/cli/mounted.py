"""Sweeps as they are seen from their sensor, upright: what ``--sensor-at`` and ``--level`` ask for."""

from collections.abc import Sequence

from jaxbox import io
from jaxbox.geometry.mounting import Mounting


def seen_from_sensor(
    sweeps: Sequence[io.Sweep],
    *,
    sensor_at: tuple[float, float, float] | None,
    level: bool,
    measured: Mounting | None = None,
) -> tuple[Sequence[io.Sweep], Mounting | None]:
    """Moves sweeps into the frame of their sensor.

    Args:
      sweeps: of one sensor.
      sensor_at: x, y, z of the sensor in the frame of the points, m; None for the origin.
      level: whether they are seen upright, too.
      measured: how the sensor stands, where that was measured before; None to measure it.

    Returns:
      The sweeps, and how the sensor stands; None where neither was asked for.

    Raises:
      InputError: where no ground can be found to measure by.
    """
    position = sensor_at or (0.0, 0.0, 0.0)
    if level:
        mounting = measured or io.measure_sweeps(sweeps, position=position)
    elif any(position):
        mounting = Mounting(position)
    else:
        return sweeps, None
    return io.LevelSweeps(sweeps, mounting), mounting


def describe_mounting(mounting: Mounting) -> str:
    """A measured mounting in words."""
    return (
        f"the sensor stands {mounting.height_m:.2f} m above the ground, tilted {mounting.tilt_deg:.1f} "
        "degrees; boxes are in the level frame"
    )
