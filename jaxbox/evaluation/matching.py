"""Which detection is which label: one-to-one matching, recall and precision by overlap, range and points.

Detections and labels are matched one to one, best overlap first. As in KITTI's protocol, a label that is
not selected (too few points, too occluded, a neighbouring class) is neither found nor missed, and a
detection matched to it neither right nor wrong. So is a detection in a DontCare region, or one lower than
25 px in the image, as are those outside it: KITTI labels only what the camera sees. Unlike the
protocol, no average over scores is taken: these are the figures at one cut.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxbox.evaluation import kitti
from jaxbox.evaluation.boxes import camera_boxes, excused_in_image, image_boxes
from jaxbox.evaluation.iou import framewise_overlaps
from jaxbox.io import KittiObject
from jaxbox.types import Label

NEIGHBOURS: Mapping[str, tuple[str, ...]] = {
    "car": tuple(label.word for label in Label if label is not Label.CAR),
    "pedestrian": ("person_sitting",),
}
"""Classes too alike to call a detection of the first one wrong; KITTI itself does not list Truck."""

RATE_OVERLAPS = (0.5, 0.7)
RANGE_EDGES_M = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0)
POINT_EDGES = (0, 10, 30, 100, 300, 1000)
"""Lower edges of the bins of recall; the last bin has no upper one."""

MAX_TRUNCATION = 0.5
"""KITTI's difficulties leave out labels of which more is outside the image."""

_MIN_HEIGHT_PX = kitti.MIN_HEIGHT_PX[-1]
_EXCUSED_FRACTION = 0.5
_ROUNDING_M = 1e-6


@dataclasses.dataclass(frozen=True)
class Selection:
    """Which labels count, and of which class the detections are."""

    class_name: str = "Car"
    """Class of both."""
    min_points: int = 0
    """LiDAR points that a label's box must hold."""
    max_occlusion: int = 3
    """KITTI's occlusion that a label may have: 0 visible, 1 partly, 2 largely occluded, 3 unknown."""
    difficulty: str | None = None
    """KITTI's limits that a label must keep: "easy", "moderate", "hard", or None for none."""
    cut_off: bool | None = None
    """Only labels that the image cuts off, of a truncation above `MAX_TRUNCATION`, or only others; None is
    both."""
    track_id: int | None = None
    """Only this object of a tracking sequence, or None for every one."""

    def __post_init__(self):
        if self.difficulty not in (None, *kitti.DIFFICULTIES):
            raise ValueError(f"difficulty is {self.difficulty!r}; choose from {kitti.DIFFICULTIES} or None.")

    def to_dict(self) -> dict[str, Any]:
        """Numbers, strings and None only, for JSON."""
        return dataclasses.asdict(self)


@dataclasses.dataclass(frozen=True)
class Scene:
    """One frame's labels and detections as a `Selection` sees them."""

    name: str
    """The frame."""
    labels: np.ndarray
    """(A, 7) float64, m and rad, x forward y left z up: labels that count or are ignored."""
    counts: np.ndarray
    """(A,) bool: the label counts; else it is ignored."""
    num_points: np.ndarray
    """(A,) int: LiDAR points within the label's box, -1 where unknown."""
    detections: np.ndarray
    """(B, 7) float64, likewise."""
    scores: np.ndarray
    """(B,) float64, higher is better."""
    excused: np.ndarray
    """(B,) bool: neither right nor wrong unless it matches a label."""
    bev: np.ndarray
    """(A, B) bird's-eye IoU."""
    box: np.ndarray
    """(A, B) 3D IoU."""
    label_rows: np.ndarray
    """(A,) int: rows of the labels in the frame's list."""
    detection_rows: np.ndarray
    """(B,) int: rows of the detections in the frame's list."""


def select(
    labels: kitti.Objects,
    results: kitti.Objects,
    selection: Selection,
    *,
    num_points: Mapping[str, np.ndarray] | None = None,
) -> list[Scene]:
    """Applies a selection to labelled frames.

    Args:
      labels: ground truth of each frame, by name.
      results: detections of each of these frames.
      selection: what to count.
      num_points: (labels of the frame,) int for each frame: LiDAR points within each label's box. None
        where they are unknown.

    Returns:
      One scene a frame, in the order of the labels.

    Raises:
      ValueError: for a selection by points where they are unknown, or a detection without score.
    """
    if num_points is None and selection.min_points > 0:
        raise ValueError("labels are selected by their LiDAR points, but no sweeps were given to count them.")
    found_rows = {name: _rows_of(results[name], selection.class_name, name) for name in labels}
    found = {name: [results[name][row] for row in rows] for name, rows in found_rows.items()}
    boxes = {name: camera_boxes(items) for name, items in found.items()}
    scenes = []
    for name, objects in labels.items():
        roles = np.array([_label_role(item, selection) for item in objects], int)
        points = np.full(len(objects), -1) if num_points is None else np.asarray(num_points[name], int)
        roles[(roles == _COUNTS) & (points >= 0) & (points < selection.min_points)] = _IGNORED
        rows = np.flatnonzero(roles != _OTHER)
        scenes.append((name, camera_boxes(objects)[rows], roles[rows] == _COUNTS, points[rows], rows))
    overlaps = framewise_overlaps([(scene[1], boxes[scene[0]]) for scene in scenes])
    return [
        Scene(
            *scene[:4],
            detections=boxes[scene[0]],
            scores=np.array([item.score for item in found[scene[0]]], float),
            excused=_excused(found[scene[0]], labels[scene[0]]),
            bev=bev,
            box=box,
            label_rows=scene[4],
            detection_rows=found_rows[scene[0]],
        )
        for scene, (bev, box) in zip(scenes, overlaps, strict=True)
    ]


_COUNTS, _IGNORED, _OTHER = 0, 1, -1


def _label_role(label: KittiObject, selection: Selection) -> int:
    class_name = selection.class_name.lower()
    if label.type.lower() in NEIGHBOURS.get(class_name, ()):
        return _IGNORED
    if label.type.lower() != class_name:
        return _OTHER
    if label.occlusion > selection.max_occlusion:
        return _IGNORED
    is_cut_off = label.truncation > MAX_TRUNCATION
    if selection.cut_off not in (None, is_cut_off) or selection.track_id not in (None, label.track_id):
        return _IGNORED
    if selection.difficulty is None:
        return _COUNTS
    level = kitti.DIFFICULTIES.index(selection.difficulty)
    return int(kitti.label_roles([label], class_name, level)[0])


def _rows_of(results: Sequence[KittiObject], class_name: str, frame: str) -> np.ndarray:
    """Rows of the detections of a class."""
    rows = [row for row, item in enumerate(results) if item.type.lower() == class_name.lower()]
    if any(results[row].score is None for row in rows):
        raise ValueError(f"frame {frame} has a detection without score; results need 16 columns.")
    return np.array(rows, int)


def _excused(detections: Sequence[KittiObject], labels: Sequence[KittiObject]) -> np.ndarray:
    boxes = image_boxes(detections)
    covered = excused_in_image(labels, detections)
    return (boxes[:, 3] - boxes[:, 1] < _MIN_HEIGHT_PX) | (covered > _EXCUSED_FRACTION)


def cut(scenes: Sequence[Scene], *, min_score: float) -> list[Scene]:
    """Removes detections below a score.

    Args:
      scenes: the frames.
      min_score: score that a detection must reach.

    Returns:
      The same frames and labels, with the other detections.
    """
    return [_take_detections(scene, scene.scores >= min_score) for scene in scenes]


def _take_detections(scene: Scene, keep: np.ndarray) -> Scene:
    return dataclasses.replace(
        scene,
        detections=scene.detections[keep],
        scores=scene.scores[keep],
        excused=scene.excused[keep],
        bev=scene.bev[:, keep],
        box=scene.box[:, keep],
        detection_rows=scene.detection_rows[keep],
    )


def match(overlap: np.ndarray, counts: np.ndarray, *, min_overlap: float) -> np.ndarray:
    """Matches labels and detections one to one, best overlap first; labels that count go before ignored ones.

    Args:
      overlap: (A, B) in [0, 1].
      counts: (A,) bool: labels that count.
      min_overlap: a match needs at least this much, and more than 0.

    Returns:
      (A,) int: detection of each label, -1 where it has none.

    >>> overlap = np.array([[0.9, 0.6], [0.8, 0.0]])
    >>> match(overlap, np.array([True, True]), min_overlap=0.5).tolist()
    [0, -1]
    """
    matched = np.full(overlap.shape[0], -1)
    for group in (counts, ~np.asarray(counts, bool)):
        open_pairs = np.where(np.asarray(group)[:, None], overlap, 0.0)
        open_pairs[:, matched[matched >= 0]] = 0
        while open_pairs.size and open_pairs.max() > 0 and open_pairs.max() >= min_overlap:
            label, detection = np.unravel_index(np.argmax(open_pairs), open_pairs.shape)
            matched[label] = detection
            open_pairs[label], open_pairs[:, detection] = 0, 0
    return matched


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What became of one frame's labels and detections; what is in no mask is neither right nor wrong."""

    partner: np.ndarray
    """(A,) int: detection of each label, also of ignored ones; -1 where it has none."""
    found: np.ndarray
    """(A,) bool: the label counts and has a detection."""
    missed: np.ndarray
    """(A,) bool: the label counts and has none."""
    false: np.ndarray
    """(B,) bool: the detection is of no label, and nothing excuses it."""


def judge(scene: Scene, *, metric: str, min_overlap: float) -> Verdict:
    """Says of each label whether it was found, and of each detection whether it is false.

    Args:
      scene: the frame.
      metric: "bev" or "3d".
      min_overlap: IoU that a match needs.

    Returns:
      The verdict.
    """
    partner = match(_overlap(scene, metric), scene.counts, min_overlap=min_overlap)
    unmatched = np.ones(len(scene.detections), bool)
    unmatched[partner[partner >= 0]] = False
    return Verdict(
        partner=partner,
        found=scene.counts & (partner >= 0),
        missed=scene.counts & (partner < 0),
        false=unmatched & ~scene.excused,
    )


@dataclasses.dataclass(frozen=True)
class Matches:
    """Labels that count and their detections, over all frames; row i of each belongs together."""

    frames: tuple[str, ...]
    """Frame of each."""
    labels: np.ndarray
    """(n, 7) float64, m and rad: x, y, z, length, width, height, yaw; x forward y left z up."""
    detections: np.ndarray
    """(n, 7) float64, likewise."""
    bev_iou: np.ndarray
    """(n,) bird's-eye IoU."""
    box_iou: np.ndarray
    """(n,) 3D IoU."""
    num_points: np.ndarray
    """(n,) int: LiDAR points within the label's box, -1 where unknown."""


def matched_boxes(scenes: Sequence[Scene], *, min_overlap: float) -> Matches:
    """Collects the labels that count and were found.

    Args:
      scenes: the frames.
      min_overlap: bird's-eye IoU that a match needs.

    Returns:
      The matches, in the order of the frames and labels.
    """
    frames, rows = [], []
    for scene in scenes:
        verdict = judge(scene, metric="bev", min_overlap=min_overlap)
        for label in np.flatnonzero(verdict.found):
            found = verdict.partner[label]
            overlaps = scene.bev[label, found], scene.box[label, found]
            frames.append(scene.name)
            rows.append([*scene.labels[label], *scene.detections[found], *overlaps, scene.num_points[label]])
    table = np.array(rows, float).reshape(-1, 17)
    bev_iou, box_iou, num_points = table[:, 14:].T
    return Matches(tuple(frames), table[:, :7], table[:, 7:14], bev_iou, box_iou, num_points.astype(int))


@dataclasses.dataclass(frozen=True)
class Rates:
    """Recall and precision at one overlap and cut."""

    metric: str
    """"bev" or "3d"."""
    min_overlap: float
    """IoU that a match needs."""
    num_labels: int
    """Labels that count."""
    num_found: int
    """Of these, matched ones."""
    num_false: int
    """Detections that match no label and that nothing excuses."""
    num_excused: int
    """Detections that are neither right nor wrong."""

    @property
    def recall(self) -> float | None:
        """Found of the labels, in [0, 1]; None without labels."""
        return self.num_found / self.num_labels if self.num_labels else None

    @property
    def precision(self) -> float | None:
        """Right of the right and wrong detections, in [0, 1]; None without either."""
        judged = self.num_found + self.num_false
        return self.num_found / judged if judged else None

    def to_dict(self) -> dict[str, Any]:
        """Numbers, strings and None only, for JSON."""
        return dataclasses.asdict(self) | {"recall": self.recall, "precision": self.precision}


def rates(scenes: Sequence[Scene], *, metric: str, min_overlap: float) -> Rates:
    """Counts what was found, missed and false.

    Args:
      scenes: the frames.
      metric: "bev" or "3d".
      min_overlap: IoU that a match needs.

    Returns:
      The counts over all frames.
    """
    num_labels = num_found = num_false = num_excused = 0
    for scene in scenes:
        verdict = judge(scene, metric=metric, min_overlap=min_overlap)
        found, false = int(verdict.found.sum()), int(verdict.false.sum())
        num_labels += int(scene.counts.sum())
        num_found += found
        num_false += false
        num_excused += len(scene.detections) - found - false
    return Rates(metric, min_overlap, num_labels, num_found, num_false, num_excused)


def _overlap(scene: Scene, metric: str) -> np.ndarray:
    return {"bev": scene.bev, "3d": scene.box}[metric]


@dataclasses.dataclass(frozen=True)
class RecallBin:
    """Recall of the labels of one range of distance or point count."""

    lower: float
    """Least value of the bin."""
    upper: float | None
    """First value beyond it; None for the last bin."""
    num_labels: int
    """Labels that count."""
    num_found: Mapping[str, int]
    """Matched ones, by "bev_0.5", "bev_0.7", "3d_0.5" and "3d_0.7"."""

    def to_dict(self) -> dict[str, Any]:
        """Numbers, dicts and None only, for JSON; recall is None without labels."""
        recall = {
            key: found / self.num_labels if self.num_labels else None for key, found in self.num_found.items()
        }
        return dataclasses.asdict(self) | {"num_found": dict(self.num_found), "recall": recall}


def recall_by(
    scenes: Sequence[Scene], values: Sequence[np.ndarray], edges: Sequence[float]
) -> list[RecallBin]:
    """Recall by any value of the labels.

    Args:
      scenes: the frames.
      values: for each scene (A,), the value of each label.
      edges: ascending lower edges of the bins; the last bin has no upper one.

    Returns:
      One bin an edge. Labels below the first edge are in none.
    """
    counts = np.concatenate([np.zeros(0, bool), *(scene.counts for scene in scenes)])
    bins = np.searchsorted(edges, np.concatenate([np.zeros(0), *values]), side="right") - 1
    found = {
        f"{metric}_{overlap}": np.concatenate(
            [
                np.zeros(0, bool),
                *(match(_overlap(s, metric), s.counts, min_overlap=overlap) >= 0 for s in scenes),
            ]
        )
        for metric in ("bev", "3d")
        for overlap in RATE_OVERLAPS
    }
    return [
        RecallBin(
            lower=edge,
            upper=edges[i + 1] if i + 1 < len(edges) else None,
            num_labels=int(np.sum(counts & (bins == i))),
            num_found={key: int(np.sum(hit & counts & (bins == i))) for key, hit in found.items()},
        )
        for i, edge in enumerate(edges)
    ]


def recall_by_range(scenes: Sequence[Scene]) -> list[RecallBin]:
    """Recall by horizontal distance of the label's centre from the camera, in bins of `RANGE_EDGES_M`.

    Args:
      scenes: the frames.

    Returns:
      One bin an edge.
    """
    ranges = [np.hypot(scene.labels[:, 0], scene.labels[:, 1]) for scene in scenes]
    return recall_by(scenes, ranges, RANGE_EDGES_M)


def recall_by_points(scenes: Sequence[Scene]) -> list[RecallBin]:
    """Recall by LiDAR points within the label's box, in bins of `POINT_EDGES`.

    Args:
      scenes: the frames; labels with an unknown number are in no bin.

    Returns:
      One bin an edge.
    """
    return recall_by(scenes, [scene.num_points for scene in scenes], POINT_EDGES)


def count_points_in_boxes(
    xyz: np.ndarray, center: np.ndarray, size: np.ndarray, yaw: np.ndarray
) -> np.ndarray:
    """Counts the points within upright boxes, the faces included.

    Args:
      xyz: (N, 3) real numbers, m; rows that are not finite are in no box.
      center: (K, 3) m, in the same frame, z up.
      size: (K, 3) m: length, width, height.
      yaw: (K,) rad.

    Returns:
      (K,) int.

    >>> points = np.array([[1.0, 0.0, 0.0], [0.0, 1.5, 0.0]])
    >>> count_points_in_boxes(points, np.zeros((1, 3)), np.array([[4.0, 2.0, 1.0]]), np.zeros(1)).tolist()
    [1]
    """
    xyz = np.asarray(xyz)[np.isfinite(xyz).all(axis=1)].astype(float)
    xyz = xyz[np.argsort(xyz[:, 0])]
    counts = [
        _count_in_box(xyz, *box)
        for box in zip(np.reshape(center, (-1, 3)), np.reshape(size, (-1, 3)), np.ravel(yaw), strict=True)
    ]
    return np.array(counts, int)


def _count_in_box(xyz: np.ndarray, center: np.ndarray, size: np.ndarray, yaw: float) -> int:
    # The slice of x that the box reaches over first: a sweep has 120,000 points, a car at most some thousand.
    reach_m = np.hypot(size[0], size[1]) / 2 + _ROUNDING_M
    first, last = np.searchsorted(xyz[:, 0], (center[0] - reach_m, center[0] + reach_m))
    x, y, z = (xyz[first:last] - center).T
    along, across = np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x
    inside = np.abs(np.stack([along, across, z], axis=1)) <= size / 2
    return int(np.sum(inside.all(axis=1)))
