"""One sweep more: the tracks of the sweep before, and the detections of this one.

A step is a fixed-shape function without host calls: it runs in `jax.lax.scan` over a recording, under
`jax.vmap` over recordings and settings, and next to `jaxbox.detect`.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxbox.config import Label, TrackConfig
from jaxbox.geometry.planar import rotate, wrap_yaw
from jaxbox.tracking import kalman, motion, shape
from jaxbox.tracking.association import associate, position_variance
from jaxbox.tracking.ego_motion import Interval, check_interval, to_current_frame
from jaxbox.tracking.state import Observations, Slots, TrackerState, empty_slots
from jaxbox.tracking.tracks import FREE, Sight, TrackCounts, Tracks, TrackStatus
from jaxbox.tracking.visibility import is_hidden
from jaxbox.types import combine_bits
from jaxbox.xla.sequences import scan_sequence

MAX_NUMBER = 1e6
"""A detection with a number beyond is no vehicle near a sensor; products of four such are finite still."""
Z_GAIN, FIRST_Z_GAIN = 0.3, 0.5
"""Share of the difference that corrects the height of the centre, and that of the first detections."""
EXPECTED_WITHIN_M = 1.2
"""A detection so far from where its track was expected supports it by exp(-1) of its score."""
DOUBTED_HITS = 0.5
"""So many detections of score 0 are counted with those of each track: what is seen once may be chance."""


def track_step(
    state: TrackerState,
    seen: Observations,
    dt: jax.Array | float,
    T_previous_current: jax.Array,
    config: TrackConfig | None = None,
) -> tuple[TrackerState, Tracks]:
    """Moves the tracks on by one sweep.

    Args:
      state: after the last sweep, or `TrackerState.empty`.
      seen: D detections of this sweep, in its sensor frame; see `observe`.
      dt: () float32, s since the last sweep; not read for the first one.
      T_previous_current: (4, 4) float32: from this sweep's sensor frame to the last one's, so the way of
        the ego vehicle; the identity where it is not known. Not read for the first sweep.
      config: of the tracker; None for the defaults.

    Returns:
      The state to go on with, and the T tracks of this sweep. Where the sweep is not later than the last one
      it is passed over: the state is as it was, nothing is counted, and no detection belongs to a track. Time
      and pose of the next sweep are since the last one that was not passed over.

    Reference: oracle `jaxbox.reference.tracking.track_step`; Kalman (1960) with the constant-velocity model;
    two stages as ByteTrack (Zhang et al., 2022).
    """
    config = _as_arrays(TrackConfig() if config is None else config)
    interval = check_interval(jnp.asarray(dt, jnp.float32), T_previous_current, state.started, config)
    seen = _with_rows(seen)
    order = jnp.argsort(-jnp.where(seen.valid, seen.score, -jnp.inf), stable=True)
    seen = _take(seen, order)
    slots = _end_all(state.slots, interval.restarts)
    predicted = predict(to_current_frame(slots, interval), interval.dt, config)
    finite = seen.valid & _is_plausible(seen)
    detection = associate(predicted, seen, finite & (seen.score >= config.low_score), config)
    updated = update(predicted, seen, detection, interval.dt, config)
    kept = forget(updated, seen.first_return_m, config)
    fates = sort_detections(kept, seen, finite, detection, config)
    slots, origin = begin_tracks(kept, seen, fates.new, state.next_id, config)
    slots = dataclasses.replace(slots, moving=slots.alive & motion.is_moving(slots, config))
    slots, moment_age_s = motion.remember(slots, state.moment_age_s, interval.dt)
    num_births = jnp.sum(origin < len(order), dtype=jnp.int32)
    after = TrackerState(slots, moment_age_s, state.next_id + num_births, jnp.ones((), bool))
    after = jax.tree.map(lambda old, new: jnp.where(interval.skipped, old, new), state, after)
    counts = _count(fates, num_births, state.slots.alive, kept.alive, after, interval.skipped)
    row = jnp.where(interval.skipped, len(order), jnp.minimum(detection, origin))
    return after, _answer(after, seen, row, order, counts, interval, config)


def _as_arrays(config: TrackConfig) -> TrackConfig:
    """Thresholds as float32, so that Python's numbers and arrays are one program."""
    return jax.tree.map(lambda value: jnp.asarray(value, jnp.float32), config)


class Fates(NamedTuple):
    """What becomes of each detection; a valid one is in exactly one of these, each (D,) bool."""

    matched: jax.Array
    """Belongs to a track."""
    new: jax.Array
    """Begins a track, if a slot is free."""
    inside: jax.Array
    """Its centre lies in the box of a track: it is a duplicate of that vehicle."""
    low: jax.Array
    """Its score is too low to begin a track."""
    invalid: jax.Array
    """It has NaN, infinite or enormous numbers."""


def _with_rows(seen: Observations) -> Observations:
    """The detections; an empty list gets one invalid row, because gathers need at least one."""
    if seen.valid.shape[0] > 0:
        return seen
    rows = jax.tree.map(lambda a: jnp.zeros((1, *a.shape[1:]), a.dtype), seen)
    return dataclasses.replace(rows, first_return_m=seen.first_return_m)


def _take(seen: Observations, order: jax.Array) -> Observations:
    """The detections in another order."""
    rows = jax.tree.map(lambda a: a[order], dataclasses.replace(seen, first_return_m=order))
    return dataclasses.replace(rows, first_return_m=seen.first_return_m)


def _is_plausible(seen: Observations) -> jax.Array:
    rows = jnp.stack([seen.yaw, seen.score, seen.front_log_odds], axis=1)
    numbers = [seen.center, seen.size, seen.extent, rows]
    # Anything compared with NaN is False.
    return jnp.all(jnp.abs(jnp.concatenate(numbers, axis=1)) <= MAX_NUMBER, axis=1)


def _end_all(slots: Slots, ends: jax.Array) -> Slots:
    return dataclasses.replace(slots, id=jnp.where(ends, FREE, slots.id))


def predict(slots: Slots, dt: jax.Array, config: TrackConfig) -> Slots:
    """Predicts tracks at constant velocity and turn rate.

    Args:
      slots: T tracks.
      dt: () float32, s.
      config: of the tracker.

    Returns:
      The slots.
    """
    turn = slots.turn_rate * dt
    return dataclasses.replace(
        slots,
        position=slots.position + dt * slots.velocity,
        covariance=kalman.predict_covariance(slots.covariance, dt, config.acceleration_mps2),
        yaw_vote=rotate(slots.yaw_vote, 2 * turn),
        front_vote=rotate(slots.front_vote, turn),
        profile_vote=rotate(slots.profile_vote, turn),
        age=slots.age + 1,
    )


def update(
    slots: Slots, seen: Observations, detection: jax.Array, dt: jax.Array, config: TrackConfig
) -> Slots:
    """Updates tracks with their detections, and counts a miss for the others.

    Args:
      slots: T predicted tracks.
      seen: D detections.
      detection: (T,) int32, row of each track's, D for none.
      dt: () float32, s.
      config: of the tracker.

    Returns:
      The slots.
    """
    is_hit = detection < seen.valid.shape[0]
    own = _take(seen, jnp.minimum(detection, seen.valid.shape[0] - 1))
    learned = _learn(slots, own, dt, config)
    missed = dataclasses.replace(slots, misses=slots.misses + 1)
    return _where(is_hit, learned, missed)


def _where(condition: jax.Array, yes: Slots, no: Slots) -> Slots:
    """Rows of one where a condition (T,) holds, and of the other elsewhere."""

    def choose(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(condition.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, yes, no)


def _learn(slots: Slots, own: Observations, dt: jax.Array, config: TrackConfig) -> Slots:
    """Tracks after a detection each, `own`."""
    vote, turn_rate = shape.update_yaw(slots, own, dt, config)
    turned = dataclasses.replace(slots, yaw_vote=vote, turn_rate=turn_rate)
    crossed = shape.is_crossed(own.yaw, turned.yaw)
    sized = dataclasses.replace(
        turned,
        size_sum=slots.size_sum + shape.size_sums(own, crossed),
        extent=shape.update_extent(slots, own, crossed),
    )
    flat = jnp.where(crossed[:, None], own.size[:, 1::-1], own.size[:, :2])
    size = shape.track_size(sized)[:, :2]
    center = shape.keep_visible_faces(own.center[:, :2], flat, turned.yaw, size)
    variance = position_variance(own.center, config)
    variance = kalman.outlier_variance(slots.position, slots.covariance, center, variance)
    position, velocity, covariance = kalman.update(
        slots.position, slots.velocity, slots.covariance, center, variance
    )
    moved = dataclasses.replace(sized, position=position, velocity=velocity, covariance=covariance)
    z_gain = jnp.where(slots.hits > shape.MATURE_HITS, Z_GAIN, FIRST_Z_GAIN)
    return dataclasses.replace(
        moved,
        z=slots.z + z_gain * (own.center[:, 2] - slots.z),
        front_vote=shape.update_front(moved),
        profile_vote=slots.profile_vote + shape.profile_votes(own),
        score_sum=slots.score_sum + _agreement(slots, center) * own.score,
        label_score=slots.label_score + _label_score(own),
        hits=slots.hits + 1,
        misses=jnp.zeros_like(slots.misses),
        hidden=jnp.zeros_like(slots.hidden),
        hidden_now=jnp.zeros_like(slots.hidden_now),
    )


def _agreement(slots: Slots, center: jax.Array) -> jax.Array:
    """(T,) float32, in (0, 1]: how well detections at (T, 2) m lie where their tracks were expected.

    The box of a vehicle that is there moves as its track says; clutter and other vehicles jump. A track whose
    velocity is not known yet expects nothing.
    """
    distance_sq = kalman.squared_distance(slots.position, center)
    return jnp.where(slots.hits < shape.MATURE_HITS, 1.0, jnp.exp(-distance_sq / EXPECTED_WITHIN_M**2))


def _label_score(seen: Observations) -> jax.Array:
    """(D, L) float32: the score of each detection under its class."""
    return jax.nn.one_hot(seen.label, len(Label), dtype=jnp.float32) * seen.score[:, None]


def _is_confirmed(slots: Slots, config: TrackConfig) -> jax.Array:
    """(T,) bool: whether tracks were detected often enough."""
    return slots.hits.astype(jnp.float32) >= config.confirm_hits


def forget(slots: Slots, first_return_m: jax.Array, config: TrackConfig) -> Slots:
    """Ends tracks without detections: soon where they would be visible, later where they are hidden.

    Args:
      slots: T tracks after the sweep.
      first_return_m: (A,) float32, m.
      config: of the tracker.

    Returns:
      The slots, those of ended tracks free.
    """
    size = shape.track_size(slots)[:, :2]
    is_missed = slots.misses > 0
    hidden = is_hidden(slots.position, size, slots.yaw, first_return_m, config) & is_missed
    num_hidden = slots.hidden + hidden.astype(jnp.int32)
    num_visible = (slots.misses - num_hidden).astype(jnp.float32)
    # What was seen twice has no velocity to be followed for seconds.
    max_hidden = jnp.minimum(config.max_hidden, slots.hits.astype(jnp.float32))
    lives = (num_visible <= config.max_misses) & (num_hidden.astype(jnp.float32) <= max_hidden)
    lives = ~is_missed | (lives & _is_confirmed(slots, config))
    remembered = dataclasses.replace(slots, hidden=num_hidden, hidden_now=hidden)
    return _where(lives & slots.alive, remembered, empty_slots(slots.id.shape[0]))


def sort_detections(
    slots: Slots, seen: Observations, finite: jax.Array, detection: jax.Array, config: TrackConfig
) -> Fates:
    """Says what becomes of each detection.

    Args:
      slots: T tracks that live on.
      seen: D detections.
      finite: (D,) bool: valid, and all numbers finite.
      detection: (T,) int32, row of each track's, D for none.
      config: of the tracker.

    Returns:
      The fates.
    """
    matched = jnp.zeros(finite.shape[0], bool).at[detection].set(True, mode="drop")
    size = shape.track_size(slots)[:, :2]
    offset = rotate(seen.center[None, :, :2] - slots.position[:, None], -slots.yaw[:, None])
    inside = jnp.all(jnp.abs(offset) < size[:, None] / 2, axis=-1) & slots.alive[:, None]
    inside = finite & ~matched & jnp.any(inside, axis=0)
    alone = finite & ~matched & ~inside
    is_high = seen.score >= config.birth_score
    return Fates(matched, alone & is_high, inside, alone & ~is_high, seen.valid & ~finite)


def begin_tracks(
    slots: Slots, seen: Observations, new: jax.Array, next_id: jax.Array, config: TrackConfig
) -> tuple[Slots, jax.Array]:
    """Puts new vehicles into free slots, those with the best scores first.

    Args:
      slots: T tracks, and free slots.
      seen: D detections, best score first.
      new: (D,) bool, which of them begin a track.
      next_id: () int32, id of the first.
      config: of the tracker.

    Returns:
      The slots, and (T,) int32: row of the detection that began the slot's track now, D for none.
    """
    num_detections = new.shape[0]
    rank = jnp.cumsum(new, dtype=jnp.int32) - 1
    row_of_rank = jnp.full(num_detections, num_detections, jnp.int32)
    place = jnp.where(new, rank, num_detections)
    row_of_rank = row_of_rank.at[place].set(jnp.arange(num_detections, dtype=jnp.int32), mode="drop")
    free = ~slots.alive
    free_rank = jnp.where(free, jnp.cumsum(free, dtype=jnp.int32) - 1, num_detections)
    origin = jnp.take(row_of_rank, free_rank, mode="fill", fill_value=num_detections)
    own = _take(seen, jnp.minimum(origin, num_detections - 1))
    fresh = dataclasses.replace(_first_seen(own, config), id=next_id + free_rank)
    return _where(origin < num_detections, fresh, slots), origin


def _first_seen(seen: Observations, config: TrackConfig) -> Slots:
    """Slots as one detection each tells, without an id."""
    num = seen.valid.shape[0]
    variance = position_variance(seen.center, config)
    speed_variance = jnp.full_like(variance, config.birth_speed_sd_mps**2)
    return dataclasses.replace(
        empty_slots(num),
        position=seen.center[:, :2],
        z=seen.center[:, 2],
        covariance=jnp.stack([variance, jnp.zeros_like(variance), speed_variance], axis=1),
        yaw_vote=shape.yaw_weight(seen)[:, None] * shape.doubled(seen.yaw),
        profile_vote=shape.profile_votes(seen),
        size_sum=shape.size_sums(seen, jnp.zeros(num, bool)),
        extent=seen.extent,
        score_sum=seen.score,
        label_score=_label_score(seen),
        hits=jnp.ones(num, jnp.int32),
        age=jnp.ones(num, jnp.int32),
    )


def _count(
    fates: Fates,
    num_births: jax.Array,
    lived: jax.Array,
    kept: jax.Array,
    after: TrackerState,
    skipped: jax.Array,
) -> TrackCounts:
    """Counts of the sweep; none of a sweep that is passed over."""

    def count(flags: jax.Array) -> jax.Array:
        return jnp.where(skipped, 0, jnp.sum(flags, dtype=jnp.int32))

    births = jnp.where(skipped, 0, num_births)
    return TrackCounts(
        matched=count(fates.matched),
        births=births,
        dropped_births=count(fates.new) - births,
        inside_tracks=count(fates.inside),
        low_scores=count(fates.low),
        invalid=count(fates.invalid),
        deaths=count(lived & ~kept),
        tracks=jnp.sum(after.slots.alive, dtype=jnp.int32),
    )


def _answer(
    state: TrackerState,
    seen: Observations,
    row: jax.Array,
    order: jax.Array,
    counts: TrackCounts,
    interval: Interval,
    config: TrackConfig,
) -> Tracks:
    """The tracks of the sweep: with a box between its detection and the track's own, else with that."""
    slots, alive = state.slots, state.slots.alive
    is_seen = alive & (row < len(order))
    own = _take(seen, jnp.minimum(row, len(order) - 1))
    center = jnp.concatenate([slots.position, slots.z[:, None]], axis=1)
    size, yaw = shape.track_size(slots), wrap_yaw(slots.yaw)
    own_center, own_size, own_yaw = shape.refine_boxes(slots, own)
    shown_yaw = jnp.where(is_seen, own_yaw, yaw)
    mean_score = slots.score_sum / (slots.hits.astype(jnp.float32) + DOUBTED_HITS)
    share = shape.track_share(slots, mean_score, own.score)[:, None]
    # The variance over a square would be 0 / 0 in free slots, where the setting is the smallest allowed.
    sd_m = jnp.sqrt(slots.covariance[:, 0])
    expected_score = mean_score * jnp.exp(-((sd_m / config.unseen_sd_m) ** 2))
    heading, front_probability = shape.front_of(shown_yaw, slots)
    motions, shift = motion.classify(slots, state.moment_age_s, config)
    missed = jnp.where(slots.hidden_now, Sight.HIDDEN.value, Sight.COASTING.value)
    bits = {
        TrackStatus.TRACK_OVERFLOW: counts.dropped_births > 0,
        TrackStatus.INVALID_DETECTIONS: counts.invalid > 0,
    }
    label_sum = jnp.sum(slots.label_score, axis=1, keepdims=True)
    return Tracks(
        id=slots.id,
        valid=alive,
        confirmed=alive & _is_confirmed(slots, config),
        age=slots.age,
        hits=slots.hits,
        sight=jnp.where(is_seen, Sight.SEEN.value, missed).astype(jnp.int32),
        detection=jnp.where(is_seen, order[jnp.minimum(row, len(order) - 1)], FREE).astype(jnp.int32),
        motion=motions,
        lateral_shift_m=shift,
        label=jnp.argmax(slots.label_score, axis=1).astype(jnp.int32),
        label_probability=slots.label_score / jnp.maximum(label_sum, 1e-6),
        score=jnp.where(is_seen, mean_score, expected_score),
        center=jnp.where(is_seen[:, None], own_center + share * (center - own_center), center),
        size=jnp.where(is_seen[:, None], own_size + share * (size - own_size), size),
        yaw=shown_yaw,
        heading=heading,
        front_probability=front_probability,
        velocity=slots.velocity,
        turn_rate=slots.turn_rate,
        covariance=slots.covariance,
        filtered_center=center,
        filtered_size=size,
        filtered_yaw=yaw,
        counts=counts,
        status=interval.status + combine_bits(bits),
    )


def track_sequence(
    state: TrackerState,
    seen: Observations,
    dt: jax.Array,
    T_previous_current: jax.Array,
    config: TrackConfig | None = None,
) -> tuple[TrackerState, Tracks]:
    """Steps over a recording whose detections are all known: `track_step` of one sweep after the other.

    Args:
      state: before the first sweep.
      seen: the detections of F sweeps, (F, D, ...).
      dt: (F,) float32, s, since the sweep before.
      T_previous_current: (F, 4, 4) float32, from each sweep's sensor frame to that of the sweep before.
      config: of the tracker; None for the defaults.

    Returns:
      The last state, and the tracks of each sweep, (F, T, ...).
    """

    def step(state: TrackerState, sweep: Any) -> tuple[TrackerState, Tracks]:
        observations, dt_s, motion_of_sweep = sweep
        return track_step(state, observations, dt_s, motion_of_sweep, config)

    return scan_sequence(step, state, (seen, dt, T_previous_current))
