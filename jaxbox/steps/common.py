"""What the steps share: how settings reach the stages."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox.config import DetectorConfig


def stage_options(config: Any, *drop: str) -> dict[str, Any]:
    """The fields of a sub-config as keyword arguments for its stage."""
    return {f.name: getattr(config, f.name) for f in dataclasses.fields(config) if f.name not in drop}


def class_values(config: DetectorConfig, field: str, label: jax.Array) -> jax.Array:
    """A field of the class priors, for each label."""
    return jnp.stack([jnp.asarray(getattr(c, field), jnp.float32) for c in config.vehicles.classes])[label]
