"""``jaxbox eval --protocol``: detects in the frames of a protocol, evaluates them, and writes a table."""

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Any

from rich.console import Console

from jaxbox import io
from jaxbox._version import __version__
from jaxbox.cli.console import ExitCode
from jaxbox.cli.detect import DetectOptions, run_detect
from jaxbox.cli.evaluate import METRIC_NAMES, group_curves, print_report
from jaxbox.cli.results import ResultFormat
from jaxbox.config import DetectorConfig
from jaxbox.evaluation import evaluate_folders, kitti
from jaxbox.evaluation.protocols import Protocol, protocol_frames
from jaxbox.io import InputError, atomic_writer


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProtocolOptions:
    """What ``jaxbox eval --protocol`` is asked for."""

    protocol: Protocol
    """Whose frames."""
    config: DetectorConfig
    """The detector's settings."""
    jobs: int
    """Processes that detect."""


def run_eval_protocol(
    labels: pathlib.Path, results: pathlib.Path, options: ProtocolOptions, console: Console
) -> ExitCode:
    """Detects in the protocol's frames that have no results yet, evaluates all, prints and writes the table.

    Args:
      labels: KITTI folder.
      results: folder for the result files and the table; what an earlier run left there is gone on from.
      options: of the command.
      console: where the tables go.

    Returns:
      What `run_detect` ended with; the table is written only where that is success.

    Raises:
      InputError: where the folder has none of the frames, or results of other settings are there.
    """
    listed = protocol_frames(options.protocol)
    labelled = {sweep.name for sweep in io.open_sweeps(labels) if sweep.labels_path is not None}
    frames = labelled.intersection(listed)
    if not frames:
        raise InputError(
            f"{labels}: none of the {len(listed):,} frames of {options.protocol} is there with labels; the "
            f"first is velodyne/{listed[0]}.bin with label_2/{listed[0]}.txt. Give KITTI's object folder."
        )
    ended = run_detect([str(labels)], _detect_options(results, options), frames=frames)
    if ended is not ExitCode.OK:
        return ended
    report = evaluate_folders(labels, results, frames=frames)
    print_report(report, console)
    table = markdown_table(report, options.protocol, num_listed=len(listed))
    path = results / f"{options.protocol}.md"
    with atomic_writer(path) as handle:
        handle.write(table)
    for line in table.splitlines():
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    console.print(f"wrote {path}", markup=False)
    return ended


def _detect_options(results: pathlib.Path, options: ProtocolOptions) -> DetectOptions:
    return DetectOptions(
        output=results,
        config=options.config,
        jobs=options.jobs,
        resume=True,
        formats=frozenset({ResultFormat.KITTI}),
        points=False,
        pictures=False,
    )


def markdown_table(report: Mapping[str, Any], protocol: Protocol, *, num_listed: int) -> str:
    """The average precision of cars and of all vehicles, as a table to paste.

    Args:
      report: of `jaxbox.evaluation.evaluate_folders`.
      protocol: whose frames.
      num_listed: how many it lists.

    Returns:
      Markdown.
    """
    num = report["num_frames"]
    frames = f"all {num:,} frames" if num == num_listed else f"only {num:,} of {num_listed:,} frames"
    cars = (curve for curve in report["kitti"]["curves"] if curve["class"] == "Car")
    grouped = group_curves([*cars, *report["vehicles"]])
    difficulties = list(next(iter(grouped.values())))
    lines = [
        f"jaxbox {__version__}, {protocol}, {frames}: AP over 40 recalls",
        "",
        f"| class, metric, IoU | {' | '.join(difficulties)} |",
        "|---" + "|---:" * len(difficulties) + "|",
    ]
    for (name, metric), levels in grouped.items():
        overlap = kitti.MIN_OVERLAP.get(name, kitti.VEHICLE_OVERLAP)
        values = " | ".join(f"{curve['r40']:.2f}" for curve in levels.values())
        lines.append(f"| {name}, {METRIC_NAMES[metric]}, {overlap:g} | {values} |")
    return "\n".join(lines) + "\n"
