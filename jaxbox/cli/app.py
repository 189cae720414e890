"""The commands and their options; the work is done in the module of each."""

import pathlib
from typing import Annotated

import typer

from jaxbox._loopback import LOOPBACK
from jaxbox._version import __version__
from jaxbox.cli.box_filter import (
    MIN_SCORE_METAVAR,
    BoxFilter,
    ClassesOption,
    WithinOption,
    parse_min_score,
)
from jaxbox.cli.config_options import chosen_config, chosen_preset
from jaxbox.cli.console import cache_warnings, input_errors, stdout
from jaxbox.cli.demo import run_demo
from jaxbox.cli.detect import DetectOptions, ResultFormat, run_detect
from jaxbox.cli.detect_ray import DetectRayOptions, run_detect_ray
from jaxbox.cli.eval_command import evaluate
from jaxbox.cli.export import Platform, run_export
from jaxbox.cli.info import print_info
from jaxbox.cli.live_command import LIVE_EXAMPLES, live
from jaxbox.cli.options import (
    EXIT_CODES,
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
    PresetOption,
    QuietOption,
    ScaleOption,
    SensorAtOption,
    SensorOption,
    SetOption,
    SettingsOption,
    SheetOption,
    TopicOption,
)
from jaxbox.cli.ray_engine import check_local, check_ray
from jaxbox.cli.report import SHOWN_MIN_SCORE
from jaxbox.cli.sweep_info import print_sweep_info
from jaxbox.cli.threads import compute_on_one_thread
from jaxbox.cli.track_command import TRACK_EXAMPLES, track
from jaxbox.cli.tune import TuneOptions, run_tune
from jaxbox.cli.view import ViewOptions, run_view
from jaxbox.cluster.dataset import SWEEPS_PER_PARTITION
from jaxbox.evaluation.copies import COPIES
from jaxbox.evaluation.objectives import OBJECTIVES
from jaxbox.io import InputError, PointConvention, open_sweeps
from jaxbox.run.cache import enable_cache

DETECT_EXAMPLES = """Examples:

jaxbox detect KITTI/training --output out

jaxbox detect drive.bag --topic /velodyne_points --output out --format mcap

jaxbox detect 'clouds/*.pcd' --output out --format parquet --format jsonl --no-pictures

jaxbox detect drive.mcap --output out --format parquet --resume

jaxbox detect 'drives/**/*.bin' --output out --no-pictures --jobs 8

jaxbox detect s3://bucket/drives --output s3://bucket/boxes --engine ray --address auto --resume

jaxbox detect sweep.pcd --output out --config my.toml --set vehicles.min_score=0.1 --json

"""

VIEW_EXAMPLES = """Examples:

jaxbox view KITTI/training

jaxbox view drive.bag --topic /velodyne_points --preset fast

jaxbox view 'clouds/*.pcd' --config my.toml --port 0 --open

jaxbox view drive.bag --compare fast

"""

app = typer.Typer(
    name="jaxbox",
    help="Training-free LiDAR vehicle detection: sweeps in, oriented 3D boxes out.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _show_version(wanted: bool) -> None:
    if wanted:
        stdout().print(__version__)
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    compute_on_one_thread()
    with cache_warnings():
        enable_cache()


@app.command(epilog=EXIT_CODES)
def demo(
    *,
    output: Annotated[pathlib.Path, typer.Option(help="Folder for the pictures.")] = pathlib.Path("out"),
    seed: Annotated[int, typer.Option(min=0, help="Of the scene: another number, another street.")] = 0,
) -> None:
    """Detect vehicles in a built-in ray-cast sweep and compare them with the exact truth."""
    with input_errors():
        run_demo(output, seed=seed, console=stdout())


@app.command(epilog=DETECT_EXAMPLES + EXIT_CODES)
def detect(
    paths: Annotated[
        list[str],
        typer.Argument(
            help="Sweeps (.bin .pcd.bin .pcd .ply .las .laz .npy .npz .feather .parquet .txt .csv .xyz), "
            "recordings (.bag .db3 .mcap .pcap .pcapng .osf, ROS 2 folders), folders of them, data sets' "
            "folders, or patterns in quotes; docs/formats.md.",
        ),
    ],
    *,
    output: Annotated[
        str, typer.Option(metavar="FOLDER", help="For results and pictures; with ray a URL will do.")
    ],
    preset: PresetOption = None,
    sensor: SensorOption = None,
    settings: SettingsOption = None,
    changes: SetOption = None,
    result_format: Annotated[
        list[ResultFormat] | None,
        typer.Option(
            "--format",
            help="What to write; repeatable. both: kitti and jsonl. By default kitti, or with ray parquet.",
        ),
    ] = None,
    topic: TopicOption = None,
    sensor_at: SensorAtOption = None,
    level: LevelOption = False,
    scale: ScaleOption = 1.0,
    axes: AxesOption = "ros",
    flip: FlipOption = "",
    columns: ColumnsOption = None,
    capacity: CapacityOption = None,
    min_score: Annotated[
        str,
        typer.Option(
            metavar=MIN_SCORE_METAVAR,
            help="Leave out lower scores, of all or by class. 0 keeps all, as `eval` wants it; "
            f"pictures and counts never show less than {SHOWN_MIN_SCORE:g}.",
        ),
    ] = "0",
    classes: ClassesOption = None,
    within: WithinOption = None,
    points: Annotated[
        bool | None,
        typer.Option(
            "--points/--no-points", help="Put the points into MCAP and rerun files too. By default yes."
        ),
    ] = None,
    pictures: Annotated[
        bool | None,
        typer.Option(
            "--pictures/--no-pictures", help="Draw pictures of each sweep. By default yes, but not with ray."
        ),
    ] = None,
    sheet: SheetOption = True,
    crops: CropsOption = False,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Processes that read, detect and draw; results do not depend on it. By default 1, or with "
            "ray one a core.",
        ),
    ] = None,
    engine: EngineOption = Engine.LOCAL,
    address: AddressOption = None,
    sweeps_per_partition: Annotated[
        int | None,
        typer.Option(
            min=1, help=f"Sweeps of each Parquet file, with ray; {SWEEPS_PER_PARTITION} by default."
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Pass over sweeps whose results in OUTPUT are complete.")
    ] = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Detect vehicles in real sweeps: writes result files and pictures.

    Results are OUTPUT/NAME.txt (kitti) or OUTPUT/detections.jsonl, .parquet, .mcap (for Foxglove) and .rrd
    (for rerun), pictures OUTPUT/pictures/NAME_*.png. Every file is written whole or not at all. The exact
    settings are in OUTPUT/config.toml, versions and failures in OUTPUT/run.json. A broken sweep is reported
    and the others go on. With --engine ray, paths and OUTPUT may be URLs, results are OUTPUT/part-*.parquet,
    and OUTPUT/manifest.json tells what became of every sweep.
    """
    with input_errors():
        config = chosen_config(preset, settings, changes or [], sensor=sensor)
        least, by_class = parse_min_score(min_score)
        keep = BoxFilter.chosen(classes=classes, within=within, min_scores=by_class)
        convention = PointConvention(scale, axes, flip, columns)
        if engine is Engine.RAY:
            kept, drawn = (
                {"--classes": classes, "--within": within, "--min-score by class": by_class},
                {"--pictures": pictures, "--crops": crops},
            )
            other = kept | drawn | {"--level": level, "--sensor-at": sensor_at}
            check_ray(other, formats=result_format, points=points, convention=convention)
            ray_options = DetectRayOptions(
                output=output,
                config=config,
                address=address,
                jobs=jobs,
                sweeps_per_partition=sweeps_per_partition or SWEEPS_PER_PARTITION,
                topic=topic,
                capacity=capacity,
                min_score=least,
                resume=resume,
                quiet=quiet,
                json=json,
            )
            raise typer.Exit(run_detect_ray(paths, ray_options))
        check_local(output, address)
        if sweeps_per_partition is not None:
            raise InputError(
                "--sweeps-per-partition: only --engine ray writes partitions; add it, or leave this out."
            )
        options = DetectOptions(
            output=pathlib.Path(output),
            config=config,
            formats=frozenset(result_format or [ResultFormat.KITTI]),
            topic=topic,
            sensor_at=sensor_at,
            level=level,
            convention=convention,
            capacity=capacity,
            min_score=least,
            keep=keep,
            crops=crops,
            sheet=sheet,
            points=True if points is None else points,
            pictures=True if pictures is None else pictures,
            jobs=jobs or 1,
            resume=resume,
            quiet=quiet,
            json=json,
        )
        raise typer.Exit(run_detect(paths, options))


app.command(epilog=TRACK_EXAMPLES + EXIT_CODES)(track)
app.command(epilog=LIVE_EXAMPLES + EXIT_CODES)(live)
app.command("eval", epilog=EXIT_CODES)(evaluate)


@app.command(epilog=EXIT_CODES)
def tune(
    *,
    labels: Annotated[
        list[pathlib.Path],
        typer.Option(
            help="A labelled KITTI folder, or that of an annotation tool; repeat it to pool several."
        ),
    ],
    output: Annotated[pathlib.Path, typer.Option(help="Folder for the report and the best settings.")],
    search: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FIELD=LOW:HIGH[:log]",
            help="Range of one traced setting; repeatable. Without any, the main thresholds round the base.",
        ),
    ] = None,
    trials: Annotated[int, typer.Option(min=1, help="Settings to try, the base among them.")] = 100,
    refine: Annotated[
        int, typer.Option(min=0, help="How many of them are steps round the best, chosen by all labels.")
    ] = 0,
    copies: Annotated[
        int, typer.Option(min=1, max=len(COPIES), help="Turned and mirrored copies of each sweep.")
    ] = 4,
    objective: Annotated[str, typer.Option(help=f"One of {', '.join(OBJECTIVES)}; R40.")] = "soft",
    drives: Annotated[
        pathlib.Path | None,
        typer.Option(
            help='Text file of the drive of each frame: "frame drive" a line. Without it, drives.txt in or '
            "beside each labelled folder."
        ),
    ] = None,
    preset: PresetOption = None,
    sensor: SensorOption = None,
    settings: SettingsOption = None,
    changes: SetOption = None,
    scale: ScaleOption = 1.0,
    axes: AxesOption = "ros",
    flip: FlipOption = "",
    columns: ColumnsOption = None,
    seed: Annotated[int, typer.Option(min=0, help="Another number tries other settings.")] = 0,
) -> None:
    """Search settings on labelled sweeps, and evaluate them on held-out drives.

    Thresholds are traced: every trial runs in one compiled program. Each drive is scored with the setting
    that the other drives chose. Interrupted, it reports what is done and ends with exit code 130. Use the
    result with `jaxbox detect --config OUTPUT/best.json`.
    """
    with input_errors():
        if objective not in OBJECTIVES:
            raise InputError(f"--objective {objective}: choose one of {', '.join(OBJECTIVES)}.")
        config = chosen_config(preset, settings, changes or [], sensor=sensor)
        options = TuneOptions(
            output=output,
            preset=chosen_preset(preset, settings),
            config=config,
            search=search or [],
            trials=trials,
            refine=refine,
            copies=copies,
            objective=objective,
            drives=drives,
            convention=PointConvention(scale, axes, flip, columns),
            seed=seed,
        )
        raise typer.Exit(run_tune(labels, options, stdout()))


@app.command(epilog=EXIT_CODES)
def export(
    *,
    output: Annotated[pathlib.Path, typer.Option(help="Folder for the files.")],
    capacity: Annotated[int, typer.Option(min=1, help="Points that a sweep is padded to.")] = 2**17,
    preset: PresetOption = None,
    sensor: SensorOption = None,
    settings: SettingsOption = None,
    changes: SetOption = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the random key inside.")] = 0,
    platforms: Annotated[
        list[Platform] | None,
        typer.Option("--platform", help="Repeatable. By default what JAX runs on here."),
    ] = None,
) -> None:
    """Write the detector as StableHLO, to run without jaxbox's source: in JAX, or in C++.

    One capacity, with its settings and random key inside. docs/export.md tells how to run it.
    """
    with input_errors():
        config = chosen_config(preset, settings, changes or [], sensor=sensor)
        run_export(output, config, capacity=capacity, seed=seed, platforms=platforms or [], console=stdout())


@app.command(epilog=EXIT_CODES)
def info(
    paths: Annotated[
        list[str] | None, typer.Argument(help="What `detect` takes; none for versions and presets.")
    ] = None,
    *,
    topic: TopicOption = None,
    scale: ScaleOption = 1.0,
    axes: AxesOption = "ros",
    flip: FlipOption = "",
    columns: ColumnsOption = None,
    num_sweeps: Annotated[
        int, typer.Option("--sweeps", min=1, help="Sweeps to look at, spread over all there are.")
    ] = 1,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")] = False,
) -> None:
    """Say what a sweep looks like, and which settings fit it; or print versions, devices and presets.

    Points, range, height, beams, missing values, the sensor's height and tilt, and the capacities that
    sweeps like these need, as a settings file for --config.
    """
    with input_errors():
        if paths:
            sweeps = open_sweeps(paths, topic=topic, convention=PointConvention(scale, axes, flip, columns))
            print_sweep_info(sweeps, num_sweeps=num_sweeps, as_json=json, console=stdout())
        else:
            print_info(stdout(), as_json=json)


@app.command(epilog=VIEW_EXAMPLES + EXIT_CODES)
def view(
    paths: Annotated[list[str], typer.Argument(help="What `detect` takes.")],
    *,
    host: Annotated[
        str, typer.Option(help="Address to listen at. The default is reached from this machine only.")
    ] = LOOPBACK,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes a free one.")] = 8080,
    open_browser: Annotated[bool, typer.Option("--open", help="Open the browser at the page.")] = False,
    track: Annotated[
        bool, typer.Option("--track", help="Show tracks: ids, states, trails. The page has a switch, too.")
    ] = False,
    compare: Annotated[
        str | None,
        typer.Option(metavar="PRESET|FILE|PATH", help="Other settings or sweeps to show beside these."),
    ] = None,
    light: Annotated[bool, typer.Option("--light", help="A light page; it has a switch, too.")] = False,
    preset: PresetOption = None,
    sensor: SensorOption = None,
    settings: SettingsOption = None,
    changes: SetOption = None,
    topic: TopicOption = None,
    sensor_at: SensorAtOption = None,
    level: LevelOption = False,
    scale: ScaleOption = 1.0,
    axes: AxesOption = "ros",
    flip: FlipOption = "",
    columns: ColumnsOption = None,
    capacity: CapacityOption = None,
    min_score: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, help="Boxes that score less are hidden at first."),
    ] = SHOWN_MIN_SCORE,
    classes: ClassesOption = None,
    within: WithinOption = None,
) -> None:
    """Show sweeps and boxes in the browser, and move thresholds live (the view extra).

    A page with the points, boxes, hulls and labels in 3D, the camera's image, a timeline, and sliders that
    detect again without compiling. "copy settings" gives the TOML for `detect --config`.
    """
    with input_errors():
        options = ViewOptions(
            config=chosen_config(preset, settings, changes or [], sensor=sensor),
            host=host,
            port=port,
            topic=topic,
            sensor_at=sensor_at,
            level=level,
            convention=PointConvention(scale, axes, flip, columns),
            capacity=capacity,
            min_score=min_score,
            keep=BoxFilter.chosen(classes=classes, within=within),
            track=track,
            open_browser=open_browser,
            light=light,
            compare=compare,
            sensor=sensor,
        )
        raise typer.Exit(run_view(paths, options, stdout()))
