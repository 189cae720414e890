"""HOTA: detection and association in one figure, as the mean over how well a match has to fit.

At each overlap limit alpha, with the matches TP and what is missed (FN) and false (FP):

    DetA = TP / (TP + FN + FP),  AssA = mean over TP of |TPA| / |TPA + FNA + FPA|,  HOTA = sqrt(DetA AssA)

where TPA of a match are all matches of the same label and the same track, FNA and FPA the other frames
of either. Frames are matched by overlap times how well the two identities agree over the whole sequence.

Reference: Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", IJCV 2021;
the oracle is trackeval.
"""

import dataclasses
from typing import Any

import numpy as np

from jaxbox.evaluation.tracking.comparison import EPSILON, Comparison, Sums, assign

ALPHAS = np.arange(0.05, 0.99, 0.05)
"""The 19 overlaps that HOTA averages over, from the paper."""

_MIN_SUM = 1e-10
"""Without any match the mean overlap of matches is 1, as trackeval has it."""


@dataclasses.dataclass(frozen=True)
class Hota(Sums):
    """Sums over the matches at each of the 19 `ALPHAS`; the figures are in [0, 1]."""

    num_labels: int
    """Labels of all frames."""
    num_boxes: int
    """Results of all frames."""
    num_matches: np.ndarray
    """(19,) int: matches, TP."""
    overlap: np.ndarray
    """(19,) sum of the matches' overlaps."""
    association: np.ndarray
    """(19,) sum of |TPA| / |TPA + FNA + FPA| over the matches."""
    association_recall: np.ndarray
    """(19,) sum of |TPA| / |TPA + FNA|."""
    association_precision: np.ndarray
    """(19,) sum of |TPA| / |TPA + FPA|."""

    @property
    def det_re(self) -> np.ndarray:
        """(19,) matches of the labels."""
        return self.num_matches / max(self.num_labels, 1)

    @property
    def det_pr(self) -> np.ndarray:
        """(19,) matches of the results."""
        return self.num_matches / max(self.num_boxes, 1)

    @property
    def det_a(self) -> np.ndarray:
        """(19,) matches of all that is matched, missed or false."""
        return self.num_matches / np.maximum(self.num_labels + self.num_boxes - self.num_matches, 1)

    @property
    def ass_a(self) -> np.ndarray:
        """(19,) mean association over the matches."""
        return self.association / np.maximum(self.num_matches, 1)

    @property
    def ass_re(self) -> np.ndarray:
        """(19,) mean association recall."""
        return self.association_recall / np.maximum(self.num_matches, 1)

    @property
    def ass_pr(self) -> np.ndarray:
        """(19,) mean association precision."""
        return self.association_precision / np.maximum(self.num_matches, 1)

    @property
    def loc_a(self) -> np.ndarray:
        """(19,) mean overlap of the matches; 1 without any."""
        return np.maximum(self.overlap, _MIN_SUM) / np.maximum(self.num_matches, _MIN_SUM)

    @property
    def hota(self) -> np.ndarray:
        """(19,) the square root of detection times association."""
        return np.sqrt(self.det_a * self.ass_a)

    def to_dict(self) -> dict[str, Any]:
        """Means over the alphas, and under "by_alpha" every one, for JSON."""
        names = ("hota", "det_a", "ass_a", "loc_a", "det_re", "det_pr", "ass_re", "ass_pr")
        curves = {name: getattr(self, name) for name in names}
        return {name: float(curve.mean()) for name, curve in curves.items()} | {
            "by_alpha": {"alpha": ALPHAS.round(2).tolist()}
            | {name: curve.tolist() for name, curve in curves.items()}
        }


def measure_hota(sequence: Comparison) -> Hota:
    """Measures one sequence.

    Args:
      sequence: what counts, and its overlaps.

    Returns:
      Its sums; those of several sequences are added.
    """
    true_ids, ids, overlaps = _matches(sequence)
    hits = (overlaps[:, None] >= ALPHAS - EPSILON).astype(float)
    # Only pairs of identities that are matched in some frame: all of them would be a million and more.
    pairs, pair = np.unique(np.stack([true_ids, ids]), axis=1, return_inverse=True)
    together = np.zeros((pairs.shape[1], len(ALPHAS)))
    np.add.at(together, pair.ravel(), hits)
    true_counts = sequence.true_counts[pairs[0]][:, None]
    counts = sequence.counts[pairs[1]][:, None]
    return Hota(
        num_labels=int(sequence.true_counts.sum()),
        num_boxes=int(sequence.counts.sum()),
        num_matches=hits.sum(axis=0).astype(int),
        overlap=overlaps @ hits,
        association=(together * together / (true_counts + counts - together)).sum(axis=0),
        association_recall=(together * together / true_counts).sum(axis=0),
        association_precision=(together * together / counts).sum(axis=0),
    )


def _matches(sequence: Comparison) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Identities and overlap of each matched pair, over all frames; the limits alpha come afterwards."""
    alignment = _alignment(sequence)
    found = [(np.zeros(0, int), np.zeros(0, int), np.zeros(0))]
    for true_ids, ids, overlap in zip(sequence.true_ids, sequence.ids, sequence.overlaps, strict=True):
        if overlap.size:
            rows, columns = assign(alignment[np.ix_(true_ids, ids)] * overlap)
            found.append((true_ids[rows], ids[columns], overlap[rows, columns]))
    true_ids, ids, overlaps = (np.concatenate(part) for part in zip(*found, strict=True))
    return true_ids, ids, overlaps


def _alignment(sequence: Comparison) -> np.ndarray:
    """(true ids, ids) how well two identities agree over the sequence: a soft Jaccard index."""
    shared = np.zeros((sequence.num_true_ids, sequence.num_ids))
    for true_ids, ids, overlap in zip(sequence.true_ids, sequence.ids, sequence.overlaps, strict=True):
        if overlap.size:
            total = overlap.sum(axis=0)[None] + overlap.sum(axis=1)[:, None] - overlap
            share = np.divide(overlap, total, out=np.zeros_like(overlap), where=total > EPSILON)
            shared[np.ix_(true_ids, ids)] += share
    return shared / (sequence.true_counts[:, None] + sequence.counts[None] - shared)
