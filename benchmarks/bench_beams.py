"""Fewer beams and more: the preset of 64 beams against the one that is fitted to the sensor.

KITTI's sweeps are thinned to every second and every fourth beam, as sensors of 32 and 16 beams over the same
field of view would have seen them; any of the beams may be the first, so there are several such sweeps. The
fitted values gain on both sets of frames. That is no proof: both were looked at, and share eight drives.
Labels stay those of 64 beams: a car that hardly holds a point any more counts as missed. Average precision is
a share of what perfect answers reach on these few labels.

More than 64 beams are only to be had from `jaxbox.synthetic`, whose scenes no value was chosen on.

    python -m benchmarks.bench_beams --json benchmarks/results/beams.json
"""

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import common
from benchmarks.bench_accuracy import MIN_OVERLAP, RECALLS
from benchmarks.bench_sensors import RIGHT_OVERLAP
from jaxbox import DEFAULT_SCORE_THRESHOLD, DetectorConfig, Label
from jaxbox._padding import fitting_capacity
from jaxbox.config.sensors import TUNED_BEAMS
from jaxbox.evaluation import Selection, kitti, matching, pairwise_overlaps, report, thin_beams
from jaxbox.evaluation.copies import COPIES, Copy, Frame, detect_copy, labelled_frames
from jaxbox.io import open_sweeps
from jaxbox.synthetic import SyntheticSweep, make_sweep

SETS: Mapping[str, str] = {"20 frames": "kitti_object", "58 frames": "kitti_object_more"}
"""Folders of labelled sweeps; eight drives are in both."""
FIRSTS: Mapping[int, tuple[int, ...]] = {64: (0,), 32: (0, 1), 16: (0, 2)}
"""The first beam that is kept: several sensors of that many beams in one sweep."""
DENSEST = 128
SYNTHETIC_BEAMS = (128, 64, 32, 16)
SYNTHETIC_MIN_POINTS = 20
"""Cars that hold fewer points of the densest sensor's sweep are not asked for, whatever the sensor."""
SYNTHETIC_OVERLAP = 0.5
NUM_COPIES = 3
NUM_SCENES = 12
QUICK_FRAMES, QUICK_SCENES = 6, 3


def thinned(frame: Frame, num_beams: int, first: int) -> Frame:
    """A frame as a sensor of fewer beams would have seen it."""
    keep = thin_beams(frame.xyz, num_beams=TUNED_BEAMS, keep_every=TUNED_BEAMS // num_beams, first=first)
    return dataclasses.replace(frame, xyz=frame.xyz[keep], intensity=frame.intensity[keep])


def measure(labels: kitti.Objects, results: kitti.Objects) -> dict[str, float]:
    """Average precision, SOFT and recall of cars, moderate."""
    curves = kitti.evaluate(labels, results, min_overlap=MIN_OVERLAP, metrics=("bev", "3d")).curves
    ap = {f"AP {c.metric}": _of_ceiling(c) for c in curves if c.difficulty == "moderate"}
    found = report.measure_selection(labels, results, Selection(difficulty="moderate"))["rates"]
    rates = {(row["metric"], row["min_overlap"]): row["recall"] for row in found}
    recall = {f"recall {metric} {overlap}": rates[metric, overlap] for metric, overlap in RECALLS}
    return ap | {"SOFT": kitti.soft_score(labels, results)} | recall


def _of_ceiling(curve: kitti.PrecisionCurve) -> float:
    return 100 * curve.r40 / max(kitti.average_precision(curve.ceiling, r11=False), 1e-9)


def measure_kitti(
    frames: Sequence[Frame], num_beams: int, config: DetectorConfig, copies: Sequence[Copy]
) -> dict[str, float]:
    """The mean over copies and sensors of each figure."""
    capacity = fitting_capacity(max(len(frame.xyz) for frame in frames) * num_beams // TUNED_BEAMS)
    labels = {frame.name: frame.labels for frame in frames}
    rows = []
    for first in FIRSTS[num_beams]:
        seen = [thinned(frame, num_beams, first) for frame in frames]
        for copy in copies:
            found = {f.name: detect_copy(f, copy, config, capacity=capacity)[0] for f in seen}
            rows.append(measure(labels, found))
    return mean_of(rows)


def mean_of(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each figure."""
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def measure_synthetic(
    sweeps: Sequence[SyntheticSweep], num_beams: int, config: DetectorConfig
) -> dict[str, float]:
    """Recall of cars, and precision of all boxes from the default cut on, over ray-cast streets."""
    found = wanted = right = shown = 0
    for sweep in sweeps:
        keep = thin_beams(sweep.xyz, num_beams=DENSEST, keep_every=DENSEST // num_beams)
        answer = common.detect(sweep.xyz[keep], sweep.intensity[keep], config)
        acted_on = np.asarray(answer.valid) & (np.asarray(answer.score) >= DEFAULT_SCORE_THRESHOLD)
        rows = common.box_rows(answer)[acted_on]
        boxes = sweep.boxes
        truth = common.box_rows(boxes)
        overlap, _ = pairwise_overlaps(truth, rows)
        is_wanted = (boxes.num_points >= SYNTHETIC_MIN_POINTS) & (boxes.label == Label.CAR)
        matched = matching.match(overlap, is_wanted, min_overlap=SYNTHETIC_OVERLAP)
        found, wanted = found + int(np.sum(is_wanted & (matched >= 0))), wanted + int(np.sum(is_wanted))
        right += int(np.sum(overlap.max(axis=0, initial=0) >= RIGHT_OVERLAP))
        shown += len(rows)
    return {"cars": wanted, "recall": found / wanted, "boxes": shown, "precision": right / max(shown, 1)}


def fitted(num_beams: int, options: argparse.Namespace) -> dict[str, DetectorConfig]:
    """The settings that are compared for a sensor."""
    base = common.chosen_config(options)
    configs = {f"{TUNED_BEAMS} beams": base}
    return (
        configs
        if num_beams == TUNED_BEAMS
        else configs | {f"{num_beams} beams": DetectorConfig.for_sensor(num_beams, base=base)}
    )


def run_kitti(options: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for each sensor, its settings and set of frames."""
    sets = {}
    for name, folder in SETS.items():
        sweeps = open_sweeps(common.data_folder(folder))
        frames = labelled_frames(sweeps)
        sets[name] = frames[:: len(frames) // QUICK_FRAMES] if options.quick else frames
    copies = COPIES[: 1 if options.quick else options.copies]
    return [
        {"sensor": num_beams, "preset for": preset, "set": name}
        | measure_kitti(frames, num_beams, config, copies)
        for num_beams in FIRSTS
        for preset, config in fitted(num_beams, options).items()
        for name, frames in sets.items()
    ]


def run_synthetic(options: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for each sensor and its settings."""
    num_scenes = QUICK_SCENES if options.quick else NUM_SCENES
    sweeps = [make_sweep(seed, num_beams=DENSEST) for seed in range(num_scenes)]
    return [
        {"sensor": num_beams, "preset for": preset} | measure_synthetic(sweeps, num_beams, config)
        for num_beams in SYNTHETIC_BEAMS
        for preset, config in fitted(num_beams, options).items()
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = common.parser(
        __doc__ or "", quick=f"{QUICK_FRAMES} frames as recorded, {QUICK_SCENES} synthetic scenes"
    )
    parser.add_argument("--copies", type=int, default=NUM_COPIES, choices=range(1, len(COPIES) + 1))
    options = parser.parse_args(arguments)
    tables = {"kitti": run_kitti(options), "synthetic": run_synthetic(options)}
    for title, key in (
        ("KITTI thinned: Car, moderate, R40 at IoU 0.7, % of its ceiling", "kitti"),
        (
            f"synthetic streets: cars, BEV IoU {SYNTHETIC_OVERLAP}, "
            f"from a score of {DEFAULT_SCORE_THRESHOLD}",
            "synthetic",
        ),
    ):
        print(f"\n{title}")
        common.print_table(list(tables[key][0]), [list(row.values()) for row in tables[key]])
    common.write_report(tables, options)


if __name__ == "__main__":
    main()
