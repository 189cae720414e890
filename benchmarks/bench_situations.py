"""What is found of cars in hard situations, and whether the status says where they are missed.

    python -m benchmarks.bench_situations --json benchmarks/results/situations.json
    python -m benchmarks.bench_situations --only "under a ceiling"
    python -m benchmarks.bench_situations --draws 8 --json benchmarks/results/situations_draws.json

Each situation of `jaxbox.synthetic.situations` is one sweep or a few, with exact truth. Vehicles of 30
points or more count. One is *found* where a box from `jaxbox.DEFAULT_SCORE_THRESHOLD` on covers it with a
bird's-eye view IoU of .5 or more, whatever its class; missed *loudly* where the status has a bit, and
*silently* where it has none. *False* boxes cover none.

With ``--draws N`` the sensor stands instead at N places up to half a metre aside in x and in y, drawn by
``--seed``: rules are made while looking at the table, and places that nobody looked at tell what they are
worth.
"""

import collections
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks import common
from jaxbox import DEFAULT_SCORE_THRESHOLD, Detections, PointCloud, detect
from jaxbox.evaluation.iou import pairwise_overlaps
from jaxbox.synthetic import TruthBoxes
from jaxbox.synthetic.situations import SITUATIONS, Situation
from jaxbox.synthetic.sweep import NUM_AZIMUTHS

MIN_OVERLAP = 0.5
MIN_POINTS = 30
"""A vehicle with fewer is hidden, or beyond the reach of the beams."""
ASIDE_M = 0.5
"""How far aside, in x and in y, the sensor is drawn."""
CAPACITY = 131_072
"""Rows of every cloud, so that one compiled function serves all."""
COLUMNS = "vehicles", "found", "loud", "silent", "false"


def count(truth: TruthBoxes, detections: Detections) -> dict[str, int]:
    """The columns of the table, of one sweep."""
    boxes = detections.on_host().above(DEFAULT_SCORE_THRESHOLD)
    overlap, _ = pairwise_overlaps(common.box_rows(truth), common.box_rows(boxes))
    is_match = overlap >= MIN_OVERLAP
    is_found, is_seen = is_match.any(axis=1), truth.num_points >= MIN_POINTS
    missed, is_loud = int((is_seen & ~is_found).sum()), int(detections.status) != 0
    return {
        "vehicles": int(is_seen.sum()),
        "found": int((is_seen & is_found).sum()),
        "loud": missed if is_loud else 0,
        "silent": 0 if is_loud else missed,
        "false": int((~is_match.any(axis=0)).sum()),
    }


def drawn_places(num: int, seed: int) -> list[tuple[float, float]]:
    """Where the sensor stands, x and y in m: where it was, or at places up to `ASIDE_M` aside."""
    places = np.random.default_rng(seed).uniform(-ASIDE_M, ASIDE_M, (num, 2))
    return [(float(x), float(y)) for x, y in places] or [(0.0, 0.0)]


def measure(
    situation: Situation,
    find: Callable[[np.ndarray], Detections],
    *,
    places: Sequence[tuple[float, float]] = ((0.0, 0.0),),
    num_azimuths: int = NUM_AZIMUTHS,
) -> dict[str, Any]:
    """The columns of one situation, seen from all these places, and the status bits of its sweeps."""
    total: collections.Counter[str] = collections.Counter(dict.fromkeys(COLUMNS, 0))
    statuses = []
    for place in places:
        for xyz, truth in situation.seen_from(*place).sweeps(num_azimuths=num_azimuths):
            detections = find(xyz)
            total.update(count(truth, detections))
            statuses.append(int(detections.status))
    row = {"group": situation.group, "situation": situation.name}
    return row | {name: total[name] for name in COLUMNS} | {"status": common.status_names(statuses)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table, and writes the report."""
    groups = list(dict.fromkeys(situation.group for situation in SITUATIONS))
    parser = common.parser(__doc__ or "")
    parser.add_argument("--only", nargs="+", choices=groups, default=groups, help="these groups")
    parser.add_argument(
        "--draws", type=common.at_least(0), default=0, help="of places aside; 0: the table's own"
    )
    parser.add_argument("--seed", type=common.at_least(0), default=0, help="of the draws")
    options = parser.parse_args(arguments)
    config = common.chosen_config(options)

    def find(xyz: np.ndarray) -> Detections:
        return detect(PointCloud.from_numpy(xyz, capacity=CAPACITY), config)

    places = drawn_places(options.draws, options.seed)
    chosen = [situation for situation in SITUATIONS if situation.group in options.only]
    rows = [measure(situation, find, places=places) for situation in chosen]
    cells = [[*list(row.values())[:-1], ", ".join(row["status"])] for row in rows]
    common.print_table(list(rows[0]), cells)
    totals = {name: sum(row[name] for row in rows) for name in COLUMNS}
    print(", ".join(f"{number} {name}" for name, number in totals.items()))
    common.write_report({"rows": rows, "places": places}, options)


if __name__ == "__main__":
    main()
