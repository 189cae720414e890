"""Figures to choose settings by, of any set of frames, from matches that are worked out once a frame."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from jaxbox.evaluation import kitti

MODERATE, HARD = 1, 2

Matched = tuple[kitti.Round, ...]
"""One frame as an objective looks at it: a round for each overlap and difficulty, without the boxes."""


@dataclasses.dataclass(frozen=True)
class Objective:
    """A mean of average precisions (R40)."""

    title: str
    """In words."""
    metric: str
    """One of `kitti.METRICS`."""
    min_overlaps: tuple[float, ...]
    """Overlaps that a match must exceed."""
    levels: tuple[int, ...]
    """Difficulties: 0 easy, 1 moderate, 2 hard."""
    class_name: str = "Car"
    """The class."""

    def match(self, labels: kitti.Objects, results: kitti.Objects) -> dict[str, Matched]:
        """Matches results with labels, each frame by itself.

        Args:
          labels: ground truth of each frame, by name.
          results: detections, each with a score, of each of these frames.

        Returns:
          The rounds of each frame, by name.

        Raises:
          ValueError: for frames without results or detections without score.
        """
        frames = kitti.prepare_frames(labels, results)
        return {
            name: tuple(
                kitti.Round.of(frame, self.class_name, self.metric, level, overlap)
                for overlap in self.min_overlaps
                for level in self.levels
            )
            for name, frame in zip(labels, frames, strict=True)
        }

    def score(self, frames: Iterable[Matched]) -> float:
        """The figure over some frames.

        Args:
          frames: from `match`, each of any settings.

        Returns:
          In [0, 100]; 0 without labels.
        """
        by_round: Sequence[tuple[kitti.Round, ...]] = list(zip(*frames, strict=True))
        if not by_round:
            return 0.0
        precisions = [kitti.precision_of(rounds) for rounds in by_round]
        return float(np.mean([kitti.average_precision(p, r11=False) for p in precisions]))


OBJECTIVES: Mapping[str, Objective] = {
    "soft": Objective("SOFT (3D AP over overlaps .60 to .75)", "3d", kitti.SOFT_OVERLAPS, (MODERATE, HARD)),
    "3d": Objective("3D AP moderate", "3d", (kitti.MIN_OVERLAP["Car"],), (MODERATE,)),
    "bev": Objective("BEV AP moderate", "bev", (kitti.MIN_OVERLAP["Car"],), (MODERATE,)),
}
"""Of cars. ``soft`` is `kitti.soft_score`: one borderline car weighs less in it than at one overlap."""
