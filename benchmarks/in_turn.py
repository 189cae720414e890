"""Times two checkouts of jaxbox in turn, sweep by sweep, each in a process of its own.

The speed of a shared machine swings by half within minutes: only what runs within the same second can be
compared. So each sweep goes to one checkout and at once to the other, and the ratio of the two is reported.
"""

import json
import os
import pathlib
import subprocess
import sys
from collections.abc import Sequence
from types import TracebackType
from typing import Any

import numpy as np

WORKER = """
import hashlib, json, os, sys, time
import numpy as np
import jax, jaxbox
preset, *changes = sys.argv[1:]
config = jaxbox.DetectorConfig.presets()[preset]
if changes:
    from jaxbox.config.fields import parse_change, replace_fields
    config = replace_fields(config, dict(parse_change(change) for change in changes))
config = jax.tree.map(float, config)
print(json.dumps({"jaxbox": os.path.dirname(jaxbox.__file__)}), flush=True)
for line in sys.stdin:
    points = np.load(line.strip())
    start = time.perf_counter()
    found = jaxbox.detect(jaxbox.PointCloud.from_numpy(points[:, :3], points[:, 3]), config)
    wanted = found.center, found.size, found.yaw, found.score, found.label, found.valid
    boxes = [np.asarray(array) for array in wanted]
    spent_ms = 1e3 * (time.perf_counter() - start)
    digest = hashlib.sha256(b"".join(array.tobytes() for array in boxes)).hexdigest()
    print(json.dumps({"ms": spent_ms, "boxes": digest}), flush=True)
"""
"""What each process runs, from a host array to boxes on the host. It uses what every version of jaxbox has;
only changed settings need `jaxbox.config.fields`."""


class Checkout:
    """A process that runs `jaxbox.detect` of one checkout, sweep by sweep. A context manager."""

    def __init__(self, folder: pathlib.Path, preset: str, changes: Sequence[str] = ()) -> None:
        """Starts the process, and checks that it imports jaxbox from the folder."""
        self.folder = folder.resolve()
        if not (self.folder / "jaxbox" / "__init__.py").is_file():
            raise SystemExit(
                f"--against: {folder} is not a checkout of jaxbox: it has no jaxbox/__init__.py."
            )
        self._process = subprocess.Popen(
            # Without -P the folder that it is started in comes first on the path.
            [sys.executable, "-c", WORKER, preset, *changes],
            cwd=self.folder,
            env={name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        imported = pathlib.Path(self._read()["jaxbox"])
        if imported.resolve() != self.folder / "jaxbox":
            self.__exit__(None, None, None)
            raise SystemExit(f"--against: Python imports jaxbox from {imported}, and not from {self.folder}.")

    def __enter__(self) -> "Checkout":
        """The process, which has been started."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()

    def detect(self, sweep: pathlib.Path) -> tuple[float, str]:
        """Milliseconds that one sweep took, host to host, and a digest of its boxes.

        Args:
          sweep: file of an (N, 4) array, as NumPy saves it.

        Returns:
          The time and the digest.
        """
        assert self._process.stdin is not None
        print(sweep, file=self._process.stdin, flush=True)
        answer = self._read()
        return answer["ms"], answer["boxes"]

    def _read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"the process of {self.folder} ended with exit code {self._process.wait()}.")
        return json.loads(line)


def take_turns(
    checkouts: tuple[Checkout, Checkout], sweeps: Sequence[pathlib.Path], passes: int
) -> dict[str, Any]:
    """Runs each sweep with one checkout and then the other, in alternating order, several times over.

    Args:
      checkouts: this one, and the one that it is compared with.
      sweeps: files of (N, 4) arrays.
      passes: how often each sweep is run, after one call that compiles.

    Returns:
      The times of both (ms), the ratios of this one's time to the other's, and how many sweeps have other
      boxes: see `summarize_turns`.
    """
    for checkout in checkouts:
        checkout.detect(sweeps[0])
    spent_ms = np.full((2, passes, len(sweeps)), np.nan)
    boxes = [["", ""] for _ in sweeps]
    for i in range(passes):
        for j, sweep in enumerate(sweeps):
            for which in (0, 1) if (i + j) % 2 == 0 else (1, 0):
                spent_ms[which, i, j], boxes[j][which] = checkouts[which].detect(sweep)
    return summarize_turns(spent_ms) | {"sweeps_with_other_boxes": sum(a != b for a, b in boxes)}


def summarize_turns(spent_ms: np.ndarray) -> dict[str, Any]:
    """Times and ratios of two programs that took turns.

    Args:
      spent_ms: (2, passes, sweeps) ms: of this program, then of the other.

    Returns:
      `mean_of_least_ms` and `median_ms` of both; `ratio_of_means`, this one's mean of the least times by the
      other's; and `ratio_quartiles` over all turns.

    >>> found = summarize_turns(np.array([[[1.0, 2.0], [3.0, 2.0]], [[2.0, 2.0], [2.0, 2.0]]]))
    >>> found["mean_of_least_ms"], found["ratio_of_means"]
    ([1.5, 2.0], 0.75)
    """
    mean_of_least = spent_ms.min(axis=1).mean(axis=1)
    quartiles = np.percentile(spent_ms[0] / spent_ms[1], [25, 50, 75])
    return {
        "mean_of_least_ms": mean_of_least.tolist(),
        "median_ms": np.median(spent_ms, axis=(1, 2)).tolist(),
        "ratio_of_means": float(mean_of_least[0] / mean_of_least[1]),
        "ratio_quartiles": quartiles.tolist(),
    }
