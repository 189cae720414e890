"""Poses from points and from boxes: on synthetic motion with exact truth, real drives, and too little."""

import sys
import types

import numpy as np
import pytest

import jaxbox
from jaxbox import io
from jaxbox.geometry.rigid import inverse_rigid, move_along, relative_rigid
from jaxbox.io import TimedPoints
from jaxbox.tracking.odometry import KissIcp, boxes_poses, ego_motion_from_boxes, kiss_icp_poses
from jaxbox.tracking.poses import PoseSource, ego_motions


def motion(x=1.0, y=0.0, yaw_deg=2.0):
    angle = np.radians(yaw_deg)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:2, 3] = x, y
    return T


# --- boxes ----------------------------------------------------------------------------------------


def boxes(xy, valid=None):
    """What `ego_motion_from_boxes` looks at of a sweep's detections."""
    center = np.column_stack([xy, np.zeros(len(xy))]).astype(np.float32)
    valid = np.ones(len(xy), bool) if valid is None else valid
    return types.SimpleNamespace(center=center, valid=valid)


def scene(count=40, seed=0):
    return np.random.default_rng(seed).uniform(-40, 40, (count, 2))


def seen(xy, T):
    """Points of one sweep from where the next was taken."""
    return (xy - T[:2, 3]) @ T[:2, :2]


@pytest.mark.parametrize("T", [motion(), motion(0.0, 0.0, 0.0), motion(0.9, -0.2, -5.0)])
def test_the_motion_of_standing_boxes_is_found(T):
    found, num_pairs = ego_motion_from_boxes(boxes(scene()), boxes(seen(scene(), T)), np.eye(4))
    np.testing.assert_allclose(found, T, atol=1e-5)
    assert num_pairs == 40


@pytest.mark.parametrize("speed_m", [2.0, 3.3, 5.0])
def test_a_fast_first_step_is_found_without_a_guess(speed_m):
    T = motion(speed_m, 0.0, 0.5)
    found, num_pairs = ego_motion_from_boxes(boxes(scene()), boxes(seen(scene(), T)), np.eye(4))
    np.testing.assert_allclose(found, T, atol=1e-5)
    assert num_pairs == 40


def test_movers_missing_boxes_and_noise_hardly_matter():
    rng, T, errors = np.random.default_rng(1), motion(1.5, 0.05, 1.0), []
    for seed in range(30):
        xy = scene(50, seed)
        later = seen(xy, T) + rng.normal(0, 0.03, xy.shape)
        # A third of them moves, a fifth is not seen again, and others come.
        later[:15] += rng.uniform(0.3, 1.5, (15, 2))
        later = np.vstack([later[:40], rng.uniform(-40, 40, (10, 2))])
        found, num_pairs = ego_motion_from_boxes(boxes(xy), boxes(later), motion(1.45, 0.0, 1.0))
        errors.append(np.linalg.norm((found - T)[:2, 3]))
        assert num_pairs >= 20
    assert np.median(errors) < 0.02
    assert max(errors) < 0.06


def test_the_order_of_boxes_and_padding_change_nothing():
    T, order = motion(), np.random.default_rng(2).permutation(40)
    before, after = scene(), seen(scene(), T)
    one, num = ego_motion_from_boxes(boxes(before), boxes(after), np.eye(4))
    padded = boxes(np.vstack([after[order], np.zeros((9, 2))]), np.arange(49) < 40)
    other, num_other = ego_motion_from_boxes(boxes(before), padded, np.eye(4))
    np.testing.assert_allclose(one, other, atol=1e-12)
    assert num == num_other


def test_the_reverse_motion_is_the_inverse():
    before, after = boxes(scene()), boxes(seen(scene(), motion()))
    there, _ = ego_motion_from_boxes(before, after, np.eye(4))
    back, _ = ego_motion_from_boxes(after, before, np.eye(4))
    np.testing.assert_allclose(there @ back, np.eye(4), atol=1e-5)


def test_too_few_boxes_leave_the_guess():
    guess = motion(0.7, 0.1, 3.0)
    for first, second in (
        (0, 0), (0, 9), (2, 9), (9, 2),
    ):  # fmt: skip
        found, num_pairs = ego_motion_from_boxes(boxes(scene(first)), boxes(scene(second)), guess)
        np.testing.assert_array_equal(found, guess)
        assert num_pairs == 0
    # Far apart: no partners.
    found, num_pairs = ego_motion_from_boxes(boxes(scene(5)), boxes(scene(5) + 1000.0), guess)
    np.testing.assert_array_equal(found, guess)
    assert num_pairs == 0
    # All in one place: a shift, and no turn.
    same = np.zeros((5, 2))
    found, _ = ego_motion_from_boxes(boxes(same), boxes(same), np.eye(4))
    np.testing.assert_allclose(found, np.eye(4), atol=1e-12)


def test_poses_of_boxes_are_chained_and_go_on_where_there_are_none():
    xy, T, sweeps = scene(60), motion(0.8, 0.0, 1.0), []
    for index in range(6):
        sweeps.append(boxes(seen(xy, np.linalg.matrix_power(T, index))))
    sweeps[3] = boxes(xy[:0])
    sweeps[4] = boxes(xy[:0])
    found = boxes_poses(sweeps)
    assert found.source == PoseSource.BOXES
    expected = [np.linalg.matrix_power(T, index) for index in range(6)]
    np.testing.assert_allclose(found.T_world_sensor, expected, atol=1e-4)
    assert len(boxes_poses([])) == 0


# --- points ---------------------------------------------------------------------------------------


def street(seed=0):
    """Points on the ground, walls and poles, which stand still; m, the world's frame."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-60, 90, 9000), rng.uniform(-20, 20, 9000), np.full(9000, -1.7)])
    walls = []
    for x in np.arange(-60, 90, 9.0):
        depth = rng.uniform(8, 20)
        for side in (-1, 1):
            y, z = side * depth + rng.normal(0, 0.02, 500), rng.uniform(-1.7, 4, 500)
            walls.append(np.column_stack([x + rng.uniform(0, 7, 500), y, z]))
    poles = [
        np.column_stack([rng.normal(x, 0.1, 60), rng.normal(y, 0.1, 60), rng.uniform(-1.7, 5, 60)])
        for x, y in rng.uniform((-60, -7), (90, 7), (40, 2))
    ]
    return np.vstack([ground, *walls, *poles])


def test_kiss_icp_finds_an_exact_drive_and_repeats_it():
    world, T = street(), motion(0.7, 0.0, 0.8)
    poses = [np.linalg.matrix_power(T, index) for index in range(15)]
    runs = []
    for _ in range(2):
        odometry = KissIcp(voxel_m=1.0)
        runs.append([
            odometry.register(seen_from(world, pose)) for pose in poses
        ])  # fmt: skip
        assert not odometry.is_lost
    np.testing.assert_array_equal(runs[0], runs[1])
    length = np.linalg.norm(poses[-1][:3, 3])
    gap = relative_rigid(poses[-1], np.array(runs[0][-1]))
    assert np.linalg.norm(gap[:3, 3]) < 0.01 * length
    assert abs(np.degrees(np.arctan2(gap[1, 0], gap[0, 0]))) < 0.2


def seen_from(world, pose):
    return (world - pose[:3, 3]) @ pose[:3, :3]


def test_kiss_icp_deskews_where_points_carry_times():
    # At 20 m/s and 10 Hz the last points of a sweep are 2 m off; the beam turns once a sweep.
    world, T, rng = street(), motion(2.0, 0.0, 0.6), np.random.default_rng(4)
    poses = [np.linalg.matrix_power(T, index) for index in range(25)]
    errors = {True: [], False: []}
    runs = {True: KissIcp(voxel_m=1.0), False: KissIcp(voxel_m=1.0)}
    for pose in poses:
        truth = seen_from(world, pose)
        truth = truth[rng.random(len(truth)) < 0.3]
        share = np.arctan2(truth[:, 1], truth[:, 0]) / (2 * np.pi) + 0.5
        distorted = move_along(truth, inverse_rigid(T), share)
        for is_timed, odometry in runs.items():
            found = odometry.register(distorted, 0.1 * share if is_timed else None)
            errors[is_timed].append(np.linalg.norm((found - pose)[:3, 3]))
    # An error of the motion that deskews must not grow: it would be metres by now.
    assert max(errors[True]) < 0.1
    assert errors[True][-1] < errors[False][-1] / 2


@pytest.mark.parametrize("stamp_s", [-0.1, -0.05, 0.0])
def test_poses_are_those_of_the_sweeps_own_time(stamp_s):
    # The stamp may be that of the first point, as here 0, of the last one, or of any between.
    world, T, rng = street(), motion(2.0, 0.0, 0.0), np.random.default_rng(4)
    odometry = KissIcp(voxel_m=1.0)
    for index in range(8):
        truth = seen_from(world, np.linalg.matrix_power(T, index))
        truth = truth[rng.random(len(truth)) < 0.3]
        time_s = stamp_s + 0.1 * (np.arctan2(truth[:, 1], truth[:, 0]) / (2 * np.pi) + 0.5)
        found = odometry.register(move_along(truth, inverse_rigid(T), time_s / 0.1), time_s)
    np.testing.assert_allclose(found[:3, 3], [14, 0, 0], atol=0.06)


def test_kiss_icp_goes_on_over_sweeps_that_show_too_little():
    world, T = street(), motion(0.7, 0.0, 0.0)
    poses = [np.linalg.matrix_power(T, index) for index in range(8)]
    odometry = KissIcp(voxel_m=1.0)
    for index, pose in enumerate(poses):
        points = seen_from(world, pose)
        if index in (5, 6):
            points = np.full_like(points, np.nan) if index == 5 else points[:0]
        found = odometry.register(points)
        assert odometry.is_lost == (index in (5, 6))
    np.testing.assert_allclose(found[:3, 3], poses[-1][:3, 3], atol=0.1)
    empty = KissIcp()
    np.testing.assert_array_equal(empty.register(np.zeros((0, 3), np.float32)), np.eye(4))
    assert empty.is_lost
    # Points all in one place, and far beyond the range.
    for xyz in (np.zeros((500, 3)), np.full((500, 3), 1e30), np.full((500, 3), 5000.0)):
        again = KissIcp()
        for _ in range(3):
            assert np.isfinite(again.register(xyz)).all()


class RecordedSweep:
    """A sweep in memory."""

    def __init__(self, points, timestamp_ns):
        self.points, self.timestamp_ns = points, timestamp_ns

    def read_timed_points(self):
        return self.points


def test_what_is_compensated_is_not_deskewed_again():
    world, T = street(), motion(2.0, 0.0, 0.6)
    poses = [np.linalg.matrix_power(T, index) for index in range(6)]
    time_s = np.linspace(0, 0.1, len(world))
    found = {}
    for compensated in (True, False):
        sweeps = [
            RecordedSweep(TimedPoints(seen_from(world, pose), time_s, time_s, compensated), 10**8 * index)
            for index, pose in enumerate(poses)
        ]
        found[compensated] = kiss_icp_poses(sweeps, voxel_m=1.0)
    assert found[True].source == PoseSource.KISS_ICP
    np.testing.assert_array_equal(found[True].times_ns, 10**8 * np.arange(6))
    np.testing.assert_allclose(found[True].T_world_sensor[-1, :3, 3], poses[-1][:3, 3], atol=0.1)
    assert not np.allclose(found[True].T_world_sensor[-1], found[False].T_world_sensor[-1], atol=1e-6)
    untimed = kiss_icp_poses([RecordedSweep(TimedPoints(world, time_s), None)])
    assert untimed.times_ns is None


def test_without_the_library_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "kiss_icp.kiss_icp", None)
    with pytest.raises(ImportError, match=r"Poses from points need kiss_icp: pip install 'jaxbox\[track\]'"):
        KissIcp()


# --- real and ray-cast drives ---------------------------------------------------------------------

NUM_SWEEPS = 20


@pytest.fixture(scope="module", params=["0000", "0003"])
def real_drive(request, data_root):
    """Twenty sweeps of a drive, and the motions between them by kiss-icp."""
    folder = data_root / "kitti_tracking" / "training" / "velodyne" / request.param
    sweeps = io.open_sweeps(folder)[: NUM_SWEEPS + 1]
    return sweeps, kiss_icp_poses(sweeps)


def test_oxts_and_kiss_icp_agree_on_real_drives(real_drive):
    sweeps, registered = real_drive
    oxts = io.find_poses(sweeps)
    assert oxts.source == PoseSource.OXTS
    lengths, yaws = [], []
    for poses in (oxts, registered):
        steps = ego_motions(poses)
        lengths.append(np.linalg.norm(steps[:, :3, 3], axis=1).sum())
        whole = relative_rigid(poses.T_world_sensor[0], poses.T_world_sensor[-1])
        yaws.append(np.degrees(np.arctan2(whole[1, 0], whole[0, 0])))
    print(f"path {lengths[0]:.2f} m by oxts, {lengths[1]:.2f} by kiss-icp; turn {yaws[0]:.2f}, {yaws[1]:.2f}")
    # The satellites' positions jitter by centimetres a sweep, which counts most on the slow drive.
    assert lengths[1] == pytest.approx(lengths[0], rel=0.05)
    assert abs(yaws[1] - yaws[0]) < 0.2


def test_motions_by_boxes_are_within_centimetres_of_kiss_icp(real_drive):
    sweeps, registered = real_drive
    detections = [result.detections for result in jaxbox.stream(sweeps)]
    steps = ego_motions(boxes_poses(detections))[1:]
    expected = ego_motions(registered)[1:]
    errors = np.linalg.norm((steps - expected)[:, :2, 3], axis=1)
    print(f"median {np.median(errors):.3f} m, p95 {np.quantile(errors, 0.95):.3f} m a sweep")
    assert np.median(errors) < 0.07
    assert np.quantile(errors, 0.95) < 0.2
