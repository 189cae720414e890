"""A short way through everything, for the oldest and the newest versions allowed: .ci/oldest.txt."""

import pathlib
import re
import tomllib

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

import jaxbox
from jaxbox import DetectorConfig, PointCloud, reference, synthetic
from jaxbox.cli import app
from jaxbox.evaluation import pairwise_overlaps

PROJECT = pathlib.Path(__file__).parents[1]
CAPACITY = 16384
SWEEP = synthetic.make_sweep(0, num_beams=32, num_azimuths=520)
# Whose program other tests take too.
CONFIG = DetectorConfig()
SAME_IOU = 0.7
NUM_FOUND = 3
"""Boxes worth acting on in this sweep, of which most cars hold a few points only."""


@pytest.fixture(scope="module")
def found():
    return jax.device_get(jaxbox.detect(PointCloud.from_numpy(SWEEP.xyz, capacity=CAPACITY), CONFIG))


def rows(detections):
    # The reference has no padding.
    keep = np.asarray(detections.score) >= jaxbox.DEFAULT_SCORE_THRESHOLD
    return np.column_stack([detections.center, detections.size, detections.yaw])[keep].astype(float)


def test_the_boxes_are_vehicles_and_those_of_the_reference(found):
    other = rows(reference.detect(SWEEP.xyz, CONFIG))
    boxes = rows(found)
    overlap, _ = pairwise_overlaps(boxes, other)
    # The planes of their random samples differ a little, so the last box by score may be one side's alone.
    assert len(boxes) >= NUM_FOUND
    assert np.sum(overlap.max(axis=1) > SAME_IOU) >= len(boxes) - 1
    assert np.sum(overlap.max(axis=0) > SAME_IOU) >= len(other) - 1
    truth = np.column_stack([SWEEP.boxes.center, SWEEP.boxes.size, SWEEP.boxes.yaw])
    assert np.mean(pairwise_overlaps(boxes, truth)[0].max(axis=1) > 0.3) > 0.8


def test_the_command_line_detects_and_writes(tmp_path):
    np.save(tmp_path / "a.npy", SWEEP.xyz)
    options = [
        "--capacity",
        str(CAPACITY),
        "--format",
        "jsonl",
        "--no-pictures",
        "--json",
    ]
    result = CliRunner().invoke(
        app, ["detect", str(tmp_path / "a.npy"), "--output", str(tmp_path / "out"), *options]
    )
    assert result.exit_code == 0, result.output
    record = jaxbox.io.read_jsonl(tmp_path / "out" / "detections.jsonl")[0]
    assert sum(box["score"] >= jaxbox.DEFAULT_SCORE_THRESHOLD for box in record["boxes"]) >= NUM_FOUND


def parts(version):
    return tuple(map(int, version.split(".")))


def test_the_tested_oldest_versions_are_those_that_the_project_allows():
    lines = (PROJECT / ".ci" / "oldest.txt").read_text().splitlines()
    tested = dict(line.split("==") for line in lines if line and line[0] != "#")
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    # As .ci/run installs the wheel.
    used = ["reference", "plots", "pcd", "las", "arrow", "ros", "mcap", "velodyne"]
    wanted = [*project["dependencies"], *(item for name in used for item in extras[name])]
    bounds = dict(
        re.match(r"([\w-]+)(?:\[\w+\])?>=([\d.]+)", item).groups() for item in wanted if ">=" in item
    )
    assert {"jax", "numpy", "pyarrow", "pypcd4"} < set(bounds)
    for name, bound in bounds.items():
        # 24.3.25 is the oldest of 24.3, 0.6.0 that of 0.6.
        assert name in tested, f"{name} has no line in .ci/oldest.txt"
        assert parts(tested[name])[: len(parts(bound))] == parts(bound), name
