"""What an Arrow file would unpack to, from its own tables: Arrow itself allocates what a buffer claims.

Only the few fields of the flatbuffers that say where buffers lie are read here; pyarrow reads the rest.

Reference: the Arrow columnar format, "IPC File Format", and its schemas ``File.fbs`` and ``Message.fbs``.
"""

import mmap
import struct
from collections.abc import Iterator

_MAGIC_BYTES = 6
_PREFIX = 8
"""Bytes before a compressed buffer that give its size; -1 where it is not compressed after all."""
_CONTINUES = 0xFFFFFFFF
_FOOTER_DICTIONARIES, _FOOTER_BATCHES = 2, 3
_MESSAGE_KIND, _MESSAGE_HEADER = 1, 2
_DICTIONARY_KIND, _DICTIONARY_DATA = 2, 1
_BATCH_BUFFERS, _BATCH_COMPRESSION = 2, 3
_BLOCK, _BUFFER = struct.Struct("<qi4xq"), struct.Struct("<qq")

Data = mmap.mmap | bytes


def unpacked_bytes(data: Data) -> int:
    """Sums what the buffers of an Arrow file claim to unpack to.

    Args:
      data: the whole file.

    Returns:
      Bytes of all compressed buffers, unpacked; 0 for a file without any.

    Raises:
      struct.error: where a table points out of the file, which is damaged then.
    """
    length = _integer(data, "<i", len(data) - _MAGIC_BYTES - 4)
    footer = len(data) - _MAGIC_BYTES - 4 - length
    root = footer + _integer(data, "<I", footer)
    blocks = [
        block
        for field in (_FOOTER_DICTIONARIES, _FOOTER_BATCHES)
        for block in _structs(data, _field(data, root, field), _BLOCK)
    ]
    return sum(_unpacked_block(data, offset, length) for offset, length, _ in blocks)


def _unpacked_block(data: Data, start: int, metadata_bytes: int) -> int:
    """Of one record batch or dictionary."""
    table = start + (8 if _integer(data, "<I", start) == _CONTINUES else 4)
    message = table + _integer(data, "<I", table)
    kind, header = (_field(data, message, number) for number in (_MESSAGE_KIND, _MESSAGE_HEADER))
    if not kind or not header:
        return 0
    batch = header + _integer(data, "<I", header)
    if _integer(data, "<B", kind) == _DICTIONARY_KIND:
        field = _field(data, batch, _DICTIONARY_DATA)
        batch = field + _integer(data, "<I", field)
    if not _field(data, batch, _BATCH_COMPRESSION):
        return 0
    body = start + metadata_bytes
    buffers = _structs(data, _field(data, batch, _BATCH_BUFFERS), _BUFFER)
    return sum(
        max(_integer(data, "<q", body + offset), length) for offset, length in buffers if length > _PREFIX
    )


def _field(data: Data, table: int, number: int) -> int:
    """Where a table's field lies, or 0 where it is absent."""
    vtable = table - _integer(data, "<i", table)
    place = 4 + 2 * number
    if place >= _integer(data, "<H", vtable):
        return 0
    offset = _integer(data, "<H", vtable + place)
    return table + offset if offset else 0


def _structs(data: Data, field: int, kind: struct.Struct) -> Iterator[tuple[int, ...]]:
    """The items of a field that is a vector."""
    if not field:
        return
    vector = field + _integer(data, "<I", field)
    for index in range(_integer(data, "<I", vector)):
        yield _unpack(data, kind, vector + 4 + index * kind.size)


def _integer(data: Data, kind: str, offset: int) -> int:
    return _unpack(data, struct.Struct(kind), offset)[0]


def _unpack(data: Data, kind: struct.Struct, offset: int) -> tuple[int, ...]:
    # A negative offset would count from the end.
    if offset < 0:
        raise struct.error(f"a table at byte {offset}")
    return kind.unpack_from(data, offset)
