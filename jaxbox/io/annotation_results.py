"""Boxes in the forms of annotation tools, to be corrected there; `jaxbox.io.annotations` reads them back.

See there for the folders of each tool, and where its form is described.
"""

import contextlib
import functools
import json
import pathlib
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from jaxbox._files import atomic_path, atomic_writer
from jaxbox.config import DEFAULT_SCORE_THRESHOLD
from jaxbox.io.annotations import CVAT_FILE, LABELCLOUD_CLASSES, POINT_FOLDERS, read_cvat_items
from jaxbox.io.pcd import write_pcd
from jaxbox.io.results import ResultFile, SweepResult, WriteResult
from jaxbox.types import Label

_COLORS = ("#ff5050", "#ffc800", "#00c864", "#3c78ff", "#b450ff")
_POINTS, _XTREME1_POINTS = POINT_FOLDERS
_CVAT_ZIP = "annotations.zip"


def chosen_boxes(record: Mapping[str, Any], *, coasting: bool = False) -> list[Mapping[str, Any]]:
    """The boxes of a sweep that are worth a look: from `jaxbox.DEFAULT_SCORE_THRESHOLD` on.

    Args:
      record: as `jaxbox.io.detections_record` or `jaxbox.io.tracks_record` makes it.
      coasting: whether tracks too that were not detected in the sweep.

    Returns:
      The boxes; of tracks only confirmed ones.
    """
    return [
        box
        for box in record["boxes"]
        if box["score"] >= DEFAULT_SCORE_THRESHOLD
        and box.get("confirmed", True)
        and (coasting or box.get("sight", "seen") == "seen")
    ]


_Axes = Sequence[float]


def _xyz(values: _Axes, names: Sequence[str] = ("x", "y", "z")) -> dict[str, float]:
    return dict(zip(names, map(float, values), strict=True))


def _labelcloud_labels(name: str, boxes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    # Its reader takes the values of each part in their order.
    objects = [
        {
            "name": box["label"],
            "centroid": _xyz(box["center"]),
            "dimensions": _xyz(box["size"], ("length", "width", "height")),
            "rotations": _xyz((0, 0, box["heading"])),
        }
        for box in boxes
    ]
    file = f"{name}.pcd"
    return {"folder": _POINTS, "filename": file, "path": f"{_POINTS}/{file}", "objects": objects}


def _labelcloud_classes() -> dict[str, Any]:
    classes = [
        {"name": label.word, "id": label.value, "color": _COLORS[label.value % len(_COLORS)]}
        for label in Label
    ]
    return {"classes": classes, "default": 0, "type": "object_detection", "format": "centroid_rel"}


def _xtreme1_labels(name: str, boxes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    objects = [
        {
            "type": "3D_BOX",
            "className": box["label"],
            "trackId": f"{name}-{row}" if "id" not in box else str(box["id"]),
            "trackName": str(box.get("id", row)),
            "classValues": [],
            "contour": {
                "pointN": box["num_points"],
                "points": [],
                "size3D": _xyz(box["size"]),
                "center3D": _xyz(box["center"]),
                "viewIndex": 0,
                "rotation3D": _xyz((0, 0, box["heading"])),
            },
            "modelConfidence": box["score"],
            "modelClass": box["label"],
        }
        for row, box in enumerate(boxes)
    ]
    return {"version": "Xtreme1 V0.6", "objects": objects}


def _cvat_item(index: int, name: str, boxes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    annotations = [
        {
            "id": row,
            "type": "cuboid_3d",
            "attributes": {"occluded": box.get("sight", "seen") != "seen"}
            | ({"track_id": box["id"], "keyframe": True, "outside": False} if "id" in box else {}),
            "group": 0,
            "label_id": Label[box["label"].upper()].value,
            "position": list(box["center"]),
            "rotation": [0.0, 0.0, box["heading"]],
            "scale": list(box["size"]),
        }
        for row, box in enumerate(boxes)
    ]
    cloud = {"path": f"{name}.pcd"}
    return {"id": name, "annotations": annotations, "attr": {"frame": index}, "point_cloud": cloud}


@contextlib.contextmanager
def _open_files(
    path: pathlib.Path,
    resume: bool = False,
    *,
    points: str,
    labels: str,
    describe: Callable[[str, Sequence[Mapping[str, Any]]], dict[str, Any]],
    files: Mapping[str, Any],
    coasting: bool = False,
) -> Iterator[WriteResult]:
    """Opens a folder of a tool with one label file a sweep, each written whole or not at all."""

    def write(result: SweepResult) -> None:
        name = result.record["name"]
        _write_points(path / points, result)
        _write_json(
            path / labels / f"{name}.json", describe(name, chosen_boxes(result.record, coasting=coasting))
        )

    for name, content in files.items():
        _write_json(path / labels / name, content)
    yield write


def _write_points(folder: pathlib.Path, result: SweepResult) -> None:
    if result.xyz is not None and result.intensity is not None:
        write_pcd(folder / f"{result.record['name']}.pcd", result.xyz, result.intensity)


def _write_json(path: pathlib.Path, content: Mapping[str, Any]) -> None:
    with atomic_writer(path) as handle:
        json.dump(content, handle, indent=1, allow_nan=False)


open_labelcloud = functools.partial(
    _open_files,
    points=_POINTS,
    labels="labels",
    describe=_labelcloud_labels,
    files={LABELCLOUD_CLASSES: _labelcloud_classes()},
)
"""Opens a folder for labelCloud: path, whether a run is resumed, and whether tracks are ``coasting``."""


@contextlib.contextmanager
def open_xtreme1(
    path: pathlib.Path, resume: bool = False, *, scene: bool = False, coasting: bool = False
) -> Iterator[WriteResult]:
    """Opens a folder for Xtreme1, to be uploaded as a zip.

    Args:
      path: the folder; it is made where it is missing.
      resume: whether a run is resumed; what it has written is left.
      scene: whether the sweeps are a scene, within which ids are those of tracks.
      coasting: as `chosen_boxes`.

    Yields:
      What adds a sweep.
    """
    # It takes a folder for a scene where its name begins so.
    root = path / f"scene_{path.name.removesuffix('_xtreme1')}" if scene else path
    points, labels = _XTREME1_POINTS, "result"
    with _open_files(
        root, resume, points=points, labels=labels, describe=_xtreme1_labels, files={}, coasting=coasting
    ) as write:
        yield write


@contextlib.contextmanager
def open_cvat(path: pathlib.Path, resume: bool = False, *, coasting: bool = False) -> Iterator[WriteResult]:
    """Opens a folder for CVAT: point clouds for the task, and ``annotations.zip``, written at the end.

    Args:
      path: the folder; it is made where it is missing.
      resume: whether the annotations of an earlier run come first.
      coasting: as `chosen_boxes`.

    Yields:
      What adds a sweep.

    Raises:
      InputError: where the earlier annotations cannot be read.
    """
    file = path / _CVAT_ZIP
    items = list(read_cvat_items(file)) if resume and file.is_file() else []

    def write(result: SweepResult) -> None:
        _write_points(path / _POINTS, result)
        boxes = chosen_boxes(result.record, coasting=coasting)
        items.append(_cvat_item(len(items), result.record["name"], boxes))

    yield write
    labels = [{"name": label.word, "parent": "", "attributes": []} for label in Label]
    categories = {"label": {"labels": labels, "attributes": ["occluded"]}}
    text = json.dumps({"info": {}, "categories": categories, "items": items}, allow_nan=False)
    with atomic_path(file) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(CVAT_FILE, text)


def _finished_files(labels: str, path: pathlib.Path) -> frozenset[str]:
    return frozenset(file.stem for file in (path / labels).glob("*.json")) - {
        pathlib.Path(LABELCLOUD_CLASSES).stem
    }


def _finished_cvat(path: pathlib.Path) -> frozenset[str]:
    file = path / _CVAT_ZIP
    return frozenset(str(item["id"]) for item in read_cvat_items(file)) if file.is_file() else frozenset()


LABELCLOUD = ResultFile(
    name="labelcloud",
    open=open_labelcloud,
    finished=functools.partial(_finished_files, "labels"),
    wants_points=True,
)
XTREME1 = ResultFile(
    name="xtreme1",
    open=open_xtreme1,
    finished=functools.partial(_finished_files, "result"),
    wants_points=True,
)
CVAT = ResultFile(name="cvat", open=open_cvat, finished=_finished_cvat, wants_points=True)
