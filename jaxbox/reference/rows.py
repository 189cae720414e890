"""Vehicles that stand side by side in a row: each hides the sides of the next from the sensor."""

import numpy as np

from jaxbox.config import ClassPrior, CompletionConfig
from jaxbox.reference.state import Assignment, RayFractions

NARROWEST, WIDEST = 0.8, 1.15
"""Share of the class's width that the visible end of a vehicle has."""
NEAREST = 1.1
"""Two ends that are nearer than this share of the width are readings of one vehicle."""
MAX_SINE = 0.2
"""Sine of the largest angle between vehicles side by side."""
MIN_REACHED = 0.05
"""Share of the rays that reaches a box, at the least."""


def visible_end(sides: Assignment, prior: ClassPrior) -> np.ndarray | None:
    """The end of a vehicle that faces the sensor, if a rectangle may be a vehicle seen end on.

    Args:
      sides: as measured.
      prior: of the class.

    Returns:
      (3,) the middle of the end, x and y in m, and the yaw in rad; None where it is not as wide as a vehicle
      or the sensor is beside it.
    """
    low, high = sides.along
    width = sides.measured[1] / float(prior.width_m)
    if not NARROWEST < width < WIDEST or low <= 0 <= high:
        return None
    near, across = min(low, high, key=abs), sum(sides.across) / 2
    cos, sin = np.cos(sides.yaw), np.sin(sides.yaw)
    return np.array([cos * near - sin * across, sin * near + cos * across, sides.yaw])


def find_rows(ends: np.ndarray, width_m: float, config: CompletionConfig) -> np.ndarray:
    """Which ends are in a row of three or more vehicles side by side.

    Args:
      ends: (n, 3), see `visible_end`.
      width_m: of the class.
      config: how far apart neighbours stand, and how much farther or nearer.

    Returns:
      (n,) bool: between two neighbours, or beside one that has another one behind it.
    """
    apart_m, shift_m = float(config.row_distance_m), float(config.row_shift_m)
    found = np.zeros(len(ends), bool)
    for row, (*place, yaw) in enumerate(ends):
        along, left = (
            (ends[:, :2] - place) @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        ).T
        parallel = np.abs(np.sin(ends[:, 2] - yaw)) < MAX_SINE
        places = np.where(np.abs(left) <= apart_m, 1, 2)
        counts = parallel & (np.abs(left) <= 2 * apart_m) & (np.abs(left) > NEAREST * width_m)
        counts &= np.abs(along) <= places * shift_m
        where = set((np.sign(left) * places)[counts])
        found[row] = any(two <= where for two in ({-1, 1}, {1, 2}, {-1, -2}))
    return found


def hit_share(rays: RayFractions, in_row: bool | np.ndarray) -> np.ndarray:
    """The share of rays that hit a box: in a row, of those that its neighbours let through.

    Args:
      rays: fractions (...).
      in_row: whether the boxes are in a row, broadcasts with them.

    Returns:
      (...) in [0, 1].
    """
    reached = np.maximum(1 - rays.occluded, MIN_REACHED)
    return np.where(in_row, np.minimum(rays.hit / reached, 1), rays.hit)
