"""Detection figures of the same boxes, so that single sweeps and tracks stand side by side.

Boxes take objects in the order of their scores: each the object of best overlap that is free, one that counts
if there is any. A box of an object that does not count is ignored, and so is one of no object where nobody
labelled; a second box of the same object is wrong, as in KITTI's protocol.
Precision and recall are those of all boxes from a score on, so boxes of one score come in together.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxbox.evaluation.tracking.comparison import EPSILON
from jaxbox.evaluation.tracking.judged import JudgedFrame

FIGURES = (("bev", 0.5), ("3d", 0.7))
"""Metric and overlap of the figures that are reported."""

PRECISIONS = (0.90, 0.95)
"""Recall is reported where precision is at least this."""

_NUM_SAMPLES = 40
_RIGHT, _WRONG, _LEFT_OUT = 1, 0, -1


@dataclasses.dataclass(frozen=True)
class DetectionCurve:
    """Precision over recall of one metric and overlap."""

    metric: str
    """"bev" or "3d"."""
    min_overlap: float
    """IoU that a match needs."""
    num_labels: int
    """Objects that count."""
    num_boxes: int
    """Boxes that are right or wrong."""
    scores: np.ndarray
    """(S,) the different scores, falling."""
    recall: np.ndarray
    """(S,) of all boxes from each score on; without objects 0."""
    precision: np.ndarray
    """(S,) likewise."""

    @property
    def average_precision(self) -> float | None:
        """R40: mean over recalls 1/40, ... 1 of the best precision from there on; None without objects."""
        if self.num_labels == 0:
            return None
        samples = np.arange(1, _NUM_SAMPLES + 1) / _NUM_SAMPLES
        best = np.append(np.maximum.accumulate(self.precision[::-1])[::-1], 0)
        return float(best[np.searchsorted(self.recall, samples - EPSILON)].mean())

    def recall_at(self, precision: float) -> float | None:
        """Greatest recall at which precision reaches a bound.

        Args:
          precision: the bound.

        Returns:
          In [0, 1]; 0 where it is never reached, None without objects.
        """
        if self.num_labels == 0:
            return None
        return float(self.recall[self.precision >= precision - EPSILON].max(initial=0))

    @property
    def max_recall(self) -> float | None:
        """Recall of all boxes; None without objects."""
        return float(self.recall.max(initial=0)) if self.num_labels else None

    def to_dict(self) -> dict[str, Any]:
        """Numbers, strings and None only, for JSON."""
        return {
            "metric": self.metric,
            "min_overlap": self.min_overlap,
            "num_labels": self.num_labels,
            "num_boxes": self.num_boxes,
            "ap_r40": self.average_precision,
            "max_recall": self.max_recall,
        } | {f"recall_at_{round(100 * p)}": self.recall_at(p) for p in PRECISIONS}


def detection_curve(
    frames: Iterable[JudgedFrame], *, metric: str = "bev", min_overlap: float = 0.5
) -> DetectionCurve:
    """Precision over recall of the boxes of any number of frames.

    Args:
      frames: of any sequences.
      metric: "bev" or "3d".
      min_overlap: IoU that a match needs.

    Returns:
      The curve, empty without boxes.
    """
    frames = list(frames)
    none = np.zeros(0)
    outcome = np.concatenate([none, *(_outcomes(frame, metric, min_overlap) for frame in frames)])
    scores = np.concatenate([none, *(np.asarray(frame.found.scores, float) for frame in frames)])
    scores, outcome = scores[outcome != _LEFT_OUT], outcome[outcome != _LEFT_OUT]
    order = np.argsort(-scores, kind="stable")
    different, last = np.unique(-scores[order], return_index=True)
    # Boxes of one score end where those of the next begin.
    ends = np.append(last[1:], len(order))[: len(different)]
    right = np.append(0, np.cumsum(outcome[order]))[ends]
    num_labels = sum(int(np.sum(frame.truth.counts)) for frame in frames)
    return DetectionCurve(
        metric=metric,
        min_overlap=min_overlap,
        num_labels=num_labels,
        num_boxes=len(order),
        scores=-different,
        recall=right / max(num_labels, 1),
        precision=right / np.maximum(ends, 1),
    )


def _outcomes(frame: JudgedFrame, metric: str, min_overlap: float) -> np.ndarray:
    """(B,) whether each box is right, wrong or ignored."""
    counts = np.asarray(frame.truth.counts, bool)
    free = np.where(frame.overlaps[metric] >= min_overlap - EPSILON, frame.overlaps[metric], 0)
    outcome = np.where(frame.excused, _LEFT_OUT, _WRONG)
    # Most boxes of a frame overlap nothing; only the others take part.
    near = np.flatnonzero(free.any(axis=0))
    for box in near[np.argsort(-np.asarray(frame.found.scores)[near], kind="stable")]:
        # An object that counts goes before one that does not, whatever their overlaps.
        taken = int(np.argmax(free[:, box] + (counts & (free[:, box] > 0))))
        if free[taken, box] > 0:
            outcome[box] = _RIGHT if counts[taken] else _LEFT_OUT
            free[taken] = 0
    return outcome
