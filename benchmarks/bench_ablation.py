"""What each component of the default preset is worth: leave one out, over turned and mirrored copies.

    python -m benchmarks.bench_ablation --copies 3 --json benchmarks/results/ablation.json
    python -m benchmarks.bench_ablation --only "no bumpers alone" --only "no filter"

Each row changes a few settings of the preset. Both labelled sets are pooled, and SOFT is of each by itself
too: the 20 frames chose the older rules, the 58 further ones the newer. Every row sees the same copies of the
same frames, so its difference from the full preset is taken copy by copy: the copies' own spread cancels. A
difference within two of its standard errors is not evidence; as all copies come of the same few frames, even
one beyond may be particular to them. Settings that are thresholds share one compiled program.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import bench_accuracy, common
from jaxbox import DEFAULT_SCORE_THRESHOLD, DetectorConfig
from jaxbox.config.fields import replace_fields
from jaxbox.evaluation import Selection, kitti, matching
from jaxbox.evaluation.copies import COPIES, Copy, Frame, label_points, labelled_frames
from jaxbox.io import open_sweeps

FULL = "default preset"
NO_LIMIT = 1e6
"""A width or a gate that no value reaches."""
MORE_POINTS = {"clustering.max_obstacles": 131072, "box.max_slab_points": 65536}
"""Room for rows that take more points for obstacles, or fit to more: theirs is not an error of capacity."""
MORE_DETECTIONS = {"vehicles.max_detections": 512}
"""Room for rows that reject less."""

DATA = {"SOFT of 20": "kitti_object", "SOFT of 58": "kitti_object_more"}
COLUMNS = (
    "SOFT", *DATA, "bev moderate", "3d moderate", "recall bev 0.5", "recall bev 0.7", "recall 3d 0.7",
    "vehicles bev", "vans found", "trucks found", "false a frame",
)  # fmt: skip
"""Of cars but for the last four. These are AP of all vehicles as one class, the share of labels of
`MIN_POINTS` that a box of their class meets, and boxes that meet no vehicle; at a BEV IoU of .5, the last
three of boxes from the default score threshold on."""
MIN_POINTS = 30
MIN_OVERLAP = 0.5


@dataclasses.dataclass(frozen=True)
class Ablation:
    """One component left out or replaced."""

    name: str
    changes: Mapping[str, Any]
    """New values by dotted setting name."""


def _without_maps(*indices: int) -> dict[str, Any]:
    """No point is low enough for these component maps."""
    return {f"clustering.maps.{index}.max_height_m": 0.0 for index in indices}


ABLATIONS = (
    # Points.
    Ablation("read twice, turned", {"vehicles.num_readings": 2}),
    Ablation("no filter", {"filtering.enabled": False}),
    Ablation("one plane instead of the ground grid", {"ground.surface": False, **MORE_POINTS}),
    Ablation("ground grid of grade 0.2", {"ground.max_grade": 0.2}),
    Ablation("ground needs no support", {"ground.min_support_share": 0.0}),
    Ablation("mirror images may be ground", {"ground.min_deep_ratio": 0.0}),
    Ablation("few low cells may be ground", {"ground.min_low_ratio": 0.0}),
    Ablation("pits may be ground", {"ground.min_pit_neighbours": 9.0}),
    Ablation("smooth sheets are no ground", {"ground.sheet_tolerance_m": 0.0}),
    # Proposals.
    Ablation("one map: 0.2 m", _without_maps(1, 2)),
    Ablation("one map: 0.35 m", {"clustering.maps.0.cell_m": 0.35, **_without_maps(1, 2)}),
    Ablation("maps without 0.1 m", _without_maps(1)),
    Ablation("maps without 0.5 m", _without_maps(2)),
    Ablation("cells that do not grow with range", {"clustering.adaptive_growth": 0.0}),
    # Rectangle.
    Ablation("rectangle of points up to 2.0 m", {"box.slab_max_height_m": 2.0, **MORE_POINTS}),
    Ablation("closeness to all four edges", {"box.criterion": "closeness"}),
    Ablation("no scene direction", {"box.direction_weight": 0.0}),
    Ablation("no third rectangle at a second peak", {"box.second_peak_loss": 0.0}),
    Ablation("no fourth rectangle along the principal axis", {"box.min_axis_points": 1e9}),
    Ablation("edges at strays", {"box.min_stray_points": 1e9}),
    Ablation("few points of a slab are fitted to", {"box.min_slab_share": 0.0}),
    Ablation("64 points a rectangle", {"box.max_points": 64}),
    Ablation("256 points a rectangle", {"box.max_points": 256}),
    # Completion.
    Ablation("no hypotheses: longer side extended away, no gate", {"completion.mode": "away"}),
    Ablation("no hypotheses, evidence or scene direction", {
        "completion.mode": "away", "evidence.enabled": False, **MORE_DETECTIONS,
    }),
    Ablation("hypotheses blind to free space", {
        "completion.free_weight": 0.0, "completion.free_length_weight": 0.0,
    }),
    Ablation("no second reading along the scene", {"completion.along_scene": False}),
    Ablation("sides of the class's size, not the likely one", {"completion.seen_weight": 0.0}),
    Ablation("far ends as fitted, not where the last point is", {
        "completion.end_points": NO_LIMIT, "vehicles.hidden_length_score": 1.0,
    }),
    Ablation("boxes turned against the best not blended into it", {"completion.blend_objective": 0.0}),
    Ablation("rows of vehicles side by side as others", {
        "completion.row_distance_m": 0.0, "completion.row_shift_m": 0.0,
    }),
    Ablation("boxes along rows at no cost", {"completion.along_row_cost": 0.0}),
    Ablation("lines of vehicles nose to tail as others", {"vehicles.line_lengths": 0.0}),
    Ablation("slivers in rows and lines are none", {"vehicles.row_extent": 1.0}),
    Ablation("evidence from 2 m on", {"evidence.min_range_m": 2.0}),
    Ablation("far vehicles stand on the ground below them", {"vehicles.far_ground_from_m": NO_LIMIT}),
    Ablation("no lowest box height", {"vehicles.classes.0.min_box_height_m": 0.0}),
    # Score.
    Ablation("no free length, no objective in the score", {
        "vehicles.free_scale": NO_LIMIT, "vehicles.objective_gate": -NO_LIMIT, **MORE_DETECTIONS,
    }),
    Ablation("no free length in the score", {"vehicles.free_scale": NO_LIMIT}),
    Ablation("no objective in the score", {"vehicles.objective_gate": -NO_LIMIT}),
    Ablation("no ring, no overhead penalty", {"vehicles.ring_weight": 0.0, "vehicles.overhead_weight": 0.0}),
    Ablation("no ring penalty", {"vehicles.ring_weight": 0.0}),
    Ablation("no overhead penalty", {"vehicles.overhead_weight": 0.0}),
    Ablation("all points above are overhead, connected or not", {"vehicles.overhead_gap_m": NO_LIMIT}),
    Ablation("hidden lengths count as seen ones", {"vehicles.hidden_length_score": 1.0}),
    Ablation("no bumpers alone", {"vehicles.bumper_from_m": NO_LIMIT}),
    Ablation("tops are as high as seen, cut off, bumpers or not", {"vehicles.unseen_top_score": 0.0}),
    Ablation("trucks: nothing past the ends counts, nothing overhangs", {
        "vehicles.classes.2.past_ends_m": 0.0,
    }),
    Ablation("trucks: judged no shorter than usual", {"vehicles.classes.2.whole_from_m": 8.5}),
    Ablation("vans: nothing past the ends counts, nothing overhangs", {
        "vehicles.classes.1.past_ends_m": 0.0,
    }),
    Ablation("vans: free space below the body counts", {"vehicles.classes.1.open_below": 0.0}),
    Ablation("trucks: free space below the body counts", {"vehicles.classes.2.open_below": 0.0}),
    Ablation("trucks: hits no higher than those of cars", {"evidence.raised_hit_max_height_m": 1.2}),
    Ablation("vans, trucks: boxes that other points fill count in full", {
        "vehicles.classes.1.own_share": 0.0, "vehicles.classes.2.own_share": 0.0,
    }),
    Ablation("trucks: cut off or seen from one side, no beam need pass below", {
        "vehicles.classes.2.min_open": 0.0,
    }),
    Ablation("trucks: 2.4 m high where they are cut off, too", {"vehicles.classes.2.min_cut_height_m": 2.4}),
    Ablation("upright things not told from cars", {"vehicles.upright_score": 1.0}),
    Ablation("vans from 2.0 m on", {"vehicles.classes.1.min_height_m": 2.0}),
    Ablation("far boxes score as near ones", {"vehicles.far_score_power": 0.0}),
    Ablation("what is high and upright as any wall", {"vehicles.tall_upright_score": 0.2}),
    Ablation("no sparseness", {"vehicles.sparseness_power": 0.0}),
    Ablation("height gate that does not widen with range", {"vehicles.top_grade": 0.0}),
    Ablation("cars only, no vans and trucks", {"vehicles.large_height_m": NO_LIMIT}),
)  # fmt: skip


def copy_figures(
    frames: Sequence[Frame],
    num_points: Mapping[str, np.ndarray],
    sets: Mapping[str, str],
    copy: Copy,
    config: DetectorConfig,
) -> tuple[dict[str, float], list[int]]:
    """The figures of one copy of the frames, and its status bits.

    Args:
      frames: of all sets.
      num_points: in each label of each frame.
      sets: the set of each frame.
      copy: how they are turned.
      config: the settings.
    """
    results, bits = bench_accuracy.detect_frames(frames, copy, config)
    labels = {frame.name: frame.labels for frame in frames}
    found = bench_accuracy.figures(bench_accuracy.measure(labels, results, num_points))
    for column, name in DATA.items():
        some = [frame for frame in labels if sets[frame] == name]
        found[column] = kitti.soft_score({n: labels[n] for n in some}, {n: results[n] for n in some})
    found |= vehicle_figures(labels, results, num_points)
    return {column: found[column] for column in COLUMNS}, bits


def share_found(
    selection: Selection, labels: kitti.Objects, results: kitti.Objects, num_points: Mapping[str, np.ndarray]
) -> float:
    """Share of the selected labels that are found; nan where there are none."""
    recall = rates(labels, results, selection, num_points).recall
    return math.nan if recall is None else recall


def vehicle_figures(
    labels: kitti.Objects, results: kitti.Objects, num_points: Mapping[str, np.ndarray]
) -> dict[str, float]:
    """What is found of vans and trucks, and of all vehicles as one class; see `COLUMNS`."""
    merged = kitti.as_vehicles(labels), kitti.as_vehicles(results)
    overlap = {kitti.VEHICLE: kitti.VEHICLE_OVERLAP}
    curves = kitti.evaluate(*merged, min_overlap=overlap, metrics=("bev",)).curves
    every = rates(*merged, Selection(class_name=kitti.VEHICLE), num_points)
    return {
        "vehicles bev": next(curve.r40 for curve in curves if curve.difficulty == "moderate"),
        "vans found": share_found(Selection("Van", MIN_POINTS), labels, results, num_points),
        "trucks found": share_found(Selection("Truck", MIN_POINTS), labels, results, num_points),
        "false a frame": every.num_false / len(labels),
    }


def rates(
    labels: kitti.Objects,
    results: kitti.Objects,
    selection: Selection,
    num_points: Mapping[str, np.ndarray],
) -> matching.Rates:
    """What boxes from the default score threshold on find of some labels."""
    scenes = matching.select(labels, results, selection, num_points=num_points)
    shown = matching.cut(scenes, min_score=DEFAULT_SCORE_THRESHOLD)
    return matching.rates(shown, metric="bev", min_overlap=MIN_OVERLAP)


def compare(
    rows: Mapping[str, Mapping[str, float]], full: Mapping[str, Mapping[str, float]]
) -> dict[str, dict[str, float | None]]:
    """Each figure's mean and spread over the copies, and its difference from the full preset, copy by copy.

    Args:
      rows: the figures of each copy.
      full: those of the full preset, of the same copies.

    Returns:
      Of each figure: mean, sd (over the copies), difference, and its standard error; None for one copy.
    """
    summary = {}
    for column in next(iter(rows.values())):
        values = np.array([rows[copy][column] for copy in full])
        difference = values - np.array([full[copy][column] for copy in full])
        several = len(values) > 1
        summary[column] = {
            "mean": float(values.mean()),
            "sd": float(values.std(ddof=1)) if several else None,
            "difference": float(difference.mean()),
            "difference_error": float(difference.std(ddof=1) / np.sqrt(len(values))) if several else None,
        }
    return summary


def measure(
    frames: Sequence[Frame],
    sets: Mapping[str, str],
    copies: Sequence[Copy],
    ablations: Sequence[Ablation],
    base: DetectorConfig,
) -> dict[str, dict[str, Any]]:
    """Every ablation, and the full preset first, over the copies."""
    num_points = {frame.name: label_points(frame) for frame in frames}
    table: dict[str, dict[str, Any]] = {}
    for ablation in (Ablation(FULL, {}), *ablations):
        config = replace_fields(base, ablation.changes)
        by_copy, statuses = {}, []
        for copy in copies:
            by_copy[copy.name], bits = copy_figures(frames, num_points, sets, copy, config)
            statuses += bits
        table[ablation.name] = row = {
            "changes": dict(ablation.changes),
            "copies": by_copy,
            "status": common.status_names(statuses),
        }
        row["summary"] = compare(by_copy, table[FULL]["copies"])
        print_row(ablation.name, row)
    return table


def print_header() -> None:
    columns = "  ".join(column.rjust(14) for column in COLUMNS)
    print(f"{'left out':50} {columns}  {'SOFT - full':>16}", flush=True)


def print_row(name: str, row: Mapping[str, Any]) -> None:
    """One line as soon as it is known: the whole table takes minutes."""
    cells = [_with_error(row["summary"][column], "mean", "sd") for column in COLUMNS]
    difference = _with_error(row["summary"]["SOFT"], "difference", "difference_error")
    status = f"  {', '.join(row['status'])}" if row["status"] else ""
    line = "  ".join(cell.rjust(14) for cell in cells)
    print(f"{name:50} {line}  {difference:>16}{status}", flush=True)


def _with_error(values: Mapping[str, float | None], mean: str, error: str) -> str:
    spread = values[error]
    return f"{values[mean]:.3g}" if spread is None else f"{values[mean]:.3g} +-{spread:.2g}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = common.parser(__doc__ or "")
    parser.add_argument("--copies", type=int, default=len(COPIES), choices=range(1, len(COPIES) + 1))
    parser.add_argument(
        "--only",
        action="append",
        choices=[ablation.name for ablation in ABLATIONS],
        metavar="NAME",
        help="only this row, next to the full preset; repeat for more",
    )
    options = parser.parse_args(arguments)
    chosen = [ablation for ablation in ABLATIONS if not options.only or ablation.name in options.only]
    base = common.chosen_config(options)
    found = {name: labelled_frames(open_sweeps(common.data_folder(name))) for name in DATA.values()}
    frames = [frame for some in found.values() for frame in some]
    sets = {frame.name: name for name, some in found.items() for frame in some}
    copies = COPIES[: options.copies]
    print(f"Car, R40, mean +-sd over {len(copies)} copies of {len(frames)} frames; recall: moderate;")
    print("difference from the full preset, paired over copies, +-standard error")
    print_header()
    table = measure(frames, sets, copies, chosen, base)
    common.write_report({"num_frames": len(frames), "rows": table}, options)


if __name__ == "__main__":
    main()
