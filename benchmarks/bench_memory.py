"""Memory of a long `jaxbox detect` run, frame by frame, and of the compiled detector.

    python -m benchmarks.bench_memory [--preset paper] [--frames 1000] [--quick] [--json FILE]

The command line runs in a process of its own on links to the real sweeps, over and over, without pictures.
Its resident memory is read while its lines appear: the peak, and whether it grows with the frames.
Compiling is part of the run and often its peak.
"""

import argparse
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from benchmarks import common
from jaxbox import DetectorConfig, PointCloud
from jaxbox.run import compiled

FRAMES, QUICK_FRAMES = 1000, 60
CAPACITY = 2**17
POLL_S = 0.05
SETTLED_SHARE = 0.2
"""Growth is counted from this share of the frames on: buffers and pools fill up before."""


def link_sweeps(folder: pathlib.Path, count: int) -> None:
    """A folder with links to the real sweeps, repeated up to a number of them."""
    paths = [sweep.points_path for sweep in common.kitti_sweeps()]
    for number in range(count):
        (folder / f"{number:06d}.bin").symlink_to(paths[number % len(paths)])


def resident_mb(pid: int) -> tuple[float, float] | None:
    """Resident memory now and its peak, MB; None once the process has ended."""
    try:
        lines = pathlib.Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return None
    fields = dict(line.split(":", 1) for line in lines if line.startswith(("VmRSS", "VmHWM")))
    if len(fields) < 2:
        return None
    now, peak = (int(fields[name].split()[0]) * 1024 / 1e6 for name in ("VmRSS", "VmHWM"))
    return now, peak


def watch_run(preset: str, frames: int) -> dict[str, Any]:
    """Peak and growth of resident memory of one run of the command line."""
    with tempfile.TemporaryDirectory() as root:
        sweeps, output = pathlib.Path(root, "sweeps"), pathlib.Path(root, "out")
        sweeps.mkdir()
        link_sweeps(sweeps, frames)
        command = [
            *(sys.executable, "-m", "jaxbox", "detect", str(sweeps), "--output", str(output)),
            *("--preset", preset, "--no-pictures", "--no-contact-sheet", "--format", "jsonl"),
        ]
        progress = pathlib.Path(root, "progress.txt")
        samples = []
        with progress.open("w") as handle:
            process = subprocess.Popen(command, stdout=handle, env=os.environ | {"PYTHONUNBUFFERED": "1"})
            while process.poll() is None:
                if (memory := resident_mb(process.pid)) is not None:
                    done = progress.read_text().count(" points, ")
                    samples.append((done, *memory))
                time.sleep(POLL_S)
    if process.returncode:
        raise SystemExit(f"jaxbox detect ended with exit code {process.returncode}")
    done, now, peak = np.array(samples).T
    # After its last frame the process gives its memory up.
    settled = (done >= SETTLED_SHARE * frames) & (done < frames)
    if not settled.any():
        raise SystemExit(f"--frames {frames}: the run was over before its memory could be read; ask for more")
    slope = np.polyfit(done[settled], now[settled], 1)[0] if np.ptp(done[settled]) > 0 else 0.0
    return {
        "frames": frames,
        "peak_mb": float(peak.max()),
        "median_mb": float(np.median(now[settled])),
        "last_mb": float(now[settled][-1]),
        "growth_mb_per_1000_frames": float(1000 * slope),
    }


def program_memory(config: DetectorConfig) -> dict[str, float]:
    """What the compiler says of the detector, MB."""
    empty = PointCloud.from_numpy(np.zeros((0, 3), np.float32), capacity=CAPACITY)
    memory: Any = compiled.lower(empty, config).compile().memory_analysis()
    parts = {"arguments": "argument", "outputs": "output", "scratch": "temp"}
    sizes = {name: getattr(memory, f"{part}_size_in_bytes") / 1e6 for name, part in parts.items()}
    return sizes | {"code": memory.generated_code_size_in_bytes / 1e6}


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the figures and writes the report."""
    parser = common.parser(__doc__ or "", quick=f"{QUICK_FRAMES} frames")
    parser.add_argument("--frames", type=common.at_least(1), default=FRAMES)
    options: argparse.Namespace = parser.parse_args(arguments)
    if options.set:
        raise SystemExit("--set: the command line is measured with a preset as it is.")
    run = watch_run(options.preset, QUICK_FRAMES if options.quick else options.frames)
    program = program_memory(common.chosen_config(options))
    common.print_table(
        ["jaxbox detect", "MB"], [(name, value) for name, value in run.items() if name != "frames"]
    )
    print(f"\n{run['frames']} frames, preset {options.preset}, {jax.default_backend()}")
    print("compiled detector: " + ", ".join(f"{name} {value:.1f} MB" for name, value in program.items()))
    common.write_report({"run": run, "program_mb": program}, options)


if __name__ == "__main__":
    main()
