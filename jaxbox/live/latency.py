"""How long sweeps took lately, as p50 and p99."""

import collections

import numpy as np

WINDOW = 3000
"""Sweeps that the figures are of: five minutes of most sensors."""


class Latencies:
    """The last latencies of a run, in a room of fixed size."""

    def __init__(self, window: int = WINDOW) -> None:
        """Begins without any.

        Args:
          window: how many are kept.
        """
        self._seconds: collections.deque[float] = collections.deque(maxlen=window)

    def __len__(self) -> int:
        """How many the figures are of."""
        return len(self._seconds)

    def add(self, seconds: float) -> None:
        """Adds one, s."""
        self._seconds.append(seconds)

    def quantiles_ms(self) -> tuple[float, float]:
        """The median and the 99th percentile, ms; NaN where there are none.

        >>> latencies = Latencies(window=3)
        >>> for seconds in (9.0, 0.01, 0.02, 0.03):
        ...     latencies.add(seconds)
        >>> latencies.quantiles_ms()
        (20.0, 29.8)
        """
        if not self._seconds:
            return float("nan"), float("nan")
        median, high = np.percentile(self._seconds, [50, 99]) * 1e3
        return round(float(median), 3), round(float(high), 3)
