"""Boxes projected into the camera image (paper, 3.6 and figure 11)."""

import dataclasses
from collections.abc import Sequence

import cv2
import jax.numpy as jnp
import numpy as np

from jaxbox.types import Calibration
from jaxbox.viz.boxes import BoxGroup, BoxSet
from jaxbox.viz.canvas import draw_legend, draw_segments, draw_text
from jaxbox.viz.perspective import cut_segments, project, transform
from jaxbox.viz.verdict import group_boxes, legend_entries


def draw_image_boxes(
    image: np.ndarray,
    calibration: Calibration,
    *,
    boxes: BoxSet | None = None,
    truth: BoxSet | None = None,
    judged: np.ndarray | None = None,
    groups: Sequence[BoxGroup] | None = None,
    title: str = "",
    legend: bool = True,
) -> np.ndarray:
    """Draws the edges of 3D boxes on an image; edges are cut where they pass behind the camera.

    Args:
      image: (h, w, 3) uint8, red green blue; not changed.
      calibration: of the camera that took it.
      boxes: estimates, sensor frame.
      truth: true boxes, sensor frame.
      judged: (K,) bool: estimates that the truth covers; None is all.
      groups: boxes with colours of their own, drawn in this order, in place of the last three.
      title: first line of the legend.
      legend: whether the groups are explained.

    Returns:
      (h, w, 3) uint8: a copy of the image with the boxes.
    """
    picture = np.ascontiguousarray(image).copy()
    if groups is None:
        groups = group_boxes(boxes, truth, judged)
    seen = [_draw_group(picture, calibration, group) for group in groups]
    draw_legend(picture, legend_entries(seen) if legend else [], title=title)
    return picture


def scale_camera(
    image: np.ndarray, calibration: Calibration, *, width_px: int
) -> tuple[np.ndarray, Calibration]:
    """An image of another width, and the camera that would have taken it.

    Drawn on after scaling, lines and captions are the same at any size.

    Args:
      image: (h, w, 3) uint8.
      calibration: of the camera that took it.
      width_px: width of the image that is wanted.

    Returns:
      The image, of the same proportions, and the camera.
    """
    height, width = image.shape[:2]
    scale = width_px / width
    scaled = cv2.resize(image, (width_px, round(height * scale)), interpolation=cv2.INTER_AREA)
    projection = jnp.diag(jnp.array([scale, scale, 1.0])) @ calibration.P_rect
    return scaled, dataclasses.replace(calibration, P_rect=projection)


def _draw_group(picture: np.ndarray, calibration: Calibration, group: BoxGroup) -> BoxGroup:
    """Draws boxes, far ones first, and returns those with an edge in the picture."""
    projection = np.asarray(calibration.P_rect, np.float64)
    segments = transform(group.boxes.segments(), np.asarray(calibration.T_rect_velo, np.float64))
    seen = np.zeros(len(segments), bool)
    for row in np.argsort(-segments[..., 2].mean(axis=(1, 2)), kind="stable"):
        uv = project(cut_segments(segments[row]), projection)
        seen[row] = _meets_picture(uv, picture)
        if seen[row]:
            draw_segments(picture, uv, group.color, thickness_px=group.thickness_px)
            if group.boxes.captions:
                _draw_caption(picture, uv, group, row)
    return dataclasses.replace(group, boxes=group.boxes.take(seen))


def _meets_picture(uv: np.ndarray, picture: np.ndarray) -> bool:
    """Whether the rectangle round the edges overlaps the picture."""
    if len(uv) == 0:
        return False
    low, high = uv.min(axis=(0, 1)), uv.max(axis=(0, 1))
    height, width = picture.shape[:2]
    return bool(high[0] > 0 and high[1] > 0 and low[0] < width and low[1] < height)


def _draw_caption(picture: np.ndarray, uv: np.ndarray, group: BoxGroup, row: int) -> None:
    left, top = uv.min(axis=(0, 1))
    bottom = min(uv[..., 1].max() + 14, picture.shape[0] - 4)
    position = max(left, 2.0), bottom if group.caption_below else max(top - 4, 12.0)
    draw_text(picture, group.boxes.captions[row], position, group.color, scale=0.45)
