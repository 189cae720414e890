"""``jaxbox detect``: sweeps of files, folders and recordings to result files and pictures, one by one."""

import dataclasses
import json
import pathlib
import time
from collections.abc import Iterable, Sequence

import jax
import numpy as np

from jaxbox import io
from jaxbox.cli.console import ExitCode, make_progress, print_error, stderr, stdout, stoppable
from jaxbox.cli.report import (
    SHOWN_MIN_SCORE,
    FrameOutcome,
    FrameReport,
    RunReport,
    describe_frame,
    describe_run,
)
from jaxbox.cli.results import ResultFormat, Results, RunAccount
from jaxbox.cli.timing import TimedDetector
from jaxbox.config import DetectorConfig
from jaxbox.evaluation.iou import image_fractions
from jaxbox.io.jsonl import JSONL
from jaxbox.projection import project_boxes
from jaxbox.types import Calibration, Detections, PointCloud
from jaxbox.viz import BoxSet, draw_stages, save_png

PICTURE_FOLDER = "pictures"
SHOWN_PICTURES = ("boxes", "lidar", "image")
"""Of the pictures of the stages, those that show the answer."""
VEHICLE_TYPES = ("Car", "Van", "Truck")
DONT_CARE_SHARE = 0.5
"""A box with a larger share of its 2D box in one DontCare region is not judged."""

_project_boxes = jax.jit(project_boxes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectOptions:
    """The options of ``jaxbox detect``; the command's help explains them."""

    output: pathlib.Path
    """Folder for results and pictures."""
    config: DetectorConfig
    """The detector's settings."""
    formats: frozenset[ResultFormat]
    """What to write."""
    topic: str | None
    """Topic of the points in recordings."""
    capacity: int | None
    """Points a sweep is padded to, or None for what it needs."""
    min_score: float
    """Lower scores are left out."""
    points: bool
    """Whether MCAP and rerun files hold the points too."""
    pictures: bool
    """Whether pictures are drawn."""
    resume: bool
    """Whether sweeps with complete results are passed over."""
    quiet: bool
    """Whether only errors are printed."""
    json: bool
    """Whether stdout is JSON Lines."""

    @property
    def speaks(self) -> bool:
        """Whether sentences are printed."""
        return not (self.quiet or self.json)


def run_detect(paths: Sequence[str], options: DetectOptions) -> ExitCode:
    """Detects in every sweep of some paths; a broken one is reported and the others go on.

    Interrupted (Ctrl-C or SIGTERM), it closes its files, so that what is done is whole and can be resumed.

    Args:
      paths: what `jaxbox.io.open_sweeps` takes.
      options: the command's options.

    Returns:
      `ExitCode.FRAME_FAILED` where a sweep failed, or it was interrupted.

    Raises:
      InputError: where a path holds no sweeps, or the options cannot be used.
    """
    sweeps = io.open_sweeps(paths, topic=options.topic)
    options.output.mkdir(parents=True, exist_ok=True)
    account = RunAccount(
        output=options.output,
        config=options.config,
        options={"min_score": options.min_score, "capacity": options.capacity, "topic": options.topic},
        inputs=tuple(paths),
    )
    if options.resume:
        account.check_resumable()
    detector = TimedDetector(options.config)
    run = RunReport()
    with Results(
        options.output,
        options.formats,
        resume=options.resume,
        min_score=options.min_score,
        points=options.points,
    ) as results:
        account.write(finished=False)
        _run_sweeps(sweeps, detector, options, run, results)
    account.write(
        finished=not (run.interrupted or run.failures),
        interrupted=run.interrupted,
        num_done=len(run.frames),
        num_skipped=run.num_skipped,
        failures=[{"sweep": name, "reason": reason} for name, reason in run.failures],
    )
    _report(run, results, detector, options)
    return ExitCode.FRAME_FAILED if run.failures or run.interrupted else ExitCode.OK


def _run_sweeps(
    sweeps: Sequence[io.Sweep],
    detector: TimedDetector,
    options: DetectOptions,
    run: RunReport,
    results: Results,
) -> None:
    """Every sweep; ends early, with what is done, where it is interrupted or a recording breaks off."""
    with stoppable(), make_progress(shown=options.speaks) as progress:
        try:
            for sweep in progress.track(sweeps, description="detecting"):
                if results.is_finished(sweep.name):
                    run.num_skipped += 1
                else:
                    _run_frame(sweep, detector, options, run, results)
        except io.InputError as error:
            run.failures.append(("the recording", str(error)))
            print_error(str(error))
        except KeyboardInterrupt:
            run.interrupted = True


def _report(run: RunReport, results: Results, detector: TimedDetector, options: DetectOptions) -> None:
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
        failures = [{"sweep": name, "reason": reason} for name, reason in run.failures]
        counts = {"done": len(run.frames), "skipped": run.num_skipped, "interrupted": run.interrupted}
        _print_json({"summary": {**counts, "failures": failures}})
    elif options.speaks:
        for line in describe_run(run, detector.compile_s):
            stdout().print(line, markup=False)


def _print_json(value: dict) -> None:
    stdout().out(json.dumps(value, allow_nan=False), highlight=False)


def _run_frame(
    sweep: io.Sweep, detector: TimedDetector, options: DetectOptions, run: RunReport, results: Results
) -> None:
    """One sweep, its files and its lines; a failure is added to the run."""
    try:
        report = _process(sweep, detector, options, results)
    except (io.InputError, OSError) as error:
        run.failures.append((sweep.name, str(error)))
        print_error(f"sweep {sweep.name}: {error}")
        return
    run.frames.append(FrameOutcome.of(report))
    if options.speaks:
        for line in describe_frame(report, min_score=max(SHOWN_MIN_SCORE, options.min_score)):
            stdout().print(line, markup=False)


def _process(
    sweep: io.Sweep, detector: TimedDetector, options: DetectOptions, results: Results
) -> FrameReport:
    """Reads, detects, writes and draws; results are written before the pictures are tried."""
    start = time.perf_counter()
    xyz, intensity = sweep.read_points()
    calibration = sweep.read_calibration()
    image = sweep.read_image() if results.wants_image else None
    cloud = PointCloud.from_numpy(xyz, intensity, capacity=options.capacity)
    reading_s = time.perf_counter() - start
    detections, detect_s = detector(cloud)
    start = time.perf_counter()
    record = results.write(sweep, detections, calibration=calibration, points=(xyz, intensity), image=image)
    if options.json:
        health = detections.summary(options.config).to_dict()
        timing = {"num_points": len(xyz), "detect_ms": round(detect_s * 1e3, 3)}
        _print_json({**record, **timing, "health": health})
    if options.pictures:
        _write_pictures(sweep, cloud, detections, calibration, options)
    return FrameReport(
        name=sweep.name,
        num_points=len(xyz),
        detections=detections,
        detect_s=detect_s,
        other_s=reading_s + time.perf_counter() - start,
    )


def _write_pictures(
    sweep: io.Sweep,
    cloud: PointCloud,
    detections: Detections,
    calibration: Calibration | None,
    options: DetectOptions,
) -> None:
    min_score = max(SHOWN_MIN_SCORE, options.min_score)
    labels = sweep.read_labels()
    truth = judged = None
    if labels is not None and calibration is not None:
        truth = label_boxes(labels, calibration)
        shown = np.asarray(detections.valid) & (np.asarray(detections.score) >= min_score)
        judged = covered_by_labels(detections, labels, calibration)[shown]
    pictures = draw_stages(
        cloud,
        detections,
        calibration=calibration,
        image=sweep.read_image(),
        truth=truth,
        judged=judged,
        min_score=min_score,
    )
    for kind in SHOWN_PICTURES:
        if kind in pictures:
            save_png(options.output / PICTURE_FOLDER / f"{sweep.name}_{kind}.png", pictures[kind])


def label_boxes(labels: Iterable[io.KittiObject], calibration: Calibration) -> BoxSet:
    """The labelled vehicles, in the sensor frame."""
    vehicles = [label for label in labels if label.type in VEHICLE_TYPES]
    center, size, yaw = io.boxes_from_objects(vehicles, calibration)
    return BoxSet(center=center, size=size, yaw=yaw)


def covered_by_labels(
    detections: Detections, labels: Iterable[io.KittiObject], calibration: Calibration
) -> np.ndarray:
    """(K,) bool: boxes that the labels speak about, in the image and in no DontCare region.

    Args:
      detections: of one sweep.
      labels: all labels of the sweep.
      calibration: of the camera whose image was labelled.

    Returns:
      (K,) bool, padding included.
    """
    projected = _project_boxes(detections.center, detections.size, detections.yaw, calibration)
    boxes_px = np.asarray(projected.boxes_px, np.float64)
    covered = np.asarray(projected.visible).copy()
    for label in labels:
        if label.is_dont_care:
            covered &= (
                image_fractions(boxes_px, np.asarray([label.box_px], np.float64))[:, 0] <= DONT_CARE_SHARE
            )
    return covered
