"""KITTI's labels and conventions; nothing outside this module and `kitti_calibration` knows them.

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
from collections.abc import Iterable, Iterator, Sequence

import jax
import numpy as np

from jaxbox._files import InputError, atomic_writer, finite_number, read_text
from jaxbox.geometry.projection import project_boxes
from jaxbox.types import Calibration, Detections, Label

# Columns of the object labels, in the order of the development kit's readme.
_FIELDS = (
    "type", "truncated", "occluded", "alpha", "left", "top", "right", "bottom",
    "height", "width", "length", "x", "y", "z", "rotation_y", "score",
)  # fmt: skip
_OBJECT_COLUMNS = (15, 16)
_TRACKING_COLUMNS = (17, 18)

DONT_CARE = "DontCare"
VEHICLE_TYPES = tuple(label.word.capitalize() for label in Label)
"""Types of the objects that the detector looks for."""

MIN_VISIBLE_FRACTION = 0.1
"""Boxes with less of their 2D box in the image are not answers: the labels hold what the image shows."""

ALL_ROUND = Calibration(
    P_rect=np.zeros((3, 4), np.float32),  # pyright: ignore[reportArgumentType]
    T_rect_velo=np.array(  # pyright: ignore[reportArgumentType]
        [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], np.float32
    ),
    image_size_px=np.zeros(2, np.int32),  # pyright: ignore[reportArgumentType]
)
"""In place of a camera, where labels are of all round the sensor: it sees every box whole and large. What
KITTI measures in the image says nothing then."""
_WHOLE_BOX_PX = (0.0, 0.0, 100.0, 100.0)

# Boxes are projected in chunks of this size, the last one padded, so that one shape is compiled.
_CHUNK = 256

_project_boxes = jax.jit(project_boxes)


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
    return [item for _, item in numbered_labels(path, frame=frame)]


def numbered_labels(
    path: str | os.PathLike[str], *, frame: int | None = None
) -> Iterator[tuple[int, KittiObject]]:
    """Reads a label or result file, with the number of each object's line, which errors name.

    Args:
      path: the file.
      frame: keep only this frame of a tracking file; None keeps every line.

    Yields:
      Line, from 1, and object, in the file's order.

    Raises:
      InputError: as `read_labels`.
    """
    rows = ((number, line.split()) for number, line in enumerate(read_text(path).splitlines(), start=1))
    for number, fields in rows:
        if fields and (frame is None or fields[0] == str(frame)):
            yield number, _parse_object(fields, f"{path}, line {number}")


def _parse_object(fields: list[str], where: str) -> KittiObject:
    frame = track_id = None
    if len(fields) in _TRACKING_COLUMNS:
        frame, track_id = whole_number(fields[0], "frame", where), whole_number(fields[1], "track id", where)
        fields = fields[2:]
    elif len(fields) not in _OBJECT_COLUMNS:
        raise InputError(
            f"{where}: {len(fields)} columns; KITTI labels have 15, results 16, tracking labels 17 and "
            "tracking results 18. Fix or remove the line."
        )
    numbers = [finite_number(text, name, where) for text, name in zip(fields[1:], _FIELDS[1:], strict=False)]
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


def whole_number(text: str, name: str, where: str) -> int:
    """Reads a whole number.

    Args:
      text: of one field.
      name: of the field, for the message.
      where: file and line, for the message.

    Returns:
      The number.

    Raises:
      InputError: where it is none.
    """
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
            if item.frame is None:
                raise InputError(f"{file}: mixes object and tracking lines; split it into two files.")
            labels.setdefault(tracking_name(file.stem, item.frame), []).append(item)
    return labels


def tracking_name(sequence: str, frame: int) -> str:
    """Name of a tracking sweep.

    >>> tracking_name("0000", 12)
    '0000_000012'
    """
    return f"{sequence}_{frame:06d}"


def objects_from_detections(
    detections: Detections,
    calibration: Calibration,
    *,
    min_score: float = 0.0,
    min_visible_fraction: float = MIN_VISIBLE_FRACTION,
) -> list[KittiObject]:
    """Turns one sweep's boxes into KITTI results: those that the camera sees.

    Truncation and occlusion are -1, as results do not hold them. `rotation_y` is that of the heading; where
    ``front_probability`` is .5 it may be half a turn off.

    Args:
      detections: of one sweep, not a batch.
      calibration: the camera whose image the 2D boxes are in.
      min_score: boxes with lower scores are not written.
      min_visible_fraction: boxes with a smaller part of their 2D box in the image are dropped; 0 keeps
        every box that the image touches.

    Returns:
      One object a box, best score first.
    """
    keep = np.asarray(detections.valid) & (np.asarray(detections.score) >= min_score)
    objects = objects_from_boxes(
        np.asarray(detections.center),
        np.asarray(detections.size),
        np.asarray(detections.heading),
        calibration,
        types=[Label(label).word.capitalize() for label in np.asarray(detections.label).tolist()],
        min_visible_fraction=min_visible_fraction,
    )
    return [
        dataclasses.replace(item, truncation=-1.0, occlusion=-1, score=float(score))
        for item, kept, score in zip(objects, keep, np.asarray(detections.score), strict=True)
        if kept and item is not None
    ]


def objects_from_boxes(
    center: np.ndarray,
    size: np.ndarray,
    yaw: np.ndarray,
    calibration: Calibration,
    *,
    types: Sequence[str],
    min_visible_fraction: float = MIN_VISIBLE_FRACTION,
) -> list[KittiObject | None]:
    """Turns boxes into KITTI labels, such as the truth of a sweep of another source.

    Args:
      center: (n, 3) m, sensor frame.
      size: (n, 3) m: length, width, height.
      yaw: (n,) rad.
      calibration: the camera whose image the 2D boxes are in.
      types: n class names.
      min_visible_fraction: boxes with a smaller part of their 2D box in the image are not labels.

    Returns:
      n objects, with the part out of the image as truncation and occlusion 0; None for no label.
    """
    boxes_px, fraction, visible = boxes_in_image(center, size, yaw, calibration)
    keep = visible & (fraction >= min_visible_fraction)
    location, rotation_y = _kitti_pose(center, size, yaw, calibration)
    length, width, height = np.asarray(size, np.float64).T
    return [
        KittiObject(
            type=types[row],
            truncation=1 - float(fraction[row]),
            occlusion=0,
            alpha=observation_angle(rotation_y[row], location[row]),
            box_px=boxes_px[row],
            height=float(height[row]),
            width=float(width[row]),
            length=float(length[row]),
            location=location[row],
            rotation_y=float(rotation_y[row]),
        )
        if keep[row]
        else None
        for row in range(len(types))
    ]


def boxes_in_image(
    center: np.ndarray, size: np.ndarray, yaw: np.ndarray, calibration: Calibration
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Projects any number of boxes into the image, without compiling for each number of them.

    Args:
      center: (n, 3) m, sensor frame.
      size: (n, 3) m: length, width, height.
      yaw: (n,) rad.
      calibration: the camera.

    Returns:
      boxes_px: (n, 4) float64, px: left, top, right, bottom, clipped to the image; 0 where not visible.
      visible_fraction: (n,) float32, in [0, 1]: part of the 2D box that is in the image.
      visible: (n,) bool: some of the box is before the camera and in the image; all for `ALL_ROUND`.
    """
    num = len(center)
    if not np.any(calibration.image_size_px):
        return np.tile(_WHOLE_BOX_PX, (num, 1)), np.ones(num, np.float32), np.ones(num, bool)
    padded = np.zeros((-(-num // _CHUNK) * _CHUNK, 7), np.float32)
    padded[:num] = np.column_stack([center, size, yaw])
    parts = [(np.zeros((0, 4)), np.zeros(0, np.float32), np.zeros(0, bool))]
    for chunk in padded.reshape(-1, _CHUNK, 7):
        image = _project_boxes(chunk[:, :3], chunk[:, 3:6], chunk[:, 6], calibration)
        parts.append((np.asarray(image.boxes_px, float), image.visible_fraction, image.visible))
    boxes_px, fraction, visible = (np.concatenate(column)[:num] for column in zip(*parts, strict=True))
    return boxes_px, fraction, visible


def _kitti_pose(
    center: np.ndarray, size: np.ndarray, yaw: np.ndarray, calibration: Calibration
) -> tuple[np.ndarray, np.ndarray]:
    """Bottom centre (n, 3) and `rotation_y` (n,), rectified camera frame, of boxes in the LiDAR frame."""
    T_rect_velo = np.asarray(calibration.T_rect_velo, np.float64)
    location = center @ T_rect_velo[:3, :3].T + T_rect_velo[:3, 3]
    # The camera's y points down, and KITTI's box stands upright along it: its bottom is h/2 below.
    location[:, 1] += size[:, 2] / 2
    # The length axis (cos yaw, sin yaw, 0) seen from above in the camera frame, whose own axis at
    # rotation_y is (cos ry, 0, -sin ry): a turn about a y that points down takes x toward -z.
    x, z = _ground_axes(T_rect_velo) @ np.stack([np.cos(yaw), np.sin(yaw)])
    return location, np.arctan2(-z, x)


def _ground_axes(T_rect_velo: np.ndarray) -> np.ndarray:
    """(2, 2): x and z in the camera frame of the LiDAR frame's x and y axes, for an upright camera."""
    return T_rect_velo[np.ix_([0, 2], [0, 1])]


def boxes_from_objects(
    objects: Sequence[KittiObject], calibration: Calibration, *, keep_heading: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes of KITTI objects in the LiDAR frame: the inverse of `objects_from_detections`.

    Args:
      objects: n objects with a 3D box.
      calibration: of their sweep.
      keep_heading: whether yaw points to the object's front, and length and width stay as they are.

    Returns:
      center: (n, 3) float64, m, sensor frame, the box's centre.
      size: (n, 3) float64, m: length >= width, height; a pedestrian's may have to change places.
      yaw: (n,) float64, rad, in [-pi/2, pi/2), or in [-pi, pi] for headings.

    Raises:
      ValueError: where one is a DontCare region, which has no 3D box.
    """
    if any(item.is_dont_care for item in objects):
        raise ValueError("a DontCare region has no 3D box; leave out objects with is_dont_care.")
    T_rect_velo = np.asarray(calibration.T_rect_velo, np.float64)
    size = np.array([[item.length, item.width, item.height] for item in objects]).reshape(-1, 3)
    center = np.array([item.location for item in objects]).reshape(-1, 3)
    center[:, 1] -= size[:, 2] / 2
    center = np.linalg.solve(T_rect_velo[:3, :3], (center - T_rect_velo[:3, 3]).T).T
    rotation_y = np.array([item.rotation_y for item in objects])
    x, y = np.linalg.solve(_ground_axes(T_rect_velo), np.stack([np.cos(rotation_y), -np.sin(rotation_y)]))
    if keep_heading:
        return center, size, np.arctan2(y, x)
    across = size[:, 1] > size[:, 0]
    size[across, :2] = size[across, 1::-1]
    return center, size, _wrap_yaw(np.arctan2(y, x) + across * np.pi / 2)


def _wrap_yaw(yaw: np.ndarray) -> np.ndarray:
    """`jaxbox.geometry.planar.wrap_yaw` in NumPy: JAX would compile again for every number of labels."""
    wrapped = yaw - np.pi * np.floor(yaw / np.pi + 0.5)
    return np.where(wrapped >= np.pi / 2, -np.pi / 2, wrapped)


def observation_angle(rotation_y: float, location: np.ndarray) -> float:
    """KITTI's alpha: the turn of the object relative to the ray it is seen along.

    alpha = rotation_y - atan2(x, z), so that objects of one alpha look alike wherever they stand.

    Args:
      rotation_y: rad.
      location: (3,) m, rectified camera frame.

    Returns:
      rad, in (-pi, pi].

    >>> observation_angle(0.0, np.array([0.0, 1.6, 10.0]))
    0.0
    """
    turn = rotation_y - math.atan2(location[0], location[2])
    return math.pi - (math.pi - turn) % math.tau
