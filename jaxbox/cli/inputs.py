"""What `detect` and `track` have in common: their options, the sweeps that are meant, and the account."""

import dataclasses
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from jaxbox import io
from jaxbox._files import check_no_link
from jaxbox.cli.box_filter import EVERY_BOX, BoxFilter
from jaxbox.cli.console import stdout
from jaxbox.cli.crops import CROP_FOLDER
from jaxbox.cli.mounted import describe_mounting, seen_from_sensor
from jaxbox.cli.report import SHOWN_MIN_SCORE
from jaxbox.cli.results import RUN_NAME, RunAccount, written
from jaxbox.config import DetectorConfig

PICTURE_FOLDER = "pictures"
"""Folder of the pictures, in that of the results."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of a command that goes through sweeps and writes results."""

    output: pathlib.Path
    """Folder for results and pictures."""
    config: DetectorConfig
    """The detector's settings."""
    topic: str | None = None
    """Topic of the points in recordings."""
    sensor_at: tuple[float, float, float] | None = None
    """Where the sensor is in the frame of the points, m; None for the origin."""
    level: bool = False
    """Whether its tilt is measured, and the sweeps are seen upright."""
    convention: io.PointConvention = io.ORDINARY
    """How the numbers of the points are to be taken."""
    capacity: int | None = None
    """Points a sweep is padded to, or None for what it needs."""
    min_score: float = 0.0
    """Boxes with lower scores are dropped."""
    keep: BoxFilter = EVERY_BOX
    """Which other boxes are dropped."""
    crops: bool = False
    """Whether the points in each box are written."""
    sheet: bool = False
    """Whether there is a contact sheet of the run."""
    resume: bool
    """Whether what has complete results is passed over."""
    quiet: bool = False
    """Whether only errors are printed."""
    json: bool = False
    """Whether stdout is JSON Lines."""
    jobs: int = 1
    """Processes that detect."""

    @property
    def shown_min_score(self) -> float:
        """Boxes that score less are neither drawn nor counted."""
        return max(SHOWN_MIN_SCORE, self.min_score)

    @property
    def speaks(self) -> bool:
        """Whether sentences are printed."""
        return not (self.quiet or self.json)


def prepare_run(
    paths: Sequence[str], options: RunOptions, *, more: Mapping[str, Any] | None = None
) -> tuple[Sequence[io.Sweep], RunAccount]:
    """Finds the sweeps, makes the output folder, and holds a resumed run to the earlier one's options.

    Args:
      paths: what `jaxbox.io.open_sweeps` takes.
      options: the command's options.
      more: further options that the results depend on, as JSON can hold them.

    Returns:
      The sweeps as they are seen from the sensor, and the account, which is not written yet.

    Raises:
      InputError: where a path holds no sweeps, or the options cannot be used.
    """
    sweeps = io.open_sweeps(paths, topic=options.topic, convention=options.convention)
    account = RunAccount(
        output=options.output,
        config=options.config,
        options={
            "min_score": options.min_score,
            **options.keep.recorded(),
            "capacity": options.capacity,
            "topic": options.topic,
            "sensor_at": None if options.sensor_at is None else list(options.sensor_at),
            "level": options.level,
            "convention": dataclasses.asdict(options.convention),
            **(more or {}),
        },
        inputs=tuple(paths),
    )
    if options.resume:
        account.check_resumable()
    # Measured again where the archive has grown, the sensor would stand otherwise than for what is there.
    earlier = account.earlier_mounting() if options.resume and options.level else None
    sweeps, mounting = seen_from_sensor(
        sweeps, sensor_at=options.sensor_at, level=options.level, measured=earlier
    )
    if options.level and mounting is not None and options.speaks:
        where = f"see T_level_points in {RUN_NAME}"
        stdout().print(f"{describe_mounting(mounting)}, {where}", markup=False)
    folders = (options.output, options.output / PICTURE_FOLDER, options.output / CROP_FOLDER)
    for folder in folders[1:]:
        check_no_link(folder)
    with written(options.output):
        options.output.mkdir(parents=True, exist_ok=True)
    for folder in folders:
        io.remove_abandoned(folder)
    return sweeps, dataclasses.replace(account, mounting=mounting)


def reasons_as_json(reasons: Sequence[tuple[str, str]]) -> list[dict[str, str]]:
    """Names and reasons of failures, for JSON.

    >>> reasons_as_json([("000001", "empty")])
    [{'sweep': '000001', 'reason': 'empty'}]
    """
    return [{"sweep": name, "reason": reason} for name, reason in reasons]


def print_json(value: Mapping[str, Any]) -> None:
    """Prints one line of JSON to stdout."""
    stdout().out(json.dumps(value, allow_nan=False), highlight=False)
