"""What a vehicle does, from the moments of its path."""

import math

import numpy as np

from jaxbox.config import TrackConfig
from jaxbox.reference.tracks import MAX_MOMENTS, Moment, Track, Tracker
from jaxbox.types import Motion

MOMENT_S = 0.1
"""Time between the moments of a path, s."""
AGE_TOLERANCE = 0.25
"""A moment stands for another whose age differs by less than this share."""
MEMORY_S = 1.0
"""Speed and course are compared with those this long ago, s."""
LANE_S, LANE_END_S, LANE_END_M = 5.0, 0.8, 2.0
"""A lane change is looked for in a path of this duration, s, whose ends have this duration, s, and at least
this length, m."""
MATURE_HITS = 10
"""Detections after which a velocity is good enough to be compared with an earlier one."""
FIRST_MOMENTS = 3
"""The velocity at a path's first moments is compared with none."""
SPEED_SDS = 3.0
"""A vehicle that moves is faster than this many standard deviations of its speed."""
STARTING_SPEED_MPS, STOPPING_SPEED_MPS, TURNING_SPEED_MPS = 3.0, 4.0, 1.5
"""A vehicle starts from below the first, stops below the second, and turns above the third."""


def is_moving(track: Track, config: TrackConfig) -> bool:
    """Whether a track moves, with hysteresis.

    Args:
      track: after the sweep.
      config: of the tracker.

    Returns:
      Whether it does.
    """
    if track.moving:
        return track.speed >= float(config.standing_speed_mps)
    sd = math.sqrt(track.covariance[2, 2])
    return track.speed > max(float(config.moving_speed_mps), SPEED_SDS * sd)


def remember(tracker: Tracker) -> None:
    """Adds where tracks are to their paths, where the newest moment is old enough.

    Args:
      tracker: after the sweep; changed.
    """
    if tracker.time_s - tracker.moment_times_s[0] <= (1 - AGE_TOLERANCE) * MOMENT_S:
        return
    tracker.moment_times_s = [tracker.time_s, *tracker.moment_times_s][:MAX_MOMENTS]
    for track in tracker.tracks():
        now = Moment(track.position[:2].copy(), track.velocity.copy(), track.moving)
        track.path = [now, *track.path][:MAX_MOMENTS]


def find_moment(tracker: Tracker, ago_s: float) -> tuple[int, float]:
    """Place and age of the moment nearest to a time ago.

    Args:
      tracker: after the sweep.
      ago_s: s.

    Returns:
      Its place, and its age in s.
    """
    ages = [tracker.time_s - time for time in tracker.moment_times_s]
    place = min(range(len(ages)), key=lambda i: abs(ages[i] - ago_s))
    return place, ages[place]


def classify(track: Track, tracker: Tracker, config: TrackConfig) -> tuple[Motion, float]:
    """What a track does, and how far it shifted to its left where it changes lanes.

    Args:
      track: after the sweep.
      tracker: with the times of the moments of its path.
      config: of the tracker.

    Returns:
      The state, and the shift in m.
    """
    shift = lateral_shift(track, tracker, config)
    if shift:
        return Motion.LANE_CHANGE, shift
    return (compare_with_earlier(track, tracker, config) if track.moving else Motion.STANDING), 0.0


def compare_with_earlier(track: Track, tracker: Tracker, config: TrackConfig) -> Motion:
    """Whether a moving track turns, stops or starts.

    Args:
      track: after the sweep.
      tracker: with the times of the moments of its path.
      config: of the tracker.

    Returns:
      The state.
    """
    place, age = find_moment(tracker, MEMORY_S)
    known = abs(age - MEMORY_S) < AGE_TOLERANCE * MEMORY_S and track.hits > MATURE_HITS
    if not known or len(track.path) <= place + FIRST_MOMENTS:
        return Motion.MOVING
    earlier = track.path[place].velocity
    rate_deg = abs(math.degrees(angle_between(earlier, track.velocity))) / age
    moved = all(moment.moving for moment in track.path[: place + 1])
    if moved and rate_deg > float(config.turning_deg_per_s) and track.speed > TURNING_SPEED_MPS:
        return Motion.TURNING
    earlier_speed = float(np.linalg.norm(earlier))
    acceleration = (track.speed - earlier_speed) / age
    if acceleration < -float(config.starting_mps2) and track.speed < STOPPING_SPEED_MPS:
        return Motion.STOPPING
    if acceleration > float(config.starting_mps2) and earlier_speed < STARTING_SPEED_MPS:
        return Motion.STARTING
    return Motion.MOVING


def angle_between(first: np.ndarray, second: np.ndarray) -> float:
    """Signed angle from a direction to another, rad.

    Args:
      first: (2,).
      second: (2,).

    Returns:
      The angle, in (-pi, pi].
    """
    turned = complex(*second) * complex(*first).conjugate()
    return math.atan2(turned.imag, turned.real)


def lateral_shift(track: Track, tracker: Tracker, config: TrackConfig) -> float:
    """Shift to the left between two courses that agree, m; 0 where lanes are not changed.

    Args:
      track: after the sweep.
      tracker: with the times of the moments of its path.
      config: of the tracker.

    Returns:
      The shift.
    """
    first, age = find_moment(tracker, LANE_S)
    if abs(age - LANE_S) >= AGE_TOLERANCE * LANE_S or len(track.path) <= first:
        return 0.0
    first_end, last_start = (find_moment(tracker, ago)[0] for ago in (LANE_S - LANE_END_S, LANE_END_S))
    before = track.path[first_end].position - track.path[first].position
    after = track.path[0].position - track.path[last_start].position
    way = track.path[0].position - track.path[first].position
    shifts = [float(np.linalg.norm(way)) * math.sin(angle_between(end, way)) for end in (before, after)]
    least = float(config.lane_change_m)
    is_lane_change = (
        all(moment.moving for moment in track.path[: first + 1])
        and min(np.linalg.norm(before), np.linalg.norm(after)) > LANE_END_M
        and abs(math.degrees(angle_between(before, after))) < float(config.lane_course_deg)
        and (min(shifts) > least or max(shifts) < -least)
    )
    return sum(shifts) / 2 if is_lane_change else 0.0
