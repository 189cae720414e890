"""KITTI's objects as arrays: boxes in space and in the image, and what DontCare regions cover of them."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbox.evaluation.iou import framewise_overlaps, image_fractions
from jaxbox.io import KittiObject


def camera_boxes(objects: Sequence[KittiObject]) -> np.ndarray:
    """Boxes of KITTI objects in the rectified camera frame turned to x forward, y left, z up.

    Args:
      objects: n of them; DontCare regions, which have no box, get size 0.

    Returns:
      (n, 7) float64, m and rad: x, y, z of the centre, length, width, height, yaw about z.
    """
    rows = [(*item.location, item.length, item.width, item.height, item.rotation_y) for item in objects]
    columns = np.array(rows, float).reshape(-1, 7)
    right, down, forward = columns[:, :3].T
    size = np.maximum(columns[:, 3:6], 0)
    # The location is the centre of the bottom face, and rotation_y turns clockwise seen from above.
    return np.column_stack([forward, -right, size[:, 2] / 2 - down, size, -columns[:, 6] - np.pi / 2])


def image_boxes(objects: Sequence[KittiObject]) -> np.ndarray:
    """The 2D boxes of objects.

    Args:
      objects: n of them.

    Returns:
      (n, 4) float64, px: left, top, right, bottom.
    """
    return np.array([item.box_px for item in objects], float).reshape(-1, 4)


def excused_in_image(labels: Sequence[KittiObject], detections: Sequence[KittiObject]) -> np.ndarray:
    """How far DontCare regions cover detections in the image.

    Args:
      labels: of a frame.
      detections: n of the same frame.

    Returns:
      (n,) float64: the largest fraction of the 2D box within that of one region.
    """
    regions = image_boxes([label for label in labels if label.is_dont_care])
    return image_fractions(image_boxes(detections), regions).max(axis=1, initial=0)


def excused_from_above(
    pairs: Sequence[tuple[Sequence[KittiObject], Sequence[KittiObject]]],
) -> list[np.ndarray]:
    """How far DontCare regions cover detections from above, as the official evaluator draws them.

    It draws footprints of negative sizes too.

    Args:
      pairs: labels and detections of each frame.

    Returns:
      For each frame (detections,) float64: the largest fraction of the footprint within that of one region.
    """
    boxes = []
    for labels, detections in pairs:
        regions = [
            dataclasses.replace(item, length=abs(item.length), width=abs(item.width))
            for item in labels
            if item.is_dont_care
        ]
        boxes.append((camera_boxes(detections), camera_boxes(regions)))
    fractions = []
    for (found, regions), (iou, _) in zip(boxes, framewise_overlaps(boxes), strict=True):
        areas, region_areas = (part[:, 3] * part[:, 4] for part in (found, regions))
        shared = iou / (1 + iou) * (areas[:, None] + region_areas)
        fractions.append((shared / np.maximum(areas, 1e-9)[:, None]).max(axis=1, initial=0))
    return fractions
