"""``jaxbox track --engine ray``: the drives of an archive by the workers of a Ray cluster, to Parquet."""

import dataclasses
from collections.abc import Sequence

from jaxbox.cli.console import ExitCode
from jaxbox.cli.ray_engine import RayOptions, run_on_ray
from jaxbox.cluster import track_dataset
from jaxbox.config import TrackConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackRayOptions(RayOptions):
    """The options of ``jaxbox track`` that this engine takes; the command's help explains them."""

    track_config: TrackConfig
    """The tracker's settings."""
    poses: str
    """As `jaxbox.io.poses.choose_poses` takes them."""
    rate_hz: float
    """Sweeps a second where nothing says when they were taken."""
    max_tracks: int
    """Vehicles at a time."""
    smooth: bool
    """Whether the whole drive is looked at before anything is written."""
    confirmed: bool
    """Whether only confirmed tracks are written."""


def run_track_ray(paths: Sequence[str], options: TrackRayOptions) -> ExitCode:
    """Tracks the vehicles of all drives of some paths and URLs.

    Args:
      paths: what `jaxbox.cluster.track_dataset` takes.
      options: the command's options.

    Returns:
      As `run_on_ray`.

    Raises:
      InputError: where there are no sweeps, or the options cannot be used.
      ImportError: without the extra ``ray``.
    """
    return run_on_ray(
        options,
        lambda on_report: track_dataset(
            paths,
            options.output,
            options.config,
            options.track_config,
            poses=options.poses,
            rate_hz=options.rate_hz,
            max_tracks=options.max_tracks,
            smooth=options.smooth,
            confirmed=options.confirmed,
            on_report=on_report,
            **options.common(),
        ),
    )
