"""Matching, rates and the report of a folder, on frames worked by hand."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from kitti_objects import car

from jaxbox import evaluation
from jaxbox.cli.evaluate import clip_sentence
from jaxbox.evaluation import matching, report
from jaxbox.geometry import planar
from jaxbox.io import (
    InputError,
    KittiObject,
    boxes_from_objects,
    objects_from_boxes,
    open_sweeps,
    write_bin,
    write_jsonl,
    write_labels,
)
from jaxbox.io.kitti import MIN_VISIBLE_FRACTION, boxes_in_image

ALL = matching.Selection()


def dont_care(left, top, right, bottom) -> KittiObject:
    box = np.array([left, top, right, bottom], float)
    none = {"length": -1.0, "width": -1.0, "height": -1.0, "location": np.full(3, -1000.0)}
    return car(
        type="DontCare", truncation=-1.0, occlusion=-1, alpha=-10.0, rotation_y=-10.0, box_px=box, **none
    )


def counted(labels, results, selection=ALL, *, metric="bev", min_overlap=0.5, num_points=None):
    scenes = matching.select({"a": labels}, {"a": results}, selection, num_points=num_points)
    found = matching.rates(scenes, metric=metric, min_overlap=min_overlap)
    return found.num_labels, found.num_found, found.num_false, found.num_excused


def test_a_match_is_one_to_one_and_takes_the_best_overlap_first():
    overlap = np.array([[0.6, 0.9, 0.0], [0.0, 0.8, 0.55], [0.4, 0.0, 0.0]])
    counts = np.ones(3, bool)
    assert matching.match(overlap, counts, min_overlap=0.5).tolist() == [1, 2, -1]
    assert matching.match(overlap, counts, min_overlap=0.3).tolist() == [1, 2, 0]
    assert matching.match(overlap, counts, min_overlap=0.85).tolist() == [1, -1, -1]


def test_labels_that_count_are_matched_before_ignored_ones():
    overlap = np.array([[0.6], [0.9]])
    assert matching.match(overlap, np.array([True, False]), min_overlap=0.5).tolist() == [0, -1]


def test_without_overlap_there_is_no_match_even_at_limit_zero():
    assert matching.match(np.zeros((2, 2)), np.ones(2, bool), min_overlap=0).tolist() == [-1, -1]
    assert matching.match(np.zeros((0, 3)), np.ones(0, bool), min_overlap=0.5).tolist() == []
    assert matching.match(np.zeros((2, 0)), np.ones(2, bool), min_overlap=0.5).tolist() == [-1, -1]


def test_found_missed_and_false_are_counted():
    labels = [car(), car(right=10.0)]
    results = [car(right=0.2, score=0.5), car(right=-10.0, score=0.4)]
    assert counted(labels, results) == (2, 1, 1, 0)
    scenes = matching.select({"a": labels}, {"a": results}, ALL)
    found = matching.rates(scenes, metric="bev", min_overlap=0.5)
    assert (found.recall, found.precision) == (0.5, 0.5)


def test_the_3d_rates_see_height_and_the_bev_rates_do_not():
    results = [car(score=1.0, location=np.array([0.0, 0.9, 20.0]))]
    assert counted([car()], results, metric="bev") == (1, 1, 0, 0)
    assert counted([car()], results, metric="3d") == (1, 0, 1, 0)


@pytest.mark.parametrize("neighbour", ["Van", "Truck"])
def test_a_detected_neighbour_is_neither_right_nor_wrong(neighbour):
    assert counted([car(type=neighbour)], [car(score=1.0)]) == (0, 0, 0, 1)


def test_a_detected_other_object_is_false():
    assert counted([car(type="Tram")], [car(score=1.0)]) == (0, 0, 1, 0)


def test_detections_of_other_classes_are_not_asked():
    assert counted([car()], [car(type="Van", score=1.0)]) == (1, 0, 0, 0)


def test_a_detection_in_a_dont_care_region_is_excused_where_it_covers_more_than_half():
    alarm = car(right=10.0, score=1.0)
    left, top, _, bottom = alarm.box_px
    assert counted([dont_care(left, top, left + 51, bottom)], [alarm]) == (0, 0, 0, 1)
    assert counted([dont_care(left, top, left + 49, bottom)], [alarm]) == (0, 0, 1, 0)


def test_a_detection_too_low_in_the_image_or_outside_it_is_excused_but_can_be_right():
    low = car(score=1.0, box_px=np.array([0.0, 0, 50, 24.9]))
    outside = car(score=1.0, box_px=np.zeros(4))
    for detection in (low, outside):
        assert counted([], [detection]) == (0, 0, 0, 1)
        assert counted([car()], [detection]) == (1, 1, 0, 0)


@pytest.mark.parametrize(
    ("selection", "changes", "counts"),
    [
        (matching.Selection(max_occlusion=1), {"occlusion": 1}, True),
        (matching.Selection(max_occlusion=1), {"occlusion": 2}, False),
        (matching.Selection(difficulty="easy"), {"truncation": 0.2}, False),
        (matching.Selection(difficulty="moderate"), {"truncation": 0.2}, True),
        (matching.Selection(difficulty="hard"), {"box_px": np.array([0, 0, 9, 24.0])}, False),
        (matching.Selection(track_id=3), {"track_id": 3}, True),
        (matching.Selection(track_id=3), {"track_id": 4}, False),
    ],
)
def test_a_label_outside_the_selection_is_neither_found_nor_missed(selection, changes, counts):
    found = counted([car(**changes)], [car(score=1.0)], selection)
    assert found == ((1, 1, 0, 0) if counts else (0, 0, 0, 1))


def test_labels_are_selected_by_their_points():
    selection = matching.Selection(min_points=30)
    for points, num_labels in ((29, 0), (30, 1)):
        assert counted([car()], [], selection, num_points={"a": np.array([points])})[0] == num_labels
    with pytest.raises(ValueError, match="points"):
        counted([car()], [], selection)


def test_a_cut_leaves_out_lower_scores():
    labels, results = [car(), car(right=10.0)], [car(score=0.8), car(right=10.0, score=0.3)]
    scenes = matching.select({"a": labels}, {"a": results}, ALL)
    found = [
        matching.rates(matching.cut(scenes, min_score=cut), metric="bev", min_overlap=0.5).num_found
        for cut in (0.0, 0.3, 0.5, 0.9)
    ]
    assert found == [2, 2, 1, 0]


def test_recall_bins_share_out_the_labels():
    labels = [car(forward=5.0), car(forward=15.0), car(forward=60.0)]
    results = [car(forward=15.0, score=1.0)]
    points = {"a": np.array([2000, 20, 9])}
    scenes = matching.select({"a": labels}, {"a": results}, ALL, num_points=points)
    ranges = matching.recall_by_range(scenes)
    assert [row.num_labels for row in ranges] == [1, 1, 0, 0, 0, 1]
    assert [row.to_dict()["recall"]["bev_0.5"] for row in ranges] == [0, 1, None, None, None, 0]
    assert ranges[-1].upper is None
    assert [row.num_labels for row in matching.recall_by_points(scenes)] == [1, 1, 0, 0, 0, 1]
    unknown = matching.select({"a": labels}, {"a": results}, ALL)
    assert sum(row.num_labels for row in matching.recall_by_points(unknown)) == 0


def test_a_verdict_marks_each_label_and_detection_once_and_keeps_their_rows():
    labels = [car(type="Pedestrian"), car(), car(right=10.0), car(right=20.0, type="Van")]
    results = [
        car(right=-10.0, score=0.9),
        car(type="Van", score=0.8),
        car(right=20.0, score=0.7),
        car(right=0.1, score=0.6),
        car(right=-20.0, score=0.5, box_px=np.array([0.0, 0, 50, 20])),
    ]
    (scene,) = matching.select({"a": labels}, {"a": results}, ALL)
    verdict = matching.judge(scene, metric="bev", min_overlap=0.5)
    assert scene.label_rows.tolist() == [1, 2, 3], "the pedestrian is not a matter of cars"
    assert scene.detection_rows.tolist() == [0, 2, 3, 4]
    assert verdict.found.tolist() == [True, False, False]
    assert verdict.missed.tolist() == [False, True, False]
    assert verdict.false.tolist() == [True, False, False, False]
    assert scene.detection_rows[verdict.partner[verdict.found]].tolist() == [3]
    (kept,) = matching.cut([scene], min_score=0.65)
    assert kept.detection_rows.tolist() == [0, 2]
    assert matching.judge(kept, metric="bev", min_overlap=0.5).missed.tolist() == [True, True, False]


def test_points_on_a_face_are_inside_and_nan_is_nowhere():
    box = (np.array([[10.0, 5.0, 1.0]]), np.array([[4.0, 2.0, 2.0]]), np.array([np.pi / 2]))
    # The box is turned: 2 m along x, 4 m along y.
    points = np.array(
        [
            [10, 5, 1],
            [10.99, 5, 1],
            [11.01, 5, 1],
            [10, 6.99, 1],
            [10, 7.01, 1],
            [10, 5, 2],
            [10, 5, 2.01],
            [np.nan] * 3,
        ]
    )
    assert matching.count_points_in_boxes(points, *box).tolist() == [4]
    assert (
        matching.count_points_in_boxes(points, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)).tolist() == []
    )
    assert matching.count_points_in_boxes(np.zeros((0, 3)), *box).tolist() == [0]


@pytest.mark.parametrize("seed", range(3))
def test_counted_points_do_not_depend_on_how_the_scene_is_turned(seed):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-5, 5, (5000, 3))
    center, size, yaw = rng.uniform(-3, 3, (8, 3)), rng.uniform(1, 5, (8, 3)), rng.uniform(-2, 2, 8)
    counts = matching.count_points_in_boxes(xyz, center, size, yaw)
    assert counts.min() > 0

    def turned(points):
        xy = np.asarray(planar.rotate(jnp.asarray(points[:, :2]), jnp.full(len(points), 0.7)))
        return np.column_stack([xy, points[:, 2]])

    again = matching.count_points_in_boxes(turned(xyz), turned(center), size, yaw + 0.7)
    # float32 rotations may move a point across a face.
    np.testing.assert_allclose(again, counts, atol=1)


def test_a_box_with_swapped_axes_is_matched_and_counted_as_a_swap():
    found = report.measure_selection({"a": [car()]}, {"a": [car(score=1.0, rotation_y=np.pi / 2)]}, ALL)[
        "matched"
    ]
    assert found["num"] == 1
    assert found["yaw"]["num_axis_swaps"] == 1
    assert found["yaw"]["median_deg"] == pytest.approx(90)


def test_sizes_are_of_the_matched_labels_beside_the_constants_for_the_same():
    labels = {"a": [car(), car(right=10.0, length=9.0)]}
    results = {"a": [car(score=1.0, length=4.3, width=1.7, height=1.6)]}
    measured = report.measure_selection(labels, results, ALL)
    assert measured["matched"]["sizes"]["length"]["mae"] == pytest.approx(0.4)
    assert measured["matched"]["sizes"]["pooled"]["bias"] == pytest.approx(0.2)
    assert measured["matched"]["constant_sizes"]["length"]["mae"] == pytest.approx(0.02)
    assert measured["objects"]["frames"] == ["a"]
    np.testing.assert_allclose(measured["objects"]["residual_m"], [[0.4, 0.1, 0.1]])
    assert measured["objects"]["num_points"] == [None]


def test_nothing_found_and_nothing_labelled_give_none_and_are_json():
    for labels, results in (
        ({"a": [car()]}, {"a": []}),
        ({"a": []}, {"a": [car(score=1.0)]}),
        ({"a": []}, {"a": []}),
    ):
        measured = evaluation.evaluate_objects(labels, results)
        json.dumps(measured, allow_nan=False)
        matched = measured["selections"]["all"]["matched"]
        assert matched["num"] == 0
        assert matched["mean_bev_iou"] is None
        assert "clear" not in measured["selections"]


def test_false_alarms_are_told_a_frame_at_each_cut():
    labels = {"a": [car()], "b": []}
    results = {"a": [car(score=0.9), car(right=10.0, score=0.45)], "b": [car(score=0.25)]}
    rates = evaluation.evaluate_objects(labels, results)["selections"]["all"]["rates_by_score"]
    assert [rate["false_per_frame"] for rate in rates[:6]] == [1, 1, 1, 0.5, 0.5, 0]


def test_cars_of_fifty_points_are_a_selection_with_their_own_axis_swaps():
    labels = {"a": [car(), car(right=10.0)]}
    results = {"a": [car(score=1.0, rotation_y=np.pi / 2), car(right=10.0, score=1.0, rotation_y=np.pi / 2)]}
    measured = evaluation.evaluate_objects(labels, results, num_points={"a": np.array([49, 50])})
    swaps = {
        name: found["matched"]["yaw"]["num_axis_swaps"] for name, found in measured["selections"].items()
    }
    assert (swaps["all"], swaps["dense"]) == (2, 1)


def test_a_detection_without_score_is_named():
    with pytest.raises(ValueError, match=r"frame a .*score"):
        counted([car()], [car()])


def test_an_unknown_difficulty_is_refused():
    with pytest.raises(ValueError, match="medium"):
        matching.Selection(difficulty="medium")


CALIBRATION = """P2: 700 0 600 0 0 700 180 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
"""


@pytest.fixture
def folder(tmp_path):
    """Two labelled sweeps; the car of the first holds three points, in the sensor frame at x 20, y 0."""
    training = tmp_path / "training"
    for name in ("000000", "000001"):
        write_labels(training / "label_2" / f"{name}.txt", [car(), dont_care(0, 0, 9, 9)])
        (training / "calib").mkdir(exist_ok=True)
        (training / "calib" / f"{name}.txt").write_text(CALIBRATION)
        (training / "velodyne").mkdir(exist_ok=True)
        points = np.array([[20, 0, -1], [20, 1.9, -1], [20.7, 0, -0.3], [20, 2.1, -1], [5, 0, 0]], np.float32)
        write_bin(training / "velodyne" / f"{name}.bin", points)
    return training


def test_a_folder_is_measured_with_points_counted_in_the_sweeps(folder, tmp_path):
    write_labels(tmp_path / "out" / "000000.txt", [car(score=0.9)])
    write_labels(tmp_path / "out" / "000001.txt", [])
    measured = evaluation.evaluate_folders(folder, tmp_path / "out")
    json.dumps(measured, allow_nan=False)
    assert measured["num_frames"] == 2
    assert measured["num_missing_results"] == 0
    everything = measured["selections"]["all"]
    assert (everything["rates"][0]["num_labels"], everything["rates"][0]["num_found"]) == (2, 1)
    assert everything["objects"]["num_points"] == [3]
    assert everything["objects"]["range_m"] == pytest.approx([20])
    assert measured["selections"]["clear"]["rates"][0]["num_labels"] == 0


def test_recall_is_of_boxes_that_the_image_cuts_off_where_the_run_tells(folder, tmp_path):
    """A car at the left edge of the image: found, and left out of KITTI's text."""
    calibration = open_sweeps(folder)[0].read_calibration()
    size = np.array([[3.9, 1.6, 1.5]])
    centers = np.array([[4.0, y, -1.0] for y in np.arange(3, 9, 0.1)])
    num = len(centers)
    _, fraction, visible = boxes_in_image(centers, np.tile(size, (num, 1)), np.zeros(num), calibration)
    (place, *_) = centers[visible & (fraction < MIN_VISIBLE_FRACTION)]
    (label,) = objects_from_boxes(
        place[None], size, np.zeros(1), calibration, types=["Car"], min_visible_fraction=0
    )
    write_labels(folder / "label_2" / "000000.txt", [label, car()])
    near = boxes_from_objects([car()], calibration, keep_heading=True)
    shown = {"center": near[0][0].tolist(), "size": near[1][0].tolist(), "heading": float(near[2][0])}
    cut = {"center": place.tolist(), "size": size[0].tolist(), "heading": 0.0}
    boxes = [{"label": "car", "score": 0.9, **shown}, {"label": "car", "score": 0.4, **cut}]
    for name in ("000000", "000001"):
        write_labels(tmp_path / "out" / f"{name}.txt", [car(score=0.9)])

    def measure(*records):
        write_jsonl(tmp_path / "out" / "detections.jsonl", records)
        measured = evaluation.evaluate_folders(folder, tmp_path / "out")
        rates = {name: part["rates"][0] for name, part in measured["selections"].items()}
        found = {name: (rate["num_found"], rate["num_labels"]) for name, rate in rates.items()}
        return measured["unclipped"], found["all"], found["cut_off"]

    first, second = {"name": "000000", "boxes": boxes}, {"name": "000001", "boxes": boxes[:1]}
    assert measure(first, second) == (True, (3, 3), (1, 1))
    # Those of another run are not taken: they lack a sweep, or a box of the text.
    assert measure(first) == (False, (2, 3), (0, 1))
    assert measure(first, second | {"boxes": []}) == (False, (2, 3), (0, 1))
    with pytest.raises(InputError, match=r"detections\.jsonl: 000001 is no record"):
        measure(first, second | {"boxes": [{}]})


@pytest.mark.parametrize(
    ("num", "unclipped", "words"),
    [
        (0, True, ""),
        (3, False, "`detect --format both` tell"),
        (3, True, "Recall is of the boxes of detections"),
    ],
)
def test_the_command_says_what_recall_is_of(num, unclipped, words):
    cut_off = {"rates": [{"num_labels": num}]}
    sentence = clip_sentence({"unclipped": unclipped, "selections": {"cut_off": cut_off}})
    assert sentence.startswith(f"{num} labels are cut off") == (num > 0)
    assert words in sentence


def test_results_may_lie_in_a_data_folder(folder, tmp_path):
    for name in ("000000", "000001"):
        write_labels(tmp_path / "out" / "data" / f"{name}.txt", [car(score=0.9)])
    assert evaluation.evaluate_folders(folder, tmp_path / "out")["selections"]["all"]["matched"]["num"] == 2


def test_a_missing_result_file_is_an_error_unless_taken_for_empty(folder, tmp_path):
    write_labels(tmp_path / "out" / "000000.txt", [car(score=0.9)])
    with pytest.raises(InputError, match=r"1 of 2.*000001\.txt"):
        evaluation.evaluate_folders(folder, tmp_path / "out")
    measured = evaluation.evaluate_folders(folder, tmp_path / "out", missing_as_empty=True)
    assert measured["num_missing_results"] == 1
    assert measured["selections"]["all"]["rates"][0]["num_labels"] == 2


def test_missing_folders_and_labels_are_named(folder, tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        evaluation.evaluate_folders(folder, tmp_path / "nowhere")
    write_bin(tmp_path / "plain" / "a.bin", np.zeros((3, 3), np.float32))
    with pytest.raises(InputError, match="no sweep there has labels"):
        evaluation.evaluate_folders(tmp_path / "plain", tmp_path)


def test_each_drive_is_reported_by_itself(folder, tmp_path):
    for name in ("000000", "000001"):
        write_labels(tmp_path / "out" / f"{name}.txt", [car(score=0.9)])
    drives = {"000000": "drive_a", "000001": "drive_b"}
    measured = evaluation.evaluate_folders(folder, tmp_path / "out", drives=drives)
    assert measured["num_drives"] == 2
    assert sorted(measured["kitti"]["by_drive"]) == ["drive_a", "drive_b"]


def test_perfect_answers_on_real_frames_are_all_found_with_no_error(data_root):
    root = data_root / "kitti_object" / "training"
    measured = evaluation.evaluate_folders(root, data_root / "kitti_eval_oracle" / "perfect")
    everything = measured["selections"]["all"]
    assert [row["recall"] for row in everything["rates"]] == [1, 1, 1, 1]
    assert everything["rates"][0]["num_labels"] == 66
    assert everything["matched"]["sizes"]["pooled"]["mae"] == 0
    assert everything["matched"]["yaw"]["num_axis_swaps"] == 0
    assert everything["matched"]["constant_sizes"]["pooled"]["mae"] > 0.1
    assert min(everything["objects"]["num_points"]) >= 0
    assert len(open_sweeps(root)) == measured["num_frames"] == 20
