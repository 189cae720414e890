"""Line and branch coverage of the test suite by part of the package, from coverage's own report.

    coverage run -m pytest && coverage combine && coverage json
    python -m quality.coverage_table coverage.json --json quality/results/coverage.json

A part is a module or folder of `jaxbox`. What a kernel does is covered where it is traced: coverage says that
a line was compiled by some test, not that its numbers were looked at; mutation testing asks that, see
`mutation`.
"""

import argparse
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks import common

COUNTS = {
    "lines": "num_statements",
    "lines missed": "missing_lines",
    "branches": "num_branches",
    "branches missed": "missing_branches",
}
"""Names of the columns, and coverage's own."""


def by_part(files: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Sums over the files of each part, and over all.

    Args:
      files: of coverage's report, by path.

    Returns:
      Counts and percent of each part, the most uncovered first, then "all".
    """
    totals: dict[str, dict[str, float]] = {}
    for path, entry in files.items():
        part = pathlib.PurePath(path).with_suffix("").parts[1]
        for name in (part, "all"):
            row = totals.setdefault(name, dict.fromkeys(COUNTS, 0))
            for column, key in COUNTS.items():
                row[column] += entry["summary"][key]
    for row in totals.values():
        everything = row["lines"] + row["branches"]
        missed = row["lines missed"] + row["branches missed"]
        row["percent"] = 100 * (1 - missed / everything) if everything else 100.0
    whole = totals.pop("all")
    ordered = sorted(totals.items(), key=lambda item: -(item[1]["lines missed"] + item[1]["branches missed"]))
    return dict(ordered) | {"all": whole}


def uncovered(files: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, list[Any]]]:
    """Lines and branches of each file that no test ran."""
    return {
        path: {"lines": entry["missing_lines"], "branches": entry["missing_branches"]}
        for path, entry in sorted(files.items())
        if entry["missing_lines"] or entry["missing_branches"]
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table, and writes the report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("report", type=pathlib.Path, help="what `coverage json` wrote")
    parser.add_argument("--tests", default="the whole suite", help="which tests were run, for the report")
    parser.add_argument("--json", type=pathlib.Path, help="also write the table to this file")
    options = parser.parse_args(arguments)
    files = json.loads(options.report.read_text("utf-8"))["files"]
    parts, missing = by_part(files), uncovered(files)
    columns = list(parts["all"])
    common.print_table(["", *columns], [[name, *(row[c] for c in columns)] for name, row in parts.items()])
    for path, places in missing.items():
        branches = ", ".join(f"{start} to {end}" for start, end in places["branches"])
        print(f"{path}: lines {places['lines']}; branches {branches or 'none'}")
    common.write_report({"tests": options.tests, "parts": parts, "uncovered": missing}, options)


if __name__ == "__main__":
    main()
