"""The detector's configuration: one sub-config a stage, the presets, and names for every field."""

from jaxbox.config.capacities import propose_capacities
from jaxbox.config.class_priors import CAR, TRUCK, VAN, ClassPrior, Scalar
from jaxbox.config.schema import (
    DEFAULT_CUT,
    BoxConfig,
    ClusteringConfig,
    CompletionConfig,
    ComponentMap,
    DetectorConfig,
    EvidenceConfig,
    FilterConfig,
    GroundConfig,
    HullConfig,
    RegionConfig,
    VehicleConfig,
)

__all__ = [
    "CAR",
    "DEFAULT_CUT",
    "TRUCK",
    "VAN",
    "BoxConfig",
    "ClassPrior",
    "ClusteringConfig",
    "CompletionConfig",
    "ComponentMap",
    "DetectorConfig",
    "EvidenceConfig",
    "FilterConfig",
    "GroundConfig",
    "HullConfig",
    "RegionConfig",
    "Scalar",
    "VehicleConfig",
    "propose_capacities",
]
