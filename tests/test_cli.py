"""The command line: exit codes, files, one broken sweep among others, and what is printed."""

import dataclasses
import functools
import json
import os
import pathlib
import shutil
import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

import jaxbox
from jaxbox import synthetic
from jaxbox.cli import app, demo, eval_pictures, inputs
from jaxbox.cli.report import (
    SHOWN_MIN_SCORE,
    FrameOutcome,
    FrameReport,
    RunReport,
    describe_frame,
    describe_run,
)
from jaxbox.cli.run_sheet import TILE_FOLDER, TILE_FRAME
from jaxbox.config import DetectorConfig
from jaxbox.evaluation.report import read_folders
from jaxbox.io import (
    objects_from_detections,
    read_image,
    read_jsonl,
    read_labels,
    read_points,
    write_bin,
    write_calibration,
    write_labels,
)
from jaxbox.run.processes import THREADS_VARIABLE
from jaxbox.types import PointCloud, Status

# Few beams, so that all sweeps of this file share the smallest capacity and one compile.
CAPACITY = 16384
make_small_sweep = functools.partial(synthetic.make_sweep, num_azimuths=250)


def run(*arguments):
    """Runs a command in this process, so that the compiled detector is shared."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def write_points(path, sweep):
    write_bin(path, sweep.xyz, sweep.intensity)


@pytest.fixture(scope="session")
def kitti_folder(tmp_path_factory):
    """Two synthetic sweeps in KITTI's object layout; their detections are their labels."""

    root = tmp_path_factory.mktemp("kitti") / "training"
    for folder in ("velodyne", "calib", "label_2"):
        (root / folder).mkdir(parents=True)
    for seed in range(2):
        sweep = make_small_sweep(seed)
        write_points(root / "velodyne" / f"{seed:06d}.bin", sweep)
        write_calibration(root / "calib" / f"{seed:06d}.txt", sweep.calibration)
        cloud = PointCloud.from_numpy(sweep.xyz, sweep.intensity)
        assert cloud.capacity == CAPACITY
        objects = objects_from_detections(jaxbox.detect(cloud, DetectorConfig()), sweep.calibration)
        labels = [dataclasses.replace(item, truncation=0, occlusion=0, score=None) for item in objects]
        write_labels(root / "label_2" / f"{seed:06d}.txt", labels)
    return root


@pytest.fixture(scope="session")
def detected(kitti_folder, tmp_path_factory):
    """The two sweeps after `jaxbox detect`, with everything it writes."""
    output = tmp_path_factory.mktemp("detected")
    result = run("detect", kitti_folder, "--output", output, "--format", "both")
    assert result.exit_code == 0, result.output
    return output, result


def test_detect_writes_a_result_file_and_pictures_a_sweep(detected):
    output, _ = detected
    names = sorted(str(path.relative_to(output)) for path in output.rglob("*") if path.is_file())
    expected = ["config.toml", "contact_sheet.png", "detections.jsonl", "run.json"]
    for name in ("000000", "000001"):
        expected += [f"{name}.txt", f"pictures/{name}_boxes.png", f"pictures/{name}_lidar.png"]
    assert names == sorted(expected)
    assert read_image(output / "pictures" / "000000_boxes.png").shape == (720, 1200, 3)


def test_crops_are_the_points_in_the_boxes_in_the_order_of_the_results(kitti_folder, tmp_path, monkeypatch):
    # So sparse a street has no high scores.
    monkeypatch.setattr(inputs, "SHOWN_MIN_SCORE", 0.02)
    file = kitti_folder / "velodyne" / "000000.bin"
    result = run("detect", file, "--output", tmp_path, "--no-pictures", "--crops", "--classes", "car")
    assert result.exit_code == 0, result.output
    xyz, intensity = read_points(file)
    boxes = enumerate(jaxbox.detect(xyz, DetectorConfig()).of("car").above(0.02))
    inside = {f"000000_{row:03d}": mask for row, box in boxes if (mask := box.contains(xyz)).any()}
    crops = {path.stem: read_points(path) for path in (tmp_path / "crops").iterdir()}
    assert crops.keys() == inside.keys()
    assert len(crops) > 0
    for name, mask in inside.items():
        for cropped, points in zip(crops[name], (xyz, intensity), strict=True):
            np.testing.assert_array_equal(cropped, points[mask])


def test_no_sweep_fails_for_want_of_a_tile_of_the_contact_sheet(kitti_folder, tmp_path):
    root = tmp_path / "training"
    shutil.copytree(kitti_folder, root)
    (root / "label_2" / "000000.txt").write_text("rubbish\n")
    result = run("detect", root, "--output", tmp_path / "out", "--no-pictures")
    assert result.exit_code == 0, result.output
    assert "2 sweeps done, 0 failed" in result.stdout
    height, width, _ = read_image(tmp_path / "out" / "contact_sheet.png").shape
    assert width < 2 * TILE_FRAME.width_px, "the tile of the other sweep"
    assert height > TILE_FRAME.shape[0]


def test_both_formats_hold_the_same_boxes(detected):
    output, _ = detected
    for record in read_jsonl(output / "detections.jsonl"):
        lines = read_labels(output / f"{record['name']}.txt")
        scores = {round(box["score"], 5) for box in record["boxes"]}
        assert lines, "a street has vehicles"
        assert {round(line.score, 5) for line in lines} <= scores, "the camera sees some of them"


def test_detect_writes_every_score_and_cuts_where_asked(kitti_folder, detected, tmp_path):
    output, _ = detected
    sweep = make_small_sweep(0)
    found = jaxbox.detect(PointCloud.from_numpy(sweep.xyz, sweep.intensity), DetectorConfig())
    scores = [item.score for item in read_labels(output / "000000.txt")]
    assert scores == pytest.approx([item.score for item in objects_from_detections(found, sweep.calibration)])
    assert min(scores) < SHOWN_MIN_SCORE, "average precision needs the low scores too"
    file = kitti_folder / "velodyne" / "000000.bin"
    result = run("detect", file, "--output", tmp_path, "--no-pictures", "--min-score", SHOWN_MIN_SCORE)
    assert result.exit_code == 0, result.output
    kept = [item.score for item in read_labels(tmp_path / "000000.txt")]
    assert kept == [score for score in scores if score >= SHOWN_MIN_SCORE]


def test_detect_prints_counts_a_sweep_and_a_summary_with_compiling_apart(detected):
    _, result = detected
    lines = result.stdout.splitlines()
    assert [line.split(":")[0] for line in lines if line.startswith("00000")] == ["000000", "000001"]
    assert "2 sweeps done, 0 failed" in result.stdout
    assert "compiled (or loaded from the cache) once:" in result.stdout
    assert f"for {CAPACITY} points" in result.stdout
    assert "detector: median" in result.stdout


def test_eval_of_results_against_themselves_finds_every_car(kitti_folder, detected, tmp_path):
    output, _ = detected
    result = run(
        "eval", "--labels", kitti_folder, "--results", output,
        "--json", tmp_path / "eval.json", "--plots", tmp_path / "plots",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "eval.json").read_text())
    cars = report["selections"]["all"]
    assert cars["rates"][0]["num_labels"] > 0
    assert [rate["recall"] for rate in cars["rates"]] == [1.0] * 4
    assert cars["matched"]["sizes"]["pooled"]["mae"] == pytest.approx(0, abs=1e-6)
    for text in ("by range, m", "by LiDAR points", "axis swaps", "at least 50 points", "a frame"):
        assert text in result.stdout
    for text in ("constant: pooled", "Pearson", "1D IoU", "3D 0.7", "R40"):
        assert text in result.stdout
    assert sorted(path.name for path in (tmp_path / "plots").iterdir()) == ["dimensions.png", "residuals.png"]


def test_eval_draws_each_frame_and_one_contact_sheet(kitti_folder, detected, tmp_path):
    shutil.copytree(detected[0], tmp_path / "results", ignore=shutil.ignore_patterns("pictures"))
    result = run("eval", "--labels", kitti_folder, "--results", tmp_path / "results", "--pictures")
    assert result.exit_code == 0, result.output
    folder = tmp_path / "results" / "pictures"
    names = ["000000_eval.png", "000001_eval.png", "contact_sheet.png"]
    assert sorted(path.name for path in folder.iterdir()) == names
    sheet, tile = (read_image(folder / name) for name in ("contact_sheet.png", "000000_eval.png"))
    assert sheet.shape[1] > 2 * eval_pictures.TILE_WIDTH_PX
    assert tile.shape[0] > tile.shape[1] / 2, "the view from above alone: there is no image"


def test_eval_does_not_draw_through_a_link_either(tmp_path, kitti_folder, detected):
    output = tmp_path / "out"
    output.mkdir()
    for text in detected[0].glob("*.txt"):
        (output / text.name).write_text(text.read_text())
    for name, words in (("pictures", ["--pictures"]), ("plots", [])):
        elsewhere = tmp_path / f"elsewhere_{name}"
        elsewhere.mkdir()
        (output / name).symlink_to(elsewhere)
        result = run("eval", "--labels", kitti_folder, "--results", output, *words)
        assert result.exit_code == 2, result.output
        assert f"out/{name}: a link" in result.stderr
        assert not list(elsewhere.iterdir())
        (output / name).unlink()


def test_eval_with_many_frames_writes_several_sheets(kitti_folder, detected, tmp_path, monkeypatch):
    monkeypatch.setattr(eval_pictures, "TILES_PER_SHEET", 1)
    read = read_folders(kitti_folder, detected[0])
    paths = eval_pictures.write_judged_pictures(read, tmp_path, min_score=0.2)
    assert [path.name for path in paths] == ["contact_sheet_1.png", "contact_sheet_2.png"]


def test_eval_pictures_with_a_broken_image_end_with_exit_code_2_and_its_file(
    kitti_folder, detected, tmp_path
):
    root = tmp_path / "training"
    shutil.copytree(kitti_folder, root)
    (root / "image_2").mkdir()
    (root / "image_2" / "000001.png").write_bytes(b"no image")
    results = tmp_path / "results"
    shutil.copytree(detected[0], results, ignore=shutil.ignore_patterns("pictures", "*.png"))
    result = run("eval", "--labels", root, "--results", results, "--pictures")
    assert result.exit_code == 2
    assert "image_2/000001.png: not a readable image" in result.stderr
    assert not list(results.rglob("*.png"))


def test_eval_without_a_calibration_measures_but_cannot_draw(kitti_folder, detected, tmp_path):
    root = tmp_path / "training"
    shutil.copytree(kitti_folder, root)
    (root / "calib" / "000000.txt").unlink()
    arguments = ("eval", "--labels", root, "--results", detected[0], "--plots", tmp_path / "plots")
    assert run(*arguments).exit_code == 0
    drawn = run(*arguments, "--pictures")
    assert drawn.exit_code == 2
    assert "000000.bin: no calibration belongs to it" in drawn.stderr


def test_eval_says_which_result_is_missing_and_can_take_it_for_empty(kitti_folder, detected, tmp_path):
    results = tmp_path / "results"
    results.mkdir()
    shutil.copy(detected[0] / "000000.txt", results)
    arguments = ("eval", "--labels", kitti_folder, "--results", results)
    missing = run(*arguments)
    assert missing.exit_code == 2
    assert "000001.txt" in missing.stderr
    taken = run(*arguments, "--missing-as-empty")
    assert taken.exit_code == 0, taken.output
    assert "1 without results" in taken.stdout


def test_eval_of_a_protocol_detects_evaluates_and_goes_on_where_it_ended(kitti_folder, detected, tmp_path):
    results = tmp_path / "results"
    arguments = ("eval", "--protocol", "kitti-val", "--labels", kitti_folder, "--results", results)
    first = run(*arguments)
    assert first.exit_code == 0, first.output
    # Of the two sweeps there, the protocol lists the second.
    assert [path.name for path in results.glob("0*.txt")] == ["000001.txt"]
    assert (results / "000001.txt").read_bytes() == (detected[0] / "000001.txt").read_bytes()
    table = (results / "kitti-val.md").read_text()
    assert "only 1 of 3,769 frames" in table
    assert table in first.stdout
    rows = [line.split("|")[1].strip() for line in table.splitlines() if line.startswith("|")]
    assert rows[2:] == [
        *(f"Car, {name}, 0.7" for name in ("2D box", "orientation", "bird's-eye view", "3D")),
        *(f"Vehicle, {name}, 0.5" for name in ("bird's-eye view", "3D")),
    ]
    again = run(*arguments)
    assert again.exit_code == 0, again.output
    assert "0 sweeps done, 0 failed, 1 done before" in again.stdout
    assert (results / "kitti-val.md").read_text() == table
    other = run(*arguments, "--set", "vehicles.min_score=0.2")
    assert other.exit_code == 2
    assert "vehicles.min_score" in other.stderr


def test_eval_of_a_protocol_refuses_what_it_cannot_use(kitti_folder, tmp_path):
    without = tmp_path / "velodyne"
    without.mkdir()
    shutil.copy(kitti_folder / "velodyne" / "000000.bin", without)
    arguments = ("eval", "--labels", without, "--results", tmp_path / "out")
    for words, sentence in (
        (("--protocol", "kitti-val"), "none of the 3,769 frames of kitti-val"),
        (("--protocol", "kitti-val", "--tracking"), "--tracking: leave it out"),
        (("--jobs", "2"), "--jobs: it detects nothing"),
    ):
        result = run(*arguments, *words)
        assert result.exit_code == 2
        assert sentence in result.stderr
        assert not (tmp_path / "out").exists()


def test_eval_warns_where_the_run_left_boxes_out(kitti_folder, detected, tmp_path):
    arguments = ("eval", "--labels", kitti_folder, "--plots", tmp_path / "plots")
    assert "warning" not in run(*arguments, "--results", detected[0]).stderr
    filtered = shutil.copytree(detected[0], tmp_path / "filtered")
    account = json.loads((filtered / "run.json").read_text())
    account["options"] |= {"min_score": 0.3, "classes": ["van"]}
    (filtered / "run.json").write_text(json.dumps(account))
    result = run(*arguments, "--results", filtered)
    assert result.exit_code == 0
    assert "the run left boxes out (min_score 0.3; classes ['van'])" in result.stderr


def test_eval_with_drives_has_a_row_a_drive(kitti_folder, detected, tmp_path):
    drives = tmp_path / "drives.txt"
    drives.write_text("000000 first_street\n000001 second_street\n")
    arguments = ("eval", "--labels", kitti_folder, "--results", detected[0], "--drives", drives)
    result = run(*arguments, "--json", tmp_path / "eval.json")
    assert result.exit_code == 0, result.output
    rows = [line for line in result.stdout.splitlines() if "_street" in line]
    assert len(rows) == 2
    report = json.loads((tmp_path / "eval.json").read_text())
    assert report["num_drives"] == 2
    assert list(report["kitti"]["by_drive"]) == ["first_street", "second_street"]
    drives.write_text("000000 first_street\n")
    missing = run(*arguments)
    assert missing.exit_code == 2
    assert "the first is 000001" in missing.stderr


def test_changed_settings_reach_the_detector_and_the_last_change_holds(kitti_folder, tmp_path):
    settings = tmp_path / "best.json"
    settings.write_text(json.dumps({"vehicles.min_score": 0.9999, "vehicles.ring_weight": 8.5}))
    sweep = kitti_folder / "velodyne" / "000000.bin"
    common = ("detect", sweep, "--no-pictures", "--quiet", "--settings", settings)
    assert run(*common, "--output", tmp_path / "a").exit_code == 0
    assert run(*common, "--output", tmp_path / "b", "--set", "vehicles.min_score=0.001").exit_code == 0
    assert read_labels(tmp_path / "a" / "000000.txt") == []
    assert len(read_labels(tmp_path / "b" / "000000.txt")) > 0


def test_one_broken_sweep_is_reported_and_the_others_are_done(kitti_folder, tmp_path):
    root = tmp_path / "training"
    shutil.copytree(kitti_folder, root)
    (root / "velodyne" / "000000.bin").write_bytes(b"\0" * 17)
    output = tmp_path / "out"
    result = run("detect", root, "--output", output, "--no-pictures")
    assert result.exit_code == 1
    assert "000000.bin" in result.stderr
    assert "16" in result.stderr
    assert "1 sweeps done, 1 failed" in result.stdout
    names = [TILE_FOLDER, "000001.txt", "config.toml", "contact_sheet.png", "run.json"]
    assert sorted(path.name for path in output.iterdir()) == names
    account = json.loads((output / "run.json").read_text())
    assert (account["num_done"], account["failures"][0]["sweep"]) == (1, "000000")


def test_a_broken_sweep_leaves_an_earlier_result_whole(kitti_folder, detected, tmp_path):
    root = tmp_path / "training"
    shutil.copytree(kitti_folder, root)
    (root / "calib" / "000000.txt").write_text("P2: 1 2 3\n")
    output = tmp_path / "out"
    output.mkdir()
    shutil.copy(detected[0] / "000000.txt", output)
    before = (output / "000000.txt").read_bytes()
    result = run("detect", root / "velodyne" / "000000.bin", "--output", output, "--quiet")
    assert result.exit_code == 1
    assert "000000.txt" in result.stderr
    assert result.stdout == ""
    assert (output / "000000.txt").read_bytes() == before


def test_a_broken_image_is_reported_with_its_file(kitti_folder, tmp_path):
    root = tmp_path / "training"
    shutil.copytree(kitti_folder, root)
    (root / "image_2").mkdir()
    (root / "image_2" / "000000.png").write_bytes(b"no image")
    result = run("detect", root, "--output", tmp_path / "out", "--no-pictures")
    assert result.exit_code == 1
    assert "image_2/000000.png: not a readable image" in result.stderr


def test_sweeps_without_a_camera_are_written_as_json_lines(tmp_path):
    for seed in range(2):
        write_points(tmp_path / "sweeps" / f"{seed}.bin", make_small_sweep(seed))
    output = tmp_path / "out"
    result = run("detect", tmp_path / "sweeps", "--output", output, "--no-pictures", "--min-score", "0.01")
    assert result.exit_code == 0, result.output
    assert "no camera calibration" in result.stderr
    names = ["config.toml", "contact_sheet.png", "detections.jsonl", "run.json"]
    assert sorted(path.name for path in output.iterdir()) == names
    records = read_jsonl(output / "detections.jsonl")
    scores = [box["score"] for record in records for box in record["boxes"]]
    assert [record["name"] for record in records] == ["0", "1"]
    assert len(scores) > 0
    assert min(scores) >= 0.01


def test_an_empty_sweep_is_no_failure_and_its_status_is_in_words(tmp_path):
    (tmp_path / "empty.bin").write_bytes(b"")
    result = run("detect", tmp_path / "empty.bin", "--output", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "EMPTY: no finite point" in result.stdout
    assert "EMPTY in 1 of 1 sweeps" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("detect", "{tmp}/nowhere", "--output", "{tmp}/out"), "nowhere"),
        (("detect", "{tmp}", "--output", "{tmp}/out"), "no points"),
        (
            ("detect", "{tmp}", "--output", "{tmp}/out", "--preset", "best"),
            "choose one of default, accurate, fast, paper",
        ),
        (("detect", "{tmp}", "--output", "{tmp}/out", "--format", "xml"), "xml"),
        (("detect", "{tmp}", "--output", "{tmp}/out", "--min-score", "2"), "min-score"),
        (("detect", "{tmp}", "--output", "{tmp}/out", "--capacity", "0"), "capacity"),
        (("detect", "{tmp}"), "output"),
        (("detect", "{tmp}", "--output", "{tmp}/out", "--sensor-at", "0", "nan", "1"), "0.0 nan 1.0: give"),
        (
            ("detect", "{tmp}", "--output", "{tmp}/out", "--sensor-at", "inf", "0", "1"),
            "three finite numbers",
        ),
        (("detect", "{tmp}", "--output", "{tmp}/out", "--set", "box.angles=9"), "nearest are box."),
        (("detect", "{tmp}", "--output", "{tmp}/out", "--settings", "{tmp}/no.json"), "no.json"),
        (
            ("detect", "{tmp}", "--output", "{tmp}/out", "--set", "evidence.enabled=False"),
            "enable the evidence",
        ),
        (("eval", "--labels", "{tmp}/nowhere", "--results", "{tmp}"), "nowhere"),
        (("unknown",), "unknown"),
    ],
)
def test_bad_input_ends_with_exit_code_2_and_no_traceback(tmp_path, arguments, expected):
    result = run(*(argument.format(tmp=tmp_path) for argument in arguments))
    assert result.exit_code == 2
    assert expected in result.stderr
    assert "Traceback" not in result.output
    assert isinstance(result.exception, SystemExit)


def test_an_output_that_cannot_be_made_ends_with_exit_code_2(kitti_folder, tmp_path):
    (tmp_path / "file").write_text("")
    result = run("detect", kitti_folder, "--output", tmp_path / "file")
    assert result.exit_code == 2
    assert str(tmp_path / "file") in result.stderr


def test_plots_without_matplotlib_name_the_extra(kitti_folder, detected, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    result = run("eval", "--labels", kitti_folder, "--results", detected[0], "--plots", tmp_path)
    assert result.exit_code == 2
    assert "pip install 'jaxbox[plots]'" in result.stderr


def test_eval_without_matplotlib_prints_its_tables_and_says_why_there_are_no_plots(
    kitti_folder, detected, monkeypatch
):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    result = run("eval", "--labels", kitti_folder, "--results", detected[0])
    assert result.exit_code == 0
    assert "no plots: plots need matplotlib: pip install 'jaxbox[plots]'" in result.stdout.replace("\n", " ")


@pytest.mark.parametrize("command", ["demo", "detect", "eval", "info", "tune"])
def test_every_help_states_the_exit_codes(command):
    result = run(command, "--help")
    assert result.exit_code == 0
    assert "Exit codes: 0" in result.stdout


def test_info_names_versions_devices_and_presets(monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    result = run("info")
    assert result.exit_code == 0
    for text in ("jaxbox", "devices: ", "default", "paper", "not kept"):
        assert text in result.stdout


def test_demo_writes_a_picture_a_stage_and_compares_every_vehicle(tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "make_sweep", make_small_sweep)
    result = run("demo", "--output", tmp_path, "--seed", "1")
    assert result.exit_code == 0, result.output
    names = [path.name for path in sorted(tmp_path.iterdir())]
    stages = ("sweep", "no_ground", "clusters", "hulls", "boxes", "lidar", "image")
    assert names == [f"{number}_{stage}.png" for number, stage in enumerate(stages, start=1)]
    rows = [line for line in result.stdout.splitlines() if " m " in line and "│" in line]
    false = [row for row in rows if "false alarm at" in row]
    assert len(rows) - len(false) == demo.NUM_VEHICLES


def test_the_demo_tells_false_alarms_as_its_pictures_do():
    sweep = make_small_sweep(3)
    truth = sweep.boxes
    # Another box on the first vehicle, and one where there is none.
    rows = [0, 0, *range(1, len(truth)), 0]
    center = truth.center[rows].astype(float)
    center[-1, :2] = (30, 40)
    captions = tuple(f"box {row}" for row in range(len(rows)))
    boxes = demo.BoxSet(center=center, size=truth.size[rows], yaw=truth.yaw[rows], captions=captions)
    known, judged = demo.known_truth(boxes, sweep)
    false = demo.false_alarms(boxes, known, judged)
    assert np.flatnonzero(false).tolist() == [1, len(rows) - 1]
    table = demo.compare_with_truth(boxes, sweep, false)
    cells = {column.header: list(column.cells) for column in table.columns}
    assert cells["vehicle"][-1] == "false alarm at 50 m"
    assert cells["box"][-2:] == ["box 1", captions[-1]]


def test_the_picture_of_the_documentation_is_of_this_detector(tmp_path):
    result = run("demo", "--output", tmp_path)
    assert result.exit_code == 0, result.output
    drawn = read_image(tmp_path / "5_boxes.png")
    shown = read_image(pathlib.Path(__file__).parents[1] / "docs" / "demo.png")
    assert drawn.shape == shown.shape
    # Another processor rounds otherwise, which may move an edge by a pixel; a box more or less is .15 %.
    differing = np.any(drawn != shown, axis=-1).mean()
    assert differing < 0.001, "jaxbox demo --output out && cp out/5_boxes.png docs/demo.png"


def test_a_table_of_perfect_boxes_has_no_errors():
    sweep = make_small_sweep(3)
    truth = sweep.boxes
    boxes = demo.BoxSet(
        center=truth.center, size=truth.size, yaw=truth.yaw, captions=tuple("x" for _ in range(len(truth)))
    )
    table = demo.compare_with_truth(boxes, sweep, np.zeros(len(truth), bool))
    cells = {column.header: list(column.cells) for column in table.columns}
    assert set(cells["length"]) == {"+0.00"}
    assert set(cells["yaw"]) == {"+0.0"}
    assert set(cells["BEV IoU"]) == {"1.00"}


def test_the_module_runs_as_a_program_and_prints_its_version():
    command = [sys.executable, "-m", "jaxbox", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0.1.0"


def test_every_status_bit_is_described_for_a_sweep_and_counted_for_a_run(kitti_folder):

    cloud = PointCloud.from_numpy(np.zeros((0, 3)), capacity=CAPACITY)
    every = Status(sum(Status))
    detections = dataclasses.replace(jaxbox.detect(cloud, DetectorConfig()), status=np.int32(every))
    frame = FrameReport(name="a", num_points=0, detections=detections, detect_s=0.1, other_s=0.1)
    lines = describe_frame(frame)
    assert len(lines) == 1 + len([bit for bit in Status if bit])
    summary = "\n".join(describe_run(RunReport(frames=[FrameOutcome.of(frame)], failures=[("b", "why")])))
    assert all(f"{bit.name} in 1 of 1 sweeps" in summary for bit in Status if bit)
    assert "failed: b: why" in summary


def test_results_without_scores_end_with_exit_code_2_and_the_file(kitti_folder, detected, tmp_path):
    folder = tmp_path / "results"
    shutil.copytree(detected[0], folder)
    file = next(file for file in sorted(folder.glob("*.txt")) if file.read_text())
    rows = [line.rsplit(" ", 1)[0] for line in file.read_text().splitlines()]
    file.write_text("\n".join(rows) + "\n")
    result = run("eval", "--labels", kitti_folder, "--results", folder)
    assert result.exit_code == 2
    assert str(file) in result.stderr.replace("\n", "")


@pytest.mark.parametrize(("asked", "taken"), [(None, "1"), ("3", "3")])
def test_xla_is_told_to_take_one_thread_unless_the_user_names_another_number(monkeypatch, asked, taken):
    monkeypatch.setenv(THREADS_VARIABLE, asked or "")
    if asked is None:
        monkeypatch.delenv(THREADS_VARIABLE)
    assert CliRunner().invoke(app, ["info"]).exit_code == 0
    assert os.environ[THREADS_VARIABLE] == taken
