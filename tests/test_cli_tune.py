"""`jaxbox tune` from end to end on small sweeps: what it writes, what it refuses, and being interrupted."""

import csv
import dataclasses
import json
import shutil

import pytest
from typer.testing import CliRunner

import jaxbox
from jaxbox import synthetic
from jaxbox.cli import app
from jaxbox.cli.tune import drive_files, frame_groups, time_left
from jaxbox.io import (
    objects_from_detections,
    open_sweeps,
    read_config,
    write_bin,
    write_calibration,
    write_labels,
)
from jaxbox.run.compiled import count_compilations
from jaxbox.tuning import Bench, Trial
from jaxbox.types import PointCloud

NUM_SWEEPS = 3
FILES = ["best.json", "report.json", "report.md", "trials.csv"]
# Cars of this length are completed to boxes that overlap with none of the labels enough.
WRONG = "vehicles.classes.0.length_m=6.2"
SEARCH = "vehicles.classes.0.length_m=3.6:4.4"


@pytest.fixture(scope="module")
def kitti_folder(tmp_path_factory):
    """Small synthetic sweeps; what the default settings find in them are their labels."""
    root = tmp_path_factory.mktemp("kitti") / "training"
    for folder in ("velodyne", "calib", "label_2"):
        (root / folder).mkdir(parents=True)
    for seed in range(NUM_SWEEPS):
        sweep = synthetic.make_sweep(seed, num_azimuths=250)
        name = f"{seed:06d}"
        write_bin(root / "velodyne" / f"{name}.bin", sweep.xyz, sweep.intensity)
        write_calibration(root / "calib" / f"{name}.txt", sweep.calibration)
        found = jaxbox.detect(PointCloud.from_numpy(sweep.xyz, sweep.intensity))
        objects = objects_from_detections(found, sweep.calibration)
        labels = [dataclasses.replace(item, truncation=0, occlusion=0, score=None) for item in objects]
        write_labels(root / "label_2" / f"{name}.txt", labels)
    return root


@pytest.fixture
def drives(tmp_path):
    path = tmp_path / "drives.txt"
    path.write_text("".join(f"{seed:06d} drive_{seed}\n" for seed in range(NUM_SWEEPS)))
    return path


def tune(kitti_folder, output, *arguments):
    options = ("tune", "--labels", kitti_folder, "--output", output, "--copies", 1, *arguments)
    return CliRunner().invoke(app, [str(option) for option in options])


def read_report(output):
    return json.loads((output / "report.json").read_text())


def test_the_time_left_is_that_of_the_median_trial():
    done = [
        Trial(index=row, changes={}, blind=True, matches=(), scores=(), scores_without={}, seconds=seconds)
        for row, seconds in enumerate((90.0, 4.0, 6.0))
    ]
    assert time_left(done, 3 + 60) == "0:06:00"
    assert time_left(done, 3) == "0:00:00"


def test_a_wrong_base_is_told_from_a_better_setting_on_drives_left_out(kitti_folder, drives, tmp_path):
    output = tmp_path / "tune"
    arguments = ("--set", WRONG, "--search", SEARCH, "--trials", 4, "--drives", drives)
    result = tune(kitti_folder, output, *arguments)
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in output.iterdir()) == FILES
    report = read_report(output)
    assert [row["trial"] for row in report["trials"]] == [0, 1, 2, 3]
    assert report["trials"][0]["changes"] == {}
    assert report["base"]["mean"] < report["held_out"]["mean"] <= report["best"]["mean"] <= report["ceiling"]
    assert [row["group"] for row in report["held_out"]["groups"]] == ["drive_0", "drive_1", "drive_2"]
    assert not report["held_out"]["keep_base"]
    assert f"Take trial {report['best']['trial']}" in result.stdout
    headline = f"Leave one drive out: {report['held_out']['mean']:.2f}"
    assert (output / "report.md").read_text().splitlines()[2].startswith(headline)
    assert f"Take trial {report['best']['trial']}" in (output / "report.md").read_text()
    best = json.loads((output / "best.json").read_text())
    assert best == {"preset": "default"} | report["best"]["changes"]
    assert 3.6 <= best["vehicles.classes.0.length_m"] <= 4.4


def test_the_preset_of_a_settings_file_is_the_base_and_the_best_settings_name_it(kitti_folder, tmp_path):
    settings = tmp_path / "mine.toml"
    settings.write_text('preset = "paper"\nvehicles.max_overlap = 0.2\n')
    output = tmp_path / "tune"
    result = tune(kitti_folder, output, "--config", settings, "--trials", 1)
    assert result.exit_code == 0, result.output
    assert read_report(output)["preset"] == "paper"
    assert "Settings tried on the paper preset" in (output / "report.md").read_text()
    assert json.loads((output / "best.json").read_text()) == {"preset": "paper", "vehicles.max_overlap": 0.2}
    assert read_config(output / "best.json") == read_config(settings)


def test_no_trial_compiles_the_detector_again(kitti_folder, tmp_path):
    assert tune(kitti_folder, tmp_path / "a", "--trials", 1).exit_code == 0
    before = count_compilations()
    result = tune(kitti_folder, tmp_path / "b", "--trials", 3)
    assert result.exit_code == 0, result.output
    assert count_compilations() == before
    assert read_report(tmp_path / "b")["num_compilations"] == 0


def test_the_seed_decides_the_trials_and_refining_follows_them(kitti_folder, tmp_path):
    arguments = ("--set", WRONG, "--search", SEARCH, "--trials", 5, "--refine", 2, "--seed")
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        result = tune(kitti_folder, tmp_path / name, *arguments, seed)
        assert result.exit_code == 0, result.output
    files = {name: (tmp_path / name / "trials.csv").read_text() for name in "abc"}
    assert files["a"] == files["b"] != files["c"]
    rows = list(csv.DictReader(files["a"].splitlines()))
    assert [row["blind"] for row in rows] == ["True"] * 3 + ["False"] * 2
    assert rows[0]["vehicles.classes.0.length_m"] == "6.2"


def test_without_drives_each_sweep_is_left_out_and_the_report_says_so(kitti_folder, tmp_path):
    result = tune(kitti_folder, tmp_path / "tune", "--trials", 1)
    assert read_report(tmp_path / "tune")["num_groups"] == NUM_SWEEPS
    for text in (result.stdout, (tmp_path / "tune" / "report.md").read_text()):
        assert "No drives were given" in text
        assert "Keep the base" in text


def copy_sweeps(kitti_folder, root, names, chosen):
    """Some of the sweeps in another folder, under other names, and the drives beside them."""
    for folder, suffix in (("velodyne", "bin"), ("calib", "txt"), ("label_2", "txt")):
        (root / "training" / folder).mkdir(parents=True)
        for name, old in zip(names, chosen, strict=True):
            target = root / "training" / folder / f"{name}.{suffix}"
            shutil.copy(kitti_folder / folder / f"{old}.{suffix}", target)
    (root / "drives.txt").write_text("".join(f"{name} drive_{root.name} 5\n" for name in names))


def group_sizes(output):
    return {row["group"]: row["num_frames"] for row in read_report(output)["held_out"]["groups"]}


def test_several_folders_are_pooled_and_grouped_by_the_drives_beside_them(kitti_folder, tmp_path):
    names = [f"{seed:06d}" for seed in range(NUM_SWEEPS)]
    copy_sweeps(kitti_folder, tmp_path / "one", names[:1], names[:1])
    # A frame of this folder has the name of one of the other's.
    copy_sweeps(kitti_folder, tmp_path / "two", names[:-1], names[1:])
    both = ("--labels", tmp_path / "one", "--trials", 1)
    result = tune(tmp_path / "two" / "training", tmp_path / "tune", *both)
    assert result.exit_code == 0, result.output
    report = read_report(tmp_path / "tune")
    assert (report["num_frames"], report["group_kind"]) == (NUM_SWEEPS, "drive")
    assert group_sizes(tmp_path / "tune") == {"drive_one": 1, "drive_two": NUM_SWEEPS - 1}
    assert "taken for one drive" not in result.stdout
    (tmp_path / "one" / "drives.txt").unlink()
    result = tune(tmp_path / "two", tmp_path / "half", *both)
    assert result.exit_code == 0, result.output
    assert group_sizes(tmp_path / "half") == {"training": 1, "drive_two": NUM_SWEEPS - 1}
    note = f"No drives.txt is with {tmp_path / 'one'}: each folder or recording is taken for one drive."
    assert note in (tmp_path / "half" / "report.md").read_text()
    (tmp_path / "two" / "drives.txt").write_text(f"{names[0]} drive_two\n")
    refused = tune(tmp_path / "two", tmp_path / "none", *both)
    assert refused.exit_code == 2
    assert "no drive for 1 of 2 frames, the first is 000001" in refused.stderr


def test_frames_of_one_name_have_the_drives_of_their_folders(kitti_folder, tmp_path):
    names = [f"{seed:06d}" for seed in range(NUM_SWEEPS)]
    for folder, number in (("one", 1), ("two", 2)):
        copy_sweeps(kitti_folder, tmp_path / folder, names[:number], names[:number])
    folders = [tmp_path / "one", tmp_path / "two"]
    sweeps = open_sweeps(folders)
    pooled = [sweep.name for sweep in sweeps]
    assert pooled == ["one_training_velodyne_000000", "two_training_velodyne_000000", "000001"]
    by_drive = ["drive_one", "drive_two", "drive_two"]
    assert frame_groups(sweeps, pooled, drive_files(folders, None)) == (
        "drive",
        dict(zip(pooled, by_drive, strict=True)),
    )
    given = tmp_path / "given.txt"
    given.write_text("".join(f"{name} {drive}\n" for name, drive in zip(pooled, "aba", strict=True)))
    groups = frame_groups(sweeps, pooled, drive_files(folders, given))
    assert groups == ("drive", dict(zip(pooled, "aba", strict=True)))
    mixed = dict(zip(folders, (given, None), strict=True))
    given.write_text("000000 a\n")
    assert frame_groups(sweeps, pooled, mixed) == (
        "drive",
        dict(zip(pooled, ["a", *["training"] * 2], strict=True)),
    )
    kind, groups = frame_groups(sweeps, pooled, dict.fromkeys(folders))
    assert kind == "folder"
    assert groups[pooled[0]] != groups[pooled[1]] == groups[pooled[2]]


def test_folders_are_listed_once_however_many_files_say_their_drives(kitti_folder, tmp_path, monkeypatch):
    for folder in ("one", "two"):
        copy_sweeps(kitti_folder, tmp_path / folder, ["000000"], ["000000"])
    folders = [tmp_path / "one", tmp_path / "two"]
    sweeps = open_sweeps(folders)
    monkeypatch.setattr("pathlib.Path.iterdir", None)
    _, groups = frame_groups(sweeps, [sweep.name for sweep in sweeps], drive_files(folders, None))
    assert list(groups.values()) == ["drive_one", "drive_two"]


def test_the_drives_beside_the_folders_of_a_pattern_are_found(tmp_path):
    for folder in ("one", "two"):
        (tmp_path / folder / "training").mkdir(parents=True)
        (tmp_path / folder / "drives.txt").touch()
    files = drive_files([tmp_path / "*" / "training"], None)
    assert files == {tmp_path / name / "training": tmp_path / name / "drives.txt" for name in ("one", "two")}


def interrupt_at(monkeypatch, index):
    run = Bench.run

    def interrupted(bench, trial, *arguments, **options):
        if trial == index:
            raise KeyboardInterrupt
        return run(bench, trial, *arguments, **options)

    monkeypatch.setattr(Bench, "run", interrupted)


def test_interrupted_it_reports_the_trials_that_are_done(kitti_folder, tmp_path, monkeypatch):
    interrupt_at(monkeypatch, 2)
    output = tmp_path / "tune"
    result = tune(kitti_folder, output, "--trials", 9)
    assert result.exit_code == 130
    assert sorted(path.name for path in output.iterdir()) == FILES
    report = read_report(output)
    assert report["interrupted"]
    assert len(report["trials"]) == 2
    assert report["held_out"] is not None
    assert "2 of 9 trials (interrupted; seed 0)" in result.stdout
    assert len((output / "trials.csv").read_text().splitlines()) == 1 + 2


def test_interrupted_before_the_base_is_scored_it_writes_nothing(kitti_folder, tmp_path, monkeypatch):
    interrupt_at(monkeypatch, 0)
    result = tune(kitti_folder, tmp_path / "tune")
    assert result.exit_code == 130
    assert "nothing to report" in result.stderr
    assert list((tmp_path / "tune").iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--search", "box.num_angles=10:90"), "box.num_angles is static"),
        (("--search", "vehicles.ring_wieght=1:2"), "nearest traced settings: vehicles.ring_weight"),
        (("--search", "vehicles.ring_m=1:2", "--search", "vehicles.ring_m=1:3"), "stands there twice"),
        (("--search", "vehicles.max_overlap=0.5:1.5"), "vehicles.max_overlap is 1.5; it must be"),
        (("--trials", "5", "--refine", "5"), "--refine 5: these are among the --trials 5"),
        (("--objective", "f1"), "choose one of soft, 3d, bev"),
        (("--drives", "nowhere.txt"), "nowhere.txt"),
        (("--copies", "99"), "copies"),
        (("--trials", "0"), "trials"),
    ],
)
def test_what_cannot_be_searched_ends_with_exit_code_2(kitti_folder, tmp_path, arguments, expected):
    result = tune(kitti_folder, tmp_path / "tune", *arguments)
    assert result.exit_code == 2
    assert expected in result.stderr
    assert not (tmp_path / "tune").exists()


def test_sweeps_without_labels_are_refused(kitti_folder, tmp_path):
    result = tune(kitti_folder / "velodyne" / "000000.bin", tmp_path / "tune", "--trials", 1)
    assert result.exit_code == 0, "a sweep knows its labels"
    (tmp_path / "bare").mkdir()
    (tmp_path / "bare" / "0.bin").write_bytes((kitti_folder / "velodyne" / "000000.bin").read_bytes())
    refused = tune(tmp_path / "bare", tmp_path / "none")
    assert refused.exit_code == 2
    assert "no sweep there has labels" in refused.stderr
