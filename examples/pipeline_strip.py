"""Draws the six pictures of the README: what each stage of the detector leaves behind.

    python examples/pipeline_strip.py docs/pipeline.png

The sweep is synthetic, so that the picture can be published under the project's own licence: KITTI's
(CC BY-NC-SA 3.0) would not allow that. Needs the extra ``reference``, whose evidence grid is drawn.
"""

import argparse
from collections.abc import Sequence

import cv2
import numpy as np

import jaxbox
from jaxbox import Detections, DetectorConfig, PointCloud, reference, synthetic
from jaxbox.viz import BirdEyeFrame, BoxSet, color_by_height, color_by_id
from jaxbox.viz.canvas import blank, draw_points, draw_polygon, draw_text
from jaxbox.viz.colors import ESTIMATE, HULL, INK, TRUTH, Color
from jaxbox.viz.stages import hull_polygons

FRAME = BirdEyeFrame(x_range_m=(-1.0, 37.0), y_range_m=(-9.8, 11.2), width_px=500)
"""The road ahead of the sensor: here each stage has something to show."""
COLUMNS = 3
GAP_PX = 8
CAPTION_PX = 52
"""Height of the two lines below each picture."""
CAPTION_SCALE = 0.66
"""Size of the letters: still legible where the strip is shown 900 pixels wide."""
GROUND: Color = (58, 63, 72)
GREY: Color = (120, 128, 140)
SECTION: Color = (160, 168, 180)
RECTANGLE = INK
FREE: Color = (28, 62, 92)
"""Cells that a beam passed through at the height of a car."""
MIN_TRUTH_POINTS = 10
"""Vehicles with fewer points are not drawn as truth: the detector promises nothing for them."""


def draw_strip(seed: int = 0) -> np.ndarray:
    """Detects the vehicles of a synthetic sweep and draws the stages side by side.

    Args:
      seed: of the sweep.

    Returns:
      (h, w, 3) uint8, red green blue: three pictures in each of two rows.
    """
    sweep = synthetic.make_sweep(seed)
    cloud = PointCloud.from_numpy(sweep.xyz, sweep.intensity)
    detections = jaxbox.detect(cloud).on_host()
    size = len(sweep.xyz)
    xyz = sweep.xyz.astype(np.float64)
    above = ~detections.ground_mask[:size]
    component = detections.point_component[:size]
    height = height_above_plane(xyz, detections)
    by_height, by_cluster = color_by_height(height), color_by_id(component)
    shown = BoxSet.from_detections(detections, min_score=jaxbox.DEFAULT_SCORE_THRESHOLD)
    hulls = hull_polygons(detections, min_score=jaxbox.DEFAULT_SCORE_THRESHOLD)
    measured = [extents_along(hull, yaw) for hull, yaw in zip(hulls, shown.yaw, strict=True)]
    grey = np.where(above[:, None], np.array(GREY), np.array(GROUND)).astype(np.uint8)
    without_ground = np.where(above[:, None], by_height, np.array(GROUND, np.uint8))
    clusters = np.where((component >= 0)[:, None], by_cluster, np.array(GROUND, np.uint8))

    pictures = []
    for colors in (by_height, without_ground, clusters):
        pictures.append(draw_view(xyz, colors))
    pictures.append(draw_view(xyz, grey, [(measured, RECTANGLE, 1), (hulls, HULL, 1)]))
    boxes = list(shown.footprints())
    free = free_space(xyz, height, detections)
    pictures.append(
        draw_view(xyz[above], grey[above], [(boxes, ESTIMATE, 2), (measured, RECTANGLE, 1)], free)
    )
    pictures.append(draw_view(xyz, grey, [(true_outlines(sweep), TRUTH, 1), (boxes, ESTIMATE, 2)]))
    return join([add_caption(*pair) for pair in zip(pictures, CAPTIONS, strict=True)])


CAPTIONS = (
    ("1  Points, by height", "statistical filtering: 3.1"),
    ("2  Ground removed", "RANSAC and ground grid: 3.1, Algorithm I"),
    ("3  Clusters", "connected components: 3.2, Algorithm II"),
    ("4  Hulls (blue), rectangles (white)", "best of all rotations: 3.3, 3.4, Algorithm III"),
    ("5  Free space (blue), completed boxes", "correction for occluded objects"),
    ("6  Boxes (yellow), the truth (green)", "scores, suppression, projection: 3.5, 3.6"),
)
"""What is seen, and the section of the paper that it belongs to."""


def height_above_plane(xyz: np.ndarray, detections: Detections) -> np.ndarray:
    """(n,) m above the fitted ground plane."""
    a, b, c = np.asarray(detections.ground.coefficients, np.float64)
    return xyz[:, 2] - (a * xyz[:, 0] + b * xyz[:, 1] + c)


def extents_along(hull: np.ndarray, yaw: float) -> np.ndarray:
    """(4, 2) corners of the smallest rectangle at a rotation that holds a hull (h, 2)."""
    along = np.array([np.cos(yaw), np.sin(yaw)])
    axes = np.stack([along, [-along[1], along[0]]])
    low, high = (hull @ axes.T).min(axis=0), (hull @ axes.T).max(axis=0)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return corners @ axes


def free_space(xyz: np.ndarray, height: np.ndarray, detections: Detections) -> np.ndarray:
    """(h, w) bool: the pixels of `FRAME` through which some beam passed at the height of a car."""
    config = DetectorConfig().evidence
    plane = np.asarray(detections.ground.coefficients, float)
    evidence = reference.build_evidence(
        xyz, height, -plane[2], lambda xyz: reference.plane_elevation(xyz, plane), config
    )
    is_free = np.diff(evidence.free_sums, axis=1) > 0
    rows, columns = np.indices(FRAME.shape) + 0.5
    x = FRAME.x_range_m[0] + columns / FRAME.px_per_m
    y = FRAME.y_range_m[1] - rows / FRAME.px_per_m
    azimuth = reference.azimuth_cell(np.arctan2(y, x), config.num_azimuths)
    return is_free[azimuth, (np.hypot(x, y) / config.range_cell_m).astype(int)]


def true_outlines(sweep: synthetic.SyntheticSweep) -> list[np.ndarray]:
    """Footprints of the vehicles that hold enough points to be found."""
    truth = sweep.boxes
    boxes = BoxSet(center=truth.center, size=truth.size, yaw=truth.yaw)
    return list(boxes.take(truth.num_points >= MIN_TRUTH_POINTS).footprints())


def draw_view(
    xyz: np.ndarray,
    colors: np.ndarray,
    outlines: Sequence[tuple[Sequence[np.ndarray], Color, int]] = (),
    free: np.ndarray | None = None,
) -> np.ndarray:
    """Draws points (n, 3) from above, then groups of outlines (h, 2), each with its colour and width."""
    height_px, width_px = FRAME.shape
    picture = blank(width_px=width_px, height_px=height_px)
    if free is not None:
        picture[free] = FREE
    # Higher points are drawn last, so that a roof covers the road.
    order = np.argsort(xyz[:, 2], kind="stable")
    draw_points(picture, FRAME.to_pixels(xyz[order]), colors[order])
    for polygons, color, thickness_px in outlines:
        for polygon in polygons:
            draw_polygon(picture, FRAME.to_pixels(polygon), color, thickness_px=thickness_px)
    return picture


def add_caption(picture: np.ndarray, caption: tuple[str, str]) -> np.ndarray:
    """The picture with two lines of text below it."""
    height_px, width_px = picture.shape[:2]
    whole = np.concatenate([picture, blank(width_px=width_px, height_px=CAPTION_PX)])
    what, where = caption
    draw_text(whole, what, (4, height_px + 20), INK, scale=CAPTION_SCALE)
    draw_text(whole, where, (4, height_px + 43), SECTION, scale=CAPTION_SCALE * 0.86)
    return whole


def join(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """The pictures, which are of one size, in rows of `COLUMNS`."""
    height_px, width_px = pictures[0].shape[:2]
    num_rows = len(pictures) // COLUMNS
    whole = blank(
        width_px=COLUMNS * width_px + (COLUMNS + 1) * GAP_PX,
        height_px=num_rows * height_px + (num_rows + 1) * GAP_PX,
    )
    for number, picture in enumerate(pictures):
        row, column = divmod(number, COLUMNS)
        top, left = GAP_PX + row * (height_px + GAP_PX), GAP_PX + column * (width_px + GAP_PX)
        whole[top : top + height_px, left : left + width_px] = picture
    return whole


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", help="PNG file to write")
    parser.add_argument("--seed", type=int, default=0, help="of the synthetic sweep")
    options = parser.parse_args(arguments)
    picture = draw_strip(options.seed)
    # Packed as tightly as PNG can, since every clone of the repository carries it.
    cv2.imwrite(options.output, picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
