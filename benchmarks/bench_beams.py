"""Fewer beams and more: the preset of 64 beams against the one that is fitted to the sensor.

KITTI's sweeps are thinned to every second and every fourth beam, as sensors of 32 and 16 beams over the same
field of view would have seen them; any of the beams may be the first, so there are several such sweeps. The
fitted values were chosen on every second drive of ``kitti_drives.txt``; the other drives are held out. Labels
stay those of 64 beams: a car that hardly holds a point any more counts as missed.

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
from jaxbox.evaluation.copies import COPIES, Copy, Frame, detect_copy, read_frame
from jaxbox.io import open_sweeps, read_drives
from jaxbox.synthetic import SyntheticSweep, make_sweep

DRIVES_FILE = common.PROJECT / "benchmarks" / "kitti_drives.txt"
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


def chosen_on(drives: Mapping[str, str]) -> dict[str, bool]:
    """Whether the fitted values were chosen on a frame: on those of the second, fourth, ... drive."""
    order = list(dict.fromkeys(drives.values()))
    return {name: order.index(drive) % 2 == 1 for name, drive in drives.items()}


def thinned(frame: Frame, num_beams: int, first: int) -> Frame:
    """A frame as a sensor of fewer beams would have seen it."""
    keep = thin_beams(frame.xyz, num_beams=TUNED_BEAMS, keep_every=TUNED_BEAMS // num_beams, first=first)
    return dataclasses.replace(frame, xyz=frame.xyz[keep], intensity=frame.intensity[keep])


def measure(labels: kitti.Objects, results: kitti.Objects) -> dict[str, float]:
    """Average precision, SOFT and recall of cars, moderate."""
    curves = kitti.evaluate(labels, results, min_overlap=MIN_OVERLAP, metrics=("bev", "3d")).curves
    ap = {f"AP {c.metric}": c.r40 for c in curves if c.difficulty == "moderate"}
    found = report.measure_selection(labels, results, Selection(difficulty="moderate"))["rates"]
    rates = {(row["metric"], row["min_overlap"]): row["recall"] for row in found}
    recall = {f"recall {metric} {overlap}": rates[metric, overlap] for metric, overlap in RECALLS}
    return ap | {"SOFT": kitti.soft_score(labels, results)} | recall


def measure_kitti(
    frames: Sequence[Frame],
    groups: Mapping[str, frozenset[str]],
    num_beams: int,
    config: DetectorConfig,
    copies: Sequence[Copy],
) -> dict[str, dict[str, float]]:
    """The mean over copies and sensors of each figure, for each group of frames."""
    capacity = fitting_capacity(max(len(frame.xyz) for frame in frames) * num_beams // TUNED_BEAMS)
    rows: dict[str, list[dict[str, float]]] = {group: [] for group in groups}
    for first in FIRSTS[num_beams]:
        seen = [thinned(frame, num_beams, first) for frame in frames]
        for copy in copies:
            found = {f.name: detect_copy(f, copy, config, capacity=capacity)[0] for f in seen}
            for group, names in groups.items():
                labels = {frame.name: frame.labels for frame in frames if frame.name in names}
                rows[group].append(measure(labels, {name: found[name] for name in labels}))
    return {group: mean_of(each) for group, each in rows.items()}


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
        rows = np.column_stack([answer.center, answer.size, answer.yaw]).astype(float)[acted_on]
        boxes = sweep.boxes
        truth = np.column_stack([boxes.center, boxes.size, boxes.yaw])
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
    """A row for each sensor, its settings and group of drives."""
    sweeps = open_sweeps(common.data_folder("kitti_object"))
    frames = [frame for sweep in sweeps if (frame := read_frame(sweep)) is not None]
    if options.quick:
        frames = frames[:: len(frames) // QUICK_FRAMES]
    is_chosen = chosen_on(read_drives(DRIVES_FILE, [frame.name for frame in frames]))
    groups = {
        "held-out drives": frozenset(name for name, chosen in is_chosen.items() if not chosen),
        "drives chosen on": frozenset(name for name, chosen in is_chosen.items() if chosen),
    }
    copies = COPIES[: 1 if options.quick else options.copies]
    return [
        {"sensor": num_beams, "preset for": preset, "drives": group} | row
        for num_beams in FIRSTS
        for preset, config in fitted(num_beams, options).items()
        for group, row in measure_kitti(frames, groups, num_beams, config, copies).items()
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
        ("KITTI thinned: Car, moderate, R40 at IoU 0.7", "kitti"),
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
