"""Car accuracy on KITTI's object benchmark, as recorded and as the mean over turned and mirrored copies.

Few labelled frames make a noisy figure: one borderline car is some points of average precision, and turning
the input by a few degrees moves it as much. Turned and mirrored copies are as good sweeps as the recorded
one, so a difference between two settings is judged by their mean next to their spread.

    python -m benchmarks.bench_accuracy --copies 6 --set vehicles.max_overlap=0.2 --json accuracy.json
    python -m benchmarks.bench_accuracy --data kitti_object_more

Both sets chose settings, the 20 frames of ``kitti_object`` the thresholds, the 58 of ``kitti_object_more``
the later rules, so neither figure is one of unseen frames. Frames of one drive resemble each other, and eight
drives are in both: the noise of a figure is that over drives drawn again (bootstrap).
"""

import argparse
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import common
from jaxbox import DetectorConfig
from jaxbox.evaluation import Selection, kitti, report
from jaxbox.evaluation.copies import COPIES, Copy, Frame, detect_copy, label_points, labelled_frames
from jaxbox.io import KittiObject, find_drives, open_sweeps, read_drives

METRICS = ("bev", "3d")
RECALLS = (("bev", 0.5), ("bev", 0.7), ("3d", 0.7))
MIN_OVERLAP = {"Car": kitti.MIN_OVERLAP["Car"]}
WELL_SEEN_POINTS = 50
"""Cars with that many points must not have their axes swapped."""


def detect_frames(
    frames: Sequence[Frame], copy: Copy, config: DetectorConfig
) -> tuple[dict[str, list[KittiObject]], list[int]]:
    """KITTI results and status bits of every frame of a copy."""
    found = {frame.name: detect_copy(frame, copy, config) for frame in frames}
    return {name: objects for name, (objects, _) in found.items()}, [int(bits) for _, bits in found.values()]


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


def measure_drives(
    labels: kitti.Objects, results: kitti.Objects, drives: Mapping[str, str]
) -> dict[str, dict[str, float]]:
    """Average precision, its ceiling and SOFT of each drive by itself, of one copy."""
    evaluation = kitti.evaluate(labels, results, min_overlap=MIN_OVERLAP, metrics=METRICS, drives=drives)
    rows = {}
    for drive, curves in evaluation.by_drive.items():
        names = [name for name in labels if drives[name] == drive]
        moderate = [curve for curve in curves if curve.difficulty == "moderate"]
        rows[drive] = {
            "frames": len(names),
            "labels": moderate[0].num_labels,
            **{f"{curve.metric} moderate": curve.r40 for curve in moderate},
            "ceiling": moderate[0].to_dict()["ceiling_r40"],
            "SOFT": kitti.soft_score({n: labels[n] for n in names}, {n: results[n] for n in names}),
        }
    return rows


def mean_rows(tables: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    """The mean over copies of each cell."""
    return {
        drive: {key: float(np.mean([table[drive][key] for table in tables])) for key in row}
        for drive, row in tables[0].items()
    }


def drive_noise(
    labels: kitti.Objects, results: kitti.Objects, drives: Mapping[str, str], *, num_draws: int
) -> dict[str, float]:
    """Standard deviation of 3D and BEV AP moderate and SOFT over drives drawn again with replacement."""
    rng = np.random.default_rng(0)
    members: dict[str, list[str]] = {}
    for name in labels:
        members.setdefault(drives[name], []).append(name)
    rows = []
    for _ in range(num_draws):
        drawn = rng.choice(sorted(members), len(members))
        # A drive that is drawn twice is two drives.
        names = [(name, f"{name}/{i}") for i, drive in enumerate(drawn) for name in members[drive]]
        some = {new: labels[name] for name, new in names}, {new: results[name] for name, new in names}
        evaluation = kitti.evaluate(*some, min_overlap=MIN_OVERLAP, metrics=METRICS)
        row = {f"{c.metric} moderate": c.r40 for c in evaluation.curves if c.difficulty == "moderate"}
        rows.append(row | {"SOFT": kitti.soft_score(*some)})
    return {key: float(np.std([row[key] for row in rows])) for key in rows[0]}


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


def drives_of(options: argparse.Namespace, frames: Sequence[Frame]) -> dict[str, str] | None:
    """The drive of each frame: of the named file, or else of the files in the folders of the data."""
    names = [frame.name for frame in frames]
    if options.drives is not None:
        return read_drives(options.drives, names)
    files = [find_drives(common.data_folder(name)) for name in options.data]
    found = [file for file in files if file is not None]
    return read_drives(found, names) if len(found) == len(files) else None


def main(arguments: Sequence[str] | None = None) -> None:
    parser = common.parser(__doc__ or "")
    parser.add_argument("--copies", type=int, default=len(COPIES), choices=range(1, len(COPIES) + 1))
    parser.add_argument(
        "--data",
        nargs="+",
        default=["kitti_object"],
        metavar="FOLDER",
        help="labelled sets, pooled",
    )
    parser.add_argument(
        "--draws", type=common.at_least(1), default=100, help="draws of the bootstrap over drives"
    )
    parser.add_argument(
        "--drives", type=pathlib.Path, metavar="FILE", help='a table by drive too; one "frame drive" a line'
    )
    options: argparse.Namespace = parser.parse_args(arguments)
    config = common.chosen_config(options)
    sweeps = [sweep for name in options.data for sweep in open_sweeps(common.data_folder(name))]
    frames = labelled_frames(sweeps)
    labels = {frame.name: frame.labels for frame in frames}
    num_points = {frame.name: label_points(frame) for frame in frames}
    drives = drives_of(options, frames)
    by_copy, statuses, by_drive, noise = {}, [], [], {}
    for copy in COPIES[: options.copies]:
        results, bits = detect_frames(frames, copy, config)
        by_copy[copy.name] = measure(labels, results, num_points)
        statuses += bits
        if drives is not None:
            by_drive.append(measure_drives(labels, results, drives))
            noise = noise or drive_noise(labels, results, drives, num_draws=options.draws)
    summary = summarise(by_copy)
    print_report(by_copy, summary)
    found: dict[str, Any] = {"num_frames": len(frames), "copies": by_copy, "summary": summary}
    if noise:
        found |= {"num_drives": len(set((drives or {}).values())), "noise_over_drives": noise}
        print("\nsd over drives drawn again: " + ", ".join(f"{k} {v:.1f}" for k, v in noise.items()))
    if by_drive:
        found["by_drive"] = rows = mean_rows(by_drive)
        print(
            "\nby drive, mean over the copies (with few labels even perfect answers stay below 100: ceiling)"
        )
        columns = list(next(iter(rows.values())))
        common.print_table(["drive", *columns], [[drive, *row.values()] for drive, row in rows.items()])
    print(f"\n{len(frames)} frames; status: {', '.join(common.status_names(statuses)) or 'OK'}")
    common.write_report(found | {"status": common.status_names(statuses)}, options)


if __name__ == "__main__":
    main()
