"""Errors of motion where the truth has it: velocities, headings, and states such as standing or turning."""

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxbox.evaluation import matching
from jaxbox.evaluation.tracking.judged import JudgedFrame
from jaxbox.types import Motion

MATCH_OVERLAP = 0.2
"""Bird's-eye IoU from which motion is compared: a car with its length and width swapped is among them."""

MIN_MOVING_SPEED = 1.0
"""m/s: what is slower stands; walking pace is faster."""

HEADING_LIMITS_DEG = (90, 10)
"""The first tells front from back, the second says how often a heading can be used."""

NUM_STATES = len(Motion)
"""Standing, starting, moving, stopping, turning, and a change of lanes."""

_QUANTILE = 0.9


@dataclasses.dataclass(frozen=True)
class MotionErrors:
    """Errors of the boxes that were matched to objects that count."""

    heading_errors: np.ndarray
    """(n,) float64, rad, in [0, pi]: of every match."""
    true_speeds: np.ndarray
    """(m,) float64, m/s: of the matches that have both velocities."""
    velocity_errors: np.ndarray
    """(m,) float64, m/s: length of the difference of the two velocities."""
    confusion: np.ndarray
    """(S, S) int: matches by true state (row) and state found (column)."""

    def to_dict(self) -> dict[str, Any]:
        """Numbers, lists and None only, for JSON; None where nothing was compared."""
        degrees = np.degrees(self.heading_errors)
        within = {
            f"within_{limit}_deg": float(np.mean(degrees <= limit)) if len(degrees) else None
            for limit in HEADING_LIMITS_DEG
        }
        moving = self.true_speeds > MIN_MOVING_SPEED
        right, all_states = int(np.trace(self.confusion)), int(self.confusion.sum())
        return {
            "min_bev_iou": MATCH_OVERLAP,
            "headings": {"num": len(degrees)} | within,
            "velocity_moving": _spread(self.velocity_errors[moving]),
            "velocity_standing": _spread(self.velocity_errors[~moving]),
            "states": {
                "num": all_states,
                "right": right / all_states if all_states else None,
                "confusion": self.confusion.tolist(),
            },
        }


def _spread(errors: np.ndarray) -> dict[str, Any]:
    if not len(errors):
        return {"num": 0, "median": None, "p90": None}
    return {
        "num": len(errors),
        "median": float(np.median(errors)),
        "p90": float(np.quantile(errors, _QUANTILE)),
    }


def motion_errors(
    frames: Iterable[JudgedFrame], *, num_states: int = NUM_STATES, min_score: float = -np.inf
) -> MotionErrors:
    """Compares the motion of boxes and objects that belong together.

    Args:
      frames: of any sequences.
      num_states: S, states of motion, numbered from 0.
      min_score: boxes of lower score are left out.

    Returns:
      The errors. Velocities that either side does not know, and states of -1, are left out.

    Raises:
      ValueError: for a state beyond the number of states.
    """
    headings, speeds, errors = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    confusion = np.zeros((num_states, num_states), int)
    for frame in frames:
        truth, found = frame.truth, frame.found
        overlap = np.where(np.asarray(found.scores) >= min_score, frame.overlaps["bev"], 0)
        partner = matching.match(overlap, np.asarray(truth.counts, bool), min_overlap=MATCH_OVERLAP)
        objects = np.flatnonzero(np.asarray(truth.counts, bool) & (partner >= 0))
        boxes = partner[objects]
        headings.append(_angles_between(truth.boxes[objects, 6], found.boxes[boxes, 6]))
        if truth.velocities is not None and found.velocities is not None:
            true, estimated = truth.velocities[objects], found.velocities[boxes]
            known = np.isfinite(true).all(axis=1) & np.isfinite(estimated).all(axis=1)
            speeds.append(np.linalg.norm(true[known], axis=1))
            errors.append(np.linalg.norm((estimated - true)[known], axis=1))
        if truth.states is not None and found.states is not None:
            pair = np.stack([truth.states[objects], found.states[boxes]]).astype(int)
            if pair.max(initial=0) >= num_states:
                raise ValueError(f"state {pair.max()} is beyond the {num_states} states; raise num_states.")
            np.add.at(confusion, tuple(pair[:, (pair >= 0).all(axis=0)]), 1)
    return MotionErrors(
        heading_errors=np.concatenate(headings),
        true_speeds=np.concatenate(speeds),
        velocity_errors=np.concatenate(errors),
        confusion=confusion,
    )


def _angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """rad, in [0, pi]."""
    return np.abs(np.angle(np.exp(1j * (np.asarray(a, float) - np.asarray(b, float)))))
