"""How good are tracks: HOTA, CLEAR and identity, in the image as KITTI has it, from above, and in 3D."""

from jaxbox.evaluation.tracking.clear import Clear, measure_clear
from jaxbox.evaluation.tracking.comparison import Comparison
from jaxbox.evaluation.tracking.detection import DetectionCurve, detection_curve
from jaxbox.evaluation.tracking.folders import (
    TrackingSequence,
    evaluate_tracking_folders,
    read_tracking_folders,
)
from jaxbox.evaluation.tracking.hota import ALPHAS, Hota, measure_hota
from jaxbox.evaluation.tracking.identity import Identity, measure_identity
from jaxbox.evaluation.tracking.judged import JudgedFrame, compare_boxes, judge_sequences
from jaxbox.evaluation.tracking.motion import MotionErrors, motion_errors
from jaxbox.evaluation.tracking.protocol import compare_in_image
from jaxbox.evaluation.tracking.report import evaluate_boxes, measure_tracks
from jaxbox.evaluation.tracking.sequences import FrameBoxes, FrameTruth, TruthSequence

__all__ = [
    "ALPHAS",
    "Clear",
    "Comparison",
    "DetectionCurve",
    "FrameBoxes",
    "FrameTruth",
    "Hota",
    "Identity",
    "JudgedFrame",
    "MotionErrors",
    "TrackingSequence",
    "TruthSequence",
    "compare_boxes",
    "compare_in_image",
    "detection_curve",
    "evaluate_boxes",
    "evaluate_tracking_folders",
    "judge_sequences",
    "measure_clear",
    "measure_hota",
    "measure_identity",
    "measure_tracks",
    "motion_errors",
    "read_tracking_folders",
]
