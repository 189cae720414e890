"""Everything that is measured of a folder of results, as one dictionary for JSON."""

import dataclasses
import os
import pathlib
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from jaxbox.evaluation import kitti, matching, sizes
from jaxbox.evaluation.unclipped import read_unclipped
from jaxbox.io import InputError, KittiObject, Sweep, boxes_from_objects, open_sweeps, read_labels

SELECTIONS: Mapping[str, matching.Selection] = {
    "all": matching.Selection(),
    "easy_to_hard": matching.Selection(difficulty="hard"),
    "easy_to_moderate": matching.Selection(difficulty="moderate"),
    "clear": matching.Selection(min_points=30, max_occlusion=1),
    "dense": matching.Selection(min_points=50),
    "cut_off": matching.Selection(cut_off=True),
}
"""Cars: every label; those of KITTI's difficulties; those that a sweep shows well; those of that many points
that no box should have its length and width changed places; and those that the image cuts off."""

MATCH_OVERLAP = 0.2
"""Bird's-eye IoU from which sizes and directions are compared. A median car with its axes swapped still has
.27 with itself, so that this worst error is among those counted; at .5 it would count as not found."""

SCORE_CUTS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Scores at which recall and precision are reported."""

_CUT_METRIC, _CUT_OVERLAP = "bev", 0.5


@dataclasses.dataclass(frozen=True)
class LabelledResults:
    """A folder's labelled sweeps and the results for them."""

    sweeps: tuple[Sweep, ...]
    """Those with labels."""
    labels: kitti.Objects
    """Ground truth of each, by the sweep's name."""
    results: kitti.Objects
    """Detections of each."""
    num_missing: int
    """Result files that were missing and taken for empty."""
    unclipped: kitti.Objects | None = None
    """Detections of each with those that KITTI's text leaves out, see `jaxbox.evaluation.unclipped`; None
    where they are not known."""


def read_folders(
    root: str | os.PathLike[str],
    results: str | os.PathLike[str],
    *,
    frames: Collection[str] | None = None,
    missing_as_empty: bool = False,
) -> LabelledResults:
    """Reads the labels of a folder of sweeps and a folder of KITTI result files for them.

    Args:
      root: what `jaxbox.io.open_sweeps` takes; sweeps without labels are skipped.
      results: folder of ``NAME.txt`` or ``data/NAME.txt``, one a labelled sweep.
      frames: names of the sweeps that are read; None for all.
      missing_as_empty: take a missing result file for an empty one.

    Returns:
      Sweeps, labels and results, in one order.

    Raises:
      InputError: for a missing folder, no labelled sweep, a missing result file, or a bad line.
    """
    labelled = [
        (sweep, objects)
        for sweep in open_sweeps(root)
        if (frames is None or sweep.name in frames) and (objects := sweep.read_labels()) is not None
    ]
    if not labelled:
        raise InputError(f"{root}: no sweep there has labels; expected label_2 or label_02 next to velodyne.")
    labels = {sweep.name: objects for sweep, objects in labelled}
    detections = _read_results(pathlib.Path(results), list(labels), missing_as_empty=missing_as_empty)
    found = {name: objects or [] for name, objects in detections.items()}
    sweeps = tuple(sweep for sweep, _ in labelled)
    has_cameras = all(sweep.calibration_path is not None for sweep in sweeps)
    return LabelledResults(
        sweeps=sweeps,
        labels=labels,
        results=found,
        unclipped=read_unclipped(results, sweeps, found) if has_cameras else None,
        num_missing=sum(found is None for found in detections.values()),
    )


def evaluate_folders(
    root: str | os.PathLike[str],
    results: str | os.PathLike[str],
    *,
    selections: Mapping[str, matching.Selection] = SELECTIONS,
    match_overlap: float = MATCH_OVERLAP,
    drives: Mapping[str, str] | None = None,
    frames: Collection[str] | None = None,
    missing_as_empty: bool = False,
) -> dict[str, Any]:
    """Measures a folder of KITTI result files against the labels of a folder of sweeps.

    Args:
      root: as `read_folders`, and so are the results.
      results: folder of ``NAME.txt`` or ``data/NAME.txt``, one a labelled sweep.
      selections: what counts, by name.
      match_overlap: bird's-eye IoU from which sizes and directions are compared.
      drives: the drive of each labelled sweep, by name, to report each by itself too.
      frames: names of the sweeps that are measured; None for all.
      missing_as_empty: take a missing result file for an empty one.

    Returns:
      As `evaluate_objects`, and under "num_missing_results" how many files were taken for empty. Recall is of
      all boxes, also those that KITTI's text leaves out, where ``detections.jsonl`` of the run has them.

    Raises:
      InputError: as `read_folders`.
    """
    read = read_folders(root, results, frames=frames, missing_as_empty=missing_as_empty)
    counted = all(sweep.is_calibrated for sweep in read.sweeps)
    report = evaluate_objects(
        read.labels,
        read.results,
        num_points={sweep.name: count_label_points(sweep, read.labels[sweep.name]) for sweep in read.sweeps}
        if counted
        else None,
        selections=selections,
        match_overlap=match_overlap,
        drives=drives,
        unclipped=read.unclipped,
        metrics=kitti.METRICS_IN_SPACE if any(sweep.is_annotated for sweep in read.sweeps) else kitti.METRICS,
    )
    return report | {"num_missing_results": read.num_missing}


def _read_results(
    folder: pathlib.Path, names: Sequence[str], *, missing_as_empty: bool
) -> dict[str, list[KittiObject] | None]:
    """Results of each frame; None where the file is missing."""
    files = find_results(folder, names, missing_as_empty=missing_as_empty)
    return {name: None if file is None else _read_scored(file) for name, file in files.items()}


def find_results(
    folder: pathlib.Path, names: Sequence[str], *, missing_as_empty: bool = False, what: str = "sweeps"
) -> dict[str, pathlib.Path | None]:
    """Finds the result file of each labelled sweep or sequence.

    Args:
      folder: of ``NAME.txt``, or of ``data/NAME.txt``.
      names: of the labelled ones.
      missing_as_empty: whether one without a file is taken for one without results.
      what: the names are of, for the message.

    Returns:
      The file of each; None where it is missing.

    Raises:
      InputError: for a missing folder or a missing file.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; give the one that the results were written to.")
    # The official layout: results under data/, next to statistics that are text files too.
    if not any((folder / f"{name}.txt").is_file() for name in names) and (folder / "data").is_dir():
        folder = folder / "data"
    files = {name: folder / f"{name}.txt" for name in names}
    missing = [name for name, file in files.items() if not file.is_file()]
    if missing and not missing_as_empty:
        raise InputError(
            f"{folder}: no result file for {len(missing)} of {len(names)} labelled {what}, the first is "
            f"{missing[0]}.txt. Detect in them too, or take missing files for empty ones."
        )
    return {name: None if name in missing else file for name, file in files.items()}


def _read_scored(file: pathlib.Path) -> list[KittiObject]:
    objects = read_labels(file)
    for line, item in enumerate(objects, 1):
        if item.score is None:
            raise InputError(f"{file}: object {line} has no score; a result has 16 columns, the last is it.")
    return objects


def count_label_points(sweep: Sweep, labels: Sequence[KittiObject]) -> np.ndarray:
    """Counts a sweep's points within each label's box.

    Args:
      sweep: a sweep with a calibration.
      labels: n objects of this sweep.

    Returns:
      (n,) int; 0 for a DontCare region.

    Raises:
      InputError: where the sweep cannot be read, or has no calibration.
    """
    calibration = sweep.read_calibration()
    if calibration is None:
        raise InputError(f"{sweep.points_path}: no calibration belongs to it; labels cannot be placed.")
    rows = np.array([i for i, label in enumerate(labels) if not label.is_dont_care], int)
    boxes = boxes_from_objects([labels[i] for i in rows], calibration)
    counts = np.zeros(len(labels), int)
    counts[rows] = matching.count_points_in_boxes(sweep.read_points()[0], *boxes)
    return counts


def evaluate_objects(
    labels: kitti.Objects,
    results: kitti.Objects,
    *,
    num_points: Mapping[str, np.ndarray] | None = None,
    selections: Mapping[str, matching.Selection] = SELECTIONS,
    match_overlap: float = MATCH_OVERLAP,
    drives: Mapping[str, str] | None = None,
    metrics: Sequence[str] = kitti.METRICS,
    unclipped: kitti.Objects | None = None,
) -> dict[str, Any]:
    """Measures results against labels.

    Args:
      labels: ground truth of each frame, by name.
      results: detections, each with a score, of each of these frames.
      num_points: (labels of the frame,) int for each frame: LiDAR points within each label's box. Without
        them, selections by points are skipped.
      selections: what counts, by name.
      match_overlap: bird's-eye IoU from which sizes and directions are compared.
      drives: the drive of each frame, to report each by itself too.
      metrics: as `kitti.evaluate`.
      unclipped: as `measure_selection`.

    Returns:
      Numbers, strings, lists, dicts and None only:
        "unclipped": whether recall is of those;
        "num_frames", "num_drives" (None if unknown);
        "kitti": `KittiEvaluation.to_dict` of cars and of the other classes that have detections;
        "vehicles": the curves of cars, vans, trucks and trams as one class, see `kitti.as_vehicles`;
        "soft": `kitti.soft_score` of cars;
        "selections": for each, see `measure_selection`.

    Raises:
      ValueError: as `kitti.evaluate`.
    """
    found = {item.type.lower() for items in results.values() for item in items} | {"car"}
    classes = {name: overlap for name, overlap in kitti.MIN_OVERLAP.items() if name.lower() in found}
    protocol = kitti.evaluate(labels, results, min_overlap=classes, metrics=metrics, drives=drives)
    usable = {n: s for n, s in selections.items() if num_points is not None or s.min_points <= 0}
    return {
        "unclipped": unclipped is not None,
        "num_frames": len(labels),
        "num_drives": None if drives is None else len({drives[name] for name in labels}),
        "kitti": protocol.to_dict(),
        "vehicles": _vehicle_curves(labels, results),
        "soft": kitti.soft_score(labels, results),
        "selections": {
            name: measure_selection(
                labels,
                results,
                selection,
                num_points=num_points,
                match_overlap=match_overlap,
                unclipped=unclipped,
            )
            for name, selection in usable.items()
        },
    }


def _vehicle_curves(labels: kitti.Objects, results: kitti.Objects) -> list[dict[str, Any]]:
    merged = kitti.as_vehicles(labels), kitti.as_vehicles(results)
    overlap = {kitti.VEHICLE: kitti.VEHICLE_OVERLAP}
    curves = kitti.evaluate(*merged, min_overlap=overlap, metrics=kitti.METRICS_IN_SPACE).curves
    return [curve.to_dict() for curve in curves]


def measure_selection(
    labels: kitti.Objects,
    results: kitti.Objects,
    selection: matching.Selection,
    *,
    num_points: Mapping[str, np.ndarray] | None = None,
    match_overlap: float = MATCH_OVERLAP,
    unclipped: kitti.Objects | None = None,
) -> dict[str, Any]:
    """Measures what was found of the selected labels, and how well its boxes fit.

    Args:
      labels: ground truth of each frame, by name.
      results: detections, each with a score, of each of these frames.
      selection: what counts.
      num_points: as `evaluate_objects`.
      match_overlap: bird's-eye IoU from which sizes and directions are compared.
      unclipped: detections with those that KITTI's text leaves out, as the image shows too little of them,
        for "rates", "by_range" and "by_points"; None takes the results.

    Returns:
      Numbers, strings, lists, dicts and None only:
        "selection": its fields;
        "rates": `Rates` at BEV and 3D IoU .5 and .7, of all detections;
        "rates_by_score": `Rates` at BEV IoU .5 of the detections from each of `SCORE_CUTS` on, and
          "false_per_frame" (None without frames);
        "by_range", "by_points": `RecallBin`, of all detections;
        "matched": number, mean IoU, yaw and size errors, and "constant_sizes", the errors of always
          answering the median car for the same labels (None for other classes);
        "objects": the matched ones row by row, for plots.

    Raises:
      ValueError: as `matching.select`.
    """
    scenes = matching.select(labels, results, selection, num_points=num_points)
    matches = matching.matched_boxes(scenes, min_overlap=match_overlap)
    whole = (
        scenes if unclipped is None else matching.select(labels, unclipped, selection, num_points=num_points)
    )
    return {
        "selection": selection.to_dict(),
        "rates": [
            matching.rates(whole, metric=metric, min_overlap=overlap).to_dict()
            for metric in ("bev", "3d")
            for overlap in matching.RATE_OVERLAPS
        ],
        "rates_by_score": [_rates_at(scenes, min_score) for min_score in SCORE_CUTS],
        "by_range": [row.to_dict() for row in matching.recall_by_range(whole)],
        "by_points": [row.to_dict() for row in matching.recall_by_points(whole)],
        "matched": _matched_errors(matches, selection.class_name, match_overlap),
        "objects": _object_rows(matches),
    }


def _rates_at(scenes: Sequence[matching.Scene], min_score: float) -> dict[str, Any]:
    kept = matching.cut(scenes, min_score=min_score)
    at_cut = matching.rates(kept, metric=_CUT_METRIC, min_overlap=_CUT_OVERLAP)
    per_frame = at_cut.num_false / len(scenes) if scenes else None
    return {"min_score": min_score} | at_cut.to_dict() | {"false_per_frame": per_frame}


def _matched_errors(matches: matching.Matches, class_name: str, match_overlap: float) -> dict[str, Any]:
    true, estimated = matches.labels[:, 3:6], matches.detections[:, 3:6]
    constant = sizes.constant_sizes(len(true)) if class_name.lower() == "car" else None
    return {
        "min_bev_iou": match_overlap,
        "num": len(true),
        "mean_bev_iou": float(matches.bev_iou.mean()) if len(true) else None,
        "mean_3d_iou": float(matches.box_iou.mean()) if len(true) else None,
        "yaw": sizes.yaw_errors(matches.detections[:, 6], matches.labels[:, 6]).to_dict(),
        "sizes": _size_table(estimated, true),
        "constant_sizes": None if constant is None else _size_table(constant, true),
    }


def _size_table(estimated: np.ndarray, true: np.ndarray) -> dict[str, Any]:
    return {name: errors.to_dict() for name, errors in sizes.size_errors(estimated, true).items()}


def _object_rows(matches: matching.Matches) -> dict[str, Any]:
    true, estimated = matches.labels[:, 3:6], matches.detections[:, 3:6]
    yaw_error = sizes.axis_differences(matches.detections[:, 6], matches.labels[:, 6])
    return {
        "frames": list(matches.frames),
        "estimated_m": estimated.tolist(),
        "true_m": true.tolist(),
        "residual_m": (estimated - true).tolist(),
        "yaw_error_deg": np.degrees(yaw_error).tolist(),
        "bev_iou": matches.bev_iou.tolist(),
        "3d_iou": matches.box_iou.tolist(),
        "range_m": np.hypot(matches.labels[:, 0], matches.labels[:, 1]).tolist(),
        "num_points": [None if count < 0 else count for count in matches.num_points.tolist()],
    }
