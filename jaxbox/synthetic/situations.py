"""Situations that are hard for a detector, one deterministic sweep each, with exact truth.

`SITUATIONS` is the table: a name, the group that it belongs to, what stands where, and the sensor. The
detector is told the points alone; `benchmarks.bench_situations` counts what it finds.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable

import numpy as np

from jaxbox.synthetic.scene import Clutter, Scene, Thing, Vehicle
from jaxbox.synthetic.solids import Body, Foliage, Material, make_solid, pickup_body, suv_body
from jaxbox.synthetic.sweep import NUM_AZIMUTHS, NUM_BEAMS, TruthBoxes, scan
from jaxbox.synthetic.terrain import SENSOR_HEIGHT_M, Road, Terrain
from jaxbox.types import Label

Point = tuple[float, float, float]
Size = tuple[float, float, float]
Pose = tuple[float, float, float]
"""x and y of the middle, m, and the heading, degrees."""

CAR_M: Size = (3.9, 1.63, 1.5)
SUV_M: Size = (4.8, 2.0, 1.95)
PICKUP_M: Size = (5.4, 1.95, 1.85)
BOX_VAN_M: Size = (6.5, 2.2, 2.9)
TRUCK_WIDTH_M, TRUCK_HEIGHT_M = 2.55, 3.5
LOOKS_UP_DEG = (15.0, -25.0)
"""Highest and lowest beam of a sensor that sees ceilings."""
FEET_IN_A_METRE = 3.2808
GREY = (0.5, 0.52, 0.54)


@dataclasses.dataclass(frozen=True)
class Situation:
    """One sweep over a scene, and what became of its points on the way to the detector."""

    group: str
    """What is asked."""
    name: str
    """How much of it."""
    scenes: tuple[Scene, ...]
    """One sweep of each: their vehicles count together."""
    elevation_deg: tuple[float, float] | None = None
    """Of the highest and the lowest beam; None for an HDL-64E's."""
    origins: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),)
    """Where the sensors stand whose points are in one cloud, m."""
    scale: float = 1.0
    """Units of the points in a metre."""
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the sensor is in the frame of the points, m."""

    @property
    def title(self) -> str:
        """Group and name: what no two situations share."""
        return f"{self.group}: {self.name}"

    def seen_from(self, x: float, y: float) -> "Situation":
        """The same scenes from elsewhere: every sensor is moved, and the frame of the points with it.

        Args:
          x: m, how far ahead.
          y: m, how far to the left.

        Returns:
          The situation, under the same name.
        """
        ahead, left, up = self.shift_m
        origins = tuple((a + x, b + y, c) for a, b, c in self.origins)
        return dataclasses.replace(self, origins=origins, shift_m=(ahead - x, left - y, up))

    def sweeps(self, *, num_azimuths: int = NUM_AZIMUTHS) -> list[tuple[np.ndarray, TruthBoxes]]:
        """Casts the beams.

        Args:
          num_azimuths: firings a turn; several sensors share them.

        Returns:
          Of each scene the points (n, 3) float32, and the vehicles, both in the units and the frame that the
          detector is given.
        """
        return [self._sweep(scene, seed, num_azimuths) for seed, scene in enumerate(self.scenes)]

    def _sweep(self, scene: Scene, seed: int, num_azimuths: int) -> tuple[np.ndarray, TruthBoxes]:
        seen = [
            scan(
                scene,
                seed + 100 * i,
                num_beams=NUM_BEAMS,
                num_azimuths=num_azimuths // len(self.origins),
                elevation_deg=self.elevation_deg,
                origin=origin,
            )
            for i, origin in enumerate(self.origins)
        ]
        boxes, shift = seen[0].boxes, np.array(self.shift_m)
        xyz = np.concatenate([sweep.xyz for sweep in seen])
        truth = dataclasses.replace(
            boxes,
            center=self.scale * (boxes.center + shift),
            size=self.scale * boxes.size,
            num_points=sum(sweep.boxes.num_points for sweep in seen),
        )
        return (self.scale * (xyz + shift)).astype(np.float32), truth


def cars(poses: Iterable[Pose], size: Size = CAR_M, body: Body | None = None) -> tuple[Vehicle, ...]:
    """Vehicles of one size, cars unless they have another body."""
    return tuple(Vehicle(Label.CAR, (x, y), math.radians(yaw), size, GREY, body) for x, y, yaw in poses)


def block(low: Point, high: Point, *, ground_z: float = -SENSOR_HEIGHT_M) -> Thing:
    """A wall or ceiling between two corners, m, heights above the ground."""
    low, high = ((x, y, z + ground_z) for x, y, z in (low, high))
    solid = make_solid(low, high, material=Material.WALL)
    return Thing(int(Clutter.WALL), (solid,))


def wall(y: float, side: int) -> Thing:
    """A wall of 2.5 m along the road whose face is at y, m; it stands to that side of it."""
    near, far = sorted((y, y + 0.3 * side))
    return block((-10, near, 0), (40, far, 2.5))


def hedge(y: float, side: int) -> Thing:
    """A hedge of about 1.5 m along the road whose face is at y, m."""
    radii = np.array([0.45, 0.45, 0.75])
    centers = [np.array([x, y + side * radii[1], 0.75 - SENSOR_HEIGHT_M]) for x in np.arange(0, 32, 0.5)]
    return Thing(int(Clutter.BUSH), tuple(Foliage(center, radii) for center in centers))


def rail(y: float, side: int) -> Thing:
    """A guard rail along the road whose face is at y, m: a band .45 to .75 m high, and posts behind it."""
    near, far = sorted((y, y + 0.08 * side))
    posts = [block((x, near, 0), (x + 0.1, far, 0.7)) for x in range(0, 40, 2)]
    band = block((-10, near, 0.45), (40, far, 0.75))
    return Thing(int(Clutter.WALL), (*band.shapes, *(shape for post in posts for shape in post.shapes)))


def beside(thing: Callable[[float, int], Thing], gap_m: float) -> Scene:
    """Three cars along a thing on the left, and three with their ends to one on the right, 8 to 25 m away."""
    left, right = 5.5, -7.5
    along = [(x, left - gap_m - CAR_M[1] / 2, 0.0) for x in (7.0, 14.5, 23.0)]
    across = [(x, right + gap_m + CAR_M[0] / 2, 90.0) for x in (6.5, 14.0, 22.5)]
    return Scene(Terrain(), cars([*along, *across]), (thing(left, 1), thing(right, -1)))


def side_by_side(gap_m: float) -> Scene:
    """Five cars that face the road, 8 to 18 m away."""
    pitch = CAR_M[1] + gap_m
    return Scene(Terrain(), cars((7.5 + i * pitch, 6.5, 90.0) for i in range(5)))


def nose_to_tail(gap_m: float) -> Scene:
    """Five cars along the kerb, 6 to 24 m away."""
    pitch = CAR_M[0] + gap_m
    return Scene(Terrain(), cars((5.5 + i * pitch, 3.8, 0.0) for i in range(5)))


def under(height_m: float) -> Scene:
    """Six cars under a ceiling, between two walls, as in a garage or an underpass."""
    ceiling = block((-20, -10, height_m), (35, 10, height_m + 0.4))
    walls = block((-20, 9.5, 0), (35, 10, height_m)), block((-20, -10, 0), (35, -9.5, height_m))
    poses = [(x, side * 6.0, 90.0) for x in (5.0, 10.0, 17.0) for side in (-1, 1)]
    return Scene(Terrain(), cars(poses), (ceiling, *walls))


def near(distance_m: float) -> tuple[Scene, ...]:
    """Five times three cars whose middles are that far away, 0 to 168 degrees to the line of sight."""
    scenes = []
    for first in range(0, 15, 3):
        bearings = [(120 * i + 8 * first, 12 * (first + i)) for i in range(3)]
        poses = [
            (distance_m * math.cos(math.radians(at)), distance_m * math.sin(math.radians(at)), at + turn)
            for at, turn in bearings
        ]
        scenes.append(Scene(Terrain(), cars(poses)))
    return tuple(scenes)


STREET: tuple[Pose, ...] = (
    *((x, 4.5, 0.0) for x in (-9.0, 6.0, 12.5, 19.0)),
    *((x, -4.5, 0.0) for x in (-8.0, 7.0, 14.0, 21.0)),
    (11.0, 0.3, 0.0),
    (26.0, 0.0, 0.0),
)
"""Ten cars, parked and driving, 7 to 26 m away."""


def street(terrain: Terrain | None = None) -> Scene:
    """Ten cars and nothing else."""
    return Scene(terrain or Terrain(), cars(STREET))


def four_poses(size: Size, body: Body | None = None, label: Label = Label.CAR) -> Scene:
    """Four vehicles of a size, 9 to 18 m away: along, across and aslant."""
    poses = ((10.0, 5.0, 0.0), (0.0, -11.0, 90.0), (-12.0, 4.0, 30.0), (14.0, -10.0, 120.0))
    vehicles = cars(poses, size, body)
    return Scene(Terrain(), tuple(dataclasses.replace(vehicle, label=label) for vehicle in vehicles))


def trucks(length_m: float) -> Scene:
    """Four trucks of a length, 13 to 27 m away."""
    size = (length_m, TRUCK_WIDTH_M, TRUCK_HEIGHT_M)
    poses = (12.0, 5.0, 0.0), (-10.0, -16.0, 90.0), (-20.0, 7.0, 0.0), (26.0, -8.0, 30.0)
    vehicles = cars(poses, size)
    return Scene(Terrain(), tuple(dataclasses.replace(vehicle, label=Label.TRUCK) for vehicle in vehicles))


def platform(height_m: float) -> Scene:
    """Six cars on platforms on both sides of the sensor's lane."""
    road = Road(center_offset_m=0.0, half_width_m=3.5)
    poses = [(x, side * 5.5, 0.0) for x in (6.0, 12.5, 19.0) for side in (-1, 1)]
    return Scene(Terrain(road=road, kerb_height_m=height_m), cars(poses))


def ramp_ahead(grade: float) -> Scene:
    """The sensor on the flat before a ramp that begins 6 m ahead, with six cars on it."""
    poses = [(x, side * 3.5, 0.0) for x in (10.0, 16.0, 22.0) for side in (-1, 1)]
    return Scene(Terrain(crest=(6.0, 0.5, -grade)), cars(poses))


def _beside_things() -> Iterable[Situation]:
    for thing in (wall, hedge, rail):
        for gap_m in (0.1, 0.2, 0.3):
            yield Situation(f"beside a {thing.__name__}", f"{gap_m:g} m", (beside(thing, gap_m),))
    for row, words in ((side_by_side, "side by side"), (nose_to_tail, "nose to tail")):
        for gap_m in (0.2, 0.3, 0.5):
            yield Situation(f"rows, {words}", f"gaps of {gap_m:g} m", (row(gap_m),))


def _other_sizes() -> Iterable[Situation]:
    named = functools.partial(Situation, "other sizes")
    yield named("SUVs", (four_poses(SUV_M, suv_body),))
    yield named("pickups", (four_poses(PICKUP_M, pickup_body),))
    yield named("box vans", (four_poses(BOX_VAN_M, label=Label.TRUCK),))
    for length_m in (7.0, 9.0, 12.0, 16.0):
        yield named(f"trucks of {length_m:g} m", (trucks(length_m),))


def _mounts() -> Iterable[Situation]:
    named = functools.partial(Situation, "mounts")
    for height_m in (0.3, 0.6, 0.9, 1.2):
        yield named(f"sensor {height_m:g} m high", (street(Terrain(sensor_height_m=height_m)),), LOOKS_UP_DEG)
    for grade in (0.1, 0.15, 0.2):
        yield named(f"on a slope of {100 * grade:g} %", (street(Terrain(gradient=(grade, 0.0))),))
    for grade in (0.1, 0.2):
        yield named(f"before a ramp of {100 * grade:g} %", (ramp_ahead(grade),))
    for height_m in (0.6, 1.0):
        yield named(f"cars on a platform of {height_m:g} m", (platform(height_m),))
    two = (0.0, 0.8, 0.0), (3.5, -0.8, -1.0)
    yield named("two sensors in one cloud", (street(),), origins=two)


SITUATIONS: tuple[Situation, ...] = (
    Situation("open street", "as it is", (street(),)),
    *_beside_things(),
    *(Situation("under a ceiling", f"{h:g} m", (under(h),), LOOKS_UP_DEG) for h in (2.1, 2.3, 2.5, 3.0, 4.2)),
    *(Situation("very near", f"middle {d:g} m away", near(d)) for d in (3.0, 3.5, 4.0)),
    *_other_sizes(),
    *_mounts(),
    Situation("wrong input", "in feet", (street(),), scale=FEET_IN_A_METRE),
    Situation("wrong input", "origin 10 m aside", (street(),), shift_m=(0.0, 10.0, 0.0)),
)
"""The table."""
