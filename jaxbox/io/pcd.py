"""PCD, the Point Cloud Library's format: ascii, binary and binary_compressed, by way of pypcd4.

What a header claims is checked against the size of the file before memory is allocated. The text body is read
here: pypcd4 takes exactly one blank between numbers, and real files have more.
"""

import io
import os
import pathlib
import struct
from typing import Any, BinaryIO

import numpy as np

from jaxbox._extras import require
from jaxbox._files import InputError, atomic_path, check_file, reason
from jaxbox.io.point_times import timed_reader
from jaxbox.io.points import (
    PointFormat,
    Points,
    check_num_bytes,
    check_num_points,
    check_unpacked,
    named_points,
    read_number_lines,
)

_MAX_HEADER_LINES = 64
_MAX_LINE_BYTES = 65536
_MAX_FIELDS = 1024
_LENGTHS = struct.Struct("<II")
_LZF_BEST_RATIO = 100
"""LZF codes at most 264 bytes in 3."""


def read_pcd(path: str | os.PathLike[str]) -> Points:
    """Reads a PCD file; points of an organised cloud come row by row.

    Args:
      path: the file.

    Returns:
      As `jaxbox.io.read_points`.

    Raises:
      InputError: where it is not a PCD file, is cut short, or has no x, y, z.
      ImportError: without the extra ``pcd``.
    """
    return named_points(_columns(path), str(path))


def write_pcd(path: str | os.PathLike[str], xyz: np.ndarray, intensity: np.ndarray) -> None:
    """Writes a binary PCD file, whole or not at all; it needs no extra.

    Args:
      path: the file; its folder is made where it is missing.
      xyz: (n, 3) m.
      intensity: (n,) any unit.

    Raises:
      OSError: where it cannot be written.
    """
    points = np.column_stack([xyz, intensity]).astype("<f4")
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\n"
        f"TYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(points)}\nDATA binary\n"
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(header.encode() + points.tobytes())


def _columns(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    pypcd4 = require("pypcd4", extra="pcd", what="PCD files")
    size = check_file(path)
    with pathlib.Path(path).open("rb") as file:
        lines = _read_header_lines(file, str(path))
        header = _parse_header(lines, pypcd4, str(path))
        check_num_points(header.points, str(path))
        if header.points == 0:
            # pypcd4 makes other than numbers of them under NumPy 1.
            return {name: np.zeros(0) for name in header.build_dtype().names}
        if header.data.value == "ascii":
            return _read_ascii(file, header, str(path))
        _check_body(file, header, size, str(path))
        # The header as it was understood and checked, so that pypcd4 cannot find another one in the file.
        whole = io.BytesIO(header.compose_header().encode() + file.read())
        try:
            cloud = pypcd4.PointCloud.from_fileobj(whole).pc_data
        # For broken bytes the decompressor answers None, which pypcd4 takes the length of, or MemoryError.
        except (ValueError, TypeError, RuntimeError, MemoryError, struct.error) as error:
            raise InputError(
                f"{path}: the points cannot be read ({reason(error)}); copy it again."
            ) from error
    return {name: cloud[name] for name in cloud.dtype.names}


def _read_header_lines(file: BinaryIO, where: str) -> list[str]:
    """The header's lines, without comments and with a line COUNT."""
    lines = []
    while len(lines) < _MAX_HEADER_LINES and (line := file.readline(_MAX_LINE_BYTES)):
        lines.append(line.decode("ascii", "replace").strip())
        if lines[-1].upper().startswith("DATA"):
            break
    else:
        raise InputError(f"{where}: no PCD file, as no line DATA ends its header.")
    lines = [line for line in lines if line and not line.startswith("#")]
    words = {line.split()[0].upper(): line.split()[1:] for line in lines}
    if "COUNT" not in words and "FIELDS" in words:
        # PCL takes a missing line COUNT for ones.
        lines.insert(-1, f"COUNT {' '.join('1' * len(words['FIELDS']))}")
    return lines


def _parse_header(lines: list[str], pypcd4: Any, where: str) -> Any:
    try:
        header = pypcd4.MetaData.parse_header(lines)
        # pypcd4 makes a field of each value.
        if sum(header.count) > _MAX_FIELDS:
            raise ValueError(f"{sum(header.count)} values a point")
        header.build_dtype()
    except (ValueError, KeyError, IndexError, TypeError) as error:
        problem = "; ".join(str(error).splitlines()[:3])
        raise InputError(f"{where}: the PCD header cannot be read ({problem}); write it again.") from error
    return header


def _check_body(file: BinaryIO, header: Any, size: int, where: str) -> None:
    """Holds the sizes in header and body against the file's."""
    there = size - file.tell()
    needed = header.points * header.build_dtype().itemsize
    check_unpacked(needed, where)
    if header.data.value == "binary":
        check_num_bytes(needed, there, where)
    elif header.points:
        lengths = file.read(_LENGTHS.size)
        file.seek(-len(lengths), os.SEEK_CUR)
        check_num_bytes(_LENGTHS.size, len(lengths), where)
        compressed, uncompressed = _LENGTHS.unpack(lengths)
        check_num_bytes(compressed, there - _LENGTHS.size, where)
        if uncompressed != needed or uncompressed > _LZF_BEST_RATIO * compressed:
            raise InputError(
                f"{where}: {compressed} compressed bytes are to make {uncompressed}, and the header's points "
                f"take {needed}. The file is damaged: copy or convert it again."
            )


def _read_ascii(file: BinaryIO, header: Any, where: str) -> dict[str, np.ndarray]:
    names = header.build_dtype().names
    rows = read_number_lines(file, header.points, len(names), where)
    return dict(zip(names, rows.T, strict=True))


PCD = PointFormat(name="PCD", suffixes=(".pcd",), read=read_pcd, read_timed=timed_reader(_columns))
