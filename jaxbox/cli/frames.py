"""What `jaxbox detect` does for each sweep before its results are written: here, or in worker processes."""

import concurrent.futures
import contextlib
import dataclasses
import functools
import pathlib
import time
from collections.abc import Callable, Generator, Iterable, Mapping

import numpy as np

from jaxbox import io
from jaxbox.cli.box_filter import BoxFilter
from jaxbox.cli.crops import write_crops
from jaxbox.cli.run_sheet import TILE_FRAME
from jaxbox.cli.timing import TimedDetector
from jaxbox.config import DetectorConfig
from jaxbox.evaluation.iou import image_fractions
from jaxbox.io.kitti import boxes_in_image
from jaxbox.io.points import Points
from jaxbox.run.processes import ProcessPool, ahead
from jaxbox.types import Calibration, Detections, PointCloud
from jaxbox.viz import BoxSet, draw_bird_eye, draw_image_boxes, draw_stages, save_png
from jaxbox.viz.colors import color_by_height
from jaxbox.viz.image_boxes import scale_camera
from jaxbox.viz.stages import height_above_plane

SHOWN_PICTURES = ("boxes", "lidar", "image")
"""Of the pictures of the stages, those that show the answer."""
DONT_CARE_SHARE = 0.5
"""A box with a larger share of its 2D box in one DontCare region is not judged."""


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
    """Why pictures or crops could not be made; None where they could, or were not wanted."""


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
    keep: BoxFilter
    """Which boxes are kept of those that are found."""
    picture_folder: pathlib.Path | None
    """Where pictures go; None for none."""
    crop_folder: pathlib.Path | None
    """Where the points in each box go; None for nowhere."""
    tiles: Mapping[str, pathlib.Path]
    """Where pictures for the contact sheet go, by the names of the sweeps that are on it."""
    shown_min_score: float
    """Boxes that score less are neither drawn nor cropped."""
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
        detections = self.keep(detections.on_host())
        picture_error = None
        try:
            self._draw(read, cloud, detections)
        except (io.InputError, OSError) as error:
            # The results do not depend on whether they can be drawn.
            picture_error = error
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

    def _draw(self, read: _Read, cloud: PointCloud, detections: Detections) -> None:
        """Writes crops and pictures where they are wanted."""
        name, min_score = read.sweep.name, self.shown_min_score
        if self.crop_folder is not None:
            write_crops(self.crop_folder, name, read.points, enumerate(detections), min_score=min_score)
        # Read once for both; an error is raised again.
        judge = functools.cache(lambda: _judge(read, detections, min_score))
        if name in self.tiles:
            # No sweep fails for want of a picture that nobody asked for.
            with contextlib.suppress(io.InputError, OSError):
                save_png(self.tiles[name], _draw_tile(read, detections, judge(), min_score))
        if self.picture_folder is not None:
            shown = judge()
            pictures = draw_stages(
                cloud,
                detections,
                calibration=read.calibration,
                image=shown.image,
                truth=shown.truth,
                judged=shown.judged,
                min_score=min_score,
            )
            for kind in SHOWN_PICTURES:
                if kind in pictures:
                    save_png(self.picture_folder / f"{name}_{kind}.png", pictures[kind])


@dataclasses.dataclass(frozen=True)
class _Shown:
    """What pictures of a sweep show besides its points and boxes, each None where there is none."""

    image: np.ndarray | None
    """(h, w, 3) uint8, red green blue."""
    truth: BoxSet | None
    """Labelled vehicles."""
    judged: np.ndarray | None
    """(boxes from the score on,) bool: those that the labels speak about."""


def _judge(read: _Read, detections: Detections, min_score: float) -> _Shown:
    labels, calibration = read.sweep.read_labels(), read.calibration
    image = read.sweep.read_image() if read.image is None else read.image
    if labels is None or calibration is None:
        return _Shown(image, None, None)
    shown = np.asarray(detections.valid) & (np.asarray(detections.score, np.float64) >= min_score)
    covered = covered_by_labels(detections, labels, calibration)
    return _Shown(image, label_boxes(labels, calibration), covered[shown])


def _draw_tile(read: _Read, detections: Detections, shown: _Shown, min_score: float) -> np.ndarray:
    """The sweep from above, under the camera's image where there is one, at the width of a tile."""
    xyz = np.asarray(read.points[0], np.float64)
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    boxes = BoxSet.from_detections(detections, min_score=min_score)
    common = {"boxes": boxes, "truth": shown.truth, "judged": shown.judged, "legend": False}
    colors = color_by_height(height_above_plane(xyz, detections))
    above = draw_bird_eye(xyz, colors=colors, frame=TILE_FRAME, title=read.sweep.name, **common)
    if shown.image is None or read.calibration is None:
        return above
    scaled, camera = scale_camera(shown.image, read.calibration, width_px=above.shape[1])
    return np.concatenate([draw_image_boxes(scaled, camera, **common), above])


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
    boxes_px, _, covered = boxes_in_image(
        np.asarray(detections.center), np.asarray(detections.size), np.asarray(detections.yaw), calibration
    )
    for label in labels:
        if label.is_dont_care:
            covered &= (
                image_fractions(boxes_px, np.asarray([label.box_px], np.float64))[:, 0] <= DONT_CARE_SHARE
            )
    return covered
