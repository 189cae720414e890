"""Shared by the programs of `benchmarks` and `quality`: data, settings, and the circumstances of a report."""

import argparse
import importlib.metadata
import json
import os
import pathlib
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

import jaxbox
from jaxbox import Detections, DetectorConfig, PointCloud, Status
from jaxbox.config.fields import parse_change, replace_fields
from jaxbox.io import Sweep, atomic_writer, open_sweeps
from jaxbox.run.cache import cache_folder, keep_compiled, make_private
from jaxbox.run.processes import THREADS_VARIABLE

PROJECT = pathlib.Path(__file__).resolve().parents[1]

DATA_VARIABLE = "JAXBOX_DATA"
"""Environment variable that names the folder of real sweeps; by default ``../shared/data``."""

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "opencv-python-headless")

VECTORS = {"avx512f": "AVX-512", "avx2": "AVX2"}
"""Flags of processors, widest vectors first."""

SWEEP_SETS = ("kitti_object", "kitti_tracking", "kitti_raw")
"""Data sets of one sensor, whose sweeps are timed."""


def data_folder(name: str) -> pathlib.Path:
    """One data set's folder; ends the program, saying how to go on, where it is absent."""
    root = pathlib.Path(os.environ.get(DATA_VARIABLE, PROJECT.parent / "shared" / "data"))
    if not (root / name).is_dir():
        raise SystemExit(f"{root / name} is not a folder; set {DATA_VARIABLE} to the folder of real sweeps.")
    return root / name


def kitti_sweeps(limit: int | None = None) -> list[Sweep]:
    """Real sweeps of the three KITTI data sets; evenly spread ones where only that many are wanted."""
    folders = [data_folder(SWEEP_SETS[0])]
    folders += [folder for name in SWEEP_SETS[1:] if (folder := folders[0].parent / name).is_dir()]
    sweeps = [sweep for folder in folders for sweep in open_sweeps(folder)]
    step = 1 if limit is None else max(len(sweeps) / limit, 1)
    return [sweeps[int(i * step)] for i in range(int(len(sweeps) / step))]


def parser(description: str, *, preset: bool = True, quick: str | None = None) -> argparse.ArgumentParser:
    """A parser with the options of every benchmark.

    Without the preset's where the benchmark chooses it; with ``--quick`` where its help is given.
    """
    options = argparse.ArgumentParser(description=description)
    if preset:
        options.add_argument("--preset", choices=sorted(DetectorConfig.presets()), default="default")
    options.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="FIELD=VALUE",
        help="change one setting, such as vehicles.max_overlap=0.2 or clustering.maps.0.cell_m=0.3",
    )
    if quick is not None:
        options.add_argument("--quick", action="store_true", help=quick)
    options.add_argument("--json", type=pathlib.Path, help="also write the report to this file")
    return options


def at_least(least: int) -> Callable[[str], int]:
    """Type of an option: whole numbers from the least on."""

    def number(text: str) -> int:
        if not text.removeprefix("-").isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number from {least} on")
        return int(text)

    return number


def enable_cache() -> None:
    """Switches JAX's compilation cache on, without jaxbox's traced programs: `detect` is one function."""
    folder = cache_folder(os.environ)
    if folder is not None and make_private(folder) is None:
        keep_compiled(folder)


def chosen_config(options: argparse.Namespace, *, preset: str | None = None) -> DetectorConfig:
    """The preset, the user's unless named, with its changes; also switches the compilation cache on."""
    enable_cache()
    try:
        changes = dict(parse_change(change) for change in options.set)
        return replace_fields(DetectorConfig.presets()[preset or options.preset], changes)
    except ValueError as error:
        raise SystemExit(f"--set: {error}") from error


def detect(xyz: np.ndarray, intensity: np.ndarray | None, config: DetectorConfig) -> Detections:
    """Finds the vehicles of one sweep, on the host's side of the API."""
    return jax.block_until_ready(jaxbox.detect(PointCloud.from_numpy(xyz, intensity), config))


def status_names(statuses: Sequence[int]) -> list[str]:
    """Names of all status bits that are set in any sweep."""
    together = Status(int(np.bitwise_or.reduce(np.array([0, *statuses]))))
    return [bit.name or "" for bit in Status if bit and bit in together]


def circumstances(options: argparse.Namespace) -> dict[str, Any]:
    """What a figure depends on besides the code: settings, commit, versions and machine."""
    # The place of a file says nothing of the figures.
    chosen = {
        name: value.name if isinstance(value, pathlib.Path) else value
        for name, value in vars(options).items()
    }
    return {
        "options": chosen,
        "commit": _git("rev-parse", "HEAD"),
        "uncommitted_changes": bool(_git("status", "--porcelain", "--", "jaxbox", "benchmarks", "quality")),
        "jaxbox": jaxbox.__version__,
        "python": platform.python_version(),
        "packages": {name: installed_version(name) for name in PACKAGES},
        "machine": platform.machine(),
        "processor": _processor(),
        "cpus": os.cpu_count(),
        "threads": os.environ.get(THREADS_VARIABLE),
        "devices": [str(device) for device in jax.devices()],
        "device_kind": jax.devices()[0].device_kind,
    }


def _git(*words: str) -> str | None:
    done = subprocess.run(["git", *words], cwd=PROJECT, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else None


def _processor() -> str:
    """Its name, with what tells processors of one name apart where a virtual machine hides the rest."""
    cpuinfo = pathlib.Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().split("\n\n")[0].splitlines() if cpuinfo.is_file() else []
    known = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    parts = [known.get("model name", "unknown")]
    if "cpu family" in known and "model" in known:
        parts.append(f"family {known['cpu family']} model {known['model']}")
    flags = known.get("flags", "").split()
    parts += [name for flag, name in VECTORS.items() if flag in flags][:1]
    return ", ".join(parts)


def installed_version(name: str) -> str | None:
    """Version of a package, or None where it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def milliseconds(function: Callable[[], Any]) -> tuple[float, Any]:
    """Time of one call, until its result is ready, and the result."""
    start = time.perf_counter()
    result = jax.block_until_ready(function())
    return 1e3 * (time.perf_counter() - start), result


def spread(values: Sequence[float]) -> dict[str, float]:
    """Least, median, 90th and 99th percentile (ms), and how many runs."""
    least, median, p90, p99 = np.percentile(values, [0, 50, 90, 99])
    return {"min": least, "median": median, "p90": p90, "p99": p99, "runs": len(values)}


def write_report(report: dict[str, Any], options: argparse.Namespace) -> None:
    """Writes the report where ``--json`` says, whole or not at all."""
    if options.json:
        with atomic_writer(options.json) as handle:
            json.dump(report | {"circumstances": circumstances(options)}, handle, indent=1)


def box_rows(boxes: Any) -> np.ndarray:
    """(n, 7) float64 x, y, z, length, width, height, yaw of boxes with `center`, `size` and `yaw`."""
    return np.column_stack([boxes.center, boxes.size, boxes.yaw]).astype(float)


def print_table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Prints aligned columns; floats with three significant decimals at most."""
    texts = [[_cell(value) for value in row] for row in [header, *rows]]
    widths = [max(len(row[i]) for row in texts) for i in range(len(header))]
    for row in texts:
        print(
            "  ".join(
                text.rjust(width) if i else text.ljust(width)
                for i, (text, width) in enumerate(zip(row, widths, strict=True))
            )
        )


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
