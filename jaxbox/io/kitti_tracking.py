"""KITTI's tracking files: labels and results of a whole sequence, one object a line, with identities.

A line holds the frame, the identity, and then the columns of an object label: 17 in ``label_02``, 18 with
a score. An identity stands for one object of the sequence; -1 stands for none, as of DontCare regions.

Reference: the tracking development kit's readme; the detections are those of Weng et al., "3D Multi-Object
Tracking: A Baseline and New Evaluation Metrics", IROS 2020 (AB3DMOT).
"""

import contextlib
import dataclasses
import itertools
import os
import pathlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from jaxbox._files import InputError, finite_number, read_text
from jaxbox.io.kitti import (
    MIN_VISIBLE_FRACTION,
    KittiObject,
    numbered_labels,
    objects_from_boxes,
    whole_number,
    write_labels,
)
from jaxbox.io.results import SweepResult, WriteResult
from jaxbox.types import Calibration

NO_TRACK = -1
"""Identity of what has none."""

_DETECTION_TYPES = {1: "Pedestrian", 2: "Car", 3: "Cyclist"}
_DETECTION_COLUMNS = (
    "frame", "type", "left", "top", "right", "bottom", "score",
    "height", "width", "length", "x", "y", "z", "rotation_y", "alpha",
)  # fmt: skip


def read_tracks(path: str | os.PathLike[str]) -> list[KittiObject]:
    """Reads a tracking label or result file of one sequence.

    Args:
      path: the file.

    Returns:
      One object a line, in the file's order, each with a frame and an identity.

    Raises:
      InputError: naming file and line, for what `read_labels` refuses, a line without frame and identity,
        a frame below 0, an identity below -1, or an identity twice in one frame.
    """
    objects: list[KittiObject] = []
    lines: dict[tuple[int, int], int] = {}
    for number, item in numbered_labels(path):
        where = f"{path}, line {number}"
        frame, track_id = item.frame, item.track_id
        if frame is None or track_id is None:
            raise InputError(
                f"{where}: has no frame and track id; tracking files hold both before the type. Is it a file "
                "of the object benchmark?"
            )
        if frame < 0 or track_id < NO_TRACK:
            raise InputError(f"{where}: frame {frame}, track id {track_id}; frames are from 0, ids from -1.")
        first = lines.setdefault((frame, track_id), number)
        if track_id != NO_TRACK and first != number:
            raise InputError(
                f"{where}: track id {track_id} is in frame {frame} already (line {first}); "
                "give every object of a frame an id of its own."
            )
        objects.append(item)
    return objects


def write_tracks(path: str | os.PathLike[str], objects: Iterable[KittiObject]) -> None:
    """Writes a tracking result or label file of one sequence, whole or not at all, sorted by frame and id.

    Args:
      path: the file, which KITTI names after the sequence: ``0000.txt``.
      objects: any number, each with a frame, and all of them or none with a score. Without an identity
        they get -1, which evaluators read as no track.

    Raises:
      ValueError: for an object without frame, scores on some of them only, an identity twice in one
        frame, or what `write_labels` refuses.
    """
    rows = sorted(objects, key=lambda item: (_frame_of(item), _identity(item)))
    if len({item.score is None for item in rows}) > 1:
        raise ValueError("some objects have a score and some have none; the file's lines have one length.")
    keys = [(item.frame, item.track_id) for item in rows if _identity(item) != NO_TRACK]
    for before, after in itertools.pairwise(keys):
        if before == after:
            raise ValueError(f"track id {after[1]} is twice in frame {after[0]}; ids are unique in a frame.")
    write_labels(path, rows)


def _frame_of(item: KittiObject) -> int:
    if item.frame is None or item.frame < 0:
        raise ValueError(f"frame is {item.frame}; objects of tracking files have one, from 0 on.")
    return item.frame


def _identity(item: KittiObject) -> int:
    return NO_TRACK if item.track_id is None else item.track_id


def read_track_folder(path: str | os.PathLike[str]) -> dict[str, list[KittiObject]]:
    """Reads every tracking file of a folder.

    Args:
      path: a folder of ``.txt`` files, one a sequence.

    Returns:
      Objects by sequence, which is the file's stem, in its order.

    Raises:
      InputError: for a folder without ``.txt`` files, or as `read_tracks`.
    """
    files = sorted(pathlib.Path(path).glob("*.txt"))
    if not files:
        raise InputError(f"{path}: no .txt files there; give the folder of tracking files, one a sequence.")
    return {file.stem: read_tracks(file) for file in files}


def read_track_detections(path: str | os.PathLike[str]) -> list[KittiObject]:
    """Reads the detections of a sequence as AB3DMOT and trackers after it distribute them.

    A line is ``frame, type, left, top, right, bottom, score, h, w, l, x, y, z, rotation_y, alpha``, with
    commas between; type is 1 for Pedestrian, 2 for Car and 3 for Cyclist.

    Args:
      path: the file.

    Returns:
      One object a line, in the file's order, with a frame and a score, and no identity.

    Raises:
      InputError: naming file and line, for a wrong number of columns, a field that is not a finite number,
        or an unknown type.
    """
    lines = enumerate(read_text(path).splitlines(), start=1)
    return [_parse_detection(line, f"{path}, line {number}") for number, line in lines if line.strip()]


def _parse_detection(line: str, where: str) -> KittiObject:
    fields = line.split(",")
    if len(fields) != len(_DETECTION_COLUMNS):
        raise InputError(
            f"{where}: {len(fields)} columns with commas between; expected {len(_DETECTION_COLUMNS)}: "
            f"{', '.join(_DETECTION_COLUMNS)}."
        )
    frame, kind = (whole_number(fields[i], _DETECTION_COLUMNS[i], where) for i in (0, 1))
    if kind not in _DETECTION_TYPES:
        raise InputError(f"{where}: type is {kind}; known are 1 Pedestrian, 2 Car and 3 Cyclist.")
    if frame < 0:
        raise InputError(f"{where}: frame is {frame}; frames are from 0.")
    numbers = [
        finite_number(text, name, where)
        for text, name in zip(fields[2:], _DETECTION_COLUMNS[2:], strict=True)
    ]
    return KittiObject(
        type=_DETECTION_TYPES[kind],
        truncation=-1.0,
        occlusion=-1,
        alpha=numbers[12],
        box_px=np.array(numbers[:4]),
        height=numbers[5],
        width=numbers[6],
        length=numbers[7],
        location=np.array(numbers[8:11]),
        rotation_y=numbers[11],
        score=numbers[4],
        frame=frame,
    )


def objects_by_frame(objects: Iterable[KittiObject]) -> Mapping[int, Sequence[KittiObject]]:
    """Sorts the objects of a sequence into its frames.

    Args:
      objects: each with a frame.

    Returns:
      The objects of each frame that has any, in their order.

    Raises:
      ValueError: for an object without frame.
    """
    frames: dict[int, list[KittiObject]] = {}
    for item in objects:
        frames.setdefault(_frame_of(item), []).append(item)
    return frames


def objects_from_tracks(
    boxes: np.ndarray,
    scores: np.ndarray,
    track_ids: np.ndarray,
    calibration: Calibration,
    *,
    frame: int,
    types: Sequence[str],
    min_visible_fraction: float = MIN_VISIBLE_FRACTION,
) -> list[KittiObject]:
    """Turns the tracks of one frame into KITTI results: those that the camera sees.

    Args:
      boxes: (n, 7) m and rad, sensor frame: x, y, z of the centre, length, width, height, heading.
      scores: (n,) higher is better.
      track_ids: (n,) int, each at most once.
      calibration: the camera whose image the 2D boxes are in.
      frame: of the sequence.
      types: n class names.
      min_visible_fraction: boxes with a smaller part of their 2D box in the image are left out.

    Returns:
      At most n objects, in the order of the boxes.
    """
    boxes = np.asarray(boxes, float).reshape(-1, 7)
    objects = objects_from_boxes(
        boxes[:, :3],
        boxes[:, 3:6],
        boxes[:, 6],
        calibration,
        types=types,
        min_visible_fraction=min_visible_fraction,
    )
    return [
        dataclasses.replace(
            item, truncation=-1.0, occlusion=-1, score=float(score), frame=frame, track_id=int(track_id)
        )
        for item, score, track_id in zip(objects, scores, track_ids, strict=True)
        if item is not None
    ]


def objects_from_record(
    record: Mapping[str, Any], calibration: Calibration, *, coasting: bool = False, min_score: float = 0.0
) -> list[KittiObject]:
    """Turns what is written of a sweep's tracks into KITTI results: those that the camera sees.

    Args:
      record: as `jaxbox.io.tracks_record` makes it.
      calibration: the camera whose image the 2D boxes are in.
      coasting: whether tracks are written too that were not detected in the sweep.
      min_score: tracks that score less are left out.

    Returns:
      The objects, whose ``rotation_y`` points to the front.
    """
    seen = [box for box in record["boxes"] if coasting or box["detection"] >= 0]
    boxes = [box for box in seen if box["score"] >= min_score]
    return objects_from_tracks(
        np.array([[*box["center"], *box["size"], box["heading"]] for box in boxes]),
        np.array([box["score"] for box in boxes]),
        np.array([box["id"] for box in boxes], int),
        calibration,
        frame=record["frame"],
        types=[box["label"].capitalize() for box in boxes],
    )


@contextlib.contextmanager
def open_track_text(
    path: pathlib.Path, *, coasting: bool = False, min_score: float = 0.0
) -> Iterator[WriteResult]:
    """Opens a tracking result file for the tracks of a drive.

    Args:
      path: the file, which KITTI names after the sequence: ``0000.txt``.
      coasting: as `objects_from_record`.
      min_score: likewise.

    Yields:
      What adds a sweep; one without calibration adds nothing.
    """
    objects: list[KittiObject] = []

    def write(result: SweepResult) -> None:
        if result.calibration is not None:
            objects.extend(
                objects_from_record(result.record, result.calibration, coasting=coasting, min_score=min_score)
            )

    yield write
    write_tracks(path, objects)
