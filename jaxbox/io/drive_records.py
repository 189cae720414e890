"""What the files of a drive say of each of its sweeps."""

from typing import Any

from jaxbox.io.jsonl import tracks_record
from jaxbox.run.tracking import TrackedSweep

_NS_PER_S = 10**9


class DriveRecords:
    """Makes the records of one drive's sweeps: numbers them, and takes their times from the first."""

    def __init__(self, sequence: str, *, min_score: float, confirmed: bool) -> None:
        """Begins a drive.

        Args:
          sequence: its name.
          min_score: as `jaxbox.io.tracks_record`.
          confirmed: as `jaxbox.io.tracks_record`.
        """
        self._sequence, self._min_score, self._confirmed = sequence, min_score, confirmed
        self._start_ns: int | None = None

    def record(self, index: int, tracked: TrackedSweep) -> dict[str, Any]:
        """The record of a sweep.

        Args:
          index: of the sweep among all of the drive, which numbers it where it has no frame.
          tracked: the sweep, which went through; later ones follow.

        Returns:
          As `jaxbox.io.tracks_record`.
        """
        frame = getattr(tracked.sweep, "frame", None)
        if self._start_ns is None:
            self._start_ns = tracked.time_ns
        return tracks_record(
            tracked,
            sequence=self._sequence,
            frame=index if frame is None else frame,
            time_s=(tracked.time_ns - self._start_ns) / _NS_PER_S,
            min_score=self._min_score,
            confirmed=self._confirmed,
        )
