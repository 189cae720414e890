"""What a search found, as one dictionary for JSON, as tables and as sentences."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxbox.evaluation.objectives import Matched
from jaxbox.tuning.selection import NOISE, HeldOut, Trial, best_trial, leave_one_out
from jaxbox.tuning.space import Axis, axis_values
from jaxbox.tuning.trials import Bench

SHOWN_TRIALS = 10
"""Of the trials, the best that the table shows; the others are in the files."""

Table = tuple[str, Sequence[str], Sequence[Sequence[str]]]
"""Title, columns, rows."""


def make_report(bench: Bench, axes: Sequence[Axis], trials: Sequence[Trial[Matched]]) -> dict[str, Any]:
    """Everything about a search; the command adds how it was run.

    Args:
      bench: what the settings were tried on.
      axes: the space.
      trials: at least the base.

    Returns:
      Numbers, strings, lists, dicts and None only.
    """
    values = axis_values(bench.base, axes)
    held_out = leave_one_out(trials, bench.groups, bench.objective.score)
    ceiling, group_ceilings = bench.ceilings()
    return {
        "objective": bench.objective.title,
        "num_frames": len(bench.frames),
        "num_groups": len(set(bench.groups.values())),
        "group_kind": bench.group_kind,
        "ceiling": ceiling,
        "capacity": bench.capacity,
        "copies": [copy.name for copy in bench.copies],
        "space": [
            {"name": a.name, "low": a.low, "high": a.high, "log": a.log, "base": values[a.name]} for a in axes
        ],
        "seconds_per_trial": float(np.median([trial.seconds for trial in trials])),
        "base": _trial_row(trials[0]),
        "best": _trial_row(best_trial(trials)),
        "held_out": None if held_out is None else _held_out_row(held_out, bench.groups, group_ceilings),
        "trials": [_trial_row(trial) for trial in trials],
    }


def _trial_row(trial: Trial[Matched]) -> dict[str, Any]:
    return {
        "trial": trial.index,
        "changes": dict(trial.changes),
        "blind": trial.blind,
        "scores": list(trial.scores),
        "mean": trial.mean,
        "sd": _spread(trial.scores),
        "status": [bit.name for bit in type(trial.status) if bit and bit in trial.status],
        "seconds": trial.seconds,
    }


def _held_out_row(
    held_out: HeldOut, groups: Mapping[str, str], ceilings: Mapping[str, float]
) -> dict[str, Any]:
    return {
        "scores": list(held_out.scores),
        "mean": float(np.mean(held_out.scores)),
        "sd": _spread(held_out.scores),
        "gain": held_out.gain,
        "gain_spread": held_out.spread,
        "gain_spread_over_groups": held_out.group_spread,
        "noise": held_out.noise,
        "keep_base": held_out.keep_base,
        "times_chosen": {str(index): times for index, times in held_out.times_chosen.items()},
        "groups": [
            {
                "group": group,
                "num_frames": sum(other == group for other in groups.values()),
                "chosen": held_out.chosen[group],
                "base": base,
                "held_out": score,
                "ceiling": ceilings[group],
            }
            for group, (base, score) in held_out.group_scores.items()
        ],
    }


def _spread(scores: Sequence[float]) -> float | None:
    return float(np.std(scores, ddof=1)) if len(scores) > 1 else None


def report_sentences(report: Mapping[str, Any]) -> list[str]:
    """What to conclude: the held-out figure first, the advice last.

    Args:
      report: from `make_report`.

    Returns:
      A few sentences.
    """
    base, best, held_out, kind = report["base"], report["best"], report["held_out"], report["group_kind"]
    lines = [
        f"Objective: {report['objective']}, mean over the copies ({', '.join(report['copies'])}) of "
        f"{_counted(report['num_frames'], 'frame')} of {_counted(report['num_groups'], kind)}; perfect "
        f"answers reach {report['ceiling']:.2f}.",
        f"Best in sample {_mean(best)}, trial {best['trial']}: flattered, as it was chosen on the frames "
        "that it is scored on.",
    ]
    if held_out is None:
        base_line = f"Base {_mean(base)}; with one {kind} nothing can be held out."
        return [base_line, *lines, "Keep the base: the gain is unproven."]
    lines.insert(0, _headline(base, held_out, kind))
    if best["trial"] == 0:
        return [*lines, "Keep the base: no setting that was tried is better."]
    if held_out["keep_base"]:
        return [
            *lines,
            f"Keep the base: the held-out gain does not exceed the noise, {held_out['noise']:.2f}.",
        ]
    chosen = f"Take trial {best['trial']}: the held-out gain exceeds the noise, {held_out['noise']:.2f}."
    if not best["blind"]:
        chosen += " It was refined by all labels; what refining added is not in the held-out gain."
    return [*lines, chosen]


def _headline(base: Mapping[str, Any], held_out: Mapping[str, Any], kind: str) -> str:
    return (
        f"Leave one {kind} out: {_mean(held_out)}, each {kind} with the setting that the others chose; the "
        f"base {_mean(base)}, a gain of {held_out['gain']:+.2f} (spread over the copies "
        f"{_number(held_out['gain_spread'])}, over {kind}s drawn again "
        f"{_number(held_out['gain_spread_over_groups'])}; at least {NOISE:g} is noise)."
    )


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


def report_tables(report: Mapping[str, Any]) -> list[Table]:
    """The figures: by copy, the settings, the best trials, and the held-out groups.

    Args:
      report: from `make_report`.

    Returns:
      Title, columns and rows of each table.
    """
    tables = [_copies_table(report), _config_table(report), _trials_table(report)]
    return tables if report["held_out"] is None else [*tables, _groups_table(report)]


def _copies_table(report: Mapping[str, Any]) -> Table:
    named = [("held out", report["held_out"]), ("base", report["base"]), ("best in sample", report["best"])]
    rows = [
        [name, *(f"{score:.2f}" for score in row["scores"]), f"{row['mean']:.2f}", _number(row["sd"])]
        for name, row in named
        if row is not None
    ]
    return "objective by copy", ["", *report["copies"], "mean", "sd"], rows


def _config_table(report: Mapping[str, Any]) -> Table:
    best = report["best"]["changes"]
    rows = [
        [
            axis["name"],
            f"{axis['low']:.4g} to {axis['high']:.4g}{', log' * axis['log']}",
            f"{axis['base']:.4g}",
            f"{best.get(axis['name'], axis['base']):.4g}",
        ]
        for axis in report["space"]
    ]
    return f"settings of trial {report['best']['trial']}", ["setting", "tried", "base", "best"], rows


def _trials_table(report: Mapping[str, Any]) -> Table:
    ranked = sorted(report["trials"], key=lambda row: (-row["mean"], row["trial"]))
    chosen = {} if report["held_out"] is None else report["held_out"]["times_chosen"]
    shown = ranked[:SHOWN_TRIALS]
    shown += [row for row in ranked[SHOWN_TRIALS:] if row["trial"] == 0 or str(row["trial"]) in chosen]
    rows = [
        [
            f"{row['trial']}{_kind(row)}",
            f"{row['mean']:.2f}",
            _number(row["sd"]),
            f"{row['mean'] - report['base']['mean']:+.2f}",
            str(chosen.get(str(row["trial"]), 0)),
            ", ".join(row["status"]) or "OK",
        ]
        for row in shown
    ]
    title = f"the best of {len(ranked)} trials, the base, and all that were chosen"
    return title, ["trial", "mean", "sd", "over base", "times chosen", "status"], rows


def _kind(row: Mapping[str, Any]) -> str:
    if row["trial"] == 0:
        return " (base)"
    return "" if row["blind"] else " (refined)"


def _groups_table(report: Mapping[str, Any]) -> Table:
    rows = [
        [
            row["group"],
            str(row["num_frames"]),
            str(row["chosen"]),
            f"{row['base']:.2f}",
            f"{row['held_out']:.2f}",
            f"{row['held_out'] - row['base']:+.2f}",
            f"{row['ceiling']:.2f}",
        ]
        for row in report["held_out"]["groups"]
    ]
    kind = report["group_kind"]
    title = f"each {kind} by itself, held out; the ceiling is what perfect answers reach"
    return title, [kind, "frames", "trial chosen without it", "base", "held out", "gain", "ceiling"], rows


def markdown_report(report: Mapping[str, Any], *, title: str, notes: Sequence[str]) -> str:
    """The sentences and tables as a Markdown page.

    Args:
      report: from `make_report`.
      title: its heading.
      notes: sentences on how it was run, after the conclusions.

    Returns:
      The page.
    """
    parts = [f"# {title}", *report_sentences(report)]
    for name, columns, rows in report_tables(report):
        lines = [columns, ["---", *["---:"] * (len(columns) - 1)], *rows]
        parts += [f"## {name[0].upper()}{name[1:]}", "\n".join(f"| {' | '.join(line)} |" for line in lines)]
    return "\n\n".join([*parts, "## How it was run", *notes]) + "\n"


def _mean(row: Mapping[str, Any]) -> str:
    return f"{row['mean']:.2f}"


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f}"
