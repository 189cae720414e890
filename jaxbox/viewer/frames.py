"""Sweeps as the page shows them: each read whole, in any order."""

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import numpy as np

from jaxbox import io
from jaxbox.types import Calibration, PointCloud
from jaxbox.viz import BoxSet

_T = TypeVar("_T")

FAR_M = 1000.0
"""Points farther along an axis are errors of the sensor, and would make the scene too large to draw."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Frame:
    """One sweep and what belongs to it, read."""

    name: str
    """Of the sweep."""
    timestamp_ns: int | None = None
    """ns since 1970, or None where it is unknown."""
    num_points: int
    """Points of the sweep, with those that are not finite or beyond the capacity."""
    cloud: PointCloud
    """What the detector takes."""
    rows: np.ndarray
    """(n,) int64: rows of the cloud whose point can be drawn: finite, within `FAR_M`."""
    xyz: np.ndarray
    """(n, 3) float32, m, sensor frame: those points."""
    intensity: np.ndarray
    """(n,) float32: theirs."""
    calibration: Calibration | None = None
    """Of the camera, where there is one."""
    image: np.ndarray | None = None
    """(h, w, 3) uint8, RGB, where there is one."""
    vehicles: BoxSet | None = None
    """Labelled vehicles, their types as captions; None where the source has no labels."""
    others: BoxSet | None = None
    """Other labelled objects, likewise."""
    read_s: float = 0.0
    """Seconds of reading."""
    problems: tuple[str, ...] = ()
    """What could not be read besides the points, in words."""

    @classmethod
    def of_points(
        cls,
        name: str,
        xyz: np.ndarray,
        intensity: np.ndarray | None,
        *,
        timestamp_ns: int | None = None,
        capacity: int | None = None,
    ) -> "Frame":
        """A sweep that is points alone.

        Args:
          name: of the sweep.
          xyz: (n, 3) real, m, sensor frame.
          intensity: (n,) real, or None.
          timestamp_ns: ns since 1970, or None.
          capacity: points that it is padded to; None for what it needs.

        Returns:
          The frame.
        """
        cloud = PointCloud.from_numpy(xyz, intensity, capacity=capacity)
        rows = _drawable_rows(cloud)
        return cls(
            name=name,
            timestamp_ns=timestamp_ns,
            num_points=len(xyz),
            cloud=cloud,
            rows=rows,
            xyz=np.asarray(cloud.xyz1)[rows, :3],
            intensity=np.asarray(cloud.intensity)[rows],
        )

    @classmethod
    def read(cls, sweep: io.Sweep, *, capacity: int | None = None) -> "Frame":
        """Reads a sweep; where only its image, calibration or labels are broken, it goes without them.

        Args:
          sweep: the sweep.
          capacity: points that it is padded to; None for what it needs.

        Returns:
          The frame.

        Raises:
          InputError: where the points cannot be read.
        """
        start = time.perf_counter()
        points = cls.of_points(
            sweep.name, *sweep.read_points(), timestamp_ns=sweep.timestamp_ns, capacity=capacity
        )
        problems: list[str] = []
        image = _attempt(sweep.read_image, problems)
        calibration = _attempt(sweep.read_calibration, problems)
        labels = _attempt(sweep.read_labels, problems)
        vehicles, others = _label_boxes(labels, calibration)
        return dataclasses.replace(
            points,
            calibration=calibration,
            image=image,
            vehicles=vehicles,
            others=others,
            read_s=time.perf_counter() - start,
            # A broken image is met twice: the calibration asks it for its size.
            problems=tuple(dict.fromkeys(problems)),
        )


class Frames:
    """Frames by number. The next one of a recording costs no new pass over it."""

    def __init__(self, sweeps: Sequence[io.Sweep], *, capacity: int | None = None) -> None:
        """Takes what `jaxbox.io.open_sweeps` answers; nothing is read yet."""
        self._sweeps, self._capacity = sweeps, capacity
        self._pass: Iterator[io.Sweep] = iter(())
        self._next = len(sweeps)

    def __len__(self) -> int:
        """How many sweeps there are."""
        return len(self._sweeps)

    def read(self, index: int) -> Frame:
        """Reads one.

        Args:
          index: from 0.

        Returns:
          The frame.

        Raises:
          InputError: where it cannot be read; the others still can.
          ImportError: naming the extra that its format needs, where that is not installed.
        """
        return Frame.read(self._sweep(index), capacity=self._capacity)

    def _sweep(self, index: int) -> io.Sweep:
        if isinstance(self._sweeps, tuple):
            return self._sweeps[index]
        # An item of a recording by its number is a pass up to it, so one pass is kept and goes on.
        if index < self._next:
            self._pass, self._next = iter(self._sweeps), 0
        skipped, self._next = index - self._next, len(self._sweeps)
        found = next(itertools.islice(self._pass, skipped, None), None)
        if found is None:
            raise io.InputError(f"sweep {index}: the recording ends before it; it may be cut off.")
        self._next = index + 1
        return found


def _drawable_rows(cloud: PointCloud) -> np.ndarray:
    xyz1 = np.asarray(cloud.xyz1)
    # Comparisons with NaN are false.
    return np.flatnonzero((xyz1[:, 3] > 0) & (np.abs(xyz1) < FAR_M).all(axis=1))


def _attempt(read: Callable[[], _T], problems: list[str]) -> _T | None:
    """What a reader answers, or None and its error in words."""
    try:
        return read()
    except io.InputError as error:
        problems.append(str(error))
        return None


def _label_boxes(
    labels: list[io.KittiObject] | None, calibration: Calibration | None
) -> tuple[BoxSet | None, BoxSet | None]:
    """Labelled vehicles and other objects in the sensor frame, which takes a calibration."""
    if labels is None or calibration is None:
        return None, None
    objects = [label for label in labels if not label.is_dont_care]
    center, size, yaw = io.boxes_from_objects(objects, calibration)
    boxes = BoxSet(center=center, size=size, yaw=yaw, captions=tuple(label.type for label in objects))
    is_vehicle = np.array([label.type in io.VEHICLE_TYPES for label in objects], bool)
    return boxes.take(is_vehicle), boxes.take(~is_vehicle)
