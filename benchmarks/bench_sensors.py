"""Vehicles on sweeps labelled all round: Argoverse 2, PandaSet, SemanticKITTI; nothing was tuned on them.

KITTI's labels hold only what one camera sees, so there a false alarm next to or behind the car costs nothing.
These labels go all round: a detection that overlaps no vehicle's label is a false alarm. SemanticKITTI has
no boxes but a class for every point: there a detection is right where most of its points are a vehicle's.

The score from which boxes are worth acting on is chosen here: the smallest cut at which 9 of 10 detections
are right, over all three data sets. They are few sweeps, so each is also seen turned and mirrored.

    python -m benchmarks.bench_sensors --json sensors.json
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import common
from jaxbox import Detections, DetectorConfig, Label
from jaxbox.cli.report import SHOWN_MIN_SCORE
from jaxbox.evaluation import count_points_in_boxes, matching, pairwise_overlaps
from jaxbox.evaluation.copies import COPIES, Copy, turn_back, turn_points
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
"""Labels nearer than this with that many points are to be found."""
RECALL_OVERLAP = 0.5
REPEATED_OVERLAP = 0.9
TRUE_OVERLAPS = (0.1, 0.3, 0.5)
"""A detection is right where it overlaps a vehicle's label so much: found at all, in its place, well."""
RIGHT_OVERLAP = 0.3
"""The one of them that the cut is chosen by: of two equal boxes, one shifted by half its length has 0.33."""
RIGHT_SHARE = 0.5
"""Where points have classes: this share of a detection's are a vehicle's, or the other way round."""
UNLABELLED_CLASSES = frozenset({0, 1})
"""SemanticKITTI's unlabelled points and outliers, most of those far away: a detection there is not judged."""
CAR_POINT_CLASSES = frozenset({10, 252})
"""SemanticKITTI's cars, standing and moving."""
SCORE_CUTS = (0.0, 0.01, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
MIN_PRECISION = 0.9
"""A user's cut keeps this precision."""


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
    """What was found of one sweep's labels, and what was found besides them."""
    boxes = sweep.boxes
    valid = np.asarray(found.valid)
    score = np.asarray(found.score)[valid]
    overlap, _ = pairwise_overlaps(common.box_rows(boxes), common.box_rows(found)[valid])
    num_points = count_points_in_boxes(sweep.xyz, boxes.center, boxes.size, boxes.yaw)
    wanted = (num_points >= MIN_POINTS) & (np.hypot(*boxes.center[:, :2].T) <= MAX_RANGE_M)
    wanted &= ~_repeated(boxes)
    best = overlap[sweep.is_vehicle].max(axis=0, initial=0)
    return {
        "sweep": sweep.name,
        "labels": {
            "cars": _labels_found(overlap, score, wanted & sweep.is_car),
            "vehicles": _labels_found(overlap, score, wanted & sweep.is_vehicle),
        },
        **_detections(found, np.ones(len(score), bool), best, best >= RIGHT_OVERLAP),
    }


def _detections(found: Detections, judged: np.ndarray, best: np.ndarray, right: np.ndarray) -> dict[str, Any]:
    """The detections that can be judged, and whether they are right."""
    valid = np.asarray(found.valid)
    score, reach = np.asarray(found.score)[valid], np.hypot(*np.asarray(found.center)[valid, :2].T)
    return {
        "score": score[judged].tolist(),
        "label": np.asarray(found.label)[valid][judged].tolist(),
        "range_m": reach[judged].tolist(),
        "best_overlap": best[judged].tolist(),
        "right": right[judged].tolist(),
        "unjudged_scores": score[~judged].tolist(),
        "sensor_height_m": -float(found.ground.coefficients[2]),
        "status": common.status_names([int(found.status)]),
    }


def _repeated(boxes: LabelledBoxes) -> np.ndarray:
    """(n,) bool: labels that an earlier one covers; some objects are labelled twice, as two tracks."""
    rows = common.box_rows(boxes)
    overlap, _ = pairwise_overlaps(rows, rows)
    return np.any(np.tril(overlap, k=-1) >= REPEATED_OVERLAP, axis=1)


def _labels_found(overlap: np.ndarray, score: np.ndarray, wanted: np.ndarray) -> dict[str, Any]:
    """Wanted labels, and those found at each cut; other labels take their detections only after them."""
    found = []
    for cut in SCORE_CUTS:
        matched = matching.match(overlap[:, score >= cut], wanted, min_overlap=RECALL_OVERLAP)
        found.append(int(np.sum(wanted & (matched >= 0))))
    return {"wanted": int(np.sum(wanted)), "found": found}


@dataclasses.dataclass(frozen=True)
class ClassedSweep:
    """A sweep with a class and an instance for every point."""

    name: str
    xyz: np.ndarray
    intensity: np.ndarray
    class_id: np.ndarray
    instance_id: np.ndarray


def measure_points(sweep: ClassedSweep, found: Detections) -> dict[str, Any]:
    """The same where points are labelled: the share of each detection's points that are a vehicle's."""
    owner = np.asarray(found.point_detection)[: len(sweep.class_id)]
    valid = np.asarray(found.valid)
    is_vehicle = np.isin(sweep.class_id, list(semantic_kitti.VEHICLE_CLASSES))
    is_unlabelled = np.isin(sweep.class_id, list(UNLABELLED_CLASSES))
    points, vehicle_points, unlabelled_points = (
        np.bincount(owner[(owner >= 0) & kind], minlength=len(valid))[valid]
        for kind in (np.ones_like(is_vehicle), is_vehicle, is_unlabelled)
    )
    share = vehicle_points / np.maximum(points, 1)
    judged = (points > 0) & (unlabelled_points <= RIGHT_SHARE * points)
    return {
        "sweep": sweep.name,
        "labels": {"cars": _instances_found(sweep, owner, np.asarray(found.score))},
        **_detections(found, judged, share, share >= RIGHT_SHARE),
    }


def _instances_found(sweep: ClassedSweep, owner: np.ndarray, score: np.ndarray) -> dict[str, Any]:
    """Cars to be found, and those of which one detection holds most points, at each cut."""
    is_car = np.isin(sweep.class_id, list(CAR_POINT_CLASSES)) & (sweep.instance_id > 0)
    scores = []
    for instance in np.unique(sweep.instance_id[is_car]):
        own = is_car & (sweep.instance_id == instance)
        distance = np.hypot(*np.median(sweep.xyz[own, :2], axis=0))
        if np.sum(own) < MIN_POINTS or distance > MAX_RANGE_M:
            continue
        held = np.bincount(owner[own & (owner >= 0)], minlength=len(score))
        scores.append(score[np.argmax(held)] if held.max() >= RIGHT_SHARE * np.sum(own) else -1)
    return {"wanted": len(scores), "found": [int(np.sum(np.array(scores) >= cut)) for cut in SCORE_CUTS]}


def cut_rows(
    measured: Sequence[Mapping[str, Any]], right: Mapping[str, Callable[[Mapping[str, Any]], np.ndarray]]
) -> list[dict[str, float | None]]:
    """At each cut: detections a sweep, precision and false alarms a sweep, and recall of cars.

    Args:
      measured: of each sweep.
      right: which of a sweep's detections are right, by the name of the rule.

    Returns:
      One row a cut; None where there is nothing to divide by.
    """
    score = np.concatenate([np.zeros(0), *(sweep["score"] for sweep in measured)])
    verdicts = {
        name: np.concatenate([np.zeros(0, bool), *(np.asarray(rule(sweep), bool) for sweep in measured)])
        for name, rule in right.items()
    }
    wanted = sum(sweep["labels"]["cars"]["wanted"] for sweep in measured)
    rows = []
    for index, cut in enumerate(SCORE_CUTS):
        kept = score >= cut
        row: dict[str, float | None] = {"min_score": cut, "detections_per_sweep": kept.sum() / len(measured)}
        for name, verdict in verdicts.items():
            row[f"precision{name}"] = float(np.mean(verdict[kept])) if kept.any() else None
            row[f"false_per_sweep{name}"] = float(np.sum(~verdict[kept])) / len(measured)
        found = sum(sweep["labels"]["cars"]["found"][index] for sweep in measured)
        row["recall_cars"] = found / wanted if wanted else None
        rows.append(row)
    return rows


def _nearer(sweep: Mapping[str, Any], max_range_m: float) -> dict[str, Any]:
    """The sweep without its farther detections."""
    near = np.asarray(sweep["range_m"]) <= max_range_m
    lists = {
        key: np.asarray(sweep[key])[near] for key in ("score", "label", "range_m", "best_overlap", "right")
    }
    return {**sweep, **lists}


def choose_cut(rows: Sequence[Mapping[str, float | None]]) -> float | None:
    """The smallest cut that keeps `MIN_PRECISION`, or None where none does."""
    return next((row["min_score"] for row in rows if (row["precision"] or 0) >= MIN_PRECISION), None)


def summarise(measured: Sequence[Mapping[str, Any]], overlaps: Sequence[float]) -> dict[str, Any]:
    """Tables by cut, at every range and near by, of one data set."""
    rules = {
        f"_{overlap}": lambda sweep, least=overlap: np.asarray(sweep["best_overlap"]) >= least
        for overlap in overlaps
    }
    near = [_nearer(sweep, MAX_RANGE_M) for sweep in measured]
    return {
        "sweeps": list(measured),
        "recall": {kind: _recall(measured, kind) for kind in measured[0]["labels"]} if measured else {},
        "cuts": cut_rows(measured, rules),
        "cuts_within_40_m": cut_rows(near, rules),
    }


def _recall(measured: Sequence[Mapping[str, Any]], kind: str) -> dict[str, int]:
    """Labels found without a cut, as recorded and over all copies."""
    recorded = [sweep for sweep in measured if sweep["copy"] == Copy().name]
    return {
        f"{count}{suffix}": sum(
            sweep["labels"][kind]["wanted"] if count == "wanted" else sweep["labels"][kind]["found"][0]
            for sweep in sweeps
        )
        for suffix, sweeps in (("", recorded), ("_all_copies", measured))
        for count in ("found", "wanted")
    }


def classed_sweeps() -> list[ClassedSweep]:
    folder = common.data_folder("semantic_kitti")
    sweeps = []
    for path in sorted((folder / "labels").glob("*.label")):
        xyz, intensity = read_bin(folder / "velodyne" / f"{path.stem}.bin")
        sweeps.append(
            ClassedSweep(path.stem, xyz, intensity, *read_semantic_labels(path, num_points=len(xyz)))
        )
    return sweeps


def measure_copies(
    sweeps: Sequence[Any],
    config: DetectorConfig,
    copies: Sequence[Copy],
    *,
    by: Callable[[Any, Detections], dict[str, Any]],
) -> list[dict[str, Any]]:
    """Measures every sweep as each copy has it."""
    measured = []
    for sweep in sweeps:
        for copy in copies:
            found = turn_back(common.detect(turn_points(sweep.xyz, copy), sweep.intensity, config), copy)
            measured.append({"copy": copy.name} | by(sweep, found))
    return measured


def pool(summaries: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """All data sets together: the table by cut, and the cut that it chooses."""
    measured = [sweep for summary in summaries.values() for sweep in summary["sweeps"]]
    rows = cut_rows(measured, {"": lambda sweep: sweep["right"]})
    return {
        "cuts": rows,
        "chosen_cut": choose_cut(rows),
        "library_cut": SHOWN_MIN_SCORE,
        "classes": right_by_class(measured),
    }


def right_by_class(measured: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Boxes of each class from the library's cut on, and how many of them are right: on a vehicle of any."""
    score, label, right = (
        np.concatenate([np.zeros(0, int), *(np.asarray(sweep[key]) for sweep in measured)])
        for key in ("score", "label", "right")
    )
    shown = score >= SHOWN_MIN_SCORE
    of_class = {kind: shown & (label == kind) for kind in Label}
    return {
        kind.name.lower(): {"boxes": int(rows.sum()), "right": int(right[rows].sum())}
        for kind, rows in of_class.items()
    }


def print_summary(name: str, summary: Mapping[str, Any]) -> None:
    statuses = sorted({bit for sweep in summary["sweeps"] for bit in sweep["status"]})
    print(f"\n{name}: {len(summary['sweeps'])} sweeps and copies; status: {', '.join(statuses) or 'OK'}")
    for sweep in summary["sweeps"]:
        if sweep["copy"] == Copy().name:
            found = ", ".join(
                f"{kind} {labels['found'][0]} of {labels['wanted']}"
                for kind, labels in sweep["labels"].items()
            )
            print(f"  {sweep['sweep']}: {found}; sensor {sweep['sensor_height_m']:.2f} m above the ground")
    for kind, counts in summary["recall"].items():
        for suffix, text in (("", "as recorded"), ("_all_copies", "over all copies")):
            found, wanted = counts[f"found{suffix}"], counts[f"wanted{suffix}"]
            print(f"recall of {kind}, {text}: {found / wanted if wanted else np.nan:.3f} of {wanted}")
    for key in ("cuts_within_40_m", "cuts"):
        print(f"{key}:")
        common.print_table(list(summary[key][0]), [list(row.values()) for row in summary[key]])


def print_pool(pooled: Mapping[str, Any]) -> None:
    print(
        f"\nall data sets (right: BEV IoU {RIGHT_OVERLAP}, or {RIGHT_SHARE:.0%} of the points), every range:"
    )
    common.print_table(list(pooled["cuts"][0]), [list(row.values()) for row in pooled["cuts"]])
    precision = {row["min_score"]: row["precision"] for row in pooled["cuts"]}
    if pooled["chosen_cut"] is None:
        print(f"no cut keeps a precision of {MIN_PRECISION}")
    else:
        print(
            f"the smallest cut that keeps a pooled precision of {MIN_PRECISION} is {pooled['chosen_cut']}: "
            f"{precision[pooled['chosen_cut']]:.3f}"
        )
    if SHOWN_MIN_SCORE in precision:
        print(f"the default cut is {SHOWN_MIN_SCORE}: pooled precision {precision[SHOWN_MIN_SCORE]:.3f}")
    by_class = (f"{name} {count['right']} of {count['boxes']}" for name, count in pooled["classes"].items())
    print(f"right of the boxes of each class, from there on: {', '.join(by_class)}")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = common.parser(__doc__ or "")
    parser.add_argument("--copies", type=int, default=len(COPIES), choices=range(1, len(COPIES) + 1))
    options = parser.parse_args(arguments)
    config, copies = common.chosen_config(options), COPIES[: options.copies]
    summaries = {
        name: summarise(measure_copies(read(), config, copies, by=measure), TRUE_OVERLAPS)
        for name, read in DATA_SETS.items()
    }
    measured = measure_copies(classed_sweeps(), config, copies, by=measure_points)
    summaries["semantic_kitti"] = summarise(measured, (RIGHT_SHARE,))
    pooled = pool(summaries)
    for name, summary in summaries.items():
        print_summary(name, summary)
    print_pool(pooled)
    common.write_report(summaries | {"pooled": pooled}, options)


if __name__ == "__main__":
    main()
