"""Vehicles in rows: laws of which ends are in one, and parity with the reference on equal inputs."""

import dataclasses

import numpy as np
import parity
import pytest

from jaxbox import reference
from jaxbox.stages import _rows
from jaxbox.stages._assignments import Assignments
from jaxbox.stages._priors import prior_of
from jaxbox.stages.state import RayFractions

CAR = parity.CONFIG.vehicles.classes[0]
SETTINGS = parity.CONFIG.completion
CAPACITY = 256

find_rows = parity.PerForm(lambda ends, may_be: _rows.find_rows(ends, may_be, CAR.width_m, SETTINGS))


def in_rows(ends):
    """Which of ends (n, 3) are in a row, by the stage and, the same, by the reference."""
    padded = np.zeros((CAPACITY, 4), np.float32)
    padded[: len(ends)] = np.column_stack([ends[:, :2], np.cos(ends[:, 2]), np.sin(ends[:, 2])])
    found = np.asarray(find_rows(padded, np.arange(CAPACITY) < len(ends)))
    assert not found[len(ends) :].any()
    expected = reference.find_rows(ends, CAR.width_m, SETTINGS)
    np.testing.assert_array_equal(found[: len(ends)], expected)
    return expected.tolist()


find_lines = parity.PerForm(lambda *rows: _rows.find_lines(*rows, parity.CONFIG.vehicles))


def in_lines(boxes, early):
    """Which of boxes (n, 5) are in a line, by the stage and, the same, by the reference."""
    early = np.broadcast_to(np.float32(early), len(boxes))
    padded = parity.pad(boxes, CAPACITY), parity.pad(early, CAPACITY, fill=1)
    found = np.asarray(find_lines(*padded, np.arange(CAPACITY) < len(boxes)))
    assert not found[len(boxes) :].any()
    expected = reference.find_lines(boxes, early, parity.CONFIG.vehicles)
    np.testing.assert_array_equal(found[: len(boxes)], expected)
    return expected.tolist()


def nose_to_tail(*ahead_m, yaw=0.7, asides_m=None):
    """(n, 5) boxes of 4 m in a line, with these places of their middles along it and aside."""
    asides = np.zeros(len(ahead_m)) if asides_m is None else np.array(asides_m)
    places = np.outer(ahead_m, [np.cos(yaw), np.sin(yaw)]) + np.outer(asides, [-np.sin(yaw), np.cos(yaw)])
    places += 20.0
    return np.column_stack([places, np.tile([4.0, 1.6, yaw], (len(ahead_m), 1))])


def side_by_side(*sides_m, yaw=0.7, shifts_m=None):
    """(n, 3) ends of vehicles in a row 20 m ahead, at these places along it, one farther than the other."""
    across, away = np.array([-np.sin(yaw), np.cos(yaw)]), np.array([np.cos(yaw), np.sin(yaw)])
    shifts = np.zeros(len(sides_m)) if shifts_m is None else np.array(shifts_m)
    place = np.array([20.0, 0.0]) + np.outer(sides_m, across) + np.outer(shifts, away)
    return np.column_stack([place, np.full(len(sides_m), yaw)])


@pytest.mark.usefixtures("platform")
def test_three_side_by_side_are_a_row_and_two_are_not():
    assert in_rows(side_by_side(0, 2.3)) == [False, False]
    assert in_rows(side_by_side(0, 2.3, 4.6)) == [True, True, True]
    assert in_rows(side_by_side(0, 2.3, 4.6, 20.0)) == [True, True, True, False]


@pytest.mark.usefixtures("platform")
def test_what_is_too_far_too_near_turned_or_farther_forward_is_not_in_the_row():
    apart = SETTINGS.row_distance_m
    assert in_rows(side_by_side(0, apart + 0.1, 2 * apart + 0.2)) == [False, False, False]
    assert in_rows(side_by_side(0, 0.4, 0.8)) == [False, False, False]
    forward = [0, SETTINGS.row_shift_m + 0.1, 0]
    assert in_rows(side_by_side(0, 2.3, 4.6, shifts_m=forward)) == [False, False, False]
    turned = side_by_side(0, 2.3, 4.6)
    turned[1, 2] += 0.3
    assert in_rows(turned) == [False, False, False]
    turned[1, 2] += np.pi - 0.3
    assert in_rows(turned) == [True, True, True]


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("seed", range(5))
def test_rows_of_random_ends_are_those_of_the_reference_in_any_order(seed):
    rng = np.random.default_rng(seed)
    ends = np.column_stack([rng.uniform(-9, 9, (150, 2)), rng.choice([0, 0.1, 1.5, 3.2], 150)])
    found, order = np.array(in_rows(ends)), rng.permutation(150)
    assert 0 < found.sum() < 150
    assert in_rows(ends[order]) == found[order].tolist()


@pytest.mark.usefixtures("platform")
def test_three_nose_to_tail_are_a_line_and_two_are_not():
    assert in_lines(nose_to_tail(0, 4.2), 1) == [False, False]
    assert in_lines(nose_to_tail(0, 4.2, 8.4), 1) == [True, True, True]
    assert in_lines(nose_to_tail(8.4, 0, 4.2, 40.0), 1) == [True, True, True, False]
    # Where one is missing there are two.
    assert in_lines(nose_to_tail(0, 4.2, 12.6), 1) == [False, False, False]


@pytest.mark.usefixtures("platform")
def test_what_is_too_far_too_near_turned_aside_or_unsure_is_not_in_the_line():
    most = 4 * parity.CONFIG.vehicles.line_lengths
    assert in_lines(nose_to_tail(0, most + 0.1, 2 * most + 0.2), 1) == [False, False, False]
    assert in_lines(nose_to_tail(0, 2, 4), 1) == [False, False, False]
    assert in_lines(nose_to_tail(0, 4.2, 8.4, asides_m=[0, 0.4, 0]), 1) == [False, False, False]
    assert in_lines(nose_to_tail(0, 4.2, 8.4), [1, 0.2, 1]) == [False, False, False]
    turned = nose_to_tail(0, 4.2, 8.4)
    turned[1, 4] += 0.2
    assert in_lines(turned, 1) == [False, False, False]
    turned[1, 4] += np.pi - 0.2
    assert in_lines(turned, 1) == [True, True, True]


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("seed", range(5))
def test_lines_of_random_boxes_are_those_of_the_reference_in_any_order(seed):
    rng = np.random.default_rng(seed)
    sizes = rng.uniform([3.5, 1.5], [4.5, 1.8], (150, 2))
    boxes = np.column_stack([rng.uniform(-15, 15, (150, 2)), sizes, rng.choice([0, 0.1, 3.2], 150)])
    boxes, early = boxes.astype(np.float32), rng.uniform(0, 1, 150).astype(np.float32)
    found, order = np.array(in_lines(boxes, early)), rng.permutation(150)
    assert 0 < found.sum() < 150
    assert in_lines(boxes[order], early[order]) == found[order].tolist()


def test_only_ends_as_wide_as_a_vehicle_beside_no_sensor_are_looked_at():
    sides = ((8.0, 9.0), (-9.0, -8.0), (-1.0, 2.0), (8.0, 9.0), (8.0, 9.0))
    widths = (1.6, 1.6, 1.6, 1.0, 2.3)
    each = [reference.Assignment(along, (3.0, 3.0 + w), 0.4) for along, w in zip(sides, widths, strict=True)]
    expected = [reference.visible_end(assignment, CAR) for assignment in each]
    assert [end is not None for end in expected] == [True, True, False, False, False]
    low_high = np.array([(*a.along, *a.across, a.yaw, 0) for a in each], np.float32).T
    stacked = Assignments((low_high[0], low_high[1]), (low_high[2], low_high[3]), low_high[4], low_high[5])
    ends, may_be = _rows.visible_ends(stacked, prior_of([CAR], np.zeros(5, np.int32)))
    assert may_be.tolist() == [True, True, False, False, False]
    for row, end in enumerate(expected[:2]):
        np.testing.assert_allclose(ends[row], [*end[:2], np.cos(end[2]), np.sin(end[2])], atol=1e-6)


def test_in_a_row_only_rays_that_reach_a_vehicle_count():
    rays = RayFractions(
        *np.array([[0.3, 0.2, 0.0], [0, 0.2, 0], [0, 0, 0], [0.7, 0.6, 1.0], [0, 0, 0], [0, 0, 0]])
    )
    np.testing.assert_allclose(_rows.hit_share(rays, np.zeros(3, bool)), rays.hit)
    shares = _rows.hit_share(rays, np.ones(3, bool))
    np.testing.assert_allclose(shares, [1, 0.5, 0], atol=1e-6)
    of_reference = reference.RayFractions(**{f.name: getattr(rays, f.name) for f in dataclasses.fields(rays)})
    np.testing.assert_allclose(reference.hit_share(of_reference, True), shares, atol=1e-6)
