"""KITTI's files and conventions; nothing outside this module knows them.

KITTI describes a box in the rectified camera frame (x right, y down, z forward) by (h, w, l), the centre
of its **bottom** face and ``rotation_y``, the angle of its length axis about the camera's y axis. The
rest of the project describes it in the LiDAR frame by ``center``, ``size`` and ``yaw``.

Reference: Geiger, Lenz, Urtasun, "Are we ready for autonomous driving?", CVPR 2012, and the readme
files of the object, tracking and raw development kits.
"""

import dataclasses
import math
import os
import pathlib
from collections.abc import Iterable

import numpy as np

from jaxbox.io._files import InputError, atomic_writer, read_text

# Columns of the object labels, in the order of the development kit's readme.
_FIELDS = (
    "type", "truncated", "occluded", "alpha", "left", "top", "right", "bottom",
    "height", "width", "length", "x", "y", "z", "rotation_y", "score",
)  # fmt: skip
_OBJECT_COLUMNS = (15, 16)
_TRACKING_COLUMNS = (17, 18)

DONT_CARE = "DontCare"


@dataclasses.dataclass(frozen=True)
class KittiObject:
    """One line of a label or result file, in KITTI's own conventions."""

    type: str
    """Class name as in the file: Car, Van, Truck, Pedestrian, ..., DontCare."""
    truncation: float
    """Fraction outside the image, 0 to 1; -1 where unknown (DontCare, results)."""
    occlusion: int
    """0 visible, 1 partly, 2 largely occluded, 3 unknown; -1 in DontCare and results."""
    alpha: float
    """Observation angle, rad, in [-pi, pi]; -10 where unknown."""
    box_px: np.ndarray
    """(4,) float64, px: left, top, right, bottom, 0-based."""
    height: float
    """m; -1 in DontCare, as width and length."""
    width: float
    """m, across the length axis."""
    length: float
    """m, along the length axis."""
    location: np.ndarray
    """(3,) float64, m, rectified camera frame: centre of the bottom face; -1000 in DontCare."""
    rotation_y: float
    """Angle of the length axis about the camera's y axis, rad, in [-pi, pi]; -10 where unknown."""
    score: float | None = None
    """Confidence, higher is better; None in ground truth."""
    frame: int | None = None
    """Frame within the sequence; only in tracking files."""
    track_id: int | None = None
    """Identity over frames, -1 for none; only in tracking files."""

    @property
    def is_dont_care(self) -> bool:
        """Whether this is a region without labels, which has no 3D box."""
        return self.type == DONT_CARE


def read_labels(path: str | os.PathLike[str], *, frame: int | None = None) -> list[KittiObject]:
    """Reads a label or result file: object (15 or 16 columns) or tracking (17 or 18 columns).

    Args:
      path: the file.
      frame: keep only this frame of a tracking file; None keeps every line.

    Returns:
      One object a line, in the file's order; empty lines are skipped.

    Raises:
      InputError: naming file, line and field, for a wrong number of columns or a field that is no
        finite number.
    """
    rows = ((number, line.split()) for number, line in enumerate(read_text(path).splitlines(), start=1))
    return [
        _parse_object(fields, f"{path}, line {number}")
        for number, fields in rows
        if fields and (frame is None or fields[0] == str(frame))
    ]


def _parse_object(fields: list[str], where: str) -> KittiObject:
    frame = track_id = None
    if len(fields) in _TRACKING_COLUMNS:
        frame, track_id = _integer(fields[0], "frame", where), _integer(fields[1], "track id", where)
        fields = fields[2:]
    elif len(fields) not in _OBJECT_COLUMNS:
        raise InputError(
            f"{where}: {len(fields)} columns; KITTI labels have 15, results 16, tracking labels 17 and "
            "tracking results 18. Mend or remove the line."
        )
    numbers = [_number(text, name, where) for text, name in zip(fields[1:], _FIELDS[1:], strict=False)]
    return KittiObject(
        type=fields[0],
        truncation=numbers[0],
        occlusion=int(numbers[1]),
        alpha=numbers[2],
        box_px=np.array(numbers[3:7]),
        height=numbers[7],
        width=numbers[8],
        length=numbers[9],
        location=np.array(numbers[10:13]),
        rotation_y=numbers[13],
        score=numbers[14] if len(numbers) > 14 else None,
        frame=frame,
        track_id=track_id,
    )


def _number(text: str, name: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: {name} is {text!r}; it must be a finite number.")
    return value


def _integer(text: str, name: str, where: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise InputError(f"{where}: {name} is {text!r}; it must be a whole number.") from error


def write_labels(path: str | os.PathLike[str], objects: Iterable[KittiObject]) -> None:
    """Writes a label or result file, whole or not at all.

    An object with a score has one column more, one with a frame the two tracking columns before.
    Numbers keep six decimals, scores nine significant digits, so that float32 scores keep their order.

    Args:
      path: the file; its folder is made where it is missing.
      objects: any number; none makes an empty file, which is how KITTI says "nothing found".

    Raises:
      ValueError: for a type that is empty or holds a blank, or a number that is not finite.
    """
    with atomic_writer(path) as handle:
        handle.writelines(_format_object(item) + "\n" for item in objects)


def _format_object(item: KittiObject) -> str:
    if len(item.type.split()) != 1:
        raise ValueError(f"type is {item.type!r}; it must be one word, or the columns shift.")
    numbers = [
        item.truncation, item.occlusion, item.alpha, *item.box_px,
        item.height, item.width, item.length, *item.location, item.rotation_y,
    ]  # fmt: skip
    if not np.all(np.isfinite([*numbers, 0.0 if item.score is None else item.score])):
        raise ValueError(f"{item} has a number that is not finite; KITTI's files cannot hold it.")
    columns = [item.type, *(_decimal(value) for value in numbers)]
    if item.score is not None:
        columns.append(f"{item.score:.9g}")
    if item.frame is not None:
        columns = [str(item.frame), str(-1 if item.track_id is None else item.track_id), *columns]
    return " ".join(columns)


def _decimal(value: float) -> str:
    """Six decimals at most, no trailing zeros."""
    return f"{value:.6f}".rstrip("0").rstrip(".")


def read_label_folder(path: str | os.PathLike[str]) -> dict[str, list[KittiObject]]:
    """Reads every label or result file of a folder.

    Args:
      path: a folder of ``.txt`` files in the object format, or of tracking files, one a sequence.

    Returns:
      Objects by sweep name, as `open_sweeps` names it: the file's stem, and for tracking files
      ``sequence_frame`` ("0000_000012"), in which frames without a line are absent.

    Raises:
      InputError: for a missing folder, one without ``.txt`` files, or a bad line.
    """
    files = sorted(pathlib.Path(path).glob("*.txt"))
    if not files:
        raise InputError(f"{path}: no .txt files there; give the folder that holds the label files.")
    labels: dict[str, list[KittiObject]] = {}
    for file in files:
        objects = read_labels(file)
        if not any(item.frame is not None for item in objects):
            labels[file.stem] = objects
            continue
        for item in objects:
            labels.setdefault(tracking_name(file.stem, item.frame), []).append(item)
    return labels


def tracking_name(sequence: str, frame: int | None) -> str:
    """Name of a tracking sweep.

    >>> tracking_name("0000", 12)
    '0000_000012'
    """
    return f"{sequence}_{frame:06d}"
