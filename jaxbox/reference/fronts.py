"""Front and back: a car's bonnet is lower than its rear, and so is a van's nose."""

from collections.abc import Sequence

import numpy as np

from jaxbox.config import Label

MIN_PART_POINTS = 3
"""A part of the box with fewer points has no top."""
HEIGHT_RANGE_M = 1.2, 2.0
"""Tops are shares of the box's height within these."""
PROFILE_SD, MAX_PART_COST = 0.15, 4.0
"""Standard deviation of a top, as a share of the height, and the most that one part counts."""
LOG_ODDS_PER_COST = 0.3
"""Log odds of a unit of cost, as tops of neighbouring parts are not independent."""


def find_fronts(
    xy: Sequence[np.ndarray],
    height: Sequence[np.ndarray],
    boxes: np.ndarray,
    heights: np.ndarray,
    labels: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Where the front of each detection points, and how sure that is.

    Args:
      xy: (n, 2) m, the points of each of k detections.
      height: (n,) m above the ground, of those.
      boxes: (k, 5) m and rad: centre, length, width, yaw.
      heights: (k,) m, of the boxes.
      labels: (k,) int.

    Returns:
      (k,) headings, rad, and (k,) P(front) in [.5, 1].
    """
    yaw, log_odds = boxes[:, 4], np.zeros(len(boxes))
    for row, box in enumerate(boxes):
        tops = profile_tops(xy[row], height[row], box) / np.clip(heights[row], *HEIGHT_RANGE_M)
        log_odds[row] = front_log_odds(tops, np.array(Label(int(labels[row])).front_profile))
    heading = np.angle(np.exp(1j * np.where(log_odds < 0, yaw + np.pi, yaw)))
    return heading, 1 / (1 + np.exp(-np.abs(log_odds)))


def profile_tops(xy: np.ndarray, height: np.ndarray, box: np.ndarray) -> np.ndarray:
    """The highest point in each part of a box, from the end opposite to its yaw on.

    Args:
      xy: (n, 2) m.
      height: (n,) m above the ground.
      box: (5,) m and rad: centre, length, width, yaw.

    Returns:
      (parts,) m above the ground; NaN for parts with too few points.
    """
    num = len(Label.CAR.front_profile)
    along = (xy - box[:2]) @ [np.cos(box[4]), np.sin(box[4])]
    part = np.clip(np.floor((along / box[2] + 0.5) * num), 0, num - 1)
    tops = np.full(num, np.nan)
    for index in range(num):
        if np.sum(part == index) >= MIN_PART_POINTS:
            tops[index] = height[part == index].max()
    return tops


def front_log_odds(tops: np.ndarray, profile: np.ndarray) -> float:
    """How much rather the front is where the box's yaw points than opposite.

    Args:
      tops: (parts,) shares of the height; NaN where unknown.
      profile: (parts,) of the class.

    Returns:
      Log odds; 0 where nothing is known.
    """
    costs = [np.minimum(((tops - one) / PROFILE_SD) ** 2, MAX_PART_COST) for one in (profile, profile[::-1])]
    ahead, back = np.nansum(costs, axis=1)
    return float(LOG_ODDS_PER_COST * (back - ahead))
