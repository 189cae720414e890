"""Poses at times of their own, and those between them."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbox.geometry.rigid import interpolate_rigid

MAX_EXTRAPOLATION_S = 0.1
"""A sweep may lie this far outside of the poses' times: one period at 10 Hz."""
MAX_GAP_S = 1.0
"""Poses farther apart say too little of the motion between them."""
_NS_PER_S = 10**9


class UnusableSource(Exception):
    """A source of poses that is there, and cannot serve these sweeps; the message says why."""


@dataclasses.dataclass(frozen=True)
class PoseTrack:
    """A body's poses at some times."""

    times_ns: np.ndarray
    """(M,) int64, ns, ascending, M >= 1."""
    T_world_body: np.ndarray
    """(M, 4, 4) float64, m."""

    @classmethod
    def sorted(cls, times_ns: Sequence[int] | np.ndarray, T_world_body: np.ndarray) -> "PoseTrack":
        """Sorts poses by time; of several of one time the last is kept.

        Args:
          times_ns: (M,) ns.
          T_world_body: (M, 4, 4) float64, m.

        Returns:
          The track.
        """
        times = np.asarray(times_ns, np.int64)[::-1]
        distinct, index = np.unique(times, return_index=True)
        return cls(distinct, np.asarray(T_world_body, np.float64)[::-1][index])

    def at(self, times_ns: np.ndarray) -> np.ndarray:
        """Poses at other times: between two by slerp and lerp, up to `MAX_EXTRAPOLATION_S` beyond the ends.

        Args:
          times_ns: (F,) int64, ns.

        Returns:
          (F, 4, 4) float64, m.

        Raises:
          UnusableSource: for a time farther outside, or between poses more than `MAX_GAP_S` apart.

        >>> T = np.tile(np.eye(4), (2, 1, 1))
        >>> T[1, 0, 3] = 1
        >>> PoseTrack.sorted([0, 10**8], T).at(np.array([25 * 10**6]))[0, 0, 3].item()
        0.25
        """
        times, times_ns = self.times_ns, np.asarray(times_ns, np.int64)
        last = np.searchsorted(times, times_ns, side="right") - 1
        self._check(times_ns, last)
        if len(times) == 1:
            return np.tile(self.T_world_body, (len(times_ns), 1, 1))
        low = np.clip(last, 0, len(times) - 2)
        high = low + 1
        # Beyond the ends the motion of the last tenth of a second goes on: that of two poses is mostly noise.
        far = int(MAX_EXTRAPOLATION_S * _NS_PER_S)
        high[times_ns < times[0]] = min(np.searchsorted(times, times[0] + far), len(times) - 1)
        low[times_ns > times[-1]] = max(np.searchsorted(times, times[-1] - far, side="right") - 1, 0)
        share = (times_ns - times[low]) / (times[high] - times[low])
        return interpolate_rigid(self.T_world_body[low], self.T_world_body[high], share)

    def _check(self, times_ns: np.ndarray, last: np.ndarray) -> None:
        """Refuses times that no poses are near to; `last` is the last pose before each, -1 for none."""
        times = self.times_ns
        before, after = times[np.maximum(last, 0)], times[np.minimum(last + 1, len(times) - 1)]
        outside = np.maximum(times[0] - times_ns, times_ns - times[-1])
        limit = MAX_EXTRAPOLATION_S * _NS_PER_S if len(times) > 1 else 0
        if (outside > limit).any():
            worst = int(np.argmax(outside))
            raise UnusableSource(
                f"its poses are from {times[0] / _NS_PER_S:.3f} to {times[-1] / _NS_PER_S:.3f} s, and sweep "
                f"{worst} of {len(times_ns)} is at {times_ns[worst] / _NS_PER_S:.3f} s"
            )
        gap = np.where((times_ns > before) & (times_ns < after), after - before, 0)
        if (gap > MAX_GAP_S * _NS_PER_S).any():
            worst = int(np.argmax(gap))
            raise UnusableSource(
                f"it has no pose for {gap[worst] / _NS_PER_S:.2f} s round sweep {worst} of {len(times_ns)}"
            )
