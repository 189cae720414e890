"""The benchmark of classes: which labels are found, and from which cut on nine of ten boxes are right."""

import json
import pathlib

import numpy as np
import pytest
from kitti_objects import car

from benchmarks import bench_classes as bench
from jaxbox.evaluation.boxes import excused_in_image

RESULTS = pathlib.Path(__file__).parents[1] / "benchmarks" / "results"


def box(x, length=4.0):
    return [x, 0.0, 0.0, length, 2.0, 1.5, 0.0]


def test_a_label_has_the_score_of_the_best_box_that_covers_half_of_it():
    labels = np.array([box(0), box(20), box(40)])
    boxes = np.array([box(0), box(0.2), box(22), box(40, length=7.9), box(40, length=8.1)])
    best = bench.best_scores(labels, boxes, np.array([0.3, 0.6, 0.9, 0.2, 0.8]))
    np.testing.assert_allclose(best, [0.6, 0, 0.2])
    assert bench.best_scores(labels, boxes[:0], np.zeros(0)).tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("right", "cut"),
    [
        ([1] * 10, 0.0),
        ([1] * 9 + [0], 0.0),
        ([1] * 8 + [0, 0], 0.2),
        # Later right ones make up for an early false one.
        ([0] + [1] * 9, 0.0),
        ([0] * 10, None),
        ([], None),
    ],
)
def test_the_cut_is_the_least_score_from_which_nine_of_ten_are_right(right, cut):
    scores = np.linspace(0.9, 0, 10)[: len(right)]
    found = bench.cut_of(scores, np.array(right, bool), 0.9)
    assert found == (None if cut is None else pytest.approx(cut))


def test_counts_are_by_class_and_points():
    frame = {
        "labels": [("Truck", 120, 0.3), ("Truck", 40, 0.1), ("Van", 99, 0.15), ("Pedestrian", 200, 0.9)],
        "boxes": [("Truck", 0.4, 0.6), ("Truck", 0.2, 0.2), ("Truck", 0.16, 0.0), ("Car", 0.9, 0.9)],
    }
    table = bench.summarise([frame, frame])
    truck, van = table["Truck"], table["Van"]
    assert (truck["labels 30"], truck["found 30"], truck["labels 100"], truck["found 100"]) == (4, 2, 2, 2)
    assert (truck["boxes"], truck["right"], truck["false"], truck["cut 0.9"]) == (6, 2, 2, 0.4)
    assert truck["found 100 from 0.9"] == 0
    assert (van["labels 30"], van["found 30"], van["labels 100"], van["cut 0.9"]) == (2, 2, 0, None)
    vehicles = table["Any"]
    assert (vehicles["labels 30"], vehicles["found 30"], vehicles["labels 100"]) == (6, 4, 2)
    assert (vehicles["boxes"], vehicles["right"], vehicles["cut 0.95"]) == (8, 4, 0.4)
    assert vehicles["found 30 from 0.95"] == vehicles["found 100 from 0.95"] == 0


def test_what_lies_for_more_than_half_in_a_region_is_in_it():
    def seen(left, right, kind="Car"):
        return car(type=kind, box_px=np.array([left, 100.0, right, 200.0]))

    half, more, beside = seen(0, 200), seen(1, 200), seen(300, 400)
    regions = [seen(100, 280, "DontCare"), seen(390, 500, "DontCare")]

    def in_regions(objects, labels):
        return excused_in_image(labels, objects) > bench.MAX_DONT_CARE

    # A labelled car covers others too, and is no region.
    assert in_regions([half, more, beside], [half, *regions]).tolist() == [False, True, False]
    assert in_regions([half, more], [half]).tolist() == [False, False]
    assert in_regions([], regions).shape == (0,)


@pytest.mark.parametrize("arguments", [["--corrupt", "reflections"], ["--amount", "0.01"]])
def test_a_corruption_needs_its_amount(arguments, capsys):
    with pytest.raises(SystemExit):
        bench.main(arguments)
    assert "--amount" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["reflections", "mirrored"])
def test_a_hundredth_of_points_below_the_road_costs_hardly_a_well_seen_car(kind):
    report = json.loads((RESULTS / f"classes_{kind}.json").read_text())
    assert (report["corruption"], report["amount"], report["num_copies"]) == (kind, 0.01, 6)
    clean = json.loads((RESULTS / "classes.json").read_text())["classes"]["Car"]
    car = report["classes"]["Car"]
    assert car["labels 100"] == clean["labels 100"]
    assert car["found 100"] >= clean["found 100"] - 3


def test_the_record_is_of_all_frames_and_copies():
    report = json.loads((RESULTS / "classes.json").read_text())
    assert (report["num_frames"], report["num_copies"]) == (78, 6)
    for row in report["classes"].values():
        assert row["false"] <= row["boxes"] - row["right"]
        for least in (30, 100):
            found = [row[f"found {least}{cut}"] for cut in (" from 0.95", " from 0.9", "")]
            assert found == sorted(found)
            assert found[-1] <= row[f"labels {least}"]
    *classes, together = report["classes"].values()
    for name in ("labels 30", "found 30", "boxes", "right", "false"):
        assert together[name] == sum(row[name] for row in classes)
