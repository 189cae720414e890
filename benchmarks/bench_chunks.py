"""Times each chunk size of `jaxbox.xla.chunks` against its half and its double, in the step that uses it.

    python -m benchmarks.bench_chunks [SIZE ...] [--quick] [--json FILE]

The programs of the three sizes take turns on real sweeps. A size stays where neither other one is faster by
more than the runs of one program differ. Sizes that cannot be halved or doubled, or that only an accelerator
uses, are listed with what chose them.
"""

import argparse
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks import bench_stages, common
from jaxbox import DetectorConfig, PointCloud
from jaxbox.xla import chunks

SWEEPS, QUICK_SWEEPS = 12, 3
"""Different sweeps that each program is timed on."""

PASSES, QUICK_PASSES = 10, 3
"""Times that each sweep is run; the least counts."""

FACTORS = 0.5, 1, 2


class Use(NamedTuple):
    """Where a size matters most."""

    step: str
    """of `bench_stages.STEPS`."""
    preset: str = "default"
    """that uses the size."""


USES = {
    "FILTER_BLOCKS": Use("select_points"),
    "FILTER_BLOCK_CELLS": Use("select_points"),
    "MINIMA_TABLES": Use("remove_ground"),
    "PLANES": Use("remove_ground"),
    "MAP_POINTS": Use("propose_clusters"),
    "STATISTICS_MAPS": Use("propose_clusters"),
    "HULL_POINTS": Use("fit_rectangles", "paper"),
    "HULLS": Use("fit_rectangles", "paper"),
    "ROTATIONS": Use("fit_rectangles"),
    "FOLDED_POINTS": Use("fit_rectangles"),
    "PAIRS": Use("complete_boxes"),
    "VOTES": Use("complete_boxes"),
    "PROPOSALS": Use("complete_boxes"),
    "RAYS": Use("complete_boxes"),
    "BOXES": Use("score_boxes"),
    "RUN_BLOCKS": Use("score_boxes"),
    "RANKS": Use("score_boxes"),
    "OWNERS": Use("assemble"),
}
"""The step that each size is timed in."""

FIXED = {
    "RUN_ROWS": "the most that a count of 6 bits holds, of which five fit a word",
    "UNROLLED": "the largest divisor of a size up to four: python -m benchmarks.bench_stages",
    "SINGLE_KERNEL_NUMBERS": "the limit of XLA: pytest -m codegen tests/test_xla_loops.py",
    "RUN_BLOCKS_ON_ACCELERATOR": "python -m benchmarks.bench_launches: launches of score_boxes",
    "SUM_BLOCK": "python -m benchmarks.bench_launches: launches of gather_obstacles",
    "MAX_TABLES": "the profile of an H200: docs/notes/accelerators.md",
    "TABLE_NUMBERS": "the profile of an H200: docs/notes/accelerators.md",
}
"""What chose the others."""


def record_inputs(
    clouds: Sequence[PointCloud], config: DetectorConfig, wanted: str
) -> tuple[Callable[..., Any], list[tuple[Any, ...]]]:
    """The function of a step, and what it is called with for each sweep."""
    programs: dict[str, Callable[..., Any]] = {}
    found: list[tuple[Any, ...]] = []
    steps: list[Callable[..., Any]] = []

    def run(step: Callable[..., Any], *inputs: Any) -> Any:
        if step.__name__ == wanted:
            steps.append(step)
            found.append(inputs)
        return programs.setdefault(step.__name__, jax.jit(step))(*inputs)

    for cloud in clouds:
        bench_stages.run_steps(cloud, config, run)
    return steps[0], found


def compile_with(
    name: str, size: int, step: Callable[..., Any], inputs: tuple[Any, ...]
) -> Callable[..., Any]:
    """The program of a step with another chunk size."""
    before = getattr(chunks, name)
    setattr(chunks, name, size)
    try:
        # A function of its own: JAX would hand out what it has traced of the same one.
        return jax.jit(functools.partial(step)).lower(*inputs).compile()
    finally:
        setattr(chunks, name, before)


def time_sizes(
    name: str, step: Callable[..., Any], inputs: Sequence[tuple[Any, ...]], passes: int
) -> dict[int, float]:
    """Milliseconds of the step with half the size, the size and its double: means of each sweep's least."""
    sizes = [max(int(factor * getattr(chunks, name)), 1) for factor in FACTORS]
    programs = [compile_with(name, size, step, inputs[0]) for size in sizes]
    spent_ms = np.full((passes, len(inputs), len(sizes)), np.inf)
    for i in range(passes):
        for j, of_sweep in enumerate(inputs):
            for k in np.roll(np.arange(len(sizes)), i + j):
                spent_ms[i, j, k], _ = common.milliseconds(functools.partial(programs[k], *of_sweep))
    return dict(zip(sizes, spent_ms.min(axis=0).mean(axis=0).tolist(), strict=True))


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table and writes the report."""
    parser = common.parser(__doc__ or "", preset=False, quick="fewer sweeps and passes")
    parser.add_argument("sizes", nargs="*", metavar="SIZE", help="names such as RAYS; all by default")
    options: argparse.Namespace = parser.parse_args(arguments)
    unknown = set(options.sizes) - set(USES)
    if unknown:
        raise SystemExit(f"{', '.join(sorted(unknown))}: choose from {', '.join(USES)}.")
    common.enable_cache()
    sweeps = common.kitti_sweeps(QUICK_SWEEPS if options.quick else SWEEPS)
    clouds = [jax.device_put(PointCloud.from_numpy(*sweep.read_points())) for sweep in sweeps]
    inputs: dict[Use, Any] = {}
    found = {}
    for name in options.sizes or USES:
        use = USES[name]
        if use not in inputs:
            config = jax.tree.map(float, DetectorConfig.presets()[use.preset])
            inputs[use] = record_inputs(clouds, config, use.step)
        found[name] = time_sizes(name, *inputs[use], passes=QUICK_PASSES if options.quick else PASSES)
    rows = [
        (name, USES[name].step, USES[name].preset, getattr(chunks, name), *times.values())
        for name, times in found.items()
    ]
    common.print_table(["size", "step", "preset", "now", "half ms", "now ms", "double ms"], rows)
    for name, reason in FIXED.items():
        print(f"{name} {getattr(chunks, name)}: {reason}")
    common.write_report({"milliseconds": found, "fixed": FIXED}, options)


if __name__ == "__main__":
    main()
