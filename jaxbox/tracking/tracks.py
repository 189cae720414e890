"""What a tracker says of one sweep: its vehicles, what was dropped, and what was wrong with time or pose.

Axis letters: T slots, D detections, L classes. A slot without a vehicle has ``id`` -1 and finite numbers.
"""

import dataclasses
import enum
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox._box import Box
from jaxbox._box_rows import BoxRows, later_module
from jaxbox.config.class_priors import classes_in_words
from jaxbox.types import Calibration, Motion
from jaxbox.xla.transfer import to_host

FREE = -1
"""`Tracks.id` of a slot without a vehicle, and `Tracks.detection` of a vehicle that was not detected."""


class Sight(enum.IntEnum):
    """Whether a track was detected in this sweep, and if not, why."""

    SEEN = 0
    HIDDEN = 1
    COASTING = 2


class TrackStatus(enum.IntFlag):
    """What happened to the tracks in a sweep. Zero is a clean step; each bit is explained by `describe`."""

    OK = 0
    TRACK_OVERFLOW = 1
    TIME_NOT_LATER = 2
    TIME_GAP = 4
    POSE_INVALID = 8
    POSE_JUMP = 16
    INVALID_DETECTIONS = 32
    POSE_FROM_BOXES = 64
    POSE_UNKNOWN = 128

    def describe(self) -> list[str]:
        """Returns one sentence a set bit: what happened and what to do about it.

        >>> TrackStatus.POSE_UNKNOWN.describe()[0].partition(":")[0]
        'POSE_UNKNOWN'
        """
        return [f"{bit.name}: {_STATUS_TEXT[bit]}" for bit in TrackStatus if bit and bit in self]


_STATUS_TEXT = {
    TrackStatus.TRACK_OVERFLOW: "more vehicles than slots; those with the lowest scores began no track. "
    "Ask for more: jaxbox.track(max_tracks=...), on the command line --max-tracks.",
    TrackStatus.TIME_NOT_LATER: "the sweep is not later than the one before, or has no time; it was passed "
    "over and the tracks are as they were. Sort the sweeps by time and drop doubled ones.",
    TrackStatus.TIME_GAP: "more than TrackConfig.max_gap_s passed since the sweep before; all tracks ended, "
    "and new ones began.",
    TrackStatus.POSE_INVALID: "the pose is not finite or not a rigid transform; the ego vehicle was taken to "
    "stand, or by jaxbox.track to go on as it did. Check the source of the poses.",
    TrackStatus.POSE_JUMP: "the pose moved faster than TrackConfig.max_ego_speed_mps; all tracks ended, "
    "and new ones began. Check the source of the poses.",
    TrackStatus.INVALID_DETECTIONS: "detections with numbers that are NaN, infinite or beyond a million were "
    "ignored.",
    TrackStatus.POSE_FROM_BOXES: "no poses were given, so they were estimated from the boxes, to some "
    "centimetres a sweep; velocities are as good as that.",
    TrackStatus.POSE_UNKNOWN: "no poses were given or found, so the ego vehicle was taken to stand: "
    "velocities are relative to it, and what stands seems to move.",
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrackCounts:
    """True counts of one sweep. Every valid detection is in exactly one of the first six, or in none where
    the sweep was passed over (`TrackStatus.TIME_NOT_LATER`)."""

    matched: jax.Array
    """() int32: detections that belong to a track of the sweep before."""
    births: jax.Array
    """() int32: detections that began a track."""
    dropped_births: jax.Array
    """() int32: detections that would have begun a track, but no slot was free."""
    inside_tracks: jax.Array
    """() int32: detections without a track whose centre lies in a track's box: no new vehicle."""
    low_scores: jax.Array
    """() int32: detections without a track whose score is too low to begin one."""
    invalid: jax.Array
    """() int32: detections with numbers that are NaN, infinite or beyond a million."""
    deaths: jax.Array
    """() int32: tracks that ended."""
    tracks: jax.Array
    """() int32: tracks that live after the sweep."""

    @property
    def detections(self) -> jax.Array:
        """() int32: all valid detections of the sweep."""
        return (
            self.matched
            + self.births
            + self.dropped_births
            + self.inside_tracks
            + self.low_scores
            + self.invalid
        )


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Track(Box):
    """One vehicle of a tracker after a sweep, as iterating over `Tracks` gives it."""

    id: int
    """The same for a vehicle in all sweeps."""
    confirmed: bool
    """Whether it was detected often enough to be shown."""
    age: int
    """Sweeps since its first detection, which counts as 1."""
    hits: int
    """Sweeps in which it was detected."""
    sight: Sight
    """Whether it was detected in this sweep, and if not, why."""
    detection: int
    """Row of its detection in this sweep, -1 where it has none."""
    motion: Motion
    """What it does."""
    velocity: np.ndarray
    """(2,) float32, m/s, over ground, along the axes of this sweep's sensor frame."""
    turn_rate: float
    """Rad/s, about +z."""

    @property
    def speed(self) -> float:
        """m/s, over ground."""
        return math.hypot(*self.velocity)

    def __str__(self) -> str:
        """One line: the number, the box, the speed and what it does."""
        unseen = "" if self.sight is Sight.SEEN else f" ({self.sight.name.lower()})"
        return f"{self.id:4}  {super().__str__()}  {self.speed:4.1f} m/s  {self.motion.word}{unseen}"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Tracks(BoxRows[Track]):
    """The vehicles that a tracker knows after one sweep, one a slot.

    Arrays of T slots, of which those of ``valid`` count, as a compiled function needs them. On the host it is
    also a sequence of `Track` in the order of the slots, with the choices and tables of `jaxbox.Detections`:
    ``tracks[tracks.confirmed]``, ``tracks.of("car")``, ``tracks.to_pandas()``.
    """

    id: jax.Array
    """(T,) int32: the same for a vehicle in all sweeps, and never used again; -1 for a free slot."""
    valid: jax.Array
    """(T,) bool: whether the slot holds a vehicle."""
    confirmed: jax.Array
    """(T,) bool: whether it was detected often enough to be shown."""
    age: jax.Array
    """(T,) int32: sweeps since its first detection, which counts as 1."""
    hits: jax.Array
    """(T,) int32: sweeps in which it was detected."""
    sight: jax.Array
    """(T,) int32: a `Sight`."""
    detection: jax.Array
    """(T,) int32: row of its detection in this sweep, -1 where it has none."""
    motion: jax.Array
    """(T,) int32: a `jaxbox.Motion`."""
    lateral_shift_m: jax.Array
    """(T,) float32, m: how far it shifted to the side over the last 5 s, to its left; 0 where it does not
    change lanes."""
    label: jax.Array
    """(T,) int32: the most probable `jaxbox.Label`."""
    label_probability: jax.Array
    """(T, L) float32, in [0, 1]: shares of the classes in the scores of its detections."""
    score: jax.Array
    """(T,) float32, in [0, 1]: sum of the scores of its n detections over n + .5: what is seen once has two
    thirds of it. A detection that lies a distance d from where the track was expected, after three, counts
    exp(-(d / 1.2 m)^2) of its score. Where this sweep has none, less the less its place is known
    (`TrackConfig.unseen_sd_m`)."""
    center: jax.Array
    """(T, 3) float32, m, sensor frame of this sweep: where the track has a detection, of the detection's box;
    from the fourth on, of one between that and the track's own, nearer to the track the less the detection
    scores. Else where the track is expected. After the second pass: of the track, where it moves."""
    size: jax.Array
    """(T, 3) float32, m: length, width, height, likewise; the box of a detection has the length that the
    track's detections agree on, with the faces that this sweep saw where it saw them."""
    yaw: jax.Array
    """(T,) float32, rad, in [-pi/2, pi/2): length axis from +x about +z; of a track of some detections, the
    one that they agree on."""
    heading: jax.Array
    """(T,) float32, rad, in [-pi, pi): where the front points; ``yaw`` or half a turn further."""
    front_probability: jax.Array
    """(T,) float32, in [.5, 1]: P(front), that the front is at ``heading`` and not opposite, by its
    motion and by the profiles of its detections; .5 where neither says anything."""
    velocity: jax.Array
    """(T, 2) float32, m/s, over ground, along the axes of this sweep's sensor frame."""
    turn_rate: jax.Array
    """(T,) float32, rad/s, about +z."""
    covariance: jax.Array
    """(T, 3) float32: variance of position (m^2), covariance of position and velocity (m^2/s), variance of
    velocity (m^2/s^2), of either axis."""
    filtered_center: jax.Array
    """(T, 3) float32, m: of the track's own box, which the detections agree on."""
    filtered_size: jax.Array
    """(T, 3) float32, m."""
    filtered_yaw: jax.Array
    """(T,) float32, rad, in [-pi/2, pi/2)."""
    counts: TrackCounts
    """Where every detection went."""
    status: jax.Array
    """() int32: `TrackStatus` bits."""

    _of_sweep: ClassVar[frozenset[str]] = frozenset(("counts", "status"))
    """Fields that have no row for each track."""

    @property
    def speed(self) -> jax.Array:
        """(T,) float32, m/s, over ground."""
        return jnp.linalg.norm(self.velocity, axis=-1)

    def on_host(self) -> "Tracks":
        """The same in NumPy arrays, once they are computed."""
        return to_host(self, self.status)

    def _box_at(self, row: int) -> Track:
        """The track of a slot, which is valid, of a sweep on the host."""
        return Track(
            **self._fields_of_box(row),
            id=int(self.id[row]),
            confirmed=bool(self.confirmed[row]),
            age=int(self.age[row]),
            hits=int(self.hits[row]),
            sight=Sight(self.sight[row]),
            detection=int(self.detection[row]),
            motion=Motion(self.motion[row]),
            velocity=np.asarray(self.velocity[row]),
            turn_rate=float(self.turn_rate[row]),
        )

    def _title(self) -> str:
        """What there is, in a line, of a sweep on the host."""
        words = classes_in_words(np.asarray(self.label)[self.valid]) or "no track"
        num_confirmed = np.count_nonzero(self.valid & self.confirmed)
        return f"{words}, {num_confirmed} confirmed; {TrackStatus(int(self.status)).name}"

    def to_columns(self) -> dict[str, np.ndarray]:
        """Columns as `jaxbox.io.parquet` has them: ``id`` first, then those of boxes, state and velocity."""
        tracks = self[:]
        return {
            "id": np.asarray(tracks.id),
            **super().to_columns(),
            "state": np.array([Motion(motion).word for motion in tracks.motion.tolist()], str),
            "sight": np.array([Sight(sight).name.lower() for sight in tracks.sight.tolist()], str),
            "confirmed": np.asarray(tracks.confirmed),
            "age": np.asarray(tracks.age),
            "hits": np.asarray(tracks.hits),
            **dict(zip(("velocity_x", "velocity_y"), np.asarray(tracks.velocity).T, strict=True)),
            "speed": np.asarray(tracks.speed),
            "turn_rate": np.asarray(tracks.turn_rate),
            "lateral_shift_m": np.asarray(tracks.lateral_shift_m),
        }

    def to_kitti(
        self, calibration: Calibration, *, frame: int, min_visible_fraction: float | None = None
    ) -> list[Any]:
        """The tracks that a camera sees as KITTI's objects of a frame, see `jaxbox.io.write_tracks`."""
        tracks, kitti = self[:], later_module("io.kitti_tracking")
        options = {} if min_visible_fraction is None else {"min_visible_fraction": min_visible_fraction}
        return kitti.objects_from_tracks(
            np.column_stack([tracks.center, tracks.size, tracks.heading]),
            np.asarray(tracks.score),
            np.asarray(tracks.id),
            calibration,
            frame=frame,
            types=[track.label.word.capitalize() for track in tracks],
            **options,
        )

    def draw(self, xyz: np.ndarray | None = None, *, frame: Any = None, title: str = "") -> np.ndarray:
        """Draws the tracks from above, see `jaxbox.viz.draw_tracks`."""
        points = np.zeros((0, 3)) if xyz is None else np.asarray(xyz)[:, :3]
        return later_module("viz.tracks").draw_tracks(
            points, self[:], frame=frame, title=title, confirmed=False
        )
