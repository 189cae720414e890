"""`jaxbox detect --jobs`: the files of one process, also where a worker is killed or the run interrupted."""

import json
import multiprocessing
import os
import pathlib
import pickle
import signal

import numpy as np
import pytest
from test_cli import make_small_sweep, run, write_points
from test_io_formats import write_foxglove

from jaxbox import io
from jaxbox.cli.results import Results
from jaxbox.run import processes

COMMON = ("--preset", "paper", "--format", "both", "--format", "parquet", "--format", "mcap")
BROKEN = "000001"


@pytest.fixture(scope="session")
def street(tmp_path_factory):
    """Four sweeps in KITTI's layout; one has a point file that was cut short."""
    root = tmp_path_factory.mktemp("jobs") / "training"
    for number in range(4):
        sweep = make_small_sweep(number)
        write_points(root / "velodyne" / f"{number:06d}.bin", sweep)
        io.write_calibration(root / "calib" / f"{number:06d}.txt", sweep.calibration)
    (root / "velodyne" / f"{BROKEN}.bin").write_bytes(b"\0" * 17)
    return root


@pytest.fixture(scope="session")
def alone(street, tmp_path_factory):
    """What one process writes, and says."""
    output = tmp_path_factory.mktemp("alone")
    return output, run("detect", street, "--output", output, *COMMON)


def files_of(output):
    """Every file but the account, which has the time in it."""
    paths = [path for path in output.rglob("*") if path.is_file() and path.name != "run.json"]
    return {str(path.relative_to(output)): path.read_bytes() for path in paths}


def counts_of(stdout):
    """The line of each sweep, without its time."""
    return [line.rpartition(",")[0] for line in stdout.splitlines() if " points, " in line]


def account_of(output):
    return json.loads((output / "run.json").read_text())


@pytest.mark.slow
def test_two_jobs_write_the_files_of_one_though_a_worker_is_killed(street, alone, tmp_path, monkeypatch):
    call, killed = processes._Process.call, []

    def kill_once(process, item):
        if item.name == "000002" and not killed:
            killed.append(process._process.pid)
            os.kill(process._process.pid, signal.SIGKILL)
        return call(process, item)

    monkeypatch.setattr(processes._Process, "call", kill_once)
    result = run("detect", street, "--output", tmp_path, *COMMON, "--jobs", "2")
    output, one = alone
    assert result.exit_code == one.exit_code == 1
    found, expected = files_of(tmp_path), files_of(output)
    assert sorted(found) == sorted(expected)
    assert [name for name in expected if found[name] != expected[name]] == []
    # Two of each of three sweeps, the contact sheet, and what a resumed run needs of it, as a sweep failed.
    assert len([name for name in expected if name.endswith(".png")]) == 6 + 1 + 3
    reason = "its worker process ended (killed by SIGKILL, perhaps for want of memory)"
    told = [line for line in result.stderr.splitlines() if reason not in line]
    assert told == one.stderr.splitlines(), "failures are told as one process tells them"
    assert len(killed) == 1
    assert f"error: sweep 000002: {reason}; it is tried once more." in result.stderr
    account = account_of(tmp_path)
    assert account["repeated"][0]["sweep"] == "000002"
    assert account["failures"] == account_of(output)["failures"]
    assert account["failures"][0]["sweep"] == BROKEN
    assert counts_of(result.stdout) == counts_of(one.stdout) != []
    assert "in each of 2 processes" in result.stdout


def test_ctrl_c_ends_the_workers_and_what_is_done_is_whole(street, alone, tmp_path, monkeypatch):
    write = Results.write

    def interrupted(self, sweep, *arguments, **options):
        record = write(self, sweep, *arguments, **options)
        if sweep.name == "000002":
            for process in [*multiprocessing.active_children()]:
                os.kill(process.pid, signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
        return record

    # A process that was started in the background ignores Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(Results, "write", interrupted)
            result = run("detect", street, "--output", tmp_path, *COMMON, "--jobs", "2")
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.exit_code == 130
    assert "--resume goes on" in result.stderr
    assert "worker" not in result.stderr
    assert multiprocessing.active_children() == []
    assert account_of(tmp_path)["interrupted"]
    assert [record["name"] for record in io.read_jsonl(tmp_path / "detections.jsonl")] == ["000000", "000002"]
    assert run("detect", street, "--output", tmp_path, *COMMON, "--resume").exit_code == 1
    assert (tmp_path / "detections.jsonl").read_bytes() == (alone[0] / "detections.jsonl").read_bytes()


def test_sweeps_of_recordings_can_be_sent_to_processes(tmp_path):
    write_foxglove(tmp_path / "drive.mcap", ["/front"])
    (first, *_) = io.open_sweeps(tmp_path / "drive.mcap")
    again = pickle.loads(pickle.dumps(first))
    np.testing.assert_array_equal(again.read_points()[0], first.read_points()[0])
    assert pathlib.Path(again.points_path) == tmp_path / "drive.mcap"
