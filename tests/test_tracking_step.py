"""The tracker's step: parity with the reference, laws, status bits, and bad input."""

import dataclasses
import functools
import io
import types

import chex
import jax
import numpy as np
import pytest
import traffic

import jaxbox
from jaxbox import PointCloud, reference
from jaxbox.io import open_sweeps
from jaxbox.tracking import (
    Motion,
    Observations,
    Sight,
    TrackConfig,
    TrackerState,
    TrackStatus,
    observe,
    track_sequence,
    track_step,
)

NUM_SLOTS = 24
AXES = ("yaw", "filtered_yaw")
TOLERANCE = 3e-4
"""Of float32 over a recording: m, m/s, rad; shares and probabilities are much closer."""

_step = jax.jit(track_step)
run_sequence = jax.jit(track_sequence)
STAY = np.eye(4, dtype=np.float32)


def step(state, seen, dt, T_previous_current, config=None):
    """One compiled step: settings and times are of one type, so that none makes another program."""
    dt, config = jax.tree.map(np.float32, (dt, TrackConfig() if config is None else config))
    return _step(state, seen, dt, T_previous_current, config)


@functools.cache
def recording(seed, dt=0.1):
    return traffic.simulate(seed, dt=dt)


def start(num_slots=NUM_SLOTS):
    return TrackerState.empty(num_slots)


def run(sweeps, state=None, config=None):
    """The last state and the tracks of all sweeps of a recording, (F, T, ...)."""
    state = start() if state is None else state
    config = jax.tree.map(np.float32, TrackConfig() if config is None else config)
    state, tracks = run_sequence(state, sweeps.seen, sweeps.dt, sweeps.T_previous_current, config)
    return jax.tree.map(np.asarray, state), tracks.on_host()


def walk(sweeps, state=None):
    """As `run`, by one step after the other: it needs no program of its own for another length."""
    state, rows = start() if state is None else state, []
    for index in range(len(sweeps)):
        state, tracks = step(state, *sweeps.sweep(index))
        rows.append(tracks)
    return jax.tree.map(np.asarray, (state, jax.tree.map(lambda *leaves: np.stack(leaves), *rows)))


def status_of(tracks):
    return TrackStatus(int(tracks.status))


def counts_of(tracks):
    return {name: int(count) for name, count in vars(tracks.counts).items()}


def turned_difference(a, b, period):
    """Difference of angles whose multiples of a period are the same."""
    return np.abs((a - b + period / 2) % period - period / 2)


def difference(name, ours, theirs, front_probability):
    """Absolute difference; a heading whose front is not known is that of an axis."""
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    if name in AXES:
        return turned_difference(ours, theirs, np.pi)
    if name == "heading":
        return turned_difference(ours, theirs, np.where(front_probability > 0.5, 2, 1) * np.pi)
    return np.abs(ours - theirs)


def assert_same_tracks(a, b, *, but=(), atol=0.0):
    """All outputs of valid slots are the same, but for some fields."""
    np.testing.assert_array_equal(a.valid, b.valid)
    for field in dataclasses.fields(a):
        if field.name in {"counts", *but}:
            continue
        ours, theirs = getattr(a, field.name), getattr(b, field.name)
        if field.name != "status":
            ours, theirs = ours[a.valid], theirs[b.valid]
        far = difference(field.name, ours, theirs, a.front_probability[a.valid])
        assert np.max(far, initial=0) <= atol, field.name
    chex.assert_trees_all_equal(a.counts, b.counts)


# Parity.


def assert_vehicle_is(vehicle, tracks, slot, tolerance):
    for name, theirs in (vars(vehicle) | {"sight": Sight[vehicle.sight].value}).items():
        ours = getattr(tracks, name)[slot]
        if ours.dtype.kind in "ib":
            assert ours == theirs, name
        else:
            far = np.max(difference(name, ours, theirs, tracks.front_probability[slot]))
            assert far <= tolerance, f"{name} of slot {slot}: {far}"


def assert_parity(sweeps, num_slots, config=None, tolerance=TOLERANCE):
    """Steps through a recording with both, and returns what was met."""
    state, tracker = start(num_slots), reference.Tracker([None] * num_slots)
    met = set()
    for index in range(len(sweeps)):
        state, tracks = step(state, *sweeps.sweep(index), config)
        tracker, sweep = reference.track_step(tracker, *sweeps.sweep(index), config)
        tracks = tracks.on_host()
        assert counts_of(tracks) == sweep.counts
        assert {bit.name for bit in status_of(tracks)} == sweep.status
        np.testing.assert_array_equal(tracks.valid, [vehicle is not None for vehicle in sweep.vehicles])
        for slot in np.flatnonzero(tracks.valid):
            vehicle = sweep.vehicles[slot]
            assert_vehicle_is(vehicle, tracks, slot, tolerance)
            met |= {vehicle.sight, Motion(vehicle.motion)}
        met |= {name for name, count in sweep.counts.items() if count}
        assert int(state.next_id) == tracker.next_id
    return met


@pytest.mark.parametrize(("dt", "num_slots"), [(0.1, NUM_SLOTS), (0.1, 11), (0.05, NUM_SLOTS), (0.37, 11)])
def test_every_output_is_that_of_the_reference(dt, num_slots):
    met = set()
    for seed in (3, 7):
        met |= assert_parity(recording(seed, dt), num_slots)
    everything = {"SEEN", "HIDDEN", "COASTING", "matched", "births", "low_scores", "deaths"}
    everything |= {Motion.STANDING, Motion.MOVING, Motion.STARTING, Motion.STOPPING, Motion.TURNING}
    everything |= {"inside_tracks", Motion.LANE_CHANGE} if (dt, num_slots) == (0.1, NUM_SLOTS) else set()
    everything |= {"dropped_births"} if num_slots < NUM_SLOTS else set()
    assert everything <= met


def test_other_settings_are_read_by_the_reference_and_the_step_alike():
    rng = np.random.default_rng(0)
    usual = TrackConfig()
    changed = TrackConfig(
        **{name: np.float32(value * rng.uniform(0.6, 1.6)) for name, value in vars(usual).items()}
    )
    changed = dataclasses.replace(changed, confirm_hits=1.0, max_misses=2.0, max_hidden=5.0, max_gap_s=2.0)
    assert_parity(recording(5), NUM_SLOTS, changed)


@functools.cache
def real_recording(data_root, name, count=10):
    sweeps = open_sweeps(data_root / "kitti_tracking" / "training" / "velodyne" / name)[:count]
    assert len(sweeps) == count
    clouds = [PointCloud.from_numpy(*sweep.read_points(), capacity=2**17) for sweep in sweeps]
    seen = [observe(jaxbox.detect(cloud)) for cloud in clouds]
    stacked = jax.tree.map(lambda *rows: np.stack([np.asarray(row) for row in rows]), *seen)
    # About how the car went; what it did exactly is no matter here.
    moved = np.stack([traffic.pose(1.2, 0.02, 0.01)] * count).astype(np.float32)
    return traffic.Recording(stacked, np.full(count, 0.1036, np.float32), moved)


@pytest.mark.parametrize("name", ["0000", "0003"])
def test_every_output_is_that_of_the_reference_on_real_sweeps(data_root, name):
    met = assert_parity(real_recording(data_root, name), 64)
    assert {"SEEN", "matched", "births", "deaths", Motion.STANDING, Motion.MOVING} <= met


# Laws.


def permuted(sweeps, seed):
    rng = np.random.default_rng(seed)
    num_sweeps, num_rows = sweeps.seen.valid.shape
    order = np.stack([rng.permutation(num_rows) for _ in range(num_sweeps)])
    of_sweep = np.arange(num_sweeps)[:, None]
    rows = {
        name: value if name == "first_return_m" else value[of_sweep, order]
        for name, value in vars(sweeps.seen).items()
    }
    return dataclasses.replace(sweeps, seen=Observations(**rows)), order


def test_the_order_of_detections_changes_nothing_but_their_rows():
    sweeps = recording(0)
    other, order = permuted(sweeps, 1)
    state, tracks = run(sweeps)
    other_state, other_tracks = run(other)
    chex.assert_trees_all_equal(state, other_state)
    assert_same_tracks(tracks, other_tracks, but={"detection"})
    of_sweep, slot = np.nonzero(other_tracks.detection >= 0)
    rows = order[of_sweep, other_tracks.detection[of_sweep, slot]]
    np.testing.assert_array_equal(rows, tracks.detection[of_sweep, slot])


def with_transform(sweeps, transform, turn=0.0, mirror=1):
    """The recording seen by a sensor whose frame is another: p' = transform p."""
    inverse = np.linalg.inv(transform)
    seen = sweeps.seen
    moved = np.asarray(transform @ sweeps.T_previous_current.astype(float) @ inverse, np.float32)
    center = seen.center.astype(float) @ transform[:3, :3].T
    first = seen.first_return_m
    cells = round(turn / (2 * np.pi) * first.shape[1])
    # Cell i of the mirrored world is the last but i of the other.
    first = np.roll(first[:, ::mirror], cells, axis=1)
    yaw = mirror * seen.yaw + np.float32(turn)
    seen = dataclasses.replace(seen, center=center.astype(np.float32), yaw=yaw, first_return_m=first)
    return dataclasses.replace(sweeps, seen=seen, T_previous_current=moved)


def test_in_a_turned_sensor_frame_everything_is_turned():
    sweeps, turn = recording(3), 2 * np.pi * 0.2
    transform = traffic.pose(yaw=turn)
    state, tracks = run(sweeps)
    other_state, other = run(with_transform(sweeps, transform, turn))
    assert int(state.next_id) == int(other_state.next_id)
    rotation = transform[:3, :3]
    expected = dataclasses.replace(
        tracks,
        center=tracks.center @ rotation.T,
        filtered_center=tracks.filtered_center @ rotation.T,
        velocity=tracks.velocity @ rotation[:2, :2].T,
        yaw=tracks.yaw + turn,
        heading=tracks.heading + turn,
        filtered_yaw=tracks.filtered_yaw + turn,
    )
    assert_same_tracks(expected, other, atol=TOLERANCE)
    assert {Sight.HIDDEN, Sight.COASTING, Sight.SEEN} <= set(tracks.sight[tracks.valid])


def test_a_mirrored_world_mirrors_everything():
    sweeps = recording(0)
    _, tracks = run(sweeps)
    _, other = run(with_transform(sweeps, np.diag([1.0, -1, 1, 1]), mirror=-1))
    flip = np.array([1.0, -1, 1])
    expected = dataclasses.replace(
        tracks,
        center=tracks.center * flip,
        filtered_center=tracks.filtered_center * flip,
        velocity=tracks.velocity * flip[:2],
        yaw=-tracks.yaw,
        heading=-tracks.heading,
        filtered_yaw=-tracks.filtered_yaw,
        turn_rate=-tracks.turn_rate,
        lateral_shift_m=-tracks.lateral_shift_m,
    )
    assert_same_tracks(expected, other, atol=TOLERANCE)
    assert (tracks.motion[tracks.valid] == Motion.LANE_CHANGE).any()


def test_more_rows_of_padding_and_more_slots_change_nothing():
    sweeps, more = recording(0), 17

    def pad(rows):
        return np.concatenate([rows, np.full((len(rows), more, *rows.shape[2:]), 7, rows.dtype)], axis=1)

    rows = {name: rows if name == "first_return_m" else pad(rows) for name, rows in vars(sweeps.seen).items()}
    rows["valid"][:, -more:] = False
    rows["score"][:, -more:] = np.nan
    padded = dataclasses.replace(sweeps, seen=Observations(**rows))
    (state, tracks), (other_state, other) = run(sweeps), run(padded, start(NUM_SLOTS + 9))
    assert not (tracks.status & TrackStatus.TRACK_OVERFLOW).any()
    assert not other.valid[:, NUM_SLOTS:].any()
    of_slots = {
        field.name: getattr(other, field.name)[:, :NUM_SLOTS]
        for field in dataclasses.fields(other)
        if field.name not in ("counts", "status")
    }
    assert_same_tracks(tracks, dataclasses.replace(other, **of_slots))
    first = dataclasses.replace(
        other_state, slots=jax.tree.map(lambda leaf: leaf[:NUM_SLOTS], other_state.slots)
    )
    chex.assert_trees_all_equal(state, first)


def test_a_sequence_is_the_steps_one_after_the_other():
    (state, tracks), (one_state, ones) = run(recording(1)), walk(recording(1))
    chex.assert_trees_all_close(one_state, state, rtol=1e-6, atol=2e-5)
    assert_same_tracks(tracks, ones, atol=2e-5)


def cut(sweeps, part):
    return traffic.Recording(*sweeps.sweep(part))


def row_of(tree, index):
    return jax.tree.map(lambda a: np.asarray(a[index]), tree)


def test_vmap_over_recordings_and_settings_is_each_by_itself():
    sweeps = [recording(seed).sweep(slice(None)) for seed in (3, 1, 3)]
    configs = [TrackConfig(), TrackConfig(), TrackConfig(gate=1.0)]
    stacked = jax.tree.map(lambda *rows: np.stack(rows), *sweeps)
    config = jax.tree.map(lambda *values: np.array(values, np.float32), *configs)
    together = jax.jit(jax.vmap(track_sequence, in_axes=(None, 0, 0, 0, 0)))
    state, tracks = together(start(), *stacked, config)
    assert int(state.next_id[0]) < int(state.next_id[2])
    for index, seed in enumerate((3, 1, 3)):
        one_state, one = run(recording(seed), config=configs[index])
        assert_same_tracks(one, row_of(tracks, index), atol=2e-5)
        chex.assert_trees_all_close(one_state, row_of(state, index), rtol=1e-6, atol=2e-5)


def test_one_trace_serves_all_sweeps_and_settings():
    counted = jax.jit(chex.assert_max_traces(track_step, n=1))
    state, sweeps = start(), recording(0)
    for index, gate in enumerate((16.0, 9.0, 4.0)):
        config = jax.tree.map(np.float32, TrackConfig(gate=gate))
        state, _ = counted(state, *sweeps.sweep(index), config)
    assert int(state.next_id) > 0


def test_types_are_those_of_the_state_whatever_the_promotion():
    # The suite runs under strict promotion of types and ranks.
    state = start()
    after, tracks = step(state, *recording(0).sweep(0))
    chex.assert_trees_all_equal_shapes_and_dtypes(state, after)
    floats = {leaf.dtype for leaf in jax.tree.leaves(tracks)}
    assert floats == {np.dtype(name) for name in ("float32", "int32", "bool")}


@pytest.mark.parametrize("seed", range(4))
def test_ids_rise_and_are_never_used_twice(seed):
    sweeps = recording(seed, 0.1)
    last, highest = {}, -1
    state, tracks = run(sweeps, start(11))
    ended = set()
    for ids in tracks.id:
        now = {int(number): slot for slot, number in enumerate(ids) if number >= 0}
        new = sorted(set(now) - set(last))
        assert new == list(range(highest + 1, highest + 1 + len(new)))
        assert not ended & set(now)
        assert all(last[number] == slot for number, slot in now.items() if number in last)
        ended |= set(last) - set(now)
        highest, last = highest + len(new), now
    assert int(state.next_id) == highest + 1
    assert ended


@pytest.mark.parametrize("num_slots", [11, NUM_SLOTS])
def test_every_detection_is_in_exactly_one_count(num_slots):
    for seed in range(3):
        _, tracks = run(recording(seed), start(num_slots))
        np.testing.assert_array_equal(tracks.counts.detections, recording(seed).seen.valid.sum(axis=1))
        np.testing.assert_array_equal(tracks.counts.tracks, tracks.valid.sum(axis=1))
        np.testing.assert_array_equal(
            tracks.counts.matched + tracks.counts.births, (tracks.detection >= 0).sum(axis=1)
        )
        living = np.cumsum(tracks.counts.births - tracks.counts.deaths)
        np.testing.assert_array_equal(living, tracks.counts.tracks)


def test_a_track_moves_no_further_from_its_prediction_than_the_gate_allows():
    config, sweeps, state, most = TrackConfig(), recording(0), start(), 0.0
    for index in range(len(sweeps)):
        seen, dt, motion = sweeps.sweep(index)
        before, (state, tracks) = state.slots, step(state, seen, dt, motion)
        kept = np.asarray((before.id == state.slots.id) & before.alive)
        T_current_previous = np.linalg.inv(motion.astype(float))
        flat, shift = T_current_previous[:2, :2], T_current_previous[:2, 3]
        ahead = np.asarray(before.position) + float(dt) * np.asarray(before.velocity)
        gap = np.linalg.norm(np.asarray(state.slots.position) - ahead @ flat.T - shift, axis=1)[kept]
        pp, pv, vv = np.asarray(before.covariance, float)[kept].T
        spread = pp + 2 * dt * pv + dt**2 * vv + dt**4 / 4 * config.acceleration_mps2**2
        row = np.asarray(tracks.detection)[kept]
        center, size = seen.center[row, :2], seen.size[row]
        noise = np.linalg.norm(center, axis=1) * config.position_sd_grade + config.position_sd_m
        # Where a box is made longer or shorter its centre moves besides.
        resized = np.linalg.norm(np.asarray(tracks.filtered_size)[kept, :2] - size[:, :2], axis=1) / 2
        crossed = np.linalg.norm(np.asarray(tracks.filtered_size)[kept, 1::-1] - size[:, :2], axis=1) / 2
        most_gap = np.sqrt(config.gate * (spread + noise**2 + config.placement_sd_m**2))
        assert (gap <= np.where(row < 0, 1e-4, most_gap + np.maximum(resized, crossed))).all()
        most = max(most, np.max(gap / most_gap, initial=0))
    assert most > 0.2


# Status bits and bad input.


def cars(places, **fields):
    """Observations of one sweep with cars at some places."""
    xyz = np.zeros((traffic.CAPACITY, 3))
    places = np.asarray(places, float).reshape(-1, 2)
    xyz[: len(places), :2] = places
    valid = np.arange(traffic.CAPACITY) < len(places)
    return traffic.observations(xyz, **({"valid": valid} | fields))


PLACES = [[10.0, 5.0], [20.0, -3.0], [-8.0, 6.0]]


def after_two():
    """A state after two sweeps of three cars that stand."""
    state, _ = step(start(), cars(PLACES), 0.1, STAY)
    return step(state, cars(PLACES), 0.1, STAY)


def test_a_usual_sweep_has_no_status_bit():
    state, tracks = after_two()
    assert status_of(tracks) == TrackStatus.OK
    assert tracks.id[:3].tolist() == [0, 1, 2]
    assert tracks.confirmed[:3].all()
    _, tracks = step(state, cars([]), 0.1, STAY)
    assert status_of(tracks) == TrackStatus.OK


@pytest.mark.parametrize("dt", [0.0, -0.1, np.nan, np.inf, -np.inf])
def test_a_sweep_that_is_not_later_is_passed_over(dt):
    state, _ = after_two()
    after, tracks = step(state, cars([[10.1, 5.0], [40.0, 40.0]]), dt, STAY)
    assert status_of(tracks) == TrackStatus.TIME_NOT_LATER
    chex.assert_trees_all_equal(after, state)
    assert counts_of(tracks) == dict.fromkeys(counts_of(tracks), 0) | {"tracks": 3}
    assert not (tracks.sight == Sight.SEEN)[tracks.valid].any()
    assert (tracks.detection == -1).all()
    # And the next one goes on.
    after, tracks = step(after, cars(PLACES), 0.1, STAY)
    assert status_of(tracks) == TrackStatus.OK
    assert tracks.id[:3].tolist() == [0, 1, 2]


@pytest.mark.parametrize("dt", [0.0, -1.0, np.nan, 3600.0])
def test_of_the_first_sweep_time_and_pose_are_not_read(dt):
    expected = step(start(), cars(PLACES), 0.1, STAY)
    got = step(start(), cars(PLACES), dt, np.full((4, 4), np.nan, np.float32))
    chex.assert_trees_all_equal(got, expected)
    assert status_of(got[1]) == TrackStatus.OK


def test_after_an_hour_all_tracks_end_and_new_ones_begin():
    state, _ = after_two()
    after, tracks = step(state, cars(PLACES), 3600.0, STAY)
    assert status_of(tracks) == TrackStatus.TIME_GAP
    assert tracks.id[:3].tolist() == [3, 4, 5]
    assert (int(tracks.counts.deaths), int(tracks.counts.births)) == (3, 3)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))
    _, tracks = step(state, cars(PLACES), 1.0, STAY)
    assert status_of(tracks) == TrackStatus.OK
    assert tracks.id[:3].tolist() == [0, 1, 2]


def test_sweeps_with_nearly_the_same_time_do_no_harm():
    sweeps = recording(0)
    state, _ = walk(cut(sweeps, slice(0, 30)))
    state, tracks = step(state, sweeps.sweep(30)[0], 1e-6, STAY)
    assert int(tracks.counts.matched) > 3
    for index in range(31, 36):
        state, tracks = step(state, *sweeps.sweep(index))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state, tracks)))
    assert np.abs(tracks.turn_rate).max() <= np.pi / 2 + 1e-6
    assert tracks.speed.max() < 40


BAD_POSES = {
    "NaN": np.full((4, 4), np.nan),
    "NaN translation": np.array(traffic.pose(np.nan)),
    "infinite": traffic.pose(np.inf),
    "reflection": np.diag([1.0, -1, 1, 1]),
    "scaled": np.diag([1.01, 1.01, 1.01, 1]),
    "zero": np.zeros((4, 4)),
    "sheared": traffic.pose() + np.eye(4, k=1) * [[0.1], [0], [0], [0]],
}


@pytest.mark.parametrize("name", BAD_POSES)
def test_a_pose_that_is_no_motion_is_taken_for_none(name):
    state, _ = after_two()
    expected_state, expected = step(state, cars(PLACES), 0.1, STAY)
    after, tracks = step(state, cars(PLACES), 0.1, BAD_POSES[name].astype(np.float32))
    assert status_of(tracks) == TrackStatus.POSE_INVALID
    chex.assert_trees_all_equal(after, expected_state)
    assert_same_tracks(tracks.on_host(), expected.on_host(), but={"status"})


@pytest.mark.parametrize(
    ("jump", "slow"),
    [
        (traffic.pose(7.1), traffic.pose(6.9)),
        (traffic.pose(z=-7.1), traffic.pose(z=-6.9)),
        (traffic.pose(yaw=np.radians(18.5)), traffic.pose(yaw=np.radians(17.5))),
    ],
    ids=["forward", "down", "turned"],
)
def test_where_a_pose_jumps_all_tracks_end(jump, slow):
    state, _ = after_two()
    after, tracks = step(state, cars(PLACES), 0.1, jump.astype(np.float32))
    assert status_of(tracks) == TrackStatus.POSE_JUMP
    assert tracks.id[:3].tolist() == [3, 4, 5]
    np.testing.assert_array_equal(after.slots.velocity[:3], 0)
    _, tracks = step(state, cars(PLACES), 0.1, slow.astype(np.float32))
    assert status_of(tracks) == TrackStatus.OK


@pytest.mark.parametrize("dt", [0.0, -0.1, np.nan])
def test_of_a_sweep_that_is_passed_over_no_pose_jumps(dt):
    state, _ = after_two()
    _, tracks = step(state, cars(PLACES), dt, traffic.pose(50.0).astype(np.float32))
    assert status_of(tracks) == TrackStatus.TIME_NOT_LATER
    assert tracks.id[:3].tolist() == [0, 1, 2], "all tracks go on"


def test_several_bits_are_set_together():
    state, _ = after_two()
    seen = cars([*PLACES, [30.0, 30.0]])
    seen.yaw[3] = np.nan
    _, tracks = step(state, seen, 3600.0, BAD_POSES["NaN"].astype(np.float32))
    expected = TrackStatus.TIME_GAP | TrackStatus.POSE_INVALID | TrackStatus.INVALID_DETECTIONS
    assert status_of(tracks) == expected
    # A jump over a gap is none.
    _, tracks = step(state, cars(PLACES), 3600.0, traffic.pose(1e6).astype(np.float32))
    assert status_of(tracks) == TrackStatus.TIME_GAP


@pytest.mark.parametrize("field", ["center", "size", "yaw", "score", "extent"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -1e30])
def test_detections_that_are_no_numbers_are_counted_and_left_out(field, value):
    state, _ = after_two()
    expected_state, expected = step(state, cars(PLACES), 0.1, STAY)
    seen = cars([*PLACES, [30.0, 30.0]])
    getattr(seen, field)[3] = value
    after, tracks = step(state, seen, 0.1, STAY)
    assert status_of(tracks) == TrackStatus.INVALID_DETECTIONS
    assert int(tracks.counts.invalid) == 1
    chex.assert_trees_all_equal(after, expected_state)
    assert_same_tracks(
        dataclasses.replace(tracks, counts=expected.counts).on_host(), expected.on_host(), but={"status"}
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tracks))


def test_the_best_scores_get_the_slots_and_the_rest_is_counted():
    places = np.stack([np.arange(20) * 5.0 - 50, np.full(20, 12.0)], axis=1)
    score = np.zeros(traffic.CAPACITY)
    score[:20] = np.random.default_rng(0).permutation(np.linspace(0.2, 0.9, 20))
    seen = cars(places, score=score)
    state, tracks = step(start(11), seen, 0.1, STAY)
    assert status_of(tracks) == TrackStatus.TRACK_OVERFLOW
    assert (int(tracks.counts.births), int(tracks.counts.dropped_births)) == (11, 9)
    np.testing.assert_array_equal(tracks.detection, np.argsort(-score)[:11])
    # All slots are taken; the bit stays as long as others are seen.
    state, tracks = step(state, seen, 0.1, STAY)
    assert int(tracks.counts.dropped_births) == 9
    assert int(state.next_id) == 11
    _, tracks = step(state, dataclasses.replace(seen, valid=score >= np.sort(score)[-11]), 0.1, STAY)
    assert status_of(tracks) == TrackStatus.OK


@pytest.mark.parametrize("num_rows", [0, 1])
def test_a_sweep_without_rows_has_no_vehicle(num_rows):
    state, _ = after_two()
    seen = traffic.observations(np.zeros((num_rows, 3)), valid=np.zeros(num_rows, bool))
    after, tracks = step(state, seen, 0.1, STAY)
    expected_state, expected = step(state, cars([]), 0.1, STAY)
    chex.assert_trees_all_equal(after, expected_state)
    assert_same_tracks(tracks.on_host(), expected.on_host())
    assert int(tracks.counts.tracks) == 3


def test_a_recording_of_empty_sweeps_has_no_track():
    num = len(recording(0))
    seen = jax.tree.map(lambda *a: np.stack(a), *[cars([]) for _ in range(num)])
    state, tracks = run(traffic.Recording(seen, np.full(num, 0.1, np.float32), np.stack([STAY] * num)))
    assert int(state.next_id) == 0
    assert not tracks.valid.any()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state, tracks)))


def test_a_recording_of_no_sweeps_leaves_the_state_as_it_was():
    state, tracks = run(cut(recording(0), slice(0, 0)))
    chex.assert_trees_all_equal(state, jax.tree.map(np.asarray, start()))
    assert tracks.id.shape == (0, NUM_SLOTS)


def test_a_cut_recording_goes_on_bit_for_bit_from_the_saved_state():
    sweeps = recording(0)
    whole_state, whole = walk(sweeps)
    state, first = walk(cut(sweeps, slice(0, 23)))
    leaves, structure = jax.tree.flatten(state)
    file = io.BytesIO()
    np.savez(file, *leaves)
    file.seek(0)
    with np.load(file) as saved:
        loaded = jax.tree.unflatten(structure, [saved[name] for name in saved.files])
    state, second = walk(cut(sweeps, slice(23, None)), loaded)
    chex.assert_trees_all_equal(state, whole_state)
    joined = jax.tree.map(lambda a, b: np.concatenate([a, b]), first, second)
    chex.assert_trees_all_equal(joined, whole)


def test_without_slots_there_is_no_tracker():
    with pytest.raises(ValueError, match="max_tracks is 0; it must be at least 1"):
        TrackerState.empty(0)


def test_every_status_bit_says_what_happened():
    for bit in TrackStatus:
        if bit:
            (text,) = bit.describe()
            assert text.startswith(f"{bit.name}: ")
            assert text.endswith(".")
    assert TrackStatus.OK.describe() == []
    assert len((TrackStatus.TIME_GAP | TrackStatus.POSE_JUMP).describe()) == 2


# What a user relies on.


def test_scores_labels_and_ages_are_those_of_the_detections():
    score, label = np.full(traffic.CAPACITY, 0.9), np.zeros(traffic.CAPACITY)
    state, before = step(start(), cars(PLACES, score=score, label=label), 0.1, STAY)
    _, tracks = step(state, cars(PLACES[:1], score=score / 3, label=label + 2), 0.1, STAY)
    assert tracks.score[0] == pytest.approx((0.9 + 0.3) / 2.5, abs=1e-6)
    # What is seen once may be chance.
    assert before.score[0] == pytest.approx(0.9 / 1.5, abs=1e-6)
    assert tracks.label[0] == 0
    shares = np.zeros(tracks.label_probability.shape[1])
    shares[[0, 2]] = 0.75, 0.25
    np.testing.assert_allclose(tracks.label_probability[0], shares, atol=1e-6)
    assert (int(tracks.age[0]), int(tracks.hits[0])) == (2, 2)
    # The others were seen once only, and are gone.
    assert tracks.valid.tolist() == [True] + [False] * (NUM_SLOTS - 1)


def test_what_is_not_seen_scores_less_the_less_its_place_is_known():
    state, before = after_two()
    sds_m, scores = [], [before.score[:3]]
    for _ in range(3):
        state, tracks = step(state, cars([]), 0.1, STAY)
        sds_m.append(np.sqrt(tracks.covariance[:3, 0]))
        scores.append(tracks.score[:3])
    mean = before.score[:3]
    expected = [mean * np.exp(-((sd_m / TrackConfig().unseen_sd_m) ** 2)) for sd_m in sds_m]
    np.testing.assert_allclose(scores[1:], expected, rtol=1e-5)
    assert (np.diff(scores, axis=0) < 0).all()
    # Seen again, it scores as its detections do: of three of them more than of two.
    _, tracks = step(state, cars(PLACES), 0.1, STAY)
    np.testing.assert_allclose(tracks.score[:3], mean * (3 / 3.5) / (2 / 2.5), rtol=1e-5)


def test_a_weak_box_hardly_moves_a_vehicle_that_is_known():
    state = start()
    for _ in range(8):
        state, before = step(state, cars(PLACES), 0.1, STAY)
    aside = np.add(PLACES, [0.0, 1.0])
    shifts, scores = [], []
    for score in (0.01, 0.2, 0.8):
        _, tracks = step(state, cars(aside, score=np.full(traffic.CAPACITY, score)), 0.1, STAY)
        assert tracks.id[:3].tolist() == [0, 1, 2]
        shift = np.linalg.norm(tracks.center[:3, :2] - before.center[:3, :2], axis=1)
        assert (shift <= 1 + 1e-5).all()
        shifts.append(shift)
        scores.append(tracks.score[:3])
    assert np.max(shifts[0]) < 0.4
    assert np.min(shifts[2]) > 0.6
    assert (np.diff(shifts, axis=0) > 0).all()
    # One weak detection of nine costs no more than its share, and less than not to be seen at all would.
    assert (np.diff(scores, axis=0) > 0).all()
    assert (scores[0] >= before.score[:3] * 8.5 / 9.5 - 1e-6).all()


def test_what_jumps_scores_less_than_what_moves_as_expected():
    rng = np.random.default_rng(0)
    state, ways = start(), np.zeros((3, 2))
    for k in range(20):
        # The first drives at 10 m/s, the second stands, the third jumps by decimetres to any side.
        ways[0] = k * 1.0, 0.0
        ways[2] = rng.choice([-0.3, 0.3], 2)
        state, tracks = step(state, cars(PLACES + ways), 0.1, STAY)
    assert tracks.id[:3].tolist() == [0, 1, 2]
    np.testing.assert_allclose(tracks.score[:2], tracks.score[1], rtol=0.01)
    assert tracks.score[2] < 0.8 * tracks.score[1]


def test_a_low_score_keeps_a_track_alive_but_begins_none():
    low = np.full(traffic.CAPACITY, 0.015)
    state, _ = after_two()
    _, tracks = step(state, cars([*PLACES, [30.0, 30.0]], score=low), 0.1, STAY)
    counts = counts_of(tracks)
    assert (counts["matched"], counts["low_scores"], counts["births"]) == (3, 1, 0)
    _, tracks = step(state, cars(PLACES, score=low / 10), 0.1, STAY)
    assert counts_of(tracks)["matched"] == 0
    assert counts_of(tracks)["inside_tracks"] == 3


def test_of_two_detections_the_one_of_a_high_score_comes_first():
    state, _ = after_two()
    score = np.full(traffic.CAPACITY, 0.8)
    score[0] = 0.05
    _, tracks = step(state, cars([[10.0, 5.0], [10.5, 5.0]], score=score), 0.1, STAY)
    assert int(tracks.detection[0]) == 1


@pytest.mark.parametrize(("hidden", "hits", "sweeps"), [(False, 40, 4), (True, 40, 30), (True, 7, 7)])
def test_a_track_that_is_missed_lives_as_long_as_it_is_told_or_was_seen(hidden, hits, sweeps):
    state = start()
    for _ in range(hits):
        state, _ = step(state, cars(PLACES), 0.1, STAY)
    first_return_m = np.full(traffic.NUM_AZIMUTHS, 2.0 if hidden else traffic.FAR_M)
    for _ in range(sweeps):
        state, tracks = step(state, cars([], first_return_m=first_return_m), 0.1, STAY)
        assert (tracks.sight[:3] == (Sight.HIDDEN if hidden else Sight.COASTING)).all()
        assert int(tracks.counts.tracks) == 3
    _, tracks = step(state, cars([], first_return_m=first_return_m), 0.1, STAY)
    assert (int(tracks.counts.tracks), int(tracks.counts.deaths)) == (0, 3)


def test_the_front_of_a_standing_car_is_that_of_its_profile_wherever_it_is_seen_from():
    state = start()
    for index in range(12):
        # The sensor drives in a circle; the car points along +y of the world. Its yaw is that of the axis.
        T_world_sensor = traffic.pose(0.5 * index, 0.0, 0.3 * index)
        T_world_before = traffic.pose(0.5 * (index - 1), 0.0, 0.3 * (index - 1)) if index else np.eye(4)
        place = (np.linalg.inv(T_world_sensor) @ [10, 5, 0, 1])[:3]
        heading = np.pi / 2 - 0.3 * index
        yaw = (heading + np.pi / 2) % np.pi - np.pi / 2
        seen = traffic.observations([place], yaw=[yaw], front_log_odds=[1.5 * np.sign(np.cos(heading - yaw))])
        moved = np.linalg.inv(T_world_before) @ T_world_sensor
        state, tracks = step(state, seen, 0.1, moved.astype(np.float32))
        assert int(tracks.id[0]) == 0
        assert turned_difference(float(tracks.heading[0]), heading, 2 * np.pi) < 0.05
        assert float(tracks.front_probability[0]) > 0.8
    assert float(tracks.front_probability[0]) < 1 / (1 + np.exp(-1.5 / 0.15))


def test_motion_outvotes_a_profile():
    state, headings = start(), []
    for index in range(40):
        place = [-20.0 + 0.8 * index, 8.0, 0.0]
        seen = traffic.observations([place], front_log_odds=[-8.0])
        state, tracks = step(state, seen, 0.1, STAY)
        headings.append(float(tracks.heading[0]))
    assert abs(headings[0]) == pytest.approx(np.pi, abs=1e-5)
    assert headings[-1] == pytest.approx(0, abs=0.01)
    assert float(tracks.front_probability[0]) > 0.99


@pytest.mark.parametrize(
    ("probability", "turned", "expected"),
    [(0.5, False, 0.0), (0.9, False, np.log(9)), (0.9, True, -np.log(9)), (1.0, False, np.log(1e6))],
)
def test_log_odds_of_a_detections_front_are_those_of_its_yaw(probability, turned, expected):
    yaw = np.linspace(-1.5, 1.5, 5, dtype=np.float32)
    found = types.SimpleNamespace(
        yaw=yaw,
        heading=yaw + np.float32(np.pi * turned),
        front_probability=np.full(5, probability, np.float32),
        hulls=types.SimpleNamespace(vertices=np.zeros((5, 3, 2), np.float32)),
        **dict.fromkeys(("center", "size", "score", "label", "num_points", "valid", "first_return_m")),
    )
    np.testing.assert_allclose(observe(found).front_log_odds, expected, rtol=0.02, atol=1e-6)


def test_a_car_that_drives_is_known_by_its_velocity_and_front():
    state = start()
    for index in range(25):
        # It drives backwards along x, and the ego vehicle forwards at 5 m/s.
        place = [30.0 - 1.0 * index - 0.5 * index, 4.0]
        state, tracks = step(state, cars([place]), 0.1, traffic.pose(0.5).astype(np.float32))
    assert tracks.id[0] == 0
    np.testing.assert_allclose(tracks.velocity[0], [-10, 0], atol=0.05)
    assert abs(float(tracks.heading[0])) == pytest.approx(np.pi, abs=1e-3)
    assert float(tracks.front_probability[0]) > 0.99
    assert int(tracks.motion[0]) == Motion.MOVING
    np.testing.assert_allclose(tracks.center[0], [-6.0, 4.0, 0.0], atol=0.1)
