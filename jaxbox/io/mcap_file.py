"""The messages of an MCAP file, with a bound on what its chunks unpack to.

The `mcap` library reads the records. It would unpack whatever a chunk holds, so chunks are unpacked here.
"""

import contextlib
import dataclasses
import heapq
import io
import pathlib
from collections.abc import Collection, Iterator
from typing import Any, BinaryIO

from jaxbox._extras import require
from jaxbox._files import InputError, check_file, reason
from jaxbox.io._unpack import MAX_CHUNK_BYTES, unpack

McapMessage = tuple[Any, Any, Any]
"""Schema (or None), channel and message, as the library has them."""


@contextlib.contextmanager
def open_mcap_file(path: pathlib.Path) -> Iterator["McapFile"]:
    """Opens an MCAP file; what library and decompressors raise on broken bytes becomes one kind of error.

    Args:
      path: the file.

    Yields:
      Its reader.

    Raises:
      InputError: naming the file, where it cannot be read.
      ImportError: without the extra ``mcap``.
    """
    require("mcap.reader", extra="mcap", what="MCAP files")
    check_file(path, max_bytes=None)
    try:
        with path.open("rb") as file:
            yield McapFile(file, str(path))
    except (InputError, ImportError):
        raise
    except Exception as error:
        raise InputError(
            f"{path}: the MCAP file cannot be read ({reason(error)}). Copy it again; `mcap recover` fixes a "
            "recording that was cut short."
        ) from error


class McapFile:
    """An open file; it raises whatever the library does, and `open_mcap_file` makes one error of it."""

    def __init__(self, file: BinaryIO, where: str) -> None:
        self._file, self._where = file, where
        self._library = require("mcap.stream_reader", extra="mcap", what="MCAP files")
        self._records = require("mcap.records", extra="mcap", what="MCAP files")
        self._library.read_magic(
            require("mcap.data_stream", extra="mcap", what="MCAP files").ReadDataStream(file)
        )
        self.summary: Any = self._read_summary()
        """The library's `Summary`, or None where the file has none."""

    def _stream(self, *, skip_magic: bool = True) -> Iterator[Any]:
        """Records from where the file stands, chunks as they are."""
        reader = self._library.StreamReader(
            self._file, skip_magic=skip_magic, emit_chunks=True, record_size_limit=MAX_CHUNK_BYTES
        )
        return iter(reader.records)

    def _read_summary(self) -> Any:
        reader = require("mcap.reader", extra="mcap", what="MCAP files")
        self._file.seek(-(reader.FOOTER_SIZE + self._library.MAGIC_SIZE), io.SEEK_END)
        footer = next(self._stream())
        if not isinstance(footer, self._records.Footer):
            raise ValueError("no footer at its end")
        if footer.summary_start == 0:
            return None
        self._file.seek(footer.summary_start)
        summary = require("mcap.summary", extra="mcap", what="MCAP files").Summary()
        for record in self._stream():
            if isinstance(record, self._records.Statistics):
                summary.statistics = record
            elif isinstance(record, self._records.Schema):
                summary.schemas[record.id] = record
            elif isinstance(record, self._records.Channel):
                summary.channels[record.id] = record
            elif isinstance(record, self._records.ChunkIndex):
                summary.chunk_indexes.append(record)
        return summary

    def iter_messages(self, topics: Collection[str] | None = None) -> Iterator[McapMessage]:
        """One pass over the messages, a chunk at a time.

        Args:
          topics: those wanted; None for all.

        Yields:
          Messages in the order of time, or, where the file has no index, in its own order.
        """
        schemas, channels = {}, {}
        if self.summary is not None and self.summary.chunk_indexes:
            schemas, channels = dict(self.summary.schemas), dict(self.summary.channels)
            records = self._indexed_records(topics)
        else:
            records = self._all_records()
        for record in records:
            if isinstance(record, self._records.Schema):
                schemas[record.id] = record
            elif isinstance(record, self._records.Channel):
                channels[record.id] = record
            elif isinstance(record, self._records.Message):
                channel = channels[record.channel_id]
                if topics is None or channel.topic in topics:
                    yield schemas[channel.schema_id] if channel.schema_id else None, channel, record

    def _all_records(self) -> Iterator[Any]:
        """Every record, from the file's start."""
        self._file.seek(0)
        for record in self._stream(skip_magic=False):
            yield from self._unpacked(record) if isinstance(record, self._records.Chunk) else (record,)

    def _indexed_records(self, topics: Collection[str] | None) -> Iterator[Any]:
        """What is in chunks with those topics, messages in the order of time over chunks that overlap."""
        wanted = {
            key for key, channel in self.summary.channels.items() if topics is None or channel.topic in topics
        }
        # Of one time, a chunk comes before its messages, and they stay in their order.
        queue = [
            (chunk.message_start_time, chunk.chunk_start_offset, -1, None)
            for chunk in self.summary.chunk_indexes
            if not chunk.message_index_offsets or wanted & chunk.message_index_offsets.keys()
        ]
        if len({offset for _, offset, *_ in queue}) < len(queue):
            raise ValueError("its index names a chunk twice")
        heapq.heapify(queue)
        while queue:
            _, offset, _, record = heapq.heappop(queue)
            if record is not None:
                yield record
                continue
            self._file.seek(offset)
            for number, found in enumerate(self._unpacked(next(self._stream()))):
                if not isinstance(found, self._records.Message):
                    yield found
                elif found.channel_id in wanted:
                    heapq.heappush(queue, (found.log_time, offset, number, found))

    def _unpacked(self, chunk: Any) -> list[Any]:
        """The records of a chunk."""
        data = unpack(chunk.data, chunk.compression, self._where)
        if len(data) != chunk.uncompressed_size:
            raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes unpacks to {len(data)}")
        return self._library.breakup_chunk(dataclasses.replace(chunk, compression="", data=data))
