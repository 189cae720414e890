"""The parts of the tracker's step, each against a law or the textbook's matrices."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import traffic

from jaxbox.config import TrackConfig
from jaxbox.tracking import Motion, TrackerState, kalman, motion, shape, track_step, visibility
from jaxbox.tracking.state import empty_slots

CONFIG = TrackConfig()
STAY = np.eye(4, dtype=np.float32)
_step = jax.jit(track_step)


def step(state, seen, dt, T_previous_current, config=CONFIG):
    """One compiled step, whose times and settings are of one type: all tests share its program."""
    dt, config = jax.tree.map(np.float32, (dt, config))
    return _step(state, seen, dt, T_previous_current, config)


# The filter.


def textbook(covariance, dt, acceleration):
    """(4, 4) predicted covariance of x, y and their velocities, and the matrix of the motion."""
    pp, pv, vv = covariance
    full = np.kron([[pp, pv], [pv, vv]], np.eye(2))
    motion_matrix = np.kron([[1, dt], [0, 1]], np.eye(2))
    by_acceleration = np.kron([[dt**2 / 2], [dt]], np.eye(2))
    noise = acceleration**2 * by_acceleration @ by_acceleration.T
    return motion_matrix @ full @ motion_matrix.T + noise, motion_matrix


@pytest.mark.parametrize("seed", range(5))
def test_the_filter_is_that_of_full_matrices(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(2, 2))
    covariance = (root @ root.T)[[0, 0, 1], [0, 1, 1]].astype(np.float32)
    position, velocity, measured = rng.normal(0, 5, (3, 2)).astype(np.float32)
    dt, acceleration, variance = rng.uniform(0.05, 0.5), rng.uniform(1, 5), rng.uniform(0.01, 1)
    predicted = kalman.predict_covariance(jnp.asarray(covariance), jnp.float32(dt), acceleration)
    full, _ = textbook(covariance.astype(float), dt, acceleration)
    np.testing.assert_allclose(predicted, full[[0, 0, 2], [0, 2, 2]], rtol=1e-5)

    got = kalman.update(position, velocity, predicted, measured, jnp.float32(variance))
    sees = np.eye(2, 4)
    gain = full @ sees.T @ np.linalg.inv(sees @ full @ sees.T + variance * np.eye(2))
    state = np.concatenate([position, velocity]) + gain @ (measured - position)
    after = (np.eye(4) - gain @ sees) @ full
    np.testing.assert_allclose(np.concatenate(got[:2]), state, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(got[2], after[[0, 0, 2], [0, 2, 2]], rtol=2e-4, atol=1e-6)


def test_a_measurement_without_noise_is_believed_and_one_of_much_noise_is_not():
    covariance = jnp.array([1.0, 0.5, 2.0])
    start = jnp.zeros(2), jnp.ones(2), covariance
    position, _, after = kalman.update(*start, jnp.array([3.0, -4.0]), jnp.float32(1e-9))
    np.testing.assert_allclose(position, [3, -4], atol=1e-5)
    np.testing.assert_allclose(after, [0, 0, 2 - 0.5**2], atol=1e-5)
    same = kalman.update(*start, jnp.array([3.0, -4.0]), jnp.float32(1e9))
    np.testing.assert_allclose(np.concatenate(same), np.concatenate(start), atol=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_an_outlier_lies_three_standard_deviations_off_and_others_are_believed(seed):
    rng = np.random.default_rng(seed)
    position, covariance = rng.normal(0, 5, (200, 2)), rng.uniform(0.01, 1, (200, 3))
    variance, turn = rng.uniform(0.01, 1, 200), rng.uniform(-np.pi, np.pi, 200)
    sds = np.where(np.arange(200) % 2, rng.uniform(0, 2.9, 200), rng.uniform(3.1, 40, 200))
    spread = covariance[:, 0] + variance
    gap = sds[:, None] * np.sqrt(spread)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    operands = (position, covariance, position + gap, variance)
    raised = np.asarray(kalman.outlier_variance(*(np.float32(operand) for operand in operands)))
    usual = sds < 3
    np.testing.assert_array_equal(raised[usual], np.float32(variance[usual]))
    left = np.sum(gap**2, axis=1) / (covariance[:, 0] + raised)
    np.testing.assert_allclose(left[~usual], 9, rtol=1e-3)


def test_one_box_metres_aside_does_not_throw_a_track():
    """A car at 10 m/s whose box of one sweep is of its other face: 1.5 m behind."""
    at = np.arange(12) * 1.0
    at[8] -= 1.5
    state = TrackerState.empty(1)
    for k, x in enumerate(at):
        seen = traffic.observations([[x, 5.0, 0.0]])
        state, tracks = step(state, seen, 0.1, STAY)
        if k >= 8:
            assert int(tracks.id[0]) == 0
            np.testing.assert_allclose(tracks.velocity[0], [10, 0], atol=1.0)
    np.testing.assert_allclose(tracks.filtered_center[0, :2], [11, 5], atol=0.1)


# Visibility.


def is_hidden(center, first_return_m, size=(4.0, 1.8), yaw=0.0):
    operands = (np.asarray([value], np.float32) for value in (center, size, yaw))
    return bool(visibility.is_hidden(*operands, np.asarray(first_return_m, np.float32), CONFIG)[0])


def wall(middle, half, range_m, num_azimuths=1440):
    """First returns of a wall that is seen in some azimuths, nothing elsewhere."""
    azimuth = -np.pi + 2 * np.pi * (np.arange(num_azimuths) + 0.5) / num_azimuths
    inside = np.abs((azimuth - middle + np.pi) % (2 * np.pi) - np.pi) < half
    return np.where(inside, range_m, 200.0)


@pytest.mark.parametrize("azimuth", [0.0, 1.0, np.pi - 0.01, np.pi, -np.pi, -3.0])
def test_a_car_behind_a_wall_is_hidden_and_one_before_or_beside_it_is_not(azimuth):
    center = 20 * np.array([np.cos(azimuth), np.sin(azimuth)])
    assert is_hidden(center, wall(azimuth, 0.3, 10.0))
    assert not is_hidden(center, wall(azimuth, 0.3, 30.0))
    assert not is_hidden(center, wall(azimuth + 0.7, 0.3, 10.0))
    assert not is_hidden(center, wall(azimuth + np.pi, 0.3, 10.0))
    # A wall over 0.4 of it, and over 0.6: it is .2 rad wide.
    across = azimuth + np.pi / 2
    for share, hidden in ((0.4, False), (0.6, True)):
        half_width = np.arctan2(2, 20 - 0.9)
        edge = wall(azimuth - half_width + share * half_width, share * half_width, 10.0)
        assert is_hidden(center, edge, yaw=across) == hidden


def test_its_own_returns_do_not_hide_a_car_however_long_and_near():
    for size in ((4.0, 1.8), (14.0, 2.5)):
        for gap, hidden in ((0.5, False), (0.9, True)):
            assert is_hidden((0.0, 5.0), np.full(1440, 5.0 - size[1] / 2 - gap), size) == hidden
    # The sensor is in the box.
    assert not is_hidden((0.3, 0.2), np.full(1440, 0.5))


# Shape.


def slots_of(num=1, **fields):
    """Slots of vehicles that were detected ten times, with some fields."""
    usual = {
        "id": np.arange(num, dtype=np.int32),
        "hits": np.full(num, 10, np.int32),
        "size_sum": np.tile(np.float32([420, 180, 150, 100]), (num, 1)),
        "yaw_vote": np.tile(np.float32([10, 0]), (num, 1)),
    }
    return dataclasses.replace(empty_slots(num), **(usual | fields))


def test_the_extent_settles_at_its_quantile():
    rng = np.random.default_rng(0)
    extents = rng.uniform(2, 4, (2000, 1, 2)).astype(np.float32)
    slots, trail = slots_of(hits=np.int32([0])), []
    update = jax.jit(shape.update_extent)
    for extent in extents:
        seen = traffic.observations(np.zeros((1, 3)), extent=extent)
        moved = update(slots, seen, np.zeros(1, bool))
        slots = dataclasses.replace(slots, extent=moved, hits=slots.hits + 1)
        trail.append(np.asarray(moved[0]))
    # The quantile .9 of 2 to 4 m is 3.8.
    np.testing.assert_allclose(np.mean(trail[500:], axis=0), 3.8, atol=0.06)
    assert np.std(trail[500:], axis=0).max() < 0.15
    np.testing.assert_array_equal(update(slots, seen, np.ones(1, bool)), slots.extent)


@pytest.mark.parametrize(
    ("center", "kept"),
    [
        ((20.0, 10.0), [(-1, 0), (0, -1)]),
        ((-20.0, 10.0), [(1, 0), (0, -1)]),
        ((20.0, -10.0), [(-1, 0), (0, 1)]),
        ((20.0, 0.5), [(-1, 0)]),
        ((-0.5, -9.0), [(0, 1)]),
    ],
)
def test_faces_towards_the_sensor_stay_where_they_are(center, kept):
    size, new_size = np.float32([[4.0, 1.8]]), np.float32([[5.0, 1.5]])
    for yaw in (0.0, np.pi):
        got = np.asarray(shape.keep_visible_faces(np.float32([center]), size, np.float32([yaw]), new_size))[0]
        for axis in (0, 1):
            sides = [side for side in kept if side[axis]]
            if sides:
                face = np.array(center)[axis] + sides[0][axis] * size[0, axis] / 2
                assert got[axis] + sides[0][axis] * new_size[0, axis] / 2 == pytest.approx(face, abs=1e-5)
            else:
                assert got[axis] == pytest.approx(center[axis], abs=1e-5)


def test_a_track_is_as_long_as_what_was_seen_but_not_much_longer_than_its_boxes():
    extent = np.float32([[4.0, 2.0], [4.8, 1.0], [9.0, 9.0], [9.0, 9.0]])
    slots = slots_of(4, extent=extent, hits=np.int32([10, 10, 10, 3]))
    expected = [[4.2, 2.0, 1.5], [4.8, 1.8, 1.5], [1.25 * 4.2, 1.25 * 1.8, 1.5], [4.2, 1.8, 1.5]]
    np.testing.assert_allclose(shape.track_size(slots), expected, rtol=1e-6)


def test_votes_find_the_front_and_say_how_sure_they_are():
    slots = slots_of(
        3, moving=np.array([True, True, False]), velocity=np.float32([[-6.0, 0], [1.5, 0], [6.0, 0]])
    )
    for _ in range(4):
        slots = dataclasses.replace(slots, front_vote=shape.update_front(slots))
    np.testing.assert_allclose(slots.front_vote, [[-4, 0], [2, 0], [0, 0]], atol=1e-6)
    heading, probability = shape.front_of(jnp.full(3, 0.1), slots)
    np.testing.assert_allclose(heading, [0.1 - np.pi, 0.1, 0.1], atol=1e-6)
    votes = np.array([4, 2, 0]) * np.cos(0.1)
    np.testing.assert_allclose(probability, 1 / (1 + np.exp(-votes)), rtol=1e-6)


def profile_log_odds(log_odds, yaw=0.0):
    """Log odds of the front at a yaw, after detections at yaw 0 with these log odds of theirs."""
    seen = traffic.observations(np.zeros((len(log_odds), 3)), front_log_odds=log_odds)
    vote = np.asarray(shape.profile_votes(seen)).sum(axis=0, keepdims=True)
    slots = slots_of(profile_vote=vote, hits=np.int32([len(log_odds)]))
    return float(shape.profile_log_odds(np.float32([[np.cos(yaw), np.sin(yaw)]]), slots)[0])


def test_profiles_of_several_sweeps_count_as_normal_variables_with_one_correlation():
    rng = np.random.default_rng(0)
    for num in (1, 2, 7):
        # Log odds of the front: of 2 m C^-1 x with the mean m and the covariance C, here of unit variance.
        covariance = np.full((num, num), shape.PROFILE_CORRELATION)
        np.fill_diagonal(covariance, 1.0)
        values, mean = rng.normal(0.3, 1, num), np.full(num, 0.3)
        expected = 2 * mean @ np.linalg.inv(covariance) @ values
        assert profile_log_odds(2 * 0.3 * values) == pytest.approx(expected, rel=1e-5)


def test_many_sweeps_of_a_weak_profile_are_no_certainty():
    weak = np.log(0.6 / 0.4)
    assert profile_log_odds([weak]) == pytest.approx(weak, rel=1e-6)
    assert profile_log_odds([weak] * 50) < profile_log_odds([weak] * 500) < weak / shape.PROFILE_CORRELATION
    assert 1 / (1 + np.exp(-profile_log_odds([weak] * 50))) < 0.92
    for sign in (-1, 1):
        assert profile_log_odds([sign * 9.0] * 50) == pytest.approx(sign * shape.MAX_PROFILE_LOG_ODDS)


def test_a_profile_says_nothing_of_the_front_across_it_and_the_opposite_behind():
    log_odds = [1.0, 2.0, -0.5]
    assert profile_log_odds(log_odds, np.pi / 2) == pytest.approx(0, abs=1e-6)
    assert profile_log_odds(log_odds, np.pi) == pytest.approx(-profile_log_odds(log_odds), rel=1e-5)


def test_headings_are_in_their_interval():
    yaw = np.linspace(-np.pi / 2, np.pi / 2, 1001, endpoint=False, dtype=np.float32)
    yaw = np.concatenate([yaw, np.nextafter(np.float32(0), np.float32([-1, 1])), np.float32([0])])
    for sign in (-1, 1):
        vote = sign * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        heading, _ = shape.front_of(yaw, slots_of(len(yaw), front_vote=vote))
        assert (np.abs(np.sin(np.asarray(heading, float) - yaw)) < 1e-6).all()
        assert (heading >= np.float32(-np.pi)).all()
        assert (heading < np.float32(np.pi)).all()


def test_one_quarter_turn_is_outvoted_and_changes_neither_size_nor_extent():
    state = TrackerState.empty(1)
    for index in range(12):
        crossed = index == 8
        seen = traffic.observations(
            np.float32([[12.0, 7.0, 0.0]]), yaw=[0.3 + crossed * np.pi / 2], size=[[4.2, 1.8, 1.5]]
        )
        before = state.slots
        state, tracks = step(state, seen, 0.1, STAY)
        assert tracks.yaw[0] == pytest.approx(0.3, abs=1e-4)
        np.testing.assert_allclose(tracks.filtered_size[0], [4.2, 1.8, 1.5], atol=1e-3)
        if crossed:
            np.testing.assert_array_equal(state.slots.extent, before.extent)
            # The length of the box that lies across is not taken for the track's width.
            np.testing.assert_allclose(tracks.size[0], [4.2, 1.8, 1.5], atol=1e-3)


def test_boxes_whose_points_were_not_counted_have_a_yaw_all_the_same():
    state = TrackerState.empty(1)
    for _ in range(6):
        seen = traffic.observations(np.float32([[12.0, 7.0, 0.0]]), yaw=[0.7], num_points=[0])
        state, tracks = step(state, seen, 0.1, STAY)
    assert tracks.yaw[0] == pytest.approx(0.7, abs=1e-5)
    np.testing.assert_allclose(tracks.size[0], [4.2, 1.8, 1.5], atol=1e-5)


@pytest.mark.parametrize(("course_weight", "tolerance"), [(0.0, 0.01), (3.0, 0.1)])
def test_the_turn_rate_follows_a_car_that_turns(course_weight, tolerance):
    # The course of a car that turns lags behind, and where it votes the turn rate makes up for that.
    config = TrackConfig(course_weight=course_weight)
    rate, state = 0.4, TrackerState.empty(1)
    for index in range(60):
        yaw = rate * 0.1 * index
        place = 20 * np.array([np.sin(yaw), 1 - np.cos(yaw)]) + [5, 5]
        seen = traffic.observations(np.float32([[*place, 0.0]]), yaw=[yaw])
        state, tracks = step(state, seen, 0.1, STAY, config)
    assert tracks.turn_rate[0] == pytest.approx(rate, abs=tolerance)
    assert np.abs(np.sin(tracks.yaw[0] - yaw)) < 0.02
    assert np.cos(tracks.heading[0] - yaw) > 0.999


# What a vehicle does.


def speeds_of(name, times):
    """Speed (m/s) and course (rad) at some times of a car that does one thing from 7 s on."""
    since = np.maximum(times - 7, 0)
    speed, course = np.full(len(times), 10.0), np.zeros(len(times))
    if name is Motion.STANDING:
        speed[:] = 0
    elif name is Motion.STARTING:
        speed = np.minimum(1.5 * since, 10)
    elif name is Motion.STOPPING:
        speed = np.maximum(5 - 2 * since, 0)
    elif name is Motion.TURNING:
        course = np.radians(25) * since
    elif name is Motion.LANE_CHANGE:
        # 3.5 m to the left in 3 s.
        course = np.arctan(3.5 / 10 / 3 * (1 - np.cos(2 * np.pi * np.clip(since / 3, 0, 1))))
    return speed, course


def states_of(name, rate_hz, seconds=13.0, fine=100):
    """Times, states and shifts that the tracker says of a car on an exact path."""
    times = np.arange(0, seconds, 1 / fine)
    speed, course = speeds_of(name, times)
    way = np.cumsum(speed[:, None] / fine * np.stack([np.cos(course), np.sin(course)], axis=1), axis=0)
    state, said = TrackerState.empty(1), []
    for index in range(0, len(times), round(fine / rate_hz)):
        center = np.float32([[*(way[index] + [-40, 12]), 0]])
        seen = traffic.observations(center, yaw=course[[index]])
        state, tracks = step(state, seen, 1 / rate_hz, STAY)
        said.append((times[index], Motion(int(tracks.motion[0])), float(tracks.lateral_shift_m[0])))
    assert int(state.next_id) == 1
    return said


def between(said, first_s, last_s):
    return {motion for time, motion, _ in said if first_s <= time <= last_s}


@pytest.mark.parametrize("rate_hz", [10, 20, 2.5])
@pytest.mark.parametrize("name", [Motion.STANDING, Motion.MOVING])
def test_what_stands_stands_and_what_drives_drives(name, rate_hz):
    # A velocity takes two sweeps; that it was 0 before is no start.
    assert between(states_of(name, rate_hz), 0.5, 13.0) == {name}


@pytest.mark.parametrize("rate_hz", [10, 20, 2.5])
@pytest.mark.parametrize(
    ("name", "begins_s", "ends_s", "before", "after"),
    [
        (Motion.STARTING, 9.1, 9.9, Motion.STANDING, Motion.MOVING),
        (Motion.STOPPING, 8.1, 9.0, Motion.MOVING, Motion.STANDING),
        (Motion.TURNING, 8.5, 13.0, Motion.MOVING, Motion.TURNING),
    ],
)
def test_starting_stopping_and_turning_are_seen_within_the_time_they_take(
    name, begins_s, ends_s, before, after, rate_hz
):
    said = states_of(name, rate_hz)
    assert between(said, 5.0, 6.9) == {before}
    assert between(said, begins_s, ends_s) == {name}
    assert between(said, 12.5, 13.0) == {after}
    assert between(said, 5.0, 13.0) <= {name, before, after, Motion.MOVING}


@pytest.mark.parametrize("rate_hz", [10, 20, 2.5])
def test_a_change_of_lanes_is_seen_with_its_metres_and_no_sooner(rate_hz):
    said = states_of(Motion.LANE_CHANGE, rate_hz)
    # It takes 3 s, and the courses at both ends have to agree again.
    assert Motion.LANE_CHANGE not in between(said, 0.0, 8.5)
    assert between(said, 10.5, 11.0) == {Motion.LANE_CHANGE}
    shifts = [shift for time, _, shift in said if 10.5 <= time <= 11.0]
    np.testing.assert_allclose(shifts, 3.5, atol=0.4)
    assert all((shift != 0) == (motion is Motion.LANE_CHANGE) for _, motion, shift in said)


@pytest.mark.parametrize("rate_hz", [10, 20, 2.5, 12.5, 1.5])
def test_moments_are_a_tenth_of_a_second_apart_or_a_sweep(rate_hz):
    slots, age = slots_of(), jnp.zeros(motion.NUM_MOMENTS)
    remember = jax.jit(motion.remember)
    for index in range(120):
        slots = dataclasses.replace(slots, position=np.float32([[index / rate_hz, 0]]))
        slots, age = remember(slots, age, jnp.float32(1 / rate_hz))
    gap = max(1 / rate_hz, 0.1 if rate_hz == 20 else 0)
    np.testing.assert_allclose(np.diff(age), gap, rtol=1e-4)
    assert float(age[0]) < gap
    # Each moment is where it was so long ago.
    np.testing.assert_allclose(slots.path[0, :, 0], 119 / rate_hz - age, atol=1e-3)
    assert int(slots.path_length[0]) == min(motion.NUM_MOMENTS, 60 if rate_hz == 20 else 120)
