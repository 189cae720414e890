"""From the start of a process to its first boxes, with an empty cache of compiled functions and a full one.

    python -m benchmarks.bench_coldstart [--preset paper] [--quick] [--json FILE]

Each start is a process of its own, on a built-in sweep padded to 131,072 points, with compiled and traced
programs kept as the command line does it, in a folder of this run. Import, compile (or load from the cache)
and run are apart; the total is the clock of whoever started the process.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from benchmarks import common

STARTS, QUICK_STARTS = 3, 1
"""Processes with a full cache; one has an empty cache."""

CAPACITY = 2**17
PHASES = ("import", "sweep", "first call", "second call", "total")

PROGRAM = """
import json, sys, time
clock = time.perf_counter
start = clock()
import jax, jaxbox
from jaxbox.cli.cache import enable_cache
from jaxbox.cli.timing import TimedDetector
enable_cache()
imported = clock()
import numpy as np
points = np.load(sys.argv[1])
config = jaxbox.DetectorConfig.presets()[sys.argv[2]]
cloud = jaxbox.PointCloud.from_numpy(points, capacity=int(sys.argv[3]))
ready = clock()
detect = TimedDetector(config)
boxes = jax.device_get(detect(cloud)[0].center)
first = clock()
spent = {"import": imported - start, "sweep": ready - imported, "first call": first - ready}
print(json.dumps(spent), flush=True)
jax.device_get(detect(cloud)[0].center)
print(json.dumps({"second call": clock() - first}), flush=True)
"""


def start_process(points: str, preset: str, cache: str) -> dict[str, float]:
    """Seconds of the phases of one process; the total is until its first boxes."""
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    command = [sys.executable, "-c", PROGRAM, points, preset, str(CAPACITY)]
    start = time.perf_counter()
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environment | {"JAXBOX_CACHE_DIR": cache}
    ) as process:
        assert process.stdout is not None
        first = json.loads(process.stdout.readline())
        total = time.perf_counter() - start
        second = json.loads(process.stdout.readline())
    return first | second | {"total": total}


def measure(preset: str, num_warm: int) -> dict[str, dict[str, float]]:
    """Phases with an empty cache, and their medians with a full one."""
    from jaxbox import synthetic  # noqa: PLC0415 - this process measures others

    with tempfile.TemporaryDirectory() as folder:
        points = os.path.join(folder, "points.npy")
        np.save(points, synthetic.make_sweep(0).xyz)
        cache = os.path.join(folder, "cache")
        empty = start_process(points, preset, cache)
        warm = [start_process(points, preset, cache) for _ in range(num_warm)]
    return {
        "empty cache": empty,
        "full cache": {phase: float(np.median([run[phase] for run in warm])) for phase in PHASES},
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table and writes the report."""
    parser = common.parser(__doc__ or "", quick="one start with a full cache")
    options: argparse.Namespace = parser.parse_args(arguments)
    if options.set:
        raise SystemExit("--set: a cold start is measured with a preset as it is.")
    rows: dict[str, Any] = measure(options.preset, QUICK_STARTS if options.quick else STARTS)
    for row in rows.values():
        row["compile or load"] = row["first call"] - row["second call"]
    columns = ("total", "import", "sweep", "compile or load", "second call")
    header = ["s", "to first boxes", *columns[1:]]
    common.print_table(header, [[name, *(row[c] for c in columns)] for name, row in rows.items()])
    print(f"\npreset {options.preset}, {CAPACITY} points, {jax.default_backend()}")
    common.write_report({"starts": rows}, options)


if __name__ == "__main__":
    main()
