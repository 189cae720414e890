"""``jaxbox detect --engine ray``: the sweeps of an archive by the workers of a Ray cluster, to Parquet."""

import dataclasses
from collections.abc import Sequence

from jaxbox.cli.console import ExitCode
from jaxbox.cli.ray_engine import RayOptions, run_on_ray
from jaxbox.cluster import detect_dataset


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectRayOptions(RayOptions):
    """The options of ``jaxbox detect`` that this engine takes; the command's help explains them."""

    sweeps_per_partition: int
    """Size of the partitions."""


def run_detect_ray(paths: Sequence[str], options: DetectRayOptions) -> ExitCode:
    """Detects in all sweeps of some paths and URLs.

    Args:
      paths: what `jaxbox.cluster.detect_dataset` takes.
      options: the command's options.

    Returns:
      As `run_on_ray`.

    Raises:
      InputError: where there are no sweeps, or the options cannot be used.
      ImportError: without the extra ``ray``.
    """
    return run_on_ray(
        options,
        lambda on_report: detect_dataset(
            paths,
            options.output,
            options.config,
            sweeps_per_partition=options.sweeps_per_partition,
            on_report=on_report,
            **options.common(),
        ),
    )
