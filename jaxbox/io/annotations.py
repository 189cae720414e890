"""Labels of annotation tools; `jaxbox.io.annotation_results` writes what is to be corrected there.

Each tool has a folder: the point clouds as PCD in the sensor's frame, and its own labels beside them. Boxes
are upright, with x along their heading; what a tool turns about x and y is not looked at.

- labelCloud: ``pointclouds/NAME.pcd``, ``labels/NAME.json`` and ``labels/_classes.json``; written as
  ``centroid_rel``, read in its three JSON forms. It has no ids.
- Xtreme1: ``lidar_point_cloud_0/NAME.pcd``, ``result/NAME.json``, for drives within a scene's folder.
- CVAT: ``pointclouds/NAME.pcd``, and ``annotations.zip`` in its form "Datumaro 3D"; or what is unpacked from
  it, ``annotations/*.json``.

References: labelCloud, README, "Label formats", and ``labelCloud/io/labels`` (ch-sa/labelCloud). Xtreme1,
"Upload Dataset" and "Data Annotation Result" (docs.xtreme1.io), and its ``UploadDataUseCase``. CVAT,
"Datumaro" (docs.cvat.ai), and ``import_dm_annotations``, which makes tracks of what has ``track_id`` and
``keyframe``; from KITTI's raw tracklets it makes boxes without ids.
"""

import dataclasses
import functools
import io
import math
import pathlib
import zipfile
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxbox._files import InputError, parse_json, read_bytes, read_text, reason
from jaxbox.io.kitti import ALL_ROUND, KittiObject, objects_from_boxes
from jaxbox.io.labelled import finite_number

POINT_FOLDERS = ("pointclouds", "lidar_point_cloud_0")
"""Folders of the point clouds that a tool's labels lie beside."""
LABELCLOUD_CLASSES = "_classes.json"
"""Beside its labels: the classes, and in which form the labels are."""
CVAT_FILE = "annotations/default.json"
"""In the zip."""
_MAX_JSON_BYTES = 2**30
_ZIP_ERRORS = (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, EOFError, UnicodeDecodeError)


@dataclasses.dataclass(frozen=True)
class Annotation:
    """One box of a tool, in the sensor's frame."""

    name: str
    """Of its class."""
    center: tuple[float, float, float]
    """m."""
    size: tuple[float, float, float]
    """m: length along the heading, width, height."""
    heading: float
    """Rad, from +x about +z."""
    track_id: int | None = None
    """The same for an object in all sweeps; None where the tool has none."""


def find_annotations(points: pathlib.Path) -> pathlib.Path | None:
    """The labels that a tool has beside a point cloud.

    Args:
      points: of a folder of `POINT_FOLDERS`.

    Returns:
      The file, which may be that of many sweeps; None where there is none.
    """
    root = points.parent.parent
    own = [root / folder / f"{points.stem}.json" for folder in ("labels", "result")]
    shared = [root / "annotations.zip", *sorted((root / "annotations").glob("*.json"))]
    return next((file for file in (*own, *shared) if file.is_file()), None)


def is_annotations(path: pathlib.Path) -> bool:
    """Whether a label file is that of a tool, and not KITTI's."""
    return path.suffix.lower() in (".json", ".zip")


def read_annotations(path: pathlib.Path, name: str) -> list[Annotation] | None:
    """Reads the labels of one sweep.

    Args:
      path: a label file of labelCloud (``centroid_rel``, ``centroid_abs`` or ``vertices``) or Xtreme1, or the
        file of many sweeps that CVAT exports as "Datumaro 3D", packed or not.
      name: of the sweep, by which it is found in the latter.

    Returns:
      Its boxes, in the file's order; None where a file of many sweeps does not have it.

    Raises:
      InputError: naming the file, and the object, where it cannot be read.
    """
    if path.suffix.lower() == ".zip" or path.parent.name == "annotations":
        return _read_cvat(path, name)
    content = parse_json(read_text(path), str(path))
    if path.parent.name == "result":
        parts = content if isinstance(content, list) else [content]
        objects = [item for part in parts for item in _list_of(part, "objects", path)]
        # 2D boxes of cameras stand among them.
        return _read_all(
            [item for item in objects if isinstance(item, dict) and item.get("type") == "3D_BOX"],
            _read_xtreme1,
            path,
        )
    read = functools.partial(_read_labelcloud, in_degrees=_is_in_degrees(path, content))
    return _read_all(_list_of(content, "objects", path), read, path)


def read_annotated_objects(path: pathlib.Path, name: str) -> list[KittiObject] | None:
    """Reads the labels of one sweep as KITTI's objects, all round the sensor: of `jaxbox.io.kitti.ALL_ROUND`.

    Args:
      path: as `read_annotations`.
      name: as `read_annotations`.

    Returns:
      One object a box, of type "Car" for "car", with its id where it has one; None as `read_annotations`.

    Raises:
      InputError: as `read_annotations`.
    """
    boxes = read_annotations(path, name)
    if boxes is None:
        return None
    objects = objects_from_boxes(
        np.array([box.center for box in boxes]).reshape(-1, 3),
        np.array([box.size for box in boxes]).reshape(-1, 3),
        np.array([box.heading for box in boxes]),
        ALL_ROUND,
        types=["_".join(box.name.split()).capitalize() for box in boxes],
    )
    return [
        dataclasses.replace(item, track_id=box.track_id)
        for item, box in zip(objects, boxes, strict=True)
        if item is not None
    ]


def _list_of(content: Any, key: str, path: pathlib.Path) -> list[Any]:
    found = content.get(key) if isinstance(content, dict) else None
    if not isinstance(found, list):
        raise InputError(f"{path}: no list of {key} in it; is it a label file of the tool?")
    return found


def _read_all(
    objects: Sequence[Any], read: Callable[[Any, str], Annotation], path: pathlib.Path
) -> list[Annotation]:
    boxes = []
    for number, item in enumerate(objects, start=1):
        where = f"{path}, object {number}"
        try:
            boxes.append(_checked(read(item, where), where))
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{where}: not a box of the tool ({reason(error)}).") from error
    return boxes


def _checked(box: Annotation, where: str) -> Annotation:
    if not box.name.strip():
        raise InputError(f"{where}: it has no class.")
    if min(box.size) <= 0:
        raise InputError(f"{where}: its size is {box.size}; lengths must be above 0.")
    return box


def _numbers(values: Any, names: Sequence[str], where: str) -> tuple[float, float, float]:
    a, b, c = (finite_number(values[name], name, where) for name in names)
    return a, b, c


def _is_in_degrees(path: pathlib.Path, content: Any) -> bool:
    """Whether labelCloud's file is ``centroid_abs``: its classes say so, or an angle beyond a turn."""
    classes = path.parent / LABELCLOUD_CLASSES
    if classes.is_file():
        found = parse_json(read_text(classes), str(classes))
        return isinstance(found, dict) and found.get("format") == "centroid_abs"
    objects = _list_of(content, "objects", path)
    turns = [item["rotations"].get("z") for item in objects if isinstance(item, dict) and "rotations" in item]
    return any(isinstance(turn, int | float) and abs(turn) > math.tau for turn in turns)


def _read_labelcloud(item: Any, where: str, *, in_degrees: bool) -> Annotation:
    if "vertices" in item:
        corners = np.array(item["vertices"], float)
        if corners.shape != (8, 3) or not np.all(np.isfinite(corners)):
            raise InputError(f"{where}: vertices must be 8 rows of 3 finite numbers.")
        along, across, up = corners[3] - corners[0], corners[1] - corners[0], corners[4] - corners[0]
        length, width, height = (float(np.linalg.norm(edge)) for edge in (along, across, up))
        x, y, z = corners.mean(axis=0).tolist()
        heading = math.atan2(along[1], along[0])
        return Annotation(str(item["name"]), (x, y, z), (length, width, height), heading)
    turn = finite_number(item["rotations"]["z"], "z", where)
    return Annotation(
        name=str(item["name"]),
        center=_numbers(item["centroid"], ("x", "y", "z"), where),
        size=_numbers(item["dimensions"], ("length", "width", "height"), where),
        heading=math.radians(turn) if in_degrees else turn,
    )


def _read_xtreme1(item: Any, where: str) -> Annotation:
    contour, track = item["contour"], str(item.get("trackName") or "")
    return Annotation(
        # Until somebody gives it a class of the data set, there is that of the upload.
        name=str(item.get("className") or item.get("modelClass") or ""),
        center=_numbers(contour["center3D"], ("x", "y", "z"), where),
        size=_numbers(contour["size3D"], ("x", "y", "z"), where),
        heading=finite_number(contour["rotation3D"]["z"], "z", where),
        track_id=int(track) if track.isdecimal() else None,
    )


def _read_cvat(path: pathlib.Path, name: str) -> list[Annotation] | None:
    labels, items = _load_cvat(path, path.stat().st_mtime_ns)
    if name not in items:
        return None
    found = items[name]
    shown = [item for item in found if isinstance(item, dict) and item.get("type") == "cuboid_3d"]
    shown = [item for item in shown if not (item.get("attributes") or {}).get("outside", False)]

    def read(item: Any, where: str) -> Annotation:
        track = (item.get("attributes") or {}).get("track_id")
        return Annotation(
            name=str(labels[item["label_id"]]["name"]),
            center=_numbers(item["position"], (0, 1, 2), where),  # pyright: ignore[reportArgumentType]
            size=_numbers(item["scale"], (0, 1, 2), where),  # pyright: ignore[reportArgumentType]
            heading=finite_number(item["rotation"][2], "rotation", where),
            track_id=None if track is None else int(track),
        )

    return _read_all(shown, read, path / name)


@functools.lru_cache(maxsize=2)
def _load_cvat(path: pathlib.Path, _changed_ns: int) -> tuple[list[Any], dict[str, list[Any]]]:
    """Classes, and the annotations of each sweep, of a file that each sweep asks for, read once."""
    content = _cvat_content(path)
    labels = content.get("categories", {}).get("label", {}).get("labels", [])
    items = _items_of(content, path)
    # CVAT puts folders of the upload before the name.
    return labels, {str(item["id"]).rpartition("/")[2]: item["annotations"] for item in items}


def read_cvat_items(path: pathlib.Path) -> list[Any]:
    """The sweeps of a file of CVAT, each with its ``id`` and ``annotations``.

    Args:
      path: as CVAT exports it, packed or not.

    Raises:
      InputError: where it cannot be read.
    """
    return _items_of(_cvat_content(path), path)


def _items_of(content: Any, path: pathlib.Path) -> list[Any]:
    items = _list_of(content, "items", path)
    if not all(isinstance(item, dict) and isinstance(item.get("annotations"), list) for item in items):
        raise InputError(f"{path}: its items must have annotations; export it again as Datumaro 3D.")
    return items


def _cvat_content(path: pathlib.Path) -> Any:
    if path.suffix.lower() == ".json":
        return parse_json(read_text(path), str(path))
    try:
        with zipfile.ZipFile(io.BytesIO(read_bytes(path))) as archive:
            names = [name for name in archive.namelist() if name.startswith("annotations/")]
            names = [name for name in names if name.endswith(".json")]
            if len(names) != 1:
                raise InputError(
                    f"{path}: {len(names)} files annotations/*.json in it; export one task as Datumaro 3D."
                )
            if archive.getinfo(names[0]).file_size > _MAX_JSON_BYTES:
                raise InputError(f"{path}: {names[0]} unpacks to more than {_MAX_JSON_BYTES} bytes.")
            text = archive.read(names[0]).decode("utf-8-sig")
    except _ZIP_ERRORS as error:
        raise InputError(f"{path}: not a zip of annotations ({reason(error)}).") from error
    return parse_json(text, f"{path}, {names[0]}")
