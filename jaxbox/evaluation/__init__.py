"""How good are the boxes: KITTI's protocol, overlaps, recall and precision, and the errors of size."""

from jaxbox.evaluation.beams import beam_of_points, thin_beams
from jaxbox.evaluation.iou import paired_overlaps, pairwise_overlaps
from jaxbox.evaluation.kitti import KittiEvaluation, PrecisionCurve, evaluate, soft_score
from jaxbox.evaluation.matching import Selection, count_points_in_boxes
from jaxbox.evaluation.report import evaluate_folders, evaluate_objects
from jaxbox.evaluation.sizes import DimensionErrors, constant_sizes, size_errors, yaw_errors

__all__ = [
    "DimensionErrors",
    "KittiEvaluation",
    "PrecisionCurve",
    "Selection",
    "beam_of_points",
    "constant_sizes",
    "count_points_in_boxes",
    "evaluate",
    "evaluate_folders",
    "evaluate_objects",
    "paired_overlaps",
    "pairwise_overlaps",
    "size_errors",
    "soft_score",
    "thin_beams",
    "yaw_errors",
]
