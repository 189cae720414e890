"""How a vehicle moves, in closed form: position, course, velocity and motion state at any time."""

import dataclasses
import math

import numpy as np

from jaxbox.types import Motion

MOVING_ABOVE, STANDING_BELOW = 1.0, 0.5
"""m/s: a standing vehicle moves from the first speed on, a moving one stands from the second on."""
START_STOP_ACCELERATION = 0.8
"""m/s^2: what speeds up or brakes by less neither starts nor stops."""
STARTING_BELOW, STARTING_WINDOW_S = 3.0, 1.0
"""m/s and s: a starting vehicle was slower than this speed, this long ago."""
STOPPING_BELOW = 4.0
"""m/s: a stopping vehicle is slower."""
TURNING_RATE, TURNING_ABOVE = math.radians(10.0), 1.5
"""rad/s and m/s: a turning vehicle turns faster than the one and drives faster than the other."""
LANE_CHANGE_SHIFT_M, LANE_CHANGE_WINDOW_S = 2.0, 5.0
"""A lane change leads farther sideways than the one within the other."""


@dataclasses.dataclass(frozen=True)
class SpeedProfile:
    """Speed that is linear in time between knots, and constant before the first and after the last.

    >>> braking = SpeedProfile((0.0, 4.0), (8.0, 0.0))
    >>> float(braking.speed(2.0)), float(braking.distance(10.0))
    (4.0, 16.0)
    """

    times_s: tuple[float, ...]
    """J increasing times, s."""
    speeds: tuple[float, ...]
    """J speeds, m/s, none negative."""

    def __post_init__(self) -> None:
        """Checks the knots.

        Raises:
          ValueError: where times do not increase, a speed is negative, or their numbers differ.
        """
        if len(self.times_s) != len(self.speeds) or not self.times_s:
            raise ValueError(
                f"there are {len(self.times_s)} times and {len(self.speeds)} speeds; give one speed a time."
            )
        if (np.diff(self.times_s) <= 0).any() or min(self.speeds) < 0:
            raise ValueError(
                f"times {self.times_s} must increase, and no speed of {self.speeds} be negative."
            )

    def speed(self, time_s: np.ndarray | float) -> np.ndarray:
        """(...) m/s at times (...)."""
        return np.asarray(np.interp(time_s, self.times_s, self.speeds))

    def acceleration(self, time_s: np.ndarray | float) -> np.ndarray:
        """(...) m/s^2 at times (...); at a knot, that of the piece that begins there."""
        return self._piece(time_s)[1]

    def distance(self, time_s: np.ndarray | float) -> np.ndarray:
        """(...) m travelled between the first knot and times (...); negative before it."""
        piece, rate = self._piece(time_s)
        times, speeds = np.array(self.times_s), np.array(self.speeds)
        before = np.append(0.0, np.cumsum(np.diff(times) * (speeds[1:] + speeds[:-1]) / 2))
        elapsed = time_s - times[piece]
        return before[piece] + speeds[piece] * elapsed + rate * elapsed**2 / 2

    def plus(self, times_s: tuple[float, ...], changes: tuple[float, ...]) -> "SpeedProfile":
        """The speed with a change added, m/s, that is linear between the given times, s."""
        times = np.union1d(self.times_s, times_s)
        speeds = self.speed(times) + np.interp(times, times_s, changes)
        return SpeedProfile(tuple(times.tolist()), tuple(speeds.tolist()))

    def is_moving(self, time_s: np.ndarray | float) -> np.ndarray:
        """(...) bool at times (...): with the hysteresis of `MOVING_ABOVE` and `STANDING_BELOW`."""
        changes: list[tuple[float, bool]] = [(-np.inf, self.speeds[0] > MOVING_ABOVE)]
        pieces = zip(self.times_s, self.times_s[1:], self.speeds, self.speeds[1:], strict=False)
        for start, end, first, last in pieces:
            for level, moves in ((MOVING_ABOVE, True), (STANDING_BELOW, False)):
                if (first <= level < last) if moves else (first >= level > last):
                    changes.append((start + (end - start) * (level - first) / (last - first), moves))
        place = np.searchsorted([at for at, _ in changes], time_s, side="right") - 1
        return np.array([moves for _, moves in changes])[place]

    def _piece(self, time_s: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """The knot before each time, or the first one, and the acceleration then."""
        times = np.array(self.times_s)
        piece = np.searchsorted(times, time_s, side="right") - 1
        rates = np.concatenate([[0.0], np.diff(self.speeds) / np.diff(times), [0.0]])
        return np.maximum(piece, 0), rates[piece + 1]


@dataclasses.dataclass(frozen=True)
class LaneChange:
    """A shift to the side along the smoothest curve, 10 u^3 - 15 u^4 + 6 u^5 (Flash and Hogan 1985)."""

    start_s: float
    """When it begins, s."""
    duration_s: float
    """How long it lasts, s."""
    shift_m: float
    """How far it leads, m; positive to the left."""

    def at(self, time_s: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(...) shift m, its rate m/s and the rate of that m/s^2 at times (...)."""
        u = np.clip((np.asarray(time_s) - self.start_s) / self.duration_s, 0.0, 1.0)
        shift = self.shift_m * u**3 * (10 - 15 * u + 6 * u**2)
        rate = self.shift_m / self.duration_s * 30 * u**2 * (1 - u) ** 2
        second = self.shift_m / self.duration_s**2 * 60 * u * (1 - u) * (1 - 2 * u)
        return shift, rate, second

    def is_under_way(self, time_s: np.ndarray | float) -> np.ndarray:
        """(...) bool at times (...), with its beginning and without its end."""
        elapsed = np.asarray(time_s) - self.start_s
        return (elapsed >= 0) & (elapsed < self.duration_s)


@dataclasses.dataclass(frozen=True)
class Turn:
    """A change of course on an arc of a circle."""

    after_m: float
    """Where on the path it begins, m from the start."""
    radius_m: float
    """Radius of the arc, m."""
    angle: float
    """rad: change of course; positive to the left."""

    def at(self, distance_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(...) complex position m on a path along +x, and (...) course rad, at distances (...) m."""
        bend = self.radius_m * abs(self.angle)
        on_arc = np.clip(distance_m - self.after_m, 0.0, bend)
        course = math.copysign(1.0, self.angle) * on_arc / self.radius_m
        # A chord subtends half the angle between its two tangents.
        chord = 2 * self.radius_m * np.sin(np.abs(course) / 2) * np.exp(0.5j * course)
        straight = np.minimum(distance_m, self.after_m)
        after = np.maximum(distance_m - self.after_m - bend, 0.0) * np.exp(1j * self.angle)
        return straight + chord + after, course

    def curvature(self, distance_m: np.ndarray) -> np.ndarray:
        """(...) 1/m at distances (...) m; positive to the left."""
        on_arc = (distance_m >= self.after_m) & (distance_m < self.after_m + self.radius_m * abs(self.angle))
        return on_arc * math.copysign(1 / self.radius_m, self.angle)


@dataclasses.dataclass(frozen=True)
class Kinematics:
    """Where a vehicle is and how it moves, at times of any shape (...)."""

    xy: np.ndarray
    """(..., 2) float64, m, world frame: its middle."""
    heading: np.ndarray
    """(...) float64, rad: direction of its front, which is that of its motion, from +x about +z."""
    velocity: np.ndarray
    """(..., 2) float64, m/s, world frame."""
    acceleration: np.ndarray
    """(...) float64, m/s^2: of the speed along the lane."""
    turn_rate: np.ndarray
    """(...) float64, rad/s: of the heading, counter-clockwise from above."""


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """A straight path with lane changes, or one with a turn, at a speed that varies.

    >>> path = Trajectory((0.0, 0.0), 0.0, SpeedProfile((0.0,), (10.0,)), turn=Turn(20.0, 8.0, np.pi / 2))
    >>> path.at(5.0).velocity.round(6).tolist()
    [0.0, 10.0]
    """

    start: tuple[float, float]
    """m, world frame: where it is at the first knot of `speed`."""
    course: float
    """rad: direction there, from +x about +z."""
    speed: SpeedProfile
    """Along the path."""
    turn: Turn | None = None
    """The turn."""
    lane_changes: tuple[LaneChange, ...] = ()
    """Shifts to the side, one after the other."""

    def __post_init__(self) -> None:
        """Checks what the closed form can say.

        Raises:
          ValueError: for lane changes together with a turn.
        """
        if self.turn is not None and self.lane_changes:
            raise ValueError("a path has a turn and lane changes; give it one of the two.")

    def at(self, time_s: np.ndarray | float) -> Kinematics:
        """Position and motion at times (...), s."""
        distance, speed = self.speed.distance(time_s), self.speed.speed(time_s)
        acceleration = self.speed.acceleration(time_s)
        shift, shift_rate, shift_second = self._shift(time_s)
        place, bend = distance + 0j, np.zeros_like(speed)
        curvature = np.zeros_like(speed)
        if self.turn is not None:
            place, bend = self.turn.at(distance)
            curvature = self.turn.curvature(distance)
        # A path with lane changes is straight, so that its left is always the same direction.
        xy = complex(*self.start) + np.exp(1j * self.course) * (place + 1j * shift)
        aside = np.arctan2(shift_rate, speed)
        heading = self.course + bend + aside
        velocity = (speed + 1j * shift_rate) * np.exp(1j * (self.course + bend))
        sq = np.maximum(speed**2 + shift_rate**2, np.finfo(float).tiny)
        turn_rate = curvature * speed + (speed * shift_second - acceleration * shift_rate) / sq
        return Kinematics(
            xy=np.stack([xy.real, xy.imag], axis=-1),
            heading=heading,
            velocity=np.stack([velocity.real, velocity.imag], axis=-1),
            acceleration=acceleration,
            turn_rate=turn_rate,
        )

    def _shift(self, time_s: np.ndarray | float) -> np.ndarray:
        """(3, ...) of all lane changes together: m, m/s and m/s^2."""
        parts = [np.stack(change.at(time_s)) for change in self.lane_changes]
        return np.sum(parts, axis=0) if parts else np.zeros((3, *np.shape(time_s)))

    def motion(self, time_s: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """What the vehicle does at times (...), by its exact motion at that moment.

        - moving: from `MOVING_ABOVE` on, until it is slower than `STANDING_BELOW`; otherwise standing;
        - turning: moving, and the course changes by more than `TURNING_RATE` above `TURNING_ABOVE`;
        - lane change: from the first to the last moment of a shift of more than `LANE_CHANGE_SHIFT_M` within
          `LANE_CHANGE_WINDOW_S`, after which the course is what it was before;
        - starting: speeds up by more than `START_STOP_ACCELERATION`, and `STARTING_WINDOW_S` ago it was
          slower than `STARTING_BELOW`; from the first moment of the acceleration on;
        - stopping: brakes by more than that and is slower than `STOPPING_BELOW`; until it stands.

        Of those that hold, the last in this list counts. A tracker, which sees differences over a second, or
        over five for a lane change, can say so only that much later.

        Args:
          time_s: (...) s.

        Returns:
          (...) int64, a `jaxbox.Motion` each, and (...) float64, m: where it is a lane change, how far that
          leads in all, positive to the left; 0 elsewhere.
        """
        time_s = np.asarray(time_s, float)
        state, speed = self.at(time_s), self.speed.speed(time_s)
        moves = self.speed.is_moving(time_s)
        motion = np.where(moves, Motion.MOVING, Motion.STANDING)
        turns = moves & (np.abs(state.turn_rate) > TURNING_RATE) & (speed > TURNING_ABOVE)
        motion = np.where(turns, Motion.TURNING, motion)
        shift = np.zeros_like(speed)
        for change in self.lane_changes:
            if abs(change.shift_m) > LANE_CHANGE_SHIFT_M and change.duration_s <= LANE_CHANGE_WINDOW_S:
                shift = np.where(moves & change.is_under_way(time_s), change.shift_m, shift)
        motion = np.where(shift != 0, Motion.LANE_CHANGE, motion)
        was_slow = self.speed.speed(time_s - STARTING_WINDOW_S) < STARTING_BELOW
        starts = (state.acceleration > START_STOP_ACCELERATION) & was_slow
        stops = (state.acceleration < -START_STOP_ACCELERATION) & (speed < STOPPING_BELOW)
        motion = np.where(starts, Motion.STARTING, np.where(stops, Motion.STOPPING, motion))
        return motion, np.where(motion == Motion.LANE_CHANGE, shift, 0.0)
