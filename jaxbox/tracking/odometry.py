"""Poses where none are given: from the points, by kiss-icp, or from the detector's own boxes.

References: Vizzo et al., "KISS-ICP: In defense of point-to-point ICP", RA-L 8(2), 2023, whose library does
the registration; Arun, Huang, Blostein, "Least-squares fitting of two 3-D point sets", PAMI 9(5), 1987, and
Holland, Welsch, "Robust regression using iteratively reweighted least-squares", 1977, for the boxes.
"""

from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np

from jaxbox._extras import require
from jaxbox.geometry.rigid import inverse_rigid, partial_motion
from jaxbox.tracking.poses import Poses, PoseSource, check_pose, deskew
from jaxbox.types import Detections

VOXEL_M = 2.0
"""Side of a voxel of kiss-icp's map: a third of the time of its own 1 m, and within .1 % of the path."""
MAX_RANGE_M = 100.0
"""Points beyond this range are not registered."""
MIN_POINTS = 100
"""Sweeps with fewer points show too little of the scene to be registered."""

MIN_PAIRS = 3
"""Two boxes fix a motion in the plane; with a third there is something that can contradict it."""

_GATES_M = (1.5, 1.0, 0.6, 0.4, 0.3, 0.3, 0.3)
"""How far apart two boxes of a pair may be, round by round."""
_PAIR_STD_M = 0.15
"""Distance at which a pair weighs half: as much as the box of a standing object moves from sweep to sweep."""
_NEAR_M = 5.0
"""Boxes nearer than this weigh no more than at this distance; farther ones less,
because their positions vary more."""
_GUESS_PAIRS = 5.0
"""The guess weighs as much as this many pairs: vehicles keep their velocity from sweep to sweep to some
.03 m, and one pair is good for about .1 m."""
_GUESS_ARM_M = 10.0
"""Distance from the sensor of the points that stand for the guess, as of a usual box."""
_SHIFT_CELL_M = 0.5
_MAX_SHIFT_M = 6.0
"""Of a vehicle at 60 m/s and ten sweeps a second."""
_MIN_SHARE, _CLEARLY_MORE = 0.3, 1.5
"""Where a smaller share of the boxes finds a partner, the guess may be wrong; it is where another motion
finds this many times the pairs."""


class TimedSweep(Protocol):
    """What `kiss_icp_poses` asks of a sweep; `jaxbox.io.Sweep` has it."""

    @property
    def timestamp_ns(self) -> int | None:
        """When it was taken, ns; None where that is not known."""
        ...

    def read_timed_points(self) -> Any:
        """Reads ``xyz`` (n, 3) m, ``time_s`` (n,) s from the sweep's time or None, and ``is_compensated``."""
        ...


class KissIcp:
    """The sensor's pose sweep by sweep, by registration of the points to a map of those before.

    With one thread the same sweeps give the same poses.
    """

    def __init__(
        self, *, voxel_m: float = VOXEL_M, max_range_m: float = MAX_RANGE_M, num_threads: int = 1
    ) -> None:
        """Starts at the origin of the world.

        Args:
          voxel_m: side of a voxel of the map, m.
          max_range_m: points beyond this range are not registered, m.
          num_threads: of the registration; 0 for all cores.

        Raises:
          ImportError: without the extra ``track``.
        """
        self._library = require("kiss_icp.kiss_icp", extra="track", what="Poses from points")
        config = require("kiss_icp.config", extra="track", what="Poses from points").KISSConfig()
        # The library would deskew to the sweep's end; here poses are those of the sweep's own time.
        config.data.deskew = False
        config.data.max_range = max_range_m
        config.mapping.voxel_size = voxel_m
        config.registration.max_num_threads = num_threads
        self._odometry = self._library.KissICP(config)
        self._first: tuple[np.ndarray, np.ndarray] | None = None
        self._num_sweeps = 0
        self.is_lost = False
        """Whether the last sweep could not be registered, so that its motion is that of the one before."""

    def register(self, xyz: np.ndarray, time_s: np.ndarray | None = None) -> np.ndarray:
        """Takes the next sweep.

        The motion before serves as a first guess and, where the points carry times, to remove the sweep's
        distortion: it is taken to have lasted as long as the sweep.

        Args:
          xyz: (n, 3) real, m, sensor frame; points that are not finite are ignored.
          time_s: (n,) real, s from the sweep's time; None where the points have none, or are compensated.

        Returns:
          T_world_sensor: (4, 4) float64 at the sweep's time; the world is the first sweep's frame. Of fewer
          than `MIN_POINTS` points, and where the registration finds no pose, the motion before goes on, and
          `is_lost` is set.
        """
        pose = self._register(xyz, time_s)
        self._num_sweeps += 1
        if self._num_sweeps == 1 and time_s is not None:
            self._first = np.array(xyz), np.array(time_s)
        elif self._first is not None:
            first, self._first = self._first, None
            if not self.is_lost:
                pose = self._restart(first, xyz, time_s)
        return pose

    def _restart(
        self, first: tuple[np.ndarray, np.ndarray], xyz: np.ndarray, time_s: np.ndarray | None
    ) -> np.ndarray:
        """Registers the first two sweeps again once the motion between them is known.

        The map would keep the distortion of the first one, to which no later sweep fits.
        """
        motion = self._odometry.last_delta
        self._odometry = self._library.KissICP(self._odometry.config)
        # So that the first sweep's time is the origin of the world.
        middle = partial_motion(motion, _middle_share(first[1]))
        self._odometry.last_pose, self._odometry.last_delta = middle @ inverse_rigid(motion), motion
        self._register(*first)
        return self._register(xyz, time_s)

    def _register(self, xyz: np.ndarray, time_s: np.ndarray | None) -> np.ndarray:
        """The pose at the sweep's time.

        The library sees the sweep as from its middle. From its start, an error of the motion would shift the
        points by half of it, and the next motion by as much: it would grow from sweep to sweep.
        """
        odometry, share = self._odometry, 0.0
        if time_s is not None and np.isfinite(time_s).any():
            share = _middle_share(time_s)
            xyz = deskew(xyz, time_s - share * np.ptp(time_s[np.isfinite(time_s)]), odometry.last_delta)
        points = np.asarray(xyz, np.float64)
        points = points[np.isfinite(points).all(axis=1)]
        before, motion = odometry.last_pose, odometry.last_delta
        self.is_lost = len(points) < MIN_POINTS
        if not self.is_lost:
            odometry.register_frame(points, np.zeros(0))
            self.is_lost = check_pose(odometry.last_pose) is not None
            if self.is_lost:
                odometry.local_map.clear()
        if self.is_lost:
            odometry.last_pose, odometry.last_delta = before @ motion, motion
        return odometry.last_pose @ partial_motion(odometry.last_delta, -share)


def _middle_share(time_s: np.ndarray) -> float:
    """When the middle of a sweep is, from the sweep's time, as a share of its length; 0 without times."""
    known = time_s[np.isfinite(time_s)]
    span = float(np.ptp(known)) if known.size else 0.0
    return float(known.min() + span / 2) / span if span else 0.0


def kiss_icp_poses(sweeps: Iterable[TimedSweep], *, voxel_m: float = VOXEL_M, num_threads: int = 1) -> Poses:
    """Poses of the sweeps of one sequence, by registration of their points.

    Args:
      sweeps: in the order of time; read one after the other.
      voxel_m: as `KissIcp`.
      num_threads: as `KissIcp`.

    Returns:
      The poses; the world is the first sweep's frame.

    Raises:
      InputError: of a sweep that cannot be read.
      ImportError: without the extra ``track``.
    """
    odometry = KissIcp(voxel_m=voxel_m, num_threads=num_threads)
    poses, times_ns = [], []
    for sweep in sweeps:
        points = sweep.read_timed_points()
        time_s = None if points.is_compensated else points.time_s
        poses.append(odometry.register(points.xyz, time_s))
        times_ns.append(sweep.timestamp_ns)
    return _poses(poses, times_ns, PoseSource.KISS_ICP, f"kiss-icp with {voxel_m:g} m voxels")


def _poses(poses: list[np.ndarray], times_ns: list[int | None], source: PoseSource, origin: str) -> Poses:
    known = None if None in times_ns else np.array(times_ns, np.int64)
    return Poses(np.array(poses).reshape(-1, 4, 4), source, known, origin)


def ego_motion_from_boxes(
    previous: Detections, current: Detections, guess: np.ndarray
) -> tuple[np.ndarray, int]:
    """The sensor's motion in the plane between two sweeps, from the boxes of both.

    Boxes that are nearest to each other, once the motion found so far is undone, are pairs: clutter too, as
    poles and walls stand still. The motion is the least-squares rotation and translation of the pairs,
    weighted by their nearness and by how well they agree, in seven rounds with narrower and narrower gates;
    the guess weighs as much as five pairs. Where few boxes find a partner near the guess, as at the first
    sweep of a fast drive, the most frequent shift between boxes of the two sweeps takes its place.

    Args:
      previous: one sweep's detections on the host.
      current: those of the next.
      guess: (4, 4) float64, T_previous_current as expected, such as the motion before; the identity where
        nothing is known, and then it weighs nothing.

    Returns:
      T_previous_current: (4, 4) float64: a turn about z, and a shift along x and y; the guess where there are
      fewer than `MIN_PAIRS` pairs.
      num_pairs: boxes that agree within 0.3 m; 0 where the guess is the answer. Movers may be among the pairs
      where nearly everything moves, so a small number of pairs proves nothing.
    """
    a, b = _centers(previous), _centers(current)
    if min(len(a), len(b)) < MIN_PAIRS:
        return np.array(guess, np.float64), 0
    start = complex(guess[0, 3], guess[1, 3]), complex(guess[0, 0], guess[1, 0])
    is_known = start != (0, 1)
    motion, num_pairs = _fit_motion(a, b, start, _GUESS_PAIRS if is_known else 0.0)
    if num_pairs < max(MIN_PAIRS, _MIN_SHARE * min(len(a), len(b))):
        other, num_others = _fit_motion(a, b, (_frequent_shift(a, b * start[1]), start[1]), 0.0)
        if num_others > num_pairs * (_CLEARLY_MORE if is_known else 1.0):
            motion, num_pairs = other, num_others
    if num_pairs < MIN_PAIRS:
        return np.array(guess, np.float64), 0
    (shift, turn), T = motion, np.eye(4)
    T[:2, :2] = [[turn.real, -turn.imag], [turn.imag, turn.real]]
    T[:2, 3] = shift.real, shift.imag
    return T, num_pairs


def boxes_poses(sweeps: Iterable[Detections], *, times_ns: np.ndarray | None = None) -> Poses:
    """Poses of the sweeps of one sequence, from the detector's boxes alone.

    Args:
      sweeps: detections on the host, in the order of time.
      times_ns: (F,) int64, ns; None where they are not known.

    Returns:
      The poses; the world is the first sweep's frame. Where a sweep has too few boxes, the motion before goes
      on.
    """
    poses, motion, previous = [], np.eye(4), None
    for detections in sweeps:
        if previous is not None:
            motion, _ = ego_motion_from_boxes(previous, detections, motion)
        poses.append(poses[-1] @ motion if poses else np.eye(4))
        previous = detections
    stacked = np.array(poses).reshape(-1, 4, 4)
    return Poses(stacked, PoseSource.BOXES, times_ns, "the detector's own boxes")


_Motion = tuple[complex, complex]
"""In the plane of complex numbers: b is seen from a at shift + turn * b, where the turn has length 1."""


def _centers(detections: Detections) -> np.ndarray:
    """Centres of the boxes of a sweep in the plane, (n,) complex: x + iy."""
    x, y, _ = np.asarray(detections.center, np.float64)[np.asarray(detections.valid)].T
    return x + 1j * y


def _fit_motion(a: np.ndarray, b: np.ndarray, guess: _Motion, guess_pairs: float) -> tuple[_Motion, int]:
    """Robust alignment of b to a from a guess, and the number of pairs at the end."""
    motion, num_pairs = guess, 0
    nearness = 1.0 / np.maximum(np.abs(b), _NEAR_M)
    arms = _GUESS_ARM_M * np.array([1, -1, 1j, -1j])
    expected = guess[0] + guess[1] * arms
    for gate in _GATES_M:
        gap = np.abs(a[:, None] - (motion[0] + motion[1] * b)[None])
        partner, every = gap.argmin(axis=0), np.arange(len(b))
        paired = (gap[partner, every] < gate) & (gap.argmin(axis=1)[partner] == every)
        num_pairs = int(paired.sum())
        if num_pairs < MIN_PAIRS:
            return motion, 0
        partner = partner[paired]
        weight = nearness[paired] / (1.0 + (gap[partner, every[paired]] / _PAIR_STD_M) ** 2)
        weight = np.append(weight / weight.sum() * num_pairs, np.full(len(arms), guess_pairs / len(arms)))
        motion = _align(np.append(a[partner], expected), np.append(b[paired], arms), weight)
    return motion, num_pairs


def _align(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> _Motion:
    """Weighted Procrustes in the plane: the motion that brings b to a."""
    share = weight / weight.sum()
    middle_a, middle_b = share @ a, share @ b
    turn = share @ ((a - middle_a) * (b - middle_b).conj())
    # Boxes all in one place say nothing of a turn.
    turn = turn / abs(turn) if turn else 1.0 + 0.0j
    return complex(middle_a - turn * middle_b), complex(turn)


def _frequent_shift(a: np.ndarray, b: np.ndarray) -> complex:
    """The shift that most pairs of boxes agree on: a vote in cells, smoothed over their neighbours."""
    shifts = (a[:, None] - b[None]).ravel()
    edges = np.arange(-_MAX_SHIFT_M, _MAX_SHIFT_M + _SHIFT_CELL_M, _SHIFT_CELL_M)
    votes = np.pad(np.histogram2d(np.real(shifts), np.imag(shifts), bins=[edges, edges])[0], 1)
    # What is at the edge of a cell votes for both sides.
    smooth = votes[1:-1, 1:-1] + (votes[:-2, 1:-1] + votes[2:, 1:-1] + votes[1:-1, :-2] + votes[1:-1, 2:]) / 2
    x, y = np.unravel_index(smooth.argmax(), smooth.shape)
    return complex(edges[x] + _SHIFT_CELL_M / 2, edges[y] + _SHIFT_CELL_M / 2)
