"""Sources in other units, with other axes or more columns are read as the detector wants them."""

import dataclasses
import json
import pathlib

import lidar_packets as packets
import numpy as np
import pytest
from test_cli import run

from jaxbox import DetectorConfig, io
from jaxbox.cli.inputs import RunOptions, prepare_run
from jaxbox.geometry.rigid import rotation_about_z
from jaxbox.io import PointConvention
from jaxbox.io.columns import told_columns
from jaxbox.synthetic import make_sweep

XYZ = np.float32([[9, 1, -1.5], [20, -3, 0.25], [np.nan, 2, 3], [4, np.inf, 5]])
CALIBRATED = make_sweep(0, num_azimuths=90)

SOURCES = {
    "mm": (PointConvention(scale=0.001), lambda x, y, z: (1000 * x, 1000 * y, 1000 * z)),
    "camera": (PointConvention(axes="camera"), lambda x, y, z: (-y, -z, x)),
    "ned": (PointConvention(axes="ned"), lambda x, y, z: (x, -y, -z)),
    "enu": (PointConvention(axes="enu"), lambda x, y, z: (-y, x, z)),
    "left_handed": (PointConvention(flip="y"), lambda x, y, z: (x, -y, z)),
    "y_up_feet": (PointConvention(0.3048, "x,-z,y"), lambda x, y, z: (x / 0.3048, z / 0.3048, -y / 0.3048)),
    "mirrored_camera": (PointConvention(axes="z,-x,-y", flip="xz"), lambda x, y, z: (-y, z, -x)),
    "named": (PointConvention(axes=" -y, x ,z"), lambda x, y, z: (y, -x, z)),
}


def as_source(name, xyz):
    """Points of the detector's convention in that of a source."""
    return np.stack(SOURCES[name][1](*xyz.T), axis=1).astype(np.float32)


@pytest.mark.parametrize("name", SOURCES)
def test_points_of_any_source_become_the_detectors(name):
    convention = SOURCES[name][0]
    found = convention.apply(as_source(name, XYZ))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, XYZ, rtol=1e-6)
    turned = convention.rotation @ as_source(name, XYZ[:2]).T.astype(float) * convention.scale
    np.testing.assert_allclose(turned.T, XYZ[:2], rtol=1e-6)


def test_the_ordinary_convention_changes_no_bit():
    assert io.ORDINARY.apply(XYZ) is XYZ
    assert PointConvention(axes="ros") == io.ORDINARY


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"scale": 0}, "--scale 0: give the metres of a unit"),
        ({"scale": np.nan}, "--scale nan"),
        ({"axes": "x,y"}, "--axes x,y: give x, y and z .* camera"),
        ({"axes": "x,x,z"}, "--axes x,x,z"),
        ({"axes": "--x,y,z"}, "--axes --x,y,z"),
        ({"axes": "left"}, "--axes left"),
        ({"flip": "zz"}, "--flip zz: give the axes"),
        ({"flip": "up"}, "--flip up"),
        ({"columns": 3}, r"--columns 3: x, y, z and intensity are 4"),
    ],
)
def test_what_makes_no_convention_is_refused_by_its_option(options, expected):
    with pytest.raises(io.InputError, match=expected):
        PointConvention(**options)


@pytest.mark.parametrize("name", SOURCES)
def test_files_and_their_times_and_cameras_are_read_so(tmp_path, name):
    xyz, calibration = CALIBRATED.xyz, CALIBRATED.calibration
    io.write_bin(tmp_path / "velodyne" / "000001.bin", as_source(name, xyz))
    R = SOURCES[name][0].rotation
    T_rect_source = np.asarray(calibration.T_rect_velo, float).copy()
    T_rect_source[:3, :3] = T_rect_source[:3, :3] @ R
    io.write_calibration(
        tmp_path / "calib" / "000001.txt",
        dataclasses.replace(calibration, T_rect_velo=T_rect_source.astype(np.float32)),
    )
    (sweep,) = io.open_sweeps(tmp_path, convention=SOURCES[name][0])
    np.testing.assert_allclose(sweep.read_points()[0], xyz, rtol=1e-6)
    np.testing.assert_allclose(sweep.read_timed_points().xyz, xyz, rtol=1e-6)
    found = sweep.read_calibration()
    assert found is not None
    np.testing.assert_allclose(found.T_rect_velo, calibration.T_rect_velo, atol=1e-5)
    # What is levelled is levelled after it.
    level = io.LevelSweeps([sweep], io.measure_sweeps([sweep]))[0]
    assert abs(level.mounting.height_m - 1.73) < 0.1
    assert level.convention == sweep.convention


def test_recordings_are_read_so(tmp_path):
    xyz = np.float32([[12, 1, -1], [8, -2, -1.2]])
    seen = as_source("ned", np.repeat(xyz, 20, axis=0) * np.linspace(1, 2, 40)[:, None])
    packets.write_pcap(tmp_path / "a.pcap", packets.drive_packets(packets.HDL32E, [(seen, np.ones(40))] * 2))
    plain = [sweep.read_points()[0] for sweep in io.open_sweeps(tmp_path / "a.pcap")]
    sweeps = io.open_sweeps(tmp_path / "a.pcap", convention=PointConvention(2.0, "ned"))
    assert len(sweeps) == len(plain) == 2
    for sweep, before in zip(sweeps, plain, strict=True):
        np.testing.assert_allclose(sweep.read_points()[0], 2 * before * [1, -1, -1])


# --- poses ----------------------------------------------------------------------------------------


def poses():
    """(3, 4, 4): a drive round a bend, in the detector's axes."""
    T = np.tile(np.eye(4), (3, 1, 1))
    for frame in range(3):
        T[frame, :3, :3] = rotation_about_z(0.2 * frame)
        T[frame, :3, 3] = [5.0 * frame, 0.5 * frame**2, 0.1 * frame]
    return T


@pytest.mark.parametrize("name", ["camera", "ned", "enu", "left_handed"])
def test_poses_are_of_the_sensor_whose_points_are_read(tmp_path, name):
    convention = SOURCES[name][0]
    T = convention.T_points_source
    keeps_up = name == "enu"
    # The source's own account: of its axes in a world whose z is up, or in one of its axes.
    T_world_source = poses() @ T if keeps_up else T.T @ poses() @ T
    for frame in range(3):
        io.write_bin(tmp_path / f"{frame:06d}.bin", as_source(name, XYZ[:2]))
    np.savetxt(tmp_path / "poses.txt", T_world_source[:, :3].reshape(3, 12))
    sweeps = io.open_sweeps(tmp_path / "*.bin", convention=convention)
    found = io.find_poses(sweeps, poses_path=tmp_path / "poses.txt")
    assert found is not None
    np.testing.assert_allclose(found.T_world_sensor, poses(), atol=1e-9)


# --- columns --------------------------------------------------------------------------------------


def rows_of(columns, num_rows=600, seed=0):
    """A little sweep: x, y, z, intensity, ring and time."""
    rng = np.random.default_rng(seed)
    ring = rng.integers(0, 32, num_rows)
    azimuth, distance = rng.uniform(-np.pi, np.pi, num_rows), rng.gamma(2, 8, num_rows)
    x, y = distance * np.cos(azimuth), distance * np.sin(azimuth)
    z = np.maximum(-1.7, distance * np.radians(ring - 26))
    listed = [x, y, z, rng.uniform(0, 1, num_rows), ring, np.linspace(0, 0.1, num_rows)]
    return np.stack(listed[:columns], axis=1).astype("<f4")


@pytest.mark.parametrize("columns", [4, 5, 6])
@pytest.mark.parametrize("num_rows", [600, 599, 100])
def test_the_number_of_columns_is_told_by_the_numbers(tmp_path, columns, num_rows):
    rows = rows_of(columns, num_rows)
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    (sweep,) = io.open_sweeps(tmp_path)
    xyz, intensity = sweep.read_points()
    np.testing.assert_array_equal(xyz, rows[:, :3])
    np.testing.assert_array_equal(intensity, rows[:, 3])
    # A few values less are no rows of another number of columns.
    for cut in range(1, columns):
        (tmp_path / "a.bin").write_bytes(rows.tobytes()[: -4 * cut])
        with pytest.raises(io.InputError, match=r"a.bin: .*--columns N"):
            sweep.read_points()


def test_what_the_numbers_do_not_say_has_to_be_said(tmp_path):
    rows = np.random.default_rng(0).uniform(-30, 30, (600, 5)).astype("<f4")
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    with pytest.raises(
        io.InputError, match=r"4 or 5 or 6 columns of float32 fit .* do not say which.* --columns N"
    ):
        io.open_sweeps(tmp_path)[0].read_points()
    for columns in (4, 5, 10):
        (sweep,) = io.open_sweeps(tmp_path, convention=PointConvention(columns=columns))
        np.testing.assert_array_equal(sweep.read_points()[0], rows.reshape(-1, columns)[:, :3])
        assert sweep.read_timed_points().time_s is None
    with pytest.raises(io.InputError, match="12000 bytes is not a multiple of 28"):
        io.open_sweeps(tmp_path, convention=PointConvention(columns=7))[0].read_points()
    # So few that they say nothing are of four, as they ever were.
    assert told_columns(rows[:20].tobytes(), "a.bin") == 4


def test_real_sweeps_tell_their_columns(data_root):
    files = sorted((data_root / "kitti_object").rglob("*.bin"))[::4]
    files += sorted((data_root / "semantic_kitti").rglob("*.bin"))
    assert len(files) > 5
    for file in files:
        four = np.fromfile(file, "<f4").reshape(-1, 4)[::3]
        four = four[: len(four) // 60 * 60]
        ring = np.round(64 * np.linspace(0, 1, len(four)))
        five = np.column_stack([four, ring]).astype("<f4")
        six = np.column_stack([five, np.linspace(0, 0.1, len(four))]).astype("<f4")
        assert [told_columns(rows.tobytes(), file) for rows in (four, five, six)] == [4, 5, 6]


# --- the command line -----------------------------------------------------------------------------


def test_info_looks_at_what_the_detector_would_see(tmp_path):
    io.write_bin(tmp_path / "a.bin", 1000 * as_source("camera", CALIBRATED.xyz))
    done = run("info", tmp_path / "a.bin", "--scale", 0.001, "--axes", "camera", "--json")
    assert done.exit_code == 0, done.output
    (info,) = json.loads(done.stdout)["sweeps"]
    assert info["sensor_height_m"] == pytest.approx(1.73, abs=0.1)
    assert run("info", tmp_path / "a.bin", "--axes", "-y,x,z").exit_code == 0
    for option in (["--axes", "left"], ["--scale", "-1"], ["--flip", "q"], ["--columns", "1"]):
        refused = run("info", tmp_path / "a.bin", *option)
        assert refused.exit_code == 2
        assert option[0] in refused.stderr


def test_a_run_is_resumed_with_its_own_convention(tmp_path):
    io.write_bin(tmp_path / "a.bin", 1000 * CALIBRATED.xyz)

    def options(**changes):
        return RunOptions(
            output=pathlib.Path(tmp_path / "out"),
            config=DetectorConfig(),
            quiet=True,
            **changes,
        )

    mm = PointConvention(scale=0.001)
    _, account = prepare_run([str(tmp_path / "a.bin")], options(convention=mm, resume=False))
    account.write()
    recorded = json.loads((tmp_path / "out" / "run.json").read_text())["options"]["convention"]
    assert PointConvention(**recorded) == mm
    sweeps, _ = prepare_run([str(tmp_path / "a.bin")], options(convention=mm, resume=True))
    np.testing.assert_allclose(sweeps[0].read_points()[0], CALIBRATED.xyz, rtol=1e-6)
    with pytest.raises(io.InputError, match="convention differ"):
        prepare_run([str(tmp_path / "a.bin")], options(convention=io.ORDINARY, resume=True))
