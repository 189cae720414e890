"""The steps of `detect`: each picks its settings, hands arrays to its stage, and names what comes back."""

from jaxbox.steps.answer import conclude
from jaxbox.steps.boxes import build_evidence, complete_boxes, fit_rectangles
from jaxbox.steps.common import check_settings
from jaxbox.steps.decision import score_boxes
from jaxbox.steps.points import gather_obstacles, remove_ground, select_points
from jaxbox.steps.proposals import propose_clusters

__all__ = [
    "build_evidence",
    "check_settings",
    "complete_boxes",
    "conclude",
    "fit_rectangles",
    "gather_obstacles",
    "propose_clusters",
    "remove_ground",
    "score_boxes",
    "select_points",
]
