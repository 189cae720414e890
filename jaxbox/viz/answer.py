"""The answer for one sweep from above: boxes, hulls, and the points, or what the answer knows of them."""

import math

import numpy as np

from jaxbox.types import Detections
from jaxbox.viz.bird_eye import BirdEyeFrame, draw_bird_eye
from jaxbox.viz.boxes import BoxSet
from jaxbox.viz.colors import UNASSIGNED, color_by_height
from jaxbox.viz.stages import height_above_plane, hull_polygons


def draw_detections(
    detections: Detections,
    xyz: np.ndarray | None = None,
    *,
    frame: BirdEyeFrame | None = None,
    title: str = "",
) -> np.ndarray:
    """Draws the boxes of one sweep and the hulls of their points from above.

    Args:
      detections: of one sweep; choose boxes by `Detections.above` and its like.
      xyz: (n, 3 or more) m, the points of the sweep, coloured by their height above the ground; None draws
        the first return at a vehicle's height in each direction, which the detections hold.
      frame: the part of the world; None is 40 m behind to 60 m ahead.
      title: first line of the legend.

    Returns:
      (h, w, 3) uint8, red green blue.
    """
    detections = detections[:]
    if xyz is None:
        points = first_returns(detections)
        colors = np.full(points.shape, UNASSIGNED, np.uint8)
    else:
        points = np.asarray(xyz, np.float64)[:, :3]
        colors = color_by_height(height_above_plane(points, detections))
    boxes, hulls = BoxSet.from_detections(detections), hull_polygons(detections)
    return draw_bird_eye(points, colors=colors, boxes=boxes, hulls=hulls, frame=frame, title=title)


def first_returns(detections: Detections) -> np.ndarray:
    """Where each direction's beams first returned at a vehicle's height.

    Args:
      detections: of one sweep.

    Returns:
      (m, 3) float64, m, at the sensor's height: one a direction that returned; none without evidence.
    """
    range_m = np.asarray(detections.first_return_m, np.float64)
    azimuth = -math.pi + (np.arange(len(range_m)) + 0.5) * 2 * math.pi / max(len(range_m), 1)
    points = np.stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), 0 * range_m], axis=1)
    # Directions without a return hold the end of the grid.
    return points[range_m < range_m.max(initial=0)]
