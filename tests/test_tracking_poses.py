"""Rigid motions, poses, ego-motion and the removal of motion distortion, against SciPy and by laws."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from jaxbox.geometry import rigid
from jaxbox.tracking import poses
from jaxbox.tracking.poses import Poses, PoseSource

RNG = np.random.default_rng(3)


def random_poses(count, *, spread_m=50.0, seed=0):
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    T[:, :3, 3] = rng.uniform(-spread_m, spread_m, (count, 3))
    return T


def motion(angle_deg=8.0, shift=(1.2, 0.1, -0.05)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(angle_deg) * np.array([0.05, -0.1, 1.0])).as_matrix()
    T[:3, 3] = shift
    return T


# --- rigid motions --------------------------------------------------------------------------------


def test_quaternions_are_scipys():
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3))
    for rotation in (Rotation.random(500, random_state=1), half_turns, Rotation.identity(1)):
        R = rotation.as_matrix()
        found = rigid.quaternion_of(R)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
        assert (found[:, 0] >= -1e-9).all()
        np.testing.assert_allclose(rigid.rigid_from_quaternion(found, np.zeros(3))[:, :3, :3], R, atol=1e-12)
        expected = rotation.as_quat(canonical=True, scalar_first=True)
        np.testing.assert_allclose(np.abs((found * expected).sum(axis=1)), 1, atol=1e-12)


def test_inverse_and_relative_poses_are_those_of_matrices():
    A, B = random_poses(50, seed=1), random_poses(50, seed=2)
    np.testing.assert_allclose(rigid.inverse_rigid(A), np.linalg.inv(A), atol=1e-12)
    np.testing.assert_allclose(rigid.relative_rigid(A, B), np.linalg.inv(A) @ B, atol=1e-11)


def test_poses_between_are_scipys_slerp_and_the_line():
    A, B = random_poses(2, seed=5)
    share = np.array([-0.2, 0.0, 0.3, 1.0, 1.1])
    found = rigid.interpolate_rigid(*(np.tile(T, (len(share), 1, 1)) for T in (A, B)), share)
    inside = (share >= 0) & (share <= 1)
    slerp = Slerp([0, 1], Rotation.from_matrix(np.stack([A, B])[:, :3, :3]))
    np.testing.assert_allclose(found[inside, :3, :3], slerp(share[inside]).as_matrix(), atol=1e-12)
    line = A[:3, 3] + share[:, None] * (B - A)[:3, 3]
    np.testing.assert_allclose(found[:, :3, 3], line, atol=1e-12)
    # Outside the turn goes on about the same axis.
    R_a_b = Rotation.from_matrix(A[:3, :3].T @ B[:3, :3])
    beyond = A[:3, :3] @ Rotation.from_rotvec(1.1 * R_a_b.as_rotvec()).as_matrix()
    np.testing.assert_allclose(found[-1, :3, :3], beyond, atol=1e-12)


def test_motion_at_constant_velocity_is_the_same_in_steps():
    T, xyz = motion(), RNG.uniform(-40, 40, (100, 3))
    whole = rigid.move_along(xyz, T, np.ones(100))
    np.testing.assert_allclose(whole, xyz @ T[:3, :3].T + T[:3, 3], atol=1e-12)
    np.testing.assert_allclose(rigid.move_along(xyz, T, np.zeros(100)), xyz, atol=1e-12)
    # exp(s) exp(1 - s) = exp(1)
    for share in (0.1, 0.5, 0.9):
        first = rigid.move_along(xyz, T, np.full(100, 1 - share))
        np.testing.assert_allclose(rigid.move_along(first, T, np.full(100, share)), whole, atol=1e-12)
    straight = motion(0.0)
    np.testing.assert_allclose(
        rigid.move_along(xyz, straight, np.full(100, 0.5)), xyz + straight[:3, 3] / 2, atol=1e-12
    )


# --- poses ----------------------------------------------------------------------------------------


def scaled(T, factor):
    return np.block([[factor * T[:3, :3], T[:3, 3:]], [T[3:]]])


@pytest.mark.parametrize(
    ("T", "reason"),
    [
        (np.eye(3), "shape"),
        (np.full((4, 4), np.nan), "not finite"),
        (np.diag([1.0, 1, 1, np.inf]), "not finite"),
        (np.zeros((4, 4)), "last row"),
        (np.diag([1.0, 1, 1, 2]), "last row"),
        (scaled(motion(), 1.01), "its rotation is off by 0.02"),
        (scaled(motion(), 1e200), "its rotation is off"),
        (np.diag([1.0, -1, 1, 1]), "mirror image"),
        (scaled(motion(), 1.0004), None),
        (motion(179.0), None),
    ],
)
def test_what_is_no_pose_is_named(T, reason):
    found = poses.check_pose(T)
    assert found is None if reason is None else reason in found


def test_rotations_within_the_tolerance_are_made_exact():
    T = random_poses(20)
    rough = T.copy()
    rough[:, :3, :3] += RNG.uniform(-2e-4, 2e-4, (20, 3, 3))
    assert all(poses.check_pose(item) is None for item in rough)
    exact = poses.orthonormal_pose(rough)
    np.testing.assert_allclose(
        exact[:, :3, :3] @ exact[:, :3, :3].swapaxes(1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-14
    )
    np.testing.assert_allclose(exact, T, atol=1e-3)


def test_ego_motions_of_utm_coordinates_keep_a_hundredth_of_a_millimetre():
    steps = [motion(2.0, (1.5 + 0.01 * i, 0.02, 0.003)) for i in range(60)]
    T = [np.eye(4)]
    for step in steps:
        T.append(T[-1] @ step)
    near = np.array(T)
    far = near.copy()
    far[:, :3, 3] += 691_608.25, 5_334_764.5, 519.0
    for world in (near, far):
        found = poses.ego_motions(Poses(world, PoseSource.OXTS))
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found[0], np.eye(4))
        np.testing.assert_allclose(found[1:], steps, atol=1e-6)
    # A world of float32 would be off by decimetres, which is why there is none.
    lost = np.abs(np.diff(far[:, 1, 3].astype(np.float32)) - np.diff(far[:, 1, 3])).max()
    assert lost > 0.1


def test_ego_motions_do_not_know_the_world():
    near = random_poses(9)
    world = random_poses(1, spread_m=1000.0, seed=7)[0]
    a, b = (poses.ego_motions(Poses(T, PoseSource.TF)) for T in (near, world @ near))
    np.testing.assert_allclose(a, b, atol=1e-4)


def test_poses_of_no_sweeps_and_of_wrong_shapes():
    assert poses.ego_motions(poses.no_poses(0)).shape == (0, 4, 4)
    assert len(poses.no_poses(2)) == 2
    with pytest.raises(ValueError, match="poses are"):
        Poses(np.eye(4), PoseSource.NONE)
    with pytest.raises(ValueError, match="2 poses, and times"):
        Poses(np.tile(np.eye(4), (2, 1, 1)), PoseSource.NONE, np.zeros(3, np.int64))


# --- motion distortion ----------------------------------------------------------------------------


@pytest.mark.parametrize("starts_s", [0.0, -0.1, -0.05])
def test_deskew_undoes_the_distortion_of_a_constant_motion(starts_s):
    # What the sensor sees of standing points while it drives an arc: the inverse motion to each one's time.
    T, truth = motion(), RNG.uniform(-40, 40, (2000, 3))
    time_s = RNG.uniform(starts_s, starts_s + 0.1, len(truth))
    share = time_s / 0.1
    seen = rigid.move_along(truth, rigid.inverse_rigid(T), share)
    assert np.abs(seen - truth).max() > 1, "there is something to undo"
    found = poses.deskew(seen, time_s, T, duration_s=0.1)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, truth, atol=1e-5)


def test_deskew_without_a_duration_takes_that_of_the_sweep():
    T, xyz = motion(), np.float32(RNG.uniform(-40, 40, (50, 3)))
    time_s = np.linspace(0, 0.08, 50)
    np.testing.assert_array_equal(poses.deskew(xyz, time_s, T), poses.deskew(xyz, time_s, T, duration_s=0.08))


def test_deskew_leaves_what_it_cannot_move():
    T = motion()
    xyz = np.float32([[1, 2, 3], [np.nan, 1, 1], [4, 5, 6], [np.inf, 0, 0]])
    found = poses.deskew(xyz, np.array([0.1, 0.1, np.nan, 0.0]), T)
    np.testing.assert_array_equal(found[1:], xyz[1:])
    assert np.isfinite(found[0]).all()
    np.testing.assert_array_equal(poses.deskew(xyz, np.zeros(4), T), xyz)
    assert poses.deskew(xyz[:0], np.zeros(0), T).shape == (0, 3)
    with pytest.raises(ValueError, match="not a rigid motion: its rotation"):
        poses.deskew(xyz, np.zeros(4), 2 * np.eye(4) - np.diag([0, 0, 0, 1.0]))
    with pytest.raises(ValueError, match="duration_s is -1"):
        poses.deskew(xyz, np.zeros(4), T, duration_s=-1.0)
