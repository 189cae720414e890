"""How a sensor stands over the ground, measured from its sweeps, and sweeps seen upright from it.

The detector looks from the origin, with z up. It bears the ground's own slope, but a sensor that is mounted
with a tilt, or points in a vehicle's frame, whose origin lies on the ground, are to be moved first:
`measure_mounting` finds the tilt and the height, and `Mounting.T_level_points` is the way there.
"""

import dataclasses

import numpy as np

from jaxbox.types import GROUND_ABOVE_M

NEAR_M, FAR_M = 3.0, 30.0
"""The ground is fitted to points at these ranges: nearer ones are the ego vehicle, farther ones
other roads."""
MAX_TILT_DEG = 35.0
"""A steeper plane is a wall, or z is not up."""
MIN_SENSOR_HEIGHT_M = 0.7
"""Sensors of road vehicles stand higher: a lower origin is a vehicle's frame's."""
ROOF_HEIGHT_M = 1.73
"""Where a sensor is taken to stand in such a frame, over the origin: as high as KITTI's."""
_CELL_M = 1.0
_NUM_PLANES = 256
_NUM_ROUNDS = 3
_TOLERANCE_M = 0.1
_MIN_INLIER_SHARE = 0.1
_MIN_SPREAD = 1.0
"""Of the three cells of a sample: twice the area (m^2) of their triangle."""


@dataclasses.dataclass(frozen=True)
class Mounting:
    """Where a sensor stands in the frame of its points, and which way is up there."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """x, y, z of the sensor, m, in the frame of the points."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """The ground's unit normal, in the frame of the points."""
    height_m: float | None = None
    """Of the sensor above the ground, or None where it was not measured."""

    @property
    def tilt_deg(self) -> float:
        """Between z and the ground's normal, in [0, 180]."""
        return float(np.degrees(np.arctan2(np.hypot(*self.up[:2]), self.up[2])))

    @property
    def is_upside_down(self) -> bool:
        """Whether the ground lies clearly above the sensor, as `Status.GROUND_ABOVE` says."""
        return self.height_m is not None and self.height_m < -GROUND_ABOVE_M

    @property
    def T_level_points(self) -> np.ndarray:
        """(4, 4) float64: from the frame of the points to the level frame.

        The level frame has the sensor at its origin and the ground's normal along z. Of all turns that bring
        it there this is the least, about a horizontal axis: headings stay what they are.
        """
        T = np.eye(4)
        T[:3, :3] = _least_turn(np.asarray(self.up, np.float64))
        T[:3, 3] = -T[:3, :3] @ np.asarray(self.position)
        return T

    def raised(self) -> "Mounting":
        """The same sensor, at a roof's height where its origin is on the ground and cannot be a sensor's."""
        if self.height_m is None or self.height_m >= MIN_SENSOR_HEIGHT_M:
            return self
        lift = ROOF_HEIGHT_M - self.height_m
        x, y, z = (float(p + lift * u) for p, u in zip(self.position, self.up, strict=True))
        return Mounting((x, y, z), self.up, ROOF_HEIGHT_M)

    def level(self, xyz: np.ndarray) -> np.ndarray:
        """Moves points into the level frame.

        Args:
          xyz: (n, 3) m, in their own frame.

        Returns:
          (n, 3) float32, m; NaN and infinity stay what they are.
        """
        T = self.T_level_points
        finite = np.isfinite(xyz).all(axis=1)
        # Beyond float32's range numbers become infinite, and are counted by the detector, as NaN of any kind.
        with np.errstate(over="ignore", invalid="ignore"):
            moved = np.array(xyz, np.float32)
            moved[finite] = xyz[finite].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        return moved


def measure_mounting(
    xyz: np.ndarray, *, position: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Mounting | None:
    """Measures height and tilt of a sensor from the ground round it.

    A plane through most of the lowest points of 1 m cells, by RANSAC; the cells stand along the plane found
    so far, and it is fitted again.

    Args:
      xyz: (n, 3) m; NaN and infinity are ignored.
      position: x, y, z of the sensor in the frame of the points, m.

    Returns:
      The mounting, or None where no plane has a tenth of the cells.

    >>> x, y = np.mgrid[-20:20, -20:20]
    >>> floor = np.column_stack([x.ravel(), y.ravel(), 0.1 * x.ravel() - 1.8])
    >>> mounting = measure_mounting(floor)
    >>> round(mounting.height_m, 2), round(mounting.tilt_deg, 1)
    (1.79, 5.7)
    """
    points = np.asarray(xyz, np.float64)
    points = points[np.isfinite(points).all(axis=1) & np.any(xyz, axis=1)] - position
    up, height_m = np.array([0.0, 0.0, 1.0]), 0.0
    for _ in range(_NUM_ROUNDS):
        turn = _least_turn(up)
        plane = fit_ground(points @ turn.T)
        if plane is None:
            return None
        normal = np.array([-plane[0], -plane[1], 1.0]) / np.linalg.norm([*plane[:2], 1.0])
        up, height_m = turn.T @ normal, -plane[2] * normal[2]
    if up[2] < np.cos(np.radians(MAX_TILT_DEG)):
        return None
    return Mounting(position, (float(up[0]), float(up[1]), float(up[2])), float(height_m))


def fit_ground(xyz: np.ndarray) -> np.ndarray | None:
    """The plane z = a x + b y + c through most of the lowest points of 1 m cells near the sensor.

    Args:
      xyz: (n, 3) finite, m.

    Returns:
      (3,) a, b, c; or None where no plane has enough of them.
    """
    lowest = _lowest_of_cells(xyz)
    if len(lowest) < 2 * len("xyz"):
        return None
    ones = np.column_stack([lowest[:, :2], np.ones(len(lowest))])
    samples = np.random.default_rng(0).integers(len(lowest), size=(_NUM_PLANES, 3))
    regular = np.abs(np.linalg.det(ones[samples])) > _MIN_SPREAD
    if not regular.any():
        return None
    planes = np.linalg.solve(ones[samples][regular], lowest[samples][regular][..., 2:])[..., 0]
    inliers = np.abs(ones @ planes.T - lowest[:, 2:]) < _TOLERANCE_M
    inliers &= np.hypot(planes[:, 0], planes[:, 1]) < np.tan(np.radians(MAX_TILT_DEG))
    best = inliers[:, inliers.sum(axis=0).argmax()]
    if best.sum() < max(len("xyz"), _MIN_INLIER_SHARE * len(lowest)):
        return None
    return np.linalg.lstsq(ones[best], lowest[best, 2], rcond=None)[0]


def _lowest_of_cells(xyz: np.ndarray) -> np.ndarray:
    """(m, 3) the lowest point of each cell round the sensor."""
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    near = xyz[(rho > NEAR_M) & (rho < FAR_M)]
    cells = np.floor(near[:, :2] / _CELL_M).astype(int)
    order = np.lexsort((near[:, 2], cells[:, 1], cells[:, 0]))
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(cells[order], axis=0) != 0).any(axis=1)
    return near[order][first]


def _least_turn(up: np.ndarray) -> np.ndarray:
    """(3, 3) the rotation about a horizontal axis that takes `up` to z (Rodrigues' formula)."""
    x, y, z = up
    cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
    return np.eye(3) + cross + cross @ cross / (1 + z)
