"""Shapes that rays can meet: convex solids, porous foliage, and the vehicles built from them."""

import dataclasses
import enum
from collections.abc import Callable, Sequence

import numpy as np

from jaxbox.types import Label

GLASS_REFLECTED = 0.2
"""Share of the beams that return from glass: frames, pillars and steep panes."""
GLASS_TRANSMITTED = 0.45
"""Share that goes on through the pane; the rest is reflected away and never returns."""
FOLIAGE_FREE_PATH_M = 0.3
"""Mean depth to which a beam enters foliage before it meets a leaf."""


class Material(enum.IntEnum):
    """What a surface is made of; decides reflectance and colour."""

    ROAD = 0
    SIDEWALK = 1
    GRASS = 2
    PAINT = 3
    GLASS = 4
    TYRE = 5
    WALL = 6
    POLE = 7
    FOLIAGE = 8


@dataclasses.dataclass(frozen=True)
class Solid:
    """A convex polyhedron: the points p with n . p <= d for every face."""

    normals: np.ndarray
    """(F, 3) float64, unit: outward."""
    offsets: np.ndarray
    """(F,) float64, m: d."""
    materials: np.ndarray
    """(F,) int64: a `Material` each."""
    center: np.ndarray
    """(3,) float64, m: of a sphere round the solid."""
    radius: float
    """m: of that sphere."""

    def first_hit(
        self, origins: np.ndarray, directions: np.ndarray, draw: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where rays enter the solid (slab method of Kay and Kajiya 1986, for any convex polyhedron).

        Args:
          origins: (n, 3) or (1, 3), m.
          directions: (n, 3), unit.
          draw: (n,) in [0, 1): the fate of each ray on glass. Above 1 - `GLASS_TRANSMITTED` it goes through.

        Returns:
          Distance (n,), m, infinite for a miss; material (n,); outward unit normal (n, 3).
        """
        speed = directions @ self.normals.T
        gap = self.offsets - origins @ self.normals.T
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = gap / speed
        entering = np.where(speed < 0, crossing, -np.inf)
        leave = np.where(speed > 0, crossing, np.inf).min(axis=1)
        face = entering.argmax(axis=1)
        enter = np.take_along_axis(entering, face[:, None], axis=1)[:, 0]
        parallel_outside = ((speed == 0) & (gap < 0)).any(axis=1)
        material = self.materials[face]
        through = (material == Material.GLASS) & (draw > 1 - GLASS_TRANSMITTED)
        hit = (enter > 0) & (enter < leave) & ~parallel_outside & ~through
        return np.where(hit, enter, np.inf), material, self.normals[face]

    def placed(self, linear: np.ndarray, offset: np.ndarray) -> "Solid":
        """The solid after p -> linear p + offset (linear (3, 3), of determinant near 1)."""
        normals = self.normals @ np.linalg.inv(linear)
        lengths = np.linalg.norm(normals, axis=1)
        offsets = (self.offsets + normals @ offset) / lengths
        stretch = float(np.linalg.norm(linear, ord=2))
        return Solid(
            normals=normals / lengths[:, None],
            offsets=offsets,
            materials=self.materials,
            center=linear @ self.center + offset,
            radius=self.radius * stretch,
        )


@dataclasses.dataclass(frozen=True)
class Foliage:
    """A porous ellipsoid: beams end at a random depth in it, or leave it again."""

    center: np.ndarray
    """(3,) float64, m."""
    radii: np.ndarray
    """(3,) float64, m."""

    @property
    def radius(self) -> float:
        """Radius of a sphere round it, m."""
        return float(self.radii.max())

    def first_hit(
        self, origins: np.ndarray, directions: np.ndarray, draw: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `Solid.first_hit`; ``draw`` decides the depth, 0 being the surface."""
        offset = (origins - self.center) / self.radii
        ray = directions / self.radii
        a = (ray * ray).sum(axis=1)
        b = (ray * offset).sum(axis=1)
        discriminant = b * b - a * ((offset * offset).sum(axis=1) - 1)
        root = np.sqrt(np.maximum(discriminant, 0))
        depth = -FOLIAGE_FREE_PATH_M * np.log1p(-draw)
        distance = (-b - root) / a + depth
        hit = (discriminant > 0) & (distance > 0) & (distance < (-b + root) / a)
        surface = offset + distance[:, None] * ray
        normal = surface / self.radii
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-9
        return np.where(hit, distance, np.inf), np.full(len(draw), Material.FOLIAGE), normal


Shape = Solid | Foliage
Cut = tuple[tuple[float, float, float], tuple[float, float, float]]
"""A face: its outward normal, of any length, and a point on it."""


def make_solid(
    low: Sequence[float],
    high: Sequence[float],
    *,
    material: Material,
    cuts: Sequence[Cut] = (),
    cut_material: Material | None = None,
) -> Solid:
    """A block with pieces cut off.

    Args:
      low: (3,), m: lower corner of the block.
      high: (3,), m: upper corner.
      material: of the block's own six faces.
      cuts: half-spaces that are kept, one a cut.
      cut_material: of the cut faces; as the block by default.

    Returns:
      A solid with 6 + len(cuts) faces.
    """
    least, most = np.asarray(low, float), np.asarray(high, float)
    normals = np.concatenate([np.eye(3), -np.eye(3), np.reshape([n for n, _ in cuts], (-1, 3))])
    points = np.concatenate(
        [np.tile(most, (3, 1)), np.tile(least, (3, 1)), np.reshape([p for _, p in cuts], (-1, 3))]
    )
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    materials = np.full(len(normals), material, np.int64)
    materials[6:] = material if cut_material is None else cut_material
    return Solid(
        normals=normals,
        offsets=(normals * points).sum(axis=1),
        materials=materials,
        center=(least + most) / 2,
        radius=float(np.linalg.norm(most - least) / 2),
    )


def make_post(center: np.ndarray, radius_m: float, height_m: float) -> Solid:
    """An upright octagonal post whose foot is at ``center`` (3,), m."""
    x, y, z = (float(c) for c in center)
    sides = [(float(np.cos(a)), float(np.sin(a))) for a in np.pi / 4 * np.arange(1, 8, 2)]
    return make_solid(
        (x - radius_m, y - radius_m, z),
        (x + radius_m, y + radius_m, z + height_m),
        material=Material.POLE,
        cuts=[((c, s, 0.0), (x + radius_m * c, y + radius_m * s, z)) for c, s in sides],
    )


def make_wheel(x: float, y: float, radius_m: float) -> Solid:
    """A twelve-sided wheel that stands on z = 0 with its axle along y, its middle at (x, y)."""
    angles = np.pi / 6 * np.array([1, 2, 4, 5, 7, 8, 10, 11])
    rim = [(float(radius_m * np.cos(a)), float(radius_m * np.sin(a))) for a in angles]
    return make_solid(
        (x - radius_m, y - WHEEL_WIDTH_M / 2, 0),
        (x + radius_m, y + WHEEL_WIDTH_M / 2, 2 * radius_m),
        material=Material.TYRE,
        cuts=[((c, 0.0, s), (x + c, y, radius_m + s)) for c, s in rim],
    )


WHEEL_WIDTH_M = 0.22
TYRE_BULGE_M = 0.015
"""Tyres stand out of the sides of the body by this much."""


def _wheels(axles: Sequence[float], half_width: float, radius_m: float) -> list[Solid]:
    y = half_width - WHEEL_WIDTH_M / 2
    return [make_wheel(x, side * y, radius_m) for x in axles for side in (-1, 1)]


def _rounded_corners(length: float, width: float, chamfer_m: float) -> list[Cut]:
    """The four upright edges cut off at 45 degrees."""
    x, y = length / 2 - chamfer_m, width / 2
    return [((float(i), float(j), 0.0), (i * x, j * y, 0.0)) for i in (-1, 1) for j in (-1, 1)]


def _slope(x0: float, z0: float, x1: float, z1: float) -> Cut:
    """The face through (x0, z0) and (x1, z1) of the side view, outward up; x0 > x1."""
    return ((z1 - z0, 0.0, x0 - x1), (x0, 0.0, z0))


def _leaning_sides(half_width: float, z: float, lean_deg: float) -> list[Cut]:
    """Left and right faces that lean inward from the height z up."""
    c, s = np.cos(np.radians(lean_deg)), np.sin(np.radians(lean_deg))
    return [((0.0, side * c, s), (0.0, side * half_width, z)) for side in (-1, 1)]


def vehicle_solids(label: Label, size: Sequence[float]) -> list[Solid]:
    """The pieces of a vehicle that heads along +x and stands on z = 0 over the origin.

    The pieces touch all six faces of the box (length, width, height): bumpers, tyres and roof.

    Args:
      label: decides the shape; all but cars and vans look like trucks.
      size: (length, width, height), m.

    Returns:
      Convex solids within the box.
    """
    return {Label.CAR: _car, Label.VAN: _van}.get(label, _truck)(*size)


Body = Callable[[float, float, float], list[Solid]]
"""Makes the pieces of a vehicle from its length, width and height, m, as `vehicle_solids` does."""

SEDAN_LENGTH_M = 4.2
"""Cars longer than this have a boot; shorter ones a steep tailgate."""


def _car(length: float, width: float, height: float) -> list[Solid]:
    belt, half, body = 0.6 * height, width / 2, width - 2 * TYRE_BULGE_M
    screen, roof = 0.26 * length, 0.26 * length - 0.62 * height
    sedan = length > SEDAN_LENGTH_M
    tail, tail_top = (-0.36 * length, -0.2 * length) if sedan else (-0.48 * length, -0.41 * length)
    lower = make_solid(
        (-length / 2, -body / 2, 0.2),
        (length / 2, body / 2, belt),
        material=Material.PAINT,
        cuts=[
            *_rounded_corners(length, body, 0.2),
            _slope(length / 2, 0.44 * height, screen, belt),
            _slope(-0.44 * length, belt, -length / 2, 0.48 * height),
            ((1.0, 0.0, -1.0), (length / 2, 0.0, 0.3)),
            ((-1.0, 0.0, -1.0), (-length / 2, 0.0, 0.3)),
        ],
    )
    cabin = make_solid(
        (-length / 2, -half, belt),
        (screen, half, height),
        material=Material.PAINT,
        cuts=[
            _slope(screen, belt, roof, height),
            _slope(tail_top, height, tail, belt),
            *_leaning_sides(half - 0.05, belt, 20.0),
        ],
        cut_material=Material.GLASS,
    )
    return [lower, cabin, *_wheels((-0.31 * length, 0.31 * length), half, 0.31)]


def suv_body(length: float, width: float, height: float) -> list[Solid]:
    """A tall car with a long bonnet and an upright tailgate."""
    belt, half, body = 0.6 * height, width / 2, width - 2 * TYRE_BULGE_M
    screen, roof = 0.24 * length, 0.1 * length
    lower = make_solid(
        (-length / 2, -body / 2, 0.25),
        (length / 2, body / 2, belt),
        material=Material.PAINT,
        cuts=[*_rounded_corners(length, body, 0.2), _slope(length / 2, 0.5 * height, screen, belt)],
    )
    cabin = make_solid(
        (-length / 2, -half, belt),
        (screen, half, height),
        material=Material.PAINT,
        cuts=[
            _slope(screen, belt, roof, height),
            _slope(-0.44 * length, height, -0.49 * length, belt),
            *_leaning_sides(half - 0.05, belt, 12.0),
        ],
        cut_material=Material.GLASS,
    )
    return [lower, cabin, *_wheels((-0.3 * length, 0.31 * length), half, 0.37)]


def pickup_body(length: float, width: float, height: float) -> list[Solid]:
    """A car with a low bed behind its cabin."""
    belt, half, body = 0.58 * height, width / 2, width - 2 * TYRE_BULGE_M
    lower = make_solid(
        (-length / 2, -body / 2, 0.3),
        (length / 2, body / 2, belt),
        material=Material.PAINT,
        cuts=[*_rounded_corners(length, body, 0.15), _slope(length / 2, 0.5 * height, 0.24 * length, belt)],
    )
    cabin = make_solid(
        (-0.14 * length, -half, belt),
        (0.24 * length, half, height),
        material=Material.PAINT,
        cuts=[_slope(0.24 * length, belt, 0.11 * length, height), *_leaning_sides(half - 0.05, belt, 12.0)],
        cut_material=Material.GLASS,
    )
    return [lower, cabin, *_wheels((-0.3 * length, 0.31 * length), half, 0.38)]


def _van(length: float, width: float, height: float) -> list[Solid]:
    belt, half, body = 0.5 * height, width / 2, width - 2 * TYRE_BULGE_M
    screen, bulkhead = 0.36 * length, 0.17 * length
    lower = make_solid(
        (-length / 2, -body / 2, 0.22),
        (length / 2, body / 2, belt),
        material=Material.PAINT,
        cuts=[*_rounded_corners(length, body, 0.15), _slope(length / 2, 0.4 * height, screen, belt)],
    )
    cargo = make_solid(
        (-length / 2, -body / 2, belt),
        (bulkhead, body / 2, height),
        material=Material.PAINT,
        cuts=[*_leaning_sides(body / 2, belt, 5.0), ((-1.0, 0.0, 0.1), (-length / 2, 0.0, belt))],
    )
    cabin = make_solid(
        (bulkhead, -body / 2, belt),
        (screen, body / 2, height),
        material=Material.PAINT,
        cuts=[_slope(screen, belt, bulkhead, height), *_leaning_sides(body / 2, belt, 5.0)],
        cut_material=Material.GLASS,
    )
    return [lower, cargo, cabin, *_wheels((-0.3 * length, 0.32 * length), half, 0.33)]


def _truck(length: float, width: float, height: float) -> list[Solid]:
    front, back, half = length / 2, -length / 2, width / 2
    cab_half, sill, cab_top = half - 0.05, 0.45 * height, 0.86 * height
    cab = make_solid(
        (front - 1.9, -cab_half, 0.45),
        (front, cab_half, sill),
        material=Material.PAINT,
        cuts=_rounded_corners(length, 2 * cab_half, 0.15),
    )
    windows = make_solid(
        (front - 1.9, -cab_half, sill),
        (front, cab_half, cab_top),
        material=Material.PAINT,
        cuts=[_slope(front, sill, front - 0.3, cab_top), *_rounded_corners(length, 2 * cab_half, 0.15)],
        cut_material=Material.GLASS,
    )
    chassis = make_solid((back + 0.3, -0.45, 0.5), (front - 0.3, 0.45, 1.05), material=Material.TYRE)
    cargo = make_solid((back, -half, 1.05), (front - 2.2, half, height), material=Material.PAINT)
    axles = (front - 1.2, back + 1.4, back + 2.6)
    return [cab, windows, chassis, cargo, *_wheels(axles, half - TYRE_BULGE_M, 0.5)]
