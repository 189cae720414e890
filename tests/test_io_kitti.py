"""KITTI's files and conventions: round trips, the formulas on real labels, and errors that name the place."""

import dataclasses

import numpy as np
import pytest

from jaxbox import io
from jaxbox.io.kitti import observation_angle
from jaxbox.types import Calibration, Counts, Descriptors, Detections, GroundPlane, Hulls, Label

CALIB = """\
P2: 7.2e+02 0 6.1e+02 4.5e+01 0 7.2e+02 1.7e+02 2.2e-01 0 0 1 2.7e-03
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0.01 0 0 -1 -0.08 1 0 0 -0.27
"""
TRACKING_CALIB = CALIB.replace("R0_rect:", "R_rect").replace("Tr_velo_to_cam:", "Tr_velo_cam")
LINE = "Car 0.00 0 1.85 387.63 181.54 423.81 203.12 1.67 1.87 3.69 -16.53 2.39 58.49 1.57"


def make_detections(center, size, yaw, score, label, valid=None) -> Detections:
    """Boxes, with the rest of a sweep's answer empty."""
    count = len(center)
    rows = {"center": center, "size": size, "yaw": yaw, "heading": yaw, "score": score}
    rows["front_probability"] = np.full(count, 0.5)
    arrays = {name: np.asarray(array, np.float32) for name, array in rows.items()}
    empty = {
        kind: kind(**{field.name: np.zeros(count) for field in dataclasses.fields(kind)})
        for kind in (Hulls, Descriptors, GroundPlane, Counts)
    }
    return Detections(
        **arrays,
        label=np.asarray(label, np.int32),
        valid=np.ones(count, bool) if valid is None else np.asarray(valid),
        num_points=np.full(count, 9, np.int32),
        hulls=empty[Hulls],
        descriptors=empty[Descriptors],
        ground=empty[GroundPlane],
        ground_mask=np.zeros(5, bool),
        point_component=np.zeros(5, np.int32),
        point_detection=np.zeros(5, np.int32),
        first_return_m=np.zeros(4, np.float32),
        status=np.int32(0),
        counts=empty[Counts],
    )


def write(path, text):
    path.write_text(text)
    return path


def assert_same_objects(left, right, *, atol=0.0):
    assert len(left) == len(right)
    for a, b in zip(left, right, strict=True):
        assert (a.type, a.occlusion, a.frame, a.track_id) == (b.type, b.occlusion, b.frame, b.track_id)
        assert (a.score is None) == (b.score is None)
        np.testing.assert_allclose(_numbers(a), _numbers(b), rtol=0, atol=atol)


def _numbers(item) -> list[float]:
    size = [item.height, item.width, item.length]
    return [
        item.truncation,
        item.alpha,
        *item.box_px,
        *size,
        *item.location,
        item.rotation_y,
        item.score or 0,
    ]


# --- labels ---------------------------------------------------------------------------------------


def test_label_columns_are_those_of_the_development_kit(tmp_path):
    (item,) = io.read_labels(write(tmp_path / "a.txt", LINE + "\n\n"))
    assert (item.type, item.truncation, item.occlusion, item.alpha) == ("Car", 0.0, 0, 1.85)
    np.testing.assert_array_equal(item.box_px, [387.63, 181.54, 423.81, 203.12])
    assert (item.height, item.width, item.length) == (1.67, 1.87, 3.69)
    np.testing.assert_array_equal(item.location, [-16.53, 2.39, 58.49])
    assert (item.rotation_y, item.score, item.frame, item.track_id) == (1.57, None, None, None)


def test_result_has_a_score_and_tracking_a_frame_and_an_identity(tmp_path):
    lines = f"{LINE} 0.5\n7 3 {LINE}\n8 -1 {LINE} -2.25\n"
    result, label, tracked = io.read_labels(write(tmp_path / "a.txt", lines))
    assert (result.score, result.frame) == (0.5, None)
    assert (label.score, label.frame, label.track_id) == (None, 7, 3)
    assert (tracked.score, tracked.frame, tracked.track_id) == (-2.25, 8, -1)


def test_real_labels_survive_writing_and_reading(data_root, tmp_path):
    files = sorted((data_root / "kitti_object/training/label_2").glob("*.txt"))
    files += [data_root / "kitti_tracking/training/label_02/0000.txt"]
    files += sorted((data_root / "kitti_eval_oracle/perturbed/data").glob("*.txt"))
    assert len(files) == 41
    for file in files:
        objects = io.read_labels(file)
        io.write_labels(tmp_path / "a.txt", objects)
        assert_same_objects(io.read_labels(tmp_path / "a.txt"), objects)


def test_scores_keep_their_float32_order(tmp_path):
    (item,) = io.read_labels(write(tmp_path / "a.txt", LINE))
    scores = np.float32([1e-7, 0.1, np.nextafter(np.float32(0.1), 1), 0.99999994])
    io.write_labels(tmp_path / "b.txt", [dataclasses.replace(item, score=float(s)) for s in scores])
    np.testing.assert_array_equal(np.float32([b.score for b in io.read_labels(tmp_path / "b.txt")]), scores)


def test_no_objects_make_an_empty_file(tmp_path):
    io.write_labels(tmp_path / "out" / "a.txt", [])
    assert (tmp_path / "out" / "a.txt").read_text() == ""
    assert io.read_labels(tmp_path / "out" / "a.txt") == []


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("Car 0 0", r"a\.txt, line 2: 3 columns; KITTI labels have 15, results 16"),
        (f"{LINE} 1 2 3 4", r"line 2: 19 columns"),
        (LINE.replace("1.85", "x"), r"line 2: alpha is 'x'; it must be a finite number"),
        (LINE.replace("58.49", "nan"), r"line 2: z is 'nan'; it must be a finite number"),
        (f"{LINE} inf", r"line 2: score is 'inf'"),
        (f"0.5 1 {LINE}", r"line 2: frame is '0.5'; it must be a whole number"),
        (f"0 Car {LINE}", r"line 2: track id is 'Car'"),
    ],
)
def test_bad_label_line_is_named_with_file_line_and_field(tmp_path, line, message):
    with pytest.raises(io.InputError, match=message):
        io.read_labels(write(tmp_path / "a.txt", f"{LINE}\n{line}\n"))


@pytest.mark.parametrize("seed", range(30))
def test_labels_cut_short_or_garbled_raise_nothing_but_input_errors(tmp_path, seed):
    rng = np.random.default_rng(seed)
    data = bytearray(f"{LINE}\n0 1 {LINE}\n{LINE} 0.5\n".encode())
    for place in rng.integers(0, len(data), 4):
        data[place] = rng.integers(0, 256)
    file = tmp_path / "a.txt"
    file.write_bytes(data[: rng.integers(1, len(data))])
    try:
        objects = io.read_labels(file)
    except io.InputError as error:
        assert "a.txt" in str(error)  # noqa: PT017 - either outcome is right, another error is not
    else:
        assert all(np.isfinite(_numbers(item)).all() for item in objects)


@pytest.mark.parametrize("change", [{"type": "two words"}, {"type": ""}, {"alpha": np.nan}])
def test_object_that_the_format_cannot_hold_is_refused_and_the_old_file_stays(tmp_path, change):
    file = write(tmp_path / "a.txt", LINE)
    (item,) = io.read_labels(file)
    with pytest.raises(ValueError, match=r"type is|not finite"):
        io.write_labels(file, [item, dataclasses.replace(item, **change)])
    assert file.read_text() == LINE
    assert list(tmp_path.iterdir()) == [file]


def test_label_folder_is_keyed_by_sweep_name(data_root):
    labels = io.read_label_folder(data_root / "kitti_object/training/label_2")
    assert len(labels) == 20
    assert labels["000001"][0].type == "Truck"
    tracked = io.read_label_folder(data_root / "kitti_tracking/training/label_02")
    assert sum(name.startswith("0000_") for name in tracked) == 48
    assert {item.frame for item in tracked["0000_000012"]} == {12}


def test_label_folder_without_labels_or_with_mixed_lines_is_refused(tmp_path):
    with pytest.raises(io.InputError, match=r"no \.txt files"):
        io.read_label_folder(tmp_path)
    write(tmp_path / "a.txt", f"0 1 {LINE}\n{LINE}")
    with pytest.raises(io.InputError, match=r"a\.txt: mixes"):
        io.read_label_folder(tmp_path)


# --- calibration ----------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [CALIB, TRACKING_CALIB])
def test_both_spellings_of_the_calibration_are_read(tmp_path, text):
    calibration = io.read_calibration(write(tmp_path / "c.txt", text), image_size_px=(1224, 370))
    np.testing.assert_allclose(calibration.P_rect[0], [720, 0, 610, 45])
    np.testing.assert_allclose(calibration.T_rect_velo @ np.array([10.0, 2, 1, 1]), [-1.99, -1.08, 9.73, 1])
    np.testing.assert_array_equal(calibration.image_size_px, [1224, 370])


def test_a_written_calibration_reads_back(tmp_path):
    camera = io.read_calibration(write(tmp_path / "c.txt", CALIB))
    io.write_calibration(tmp_path / "new" / "c.txt", camera)
    back = io.read_calibration(tmp_path / "new" / "c.txt")
    np.testing.assert_allclose(back.P_rect, camera.P_rect, rtol=1e-7)
    np.testing.assert_allclose(back.T_rect_velo, camera.T_rect_velo, atol=1e-7)


def test_object_and_raw_calibration_of_one_frame_agree(data_root):
    """Object frame 001497 is frame 7 of the raw drive; its file has digits more, hence the tolerance."""
    ours = io.read_calibration(data_root / "kitti_object/training/calib/001497.txt")
    raw = io.read_raw_calibration(data_root / "kitti_raw/2011_09_26")
    np.testing.assert_allclose(ours.P_rect, raw.P_rect, rtol=1e-6)
    np.testing.assert_allclose(ours.T_rect_velo, raw.T_rect_velo, atol=1e-6)
    np.testing.assert_array_equal(ours.image_size_px, raw.image_size_px)


def test_real_extrinsics_are_rotations(data_root):
    for file in sorted((data_root / "kitti_object/training/calib").glob("*.txt")):
        R = np.asarray(io.read_calibration(file).T_rect_velo, np.float64)[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-5)
        assert np.linalg.det(R) > 0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("P2:", "P7:", r"c\.txt: no key P2; it holds P7, R0_rect"),
        ("R0_rect:", "R:", "no key R0_rect or R_rect"),
        ("Tr_velo_to_cam:", "Tr:", "no key Tr_velo_to_cam or Tr_velo_cam"),
        ("R0_rect: 1 0 0 0 1", "R0_rect: 1 0 0 0", "R0_rect has 8 values; it must have 9"),
        ("R0_rect: 1", "R0_rect: one", "R0_rect is 'one'; it must be a finite number"),
        (
            "R0_rect: 1 0 0 0 1 0 0 0 1",
            "R0_rect: 1 0 0 0 1 0 0 0 0",
            r"c\.txt: .* rank 3, not 4: it is singular",
        ),
        ("0 -1 0 0.01 0 0 -1", "0 -1 0 0.01 0 -1 0", r"c\.txt: the LiDAR-to-camera transform has rank 3"),
        ("7.2e+02", "0", r"c\.txt: the camera matrix has rank"),
    ],
)
def test_bad_calibration_is_named_with_file_and_key(tmp_path, old, new, message):
    with pytest.raises(io.InputError, match=message):
        io.read_calibration(write(tmp_path / "c.txt", CALIB.replace(old, new)))


def test_missing_raw_calibration_file_is_named(tmp_path):
    write(tmp_path / "calib_velo_to_cam.txt", "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")
    with pytest.raises(io.InputError, match=r"calib_cam_to_cam\.txt: there is no such file"):
        io.read_raw_calibration(tmp_path)


# --- boxes ----------------------------------------------------------------------------------------


@pytest.fixture
def calibration(tmp_path) -> Calibration:
    """An upright camera, axes exactly KITTI's, so that the conventions can be told by hand."""
    return io.read_calibration(write(tmp_path / "c.txt", CALIB))


def test_car_ahead_pointing_forward_has_rotation_y_of_minus_a_quarter_turn(calibration):
    detections = make_detections([[20, 0, -1]], [[4, 1.6, 1.5]], [0.0], [0.7], [Label.CAR])
    (item,) = io.objects_from_detections(detections, calibration)
    assert (item.type, item.truncation, item.occlusion) == ("Car", -1, -1)
    assert item.score == pytest.approx(0.7)
    assert (item.height, item.width, item.length) == pytest.approx((1.5, 1.6, 4.0))
    np.testing.assert_allclose(item.location, [0.01, 1 - 0.08 + 0.75, 20 - 0.27], atol=1e-5)
    assert item.rotation_y == pytest.approx(-np.pi / 2, abs=1e-6)
    assert item.alpha == pytest.approx(-np.pi / 2 - 0.01 / 19.73, abs=1e-6)


def test_turning_left_turns_rotation_y_to_minus(calibration):
    """A car ahead, its nose to the left: rotation_y is the negative of the turn, less a quarter."""
    detections = make_detections([[20, 0, -1]], [[4, 1.6, 1.5]], [0.3], [0.7], [Label.VAN])
    (item,) = io.objects_from_detections(detections, calibration)
    assert item.type == "Van"
    assert item.rotation_y == pytest.approx(-0.3 - np.pi / 2, abs=1e-6)


def test_results_hold_only_valid_boxes_that_the_camera_sees(calibration):
    center = [[20, 0, -1], [-20, 0, -1], [20, 60, -1], [25, 3, -1], [30, -3, -1], [1.5, 2.5, -1]]
    rows = len(center)
    detections = make_detections(
        center, [[4, 1.6, 1.5]] * rows, [0.1] * rows, [0.9, 0.8, 0.7, 0.6, 0.01, 0.5], [0] * rows,
        valid=[True, True, True, False, True, True],
    )  # fmt: skip
    objects = io.objects_from_detections(detections, calibration)
    assert [round(item.score, 2) for item in objects] == [0.9, 0.01]
    assert len(io.objects_from_detections(detections, calibration, min_score=0.1)) == 1
    touching = io.objects_from_detections(detections, calibration, min_visible_fraction=0)
    assert [round(item.score, 2) for item in touching] == [0.9, 0.01, 0.5]
    for item in touching:
        assert (item.box_px[:2] >= 0).all()
        assert (item.box_px[2:] <= [1241, 374]).all()


def test_labels_of_boxes_say_how_much_the_image_shows_and_come_back(calibration):
    center = np.array([[20.0, 0, -1], [-20, 0, -1], [12, 9.5, -1]])
    size, yaw = np.array([[4.0, 1.6, 1.5]] * 3), np.array([0.3, 0.3, 0.3])
    whole, behind, cut = io.objects_from_boxes(center, size, yaw, calibration, types=["Car", "Car", "Van"])
    assert behind is None
    assert (whole.type, whole.truncation, whole.occlusion, whole.score) == ("Car", 0, 0, None)
    assert cut.type == "Van"
    assert 0.1 < cut.truncation < 0.7
    back = io.boxes_from_objects([whole, cut], calibration)
    for found, expected in zip(back, (center, size, yaw), strict=True):
        np.testing.assert_allclose(found, expected[[0, 2]], atol=1e-5)


@pytest.mark.parametrize(
    ("rotation_y", "x", "expected"), [(np.pi, -10.0, -np.pi * 3 / 4), (-np.pi, 0.0, np.pi)]
)
def test_alpha_is_wrapped_to_one_turn(rotation_y, x, expected):
    assert observation_angle(rotation_y, np.array([x, 1.6, 10.0])) == pytest.approx(expected)


def test_real_labels_survive_the_way_through_the_lidar_frame(data_root):
    seen = 0
    for sweep in io.open_sweeps(data_root / "kitti_object"):
        calibration = sweep.read_calibration()
        objects = [item for item in sweep.read_labels() if item.type in ("Car", "Van", "Truck")]
        center, size, yaw = io.boxes_from_objects(objects, calibration)
        assert ((yaw >= -np.pi / 2) & (yaw < np.pi / 2)).all()
        assert (size[:, 0] >= size[:, 1]).all()
        seen += _check_return(objects, center, size, yaw, calibration)
    assert seen == 84


def _check_return(objects, center, size, yaw, calibration) -> int:
    padding = 32 - len(objects)
    label = [Label[item.type.upper()] for item in objects]
    arrays = [np.concatenate([a, np.zeros((padding, *np.shape(a)[1:]))]) for a in (center, size, yaw, label)]
    valid = np.arange(32) < len(objects)
    detections = make_detections(*arrays[:3], np.ones(32), arrays[3], valid)
    back = io.objects_from_detections(detections, calibration, min_visible_fraction=0)
    for ours, theirs in zip(back, objects, strict=True):
        assert ours.type == theirs.type
        np.testing.assert_allclose(ours.location, theirs.location, atol=1e-4)
        np.testing.assert_allclose(
            [ours.height, ours.width, ours.length], [theirs.height, theirs.width, theirs.length], atol=1e-5
        )
        # A box has no front, so the turn is known up to half a turn.
        assert abs(np.sin(ours.rotation_y - theirs.rotation_y)) < 1e-4
        # The labels' alpha is rounded, and differs by up to 0.034 at the nearest objects.
        assert abs(np.sin(ours.alpha - theirs.alpha)) < 0.04
        assert ours.alpha == pytest.approx(observation_angle(ours.rotation_y, ours.location))
    return len(back)


def test_real_label_boxes_hold_the_points_of_their_cars(data_root):
    """An independent check of the frame: clear cars hold hundreds of returns, and few lie just outside."""
    shares = []
    for sweep in io.open_sweeps(data_root / "kitti_object"):
        near = [
            item
            for item in sweep.read_labels()
            if item.type == "Car" and item.occlusion == 0 and item.truncation == 0 and item.location[2] < 25
        ]
        xyz, _ = sweep.read_points()
        for center, size, yaw in zip(*io.boxes_from_objects(near, sweep.read_calibration()), strict=True):
            dx, dy, dz = (xyz - center).T
            u, v = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
            above = np.abs(dz - 0.1) < size[2] / 2 - 0.2
            inside = above & (np.abs(u) < size[0] / 2 + 0.1) & (np.abs(v) < size[1] / 2 + 0.1)
            around = above & (np.abs(u) < size[0] / 2 + 0.4) & (np.abs(v) < size[1] / 2 + 0.4)
            assert inside.sum() > 100
            shares.append(inside.sum() / around.sum())
    assert len(shares) >= 5
    assert np.median(shares) > 0.97


def test_pedestrian_wider_than_long_changes_its_sides_and_turns(calibration):
    line = "Pedestrian 0 0 0 0 0 1 1 1.8 0.9 0.4 0 1.7 10 -1.5707963"
    item = dataclasses.replace(_parse(line), box_px=np.zeros(4))
    _, size, yaw = io.boxes_from_objects([item], calibration)
    np.testing.assert_allclose(size, [[0.9, 0.4, 1.8]])
    assert abs(abs(yaw[0]) - np.pi / 2) < 1e-6


def _parse(line):
    return io.kitti._parse_object(line.split(), "here")


def test_no_objects_make_no_boxes(calibration):
    center, size, yaw = io.boxes_from_objects([], calibration)
    assert (center.shape, size.shape, yaw.shape) == ((0, 3), (0, 3), (0,))


def test_dont_care_has_no_box(calibration):
    item = _parse("DontCare -1 -1 -10 503 169 590 190 -1 -1 -1 -1000 -1000 -1000 -10")
    assert item.is_dont_care
    with pytest.raises(ValueError, match="DontCare region has no 3D box"):
        io.boxes_from_objects([item], calibration)
