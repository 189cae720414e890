"""Where the results of a live run go, one sweep after the other."""

from collections.abc import Callable

from jaxbox.io.results import SweepResult
from jaxbox.live.loop import LiveResult

Sink = Callable[[LiveResult, SweepResult], None]
"""Takes one sweep: the result, and what is written of it. It must not take long, as the next sweep waits."""
