"""From a path to sweeps: which points, calibration, labels and image belong together.

Three of KITTI's layouts are known, at the dataset's root or any folder below, and plain folders:

- object: ``training/{velodyne,calib,label_2,image_2}/000001.*``
- tracking: ``training/velodyne/0000/000001.bin``, ``training/{calib,label_02}/0000.txt``,
  ``training/image_02/0000/000001.png``
- raw: ``2011_09_26/2011_09_26_drive_0052_sync/{velodyne_points,image_02}/data/0000000001.*``, with the
  calibration files beside the drive
- plain: a folder of point files, or one, without anything else.

What belongs to a sweep follows from where its points lie, so it is the same however it was reached.
"""

import dataclasses
import os
import pathlib
from collections.abc import Iterator

import numpy as np

from jaxbox.io._files import InputError
from jaxbox.io.images import read_image
from jaxbox.io.kitti import KittiObject, read_labels, tracking_name
from jaxbox.io.kitti_calibration import (
    IMAGE_SIZE_PX,
    RAW_CALIBRATION_FILES,
    read_calibration,
    read_raw_calibration,
)
from jaxbox.io.points import POINT_SUFFIXES, TEXT_SUFFIXES, read_points
from jaxbox.types import Calibration

_FOLDERS = (
    "velodyne", "velodyne/*", "*",
    "training/velodyne", "training/velodyne/*",
    "data", "velodyne_points/data", "*/velodyne_points/data", "*/*/velodyne_points/data",
)  # fmt: skip
"""Where points may lie below a given folder, after the folder itself."""

_SEARCHED = tuple(folder for folder in _FOLDERS if folder != "*")

_IMAGE_SUFFIXES = (".png", ".jpg")


@dataclasses.dataclass(frozen=True)
class Sweep:
    """One LiDAR sweep and the files that belong to it; nothing is read before it is asked for."""

    name: str
    """Unique among the sweeps of a folder, fit for a file name: "000001", "0000_000001" (tracking) or
    "2011_09_26_drive_0052_sync_0000000001" (raw)."""
    points_path: pathlib.Path
    """The points."""
    calibration_path: pathlib.Path | None = None
    """A ``calib/*.txt`` file, or for raw recordings the day's folder; None where there is none."""
    labels_path: pathlib.Path | None = None
    """The label file; None where there is none."""
    image_path: pathlib.Path | None = None
    """The left colour camera's image; None where there is none."""
    frame: int | None = None
    """Frame within the sequence, which picks this sweep's lines of a tracking label file."""

    def read_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Reads the points.

        Returns:
          xyz: (n, 3) float32, m, sensor frame.
          intensity: (n,) float32, the file's own unit; 0 where unknown.

        Raises:
          InputError: naming the file, where it cannot be read.
        """
        return read_points(self.points_path)

    def read_calibration(self) -> Calibration | None:
        """Reads the calibration of the left colour camera.

        Returns:
          The camera, with the image's size; or the raw calibration's size, or 1242 x 375, where there
          is no image. None where the sweep has no calibration.

        Raises:
          InputError: naming the file, where it or the image cannot be read.
        """
        if self.calibration_path is None:
            return None
        image = self.read_image()
        size = None if image is None else (image.shape[1], image.shape[0])
        if self.calibration_path.is_dir():
            return read_raw_calibration(self.calibration_path, image_size_px=size)
        return read_calibration(self.calibration_path, image_size_px=size or IMAGE_SIZE_PX)

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


def open_sweeps(path: str | os.PathLike[str]) -> tuple[Sweep, ...]:
    """Finds the sweeps at a path; see the module for the layouts.

    Args:
      path: a point file, a folder of point files, or a KITTI folder.

    Returns:
      At least one sweep, sorted by path; their names differ.

    Raises:
      InputError: where there is no such path, or no points in it.
    """
    # Not `resolve`: datasets are often put together from links, and the layout is in the links' names.
    path = pathlib.Path(os.path.abspath(path))
    if path.is_file():
        return (_sweep_at(path),)
    if not path.is_dir():
        raise InputError(f"{path}: there is no such file or folder; check the path.")
    if files := _find_points(path):
        return tuple(_sweep_at(file) for file in files)
    raise InputError(
        f"{path}: no points there. Give a point file ({', '.join(POINT_SUFFIXES)}), a folder of them, or a "
        f"folder that holds {', '.join(_SEARCHED)}."
    )


def _find_points(path: pathlib.Path) -> list[pathlib.Path]:
    """The point files of the first place that has any, all of one kind."""
    layouts = list(_layout_folders(path))
    # Binary points are taken where they lie, but .txt files beside a known layout are its calibration.
    searches = [(suffix, folders) for suffix in TEXT_SUFFIXES for folders in [*layouts, [path]]]
    searches = [(".bin", folders) for folders in [[path], *layouts]] + searches
    return next((files for search in searches if (files := _point_files(*search))), [])


def _layout_folders(path: pathlib.Path) -> Iterator[list[pathlib.Path]]:
    """Sets of folders that may hold the points, by layout."""
    for pattern in _FOLDERS:
        # Any subfolder of "velodyne" is a sequence; elsewhere it could be anything, such as labels.
        if pattern != "*" or path.name == "velodyne":
            yield sorted(folder for folder in path.glob(pattern) if folder.is_dir())


def _point_files(suffix: str, folders: list[pathlib.Path]) -> list[pathlib.Path]:
    files = [file for folder in folders for file in sorted(folder.glob(f"*{suffix}"))]
    # Hidden files are other programs' leftovers.
    return [file for file in files if not file.name.startswith(".")]


def _sweep_at(file: pathlib.Path) -> Sweep:
    folder = file.parent
    if folder.name == "velodyne":
        return _object_sweep(file, folder.parent)
    if folder.parent.name == "velodyne" and file.stem.isdecimal():
        return _tracking_sweep(file, folder.parent.parent)
    if folder.name == "data" and folder.parent.name == "velodyne_points":
        return _raw_sweep(file, folder.parent.parent)
    return Sweep(file.stem, file)


def _object_sweep(file: pathlib.Path, root: pathlib.Path) -> Sweep:
    return Sweep(
        name=file.stem,
        points_path=file,
        calibration_path=_existing(root / "calib" / f"{file.stem}.txt"),
        labels_path=_existing(root / "label_2" / f"{file.stem}.txt"),
        image_path=_image(root / "image_2", file.stem),
    )


def _tracking_sweep(file: pathlib.Path, root: pathlib.Path) -> Sweep:
    sequence, frame = file.parent.name, int(file.stem)
    return Sweep(
        name=tracking_name(sequence, frame),
        points_path=file,
        calibration_path=_existing(root / "calib" / f"{sequence}.txt"),
        labels_path=_existing(root / "label_02" / f"{sequence}.txt"),
        image_path=_image(root / "image_02" / sequence, file.stem),
        frame=frame,
    )


def _raw_sweep(file: pathlib.Path, drive: pathlib.Path) -> Sweep:
    # One of the two alone is a mistake, which reading them will name.
    calibrated = any((drive.parent / name).is_file() for name in RAW_CALIBRATION_FILES)
    return Sweep(
        name=f"{drive.name}_{file.stem}",
        points_path=file,
        calibration_path=drive.parent if calibrated else None,
        image_path=_image(drive / "image_02" / "data", file.stem),
    )


def _existing(path: pathlib.Path) -> pathlib.Path | None:
    return path if path.is_file() else None


def _image(folder: pathlib.Path, stem: str) -> pathlib.Path | None:
    paths = (folder / f"{stem}{suffix}" for suffix in _IMAGE_SUFFIXES)
    return next((path for path in paths if path.is_file()), None)
