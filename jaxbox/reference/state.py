"""What flows between the stages of the reference: one sweep, cluster and box at a time."""

import dataclasses

import numpy as np
from scipy.spatial import KDTree

from jaxbox.types import Label

NO_CLUSTER = -1
"""Component, cluster or detection of a point that has none."""


@dataclasses.dataclass(frozen=True)
class Sweep:
    """The n points of a sweep: which are finite, in the region, and no outliers."""

    xyz: np.ndarray
    """(n, 3) m, sensor frame."""
    finite: np.ndarray
    """(n,) bool."""
    in_region: np.ndarray
    """(n,) bool: and in the region."""
    inlier: np.ndarray
    """(n,) bool: and no outlier."""


@dataclasses.dataclass(frozen=True)
class Ground:
    """The ground, and every point's height above it."""

    planes: np.ndarray
    """(planes, 3): a, b and c of each plane, that with the most support first."""
    found: bool
    """Whether the first has enough support."""
    num_inliers: int
    """Candidates within the tolerance of the first."""
    surface: np.ndarray | None
    """(X, Y) m: height of the ground grid over the planes; None without a grid."""
    height: np.ndarray
    """(n,) m above the ground; NaN for points that are not in the region or are outliers."""


@dataclasses.dataclass(frozen=True)
class Obstacles:
    """The m points above the ground that are looked at, in sweep order."""

    row: np.ndarray
    """(m,) int: their rows in the sweep."""
    xyz: np.ndarray
    """(m, 3) m, sensor frame."""
    height: np.ndarray
    """(m,) m above the ground."""
    count: int
    """Points above the ground, more than m where not all are looked at."""
    tree: KDTree | None
    """Of their x and y; None without obstacles."""


@dataclasses.dataclass(frozen=True)
class Cluster:
    """A component that passes the size gates."""

    members: np.ndarray
    """(k,) int: rows of its points among the obstacles."""
    bottom_m: float
    """Height of its lowest member above the ground."""
    top_m: float
    """Height of its highest member above the ground."""


@dataclasses.dataclass(frozen=True)
class Clusters:
    """The clusters of one component map."""

    component: np.ndarray
    """(m,) int: component of each obstacle, `NO_CLUSTER` where it does not count on the map."""
    of_point: np.ndarray
    """(m,) int: cluster of each obstacle, `NO_CLUSTER` where it has none."""
    clusters: list[Cluster]
    """In the order of their components."""
    num_runs: int
    """Runs of occupied cells."""
    num_found: int
    """Components that pass the gates, which may be more than the map has room for."""


@dataclasses.dataclass(frozen=True)
class Rotations:
    """The rectangles round a cluster at all rotations."""

    curve: np.ndarray
    """(A,): the criterion, larger is better."""
    extents: np.ndarray
    """(A, 4) m: smallest and largest u, smallest and largest v, see `try_rotations`."""
    num_points: int
    """How many points they were fitted to."""
    principal: int
    """The rotation along the principal axes of the points, see `principal_rotations`."""

    @property
    def short_m(self) -> np.ndarray:
        """(A,) m: the shorter side at each rotation."""
        u0, u1, v0, v1 = self.extents.T
        return np.minimum(u1 - u0, v1 - v0)


@dataclasses.dataclass(frozen=True)
class Rectangle:
    """A cluster's rectangle at one rotation."""

    extents: np.ndarray
    """(4,) m: smallest and largest u, smallest and largest v."""
    angle: float
    """rad, of the u axis."""
    score: float
    """The criterion at this angle, and the preference for it."""

    @property
    def sides_m(self) -> np.ndarray:
        """(2,) m, along u and along v."""
        return self.extents[1::2] - self.extents[::2]


@dataclasses.dataclass(frozen=True)
class Evidence:
    """Hits and free space on a polar grid."""

    hit_sums: np.ndarray
    """(azimuths, ranges + 1) int: returns between the hit heights in all range cells before."""
    raised_hit_sums: np.ndarray
    """Likewise, returns that are hits of vehicles with a raised body."""
    free_sums: np.ndarray
    """(azimuths, ranges + 1) int: free range cells before."""
    steepest: float
    """Rise of the highest beam, m/m."""
    range_cell_m: float
    """Length of a range cell."""


@dataclasses.dataclass(frozen=True)
class RayFractions:
    """How the rays over each of B boxes ended; the first four sum to 1, or to 0 without rays."""

    hit: np.ndarray
    """(B,): end at the faces towards the sensor."""
    free: np.ndarray
    """(B,): pass through."""
    deep: np.ndarray
    """(B,): end inside, behind the faces."""
    occluded: np.ndarray
    """(B,): tell nothing."""
    free_length: np.ndarray
    """(B,): length seen to be free over length within the box, all rays together."""
    open: np.ndarray
    """(B,): see free space within, whether they hit before or not."""


@dataclasses.dataclass(frozen=True)
class Assignment:
    """A rectangle with one of its sides taken as the length."""

    along: tuple[float, float]
    """m: where the length begins and ends, along the box and from the sensor."""
    across: tuple[float, float]
    """m: the same of the width, across the box."""
    yaw: float
    """rad, not wrapped."""

    @property
    def measured(self) -> tuple[float, float]:
        """m: length and width."""
        return self.along[1] - self.along[0], self.across[1] - self.across[0]


@dataclasses.dataclass(frozen=True)
class CompletedBox:
    """A rectangle in the bird's-eye view, its hidden sides completed."""

    box: np.ndarray
    """(5,): x, y, length, width in m and yaw in rad, not wrapped."""
    objective: float
    """J, how well the box explains the evidence; infinite where there is none."""
    measured_length_m: float
    """Extent of the fitted points along the box."""
    measured_width_m: float
    """Extent of the fitted points across the box."""
    in_row: bool = False
    """Whether it stands side by side with others, which hide its sides."""

    @property
    def longest_m(self) -> float:
        """The longer of the two measured extents."""
        return max(self.measured_length_m, self.measured_width_m)


@dataclasses.dataclass(frozen=True)
class ClassHypothesis:
    """A cluster as a vehicle of one class."""

    cluster: int
    """Its place among the clusters of all maps."""
    label: Label
    """The class."""


@dataclasses.dataclass(frozen=True)
class Completed:
    """The completed boxes of the hypotheses whose cluster is not too large for its class."""

    hypotheses: list[ClassHypothesis]
    """Those hypotheses."""
    boxes: list[CompletedBox]
    """One each."""
    num_assignments: int
    """Length-axis assignments that the evidence had to weigh, of all hypotheses."""


@dataclasses.dataclass(frozen=True)
class NeighbourhoodCounts:
    """Points of the whole sweep in and round a box."""

    num_inside: float
    """Points of the vehicle's heights within the box and its margin."""
    top: float
    """m above the ground: as high as all but a few of them, see `top_of`; 0 without any."""
    num_above: float
    """Higher points within the box and its margin."""
    num_ring: float
    """Points of the vehicle's heights in the ring round the margin."""
    num_upper: float = 0
    """Points inside as high as glass, bonnet and roof."""
    num_recessed: float = 0
    """Those of them behind the faces that the sensor sees."""
    deepest: float = 0
    """m: how far behind the near end the farthest point of the vehicle's heights within the box and its
    margin lies, those behind hidden faces too."""


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A box that may be a vehicle."""

    hypothesis: ClassHypothesis
    """Its cluster and class."""
    completed: CompletedBox
    """The box."""
    around: NeighbourhoodCounts
    """Points in and round it."""
    top_unseen: bool
    """Whether its top is out of sight: above the highest beam, or above a bumper."""
    score: float
    """In [0, 1]."""


@dataclasses.dataclass(frozen=True)
class Kept:
    """The candidates that suppression leaves, best score first."""

    candidates: list[Candidate]
    """At most as many as the answer has room for."""
    num: int
    """How many it leaves."""


@dataclasses.dataclass(frozen=True)
class ShapeDescriptors:
    """Shape descriptors of one cluster's points in the bird's-eye view."""

    moment_of_inertia: np.ndarray
    """(2,) m^2: second central moments per point, larger first."""
    eccentricity: float
    """Length of the major over length of the minor axis, >= 1."""
    density: float
    """Points per m^2 of hull area; 0 where the hull has none."""
    complexity: float
    """Hull vertices / points (paper, equation 7); 0 without points."""
