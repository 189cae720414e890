"""Which numbers each setting takes: the one table of ranges, by dotted name.

A number outside finds nothing, or divides by zero, and compiled code could not say so. Two functions check
against it: `replace_fields` for files and the command line, `check_config` for what Python hands to `detect`.
"""

import dataclasses
import math
import re
from typing import Any

import numpy as np

LARGEST = float(np.finfo(np.float32).max)
"""Thresholds are float32 in compiled code, where larger numbers would be infinite."""
LARGEST_WHOLE = 2**31 - 1
"""Of capacities and loop bounds: indices are int32."""
MAX_SHOWN = 80
"""Characters of a value in an error."""


class ConfigError(ValueError):
    """Invalid settings; the message names the setting and what it takes."""


@dataclasses.dataclass(frozen=True)
class Range:
    """The numbers that a setting takes, from `minimum` to `maximum`."""

    minimum: float
    """Smallest number."""
    maximum: float
    """Largest number."""
    text: str
    """In words, for errors and the documentation."""


SIGNED = Range(-LARGEST, LARGEST, "a finite number")
NON_NEGATIVE = Range(0, LARGEST, "a finite number, 0 or above")
POSITIVE = Range(float(np.finfo(np.float32).tiny), LARGEST, "a finite number above 0")
SHARE = Range(0, 1, "a finite number from 0 to 1")
COUNT = Range(1, LARGEST_WHOLE, "a whole number, 1 or above")
ROUNDS = Range(0, LARGEST_WHOLE, "a whole number, 0 or above")

_SIGNED = """
    ground.min_height_m clustering.maps.min_height_m box.slab_min_height_m
    evidence.hit_min_height_m evidence.free_min_height_m
    completion.length_margin_m completion.width_margin_m
    vehicles.classes.recess_m vehicles.classes.min_height_m vehicles.objective_gate vehicles.top_margin_m
"""
"""Heights from which points count, corrections of either sign, and gates that -1 opens."""

_POSITIVE = """
    filtering.bandwidth_m filtering.num_std
    ground.tolerance_m ground.smoothing_m ground.max_height_m
    clustering.max_extent_m completion.end_slope completion.end_points
    evidence.hit_max_height_m evidence.raised_hit_max_height_m evidence.free_max_height_m
    box.slab_max_height_m box.min_distance_m box.direction_sigma_deg
    vehicles.classes.length_m vehicles.classes.width_m vehicles.classes.height_m
    vehicles.classes.length_below_m vehicles.classes.length_above_m vehicles.classes.width_tolerance_m
    vehicles.classes.height_below_m vehicles.classes.height_above_m
    vehicles.classes.max_height_m vehicles.classes.max_length_m vehicles.classes.max_width_m
    vehicles.classes.count_max_height_m vehicles.classes.far_score_from_m
    vehicles.saturation_points vehicles.recess_share
    vehicles.free_scale vehicles.objective_softness vehicles.overhead_gap_m
    gate acceleration_mps2 position_sd_m unseen_sd_m birth_speed_sd_mps max_gap_s max_ego_speed_mps
"""
"""Divisors, and what leaves nothing to find at zero. Zero for a map's greatest height turns the map off."""

_SHARES = """
    ground.min_inlier_fraction ground.min_support_share box.direction_max_free box.min_slab_share
    completion.seen_weight
    health.min_far_share health.max_scattered_share health.max_rough_share health.max_under_share
    health.max_below_share
    vehicles.hidden_length_score vehicles.unseen_top_score vehicles.classes.min_open
    vehicles.classes.own_share
    vehicles.tall_upright_score vehicles.top_quantile vehicles.upright_score
    vehicles.min_score vehicles.max_overlap
    birth_score high_score low_score hidden_share yaw_memory yaw_memory_moving turn_gain
"""

_ROUNDS = "filtering.num_iterations ground.num_refits ground.num_envelope_rounds"

_RANGES = {
    name: of_all
    for names, of_all in ((_SIGNED, SIGNED), (_POSITIVE, POSITIVE), (_SHARES, SHARE), (_ROUNDS, ROUNDS))
    for name in names.split()
}
_ITEM = re.compile(r"\.\d+(?=\.|$)")


def range_of(name: str, *, is_static: bool, is_whole: bool) -> Range:
    """The numbers that a setting takes.

    Args:
      name: dotted; the items of a list, such as the component maps, share their ranges.
      is_static: whether it decides a shape or a loop bound.
      is_whole: whether it is a whole number.

    Returns:
      What the table says; without an entry the rule: thresholds are not negative, static lengths are
      positive, and capacities and other counts are 1 or above.

    >>> range_of("clustering.maps.2.cell_m", is_static=True, is_whole=False).text
    'a finite number above 0'
    """
    rule = COUNT if is_whole else POSITIVE if is_static else NON_NEGATIVE
    return _RANGES.get(_ITEM.sub("", name), rule)


def named_ranges() -> frozenset[str]:
    """The names in the table, without the numbers of items."""
    return frozenset(_RANGES)


def checked_number(name: str, value: Any, allowed: Range) -> float:
    """One number of a setting.

    Args:
      name: dotted, for the error.
      value: any number of Python or NumPy, or an array of one.
      allowed: its range.

    Returns:
      The number.

    Raises:
      ConfigError: for anything but a single number in the range; NaN is in none.

    >>> checked_number("vehicles.min_score", 0.5, SHARE)
    0.5
    """
    try:
        number = math.nan if isinstance(value, bool | str) else float(value)
    # TypeError for anything but a number, OverflowError for a whole number of hundreds of digits.
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not allowed.minimum <= number <= allowed.maximum:
        raise ConfigError(f"{name} is {shown(value)}; it must be {allowed.text}.")
    return number


def shown(value: Any) -> str:
    """A value for an error, cut short where it is long.

    Args:
      value: anything.

    Returns:
      Its `repr`, or what it is where that fails.

    >>> shown("none")
    "'none'"
    """
    try:
        text = repr(value)
    # Lists within lists without end, and whole numbers of thousands of digits.
    except (RecursionError, ValueError):
        return f"a {type(value).__name__} that cannot be shown"
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."
