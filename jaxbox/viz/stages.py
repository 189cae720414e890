"""One picture a stage, as the paper's figures 4 to 11 show them."""

import numpy as np

from jaxbox.types import Calibration, Detections, PointCloud
from jaxbox.viz.bird_eye import BirdEyeFrame, draw_bird_eye
from jaxbox.viz.boxes import BoxSet
from jaxbox.viz.colors import color_by_height, color_by_id
from jaxbox.viz.image_boxes import draw_image_boxes
from jaxbox.viz.lidar_view import draw_lidar_view


def draw_stages(
    cloud: PointCloud,
    detections: Detections,
    *,
    calibration: Calibration | None = None,
    image: np.ndarray | None = None,
    truth: BoxSet | None = None,
    judged: np.ndarray | None = None,
    min_score: float = 0.0,
    frame: BirdEyeFrame | None = None,
) -> dict[str, np.ndarray]:
    """Draws what each stage left behind, from one sweep and its detections.

    Args:
      cloud: the sweep, unbatched.
      detections: the answer for it.
      calibration: of the camera; without it nothing is drawn on the image.
      image: (h, w, 3) uint8 camera image, or None.
      truth: true boxes, or None.
      judged: (K,) bool for the boxes of at least that score: those that the truth covers; None is all.
      min_score: boxes that score less are not drawn.
      frame: the part of the world that the views from above show.

    Returns:
      Name to picture (h, w, 3) uint8, in the order of the stages: ``sweep`` (figure 5), ``no_ground``
      (6), ``clusters`` (7, 8), ``hulls`` (9), ``boxes`` and ``lidar`` (10), and with a camera
      ``image`` (4, 11).
    """
    used = np.asarray(cloud.xyz1)[:, 3] > 0
    xyz = np.asarray(cloud.xyz1)[used, :3].astype(np.float64)
    raised = ~np.asarray(detections.ground_mask)[used]
    component = np.asarray(detections.point_component)[used]
    by_height = color_by_height(height_above_plane(xyz, detections))
    by_cluster = color_by_id(component)
    boxes = BoxSet.from_detections(detections, min_score=min_score)
    common = {"boxes": boxes, "truth": truth, "judged": judged}
    pictures = {
        "sweep": draw_bird_eye(xyz, colors=by_height, frame=frame, title=f"{len(xyz)} points by height"),
        "no_ground": draw_bird_eye(
            xyz[raised], colors=by_height[raised], frame=frame, title=f"ground removed: {raised.sum()} points"
        ),
        "clusters": draw_bird_eye(
            xyz[raised], colors=by_cluster[raised], frame=frame, title=_count_clusters(component)
        ),
        "hulls": draw_bird_eye(
            xyz[raised],
            colors=by_cluster[raised],
            hulls=hull_polygons(detections, min_score=min_score),
            frame=frame,
            title="convex hulls",
        ),
        "boxes": draw_bird_eye(xyz, colors=by_height, frame=frame, title="boxes", **common),
        "lidar": draw_lidar_view(xyz, colors=by_height, title="boxes in the LiDAR view", **common),
    }
    if image is not None and calibration is not None:
        pictures["image"] = draw_image_boxes(image, calibration, title="boxes in the image", **common)
    return pictures


def hull_polygons(detections: Detections, *, min_score: float = 0.0) -> list[np.ndarray]:
    """Hulls of the valid boxes without padding: a list of (h, 2) arrays, m, sensor frame."""
    keep = np.asarray(detections.valid) & (np.asarray(detections.score) >= min_score)
    vertices = np.asarray(detections.hulls.vertices)
    counts = np.minimum(np.asarray(detections.hulls.num_vertices), vertices.shape[1])
    return [vertices[row, : counts[row]] for row in np.flatnonzero(keep & (counts > 0))]


def height_above_plane(xyz: np.ndarray, detections: Detections) -> np.ndarray:
    """Heights (n,) m of points (n, 3) m above the ground plane of the detections."""
    a, b, c = np.asarray(detections.ground.coefficients, np.float64)
    return xyz[:, 2] - (a * xyz[:, 0] + b * xyz[:, 1] + c)


def _count_clusters(component: np.ndarray) -> str:
    return f"{len(np.unique(component[component >= 0]))} connected components"
