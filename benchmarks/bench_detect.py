"""Times detect() on real sweeps, whole and step by step, beside the NumPy reference in the same run.

    python -m benchmarks.bench_detect [--preset paper] [--quick] [--json FILE]

Compile time is apart. Each sweep is on the device before the clock starts, and the clock stops when the
result is ready. Every pass goes over different sweeps; the reference, which takes seconds a sweep, is
interleaved with them over the first few. A step is timed as a compiled function of its own, so the steps
need not add up to the whole, which fuses across them.
"""

import argparse
import functools
import itertools
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

import jaxbox
from benchmarks import common
from jaxbox import DetectorConfig, PointCloud, reference, steps
from jaxbox.io import open_sweeps

PASSES, QUICK_PASSES = 5, 2
"""Times that each sweep is run."""

REFERENCE_SWEEPS, QUICK_REFERENCE_SWEEPS = 5, 1
"""Sweeps that the reference runs on."""

MIN_RUNS = 30
"""Runs that a median is taken over, at the least."""


def milliseconds(function: Callable[[], Any]) -> tuple[float, Any]:
    """Time of one call, until its result is ready, and the result."""
    start = time.perf_counter()
    result = jax.block_until_ready(function())
    return 1e3 * (time.perf_counter() - start), result


def time_whole(
    clouds: Sequence[PointCloud], xyz: Sequence[np.ndarray], config: DetectorConfig, quick: bool
) -> dict[str, Any]:
    """Whole sweeps through detect(), with the reference in between."""
    compile_ms, _ = milliseconds(lambda: jaxbox.detect(clouds[0], config))
    num_reference = QUICK_REFERENCE_SWEEPS if quick else REFERENCE_SWEEPS
    ours, theirs, statuses = [], [], []
    for turn in range(QUICK_PASSES if quick else PASSES):
        for i, cloud in enumerate(clouds):
            spent, found = milliseconds(functools.partial(jaxbox.detect, cloud, config))
            ours.append(spent)
            statuses.append(int(found.status))
            if turn == 0 and i < num_reference:
                theirs.append(milliseconds(functools.partial(reference.detect, xyz[i], config))[0])
    if len(ours) < MIN_RUNS:
        raise SystemExit(f"{len(ours)} runs are too few for a median; at least {MIN_RUNS} are needed.")
    return {
        "first_call_ms": compile_ms,
        "detect": spread(ours),
        "reference": spread(theirs),
        "times_faster": float(np.median(theirs) / np.median(ours)),
        "status": common.status_names(statuses),
    }


def time_steps(clouds: Sequence[PointCloud], config: DetectorConfig) -> dict[str, Any]:
    """Each step of detect() by itself, on what the steps before it found."""
    names = (
        "select_points", "remove_ground", "gather_obstacles", "propose_clusters", "fit_rectangles",
        "build_evidence", "complete_boxes", "score_boxes", "conclude",
    )  # fmt: skip
    compiled = {name: jax.jit(getattr(steps, name)) for name in names}
    spent: dict[str, list[float]] = {name: [] for name in names}

    def run(name: str, *inputs: Any) -> Any:
        jax.block_until_ready(compiled[name](*inputs))
        ms, result = milliseconds(functools.partial(compiled[name], *inputs))
        spent[name].append(ms)
        return result

    for cloud in itertools.islice(itertools.cycle(clouds), max(MIN_RUNS, len(clouds))):
        sweep = run("select_points", cloud, config)
        heights = run("remove_ground", sweep, config, jax.random.key(0))
        obstacles = run("gather_obstacles", sweep, heights, config)
        proposals = run("propose_clusters", obstacles, config)
        fits = run("fit_rectangles", obstacles, proposals, config)
        seen = run("build_evidence", sweep, heights, config)
        trials, boxes = run("complete_boxes", fits, proposals, seen, config)
        candidates = run("score_boxes", trials, boxes, proposals, obstacles, heights, seen, config)
        run("conclude", cloud, sweep, heights, obstacles, proposals, fits, candidates, config)
    return {name: spread(values) for name, values in spent.items()}


def spread(values: Sequence[float]) -> dict[str, float]:
    """Least, median, 90th and 99th percentile (ms), and how many runs."""
    least, median, p90, p99 = np.percentile(values, [0, 50, 90, 99])
    return {"min": least, "median": median, "p90": p90, "p99": p99, "runs": len(values)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table and writes the report."""
    parser = common.parser(__doc__ or "")
    parser.add_argument("--quick", action="store_true", help="fewer passes and one sweep for the reference")
    options: argparse.Namespace = parser.parse_args(arguments)
    config = common.chosen_config(options)
    sweeps = open_sweeps(common.data_folder("kitti_object"))
    points = [sweep.read_points() for sweep in sweeps]
    xyz = [p[0] for p in points]
    clouds = [jax.device_put(PointCloud.from_numpy(*p)) for p in points]
    whole = time_whole(clouds, xyz, config, options.quick)
    by_step = time_steps(clouds[: len(clouds) // 2 if options.quick else None], config)

    rows = [("detect", *whole["detect"].values()), ("reference", *whole["reference"].values())]
    rows += [(f"  {name}", *values.values()) for name, values in by_step.items()]
    common.print_table(["", "min ms", "median ms", "p90 ms", "p99 ms", "runs"], rows)
    print(f"\n{len(clouds)} sweeps of {np.median([len(p) for p in xyz]):.0f} points, preset {options.preset}")
    print(f"first call, with its compile or from the cache: {whole['first_call_ms'] / 1e3:.1f} s")
    print(f"{whole['times_faster']:.0f} times as fast as the reference; status {whole['status'] or 'OK'}")
    common.write_report({"whole": whole, "steps": by_step, "num_sweeps": len(clouds)}, options)


if __name__ == "__main__":
    main()
