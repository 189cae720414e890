"""Data packets as Velodyne sensors send them, made from the points of a sweep, and captures of them.

A packet has twelve blocks of 32 returns. A firing of the HDL-64E is two blocks, upper and lower lasers; one
of the HDL-32E is a block; two of the VLP-16 are a block. Azimuths turn clockwise from +x.

References: Velodyne's manuals 63-9113 (HDL-32E), 63-9243 (VLP-16) and 63-HDL64ES3 (HDL-64E).
"""

import dataclasses
import pathlib
import struct
from collections.abc import Iterable, Iterator

import numpy as np

PORT = 2368
PACKET_BYTES = 1206
TURN_S = 0.1
DISTANCE_STEP_M = 0.002
START_S = 1_700_000_000.25
"""A time since 1970 that is not the start of an hour: packets count from it."""

_BLOCKS = 12
_RETURNS = 32
_BANKS = (0xEEFF, 0xDDFF)
_BLOCK = np.dtype(
    [("bank", "<u2"), ("azimuth", "<u2"), ("returns", [("range", "<u2"), ("i", "u1")], _RETURNS)]
)
_CORRECTIONS = ("rot_correction", "dist_correction", "vert_offset_correction", "horiz_offset_correction")
_STRONGEST = 0x37
_HOUR_US = 3_600_000_000


@dataclasses.dataclass(frozen=True)
class Sensor:
    """What tells one model's packets from another's."""

    elevation_deg: tuple[float, ...]
    """Of each laser, in the order in which a firing lists them."""
    num_firings: int
    """A turn; packets come out whole."""
    model: int
    """Last byte of a packet; the HDL-64E has a part of its status there."""

    @property
    def firings_per_packet(self) -> int:
        return _BLOCKS * _RETURNS // len(self.elevation_deg)


VLP16 = Sensor(tuple(float(i if i % 2 else i - 15) for i in range(16)), 1800, 0x22)
HDL32E = Sensor(
    tuple(-9.33 + 4 / 3 * (i // 2) if i % 2 else -30.67 + 4 / 3 * (i // 2) for i in range(32)), 2160, 0x21
)
HDL64E = Sensor((*np.linspace(2, -8.33, 32).tolist(), *np.linspace(-8.83, -24.33, 32).tolist()), 2088, 0x00)
"""KITTI's, with lasers where its manual has them; real ones differ from unit to unit, so decoders need
`hdl64e_calibration`."""


def hdl64e_calibration() -> str:
    """The lasers of `HDL64E` as decoders read them: YAML, as ROS's ``gen_calibration.py`` writes it."""
    head = f"num_lasers: {len(HDL64E.elevation_deg)}\ndistance_resolution: {DISTANCE_STEP_M}\nlasers:\n"
    zeros = ", ".join(f"{name}: 0.0" for name in _CORRECTIONS)
    lines = [
        f"- {{laser_id: {laser}, vert_correction: {elevation:.7f}, {zeros}}}\n"
        for laser, elevation in enumerate(np.radians(HDL64E.elevation_deg))
    ]
    return head + "".join(lines)


def sweep_packets(
    sensor: Sensor, xyz: np.ndarray, intensity: np.ndarray, *, start_s: float = START_S
) -> list[tuple[float, bytes]]:
    """The packets of one turn.

    Args:
      sensor: the model.
      xyz: (n, 3) m. A point goes to the nearest laser and firing; of several there the nearest is seen.
      intensity: (n,) in [0, 1].
      start_s: when the turn starts, s since 1970.

    Returns:
      Time, s since 1970, and bytes of each.
    """
    ranges, strengths = _image(sensor, xyz, intensity)
    num_packets = sensor.num_firings // sensor.firings_per_packet
    blocks = np.zeros((num_packets, _BLOCKS), _BLOCK)
    blocks["returns"]["range"] = ranges.reshape((*blocks.shape, _RETURNS))
    blocks["returns"]["i"] = strengths.reshape((*blocks.shape, _RETURNS))
    banks = max(len(sensor.elevation_deg) // _RETURNS, 1)
    blocks["bank"] = np.tile(_BANKS[:banks], _BLOCKS // banks)
    # In 0.01 degrees, of a block's first firing.
    first = np.arange(num_packets * _BLOCKS) * _RETURNS // len(sensor.elevation_deg)
    blocks["azimuth"] = np.round(first * 36000 / sensor.num_firings).reshape(blocks.shape)
    packets = []
    for number, packet in enumerate(blocks):
        time_s = start_s + TURN_S * number / num_packets
        tail = struct.pack("<IBB", round(time_s * 1e6) % _HOUR_US, _STRONGEST, sensor.model)
        packets.append((time_s, packet.tobytes() + tail))
    return packets


def _image(sensor: Sensor, xyz: np.ndarray, intensity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance in steps and intensity of 255, each (firings, lasers); 0 where nothing was seen."""
    xyz = np.asarray(xyz, np.float64)
    distance_m = np.linalg.norm(xyz, axis=1)
    order = np.argsort(-distance_m)
    elevation_deg = np.degrees(np.arcsin(xyz[:, 2] / np.maximum(distance_m, 1e-9)))
    laser = np.abs(elevation_deg[:, None] - sensor.elevation_deg).argmin(axis=1)
    turn = -np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi) % 1
    firing = np.round(turn * sensor.num_firings).astype(int) % sensor.num_firings
    steps = np.round(distance_m / DISTANCE_STEP_M)
    seen = order[(steps[order] > 0) & (steps[order] < 2**16)]
    shape = (sensor.num_firings, len(sensor.elevation_deg))
    ranges, strengths = np.zeros(shape, np.uint16), np.zeros(shape, np.uint8)
    # The last of several is kept: the nearest.
    ranges[firing[seen], laser[seen]] = steps[seen]
    strengths[firing[seen], laser[seen]] = np.clip(np.round(255 * intensity[seen]), 0, 255)
    return ranges, strengths


def drive_packets(
    sensor: Sensor, sweeps: Iterable[tuple[np.ndarray, np.ndarray]], *, start_s: float = START_S
) -> Iterator[tuple[float, bytes]]:
    """The packets of turns one after the other; as `sweep_packets`."""
    for number, (xyz, intensity) in enumerate(sweeps):
        yield from sweep_packets(sensor, xyz, intensity, start_s=start_s + number * TURN_S)


def write_pcap(path: pathlib.Path, packets: Iterable[tuple[float, bytes]], *, port: int = PORT) -> None:
    """Writes packets as a capture of UDP over IPv4 and Ethernet, in the classic format (microseconds)."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 2**16, 1))
        for time_s, payload in packets:
            frame = udp_frame(payload, port)
            micros = round(time_s * 1e6)
            file.write(struct.pack("<IIII", micros // 10**6, micros % 10**6, len(frame), len(frame)))
            file.write(frame)


def udp_frame(payload: bytes, port: int) -> bytes:
    """A datagram of a sensor at 192.168.1.201, as a frame of Ethernet."""
    ethernet = b"\xff" * 6 + bytes.fromhex("60 76 88 00 00 01 08 00")
    addresses = bytes([192, 168, 1, 201]) + b"\xff" * 4
    ip = struct.pack(">BBHHHBBH", 0x45, 0, 28 + len(payload), 0, 0, 64, 17, 0) + addresses
    total = sum(struct.unpack(">10H", ip))
    checksum = ~(total + (total >> 16)) & 0xFFFF
    ip = ip[:10] + struct.pack(">H", checksum) + ip[12:]
    return ethernet + ip + struct.pack(">HHHH", port, port, 8 + len(payload), 0) + payload
