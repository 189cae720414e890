"""`jaxbox live` as a user runs it: lines of JSON, the summary, exit codes, the page and what it changes."""

import json

import numpy as np
import pytest
from test_cli import CAPACITY, make_small_sweep, run

from jaxbox import io
from jaxbox.cli import live as command
from jaxbox.live import page
from jaxbox.live.records import LiveRecords

NUM_SWEEPS, STEP_M = 5, 1.0
# The machine may be busy: nothing is to be skipped where that is not the question.
SLOWLY = ("--rate-hz", 2, "--capacity", CAPACITY, "--poses", "boxes")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A standing street, past which the sensor drives."""
    folder = tmp_path_factory.mktemp("drive")
    street = make_small_sweep(6)
    for frame in range(NUM_SWEEPS):
        io.write_bin(folder / f"{frame:06d}.bin", street.xyz - np.float32([STEP_M * frame, 0, 0]))
    return folder


@pytest.fixture(scope="module")
def lines(drive):
    """What a whole run prints."""
    result = run("live", drive, "--json", *SLOWLY)
    assert result.exit_code == 0, result.output
    return [json.loads(line) for line in result.stdout.splitlines()]


def test_each_sweep_is_a_line_with_its_tracks_and_latency(lines):
    *records, last = lines
    assert [record["name"] for record in records] == [f"{frame:06d}" for frame in range(NUM_SWEEPS)]
    assert [record["frame"] for record in records] == list(range(NUM_SWEEPS))
    np.testing.assert_allclose([record["time_s"] for record in records], 0.5 * np.arange(NUM_SWEEPS))
    assert {record["pose_source"] for record in records} == {"boxes"}
    assert all(record["latency_ms"] > 0 and record["num_points"] > 1000 for record in records)
    ids = [{box["id"] for box in record["boxes"]} for record in records]
    assert ids[-1] & ids[0]
    summary = last["summary"]
    assert (summary["done"], summary["skipped"], summary["faults"]) == (NUM_SWEEPS, 0, 0)
    latencies = [record["latency_ms"] for record in records]
    assert summary["latency_p50_ms"] == pytest.approx(np.median(latencies), abs=0.01)


def test_a_broken_sweep_is_reported_and_the_exit_code_is_1(drive, tmp_path):
    for name, contents in (("000000", (drive / "000000.bin").read_bytes()), ("000001", b"cut off")):
        (tmp_path / f"{name}.bin").write_bytes(contents)
    result = run("live", tmp_path, *SLOWLY, "--no-track")
    assert result.exit_code == 1
    assert "000001.bin: 7 bytes" in result.stderr
    assert "1 sweep, 0 skipped, 1 fault," in result.stdout


def test_ctrl_c_ends_it_with_a_summary(drive, monkeypatch):
    record = LiveRecords.result

    def interrupted(self, live):
        if live.sweep.frame == 2:
            raise KeyboardInterrupt
        return record(self, live)

    monkeypatch.setattr(LiveRecords, "result", interrupted)
    result = run("live", drive, "--json", *SLOWLY, "--no-track", "--loop")
    assert result.exit_code == 130
    *records, last = map(json.loads, result.stdout.splitlines())
    assert last["summary"]["interrupted"]
    assert last["summary"]["done"] == len(records) == 2
    assert "id" not in records[0]["boxes"][0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--poses", "gps"), "--poses gps: choose one of auto, kiss-icp"),
        (("--rate-hz", 0), "--rate-hz is 0"),
        (("--rate-hz", "inf"), "--rate-hz is inf"),
        (("--timeout", 0), "--timeout is 0"),
    ],
)
def test_wrong_options_are_said(drive, options, message):
    result = run("live", drive, *options)
    assert result.exit_code == 2
    assert message in result.output


def test_a_path_without_sweeps_is_said(tmp_path):
    result = run("live", tmp_path)
    assert result.exit_code == 2
    assert "no points there" in result.stderr


def test_the_page_draws_the_newest_sweep_and_hands_thresholds_on(drive, monkeypatch):
    drawn, used = [], []

    class FakePage:
        def __init__(self, server, wanted, *, num_sweeps):
            assert num_sweeps == 1

        def connect(self, viewer):
            self.viewer = viewer

        def show_scene(self, scene, *_):
            drawn.append(scene)
            if len(drawn) == 1:
                self.viewer.want_threshold("vehicles.min_score", 0.5)

        def show_words(self, answer, **_):
            assert "000" in answer
            assert "from the end of the sweep to its boxes" in answer
            assert "compiled" not in answer

        def follow(self, wanted):
            pass

    class FakeServer:
        def stop(self):
            pass

    monkeypatch.setattr(page, "open_server", lambda **_: FakeServer())
    monkeypatch.setattr(page, "page_url", lambda _: "http://page")
    monkeypatch.setattr(page, "ViserPage", FakePage)
    use = command.LiveRun.use
    monkeypatch.setattr(command.LiveRun, "use", lambda run, config: (used.append(config), use(run, config)))
    result = run("live", drive, "--view", *SLOWLY)
    assert result.exit_code == 0, result.output
    assert "http://page" in result.stderr
    assert 1 <= len(drawn) <= NUM_SWEEPS + 1
    assert all(len(scene.points) > 1000 for scene in drawn)
    assert [config.vehicles.min_score for config in used] == [0.5]
