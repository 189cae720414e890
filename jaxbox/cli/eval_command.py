"""Options of ``jaxbox eval``, of single sweeps and of tracks."""

import math
import pathlib
from collections.abc import Mapping
from typing import Annotated

import typer

from jaxbox.cli.config_options import chosen_config
from jaxbox.cli.console import input_errors, print_warning, stdout
from jaxbox.cli.eval_protocol import ProtocolOptions, run_eval_protocol
from jaxbox.cli.evaluate import run_eval
from jaxbox.cli.evaluate_tracking import run_eval_tracking
from jaxbox.cli.options import DrivesOption, PresetOption, SetOption, SettingsOption
from jaxbox.cli.report import SHOWN_MIN_SCORE
from jaxbox.cli.results import RUN_NAME, chosen_by_run
from jaxbox.evaluation.protocols import Protocol


def evaluate(
    *,
    labels: Annotated[
        pathlib.Path,
        typer.Option(help="The KITTI folder, or that of an annotation tool, that was given to `detect`."),
    ],
    results: Annotated[pathlib.Path, typer.Option(help="The folder that `detect` wrote to.")],
    json: Annotated[pathlib.Path | None, typer.Option(help="Also write every figure to this file.")] = None,
    plots: Annotated[
        pathlib.Path | None,
        typer.Option(help="Folder for the plots (the plots extra); RESULTS/plots unless given."),
    ] = None,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="Draw what was found, missed and false: RESULTS/pictures.")
    ] = False,
    min_score: Annotated[
        float | None,
        typer.Option(
            help=f"Draw no lower scores, {SHOWN_MIN_SCORE:g} unless given; the figures take all. "
            "With --tracking: leave lower scores out of the tracks' figures, none unless given.",
        ),
    ] = None,
    drives: DrivesOption = None,
    tracking: Annotated[
        bool,
        typer.Option(
            "--tracking",
            help="Results are tracks, one text file a sequence; LABELS holds label_02/ and calib/.",
        ),
    ] = False,
    frames: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SEQUENCE[:FIRST-LAST]",
            help="With --tracking: evaluate only this sequence and these frames, as 0000:0-47; repeatable.",
        ),
    ] = None,
    missing_as_empty: Annotated[
        bool, typer.Option("--missing-as-empty", help="Take a missing result file for one without boxes.")
    ] = False,
    protocol: Annotated[
        Protocol | None,
        typer.Option(
            help="Detect in these frames of LABELS first, where RESULTS lacks them, and write a table to "
            "paste: RESULTS/PROTOCOL.md.",
        ),
    ] = None,
    preset: PresetOption = None,
    settings: SettingsOption = None,
    changes: SetOption = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="With --protocol: processes that detect, 1 unless given.")
    ] = None,
) -> None:
    """Score results against labels: the paper's size errors, recall and precision, KITTI's AP.

    Pictures are RESULTS/pictures/NAME_eval.png and contact_sheet.png, all frames on one.

    With --tracking: HOTA, CLEAR and identity by KITTI's protocol, and of vehicles from above and in 3D.

    With --protocol kitti-val: one command for all of it, on KITTI's usual 3,769 validation frames; the same
    command goes on where it was interrupted.
    """
    _check_options(tracking=tracking, frames=frames, plots=plots, drives=drives, pictures=pictures)
    if min_score is not None and not math.isfinite(min_score):
        raise typer.BadParameter(f"--min-score is {min_score:g}; give a finite number.")
    if not tracking and min_score is not None and not 0 <= min_score <= 1:
        raise typer.BadParameter(f"--min-score is {min_score:g}; scores of detections are from 0 to 1.")
    if not tracking and protocol is None and min_score is not None and not pictures:
        raise typer.BadParameter(
            "--min-score chooses what --pictures draws, and the figures take all scores; give both, or none."
        )
    of_detecting = {"--preset": preset, "--config": settings, "--set": changes, "--jobs": jobs}
    of_results = {"--tracking": tracking, "--plots": plots, "--drives": drives, "--pictures": pictures}
    of_results |= {"--json": json, "--missing-as-empty": missing_as_empty, "--min-score": min_score}
    if protocol is None:
        _refuse(of_detecting, "{}: it detects nothing; give it with --protocol.")
    else:
        _refuse(of_results, "{}: leave it out with --protocol, and evaluate again then.")
    with input_errors():
        if protocol is not None:
            config = chosen_config(preset, settings, changes or [])
            options = ProtocolOptions(protocol=protocol, config=config, jobs=jobs or 1)
            raise typer.Exit(run_eval_protocol(labels, results, options, stdout()))
        if chosen := chosen_by_run(results):
            print_warning(
                f"{results}: by {RUN_NAME} the run left boxes out ({'; '.join(chosen)}), and the figures are "
                "of those that it kept."
            )
        if tracking:
            run_eval_tracking(
                labels,
                results,
                frames=frames or (),
                missing_as_empty=missing_as_empty,
                min_score=min_score,
                json_path=json,
                console=stdout(),
            )
            return
        run_eval(
            labels,
            results,
            missing_as_empty=missing_as_empty,
            json_path=json,
            plots=plots,
            drives_path=drives,
            pictures=pictures,
            min_score=SHOWN_MIN_SCORE if min_score is None else min_score,
            console=stdout(),
        )


def _check_options(
    *,
    tracking: bool,
    frames: list[str] | None,
    plots: pathlib.Path | None,
    drives: pathlib.Path | None,
    pictures: bool,
) -> None:
    """Refuses options of the other kind of results, rather than passing them over."""
    if frames and not tracking:
        raise typer.BadParameter("--frames chooses frames of tracking sequences; give --tracking with it.")
    if tracking:
        of_sweeps = {"--plots": plots, "--drives": drives, "--pictures": pictures}
        _refuse(of_sweeps, "{} is for single sweeps; leave it out with --tracking.")


def _refuse(given: Mapping[str, object], sentence: str) -> None:
    """Refuses the first option that was given, by its name in a sentence."""
    for name, value in given.items():
        # A score of 0 was given, too, and equals False.
        if value is not None and value is not False:
            raise typer.BadParameter(sentence.format(name))
