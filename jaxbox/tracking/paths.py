"""Whole tracks as padded arrays in the world of the poses, and their smoothing in both directions.

All of it is float64 in NumPy. Axis letters: I tracks, L moments of each from its first detection to its last,
padded; F sweeps.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxbox.config import TrackConfig
from jaxbox.tracking.state import Observations
from jaxbox.tracking.tracks import FREE, Tracks

MAX_PADDED_MOMENTS = 2**18
"""Moments of the tracks that are smoothed together, padding included, so that memory stays flat."""


@dataclasses.dataclass(frozen=True)
class Paths:
    """Tracks of similar length, from the first detection to the last."""

    id: np.ndarray
    """(I,) int."""
    first: np.ndarray
    """(I,) int: sweep of the first moment."""
    length: np.ndarray
    """(I,) int: moments that count."""
    step_s: np.ndarray
    """(I, L) s: time since the moment before; 0 at the first one and beyond the last."""
    slot: np.ndarray
    """(I, L) int: slot of the track in the sweep, -1 beyond the last moment."""
    hit: np.ndarray
    """(I, L) bool: whether it was detected."""
    center: np.ndarray
    """(I, L, 3) m, world: of its detection; 0 where there is none."""
    size: np.ndarray
    """(I, L, 3) m, likewise."""
    yaw: np.ndarray
    """(I, L) rad, world, likewise."""
    score: np.ndarray
    """(I, L), likewise."""
    num_points: np.ndarray
    """(I, L), likewise."""
    extent: np.ndarray
    """(I, L, 2) m: what was seen, along and across, likewise."""
    front_log_odds: np.ndarray
    """(I, L): that the front is where its yaw points, likewise."""
    sensor: np.ndarray
    """(I, L, 2) m, world: where the sensor was."""

    @property
    def valid(self) -> np.ndarray:
        """(I, L) bool: moments that count."""
        return np.arange(self.hit.shape[1]) < self.length[:, None]

    @property
    def sweep(self) -> np.ndarray:
        """(I, L) int: sweep of each moment, that of the last one beyond it."""
        return self.first[:, None] + np.minimum(np.arange(self.hit.shape[1]), self.length[:, None] - 1)


def position_variance(paths: Paths, config: TrackConfig) -> np.ndarray:
    """(I, L) m^2: variance of each detected position along each axis; infinite where there is none."""
    range_m = np.linalg.norm(paths.center[..., :2] - paths.sensor, axis=-1)
    variance = (float(config.position_sd_m) + float(config.position_sd_grade) * range_m) ** 2
    return np.where(paths.hit, variance, np.inf)


def gather_paths(
    tracks: Sequence[Tracks], seen: Sequence[Observations], T_world_sensor: np.ndarray, time_s: np.ndarray
) -> Iterator[Paths]:
    """Gathers the detections of each track.

    Args:
      tracks: of F sweeps, on the host.
      seen: the detections of each.
      T_world_sensor: (F, 4, 4) m.
      time_s: (F,) s.

    Yields:
      Groups of tracks of similar length, every track that was detected once.
    """
    sweeps = [_sightings(*of_sweep) for of_sweep in zip(tracks, seen, T_world_sensor, strict=True)]
    sweep = np.repeat(np.arange(len(sweeps)), [len(s.id) for s in sweeps])
    rows = Sightings(*(np.concatenate(columns) for columns in zip(*sweeps, strict=True)))
    hit_ids, hit_sweep = rows.id[rows.hit], sweep[rows.hit]
    ids, first_index = np.unique(hit_ids, return_index=True)
    # Rows are in the order of sweeps.
    first = hit_sweep[first_index]
    last = hit_sweep[len(hit_ids) - 1 - np.unique(hit_ids[::-1], return_index=True)[1]]
    track = np.minimum(np.searchsorted(ids, rows.id), max(len(ids) - 1, 0))
    order = np.argsort(last - first, kind="stable")
    for group in _groups((last - first + 1)[order]):
        chosen = np.sort(order[group])
        place = np.full(len(ids), FREE)
        place[chosen] = np.arange(len(chosen))
        inside = (place[track] > FREE) & (rows.id == ids[track])
        inside &= (first[track] <= sweep) & (sweep <= last[track])
        member = Sightings(*(column[inside] for column in rows))
        at = place[track[inside]], sweep[inside] - first[track[inside]]
        yield _pad(ids[chosen], first[chosen], last[chosen], member, at, T_world_sensor, time_s)


class Sightings(NamedTuple):
    """Tracks in single sweeps, n of them, with their detections in the world."""

    id: np.ndarray
    """(n,) int."""
    slot: np.ndarray
    """(n,) int, of the track in its sweep."""
    hit: np.ndarray
    """(n,) bool: whether it was detected."""
    numbers: np.ndarray
    """(n, 12): centre (m), size (m), yaw (rad), score, points, extents (m), log odds of the front; 0 where
    it was not."""


def _sightings(tracks: Tracks, seen: Observations, T_world_sensor: np.ndarray) -> Sightings:
    slot = np.flatnonzero(tracks.valid)
    row = np.asarray(tracks.detection)[slot]
    hit = row > FREE
    names = ("center", "size", "yaw", "score", "num_points", "extent", "front_log_odds")
    center, size, yaw, *others = (np.asarray(getattr(seen, name), float)[row] for name in names)
    center = center @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3]
    yaw = yaw + np.arctan2(T_world_sensor[1, 0], T_world_sensor[0, 0])
    numbers = np.column_stack([center, size, yaw, *others])
    return Sightings(np.asarray(tracks.id)[slot], slot, hit, np.where(hit[:, None], numbers, 0.0))


def _groups(lengths: np.ndarray) -> Iterator[slice]:
    """Slices of ascending lengths that, padded to their longest, hold few enough moments."""
    start = 0
    while start < len(lengths):
        stop = start + 1
        while stop < len(lengths) and (stop + 1 - start) * lengths[stop] <= MAX_PADDED_MOMENTS:
            stop += 1
        yield slice(start, stop)
        start = stop


def _pad(
    ids: np.ndarray,
    first: np.ndarray,
    last: np.ndarray,
    rows: Sightings,
    at: tuple[np.ndarray, np.ndarray],
    T_world_sensor: np.ndarray,
    time_s: np.ndarray,
) -> Paths:
    """Tracks as padded arrays; `at` is the track and the moment of each row."""
    length = last - first + 1
    shape = len(ids), int(length.max())
    sweep = first[:, None] + np.minimum(np.arange(shape[1]), length[:, None] - 1)
    slot, hit, numbers = (
        np.full(shape, FREE),
        np.zeros(shape, bool),
        np.zeros((*shape, rows.numbers.shape[1])),
    )
    slot[at], hit[at], numbers[at] = rows.slot, rows.hit, rows.numbers
    return Paths(
        id=ids,
        first=first,
        length=length,
        step_s=np.diff(time_s[sweep], axis=1, prepend=time_s[first][:, None]),
        slot=slot,
        hit=hit,
        center=numbers[..., :3],
        size=numbers[..., 3:6],
        yaw=numbers[..., 6],
        score=numbers[..., 7],
        num_points=numbers[..., 8],
        extent=numbers[..., 9:11],
        front_log_odds=numbers[..., 11],
        sensor=T_world_sensor[sweep][..., :2, 3],
    )


def smooth_positions(
    measured: np.ndarray, variance: np.ndarray, step_s: np.ndarray, config: TrackConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions and velocities from all measurements, earlier and later ones (Rauch, Tung, Striebel, 1965).

    The model is that of the step: constant velocity, white acceleration, one covariance for both axes.

    Args:
      measured: (I, L, 2) m; a first measurement each.
      variance: (I, L) m^2; infinite where nothing was measured.
      step_s: (I, L) s, time since the moment before.
      config: of the tracker.

    Returns:
      position (I, L, 2) m, velocity (I, L, 2) m/s, and covariance (I, L, 3): of position, of both, and of
      velocity.
    """
    num_tracks, num_moments = variance.shape
    state = np.zeros((num_moments, num_tracks, 2, 2))
    """Position and velocity along the third axis."""
    covariance = np.zeros((num_moments, num_tracks, 2, 2))
    expected, expected_covariance = np.zeros_like(state), np.zeros_like(covariance)
    now = np.stack([measured[:, 0], np.zeros_like(measured[:, 0])], axis=1)
    speed_variance = float(config.birth_speed_sd_mps) ** 2
    spread = np.tile(np.diag([0.0, speed_variance]), (num_tracks, 1, 1))
    spread[:, 0, 0] = variance[:, 0]
    for k in range(num_moments):
        if k:
            transition, noise = _model(step_s[:, k], config)
            now = transition @ now
            spread = transition @ spread @ transition.swapaxes(1, 2) + noise
        expected[k], expected_covariance[k] = now, spread
        if k:
            gain = spread[:, :, 0] / (spread[:, 0, 0] + variance[:, k])[:, None]
            now = now + gain[:, :, None] * (measured[:, k] - now[:, 0])[:, None]
            spread = spread - gain[:, :, None] * spread[:, None, 0]
        state[k], covariance[k] = now, spread
    for k in range(num_moments - 2, -1, -1):
        transition, _ = _model(step_s[:, k + 1], config)
        gain = covariance[k] @ transition.swapaxes(1, 2) @ np.linalg.inv(expected_covariance[k + 1])
        state[k] += gain @ (state[k + 1] - expected[k + 1])
        covariance[k] += gain @ (covariance[k + 1] - expected_covariance[k + 1]) @ gain.swapaxes(1, 2)
    state, covariance = state.swapaxes(0, 1), covariance.swapaxes(0, 1)
    entries = [covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]]
    return state[..., 0, :], state[..., 1, :], np.stack(entries, axis=-1)


MIN_STEP_S = 1e-3
"""Beyond the last moment no time passes; so much keeps the covariance invertible."""


def _model(dt: np.ndarray, config: TrackConfig) -> tuple[np.ndarray, np.ndarray]:
    """(I, 2, 2) each: transition of position and velocity, and the noise of a white acceleration."""
    dt = np.maximum(dt, MIN_STEP_S)
    one, zero = np.ones_like(dt), np.zeros_like(dt)
    transition = np.stack([np.stack([one, dt], -1), np.stack([zero, one], -1)], -2)
    push = np.stack([dt**2 / 2, dt], axis=-1) * float(config.acceleration_mps2)
    return transition, push[:, :, None] * push[:, None]
