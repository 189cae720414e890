"""Captures of network packets, ``.pcap`` and ``.pcapng``: the UDP datagrams in them.

References: draft-ietf-opsawg-pcap and draft-ietf-opsawg-pcapng.
"""

import functools
import pathlib
import socket
import struct
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

from jaxbox._files import InputError, check_file

_MAX_FRAME_BYTES = 2**18
"""No frame is captured beyond it (libpcap's MAXIMUM_SNAPLEN); a record that claims more is damaged."""
_MAX_BLOCK_BYTES = 2**24
_PCAP = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
"""Byte order and ns of a tick by the first bytes."""
_PCAPNG = b"\x0a\x0d\x0d\x0a"
_PCAPNG_ORDERS = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}
_INTERFACE, _ENHANCED_PACKET = 1, 6
_TICK_OPTION = 9
_NS_PER_S = 10**9

_LINK_HEADERS = {0: 4, 1: 14, 12: 0, 14: 0, 101: 0, 108: 4, 113: 16, 228: 0, 276: 20}
"""Bytes before the IP header by the link's type: loopback, Ethernet, raw IP, Linux's "any" device."""
_ETHERNET = 1
_VLAN_TAGS = (b"\x81\x00", b"\x88\xa8")
_UDP = 17
_MIN_IP_BYTES, _UDP_BYTES = 20, 8


class Datagram(NamedTuple):
    """One UDP datagram of a capture."""

    time_ns: int
    """When it was captured, ns since 1970."""
    address: str
    """Of the sender and the port that it sends to, such as "192.168.1.201:2368"."""
    payload: bytes
    """What was sent."""


def read_datagrams(path: pathlib.Path) -> Iterator[Datagram]:
    """Reads the UDP datagrams of a capture one by one; whatever else was captured is passed over.

    Args:
      path: a file of libpcap (any byte order, microseconds or nanoseconds) or a pcapng file.

    Yields:
      Those over IPv4 that are in one frame each. A last record that was cut off, as where the capture was
      stopped, is left out.

    Raises:
      InputError: where it is not such a file, or a record is damaged.
    """
    check_file(path, max_bytes=None)
    with path.open("rb") as file:
        magic = file.read(4)
        if magic == _PCAPNG:
            frames = _pcapng_frames(file, str(path))
        elif magic in _PCAP:
            frames = _pcap_frames(file, *_PCAP[magic], str(path))
        else:
            raise InputError(f"{path}: no capture of packets (pcap, pcapng); is it packed? Unpack it first.")
        for time_ns, link, frame in frames:
            found = _udp(frame, link)
            if found is not None:
                yield Datagram(time_ns, *found)


def _pcap_frames(file: BinaryIO, order: str, tick_ns: int, where: str) -> Iterator[tuple[int, int, bytes]]:
    """Time, link type and bytes of each frame."""
    header = file.read(20)
    if len(header) < 20:
        return
    link = struct.unpack(order + "I", header[16:])[0] & 0xFFFF
    record = struct.Struct(order + "IIII")
    while len(head := file.read(record.size)) == record.size:
        seconds, ticks, size, _ = record.unpack(head)
        _check_size(size, _MAX_FRAME_BYTES, where)
        frame = file.read(size)
        if len(frame) < size:
            return
        yield seconds * _NS_PER_S + ticks * tick_ns, link, frame


def _pcapng_frames(file: BinaryIO, where: str) -> Iterator[tuple[int, int, bytes]]:
    """As `_pcap_frames`; each section has its byte order and its interfaces, each with a tick of its own."""
    file.seek(0)
    order, interfaces = "<", list[tuple[int, int]]()
    while len(head := file.read(12)) == 12:
        if head[:4] == _PCAPNG:
            if head[8:12] not in _PCAPNG_ORDERS:
                raise InputError(f"{where}: the section's byte order is not known; the file is damaged.")
            order, interfaces = _PCAPNG_ORDERS[head[8:12]], []
        kind, size = struct.unpack(order + "II", head[:8])
        _check_size(size, _MAX_BLOCK_BYTES, where)
        rest = file.read(size - 12) if size >= 12 else b""
        if size < 12 or len(rest) < size - 12:
            return
        body = head[8:] + rest[:-4]
        if kind == _INTERFACE and len(body) >= 8:
            interfaces.append((struct.unpack(order + "H", body[:2])[0], _ticks_per_s(body[8:], order)))
        elif kind == _ENHANCED_PACKET and len(body) >= 20:
            number, high, low, length = struct.unpack(order + "IIII", body[:16])
            if number < len(interfaces):
                link, per_s = interfaces[number]
                yield ((high << 32) + low) * _NS_PER_S // per_s, link, body[20 : 20 + length]


def _ticks_per_s(options: bytes, order: str) -> int:
    """The resolution of an interface's times, 10^-6 s where it does not say."""
    while len(options) >= 5:
        code, size = struct.unpack(order + "HH", options[:4])
        if code == _TICK_OPTION and size == 1:
            exponent = options[4] & 0x7F
            return 2**exponent if options[4] & 0x80 else 10**exponent
        # Padded to 32 bits.
        options = options[4 + (size + 3) // 4 * 4 :]
    return 10**6


def _check_size(size: int, bound: int, where: str) -> None:
    if size > bound:
        raise InputError(
            f"{where}: a record claims {size} bytes; at most {bound} are one. The file is damaged: "
            "copy it again."
        )


def _udp(frame: bytes, link: int) -> tuple[str, bytes] | None:
    """Address and payload of a UDP datagram over IPv4 that is whole; None for any other frame."""
    start = _LINK_HEADERS.get(link)
    if start is None:
        return None
    while link == _ETHERNET and frame[start - 2 : start] in _VLAN_TAGS:
        start += 4
    if len(frame) < start + _MIN_IP_BYTES + _UDP_BYTES or frame[start] >> 4 != 4:
        return None
    # Of a fragment the offset, or the bit that more follow, is set.
    fragment = int.from_bytes(frame[start + 6 : start + 8], "big") & 0x3FFF
    if frame[start + 9] != _UDP or fragment:
        return None
    udp = start + (frame[start] & 0xF) * 4
    size = int.from_bytes(frame[udp + 4 : udp + 6], "big")
    address = _address(frame[start + 12 : start + 16], frame[udp + 2 : udp + 4])
    return address, frame[udp + _UDP_BYTES : udp + max(size, _UDP_BYTES)]


@functools.lru_cache(maxsize=64)
def _address(sender: bytes, port: bytes) -> str:
    return f"{socket.inet_ntoa(sender)}:{int.from_bytes(port, 'big')}"
