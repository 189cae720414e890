"""``jaxbox view``: sweeps, boxes and thresholds on an interactive page."""

import dataclasses
import itertools
import pathlib
import webbrowser
from collections.abc import Sequence

from rich.console import Console

from jaxbox import io
from jaxbox._interrupts import heard, stoppable
from jaxbox._loopback import LOOPBACK_NAMES
from jaxbox.cli.box_filter import EVERY_BOX, BoxFilter
from jaxbox.cli.config_options import chosen_config
from jaxbox.cli.console import ExitCode, counted, print_warning, stderr
from jaxbox.cli.mounted import describe_mounting, seen_from_sensor
from jaxbox.config import DetectorConfig
from jaxbox.viewer import Comparison, View, Wanted, open_viewer

APART_M = 80.0
"""Two recordings are drawn so far from each other: farther than most boxes are found to the side."""
SETTINGS_SUFFIXES = (".toml", ".json")
"""Endings of files of settings; no sweeps have them."""


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
    keep: BoxFilter = EVERY_BOX
    """Which boxes and tracks are shown."""
    track: bool
    """Whether tracks are shown at first."""
    open_browser: bool
    """Whether the browser is opened at the page."""
    light: bool = False
    """Whether the page is light at first, and not dark."""
    compare: str | None = None
    """A preset, a file of settings, or sweeps to show with these; None for nothing."""
    sensor: int | None = None
    """Number of beams that a compared preset is fitted to, too."""


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
    sweeps = _open_sweeps(paths, options, console)
    comparison = _comparison(paths, options, console)
    wanted = initial_wish(options.config, min_score=options.min_score, track=options.track)
    apart_m = APART_M if comparison is not None and comparison.sweeps is not None else 0.0
    view = dataclasses.replace(wanted.view, light=options.light, apart_m=apart_m)
    with open_viewer(
        sweeps,
        wanted=dataclasses.replace(wanted, view=view),
        host=options.host,
        port=options.port,
        capacity=options.capacity,
        comparison=comparison,
        keep=options.keep,
    ) as (viewer, url):
        _announce(url, options, len(sweeps), console)
        try:
            with stoppable():
                viewer.run()
        except KeyboardInterrupt:
            heard()
            stderr().print("stopped")
    return ExitCode.OK


def _open_sweeps(paths: Sequence[str], options: ViewOptions, console: Console) -> Sequence[io.Sweep]:
    sweeps, mounting = seen_from_sensor(
        io.open_sweeps(paths, topic=options.topic, convention=options.convention),
        sensor_at=options.sensor_at,
        level=options.level,
    )
    if options.level and mounting is not None:
        console.print(describe_mounting(mounting), markup=False)
    return sweeps


def _comparison(paths: Sequence[str], options: ViewOptions, console: Console) -> Comparison | None:
    """What ``--compare`` names."""
    name = options.compare
    if name is None:
        return None
    if name in DetectorConfig.presets():
        return Comparison(title=name, config=chosen_config(name, None, [], sensor=options.sensor))
    if name.endswith(SETTINGS_SUFFIXES):
        file = pathlib.Path(name)
        return Comparison(title=file.name, config=chosen_config(None, file, [], sensor=options.sensor))
    try:
        sweeps = _open_sweeps([name], options, console)
    except io.InputError as error:
        presets = ", ".join(DetectorConfig.presets())
        raise io.InputError(
            f"--compare: {error} It takes a preset ({presets}), settings (.toml), or sweeps."
        ) from error
    title, of = distinct_names(name, paths[0])
    return Comparison(title=title, sweeps=sweeps, of=of)


def distinct_names(path: str, other: str) -> tuple[str, str]:
    """Two paths without the folders that both begin with.

    Args:
      path: one.
      other: another.

    Returns:
      What tells them apart; the last part where nothing does.

    >>> distinct_names("/data/drives/0000/lidar", "/data/drives/0003/lidar")
    ('0000/lidar', '0003/lidar')
    """
    parts, others = pathlib.PurePath(path).parts, pathlib.PurePath(other).parts
    same = list(itertools.takewhile(lambda pair: pair[0] == pair[1], zip(parts, others, strict=False)))
    names = [pathlib.PurePath(*each[min(len(same), len(each) - 1) :]) for each in (parts, others)]
    return str(names[0]), str(names[1])


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


def warn_of_watchers(host: str) -> None:
    """Says who can see what is served at an address, where that is not this machine alone.

    Args:
      host: that a server listens at.
    """
    if host not in LOOPBACK_NAMES:
        print_warning(
            f"at {host} everybody who can reach this machine sees the sweeps; docs/viewer.md tells how to "
            "forward a port instead."
        )


def _announce(url: str, options: ViewOptions, num_sweeps: int, console: Console) -> None:
    console.print(f"{counted(num_sweeps, 'sweep')} at {url} (Ctrl-C ends it)", markup=False)
    warn_of_watchers(options.host)
    if options.open_browser:
        webbrowser.open(url)
