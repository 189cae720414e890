"""``jaxbox detect``: sweeps of files, folders and recordings to result files and pictures, one by one."""

import dataclasses
import pathlib
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

from rich.progress import Progress

from jaxbox import io
from jaxbox._interrupts import heard, stoppable, undisturbed
from jaxbox.cli.console import ExitCode, exit_code, make_progress, print_error, stderr, stdout
from jaxbox.cli.crops import CROP_FOLDER
from jaxbox.cli.frames import Frame, FrameSource, FrameWork
from jaxbox.cli.inputs import PICTURE_FOLDER, RunOptions, prepare_run, print_json, reasons_as_json
from jaxbox.cli.report import (
    FrameOutcome,
    FrameReport,
    RunReport,
    describe_frame,
    describe_run,
)
from jaxbox.cli.results import ResultFormat, Results, written
from jaxbox.cli.run_sheet import SHEET_NAME, RunSheet
from jaxbox.io.jsonl import JSONL
from jaxbox.run.processes import WorkerDied
from jaxbox.run.summary import summarise


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectOptions(RunOptions):
    """The options of ``jaxbox detect``; the command's help explains them."""

    formats: frozenset[ResultFormat]
    """What to write."""
    points: bool
    """Whether MCAP and rerun files hold the points too."""
    pictures: bool
    """Whether pictures are drawn."""


def run_detect(
    paths: Sequence[str], options: DetectOptions, *, frames: Collection[str] | None = None
) -> ExitCode:
    """Detects in every sweep of some paths; a broken one is reported and the others go on.

    Interrupted (Ctrl-C or SIGTERM), it closes its files, so that what is done is whole and can be resumed.

    Args:
      paths: what `jaxbox.io.open_sweeps` takes.
      options: the command's options.
      frames: names of the sweeps that are wanted; None for all.

    Returns:
      `ExitCode.INTERRUPTED`, or `FRAME_FAILED` where a sweep failed.

    Raises:
      InputError: where a path holds no sweeps, or the options cannot be used.
    """
    sweeps, account = prepare_run(paths, options)
    if frames is not None:
        sweeps = [sweep for sweep in sweeps if sweep.name in frames]
    run = RunReport(jobs=options.jobs)
    sheet = RunSheet(options.output, sweeps, shown=options.sheet)
    start = time.perf_counter()
    with Results(
        options.output,
        options.formats,
        resume=options.resume,
        min_score=options.min_score,
        points=options.points,
    ) as results:
        account.write(finished=False)
        _run_sweeps(sweeps, options, run, results, sheet.tiles)
    is_complete = not (run.interrupted or run.failures)
    with written(options.output / SHEET_NAME):
        sheet.write(min_score=options.shown_min_score, is_complete=is_complete)
    run.elapsed_s = time.perf_counter() - start
    account.write(
        finished=is_complete,
        interrupted=run.interrupted,
        num_done=len(run.frames),
        num_skipped=run.num_skipped,
        failures=reasons_as_json(run.failures),
        repeated=reasons_as_json(run.repeated),
    )
    _report(run, results, options)
    return exit_code(failed=bool(run.failures), interrupted=run.interrupted)


def _run_sweeps(
    sweeps: Sequence[io.Sweep],
    options: DetectOptions,
    run: RunReport,
    results: Results,
    tiles: Mapping[str, pathlib.Path],
) -> None:
    """Every sweep; ends early, with what is done, where it is interrupted or a recording breaks off."""
    with stoppable(), make_progress(shown=options.speaks) as progress:
        task = progress.add_task("detecting", total=len(sweeps))
        missing = _missing(sweeps, results, run, progress)
        frames = _frames(missing, options, run, results, tiles)
        try:
            for sweep, wait in frames:
                _run_frame(sweep, wait, options, run, results)
                progress.advance(task)
        except io.InputError as error:
            run.failures.append(("the recording", str(error)))
            print_error(str(error))
        except KeyboardInterrupt:
            heard()
            run.interrupted = True
        finally:
            # Where it was interrupted, the workers end now, and not with the last reference to them.
            frames.close()


def _missing(
    sweeps: Sequence[io.Sweep], results: Results, run: RunReport, progress: Progress
) -> Iterator[io.Sweep]:
    """The sweeps that an earlier run has not finished."""
    for sweep in sweeps:
        if results.is_finished(sweep.name):
            run.num_skipped += 1
            progress.advance(progress.task_ids[0])
        else:
            yield sweep


def _frames(
    sweeps: Iterator[io.Sweep],
    options: DetectOptions,
    run: RunReport,
    results: Results,
    tiles: Mapping[str, pathlib.Path],
) -> FrameSource:
    """The frames of the sweeps, made here or by that many processes."""
    work = FrameWork(
        config=options.config,
        capacity=options.capacity,
        keep=options.keep,
        picture_folder=options.output / PICTURE_FOLDER if options.pictures else None,
        crop_folder=options.output / CROP_FOLDER if options.crops else None,
        tiles=tiles,
        shown_min_score=options.shown_min_score,
        keep_points=results.wants_points,
        keep_image=results.wants_image,
    )

    def on_death(sweep: io.Sweep, how: str) -> None:
        run.repeated.append((sweep.name, how))
        print_error(f"sweep {sweep.name}: its worker process ended ({how}); it is tried once more.")

    return work.run(sweeps) if options.jobs == 1 else work.run_apart(sweeps, options.jobs, on_death)


def _report(run: RunReport, results: Results, options: DetectOptions) -> None:
    """The end of the run, in sentences or as the last line of JSON."""
    if run.interrupted:
        stderr().print("interrupted; the same command with --resume goes on.", markup=False)
    if results.without_camera:
        first, count = results.without_camera[0], len(results.without_camera)
        stderr().print(
            f"{count} sweeps have no camera calibration (the first is {first}); KITTI text needs one, so "
            f"their boxes are in {options.output / JSONL.name} instead.",
            markup=False,
        )
    if options.json:
        counts = {"done": len(run.frames), "skipped": run.num_skipped, "interrupted": run.interrupted}
        lists = {"failures": reasons_as_json(run.failures), "repeated": reasons_as_json(run.repeated)}
        print_json({"summary": {**counts, **lists}})
    elif options.speaks:
        for line in describe_run(run):
            stdout().print(line, markup=False)


def _run_frame(
    sweep: io.Sweep,
    wait: Callable[[], Frame],
    options: DetectOptions,
    run: RunReport,
    results: Results,
) -> None:
    """One sweep, its files and its lines; a failure is added to the run."""
    try:
        report = _write(sweep, wait(), options, run, results)
    except (io.InputError, OSError, WorkerDied) as error:
        run.failures.append((sweep.name, str(error)))
        print_error(f"sweep {sweep.name}: {error}")
        return
    run.frames.append(FrameOutcome.of(report))
    if options.speaks:
        for line in describe_frame(report, min_score=options.shown_min_score):
            stdout().print(line, markup=False)


def _write(
    sweep: io.Sweep, frame: Frame, options: DetectOptions, run: RunReport, results: Results
) -> FrameReport:
    """Writes the results, and then reports pictures that could not be drawn."""
    start = time.perf_counter()
    with undisturbed():
        record = results.write(
            sweep,
            frame.detections,
            calibration=frame.calibration,
            points=frame.points,
            image=frame.image,
        )
    if options.json:
        health = summarise(frame.detections, options.config).to_dict()
        timing = {"num_points": frame.num_points, "detect_ms": round(frame.detect_s * 1e3, 3)}
        print_json({**record, **timing, "health": health})
    run.add_compile_times(frame.compile_s)
    if frame.picture_error is not None:
        raise frame.picture_error
    return FrameReport(
        name=sweep.name,
        num_points=frame.num_points,
        detections=frame.detections,
        detect_s=frame.detect_s,
        other_s=frame.other_s + time.perf_counter() - start,
    )
