"""`jaxbox track`: files of each format, resumed and interrupted drives, broken sweeps, and options."""

import collections
import csv
import functools
import json
import shutil
import types

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from test_cli import CAPACITY, run
from test_cli_formats import heard_ctrl_c

from jaxbox import Status, TrackStatus, io, synthetic
from jaxbox.cli.config_options import chosen_track_config
from jaxbox.cli.report import SHOWN_MIN_SCORE
from jaxbox.cli.track_report import SequenceReport
from jaxbox.cli.track_results import SequenceFiles, TrackFormat
from jaxbox.evaluation.tracking.folders import evaluate_tracking_folders
from jaxbox.geometry.rigid import rotation_about_z
from jaxbox.io import mcap_results
from jaxbox.io import rerun as rerun_results
from jaxbox.io.mcap_file import open_mcap_file
from jaxbox.io.parquet import TRACK_COLUMNS
from jaxbox.io.results import SweepResult

STEP_M = 1.0
LENGTHS = {"0000": 5, "0001": 3}
ALL = [word for name in TrackFormat for word in ("--format", name)]
FILMS = ["--pictures", "--video", "--gif", "--crops"]
LIGHT = ["--format", "kitti", "--format", "jsonl", "--capacity", CAPACITY]


@pytest.fixture(scope="session")
def kitti(tmp_path_factory):
    """Two drives past a standing street in KITTI's tracking layout, with poses and one image."""
    root = tmp_path_factory.mktemp("tracking") / "training"
    for seed, (sequence, length) in zip((6, 3), LENGTHS.items(), strict=True):
        street = synthetic.make_sweep(seed, num_azimuths=250)
        for frame in range(length):
            shifted = street.xyz - np.float32([STEP_M * frame, 0, 0])
            path = root / "velodyne" / sequence / f"{frame:06d}.bin"
            path.parent.mkdir(parents=True, exist_ok=True)
            io.write_bin(path, shifted, street.intensity)
        (root / "calib").mkdir(exist_ok=True)
        io.write_calibration(root / "calib" / f"{sequence}.txt", street.calibration)
        poses = [f"1 0 0 {STEP_M * frame} 0 1 0 0 0 0 1 0" for frame in range(length)]
        (root / "poses").mkdir(exist_ok=True)
        (root / "poses" / f"{sequence}.txt").write_text("\n".join(poses) + "\n")
    (root / "image_02" / "0000").mkdir(parents=True)
    image = np.full((375, 1242, 3), 90, np.uint8)
    for frame in range(LENGTHS["0000"]):
        cv2.imwrite(str(root / "image_02" / "0000" / f"{frame:06d}.png"), image)
    return root


def track(kitti, output, *arguments):
    return run("track", kitti, "--output", output, "--poses", "boxes", *arguments)


@pytest.fixture(scope="session")
def written(kitti, tmp_path_factory):
    """What a whole run writes, in every format, with pictures, crops and films."""
    output = tmp_path_factory.mktemp("written")
    result = track(kitti, output, *ALL, *FILMS, "--capacity", CAPACITY)
    assert result.exit_code == 0, result.output
    return output, result


def records_of(output, sequence="0000"):
    return io.read_jsonl(output / f"{sequence}.jsonl")


def test_every_sequence_has_every_file_and_the_account(written, kitti):
    output, result = written
    suffixes = ("txt", "jsonl", "parquet", "csv", "mcap", "rrd", "mp4", "gif")
    expected = {f"{sequence}.{suffix}" for sequence in LENGTHS for suffix in suffixes}
    expected |= {f"{sequence}_{tool}" for sequence in LENGTHS for tool in ("cvat", "labelcloud", "xtreme1")}
    beside = {"config.toml", "run.json", "pictures", "crops", "contact_sheet.png"}
    assert {path.name for path in output.iterdir()} == expected | beside
    account = json.loads((output / "run.json").read_text())
    assert account["finished"]
    assert account["incomplete"] == []
    assert account["options"]["track"]["max_misses"] == 4.0
    assert account["options"]["poses"] == "boxes"
    assert [item["done"] for item in account["sequences"]] == list(LENGTHS.values())
    assert account["sequences"][0]["status"]["POSE_FROM_BOXES"] == LENGTHS["0000"]
    assert "0000: 5 sweeps" in result.stdout
    assert "warning: 0000: 5 of 5 sweeps: POSE_FROM_BOXES" in result.stderr


def test_json_lines_hold_all_of_a_track(written):
    records = records_of(written[0])
    assert [record["name"] for record in records] == [f"0000_{frame:06d}" for frame in range(5)]
    assert [record["frame"] for record in records] == list(range(5))
    np.testing.assert_allclose([record["time_s"] for record in records], 0.1 * np.arange(5), atol=1e-9)
    boxes = records[-1]["boxes"]
    assert [box["id"] for box in boxes] == sorted({box["id"] for box in boxes})
    box = max(boxes, key=lambda box: box["score"])
    assert box["confirmed"]
    assert box["sight"] == "seen"
    assert box["state"] == "standing"
    assert box["num_points"] > 0
    assert box["speed"] == pytest.approx(np.hypot(*box["velocity"]), abs=1e-5)
    assert sum(box["label_probability"].values()) == pytest.approx(1, abs=1e-5)
    # Poses from boxes follow the sensor, which goes 1 m on from sweep to sweep.
    assert records[-1]["pose_source"] == "boxes"
    assert records[-1]["T_world_sensor"][0][3] == pytest.approx(4 * STEP_M, abs=0.2)
    ids = [{box["id"] for box in record["boxes"] if box["score"] > 0.15} for record in records]
    assert ids[-1] & ids[1]


def test_kitti_text_holds_the_tracks_that_the_camera_sees_with_their_fronts(written, kitti):
    output, _ = written
    objects = io.read_tracks(output / "0000.txt")
    records = records_of(output)
    calibration = io.open_sweeps(kitti)[0].read_calibration()
    boxes = {(record["frame"], box["id"]): box for record in records for box in record["boxes"]}
    assert objects
    center, size, heading = io.boxes_from_objects(objects, calibration, keep_heading=True)
    for row, item in enumerate(objects):
        box = boxes[item.frame, item.track_id]
        assert box["detection"] >= 0
        assert item.type == box["label"].capitalize()
        assert item.score == pytest.approx(box["score"], rel=1e-6)
        np.testing.assert_allclose(center[row], box["center"], atol=1e-3)
        np.testing.assert_allclose(size[row], box["size"], atol=1e-3)
        assert np.cos(heading[row] - box["heading"]) > 0.999


def test_kitti_text_is_what_the_evaluation_reads(written, kitti, tmp_path):
    labels = tmp_path / "label_02"
    labels.mkdir()
    shutil.copytree(kitti / "calib", tmp_path / "calib")
    for sequence in LENGTHS:
        truth = io.read_tracks(written[0] / f"{sequence}.txt")
        lines = [line.rsplit(" ", 1)[0] for line in (written[0] / f"{sequence}.txt").read_text().splitlines()]
        assert len(lines) == len(truth)
        lines = [" ".join([*line.split()[:3], "0", "0", *line.split()[5:]]) for line in lines]
        (labels / f"{sequence}.txt").write_text("\n".join(lines) + "\n")
    report = evaluate_tracking_folders(tmp_path, written[0])
    assert report["kitti"]["Car"]["hota"]["hota"] == pytest.approx(1)
    assert report["kitti"]["Car"]["clear"]["num_labels"] > 0


def test_labels_for_annotation_tools_hold_the_seen_and_confirmed_tracks(written):
    output, _ = written
    shown = {}
    for record in records_of(output):
        boxes = [box for box in record["boxes"] if box["confirmed"] and box["sight"] == "seen"]
        shown[record["name"]] = [box["id"] for box in boxes if box["score"] >= SHOWN_MIN_SCORE]
    assert any(shown.values())
    for tool in ("cvat", "xtreme1"):
        sweeps = io.open_sweeps(output / f"0000_{tool}")
        assert {s.name: [item.track_id for item in s.read_labels()] for s in sweeps} == shown
    sweeps = io.open_sweeps(output / "0000_labelcloud")
    assert {s.name: len(s.read_labels()) for s in sweeps} == {name: len(ids) for name, ids in shown.items()}


def test_labels_of_a_tool_are_detected_in_and_evaluated(written, tmp_path):
    labels = written[0] / "0000_labelcloud"
    options = ("--output", tmp_path, "--no-pictures", "--capacity", CAPACITY)
    assert run("detect", labels, *options).exit_code == 0
    result = run("eval", "--labels", labels, "--results", tmp_path, "--json", tmp_path / "report.json")
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["num_frames"] == LENGTHS["0000"]
    # What the tracker shows is what was detected, with a box that its sweeps agree on.
    rate = report["selections"]["all"]["rates"][0]
    assert rate["num_labels"] > 0
    assert rate["recall"] > 0.8
    assert "2D box" not in result.output


def test_tables_hold_a_row_for_each_track_and_sweep(written):
    output, _ = written
    boxes = [(record, box) for record in records_of(output) for box in record["boxes"]]
    table = pq.read_table(output / "0000.parquet").to_pylist()
    with (output / "0000.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(table) == len(rows) == len(boxes)
    assert list(rows[0]) == list(table[0]) == list(TRACK_COLUMNS)
    for (record, box), of_table, of_text in zip(boxes, table, rows, strict=True):
        assert of_table["id"] == int(of_text["id"]) == box["id"]
        assert of_table["sweep"] == of_text["sweep"] == record["name"]
        assert of_table["state"] == of_text["state"] == box["state"]
        world = np.array(record["T_world_sensor"]) @ [*box["center"], 1]
        np.testing.assert_allclose([of_table[f"world_{axis}"] for axis in "xyz"], world[:3], atol=1e-9)
        assert float(of_text["velocity_x"]) == pytest.approx(box["velocity"][0], rel=1e-5, abs=1e-6)


def test_mcap_holds_an_entity_a_track_with_its_trail_the_pose_and_the_points(written):
    output, _ = written
    scene = pytest.importorskip("foxglove_schemas_protobuf.SceneUpdate_pb2").SceneUpdate
    topics = collections.Counter()
    scenes, records = [], []
    with open_mcap_file(output / "0000.mcap") as reader:
        for _, channel, message in reader.iter_messages():
            topics[channel.topic] += 1
            if channel.topic == mcap_results.BOXES_TOPIC:
                scenes.append(scene.FromString(message.data))
            elif channel.topic == mcap_results.TRACKS_TOPIC:
                records.append(json.loads(message.data))
    names = (mcap_results.BOXES_TOPIC, mcap_results.TRACKS_TOPIC, mcap_results.POSE_TOPIC)
    assert topics == dict.fromkeys((*names, mcap_results.POINTS_TOPIC), 5)
    assert records == records_of(output)
    for record, update in zip(records, scenes, strict=True):
        assert [entity.id for entity in update.entities] == [str(box["id"]) for box in record["boxes"]]
        assert len(update.deletions) == 1
        for box, entity in zip(record["boxes"], update.entities, strict=True):
            place = entity.lines[0].points[-1]
            np.testing.assert_allclose([place.x, place.y, place.z], box["center"], atol=1e-5)
            assert len(entity.lines[0].points) == min(box["age"], 21)
            assert len(entity.arrows) == (box["state"] != "standing")
            assert entity.texts[0].text.split()[0] == str(box["id"])


def test_a_rerun_recording_holds_boxes_trails_and_velocities(written):
    rerun = pytest.importorskip("rerun")
    assert (written[0] / "0000.rrd").read_bytes()[:3] == b"RRF"
    record = records_of(written[0])[-1]
    logged = {}
    recording = type("Recording", (), {"log": staticmethod(logged.__setitem__)})
    trails = {box["id"]: np.array([[0.0, 0, 0], box["center"]]) for box in record["boxes"]}
    rerun_results._log_world(rerun, recording, SweepResult(record=record, trails=trails))
    boxes, moving = record["boxes"], [box for box in record["boxes"] if box["state"] != "standing"]
    labels = logged["world/boxes"].labels.as_arrow_array().to_pylist()
    assert [label.split()[0] for label in labels] == [str(box["id"]) for box in boxes]
    strips = logged["world/trails"].strips.as_arrow_array().to_pylist()
    np.testing.assert_allclose([strip[-1] for strip in strips], [box["center"] for box in boxes], rtol=1e-6)
    vectors = logged["world/velocities"].vectors.as_arrow_array().to_pylist()
    np.testing.assert_allclose(vectors, [[*box["velocity"], 0] for box in moving], rtol=1e-6)


def test_a_video_has_a_picture_a_sweep_and_the_camera_above(written):
    output, _ = written
    shapes = {"0000.mp4": (720 + 362, 1200), "0001.mp4": (720, 1200), "0000.gif": (288 + 145, 480)}
    for name, shape in shapes.items():
        video = cv2.VideoCapture(str(output / name))
        pictures = []
        while (read := video.read())[0]:
            pictures.append(read[1])
        assert len(pictures) == LENGTHS[name[:4]]
        assert pictures[0].shape[:2] == shape
        assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10, abs=0.01)
    assert len(list((output / "pictures").iterdir())) == sum(LENGTHS.values())
    picture = io.read_image(output / "pictures" / "0001_000002_tracks.png")
    assert picture.shape == (720, 1200, 3)
    assert np.ptp(picture.reshape(-1, 3).astype(int), axis=1).max() > 100, "no coloured box"


def test_crops_are_the_points_in_the_boxes_of_confirmed_tracks_by_their_ids(written, kitti):
    output, _ = written
    record = records_of(output)[4]
    xyz = io.read_points(kitti / "velodyne" / "0000" / "000004.bin")[0]
    expected = {}
    for box in record["boxes"]:
        offset = (xyz - box["center"]) @ rotation_about_z(box["heading"])
        inside = np.all(np.abs(offset) <= np.array(box["size"]) / 2, axis=1)
        if box["confirmed"] and box["score"] >= SHOWN_MIN_SCORE and inside.any():
            expected[f"0000_000004_{box['id']:03d}.pcd"] = int(inside.sum())
    assert expected
    files = (output / "crops").glob("0000_000004_*.pcd")
    found = {path.name: len(io.read_points(path)[0]) for path in files}
    # A point on a face is in or out by the last bit.
    assert found == {name: pytest.approx(count, abs=1) for name, count in expected.items()}


def test_a_drive_in_part_of_the_world_and_of_one_class(kitti, written, tmp_path):
    near = ("--within", "15", "--classes", "car", "--no-contact-sheet")
    assert track(kitti, tmp_path, *LIGHT, *near).exit_code == 0
    num_kept = 0
    for record, whole in zip(records_of(tmp_path), records_of(written[0]), strict=True):
        kept = [box for box in whole["boxes"] if box["label"] == "car" and np.hypot(*box["center"][:2]) <= 15]
        assert record["boxes"] == kept
        assert record["counts"] == whole["counts"], "the tracker sees all"
        assert len(kept) < len(whole["boxes"])
        num_kept += len(kept)
    assert num_kept > 0
    assert not (tmp_path / "contact_sheet.png").exists()


def test_poses_of_the_data_set_and_of_a_file_are_the_same(kitti, tmp_path):
    by_file = run("track", kitti, "--output", tmp_path / "file", "--poses", kitti / "poses", *LIGHT)
    assert by_file.exit_code == 0, by_file.output
    records = records_of(tmp_path / "file")
    assert {record["pose_source"] for record in records} == {"pose file"}
    assert all(record["status"] == [] for record in records)


def test_a_finished_drive_is_passed_over_and_the_others_are_done(written, kitti, tmp_path):
    whole = track(kitti, tmp_path, *LIGHT)
    assert whole.exit_code == 0
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("000*")}
    (tmp_path / "0001.txt").unlink()
    again = track(kitti, tmp_path, *LIGHT, "--resume", "--json")
    assert again.exit_code == 0
    lines = [json.loads(line) for line in again.stdout.splitlines()]
    assert [line["name"] for line in lines[:-1]] == [f"0001_{frame:06d}" for frame in range(3)]
    assert lines[-1]["summary"]["done"] == 3
    assert lines[-1]["summary"]["skipped"] == 5
    assert (tmp_path / "0000.txt").stat().st_mtime_ns == before["0000.txt"]
    assert records_of(tmp_path, "0001") == records_of(written[0], "0001")
    other = track(kitti, tmp_path, *LIGHT, "--resume", "--track-set", "max_misses=6")
    assert other.exit_code == 2
    assert "track differ" in other.stderr


def test_ctrl_c_leaves_what_is_done_and_resume_begins_the_drive_again(written, kitti, tmp_path, monkeypatch):
    read_points = io.Sweep.read_points

    def interrupted(self):
        if self.name == "0000_000003":
            raise KeyboardInterrupt
        return read_points(self)

    with monkeypatch.context() as patch, heard_ctrl_c():
        patch.setattr(io.Sweep, "read_points", interrupted)
        patch.setattr(io.Sweep, "read_timed_points", interrupted)
        result = track(kitti, tmp_path, *LIGHT)
    assert result.exit_code == 130
    assert "--resume goes on" in result.stderr
    done = records_of(tmp_path)
    assert 1 <= len(done) <= 3
    assert done == records_of(written[0])[: len(done)]
    account = json.loads((tmp_path / "run.json").read_text())
    assert account["interrupted"]
    assert account["incomplete"] == ["0000", "0001"]
    assert track(kitti, tmp_path, *LIGHT, "--resume").exit_code == 0
    assert records_of(tmp_path) == records_of(written[0])


def test_a_broken_sweep_is_reported_and_its_drive_is_done_again_once_it_is_mended(kitti, tmp_path):
    root = tmp_path / "training"
    shutil.copytree(kitti, root)
    broken = root / "velodyne" / "0000" / "000002.bin"
    whole = broken.read_bytes()
    broken.write_bytes(whole[:-3])
    output = tmp_path / "out"
    result = track(root, output, *LIGHT)
    assert result.exit_code == 1
    assert "error: 0000_000002:" in result.stderr
    assert [record["frame"] for record in records_of(output)] == [0, 1, 3, 4]
    assert {item.frame for item in io.read_tracks(output / "0000.txt")} <= {0, 1, 3, 4}
    assert json.loads((output / "run.json").read_text())["incomplete"] == ["0000"]
    broken.write_bytes(whole)
    assert track(root, output, *LIGHT, "--resume").exit_code == 0
    assert [record["frame"] for record in records_of(output)] == list(range(5))


def test_a_drive_that_has_got_more_sweeps_is_done_again(kitti, tmp_path):
    root, output = tmp_path / "training", tmp_path / "out"
    shutil.copytree(kitti, root)
    last = root / "velodyne" / "0001" / "000002.bin"
    last.rename(tmp_path / "000002.bin")
    assert track(root, output, *LIGHT).exit_code == 0
    before = (output / "0000.txt").stat().st_mtime_ns
    (tmp_path / "000002.bin").rename(last)
    again = track(root, output, *LIGHT, "--resume", "--json")
    assert again.exit_code == 0, again.stderr
    assert json.loads(again.stdout.splitlines()[-1])["summary"]["skipped"] == 5
    assert [record["frame"] for record in records_of(output, "0001")] == [0, 1, 2]
    assert (output / "0000.txt").stat().st_mtime_ns == before
    assert json.loads((output / "run.json").read_text())["num_sweeps"] == {"0000": 5, "0001": 3}
    done = track(root, output, *LIGHT, "--resume", "--json")
    assert json.loads(done.stdout)["summary"]["skipped"] == 8


def test_a_drive_without_a_file_in_a_folder_of_poses_fails_and_the_others_go_on(kitti, tmp_path):
    poses = tmp_path / "poses"
    shutil.copytree(kitti / "poses", poses)
    (poses / "0000.txt").unlink()
    result = run("track", kitti, "--output", tmp_path / "out", "--poses", poses, *LIGHT)
    assert result.exit_code == 1
    assert "0000.txt: there is no such file" in result.stderr
    assert len(records_of(tmp_path / "out", "0001")) == 3
    assert json.loads((tmp_path / "out" / "run.json").read_text())["incomplete"] == ["0000"]


def test_of_a_drive_of_which_nothing_was_done_no_poses_are_told():
    assert SequenceReport("a").describe() == "a: 0 sweeps, 0 vehicles, 0 of them moved"


def test_a_drive_without_any_good_sweep_leaves_no_file(kitti, tmp_path):
    folder = tmp_path / "training" / "velodyne" / "0007"
    folder.mkdir(parents=True)
    (folder / "000000.bin").write_bytes(b"abc")
    result = track(tmp_path / "training", tmp_path / "out", *LIGHT)
    assert result.exit_code == 1
    assert not list((tmp_path / "out").glob("0007*"))


def test_without_a_camera_text_is_json_lines(kitti, tmp_path):
    folder = tmp_path / "drive"
    shutil.copytree(kitti / "velodyne" / "0001", folder)
    result = track(folder, tmp_path / "out", "--capacity", CAPACITY)
    assert result.exit_code == 0, result.output
    assert "no camera calibration" in result.stderr
    assert [path.suffix for path in (tmp_path / "out").glob("drive*")] == [".jsonl"]
    again = track(folder, tmp_path / "out", "--capacity", CAPACITY, "--resume", "--json")
    assert json.loads(again.stdout)["summary"]["skipped"] == 3


def test_smoothing_and_coasting_and_scores_change_what_is_written(kitti, tmp_path):
    outputs = {}
    for name, extra in {
        "smooth": ["--smooth"],
        "confirmed": ["--confirmed"],
        "high": ["--min-score", "0.3"],
        "low": ["--min-score", "0"],
        "all": [],
    }.items():
        assert track(kitti, tmp_path / name, *LIGHT, *extra, "--quiet").exit_code == 0
        outputs[name] = records_of(tmp_path / name)
    assert [record["name"] for record in outputs["smooth"]] == [record["name"] for record in outputs["all"]]
    assert all(box["confirmed"] for record in outputs["confirmed"] for box in record["boxes"])
    assert not all(box["confirmed"] for record in outputs["all"] for box in record["boxes"])
    scores = [box["score"] for record in outputs["high"] for box in record["boxes"]]
    assert scores
    assert min(scores) >= 0.3
    # KITTI's benchmark takes every line for an answer, so text has what is shown unless scores are asked for.
    texts = {name: (tmp_path / name / "0000.txt").read_text().splitlines() for name in outputs}
    assert outputs["low"] == outputs["all"]
    assert min(float(line.split()[-1]) for line in texts["low"]) < SHOWN_MIN_SCORE
    assert texts["all"] == [line for line in texts["low"] if float(line.split()[-1]) >= SHOWN_MIN_SCORE]
    assert texts["all"]
    smooth = io.read_tracks(tmp_path / "smooth" / "0000.txt")
    assert {item.track_id for item in smooth} <= {
        box["id"] for record in outputs["smooth"] for box in record["boxes"]
    }


def test_real_vehicles_keep_their_ids_and_have_their_speeds(data_root, tmp_path):
    root = data_root / "kitti_tracking" / "training"
    frames = root / "velodyne" / "0003" / "00000[0-7].bin"
    result = run("track", frames, "--output", tmp_path, "--format", "kitti", "--format", "jsonl")
    assert result.exit_code == 0, result.output
    report = evaluate_tracking_folders(root, tmp_path, frames={"0003": (0, 7)}, min_score=0.15)
    clear = report["kitti"]["Car"]["clear"]
    assert clear["num_labels"] > 10
    assert clear["recall"] > 0.9
    assert clear["idsw"] == 0
    last = records_of(tmp_path, "0003")[-1]
    assert last["pose_source"] == "oxts"
    # The cars around, on a highway in a city.
    speeds = [box["speed"] for box in last["boxes"] if box["score"] > 0.5 and abs(box["center"][1]) < 5]
    assert len(speeds) >= 3
    assert 11 < min(speeds) <= max(speeds) < 18


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--track-set", "max_mises=3"], "nearest are max_misses"),
        (["--track-set", "gate=wide"], "gate is 'wide'; it must be a finite number"),
        (["--poses", "nowhere.txt"], "nowhere.txt"),
        (["--rate-hz", "0"], "--rate-hz is 0"),
        (["--rate-hz", "inf"], "--rate-hz is inf"),
        (["--set", "nothing=1"], "there is no setting nothing"),
    ],
)
def test_options_that_cannot_be_used_say_so(kitti, tmp_path, arguments, words):
    result = run("track", kitti, "--output", tmp_path / "out", *LIGHT, *arguments)
    assert result.exit_code == 2
    assert words in result.stderr
    assert not list((tmp_path / "out").glob("000*"))


def test_an_empty_recording_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(io, "open_sweeps", lambda paths, **_: [])
    result = run("track", tmp_path, "--output", tmp_path / "out")
    assert result.exit_code == 2
    assert "the recording is empty" in result.stderr


def test_bits_of_detector_and_tracker_that_have_one_value_are_both_reported():
    assert Status.CLUSTER_OVERFLOW == TrackStatus.POSE_FROM_BOXES
    report = SequenceReport("drive")
    detections = types.SimpleNamespace(status=int(Status.CLUSTER_OVERFLOW))
    tracked = types.SimpleNamespace(
        name="a", detections=detections, status=TrackStatus.POSE_FROM_BOXES, pose_source="boxes"
    )
    report.add(tracked, {"boxes": []}, min_score=0.0)
    assert report.to_json()["status"] == {"CLUSTER_OVERFLOW": 1, "POSE_FROM_BOXES": 1}
    overflow, source = report.warnings()
    assert overflow.startswith("drive: 1 of 1 sweeps, a first: CLUSTER_OVERFLOW")
    assert source.startswith("drive: 1 of 1 sweeps: POSE_FROM_BOXES")


def test_settings_of_the_tracker_are_changed_by_name():
    assert chosen_track_config(["max_misses=6", "gate=9.5"]).max_misses == 6.0
    with pytest.raises(io.InputError, match="--track-set: gate: write it as FIELD=VALUE"):
        chosen_track_config(["gate"])


def test_a_failure_leaves_an_earlier_file_as_it_was(tmp_path):
    wanted = {"coasting": False, "points": False, "pictures": False, "video": True, "gif": False}
    files = functools.partial(SequenceFiles, **wanted, text_min_score=0.0)
    (tmp_path / "a.mp4").write_bytes(b"earlier")

    def fail():
        with files(tmp_path, "a", frozenset()) as opened:
            for index in range(3):
                opened.add_pictures("a", np.zeros((20, 30, 3), np.uint8), None, index * 10**8)
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == b"earlier"
