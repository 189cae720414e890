"""The loop: a thread receives, this one detects, and the newest sweep wins."""

import dataclasses
import math
import time
from collections.abc import Generator

from jaxbox._padding import fitting_capacity
from jaxbox.config import DetectorConfig
from jaxbox.live.pipeline import LiveConfig, Pipeline
from jaxbox.live.reception import Reception, Report
from jaxbox.live.sweep import LiveSweep, Source
from jaxbox.run.streaming import StreamedSweep

HEADROOM = 1.05
"""The capacity holds this many times the points of the first sweep, unless it is given."""
TIMEOUT_S = 2.0
"""A source that is silent for so long has stopped, unless another time is given."""
_NS_PER_S = 10**9


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class LiveResult:
    """One sweep that went through, and how long it took."""

    sweep: LiveSweep
    """The sweep with its points."""
    found: StreamedSweep
    """What was found; a `jaxbox.TrackedSweep` where tracks are on."""
    latency_s: float
    """From the sweep's last point on this machine to its boxes and tracks, s."""
    num_skipped: int
    """Sweeps of the source so far that nobody looked at, as newer ones had come."""
    num_faults: int
    """What came from the source so far and was no sweep."""


class LiveRun:
    """Finds and follows vehicles while a sensor runs: the newest sweep wins, so that no answer is old.

    A thread receives. Sweeps that come while one is computed take each other's place, and the next step of
    the tracker is longer. After a silence of more than its ``max_gap_s`` all tracks end.
    """

    def __init__(
        self,
        source: Source,
        config: LiveConfig | None = None,
        *,
        capacity: int | None = None,
        timeout_s: float = TIMEOUT_S,
        report: Report = lambda sentence: None,
    ) -> None:
        """Begins nothing yet.

        Args:
          source: of the sweeps, such as `open_source` gives.
          config: the settings; None for the defaults.
          capacity: points that every sweep is padded to; None for what holds the first sweep with `HEADROOM`.
            With a number, all is compiled before the source begins. Of larger sweeps the nearest points
            count, as their status says, and `report` is told once.
          timeout_s: a source that is silent for so long is reported, once, and when it is there again.
          report: is told what a user should know, a sentence each; the thread that receives calls it, too.
        """
        self._source, self._report = source, report
        self._config = LiveConfig() if config is None else config
        self._capacity, self._timeout_s = capacity, timeout_s
        self._reception = Reception(source, report)
        self._told_too_large = False

    @property
    def num_skipped(self) -> int:
        """Sweeps so far that nobody looked at, as newer ones had come."""
        return self._reception.num_skipped

    @property
    def num_faults(self) -> int:
        """What came so far and was no sweep, such as a broken file or packet."""
        return self._reception.num_faults

    def use(self, detector: DetectorConfig) -> None:
        """Detects with other settings from the next sweep on; any thread may ask.

        Args:
          detector: the settings. Where they differ in more than thresholds, the next sweep takes as long as
            it takes to compile.
        """
        self._config = dataclasses.replace(self._config, detector=detector)

    def __iter__(self) -> Generator[LiveResult, None, None]:
        """The results as long as the source goes on; once.

        Yields:
          A result a sweep.

        Raises:
          ValueError: as `Pipeline`.
          ImportError: as `Pipeline`, and where the source needs an extra.
          InputError: where the source cannot go on.
        """
        pipeline = None if self._capacity is None else Pipeline(self._config, capacity=self._capacity)
        with self._reception as reception:
            for taken in reception.sweeps(self._timeout_s):
                sweep = taken
                if pipeline is None:
                    pipeline = self._compile_for(sweep)
                    if not self._source.can_wait:
                        # By now it is late, and there are newer ones.
                        reception.pass_over()
                        continue
                    sweep = sweep.arriving_now()
                reception.go_on()
                self._check_size(sweep, pipeline.capacity)
                pipeline.detector = self._config.detector
                found = pipeline(sweep)
                yield LiveResult(
                    sweep=sweep,
                    found=found,
                    latency_s=(time.time_ns() - sweep.arrived_ns) / _NS_PER_S,
                    num_skipped=self.num_skipped,
                    num_faults=self.num_faults,
                )

    def _compile_for(self, sweep: LiveSweep) -> Pipeline:
        capacity = fitting_capacity(math.ceil(HEADROOM * sweep.num_points))
        self._report(f"compiling for {capacity:,} points, once; later runs load it from the cache.")
        return Pipeline(self._config, capacity=capacity)

    def _check_size(self, sweep: LiveSweep, capacity: int) -> None:
        """Reports the first sweep that is too large."""
        if sweep.num_points > capacity and not self._told_too_large:
            self._told_too_large = True
            self._report(
                f"a sweep has {sweep.num_points:,} points, and the capacity is {capacity:,}: the farthest "
                f"are left out, of all such sweeps. Give --capacity {fitting_capacity(sweep.num_points)}."
            )
