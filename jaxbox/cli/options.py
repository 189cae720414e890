"""Options that several commands share, and what they say at the end of their help."""

import enum
import math
import pathlib
from typing import Annotated

import typer

from jaxbox.cli.config_options import complete_preset, complete_setting, complete_track_setting

EXIT_CODES = (
    "Exit codes: 0 all went well; 1 some sweeps failed, the others are done; 2 the input or an option cannot "
    "be used, or results cannot be written; 130 it was interrupted, and what is done is whole."
)


class Engine(enum.StrEnum):
    """What a command runs on."""

    LOCAL = "local"
    RAY = "ray"


EngineOption = Annotated[
    Engine, typer.Option(help="ray: workers of a Ray cluster, or of this machine; docs/cluster.md.")
]
AddressOption = Annotated[
    str | None, typer.Option(help="Of the Ray cluster, such as auto; by default one is started here.")
]
PresetOption = Annotated[
    str | None,
    typer.Option(
        help="Settings to start from: default, accurate (twice the time), fast, or paper (its choices).",
        autocompletion=complete_preset,
    ),
]
SensorOption = Annotated[
    int | None,
    typer.Option(
        metavar="BEAMS", help="Fit the preset to a sensor: 16, 32, 64 or 128 beams; `info FILE` says which."
    ),
]
SettingsOption = Annotated[
    pathlib.Path | None,
    typer.Option(
        "--config",
        "--settings",
        help="Settings file: TOML, or JSON such as best.json of `tune`; docs/settings.md.",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="FIELD=VALUE",
        help="Change one setting by its name; repeatable.",
        autocompletion=complete_setting,
    ),
]
TrackSetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--track-set",
        metavar="FIELD=VALUE",
        help="Change one setting of the tracker by its name; repeatable.",
        autocompletion=complete_track_setting,
    ),
]
MaxTracksOption = Annotated[int, typer.Option(min=1, help="Vehicles at a time.")]
TopicOption = Annotated[str | None, typer.Option(help="Topic of the points, for recordings of several.")]


def _finite_position(position: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
    if position is not None and not all(map(math.isfinite, position)):
        raise typer.BadParameter(f"{' '.join(map(str, position))}: give three finite numbers, in metres.")
    return position


SensorAtOption = Annotated[
    tuple[float, float, float] | None,
    typer.Option(
        metavar="X Y Z",
        callback=_finite_position,
        help="Where the sensor is in the points' frame (m), if not at 0 0 0.",
    ),
]
LevelOption = Annotated[
    bool, typer.Option("--level", help="Measure how the sensor is tilted, and see the sweeps upright.")
]
ScaleOption = Annotated[
    float, typer.Option(help="Metres of the points' unit: 0.001 for millimetres, 0.3048 for feet.")
]
AxesOption = Annotated[
    str,
    typer.Option(
        metavar="ros|camera|ned|enu|X,Y,Z",
        help="The points' axes: camera is x right, y down, z forward; ned y right, z down; enu x right, y "
        "forward; or x, y, z by theirs, as -y,x,z.",
    ),
]
FlipOption = Annotated[
    str, typer.Option(metavar="AXES", help="Mirror axes, as z or xy, after --axes; for left-handed sources.")
]
ColumnsOption = Annotated[
    int | None, typer.Option(help="float32 a point in .bin files; by default the numbers tell 4, 5 and 6.")
]
CapacityOption = Annotated[
    int | None,
    typer.Option(min=1, help="Points a sweep is padded to; by default what it needs. One compile each."),
]
CropsOption = Annotated[
    bool, typer.Option("--crops", help="Write the points in each box: OUTPUT/crops/SWEEP_NUMBER.pcd.")
]
SheetOption = Annotated[
    bool,
    typer.Option(
        "--contact-sheet/--no-contact-sheet",
        help="One picture of sweeps from all over the run: OUTPUT/contact_sheet.png.",
    ),
]
QuietOption = Annotated[bool, typer.Option("--quiet", help="Print only what went wrong.")]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON object a sweep, and a summary, for scripts.")
]
DrivesOption = Annotated[
    pathlib.Path | None, typer.Option(help='Text file of the drive of each frame: "frame drive" a line.')
]
