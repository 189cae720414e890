"""KITTI's tracking protocol: which labels count, and which results are neither right nor wrong.

- Labels of the class count unless they are largely hidden (occlusion beyond 2) or cut off by the image's
  border (truncation beyond 0). Those, and labels of the neighbouring class, are distractors.
- Labels and results are first matched at an overlap of .5. A result matched to a distractor is removed. So
  is one that matches nothing and is at most 25 px high, or for more than half in one DontCare region.

Reference: Geiger, Lenz, Urtasun, CVPR 2012, and the tracking development kit; the oracle is trackeval.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from jaxbox.evaluation.boxes import image_boxes
from jaxbox.evaluation.iou import image_fractions, image_iou
from jaxbox.evaluation.tracking.comparison import EPSILON, Comparison, assign_above
from jaxbox.io import KittiObject

MAX_OCCLUSION, MAX_TRUNCATION = 2, 0
"""Limits of the labels that count, from the development kit."""

MAX_EXCUSED_HEIGHT_PX = 25
MAX_DONT_CARE = 0.5
"""Results up to this height, or beyond this fraction in a DontCare region, may be of unlabelled objects."""

REMOVAL_OVERLAP = 0.5
"""Overlap from which a result is that of a distractor."""

DISTRACTORS: Mapping[str, tuple[str, ...]] = {"Car": ("Van",), "Pedestrian": ("Person", "Person_sitting")}
"""The classes that are evaluated, and those too alike to call their detection wrong."""


def counts_by_limits(item: KittiObject) -> bool:
    """Whether a label of the class counts: neither largely hidden nor cut off.

    Args:
      item: a label.
    """
    # Truncation is a whole number in tracking labels, and read as one.
    return item.occlusion <= MAX_OCCLUSION and int(item.truncation) <= MAX_TRUNCATION


def compare_in_image(
    labels: Sequence[Sequence[KittiObject]],
    results: Sequence[Sequence[KittiObject]],
    *,
    class_name: str = "Car",
) -> Comparison:
    """Applies KITTI's protocol to the 2D boxes of one sequence.

    Args:
      labels: ground truth of each of T frames.
      results: of each of these frames, with identities.
      class_name: one of `DISTRACTORS`.

    Returns:
      What the metrics look at.

    Raises:
      ValueError: for another class, or an identity twice in one frame.
    """
    if class_name not in DISTRACTORS:
        raise ValueError(f"class {class_name!r} has no tracking protocol; choose from {list(DISTRACTORS)}.")
    true_ids, ids, overlaps = [], [], []
    for labels_here, results_here in zip(labels, results, strict=True):
        regions = image_boxes([item for item in labels_here if item.is_dont_care])
        roles = [(item, role) for item in labels_here if (role := _role(item, class_name)) is not None]
        here, counts = [item for item, _ in roles], np.array([role for _, role in roles], bool)
        found = [item for item in results_here if item.type.lower() == class_name.lower() and _has_id(item)]
        boxes = image_boxes(found)
        overlap = image_iou(image_boxes(here), boxes)
        kept = kept_results(overlap, counts, is_excused(boxes, regions))
        true_ids.append(_ids(here)[counts])
        ids.append(_ids(found)[kept])
        overlaps.append(overlap[counts][:, kept])
    return Comparison.of(true_ids, ids, overlaps)


def _role(item: KittiObject, class_name: str) -> bool | None:
    """Whether a label counts or is a distractor; None for what is neither."""
    if not _has_id(item):
        return None
    if item.type.lower() == class_name.lower():
        return counts_by_limits(item)
    return False if item.type.lower() in map(str.lower, DISTRACTORS[class_name]) else None


def _has_id(item: KittiObject) -> bool:
    return item.track_id is not None and item.track_id >= 0


def _ids(objects: Sequence[KittiObject]) -> np.ndarray:
    return np.array([item.track_id for item in objects], int)


def is_excused(boxes_px: np.ndarray, regions_px: np.ndarray) -> np.ndarray:
    """Which results may be of objects that nobody labelled.

    Args:
      boxes_px: (B, 4) px: left, top, right, bottom; empty for what is not in the image.
      regions_px: (R, 4), likewise: DontCare regions of the frame.

    Returns:
      (B,) bool: too low in the image, or for the most part within one region.

    >>> is_excused(np.array([[0, 0, 9, 25], [0, 0, 9, 26]]), np.zeros((0, 4))).tolist()
    [True, False]
    """
    covered = image_fractions(boxes_px, regions_px).max(axis=1, initial=0)
    too_low = boxes_px[:, 3] - boxes_px[:, 1] <= MAX_EXCUSED_HEIGHT_PX + EPSILON
    return too_low | (covered > MAX_DONT_CARE + EPSILON)


def kept_results(overlap: np.ndarray, counts: np.ndarray, excused: np.ndarray) -> np.ndarray:
    """Which results of a frame are right or wrong.

    Args:
      overlap: (A, B) in [0, 1].
      counts: (A,) bool: labels that count; the others are distractors.
      excused: (B,) bool: results that are not wrong where they match nothing.

    Returns:
      (B,) bool: not matched to a distractor, and matched or not excused.

    >>> kept_results(np.array([[0.9, 0.0]]), np.array([False]), np.array([False, False])).tolist()
    [False, True]
    """
    kept = ~excused
    if overlap.size:
        rows, columns = assign_above(overlap, REMOVAL_OVERLAP)
        kept[columns] = counts[rows]
    return kept
