"""What a killed `jaxbox detect` leaves behind, and whether a resumed run ends with the same results.

    python -m quality.faults [--kills 50] [--sweeps 4] [--json FILE]

A run over synthetic sweeps is killed (SIGKILL) at random moments from its start to its end, and the same
command with ``--resume`` is started over and over, until it was killed so often, and then left alone.
KITTI text, JSON Lines, Parquet and pictures have to be those of a run that nothing disturbed, byte for byte.
After each kill every file that has its name is read: it has to be whole.
"""

import argparse
import collections
import contextlib
import itertools
import json
import os
import pathlib
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from benchmarks import common
from jaxbox import io, synthetic
from jaxbox.io.parquet import finished_parquet

KILLS, SWEEPS = 50, 4
NUM_AZIMUTHS = 250
"""Small sweeps, of the smallest capacity."""
OPTIONS = ("--format", "kitti", "--format", "jsonl", "--format", "parquet")
ACCOUNTS = ("run.json",)
"""Files that say when a run was; all others have to be the same."""
_START_SHARE = 0.8
"""Of a short run's time that passes before its first sweep is done."""
_LONGEST_SWEEP_S = 0.5
_SWEEP_LINE = re.compile(r"\d{6}: ")


def write_sweeps(folder: pathlib.Path, count: int) -> None:
    """Synthetic sweeps with a camera, in KITTI's object layout."""
    for seed in range(count):
        sweep = synthetic.make_sweep(seed, num_azimuths=NUM_AZIMUTHS)
        io.write_bin(folder / "velodyne" / f"{seed:06d}.bin", sweep.xyz, sweep.intensity)
        io.write_calibration(folder / "calib" / f"{seed:06d}.txt", sweep.calibration)


def command(sweeps: pathlib.Path, output: pathlib.Path, *options: str) -> list[str]:
    """The command line of a run, in a process of its own."""
    return [
        *(sys.executable, "-m", "jaxbox", "detect", str(sweeps), "--output", str(output)),
        *OPTIONS,
        *options,
    ]


def run(words: list[str], *, kill_after: tuple[int, float] | None = None) -> int:
    """Runs a command, killed that many seconds after that many of its lines about a sweep; its exit code.

    Moments are counted in sweeps rather than seconds because most of a short run is its start.
    """
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    ) as process:
        if kill_after is not None:
            num_lines, delay_s = kill_after
            lines = (line for line in process.stdout or () if _SWEEP_LINE.match(line))
            collections.deque(itertools.islice(lines, num_lines), maxlen=0)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(delay_s)
            process.kill()
        process.communicate()
    return process.returncode


def contents(folder: pathlib.Path) -> dict[str, bytes]:
    """Every file below a folder, but those that tell the time."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in ACCOUNTS)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def differing_files(expected: dict[str, bytes], found: dict[str, bytes]) -> set[str]:
    """Names of files that are absent from one of two folders, or differ."""
    return {name for name in {*expected, *found} if expected.get(name) != found.get(name)}


def broken(folder: pathlib.Path) -> list[str]:
    """Files that have their names and cannot be read; hidden ones are still to be named."""
    readers = {
        ".txt": io.read_labels,
        ".jsonl": io.read_jsonl,
        ".parquet": finished_parquet,
        ".png": io.read_image,
        ".toml": io.read_config,
        ".json": lambda path: json.loads(path.read_text("utf-8")),
    }
    found = []
    for path in folder.rglob("*"):
        if path.is_file() and not path.name.startswith("."):
            try:
                readers[path.suffix](path)
            except ValueError as error:
                found.append(f"{path.name}: {error}")
    return found


def stage_of(killed: pathlib.Path, num_done: int, num_sweeps: int) -> str:
    """How far a killed run had come."""
    if (killed / "detections.parquet").exists():
        return "while or after the result files took their names"
    if num_done == 0:
        return "before the first sweep was done"
    return "after the last sweep" if num_done == num_sweeps else "between sweeps"


def kill_and_resume(sweeps: pathlib.Path, root: pathlib.Path, *, kills: int, seed: int) -> dict[str, Any]:
    """Runs undisturbed, then killed and resumed that many times.

    Args:
      sweeps: of `write_sweeps`.
      root: an empty folder for the results.
      kills: how many processes are killed.
      seed: of the moments.

    Returns:
      What happened: when kills came, how far the runs had come, files that differ or were broken.
    """
    plain, repeated, killed = root / "undisturbed", root / "repeated", root / "killed"
    num_sweeps = len(list((sweeps / "velodyne").iterdir()))
    usual_s = 0.0
    # The time of the second, for which the programs are kept, as they are for the runs that are killed.
    for folder in (plain, repeated):
        start = time.monotonic()
        if run(command(sweeps, folder)):
            raise SystemExit(f"the {folder.name} run failed")
        usual_s = time.monotonic() - start
    rng = random.Random(seed)
    reached: collections.Counter[str] = collections.Counter()
    half_written, num_ended = [], 0
    while reached.total() < kills:
        # Before the first sweep anywhere in the start, after that anywhere up to the next sweep, or the end.
        num_lines = rng.randint(0, num_sweeps)
        moment = num_lines, rng.uniform(0, _START_SHARE * usual_s if num_lines == 0 else _LONGEST_SWEEP_S)
        code = run(command(sweeps, killed, "--resume"), kill_after=moment)
        if code == -signal.SIGKILL:
            reached[stage_of(killed, num_lines, num_sweeps)] += 1
            half_written += broken(killed)
            print(f"killed {reached.total()} times", file=sys.stderr)
        elif code:
            raise SystemExit(f"a resumed run ended with exit code {code}")
        else:
            # It has nothing left to do: the next begins again.
            num_ended += 1
            (killed / "detections.parquet").unlink()
    code = run(command(sweeps, killed, "--resume"))
    expected = contents(plain)
    differing = differing_files(expected, contents(repeated)) | differing_files(expected, contents(killed))
    return {
        "kills": reached.total(), "ended_by_themselves": num_ended, "usual_s": usual_s,
        "reached": dict(sorted(reached.items())), "half_written": half_written,
        "final_exit_code": code, "files": len(expected), "differing": sorted(differing),
    }  # fmt: skip


def main() -> None:
    """Prints what happened; ends with 1 where results differ or a file was broken."""
    options = argparse.ArgumentParser(description="A killed and resumed jaxbox detect.")
    options.add_argument("--kills", type=common.at_least(1), default=KILLS)
    options.add_argument("--sweeps", type=common.at_least(1), default=SWEEPS)
    options.add_argument("--seed", type=int, default=0, help="of the moments of the kills")
    options.add_argument("--json", type=pathlib.Path, help="also write the report to this file")
    chosen = options.parse_args()
    with tempfile.TemporaryDirectory() as name:
        root = pathlib.Path(name)
        write_sweeps(root / "sweeps", chosen.sweeps)
        report = kill_and_resume(root / "sweeps", root, kills=chosen.kills, seed=chosen.seed)
    for key, value in report.items():
        print(f"{key}: {value}")
    common.write_report(report, chosen)
    sys.exit(int(bool(report["differing"] or report["half_written"] or report["final_exit_code"])))


if __name__ == "__main__":
    main()
