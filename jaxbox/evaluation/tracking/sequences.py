"""Boxes of a sequence, frame by frame: what was found, and what is true."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Self

import numpy as np

from jaxbox.evaluation.boxes import image_boxes
from jaxbox.evaluation.tracking.protocol import counts_by_limits
from jaxbox.io import VEHICLE_TYPES, KittiObject, boxes_from_objects
from jaxbox.types import Calibration, Detections

IGNORED_VEHICLES = ("Misc", "Tram")
"""KITTI's types that may be taken for a vehicle: trailers, trams."""


@dataclasses.dataclass(frozen=True)
class FrameBoxes:
    """What was found in one frame: single boxes, or tracks."""

    boxes: np.ndarray
    """(B, 7) real numbers, m and rad, sensor frame: x, y, z of the centre, length, width, height, yaw. Yaw
    is the heading where the front is known."""
    scores: np.ndarray
    """(B,) real numbers, higher is better."""
    ids: np.ndarray | None = None
    """(B,) int, unique in the frame: identities of tracks; None for single boxes."""
    velocities: np.ndarray | None = None
    """(B, 2) m/s over the ground, along the sensor frame's x and y axes; NaN where unknown. None without."""
    states: np.ndarray | None = None
    """(B,) int from 0: states of motion; -1 where unknown. None without."""

    def __post_init__(self):
        _check_rows(self, len(self.boxes))

    @classmethod
    def of_detections(cls, detections: Detections) -> Self:
        """The valid boxes of one sweep.

        Args:
          detections: of one sweep, not a batch.
        """
        valid = np.asarray(detections.valid)
        parts = [np.asarray(part)[valid] for part in (detections.center, detections.size, detections.heading)]
        return cls(np.column_stack(parts).astype(float), np.asarray(detections.score, float)[valid])

    @classmethod
    def of_objects(cls, objects: Sequence[KittiObject], calibration: Calibration) -> Self:
        """The results of one frame, of any vehicle type.

        Args:
          objects: results of the frame; without a score they get 1, as trackeval has it. Those of
            identity -1 are left out; where one has none at all, all are single boxes.
          calibration: of the sequence.
        """
        found = [item for item in objects if item.type.lower() in _lower(VEHICLE_TYPES)]
        rows = [item for item in found if item.track_id is None or item.track_id >= 0]
        single = any(item.track_id is None for item in rows)
        return cls(
            boxes=_boxes(rows, calibration),
            scores=np.array([1.0 if item.score is None else item.score for item in rows]),
            ids=None if single else np.array([item.track_id for item in rows], int),
        )


@dataclasses.dataclass(frozen=True)
class FrameTruth:
    """What is true of one frame."""

    boxes: np.ndarray
    """(A, 7) real numbers, m and rad, sensor frame, as `FrameBoxes`; yaw is the heading."""
    ids: np.ndarray
    """(A,) int, unique in the frame."""
    counts: np.ndarray
    """(A,) bool: the object counts; else it is neither found nor missed."""
    dont_care_px: np.ndarray
    """(R, 4) px: left, top, right, bottom of regions of the image without labels; (0, 4) for none."""
    velocities: np.ndarray | None = None
    """(A, 2) m/s, as `FrameBoxes`."""
    states: np.ndarray | None = None
    """(A,) int, as `FrameBoxes`."""

    def __post_init__(self):
        _check_rows(self, len(self.boxes))

    @classmethod
    def of_objects(
        cls,
        labels: Sequence[KittiObject],
        calibration: Calibration,
        *,
        types: Iterable[str] = VEHICLE_TYPES,
        ignored: Iterable[str] = IGNORED_VEHICLES,
    ) -> Self:
        """The vehicles of one frame of tracking labels, all of one class.

        Those that are largely hidden or cut off by the image's border do not count, as in KITTI's protocol.

        Args:
          labels: of the frame.
          calibration: of the sequence.
          types: KITTI's types that count.
          ignored: types that are neither found nor missed.
        """
        counted, named = _lower(types), _lower([*types, *ignored])
        rows = [item for item in labels if item.type.lower() in named]
        return cls(
            boxes=_boxes(rows, calibration),
            ids=np.array([item.track_id for item in rows], int),
            counts=np.array([item.type.lower() in counted and counts_by_limits(item) for item in rows], bool),
            dont_care_px=image_boxes([item for item in labels if item.is_dont_care]),
        )


@dataclasses.dataclass(frozen=True)
class TruthSequence:
    """The truth of a sequence."""

    frames: Sequence[FrameTruth]
    """Of each of T frames."""
    calibration: Calibration | None = None
    """Camera whose image shows what is labelled: a result that matches nothing and lies out of the image,
    too low in it or in a DontCare region is then not wrong. None where objects are labelled all round."""


def _lower(types: Iterable[str]) -> tuple[str, ...]:
    return tuple(name.lower() for name in types)


def _boxes(objects: Sequence[KittiObject], calibration: Calibration) -> np.ndarray:
    return np.column_stack(boxes_from_objects(objects, calibration, keep_heading=True))


def _check_rows(frame: FrameBoxes | FrameTruth, num: int) -> None:
    for field in dataclasses.fields(frame):
        value = getattr(frame, field.name)
        if value is None or field.name == "dont_care_px":
            continue
        if len(value) != num:
            raise ValueError(f"{field.name} has {len(value)} rows and boxes {num}; they belong together.")
    if np.shape(frame.boxes)[1:] != (7,):
        raise ValueError(f"boxes has shape {np.shape(frame.boxes)}; it must be (n, 7).")
    if not np.all(np.isfinite(frame.boxes)):
        raise ValueError("a box has a number that is not finite; leave out what has no box.")
    if isinstance(frame, FrameBoxes) and not np.all(np.isfinite(frame.scores)):
        raise ValueError("a score is not finite; every box needs one that can be compared.")


def check_frames(truth: Mapping[str, TruthSequence], results: Mapping[str, Sequence[FrameBoxes]]) -> None:
    """Refuses results that are not of the same sequences and frames.

    Args:
      truth: by sequence.
      results: of these sequences.

    Raises:
      ValueError: naming the sequence.
    """
    for name, sequence in truth.items():
        if name not in results:
            raise ValueError(f"sequence {name} has no results; give empty frames where nothing was found.")
        if len(results[name]) != len(sequence.frames):
            raise ValueError(
                f"sequence {name} has {len(sequence.frames)} frames of truth and {len(results[name])} of "
                "results; give one of each for every frame."
            )
