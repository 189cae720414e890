"""What the page draws of a sweep and its detections, as arrays: no viewer is needed to make it."""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from jaxbox.config import DEFAULT_SCORE_THRESHOLD
from jaxbox.types import Detections
from jaxbox.viewer.drives import TrackedFrame
from jaxbox.viewer.frames import Frame
from jaxbox.viewer.motion import motion_lines, shown_groups
from jaxbox.viewer.space import Caption, Lines, colored_edges, edges
from jaxbox.viz import BoxGroup, BoxSet, color_by_height, color_by_id, draw_image_boxes
from jaxbox.viz.boxes import pair_boxes
from jaxbox.viz.colors import ESTIMATE, HULL, IGNORED, TRUTH, Color, shade_by_height
from jaxbox.viz.stages import height_above_plane

GROUND_COLOR: Color = (120, 100, 80)
"""Points of the ground."""
OBSTACLE_COLOR: Color = (120, 215, 255)
"""Points above it."""
CAPTION_GAP_M = 0.3
"""Distance of captions above their boxes, and of those of labels below, so that neither hides the other."""
COMPARED: Color = (240, 120, 255)
"""Boxes of what is compared."""
LIGHT_SHARE = 0.7
"""On a light page colours are darker by this factor: they are made for a dark one."""
_TITLE_M = 2.0
_INTENSITY_TOP = 99.0
"""Percentile of the intensities that has the highest colour: a few mirrors outshine everything."""
_LOW_PERCENTILE = 5.0
_LABEL_MARGIN_M = 0.1


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """What is to be seen of a sweep."""

    coloring: str = "height"
    """What the colours of the points mean: one of `COLORINGS`."""
    min_score: float = DEFAULT_SCORE_THRESHOLD
    """Boxes that score less are hidden."""
    boxes: bool = True
    """Whether boxes are drawn."""
    hulls: bool = True
    """Whether the hulls of their points are."""
    captions: bool = True
    """Whether class and score stand above them."""
    labels: bool = True
    """Whether labelled boxes are drawn."""
    points: bool = True
    """Whether points are."""
    tracks: bool = False
    """Whether the boxes are those of tracks, by id, with their trails and velocities."""
    light: bool = False
    """Whether the page is light, and not dark."""
    apart_m: float = 0.0
    """Distance to the right at which what is compared is drawn, m; 0 for the same place."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene:
    """Arrays of what is drawn, sensor frame."""

    points: np.ndarray
    """(n, 3) float32, m: the frame's own array, so that an unchanged sweep is known by it; or none."""
    colors: np.ndarray
    """(n, 3) uint8: of the points."""
    lines: Mapping[str, Lines]
    """By name: ``boxes``, ``hulls``, ``labels`` and ``other_labels``; of tracks ``trails`` and ``arrows``
    too; some may be empty."""
    captions: tuple[Caption, ...]
    """One an object: class and score of a box, or id and state of its track, or the type of a label alone."""
    image: np.ndarray | None
    """(h, w, 3) uint8: the camera's image with the boxes, where there is one."""
    boxes: BoxSet
    """Those drawn, or that would be were they not switched off."""
    view: View
    """What was to be seen."""
    title: str = ""
    """What it is a scene of, where another is compared with it."""

    @property
    def num_boxes(self) -> int:
        """Boxes drawn, or that would be were they not switched off."""
        return len(self.boxes)


def build_scene(
    frame: Frame,
    detections: Detections | None,
    view: View,
    tracked: TrackedFrame | None = None,
    *,
    title: str = "",
    compared: bool = False,
) -> Scene:
    """Puts the arrays together.

    Args:
      frame: the sweep.
      detections: the answer for it; None where there is none yet.
      view: what is to be seen.
      tracked: its tracks, which take the place of the boxes where the view wants them; None where there are
        none.
      title: what it is a scene of, where another is compared with it.
      compared: whether it is that other scene, whose boxes have a colour of their own and captions below.

    Returns:
      The scene.
    """
    found = _no_boxes()
    if detections is not None:
        found = BoxSet.from_detections(detections, min_score=view.min_score)
    by_row = {0: BoxGroup(name="box", boxes=found, color=ESTIMATE)}
    if view.tracks and tracked is not None:
        by_row = shown_groups(tracked, min_score=view.min_score)
    if compared:
        by_row = {row: dataclasses.replace(group, color=COMPARED) for row, group in by_row.items()}
    groups = list(by_row.values())
    motion = motion_lines(tracked, by_row) if view.tracks and tracked is not None else {}
    shown = groups if view.boxes else []
    hulls = [] if detections is None or not view.hulls else _hull_lines(detections, found, view.min_score)
    vehicles, others = (
        labels if view.labels and labels is not None else _no_boxes()
        for labels in (frame.vehicles, frame.others)
    )
    lines = {
        "boxes": colored_edges(shown),
        "hulls": Lines(segments=_stacked(hulls), color=HULL),
        "labels": Lines(segments=edges(vehicles), color=TRUTH),
        "other_labels": Lines(segments=edges(others), color=IGNORED),
        **motion,
    }
    boxes = _joined(groups)
    captions = []
    if view.captions:
        captions = _all_captions(boxes if view.boxes else _no_boxes(), vehicles, others, below=compared)
    titles = [Caption(text=title, position=(0.0, 0.0, _TITLE_M))] if title and view.apart_m else []
    points, colors = frame.xyz[:0], np.zeros((0, 3), np.uint8)
    if view.points:
        points, colors = frame.xyz, on_page(COLORINGS[view.coloring](frame, detections, view), view)
    return Scene(
        points=points,
        colors=colors,
        lines={
            name: Lines(segments=drawn.segments, color=on_page(drawn.color, view))
            for name, drawn in lines.items()
        },
        captions=(*captions, *titles),
        image=_camera_picture(frame, shown, vehicles, others),
        boxes=boxes,
        view=view,
        title=title,
    )


def on_page(colors: Color | np.ndarray, view: View) -> np.ndarray:
    """Colours as a page shows them.

    Args:
      colors: (..., 3) uint8, for a dark page.
      view: says whether the page is light.

    Returns:
      (..., 3) uint8: the same, or darker by `LIGHT_SHARE`.

    >>> on_page((200, 100, 0), View(light=True)).tolist()
    [140, 70, 0]
    """
    colors = np.asarray(colors, np.uint8)
    return np.round(LIGHT_SHARE * colors).astype(np.uint8) if view.light else colors


def _no_boxes() -> BoxSet:
    return BoxSet(center=np.zeros((0, 3)), size=np.zeros((0, 3)), yaw=np.zeros(0))


def _joined(groups: list[BoxGroup]) -> BoxSet:
    """The boxes of all groups."""
    sets = [_no_boxes(), *(group.boxes for group in groups)]
    return BoxSet(
        center=np.concatenate([boxes.center for boxes in sets]),
        size=np.concatenate([boxes.size for boxes in sets]),
        yaw=np.concatenate([boxes.yaw for boxes in sets]),
        captions=tuple(caption for boxes in sets for caption in boxes.captions),
    )


def _stacked(segments: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros((0, 2, 3)), *segments]).astype(np.float32)


def _hull_lines(detections: Detections, boxes: BoxSet, min_score: float) -> list[np.ndarray]:
    """The hull of each box's points, drawn round its foot and its top."""
    # The same comparison as that which chose the boxes, so that the rows are theirs.
    keep = np.asarray(detections.valid) & (np.asarray(detections.score, np.float64) >= min_score)
    polygons, capacity = np.asarray(detections.hulls.vertices)[keep], detections.hulls.vertices.shape[1]
    counts = np.minimum(np.asarray(detections.hulls.num_vertices)[keep], capacity)
    half_heights = np.array([[-0.5, 0.5]]) * boxes.size[:, 2:]
    levels = boxes.center[:, 2:] + half_heights
    return [
        _ring(polygon[:count], z)
        for polygon, count, pair in zip(polygons, counts, levels.tolist(), strict=True)
        for z in pair
    ]


def _ring(polygon: np.ndarray, z: float) -> np.ndarray:
    """(h, 2, 3): the sides of a polygon at a height."""
    corners = np.column_stack([polygon, np.full(len(polygon), z)])
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def _all_captions(boxes: BoxSet, vehicles: BoxSet, others: BoxSet, *, below: bool) -> list[Caption]:
    """One an object: a label in the place of a box is in that box's caption, where it says anything else."""
    pairs, texts = pair_boxes(boxes, vehicles), list(boxes.captions)
    for row in np.flatnonzero(pairs >= 0).tolist():
        label, word = vehicles.captions[pairs[row]], texts[row].split()[0]
        # A track's caption begins with its id.
        if word.isalpha() and label.lower() != word:
            texts[row] += f" (label: {label})"
    captions = _captions(dataclasses.replace(boxes, captions=tuple(texts)), below=below)
    alone = [vehicles.take(~np.isin(np.arange(len(vehicles)), pairs)), others]
    return captions + [
        dataclasses.replace(caption, text=f"label: {caption.text}")
        for labels in alone
        for caption in _captions(labels, below=True)
    ]


def _captions(boxes: BoxSet, *, below: bool = False) -> list[Caption]:
    shift = boxes.size[:, 2] / 2 + CAPTION_GAP_M
    x, y, z = boxes.center.T
    places = np.stack([x, y, z - shift if below else z + shift], axis=1).tolist()
    return [
        Caption(text=text, position=(x, y, z), below=below)
        for text, (x, y, z) in zip(boxes.captions, places, strict=True)
    ]


def _camera_picture(
    frame: Frame, shown: list[BoxGroup], vehicles: BoxSet, others: BoxSet
) -> np.ndarray | None:
    if frame.image is None or frame.calibration is None:
        return frame.image
    groups = [
        *shown,
        BoxGroup(name="label", boxes=dataclasses.replace(vehicles, captions=()), color=TRUTH, thickness_px=1),
        BoxGroup(name="other", boxes=dataclasses.replace(others, captions=()), color=IGNORED, thickness_px=1),
    ]
    return draw_image_boxes(frame.image, frame.calibration, groups=groups, legend=False)


def _by_height(frame: Frame, detections: Detections | None, _: View) -> np.ndarray:
    return color_by_height(_height_above_ground(frame, detections))


def _by_cluster(frame: Frame, detections: Detections | None, _: View) -> np.ndarray:
    return color_by_id(_rows_of(frame, None if detections is None else detections.point_component))


def _by_vehicle(frame: Frame, detections: Detections | None, view: View) -> np.ndarray:
    ids = _rows_of(frame, None if detections is None else detections.point_detection)
    if detections is not None:
        shown = np.asarray(detections.score, np.float64) >= view.min_score
        ids = np.where(shown[ids], ids, -1)
    shades = shade_by_height(_height_above_ground(frame, detections))
    return np.where(ids[:, None] < 0, shades, color_by_id(ids))


def _by_ground(frame: Frame, detections: Detections | None, _: View) -> np.ndarray:
    is_ground = (
        np.zeros(len(frame.rows), bool)
        if detections is None
        else np.asarray(detections.ground_mask)[frame.rows]
    )
    return np.where(is_ground[:, None], GROUND_COLOR, OBSTACLE_COLOR).astype(np.uint8)


def _by_label(frame: Frame, detections: Detections | None, _: View) -> np.ndarray:
    colors = shade_by_height(_height_above_ground(frame, detections))
    for labels, color in ((frame.others, IGNORED), (frame.vehicles, TRUTH)):
        if labels is not None:
            colors[_inside_any(frame.xyz, labels)] = color
    return colors


def _by_intensity(frame: Frame, _: Detections | None, __: View) -> np.ndarray:
    shown = np.where(np.isfinite(frame.intensity), frame.intensity, 0)
    high = np.percentile(shown, _INTENSITY_TOP) if len(shown) else 0
    return color_by_height(shown, low_m=0, high_m=float(high) or 1.0)


Coloring = Callable[[Frame, Detections | None, View], np.ndarray]
"""(n, 3) uint8 of a frame's points, with or without an answer."""

COLORINGS: Mapping[str, Coloring] = {
    "height": _by_height,
    "cluster": _by_cluster,
    "ground": _by_ground,
    "vehicle": _by_vehicle,
    "label": _by_label,
    "intensity": _by_intensity,
}
"""What the colours of the points may mean: height above the ground plane, component of the first map,
ground or not, box, labelled box, intensity."""


def _rows_of(frame: Frame, values: object) -> np.ndarray:
    """(n,) values of the frame's points out of (N,) of the cloud; -1 where there are none yet."""
    if values is None:
        return np.full(len(frame.rows), -1)
    return np.asarray(values)[frame.rows]


def _height_above_ground(frame: Frame, detections: Detections | None) -> np.ndarray:
    """(n,) m above the plane, or above the lowest points where there is no answer yet."""
    xyz = frame.xyz.astype(np.float64)
    if detections is None:
        z = xyz[:, 2]
        return z - (np.percentile(z, _LOW_PERCENTILE) if len(z) else 0)
    return height_above_plane(xyz, detections)


def _inside_any(xyz: np.ndarray, boxes: BoxSet) -> np.ndarray:
    """(n,) bool: within one of the boxes, or a hand's breadth next to it; not below, where the road is."""
    inside = np.zeros(len(xyz), bool)
    for center, size, yaw in zip(boxes.center, boxes.size, boxes.yaw.tolist(), strict=True):
        x, y, z = (xyz - center).T
        along, across = np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x
        reach = size[:2] / 2 + _LABEL_MARGIN_M
        inside |= (abs(along) < reach[0]) & (abs(across) < reach[1]) & (abs(z) < size[2] / 2)
    return inside
