"""Counts what a GPU would be asked to do for a sweep, or a batch of them, without a GPU.

    python -m benchmarks.bench_launches [--preset fast] [--batch 64] [--json FILE] [--fail-above 460]

XLA compiles `jaxbox.detect` ahead of time for an H100 that is not there. What the host would launch is
counted by step of the detector: kernels and copies, how many of them in CUDA graphs, how often the host waits
for the condition of a loop, and the bytes that kernels read and write. Turns of loops that depend on data are
counted on real sweeps, by running the same program on the CPU; in a batch a loop turns as long as it does for
any sweep.

The time is that of a simple model, see `launch_model`, and no measurement. Without a device XLA does not
choose its library for sorting: some kernels are of its stand-in, which moves several times the bytes.

It takes XLA's compiler for NVIDIA GPUs, without a driver or CUDA, of the version of jax:

    pip install jax-cuda12-pjrt==VERSION jax-cuda12-plugin==VERSION nvidia-cuda-nvcc-cu12
"""

import argparse
import dataclasses
import pathlib
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any

import jax

from benchmarks import common, compile_ahead, launch_model, loop_turns, xla_dump
from benchmarks.bench_stages import STEPS
from benchmarks.launch_model import Counts, Loop, Turns
from jaxbox import DetectorConfig, PointCloud

SWEEPS = 6
"""Real sweeps that turns of loops are counted on."""

CAPACITY = 131072
"""Points of a KITTI sweep's capacity."""

HEAVIEST = 20
"""Kernels that are listed by their bytes."""

HEADER = ("kernels", "copies", "in graphs", "graphs", "waits", "MB read", "MB written", "model ms")


def figures(counts: Counts) -> dict[str, float]:
    """What is reported of a step or of the whole."""
    return dataclasses.asdict(counts) | {"launches": counts.launches, "model_ms": counts.model_ms}


def row(name: str, counts: Counts) -> list[object]:
    """A line of the table."""
    launched = (counts.kernels, counts.copies, counts.in_graphs, counts.graphs, counts.waits)
    moved = (counts.bytes_read / 1e6, counts.bytes_written / 1e6)
    return [name, *(round(value, 1) for value in launched), *moved, counts.model_ms]


def in_order(counts: Mapping[str, Counts]) -> dict[str, Counts]:
    """By the order of the steps; what belongs to none comes first."""
    return {step or "other": counts[step] for step in ("", *STEPS) if step in counts}


def report_of(thunks: Sequence[xla_dump.Thunk], turns: Mapping[str, Turns], sweeps: int) -> dict[str, Any]:
    """All figures of a program; a batch's are also given by the sweep."""
    counts = launch_model.count(thunks, turns)
    whole = launch_model.total(counts)
    columns = ("step", "name", "bytes", "lines")
    return {
        "whole": figures(whole),
        "model_ms_a_sweep": whole.model_ms / sweeps,
        "steps": {step: figures(value) for step, value in in_order(counts).items()},
        "loops": [loop._asdict() for loop in launch_model.list_loops(thunks, turns)],
        "heaviest": [
            dict(zip(columns, launch, strict=True)) for launch in launch_model.heaviest(thunks, HEAVIEST)
        ],
    }


def count_turns(options: argparse.Namespace, config: DetectorConfig) -> dict[str, Turns]:
    """Turns of loops on real sweeps, by the program for an accelerator."""
    sweeps = common.kitti_sweeps(options.sweeps)[: options.sweeps] if options.sweeps else []
    clouds = [PointCloud.from_numpy(*sweep.read_points(), capacity=CAPACITY) for sweep in sweeps]
    return loop_turns.turns_of_sweeps(clouds, config, together=bool(options.batch))


def show(report: Mapping[str, Any], batch: int) -> None:
    """Prints the tables."""
    names = [field.name for field in dataclasses.fields(Counts)]

    def counts(values: Mapping[str, float]) -> Counts:
        return Counts(*(values[name] for name in names))

    steps = {**report["steps"], "all": report["whole"]}
    common.print_table(["", *HEADER], [row(step, counts(values)) for step, values in steps.items()])
    if batch:
        print(f"\n{batch} sweeps: {report['model_ms_a_sweep']:.3f} ms a sweep by the model")
    if report["loops"]:
        print()
        common.print_table(["loop", *Loop._fields[2:]], [list(loop.values())[1:] for loop in report["loops"]])


def fail_above(launches: float, most: float | None) -> None:
    """Ends the program with status 1 where there are more launches than wanted."""
    if most is not None and launches > most:
        raise SystemExit(f"{launches:.0f} kernels and copies, more than {most:.0f}.")


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the tables and writes the report."""
    parser = common.parser(__doc__ or "")
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "--batch", type=common.at_least(0), default=0, help="sweeps of a jax.vmap; by default a single sweep"
    )
    parser.add_argument(
        "--sweeps",
        type=common.at_least(0),
        default=SWEEPS,
        help="real sweeps that turns are counted on; 0: loops count once",
    )
    parser.add_argument(
        "--dump", type=pathlib.Path, help="keep XLA's dump in this folder, which is to be empty"
    )
    parser.add_argument("--fail-above", type=float, metavar="N", help="status 1 above N kernels and copies")
    options = parser.parse_args(arguments)
    compile_ahead.require_compiler()
    compile_ahead.prepare()
    config = jax.tree.map(float, common.chosen_config(options))
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.dump or pathlib.Path(temporary)
        built = compile_ahead.compile_for_gpu(config, folder, batch=options.batch, capacity=CAPACITY)
        thunks = xla_dump.read_program(folder, compile_ahead.PROGRAM)
    report = report_of(thunks, count_turns(options, config), options.batch or 1)
    show(report, options.batch)
    common.write_report({"target": compile_ahead.TARGET, "built": built, **report}, options)
    fail_above(report["whole"]["launches"], options.fail_above)


if __name__ == "__main__":
    main()
