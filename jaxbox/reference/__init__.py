"""The same pipeline in NumPy, SciPy and OpenCV: the oracle of the tests, the baseline of the benchmarks.

Written apart from the compiled stages, and sharing nothing with them but the settings: float64, one
cluster after the other, no capacity of fixed shapes. One public function a stage, under the same name.
"""

from jaxbox.reference.boxes import (
    ShapeDescriptors,
    convex_hull,
    criterion_curve,
    fit_points,
    min_area_rectangle,
    shape_descriptors,
    signed_area,
    wrap_yaw,
)
from jaxbox.reference.clusters import (
    NO_CLUSTER,
    count_runs,
    euclidean_clusters,
    grid_cells,
    keep_clusters,
    label_components,
    warp_range,
)
from jaxbox.reference.completion import (
    CompletedBox,
    Reading,
    complete_box,
    complete_extent,
    direction_preference,
    likely_size,
    point_agreement,
    scene_direction,
)
from jaxbox.reference.detector import ReferenceDetections, detect
from jaxbox.reference.evidence import (
    BoxEvidence,
    Evidence,
    azimuth_cell,
    box_evidence,
    build_evidence,
    ground_support,
    support_at,
)
from jaxbox.reference.filtering import filter_outliers, select_points
from jaxbox.reference.ground import (
    cell_minima,
    fit_ground_plane,
    fit_ground_planes,
    fit_ground_surface,
    ground_elevation,
    height_above_ground,
    plane_elevation,
    spread_candidates,
    surface_deviation,
)
from jaxbox.reference.vehicles import (
    PointsAround,
    bev_iou,
    count_points_around,
    depth_behind_faces,
    distance_outside,
    score_box,
    suppress,
)

__all__ = [
    "NO_CLUSTER",
    "BoxEvidence",
    "CompletedBox",
    "Evidence",
    "PointsAround",
    "Reading",
    "ReferenceDetections",
    "ShapeDescriptors",
    "azimuth_cell",
    "bev_iou",
    "box_evidence",
    "build_evidence",
    "cell_minima",
    "complete_box",
    "complete_extent",
    "convex_hull",
    "count_points_around",
    "count_runs",
    "criterion_curve",
    "depth_behind_faces",
    "detect",
    "direction_preference",
    "distance_outside",
    "euclidean_clusters",
    "filter_outliers",
    "fit_ground_plane",
    "fit_ground_planes",
    "fit_ground_surface",
    "fit_points",
    "grid_cells",
    "ground_elevation",
    "ground_support",
    "height_above_ground",
    "keep_clusters",
    "label_components",
    "likely_size",
    "min_area_rectangle",
    "plane_elevation",
    "point_agreement",
    "scene_direction",
    "score_box",
    "select_points",
    "shape_descriptors",
    "signed_area",
    "spread_candidates",
    "support_at",
    "suppress",
    "surface_deviation",
    "warp_range",
    "wrap_yaw",
]
