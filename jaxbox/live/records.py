"""What is said of each sweep of a live run: its record, and the trails of its tracks."""

from typing import Any

import numpy as np

from jaxbox import io
from jaxbox.io.drive_records import DriveRecords
from jaxbox.io.results import SweepResult
from jaxbox.live.loop import LiveResult
from jaxbox.run.tracking import TrackedSweep
from jaxbox.tracking.trails import Trails


class LiveRecords:
    """Makes what the sinks take of each result, in their order."""

    def __init__(self, name: str, *, min_score: float = 0.0, confirmed: bool = False) -> None:
        """Begins a run.

        Args:
          name: of the source.
          min_score: boxes that score less are left out.
          confirmed: whether tracks that are not confirmed are.
        """
        self._min_score = min_score
        self._records = DriveRecords(name, min_score=min_score, confirmed=confirmed)
        self._trails = Trails()

    def result(self, live: LiveResult) -> SweepResult:
        """The record, points and trails of the next sweep.

        Args:
          live: the sweep.

        Returns:
          The record is that of `jaxbox.io.tracks_record`, or `jaxbox.io.detections_record` without tracks,
          with ``num_points``, ``latency_ms`` and, of the source so far, ``num_skipped`` and ``num_faults``.
        """
        found, trails = live.found, None
        if isinstance(found, TrackedSweep):
            record = self._records.record(live.sweep.frame, found)
            assert found.tracks is not None
            assert found.T_world_sensor is not None
            trails = self._trails.add(found.tracks, found.T_world_sensor, record["time_s"])
        else:
            assert found.detections is not None
            record = io.detections_record(
                found.name,
                found.detections,
                min_score=self._min_score,
                timestamp_ns=live.sweep.timestamp_ns,
            )
        xyz, intensity = live.sweep.read_points()
        return SweepResult(
            record=record | _run_of(live), xyz=np.asarray(xyz), intensity=intensity, trails=trails
        )


def _run_of(live: LiveResult) -> dict[str, Any]:
    return {
        "num_points": live.sweep.num_points,
        "latency_ms": round(1e3 * live.latency_s, 3),
        "num_skipped": live.num_skipped,
        "num_faults": live.num_faults,
    }
