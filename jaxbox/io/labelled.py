"""Labelled boxes in the sensor frame, whatever data set they come from."""

import dataclasses
import math
import os
from collections.abc import Collection

import numpy as np

from jaxbox._files import InputError


@dataclasses.dataclass(frozen=True)
class LabelledBoxes:
    """The labels of one sweep, row by row, in the project's conventions."""

    class_names: tuple[str, ...]
    """n class names, as in the file."""
    center: np.ndarray
    """(n, 3) float64, m, sensor frame: centre of the box."""
    size: np.ndarray
    """(n, 3) float64, m: length >= width, height."""
    yaw: np.ndarray
    """(n,) float64, rad, in [-pi/2, pi/2): length axis from +x about +z."""

    def __len__(self) -> int:
        """n."""
        return len(self.class_names)

    def of_classes(self, class_names: Collection[str]) -> np.ndarray:
        """Which boxes are of one of these classes.

        Args:
          class_names: as in the file.

        Returns:
          (n,) bool.
        """
        return np.array([name in class_names for name in self.class_names], bool)


def labelled_boxes(
    class_names: Collection[str], center: np.ndarray, size: np.ndarray, yaw: np.ndarray
) -> LabelledBoxes:
    """Brings boxes to the project's conventions.

    Args:
      class_names: n names.
      center: (n, 3) m, sensor frame.
      size: (n, 3) m: the extent along the yaw axis, across it, and in height; in either order of the two.
      yaw: (n,) rad, any turn.

    Returns:
      The boxes, with length >= width and the yaw of the length.

    >>> boxes = labelled_boxes(["Car"], np.zeros((1, 3)), np.array([[2.0, 4.0, 1.5]]), np.zeros(1))
    >>> boxes.size[0].tolist(), boxes.yaw.round(3).tolist()
    ([4.0, 2.0, 1.5], [-1.571])
    """
    center, size = np.reshape(center, (-1, 3)).astype(float), np.reshape(size, (-1, 3)).astype(float)
    across = size[:, 1] > size[:, 0]
    size[across, :2] = size[across, 1::-1]
    yaw = np.ravel(yaw).astype(float) + across * np.pi / 2
    wrapped = yaw - np.pi * np.floor(yaw / np.pi + 0.5)
    # Rounding can land on the open end.
    wrapped = np.where(wrapped >= np.pi / 2, -np.pi / 2, wrapped)
    return LabelledBoxes(tuple(class_names), center, size, wrapped)


def check_count(path: str | os.PathLike[str], count: int, num_points: int | None, *, what: str) -> None:
    """Refuses labels that belong to another sweep.

    Args:
      path: the label file.
      count: the labels that it holds.
      num_points: the points of the sweep; None where they are unknown.
      what: what is counted, for the message.

    Raises:
      InputError: where the two differ.
    """
    if num_points is not None and count != num_points:
        raise InputError(
            f"{path}: {count} {what} for a sweep of {num_points} points; give the file of the same sweep."
        )


def finite_number(value: object, name: str, where: str) -> float:
    """Reads one number of a label.

    Args:
      value: a number, or its text.
      name: of the field, for the message.
      where: file and line or entry, for the message.

    Returns:
      The number.

    Raises:
      InputError: where it is missing, no number or not finite.
    """
    try:
        # Other types are a TypeError.
        number = float(value)  # pyright: ignore[reportArgumentType]
    # A whole number of hundreds of digits overflows.
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{where}: {name} is {value!r}; it must be a finite number.")
    return number
