"""A server that Foxglove connects to: points, boxes with trails and arrows, poses, and the records.

The topics are those of the MCAP files, see `jaxbox.io.mcap_results`. A slow reader loses the oldest messages.
"""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

from jaxbox._extras import require
from jaxbox._loopback import LOOPBACK
from jaxbox.io import InputError
from jaxbox.io.mcap_results import add_result, record_schema
from jaxbox.io.results import SweepResult
from jaxbox.live.loop import LiveResult
from jaxbox.live.sinks import Sink

PORT = 8765
"""At which Foxglove looks for a server unless it is told otherwise."""
MAX_WAITING = 64
"""Messages that wait for one reader: a second or two of all topics."""


@contextlib.contextmanager
def open_foxglove(
    *, host: str = LOOPBACK, port: int = PORT, points: bool = True
) -> Iterator[tuple[Sink, str]]:
    """Serves results to Foxglove while the context is open.

    Args:
      host: address to listen at; the default is reached from this machine only. The server asks nobody who
        they are.
      port: 0 takes a free one.
      points: whether points are served, too.

    Yields:
      What takes each result, and the server's address.

    Raises:
      InputError: where the address cannot be listened at.
      ImportError: without the extra ``foxglove``.
    """
    library = require("foxglove", extra="foxglove", what="Foxglove's live view")
    context = library.Context()
    try:
        server = library.start_server(
            name="jaxbox", host=host, port=port, context=context, message_backlog_size=MAX_WAITING
        )
    except (OSError, RuntimeError) as error:
        raise InputError(
            f"cannot listen at {host}, port {port} ({error}); choose another --foxglove-port (0 takes a free "
            "one), or a --host of this machine."
        ) from error
    channels = _Channels(library, context)

    def send(_: LiveResult, result: SweepResult) -> None:
        shown = result if points else dataclasses.replace(result, xyz=None)
        add_result(channels, shown, shown.time_ns(0))

    try:
        yield send, f"ws://{host}:{server.port}"
    finally:
        server.stop()


class _Channels:
    """The topics of a server, each opened with its first message."""

    def __init__(self, library: Any, context: Any) -> None:
        self._library, self._context = library, context
        self._open: dict[str, Any] = {}

    def add_message(self, topic: str, message: Any, time_ns: int) -> None:
        """Sends a protobuf message."""
        if topic not in self._open:
            schemas = require("mcap_protobuf.schema", extra="foxglove", what="Foxglove's live view")
            kind = type(message)
            data = schemas.build_file_descriptor_set(kind).SerializeToString()
            schema = self._library.Schema(name=kind.DESCRIPTOR.full_name, encoding="protobuf", data=data)
            self._open[topic] = self._library.Channel(
                topic, schema=schema, message_encoding="protobuf", context=self._context
            )
        self._open[topic].log(message.SerializeToString(), log_time=time_ns)

    def add_record(self, topic: str, record: Any, time_ns: int) -> None:
        """Sends a record as JSON."""
        if topic not in self._open:
            self._open[topic] = self._library.Channel(
                topic, schema=record_schema(topic), message_encoding="json", context=self._context
            )
        self._open[topic].log(dict(record), log_time=time_ns)
