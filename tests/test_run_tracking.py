"""`jaxbox.track`: a drive past standing vehicles, whose poses, times and points are right, or not."""

import dataclasses
import pickle

import numpy as np
import pytest

import jaxbox
from jaxbox import TrackConfig, synthetic
from jaxbox.run.pose_providers import Clock, GivenPoses, ReadSweep, RegisteredPoints, make_pose_provider
from jaxbox.run.tracking import smooth_tracks
from jaxbox.tracking import Poses, PoseSource
from jaxbox.tracking.trails import Trails

STEP_M = 1.0
NUM_SWEEPS = 7
MIN_SCORE, UNSURE_SCORE = 0.15, 0.1
SEED = 5  # A street with vehicles that few beams show well.
SWEEP_NS = 10**8


@dataclasses.dataclass(frozen=True)
class ArraySweep:
    """A sweep in memory."""

    name: str
    xyz: np.ndarray | None
    timestamp_ns: int | None = None

    def read_points(self):
        if self.xyz is None:
            raise ValueError("the file is damaged")
        return self.xyz, None


def poses_along_x(count):
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3] = STEP_M * np.arange(count)
    return T


@pytest.fixture(scope="session")
def drive():
    """A standing street, seen from a sensor that goes 1 m on along x from sweep to sweep."""
    street = synthetic.make_sweep(SEED, num_azimuths=250).xyz
    return [ArraySweep(f"{k:02d}", street - np.float32([STEP_M * k, 0, 0])) for k in range(NUM_SWEEPS)]


def shown(tracked, min_score=MIN_SCORE):
    """Ids and speeds over ground of the vehicles that are sure, of a sweep."""
    tracks = tracked.tracks
    rows = np.flatnonzero(tracks.confirmed & (tracks.score > min_score))
    return set(tracks.id[rows].tolist()), tracks.velocity[rows]


def statuses(tracked):
    return [sweep.status for sweep in tracked]


def test_a_standing_street_stands_where_the_poses_are_known(drive):
    T = poses_along_x(NUM_SWEEPS)
    tracked = list(jaxbox.track(iter(drive), poses=T))
    assert [sweep.name for sweep in tracked] == [sweep.name for sweep in drive]
    assert all(sweep.status == 0 for sweep in tracked)
    np.testing.assert_allclose([sweep.T_world_sensor for sweep in tracked], T, atol=1e-9)
    ids, velocity = shown(tracked[-1], UNSURE_SCORE)
    assert len(ids) >= 3
    assert np.abs(velocity).max() < 1.0
    # Scores grow with the number of detections, ids stay.
    assert ids <= shown(tracked[2], UNSURE_SCORE / 2)[0] & shown(tracked[4], UNSURE_SCORE / 2)[0]
    # The row of each detection is one of the sweep's own.
    seen = tracked[-1].tracks
    rows = seen.detection[seen.detection >= 0]
    assert tracked[-1].detections.valid[rows].all()
    assert len(set(rows.tolist())) == len(rows)


def test_the_same_drive_twice_gives_the_same_bits(drive):
    first, second = (list(jaxbox.track(drive, poses="boxes")) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        for name in ("id", "center", "velocity", "score"):
            np.testing.assert_array_equal(getattr(a.tracks, name), getattr(b.tracks, name))


def test_a_stream_with_a_tracker_is_that_of_track(drive):
    config = TrackConfig(confirm_hits=2.0)
    streamed = list(jaxbox.stream(drive, track=config))
    for a, b in zip(streamed, jaxbox.track(drive, track_config=config), strict=True):
        assert isinstance(a, jaxbox.TrackedSweep)
        assert (a.name, a.num_points, a.time_ns) == (b.name, b.num_points, b.time_ns)
        for name in ("id", "center", "confirmed", "score"):
            np.testing.assert_array_equal(getattr(a.tracks, name), getattr(b.tracks, name))


def test_without_poses_what_stands_comes_closer_and_the_status_says_so(drive):
    tracked = list(jaxbox.track(drive, poses="none"))
    assert statuses(tracked) == [jaxbox.TrackStatus.POSE_UNKNOWN] * NUM_SWEEPS
    assert {sweep.pose_source for sweep in tracked} == {PoseSource.NONE}
    _, velocity = shown(tracked[-1])
    np.testing.assert_allclose(velocity, np.tile([-10.0, 0.0], (len(velocity), 1)), atol=0.8)


@pytest.mark.parametrize("source", ["boxes", "kiss-icp"])
def test_poses_are_estimated_where_none_are_given(drive, source):
    if source == "kiss-icp":
        pytest.importorskip("kiss_icp")
    tracked = list(jaxbox.track(drive, poses=source))
    bit = jaxbox.TrackStatus.POSE_FROM_BOXES if source == "boxes" else jaxbox.TrackStatus.OK
    assert statuses(tracked) == [bit] * NUM_SWEEPS
    # Of points that all move alike, the registration is as good as its voxels.
    np.testing.assert_allclose(tracked[-1].T_world_sensor, poses_along_x(NUM_SWEEPS)[-1], atol=0.15 * STEP_M)
    assert np.abs(shown(tracked[-1])[1]).max() < 1.5


def test_kiss_icp_is_the_default_where_it_is_installed(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert make_pose_provider(None).source is PoseSource.BOXES
    monkeypatch.undo()
    pytest.importorskip("kiss_icp")
    assert make_pose_provider(None).source is PoseSource.KISS_ICP


def test_a_broken_sweep_makes_the_next_step_longer(drive):
    broken = [*drive[:3], ArraySweep("broken", None), *drive[4:]]
    tracked = list(jaxbox.track(broken, poses="none"))
    assert tracked[3].error == "ValueError: the file is damaged"
    assert tracked[3].tracks is None
    assert tracked[3].T_world_sensor is None
    # Taken as one period, 2 m in that step would make -20 m/s of -10.
    _, velocity = shown(tracked[4])
    np.testing.assert_allclose(velocity[:, 0], -10.0, atol=1.0)
    assert shown(tracked[-1])[0] <= shown(tracked[2])[0] | shown(tracked[4])[0] | shown(tracked[5])[0]


def test_a_broken_sweep_is_passed_over_by_kiss_icp(drive):
    pytest.importorskip("kiss_icp")
    broken = [*drive[:3], ArraySweep("broken", None), *drive[4:]]
    tracked = list(jaxbox.track(broken, poses="kiss-icp"))
    assert [sweep.error is None for sweep in tracked] == [True] * 3 + [False] + [True] * 3
    np.testing.assert_allclose(tracked[-1].T_world_sensor[0, 3], 6 * STEP_M, atol=0.2)


def test_sweeps_that_are_doubled_or_too_early_change_no_track(drive):
    times = [0, 1, 2, 2, 1, 3, 4]
    sweeps = [
        dataclasses.replace(drive[time], name=str(k), timestamp_ns=time * SWEEP_NS)
        for k, time in enumerate(times)
    ]
    T = poses_along_x(NUM_SWEEPS)[times]
    tracked = list(jaxbox.track(sweeps, poses=T))
    late = [bool(jaxbox.TrackStatus.TIME_NOT_LATER & status) for status in statuses(tracked)]
    assert late == [False, False, False, True, True, False, False]
    for index in (3, 4):
        np.testing.assert_array_equal(tracked[index].tracks.id, tracked[2].tracks.id)
        assert (tracked[index].tracks.detection == -1).all()
    assert np.abs(shown(tracked[-1])[1]).max() < 1.0


def test_one_time_that_is_an_hour_off_does_not_end_the_drive(drive):
    times = [0, 1, 2, 36003, 4, 5, 6]
    sweeps = [
        dataclasses.replace(sweep, timestamp_ns=time * SWEEP_NS)
        for sweep, time in zip(drive, times, strict=True)
    ]
    tracked = list(jaxbox.track(sweeps, poses=poses_along_x(NUM_SWEEPS)))
    gap = jaxbox.TrackStatus.TIME_GAP
    assert statuses(tracked) == [0, 0, 0, gap, gap, 0, 0]
    before, after = (set(tracked[k].tracks.id[tracked[k].tracks.valid].tolist()) for k in (2, 6))
    assert not before & after, "an id was used twice"
    assert shown(tracked[-1])[0]


def test_poses_of_nan_are_said_and_the_sensor_goes_on_as_it_did(drive):
    true = poses_along_x(NUM_SWEEPS)
    T = true.copy()
    T[3:5] = np.nan
    tracked = list(jaxbox.track(drive, poses=T))
    invalid = jaxbox.TrackStatus.POSE_INVALID
    assert statuses(tracked) == [0, 0, 0, invalid, invalid, 0, 0]
    np.testing.assert_allclose([sweep.T_world_sensor for sweep in tracked], true, atol=1e-5)
    assert shown(tracked[-1])[0] & shown(tracked[2])[0]
    assert all(np.isfinite(sweep.tracks.center).all() for sweep in tracked)


def test_many_poses_of_nan_are_no_jump(drive):
    # At 25 m/s the sensor is 10 m farther when a pose comes again, and is not that fast.
    T = poses_along_x(NUM_SWEEPS)
    T[:, 0, 3] *= 2.5 / STEP_M
    T[2:5] = np.nan
    invalid = jaxbox.TrackStatus.POSE_INVALID
    assert statuses(list(jaxbox.track(drive, poses=T))) == [0, 0, invalid, invalid, invalid, 0, 0]


def test_a_first_pose_that_is_none_is_said_too(drive):
    T = poses_along_x(3)
    T[0, 0, 0] = 2.0
    tracked = list(jaxbox.track(drive[:3], poses=T))
    assert statuses(tracked) == [jaxbox.TrackStatus.POSE_INVALID, 0, 0]


def test_the_world_of_sweeps_before_the_first_valid_pose_is_that_of_the_others(drive):
    T = poses_along_x(NUM_SWEEPS)
    T[:, :3, 3] += 5e5, 5e6, 100.0
    T[:2] = np.nan
    tracked = list(jaxbox.track(drive, poses=T))
    np.testing.assert_array_equal(tracked[0].T_world_sensor, T[2])
    for sweep in smooth_tracks(tracked):
        assert np.abs(sweep.tracks.center).max() < 100, "places on earth are no places near the sensor"
        assert np.abs(sweep.tracks.velocity).max() < 70


def test_a_pose_that_jumps_ends_all_tracks(drive):
    T = poses_along_x(NUM_SWEEPS)
    T[4:, 1, 3] += 500.0
    tracked = list(jaxbox.track(drive, poses=T))
    assert statuses(tracked)[4] == jaxbox.TrackStatus.POSE_JUMP
    assert not shown(tracked[3])[0] & shown(tracked[-1])[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"poses": np.tile(np.eye(4), (2, 1, 1))}, "2 poses for 4 sweeps; give one each"),
        ({"poses": np.tile(np.eye(4), (5, 1, 1))}, "5 poses for 4 sweeps; give one each"),
        ({"poses": np.eye(3)}, r"poses are \(F, 4, 4\)"),
        ({"poses": "gps"}, "kiss-icp, boxes, none"),
        ({"rate_hz": 0.0}, "rate_hz is 0.0"),
        ({"rate_hz": np.inf}, "rate_hz is inf; it must be positive and finite"),
        ({"max_tracks": 0}, "max_tracks is 0"),
    ],
)
def test_options_that_cannot_be_are_refused(drive, options, message):
    with pytest.raises(ValueError, match=message):
        list(jaxbox.track(drive[:4], **options))


def test_fewer_poses_than_sweeps_of_unknown_number_are_an_error_in_their_turn(drive):
    with pytest.raises(ValueError, match="2 poses for more sweeps than that, such as 02"):
        list(jaxbox.track(iter(drive[:4]), poses=poses_along_x(2)))


def test_no_sweeps_give_no_tracks():
    assert list(jaxbox.track([])) == []
    assert smooth_tracks([]) == []


def test_smoothing_keeps_the_sweeps_and_leaves_broken_ones_as_they_are(drive):
    broken = [*drive[:3], ArraySweep("broken", None), *drive[4:]]
    tracked = list(jaxbox.track(broken, poses=poses_along_x(NUM_SWEEPS)))
    smoothed = smooth_tracks(tracked)
    assert [sweep.name for sweep in smoothed] == [sweep.name for sweep in broken]
    assert smoothed[3] is tracked[3]
    assert shown(smoothed[-1], UNSURE_SCORE)[0]
    assert np.abs(shown(smoothed[2], UNSURE_SCORE)[1]).max() < 0.5


@pytest.mark.parametrize(
    ("sweeps", "times_ns", "expected"),
    [
        ([{}, {}, {}], None, [0, 50, 100]),
        ([{"frame": 3}, {"frame": 4}, {"frame": 7}], None, [150, 200, 350]),
        ([{"timestamp_ns": 1000}, {"timestamp_ns": 1040}, {}], None, [1000, 1040, 1090]),
        ([{}, {}, {}], [7, 70, 700], [7, 70, 700]),
        ([{"timestamp_ns": 9}, {}, {}], [7, 70, 700], [9, 70, 700]),
    ],
)
def test_time_is_the_sweeps_own_then_that_of_the_poses_then_counted(sweeps, times_ns, expected):
    clock = Clock(2e7, times_ns)

    def at(index, fields):
        return clock.read(index, type("Sweep", (), {"timestamp_ns": None, "frame": None} | fields))

    assert [at(index, fields) for index, fields in enumerate(sweeps)] == expected


@dataclasses.dataclass(frozen=True)
class TimedSweep:
    """A wall at x = 20 m, seen by a sensor that drives 2 m while it turns."""

    name: str = "wall"

    def read_timed_points(self):
        time_s = np.linspace(0, 0.1, 500)
        xyz = np.column_stack([20 - 20 * time_s, np.linspace(-5, 5, 500), np.zeros(500)])
        fields = {"xyz": xyz.astype(np.float32), "intensity": None, "time_s": time_s}
        return type("Points", (), {**fields, "is_compensated": False})


def test_points_with_times_lose_the_distortion_by_the_poses():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 2.0
    provider = GivenPoses(Poses(T, PoseSource.OXTS))
    for index in range(2):  # The last sweep's motion is that of the one before.
        xyz, _ = provider.prepare(index, TimedSweep()).read_points()
        np.testing.assert_allclose(xyz[:, 0], 20, atol=1e-4)


def test_the_motion_over_a_missing_sweep_is_twice_as_long_as_the_sweep():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 4.0
    provider = GivenPoses(Poses(T, PoseSource.ODOMETRY, np.array([0, 2 * SWEEP_NS])))
    for index in range(2):
        xyz, _ = provider.prepare(index, TimedSweep()).read_points()
        np.testing.assert_allclose(xyz[:, 0], 20, atol=1e-4)


@pytest.mark.parametrize("step_ns", [0, SWEEP_NS // 3, 1.3 * SWEEP_NS, None])
def test_times_that_jitter_do_not_shorten_the_motion_of_a_sweep(step_ns):
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 2.0
    times_ns = None if step_ns is None else np.array([0, step_ns], np.int64)
    xyz, _ = GivenPoses(Poses(T, PoseSource.POSE_FILE, times_ns)).prepare(0, TimedSweep()).read_points()
    np.testing.assert_allclose(xyz[:, 0], 20, atol=1e-4)


def test_a_single_pose_leaves_points_as_they_are():
    sweep = TimedSweep()
    assert GivenPoses(Poses(np.eye(4)[None], PoseSource.OXTS)).prepare(0, sweep) is sweep


def test_sweeps_that_were_read_ahead_go_to_other_processes(drive):
    pytest.importorskip("kiss_icp")
    prepared = RegisteredPoints().prepare(0, drive[0])
    assert isinstance(prepared, ReadSweep)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(prepared)).xyz, drive[0].xyz)


def test_a_sweep_whose_times_cannot_be_read_is_not_read_without_them():
    pytest.importorskip("kiss_icp")
    provider = RegisteredPoints()

    class Untimed(TimedSweep):
        def read_timed_points(self):
            raise ValueError("which unit?")

    broken = provider.prepare(0, Untimed())
    with pytest.raises(ValueError, match="which unit"):
        broken.read_points()
    assert np.isnan(provider.locate(0, None)).all(), "no pose"


def test_trails_end_where_the_track_is_and_begin_two_seconds_ago(drive):
    tracked = list(jaxbox.track(drive, poses=poses_along_x(NUM_SWEEPS)))
    trails = Trails(duration_s=0.35)
    for sweep in tracked:
        last = trails.add(sweep.tracks, sweep.T_world_sensor, sweep.time_ns / 1e9)
    tracks = tracked[-1].tracks
    rows = np.flatnonzero(tracks.valid)
    assert set(last) == set(tracks.id[rows].tolist())
    for row in rows:
        way = last[int(tracks.id[row])]
        np.testing.assert_allclose(way[-1], tracks.center[row], atol=1e-5)
        assert len(way) == min(int(tracks.age[row]), 4)
    # What stands leaves no trail, though its place in the sensor's frame goes back 1 m a sweep.
    ids, _ = shown(tracked[-1])
    assert all(np.ptp(last[track_id], axis=0).max() < 0.6 for track_id in ids)
