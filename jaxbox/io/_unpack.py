"""Unpacking with a bound: what a file says of its unpacked size may be a lie."""

import bz2
import io
from typing import Any, BinaryIO

from jaxbox._extras import require
from jaxbox._files import InputError

MAX_CHUNK_BYTES = 2**27
"""Of one chunk or message of a recording, unpacked; writers make chunks of a few megabytes."""

_PIECE_BYTES = 2**20


def unpack(data: bytes, compression: str, where: str) -> bytes:
    """Unpacks one chunk or message, and stops where that makes too much of it.

    Args:
      data: packed.
      compression: ``lz4``, ``bz2``, ``zstd``, or ``none`` or empty.
      where: the file, for the error.

    Returns:
      The unpacked bytes, at most `MAX_CHUNK_BYTES`.

    Raises:
      InputError: for more than that, or another compression.
      Exception: what the decompressor raises on broken bytes.

    >>> unpack(bz2.compress(b"points"), "bz2", "here")
    b'points'
    """
    if compression in ("", "none"):
        return data
    pieces, size = [], 0
    with _open(io.BytesIO(data), compression, where) as file:
        while piece := file.read(_PIECE_BYTES):
            size += len(piece)
            if size > MAX_CHUNK_BYTES:
                raise InputError(
                    f"{where}: {len(data)} bytes unpack to more than {MAX_CHUNK_BYTES}. "
                    "The file is damaged, or made to fill the memory."
                )
            pieces.append(piece)
    return b"".join(pieces)


def _open(file: BinaryIO, compression: str, where: str) -> Any:
    if compression == "bz2":
        return bz2.BZ2File(file)
    if compression == "lz4":
        return require("lz4.frame", extra="ros", what="Recordings").open(file)
    if compression == "zstd":
        return open_zstd(file)
    raise InputError(f"{where}: the compression {compression!r} is not known; write it with lz4 or zstd.")


def open_zstd(file: BinaryIO) -> Any:
    """What zstd has packed, as a file; it may be several frames."""
    zstandard = require("zstandard", extra="ros", what="Recordings")
    return zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
