"""The thread that receives: it goes through a source, and leaves the newest sweep for who detects."""

import threading
import time
from collections.abc import Callable, Generator

from jaxbox.live.mailbox import Closed, Mailbox
from jaxbox.live.sweep import IDLE_S, Fault, LiveSweep, Source

Report = Callable[[str], None]
"""Is told, in a sentence, what a user should know."""

MAX_TOLD_FAULTS = 5
"""Faults that are told one by one; the others are counted only, as a broken sensor has thousands a second."""
_JOIN_S = 10 * IDLE_S


class Reception:
    """A source that is gone through in a thread, as a context."""

    def __init__(self, source: Source, report: Report) -> None:
        """Begins nothing yet.

        Args:
          source: of the sweeps.
          report: is told of faults.
        """
        self._source, self._report = source, report
        self._mailbox: Mailbox[LiveSweep] = Mailbox()
        self._ready, self._stopped = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._receive, name="receive", daemon=True)
        self.num_faults = 0
        """What came and was no sweep."""

    @property
    def num_skipped(self) -> int:
        """Sweeps that nobody looked at."""
        return self._mailbox.num_skipped

    def __enter__(self) -> "Reception":
        """Starts the thread."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Ends it: within moments, as a source gives way several times a second."""
        self._stopped.set()
        self._ready.set()
        self._thread.join(_JOIN_S)

    def go_on(self) -> None:
        """Lets a source that can wait go on after its first sweep."""
        self._ready.set()

    def pass_over(self) -> None:
        """Counts a sweep that was taken, and came too late to be looked at."""
        self._mailbox.skip()

    def sweeps(self, timeout_s: float) -> Generator[LiveSweep, None, None]:
        """The newest sweep each time, as long as the source goes on.

        Args:
          timeout_s: a silence of so long is reported once, and its end.

        Yields:
          Sweeps.

        Raises:
          Exception: what ended the source, such as an `InputError`.
        """
        last_s, name = time.monotonic(), self._source.name
        is_silent = False
        while True:
            try:
                sweep = self._mailbox.take(timeout_s)
            except Closed:
                return
            now_s = time.monotonic()
            if sweep is None:
                if not is_silent:
                    self._report(f"nothing from {name} for {timeout_s:g} s: {self._source.hint}")
                is_silent = True
                continue
            if is_silent:
                self._report(f"{name} is there again after {now_s - last_s:.1f} s.")
            is_silent = False
            yield sweep
            last_s = time.monotonic()

    def _receive(self) -> None:
        error: BaseException | None = None
        try:
            for item in self._source:
                if self._stopped.is_set():
                    break
                self._sort(item)
        except BaseException as problem:
            # It is raised again in the thread that waits for sweeps.
            error = problem
        self._mailbox.close(error)

    def _sort(self, item: LiveSweep | Fault | None) -> None:
        if isinstance(item, LiveSweep):
            self._mailbox.put(item)
            if self._source.can_wait:
                self._ready.wait()
        elif isinstance(item, Fault):
            self.num_faults += 1
            if self.num_faults <= MAX_TOLD_FAULTS:
                more = "; more of them are counted only" if self.num_faults == MAX_TOLD_FAULTS else ""
                self._report(f"{item.reason}{more}")
