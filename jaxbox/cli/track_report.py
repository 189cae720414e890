"""What `jaxbox track` says of a sequence and of a run."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from jaxbox.run.tracking import TrackedSweep
from jaxbox.tracking.tracks import TrackStatus
from jaxbox.types import Status

_EXPECTED = TrackStatus.POSE_FROM_BOXES | TrackStatus.POSE_UNKNOWN
"""Bits of every sweep of a sequence without poses."""


@dataclasses.dataclass
class SequenceReport:
    """One sequence, while it is tracked and after it."""

    name: str
    """Of the sequence."""
    pose_source: str = ""
    """Where the poses are from, in words."""
    num_done: int = 0
    """Sweeps that went through."""
    failures: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    """Name and reason of sweeps that did not, and of the recording where it broke off."""
    vehicles: set[int] = dataclasses.field(default_factory=set)
    """Ids of confirmed tracks."""
    movers: set[int] = dataclasses.field(default_factory=set)
    """Ids of those that moved in some sweep."""
    lane_changes: set[int] = dataclasses.field(default_factory=set)
    """Ids of those that changed lanes."""
    bits: dict[str, tuple[Status | TrackStatus, int, str]] = dataclasses.field(default_factory=dict)
    """For each status bit that occurred, by name, as bits of the two kinds have the same values: the bit, in
    how many sweeps, and the name of the first."""
    interrupted: bool = False
    """Whether it was ended before its last sweep."""
    has_camera: bool = True
    """Whether KITTI text was written, where it was asked for; else JSON Lines were, in its place."""
    is_complete: bool = False
    """Whether every sweep went through, and all files are whole."""

    def add(self, tracked: TrackedSweep, record: Mapping[str, Any], *, min_score: float) -> None:
        """Takes in a sweep that went through; vehicles of lower scores are not counted."""
        assert tracked.detections is not None
        self.num_done += 1
        self.pose_source = str(tracked.pose_source)
        for box in record["boxes"]:
            # A guess about a hidden vehicle says neither that it is there nor that it moves.
            if box["confirmed"] and box["score"] >= min_score and box["detection"] >= 0:
                self.vehicles.add(box["id"])
                self.movers |= {box["id"]} if box["state"] != "standing" else set()
                self.lane_changes |= {box["id"]} if box["state"] == "lane change" else set()
        for bit in (*Status(int(tracked.detections.status)), *tracked.status):
            name = str(bit.name)
            _, count, first = self.bits.get(name, (bit, 0, tracked.name))
            self.bits[name] = bit, count + 1, first

    def to_json(self) -> dict[str, Any]:
        """What the account and scripts are told."""
        return {
            "sequence": self.name,
            "done": self.num_done,
            "complete": self.is_complete,
            "pose_source": self.pose_source,
            "vehicles": len(self.vehicles),
            "moved": len(self.movers),
            "lane_changes": len(self.lane_changes),
            "status": {name: count for name, (_, count, _) in self.bits.items()},
        }

    def describe(self) -> str:
        """One sentence."""
        changes = f", {len(self.lane_changes)} changed lanes" if self.lane_changes else ""
        poses = f"; poses: {self.pose_source}" if self.pose_source else ""
        return (
            f"{self.name}: {self.num_done} sweeps, {len(self.vehicles)} vehicles, {len(self.movers)} of them "
            f"moved{changes}{poses}"
        )

    def warnings(self) -> list[str]:
        """A sentence for each bit: what happened, in how many sweeps, and in which first."""
        sentences = []
        for bit, count, first in self.bits.values():
            where = f"{self.name}: {count} of {self.num_done} sweeps"
            is_expected = isinstance(bit, TrackStatus) and bit in _EXPECTED
            where += "" if is_expected else f", {first} first"
            sentences.append(f"{where}: {bit.describe()[0]}")
        return sentences


@dataclasses.dataclass
class TrackReport:
    """All sequences of a run."""

    sequences: list[SequenceReport] = dataclasses.field(default_factory=list)
    """Those that were begun."""
    num_skipped: int = 0
    """Sweeps of sequences that an earlier run had finished."""

    @property
    def interrupted(self) -> bool:
        """Whether the run was ended before its last sweep."""
        return any(sequence.interrupted for sequence in self.sequences)

    @property
    def failures(self) -> list[tuple[str, str]]:
        """Name and reason of everything that failed."""
        return [failure for sequence in self.sequences for failure in sequence.failures]

    @property
    def num_done(self) -> int:
        """Sweeps that went through."""
        return sum(sequence.num_done for sequence in self.sequences)

    def describe(self, elapsed_s: float) -> list[str]:
        """The end of the run in sentences."""
        skipped = f", {self.num_skipped} done before" if self.num_skipped else ""
        rate = self.num_done / max(elapsed_s, 1e-9)
        return [
            f"{self.num_done} sweeps done, {len(self.failures)} failed{skipped}; took {elapsed_s:.1f} s, "
            f"{rate:.1f} sweeps a second",
            *(f"failed: {name}: {reason}" for name, reason in self.failures),
        ]
