"""One sweep, wherever it lies: its name, its time, and readers of what belongs to it."""

import dataclasses
import os
import pathlib

import jax.numpy as jnp
import numpy as np

from jaxbox._files import InputError
from jaxbox.io.convention import ORDINARY, PointConvention
from jaxbox.io.images import read_image, read_image_size
from jaxbox.io.kitti import KittiObject, read_labels
from jaxbox.io.kitti_calibration import IMAGE_SIZE_PX, read_calibration, read_raw_calibration
from jaxbox.io.points import BIN, Points, RecordedPoints, TimedPoints, read_bin
from jaxbox.io.registry import format_of, read_points, read_timed_points
from jaxbox.types import Calibration

_END_OF_TIME_NS = 2**63


@dataclasses.dataclass(frozen=True)
class Sweep:
    """One LiDAR sweep and the files that belong to it; nothing is read before it is asked for."""

    name: str
    """Unique among the sweeps of a folder, fit for a file name: "000001", "0000_000001" (tracking),
    "2011_09_26_drive_0052_sync_0000000001" (raw) or "drive_000001" (second sweep of ``drive.bag``)."""
    points_path: pathlib.Path
    """The points, or the recording that holds them."""
    calibration_path: pathlib.Path | None = None
    """A ``calib/*.txt`` file, or for raw recordings the day's folder; None where there is none."""
    labels_path: pathlib.Path | None = None
    """The label file; None where there is none."""
    image_path: pathlib.Path | None = None
    """The left colour camera's image; None where there is none."""
    frame: int | None = None
    """Frame within the sequence, which picks this sweep's lines of a tracking label file."""
    timestamp_ns: int | None = None
    """When it was taken, ns since 1970, as far as file name or recording say; None where they do not, or
    where it is before 1970 or after 2262, which the results' integers of 64 bits end with."""
    sequence: str | None = None
    """The drive that it belongs to: "0000" (tracking), the raw drive, nuScenes' log, Argoverse 2's log, the
    recording's name, or the folder's; None where that is not known."""
    decode: RecordedPoints | None = dataclasses.field(default=None, repr=False, compare=False)
    """Decodes the points of a sweep within a recording; None where `points_path` holds this sweep alone."""
    convention: PointConvention = ORDINARY
    """How its numbers are to be taken; what is read of it is in metres, x forward, y left, z up."""

    def __post_init__(self) -> None:
        """Keeps what a file or index claims within what results can hold.

        Raises:
          InputError: for a name that would lead out of the folder of the results.
        """
        is_plain = self.name not in ("", "..") and pathlib.PurePath(self.name).name == self.name
        if not is_plain or "\0" in self.name:
            raise InputError(
                f"{self.points_path}: its sweep would be named {self.name!r}, and results are named by it; "
                "rename the file, or give a name without folders."
            )
        # Bytes of a file's name that are not UTF-8 can neither be printed nor written.
        for field in ("name", "sequence"):
            if (text := getattr(self, field)) is not None:
                printable = os.fsencode(text).decode("utf-8", "backslashreplace")
                object.__setattr__(self, field, printable)
        if self.timestamp_ns is not None and not 0 <= self.timestamp_ns < _END_OF_TIME_NS:
            object.__setattr__(self, "timestamp_ns", None)

    def read_points(self) -> Points:
        """Reads the points.

        Returns:
          xyz: (n, 3) float32, m, sensor frame; NaN and infinity are kept for the detector to count.
          intensity: (n,) float32, the file's own unit; 0 where unknown.

        Raises:
          InputError: naming the file, where it cannot be read.
          ImportError: naming the extra that its format needs, where that is not installed.
        """
        xyz, intensity = self._source_points()
        return self.convention.apply(xyz), intensity

    def _source_points(self) -> Points:
        if self.decode is not None:
            return self.decode()
        if self.convention.columns is not None and format_of(self.points_path) is BIN:
            return read_bin(self.points_path, columns=self.convention.columns)
        return read_points(self.points_path)

    def read_timed_points(self) -> TimedPoints:
        """Reads the points, and when each was measured.

        Returns:
          As `read_points`, with ``time_s`` (n,) float64, s from the sweep's time; None where the source does
          not say. See `jaxbox.io.TimedPoints`.

        Raises:
          InputError: naming the file, where it cannot be read, or the unit of the times is not clear.
          ImportError: naming the extra that its format needs, where that is not installed.
        """
        if self.decode is not None:
            points = self.decode.timed()
        elif format_of(self.points_path) is BIN:
            points = TimedPoints(*self._source_points())
        else:
            points = read_timed_points(self.points_path)
        return dataclasses.replace(points, xyz=self.convention.apply(points.xyz))

    def read_calibration(self) -> Calibration | None:
        """Reads the calibration of the left colour camera.

        Returns:
          The camera, with the image's size; or the raw calibration's size, or 1242 x 375, where there
          is not an image. None where the sweep has no calibration.

        Raises:
          InputError: naming the file, where it or the image's size cannot be read.
        """
        if self.calibration_path is None:
            return None
        size = None if self.image_path is None else read_image_size(self.image_path)
        if self.calibration_path.is_dir():
            calibration = read_raw_calibration(self.calibration_path, image_size_px=size)
        else:
            calibration = read_calibration(self.calibration_path, image_size_px=size or IMAGE_SIZE_PX)
        if self.convention == ORDINARY:
            return calibration
        return seen_from_frame(calibration, self.convention.T_points_source)

    def read_labels(self) -> list[KittiObject] | None:
        """Reads the labels of this sweep.

        Returns:
          The objects, none of them for an empty frame; or None where the sweep has no labels.

        Raises:
          InputError: naming file and line, where it cannot be read.
        """
        return None if self.labels_path is None else read_labels(self.labels_path, frame=self.frame)

    def read_image(self) -> np.ndarray | None:
        """Reads the left colour camera's image.

        Returns:
          (height, width, 3) uint8, RGB; or None where the sweep has no image.

        Raises:
          InputError: naming the file, where it cannot be decoded.
        """
        return None if self.image_path is None else read_image(self.image_path)


def seen_from_frame(calibration: Calibration, T_frame_points: np.ndarray) -> Calibration:
    """The same camera, for points in another frame.

    Args:
      calibration: for the points as they are.
      T_frame_points: (4, 4) float64, m, from the points as they are to the frame.

    Returns:
      The calibration for the frame.
    """
    T = np.asarray(calibration.T_rect_velo, np.float64) @ np.linalg.inv(T_frame_points)
    return dataclasses.replace(calibration, T_rect_velo=jnp.asarray(T, jnp.float32))
