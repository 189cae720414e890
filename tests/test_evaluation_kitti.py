"""KITTI's protocol: against the official evaluator's own output, and rule by rule on cases worked by hand."""

import dataclasses
import hashlib
import json

import numpy as np
import pytest
from kitti_objects import car

from jaxbox.evaluation import boxes, kitti
from jaxbox.evaluation.protocols import Protocol, protocol_frames
from jaxbox.io import KittiObject, read_label_folder

OFFICIAL_METRICS = {
    "detection": "image",
    "orientation": "orientation",
    "detection_ground": "bev",
    "detection_3d": "3d",
}


def region(left, top, right, bottom) -> KittiObject:
    return car(
        type="DontCare",
        truncation=-1.0,
        occlusion=-1,
        alpha=-10.0,
        box_px=np.array([left, top, right, bottom], float),
        height=-1.0,
        width=-1.0,
        length=-1.0,
        location=np.full(3, -1000.0),
        rotation_y=-10.0,
    )


def lone_cars(count: int) -> dict[str, list[KittiObject]]:
    return {f"{i:06d}": [car()] for i in range(count)}


def scored(labels, scores=None):
    scores = iter(scores if scores is not None else np.linspace(0.9, 0.1, 1000))
    return {
        n: [dataclasses.replace(item, score=float(next(scores))) for item in items]
        for n, items in labels.items()
    }


def changed(labels, **changes):
    return {name: [dataclasses.replace(item, **changes) for item in items] for name, items in labels.items()}


def shifted(labels, right, up=0.0):
    """Every object moved; cars here lie along the camera's x."""
    return {
        name: [
            dataclasses.replace(item, location=item.location + np.array([right, -up, 0])) for item in items
        ]
        for name, items in labels.items()
    }


def r40(labels, results, metric="3d", difficulty="moderate", class_name="Car"):
    return kitti.evaluate(labels, results).curve(class_name, metric, difficulty).r40


def test_vehicles_of_any_class_are_judged_as_cars_are():
    words = ("Car", "Van", "Truck", "Tram")
    labels = {name: [car(type=words[i % 4])] for i, name in enumerate(lone_cars(60))}
    found_as = {name: [car(type=words[i % 3])] for i, name in enumerate(labels)}
    found = scored(shifted(found_as, 0.9) | {"000007": [], "000011": shifted(found_as, 9)["000011"]})
    overlap = {kitti.VEHICLE: kitti.VEHICLE_OVERLAP}
    merged = kitti.evaluate(kitti.as_vehicles(labels), kitti.as_vehicles(found), min_overlap=overlap)
    cars = changed(labels, type="Car"), changed(found, type="Car")
    of_cars = kitti.evaluate(*cars, min_overlap={"Car": kitti.VEHICLE_OVERLAP})
    assert [curve.r40 for curve in merged.curves] == [curve.r40 for curve in of_cars.curves]
    assert 0 < merged.curve(kitti.VEHICLE, "3d", "moderate").r40 < 100


def test_people_are_no_vehicles_and_trailers_excuse_them():
    labels = {"a": [car(type="Pedestrian"), car(type="Misc")], "b": [car()]}
    assert [item.type for items in kitti.as_vehicles(labels).values() for item in items] == [
        "Pedestrian", "Misc", "Vehicle",
    ]  # fmt: skip
    found = kitti.as_vehicles(scored({"a": [car()], "b": [car()]}))
    curve = kitti.evaluate(kitti.as_vehicles(labels), found, min_overlap={kitti.VEHICLE: 0.5}).curves[-1]
    assert (curve.num_labels, curve.r40) == (1, curve.to_dict()["ceiling_r40"])


@pytest.mark.parametrize("answers", ["perturbed", "perfect", "borderline"])
def test_every_curve_is_that_of_the_official_evaluator(data_root, answers):
    folder = data_root / "kitti_eval_oracle" / answers
    own = folder / "label_2"
    labels = read_label_folder(own if own.is_dir() else data_root / "kitti_object" / "training" / "label_2")
    evaluation = kitti.evaluate(labels, read_label_folder(folder / "data"))
    files = sorted(folder.glob("stats_*.txt"))
    assert len(files) in (4, 12)
    for file in files:
        _, class_name, kind = file.stem.split("_", 2)
        ours = [
            evaluation.curve(class_name.capitalize(), OFFICIAL_METRICS[kind], difficulty).precision
            for difficulty in kitti.DIFFICULTIES
        ]
        # The files keep six decimals.
        np.testing.assert_allclose(ours, np.loadtxt(file), atol=1e-6, err_msg=file.name)


def test_the_ceiling_is_what_perfect_answers_reach(data_root):
    labels = read_label_folder(data_root / "kitti_object" / "training" / "label_2")
    perfect = {
        n: [dataclasses.replace(x, score=1.0) for x in items if not x.is_dont_care]
        for n, items in labels.items()
    }
    curves = kitti.evaluate(labels, perfect).curves
    assert len(curves) == 36
    for curve in curves:
        if curve.metric != "image" and curve.metric != "orientation":
            np.testing.assert_array_equal(curve.precision, curve.ceiling)
    assert curves[0].to_dict()["ceiling_r40"] == pytest.approx(47.5)


@pytest.mark.parametrize(("count", "expected"), [(1, 0.0), (2, 2.5), (21, 50.0), (41, 100.0), (80, 100.0)])
def test_perfect_answers_on_few_labels_stay_below_100(count, expected):
    labels = lone_cars(count)
    curve = kitti.evaluate(labels, scored(labels)).curve("Car", "3d", "easy")
    assert curve.r40 == pytest.approx(expected)
    assert curve.to_dict()["ceiling_r40"] == pytest.approx(expected)
    assert curve.num_labels == count


def test_r11_takes_every_fourth_sample_from_recall_zero():
    labels = lone_cars(5)
    curve = kitti.evaluate(labels, scored(labels)).curve("Car", "3d", "easy")
    np.testing.assert_array_equal(curve.precision, [1] * 5 + [0] * 36)
    assert curve.r11 == pytest.approx(100 * 2 / 11)


def test_a_false_alarm_with_the_best_score_lowers_precision_at_every_recall():
    labels = lone_cars(41)
    results = scored(labels)
    results["000000"].append(car(right=15.0, score=1.0))
    curve = kitti.evaluate(labels, results).curve("Car", "3d", "easy")
    # At sample i, i + 1 cars are found next to one false alarm; the best from there on is at the end.
    np.testing.assert_allclose(curve.precision, 41 / 42)


def test_a_false_alarm_with_the_worst_score_costs_nothing():
    labels = lone_cars(41)
    results = scored(labels)
    results["000000"].append(car(right=15.0, score=0.0))
    assert r40(labels, results) == pytest.approx(100)


def test_missed_cars_end_the_curve():
    labels = lone_cars(80)
    results = scored(labels)
    for name in list(results)[40:]:
        results[name] = []
    # Half the cars are found: recall 0 to 1/2 is reached.
    precision = kitti.evaluate(labels, results).curve("Car", "3d", "easy").precision
    assert precision[19] == 1
    assert precision[21] == 0


def test_a_second_detection_of_the_same_car_is_a_false_alarm():
    labels = lone_cars(41)
    results = {name: items * 2 for name, items in scored(labels).items()}
    assert r40(labels, results) == pytest.approx(50)


def test_an_overlap_must_exceed_the_limit():
    labels = lone_cars(41)
    # Moved along its length by 3.9 * .3 / 1.7 m, a car has an overlap of .7 with its label.
    limit = 3.9 * 0.3 / 1.7
    assert r40(labels, scored(shifted(labels, limit - 0.01)), "bev") == pytest.approx(100)
    assert r40(labels, scored(shifted(labels, limit + 0.01)), "bev") == 0


def test_height_and_vertical_place_count_in_3d_only():
    labels = lone_cars(41)
    raised = scored(shifted(labels, 0, up=0.6))
    assert r40(labels, raised, "bev") == pytest.approx(100)
    assert r40(labels, raised, "3d") == 0
    assert r40(labels, raised, "image") == pytest.approx(100)


def test_a_turned_box_is_judged_in_its_own_direction():
    labels = changed(lone_cars(41), rotation_y=0.9)
    mirrored = changed(labels, rotation_y=-0.9)
    assert r40(labels, scored(labels), "bev") == pytest.approx(100)
    assert r40(labels, scored(mirrored), "bev") == 0


def test_orientation_similarity_is_half_at_a_right_angle_and_none_when_reversed():
    labels = lone_cars(41)
    for turn, expected in ((0.0, 100.0), (np.pi / 2, 50.0), (np.pi, 0.0)):
        turned = scored(changed(labels, alpha=turn))
        assert r40(labels, turned, "orientation") == pytest.approx(expected, abs=1e-9)
        assert r40(labels, turned, "image") == pytest.approx(100)


def test_one_unknown_orientation_voids_the_orientation_score_alone():
    labels = lone_cars(41)
    results = scored(labels)
    results["000003"] = [dataclasses.replace(results["000003"][0], alpha=-10.0)]
    assert r40(labels, results, "orientation") == 0
    assert r40(labels, results, "image") == pytest.approx(100)


@pytest.mark.parametrize("neighbour", ["Van", "van"])
def test_a_detected_van_is_neither_right_nor_wrong_for_cars(neighbour):
    labels = lone_cars(41)
    labels["000000"].append(car(right=10.0, type=neighbour))
    results = scored(lone_cars(41))
    results["000000"].append(car(right=10.0, score=1.0))
    curve = kitti.evaluate(labels, results).curve("Car", "3d", "moderate")
    assert curve.num_labels == 41
    assert curve.r40 == pytest.approx(100)


def test_a_detected_truck_is_a_false_alarm_for_cars():
    labels = lone_cars(41)
    labels["000000"].append(car(right=10.0, type="Truck"))
    results = scored(lone_cars(41))
    results["000000"].append(car(right=10.0, score=1.0))
    assert r40(labels, results) == pytest.approx(100 * 41 / 42)


def test_a_seated_person_is_neither_right_nor_wrong_for_pedestrians():
    labels = changed(lone_cars(41), type="Pedestrian")
    results = scored(labels)
    labels["000000"].append(car(right=10.0, type="Person_sitting"))
    results["000000"].append(car(right=10.0, type="Pedestrian", score=1.0))
    assert r40(labels, results, class_name="Pedestrian") == pytest.approx(100)


@pytest.mark.parametrize("metric", ["image", "bev", "3d"])
def test_dont_care_excuses_what_it_covers_in_the_image_metrics_only(metric):
    labels = lone_cars(41)
    alarm = car(right=10.0, score=1.0)
    # Covers .75 of the alarm's box, although its own area is far larger.
    labels["000000"].append(region(alarm.box_px[0] - 1, 0, alarm.box_px[0] + 75, 2000))
    results = scored(lone_cars(41))
    results["000000"].append(alarm)
    expected = 100 if metric == "image" else 100 * 41 / 42
    assert r40(labels, results, metric) == pytest.approx(expected)


def test_dont_care_that_covers_too_little_excuses_nothing():
    labels = lone_cars(41)
    alarm = car(right=10.0, score=1.0)
    labels["000000"].append(region(alarm.box_px[0], 0, alarm.box_px[0] + 65, 400))
    results = scored(lone_cars(41))
    results["000000"].append(alarm)
    assert r40(labels, results, "image") == pytest.approx(100 * 41 / 42)


@pytest.mark.parametrize(
    ("changes", "counted"),
    [
        ({}, [True, True, True]),
        ({"occlusion": 1}, [False, True, True]),
        ({"occlusion": 2}, [False, False, True]),
        ({"occlusion": 3}, [False, False, False]),
        ({"truncation": 0.15}, [True, True, True]),
        ({"truncation": 0.16}, [False, True, True]),
        ({"truncation": 0.31}, [False, False, True]),
        ({"truncation": 0.51}, [False, False, False]),
        ({"box_px": np.array([0.0, 0, 90, 40])}, [True, True, True]),
        ({"box_px": np.array([0.0, 0, 90, 39.9])}, [False, True, True]),
        ({"box_px": np.array([0.0, 0, 90, 24.9])}, [False, False, False]),
    ],
)
def test_difficulties_follow_the_limits_of_the_development_kit(changes, counted):
    labels = {"a": [car(**changes)]}
    curves = [kitti.evaluate(labels, {"a": []}).curve("Car", "3d", d) for d in kitti.DIFFICULTIES]
    assert [curve.num_labels == 1 for curve in curves] == counted


def test_a_detection_too_low_in_the_image_is_no_false_alarm():
    labels = lone_cars(41)
    results = scored(labels)
    low = car(right=10.0, score=1.0)
    # 25.9 px are 25 whole ones: enough for moderate, too low for easy.
    results["000000"].append(dataclasses.replace(low, box_px=np.array([1000, 170, 1100, 195.9])))
    assert r40(labels, results, difficulty="easy") == pytest.approx(100)
    assert r40(labels, results, difficulty="moderate") == pytest.approx(100 * 41 / 42)
    results["000000"][-1] = dataclasses.replace(low, box_px=np.array([1000, 170, 1100, 194.9]))
    assert r40(labels, results, difficulty="moderate") == pytest.approx(100)


def test_a_hard_label_excuses_its_detection_where_it_does_not_count():
    labels = lone_cars(41)
    labels["000000"].append(car(right=10.0, occlusion=2))
    results = scored(labels, np.linspace(1, 0.5, 42))
    for difficulty in kitti.DIFFICULTIES:
        assert r40(labels, results, difficulty=difficulty) == pytest.approx(100)


def test_precision_prefers_the_better_overlap_to_the_better_score():
    labels = {f"{i:06d}": [car(), car(forward=21.3)] for i in range(41)} | {
        f"{i:06d}": [car()] for i in range(41, 82)
    }
    results = {name: [car(score=0.5)] for name in labels}
    for name in list(labels)[:41]:
        # The better scored box fits both cars, the other one only the first, and better.
        results[name] = [car(score=0.8), car(forward=20.5, score=0.9)]
    curve = kitti.evaluate(labels, results, min_overlap={"Car": 0.2}).curve("Car", "bev", "easy")
    # With the better score first, a third of the detections were false alarms at score .5.
    assert curve.precision[26] == 1


def test_a_detection_high_enough_is_preferred_to_one_too_low():
    labels = lone_cars(41)
    low = changed(scored(labels, np.full(41, 0.5)), box_px=np.array([0.0, 0, 50, 20]))
    proper = scored(shifted(labels, 0.2), np.full(41, 0.9))
    results = {name: low[name] + proper[name] for name in labels}
    assert r40(labels, results) == pytest.approx(100)


def test_a_detection_too_low_takes_a_label_whatever_its_class_as_officially():
    labels = lone_cars(41)
    low = changed(scored(labels, np.full(41, 0.9)), box_px=np.array([0.0, 0, 50, 20]), type="Cyclist")
    results = {name: low[name] + items for name, items in scored(labels, np.full(41, 0.5)).items()}
    assert r40(labels, results) == 0


def test_no_detections_score_zero_and_no_labels_have_ceiling_zero():
    labels = lone_cars(41)
    nothing = {name: [] for name in labels}
    for curve in kitti.evaluate(labels, nothing).curves:
        assert curve.r40 == curve.r11 == 0
    for curve in kitti.evaluate(nothing, scored(labels)).curves:
        assert curve.r40 == 0
        assert curve.ceiling.sum() == 0
    assert kitti.evaluate({}, {}).num_frames == 0
    assert kitti.soft_score(labels, nothing) == 0


def test_an_evaluation_by_drive_is_that_of_the_drives_frames_alone():
    labels = lone_cars(60)
    results = scored(labels)
    for name in list(results)[45:]:
        results[name].append(car(right=10.0, score=1.0))
    drives = {name: "late" if int(name) >= 45 else "early" for name in labels}
    by_drive = kitti.evaluate(labels, results, drives=drives).by_drive
    assert list(by_drive) == ["early", "late"]
    for drive, curves in by_drive.items():
        names = [name for name in labels if drives[name] == drive]
        alone = kitti.evaluate({n: labels[n] for n in names}, results).curves
        for ours, theirs in zip(curves, alone, strict=True):
            assert ours.to_dict() == theirs.to_dict()


def test_soft_score_averages_over_the_overlaps():
    labels = lone_cars(41)
    # 3D overlap .68: found at .60 and .65, not at .70 and .75.
    moved = shifted(labels, 3.9 * (1 - 0.68) / (1 + 0.68))
    assert kitti.soft_score(labels, scored(moved)) == pytest.approx(50)
    assert kitti.soft_score(labels, scored(labels)) == pytest.approx(100)


def test_the_dictionary_is_json():
    labels = lone_cars(3)
    drives = dict.fromkeys(labels, "0001")
    read = json.loads(
        json.dumps(kitti.evaluate(labels, scored(labels), drives=drives).to_dict(), allow_nan=False)
    )
    assert len(read["curves"]) == 36
    assert read["num_drives"] == 1


def test_frames_without_results_are_named():
    with pytest.raises(ValueError, match="000001"):
        kitti.evaluate(lone_cars(2), {"000000": []})


def test_detections_without_score_are_named():
    with pytest.raises(ValueError, match=r"000000.*score"):
        kitti.evaluate(lone_cars(1), lone_cars(1))


def test_frames_without_a_drive_are_named():
    with pytest.raises(ValueError, match="000001"):
        kitti.evaluate(lone_cars(2), scored(lone_cars(2)), drives={"000000": "a"})


def test_unknown_metrics_are_named():
    with pytest.raises(ValueError, match="depth"):
        kitti.evaluate({}, {}, metrics=["depth"])


def test_camera_boxes_look_forward_left_up():
    box = boxes.camera_boxes([car(right=2.0, forward=20.0)])[0]
    # rotation_y 0 lies across the view, along the camera's x.
    np.testing.assert_allclose(box, [20, -2, 0.75 - 1.7, 3.9, 1.6, 1.5, -np.pi / 2])
    assert boxes.camera_boxes([]).shape == (0, 7)
    np.testing.assert_array_equal(boxes.camera_boxes([region(0, 0, 1, 1)])[0, 3:6], 0)


def test_the_validation_frames_are_those_that_were_copied_and_checked():
    # Against the training frames of the same split: none is in both, and together they are all 7,481.
    frames = protocol_frames(Protocol.KITTI_VAL)
    digest = hashlib.sha256("\n".join(frames).encode()).hexdigest()
    assert digest == "657ac4bcc1e156e5b106a4ca18e1f88e012787ea1d2b5d0adeea97fee903fa86"
