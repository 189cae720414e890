"""The scene's direction: vehicles stand along or across one road, so that their boxes share a yaw."""

from collections.abc import Sequence

import numpy as np

from jaxbox.config import BoxConfig, DetectorConfig
from jaxbox.reference.completion import assign_length_axis, extend_away
from jaxbox.reference.evidence import cast_rays
from jaxbox.reference.scoring import size_score
from jaxbox.reference.state import Cluster, Evidence, Rectangle

VOTE_POINTS, VOTE_EXTENT_M = 150, 6.0
"""A cluster with more points, or longer, has no more say about the scene's direction."""


def scene_preference(
    rectangles: Sequence[Rectangle], clusters: Sequence[Cluster], evidence: Evidence, config: DetectorConfig
) -> np.ndarray:
    """The direction that the first map's rectangles, fitted without a preference, vote for.

    Args:
      rectangles: of the first map's clusters.
      clusters: of the first map.
      evidence: of the sweep.
      config: of the detector.

    Returns:
      (A,) to be added to the curves; zero where no rectangle votes.
    """
    prior = config.vehicles.classes[0]

    def look(rectangle: Rectangle) -> tuple[float, float]:
        """The least free length of the boxes with either side as length, and the best score as a car.

        Infinite and 0 where the class allows neither.
        """
        both = (extend_away(assign_length_axis(rectangle, i), prior, config.completion) for i in (0, 1))
        boxes = np.array([box.box for box in both if box is not None]).reshape(-1, 5)
        rays = cast_rays(evidence, boxes, num_rays=config.completion.num_final_rays)
        by_size = np.array([size_score(box[2:4], prior) for box in boxes])
        score = rays.hit * np.exp(-((rays.free_length / config.vehicles.free_scale) ** 2)) * by_size
        return rays.free_length.min(initial=np.inf), score.max(initial=0)

    extent_m = np.array([rectangle.sides_m.max() for rectangle in rectangles])
    free, score = np.array([look(rectangle) for rectangle in rectangles]).reshape(-1, 2).T
    return count_votes(
        np.array([rectangle.angle for rectangle in rectangles]),
        extent_m,
        np.array([len(cluster.members) for cluster in clusters], int),
        score,
        may_vote(extent_m, free, config.box),
        config.box,
    )


def may_vote(extent_m: np.ndarray, free_length: np.ndarray, config: BoxConfig) -> np.ndarray:
    """Which boxes are long enough, and not seen to be free.

    Args:
      extent_m: (k,) longer measured extent.
      free_length: (k,) share of the box seen to be free.
      config: the gates.

    Returns:
      (k,) bool.
    """
    return (extent_m >= config.direction_min_extent_m) & (free_length <= config.direction_max_free)


def count_votes(
    yaw: np.ndarray,
    extent_m: np.ndarray,
    num_points: np.ndarray,
    score: np.ndarray,
    voting: np.ndarray,
    config: BoxConfig,
) -> np.ndarray:
    """Prefers the direction modulo 90 degrees that most boxes share.

    Args:
      yaw: (k,) rad.
      extent_m: (k,) longer measured extent.
      num_points: (k,) points of the cluster.
      score: (k,) in [0, 1], how much each looks like a car.
      voting: (k,) bool.
      config: A angles, i 90 / A degrees; a vote for d weighs exp(-(d / sigma)^2) at distance d, and so
        does the preference, times its height.

    Returns:
      (A,) to be added to the curves; zero where no box votes.
    """
    num_angles, sigma_deg = config.num_angles, config.direction_sigma_deg
    weight = np.minimum(num_points[voting], VOTE_POINTS) * np.minimum(extent_m[voting], VOTE_EXTENT_M)
    weight = weight * score[voting]
    if not weight.any():
        return np.zeros(num_angles)
    angles = np.arange(num_angles) * 90 / num_angles
    distance = _turn_between_deg(angles[:, None], np.degrees(yaw[voting]))
    direction_deg = angles[np.argmax(np.exp(-((distance / sigma_deg) ** 2)) @ weight)]
    distance = _turn_between_deg(angles, direction_deg)
    return float(config.direction_weight) * np.exp(-((distance / sigma_deg) ** 2))


def _turn_between_deg(first: np.ndarray, second: np.ndarray | float) -> np.ndarray:
    """Signed turn between axes of rectangles, modulo 90 degrees, in [-45, 45)."""
    return (first - second + 45) % 90 - 45
