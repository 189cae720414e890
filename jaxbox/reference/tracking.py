"""Tracks from sweep to sweep, as objects: one `Track` a vehicle, full matrices, loops over all pairs.

A pair of an axis and its opposite, such as a yaw, is a complex number whose angle is twice that of the axis.
"""

import copy
import dataclasses
import itertools
import math
from typing import Any

import numpy as np

from jaxbox.config import Label, TrackConfig
from jaxbox.reference import vehicle_motion, vehicle_shape
from jaxbox.reference.tracks import (
    MATURE_HITS,
    Interval,
    Track,
    TrackedSweep,
    TrackedVehicle,
    Tracker,
    rotation_about_z,
)

RIGID_TOLERANCE = 1e-3
"""Entries of R R^T may differ from those of the identity by this."""
MAX_TURN_DEG_PER_S = 180.0
"""No vehicle turns faster."""
MAX_NUMBER = 1e6
"""A detection with a number beyond is no vehicle near a sensor."""
FIRST_INTERVAL_S = 0.1
"""What is taken for the time before the first sweep."""
Z_GAIN, FIRST_Z_GAIN = 0.3, 0.5
"""Share of the difference that corrects the height of the centre, and that of the first detections."""
EXPECTED_WITHIN_M = 1.2
"""A detection so far from where its track was expected supports it by exp(-1) of its score."""
DOUBTED_HITS = 0.5
"""So many detections of score 0 are counted with those of each track: what is seen once may be chance."""
OUTLIER_SDS = 3.0
"""Positions farther from what is expected count as if they were less certain, so that they lie so far."""
NUM_RAYS = 24
"""Azimuths over a box at which the nearest return is looked up."""


def track_step(
    tracker: Tracker, seen: Any, dt: float, T_previous_current: np.ndarray, config: TrackConfig | None = None
) -> tuple[Tracker, TrackedSweep]:
    """Moves the tracks on by one sweep.

    Args:
      tracker: after the last sweep; it is left as it is.
      seen: D detections, with the attributes of `jaxbox.tracking.Observations`.
      dt: s, since the last sweep.
      T_previous_current: (4, 4), from this sweep's sensor frame to the last one's.
      config: of the tracker; None for the defaults.

    Returns:
      The tracker to go on with, and the vehicles of this sweep.
    """
    config = TrackConfig() if config is None else config
    interval = check_interval(float(dt), np.asarray(T_previous_current, float), tracker.started, config)
    if interval.skipped:
        return tracker, _passed_over(tracker, interval, config)
    tracker = copy.deepcopy(tracker)
    tracker.time_s += interval.dt
    num_before = len(tracker.tracks())
    if interval.restarts:
        tracker.slots = [None] * len(tracker.slots)
    for track in tracker.tracks():
        to_current_frame(track, interval)
        predict(track, interval.dt, config)
    rows = _in_order_of_score(seen)
    finite = [row for row in rows if _is_plausible(seen, row)]
    pairs = associate(tracker, seen, finite, config)
    for slot, track in tracker.numbered():
        if slot in pairs:
            learn(track, seen, pairs[slot], interval.dt, config)
        else:
            track.misses += 1
    forget(tracker, np.asarray(seen.first_return_m, float), config)
    num_kept = len(tracker.tracks())
    counts = {"matched": len(pairs), "invalid": len(rows) - len(finite), "deaths": num_before - num_kept}
    alone = [row for row in finite if row not in pairs.values()]
    born, fates = begin_tracks(tracker, seen, alone, config)
    for track in tracker.tracks():
        track.moving = vehicle_motion.is_moving(track, config)
    vehicle_motion.remember(tracker)
    tracker.started = True
    counts |= fates | {"tracks": len(tracker.tracks())}
    status = set(interval.status)
    status |= {"TRACK_OVERFLOW"} if counts["dropped_births"] else set()
    status |= {"INVALID_DETECTIONS"} if counts["invalid"] else set()
    vehicles = describe_all(tracker, seen, pairs | born, config)
    return tracker, TrackedSweep(vehicles, counts, frozenset(status))


def check_interval(dt: float, T_previous_current: np.ndarray, started: bool, config: TrackConfig) -> Interval:
    """Judges time and pose: what cannot be believed is replaced, and said.

    Args:
      dt: s, since the last sweep.
      T_previous_current: (4, 4), from this sweep's sensor frame to the last one's.
      started: whether there was a last one.
      config: of the tracker.

    Returns:
      The interval.
    """
    stands = Interval(FIRST_INTERVAL_S, np.eye(3), np.zeros(3), skipped=False, restarts=False)
    if not started:
        return stands
    status = set()
    is_later = math.isfinite(dt) and dt > 0
    seconds = dt if is_later else FIRST_INTERVAL_S
    is_gap = is_later and dt > float(config.max_gap_s)
    rotation, translation = T_previous_current[:3, :3], T_previous_current[:3, 3]
    rigid = _is_rotation(rotation) and bool(np.isfinite(translation).all())
    jumps = rigid and _jumps(rotation, translation, seconds, config)
    if not is_later:
        status.add("TIME_NOT_LATER")
    if is_gap:
        status.add("TIME_GAP")
    elif jumps and is_later:
        status.add("POSE_JUMP")
    if not rigid:
        status.add("POSE_INVALID")
    if rigid and not jumps and not is_gap:
        stands = dataclasses.replace(stands, rotation=rotation, translation=translation)
    return dataclasses.replace(
        stands,
        dt=seconds,
        skipped=not is_later,
        restarts=is_later and (is_gap or jumps),
        status=frozenset(status),
    )


def _is_rotation(matrix: np.ndarray) -> bool:
    if not np.isfinite(matrix).all():
        return False
    is_orthogonal = np.abs(matrix @ matrix.T - np.eye(3)).max() < RIGID_TOLERANCE
    return bool(is_orthogonal) and float(np.linalg.det(matrix)) > 0


def _jumps(rotation: np.ndarray, translation: np.ndarray, dt: float, config: TrackConfig) -> bool:
    # Of the eigenvalues 1, exp(i a) and exp(-i a) of a rotation by a.
    angle = np.abs(np.angle(np.linalg.eigvals(rotation))).max()
    too_far = np.linalg.norm(translation) > float(config.max_ego_speed_mps) * dt
    return bool(too_far or np.degrees(angle) > MAX_TURN_DEG_PER_S * dt)


def to_current_frame(track: Track, interval: Interval) -> None:
    """Sees a track from where the sensor is now.

    Args:
      track: in the sensor frame of the last sweep; changed.
      interval: since then.
    """
    turn = -math.atan2(interval.rotation[1, 0], interval.rotation[0, 0])
    turned, flat = rotation_about_z(turn), rotation_about_z(turn)[:2, :2]
    track.position = np.linalg.inv(interval.rotation) @ (track.position - interval.translation)
    track.velocity = flat @ track.velocity
    both = np.kron(np.eye(2), flat)
    track.covariance = both @ track.covariance @ both.T
    track.yaw_vote *= np.exp(2j * turn)
    track.front_vote *= np.exp(1j * turn)
    track.profile_vote *= np.exp(1j * turn)
    for moment in track.path:
        away = np.array([*moment.position, 0.0]) - interval.translation
        moment.position = (turned @ away)[:2]
        moment.velocity = flat @ moment.velocity


def predict(track: Track, dt: float, config: TrackConfig) -> None:
    """Where a track is expected after a time.

    Args:
      track: changed.
      dt: s.
      config: of the tracker.
    """
    step = np.block([[np.eye(2), dt * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
    by_acceleration = np.concatenate([dt**2 / 2 * np.eye(2), dt * np.eye(2)])
    state = step @ np.concatenate([track.position[:2], track.velocity])
    track.position[:2], track.velocity = state[:2], state[2:]
    noise = float(config.acceleration_mps2) ** 2 * by_acceleration @ by_acceleration.T
    track.covariance = step @ track.covariance @ step.T + noise
    track.yaw_vote *= np.exp(2j * track.turn_rate * dt)
    track.front_vote *= np.exp(1j * track.turn_rate * dt)
    track.profile_vote *= np.exp(1j * track.turn_rate * dt)
    track.age += 1


def position_variance(center: np.ndarray, config: TrackConfig) -> float:
    """Variance of a detected position along each axis, m^2.

    Args:
      center: (3,) m, sensor frame.
      config: of the tracker.

    Returns:
      The variance.
    """
    range_m = math.hypot(center[0], center[1])
    return (float(config.position_sd_m) + float(config.position_sd_grade) * range_m) ** 2


def _in_order_of_score(seen: Any) -> list[int]:
    """Rows of valid detections, best score first; those without a number last."""
    score, valid = np.asarray(seen.score, float), np.asarray(seen.valid)
    return sorted(np.flatnonzero(valid).tolist(), key=lambda row: (math.isnan(score[row]), -score[row]))


def _is_plausible(seen: Any, row: int) -> bool:
    names = ("center", "size", "extent", "yaw", "score", "front_log_odds")
    numbers = np.concatenate([np.ravel(getattr(seen, name)[row]) for name in names])
    # Anything compared with NaN is False.
    return bool((np.abs(numbers) <= MAX_NUMBER).all())


def associate(tracker: Tracker, seen: Any, rows: list[int], config: TrackConfig) -> dict[int, int]:
    """Takes all pairs in the gate in the order of their cost, each track and detection once.

    Args:
      tracker: with the tracks where they are expected.
      seen: D detections.
      rows: those to match.
      config: of the tracker.

    Returns:
      Row of the detection by slot.
    """
    costs = []
    for (slot, track), row in itertools.product(tracker.numbered(), rows):
        if float(seen.score[row]) < float(config.low_score):
            continue
        center = np.asarray(seen.center[row], float)
        noise = position_variance(center, config) + float(config.placement_sd_m) ** 2
        spread = track.covariance[:2, :2] + noise * np.eye(2)
        gap = center[:2] - track.position[:2]
        distance_sq = gap @ np.linalg.inv(spread) @ gap
        if distance_sq < float(config.gate):
            cost = distance_sq + np.log(np.linalg.det(spread))
            costs.append((bool(seen.score[row] < config.high_score), cost, slot, row))
    pairs: dict[int, int] = {}
    for _, _, slot, row in sorted(costs):
        if slot not in pairs and row not in pairs.values():
            pairs[slot] = row
    return pairs


def learn(track: Track, seen: Any, row: int, dt: float, config: TrackConfig) -> None:
    """What a track learns from its detection.

    Args:
      track: predicted; changed.
      seen: D detections.
      row: of its own.
      dt: s.
      config: of the tracker.
    """
    center, score = np.asarray(seen.center[row], float), float(seen.score[row])
    size = vehicle_shape.learn_shape(track, seen, row, dt, config)
    place = vehicle_shape.keep_visible_faces(center[:2], size, track.yaw, track.size()[:2])
    innovation = float(np.linalg.norm(place - track.position[:2]))
    knows_velocity = track.hits >= MATURE_HITS
    agreement = math.exp(-((innovation / EXPECTED_WITHIN_M) ** 2)) if knows_velocity else 1.0
    least = (innovation / OUTLIER_SDS) ** 2 - track.covariance[0, 0]
    correct(track, place, max(position_variance(center, config), least))
    z_gain = Z_GAIN if track.hits > MATURE_HITS else FIRST_Z_GAIN
    track.position[2] += z_gain * (center[2] - track.position[2])
    vehicle_shape.vote_front(track)
    track.profile_vote += vehicle_shape.profile_vote(seen, row)
    track.score_sum += score * agreement
    track.label_scores[int(seen.label[row])] += score
    track.hits += 1
    track.misses = track.hidden = 0
    track.hidden_now = False


def correct(track: Track, measured: np.ndarray, variance: float) -> None:
    """The Kalman filter's update by a measured position.

    Args:
      track: changed.
      measured: (2,) m.
      variance: m^2, along each axis.
    """
    sees = np.eye(2, 4)
    spread = sees @ track.covariance @ sees.T + variance * np.eye(2)
    gain = track.covariance @ sees.T @ np.linalg.inv(spread)
    change = gain @ (measured - track.position[:2])
    track.position[:2] += change[:2]
    track.velocity = track.velocity + change[2:]
    rest = np.eye(4) - gain @ sees
    # Joseph's form.
    track.covariance = rest @ track.covariance @ rest.T + variance * gain @ gain.T


def is_hidden(track: Track, first_return_m: np.ndarray, config: TrackConfig) -> bool:
    """Whether more than a share of the azimuths over a track's box have a return well before it.

    Args:
      track: in the sensor frame.
      first_return_m: (A,) m, from azimuth -pi on.
      config: of the tracker.

    Returns:
      Whether it is hidden.
    """
    corners = vehicle_shape.corners(track.position[:2], track.size()[:2], track.yaw)
    middle = math.atan2(track.position[1], track.position[0])
    offsets = [math.remainder(math.atan2(y, x) - middle, 2 * math.pi) for x, y in corners]
    nearest = vehicle_shape.distance_to_sensor(track.position[:2], track.size()[:2], track.yaw)
    num_before = 0
    for offset in np.linspace(min(offsets), max(offsets), NUM_RAYS):
        turns = (middle + offset) / (2 * math.pi) + 1 / 2
        cell = math.floor(turns * len(first_return_m)) % len(first_return_m)
        num_before += first_return_m[cell] < nearest - float(config.hidden_gap_m)
    return bool(num_before / NUM_RAYS > float(config.hidden_share))


def forget(tracker: Tracker, first_return_m: np.ndarray, config: TrackConfig) -> None:
    """Ends tracks that miss their detections.

    Args:
      tracker: after the sweep; changed.
      first_return_m: (A,) m.
      config: of the tracker.
    """
    for slot, track in tracker.numbered():
        if track.misses == 0:
            continue
        track.hidden_now = is_hidden(track, first_return_m, config)
        track.hidden += track.hidden_now
        is_gone = track.misses - track.hidden > float(config.max_misses)
        is_gone |= track.hidden > min(float(config.max_hidden), track.hits)
        if is_gone or track.hits < float(config.confirm_hits):
            tracker.slots[slot] = None


def begin_tracks(
    tracker: Tracker, seen: Any, rows: list[int], config: TrackConfig
) -> tuple[dict[int, int], dict[str, int]]:
    """Puts new vehicles into free slots, those with the best scores first.

    Args:
      tracker: with the tracks that live on; changed.
      seen: D detections.
      rows: those without a track, best score first.
      config: of the tracker.

    Returns:
      Row of the detection by the slot that it began, and how many began none for which reason.
    """
    counts: dict[str, int] = {}
    counts |= dict.fromkeys(("births", "dropped_births", "inside_tracks", "low_scores"), 0)
    kept = tracker.tracks()
    free = [slot for slot, track in enumerate(tracker.slots) if track is None]
    born: dict[int, int] = {}
    for row in rows:
        center = np.asarray(seen.center[row], float)
        if any(vehicle_shape.is_inside(center[:2], track) for track in kept):
            counts["inside_tracks"] += 1
        elif seen.score[row] < config.birth_score:
            counts["low_scores"] += 1
        elif len(born) == len(free):
            counts["dropped_births"] += 1
        else:
            slot = free[len(born)]
            born[slot] = row
            tracker.slots[slot] = first_seen(seen, row, tracker.next_id, config)
            tracker.next_id += 1
            counts["births"] += 1
    return born, counts


def first_seen(seen: Any, row: int, number: int, config: TrackConfig) -> Track:
    """A track as one detection tells.

    Args:
      seen: D detections.
      row: of the detection.
      number: id of the track.
      config: of the tracker.

    Returns:
      The track.
    """
    center, score = np.asarray(seen.center[row], float), float(seen.score[row])
    variances = [position_variance(center, config)] * 2 + [float(config.birth_speed_sd_mps) ** 2] * 2
    label_scores = np.zeros(len(Label))
    label_scores[int(seen.label[row])] = score
    return Track(
        id=number,
        position=center,
        velocity=np.zeros(2),
        covariance=np.diag(variances),
        yaw_vote=vehicle_shape.yaw_vote(seen, row),
        profile_vote=vehicle_shape.profile_vote(seen, row),
        size_sums=vehicle_shape.size_sums(seen, row, crossed=False),
        extent=np.asarray(seen.extent[row], float),
        score_sum=score,
        label_scores=label_scores,
    )


def describe_all(
    tracker: Tracker, seen: Any, row_of: dict[int, int], config: TrackConfig
) -> list[TrackedVehicle | None]:
    """What is said of the tracks of a sweep, None for a free slot.

    Args:
      tracker: after the sweep.
      seen: D detections.
      row_of: row of the detection by slot.
      config: of the tracker.

    Returns:
      A vehicle a slot.
    """
    return [
        None if track is None else describe(track, seen, row_of.get(slot), tracker, config)
        for slot, track in enumerate(tracker.slots)
    ]


def describe(
    track: Track, seen: Any, row: int | None, tracker: Tracker, config: TrackConfig
) -> TrackedVehicle:
    """What is said of a track: with a box between its own and that of its detection, where there is one.

    Args:
      track: after the sweep.
      seen: D detections.
      row: of its detection.
      tracker: with the times of the moments of its path.
      config: of the tracker.

    Returns:
      The vehicle.
    """
    own = vehicle_shape.Box(track.position.copy(), track.size(), vehicle_shape.wrap_yaw(track.yaw))
    score = track.score_sum / (track.hits + DOUBTED_HITS)
    if row is None:
        shown, score = own, score * math.exp(-track.covariance[0, 0] / float(config.unseen_sd_m) ** 2)
    else:
        of_sweep = vehicle_shape.refine_box(track, seen, row)
        share = vehicle_shape.track_share(track, score, float(seen.score[row]))
        center = (1 - share) * of_sweep.center + share * own.center
        size = (1 - share) * of_sweep.size + share * own.size
        shown = vehicle_shape.Box(center, size, of_sweep.yaw)
    heading, front_probability = vehicle_shape.front_of(shown.yaw, track)
    motion, shift = vehicle_motion.classify(track, tracker, config)
    missed = "HIDDEN" if track.hidden_now else "COASTING"
    return TrackedVehicle(
        id=track.id,
        confirmed=track.hits >= float(config.confirm_hits),
        age=track.age,
        hits=track.hits,
        sight=missed if row is None else "SEEN",
        detection=-1 if row is None else row,
        motion=int(motion),
        lateral_shift_m=shift,
        label=int(np.argmax(track.label_scores)),
        label_probability=track.label_scores / track.label_scores.sum(),
        score=score,
        center=shown.center,
        size=shown.size,
        yaw=shown.yaw,
        heading=heading,
        front_probability=front_probability,
        velocity=track.velocity.copy(),
        turn_rate=track.turn_rate,
        covariance=track.covariance[[0, 0, 2], [0, 2, 2]],
        filtered_center=own.center,
        filtered_size=own.size,
        filtered_yaw=own.yaw,
    )


def _passed_over(tracker: Tracker, interval: Interval, config: TrackConfig) -> TrackedSweep:
    names = ("matched", "births", "dropped_births", "inside_tracks", "low_scores", "invalid", "deaths")
    counts = dict.fromkeys(names, 0) | {"tracks": len(tracker.tracks())}
    return TrackedSweep(describe_all(tracker, None, {}, config), counts, interval.status)
