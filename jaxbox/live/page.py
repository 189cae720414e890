"""The viewer's page, fed while the sensor runs: the newest sweep with boxes and trails, and thresholds."""

import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterator

from jaxbox._loopback import LOOPBACK
from jaxbox.config import DetectorConfig
from jaxbox.io.results import SweepResult
from jaxbox.live.loop import LiveResult
from jaxbox.live.sinks import Sink
from jaxbox.run.tracking import TrackedSweep
from jaxbox.viewer.drives import TrackedFrame, TrackMemory
from jaxbox.viewer.frames import Frame, Frames
from jaxbox.viewer.page import ViserPage
from jaxbox.viewer.server import open_server, page_url, quiet
from jaxbox.viewer.session import Session, Shown
from jaxbox.viewer.viewer import Viewer, Wanted

PORT = 8080
"""Of the page, unless another is named."""


@contextlib.contextmanager
def open_page(
    wanted: Wanted, use: Callable[[DetectorConfig], None], *, host: str = LOOPBACK, port: int = PORT
) -> Iterator[tuple[Sink, str]]:
    """Serves a page while the context is open; a thread of its own draws the newest sweep.

    Args:
      wanted: what the page begins with.
      use: is told of other settings, where the page's user moves a threshold.
      host: address to listen at; the default is reached from this machine only.
      port: 0 takes a free one.

    Yields:
      What takes each result, and the page's address.

    Raises:
      InputError: where the address cannot be listened at.
      ImportError: without the extra ``view``.
    """
    server = open_server(host=host, port=port)
    try:
        page = ViserPage(server, wanted, num_sweeps=1)
        newest = _Newest(use)
        viewer = Viewer(newest, page, wanted, tracks=_NewestTracks(newest))
        page.connect(viewer)
        thread = threading.Thread(target=viewer.run, name="page", daemon=True)

        def show(live: LiveResult, written: SweepResult) -> None:
            newest.put(live, written)
            # Each sweep is another wish, of which a page that is slower answers the last only.
            viewer.want(index=live.sweep.frame)
            if not thread.is_alive():
                thread.start()

        try:
            yield show, page_url(server)
        finally:
            viewer.stop()
            if thread.is_alive():
                thread.join()
    finally:
        with quiet():
            server.stop()


class _Newest(Session):
    """The newest sweep, in which somebody else has detected already."""

    detects = False

    def __init__(self, use: Callable[[DetectorConfig], None]) -> None:
        super().__init__(Frames(()))
        self._use, self._used = use, None
        self._came: tuple[LiveResult, SweepResult] | None = None
        self._drawn: tuple[LiveResult, SweepResult] | None = None

    def put(self, live: LiveResult, written: SweepResult) -> None:
        """Takes the place of the sweep before; any thread may."""
        self._came = live, written

    def __len__(self) -> int:
        return 1 if self._came is None else self._came[0].sweep.frame + 1

    def frame(self, index: int) -> Frame:
        """The newest sweep, whatever its number, which `detect` and the tracks are then of."""
        del index
        self._drawn = self._came
        live, _ = self.drawn
        assert live.found.detections is not None
        frame = Frame.of_points(
            live.sweep.name,
            *live.sweep.read_points(),
            timestamp_ns=live.sweep.timestamp_ns,
            # The same rows as what was found in them.
            capacity=live.found.detections.ground_mask.shape[-1],
        )
        told = f"{live.num_skipped} of {live.sweep.frame + 1} sweeps were skipped, as newer ones had come."
        return dataclasses.replace(frame, problems=(told,) if live.num_skipped else ())

    def is_compiled(self, frame: Frame, config: DetectorConfig) -> bool:
        """True: nothing is compiled here."""
        del frame, config
        return True

    def detect(self, frame: Frame, config: DetectorConfig) -> Shown:
        """What was found in the frame; other settings are used from the next sweep on."""
        if self._used is not None and config != self._used:
            self._use(config)
        self._used = config
        live, _ = self.drawn
        assert live.found.detections is not None
        return Shown(frame=frame, config=config, detections=live.found.detections, detect_s=live.latency_s)

    @property
    def drawn(self) -> tuple[LiveResult, SweepResult]:
        """What the page shows."""
        assert self._drawn is not None
        return self._drawn


class _NewestTracks(TrackMemory):
    """The tracks of the newest sweep, which somebody else has followed already."""

    def __init__(self, newest: _Newest) -> None:
        super().__init__(())
        self._newest = newest

    def progress(self, index: int, config: DetectorConfig) -> tuple[int, int]:
        """Nothing is left to do."""
        del index, config
        return 1, 1

    def find(self, index: int, config: DetectorConfig) -> tuple[TrackedFrame | None, list[str]]:
        """The tracks, or None where tracks are off."""
        del index, config
        live, written = self._newest.drawn
        if not isinstance(live.found, TrackedSweep) or written.trails is None:
            return None, []
        return TrackedFrame.of(live.found, written.trails), []
