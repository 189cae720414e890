"""Options of ``jaxbox live``."""

import math
from typing import Annotated

import typer

from jaxbox._loopback import LOOPBACK
from jaxbox.cli.config_options import chosen_config, chosen_track_config
from jaxbox.cli.console import input_errors
from jaxbox.cli.live import LiveOptions, run_live
from jaxbox.cli.options import (
    AxesOption,
    ColumnsOption,
    FlipOption,
    LevelOption,
    MaxTracksOption,
    PresetOption,
    QuietOption,
    ScaleOption,
    SensorAtOption,
    SensorOption,
    SetOption,
    SettingsOption,
    TopicOption,
    TrackSetOption,
)
from jaxbox.io import InputError, PointConvention
from jaxbox.live import LiveConfig
from jaxbox.live.foxglove import PORT as FOXGLOVE_PORT
from jaxbox.live.loop import TIMEOUT_S
from jaxbox.live.page import PORT as PAGE_PORT
from jaxbox.run.pose_providers import ESTIMATED
from jaxbox.run.tracking import MAX_TRACKS, RATE_HZ

LIVE_EXAMPLES = """Examples:

jaxbox live drive.mcap --open

jaxbox live drive.mcap --foxglove

jaxbox live KITTI/training/velodyne/0000 --loop --json | jq '.boxes | length'

jaxbox live udp://0.0.0.0:2368 --sensor 16 --capacity 32768 --foxglove

jaxbox live 'udp://0.0.0.0?from=192.168.1.201&model=HDL64E_S3' --level --json

"""
AUTO = "auto"


def live(
    source: Annotated[
        str,
        typer.Argument(
            help="A recording, folder or pattern as `detect` takes it, at its own pace; udp://HOST:PORT for "
            "the packets of a Velodyne sensor; ouster://HOST; ros2://TOPIC; docs/live.md."
        ),
    ],
    *,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Serve points, boxes and trails to Foxglove (extra foxglove).")
    ] = False,
    foxglove_port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of that server; 0 takes a free one.")
    ] = FOXGLOVE_PORT,
    view: Annotated[
        bool, typer.Option("--view", help="Serve the viewer's page: boxes, trails, thresholds (extra view).")
    ] = False,
    view_port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of that page; 0 takes a free one.")
    ] = PAGE_PORT,
    open_browser: Annotated[
        bool, typer.Option("--open", help="Serve that page, and open the browser at it.")
    ] = False,
    host: Annotated[
        str,
        typer.Option(help="Address that servers listen at. The default is reached from this machine only."),
    ] = LOOPBACK,
    points: Annotated[bool, typer.Option("--points/--no-points", help="Serve the points, too.")] = True,
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Publish /jaxbox/detections and /jaxbox/markers in ROS 2.")
    ] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object a sweep, and a summary, as they come.")
    ] = False,
    track: Annotated[
        bool, typer.Option("--track/--no-track", help="Ids, velocities and states; or boxes alone.")
    ] = True,
    poses: Annotated[
        str,
        typer.Option(
            metavar="auto|kiss-icp|boxes|none",
            help="Where the sensor is. auto: kiss-icp where it is installed (extra track), else the boxes.",
        ),
    ] = AUTO,
    rate_hz: Annotated[float, typer.Option(help="Sweeps a second of a recording without times.")] = RATE_HZ,
    loop: Annotated[bool, typer.Option("--loop", help="Begin a recording again where it ends.")] = False,
    timeout: Annotated[
        float, typer.Option(help="Report a sensor that is silent for so long (s), and when it is back.")
    ] = TIMEOUT_S,
    confirmed: Annotated[
        bool, typer.Option("--confirmed/--all", help="Only vehicles that were found often enough, or all.")
    ] = False,
    min_score: Annotated[float, typer.Option(min=0.0, max=1.0, help="Leave out lower scores.")] = 0.0,
    preset: PresetOption = None,
    sensor: SensorOption = None,
    settings: SettingsOption = None,
    changes: SetOption = None,
    track_changes: TrackSetOption = None,
    max_tracks: MaxTracksOption = MAX_TRACKS,
    topic: TopicOption = None,
    sensor_at: SensorAtOption = None,
    level: LevelOption = False,
    scale: ScaleOption = 1.0,
    axes: AxesOption = "ros",
    flip: FlipOption = "",
    columns: ColumnsOption = None,
    capacity: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Points a sweep is padded to, and compiled for before the first. By default what it needs.",
        ),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Follow vehicles while a sensor runs, or a recording as if it did.

    The newest sweep wins: those that come while one is computed are skipped, and counted. The status line has
    the time from a sweep's last packet to its boxes. A sensor that stops is reported, and followed again when
    it is back. Ctrl-C ends it.
    """
    with input_errors():
        for name, value in (("--rate-hz", rate_hz), ("--timeout", timeout)):
            if not 0 < value < math.inf:
                raise typer.BadParameter(f"{name} is {value:g}; it must be positive and finite.")
        if poses not in (AUTO, *ESTIMATED):
            raise InputError(f"--poses {poses}: choose one of {', '.join((AUTO, *map(str, ESTIMATED)))}.")
        config = LiveConfig(
            detector=chosen_config(preset, settings, changes or [], sensor=sensor),
            tracker=chosen_track_config(track_changes or []) if track else None,
            poses=None if poses == AUTO else poses,
            max_tracks=max_tracks,
        )
        options = LiveOptions(
            config=config,
            topic=topic,
            convention=PointConvention(scale, axes, flip, columns),
            rate_hz=rate_hz,
            loop=loop,
            sensor_at=sensor_at,
            level=level,
            capacity=capacity,
            timeout_s=timeout,
            min_score=min_score,
            confirmed=confirmed,
            host=host,
            foxglove_port=foxglove_port if foxglove else None,
            page_port=view_port if view or open_browser else None,
            open_browser=open_browser,
            points=points,
            ros2=ros2,
            quiet=quiet,
            json=json,
        )
        raise typer.Exit(run_live(source, options))
