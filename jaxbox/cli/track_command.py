"""Options of ``jaxbox track``."""

import math
import pathlib
from typing import Annotated, Any

import typer

from jaxbox.cli.box_filter import (
    MIN_SCORE_METAVAR,
    BoxFilter,
    ClassesOption,
    WithinOption,
    parse_min_score,
)
from jaxbox.cli.config_options import chosen_config, chosen_track_config
from jaxbox.cli.console import input_errors
from jaxbox.cli.options import (
    AddressOption,
    AxesOption,
    CapacityOption,
    ColumnsOption,
    CropsOption,
    Engine,
    EngineOption,
    FlipOption,
    JsonOption,
    LevelOption,
    MaxTracksOption,
    PresetOption,
    QuietOption,
    ScaleOption,
    SensorAtOption,
    SensorOption,
    SetOption,
    SettingsOption,
    SheetOption,
    TopicOption,
    TrackSetOption,
)
from jaxbox.cli.ray_engine import check_local, check_ray
from jaxbox.cli.report import SHOWN_MIN_SCORE
from jaxbox.cli.track import TrackOptions, run_track
from jaxbox.cli.track_ray import TrackRayOptions, run_track_ray
from jaxbox.cli.track_results import TrackFormat
from jaxbox.io import PointConvention
from jaxbox.io.poses import AUTO
from jaxbox.run.pose_providers import ESTIMATED
from jaxbox.run.tracking import MAX_TRACKS, RATE_HZ

TRACK_EXAMPLES = """Examples:

jaxbox track KITTI/training --output tracks --video

jaxbox track drive.mcap --output tracks --format jsonl --format mcap --smooth

jaxbox track drive.bag --output tracks --poses odometry.txt --format csv

jaxbox track s3://bucket/drives --output s3://bucket/tracks --engine ray --address auto --resume

jaxbox track 'sweeps/*.pcd' --output tracks --rate-hz 20 --poses boxes --track-set max_misses=6

"""


def complete_poses(incomplete: str) -> list[str]:
    """Words that a shell proposes for ``--poses``.

    >>> complete_poses("b")
    ['boxes']
    """
    return [word for word in (AUTO, *map(str, ESTIMATED)) if word.startswith(incomplete)]


def track(
    paths: Annotated[
        list[str], typer.Argument(help="What `detect` takes; each folder or recording is a drive.")
    ],
    *,
    output: Annotated[
        str,
        typer.Option(metavar="FOLDER", help="For results, pictures and videos; with ray a URL will do."),
    ],
    poses: Annotated[
        str,
        typer.Option(
            metavar="auto|kiss-icp|boxes|none|FILE",
            help="Where the sensor was. auto: what the data set or recording holds, else kiss-icp (extra "
            "track), else the boxes. FILE: a text file, or a folder of one a drive; docs/formats.md.",
            autocompletion=complete_poses,
        ),
    ] = AUTO,
    rate_hz: Annotated[
        float, typer.Option(help="Sweeps a second, where nothing says when they were taken.")
    ] = RATE_HZ,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Look at the whole drive first: smoother, and gaps are filled.")
    ] = False,
    result_format: Annotated[
        list[TrackFormat] | None,
        typer.Option("--format", help="What to write; repeatable. By default kitti, or with ray parquet."),
    ] = None,
    video: Annotated[
        bool, typer.Option("--video", help="A video of each drive: from above, and the camera's image.")
    ] = False,
    gif: Annotated[
        bool, typer.Option("--gif", help="The same as a small animated GIF of at most 100 pictures.")
    ] = False,
    sheet: SheetOption = True,
    crops: CropsOption = False,
    pictures: Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw each sweep.")] = False,
    points: Annotated[
        bool | None,
        typer.Option(
            "--points/--no-points", help="Put the points into MCAP and rerun files too. By default yes."
        ),
    ] = None,
    confirmed: Annotated[
        bool,
        typer.Option(
            "--confirmed/--all", help="Write only vehicles that were found often enough, or all of them."
        ),
    ] = False,
    coasting: Annotated[
        bool,
        typer.Option(
            "--coasting",
            help="KITTI text holds vehicles too that are hidden or were missed in the sweep. The other "
            "formats say which these are; with --smooth text has them in any case.",
        ),
    ] = False,
    min_score: Annotated[
        str | None,
        typer.Option(
            metavar=MIN_SCORE_METAVAR,
            help="Leave out lower scores, of all or by class. Unless given, KITTI text holds what scores "
            f"{SHOWN_MIN_SCORE:g} or more; pictures never show less.",
        ),
    ] = None,
    classes: ClassesOption = None,
    within: WithinOption = None,
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
    capacity: CapacityOption = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Processes that detect; results do not depend on it. By default 1. With ray those that "
            "track, each a drive of its own; by default one a core.",
        ),
    ] = None,
    engine: EngineOption = Engine.LOCAL,
    address: AddressOption = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Pass over drives whose results in OUTPUT are complete.")
    ] = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Follow vehicles through drives: ids, velocities, headings, and what they do.

    Results are OUTPUT/DRIVE.txt (kitti), .jsonl, .parquet, .csv, .mcap (for Foxglove), .rrd (for rerun) and
    .mp4, pictures OUTPUT/pictures/SWEEP_tracks.png. Every file is written whole or not at all. The exact
    settings are in OUTPUT/config.toml, those of the tracker, versions and failures in OUTPUT/run.json. A
    broken sweep is reported and the others go on; of an interrupted drive there is what was done. With
    --engine ray, paths and OUTPUT may be URLs, results are OUTPUT/DRIVE.parquet, OUTPUT/manifest.json tells
    what became of every sweep, and an interrupted drive has no file.
    """
    with input_errors():
        if not 0 < rate_hz < math.inf:
            raise typer.BadParameter(f"--rate-hz is {rate_hz:g}; give sweeps a second, such as 10.")
        convention = PointConvention(scale, axes, flip, columns)
        least, by_class = (0.0, {}) if min_score is None else parse_min_score(min_score)
        common: dict[str, Any] = {
            "config": chosen_config(preset, settings, changes or [], sensor=sensor),
            "track_config": chosen_track_config(track_changes or []),
            "poses": poses,
            "rate_hz": rate_hz,
            "max_tracks": max_tracks,
            "smooth": smooth,
            "confirmed": confirmed,
            "topic": topic,
            "capacity": capacity,
            "min_score": least,
            "resume": resume,
            "quiet": quiet,
            "json": json,
        }
        keep = BoxFilter.chosen(classes=classes, within=within, min_scores=by_class)
        if engine is Engine.RAY:
            kept = {"--classes": classes, "--within": within, "--min-score by class": by_class}
            drawn = {"--pictures": pictures, "--video": video, "--gif": gif, "--crops": crops}
            other = kept | drawn | {"--coasting": coasting, "--level": level, "--sensor-at": sensor_at}
            check_ray(other, formats=result_format, points=points, convention=convention)
            ray_options = TrackRayOptions(
                output=output,
                address=address,
                jobs=jobs,
                **common,
            )
            raise typer.Exit(run_track_ray(paths, ray_options))
        check_local(output, address)
        options = TrackOptions(
            output=pathlib.Path(output),
            formats=frozenset(result_format or [TrackFormat.KITTI]),
            keep=keep,
            crops=crops,
            coasting=coasting,
            text_min_score=SHOWN_MIN_SCORE if min_score is None else least,
            pictures=pictures,
            video=video,
            sheet=sheet,
            gif=gif,
            points=True if points is None else points,
            sensor_at=sensor_at,
            level=level,
            convention=convention,
            jobs=jobs or 1,
            **common,
        )
        raise typer.Exit(run_track(paths, options))
