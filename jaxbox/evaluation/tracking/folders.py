"""Measures a folder of tracking results against a folder of labels, in KITTI's layout."""

import dataclasses
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxbox.evaluation.report import find_results
from jaxbox.evaluation.tracking.protocol import DISTRACTORS, compare_in_image
from jaxbox.evaluation.tracking.report import evaluate_boxes, measure_tracks
from jaxbox.evaluation.tracking.sequences import FrameBoxes, FrameTruth, TruthSequence
from jaxbox.io import VEHICLE_TYPES, InputError, KittiObject, objects_by_frame, read_calibration, read_tracks
from jaxbox.io.kitti_tracking import NO_TRACK
from jaxbox.types import Calibration

LABELS_FOLDER, CALIBRATION_FOLDER = "label_02", "calib"

_TYPES = sorted({*VEHICLE_TYPES, *DISTRACTORS})
"""Types of results that a figure is of."""

Frames = tuple[Sequence[KittiObject], ...]


@dataclasses.dataclass(frozen=True)
class TrackingSequence:
    """A sequence's labels and results, frame by frame."""

    first_frame: int
    """Number of the first frame that is evaluated."""
    labels: Frames
    """Of each frame from there on."""
    results: Frames
    """Of each of these frames."""
    calibration: Calibration
    """The camera whose image the labels are of."""
    is_missing: bool
    """Whether the result file was missing and taken for empty."""
    last_result: int | None
    """Last frame with a result in the file, evaluated or not; None without results."""

    @property
    def last_frame(self) -> int:
        """Number of the last frame that is evaluated."""
        return self.first_frame + len(self.labels) - 1


def evaluate_tracking_folders(
    root: str | os.PathLike[str],
    results: str | os.PathLike[str],
    *,
    frames: Mapping[str, tuple[int, int] | None] | None = None,
    missing_as_empty: bool = False,
    min_score: float = -np.inf,
) -> dict[str, Any]:
    """Measures tracking results, by KITTI's protocol and as boxes of one class "vehicle".

    Args:
      root: folder of ``label_02/NAME.txt`` and ``calib/NAME.txt``.
      results: folder of ``NAME.txt`` or ``data/NAME.txt``, one a sequence.
      frames: as `read_tracking_folders`.
      missing_as_empty: take a missing result file for an empty one.
      min_score: boxes of lower score are left out of the metrics of tracks; average precision takes all.

    Returns:
      Numbers, strings, lists, dicts and None only:
        "frames": first and last of each sequence, by name;
        "kitti": `measure_tracks` of the 2D boxes by class, of cars and of pedestrians where there are any
          results of them;
        "vehicle": `evaluate_boxes` of Car, Van and Truck;
        "without_effect": why no result counts as a vehicle's, of each sequence with results of which none
          does;
        "unfinished": last frame with a result, of each sequence whose labels go on after it though no
          frames were chosen: they count as missed;
        "num_missing_results": files that were taken for empty.

    Raises:
      InputError: as `read_tracking_folders`.
    """
    sequences = read_tracking_folders(root, results, frames=frames, missing_as_empty=missing_as_empty)
    return {
        "frames": {name: [item.first_frame, item.last_frame] for name, item in sequences.items()},
        "kitti": {
            class_name: measure_tracks(
                {
                    name: compare_in_image(item.labels, _above(item, min_score), class_name=class_name)
                    for name, item in sequences.items()
                }
            )
            for class_name in _classes_found(sequences)
        },
        "vehicle": evaluate_boxes(
            {name: _truth(item) for name, item in sequences.items()},
            {
                name: [FrameBoxes.of_objects(found, item.calibration) for found in item.results]
                for name, item in sequences.items()
            },
            min_score=min_score,
        ),
        "without_effect": {
            name: reason
            for name, item in sequences.items()
            if (reason := _why_none_counts(item, min_score)) is not None
        },
        "unfinished": {
            name: item.last_result
            for name, item in sequences.items()
            if (frames is None or frames[name] is None) and _goes_on(item)
        },
        "num_missing_results": sum(item.is_missing for item in sequences.values()),
    }


def _above(sequence: TrackingSequence, min_score: float) -> Frames:
    return tuple(
        [item for item in found if item.score is None or item.score >= min_score]
        for found in sequence.results
    )


def _why_none_counts(sequence: TrackingSequence, min_score: float) -> str | None:
    """Why all figures of a sequence with results are zero; None where they need not be."""
    if sequence.last_result is None:
        return None
    items = [item for found in sequence.results for item in found]
    if not items:
        return f"no result is in frames {sequence.first_frame} to {sequence.last_frame}"
    if all(item.track_id == NO_TRACK for item in items):
        return f"every result has the identity {NO_TRACK}, which stands for no track"
    if not any(found for found in _above(sequence, min_score)):
        return f"no result scores {min_score:g} or more"
    types = sorted({item.type for item in items})
    if not {name.lower() for name in types} & {name.lower() for name in _TYPES}:
        return f"results are of type {', '.join(types)}; those that count are {', '.join(_TYPES)}"
    return None


def _goes_on(sequence: TrackingSequence) -> bool:
    """Whether objects are labelled after the last frame with a result."""
    if sequence.last_result is None:
        return False
    after = sequence.labels[sequence.last_result + 1 :]
    return any(label.track_id != NO_TRACK for labels in after for label in labels)


def _classes_found(sequences: Mapping[str, TrackingSequence]) -> list[str]:
    found = {item.type.lower() for part in sequences.values() for here in part.results for item in here}
    return [name for name in DISTRACTORS if name == "Car" or name.lower() in found]


def _truth(sequence: TrackingSequence) -> TruthSequence:
    calibration = sequence.calibration
    frames = [FrameTruth.of_objects(labels, calibration) for labels in sequence.labels]
    return TruthSequence(frames, calibration)


def read_tracking_folders(
    root: str | os.PathLike[str],
    results: str | os.PathLike[str],
    *,
    frames: Mapping[str, tuple[int, int] | None] | None = None,
    missing_as_empty: bool = False,
) -> dict[str, TrackingSequence]:
    """Reads labels, results and calibrations of sequences.

    Args:
      root: folder of ``label_02/NAME.txt`` and ``calib/NAME.txt``.
      results: folder of ``NAME.txt`` or ``data/NAME.txt``, one a sequence.
      frames: sequences to evaluate, each with its first and last frame, or None for all of its frames.
        Without it, every labelled sequence is evaluated, from frame 0 to the last that has a label or a
        result.
      missing_as_empty: take a missing result file for an empty one.

    Returns:
      The sequences by name.

    Raises:
      InputError: for a missing folder, label file, result file or calibration, a bad line, or frames
        of which none has a label or result.
    """
    names = _labelled_names(pathlib.Path(root) / LABELS_FOLDER)
    unknown = sorted(set(frames or ()) - set(names))
    if unknown:
        raise InputError(f"{root}: no labels of sequence {unknown[0]}; there are {', '.join(names)}.")
    chosen = {name: (frames or {}).get(name) for name in names if frames is None or name in frames}
    files = find_results(
        pathlib.Path(results), list(chosen), missing_as_empty=missing_as_empty, what="sequences"
    )
    return {name: _read_sequence(pathlib.Path(root), name, files[name], chosen[name]) for name in chosen}


def _labelled_names(folder: pathlib.Path) -> list[str]:
    names = sorted(file.stem for file in folder.glob("*.txt"))
    if not names:
        raise InputError(
            f"{folder}: no label files there; give the folder that holds {LABELS_FOLDER}/ and "
            f"{CALIBRATION_FOLDER}/ of KITTI's tracking benchmark."
        )
    return names


def _read_sequence(
    root: pathlib.Path, name: str, file: pathlib.Path | None, span: tuple[int, int] | None
) -> TrackingSequence:
    labels_path = root / LABELS_FOLDER / f"{name}.txt"
    labels = objects_by_frame(read_tracks(labels_path))
    results = objects_by_frame([] if file is None else read_tracks(file))
    last_seen = max([*labels, *results], default=-1)
    first, last = (0, last_seen) if span is None else span
    if not 0 <= first <= last <= last_seen:
        raise InputError(
            f"{labels_path}: frames {first} to {last} are asked for, but the last one with a label or a "
            f"result is {last_seen}; give frames from 0 up to it."
        )
    numbers = range(first, last + 1)
    return TrackingSequence(
        first_frame=first,
        labels=tuple(labels.get(number, ()) for number in numbers),
        results=tuple(results.get(number, ()) for number in numbers),
        calibration=read_calibration(root / CALIBRATION_FOLDER / f"{name}.txt"),
        is_missing=file is None,
        last_result=max(results, default=None),
    )
