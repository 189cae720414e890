"""Mutation testing of the geometry: how many small errors, put in one at a time, do the tests notice?

    python -m quality.mutation [--modules hull box] [--sample 60] [--json FILE]
    python -m quality.mutation --again FILE    # only the mutants that survived then

Cosmic Ray (`pip install 'jaxbox[quality]'`) changes a sign, a number, a comparison or a condition in a copy
of the tracked files; the checkout is not touched. A mutant is killed where the fast tests of its module fail,
or take more than `MAX_CPU_S` of processor time; "timeout" is not a verdict. Most mutants compile what they
change again, so that one takes some seconds: a seeded sample is drawn of each module.
JAX_COMPILATION_CACHE_DIR keeps what they share.
"""

import argparse
import dataclasses
import json
import os
import pathlib
import random
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks import common

TESTS: Mapping[str, str] = {
    "jaxbox/geometry/planar.py": "tests/test_geometry.py",
    "jaxbox/evaluation/iou.py": "tests/test_evaluation_iou.py jaxbox/evaluation/iou.py",
    "jaxbox/geometry/projection.py": "tests/test_projection.py",
    "jaxbox/stages/descriptors.py": "tests/test_parity_boxes.py -k 'descriptors and not real'",
    "jaxbox/stages/hull.py": "tests/test_parity_boxes.py -k 'hull or extreme'",
    "jaxbox/stages/rectangles.py": (
        "tests/test_parity_boxes.py -k '(synthetic or direction) and not hull and not extreme'"
    ),
    "jaxbox/xla/arithmetic.py": "tests/test_xla_numbers.py",
    "jaxbox/xla/bits.py": "tests/test_xla_numbers.py -k bit",
    "jaxbox/xla/components.py": "tests/test_xla_structures.py -k component",
    "jaxbox/xla/hulls.py": "tests/test_xla_structures.py -k hull",
    "jaxbox/xla/loops.py": "tests/test_xla_loops.py",
    "jaxbox/xla/ragged.py": "tests/test_xla_structures.py -k point",
    "jaxbox/xla/range_bits.py": "tests/test_xla_structures.py -k 'covered or next_set or words_at'",
    "jaxbox/xla/rows.py": "tests/test_xla_rows.py",
    "jaxbox/xla/runs.py": "tests/test_xla_structures.py -k 'runs or kinds or maximum'",
    "jaxbox/xla/segments.py": "tests/test_xla_structures.py -k 'segment or keys'",
    "jaxbox/xla/sorting.py": "tests/test_xla_sorting.py",
    "jaxbox/xla/suppression.py": "tests/test_xla_structures.py -k conflicts",
}
"""The fast tests of each module, as arguments of pytest."""

MAX_CPU_S = 300
"""Processor time that the tests of a mutant may take, several times the slowest of these commands: beyond it
the mutant is in an endless loop, and counts as killed. A clock would kill the innocent on a busy machine."""

TIMEOUT_S = 3600.0
"""Where the clock says that the machine is too busy for a verdict."""

OPERATORS = (
    "NumberReplacer", "Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_Mul", "Pow_Mul",
    "LShift_RShift", "RShift_LShift", "BitAnd_BitOr", "BitOr_BitAnd", "Gt_GtE", "GtE_Gt", "Lt_LtE", "LtE_Lt",
    "Gt_Lt", "GtE_LtE", "Lt_Gt", "LtE_GtE", "Eq_NotEq", "NotEq_Eq", "USub_UAdd", "AddNot", "ReplaceAndWithOr",
    "ReplaceOrWithAnd", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ZeroIterationForLoop",
)  # fmt: skip
"""Those of Cosmic Ray's that are a likely slip. Left out: a power for a sum, a shift for a product and the
like, which any test notices, most because such types do not go together."""

SEED = 0
"""Of the sample."""


@dataclasses.dataclass(frozen=True)
class Mutant:
    """One changed place, and what the tests made of it."""

    module: str
    """Path of the changed file."""
    operator: str
    """Cosmic Ray's name for the change."""
    occurrence: int
    """Which of the operator's places in the file."""
    line: int
    """Of the changed place."""
    change: str
    """The lines taken out and put in, as a diff has them."""
    outcome: str
    """"killed", "survived", "timeout" or "incompetent"."""


def copy_checkout(folder: pathlib.Path) -> None:
    """Copies the tracked files, with what is changed in them."""
    listed = subprocess.run(
        ["git", "ls-files"], cwd=common.PROJECT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    for name in listed:
        source, target = common.PROJECT / name, folder / name
        if source.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target)


def write_config(module: str, path: pathlib.Path) -> None:
    """Cosmic Ray's settings for one module."""
    tests = f"{shlex.quote(sys.executable)} -m pytest -x -q --no-header {TESTS[module]}"
    command = f"bash -c {shlex.quote(f'ulimit -t {MAX_CPU_S}; exec {tests}')}"
    path.write_text(
        f"[cosmic-ray]\nmodule-path = {json.dumps(module)}\ntimeout = {TIMEOUT_S}\nexcluded-modules = []\n"
        f'test-command = {json.dumps(command)}\n[cosmic-ray.distributor]\nname = "local"\n',
        "utf-8",
    )
    tomllib.loads(path.read_text("utf-8"))


def cosmic_ray(*words: str, folder: pathlib.Path) -> None:
    """Runs one of its commands on the copy."""
    environment = os.environ | {"PYTHONPATH": str(folder)}
    command = [sys.executable, "-m", "cosmic_ray.cli", *words]
    subprocess.run(command, cwd=folder, env=environment, check=True)


def choose(session: pathlib.Path, sample: int | None, wanted: frozenset[tuple[str, int]] | None) -> int:
    """Marks what is not to be run as skipped.

    Returns:
      How many mutants the chosen operators have in all.
    """
    from cosmic_ray.work_db import WorkDB, use_db  # noqa: PLC0415  # pyright: ignore[reportMissingImports]
    from cosmic_ray.work_item import (  # noqa: PLC0415  # pyright: ignore[reportMissingImports]
        WorkerOutcome,
        WorkResult,
    )

    with use_db(str(session), WorkDB.Mode.open) as database:
        items = list(database.work_items)
        likely = [item for item in items if item.mutations[0].operator_name.endswith(OPERATORS)]
        chosen = likely
        if wanted is not None:
            places = {
                item.job_id: (item.mutations[0].operator_name, item.mutations[0].occurrence)
                for item in likely
            }
            chosen = [item for item in likely if places[item.job_id] in wanted]
        elif sample is not None:
            # Shuffled, then cut: a larger sample holds the smaller one.
            chosen = random.Random(SEED).sample(likely, len(likely))[:sample]
        kept = {item.job_id for item in chosen}
        skipped = [item.job_id for item in items if item.job_id not in kept]
        database.set_multiple_results(skipped, WorkResult(worker_outcome=WorkerOutcome.SKIPPED))
    return len(likely)


def read_results(module: str, session: pathlib.Path) -> list[Mutant]:
    """What became of the mutants that were run."""
    from cosmic_ray.work_db import WorkDB, use_db  # noqa: PLC0415  # pyright: ignore[reportMissingImports]

    with use_db(str(session), WorkDB.Mode.open) as database:
        completed = [(item.mutations[0], result) for item, result in database.completed_work_items]
    return [
        Mutant(
            module=module,
            operator=place.operator_name.removeprefix("core/"),
            occurrence=place.occurrence,
            line=place.start_pos[0],
            change=changed_lines(result.diff or ""),
            outcome="timeout" if result.output == "timeout" else result.test_outcome.value,
        )
        for place, result in completed
        if result.test_outcome is not None
    ]


def changed_lines(diff: str) -> str:
    """The lines of a unified diff that differ.

    >>> changed_lines("--- a\\n+++ b\\n same\\n-  x + y\\n+  x - y")
    '- x + y\\n+ x - y'
    """
    lines = [line for line in diff.splitlines() if line[:1] in ("-", "+") and line[:3] not in ("---", "+++")]
    return "\n".join(f"{line[0]} {line[1:].strip()}" for line in lines)


def test_module(
    module: str, folder: pathlib.Path, *, sample: int | None, wanted: frozenset[tuple[str, int]] | None
) -> tuple[list[Mutant], int]:
    """Runs one module's mutants; also says how many there are."""
    name = module.replace("/", "_")
    config, session = folder / f"{name}.toml", folder / f"{name}.sqlite"
    write_config(module, config)
    # Unchanged, the tests must pass, or every mutant would count as killed.
    cosmic_ray("baseline", str(config), folder=folder)
    cosmic_ray("init", str(config), str(session), folder=folder)
    available = choose(session, sample, wanted)
    cosmic_ray("exec", str(config), str(session), folder=folder)
    return read_results(module, session), available


def survivors_of(path: pathlib.Path) -> dict[str, frozenset[tuple[str, int]]]:
    """Mutants of an earlier report that survived, by module."""
    rows = json.loads(path.read_text("utf-8"))["survivors"]
    return {
        module: frozenset(
            ("core/" + row["operator"], row["occurrence"]) for row in rows if row["module"] == module
        )
        for module in sorted({row["module"] for row in rows})
    }


def earlier_report(path: pathlib.Path | None, modules: Sequence[str]) -> dict[str, Any]:
    """What an earlier report of that name says of the other modules, so that they can be run one by one."""
    if path is None or not path.is_file():
        return {"modules": {}, "survivors": []}
    report = json.loads(path.read_text("utf-8"))
    kept = {module: row for module, row in report["modules"].items() if module not in modules}
    return {"modules": kept, "survivors": [row for row in report["survivors"] if row["module"] in kept]}


def summarise(mutants: Sequence[Mutant], available: int) -> dict[str, int]:
    """Counts by outcome."""
    outcomes = [mutant.outcome for mutant in mutants]
    names = ("killed", "timeout", "incompetent", "survived")
    return {"mutants": available, "run": len(mutants)} | {name: outcomes.count(name) for name in names}


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the counts and the survivors, and writes the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    short = {pathlib.PurePath(module).stem: module for module in TESTS}
    parser.add_argument("--modules", nargs="+", choices=sorted(short), default=list(short))
    parser.add_argument("--sample", type=common.at_least(1), help="mutants of each module; all without")
    parser.add_argument(
        "--again", type=pathlib.Path, help="a report whose survivors are run again, and no others"
    )
    parser.add_argument("--json", type=pathlib.Path, help="also write the report to this file")
    options = parser.parse_args(arguments)
    again = None if options.again is None else survivors_of(options.again)
    modules = [short[name] for name in options.modules if again is None or short[name] in again]
    report = earlier_report(options.json, modules)
    for module in modules:
        wanted = None if again is None else again[module]
        with tempfile.TemporaryDirectory() as folder:
            copy_checkout(pathlib.Path(folder))
            mutants, available = test_module(
                module, pathlib.Path(folder), sample=options.sample, wanted=wanted
            )
        report["modules"][module] = summarise(mutants, available)
        survivors = [dataclasses.asdict(mutant) for mutant in mutants if mutant.outcome == "survived"]
        report["survivors"] += survivors
        print(module, report["modules"][module], flush=True)
        for row in survivors:
            print(f"  line {row['line']}, {row['operator']} {row['occurrence']}\n{row['change']}", flush=True)
        # After each module, so that what is done is kept where the rest is cut short.
        common.write_report(report, options)


if __name__ == "__main__":
    main()
