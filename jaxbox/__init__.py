"""jaxbox: training-free LiDAR vehicle detection as one compiled JAX function."""

# First: to import JAX takes a second, in which Ctrl-C is to be heard, too.
from jaxbox._interrupts import release as _release  # isort: split

import importlib as _importlib
from typing import TYPE_CHECKING as _TYPE_CHECKING

from jaxbox._box import Box, Detection
from jaxbox._version import __version__
from jaxbox.config import DEFAULT_SCORE_THRESHOLD, DetectorConfig, TrackConfig, propose_capacities
from jaxbox.run import serialization as _serialization  # noqa: F401 - jax.export learns the types below
from jaxbox.run.batching import detect_batch
from jaxbox.run.cache import enable_cache
from jaxbox.run.compiled import detect
from jaxbox.run.steps import ClusterBoxes, GroundPoints, cluster_points, fit_boxes, remove_ground
from jaxbox.run.streaming import StreamedSweep, stream
from jaxbox.run.summary import Summary, summarise
from jaxbox.run.tracking import TrackedSweep, track
from jaxbox.tracking.tracks import Sight, Track, Tracks, TrackStatus
from jaxbox.types import (
    Calibration,
    Detections,
    GroundPlane,
    Hulls,
    Label,
    Motion,
    PointCloud,
    Status,
    stack_clouds,
)

__all__ = [
    "DEFAULT_SCORE_THRESHOLD",
    "Box",
    "Calibration",
    "ClusterBoxes",
    "Detection",
    "Detections",
    "DetectorConfig",
    "GroundPlane",
    "GroundPoints",
    "Hulls",
    "Label",
    "Motion",
    "PointCloud",
    "Sight",
    "Status",
    "StreamedSweep",
    "Summary",
    "Track",
    "TrackConfig",
    "TrackStatus",
    "TrackedSweep",
    "Tracks",
    "__version__",
    "cluster_points",
    "detect",
    "detect_batch",
    "enable_cache",
    "fit_boxes",
    "propose_capacities",
    "remove_ground",
    "stack_clouds",
    "stream",
    "summarise",
    "track",
]

if _TYPE_CHECKING:
    from jaxbox import cluster as cluster
    from jaxbox import evaluation as evaluation
    from jaxbox import io as io
    from jaxbox import live as live
    from jaxbox import reference as reference
    from jaxbox import synthetic as synthetic
    from jaxbox import tuning as tuning
    from jaxbox import viewer as viewer
    from jaxbox import viz as viz
else:
    _LATER = {"cluster", "evaluation", "io", "live", "reference", "synthetic", "tuning", "viewer", "viz"}

    def __getattr__(name):
        """Packages that detecting does not need are imported when they are asked for, as ``jaxbox.io``."""
        if name not in _LATER:
            raise AttributeError(f"module 'jaxbox' has no attribute {name!r}")
        return _importlib.import_module(f".{name}", __name__)


_release()
