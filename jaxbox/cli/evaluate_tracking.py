"""``jaxbox eval --tracking``: the figures of a folder of tracks, as tables and JSON."""

import json
import pathlib
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from jaxbox.cli.report import make_table
from jaxbox.evaluation.tracking import evaluate_tracking_folders
from jaxbox.io import InputError, atomic_writer

METRIC_NAMES = {"bev": "vehicle, bird's-eye view", "3d": "vehicle, 3D"}
_FRAMES = re.compile(r"(?P<name>[^:]+)(:(?P<first>\d+)-(?P<last>\d+))?")


def run_eval_tracking(
    labels: pathlib.Path,
    results: pathlib.Path,
    *,
    frames: Sequence[str],
    missing_as_empty: bool,
    min_score: float | None,
    json_path: pathlib.Path | None,
    console: Console,
) -> None:
    """Measures tracks against labels, prints the tables, and writes what is asked for.

    Args:
      labels: folder of ``label_02`` and ``calib``.
      results: folder of tracking results, one text file a sequence.
      frames: sequences to evaluate, as `parse_frames` reads them; none for every labelled one.
      missing_as_empty: take a missing result file for an empty one.
      min_score: lower-scored boxes are left out of the metrics of tracks; None keeps all.
      json_path: file for every figure, or None.
      console: where the tables go.

    Raises:
      InputError: where labels, results or frames cannot be used.
      ImportError: without SciPy.
    """
    report = evaluate_tracking_folders(
        labels,
        results,
        frames=parse_frames(frames) if frames else None,
        missing_as_empty=missing_as_empty,
        min_score=-np.inf if min_score is None else min_score,
    )
    print_tracking_report(report, console)
    if json_path is not None:
        with atomic_writer(json_path) as handle:
            json.dump(report, handle, indent=1, allow_nan=False)
        console.print(f"wrote {json_path}", markup=False)


def parse_frames(words: Iterable[str]) -> dict[str, tuple[int, int] | None]:
    """Reads which sequences and frames are evaluated.

    Args:
      words: ``NAME:FIRST-LAST``, or ``NAME`` for all frames of a sequence.

    Returns:
      First and last frame of each, None for all.

    Raises:
      InputError: for another form, or a sequence named twice.

    >>> parse_frames(["0000:0-47", "0003"])
    {'0000': (0, 47), '0003': None}
    """
    spans: dict[str, tuple[int, int] | None] = {}
    for word in words:
        found = _FRAMES.fullmatch(word)
        if found is None:
            raise InputError(f"--frames {word}: give SEQUENCE:FIRST-LAST, as 0000:0-47, or a sequence alone.")
        if found["name"] in spans:
            raise InputError(f"--frames {word}: sequence {found['name']} is named twice; give one span.")
        spans[found["name"]] = None if found["first"] is None else (int(found["first"]), int(found["last"]))
    return spans


def print_tracking_report(report: Mapping[str, Any], console: Console) -> None:
    """Prints what `evaluate_tracking_folders` measured."""
    missing = report["num_missing_results"]
    console.print(
        f"{len(report['frames'])} sequences, {report['vehicle']['num_frames']} frames"
        + f", {missing} sequences without results" * bool(missing)
    )
    for name, last_result in report["unfinished"].items():
        console.print(
            f"{name}: no results after frame {last_result}; labels up to {report['frames'][name][1]} are "
            f"missed. Where those frames were not processed: --frames {name}:0-{last_result}",
            markup=False,
        )
    for name, reason in report["without_effect"].items():
        console.print(f"{name}: no result counts: {reason}.", markup=False)
    tracks = report["vehicle"]["tracks"]
    rows = {f"KITTI {name}, 2D": part for name, part in report["kitti"].items()}
    rows |= {METRIC_NAMES[metric]: part for metric, part in (tracks or {}).items()}
    console.print(hota_table(rows))
    console.print(clear_table(rows))
    console.print(sequence_table(report["kitti"]["Car"]["by_sequence"]))
    console.print(detection_table(report["vehicle"]["detection"]))
    headings = report["vehicle"]["motion"]["headings"]
    if headings["num"]:
        console.print(
            f"headings of {headings['num']} matched vehicles: {_percent(headings['within_90_deg'])} % "
            f"within 90 degrees, {_percent(headings['within_10_deg'])} % within 10"
        )


def hota_table(rows: Mapping[str, Mapping[str, Any]]) -> Table:
    """HOTA and its parts, and identity, one row a class and overlap."""
    keys = ("hota", "det_a", "ass_a", "det_re", "det_pr", "ass_re", "ass_pr", "loc_a")
    columns = ["HOTA", "DetA", "AssA", "DetRe", "DetPr", "AssRe", "AssPr", "LocA", "IDF1", "IDR", "IDP"]
    cells = [
        [
            name,
            *(_percent(part["hota"][key]) for key in keys),
            *(_percent(part["identity"][key]) for key in ("idf1", "idr", "idp")),
        ]
        for name, part in rows.items()
    ]
    return make_table("HOTA and identity, %", ["", *columns], cells)


def clear_table(rows: Mapping[str, Mapping[str, Any]]) -> Table:
    """The CLEAR metrics, one row a class and overlap."""
    ratios, counts = ("mota", "motp", "recall", "precision"), ("fp", "fn", "idsw", "frag", "mt", "pt", "ml")
    cells = [
        [
            name,
            *(_percent(part["clear"][key]) for key in ratios),
            *(str(part["clear"][key]) for key in counts),
        ]
        for name, part in rows.items()
    ]
    columns = ["MOTA", "MOTP", "recall", "precision", "FP", "FN", "IDSW", "Frag", "MT", "PT", "ML"]
    return make_table("CLEAR at overlap .5: % and counts", ["", *columns], cells)


def sequence_table(by_sequence: Mapping[str, Mapping[str, Any]]) -> Table:
    """The main figures of cars in the image, one row a sequence."""
    cells = [
        [
            name,
            str(part["clear"]["num_labels"]),
            *(_percent(part["hota"][key]) for key in ("hota", "det_a", "ass_a")),
            _percent(part["clear"]["mota"] if part["clear"]["num_labels"] else None),
            _percent(part["identity"]["idf1"]),
            str(part["clear"]["idsw"]),
        ]
        for name, part in by_sequence.items()
    ]
    columns = ["sequence", "labels", "HOTA", "DetA", "AssA", "MOTA", "IDF1", "IDSW"]
    return make_table("KITTI Car, 2D, by sequence, %", columns, cells)


def detection_table(figures: Mapping[str, Any]) -> Table:
    """Average precision and recall of all boxes, whatever identity they have."""
    rows = [
        [
            f"{part['metric'].upper()} IoU {part['min_overlap']:g}",
            str(part["num_labels"]),
            *(_percent(part[key]) for key in ("ap_r40", "recall_at_90", "recall_at_95", "max_recall")),
        ]
        for name, part in figures.items()
        if name != "by_sequence"
    ]
    columns = ["", "labels", "AP R40", "recall at precision .90", "at .95", "of all boxes"]
    return make_table("vehicles as detections, frame by frame, %", columns, rows)


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f}"
