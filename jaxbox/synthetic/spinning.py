"""A spinning sensor on a moving vehicle: how the ego vehicle's body sways, and which beams are fired when."""

import dataclasses

import numpy as np

from jaxbox.synthetic.terrain import MAX_RANGE_M

SWAY_DEG = (0.6, 0.3, 0.3)
"""Greatest yaw, pitch and roll of the ego vehicle's body, degrees: as a car's on a smooth road."""
SWAY_PERIOD_S = (1.5, 4.0)
"""Of each, s."""


@dataclasses.dataclass(frozen=True)
class Sway:
    """How the ego vehicle's body turns about its course: three sines."""

    period_s: np.ndarray
    """(3,) float64, s."""
    phase: np.ndarray
    """(3,) float64, rad."""

    @classmethod
    def draw(cls, rng: np.random.Generator) -> "Sway":
        """Draws periods and phases."""
        return cls(rng.uniform(*SWAY_PERIOD_S, 3), rng.uniform(0, 2 * np.pi, 3))

    def rotation(self, time_s: np.ndarray, heading: np.ndarray) -> np.ndarray:
        """(..., 3, 3) from the sensor to the world, for times and headings (...): yaw, pitch, roll."""
        swing = np.sin(2 * np.pi * time_s[..., None] / self.period_s + self.phase)
        angles = np.radians(SWAY_DEG) * swing
        angles[..., 0] += heading
        (cy, cp, cr), (sy, sp, sr) = np.moveaxis(np.array([np.cos(angles), np.sin(angles)]), -1, 1)
        rows = [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
        return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


NUM_PACKETS = 48
"""A turn is fired in this many groups of azimuths, each at one time: 2 ms at 10 turns a second. More take
longer to cast; a point's time is exact with any number."""
NUM_SECTORS = 12
"""Where all azimuths are fired simultaneously."""
BEARING_MARGIN = np.radians(1.0)
"""Pitch and roll move what a beam meets sideways by less than this."""


@dataclasses.dataclass(frozen=True)
class Packet:
    """Neighbouring azimuths that are fired at one time."""

    columns: np.ndarray
    """(A,) int64: which azimuths."""
    phase: float
    """When, in [0, 1) of a turn."""
    bearing: float
    """rad: direction of their middle."""
    half_width: float
    """rad: from there to their first and last."""

    def may_meet(self, pose: np.ndarray, xy: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """(C,) bool: whether things within radius (C,), m, of (C, 2), m, world frame, are in its sector."""
        ahead, left = ((xy - pose[:2, 3]) @ pose[:2, :2]).T
        distance = np.hypot(ahead, left)
        off = np.abs((np.arctan2(left, ahead) - self.bearing + np.pi) % (2 * np.pi) - np.pi)
        with np.errstate(divide="ignore"):
            reach = np.where(distance > radius, np.arcsin(np.minimum(radius / distance, 1.0)), np.pi)
        return (off < self.half_width + reach + BEARING_MARGIN) & (distance < MAX_RANGE_M + radius)


def split_turn(num_azimuths: int, *, rolling_shutter: bool) -> list[Packet]:
    """All azimuths of a turn by sectors; the sensor begins behind and turns counter-clockwise.

    Args:
      num_azimuths: firings a turn, from +x counter-clockwise.
      rolling_shutter: whether the sectors have their turn one after the other. Otherwise they are fired at
        once, and apart only because a sector meets fewer things.

    Returns:
      At most `NUM_PACKETS` packets, each with at least one azimuth.
    """
    number = NUM_PACKETS if rolling_shutter else NUM_SECTORS
    columns = np.arange(num_azimuths)
    place = ((columns / num_azimuths + 0.5) % 1.0 * number).astype(int)
    return [
        Packet(
            columns=columns[place == i],
            phase=i / number if rolling_shutter else 0.0,
            bearing=float(2 * np.pi * ((i + 0.5) / number - 0.5)),
            half_width=np.pi / number,
        )
        for i in np.unique(place).tolist()
    ]
