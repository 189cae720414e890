"""How a sensor stands over the ground, and sweeps seen upright from it."""

import dataclasses

import numpy as np
import pytest

from jaxbox import io, synthetic
from jaxbox.geometry.mounting import (
    MAX_TILT_DEG,
    MIN_SENSOR_HEIGHT_M,
    ROOF_HEIGHT_M,
    Mounting,
    measure_mounting,
)

SWEEP = synthetic.make_sweep(3, num_beams=32, num_azimuths=520)
SENSOR_HEIGHT_M = 1.73
LIFT = np.array([0, 0, SENSOR_HEIGHT_M])


def rotation(roll_deg, pitch_deg):
    (sin_r, sin_p), (cos_r, cos_p) = (f(np.radians([roll_deg, pitch_deg])) for f in (np.sin, np.cos))
    roll = np.array([[1, 0, 0], [0, cos_r, -sin_r], [0, sin_r, cos_r]])
    pitch = np.array([[cos_p, 0, sin_p], [0, 1, 0], [-sin_p, 0, cos_p]])
    return pitch @ roll


TILTS = [(0, 2), (0, -5), (5, 0), (-10, 0), (0, 10), (7, -20), (0, 30)]


@pytest.mark.parametrize(("roll", "pitch"), TILTS)
def test_tilt_and_height_are_measured_whatever_they_are(roll, pitch):
    turn = rotation(roll, pitch)
    mounting = measure_mounting(SWEEP.xyz @ turn.T)
    true_tilt = np.degrees(np.arccos(turn[2, 2]))
    assert mounting.tilt_deg == pytest.approx(true_tilt, abs=0.2)
    assert mounting.height_m == pytest.approx(SENSOR_HEIGHT_M, abs=0.1)
    # Upright again: the ground's normal, and no turn about it.
    residual = mounting.T_level_points[:3, :3] @ turn @ [0, 0, 1]
    assert np.degrees(np.arccos(residual[2])) < 0.5


def test_real_sweeps_stand_upright_at_kitti_s_height_and_stay_so_turned(data_root):
    turn = rotation(5, -20)
    for sweep in io.open_sweeps(data_root / "kitti_object")[::5]:
        xyz, _ = sweep.read_points()
        upright, turned = measure_mounting(xyz), measure_mounting(xyz @ turn.T)
        assert upright.height_m == pytest.approx(SENSOR_HEIGHT_M, abs=0.1)
        assert upright.tilt_deg < 2
        assert turned.height_m == pytest.approx(upright.height_m, abs=0.05)
        normal = turned.T_level_points[:3, :3] @ turn @ upright.up
        assert np.degrees(np.arccos(min(normal[2], 1))) < 0.5


def test_the_level_frame_has_the_sensor_at_its_origin_and_turns_no_heading():
    mounting = Mounting((1.0, 2.0, 3.0), tuple(rotation(10, 0)[:, 2]))
    T = mounting.T_level_points
    np.testing.assert_allclose(T @ [1, 2, 3, 1], [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    # The axis of the tilt stays where it is.
    np.testing.assert_allclose(T[:3, :3] @ [1, 0, 0], [1, 0, 0], atol=1e-12)
    points = np.array([[1.0, 2.0, 3.0], [np.nan, 0, 0], [np.inf, 0, 0]])
    moved = mounting.level(points)
    assert moved.dtype == np.float32
    np.testing.assert_allclose(moved[0], 0, atol=1e-6)
    assert np.isnan(moved[1, 0])
    assert np.isinf(moved[2, 0])
    np.testing.assert_array_equal(Mounting().T_level_points, np.eye(4))


def test_points_without_a_place_are_seen_upright_without_a_word():
    mounting = Mounting((0.0, 0.0, 2.0), (0.1, 0.0, 0.99), 2.0)
    signalling = np.array([0x7FA00000], np.uint32).view(np.float32)[0]
    odd = [np.nan, np.inf, -np.inf, signalling, 3e38]
    xyz = np.array([[value, 0, 0] for value in odd] + [[1, 2, 3]], np.float32)
    moved = mounting.level(xyz)
    assert moved.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(moved[:, 0]), np.isnan(xyz[:, 0]))
    np.testing.assert_array_equal(moved[1:3], xyz[1:3])
    T = mounting.T_level_points
    np.testing.assert_allclose(moved[-1], T[:3, :3] @ [1, 2, 3] + T[:3, 3], rtol=1e-6)


def test_an_origin_on_the_ground_is_lifted_to_a_roof_and_a_sensor_s_is_left():
    on_ground = measure_mounting(SWEEP.xyz + LIFT)
    assert abs(on_ground.height_m) < MIN_SENSOR_HEIGHT_M
    raised = on_ground.raised()
    assert raised.height_m == ROOF_HEIGHT_M
    assert measure_mounting(raised.level(SWEEP.xyz + LIFT)).height_m == pytest.approx(ROOF_HEIGHT_M, abs=0.05)
    assert measure_mounting(SWEEP.xyz).raised() == measure_mounting(SWEEP.xyz)


@pytest.mark.parametrize(
    "xyz",
    [np.zeros((0, 3)), np.zeros((500, 3)), np.full((9, 3), np.nan), SWEEP.xyz @ rotation(0, 60).T],
    ids=["no points", "points at the origin", "NaN", f"more than {MAX_TILT_DEG} degrees"],
)
def test_where_there_is_no_ground_nothing_is_measured(xyz):
    assert measure_mounting(xyz) is None


def test_sweeps_are_seen_upright_with_their_camera(tmp_path):
    turn = rotation(0, 15)
    io.write_bin(tmp_path / "a.bin", SWEEP.xyz @ turn.T, SWEEP.intensity)
    calibration = SWEEP.calibration
    tilted = np.asarray(calibration.T_rect_velo, np.float64)
    tilted[:3, :3] = tilted[:3, :3] @ turn.T
    io.write_calibration(tmp_path / "a.txt", dataclasses.replace(calibration, T_rect_velo=tilted))
    sweep = dataclasses.replace(io.open_sweeps(tmp_path / "a.bin")[0], calibration_path=tmp_path / "a.txt")
    levelled = io.LevelSweeps([sweep], io.measure_sweeps([sweep]))
    assert len(levelled) == 1
    assert [seen.name for seen in levelled] == [seen.name for seen in levelled[:1]] == ["a"]
    xyz, intensity = levelled[0].read_points()
    np.testing.assert_allclose(intensity, SWEEP.intensity)
    assert np.percentile(np.linalg.norm(xyz - SWEEP.xyz, axis=1), 95) < 0.5
    # A point is seen at the same place of the image, however its frame is turned.
    seen = np.asarray(levelled[0].read_calibration().T_rect_velo, np.float64)
    straight = np.asarray(calibration.T_rect_velo, np.float64)
    camera = [T[:3, :3] @ p + T[:3, 3] for T, p in ((seen, xyz[0]), (straight, SWEEP.xyz[0]))]
    np.testing.assert_allclose(*camera, atol=2e-3)
    assert dataclasses.replace(levelled[0], calibration_path=None).read_calibration() is None


def test_sweeps_without_a_ground_are_refused(tmp_path):
    io.write_bin(tmp_path / "a.bin", np.eye(3, dtype=np.float32), np.zeros(3, np.float32))
    with pytest.raises(io.InputError, match="no ground round the sensor"):
        io.measure_sweeps(io.open_sweeps(tmp_path / "a.bin"))


def test_an_upside_down_sensor_is_not_seen_upright_but_named(tmp_path):
    io.write_bin(tmp_path / "a.bin", SWEEP.xyz * [1, -1, -1])
    with pytest.raises(io.InputError, match=r"ground lies 1\.7. m above the sensor"):
        io.measure_sweeps(io.open_sweeps(tmp_path / "a.bin"))
