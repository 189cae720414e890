"""A viewer behind an address: server, page, session and loop put together."""

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence

from jaxbox import io
from jaxbox._loopback import LOOPBACK
from jaxbox.config import DetectorConfig
from jaxbox.viewer.drives import TrackMemory, split_drives
from jaxbox.viewer.frames import Frames
from jaxbox.viewer.page import ViserPage
from jaxbox.viewer.server import open_server, page_url, quiet
from jaxbox.viewer.session import Session
from jaxbox.viewer.viewer import KeepRows, Side, Viewer, Wanted

_SplitDrives = tuple[Sequence[io.Sweep], tuple[Sequence[io.Sweep], ...]]
"""What `split_drives` answers."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparison:
    """What a page shows beside its sweeps: other sweeps, or the same with other settings."""

    title: str
    """What it is, in a few words."""
    config: DetectorConfig | None = None
    """Settings; None for those of the page."""
    sweeps: Sequence[io.Sweep] | None = None
    """Sweeps, which are shown by number: the first with the first; None for those of the page."""
    of: str = ""
    """What it is compared with, in a few words; empty for the page's preset."""


@contextlib.contextmanager
def open_viewer(
    sweeps: Sequence[io.Sweep],
    *,
    wanted: Wanted | None = None,
    host: str = LOOPBACK,
    port: int = 0,
    capacity: int | None = None,
    comparison: Comparison | None = None,
    keep: KeepRows | None = None,
) -> Iterator[tuple[Viewer, str]]:
    """Serves a page while the block runs; in it, `Viewer.run` answers what the page's user asks for.

    Args:
      sweeps: what `jaxbox.io.open_sweeps` answers; the timeline has them drive by drive.
      wanted: what the page begins with; None for the first sweep and the default preset.
      host: name or address to listen at.
      port: 0 takes a free one.
      capacity: points that a sweep is padded to; None for what it needs.
      comparison: what is shown with it; None for nothing.
      keep: answers boxes or tracks with those no longer valid that are not shown; None shows all.

    Yields:
      The viewer, and the address of its page.

    Raises:
      InputError: where the address cannot be listened at.
      ImportError: without the extra ``view``.
    """
    wanted = Wanted() if wanted is None else wanted
    server = open_server(host=host, port=port)
    try:
        with contextlib.ExitStack() as stack:
            split = split_drives(sweeps)
            side = _side(split, capacity, stack)
            compared = None if comparison is None else _compared_side(comparison, split, capacity, stack)
            page = ViserPage(server, wanted, num_sweeps=len(side.session), compares=compared is not None)
            title = "" if comparison is None else comparison.of
            viewer = Viewer(
                side.session, page, wanted, tracks=side.tracks, title=title, compared=compared, keep=keep
            )
            page.connect(viewer)
            yield viewer, page_url(server)
    finally:
        with quiet():
            server.stop()


def _side(split: _SplitDrives, capacity: int | None, stack: contextlib.ExitStack) -> Side:
    """Sweeps with a detector and a memory of tracks, which the stack closes."""
    ordered, drives = split
    tracks = stack.enter_context(contextlib.closing(TrackMemory(drives, capacity=capacity)))
    return Side(session=Session(Frames(ordered, capacity=capacity)), tracks=tracks)


def _compared_side(
    comparison: Comparison, split: _SplitDrives, capacity: int | None, stack: contextlib.ExitStack
) -> Side:
    is_same = comparison.sweeps is None
    side = _side(split if comparison.sweeps is None else split_drives(comparison.sweeps), capacity, stack)
    return dataclasses.replace(side, title=comparison.title, config=comparison.config, same_sweeps=is_same)
