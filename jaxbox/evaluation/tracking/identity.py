"""Identity: how long each object has one and the same track, with one best pairing of both over the sequence.

    IDF1 = 2 IDTP / (labels + results)

where IDTP counts the frames in which a label and the one track that it is paired with overlap enough.

Reference: Ristani et al., "Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking",
ECCV workshops 2016; the oracle is trackeval.
"""

import dataclasses
from typing import Any

import numpy as np

from jaxbox.evaluation.tracking.clear import MIN_OVERLAP
from jaxbox.evaluation.tracking.comparison import Comparison, Sums, assign, ratio


@dataclasses.dataclass(frozen=True)
class Identity(Sums):
    """Counts of the identity metrics; the figures are in [0, 1]."""

    num_labels: int
    """Labels of all frames."""
    num_boxes: int
    """Results of all frames."""
    num_matches: int
    """Labels in frames where their one track is, IDTP."""

    def to_dict(self) -> dict[str, Any]:
        """Numbers only, for JSON."""
        return {
            "idf1": ratio(2 * self.num_matches, self.num_labels + self.num_boxes),
            "idr": ratio(self.num_matches, self.num_labels),
            "idp": ratio(self.num_matches, self.num_boxes),
            "idtp": self.num_matches,
            "idfn": self.num_labels - self.num_matches,
            "idfp": self.num_boxes - self.num_matches,
        }


def measure_identity(sequence: Comparison, *, min_overlap: float = MIN_OVERLAP) -> Identity:
    """Measures one sequence.

    A pair of identities saves one missed label and one false result in each frame they share, so the best
    pairing is the one with the most shared frames.

    Args:
      sequence: what counts, and its overlaps.
      min_overlap: from which a label and a result may be the same object.

    Returns:
      Its counts; those of several sequences are added.
    """
    shared = np.zeros((sequence.num_true_ids, sequence.num_ids))
    for true_ids, ids, overlap in zip(sequence.true_ids, sequence.ids, sequence.overlaps, strict=True):
        if overlap.size:
            shared[np.ix_(true_ids, ids)] += overlap >= min_overlap
    return Identity(
        num_labels=int(sequence.true_counts.sum()),
        num_boxes=int(sequence.counts.sum()),
        num_matches=int(shared[assign(shared)].sum()) if shared.size else 0,
    )
