"""What the fuzzer reads: every reader of `jaxbox.io`, with small files of the formats' own libraries."""

import contextlib
import dataclasses
import importlib
import json
import pathlib
import struct
import tempfile
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import cv2
import laspy
import numpy as np
import plyfile
import pyarrow as pa
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from pyarrow import feather
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from jaxbox import DetectorConfig, io
from jaxbox.cli.results import RunAccount
from jaxbox.config.fields import config_to_toml
from jaxbox.io import foxglove
from jaxbox.io.jsonl import JSONL
from jaxbox.io.mcap_results import MCAP_RESULTS
from jaxbox.io.parquet import PARQUET
from jaxbox.io.pose_track import UnusableSource
from jaxbox.io.recorded_poses import collect_poses, odometry_poses, tf_poses
from jaxbox.io.results import ResultFile, SweepResult
from jaxbox.io.rosbag import MessageDecoder, decode_message
from jaxbox.io.velodyne import calibrated_sensor, decode_packets

CLOUD = "sensor_msgs/msg/PointCloud2"
STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
NUM_POINTS = 12
POINTS = np.random.default_rng(0).uniform(-30, 30, (NUM_POINTS, 5)).astype(np.float32)
"""x, y, z, intensity, ring."""
NAMES = ("x", "y", "z", "intensity", "ring")
TIME_NS = 10**18
RECORD = {
    "name": "a",
    "timestamp_ns": TIME_NS,
    "boxes": [
        {"label": "car", "score": 0.5, "center": [9.0, 1.0, -1.0], "size": [4.0, 1.7, 1.5], "yaw": 0.1,
         "heading": 0.1, "front_probability": 0.7, "num_points": 99},
    ],
    "status": [],
    "counts": {"points": 12},
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Target:
    """A reader and what it is fed with."""

    file_name: str
    """Of the file that holds the bytes; its suffix chooses the reader."""
    read: Callable[[pathlib.Path], object]
    """Reads that file; may raise `jaxbox.io.InputError`, and nothing else."""
    seeds: Callable[[], Mapping[str, bytes]]
    """Makes whole files to begin with."""
    known: Callable[[pathlib.Path], None] = lambda _: None
    """Writes the files that belong to it, into its folder."""


# --- points ---------------------------------------------------------------------------------------


def read_sweeps(path: pathlib.Path) -> None:
    """Every sweep at a path; a damaged message among others is an error of its own."""
    for sweep in io.open_sweeps(path):
        with contextlib.suppress(io.InputError):
            check_points(*sweep.read_points())


def check_points(xyz: np.ndarray, intensity: np.ndarray) -> None:
    """What every reader of points promises."""
    assert xyz.shape == (len(intensity), 3), (xyz.shape, intensity.shape)
    assert xyz.dtype == intensity.dtype == np.float32


def points_target(suffix: str, seeds: Callable[[pathlib.Path], object]) -> Target:
    """A file of one sweep; the seeds are what is written into a folder, all of that suffix."""
    return Target(f"a{suffix}", lambda path: check_points(*io.read_points(path)), lambda: written(seeds))


def written(write: Callable[[pathlib.Path], object]) -> dict[str, bytes]:
    """The files that something writes into a folder."""
    with tempfile.TemporaryDirectory() as root:
        write(pathlib.Path(root))
        files = sorted(path for path in pathlib.Path(root).rglob("*") if path.is_file())
        return {str(path.relative_to(root)).replace("/", "_"): path.read_bytes() for path in files}


def write_text(folder: pathlib.Path) -> None:
    """With and without a header, with blanks and commas."""
    np.savetxt(folder / "a.xyz", POINTS, fmt="%.3f")
    np.savetxt(folder / "b.xyz", POINTS[:, :3], fmt="%.3f", delimiter=",", header="x,y,z", comments="")


def write_pcd(folder: pathlib.Path) -> None:
    """The three encodings, with columns of several types."""
    pypcd4 = importlib.import_module("pypcd4")
    for encoding in ("ascii", "binary", "binary_compressed"):
        types = (np.float32, np.float32, np.float64, np.float32, np.uint16)
        columns = [column.astype(kind) for column, kind in zip(np.abs(POINTS.T), types, strict=True)]
        cloud = pypcd4.PointCloud.from_points(columns, NAMES, types)
        cloud.save(folder / f"{encoding}.pcd", encoding=pypcd4.Encoding(encoding))


def write_ply(folder: pathlib.Path) -> None:
    """Text and both byte orders, with a face behind the vertices."""
    vertices = np.rec.fromarrays(POINTS.T, dtype=[(name, "f4") for name in NAMES])
    face = np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))])
    elements = [plyfile.PlyElement.describe(vertices, "vertex"), plyfile.PlyElement.describe(face, "face")]
    for name, text, order in (("ascii", True, "="), ("little", False, "<"), ("big", False, ">")):
        plyfile.PlyData(elements, text=text, byte_order=order).write(folder / f"{name}.ply")


def write_las(folder: pathlib.Path, suffix: str) -> None:
    """Two versions and point formats."""
    for version, point_format in (("1.2", 1), ("1.4", 6)):
        las = laspy.LasData(laspy.LasHeader(point_format=point_format, version=version))
        las.x, las.y, las.z = POINTS[:, :3].T.astype(float)
        las.intensity = np.arange(NUM_POINTS)
        las.write(str(folder / f"{version}{suffix}"))


def write_npy(folder: pathlib.Path) -> None:
    """A matrix, one in Fortran's order, and records."""
    np.save(folder / "a.npy", POINTS)
    np.save(folder / "b.npy", np.asfortranarray(POINTS.astype(np.float64)))
    np.save(folder / "c.npy", np.rec.fromarrays(POINTS.T, dtype=[(name, "f4") for name in NAMES]))


def write_npz(folder: pathlib.Path) -> None:
    """A matrix, named columns, and several arrays; stored and compressed."""
    np.savez(folder / "a.npz", POINTS)
    np.savez(folder / "b.npz", **dict(zip(NAMES, POINTS.T, strict=True)))
    np.savez_compressed(folder / "c.npz", points=POINTS, labels=np.arange(3))


def write_feather(folder: pathlib.Path) -> None:
    """Plain and compressed tables of half floats, as of Argoverse 2."""
    columns = {name: POINTS[:, index].astype(np.float16) for index, name in enumerate("xyz")}
    table = pa.table({**columns, "intensity": np.arange(NUM_POINTS, dtype=np.uint8)})
    for compression in ("uncompressed", "lz4", "zstd"):
        feather.write_feather(table, folder / f"{compression}.feather", compression=compression)


def write_feather_calibration(folder: pathlib.Path) -> None:
    """Where the sensors are."""
    place = {"tx_m": [0.0, 1.25], "ty_m": [0.0, 0.5], "tz_m": [0.0, 2.0]}
    table = pa.table({"sensor_name": ["down_lidar", "up_lidar"], **place})
    feather.write_feather(table, folder / "a.feather", compression="uncompressed")


def read_calibrated_feather(path: pathlib.Path) -> None:
    """A good sweep next to a calibration of these bytes."""
    check_points(*io.read_points(path.parents[1] / "sensors" / "lidar" / "1.feather"))


def write_log(folder: pathlib.Path) -> None:
    """The good sweep, in the folders of a log."""
    lidar = folder.parent / "sensors" / "lidar"
    lidar.mkdir(parents=True, exist_ok=True)
    (lidar / "1.feather").write_bytes(written(write_feather)["uncompressed.feather"])


# --- recordings -----------------------------------------------------------------------------------


def make_message(ros: int) -> Any:
    """A PointCloud2 of all the points."""
    types = STORES[ros].types
    time = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = {"stamp": time, "frame_id": "lidar"} | ({"seq": 0} if ros == 1 else {})
    field = types["sensor_msgs/msg/PointField"]
    return types[CLOUD](
        header=types["std_msgs/msg/Header"](**header),
        height=1,
        width=NUM_POINTS,
        fields=[field(name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate(NAMES)],
        is_bigendian=False,
        point_step=POINTS.itemsize * POINTS.shape[1],
        row_step=POINTS.nbytes,
        data=np.frombuffer(POINTS.tobytes(), np.uint8),
        is_dense=True,
    )


def serialized(ros: int) -> bytes:
    """The message's bytes in ROS 1 or ROS 2."""
    store = STORES[ros]
    return bytes((store.serialize_ros1 if ros == 1 else store.serialize_cdr)(make_message(ros), CLOUD))


def write_bag1(folder: pathlib.Path) -> None:
    """Plain, bz2 and lz4 chunks."""
    for compression in (None, *rosbag1.Writer.CompressionFormat):
        writer = rosbag1.Writer(folder / f"{compression.name if compression else 'plain'}.bag")
        if compression:
            writer.set_compression(compression)
        with writer:
            connection = writer.add_connection("/points", CLOUD, typestore=STORES[1], msgdef="")
            for index in range(2):
                writer.write(connection, TIME_NS + index, serialized(1))


def write_bag2(folder: pathlib.Path, storage: str = "SQLITE3", compression: str | None = None) -> None:
    """A folder of ROS 2."""
    plugin = getattr(rosbag2.StoragePlugin, storage)
    writer = rosbag2.Writer(folder / "drive", version=9, storage_plugin=plugin)
    if compression:
        mode = getattr(rosbag2.CompressionMode, compression)
        writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/points", CLOUD, typestore=STORES[2])
        for index in range(2):
            writer.write(connection, TIME_NS + index, serialized(2))


def bag2_files(suffix: str, **options: Any) -> dict[str, bytes]:
    """Those files of a ROS 2 folder that end so."""
    files = written(lambda folder: write_bag2(folder, **options))
    return {name: data for name, data in files.items() if name.endswith(suffix)}


def write_storage(folder: pathlib.Path, **options: Any) -> None:
    """The storage that the metadata names."""
    with tempfile.TemporaryDirectory() as root:
        write_bag2(pathlib.Path(root), **options)
        for file in pathlib.Path(root, "drive").iterdir():
            (folder / file.name).write_bytes(file.read_bytes())


def velodyne_packets() -> list[bytes]:
    """A turn of an HDL-32E in few packets."""
    rng = np.random.default_rng(0)
    sent = []
    for number in range(10):
        blocks = bytearray()
        for block in range(12):
            azimuth = 3600 * number + 300 * block
            blocks += struct.pack("<HH", 0xEEFF, azimuth) + rng.integers(0, 256, 96, np.uint8).tobytes()
        sent.append(bytes(blocks) + struct.pack("<IBB", 10_000 * number, 0x37, 0x21))
    return sent


def write_captures(folder: pathlib.Path) -> None:
    """The same in the classic format and the newer one, each with an odd frame."""
    classic = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 2**16, 1)
    newer = struct.pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)
    newer += struct.pack("<IIHHIHHB3xI", 1, 28, 1, 0, 2**16, 9, 1, 9, 28)
    for number, payload in enumerate([b"short", *velodyne_packets()]):
        length = len(payload)
        frame = bytes(12) + b"\x08\x00" + struct.pack(">BBHIBB10x", 0x45, 0, 28 + length, 0, 64, 17)
        frame += struct.pack(">HHHH", 2368, 2368, 8 + length, 0) + payload
        classic += struct.pack("<IIII", 1, 10_000 * number, len(frame), len(frame)) + frame
        padded = frame + bytes(-len(frame) % 4)
        size = 32 + len(padded)
        newer += struct.pack("<IIIIIII", 6, size, 0, 0, number, len(frame), len(frame))
        newer += padded + struct.pack("<I", size)
    (folder / "a.pcap").write_bytes(classic)
    (folder / "a.pcapng").write_bytes(newer)


def capture_target(name: str) -> Target:
    """One of `write_captures`."""
    return Target(name, read_sweeps, lambda: {name: written(write_captures)[name]})


def velodyne_calibration() -> bytes:
    """Of 16 lasers, as ROS's driver has it."""
    fields = ("rot_correction", "vert_correction", "dist_correction", "vert_offset_correction")
    lasers = [{"laser_id": laser, **dict.fromkeys(fields, 0.01)} for laser in range(16)]
    return json.dumps({"num_lasers": 16, "distance_resolution": 0.002, "lasers": lasers}).encode()


def read_calibrated(path: pathlib.Path) -> None:
    """Decodes with what is read."""
    sensor = calibrated_sensor(path.with_suffix(".pcap"))
    packets = [(0, data[:-1] + b"\x22") for data in velodyne_packets()]
    decode_packets(packets, sensor, "here")


def write_mcap(folder: pathlib.Path) -> None:
    """ROS 2 with each compression and without an index, and Foxglove's own messages."""
    for compression in CompressionType:
        for indexed in (True, False):
            name = f"{compression.name}{'' if indexed else '_unindexed'}.mcap"
            with (folder / name).open("wb") as file:
                writer = McapWriter(
                    file, compression=compression, use_statistics=indexed, use_summary_offsets=indexed
                )
                writer.start()
                schema = writer.register_schema(CLOUD, "ros2msg", b"")
                channel = writer.register_channel("/points", "cdr", schema)
                for index in range(2):
                    writer.add_message(channel, TIME_NS + index, serialized(2), TIME_NS)
                writer.finish()
    with (folder / "foxglove.mcap").open("wb") as file:
        options = {"compression": CompressionType.NONE}
        writer = importlib.import_module("mcap_protobuf.writer").Writer(file, **options)
        writer.write_message("/points", foxglove_message(), TIME_NS, TIME_NS)
        writer.finish()


def foxglove_message() -> Any:
    """A ``foxglove.PointCloud``."""
    return foxglove.point_cloud(POINTS[:, :3], POINTS[:, 3], timestamp_ns=TIME_NS, frame_id="lidar")


def read_message(path: pathlib.Path) -> None:
    """The bytes of one message of ROS 2, and of ROS 1."""
    data = path.read_bytes()
    for is_ros1 in (False, True):
        with contextlib.suppress(io.InputError):
            check_points(*MessageDecoder(data, "here", is_ros1)())


# --- poses ----------------------------------------------------------------------------------------

POSE_MESSAGE_TYPES = {1: ("nav_msgs/msg/Odometry",), 2: ("nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage")}
"""By the version of ROS whose definitions the library has."""


def pose_messages() -> dict[str, bytes]:
    """Odometry and transforms of ROS 2, and odometry of ROS 1."""
    seeds = {}
    for ros, names in POSE_MESSAGE_TYPES.items():
        types, store = STORES[ros].types, STORES[ros]
        vector, turn = types["geometry_msgs/msg/Vector3"](x=1, y=2, z=3), {"x": 0, "y": 0, "z": 0.6, "w": 0.8}
        header = make_message(ros).header
        twist = types["geometry_msgs/msg/Twist"](linear=vector, angular=vector)
        quaternion = types["geometry_msgs/msg/Quaternion"](**turn)
        place = types["geometry_msgs/msg/Point"](x=1, y=2, z=3)
        pose = types["geometry_msgs/msg/Pose"](position=place, orientation=quaternion)
        transform = types["geometry_msgs/msg/Transform"](translation=vector, rotation=quaternion)
        spread = {"covariance": np.zeros(36)}
        for name in names:
            if name.endswith("Odometry"):
                message = types[name](
                    header=header,
                    child_frame_id="base_link",
                    pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, **spread),
                    twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, **spread),
                )
            else:
                stamped = types["geometry_msgs/msg/TransformStamped"]
                item = stamped(header=header, child_frame_id="lidar", transform=transform)
                message = types[name](transforms=[item])
            data = (store.serialize_ros1 if ros == 1 else store.serialize_cdr)(message, name)
            seeds[f"{name}{ros}"] = bytes(data)
    return seeds


def read_pose_message(path: pathlib.Path) -> None:
    """The bytes as a message of every kind, and the sensor's pose by it."""
    for name in POSE_MESSAGE_TYPES[2]:
        for is_ros1 in (False, True):
            with contextlib.suppress(io.InputError):
                message = decode_message(path.read_bytes(), name, "here", is_ros1=is_ros1)
                found = collect_poses([("/a", TIME_NS, message)], path)
                times = np.array([TIME_NS])
                list(odometry_poses(found, times, "lidar", by_stamp=False))
                with contextlib.suppress(UnusableSource):
                    tf_poses(found, times, "lidar", by_stamp=False)


OXTS = f"49.01 8.42 112.8 0.02 0.001 -1.2 {'0 ' * 24}\n"
POSE_FILES = {
    "kitti": b"1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 1 1 0 0 2 0 0 1 0\n",
    "tum": b"# time x y z quaternion\n1700000000.1 1 2 3 0 0 0 1\n",
    "matrix": b"1,0,0,1,0,1,0,2,0,0,1,3,0,0,0,1\n",
}


def write_nuscenes(folder: pathlib.Path) -> None:
    """A sweep, and the tables but that of the poses."""
    sweep = folder.parent / "samples" / "LIDAR_TOP" / "a__LIDAR_TOP__1.pcd.bin"
    sweep.parent.mkdir(parents=True, exist_ok=True)
    sweep.write_bytes(b"")
    data = {
        "ego_pose_token": "e",
        "calibrated_sensor_token": "c",
        "filename": f"samples/LIDAR_TOP/{sweep.name}",
    }
    (folder / "sample_data.json").write_text(json.dumps([data]))
    (folder / "calibrated_sensor.json").write_bytes(nuscenes_poses("c"))


def nuscenes_poses(token: str) -> bytes:
    """A table of one pose."""
    return json.dumps([{"token": token, "rotation": [1, 0, 0, 0.0], "translation": [1.0, 2, 3]}]).encode()


def write_argoverse_poses(folder: pathlib.Path) -> None:
    """Two poses of a log."""
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    columns = {
        name: np.array([value, value]) for name, value in zip(names, (1.0, 0, 0, 0, 5, 6, 7), strict=True)
    }
    table = pa.table({"timestamp_ns": np.array([1, 2]), **columns})
    feather.write_feather(table, folder / "a.feather", compression="uncompressed")


# --- labels, calibrations and settings ------------------------------------------------------------


def read_boxes(boxes: io.LabelledBoxes) -> None:
    """What every reader of boxes promises."""
    assert np.isfinite(boxes.center).all()
    assert (boxes.size[:, 0] >= boxes.size[:, 1]).all()
    assert ((-np.pi / 2 <= boxes.yaw) & (boxes.yaw < np.pi / 2)).all()


def argoverse2_json() -> bytes:
    """A list of one box."""
    names = ("tx_m", "ty_m", "tz_m", "length_m", "width_m", "height_m", "qw", "qx", "qy", "qz")
    return json.dumps([{"category": "BUS", **dict.fromkeys(names, 1.0)}]).encode()


LABEL = "Car 0.00 0 -1.57 614.2 181.8 727.3 284.8 1.57 1.73 4.15 1.00 1.75 13.22 -1.62"
LABELS = {
    "object": f"{LABEL}\n{LABEL} 0.5\nDontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\n".encode(),
    "tracking": f"0 -1 {LABEL}\n1 7 {LABEL}\n".encode(),
}
TRACK_DETECTION = "3,2,298.3,165.1,458.2,293.4,8.2,1.96,1.81,4.75,-4.57,1.84,13.5,-2.11,-1.78"
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0"
CALIBRATION = (
    f"P2: 700 0 600 45 0 700 180 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {IDENTITY}\n"
)
RAW_CALIBRATION = {
    "calib_velo_to_cam.txt": "R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n",
    "calib_cam_to_cam.txt": "S_rect_02: 1242 375\nR_rect_00: 1 0 0 0 1 0 0 0 1\n"
    "P_rect_02: 700 0 600 45 0 700 180 0 0 0 1 0\n",
}


def raw_calibration_target(name: str) -> Target:
    """One of the two files, next to a good other one."""

    def write_other(folder: pathlib.Path) -> None:
        for other, text in RAW_CALIBRATION.items():
            (folder / other).write_text(text)

    seeds = {name: RAW_CALIBRATION[name].encode()}
    return Target(name, lambda path: io.read_raw_calibration(path.parent), lambda: seeds, write_other)


def write_raw_drive(folder: pathlib.Path) -> None:
    """A sweep of a raw drive, whose times are next to its folder."""
    (folder / "data").mkdir(exist_ok=True)
    (folder / "data" / "0000000000.bin").write_bytes(b"")


def read_label_lines(path: pathlib.Path) -> None:
    """Labels, and their boxes where they have any."""
    for item in io.read_labels(path):
        assert np.isfinite(item.location).all()
    io.read_label_folder(path.parent)


def write_image(folder: pathlib.Path) -> None:
    """The two kinds that the data sets have."""
    image = np.arange(8 * 6 * 3, dtype=np.uint8).reshape(6, 8, 3)
    for suffix in (".png", ".jpg"):
        cv2.imwrite(str(folder / f"a{suffix}"), image)


# --- results that are read back -------------------------------------------------------------------


def result_target(kind: ResultFile) -> Target:
    """A result file of an earlier run, looked into and carried over."""

    def write(folder: pathlib.Path) -> None:
        with kind.open(folder / kind.name, False) as add:
            add(SweepResult(record=RECORD))

    def read(path: pathlib.Path) -> None:
        assert kind.finished is not None
        names = kind.finished(path)
        assert all(isinstance(name, str) for name in names)
        data = path.read_bytes()
        try:
            with kind.open(path, True) as add:
                add(SweepResult(record=RECORD | {"name": "b"}))
        except io.InputError:
            assert path.read_bytes() == data, "what cannot be continued stays as it was"

    return Target(kind.name, read, lambda: written(write))


def account(folder: pathlib.Path) -> RunAccount:
    """Of a run with these settings."""
    return RunAccount(output=folder, config=DetectorConfig(), options={"min_score": 0.0}, inputs=("a",))


def run_seeds(folder: pathlib.Path) -> None:
    """Only ``run.json`` of what a run writes."""
    account(folder).write(finished=True)
    (folder / "config.toml").unlink()


def write_run_config(folder: pathlib.Path) -> None:
    """The settings next to ``run.json``."""
    io.write_config(folder / "config.toml", DetectorConfig())


TARGETS: Mapping[str, Target] = {
    "bin": points_target(".bin", lambda folder: io.write_bin(folder / "a.bin", POINTS[:, :3])),
    "nuscenes": points_target(".pcd.bin", lambda f: (f / "a.pcd.bin").write_bytes(POINTS.tobytes())),
    "text": points_target(".xyz", write_text),
    "pcd": points_target(".pcd", write_pcd),
    "ply": points_target(".ply", write_ply),
    "las": points_target(".las", lambda folder: write_las(folder, ".las")),
    "laz": points_target(".laz", lambda folder: write_las(folder, ".laz")),
    "npy": points_target(".npy", write_npy),
    "npz": points_target(".npz", write_npz),
    "feather": points_target(".feather", write_feather),
    "feather_calibration": Target(
        "calibration/egovehicle_SE3_sensor.feather",
        read_calibrated_feather,
        lambda: written(write_feather_calibration),
        write_log,
    ),
    "rosbag1": Target("a.bag", read_sweeps, lambda: written(write_bag1)),
    "rosbag2_db3": Target("a.db3", read_sweeps, lambda: bag2_files(".db3")),
    "rosbag2_metadata": Target(
        "drive/metadata.yaml",
        lambda path: read_sweeps(path.parent),
        lambda: bag2_files(".yaml"),
        write_storage,
    ),
    "rosbag2_mcap": Target(
        "drive/drive.mcap",
        lambda path: read_sweeps(path.parent),
        lambda: bag2_files(".mcap", storage="MCAP"),
        lambda folder: write_storage(folder, storage="MCAP"),
    ),
    "mcap": Target("a.mcap", read_sweeps, lambda: written(write_mcap)),
    "pcap": capture_target("a.pcap"),
    "pcapng": capture_target("a.pcapng"),
    "velodyne_calibration": Target(
        "a.yaml", read_calibrated, lambda: {"calibration": velodyne_calibration()}
    ),
    "ros_message": Target("a.cdr", read_message, lambda: {"ros2": serialized(2), "ros1": serialized(1)}),
    "foxglove_message": Target(
        "a.pb",
        lambda path: check_points(*foxglove.PointCloudDecoder(path.read_bytes(), "here")()),
        lambda: {"cloud": foxglove_message().SerializeToString()},
    ),
    "argoverse2_boxes": Target(
        "a.json",
        lambda path: read_boxes(io.read_argoverse2_boxes(path)),
        lambda: {"boxes": argoverse2_json()},
    ),
    "argoverse2_ground": Target("a.u8", io.read_argoverse2_ground, lambda: {"flags": bytes([0, 1] * 8)}),
    "pandaset_boxes": Target(
        "a.txt",
        lambda path: read_boxes(io.read_pandaset_boxes(path)),
        lambda: {"boxes": b"Car 0 1 2 -1 4.5 1.8 1.5 0.3 12\nBus 0 9 2 -1 2.5 11 3 1.2\n"},
    ),
    "semantic_labels": Target("a.label", io.read_semantic_labels, lambda: {"labels": bytes(range(48))}),
    "kitti_labels": Target("a.txt", read_label_lines, lambda: LABELS),
    "kitti_tracks": Target("0000.txt", io.read_tracks, lambda: {"tracks": LABELS["tracking"]}),
    "kitti_track_detections": Target(
        "0000.txt", io.read_track_detections, lambda: {"detections": f"{TRACK_DETECTION}\n".encode() * 2}
    ),
    "kitti_calibration": Target("a.txt", io.read_calibration, lambda: {"calib": CALIBRATION.encode()}),
    "kitti_raw_velo_to_cam": raw_calibration_target("calib_velo_to_cam.txt"),
    "kitti_raw_cam_to_cam": raw_calibration_target("calib_cam_to_cam.txt"),
    "kitti_raw_timestamps": Target(
        "velodyne_points/timestamps.txt",
        lambda path: io.open_sweeps(path.parent / "data"),
        lambda: {"times": b"2011-09-26 13:02:25.594360375\n"},
        write_raw_drive,
    ),
    "drives": Target(
        "a.txt", lambda path: io.read_drives(path, ["1"]), lambda: {"drives": b"1 city # first\n2 road\n"}
    ),
    "pose_file": Target("a.txt", io.read_pose_file, lambda: POSE_FILES),
    "oxts": Target("a.txt", io.read_oxts, lambda: {"oxts": (2 * OXTS).encode()}),
    "pose_messages": Target("a.msg", read_pose_message, pose_messages),
    "nuscenes_poses": Target(
        "v1.0-mini/ego_pose.json",
        lambda path: io.find_poses(io.open_sweeps(path.parents[1])),
        lambda: {"ego_pose": nuscenes_poses("e")},
        write_nuscenes,
    ),
    "argoverse2_poses": Target(
        "city_SE3_egovehicle.feather",
        lambda path: io.find_poses(io.open_sweeps(path.parent / "sensors" / "lidar" / "1.feather")),
        lambda: written(write_argoverse_poses),
        lambda folder: write_log(folder / "calibration"),
    ),
    "image": Target("a.png", io.read_image, lambda: written(write_image)),
    "config_toml": Target(
        "a.toml", io.read_config, lambda: {"settings": config_to_toml(DetectorConfig()).encode()}
    ),
    "config_json": Target(
        "a.json", io.read_config, lambda: {"settings": b'{"preset": "paper", "vehicles.min_score": 0.1}'}
    ),
    "jsonl": result_target(JSONL),
    "parquet": result_target(PARQUET),
    "mcap_results": result_target(MCAP_RESULTS),
    "run_json": Target(
        "run.json",
        lambda path: account(path.parent).check_resumable(),
        lambda: written(run_seeds),
        write_run_config,
    ),
}
"""Every reader, by the name that `fuzz_readers` knows it by."""


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """A copy with one to four places changed: bytes, whole numbers, cut off, left out or said twice.

    Args:
      data: a whole file.
      rng: chooses what and where.

    Returns:
      The changed bytes.
    """
    changed = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        place, kind = int(rng.integers(len(changed) + 1)), int(rng.integers(6))
        length = int(rng.integers(1, 17))
        if kind == 0:
            changed[place : place + 1] = bytes([rng.integers(256)])
        elif kind == 1:
            changed[place : place + 4] = _NUMBERS[rng.integers(len(_NUMBERS))].to_bytes(4, "little")
        elif kind == 2:
            changed[place : place + 8] = (2 ** int(rng.integers(64)) - 1).to_bytes(8, "little")
        elif kind == 3:
            del changed[place : place + length]
        elif kind == 4:
            changed[place:place] = changed[place : place + length]
        else:
            del changed[place:]
    return bytes(changed)


_NUMBERS = (0, 1, 2**7, 2**8, 2**15, 2**16, 2**31 - 1, 2**31, 2**32 - 1)


@contextlib.contextmanager
def prepared(target: Target, root: pathlib.Path) -> Iterator[Callable[[bytes], bool]]:
    """Lends a function that feeds the reader with bytes, by way of a file below a folder.

    Args:
      target: the reader.
      root: an empty folder.

    Yields:
      What reads bytes, and tells whether they were read: False for `jaxbox.io.InputError`. It raises what the
      reader may not.
    """
    path = root / target.file_name
    path.parent.mkdir(parents=True, exist_ok=True)
    target.known(path.parent)

    def read(data: bytes) -> bool:
        path.write_bytes(data)
        try:
            target.read(path)
        except io.InputError:
            return False
        return True

    yield read
