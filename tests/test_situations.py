"""The table of situations: exact scenes, what is counted, and a short form of the benchmark."""

import collections
import dataclasses
import functools
import json
import pathlib
import types
from typing import Any

import numpy as np
import pytest

from benchmarks import bench_situations, common
from jaxbox import DEFAULT_SCORE_THRESHOLD, DetectorConfig, Label, PointCloud, Status, detect
from jaxbox.config.fields import replace_fields
from jaxbox.evaluation.iou import pairwise_overlaps
from jaxbox.synthetic import TruthBoxes, make_sweep
from jaxbox.synthetic.scene import outline
from jaxbox.synthetic.situations import SITUATIONS
from jaxbox.synthetic.solids import Solid

RESULTS = pathlib.Path(__file__).parents[1] / "benchmarks" / "results"
BY_TITLE = {situation.title: situation for situation in SITUATIONS}
IN_SHORT = {
    "open street: as it is": 10,
    "beside a wall: 0.2 m": 6,
    "beside a hedge: 0.2 m": 6,
    "rows, side by side: gaps of 0.2 m": 5,
    "rows, side by side: gaps of 0.3 m": 5,
    "rows, nose to tail: gaps of 0.2 m": 5,
    "rows, nose to tail: gaps of 0.3 m": 5,
    "very near: middle 3 m away": 13,
    "under a ceiling: 2.3 m": 6,
    "under a ceiling: 3 m": 6,
    "other sizes: box vans": 4,
    "other sizes: trucks of 9 m": 4,
    "mounts: on a slope of 10 %": 9,
    "mounts: before a ramp of 10 %": 6,
}
"""Situations that the suite runs, and how many vehicles are to be found in each."""


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.4, -0.3)])
@pytest.mark.parametrize("situation", SITUATIONS, ids=lambda situation: situation.title)
def test_vehicles_of_a_situation_stand_apart_and_hold_their_points(situation, place):
    for xyz, truth in situation.seen_from(*place).sweeps(num_azimuths=200):
        rows = common.box_rows(truth)
        overlap, _ = pairwise_overlaps(rows, rows)
        np.testing.assert_allclose(overlap, np.eye(len(rows)), atol=1e-6)
        c, s = np.cos(truth.yaw), np.sin(truth.yaw)
        dx, dy = xyz[:, :1] - truth.center[:, 0], xyz[:, 1:2] - truth.center[:, 1]
        out = np.maximum(
            np.abs(dx * c + dy * s) - truth.size[:, 0] / 2, np.abs(dy * c - dx * s) - truth.size[:, 1] / 2
        )
        # Five standard deviations of the noise.
        assert ((out < 0.1 * situation.scale).sum(axis=0) >= truth.num_points).all()
        assert truth.num_points.max() >= 10


@pytest.mark.parametrize("gap_m", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("thing", ["wall", "rail"])
def test_cars_beside_a_thing_are_as_far_from_it_as_said(thing, gap_m):
    scene, *_ = BY_TITLE[f"beside a {thing}: {gap_m:g} m"].scenes
    # The second of a block's six faces looks along +y, the fifth along -y.
    left = min(-float(s.offsets[4]) for s in scene.clutter[0].shapes if isinstance(s, Solid))
    right = max(float(s.offsets[1]) for s in scene.clutter[1].shapes if isinstance(s, Solid))
    reach = [outline(vehicle)[:, 1] for vehicle in scene.vehicles]
    np.testing.assert_allclose([left - y.max() for y in reach[:3]], gap_m, atol=1e-9)
    np.testing.assert_allclose([y.min() - right for y in reach[3:]], gap_m, atol=1e-9)


def test_the_same_situation_gives_the_same_bits():
    situation = BY_TITLE["beside a hedge: 0.2 m"]
    first, again = (situation.sweeps(num_azimuths=100)[0][0] for _ in range(2))
    assert first.tobytes() == again.tobytes()


def test_from_elsewhere_it_is_the_same_scene_in_the_frame_of_the_moved_sensor():
    situation = BY_TITLE["rows, nose to tail: gaps of 0.3 m"]
    (xyz, truth), (moved, moved_truth) = (
        each.sweeps(num_azimuths=400)[0] for each in (situation, situation.seen_from(0.5, -0.25))
    )
    np.testing.assert_allclose(moved_truth.center, truth.center - [0.5, -0.25, 0], atol=1e-6)
    for name in ("size", "yaw", "label"):
        np.testing.assert_array_equal(getattr(moved_truth, name), getattr(truth, name))
    # The sensor stays in the middle of its points: the nearest ring of ground is as far away on all sides.
    for points in (xyz, moved):
        ground = points[(np.abs(points[:, 2] + 1.73) < 0.1) & (np.hypot(*points[:, :2].T) < 4)]
        np.testing.assert_allclose(ground[:, :2].mean(axis=0), 0, atol=0.1)
    assert not np.array_equal(xyz[:100], moved[:100])


def test_places_are_the_same_for_the_same_seed_and_the_tables_own_without_draws():
    assert bench_situations.drawn_places(0, 3) == [(0, 0)]
    places = bench_situations.drawn_places(50, 3)
    assert places == bench_situations.drawn_places(50, 3) != bench_situations.drawn_places(50, 4)
    assert 0.4 < np.abs(places).max() <= bench_situations.ASIDE_M


def test_titles_are_unique():
    assert len(BY_TITLE) == len(SITUATIONS)


@pytest.mark.parametrize("status", [Status.OK, Status.NO_GROUND])
def test_what_is_counted_is_what_is_worked_out_by_hand(status):
    truth = TruthBoxes(
        center=np.array([[10.0, 0, -1], [20, 0, -1], [30, 0, -1], [40, 0, -1]]),
        size=np.tile([4.0, 2.0, 1.5], (4, 1)),
        yaw=np.zeros(4),
        label=np.zeros(4, int),
        num_points=np.array([100, 100, 30, 29]),
        visible=np.ones(4),
    )
    # The first is met exactly, the second by a box 1.5 m off (IoU 10 / 22), the third by none. The fourth has
    # too few points.
    boxes = types.SimpleNamespace(
        center=np.array([[10.0, 0, -1], [21.5, 0, -1], [40, 0, -1]]), size=truth.size[:3], yaw=np.zeros(3)
    )
    found: Any = types.SimpleNamespace(on_host=lambda: found, above=lambda _: boxes, status=int(status))
    loud, silent = (2, 0) if status else (0, 2)
    expected = {"vehicles": 3, "found": 1, "loud": loud, "silent": silent, "false": 1}
    assert bench_situations.count(truth, found) == expected


@pytest.fixture(scope="module")
def find():
    def find(xyz, **changes):
        config = replace_fields(DetectorConfig(), {f"vehicles.{name}": v for name, v in changes.items()})
        return detect(PointCloud.from_numpy(xyz, capacity=bench_situations.CAPACITY), config)

    return find


@pytest.mark.parametrize("title", IN_SHORT)
def test_what_is_said_to_be_found_is_found(title, find):
    assert bench_situations.measure(BY_TITLE[title], find)["found"] >= IN_SHORT[title]


def test_slivers_are_cars_in_rows_alone(find):
    """The fourth of five falls into two clusters. Alone it is, or is not, what it is without the rule."""
    row = BY_TITLE["rows, nose to tail: gaps of 0.3 m"]
    (scene,) = row.scenes
    alone = dataclasses.replace(row, scenes=(dataclasses.replace(scene, vehicles=scene.vehicles[3:4]),))
    without = functools.partial(find, row_extent=1.0)
    assert [bench_situations.measure(row, each)["found"] for each in (find, without)] == [5, 4]
    for situation in (alone, BY_TITLE["open street: as it is"]):
        xyz, _ = situation.sweeps()[0]
        boxes, others = (each(xyz).on_host().above(DEFAULT_SCORE_THRESHOLD) for each in (find, without))
        np.testing.assert_array_equal(common.box_rows(boxes), common.box_rows(others))


@pytest.mark.parametrize("seed", [0, 3])
def test_facades_that_end_where_a_truck_would_are_none(seed, find):
    street = make_sweep(seed, num_vehicles=12)
    boxes = find(street.xyz).on_host().above(DEFAULT_SCORE_THRESHOLD)
    assert len(boxes) > 5
    trucks = np.asarray(boxes.center)[np.asarray(boxes.label) == Label.TRUCK, :2]
    vehicles = street.boxes.center[:, :2]
    assert (np.linalg.norm(trucks[:, None] - vehicles, axis=2).min(axis=1) < 4).all()


@pytest.mark.parametrize(
    ("name", "num_places"),
    [("situations", 1), ("situations_before", 1), ("situations_draws", 8), ("situations_draws_accurate", 8)],
)
def test_the_recorded_table_is_that_of_the_code(name, num_places):
    report = json.loads((RESULTS / f"{name}.json").read_text())
    rows = report["rows"]
    assert len(report.get("places", [[0, 0]])) == num_places
    assert [f"{row['group']}: {row['situation']}" for row in rows] == list(BY_TITLE)
    for row in rows:
        situation = BY_TITLE[f"{row['group']}: {row['situation']}"]
        assert row["vehicles"] <= num_places * sum(len(scene.vehicles) for scene in situation.scenes)
        assert row["vehicles"] == row["found"] + row["loud"] + row["silent"]
        assert not row["loud"] or row["status"]
    assert collections.Counter(row["group"] for row in rows).keys() == {s.group for s in SITUATIONS}
