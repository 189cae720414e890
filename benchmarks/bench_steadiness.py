"""Whether the boxes stay where the sweep hardly changes: a little noise, or its points in another order.

    python -m benchmarks.bench_steadiness --json benchmarks/results/steadiness.json
    python -m benchmarks.bench_steadiness --parts boxes --lost    # names each box that does not stay

All labelled KITTI sweeps, and tracks over the sweeps of KITTI's tracking benchmark, each next to changed
copies of itself. No label is used: a box of the sweep as recorded stays where the changed sweep has a box of
the same class at or above the default score threshold, and their IoU in the bird's-eye view is .7 or more.
"""

import itertools
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

import jaxbox
from benchmarks import common
from jaxbox import DEFAULT_SCORE_THRESHOLD, Detections, DetectorConfig, Tracks
from jaxbox.evaluation.iou import pairwise_overlaps
from jaxbox.io import Sweep, find_poses, group_sequences, open_sweeps

PARTS = ("boxes", "tracks")
FRAMES = ("kitti_object", "kitti_object_more")
FROM_SCORES = (DEFAULT_SCORE_THRESHOLD, 0.3, 0.5)
"""Boxes are asked for from each of these scores on."""
MIN_OVERLAP = 0.7
FOUND_OVERLAP = 0.5
"""A box is still found, if not in its place, where one of any class overlaps it so much."""


def add_noise(xyz: np.ndarray, std_m: float, rng: np.random.Generator) -> np.ndarray:
    """Every coordinate with Gaussian noise of its own."""
    return (xyz + rng.normal(0, std_m, xyz.shape)).astype(np.float32)


CHANGES: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "1 mm": lambda xyz, rng: add_noise(xyz, 0.001, rng),
    "1 cm": lambda xyz, rng: add_noise(xyz, 0.01, rng),
    "order": lambda xyz, rng: rng.permutation(xyz),
}
"""What is done to the points of a sweep, (n, 3) m."""


def seeded(*words: object) -> np.random.Generator:
    """A generator of its own for a sweep, a change and a draw, the same in every run."""
    return np.random.default_rng(zlib.crc32(repr(words).encode()))


def changed(sweep: Sweep, change: str, draw: int) -> np.ndarray:
    """The points of a sweep after a change; as recorded for the change ""."""
    xyz = sweep.read_points()[0]
    return CHANGES[change](xyz, seeded(sweep.name, change, draw)) if change else xyz


def rows_of(found: Detections | Tracks) -> np.ndarray:
    """(n, 9) centre, size, yaw, score and class of the boxes at or above the threshold."""
    found = found.above(DEFAULT_SCORE_THRESHOLD)
    return np.column_stack([common.box_rows(found), found.score, found.label])


def judge(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which boxes stay, and which are found at all, (n,) bool each."""
    if not len(before) or not len(after):
        return np.zeros(len(before), bool), np.zeros(len(before), bool)
    overlap = pairwise_overlaps(before[:, :7], after[:, :7])[0]
    same = before[:, None, 8] == after[None, :, 8]
    stay, found = (overlap >= MIN_OVERLAP) & same, overlap >= FOUND_OVERLAP
    return np.any(stay, axis=1), np.any(found, axis=1)


class Tally:
    """Counts of boxes that stay, over sweeps and draws."""

    def __init__(self) -> None:
        self.counts = {score: np.zeros(3, int) for score in FROM_SCORES}

    def add(self, before: np.ndarray, stay: np.ndarray, found: np.ndarray) -> None:
        """The boxes of one sweep."""
        for score, count in self.counts.items():
            high = before[:, 7] >= score
            count += [high.sum(), (high & stay).sum(), (high & found).sum()]

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """By the score from which boxes are asked for: how many, and the shares."""
        return {
            f"{score:g}": {
                "boxes": int(boxes),
                "stay": stay / max(boxes, 1),
                "found": found / max(boxes, 1),
            }
            for score, (boxes, stay, found) in self.counts.items()
        }


def measure_boxes(
    config: DetectorConfig, sweeps: Sequence[Sweep], draws: range, show: bool
) -> dict[str, Any]:
    """The shares of the boxes of single sweeps, by change."""
    tallies = {change: Tally() for change in CHANGES}
    for sweep in sweeps:
        before = rows_of(common.detect(changed(sweep, "", 0), None, config))
        for change, tally in tallies.items():
            for draw in draws:
                after = rows_of(common.detect(changed(sweep, change, draw), None, config))
                stay, found = judge(before, after)
                tally.add(before, stay, found)
                for row in before[~stay & (before[:, 7] >= FROM_SCORES[1])] if show else ():
                    print(sweep.name, change, draw, np.round(row, 2).tolist(), flush=True)
    return {change: tally.to_dict() for change, tally in tallies.items()}


def measure_tracks(config: DetectorConfig, draws: range, limit: int | None) -> dict[str, Any]:
    """The shares of the boxes of each sweep's tracks, by change."""
    root = common.data_folder("kitti_tracking") / "training"
    tallies = {change: Tally() for change in CHANGES}
    for _, sweeps in group_sequences(open_sweeps(root)):
        chosen = sweeps[:limit]
        before = list(track_boxes(chosen, config, "", 0))
        for change, draw in itertools.product(CHANGES, draws):
            for rows, after in zip(before, track_boxes(chosen, config, change, draw), strict=True):
                tallies[change].add(rows, *judge(rows, after))
    return {change: tally.to_dict() for change, tally in tallies.items()}


def track_boxes(
    sweeps: Sequence[Sweep], config: DetectorConfig, change: str, draw: int
) -> Iterator[np.ndarray]:
    """The rows of each sweep's tracks."""
    clouds = (changed(sweep, change, draw) for sweep in sweeps)
    for tracked in jaxbox.track(clouds, config, poses=find_poses(sweeps)):
        if tracked.tracks is None:
            raise SystemExit(f"{tracked.name}: {tracked.error}")
        yield rows_of(tracked.tracks)


def print_report(report: Mapping[str, Any]) -> None:
    rows = [
        [part, change, score, shares["boxes"], 100 * shares["stay"], 100 * shares["found"]]
        for part in PARTS
        for change, by_score in report.get(part, {}).items()
        for score, shares in by_score.items()
    ]
    common.print_table(["", "change", "from score", "boxes", "% stay", "% found"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table, and writes the report."""
    parser = common.parser(__doc__ or "", quick="four sweeps and one draw, eight sweeps a sequence")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument(
        "--draws", type=common.at_least(1), default=20, help="changed copies of a sweep and a change"
    )
    parser.add_argument(
        "--first-draw", type=common.at_least(0), default=0, help="other noise than that of the record"
    )
    parser.add_argument("--lost", action="store_true", help="print boxes from score .3 on that do not stay")
    options = parser.parse_args(arguments)
    config = common.chosen_config(options)
    sweeps = [sweep for name in FRAMES for sweep in open_sweeps(common.data_folder(name))]
    num_draws, limit = (1, 8) if options.quick else (options.draws, None)
    draws = range(options.first_draw, options.first_draw + num_draws)
    sweeps = sweeps[:: len(sweeps) // 4] if options.quick else sweeps
    report: dict[str, Any] = {"num_sweeps": len(sweeps), "num_draws": num_draws}
    if "boxes" in options.parts:
        report["boxes"] = measure_boxes(config, sweeps, draws, options.lost)
    if "tracks" in options.parts:
        report["tracks"] = measure_tracks(config, draws, limit)
    print_report(report)
    common.write_report(report, options)


if __name__ == "__main__":
    main()
