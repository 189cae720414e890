"""Boxes projected into the camera image (paper, 3.6 and figure 11)."""

import numpy as np

from jaxbox.types import Calibration
from jaxbox.viz.boxes import BoxSet
from jaxbox.viz.canvas import draw_legend, draw_segments, draw_text
from jaxbox.viz.colors import Color
from jaxbox.viz.perspective import cut_segments, project, transform
from jaxbox.viz.verdict import choose_colors, legend_entries


def draw_image_boxes(
    image: np.ndarray,
    calibration: Calibration,
    *,
    boxes: BoxSet,
    truth: BoxSet | None = None,
    judged: np.ndarray | None = None,
    title: str = "",
) -> np.ndarray:
    """Draws the edges of 3D boxes on an image; edges are cut where they pass behind the camera.

    Args:
      image: (h, w, 3) uint8, red green blue; not changed.
      calibration: of the camera that took it.
      boxes: estimates, sensor frame.
      truth: true boxes, sensor frame.
      judged: (K,) bool: estimates that the truth covers; None is all.
      title: first line of the legend.

    Returns:
      (h, w, 3) uint8: a copy of the image with the boxes.
    """
    picture = np.ascontiguousarray(image).copy()
    box_colors, truth_colors = choose_colors(boxes, truth, judged)
    seen = _draw_set(picture, calibration, boxes, box_colors, thickness_px=2)
    seen_truth: list[Color] = []
    if truth is not None:
        seen_truth = _draw_set(picture, calibration, truth, truth_colors, thickness_px=1)
    draw_legend(picture, legend_entries(seen, seen_truth), title=title)
    return picture


def _draw_set(
    picture: np.ndarray, calibration: Calibration, boxes: BoxSet, colors: list[Color], *, thickness_px: int
) -> list[Color]:
    """Draws boxes, far ones first, and returns the colours of those with an edge in the picture."""
    projection = np.asarray(calibration.P_rect, np.float64)
    segments = transform(boxes.segments(), np.asarray(calibration.T_rect_velo, np.float64))
    shown = []
    for row in np.argsort(-segments[..., 2].mean(axis=(1, 2)), kind="stable"):
        uv = project(cut_segments(segments[row]), projection)
        if _meets_picture(uv, picture):
            shown.append(colors[row])
            draw_segments(picture, uv, colors[row], thickness_px=thickness_px)
            if boxes.captions:
                _draw_caption(picture, uv, boxes.captions[row], colors[row])
    return shown


def _meets_picture(uv: np.ndarray, picture: np.ndarray) -> bool:
    """Whether the rectangle round the edges overlaps the picture."""
    if len(uv) == 0:
        return False
    low, high = uv.min(axis=(0, 1)), uv.max(axis=(0, 1))
    height, width = picture.shape[:2]
    return bool(high[0] > 0 and high[1] > 0 and low[0] < width and low[1] < height)


def _draw_caption(picture: np.ndarray, uv: np.ndarray, caption: str, color: Color) -> None:
    left, top = uv.min(axis=(0, 1))
    draw_text(picture, caption, (max(left, 2.0), max(top - 4, 12.0)), color, scale=0.45)
