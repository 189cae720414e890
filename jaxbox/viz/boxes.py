"""Boxes as the pictures need them: host arrays, corners, edges, and which agree with the truth."""

import dataclasses

import cv2
import numpy as np

from jaxbox._box import box_corners, footprints
from jaxbox.types import Detections, Label
from jaxbox.viz.colors import Color

MATCH_IOU = 0.5
"""An estimate with at least this bird's-eye view IoU to a true box has found it."""

EDGES = np.array(
    [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
)
"""Pairs of corners: floor, roof, uprights."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BoxSet:
    """Boxes on the host, without padding.

    >>> BoxSet(center=[[10, 0, -1]], size=[[4, 2, 1.5]], yaw=[0]).corners()[0, 0].tolist()
    [12.0, 1.0, -1.75]
    """

    center: np.ndarray
    """(K, 3) float64, m, sensor frame."""
    size: np.ndarray
    """(K, 3) float64, m: length, width, height."""
    yaw: np.ndarray
    """(K,) float64, rad, from +x about +z."""
    captions: tuple[str, ...] = ()
    """K short texts, or none."""
    rank: np.ndarray | None = None
    """(K,) float64: the higher is matched first; None keeps the order."""

    def __post_init__(self) -> None:
        """Converts to float64 arrays, so that lists are accepted too."""
        for name, columns in (("center", (3,)), ("size", (3,)), ("yaw", ())):
            array = np.asarray(getattr(self, name), np.float64).reshape(-1, *columns)
            object.__setattr__(self, name, array)
        if not len(self.center) == len(self.size) == len(self.yaw):
            raise ValueError(
                f"center, size and yaw have {len(self.center)}, {len(self.size)} and {len(self.yaw)} rows; "
                "they must have one a box."
            )

    def __len__(self) -> int:
        """K."""
        return len(self.yaw)

    @classmethod
    def from_detections(cls, detections: Detections, *, min_score: float = 0.0) -> "BoxSet":
        """Takes the valid boxes of one sweep, best first, with class and score as captions.

        Args:
          detections: the answer for one sweep, unbatched.
          min_score: boxes with lower scores are not drawn.

        Returns:
          At most K boxes.
        """
        score = np.asarray(detections.score, np.float64)
        keep = np.asarray(detections.valid) & (score >= min_score)
        labels = np.asarray(detections.label)[keep]
        captions = [f"{Label(label).word} {s:.2f}" for label, s in zip(labels, score[keep], strict=True)]
        return cls(
            center=np.asarray(detections.center)[keep],
            size=np.asarray(detections.size)[keep],
            yaw=np.asarray(detections.yaw)[keep],
            captions=tuple(captions),
            rank=score[keep],
        )

    def take(self, rows: np.ndarray) -> "BoxSet":
        """Some of the boxes: rows is (k,) int or (K,) bool.

        >>> size = [[4, 2, 1]] * 2
        >>> pair = BoxSet(center=[[1, 0, 0], [9, 0, 0]], size=size, yaw=[0, 0], captions=("a", "b"))
        >>> pair.take(np.array([False, True])).captions
        ('b',)
        """
        chosen = np.arange(len(self))[rows]
        return BoxSet(
            center=self.center[chosen],
            size=self.size[chosen],
            yaw=self.yaw[chosen],
            captions=tuple(self.captions[row] for row in chosen) if self.captions else (),
            rank=None if self.rank is None else np.asarray(self.rank)[chosen],
        )

    def footprints(self) -> np.ndarray:
        """(K, 4, 2) float64, m: corners in the bird's-eye view, counter-clockwise from front left."""
        return footprints(self.center, self.size, self.yaw)

    def corners(self) -> np.ndarray:
        """(K, 8, 3) float64, m: the four corners of the floor, then of the roof."""
        return box_corners(self.center, self.size, self.yaw)

    def segments(self) -> np.ndarray:
        """(K, 12, 2, 3) float64, m: the edges."""
        return self.corners()[:, EDGES]


@dataclasses.dataclass(frozen=True, kw_only=True)
class BoxGroup:
    """Boxes that mean the same and look the same."""

    name: str
    """What they are, for the legend."""
    boxes: BoxSet
    """The boxes."""
    color: Color
    """Red, green, blue."""
    thickness_px: int = 2
    """Width of their lines."""
    caption_below: bool = False
    """Whether captions stand below the boxes, where those of other boxes in the same place leave room."""


def bird_eye_iou(boxes: BoxSet, others: BoxSet) -> np.ndarray:
    """Intersection over union of the footprints of every pair.

    Args:
      boxes: K boxes.
      others: L boxes.

    Returns:
      (K, L) float64, in [0, 1].

    Reference: `cv2.rotatedRectangleIntersection`.
    """
    return np.array(
        [[_footprint_iou(a, b) for b in _rectangles(others)] for a in _rectangles(boxes)]
    ).reshape(len(boxes), len(others))


def find_matches(boxes: BoxSet, truth: BoxSet) -> tuple[np.ndarray, np.ndarray]:
    """Pairs estimates with true boxes, greedily from the best estimate, one to one.

    Args:
      boxes: K estimates.
      truth: L true boxes.

    Returns:
      (K,) bool: the estimate has found a true box; (L,) bool: the true box was found.
    """
    pairs = pair_boxes(boxes, truth)
    return pairs >= 0, np.isin(np.arange(len(truth)), pairs)


def pair_boxes(boxes: BoxSet, truth: BoxSet) -> np.ndarray:
    """As `find_matches`, which true box each estimate has found.

    Args:
      boxes: K estimates.
      truth: L true boxes.

    Returns:
      (K,) int: its row; -1 for an estimate that has found none.
    """
    iou = bird_eye_iou(boxes, truth)
    pairs, free = np.full(len(boxes), -1), np.ones(len(truth), bool)
    order = np.arange(len(boxes)) if boxes.rank is None else np.argsort(-boxes.rank, kind="stable")
    for row in order:
        left = np.where(free, iou[row], 0.0)
        if len(left) and left.max() >= MATCH_IOU:
            pairs[row] = left.argmax()
            free[pairs[row]] = False
    return pairs


_Rectangle = tuple[tuple[float, float], tuple[float, float], float]


def _rectangles(boxes: BoxSet) -> list[_Rectangle]:
    rows = zip(boxes.center[:, :2].tolist(), boxes.size[:, :2].tolist(), np.degrees(boxes.yaw), strict=True)
    return [((x, y), (length, width), float(angle)) for (x, y), (length, width), angle in rows]


def _footprint_iou(a: _Rectangle, b: _Rectangle) -> float:
    _, region = cv2.rotatedRectangleIntersection(a, b)
    shared = 0.0 if region is None else float(cv2.contourArea(cv2.convexHull(region)))
    total = a[1][0] * a[1][1] + b[1][0] * b[1][1] - shared
    return shared / total if total > 0 else 0.0
