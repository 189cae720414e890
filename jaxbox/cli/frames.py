"""What `jaxbox detect` does for each sweep before its results are written: here, or in worker processes."""

import concurrent.futures
import dataclasses
import pathlib
import time
from collections.abc import Callable, Generator, Iterable

import jax
import numpy as np

from jaxbox import io
from jaxbox.cli.timing import TimedDetector
from jaxbox.config import DetectorConfig
from jaxbox.evaluation.iou import image_fractions
from jaxbox.geometry.projection import project_boxes
from jaxbox.io.points import Points
from jaxbox.run.processes import ProcessPool, ahead
from jaxbox.types import Calibration, Detections, PointCloud
from jaxbox.viz import BoxSet, draw_stages, save_png

SHOWN_PICTURES = ("boxes", "lidar", "image")
"""Of the pictures of the stages, those that show the answer."""
DONT_CARE_SHARE = 0.5
"""A box with a larger share of its 2D box in one DontCare region is not judged."""

_project_boxes = jax.jit(project_boxes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Frame:
    """One sweep that was detected, and what its results need."""

    num_points: int
    """Points of the sweep."""
    detections: Detections
    """What was found, in arrays of the host."""
    calibration: Calibration | None
    """Of the camera; None where there is none."""
    points: Points | None
    """The points, where a result file holds them."""
    image: np.ndarray | None
    """The camera's image, where a result file holds it."""
    detect_s: float
    """Seconds in the detector, without compiling."""
    other_s: float
    """Seconds of reading and drawing."""
    compile_s: dict[int, float]
    """Seconds that each capacity took to compile, in the process that did this sweep."""
    picture_error: Exception | None
    """Why the pictures could not be drawn; None where they could, or were not wanted."""


FrameSource = Generator[tuple[io.Sweep, Callable[[], Frame]], None, None]
"""Each sweep and what waits for its frame; it raises what reading or detecting raised."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Read:
    """A sweep before it is detected."""

    sweep: io.Sweep
    points: Points
    calibration: Calibration | None
    image: np.ndarray | None
    seconds: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrameWork:
    """What is to be done for each sweep."""

    config: DetectorConfig
    """The detector's settings."""
    capacity: int | None
    """Points a sweep is padded to, or None for what it needs."""
    picture_folder: pathlib.Path | None
    """Where pictures go; None for none."""
    shown_min_score: float
    """Boxes that score less are not drawn."""
    keep_points: bool
    """Whether results need the points."""
    keep_image: bool
    """Whether results need the image."""

    def run(self, sweeps: Iterable[io.Sweep]) -> FrameSource:
        """Works here, and reads the next sweep meanwhile.

        Args:
          sweeps: asked for one ahead.
        """
        detector = TimedDetector(self.config)
        with concurrent.futures.ThreadPoolExecutor(1) as reader:
            for sweep, reading in ahead(sweeps, lambda sweep: reader.submit(self._read, sweep), 1):
                yield sweep, lambda reading=reading: self._finish(reading.result(), detector)

    def run_apart(
        self, sweeps: Iterable[io.Sweep], jobs: int, on_death: Callable[[io.Sweep, str], None]
    ) -> FrameSource:
        """Works in processes.

        Args:
          sweeps: asked for a few ahead.
          jobs: number of processes.
          on_death: told of each sweep whose process died, and how, when it is tried once more.
        """
        with ProcessPool(self.start, jobs) as pool:
            for sweep, job in ahead(sweeps, pool.submit, 2 * jobs):
                concurrent.futures.wait([job])
                for unlucky, how in pool.take_deaths():
                    on_death(unlucky, how)
                yield sweep, job.result

    def start(self) -> Callable[[io.Sweep], Frame]:
        """In a worker process: what takes each sweep."""
        detector = TimedDetector(self.config)
        return lambda sweep: self._finish(self._read(sweep), detector)

    def _read(self, sweep: io.Sweep) -> _Read:
        start = time.perf_counter()
        return _Read(
            sweep=sweep,
            points=sweep.read_points(),
            calibration=sweep.read_calibration(),
            image=sweep.read_image() if self.keep_image else None,
            seconds=time.perf_counter() - start,
        )

    def _finish(self, read: _Read, detector: TimedDetector) -> Frame:
        start = time.perf_counter()
        cloud = PointCloud.from_numpy(*read.points, capacity=self.capacity)
        padding_s = time.perf_counter() - start
        detections, detect_s = detector(cloud)
        start = time.perf_counter()
        detections = detections.on_host()
        picture_error = self._draw(read, cloud, detections)
        return Frame(
            num_points=len(read.points[0]),
            detections=detections,
            calibration=read.calibration,
            points=read.points if self.keep_points else None,
            image=read.image,
            detect_s=detect_s,
            other_s=read.seconds + padding_s + time.perf_counter() - start,
            compile_s=dict(detector.compile_s),
            picture_error=picture_error,
        )

    def _draw(self, read: _Read, cloud: PointCloud, detections: Detections) -> Exception | None:
        """Draws the pictures where they are wanted; the results do not depend on whether they can be."""
        if self.picture_folder is None:
            return None
        try:
            _write_pictures(read, cloud, detections, self.picture_folder, self.shown_min_score)
        except (io.InputError, OSError) as error:
            return error
        return None


def _write_pictures(
    read: _Read, cloud: PointCloud, detections: Detections, folder: pathlib.Path, min_score: float
) -> None:
    sweep, calibration = read.sweep, read.calibration
    labels = sweep.read_labels()
    truth = judged = None
    if labels is not None and calibration is not None:
        truth = label_boxes(labels, calibration)
        shown = np.asarray(detections.valid) & (np.asarray(detections.score, np.float64) >= min_score)
        judged = covered_by_labels(detections, labels, calibration)[shown]
    pictures = draw_stages(
        cloud,
        detections,
        calibration=calibration,
        image=sweep.read_image() if read.image is None else read.image,
        truth=truth,
        judged=judged,
        min_score=min_score,
    )
    for kind in SHOWN_PICTURES:
        if kind in pictures:
            save_png(folder / f"{sweep.name}_{kind}.png", pictures[kind])


def label_boxes(labels: Iterable[io.KittiObject], calibration: Calibration) -> BoxSet:
    """The labelled vehicles, in the sensor frame."""
    vehicles = [label for label in labels if label.type in io.VEHICLE_TYPES]
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
