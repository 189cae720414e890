"""``jaxbox tune``: tries settings on labelled sweeps, and evaluates them on held-out drives."""

import csv
import dataclasses
import datetime
import json
import pathlib
import statistics
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console

from jaxbox import tuning
from jaxbox._interrupts import heard
from jaxbox.cli.console import ExitCode, exit_code, make_progress, print_error
from jaxbox.cli.report import make_table
from jaxbox.cli.results import written
from jaxbox.config import DetectorConfig
from jaxbox.config.fields import PRESET_KEY, changed_fields
from jaxbox.evaluation.copies import COPIES, labelled_frames
from jaxbox.evaluation.objectives import OBJECTIVES
from jaxbox.io import (
    InputError,
    PointConvention,
    Sweep,
    atomic_writer,
    find_drives,
    group_sequences,
    open_sweeps,
    read_drives,
)
from jaxbox.io.sweeps import distinct_names, expand, sweep_of
from jaxbox.run.compiled import count_compilations
from jaxbox.tuning import Axis, Bench, Trial


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuneOptions:
    """The options of ``jaxbox tune``; the command's help explains them."""

    output: pathlib.Path
    """Folder for the report."""
    preset: str
    """Name of the preset that the base comes from."""
    config: DetectorConfig
    """The base: the preset with its changes."""
    search: Sequence[str]
    """The ranges, or none for the default space."""
    trials: int
    """Settings that are tried, with the base."""
    refine: int
    """How many of them are steps round the best."""
    copies: int
    """Of `COPIES`, how many are scored."""
    objective: str
    """Name in `OBJECTIVES`."""
    drives: pathlib.Path | None
    """File with the drive of each frame; None for the ``drives.txt`` beside the labels."""
    convention: PointConvention
    """How the numbers of the points are to be taken."""
    seed: int
    """Of the settings that are tried."""


def run_tune(labels: Sequence[pathlib.Path], options: TuneOptions, console: Console) -> ExitCode:
    """Tries settings, reports, and writes report.json, report.md, best.json and trials.csv.

    Interrupted, it reports the trials that are done.

    Args:
      labels: folders of labelled sweeps, pooled.
      options: the command's options.
      console: where results go.

    Returns:
      `ExitCode.INTERRUPTED` where it was interrupted.

    Raises:
      InputError: where labels or options cannot be used.
    """
    check_trials(options)
    axes = chosen_axes(options)
    drives = drive_files(labels, options.drives)
    bench = make_bench(labels, options, drives)
    with written(options.output, advice="or choose another --output."):
        options.output.mkdir(parents=True, exist_ok=True)
    compiled_before = count_compilations()
    console.print(f"compiling the detector for {bench.capacity} points")
    compile_s = bench.warm_up()
    trials, interrupted = try_settings(bench, axes, options, console)
    if not trials:
        print_error("interrupted before the base was scored; there is nothing to report.")
        return ExitCode.INTERRUPTED
    report = tuning.make_report(bench, axes, trials) | {
        "interrupted": interrupted,
        "num_planned": options.trials,
        "preset": options.preset,
        "base_changes": changed_fields(options.config, DetectorConfig.presets()[options.preset]),
        "drives": [str(file) for file in dict.fromkeys(drives.values()) if file is not None],
        "folders_without_drives": [str(folder) for folder, file in drives.items() if file is None],
        "seed": options.seed,
        "compile_s": compile_s,
        "num_compilations": count_compilations() - compiled_before,
    }
    write_report(report, options, console)
    return exit_code(failed=False, interrupted=interrupted)


def try_settings(
    bench: Bench, axes: Sequence[Axis], options: TuneOptions, console: Console
) -> tuple[list[Trial], bool]:
    """Runs the trials, says how each went, and writes trials.csv anew after each.

    Args:
      bench: what they are tried on.
      axes: the space.
      options: the command's options.
      console: where the lines go.

    Returns:
      The trials that are done, and whether it was interrupted.
    """
    trials: list[Trial] = []
    with make_progress(shown=True) as progress:
        task = progress.add_task("tuning", total=options.trials * bench.sweeps_per_trial)
        try:
            for trial in run_trials(bench, axes, options, lambda: progress.advance(task)):
                trials.append(trial)
                write_trials(options.output / "trials.csv", bench, axes, trials)
                best = tuning.best_trial(trials)
                console.print(
                    f"trial {trial.index} of {options.trials - 1}: {trial.mean:.2f}, {trial.seconds:.1f} s; "
                    f"best {best.mean:.2f}, trial {best.index}; {time_left(trials, options.trials)} left"
                )
        except KeyboardInterrupt:
            heard()
            return trials, True
    return trials, False


def check_trials(options: TuneOptions) -> None:
    """Refuses more steps round the best than there are trials besides the base.

    Raises:
      InputError: naming how many trials they take.
    """
    if 0 < options.refine >= options.trials:
        raise InputError(
            f"--refine {options.refine}: these are among the --trials {options.trials}, the first of which "
            f"is the base; give at least --trials {options.refine + 1}, or fewer steps."
        )


def time_left(trials: Sequence[Trial], planned: int) -> str:
    """How long the other trials take, if each takes as long as the median one did.

    Args:
      trials: those that are done, at least one.
      planned: how many there will be.

    Returns:
      Hours, minutes and seconds, such as "0:04:30".
    """
    seconds = statistics.median(trial.seconds for trial in trials) * (planned - len(trials))
    return str(datetime.timedelta(seconds=round(seconds)))


def chosen_axes(options: TuneOptions) -> list[Axis]:
    """The ranges that were asked for, or the default space.

    Raises:
      InputError: for a range that cannot be searched, or a setting that stands twice.
    """
    if not options.search:
        return tuning.default_axes(options.config)
    try:
        axes = [tuning.parse_axis(options.config, text) for text in options.search]
    except ValueError as error:
        raise InputError(f"--search: {error}") from error
    names = [axis.name for axis in axes]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"--search: {twice} stands there twice; give one range.")
    return axes


def make_bench(
    labels: Sequence[pathlib.Path], options: TuneOptions, drives: Mapping[pathlib.Path, pathlib.Path | None]
) -> Bench:
    """Reads the labelled sweeps, and the groups in which they are held out.

    Raises:
      InputError: where there are none, one cannot be read, or a frame has no drive.
    """
    sweeps = open_sweeps(labels, convention=options.convention)
    frames = labelled_frames(sweeps)
    if not frames:
        raise InputError(
            f"{', '.join(map(str, labels))}: no sweep there has labels and a calibration; give a labelled "
            "KITTI folder."
        )
    kind, groups = frame_groups(sweeps, [frame.name for frame in frames], drives)
    return Bench(
        base=options.config,
        frames=frames,
        groups=groups,
        group_kind=kind,
        copies=COPIES[: options.copies],
        objective=OBJECTIVES[options.objective],
    )


def drive_files(
    labels: Sequence[pathlib.Path], given: pathlib.Path | None
) -> dict[pathlib.Path, pathlib.Path | None]:
    """The file that says which drive a frame is of, for each folder.

    Args:
      labels: folders of labelled sweeps, or patterns of them.
      given: the file that the user named, for all of them; or None.

    Returns:
      That file; else the ``drives.txt`` in or beside the folder, None where there is none. By absolute path.

    Raises:
      InputError: for a pattern that nothing matches.
    """
    return {folder: given or find_drives(folder) for label in labels for folder in expand(label)}


def frame_groups(
    sweeps: Sequence[Sweep],
    names: Sequence[str],
    drives: Mapping[pathlib.Path, pathlib.Path | None],
) -> tuple[str, dict[str, str]]:
    """What is held out together: drives as files say them, else the sweeps of one folder or recording.

    Args:
      sweeps: all sweeps.
      names: those of them that have labels.
      drives: from `drive_files`.

    Returns:
      What a group is, in a word, and the group of each frame. Where all sweeps lie in one folder and no file
      says their drives, each sweep is a group.

    Raises:
      InputError: where a folder has a file and one of its frames has no drive in it.
    """
    path_of = {sweep.name: sweep.points_path for sweep in sweeps}
    if any(drives.values()):
        labelled = {path_of[name] for name in names}
        drive_of: dict[pathlib.Path, str] = {}
        for file in dict.fromkeys(drives.values()):
            found = _sweeps_below(sweeps, [folder for folder in drives if drives[folder] == file])
            drive_of |= _folder_groups(found) if file is None else _drives_in(file, found, labelled)
        return "drive", {name: drive_of[path_of[name]] for name in names}
    folder_of = _folder_groups(sweeps)
    folders = {name: folder_of[path_of[name]] for name in names}
    if len(set(folders.values())) > 1:
        return "folder", folders
    return "sweep", {name: name for name in names}


def _sweeps_below(sweeps: Sequence[Sweep], folders: Iterable[pathlib.Path]) -> list[Sweep]:
    """Those whose points lie in the folders; recordings have no labels, and are none of them."""
    roots = set(folders)
    files = [sweep for sweep in sweeps if sweep.decode is None]
    return [s for s in files if not roots.isdisjoint((s.points_path, *s.points_path.parents))]


def _drives_in(
    file: pathlib.Path, sweeps: Sequence[Sweep], labelled: Collection[pathlib.Path]
) -> dict[pathlib.Path, str]:
    """The drive of each labelled sweep; the file names these sweeps as if there were no others."""
    paths = [sweep.points_path for sweep in sweeps]
    names = distinct_names([(path.parent, sweep_of(path).name) for path in paths])
    path_of = {name: path for name, path in zip(names, paths, strict=True) if path in labelled}
    return {path_of[name]: drive for name, drive in read_drives(file, path_of).items()}


def _folder_groups(sweeps: Sequence[Sweep]) -> dict[pathlib.Path, str]:
    """The folder or recording of each sweep, by the path of its points."""
    return {sweep.points_path: name for name, group in group_sequences(sweeps) for sweep in group}


def run_trials(
    bench: Bench, axes: Sequence[Axis], options: TuneOptions, on_sweep: Callable[[], None]
) -> Iterator[Trial]:
    """The base, settings spread evenly over the space, then steps round the best of these.

    Args:
      bench: what they are tried on.
      axes: the space.
      options: how many of each, and the seed.
      on_sweep: called after each sweep.

    Yields:
      Each trial as it is done.
    """
    best = bench.run(0, {}, blind=True, on_sweep=on_sweep)
    yield best
    spread = tuning.latin_hypercube(axes, options.trials - 1 - options.refine, seed=options.seed)
    for index, changes in enumerate(spread, 1):
        trial = bench.run(index, changes, blind=True, on_sweep=on_sweep)
        best = tuning.best_trial([best, trial])
        yield trial
    if not options.refine:
        return
    values = tuning.axis_values(bench.base, axes) | dict(best.changes)
    steps = tuning.refine(axes, values, best.mean)
    changes = next(steps)
    for index in range(len(spread) + 1, options.trials):
        trial = bench.run(index, changes, blind=False, on_sweep=on_sweep)
        yield trial
        try:
            changes = steps.send(trial.mean)
        except StopIteration:
            return


def write_trials(path: pathlib.Path, bench: Bench, axes: Sequence[Axis], trials: Sequence[Trial]) -> None:
    """Writes a row a trial: its settings and scores, whole or not at all."""
    base = tuning.axis_values(bench.base, axes)
    with atomic_writer(path) as handle:
        rows = csv.writer(handle, lineterminator="\n")
        rows.writerow(["trial", "blind", "mean", *(copy.name for copy in bench.copies), *base, "status"])
        for trial in trials:
            values = (base | dict(trial.changes)).values()
            status = " ".join(bit.name or "" for bit in type(trial.status) if bit and bit in trial.status)
            rows.writerow([trial.index, trial.blind, trial.mean, *trial.scores, *values, status or "OK"])


def write_report(report: dict[str, Any], options: TuneOptions, console: Console) -> None:
    """Prints the report and writes it as JSON and Markdown, with the best settings next to it."""
    notes = run_notes(report)
    for name, columns, rows in tuning.report_tables(report):
        console.print(make_table(name, columns, rows))
    for line in [*notes, *tuning.report_sentences(report)]:
        console.print(line, markup=False)
    title = f"Settings tried on the {options.preset} preset"
    best = {PRESET_KEY: options.preset} | report["base_changes"] | report["best"]["changes"]
    texts = {
        "report.json": json.dumps(report, indent=1, allow_nan=False),
        "report.md": tuning.markdown_report(report, title=title, notes=notes),
        "best.json": json.dumps(best, indent=1),
    }
    for name, text in texts.items():
        with atomic_writer(options.output / name) as handle:
            handle.write(text)
    console.print(f"wrote {', '.join(texts)} and trials.csv to {options.output}", markup=False)


def run_notes(report: dict[str, Any]) -> list[str]:
    """Sentences on how the search was run."""
    done, planned = len(report["trials"]), report["num_planned"]
    ended = "interrupted; " if report["interrupted"] else ""
    drives = f"Drives are those of {', '.join(report['drives'])}."
    if whole := ", ".join(report["folders_without_drives"]):
        drives += f" No drives.txt is with {whole}: each folder or recording is taken for one drive."
    groups = {
        "drive": drives,
        "folder": "No file says which drive a frame is of, so each folder or recording is taken for one.",
        "sweep": "No drives were given, so each sweep was held out by itself: sweeps of a drive resemble "
        "each other, and the held-out figures are flattered.",
    }[report["group_kind"]]
    return [
        f"{done} of {planned} trials ({ended}seed {report['seed']}), "
        f"median {report['seconds_per_trial']:.1f} s a trial.",
        f"Compilations of the detector, all trials together: {report['num_compilations']}, "
        f"{report['compile_s']:.1f} s before the first, for {report['capacity']} points.",
        groups,
    ]
