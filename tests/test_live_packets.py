"""Packets of a Velodyne sensor over the loopback interface: whole turns, and nothing that is sent ends it."""

import functools
import itertools
import socket
import sys
import threading
import time

import lidar_packets
import numpy as np
import pytest
import velodyne_decoder
from test_live import NS, came

from jaxbox import synthetic
from jaxbox.io import InputError
from jaxbox.io import velodyne as recorded
from jaxbox.io.velodyne import MAX_TURN_PACKETS
from jaxbox.live import Fault, LiveSweep, open_source, velodyne
from jaxbox.live.sources import parse_udp
from jaxbox.live.velodyne import UdpAddress, VelodyneSource

MODEL = lidar_packets.VLP16


@functools.cache
def turns(count=4):
    """Packets of turns in one street."""
    street = synthetic.make_sweep(0, num_azimuths=250)
    return [
        [
            packet
            for _, packet in lidar_packets.sweep_packets(
                MODEL, street.xyz, street.intensity, start_s=lidar_packets.START_S + 0.1 * number
            )
        ]
        for number in range(count)
    ]


class Listening:
    """A source at a free port, gone through in a thread; and what sends to it."""

    def __init__(self, **address):
        self.source = VelodyneSource(UdpAddress(port=0, **address))
        self.found, self._ready, self._stopped = [], threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._receive)

    def _receive(self):
        for item in self.source:
            self._ready.set()
            if item is not None:
                self.found.append(item)
            if self._stopped.is_set():
                return

    def __enter__(self):
        self._thread.start()
        # What comes before it goes through the source is forgotten.
        assert self._ready.wait(5)
        return self

    def __exit__(self, *_):
        self._stopped.set()
        self._thread.join()

    def send(self, packets, *, sender="127.0.0.1"):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outgoing:
            outgoing.bind((sender, 0))
            for count, packet in enumerate(packets):
                outgoing.sendto(packet, ("127.0.0.1", self.source.port))
                if count % 8 == 7:
                    # As a sensor: a burst may be more than a system's buffers hold.
                    time.sleep(0.001)

    def wait(self, condition):
        end_s = time.monotonic() + 5
        while not condition():
            assert time.monotonic() < end_s, self.found
            time.sleep(0.01)

    @property
    def sweeps(self):
        return [item for item in self.found if isinstance(item, LiveSweep)]

    @property
    def faults(self):
        return [item.reason for item in self.found if isinstance(item, Fault)]


def test_packets_are_the_points_of_their_turns():
    with Listening() as listening:
        before_ns = time.time_ns()
        listening.send(itertools.chain.from_iterable(turns()))
        listening.wait(lambda: len(listening.sweeps) == 3)
    decode = velodyne_decoder.ScanDecoder(velodyne_decoder.Config()).decode
    packed = [
        [velodyne_decoder.VelodynePacket(turn, packet) for packet in packets]
        for turn, packets in enumerate(turns())
    ]
    expected = [decode(velodyne_decoder.PacketVector(packets), True)[1] for packets in packed[:3]]
    for index, (item, known) in enumerate(zip(listening.sweeps, expected, strict=True)):
        assert item.frame == index
        assert before_ns <= item.arrived_ns <= time.time_ns()
        np.testing.assert_array_equal(item.points.xyz, np.column_stack([known[axis] for axis in "xyz"]))
        assert 0.09 < np.ptp(item.points.time_s) < 0.11
    assert listening.faults == []


def test_a_capture_is_the_same_sweeps_at_their_own_pace(tmp_path):
    start_s = lidar_packets.START_S
    times_s = [start_s + 0.1 * turn + 0.1 * place / 75 for turn in range(4) for place in range(75)]
    packets = zip(times_s, itertools.chain.from_iterable(turns()), strict=True)
    lidar_packets.write_pcap(tmp_path / "drive.pcap", packets)
    begin_ns = time.time_ns()
    found = came(open_source(str(tmp_path / "drive.pcap")))
    assert len(found) >= 3
    came_s = (found[2].arrived_ns - begin_ns) / NS
    assert came_s >= (found[2].timestamp_ns - found[0].timestamp_ns) / NS >= 0.19
    np.testing.assert_allclose(np.diff([item.timestamp_ns for item in found])[:2], NS / 10, rtol=0.02)


def test_a_sensor_that_stops_in_the_middle_of_a_turn_goes_on_with_whole_ones():
    with Listening() as listening:
        listening.send([*turns()[0], *turns()[1][:40]])
        time.sleep(3 * velodyne.IDLE_S)
        listening.send(itertools.chain.from_iterable(turns()[2:]))
        listening.wait(lambda: len(listening.sweeps) == 2)
    whole = {len(item.points.xyz) for item in listening.sweeps}
    assert len(whole) == 1
    assert listening.faults == []


def test_packets_of_another_sender_are_refused_while_the_first_one_sends():
    with Listening() as listening:
        listening.send(turns()[0])
        listening.send(turns()[1][:3], sender="127.0.0.2")
        listening.send(turns()[1])
        listening.wait(lambda: listening.sweeps and len(listening.faults) == 3)
    assert all("127.0.0.2, while 127.0.0.1 is listened to" in reason for reason in listening.faults)


def test_a_sender_that_falls_silent_leaves_its_place_to_another_that_sends_all_the_time():
    with Listening() as listening:
        listening.send(turns()[0][:20])
        for packet in [*turns()[1], *turns()[2], *turns()[3]]:
            listening.send([packet], sender="127.0.0.2")
            time.sleep(2 * velodyne.IDLE_S / 75)
        listening.wait(lambda: len(listening.sweeps) >= 1)
    assert len(listening.faults) < 75


def test_a_named_sender_is_the_only_one():
    with Listening(sender="127.0.0.2") as listening:
        listening.send(turns()[0][:2])
        listening.send(itertools.chain(*turns()[:2]), sender="127.0.0.2")
        listening.wait(lambda: len(listening.sweeps) == 1)
    assert len(listening.faults) == 2


def damaged_packets(count):
    """Anything that a port may be sent: other sizes, noise, and packets with some bytes changed."""
    rng = np.random.default_rng(0)
    for index in range(count):
        packet = bytearray(turns()[0][index % 75])
        kind = index % 4
        if kind == 0:
            yield rng.bytes(int(rng.integers(0, 3000)))
        elif kind == 1:
            yield rng.bytes(velodyne.PACKET_BYTES)
        elif kind == 2:
            for place in rng.integers(0, len(packet), 200):
                packet[place] = rng.integers(0, 256)
            yield bytes(packet)
        else:
            packet[-1] = rng.integers(0, 256)
            yield bytes(packet)


def test_nothing_that_is_sent_ends_the_source():
    with Listening() as listening:
        listening.send(damaged_packets(1000))
        listening.wait(lambda: len(listening.faults) > 100)
        time.sleep(3 * velodyne.IDLE_S)
        num_before = len(listening.sweeps)
        listening.send(itertools.chain.from_iterable(turns()))
        listening.wait(lambda: len(listening.sweeps) >= num_before + 3)
    np.testing.assert_array_equal(listening.sweeps[-1].points.xyz, listening.sweeps[-2].points.xyz)
    # No turn of nonsense is larger than a sensor's can be.
    assert max(item.num_points for item in listening.sweeps) <= 32 * 12 * MAX_TURN_PACKETS


def test_packets_of_a_model_with_more_lasers_than_the_calibration_end_nothing(tmp_path):
    # The library reads memory that is not its own for these, and the process may end.
    lasers = velodyne_decoder.Calibration.default_calibs[velodyne_decoder.Model.VLP16]
    (tmp_path / "vlp16.yaml").write_text(lasers.to_string())
    with Listening(calibration=tmp_path / "vlp16.yaml") as listening:
        listening.send([packet[:-1] + bytes([0xA1]) for turn in turns()[:3] for packet in turn])
        listening.wait(lambda: len(listening.faults) == 2)
        listening.send(itertools.chain.from_iterable(turns()))
        listening.wait(lambda: len(listening.sweeps) >= 2)
    assert all("a sensor of 128 lasers" in reason for reason in listening.faults[:2])


def test_a_turn_that_does_not_end_is_dropped(monkeypatch):
    monkeypatch.setattr(recorded, "MAX_TURN_PACKETS", 50)
    with Listening() as listening:
        listening.send([turns()[0][0]] * 60)
        listening.wait(lambda: listening.faults)
    assert "50 packets before this one, and the sensor has not turned half round" in listening.faults[0]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts what is lost")
def test_packets_that_nobody_fetched_in_time_are_counted(monkeypatch):
    monkeypatch.setattr(velodyne, "_BUFFER_BYTES", 20_000)
    monkeypatch.setattr(velodyne, "IDLE_S", 0.01)
    source = VelodyneSource(UdpAddress(port=0))
    items = iter(source)
    assert next(items) is None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outgoing:
        for packet in [*turns()[0], *turns()[1]]:
            outgoing.sendto(packet, ("127.0.0.1", source.port))
        # What the buffer held, and then a silence.
        assert not any(itertools.islice(items, 100))
        outgoing.sendto(turns()[2][0], ("127.0.0.1", source.port))
    fault = next(items)
    assert "packets were lost" in fault.reason
    items.close()


def test_a_port_that_is_taken_and_unknown_models_are_said_at_once(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"cannot listen at 127.0.0.1, UDP port {port}"):
            open_source(f"udp://:{port}")
    with pytest.raises(InputError, match=r"model VLP17 is not known; name one of .*VLP16"):
        open_source("udp://:0?model=VLP17")
    (tmp_path / "lasers.yml").write_text("lasers: 3")
    with pytest.raises(InputError, match=r"lasers\.yml: no calibration"):
        open_source(f"udp://:0?model=HDL64E_S2&calibration={tmp_path / 'lasers.yml'}")
    with pytest.raises(InputError, match=r"model HDL64E_S2: .* name a calibration"):
        open_source("udp://:0?model=HDL64E_S2")


@pytest.mark.parametrize(
    ("source", "is_open"),
    [("udp://", False), ("udp://0.0.0.0", True), ("udp://0.0.0.0?from=192.168.1.201", False)],
)
def test_only_a_port_that_strangers_reach_is_open(source, is_open):
    assert parse_udp(source).is_open == is_open


@pytest.mark.parametrize(
    "source", ["udp://:99999", "udp://:port", "udp://a/b", "udp://?colour=red", "udp://?x"]
)
def test_other_addresses_are_refused(source):
    with pytest.raises(InputError, match=r"udp://"):
        parse_udp(source)


def test_an_unknown_kind_of_address_names_those_that_are_known():
    with pytest.raises(InputError, match="ouster://, ros2://, udp://, or a path"):
        open_source("s3://bucket")
