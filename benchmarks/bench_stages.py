"""Times detect() on real sweeps, whole and step by step, next to what the machine could do at the best.

    python -m benchmarks.bench_stages [--preset paper] [--quick] [--json FILE]
    python -m benchmarks.bench_stages --against ANOTHER_CHECKOUT [--preset paper] [--quick] [--json FILE]

Compile time is apart. The whole is timed from a host array to boxes on the host, and on the device alone;
each pass goes over different sweeps. A step is timed as a compiled function of its own, so the steps need
not add up to the whole. Its floor is the longer of two times: its inputs and outputs through the memory
once, and the arithmetic that the compiler counts (loops once) at the machine's best rate; both rates are
measured in the same run. On an accelerator the same command measures that.

With ``--against`` whole sweeps of this checkout and of another one, which ``git worktree add`` makes of any
commit, are timed in turn instead: see `benchmarks.in_turn`.
"""

import argparse
import contextlib
import functools
import pathlib
import tempfile
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxbox
from benchmarks import common, in_turn
from jaxbox import DetectorConfig, PointCloud, detector
from jaxbox.io import Sweep
from jaxbox.run import compiled
from jaxbox.stages import clustering, filtering, ground

MIN_SWEEPS, QUICK_SWEEPS = 80, 20
"""Different sweeps that a 99th percentile is taken over, at the least."""

STEP_SWEEPS, QUICK_STEP_SWEEPS = 30, 10
"""Sweeps that each step is timed on."""

PASSES, QUICK_PASSES = 3, 2
"""Times that each sweep is run."""

COPY_FLOATS = 2**25
"""Size of the copy that measures the machine."""

MATRIX, LARGE_MATRIX = 1024, 8192
"""Sizes of the product that measures it, on a CPU and on an accelerator."""

RATE_CALLS = 10
"""Calls of each that are timed together: to launch one takes an accelerator as long as to run it."""

STEPS = (
    "select_points", "remove_ground", "gather_obstacles", "propose_clusters", "fit_rectangles",
    "observe", "complete_boxes", "score_boxes", "assemble",
)  # fmt: skip


def time_whole(
    points: Sequence[tuple[np.ndarray, np.ndarray]], config: DetectorConfig, passes: int
) -> dict[str, Any]:
    """Whole sweeps through detect(): from the host to the host, and on the device."""
    clouds = [jax.device_put(PointCloud.from_numpy(*p)) for p in points]
    first_call_ms, _ = common.milliseconds(lambda: jaxbox.detect(clouds[0], config))
    on_host, on_device, statuses = [], [], []

    def boxes(sweep: tuple[np.ndarray, np.ndarray]) -> Any:
        return jaxbox.detect(PointCloud.from_numpy(*sweep), config).on_host()

    for _ in range(passes):
        for sweep, cloud in zip(points, clouds, strict=True):
            on_host.append(common.milliseconds(functools.partial(boxes, sweep))[0])
            spent_ms, found = common.milliseconds(functools.partial(jaxbox.detect, cloud, config))
            on_device.append(spent_ms)
            statuses.append(int(found.status))
    return {
        "first_call_ms": first_call_ms,
        "host to host": common.spread(on_host),
        "on the device": common.spread(on_device),
        "status": common.status_names(statuses),
    }


def machine_rates() -> dict[str, float]:
    """Bytes and floating-point operations a second that this machine reaches."""
    # In place, where the copy can: fresh memory would be measured by what the system takes to hand it out.
    size = MATRIX if jax.default_backend() == "cpu" else LARGE_MATRIX
    source, matrix = jnp.zeros(COPY_FLOATS), jnp.ones((size, size))
    best_ms = {}
    for name, function, start in (
        ("copy", jax.jit(lambda a: a + 1, donate_argnums=0), source),
        ("product", jax.jit(lambda a: jnp.matmul(a, a, precision="highest") / size), matrix),
    ):
        operand, spent = start, []
        for _ in range(4):
            ms, operand = common.milliseconds(functools.partial(_repeat, function, operand))
            spent.append(ms / RATE_CALLS)
        best_ms[name] = min(spent)
    return {
        "bytes_per_s": 2 * source.nbytes / best_ms["copy"] * 1e3,
        "flops_per_s": 2 * size**3 / best_ms["product"] * 1e3,
    }


def _repeat(function: Callable[[Any], Any], operand: Any) -> Any:
    for _ in range(RATE_CALLS):
        operand = function(operand)
    return operand


def floor(program: Any, rates: dict[str, float]) -> dict[str, float]:
    """Least time of a compiled function: its inputs and outputs, and its arithmetic, at the best rates."""
    memory, cost = program.memory_analysis(), program.cost_analysis() or {}
    moved = memory.argument_size_in_bytes + memory.output_size_in_bytes
    flops = max(float(cost.get("flops", 0)), 0.0)
    return {
        "bytes": moved,
        "flops": flops,
        "floor_ms": 1e3 * max(moved / rates["bytes_per_s"], flops / rates["flops_per_s"]),
    }


def run_steps(cloud: PointCloud, config: DetectorConfig, run: Callable[..., Any]) -> None:
    """Calls ``run(step, *inputs)`` for each step of detect(), on what it returned for the steps before."""
    sweep = run(filtering.select_points, cloud, config.filtering, config.region)
    terrain = run(ground.remove_ground, sweep, config.ground, jax.random.key(0))
    obstacles = run(ground.gather_obstacles, sweep, terrain, config)
    clusters = run(clustering.propose_clusters, obstacles, config)
    outlines, rotations = run(detector.fit_rectangles, obstacles, clusters, config)
    seen = run(detector.observe, sweep, terrain, config)
    segments = detector.Segments(sweep, terrain, obstacles, clusters, outlines, rotations, seen)
    completed = run(detector.complete_boxes, segments, config)
    candidates = run(detector.score_boxes, completed, segments, config)
    run(detector.assemble, cloud, segments, completed, candidates, config)


def time_steps(
    clouds: Sequence[PointCloud], config: DetectorConfig, rates: dict[str, float]
) -> dict[str, dict[str, float]]:
    """Each step of detect() by itself, on what the steps before it found."""
    programs: dict[str, Callable[..., Any]] = {}
    floors: dict[str, dict[str, float]] = {}
    spent: dict[str, list[float]] = {name: [] for name in STEPS}

    def run(step: Callable[..., Any], *inputs: Any) -> Any:
        name = step.__name__
        if name not in programs:
            programs[name] = jax.jit(step).lower(*inputs).compile()
            floors[name] = floor(programs[name], rates)
        jax.block_until_ready(programs[name](*inputs))
        ms, result = common.milliseconds(functools.partial(programs[name], *inputs))
        spent[name].append(ms)
        return result

    for cloud in clouds:
        run_steps(cloud, config, run)
    return {name: common.spread(spent[name]) | floors[name] for name in STEPS}


def whole_program(cloud: PointCloud, config: DetectorConfig, rates: dict[str, float]) -> dict[str, float]:
    """Floor and memory of the whole compiled detector."""
    program = compiled.lower(cloud, config).compile()
    memory: Any = program.memory_analysis()
    return floor(program, rates) | {
        "arguments_mb": memory.argument_size_in_bytes / 1e6,
        "outputs_mb": memory.output_size_in_bytes / 1e6,
        "scratch_mb": memory.temp_size_in_bytes / 1e6,
        "code_mb": memory.generated_code_size_in_bytes / 1e6,
    }


def read_all(sweeps: Sequence[Sweep]) -> list[tuple[np.ndarray, np.ndarray]]:
    return [sweep.read_points() for sweep in sweeps]


def compare(options: argparse.Namespace) -> dict[str, Any]:
    """Times of this checkout and of another one, taking turns on each sweep."""
    sweeps = common.kitti_sweeps(QUICK_SWEEPS if options.quick else MIN_SWEEPS)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        files = [pathlib.Path(folder) / f"{i}.npy" for i in range(len(sweeps))]
        for file, (xyz, intensity) in zip(files, read_all(sweeps), strict=True):
            np.save(file, np.column_stack([xyz, intensity]))
        this, other = (
            stack.enter_context(in_turn.Checkout(place, options.preset, options.set))
            for place in (common.PROJECT, options.against)
        )
        found = in_turn.take_turns((this, other), files, QUICK_PASSES if options.quick else PASSES)
    return found | {"num_sweeps": len(files)}


def print_turns(found: dict[str, Any], options: argparse.Namespace) -> None:
    """Prints what `compare` found."""
    means, medians = found["mean_of_least_ms"], found["median_ms"]
    names = "this checkout", str(options.against)
    common.print_table(
        ["", "mean of each sweep's least ms", "median ms"], list(zip(names, means, medians, strict=True))
    )
    low, middle, high = found["ratio_quartiles"]
    print(f"\n{found['num_sweeps']} sweeps, {options.preset}: {found['ratio_of_means']:.3f} times as long")
    print(f"ratio of each turn: median {middle:.3f}, quartiles {low:.3f} and {high:.3f}")
    print(f"{found['sweeps_with_other_boxes']} sweeps have other boxes")


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the tables and writes the report."""
    parser = common.parser(__doc__ or "", quick="fewer sweeps and passes")
    parser.add_argument(
        "--against",
        type=pathlib.Path,
        metavar="CHECKOUT",
        help="time whole sweeps of this checkout and of another one in turn, instead of steps",
    )
    options: argparse.Namespace = parser.parse_args(arguments)
    if options.against is not None:
        found = compare(options)
        print_turns(found, options)
        common.write_report({"turns": found}, options)
        return
    config = jax.tree.map(float, common.chosen_config(options))
    points = read_all(common.kitti_sweeps(QUICK_SWEEPS if options.quick else None))
    if not options.quick and len(points) < MIN_SWEEPS:
        print(f"only {len(points)} sweeps are at hand; a 99th percentile wants {MIN_SWEEPS}")
    rates = machine_rates()
    whole = time_whole(points, config, QUICK_PASSES if options.quick else PASSES)
    some = points[:: max(len(points) // (QUICK_STEP_SWEEPS if options.quick else STEP_SWEEPS), 1)]
    clouds = [jax.device_put(PointCloud.from_numpy(*p)) for p in some]
    by_step = time_steps(clouds, config, rates)
    program = whole_program(PointCloud.from_numpy(*points[0]), config, rates)

    columns = ("min", "median", "p90", "p99", "runs", "floor_ms")
    rows = [
        ("host to host", *whole["host to host"].values(), None),
        ("on the device", *whole["on the device"].values(), program["floor_ms"]),
        *((f"  {name}", *(values[c] for c in columns)) for name, values in by_step.items()),
    ]
    common.print_table(["", "min ms", "median ms", "p90 ms", "p99 ms", "runs", "floor ms"], rows)
    host = whole["host to host"]
    print(f"\n{len(points)} sweeps of {np.median([len(p[0]) for p in points]):.0f} points, {options.preset}")
    print(f"p99 is {host['p99'] / host['median']:.2f} times the median")
    print(f"first call, with its compile or from the cache: {whole['first_call_ms'] / 1e3:.1f} s")
    print(
        f"memory: arguments {program['arguments_mb']:.1f}, outputs {program['outputs_mb']:.1f}, "
        f"scratch {program['scratch_mb']:.1f} MB"
    )
    share = program["floor_ms"] / whole["on the device"]["median"]
    print(f"device: {jax.devices()[0].device_kind}; the whole runs at {share:.2%} of its roofline")
    print(f"machine: {rates['bytes_per_s'] / 1e9:.1f} GB/s, {rates['flops_per_s'] / 1e9:.0f} GFLOP/s")
    print(f"status {whole['status'] or 'OK'}")
    report = {"whole": whole, "steps": by_step, "program": program, "machine_rates": rates}
    common.write_report(report | {"num_sweeps": len(points)}, options)


if __name__ == "__main__":
    main()
