"""Accuracy against time: every preset on the same sweeps, in one run.

    python -m benchmarks.bench_frontier [--copies 6] [--json FILE] [--plot PICTURE]

The presets take turns on each sweep, so that the machine's swings meet them alike. Time is of a whole sweep
on the device; accuracy is the mean over turned and mirrored copies, see `bench_accuracy`.
"""

import functools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

import jaxbox
from benchmarks import bench_accuracy, common
from jaxbox import DetectorConfig, PointCloud
from jaxbox.evaluation.copies import COPIES, Frame, label_points, labelled_frames
from jaxbox.io import Sweep, open_sweeps
from jaxbox.viz.plots import save_figure

PASSES = 5
"""Times that each preset runs on each sweep."""

COLUMNS = ("median ms", "p90 ms", "bev moderate", "3d moderate", "SOFT", "SOFT sd")


def time_presets(sweeps: Sequence[Sweep], presets: Mapping[str, DetectorConfig]) -> dict[str, list[float]]:
    """Milliseconds of every call of each preset."""
    clouds = [jax.device_put(PointCloud.from_numpy(*sweep.read_points())) for sweep in sweeps]
    for config in presets.values():
        jax.block_until_ready(jaxbox.detect(clouds[0], config))
    spent: dict[str, list[float]] = {name: [] for name in presets}
    for _ in range(PASSES):
        for cloud in clouds:
            for name, config in presets.items():
                call = functools.partial(jaxbox.detect, cloud, config)
                spent[name].append(common.milliseconds(call)[0])
    return spent


def measure_accuracy(
    frames: Sequence[Frame], num_points: Mapping[str, np.ndarray], config: DetectorConfig, num_copies: int
) -> dict[str, float]:
    """Mean figures over the copies."""
    labels = {frame.name: frame.labels for frame in frames}
    rows = []
    for copy in COPIES[:num_copies]:
        results, _ = bench_accuracy.detect_frames(frames, copy, config)
        rows.append(bench_accuracy.figures(bench_accuracy.measure(labels, results, num_points)))
    means = {name: float(np.mean([row[name] for row in rows])) for name in COLUMNS[2:5]}
    return means | {"SOFT sd": float(np.std([row["SOFT"] for row in rows]))}


def plot(table: Mapping[str, Mapping[str, float]], path: pathlib.Path) -> None:
    """A point a preset."""
    from matplotlib.figure import Figure  # noqa: PLC0415 (an extra: imported where it is used)

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for name, row in table.items():
        axes.errorbar(row["median ms"], row["SOFT"], yerr=row["SOFT sd"], fmt="o", capsize=3, label=name)
    axes.set(xlabel="median time of a sweep (ms)", ylabel="SOFT", ylim=(0, 100))
    axes.set_xlim(left=0)
    # Names beside the points would lie on each other, and over the edge.
    axes.legend(loc="lower right")
    axes.grid(alpha=0.3)
    save_figure(path, figure)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table, writes the report and the plot."""
    parser = common.parser(__doc__ or "", preset=False)
    parser.add_argument("--copies", type=int, default=len(COPIES), choices=range(1, len(COPIES) + 1))
    parser.add_argument("--plot", type=pathlib.Path, help="also draw the frontier (the plots extra)")
    options = parser.parse_args(arguments)
    presets = {name: common.chosen_config(options, preset=name) for name in DetectorConfig.presets()}
    sweeps = open_sweeps(common.data_folder("kitti_object"))
    frames = labelled_frames(sweeps)
    num_points = {frame.name: label_points(frame) for frame in frames}
    spent = time_presets(sweeps, presets)
    table: dict[str, dict[str, Any]] = {}
    for name, config in presets.items():
        median, p90 = np.percentile(spent[name], [50, 90])
        times = {"median ms": float(median), "p90 ms": float(p90)}
        table[name] = times | measure_accuracy(frames, num_points, config, options.copies)
    common.print_table(
        ["preset", *COLUMNS], [[name, *(row[c] for c in COLUMNS)] for name, row in table.items()]
    )
    if options.plot is not None:
        plot(table, options.plot)
    common.write_report({"presets": table, "num_sweeps": len(sweeps)}, options)


if __name__ == "__main__":
    main()
