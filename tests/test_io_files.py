"""Points, sweeps, images and JSON Lines: every layout, whole files only, errors that name the fix."""

import dataclasses
import json
import os
import shutil

import cv2
import numpy as np
import pytest
from test_io_kitti import CALIB, LINE, make_detections, write

from jaxbox import io
from jaxbox.types import Label, Status

XYZ = np.array([[1.5, -2.0, 0.25], [30.0, 4.0, -1.75]], np.float32)
INTENSITY = np.array([0.25, 0.5], np.float32)


# --- points ---------------------------------------------------------------------------------------


def test_binary_points_survive_writing_and_reading(tmp_path):
    io.write_bin(tmp_path / "a.bin", XYZ, INTENSITY)
    xyz, intensity = io.read_points(tmp_path / "a.bin")
    np.testing.assert_array_equal(xyz, XYZ)
    np.testing.assert_array_equal(intensity, INTENSITY)
    assert (tmp_path / "a.bin").read_bytes() == np.column_stack([XYZ, INTENSITY]).astype("<f4").tobytes()


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_empty_file_is_a_sweep_without_points(tmp_path, suffix):
    xyz, intensity = io.read_points(write(tmp_path / f"a{suffix}", ""))
    assert (xyz.shape, intensity.shape) == ((0, 3), (0,))


@pytest.mark.parametrize("size", [1, 15, 17, 40])
def test_binary_points_cut_short_are_refused_with_file_size_and_mend(tmp_path, size):
    (tmp_path / "a.bin").write_bytes(bytes(size))
    with pytest.raises(
        io.InputError, match=rf"a\.bin: {size} bytes is not a multiple of 16 .*Copy the file again"
    ):
        io.read_points(tmp_path / "a.bin")


@pytest.mark.parametrize(
    "text",
    [
        "1.5 -2 0.25 0.25\n30 4 -1.75 0.5\n",
        "1.5,-2,0.25,0.25\r\n30,4,-1.75,0.5\r\n",
        "x, y, z, intensity\n1.5, -2, 0.25, 0.25\n\n30, 4, -1.75, 0.5",
        "# x y z i ring\n1.5\t-2\t0.25\t0.25\tseven\n30 4 -1.75 0.5 9\n",
    ],
)
def test_text_points_are_read_with_blanks_commas_headings_and_more_columns(tmp_path, text):
    xyz, intensity = io.read_points(write(tmp_path / "a.txt", text))
    np.testing.assert_array_equal(xyz, XYZ)
    np.testing.assert_array_equal(intensity, INTENSITY)


@pytest.mark.parametrize(
    ("text", "intensity"),
    [
        ("x,y,z,time,intensity\n1.5,-2,0.25,0,0.25\n30,4,-1.75,0.1,0.5\n", INTENSITY),
        ("x y z ring reflectivity\n1.5 -2 0.25 7 0.25\n30 4 -1.75 9 0.5\n", INTENSITY),
        ("x y z ring\n1.5 -2 0.25 7\n30 4 -1.75 9\n", np.zeros(2)),
    ],
)
def test_the_first_line_of_text_points_names_the_intensity(tmp_path, text, intensity):
    xyz, found = io.read_points(write(tmp_path / "a.csv", text))
    np.testing.assert_array_equal(xyz, XYZ)
    np.testing.assert_array_equal(found, intensity)


def test_text_points_without_intensity_have_zeros_and_may_be_nan(tmp_path):
    xyz, intensity = io.read_points(write(tmp_path / "a.xyz", "1 2 3\nnan inf 1e300\n"))
    np.testing.assert_array_equal(xyz, np.float32([[1, 2, 3], [np.nan, np.inf, np.inf]]))
    np.testing.assert_array_equal(intensity, 0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n1 2\n", r"a\.txt, line 2: 2 columns"),
        ("1 2 3 4\n1 2 3\n", r"a\.txt, line 2: 3 columns"),
        ("1 2\n", r"a\.txt, line 1: 2 columns"),
        (",x,y,z\n0,1.5,-2,0.25\n", r"a\.txt, line 2: 4 columns, and the first line names 3"),
        ("x,y,z\n1,5,-2,0,0,25\n", r"a\.txt, line 2: 6 columns, and the first line names 3"),
        (LINE, r"a\.txt, line 1: 'Car 0\.00 0 .*is not x y z"),
    ],
)
def test_bad_text_points_are_named_with_file_and_line(tmp_path, text, message):
    with pytest.raises(io.InputError, match=message):
        io.read_points(write(tmp_path / "a.txt", text))


def test_unknown_suffix_missing_file_and_binary_text_are_refused(tmp_path):
    with pytest.raises(io.InputError, match=r"a\.e57: not a known kind of points; give one of \.bin"):
        io.read_points(tmp_path / "a.e57")
    with pytest.raises(io.InputError, match=r"a\.bin: there is no such file"):
        io.read_points(tmp_path / "a.bin")
    (tmp_path / "a.txt").write_bytes(b"\xff\xfe1 2 3")
    with pytest.raises(io.InputError, match=r"a\.txt: not a text file"):
        io.read_points(tmp_path / "a.txt")


# --- files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_interrupted_write_leaves_the_old_file_whole_and_nothing_beside_it(tmp_path, error):
    file = write(tmp_path / "a.txt", "old")

    def interrupted():
        with io.atomic_writer(file) as handle:
            handle.write("new, but not")
            raise error

    with pytest.raises(error):
        interrupted()
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_written_file_has_the_permissions_of_any_other(tmp_path):
    with io.atomic_writer(tmp_path / "new" / "a.txt") as handle:
        handle.write("x")
    other = write(tmp_path / "b.txt", "x")
    assert (tmp_path / "new" / "a.txt").stat().st_mode == other.stat().st_mode


def test_image_is_rgb_and_an_unreadable_one_is_named(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((2, 3, 3), (255, 0, 0), np.uint8))
    np.testing.assert_array_equal(io.read_image(tmp_path / "a.png"), np.full((2, 3, 3), (0, 0, 255)))
    for content in ("", "no image"):
        with pytest.raises(io.InputError, match=r"b\.png: not a readable image"):
            io.read_image(write(tmp_path / "b.png", content))


# --- layouts --------------------------------------------------------------------------------------


@pytest.mark.parametrize("below", ["", "training", "training/velodyne", "training/velodyne/000134.bin"])
def test_object_layout_is_found_from_any_folder_and_file(data_root, below):
    sweeps = io.open_sweeps(data_root / "kitti_object" / below)
    assert len(sweeps) == (1 if below.endswith("bin") else 20)
    sweep = next(sweep for sweep in sweeps if sweep.name == "000134")
    assert len(sweep.read_labels()) == 17
    np.testing.assert_array_equal(sweep.read_calibration().image_size_px, [1224, 370])
    assert sweep.read_image().shape == (370, 1224, 3)
    xyz, intensity = sweep.read_points()
    assert xyz.shape == (len(intensity), 3)
    assert len(xyz) > 100_000


def test_an_image_is_not_decoded_for_its_size_and_lies_as_it_is_stored(tmp_path, monkeypatch):
    for folder, name, text in (("velodyne", "1.bin", ""), ("calib", "1.txt", CALIB)):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / name, text)
    (tmp_path / "image_2").mkdir()
    jpeg = cv2.imencode(".jpg", np.zeros((6, 8, 3), np.uint8))[1].tobytes()
    # Exif that says "turn me by a quarter", as a phone writes it.
    turned = bytes.fromhex("ffe1 0022 457869660000 49492a0008000000 0100 12010300 01000000 06000000 00000000")
    (tmp_path / "image_2" / "1.jpg").write_bytes(jpeg[:2] + turned + jpeg[2:])
    (sweep,) = io.open_sweeps(tmp_path)
    assert sweep.read_image().shape == (6, 8, 3)
    monkeypatch.setattr(cv2, "imdecode", None)
    np.testing.assert_array_equal(sweep.read_calibration().image_size_px, [8, 6])


def test_object_sweep_without_image_has_the_usual_size(data_root):
    (sweep,) = io.open_sweeps(data_root / "kitti_object/training/velodyne/000157.bin")
    assert sweep.read_image() is None
    np.testing.assert_array_equal(sweep.read_calibration().image_size_px, [1242, 375])


@pytest.mark.parametrize("below", ["", "training", "training/velodyne", "training/velodyne/0000"])
def test_tracking_layout_is_found_from_any_folder(data_root, below):
    sweeps = io.open_sweeps(data_root / "kitti_tracking" / below)
    first_drive = [sweep for sweep in sweeps if sweep.name.startswith("0000_")]
    assert [sweep.name for sweep in first_drive] == [f"0000_{frame:06d}" for frame in range(48)]
    assert {item.frame for item in first_drive[12].read_labels()} == {12}
    # 218 lines in the file, all of them of these 48 frames.
    assert sum(len(sweep.read_labels()) for sweep in first_drive) == 218
    assert first_drive[12].read_calibration() is not None


DRIVE = "2011_09_26/2011_09_26_drive_0052_sync"


@pytest.mark.parametrize(
    "below", ["", "2011_09_26", DRIVE, f"{DRIVE}/velodyne_points", f"{DRIVE}/velodyne_points/data"]
)
def test_raw_layout_is_found_from_any_folder(data_root, below):
    sweeps = io.open_sweeps(data_root / "kitti_raw" / below)
    assert [sweep.name for sweep in sweeps] == [f"{DRIVE[11:]}_{frame:010d}" for frame in range(5, 17)]
    assert sweeps[2].read_labels() is None
    assert sweeps[2].read_image().shape == (375, 1242, 3)
    np.testing.assert_array_equal(sweeps[2].read_calibration().image_size_px, [1242, 375])


def test_object_and_raw_copies_of_one_frame_hold_the_same_points(data_root):
    ours, _ = io.read_points(data_root / "kitti_object/training/velodyne/001497.bin")
    raw, _ = io.read_points(data_root / "kitti_raw" / DRIVE / "velodyne_points/data/0000000007.bin")
    np.testing.assert_array_equal(ours, raw)


def test_plain_folder_takes_binary_points_before_text_and_no_hidden_files(tmp_path):
    for name in ("b.bin", "a.bin", "notes.txt", ".a.bin"):
        write(tmp_path / name, "")
    sweeps = io.open_sweeps(tmp_path)
    assert [sweep.name for sweep in sweeps] == ["a", "b"]
    assert sweeps[0].read_calibration() is sweeps[0].read_labels() is sweeps[0].read_image() is None


def test_text_files_beside_a_layout_are_not_its_points(tmp_path):
    (tmp_path / "velodyne").mkdir()
    write(tmp_path / "readme.txt", "1 2 3")
    write(tmp_path / "velodyne" / "000001.txt", "4 5 6")
    (sweep,) = io.open_sweeps(tmp_path)
    assert (sweep.name, sweep.points_path.parent.name) == ("000001", "velodyne")


def test_layout_is_read_from_the_names_of_links_and_relative_paths(tmp_path, monkeypatch):
    (tmp_path / "store").mkdir()
    write(tmp_path / "store" / "000001.bin", "")
    training = tmp_path / "training"
    (training / "calib").mkdir(parents=True)
    write(training / "calib" / "000001.txt", CALIB)
    os.symlink(tmp_path / "store", training / "velodyne")
    monkeypatch.chdir(training / "calib")
    for path in (training, "..", "../velodyne", "../velodyne/000001.bin"):
        (sweep,) = io.open_sweeps(path)
        assert sweep.read_calibration() is not None


def test_missing_and_empty_folders_are_named_with_what_was_looked_for(tmp_path):
    with pytest.raises(io.InputError, match="nowhere: there is no such file or folder"):
        io.open_sweeps(tmp_path / "nowhere")
    with pytest.raises(io.InputError, match=r"no points there\. Give a point file .*training/velodyne"):
        io.open_sweeps(tmp_path)


def test_unreadable_image_of_a_sweep_is_named_not_passed_over(tmp_path):
    for folder, name, text in (
        ("velodyne", "1.bin", ""),
        ("calib", "1.txt", CALIB),
        ("image_2", "1.png", "x"),
    ):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / name, text)
    (sweep,) = io.open_sweeps(tmp_path)
    with pytest.raises(io.InputError, match=r"image_2/1\.png: not a readable image"):
        sweep.read_calibration()
    shutil.rmtree(tmp_path / "image_2")
    (sweep,) = io.open_sweeps(tmp_path)
    assert sweep.read_calibration() is not None


def test_raw_drive_with_half_its_calibration_names_the_other_half(tmp_path):
    data = tmp_path / "2011_09_26" / "drive" / "velodyne_points" / "data"
    data.mkdir(parents=True)
    write(data / "0000000000.bin", "")
    (sweep,) = io.open_sweeps(tmp_path)
    assert (sweep.name, sweep.read_calibration()) == ("drive_0000000000", None)
    write(tmp_path / "2011_09_26" / "calib_cam_to_cam.txt", "")
    (sweep,) = io.open_sweeps(tmp_path)
    with pytest.raises(io.InputError, match=r"calib_velo_to_cam\.txt: there is no such file"):
        sweep.read_calibration()


# --- JSON Lines -----------------------------------------------------------------------------------


def test_detections_survive_json_lines(tmp_path):
    rows = {"center": [[20, 1, -1], [9, 9, 9]], "size": [[4, 1.6, 1.5], [1, 1, 1]], "yaw": [-0.3, 0]}
    detections = make_detections(**rows, score=[0.7, 0.6], label=[Label.TRUCK, 0], valid=[True, False])
    record = io.detections_record("000001", detections)
    io.write_jsonl(tmp_path / "a.jsonl", [record, {"name": "000002"}])
    back, other = io.read_jsonl(tmp_path / "a.jsonl")
    assert (back, other) == (record, {"name": "000002"})
    assert set(back) == {"name", "timestamp_ns", "boxes", "status", "counts"}
    (box,) = back["boxes"]
    assert (box["label"], box["num_points"]) == ("truck", 9)
    np.testing.assert_array_equal(np.float32(box["center"]), np.float32([20, 1, -1]))
    np.testing.assert_array_equal(np.float32(box["size"]), np.float32([4, 1.6, 1.5]))
    assert (np.float32(box["yaw"]), np.float32(box["score"])) == (np.float32(-0.3), np.float32(0.7))


def test_record_leaves_out_low_scores_and_says_the_status_in_words():
    detections = make_detections([[20, 1, -1]], [[4, 1.6, 1.5]], [0], [0.1], [0])
    detections = dataclasses.replace(detections, status=np.int32(Status.NO_GROUND))
    record = io.detections_record("a", detections, min_score=0.2)
    assert record["boxes"] == []
    assert record["status"] == Status.NO_GROUND.describe()
    assert json.dumps(record, allow_nan=False)


def test_bad_json_lines_are_refused(tmp_path):
    with pytest.raises(ValueError, match="JSON compliant"):
        io.write_jsonl(tmp_path / "a.jsonl", [{"x": float("nan")}])
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(io.InputError, match=r"a\.jsonl, line 2: not JSON"):
        io.read_jsonl(write(tmp_path / "a.jsonl", "{}\n{\n"))
    with pytest.raises(io.InputError, match=r"a\.jsonl, line 1: not a JSON object"):
        io.read_jsonl(write(tmp_path / "a.jsonl", "[1]\n"))
