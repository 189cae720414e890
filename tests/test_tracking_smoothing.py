"""The second pass: smoothing against a solved system, laws of worlds and padding, gaps, fronts and states."""

import dataclasses

import jax
import numpy as np
import pytest
import traffic

from jaxbox.config import TrackConfig
from jaxbox.tracking import (
    Motion,
    Sight,
    TrackerState,
    offline_motion,
    paths,
    smooth,
    smoothing,
    track_sequence,
)

CONFIG = TrackConfig()
NUM_SWEEPS = 60
track = jax.jit(track_sequence)


def rows_of(tree, index):
    return jax.tree.map(lambda a: np.asarray(a)[index], tree)


def tracked(recording):
    """Tracks and observations of each sweep, the poses and the times."""
    # All recordings are of one length, also that of the step's tests: they share one compiled program.
    config = jax.tree.map(np.float32, CONFIG)
    _, tracks = track(TrackerState.empty(24), *traffic.padded(recording).sweep(slice(None)), config)
    assert not tracks.status.any()
    poses = [np.eye(4)]
    for moved in recording.T_previous_current[1:]:
        poses.append(poses[-1] @ moved.astype(float))
    sweeps = range(len(recording))
    seen = [recording.sweep(f)[0] for f in sweeps]
    return [rows_of(tracks, f) for f in sweeps], seen, np.array(poses), np.cumsum(recording.dt.astype(float))


@pytest.fixture(scope="module")
def drive():
    return tracked(traffic.simulate(3, num_sweeps=NUM_SWEEPS))


def assert_same(left, right, atol):
    for a, b in zip(left, right, strict=True):
        for field in dataclasses.fields(a):
            if field.name not in ("counts", "status"):
                x, y = getattr(a, field.name), getattr(b, field.name)
                if field.name in ("yaw", "filtered_yaw"):
                    x, y = np.exp(2j * x), np.exp(2j * y)
                elif field.name == "heading":
                    x, y = np.exp(1j * x), np.exp(1j * y)
                np.testing.assert_allclose(x, y, rtol=0, atol=atol, err_msg=field.name)


def solved(measured, variance, step_s, config):
    """Posterior mean and covariance of position and velocity along one axis, by one system of all moments.

    Its unknowns are the first state and the acceleration of each step, which all states are linear in.
    """
    n = len(measured)
    state = np.zeros((n, 2, n + 1))
    state[0, 0, 0] = state[0, 1, 1] = 1
    for k in range(1, n):
        dt = step_s[k]
        state[k] = np.array([[1, dt], [0, 1]]) @ state[k - 1]
        state[k, :, k + 1] += [dt**2 / 2, dt]
    information = np.full(n + 1, config.acceleration_mps2**-2.0)
    information[:2] = 0, config.birth_speed_sd_mps**-2.0
    weight = 1 / variance
    normal = np.diag(information) + np.einsum("k,ki,kj->ij", weight, state[:, 0], state[:, 0])
    mean = np.linalg.solve(normal, (weight * measured) @ state[:, 0])
    return state @ mean, state @ np.linalg.inv(normal) @ state.swapaxes(1, 2)


@pytest.mark.parametrize("seed", range(5))
def test_smoothed_paths_are_the_solution_of_one_large_system(seed):
    rng = np.random.default_rng(seed)
    num_tracks, num_moments = 4, 12
    measured = rng.normal(0, 5, (num_tracks, num_moments, 2))
    variance = rng.uniform(0.01, 0.3, (num_tracks, num_moments))
    variance[:, 1:][rng.random((num_tracks, num_moments - 1)) < 0.4] = np.inf
    step_s = rng.uniform(0.05, 0.2, (num_tracks, num_moments))
    position, velocity, covariance = paths.smooth_positions(measured, variance, step_s, CONFIG)
    for i in range(num_tracks):
        for axis in (0, 1):
            expected, spread = solved(measured[i, :, axis], variance[i], step_s[i], CONFIG)
            np.testing.assert_allclose(position[i, :, axis], expected[:, 0], atol=1e-8)
            np.testing.assert_allclose(velocity[i, :, axis], expected[:, 1], atol=1e-7)
            entries = np.stack([spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]], axis=1)
            np.testing.assert_allclose(covariance[i], entries, atol=1e-7)


def test_the_sensor_frames_stay_the_same_in_any_world(drive):
    tracks, seen, poses, times = drive
    world = traffic.pose(5e5, 4e6, 2.2, 30.0)
    before = smooth(tracks, seen, poses, times)
    assert sum(len(of_sweep.id) for of_sweep in before) > 5 * NUM_SWEEPS
    assert_same(before, smooth(tracks, seen, world @ poses, times + 1e9), atol=1e-5)


def test_groups_of_any_size_give_the_same_tracks(drive, monkeypatch):
    together = smooth(*drive)
    monkeypatch.setattr(paths, "MAX_PADDED_MOMENTS", 1)
    assert_same(together, smooth(*drive), atol=1e-6)


def test_every_detection_of_a_track_is_shown_and_gaps_are_short(drive):
    tracks, _, _, times = drive
    smoothed = smooth(*drive)
    shown = {(f, i) for f, of_sweep in enumerate(smoothed) for i in of_sweep.id}
    hits = {(f, i) for f, t in enumerate(tracks) for i in t.id[t.valid & (t.detection >= 0)]}
    assert hits <= shown
    filled = shown - hits
    assert filled
    for f, i in filled:
        around = [times[g] for g, j in hits if j == i]
        before, after = max(t for t in around if t < times[f]), min(t for t in around if t > times[f])
        assert after - before <= 0.8 + 1e-6
    for of_sweep in smoothed:
        assert (np.diff(of_sweep.id) > 0).all()
        is_hit = of_sweep.detection >= 0
        assert (is_hit == (of_sweep.sight == Sight.SEEN)).all()
        assert ((of_sweep.yaw >= -np.pi / 2) & (of_sweep.yaw < np.pi / 2)).all()
        assert ((of_sweep.heading >= -np.pi) & (of_sweep.heading < np.pi)).all()
        assert (np.abs(np.sin(of_sweep.heading - of_sweep.yaw)) < 1e-5).all()
        assert ((of_sweep.score > 0) & (of_sweep.score <= 1)).all()


def one_car(num_sweeps=50, speed=10.0, missing=(), size=(4.4, 1.8, 1.5), extent=(4.2, 1.7), yaw=0.0):
    """A car that drives along x, 8 m to the left of a sensor that stands."""
    x = speed * 0.1 * np.arange(num_sweeps) - speed * num_sweeps * 0.05
    center = np.stack([x, np.full(num_sweeps, 8.0), np.zeros(num_sweeps)], axis=1)[:, None]
    valid = np.ones((num_sweeps, 1), bool)
    valid[list(missing)] = False
    whole = (num_sweeps, 1, 1)
    seen = traffic.observations(
        center,
        size=np.tile(size, whole),
        extent=np.tile(extent, whole),
        yaw=np.full((num_sweeps, 1), yaw),
        valid=valid,
    )
    identity = np.tile(np.eye(4, dtype=np.float32), whole)
    return traffic.Recording(seen, np.full(num_sweeps, 0.1, np.float32), identity)


def test_a_gap_is_filled_where_the_car_was():
    missing = (20, 21, 22)
    smoothed = smooth(*tracked(one_car(missing=missing)))
    for f in missing:
        assert smoothed[f].id.tolist() == [0]
        np.testing.assert_allclose(smoothed[f].center[0, :2], [f - 25.0, 8.0], atol=0.02)
        assert smoothed[f].sight[0] != Sight.SEEN
    assert all(len(of_sweep.id) == 1 for of_sweep in smoothed)


def test_velocity_and_front_are_those_of_the_car_from_the_first_sweep_on():
    for speed in (10.0, -10.0):
        for of_sweep in smooth(*tracked(one_car(speed=speed))):
            np.testing.assert_allclose(of_sweep.velocity, [[speed, 0]], atol=0.05)
            np.testing.assert_allclose(np.cos(of_sweep.heading), np.sign(speed), atol=1e-6)
            assert of_sweep.front_probability > 0.99
            assert of_sweep.motion == Motion.MOVING


def test_a_standing_car_has_no_front_and_one_yaw_for_all_sweeps():
    recording = one_car(speed=0.0)
    rng = np.random.default_rng(0)
    recording.seen.yaw[:] += rng.normal(0, 0.1, recording.seen.yaw.shape)
    smoothed = smooth(*tracked(recording))
    assert len({float(of_sweep.yaw[0]) for of_sweep in smoothed}) == 1
    assert abs(smoothed[0].yaw[0]) < 0.05
    assert {int(of_sweep.motion[0]) for of_sweep in smoothed} == {Motion.STANDING}
    assert smoothed[0].front_probability == pytest.approx(0.5)


def test_the_front_is_by_motion_and_where_a_car_stands_by_its_profile():
    for speed, sign in ((0.0, -1), (0.0, 1), (10.0, 1)):
        recording = one_car(speed=speed)
        recording.seen.front_log_odds[:] = sign * (1.0 if speed == 0 else -9.0)
        for of_sweep in smooth(*tracked(recording)):
            np.testing.assert_allclose(np.cos(of_sweep.heading), sign, atol=1e-3)
            assert of_sweep.front_probability > 0.99


def test_height_and_vertical_place_are_those_of_the_track_also_in_gaps():
    recording = one_car(speed=2.0, missing=(20, 21))
    rng = np.random.default_rng(1)
    recording.seen.size[..., 2] += rng.normal(0, 0.2, recording.seen.size.shape[:2])
    noise = rng.normal(0, 0.1, recording.seen.size.shape[:2])
    # It drives uphill.
    hill = 0.05 * np.arange(len(recording))[:, None]
    recording.seen.center[..., 2] += hill + noise
    tracks, seen, poses, times = tracked(recording)
    smoothed = smooth(tracks, seen, poses, times)
    heights = {float(of_sweep.size[0, 2]) for of_sweep in smoothed}
    assert len(heights) == 1
    assert heights.pop() == pytest.approx(1.5, abs=0.1)
    # Away from both ends.
    errors = [float(smoothed[f].center[0, 2]) - hill[f, 0] for f in range(5, len(recording) - 5)]
    assert np.std(errors) < 0.6 * noise.std()
    assert abs(np.mean(errors)) < 0.02
    np.testing.assert_array_equal(smoothed[20].center[0, 2], smoothed[20].filtered_center[0, 2])


def test_what_moves_has_the_box_of_its_track_and_what_stands_that_of_the_sweep():
    for speed, is_own in ((10.0, False), (0.0, True)):
        recording = one_car(speed=speed)
        rng = np.random.default_rng(2)
        shape = recording.seen.size.shape[:2]
        error = rng.normal(0, 0.1, (*shape, 2))
        recording.seen.center[..., :2] += error
        recording.seen.size[..., 0] += rng.normal(0, 0.2, shape)
        smoothed = smooth(*tracked(recording))[5:-5]
        truth = recording.seen.center[5:-5, 0, :2] - error[5:-5, 0]
        center = np.array([of_sweep.center[0, :2] for of_sweep in smoothed])
        filtered = np.array([of_sweep.filtered_center[0, :2] for of_sweep in smoothed])
        lengths = {round(float(of_sweep.size[0, 0]), 4) for of_sweep in smoothed}
        assert (len(lengths) > 1) == is_own
        assert np.array_equal(center, filtered) == (not is_own)
        if not is_own:
            assert np.std(center - truth) < 0.06


def test_a_track_of_few_detections_is_believed_less():
    scores = []
    for num in (2, 10, 50):
        tracks, seen, poses, times = tracked(one_car(missing=range(num, 50)))
        scores.append(float(smooth(tracks, seen, poses, times)[0].score[0]))
    # Each detection has .8, and so has the track that is in all sweeps.
    assert scores[-1] == pytest.approx(0.8)
    few = smoothing.BELIEVED_HITS
    expected = [0.8 * num / (num + few) * (50 + few) / 50 for num in (2, 10, 50)]
    np.testing.assert_allclose(scores, expected, rtol=1e-5)


def test_an_unseen_length_is_the_tracks_and_the_visible_faces_stay():
    recording = one_car(speed=0.0)
    # In one sweep only the front half was seen, and completed too short.
    recording.seen.size[10, 0, 0], recording.seen.extent[10, 0, 0] = 3.4, 2.0
    recording.seen.center[10, 0, 0] += 0.5
    recording.seen.center[..., 0] -= 12.0
    tracks, seen, poses, times = tracked(recording)
    smoothed = smooth(tracks, seen, poses, times)
    # The sensor is in front of the car, whose front is the face that stays.
    front = smoothed[10].center[0, 0] + smoothed[10].size[0, 0] / 2
    assert front == pytest.approx(-12 + 0.5 + 1.7, abs=1e-3)
    assert smoothed[10].size[0, 0] == pytest.approx(4.4, abs=0.05)
    # The width, which was seen, is that of the sweep.
    assert smoothed[10].size[0, 1] == pytest.approx(1.8)


def test_nothing_comes_of_nothing():
    recording = one_car(num_sweeps=3, missing=(0, 1, 2))
    smoothed = smooth(*tracked(recording))
    assert [len(of_sweep.id) for of_sweep in smoothed] == [0, 0, 0]
    assert smoothed[0].center.shape == (0, 3)
    assert smooth([], [], np.zeros((0, 4, 4)), np.zeros(0)) == []


def test_numbers_of_sweeps_that_differ_are_refused(drive):
    tracks, seen, poses, times = drive
    with pytest.raises(ValueError, match="59 poses"):
        smooth(tracks, seen, poses[1:], times)


def path_of(position, step_s):
    """One exact path, as `classify_paths` takes it."""
    num = len(position)
    velocity = np.gradient(position, step_s, axis=0)
    whole = (1, num)
    empty = {field.name: np.zeros((*whole, 3)) for field in dataclasses.fields(paths.Paths)}
    one = {"id": np.zeros(1, int), "first": np.zeros(1, int), "length": np.full(1, num)}
    steps = {"step_s": np.r_[0, np.full(num - 1, step_s)][None], "hit": np.ones(whole, bool)}
    track = paths.Paths(**(empty | one | steps))
    return position[None], velocity[None], np.full((*whole, 3), 1e-4), track


def states_of(position, step_s):
    motion, shift = offline_motion.classify_paths(*path_of(position, step_s), CONFIG)
    return motion[0], shift[0]


@pytest.mark.parametrize("step_s", [0.05, 0.1])
def test_states_of_exact_paths(step_s):
    time = np.arange(0, 16, step_s)
    along = np.stack([time * 9, np.zeros_like(time)], axis=1)
    assert (states_of(along, step_s)[0] == Motion.MOVING).all()
    assert (states_of(0 * along, step_s)[0] == Motion.STANDING).all()

    # It stands for 4 s, starts with 2 m/s^2, drives, and stops.
    speed = np.clip(np.minimum(2 * (time - 4), 2 * (13 - time)), 0, 6)
    way = np.cumsum(speed) * step_s
    motion, _ = states_of(np.stack([way, 0 * way], axis=1), step_s)
    expected = [(2, Motion.STANDING), (5, Motion.STARTING), (8.5, Motion.MOVING), (12, Motion.STOPPING)]
    for at_s, state in expected:
        assert motion[round(at_s / step_s)] == state, at_s

    # A quarter turn of 8 m radius at 5 m/s.
    angle = np.clip((time - 6) * 5 / 8, 0, np.pi / 2)
    steps = 5 * step_s * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    motion, _ = states_of(np.cumsum(steps, axis=0), step_s)
    assert motion[round(7 / step_s)] == Motion.TURNING
    assert motion[round(2 / step_s)] == motion[round(14 / step_s)] == Motion.MOVING

    # One lane to the left, and back to the right.
    for shift_m in (3.5, -3.5):
        side = shift_m / 2 * (1 + np.tanh((time - 8) / 0.8))
        motion, shift = states_of(np.stack([time * 20, side], axis=1), step_s)
        middle = round(8 / step_s)
        assert motion[middle] == Motion.LANE_CHANGE
        assert shift[middle] == pytest.approx(shift_m, abs=0.35)
        assert motion[round(2 / step_s)] == Motion.MOVING
