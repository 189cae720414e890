"""SemanticKITTI: the class and instance of every point of a KITTI odometry sweep.

Reference: Behley et al., "SemanticKITTI: A dataset for semantic scene understanding of LiDAR sequences",
ICCV 2019.
"""

import os

import numpy as np

from jaxbox._files import InputError, read_bytes
from jaxbox.io.labelled import check_count

GROUND_CLASSES = frozenset({40, 44, 48, 49, 60, 72})
"""Road, parking, sidewalk, other ground, lane marking, terrain."""

UNJUDGED_CLASSES = frozenset({0, 1, 70})
"""Unlabelled, outlier, and vegetation, which holds grass as well as crowns: no answer is right or wrong
there (Lee, Lim, Myung, "Patchwork++", IROS 2022)."""

VEHICLE_CLASSES = frozenset({10, 13, 16, 18, 20, 252, 256, 257, 258, 259})
"""Cars, buses, trams, trucks and other vehicles, standing and moving."""

_BYTES_PER_LABEL = 4
_CLASS_BITS = 16


def read_semantic_labels(
    path: str | os.PathLike[str], *, num_points: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Reads a ``.label`` file: little-endian uint32, the class in the lower half, the instance above.

    Args:
      path: the file.
      num_points: points of the sweep, to check that the two belong together.

    Returns:
      class_id: (n,) int64.
      instance_id: (n,) int64; 0 where a point belongs to no counted thing.

    Raises:
      InputError: where the file is missing, cut short, or of another number of points.
    """
    data = read_bytes(path)
    if len(data) % _BYTES_PER_LABEL:
        raise InputError(
            f"{path}: {len(data)} bytes is not a multiple of {_BYTES_PER_LABEL} (one uint32 a point). "
            "Copy the file again if it was cut short."
        )
    labels = np.frombuffer(data, "<u4").astype(np.int64)
    check_count(path, len(labels), num_points, what="labels")
    return labels & (1 << _CLASS_BITS) - 1, labels >> _CLASS_BITS
