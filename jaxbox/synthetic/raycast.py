"""Which surface each ray meets first."""

import dataclasses

import numpy as np

from jaxbox.synthetic.scene import Clutter, Scene, Thing
from jaxbox.synthetic.solids import Material
from jaxbox.synthetic.terrain import Terrain

SIDEWALK_WIDTH_M = 2.4


@dataclasses.dataclass(frozen=True)
class Hits:
    """What n rays meet first. Where the distance is infinite the rest is arbitrary."""

    distance: np.ndarray
    """(n,) float64, m; infinite for a ray that meets nothing."""
    object_id: np.ndarray
    """(n,) int64: index of a vehicle, or a `Clutter` code."""
    material: np.ndarray
    """(n,) int64: a `Material`."""
    normal: np.ndarray
    """(n, 3) float64, unit: outward."""
    thing: np.ndarray
    """(n,) int64: row in `Scene.things`, -1 for the ground."""
    met: np.ndarray
    """(V,) int64: rays that meet each vehicle if it is alone."""
    seen: np.ndarray
    """(V,) int64: rays of those that still do."""

    @property
    def visible(self) -> np.ndarray:
        """(V,) float64: of the rays that meet each vehicle if it is alone, the share that still do."""
        return self.seen / np.maximum(self.met, 1)


def cast(scene: Scene, origin: np.ndarray, directions: np.ndarray, draw: np.ndarray) -> Hits:
    """Casts rays from one point; the nearest surface wins.

    Args:
      scene: the scene.
      origin: (3,), m, above ground.
      directions: (n, 3), unit.
      draw: (n,) in [0, 1): fate of each ray on glass and in foliage; 0 for the outer surface.

    Returns:
      The first hits.
    """
    distance = scene.terrain.first_hit(origin, directions)
    ground = origin + np.where(np.isfinite(distance), distance, 0)[:, None] * directions
    normal = scene.terrain.normal(ground[:, 0], ground[:, 1])
    material = ground_material(scene.terrain, ground)
    row = np.full(len(distance), -1)
    met = np.zeros(len(scene.vehicles), np.int64)
    things = scene.things()
    for index, thing in enumerate(things):
        rays, thing_distance, thing_material, thing_normal = _hit_thing(thing, origin, directions, draw)
        if thing.object_id >= 0:
            met[thing.object_id] = len(rays)
        nearer = thing_distance < distance[rays]
        rays = rays[nearer]
        distance[rays], row[rays] = thing_distance[nearer], index
        material[rays], normal[rays] = thing_material[nearer], thing_normal[nearer]
    ids = np.array([thing.object_id for thing in things] + [Clutter.GROUND])
    seen = np.bincount(row[row >= 0], minlength=len(things))[: len(met)]
    return Hits(distance, ids[row], material, normal, row, met, seen)


def ground_material(terrain: Terrain, points: np.ndarray) -> np.ndarray:
    """(n,) `Material` of ground points (n, 3): from the middle outward road, sidewalk, grass."""
    beyond = np.abs(terrain.road.across(points[:, 0], points[:, 1])) - terrain.road.half_width_m
    return np.where(
        beyond < 0, Material.ROAD, np.where(beyond < SIDEWALK_WIDTH_M, Material.SIDEWALK, Material.GRASS)
    )


def is_shaded(scene: Scene, points: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(n,) bool: whether a thing stands between each point (n, 3) and a far light in one direction (3,)."""
    shaded = np.zeros(len(points), bool)
    for thing in scene.things():
        rays = _rays_near(*thing.sphere, points, direction[None])
        directions = np.broadcast_to(direction, (len(rays), 3))
        for shape in thing.shapes:
            hit = shape.first_hit(points[rays], directions, np.zeros(len(rays)))[0]
            shaded[rays] |= np.isfinite(hit)
    return shaded


def _hit_thing(
    thing: Thing, origin: np.ndarray, directions: np.ndarray, draw: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rays that meet a thing, and the distance, material and normal of its nearest piece."""
    rays = _rays_near(*thing.sphere, origin[None], directions)
    directions, draw = directions[rays], draw[rays]
    distance = np.full(len(rays), np.inf)
    material = np.zeros(len(rays), np.int64)
    normal = np.zeros((len(rays), 3))
    for shape in thing.shapes:
        near = _rays_near(shape.center, shape.radius, origin[None], directions)
        piece, piece_material, piece_normal = shape.first_hit(origin[None], directions[near], draw[near])
        nearer = piece < distance[near]
        rows = near[nearer]
        distance[rows], material[rows], normal[rows] = (
            piece[nearer],
            piece_material[nearer],
            piece_normal[nearer],
        )
    hit = np.isfinite(distance)
    return rays[hit], distance[hit], material[hit], normal[hit]


def _rays_near(center: np.ndarray, radius: float, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Rows of the rays that pass through a sphere; one origin for all, or one direction for all."""
    to_center = center - origins
    along = (to_center @ directions.T).ravel()
    nearest_sq = (to_center * to_center).sum(axis=1) - along * along
    return np.flatnonzero((nearest_sq < radius**2) & (along > -radius))
