"""What time gives: boxes of single sweeps, of the tracker, and of its second pass, side by side.

Real drives of KITTI's tracking benchmark (Car and Van, in the bird's-eye view and 3D, where camera 2 sees
them; and HOTA of cars in the image by KITTI's protocol), ray-cast drives with exact truth, and the
association alone, on boxes that a trained detector found in ten sequences (2D, Car, KITTI's protocol), whose
one threshold is chosen on the nine others.

    python -m benchmarks.bench_tracking --json tracking.json
    python -m benchmarks.bench_tracking --parts real

Chosen on these drives too, the real ones among them, are the share of a side that counts as seen (.8), the
correlation of profiles (.15), the score of what is not seen (``unseen_sd_m``), what the track's box counts
next to the sweep's (.5), the doubt in few detections (.5) and in those that jump (1.2 m), the second pass's
memory of heights (.2 s) and belief in few detections (4), and that it shows the track's own box of what
moves. The settings for the trained detector's boxes were chosen on all ten sequences; only the threshold
leaves one out.
"""

import argparse
import collections
import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

import jaxbox
from benchmarks import common
from benchmarks.tracking_room import count_predictions, count_seen_through
from jaxbox import Calibration, DetectorConfig, Label, Motion
from jaxbox.evaluation.tracking import (
    Comparison,
    FrameBoxes,
    FrameTruth,
    TruthSequence,
    compare_in_image,
    evaluate_boxes,
    measure_tracks,
)
from jaxbox.io import (
    KittiObject,
    boxes_from_objects,
    find_poses,
    group_sequences,
    objects_by_frame,
    objects_from_tracks,
    open_sweeps,
    read_calibration,
    read_track_detections,
    read_tracks,
)
from jaxbox.io.sweeps import sweep_of
from jaxbox.run.tracking import RATE_HZ, TrackedSweep, smooth_tracks
from jaxbox.synthetic import make_sequence
from jaxbox.synthetic.traffic import TrafficKind
from jaxbox.tracking import Observations, Sight, TrackConfig, TrackerState, Tracks, smooth, track_sequence
from jaxbox.tracking.poses import ego_motions

PARTS = ("real", "synthetic", "boxes")
MIN_SCORE = jaxbox.DEFAULT_SCORE_THRESHOLD
"""Tracks of a lower score are left out of HOTA, identity and the errors; average precision takes all."""
TYPES, IGNORED = ("Car", "Van"), ("Truck", "Misc", "Tram")
SYNTHETIC: tuple[tuple[TrafficKind, int], ...] = (
    ("street", 0),
    ("street", 1),
    ("highway", 0),
    ("highway", 1),
)
MIN_TRUE_POINTS, MAX_TRUE_RANGE_M = 15, 50.0
"""A synthetic vehicle with fewer points, or farther away, is neither found nor missed."""
THRESHOLDS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5)
"""Thresholds of the tracks' score that are chosen from, for boxes of the trained detector, in its units."""
TRAINED = TrackConfig(birth_score=0.3, high_score=0.5, low_score=0.1, max_misses=15)
"""Scores of the trained detector, through the logistic function, are those of another scale. Nothing says
what is hidden, so that every missed vehicle may be: 10 to 20 misses are equally good."""
POINTS_AT_1M, MAX_POINTS = 1e5, 500.0
"""Points of a car fall with the square of its range; how many it has is not in those files."""
CAPACITY, MAX_TRACKS, PADDED_TO = 64, 96, 200
"""Boxes a sweep and tracks at a time of those sequences; lengths are padded to multiples of the last."""


def boxes_of(tracks: Tracks, chosen: Any) -> FrameBoxes:
    """Chosen tracks of a sweep, as the evaluator takes them."""
    return FrameBoxes(
        boxes=np.column_stack([tracks.center, tracks.size, tracks.heading])[chosen].astype(float),
        scores=np.asarray(tracks.score, float)[chosen],
        ids=np.asarray(tracks.id, int)[chosen],
        velocities=np.asarray(tracks.velocity, float)[chosen],
        states=np.asarray(tracks.motion, int)[chosen],
    )


def all_boxes(tracked: Sequence[TrackedSweep]) -> list[FrameBoxes]:
    """All tracks of each sweep, those that it did not see too."""
    return [boxes_of(sweep.tracks, sweep.tracks.valid) for sweep in checked(tracked)]


def checked(tracked: Iterable[TrackedSweep]) -> Iterable[Any]:
    """The sweeps; a benchmark's all have to be read."""
    for sweep in tracked:
        if sweep.error is not None:
            raise SystemExit(f"{sweep.name}: {sweep.error}")
        yield sweep


def row(truth: Mapping[str, TruthSequence], results: Mapping[str, list[FrameBoxes]]) -> dict[str, Any]:
    """The figures of one kind of result."""
    found = evaluate_boxes(truth, results, min_score=MIN_SCORE)
    bev, volume = found["detection"]["bev_0.5"], found["detection"]["3d_0.7"]
    figures = {
        "BEV AP": bev["ap_r40"],
        "BEV R90": bev["recall_at_90"],
        "BEV recall": bev["max_recall"],
        "3D AP": volume["ap_r40"],
        "3D R90": volume["recall_at_90"],
    }
    tracks = found["tracks"]["bev"] if found["tracks"] else None
    if tracks is not None:
        figures |= {
            "HOTA": tracks["hota"]["hota"],
            "IDF1": tracks["identity"]["idf1"],
            "switches": tracks["clear"]["idsw"],
        }
    return {"figures": figures, "motion": found["motion"]}


def side_by_side(
    name: str, truth: TruthSequence, tracked: Sequence[TrackedSweep], smoothed: Sequence[TrackedSweep]
) -> dict[str, dict[str, Any]]:
    """Single sweeps, online and offline."""
    kinds = {
        "single sweep": [FrameBoxes.of_detections(sweep.detections) for sweep in checked(tracked)],
        "online": all_boxes(tracked),
        "offline": all_boxes(smoothed),
    }
    rows: dict[str, Any] = {kind: row({name: truth}, {name: boxes}) for kind, boxes in kinds.items()}
    predictions = count_predictions(truth.frames, tracked)
    return rows | {"room": predictions | count_seen_through(truth.frames, tracked, smoothed)}


def measure_real(config: DetectorConfig, poses: str | None) -> dict[str, Any]:
    """Every sequence of the tracking benchmark that there are sweeps of."""
    root = common.data_folder("kitti_tracking") / "training"
    found = {}
    for name, sweeps in group_sequences(open_sweeps(root)):
        given = find_poses(sweeps) if poses is None else poses
        tracked = list(jaxbox.track(sweeps, config, poses=given))
        calibration = read_calibration(root / "calib" / f"{name}.txt")
        labels = objects_by_frame(read_tracks(root / "label_02" / f"{name}.txt"))
        frames = [
            FrameTruth.of_objects(labels.get(sweep.frame or 0, []), calibration, types=TYPES, ignored=IGNORED)
            for sweep in sweeps
        ]
        truth = TruthSequence(frames, calibration)
        smoothed = smooth_tracks(tracked)
        poses_of = {"poses": str(tracked[0].pose_source)}
        found[name] = side_by_side(name, truth, tracked, smoothed) | poses_of
        of_sweeps = [labels.get(sweep.frame or 0, []) for sweep in sweeps]
        for kind, sweeps_of_kind in (("online", tracked), ("offline", smoothed)):
            tracks = [of_sweep.tracks for of_sweep in checked(sweeps_of_kind)]
            found[name][kind]["figures"]["HOTA Car 2D"] = hota_in_image(of_sweeps, tracks, calibration)
    return found


def hota_in_image(
    labels: Sequence[Sequence[KittiObject]], tracks: Sequence[Tracks], calibration: Calibration
) -> float | None:
    """KITTI's official figure of a drive; None where no car of it counts."""
    found = [shown_in_image(of_sweep, MIN_SCORE, calibration, frame) for frame, of_sweep in enumerate(tracks)]
    measured = measure_tracks({"": compare_in_image(labels, found, class_name="Car")})
    return measured["hota"]["hota"] if measured["clear"]["num_labels"] else None


def shown_in_image(
    tracks: Tracks, min_score: float, calibration: Calibration, frame: int, *, car: bool = False
) -> list[KittiObject]:
    """The tracks of a sweep from a score on, as results of a frame; all as cars, if wanted."""
    shown = tracks.valid & tracks.confirmed & (tracks.score >= min_score)
    boxes = boxes_of(tracks, shown)
    labels = [Label.CAR if car else Label(label) for label in np.asarray(tracks.label)[shown].tolist()]
    return objects_from_tracks(
        boxes.boxes,
        boxes.scores,
        np.asarray(boxes.ids),
        calibration,
        frame=frame,
        types=[label.word.capitalize() for label in labels],
    )


def measure_synthetic(config: DetectorConfig, num_sweeps: int) -> dict[str, Any]:
    """Ray-cast drives, with exact velocities and states."""
    found = {}
    for kind, seed in SYNTHETIC:
        sequence = make_sequence(seed, kind=kind, num_sweeps=num_sweeps)
        name = f"{kind} {seed}"
        poses = np.array([sweep.T_world_sensor for sweep in sequence])
        sweeps = list(sequence)
        tracked = list(jaxbox.track(sweeps, config, poses=poses))
        frames = [true_frame(sweep) for sweep in sweeps]
        found[name] = side_by_side(name, TruthSequence(frames), tracked, smooth_tracks(tracked))
    return found


def true_frame(sweep: Any) -> FrameTruth:
    """The exact truth of a ray-cast sweep."""
    truth = sweep.truth
    near = np.linalg.norm(truth.center[:, :2], axis=1) <= MAX_TRUE_RANGE_M
    return FrameTruth(
        boxes=np.column_stack([truth.center, truth.size, truth.yaw]),
        ids=truth.ids,
        counts=near & (sweep.num_points >= MIN_TRUE_POINTS),
        dont_care_px=np.zeros((0, 4)),
        velocities=truth.velocity,
        states=truth.motion,
    )


class TrainedSequence:
    """A sequence of the trained detector's boxes: labels, poses and detections."""

    def __init__(self, name: str) -> None:
        root = common.data_folder("kitti_tracking_boxes") / "training"
        self.calibration = read_calibration(root / "calib" / f"{name}.txt")
        labels = objects_by_frame(read_tracks(root / "label_02" / f"{name}.txt"))
        found = objects_by_frame(read_track_detections(root / "det_pointrcnn_Car" / f"{name}.txt"))
        num = len((root / "oxts" / f"{name}.txt").read_text().splitlines())
        # The sweeps themselves are not there, but their names say which poses are theirs.
        sweeps = [sweep_of(root / "velodyne" / name / f"{frame:06d}.bin") for frame in range(num)]
        poses = find_poses(sweeps)
        if poses is None:
            raise SystemExit(f"{root / 'oxts'}: no poses of sequence {name}.")
        self.poses = poses
        self.labels = [labels.get(frame, []) for frame in range(num)]
        self.seen = [padded(found.get(frame, []), self.calibration) for frame in range(num)]
        self.scores = [np.array([item.score for item in found.get(frame, [])]) for frame in range(num)]

    def track(self) -> list[Tracks]:
        """The tracks of each frame, of the compiled tracker in one call."""
        num = len(self.seen)
        room = -num % PADDED_TO
        seen = jax.tree.map(lambda *rows: np.stack(rows), *self.seen, *[self.seen[-1]] * room)
        motions = np.concatenate(
            [ego_motions(self.poses), np.tile(np.eye(4, dtype=np.float32), (room, 1, 1))]
        )
        dt = np.full(num + room, 1 / RATE_HZ, np.float32)
        _, tracks = _track(TrackerState.empty(MAX_TRACKS), seen, dt, motions, TRAINED)
        tracks = jax.tree.map(np.asarray, tracks)
        return [jax.tree.map(lambda a, f=f: a[f], tracks) for f in range(num)]

    def compare(self, tracks: Sequence[Tracks], min_score: float) -> Comparison:
        """Tracks from a score on against the labels, in the image."""
        found = [
            shown_in_image(of_sweep, min_score, self.calibration, frame, car=True)
            for frame, of_sweep in enumerate(tracks)
        ]
        return compare_in_image(self.labels, found, class_name="Car")


_track = jax.jit(track_sequence)


def as_wholes(tracks: Sequence[Tracks], scores: Sequence[np.ndarray], *, ahead: bool) -> list[Tracks]:
    """Each track with its own box, which errors of single detections are averaged in, and one score.

    Args:
      tracks: of each sweep.
      scores: of the detections of each sweep.
      ahead: whether the score is the mean of all its detections, or of those so far.

    Returns:
      The tracks.
    """
    sums: dict[int, np.ndarray] = collections.defaultdict(lambda: np.zeros(2))
    means: list[dict[int, float]] = []
    for of_sweep, of_detections in zip(tracks, scores, strict=True):
        for track, row in zip(of_sweep.id.tolist(), of_sweep.detection.tolist(), strict=True):
            if row >= 0:
                sums[track] += of_detections[row], 1
        means.append({track: total / num for track, (total, num) in sums.items()})
    return [
        dataclasses.replace(
            of_sweep,
            score=np.array([mean.get(track, -np.inf) for track in of_sweep.id.tolist()]),
            center=of_sweep.filtered_center,
            size=of_sweep.filtered_size,
            heading=of_sweep.filtered_yaw,
        )
        for of_sweep, mean in zip(tracks, [means[-1]] * len(means) if ahead else means, strict=True)
    ]


def padded(objects: Sequence[Any], calibration: Any) -> Observations:
    """Boxes of one frame, padded; of their points nothing but the usual number is known."""
    center, size, yaw = boxes_from_objects(objects, calibration, keep_heading=True)
    num, room = len(objects), CAPACITY - len(objects)
    score = 1 / (1 + np.exp(-np.array([item.score for item in objects])))
    range_m = np.maximum(np.linalg.norm(center[:, :2], axis=1), 1.0)

    def pad(values: np.ndarray, *more: int) -> np.ndarray:
        rows = np.asarray(values, np.float32).reshape(num, *more)
        return np.concatenate([rows, np.zeros((room, *more), np.float32)])

    fields: dict[str, Any] = {
        "center": pad(center, 3),
        "size": pad(size, 3),
        "yaw": pad(yaw),
        "score": pad(score),
        "label": np.zeros(CAPACITY, np.int32),
        "num_points": pad(np.clip(POINTS_AT_1M / range_m**2, 1, MAX_POINTS)).astype(np.int32),
        "extent": np.zeros((CAPACITY, 2), np.float32),
        "front_log_odds": np.zeros(CAPACITY, np.float32),
        "valid": np.arange(CAPACITY) < num,
        "first_return_m": np.full(8, 1e3, np.float32),
    }
    return Observations(**fields)


def measure_boxes() -> dict[str, Any]:
    """HOTA of the ten sequences, online and offline, each with the threshold that the nine others chose."""
    root = common.data_folder("kitti_tracking_boxes") / "training"
    sequences = {path.stem: TrainedSequence(path.stem) for path in sorted((root / "label_02").glob("*.txt"))}
    online, offline = {}, {}
    for name, sequence in sequences.items():
        tracks = sequence.track()
        time_s = np.arange(len(tracks)) / RATE_HZ
        smoothed = smooth(tracks, sequence.seen, sequence.poses.T_world_sensor, time_s, TRAINED)
        online[name] = as_wholes([seen_only(of_sweep) for of_sweep in tracks], sequence.scores, ahead=False)
        offline[name] = as_wholes(smoothed, sequence.scores, ahead=True)
    return {
        kind: chosen_by_others(sequences, found) for kind, found in (("online", online), ("offline", offline))
    }


def seen_only(tracks: Tracks) -> Tracks:
    """The tracks that this sweep saw."""
    return dataclasses.replace(tracks, valid=tracks.valid & (tracks.sight == Sight.SEEN))


def chosen_by_others(
    sequences: Mapping[str, TrainedSequence], tracks: Mapping[str, Sequence[Tracks]]
) -> dict[str, Any]:
    """Each sequence with the threshold that is best for all others together."""
    compared = {
        threshold: {name: item.compare(tracks[name], threshold) for name, item in sequences.items()}
        for threshold in THRESHOLDS
    }

    def hota(threshold: float, left_out: str) -> float:
        others = {name: found for name, found in compared[threshold].items() if name != left_out}
        return measure_tracks(others)["hota"]["hota"]

    chosen = {name: max(THRESHOLDS, key=lambda t, n=name: hota(t, n)) for name in sequences}
    measured = measure_tracks({name: compared[threshold][name] for name, threshold in chosen.items()})
    return {"thresholds": chosen, "figures": measured}


def print_rows(found: Mapping[str, Any]) -> None:
    """The table of drives."""
    for name, kinds in found.items():
        rows = {kind: item["figures"] for kind, item in kinds.items() if "figures" in item}
        columns = list(rows["online"])
        print()
        common.print_table([name, *columns], [[k, *(r.get(c) for c in columns)] for k, r in rows.items()])
        for kind in ("online", "offline"):
            print_motion(kind, kinds[kind]["motion"])
        print(", ".join(f"{name} {count}" for name, count in kinds["room"].items()))


def print_motion(kind: str, motion: Mapping[str, Any]) -> None:
    """Errors of velocity and heading, and the table of states, where the truth has them."""
    headings = motion["headings"]
    parts = [f"headings within 90 deg {_text(headings['within_90_deg'])}"]
    for name in ("velocity_moving", "velocity_standing"):
        item = motion.get(name)
        if item and item["median"] is not None:
            parts.append(f"{name} median {_text(item['median'])} p90 {_text(item['p90'])} m/s")
    print(f"{kind}: " + ", ".join(parts))
    confusion = (motion.get("states") or {}).get("confusion", [])
    if np.any(confusion):
        names = [state.word for state in Motion]
        common.print_table(["truth, found", *names], [[n, *r] for n, r in zip(names, confusion, strict=True)])


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def print_boxes(found: Mapping[str, Any]) -> None:
    """The table of the trained detector's boxes."""
    rows = []
    for kind, item in found.items():
        hota, clear = item["figures"]["hota"], item["figures"]["clear"]
        values = [hota["hota"], hota["det_a"], hota["ass_a"], clear["mota"]]
        rows.append([kind, *(100 * value for value in values), clear["idsw"], clear["frag"]])
    print()
    common.print_table(["ten sequences, Car 2D", "HOTA", "DetA", "AssA", "MOTA", "switches", "frag"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = common.parser(__doc__ or "")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--poses", choices=["kiss-icp", "boxes", "none"], help="of the real drives, not oxts")
    parser.add_argument("--sweeps", type=common.at_least(2), default=100, help="of each ray-cast drive")
    options: argparse.Namespace = parser.parse_args(arguments)
    config = common.chosen_config(options)
    found: dict[str, Any] = {}
    if "real" in options.parts:
        found["real"] = measure_real(config, options.poses)
        print_rows(found["real"])
    if "synthetic" in options.parts:
        found["synthetic"] = measure_synthetic(config, options.sweeps)
        print_rows(found["synthetic"])
    if "boxes" in options.parts:
        found["boxes"] = measure_boxes()
        print_boxes(found["boxes"])
    common.write_report(found, options)


if __name__ == "__main__":
    main()
