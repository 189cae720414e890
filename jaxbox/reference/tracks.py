"""What the reference's tracker remembers and says: objects, one a vehicle."""

import dataclasses
import math

import numpy as np

MATURE_HITS = 3
"""From more detections on, velocity and extents are believed."""
MAX_GROWTH = 1.25
"""What was seen makes a box longer than the mean by this factor at most."""
MAX_MOMENTS = 51
"""Moments of a path that are remembered."""


@dataclasses.dataclass
class Interval:
    """From the last sweep to this one."""

    dt: float
    """s, positive."""
    rotation: np.ndarray
    """(3, 3), from the current sensor frame to the previous one."""
    translation: np.ndarray
    """(3,) m, the current sensor in the previous frame."""
    skipped: bool
    """The sweep is to be passed over."""
    restarts: bool
    """All tracks end."""
    status: frozenset[str] = frozenset()
    """Names of the bits of `jaxbox.tracking.TrackStatus`."""


@dataclasses.dataclass
class Moment:
    """Where a track was at a time."""

    position: np.ndarray
    """(2,) m, sensor frame of the last sweep."""
    velocity: np.ndarray
    """(2,) m/s."""
    moving: bool
    """Whether it moved."""


@dataclasses.dataclass
class Track:
    """A vehicle, in the sensor frame of the last sweep."""

    id: int
    """Never used again."""
    position: np.ndarray
    """(3,) m, centre of the box."""
    velocity: np.ndarray
    """(2,) m/s, over ground."""
    covariance: np.ndarray
    """(4, 4) of x, y, and their velocities."""
    yaw_vote: complex
    """Weighted sum of exp(2 i yaw)."""
    size_sums: np.ndarray
    """(4,) weighted sums of length, width and height (m), and of the weights."""
    extent: np.ndarray
    """(2,) m, quantile of the extents seen, along and across."""
    score_sum: float
    """Of its detections."""
    label_scores: np.ndarray
    """(L,) sum of the scores by class."""
    turn_rate: float = 0.0
    """rad/s."""
    front_vote: complex = 0j
    """Weighted sum of the directions x + i y in which it moved."""
    profile_vote: complex = 0j
    """Sum of the directions in which its detections saw a front, each times its log odds."""
    hits: int = 1
    """Sweeps in which it was detected."""
    age: int = 1
    """Sweeps since its first detection."""
    misses: int = 0
    """Sweeps since its last detection,"""
    hidden: int = 0
    """and those of them in which it was hidden."""
    hidden_now: bool = False
    """Whether the last sweep was one of those."""
    moving: bool = False
    """Whether it moves."""
    path: list[Moment] = dataclasses.field(default_factory=list)
    """Newest first."""

    @property
    def yaw(self) -> float:
        """Rad, what the votes agree on."""
        return math.atan2(self.yaw_vote.imag, self.yaw_vote.real) / 2

    @property
    def speed(self) -> float:
        """m/s."""
        return float(np.linalg.norm(self.velocity))

    def size(self) -> np.ndarray:
        """(3,) m, the weighted means of the detections, and never shorter than what was seen."""
        size = self.size_sums[:3] / self.size_sums[3]
        if self.hits > MATURE_HITS:
            size[:2] = np.maximum(size[:2], np.minimum(self.extent, MAX_GROWTH * size[:2]))
        return size


@dataclasses.dataclass
class Tracker:
    """All that is remembered between two sweeps."""

    slots: list[Track | None]
    """A vehicle or None each."""
    time_s: float = 0.0
    """Since the recording began,"""
    moment_times_s: list[float] = dataclasses.field(default_factory=lambda: [0.0])
    """and of the moments of all paths, newest first; the last is the beginning."""
    next_id: int = 0
    """Of the next track."""
    started: bool = False
    """Whether there was a sweep before."""

    def tracks(self) -> list[Track]:
        """The vehicles."""
        return [track for track in self.slots if track is not None]

    def numbered(self) -> list[tuple[int, Track]]:
        """The vehicles, each with its slot."""
        return [(slot, track) for slot, track in enumerate(self.slots) if track is not None]


@dataclasses.dataclass
class TrackedVehicle:
    """A vehicle of one sweep: as a row of `jaxbox.tracking.Tracks`, whose names the fields have."""

    id: int
    confirmed: bool
    age: int
    hits: int
    sight: str
    """Name of a `jaxbox.tracking.Sight`."""
    detection: int
    motion: int
    lateral_shift_m: float
    label: int
    label_probability: np.ndarray
    score: float
    center: np.ndarray
    size: np.ndarray
    yaw: float
    heading: float
    front_probability: float
    velocity: np.ndarray
    turn_rate: float
    covariance: np.ndarray
    filtered_center: np.ndarray
    filtered_size: np.ndarray
    filtered_yaw: float


@dataclasses.dataclass
class TrackedSweep:
    """What is said of one sweep."""

    vehicles: list[TrackedVehicle | None]
    """One a slot."""
    counts: dict[str, int]
    """Under the names of `jaxbox.tracking.TrackCounts`."""
    status: frozenset[str]
    """Names of the bits of `jaxbox.tracking.TrackStatus`."""


def rotation_about_z(angle: float) -> np.ndarray:
    """(3, 3) rotation matrix.

    Args:
      angle: rad, counter-clockwise.

    Returns:
      The matrix.
    """
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
