"""LAS and LAZ, the survey formats, by way of laspy: for sweeps that were saved in their sensor's frame."""

import os
import pathlib
import struct
from typing import Any

import numpy as np

from jaxbox._extras import require
from jaxbox._files import InputError, check_file, reason
from jaxbox.io.points import (
    PointFormat,
    Points,
    check_num_bytes,
    check_num_points,
    check_unpacked,
    named_points,
)

MAP_DISTANCE_M = 10_000.0
"""Points whose median is farther from the origin than this are on a map, not round a sensor."""

_NUM_HEADER_BYTES = 375
"""Of the longest header, that of LAS 1.4."""
_VLR_BYTES, _EVLR_BYTES = 54, 60
"""Least size of a variable length record, and of an extended one."""
_LASZIP_RECORD, _CHUNK_POINTS, _ITEMS = 22204, 12, 32
"""The record of a LAZ file that says how points are packed; in it, the points of a chunk, and the items."""
_CHUNKS_DIFFER = 2**32 - 1
"""Instead of the points of a chunk: the table of chunks says how many each has."""
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers of the items of LAS 1.4: point, colours, colours with infrared, waveform."""
_EXTRA_BYTES = 14
"""An item with a layer a byte."""
_COMPRESSED = 0x80
"""Bit of the point format that LAZ sets."""


def read_las(path: str | os.PathLike[str]) -> Points:
    """Reads a LAS or LAZ file, scaled and offset as its header says.

    Args:
      path: the file.

    Returns:
      As `jaxbox.io.read_points`.

    Raises:
      InputError: where it is not such a file, is cut short, or holds map coordinates.
      ImportError: without the extra ``las``.
    """
    laspy = require("laspy", extra="las", what="LAS and LAZ files")
    size = check_file(path)
    try:
        _check_tables(pathlib.Path(path), size)
        with laspy.open(path) as reader:
            header = reader.header
            check_num_points(header.point_count, str(path))
            needed = header.point_count * header.point_format.size
            check_unpacked(needed, str(path))
            if not header.are_points_compressed:
                check_num_bytes(needed, size - header.offset_to_point_data, str(path))
            else:
                _check_layers(pathlib.Path(path), header, size)
            points = reader.read()
        # A scale that is not a number makes points that are not finite, which the detector counts.
        with np.errstate(all="ignore"):
            columns = {name: np.asarray(getattr(points, name)) for name in ("x", "y", "z", "intensity")}
    except InputError:
        raise
    # laspy and its decoders raise whatever the bytes lead them to; lazrs even its own Rust errors.
    except BaseException as error:
        # A panic in Rust is not an Exception.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise InputError(f"{path}: no readable LAS or LAZ file ({reason(error)}); copy it again.") from error
    _check_frame(columns, str(path))
    return named_points(columns, str(path))


def _check_tables(path: pathlib.Path, size: int) -> None:
    """Holds the lengths of the file's tables against its size: the decoders would loop or ask for memory."""
    with path.open("rb") as file:
        header = file.read(_NUM_HEADER_BYTES).ljust(_NUM_HEADER_BYTES, b"\0")
        start, num_vlrs, point_format = struct.unpack_from("<IIB", header, 96)
        check_num_bytes(num_vlrs * _VLR_BYTES, size, str(path))
        # Whatever the major version, laspy goes by the minor one.
        if header[25] >= 4:
            (num_evlrs,) = struct.unpack_from("<I", header, 243)
            check_num_bytes(num_evlrs * _EVLR_BYTES, size, str(path))
        if point_format < _COMPRESSED:
            return
        file.seek(start)
        table = _read_int64(file.read(8))
        if table < 0:
            # Written as a stream: the last bytes say where the table is.
            file.seek(max(size - 8, 0))
            table = _read_int64(file.read(8))
        file.seek(min(max(table, 0), size))
        _, num_chunks = struct.unpack("<II", file.read(8).ljust(8, b"\0"))
        # No chunk is smaller than a byte.
        check_num_bytes(num_chunks, size, str(path))


def _check_layers(path: pathlib.Path, header: Any, size: int) -> None:
    """Holds LAZ chunks against a bound, and their layers against the file's size: the decoder allocates both.

    Reference: Isenburg, "LASzip: lossless compression of LiDAR data", 2013, and the LAZ 1.4 specification: a
    chunk is a point, the number of points, the size of each layer, and the layers.
    """
    lazrs = require("lazrs", extra="las", what="LAZ files")
    (record,) = [vlr.record_data for vlr in header.vlrs if vlr.record_id == _LASZIP_RECORD]
    (chunk_points,) = struct.unpack_from("<I", record, _CHUNK_POINTS)
    if chunk_points != _CHUNKS_DIFFER:
        check_unpacked(chunk_points * header.point_format.size, str(path))
    (num_items,) = struct.unpack_from("<H", record, _ITEMS)
    items = [struct.unpack_from("<HH", record, _ITEMS + 2 + 6 * index) for index in range(num_items)]
    num_layers = sum(num_bytes if kind == _EXTRA_BYTES else _LAYERS.get(kind, 0) for kind, num_bytes in items)
    if not num_layers:
        return
    with path.open("rb") as file:
        file.seek(header.offset_to_point_data)
        chunks = lazrs.read_chunk_table(file, lazrs.LazVlr(record))
        # The table's own place comes first.
        start = header.offset_to_point_data + 8
        for _, num_bytes in chunks:
            if num_bytes:
                file.seek(start + header.point_format.size + 4)
                layers = struct.unpack(f"<{num_layers}I", file.read(4 * num_layers))
                check_num_bytes(sum(layers), size - start, str(path))
            start += num_bytes


def _read_int64(data: bytes) -> int:
    return struct.unpack("<q", data.ljust(8, b"\0"))[0]


def _check_frame(columns: dict[str, np.ndarray], where: str) -> None:
    for name in "xy":
        there = columns[name][np.isfinite(columns[name])]
        middle = float(np.median(there)) if len(there) else 0.0
        if abs(middle) > MAP_DISTANCE_M:
            raise InputError(
                f"{where}: {name} is about {middle:.0f} m: these are map coordinates. Subtract the sensor's "
                "position first: the detector looks from the origin."
            )


LAS = PointFormat(name="LAS and LAZ", suffixes=(".las", ".laz"), read=read_las)
