"""Car accuracy on KITTI's object benchmark, as recorded and as the mean over turned and mirrored copies.

Few labelled frames make a noisy figure: one borderline car is some points of average precision, and turning
the input by a few degrees moves it as much. Turned and mirrored copies are as good sweeps as the recorded
one, so a difference between two settings is judged by their mean beside their spread.

    python -m benchmarks.bench_accuracy --copies 6 --set vehicles.max_overlap=0.2 --json accuracy.json
"""

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks import common
from jaxbox import Calibration, Detections, DetectorConfig
from jaxbox.evaluation import Selection, count_points_in_boxes, kitti, report
from jaxbox.geometry import wrap_yaw
from jaxbox.io import KittiObject, Sweep, boxes_from_objects, objects_from_detections, open_sweeps

METRICS = ("bev", "3d")
RECALLS = (("bev", 0.5), ("bev", 0.7), ("3d", 0.7))
MIN_OVERLAP = {"Car": kitti.MIN_OVERLAP["Car"]}
WELL_SEEN_POINTS = 50
"""Cars with so many points must not have their axes swapped."""


@dataclasses.dataclass(frozen=True)
class Copy:
    """A sweep turned about the sensor, mirrored before where said."""

    turn_deg: float = 0.0
    mirrored: bool = False

    @property
    def name(self) -> str:
        """Such as "+7.3" or "mirrored -13.9"."""
        if not self.turn_deg and not self.mirrored:
            return "as recorded"
        return f"{'mirrored ' if self.mirrored else ''}{self.turn_deg:+g}"


COPIES = (
    Copy(), Copy(7.3), Copy(-13.9, mirrored=True), Copy(29.4), Copy(-21.7, mirrored=True), Copy(45.1),
)  # fmt: skip
"""Turns that no grid or angle step of the detector divides."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """One labelled sweep, read once."""

    name: str
    xyz: np.ndarray
    intensity: np.ndarray
    calibration: Calibration
    labels: list[KittiObject]


def read_frame(sweep: Sweep) -> Frame | None:
    labels, calibration = sweep.read_labels(), sweep.read_calibration()
    if labels is None or calibration is None:
        return None
    return Frame(sweep.name, *sweep.read_points(), calibration, labels)


def turn_points(xyz: np.ndarray, copy: Copy) -> np.ndarray:
    """Points (n, 3) as the copy has them: mirrored left to right, then turned."""
    mirror = np.array([1.0, -1.0 if copy.mirrored else 1.0, 1.0])
    return ((xyz * mirror) @ _rotation(copy.turn_deg).T).astype(np.float32)


def turn_back(detections: Detections, copy: Copy) -> Detections:
    """Boxes of a copy as they stand in the recorded sweep."""
    center = np.asarray(detections.center, np.float64) @ _rotation(copy.turn_deg)
    yaw = np.asarray(detections.yaw, np.float64) - np.radians(copy.turn_deg)
    if copy.mirrored:
        center, yaw = center * [1, -1, 1], -yaw
    return dataclasses.replace(
        detections,
        center=jnp.asarray(center, jnp.float32),
        yaw=wrap_yaw(jnp.asarray(yaw, jnp.float32)),
    )


def _rotation(turn_deg: float) -> np.ndarray:
    cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def detect_copy(
    frames: Sequence[Frame], copy: Copy, config: DetectorConfig
) -> tuple[dict[str, list[KittiObject]], list[int]]:
    """KITTI results and status bits of every frame of a copy."""
    results, statuses = {}, []
    for frame in frames:
        found = common.detect(turn_points(frame.xyz, copy), frame.intensity, config)
        results[frame.name] = objects_from_detections(turn_back(found, copy), frame.calibration)
        statuses.append(int(found.status))
    return results, statuses


def label_points(frame: Frame) -> np.ndarray:
    """(labels,) LiDAR points within each label's box, -1 for regions without one."""
    boxed = [not label.is_dont_care for label in frame.labels]
    counts = np.full(len(boxed), -1)
    objects = [label for label in frame.labels if not label.is_dont_care]
    counts[boxed] = count_points_in_boxes(frame.xyz, *boxes_from_objects(objects, frame.calibration))
    return counts


def measure(
    labels: kitti.Objects, results: kitti.Objects, num_points: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """Average precision with ceilings, SOFT, recall, axis swaps and size errors of one copy."""
    evaluation = kitti.evaluate(labels, results, min_overlap=MIN_OVERLAP, metrics=METRICS)
    moderate = report.measure_selection(labels, results, Selection(difficulty="moderate"))
    hard = report.measure_selection(labels, results, Selection(difficulty="hard"))
    seen = Selection(min_points=WELL_SEEN_POINTS)
    well_seen = report.measure_selection(labels, results, seen, num_points=num_points)
    rates = {(row["metric"], row["min_overlap"]): row["recall"] for row in moderate["rates"]}
    curves = [curve.to_dict() for curve in evaluation.curves]
    return {
        "ap": {f"{c['metric']} {c['difficulty']}": c["r40"] for c in curves},
        "ap_ceiling": {f"{c['metric']} {c['difficulty']}": c["ceiling_r40"] for c in curves},
        "soft": kitti.soft_score(labels, results),
        "recall_moderate": {f"{metric} {overlap}": rates[metric, overlap] for metric, overlap in RECALLS},
        "yaw_well_seen": well_seen["matched"]["yaw"],
        "sizes": hard["matched"]["sizes"],
        "constant_sizes": hard["matched"]["constant_sizes"],
    }


def figures(measured: Mapping[str, Any]) -> dict[str, float]:
    """The numbers of one copy that are averaged over copies, by name."""
    recall = {f"recall {name}": value for name, value in measured["recall_moderate"].items()}
    swaps = {"swaps": measured["yaw_well_seen"]["num_axis_swaps"]}
    return measured["ap"] | {"SOFT": measured["soft"]} | recall | swaps


def summarise(by_copy: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Mean and standard deviation over the copies, and over those other than the recorded sweeps."""
    rows = {name: figures(measured) for name, measured in by_copy.items()}
    turned = [row for name, row in rows.items() if name != Copy().name]
    groups = {"all": list(rows.values())} | ({"turned": turned} if turned else {})
    return {
        f"{statistic} of {group}": {key: float(compute([row[key] for row in members])) for key in members[0]}
        for group, members in groups.items()
        for statistic, compute in (("mean", np.mean), ("sd", np.std))
    }


def print_report(
    by_copy: Mapping[str, Mapping[str, Any]], summary: Mapping[str, Mapping[str, float]]
) -> None:
    rows = {name: figures(measured) for name, measured in by_copy.items()} | dict(summary)
    columns = list(next(iter(rows.values())))
    common.print_table(["Car, R40", *columns], [[name, *row.values()] for name, row in rows.items()])
    ceilings = ", ".join(
        f"{name} {value:.1f}" for name, value in next(iter(by_copy.values()))["ap_ceiling"].items()
    )
    print(
        f"ceilings of perfect answers: {ceilings}; recall: moderate; swaps: {WELL_SEEN_POINTS} points or more"
    )
    name, measured = next(iter(by_copy.items()))
    num = measured["sizes"]["length"]["num"]
    print(f"\nsizes of {num} matched cars, easy to hard, {name} (m)")
    kept = ("mae", "rmse", "bias", "percent", "pearson", "mean_iou")
    table = measured["sizes"] | {"pooled constant": measured["constant_sizes"]["pooled"]}
    common.print_table(["", *kept], [[row, *(errors[key] for key in kept)] for row, errors in table.items()])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = common.parser(__doc__ or "")
    parser.add_argument("--copies", type=int, default=len(COPIES), choices=range(1, len(COPIES) + 1))
    options: argparse.Namespace = parser.parse_args(arguments)
    config = common.chosen_config(options)
    sweeps = open_sweeps(common.data_folder("kitti_object"))
    frames = [frame for sweep in sweeps if (frame := read_frame(sweep)) is not None]
    labels = {frame.name: frame.labels for frame in frames}
    num_points = {frame.name: label_points(frame) for frame in frames}
    by_copy, statuses = {}, []
    for copy in COPIES[: options.copies]:
        results, bits = detect_copy(frames, copy, config)
        by_copy[copy.name] = measure(labels, results, num_points)
        statuses += bits
    summary = summarise(by_copy)
    print_report(by_copy, summary)
    print(f"\n{len(frames)} frames; status: {', '.join(common.status_names(statuses)) or 'OK'}")
    found = {"num_frames": len(frames), "copies": by_copy, "summary": summary}
    common.write_report(found | {"status": common.status_names(statuses)}, options)


if __name__ == "__main__":
    main()
