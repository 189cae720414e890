"""Boxes that overlap a better one are suppressed: within a reading of the sweep, and across readings."""

import jax

from jaxbox.geometry.planar import rectangle_iou
from jaxbox.xla.suppression import suppress_conflicts


def non_max_suppression(boxes: jax.Array, valid: jax.Array, *, max_overlap: jax.Array | float) -> jax.Array:
    """Keeps each box that overlaps no better one that is kept (greedy non-maximum suppression).

    Args:
      boxes: (P, 5) float32: x, y, length, width, yaw; best first.
      valid: (P,) bool, rows that hold a box, all before the others.
      max_overlap: largest bird's-eye view IoU of two boxes that are both kept.

    Returns:
      (P,) bool.

    Reference: oracle `jaxbox.reference.non_max_suppression`.
    """
    return suppress_conflicts(boxes, valid, lambda a, b: rectangle_iou(a, b) > max_overlap)
