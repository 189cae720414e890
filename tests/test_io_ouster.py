"""Recordings of an Ouster sensor, written by its own library, in an environment of their own: -m ouster."""

import importlib
import pickle
import shutil
from typing import Any

import numpy as np
import pytest

from jaxbox import io

pytestmark = pytest.mark.ouster

SWEEPS = 3
START_NS = 1_700_000_000 * 10**9
SWEEP_NS = 10**8
SERIAL = 122_246_000_293


@pytest.fixture(scope="module")
def sensor() -> Any:
    """An OS-1-64, as the library knows it."""
    core = importlib.import_module("ouster.sdk.core")
    info = core.SensorInfo.from_default(core.LidarMode._512x10)
    info.sn, info.init_id = SERIAL, 7
    info.config.udp_port_lidar, info.config.udp_port_imu = 7502, 7503
    return info


@pytest.fixture(scope="module")
def frames(sensor):
    core = importlib.import_module("ouster.sdk.core")
    made = []
    for index in range(SWEEPS):
        frame = core.LidarFrame(sensor)
        columns = np.arange(sensor.w)
        frame.field("RANGE")[:] = 5000 + columns + 1000 * index
        frame.field("RANGE")[::2, ::3] = 0
        frame.field("REFLECTIVITY")[:] = np.arange(sensor.h)[:, None]
        frame.status[:] = 1
        frame.measurement_id[:] = columns
        # The sensor's clock counts from when it was switched on.
        frame.timestamp[:] = 10**12 + index * SWEEP_NS + columns * SWEEP_NS // sensor.w
        sent = np.arange(len(frame.packet_timestamp)) * SWEEP_NS // len(frame.packet_timestamp)
        frame.packet_timestamp[:] = START_NS + index * SWEEP_NS + sent
        frame.frame_id = 10 + index
        made.append(frame)
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory, sensor, frames):
    """The same sweeps as OSF, and as a capture with its metadata."""
    core, osf, pcap = (importlib.import_module(f"ouster.sdk.{name}") for name in ("core", "osf", "pcap"))
    root = tmp_path_factory.mktemp("ouster")
    with osf.Writer(str(root / "drive.osf"), [sensor]) as writer:
        for frame in frames:
            writer.save(0, frame)
    layout = core.PacketFormat.from_info(sensor)
    sent = [p for f in frames for p in core.frame_to_packets(f, layout, sensor.init_id, sensor.sn)]
    pcap.record(sent, str(root / "drive.pcap"))
    (root / "drive.json").write_text(sensor.to_json_string())
    return root


@pytest.mark.parametrize("name", ["drive.osf", "drive.pcap"])
def test_what_the_library_writes_is_read_back(folder, sensor, frames, name):
    rays = importlib.import_module("ouster.sdk.core").XYZLut(sensor)
    sweeps = io.open_sweeps(folder / name)
    assert len(sweeps) == len(list(sweeps)) == SWEEPS
    assert sweeps.topic == str(SERIAL)
    assert [sweep.name for sweep in sweeps] == [f"drive_{index:06d}" for index in range(SWEEPS)]
    for index, (sweep, frame) in enumerate(zip(sweeps, frames, strict=True)):
        last = START_NS + index * SWEEP_NS + 31 * SWEEP_NS // 32
        assert abs(sweep.timestamp_ns - last) <= 1000
        points = pickle.loads(pickle.dumps(sweep)).read_timed_points()
        seen = frame.field("RANGE") > 0
        assert points.xyz.dtype == points.intensity.dtype == np.float32
        np.testing.assert_allclose(points.xyz, rays(frame)[seen], atol=1e-5)
        np.testing.assert_array_equal(points.intensity, frame.field("REFLECTIVITY")[seen])
        column = np.broadcast_to(np.arange(sensor.w), seen.shape)[seen]
        np.testing.assert_allclose(points.time_s, (column - sensor.w + 1) * 0.1 / sensor.w, atol=1e-8)
        xyz, intensity = sweep.read_points()
        np.testing.assert_array_equal(xyz, points.xyz)
        np.testing.assert_array_equal(intensity, points.intensity)


def test_the_metadata_may_have_the_beginning_of_the_name(folder, tmp_path):
    shutil.copy(folder / "drive.pcap", tmp_path / "drive-000.pcap")
    with pytest.raises(io.InputError, match=r"An Ouster's need its metadata beside the capture, FILE.json"):
        io.open_sweeps(tmp_path / "drive-000.pcap")
    (tmp_path / "drive-000.json").write_text("{}")
    shutil.copy(folder / "drive.json", tmp_path / "drive.json")
    assert len(io.open_sweeps(tmp_path / "drive-000.pcap")) == SWEEPS


def test_another_sensor_is_named(folder):
    with pytest.raises(io.InputError, match=rf"no topic 7 of points; there are {SERIAL} \(3\)"):
        io.open_sweeps(folder / "drive.osf", topic="7")


def test_what_is_no_recording_is_named(folder, tmp_path):
    (tmp_path / "a.osf").write_bytes(b"no recording at all")
    with pytest.raises(io.InputError, match=r"a.osf: .*cannot be read"):
        io.open_sweeps(tmp_path / "a.osf")
    (tmp_path / "a.pcap").write_bytes((folder / "drive.pcap").read_bytes()[:24])
    shutil.copy(folder / "drive.json", tmp_path / "a.json")
    with pytest.raises(io.InputError, match=r"a.pcap: .*(no sweep of the sensor|cannot be read)"):
        io.open_sweeps(tmp_path / "a.pcap")
