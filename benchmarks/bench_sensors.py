"""Vehicles on sensors that nothing was tuned on: Argoverse 2 and PandaSet, labelled all round the sensor.

KITTI's labels hold only what one camera sees, so there a false alarm beside or behind the car costs nothing.
These labels go all round: a detection that overlaps no vehicle's label is a false alarm. SemanticKITTI has
no boxes but a class for every point: there a detection is right where most of its points are a vehicle's.

    python -m benchmarks.bench_sensors --json sensors.json
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import common
from jaxbox import Detections, DetectorConfig
from jaxbox.evaluation import count_points_in_boxes, matching, pairwise_overlaps
from jaxbox.io import (
    LabelledBoxes,
    argoverse2,
    pandaset,
    read_argoverse2_boxes,
    read_argoverse2_points,
    read_bin,
    read_pandaset_boxes,
    read_pandaset_points,
    read_semantic_labels,
    semantic_kitti,
)

MIN_POINTS = 30
MAX_RANGE_M = 40.0
"""Labels nearer than this with so many points are to be found."""
RECALL_OVERLAP = 0.5
REPEATED_OVERLAP = 0.9
TRUE_OVERLAPS = (0.1, 0.3, 0.5)
"""A detection is right where it overlaps a vehicle's label so much: found at all, in its place, well."""
SCORE_CUTS = (0.01, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
TRUE_POINT_SHARE = 0.5


@dataclasses.dataclass(frozen=True)
class LabelledSweep:
    """A sweep with boxes all round."""

    name: str
    xyz: np.ndarray
    intensity: np.ndarray
    boxes: LabelledBoxes
    is_car: np.ndarray
    is_vehicle: np.ndarray


def argoverse2_sweeps() -> list[LabelledSweep]:
    files = sorted(common.data_folder("argoverse2").glob("*.bin"))
    return [
        _labelled(
            file.stem,
            read_argoverse2_points(file),
            read_argoverse2_boxes(file.with_suffix(".boxes.json")),
            argoverse2.CAR_CLASSES,
            argoverse2.VEHICLE_CLASSES,
        )
        for file in files
    ]


def pandaset_sweeps() -> list[LabelledSweep]:
    files = sorted(common.data_folder("pandaset").glob("*.bin"))
    return [
        _labelled(
            file.stem,
            read_pandaset_points(file),
            read_pandaset_boxes(file.with_suffix(".txt")),
            pandaset.CAR_CLASSES,
            pandaset.VEHICLE_CLASSES,
        )
        for file in files
    ]


def _labelled(
    name: str,
    points: tuple[np.ndarray, np.ndarray],
    boxes: LabelledBoxes,
    cars: frozenset[str],
    vehicles: frozenset[str],
) -> LabelledSweep:
    return LabelledSweep(name, *points, boxes, boxes.of_classes(cars), boxes.of_classes(vehicles))


DATA_SETS: Mapping[str, Callable[[], list[LabelledSweep]]] = {
    "argoverse2": argoverse2_sweeps,
    "pandaset": pandaset_sweeps,
}


def measure(sweep: LabelledSweep, found: Detections) -> dict[str, Any]:
    """What was found of one sweep's labels, and what was found beside them."""
    boxes = sweep.boxes
    valid = np.asarray(found.valid)
    center, size, yaw = (np.asarray(part)[valid] for part in (found.center, found.size, found.yaw))
    overlap, _ = pairwise_overlaps(_rows(boxes.center, boxes.size, boxes.yaw), _rows(center, size, yaw))
    num_points = count_points_in_boxes(sweep.xyz, boxes.center, boxes.size, boxes.yaw)
    wanted = (num_points >= MIN_POINTS) & (np.hypot(*boxes.center[:, :2].T) <= MAX_RANGE_M)
    wanted &= ~_repeated(boxes)
    best = overlap[sweep.is_vehicle].max(axis=0, initial=0)
    return {
        "sweep": sweep.name,
        "recall": {
            "cars": _recall(overlap, wanted & sweep.is_car),
            "vehicles": _recall(overlap, wanted & sweep.is_vehicle),
        },
        "score": np.asarray(found.score)[valid].tolist(),
        "range_m": np.hypot(*center[:, :2].T).tolist(),
        "best_overlap": best.tolist(),
        "sensor_height_m": -float(found.ground.coefficients[2]),
        "status": common.status_names([int(found.status)]),
    }


def _repeated(boxes: LabelledBoxes) -> np.ndarray:
    """(n,) bool: labels that an earlier one covers; some objects are labelled twice, as two tracks."""
    rows = _rows(boxes.center, boxes.size, boxes.yaw)
    overlap, _ = pairwise_overlaps(rows, rows)
    return np.any(np.tril(overlap, k=-1) >= REPEATED_OVERLAP, axis=1)


def _rows(center: np.ndarray, size: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    return np.column_stack([center, size, yaw]).astype(float)


def _recall(overlap: np.ndarray, wanted: np.ndarray) -> list[int]:
    """Found and wanted labels; other labels take their detections only after the wanted ones."""
    matched = matching.match(overlap, wanted, min_overlap=RECALL_OVERLAP)
    return [int(np.sum(wanted & (matched >= 0))), int(np.sum(wanted))]


def measure_points(name: str, class_id: np.ndarray, found: Detections) -> dict[str, Any]:
    """For each detection, the share of its points that are a vehicle's."""
    owner = np.asarray(found.point_detection)[: len(class_id)]
    valid = np.asarray(found.valid)
    is_vehicle = np.isin(class_id, list(semantic_kitti.VEHICLE_CLASSES))
    points = np.bincount(owner[owner >= 0], minlength=len(valid))[valid]
    vehicle_points = np.bincount(owner[(owner >= 0) & is_vehicle], minlength=len(valid))[valid]
    return {
        "sweep": name,
        "score": np.asarray(found.score)[valid].tolist(),
        "range_m": np.hypot(*np.asarray(found.center)[valid, :2].T).tolist(),
        "best_overlap": (vehicle_points / np.maximum(points, 1)).tolist(),
        "status": common.status_names([int(found.status)]),
    }


def precision_rows(
    measured: Sequence[Mapping[str, Any]], overlaps: Sequence[float], *, max_range_m: float
) -> list[dict[str, float | None]]:
    """Precision and false alarms a sweep at each cut, of detections nearer than a range."""
    score, reach, best = (
        np.concatenate([np.zeros(0), *(sweep[key] for sweep in measured)])
        for key in ("score", "range_m", "best_overlap")
    )
    rows = []
    for cut in SCORE_CUTS:
        kept = best[(score >= cut) & (reach <= max_range_m)]
        row: dict[str, float | None] = {"min_score": cut, "detections_per_sweep": len(kept) / len(measured)}
        for overlap in overlaps:
            row[f"precision_{overlap}"] = float(np.mean(kept >= overlap)) if len(kept) else None
            row[f"false_per_sweep_{overlap}"] = float(np.sum(kept < overlap)) / len(measured)
        rows.append(row)
    return rows


def bench_boxes(name: str, config: DetectorConfig) -> dict[str, Any]:
    measured = [
        measure(sweep, common.detect(sweep.xyz, sweep.intensity, config)) for sweep in DATA_SETS[name]()
    ]
    return _summary(measured, TRUE_OVERLAPS) | {
        "recall": {
            kind: {
                "found": sum(sweep["recall"][kind][0] for sweep in measured),
                "wanted": sum(sweep["recall"][kind][1] for sweep in measured),
            }
            for kind in ("cars", "vehicles")
        }
    }


def bench_semantic_kitti(config: DetectorConfig) -> dict[str, Any]:
    folder = common.data_folder("semantic_kitti")
    measured = []
    for path in sorted((folder / "labels").glob("*.label")):
        xyz, intensity = read_bin(folder / "velodyne" / f"{path.stem}.bin")
        class_id, _ = read_semantic_labels(path, num_points=len(xyz))
        measured.append(measure_points(path.stem, class_id, common.detect(xyz, intensity, config)))
    return _summary(measured, (TRUE_POINT_SHARE,))


def _summary(measured: list[dict[str, Any]], overlaps: Sequence[float]) -> dict[str, Any]:
    return {
        "sweeps": measured,
        "precision_within_40_m": precision_rows(measured, overlaps, max_range_m=MAX_RANGE_M),
        "precision": precision_rows(measured, overlaps, max_range_m=np.inf),
    }


def print_summary(name: str, summary: Mapping[str, Any]) -> None:
    statuses = sorted({bit for sweep in summary["sweeps"] for bit in sweep["status"]})
    print(f"\n{name}: {len(summary['sweeps'])} sweeps; status: {', '.join(statuses) or 'OK'}")
    for sweep in summary["sweeps"]:
        if "recall" in sweep:
            found = ", ".join(f"{kind} {n} of {of}" for kind, (n, of) in sweep["recall"].items())
            print(f"  {sweep['sweep']}: {found}; sensor {sweep['sensor_height_m']:.2f} m above the ground")
    for kind, counts in summary.get("recall", {}).items():
        recall = counts["found"] / counts["wanted"] if counts["wanted"] else float("nan")
        print(f"recall of {kind} at BEV IoU {RECALL_OVERLAP}: {recall:.3f} of {counts['wanted']}")
    for key in ("precision_within_40_m", "precision"):
        print(key)
        common.print_table(list(summary[key][0]), [list(row.values()) for row in summary[key]])


def main(arguments: Sequence[str] | None = None) -> None:
    options = common.parser(__doc__ or "").parse_args(arguments)
    config = common.chosen_config(options)
    summaries = {name: bench_boxes(name, config) for name in DATA_SETS}
    summaries["semantic_kitti"] = bench_semantic_kitti(config)
    for name, summary in summaries.items():
        print_summary(name, summary)
    common.write_report(summaries, options)


if __name__ == "__main__":
    main()
