"""What is known of a run: of each partition, which its own file carries too, and of the whole."""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any, Generic, Self, TypeVar


@dataclasses.dataclass(kw_only=True)
class PartitionReport:
    """One partition: what went in, what came out, and what went wrong."""

    name: str
    """Of its file, without the suffix."""
    key: str
    """Digest of its sweeps, and of settings and options: a file with another key belongs to another run."""
    num_sweeps: int
    """Sweeps that belong to it."""
    num_boxes: int = 0
    """Boxes in its file."""
    num_bytes: int = 0
    """Bytes of points that were read: of files as they lie there, of messages as decoded."""
    status: dict[str, int] = dataclasses.field(default_factory=dict)
    """`jaxbox.Status` bits of each sweep that is done, by its name."""
    failures: list[dict[str, str]] = dataclasses.field(default_factory=list)
    """Sweeps that are not: ``sweep``, ``url`` and ``reason``."""
    num_deaths: int = 0
    """Workers that died while they worked on it; it was begun again each time."""
    worker: str = ""
    """Node and process that finished it."""
    seconds: float = 0.0
    """From its first sweep to its file, without compiling."""
    detect_s: float = 0.0
    """Seconds of that in which the detector was waited for."""
    compile_s: float = 0.0
    """Seconds before that in which the worker compiled, or loaded from the cache."""
    peak_mb: float = 0.0
    """Most memory that its worker had resident until then."""
    error: str | None = None
    """Why there is no file; None where there is one."""

    @property
    def num_done(self) -> int:
        """Sweeps that are in its file, also those without boxes."""
        return len(self.status)

    def add_failure(self, sweep: str, url: str, reason: str) -> None:
        """Notes a sweep that did not go through."""
        self.failures.append({"sweep": sweep, "url": url, "reason": reason})

    def failed(self, reason: str) -> Self:
        """The report of a partition without a file."""
        return dataclasses.replace(self, status={}, num_boxes=0, error=reason)

    def to_json(self) -> str:
        """All fields as a JSON object."""
        return json.dumps(dataclasses.asdict(self), allow_nan=False)

    @classmethod
    def from_json(cls, text: str | bytes) -> Self:
        """What `to_json` wrote.

        Raises:
          ValueError: for another text.
        """
        fields = json.loads(text)
        try:
            return cls(**fields)
        except TypeError as error:
            raise ValueError(f"not the report of a partition: {error}") from error


@dataclasses.dataclass(kw_only=True)
class DriveReport(PartitionReport):
    """One drive that was tracked. The tracker's seconds are in ``seconds`` alone, those of compiling too."""

    pose_source: str = ""
    """Where its poses are from, in words."""
    notes: list[str] = dataclasses.field(default_factory=list)
    """Sentences on the poses: which were found, and why others were not used."""
    num_tracks: int = 0
    """Ids in its file; ``num_boxes`` are its rows."""
    track_status: dict[str, int] = dataclasses.field(default_factory=dict)
    """`jaxbox.TrackStatus` bits of each sweep that is done, by its name."""

    def failed(self, reason: str) -> Self:
        """The report of a drive without a file."""
        return dataclasses.replace(super().failed(reason), num_tracks=0, track_status={})


AnyReport = TypeVar("AnyReport", bound=PartitionReport)


@dataclasses.dataclass(kw_only=True)
class DatasetReport(Generic[AnyReport]):
    """A whole run."""

    partitions: list[AnyReport]
    """In the order of the sweeps; those that an earlier run finished among them."""
    num_skipped: int = 0
    """Partitions that an earlier run had finished."""
    num_done_before: int = 0
    """Sweeps that are done in those."""
    interrupted: bool = False
    """Whether it was ended before its last partition."""
    workers: int = 0
    """Workers that were asked for."""
    elapsed_s: float = 0.0
    """Seconds from listing to the last partition, with starting the workers and compiling."""

    @property
    def num_done(self) -> int:
        """Sweeps whose boxes are in the files."""
        return sum(part.num_done for part in self.partitions)

    @property
    def num_failed(self) -> int:
        """Sweeps without a result: also those of a lost partition, and behind where a recording breaks."""
        return sum(part.num_sweeps - part.num_done for part in self.partitions)

    @property
    def num_boxes(self) -> int:
        """Boxes in the files."""
        return sum(part.num_boxes for part in self.partitions)

    @property
    def failures(self) -> list[dict[str, str]]:
        """Sweeps without a result, and partitions without a file: ``sweep``, ``url`` and ``reason``."""
        lost = [
            {"sweep": part.name, "url": "", "reason": part.error} for part in self.partitions if part.error
        ]
        return [failure for part in self.partitions for failure in part.failures] + lost

    @property
    def deaths(self) -> dict[str, int]:
        """How many workers died on which partition."""
        return {part.name: part.num_deaths for part in self.partitions if part.num_deaths}

    def summary(self) -> Mapping[str, Any]:
        """The counts, as JSON can hold them."""
        return {
            "interrupted": self.interrupted,
            "num_partitions": len(self.partitions),
            "num_skipped": self.num_skipped,
            "num_done": self.num_done,
            "num_done_before": self.num_done_before,
            "num_failed": self.num_failed,
            "num_boxes": self.num_boxes,
            "workers": self.workers,
            "elapsed_s": round(self.elapsed_s, 3),
        }
