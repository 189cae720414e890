"""Everything that is measured of boxes and tracks over time, as dictionaries for JSON."""

import functools
import itertools
import operator
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxbox.evaluation.tracking.clear import measure_clear
from jaxbox.evaluation.tracking.comparison import Comparison
from jaxbox.evaluation.tracking.detection import FIGURES, detection_curve
from jaxbox.evaluation.tracking.hota import measure_hota
from jaxbox.evaluation.tracking.identity import measure_identity
from jaxbox.evaluation.tracking.judged import METRICS, JudgedFrame, compare_boxes, judge_sequences
from jaxbox.evaluation.tracking.motion import NUM_STATES, motion_errors
from jaxbox.evaluation.tracking.sequences import FrameBoxes, TruthSequence

MEASURES = {"hota": measure_hota, "clear": measure_clear, "identity": measure_identity}
"""Of one sequence; their results are added over sequences."""


def measure_tracks(sequences: Mapping[str, Comparison]) -> dict[str, Any]:
    """HOTA, CLEAR and identity of several sequences, together and each by itself.

    Together they are made of the sums over the sequences, as trackeval combines them: an identity of one
    sequence is another one in the next, and long sequences weigh more.

    Args:
      sequences: at least one.

    Returns:
      Numbers and lists only: "hota", "clear" and "identity", each as the `to_dict` of `Hota`, `Clear` and
      `Identity`, "num_true_ids", "num_ids", and under "by_sequence" the same of each.

    Raises:
      ValueError: without sequences.
    """
    if not sequences:
        raise ValueError("there is no sequence to measure; give at least one.")
    each = {
        name: {key: measure(sequence) for key, measure in MEASURES.items()}
        for name, sequence in sequences.items()
    }
    total = {key: functools.reduce(operator.add, [parts[key] for parts in each.values()]) for key in MEASURES}
    return (
        _counts(sequences.values())
        | {key: part.to_dict() for key, part in total.items()}
        | {
            "by_sequence": {
                name: _counts([sequences[name]]) | {key: part.to_dict() for key, part in parts.items()}
                for name, parts in each.items()
            }
        }
    )


def _counts(sequences: Iterable[Comparison]) -> dict[str, int]:
    sequences = list(sequences)
    return {
        "num_true_ids": sum(sequence.num_true_ids for sequence in sequences),
        "num_ids": sum(sequence.num_ids for sequence in sequences),
    }


def evaluate_boxes(
    truth: Mapping[str, TruthSequence],
    results: Mapping[str, Sequence[FrameBoxes]],
    *,
    min_score: float = -np.inf,
    num_states: int = NUM_STATES,
) -> dict[str, Any]:
    """Measures boxes of whole sequences, be they of single sweeps, of tracks, or of smoothed tracks.

    All are of one class, "vehicle". Average precision takes boxes of every score.

    Args:
      truth: by sequence.
      results: boxes of each frame of these sequences.
      min_score: boxes of lower score are left out of the metrics of tracks and of motion.
      num_states: states of motion that there are, numbered from 0.

    Returns:
      Numbers, strings, lists, dicts and None only:
        "num_sequences", "num_frames";
        "detection": `DetectionCurve.to_dict` at BEV IoU .5 and 3D IoU .7, by "bev_0.5" and "3d_0.7", over
          all sequences, and under "by_sequence" of each;
        "tracks": `measure_tracks` by "bev" and "3d"; None where boxes have no identities;
        "motion": `MotionErrors.to_dict`.

    Raises:
      ValueError: without sequences, or as `judge_sequences`.

    >>> from jaxbox.evaluation.tracking import FrameTruth
    >>> boxes = np.array([[20.0, 3.0, -1.0, 4.0, 1.8, 1.5, 0.1]])
    >>> frame = FrameTruth(boxes, np.array([7]), np.array([True]), np.zeros((0, 4)))
    >>> found = FrameBoxes(boxes, scores=np.array([0.9]), ids=np.array([0]))
    >>> report = evaluate_boxes({"a": TruthSequence([frame])}, {"a": [found]})
    >>> report["detection"]["3d_0.7"]["ap_r40"], report["tracks"]["bev"]["hota"]["hota"]
    (1.0, 1.0)
    """
    if not truth:
        raise ValueError("there is no sequence to measure; give at least one.")
    judged = judge_sequences(truth, results)
    frames = list(itertools.chain.from_iterable(judged.values()))
    tracked = all(frame.found.ids is not None or not len(frame.found.boxes) for frame in frames)
    return {
        "num_sequences": len(judged),
        "num_frames": len(frames),
        "detection": _detection(frames)
        | {"by_sequence": {name: _detection(part) for name, part in judged.items()}},
        "tracks": {
            metric: measure_tracks(
                {
                    name: compare_boxes(part, metric=metric, min_score=min_score)
                    for name, part in judged.items()
                }
            )
            for metric in METRICS
        }
        if tracked
        else None,
        "motion": motion_errors(frames, num_states=num_states, min_score=min_score).to_dict(),
    }


def _detection(frames: Sequence[JudgedFrame]) -> dict[str, Any]:
    return {
        f"{metric}_{overlap:g}": detection_curve(frames, metric=metric, min_overlap=overlap).to_dict()
        for metric, overlap in FIGURES
    }
