"""PLY, the Stanford polygon format: the vertices of ascii, little-endian and big-endian files.

Read here rather than by a library: the one that is maintained, plyfile, is under the GPL, which this
package is not. The tests read what plyfile writes. Elements after the vertices are not looked at.
"""

import os
import pathlib
import re
from typing import BinaryIO

import numpy as np

from jaxbox._files import InputError, check_file, reason
from jaxbox.io.point_times import timed_reader
from jaxbox.io.points import (
    PointFormat,
    Points,
    check_num_bytes,
    check_num_points,
    named_points,
    read_number_lines,
)

_MAX_HEADER_LINES = 1024
_MAX_LINE_BYTES = 65536
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip


def read_ply(path: str | os.PathLike[str]) -> Points:
    """Reads the vertices of a PLY file.

    Args:
      path: the file.

    Returns:
      As `jaxbox.io.read_points`.

    Raises:
      InputError: where it is not a PLY file, is cut short, has no x, y, z, or does not begin with vertices.
    """
    return named_points(_columns(path), str(path))


def _columns(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    there = check_file(path)
    with pathlib.Path(path).open("rb") as file:
        order, count, dtype = _read_header(file, str(path))
        check_num_points(count, str(path))
        if order:
            size = count * dtype.itemsize
            check_num_bytes(size, there - file.tell(), str(path))
            vertices = np.frombuffer(file.read(size), dtype) if size else np.zeros(0, dtype)
        else:
            vertices = _read_ascii(file, count, dtype, str(path))
    return {name: vertices[name] for name in dtype.names or ()}


def _read_header(file: BinaryIO, where: str) -> tuple[str, int, np.dtype]:
    """Byte order (empty for ascii), number of vertices, and the type of a vertex."""
    lines = []
    while len(lines) < _MAX_HEADER_LINES and (line := file.readline(_MAX_LINE_BYTES)):
        lines.append(line.decode("ascii", "replace").strip())
        if lines[-1] == "end_header":
            break
    else:
        lines = []
    header = "\n".join(lines)
    kind = re.match(r"ply\nformat (\w+) 1\.0$", header, re.MULTILINE)
    if kind is None or kind[1] not in _ORDERS:
        raise InputError(f"{where}: no PLY file; it must begin with ply, format and end in end_header.")
    element, *_ = re.split(r"^(?=element )", header, flags=re.MULTILINE)[1:] or [""]
    vertex = re.match(r"element vertex (\d+)$", element, re.MULTILINE)
    if vertex is None:
        raise InputError(f"{where}: the first element is not a vertex; write the vertices before all else.")
    order = _ORDERS[kind[1]]
    properties = re.findall(r"^property (.+)$", element, re.MULTILINE)
    fields = [
        (name, order + _TYPES.get(kind, "")) for kind, _, name in (p.rpartition(" ") for p in properties)
    ]
    if unknown := [name for name, kind in fields if not kind.lstrip("<>")]:
        raise InputError(f"{where}: vertex property {unknown[0]} is not a number; leave it out.")
    try:
        return order, int(vertex[1]), np.dtype(fields)
    # A name that occurs twice, or a number of thousands of digits.
    except ValueError as error:
        raise InputError(
            f"{where}: the PLY header cannot be read ({reason(error)}); write it again."
        ) from error


def _read_ascii(file: BinaryIO, count: int, dtype: np.dtype, where: str) -> np.ndarray:
    rows = read_number_lines(file, count, len(dtype.names or ()), where)
    vertices = np.empty(count, dtype)
    # Numbers beyond their type's range.
    with np.errstate(over="ignore", invalid="ignore"):
        for name, values in zip(dtype.names or (), rows.T, strict=True):
            vertices[name] = values
    return vertices


PLY = PointFormat(name="PLY", suffixes=(".ply",), read=read_ply, read_timed=timed_reader(_columns))
