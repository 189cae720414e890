"""Bad input, as one table: what went in, what came out, and whether the laws of every answer held.

    python -m quality.bad_input_table --json quality/results/bad_input.json

The inputs and the laws are those of `quality.bad_input`. `tests/test_bad_input.py` holds them in the
suite, all but those that would compile programs of their own. It ends with exit code 1 where a law is broken.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from typing import Any

import jax

import jaxbox
from benchmarks import common
from jaxbox import DetectorConfig, PointCloud, Status
from jaxbox.config.fields import replace_fields
from jaxbox.types import NUM_POINT_COUNTS
from quality import bad_input


def answer(case: bad_input.Case, preset: str, base: DetectorConfig) -> dict[str, Any]:
    """What one preset made of one input."""
    xyz, cloud = bad_input.pad(case)
    config = replace_fields(base, case.changes)
    found = jax.device_get(jaxbox.detect(cloud, config))
    status = Status(int(found.status))
    broken = bad_input.broken_laws(found, xyz, case.capacity, config)
    if status != case.status[preset]:
        broken.append(f"the status is {case.status[preset]!r}")
    best = float(found.score[0])
    if best > case.best_score:
        broken.append(f"no box scores more than {case.best_score}")
    places = dataclasses.fields(found.counts)[:NUM_POINT_COUNTS]
    return {
        "points": len(xyz),
        "status": common.status_names([int(status)]),
        "boxes": int(found.valid.sum()),
        "boxes_above_cut": int((found.score >= jaxbox.DEFAULT_SCORE_THRESHOLD).sum()),
        "best_score": best,
        "least_support": int(bad_input.box_support(found, xyz, config).min(initial=len(xyz))),
        "counts": {place.name: int(getattr(found.counts, place.name)) for place in places},
        "broken": broken,
    }


def _cells(given: dict[str, Any]) -> list[Any]:
    status, broken = " ".join(given["status"]) or "OK", "; ".join(given["broken"]) or "-"
    return [given["points"], given["boxes"], given["best_score"], status, broken]


def refusals() -> dict[str, str]:
    """The error of each input that is refused; a missing error ends the program."""
    errors = {}
    for name, (arguments, options, _) in bad_input.REFUSED.items():
        try:
            PointCloud.from_numpy(*arguments, **options)
        except ValueError as error:
            errors[name] = str(error)
        else:
            raise SystemExit(f"{name}: was not refused.")
    return errors


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table and writes the report."""
    parser = common.parser(__doc__ or "", preset=False, quick="leave out what compiles programs of its own")
    options: argparse.Namespace = parser.parse_args(arguments)
    bases = {preset: common.chosen_config(options, preset=preset) for preset in bad_input.PRESETS}
    answers: dict[str, dict[str, dict[str, Any]]] = {}
    for group, cases in bad_input.GROUPS.items():
        chosen = [case for case in cases if not (options.quick and case.compiles_anew)]
        answers[group] = {
            case.name: {preset: answer(case, preset, base) for preset, base in bases.items()}
            for case in chosen
        }
    rows = [
        (name, preset, given)
        for group in answers.values()
        for name, both in group.items()
        for preset, given in both.items()
    ]
    common.print_table(
        ["input", "preset", "points", "boxes", "best", "status", "broken"],
        [(name, preset, *_cells(given)) for name, preset, given in rows],
    )
    refused = refusals()
    print()
    common.print_table(["refused", "error"], list(refused.items()))
    common.write_report({"answers": answers, "refused": refused}, options)
    if any(given["broken"] for *_, given in rows):
        sys.exit(1)


if __name__ == "__main__":
    main()
