"""Every point format and recording: what its own library writes is read back, and bad files are named."""

import importlib
import json
import pickle
import struct
import sys

import laspy
import numpy as np
import plyfile
import pyarrow as pa
import pypcd4
import pytest
from mcap.writer import Writer as McapWriter
from pyarrow import feather, parquet
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from jaxbox import io
from jaxbox.io import foxglove, pointcloud2, points
from jaxbox.io.parquet import TRACK_COLUMNS, open_parquet

XYZ = np.float32([[1.5, -2, 0.25], [30, 4, -1.75], [np.nan, np.inf, 7]])
INTENSITY = np.float32([0.25, 0.5, 9])
FINITE = XYZ[:2]
RING = np.uint16([3, 4, 5])


def assert_points(found, xyz=XYZ, intensity=INTENSITY):
    assert [array.dtype for array in found] == [np.float32, np.float32]
    np.testing.assert_array_equal(found[0], xyz)
    np.testing.assert_array_equal(found[1], intensity)


# --- point files ----------------------------------------------------------------------------------


def write_pcd(path, encoding):
    columns = [RING, *XYZ.T.astype(np.float64), INTENSITY]
    types = (np.uint16, np.float64, np.float64, np.float64, np.float32)
    cloud = pypcd4.PointCloud.from_points(columns, ("ring", "x", "y", "z", "intensity"), types)
    cloud.save(path, encoding=pypcd4.Encoding(encoding))


def write_ply(path, *, text, order):
    fields = [("x", "f4"), ("red", "u1"), ("y", "f8"), ("z", "f4"), ("scalar_Intensity", "f4")]
    vertices = np.rec.fromarrays([XYZ[:, 0], RING, XYZ[:, 1], XYZ[:, 2], INTENSITY], dtype=fields)
    face = plyfile.PlyElement.describe(np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))]), "face")
    vertex = plyfile.PlyElement.describe(vertices, "vertex")
    plyfile.PlyData([vertex, face], text=text, byte_order=order, comments=["of a test"]).write(path)


def write_structured(path):
    record = np.rec.fromarrays([INTENSITY, *XYZ.T], names="intensity,x,y,z")
    np.save(path, record)


def write_parquet(path):
    """In groups of rows, with a column of another type, one that is missing once, and capital letters."""
    columns = {"X": XYZ[:, 0].astype(np.float64), "Y": XYZ[:, 1], "Z": XYZ[:, 2], "Intensity": INTENSITY}
    table = pa.table({"name": ["a", None, "c"], **columns, "ring": RING})
    parquet.write_table(table, path, row_group_size=2)


WRITERS = {
    "a.parquet": write_parquet,
    "ascii.pcd": lambda path: write_pcd(path, "ascii"),
    "binary.pcd": lambda path: write_pcd(path, "binary"),
    "compressed.PCD": lambda path: write_pcd(path, "binary_compressed"),
    "ascii.ply": lambda path: write_ply(path, text=True, order="="),
    "little.ply": lambda path: write_ply(path, text=False, order="<"),
    "big.ply": lambda path: write_ply(path, text=False, order=">"),
    "a.npy": lambda path: np.save(path, np.column_stack([XYZ, INTENSITY, RING]).astype(np.float64)),
    "structured.npy": write_structured,
    "one.npz": lambda path: np.savez(path, anything=np.column_stack([XYZ, INTENSITY])),
    "several.npz": lambda path: np.savez_compressed(
        path, labels=RING, points=np.column_stack([XYZ, INTENSITY])
    ),
    "columns.npz": lambda path: np.savez(path, x=XYZ[:, 0], y=XYZ[:, 1], z=XYZ[:, 2], intensity=INTENSITY),
    "n__LIDAR_TOP__1532402927647951.pcd.bin": lambda path: path.write_bytes(
        np.column_stack([XYZ, INTENSITY, RING]).astype("<f4").tobytes()
    ),
}


@pytest.mark.parametrize("name", WRITERS)
def test_what_the_library_writes_is_read_back_with_its_non_finite_points(tmp_path, name):
    WRITERS[name](tmp_path / name)
    assert_points(io.read_points(tmp_path / name))
    (sweep,) = io.open_sweeps(tmp_path)
    assert_points(sweep.read_points())
    assert sweep.name == name[: name.index(".")]
    assert sweep.timestamp_ns == (1532402927647951000 if "LIDAR_TOP" in name else None)


def write_las(path):
    las = laspy.LasData(laspy.LasHeader(point_format=1, version="1.2"))
    las.x, las.y, las.z = FINITE.T.astype(float)
    las.write(path)


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_tables_that_claim_more_than_the_file_are_refused_before_they_are_read(tmp_path, name):
    file = tmp_path / name
    write_las(file)
    data = bytearray(file.read_bytes())
    # Of records in LAS; of chunks in LAZ, for which the decoder would ask 64 GB and end the process.
    place = (
        100
        if name == "a.las"
        else struct.unpack_from("<q", data, struct.unpack_from("<I", data, 96)[0])[0] + 4
    )
    struct.pack_into("<I", data, place, 2**32 - 1)
    file.write_bytes(data)
    with pytest.raises(io.InputError, match=rf"{name}: {len(data)} bytes .* promises"):
        io.open_sweeps(file)[0].read_points()


def test_a_compressed_pcd_whose_bytes_are_broken_is_an_input_error(tmp_path):
    file = tmp_path / "a.pcd"
    write_pcd(file, "binary_compressed")
    data = bytearray(file.read_bytes())
    # A copy that is longer than the room that is left: the decompressor has no answer.
    body = data.index(b"DATA binary_compressed") + len("DATA binary_compressed\n")
    data[body + 17] = 0xFF
    file.write_bytes(data)
    with pytest.raises(io.InputError, match="the points cannot be read"):
        io.open_sweeps(file)[0].read_points()


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_las_and_laz_are_scaled_and_map_coordinates_are_refused(tmp_path, name):
    for offset, file in ((0.0, tmp_path / name), (4.5e5, tmp_path / f"map_{name}")):
        header = laspy.LasHeader(point_format=1, version="1.2")
        header.scales, header.offsets = [0.001] * 3, [offset] * 3
        las = laspy.LasData(header)
        las.x, las.y, las.z = (FINITE.T + offset).astype(float)
        las.intensity = [7, 9]
        las.write(file)
    xyz, intensity = io.read_points(tmp_path / name)
    np.testing.assert_allclose(xyz, FINITE, atol=1e-6)
    np.testing.assert_array_equal(intensity, [7, 9])
    with pytest.raises(io.InputError, match=r"map_a.*x is about 450016 m: these are map coordinates"):
        io.read_points(tmp_path / f"map_{name}")


@pytest.mark.parametrize("calibrated", [False, True])
def test_feather_is_moved_to_the_sensor_of_a_calibrated_log_and_named_by_its_time(tmp_path, calibrated):
    lidar = tmp_path / "log" / "sensors" / "lidar"
    lidar.mkdir(parents=True)
    columns = {"x": FINITE[:, 0], "y": FINITE[:, 1], "z": FINITE[:, 2]}
    columns = {name: values.astype(np.float16) for name, values in columns.items()}
    table = pa.table({**columns, "intensity": np.uint8([7, 9]), "laser_number": np.uint8([1, 2])})
    feather.write_feather(table, lidar / "315966265259836000.feather")
    sensor = np.zeros(3)
    if calibrated:
        sensor = np.array([1.25, 0.5, 2])
        (tmp_path / "log" / "calibration").mkdir()
        place = {name: [0.0, value] for name, value in zip(("tx_m", "ty_m", "tz_m"), sensor, strict=True)}
        table = pa.table({"sensor_name": ["down_lidar", "up_lidar"], **place})
        feather.write_feather(table, tmp_path / "log" / "calibration" / "egovehicle_SE3_sensor.feather")
    for root in (tmp_path, tmp_path / "log", lidar):
        (sweep,) = io.open_sweeps(root)
        assert (sweep.name, sweep.timestamp_ns) == ("315966265259836000", 315966265259836000)
    xyz, intensity = sweep.read_points()
    np.testing.assert_allclose(xyz, FINITE - sensor, atol=1e-6)
    np.testing.assert_allclose(sweep.read_timed_points().xyz, xyz)
    np.testing.assert_array_equal(intensity, [7, 9])


@pytest.mark.parametrize("folder", ["", "a/b", "sensors/other"])
def test_a_table_that_is_no_sweep_of_a_log_is_taken_as_it_is_whatever_lies_near_it(tmp_path, folder):
    (tmp_path / "calibration").mkdir()
    place = {name: [1.25] for name in ("tx_m", "ty_m", "tz_m")}
    table = pa.table({"sensor_name": ["up_lidar"], **place})
    feather.write_feather(table, tmp_path / "calibration" / "egovehicle_SE3_sensor.feather")
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    columns = dict(zip("xyz", FINITE.T, strict=True))
    feather.write_feather(pa.table(columns), tmp_path / folder / "a.feather")
    np.testing.assert_array_equal(io.read_points(tmp_path / folder / "a.feather")[0], FINITE)
    assert not io.read_timed_points(tmp_path / folder / "a.feather").is_compensated


def test_tables_of_boxes_and_of_other_things_are_no_points(tmp_path):
    folder = tmp_path / "drive"
    folder.mkdir()
    with open_parquet(folder / "detections.parquet"):
        pass
    with pytest.raises(io.InputError, match=r"detections.parquet: holds boxes, as jaxbox writes its results"):
        io.open_sweeps(folder)[0].read_points()
    with open_parquet(folder / "tracks.parquet", columns=TRACK_COLUMNS):
        pass
    with pytest.raises(io.InputError, match=r"tracks.parquet: holds boxes"):
        io.read_points(folder / "tracks.parquet")
    # Results beside the points that they are of are passed over.
    np.save(folder / "a.npy", FINITE)
    assert [sweep.name for sweep in io.open_sweeps(folder)] == ["a"]
    parquet.write_table(pa.table({"x": [1.0], "name": ["a"], "z": [None]}), tmp_path / "b.parquet")
    with pytest.raises(io.InputError, match=r"b.parquet: no field y among x, z"):
        io.read_points(tmp_path / "b.parquet")


def test_the_real_pcd_is_the_binary_frame_and_a_spurious_point(data_root):
    pcd, intensity = io.read_points(data_root / "pcd" / "2011_09_26_drive_0005_0000000010.pcd")
    frame, frame_intensity = io.read_points(data_root / "kitti_tracking/training/velodyne/0000/000010.bin")
    assert len(pcd) == 123224
    assert not pcd[-1].any()
    np.testing.assert_array_equal(pcd[: len(frame)], frame)
    np.testing.assert_allclose(intensity[: len(frame)], frame_intensity, atol=0.01)


PCD_HEADER = (
    "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {n}\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {data}\n"
)
PLY_HEADER = "ply\nformat {data} 1.0\nelement vertex {n}\n{fields}end_header\n"
PLY_XYZ = "".join(f"property float {name}\n" for name in "xyz")
BAD = {
    "huge.pcd": (PCD_HEADER.format(n=10**12, data="binary"), "claims 1000000000000 points"),
    "short.pcd": (
        PCD_HEADER.format(n=9, data="binary") + "12345",
        "5 bytes of points, and the header promises",
    ),
    "lzf.pcd": (
        PCD_HEADER.format(n=9, data="binary_compressed").encode() + struct.pack("<II", 2, 999) + b"ab",
        "compressed bytes are to make 999",
    ),
    "few.pcd": (
        PCD_HEADER.format(n=2, data="ascii") + "1 2 3\n",
        "1 lines of 3 numbers; the header promises 2",
    ),
    "word.pcd": (PCD_HEADER.format(n=1, data="ascii") + "1 2 three\n", "needs 3 numbers"),
    "no_x.pcd": (
        PCD_HEADER.format(n=1, data="ascii").replace("x y z", "u y z") + "1 2 3\n",
        "no field x among u",
    ),
    "text.pcd": ("this is not a cloud", "no line DATA"),
    "odd.pcd": (
        PCD_HEADER.format(n=1, data="ascii").replace("TYPE F F F", "TYPE Q F F"),
        "header cannot be read",
    ),
    "huge.ply": (PLY_HEADER.format(data="ascii", n=10**12, fields=PLY_XYZ), "claims 1000000000000 points"),
    "short.ply": (
        PLY_HEADER.format(data="binary_big_endian", n=2, fields=PLY_XYZ) + "12345",
        "5 bytes of points, and the header promises 24",
    ),
    "few.ply": (
        PLY_HEADER.format(data="ascii", n=2, fields=PLY_XYZ) + "1 2 3\n",
        "the header promises 2 of 3",
    ),
    "no_z.ply": (PLY_HEADER.format(data="ascii", n=0, fields=PLY_XYZ[:34]), "no field z among x, y"),
    "list.ply": (
        PLY_HEADER.format(data="ascii", n=0, fields=f"{PLY_XYZ}property list uchar int i\n"),
        "property i is not a number",
    ),
    "faces.ply": ("ply\nformat ascii 1.0\nelement face 1\nend_header\n", "write the vertices before"),
    "text.ply": ("no mesh", "no PLY file"),
    "text.las": ("no survey", "no readable LAS or LAZ file"),
    "text.npy": ("no array", r"no readable \.npy array"),
    "text.npz": ("no archive", r"no readable \.npz file"),
    "text.feather": ("no table", "no readable Feather table"),
    "text.parquet": ("no table", "no readable Parquet table"),
    "text.pcd.bin": ("x" * 16, "not a multiple of 20"),
    "text.bag": ("no bag", "the bag cannot be read"),
    "text.db3": ("no bag", "the bag cannot be read"),
    "text.mcap": ("no recording", "the MCAP file cannot be read"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_named_with_what_is_wrong(tmp_path, name):
    content, message = BAD[name]
    (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(io.InputError, match=message) as error:
        io.open_sweeps(tmp_path / name)[0].read_points()
    assert name in str(error.value)


def test_a_missing_file_is_named_by_every_reader(tmp_path):
    for suffix in (*io.POINT_SUFFIXES, *io.RECORDING_SUFFIXES):
        with pytest.raises(io.InputError, match="there is no such file"):
            io.open_sweeps(tmp_path / f"a{suffix}")
    for suffix in io.POINT_SUFFIXES:
        with pytest.raises(io.InputError, match="there is no such file"):
            io.read_points(tmp_path / f"a{suffix}")


def test_numpy_files_that_claim_too_much_or_hold_other_things_are_refused(tmp_path):
    header = {"descr": "<f4", "fortran_order": False, "shape": (10**12, 4)}
    with (tmp_path / "huge.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
    np.save(tmp_path / "flat.npy", np.zeros(9))
    np.save(tmp_path / "transposed.npy", np.zeros((3, 17)))
    np.save(tmp_path / "objects.npy", np.array([{}], object), allow_pickle=True)
    np.save(tmp_path / "empty.npy", np.zeros((0, 4)))
    np.savez(tmp_path / "many.npz", a=XYZ, b=XYZ)
    with pytest.raises(io.InputError, match=r"huge\.npy: no readable"):
        io.read_points(tmp_path / "huge.npy")
    with pytest.raises(io.InputError, match=r"flat\.npy: the array is float64 of shape \(9,\)"):
        io.read_points(tmp_path / "flat.npy")
    with pytest.raises(io.InputError, match=r"transposed\.npy: the array has shape \(3, 17\).*points\.T"):
        io.read_points(tmp_path / "transposed.npy")
    with pytest.raises(io.InputError, match=r"objects\.npy: no readable"):
        io.read_points(tmp_path / "objects.npy")
    with pytest.raises(io.InputError, match=r"many\.npz: holds a, b; name the points one of points, xyz"):
        io.read_points(tmp_path / "many.npz")
    assert_points(io.read_points(tmp_path / "empty.npy"), XYZ[:0], INTENSITY[:0])


def test_an_empty_cloud_is_a_sweep_without_points(tmp_path):
    (tmp_path / "a.pcd").write_text(PCD_HEADER.format(n=0, data="binary_compressed"))
    (tmp_path / "b.ply").write_text(PLY_HEADER.format(data="ascii", n=0, fields=PLY_XYZ))
    for name in ("a.pcd", "b.ply"):
        assert_points(io.read_points(tmp_path / name), XYZ[:0], INTENSITY[:0])


EXTRAS = {
    "a.pcd": ("pypcd4", "pcd"),
    "a.las": ("laspy", "las"),
    "a.feather": ("pyarrow", "arrow"),
    "a.parquet": ("pyarrow", "arrow"),
    "a.bag": ("rosbags.rosbag1", "ros"),
    "a.mcap": ("mcap.reader", "mcap"),
}


@pytest.mark.parametrize("name", EXTRAS)
def test_a_missing_library_names_its_extra(tmp_path, monkeypatch, name):
    library, extra = EXTRAS[name]
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, "pyarrow.feather", raising=False)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(ImportError, match=rf"pip install 'jaxbox\[{extra}\]'"):
        io.open_sweeps(tmp_path / name)[0].read_points()


# --- messages -------------------------------------------------------------------------------------

STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
CLOUD = "sensor_msgs/msg/PointCloud2"


def make_message(ros=2, *, big=False, height=1, xyz=XYZ, intensity=INTENSITY):
    """Fields in an odd order, with gaps within a point and after a row."""
    types = STORES[ros].types
    field, order = types["sensor_msgs/msg/PointField"], ">" if big else "<"
    dtype = np.dtype(
        {
            "names": ["z", "ring", "intensity", "x", "y"],
            "formats": [f"{order}f8", f"{order}u2", f"{order}f4", f"{order}f4", f"{order}f4"],
            "offsets": [2, 11, 16, 24, 28],
            "itemsize": 35,
        }
    )
    points = np.zeros(len(xyz), dtype)
    points["x"], points["y"], points["z"] = xyz.T
    points["intensity"], points["ring"] = intensity, 5
    width = len(xyz) // height
    rows = [points[row * width : (row + 1) * width].tobytes() + b"\xff" * 6 for row in range(height)]
    datatypes = {"f8": 8, "u2": 4, "f4": 7}
    time = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = {"stamp": time, "frame_id": "lidar"} | ({"seq": 0} if ros == 1 else {})
    return types[CLOUD](
        header=types["std_msgs/msg/Header"](**header),
        height=height,
        width=width,
        fields=[
            field(name=name, offset=offset, datatype=datatypes[kind.str[1:]], count=1)
            for name, (kind, offset) in ((name, dtype.fields[name][:2]) for name in dtype.names)
        ],
        is_bigendian=big,
        point_step=dtype.itemsize,
        row_step=len(rows[0]) if rows else 0,
        data=np.frombuffer(b"".join(rows), np.uint8),
        is_dense=False,
    )


@pytest.mark.parametrize("height", [1, 3])
@pytest.mark.parametrize("big", [False, True])
def test_a_message_of_any_layout_is_decoded(big, height):
    assert_points(pointcloud2.decode_pointcloud2(make_message(big=big, height=height), "here"))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"width": 10**6, "height": 10**6}, "claims 1000000000000 points"),
        ({"width": 30}, "the header promises"),
        ({"point_step": 20}, "field x ends at byte 28 of a point of 20"),
        ({"fields": []}, "no field x or y or z among none"),
    ],
)
def test_a_message_that_contradicts_itself_is_refused(change, expected):
    message = make_message()
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(io.InputError, match=f"here: .*{expected}"):
        pointcloud2.decode_pointcloud2(message, "here")


# --- recordings -----------------------------------------------------------------------------------

TIMES = [10**18 + 10**8 * i for i in range(3)]


def clouds(ros):
    for index, time in enumerate(TIMES):
        yield time, make_message(ros, xyz=XYZ + np.float32(index), height=3 if index == 1 else 1)


def write_bag1(path, topics):
    with rosbag1.Writer(path) as writer:
        for topic in topics:
            connection = writer.add_connection(topic, CLOUD, typestore=STORES[1])
            for time, message in clouds(1):
                writer.write(connection, time, STORES[1].serialize_ros1(message, CLOUD))
        add_other(writer, STORES[1], STORES[1].serialize_ros1)


def write_bag2(path, topics, storage):
    plugin = getattr(rosbag2.StoragePlugin, storage)
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
        for topic in topics:
            connection = writer.add_connection(topic, CLOUD, typestore=STORES[2])
            for time, message in clouds(2):
                writer.write(connection, time, STORES[2].serialize_cdr(message, CLOUD))
        add_other(writer, STORES[2], STORES[2].serialize_cdr)


def add_other(writer, store, serialize):
    name = "std_msgs/msg/String"
    connection = writer.add_connection("/words", name, typestore=store)
    writer.write(connection, TIMES[0], serialize(store.types[name](data="hello"), name))


def write_mcap(path, topics, *, encoding="cdr", indexed=True):
    with path.open("wb") as file:
        options = {"use_statistics": indexed, "use_summary_offsets": indexed}
        writer = McapWriter(file, **options)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/PointCloud2", "ros2msg", b"")
        words = writer.register_channel(
            "/words", "json", writer.register_schema("x.Words", "jsonschema", b"{}")
        )
        writer.add_message(words, TIMES[0], json.dumps({"a": 1}).encode(), TIMES[0])
        for topic in topics:
            channel = writer.register_channel(topic, encoding, schema)
            for time, message in clouds(1 if encoding == "ros1" else 2):
                store = STORES[1 if encoding == "ros1" else 2]
                serialize = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
                writer.add_message(channel, time, bytes(serialize(message, CLOUD)), time)
        writer.finish()


def write_foxglove(path, topics):
    with path.open("wb") as file:
        writer = importlib.import_module("mcap_protobuf.writer").Writer(file)
        for topic in topics:
            for index, time in enumerate(TIMES):
                cloud = foxglove.point_cloud(
                    XYZ + np.float32(index), INTENSITY, timestamp_ns=time, frame_id="lidar"
                )
                writer.write_message(topic, cloud, time, time)
        words = importlib.import_module("foxglove_schemas_protobuf.Log_pb2").Log(message="hello")
        writer.write_message("/words", words, TIMES[0], TIMES[0])
        writer.finish()


RECORDINGS = {
    "drive.bag": write_bag1,
    "drive_sqlite": lambda path, topics: write_bag2(path, topics, "SQLITE3"),
    "drive_mcap": lambda path, topics: write_bag2(path, topics, "MCAP"),
    "drive.mcap": write_mcap,
    "ros1.mcap": lambda path, topics: write_mcap(path, topics, encoding="ros1"),
    "unindexed.mcap": lambda path, topics: write_mcap(path, topics, indexed=False),
    "foxglove.mcap": write_foxglove,
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_recordings_are_read_one_message_after_the_other(tmp_path, name):
    path = tmp_path / name
    RECORDINGS[name](path, ["/points"])
    for given in (path, tmp_path):
        sweeps = io.open_sweeps(given)
        assert len(sweeps) == len(TIMES)
        assert [sweep.name for sweep in sweeps] == [f"{path.stem}_{index:06d}" for index in range(3)]
    assert [sweep.timestamp_ns for sweep in sweeps] == TIMES
    for index, sweep in enumerate(sweeps):
        assert_points(sweep.read_points(), XYZ + np.float32(index))
    assert [sweep.name for sweep in sweeps[::-1]] == [sweep.name for sweep in list(sweeps)[::-1]]
    assert_points(sweeps[-1].read_points(), XYZ + np.float32(2))
    assert_points(pickle.loads(pickle.dumps(sweeps[1])).read_points(), XYZ + np.float32(1))


@pytest.mark.parametrize("name", RECORDINGS)
def test_of_several_topics_one_has_to_be_named(tmp_path, name):
    RECORDINGS[name](tmp_path / name, ["/front", "/rear"])
    with pytest.raises(io.InputError, match=r"/front \(3\), /rear \(3\); choose one with --topic"):
        io.open_sweeps(tmp_path / name)
    with pytest.raises(io.InputError, match=r"no topic /raer of points.* Nearest: /rear"):
        io.open_sweeps(tmp_path / name, topic="/raer")
    assert len(io.open_sweeps(tmp_path / name, topic="/rear")) == 3
    RECORDINGS[name](tmp_path / f"none_{name}", [])
    with pytest.raises(io.InputError, match=r"no topic of sensor_msgs/PointCloud2.*; its topics are /words"):
        io.open_sweeps(tmp_path / f"none_{name}")


@pytest.mark.parametrize("name", ["drive.bag", "drive.mcap"])
def test_a_recording_cut_short_is_named_with_the_mend(tmp_path, name):
    RECORDINGS[name](tmp_path / name, ["/points"])
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(io.InputError, match="fixes a recording that was cut short"):
        list(io.open_sweeps(tmp_path / name))


def test_a_damaged_message_is_named_and_the_others_are_read(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema(CLOUD, "ros2msg", b"")
        channel = writer.register_channel("/points", "cdr", schema)
        good = bytes(STORES[2].serialize_cdr(make_message(), CLOUD))
        for time, data in zip(TIMES, (good, good[:50], good), strict=True):
            writer.add_message(channel, time, data, time)
        writer.finish()
    first, second, third = io.open_sweeps(path)
    assert_points(first.read_points())
    assert_points(third.read_points())
    with pytest.raises(io.InputError, match=rf"a\.mcap, /points at {TIMES[1]}: the message cannot be read"):
        second.read_points()


# --- several paths --------------------------------------------------------------------------------


def test_patterns_and_several_paths_are_taken_and_names_stay_apart(tmp_path):
    for folder in ("a", "b"):
        for name in ("1.npy", "2.npy"):
            (tmp_path / folder).mkdir(exist_ok=True)
            np.save(tmp_path / folder / name, XYZ)
    assert [s.name for s in io.open_sweeps(tmp_path / "a" / "*.npy")] == ["1", "2"]
    assert [s.name for s in io.open_sweeps(tmp_path / "*" / "1.npy")] == ["a_1", "b_1"]
    assert [s.name for s in io.open_sweeps([tmp_path / "a", tmp_path / "b" / "2.npy"])] == ["1", "a_2", "b_2"]
    for drive in ("a", "b"):
        (tmp_path / drive / "velodyne").mkdir()
        np.save(tmp_path / drive / "velodyne" / "1.npy", XYZ)
    folders = [tmp_path / drive / "velodyne" for drive in ("a", "b")]
    assert [s.name for s in io.open_sweeps(folders)] == ["a_velodyne_1", "b_velodyne_1"]
    with pytest.raises(io.InputError, match=r"\*\.las: no file or folder is of this pattern"):
        io.open_sweeps(tmp_path / "*.las")
    with pytest.raises(io.InputError, match=r"1\.npy: given twice, by itself or by a folder that holds it"):
        io.open_sweeps([tmp_path / "a", tmp_path / "a" / "1.npy"])
    with pytest.raises(io.InputError, match="no path was given"):
        io.open_sweeps([])


def test_recordings_and_files_are_taken_one_after_the_other(tmp_path):
    write_mcap(tmp_path / "a.mcap", ["/points"])
    write_bag1(tmp_path / "b.bag", ["/points"])
    np.save(tmp_path / "c.npy", XYZ)
    sweeps = io.open_sweeps([tmp_path / "a.mcap", tmp_path / "c.npy", tmp_path / "b.bag"])
    names = ["a_000000", "a_000001", "a_000002", "c", "b_000000", "b_000001", "b_000002"]
    assert [sweep.name for sweep in sweeps] == names
    assert [sweeps[i].name for i in range(len(sweeps))] == names
    assert [sweep.name for sweep in sweeps[2:5]] == names[2:5]
    assert sweeps[-1].name == names[-1]


def test_no_two_sweeps_share_their_results_where_recordings_are_among_them(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_mcap(tmp_path / folder / "x.mcap", ["/points"])
        np.save(tmp_path / folder / "1.npy", XYZ)
    recording = tmp_path / "a" / "x.mcap"
    files = [tmp_path / folder / "1.npy" for folder in ("a", "b")]
    names = ["a_1", "x_000000", "x_000001", "x_000002", "b_1"]
    assert [sweep.name for sweep in io.open_sweeps([files[0], recording, files[1]])] == names
    np.save(tmp_path / "x_000002.npy", XYZ)
    for other, name in ((tmp_path / "b" / "x.mcap", "x_000000"), (tmp_path / "x_000002.npy", "x_000002")):
        with pytest.raises(
            io.InputError, match=f"would be named {name}, as that of .*Rename one, or go over"
        ):
            io.open_sweeps([recording, other])
    with pytest.raises(io.InputError, match=r"x\.mcap: given twice"):
        io.open_sweeps([recording, recording])


def test_a_raw_drive_has_the_times_of_its_file(tmp_path):
    data = tmp_path / "2011_09_26" / "drive" / "velodyne_points" / "data"
    data.mkdir(parents=True)
    for index in (0, 1, 2):
        (data / f"{index:010d}.bin").write_bytes(b"")
    lines = ["2011-09-26 13:02:25.594360375", "2011-09-26 13:02:25.697892189"]
    (data.parent / "timestamps.txt").write_text("\n".join(lines) + "\n")
    times = [sweep.timestamp_ns for sweep in io.open_sweeps(tmp_path)]
    assert times == [1317042145594360375, 1317042145697892189, None]


def test_no_sweep_is_larger_than_the_limit():
    points.check_num_points(points.MAX_POINTS, "here")
    with pytest.raises(io.InputError, match="here: the header claims -1 points"):
        points.check_num_points(-1, "here")
