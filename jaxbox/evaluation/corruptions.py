"""Sweeps made worse on purpose: lost beams, noise, fog, spurious returns, motion, a calibration that is off.

Each function takes one sweep and how much of a thing happens to it; at the amount given as "none" it changes
nothing. They answer "how does the answer fall off", not "how will it be in rain": real weather has more to it
than the models below. Points keep their order, and none is added, so that a corrupted sweep has at most the
points of the clean one.

References: Dong et al., "Benchmarking Robustness of 3D Object Detection to Common Corruptions", CVPR 2023
(kinds, and the scale of noise); Hahner et al., "Fog Simulation on Real LiDAR Point Clouds for 3D Object
Detection in Adverse Weather", ICCV 2021 (the LiDAR equation in fog); Goodin et al., "Predicting the
Influence of Rain on LIDAR in ADAS", Electronics 8(1), 2019 (loss and noise by the rate of rain).
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree

from jaxbox.evaluation.beams import beam_of_points

Points = tuple[np.ndarray, np.ndarray]
"""(n, 3) float32, m, sensor frame; (n,) float32, the sensor's own unit."""

REACH_M = 120.0
"""Range to which a surface that reflects everything is seen in clear air (HDL-64E: 120 m for a car)."""

BACKSCATTER_SHARE = 0.3
"""Of the beams that fog takes, the share that come back from the fog itself."""

MIN_RANGE_M = 2.0
"""Spurious returns are at least this far: an HDL-64E reports none nearer than 0.9 m, and the ego vehicle
is excluded."""

ROAD_BELOW_M = 1.3
"""What lies lower than this below the sensor is taken for road, for sensors at about 1.7 m."""

REFLECTION_DEPTHS_M = (0.2, 0.8)
"""How far below the road beams seem to end that it reflects."""

MIRRORED_FROM_M = 0.3
"""What stands higher above the road is mirrored in it."""

SAME_BEAM_RAD = 0.01
"""A beam that is nearer to the direction of a mirror image shows it, if it met the road."""

RAIN_EXTINCTION, RAIN_NOISE = 0.01, 0.02
"""Goodin et al.: loss a metre at 1 mm/h, and the largest error of a range, as a share of it."""

SNOW_RANGE_M = 5.0
"""Mean range of flakes beyond the nearest: nearly all returns from snow lie within 20 m of the sensor."""

PLUME_RADIUS_M = 1.2
"""Of the spray that wheels throw up: as wide as the car, as high as its roof."""

PLUME_RANGES_M = (6.0, 30.0)
"""Ranges of the plumes."""

PLUME_Z_M = -1.0
"""Of their centres, about .7 m above the road for sensors at about 1.7 m."""

PLUME_SHARE = 0.5
"""Of the beams through a plume that come back from it."""

SWEEP_PERIOD_S = 0.1
"""Of one turn."""


def thin_beams(xyz: np.ndarray, intensity: np.ndarray, one_in: float, rng: np.random.Generator) -> Points:
    """Keeps every n-th beam, as a sensor with fewer beams over the same angles would have them.

    Args:
      xyz: (n, 3) m, beam by beam, see `jaxbox.evaluation.beams.beam_of_points`.
      intensity: (n,).
      one_in: 1 keeps all (none lost), 2 every second, ...
      rng: not used, every run is the same.

    Returns:
      The points of the beams kept: the last of each `one_in`, so that of 64 beams from the top the lowest,
      which shows the ground near by, is among them.
    """
    beam = beam_of_points(xyz)
    keep = beam % int(one_in) == int(one_in) - 1
    return xyz[keep], intensity[keep]


def lose_points(xyz: np.ndarray, intensity: np.ndarray, share: float, rng: np.random.Generator) -> Points:
    """Loses points at random, each with the same probability.

    Args:
      xyz: (n, 3) m.
      intensity: (n,).
      share: probability, 0 (none) to 1.
      rng: draws them.

    Returns:
      The points left.
    """
    keep = rng.random(len(xyz)) >= share
    return xyz[keep], intensity[keep]


def add_range_noise(xyz: np.ndarray, intensity: np.ndarray, std_m: float, rng: np.random.Generator) -> Points:
    """Moves each point along its beam by Gaussian noise.

    Args:
      xyz: (n, 3) m.
      intensity: (n,).
      std_m: standard deviation, m; 0 is none. Dong et al. go up to 0.1.
      rng: draws the noise.

    Returns:
      As many points.
    """
    distance = np.maximum(np.linalg.norm(xyz, axis=1), np.finfo(np.float32).tiny)
    scale = 1 + rng.normal(0, 1, len(xyz)) * std_m / distance
    return (xyz * np.maximum(scale, 0)[:, None]).astype(np.float32), intensity


def add_fog(xyz: np.ndarray, intensity: np.ndarray, visibility_m: float, rng: np.random.Generator) -> Points:
    """Weakens returns by fog, loses those that are too weak, and lets some of them come back from the fog.

    A return from R has the power rho / R^2 exp(-2 alpha R), with alpha = ln(20) / visibility (Koschmieder;
    Hahner et al.), and is seen where that is at least 1 / REACH_M^2. What was seen in clear air had a
    reflectivity of at least (R / REACH_M)^2; it is taken as uniform from there to 1, since some recordings
    have no intensity. Beams that return from fog do so at a range of density exp(-2 alpha r).

    Args:
      xyz: (n, 3) m.
      intensity: (n,).
      visibility_m: meteorological optical range, m; infinity is none.
      rng: draws which beams are lost, and where from fog returns.

    Returns:
      The points left, with intensities weakened; those from the fog have intensity 0.
    """
    alpha = math.log(20) / visibility_m
    distance = np.linalg.norm(xyz, axis=1).astype(np.float64)
    seen = _seen_through(distance, alpha, rng)
    scattered = ~seen & (rng.random(len(xyz)) < BACKSCATTER_SHARE) & (distance > MIN_RANGE_M)
    near = _truncated_exponential(rng.random(len(xyz)), 2 * alpha, MIN_RANGE_M, distance)
    scale = np.where(scattered, near / np.maximum(distance, MIN_RANGE_M), 1)
    weaker = np.where(scattered, 0, intensity * np.exp(-2 * alpha * distance))
    keep = seen | scattered
    return (xyz * scale[:, None]).astype(np.float32)[keep], weaker.astype(np.float32)[keep]


def _truncated_exponential(share: np.ndarray, rate: float, low: float, high: np.ndarray) -> np.ndarray:
    """Quantiles of the density exp(-rate r) over low to high; uniform where the rate is 0."""
    width = np.maximum(high - low, 0)
    if rate == 0:
        return low + share * width
    return low - np.log1p(share * np.expm1(-rate * width)) / rate


def add_clutter(xyz: np.ndarray, intensity: np.ndarray, share: float, rng: np.random.Generator) -> Points:
    """Ends beams early at random, as drops, flakes and crosstalk do.

    Args:
      xyz: (n, 3) m.
      intensity: (n,).
      share: probability of each beam, 0 (none) to 1.
      rng: draws which, and where: uniform from `MIN_RANGE_M` to the return.

    Returns:
      As many points; spurious ones have intensity 0.
    """
    distance = np.linalg.norm(xyz, axis=1)
    spurious = (rng.random(len(xyz)) < share) & (distance > MIN_RANGE_M)
    near = MIN_RANGE_M + rng.random(len(xyz)) * (distance - MIN_RANGE_M)
    scale = np.where(spurious, near / np.maximum(distance, MIN_RANGE_M), 1)
    return (xyz * scale[:, None]).astype(np.float32), np.where(spurious, 0, intensity).astype(np.float32)


def add_rain(xyz: np.ndarray, intensity: np.ndarray, rate_mm_h: float, rng: np.random.Generator) -> Points:
    """Weakens returns by rain, loses the too weak, and blurs the ranges of the others (Goodin et al.).

    As in `add_fog` a return from R has the power rho / R^2 exp(-2 alpha R), with alpha = .01 r^.6 / m as they
    fit it to a rate of r mm/h; the error of its range has the deviation .02 R (1 - exp(-r))^2.

    Args:
      xyz: (n, 3) m.
      intensity: (n,).
      rate_mm_h: r, mm/h; 0 is none, 10 heavy rain, 50 a cloudburst.
      rng: draws which beams are lost, and the errors.

    Returns:
      The points left, with intensities weakened.
    """
    alpha = RAIN_EXTINCTION * rate_mm_h**0.6
    distance = np.linalg.norm(xyz, axis=1).astype(np.float64)
    seen = _seen_through(distance, alpha, rng)
    std_m = RAIN_NOISE * distance * (1 - math.exp(-rate_mm_h)) ** 2
    scale = 1 + rng.normal(0, 1, len(xyz)) * std_m / np.maximum(distance, MIN_RANGE_M)
    weaker = intensity * np.exp(-2 * alpha * distance)
    return (xyz * scale[:, None]).astype(np.float32)[seen], weaker.astype(np.float32)[seen]


def _seen_through(distance: np.ndarray, alpha: float, rng: np.random.Generator) -> np.ndarray:
    """(n,) bool: which returns are still strong enough where air takes exp(-alpha) a metre, see `add_fog`."""
    least = np.minimum((distance / REACH_M) ** 2, 1)
    reflectivity = least + (1 - least) * rng.random(len(distance))
    return reflectivity * np.exp(-2 * alpha * distance) >= least


def add_snow(xyz: np.ndarray, intensity: np.ndarray, share: float, rng: np.random.Generator) -> Points:
    """Ends beams early near the sensor, as flakes, dust and exhaust do.

    Args:
      xyz: (n, 3) m.
      intensity: (n,).
      share: probability of each beam, 0 (none) to 1.
      rng: draws which, and where: `MIN_RANGE_M` and more by an exponential of mean `SNOW_RANGE_M`, where that
        is before the return.

    Returns:
      As many points; those of flakes have intensity 0.
    """
    distance = np.linalg.norm(xyz, axis=1)
    near = MIN_RANGE_M + rng.exponential(SNOW_RANGE_M, len(xyz))
    return _end_at(xyz, intensity, near, (rng.random(len(xyz)) < share) & (near < distance))


def add_spray(xyz: np.ndarray, intensity: np.ndarray, num_plumes: float, rng: np.random.Generator) -> Points:
    """Puts clouds of drops on the road, as wheels throw them up where it is wet.

    Args:
      xyz: (n, 3) m.
      intensity: (n,).
      num_plumes: how many; 0 is none.
      rng: draws where, in a ring of `PLUME_RANGES_M`, which beams return from inside, and where on their way
        through.

    Returns:
      As many points; those of drops have intensity 0.
    """
    for _ in range(int(num_plumes)):
        angle, rho = rng.uniform(0, math.tau), rng.uniform(*PLUME_RANGES_M)
        center = np.array([rho * math.cos(angle), rho * math.sin(angle), PLUME_Z_M])
        distance = np.maximum(np.linalg.norm(xyz, axis=1), np.finfo(np.float32).tiny)
        along = xyz @ center / distance
        half_sq = PLUME_RADIUS_M**2 - (center @ center - along**2)
        half = np.sqrt(np.maximum(half_sq, 0))
        near = along + rng.uniform(-1, 1, len(xyz)) * half
        inside = (half_sq > 0) & (near > MIN_RANGE_M) & (near < distance)
        xyz, intensity = _end_at(xyz, intensity, near, inside & (rng.random(len(xyz)) < PLUME_SHARE))
    return xyz, intensity


def _end_at(xyz: np.ndarray, intensity: np.ndarray, range_m: np.ndarray, early: np.ndarray) -> Points:
    """Some beams end at another range, with intensity 0."""
    distance = np.maximum(np.linalg.norm(xyz, axis=1), np.finfo(np.float32).tiny)
    scale = np.where(early, range_m / distance, 1)
    return (xyz * scale[:, None]).astype(np.float32), np.where(early, 0, intensity).astype(np.float32)


def reflect_below_road(
    xyz: np.ndarray, intensity: np.ndarray, share: float, rng: np.random.Generator
) -> Points:
    """Lets some beams that meet the road end farther on, below it, as puddles and wet asphalt do.

    Args:
      xyz: (n, 3) m.
      intensity: (n,).
      share: of all points, 0 (none) to 1; no more than lie lower than `ROAD_BELOW_M`.
      rng: draws which, and how far below the road, uniform in `REFLECTION_DEPTHS_M`.

    Returns:
      As many points.
    """
    on_road = np.flatnonzero(xyz[:, 2] < -ROAD_BELOW_M)
    rows = rng.permutation(on_road)[: round(share * len(xyz))]
    z, moved = xyz[rows, 2], xyz.astype(np.float32)
    moved[rows] *= ((z - rng.uniform(*REFLECTION_DEPTHS_M, len(rows))) / z)[:, None].astype(np.float32)
    return moved, intensity


def mirror_in_road(xyz: np.ndarray, intensity: np.ndarray, share: float, rng: np.random.Generator) -> Points:
    """Lets some beams that meet the road end at the mirror image of what stands beyond, as on a wet road.

    The image lies as far below the road, level for this, as the thing above it: the beam has gone as far.
    Only beams that met the road show one.

    Args:
      xyz: (n, 3) m.
      intensity: (n,).
      share: of all points, 0 (none) to 1; no more than the road shows.
      rng: draws which.

    Returns:
      As many points.
    """
    on_road, moved = xyz[:, 2] < -ROAD_BELOW_M, xyz.astype(np.float32)
    if share == 0 or not on_road.any():
        return moved, intensity
    road_z = np.median(xyz[on_road, 2])
    images = xyz[xyz[:, 2] > road_z + MIRRORED_FROM_M]
    images[:, 2] = 2 * road_z - images[:, 2]
    away, beam = map(np.asarray, KDTree(_directions(xyz)).query(_directions(images)))
    seen = rng.permutation(np.flatnonzero((away < SAME_BEAM_RAD) & on_road[beam]))
    # One image a beam.
    _, first = np.unique(beam[seen], return_index=True)
    chosen = rng.permutation(seen[first])[: round(share * len(xyz))]
    moved[beam[chosen]] = images[chosen]
    return moved, intensity


def _directions(xyz: np.ndarray) -> np.ndarray:
    return xyz / np.maximum(np.linalg.norm(xyz, axis=1, keepdims=True), np.finfo(np.float32).tiny)


def drive_during_sweep(
    xyz: np.ndarray, intensity: np.ndarray, speed_m_s: float, rng: np.random.Generator
) -> Points:
    """Distorts a sweep as if the sensor drove straight on while it turned, without compensation.

    A point at azimuth phi is seen phi / 2 pi of a period after the sensor looked straight ahead, and then is
    nearer by the distance driven. The distortion comes on top of what the recording has.

    Args:
      xyz: (n, 3) m.
      intensity: (n,).
      speed_m_s: m/s along x; 0 is none.
      rng: not used.

    Returns:
      As many points.
    """
    shift = np.zeros_like(xyz)
    shift[:, 0] = speed_m_s * _firing_time(xyz)
    return (xyz - shift).astype(np.float32), intensity


def turn_during_sweep(
    xyz: np.ndarray, intensity: np.ndarray, rate_deg_s: float, rng: np.random.Generator
) -> Points:
    """Distorts a sweep as if the ego vehicle turned meanwhile, see `drive_during_sweep`.

    Args:
      xyz: (n, 3) m.
      intensity: (n,).
      rate_deg_s: degrees a second, to the left; 0 is none.
      rng: not used.

    Returns:
      As many points.
    """
    angle = -np.radians(rate_deg_s) * _firing_time(xyz)
    cos, sin, (x, y, z) = np.cos(angle), np.sin(angle), xyz.T
    return np.column_stack([cos * x - sin * y, sin * x + cos * y, z]).astype(np.float32), intensity


def _firing_time(xyz: np.ndarray) -> np.ndarray:
    """(n,) s, from -half a period to half a period; 0 straight ahead."""
    return SWEEP_PERIOD_S / math.tau * np.arctan2(xyz[:, 1], xyz[:, 0])


def rotate_calibration(T_rect_velo: np.ndarray, angle_deg: float, rng: np.random.Generator) -> np.ndarray:
    """A LiDAR-to-camera transform that is turned about a random axis through the LiDAR.

    Args:
      T_rect_velo: (4, 4) rigid transform.
      angle_deg: degrees; 0 is none.
      rng: draws the axis, uniform on the sphere.

    Returns:
      (4, 4) float32.
    """
    axis = rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    # Rodrigues' formula.
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = math.radians(angle_deg)
    T_error = np.eye(4)
    T_error[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return (np.asarray(T_rect_velo, np.float64) @ T_error).astype(np.float32)


def shift_calibration(T_rect_velo: np.ndarray, distance_m: float, rng: np.random.Generator) -> np.ndarray:
    """A LiDAR-to-camera transform that is moved in a random direction.

    Args:
      T_rect_velo: (4, 4) rigid transform.
      distance_m: m; 0 is none.
      rng: draws the direction, uniform on the sphere.

    Returns:
      (4, 4) float32.
    """
    direction = rng.normal(size=3)
    T_error = np.eye(4)
    T_error[:3, 3] = distance_m * direction / np.linalg.norm(direction)
    return (np.asarray(T_rect_velo, np.float64) @ T_error).astype(np.float32)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Corruption:
    """One kind of corruption at five severities."""

    title: str
    """What happens, in words."""
    unit: str
    """Of the amounts."""
    none: float
    """The amount that changes nothing."""
    amounts: tuple[float, ...]
    """Of severity 1 to 5."""
    of_points: Callable[[np.ndarray, np.ndarray, float, np.random.Generator], Points] | None = None
    """Corrupts the points; None where the calibration is."""
    of_calibration: Callable[[np.ndarray, float, np.random.Generator], np.ndarray] | None = None
    """Corrupts T_rect_velo; None where the points are."""


CORRUPTIONS: dict[str, Corruption] = {
    "beams": Corruption(
        title="beam loss", unit="x fewer beams", none=1, amounts=(2, 3, 4, 8, 16), of_points=thin_beams
    ),
    "dropout": Corruption(
        title="lost points",
        unit="share lost",
        none=0,
        amounts=(0.25, 0.5, 0.75, 0.9, 0.95),
        of_points=lose_points,
    ),
    "noise": Corruption(
        title="range noise",
        unit="m, standard deviation",
        none=0,
        amounts=(0.02, 0.05, 0.1, 0.2, 0.4),
        of_points=add_range_noise,
    ),
    "fog": Corruption(
        title="fog", unit="m visibility", none=math.inf, amounts=(400, 200, 100, 50, 25), of_points=add_fog
    ),
    "rain": Corruption(title="rain", unit="mm/h", none=0, amounts=(0.5, 1, 5, 20, 50), of_points=add_rain),
    "snow": Corruption(
        title="snow", unit="share of beams", none=0, amounts=(0.01, 0.02, 0.05, 0.1, 0.2), of_points=add_snow
    ),
    "spray": Corruption(
        title="spray", unit="plumes", none=0, amounts=(4, 8, 16, 32, 64), of_points=add_spray
    ),
    "clutter": Corruption(
        title="spurious returns",
        unit="share of beams",
        none=0,
        amounts=(0.01, 0.02, 0.05, 0.1, 0.2),
        of_points=add_clutter,
    ),
    "reflections": Corruption(
        title="returns from below the road",
        unit="share of points",
        none=0,
        amounts=(0.001, 0.002, 0.005, 0.01, 0.02),
        of_points=reflect_below_road,
    ),
    "mirrored": Corruption(
        title="mirror images",
        unit="share of points",
        none=0,
        amounts=(0.001, 0.003, 0.01, 0.03, 0.06),
        of_points=mirror_in_road,
    ),
    "speed": Corruption(
        title="driving during the sweep",
        unit="m/s",
        none=0,
        amounts=(5, 10, 15, 20, 30),
        of_points=drive_during_sweep,
    ),
    "turning": Corruption(
        title="turning during the sweep",
        unit="degrees/s",
        none=0,
        amounts=(5, 10, 20, 40, 80),
        of_points=turn_during_sweep,
    ),
    "calibration_angle": Corruption(
        title="calibration turned",
        unit="degrees",
        none=0,
        amounts=(0.25, 0.5, 1, 2, 4),
        of_calibration=rotate_calibration,
    ),
    "calibration_shift": Corruption(
        title="calibration moved",
        unit="m",
        none=0,
        amounts=(0.02, 0.05, 0.1, 0.2, 0.4),
        of_calibration=shift_calibration,
    ),
}
"""Those that `benchmarks.bench_corruption` measures."""
