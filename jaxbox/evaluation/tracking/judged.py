"""Boxes against truth: the overlaps of each frame, and which boxes may be of objects that nobody labelled."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from jaxbox.evaluation.iou import framewise_overlaps
from jaxbox.evaluation.tracking.comparison import Comparison
from jaxbox.evaluation.tracking.protocol import is_excused, kept_results
from jaxbox.evaluation.tracking.sequences import FrameBoxes, FrameTruth, TruthSequence, check_frames
from jaxbox.io.kitti import boxes_in_image

METRICS = ("bev", "3d")
"""Overlaps of boxes: in the bird's-eye view, and in 3D."""


@dataclasses.dataclass(frozen=True)
class JudgedFrame:
    """One frame's truth and boxes with what all measures share."""

    truth: FrameTruth
    """A objects."""
    found: FrameBoxes
    """B boxes."""
    overlaps: Mapping[str, np.ndarray]
    """(A, B) in [0, 1], for each of `METRICS`."""
    excused: np.ndarray
    """(B,) bool: not wrong where it matches nothing."""


def judge_sequences(
    truth: Mapping[str, TruthSequence], results: Mapping[str, Sequence[FrameBoxes]]
) -> dict[str, list[JudgedFrame]]:
    """Works out the overlaps of every frame.

    Args:
      truth: by sequence.
      results: boxes of each frame of these sequences.

    Returns:
      The frames of each sequence.

    Raises:
      ValueError: for a sequence without results, or with another number of frames.
    """
    check_frames(truth, results)
    pairs = [
        (frame.boxes, found.boxes)
        for name, sequence in truth.items()
        for frame, found in zip(sequence.frames, results[name], strict=True)
    ]
    overlaps = iter(framewise_overlaps(pairs))
    return {
        name: [
            JudgedFrame(frame, found, dict(zip(METRICS, next(overlaps), strict=True)), excused)
            for frame, found, excused in zip(
                sequence.frames, results[name], _excused(sequence, results[name]), strict=True
            )
        ]
        for name, sequence in truth.items()
    }


def _excused(sequence: TruthSequence, results: Sequence[FrameBoxes]) -> list[np.ndarray]:
    """For each frame (B,) bool, with one projection of all boxes of the sequence."""
    if sequence.calibration is None:
        return [np.zeros(len(found.boxes), bool) for found in results]
    boxes = np.concatenate([np.zeros((0, 7)), *(found.boxes for found in results)])
    boxes_px, _, _ = boxes_in_image(boxes[:, :3], boxes[:, 3:6], boxes[:, 6], sequence.calibration)
    ends = np.cumsum([0, *(len(found.boxes) for found in results)])
    return [
        is_excused(boxes_px[start:end], frame.dont_care_px)
        for frame, start, end in zip(sequence.frames, ends[:-1], ends[1:], strict=True)
    ]


def compare_boxes(frames: Sequence[JudgedFrame], *, metric: str, min_score: float = -np.inf) -> Comparison:
    """What the metrics of tracking look at: KITTI's rules with the overlap of boxes, not of the image.

    Args:
      frames: of one sequence, all with identities.
      metric: one of `METRICS`.
      min_score: boxes of lower score are left out.

    Returns:
      The labels that count, and the boxes that are right or wrong.

    Raises:
      ValueError: for boxes without identities, or an identity twice in one frame.
    """
    true_ids, ids, overlaps = [], [], []
    for frame in frames:
        if frame.found.ids is None and len(frame.found.boxes):
            raise ValueError("single boxes have no identities; only tracks can be compared over time.")
        shown = np.flatnonzero(frame.found.scores >= min_score)
        counts, overlap = np.asarray(frame.truth.counts, bool), frame.overlaps[metric][:, shown]
        kept = kept_results(overlap, counts, frame.excused[shown])
        found_ids = np.zeros(0, int) if frame.found.ids is None else np.asarray(frame.found.ids)
        true_ids.append(np.asarray(frame.truth.ids)[counts])
        ids.append(found_ids[shown][kept])
        overlaps.append(overlap[counts][:, kept])
    return Comparison.of(true_ids, ids, overlaps)
