"""The ground of a scene: a height over every (x, y), and where rays meet it."""

import dataclasses
from typing import Literal

import numpy as np

GroundKind = Literal["flat", "sloped", "uneven", "none"]

SENSOR_HEIGHT_M = 1.73
"""Height of the sensor above the ground below it (the KITTI car, Geiger et al. 2013)."""
MAX_RANGE_M = 120.0
"""Reach of the sensor (HDL-64E)."""
MAX_SLOPE_DEG = 15.0
"""Steeper than any road; also bounds how far up a ray is looked for on the ground."""
KERB_HEIGHT_M = 0.12
KERB_RUN_M = 0.04
"""The kerb's face rises over so much, so that the ground stays a function of (x, y)."""


@dataclasses.dataclass(frozen=True)
class Road:
    """A straight road past the sensor."""

    heading: float = 0.0
    """rad: its direction from +x about +z."""
    center_offset_m: float = 1.75
    """How far left of the sensor its centre line is."""
    half_width_m: float = 5.7
    """Centre line to kerb: a lane and a parking bay."""

    def to_xy(self, along: np.ndarray, across: np.ndarray) -> np.ndarray:
        """(..., 2) sensor frame, m, of points ``along`` the road and ``across``, left of its centre."""
        left = across + self.center_offset_m
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.stack([c * along - s * left, s * along + c * left], axis=-1)

    def across(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Distance left of the centre line, m."""
        return np.cos(self.heading) * y - np.sin(self.heading) * x - self.center_offset_m

    def along(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Distance along the road from the sensor, m."""
        return np.cos(self.heading) * x + np.sin(self.heading) * y


@dataclasses.dataclass(frozen=True)
class Terrain:
    """Height of the ground: a slope, waves, a crest and a kerb, added up."""

    road: Road = Road()
    """The road, for the kerb and the surface."""
    gradient: tuple[float, float] = (0.0, 0.0)
    """Rise per metre along x and y."""
    waves: tuple[tuple[float, float, float, float], ...] = ()
    """(amplitude m, wave number x and y rad/m, phase rad) each."""
    crest: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """(x m, half-width m, gradient): beyond x the ground falls off ever steeper, up to the gradient."""
    kerb_height_m: float = 0.0
    """Height of the sidewalk above the road."""
    visible: bool = True
    """False: things stand on it, but beams pass through."""
    sensor_height_m: float = SENSOR_HEIGHT_M
    """Of the origin above the ground below it."""

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Ground height z, m, sensor frame; minus the sensor's height at the origin."""
        return self._raw(x, y) - self._raw(np.zeros(()), np.zeros(())) - self.sensor_height_m

    def _raw(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        z = self.gradient[0] * x + self.gradient[1] * y
        for amplitude, kx, ky, phase in self.waves:
            z = z + amplitude * np.sin(kx * x + ky * y + phase)
        start, width, fall = self.crest
        if fall:
            z = z - fall * width * np.logaddexp(0, (x - start) / width)
        if self.kerb_height_m:
            beyond = np.abs(self.road.across(x, y)) - self.road.half_width_m
            z = z + self.kerb_height_m * np.clip(beyond / KERB_RUN_M, 0, 1)
        return z

    def normal(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(..., 3) unit, upward normals, by central differences over a step of 1 cm."""
        step = 0.01
        slope_x = (self.height(x + step, y) - self.height(x - step, y)) / (2 * step)
        slope_y = (self.height(x, y + step) - self.height(x, y - step)) / (2 * step)
        normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)

    def first_hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distance along each ray to the ground.

        Marches in steps of 8 % of the distance until a ray is below ground, then bisects. Features
        thinner than a step can be jumped, but a ray cannot stay below ground unnoticed.

        Args:
          origins: (3,), m, above ground.
          directions: (n, 3), unit.

        Returns:
          (n,), m, to within 1 mm; infinite for a miss.
        """
        distance = np.full(len(directions), np.inf)
        if not self.visible:
            return distance
        near = np.ones(len(directions))
        far = np.full(len(directions), np.nan)
        active = np.flatnonzero(directions[:, 2] < np.sin(np.radians(MAX_SLOPE_DEG)))
        for reach in np.geomspace(1.0, MAX_RANGE_M, MARCH_STEPS):
            below = self._clearance(origins, directions[active], reach) < 0
            far[active[below]] = reach
            active = active[~below]
            near[active] = reach
        rows = np.flatnonzero(~np.isnan(far))
        distance[rows] = self._bisect(origins, directions[rows], near[rows], far[rows])
        return distance

    def _bisect(
        self, origin: np.ndarray, directions: np.ndarray, near: np.ndarray, far: np.ndarray
    ) -> np.ndarray:
        for _ in range(BISECTIONS):
            middle = (near + far) / 2
            below = self._clearance(origin, directions, middle) < 0
            near, far = np.where(below, near, middle), np.where(below, middle, far)
        return (near + far) / 2

    def _clearance(
        self, origin: np.ndarray, directions: np.ndarray, distance: np.ndarray | float
    ) -> np.ndarray:
        x = origin[0] + distance * directions[:, 0]
        y = origin[1] + distance * directions[:, 1]
        return origin[2] + distance * directions[:, 2] - self.height(x, y)


MARCH_STEPS = 63
BISECTIONS = 14


def make_terrain(
    rng: np.random.Generator,
    *,
    ground: GroundKind = "flat",
    slope_deg: float = 4.0,
    slope_azimuth_deg: float = 0.0,
    kerb: bool = False,
    road: Road | None = None,
) -> Terrain:
    """Draws the ground of a scene.

    Args:
      rng: draws the waves and the crest of uneven ground.
      ground: "flat", "sloped", "uneven", or "none" for flat ground that beams pass through.
      slope_deg: steepness of sloped ground, degrees, at most `MAX_SLOPE_DEG` either way.
      slope_azimuth_deg: the direction in which it rises, degrees from +x about +z.
      kerb: whether a sidewalk stands `KERB_HEIGHT_M` above the road.
      road: where the road runs; straight ahead by default.

    Returns:
      A terrain `SENSOR_HEIGHT_M` below the origin.

    Raises:
      ValueError: for an unknown kind or a slope out of range.
    """
    if ground not in ("flat", "sloped", "uneven", "none"):
        raise ValueError(f"ground is {ground!r}; it must be 'flat', 'sloped', 'uneven' or 'none'.")
    if abs(slope_deg) > MAX_SLOPE_DEG:
        raise ValueError(f"slope_deg is {slope_deg}; it must lie within +-{MAX_SLOPE_DEG}.")
    terrain = Terrain(
        road=road or Road(), kerb_height_m=KERB_HEIGHT_M if kerb else 0.0, visible=ground != "none"
    )
    if ground == "sloped":
        rise, azimuth = np.tan(np.radians(slope_deg)), np.radians(slope_azimuth_deg)
        gradient = (float(rise * np.cos(azimuth)), float(rise * np.sin(azimuth)))
        return dataclasses.replace(terrain, gradient=gradient)
    if ground == "uneven":
        return dataclasses.replace(terrain, waves=_draw_waves(rng), crest=_draw_crest(rng))
    return terrain


def _draw_waves(rng: np.random.Generator) -> tuple[tuple[float, float, float, float], ...]:
    """Three waves of 25 to 70 m, of a steepness of up to 1.2 degrees each."""
    waves = []
    for _ in range(3):
        number = 2 * np.pi / rng.uniform(25, 70)
        azimuth, phase = rng.uniform(-np.pi, np.pi, 2)
        amplitude = rng.uniform(0.01, 0.02) / number
        along_x, along_y = number * np.cos(azimuth), number * np.sin(azimuth)
        waves.append((float(amplitude), float(along_x), float(along_y), float(phase)))
    return tuple(waves)


def _draw_crest(rng: np.random.Generator) -> tuple[float, float, float]:
    """The road falls off by 2 to 4 degrees beyond 18 to 35 m."""
    fall = np.tan(np.radians(rng.uniform(2, 4)))
    return float(rng.uniform(18, 35)), float(rng.uniform(3, 6)), float(fall)
