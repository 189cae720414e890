"""Vehicles that stand in a row, side by side or nose to tail: what is round one is of its neighbours."""

from collections.abc import Iterable

import numpy as np

from jaxbox.config import ClassPrior, CompletionConfig, VehicleConfig
from jaxbox.reference.state import Assignment, RayFractions
from jaxbox.reference.surroundings import in_box_frame

NARROWEST, WIDEST = 0.8, 1.15
"""Share of the class's width that the visible end of a vehicle has."""
NEAREST = 1.1
"""Two ends that are nearer than this share of the width are readings of one vehicle."""
MAX_SINE = 0.2
"""Sine of the largest angle between vehicles side by side."""
NEAREST_LENGTHS = 0.95
"""Two boxes in a line whose middles are fewer lengths apart are readings of one vehicle."""
MAX_ASIDE_M, MAX_LINE_SINE = 0.35, 0.12
"""How far a vehicle in a line stands to the side of the next, and the sine of the angle between them."""
MIN_EARLY = 0.3
"""What scores less by rays and size makes no line."""
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
        found[row] = _in_three((np.sign(left) * places)[counts])
    return found


def find_lines(boxes: np.ndarray, early: np.ndarray, config: VehicleConfig) -> np.ndarray:
    """Which boxes are in a line of three or more vehicles nose to tail.

    Args:
      boxes: (n, 5) x, y, length, width in m and yaw in rad.
      early: (n,) scores by rays and size.
      config: how many lengths apart neighbours stand.

    Returns:
      (n,) bool: between two neighbours, or before one that has another one before it.
    """
    found = np.zeros(len(boxes), bool)
    may_be = np.flatnonzero(early > MIN_EARLY)
    others = boxes[may_be]
    for row in may_be:
        ahead, aside = in_box_frame(others[:, :2], boxes[row]).T
        lengths = ahead / ((others[:, 2] + boxes[row, 2]) / 2)
        turned = np.sin(others[:, 4] - boxes[row, 4])
        aligned = (np.abs(aside) < MAX_ASIDE_M) & (np.abs(turned) < MAX_LINE_SINE)
        first, second = (
            aligned & (np.abs(lengths) > n * NEAREST_LENGTHS) & (np.abs(lengths) < n * config.line_lengths)
            for n in (1, 2)
        )
        places = np.sign(lengths) * np.where(first, 1, 2)
        found[row] = _in_three(places[first | second])
    return found


def _in_three(places: Iterable[float]) -> bool:
    """Whether neighbours at places 1 and 2 on one side, -1 and -2 on the other, make a third of three."""
    where = set(places)
    return any(two <= where for two in ({-1, 1}, {1, 2}, {-1, -2}))


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
