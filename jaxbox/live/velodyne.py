"""Packets of a Velodyne sensor over UDP, as they come; the library ``velodyne-decoder`` makes points of them.

Whoever reaches the port can send: packets have no signature. So it listens at this machine's loopback address
unless another is named, and nothing that comes can do more than be a wrong point: a datagram of another size
is refused, one that cannot be decoded is counted, a turn that does not end is dropped, and packets from
another address than the first are refused while that one sends.
"""

import contextlib
import dataclasses
import pathlib
import socket
import struct
import sys
from collections.abc import Iterator

from jaxbox._extras import require
from jaxbox._loopback import LOOPBACK, LOOPBACK_NAMES
from jaxbox.io import InputError, TimedPoints
from jaxbox.io.velodyne import (
    PACKET_BYTES,
    TurnBatcher,
    VelodynePoints,
    VelodyneSensor,
    read_calibrated_sensor,
)
from jaxbox.live.sweep import IDLE_S, Fault, LiveSweep, now_ns

PORT = 2368
"""To which Velodyne sensors send unless they are told otherwise."""
_BUFFER_BYTES = 2**22
"""Of the socket: a second of the busiest sensor."""
_STAMP = struct.Struct("@ll")
"""Seconds and nanoseconds, by which the kernel says when a packet came: not late, where this program is."""
_LOST = struct.Struct("@I")
_SO_TIMESTAMPNS, _SO_RXQ_OVFL = 35, 40
"""Linux's numbers, which Python does not name: packets come with their time, and with how many were lost."""
_NS_PER_S = 10**9


@dataclasses.dataclass(frozen=True, kw_only=True)
class UdpAddress:
    """Where packets come in, and from whom."""

    host: str = LOOPBACK
    """Address of this machine to listen at."""
    port: int = PORT
    """Port to listen at; 0 takes a free one."""
    sender: str | None = None
    """Address of the sensor; None for whoever sends first."""
    model: str | None = None
    """Name of the model, as ``velodyne_decoder.Model`` has it; None for what the packets say, which those of
    an HDL-64E do not."""
    calibration: pathlib.Path | None = None
    """Calibration of the lasers, YAML or XML; None for the model's own."""

    @property
    def is_open(self) -> bool:
        """Whether others than this machine and a named sensor may send."""
        return self.sender is None and self.host not in LOOPBACK_NAMES


class VelodyneSource:
    """A Velodyne sensor whose packets come in at a port; a `jaxbox.live.Source`."""

    can_wait = False

    def __init__(self, address: UdpAddress) -> None:
        """Begins to listen, so that a port that is taken is known at once.

        Args:
          address: where, and to whom.

        Raises:
          InputError: for an address that cannot be listened at, an unknown model, or a bad calibration.
          ImportError: without the extra ``velodyne``.
        """
        self.is_open = address.is_open
        """Whether whoever reaches the port may send."""
        self._address = address
        sensor = _sensor_of(address)
        self._socket = _listening(address)
        self.port: int = self._socket.getsockname()[1]
        """At which it listens."""
        self.name = f"udp://{address.host}:{self.port}"
        self._turns = _Turns(sensor, "a turn")
        self.hint = f"is the sensor on, and does it send to this machine at port {self.port}?"

    def __iter__(self) -> Iterator[LiveSweep | Fault | None]:
        """A sweep with the packet that ends its turn, and None with the others."""
        sender, frame, num_lost, heard_ns = self._address.sender, 0, None, 0
        with self._socket:
            _drain(self._socket)
            while True:
                received = _receive(self._socket)
                if received is None:
                    # Half a turn before a silence and half a turn after it are no sweep.
                    self._turns.reset()
                    sender = self._address.sender
                    yield None
                    continue
                packet, stamp_ns, host, lost = received
                if num_lost is not None and lost > num_lost:
                    yield Fault(
                        f"{self.name}: {lost - num_lost} packets were lost; this machine is too busy."
                    )
                num_lost = lost
                if sender not in (None, host) and stamp_ns - heard_ns > IDLE_S * _NS_PER_S:
                    # It has fallen silent, while another one sends.
                    self._turns.reset()
                    sender = self._address.sender
                if sender not in (None, host):
                    yield Fault(f"{self.name}: a packet from {host}, while {sender} is listened to.")
                    continue
                try:
                    turn = self._turns.add(packet, stamp_ns)
                except InputError as error:
                    yield Fault(f"{self.name}: {error} It came from {host}.")
                    continue
                sender, heard_ns = host, stamp_ns
                yield None if turn is None else _sweep(*turn, frame)
                frame += turn is not None


class _Turns:
    """Packets of a sensor as they come, put together to turns, which are decoded whole."""

    def __init__(self, sensor: VelodyneSensor, where: str) -> None:
        self._sensor, self._where = sensor, where
        self.reset()

    def reset(self) -> None:
        """Forgets the turn that was begun."""
        self._batcher = TurnBatcher()

    def add(self, packet: bytes, stamp_ns: int) -> tuple[TimedPoints, int] | None:
        """The points of a turn and when its last packet came, with the packet that begins the next.

        Raises:
          InputError: for what is no packet, for packets that make no turn, or that cannot be decoded.
        """
        if len(packet) != PACKET_BYTES:
            raise InputError(f"{len(packet)} bytes, and packets of a Velodyne sensor have {PACKET_BYTES}.")
        num_dropped = self._batcher.num_dropped
        turn = self._batcher.push(stamp_ns, packet)
        if self._batcher.num_dropped > num_dropped:
            raise InputError(
                f"{self._batcher.num_dropped - num_dropped} packets before this one, and the sensor has not "
                "turned half round."
            )
        if turn is None:
            return None
        ended_ns = turn[-1][0]
        return VelodynePoints(turn, self._sensor, self._where, (ended_ns, "")).timed(), ended_ns


def _sweep(points: TimedPoints, ended_ns: int, frame: int) -> LiveSweep:
    return LiveSweep(
        name=f"{frame:06d}", frame=frame, timestamp_ns=ended_ns, arrived_ns=ended_ns, points=points
    )


def _sensor_of(address: UdpAddress) -> VelodyneSensor:
    """What an address says of the sensor that sends to it."""
    models = require("velodyne_decoder", extra="velodyne", what="Velodyne packets").Model.__members__
    if address.model is not None and address.model not in models:
        raise InputError(f"model {address.model} is not known; name one of {', '.join(models)}.")
    if address.calibration is None and (address.model or "").startswith("HDL64E"):
        raise InputError(f"model {address.model}: its lasers differ from unit to unit; name a calibration.")
    if address.calibration is None:
        return VelodyneSensor(address.model)
    calibrated = read_calibrated_sensor(address.calibration)
    return calibrated._replace(model=address.model or calibrated.model)


def _listening(address: UdpAddress) -> socket.socket:
    """A socket that waits no longer than `IDLE_S`, and stamps what it receives where it can (Linux)."""
    try:
        family, kind, *_, place = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_DGRAM)[0]
        found = socket.socket(family, kind)
        try:
            found.bind(place)
        except BaseException:
            found.close()
            raise
    except (OSError, OverflowError) as error:
        raise InputError(
            f"cannot listen at {address.host}, UDP port {address.port} ({error}); does another program, "
            "or is the address not this machine's?"
        ) from error
    found.settimeout(IDLE_S)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    if sys.platform == "linux":
        found.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        found.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
    return found


def _drain(listening: socket.socket) -> None:
    """Forgets what came while nobody was ready."""
    listening.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            listening.recv(1)
    listening.settimeout(IDLE_S)


def _receive(listening: socket.socket) -> tuple[bytes, int, str, int] | None:
    """A datagram, when it was there, ns since 1970, from which address, and how many were lost so far.

    None where none came. Only Linux counts what is lost, where nobody fetches packets in time.
    """
    room = socket.CMSG_SPACE(_STAMP.size) + socket.CMSG_SPACE(_LOST.size)
    try:
        packet, extras, _, sender = listening.recvmsg(2 * PACKET_BYTES, room)
    except TimeoutError:
        return None
    stamp_ns, num_lost = now_ns(), 0
    for _, kind, data in extras:
        if kind == _SO_TIMESTAMPNS and len(data) == _STAMP.size:
            seconds, nanoseconds = _STAMP.unpack(data)
            stamp_ns = seconds * _NS_PER_S + nanoseconds
        elif kind == _SO_RXQ_OVFL:
            (num_lost,) = _LOST.unpack(data)
    return packet, stamp_ns, sender[0], num_lost
