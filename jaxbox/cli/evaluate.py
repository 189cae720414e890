"""``jaxbox eval``: the figures of a folder of results, as tables, JSON and plots."""

import json
import pathlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from jaxbox import viz
from jaxbox._files import check_no_link
from jaxbox.cli.eval_pictures import write_judged_pictures
from jaxbox.cli.report import make_table
from jaxbox.evaluation import evaluate_folders
from jaxbox.evaluation.kitti import VEHICLE_OVERLAP
from jaxbox.evaluation.matching import MAX_TRUNCATION
from jaxbox.evaluation.report import read_folders
from jaxbox.io import atomic_writer, open_sweeps, read_drives
from jaxbox.io.kitti import MIN_VISIBLE_FRACTION

SELECTION_NAMES = {
    "all": "every labelled car",
    "easy_to_hard": "KITTI's easy to hard",
    "easy_to_moderate": "KITTI's easy and moderate",
    "clear": "at least 30 points, occlusion 0 or 1",
    "dense": "at least 50 points",
    "cut_off": f"cut off by the image: truncation above {MAX_TRUNCATION:g}",
}
PLOTS_FOLDER, PICTURES_FOLDER = "plots", "pictures"
"""Where in the results' folder the plots go, unless said otherwise, and the pictures."""
SIZE_SELECTION = "easy_to_hard"
"""The cars whose median the constant row answers."""
CUT_OVERLAP = 0.5
"""The overlap of the rates by score that `evaluate_folders` reports."""
PRECISION_TITLE = "KITTI average precision (R40) of its ceiling on these sweeps"
VEHICLES_TITLE = f"the same of cars, vans, trucks and trams as one class, at IoU {VEHICLE_OVERLAP:g}"
METRIC_NAMES = {"image": "2D box", "orientation": "orientation", "bev": "bird's-eye view", "3d": "3D"}


def run_eval(
    labels: pathlib.Path,
    results: pathlib.Path,
    *,
    missing_as_empty: bool,
    json_path: pathlib.Path | None,
    plots: pathlib.Path | None,
    drives_path: pathlib.Path | None,
    pictures: bool,
    min_score: float,
    console: Console,
) -> None:
    """Measures results against labels, prints the tables, and writes what is asked for.

    Args:
      labels: folder of labelled sweeps.
      results: folder of KITTI result files.
      missing_as_empty: take a missing result file for an empty one.
      json_path: file for every figure, or None.
      plots: folder for the plots; None for ``plots`` in the results' folder, if matplotlib is there.
      drives_path: file with the drive of each frame, or None.
      pictures: whether each frame is drawn, into ``pictures`` in the results' folder.
      min_score: boxes with lower scores are not drawn.
      console: where the tables go.

    Raises:
      InputError: where labels or results cannot be used.
      ImportError: without matplotlib, where a folder for the plots is given.
    """
    drives = None if drives_path is None else read_drives(drives_path, _labelled_names(labels))
    report = evaluate_folders(labels, results, drives=drives, missing_as_empty=missing_as_empty)
    print_report(report, console)
    if json_path is not None:
        with atomic_writer(json_path) as handle:
            json.dump(report, handle, indent=1, allow_nan=False)
        console.print(f"wrote {json_path}", markup=False)
    if pictures:
        check_no_link(results / PICTURES_FOLDER)
        read = read_folders(labels, results, missing_as_empty=missing_as_empty)
        for path in write_judged_pictures(read, results / PICTURES_FOLDER, min_score=min_score):
            console.print(f"wrote {path}", markup=False)
    if plots is None:
        check_no_link(results / PLOTS_FOLDER)
    objects = report["selections"][SIZE_SELECTION]["objects"]
    try:
        paths = write_plots(objects, plots or results / PLOTS_FOLDER)
    except ImportError as error:
        if plots is not None:
            raise
        console.print(f"no plots: {error}", markup=False)
        return
    for path in paths:
        console.print(f"wrote {path}", markup=False)


def print_report(report: Mapping[str, Any], console: Console) -> None:
    """Prints what `evaluate_folders` measured: rates, sizes next to the constant, average precision."""
    taken = report.get("num_missing_results", 0)
    console.print(f"{report['num_frames']} labelled sweeps" + f", {taken} without results" * bool(taken))
    console.print(recall_table(report["selections"]))
    if sentence := clip_sentence(report):
        console.print(sentence)
    everything = report["selections"]["all"]
    console.print(score_table(everything["rates_by_score"]))
    console.print(bin_table("range, m", everything["by_range"]))
    console.print(bin_table("LiDAR points", everything["by_points"]))
    console.print(size_table(report["selections"][SIZE_SELECTION]["matched"]))
    console.print(pose_table(report["selections"]))
    console.print(precision_table(report["kitti"]["curves"]))
    console.print(precision_table(report["vehicles"], VEHICLES_TITLE))
    if report["kitti"]["by_drive"]:
        console.print(drive_table(report["kitti"]["by_drive"]))


def _labelled_names(labels: pathlib.Path) -> list[str]:
    return [sweep.name for sweep in open_sweeps(labels) if sweep.labels_path is not None]


def recall_table(selections: Mapping[str, Any]) -> Table:
    """Recall of cars at BEV and 3D IoU 0.5 and 0.7, one row a selection."""
    rows = []
    for name, measured in selections.items():
        rates = measured["rates"]
        cells = [_number(rate["recall"]) for rate in rates]
        rows.append([SELECTION_NAMES.get(name, name), str(rates[0]["num_labels"]), *cells])
    some = next(iter(selections.values()))["rates"]
    columns = ["cars", "labels", *(f"{rate['metric'].upper()} {rate['min_overlap']:g}" for rate in some)]
    return make_table("recall of all boxes, whatever their score", columns, rows)


def clip_sentence(report: Mapping[str, Any]) -> str:
    """What recall says of labels that the image cuts off; empty where it cuts off none."""
    num_cut = report["selections"]["cut_off"]["rates"][0]["num_labels"]
    if not num_cut:
        return ""
    sentence = f"{num_cut} labels are cut off by the image; KITTI's difficulties leave them out. "
    left_out = f"of which KITTI's text leaves out those with less than {MIN_VISIBLE_FRACTION:g} in the image"
    if report["unclipped"]:
        return f"{sentence}Recall is of the boxes of detections.jsonl, {left_out}."
    return (
        f"{sentence}Some may be found and not written: recall is of boxes, {left_out}. "
        "Results of `detect --format both` tell."
    )


def score_table(rates_by_score: Iterable[Mapping[str, Any]]) -> Table:
    """Recall and precision over the least score, to choose where to cut."""
    keys = ("recall", "precision")
    rows = [
        [
            f"{rate['min_score']:g}",
            *(_number(rate[key]) for key in keys),
            str(rate["num_false"]),
            _number(rate["false_per_frame"], 2),
        ]
        for rate in rates_by_score
    ]
    title = f"every labelled car at BEV IoU {CUT_OVERLAP:g}, by least score"
    return make_table(title, ["score from", *keys, "false alarms", "a frame"], rows)


def bin_table(name: str, bins: Iterable[Mapping[str, Any]]) -> Table:
    """Recall over ranges of one value, such as distance or points."""
    bins = list(bins)
    rows = []
    for row in bins:
        upper = "" if row["upper"] is None else f" to {row['upper']:g}"
        cells = [_number(value) for value in row["recall"].values()]
        rows.append([f"from {row['lower']:g}{upper}", str(row["num_labels"]), *cells])
    columns = [key.replace("_", " ").upper() for key in (bins[0]["recall"] if bins else {})]
    title = f"recall of every labelled car by {name}, whatever the score"
    return make_table(title, [name, "labels", *columns], rows)


def size_table(matched: Mapping[str, Any]) -> Table:
    """The paper's size errors, and the row of always answering the median car."""
    rows = [_size_row(name, errors) for name, errors in matched["sizes"].items()]
    if matched["constant_sizes"] is not None:
        rows += [_size_row(f"constant: {name}", errors) for name, errors in matched["constant_sizes"].items()]
    title = f"size of {matched['num']} matched cars (BEV IoU >= {matched['min_bev_iou']:g}), easy to hard"
    columns = ["dimension", "MAE m", "RMSE m", "bias m", "error %", "Pearson", "1D IoU"]
    return make_table(title, columns, rows)


def pose_table(selections: Mapping[str, Any]) -> Table:
    """Overlap and direction of the matched cars, one row a selection."""
    rows = []
    for name, measured in selections.items():
        matched = measured["matched"]
        yaw = matched["yaw"]
        rows.append(
            [
                SELECTION_NAMES.get(name, name),
                str(matched["num"]),
                _number(matched["mean_bev_iou"]),
                _number(matched["mean_3d_iou"]),
                _number(yaw["median_deg"], 1),
                _number(yaw["p90_deg"], 1),
                str(yaw["num_axis_swaps"]),
            ]
        )
    columns = ["cars", "matched", "BEV IoU", "3D IoU", "median", "p90", "axis swaps"]
    return make_table("mean overlap and yaw error in degrees of matched cars", columns, rows)


def _size_row(name: str, errors: Mapping[str, Any]) -> list[str]:
    keys = (("mae", 3), ("rmse", 3), ("bias", 3), ("percent", 1), ("pearson", 3), ("mean_iou", 3))
    return [name, *(_number(errors[key], digits) for key, digits in keys)]


def group_curves(curves: Iterable[Mapping[str, Any]]) -> dict[tuple[str, str], dict[str, Mapping[str, Any]]]:
    """Curves by class and metric, and then by difficulty, in their order."""
    grouped: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for curve in curves:
        grouped.setdefault((curve["class"], curve["metric"]), {})[curve["difficulty"]] = curve
    return grouped


def precision_table(curves: Iterable[Mapping[str, Any]], title: str = PRECISION_TITLE) -> Table:
    """KITTI's average precision over 40 recalls, and the most that perfect boxes reach on these sweeps."""
    grouped, rows = group_curves(curves), []
    for (class_name, metric), levels in grouped.items():
        cells = [f"{curve['r40']:.2f} of {curve['ceiling_r40']:.2f}" for curve in levels.values()]
        rows.append([f"{class_name}, {METRIC_NAMES.get(metric, metric)}", *cells])
    difficulties = list(next(iter(grouped.values()))) if grouped else []
    return make_table(title, ["", *difficulties], rows)


def drive_table(by_drive: Mapping[str, Iterable[Mapping[str, Any]]]) -> Table:
    """Average precision of cars of each drive by itself, moderate; few labels have a low ceiling."""
    rows = []
    for drive, curves in by_drive.items():
        cars = {c["metric"]: c for c in curves if c["class"] == "Car" and c["difficulty"] == "moderate"}
        cells = [f"{cars[name]['r40']:.2f} of {cars[name]['ceiling_r40']:.2f}" for name in ("bev", "3d")]
        rows.append([drive, str(cars["3d"]["num_labels"]), *cells])
    title = "cars by drive, moderate: average precision (R40) of its ceiling"
    return make_table(title, ["drive", "labels", METRIC_NAMES["bev"], METRIC_NAMES["3d"]], rows)


def write_plots(objects: Mapping[str, Any], folder: pathlib.Path) -> list[pathlib.Path]:
    """Writes estimated against true dimensions (figure 12) and the residuals (figure 13).

    Args:
      objects: the matched boxes row by row, of `evaluate_folders`.
      folder: where to.

    Returns:
      The files.
    """
    estimated = np.reshape(objects["estimated_m"], (-1, 3))
    true = np.reshape(objects["true_m"], (-1, 3))
    return [
        viz.save_figure(folder / "dimensions.png", viz.plot_dimensions(estimated, true)),
        viz.save_figure(folder / "residuals.png", viz.plot_residuals(estimated, true)),
    ]


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
