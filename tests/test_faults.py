"""`jaxbox detect` when things fail: killed, no room, no permission, vanished inputs, sudden signals."""

import importlib
import json
import os
import pathlib
import signal
import subprocess
import sys
import tempfile

import numpy as np
import pytest
from test_cli import make_small_sweep, run, write_points
from test_cli_formats import heard_ctrl_c, records_of

from jaxbox import io
from jaxbox.cli.run_sheet import TILE_FOLDER
from jaxbox.io import parquet
from jaxbox.run import cache

FORMATS = [word for name in ("kitti", "jsonl", "parquet", "mcap") for word in ("--format", name)]


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory):
    """Three streets with a camera."""
    folder = tmp_path_factory.mktemp("streets")
    for seed in range(3):
        sweep = make_small_sweep(seed)
        write_points(folder / "velodyne" / f"{seed}.bin", sweep)
        io.write_calibration(folder / "calib" / f"{seed}.txt", sweep.calibration)
    return folder


def detect(sweeps, output, *words):
    return run("detect", sweeps, "--output", output, "--no-pictures", *FORMATS, *words)


def names_of(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def faults(monkeypatch):
    """The program whose short version this is."""
    monkeypatch.syspath_prepend(str(pathlib.Path(__file__).parents[1]))
    return importlib.import_module("quality.faults")


# --- killed -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_killed_and_resumed_a_run_ends_as_if_nothing_had_happened(tmp_path, faults, monkeypatch):
    # Processes of their own, which share the compiled detector of these tests.
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path / "cache"))
    # The preset that each of them has soonest.
    monkeypatch.setattr(faults, "OPTIONS", (*faults.OPTIONS, "--preset", "paper"))
    faults.write_sweeps(tmp_path / "sweeps", 2)
    report = faults.kill_and_resume(tmp_path / "sweeps", tmp_path, kills=3, seed=1)
    assert report["kills"] == 3
    assert (report["differing"], report["half_written"], report["final_exit_code"]) == ([], [], 0)
    # Settings, JSON Lines, Parquet and the contact sheet; a text and two pictures a sweep.
    assert report["files"] == 4 + 2 * 3


WRITE_AND_DIE = """
import os, signal, sys
from jaxbox import io
with io.atomic_writer(sys.argv[1]) as handle:
    handle.write("half")
    handle.flush()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_writers_file_is_taken_away_and_a_living_ones_is_not(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")
    command = [sys.executable, "-c", WRITE_AND_DIE, target]
    assert subprocess.run(command, check=False, timeout=120).returncode == -signal.SIGKILL
    assert len(names_of(tmp_path)) == 2, "its temporary file is left"
    with io.atomic_writer(tmp_path / "b.txt") as handle:
        handle.write("whole")
        io.remove_abandoned(tmp_path)
    assert names_of(tmp_path) == ["a.txt", "b.txt"]
    assert (target.read_text(), (tmp_path / "b.txt").read_text()) == ("old", "whole")
    io.remove_abandoned(tmp_path / "missing")


# --- nowhere to write -------------------------------------------------------------------------------


def fill_disk(monkeypatch, suffix):
    """Lets files of one kind be on a disk that is full; writes fail once they reach it, as real ones do."""
    make = tempfile.mkstemp

    def mkstemp(**options):
        if options["suffix"] != suffix:
            return make(**options)
        name = f"{options['dir']}/{options['prefix']}full{suffix}"
        os.symlink("/dev/full", name)
        return os.open(name, os.O_RDWR), name

    monkeypatch.setattr(tempfile, "mkstemp", mkstemp)


@pytest.mark.parametrize("kind", ["kitti", "jsonl", "parquet", "mcap"])
def test_a_full_disk_ends_the_run_with_the_mend_and_leaves_no_file(sweeps, tmp_path, monkeypatch, kind):
    fill_disk(monkeypatch, {"kitti": ".txt"}.get(kind, f".{kind}"))
    result = run("detect", sweeps, "--output", tmp_path, "--no-pictures", "--format", kind)
    assert result.exit_code == 2, result.output
    assert result.stderr.count("cannot be written (") == 1, "not once a sweep"
    assert "No space left on device" in result.stderr
    assert "run the same command with --resume" in result.stderr
    # A whole picture of the sheet may be there, which the run that resumes takes up.
    assert [name for name in names_of(tmp_path) if name != TILE_FOLDER] == ["config.toml", "run.json"]
    assert not json.loads((tmp_path / "run.json").read_text())["finished"]


LIMITED = """
import resource, sys
from jaxbox.__main__ import main
# Beyond this no file can grow: the same to a program as a disk or quota that is full.
import signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)),) * 2)
main()
"""


def test_a_file_that_cannot_grow_is_an_error_of_its_own_process_too(sweeps, tmp_path, monkeypatch):
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path / "cache"))
    command = [sys.executable, "-c", LIMITED, "300", "detect", sweeps, "--output", tmp_path / "out"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 2, done.stderr
    assert "out/run.json: cannot be written (File too large). Free space" in done.stderr
    assert names_of(tmp_path / "out") == []


def test_an_output_folder_that_cannot_be_made_or_written_is_named(sweeps, tmp_path):
    (tmp_path / "file").write_text("keep me")
    result = detect(sweeps, tmp_path / "file")
    assert result.exit_code == 2
    assert "file: cannot be written (File exists)" in result.stderr
    result = detect(sweeps, tmp_path / "file" / "below")
    assert "below: cannot be written (Not a directory)" in result.stderr
    # A folder that no one can write to, the superuser included.
    result = detect(sweeps, "/proc/self/fdinfo")
    assert result.exit_code == 2
    assert "/proc/self/fdinfo" in result.stderr
    assert "cannot be written (" in result.stderr
    assert (tmp_path / "file").read_text() == "keep me"


def test_a_failed_picture_is_a_failed_sweep_and_its_results_are_there(sweeps, tmp_path):
    (tmp_path / "pictures").write_text("in the way")
    result = run("detect", sweeps, "--output", tmp_path, "--format", "kitti")
    assert result.exit_code == 1
    assert "3 failed" in result.stdout
    assert {"0.txt", "1.txt", "2.txt"} <= set(names_of(tmp_path))


# --- inputs that vanish, signals --------------------------------------------------------------------


def test_an_input_that_vanishes_is_one_failed_sweep_and_comes_with_resume(sweeps, tmp_path, monkeypatch):
    gone, kept = sweeps / "velodyne" / "1.bin", sweeps / "kept"
    read = io.Sweep.read_points

    def vanishing(self):
        if self.name == "0":
            gone.rename(kept)
        return read(self)

    with monkeypatch.context() as patch:
        patch.setattr(io.Sweep, "read_points", vanishing)
        result = detect(sweeps, tmp_path)
    kept.rename(gone)
    assert result.exit_code == 1
    assert "sweep 1: " in result.stderr
    assert "1.bin: there is no such file" in result.stderr
    assert [record["name"] for record in records_of(tmp_path)] == ["0", "2"]
    (failure,) = json.loads((tmp_path / "run.json").read_text())["failures"]
    assert failure["sweep"] == "1"
    assert detect(sweeps, tmp_path, "--resume").exit_code == 0
    assert sorted(record["name"] for record in records_of(tmp_path)) == ["0", "1", "2"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_results_are_written_comes_after_them(sweeps, tmp_path, monkeypatch, number):
    made = parquet.box_rows

    def interrupted(record):
        # Between the sweep's name and its rows.
        os.kill(os.getpid(), number)
        return made(record)

    with monkeypatch.context() as patch, heard_ctrl_c():
        patch.setattr(parquet, "box_rows", interrupted)
        result = detect(sweeps, tmp_path)
    assert result.exit_code == 130
    assert "interrupted; the same command with --resume goes on." in result.stderr
    assert parquet.finished_parquet(tmp_path / "detections.parquet") == {"0"}
    (first,) = records_of(tmp_path)
    rows = importlib.import_module("pyarrow.parquet").read_table(tmp_path / "detections.parquet")
    assert rows.num_rows == len(first["boxes"]) > 0
    assert "0.txt" in names_of(tmp_path)
    assert detect(sweeps, tmp_path, "--resume").exit_code == 0
    assert [record["name"] for record in records_of(tmp_path)] == ["0", "1", "2"]


def test_names_that_no_terminal_can_print_are_detected_and_written(tmp_path):
    odd = tmp_path / os.fsdecode(b"\xff.npy")
    np.save(odd, np.zeros((0, 4)))
    result = run("detect", odd, "--output", tmp_path / "out", "--no-pictures", *FORMATS[2:])
    assert result.exit_code == 0, result.output
    assert [record["name"] for record in records_of(tmp_path / "out")] == ["\\xff"]
