"""Parity with the reference end to end: the same boxes from the same sweep, for all presets."""

import dataclasses
import functools

import numpy as np
import parity
import pytest

import jaxbox
from jaxbox import DetectorConfig, reference
from jaxbox.reference import ground as reference_ground
from jaxbox.synthetic.situations import SITUATIONS
from jaxbox.xla import backend

MIN_SCORE = 0.05
PRESETS = {name: c for name, c in DetectorConfig.presets().items() if c.vehicles.num_readings == 1}
"""Several readings are compared in `test_readings`, as each has a plane of its own."""
SWEEPS = slice(1, 3)
"""Two of each kind, as the reference takes seconds for each."""


def boxes_of(detections):
    """(k, 8) centre, size, yaw and score."""
    rows = np.column_stack([detections.center, detections.size, detections.yaw, detections.score])
    return rows[np.asarray(getattr(detections, "valid", np.ones(len(rows), bool)))]


def num_partners(boxes, others):
    """Boxes that count, and those with another in 10 cm, 10 cm of size, 2 degrees and .02 of score."""
    boxes = boxes[boxes[:, 7] > MIN_SCORE]
    gap = np.abs(boxes[:, None] - others)
    turn = (boxes[:, None, 6] - others[:, 6] + np.pi / 2) % np.pi - np.pi / 2
    near = np.linalg.norm(gap[..., :3], axis=2) < 0.1
    alike = near & (gap[..., 3:6] < 0.1).all(axis=2) & (np.abs(turn) < np.radians(2))
    alike &= gap[..., 7] < 0.02
    return np.array([len(boxes), alike.any(axis=1).sum()])


def detect(case, preset):
    return detect_in_form(case, preset, backend.on_accelerator())


@functools.cache
def detect_in_form(case, preset, accelerator):
    cloud = jaxbox.PointCloud.from_numpy(case.xyz, capacity=parity.CAPACITY)
    with backend.building_for(accelerator=accelerator):
        # Nobody but the tests runs an accelerator's program on a CPU.
        find = parity.detect_quickly if accelerator else jaxbox.detect
        return parity.on_host(find(cloud, PRESETS[preset]))


def both(cases, preset, use_plane):
    """Detections of jaxbox and of the reference, for some of the sweeps."""
    for case in cases[SWEEPS]:
        ours = detect(case, preset)
        use_plane(ours.ground)
        yield ours, reference.detect(case.xyz, PRESETS[preset])


def missing(pairs):
    """Boxes that count and have no partner, and boxes that count; of jaxbox and the reference together."""
    total = np.zeros(2, int)
    for ours, theirs in pairs:
        boxes, others = boxes_of(ours), boxes_of(theirs)
        total += num_partners(boxes, others) + num_partners(others, boxes)
    return total[0] - total[1], total[0]


def owners_of(detections, num_points, min_score):
    """(n, 2) m: centre of the box that each point belongs to; far away for points of no box that counts."""
    row = np.asarray(detections.point_detection)[:num_points]
    owned = (row >= 0) & (detections.score[row] > min_score)
    return np.where(owned[:, None], detections.center[row, :2], 1e6)


@pytest.mark.parametrize("preset", parity.slow_but_first(PRESETS))
def test_on_one_ground_plane_both_find_the_same_boxes_of_the_same_points(cases, preset, monkeypatch):
    def use_plane(plane):
        fit = plane.coefficients.astype(float), bool(plane.found), int(plane.num_inliers)
        monkeypatch.setattr(reference_ground, "fit_ground_planes", lambda *_, **__: [fit])

    pairs = list(both(cases, preset, use_plane))
    bad, total = missing(pairs)
    assert total > 15
    parity.assert_share(bad, total, 0.02, f"boxes of {preset}, on one plane")
    # A component that one cell joins otherwise takes its points along.
    slab = np.array([(ours.counts.slab_points, theirs.counts["slab_points"]) for ours, theirs in pairs])
    parity.assert_share(np.abs(slab @ [1, -1]).sum(), slab[:, 0].sum(), 0.03, f"slab points of {preset}")
    for ours, theirs in pairs:
        count = len(theirs.ground_mask)
        ground = ours.ground_mask[:count] != theirs.ground_mask
        parity.assert_share(ground.sum(), count, 1e-4, f"ground of {preset}")
        for one, other in ((ours, theirs), (theirs, ours)):
            # Boxes of just the least score may round to either side of it.
            first, second = owners_of(one, count, MIN_SCORE), owners_of(other, count, 0.8 * MIN_SCORE)
            owned = first[:, 0] < 1e6
            apart = owned & (np.abs(first - second).max(axis=1) > 0.1)
            # A box that differs, of which 2 % are let pass above, takes its points along.
            parity.assert_share(apart.sum(), owned.sum(), 0.02, f"points of the boxes of {preset}")


@pytest.mark.parametrize(("preset", "limit"), parity.slow_but_first([("default", 0.3), ("paper", 0.4)]))
def test_on_planes_of_their_own_most_boxes_are_the_same(cases, preset, limit):
    # A point more or less can decide whether a side was seen whole, and so its length. The paper's
    # candidates hold walls too, so that its plane, and with it every height, is less sure.
    bad, total = missing(both(cases, preset, use_plane=lambda plane: None))
    parity.assert_share(bad, total, limit, f"boxes of {preset}, each on its own plane")


@pytest.mark.parametrize("preset", parity.slow_but_first(PRESETS))
def test_the_form_for_accelerators_finds_what_the_form_for_a_cpu_does(cases, preset):
    moved, total = 0, 0
    for case in cases[SWEEPS]:
        ours, theirs = (detect_in_form(case, preset, accelerator) for accelerator in (False, True))
        assert ours.status == theirs.status
        for name in ("label", "valid"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
        boxes, others = boxes_of(ours), boxes_of(theirs)
        assert len(boxes) > 5
        # Two placements of a box may be worth the same: either may be chosen. None of those boxes counts.
        same = np.abs(boxes[:, :7] - others[:, :7]).max(axis=1) <= 1e-4
        assert (boxes[~same, 7] < MIN_SCORE).all()
        moved, total = moved + (~same).sum(), total + len(same)
        parity.assert_within((boxes - others)[same, 7], 1e-5, f"scores of {preset}")
    parity.assert_share(moved, total, 0.03, f"boxes of {preset}, placed otherwise")


def terrace_with_cars():
    """(n, 3) float32 m: a road, a terrace above it, and the two faces of a car on each that are seen."""
    rng = np.random.default_rng(0)
    xy = rng.uniform([-40, -20], [40, 20], (30_000, 2))
    xy = xy[np.hypot(*xy.T) > 3]
    ground_z = np.where(xy[:, 1] > 5, TERRACE_Z, ROAD_Z)
    points = [np.column_stack([xy, rng.normal(ground_z, 0.01)])]
    for y, ground_z in ((-6.0, ROAD_Z), (9.0, TERRACE_Z)):
        up = rng.uniform(ground_z + 0.2, ground_z + 1.5, 1000)
        points.append(
            np.column_stack([rng.uniform(10, 14, 600), np.full(600, y - np.sign(y) * 0.8), up[:600]])
        )
        points.append(np.column_stack([np.full(400, 10.0), rng.uniform(y - 0.8, y + 0.8, 400), up[600:]]))
    return np.concatenate(points).astype(np.float32)


ROAD_Z, TERRACE_Z = -1.7, -0.5


def test_on_several_planes_boxes_stand_where_those_of_the_reference_do():
    paper = PRESETS["paper"]
    ground = dataclasses.replace(paper.ground, max_planes=2, surface=True)
    config, xyz = dataclasses.replace(paper, ground=ground), terrace_with_cars()
    bottoms = []
    ours = parity.detect_quickly(jaxbox.PointCloud.from_numpy(xyz), config)
    for found in (ours, reference.detect(xyz, config)):
        boxes = boxes_of(found)
        bottoms.append((boxes[:, 2] - boxes[:, 5] / 2)[np.argsort(boxes[:, 1])])
    np.testing.assert_allclose(bottoms[0], bottoms[1], atol=0.02)
    # The paper's boxes begin at the lowest point of the cluster above the ground.
    np.testing.assert_allclose(bottoms[0], [ROAD_Z + 0.2, TERRACE_Z + 0.2], atol=0.15)


@pytest.mark.slow
def test_on_two_planes_the_cars_of_a_platform_are_found_as_by_the_reference():
    base = PRESETS["default"]
    config = dataclasses.replace(base, ground=dataclasses.replace(base.ground, max_planes=2))
    (platform,) = (each for each in SITUATIONS if each.name == "cars on a platform of 1 m")
    for xyz, _ in platform.sweeps():
        cloud = jaxbox.PointCloud.from_numpy(xyz, capacity=parity.CAPACITY)
        found = parity.on_host(parity.detect_quickly(cloud, config))
        ours, theirs = boxes_of(found), boxes_of(reference.detect(xyz, config))
        counts = num_partners(ours, theirs) + num_partners(theirs, ours)
        assert counts[0] == counts[1] >= 4
