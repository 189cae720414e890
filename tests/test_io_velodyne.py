"""Packets of Velodyne sensors, captured or recorded by ROS, become the turns that they were made of."""

import pickle
import struct
import sys
import xml.etree.ElementTree as ElementTree

import lidar_packets as packets
import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags import rosbag1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from jaxbox import io
from jaxbox.io.captures import read_datagrams
from jaxbox.io.velodyne import ANY_MODEL, TurnBatcher, decode_packets

SENSOR = packets.HDL32E
TURNS = 3
SCAN = "velodyne_msgs/msg/VelodyneScan"
DEFINITIONS = {
    "velodyne_msgs/msg/VelodynePacket": "time stamp\nuint8[1206] data",
    SCAN: "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets",
}
"""As in https://github.com/ros-drivers/velodyne/tree/master/velodyne_msgs."""


def cloud(sensor, seed, num_points=3000):
    """A turn of points, one a firing and laser at most."""
    rng = np.random.default_rng(seed)
    firing = rng.permutation(sensor.num_firings - 10)[: num_points // 2] + 5
    azimuth = np.repeat(-2 * np.pi * firing / sensor.num_firings, 2)
    elevation = np.radians(np.tile([sensor.elevation_deg[3], sensor.elevation_deg[10]], len(firing)))
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    return rng.uniform(3, 60, len(rays))[:, None] * rays, rng.uniform(0.1, 1, len(rays))


CLOUDS = [cloud(SENSOR, seed) for seed in range(TURNS)]
SENT = list(packets.drive_packets(SENSOR, CLOUDS))
NUM_PACKETS = len(SENT) // TURNS
LAST_NS = [round(SENT[(turn + 1) * NUM_PACKETS - 1][0] * 1e9) for turn in range(TURNS)]


def assert_turns(sweeps, sensor=SENSOR, clouds=CLOUDS):
    """Each sweep has the points of its turn: as many, as far away, as bright, in the same directions."""
    assert len(sweeps) == len(clouds) == len(list(sweeps))
    for sweep, (xyz, intensity) in zip(sweeps, clouds, strict=True):
        found, strength = sweep.read_points()
        assert found.dtype == strength.dtype == np.float32
        assert len(found) == len(xyz)
        order, expected = (np.lexsort((elevation_of(p), turn(p))) for p in (found, xyz))
        # An HDL-32E turns on by 0.13 degrees until its last laser has fired.
        np.testing.assert_allclose(found[order], xyz[expected], atol=0.2)
        np.testing.assert_allclose(strength[order], 255 * intensity[expected], atol=0.51)


def turn(xyz):
    """The number of the firing."""
    turned = -np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi) % 1
    return np.floor(turned * SENSOR.num_firings + 0.1).astype(int)


def elevation_of(xyz):
    return np.degrees(np.arctan2(xyz[:, 2], np.hypot(*xyz[:, :2].T)))


def test_a_capture_is_a_recording_of_turns(tmp_path):
    path = tmp_path / "drive.pcap"
    packets.write_pcap(path, SENT)
    for given in (path, tmp_path):
        sweeps = io.open_sweeps(given)
        assert [sweep.name for sweep in sweeps] == [f"drive_{index:06d}" for index in range(TURNS)]
        assert_turns(sweeps)
    np.testing.assert_allclose([sweep.timestamp_ns for sweep in sweeps], LAST_NS, rtol=0, atol=1000)
    assert_turns([pickle.loads(pickle.dumps(sweep)) for sweep in sweeps])
    assert io.find_poses(sweeps) is None


def test_points_have_the_times_at_which_they_were_measured(tmp_path):
    packets.write_pcap(tmp_path / "a.pcap", SENT)
    for sweep, (xyz, _) in zip(io.open_sweeps(tmp_path / "a.pcap"), CLOUDS, strict=True):
        points = sweep.read_timed_points()
        # From the last packet's time; a firing takes 0.1 s / 2160, and the packets' times are whole us.
        expected = (turn(points.xyz) - SENSOR.num_firings) / SENSOR.num_firings * packets.TURN_S
        firing_s = packets.TURN_S / (NUM_PACKETS - 1)
        np.testing.assert_allclose(points.time_s, expected + firing_s, atol=2e-4)
        assert len(points.time_s) == len(xyz)
        assert not points.is_compensated


def test_a_capture_that_starts_and_ends_within_a_turn_has_the_turns_that_are_more_than_half(tmp_path):
    # From 90 degrees on: turns are from there to there, and the last one has 270 degrees.
    packets.write_pcap(tmp_path / "a.pcap", SENT[NUM_PACKETS // 4 :])
    sweeps = io.open_sweeps(tmp_path / "a.pcap")
    whole = sum(len(xyz) for xyz, _ in CLOUDS)
    counts = [len(sweep.read_points()[0]) for sweep in sweeps]
    first = np.sum(turn(CLOUDS[0][0]) < SENSOR.num_firings // 4)
    assert len(counts) == TURNS
    assert sum(counts) == whole - first
    # A sensor that stopped for a second: two thirds of a turn before it are one, and a third after is none.
    late = [(time_s + 1, data) for time_s, data in SENT[NUM_PACKETS * 5 // 3 :]]
    packets.write_pcap(tmp_path / "b.pcap", SENT[: NUM_PACKETS * 5 // 3] + late)
    assert len(io.open_sweeps(tmp_path / "b.pcap")) == 3


def pcapng(sent, *, order="<", tick_exponent=9):
    """A capture in the newer format, with an interface of its own tick and a block of another kind."""

    def block(kind, body):
        body += bytes(-len(body) % 4)
        size = struct.pack(order + "I", len(body) + 12)
        return struct.pack(order + "I", kind) + size + body + size

    def option(code, value):
        return struct.pack(order + "HH", code, len(value)) + value + bytes(-len(value) % 4)

    options = option(2, b"eth0") + option(9, bytes([tick_exponent])) + option(0, b"")
    yield block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1))
    yield block(1, struct.pack(order + "HHI", 1, 0, 2**16) + options)
    yield block(5, bytes(12))
    for time_s, payload in sent:
        frame = packets.udp_frame(payload, packets.PORT)
        ticks = round(time_s * 10**tick_exponent)
        head = struct.pack(order + "IIIII", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame))
        yield block(6, head + frame)


def pcap(sent, *, order="<", magic=0xA1B2C3D4, ticks_per_s=10**6, link=1, tag=b""):
    yield struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 2**16, link)
    for time_s, payload in sent:
        frame = packets.udp_frame(payload, packets.PORT)
        frame = frame[:12] + tag + frame[12:] if link == 1 else bytes(packets_before(link)) + frame[14:]
        ticks = round(time_s * ticks_per_s)
        size = len(frame)
        yield struct.pack(order + "IIII", ticks // ticks_per_s, ticks % ticks_per_s, size, size) + frame


def packets_before(link):
    return {101: 0, 113: 16, 276: 20}[link]


CAPTURES = {
    "little.pcap": lambda: pcap(SENT),
    "big.pcap": lambda: pcap(SENT, order=">"),
    "nanoseconds.pcap": lambda: pcap(SENT, magic=0xA1B23C4D, ticks_per_s=10**9),
    "vlan.pcap": lambda: pcap(SENT, tag=b"\x81\x00\x00\x07"),
    "raw.pcap": lambda: pcap(SENT, link=101),
    "any_device.pcap": lambda: pcap(SENT, link=113),
    "any_device_2.pcap": lambda: pcap(SENT, link=276),
    "little.pcapng": lambda: pcapng(SENT),
    "big.pcapng": lambda: pcapng(SENT, order=">", tick_exponent=6),
}


@pytest.mark.parametrize("name", CAPTURES)
def test_captures_of_every_kind_hold_the_same_datagrams(tmp_path, name):
    (tmp_path / name).write_bytes(b"".join(CAPTURES[name]()))
    found = list(read_datagrams(tmp_path / name))
    assert [datagram.payload for datagram in found] == [data for _, data in SENT]
    assert {datagram.address for datagram in found} == {"192.168.1.201:2368"}
    times = [datagram.time_ns * 1e-9 for datagram in found]
    np.testing.assert_allclose(times, [time_s for time_s, _ in SENT], rtol=0, atol=1e-6)
    assert len(io.open_sweeps(tmp_path / name)) == TURNS


def test_frames_that_are_no_whole_datagram_are_passed_over(tmp_path):
    frame = packets.udp_frame(SENT[0][1], packets.PORT)
    others = [
        b"",
        frame[:30],
        frame[:12] + b"\x86\xdd\x60" + frame[15:],
        frame[:20] + b"\x20" + frame[21:],
        frame[:23] + b"\x06" + frame[24:],
    ]
    data = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 2**16, 1)
    for item in [*others, frame]:
        data += struct.pack("<IIII", 1, 0, len(item), len(item)) + item
    (tmp_path / "a.pcap").write_bytes(data)
    assert [datagram.payload for datagram in read_datagrams(tmp_path / "a.pcap")] == [SENT[0][1]]
    # The record in which the capture was stopped.
    (tmp_path / "a.pcap").write_bytes(data[:-1])
    assert list(read_datagrams(tmp_path / "a.pcap")) == []


def test_of_several_sensors_one_has_to_be_named(tmp_path):
    one = b"".join(pcap(SENT))
    other = one.replace(bytes([192, 168, 1, 201]), bytes([10, 0, 0, 2]))
    (tmp_path / "a.pcap").write_bytes(one + other[24:])
    with pytest.raises(io.InputError, match=r"10.0.0.2:2368 \(3\), 192.168.1.201:2368 \(3\); choose one"):
        io.open_sweeps(tmp_path / "a.pcap")
    assert_turns(io.open_sweeps(tmp_path / "a.pcap", topic="10.0.0.2:2368"))


def test_a_missing_library_names_its_extra(tmp_path, monkeypatch):
    packets.write_pcap(tmp_path / "a.pcap", SENT)
    monkeypatch.setitem(sys.modules, "velodyne_decoder", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxbox\[velodyne\]'"):
        io.open_sweeps(tmp_path / "a.pcap")


BAD = {
    "text.pcap": (b"no capture at all", "no capture of packets"),
    "empty.pcap": (b"", "no capture of packets"),
    "claims.pcap": (
        b"".join(pcap([])) + struct.pack("<IIII", 0, 0, 2**31, 2**31),
        "a record claims 2147483648 bytes",
    ),
    "nothing.pcap": (b"".join(pcap([])), "there are none over UDP"),
    "ouster.pcap": (
        b"".join(pcap([(1.0, bytes(24896))] * 2)),
        r"there are 2 of 24896 bytes from 192.168.1.201:2368. An Ouster's need its metadata beside",
    ),
    "short.pcap": (b"".join(pcap(SENT[:5])), "not half a turn"),
    "order.pcapng": (struct.pack("<IIIIII", 0x0A0D0D0A, 28, 7, 0, 0, 28), "byte order is not known"),
    "claims.pcapng": (next(pcapng([])) + struct.pack("<II", 6, 2**31) + bytes(8), "a record claims"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_capture_is_named_with_what_is_wrong(tmp_path, name):
    data, expected = BAD[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(io.InputError, match=rf"{name}: .*{expected}"):
        io.open_sweeps(tmp_path / name)


def test_a_model_that_no_decoder_knows_is_named(tmp_path):
    packets.write_pcap(tmp_path / "a.pcap", [(time_s, data[:-1] + b"\x77") for time_s, data in SENT])
    (sweep, *_) = io.open_sweeps(tmp_path / "a.pcap")
    with pytest.raises(io.InputError, match=r"a.pcap at \d+: .*unsupported Velodyne model.*HDL-64E"):
        sweep.read_points()


# --- the HDL-64E's calibration --------------------------------------------------------------------

HDL64E = packets.HDL64E
"""Its lasers' angles are this one sensor's, and no decoder's."""


@pytest.fixture(scope="module")
def hdl64e():
    """Packets of 12 turns: as many as it takes the sensor to tell its calibration once."""
    return list(packets.drive_packets(HDL64E, [cloud(HDL64E, seed) for seed in range(12)]))


def lasers():
    """Velodyne's names and units: degrees and cm."""
    for number, elevation in enumerate(HDL64E.elevation_deg):
        yield {"id_": number, "rotCorrection_": 0, "vertCorrection_": elevation, "distCorrection_": 0}


def calibration_xml():
    root = ElementTree.Element("boost_serialization")
    database = ElementTree.SubElement(root, "DB")
    ElementTree.SubElement(database, "distLSB_").text = "0.2"
    points = ElementTree.SubElement(database, "points_")
    for laser in lasers():
        item = ElementTree.SubElement(ElementTree.SubElement(points, "item"), "px")
        for name, value in laser.items():
            ElementTree.SubElement(item, name).text = str(value)
    return ElementTree.tostring(root, encoding="unicode")


def with_status(sent):
    """The packets, in whose last bytes an HDL-64E S2 tells state and calibration: 9 bytes of one, 7 of the
    other, and so on (manual 63-HDL64E S2, appendix E)."""
    table = bytearray(b"UNIT#\x18\x18")
    for laser in lasers():
        angle = round(100 * laser["vertCorrection_"])
        table += struct.pack("<BhhhhhhhhhBB", laser["id_"], angle, *[0] * 8, 0, 255) + bytes(7)
    table += bytes(19) + struct.pack("<H", 1820)
    table[-28:-22] = bytes([10, 5, 20, 12, 0, 0])
    state = list(zip(b"HMSDNYGTV", (12, 0, 0, 20, 5, 10, 0, 30, 1), strict=True))
    told = []
    while len(told) < len(sent):
        for start in range(0, len(table), 7):
            told += state + [(0x31 + i, value) for i, value in enumerate(table[start : start + 7])]
    return [(time_s, data[:-2] + bytes(pair)) for (time_s, data), pair in zip(sent, told, strict=False)]


CALIBRATIONS = {
    "drive.yaml": packets.hdl64e_calibration,
    "drive.yml": packets.hdl64e_calibration,
    "drive.xml": calibration_xml,
    "db.xml": calibration_xml,
}


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_an_hdl64e_is_calibrated_by_the_file_beside_it(tmp_path, hdl64e, name):
    packets.write_pcap(tmp_path / "drive.pcap", hdl64e[: len(hdl64e) // 12])
    (tmp_path / name).write_text(CALIBRATIONS[name]())
    (sweep,) = io.open_sweeps(tmp_path / "drive.pcap")
    assert_elevations(sweep)


def test_an_hdl64e_is_calibrated_by_what_it_tells(tmp_path, hdl64e):
    packets.write_pcap(tmp_path / "drive.pcap", with_status(hdl64e))
    sweeps = io.open_sweeps(tmp_path / "drive.pcap")
    assert len(sweeps) == 12
    assert_elevations(sweeps[3])


def assert_elevations(sweep):
    xyz, _ = sweep.read_points()
    elevation = elevation_of(xyz)
    assert len(xyz) == len(CLOUDS[0][0])
    expected = [HDL64E.elevation_deg[3], HDL64E.elevation_deg[10]]
    found = np.abs(elevation[:, None] - expected).min(axis=1)
    assert found.max() < 0.01


@pytest.mark.parametrize("told", [False, True])
def test_an_hdl64e_without_calibration_says_how_to_give_it(tmp_path, hdl64e, told):
    sent = with_status(hdl64e[:700]) if told else hdl64e[:700]
    packets.write_pcap(tmp_path / "drive.pcap", sent)
    with pytest.raises(io.InputError, match=r"put its calibration beside .* DRIVE.yaml .* DRIVE.xml"):
        io.open_sweeps(tmp_path / "drive.pcap")[0].read_points()


@pytest.mark.parametrize("name", ["drive.yaml", "drive.xml"])
def test_a_file_beside_it_that_is_no_calibration_is_named(tmp_path, name):
    packets.write_pcap(tmp_path / "drive.pcap", SENT)
    no_number = "<DB><points_><item><px><id_>x</id_></px></item></points_></DB>"
    # The decoder would read beyond the lasers that there are.
    few = packets.hdl64e_calibration().partition("- {laser_id: 2,")[0].replace("64", "2", 1)
    for text in ("cars: 3", "<DB>", no_number, "[", "", few, "num_lasers: 0\nlasers: []"):
        (tmp_path / name).write_text(text)
        with pytest.raises(io.InputError, match=rf"{name}: no .*calibration"):
            io.open_sweeps(tmp_path / "drive.pcap")


# --- recordings of ROS's driver -------------------------------------------------------------------


def typestore(ros):
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def scans(store, ros):
    time, header = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
    packet, scan = store.types["velodyne_msgs/msg/VelodynePacket"], store.types[SCAN]
    for number in range(TURNS):
        sent = SENT[number * NUM_PACKETS : (number + 1) * NUM_PACKETS]
        stamps = [time(sec=int(time_s), nanosec=round(time_s % 1 * 1e9)) for time_s, _ in sent]
        data = [np.frombuffer(data, np.uint8) for _, data in sent]
        listed = [packet(stamp=stamp, data=item) for stamp, item in zip(stamps, data, strict=True)]
        fields = {"stamp": stamps[-1], "frame_id": "velodyne"} | ({"seq": 0} if ros == 1 else {})
        yield LAST_NS[number], scan(header=header(**fields), packets=listed)


def write_bag(path):
    store = typestore(1)
    with rosbag1.Writer(path) as writer:
        connection = writer.add_connection("/velodyne_packets", SCAN, typestore=store)
        for time_ns, message in scans(store, 1):
            writer.write(connection, time_ns, store.serialize_ros1(message, SCAN))


def write_mcap(path):
    store = typestore(2)
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema(SCAN, "ros2msg", b"")
        channel = writer.register_channel("/velodyne_packets", "cdr", schema)
        for time_ns, message in scans(store, 2):
            writer.add_message(channel, time_ns, bytes(store.serialize_cdr(message, SCAN)), time_ns)
        writer.finish()


@pytest.mark.parametrize(("name", "write"), [("drive.bag", write_bag), ("drive.mcap", write_mcap)])
def test_recordings_of_packets_are_the_turns_of_the_driver(tmp_path, name, write):
    write(tmp_path / name)
    sweeps = io.open_sweeps(tmp_path / name)
    assert sweeps.topic == "/velodyne_packets"
    assert [sweep.timestamp_ns for sweep in sweeps] == LAST_NS
    assert_turns(sweeps)
    sweep = pickle.loads(pickle.dumps(sweeps[1]))
    assert_turns([sweep], clouds=CLOUDS[1:2])
    stamp_ns, frame = sweep.decode.header()
    assert frame == "velodyne"
    assert abs(stamp_ns - LAST_NS[1]) < 1000
    points = sweep.read_timed_points()
    assert -packets.TURN_S < points.time_s.min() < points.time_s.max() < 0.001


def test_where_the_driver_recorded_points_too_they_are_taken(tmp_path):
    name = "sensor_msgs/msg/PointCloud2"
    store = typestore(1)
    with rosbag1.Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/velodyne_packets", SCAN, typestore=store)
        for time_ns, message in scans(store, 1):
            writer.write(connection, time_ns, store.serialize_ros1(message, SCAN))
        header = message.header
        field = store.types["sensor_msgs/msg/PointField"]
        fields = [field(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")]
        empty = store.types[name](header, 1, 1, fields, False, 12, 12, np.zeros(12, np.uint8), True)
        connection = writer.add_connection("/velodyne_points", name, typestore=store)
        writer.write(connection, LAST_NS[0], store.serialize_ros1(empty, name))
    assert io.open_sweeps(tmp_path / "a.bag").topic == "/velodyne_points"
    assert_turns(io.open_sweeps(tmp_path / "a.bag", topic="/velodyne_packets"))


def test_a_calibration_of_another_sensor_is_refused(tmp_path):
    packets.write_pcap(tmp_path / "drive.pcap", SENT)
    (tmp_path / "drive.yaml").write_text(packets.hdl64e_calibration())
    with pytest.raises(io.InputError, match=r"a sensor of 32 lasers, and the calibration beside .* is of 64"):
        io.open_sweeps(tmp_path / "drive.pcap")[0].read_points()


def test_a_sensor_that_does_not_turn_fills_no_memory():
    batcher = TurnBatcher()
    for _ in range(25_000):
        assert batcher.push(0, SENT[0][1]) is None
    assert sum(len(value) for value in vars(batcher).values() if isinstance(value, list)) <= 10_000


def test_damaged_packets_are_an_input_error():
    rng = np.random.default_rng(0)
    noise = [(0, rng.integers(0, 256, packets.PACKET_BYTES, np.uint8).tobytes()) for _ in range(3)]
    with pytest.raises(io.InputError, match="here: the packets cannot be decoded"):
        decode_packets(noise, ANY_MODEL, "here")
    with pytest.raises(io.InputError, match="here: a turn without packets"):
        decode_packets([], ANY_MODEL, "here")
