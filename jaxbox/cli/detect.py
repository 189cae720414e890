"""``jaxbox detect``: sweeps of a folder to result files and pictures, one after the other."""

import dataclasses
import enum
import pathlib
import time
from collections.abc import Iterable

import jax
import numpy as np

from jaxbox import io
from jaxbox.cli.console import ExitCode, make_progress, print_error, stderr, stdout
from jaxbox.cli.report import (
    SHOWN_MIN_SCORE,
    FrameOutcome,
    FrameReport,
    RunReport,
    describe_frame,
    describe_run,
)
from jaxbox.cli.timing import TimedDetector
from jaxbox.config import DetectorConfig
from jaxbox.evaluation.iou import image_fractions
from jaxbox.projection import project_boxes
from jaxbox.types import Calibration, Detections, PointCloud
from jaxbox.viz import BoxSet, draw_stages, save_png

PICTURE_FOLDER = "pictures"
JSONL_NAME = "detections.jsonl"
SHOWN_PICTURES = ("boxes", "lidar", "image")
"""Of the pictures of the stages, those that show the answer."""
VEHICLE_TYPES = ("Car", "Van", "Truck")
DONT_CARE_SHARE = 0.5
"""A box with a larger share of its 2D box in one DontCare region is not judged."""

_project_boxes = jax.jit(project_boxes)


class ResultFormat(enum.StrEnum):
    """What `detect` writes."""

    KITTI = "kitti"
    JSONL = "jsonl"
    BOTH = "both"


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectOptions:
    """The options of ``jaxbox detect``; the command's help explains them."""

    output: pathlib.Path
    """Folder for results and pictures."""
    config: DetectorConfig
    """The detector's settings."""
    result_format: ResultFormat
    """What to write."""
    capacity: int | None
    """Points a sweep is padded to, or None for what it needs."""
    min_score: float
    """Lower scores are left out."""
    pictures: bool
    """Whether pictures are drawn."""
    quiet: bool
    """Whether only errors are printed."""


def run_detect(path: pathlib.Path, options: DetectOptions) -> ExitCode:
    """Detects in every sweep below a path; a broken one is reported and the others go on.

    Args:
      path: what `jaxbox.io.open_sweeps` takes.
      options: the command's options.

    Returns:
      `ExitCode.FRAME_FAILED` where a sweep failed.

    Raises:
      InputError: where the path holds no sweeps.
    """
    sweeps = io.open_sweeps(path)
    options.output.mkdir(parents=True, exist_ok=True)
    detector = TimedDetector(options.config)
    run = RunReport()
    try:
        with make_progress(shown=not options.quiet) as progress:
            for sweep in progress.track(sweeps, description="detecting"):
                _run_frame(sweep, detector, options, run)
    finally:
        # Also when interrupted: what is done is not lost.
        if run.records:
            io.write_jsonl(options.output / JSONL_NAME, run.records)
    _note_missing_cameras(run, options)
    if not options.quiet:
        for line in describe_run(run, detector.compile_s):
            stdout().print(line, markup=False)
    return ExitCode.FRAME_FAILED if run.failures else ExitCode.OK


def _note_missing_cameras(run: RunReport, options: DetectOptions) -> None:
    if run.without_camera:
        first, count = run.without_camera[0], len(run.without_camera)
        stderr().print(
            f"{count} sweeps have no camera calibration (the first is {first}); KITTI text needs one, so "
            f"their boxes are in {options.output / JSONL_NAME} instead.",
            markup=False,
        )


def _run_frame(sweep: io.Sweep, detector: TimedDetector, options: DetectOptions, run: RunReport) -> None:
    """One sweep, its files and its lines; a failure is added to the run."""
    try:
        report = _process(sweep, detector, options, run)
    except (io.InputError, OSError) as error:
        run.failures.append((sweep.name, str(error)))
        print_error(f"sweep {sweep.name}: {error}")
        return
    run.frames.append(FrameOutcome.of(report))
    if not options.quiet:
        for line in describe_frame(report, min_score=max(SHOWN_MIN_SCORE, options.min_score)):
            stdout().print(line, markup=False)


def _process(sweep: io.Sweep, detector: TimedDetector, options: DetectOptions, run: RunReport) -> FrameReport:
    """Reads, detects, writes and draws; results are written before the pictures are tried."""
    start = time.perf_counter()
    xyz, intensity = sweep.read_points()
    calibration = sweep.read_calibration()
    cloud = PointCloud.from_numpy(xyz, intensity, capacity=options.capacity)
    reading_s = time.perf_counter() - start
    detections, detect_s = detector(cloud)
    start = time.perf_counter()
    _write_results(sweep.name, detections, calibration, options, run)
    if options.pictures:
        _write_pictures(sweep, cloud, detections, calibration, options)
    return FrameReport(
        name=sweep.name,
        num_points=len(xyz),
        detections=detections,
        detect_s=detect_s,
        other_s=reading_s + time.perf_counter() - start,
    )


def _write_results(
    name: str, detections: Detections, calibration: Calibration | None, options: DetectOptions, run: RunReport
) -> None:
    """KITTI text where there is a camera; JSON Lines where asked for, or where there is none."""
    wants_text = options.result_format is not ResultFormat.JSONL
    if wants_text and calibration is not None:
        objects = io.objects_from_detections(detections, calibration, min_score=options.min_score)
        io.write_labels(options.output / f"{name}.txt", objects)
    if wants_text and calibration is None:
        run.without_camera.append(name)
    if options.result_format is not ResultFormat.KITTI or calibration is None:
        run.records.append(io.detections_record(name, detections, min_score=options.min_score))


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
