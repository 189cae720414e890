"""``jaxbox track``: drives to vehicles that have a history, one sequence after the other."""

import contextlib
import dataclasses
import pathlib
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any

import numpy as np

from jaxbox import io
from jaxbox._interrupts import heard, stoppable, undisturbed
from jaxbox.cli.console import (
    ExitCode,
    exit_code,
    make_progress,
    print_error,
    print_warning,
    stderr,
    stdout,
)
from jaxbox.cli.crops import CROP_FOLDER, write_crops
from jaxbox.cli.inputs import RunOptions, prepare_run, print_json, reasons_as_json
from jaxbox.cli.kept import KeptSweep
from jaxbox.cli.results import RunAccount, written
from jaxbox.cli.run_sheet import SHEET_NAME, TILE_FRAME, RunSheet
from jaxbox.cli.track_report import SequenceReport, TrackReport
from jaxbox.cli.track_results import GIF_FRAME, SequenceFiles, TrackFormat
from jaxbox.config import TrackConfig
from jaxbox.config.fields import all_fields
from jaxbox.io.drive_records import DriveRecords
from jaxbox.io.poses import choose_poses
from jaxbox.io.results import SweepResult
from jaxbox.run.pose_providers import without_points
from jaxbox.run.tracking import TrackedSweep, smooth_tracks, track
from jaxbox.tracking.poses import Poses, PoseSource
from jaxbox.tracking.trails import Trails
from jaxbox.viz import BirdEyeFrame, draw_drive, save_png


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackOptions(RunOptions):
    """The options of ``jaxbox track``; the command's help explains them."""

    track_config: TrackConfig
    """The tracker's settings."""
    formats: frozenset[TrackFormat]
    """What to write."""
    poses: str
    """As `jaxbox.io.poses.choose_poses` takes them."""
    rate_hz: float
    """Sweeps a second where nothing says when they were taken."""
    max_tracks: int
    """Vehicles at a time."""
    smooth: bool
    """Whether the whole drive is looked at before anything is written."""
    confirmed: bool
    """Whether only confirmed tracks are written."""
    coasting: bool
    """Whether KITTI text holds tracks too that were not detected in the sweep."""
    text_min_score: float
    """KITTI text holds no lower scores, as its benchmark takes every line for an answer."""
    points: bool
    """Whether MCAP and rerun files hold the points too."""
    pictures: bool
    """Whether each sweep is drawn."""
    video: bool
    """Whether there is a video of each drive."""
    gif: bool
    """Whether there is an animated GIF of each drive."""

    def recorded(self) -> dict:
        """What the results depend on besides the detector's settings, as JSON can hold it."""
        names = ("poses", "rate_hz", "max_tracks", "smooth", "confirmed", "coasting", "text_min_score")
        settings = {name: float(value) for name, value in all_fields(self.track_config).items()}
        return {"track": settings} | {name: getattr(self, name) for name in names}

    def files_of(self, sequence: str) -> SequenceFiles:
        """The files of a sequence."""
        return SequenceFiles(
            self.output,
            sequence,
            self.formats,
            # A gap that is filled between two detections is what smoothing is for.
            coasting=self.coasting or self.smooth,
            text_min_score=self.text_min_score,
            points=self.points,
            pictures=self.pictures,
            video=self.video,
            gif=self.gif,
        )


def run_track(paths: Sequence[str], options: TrackOptions) -> ExitCode:
    """Tracks the vehicles of every sequence of some paths.

    A broken sweep is reported and the others go on. Interrupted (Ctrl-C or SIGTERM), or where a recording
    breaks off, what is done of the sequence is written, and ``--resume`` begins it again.

    Args:
      paths: what `jaxbox.io.open_sweeps` takes.
      options: the command's options.

    Returns:
      `ExitCode.INTERRUPTED`, or `FRAME_FAILED` where a sweep failed.

    Raises:
      InputError: where a path holds no sweeps, or the options cannot be used.
    """
    sweeps, account = prepare_run(paths, options, more=options.recorded())
    if len(sweeps) == 0:
        raise io.InputError(f"{', '.join(paths)}: no sweeps there; the recording is empty.")
    sequences = io.group_sequences(sweeps)
    earlier = _Earlier.of(account) if options.resume else None
    run, start = TrackReport(), time.perf_counter()
    sheet = RunSheet(options.output, sweeps, shown=options.sheet)
    pending = [name for name, group in sequences if not _is_finished(name, group, options, earlier)]
    num_sweeps = {name: len(group) for name, group in sequences}
    account.write(finished=False, incomplete=pending, num_sweeps=num_sweeps)
    with stoppable(), make_progress(shown=options.speaks) as progress:
        task = progress.add_task("tracking", total=len(sweeps))
        for name, group in sequences:
            if name not in pending:
                run.num_skipped += len(group)
                progress.advance(task, len(group))
                continue
            report = SequenceReport(name)
            run.sequences.append(report)
            _run_sequence(group, report, options, sheet, lambda: progress.advance(task))
            if report.is_complete:
                pending.remove(name)
            _write_account(account, run, pending, num_sweeps)
            _describe_sequence(report, options)
            if report.interrupted:
                break
    with written(options.output / SHEET_NAME):
        sheet.write(min_score=options.shown_min_score, is_complete=not pending)
    _describe_run(run, options, time.perf_counter() - start)
    return exit_code(failed=bool(run.failures), interrupted=run.interrupted)


@dataclasses.dataclass(frozen=True)
class _Earlier:
    """What the account of the run that is resumed says of its sequences."""

    incomplete: frozenset[str] | None
    """Those that it has not done; None where there is no such run."""
    num_sweeps: Mapping[str, int]
    """How many sweeps each had, as far as it says."""

    @classmethod
    def of(cls, account: RunAccount) -> "_Earlier":
        return cls(account.earlier_incomplete(), account.earlier_num_sweeps())

    def has_done(self, name: str, num_sweeps: int) -> bool:
        """Whether it has done a sequence, which has got no further sweeps since."""
        if self.incomplete is None or name in self.incomplete:
            return False
        return self.num_sweeps.get(name, num_sweeps) == num_sweeps


def _is_finished(
    name: str, sweeps: Sequence[io.Sweep], options: TrackOptions, earlier: _Earlier | None
) -> bool:
    """Whether an earlier run has done a whole sequence."""
    if earlier is None or len(sweeps) == 0 or not earlier.has_done(name, len(sweeps)):
        return False
    return options.files_of(name).are_there(has_camera=sweeps[0].is_calibrated)


def _write_account(
    account: RunAccount, run: TrackReport, pending: Sequence[str], num_sweeps: Mapping[str, int]
) -> None:
    account.write(
        num_sweeps=num_sweeps,
        finished=not (pending or run.interrupted),
        interrupted=run.interrupted,
        incomplete=list(pending),
        num_done=run.num_done,
        num_skipped=run.num_skipped,
        failures=reasons_as_json(run.failures),
        sequences=[sequence.to_json() for sequence in run.sequences],
    )


def _run_sequence(
    sweeps: Sequence[io.Sweep],
    report: SequenceReport,
    options: TrackOptions,
    sheet: RunSheet,
    advance: Callable[[], None],
) -> None:
    """One sequence and its files."""
    if len(sweeps) == 0:
        _fail(report, report.name, "no sweeps in it; the recording is empty.")
        return
    with options.files_of(report.name) as files:
        files.expect(len(sweeps))
        _Drive(sweeps, report, options, files, sheet, advance).go()
        report.has_camera = files.has_camera
    report.is_complete = not (report.failures or report.interrupted)


def _fail(report: SequenceReport, name: str, reason: str) -> None:
    report.failures.append((name, reason))
    print_error(f"{name}: {reason}")


class _Drive:
    """The way of one sequence from its sweeps to its files."""

    def __init__(
        self,
        sweeps: Sequence[io.Sweep],
        report: SequenceReport,
        options: TrackOptions,
        files: SequenceFiles,
        sheet: RunSheet,
        advance: Callable[[], None],
    ) -> None:
        self._sweeps, self._report, self._options = sweeps, report, options
        self._files, self._sheet, self._advance = files, sheet, advance
        self._trails = Trails()
        self._records = DriveRecords(report.name, min_score=options.min_score, confirmed=options.confirmed)

    def go(self) -> None:
        """Tracks and writes; ends early, with what is done, where it is interrupted or breaks off."""
        kept: list[tuple[int, TrackedSweep]] = []
        try:
            poses = self._find_poses()
        except io.InputError as error:
            if not pathlib.Path(self._options.poses).is_dir():
                raise
            # Of a folder with a file a drive, the other drives' may serve.
            _fail(self._report, self._report.name, str(error))
            return
        source = self._track(poses)
        try:
            for index, tracked in enumerate(source):
                if tracked.error is not None:
                    _fail(self._report, tracked.name, tracked.error)
                elif self._options.smooth:
                    kept.append((index, _light(tracked)))
                else:
                    self._write(index, tracked)
                self._advance()
        except io.InputError as error:
            _fail(self._report, self._report.name, str(error))
        except KeyboardInterrupt:
            heard()
            self._report.interrupted = True
        finally:
            source.close()
        smoothed = smooth_tracks([tracked for _, tracked in kept], self._options.track_config)
        for (index, _), tracked in zip(kept, smoothed, strict=True):
            self._write(index, tracked)

    def _track(self, poses: Poses | PoseSource | None) -> Generator[TrackedSweep, None, None]:
        # Results and pictures show points that were read anyway.
        options = self._options
        return track(
            (KeptSweep(sweep, keeps=self._wants_points(sweep.name)) for sweep in self._sweeps),
            options.config,
            options.track_config,
            poses=poses,
            capacity=options.capacity,
            max_tracks=options.max_tracks,
            rate_hz=options.rate_hz,
            workers=options.jobs,
        )

    def _wants_points(self, name: str) -> bool:
        return self._files.wants_points or self._options.crops or name in self._sheet.tiles

    def _find_poses(self) -> Poses | PoseSource | None:
        return choose_poses(
            self._sweeps,
            self._options.poses,
            report=self._tell,
            warn=lambda sentence: print_warning(f"{self._report.name}: {sentence}"),
        )

    def _tell(self, sentence: str) -> None:
        if self._options.speaks:
            stdout().print(f"{self._report.name}: {sentence}", markup=False)

    def _write(self, index: int, tracked: TrackedSweep) -> None:
        """Adds a sweep to the files; a failure to read what belongs to it is one of the sweep."""
        kept = tracked.sweep
        assert isinstance(kept, KeptSweep)
        if tracked.tracks is not None:
            tracked = dataclasses.replace(tracked, tracks=self._options.keep(tracked.tracks))
        record = self._records.record(index, tracked)
        try:
            result = self._gather(kept, tracked, record)
        except (io.InputError, OSError) as error:
            _fail(self._report, tracked.name, str(error))
            return
        time = f"{record['time_s']:.1f} s"
        picture = small = None
        if self._files.wants_pictures:
            title = f"{tracked.name}  {time}  poses: {record['pose_source']}"
            picture = self._draw(tracked, result, title=title)
        if self._files.wants_gif(index):
            small = self._draw(tracked, result, title=time, frame=GIF_FRAME)
        if tile := self._sheet.tiles.get(tracked.name):
            with written(tile):
                save_png(tile, self._draw(tracked, result, title=tracked.name, frame=TILE_FRAME))
        with undisturbed():
            self._write_crops(tracked, result)
            self._files.write(result)
            self._files.add_pictures(tracked.name, picture, small, tracked.time_ns)
        self._report.add(tracked, record, min_score=self._options.shown_min_score)
        if self._options.json:
            print_json({**record, "num_points": tracked.num_points})

    def _gather(self, kept: KeptSweep, tracked: TrackedSweep, record: Mapping[str, Any]) -> SweepResult:
        """What belongs to a sweep, as far as the files show it."""
        xyz, intensity = kept.take_points() if self._wants_points(kept.name) else (None, None)
        trails: Mapping[int, np.ndarray] = {}
        if self._files.wants_trails or self._sheet.tiles:
            assert tracked.tracks is not None
            assert tracked.T_world_sensor is not None
            trails = self._trails.add(tracked.tracks, tracked.T_world_sensor, record["time_s"])
        return SweepResult(
            record=record,
            xyz=xyz,
            intensity=intensity,
            calibration=kept.sweep.read_calibration(),
            image=self._read_image(kept.sweep),
            trails=trails,
        )

    def _read_image(self, sweep: io.Sweep) -> np.ndarray | None:
        if self._files.wants_image:
            return sweep.read_image()
        if sweep.name in self._sheet.tiles:
            # No sweep is lost for want of a picture that nobody asked for.
            with contextlib.suppress(io.InputError, OSError):
                return sweep.read_image()
        return None

    def _write_crops(self, tracked: TrackedSweep, result: SweepResult) -> None:
        if self._options.crops:
            assert tracked.tracks is not None
            assert result.xyz is not None
            assert result.intensity is not None
            folder, points = self._options.output / CROP_FOLDER, (result.xyz, result.intensity)
            boxes = [(box.id, box) for box in tracked.tracks if box.confirmed]
            with written(folder):
                write_crops(folder, tracked.name, points, boxes, min_score=self._options.shown_min_score)

    def _draw(
        self, tracked: TrackedSweep, result: SweepResult, *, title: str, frame: BirdEyeFrame | None = None
    ) -> np.ndarray:
        assert tracked.tracks is not None
        assert result.xyz is not None
        return draw_drive(
            result.xyz,
            tracked.tracks,
            image=result.image,
            calibration=result.calibration,
            trails=result.trails,
            frame=frame,
            title=title,
            min_score=self._options.shown_min_score,
        )


def _light(tracked: TrackedSweep) -> TrackedSweep:
    """A sweep that can be kept until its drive is over: without points."""
    assert tracked.detections is not None
    assert isinstance(tracked.sweep, KeptSweep)
    tracked.sweep.forget_points()
    return dataclasses.replace(tracked, detections=without_points(tracked.detections))


def _describe_sequence(report: SequenceReport, options: TrackOptions) -> None:
    if not options.quiet:
        for sentence in report.warnings():
            print_warning(sentence)
    if options.speaks:
        stdout().print(report.describe(), markup=False)


def _describe_run(run: TrackReport, options: TrackOptions, elapsed_s: float) -> None:
    """The end of the run, in sentences or as the last line of JSON."""
    if run.interrupted:
        stderr().print("interrupted; the same command with --resume goes on.", markup=False)
    without = [sequence.name for sequence in run.sequences if not sequence.has_camera]
    if without:
        stderr().print(
            f"{len(without)} sequences have no camera calibration (the first is {without[0]}); KITTI text "
            "needs one, so their tracks are in JSON Lines instead.",
            markup=False,
        )
    if options.json:
        counts = {"done": run.num_done, "skipped": run.num_skipped, "interrupted": run.interrupted}
        sequences = [sequence.to_json() for sequence in run.sequences]
        summary = {**counts, "failures": reasons_as_json(run.failures), "sequences": sequences}
        print_json({"summary": summary})
    elif options.speaks:
        for line in run.describe(elapsed_s):
            stdout().print(line, markup=False)
