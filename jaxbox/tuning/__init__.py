"""Choosing settings by labelled frames: what to try, what it scored, and what on held-out drives."""

from jaxbox.tuning.report import make_report, markdown_report, report_sentences, report_tables
from jaxbox.tuning.selection import HeldOut, Trial, best_trial, leave_one_out
from jaxbox.tuning.space import Axis, axis_values, default_axes, latin_hypercube, parse_axis, refine
from jaxbox.tuning.trials import Bench

__all__ = [
    "Axis",
    "Bench",
    "HeldOut",
    "Trial",
    "axis_values",
    "best_trial",
    "default_axes",
    "latin_hypercube",
    "leave_one_out",
    "make_report",
    "markdown_report",
    "parse_axis",
    "refine",
    "report_sentences",
    "report_tables",
]
