"""Reads XLA's dump of a program compiled for a GPU: what the host launches, and where it stems from.

XLA calls one thing that the host launches a thunk. Three of the files it dumps are read: the tree of thunks,
the instruction that each stems from, and the instructions themselves, see `hlo_text`.
"""

import dataclasses
import pathlib
import re
from collections.abc import Iterator, Sequence

from benchmarks.bench_stages import STEPS
from benchmarks.hlo_text import Frame, Instruction, parse_instructions, step_of

GRAPH, LOOP, BRANCHES = "kCommandBuffer", "kWhile", "kConditional"
"""Thunks of interest that hold others: a CUDA graph, a loop, and a conditional."""

INDENT = 4
"""Spaces by which XLA indents what a thunk holds."""

SUFFIXES = ("thunk_sequence_after_thunk_passes.txt", "thunk_metadata.txt", "*gpu_after_optimizations.txt")
"""How the names of the three files end, after the name of the program."""


NOTHING = Instruction()
"""Where a thunk stems from no instruction that is known."""


@dataclasses.dataclass
class Thunk:
    """One thing that the host launches, or that holds others."""

    kind: str
    number: int = -1
    name: str = ""
    instruction: Instruction = NOTHING
    step: str = ""
    """The step of the detector that it belongs to."""
    parts: dict[str, list["Thunk"]] = dataclasses.field(default_factory=dict)
    """What it holds: a loop its "condition" and "body", a conditional its branches, all else under ""."""


def read_program(folder: pathlib.Path, program: str) -> list[Thunk]:
    """The thunks of a program in the order of their launch; ends the program where the dump is another."""
    texts = []
    for suffix in SUFFIXES:
        files = sorted(folder.glob(f"*.jit_{program}.{suffix}"))
        if len(files) != 1:
            raise SystemExit(
                f"{folder}: {len(files)} files jit_{program}.{suffix}, not one: this XLA dumps otherwise."
            )
        texts.append(files[0].read_text())
    return parse_program(*texts)


def parse_program(tree: str, metadata: str, hlo: str) -> list[Thunk]:
    """The thunks, with their instructions and steps, by the texts of the three files."""
    thunks, names, instructions = parse_thunks(tree), parse_names(metadata), parse_instructions(hlo)
    last = ""
    for thunk in walk(thunks):
        if thunk.kind == GRAPH:  # It stems from no instruction; in loops, its number is another thunk's.
            continue
        thunk.name = names.get(thunk.number, "")
        thunk.instruction = instructions.get(thunk.name, NOTHING)
        # What the compiler made up itself, such as a copy, goes with what is launched before it.
        thunk.step = last = step_of(thunk.instruction.frames) or last
    return thunks


def walk(thunks: Sequence[Thunk]) -> Iterator[Thunk]:
    """All thunks, each before those that it holds."""
    for thunk in thunks:
        yield thunk
        for part in thunk.parts.values():
            yield from walk(part)


def key_of(frames: Sequence[Frame]) -> str:
    """What tells a loop from the others: the lines from where it stands up to the step."""
    lines = []
    for frame in frames:
        if frame.function in STEPS:
            return " < ".join([*lines, frame.function])
        lines.append(f"{pathlib.PurePath(frame.file).name}:{frame.line}")
    return " < ".join(lines)


def parse_thunks(text: str) -> list[Thunk]:
    """The tree of thunks, which XLA prints by indentation; names and instructions are still missing."""
    root = Thunk("kSequential")
    open_thunks, sections = [(-1, root)], {id(root): ""}
    for line in text.splitlines():
        if found := re.match(r"( *)(\d+): (k\w+)", line):
            depth = len(found[1]) // INDENT
            while open_thunks[-1][0] >= depth:
                open_thunks.pop()
            thunk, parent = Thunk(found[3], int(found[2])), open_thunks[-1][1]
            parent.parts.setdefault(sections.get(id(parent), ""), []).append(thunk)
            open_thunks.append((depth, thunk))
            continue
        # One line may end a section that has no thunks and start the next one.
        for mark in re.finditer(r"( *)(condition|body|\w*branch\w*):", line):
            owner = _owner(open_thunks, mark[2], len(mark[1]) // INDENT)
            sections[id(owner)] = mark[2]
            owner.parts.setdefault(mark[2], [])
    return root.parts.get("", [])


def _owner(open_thunks: Sequence[tuple[int, Thunk]], section: str, depth: int) -> Thunk:
    """The loop or conditional of a section: conditions are not indented, all else is by half a step."""
    kind = BRANCHES if "branch" in section else LOOP
    return next(
        thunk
        for at, thunk in reversed(open_thunks)
        if thunk.kind == kind and (section == "condition" or at <= depth)
    )


def parse_names(text: str) -> dict[int, str]:
    """Names of instructions by the numbers of their thunks."""
    names = {}
    for block in text.split("thunk_metadata {")[1:]:
        name, number = (
            re.search(r'profile_annotation: "([^"]*)"', block),
            re.search(r"thunk_id: (\d+)", block),
        )
        if name and number:
            names[int(number[1])] = name[1]
    return names
