"""The second pass over a whole recording: what is seen later tells about what was seen before.

Positions are smoothed forward and backward, a track has one size and, where it stands, one yaw, and it goes
on through short gaps. What moves has the box of its track. What stands has, as in the step, one between that
and the sweep's own, of which the track's length and width are for the sides that the sweep did not see.
Height and vertical place are the track's in every sweep, because single ones depend on which beams hit the
roof. All is float64 in NumPy, in the world of the poses.

Axis letters: I tracks, L moments, F sweeps.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbox.config import TrackConfig
from jaxbox.tracking.offline_motion import classify_paths
from jaxbox.tracking.paths import Paths, gather_paths, position_variance, smooth_positions
from jaxbox.tracking.shape import (
    CROSSED_WEIGHT,
    FULL_FRONT_SPEED_MPS,
    MAX_GROWTH,
    MAX_PROFILE_LOG_ODDS,
    MAX_SIZE_POINTS,
    MAX_YAW_POINTS,
    PROFILE_CORRELATION,
    SEEN_QUANTILE,
    SEEN_SHARE,
    TRACK_WEIGHT,
)
from jaxbox.tracking.state import Observations
from jaxbox.tracking.tracks import Tracks
from jaxbox.types import Motion

MAX_GAP_S = 0.8
"""Longer gaps between two detections are not filled."""
MIN_EXTENTS = 5
"""From this many extents on, a track is at least as long as a quantile of them."""
YAW_MEMORY_S = 0.4
"""A moving vehicle's yaw is a vote in which a detection counts exp(-t / this) at a time t from it."""
HEIGHT_MEMORY_S = 0.2
"""The same of the height of a box's centre; it is short, because the pitch of poses is not exact."""
COURSE_SHARE = 0.5
"""At speeds at which the course has a vote for the yaw, it is this share of all the others."""
MOVING_DISTANCE_M = 1.5
"""A track moves where its path is longer than this, m, and its median speed is that of a moving one."""
MEAN_SCORE_SHARE = 0.75
"""Share of the track's mean score in the logarithm of a detection's; the rest is its own."""
BELIEVED_HITS = 4.0
"""A track of n detections is believed n / (n + this), and one of all sweeps wholly: false alarms last shorter
than vehicles."""


def smooth(
    tracks: Sequence[Tracks],
    seen: Sequence[Observations],
    T_world_sensor: np.ndarray,
    time_s: np.ndarray,
    config: TrackConfig | None = None,
) -> list[Tracks]:
    """Tracks of a whole recording, each moment in the light of all others.

    Args:
      tracks: what `track_step` gave for F sweeps, in arrays of the host.
      seen: the detections of each sweep that it was given.
      T_world_sensor: (F, 4, 4) m, the poses.
      time_s: (F,) s, increasing.
      config: of the tracker; None for the defaults.

    Returns:
      The tracks of each sweep, in the order of their ids: those that were detected or whose gap is filled.
      `Tracks.velocity`, `motion`, `lateral_shift_m` and the filtered box are the smoothed ones.

    Raises:
      ValueError: where the numbers of sweeps differ.
    """
    if not len(tracks) == len(seen) == len(T_world_sensor) == len(time_s):
        raise ValueError(
            f"{len(tracks)} sweeps of tracks, {len(seen)} of detections, {len(T_world_sensor)} poses and "
            f"{len(time_s)} times; give one of each a sweep."
        )
    config = TrackConfig() if config is None else config
    T_world_sensor, time_s = np.asarray(T_world_sensor, float), np.asarray(time_s, float)
    groups = gather_paths(tracks, seen, T_world_sensor, time_s) if len(tracks) else ()
    parts = [_smooth_group(paths, tracks, T_world_sensor, config) for paths in groups]
    if not parts:
        return [_pick(of_sweep, {}, np.zeros(0, int)) for of_sweep in tracks]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.lexsort([columns["id"], columns["sweep"]])
    sweep = columns["sweep"][order]
    bounds = np.searchsorted(sweep, np.arange(len(tracks) + 1))
    return [
        _pick(of_sweep, columns, order[start:stop])
        for of_sweep, start, stop in zip(tracks, bounds, bounds[1:], strict=False)
    ]


Columns = dict[str, np.ndarray]
"""One row a track and sweep: the fields of `Tracks` by name, the sweep and the slot."""


def _pick(before: Tracks, columns: Columns, rows: np.ndarray) -> Tracks:
    """The tracks of one sweep: some rows, and the counts and the status that the step gave."""
    fields = [field.name for field in dataclasses.fields(Tracks) if field.name not in ("counts", "status")]
    chosen = {}
    for name in fields:
        like = np.asarray(getattr(before, name))
        chosen[name] = columns[name][rows].astype(like.dtype) if len(rows) else like[:0]
    return Tracks(**chosen, counts=before.counts, status=before.status)


def wrap_axis(angle: np.ndarray) -> np.ndarray:
    """Wraps angles of an axis, rad, to [-pi/2, pi/2)."""
    return (angle + np.pi / 2) % np.pi - np.pi / 2


def _rotate(xy: np.ndarray, angle: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * xy[..., 0] - sin * xy[..., 1], sin * xy[..., 0] + cos * xy[..., 1]], axis=-1)


def _keep_visible_faces(
    center: np.ndarray, size: np.ndarray, yaw: np.ndarray, new_size: np.ndarray, sensor: np.ndarray
) -> np.ndarray:
    """Centres (..., 2) of boxes of another size whose faces towards the sensor stay where they are."""
    toward = _rotate(sensor - center, -yaw)
    face = np.where(np.abs(toward) > size / 2, np.sign(toward), 0.0)
    return center + _rotate(face * (size - new_size) / 2, yaw)


def _find_shapes(
    paths: Paths, velocity: np.ndarray, config: TrackConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What whole tracks are like.

    Returns:
      yaw: (I, L) rad, world.
      size: (I, 3) m.
      flat: (I, L, 2) m: length and width of the detections, along and across that yaw.
      shown: (I, L, 2) m: the same, with the track's where the sweep did not see the side.
    """
    yaw = _vote_yaw(paths, velocity, config)
    crossed = np.abs(wrap_axis(paths.yaw - yaw)) > np.pi / 4
    flat = np.where(crossed[..., None], paths.size[..., 1::-1], paths.size[..., :2])
    weight = np.minimum(paths.num_points, MAX_SIZE_POINTS) * np.where(crossed, CROSSED_WEIGHT, 1.0)
    weight = np.where(paths.hit, weight + CROSSED_WEIGHT, 0.0)
    size = np.einsum("il,ilk->ik", weight, paths.size) / weight.sum(axis=1)[:, None]
    extents = np.where((paths.hit & ~crossed)[..., None], paths.extent, -np.inf)
    size[:, :2] = np.maximum(size[:, :2], np.minimum(_top_extents(extents), MAX_GROWTH * size[:, :2]))
    unseen = extents <= SEEN_SHARE * size[:, None, :2]
    return yaw, size, flat, np.where(unseen, size[:, None, :2], flat)


def _top_extents(extents: np.ndarray) -> np.ndarray:
    """(I, 2) m: the quantile of the extents (I, L, 2) that count; 0 for tracks of few."""
    count = np.isfinite(extents[..., 0]).sum(axis=1)
    ordered = np.sort(extents, axis=1)
    index = extents.shape[1] - count + np.floor(SEEN_QUANTILE * np.maximum(count - 1, 0)).astype(int)
    top = np.take_along_axis(ordered, np.minimum(index, extents.shape[1] - 1)[:, None, None], axis=1)[:, 0]
    return np.where((count >= MIN_EXTENTS)[:, None], top, 0.0)


def _vote_yaw(paths: Paths, velocity: np.ndarray, config: TrackConfig) -> np.ndarray:
    """(I, L) rad: of all detections alike where a track stands, of those near in time where it moves."""
    weight = paths.score * np.sqrt(np.minimum(paths.num_points, MAX_YAW_POINTS)) + 1e-6
    weight = np.where(paths.hit, weight, 0.0)
    vote = weight * np.exp(2j * paths.yaw)
    speed = np.linalg.norm(velocity, axis=-1)
    near_vote, near_weight = (_near_sum(values, paths.step_s, YAW_MEMORY_S) for values in (vote, weight))
    course = np.exp(2j * np.arctan2(velocity[..., 1], velocity[..., 0]))
    near_vote += np.where(speed > config.course_speed_mps, COURSE_SHARE * near_weight, 0.0) * course
    all_votes = np.broadcast_to(vote.sum(axis=1)[:, None], vote.shape)
    return np.angle(np.where(_is_moving(paths, speed, config)[:, None], near_vote, all_votes)) / 2


def _is_moving(paths: Paths, speed: np.ndarray, config: TrackConfig) -> np.ndarray:
    """(I,) bool: whether tracks move at all, by median speed and length of path."""
    last = paths.length[:, None, None] - 1
    way = np.take_along_axis(paths.center[..., :2], last, axis=1)[:, 0] - paths.center[:, 0, :2]
    median = np.nanmedian(np.where(paths.valid, speed, np.nan), axis=1)
    return (median > config.moving_speed_mps) & (np.linalg.norm(way, axis=1) > MOVING_DISTANCE_M)


def _near_sum(values: np.ndarray, step_s: np.ndarray, memory_s: float) -> np.ndarray:
    """(I, L): sums in which a value counts exp(-t / memory) at a time t from it, in both directions."""
    keep = np.exp(-step_s / memory_s)
    before, after = values.copy(), values.copy()
    for k in range(1, values.shape[1]):
        before[:, k] += keep[:, k] * before[:, k - 1]
        after[:, -1 - k] += keep[:, -k] * after[:, -k]
    return before + after - values


def _smooth_height(paths: Paths) -> np.ndarray:
    """(I, L) m, world: height of the centre, the mean of the detections that are near in time."""
    total = _near_sum(np.where(paths.hit, paths.center[..., 2], 0.0), paths.step_s, HEIGHT_MEMORY_S)
    weight = _near_sum(paths.hit.astype(float), paths.step_s, HEIGHT_MEMORY_S)
    # In the middle of gaps of minutes, which are not shown, it is rounded to 0.
    return total / np.maximum(weight, np.finfo(float).tiny)


def _gaps(paths: Paths) -> np.ndarray:
    """(I, L) s: time between the detections before and after each moment; 0 at a detection."""
    moment = np.arange(paths.hit.shape[1])
    before = np.maximum.accumulate(np.where(paths.hit, moment, 0), axis=1)
    far = np.where(paths.hit, moment, len(moment) - 1)
    after = np.minimum.accumulate(far[:, ::-1], axis=1)[:, ::-1]
    time = np.cumsum(paths.step_s, axis=1)
    start, stop = (np.take_along_axis(time, index, axis=1) for index in (before, after))
    return stop - start


def _fronts(
    paths: Paths, yaw: np.ndarray, velocity: np.ndarray, moving: np.ndarray, first_turn: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the fronts point, without jumps, and how sure that is, by motion and profile of the whole track.

    Args:
      paths: I tracks.
      yaw: (I, L) rad, world.
      velocity: (I, L, 2) m/s.
      moving: (I, L) bool.
      first_turn: (I,) rad, of the sensor in the first sweep: the front of what neither moved nor has a
        profile is taken to point away from that sensor's back.

    Returns:
      heading (I, L) rad, and probability (I,).
    """
    heading = np.unwrap(yaw, period=np.pi, axis=1)
    start = wrap_axis(heading[:, 0] - first_turn) + first_turn
    heading = heading + (start - heading[:, 0])[:, None]
    along = velocity[..., 0] * np.cos(heading) + velocity[..., 1] * np.sin(heading)
    votes = np.sum(np.clip(along / FULL_FRONT_SPEED_MPS, -1, 1) * moving, axis=1)
    votes = votes + _profile_log_odds(paths, heading)
    heading = heading + np.where(votes < 0, np.pi, 0.0)[:, None]
    return heading, 1 / (1 + np.exp(-np.abs(votes)))


def _profile_log_odds(paths: Paths, heading: np.ndarray) -> np.ndarray:
    """(I,): of the front at these headings (I, L), as `shape.profile_log_odds` of all detections."""
    total = np.sum(paths.front_log_odds * np.cos(paths.yaw - heading), axis=1)
    log_odds = total / (1 + (paths.hit.sum(axis=1) - 1) * PROFILE_CORRELATION)
    return np.clip(log_odds, -MAX_PROFILE_LOG_ODDS, MAX_PROFILE_LOG_ODDS)


def _smooth_group(
    paths: Paths, tracks: Sequence[Tracks], T_world_sensor: np.ndarray, config: TrackConfig
) -> Columns:
    """All moments of a group of tracks that are shown, one row each."""
    variance = position_variance(paths, config)
    # A first pass over the centres tells speed and course, which the yaw depends on.
    _, velocity, _ = smooth_positions(paths.center[..., :2], variance, paths.step_s, config)
    yaw, size, flat, shown = _find_shapes(paths, velocity, config)
    sides = np.broadcast_to(size[:, None, :2], shown.shape)
    place = paths.center[..., :2]
    anchor = _keep_visible_faces(place, flat, yaw, sides, paths.sensor)
    position, velocity, covariance = smooth_positions(anchor, variance, paths.step_s, config)
    own = _keep_visible_faces(place, flat, yaw, shown, paths.sensor)
    motion, shift = classify_paths(position, velocity, covariance, paths, config)
    first = T_world_sensor[paths.first]
    first_turn = np.arctan2(first[:, 1, 0], first[:, 0, 0])
    moving = paths.valid & (motion != Motion.STANDING)
    heading, front_probability = _fronts(paths, yaw, velocity, moving, first_turn)
    hits = paths.hit.sum(axis=1)
    mean_score = paths.score.sum(axis=1) / hits
    belief = hits / (hits + BELIEVED_HITS) * (1 + BELIEVED_HITS / len(tracks))
    own_score = mean_score[:, None] ** MEAN_SCORE_SHARE * paths.score ** (1 - MEAN_SCORE_SHARE)
    z = _smooth_height(paths)[..., None]
    whole = np.broadcast_to(size[:, None], (*yaw.shape, 3))
    shown = np.concatenate([shown, whole[..., 2:]], axis=-1)
    weight = TRACK_WEIGHT * mean_score[:, None]
    # Poses drift by more than the place of what stands is known; what moves is seen from changing sides.
    share = np.where(paths.hit & ~moving, weight / np.maximum(weight + paths.score, 1e-6), 1.0)[..., None]
    columns = {
        "center": np.concatenate([own + share * (position - own), z], axis=-1),
        "size": shown + share * (whole - shown),
        "yaw": yaw,
        "heading": heading,
        "front_probability": np.broadcast_to(front_probability[:, None], yaw.shape),
        "velocity": velocity,
        "turn_rate": _turn_rate(heading, paths),
        "covariance": covariance,
        "motion": motion,
        "lateral_shift_m": shift,
        "score": belief[:, None] * np.where(paths.hit, own_score, mean_score[:, None]),
        "filtered_center": np.concatenate([position, z], axis=-1),
        "filtered_size": whole,
    }
    return _rows(paths, columns, paths.valid & (_gaps(paths) <= MAX_GAP_S), tracks, T_world_sensor)


def _turn_rate(heading: np.ndarray, paths: Paths) -> np.ndarray:
    """(I, L) rad/s: change of the heading, which goes on without jumps, around each moment."""
    time, rate = np.cumsum(np.maximum(paths.step_s, 1e-3), axis=1), np.zeros_like(heading)
    for track, length in enumerate(paths.length):
        if length > 1:
            rate[track, :length] = np.gradient(heading[track, :length], time[track, :length])
    return rate


def _rows(
    paths: Paths, columns: Columns, shown: np.ndarray, tracks: Sequence[Tracks], T_world_sensor: np.ndarray
) -> Columns:
    """Moments that are shown, a row each, in the sensor frame of their sweep."""
    sweep, slot = paths.sweep[shown], paths.slot[shown]
    rows = {name: values[shown] for name, values in columns.items()}
    T = T_world_sensor[sweep]
    turn = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    for name in ("center", "filtered_center"):
        rows[name] = np.einsum("nj,njk->nk", rows[name] - T[:, :3, 3], T[:, :3, :3])
    rows["velocity"] = _rotate(rows["velocity"], -turn)
    rows["yaw"] = rows["filtered_yaw"] = wrap_axis(rows["yaw"] - turn)
    rows["heading"] = (rows["heading"] - turn + np.pi) % (2 * np.pi) - np.pi
    for name in ("detection", "sight"):
        rows[name] = np.array([getattr(tracks[f], name)[s] for f, s in zip(sweep, slot, strict=True)])
    last = paths.sweep[:, -1], paths.slot[np.arange(len(paths.id)), paths.length - 1]
    of_track = {
        name: np.array([getattr(tracks[f], name)[s] for f, s in zip(*last, strict=True)])
        for name in ("label", "label_probability", "confirmed")
    }
    of_track["id"] = paths.id
    track, moment = np.nonzero(shown)
    rows |= {name: values[track] for name, values in of_track.items()}
    hits = np.cumsum(paths.hit, axis=1)[shown]
    return rows | {"sweep": sweep, "valid": np.ones(len(sweep), bool), "age": moment + 1, "hits": hits}
