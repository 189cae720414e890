"""The benchmark of tracking: figures by hand, thresholds by leaving one out, padding, and its tables."""

import dataclasses
import importlib
import json
import pathlib
import types

import numpy as np
import pytest
from test_docs import hook

from jaxbox import Label, Motion
from jaxbox.evaluation.tracking import Comparison, FrameBoxes, FrameTruth, TruthSequence
from jaxbox.io import objects_from_tracks
from jaxbox.synthetic import make_sequence
from jaxbox.synthetic.camera import make_calibration
from jaxbox.tracking import Sight, Tracks

NUM_FRAMES, NUM_CARS = 10, 3
SPEED_MPS = 5.0


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(pathlib.Path(__file__).parents[1]))
    return importlib.import_module("benchmarks.bench_tracking")


def cars(frame):
    """(K, 7) three cars side by side, half a metre on in each frame."""
    boxes = np.tile([30.0, 0.0, -1.0, 4.2, 1.8, 1.5, 0.0], (NUM_CARS, 1))
    boxes[:, 0] += 0.5 * frame
    boxes[:, 1] = 6.0 * np.arange(NUM_CARS)
    return boxes


def truth():
    velocities = np.tile([SPEED_MPS, 0.0], (NUM_CARS, 1))
    states = np.full(NUM_CARS, Motion.MOVING)
    every, nowhere = np.ones(NUM_CARS, bool), np.zeros((0, 4))
    return TruthSequence(
        [
            FrameTruth(cars(k), np.arange(NUM_CARS), every, nowhere, velocities=velocities, states=states)
            for k in range(NUM_FRAMES)
        ]
    )


def found(*, tracked=True, score=0.9, error_mps=0.0, swapped_from=NUM_FRAMES):
    """The boxes of the truth, with ids that two cars swap from some frame on."""
    frames = []
    for k in range(NUM_FRAMES):
        ids = np.array([1, 0, 2]) if k >= swapped_from else np.arange(NUM_CARS)
        more = {
            "ids": ids,
            "velocities": np.tile([SPEED_MPS + error_mps, 0.0], (NUM_CARS, 1)),
            "states": np.full(NUM_CARS, Motion.STANDING),
        }
        frames.append(FrameBoxes(cars(k), np.full(NUM_CARS, score), **(more if tracked else {})))
    return frames


def test_the_figures_of_boxes_that_are_right(bench):
    row = bench.row({"a": truth()}, {"a": found(error_mps=0.25)})
    assert all(row["figures"][name] == pytest.approx(1.0) for name in ("BEV AP", "3D AP", "HOTA", "IDF1"))
    assert row["figures"]["switches"] == 0
    assert row["motion"]["velocity_moving"]["median"] == pytest.approx(0.25)
    assert row["motion"]["states"]["confusion"][Motion.MOVING][Motion.STANDING] == NUM_FRAMES * NUM_CARS
    swapped = bench.row({"a": truth()}, {"a": found(swapped_from=NUM_FRAMES // 2)})["figures"]
    assert swapped["switches"] == 2
    assert swapped["IDF1"] == pytest.approx(2 / 3)
    assert swapped["BEV AP"] == pytest.approx(1.0)


def test_boxes_of_single_sweeps_have_no_figures_of_identity(bench):
    figures = bench.row({"a": truth()}, {"a": found(tracked=False)})["figures"]
    assert figures["BEV AP"] == pytest.approx(1.0)
    assert "HOTA" not in figures


def test_scores_below_the_cut_count_for_average_precision_alone(bench):
    figures = bench.row({"a": truth()}, {"a": found(score=bench.MIN_SCORE / 2)})["figures"]
    assert figures["BEV AP"] == pytest.approx(1.0)
    assert figures["HOTA"] == 0


class Stub:
    """A sequence in which only results of one threshold follow their vehicles."""

    def __init__(self, best):
        self.best = best

    def compare(self, tracks, min_score):
        assert tracks == f"tracks of {self.best}"
        overlap = np.ones((1, 1)) * (1.0 if min_score == self.best else 0.0)
        one = np.zeros(1, int)
        return Comparison.of([one] * 4, [one] * 4, [overlap] * 4)


def test_a_sequence_has_the_threshold_that_the_others_chose(bench):
    low, high = bench.THRESHOLDS[0], bench.THRESHOLDS[-1]
    best = {"a": low, "b": low, "c": high}
    sequences = {name: Stub(value) for name, value in best.items()}
    chosen = bench.chosen_by_others(sequences, {name: f"tracks of {value}" for name, value in best.items()})
    # For c both others are best at the low one; a and b have one of each, and the first of equals counts.
    assert chosen["thresholds"] == {"a": low, "b": low, "c": low}
    by_sequence = chosen["figures"]["by_sequence"]
    assert [by_sequence[name]["hota"]["hota"] for name in best] == [1.0, 1.0, 0.0]


def tracks_of(ids, detections):
    """Tracks of one sweep, with what a score of wholes reads and changes."""
    num = len(ids)
    fields = {field.name: np.zeros(num) for field in dataclasses.fields(Tracks)}
    fields |= {"id": np.array(ids, int), "detection": np.array(detections, int)}
    return Tracks(**(fields | {"filtered_yaw": np.full(num, 0.5), "filtered_size": np.ones((num, 3))}))


def test_a_whole_track_has_one_score_and_its_own_box(bench):
    tracks = [tracks_of([4, 7], [1, 0]), tracks_of([7, 4], [0, -1]), tracks_of([4, 9], [0, -1])]
    scores = [np.array([5.0, 1.0]), np.array([3.0]), np.array([4.0])]
    so_far = bench.as_wholes(tracks, scores, ahead=False)
    assert [of_sweep.score.tolist() for of_sweep in so_far] == [[1.0, 5.0], [4.0, 1.0], [2.5, -np.inf]]
    of_all = bench.as_wholes(tracks, scores, ahead=True)
    assert [of_sweep.score.tolist() for of_sweep in of_all] == [[2.5, 4.0], [4.0, 2.5], [2.5, -np.inf]]
    for of_sweep in so_far:
        assert (of_sweep.heading == 0.5).all()
        assert (of_sweep.size == 1).all()


def test_padded_boxes_are_those_of_the_file_and_nothing_else_is_valid(bench):
    calibration = make_calibration()
    boxes = cars(0)
    scores, ids = np.array([0.0, 3.0, -3.0]), np.arange(NUM_CARS)
    objects = objects_from_tracks(boxes, scores, ids, calibration, frame=0, types=["Car"] * NUM_CARS)
    assert len(objects) == NUM_CARS
    seen = bench.padded(objects, calibration)
    assert seen.valid.sum() == NUM_CARS
    assert {len(field) for name, field in vars(seen).items() if name != "first_return_m"} == {bench.CAPACITY}
    np.testing.assert_allclose(seen.center[:NUM_CARS], boxes[:, :3], atol=0.02)
    np.testing.assert_allclose(seen.size[:NUM_CARS], boxes[:, 3:6], atol=0.01)
    np.testing.assert_allclose(seen.score[:NUM_CARS], 1 / (1 + np.exp(-scores)), rtol=1e-5)
    range_sq = np.sum(boxes[:, :2] ** 2, axis=1)
    np.testing.assert_allclose(seen.num_points[:NUM_CARS] * range_sq, bench.POINTS_AT_1M, rtol=0.02)
    assert not seen.center[NUM_CARS:].any()
    assert (seen.label == Label.CAR).all()
    assert not bench.padded([], calibration).valid.any()


def test_the_exact_truth_counts_what_is_near_and_has_points(bench):
    sweep = make_sequence(0, num_sweeps=1, num_beams=16, num_azimuths=180)[0]
    frame = bench.true_frame(sweep)
    near = np.linalg.norm(sweep.truth.center[:, :2], axis=1) <= bench.MAX_TRUE_RANGE_M
    np.testing.assert_array_equal(frame.counts, near & (sweep.num_points >= bench.MIN_TRUE_POINTS))
    assert 0 < frame.counts.sum() < len(frame.counts)
    np.testing.assert_array_equal(frame.boxes[:, :3], sweep.truth.center)
    np.testing.assert_array_equal(frame.velocities, sweep.truth.velocity)


def test_the_page_shows_the_parts_that_were_recorded(bench, tmp_path, monkeypatch, capsys):
    figures = hook("figures")
    rows = {
        "single sweep": bench.row({"a": truth()}, {"a": found(tracked=False)}),
        "online": bench.row({"a": truth()}, {"a": found(error_mps=0.25)}),
        "offline": bench.row({"a": truth()}, {"a": found()}),
        "room": {"vehicles": 30, "detected": 28, "only predicted": 1},
    }
    drives = {"0000": rows | {"poses": "oxts"}}
    at = {"commit": "0123456789", "processor": "one", "cpus": 1, "packages": {"jax": "1"}}
    parts = {"real": drives, "synthetic": {"street 0": rows}}
    for names in ([], ["real"], ["synthetic"], ["real", "synthetic"]):
        file = tmp_path / "tracking.json"
        file.write_text(json.dumps({"circumstances": at, **{name: parts[name] for name in names}}))
        monkeypatch.setitem(figures.RESULTS, "tracking", file)
        page = figures.tracking()
        assert ("| 0000 | online | 1.000" in page) == ("real" in names)
        assert ("| street 0 | offline | 1.000" in page) == ("synthetic" in names)
        assert (f"| moving | {NUM_FRAMES * NUM_CARS} | 0 |" in page) == ("synthetic" in names)
        assert ("| 0000 | 30 | 28 | 1 |" in page) == ("real" in names)
        assert "trained detector" not in page
        assert "01234567" in page
    monkeypatch.delitem(figures.RESULTS, "tracking")
    assert figures.tracking() == "*Not recorded yet.*"
    bench.print_rows(drives)
    printed = capsys.readouterr().out
    assert "velocity_moving median 0.250" in printed
    assert "vehicles 30, detected 28, only predicted 1" in printed


def sweep_of(sight, error=None):
    """A tracked sweep of two cars."""
    fields = dict.fromkeys(field.name for field in dataclasses.fields(Tracks))
    of_cars = {"center": cars(0)[:2, :3], "size": cars(0)[:2, 3:6], "velocity": np.zeros((2, 2))}
    of_cars |= {name: np.zeros(2) for name in ("heading", "score", "motion")}
    tracks = Tracks(**fields | of_cars | {"id": np.array([4, 9]), "valid": np.ones(2, bool), "sight": sight})
    return types.SimpleNamespace(name="000007", tracks=tracks, error=error)


def test_tracks_that_a_sweep_did_not_see_count_too(bench):
    sweeps = [
        sweep_of(np.array([Sight.SEEN, Sight.HIDDEN])),
        sweep_of(np.array([Sight.COASTING, Sight.SEEN])),
    ]
    assert [boxes.ids.tolist() for boxes in bench.all_boxes(sweeps)] == [[4, 9], [4, 9]]
    with pytest.raises(SystemExit, match="000007: cut off"):
        bench.all_boxes([sweep_of(np.zeros(2), error="cut off")])


@pytest.fixture
def room(bench):
    return importlib.import_module("benchmarks.tracking_room")


@pytest.mark.parametrize("azimuth", [0.0, 2.0, np.pi, -2.5])
@pytest.mark.parametrize(("range_m", "share"), [(10.0, None), (20.0, 0.0), (30.0, 1.0)])
def test_a_wall_behind_a_box_is_seen_through_it_and_one_before_hides_it(room, azimuth, range_m, share):
    box = np.array([20 * np.cos(azimuth), 20 * np.sin(azimuth), 0.0, 4.0, 1.8, 1.5, azimuth + 0.4])
    assert room.share_through(box, np.full(720, range_m)) == share


def test_a_wall_behind_half_of_a_box_is_seen_through_by_half_of_the_beams(room):
    box = np.array([20.0, 0.0, 0.0, 1.8, 4.0, 1.5, 0.0])
    first = np.full(1440, 20.0)
    first[720:] = 50.0
    assert room.share_through(box, first) == pytest.approx(0.5, abs=0.03)


def tracked_cars(seen, detected):
    """One sweep with the cars of `truth`, some of them with a track that sees them, and some detected."""
    boxes = cars(0)
    fields = {"center": boxes[:, :3], "size": boxes[:, 3:6]}
    tracks = types.SimpleNamespace(
        valid=np.ones(NUM_CARS, bool),
        sight=np.where(seen, Sight.SEEN, Sight.COASTING),
        filtered_center=boxes[:, :3],
        filtered_size=boxes[:, 3:6],
        filtered_yaw=boxes[:, 6],
    )
    detections = types.SimpleNamespace(**fields, yaw=boxes[:, 6], valid=np.array(detected))
    return types.SimpleNamespace(tracks=tracks, detections=detections)


def test_a_prediction_counts_where_nothing_was_detected(room):
    sweep = tracked_cars(seen=np.array([True, False, False]), detected=[True, True, False])
    counts = room.count_predictions(truth().frames[:1], [sweep])
    assert counts == {"vehicles": 3, "detected": 2, "only predicted": 1}
