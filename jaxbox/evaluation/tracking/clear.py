"""The CLEAR metrics: what is missed, false, and given to another identity than before.

    MOTA = 1 - (FN + FP + IDSW) / labels,  MOTP = mean overlap of the matches

A label keeps the track that it had in the frame before where their overlap allows it; the others are
matched by overlap. A switch is a label whose track is another one than at its last match, however long ago.

Reference: Bernardin, Stiefelhagen, "Evaluating Multiple Object Tracking Performance",
EURASIP 2008; mostly tracked and lost: Li, Huang, Nevatia, CVPR 2009; the oracle is trackeval.
"""

import dataclasses
from typing import Any

import numpy as np

from jaxbox.evaluation.tracking.comparison import Comparison, Sums, assign_above, ratio

MIN_OVERLAP = 0.5
"""Overlap from which a match counts, of CLEAR and of identity, as KITTI has it."""

_KEEP_TRACK = 1000.0
"""Benefit of keeping the last frame's track: more than all overlaps of a frame together."""
_MOSTLY_TRACKED, _MOSTLY_LOST = 0.8, 0.2
_NONE = -1


@dataclasses.dataclass(frozen=True)
class Clear(Sums):
    """Counts of the CLEAR metrics; the figures are at most 1, and MOTA has no lower bound."""

    num_labels: int
    """Labels of all frames."""
    num_boxes: int
    """Results of all frames."""
    num_matches: int
    """Matches, TP."""
    overlap: float
    """Sum of the matches' overlaps."""
    num_switches: int
    """Matches of a label with another track than at its last match, IDSW."""
    num_fragments: int
    """Times that a label is tracked again after it was not, Frag."""
    mostly_tracked: int
    """Labels' identities that are matched in more than .8 of their frames, MT."""
    partly_tracked: int
    """Those between, PT."""
    mostly_lost: int
    """Those matched in fewer than .2, ML."""

    @property
    def num_missed(self) -> int:
        """Labels without a match, FN."""
        return self.num_labels - self.num_matches

    @property
    def num_false(self) -> int:
        """Results without a match, FP."""
        return self.num_boxes - self.num_matches

    @property
    def mota(self) -> float:
        """Accuracy; without labels minus the false results, as trackeval combines sequences."""
        return ratio(self.num_matches - self.num_false - self.num_switches, self.num_labels)

    def to_dict(self) -> dict[str, Any]:
        """Numbers only, for JSON."""
        return {
            "mota": self.mota,
            "motp": ratio(self.overlap, self.num_matches),
            "recall": ratio(self.num_matches, self.num_labels),
            "precision": ratio(self.num_matches, self.num_boxes),
            "num_labels": self.num_labels,
            "num_boxes": self.num_boxes,
            "tp": self.num_matches,
            "fn": self.num_missed,
            "fp": self.num_false,
            "idsw": self.num_switches,
            "frag": self.num_fragments,
            "mt": self.mostly_tracked,
            "pt": self.partly_tracked,
            "ml": self.mostly_lost,
        }


def measure_clear(sequence: Comparison, *, min_overlap: float = MIN_OVERLAP) -> Clear:
    """Measures one sequence.

    Args:
      sequence: what counts, and its overlaps.
      min_overlap: from which a match counts.

    Returns:
      Its counts; those of several sequences are added.
    """
    last, previous = np.full((2, sequence.num_true_ids), _NONE)
    matched, starts = np.zeros((2, sequence.num_true_ids), int)
    total, num_switches = 0.0, 0
    for true_ids, ids, overlap in zip(sequence.true_ids, sequence.ids, sequence.overlaps, strict=True):
        # A frame without labels or without results leaves the tracks of the frame before as they are.
        if not overlap.size:
            continue
        is_kept = ids == previous[true_ids][:, None]
        rows, columns = assign_above(overlap, min_overlap, bonus=_KEEP_TRACK * is_kept)
        found, tracks = true_ids[rows], ids[columns]
        num_switches += int(np.sum((last[found] != _NONE) & (last[found] != tracks)))
        starts[found] += previous[found] == _NONE
        matched[found] += 1
        previous[:] = _NONE
        last[found], previous[found] = tracks, tracks
        total += float(overlap[rows, columns].sum())
    tracked = matched / sequence.true_counts
    num_mostly = int(np.sum(tracked > _MOSTLY_TRACKED))
    num_lost = int(np.sum(tracked < _MOSTLY_LOST))
    return Clear(
        num_labels=int(sequence.true_counts.sum()),
        num_boxes=int(sequence.counts.sum()),
        num_matches=int(matched.sum()),
        overlap=total,
        num_switches=num_switches,
        num_fragments=int(np.sum(np.maximum(starts - 1, 0))),
        mostly_tracked=num_mostly,
        partly_tracked=sequence.num_true_ids - num_mostly - num_lost,
        mostly_lost=num_lost,
    )
