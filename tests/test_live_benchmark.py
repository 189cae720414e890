"""The benchmark of `jaxbox live`: what it asks of the command, and what is recorded of it."""

import json
import pathlib

from benchmarks import bench_live as bench

RESULTS = pathlib.Path(__file__).parents[1] / "benchmarks" / "results"


def test_every_source_is_measured_with_poses_of_each_kind_and_without_tracks(monkeypatch):
    asked = []
    monkeypatch.setattr(bench, "measure", lambda source, options, seconds: asked.append(options) or {})
    found = [(row["source"], row["poses"]) for row in bench.rows(1.0)]
    assert found == [(source, poses) for source in bench.CAPACITIES for poses in (*bench.POSES, "no tracks")]
    assert asked[:4] == [*(("--poses", poses) for poses in bench.POSES), ("--no-track",)]


def test_the_record_is_of_these_sources():
    rows = json.loads((RESULTS / "live.json").read_text())["rows"]
    assert {(row["source"], row["poses"]) for row in rows} == {
        (source, poses) for source in bench.CAPACITIES for poses in (*bench.POSES, "no tracks")
    }
    assert all(row["min"] <= row["median"] <= row["p99"] <= row["max"] for row in rows)


def test_the_recorded_hour_has_every_minute_and_does_not_grow():
    hour = json.loads((RESULTS / "live_hour.json").read_text())
    assert hour["minutes"] == len(hour["samples"]) == 60
    assert hour["growth_mb_per_hour"] < 5
    assert all(sample["sweeps"] > 0 for sample in hour["samples"])
    # All are done or counted.
    assert hour["summary"]["done"] + hour["summary"]["skipped"] > 30_000
