"""HOTA, CLEAR and identity against trackeval, detection figures by hand, and the report of a folder."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from kitti_objects import car
from trackeval_oracle import assert_same, measured, of_comparison, of_files, shuffled
from typer.testing import CliRunner

from jaxbox import io
from jaxbox.cli import app
from jaxbox.evaluation import tracking
from jaxbox.evaluation.tracking import FrameBoxes, FrameTruth, TruthSequence
from jaxbox.evaluation.tracking.protocol import is_excused, kept_results
from jaxbox.types import Calibration

NO_REGIONS = np.zeros((0, 4))
BOXES = "kitti_tracking_boxes/training"


def random_comparison(seed, *, num_frames=12, truth=True, found=True):
    """Objects on a line that come and go, with results that drift, swap identities and go missing."""
    rng = np.random.default_rng(seed)
    num, extra = (int(rng.integers(1, 6)) if truth else 0), int(rng.integers(1, 4)) if found else 0
    start, speed = rng.uniform(0, 40, num), rng.normal(0, 0.4, num)
    true_ids, ids, overlaps = [], [], []
    names = rng.permutation(50)[: num + extra]
    for frame in range(num_frames):
        if rng.random() < 0.1:
            names = rng.permutation(names)
        here = np.flatnonzero(rng.random(num) < 0.8)
        seen = np.flatnonzero(rng.random(num) < 0.8) if found else np.zeros(0, int)
        place = start + speed * frame
        alarms = rng.uniform(0, 40, int(rng.integers(0, extra + 1)))
        position = np.concatenate([place[seen] + rng.normal(0, 0.3, len(seen)), alarms])
        name = np.concatenate([names[seen], names[num : num + len(alarms)]]).astype(int)
        gap = np.abs(place[here][:, None] - position[None])
        true_ids.append(here * 7 + 3)
        ids.append(name)
        overlaps.append(np.maximum(1 - gap, 0) / (1 + gap))
    return tracking.Comparison.of(true_ids, ids, overlaps)


@pytest.mark.parametrize("seed", range(40))
def test_overlaps_give_the_figures_of_trackeval(seed):
    sequences = {name: random_comparison((seed, index)) for index, name in enumerate(("a", "b", "c"))}
    each, together = measured({name: of_comparison(item) for name, item in sequences.items()})
    ours = tracking.measure_tracks(sequences)
    assert_same(ours, together)
    for name, theirs in each.items():
        assert_same(ours["by_sequence"][name], theirs)


@pytest.mark.parametrize(("truth", "found"), [(True, False), (False, True), (False, False)])
def test_a_sequence_without_results_or_truth_gives_the_figures_of_trackeval(truth, found):
    empty = random_comparison(1, truth=truth, found=found)
    assert (sum(map(len, empty.true_ids)) > 0, sum(map(len, empty.ids)) > 0) == (truth, found)
    for sequences in ({"a": empty}, {"a": empty, "b": random_comparison(2)}):
        each, together = measured({name: of_comparison(item) for name, item in sequences.items()})
        ours = tracking.measure_tracks(sequences)
        assert_same(ours, together)
        # Of one sequence without truth trackeval says 0, of several such together minus the false ones.
        assert_same(ours["by_sequence"]["a"], each["a"], but=() if truth else ("mota",))


def test_without_frames_every_figure_is_zero_and_the_overlap_of_matches_one():
    ours = tracking.measure_tracks({"a": tracking.Comparison.of([], [], [])})
    assert ours["hota"]["hota"] == ours["clear"]["mota"] == ours["identity"]["idf1"] == 0
    assert ours["hota"]["loc_a"] == 1
    with pytest.raises(ValueError, match="no sequence"):
        tracking.measure_tracks({})


def test_an_identity_twice_in_a_frame_is_refused():
    with pytest.raises(ValueError, match="results: frame 1 has an identity twice"):
        tracking.Comparison.of([[1], [1]], [[1], [2, 2]], [np.ones((1, 1)), np.ones((1, 2))])


def random_objects(seed, *, num_frames=10):
    """Random labels and results of one sequence in the image, with every role that the protocol knows."""
    rng = np.random.default_rng(seed)
    types = ["Car", "Van", "Truck", "Pedestrian", "Person", "Cyclist"]
    labels, results = [], []
    num = int(rng.integers(2, 8))
    kinds, corner = rng.choice(types, num), rng.uniform(50, 500, (num, 2))
    kinds[:2] = "Car", "Pedestrian"
    size = rng.uniform(20, 60, (num, 2))
    for frame in range(num_frames):
        if rng.random() < 0.2:
            continue
        for track_id in range(num):
            box = np.concatenate([corner[track_id], corner[track_id] + size[track_id]]) + 3.25 * frame
            if rng.random() < 0.8:
                hidden, cut = int(rng.choice([0, 1, 2, 3])), float(rng.choice([0, 0, 0, 1, 2]))
                labels.append(at(box, kinds[track_id], frame, track_id, occlusion=hidden, truncation=cut))
            if rng.random() < 0.8:
                kind = kinds[track_id] if rng.random() < 0.7 else rng.choice(types)
                name = track_id if rng.random() < 0.9 else track_id + 20
                moved = box + rng.normal(0, 4, 4)
                results.append(at(moved, kind, frame, name, score=float(rng.random())))
        for index in range(int(rng.integers(0, 3))):
            low = rng.uniform(50, 500, 2)
            results.append(at([*low, *(low + rng.uniform(10, 60, 2))], "Car", frame, 50 + index, score=0.5))
            labels.append(at([*low, *(low + 30)], "DontCare", frame, -1, occlusion=-1, truncation=-1.0))
    return labels, results


def at(box, kind, frame, track_id, **changes):
    return car(type=str(kind), box_px=np.array(box, float), frame=frame, track_id=track_id, **changes)


def in_frames(objects, num_frames):
    frames = io.objects_by_frame(objects)
    return [frames.get(frame, ()) for frame in range(num_frames)]


def compared(labels, results, class_name):
    """As `compare_in_image`, of objects by sequence."""
    spans = {name: 1 + max([i.frame for i in [*labels[name], *results[name]]], default=-1) for name in labels}
    return {
        name: tracking.compare_in_image(
            in_frames(labels[name], span), in_frames(results[name], span), class_name=class_name
        )
        for name, span in spans.items()
    }


def assert_trackeval_says_the_same(folder, labels, results, class_name="Car"):
    each, together = measured(of_files(folder, labels, results, class_name))
    ours = tracking.measure_tracks(compared(labels, results, class_name))
    assert_same(ours, together)
    for name, theirs in each.items():
        no_truth = ours["by_sequence"][name]["clear"]["num_labels"] == 0
        assert_same(ours["by_sequence"][name], theirs, but=("mota",) if no_truth else ())
    return ours


@pytest.mark.parametrize("class_name", ["Car", "Pedestrian"])
@pytest.mark.parametrize("seed", range(12))
def test_the_protocol_in_the_image_is_that_of_trackeval(tmp_path, seed, class_name):
    labels, results = {}, {}
    for index, name in enumerate(("0000", "0001", "0002")):
        labels[name], results[name] = random_objects((seed, index))
    ours = assert_trackeval_says_the_same(tmp_path, labels, results, class_name)
    assert ours["clear"]["num_boxes"] > 0


def test_empty_files_give_the_figures_of_trackeval(tmp_path):
    labels, results = random_objects(3)
    full, none = {"0000": labels, "0001": labels}, {"0000": results, "0001": []}
    assert_trackeval_says_the_same(tmp_path / "results", full, none)
    assert_trackeval_says_the_same(tmp_path / "truth", {"0000": labels, "0001": []}, {"0000": results} | none)


def perturbed(labels, rng):
    """Labels as a tracker would have them: moved, sometimes missing, with switches and false alarms."""
    tracks = []
    for item in labels:
        if item.is_dont_care or rng.random() < 0.1:
            continue
        kind = item.type if rng.random() < 0.9 else "Car"
        box = item.box_px + rng.normal(0, 0.08, 4) * (item.box_px[3] - item.box_px[1])
        name = item.track_id + 100 * int(rng.random() < 0.05)
        score = float(rng.random())
        tracks.append(dataclasses.replace(item, type=kind, box_px=box, track_id=name, score=score))
    return list({(item.frame, item.track_id): item for item in tracks}.values())


@pytest.mark.parametrize("class_name", ["Car", "Pedestrian"])
def test_real_labels_with_perturbed_tracks_give_the_figures_of_trackeval(data_root, tmp_path, class_name):
    rng = np.random.default_rng(0)
    labels = {
        name: io.read_tracks(data_root / BOXES / "label_02" / f"{name}.txt")
        for name in ("0000", "0003", "0005", "0017")
    }
    results = {name: perturbed(items, rng) for name, items in labels.items()}
    ours = assert_trackeval_says_the_same(tmp_path, labels, results, class_name)
    assert 0.3 < ours["hota"]["hota"] < 0.95


def near_tracks(detections):
    """A tracker of one rule: a detection goes on with the nearest track of the frame before."""
    tracks, before, next_id = [], [], 0
    for frame in sorted(detections):
        here, taken = [], set()
        for item in sorted(detections[frame], key=lambda item: -item.score):
            free = [old for old in before if old.track_id not in taken]
            gap = [float(np.linalg.norm(old.location - item.location)) for old in free]
            near = int(np.argmin(gap)) if gap and min(gap) < 3 else None
            name = next_id if near is None else free[near].track_id
            next_id += near is None
            taken.add(name)
            here.append(dataclasses.replace(item, track_id=name))
        before = here
        tracks += here
    return tracks


def test_tracks_of_real_detections_give_the_figures_of_trackeval(data_root, tmp_path):
    names = ("0000", "0003", "0004")
    labels, results = {}, {}
    for name in names:
        labels[name] = io.read_tracks(data_root / BOXES / "label_02" / f"{name}.txt")
        found = io.read_track_detections(data_root / BOXES / "det_pointrcnn_Car" / f"{name}.txt")
        results[name] = near_tracks(io.objects_by_frame([item for item in found if item.score > 0]))
    ours = assert_trackeval_says_the_same(tmp_path, labels, results)
    assert ours["hota"]["hota"] > 0.5


def test_order_and_names_of_identities_change_nothing(tmp_path):
    labels, results = random_objects(5)
    rng = np.random.default_rng(0)
    before = tracking.measure_tracks(compared({"a": labels}, {"a": results}, "Car"))
    after = tracking.measure_tracks(
        compared({"a": shuffled(labels, rng)}, {"a": shuffled(results, rng)}, "Car")
    )
    for key in ("mota", "idsw", "frag", "mt", "fp"):
        assert after["clear"][key] == pytest.approx(before["clear"][key], abs=1e-12)
    assert after["hota"]["hota"] == pytest.approx(before["hota"]["hota"], abs=1e-12)
    assert after["identity"] == before["identity"]


def test_a_class_without_a_protocol_is_refused():
    with pytest.raises(ValueError, match="class 'Van' has no tracking protocol"):
        tracking.compare_in_image([], [], class_name="Van")


@pytest.mark.parametrize(("height", "expected"), [(24.9, True), (25.0, True), (25.1, False)])
def test_a_low_box_is_excused(height, expected):
    assert is_excused(np.array([[0, 0, 40, height]]), NO_REGIONS).tolist() == [expected]


@pytest.mark.parametrize(("right", "expected"), [(50, False), (51, True)])
def test_a_box_is_excused_where_more_than_half_of_it_is_in_one_region(right, expected):
    box = np.array([[0.0, 0, 100, 100]])
    assert is_excused(box, np.array([[0.0, 0, right, 100]])).tolist() == [expected]
    halves = np.array([[0.0, 0, 50, 100], [50, 0, 100, 100]])
    assert is_excused(box, halves).tolist() == [False]


def test_what_matches_a_distractor_is_removed_and_what_matches_a_label_stays_though_excused():
    overlap = np.array([[0.6, 0.0, 0.0], [0.0, 0.6, 0.0]])
    excused = np.array([False, True, True])
    assert kept_results(overlap, np.array([False, True]), excused).tolist() == [False, True, False]
    # Half is enough, a little less is not.
    assert kept_results(np.array([[0.5]]), np.array([False]), np.array([False])).tolist() == [False]
    assert kept_results(np.array([[0.499]]), np.array([False]), np.array([False])).tolist() == [True]


# Boxes.


def vehicle(x, y=0.0, *, yaw=0.0):
    return [x, y, 0.0, 4.0, 2.0, 1.5, yaw]


def truth_of(*rows, counts=None, **more):
    boxes = np.array(rows, float).reshape(-1, 7)
    counts = np.ones(len(boxes), bool) if counts is None else np.array(counts)
    return FrameTruth(boxes, np.arange(len(boxes)), counts, NO_REGIONS, **more)


def found_of(*rows, scores=None, **more):
    boxes = np.array(rows, float).reshape(-1, 7)
    scores = np.linspace(0.9, 0.5, len(boxes)) if scores is None else np.array(scores)
    return FrameBoxes(boxes, scores, **({"ids": np.arange(len(boxes))} | more))


def curve_of(truth, found, *, metric="bev", min_overlap=0.5):
    judged = tracking.judge_sequences({"a": TruthSequence([truth])}, {"a": [found]})
    return tracking.detection_curve(judged["a"], metric=metric, min_overlap=min_overlap)


def test_precision_over_recall_by_hand():
    truth = truth_of(vehicle(10), vehicle(20), vehicle(30), vehicle(40))
    found = found_of(vehicle(10), vehicle(60), vehicle(20), vehicle(30), scores=[0.9, 0.8, 0.7, 0.6])
    curve = curve_of(truth, found)
    np.testing.assert_allclose(curve.recall, [0.25, 0.25, 0.5, 0.75])
    np.testing.assert_allclose(curve.precision, [1, 1 / 2, 2 / 3, 3 / 4])
    # The best precision from recall 0 to .25 is 1, to .75 it is 3/4, and there is none beyond.
    assert curve.average_precision == pytest.approx((10 * 1 + 20 * 0.75) / 40)
    assert (curve.recall_at(0.9), curve.recall_at(0.7), curve.max_recall) == (0.25, 0.75, 0.75)
    assert curve.recall_at(1.1) == 0


def test_boxes_of_one_score_come_in_together():
    truth = truth_of(vehicle(10), vehicle(20))
    right, wrong = vehicle(10), vehicle(60)
    for rows in ((right, wrong), (wrong, right)):
        curve = curve_of(truth, found_of(*rows, scores=[0.5, 0.5]))
        assert (curve.recall.tolist(), curve.precision.tolist()) == ([0.5], [0.5])
        assert curve.recall_at(0.9) == 0


def test_the_better_score_takes_the_object_and_the_other_is_false():
    found = found_of(vehicle(10.4), vehicle(10.0), scores=[0.9, 0.8])
    curve = curve_of(truth_of(vehicle(10)), found)
    assert (curve.num_boxes, curve.precision.tolist()) == (2, [1.0, 0.5])


def test_one_box_of_an_ignored_object_is_left_out_and_a_second_is_wrong():
    truth = truth_of(vehicle(10), vehicle(20), counts=[True, False])
    curve = curve_of(truth, found_of(vehicle(10), vehicle(20), vehicle(50)))
    assert (curve.num_labels, curve.num_boxes, curve.max_recall) == (1, 2, 1.0)
    curve = curve_of(truth, found_of(vehicle(10), vehicle(20), vehicle(20.2), vehicle(50)))
    assert curve.num_boxes == 3


def test_an_object_that_counts_goes_before_an_ignored_one_of_better_overlap():
    truth = truth_of(vehicle(10), vehicle(10.8), counts=[True, False])
    assert curve_of(truth, found_of(vehicle(10.6))).max_recall == 1


def test_3d_overlap_looks_at_the_height():
    high = vehicle(10)
    high[2] = 1.0
    assert curve_of(truth_of(vehicle(10)), found_of(high), metric="bev").max_recall == 1
    assert curve_of(truth_of(vehicle(10)), found_of(high), metric="3d").max_recall == 0


def test_without_boxes_or_objects_there_are_no_figures_to_divide():
    assert curve_of(truth_of(vehicle(10)), found_of()).to_dict()["ap_r40"] == 0
    nothing = curve_of(truth_of(), found_of(vehicle(10))).to_dict()
    assert (nothing["ap_r40"], nothing["max_recall"], nothing["recall_at_90"]) == (None, None, None)
    assert nothing["num_boxes"] == 1


CAMERA = Calibration(
    P_rect=jnp.array([[700.0, 0, 621, 0], [0, 700, 187, 0], [0, 0, 1, 0]]),
    T_rect_velo=jnp.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
    image_size_px=jnp.array([1242, 375], jnp.int32),
)
"""Looks along x of the sensor frame."""


@pytest.mark.parametrize(
    ("box", "regions", "num_false"),
    [
        (vehicle(20), NO_REGIONS, 1),
        (vehicle(-20), NO_REGIONS, 0),  # Behind the camera.
        (vehicle(20, 40), NO_REGIONS, 0),  # Beside the image.
        (vehicle(60), NO_REGIONS, 0),  # 18 px high.
        (vehicle(20), np.array([[500.0, 0, 700, 374]]), 0),
        (vehicle(20), np.array([[622.0, 0, 700, 374]]), 1),  # Less than half of it.
    ],
)
def test_what_the_camera_cannot_have_labelled_is_neither_right_nor_wrong(box, regions, num_false):
    truth = dataclasses.replace(truth_of(vehicle(30, 5)), dont_care_px=regions)
    report = tracking.evaluate_boxes(
        {"a": TruthSequence([truth], CAMERA)}, {"a": [found_of(vehicle(30, 5), box)]}
    )
    assert report["tracks"]["bev"]["clear"]["fp"] == num_false
    assert report["detection"]["bev_0.5"]["num_boxes"] == 1 + num_false
    assert report["detection"]["bev_0.5"]["max_recall"] == 1
    # A matched one counts wherever it is.
    matched = dataclasses.replace(truth_of(box), dont_care_px=regions)
    report = tracking.evaluate_boxes({"a": TruthSequence([matched], CAMERA)}, {"a": [found_of(box)]})
    assert report["tracks"]["3d"]["clear"]["tp"] == 1


def test_all_round_truth_excuses_nothing():
    report = tracking.evaluate_boxes({"a": TruthSequence([truth_of()])}, {"a": [found_of(vehicle(-20))]})
    assert report["tracks"]["bev"]["clear"]["fp"] == 1


def drive(num_frames, *, switch=False):
    """Two vehicles side by side, found at their places; their identities change in the middle on demand."""
    truth, found = [], []
    for frame in range(num_frames):
        rows = [vehicle(10 + frame), vehicle(10 + frame, 5)]
        ids = np.array([4, 9]) if switch and frame >= num_frames // 2 else np.array([9, 4])
        truth.append(truth_of(*rows))
        found.append(found_of(*rows, ids=ids))
    return truth, found


def test_perfect_tracks_have_every_figure_at_its_best():
    truth, found = drive(6)
    report = tracking.evaluate_boxes({"a": TruthSequence(truth)}, {"a": found})
    for part in report["tracks"].values():
        assert part["hota"]["hota"] == pytest.approx(1)
        assert part["clear"]["mota"] == part["identity"]["idf1"] == 1
        assert (part["clear"]["idsw"], part["clear"]["mt"]) == (0, 2)
    assert report["detection"]["3d_0.7"]["ap_r40"] == 1


def test_a_switch_costs_association_and_not_detection():
    truth, found = drive(6, switch=True)
    part = tracking.evaluate_boxes({"a": TruthSequence(truth)}, {"a": found})["tracks"]["bev"]
    assert part["clear"]["idsw"] == 2
    assert part["hota"]["det_a"] == pytest.approx(1)
    # Each match shares 3 of the 9 frames of its label and its track.
    assert part["hota"]["ass_a"] == pytest.approx(1 / 3)
    assert part["identity"]["idf1"] == pytest.approx(0.5)


def test_single_boxes_have_detection_figures_alone():
    truth, found = drive(4)
    single = [dataclasses.replace(frame, ids=None) for frame in found]
    report = tracking.evaluate_boxes({"a": TruthSequence(truth)}, {"a": single})
    assert report["tracks"] is None
    assert report["detection"]["bev_0.5"]["ap_r40"] == 1
    judged = tracking.judge_sequences({"a": TruthSequence(truth)}, {"a": single})
    with pytest.raises(ValueError, match="no identities"):
        tracking.compare_boxes(judged["a"], metric="bev")


def test_boxes_of_the_same_tracks_give_the_figures_of_trackeval():
    rng = np.random.default_rng(0)
    truth, found = [], []
    for frame in range(30):
        rows = np.array([vehicle(10 + frame, 4 * lane) for lane in range(4)])
        truth.append(truth_of(*rows, counts=[True, True, True, False]))
        moved = rows + rng.normal(0, 0.15, rows.shape) * [1, 1, 1, 1, 1, 1, 0]
        kept = rng.random(4) < 0.8
        ids = np.where(rng.random(4) < 0.1, np.arange(4) + 10, np.arange(4))
        found.append(FrameBoxes(moved[kept], np.ones(kept.sum()), ids[kept]))
    judged = tracking.judge_sequences({"a": TruthSequence(truth)}, {"a": found})
    for metric in ("bev", "3d"):
        comparison = tracking.compare_boxes(judged["a"], metric=metric)
        _, together = measured({"a": of_comparison(comparison)})
        ours = tracking.measure_tracks({"a": comparison})
        assert_same(ours, together)
        assert ours["clear"]["num_labels"] == 90
        assert 0.3 < ours["hota"]["hota"] < 0.9


def test_lower_scores_are_left_out_of_the_tracks_and_not_of_the_detections():
    truth, found = drive(4)
    report = tracking.evaluate_boxes({"a": TruthSequence(truth)}, {"a": found}, min_score=0.7)
    assert report["tracks"]["bev"]["clear"]["recall"] == 0.5
    assert report["detection"]["bev_0.5"]["max_recall"] == 1


@pytest.mark.parametrize(
    ("results", "message"),
    [({}, "sequence a has no results"), ({"a": []}, "sequence a has 4 frames of truth and 0 of results")],
)
def test_results_of_other_sequences_or_frames_are_refused(results, message):
    with pytest.raises(ValueError, match=message):
        tracking.evaluate_boxes({"a": TruthSequence(drive(4)[0])}, results)


def test_rows_that_do_not_belong_together_are_refused():
    with pytest.raises(ValueError, match="scores has 2 rows and boxes 1"):
        found_of(vehicle(1), scores=[0.5, 0.5])
    with pytest.raises(ValueError, match="not finite"):
        found_of(vehicle(np.nan))
    with pytest.raises(ValueError, match="a score is not finite"):
        found_of(vehicle(1), scores=[np.nan])
    with pytest.raises(ValueError, match=r"must be \(n, 7\)"):
        FrameBoxes(np.zeros((1, 6)), np.zeros(1))


# Motion.


def motion_of(truth, found, **options):
    judged = tracking.judge_sequences({"a": TruthSequence([truth])}, {"a": [found]})
    return tracking.motion_errors(judged["a"], **options).to_dict()


def test_velocity_errors_are_of_moving_and_standing_objects_apart():
    rows = [vehicle(10 * k) for k in range(1, 6)]
    true = np.array([[10.0, 0], [1.1, 0], [0.9, 0], [0, 0], [np.nan, 0]])
    wrong = true + np.array([[0.3, 0.4], [0, 0.1], [0.2, 0], [0, 0.4], [0, 0]])
    errors = motion_of(truth_of(*rows, velocities=true), found_of(*rows, velocities=wrong))
    assert errors["velocity_moving"]["num"] == errors["velocity_standing"]["num"] == 2
    assert errors["velocity_moving"]["median"] == pytest.approx(0.3)
    assert errors["velocity_moving"]["p90"] == pytest.approx(0.1 + 0.9 * 0.4)
    assert errors["velocity_standing"]["median"] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("turn_deg", "half", "tenth"), [(9.9, 1, 1), (10.1, 1, 0), (89.9, 1, 0), (90.1, 0, 0), (180, 0, 0)]
)
@pytest.mark.parametrize("sign", [-1, 1])
def test_headings_are_compared_over_the_whole_turn(turn_deg, half, tenth, sign):
    turned = vehicle(10, yaw=3.0 + sign * np.radians(turn_deg))
    headings = motion_of(truth_of(vehicle(10, yaw=3.0)), found_of(turned))["headings"]
    assert (headings["num"], headings["within_90_deg"], headings["within_10_deg"]) == (1, half, tenth)


def test_the_confusion_of_states_has_the_truth_in_its_rows():
    rows = [vehicle(10 * k) for k in range(1, 5)]
    truth = truth_of(*rows, states=np.array([0, 2, 2, -1]))
    states = motion_of(truth, found_of(*rows, states=np.array([0, 2, 5, 1])))["states"]
    expected = np.zeros((6, 6), int)
    expected[0, 0], expected[2, 2], expected[2, 5] = 1, 1, 1
    assert states["confusion"] == expected.tolist()
    assert (states["num"], states["right"]) == (3, pytest.approx(2 / 3))
    with pytest.raises(ValueError, match="state 5 is beyond the 3 states"):
        motion_of(truth, found_of(*rows, states=np.array([0, 2, 5, 1])), num_states=3)


def test_motion_of_what_was_not_found_is_not_compared():
    errors = motion_of(truth_of(vehicle(10)), found_of(vehicle(30)))
    assert errors["headings"] == {"num": 0, "within_90_deg": None, "within_10_deg": None}
    assert errors["velocity_moving"] == {"num": 0, "median": None, "p90": None}


# Folders.


@pytest.fixture
def folder(data_root, tmp_path):
    """Two cut sequences with labels, calibration and perturbed results."""
    rng = np.random.default_rng(0)
    for name in ("0000", "0003"):
        root = data_root / "kitti_tracking/training"
        labels = io.read_tracks(root / "label_02" / f"{name}.txt")
        io.write_tracks(tmp_path / "truth" / "label_02" / f"{name}.txt", labels)
        calibration = (root / "calib" / f"{name}.txt").read_text()
        (tmp_path / "truth" / "calib").mkdir(exist_ok=True)
        (tmp_path / "truth" / "calib" / f"{name}.txt").write_text(calibration)
        io.write_tracks(tmp_path / "results" / f"{name}.txt", perturbed(labels, rng))
    return tmp_path


def test_labels_against_themselves_are_perfect(folder, data_root):
    truth = folder / "truth"
    report = tracking.evaluate_tracking_folders(truth, truth / "label_02")
    assert report["frames"] == {"0000": [0, 47], "0003": [0, 44]}
    assert report["kitti"]["Car"]["hota"]["hota"] == pytest.approx(1)
    for part in report["vehicle"]["tracks"].values():
        assert part["clear"]["mota"] == 1
        assert part["hota"]["hota"] == pytest.approx(1, abs=1e-4)
    assert report["vehicle"]["detection"]["3d_0.7"]["ap_r40"] == 1
    assert report["vehicle"]["motion"]["headings"]["within_10_deg"] == 1
    # Vans count as vehicles, though no car is labelled in this drive.
    assert report["kitti"]["Car"]["by_sequence"]["0000"]["clear"]["num_labels"] == 0
    assert report["vehicle"]["tracks"]["bev"]["by_sequence"]["0000"]["clear"]["num_labels"] > 50
    json.dumps(report, allow_nan=False)


def test_chosen_frames_are_those_of_shorter_files(folder):
    report = tracking.evaluate_tracking_folders(
        folder / "truth", folder / "results", frames={"0003": (10, 20)}
    )
    assert report["frames"] == {"0003": [10, 20]}
    for kind, name in (("truth/label_02", "0003"), ("results", "0003")):
        path = folder / kind / f"{name}.txt"
        io.write_tracks(path, [item for item in io.read_tracks(path) if 10 <= item.frame <= 20])
    shorter = tracking.evaluate_tracking_folders(folder / "truth", folder / "results", frames={"0003": None})
    assert shorter["frames"] == {"0003": [0, 20]}
    assert shorter["kitti"] == report["kitti"]
    assert shorter["vehicle"]["tracks"] == report["vehicle"]["tracks"]
    assert shorter["vehicle"]["detection"] == report["vehicle"]["detection"]


def test_labels_after_the_last_result_count_as_missed_and_are_named(folder):
    path = folder / "results" / "0003.txt"
    io.write_tracks(path, [item for item in io.read_tracks(path) if item.frame <= 20])
    whole = tracking.evaluate_tracking_folders(folder / "truth", folder / "results")
    assert whole["unfinished"] == {"0003": 20}
    cut = tracking.evaluate_tracking_folders(folder / "truth", folder / "results", frames={"0003": (0, 20)})
    assert cut["unfinished"] == {}
    missed = [report["kitti"]["Car"]["by_sequence"]["0003"]["clear"]["fn"] for report in (whole, cut)]
    assert missed[0] > missed[1]


def test_results_after_the_last_label_are_false(folder):
    path = folder / "results" / "0003.txt"
    late = dataclasses.replace(io.read_tracks(path)[-1], frame=60, type="Car")
    before = tracking.evaluate_tracking_folders(folder / "truth", folder / "results")
    io.write_tracks(path, [*io.read_tracks(path), late])
    after = tracking.evaluate_tracking_folders(folder / "truth", folder / "results")
    assert after["frames"]["0003"] == [0, 60]
    false = [report["kitti"]["Car"]["clear"]["fp"] for report in (before, after)]
    assert false[1] == false[0] + 1


def run(*arguments):
    return CliRunner().invoke(app, [str(word) for word in arguments])


def test_the_command_prints_the_tables_and_writes_every_figure(folder):
    report = folder / "report.json"
    result = run(
        "eval", "--tracking", "--labels", folder / "truth", "--results", folder / "results",
        "--frames", "0003:0-44", "--json", report,
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    assert "1 sequences, 45 frames" in result.stdout
    for word in ("KITTI Car, 2D", "bird's-eye view", "vehicle, 3D", "HOTA", "IDSW", "AP R40"):
        assert word in result.stdout
    figures = json.loads(report.read_text())
    expected = tracking.evaluate_tracking_folders(
        folder / "truth", folder / "results", frames={"0003": (0, 44)}
    )
    assert figures == expected
    assert f"{100 * expected['kitti']['Car']['hota']['hota']:.2f}" in result.stdout


def test_the_command_says_which_result_is_missing_and_can_take_it_for_empty(folder):
    (folder / "results" / "0000.txt").unlink()
    arguments = ("eval", "--tracking", "--labels", folder / "truth", "--results", folder / "results")
    result = run(*arguments)
    assert result.exit_code == 2
    assert "no result file for 1 of 2 labelled sequences, the first is 0000.txt" in result.stderr
    result = run(*arguments, "--missing-as-empty")
    assert result.exit_code == 0
    assert "1 sequences without results" in result.stdout


@pytest.mark.parametrize(
    ("change", "options", "reason"),
    [
        ({"type": "Bus"}, (), "results are of type Bus; those that count are Car, Pedestrian, Truck, Van"),
        ({"track_id": -1}, (), "every result has the identity -1, which stands for no track"),
        ({"frame": 50}, ("--frames", "0003:0-44"), "no result is in frames 0 to 44"),
        ({"score": 0.3}, ("--min-score", "0.5"), "no result scores 0.5 or more"),
        ({"type": "van"}, (), None),
    ],
)
def test_where_no_result_counts_the_command_says_why(folder, change, options, reason):
    path = folder / "results" / "0003.txt"
    first = io.read_tracks(path)[0]
    io.write_tracks(path, [dataclasses.replace(first, **change)])
    chosen = ("--labels", folder / "truth", "--results", folder / "results", "--frames", "0003")
    result = run("eval", "--tracking", *(chosen[:4] if options[:1] == ("--frames",) else chosen), *options)
    assert result.exit_code == 0, result.stderr
    assert (f"0003: no result counts: {reason}." in result.stdout) == (reason is not None)
    assert ("no result counts" in result.stdout) == (reason is not None)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--frames", "0003:5"), "give SEQUENCE:FIRST-LAST"),
        (("--frames", "0003:0-4", "--frames", "0003"), "named twice"),
        (("--frames", "0007"), "no labels of sequence 0007; there are 0000, 0003"),
        (("--frames", "0003:0-45"), "the last one with a label or a result is 44"),
        (("--frames", "0003:5-4"), "frames 5 to 4"),
        (("--pictures",), "is for single sweeps"),
        (("--min-score", "nan"), "--min-score is nan; give a finite number"),
    ],
)
def test_options_that_cannot_be_used_end_with_exit_code_2(folder, options, message):
    result = run(
        "eval", "--tracking", "--labels", folder / "truth", "--results", folder / "results", *options
    )
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--frames", "0000"), "--tracking"),
        (("--min-score", "1.5"), "from 0 to 1"),
        (("--min-score", "0.5"), "chooses what --pictures draws"),
    ],
)
def test_options_of_tracks_are_refused_for_single_sweeps(tmp_path, options, message):
    result = run("eval", "--labels", tmp_path, "--results", tmp_path, *options)
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())


def test_a_folder_without_labels_or_calibration_is_named(folder):
    with pytest.raises(io.InputError, match="no label files there"):
        tracking.evaluate_tracking_folders(folder, folder / "results")
    (folder / "truth" / "calib" / "0003.txt").unlink()
    with pytest.raises(io.InputError, match=r"calib/0003\.txt: there is no such file"):
        tracking.evaluate_tracking_folders(folder / "truth", folder / "results")


def test_without_scipy_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "scipy.optimize", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxbox\[track\]'"):
        tracking.measure_tracks({"a": random_comparison(0)})
