"""Velodyne's packets, in a capture of the network (``.pcap``, ``.pcapng``) or as ROS's driver records them.

`velodyne-decoder` makes points of packets: x forward, y left, z up. What belongs to one turn of the sensor is
told here by the azimuths, so that nothing is decoded before it is asked for.
"""

import collections
import functools
import itertools
import json
import math
import pathlib
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple
from xml.etree import ElementTree

from jaxbox._extras import require
from jaxbox._files import InputError, read_text, reason
from jaxbox.io.captures import Datagram, read_datagrams
from jaxbox.io.ouster import open_ouster, ouster_metadata
from jaxbox.io.point_times import timed_points
from jaxbox.io.points import Points, TimedPoints
from jaxbox.io.recordings import Message, RecordedSweeps, RecordingFormat, choose_topic

PACKET_BYTES = 1206
"""Of a data packet of any model: twelve blocks of 100 bytes, a time and two bytes about the sensor."""
MAX_TURN_PACKETS = 10_000
"""An Alpha Prime that sends two returns needs 2600 for its slowest turn."""

_LAST_BLOCK = slice(1102, 1104)
_FIRST_BLOCK = slice(2, 4)
_FULL_TURN = 36000
_MAX_TURN_NS = 300_000_000
"""The slowest turn takes 0.2 s; what is further apart is not of one."""
_FACTORY_BYTES = slice(-2, None)
_NUM_LOOKED_AT = 5
_MAX_STATUS_PACKETS = 20_000
"""The HDL-64E tells its calibration in 4160 packets, over and over."""
_NUM_LASERS = {0x21: 32, 0x22: 16, 0x24: 16, 0x28: 32, 0xA1: 128}
"""By the last byte of a packet: HDL-32E, VLP-16, Puck Hi-Res, VLP-32C, Alpha Prime."""
_NUM_HDL64E_LASERS = 64
_CALIBRATION_SUFFIXES = (".yaml", ".yml", ".xml")
_XML_FIELDS = {
    "rotCorrection_": ("rot_correction", math.pi / 180),
    "vertCorrection_": ("vert_correction", math.pi / 180),
    "distCorrection_": ("dist_correction", 0.01),
    "distCorrectionX_": ("dist_correction_x", 0.01),
    "distCorrectionY_": ("dist_correction_y", 0.01),
    "vertOffsetCorrection_": ("vert_offset_correction", 0.01),
    "horizOffsetCorrection_": ("horiz_offset_correction", 0.01),
    "focalDistance_": ("focal_distance", 0.01),
    "focalSlope_": ("focal_slope", 1.0),
}
"""Names in YAML, and rad a degree or m a cm, of Velodyne's own names."""
_HDL64E = (
    "The lasers of an HDL-64E differ from unit to unit: put its calibration beside the recording, for "
    "DRIVE.pcap as DRIVE.yaml (ROS's driver) or DRIVE.xml (Velodyne's)."
)
_NS = 1e-9

Packet = tuple[int, bytes]
"""When it came, ns since 1970, and its `PACKET_BYTES`."""


class VelodyneSensor(NamedTuple):
    """What has to be known of a sensor, beyond its packets, to decode them."""

    model: str | None = None
    """Name of a model that its packets do not tell; None where they do."""
    calibration: str | None = None
    """Angles and offsets of its lasers as ROS's driver has them, YAML; None for the model's own."""
    num_lasers: int | None = None
    """That are calibrated."""


ANY_MODEL = VelodyneSensor()
"""One that its packets tell all of."""


class TurnBatcher:
    """Puts the packets of a sensor together to turns, each from the azimuth at which the first began."""

    def __init__(self) -> None:
        self._packets: list[Packet] = []
        # Azimuths, of which all but the first are counted from it.
        self._cut: int | None = None
        self._began = self._reached = 0
        self.num_dropped = 0
        """Packets of turns of which less than half came."""

    def push(self, time_ns: int, data: bytes) -> list[Packet] | None:
        """Takes the next packet.

        Args:
          time_ns: when it came, ns since 1970.
          data: `PACKET_BYTES` bytes.

        Returns:
          The packets of the turn before it, where it begins another one. A turn of which less than half
          came is dropped.
        """
        first, last = (int.from_bytes(data[block], "little") for block in (_FIRST_BLOCK, _LAST_BLOCK))
        if self._cut is None:
            self._cut = first
        reached = (last - self._cut) % _FULL_TURN
        late = bool(self._packets) and time_ns - self._packets[0][0] > _MAX_TURN_NS
        late |= len(self._packets) >= MAX_TURN_PACKETS
        done = self.finish() if late or reached < self._reached else None
        if not self._packets:
            self._began = reached - (last - first) % _FULL_TURN
        self._packets.append((time_ns, data))
        self._reached = reached
        return done

    def finish(self) -> list[Packet] | None:
        """The packets of the turn that was begun, or None where less than half of it came."""
        packets, covered = self._packets, self._reached - self._began
        self._packets, self._began, self._reached = [], 0, 0
        if 2 * covered > _FULL_TURN:
            return packets
        self.num_dropped += len(packets)
        return None


class VelodynePoints:
    """The packets of one turn, decoded when it is called."""

    def __init__(
        self, packets: Sequence[Packet], sensor: VelodyneSensor, where: str, header: tuple[int, str]
    ) -> None:
        """Decodes nothing yet.

        Args:
          packets: at least one.
          sensor: that sent them.
          where: recording and time, for the error.
          header: the turn's time, ns since 1970, and the name of the points' frame.
        """
        self._packets, self._sensor, self._where, self._header = packets, sensor, where, header

    def __call__(self) -> Points:
        """Decodes the points.

        Raises:
          InputError: naming recording and time, where the packets are damaged.
          ImportError: without the extra ``velodyne``.
        """
        points = self.timed()
        return points.xyz, points.intensity

    def timed(self) -> TimedPoints:
        """Decodes the points, and when each was measured, from the turn's time; raises as a call."""
        stamp_s, cloud = decode_packets(self._packets, self._sensor, self._where)
        columns = {name: cloud[name] for name in ("x", "y", "z", "intensity")}
        columns["time"] = cloud["time"].astype(float) + (stamp_s - self._header[0] * _NS)
        return timed_points(columns, self._where)

    def header(self) -> tuple[int, str]:
        """The turn's time, ns since 1970, and the name of the points' frame."""
        return self._header


def decode_packets(packets: Sequence[Packet], sensor: VelodyneSensor, where: str) -> tuple[float, Any]:
    """Decodes packets of one turn.

    Args:
      packets: at least one.
      sensor: that sent them.
      where: recording and time, for the error.

    Returns:
      The time of the last packet, s since 1970, and an array with the fields x, y, z (m), intensity (0 to
      255) and time (s from that of the last packet), among others.

    Raises:
      InputError: where they are damaged, or the sensor is not known.
      ImportError: without the extra ``velodyne``.
    """
    library = _library()
    _check_packets(packets, sensor, where)
    try:
        decoder = library.ScanDecoder(_decoder_config(sensor))
        listed = [library.VelodynePacket(time_ns * _NS, data) for time_ns, data in packets]
        stamp, cloud = decoder.decode(library.PacketVector(listed), True)
    except (RuntimeError, ValueError, TypeError) as error:
        raise InputError(f"{where}: the packets cannot be decoded ({reason(error)}). {_HDL64E}") from error
    return stamp.host, cloud


def _check_packets(packets: Sequence[Packet], sensor: VelodyneSensor, where: str) -> None:
    """Refuses what the decoder would read memory for that is not its own."""
    if not packets:
        raise InputError(f"{where}: a turn without packets.")
    models = {data[-1] for _, data in packets}
    needed = _NUM_LASERS.get(models.pop(), _NUM_HDL64E_LASERS) if len(models) == 1 else _NUM_HDL64E_LASERS
    if sensor.num_lasers not in (None, needed):
        raise InputError(
            f"{where}: a sensor of {needed} lasers, and the calibration beside the recording is of "
            f"{sensor.num_lasers}; put that of this sensor there, or move it away."
        )


@functools.lru_cache(maxsize=4)
def _decoder_config(sensor: VelodyneSensor) -> Any:
    library = _library()
    config = library.Config()
    if sensor.model is not None:
        config.model = getattr(library.Model, sensor.model)
    if sensor.calibration is not None:
        config.calibration = library.Calibration.from_string(sensor.calibration)
    return config


def _library() -> Any:
    return require("velodyne_decoder", extra="velodyne", what="packets of Velodyne sensors")


def calibrated_sensor(path: pathlib.Path) -> VelodyneSensor:
    """What a file beside a recording says of the sensor.

    Args:
      path: of the recording; ``drive.yaml`` (ROS's driver), or ``drive.xml`` or ``db.xml`` (Velodyne), is the
        calibration of ``drive.pcap``.

    Returns:
      Calibration, and the model where that follows; nothing where there is no such file.

    Raises:
      InputError: where the file cannot be read.
      ImportError: without the extra ``velodyne``.
    """
    file = _calibration_file(path)
    return ANY_MODEL if file is None else read_calibrated_sensor(file)


def _calibration_file(path: pathlib.Path) -> pathlib.Path | None:
    stem = path.name if path.is_dir() else path.stem
    names = [*(f"{stem}{suffix}" for suffix in _CALIBRATION_SUFFIXES), "db.xml"]
    places = map(path.with_name, names)
    return next((place for place in places if place.is_file()), None)


def read_calibrated_sensor(file: pathlib.Path) -> VelodyneSensor:
    """What a calibration says of a sensor.

    Args:
      file: YAML (ROS's driver) or XML (Velodyne).

    Returns:
      Calibration, and the model where that follows.

    Raises:
      InputError: where the file cannot be read.
      ImportError: without the extra ``velodyne``.
    """
    text = read_text(file)
    if file.suffix == ".xml":
        text = _yaml_of_xml(text, str(file))
    try:
        known = _library().Calibration.from_string(text).to_string()
        lasers = sorted(map(int, re.findall(r"laser_id: (-?\d+)", known)))
        sizes = (_NUM_HDL64E_LASERS, *_NUM_LASERS.values())
        if lasers != list(range(len(lasers))) or len(lasers) not in sizes:
            raise ValueError(f"{len(lasers)} lasers, numbered {lasers[:3]}...")
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"{file}: no calibration of a Velodyne sensor ({reason(error)}); give the YAML of ROS's driver "
            "or the XML of the sensor, or move the file away."
        ) from error
    return VelodyneSensor("HDL64E_S3" if len(lasers) == _NUM_HDL64E_LASERS else None, text, len(lasers))


def _yaml_of_xml(text: str, where: str) -> str:
    """Velodyne's own calibration, in degrees and cm, as YAML (JSON is some)."""
    try:
        root = ElementTree.fromstring(text)
        step_cm = float(root.findtext(".//distLSB_") or 0.2)
        lasers = [_laser(item) for item in root.iterfind(".//points_/item/px")]
    except (ElementTree.ParseError, ValueError, TypeError) as error:
        raise InputError(f"{where}: no readable calibration ({reason(error)}); copy it again.") from error
    enabled = [item.text == "1" for item in root.iterfind(".//enabled_/item")] or [True] * len(lasers)
    kept = [laser for laser, on in zip(lasers, enabled, strict=False) if on]
    # The file has room for 64 lasers of any model.
    return json.dumps({"distance_resolution": step_cm / 100, "num_lasers": len(kept), "lasers": kept})


def _laser(item: ElementTree.Element) -> dict[str, float]:
    laser: dict[str, float] = {"laser_id": int(item.findtext("id_") or "")}
    for name, (field, scale) in _XML_FIELDS.items():
        if (value := item.findtext(name)) is not None:
            laser[field] = float(value) * scale
    return laser


def _told_calibration(path: pathlib.Path, packets: Iterable[bytes]) -> VelodyneSensor:
    """What an HDL-64E S2 or S3 says of itself, a byte a packet."""
    hdl64e = require("velodyne_decoder.hdl64e", extra="velodyne", what="packets of Velodyne sensors")
    try:
        with warnings.catch_warnings():
            # Of what comes before a whole account.
            warnings.simplefilter("ignore")
            status = hdl64e.read_status_info(itertools.islice(packets, _MAX_STATUS_PACKETS))
    except (ValueError, LookupError) as error:
        raise InputError(
            f"{path}: an HDL-64E, and its packets do not tell its calibration ({reason(error)}). {_HDL64E}"
        ) from error
    calibration = hdl64e.status_info_to_calib_dict(status)
    del calibration["status"]
    return VelodyneSensor(f"HDL64E_{status['Model']}", json.dumps(calibration), _NUM_HDL64E_LASERS)


def open_velodyne_capture(path: pathlib.Path, topic: str | None = None) -> RecordedSweeps:
    """Opens the turns of a Velodyne sensor in a capture.

    Args:
      path: a capture, see `read_datagrams`.
      topic: sender and port, such as "192.168.1.201:2368"; None where only one sensor sends.

    Returns:
      The turns, each with the time of its last packet.

    Raises:
      InputError: where it is no capture, no such sensor sends, or the sender has to be named; as
        `calibrated_sensor`, and where an HDL-64E's calibration is not known.
      ImportError: without the extra ``velodyne``.
    """
    batchers = collections.defaultdict[str, TurnBatcher](TurnBatcher)
    counts, others = collections.Counter[str](), collections.Counter[tuple[str, int]]()
    for time_ns, address, payload in read_datagrams(path):
        if len(payload) == PACKET_BYTES:
            counts[address] += batchers[address].push(time_ns, payload) is not None
        else:
            others[address, len(payload)] += 1
    for address, batcher in batchers.items():
        counts[address] += batcher.finish() is not None
    if not any(counts.values()):
        raise InputError(f"{path}: {_what_is_there(len(batchers), others)}")
    # Before anything is read twice.
    _library()
    chosen = choose_topic(path, topic, +counts, [])

    def sent() -> Iterator[Datagram]:
        found = read_datagrams(path)
        return (d for d in found if d.address == chosen and len(d.payload) == PACKET_BYTES)

    sensor = calibrated_sensor(path)
    first = [datagram.payload for datagram in itertools.islice(sent(), _NUM_LOOKED_AT)]
    # Of other models these bytes are the kind of the returns, and the model.
    if sensor.model is None and len({packet[_FACTORY_BYTES] for packet in first}) > 1:
        sensor = _told_calibration(path, (datagram.payload for datagram in sent()))

    def messages() -> Iterator[Message]:
        batcher = TurnBatcher()
        turns = (batcher.push(datagram.time_ns, datagram.payload) for datagram in sent())
        for turn in itertools.chain(turns, (batcher.finish() for _ in range(1))):
            if turn is not None:
                time_ns = turn[-1][0]
                yield time_ns, VelodynePoints(turn, sensor, f"{path} at {time_ns}", (time_ns, ""))

    return RecordedSweeps(path, chosen, counts[chosen], messages)


def _what_is_there(num_velodyne: int, others: collections.Counter[tuple[str, int]]) -> str:
    if num_velodyne:
        return "packets of a Velodyne sensor, but not half a turn of it; capture 0.2 s or more."
    most = ", ".join(f"{count} of {size} bytes from {name}" for (name, size), count in others.most_common(3))
    return (
        f"no packets of a Velodyne sensor ({PACKET_BYTES} bytes); there are {most or 'none over UDP'}. An "
        "Ouster's need its metadata beside the capture, FILE.json. Other sensors' software exports PCD or "
        "LAS, and their ROS drivers record sensor_msgs/PointCloud2: both are read."
    )


def open_capture(path: pathlib.Path, topic: str | None = None) -> RecordedSweeps:
    """Opens a capture: an Ouster's where its metadata lies beside it, and a Velodyne's otherwise.

    Args:
      path: the capture.
      topic: as `open_velodyne_capture` or `jaxbox.io.ouster.open_ouster`.

    Returns:
      The sweeps.

    Raises:
      InputError: as either.
      ImportError: without the extra ``velodyne`` or ``ouster``.
    """
    metadata = ouster_metadata(path)
    if metadata is not None:
        return open_ouster(path, topic, metadata=metadata)
    return open_velodyne_capture(path, topic)


CAPTURE = RecordingFormat(name="captures of packets", suffixes=(".pcap", ".pcapng"), open=open_capture)
