"""What flows between the stages: frozen pytrees whose arrays have fixed shapes.

Axis letters: N points of a sweep, O obstacle points, P clusters of all maps, A rotations, Q class hypotheses,
C candidates, K detections. Rows beyond the number that counts hold finite numbers.
"""

import dataclasses
from typing import Protocol

import jax
import jax.numpy as jnp

from jaxbox.types import GroundPlane
from jaxbox.xla.ragged import PointLists

NOT_A_BOX = -1e9
"""`Boxes.objective` where the cluster is too large for the class."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sweep:
    """The sweep's points: which are finite, in the region, and no outliers."""

    xyz1: jax.Array
    """(N, 4) float32, m and 1; 0 where not in the region."""
    num_points: jax.Array
    """() int32, of the source sweep, which may exceed N."""
    is_point: jax.Array
    """(N,) bool: no padding."""
    finite: jax.Array
    """(N,) bool: and finite."""
    in_region: jax.Array
    """(N,) bool: and in the region."""
    inlier: jax.Array
    """(N,) bool: and no outlier."""

    @property
    def xyz(self) -> jax.Array:
        """(N, 3) float32, m, 0 where not in the region."""
        return self.xyz1[:, :3]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Ground:
    """The ground, and every point's height above it."""

    plane: GroundPlane
    """The plane that carries the most support."""
    planes: jax.Array
    """(rounds, 3) float32: a, b and c of all planes."""
    surface: jax.Array | None
    """(G, G) float32, m: height of the ground grid over the plane; None where there is no grid."""
    height: jax.Array
    """(N,) float32, m, above the ground."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Health:
    """What tells whether a sweep can be trusted, see the same fields of `jaxbox.types.Counts`."""

    far_points: jax.Array
    """() int32."""
    scattered_azimuths: jax.Array
    """() int32."""
    near_ground_points: jax.Array
    """() int32."""
    rough_points: jax.Array
    """() int32."""
    points_under: jax.Array
    """() int32."""
    points_below: jax.Array
    """() int32."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Obstacles:
    """The points above the ground, compacted."""

    row: jax.Array
    """(O,) int32: row of the sweep, N beyond."""
    xy: jax.Array
    """(O, 2) float32, m."""
    z: jax.Array
    """(O,) float32, m, sensor frame."""
    height: jax.Array
    """(O,) float32, m, above the ground."""
    count: jax.Array
    """() int32: true number, which may exceed O."""
    num_rows: int = dataclasses.field(metadata={"static": True})
    """static, N."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Clusters:
    """The clusters of all maps in one list, those of the first map first."""

    component: jax.Array
    """(O,) int32: connected component of each point on the first map, -1 for none."""
    of_point: jax.Array
    """(maps, O) int32: row of each point's cluster in the list, P for none."""
    fitted: jax.Array
    """(maps, O) bool: whether a rectangle is fitted to the point."""
    num: jax.Array
    """() int32: clusters in the list."""
    num_first: jax.Array
    """() int32: those of the first map."""
    num_points: jax.Array
    """(P,) int32."""
    low: jax.Array
    """(P, 3) float32, m: least x, y and height above the ground."""
    high: jax.Array
    """(P, 3) float32, m: greatest ones."""
    large: jax.Array
    """(L,) int32: clusters that are also tried as other classes than the first, P beyond."""
    num_large: jax.Array
    """() int32: true number of those."""
    num_runs: jax.Array
    """(maps,) int32: runs of occupied cells, true number."""
    num_found: jax.Array
    """(maps,) int32: clusters that pass the size gates, true number."""
    num_slab: jax.Array
    """() int32: points to fit to, on the map that has most of them."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Outlines:
    """The points that the rectangle of each cluster is fitted to."""

    points: PointLists
    """Of P clusters."""
    hull_vertices: jax.Array
    """() int32: vertices of the largest hull that was fitted to, true number; 0 where none was."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Rectangles:
    """Rectangles in a frame turned by `angle`: u along it, v a quarter turn further."""

    rows: jax.Array
    """(..., 6) float32: `low`, `high`, `angle` and `score`, which are looked up together."""

    @property
    def low(self) -> jax.Array:
        """(..., 2) m: lower bounds of u and v, from the sensor."""
        return self.rows[..., :2]

    @property
    def high(self) -> jax.Array:
        """(..., 2) m: upper bounds of u and v."""
        return self.rows[..., 2:4]

    @property
    def angle(self) -> jax.Array:
        """(...) rad, in [0, pi/2)."""
        return self.rows[..., 4]

    @property
    def score(self) -> jax.Array:
        """(...) the criterion at this angle, and the preference for it."""
        return self.rows[..., 5]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Rotations:
    """The rectangles of all clusters at all rotations."""

    curve: jax.Array
    """(A, P) float32: the criterion, larger is better; the clusters with most points first."""
    extents: jax.Array
    """(4, A, P) float32, m: lower and upper bounds of u, then of v; likewise."""
    num_points: jax.Array
    """(P,) int32: how many points the rectangles were fitted to; likewise."""
    cluster: jax.Array
    """(P,) int32: which cluster they are of; likewise."""
    place: jax.Array
    """(P,) int32: where each cluster is in those."""
    principal: jax.Array
    """(P,) int32: the rotation along the principal axes of the points; likewise."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Evidence:
    """What the beams saw on a polar grid, 16 range cells a word; see `jaxbox.xla.range_bits`."""

    free: jax.Array
    """(B, A) uint32: which cells of a block are free, and how many before the block (`covered_words`)."""
    hit: jax.Array
    """(B, 2 A) uint32: which cells of a block have a return of vehicle height, and the first beyond the block
    that has one (`next_words`); then the same with higher returns, for vehicles with a raised body."""
    steepest: jax.Array
    """() float32: rise of the highest beam, m/m."""
    num_ranges: int = dataclasses.field(metadata={"static": True})
    """static, R: range cells of the grid, the last block's being more."""

    @property
    def low_hit(self) -> jax.Array:
        """(B, A) uint32: the first columns of `hit`, of returns of vehicle height."""
        return self.hit[:, : self.free.shape[1]]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RayFractions:
    """How the rays over a box ended, each in [0, 1]; the first four sum to 1, or to 0 without rays."""

    hit: jax.Array
    """(...) float32: a return at the entry."""
    free: jax.Array
    """(...) float32: no hit, but free space inside."""
    deep: jax.Array
    """(...) float32: neither, but a return farther inside."""
    occluded: jax.Array
    """(...) float32: nothing is known."""
    free_length: jax.Array
    """(...) float32: length of free space inside the box over the length of all rays inside."""
    open: jax.Array
    """(...) float32: free space inside, behind a hit (below a body, say) or not."""


class FlatBoxes(Protocol):
    """Oriented boxes in the bird's-eye view: centre (..., 2) m, and three arrays that broadcast to (...)."""

    @property
    def center(self) -> jax.Array:
        """(..., 2) float32, m."""
        ...

    @property
    def length(self) -> jax.Array:
        """Along the yaw axis, m."""
        ...

    @property
    def width(self) -> jax.Array:
        """Across it, m."""
        ...

    @property
    def yaw(self) -> jax.Array:
        """From +x about +z, rad, not wrapped."""
        ...


class CastRays(Protocol):
    """Asks the evidence what the rays over boxes met: `jaxbox.stages.evidence.cast_rays` of one sweep."""

    def __call__(self, boxes: FlatBoxes, *, num_rays: int, raised: jax.Array | bool = False) -> RayFractions:
        """As many rays as said over each box; whether bodies are raised broadcasts to them."""
        ...


class GroundElevation(Protocol):
    """Asks where the ground is: `jaxbox.stages.ground.ground_elevation` of one sweep."""

    def __call__(self, xyz: jax.Array) -> jax.Array:
        """(N,) m, z of the ground under points (N, 3) m."""
        ...


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Boxes:
    """Oriented boxes in the bird's-eye view, and what they were completed from."""

    center: jax.Array
    """(..., 2) float32, m."""
    length: jax.Array
    """(...) float32, m, along the yaw axis."""
    width: jax.Array
    """(...) float32, m."""
    yaw: jax.Array
    """(...) float32, rad, not wrapped."""
    measured: jax.Array
    """(..., 2) float32, m: length and width before completion."""
    objective: jax.Array
    """(...) float32: J, how well the box explains the evidence; NOT_A_BOX where no hypothesis fits."""
    in_row: jax.Array
    """(...) bool: whether it stands side by side with others, which hide its sides."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ClassHypotheses:
    """Each cluster as the first class, and the large ones as every other class too: Q hypotheses."""

    cluster: jax.Array
    """(Q,) int32: row of the cluster, P beyond."""
    label: jax.Array
    """(Q,) int32: its class."""
    num: jax.Array
    """() int32."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Completed:
    """The completed box of every class hypothesis."""

    hypotheses: ClassHypotheses
    """Q of them."""
    boxes: Boxes
    """(Q,) boxes."""
    num_assignments: jax.Array
    """() int32: length-axis assignments that the evidence had to weigh, true number."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class NeighbourhoodCounts:
    """Points in and round each box."""

    rows: jax.Array
    """(P, 7) float32: what follows, in that order."""

    @property
    def num_inside(self) -> jax.Array:
        """(P,) points of vehicle height inside, give or take the margin, and before the visible end."""
        return self.rows[:, 0]

    @property
    def top(self) -> jax.Array:
        """(P,) m above the ground: as high as all but a few of them; 0 where there are none."""
        return self.rows[:, 1]

    @property
    def num_above(self) -> jax.Array:
        """(P,) points higher than the vehicle, within the box."""
        return self.rows[:, 2]

    @property
    def num_ring(self) -> jax.Array:
        """(P,) points of vehicle height just outside, but for those behind the box, as far as they count."""
        return self.rows[:, 3]

    def with_ring(self, num_ring: jax.Array) -> "NeighbourhoodCounts":
        """The same, with other numbers (P,) of points just outside."""
        return NeighbourhoodCounts(self.rows.at[:, 3].set(num_ring))

    @property
    def num_upper(self) -> jax.Array:
        """(P,) those inside that are as high as glass, bonnet and roof."""
        return self.rows[:, 4]

    @property
    def num_recessed(self) -> jax.Array:
        """(P,) those of them that lie behind the faces which the sensor sees."""
        return self.rows[:, 5]

    @property
    def deepest(self) -> jax.Array:
        """(P,) m: how far behind the near end the farthest of all points of vehicle height inside lies, those
        behind hidden faces too."""
        return self.rows[:, 6]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Candidates:
    """The boxes that pass the gates, best score first: C rows."""

    rectangle: jax.Array
    """(C, 5) float32: x, y, length, width (m), yaw (rad)."""
    bottom: jax.Array
    """(C,) float32, m, sensor frame."""
    height: jax.Array
    """(C,) float32, m."""
    score: jax.Array
    """(C,) float32."""
    label: jax.Array
    """(C,) int32."""
    cluster: jax.Array
    """(C,) int32."""
    valid: jax.Array
    """(C,) bool."""
    num: jax.Array
    """() int32: true number, before a look at what surrounds them."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Kept:
    """The candidates that non-maximum suppression leaves, best score first: K rows, 0 where there is none."""

    center: jax.Array
    """(K, 3) float32, m, sensor frame."""
    size: jax.Array
    """(K, 3) float32, m: length, width, height."""
    yaw: jax.Array
    """(K,) float32, rad, in [-pi/2, pi/2)."""
    score: jax.Array
    """(K,) float32."""
    label: jax.Array
    """(K,) int32."""
    cluster: jax.Array
    """(K,) int32."""
    frame: jax.Array
    """(K, 6) float32: centre, direction and half the size, m, that a point of the box lies within."""
    valid: jax.Array
    """(K,) bool."""
    num: jax.Array
    """() int32: true number."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Owners:
    """The points of clusters that have a detection, and the detection that each belongs to."""

    row: jax.Array
    """(O,) int32 of the obstacle, O beyond."""
    owner: jax.Array
    """(O,) int32: the best of the point's clusters' boxes that hold it, K for none."""
    num: jax.Array
    """() int32; how many rows count, from the first on."""


def longest_side(rectangles: Rectangles) -> jax.Array:
    """(P,) float32, m, of rectangles (P,)."""
    return jnp.max(rectangles.high - rectangles.low, axis=1)
