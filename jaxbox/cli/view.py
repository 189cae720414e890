"""``jaxbox view``: sweeps, boxes and thresholds on an interactive page."""

import dataclasses
import webbrowser
from collections.abc import Sequence

from rich.console import Console

from jaxbox import io
from jaxbox._interrupts import heard, stoppable
from jaxbox.cli.console import ExitCode, stderr
from jaxbox.cli.mounted import describe_mounting, seen_from_sensor
from jaxbox.config import DetectorConfig
from jaxbox.viewer import View, Wanted, open_viewer
from jaxbox.viewer.server import LOOPBACK_NAMES


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """The options of ``jaxbox view``; the command's help explains them."""

    config: DetectorConfig
    """The detector's settings to start from."""
    host: str
    """Address to listen at."""
    port: int
    """Port; 0 takes a free one."""
    topic: str | None
    """Topic of the points in recordings."""
    sensor_at: tuple[float, float, float] | None
    """Where the sensor is in the frame of the points, m; None for the origin."""
    level: bool
    """Whether its tilt is measured, and the sweeps are seen upright."""
    convention: io.PointConvention
    """How the numbers of the points are to be taken."""
    capacity: int | None
    """Points a sweep is padded to, or None for what it needs."""
    min_score: float
    """Boxes of lower scores are hidden at first."""
    track: bool
    """Whether tracks are shown at first."""
    open_browser: bool
    """Whether the browser is opened at the page."""


def run_view(paths: Sequence[str], options: ViewOptions, console: Console) -> ExitCode:
    """Shows sweeps until it is interrupted (Ctrl-C or SIGTERM).

    Args:
      paths: what `jaxbox.io.open_sweeps` takes.
      options: the command's options.
      console: where the address goes.

    Returns:
      `ExitCode.OK`.

    Raises:
      InputError: where a path holds no sweeps, or none with a ground to level by, or the address cannot be
        listened at.
      ImportError: without the extra ``view``.
    """
    sweeps, mounting = seen_from_sensor(
        io.open_sweeps(paths, topic=options.topic, convention=options.convention),
        sensor_at=options.sensor_at,
        level=options.level,
    )
    if options.level and mounting is not None:
        console.print(describe_mounting(mounting), markup=False)
    wanted = initial_wish(options.config, min_score=options.min_score, track=options.track)
    with open_viewer(
        sweeps, wanted=wanted, host=options.host, port=options.port, capacity=options.capacity
    ) as (viewer, url):
        _announce(url, options, len(sweeps), console)
        try:
            with stoppable():
                viewer.run()
        except KeyboardInterrupt:
            heard()
            stderr().print("stopped")
    return ExitCode.OK


def initial_wish(config: DetectorConfig, *, min_score: float, track: bool = False) -> Wanted:
    """The first sweep with some settings, by the name of their preset where they are one.

    Args:
      config: the settings.
      min_score: boxes of lower scores are hidden.
      track: whether tracks are shown.

    Returns:
      What a page begins with.

    >>> initial_wish(DetectorConfig.paper(), min_score=0.2).preset
    'paper'
    """
    view = View(min_score=min_score, tracks=track)
    for name, preset in DetectorConfig.presets().items():
        if preset == config:
            return Wanted(preset=name, view=view)
    return Wanted(preset=None, given=config, view=view)


def _announce(url: str, options: ViewOptions, num_sweeps: int, console: Console) -> None:
    noun = "sweep" if num_sweeps == 1 else "sweeps"
    console.print(f"{num_sweeps} {noun} at {url} (Ctrl-C ends it)", markup=False)
    if options.host not in LOOPBACK_NAMES:
        stderr().print(
            f"warning: at {options.host} everybody who can reach this machine sees the sweeps; "
            "docs/viewer.md tells how to forward a port instead.",
            markup=False,
        )
    if options.open_browser:
        webbrowser.open(url)
