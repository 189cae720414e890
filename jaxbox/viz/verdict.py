"""What colour a box has: an estimate, a false alarm, a true box, a miss."""

import numpy as np

from jaxbox.viz.boxes import BoxSet, find_matches
from jaxbox.viz.colors import ESTIMATE, FALSE_ALARM, MISS, TRUTH, Color


def choose_colors(
    boxes: BoxSet, truth: BoxSet | None, judged: np.ndarray | None
) -> tuple[list[Color], list[Color]]:
    """Colours estimates and true boxes by whether they agree.

    Args:
      boxes: K estimates.
      truth: L true boxes, or None where nothing is known: then no estimate is marked.
      judged: (K,) bool: False where the truth says nothing about the estimate, as outside the image
        that a sweep was labelled in; None judges all.

    Returns:
      K colours and L colours.
    """
    if truth is None:
        return [ESTIMATE] * len(boxes), []
    hit, found = find_matches(boxes, truth)
    right = hit if judged is None else hit | ~np.asarray(judged, bool)
    return (
        [ESTIMATE if ok else FALSE_ALARM for ok in right],
        [TRUTH if ok else MISS for ok in found],
    )


def legend_entries(estimates: list[Color], truths: list[Color]) -> list[tuple[str, Color]]:
    """One line for each colour that occurs, with how often it does."""
    names = (("box", ESTIMATE), ("false alarm", FALSE_ALARM), ("truth", TRUTH), ("missed truth", MISS))
    colors = estimates + truths
    return [(f"{name} ({colors.count(color)})", color) for name, color in names if color in colors]
