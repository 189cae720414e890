"""Reads the instructions of a compiled module from XLA's text: what each moves, and where it stems from."""

import dataclasses
import functools
import math
import re
from collections.abc import Mapping
from typing import NamedTuple

from benchmarks.bench_stages import STEPS

TYPE_BYTES = {
    "pred": 1, "s8": 1, "u8": 1, "s16": 2, "u16": 2, "f16": 2, "bf16": 2, "s32": 4, "u32": 4, "f32": 4,
    "s64": 8, "u64": 8, "f64": 8, "c64": 8, "c128": 16,
}  # fmt: skip

SAME_BYTES = {"bitcast", "reshape", "get-tuple-element"}
"""Operations that move nothing."""

SLICES = {"slice", "dynamic-slice", "gather"}
"""Operations that read as much of their first operand as they return."""

LINE = re.compile(r" +(ROOT )?%([\w.\-]+) = (\(.*?\)|\S+) ([\w\-]+)\((.*?)\)(?:,|$)")
"""An instruction: whether it is its computation's result, name, shape, operation and operands."""


class Frame(NamedTuple):
    """A line of code in a stack."""

    file: str
    line: int
    function: str


class Line(NamedTuple):
    """An instruction as it is written."""

    name: str
    shape: str
    operation: str
    operands: tuple[str, ...]
    text: str

    @property
    def called(self) -> str:
        """The computation that a fusion calls."""
        found = re.search(r"calls=%([\w.\-]+)", self.text)
        return found[1] if found else ""

    @property
    def frame(self) -> int:
        """The number of its stack frame; 0 for none."""
        found = re.search(r"stack_frame_id=(\d+)", self.text)
        return int(found[1]) if found else 0

    @property
    def trip_count(self) -> int | None:
        """Turns of a loop, where the compiler knows them."""
        found = re.search(r'"known_trip_count":\{"n":"(\d+)"', self.text)
        return int(found[1]) if found else None


@dataclasses.dataclass(frozen=True)
class Instruction:
    """What is known of an instruction."""

    bytes_read: int = 0
    """Of its operands, what it reads: of what is sliced or gathered, as much as it takes."""
    bytes_written: int = 0
    """Of its results, what it writes: of what is updated in place, the updates."""
    frames: tuple[Frame, ...] = ()
    """Where it was traced, innermost first."""
    trip_count: int | None = None
    """Turns of a loop, where the compiler knows them."""


def step_of(frames: tuple[Frame, ...]) -> str:
    """The step of the detector that a stack is in; "" for none."""
    return next((frame.function for frame in frames if frame.function in STEPS), "")


def bytes_of(shape: str) -> int:
    """Size of an array or of a tuple of them, as XLA prints its shape: ``(f32[2,3]{1,0}, pred[])``."""
    found = re.findall(r"\b([a-z]\w*)\[([\d,]*)\]", shape)
    return sum(
        TYPE_BYTES.get(kind, 0) * math.prod(int(size) for size in dims.split(",") if size)
        for kind, dims in found
    )


class Computation:
    """The instructions of one computation, of a fusion's for example."""

    def __init__(self) -> None:
        self.lines: dict[str, Line] = {}
        self.parameters: dict[int, str] = {}
        self.root = ""

    def append(self, line: Line, *, is_root: bool) -> None:
        """Adds an instruction; those that it reads are there already."""
        self.lines[line.name] = line
        if line.operation == "parameter":
            self.parameters[int(line.operands[0])] = line.name
        if is_root:
            self.root = line.name

    @functools.cached_property
    def readers(self) -> dict[str, list[Line]]:
        """Who reads an instruction's result."""
        readers: dict[str, list[Line]] = {}
        for line in self.lines.values():
            for operand in dict.fromkeys(line.operands):
                readers.setdefault(operand, []).append(line)
        return readers

    def size(self, name: str) -> int:
        """Size of a result; 0 where the name is not an instruction of the computation."""
        return bytes_of(self.lines[name].shape) if name in self.lines else 0

    @functools.cached_property
    def needed(self) -> dict[str, float]:
        """Of each result, the share that is computed: of what is sliced or gathered, as much as is taken."""
        needed = dict.fromkeys(self.lines, 0.0)
        needed[self.root] = 1.0
        for line in reversed(self.lines.values()):
            for operand in dict.fromkeys(line.operands):
                if operand in self.lines:
                    share = needed[operand] + self._needs(line, operand, needed[line.name])
                    needed[operand] = min(share, 1.0)
        return needed

    def _needs(self, line: Line, name: str, share: float) -> float:
        """Share of an operand that an instruction takes for a share of its own result."""
        if line.operation in SLICES and name not in line.operands[1:]:
            return share * self.size(line.name) / max(self.size(name), 1)
        if line.operation == "broadcast":
            return min(share * self.size(line.name) / max(self.size(name), 1), 1.0)
        if line.operation in {"scatter", "dynamic-update-slice"}:
            return 1.0
        return share

    def read(self, name: str) -> int:
        """How much of a result, whole or in slices, is read within the computation."""
        parts = [self._read_by(line, name) for line in self.readers.get(name, [])]
        return int(min(sum(parts), self.size(name)))

    def _read_by(self, line: Line, name: str) -> float:
        if line.operation in SAME_BYTES:
            return self.read(line.name)
        if line.operation == "tuple":
            return 0  # A fusion that hands on what it was given writes it in place.
        if name in self._updated(line):
            # A scatter adds to what is there, or compares with it.
            return self._updates(line) if line.operation == "scatter" else 0
        return self._needs(line, name, self.needed[line.name]) * self.size(name)

    def written(self, name: str | None = None) -> int:
        """How much of a result, by default the computation's, has to be written."""
        line = self.lines[self.root if name is None else name]
        if line.operation == "tuple" or line.operation in SAME_BYTES - {"get-tuple-element"}:
            return sum(self.written(operand) for operand in line.operands)
        if line.operation == "parameter":
            return 0
        return self._updates(line) if self._updated(line) else self.size(line.name)

    def _updated(self, line: Line) -> tuple[str, ...]:
        """Operands that an instruction writes to in place."""
        if line.operation == "dynamic-update-slice":
            return line.operands[:1]
        return line.operands[: len(line.operands) // 2] if line.operation == "scatter" else ()

    def _updates(self, line: Line) -> int:
        """Size of what it writes there."""
        if line.operation == "scatter":
            return sum(self.size(operand) for operand in line.operands[len(line.operands) // 2 + 1 :])
        return self.size(line.operands[1])


def parse_computations(text: str) -> dict[str, Computation]:
    """The computations of a module by their names."""
    computations: dict[str, Computation] = {}
    current = Computation()
    for line in text.splitlines():
        if opened := re.match(r"(?:ENTRY )?%([\w.\-]+) \(.*\{$", line):
            current = computations.setdefault(opened[1], Computation())
        elif found := LINE.match(line):
            is_root, name, shape, operation, operands = found.groups()
            plain = [operands] if operation == "parameter" else re.findall(r"%([\w.\-]+)", operands)
            current.append(Line(name, shape, operation, tuple(plain), line), is_root=bool(is_root))
    return computations


def parse_instructions(text: str) -> dict[str, Instruction]:
    """The instructions of a compiled module by their names, see `Instruction`.

    A fusion that the compiler gave no stack frame has that of the last instruction in it that has one.
    """
    computations, stack_of = parse_computations(text), Stacks(text)

    def stack(line: Line) -> tuple[Frame, ...]:
        inner = computations.get(line.called, Computation()).lines.values()
        candidates = [line.frame, *(other.frame for other in reversed(inner))]
        stacks = (stack_of(number) for number in candidates if number)
        return next((frames for frames in stacks if step_of(frames)), stack_of(line.frame))

    def instruction(around: Computation, line: Line) -> Instruction:
        return Instruction(*_moved(around, line, computations), stack(line), line.trip_count)

    return {
        line.name: instruction(part, line) for part in computations.values() for line in part.lines.values()
    }


def _moved(around: Computation, line: Line, computations: Mapping[str, Computation]) -> tuple[int, int]:
    """Bytes that an instruction reads and writes."""
    fused = computations.get(line.called)
    if fused is not None and fused.root:
        return sum(fused.read(name) for name in fused.parameters.values()), fused.written()
    alone = Computation()
    for name in dict.fromkeys(line.operands):
        if name in around.lines:
            alone.lines[name] = around.lines[name]._replace(operation="parameter", operands=())
    alone.lines[line.name] = line
    alone.root = line.name
    return sum(alone.read(name) for name in alone.lines if name != line.name), alone.written()


class Stacks:
    """Stack frames by their numbers, from the four tables that XLA writes before a module's instructions."""

    def __init__(self, text: str) -> None:
        self.files = _table(text, "FileNames", r'"(.*)"')
        self.functions = _table(text, "FunctionNames", r'"(.*)"')
        self.places = _table(text, "FileLocations", r"{file_name_id=(\d+) function_name_id=(\d+) line=(\d+)")
        self.frames = _table(text, "StackFrames", r"{file_location_id=(\d+)(?: parent_frame_id=(\d+))?")

    def __call__(self, number: int) -> tuple[Frame, ...]:
        """The stack of a frame, innermost first."""
        stack = []
        while number in self.frames:
            place, parent = self.frames[number]
            file, function, line = (int(value) for value in self.places[int(place)])
            stack.append(Frame(self.files[file][0], line, self.functions[function][0]))
            number = int(parent) - 1 if parent else 0  # XLA writes one more than the frame's number.
        return tuple(stack)


def _table(text: str, title: str, pattern: str) -> Mapping[int, tuple[str, ...]]:
    block = re.search(rf"^{title}\n((?:\d.*\n)*)", text, re.MULTILINE)
    rows = re.findall(rf"^(\d+) {pattern}", block[1] if block else "", re.MULTILINE)
    return {int(number): tuple(values) for number, *values in rows}
