"""``jaxbox export``: the detector of one capacity as StableHLO."""

import enum
import pathlib
from collections.abc import Sequence

import jax
from rich.console import Console

from jaxbox.cli.results import written
from jaxbox.config import DetectorConfig
from jaxbox.run.export import export_detector, write_exported


class Platform(enum.StrEnum):
    """What an exported detector runs on."""

    CPU = "cpu"
    CUDA = "cuda"
    ROCM = "rocm"
    TPU = "tpu"


def run_export(
    output: pathlib.Path,
    config: DetectorConfig,
    *,
    capacity: int,
    seed: int,
    platforms: Sequence[Platform],
    console: Console,
) -> None:
    """Lowers the detector and writes it.

    Args:
      output: folder for the files.
      config: the settings inside.
      capacity: points that a sweep is padded to.
      seed: of the random key inside.
      platforms: to run on; none for what JAX runs on here.
      console: where the list of files goes.

    Raises:
      OutputError: where the folder cannot be made or written, the first before the detector is lowered.
    """
    names = [platform.value for platform in platforms] or None
    with written(output, advice="or choose another --output; it is a folder."):
        output.mkdir(parents=True, exist_ok=True)
        exported = export_detector(capacity, config, jax.random.key(seed), platforms=names)
        paths = write_exported(output, exported)
    for path in paths:
        console.print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)", markup=False)
