"""How the numbers of a source are to be taken: unit, axes, and the columns of files without a header.

The detector wants metres, x forward, y left and z up, from the sensor.
"""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from jaxbox._files import InputError

AXES: Mapping[str, str] = {
    "ros": "x,y,z",
    "camera": "z,-x,-y",
    "ned": "x,-y,-z",
    "enu": "y,-x,z",
}
"""The detector's x, y and z by the source's, for the axes that have a name: x forward, y left, z up (ROS);
x right, y down, z forward (a camera's); x forward, y right, z down (NED, FRD); x right, y forward, z up
(ENU, nuScenes)."""

_ORDINARY = AXES["ros"]
_MIN_COLUMNS = 4


@dataclasses.dataclass(frozen=True)
class PointConvention:
    """Unit, axes and columns of the points of a source.

    Raises:
      InputError: for a value that cannot be used, naming the option.

    >>> PointConvention(scale=0.001, axes="camera").apply(np.array([[0.0, 1500.0, 9000.0]]))
    array([[ 9. , -0. , -1.5]], dtype=float32)
    """

    scale: float = 1.0
    """m of a unit of the source: 0.001 for millimetres, 0.3048 for feet."""
    axes: str = _ORDINARY
    """The detector's x, y and z by the source's, such as "-y,x,z" where x points left and y backward; or a
    name of `AXES`."""
    flip: str = ""
    """Of the detector's axes, those that point the other way, as "z" or "xy", where a source is mirrored."""
    columns: int | None = None
    """Of ``.bin`` files, float32 a point; None to tell it by the numbers."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise InputError(f"--scale {self.scale:g}: give the metres of a unit, such as 0.001 for mm.")
        object.__setattr__(self, "axes", AXES.get(self.axes, self.axes))
        if sorted(word.removeprefix("-") for word in self._words) != ["x", "y", "z"]:
            raise InputError(
                f"--axes {self.axes}: give x, y and z by the source's axes, such as -y,x,z, or one of "
                f"{', '.join(AXES)}."
            )
        if len(set(self.flip)) != len(self.flip) or not set(self.flip) <= set("xyz"):
            raise InputError(f"--flip {self.flip}: give the axes that point the other way, such as z or xy.")
        if self.columns is not None and self.columns < _MIN_COLUMNS:
            raise InputError(
                f"--columns {self.columns}: x, y, z and intensity are 4; give how many there are."
            )

    @property
    def _words(self) -> list[str]:
        return [word.strip() for word in self.axes.split(",")]

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) float64, from the source's axes to the detector's; a reflection where they are mirrored."""
        R = np.zeros((3, 3))
        for row, (axis, word) in enumerate(zip("xyz", self._words, strict=True)):
            turned = word.startswith("-") != (axis in self.flip)
            R[row, "xyz".index(word[-1])] = -1.0 if turned else 1.0
        return R

    @property
    def T_points_source(self) -> np.ndarray:
        """(4, 4) float64, from the source's axes to the detector's, without the scale."""
        T = np.eye(4)
        T[:3, :3] = self.rotation
        return T

    def world_poses(self, T_world_source: np.ndarray) -> np.ndarray:
        """Poses of a sensor with these axes, of one with the detector's.

        Args:
          T_world_source: (F, 4, 4) float64, m.

        Returns:
          (F, 4, 4) float64, m. Where the source's z is up the world is the same. Where it is not, the world
          is taken to have the source's axes, too, and is turned with them.
        """
        T = self.T_points_source
        moved = T_world_source @ T.T
        keeps_up = T[2, 2] == 1 and np.linalg.det(T) > 0
        return moved if keeps_up else T @ moved

    def apply(self, xyz: np.ndarray) -> np.ndarray:
        """Points as the detector wants them.

        Args:
          xyz: (n, 3), in the source's unit and axes.

        Returns:
          (n, 3) float32, m; NaN and infinity stay what they are.
        """
        if self == ORDINARY:
            return xyz
        R = self.rotation
        order, signs = np.abs(R).argmax(axis=1), R.sum(axis=1)
        # A matrix would make NaN of the other coordinates of a point.
        with np.errstate(over="ignore", invalid="ignore"):
            return (xyz[:, order] * (signs * self.scale)).astype(np.float32)


ORDINARY = PointConvention()
"""Metres, x forward, y left, z up, and columns by the numbers."""
