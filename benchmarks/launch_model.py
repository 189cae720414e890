"""What a GPU would be asked to do for a program, by its thunks, and how long that takes by a simple model."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from benchmarks.xla_dump import BRANCHES, GRAPH, LOOP, Thunk, key_of, walk

KERNEL_US = 3.0
"""Launch of a kernel by itself: the host takes as long to issue one after the other."""

NODE_US = 1.7
"""Start of a kernel as a node of a CUDA graph, after the one before it has ended."""

GRAPH_US = 8.0
"""Launch of a CUDA graph."""

WAIT_US = 14.0
"""The host's wait for the condition of a loop: a copy from the device, and the first launch after it."""

BYTES_PER_US = 2.5e6
"""Rate at which kernels read and write: three quarters of the 3.35 TB/s of an H100's memory."""

COPIES = re.compile("Copy|Memset|Memzero")
"""Kinds of thunks that copy or fill memory."""


@dataclasses.dataclass(frozen=True)
class Counts:
    """What is launched, moved and waited for; not whole where it is a mean over sweeps."""

    kernels: float = 0.0
    copies: float = 0.0
    in_graphs: float = 0.0
    """How many of the kernels and copies are nodes of CUDA graphs."""
    graphs: float = 0.0
    waits: float = 0.0
    """How often the host waits for a condition."""
    bytes_read: float = 0.0
    bytes_written: float = 0.0

    def __add__(self, other: "Counts") -> "Counts":
        pairs = zip(dataclasses.astuple(self), dataclasses.astuple(other), strict=True)
        return Counts(*(a + b for a, b in pairs))

    def __mul__(self, times: float) -> "Counts":
        return Counts(*(value * times for value in dataclasses.astuple(self)))

    @property
    def launches(self) -> float:
        """Kernels and copies."""
        return self.kernels + self.copies

    @property
    def model_ms(self) -> float:
        """Time by the model: a price for each launch and wait, one after the other, and a rate for bytes."""
        issue = (self.launches - self.in_graphs) * KERNEL_US + self.in_graphs * NODE_US
        issue += self.graphs * GRAPH_US + self.waits * WAIT_US
        return (issue + (self.bytes_read + self.bytes_written) / BYTES_PER_US) / 1e3


class Turns(NamedTuple):
    """Turns of a loop over all of its calls in a sweep, and how often it is called."""

    turns: float
    calls: float


class Loop(NamedTuple):
    """A loop of the program, and where the number of its turns is from."""

    step: str
    key: str
    turns: float
    """Each time that it is called."""
    source: str
    """The "compiler", "sweeps", or "unknown": then its body counts once."""


StepCounts = dict[str, Counts]
"""Counts by the step of the detector."""


def add(parts: Sequence[StepCounts]) -> StepCounts:
    """Counts of several parts of a program, step by step."""
    total: StepCounts = {}
    for part in parts:
        for step, counts in part.items():
            total[step] = total.get(step, Counts()) + counts
    return total


def scale(counts: StepCounts, times: float) -> StepCounts:
    """Counts of a part that runs several times."""
    return {step: value * times for step, value in counts.items()}


def total(counts: StepCounts) -> Counts:
    """Counts of all steps."""
    return sum(counts.values(), Counts())


def count(thunks: Sequence[Thunk], turns: Mapping[str, Turns], *, in_graph: bool = False) -> StepCounts:
    """What a sequence of thunks launches, moves and waits for.

    Args:
      thunks: as `xla_dump.read_program` gives them.
      turns: of loops by their keys, see `xla_dump.key_of`.
      in_graph: whether the sequence is in a CUDA graph.
    """
    return add([_count_one(thunk, turns, in_graph) for thunk in thunks])


def _count_one(thunk: Thunk, turns: Mapping[str, Turns], in_graph: bool) -> StepCounts:
    if thunk.kind == LOOP:
        return _count_loop(thunk, turns, in_graph)
    parts = [count(part, turns, in_graph=in_graph or thunk.kind == GRAPH) for part in thunk.parts.values()]
    if thunk.kind == BRANCHES:
        # Rare cases are the long branches: the short one is what a sweep usually takes.
        return add(
            [min(parts, key=lambda part: total(part).launches), {thunk.step: Counts(waits=not in_graph)}]
        )
    if thunk.kind == GRAPH:
        return add([*parts, {first_step(thunk): Counts(graphs=1)}])
    return add(parts) if parts else {thunk.step: _launch(thunk, in_graph)}


def _count_loop(thunk: Thunk, turns: Mapping[str, Turns], in_graph: bool) -> StepCounts:
    times = describe_loop(thunk, turns).turns
    body = scale(count(thunk.parts["body"], turns, in_graph=in_graph), times)
    if thunk.instruction.trip_count is not None:
        return body
    looks = add(
        [
            count(thunk.parts["condition"], turns, in_graph=in_graph),
            {thunk.step: Counts(waits=not in_graph)},
        ]
    )
    return add([body, scale(looks, times + 1)])


def _launch(thunk: Thunk, in_graph: bool) -> Counts:
    is_copy = COPIES.search(thunk.kind) is not None
    return Counts(
        kernels=not is_copy,
        copies=is_copy,
        in_graphs=in_graph,
        bytes_read=thunk.instruction.bytes_read,
        bytes_written=thunk.instruction.bytes_written,
    )


def first_step(thunk: Thunk) -> str:
    """The step of the first thing that a graph launches."""
    return next((inner.step for part in thunk.parts.values() for inner in walk(part)), "")


def describe_loop(thunk: Thunk, turns: Mapping[str, Turns]) -> Loop:
    """A loop's key and turns."""
    key = key_of(thunk.instruction.frames)
    if (known := thunk.instruction.trip_count) is not None:
        return Loop(thunk.step, key, known, "compiler")
    if (counted := turns.get(key)) is not None:
        return Loop(thunk.step, key, counted.turns / max(counted.calls, 1e-9), "sweeps")
    return Loop(thunk.step, key, 1.0, "unknown")


def list_loops(thunks: Sequence[Thunk], turns: Mapping[str, Turns]) -> list[Loop]:
    """All loops of a program."""
    return [describe_loop(thunk, turns) for thunk in walk(thunks) if thunk.kind == LOOP]


def heaviest(thunks: Sequence[Thunk], most: int) -> list[tuple[str, str, int, str]]:
    """The launches that move most bytes, each once: step, name, bytes, and where they stem from."""
    launches = [thunk for thunk in walk(thunks) if not thunk.parts]
    rows = [
        (
            thunk.step,
            thunk.name or thunk.kind,
            thunk.instruction.bytes_read + thunk.instruction.bytes_written,
            key_of(thunk.instruction.frames),
        )
        for thunk in launches
    ]
    return sorted(rows, key=lambda row: -row[2])[:most]
