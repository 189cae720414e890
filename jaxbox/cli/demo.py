"""``jaxbox demo``: a ray-cast sweep with exact truth, its boxes, and a picture of every stage."""

import pathlib

import numpy as np
from rich.console import Console
from rich.table import Table

from jaxbox.cli.report import SHOWN_MIN_SCORE, FrameReport, describe_frame, make_table
from jaxbox.cli.timing import TimedDetector
from jaxbox.config import DetectorConfig
from jaxbox.synthetic import SyntheticSweep, make_sweep
from jaxbox.types import Label, PointCloud
from jaxbox.viz import BoxSet, draw_stages, save_png
from jaxbox.viz.boxes import bird_eye_iou, find_matches

MIN_TRUTH_POINTS = 10
"""Vehicles with fewer points can hardly be found: they count neither as missed nor as false alarms."""
NUM_VEHICLES = 12
FOUND_IOU = 0.5
"""Bird's-eye view IoU from which a vehicle counts as found."""


def run_demo(output: pathlib.Path, *, seed: int, console: Console) -> None:
    """Makes a sweep, detects, prints the boxes next to the truth and writes the pictures.

    Args:
      output: folder for the pictures.
      seed: of the scene.
      console: where the table goes.
    """
    console.print(f"casting the beams of a 64-beam sensor at scene {seed}")
    sweep = make_sweep(seed, num_vehicles=NUM_VEHICLES, image=True)
    cloud = PointCloud.from_numpy(sweep.xyz, sweep.intensity)
    console.print("compiling the detector; later runs take it from the cache")
    detector = TimedDetector(DetectorConfig())
    detections, detect_s = detector(cloud)
    console.print(f"compiled in {detector.compile_s[cloud.capacity]:.1f} s")
    report = FrameReport(
        name="demo", num_points=len(sweep.xyz), detections=detections, detect_s=detect_s, other_s=0.0
    )
    for line in describe_frame(report):
        console.print(line)
    boxes = BoxSet.from_detections(detections, min_score=SHOWN_MIN_SCORE)
    truth, judged = known_truth(boxes, sweep)
    console.print(compare_with_truth(boxes, sweep, false_alarms(boxes, truth, judged)))
    pictures = draw_stages(
        cloud,
        detections,
        calibration=sweep.calibration,
        image=sweep.image,
        truth=truth,
        judged=judged,
        min_score=SHOWN_MIN_SCORE,
    )
    for number, (name, picture) in enumerate(pictures.items(), start=1):
        console.print(f"wrote {save_png(output / f'{number}_{name}.png', picture)}")


def known_truth(boxes: BoxSet, sweep: SyntheticSweep) -> tuple[BoxSet, np.ndarray]:
    """The vehicles that can be found, and which estimates they may judge.

    Args:
      boxes: K estimates.
      sweep: with its truth.

    Returns:
      Vehicles of at least `MIN_TRUTH_POINTS` points; (K,) bool: False for an estimate on another one.
    """
    enough = sweep.boxes.num_points >= MIN_TRUTH_POINTS
    faint = bird_eye_iou(boxes, _truth_boxes(sweep, ~enough))
    return _truth_boxes(sweep, enough), faint.max(axis=1, initial=0.0) == 0


def _truth_boxes(sweep: SyntheticSweep, rows: np.ndarray) -> BoxSet:
    truth = sweep.boxes
    return BoxSet(center=truth.center[rows], size=truth.size[rows], yaw=truth.yaw[rows])


def false_alarms(boxes: BoxSet, truth: BoxSet, judged: np.ndarray) -> np.ndarray:
    """(K,) bool: the estimates that the pictures show as false alarms.

    Args:
      boxes: K estimates.
      truth: as `known_truth` returns it.
      judged: likewise, (K,) bool.
    """
    hit, _ = find_matches(boxes, truth)
    return ~hit & judged


def compare_with_truth(boxes: BoxSet, sweep: SyntheticSweep, false: np.ndarray) -> Table:
    """One row a vehicle, nearest first: what was found of it, and how far it is from the truth.

    Args:
      boxes: K estimates.
      sweep: with its truth.
      false: (K,) bool: estimates on no vehicle, which have rows at the end.
    """
    truth = sweep.boxes
    distance = np.linalg.norm(truth.center[:, :2], axis=1)
    every = np.ones(len(truth), bool)
    iou = bird_eye_iou(boxes, _truth_boxes(sweep, every))
    rows = []
    for row in np.argsort(distance):
        known = [
            f"{Label(int(truth.label[row])).word} at {distance[row]:.0f} m",
            str(truth.num_points[row]),
            f"{truth.visible[row]:.0%}",
        ]
        best = int(iou[:, row].argmax()) if len(boxes) else -1
        found = best >= 0 and iou[best, row] >= FOUND_IOU
        if found:
            rows.append([*known, *_errors(boxes, best, sweep, row), f"{iou[best, row]:.2f}"])
        else:
            few = truth.num_points[row] < MIN_TRUTH_POINTS
            rows.append([*known, "too few points" if few else "missed", "", "", "", "", ""])
    for row in np.flatnonzero(false):
        place = f"false alarm at {np.hypot(*boxes.center[row, :2]):.0f} m"
        rows.append([place, "", "", boxes.captions[row], "", "", "", "", ""])
    columns = ("vehicle", "points", "in sight", "box", "length", "width", "height", "yaw", "BEV IoU")
    return make_table("boxes against the truth (estimated - true, m and degrees)", columns, rows)


def _errors(boxes: BoxSet, estimate: int, sweep: SyntheticSweep, row: int) -> list[str]:
    size = boxes.size[estimate] - sweep.boxes.size[row]
    # An axis has no front: half a turn is not an error.
    turn = np.degrees(boxes.yaw[estimate] - sweep.boxes.yaw[row])
    turn = (turn + 90) % 180 - 90
    return [boxes.captions[estimate], *(f"{error:+.2f}" for error in size), f"{turn:+.1f}"]
