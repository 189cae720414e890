"""What is found of cars, vans and trucks on KITTI's object benchmark, and how many boxes of each are right.

    python -m benchmarks.bench_classes --json benchmarks/results/classes.json
    python -m benchmarks.bench_classes --corrupt reflections --amount 0.01    # of the points below the road

The 78 frames of both sets, as recorded, turned and mirrored; they chose what vans and trucks are, so these
are figures of a tuning set. A label is *found* where a box of any class, from
`jaxbox.DEFAULT_SCORE_THRESHOLD` on, covers it with a bird's-eye view IoU of .5 or more, whether the image
shows that box or not. Of the boxes that it shows, as KITTI's text has them, those are *right* that overlap
any label by .3, as labels go no farther than the image; *false* ones overlap none by .1. Others that lie for
more than half in a DontCare region do not count, as nobody labelled what is there. From the *cuts* on nine
of ten, and 19 of 20, boxes of the class are right. The last row has cars, vans and trucks as one class.
Of corrupted sweeps, see `bench_corruption`, labels have the points of the clean ones; each copy is corrupted
with a seed of its own.
"""

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import common
from benchmarks.bench_corruption import corrupt, seeded
from jaxbox import DEFAULT_SCORE_THRESHOLD, DetectorConfig, Label
from jaxbox.evaluation import pairwise_overlaps
from jaxbox.evaluation.boxes import excused_in_image
from jaxbox.evaluation.copies import (
    COPIES,
    Copy,
    Frame,
    label_points,
    labelled_frames,
    turn_back,
    turn_points,
)
from jaxbox.evaluation.corruptions import CORRUPTIONS
from jaxbox.io import KittiObject, boxes_from_objects, objects_from_detections, open_sweeps
from jaxbox.types import Calibration

FRAMES = ("kitti_object", "kitti_object_more")
FOUND_OVERLAP, RIGHT_OVERLAP, FALSE_OVERLAP = 0.5, 0.3, 0.1
LEAST_POINTS = (30, 100)
"""Labels of so many points and more are asked for."""
PRECISIONS = (0.9, 0.95)
MAX_DONT_CARE = 0.5
TYPES = tuple(label.word.capitalize() for label in Label)
"""KITTI's names of the classes."""
GROUPS = {kind: (kind,) for kind in TYPES} | {"Any": TYPES}
"""The rows of the table, and whose labels and boxes each counts."""


def rows_of(objects: Sequence[KittiObject], calibration: Calibration) -> np.ndarray:
    """(n, 7) centre, size and yaw of KITTI objects, in the sensor frame."""
    if not objects:
        return np.zeros((0, 7))
    return np.column_stack(boxes_from_objects(objects, calibration))


def best_scores(labels: np.ndarray, boxes: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """(n,) the score of the best box that covers each label; 0 for none."""
    overlap = pairwise_overlaps(labels, boxes)[0]
    return np.max(np.where(overlap >= FOUND_OVERLAP, scores, 0), axis=1, initial=0)


def measure(frame: Frame, copy: Copy, num_points: np.ndarray, config: DetectorConfig) -> dict[str, Any]:
    """Of one frame: labels as (type, points, best score), and shown boxes as (type, score, overlap)."""
    found = turn_back(common.detect(turn_points(frame.xyz, copy), frame.intensity, config), copy)
    valid = np.asarray(found.valid)
    boxes, scores = common.box_rows(found)[valid], np.asarray(found.score)[valid]
    # Regions without a box have no number of points.
    objects = [label for label, points in zip(frame.labels, num_points, strict=True) if points >= 0]
    rows = rows_of(objects, frame.calibration)
    shown = [
        each
        for each in objects_from_detections(found, frame.calibration)
        if each.score is not None and each.score >= DEFAULT_SCORE_THRESHOLD
    ]
    overlap = pairwise_overlaps(rows, rows_of(shown, frame.calibration))[0].max(axis=0, initial=0)
    best = best_scores(rows, boxes, scores)
    judged = (overlap >= RIGHT_OVERLAP) | (excused_in_image(frame.labels, shown) <= MAX_DONT_CARE)
    return {
        "labels": [
            (label.type, int(points), float(score))
            for label, points, score in zip(objects, num_points[num_points >= 0], best, strict=True)
        ],
        "boxes": [
            (each.type, each.score, float(most))
            for each, most, counts in zip(shown, overlap, judged, strict=True)
            if counts
        ],
    }


def cut_of(scores: np.ndarray, right: np.ndarray, precision: float) -> float | None:
    """The least score from which on such a share of the boxes is right; None where there is none."""
    order = np.argsort(-scores, kind="stable")
    precise = np.cumsum(right[order]) >= precision * np.arange(1, len(order) + 1)
    return float(scores[order][np.flatnonzero(precise)[-1]]) if precise.any() else None


def summarise(measured: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Counts over all frames and copies, by class, and of all of them."""
    return {
        group: count(
            [row for frame in measured for row in frame["labels"] if row[0] in kinds],
            [row for frame in measured for row in frame["boxes"] if row[0] in kinds],
        )
        for group, kinds in GROUPS.items()
    }


def count(labels: Sequence[Any], boxes: Sequence[Any]) -> dict[str, Any]:
    """The counts of a group, of rows as `measure` makes them."""
    points, best = (np.array([row[i] for row in labels]) for i in (1, 2))
    scores, overlap = (np.array([row[i] for row in boxes]) for i in (1, 2))
    right = overlap >= RIGHT_OVERLAP

    def found(least: int, score: float | None) -> int:
        return int(((points >= least) & (best >= (np.inf if score is None else score))).sum())

    row: dict[str, Any] = {}
    for least in LEAST_POINTS:
        row[f"labels {least}"] = int((points >= least).sum())
        row[f"found {least}"] = found(least, DEFAULT_SCORE_THRESHOLD)
    row |= {"boxes": len(boxes), "right": int(right.sum()), "false": int((overlap < FALSE_OVERLAP).sum())}
    for precision in PRECISIONS:
        row[f"cut {precision}"] = cut = cut_of(scores, right, precision)
        row |= {f"found {least} from {precision}": found(least, cut) for least in LEAST_POINTS}
    return row


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table, and writes the report."""
    parser = common.parser(__doc__ or "", quick="four frames, as recorded")
    parser.add_argument("--copies", type=int, default=len(COPIES), choices=range(1, len(COPIES) + 1))
    of_points = sorted(name for name, kind in CORRUPTIONS.items() if kind.of_points is not None)
    parser.add_argument("--corrupt", choices=of_points, help="make the sweeps worse, by --amount")
    parser.add_argument("--amount", type=float, help="how much, in the unit of the corruption")
    options: argparse.Namespace = parser.parse_args(arguments)
    if (options.corrupt is None) != (options.amount is None):
        parser.error("--corrupt asks for --amount, and --amount for --corrupt")
    config = common.chosen_config(options)
    frames = labelled_frames(sweep for name in FRAMES for sweep in open_sweeps(common.data_folder(name)))
    frames = frames[:: len(frames) // 4] if options.quick else frames
    copies = COPIES[: 1 if options.quick else options.copies]
    kind = None if options.corrupt is None else CORRUPTIONS[options.corrupt]
    measured = []
    for frame in frames:
        num_points = label_points(frame)
        for copy in copies:
            seen = frame
            if kind is not None:
                rng = seeded(frame.name, copy.name, options.corrupt, options.amount)
                seen = corrupt(frame, kind, options.amount, rng)
            measured.append(measure(seen, copy, num_points, config))
    table = summarise(measured)
    columns = list(next(iter(table.values())))
    common.print_table(["class", *columns], [[kind, *row.values()] for kind, row in table.items()])
    print(
        f"{len(frames)} frames, {len(copies)} copies; cut 0.9: from there on that share of the boxes is right"
    )
    report = {"num_frames": len(frames), "num_copies": len(copies), "classes": table}
    if kind is not None:
        report |= {"corruption": options.corrupt, "amount": options.amount}
    common.write_report(report, options)


if __name__ == "__main__":
    main()
