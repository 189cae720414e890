"""jaxbox: training-free LiDAR vehicle detection as one compiled JAX function."""

from jaxbox import serialization as _serialization  # noqa: F401 - jax.export learns the types below
from jaxbox.batching import detect_batch
from jaxbox.cache import enable_cache
from jaxbox.config import DEFAULT_CUT, DetectorConfig
from jaxbox.detector import detect
from jaxbox.streaming import StreamedSweep, stream
from jaxbox.types import Calibration, Detections, GroundPlane, Hulls, Label, PointCloud, Status, stack_clouds
from jaxbox.version import __version__

__all__ = [
    "DEFAULT_CUT",
    "Calibration",
    "Detections",
    "DetectorConfig",
    "GroundPlane",
    "Hulls",
    "Label",
    "PointCloud",
    "Status",
    "StreamedSweep",
    "__version__",
    "detect",
    "detect_batch",
    "enable_cache",
    "stack_clouds",
    "stream",
]
