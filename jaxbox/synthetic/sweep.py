"""A spinning LiDAR sensor that looks at a scene, and the truth about what it saw."""

import dataclasses

import numpy as np

from jaxbox.synthetic.camera import make_calibration, render_image
from jaxbox.synthetic.raycast import Hits, cast
from jaxbox.synthetic.scene import Clutter, Scene, Thing, make_scene, vehicle_pose
from jaxbox.synthetic.solids import GLASS_REFLECTED, Material, make_solid
from jaxbox.synthetic.terrain import MAX_RANGE_M, GroundKind, make_terrain
from jaxbox.types import Calibration

BEAM_INDEX = (0.0, 31.0, 32.0, 63.0)
BEAM_ELEVATION_DEG = (2.0, -8.33, -8.83, -24.33)
"""HDL-64E: an upper block of 32 beams 1/3 degree apart and a lower block 1/2 degree apart."""
NUM_BEAMS = 64
NUM_AZIMUTHS = 2000
"""0.18 degrees apart: 10 turns a second."""
RANGE_NOISE_M = 0.02
"""Standard deviation of a range (HDL-64E: below 2 cm)."""
DROPOUT = 0.03
"""Share of the beams that are lost for no reason."""
REFLECTANCE = {
    Material.ROAD: 0.28,
    Material.SIDEWALK: 0.34,
    Material.GRASS: 0.42,
    Material.GLASS: 0.08,
    Material.TYRE: 0.06,
    Material.WALL: 0.38,
    Material.POLE: 0.5,
    Material.FOLIAGE: 0.4,
}
"""At 905 nm, in [0, 1]; paint has that of its colour."""
DETECTION_POWER = 1.6e-6
"""Received power, reflectance x cos(incidence) / range^2, at which a third of the returns are lost:
a road is seen to about 50 m, a wall to the end of the range."""


@dataclasses.dataclass(frozen=True)
class TruthBoxes:
    """The vehicles of a scene; V of them, in the order of their object ids."""

    center: np.ndarray
    """(V, 3) float64, m, sensor frame: the bottom stands on the ground below the middle."""
    size: np.ndarray
    """(V, 3) float64, m: length, width, height."""
    yaw: np.ndarray
    """(V,) float64, rad, in [-pi/2, pi/2): length axis from +x about +z."""
    label: np.ndarray
    """(V,) int64: a `jaxbox.Label`."""
    num_points: np.ndarray
    """(V,) int64: points of the sweep on each."""
    visible: np.ndarray
    """(V,) float64, in [0, 1]: of the beams that would meet it in an empty world, the share that do."""

    def __len__(self) -> int:
        return len(self.yaw)


@dataclasses.dataclass(frozen=True)
class SyntheticSweep:
    """One turn of the sensor, n points ordered by beam from the top, then by azimuth."""

    xyz: np.ndarray
    """(n, 3) float32, m, sensor frame."""
    intensity: np.ndarray
    """(n,) float32, in [0, 1]."""
    object_id: np.ndarray
    """(n,) int64: index of the vehicle in `boxes`, or a `Clutter` code."""
    is_ground: np.ndarray
    """(n,) bool: points on the ground."""
    boxes: TruthBoxes
    """The vehicles, also those that hold no point."""
    calibration: Calibration
    """The camera that looks along +x."""
    image: np.ndarray | None
    """(h, w, 3) uint8 RGB of the same scene, or None."""
    scene: Scene
    """The scene itself; `scene.terrain.height(x, y)` is the true ground."""


def make_sweep(
    seed: int = 0,
    *,
    num_vehicles: int = 12,
    clutter: bool = True,
    ground: GroundKind = "flat",
    slope_deg: float = 4.0,
    slope_azimuth_deg: float = 0.0,
    kerb: bool = False,
    num_beams: int = NUM_BEAMS,
    num_azimuths: int = NUM_AZIMUTHS,
    range_noise_m: float = RANGE_NOISE_M,
    dropout: float = DROPOUT,
    image: bool = False,
) -> SyntheticSweep:
    """A sweep over a drawn street, with exact truth: `make_scene`, then `scan`.

    Args:
      seed: the same seed and options give the same bits.
      num_vehicles: see `make_scene`, as the next five.
      clutter: whether there are walls, poles, trees and bushes.
      ground: "flat", "sloped", "uneven" or "none".
      slope_deg: steepness of sloped ground, degrees.
      slope_azimuth_deg: the direction in which it rises.
      kerb: whether there is a raised sidewalk.
      num_beams: see `scan`, as the rest.
      num_azimuths: beams' firings a turn.
      range_noise_m: standard deviation along the beam, m.
      dropout: share of returns lost at random.
      image: whether the camera's picture is rendered too, which takes some seconds.

    Returns:
      About 100,000 points at the default resolution.

    >>> sweep = make_sweep(0, num_azimuths=90)
    >>> len(sweep.boxes), sweep.xyz.shape[1]
    (12, 3)
    """
    scene = make_scene(
        seed,
        num_vehicles=num_vehicles,
        clutter=clutter,
        ground=ground,
        slope_deg=slope_deg,
        slope_azimuth_deg=slope_azimuth_deg,
        kerb=kerb,
    )
    return scan(
        scene,
        seed,
        num_beams=num_beams,
        num_azimuths=num_azimuths,
        range_noise_m=range_noise_m,
        dropout=dropout,
        image=image,
    )


def scan(
    scene: Scene,
    seed: int = 0,
    *,
    num_beams: int = NUM_BEAMS,
    num_azimuths: int = NUM_AZIMUTHS,
    range_noise_m: float = RANGE_NOISE_M,
    dropout: float = DROPOUT,
    image: bool = False,
    elevation_deg: tuple[float, float] | None = None,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> SyntheticSweep:
    """Casts every beam of one turn at a scene.

    Args:
      scene: what stands round the sensor.
      seed: of the noise, dropouts, glass and foliage.
      num_beams: beams between +2 and -24.33 degrees, spaced as an HDL-64E's.
      num_azimuths: firings a turn.
      range_noise_m: standard deviation of the range, m; the direction is exact.
      dropout: share of returns lost at random, besides those too weak to detect.
      image: whether the camera's picture is rendered too.
      elevation_deg: of the highest and the lowest beam, evenly spaced, instead of those.
      origin: (3,) m, where another sensor stands in the frame of the scene, in which its points are given.

    Returns:
      The points that came back, and the truth.

    Raises:
      ValueError: for counts below 1, negative noise or a dropout outside [0, 1].
    """
    check_sensor(num_beams, num_azimuths, range_noise_m, dropout)
    rng = np.random.default_rng((seed, 1))
    directions = beam_directions(num_beams, num_azimuths, elevation_deg)
    draw = rng.random(len(directions))
    hits = cast(scene, np.array(origin), directions, draw)
    echoes = echoes_of(scene, hits, directions)
    returned, xyz, intensity = receive(
        rng, directions, echoes, draw, range_noise_m=range_noise_m, dropout=dropout
    )
    object_id = hits.object_id[returned]
    calibration = make_calibration()
    return SyntheticSweep(
        xyz=xyz + np.array(origin, np.float32),
        intensity=intensity,
        object_id=object_id,
        is_ground=object_id == Clutter.GROUND,
        boxes=_truth_boxes(scene, object_id, hits.visible),
        calibration=calibration,
        image=render_image(scene, calibration) if image else None,
        scene=scene,
    )


@dataclasses.dataclass(frozen=True)
class Echoes:
    """What comes back to the sensor of n beams, before noise."""

    distance: np.ndarray
    """(n,) float64, m; infinite where a beam meets nothing."""
    is_glass: np.ndarray
    """(n,) bool: whether it meets glass."""
    reflectance: np.ndarray
    """(n,) float64, in [0, 1]."""
    cosine: np.ndarray
    """(n,) float64, in [0, 1]: of the angle between beam and normal."""


def echoes_of(scene: Scene, hits: Hits, directions: np.ndarray) -> Echoes:
    """What the surfaces that n beams (n, 3) meet send back."""
    return Echoes(
        distance=hits.distance,
        is_glass=hits.material == Material.GLASS,
        reflectance=_reflectance(scene, hits.object_id, hits.material),
        cosine=np.abs((hits.normal * directions).sum(axis=1)),
    )


def receive(
    rng: np.random.Generator,
    directions: np.ndarray,
    echoes: Echoes,
    draw: np.ndarray,
    *,
    range_noise_m: float,
    dropout: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points that a sensor makes of the echoes of its beams.

    Args:
      rng: of the noise and the dropouts.
      directions: (n, 3) unit, sensor frame.
      echoes: of n beams.
      draw: (n,) in [0, 1): fate of each beam on glass.
      range_noise_m: standard deviation of the range, m.
      dropout: share of returns lost at random.

    Returns:
      (n,) bool: which beams return; of those (m, 3) float32, m, sensor frame, and (m,) float32 intensity.
    """
    returned = _returned(rng, echoes.distance, echoes.reflectance * echoes.cosine, dropout)
    returned &= ~echoes.is_glass | (draw < GLASS_REFLECTED)
    noisy = echoes.distance + rng.normal(0, range_noise_m, len(draw))
    brightness = echoes.reflectance * (0.4 + 0.6 * echoes.cosine) + rng.normal(0, 0.03, len(draw))
    xyz = (directions[returned] * noisy[returned, None]).astype(np.float32)
    return returned, xyz, np.clip(brightness[returned], 0, 1).astype(np.float32)


def check_sensor(num_beams: int, num_azimuths: int, range_noise_m: float, dropout: float) -> None:
    """Raises ValueError for counts below 1, negative noise or a dropout outside [0, 1]."""
    if num_beams < 1 or num_azimuths < 1:
        raise ValueError(
            f"num_beams is {num_beams} and num_azimuths {num_azimuths}; both must be at least 1."
        )
    if range_noise_m < 0:
        raise ValueError(f"range_noise_m is {range_noise_m}; it must not be negative.")
    if not 0 <= dropout <= 1:
        raise ValueError(f"dropout is {dropout}; it must lie in [0, 1].")


def beam_directions(
    num_beams: int, num_azimuths: int, elevation_deg: tuple[float, float] | None = None
) -> np.ndarray:
    """(num_beams x num_azimuths, 3) unit vectors: beams from the top, azimuth from +x counter-clockwise."""
    index = np.linspace(0, NUM_BEAMS - 1, num_beams)
    elevation = np.radians(np.interp(index, BEAM_INDEX, BEAM_ELEVATION_DEG))[:, None]
    if elevation_deg is not None:
        elevation = np.radians(np.linspace(*elevation_deg, num_beams))[:, None]
    azimuth = 2 * np.pi / num_azimuths * np.arange(num_azimuths)
    parts = np.broadcast_arrays(
        np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    )
    return np.stack(parts, axis=-1).reshape(-1, 3)


def _reflectance(scene: Scene, object_id: np.ndarray, material: np.ndarray) -> np.ndarray:
    table = np.zeros(len(Material))
    table[list(REFLECTANCE)] = list(REFLECTANCE.values())
    # Dark paint still returns something: lacquer and primer reflect at 905 nm.
    paint = np.array([0.12 + 0.5 * np.mean(v.paint) for v in scene.vehicles] + [0.0])
    index = np.where(object_id >= 0, object_id, len(scene.vehicles))
    return np.where(material == Material.PAINT, paint[index], table[material])


def _returned(
    rng: np.random.Generator, distance: np.ndarray, strength: np.ndarray, dropout: float
) -> np.ndarray:
    """Which beams come back: in range, strong enough, and not dropped."""
    power = strength / distance**2
    kept = (1 - dropout) * (1 - np.exp(-power / DETECTION_POWER))
    return (distance < MAX_RANGE_M) & (rng.random(len(distance)) < kept)


def _truth_boxes(scene: Scene, object_id: np.ndarray, visible: np.ndarray) -> TruthBoxes:
    vehicles = scene.vehicles
    size = np.array([v.size for v in vehicles], float).reshape(-1, 3)
    foot = np.array([vehicle_pose(v, scene.terrain)[1] for v in vehicles], float).reshape(-1, 3)
    heading = np.array([v.heading for v in vehicles], float)
    return TruthBoxes(
        center=foot + size * (0, 0, 0.5),
        size=size,
        yaw=(heading + np.pi / 2) % np.pi - np.pi / 2,
        label=np.array([int(v.label) for v in vehicles], np.int64),
        num_points=np.bincount(object_id[object_id >= 0], minlength=len(vehicles)),
        visible=visible,
    )


def ground_only_sweep(
    seed: int = 0, *, ground: GroundKind = "flat", slope_deg: float = 4.0
) -> SyntheticSweep:
    """A sweep that meets nothing but the ground."""
    return make_sweep(seed, num_vehicles=0, clutter=False, ground=ground, slope_deg=slope_deg)


def no_ground_sweep(seed: int = 0, *, num_vehicles: int = 12) -> SyntheticSweep:
    """A sweep of a street whose ground returns nothing, as wet asphalt may."""
    return make_sweep(seed, num_vehicles=num_vehicles, ground="none")


def one_wall_sweep(seed: int = 0, *, distance_m: float = 10.0) -> SyntheticSweep:
    """A sweep that meets one wall across the road ahead, 40 m wide and 8 m high, and nothing else."""
    wall = make_solid((distance_m, -20, -2), (distance_m + 1, 20, 6), material=Material.WALL)
    terrain = make_terrain(np.random.default_rng(seed), ground="none")
    return scan(Scene(terrain, clutter=(Thing(int(Clutter.WALL), (wall,)),)), seed)
