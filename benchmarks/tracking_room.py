"""What tracks could give back to the detector at most: recall by predictions, false alarms by free space.

A prediction can only help where a vehicle has no detection of any score and a track that expects it. Free
space of other sweeps can only remove a standing box that their beams went through.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

import jaxbox
from jaxbox import Motion
from jaxbox.evaluation.iou import pairwise_overlaps
from jaxbox.evaluation.tracking import FrameTruth
from jaxbox.geometry.rigid import relative_rigid
from jaxbox.run.tracking import TrackedSweep
from jaxbox.tracking import Sight

MIN_IOU = 0.5
"""Of a box in the bird's-eye view that finds a vehicle at all."""
TOUCHING_IOU = 0.3
"""A box that overlaps no true one by as much is a false alarm."""
OTHER_SWEEPS = 20
"""Sweeps before and after that look at a place, 2 s each way."""
NEAREST_M, FARTHEST_M = 4.0, 45.0
"""Range from which other sweeps look: too near it fills the view, and far away beams miss a car."""
FRONT_MARGIN_M, BACK_MARGIN_M = 0.3, 0.5
"""A return this far before a box hides it, and one this far behind it shows that it is not there."""
SEEN_THROUGH = 0.5
"""Share of beams through a box above which it is taken to be no vehicle."""
HALF_VIEW_RAD = np.radians(38)
"""Half the horizontal view of KITTI's camera 2, rounded down: beyond it there are no labels."""


def count_predictions(frames: Sequence[FrameTruth], tracked: Sequence[TrackedSweep]) -> dict[str, int]:
    """True vehicles, how many of them some detection finds, and how many only a track expects.

    Args:
      frames: the truth of each sweep.
      tracked: the sweeps, online.

    Returns:
      The three counts over all sweeps.
    """
    counts = {"vehicles": 0, "detected": 0, "only predicted": 0}
    for frame, sweep in zip(frames, tracked, strict=True):
        found, tracks = sweep.detections, sweep.tracks
        if found is None or tracks is None:
            continue
        true = np.asarray(frame.boxes, float)[frame.counts]
        detected = _is_covered(true, _boxes(found.center, found.size, found.yaw, found.valid))
        unseen = tracks.valid & (tracks.sight != Sight.SEEN)
        expected = _is_covered(
            true, _boxes(tracks.filtered_center, tracks.filtered_size, tracks.filtered_yaw, unseen)
        )
        counts["vehicles"] += len(true)
        counts["detected"] += int(detected.sum())
        counts["only predicted"] += int((expected & ~detected).sum())
    return counts


def count_seen_through(
    frames: Sequence[FrameTruth], tracked: Sequence[TrackedSweep], smoothed: Sequence[TrackedSweep]
) -> dict[str, int]:
    """Boxes of standing tracks in front of the sensor, false and true, and those other sweeps saw through.

    Args:
      frames: the truth of each sweep.
      tracked: the sweeps, online; their first returns are read.
      smoothed: the same after the second pass, whose boxes are judged.

    Returns:
      The four counts over all sweeps.
    """
    counts = {"false": 0, "false seen through": 0, "true": 0, "true seen through": 0}
    for index, frame in enumerate(frames):
        boxes = _standing_boxes(smoothed[index].tracks)
        is_true = _is_covered(boxes, np.asarray(frame.boxes, float), TOUCHING_IOU)
        for box, of_vehicle in zip(boxes, is_true, strict=True):
            kind = "true" if of_vehicle else "false"
            shares = list(_shares_through(box, index, tracked))
            counts[kind] += 1
            counts[f"{kind} seen through"] += bool(shares) and bool(np.mean(shares) > SEEN_THROUGH)
    return counts


def _boxes(center: Any, size: Any, yaw: Any, chosen: Any) -> np.ndarray:
    return np.column_stack([center, size, yaw])[np.asarray(chosen)].astype(float)


def _is_covered(boxes: np.ndarray, others: np.ndarray, min_iou: float = MIN_IOU) -> np.ndarray:
    """(A,) bool: whether a box overlaps one of the others in the bird's-eye view."""
    if not len(boxes):
        return np.zeros(0, bool)
    bird, _ = pairwise_overlaps(boxes, others)
    return bird.max(axis=1, initial=0) >= min_iou


def _standing_boxes(tracks: Any) -> np.ndarray:
    """(A, 7) boxes that are shown, stand, and are where labels are."""
    boxes = np.column_stack([tracks.center, tracks.size, tracks.heading]).astype(float)
    shown = np.asarray(tracks.score) >= jaxbox.DEFAULT_SCORE_THRESHOLD
    shown &= np.asarray(tracks.motion) == Motion.STANDING
    shown &= np.abs(np.arctan2(boxes[:, 1], boxes[:, 0])) < HALF_VIEW_RAD
    return boxes[shown]


def _shares_through(box: np.ndarray, index: int, tracked: Sequence[TrackedSweep]) -> Iterator[float]:
    """For each other sweep that looks at a place, the share of its beams there that go on beyond."""
    T_world_sensor = tracked[index].T_world_sensor
    assert T_world_sensor is not None
    for other in tracked[max(0, index - OTHER_SWEEPS) : index + OTHER_SWEEPS + 1]:
        if other is tracked[index] or other.detections is None or other.T_world_sensor is None:
            continue
        T_other_sensor = relative_rigid(other.T_world_sensor, T_world_sensor)
        there = _moved(box, T_other_sensor)
        if NEAREST_M < np.hypot(*there[:2]) < FARTHEST_M:
            share = share_through(there, np.asarray(other.detections.first_return_m))
            if share is not None:
                yield share


def _moved(box: np.ndarray, transform: np.ndarray) -> np.ndarray:
    """A (7,) box in another frame."""
    center = transform[:3, :3] @ box[:3] + transform[:3, 3]
    yaw = box[6] + np.arctan2(transform[1, 0], transform[0, 0])
    return np.concatenate([center, box[3:6], [yaw]])


def share_through(box: np.ndarray, first_return_m: np.ndarray) -> float | None:
    """Share of the azimuths over a box whose first return lies behind it.

    Args:
      box: (7,) m and rad, in the sensor's frame: centre, size, yaw.
      first_return_m: (A,) m, of azimuth cells from -pi on.

    Returns:
      The share of those that nothing hides; None where all of it is hidden.
    """
    cos, sin = np.cos(box[6]), np.sin(box[6])
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
    corners = signs * box[3:5] @ np.array([[cos, sin], [-sin, cos]]) + box[:2]
    middle = np.arctan2(box[1], box[0])
    aside = (np.arctan2(corners[:, 1], corners[:, 0]) - middle + np.pi) % (2 * np.pi) - np.pi
    cells_per_rad = len(first_return_m) / (2 * np.pi)
    ends = (middle + np.array([aside.min(), aside.max()]) + np.pi) * cells_per_rad
    cells = np.arange(int(np.floor(ends[0])), int(np.floor(ends[1])) + 1) % len(first_return_m)
    distance, first = np.hypot(*corners.T), first_return_m[cells]
    looked = first > distance.min() - FRONT_MARGIN_M
    return float((first > distance.max() + BACK_MARGIN_M).sum() / looked.sum()) if looked.any() else None
