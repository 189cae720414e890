"""A viewer behind an address: server, page, session and loop put together."""

import contextlib
from collections.abc import Iterator, Sequence

from jaxbox import io
from jaxbox.viewer.drives import TrackMemory, split_drives
from jaxbox.viewer.frames import Frames
from jaxbox.viewer.page import ViserPage
from jaxbox.viewer.server import open_server, page_url, quiet
from jaxbox.viewer.session import Session
from jaxbox.viewer.viewer import Viewer, Wanted

LOOPBACK = "127.0.0.1"
"""Reached from this machine only."""


@contextlib.contextmanager
def open_viewer(
    sweeps: Sequence[io.Sweep],
    *,
    wanted: Wanted | None = None,
    host: str = LOOPBACK,
    port: int = 0,
    capacity: int | None = None,
) -> Iterator[tuple[Viewer, str]]:
    """Serves a page while the block runs; in it, `Viewer.run` answers what the page's user asks for.

    Args:
      sweeps: what `jaxbox.io.open_sweeps` answers; the timeline has them drive by drive.
      wanted: what the page begins with; None for the first sweep and the default preset.
      host: name or address to listen at.
      port: 0 takes a free one.
      capacity: points that a sweep is padded to; None for what it needs.

    Yields:
      The viewer, and the address of its page.

    Raises:
      InputError: where the address cannot be listened at.
      ImportError: without the extra ``view``.
    """
    wanted = Wanted() if wanted is None else wanted
    server = open_server(host=host, port=port)
    try:
        ordered, drives = split_drives(sweeps)
        page = ViserPage(server, wanted, num_sweeps=len(ordered))
        with contextlib.closing(TrackMemory(drives, capacity=capacity)) as tracks:
            viewer = Viewer(Session(Frames(ordered, capacity=capacity)), page, wanted, tracks=tracks)
            page.connect(viewer)
            yield viewer, page_url(server)
    finally:
        with quiet():
            server.stop()
