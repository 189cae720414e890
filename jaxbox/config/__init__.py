"""The detector's configuration: one sub-config a stage, the presets, and names for every field."""

from jaxbox.config.class_priors import ClassPrior, Label, Scalar
from jaxbox.config.fitting import propose_capacities
from jaxbox.config.presets import DetectorConfig
from jaxbox.config.ranges import ConfigError
from jaxbox.config.schema import (
    DEFAULT_SCORE_THRESHOLD,
    BoxConfig,
    ClusteringConfig,
    CompletionConfig,
    ComponentMap,
    EvidenceConfig,
    FilterConfig,
    GroundConfig,
    HealthConfig,
    HullConfig,
    RegionConfig,
    VehicleConfig,
)
from jaxbox.config.tracking import TrackConfig

__all__ = [
    "DEFAULT_SCORE_THRESHOLD",
    "BoxConfig",
    "ClassPrior",
    "ClusteringConfig",
    "CompletionConfig",
    "ComponentMap",
    "ConfigError",
    "DetectorConfig",
    "EvidenceConfig",
    "FilterConfig",
    "GroundConfig",
    "HealthConfig",
    "HullConfig",
    "Label",
    "RegionConfig",
    "Scalar",
    "TrackConfig",
    "VehicleConfig",
    "propose_capacities",
]
