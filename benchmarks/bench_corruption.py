"""Where the detector stops working: car accuracy on corrupted copies of KITTI's object sweeps.

    python -m benchmarks.bench_corruption [--only beams fog] [--copies 3] [--json FILE] [--plot PICTURE]
    python -m benchmarks.bench_corruption --redraw FILE --plot PICTURE    # of an earlier report

Each kind of `jaxbox.evaluation.corruptions` at five severities, next to the clean sweeps. A figure is the
mean over turned and mirrored copies, see `bench_accuracy`; each copy is corrupted again, with seeds of its
own. Where the calibration is corrupted the labels stay as they are: the boxes then are where the LiDAR has
them, and what is measured is how far a wrong calibration carries them off in the camera's frame, in which
KITTI's labels are.
"""

import dataclasses
import json
import pathlib
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks import common
from jaxbox import DEFAULT_SCORE_THRESHOLD, DetectorConfig
from jaxbox._padding import fitting_capacity
from jaxbox.evaluation import Selection, kitti, matching
from jaxbox.evaluation.copies import COPIES, Copy, Frame, detect_copy, label_points, labelled_frames
from jaxbox.evaluation.corruptions import CORRUPTIONS, Corruption
from jaxbox.io import open_sweeps
from jaxbox.viz.plots import save_figure

CLEAN = "clean"
NUM_COPIES = 3
METRICS = ("bev", "3d", "image")
MIN_OVERLAP = {"Car": kitti.MIN_OVERLAP["Car"]}
RECALL_OVERLAP = 0.5
WELL_SEEN_POINTS = 100
COLUMNS = (
    "3d", "bev", "image", "SOFT", "recall", "recall at the cut", "well seen", "false a frame", "length",
    "height",
)  # fmt: skip
"""AP at IoU .7 (R40, moderate), SOFT, and at BEV IoU .5 the recall of moderate cars by boxes of any score and
by those from `jaxbox.DEFAULT_SCORE_THRESHOLD` on, by the latter that of all cars with `WELL_SEEN_POINTS` or
more in the clean sweep, how many of the latter a frame match no label, and by how much (m) the boxes found
are on average too long and too high."""
PLOTTED = {"3d": "3D AP", "SOFT": "SOFT", "recall": "recall, BEV .5 (%)"}


def corrupt(frame: Frame, corruption: Corruption, amount: float, rng: np.random.Generator) -> Frame:
    """The frame with its points, or its calibration, corrupted."""
    if corruption.of_points is not None:
        intensity = np.zeros(len(frame.xyz), np.float32) if frame.intensity is None else frame.intensity
        xyz, intensity = corruption.of_points(frame.xyz, intensity, amount, rng)
        return dataclasses.replace(frame, xyz=xyz, intensity=intensity)
    assert corruption.of_calibration is not None, "a corruption is of points or of the calibration"
    T_rect_velo = corruption.of_calibration(np.asarray(frame.calibration.T_rect_velo), amount, rng)
    calibration = dataclasses.replace(frame.calibration, T_rect_velo=jnp.asarray(T_rect_velo))
    return dataclasses.replace(frame, calibration=calibration)


def seeded(*words: object) -> np.random.Generator:
    """A generator of its own for a frame, a copy and a severity, the same in every run."""
    return np.random.default_rng(zlib.crc32(repr(words).encode()))


def measure_copy(
    frames: Sequence[Frame], copy: Copy, config: DetectorConfig, name: str, severity: int
) -> tuple[dict[str, float], int]:
    """The figures of one copy of all frames, and all status bits."""
    labels, results, together, num_points = {}, {}, 0, 0
    for frame in frames:
        capacity, corrupted = fitting_capacity(len(frame.xyz)), frame
        if severity:
            kind = CORRUPTIONS[name]
            rng = seeded(frame.name, copy.name, name, severity)
            corrupted = corrupt(frame, kind, kind.amounts[severity - 1], rng)
        # At the clean sweep's capacity, so that one compiled function serves all.
        results[frame.name], status = detect_copy(corrupted, copy, config, capacity=capacity)
        labels[frame.name] = frame.labels
        together |= int(status)
        num_points += len(corrupted.xyz)
    seen = {frame.name: label_points(frame) for frame in frames}
    return score(labels, results, seen) | {"points": num_points / len(frames)}, together


def score(
    labels: kitti.Objects, results: kitti.Objects, num_points: Mapping[str, np.ndarray]
) -> dict[str, float]:
    """The columns of the table, of labels with so many points each."""
    curves = kitti.evaluate(labels, results, min_overlap=MIN_OVERLAP, metrics=METRICS).curves
    ap = {curve.metric: curve.r40 for curve in curves if curve.difficulty == "moderate"}
    scenes = matching.select(labels, results, Selection(difficulty="moderate"))
    every = matching.rates(scenes, metric="bev", min_overlap=RECALL_OVERLAP)
    cut = matching.cut(scenes, min_score=DEFAULT_SCORE_THRESHOLD)
    kept = matching.rates(cut, metric="bev", min_overlap=RECALL_OVERLAP)
    well_seen = matching.select(
        labels, results, Selection(min_points=WELL_SEEN_POINTS), num_points=num_points
    )
    well_seen = matching.cut(well_seen, min_score=DEFAULT_SCORE_THRESHOLD)
    seen = matching.rates(well_seen, metric="bev", min_overlap=RECALL_OVERLAP)
    found = matching.matched_boxes(scenes, min_overlap=RECALL_OVERLAP)
    # Without a match there is no error to report.
    too_large = np.mean(found.detections - found.labels, axis=0) if len(found.labels) else np.zeros(7)
    return {
        **ap,
        "SOFT": kitti.soft_score(labels, results),
        "recall": every.num_found / every.num_labels,
        "recall at the cut": kept.num_found / kept.num_labels,
        # Without such a label there is none to miss.
        "well seen": seen.num_found / seen.num_labels if seen.num_labels else 1.0,
        "false a frame": kept.num_false / len(labels),
        "length": float(too_large[3]),
        "height": float(too_large[5]),
    }


def measure(
    frames: Sequence[Frame], copies: Sequence[Copy], config: DetectorConfig, name: str, severity: int
) -> dict[str, Any]:
    """Mean and deviation over the copies."""
    rows, bits = [], []
    for copy in copies:
        figures, status = measure_copy(frames, copy, config, name, severity)
        rows.append(figures)
        bits.append(status)
    return {
        "mean": {key: float(np.mean([row[key] for row in rows])) for key in rows[0]},
        "sd": {key: float(np.std([row[key] for row in rows])) for key in rows[0]},
        "status": common.status_names(bits),
    }


def plot(report: Mapping[str, Any], path: pathlib.Path) -> None:
    """One panel a corruption: the figures over severity, the clean ones first."""
    from matplotlib.figure import Figure  # noqa: PLC0415 (an extra: imported where it is used)

    kinds = report["corruptions"]
    columns = 4
    rows = -(-len(kinds) // columns)
    figure = Figure(figsize=(9, 0.5 + 1.9 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    for panel, (name, kind) in zip(panels, kinds.items(), strict=False):
        rungs = [report[CLEAN], *kind["severities"]]
        for key, label in PLOTTED.items():
            scale = 100 if key == "recall" else 1
            mean = [scale * rung["mean"][key] for rung in rungs]
            sd = [scale * rung["sd"][key] for rung in rungs]
            panel.errorbar(range(len(rungs)), mean, yerr=sd, marker="o", markersize=3, capsize=2, label=label)
        panel.set_title(f"{CORRUPTIONS[name].title} ({CORRUPTIONS[name].unit})", fontsize=7)
        ticks = [CLEAN, *(f"{rung['amount']:g}" for rung in kind["severities"])]
        panel.set_xticks(range(len(ticks)), ticks, fontsize=8)
        panel.set_ylim(0, 100)
        panel.grid(alpha=0.3)
    for panel in panels[len(kinds) :]:
        panel.set_visible(False)
    panels[0].legend(fontsize=8, loc="lower left")
    save_figure(path, figure)


def print_report(report: Mapping[str, Any]) -> None:
    rows = [[CLEAN, "", *(report[CLEAN]["mean"][c] for c in COLUMNS), ", ".join(report[CLEAN]["status"])]]
    for name, kind in report["corruptions"].items():
        for rung in kind["severities"]:
            figures = [rung["mean"][c] for c in COLUMNS]
            amount = f"{rung['amount']:g} {CORRUPTIONS[name].unit}"
            rows.append([name, amount, *figures, ", ".join(rung["status"])])
    common.print_table(["", "amount", *COLUMNS, "status"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table, writes the report and the plot."""
    parser = common.parser(__doc__ or "", quick="four frames, one copy, severities 1 and 5 only")
    parser.add_argument("--copies", type=int, default=NUM_COPIES, choices=range(1, len(COPIES) + 1))
    parser.add_argument("--only", nargs="+", choices=sorted(CORRUPTIONS), default=list(CORRUPTIONS))
    parser.add_argument("--plot", type=pathlib.Path, help="also draw the curves (the plots extra)")
    parser.add_argument("--redraw", type=pathlib.Path, help="draw this report's curves, and measure nothing")
    options = parser.parse_args(arguments)
    if options.redraw is not None:
        plot(json.loads(options.redraw.read_text("utf-8")), options.plot)
        return
    config = common.chosen_config(options)
    sweeps = open_sweeps(common.data_folder("kitti_object"))
    frames = labelled_frames(sweeps)
    copies, severities = COPIES[: options.copies], range(1, 6)
    if options.quick:
        frames, copies, severities = frames[::5], COPIES[:1], (1, 5)
    clean = measure(frames, copies, config, CLEAN, 0)
    report: dict[str, Any] = {
        "num_frames": len(frames),
        "num_copies": len(copies),
        CLEAN: clean,
        "corruptions": {},
    }
    for name in options.only:
        kind = CORRUPTIONS[name]
        rungs = [
            {"amount": kind.amounts[s - 1], **measure(frames, copies, config, name, s)} for s in severities
        ]
        report["corruptions"][name] = {"severities": rungs}
        print(f"measured {name}", flush=True)
    print_report(report)
    if options.plot is not None:
        plot(report, options.plot)
    common.write_report(report, options)


if __name__ == "__main__":
    main()
