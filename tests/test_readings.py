"""Laws of several readings of one sweep, and parity with the reference."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import parity
import pytest
from test_detector import CAPACITY, assert_same_bits, iou, rectangles, street
from test_parity_detect import boxes_of, num_partners

from jaxbox import DetectorConfig, PointCloud, Status, detect, reference, stack_clouds
from jaxbox.config.capacities import CAPACITIES
from jaxbox.config.fields import replace_fields
from jaxbox.reference import ground as reference_ground
from jaxbox.stages import readings
from jaxbox.types import combine_bits
from quality import bad_input

TWICE = DetectorConfig.accurate()
SEEDS = range(3)


def cloud_of(xyz):
    return PointCloud.from_numpy(np.asarray(xyz, np.float32), capacity=CAPACITY)


@functools.cache
def read(seed, config):
    return parity.on_host(detect(cloud_of(street(seed).xyz), config))


def once(seed):
    return read(seed, DetectorConfig())


def twice(seed):
    return read(seed, TWICE)


merge = jax.jit(lambda found: readings.merge_readings(found, DetectorConfig()))


def merged(*found):
    """Readings of the street, as one answer on the host."""
    return parity.on_host(merge(jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)))


def shifted(detections, **changes):
    return dataclasses.replace(detections, **changes)


# The merge.


@pytest.mark.parametrize("seed", SEEDS)
def test_readings_that_find_the_same_are_the_first(seed):
    assert_same_bits(merged(once(seed), once(seed)), once(seed))


def test_the_better_of_two_boxes_of_a_vehicle_is_kept_with_the_points_of_its_reading_and_the_mean_score():
    first = once(0)
    assert first.valid.sum() > 10
    best = np.arange(len(first.score)) == 3
    # The second reading is surer of one vehicle, which it gives other points.
    owners = np.where(first.point_detection == 3, -1, first.point_detection)
    owners[np.flatnonzero(first.point_detection == -1)[:5]] = 3
    second = shifted(
        first,
        score=np.where(best, 2 * first.score[0] - first.score[3] + 1e-3, 0.9 * first.score).astype(
            np.float32
        ),
        center=first.center + np.float32(0.1) * best[:, None],
        point_detection=owners,
    )
    d = merged(first, second)
    assert d.valid.sum() == first.valid.sum()
    np.testing.assert_array_equal(d.center[0], second.center[3])
    np.testing.assert_array_equal(d.point_detection == 0, second.point_detection == 3)
    assert d.num_points[0] == 5
    np.testing.assert_array_equal(d.center[1:4], first.center[:3])
    means = [(first.score[3] + second.score[3]) / 2, *(0.95 * first.score[:3])]
    np.testing.assert_allclose(d.score[:4], means, rtol=1e-6)


def test_what_one_reading_alone_finds_scores_half_and_the_order_follows():
    first = once(0)
    best = np.arange(len(first.score)) == 0
    away = np.where(best[:, None], np.float32([500, 0, 0]), 0).astype(np.float32)
    d = merged(first, shifted(first, center=first.center + away))
    num = int(first.valid.sum())
    assert d.counts.detections == num + 1
    alone = (
        np.abs(d.center[:, None] - np.stack([first.center[0], first.center[0] + away[0]])).max(axis=2) == 0
    )
    np.testing.assert_array_equal(d.score[alone.any(axis=1)], [first.score[0] / 2] * 2)
    others = ~alone.any(axis=1) & d.valid
    np.testing.assert_array_equal(d.score[others], first.score[1:num])
    assert (np.diff(d.score[d.valid]) <= 0).all()


def test_boxes_far_apart_are_all_kept_as_far_as_there_is_room_and_counted():
    first = once(0)
    second = shifted(
        first, center=first.center + np.float32([500, 0, 0]), point_detection=0 * first.point_detection - 1
    )
    d, num = merged(first, second), int(first.valid.sum())
    assert d.counts.detections == 2 * num
    assert d.valid.sum() == min(2 * num, len(d.valid))
    for detections in (first, second):
        best = detections.center[: num // 2]
        assert (np.abs(d.center[:, None] - best).max(axis=2).min(axis=0) == 0).all()
    one = first.num_points[first.valid]
    assert d.num_points.sum() == one.sum()


def test_more_boxes_than_rows_set_the_bit():
    first = once(0)
    config = replace_fields(DetectorConfig(), {"vehicles.max_detections": 10})
    few = jax.tree.map(lambda a: a[:10] if a.shape[:1] == first.valid.shape else a, first)
    owners = np.where(first.point_detection < 10, first.point_detection, -1)
    counts = dataclasses.replace(first.counts, detections=np.int32(10))
    few = shifted(few, point_detection=owners, counts=counts)
    away = shifted(few, center=few.center + np.float32([500, 0, 0]))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), few, away)
    d = parity.on_host(jax.jit(readings.merge_readings)(stacked, config))
    assert d.counts.detections == 20
    assert Status(int(d.status)) == Status.DETECTION_OVERFLOW
    assert d.valid.all()


def test_bits_of_capacities_are_those_of_any_reading_and_the_others_those_of_the_first():
    first, num = once(0), DetectorConfig().completion.max_assignments + 1
    full = shifted(first.counts, assignments=np.int32(num))
    bits = Status.NO_GROUND | Status.ASSIGNMENT_OVERFLOW
    second = shifted(first, counts=full, status=np.int32(bits))
    assert Status(int(merged(first, second).status)) == Status.ASSIGNMENT_OVERFLOW
    assert merged(first, second).counts.assignments == num
    assert Status(int(merged(second, first).status)) == bits
    overflows = full.overflows(DetectorConfig(), CAPACITY)
    assert Status(int(combine_bits(overflows))) == Status.ASSIGNMENT_OVERFLOW


def test_a_reading_with_no_boxes_halves_the_scores_and_boxes_keep_all_else_of_their_reading():
    boxes, none = once(1), parity.on_host(detect(cloud_of(np.zeros((0, 3)))))
    d = merged(none, boxes)
    for field in dataclasses.fields(d):
        of = none if field.name in d._of_sweep - {"point_detection", "counts"} else boxes
        if field.name not in ("counts", "score"):
            assert_same_bits(getattr(d, field.name), getattr(of, field.name))
    np.testing.assert_array_equal(d.score, boxes.score / 2)
    # Where the points went is that of the first reading, and what was needed is the most.
    needed = {row.count for row in CAPACITIES}
    for field in dataclasses.fields(d.counts):
        of = boxes if field.name in needed else none
        assert_same_bits(getattr(d.counts, field.name), getattr(of.counts, field.name))


# The turn.


def test_a_turned_sweep_has_the_points_of_the_region_and_no_others():
    region, angle = DetectorConfig().region, jnp.float32(np.radians(readings.TURN_DEG))
    xyz = np.array([[10, 5, -1], [79, 1, 0], [81, 0, 0], [0, 61, 0], [np.nan, 1, 1], [1, np.inf, 0]])
    cloud = PointCloud.from_numpy(xyz, capacity=8)
    turned = np.asarray(readings.turn_sweep(cloud, angle, region).xyz1)
    expected = reference.turn_sweep(xyz, float(angle), region)
    inside = np.isfinite(expected).all(axis=1)
    assert inside.tolist() == [True, True, False, False, False, False]
    np.testing.assert_allclose(turned[:6, :3][inside], expected[inside], atol=1e-5)
    np.testing.assert_array_equal(turned[:, 3], [1, 1, 0, 0, 0, 0, 0, 0])
    assert_same_bits(readings.turn_sweep(cloud, 0 * angle, region), cloud)


def test_boxes_turned_back_stand_where_they_stood():
    d, angle = once(0), jnp.float32(0.7)
    there = readings.turn_back(d, -angle)
    back = parity.on_host(readings.turn_back(there, angle))
    np.testing.assert_allclose(back.center, d.center, atol=1e-4)
    np.testing.assert_allclose(back.hulls.vertices, d.hulls.vertices, atol=1e-4)
    for name, turn in (("yaw", np.pi), ("heading", 2 * np.pi)):
        gap = getattr(back, name) - getattr(d, name)
        np.testing.assert_allclose(gap - turn * np.round(gap / turn), 0, atol=1e-5)
    # +x turns towards +y.
    x, y = np.asarray(there.center[:, :2]).T
    turned = np.arctan2(y, x) - np.arctan2(d.center[:, 1], d.center[:, 0])
    np.testing.assert_allclose(np.cos(turned[d.valid] - 0.7), 1, atol=1e-5)


# The whole.


@pytest.mark.parametrize("seed", SEEDS)
def test_an_answer_of_two_readings_keeps_the_laws_of_one(seed):
    d, xyz = twice(seed), street(seed).xyz
    assert bad_input.broken_laws(d, xyz, CAPACITY, TWICE) == []
    assert Status(int(d.status)) == Status.OK
    boxes = rectangles(d)
    overlap = np.asarray(iou(boxes, boxes)) - np.eye(len(boxes))
    assert overlap.max() <= TWICE.vehicles.max_overlap + 1e-6
    # What is said of the sweep is that of the first reading.
    for name in ("ground", "ground_mask", "point_component", "first_return_m"):
        assert_same_bits(getattr(d, name), getattr(once(seed), name))
    # No vehicle that one reading finds is lost.
    covered = np.asarray(iou(rectangles(once(seed)), boxes)).max(axis=1)
    assert (covered > 0.1 - 1e-6).all()


def test_some_boxes_are_of_the_second_reading_and_of_the_same_vehicles():
    new, near = 0, []
    for seed in SEEDS:
        ours, theirs = rectangles(twice(seed), 0.3), rectangles(once(seed), 0.05)
        same = (ours[:, None] == theirs).all(axis=2).any(axis=1)
        new += (~same).sum()
        near.extend(np.asarray(iou(ours, theirs)).max(axis=1))
    assert 0 < new < len(near)
    assert np.mean(np.array(near) > 0.5) > 0.9


def test_a_sweep_of_no_points_has_no_boxes():
    d = parity.on_host(detect(cloud_of(np.zeros((0, 3))), TWICE))
    empty = parity.on_host(detect(cloud_of(np.zeros((0, 3)))))
    assert_same_bits(d, empty)


@pytest.mark.slow
def test_a_batch_has_the_answers_of_its_sweeps():
    batch = stack_clouds([cloud_of(street(seed).xyz) for seed in (0, 1)])
    found = parity.on_host(jax.vmap(lambda cloud: detect(cloud, TWICE))(batch))
    for row in (0, 1):
        assert_same_bits(jax.tree.map(lambda a, row=row: a[row], found), twice(row))


def test_both_find_the_same_boxes_in_two_readings(monkeypatch):
    """On one plane in each reading, as each has random numbers of its own."""
    counts = np.zeros(2, int)
    for seed in SEEDS[:2]:
        ours = twice(seed)
        plane = ours.ground.coefficients.astype(float), True, int(ours.ground.num_inliers)
        angles = iter((0.0, np.radians(readings.TURN_DEG)))

        def turned(*_, plane=plane, angles=angles, **__):
            (a, b, c), *rest = plane
            cos, sin = np.cos(angle := next(angles)), np.sin(angle)
            return [(np.array([cos * a - sin * b, sin * a + cos * b, c]), *rest)]

        monkeypatch.setattr(reference_ground, "fit_ground_planes", turned)
        theirs = reference.detect(street(seed).xyz, TWICE)
        boxes, others = boxes_of(ours), boxes_of(theirs)
        counts += num_partners(boxes, others) + num_partners(others, boxes)
        owned = np.bincount(theirs.point_detection + 1, minlength=len(others) + 1)[1:]
        np.testing.assert_array_equal(owned, theirs.num_points)
    assert counts[0] > 20
    parity.assert_share(counts[0] - counts[1], counts[0], 0.06, "boxes of two readings")
