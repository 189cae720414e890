"""A recording, or a folder of sweeps, as if its sensor were running: each sweep comes at its own time."""

import math
import time
from collections.abc import Iterator, Sequence

from jaxbox import io
from jaxbox.live.sweep import IDLE_S, Fault, LiveSweep
from jaxbox.run.tracking import RATE_HZ

MAX_PAUSE_S = 10.0
"""Sweeps that are farther apart, or go back in time, are of two drives: the second follows at once."""
DRIVE_GAP_S = 60.0
"""Between two drives by the times that their sweeps are given here: no track lives through it."""
_NS_PER_S = 10**9


class RecordedSource:
    """The sweeps of a recording at their own pace; a `jaxbox.live.Source`."""

    can_wait, is_open = True, False
    hint = "the recording pauses there."

    def __init__(
        self, sweeps: Sequence[io.Sweep], *, name: str, rate_hz: float = RATE_HZ, loop: bool = False
    ) -> None:
        """Reads nothing yet.

        Args:
          sweeps: what `jaxbox.io.open_sweeps` gives, in the order of time.
          name: for the results.
          rate_hz: sweeps a second, where the sweeps have no times.
          loop: whether it begins again where it ends, as another drive.

        Raises:
          ValueError: for a rate that is not positive, or infinite.
        """
        if not 0 < rate_hz < math.inf:
            raise ValueError(f"rate_hz is {rate_hz}; give sweeps a second, such as 10.")
        self.name = name
        self._sweeps, self._loop = sweeps, loop
        self._period_ns = round(_NS_PER_S / rate_hz)

    def __iter__(self) -> Iterator[LiveSweep | Fault | None]:
        """The sweeps, each when it is due; where reading takes longer than that, as soon as it is read."""
        due_ns, taken_ns = 0, None
        for frame, (sweep, step_ns) in enumerate(self._steps()):
            item = _read(sweep)
            due_ns = max(due_ns + (step_ns or self._period_ns), time.time_ns())
            yield from _wait_until(due_ns)
            if taken_ns is None:
                taken_ns = due_ns if sweep.timestamp_ns is None else sweep.timestamp_ns
            else:
                taken_ns += step_ns or round(DRIVE_GAP_S * _NS_PER_S)
            if not isinstance(item, Fault):
                arrived_ns = time.time_ns()
                item = LiveSweep(
                    name=sweep.name, frame=frame, timestamp_ns=taken_ns, arrived_ns=arrived_ns, points=item
                )
            yield item

    def _steps(self) -> Iterator[tuple[io.Sweep, int | None]]:
        """The sweeps, and the time since the one before, ns; None where a drive begins."""
        while True:
            before_ns, is_first = None, True
            for sweep in self._sweeps:
                now_ns = sweep.timestamp_ns
                step_ns = self._period_ns
                if now_ns is not None and before_ns is not None:
                    step_ns = now_ns - before_ns
                is_next = not is_first and 0 < step_ns <= MAX_PAUSE_S * _NS_PER_S
                yield sweep, step_ns if is_next else None
                before_ns, is_first = now_ns, False
            if is_first or not self._loop:
                return


def _read(sweep: io.Sweep) -> io.TimedPoints | Fault:
    try:
        return sweep.read_timed_points()
    except (io.InputError, ImportError, OSError) as error:
        return Fault(f"{sweep.name}: {error}")


def _wait_until(due_ns: int) -> Iterator[None]:
    """Waits, and gives way meanwhile."""
    while (left_s := (due_ns - time.time_ns()) / _NS_PER_S) > 0:
        time.sleep(min(left_s, IDLE_S))
        if left_s > IDLE_S:
            yield None
