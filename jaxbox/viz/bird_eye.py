"""The bird's-eye view: forward is right, left is up (paper, figures 5 to 10)."""

import dataclasses
import math
from collections.abc import Sequence

import cv2
import numpy as np

from jaxbox.viz.boxes import BoxSet
from jaxbox.viz.canvas import SHIFT, blank, draw_legend, draw_points, draw_polygon, draw_text
from jaxbox.viz.colors import FAINT, HULL, INK, Color, color_by_height
from jaxbox.viz.verdict import choose_colors, legend_entries

RING_STEP_M = 10.0
SCALE_BAR_M = 10.0
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
    hulls: Sequence[np.ndarray] = (),
    frame: BirdEyeFrame | None = None,
    title: str = "",
) -> np.ndarray:
    """Draws a sweep from above with range rings, scale bar and legend.

    With truth, false alarms and missed boxes are marked by colour: see
    `jaxbox.viz.verdict.choose_colors`.

    Args:
      xyz: (n, 3) real numbers, m, sensor frame; not finite points are left out.
      colors: (n, 3) uint8; None colours by height over the road of the KITTI car.
      boxes: estimates.
      truth: true boxes.
      judged: (K,) bool: estimates that the truth covers; None is all.
      hulls: polygons (h, 2), m, sensor frame.
      frame: the part of the world; None is 40 m behind to 60 m ahead.
      title: first line of the legend.

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
    entries = _draw_boxes(picture, frame, boxes, truth, judged)
    if len(hulls):
        entries.append((f"convex hull ({len(hulls)})", HULL))
    _draw_sensor(picture, frame)
    _draw_scale_bar(picture, frame)
    draw_legend(picture, entries, title=title)
    return picture


def _draw_boxes(
    picture: np.ndarray,
    frame: BirdEyeFrame,
    boxes: BoxSet | None,
    truth: BoxSet | None,
    judged: np.ndarray | None,
) -> list[tuple[str, Color]]:
    boxes = boxes or BoxSet(center=np.zeros((0, 3)), size=np.zeros((0, 3)), yaw=np.zeros(0))
    box_colors, truth_colors = choose_colors(boxes, truth, judged)
    footprints = frame.to_pixels(boxes.footprints())
    for corners, color in zip(footprints, box_colors, strict=True):
        draw_polygon(picture, corners, color)
    if truth is not None:
        # On top and thin: a right estimate would hide it.
        for corners, color in zip(frame.to_pixels(truth.footprints()), truth_colors, strict=True):
            draw_polygon(picture, corners, color, thickness_px=1)
    for corners, caption, color in zip(footprints, boxes.captions, box_colors, strict=False):
        draw_text(picture, caption, (corners[:, 0].max() + 4, corners[:, 1].min()), color, scale=0.4)
    return legend_entries(box_colors, truth_colors)


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


def _draw_scale_bar(picture: np.ndarray, frame: BirdEyeFrame) -> None:
    height, _ = picture.shape[:2]
    length = SCALE_BAR_M * frame.px_per_m
    bar = np.array(
        [[16, height - 24], [16, height - 16], [16 + length, height - 16], [16 + length, height - 24]]
    )
    draw_polygon(picture, bar, INK, closed=False)
    draw_text(picture, f"{SCALE_BAR_M:.0f} m; forward is right, left is up", (28 + length, height - 16))
