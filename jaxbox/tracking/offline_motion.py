"""What vehicles do, from whole smoothed paths: with as much of the path after a moment as before it.

The states are those of `jaxbox.tracking.motion`, without its delay. Axis letters: I tracks, L moments.
"""

import numpy as np

from jaxbox.config import TrackConfig
from jaxbox.geometry.planar import wrap_turn
from jaxbox.tracking.motion import (
    LANE_END_M,
    LANE_END_S,
    LANE_S,
    MEMORY_S,
    SPEED_SDS,
    STARTING_SPEED_MPS,
    STOPPING_SPEED_MPS,
    TURNING_SPEED_MPS,
)
from jaxbox.tracking.paths import Paths
from jaxbox.types import Motion

MIN_SHARE = 0.5
"""At the ends of a path a window may be shorter, down to this share."""


def classify_paths(
    position: np.ndarray, velocity: np.ndarray, covariance: np.ndarray, paths: Paths, config: TrackConfig
) -> tuple[np.ndarray, np.ndarray]:
    """What tracks do at each moment.

    Args:
      position: (I, L, 2) m, smoothed, world.
      velocity: (I, L, 2) m/s.
      covariance: (I, L, 3), see `Tracks.covariance`.
      paths: of the tracks.
      config: of the tracker.

    Returns:
      motion: (I, L) int, a `Motion`.
      lateral_shift_m: (I, L) m, to the left; 0 where no lanes are changed.
    """
    time = np.cumsum(paths.step_s, axis=1)
    speed = np.linalg.norm(velocity, axis=-1)
    moving = _hysteresis(speed, np.sqrt(covariance[..., 2]), paths.valid, config)
    start, stop = _window(time, paths, MEMORY_S)
    span_s = np.maximum(_at(time, stop) - _at(time, start), 1e-3)
    long = span_s > MIN_SHARE * MEMORY_S
    before, after = _at(speed, start), _at(speed, stop)
    acceleration = (after - before) / span_s
    course = np.arctan2(velocity[..., 1], velocity[..., 0])
    turned = wrap_turn(_at(course, stop) - _at(course, start))
    throughout = _all_between(moving, start, stop)
    rate_deg = np.rad2deg(np.abs(turned)) / span_s
    starts = long & moving & (acceleration > config.starting_mps2) & (before < STARTING_SPEED_MPS)
    stops = long & moving & (acceleration < -config.starting_mps2) & (after < STOPPING_SPEED_MPS)
    turns = long & throughout & (rate_deg > config.turning_deg_per_s) & (speed > TURNING_SPEED_MPS)
    shift = _lateral_shift(position, time, moving, paths, config)
    motion = np.select(
        [shift != 0, turns, stops, starts, moving],
        [Motion.LANE_CHANGE, Motion.TURNING, Motion.STOPPING, Motion.STARTING, Motion.MOVING],
        Motion.STANDING,
    )
    return motion, shift


def _at(values: np.ndarray, moment: np.ndarray) -> np.ndarray:
    return np.take_along_axis(values, moment, axis=1)


def _hysteresis(speed: np.ndarray, sd: np.ndarray, valid: np.ndarray, config: TrackConfig) -> np.ndarray:
    """(I, L) bool: a vehicle moves from one speed on, and until it is slower than another."""
    begins = (speed > config.moving_speed_mps) & (speed > SPEED_SDS * sd)
    ends = speed < config.standing_speed_mps
    moment = np.arange(speed.shape[1])
    last_begin = np.maximum.accumulate(np.where(begins, moment, -1), axis=1)
    last_end = np.maximum.accumulate(np.where(ends, moment, -1), axis=1)
    return valid & (last_begin > last_end)


def _window(time: np.ndarray, paths: Paths, span_s: float) -> tuple[np.ndarray, np.ndarray]:
    """(I, L) int each: first and last moment of the window of a length around each moment."""
    start, stop = np.zeros(time.shape, int), np.zeros(time.shape, int)
    for i, of_track in enumerate(time):
        own = of_track[: paths.length[i]]
        start[i] = np.searchsorted(own, of_track - span_s / 2 - 1e-6)
        stop[i] = np.searchsorted(own, of_track + span_s / 2 + 1e-6, side="right") - 1
    last = paths.length[:, None] - 1
    return np.minimum(start, last), np.maximum(stop, 0)


def _all_between(flags: np.ndarray, start: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """(I, L) bool: whether flags hold at all moments from one to another."""
    count = np.cumsum(flags, axis=1)
    return _at(count, stop) - _at(count, start) + _at(flags, start) == stop - start + 1


def _lateral_shift(
    position: np.ndarray, time: np.ndarray, moving: np.ndarray, paths: Paths, config: TrackConfig
) -> np.ndarray:
    """(I, L) m: shift across the course over the window around each moment, 0 where lanes are not changed."""
    start, stop = _window(time, paths, LANE_S)
    whole = _at(time, stop) - _at(time, start) > (1 - MIN_SHARE / 5) * LANE_S
    steps = (
        np.maximum(np.median(paths.step_s[:, 1:], axis=1), 1e-3) if time.shape[1] > 1 else np.ones(len(time))
    )
    end = np.maximum(np.round(LANE_END_S / steps).astype(int), 1)[:, None]

    def place(moment: np.ndarray) -> np.ndarray:
        return np.take_along_axis(position, moment[..., None], axis=1)

    before = place(np.minimum(start + end, stop)) - place(start)
    after = place(stop) - place(np.maximum(stop - end, start))
    way = place(stop) - place(start)
    left_of_before, left_of_after = _offset(way, before), _offset(way, after)
    far = np.minimum(np.linalg.norm(before, axis=-1), np.linalg.norm(after, axis=-1)) > LANE_END_M
    first, last = (np.arctan2(d[..., 1], d[..., 0]) for d in (before, after))
    straight = np.abs(wrap_turn(last - first)) < np.deg2rad(config.lane_course_deg)
    aside = np.minimum(np.abs(left_of_before), np.abs(left_of_after)) > config.lane_change_m
    aside &= left_of_before * left_of_after > 0
    found = whole & far & straight & aside & _all_between(moving, start, stop)
    return np.where(found, (left_of_before + left_of_after) / 2, 0.0)


def _offset(way: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(I, L) m: how far displacements end to the left of lines in some directions."""
    across = direction[..., 0] * way[..., 1] - direction[..., 1] * way[..., 0]
    return across / np.maximum(np.linalg.norm(direction, axis=-1), 1e-6)
