"""Bad input: no exception, finite answers, the right bits, every point in its place, and no box from nothing.

The inputs and the laws are in `quality.bad_input`, from which the documentation's table is made too.
"""

import dataclasses
import functools
import json
import re

import chex
import jax
import numpy as np
import pytest

from benchmarks import common
from jaxbox import DEFAULT_SCORE_THRESHOLD, DetectorConfig, PointCloud, Status, detect
from jaxbox.types import GROUND_ABOVE_M
from quality import bad_input, bad_input_table

CASES = {case.name: case for case in bad_input.CASES}
HERE = [case.name for case in bad_input.CASES if not case.compiles_anew]
"""The others compile the whole detector again, and are run by `bad_input_table`."""


@functools.cache
def answer(name, preset):
    """What a preset makes of a case: the points that went in, and the detections."""
    xyz, cloud = bad_input.pad(CASES[name])
    return xyz, jax.device_get(detect(cloud, DetectorConfig.presets()[preset]))


@pytest.mark.parametrize("preset", bad_input.PRESETS)
@pytest.mark.parametrize("name", HERE)
def test_bad_input_has_a_lawful_answer_with_the_right_status(name, preset):
    case, (xyz, detections) = CASES[name], answer(name, preset)
    config = DetectorConfig.presets()[preset]
    assert bad_input.broken_laws(detections, xyz, case.capacity, config) == []
    assert Status(int(detections.status)) == case.status[preset]
    assert detections.score.max() <= case.best_score
    if case.same_as:
        chex.assert_trees_all_equal(detections, answer(case.same_as, preset)[1])


@pytest.mark.parametrize("preset", bad_input.PRESETS)
def test_the_ground_may_be_as_high_as_the_origin_but_not_above_it(preset):
    for above_m, expected in ((0.0, False), (GROUND_ABOVE_M - 0.1, False), (GROUND_ABOVE_M + 0.1, True)):
        # The street's sensor is 1.73 m above it.
        moved = bad_input.street() + np.array([0, 0, 1.73 + above_m], np.float32)
        cloud = PointCloud.from_numpy(moved, capacity=bad_input.CAPACITY)
        found = detect(cloud, DetectorConfig.presets()[preset])
        assert (Status.GROUND_ABOVE in Status(int(found.status))) == expected
        assert float(found.ground.coefficients[2]) == pytest.approx(above_m, abs=0.05)


TILT = np.array([[np.cos(0.14), 0, np.sin(0.14)], [0, 1, 0], [-np.sin(0.14), 0, np.cos(0.14)]])
FRAMES = {
    # A facade is as good a plane as a road, but lies elsewhere, and little returns from beyond it.
    "another axis up: y": (lambda xyz: xyz[:, [1, 2, 0]], Status.DEGRADED | Status.DOUBTFUL_GROUND),
    "another axis up: x": (lambda xyz: xyz[:, [2, 1, 0]] * [1, 1, -1], Status.NO_GROUND),
    "a camera's": (lambda xyz: xyz[:, [1, 2, 0]] * [-1, -1, 1], Status.NO_GROUND),
    "upside down": (lambda xyz: xyz * [1, -1, -1], Status.GROUND_ABOVE),
    "millimetres": (lambda xyz: xyz * 1000, Status.EMPTY | Status.NO_GROUND),
    "a map's": (lambda xyz: np.add(xyz, [1000, 500, 100]), Status.EMPTY | Status.NO_GROUND),
    "kilometres": (lambda xyz: xyz / 1000, Status.DEGRADED),
    "feet": (lambda xyz: xyz / 0.3048, Status.DEGRADED | Status.DOUBTFUL_GROUND),
    "an origin 10 m aside": (lambda xyz: np.add(xyz, [10, 0, 0]), Status.DOUBTFUL_GROUND),
    "tilted by 8 degrees": (lambda xyz: xyz @ TILT, Status.DOUBTFUL_GROUND),
    "turned": (lambda xyz: xyz[:, [1, 0, 2]] * [-1, 1, 1], Status.OK),
    "mirrored": (lambda xyz: xyz * [1, -1, 1], Status.OK),
    "on the ground": (lambda xyz: np.add(xyz, [0, 0, 1.73]), Status.OK),
}
FOUND_IN = ("turned", "mirrored", "on the ground")
"""Frames in which vehicles are found nearly as in the right one, and nothing says that it is another."""

MAY_BE_FOUND_IN = ("upside down", "an origin 10 m aside", "tilted by 8 degrees")
"""Frames in which there may be boxes, but the status doubts them."""


@pytest.mark.parametrize("name", FRAMES)
def test_the_status_says_of_a_wrong_frame_what_the_documentation_says(name):
    move, status = FRAMES[name]
    cloud = PointCloud.from_numpy(move(bad_input.street()), capacity=bad_input.CAPACITY)
    found = detect(cloud, DetectorConfig())
    assert Status(int(found.status)) == status
    num_found = int((found.score >= DEFAULT_SCORE_THRESHOLD).sum())
    expected = int((answer(bad_input.STREET.name, "default")[1].score >= DEFAULT_SCORE_THRESHOLD).sum())
    assert expected >= 3
    if name in FOUND_IN:
        assert abs(num_found - expected) <= 1
    elif name not in MAY_BE_FOUND_IN:
        assert num_found == 0


@pytest.mark.parametrize("name", [case.name for case in bad_input.STORAGE])
def test_the_same_numbers_give_the_same_cloud_however_they_are_stored(name):
    _, found = bad_input.pad(CASES[name])
    _, expected = bad_input.pad(bad_input.STREET)
    assert found.xyz1.dtype == np.float32
    np.testing.assert_array_equal(found.xyz1, expected.xyz1)


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int32])
def test_masked_points_are_ignored_and_counted_as_nan_is(kind):
    xyz = np.ma.masked_array(np.arange(15).reshape(5, 3).astype(kind), mask=False)
    xyz[1, 2] = xyz[3] = np.ma.masked
    intensity = np.ma.masked_array(np.arange(5.0) + 7, mask=[1, 0, 0, 0, 0])
    cloud = PointCloud.from_numpy(xyz, intensity, capacity=5)
    assert np.isnan(cloud.xyz1[:, :3]).any(axis=1).tolist() == [False, True, False, True, False]
    np.testing.assert_array_equal(cloud.xyz1[[0, 2, 4], :3], xyz.data[[0, 2, 4]])
    assert cloud.intensity.tolist() == [0, 8, 9, 10, 11]
    with pytest.raises(ValueError, match="must be real numbers"):
        PointCloud.from_numpy(np.ma.masked_array(np.zeros((5, 3), bool)))


def test_a_cloud_made_by_hand_counts_no_fewer_points_than_its_rows():
    cloud = bad_input.pad(bad_input.STREET)[1]
    found = answer(bad_input.STREET.name, "default")[1]
    with pytest.raises(ValueError, match=r"num_points=-5; .*, 0 or above"):
        detect(dataclasses.replace(cloud, num_points=np.array(-5, np.int32)))
    # What lies on a device is not looked at before it is computed with.
    lying = detect(dataclasses.replace(cloud, num_points=jax.numpy.int32(-5)))
    assert lying.counts.num_points == found.counts.num_points == int(cloud.num_points)
    assert int(lying.status) == int(found.status) == 0


@pytest.mark.parametrize("name", bad_input.REFUSED)
def test_bad_points_are_refused_saying_what_is_wrong_and_how_to_mend_it(name):
    arguments, options, message = bad_input.REFUSED[name]
    with pytest.raises(ValueError, match=message):
        PointCloud.from_numpy(*arguments, **options)


@pytest.mark.parametrize(
    ("name", "spoil", "shape"),
    [
        ("xyz1", lambda xyz1: xyz1.T, "xyz1 (4, {0})"),
        ("xyz1", lambda xyz1: xyz1[:, :3], "xyz1 ({0}, 3)"),
        ("xyz1", lambda xyz1: xyz1[None], "xyz1 (1, {0}, 4)"),
        ("xyz1", lambda xyz1: xyz1[:, 0], "xyz1 ({0},)"),
        ("intensity", lambda intensity: intensity[1:], "intensity ({1},)"),
        ("intensity", lambda intensity: intensity[:, None], "intensity ({0}, 1)"),
        ("num_points", lambda num_points: num_points[None], "num_points (1,)"),
    ],
)
def test_a_cloud_of_wrong_shapes_is_refused_saying_which_and_how_to_mend_it(name, spoil, shape):
    cloud = bad_input.pad(bad_input.STREET)[1]
    spoilt = dataclasses.replace(cloud, **{name: spoil(getattr(cloud, name))})
    detect(cloud)  # The right shapes have a program.
    with pytest.raises(ValueError, match="was given a cloud of shapes") as refused:
        detect(spoilt)
    message = str(refused.value)
    assert shape.format(cloud.capacity, cloud.capacity - 1) in message
    assert "must be xyz1 (N, 4), intensity (N,) and num_points ()" in message
    assert "PointCloud.from_numpy" in message
    assert "jax.vmap(jaxbox.detect)" in message


def test_under_vmap_the_shapes_are_those_of_one_cloud():
    cloud = bad_input.pad(bad_input.STREET)[1]
    batch = jax.tree.map(lambda a: np.stack([a, a]), cloud)
    found = jax.eval_shape(jax.vmap(detect), batch)
    assert found.valid.shape[0] == 2
    short = dataclasses.replace(batch, intensity=batch.intensity[:, 1:])
    with pytest.raises(ValueError, match=re.escape(f"intensity ({cloud.capacity - 1},)")):
        jax.eval_shape(jax.vmap(detect), short)


def test_a_box_from_nothing_and_a_lost_point_are_noticed():
    """The laws bite: answers that break them are told."""
    config = DetectorConfig()
    xyz, detections = answer(bad_input.STREET.name, "default")
    laws = functools.partial(bad_input.broken_laws, capacity=bad_input.CAPACITY, config=config)
    moved = jax.tree.map(np.copy, detections)
    moved.center[0] += [0, 0, 50]
    assert laws(moved, xyz) == ["every box is supported by points of the input"]
    assert laws(detections, xyz[1:]) == ["every point of the input is in exactly one place"]
    wrong = jax.tree.map(np.copy, detections)
    wrong.yaw[0] = np.nan
    wrong.score[1] = 2
    assert {"every number is finite", "the best score comes first"} <= set(laws(wrong, xyz))


def test_the_recorded_table_holds_every_case_and_no_broken_law():
    recorded = json.loads((common.PROJECT / "quality" / "results" / "bad_input.json").read_text())
    answers = recorded["answers"]
    assert {group: list(cases) for group, cases in answers.items()} == {
        group: [case.name for case in cases] for group, cases in bad_input.GROUPS.items()
    }
    for group, cases in bad_input.GROUPS.items():
        for case in cases:
            for preset in bad_input.PRESETS:
                row = answers[group][case.name][preset]
                assert row["broken"] == []
                assert row["status"] == common.status_names([int(case.status[preset])])
    assert recorded["refused"] == bad_input_table.refusals()
