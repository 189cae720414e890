"""The sweep in perspective, seen by a camera behind and above the sensor (paper, figure 10)."""

import dataclasses
import math

import numpy as np

from jaxbox.viz.bird_eye import SENSOR_HEIGHT_M
from jaxbox.viz.boxes import BoxSet
from jaxbox.viz.canvas import blank, draw_legend, draw_points, draw_segments
from jaxbox.viz.colors import FAINT, Color, color_by_height
from jaxbox.viz.perspective import NEAR_M, cut_segments, project, transform
from jaxbox.viz.verdict import group_boxes, legend_entries

RING_STEP_M = 10.0
NUM_RINGS = 6
RING_SEGMENTS = 96


@dataclasses.dataclass(frozen=True, kw_only=True)
class LidarCamera:
    """A pinhole camera that looks at a target from a place, both in the sensor frame."""

    eye_m: tuple[float, float, float] = (-16.0, 0.0, 11.0)
    """m: where the camera stands."""
    target_m: tuple[float, float, float] = (12.0, 0.0, -2.0)
    """m: what it looks at."""
    fov_deg: float = 70.0
    """Horizontal angle of view."""
    width_px: int = 1200
    """Width of the picture."""
    height_px: int = 700
    """Height of the picture."""

    def projection(self) -> np.ndarray:
        """(3, 4): from the camera frame (x right, y down, z ahead) to pixels."""
        focal_px = self.width_px / 2 / math.tan(math.radians(self.fov_deg) / 2)
        middle = (self.width_px / 2, self.height_px / 2)
        return np.array([[focal_px, 0, middle[0], 0], [0, focal_px, middle[1], 0], [0, 0, 1, 0]])

    def T_camera_velo(self) -> np.ndarray:
        """(4, 4): rigid transform from the sensor frame to the camera frame.

        >>> LidarCamera().T_camera_velo().shape
        (4, 4)
        """
        eye = np.array(self.eye_m)
        ahead = np.array(self.target_m) - eye
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, (0.0, 0.0, 1.0))
        right = right / np.linalg.norm(right)
        rotation = np.stack([right, np.cross(ahead, right), ahead])
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ eye
        return matrix


def draw_lidar_view(
    xyz: np.ndarray,
    *,
    colors: np.ndarray | None = None,
    boxes: BoxSet | None = None,
    truth: BoxSet | None = None,
    judged: np.ndarray | None = None,
    camera: LidarCamera | None = None,
    title: str = "",
) -> np.ndarray:
    """Draws a sweep and 3D boxes in perspective; edges are cut in front of the camera.

    Args:
      xyz: (n, 3) real numbers, m, sensor frame; points that are not finite are not drawn.
      colors: (n, 3) uint8; None colours by height over the road of the KITTI car.
      boxes: estimates.
      truth: true boxes.
      judged: (K,) bool: estimates that the truth covers; None is all.
      camera: where the view is taken from; None is behind and above the sensor.
      title: first line of the legend.

    Returns:
      (h, w, 3) uint8, red green blue.
    """
    camera = camera or LidarCamera()
    xyz = np.asarray(xyz, np.float64)
    if colors is None:
        colors = color_by_height(xyz[:, 2] + SENSOR_HEIGHT_M)
    picture = blank(width_px=camera.width_px, height_px=camera.height_px)
    _draw_segments_3d(picture, _ring_segments(), camera, FAINT, thickness_px=1)
    _draw_points_3d(picture, xyz, colors, camera)
    groups = group_boxes(boxes, truth, judged)
    for group in groups:
        for segments in group.boxes.segments():
            _draw_segments_3d(picture, segments, camera, group.color, thickness_px=group.thickness_px)
    draw_legend(picture, legend_entries(groups), title=title)
    return picture


def _draw_points_3d(picture: np.ndarray, xyz: np.ndarray, colors: np.ndarray, camera: LidarCamera) -> None:
    local = transform(xyz, camera.T_camera_velo())
    ahead = np.isfinite(local).all(axis=1) & (local[:, 2] > NEAR_M)
    local, colors = local[ahead], colors[ahead]
    # Far points first: near ones cover them.
    order = np.argsort(-local[:, 2], kind="stable")
    draw_points(picture, project(local[order], camera.projection()), colors[order])


def _draw_segments_3d(
    picture: np.ndarray, segments: np.ndarray, camera: LidarCamera, color: Color, *, thickness_px: int
) -> None:
    cut = cut_segments(transform(segments, camera.T_camera_velo()))
    draw_segments(picture, project(cut, camera.projection()), color, thickness_px=thickness_px)


def _ring_segments() -> np.ndarray:
    """(n, 2, 3), m: range rings on a flat road."""
    turn = np.linspace(0, 2 * np.pi, RING_SEGMENTS + 1)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    radii = RING_STEP_M * np.arange(1, NUM_RINGS + 1)
    rings = radii[:, None, None] * circle
    rings = np.concatenate([rings, np.full((*rings.shape[:2], 1), -SENSOR_HEIGHT_M)], axis=-1)
    return np.stack([rings[:, :-1], rings[:, 1:]], axis=2).reshape(-1, 2, 3)
