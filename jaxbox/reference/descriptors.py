"""Shape descriptors: moment of inertia, eccentricity, density, complexity (paper, 3.5 and 4.4)."""

from collections.abc import Sequence

import numpy as np

from jaxbox.reference.hull import polygon_area
from jaxbox.reference.state import ShapeDescriptors

MIN_AXIS_SQ = 1e-6
"""m^2: second moments below (1 mm)^2 are rounding; keeps the eccentricity of a line finite."""


def describe(
    clusters: Sequence[np.ndarray], hulls: Sequence[np.ndarray]
) -> tuple[np.ndarray, list[ShapeDescriptors]]:
    """How many points each detection has, and their shape.

    Args:
      clusters: (n, 2) m, the points of k detections.
      hulls: (h, 2) m, of those points.

    Returns:
      (k,) int numbers of points, and k descriptors.
    """
    shapes = [shape_descriptors(xy, hull) for xy, hull in zip(clusters, hulls, strict=True)]
    return np.array([len(xy) for xy in clusters], int), shapes


def shape_descriptors(xy: np.ndarray, hull: np.ndarray) -> ShapeDescriptors:
    """Moments of inertia, eccentricity, density and complexity.

    Args:
      xy: (n, 2) m.
      hull: (h, 2) m, its convex hull.

    Returns:
      The descriptors; a single point has eccentricity 1, no points give zeros.
    """
    if len(xy) == 0:
        return ShapeDescriptors(np.zeros(2), 1.0, 0.0, 0.0)
    centred = xy - xy.mean(axis=0)
    minor, major = np.linalg.eigvalsh(centred.T @ centred / len(xy))
    moments = np.maximum([major, minor], 0.0)
    area = abs(polygon_area(hull))
    return ShapeDescriptors(
        moment_of_inertia=moments,
        eccentricity=float(np.sqrt(max(moments[0], MIN_AXIS_SQ) / max(moments[1], MIN_AXIS_SQ))),
        density=len(xy) / area if area > 0 else 0.0,
        complexity=len(hull) / len(xy),
    )
