"""What the steps share: how settings reach the stages."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox.config import DetectorConfig


def stage_options(config: Any, *drop: str) -> dict[str, Any]:
    """The fields of a sub-config as keyword arguments for its stage."""
    return {f.name: getattr(config, f.name) for f in dataclasses.fields(config) if f.name not in drop}


def check_settings(config: DetectorConfig) -> None:
    """Refuses settings that contradict each other.

    Raises:
      ValueError: naming the fields and the mend.
    """
    if config.completion.mode != "evidence":
        return
    if not config.evidence.enabled:
        raise ValueError(
            'completion.mode is "evidence" but evidence.enabled is False; '
            'enable the evidence, or set completion.mode to "away" or "none".'
        )
    if config.box.criterion not in ("closeness", "visible_closeness"):
        raise ValueError(
            f'completion.mode "evidence" weighs closeness, but box.criterion is {config.box.criterion!r}; '
            'choose a closeness criterion, or set completion.mode to "away" or "none".'
        )


def class_values(config: DetectorConfig, field: str, label: jax.Array) -> jax.Array:
    """A field of the class priors, for each label. Chosen, not looked up: that takes no kernel of its own."""
    value, *others = (jnp.asarray(getattr(c, field), jnp.float32) for c in config.vehicles.classes)
    for i, other in enumerate(others, start=1):
        value = jnp.where(label == i, other, value)
    return jnp.broadcast_to(value, label.shape)
