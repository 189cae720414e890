"""Turned and mirrored copies of labelled sweeps.

Few labelled frames make a noisy figure: one borderline car is some points of average precision, and turning
the input by a few degrees moves it as much. Turned and mirrored copies are as good sweeps as the recorded
one, so a difference between two settings is judged by their mean next to their spread.
"""

import dataclasses
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.config import DetectorConfig
from jaxbox.evaluation.matching import count_points_in_boxes
from jaxbox.geometry.planar import wrap_turn, wrap_yaw
from jaxbox.geometry.rigid import rotation_about_z
from jaxbox.io import KittiObject, Sweep, boxes_from_objects, objects_from_detections
from jaxbox.run.compiled import detect
from jaxbox.types import Calibration, Detections, PointCloud, Status


@dataclasses.dataclass(frozen=True)
class Copy:
    """A sweep turned about the sensor, mirrored before where said."""

    turn_deg: float = 0.0
    """Turn about +z, degrees."""
    mirrored: bool = False
    """Whether left and right change places, before the turn."""

    @property
    def name(self) -> str:
        """Such as "+7.3" or "mirrored -13.9"."""
        if not self.turn_deg and not self.mirrored:
            return "as recorded"
        return f"{'mirrored ' if self.mirrored else ''}{self.turn_deg:+g}"


COPIES = (
    Copy(), Copy(7.3), Copy(-13.9, mirrored=True), Copy(29.4), Copy(-21.7, mirrored=True), Copy(45.1),
)  # fmt: skip
"""The recorded sweep, then turns that no grid or angle step of the detector divides."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """One labelled sweep, read once."""

    name: str
    """As `Sweep.name`."""
    xyz: np.ndarray
    """(n, 3) float32, m, sensor frame."""
    intensity: np.ndarray
    """(n,) float32, the file's own unit."""
    calibration: Calibration
    """Of the camera whose image was labelled."""
    labels: list[KittiObject]
    """Everything that is labelled."""


def read_frame(sweep: Sweep) -> Frame | None:
    """Reads a sweep with all that measuring it needs.

    Args:
      sweep: any sweep.

    Returns:
      The frame; None where the sweep has no labels or no calibration.

    Raises:
      InputError: naming the file, where it cannot be read.
    """
    labels, calibration = sweep.read_labels(), sweep.read_calibration()
    if labels is None or calibration is None:
        return None
    return Frame(sweep.name, *sweep.read_points(), calibration, labels)


def labelled_frames(sweeps: Iterable[Sweep]) -> list[Frame]:
    """The sweeps that have labels and a calibration, read.

    Args:
      sweeps: any sweeps.

    Returns:
      Their frames, in their order.

    Raises:
      InputError: naming the file, where one cannot be read.
    """
    return [frame for sweep in sweeps if (frame := read_frame(sweep)) is not None]


def turn_points(xyz: np.ndarray, copy: Copy) -> np.ndarray:
    """Points as a copy has them: mirrored left to right, then turned.

    Args:
      xyz: (n, 3) m, sensor frame.
      copy: how.

    Returns:
      (n, 3) float32, m.

    >>> turn_points(np.array([[1.0, 2.0, 3.0]]), Copy(90, mirrored=True)).round(3).tolist()
    [[2.0, 1.0, 3.0]]
    """
    mirror = np.array([1.0, -1.0 if copy.mirrored else 1.0, 1.0])
    return ((xyz * mirror) @ rotation_about_z(np.radians(copy.turn_deg)).T).astype(np.float32)


def turn_back(detections: Detections, copy: Copy) -> Detections:
    """Boxes of a copy as they stand in the recorded sweep.

    Args:
      detections: of the turned points.
      copy: how they were turned.

    Returns:
      The detections with another centre, yaw and heading.
    """
    center = np.asarray(detections.center, np.float64) @ rotation_about_z(np.radians(copy.turn_deg))
    if copy.mirrored:
        center = center * [1, -1, 1]

    def back(angle: jax.Array) -> jax.Array:
        turned = np.asarray(angle, np.float64) - np.radians(copy.turn_deg)
        return jnp.asarray(-turned if copy.mirrored else turned, jnp.float32)

    return dataclasses.replace(
        detections,
        center=jnp.asarray(center, jnp.float32),
        yaw=wrap_yaw(back(detections.yaw)),
        heading=wrap_turn(back(detections.heading)),
    )


def detect_copy(
    frame: Frame, copy: Copy, config: DetectorConfig, *, capacity: int | None = None
) -> tuple[list[KittiObject], Status]:
    """Detects in a copy of a frame.

    Args:
      frame: the labelled sweep.
      copy: how it is turned before.
      config: the settings.
      capacity: points that the copy is padded to; None for the smallest bucket that holds it.

    Returns:
      KITTI results as they stand in the recorded sweep, and what happened.

    Raises:
      ValueError: for settings that contradict each other.
    """
    cloud = PointCloud.from_numpy(turn_points(frame.xyz, copy), frame.intensity, capacity=capacity)
    found = jax.block_until_ready(detect(cloud, config))
    return objects_from_detections(turn_back(found, copy), frame.calibration), Status(int(found.status))


def label_points(frame: Frame) -> np.ndarray:
    """Counts LiDAR points within each label's box.

    Args:
      frame: the labelled sweep.

    Returns:
      (labels,) int; -1 for regions without a box.
    """
    boxed = [not label.is_dont_care for label in frame.labels]
    counts = np.full(len(boxed), -1)
    objects = [label for label in frame.labels if not label.is_dont_care]
    counts[boxed] = count_points_in_boxes(frame.xyz, *boxes_from_objects(objects, frame.calibration))
    return counts
