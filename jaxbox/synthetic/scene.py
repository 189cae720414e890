"""The layout of a street: vehicles on and next to a road, buildings, hedges, trees and poles."""

import dataclasses
import enum
import math
from collections.abc import Callable, Sequence

import numpy as np

from jaxbox.synthetic.solids import Body, Foliage, Material, Shape, make_post, make_solid, vehicle_solids
from jaxbox.synthetic.terrain import GroundKind, Road, Terrain, make_terrain
from jaxbox.types import Label

MIN_RANGE_M, MAX_RANGE_M = 5.0, 55.0
"""Vehicles stand at these ranges: nearer they hide the scene, beyond they hold few points."""
SPACING_M = 0.6
"""Least gap between two things that stand on the ground."""
MAX_TRIES = 1500
"""Placements tried before the street counts as full."""
SIZE_QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
CAR_SIZE_M = (
    (2.94, 3.20, 3.59, 3.88, 4.19, 4.52, 4.89),
    (1.36, 1.47, 1.57, 1.63, 1.68, 1.80, 1.88),
    (1.27, 1.36, 1.43, 1.50, 1.59, 1.78, 1.97),
)
"""Length, width and height of the KITTI object benchmark's cars (Geiger et al. 2012) at these quantiles."""
MEDIAN_SIZE_M = {Label.VAN: (4.98, 1.88, 2.13), Label.TRUCK: (10.81, 2.63, 3.34)}
"""Medians of the same benchmark; another class has the size of its prior."""
SIZE_SPREAD = {Label.VAN: (0.9, 1.15), Label.TRUCK: (0.7, 1.1)}
"""Factors on the median; their ends keep vans apart from cars and trucks."""
OTHER_SPREAD = (0.9, 1.1)
"""Of a class that says no other."""
LABEL_SHARES = {Label.CAR: 0.82, Label.VAN: 0.12, Label.TRUCK: 0.06}
"""About the benchmark's own, with a few more vans and trucks; a class without a share stands in no street."""
PLACES = {"right": 0.3, "left": 0.24, "oncoming": 0.17, "ahead": 0.14, "perpendicular": 0.15}
"""Where vehicles stand: parked in a row, driving, or parked across the road's direction."""
HEADING_SD_DEG = {"right": 1.5, "left": 1.5, "oncoming": 1.0, "ahead": 1.0, "perpendicular": 6.0}
HIDDEN_SHARE = 0.3
"""Share of the vehicles that may stand behind another, or hide one, as parked rows do."""
PAINTS = (
    (0.75, 0.75, 0.76),
    (0.1, 0.1, 0.11),
    (0.5, 0.52, 0.54),
    (0.5, 0.03, 0.03),
    (0.1, 0.17, 0.4),
    (0.3, 0.3, 0.3),
)
"""Linear RGB in [0, 1]: mostly white, black and grey, as streets are."""


class Clutter(enum.IntEnum):
    """What `object_id` says of a point that is not on a vehicle."""

    GROUND = -1
    WALL = -2
    POLE = -3
    BUSH = -4


@dataclasses.dataclass(frozen=True)
class Vehicle:
    """A vehicle that stands on the ground and leans with it."""

    label: Label
    """Its class."""
    xy: tuple[float, float]
    """m, sensor frame: middle of its outline."""
    heading: float
    """rad: the direction of its front from +x about +z."""
    size: tuple[float, float, float]
    """m: length, width, height."""
    paint: tuple[float, float, float]
    """Linear RGB in [0, 1]."""
    body: Body | None = None
    """Its pieces; those of its class by default."""


@dataclasses.dataclass(frozen=True)
class Thing:
    """Shapes that share an id, in the sensor frame."""

    object_id: int
    """Index of the vehicle, or a `Clutter` code."""
    shapes: tuple[Shape, ...]
    """Its pieces."""
    paint: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """Linear RGB in [0, 1], of painted surfaces and walls."""

    @property
    def sphere(self) -> tuple[np.ndarray, float]:
        """Center (3,) and radius, m, of a sphere round all pieces."""
        centers = np.array([shape.center for shape in self.shapes])
        center = centers.mean(axis=0)
        reach = np.linalg.norm(centers - center, axis=1) + [shape.radius for shape in self.shapes]
        return center, float(reach.max())


@dataclasses.dataclass(frozen=True)
class Scene:
    """Everything that beams can meet."""

    terrain: Terrain
    """The ground."""
    vehicles: tuple[Vehicle, ...] = ()
    """Vehicles; the index is their object id."""
    clutter: tuple[Thing, ...] = ()
    """Walls, poles and bushes."""

    def things(self) -> tuple[Thing, ...]:
        """All that stands on the ground, vehicles first."""
        placed = (place_vehicle(v, self.terrain, i) for i, v in enumerate(self.vehicles))
        return (*placed, *self.clutter)


def vehicle_pose(vehicle: Vehicle, terrain: Terrain) -> tuple[np.ndarray, np.ndarray]:
    """Linear part (3, 3) and offset (3,) that take a vehicle's own frame to the sensor frame.

    On a slope a vehicle is sheared, not tilted: every part keeps its height above the ground, and the
    outline in the bird's-eye view stays exactly length by width, as an upright box describes it.
    """
    x, y = vehicle.xy
    ahead = np.array([np.cos(vehicle.heading), np.sin(vehicle.heading)])
    left = np.array([-ahead[1], ahead[0]])
    reach = np.array(
        [ahead * vehicle.size[0], -ahead * vehicle.size[0], left * vehicle.size[1], -left * vehicle.size[1]]
    )
    # The wheels stand at about a third of the length and the width from the middle.
    z = terrain.height(x + reach[:, 0] / 3, y + reach[:, 1] / 3)
    rise_ahead = (z[0] - z[1]) / (2 / 3 * vehicle.size[0])
    rise_left = (z[2] - z[3]) / (2 / 3 * vehicle.size[1])
    linear = np.eye(3)
    linear[:2, 0], linear[:2, 1] = ahead, left
    linear[2, :2] = rise_ahead, rise_left
    return linear, np.array([x, y, z.mean()])


def place_vehicle(vehicle: Vehicle, terrain: Terrain, object_id: int) -> Thing:
    """The vehicle's solids in the sensor frame."""
    linear, offset = vehicle_pose(vehicle, terrain)
    body = vehicle.body
    solids = vehicle_solids(vehicle.label, vehicle.size) if body is None else body(*vehicle.size)
    return Thing(object_id, tuple(s.placed(linear, offset) for s in solids), vehicle.paint)


def make_scene(
    seed: int = 0,
    *,
    num_vehicles: int = 12,
    clutter: bool = True,
    ground: GroundKind = "flat",
    slope_deg: float = 4.0,
    slope_azimuth_deg: float = 0.0,
    kerb: bool = False,
) -> Scene:
    """Draws a street: the same seed and options give the same scene.

    Args:
      seed: non-negative.
      num_vehicles: how many; they never overlap, and stand at `MIN_RANGE_M` to `MAX_RANGE_M`.
      clutter: whether there are walls, poles, trees and bushes.
      ground: see `make_terrain`, as the next three.
      slope_deg: steepness of sloped ground, degrees.
      slope_azimuth_deg: the direction in which it rises.
      kerb: whether there is a raised sidewalk.

    Returns:
      A scene round the sensor, which stands on the right lane of the road.

    Raises:
      ValueError: where that many vehicles find no room, or for an option out of range.

    >>> " ".join(v.label.name for v in make_scene(3, num_vehicles=2).vehicles)
    'CAR CAR'
    """
    rng = np.random.default_rng((seed, 0))
    road = Road(heading=float(np.radians(rng.normal(0, 3))), center_offset_m=float(rng.uniform(1.5, 2)))
    terrain = make_terrain(
        rng, ground=ground, slope_deg=slope_deg, slope_azimuth_deg=slope_azimuth_deg, kerb=kerb, road=road
    )
    vehicles = _draw_vehicles(rng, road, num_vehicles)
    things = draw_clutter(rng, terrain, [outline(vehicle) for vehicle in vehicles]) if clutter else []
    return Scene(terrain, vehicles, tuple(thing for thing, _ in things))


def _draw_vehicles(rng: np.random.Generator, road: Road, count: int) -> tuple[Vehicle, ...]:
    if count < 0:
        raise ValueError(f"num_vehicles is {count}; it must not be negative.")
    vehicles: list[Vehicle] = []
    for _ in range(MAX_TRIES):
        if len(vehicles) == count:
            break
        vehicle = _draw_vehicle(rng, road)
        if _has_room(vehicle, vehicles, may_hide=rng.random() < HIDDEN_SHARE):
            vehicles.append(vehicle)
    if len(vehicles) < count:
        raise ValueError(f"num_vehicles is {count}, but only {len(vehicles)} found room on this street.")
    return tuple(vehicles)


def _has_room(vehicle: Vehicle, others: list[Vehicle], *, may_hide: bool) -> bool:
    """Whether a vehicle is in reach, apart from all others, and, unless it may, hides none of them."""
    if not MIN_RANGE_M <= np.hypot(*vehicle.xy) <= MAX_RANGE_M:
        return False
    reach = math.hypot(*vehicle.size[:2]) / 2 + SPACING_M
    close = [o for o in others if math.dist(o.xy, vehicle.xy) < reach + math.hypot(*o.size[:2]) / 2]
    if not all(are_apart(outline(vehicle), outline(other)) for other in close):
        return False
    return may_hide or not any(_hides(vehicle, other) or _hides(other, vehicle) for other in others)


def _draw_vehicle(rng: np.random.Generator, road: Road) -> Vehicle:
    place = str(rng.choice(list(PLACES), p=list(PLACES.values())))
    label = Label(int(rng.choice(list(LABEL_SHARES), p=list(LABEL_SHARES.values()))))
    if label is Label.TRUCK and place not in ("oncoming", "ahead"):
        label = Label.VAN
    size = draw_size(rng, label)
    # More ahead than behind: that is where the camera looks.
    along = rng.uniform(-22, 52)
    parked = road.half_width_m - size[1] / 2 - rng.uniform(0.15, 0.4)
    setback = road.half_width_m + size[0] / 2 + rng.uniform(0.8, 2.0)
    across = {
        "right": -parked,
        "left": parked,
        "oncoming": rng.normal(1.75, 0.15),
        "ahead": rng.normal(-1.75, 0.15),
        "perpendicular": rng.choice((-1, 1)) * setback,
    }[place]
    direction = {"left": np.pi, "oncoming": np.pi, "perpendicular": rng.choice((-1, 1)) * np.pi / 2}.get(
        place, 0.0
    )
    wobble = np.radians(rng.normal(0, HEADING_SD_DEG[place]))
    x, y = road.to_xy(np.array(along), np.array(across))
    heading = float(road.heading + direction + wobble)
    return Vehicle(label, (float(x), float(y)), heading, size, draw_paint(rng))


def draw_paint(rng: np.random.Generator) -> tuple[float, float, float]:
    """Linear RGB in [0, 1]: one of `PAINTS`, lighter or darker."""
    shade = rng.uniform(0.8, 1.2)
    red, green, blue = (min(channel * shade, 1.0) for channel in PAINTS[rng.integers(len(PAINTS))])
    return red, green, blue


def draw_size(rng: np.random.Generator, label: Label) -> tuple[float, float, float]:
    """Length, width and height, m, of a vehicle of a class.

    Cars follow the benchmark's own quantiles, between its 1st and 99th percentile, each dimension by
    itself; all others are their median, scaled.
    """
    if label is Label.CAR:
        length, width, height = (float(np.interp(rng.random(), SIZE_QUANTILES, q)) for q in CAR_SIZE_M)
        return length, width, height
    prior = label.prior
    median = MEDIAN_SIZE_M.get(label, (prior.length_m, prior.width_m, prior.height_m))
    scale = rng.uniform(*SIZE_SPREAD.get(label, OTHER_SPREAD))
    # Vehicles vary more in length than in width and height.
    return float(median[0] * scale), float(median[1] * scale**0.3), float(median[2] * scale**0.5)


def outline(vehicle: Vehicle) -> np.ndarray:
    """(4, 2) corners in the bird's-eye view, m, counter-clockwise."""
    return rectangle(vehicle.xy, vehicle.size[0], vehicle.size[1], vehicle.heading)


def rectangle(
    xy: tuple[float, float] | np.ndarray, length: float, width: float, yaw: float | np.ndarray
) -> np.ndarray:
    """(..., 4, 2) corners, m, counter-clockwise from front left; xy is (..., 2), m, and yaw (...), rad."""
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.moveaxis(np.array([[c, s], [-s, c]]), (0, 1), (-2, -1))
    return np.asarray(xy)[..., None, :] + (signs * (length, width)) @ turn


def are_apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(...) bool: whether a line along an edge of one of two rectangles (..., 4, 2) keeps them apart."""
    apart = np.zeros((), bool)
    for corners in (first, second):
        edges = corners[..., 1:3, :] - corners[..., :2, :]
        axes = edges / np.linalg.norm(edges, axis=-1, keepdims=True)
        p, q = first @ axes.swapaxes(-1, -2), second @ axes.swapaxes(-1, -2)
        gap = np.maximum(p.min(-2) - q.max(-2), q.min(-2) - p.max(-2))
        apart = apart | (gap > SPACING_M).any(-1)
    return apart


def _hides(near: Vehicle, far: Vehicle) -> bool:
    """Whether `near` stands in the line of sight to the middle of `far`."""
    if np.hypot(*near.xy) > np.hypot(*far.xy):
        return False
    corners = outline(near) @ np.array([[far.xy[0], -far.xy[1]], [far.xy[1], far.xy[0]]])
    bearing = np.arctan2(corners[:, 1], corners[:, 0])
    return bool(bearing.min() < 0 < bearing.max() and np.ptp(bearing) < np.pi)


def draw_clutter(
    rng: np.random.Generator,
    terrain: Terrain,
    taken: Sequence[np.ndarray],
    *,
    rows: "Sequence[ClutterRow] | None" = None,
    reach_m: tuple[float, float] = (-50.0, 85.0),
) -> list[tuple[Thing, np.ndarray]]:
    """Rows of clutter on both sides of the road, except where something stands.

    Args:
      rng: draws them.
      terrain: its road is what they line.
      taken: outlines (4, 2), m, that they keep away from.
      rows: what stands how far from the kerb; None for a street's.
      reach_m: along the road, from where to where.

    Returns:
      The things, each with its footprint (4, 2), m.
    """
    outlines = np.reshape(taken, (-1, 4, 2))
    things: list[tuple[Thing, np.ndarray]] = []
    for side in (-1, 1):
        for draw, beyond, step in STREET_ROWS if rows is None else rows:
            along = reach_m[0] + rng.uniform(0, 10)
            while along < reach_m[1]:
                length = float(rng.uniform(*step))
                middle = along + length / 2
                across = side * (terrain.road.half_width_m + beyond + rng.uniform(0, 1))
                thing, footprint = draw(rng, terrain, middle, across, length)
                if are_apart(footprint, outlines).all():
                    things.append((thing, footprint))
                along += length
    return things


def make_wall(rng: np.random.Generator, terrain: Terrain, footprint: np.ndarray, height_m: float) -> Thing:
    """An upright block; it goes down far enough to meet any ground."""
    x, y = footprint.mean(0)
    edge, side = footprint[0] - footprint[1], footprint[1] - footprint[2]
    length, width = float(np.linalg.norm(edge)), float(np.linalg.norm(side))
    linear = np.eye(3)
    linear[:2, 0], linear[:2, 1] = edge / length, side / width
    depth = max(2.0, 0.3 * length)
    block = make_solid(
        (-length / 2, -width / 2, -depth), (length / 2, width / 2, height_m), material=Material.WALL
    )
    solid = block.placed(linear, np.array([x, y, float(terrain.height(x, y))]))
    tone = rng.uniform(0.4, 0.7)
    return Thing(
        int(Clutter.WALL), (solid,), (tone, tone * rng.uniform(0.8, 1), tone * rng.uniform(0.6, 0.95))
    )


def draw_building(
    rng: np.random.Generator, terrain: Terrain, along: float, across: float, length: float
) -> tuple[Thing, np.ndarray]:
    """A block of flats or houses."""
    depth = rng.uniform(6, 9)
    across = across + np.sign(across) * (depth / 2 + rng.choice((0.0, 0.0, 3.0)))
    xy = terrain.road.to_xy(np.array(along), np.array(across))
    footprint = rectangle(xy, length - rng.choice((0.0, 2.0, 5.0)), depth, terrain.road.heading)
    return make_wall(rng, terrain, footprint, rng.uniform(4, 10)), footprint


def draw_garden(
    rng: np.random.Generator, terrain: Terrain, along: float, across: float, length: float
) -> tuple[Thing, np.ndarray]:
    """A low wall, a hedge or a group of bushes."""
    xy = terrain.road.to_xy(np.array(along), np.array(across))
    if rng.random() < 0.35:
        footprint = rectangle(xy, length - 0.5, 0.3, terrain.road.heading)
        return make_wall(rng, terrain, footprint, rng.uniform(0.7, 1.8)), footprint
    footprint = rectangle(xy, length - 0.5, 1.8, terrain.road.heading)
    share = rng.choice((0.4, 1.0))
    blobs = tuple(
        _blob(rng, terrain, along + share * rng.uniform(-0.4, 0.4) * length, across + rng.normal(0, 0.3))
        for _ in range(int(3 + length * share))
    )
    return Thing(int(Clutter.BUSH), blobs), footprint


def _blob(rng: np.random.Generator, terrain: Terrain, along: float, across: float) -> Foliage:
    x, y = terrain.road.to_xy(np.array(along), np.array(across))
    radii = rng.uniform((0.4, 0.4, 0.5), (0.8, 0.8, 1.1))
    return Foliage(np.array([x, y, terrain.height(x, y) + rng.uniform(0.2, 0.7)]), radii)


def draw_kerbside(
    rng: np.random.Generator, terrain: Terrain, along: float, across: float, length: float
) -> tuple[Thing, np.ndarray]:
    """A pole, or a tree: a trunk with a crown."""
    x, y = terrain.road.to_xy(np.array(along), np.array(across))
    foot = np.array([x, y, terrain.height(x, y) - 0.3])
    footprint = rectangle((float(x), float(y)), 0.5, 0.5, 0.0)
    if rng.random() < 0.5:
        return Thing(
            int(Clutter.POLE), (make_post(foot, rng.uniform(0.06, 0.12), rng.uniform(3, 7)),)
        ), footprint
    trunk = make_post(foot, rng.uniform(0.12, 0.22), 4.2)
    crown = tuple(
        Foliage(foot + rng.normal((0, 0, 4.6), (0.6, 0.6, 0.4)), rng.uniform(0.8, 1.5, 3)) for _ in range(7)
    )
    return Thing(int(Clutter.BUSH), (trunk, *crown)), footprint


ClutterRow = tuple[
    Callable[[np.random.Generator, Terrain, float, float, float], tuple[Thing, np.ndarray]],
    float,
    tuple[float, float],
]
"""What draws a thing and its footprint, how far from the kerb, m, and the least and greatest length, m."""

STREET_ROWS: tuple[ClutterRow, ...] = (
    (draw_building, 7.3, (10.0, 20.0)),
    (draw_garden, 2.8, (4.0, 11.0)),
    (draw_kerbside, 0.7, (9.0, 22.0)),
)
"""Houses, gardens before them, and what stands at the kerb."""
