"""Laws of the synthetic sequences: exact motion, no collisions, and sweeps that depend on no order."""

import dataclasses
import functools
import itertools
import pickle

import cv2
import numpy as np
import pytest
from scipy.integrate import quad

import jaxbox
from jaxbox.synthetic import Clutter, make_sequence, spinning
from jaxbox.synthetic.solids import Solid
from jaxbox.synthetic.terrain import SENSOR_HEIGHT_M
from jaxbox.synthetic.trajectories import LaneChange, SpeedProfile, Trajectory, Turn
from jaxbox.types import Label, Motion

OVERTAKES, VAN, HIDDEN, MERGES, STOPS, TURNS = range(6)
TRUCK = 4
COARSE = {"num_beams": 16, "num_azimuths": 240}
KINDS = ("street", "highway")
DRIVES = [("street", 0, False), ("street", 1, True), ("highway", 2, False), ("street", 5, False)]
cached = functools.cache(make_sequence)


def drive_of(kind, seed, turns):
    return cached(seed, kind=kind, ego_turns=turns, **COARSE)


drives = pytest.mark.parametrize(("kind", "seed", "turns"), DRIVES)


def fields_of(sweep):
    """Everything that a sweep says, by name."""
    points = {name: getattr(sweep, name) for name in ("xyz", "intensity", "object_id", "time_s")}
    seen = {name: getattr(sweep, name) for name in ("num_points", "visible", "hidden", "T_world_sensor")}
    return points | seen | {f"truth_{k}": v for k, v in vars(sweep.truth).items()}


def assert_same(first, second):
    assert first.name == second.name
    assert first.timestamp_ns == second.timestamp_ns
    for (name, a), b in zip(fields_of(first).items(), fields_of(second).values(), strict=True):
        assert a.tobytes() == b.tobytes(), name


# Trajectories.

STOP_AND_GO = SpeedProfile((0.0, 2.0, 5.0, 7.0, 11.0), (6.0, 6.0, 0.0, 0.0, 8.0))
TIMES = np.linspace(-1.0, 14.0, 601)
PATHS = {
    "straight": Trajectory((3.0, -2.0), 2.8, STOP_AND_GO),
    "lane change": Trajectory(
        (0.0, 1.0), -3.0, SpeedProfile((0.0, 6.0), (9.0, 14.0)), lane_changes=(LaneChange(1.0, 3.0, 3.5),)
    ),
    "two lane changes": Trajectory(
        (0.0, 1.0),
        0.4,
        SpeedProfile((0.0,), (9.0,)),
        lane_changes=(LaneChange(1.0, 3.0, -3.5), LaneChange(5.0, 4.0, 2.5)),
    ),
    "left turn": Trajectory((5.0, 5.0), 1.0, STOP_AND_GO, Turn(8.0, 7.0, np.pi / 2)),
    "right turn": Trajectory((5.0, 5.0), -2.0, SpeedProfile((0.0,), (6.0,)), Turn(20.0, 6.5, -1.2)),
}


def test_the_distance_is_the_integral_of_the_speed():
    for end in (0.0, 1.0, 3.3, 6.0, 9.9, 20.0):
        expected = quad(STOP_AND_GO.speed, 0.0, end, points=[2, 5, 7, 11], limit=200)[0]
        assert float(STOP_AND_GO.distance(end)) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("name", PATHS)
def test_velocity_and_turn_rate_are_the_derivatives_of_place_and_heading(name):
    step, times = 1e-4, TIMES + 0.00312
    before, now, after = (PATHS[name].at(times + shift) for shift in (-step, 0.0, step))
    np.testing.assert_allclose((after.xy - before.xy) / (2 * step), now.velocity, atol=1e-3)
    turned = (after.heading - before.heading) / (2 * step)
    np.testing.assert_allclose(turned, now.turn_rate, atol=1e-3)
    speed = np.hypot(*now.velocity.T)
    course = np.arctan2(now.velocity[:, 1], now.velocity[:, 0])
    off = (course - now.heading + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(off[speed > 0]).max() < 1e-9


def test_a_turn_ends_on_the_new_course_beside_the_corner():
    state = Trajectory((0.0, 0.0), 0.0, SpeedProfile((0.0,), (1.0,)), Turn(10.0, 5.0, np.pi / 2)).at(
        10.0 + 5.0 * np.pi / 2 + 3.0
    )
    np.testing.assert_allclose(state.xy, (15.0, 8.0), atol=1e-9)
    assert state.heading == pytest.approx(np.pi / 2)


def test_stop_and_go_is_labelled_by_its_speed():
    """The profile brakes by 2 m/s^2 from 6 m/s until 5 s, stands until 7 s, and starts by 2 m/s^2."""
    path = PATHS["straight"]
    at = {
        time: Motion(int(path.motion(time)[0]))
        for time in (1.0, 2.9, 3.1, 4.99, 5.0, 6.9, 7.0, 9.4, 9.6, 12.0)
    }
    assert [at[t] for t in (1.0, 2.9, 12.0)] == [Motion.MOVING] * 3
    assert at[3.1] == at[4.99] == Motion.STOPPING  # Slower than 4 m/s from 3 s on.
    assert at[5.0] == at[6.9] == Motion.STANDING
    assert at[7.0] == at[9.4] == Motion.STARTING  # Slower than 3 m/s a second ago until 9.5 s.
    assert at[9.6] == Motion.MOVING


def test_who_creeps_stands_or_moves_by_hysteresis():
    creep = SpeedProfile((0.0, 10.0, 20.0), (0.0, 1.5, 0.0))
    moves = creep.is_moving(np.array([0.0, 4.0, 6.6, 6.7, 10.0, 14.0, 16.6, 16.7, 20.0]))
    np.testing.assert_array_equal(moves, [False, False, False, True, True, True, True, False, False])
    assert SpeedProfile((0.0,), (0.8,)).is_moving(5.0) == False  # noqa: E712 - a NumPy bool
    assert Trajectory((0.0, 0.0), 0.0, creep).motion(13.0)[0] == Motion.MOVING


@pytest.mark.parametrize(
    ("shift", "duration", "is_change"),
    [(3.5, 4.0, True), (-3.5, 4.0, True), (1.9, 3.0, False), (3.5, 5.5, False)],
)
def test_a_lane_change_is_wide_and_quick_enough(shift, duration, is_change):
    speed = SpeedProfile((0.0,), (20.0,))
    path = Trajectory((0.0, 0.0), 0.0, speed, lane_changes=(LaneChange(2.0, duration, shift),))
    motion, metres = path.motion(np.array([1.99, 2.0, 2.0 + duration / 2, 2.0 + duration]))
    middle = Motion.LANE_CHANGE if is_change else Motion.MOVING
    np.testing.assert_array_equal(motion, [Motion.MOVING, middle, middle, Motion.MOVING])
    np.testing.assert_array_equal(metres, np.array([0, shift, shift, 0]) * is_change)


def test_a_turn_counts_only_at_speed():
    for speed, expected in ((6.0, Motion.TURNING), (1.4, Motion.MOVING)):
        path = Trajectory((0.0, 0.0), 0.0, SpeedProfile((0.0,), (speed,)), Turn(1.0, 6.0, np.pi / 2))
        assert path.motion(3.0 / speed)[0] == expected
        assert path.motion(0.5 / speed)[0] == Motion.MOVING


@pytest.mark.parametrize(
    ("times", "speeds", "named"),
    [((), (), "0 times"), ((0.0, 1.0), (1.0,), "1 speeds"), ((1.0, 1.0), (1.0, 2.0), "increase"),
     ((0.0, 1.0), (1.0, -0.1), "negative")],
)  # fmt: skip
def test_a_wrong_speed_profile_is_named(times, speeds, named):
    with pytest.raises(ValueError, match=named):
        SpeedProfile(times, speeds)


def test_a_path_has_either_a_turn_or_lane_changes():
    with pytest.raises(ValueError, match="one of the two"):
        Trajectory((0, 0), 0, STOP_AND_GO, Turn(1, 1, 1), (LaneChange(0, 1, 3),))


# Repeatability.


@pytest.mark.parametrize("rolling", [False, True])
def test_a_sweep_is_the_same_however_it_is_reached(monkeypatch, rolling):
    monkeypatch.setattr(spinning, "NUM_PACKETS", 6)
    options = {"num_beams": 8, "num_azimuths": 100, "rolling_shutter": rolling}
    first, again = make_sequence(3, **options), make_sequence(3, num_sweeps=3, **options)
    by_iteration = [(sweep, sweep.xyz)[0] for sweep in again]
    assert_same(first[2], by_iteration[2])
    assert_same(by_iteration[1], again[1:][0])
    assert_same(by_iteration[2], pickle.loads(pickle.dumps(again[-1])))
    assert by_iteration[1].xyz.tobytes() != by_iteration[2].xyz.tobytes()


def test_other_seeds_and_kinds_are_other_traffic():
    places = [drive_of(*drive)[0].truth.center.tobytes() for drive in DRIVES]
    assert len(set(places)) == len(places)


def test_the_sensor_changes_nothing_about_the_traffic():
    fine, coarse = (
        make_sequence(2),
        make_sequence(2, rate_hz=5.0, rolling_shutter=True, dropout=0.5, **COARSE),
    )
    np.testing.assert_array_equal(fine[20].truth.center, coarse[10].truth.center)


@pytest.mark.parametrize("number", [1, 7])
def test_sectors_that_are_fired_at_once_change_nothing(monkeypatch, number):
    expected = make_sequence(4, **COARSE)[12]
    expected.xyz  # noqa: B018 - casts it
    monkeypatch.setattr(spinning, "NUM_SECTORS", number)
    assert_same(expected, make_sequence(4, **COARSE)[12])


# Truth.


@drives
def test_truth_keeps_the_project_s_conventions(kind, seed, turns):
    drive = drive_of(kind, seed, turns)
    sizes, labels = {}, {}
    for sweep in drive[::9]:
        truth = sweep.truth
        k = len(truth)
        assert (np.diff(truth.ids) > 0).all()
        assert truth.ids.dtype == truth.motion.dtype == truth.label.dtype == np.int64
        assert truth.center.shape == truth.size.shape == (k, 3)
        assert truth.velocity.shape == (k, 2)
        assert (truth.yaw >= -np.pi).all()
        assert (truth.yaw < np.pi).all()
        assert (np.hypot(*truth.center[:, :2].T) < 120.1).all()
        assert ((truth.lateral_shift_m != 0) == (truth.motion == Motion.LANE_CHANGE)).all()
        for i, size, label in zip(truth.ids, truth.size, truth.label, strict=True):
            assert sizes.setdefault(i, tuple(size)) == tuple(size)
            assert labels.setdefault(i, label) == label
    assert labels[VAN] == Label.VAN
    assert sweep.timestamp_ns - drive[0].timestamp_ns == 99 * 10**8
    assert sweep.name == f"{kind}_{seed}_000099"


@drives
def test_poses_are_rigid_and_sway_a_little_about_the_course(kind, seed, turns):
    pose = drive_of(kind, seed, turns).pose_at(np.linspace(0, 9.9, 200))
    R = pose[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-12)
    np.testing.assert_array_equal(pose[:, 3], np.broadcast_to([0.0, 0, 0, 1], (200, 4)))
    assert 0.2 < np.degrees(np.arccos(R[:, 2, 2])).max() < 0.5
    step = np.diff(pose[:, :2, 3], axis=0)
    off = np.arctan2(*step.T[::-1]) - np.arctan2(R[:-1, 1, 0], R[:-1, 0, 0])
    assert 0.3 < np.degrees(np.abs((off + np.pi) % (2 * np.pi) - np.pi)).max() < (3.0 if turns else 0.9)
    turned = np.arctan2(*step[-1][::-1]) - np.arctan2(*step[0][::-1])
    assert abs(np.sin(turned) - (-0.67 if turns else 0)) < 0.35


@drives
def test_velocity_is_how_truth_moves_over_ground(kind, seed, turns):
    drive, step = drive_of(kind, seed, turns), 1e-3
    for time in (0.3, 2.05, 3.17, 4.44, 6.71, 8.2, 9.63):
        before, now, after = (drive.truth_at(time + shift) for shift in (-step, 0.0, step))
        common = functools.reduce(np.intersect1d, (before.ids, now.ids, after.ids))
        assert len(common) >= 12
        world = []
        for truth, shift in ((before, -step), (after, step)):
            pose = drive.pose_at(time + shift)
            center = truth.center[np.isin(truth.ids, common)]
            world.append(center @ pose[:3, :3].T + pose[:3, 3])
        moved = (world[1] - world[0]) / (2 * step) @ drive.pose_at(time)[:3, :3]
        rows = np.isin(now.ids, common)
        np.testing.assert_allclose(moved[:, :2], now.velocity[rows], atol=1e-3)
        speed = np.hypot(*now.velocity.T)
        off = np.arctan2(now.velocity[:, 1], now.velocity[:, 0]) - now.yaw
        assert np.abs((off[speed > 0.01] + np.pi) % (2 * np.pi) - np.pi).max() < 1e-4
        assert ((speed == 0) == (now.motion == Motion.STANDING))[speed == 0].all()


def runs_of(drive, vehicle):
    """What a vehicle does one after the other, with the first and last time of each."""
    times = np.arange(0.0, 10.0, 0.05)
    motion, _ = drive.traffic.vehicles[vehicle].trajectory.motion(times)
    pairs = itertools.groupby(zip(motion.tolist(), times.tolist(), strict=True), key=lambda pair: pair[0])
    runs = [(Motion(state), [time for _, time in group]) for state, group in pairs]
    return [(state, group[0], group[-1]) for state, group in runs]


@pytest.mark.parametrize("seed", range(8))
def test_every_street_shows_every_motion_in_its_order(seed):
    drive = cached(seed, **COARSE)
    moving, change = Motion.MOVING, Motion.LANE_CHANGE
    expected = {
        OVERTAKES: [moving, change, moving],
        VAN: [moving],
        HIDDEN: [moving, change, moving, change, moving],
        MERGES: [moving, change, moving],
        STOPS: [moving, Motion.STOPPING, Motion.STANDING, Motion.STARTING],
        TURNS: [moving, Motion.TURNING, moving],
    }
    for vehicle, states in expected.items():
        runs = runs_of(drive, vehicle)
        assert [state for state, *_ in runs][: len(states)] == states
        for time in [time for state, *span in runs if state != moving for time in span]:
            place = drive.traffic.vehicles[vehicle].trajectory.at(time).xy
            assert np.hypot(*(place - drive.pose_at(time)[:2, 3])) < 50


@pytest.mark.parametrize("seed", range(4))
def test_every_highway_shows_overtaking_both_ways(seed):
    drive = cached(seed, kind="highway", **COARSE)
    ahead = [
        {i: c[0] for i, c in zip(t.ids, t.center, strict=True)} for t in (drive[0].truth, drive[99].truth)
    ]
    assert ahead[0][OVERTAKES] < -10
    assert ahead[1][OVERTAKES] > 5
    assert ahead[0][TRUCK] - ahead[1][TRUCK] > 20
    assert drive.traffic.vehicles[TRUCK].label == Label.TRUCK
    speed = np.hypot(*drive[0].truth.velocity.T)
    assert (speed[drive[0].truth.motion == Motion.MOVING] > 24).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_lane_change_leads_as_far_as_it_says_to_the_left_or_right(kind):
    drive = cached(1, kind=kind, **COARSE)
    found = []
    for vehicle in (OVERTAKES, HIDDEN, MERGES):
        path = drive.traffic.vehicles[vehicle].trajectory
        for state, start, end in runs_of(drive, vehicle):
            if state == Motion.LANE_CHANGE:
                shift = float(path.motion(start)[1])
                left = np.array([-np.sin(path.course), np.cos(path.course)])
                moved = (path.at(end).xy - path.at(start).xy) @ left
                assert moved == pytest.approx(shift, abs=0.02)
                found.append(shift)
    np.testing.assert_allclose(found, [3.5, -3.5, 3.5, -3.5])


def footprint(mover, state, index):
    """As OpenCV takes a rotated rectangle."""
    return tuple(state.xy[index].tolist()), mover.size[:2], float(np.degrees(state.heading[index]))


@drives
def test_nobody_touches_anybody(kind, seed, turns):
    traffic = drive_of(kind, seed, turns).traffic
    movers = [traffic.ego, *traffic.vehicles]
    times = np.arange(0.0, 20.0, 0.125)
    states = [mover.trajectory.at(times) for mover in movers]
    radius = [np.hypot(*mover.size[:2]) / 2 for mover in movers]
    looked = 0
    for i, j in itertools.combinations(range(len(movers)), 2):
        distance = np.hypot(*(states[i].xy - states[j].xy).T)
        for k in np.flatnonzero(distance < radius[i] + radius[j]):
            pair = footprint(movers[i], states[i], k), footprint(movers[j], states[j], k)
            assert cv2.rotatedRectangleIntersection(*pair)[0] == cv2.INTERSECT_NONE, (i, j, times[k])
            looked += 1
    assert looked > 50


def inside_any(shapes, points):
    """(n,) bool: whether points (n, 3) are within any shape."""
    inside = np.zeros(len(points), bool)
    for shape in shapes:
        if isinstance(shape, Solid):
            inside |= (points @ shape.normals.T <= shape.offsets).all(axis=1)
        else:
            inside |= (((points - shape.center) / shape.radii) ** 2).sum(axis=1) <= 1
    return inside


@drives
def test_nobody_drives_through_what_stands_around(kind, seed, turns):
    traffic = drive_of(kind, seed, turns).traffic
    shapes = [shape for thing in traffic.clutter for shape in thing.shapes]
    grid = (
        np.array(np.meshgrid([-0.5, -0.25, 0, 0.25, 0.5], [-0.5, 0, 0.5], [0.1, 0.5, 1.0])).reshape(3, -1).T
    )
    for mover in [traffic.ego, *traffic.vehicles[:12]]:
        state = mover.trajectory.at(np.arange(0.0, 15.0, 0.3))
        corner = grid * mover.size
        c, s = np.cos(state.heading)[:, None], np.sin(state.heading)[:, None]
        x = state.xy[:, :1] + c * corner[:, 0] - s * corner[:, 1]
        y = state.xy[:, 1:] + s * corner[:, 0] + c * corner[:, 1]
        z = np.broadcast_to(corner[:, 2] - SENSOR_HEIGHT_M, x.shape)
        points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
        near = [q for q in shapes if np.hypot(*(points[:, :2] - q.center[:2]).T).min() < q.radius]
        assert not inside_any(near, points).any()


# Sweeps.


@pytest.mark.parametrize("rolling", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_points_are_on_their_vehicles_when_moved_by_their_times(kind, rolling):
    drive = cached(1, kind=kind, rolling_shutter=rolling, range_noise_m=0.0, num_beams=32, num_azimuths=360)
    for index in (50,) if rolling else (15, 50):
        sweep = drive[index]
        on = sweep.object_id >= 0
        assert on.sum() > 200
        for time in np.unique(sweep.time_s[on]):
            # Each vehicle as it was when the point was measured, in the sensor frame of that time.
            truth = drive.truth_at(sweep.start_s + float(time))
            rows = np.flatnonzero(on & (sweep.time_s == time))
            box = np.searchsorted(truth.ids, sweep.object_id[rows])
            off = sweep.xyz[rows].astype(float) - truth.center[box]
            c, s = np.cos(truth.yaw[box]), np.sin(truth.yaw[box])
            local = np.column_stack([c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0], off[:, 2]])
            # Boxes are upright in a frame that pitches and rolls.
            assert (np.abs(local) <= truth.size[box] / 2 + 0.04).all()


def test_a_rolling_shutter_begins_behind_and_runs_counter_clockwise():
    sweep = cached(1, rolling_shutter=True, num_beams=32, num_azimuths=360)[15]
    assert sweep.time_s.dtype == np.float32
    assert 0 <= sweep.time_s.min() < sweep.time_s.max() < 0.1
    azimuth = np.arctan2(sweep.xyz[:, 1], sweep.xyz[:, 0])
    turned = (azimuth + np.pi) / (2 * np.pi) / 10
    late = (turned - sweep.time_s + 1e-6) % 0.1
    assert late.max() < 0.1 / spinning.NUM_PACKETS + 1e-5
    still = cached(1, num_beams=32, num_azimuths=360)[15]
    assert (still.time_s == 0).all()
    assert_same_truth(sweep.truth, still.truth)


def assert_same_truth(first, second):
    for field in dataclasses.fields(first):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(second, field.name))


def test_walls_are_in_their_place_where_each_point_has_the_pose_of_its_time():
    drive = cached(1, kind="highway", rolling_shutter=True, range_noise_m=0.0, num_beams=32, num_azimuths=360)
    sweep = drive[20]
    wall = sweep.object_id == Clutter.WALL
    xyz, time = sweep.xyz[wall].astype(float), sweep.time_s[wall].astype(float)
    own, one = drive.pose_at(sweep.start_s + time), sweep.T_world_sensor
    moved = np.einsum("nij,nj->ni", own[:, :3, :3], xyz) + own[:, :3, 3]
    rigid = xyz @ one[:3, :3].T + one[:3, 3]
    shapes = [shape for thing in drive.traffic.clutter for shape in thing.shapes if isinstance(shape, Solid)]

    def depth(points):
        """How far each point is from the surface of the nearest solid."""
        gaps = [(points @ shape.normals.T - shape.offsets).max(axis=1) for shape in shapes]
        return np.abs(np.array(gaps)).min(axis=0)

    assert depth(moved).max() < 0.01
    assert depth(rigid).max() > 0.2


@pytest.mark.parametrize("kind", KINDS)
def test_a_car_is_seen_then_hidden_then_seen_again(kind):
    drive = cached(0, kind=kind, num_beams=32, num_azimuths=360)
    seen = []
    for sweep in (drive[8], drive[48], drive[52], drive[95]):
        row = int(np.searchsorted(sweep.truth.ids, HIDDEN))
        seen.append((bool(sweep.hidden[row]), int(sweep.num_points[row]) > 3))
        assert (sweep.num_points == [(sweep.object_id == i).sum() for i in sweep.truth.ids]).all()
        assert (sweep.num_points[sweep.visible == 0] == 0).all()
    assert seen == [(False, True), (True, False), (True, False), (False, True)]


def test_nobody_hides_behind_the_end_of_the_range():
    sweep = cached(0, **COARSE)[0]
    far = np.hypot(*sweep.truth.center[:, :2].T) > 100
    assert far.any()
    assert not sweep.hidden[far & (sweep.visible == 1)].any()


def test_the_stream_reads_a_sequence():
    drive = make_sequence(3, num_sweeps=2, num_beams=32, num_azimuths=400)
    results = list(jaxbox.stream(drive))
    assert [result.name for result in results] == ["street_3_000000", "street_3_000001"]
    for result, sweep in zip(results, drive, strict=True):
        assert result.error is None
        assert result.num_points == len(sweep.xyz) == len(sweep.intensity)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"kind": "canal"}, "canal"),
        ({"num_sweeps": 0}, "num_sweeps 0"),
        ({"rate_hz": 0.0}, "rate_hz 0.0"),
        ({"rate_hz": float("nan")}, "nan"),
        ({"num_sweeps": 4000}, "400 s"),
        ({"kind": "highway", "ego_turns": True}, "ego_turns"),
        ({"num_beams": 0}, "num_beams"),
        ({"dropout": 2.0}, "dropout"),
    ],
)
def test_an_option_out_of_range_is_named(options, named):
    with pytest.raises(ValueError, match=named):
        make_sequence(0, **options)


def test_a_negative_seed_is_named():
    with pytest.raises(ValueError, match="seed is -1"):
        make_sequence(-1)


def test_an_index_beyond_the_end_is_an_error():
    with pytest.raises(IndexError):
        make_sequence(0, num_sweeps=3, **COARSE)[3]
