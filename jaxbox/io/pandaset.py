"""PandaSet: Pandar64 sweeps and their boxes as text.

Points are KITTI's binary points. A label is a line ``class 0 x y z l w h yaw [points]``, in which the two
horizontal sizes come in either order: the length is the larger, and the yaw is the length's direction.
Class names differ between releases.

x points forward, y left and z up, but the origin is low on the vehicle, not in the sensor. What a beam
passed through on its way can only be told from the sensor, so everything is moved there.

Reference: Xiao et al., "PandaSet: Advanced sensor suite dataset for autonomous driving", ITSC 2021.
"""

import os

import numpy as np

from jaxbox._files import InputError, read_text
from jaxbox.io.labelled import LabelledBoxes, finite_number, labelled_boxes
from jaxbox.io.points import read_bin, seen_from

SENSOR_XYZ_M = (0.8, 0.0, 1.85)
"""The sensor in the recordings' frame, to about a decimetre. From the data: seen from there, the rings on the
road lie at the elevations of the sensor's lowest beams (-25, -19, -14, -13, ... degrees)."""

CAR_CLASSES = frozenset({"Car", "TYPE_VEHICLE"})
"""Cars; the coarser release has one class for all vehicles."""

VEHICLE_CLASSES = CAR_CLASSES | {
    "Bus", "Emergency_Vehicle", "Medium-sized_Truck", "Other_Vehicle_-_Construction_Vehicle",
    "Other_Vehicle_-_Uncommon", "Pickup_Truck", "Semi-truck", "Towed_Object",
}  # fmt: skip
"""Everything on four wheels or more."""

_COLUMNS = (9, 10)
_NUMBERS = ("x", "y", "z", "length", "width", "height", "yaw")


def read_pandaset_points(
    path: str | os.PathLike[str], *, sensor_xyz_m: tuple[float, float, float] = SENSOR_XYZ_M
) -> tuple[np.ndarray, np.ndarray]:
    """Reads a sweep and moves it to the sensor.

    Args:
      path: float32 x, y, z, intensity, as `read_bin`.
      sensor_xyz_m: where the sensor is in the file's frame.

    Returns:
      xyz: (n, 3) float32, m, sensor frame.
      intensity: (n,) float32, 0 to 255.

    Raises:
      InputError: as `read_bin`.
    """
    xyz, intensity = read_bin(path)
    return seen_from(sensor_xyz_m, xyz), intensity


def read_pandaset_boxes(
    path: str | os.PathLike[str], *, sensor_xyz_m: tuple[float, float, float] = SENSOR_XYZ_M
) -> LabelledBoxes:
    """Reads the labels of one sweep and moves them to the sensor.

    Args:
      path: a text file; empty lines are skipped, and the number of points at the end is not used.
      sensor_xyz_m: where the sensor is in the file's frame.

    Returns:
      The boxes, in the file's order.

    Raises:
      InputError: naming file, line and field, for another number of columns or a field that is not a number.
    """
    lines = ((number, line.split()) for number, line in enumerate(read_text(path).splitlines(), start=1))
    rows = [(words[0], _numbers(words, f"{path}, line {number}")) for number, words in lines if words]
    values = np.array([numbers for _, numbers in rows]).reshape(-1, len(_NUMBERS))
    length, width = values[:, 3:5].max(axis=1), values[:, 3:5].min(axis=1)
    size = np.stack([length, width, values[:, 5]], axis=1)
    return labelled_boxes([name for name, _ in rows], values[:, :3] - sensor_xyz_m, size, values[:, 6])


def _numbers(words: list[str], where: str) -> list[float]:
    if len(words) not in _COLUMNS:
        raise InputError(f"{where}: {len(words)} columns; a label is class 0 x y z l w h yaw [points].")
    return [finite_number(word, name, where) for word, name in zip(words[2:9], _NUMBERS, strict=True)]
