"""The points in each box, as files: ``--crops``."""

import pathlib
from collections.abc import Iterable

import numpy as np

from jaxbox._box import Box
from jaxbox.io import write_pcd
from jaxbox.io.points import Points

CROP_FOLDER = "crops"
"""Folder of the crops, in that of the results."""


def write_crops(
    folder: pathlib.Path, name: str, points: Points, boxes: Iterable[tuple[int, Box]], *, min_score: float
) -> None:
    """Writes the points in each box of a sweep to ``NAME_NUMBER.pcd``, in the sensor's frame of the sweep.

    Args:
      folder: where to; it is made where it is missing.
      name: of the sweep.
      points: of the sweep.
      boxes: each with its number.
      min_score: boxes that score less are left out, and so are boxes without points.

    Raises:
      OSError: where one cannot be written.
    """
    xyz, intensity = points
    for number, box in boxes:
        if box.score < min_score:
            continue
        # Of the points of a sweep, few are near.
        reach = np.linalg.norm(box.size) / 2
        near = np.flatnonzero(np.all(np.abs(xyz[:, :2] - box.center[:2]) <= reach, axis=1))
        rows = near[box.contains(xyz[near])]
        if len(rows) > 0:
            write_pcd(folder / f"{name}_{number:03d}.pcd", xyz[rows], intensity[rows])
