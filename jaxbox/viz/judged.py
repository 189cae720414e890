"""A labelled frame with what was found, missed and false: in the camera's image and from above."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbox.evaluation.boxes import camera_boxes
from jaxbox.evaluation.iou import pairwise_overlaps
from jaxbox.evaluation.matching import RATE_OVERLAPS, Scene, cut, judge
from jaxbox.io import KittiObject, boxes_from_objects
from jaxbox.io.kitti import VEHICLE_TYPES
from jaxbox.types import Calibration
from jaxbox.viz.bird_eye import SENSOR_HEIGHT_M, BirdEyeFrame, draw_bird_eye
from jaxbox.viz.boxes import BoxGroup, BoxSet
from jaxbox.viz.canvas import blank, draw_legend, draw_polygon, draw_text
from jaxbox.viz.colors import (
    ESTIMATE,
    FALSE_ALARM,
    IGNORED,
    LOOSE,
    MISS,
    TRUTH,
    Color,
    shade_by_height,
)
from jaxbox.viz.image_boxes import draw_image_boxes, scale_camera

FOUND_OVERLAP, TIGHT_OVERLAP = RATE_OVERLAPS
"""A label is found from this bird's-eye IoU on; its box fits from this 3D IoU on, KITTI's limit for cars."""

FOUND, LOOSE_BOX, FALSE, MISSED = "found", "found, loose", "false alarm", "missed"
LABEL, NOT_JUDGED, IGNORED_LABEL = "its label", "not judged", "ignored label"
LEGEND: tuple[tuple[str, Color], ...] = (
    (f"{FOUND}: 3D / BEV IoU", ESTIMATE),
    (f"{LOOSE_BOX}: 3D IoU < {TIGHT_OVERLAP:g}", LOOSE),
    (LABEL, TRUTH),
    (f"{MISSED}: its points, any box there", MISS),
    (f"{FALSE}: its score", FALSE_ALARM),
    ("ignored: other class, too hard, DontCare", IGNORED),
)
"""What the colours and the captions of `draw_judged_frame` mean."""

VIEW_X_M, VIEW_Y_M = (-2.0, 78.0), (-30.0, 30.0)
"""What the view from above shows with a camera: KITTI labels only what it sees."""
STRIP_PX = 26
"""Height of the line above the pictures."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class JudgedFrame:
    """One labelled frame, ready to be drawn."""

    name: str
    """The frame."""
    xyz: np.ndarray
    """(n, 3) m, sensor frame: the sweep."""
    groups: tuple[BoxGroup, ...]
    """Labels and detections by what became of them, as `group_by_verdict` returns."""
    calibration: Calibration
    """Of the camera whose image was labelled."""
    image: np.ndarray | None = None
    """(h, w, 3) uint8, red green blue; None where there is none."""
    regions_px: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 4)))
    """(r, 4) px: left, top, right, bottom of the DontCare regions."""

    @property
    def summary(self) -> str:
        """Such as "000008: 4 found, 1 loose, 1 missed, 0 false"."""
        num = {group.name: len(group.boxes) for group in self.groups}
        return (
            f"{self.name}: {num[FOUND]} found, {num[LOOSE_BOX]} loose, {num[MISSED]} missed, "
            f"{num[FALSE]} false"
        )


def group_by_verdict(
    scene: Scene,
    labels: Sequence[KittiObject],
    results: Sequence[KittiObject],
    calibration: Calibration,
    *,
    min_score: float = 0.0,
) -> tuple[BoxGroup, ...]:
    """Groups a frame's labels and detections by what became of them.

    A label that counts is found from a bird's-eye IoU of `FOUND_OVERLAP` on; below a 3D IoU of
    `TIGHT_OVERLAP` its box is loose. Vehicles of other classes, labels that the selection leaves out and
    detections that it excuses are ignored.

    Args:
      scene: the frame as a selection sees it, from `jaxbox.evaluation.matching.select`.
      labels: the frame's labels, those that the scene was made of.
      results: likewise its detections.
      calibration: of the camera that was labelled.
      min_score: detections with lower scores are not drawn, and match nothing.

    Returns:
      All groups, some of them empty, in the order in which they are drawn.
    """
    (scene,) = cut([scene], min_score=min_score)
    verdict = judge(scene, metric="bev", min_overlap=FOUND_OVERLAP)
    rows = np.flatnonzero(verdict.found)
    hits = verdict.partner[rows]
    tight = scene.box[rows, hits] >= TIGHT_OVERLAP
    overlaps = [f"{scene.box[i, j]:.2f}/{scene.bev[i, j]:.2f}" for i, j in zip(rows, hits, strict=True)]
    found_rows, false_rows = scene.detection_rows[hits], scene.detection_rows[verdict.false]
    missed_rows, ignored_rows = scene.label_rows[verdict.missed], scene.label_rows[~scene.counts]
    other_rows = _other_detections(results, np.concatenate([found_rows, false_rows]), min_score)
    found = _take(results, found_rows, calibration, overlaps)
    truth = _take(labels, scene.label_rows[rows], calibration)
    reasons = _miss_captions([labels[i] for i in missed_rows], scene.num_points[verdict.missed], results)
    false = _take(results, false_rows, calibration, [f"{results[row].score:.2f}" for row in false_rows])
    kinds = [labels[row].type.lower() for row in ignored_rows]
    others = [_scored(results[row]) for row in other_rows]
    return (
        BoxGroup(
            name=NOT_JUDGED,
            boxes=_take(results, other_rows, calibration, others),
            color=IGNORED,
        ),
        BoxGroup(
            name=IGNORED_LABEL,
            boxes=_take(labels, ignored_rows, calibration, kinds),
            color=IGNORED,
            thickness_px=1,
            caption_below=True,
        ),
        BoxGroup(name=LOOSE_BOX, boxes=found.take(~tight), color=LOOSE),
        BoxGroup(name=FOUND, boxes=found.take(tight), color=ESTIMATE),
        BoxGroup(name=LABEL, boxes=truth, color=TRUTH, thickness_px=1),
        BoxGroup(name=FALSE, boxes=false, color=FALSE_ALARM),
        BoxGroup(name=MISSED, boxes=_take(labels, missed_rows, calibration, reasons), color=MISS),
    )


def _other_detections(results: Sequence[KittiObject], judged: np.ndarray, min_score: float) -> np.ndarray:
    """Rows of the vehicles that score enough and are neither right nor wrong."""
    rows = set(range(len(results))) - set(judged.tolist())
    kept = [row for row in sorted(rows) if (results[row].score or 0.0) >= min_score]
    return np.array([row for row in kept if results[row].type in VEHICLE_TYPES], int)


def _take(
    objects: Sequence[KittiObject], rows: np.ndarray, calibration: Calibration, captions: Sequence[str] = ()
) -> BoxSet:
    center, size, yaw = boxes_from_objects([objects[row] for row in rows], calibration)
    return BoxSet(center=center, size=size, yaw=yaw, captions=tuple(captions))


def _miss_captions(
    missed: Sequence[KittiObject], num_points: np.ndarray, results: Sequence[KittiObject]
) -> list[str]:
    """The points of each missed label, and the best box on it, of another class or too low a score."""
    vehicles = [item for item in results if item.type in VEHICLE_TYPES]
    overlaps, _ = pairwise_overlaps(camera_boxes(missed), camera_boxes(vehicles))
    captions = []
    for count, row in zip(num_points, overlaps, strict=True):
        words = [f"{count} pts"] if count >= 0 else []
        if row.max(initial=0.0) >= FOUND_OVERLAP:
            words.append(_scored(vehicles[int(row.argmax())]))
        captions.append(", ".join(words) or "missed")
    return captions


def _scored(item: KittiObject) -> str:
    return f"{item.type.lower()} {item.score:.2f}"


def draw_judged_frame(frame: JudgedFrame, *, width_px: int = 1242, legend: bool = True) -> np.ndarray:
    """Draws a frame's image, where it has one, and below it the sweep from above, forward to the right.

    Where the labels are all round the sensor, so is the view.

    Args:
      frame: what to draw.
      width_px: width of the picture.
      legend: whether `LEGEND` is drawn too.

    Returns:
      (h, width_px, 3) uint8, red green blue.
    """
    strip = blank(width_px=width_px, height_px=STRIP_PX)
    draw_text(strip, frame.summary, (8, STRIP_PX - 8), scale=0.55)
    ahead = BirdEyeFrame(x_range_m=VIEW_X_M, y_range_m=VIEW_Y_M, width_px=width_px)
    has_camera = np.any(frame.calibration.image_size_px)
    view = ahead if has_camera else BirdEyeFrame(width_px=width_px)
    colors = shade_by_height(frame.xyz[:, 2] + SENSOR_HEIGHT_M)
    above = draw_bird_eye(frame.xyz, colors=colors, groups=frame.groups, frame=view, legend=False)
    if legend:
        draw_legend(above, LEGEND)
    pictures = [strip, above] if frame.image is None else [strip, _draw_image(frame, width_px), above]
    return np.concatenate(pictures)


def _draw_image(frame: JudgedFrame, width_px: int) -> np.ndarray:
    """The boxes in the scaled image."""
    assert frame.image is not None
    image, camera = scale_camera(frame.image, frame.calibration, width_px=width_px)
    scale = width_px / frame.image.shape[1]
    for left, top, right, bottom in frame.regions_px * scale:
        corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        draw_polygon(image, corners, IGNORED, thickness_px=1)
    return draw_image_boxes(image, camera, groups=frame.groups, legend=False)
