"""Which settings are tried: a box of thresholds, filled evenly, then searched round its best point."""

import dataclasses
import math
from collections.abc import Generator, Mapping, Sequence

import numpy as np

from jaxbox.config import DetectorConfig
from jaxbox.config.fields import check_traced, traced_fields, traced_ranges
from jaxbox.config.ranges import checked_number

Changes = Mapping[str, float]
"""Thresholds by dotted name that differ from the base."""

DEFAULT_RATIOS: Mapping[str, float] = {
    "ground.min_height_m": 1.25,
    "clustering.min_points": 1.5,
    "box.slab_max_height_m": 1.25,
    "completion.free_weight": 2.0,
    "completion.free_length_weight": 2.0,
    "completion.inside_weight": 2.0,
    "completion.near_weight": 2.0,
    "vehicles.sparseness_power": 2.0,
    "vehicles.free_scale": 2.0,
    "vehicles.ring_weight": 2.0,
    "vehicles.overhead_weight": 2.0,
    "vehicles.objective_gate": 1.25,
    "vehicles.max_overlap": 2.0,
}
"""The default space: from the base's value over this to the base's value times this, on a log scale. The
weights of the completion and of the score, and the gates that decide how many proposals there are."""

FIRST_STEP, LAST_STEP = 0.125, 0.01
"""Of the search round the best point, in widths of the box."""
_DIGITS = 4
"""Significant digits of a tried value: more would say nothing and could not be read."""


@dataclasses.dataclass(frozen=True)
class Axis:
    """The range in which one threshold is tried."""

    name: str
    """Dotted."""
    low: float
    """Least value."""
    high: float
    """Largest value."""
    log: bool = False
    """Whether equal ratios, not equal differences, are equally likely."""

    def value(self, position: float) -> float:
        """The threshold at a position in [0, 1] of the range.

        >>> Axis("a", 1, 100, log=True).value(0.5)
        10.0
        """
        if self.log:
            value = self.low * (self.high / self.low) ** position
        else:
            value = self.low + (self.high - self.low) * position
        return float(f"{value:.{_DIGITS}g}")

    def position(self, value: float) -> float:
        """Where in the range a threshold lies, in [0, 1]; the nearer end for one beyond it."""
        value = min(max(value, self.low), self.high)
        if self.log:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


def parse_axis(config: DetectorConfig, text: str) -> Axis:
    """Reads one ``FIELD=LOW:HIGH`` or ``FIELD=LOW:HIGH:log``.

    Args:
      config: the settings that have the field.
      text: as above.

    Returns:
      The axis.

    Raises:
      ValueError: for another form, a field that is static or unknown, an empty range, or one with numbers
        that the field does not take.

    >>> parse_axis(DetectorConfig(), "vehicles.ring_weight=2:16:log")
    Axis(name='vehicles.ring_weight', low=2.0, high=16.0, log=True)
    """
    name, _, span = text.partition("=")
    words = span.split(":")
    scale = words[2:]
    try:
        low, high = (float(word) for word in words[:2])
    except ValueError:
        raise ValueError(f"{text}: write it as FIELD=LOW:HIGH or FIELD=LOW:HIGH:log.") from None
    if scale not in ([], ["log"]):
        raise ValueError(f"{text}: write it as FIELD=LOW:HIGH or FIELD=LOW:HIGH:log.")
    check_traced(config, name)
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(f"{text}: the range is empty; LOW must be below HIGH, both finite.")
    if scale and low <= 0:
        raise ValueError(f"{text}: a log scale needs LOW above 0.")
    allowed = traced_ranges(config)[name]
    for end in (low, high):
        checked_number(name, end, allowed)
    return Axis(name, low, high, log=bool(scale))


def default_axes(config: DetectorConfig) -> list[Axis]:
    """The default space round a base; see `DEFAULT_RATIOS`.

    Args:
      config: the base.

    Returns:
      The axes, within what each setting takes; without those that the base switched off with 0, or a gate
      that it opened with -1: ratios lead nowhere from there.
    """
    values, ranges = traced_fields(config), traced_ranges(config)
    return [
        Axis(name, value / ratio, min(value * ratio, ranges[name].maximum), log=True)
        for name, ratio in DEFAULT_RATIOS.items()
        if (value := float(values[name])) > 0
    ]


def axis_values(config: DetectorConfig, axes: Sequence[Axis]) -> dict[str, float]:
    """The settings' own value of each axis, by name."""
    values = traced_fields(config)
    return {axis.name: float(values[axis.name]) for axis in axes}


def latin_hypercube(axes: Sequence[Axis], count: int, *, seed: int) -> list[Changes]:
    """Settings spread evenly: each of `count` equal parts of every range is tried once.

    Args:
      axes: the ranges.
      count: how many settings.
      seed: the same seed gives the same settings.

    Returns:
      The settings, in random order.

    Reference: McKay, Beckman, Conover, Technometrics 21(2), 1979.
    """
    random = np.random.default_rng(seed)
    columns = [(random.permutation(count) + random.random(count)) / max(count, 1) for _ in axes]
    return [_changes_at(axes, row) for row in np.reshape(columns, (len(axes), count)).T]


def refine(axes: Sequence[Axis], start: Changes, score: float) -> Generator[Changes, float, None]:
    """Compass search: steps along one axis at a time, halved when none of them helps.

    Send each setting's score to get the next one; it ends when steps are below `LAST_STEP`.

    Args:
      axes: the ranges, which are not left.
      start: a value for each axis.
      score: of the start.

    Yields:
      The next setting to score.

    Reference: Kolda, Lewis, Torczon, SIAM Review 45(3), 2003.
    """
    center = np.array([axis.position(start[axis.name]) for axis in axes])
    step = FIRST_STEP
    while step >= LAST_STEP:
        before = score
        for index, sign in [(index, sign) for index in range(len(axes)) for sign in (1, -1)]:
            trial = center.copy()
            trial[index] = np.clip(center[index] + sign * step, 0, 1)
            if trial[index] == center[index]:
                continue
            found = yield _changes_at(axes, trial)
            if found > score:
                center, score = trial, found
        if score == before:
            step /= 2


def _changes_at(axes: Sequence[Axis], positions: np.ndarray) -> Changes:
    return {axis.name: axis.value(float(p)) for axis, p in zip(axes, positions, strict=True)}
