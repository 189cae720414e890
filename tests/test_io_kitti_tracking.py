"""KITTI's tracking files: what is read, written and refused."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from kitti_objects import car

from jaxbox import io
from jaxbox.types import Calibration

LINE = "Car 0 0 1.85 387.63 181.54 423.81 203.12 1.67 1.87 3.69 -16.53 2.39 58.49 1.57"
DONT_CARE = "DontCare -1 -1 -10 219 188 245 218 -1000 -1000 -1000 -10 -1 -1 -1"
DETECTION = (
    "0,2,298.3125,165.18,458.2292,293.4391,8.2981,1.9605,1.8137,4.7549,-4.572,1.8435,13.53,-2.1125,-1.78"
)


def write(path, text):
    path.write_text(text)
    return path


def tracked(frame, track_id, **changes):
    return car(frame=frame, track_id=track_id, **changes)


def same(a, b):
    assert len(a) == len(b)
    for x, y in zip(a, b, strict=True):
        for field in dataclasses.fields(x):
            np.testing.assert_equal(getattr(x, field.name), getattr(y, field.name), err_msg=field.name)


def test_tracks_have_frame_identity_and_perhaps_a_score(tmp_path):
    text = f"0 -1 {DONT_CARE}\n0 -1 {DONT_CARE}\n\n0 3 {LINE}\n7 3 {LINE} -2.5\n"
    region, again, label, result = io.read_tracks(write(tmp_path / "a.txt", text))
    assert region.is_dont_care
    assert again.is_dont_care
    assert (region.frame, region.track_id) == (0, -1)
    assert (label.frame, label.track_id, label.score) == (0, 3, None)
    assert (result.frame, result.track_id, result.score) == (7, 3, -2.5)
    assert (label.length, label.width, label.height) == (3.69, 1.87, 1.67)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (LINE, r"a\.txt, line 3: has no frame and track id"),
        (f"4 1 {LINE}", r"line 3: track id 1 is in frame 4 already \(line 1\)"),
        (f"-1 1 {LINE}", r"line 3: frame -1, track id 1; frames are from 0"),
        (f"4 -2 {LINE}", r"line 3: frame 4, track id -2"),
        (f"4 1.5 {LINE}", r"line 3: track id is '1.5'; it must be a whole number"),
        (f"4 2 {LINE} 1 2", r"line 3: 19 columns"),
        (f"4 2 {LINE.replace('58.49', 'nan')}", r"line 3: z is 'nan'"),
    ],
)
def test_bad_lines_are_named(tmp_path, line, message):
    with pytest.raises(io.InputError, match=message):
        io.read_tracks(write(tmp_path / "a.txt", f"4 1 {LINE}\n5 1 {LINE}\n{line}\n"))


def test_results_are_written_by_frame_and_identity_with_18_columns(tmp_path):
    rows = [tracked(10, 0, score=0.5), tracked(2, 7, score=0.25), tracked(2, 1, score=0.125)]
    io.write_tracks(tmp_path / "out" / "0000.txt", rows)
    lines = [line.split() for line in (tmp_path / "out" / "0000.txt").read_text().splitlines()]
    assert [line[:3] for line in lines] == [["2", "1", "Car"], ["2", "7", "Car"], ["10", "0", "Car"]]
    assert {len(line) for line in lines} == {18}
    assert [line[17] for line in lines] == ["0.125", "0.25", "0.5"]
    same(io.read_tracks(tmp_path / "out" / "0000.txt"), [rows[2], rows[1], rows[0]])


def test_labels_are_written_with_17_columns_and_regions_as_often_as_there_are(tmp_path):
    region = tracked(0, -1, type="DontCare")
    io.write_tracks(tmp_path / "a.txt", [tracked(0, 4), region, dataclasses.replace(region, track_id=None)])
    lines = (tmp_path / "a.txt").read_text().splitlines()
    assert [line.split()[:3] for line in lines] == [["0", "-1", "DontCare"]] * 2 + [["0", "4", "Car"]]
    assert {len(line.split()) for line in lines} == {17}


def test_no_tracks_make_an_empty_file(tmp_path):
    io.write_tracks(tmp_path / "a.txt", [])
    assert io.read_tracks(tmp_path / "a.txt") == []


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([tracked(0, 1), tracked(0, 1)], "track id 1 is twice in frame 0"),
        ([tracked(0, 1, score=0.5), tracked(0, 2)], "some objects have a score"),
        ([tracked(None, 1)], "frame is None"),
        ([tracked(-1, 1)], "frame is -1"),
        ([tracked(0, 1, alpha=np.nan)], "not finite"),
    ],
)
def test_what_no_reader_would_take_is_not_written(tmp_path, rows, message):
    with pytest.raises(ValueError, match=message):
        io.write_tracks(tmp_path / "a.txt", rows)
    assert not (tmp_path / "a.txt").exists()


def test_real_labels_survive_writing_and_reading(data_root, tmp_path):
    folder = data_root / "kitti_tracking_boxes/training/label_02"
    read = io.read_track_folder(folder)
    assert list(read) == ["0000", "0002", "0003", "0004", "0005", "0007", "0009", "0011", "0017", "0020"]
    assert sum(map(len, read.values())) == 31985
    for name in ("0000", "0017"):
        io.write_tracks(tmp_path / "a.txt", read[name])
        ordered = sorted(read[name], key=lambda item: (item.frame, item.track_id))
        same(io.read_tracks(tmp_path / "a.txt"), ordered)


def test_a_folder_without_files_is_named(tmp_path):
    with pytest.raises(io.InputError, match=r"no \.txt files there"):
        io.read_track_folder(tmp_path)


def test_detections_are_read_in_the_order_of_their_columns(tmp_path):
    text = f"\n{DETECTION}\n12{DETECTION[1:]}\n"
    first, second = io.read_track_detections(write(tmp_path / "a.txt", text))
    assert (first.frame, second.frame, first.track_id, first.type) == (0, 12, None, "Car")
    np.testing.assert_array_equal(first.box_px, [298.3125, 165.18, 458.2292, 293.4391])
    assert (first.score, first.height, first.width, first.length) == (8.2981, 1.9605, 1.8137, 4.7549)
    np.testing.assert_array_equal(first.location, [-4.572, 1.8435, 13.53])
    assert (first.rotation_y, first.alpha) == (-2.1125, -1.78)


def test_real_detections_lie_on_their_labels(data_root):
    root = data_root / "kitti_tracking_boxes/training"
    labels = io.objects_by_frame(io.read_tracks(root / "label_02/0000.txt"))[0]
    (label,) = [item for item in labels if item.track_id == 0]
    found = io.objects_by_frame(io.read_track_detections(root / "det_pointrcnn_Car/0000.txt"))[0]
    best = max(found, key=lambda item: item.score)
    np.testing.assert_allclose(best.location, label.location, atol=0.2)
    np.testing.assert_allclose(best.box_px, label.box_px, atol=5)
    assert abs(best.rotation_y - label.rotation_y) < 0.05
    assert abs(best.length - label.length) < 0.5


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (DETECTION.replace(",", " "), "a.txt, line 2: 1 columns with commas between; expected 15"),
        (DETECTION + ",1", "line 2: 16 columns"),
        (
            DETECTION.replace("0,2,", "0,4,", 1),
            "line 2: type is 4; known are 1 Pedestrian, 2 Car",
        ),
        (DETECTION.replace("8.2981", "inf"), "line 2: score is 'inf'"),
        (DETECTION.replace("0,2,", "0.5,2,", 1), "line 2: frame is '0.5'"),
        ("-1" + DETECTION[1:], "line 2: frame is -1"),
    ],
)
def test_bad_detections_are_named(tmp_path, line, message):
    with pytest.raises(io.InputError, match=message):
        io.read_track_detections(write(tmp_path / "a.txt", f"{DETECTION}\n{line}\n"))


def test_objects_are_sorted_into_their_frames():
    rows = [tracked(3, 1), tracked(0, 2), tracked(3, 0)]
    frames = io.objects_by_frame(rows)
    ids = {frame: [item.track_id for item in items] for frame, items in frames.items()}
    assert ids == {3: [1, 0], 0: [2]}


def some_calibration():
    return Calibration(
        P_rect=jnp.array([[700.0, 0, 600, 40], [0, 700, 180, 0], [0, 0, 1, 0]]),
        T_rect_velo=jnp.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.1], [1, 0, 0, -0.3], [0, 0, 0, 1]]),
        image_size_px=jnp.array([1242, 375], jnp.int32),
    )


def test_tracks_become_objects_and_their_headings_come_back(tmp_path):
    headings = np.array([0.1, 3.0, -3.0, -1.5, 1.6])
    boxes = np.tile([20.0, 0, -0.9, 4.0, 1.8, 1.5, 0.0], (6, 1))
    boxes[:5, 1], boxes[:5, 6], boxes[5, 0] = np.arange(-4, 6, 2), headings, -20
    ids, scores = np.array([5, 3, 8, 1, 0, 9]), np.linspace(0.9, 0.4, 6)
    objects = io.objects_from_tracks(
        boxes, scores, ids, some_calibration(), frame=4, types=["Car"] * 5 + ["Van"]
    )
    # The one behind the camera is no result.
    assert [item.track_id for item in objects] == [5, 3, 8, 1, 0]
    assert {(item.frame, item.truncation, item.occlusion) for item in objects} == {(4, -1.0, -1)}
    io.write_tracks(tmp_path / "0000.txt", objects)
    read = sorted(io.read_tracks(tmp_path / "0000.txt"), key=lambda item: -item.score)
    center, size, yaw = io.boxes_from_objects(read, some_calibration(), keep_heading=True)
    np.testing.assert_allclose(np.column_stack([center, size]), boxes[:5, :6], atol=1e-5)
    np.testing.assert_allclose(np.exp(1j * yaw), np.exp(1j * headings), atol=1e-5)
    # Without headings the same boxes have their axes alone.
    axes = io.boxes_from_objects(read, some_calibration())[2]
    np.testing.assert_allclose(np.exp(2j * axes), np.exp(2j * headings), atol=1e-5)
    assert np.all(np.abs(axes) <= np.pi / 2)


def test_no_tracks_become_no_objects():
    none = io.objects_from_tracks(np.zeros((0, 7)), [], [], some_calibration(), frame=0, types=[])
    assert none == []
