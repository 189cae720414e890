"""Time: from the detections of successive sweeps to vehicles with an identity, a velocity and a state."""

from jaxbox.config import TrackConfig
from jaxbox.tracking.poses import Poses, PoseSource
from jaxbox.tracking.smoothing import smooth
from jaxbox.tracking.state import Observations, TrackerState, observe
from jaxbox.tracking.step import track_sequence, track_step
from jaxbox.tracking.tracks import Sight, TrackCounts, Tracks, TrackStatus
from jaxbox.types import Motion

__all__ = [
    "Motion",
    "Observations",
    "PoseSource",
    "Poses",
    "Sight",
    "TrackConfig",
    "TrackCounts",
    "TrackStatus",
    "TrackerState",
    "Tracks",
    "observe",
    "smooth",
    "track_sequence",
    "track_step",
]
