"""Yaw, size and front of a track from all its detections."""

import dataclasses
import math
from typing import Any

import numpy as np

from jaxbox.config import TrackConfig
from jaxbox.reference.tracks import MATURE_HITS, Track

MAX_YAW_POINTS, MAX_SIZE_POINTS = 300, 500
"""More points add nothing to the weight of a detection's yaw, and of its size."""
CROSSED_WEIGHT = 1e-3
"""Weight of the size of a detection whose length lies across the track's, and of one without points."""
SEEN_QUANTILE, SEEN_STEP_M, SEEN_MIN_STEP_M = 0.9, 0.5, 0.05
"""Quantile of the seen extents, and the first and the least step of the search for it, m."""
SEEN_SHARE = 0.8
"""A side of which a sweep saw more than this share of the track's is as long as that sweep says."""
TRACK_WEIGHT = 0.5
"""What the box of a track counts next to that of its detection, where both score alike."""
MAX_COURSE_SD = 0.15
"""The course is believed where the velocity's standard deviation is below this share of the speed."""
FULL_FRONT_SPEED_MPS = 3.0
"""Speed from which a sweep's motion counts as one whole vote for the front."""
PROFILE_CORRELATION, MAX_PROFILE_LOG_ODDS = 0.15, 6.0
"""Correlation of the log odds that two sweeps see of a front, and the most that all sweeps are worth."""
MAX_TURN_RATE = math.pi / 2
"""No vehicle turns faster, rad/s."""


@dataclasses.dataclass
class Box:
    """A box of a vehicle."""

    center: np.ndarray
    """(3,) m."""
    size: np.ndarray
    """(3,) m, length, width, height."""
    yaw: float
    """rad, in [-pi/2, pi/2)."""


def wrap_yaw(yaw: float) -> float:
    """The angle of an axis in [-pi/2, pi/2).

    Args:
      yaw: rad.

    Returns:
      rad.
    """
    return (yaw + math.pi / 2) % math.pi - math.pi / 2


def axes(yaw: float) -> np.ndarray:
    """(2, 2) unit vectors along and across a box, one a row."""
    return np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])


def corners(center: np.ndarray, size: np.ndarray, yaw: float) -> np.ndarray:
    """(4, 2) m, corners of a rectangle in their order round it.

    Args:
      center: (2,) m.
      size: (2,) m.
      yaw: rad.

    Returns:
      The corners.
    """
    return center + np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * size / 2 @ axes(yaw)


def distance_to_sensor(center: np.ndarray, size: np.ndarray, yaw: float) -> float:
    """Distance of a rectangle from the origin, m, by its sides; 0 where the origin is inside.

    Args:
      center: (2,) m.
      size: (2,) m.
      yaw: rad.

    Returns:
      The distance.
    """
    if (np.abs(axes(yaw) @ center) < size / 2).all():
        return 0.0
    distances = []
    ring = corners(center, size, yaw)
    for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        side = end - start
        share = np.clip(-start @ side / max(side @ side, np.finfo(float).tiny), 0, 1)
        distances.append(np.linalg.norm(start + share * side))
    return float(min(distances))


def is_inside(xy: np.ndarray, track: Track) -> bool:
    """Whether a point is in a track's box.

    Args:
      xy: (2,) m.
      track: of the box.

    Returns:
      Whether it is.
    """
    return bool((np.abs(axes(track.yaw) @ (xy - track.position[:2])) < track.size()[:2] / 2).all())


def is_crossed(seen_yaw: float, yaw: float) -> bool:
    """Whether the length of a detection lies across that of its track.

    Args:
      seen_yaw: rad.
      yaw: rad.

    Returns:
      Whether it does.
    """
    return abs(math.sin(seen_yaw - yaw)) > abs(math.cos(seen_yaw - yaw))


def yaw_vote(seen: Any, row: int) -> complex:
    """What a detection votes for as the yaw.

    Args:
      seen: D detections.
      row: of the detection.

    Returns:
      exp(2 i yaw), times its weight.
    """
    points = min(max(int(seen.num_points[row]), 1), MAX_YAW_POINTS)
    return float(seen.score[row]) * math.sqrt(points) * np.exp(2j * float(seen.yaw[row]))


def size_sums(seen: Any, row: int, *, crossed: bool) -> np.ndarray:
    """What a detection adds to the sums of sizes and weights.

    Args:
      seen: D detections.
      row: of the detection.
      crossed: whether its length lies across that of its track.

    Returns:
      (4,).
    """
    points = min(max(int(seen.num_points[row]), 0), MAX_SIZE_POINTS)
    weight = CROSSED_WEIGHT + points * (CROSSED_WEIGHT if crossed else 1)
    return weight * np.array([*np.asarray(seen.size[row], float), 1.0])


def learn_shape(track: Track, seen: Any, row: int, dt: float, config: TrackConfig) -> np.ndarray:
    """Yaw, turn rate, size and extent after a detection.

    Args:
      track: predicted; changed.
      seen: D detections.
      row: of its own.
      dt: s.
      config: of the tracker.

    Returns:
      (2,) m, the size of the detection along and across the track.
    """
    learn_yaw(track, seen, row, dt, config)
    size, crossed = np.asarray(seen.size[row, :2], float), is_crossed(float(seen.yaw[row]), track.yaw)
    track.size_sums = track.size_sums + size_sums(seen, row, crossed=crossed)
    if not crossed:
        step = max(SEEN_STEP_M / track.hits, SEEN_MIN_STEP_M)
        for axis in (0, 1):
            is_longer = float(seen.extent[row, axis]) > track.extent[axis]
            change = step * (SEEN_QUANTILE if is_longer else SEEN_QUANTILE - 1)
            track.extent[axis] = max(track.extent[axis] + change, 0.0)
    return size[::-1] if crossed else size


def learn_yaw(track: Track, seen: Any, row: int, dt: float, config: TrackConfig) -> None:
    """Votes for the yaw, and the turn rate.

    Args:
      track: predicted; changed.
      seen: D detections.
      row: of its own.
      dt: s.
      config: of the tracker.
    """
    moves = track.moving and track.hits > MATURE_HITS
    innovation = wrap_yaw(float(seen.yaw[row]) - track.yaw)
    if not moves:
        track.turn_rate = 0.0
    elif abs(innovation) < math.pi / 8:
        rate = track.turn_rate + float(config.turn_gain) * innovation / dt
        track.turn_rate = min(max(rate, -MAX_TURN_RATE), MAX_TURN_RATE)
    track.yaw_vote *= float(config.yaw_memory_moving if moves else config.yaw_memory)
    track.yaw_vote += yaw_vote(seen, row)
    if is_course_sure(track, config):
        course = complex(*track.velocity) / track.speed
        track.yaw_vote += float(config.course_weight) * course**2


def is_course_sure(track: Track, config: TrackConfig) -> bool:
    """Whether a track is fast enough, and long enough known, that its course is its axis.

    Args:
      track: predicted.
      config: of the tracker.

    Returns:
      Whether it is.
    """
    sd = math.sqrt(np.trace(track.covariance[2:, 2:]))
    is_fast = track.speed > float(config.course_speed_mps) and track.hits > MATURE_HITS
    return is_fast and sd < MAX_COURSE_SD * track.speed


def vote_front(track: Track) -> None:
    """Votes for the front of a moving vehicle, by the direction in which it moves.

    Args:
      track: updated; changed.
    """
    if track.moving and track.speed > 0:
        weight = min(track.speed / FULL_FRONT_SPEED_MPS, 1)
        track.front_vote += weight * complex(*track.velocity) / track.speed


def profile_vote(seen: Any, row: int) -> complex:
    """What a detection votes for as the front, by its profile.

    Args:
      seen: D detections.
      row: of the detection.

    Returns:
      exp(i yaw), times its log odds that the front is there.
    """
    return float(seen.front_log_odds[row]) * np.exp(1j * float(seen.yaw[row]))


def front_of(yaw: float, track: Track) -> tuple[float, float]:
    """Where the front of a box points, and how sure that is.

    Args:
      yaw: rad, of the length axis.
      track: with its votes.

    Returns:
      Heading (rad, in [-pi, pi)) and probability.
    """
    back = np.exp(-1j * yaw)
    # The log likelihood ratio of normal variables with one correlation between any two.
    profile = (track.profile_vote * back).real / (1 + (track.hits - 1) * PROFILE_CORRELATION)
    votes = (track.front_vote * back).real + np.clip(profile, -MAX_PROFILE_LOG_ODDS, MAX_PROFILE_LOG_ODDS)
    heading = yaw if votes >= 0 else yaw + math.pi
    return (heading + math.pi) % (2 * math.pi) - math.pi, 1 / (1 + math.exp(-abs(votes)))


def keep_visible_faces(center: np.ndarray, size: np.ndarray, yaw: float, new_size: np.ndarray) -> np.ndarray:
    """Centre of a box of another size whose faces towards the sensor stay where they are.

    Args:
      center: (2,) m, sensor frame.
      size: (2,) m.
      yaw: rad.
      new_size: (2,) m.

    Returns:
      (2,) m.
    """
    moved = center.copy()
    for axis, length, new_length in zip(axes(yaw), size, new_size, strict=True):
        for direction in (axis, -axis):
            # Of the face that the sensor, the origin, is in front of.
            face = center + direction * length / 2
            if -face @ direction > 0:
                moved = moved + direction * (length - new_length) / 2
    return moved


def refine_box(track: Track, seen: Any, row: int) -> Box:
    """The box of a detection, with the yaw that the track knows, and its length unless most of it was seen.

    The width is the track's where the box lies across it.

    Args:
      track: updated.
      seen: D detections.
      row: of its own.

    Returns:
      The box.
    """
    center, size = np.asarray(seen.center[row], float), np.asarray(seen.size[row], float)
    yaw = float(seen.yaw[row])
    if track.hits <= MATURE_HITS:
        return Box(center, size, wrap_yaw(yaw))
    crossed, (length, width, _) = is_crossed(yaw, track.yaw), track.size()
    flat = size[1::-1] if crossed else size[:2]
    seen_whole = not crossed and seen.extent[row][0] > SEEN_SHARE * length
    new = np.array([flat[0] if seen_whole else length, width if crossed else flat[1]])
    place = keep_visible_faces(center[:2], flat, track.yaw, new)
    return Box(np.array([*place, center[2]]), np.array([*new, size[2]]), wrap_yaw(track.yaw))


def track_share(track: Track, track_score: float, own_score: float) -> float:
    """How far from the box of its detection to its own a track is shown; not at all after few detections.

    Args:
      track: updated.
      track_score: in [0, 1].
      own_score: in [0, 1], of the detection of this sweep.

    Returns:
      In [0, 1].
    """
    weight = TRACK_WEIGHT * track_score
    return weight / (weight + own_score) if track.hits > MATURE_HITS and weight else 0.0
