"""The paper's table: a rule that sees no result chooses the vehicle; a constant stands next to its errors."""

import importlib
import pathlib
import types

import numpy as np
import pytest
from kitti_objects import car

from jaxbox import Label

TRUE_BOX = np.array([10.0, 2.0, -0.9, 4.0, 1.6, 1.5, 0.3])


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(pathlib.Path(__file__).parents[1]))
    return importlib.import_module("benchmarks.bench_paper_table")


def track(bench, points, *, occluded=(), numbers=None, name="0000"):
    """Sightings of one car with these points; hidden in some frames."""
    numbers = range(len(points)) if numbers is None else numbers
    return [
        bench.Sighting(
            types.SimpleNamespace(name=f"{name}_{number:06d}"),
            car(frame=number, track_id=0, occlusion=int(number in occluded)),
            TRUE_BOX,
            num_points,
        )
        for number, num_points in zip(numbers, points, strict=True)
    ]


def test_the_window_with_most_points_is_chosen_among_those_where_nothing_hides_the_vehicle(bench):
    tracks = {"a": track(bench, [10, 20, 30, 40, 50, 60, 900], occluded=(6,)), "b": track(bench, [30] * 6)}
    name, window = bench.choose_vehicle(tracks)
    assert (name, [sighting.num_points for sighting in window]) == ("a", [20, 30, 40, 50, 60])


def test_a_window_has_no_gap(bench):
    assert len(bench.windows(track(bench, [1] * 7))) == 3
    assert not bench.windows(track(bench, [1] * 6, numbers=[0, 1, 2, 4, 5, 6]))
    with pytest.raises(SystemExit, match="5 consecutive"):
        bench.choose_vehicle({"a": track(bench, [1] * 4)})


def changed(*by):
    """The true box, moved, resized and turned."""
    return TRUE_BOX + np.array(by)


def detections(boxes, scores, labels):
    """The answer for a sweep, with one row of padding that holds the true box."""
    rows = np.concatenate([np.reshape(boxes, (-1, 7)), TRUE_BOX[None]])
    return types.SimpleNamespace(
        center=rows[:, :3],
        size=rows[:, 3:6],
        yaw=rows[:, 6],
        valid=np.arange(len(rows)) < len(rows) - 1,
        score=np.array([*scores, 0]),
        label=np.array([*labels, 0]),
    )


def test_the_box_that_overlaps_most_is_the_answer_whatever_its_class_and_score(bench):
    (sighting,) = track(bench, [100])
    longer, aside = changed(0, 0, 0, 0.5, 0.1, -0.2, np.pi - 0.1), changed(1.5, 0, 0, 0, 0, 0, 0)
    row = bench.estimate(sighting, detections([aside, longer], [0.9, 0.1], [Label.CAR, Label.VAN]))
    assert (row["label"], row["score"]) == ("van", 0.1)
    assert row["residual"] == pytest.approx([0.5, 0.1, -0.2])
    assert row["yaw_error_deg"] == pytest.approx(np.degrees(-0.1))


def test_a_box_that_hardly_touches_the_vehicle_is_not_its_estimate(bench):
    (sighting,) = track(bench, [100])
    beside = changed(3.8 * np.cos(0.3), 3.8 * np.sin(0.3), 0, 0, 0, 0, 0)
    assert bench.estimate(sighting, detections([beside], [0.9], [Label.CAR]))["estimated"] is None
    assert bench.estimate(sighting, detections([], [], []))["estimated"] is None


def test_the_constant_is_held_against_the_same_frames_as_the_estimate(bench):
    rows = [
        {"true": [4.0, 1.6, 1.5], "estimated": [4.3, 1.6, 1.5]},
        {"true": [5.0, 1.6, 1.5], "estimated": None},
        {"true": [4.0, 1.6, 1.5], "estimated": [3.7, 1.6, 1.5]},
    ]
    found = bench.errors(rows, (4.6, 1.6, 1.5))
    assert (found["frames"], found["found"]) == (3, 2)
    assert found["estimated"]["pooled"]["mae"] == pytest.approx(0.1)
    assert found["estimated"]["pooled"]["bias"] == pytest.approx(0)
    assert found["constant"]["pooled"]["mae"] == pytest.approx(0.2)


def test_nothing_found_is_no_error_but_none(bench):
    found = bench.errors([{"true": [4.0, 1.6, 1.5], "estimated": None}], (4.6, 1.6, 1.5))
    assert (found["frames"], found["found"]) == (1, 0)
    assert found["estimated"]["pooled"]["mae"] is None


def test_every_row_of_the_table_has_the_columns_of_the_papers(bench):
    found = bench.errors([{"true": [4.0, 1.6, 1.5], "estimated": [4.3, 1.6, 1.5]}], (4.6, 1.6, 1.5))
    assert list(found["estimated"]["pooled"]) == list(bench.PAPER)
