"""Several readings of one sweep, each turned about the sensor: the best boxes, with the mean scores."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbox.config import DetectorConfig, RegionConfig
from jaxbox.config.capacities import CAPACITIES
from jaxbox.reference.assembly import ReferenceDetections
from jaxbox.reference.rectangles import wrap_yaw
from jaxbox.reference.scoring import non_max_suppression

TURN_DEG = 7.3
"""Each reading is turned so much farther about +z."""

SAME_VEHICLE_M = 1.4
"""Boxes of two readings whose centres are nearer are of one vehicle."""


def turn_sweep(xyz: np.ndarray, angle: float, region: RegionConfig) -> np.ndarray:
    """The points as if the sensor had been turned; NaN for those outside the region.

    Args:
      xyz: (n, 3) m, sensor frame.
      angle: rad, about +z.
      region: what is looked at.

    Returns:
      (n, 3) m.
    """
    within = (np.abs(xyz[:, 0]) < region.half_x_m) & (np.abs(xyz[:, 1]) < region.half_y_m)
    return np.where(within[:, None], xyz, np.nan) @ _rotation(angle).T


def turn_back(detections: ReferenceDetections, angle: float) -> ReferenceDetections:
    """Boxes of a turned reading as they stand in the sweep.

    Args:
      detections: of the turned points.
      angle: rad, that they were turned by.

    Returns:
      The detections with the boxes and hulls turned.
    """
    back = _rotation(angle)
    return dataclasses.replace(
        detections,
        center=detections.center @ back,
        yaw=np.array([wrap_yaw(yaw - angle) for yaw in detections.yaw]),
        heading=(detections.heading - angle + np.pi) % (2 * np.pi) - np.pi,
        hulls=tuple(hull @ back[:2, :2] for hull in detections.hulls),
    )


def merge_readings(found: Sequence[ReferenceDetections], config: DetectorConfig) -> ReferenceDetections:
    """The best boxes of all readings that overlap no better one, with the mean of their scores.

    Args:
      found: of each reading, turned back.
      config: the overlap, and how many boxes are kept at most.

    Returns:
      The boxes as their readings found them; what is said of the sweep is that of the first.
    """
    origin = [(reading, row) for reading, d in enumerate(found) for row in range(len(d.score))]
    parts = [np.column_stack([d.center[:, :2], d.size[:, :2], d.yaw]) for d in found]
    boxes, scores = np.concatenate(parts), np.concatenate([d.score for d in found])
    rows = non_max_suppression(boxes, scores, max_overlap=float(config.vehicles.max_overlap))
    rows_kept = rows[: config.vehicles.max_detections]
    mean = np.array([_mean_score(boxes[row, :2], found) for row in rows_kept])
    by_score = np.argsort(-mean, kind="stable")
    kept, mean = rows_kept[by_score], mean[by_score]
    point_detection = np.full(len(found[0].point_detection), -1)
    # The best box comes last, and has the point.
    for place in reversed(range(len(kept))):
        reading, row = origin[kept[place]]
        point_detection[found[reading].point_detection == row] = place
    of_box = ("center", "size", "yaw", "heading", "front_probability", "label")
    counts = {
        name: tuple(np.max([d.counts[name] for d in found], axis=0).tolist())
        if isinstance(found[0].counts[name], tuple)
        else max(d.counts[name] for d in found)
        for name in (row.count for row in CAPACITIES)
    }
    counts["detections"] = max(counts["detections"], len(rows))
    return dataclasses.replace(
        found[0],
        **{name: np.concatenate([getattr(d, name) for d in found])[kept] for name in of_box},
        score=mean,
        hulls=tuple(found[origin[row][0]].hulls[origin[row][1]] for row in kept),
        descriptors=tuple(found[origin[row][0]].descriptors[origin[row][1]] for row in kept),
        num_points=np.array([(point_detection == place).sum() for place in range(len(kept))], int),
        point_detection=point_detection,
        counts=found[0].counts | counts,
    )


def _mean_score(xy: np.ndarray, found: Sequence[ReferenceDetections]) -> float:
    """The mean over all readings of the best score that each gives a box with this centre, (2,) m."""
    near = [d.score[np.linalg.norm(d.center[:, :2] - xy, axis=1) < SAME_VEHICLE_M] for d in found]
    return float(np.mean([scores.max(initial=0) for scores in near]))


def _rotation(angle: float) -> np.ndarray:
    """(3, 3) that turns +x towards +y."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
