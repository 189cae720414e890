"""A calibrated camera next to the sensor, and its picture of a scene."""

import jax.numpy as jnp
import numpy as np

from jaxbox.synthetic.raycast import Hits, cast, is_shaded
from jaxbox.synthetic.scene import Clutter, Scene, vehicle_pose
from jaxbox.synthetic.solids import Material
from jaxbox.types import Calibration

IMAGE_SIZE_PX = (1242, 375)
FOCAL_PX = 720.0
PRINCIPAL_POINT_PX = (610.0, 173.0)
"""About those of KITTI's colour camera (Geiger et al. 2013)."""
CAMERA_XYZ_M = (0.27, 0.0, -0.08)
"""Of the rectified frame's origin, in the sensor frame."""
BASELINE_M = 0.06
"""The colour camera stands this far left of that origin, so P's last column is not zero, as in KITTI."""
CAMERA_PITCH_DEG = 0.8
"""The camera looks down by this angle."""

SUN = np.array([-0.45, 0.5, 0.75]) / np.linalg.norm([-0.45, 0.5, 0.75])
"""Direction toward the sun: behind and to the left."""
AMBIENT = 0.45
"""Light in the shade, of 1 in the sun."""
SKY_RGB = np.array([0.62, 0.75, 0.9])
HAZE_M = 400.0
"""Distance at which the air hides two thirds of a thing."""
GAMMA = 2.2
EXPOSURE = 1.5
ALBEDO_RGB = {
    Material.ROAD: (0.16, 0.16, 0.17),
    Material.SIDEWALK: (0.33, 0.32, 0.3),
    Material.GRASS: (0.15, 0.24, 0.07),
    Material.GLASS: (0.05, 0.07, 0.09),
    Material.TYRE: (0.02, 0.02, 0.02),
    Material.POLE: (0.2, 0.19, 0.17),
    Material.FOLIAGE: (0.09, 0.19, 0.04),
}
"""Linear RGB in [0, 1]; paint and walls have their own."""


def make_calibration() -> Calibration:
    """The calibration of the synthetic camera: KITTI-like, with a small pitch and a baseline.

    Returns:
      A calibration whose rectified frame is x right, y down, z forward.
    """
    pitch = np.radians(CAMERA_PITCH_DEG)
    c, s = np.cos(pitch), np.sin(pitch)
    axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    down = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    T_rect_velo = np.eye(4)
    T_rect_velo[:3, :3] = down @ axes
    T_rect_velo[:3, 3] = -T_rect_velo[:3, :3] @ CAMERA_XYZ_M
    cx, cy = PRINCIPAL_POINT_PX
    K = np.array([[FOCAL_PX, 0.0, cx], [0.0, FOCAL_PX, cy], [0.0, 0.0, 1.0]])
    P_rect = K @ np.array([[1.0, 0.0, 0.0, BASELINE_M], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    return Calibration(
        P_rect=jnp.asarray(P_rect, jnp.float32),
        T_rect_velo=jnp.asarray(T_rect_velo, jnp.float32),
        image_size_px=jnp.array(IMAGE_SIZE_PX, jnp.int32),
    )


def pixel_rays(calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """The camera's centre (3,) and the unit directions (h w, 3) of its pixels, row by row, sensor frame."""
    P = np.asarray(calibration.P_rect, np.float64) @ np.asarray(calibration.T_rect_velo, np.float64)
    width, height = (int(n) for n in np.asarray(calibration.image_size_px))
    v, u = np.mgrid[:height, :width].reshape(2, -1)
    back = np.linalg.inv(P[:, :3])
    directions = np.stack([u, v, np.ones_like(u)], axis=-1) @ back.T
    return -back @ P[:, 3], directions / np.linalg.norm(directions, axis=1, keepdims=True)


def render_image(scene: Scene, calibration: Calibration) -> np.ndarray:
    """A shaded picture of a scene, one ray a pixel, with shadows of the sun.

    Args:
      scene: the scene.
      calibration: the camera.

    Returns:
      (h, w, 3) uint8 RGB.
    """
    origin, directions = pixel_rays(calibration)
    hits = cast(scene, origin, directions, np.zeros(len(directions)))
    seen = np.isfinite(hits.distance)
    distance = np.where(seen, hits.distance, 0)
    # A little off the surface, so that it does not shade itself.
    points = origin + distance[:, None] * directions + 0.02 * hits.normal
    light = AMBIENT + (1 - AMBIENT) * np.maximum(hits.normal @ SUN, 0)
    lit = seen & (light > AMBIENT)
    shaded = np.zeros(len(points), bool)
    shaded[lit] = is_shaded(scene, points[lit], SUN)
    light = np.where(shaded, AMBIENT, light)
    clear = np.exp(-distance / HAZE_M)[:, None] * seen[:, None]
    sky = SKY_RGB + 0.35 * np.clip(0.25 - directions[:, 2:], 0, 0.25)
    color = clear * _albedo(scene, hits, points) * light[:, None] * EXPOSURE + (1 - clear) * sky**GAMMA
    width, height = (int(n) for n in np.asarray(calibration.image_size_px))
    return (np.clip(color, 0, 1) ** (1 / GAMMA) * 255).astype(np.uint8).reshape(height, width, 3)


def _albedo(scene: Scene, hits: Hits, points: np.ndarray) -> np.ndarray:
    """(n, 3) colour of each surface, with its pattern."""
    table = np.zeros((len(Material), 3))
    table[list(ALBEDO_RGB)] = list(ALBEDO_RGB.values())
    color = table[hits.material]
    paints = np.array([thing.paint for thing in scene.things()] + [(0.0, 0.0, 0.0)])
    own = np.isin(hits.material, (Material.PAINT, Material.WALL))
    color[own] = paints[hits.thing[own]]
    color = _with_grain(color, hits.material, points)
    color[_is_marking(scene, hits, points)] = 0.6
    color[_is_window(hits, points)] = (0.07, 0.09, 0.11)
    for index, vehicle in enumerate(scene.vehicles):
        linear, offset = vehicle_pose(vehicle, scene.terrain)
        rows = np.flatnonzero((hits.object_id == index) & (hits.material == Material.PAINT))
        local = (points[rows] - offset) @ np.linalg.inv(linear).T
        color[rows] = _with_lamps(color[rows], local, vehicle.size)
    return color


GRAIN = {
    Material.ROAD: 0.1,
    Material.SIDEWALK: 0.1,
    Material.GRASS: 0.4,
    Material.WALL: 0.08,
    Material.FOLIAGE: 0.7,
}
"""Relative variation of brightness from place to place."""
GRAIN_M = 0.08


def _with_grain(color: np.ndarray, material: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Varies brightness by a hash of the place, so that surfaces are not flat."""
    cell = np.floor(points / GRAIN_M)
    noise = np.sin(cell @ np.array([12.9898, 78.233, 37.719])) * 43758.5453
    strength = np.zeros(len(Material))
    strength[list(GRAIN)] = list(GRAIN.values())
    return color * (1 + strength[material] * (noise - np.floor(noise) - 0.5))[:, None]


def _is_marking(scene: Scene, hits: Hits, points: np.ndarray) -> np.ndarray:
    """The dashed line along the middle of the road, 3 m in every 9 m."""
    road, (x, y) = scene.terrain.road, points[:, :2].T
    dash = (np.abs(road.across(x, y)) < 0.07) & (road.along(x, y) % 9 < 3)
    return dash & (hits.material == Material.ROAD) & (hits.object_id == Clutter.GROUND)


def _is_window(hits: Hits, points: np.ndarray) -> np.ndarray:
    """Windows of buildings, on a grid of 2.6 m by 2.8 m, on walls above eye level."""
    along = points[:, 0] * -hits.normal[:, 1] + points[:, 1] * hits.normal[:, 0]
    pane = (along % 2.6 < 1.2) & ((points[:, 2] + 0.6) % 2.8 < 1.5)
    upright = np.abs(hits.normal[:, 2]) < 0.1
    return pane & upright & (points[:, 2] > -0.6) & (hits.material == Material.WALL)


def _with_lamps(color: np.ndarray, local: np.ndarray, size: tuple[float, float, float]) -> np.ndarray:
    """Paints head lamps, tail lamps and number plates on a vehicle; ``local`` is in its own frame."""
    x, y, z = local.T
    color = color.copy()
    ends = np.abs(x) > size[0] / 2 - 0.22
    lamp = ends & (np.abs(y) > 0.3 * size[1]) & (np.abs(z - 0.62) < 0.09)
    color[lamp & (x > 0)] = (0.9, 0.9, 0.85)
    color[lamp & (x < 0)] = (0.3, 0.0, 0.01)
    color[ends & (np.abs(y) < 0.26) & (np.abs(z - 0.45) < 0.06)] = (0.8, 0.8, 0.78)
    return color
