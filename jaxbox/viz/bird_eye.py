"""The bird's-eye view: forward is right, left is up (paper, figures 5 to 10)."""

import dataclasses
import math
from collections.abc import Sequence

import cv2
import numpy as np

from jaxbox.viz.boxes import BoxGroup, BoxSet
from jaxbox.viz.canvas import SHIFT, blank, draw_legend, draw_points, draw_polygon, draw_text
from jaxbox.viz.colors import FAINT, HULL, INK, color_by_height
from jaxbox.viz.verdict import group_boxes, legend_entries

RING_STEP_M = 10.0
SCALE_BAR_M = 10.0
CAPTION_SCALE, CAPTION_PX = 0.4, 8
SENSOR_HEIGHT_M = 1.73
"""Height of the sensor on the KITTI car: colours without a ground plane are measured from there."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BirdEyeFrame:
    """The part of the world in the picture, and its scale.

    >>> BirdEyeFrame().shape
    (720, 1200)
    """

    x_range_m: tuple[float, float] = (-40.0, 60.0)
    """m, forward: left and right border."""
    y_range_m: tuple[float, float] = (-30.0, 30.0)
    """m, to the left: lower and upper border."""
    width_px: int = 1200
    """Width of the picture; the height follows."""

    @property
    def px_per_m(self) -> float:
        """Pixels a metre."""
        return self.width_px / (self.x_range_m[1] - self.x_range_m[0])

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, px."""
        return round((self.y_range_m[1] - self.y_range_m[0]) * self.px_per_m), self.width_px

    def to_pixels(self, xy: np.ndarray) -> np.ndarray:
        """(..., 2 or more) m, sensor frame, to (..., 2) px: column, row."""
        column = (xy[..., 0] - self.x_range_m[0]) * self.px_per_m
        row = (self.y_range_m[1] - xy[..., 1]) * self.px_per_m
        return np.stack([column, row], axis=-1)


def draw_bird_eye(
    xyz: np.ndarray,
    *,
    colors: np.ndarray | None = None,
    boxes: BoxSet | None = None,
    truth: BoxSet | None = None,
    judged: np.ndarray | None = None,
    groups: Sequence[BoxGroup] | None = None,
    hulls: Sequence[np.ndarray] = (),
    frame: BirdEyeFrame | None = None,
    title: str = "",
    legend: bool = True,
) -> np.ndarray:
    """Draws a sweep from above with range rings, scale bar and legend.

    With truth, false alarms and missed boxes are marked by colour: see
    `jaxbox.viz.verdict.group_boxes`.

    Args:
      xyz: (n, 3) real numbers, m, sensor frame; points that are not finite are not drawn.
      colors: (n, 3) uint8; None colours by height over the road of the KITTI car.
      boxes: estimates.
      truth: true boxes.
      judged: (K,) bool: estimates that the truth covers; None is all.
      groups: boxes with colours of their own, drawn in this order, in place of the last three.
      hulls: polygons (h, 2), m, sensor frame.
      frame: the part of the world; None is 40 m behind to 60 m ahead.
      title: first line of the legend.
      legend: whether the groups and directions are explained.

    Returns:
      (h, w, 3) uint8, red green blue.
    """
    frame = frame or BirdEyeFrame()
    xyz = np.asarray(xyz, np.float64)
    if colors is None:
        colors = color_by_height(xyz[:, 2] + SENSOR_HEIGHT_M)
    height_px, width_px = frame.shape
    picture = blank(width_px=width_px, height_px=height_px)
    _draw_rings(picture, frame)
    # Higher points are drawn last, so that a roof covers the road and not the other way round.
    order = np.argsort(np.nan_to_num(xyz[:, 2]), kind="stable")
    draw_points(picture, frame.to_pixels(xyz[order]), colors[order])
    for hull in hulls:
        draw_polygon(picture, frame.to_pixels(np.asarray(hull, np.float64)), HULL, thickness_px=1)
    if groups is None:
        groups = group_boxes(boxes, truth, judged)
    _draw_groups(picture, frame, groups)
    entries = legend_entries(groups)
    if len(hulls):
        entries.append((f"convex hull ({len(hulls)})", HULL))
    _draw_sensor(picture, frame)
    _draw_scale_bar(picture, frame, "; forward is right, left is up" if legend else "")
    draw_legend(picture, entries if legend else [], title=title)
    return picture


def _draw_groups(picture: np.ndarray, frame: BirdEyeFrame, groups: Sequence[BoxGroup]) -> None:
    """All outlines, then all captions on top of them."""
    footprints = [frame.to_pixels(group.boxes.footprints()) for group in groups]
    for group, outlines in zip(groups, footprints, strict=True):
        for corners in outlines:
            draw_polygon(picture, corners, group.color, thickness_px=group.thickness_px)
    for group, outlines in zip(groups, footprints, strict=True):
        for corners, caption in zip(outlines, group.boxes.captions, strict=False):
            row = corners[:, 1].max() + CAPTION_PX if group.caption_below else corners[:, 1].min()
            position = corners[:, 0].max() + 4, row
            draw_text(picture, caption, position, group.color, scale=CAPTION_SCALE)


def _draw_rings(picture: np.ndarray, frame: BirdEyeFrame) -> None:
    center = frame.to_pixels(np.zeros(2))
    fixed = (round(center[0] * 2**SHIFT), round(center[1] * 2**SHIFT))
    farthest = math.hypot(max(map(abs, frame.x_range_m)), max(map(abs, frame.y_range_m)))
    for radius in np.arange(RING_STEP_M, farthest, RING_STEP_M):
        radius_fixed = round(radius * frame.px_per_m * 2**SHIFT)
        cv2.circle(picture, fixed, radius_fixed, FAINT, 1, cv2.LINE_AA, SHIFT)
        draw_text(
            picture,
            f"{radius:.0f} m",
            (center[0] + radius * frame.px_per_m + 3, center[1] - 3),
            FAINT,
            scale=0.4,
        )


def _draw_sensor(picture: np.ndarray, frame: BirdEyeFrame) -> None:
    arrow = np.array([[1.6, 0.0], [-0.9, 0.8], [-0.4, 0.0], [-0.9, -0.8]])
    draw_polygon(picture, frame.to_pixels(arrow), INK)


def _draw_scale_bar(picture: np.ndarray, frame: BirdEyeFrame, note: str) -> None:
    height, _ = picture.shape[:2]
    length = SCALE_BAR_M * frame.px_per_m
    bar = np.array(
        [[16, height - 24], [16, height - 16], [16 + length, height - 16], [16 + length, height - 24]]
    )
    draw_polygon(picture, bar, INK, closed=False)
    draw_text(picture, f"{SCALE_BAR_M:.0f} m{note}", (28 + length, height - 16))
