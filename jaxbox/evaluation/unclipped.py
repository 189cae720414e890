"""Boxes that KITTI's text leaves out as the image shows too little of them: found, and not written there."""

import dataclasses
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxbox.evaluation.kitti import Objects
from jaxbox.io import InputError, KittiObject, Sweep, objects_from_boxes, read_jsonl
from jaxbox.io.jsonl import JSONL
from jaxbox.types import Calibration

_SCORE_DIGITS = 6
"""KITTI's text holds nine digits of a float32."""


def read_unclipped(
    folder: str | os.PathLike[str], sweeps: Sequence[Sweep], results: Objects
) -> dict[str, list[KittiObject]] | None:
    """Reads the boxes of a run from its JSON Lines, where they lie beside its KITTI text.

    Args:
      folder: of the results.
      sweeps: the labelled ones, each with a calibration.
      results: KITTI's text of each.

    Returns:
      All boxes that the image touches, by the sweep's name; None where there are no JSON Lines, or they are
      not of this run: then they lack a sweep, or a box of the text.

    Raises:
      InputError: naming the file, where it cannot be read.
    """
    path = pathlib.Path(folder) / JSONL.name
    if not path.is_file():
        return None
    records = {record.get("name"): record for record in read_jsonl(path)}
    found: dict[str, list[KittiObject]] = {}
    for sweep in sweeps:
        if sweep.name not in records:
            return None
        calibration = sweep.read_calibration()
        assert calibration is not None
        try:
            found[sweep.name] = _objects(records[sweep.name], calibration)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: {sweep.name} is no record of jaxbox; move the file away.") from error
        if not _scores(results[sweep.name]) <= _scores(found[sweep.name]):
            return None
    return found


def _objects(record: Mapping[str, Any], calibration: Calibration) -> list[KittiObject]:
    boxes = record["boxes"]
    objects = objects_from_boxes(
        np.array([box["center"] for box in boxes], float).reshape(-1, 3),
        np.array([box["size"] for box in boxes], float).reshape(-1, 3),
        np.array([box["heading"] for box in boxes], float),
        calibration,
        types=[box["label"].capitalize() for box in boxes],
        min_visible_fraction=0,
    )
    return [
        dataclasses.replace(item, score=float(box["score"]))
        for item, box in zip(objects, boxes, strict=True)
        if item is not None
    ]


def _scores(objects: Sequence[KittiObject]) -> set[float]:
    return {round(item.score or 0.0, _SCORE_DIGITS) for item in objects}
