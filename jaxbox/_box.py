"""One vehicle as people hold it: plain numbers of the host, its corners, and which points are in it."""

import dataclasses
import math
from typing import Any

import numpy as np

from jaxbox.config import Label
from jaxbox.geometry.rigid import rotation_about_z

_SIGNS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], np.float64)
"""Front left, rear left, rear right, front right."""


class ByValue:
    """A dataclass that equals another of its class where all fields do, also those that are arrays."""

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return _equal(self, other)

    # What holds arrays can be neither constant nor key.
    __hash__ = None  # pyright: ignore[reportAssignmentType]


def _equal(a: Any, b: Any) -> bool:
    if type(a) is type(b) and dataclasses.is_dataclass(a):
        fields = (field.name for field in dataclasses.fields(a) if field.compare)
        return all(_equal(getattr(a, name), getattr(b, name)) for name in fields)
    return np.array_equal(a, b)


def footprints(center: np.ndarray, size: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Corners of upright boxes from above.

    Args:
      center: (K, 2 or more) m.
      size: (K, 2 or more) m: length along the yaw, width.
      yaw: (K,) rad, from +x about +z.

    Returns:
      (K, 4, 2) float64, m: counter-clockwise from front left.
    """
    local = _SIGNS * size[:, None, :2] / 2
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y = local[..., 0], local[..., 1]
    return center[:, None, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def box_corners(center: np.ndarray, size: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Corners of upright boxes.

    Args:
      center: (K, 3) m.
      size: (K, 3) m: length along the yaw, width, height.
      yaw: (K,) rad, from +x about +z.

    Returns:
      (K, 8, 3) float64, m: the `footprints` on the floor, then on the roof.
    """
    flat, half = footprints(center, size, yaw), size[:, None, 2:].astype(np.float64) / 2
    levels = [center[:, None, 2:] + sign * half for sign in (-1, 1)]
    return np.concatenate(
        [np.concatenate([flat, np.broadcast_to(z, (len(flat), 4, 1))], axis=-1) for z in levels], axis=1
    )


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Box(ByValue):
    """An upright box of a class, in the sensor frame: what `Detection` and `Track` have in common.

    >>> center, size = np.array([8.0, 3.0, -1.0]), np.array([4.0, 2.0, 1.5])
    >>> box = Box(label=Label.CAR, score=0.9, center=center, size=size, yaw=0.0, heading=math.pi,
    ...           front_probability=0.8)
    >>> print(box)
    car    0.90  at    8.0    3.0   -1.0 m   4.00 x 2.00 x 1.50 m  heading  180 deg (0.80)
    >>> inside = box.contains(np.array([[9.9, 3.9, -0.3], [9.9, 4.1, -0.3]]))
    >>> box.footprint[0].round(3).tolist(), inside.tolist()
    ([6.0, 2.0], [True, False])
    """

    label: Label
    """The class; `Label.word` is its name, such as "car"."""
    score: float
    """In [0, 1]."""
    center: np.ndarray
    """(3,) float32, m, sensor frame."""
    size: np.ndarray
    """(3,) float32, m: length, width, height."""
    yaw: float
    """Rad, in [-pi/2, pi/2): length axis from +x about +z."""
    heading: float
    """Rad, in [-pi, pi]: where the front points; ``yaw`` or half a turn further."""
    front_probability: float
    """In [.5, 1]: P(front), that the front is at ``heading`` and not opposite."""

    def __str__(self) -> str:
        """One line, which is as wide for all boxes."""
        x, y, z = self.center.tolist()
        length, width, height = self.size.tolist()
        return (
            f"{self.label.word:5}  {self.score:.2f}  at {x:6.1f} {y:6.1f} {z:6.1f} m  "
            f"{length:5.2f} x {width:.2f} x {height:.2f} m  "
            f"heading {math.degrees(self.heading):4.0f} deg ({self.front_probability:.2f})"
        )

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {' '.join(str(self).split())}>"

    @property
    def range_m(self) -> float:
        """Distance of the centre from the sensor in the plane, m."""
        return math.hypot(*self.center[:2])

    @property
    def footprint(self) -> np.ndarray:
        """(4, 2) float64, m: corners from above, counter-clockwise from front left."""
        return footprints(self.center[None], self.size[None], np.array([self.heading]))[0]

    @property
    def corners(self) -> np.ndarray:
        """(8, 3) float64, m: the `footprint` on the floor, then on the roof."""
        return box_corners(self.center[None], self.size[None], np.array([self.heading]))[0]

    def contains(self, xyz: np.ndarray) -> np.ndarray:
        """Which points are inside.

        Args:
          xyz: (n, 3 or more) m, sensor frame; further columns are not looked at.

        Returns:
          (n,) bool; ``xyz[box.contains(xyz)]`` are the points. NaN is outside.
        """
        offset = np.asarray(xyz)[:, :3].astype(np.float64) - self.center
        local = offset @ rotation_about_z(self.heading)
        return np.all(np.abs(local) <= self.size / 2, axis=1)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Detection(Box):
    """One vehicle of a sweep, as iterating over `Detections` gives it."""

    num_points: int
    """Points of the box's cluster inside the box that no better box owns; it can be 0."""
    hull: np.ndarray
    """(h, 2) float32, m: convex hull of those points from above, counter-clockwise; (0, 2) without points."""
    point_detection: np.ndarray = dataclasses.field(compare=False)
    """(N,) int32: of the whole sweep, see `Detections`."""
    row: int = dataclasses.field(compare=False)
    """Of the box in its `Detections`."""

    @property
    def point_rows(self) -> np.ndarray:
        """(m,) int64, ascending: which points those are, rows of the sweep, or of the cloud where that holds
        fewer."""
        return np.flatnonzero(self.point_detection == self.row)
