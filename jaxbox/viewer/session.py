"""Detection for a page: one sweep and one set of settings at a time, timed, and its compiles counted."""

import dataclasses
import time
from typing import Any

import jax

from jaxbox.config import DetectorConfig
from jaxbox.run.compiled import count_compilations, detect
from jaxbox.types import Detections
from jaxbox.viewer.frames import Frame, Frames


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shown:
    """A sweep and what was found in it."""

    frame: Frame
    """The sweep."""
    config: DetectorConfig
    """The settings."""
    detections: Detections
    """The answer."""
    detect_s: float
    """Seconds in the detector, without compiling."""


class Session:
    """Sweeps and the detector, with a memory of the last frame and the last answer."""

    detects = True
    """Whether it reads, compiles and detects itself, and its times are of that."""

    def __init__(self, frames: Frames) -> None:
        self._frames = frames
        self._read: tuple[int, Frame] | None = None
        self._shown: Shown | None = None
        self._compiled: set[tuple[Any, int]] = set()
        self.num_compiles = 0
        """How often the detector was compiled, or loaded from the cache, for this session."""
        self.compile_s = 0.0
        """Seconds of that, in all."""

    def __len__(self) -> int:
        """How many sweeps there are."""
        return len(self._frames)

    def frame(self, index: int) -> Frame:
        """The sweep of a number, read where it is not the last one.

        Raises:
          InputError: where it cannot be read.
        """
        if self._read is None or self._read[0] != index:
            self._read = None
            self._read = index, self._frames.read(index)
        return self._read[1]

    def is_compiled(self, frame: Frame, config: DetectorConfig) -> bool:
        """Whether the detector of these settings' structure and this capacity has run before."""
        return _program(frame, config) in self._compiled

    def detect(self, frame: Frame, config: DetectorConfig) -> Shown:
        """Detects, where the last answer is not of this frame and these settings.

        Args:
          frame: the sweep.
          config: the settings; other thresholds than before compile nothing.

        Returns:
          The answer and its time.

        Raises:
          ValueError: for settings that contradict each other.
        """
        last = self._shown
        if last is None or last.frame is not frame or last.config != config:
            self._shown = self._detect(frame, config)
        assert self._shown is not None
        return self._shown

    def _detect(self, frame: Frame, config: DetectorConfig) -> Shown:
        before = count_compilations()
        detections, seconds = _timed(frame, config)
        if compiled := count_compilations() - before:
            first_s = seconds
            detections, seconds = _timed(frame, config)
            self.num_compiles += compiled
            self.compile_s += first_s - seconds
        self._compiled.add(_program(frame, config))
        return Shown(frame=frame, config=config, detections=detections, detect_s=seconds)


def _program(frame: Frame, config: DetectorConfig) -> tuple[Any, int]:
    """What decides which compiled function runs: static settings and capacity."""
    return jax.tree.structure(config), frame.cloud.capacity


def _timed(frame: Frame, config: DetectorConfig) -> tuple[Detections, float]:
    start = time.perf_counter()
    detections = jax.block_until_ready(detect(frame.cloud, config))
    return detections, time.perf_counter() - start
