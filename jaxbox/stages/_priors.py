"""Class priors as arrays, and how well a size matches them."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxbox.config import ClassPrior
from jaxbox.stages.state import RayFractions


def prior_of(classes: Sequence[ClassPrior], label: jax.Array) -> ClassPrior:
    """The priors of labels: a `ClassPrior` of arrays.

    Each number is chosen among the classes and not looked up, which would be a step of its own.

    Args:
      classes: in the order of the labels.
      label: (P,) int32.

    Returns:
      Fields of (P,) float32.
    """

    is_other = [label == i for i in range(1, len(classes))]

    def choose(*values: jax.Array | float) -> jax.Array:
        chosen, *others = (jnp.asarray(value, jnp.float32) for value in values)
        for is_this, value in zip(is_other, others, strict=True):
            chosen = jnp.where(is_this, value, chosen)
        return jnp.broadcast_to(chosen, label.shape)

    return jax.tree.map(choose, *classes)


def asymmetric_gaussian(
    value: jax.Array, peak: jax.Array | float, below: jax.Array | float, above: jax.Array | float
) -> jax.Array:
    """exp(-((value - peak) / width)^2), with its own width on either side.

    Args:
      value: any shape.
      peak: where it is 1.
      below: width below the peak.
      above: width above the peak.

    Returns:
      The same shape, in [0, 1].
    """
    return jnp.exp(-(((value - peak) / jnp.where(value < peak, below, above)) ** 2))


def closed_free_length(rays: RayFractions, prior: ClassPrior) -> jax.Array:
    """The free space in boxes that speaks against a class: beams also pass below the bodies of some.

    Args:
      rays: fractions (..., P).
      prior: fields of (P,) float32.

    Returns:
      (..., P) float32: the free length of all rays, or no more than the fraction that hit nothing.

    Reference: oracle `jaxbox.reference.closed_free_length`.
    """
    beside = jnp.minimum(rays.free_length, rays.free)
    share = jnp.broadcast_to(jnp.minimum(prior.open_below, 1), beside.shape)
    return rays.free_length + share * (beside - rays.free_length)


def is_raised(prior: ClassPrior) -> jax.Array:
    """Whether beams pass below the bodies of a class, so that returns from higher up are hits too.

    Args:
      prior: fields of (...) float32.

    Returns:
      (...) bool.
    """
    return jnp.asarray(prior.open_below) > 0


def size_score(length: jax.Array, width: jax.Array, prior: ClassPrior) -> jax.Array:
    """How well the box's length and width match the class.

    Args:
      length: (...) float32, m.
      width: (...) float32, m.
      prior: fields of (...) float32.

    Returns:
      (...) float32 in [0, 1].
    """
    by_length = asymmetric_gaussian(length, prior.length_m, prior.length_below_m, prior.length_above_m)
    tolerance_m = prior.width_tolerance_m
    return by_length * asymmetric_gaussian(width, prior.width_m, tolerance_m, tolerance_m)
