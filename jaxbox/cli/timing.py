"""The detector with a clock: compile time apart from run time."""

import time

import jax
import numpy as np

import jaxbox
from jaxbox.cli.memory import giving_memory_back
from jaxbox.config import DetectorConfig
from jaxbox.types import Detections, PointCloud


class TimedDetector:
    """Runs `jaxbox.detect` and times it; the first sweep of each capacity waits for the compiler."""

    def __init__(self, config: DetectorConfig) -> None:
        self._config = config
        self.compile_s: dict[int, float] = {}
        """Seconds that each capacity took to compile, or to load from the cache."""

    def __call__(self, cloud: PointCloud) -> tuple[Detections, float]:
        """Detects, and returns the detections and the seconds of the run alone."""
        if cloud.capacity not in self.compile_s:
            self.compile_s[cloud.capacity] = self._compile(cloud.capacity)
        return self._run(cloud)

    def _compile(self, capacity: int) -> float:
        """Seconds of a first call on an empty sweep; a second one is taken off, as it is not compiling."""
        start = time.perf_counter()
        empty = PointCloud.from_numpy(np.zeros((0, 3), np.float32), capacity=capacity)
        with giving_memory_back():
            self._run(empty)
        _, again_s = self._run(empty)
        return time.perf_counter() - start - 2 * again_s

    def _run(self, cloud: PointCloud) -> tuple[Detections, float]:
        start = time.perf_counter()
        detections = jax.block_until_ready(jaxbox.detect(cloud, self._config))
        return detections, time.perf_counter() - start
