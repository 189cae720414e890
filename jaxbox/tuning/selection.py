"""Which setting to take, and what it scores on drives that did not choose it.

The best of many settings on the frames that chose it is flattered: some of its gain is luck. So for each
drive the best setting on all other drives is taken, this drive's frames are scored with it, and all frames
held out in this way are scored together.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Generic, TypeVar

import numpy as np

from jaxbox.types import Status

Match = TypeVar("Match")
"""What a score is made of, for one frame."""

NOISE = 1.0
"""Points of the objective that turning the sweeps alone can move; smaller gains are not evidence."""
NUM_DRAWS = 50
"""Of the groups, with replacement (bootstrap), to say how much a gain hangs on which drives there are."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trial(Generic[Match]):
    """One setting and what it scored."""

    index: int
    """0 is the base."""
    changes: Mapping[str, float]
    """Thresholds that differ from the base, by dotted name."""
    blind: bool
    """Whether it was proposed without a look at any label; only such ones may stand for a held-out drive."""
    matches: Sequence[Mapping[str, Match]]
    """For each copy, each frame."""
    scores: tuple[float, ...]
    """For each copy, over all frames."""
    scores_without: Mapping[str, tuple[float, ...]]
    """For each group, for each copy, over the frames of all other groups."""
    status: Status = Status.OK
    """Together of all sweeps."""
    seconds: float = 0.0
    """What it took."""

    @property
    def mean(self) -> float:
        """Over the copies."""
        return float(np.mean(self.scores))


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeldOut:
    """The honest figures."""

    chosen: Mapping[str, int]
    """For each group, the trial that all other groups chose."""
    scores: tuple[float, ...]
    """For each copy: all frames together, each with the setting that was chosen without it."""
    base_scores: tuple[float, ...]
    """For each copy, the base over all frames."""
    group_scores: Mapping[str, tuple[float, float]]
    """For each group by itself, mean over the copies: the base, and the setting chosen without it."""
    group_spread: float
    """Standard deviation of the gain over groups that are drawn again with replacement."""

    @property
    def times_chosen(self) -> dict[int, int]:
        """How many groups chose each trial, most first."""
        return dict(Counter(self.chosen.values()).most_common())

    @property
    def gain(self) -> float:
        """Mean over the copies of what was won over the base."""
        return float(np.mean(np.subtract(self.scores, self.base_scores)))

    @property
    def spread(self) -> float | None:
        """Standard deviation of the gain over the copies; None for one copy."""
        gains = np.subtract(self.scores, self.base_scores)
        return float(np.std(gains, ddof=1)) if len(gains) > 1 else None

    @property
    def noise(self) -> float:
        """The gain must exceed this: its spreads over copies and groups, and at least `NOISE`."""
        return max(NOISE, self.spread or 0.0, self.group_spread)

    @property
    def keep_base(self) -> bool:
        """Whether the gain is within the noise."""
        return self.gain <= self.noise


def score_without(
    matches: Sequence[Mapping[str, Match]],
    groups: Mapping[str, str],
    score: Callable[[Iterable[Match]], float],
) -> dict[str, tuple[float, ...]]:
    """Scores all frames but one group's, for each group.

    Args:
      matches: for each copy, each frame.
      groups: the group of each frame.
      score: of some frames.

    Returns:
      For each group, the score of each copy.
    """
    return {
        left_out: tuple(score(m for name, m in copy.items() if groups[name] != left_out) for copy in matches)
        for left_out in dict.fromkeys(groups.values())
    }


def best_trial(trials: Sequence[Trial[Match]]) -> Trial[Match]:
    """The trial of the best mean over the copies; the first of equals, so that the base wins a draw."""
    return max(trials, key=lambda trial: (trial.mean, -trial.index))


def leave_one_out(
    trials: Sequence[Trial[Match]],
    groups: Mapping[str, str],
    score: Callable[[Iterable[Match]], float],
) -> HeldOut | None:
    """Scores each group with the setting that the others chose.

    Args:
      trials: the base first; those that are not blind are not chosen from.
      groups: the group of each frame.
      score: of some frames, which may be of different settings.

    Returns:
      The held-out figures; None with fewer than two groups, as there is nothing left to choose by.
    """
    names = list(dict.fromkeys(groups.values()))
    if len(names) < 2:
        return None
    blind = {trial.index: trial for trial in trials if trial.blind}
    chosen = {
        name: max(blind, key=lambda index: (np.mean(blind[index].scores_without[name]), -index))
        for name in names
    }
    held_out = {name: blind[index] for name, index in chosen.items()}
    copies = range(len(trials[0].matches))
    scores = tuple(
        score(held_out[group].matches[copy][frame] for frame, group in groups.items()) for copy in copies
    )
    members = _members(groups)
    group_scores = {
        name: (_group_mean(trials[0], frames, score), _group_mean(held_out[name], frames, score))
        for name, frames in members.items()
    }
    return HeldOut(
        chosen=chosen,
        scores=scores,
        base_scores=trials[0].scores,
        group_scores=group_scores,
        group_spread=_group_spread(trials[0], held_out, members, score),
    )


def _group_spread(
    base: Trial[Match],
    held_out: Mapping[str, Trial[Match]],
    members: Mapping[str, Sequence[str]],
    score: Callable[[Iterable[Match]], float],
) -> float:
    """Standard deviation of the gain over the groups drawn again: both settings see the same draw."""
    if all(trial is base for trial in held_out.values()):
        return 0.0
    random = np.random.default_rng(0)
    gains = []
    for _ in range(NUM_DRAWS):
        drawn = random.choice(sorted(members), len(members))
        frames = [(name, frame) for name in drawn for frame in members[name]]
        gains.append(
            [
                score(held_out[name].matches[copy][frame] for name, frame in frames)
                - score(base.matches[copy][frame] for _, frame in frames)
                for copy in range(len(base.matches))
            ]
        )
    return float(np.std(np.mean(gains, axis=1)))


def _members(groups: Mapping[str, str]) -> dict[str, list[str]]:
    members: dict[str, list[str]] = {}
    for frame, group in groups.items():
        members.setdefault(group, []).append(frame)
    return members


def _group_mean(
    trial: Trial[Match], frames: Sequence[str], score: Callable[[Iterable[Match]], float]
) -> float:
    return float(np.mean([score(copy[frame] for frame in frames) for copy in trial.matches]))
