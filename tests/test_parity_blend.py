"""Boxes of a cluster that are blended: laws, and parity with the reference on equal inputs."""

import dataclasses

import numpy as np
import parity
import pytest

from jaxbox import reference
from jaxbox.stages import _assignments
from jaxbox.stages.state import NOT_A_BOX, Boxes

MAX_LOSS = 0.2

blend_boxes = parity.PerForm(lambda boxes, max_loss: _assignments.blend_boxes(boxes, max_loss=max_loss))


def boxes_of(numbers, objective, in_row=None):
    """`Boxes` (C, W): numbers (C, W, 7) x, y, length, width, yaw, measured length and width."""
    numbers = np.asarray(numbers, np.float32)
    x_y, length, width, yaw, measured = np.split(numbers, [2, 3, 4, 5], axis=-1)
    in_row = np.zeros(numbers.shape[:2], bool) if in_row is None else in_row
    sides = (a[..., 0] for a in (length, width, yaw))
    return Boxes(x_y, *sides, measured, np.asarray(objective, np.float32), in_row)


def blended(numbers, objective, max_loss=MAX_LOSS):
    """Of one cluster: (7,) numbers as `boxes_of` takes them, by the stage and, the same, by the reference."""
    found = parity.on_host(blend_boxes(boxes_of([numbers], [objective]), np.float32(max_loss)))
    ours = np.array([*found.center[0], found.length[0], found.width[0], found.yaw[0], *found.measured[0]])
    rows = [
        reference.CompletedBox(np.array(each[:5], float), float(j), *map(float, each[5:]))
        for each, j in zip(numbers, objective, strict=True)
        if j > NOT_A_BOX
    ]
    theirs = reference.blend_boxes(rows, max_loss=max_loss)
    expected = [*theirs.box, theirs.measured_length_m, theirs.measured_width_m]
    np.testing.assert_allclose(ours, expected, atol=2e-5)
    assert found.objective[0] == np.float32(max(objective)) == np.float32(theirs.objective)
    return ours


def turned(degrees, shift_m=0.0):
    return [10 + shift_m, 5, 4 + shift_m, 1.6, np.radians(degrees), 3, 1.5]


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("sign", [-1, 1])
def test_boxes_as_good_are_blended_half_and_half(sign):
    found = blended([turned(20), turned(20 + sign * 14, 0.2)], [1.0, 1.0])
    np.testing.assert_allclose(found, turned(20 + sign * 7, 0.1), atol=1e-5)


@pytest.mark.usefixtures("platform")
def test_the_worse_a_box_the_less_it_counts():
    for loss in (0.0, 0.05, 0.1, 0.15, MAX_LOSS, 0.3):
        weight = max(1 - loss / MAX_LOSS, 0)
        for order in (1, -1):
            found = blended([turned(0), turned(15)][::order], [1.0, 1 - loss][::order])
            assert np.degrees(found[4]) == pytest.approx(15 * weight / (1 + weight), abs=1e-3)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(
    ("degrees", "weight"), [(0, 0), (8, 0), (10, 0.5), (12, 1), (30, 1), (31, 0), (90, 0)]
)
def test_boxes_turned_little_or_far_are_not_blended(degrees, weight):
    found = blended([turned(0), turned(degrees, 1.0)], [1.0, 1.0])
    np.testing.assert_allclose(found[0] - 10, weight / (1 + weight), atol=1e-4)


@pytest.mark.usefixtures("platform")
def test_boxes_are_turned_against_each_other_by_a_quarter_at_most():
    # 80 degrees and -86, which is 94, are 14 apart.
    found = blended([turned(80), turned(-86)], [1.0, 1.0])
    assert np.degrees(found[4]) == pytest.approx(87, abs=1e-3)


@pytest.mark.usefixtures("platform")
def test_what_is_no_box_counts_nothing_and_no_loss_blends_only_equals():
    alone = blended([turned(5), turned(20), turned(5)], [0.7, NOT_A_BOX, NOT_A_BOX])
    np.testing.assert_allclose(alone, turned(5), atol=1e-6)
    np.testing.assert_allclose(blended([turned(0), turned(14)], [1, 0.999], max_loss=0), turned(0), atol=1e-6)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("seed", range(3))
def test_random_boxes_are_blended_as_by_the_reference(seed):
    rng = np.random.default_rng(seed)
    for _ in range(20):
        numbers = rng.uniform([30, -20, 3, 1, 0, 1, 1], [33, -17, 5, 3, 1, 3, 2], (6, 7))
        # Whole degrees, as rotations are.
        numbers[:, 4] = np.radians(rng.integers(0, 90, 6) + 90.0 * rng.integers(0, 2, 6))
        blended(numbers, rng.uniform(0.8, 1, 6))


@pytest.mark.usefixtures("platform")
def test_whether_it_is_in_a_row_is_the_bests():
    both = boxes_of([[turned(0), turned(14)]] * 2, [[1, 0.9], [0.9, 1]], np.array([[True, False]] * 2))
    assert parity.on_host(blend_boxes(both, np.float32(MAX_LOSS))).in_row.tolist() == [True, False]
    names = {field.name for field in dataclasses.fields(Boxes)}
    assert names == {"center", "length", "width", "yaw", "measured", "objective", "in_row"}
