"""Scoring one setting: every copy of every frame through the one compiled detector."""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence

import jax
import numpy as np

from jaxbox._padding import fitting_capacity
from jaxbox.config import DetectorConfig
from jaxbox.config.fields import replace_fields
from jaxbox.evaluation.copies import Copy, Frame, detect_copy
from jaxbox.evaluation.objectives import Matched, Objective
from jaxbox.run.compiled import detect
from jaxbox.tuning.selection import Trial, score_without
from jaxbox.tuning.space import Changes
from jaxbox.types import PointCloud, Status


def _nothing() -> None:
    pass


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bench:
    """What every setting is tried on."""

    base: DetectorConfig
    """The settings that trials change."""
    frames: Sequence[Frame]
    """The labelled sweeps."""
    groups: Mapping[str, str]
    """The drive of each frame, or another group that is held out together."""
    copies: Sequence[Copy]
    """How the sweeps are turned."""
    objective: Objective
    """What a good setting is."""
    group_kind: str = "drive"
    """What a group is, in a word: "drive", "folder" or "sweep"."""

    @property
    def capacity(self) -> int:
        """Points that every sweep is padded to: one for all, so that there is one compile."""
        most = max(len(frame.xyz) for frame in self.frames)
        return fitting_capacity(most)

    @property
    def sweeps_per_trial(self) -> int:
        """Calls of the detector that one setting takes."""
        return len(self.frames) * len(self.copies)

    def ceilings(self) -> tuple[float, dict[str, float]]:
        """What perfect answers score over all frames, and over those of each group."""
        labels = {frame.name: frame.labels for frame in self.frames}
        answers = {
            name: [dataclasses.replace(item, score=1.0) for item in items if not item.is_dont_care]
            for name, items in labels.items()
        }
        matches = self.objective.match(labels, answers)
        by_group = {
            group: self.objective.score(matches[name] for name in labels if self.groups[name] == group)
            for group in dict.fromkeys(self.groups.values())
        }
        return self.objective.score(matches.values()), by_group

    def warm_up(self) -> float:
        """Compiles the detector on an empty sweep, and returns the seconds that it took."""
        start = time.perf_counter()
        empty = PointCloud.from_numpy(np.zeros((0, 3), np.float32), capacity=self.capacity)
        jax.block_until_ready(detect(empty, self.base))
        return time.perf_counter() - start

    def run(
        self, index: int, changes: Changes, *, blind: bool, on_sweep: Callable[[], None] = _nothing
    ) -> Trial[Matched]:
        """Scores one setting.

        Args:
          index: number of the trial.
          changes: thresholds that differ from the base.
          blind: see `Trial`.
          on_sweep: called after each sweep.

        Returns:
          The trial.

        Raises:
          ValueError: for changes that `replace_fields` refuses.
        """
        start = time.perf_counter()
        config = replace_fields(self.base, changes)
        labels = {frame.name: frame.labels for frame in self.frames}
        matches, status = [], Status.OK
        for copy in self.copies:
            results = {}
            for frame in self.frames:
                results[frame.name], bits = detect_copy(frame, copy, config, capacity=self.capacity)
                status |= bits
                on_sweep()
            matches.append(self.objective.match(labels, results))
        return Trial(
            index=index,
            changes=changes,
            blind=blind,
            matches=matches,
            scores=tuple(self.objective.score(copy.values()) for copy in matches),
            scores_without=score_without(matches, self.groups, self.objective.score),
            status=status,
            seconds=time.perf_counter() - start,
        )
