"""`jaxbox detect` and `info` on other formats: what is written, resumed, interrupted and told to scripts."""

import contextlib
import csv
import errno
import json
import os
import pathlib
import shutil
import signal

import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from test_cli import CAPACITY, make_small_sweep, run, write_points
from test_io_formats import write_foxglove
from typer.testing import CliRunner

import jaxbox
from jaxbox import io
from jaxbox.cli import app, sweep_info
from jaxbox.config import DetectorConfig
from jaxbox.io import mcap_results, parquet
from jaxbox.io import rerun as rerun_results
from jaxbox.io.results import SweepResult
from jaxbox.types import PointCloud

ALL = [word for name in ("jsonl", "parquet", "mcap", "csv", "rerun") for word in ("--format", name)]
ONE_FILE = ALL[:8]
FILES = ["detections.jsonl", "detections.mcap", "detections.parquet", "detections.csv"]


@pytest.fixture(scope="session")
def sweeps(tmp_path_factory):
    """A street, the same with NaN at its end, and a sweep without points."""
    folder = tmp_path_factory.mktemp("sweeps")
    street = make_small_sweep(0)
    write_points(folder / "a.bin", street)
    np.save(folder / "b.npy", np.vstack([street.xyz, np.full((5, 3), np.nan)]))
    (folder / "c.bin").write_bytes(b"")
    return folder


@contextlib.contextmanager
def heard_ctrl_c():
    """A process that was started in the background ignores Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def detect(output, *arguments):
    return run("detect", *arguments, "--output", output, "--no-pictures")


def read_mcap(path):
    with path.open("rb") as file:
        return [(c.topic, m.log_time, m.data) for _, c, m in make_reader(file).iter_messages()]


def records_of(output):
    return io.read_jsonl(output / "detections.jsonl")


def rows_of(records):
    return [row for record in records for row in parquet.box_rows(record)]


@pytest.fixture(scope="session")
def written(sweeps, tmp_path_factory):
    """All formats of the three sweeps."""
    output = tmp_path_factory.mktemp("written")
    result = detect(output, *sorted(sweeps.iterdir()), *ALL, "--json")
    assert result.exit_code == 0, result.output
    return output, result


def test_the_formats_hold_the_same_boxes(written):
    output, _ = written
    records = records_of(output)
    assert [record["name"] for record in records] == ["a", "b", "c"]
    assert len(records[0]["boxes"]) > 0
    assert records[0]["boxes"] == records[1]["boxes"], "points without a place change nothing"
    table = pq.read_table(output / "detections.parquet")
    assert table.column_names == list(parquet.PARQUET_COLUMNS)
    assert table.to_pylist() == rows_of(records)
    rows = list(csv.DictReader((output / "detections.csv").read_text().splitlines()))
    texts = [{key: "" if v is None else str(v) for key, v in row.items()} for row in rows_of(records)]
    assert rows == texts
    messages = read_mcap(output / "detections.mcap")
    assert [json.loads(data) for topic, _, data in messages if topic == mcap_results.RECORDS_TOPIC] == records
    assert (output / "detections.rrd").read_bytes()[:3] == b"RRF"


def test_mcap_boxes_are_cubes_where_the_detector_put_them_and_points_are_read_back(written, sweeps):
    output, _ = written
    schema = pytest.importorskip("foxglove_schemas_protobuf.SceneUpdate_pb2")
    scenes = [m for m in read_mcap(output / "detections.mcap") if m[0] == mcap_results.BOXES_TOPIC]
    assert [time for _, time, _ in scenes] == [0, 10**8, 2 * 10**8], "times are unknown: ten a second"
    (entity,) = schema.SceneUpdate.FromString(scenes[0][2]).entities
    first = records_of(output)[0]["boxes"]
    assert len(entity.cubes) == len(entity.texts) == len(first)
    for cube, box in zip(entity.cubes, first, strict=True):
        assert [cube.pose.position.x, cube.pose.position.y, cube.pose.position.z] == box["center"]
        assert [cube.size.x, cube.size.y, cube.size.z] == box["size"]
        turn = cube.pose.orientation
        assert 2 * np.arctan2(turn.z, turn.w) == pytest.approx(box["heading"])
    again = io.open_sweeps(output / "detections.mcap")
    np.testing.assert_array_equal(again[0].read_points()[0], io.read_points(sweeps / "a.bin")[0])


def test_json_for_scripts_is_one_object_a_sweep_and_a_summary(written):
    output, result = written
    *lines, summary = [json.loads(line) for line in result.stdout.splitlines()]
    assert [line["boxes"] for line in lines] == [record["boxes"] for record in records_of(output)]
    assert all(line["detect_ms"] > 0 for line in lines)
    assert summary == {
        "summary": {"done": 3, "skipped": 0, "interrupted": False, "failures": [], "repeated": []}
    }


def test_the_exact_settings_and_versions_are_beside_the_results_and_make_them_again(sweeps, tmp_path):
    changes = ("--set", "vehicles.min_score=0.2", "--set", "vehicles.ring_weight=7.5")
    assert detect(tmp_path / "a", sweeps / "a.bin", "--format", "jsonl", *changes).exit_code == 0
    config = io.read_config(tmp_path / "a" / "config.toml")
    assert (config.vehicles.min_score, config.vehicles.ring_weight) == (0.2, 7.5)
    account = json.loads((tmp_path / "a" / "run.json").read_text())
    assert account["versions"]["jaxbox"] == jaxbox.__version__
    assert (account["finished"], account["num_done"]) == (True, 1)
    again = ("--config", tmp_path / "a" / "config.toml", "--format", "jsonl")
    assert detect(tmp_path / "b", sweeps / "a.bin", *again).exit_code == 0
    assert records_of(tmp_path / "a") == records_of(tmp_path / "b")


def test_resume_does_what_is_missing_and_keeps_what_is_there(sweeps, written, tmp_path, monkeypatch):
    paths = sorted(sweeps.iterdir())
    assert detect(tmp_path, *paths[:1], *ONE_FILE).exit_code == 0
    first = [(tmp_path / name).stat().st_mtime_ns for name in FILES]
    result = detect(tmp_path, *paths[:1], *ONE_FILE, "--resume")
    assert "0 sweeps done, 0 failed, 1 done before" in result.stdout
    assert [(tmp_path / name).stat().st_mtime_ns for name in FILES] == first, "nothing was written again"
    result = detect(tmp_path, *paths, *ONE_FILE, "--resume")
    assert "2 sweeps done, 0 failed, 1 done before" in result.stdout
    whole = written[0]
    assert records_of(tmp_path) == records_of(whole)
    assert pq.read_table(tmp_path / FILES[2]).equals(pq.read_table(whole / FILES[2]))
    assert parquet.finished_parquet(tmp_path / FILES[2]) == {"a", "b", "c"}, "also those without boxes"
    assert read_mcap(tmp_path / FILES[1]) == read_mcap(whole / FILES[1])
    assert (tmp_path / FILES[3]).read_text() == (whole / FILES[3]).read_text()


def test_resume_with_other_settings_or_a_file_that_cannot_be_continued_is_refused(sweeps, tmp_path):
    common = (sweeps / "c.bin", "--format", "jsonl")
    assert detect(tmp_path, *common).exit_code == 0
    result = detect(tmp_path, *common, "--resume", "--set", "vehicles.min_score=0.3", "--min-score", "0.5")
    assert result.exit_code == 2
    assert "vehicles.min_score, min_score differ" in result.stderr
    result = detect(tmp_path, *common, "--resume", "--format", "rerun")
    assert result.exit_code == 2
    assert "detections.rrd cannot be continued" in result.stderr
    other = tmp_path / "other"
    other.mkdir()
    shutil.copy(sweeps / "a.bin", other / "c.bin")
    result = detect(tmp_path, other / "c.bin", *common[1:], "--resume")
    assert result.exit_code == 2, "another drive's sweep of the same name is not done"
    assert f"run.json: the earlier run was of {sweeps / 'c.bin'}" in result.stderr
    for spoil in (lambda path: path.write_text('{"options": 1}'), pathlib.Path.unlink):
        spoil(tmp_path / "run.json")
        result = detect(tmp_path, *common, "--resume")
        assert result.exit_code == 2
        assert "run.json: --resume needs the options of the earlier run" in result.stderr
    (tmp_path / "config.toml").unlink()
    assert detect(tmp_path, *common, "--resume").exit_code == 0, "a run that was killed before it had begun"


def test_filters_choose_boxes_are_recorded_and_held_by_resume(sweeps, written, tmp_path):
    (tmp_path / "area.txt").write_text("0 -10\n20, -10\n20 10\n")
    common = (sweeps / "a.bin", "--format", "jsonl", "--classes", "vans,car", "--min-score", "0.005")
    found = jaxbox.detect(io.read_points(sweeps / "a.bin")[0], DetectorConfig())
    whole = records_of(written[0])[0]["boxes"]
    by_class = "--format", "jsonl", "--min-score", "0.005,car=0.3"
    assert detect(tmp_path / "by_class", sweeps / "a.bin", *by_class).exit_code == 0
    of_class = found.above({"car": 0.3, "van": 0.005, "truck": 0.005})
    boxes = records_of(tmp_path / "by_class")[0]["boxes"]
    np.testing.assert_array_equal([box["score"] for box in boxes], of_class.score)
    for name, area in (("rectangle", "-10,30,-10.5,10"), ("polygon", tmp_path / "area.txt")):
        output = tmp_path / name
        assert detect(output, *common, "--within", area).exit_code == 0
        options = json.loads((output / "run.json").read_text())["options"]
        kept = found.of(*options["classes"]).within(options["within"]).above(options["min_score"])
        boxes = records_of(output)[0]["boxes"]
        assert 0 < len(boxes) < len(whole)
        assert all(box in whole for box in boxes)
        np.testing.assert_array_equal([box["center"] for box in boxes], kept.center)
        result = detect(output, *common, "--within", "30", "--resume")
        assert result.exit_code == 2
        assert "within differ" in result.stderr
        assert detect(output, *common, "--within", area, "--resume").exit_code == 0


def test_settings_are_there_only_where_the_options_are_too(sweeps, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(io, "atomic_writer", full)
    assert detect(tmp_path, sweeps / "c.bin", "--format", "jsonl").exit_code == 2
    assert not (tmp_path / "config.toml").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_the_files_are_whole_and_the_rest_can_be_resumed(
    sweeps, written, tmp_path, monkeypatch, number
):
    paths = sorted(sweeps.iterdir())
    read = io.Sweep.read_points

    def interrupted(self):
        # It is read while "b" is computed, which may or may not be written by the time of the signal.
        if self.name == "c":
            os.kill(os.getpid(), number)
        return read(self)

    with monkeypatch.context() as patch, heard_ctrl_c():
        patch.setattr(io.Sweep, "read_points", interrupted)
        result = detect(tmp_path, *paths, *ONE_FILE)
    assert result.exit_code == 130
    assert "--resume goes on" in result.stderr
    done = [record["name"] for record in records_of(tmp_path)]
    assert done in (["a"], ["a", "b"])
    assert parquet.finished_parquet(tmp_path / FILES[2]) == set(done)
    assert json.loads((tmp_path / "run.json").read_text())["interrupted"]
    assert detect(tmp_path, *paths, *ONE_FILE, "--resume").exit_code == 0
    assert records_of(tmp_path) == records_of(written[0])


def test_a_recording_is_detected_with_its_times(tmp_path):
    write_foxglove(tmp_path / "drive.mcap", ["/front", "/rear"])
    result = detect(tmp_path / "out", tmp_path / "drive.mcap", "--format", "jsonl")
    assert result.exit_code == 2
    assert "choose one with --topic" in result.stderr
    arguments = ("--topic", "/rear", "--format", "jsonl", "--capacity", CAPACITY)
    assert detect(tmp_path / "out", tmp_path / "drive.mcap", *arguments).exit_code == 0
    assert [record["timestamp_ns"] for record in records_of(tmp_path / "out")] == [
        10**18 + 10**8 * index for index in range(3)
    ]


def test_a_failed_write_leaves_no_file(tmp_path):
    for kind in (parquet.PARQUET, mcap_results.MCAP_RESULTS, rerun_results.RERUN):
        with pytest.raises(KeyError), kind.open(tmp_path / kind.name, False) as write:
            write(SweepResult(record={}))
    assert list(tmp_path.iterdir()) == []


def test_a_rerun_recording_holds_the_image_with_the_edges_of_the_boxes(tmp_path):
    sweep = make_small_sweep(0, image=True)
    found = jaxbox.detect(PointCloud.from_numpy(sweep.xyz, sweep.intensity), DetectorConfig())
    record = io.detections_record("a", found)
    lines, colors = rerun_results._image_lines(record, sweep.calibration)
    assert len(lines) == len(colors) > 0
    assert np.isfinite(lines).all()
    common = {"xyz": sweep.xyz, "calibration": sweep.calibration}
    with rerun_results.open_rerun(tmp_path / "a.rrd") as write:
        write(SweepResult(record=record, image=sweep.image, **common))
    with rerun_results.open_rerun(tmp_path / "b.rrd") as write:
        write(SweepResult(record=record, **common))
    assert (tmp_path / "a.rrd").stat().st_size > (tmp_path / "b.rrd").stat().st_size + 10_000


# --- info -----------------------------------------------------------------------------------------


def test_info_says_what_a_sweep_looks_like(sweeps, data_root):
    result = run("info", data_root / "kitti_object/training/velodyne/000008.bin")
    assert result.exit_code == 0, result.output
    for text in ("122555 points, 0 NaN", "about 64 beams", "sensor 1.", "padded to 131072 points"):
        assert text in result.stdout
    found = json.loads(run("info", sweeps, "--json", "--sweeps", "9").stdout)
    assert [sweep["num_points"] > 0 for sweep in found["sweeps"]] == [True, False]
    assert found["fits"]["capacity"] == CAPACITY


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("num_beams", [16, 32, 64])
def test_beams_height_and_tilt_are_those_of_the_sensor(num_beams, shuffled):
    sweep = jaxbox.synthetic.make_sweep(2, num_beams=num_beams, num_azimuths=1000)
    xyz = np.random.default_rng(0).permutation(sweep.xyz) if shuffled else sweep.xyz
    found = sweep_info.look_at("a", np.vstack([xyz, [[np.nan] * 3, [0] * 3]]), np.zeros(len(xyz) + 2))
    assert (found.num_nonfinite, found.num_zero, found.has_intensity) == (1, 1, False)
    assert found.num_beams == num_beams
    assert found.sensor_height_m == pytest.approx(1.73, abs=0.15)
    assert found.tilt_deg < 4


def test_info_of_few_points_and_capacities_that_do_not_fit():
    empty = sweep_info.look_at("a", np.zeros((0, 3)), np.zeros(0))
    assert "no point to look at" in sweep_info.describe(empty)[-1]
    few = sweep_info.look_at("a", np.eye(3), np.zeros(3))
    assert (few.num_beams, few.sensor_height_m) == (None, None)
    assert "no ground plane" in "\n".join(sweep_info.describe(few))
    assert sweep_info.capacity_changes([np.zeros((10, 3))]) == {}
    crowd = np.random.default_rng(0).uniform([-50, -50, -2], [50, 50, 2], (200_000, 3))
    assert sweep_info.capacity_changes([crowd])["clustering.maps.0.max_cells"] > 14336


def test_help_offers_completion_and_has_examples():
    assert "--install-completion" in run("--help").stdout
    assert "Examples:" in run("detect", "--help").stdout
    assert app.registered_commands


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("jaxbox det", ["detect"]),
        ("jaxbox detect --preset pa", ["paper"]),
        ("jaxbox detect --set vehicles.ring_w", ["vehicles.ring_weight="]),
        ("jaxbox detect --engine ", ["local", "ray"]),
    ],
)
def test_the_shell_is_told_what_fits(words, expected):
    environment = {
        "_JAXBOX_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split(" ")) - 1),
    }
    result = CliRunner().invoke(app, [], env=environment, prog_name="jaxbox")
    assert result.exit_code == 0
    assert result.stdout.split() == expected
