"""Poses of every source: laws of the projection, files of the libraries' own writers, bad input."""

import dataclasses
import json
import math
import pathlib
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest
from mcap.writer import Writer as McapWriter
from pyarrow import feather
from rosbags import rosbag1, rosbag2
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation
from test_io_formats import CLOUD, STORES, make_message

from jaxbox import io
from jaxbox.geometry.mounting import Mounting
from jaxbox.geometry.rigid import inverse_rigid, relative_rigid
from jaxbox.io import nuscenes_poses
from jaxbox.io.pose_track import PoseTrack, UnusableSource
from jaxbox.tracking.poses import PoseSource, ego_motions

TF_MESSAGE = "tf2_msgs/msg/TFMessage"
ODOMETRY = "nav_msgs/msg/Odometry"
if TF_MESSAGE not in STORES[1].types:
    STORES[1].register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_MESSAGE))


def pose(x=0.0, y=0.0, z=0.0, *, yaw_deg=0.0, roll_deg=0.0):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZX", [yaw_deg, roll_deg], degrees=True).as_matrix()
    T[:3, 3] = x, y, z
    return T


def drive(count, *, step_m=1.0, turn_deg=3.0):
    """Poses along an arc."""
    T = [pose(100.0, -40.0, 2.0, yaw_deg=30.0)]
    for _ in range(count - 1):
        T.append(T[-1] @ pose(step_m, yaw_deg=turn_deg))
    return np.array(T)


def assert_rigid(T):
    np.testing.assert_allclose(
        T[:, :3, :3] @ T[:, :3, :3].swapaxes(1, 2), np.tile(np.eye(3), (len(T), 1, 1)), atol=1e-12
    )
    np.testing.assert_array_equal(T[:, 3], np.tile([0, 0, 0, 1.0], (len(T), 1)))


# --- KITTI ----------------------------------------------------------------------------------------

T_VELO_IMU = pose(-0.81, 0.32, -0.8, yaw_deg=0.4, roll_deg=-0.8)
IDENTITY_ROW = "1 0 0 0 0 1 0 0 0 0 1 0"
LATITUDE_DEG = 49.0


def row(T):
    return " ".join(f"{value:.12g}" for value in T[:3].ravel())


def oxts_line(east_m=0.0, north_m=0.0, up_m=0.0, *, yaw=0.0, roll=0.0, pitch=0.0):
    """Latitude and longitude of a place near the first one, by small steps on a sphere."""
    latitude = LATITUDE_DEG + math.degrees(north_m / 6378137.0 / 1.0)
    longitude = 8.0 + math.degrees(east_m / 6378137.0 / math.cos(math.radians(LATITUDE_DEG)))
    first = [latitude, longitude, 112.0 + up_m, roll, pitch, yaw]
    return " ".join([*(f"{value:.15g}" for value in first), *["0"] * 24])


def make_tracking(root, lines, *, sequence="0000", num_sweeps=None, calibration=True):
    folder = root / "training" / "velodyne" / sequence
    folder.mkdir(parents=True)
    for index in range(len(lines) if num_sweeps is None else num_sweeps):
        (folder / f"{index:06d}.bin").write_bytes(b"")
    (root / "training" / "oxts").mkdir(exist_ok=True)
    (root / "training" / "oxts" / f"{sequence}.txt").write_text("\n".join(lines) + "\n")
    if calibration:
        (root / "training" / "calib").mkdir(exist_ok=True)
        (root / "training" / "calib" / f"{sequence}.txt").write_text(
            f"P2: 700 0 600 45 0 700 180 0 0 0 1 0\nR_rect 1 0 0 0 1 0 0 0 1\n"
            f"Tr_velo_cam {row(T_CAM_VELO)}\nTr_imu_velo {row(T_VELO_IMU)}\n"
        )
    return folder


# x of the camera is to the right, y down and z forward.
T_CAM_VELO = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])


def test_constant_velocity_makes_a_straight_track(tmp_path):
    speed = np.array([0.9, 0.5, 0.02])
    yaw = math.atan2(speed[1], speed[0])
    lines = [oxts_line(*(speed * i), yaw=yaw) for i in range(40)]
    sweeps = io.open_sweeps(make_tracking(tmp_path, lines))
    told = []
    found = io.find_poses(sweeps, report=told.append)
    assert (found.source, found.times_ns) == (PoseSource.OXTS, None)
    path = tmp_path / "training" / "oxts" / "0000.txt"
    assert found.origin == str(path)
    assert told == [f"Poses: oxts, {path}."]
    assert_rigid(found.T_world_sensor)
    steps = ego_motions(found)[1:]
    # A straight drive: the same step each time, as long as it was, with no turn.
    np.testing.assert_allclose(steps, np.tile(steps[0], (39, 1, 1)), atol=2e-5)
    np.testing.assert_allclose(np.linalg.norm(steps[0, :3, 3]), np.linalg.norm(speed), rtol=1e-4)
    np.testing.assert_allclose(steps[:, :3, :3], np.tile(np.eye(3), (39, 1, 1)), atol=1e-6)
    # The IMU's pose, seen through where the LiDAR is.
    T_world_imu = found.T_world_sensor @ T_VELO_IMU
    np.testing.assert_allclose(T_world_imu[0, :3, 3], 0, atol=1e-9)
    np.testing.assert_allclose(T_world_imu[-1, :3, 3], 39 * speed, atol=0.02)


def test_a_turn_on_the_spot_moves_the_sensor_round_the_imu(tmp_path):
    lines = [oxts_line(yaw=math.radians(10 * i)) for i in range(10)]
    found = io.find_poses(io.open_sweeps(make_tracking(tmp_path, lines)))
    steps = ego_motions(found)[1:]
    expected = T_VELO_IMU @ pose(yaw_deg=10.0) @ inverse_rigid(T_VELO_IMU)
    np.testing.assert_allclose(steps, np.tile(expected, (9, 1, 1)), atol=1e-6)
    assert np.linalg.norm(expected[:2, 3]) > 0.1


def test_roll_pitch_and_yaw_are_turned_in_the_development_kits_order(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(oxts_line(roll=0.1, pitch=-0.2, yaw=2.0) + "\n")
    expected = Rotation.from_euler("ZYX", [2.0, -0.2, 0.1]).as_matrix()
    np.testing.assert_allclose(io.read_oxts(path)[0, :3, :3], expected, atol=1e-12)


def test_frames_of_a_tracking_sequence_take_their_lines(tmp_path):
    lines = [oxts_line(float(i)) for i in range(12)]
    sweeps = io.open_sweeps(make_tracking(tmp_path, lines))
    every = io.find_poses(sweeps).T_world_sensor
    some = io.find_poses([sweeps[i] for i in (3, 4, 9)]).T_world_sensor
    np.testing.assert_array_equal(some, every[[3, 4, 9]])


def test_a_raw_drive_has_a_file_a_frame(tmp_path):
    day = tmp_path / "2011_09_26"
    drive_path = day / "2011_09_26_drive_0001_sync"
    for folder in ("velodyne_points", "oxts"):
        (drive_path / folder / "data").mkdir(parents=True)
    for index in range(5):
        (drive_path / "velodyne_points" / "data" / f"{index:010d}.bin").write_bytes(b"")
        (drive_path / "oxts" / "data" / f"{index:010d}.txt").write_text(oxts_line(2.0 * index))
    sweeps = io.open_sweeps(tmp_path)
    assert {sweep.sequence for sweep in sweeps} == {drive_path.name}
    told = []
    assert io.find_poses(sweeps, report=told.append) is None
    assert "no calib_imu_to_velo.txt" in told[0]
    T = T_VELO_IMU
    numbers = " ".join(map(repr, T[:3, :3].ravel().tolist()))
    place = " ".join(map(repr, T[:3, 3].tolist()))
    (day / "calib_imu_to_velo.txt").write_text(f"R: {numbers}\nT: {place}\n")
    found = io.find_poses(sweeps)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(found.T_world_sensor[:, :3, 3], axis=0), axis=1), 2.0, atol=1e-6
    )
    (drive_path / "oxts" / "data" / f"{3:010d}.txt").unlink()
    with pytest.raises(io.InputError, match=r"oxts/data/0000000003\.txt: there is no such file"):
        io.find_poses(sweeps)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:3], r"0000\.txt: 3 lines, and 0000_000004 needs line 5"),
        (lambda lines: [*lines[:2], "", *lines[3:]], r"0000\.txt, line 3: 0 numbers; KITTI's oxts has 30"),
        (lambda lines: [lines[0], lines[1][:-4], *lines[2:]], r"line 2: 28 numbers"),
        (lambda lines: ["nan" + lines[0][2:], *lines[1:]], r"line 1: latitude is 'nan'"),
        (lambda lines: ["90" + lines[0][2:], *lines[1:]], r"line 1: latitude is 90"),
        (lambda lines: [lines[0].replace(" 8 ", " inf "), *lines[1:]], r"line 1: longitude is 'inf'"),
        (lambda lines: [], r"0000\.txt: it holds no pose"),
    ],
)
def test_bad_oxts_is_named_by_its_line(tmp_path, change, message):
    lines = change([oxts_line(float(i)) for i in range(5)])
    sweeps = io.open_sweeps(make_tracking(tmp_path, lines, num_sweeps=5))
    with pytest.raises(io.InputError, match=message):
        io.find_poses(sweeps)


def test_oxts_without_a_calibration_is_not_used_and_one_that_is_no_rotation_is_an_error(tmp_path):
    folder = make_tracking(tmp_path, [oxts_line()] * 2, calibration=False)
    told = []
    assert io.find_poses(io.open_sweeps(folder), report=told.append) is None
    assert "no calibration next to it says where the IMU is" in told[0]
    (tmp_path / "training" / "calib").mkdir()
    file = tmp_path / "training" / "calib" / "0000.txt"
    file.write_text("Tr_imu_velo 2 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(io.InputError, match=r"0000\.txt, Tr_imu_velo: no rigid transform: its rotation"):
        io.find_poses(io.open_sweeps(folder))
    file.write_text(f"P2: {IDENTITY_ROW}\n")
    with pytest.raises(io.InputError, match="no key Tr_imu_to_velo or Tr_imu_velo; it holds P2"):
        io.find_poses(io.open_sweeps(folder))


def test_sweeps_of_several_sequences_are_refused(tmp_path):
    for sequence in ("0000", "0001"):
        make_tracking(tmp_path, [oxts_line()] * 2, sequence=sequence)
    sweeps = io.open_sweeps(tmp_path)
    with pytest.raises(ValueError, match="several sequences; see group_sequences"):
        io.find_poses(sweeps)
    for name, group in io.group_sequences(sweeps):
        assert io.find_poses(group).origin.endswith(f"{name}.txt")


def make_odometry(root, T_world_cam, *, own=False):
    sequence = root / "sequences" / "07"
    (sequence / "velodyne").mkdir(parents=True)
    for index in range(len(T_world_cam)):
        (sequence / "velodyne" / f"{index:06d}.bin").write_bytes(b"")
    (sequence / "calib.txt").write_text(f"P0: {IDENTITY_ROW}\nTr: {row(T_CAM_VELO)}\n")
    file = sequence / "poses.txt" if own else root / "poses" / "07.txt"
    file.parent.mkdir(exist_ok=True)
    file.write_text("\n".join(map(row, T_world_cam)))
    return sequence / "velodyne"


@pytest.mark.parametrize("own", [False, True])
def test_poses_of_the_odometry_benchmark_are_the_cameras(tmp_path, own):
    T_world_velo = drive(6)
    T_first = inverse_rigid(T_world_velo[0]) @ T_world_velo
    T_world_cam = T_CAM_VELO @ T_first @ inverse_rigid(T_CAM_VELO)
    found = io.find_poses(io.open_sweeps(make_odometry(tmp_path, T_world_cam, own=own)))
    assert found.source == PoseSource.POSE_FILE
    assert "of the camera" in found.origin
    np.testing.assert_allclose(found.T_world_sensor, T_first, atol=1e-9)


# --- files that are named -------------------------------------------------------------------------


def make_sweeps(folder, count):
    folder.mkdir(exist_ok=True)
    for index in range(count):
        (folder / f"{index:04d}.npy").write_bytes(b"")
    return io.open_sweeps(folder)


def timed(sweeps, times_ns):
    return [
        dataclasses.replace(sweep, timestamp_ns=int(time))
        for sweep, time in zip(sweeps, times_ns, strict=True)
    ]


def tum_line(time_s, T, digits=9):
    numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
    return " ".join([f"{time_s:.{digits}f}", *(f"{value:.12g}" for value in numbers)])


START_NS = 1_700_000_000 * 10**9


def test_the_kind_of_a_file_is_known_by_its_numbers(tmp_path):
    T = drive(5)
    sweeps = make_sweeps(tmp_path / "sweeps", 5)
    times = START_NS + np.arange(5) * 10**8
    files = {
        "kitti.txt": "\n".join(["# x", *map(row, T), ""]),
        "commas.csv": "\n".join(row(item).replace(" ", ",") for item in T),
        "matrix.txt": "\n".join(f"{row(item)} 0 0 0 1" for item in T),
        "tum.txt": "\n".join(tum_line(time / 1e9, item) for time, item in zip(times, T, strict=True)),
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
        found = io.find_poses(timed(sweeps, times), poses_path=tmp_path / name)
        assert_rigid(found.T_world_sensor)
        np.testing.assert_allclose(found.T_world_sensor, T, atol=2e-6)
        np.testing.assert_array_equal(found.times_ns, times)
        assert "of the sensor" in found.origin
    assert io.read_pose_file(tmp_path / "tum.txt").kind == "TUM"


def test_a_named_file_comes_before_the_data_set_and_the_calibration_decides_its_frame(tmp_path):
    folder = make_tracking(tmp_path, [oxts_line(float(i)) for i in range(4)])
    T = drive(4)
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "0000.txt").write_text("\n".join(map(row, T)))
    sweeps = io.open_sweeps(folder)
    for path in (tmp_path / "poses", tmp_path / "poses" / "0000.txt"):
        found = io.find_poses(sweeps, poses_path=path)
        assert found.source == PoseSource.POSE_FILE
        expected = inverse_rigid(T_CAM_VELO) @ T @ T_CAM_VELO
        np.testing.assert_allclose(found.T_world_sensor, expected, atol=1e-9)
    sensor = io.find_poses(sweeps, poses_path=path, frame=io.PoseFrame.SENSOR)
    np.testing.assert_allclose(sensor.T_world_sensor, T, atol=1e-9)
    with pytest.raises(io.InputError, match=r"nowhere\.txt: there is no such file"):
        io.find_poses(sweeps, poses_path=tmp_path / "nowhere.txt")
    bare = make_sweeps(tmp_path / "bare", 4)
    with pytest.raises(io.InputError, match="need the sweeps' calibration"):
        io.find_poses(bare, poses_path=path, frame=io.PoseFrame.CAMERA)


def test_a_line_is_a_sweep_by_its_place_or_by_its_number(tmp_path):
    T = drive(6)
    file = tmp_path / "poses.txt"
    sweeps = make_sweeps(tmp_path / "sweeps", 6)
    file.write_text("\n".join(map(row, T)))
    some = io.find_poses([sweeps[2], sweeps[4]], poses_path=file)
    np.testing.assert_allclose(some.T_world_sensor, T[[2, 4]], atol=1e-9)
    file.write_text("\n".join(map(row, T[:2])))
    placed = io.find_poses([sweeps[2], sweeps[4]], poses_path=file)
    np.testing.assert_allclose(placed.T_world_sensor, T[:2], atol=1e-9)
    with pytest.raises(io.InputError, match=r"poses\.txt: 2 lines for 6 sweeps up to 0005; a line is needed"):
        io.find_poses(sweeps, poses_path=file)


def test_times_of_a_file_are_interpolated_and_hardly_extrapolated(tmp_path):
    T = drive(11, step_m=0.2, turn_deg=0.5)
    file = tmp_path / "tum.txt"
    # In any order.
    lines = [tum_line(START_NS / 1e9 + 0.1 * i, item) for i, item in enumerate(T)]
    file.write_text("\n".join(lines[::-1]))
    sweeps = make_sweeps(tmp_path / "sweeps", 3)
    for offsets_ms in ([0, 50, 333], [-90, 0, 1000], [10, 500, 1099]):
        times = START_NS + np.array(offsets_ms) * 10**6
        found = io.find_poses(timed(sweeps, times), poses_path=file)
        # The arc between the poses, whose sagitta is far below a millimetre.
        expected = np.array([T[0] @ arc(offset / 100.0) for offset in offsets_ms])
        np.testing.assert_allclose(found.T_world_sensor, expected, atol=2e-3)
        assert "by time" in found.origin
    for offsets_ms in ([-101, 0, 1], [0, 1, 1101]):
        times = START_NS + np.array(offsets_ms) * 10**6
        with pytest.raises(io.InputError, match=r"its poses are from 1700000000\.000 to 1700000001\.000 s"):
            io.find_poses(timed(sweeps, times), poses_path=file)


def arc(steps):
    """The pose after some steps of 0.2 m and 0.5 degrees, each of which turns at its end."""
    whole = math.floor(steps)
    T = np.linalg.matrix_power(pose(0.2, yaw_deg=0.5), whole)
    return T @ pose(0.2 * (steps - whole), yaw_deg=0.5 * (steps - whole))


def test_a_hole_in_the_poses_is_not_bridged():
    T = drive(4)
    track = PoseTrack.sorted([0, 10**8, 3 * 10**9, 31 * 10**8], T)
    np.testing.assert_allclose(track.at(np.array([10**8, 3 * 10**9])), T[1:3], atol=1e-12)
    with pytest.raises(UnusableSource, match=r"no pose for 2\.90 s round sweep 1 of 2"):
        track.at(np.array([0, 10**9]))
    one = PoseTrack.sorted([5], T[:1])
    np.testing.assert_array_equal(one.at(np.array([5, 5])), T[[0, 0]])
    with pytest.raises(UnusableSource, match="its poses are from"):
        one.at(np.array([6]))
    # Of two poses of one time the later one counts.
    np.testing.assert_allclose(PoseTrack.sorted([7, 7], T[:2]).at(np.array([7])), T[1:2], atol=1e-12)


def test_extrapolation_does_not_go_by_the_last_two_poses_alone():
    times = np.arange(0, 5 * 10**8, 10**7)
    T = np.array([pose(time * 1e-8) for time in times])
    T[-1, 0, 3] += 0.01
    found = PoseTrack.sorted(times, T).at(np.array([times[-1] + 10**8]))
    # By the last two alone the centimetre would be a decimetre.
    assert abs(found[0, 0, 3] - (times[-1] + 10**8) * 1e-8) < 0.03


def test_a_file_whose_times_are_others_is_taken_line_by_line_where_there_are_as_many(tmp_path):
    T = drive(3)
    file = tmp_path / "tum.txt"
    file.write_text("\n".join(tum_line(float(i), item) for i, item in enumerate(T)))
    sweeps = make_sweeps(tmp_path / "sweeps", 3)
    told = []
    found = io.find_poses(timed(sweeps, START_NS + np.arange(3)), poses_path=file, report=told.append)
    np.testing.assert_allclose(found.T_world_sensor, T, atol=1e-9)
    assert "a line a sweep, as its poses are from 0.000 to 2.000 s" in told[0]
    untimed = io.find_poses(sweeps, poses_path=file)
    assert "as the sweeps have no times" in untimed.origin
    assert untimed.times_ns is None
    with pytest.raises(io.InputError, match=r"tum\.txt: the sweeps have no times. .* 2 sweeps; there are 3"):
        io.find_poses(sweeps[:2], poses_path=file)


BAD_FILES = {
    "": "it holds no pose",
    "# only a comment\n": "it holds no pose",
    "1 2 3\n": "line 1: 3 numbers; each line needs 12",
    f"{IDENTITY_ROW}\n\n{IDENTITY_ROW} 0 0 0 1\n": "line 3: 16 numbers",
    IDENTITY_ROW.replace("1", "nan", 1): "line 1: number 1 is 'nan'",
    f"{IDENTITY_ROW}\n{IDENTITY_ROW.replace('1', '1e999', 1)}": "line 2: number 1 is '1e999'",
    IDENTITY_ROW.replace("1", "1.01", 1): "line 1: no pose: its rotation is off by 0.02",
    IDENTITY_ROW.replace("1", "-1", 1): "line 1: no pose: its rotation is a mirror image",
    IDENTITY_ROW.replace("1 0 0 0 0", "1 0 0 1e12 0", 1): "line 1: no pose: its position is 1e+12 m away",
    f"{IDENTITY_ROW} 0 0 0 2": "line 1: no pose: its last row is",
    "0 1 2 3 0 0 0 0": "line 1: no pose: its quaternion has length 0, not 1",
    "0 1 2 3 0 0 0 1.01": "its quaternion has length 1.01",
    "1e30 1 2 3 0 0 0 1": "line 1: the time 1e+30 is neither",
    "one 2 3 4 5 6 7 8": "line 1: number 1 is 'one'",
}


@pytest.mark.parametrize("text", BAD_FILES, ids=range(len(BAD_FILES)))
def test_a_bad_file_is_named_by_its_line(tmp_path, text):
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(io.InputError) as error:
        io.read_pose_file(tmp_path / "poses.txt")
    assert BAD_FILES[text] in str(error.value)
    assert "poses.txt" in str(error.value)


def test_rotations_of_few_digits_are_made_exact(tmp_path):
    T = drive(5)
    rough = "\n".join(" ".join(f"{value:.4f}" for value in item[:3].ravel()) for item in T)
    (tmp_path / "poses.txt").write_text(rough)
    found = io.read_pose_file(tmp_path / "poses.txt").T
    assert_rigid(found)
    np.testing.assert_allclose(found, T, atol=1e-4)


# --- recordings -----------------------------------------------------------------------------------

DELAY_NS = 70_000_000
"""From a message's stamp to its recording."""
SWEEP_TIMES = START_NS + 25_000_000 + np.arange(4) * 10**8
ODOM_TIMES = START_NS - 10**7 + np.arange(22) * 2 * 10**7
T_BASE_LIDAR = pose(1.2, 0.0, 1.7, yaw_deg=-90.0)


def true_pose(time_ns):
    """A constant turn, in UTM coordinates."""
    seconds = (time_ns - START_NS) / 1e9
    return pose(691_608.0, 5_334_764.0, 519.0, yaw_deg=20.0) @ arc_at(seconds)


def arc_at(seconds, speed=8.0, rate_deg=6.0):
    angle = math.radians(rate_deg) * seconds
    radius = speed / math.radians(rate_deg)
    return pose(radius * math.sin(angle), radius * (1 - math.cos(angle)), yaw_deg=math.degrees(angle))


def stamp(types, time_ns):
    return types["builtin_interfaces/msg/Time"](sec=int(time_ns) // 10**9, nanosec=int(time_ns) % 10**9)


class Writer:
    """Messages of one of the kinds of recording, by its own library."""

    def __init__(self, path):
        self.path, self.ros = path, 1 if path.suffix == ".bag" else 2
        self.types, self.store = STORES[self.ros].types, STORES[self.ros]
        self.messages = []

    def header(self, time_ns, frame):
        extra = {"seq": 0} if self.ros == 1 else {}
        return self.types["std_msgs/msg/Header"](stamp=stamp(self.types, time_ns), frame_id=frame, **extra)

    def place(self, T):
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        return T[:3, 3].tolist(), self.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)

    def cloud(self, time_ns, *, frame="lidar", stamped=True):
        message = make_message(self.ros)
        header = self.header(time_ns if stamped else 0, frame)
        self.add("/points", CLOUD, dataclasses.replace(message, header=header), time_ns)

    def odometry(self, time_ns, T, *, child="base_link", topic="/odom"):
        types, (xyz, quaternion) = self.types, self.place(T)
        vector = types["geometry_msgs/msg/Vector3"]
        still = types["geometry_msgs/msg/Twist"](linear=vector(x=0, y=0, z=0), angular=vector(x=0, y=0, z=0))
        point = types["geometry_msgs/msg/Point"](*xyz)
        message = types[ODOMETRY](
            header=self.header(time_ns, "odom"),
            child_frame_id=child,
            pose=types["geometry_msgs/msg/PoseWithCovariance"](
                pose=types["geometry_msgs/msg/Pose"](position=point, orientation=quaternion),
                covariance=np.zeros(36),
            ),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=still, covariance=np.zeros(36)),
        )
        self.add(topic, ODOMETRY, message, time_ns)

    def transform(self, time_ns, parent, child, T, *, static=False):
        types, (xyz, quaternion) = self.types, self.place(T)
        item = types["geometry_msgs/msg/TransformStamped"](
            header=self.header(time_ns, parent),
            child_frame_id=child,
            transform=types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](*xyz), rotation=quaternion
            ),
        )
        topic = "/tf_static" if static else "/tf"
        self.add(topic, TF_MESSAGE, types[TF_MESSAGE](transforms=[item]), time_ns)

    def add(self, topic, name, message, time_ns):
        serialize = self.store.serialize_ros1 if self.ros == 1 else self.store.serialize_cdr
        self.messages.append((int(time_ns) + DELAY_NS, topic, name, bytes(serialize(message, name))))

    def write(self):
        self.messages.sort(key=lambda item: item[0])
        if self.path.suffix == ".mcap":
            self.write_mcap()
            return
        writer = rosbag1.Writer(self.path) if self.ros == 1 else rosbag2.Writer(self.path, version=9)
        with writer:
            topics = {}
            for time, topic, name, data in self.messages:
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, name, typestore=self.store)
                writer.write(topics[topic], time, data)

    def write_mcap(self):
        with self.path.open("wb") as file:
            writer = McapWriter(file, chunk_size=4096)
            writer.start()
            channels = {}
            for time, topic, name, data in self.messages:
                if topic not in channels:
                    schema = writer.register_schema(name, "ros2msg", b"")
                    channels[topic] = writer.register_channel(topic, "cdr", schema)
                writer.add_message(channels[topic], time, data, time)
            writer.finish()


RECORDINGS = ["drive.bag", "drive", "drive.mcap"]


def record(path, fill, **options):
    writer = Writer(path)
    for time in SWEEP_TIMES:
        writer.cloud(time, **options)
    fill(writer)
    writer.write()
    return io.open_sweeps(path)


def fill_odometry(writer, *, static=True, **options):
    for time in ODOM_TIMES:
        writer.odometry(time, true_pose(time), **options)
    if static:
        writer.transform(START_NS, "base_link", "mast", pose(1.2, 0.0, 0.0), static=True)
        writer.transform(START_NS, "mast", "lidar", pose(0.0, 0.0, 1.7, yaw_deg=-90.0), static=True)


def expected_poses(T_body_sensor=T_BASE_LIDAR):
    return np.array([true_pose(time) for time in SWEEP_TIMES]) @ T_body_sensor


@pytest.mark.parametrize("name", RECORDINGS)
def test_odometry_is_interpolated_to_the_stamps_of_the_sweeps(tmp_path, name):
    sweeps = record(tmp_path / name, fill_odometry)
    told = []
    found = io.find_poses(sweeps, report=told.append)
    assert found.source == PoseSource.ODOMETRY
    assert told == [f"Poses: odometry, {tmp_path / name}, /odom."]
    # Chords of 2 cm of arc; by the times of recording it would be off by half a metre.
    np.testing.assert_allclose(found.T_world_sensor, expected_poses(), atol=1e-4)
    np.testing.assert_array_equal(found.times_ns, SWEEP_TIMES)
    np.testing.assert_array_equal(
        io.find_poses(sweeps[1:3]).T_world_sensor, found.T_world_sensor[1:3], "some of the sweeps"
    )
    steps = relative_rigid(expected_poses()[:-1], expected_poses()[1:])
    np.testing.assert_allclose(ego_motions(found)[1:], steps, atol=1e-4)


def fill_tf(writer, *, smooth="odom", top="map"):
    writer.transform(START_NS, "base_link", "lidar", T_BASE_LIDAR, static=True)
    for time in ODOM_TIMES:
        writer.transform(time, f"/{smooth}", "base_link", true_pose(time))
        # A localisation that jumps.
        writer.transform(time, top, smooth, pose(5.0 * (time % 3)))


@pytest.mark.parametrize("name", RECORDINGS)
def test_transforms_are_chained_up_to_the_frame_that_does_not_jump(tmp_path, name):
    sweeps = record(tmp_path / name, fill_tf)
    found = io.find_poses(sweeps)
    assert found.source == PoseSource.TF
    assert found.origin.endswith("/tf, lidar in odom")
    np.testing.assert_allclose(found.T_world_sensor, expected_poses(), atol=1e-4)


def test_without_that_frame_the_root_is_the_world(tmp_path):
    sweeps = record(tmp_path / "a.mcap", lambda writer: fill_tf(writer, smooth="vehicle", top="world"))
    assert io.find_poses(sweeps).origin.endswith("/tf, lidar in world")


def test_a_level_sweep_has_the_poses_of_its_level_frame(tmp_path):
    sweeps = record(tmp_path / "a.mcap", fill_odometry)
    mounting = Mounting((0.1, 0.0, 0.2), (0.0, math.sin(0.2), math.cos(0.2)))
    level = io.find_poses(io.LevelSweeps(sweeps, mounting))
    expected = expected_poses() @ inverse_rigid(mounting.T_level_points)
    np.testing.assert_allclose(level.T_world_sensor, expected, atol=1e-4)


def test_without_stamps_the_times_of_recording_are_taken(tmp_path):
    sweeps = record(tmp_path / "a.bag", fill_odometry, stamped=False)
    found = io.find_poses(sweeps)
    assert found.origin.endswith("/odom, by the times of recording")
    np.testing.assert_allclose(found.T_world_sensor, expected_poses(), atol=1e-4)


def test_a_sensor_whose_place_is_not_said_is_taken_for_the_body_and_that_is_told(tmp_path):
    sweeps = record(tmp_path / "a.bag", lambda writer: fill_odometry(writer, static=False))
    told = []
    found = io.find_poses(sweeps, report=told.append)
    assert "no transform from 'lidar' to 'base_link', which are taken for one" in told[0]
    np.testing.assert_allclose(found.T_world_sensor, expected_poses(np.eye(4)), atol=1e-4)


def test_odometry_of_another_body_goes_by_the_frame_above_both(tmp_path):
    T_base_imu = pose(-0.3, 0.1, 0.4, yaw_deg=90.0)

    def fill(writer):
        for time in ODOM_TIMES:
            writer.odometry(time, true_pose(time) @ T_base_imu, child="imu")
        writer.transform(START_NS, "base_link", "imu", T_base_imu, static=True)
        writer.transform(START_NS, "base_link", "lidar", T_BASE_LIDAR, static=True)

    found = io.find_poses(record(tmp_path / "a.mcap", fill))
    np.testing.assert_allclose(found.T_world_sensor, expected_poses(), atol=1e-4)


def test_odometry_that_does_not_cover_the_sweeps_gives_way_with_a_reason(tmp_path):
    def fill(writer):
        for time in ODOM_TIMES[:5]:
            writer.odometry(time, true_pose(time), topic="/wheels")
        fill_tf(writer)

    told = []
    found = io.find_poses(record(tmp_path / "a.mcap", fill), report=told.append)
    assert found.source == PoseSource.TF
    assert "/wheels: its poses are from 1699999999.990 to 1700000000.070 s" in told[0]
    assert "/wheels: its poses are from" in told[1]
    assert len(told) == 3, "by both clocks, and what is used"


def test_of_several_topics_of_odometry_one_can_be_named(tmp_path):
    def fill(writer):
        fill_odometry(writer, topic="/b")
        for time in ODOM_TIMES:
            writer.odometry(time, pose(), topic="/a")

    sweeps = record(tmp_path / "a.bag", fill)
    assert io.find_poses(sweeps).origin.endswith(", /a")
    assert io.find_poses(sweeps, topic="/b").origin.endswith(", /b")
    with pytest.raises(io.InputError, match=r"no odometry on /c; topics of nav_msgs/Odometry: /a, /b"):
        io.find_poses(sweeps, topic="/c")


def test_a_recording_without_poses_has_none(tmp_path):
    told = []
    sweeps = record(tmp_path / "a.mcap", lambda writer: None)
    assert io.find_poses(sweeps, report=told.append) is None
    assert told == []
    standing = record(
        tmp_path / "b.mcap",
        lambda writer: writer.transform(START_NS, "base_link", "lidar", T_BASE_LIDAR, static=True),
    )
    assert io.find_poses(standing, report=told.append) is None


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_a_pose_that_is_none_is_named_by_topic_and_time(tmp_path, name):
    for index, (x, w) in enumerate([(math.nan, 1.0), (0.0, 2.0), (0.0, 0.0), (0.0, math.nan)]):
        path = tmp_path / f"{index}{name}"

        def fill(writer, x=x, w=w):
            writer.odometry(ODOM_TIMES[0], pose(x))
            time, topic, kind, data = writer.messages.pop()
            good = np.float64(1.0).tobytes()
            # The real part is the last number of the pose that is 1.
            place = data.rindex(good)
            writer.messages.append(
                (time, topic, kind, data[:place] + np.float64(w).tobytes() + data[place + 8 :])
            )

        sweeps = record(path, fill)
        with pytest.raises(io.InputError, match=rf"{path.name}, /odom at \d+: no pose: "):
            io.find_poses(sweeps)


def test_frames_that_go_round_in_a_circle_are_refused(tmp_path):
    def fill(writer):
        writer.transform(START_NS, "a", "lidar", pose(), static=True)
        writer.transform(START_NS, "lidar", "a", pose())

    sweeps = record(tmp_path / "a.bag", fill)
    with pytest.raises(io.InputError, match=r"a\.bag: frames lidar < a < lidar go round in a circle"):
        io.find_poses(sweeps)


def test_a_damaged_cloud_does_not_move_the_others(tmp_path):
    def fill(writer):
        fill_odometry(writer)
        clouds = [i for i, message in enumerate(writer.messages) if message[1] == "/points"]
        time, topic, kind, data = writer.messages[clouds[1]]
        writer.messages[clouds[1]] = time, topic, kind, data[:30]

    found = io.find_poses(record(tmp_path / "a.mcap", fill))
    np.testing.assert_allclose(found.T_world_sensor, expected_poses(), atol=1e-4)


# --- nuScenes and Argoverse 2 ---------------------------------------------------------------------


def make_nuscenes(root, T_world_ego, T_ego_sensor, *, change=lambda tables: None):
    names = [
        f"n015-2018-07-24__LIDAR_TOP__{1532402927647951 + 50000 * i}.pcd.bin" for i in range(len(T_world_ego))
    ]
    folder = root / "samples" / "LIDAR_TOP"
    folder.mkdir(parents=True)
    for name in names:
        (folder / name).write_bytes(b"")

    def fields(T):
        return {
            "translation": T[:3, 3].tolist(),
            "rotation": Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True).tolist(),
        }

    tables = {
        "sample_data": [
            {"token": f"d{i}", "ego_pose_token": f"e{i}", "calibrated_sensor_token": "c",
             "filename": f"samples/LIDAR_TOP/{name}"}
            for i, name in enumerate(names)
        ] + [{"token": "x", "filename": "samples/CAM_FRONT/a.jpg"}],
        "ego_pose": [{"token": f"e{i}", **fields(T)} for i, T in enumerate(T_world_ego)],
        "calibrated_sensor": [{"token": "c", **fields(T_ego_sensor)}],
    }  # fmt: skip
    change(tables)
    (root / "v1.0-mini").mkdir()
    for name, table in tables.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(table, indent=0))
    return io.open_sweeps(root)


def test_nuscenes_poses_are_chained_over_its_tables(tmp_path):
    T, T_ego_sensor = drive(5), pose(0.94, 0.0, 1.84, yaw_deg=-90.0)
    sweeps = make_nuscenes(tmp_path, T, T_ego_sensor)
    assert {sweep.sequence for sweep in sweeps} == {"n015-2018-07-24"}
    found = io.find_poses(sweeps)
    assert (found.source, found.origin) == (PoseSource.NUSCENES, str(tmp_path / "v1.0-mini"))
    np.testing.assert_allclose(found.T_world_sensor, T @ T_ego_sensor, atol=1e-9)
    assert found.times_ns[1] - found.times_ns[0] == 50_000_000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tables: tables["ego_pose"].pop(), "no record e2"),
        (lambda tables: tables["ego_pose"][1].pop("rotation"), "e1: no rotation of 4"),
        (
            lambda tables: tables["ego_pose"][1].update(rotation=[1, 1, 1, 1]),
            "e1: no pose: its quaternion",
        ),
        (
            lambda tables: tables["ego_pose"][1].update(translation=["a"] * 3),
            "e1: no translation of 3",
        ),
        (
            lambda tables: tables["ego_pose"][0].update(translation=[math.nan] * 3),
            "e0: no pose: it has",
        ),
        (lambda tables: tables["sample_data"].insert(0, 5), "no JSON list of records"),
    ],
)
def test_bad_tables_of_nuscenes_are_named(tmp_path, change, message):
    sweeps = make_nuscenes(tmp_path, drive(3), np.eye(4), change=change)
    with pytest.raises(io.InputError, match=message):
        io.find_poses(sweeps)


def test_sweeps_that_no_table_knows_have_no_poses(tmp_path):
    sweeps = make_nuscenes(tmp_path, drive(3), np.eye(4), change=lambda tables: tables["sample_data"].pop(0))
    told = []
    assert io.find_poses(sweeps, report=told.append) is None
    assert "no record of n015" in told[0]


def test_tables_are_read_one_record_after_the_other(tmp_path, monkeypatch):
    records = [{"token": str(i), "text": "x" * (i % 37), "nested": {"a": [1, 2.5, None]}} for i in range(500)]
    for piece in (1, 7, 64, 2**20):
        monkeypatch.setattr(nuscenes_poses, "_PIECE_CHARACTERS", piece)
        for text in (json.dumps(records[:50]), json.dumps(records, indent=1), "[]", " [ ] "):
            (tmp_path / "a.json").write_text(text)
            assert list(nuscenes_poses.iter_json_records(tmp_path / "a.json")) == json.loads(text)
    for text in (
        "",
        "{}",
        "[{}",
        '[{"a": 1}',
        '[{"a" 1}]',
        "[1]",
        '[{"a": ' + "[" * 10**6,
        '[{"a": 1' + "0" * 9999 + "}]",
    ):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(io.InputError, match=r"a\.json: (no JSON list|JSON that cannot be read)"):
            list(nuscenes_poses.iter_json_records(tmp_path / "a.json"))
    (tmp_path / "a.json").write_bytes(b"[\xff]")
    with pytest.raises(io.InputError, match="JSON that cannot be read"):
        list(nuscenes_poses.iter_json_records(tmp_path / "a.json"))


def make_argoverse(root, T_city_ego, times, **columns):
    lidar = root / "log" / "sensors" / "lidar"
    lidar.mkdir(parents=True)
    for time in times:
        (lidar / f"{time}.feather").write_bytes(b"")
    (root / "log" / "calibration").mkdir()
    place = {"tx_m": [1.35], "ty_m": [0.0], "tz_m": [1.64]}
    calibration = root / "log" / "calibration" / "egovehicle_SE3_sensor.feather"
    feather.write_feather(pa.table({"sensor_name": ["up_lidar"], **place}), calibration)
    quaternions = Rotation.from_matrix(T_city_ego[:, :3, :3]).as_quat(scalar_first=True)
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    values = np.column_stack([quaternions, T_city_ego[:, :3, 3]])
    table = {"timestamp_ns": times, **dict(zip(names, values.T, strict=True)), **columns}
    table = {name: column for name, column in table.items() if column is not None}
    feather.write_feather(pa.table(table), root / "log" / "city_SE3_egovehicle.feather")
    return io.open_sweeps(lidar)


def test_argoverse_poses_are_those_of_the_upper_lidar(tmp_path):
    T = drive(5)
    times = 315966265259836000 + np.arange(5) * 10**8
    sweeps = make_argoverse(tmp_path, T, times)
    found = io.find_poses(sweeps)
    assert found.source == PoseSource.ARGOVERSE2
    np.testing.assert_allclose(found.T_world_sensor, T @ pose(1.35, 0.0, 1.64), atol=1e-9)
    np.testing.assert_array_equal(found.times_ns, times)
    assert {sweep.sequence for sweep in sweeps} == {"log"}


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"qw": np.full(3, np.nan)}, "row 0: no pose: its quaternion"),
        ({"qw": np.array([1.0, 5.0, 1.0])}, "row 1: no pose: its quaternion"),
        ({"tx_m": None}, "no column tx_m of numbers"),
        ({"tx_m": ["a", "b", "c"]}, "no column tx_m of numbers"),
    ],
)
def test_bad_poses_of_argoverse_are_named(tmp_path, columns, message):
    T = np.tile(np.eye(4), (3, 1, 1))
    sweeps = make_argoverse(tmp_path, T, 10**17 + np.arange(3) * 10**8, **columns)
    with pytest.raises(io.InputError, match=rf"city_SE3_egovehicle\.feather.*{message}"):
        io.find_poses(sweeps)


# --- sequences ------------------------------------------------------------------------------------


def test_sweeps_are_grouped_by_their_drive(tmp_path):
    for sequence in ("0000", "0003"):
        make_tracking(tmp_path, [oxts_line()] * 3, sequence=sequence)
    groups = io.group_sequences(io.open_sweeps(tmp_path))
    assert [(name, len(group)) for name, group in groups] == [("0000", 3), ("0003", 3)]
    assert [sweep.frame for sweep in groups[1][1]] == [0, 1, 2]
    plain = io.group_sequences(make_sweeps(tmp_path / "my_sweeps", 2))
    assert [(name, [sweep.name for sweep in group]) for name, group in plain] == [
        ("my_sweeps", ["0000", "0001"])
    ]


def test_sequences_of_one_name_have_their_folders_before_it(tmp_path):
    for split in ("a", "b"):
        for sequence in ("0000", "0001"):
            make_tracking(tmp_path / split, [oxts_line()], sequence=sequence)
    paths = [tmp_path / "a", tmp_path / "b" / "training" / "velodyne" / "0000"]
    sweeps = [sweep for path in paths for sweep in io.open_sweeps(path)]
    names = [name for name, _ in io.group_sequences(sweeps)]
    assert len(set(names)) == 3
    assert names[1] == "0001"
    assert (names[0][:2], names[2][:2]) == ("a_", "b_")
    assert all(name.endswith("_0000") for name in (names[0], names[2]))
    assert all("/" not in name for name in names)


def test_a_sequence_is_in_the_order_of_time_where_all_times_are_known(tmp_path):
    sweeps = make_sweeps(tmp_path / "sweeps", 4)
    ((_, group),) = io.group_sequences(timed(sweeps, [30, 10, 20, 10]))
    assert [sweep.name for sweep in group] == ["0001", "0003", "0002", "0000"]
    some = timed(sweeps, [30, 10, 20, 10])
    some[2] = dataclasses.replace(some[2], timestamp_ns=None)
    ((_, group),) = io.group_sequences(some)
    assert [sweep.name for sweep in group] == ["0000", "0001", "0002", "0003"]


def test_a_recording_is_one_sequence_and_is_not_read(tmp_path):
    for name in ("a.bag", "b.mcap"):
        record(tmp_path / name, lambda writer: None)
    make_sweeps(tmp_path / "plain", 2)
    sweeps = io.open_sweeps([tmp_path / "a.bag", tmp_path / "plain", tmp_path / "b.mcap"])
    groups = io.group_sequences(sweeps)
    assert [name for name, _ in groups] == ["a", "plain", "b"]
    assert [isinstance(group, io.RecordedSweeps) for _, group in groups] == [True, False, True]
    level = io.group_sequences(io.LevelSweeps(sweeps, Mounting((0.0, 0.0, 1.0))))
    assert [name for name, _ in level] == ["a", "plain", "b"]
    assert all(isinstance(group, io.LevelSweeps) for _, group in level)
    assert level[0][1][0].mounting.position == (0.0, 0.0, 1.0)
    part = io.group_sequences(io.open_sweeps(tmp_path / "a.bag")[1:3])
    assert [(name, len(group)) for name, group in part] == [("a", 2)]


# --- hostile files --------------------------------------------------------------------------------

MEMORY_BYTES = 2**29
READ_ALL = f"""
import pathlib, resource, sys
from jaxbox import io
from jaxbox.io import nuscenes_poses
pages = int(pathlib.Path("/proc/self/statm").read_text().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + {MEMORY_BYTES},) * 2)
for path in sorted(pathlib.Path(sys.argv[1]).iterdir()):
    for read in (io.read_pose_file, io.read_oxts, lambda p: list(nuscenes_poses.iter_json_records(p))):
        try:
            read(path)
            print(path.name, "read")
        except io.InputError:
            print(path.name, "refused")
"""


def test_files_made_to_fill_the_memory_are_refused(tmp_path):
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(2**40)
    with (tmp_path / "record").open("wb") as file:
        file.write(b'[{"a": "')
        file.truncate(2**38)
    (tmp_path / "deep").write_text("[" + '{"a": ' * 10**5)
    (tmp_path / "line").write_text("1 " * 10**6)
    (tmp_path / "link").symlink_to("/dev/zero")
    done = subprocess.run(
        [sys.executable, "-c", READ_ALL, tmp_path], capture_output=True, text=True, timeout=120, check=False
    )
    answers = done.stdout.split("\n")[:-1]
    assert len(answers) == 15, done.stderr[-2000:]
    assert all(answer.endswith("refused") for answer in answers)


def test_a_truncated_recording_is_an_error(tmp_path):
    record(tmp_path / "a.mcap", fill_odometry)
    data = (tmp_path / "a.mcap").read_bytes()
    sweeps = io.open_sweeps(tmp_path / "a.mcap")
    listed = list(sweeps)
    (tmp_path / "a.mcap").write_bytes(data[: len(data) // 2])
    with pytest.raises(io.InputError, match=r"a\.mcap: the MCAP file cannot be read"):
        io.find_poses(listed)


# --- real drives ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("sequence", "length_m"), [("0000", 16.5), ("0003", 51.0)])
def test_real_drives_have_poses(data_root, sequence, length_m):
    sweeps = io.open_sweeps(pathlib.Path(data_root) / "kitti_tracking" / "training" / "velodyne" / sequence)
    found = io.find_poses(sweeps)
    assert (found.source, len(found)) == (PoseSource.OXTS, len(sweeps))
    path = np.linalg.norm(np.diff(found.T_world_sensor[:, :3, 3], axis=0), axis=1).sum()
    assert path == pytest.approx(length_m, rel=0.02)
