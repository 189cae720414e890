"""Teaches `jax.export` the types that users hold: functions of them can be serialized, and called again.

Whoever loads such a function imports jaxbox first. `jaxbox.run.export` writes files that do without.
"""

import ast
import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.export

from jaxbox import config, types
from jaxbox.config import class_priors

CLASSES = (
    types.PointCloud,
    types.Detections,
    types.Counts,
    types.Descriptors,
    types.GroundPlane,
    types.Hulls,
    types.Calibration,
    class_priors.ClassPrior,
    config.RegionConfig,
    config.FilterConfig,
    config.GroundConfig,
    config.ComponentMap,
    config.ClusteringConfig,
    config.EvidenceConfig,
    config.HullConfig,
    config.BoxConfig,
    config.CompletionConfig,
    config.VehicleConfig,
    config.HealthConfig,
    config.DetectorConfig,
)
"""Dataclasses whose static fields, if any, are numbers, strings and None."""


def _register(cls: type) -> None:
    fields = dataclasses.fields(cls)
    static = [field.name for field in fields if field.metadata.get("static")]
    traced = [field.name for field in fields if field.name not in static]

    def from_children(aux_data: Any, children: Sequence[Any]) -> Any:
        node = object.__new__(cls)  # Of the children only the place counts, whatever `__init__` would say.
        names = (*static, *traced)
        for name, value in zip(names, (*aux_data, *children), strict=True):
            object.__setattr__(node, name, value)
        return node

    jax.export.register_pytree_node_serialization(
        cls,
        serialized_name=f"jaxbox.{cls.__name__}",
        serialize_auxdata=lambda static_values: repr(static_values).encode(),
        deserialize_auxdata=lambda text: ast.literal_eval(bytes(text).decode()),
        from_children=from_children,
    )


for _class in CLASSES:
    _register(_class)
