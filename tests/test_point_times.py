"""When each point was measured: names and units that drivers use, by every format that has named columns."""

import dataclasses

import numpy as np
import pyarrow as pa
import pypcd4
import pytest
from pyarrow import feather, parquet
from test_io_formats import (
    CLOUD,
    INTENSITY,
    STORES,
    TIMES,
    XYZ,
    assert_points,
    make_message,
    write_bag1,
    write_mcap,
)

from jaxbox import io
from jaxbox.geometry.mounting import Mounting
from jaxbox.io import foxglove, pointcloud2
from jaxbox.io.point_times import point_times_s
from jaxbox.io.rosbag import MessageDecoder

OFFSETS_S = np.array([0.0, 0.04, 0.1])
STAMP_NS = 1_700_000_000_123_456_789
CLOCK_NS = STAMP_NS + np.array([0, 40_000_000, 100_000_000])


@pytest.mark.parametrize(
    ("name", "values", "sweep_ns", "expected", "tolerance"),
    [
        # Velodyne, whose stamp is that of the sweep's start or end.
        ("time", OFFSETS_S.astype(np.float32), STAMP_NS, OFFSETS_S, 1e-7),
        ("time", (OFFSETS_S - 0.1).astype(np.float32), STAMP_NS, OFFSETS_S - 0.1, 1e-7),
        # Ouster and Livox.
        ("t", np.uint32(OFFSETS_S * 1e9), STAMP_NS, OFFSETS_S, 1e-9),
        ("offset_time", np.uint32(OFFSETS_S * 1e9), None, OFFSETS_S, 1e-9),
        ("Timestamp", CLOCK_NS.astype(np.float64), STAMP_NS, OFFSETS_S, 1e-6),
        # Hesai and RoboSense.
        ("timestamp", CLOCK_NS / 1e9, STAMP_NS, OFFSETS_S, 1e-6),
        ("timestamp", CLOCK_NS / 1e9, None, OFFSETS_S, 1e-6),
        ("timestamp", CLOCK_NS / 1e9 - 0.1, STAMP_NS, OFFSETS_S - 0.1, 1e-6),
        # Whole nanoseconds lose nothing.
        ("timestamp", CLOCK_NS, STAMP_NS, OFFSETS_S, 1e-12),
        ("timestamp", CLOCK_NS.astype(np.uint64), STAMP_NS, OFFSETS_S, 1e-12),
        # A clock that is not the sweep's: since the sensor was switched on.
        ("timestamp", 5000 + OFFSETS_S, STAMP_NS, OFFSETS_S, 1e-9),
        ("offset_ns", np.int32(OFFSETS_S * 1e9), STAMP_NS, OFFSETS_S, 1e-9),
        ("t", np.array([0, np.nan, 0.1]), None, [0, np.nan, 0.1], 1e-12),
        ("t", np.full(3, np.nan), None, [np.nan] * 3, 0),
        ("t", np.zeros(3, np.uint32), None, np.zeros(3), 0),
    ],
)
def test_the_units_of_drivers_are_known(name, values, sweep_ns, expected, tolerance):
    found = point_times_s({"x": XYZ[:, 0], name: values}, 3, "here", sweep_ns=sweep_ns)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.uint32(OFFSETS_S * 1e6), "field t spans 0.0001 s as nanoseconds, which no sweep does; its unit"),
        (np.uint16(OFFSETS_S * 1e3), "spans 1e-07 s as nanoseconds"),
        (OFFSETS_S * 1e3, "spans 100 s as seconds"),
        (OFFSETS_S * 1e6, "spans 100000 s as seconds"),
        (np.float32(CLOCK_NS / 1e9), "field t is a clock in float32"),
        (np.array([0, 2**64 - 1, 5], np.uint64), "as nanoseconds"),
        (np.array([-(2**63), 2**63 - 1, 0]), "as nanoseconds"),
        (np.array([1e300, -1e300, 0]), "as seconds"),
        (np.zeros(2), "not one real number a point"),
        (np.zeros((3, 2)), "not one real number a point"),
        (np.zeros(3, bool), "not one real number a point"),
    ],
)
def test_a_unit_that_is_not_clear_is_an_error(values, message):
    with pytest.raises(io.InputError, match=f"here: .*{message}"):
        point_times_s({"t": values}, 3, "here")


def test_without_such_a_column_there_are_no_times():
    assert point_times_s({"x": XYZ[:, 0]}, 3, "here") is None
    assert point_times_s({"t": np.zeros(0)}, 0, "here").shape == (0,)


def write_pcd(path):
    columns = [*XYZ.T, INTENSITY, OFFSETS_S]
    types = (np.float32,) * 4 + (np.float64,)
    pypcd4.PointCloud.from_points(columns, ("x", "y", "z", "intensity", "time"), types).save(path)


def write_csv(path):
    rows = [f"{x},{y},{z},{i},7,{t}" for (x, y, z), i, t in zip(XYZ, INTENSITY, OFFSETS_S, strict=True)]
    path.write_text("\n".join(["x,y,z,intensity,ring,time", *rows]))


def write_parquet(path):
    columns = dict(zip("xyz", XYZ.T, strict=True))
    times = np.uint32(OFFSETS_S * 1e9)
    parquet.write_table(pa.table({**columns, "intensity": INTENSITY, "t": times}), path)


def write_feather(path):
    columns = {name: XYZ[:, i] for i, name in enumerate("xyz")}
    table = pa.table({**columns, "intensity": INTENSITY, "offset_ns": np.int32(OFFSETS_S * 1e9)})
    feather.write_feather(table, path)


WRITERS = {
    "a.pcd": write_pcd,
    "a.csv": write_csv,
    "a.npy": lambda path: np.save(
        path, np.rec.fromarrays([*XYZ.T, INTENSITY, OFFSETS_S], names="x,y,z,intensity,time")
    ),
    "a.npz": lambda path: np.savez(
        path, x=XYZ[:, 0], y=XYZ[:, 1], z=XYZ[:, 2], intensity=INTENSITY, t=np.uint32(OFFSETS_S * 1e9)
    ),
    "315966265259836000.feather": write_feather,
    "a.parquet": write_parquet,
    "a.ply": lambda path: path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\n"
        + "".join(f"property double {name}\n" for name in ("x", "y", "z", "intensity", "time"))
        + "end_header\n"
        + "\n".join(
            " ".join(map(str, (*xyz, i, t))) for xyz, i, t in zip(XYZ, INTENSITY, OFFSETS_S, strict=True)
        )
    ),
}


@pytest.mark.parametrize("name", WRITERS)
def test_formats_with_named_columns_have_times(tmp_path, name):
    WRITERS[name](tmp_path / name)
    (sweep,) = io.open_sweeps(tmp_path / name)
    timed = sweep.read_timed_points()
    np.testing.assert_allclose(timed.time_s, OFFSETS_S, atol=1e-9)
    assert timed.is_compensated == name.endswith(".feather")
    assert_points((timed.xyz, timed.intensity), *sweep.read_points())
    level = io.LevelSweeps([sweep], Mounting((0.0, 0.0, 1.0)))[0].read_timed_points()
    np.testing.assert_array_equal(level.xyz[:2], timed.xyz[:2] - np.float32([0, 0, 1]))
    np.testing.assert_array_equal(level.time_s, timed.time_s)


def test_formats_without_times_say_so(tmp_path):
    io.write_bin(tmp_path / "a.bin", XYZ, INTENSITY)
    np.save(tmp_path / "b.npy", XYZ)
    (tmp_path / "c.xyz").write_text("1 2 3 4 5\n")
    for name in ("a.bin", "b.npy", "c.xyz"):
        timed = io.read_timed_points(tmp_path / name)
        assert timed.time_s is None
        assert_points((timed.xyz, timed.intensity), *io.read_points(tmp_path / name))
    with pytest.raises(io.InputError, match="not a known kind of points"):
        io.read_timed_points(tmp_path / "a.docx")


def test_a_bad_time_in_text_is_named_by_its_line(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,time\n1,2,3,0.1\n1,2,3,soon\n")
    with pytest.raises(io.InputError, match=r"a\.csv, line 3: "):
        io.read_timed_points(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("x,y,z,i,ring,time\n1,2,3,0.1\n")
    with pytest.raises(io.InputError, match=r"b\.csv, line 2: no number in column 6"):
        io.read_timed_points(tmp_path / "b.csv")


def timed_message(ros, values, datatype, *, stamp_ns=STAMP_NS):
    """A message whose points end with their time."""
    message = make_message(ros)
    types = STORES[ros].types
    # Behind the gap after the last field of a row of one point each.
    rows = [bytes(message.data[i * 35 : (i + 1) * 35]) + values[i : i + 1].tobytes() for i in range(3)]
    step = 35 + values.itemsize
    field = types["sensor_msgs/msg/PointField"](name="t", offset=35, datatype=datatype, count=1)
    time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return dataclasses.replace(
        message,
        header=dataclasses.replace(message.header, stamp=time),
        fields=[*message.fields, field],
        point_step=step,
        row_step=3 * step,
        data=np.frombuffer(b"".join(rows), np.uint8),
    )


@pytest.mark.parametrize("ros", [1, 2])
def test_messages_have_times_from_their_stamp(ros):
    store = STORES[ros]
    for values, datatype in (
        (np.uint32(OFFSETS_S * 1e9), 6),
        (np.float32(OFFSETS_S), 7),
        (CLOCK_NS / 1e9, 8),
    ):
        message = timed_message(ros, values, datatype)
        timed = pointcloud2.decode_timed_pointcloud2(message, "here")
        np.testing.assert_allclose(timed.time_s, OFFSETS_S, atol=1e-6)
        data = bytes((store.serialize_ros1 if ros == 1 else store.serialize_cdr)(message, CLOUD))
        decoder = MessageDecoder(data, "here", ros == 1)
        np.testing.assert_array_equal(decoder.timed().time_s, timed.time_s)
        assert decoder.header() == (STAMP_NS, "lidar")
        assert_points(decoder())


def test_sweeps_of_recordings_have_their_headers(tmp_path):
    write_bag1(tmp_path / "a.bag", ["/points"])
    write_mcap(tmp_path / "a.mcap", ["/points"])
    for name in ("a.bag", "a.mcap"):
        for sweep in io.open_sweeps(tmp_path / name):
            assert sweep.decode.header() == (1_000_000_002, "lidar")
            assert sweep.sequence == "a"
            assert sweep.read_timed_points().time_s is None


def test_foxgloves_clouds_have_a_header():
    cloud = foxglove.point_cloud(XYZ, INTENSITY, timestamp_ns=TIMES[1], frame_id="lidar")
    decoder = foxglove.PointCloudDecoder(cloud.SerializeToString(), "here")
    assert decoder.header() == (TIMES[1], "lidar")
    assert decoder.timed().time_s is None
    assert_points(decoder())
