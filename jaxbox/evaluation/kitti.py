"""KITTI's object detection protocol: average precision in the image, of orientation, from above and in 3D.

Follows the official C++ evaluator rule by rule, also where its rules surprise:

- Labels beyond a difficulty's limits, and those of the neighbouring class, are neither found nor missed,
  and the detections matched to them neither right nor wrong. So are detections lower than the limit in
  the image; one of **any** class that is too low can still be matched to a label.
- A DontCare region excuses the detections that it covers in the image, and from above where its label has a
  size there: -1 far away in object labels, but -1000 m in those of the tracking benchmark, which **excuse
  all that matches nothing**. In 3D it excuses nothing.
- Scores are sampled where recall passes 0, 1/40, ... 1. Matching prefers the best score while these
  thresholds are collected, and the best overlap while precision is measured at them.
- There is at most one threshold a label, so with fewer than 41 labels even perfect answers stay below
  100: every average precision comes with its **ceiling**.

Reference: Geiger, Lenz, Urtasun, CVPR 2012, and the object development kit (evaluate_object.cpp); the 40
recall samples are those of Simonelli et al., "Disentangling Monocular 3D Object Detection", ICCV 2019.
"""

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxbox.evaluation.boxes import camera_boxes, excused_from_above, excused_in_image, image_boxes
from jaxbox.evaluation.iou import framewise_overlaps, image_iou
from jaxbox.io import KittiObject
from jaxbox.types import Label

DIFFICULTIES = ("easy", "moderate", "hard")
MIN_HEIGHT_PX = (40, 25, 25)
MAX_OCCLUSION = (0, 1, 2)
MAX_TRUNCATION = (0.15, 0.3, 0.5)
"""Limits of the three difficulties, from the development kit."""

MIN_OVERLAP: Mapping[str, float] = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
"""The overlap that a match must exceed, for every metric, from the development kit."""

VEHICLE = "Vehicle"
"""The one class of `as_vehicles`."""
VEHICLE_TYPES = frozenset({"car", "van", "truck", "tram"} | {label.word for label in Label})
VEHICLE_OVERLAP = 0.5
"""What a match of vehicles must exceed: half a truck is out of sight, and nothing tells how long it is."""

METRICS_IN_SPACE = ("bev", "3d")
"""Those that need no camera."""
METRICS = ("image", "orientation", *METRICS_IN_SPACE)
SOFT_OVERLAPS = (0.60, 0.65, 0.70, 0.75)
"""Overlaps that `soft_score` averages over: one borderline car weighs less than at .7 alone."""

NUM_SAMPLES = 41
_R11_STEP = 4
_INVALID_ALPHA = -10
_NEIGHBOURS = {"car": "van", "pedestrian": "person_sitting", VEHICLE.lower(): "misc"}
"""Trailers are labelled Misc."""

# Roles of labels and detections for one class and difficulty.
_COUNTS, _IGNORED, _OTHER = 0, 1, -1

Objects = Mapping[str, Sequence[KittiObject]]


@dataclasses.dataclass(frozen=True)
class PrecisionCurve:
    """Precision (or orientation similarity) over recall, of one class, metric and difficulty."""

    class_name: str
    """Car, Pedestrian or Cyclist."""
    metric: str
    """One of `METRICS`."""
    difficulty: str
    """One of `DIFFICULTIES`."""
    precision: np.ndarray
    """(41,) float64 in [0, 1], at recall 0, 1/40, ..., 1: the best from there on."""
    num_labels: int
    """Labels of this class and difficulty."""
    ceiling: np.ndarray
    """(41,) float64: what perfect answers on the same frames reach."""

    @property
    def r11(self) -> float:
        """Average precision over 11 samples from recall 0 on, in [0, 100]."""
        return average_precision(self.precision, r11=True)

    @property
    def r40(self) -> float:
        """Average precision over 40 samples without recall 0, in [0, 100]."""
        return average_precision(self.precision, r11=False)

    def to_dict(self) -> dict[str, Any]:
        """Numbers and strings only, for JSON."""
        return {
            "class": self.class_name,
            "metric": self.metric,
            "difficulty": self.difficulty,
            "r11": self.r11,
            "r40": self.r40,
            "ceiling_r11": average_precision(self.ceiling, r11=True),
            "ceiling_r40": average_precision(self.ceiling, r11=False),
            "num_labels": self.num_labels,
            "precision": self.precision.tolist(),
        }


def average_precision(precision: np.ndarray, *, r11: bool) -> float:
    """Mean precision over recall samples.

    Args:
      precision: (41,) in [0, 1].
      r11: over 11 samples from recall 0 on; else over the 40 samples without recall 0.

    Returns:
      In [0, 100].
    """
    return 100 * float(np.mean(precision[::_R11_STEP] if r11 else precision[1:]))


@dataclasses.dataclass(frozen=True)
class KittiEvaluation:
    """Every curve of an evaluation, over all frames and by drive."""

    num_frames: int
    """Labelled frames."""
    curves: tuple[PrecisionCurve, ...]
    """Over all frames."""
    by_drive: Mapping[str, tuple[PrecisionCurve, ...]]
    """Over the frames of each drive; empty where no drives were given."""

    def curve(self, class_name: str, metric: str, difficulty: str) -> PrecisionCurve:
        """Returns the curve over all frames of one class, metric and difficulty.

        Args:
          class_name: as given to `evaluate`.
          metric: one of `METRICS`.
          difficulty: one of `DIFFICULTIES`.

        Raises:
          KeyError: where it was not evaluated.
        """
        for curve in self.curves:
            if (curve.class_name, curve.metric, curve.difficulty) == (class_name, metric, difficulty):
                return curve
        raise KeyError(f"{class_name}, {metric}, {difficulty} was not evaluated.")

    def to_dict(self) -> dict[str, Any]:
        """Numbers, strings, lists and dicts only, for JSON."""
        return {
            "num_frames": self.num_frames,
            "num_drives": len(self.by_drive) or None,
            "curves": [curve.to_dict() for curve in self.curves],
            "by_drive": {drive: [c.to_dict() for c in curves] for drive, curves in self.by_drive.items()},
        }


def evaluate(
    labels: Objects,
    results: Objects,
    *,
    min_overlap: Mapping[str, float] = MIN_OVERLAP,
    metrics: Sequence[str] = METRICS,
    drives: Mapping[str, str] | None = None,
) -> KittiEvaluation:
    """Scores results against labels as the official KITTI evaluator does.

    Args:
      labels: ground truth of each frame, by name.
      results: detections, each with a score, of each of these frames; those of other frames are not used.
      min_overlap: for each class to evaluate, the overlap that a match must exceed.
      metrics: some of `METRICS`.
      drives: the drive of each frame, to evaluate each drive by itself too. Frames of one drive are
        correlated, so the number of drives says more about a figure's reliability than that of frames.

    Returns:
      A curve for each class, metric and difficulty. A class without labels or without detections has
      precision 0, one without labels also ceiling 0. Orientation is 0 where a detection has none (-10).

    Raises:
      ValueError: for frames without results, detections without score, frames without a drive, or
        unknown metrics.
    """
    unknown = sorted(set(metrics) - set(METRICS))
    if unknown:
        raise ValueError(f"metrics {unknown} are unknown; choose from {list(METRICS)}.")
    frames = prepare_frames(labels, results)
    groups = _by_drive(labels, frames, drives) if drives is not None else {}
    by_drive = {drive: _curves(groups[drive], min_overlap, metrics) for drive in sorted(groups)}
    return KittiEvaluation(len(frames), _curves(frames, min_overlap, metrics), by_drive)


def _by_drive(
    names: Iterable[str], frames: Sequence["PreparedFrame"], drives: Mapping[str, str]
) -> dict[str, list["PreparedFrame"]]:
    groups: dict[str, list[PreparedFrame]] = {}
    for name, frame in zip(names, frames, strict=True):
        if name not in drives:
            raise ValueError(f"frame {name} has no drive; add it to drives.")
        groups.setdefault(drives[name], []).append(frame)
    return groups


def as_vehicles(objects: Objects) -> dict[str, list[KittiObject]]:
    """The same objects, with cars, vans, trucks and trams as one class.

    A van that is found as a car counts as found so; KITTI's own classes take it for neither right nor wrong.

    Args:
      objects: labels or detections of each frame, by name.

    Returns:
      The same frames and objects, vehicles with the type `VEHICLE`.
    """

    def rename(item: KittiObject) -> KittiObject:
        return dataclasses.replace(item, type=VEHICLE) if item.type.lower() in VEHICLE_TYPES else item

    return {name: [rename(item) for item in items] for name, items in objects.items()}


def soft_score(labels: Objects, results: Objects, *, class_name: str = "Car") -> float:
    """Mean 3D average precision (R40) over `SOFT_OVERLAPS` and the moderate and hard difficulties.

    A smoother figure than AP at one overlap, to compare two settings on few frames.

    Args:
      labels: ground truth of each frame, by name.
      results: detections, each with a score, of each of these frames.
      class_name: the class.

    Returns:
      In [0, 100].

    Raises:
      ValueError: as `evaluate`.
    """
    frames = prepare_frames(labels, results)
    curves = [_curves(frames, {class_name: overlap}, ("3d",)) for overlap in SOFT_OVERLAPS]
    return float(np.mean([curve.r40 for group in curves for curve in group if curve.difficulty != "easy"]))


def label_roles(labels: Sequence[KittiObject], class_name: str, level: int) -> np.ndarray:
    """What each label is to one class and difficulty.

    Args:
      labels: n labels.
      class_name: the class that is evaluated.
      level: 0 easy, 1 moderate, 2 hard.

    Returns:
      (n,) int: 0 counts, 1 is ignored (too hard, or of the neighbouring class), -1 is another class.
    """
    return np.array([_label_role(label, class_name.lower(), level) for label in labels], int)


def _label_role(label: KittiObject, class_name: str, level: int) -> int:
    if label.type.lower() == _NEIGHBOURS.get(class_name):
        return _IGNORED
    if label.type.lower() != class_name:
        return _OTHER
    too_hard = (
        label.occlusion > MAX_OCCLUSION[level]
        or label.truncation > MAX_TRUNCATION[level]
        or label.box_px[3] - label.box_px[1] < MIN_HEIGHT_PX[level]
    )
    return _IGNORED if too_hard else _COUNTS


def _detection_role(detection: KittiObject, class_name: str, level: int) -> int:
    # Whole pixels, and before the class is looked at: as the official evaluator does.
    if int(abs(detection.box_px[1] - detection.box_px[3])) < MIN_HEIGHT_PX[level]:
        return _IGNORED
    return _COUNTS if detection.type.lower() == class_name.lower() else _OTHER


@dataclasses.dataclass(frozen=True)
class PreparedFrame:
    """One frame, with the overlaps that every class, difficulty and threshold shares."""

    labels: Sequence[KittiObject]
    """n of them."""
    detections: Sequence[KittiObject]
    """m of them."""
    scores: np.ndarray
    """(m,) float64."""
    overlaps: Mapping[str, np.ndarray]
    """(n, m) of each metric."""
    excused: Mapping[str, np.ndarray]
    """(m,) of each metric: largest fraction within one DontCare region."""


def prepare_frames(labels: Objects, results: Objects) -> list[PreparedFrame]:
    """Works out what every class, difficulty and threshold shares.

    Args:
      labels: ground truth of each frame, by name.
      results: detections, each with a score, of each of these frames.

    Returns:
      The frames, in the order of the labels.

    Raises:
      ValueError: for frames without results or detections without score.
    """
    missing = sorted(set(labels) - set(results))
    if missing:
        raise ValueError(
            f"{len(missing)} labelled frames have no results, the first is {missing[0]}; "
            "give an empty list for a frame in which nothing was found."
        )
    pairs = [(labels[name], results[name]) for name in labels]
    for name in labels:
        if any(item.score is None for item in results[name]):
            raise ValueError(f"frame {name} has a detection without score; results need 16 columns.")
    spatial = framewise_overlaps([(camera_boxes(a), camera_boxes(b)) for a, b in pairs])
    excused = excused_from_above(pairs)
    return [_build_frame(*pair, *both, e) for pair, both, e in zip(pairs, spatial, excused, strict=True)]


def _build_frame(
    labels: Sequence[KittiObject],
    detections: Sequence[KittiObject],
    bev: np.ndarray,
    box: np.ndarray,
    from_above: np.ndarray,
) -> PreparedFrame:
    image = image_iou(image_boxes(labels), image_boxes(detections))
    in_image = excused_in_image(labels, detections)
    scores = np.array([item.score for item in detections], float)
    overlaps = {"image": image, "orientation": image, "bev": bev, "3d": box}
    nowhere = np.zeros(len(detections))
    excused = {"image": in_image, "orientation": in_image, "bev": from_above, "3d": nowhere}
    return PreparedFrame(labels, detections, scores, overlaps, excused)


def _curves(
    frames: Sequence[PreparedFrame], min_overlap: Mapping[str, float], metrics: Sequence[str]
) -> tuple[PrecisionCurve, ...]:
    return tuple(
        _curve(frames, class_name, metric, level, overlap)
        for class_name, overlap in min_overlap.items()
        for metric in metrics
        for level in range(len(DIFFICULTIES))
    )


def _curve(
    frames: Sequence[PreparedFrame], class_name: str, metric: str, level: int, min_overlap: float
) -> PrecisionCurve:
    rounds = [Round.of(frame, class_name, metric, level, min_overlap) for frame in frames]
    in_turns = metric == "orientation"
    precision = precision_of(rounds, orientation=in_turns)
    if in_turns and any(d.alpha == _INVALID_ALPHA for f in frames for d in f.detections):
        precision = np.zeros_like(precision)
    num_labels = sum(r.num_labels for r in rounds)
    ceiling = _pad(np.ones(len(_recall_thresholds(np.ones(num_labels), num_labels))))
    return PrecisionCurve(class_name, metric, DIFFICULTIES[level], precision, num_labels, ceiling)


def precision_of(rounds: Sequence["Round"], *, orientation: bool = False) -> np.ndarray:
    """Precision over recall: collects the thresholds, then counts right and wrong at each of them.

    Args:
      rounds: the frames, of one class, metric, difficulty and overlap.
      orientation: weigh each right detection by its orientation similarity.

    Returns:
      (41,) float64 in [0, 1], at recall 0, 1/40, ..., 1: the best from there on.
    """
    scores = np.concatenate([np.zeros(0), *(r.matched_scores for r in rounds)])
    thresholds = _recall_thresholds(scores, sum(r.num_labels for r in rounds))
    counts = np.zeros((3, len(thresholds)))
    for r in rounds:
        counts += _count(r, thresholds)
    right, wrong, similarity = counts
    total = right + wrong
    gain = similarity if orientation else right
    precision = _pad(np.divide(gain, total, out=np.zeros_like(total), where=total > 0))
    return np.maximum.accumulate(precision[::-1])[::-1]


def _pad(values: np.ndarray) -> np.ndarray:
    return np.concatenate([values, np.zeros(NUM_SAMPLES)])[:NUM_SAMPLES]


@dataclasses.dataclass(frozen=True)
class Round:
    """One frame as one class, metric and difficulty sees it."""

    label_roles: np.ndarray
    """(labels,) int, as `label_roles`."""
    detection_roles: np.ndarray
    """(detections,) int, likewise."""
    scores: np.ndarray
    """(detections,) float64."""
    overlap: np.ndarray
    """(labels, detections)."""
    candidate: np.ndarray
    """(labels, detections) bool: overlap enough, and neither is of another class."""
    excused: np.ndarray
    """(detections,) bool: covered by a DontCare region."""
    similarity: np.ndarray
    """(labels, detections) orientation similarity, (1 + cos of the difference of alpha) / 2; 0 for the
    metrics that do not look at it."""

    @property
    def num_labels(self) -> int:
        """Labels that count."""
        return int(np.sum(self.label_roles == _COUNTS))

    @functools.cached_property
    def matched_scores(self) -> np.ndarray:
        """Scores of the right detections where each label takes its best-scored candidate."""
        return _matched_scores(self)

    @classmethod
    def of(
        cls, frame: PreparedFrame, class_name: str, metric: str, level: int, min_overlap: float
    ) -> "Round":
        """Takes of a frame what one class, metric, difficulty (0 to 2) and overlap looks at."""
        roles = label_roles(frame.labels, class_name, level)
        detection_roles = np.array([_detection_role(d, class_name, level) for d in frame.detections], int)
        overlap = frame.overlaps[metric]
        used = (roles != _OTHER)[:, None] & (detection_roles != _OTHER)
        in_turns = metric == "orientation"
        return cls(
            label_roles=roles,
            detection_roles=detection_roles,
            scores=frame.scores,
            overlap=overlap,
            candidate=(overlap > min_overlap) & used,
            excused=frame.excused[metric] > min_overlap,
            similarity=_similarity(frame) if in_turns else np.broadcast_to(0.0, overlap.shape),
        )


def _similarity(frame: PreparedFrame) -> np.ndarray:
    label_alpha = np.array([label.alpha for label in frame.labels], float)
    alpha = np.array([detection.alpha for detection in frame.detections], float)
    return (1 + np.cos(label_alpha[:, None] - alpha)) / 2


def _matched_scores(r: Round) -> np.ndarray:
    """Scores of the true positives where each label, in order, takes its best-scored candidate."""
    free = np.ones(len(r.scores), bool)
    scores = []
    for label in np.flatnonzero(r.candidate.any(axis=1)):
        available = r.candidate[label] & free
        if not available.any():
            continue
        chosen = int(np.argmax(np.where(available, r.scores, -np.inf)))
        free[chosen] = False
        if r.label_roles[label] == _COUNTS and r.detection_roles[chosen] == _COUNTS:
            scores.append(r.scores[chosen])
    return np.array(scores, float)


def _recall_thresholds(scores: np.ndarray, num_labels: int) -> np.ndarray:
    """Scores at which recall comes closest to each of its samples, at most 41, descending."""
    scores = np.sort(scores)[::-1]
    thresholds, recall = [], 0.0
    for i, score in enumerate(scores):
        here, following = (i + 1) / num_labels, (i + 2) / num_labels
        # The next score comes closer to this sample of recall; the last one is always taken.
        if i < len(scores) - 1 and following - recall < recall - here:
            continue
        thresholds.append(score)
        recall += 1 / (NUM_SAMPLES - 1)
    return np.array(thresholds[:NUM_SAMPLES], float)


def _count(r: Round, thresholds: np.ndarray) -> np.ndarray:
    """Counts one frame at every threshold T: each label, in order, takes its best-overlapping candidate.

    Candidates of the class come before those that are ignored, of which the first is taken.

    Returns:
      (3, T): right detections, wrong ones, and summed orientation similarity of the right ones.
    """
    free = r.scores >= thresholds[:, None]
    right, similarity = np.zeros(len(thresholds)), np.zeros(len(thresholds))
    counts = r.detection_roles == _COUNTS
    for label in np.flatnonzero(r.candidate.any(axis=1)):
        available = free & r.candidate[label]
        proper = available & counts
        best = np.argmax(np.where(proper, r.overlap[label], -1), axis=1)
        chosen = np.where(proper.any(axis=1), best, np.argmax(available, axis=1))
        matched = np.flatnonzero(available.any(axis=1))
        free[matched, chosen[matched]] = False
        if r.label_roles[label] == _COUNTS:
            hit = matched[counts[chosen[matched]]]
            right[hit] += 1
            similarity[hit] += r.similarity[label, chosen[hit]]
    return np.stack([right, (free & counts & ~r.excused).sum(axis=1), similarity])
