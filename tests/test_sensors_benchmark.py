"""The benchmark on sweeps labelled all round: what counts as right, found, and worth acting on."""

import importlib
import pathlib
import types

import numpy as np
import pytest

from jaxbox import Status
from jaxbox.io.labelled import labelled_boxes

CAR_SIZE = (4.0, 1.8, 1.5)


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(pathlib.Path(__file__).parents[1]))
    return importlib.import_module("benchmarks.bench_sensors")


def detections(xy, scores, owner=()):
    """The answer for a sweep, with one row of padding: boxes of a car's size along x."""
    valid = np.arange(len(xy) + 1) < len(xy)
    center = np.zeros((len(valid), 3))
    center[: len(xy), :2] = np.reshape(xy, (-1, 2))
    return types.SimpleNamespace(
        valid=valid,
        score=np.array([*scores, 0.0]),
        label=np.zeros(len(valid), np.int32),
        center=center,
        size=np.tile(CAR_SIZE, (len(valid), 1)),
        yaw=np.zeros(len(valid)),
        ground=types.SimpleNamespace(coefficients=np.array([0.0, 0.0, -1.7])),
        status=int(Status.OK),
        point_detection=np.array(owner, int),
    )


def labelled_sweep(bench, xy, points_each=50):
    """A sweep with cars at these places, each with that many points."""
    center = np.column_stack([xy, np.zeros(len(xy))])
    boxes = labelled_boxes(["Car"] * len(xy), center, np.tile(CAR_SIZE, (len(xy), 1)), np.zeros(len(xy)))
    xyz = np.repeat(center, points_each, axis=0).astype(np.float32)
    every = np.ones(len(xy), bool)
    return bench.LabelledSweep("a", xyz, np.zeros(len(xyz), np.float32), boxes, every, every)


def test_a_detection_is_right_where_it_stands_on_a_vehicle_and_false_elsewhere(bench):
    sweep = labelled_sweep(bench, [(10.0, 0.0), (20.0, 5.0)])
    # Half a length off is an overlap of a third; 1.4 of 1.8 m to the side, an eighth.
    measured = bench.measure(sweep, detections([(12, 0), (20, 6.4), (0, 30)], [0.9, 0.8, 0.7]))
    assert measured["right"] == [True, False, False]
    assert measured["best_overlap"] == pytest.approx([1 / 3, 0.4 / 3.2, 0], abs=1e-4)


def test_a_label_is_wanted_once_near_by_and_with_enough_points(bench):
    near = labelled_sweep(bench, [(10.0, 0.0), (10.0, 0.0), (20.0, 0.0), (50.0, 0.0)])
    assert bench.measure(near, detections([], []))["labels"]["cars"]["wanted"] == 2
    sparse = labelled_sweep(bench, [(10.0, 0.0)], points_each=bench.MIN_POINTS - 1)
    assert bench.measure(sparse, detections([], []))["labels"]["cars"]["wanted"] == 0


def test_a_label_counts_as_found_up_to_the_score_of_its_detection(bench):
    sweep = labelled_sweep(bench, [(10.0, 0.0), (20.0, 0.0)])
    found = bench.measure(sweep, detections([(10, 0), (20, 0.2)], [0.9, 0.2]))["labels"]["cars"]["found"]
    assert found == [(cut <= 0.9) + (cut <= 0.2) for cut in bench.SCORE_CUTS]


def classed_sweep(bench, class_id, instance_id):
    xyz = np.tile(np.float32([10, 0, 0]), (len(class_id), 1))
    return bench.ClassedSweep("b", xyz, xyz[:, 0], np.array(class_id), np.array(instance_id))


def test_points_without_a_label_judge_no_detection(bench):
    # 6 of 10 points of the first have no class; of the second, 4 have none, and 3 each are car and building.
    class_id = np.repeat([0, 50, 0, 10, 50], [6, 4, 4, 3, 3])
    sweep = classed_sweep(bench, class_id, np.zeros(20, int))
    owner = np.repeat([0, 1], 10)
    measured = bench.measure_points(sweep, detections([(10, 0), (11, 0)], [0.6, 0.5], owner))
    assert measured["unjudged_scores"] == [0.6]
    assert (measured["score"], measured["best_overlap"], measured["right"]) == ([0.5], [0.3], [False])


def test_a_car_of_points_is_found_where_one_detection_holds_half_of_them(bench):
    size = 2 * bench.MIN_POINTS
    sweep = classed_sweep(bench, np.full(3 * size, 10), np.repeat([1, 2, 3], size))
    owner = np.full(3 * size, -1)
    owner[: size // 2] = 0
    owner[size : size + size // 2 - 1] = 1
    labels = bench.measure_points(sweep, detections([(10, 0), (20, 0)], [0.3, 0.9], owner))["labels"]["cars"]
    assert labels == {"wanted": 3, "found": [int(cut <= 0.3) for cut in bench.SCORE_CUTS]}


def test_right_and_false_detections_of_a_cut_are_all_of_them(bench):
    rng = np.random.default_rng(0)
    cars = {"wanted": 0, "found": [0] * len(bench.SCORE_CUTS)}
    sweeps = [
        {"score": rng.random(40), "right": rng.random(40) < 0.6, "labels": {"cars": cars}} for _ in range(3)
    ]
    rows = bench.cut_rows(sweeps, {"": lambda sweep: sweep["right"]})
    for row in rows:
        kept = [(s["score"] >= row["min_score"]).sum() for s in sweeps]
        assert row["detections_per_sweep"] == pytest.approx(sum(kept) / 3)
        assert row["precision"] * row["detections_per_sweep"] + row["false_per_sweep"] == pytest.approx(
            row["detections_per_sweep"]
        )
        assert row["recall_cars"] is None


def test_right_boxes_are_counted_under_what_they_are_called_from_the_library_cut_on(bench):
    sweeps = [
        {"score": [0.9, 0.2, 0.14], "label": [0, 2, 2], "right": [True, False, True]},
        {"score": [0.15, 0.3], "label": [2, 0], "right": [True, False]},
        {"score": [], "label": [], "right": []},
    ]
    assert bench.right_by_class(sweeps) == {
        "car": {"boxes": 2, "right": 1},
        "van": {"boxes": 0, "right": 0},
        "truck": {"boxes": 2, "right": 1},
    }


def test_the_chosen_cut_is_the_smallest_that_is_precise_enough(bench):
    rows = [
        {"min_score": cut, "precision": p} for cut, p in ((0.1, 0.5), (0.2, 0.9), (0.3, 1.0), (0.4, None))
    ]
    assert bench.choose_cut(rows) == 0.2
    assert bench.choose_cut(rows[:1]) is None
    assert bench.choose_cut(rows[3:]) is None
