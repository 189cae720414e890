"""Vehicles while the sensor runs: sources that never wait, a loop in which the newest sweep wins, and sinks.

`open_source` makes a source of what a user names, and `LiveRun` goes through it.
"""

from jaxbox.live.latency import Latencies
from jaxbox.live.loop import LiveResult, LiveRun
from jaxbox.live.pipeline import LiveConfig
from jaxbox.live.recorded import RecordedSource
from jaxbox.live.sources import open_source
from jaxbox.live.sweep import Fault, LiveSweep, Source

__all__ = [
    "Fault",
    "Latencies",
    "LiveConfig",
    "LiveResult",
    "LiveRun",
    "LiveSweep",
    "RecordedSource",
    "Source",
    "open_source",
]
