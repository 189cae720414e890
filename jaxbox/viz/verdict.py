"""Which boxes agree with the truth: estimates, false alarms, true boxes, misses."""

from collections.abc import Sequence

import numpy as np

from jaxbox.viz.boxes import BoxGroup, BoxSet, find_matches
from jaxbox.viz.colors import ESTIMATE, FALSE_ALARM, MISS, TRUTH, Color

TRUTH_PX = 1
"""True boxes are drawn on top and thin: a right estimate would hide them."""


def group_boxes(boxes: BoxSet | None, truth: BoxSet | None, judged: np.ndarray | None) -> list[BoxGroup]:
    """Groups estimates and true boxes by whether they agree.

    Args:
      boxes: K estimates, or None for none.
      truth: true boxes, or None where nothing is known: then no estimate is marked.
      judged: (K,) bool: False where the truth says nothing about the estimate, as outside the image
        that a sweep was labelled in; None judges all.

    Returns:
      The groups in the order in which they are drawn; some may be empty.
    """
    if boxes is None:
        boxes = BoxSet(center=np.zeros((0, 3)), size=np.zeros((0, 3)), yaw=np.zeros(0))
    if truth is None:
        return [BoxGroup(name="box", boxes=boxes, color=ESTIMATE)]
    hit, found = find_matches(boxes, truth)
    right = hit if judged is None else hit | ~np.asarray(judged, bool)
    return [
        BoxGroup(name="box", boxes=boxes.take(right), color=ESTIMATE),
        BoxGroup(name="false alarm", boxes=boxes.take(~right), color=FALSE_ALARM),
        BoxGroup(name="truth", boxes=truth.take(found), color=TRUTH, thickness_px=TRUTH_PX),
        BoxGroup(name="missed truth", boxes=truth.take(~found), color=MISS, thickness_px=TRUTH_PX),
    ]


def legend_entries(groups: Sequence[BoxGroup]) -> list[tuple[str, Color]]:
    """One line for each group that has boxes, with how many."""
    return [(f"{group.name} ({len(group.boxes)})", group.color) for group in groups if len(group.boxes)]
