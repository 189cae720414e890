"""Convex hull (paper, 3.3), and the points that rectangles are fitted to."""

from collections.abc import Sequence

import cv2
import numpy as np

from jaxbox.config import BoxConfig, DetectorConfig
from jaxbox.reference.clustering import sampled_share, sampling_rank
from jaxbox.reference.state import Cluster, Obstacles


def outline_clusters(
    obstacles: Obstacles, clusters: Sequence[Cluster], config: DetectorConfig
) -> list[np.ndarray]:
    """The points of each cluster that its rectangle is fitted to: its hull (the paper), or those of the slab.

    Args:
      obstacles: m points.
      clusters: of the points.
      config: of the detector.

    Returns:
      (j, 2) m of each cluster.
    """
    if config.box.fit_to == "hull":
        return convex_hulls([obstacles.xyz[cluster.members, :2] for cluster in clusters])
    points = obstacles.xyz, obstacles.height
    chosen = (fit_points(cluster.members, *points, config.box) for cluster in clusters)
    return [obstacles.xyz[rows, :2] for rows in chosen]


def fit_points(members: np.ndarray, xyz: np.ndarray, height: np.ndarray, config: BoxConfig) -> np.ndarray:
    """The members of a cluster that its rectangle is fitted to.

    Args:
      members: (m,) int, rows of the cluster's points in sweep order.
      xyz: (n, 3) m, sensor frame, of all points.
      height: (n,) m above the ground, likewise.
      config: members between the slab's heights, both exclusive, are taken, unless they are too few, or too
        small a share of all: then all are. Of more than .9 `max_points` those of the lowest ranks, see
        `sampling_rank`, and of these, where they are more than `max_points`, as many spread evenly: the
        floor(j count / max_points)-th.

    Returns:
      (k,) int, k <= max_points.
    """
    chosen = sampled_points(members, xyz, height, config)
    if len(chosen) <= config.max_points:
        return chosen
    return chosen[np.arange(config.max_points) * len(chosen) // config.max_points]


def sampled_points(members: np.ndarray, xyz: np.ndarray, height: np.ndarray, config: BoxConfig) -> np.ndarray:
    """The members of the lowest ranks, as `fit_points` before it spreads what are still too many."""
    slab = members[
        (height[members] > config.slab_min_height_m) & (height[members] < config.slab_max_height_m)
    ]
    least = max(float(config.min_slab_points), np.float32(config.min_slab_share) * np.float32(len(members)))
    chosen = slab if len(slab) >= least else members
    return chosen[sampling_rank(xyz[chosen]) < sampled_share(len(chosen), config.max_points)]


def convex_hulls(clusters: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Vertices of the convex hulls of clusters, see `convex_hull`.

    Args:
      clusters: (n, 2) m each.

    Returns:
      (h, 2) m each.
    """
    return [convex_hull(xy) for xy in clusters]


def convex_hull(xy: np.ndarray) -> np.ndarray:
    """Vertices of the convex hull.

    Args:
      xy: (n, 2) m; rounded to float32.

    Returns:
      (h, 2) m, counter-clockwise; (0, 2) without points, one or two points where all are in line.
    """
    if len(xy) == 0:
        return np.zeros((0, 2))
    index = cv2.convexHull(np.ascontiguousarray(xy, np.float32), returnPoints=False).reshape(-1).astype(int)
    hull = np.asarray(xy, np.float64)[index]
    return hull if polygon_area(hull) >= 0 else hull[::-1]


def polygon_area(polygon: np.ndarray) -> float:
    """Area of a polygon, positive where it turns counter-clockwise.

    Args:
      polygon: (h, 2) m.

    Returns:
      m^2.
    """
    if len(polygon) == 0:
        return 0.0
    x, y = (polygon - polygon[0]).T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2)
