"""Argoverse 2, PandaSet and SemanticKITTI: frames, either order of sizes, errors that name the fix."""

import json

import numpy as np
import pytest

from jaxbox import io
from jaxbox.evaluation import count_points_in_boxes
from jaxbox.io import argoverse2, pandaset, semantic_kitti

RECORD = {
    "category": "REGULAR_VEHICLE", "length_m": 4.5, "width_m": 1.9, "height_m": 1.6,
    "qw": np.cos(0.15), "qx": 0.0, "qy": 0.0, "qz": np.sin(0.15), "tx_m": 11.35, "ty_m": -3.0, "tz_m": 0.84,
}  # fmt: skip


def write_json(path, content):
    path.write_text(json.dumps(content))
    return path


def test_argoverse_boxes_move_from_the_rear_axle_to_the_sensor_and_keep_their_turn(tmp_path):
    boxes = argoverse2.read_argoverse2_boxes(write_json(tmp_path / "a.json", [RECORD]))
    np.testing.assert_allclose(boxes.center, [[10.0, -3.0, -0.8]], atol=1e-12)
    np.testing.assert_allclose(boxes.size, [[4.5, 1.9, 1.6]])
    np.testing.assert_allclose(boxes.yaw, [0.3], atol=1e-12)
    assert boxes.class_names == ("REGULAR_VEHICLE",)


def test_argoverse_points_and_boxes_move_alike(tmp_path):
    io.write_bin(tmp_path / "a.bin", np.array([[11.35, -3.0, 0.84]], np.float32), np.array([200.0]))
    xyz, intensity = argoverse2.read_argoverse2_points(tmp_path / "a.bin")
    boxes = argoverse2.read_argoverse2_boxes(write_json(tmp_path / "a.json", [RECORD]))
    np.testing.assert_allclose(xyz, boxes.center, atol=1e-6)
    assert xyz.dtype == np.float32
    assert intensity.tolist() == [200.0]


@pytest.mark.parametrize("turn", [0.0, np.pi, -2.5])
def test_argoverse_yaw_is_that_of_the_axis_whatever_the_heading(tmp_path, turn):
    record = RECORD | {"qw": np.cos(turn / 2), "qz": np.sin(turn / 2)}
    (yaw,) = argoverse2.read_argoverse2_boxes(write_json(tmp_path / "a.json", [record])).yaw
    assert -np.pi / 2 <= yaw < np.pi / 2
    assert np.sin(yaw - turn) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "holds no list"),
        ([[]], "entry 0: qw is None"),
        ([RECORD, RECORD | {"tx_m": "far"}], "entry 1: tx_m is 'far'; it must be a finite number"),
        ([RECORD | {"height_m": None}], "entry 0: height_m is None"),
        ([RECORD | {"category": 3}], "entry 0: category is 3"),
        ([RECORD | {"qw": 0, "qz": 0}], "a rotation has length 1"),
    ],
)
def test_bad_argoverse_annotations_are_refused_with_file_entry_and_field(tmp_path, content, message):
    with pytest.raises(io.InputError, match=rf"a\.json.*{message}"):
        argoverse2.read_argoverse2_boxes(write_json(tmp_path / "a.json", content))


def test_broken_json_is_refused_with_its_line(tmp_path):
    (tmp_path / "a.json").write_text('[\n{"category": }]')
    with pytest.raises(io.InputError, match=r"a\.json, line 2: not JSON"):
        argoverse2.read_argoverse2_boxes(tmp_path / "a.json")


def test_a_sweep_without_labels_has_no_boxes(tmp_path):
    (tmp_path / "a.txt").write_text("")
    for boxes in (
        argoverse2.read_argoverse2_boxes(write_json(tmp_path / "a.json", [])),
        pandaset.read_pandaset_boxes(tmp_path / "a.txt"),
    ):
        assert len(boxes) == 0
        assert (boxes.center.shape, boxes.size.shape, boxes.yaw.shape) == ((0, 3), (0, 3), (0,))
        assert boxes.of_classes({"Car"}).shape == (0,)


def test_argoverse_ground_flags_are_one_byte_a_point(tmp_path):
    (tmp_path / "a.u8").write_bytes(bytes([0, 1, 1]))
    flags = argoverse2.read_argoverse2_ground(tmp_path / "a.u8", num_points=3)
    assert flags.tolist() == [False, True, True]
    with pytest.raises(io.InputError, match=r"3 ground flags for a sweep of 4 points"):
        argoverse2.read_argoverse2_ground(tmp_path / "a.u8", num_points=4)
    (tmp_path / "a.u8").write_bytes(bytes([0, 7]))
    with pytest.raises(io.InputError, match="byte 1 is 7"):
        argoverse2.read_argoverse2_ground(tmp_path / "a.u8")


LINE = "Car 0 10.8 -3 1.05 {} {} 1.5 0.3\n"


def test_pandaset_yaw_is_the_direction_of_the_larger_size_in_either_order(tmp_path):
    (tmp_path / "a.txt").write_text(LINE.format(4.5, 1.9) + "\n" + LINE.format(1.9, 4.5))
    boxes = pandaset.read_pandaset_boxes(tmp_path / "a.txt")
    np.testing.assert_allclose(boxes.size, [[4.5, 1.9, 1.5]] * 2)
    np.testing.assert_allclose(boxes.yaw, [0.3] * 2)
    np.testing.assert_allclose(boxes.center, [[10.0, -3.0, -0.8]] * 2)


def test_pandaset_reads_lines_with_and_without_the_number_of_points(tmp_path):
    line = LINE.format(4.5, 1.9).strip()
    (tmp_path / "a.txt").write_text(f"{line} 286\n{line.replace('Car', 'Bus')}\n")
    boxes = pandaset.read_pandaset_boxes(tmp_path / "a.txt")
    assert boxes.class_names == ("Car", "Bus")
    assert boxes.of_classes(pandaset.CAR_CLASSES).tolist() == [True, False]
    assert boxes.of_classes(pandaset.VEHICLE_CLASSES).tolist() == [True, True]


@pytest.mark.parametrize(
    ("line", "message"),
    [("Car 0 1 2 3 4 5", "7 columns"), ("Car 0 1 2 3 4 5 nan 0", "height is 'nan'")],
)
def test_bad_pandaset_labels_are_refused_with_file_and_line(tmp_path, line, message):
    (tmp_path / "a.txt").write_text(LINE.format(4.5, 1.9) + line)
    with pytest.raises(io.InputError, match=rf"a\.txt, line 2: {message}"):
        pandaset.read_pandaset_boxes(tmp_path / "a.txt")


def test_semantic_labels_hold_the_class_below_and_the_instance_above(tmp_path):
    (tmp_path / "a.label").write_bytes(np.array([40, 252 | 7 << 16, 65535 | 65535 << 16], "<u4").tobytes())
    class_id, instance_id = semantic_kitti.read_semantic_labels(tmp_path / "a.label", num_points=3)
    assert class_id.tolist() == [40, 252, 65535]
    assert instance_id.tolist() == [0, 7, 65535]


def test_semantic_labels_of_another_sweep_or_cut_short_are_refused(tmp_path):
    (tmp_path / "a.label").write_bytes(bytes(8))
    with pytest.raises(io.InputError, match="2 labels for a sweep of 3 points"):
        semantic_kitti.read_semantic_labels(tmp_path / "a.label", num_points=3)
    (tmp_path / "a.label").write_bytes(bytes(6))
    with pytest.raises(io.InputError, match="6 bytes is not a multiple of 4"):
        semantic_kitti.read_semantic_labels(tmp_path / "a.label")


def test_missing_files_are_named(tmp_path):
    for read in (
        argoverse2.read_argoverse2_boxes,
        pandaset.read_pandaset_boxes,
        semantic_kitti.read_semantic_labels,
    ):
        with pytest.raises(io.InputError, match="none: there is no such file"):
            read(tmp_path / "none")


def test_real_argoverse_boxes_hold_the_points_that_the_annotators_counted(data_root):
    (points,) = sorted((data_root / "argoverse2").glob("*.bin"))
    xyz, _ = argoverse2.read_argoverse2_points(points)
    path = points.with_suffix(".boxes.json")
    boxes = argoverse2.read_argoverse2_boxes(path)
    counted = [record["num_interior_pts"] for record in json.loads(path.read_text())]
    held = count_points_in_boxes(xyz, boxes.center, boxes.size, boxes.yaw)
    # Points on a face fall on either side of it by rounding.
    assert np.mean(np.abs(held - counted) <= 2 + 0.02 * np.array(counted)) > 0.95
    assert len(argoverse2.read_argoverse2_ground(points.with_suffix(".ground.u8"), num_points=len(xyz)))


def test_real_pandaset_boxes_hold_the_points_that_the_annotators_counted(data_root):
    points = data_root / "pandaset" / "000000.bin"
    xyz, _ = pandaset.read_pandaset_points(points)
    boxes = pandaset.read_pandaset_boxes(points.with_suffix(".txt"))
    counted = np.array([int(line.split()[9]) for line in points.with_suffix(".txt").read_text().splitlines()])
    held = count_points_in_boxes(xyz, boxes.center, boxes.size, boxes.yaw)
    cars = boxes.of_classes(pandaset.CAR_CLASSES)
    assert np.corrcoef(held[cars], counted[cars])[0, 1] > 0.95


def test_real_semantic_labels_put_the_road_below_the_sensor(data_root):
    folder = data_root / "semantic_kitti"
    for path in sorted((folder / "labels").glob("*.label")):
        xyz, _ = io.read_bin(folder / "velodyne" / f"{path.stem}.bin")
        class_id, _ = semantic_kitti.read_semantic_labels(path, num_points=len(xyz))
        near_road = (class_id == 40) & (np.hypot(*xyz[:, :2].T) < 10)
        assert np.median(xyz[near_road, 2]) == pytest.approx(-1.73, abs=0.1)
