"""From the start of a process to its first boxes, with and without programs that were kept or shipped.

    python -m benchmarks.bench_coldstart [--preset paper] [--quick] [--json FILE]

Each start is a process of its own, on a built-in sweep padded to 131,072 points: as the command line does it,
and as a Python user does, who calls `jaxbox.enable_cache` and `jaxbox.detect`. Its cache is empty, with or
without traced programs that were shipped, or full. The total is the clock of whoever started the process; CPU
time, of all threads, is steadier where other work runs at the same time.
"""

import argparse
import json
import os
import pathlib
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence

import jax
import numpy as np

from benchmarks import common

ROUNDS, QUICK_ROUNDS = 3, 1
"""Starts of each kind, in turn; the medians count."""

CAPACITY = 2**17
CACHES = ("empty cache", "empty cache, shipped programs", "full cache")
COLUMNS = ("total", "import", "sweep", "compile or load", "second call", "CPU")

START = """
import json, pathlib, sys, time
clock = time.perf_counter
start = clock()
import jax, jaxbox
from jaxbox.run import programs
programs.SHIPPED = pathlib.Path(sys.argv[4])
jaxbox.enable_cache()
"""
DETECTORS = {
    "command line": """
from jaxbox.cli.threads import compute_on_one_thread
from jaxbox.cli.timing import TimedDetector
compute_on_one_thread()
timed = TimedDetector(jaxbox.DetectorConfig.presets()[sys.argv[2]])
detect = lambda cloud: timed(cloud)[0]
""",
    "Python": """
config = jaxbox.DetectorConfig.presets()[sys.argv[2]]
detect = lambda cloud: jaxbox.detect(cloud, config)
""",
}
"""What `detect` is, by who starts."""
RUN = """
imported = clock()
import numpy as np
points = np.load(sys.argv[1])
cloud = jaxbox.PointCloud.from_numpy(points, capacity=int(sys.argv[3]))
ready = clock()
boxes = jax.device_get(detect(cloud).center)
first = clock()
spent = {"import": imported - start, "sweep": ready - imported, "first call": first - ready}
print(json.dumps(spent), flush=True)
jax.device_get(detect(cloud).center)
print(json.dumps({"second call": clock() - first}), flush=True)
"""


def start_process(who: str, points: str, preset: str, cache: str, shipped: str) -> dict[str, float]:
    """Seconds of the phases of one process; the total is until its first boxes, CPU until its end."""
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    command = [sys.executable, "-c", START + DETECTORS[who] + RUN, points, preset, str(CAPACITY), shipped]
    before, start = _cpu_of_children(), time.perf_counter()
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environment | {"JAXBOX_CACHE_DIR": cache}
    ) as process:
        assert process.stdout is not None
        first = json.loads(process.stdout.readline())
        total = time.perf_counter() - start
        second = json.loads(process.stdout.readline())
    found = first | second | {"total": total, "CPU": _cpu_of_children() - before}
    return found | {"compile or load": found["first call"] - found["second call"]}


def _cpu_of_children() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def start_all(preset: str, rounds: int) -> Iterator[tuple[str, dict[str, float]]]:
    """Starts of each kind in turn, with what each took."""
    from jaxbox import DetectorConfig, synthetic  # noqa: PLC0415 - this process measures others
    from jaxbox.run import shipping  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder:
        points, shipped = os.path.join(folder, "points.npy"), os.path.join(folder, "shipped")
        np.save(points, synthetic.make_sweep(0).xyz)
        config = DetectorConfig.presets()[preset]
        shipping.ship_programs(pathlib.Path(shipped), [config], capacity=CAPACITY, platforms=[_platform()])
        for i in range(rounds):
            for who in DETECTORS:
                cache = os.path.join(folder, f"{who} {i}")
                starts = {
                    CACHES[0]: (f"{cache} traced", ""),
                    CACHES[1]: (f"{cache} shipped", shipped),
                    CACHES[2]: (f"{cache} shipped", shipped),  # which has been filled now
                }
                for name, folders in starts.items():
                    yield f"{who}, {name}", start_process(who, points, preset, *folders)


def _platform() -> str:
    return "cpu" if jax.default_backend() == "cpu" else "cuda"


def measure(preset: str, rounds: int) -> dict[str, dict[str, float]]:
    """Medians of each kind of start."""
    found: dict[str, list[dict[str, float]]] = {}
    for name, spent in start_all(preset, rounds):
        found.setdefault(name, []).append(spent)
    return {
        name: {column: float(np.median([spent[column] for spent in starts])) for column in COLUMNS}
        for name, starts in found.items()
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table and writes the report."""
    parser = common.parser(__doc__ or "", quick="one start of each kind")
    options: argparse.Namespace = parser.parse_args(arguments)
    if options.set:
        raise SystemExit("--set: a cold start is measured with a preset as it is.")
    rows = measure(options.preset, QUICK_ROUNDS if options.quick else ROUNDS)
    header = ["s", "to first boxes", *COLUMNS[1:]]
    common.print_table(header, [[name, *(row[c] for c in COLUMNS)] for name, row in rows.items()])
    print(f"\npreset {options.preset}, {CAPACITY} points, {jax.default_backend()}")
    common.write_report({"starts": rows}, options)


if __name__ == "__main__":
    main()
