"""The data that flows between the stages: frozen pytree dataclasses, and the status bits.

Axis letters, project-wide: N points, K detections or clusters, H hull vertices, B batch.

Conventions, project-wide:

- The sensor frame ("velo") is x forward, y left, z up, in metres, with the sensor at the origin.
- ``size`` is (length, width, height) with length >= width.
- ``yaw`` turns +x to the length axis about +z, radians, in [-pi/2, pi/2); ``heading`` turns it to the
  front, as far as that is known.
- Invalid rows are masked by ``valid`` and hold finite numbers; dropped things are counted.
"""

import dataclasses
import enum
import functools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox._box import ByValue, Detection
from jaxbox._box_rows import BoxRows, later_module
from jaxbox._padding import aligned_empty, checked_points, fill_rows, fitting_capacity
from jaxbox.config import DetectorConfig
from jaxbox.config import Label as Label  # noqa: PLC0414 - one of the types that users hold
from jaxbox.config.capacities import CAPACITIES, CLOUD_CAPACITY, Capacity
from jaxbox.config.class_priors import classes_in_words
from jaxbox.xla.transfer import to_host

GROUND_ABOVE_M = 0.5
"""A ground plane that passes this high over the origin lies above the sensor: where recordings are in their
vehicle's frame, with the origin on the ground, it is off by bumps and slopes alone."""


class Status(enum.IntFlag):
    """What happened to a sweep. Zero is a clean run; each bit is explained by `describe`."""

    OK = 0
    EMPTY = 1
    NONFINITE_POINTS = 2
    POINT_OVERFLOW = 4
    NO_GROUND = 8
    OBSTACLE_OVERFLOW = 16
    CELL_OVERFLOW = 32
    CLUSTER_OVERFLOW = 64
    CANDIDATE_OVERFLOW = 128
    DETECTION_OVERFLOW = 256
    HULL_OVERFLOW = 512
    GROUND_ABOVE = 1024
    ASSIGNMENT_OVERFLOW = 2048
    DEGRADED = 4096
    DOUBTFUL_GROUND = 8192

    def describe(self) -> list[str]:
        """Returns one sentence a set bit: what happened and what to do about it.

        >>> Status.NO_GROUND.describe()
        ['NO_GROUND: no plane had enough support; heights are taken from the lowest candidate instead.']
        """
        return [f"{bit.name}: {_STATUS_TEXT[bit]}" for bit in Status if bit and bit in self]


_OVERFLOW_ROWS = {
    Status[name]: [row for row in CAPACITIES if row.status == name]
    for name in dict.fromkeys(row.status for row in CAPACITIES)
}
"""The capacities of each bit that says that one was too small, see `jaxbox.config.capacities`."""

_STATUS_TEXT = {
    Status.EMPTY: "no finite point lies within the region; there is nothing to detect.",
    Status.NONFINITE_POINTS: "points with NaN or infinite coordinates were ignored.",
    Status.POINT_OVERFLOW: "the sweep has more points than the cloud's capacity; the farthest "
    "were dropped. Use PointCloud.from_numpy(..., capacity=...), on the command line --capacity, with a "
    "larger capacity.",
    Status.NO_GROUND: "no plane had enough support; heights are taken from the lowest candidate instead.",
    Status.GROUND_ABOVE: "the ground lies above the origin, so that vehicles hang from it and are not found. "
    "The sensor is mounted upside down, z points down, or the points are not in the sensor's frame; turn or "
    "move them first.",
    Status.DEGRADED: "the returns are those of fog, heavy rain, snow, dust or a failing sensor: nearly none "
    "from afar, many from the air near by, or a blurred ground, and vehicles may be missing. Compare the "
    "counts with those of a good sweep; the limits are the settings under health.",
    Status.DOUBTFUL_GROUND: "the ground lies farther below the origin, or steeper, than a road lies under a "
    "vehicle's sensor, or right under it where no sensor looks, or many points lie below it. The points are "
    "not in metres, the sensor is tilted, or it is not at the origin: scale, turn or move them first; or the "
    "road lies on two levels, and vehicles may be missing.",
} | {bit: "; or ".join(row.overflow for row in rows) + "." for bit, rows in _OVERFLOW_ROWS.items()}


def combine_bits(bits: Mapping[Any, jax.Array]) -> jax.Array:
    """The status of the bits that are set.

    Args:
      bits: () bool of each.

    Returns:
      () int32.
    """
    return sum((jnp.where(is_set, jnp.int32(bit), 0) for bit, is_set in bits.items()), jnp.int32(0))


class Motion(enum.IntEnum):
    """What a tracked vehicle does, as far as its motion tells without a map."""

    STANDING = 0
    STARTING = 1
    MOVING = 2
    STOPPING = 3
    TURNING = 4
    LANE_CHANGE = 5

    @property
    def word(self) -> str:
        """As results and pictures name it.

        >>> Motion.LANE_CHANGE.word
        'lane change'
        """
        return self.name.lower().replace("_", " ")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class PointCloud(ByValue):
    """One sweep, padded to a capacity N. Build it with `from_numpy`."""

    xyz1: jax.Array | np.ndarray
    """(N, 4) float32, m, sensor frame: x, y, z and 1 for a point, all 0 for padding."""
    intensity: jax.Array | np.ndarray
    """(N,) float32, the sensor's own unit; 0 where unknown and for padding."""
    num_points: jax.Array | np.ndarray
    """() int32: points in the source sweep, which may exceed N (see `Status.POINT_OVERFLOW`)."""

    @property
    def capacity(self) -> int:
        """N, the padded number of points."""
        return self.xyz1.shape[-2]

    @classmethod
    def from_numpy(
        cls, xyz: np.ndarray, intensity: np.ndarray | None = None, *, capacity: int | None = None
    ) -> "PointCloud":
        """Pads one sweep to a capacity, so that sweeps of different length share one compile.

        Args:
          xyz: (n, 3) real numbers, m, sensor frame. NaN and infinity are allowed and are ignored,
            and counted, by the detector; so is a masked number, which is NaN.
          intensity: (n,) real numbers, or None for zeros; a masked one is 0.
          capacity: N; by default the smallest of `CAPACITY_BUCKETS` that holds n points, or the
            largest bucket. Where n is larger than N the N nearest points are kept, in their order.

        Returns:
          A cloud of NumPy arrays, whose `num_points` is n, also where points were dropped. A CPU uses them
          as they are; for several calls on an accelerator, hand them over once: ``jax.device_put(cloud)``.

        Raises:
          ValueError: for another shape, a non-numeric type or a capacity below 1.

        >>> PointCloud.from_numpy(np.zeros((5, 3), np.float32)).capacity
        16384
        """
        xyz, intensity = checked_points(xyz, intensity)
        capacity = fitting_capacity(len(xyz)) if capacity is None else capacity
        if capacity < 1:
            raise ValueError(f"capacity is {capacity}; it must be at least 1.")
        rows, padded = aligned_empty((capacity, 4)), aligned_empty((capacity,))
        fill_rows(xyz, intensity, rows, padded)
        # JAX uses them as they are, so nobody is to write to them any more.
        rows.flags.writeable = padded.flags.writeable = False
        return cls(rows, padded, np.array(len(xyz), np.int32))


def stack_clouds(clouds: Sequence[PointCloud]) -> PointCloud:
    """Stacks sweeps of one capacity into a batch for `jax.vmap(jaxbox.detect)`.

    Args:
      clouds: at least one cloud, all of the same capacity.

    Returns:
      A cloud whose arrays have a leading axis B.

    Raises:
      ValueError: for no clouds, or for different capacities.
    """
    capacities = {cloud.capacity for cloud in clouds}
    if len(capacities) != 1:
        raise ValueError(
            f"the clouds have capacities {sorted(capacities)}; a batch needs one. "
            "Pass the same capacity=... to PointCloud.from_numpy for each."
        )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *clouds)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class GroundPlane(ByValue):
    """The plane z = a x + b y + c that carries the most support."""

    coefficients: jax.Array
    """(3,) float32: a, b (slopes, unitless) and c (m, minus the sensor's height)."""
    found: jax.Array
    """() bool: False where no plane had enough support; then a = b = 0 and c is that of the lowest
    candidate, or 0 where there is none."""
    num_inliers: jax.Array
    """() int32: candidates within the tolerance of the plane."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Hulls(ByValue):
    """Convex hulls in the bird's-eye view, padded by repeating the last vertex."""

    vertices: jax.Array
    """(K, H, 2) float32, m, sensor frame: counter-clockwise."""
    num_vertices: jax.Array
    """(K,) int32: true number of vertices, which may exceed H; 0 for an empty row."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Descriptors(ByValue):
    """Shape descriptors of each detection's points (paper, 3.5 and 4.4)."""

    moment_of_inertia: jax.Array
    """(K, 2) float32, m^2: second central moments per point about the minor and the major axis,
    in the bird's-eye view (eigenvalues of the covariance, larger first)."""
    eccentricity: jax.Array
    """(K,) float32, >= 1: length of the major axis over length of the minor axis."""
    density: jax.Array
    """(K,) float32, points per m^2 of hull area."""
    complexity: jax.Array
    """(K,) float32: kappa = hull vertices / points (paper, equation 7)."""


NUM_POINT_COUNTS = 9
"""The first fields of `Counts` share out every point of the sweep."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Counts(ByValue):
    """True counts of the whole sweep: where each point went, and what each capacity had to hold.

    Every point of the source sweep is in exactly one of the first nine, so they sum to
    `PointCloud.num_points`. Where a sweep is read several times (``vehicles.num_readings``) these are of the
    first reading, and what a capacity had to hold is the most of any.
    """

    dropped_points: jax.Array
    """() int32: points beyond the cloud's capacity."""
    nonfinite_points: jax.Array
    """() int32: NaN or infinite points."""
    out_of_range_points: jax.Array
    """() int32: points outside the region."""
    outlier_points: jax.Array
    """() int32: points that the statistical filter removed."""
    ground_points: jax.Array
    """() int32: points lower than ground.min_height_m above the ground."""
    overhead_points: jax.Array
    """() int32: points higher above the ground than any vehicle."""
    dropped_obstacles: jax.Array
    """() int32: points above the ground beyond the obstacle capacity."""
    clustered_points: jax.Array
    """() int32: points of a cluster that passed the size gates in at least one map."""
    unclustered_points: jax.Array
    """() int32: obstacle points of no such cluster (too few, too long, or beyond a capacity)."""
    obstacles: jax.Array
    """() int32: points above the ground, which clustering.max_obstacles must hold."""
    slab_points: jax.Array
    """() int32: points of clusters that boxes are fitted to, in the map with most of them, which
    box.max_slab_points must hold."""
    cells: jax.Array
    """(maps,) int32: runs of occupied cells of each component map, which its max_cells must hold."""
    clusters: jax.Array
    """(maps,) int32: clusters of each map that pass the size gates."""
    large_clusters: jax.Array
    """() int32: clusters of all maps that are tried as a van and a truck too, which vehicles.max_large
    must hold."""
    assignments: jax.Array
    """() int32: sides of the clusters' rectangles that may be the length of a class, which
    completion.max_assignments must hold; 0 where no evidence weighs them."""
    candidates: jax.Array
    """() int32: boxes whose score by rays and size passes vehicles.min_score, before a look at what
    surrounds them, which vehicles.max_candidates must hold."""
    detections: jax.Array
    """() int32: boxes after suppression."""
    hull_vertices: jax.Array
    """() int32: vertices of the largest hull."""
    far_points: jax.Array
    """() int32: finite points farther than health.far_m, or outside the region."""
    scattered_azimuths: jax.Array
    """() int32: azimuth cells of the evidence in which a return from the nearest 16 range cells (4 m) was
    passed by another beam; 0 without evidence."""
    near_ground_points: jax.Array
    """() int32: points 3 to 12 m away that lie within 0.3 m of the ground; 0 without the ground grid."""
    rough_points: jax.Array
    """() int32: those of them that lie more than 0.05 m off it."""
    points_under: jax.Array
    """() int32: points on the ground that are nearer, in the plane, than 0.6 of the sensor's height."""
    points_below: jax.Array
    """() int32: points 0.3 m or more below the ground, which count to `ground_points` too; 0 without the
    ground grid."""

    @property
    def num_points(self) -> int:
        """Points of the source sweep: the sum of the nine places a point can be in."""
        fields = dataclasses.fields(self)[:NUM_POINT_COUNTS]
        return sum(int(getattr(self, field.name)) for field in fields)

    def overflows(self, config: DetectorConfig, num_rows: int) -> dict[Status, jax.Array]:
        """Which capacities were too small; works on traced counts too.

        Args:
          config: the configuration that counted.
          num_rows: N, capacity of the cloud.

        Returns:
          () bool for each bit of a capacity of the configuration: whether it is to be set.
        """
        return {
            bit: functools.reduce(jnp.logical_or, [row.is_exceeded(self, config, num_rows) for row in rows])
            for bit, rows in _OVERFLOW_ROWS.items()
        }


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Detections(BoxRows[Detection]):
    """Vehicle boxes of one sweep, best score first, and the evidence for them.

    Arrays of K rows, of which those of ``valid`` count, as a compiled function needs them. On the host it is
    also a sequence of `Detection`: ``len(detections)``, ``detections[0]``, ``for box in detections``. Each
    choice of boxes (``detections[1:]``, a mask, `above`, `of`, `within`) gives detections of those alone, in
    NumPy arrays without padding; what is said of the whole sweep stays.
    """

    center: jax.Array
    """(K, 3) float32, m, sensor frame: centre of the box."""
    size: jax.Array
    """(K, 3) float32, m: length >= width, height."""
    yaw: jax.Array
    """(K,) float32, rad, in [-pi/2, pi/2): length axis from +x about +z."""
    heading: jax.Array
    """(K,) float32, rad, in [-pi, pi]: where the front points; ``yaw`` or half a turn further."""
    front_probability: jax.Array
    """(K,) float32, in [.5, 1]: P(front), that the front is at ``heading`` and not opposite; .5 where the
    points do not tell."""
    score: jax.Array
    """(K,) float32, in [0, 1]."""
    label: jax.Array
    """(K,) int32: a `Label`."""
    valid: jax.Array
    """(K,) bool: True for a box, False for padding."""
    num_points: jax.Array
    """(K,) int32: points of the box's cluster inside the box that no better box owns; it can be 0."""
    hulls: Hulls
    """Hull of those points."""
    descriptors: Descriptors
    """Descriptors of those points."""
    ground: GroundPlane
    """The ground plane."""
    ground_mask: jax.Array
    """(N,) bool: points lower than ground.min_height_m above the ground."""
    point_component: jax.Array
    """(N,) int32: connected component of each point in the first map, -1 where it has none."""
    point_detection: jax.Array
    """(N,) int32: row of the box that the point belongs to, -1 where there is none."""
    first_return_m: jax.Array
    """(A,) float32, m: range of the first return at a vehicle's height in each azimuth cell, from -pi on, in
    steps of ``evidence.range_cell_m``; the end of the polar grid where there is none, or no evidence."""
    status: jax.Array
    """() int32: `Status` bits."""
    counts: Counts
    """Where every point went."""

    _of_sweep: ClassVar[frozenset[str]] = frozenset(
        ("ground", "ground_mask", "point_component", "point_detection", "first_return_m", "status", "counts")
    )
    """Fields that have no row for each box."""

    def on_host(self) -> "Detections":
        """The same in NumPy arrays, once they are computed.

        On a CPU they are read-only views of JAX's own memory, where `jax.device_get` copies, and takes a
        millisecond; from an accelerator all arrays come together.

        Returns:
          The detections, of one sweep or of a batch.
        """
        return to_host(self, self.status)

    def _box_at(self, row: int) -> Detection:
        """The box of a row, which is valid, of a sweep on the host."""
        hull = np.asarray(self.hulls.vertices[row])
        return Detection(
            **self._fields_of_box(row),
            num_points=int(self.num_points[row]),
            hull=hull[: min(int(self.hulls.num_vertices[row]), len(hull))],
            point_detection=np.asarray(self.point_detection),
            row=row,
        )

    def _title(self) -> str:
        """What there is, in a line, of a sweep on the host."""
        words = classes_in_words(np.asarray(self.label)[self.valid]) or "no box"
        return f"{words}; {self.counts.num_points} points; {Status(int(self.status)).name}"

    def _with_rows(self, rows: np.ndarray) -> "Detections":
        """Some rows (k,) int of a sweep on the host; points of other boxes belong to none."""
        # The last place is that of -1, for points of no box.
        places = np.full(len(self.valid) + 1, -1, np.int32)
        places[rows] = np.arange(len(rows))
        chosen = super()._with_rows(rows)
        return dataclasses.replace(chosen, point_detection=places[self.point_detection])

    def to_columns(self) -> dict[str, np.ndarray]:
        """Columns as `jaxbox.io.parquet` has them, with ``num_points``."""
        return super().to_columns() | {"num_points": np.asarray(self[:].num_points)}

    def to_kitti(self, calibration: "Calibration", *, min_visible_fraction: float | None = None) -> list[Any]:
        """The boxes that a camera sees as KITTI's objects, see `jaxbox.io.objects_from_detections`."""
        options = {} if min_visible_fraction is None else {"min_visible_fraction": min_visible_fraction}
        return later_module("io.kitti").objects_from_detections(self[:], calibration, **options)

    def draw(self, xyz: np.ndarray | None = None, *, frame: Any = None, title: str = "") -> np.ndarray:
        """Draws the boxes from above, see `jaxbox.viz.draw_detections`."""
        return later_module("viz.answer").draw_detections(self, xyz, frame=frame, title=title)

    def raise_if_failed(self) -> None:
        """Raises where anything was dropped for want of capacity, naming the field to enlarge.

        It takes the answer of one sweep: of a batch, take one from `unstack` first.

        Raises:
          RuntimeError: one line a failure, with the configuration field and the size needed.
        """
        status = Status(int(self.status))
        sizes = {Status.POINT_OVERFLOW: [f"{CLOUD_CAPACITY} must be at least {self.counts.num_points}"]}
        sizes |= {bit: [_size_text(row, self.counts) for row in rows] for bit, rows in _OVERFLOW_ROWS.items()}
        failures = [f"{bit.name}: {' and '.join(texts)}." for bit, texts in sizes.items() if bit in status]
        if failures:
            raise RuntimeError("\n".join(failures))


def _size_text(row: Capacity, counts: Counts) -> str:
    """How large a capacity must be, in words."""
    needed = ", ".join(str(int(n)) for n in np.atleast_1d(getattr(counts, row.count)))
    return f"{row.field} must be at least {needed}{' (one number a map)' if row.is_per_map else ''}"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Calibration(ByValue):
    """A camera and where it stands relative to the LiDAR (paper, 3.6, equations 1-5)."""

    P_rect: jax.Array
    """(3, 4) float32: projection P = K [R | t] from the rectified camera frame to pixels."""
    T_rect_velo: jax.Array
    """(4, 4) float32: rigid transform from the LiDAR frame to the rectified camera frame."""
    image_size_px: jax.Array
    """(2,) int32: width and height of the image."""
