"""Traced programs that come with an installation, and whether they fit it.

    python -m jaxbox.run.shipping [--presets default fast paper] [--platforms cpu cuda]

writes them into the package, before a wheel is built of it. They hold for the source that they were traced of
and for one version of JAX: run it with each version that is to be covered.
"""

import argparse
import collections
import dataclasses
import pathlib
from collections.abc import Sequence

import jax
import jaxlib.version

from jaxbox._padding import fitting_capacity
from jaxbox.config import DetectorConfig
from jaxbox.run.program_files import SUFFIX, BrokenProgramError, read_made_of, write_program
from jaxbox.run.programs import SHIPPED, Half, build_for, source_digest, trace

CAPACITY = fitting_capacity(120_000)
"""Points of a whole sweep of 64 beams."""
PLATFORMS = ("cpu", "cuda")


@dataclasses.dataclass(frozen=True)
class ShippedState:
    """Whether the programs that came with an installation fit it."""

    num_files: int
    """How many there are."""
    num_fitting: int
    """Those of this source and these versions of JAX, which are used."""
    misfits: tuple[str, ...]
    """Why the others are not used, each reason once."""

    def __str__(self) -> str:
        """One line."""
        if not self.num_files:
            return "none"
        reasons = f" ({', '.join(self.misfits)})" if self.misfits else ""
        return f"{self.num_fitting} of {self.num_files} fit{reasons}"


def shipped_state(folder: pathlib.Path = SHIPPED) -> ShippedState:
    """Looks at the programs that came with an installation.

    Args:
      folder: where they are.

    Returns:
      How many there are, how many fit, and why the others do not.
    """
    misfits = [_misfit(path) for path in sorted(folder.glob(f"*{SUFFIX}"))]
    reasons = collections.Counter(reason for reason in misfits if reason is not None)
    return ShippedState(len(misfits), misfits.count(None), tuple(reasons))


def ship_programs(
    folder: pathlib.Path,
    configs: Sequence[DetectorConfig],
    *,
    capacity: int = CAPACITY,
    platforms: Sequence[str] = PLATFORMS,
) -> list[pathlib.Path]:
    """Traces programs for those who install this source, and removes what was traced of another source.

    Args:
      folder: made where it is missing; programs that were made by another version of JAX stay.
      configs: whose thresholds do not matter.
      capacity: N, points that sweeps are padded to.
      platforms: "cpu", "cuda", "rocm" or "tpu", which need not be there.

    Returns:
      The files.
    """
    for path in folder.glob(f"*{SUFFIX}"):
        if _misfit(path) in (_DAMAGED, _OTHER_SOURCE):
            path.unlink()
    written = []
    for config in configs:
        for platform in platforms:
            build = build_for(jax.tree.structure(config), capacity, platform)
            for half in Half:
                path = folder / build.file_name(half)
                write_program(path, trace(build, half), build.made_of(half))
                written.append(path)
    return written


_DAMAGED, _OTHER_SOURCE = "damaged", "made of another source"


def _misfit(path: pathlib.Path) -> str | None:
    """Why a program is not used here; None where it fits."""
    try:
        made_of = read_made_of(path)
    except (BrokenProgramError, OSError):
        return _DAMAGED
    if made_of["source"] != source_digest():
        return _OTHER_SOURCE
    for name, version in {"jax": jax.__version__, "jaxlib": jaxlib.version.__version__}.items():
        if made_of[name] != version:
            return f"made by {name} {made_of[name]}, not {version}"
    return None


def shipped_presets() -> dict[str, DetectorConfig]:
    """The presets whose programs can be shipped: those that read a sweep once, see `KeptPrograms`."""
    return {name: c for name, c in DetectorConfig.presets().items() if c.vehicles.num_readings == 1}


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes the programs into the package, and prints their files."""
    presets = shipped_presets()
    parser = argparse.ArgumentParser(description="Traces programs into the package, for a wheel of it.")
    parser.add_argument("--presets", nargs="+", choices=presets, default=list(presets))
    parser.add_argument("--platforms", nargs="+", default=list(PLATFORMS))
    options = parser.parse_args(arguments)
    configs = [presets[name] for name in options.presets]
    for path in ship_programs(SHIPPED, configs, platforms=options.platforms):
        print(f"{path.stat().st_size / 1e3:6.1f} kB  {path}")


if __name__ == "__main__":
    main()
