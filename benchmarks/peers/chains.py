"""Chains of other libraries for the same task: outliers, ground, clusters, boxes.

Each takes the points in the region and gives boxes, and how much it kept on the way. They use the
library's own algorithms at settings that suit a 64-beam sweep, the same wherever two have the same setting,
and the same gate of sizes at the end. None completes what is out of sight, scores, or suppresses.
"""

# pyright: reportMissingImports=false
# A peer may be missing.

import dataclasses
import pathlib
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

NEIGHBOURS, NUM_STD = 20, 2.0
"""Of the statistical outlier removal."""
HYPOTHESES = 128
"""Planes that RANSAC tries."""
PLANE_TOLERANCE_M = 0.2
LINK_M = 0.5
"""Points so near to each other are of one cluster."""
MIN_POINTS, MAX_POINTS = 10, 20000
VOXEL_M = 0.2
"""Of the chains that cluster one point a voxel."""
MAX_HEIGHT_M = 3.5
SENSOR_HEIGHT_M = 1.73
"""KITTI's, which Patchwork++ wants to know."""

LENGTHS_M, WIDTHS_M, HEIGHTS_M = (1.5, 8.0), (0.4, 3.0), (0.6, 4.0)
"""What is not a vehicle by its measured size."""


@dataclasses.dataclass(frozen=True)
class Answer:
    """What a chain found in a sweep."""

    kept: int
    """Points that are neither outliers nor ground."""
    clusters: int
    """Clusters of those."""
    boxes: np.ndarray
    """(k, 5) m and rad: x, y, length, width, yaw; best first where the chain scores."""


Chain = Callable[[np.ndarray], Answer]
"""From (n, 3) float32 points in the region to what is found."""


class MissingPeer(Exception):
    """A library that is not there; the message is the command that installs it."""


def gate_sizes(boxes: np.ndarray) -> np.ndarray:
    """Keeps boxes of a vehicle's size.

    Args:
      boxes: (k, 7): x, y, length, width, yaw, height, bottom.

    Returns:
      (k', 5) without height and bottom.
    """
    boxes = np.reshape(boxes, (-1, 7))
    size = np.column_stack([np.sort(boxes[:, 2:4], axis=1)[:, ::-1], boxes[:, 5]])
    low, high = np.array([LENGTHS_M, WIDTHS_M, HEIGHTS_M]).T
    return boxes[((size >= low) & (size <= high)).all(axis=1), :5]


def fit_rectangle(xyz: np.ndarray, num_angles: int = 90) -> np.ndarray:
    """The rectangle whose sides are nearest to the points, by a search over angles in NumPy.

    Args:
      xyz: (n, 3) m, of one cluster.
      num_angles: over a quarter turn.

    Returns:
      (7,): x, y, length, width, yaw, height, bottom.
    """
    angles = np.arange(num_angles) * (np.pi / 2 / num_angles)
    cos, sin = np.cos(angles), np.sin(angles)
    u = xyz[:, :1] * cos + xyz[:, 1:2] * sin
    v = xyz[:, 1:2] * cos - xyz[:, :1] * sin
    u_low, u_high, v_low, v_high = u.min(0), u.max(0), v.min(0), v.max(0)
    side = np.minimum(np.minimum(u - u_low, u_high - u), np.minimum(v - v_low, v_high - v))
    best = int(np.argmax((1 / np.maximum(side, 0.05)).sum(0)))
    length, width = u_high[best] - u_low[best], v_high[best] - v_low[best]
    middle_u, middle_v = (u_low[best] + u_high[best]) / 2, (v_low[best] + v_high[best]) / 2
    x, y = middle_u * cos[best] - middle_v * sin[best], middle_u * sin[best] + middle_v * cos[best]
    yaw = angles[best] + (np.pi / 2 if width > length else 0)
    low, high = xyz[:, 2].min(), xyz[:, 2].max()
    return np.array([x, y, max(length, width), min(length, width), yaw, high - low, low])


def box_clusters(xyz: np.ndarray, cluster: np.ndarray) -> Answer:
    """Rectangles of clusters that NumPy fits.

    Args:
      xyz: (n, 3) m, what was kept.
      cluster: (n,) of each point, -1 for none.

    Returns:
      The answer.
    """
    order = np.argsort(cluster, kind="stable")
    order = order[np.searchsorted(cluster[order], 0) :]
    groups = np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1) if len(order) else []
    groups = [group for group in groups if MIN_POINTS <= len(group) <= MAX_POINTS]
    boxes = [fit_rectangle(xyz[group]) for group in groups]
    return Answer(len(xyz), len(groups), gate_sizes(np.array(boxes)))


def voxel_clusters(xyz: np.ndarray, label: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(n,) clusters of points, by those of one point a voxel."""
    cells = np.floor(xyz / VOXEL_M).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    size = cells.max(axis=0, initial=0) + 1
    _, first, inverse = np.unique(
        (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2], return_index=True, return_inverse=True
    )
    return label(xyz[first])[inverse] if len(xyz) else np.zeros(0, int)


def above_plane(xyz: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Points higher above the plane a x + b y + c z + d = 0 than its tolerance."""
    plane = plane * np.sign(plane[2])
    return xyz[xyz @ plane[:3] + plane[3] > PLANE_TOLERANCE_M]


def open3d_chain() -> Chain:
    """Open3D: outliers, plane, DBSCAN, oriented boxes; it takes all cores."""
    try:
        import open3d as o3d  # noqa: PLC0415 - a peer that may be missing
    except ImportError as error:
        raise MissingPeer("pip install open3d") from error
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)

    def boxed(cloud: Any) -> np.ndarray:
        points = np.asarray(cloud.points)
        low, high = points[:, 2].min(), points[:, 2].max()
        # Flattened to two layers: its boxes are of volume, and would tilt.
        flat = np.concatenate([points * [1, 1, 0], points * [1, 1, 0] + [0, 0, 1]])
        box = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(flat)).get_minimal_oriented_bounding_box(
            robust=True
        )
        upright = int(np.argmax(np.abs(np.asarray(box.R)[2])))
        first, second = sorted(set(range(3)) - {upright}, key=lambda axis: -box.extent[axis])
        yaw = np.arctan2(box.R[1, first], box.R[0, first])
        return np.array([*box.center[:2], box.extent[first], box.extent[second], yaw, high - low, low])

    def run(xyz: np.ndarray) -> Answer:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz.astype(np.float64)))
        cloud, _ = cloud.remove_statistical_outlier(NEIGHBOURS, NUM_STD)
        plane, _ = cloud.segment_plane(PLANE_TOLERANCE_M, 3, HYPOTHESES)
        kept = o3d.geometry.PointCloud(
            o3d.utility.Vector3dVector(above_plane(np.asarray(cloud.points), np.asarray(plane)))
        )
        cluster = np.asarray(kept.cluster_dbscan(LINK_M, MIN_POINTS))
        order = np.argsort(cluster, kind="stable")
        order = order[np.searchsorted(cluster[order], 0) :]
        groups = np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1) if len(order) else []
        groups = [group for group in groups if MIN_POINTS <= len(group) <= MAX_POINTS]
        boxes = [boxed(kept.select_by_index(group)) for group in groups]
        return Answer(len(kept.points), len(groups), gate_sizes(np.array(boxes)))

    return run


def patchwork_chain() -> Chain:
    """Patchwork++ for the ground, Open3D's DBSCAN of voxels, rectangles in NumPy; no outlier removal."""
    try:
        import open3d as o3d  # noqa: PLC0415
        import pypatchworkpp  # noqa: PLC0415
    except ImportError as error:
        raise MissingPeer("pip install pypatchworkpp open3d") from error
    parameters = pypatchworkpp.Parameters()
    parameters.verbose = False
    parameters.sensor_height = SENSOR_HEIGHT_M
    patchwork = pypatchworkpp.patchworkpp(parameters)

    def label(points: np.ndarray) -> np.ndarray:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
        return np.asarray(cloud.cluster_dbscan(LINK_M, 3))

    def run(xyz: np.ndarray) -> Answer:
        patchwork.estimateGround(np.column_stack([xyz, np.zeros(len(xyz), np.float32)]))
        kept = np.asarray(patchwork.getNonground(), np.float32)[:, :3]
        kept = kept[kept[:, 2] < MAX_HEIGHT_M - SENSOR_HEIGHT_M]
        return box_clusters(kept, voxel_clusters(kept, label))

    return run


def sklearn_chain() -> Chain:
    """A plane by scikit-learn's RANSAC, its DBSCAN of voxels, rectangles in NumPy; no outlier removal."""
    try:
        from sklearn.cluster import DBSCAN  # noqa: PLC0415
        from sklearn.linear_model import LinearRegression, RANSACRegressor  # noqa: PLC0415
    except ImportError as error:
        raise MissingPeer("pip install scikit-learn") from error

    def run(xyz: np.ndarray) -> Answer:
        # Points that can be ground, every few: RANSAC here evaluates each plane on all points it is given.
        low = xyz[xyz[:, 2] < 0.5 - SENSOR_HEIGHT_M][::8].astype(np.float64)
        ransac = RANSACRegressor(
            LinearRegression(), residual_threshold=PLANE_TOLERANCE_M, max_trials=HYPOTHESES, random_state=0
        ).fit(low[:, :2], low[:, 2])
        line: Any = ransac.estimator_
        slope, offset = line.coef_, line.intercept_
        kept = above_plane(xyz, np.array([-slope[0], -slope[1], 1.0, -offset]))
        kept = kept[kept[:, 2] < MAX_HEIGHT_M - SENSOR_HEIGHT_M]
        dbscan = DBSCAN(eps=LINK_M, min_samples=3)
        return box_clusters(kept, voxel_clusters(kept, dbscan.fit_predict))

    return run


def pcl_chain() -> Chain:
    """PCL: outliers, plane, Euclidean clusters, hull, moment of inertia, as a C++ program."""
    install = "apt-get install libpcl-dev cmake g++"
    if shutil.which("cmake") is None:
        raise MissingPeer(install)
    build = pathlib.Path(tempfile.mkdtemp(prefix="jaxbox_pcl_"))
    source = pathlib.Path(__file__).parent
    for words in (["cmake", "-S", str(source), "-B", str(build)], ["cmake", "--build", str(build)]):
        subprocess.run(words, capture_output=True, check=False)
    program = build / "pcl_chain"
    if not program.is_file():
        raise MissingPeer(install)
    process = subprocess.Popen(
        [str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    return PclProcess(process, build)


@dataclasses.dataclass
class PclProcess:
    """The C++ program, asked through its pipes; it times itself, without the reading."""

    process: subprocess.Popen[str]
    """Waiting for names of files."""
    folder: pathlib.Path
    """Of the program, and for the points."""
    spent_ms: float = 0.0
    """Of the last sweep."""

    def __call__(self, xyz: np.ndarray) -> Answer:
        """Writes the points where the program finds them, and reads its answer."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        path = self.folder / "points.bin"
        np.column_stack([xyz, np.zeros(len(xyz))]).astype("<f4").tofile(path)
        self.process.stdin.write(f"{path}\n")
        self.process.stdin.flush()
        spent, kept, clusters = self.process.stdout.readline().split()
        self.spent_ms = float(spent)
        rows = iter(self.process.stdout.readline, "\n")
        boxes = np.array([[float(word) for word in row.split()] for row in rows])
        return Answer(int(kept), int(clusters), gate_sizes(boxes))


def numba_chain() -> Chain:
    """Hand-written loops on one thread: what the simple chain costs at the least."""
    try:
        from benchmarks.peers import loops  # noqa: PLC0415
    except ImportError as error:
        raise MissingPeer("pip install numba") from error

    def run(xyz: np.ndarray) -> Answer:
        rng = np.random.default_rng(0)
        settings = HYPOTHESES, PLANE_TOLERANCE_M, MAX_HEIGHT_M, LINK_M, MIN_POINTS
        kept, clusters, boxes = loops.detect(xyz, *settings, rng)
        return Answer(kept, clusters, gate_sizes(boxes))

    return run


PEERS: dict[str, Callable[[], Chain]] = {
    "PCL": pcl_chain,
    "Open3D": open3d_chain,
    "Patchwork++, Open3D, NumPy": patchwork_chain,
    "scikit-learn, NumPy": sklearn_chain,
    "numba loops, one thread": numba_chain,
}
"""Makers of the chains by name; each raises `MissingPeer`."""


def make_peers(names: Sequence[str]) -> tuple[dict[str, Chain], dict[str, str]]:
    """The chains that can run here, and for the others the command that installs them."""
    chains, missing = {}, {}
    for name in names:
        try:
            chains[name] = PEERS[name]()
        except MissingPeer as error:
            missing[name] = str(error)
    return chains, missing
