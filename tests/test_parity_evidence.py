"""Parity with the reference: the polar evidence, rays over boxes, completion, all on equal inputs."""

import dataclasses
import functools
import math
import types

import jax
import jax.numpy as jnp
import numpy as np
import parity
import pytest

from jaxbox import reference
from jaxbox.stages import _assignments, completion, evidence, ground
from jaxbox.stages.state import NOT_A_BOX, Boxes, ClassHypotheses, Rectangles
from jaxbox.xla import range_bits

EVIDENCE = parity.CONFIG.evidence
NUM_RAYS, NUM_FINAL_RAYS = parity.CONFIG.completion.num_rays, parity.CONFIG.completion.num_final_rays
CLASSES = parity.CONFIG.vehicles.classes

first_returns = jax.jit(evidence.first_returns)
steepest_beam = jax.jit(evidence.steepest_beam)


@parity.PerForm
def build_evidence(xyz, height, mask, plane, surface):
    elevation = functools.partial(
        ground.ground_elevation, planes=plane[None], surface=surface, config=parity.CONFIG.ground
    )
    return evidence.build_evidence(xyz, height, mask, -plane[2], elevation, EVIDENCE)


@parity.PerForm
def weigh_boxes(seen, boxes, label, count):
    length, width, yaw = boxes[:, 2:].T
    flat = Boxes(boxes[:, :2], length, width, yaw, boxes[:, 2:4], length, length > 0)
    return evidence.weigh_boxes(seen, flat, ClassHypotheses(label, label, count), parity.CONFIG)


@functools.partial(parity.PerForm, static_argnames="num_rays")
def cast_rays(seen, boxes, raised, num_rays):
    length, width, yaw = boxes[:, 2:].T
    flat = types.SimpleNamespace(center=boxes[:, :2], length=length, width=width, yaw=yaw)
    return evidence.cast_rays(seen, flat, EVIDENCE, num_rays=num_rays, raised=raised)


@parity.PerForm
def complete(readings, points, seen, number):
    """Every cluster tried as one class."""
    cluster = jnp.arange(parity.MAX_CLUSTERS)
    hypotheses = ClassHypotheses(cluster, jnp.full_like(cluster, number), points.start.shape[0])
    cast = functools.partial(evidence.cast_rays, seen, config=EVIDENCE)
    return completion._complete_by_evidence(hypotheses, readings, points, cast, parity.CONFIG)[0]


def random_boxes(count, rng):
    """(count, 5): near and far, of all turns and sizes up to a truck's; some round the sensor."""
    columns = rng.uniform([-60, -50, 0.5, 0.3, -4], [60, 50, 12, 3, 4], (count, 5))
    columns[: count // 8, :2] /= 20
    return columns.astype(np.float32)


@parity.PerForm
def pack_words(beams, hits):
    return range_bits.covered_words(beams), range_bits.next_words(hits)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("num_blocks", [1, 2, 21])
def test_words_hold_the_sums_of_all_cells_before_and_the_next_hit_beyond(num_blocks):
    num_azimuths, rng = 12, np.random.default_rng(num_blocks)
    shape = num_blocks, range_bits.BLOCK, num_azimuths
    cell = np.arange(num_blocks * range_bits.BLOCK)[:, None]
    for share in (0.0, 0.01, 0.1, 1.0):
        hits = rng.random((len(cell), num_azimuths)) < share
        beams = rng.integers(-1, 2, hits.shape, np.int32) * hits
        free, hit = map(np.asarray, pack_words(beams.reshape(shape), hits.reshape(shape)))
        is_free = np.cumsum(beams, axis=0) > 0
        np.testing.assert_array_equal(range_bits.flagged_cells(free), is_free)
        np.testing.assert_array_equal(range_bits.flagged_cells(hit), hits)
        before = np.cumsum(is_free, axis=0)[:: range_bits.BLOCK] - is_free[:: range_bits.BLOCK]
        np.testing.assert_array_equal(free >> range_bits.BLOCK, before)
        next_hit = np.minimum.accumulate(np.where(hits, cell, range_bits.NEVER)[::-1])[::-1]
        beyond = np.append(
            next_hit[range_bits.BLOCK :: range_bits.BLOCK], [[range_bits.NEVER] * num_azimuths], 0
        )
        np.testing.assert_array_equal(hit >> range_bits.BLOCK, beyond)


@pytest.mark.usefixtures("platform")
def test_evidence_differs_in_few_cells_only(cases):
    wrong = np.zeros(4, int)
    for case in cases:
        ours = build_evidence(
            parity.pad(case.xyz, parity.CAPACITY),
            parity.pad(case.height, parity.CAPACITY),
            parity.pad(case.inlier, parity.CAPACITY),
            case.plane,
            case.surface,
        )
        hit, free = (range_bits.flagged_cells(np.asarray(words)) for words in (ours.hit, ours.free))
        both_hits = np.concatenate([case.evidence.hit_sums, case.evidence.raised_hit_sums])
        hits, frees = (parity.flagged(sums).T for sums in (both_hits, case.evidence.free_sums))
        assert np.sum(case.evidence.raised_hit_sums[:, -1]) > np.sum(case.evidence.hit_sums[:, -1])
        # A rise on the edge of a level may round into the next.
        assert abs(float(ours.steepest) - case.evidence.steepest) < 1e-3
        wrong += np.sum(hit != hits), hits.sum(), np.sum(free != frees), frees.sum()
    # A return whose azimuth or range lies on the edge of a cell may round into the next.
    parity.assert_share(*wrong[:2], 1e-4, "hits")
    parity.assert_share(*wrong[2:], 1e-4, "free cells")


def test_the_highest_beam_is_that_of_most_points_and_not_of_strays():
    rng = np.random.default_rng(0)
    rho = rng.uniform(5, 60, 4000).astype(np.float32)
    for top in (0.1037, 0.2137):
        z = (rho * np.linspace(-0.4, top, 64)[rng.integers(0, 64, 4000)]).astype(np.float32)
        z[:20] = 0.5 * rho[:20]
        for mask in (np.ones(4000, bool), np.arange(4000) % 2 == 0):
            found = float(steepest_beam(z, rho, mask))
            assert found == pytest.approx(reference.steepest_beam(z[mask], rho[mask]), abs=1e-5)
            assert top - 0.01 < found < top + 0.006
        shuffled = rng.permutation(4000)
        assert steepest_beam(z[shuffled], rho[shuffled], mask[shuffled]) == steepest_beam(z, rho, mask)
    # Nothing is known: a few strays, near points, and no points.
    for mask in (np.arange(4000) < 20, rho < evidence.STEEP_FROM_M, np.zeros(4000, bool)):
        assert (
            steepest_beam(z, rho, mask)
            == np.float32(0.03)
            == np.float32(reference.steepest_beam(z[mask], rho[mask]))
        )


def test_first_returns_are_those_of_the_reference(cases):
    for case in cases:
        expected = reference.first_returns(case.evidence, EVIDENCE)
        np.testing.assert_array_equal(first_returns(case.evidence_as_input(), EVIDENCE), expected)
        assert expected.min() >= EVIDENCE.min_range_m - EVIDENCE.range_cell_m
        assert len(np.unique(expected)) > 50


def test_without_evidence_nothing_returned_before_the_end_of_the_grid():
    end_m = EVIDENCE.num_ranges * EVIDENCE.range_cell_m
    for module in (evidence, reference):
        first_return_m = module.first_returns(None, EVIDENCE)
        assert first_return_m.shape == (EVIDENCE.num_azimuths,)
        assert (first_return_m == end_m).all()


@pytest.mark.usefixtures("platform")
def test_boxes_are_weighed_by_the_rays_of_their_class(cases):
    rng, num_boxes = np.random.default_rng(1), 512
    for case in cases:
        boxes, label = random_boxes(num_boxes, rng), rng.integers(0, len(CLASSES), num_boxes, np.int32)
        raised = np.array([reference.is_raised(CLASSES[number]) for number in label])
        rays = weigh_boxes(case.evidence_as_input(), boxes, label, num_boxes)
        of_class = cast_rays(case.evidence_as_input(), boxes, raised, NUM_FINAL_RAYS)
        np.testing.assert_array_equal(rays.hit, of_class.hit)
        np.testing.assert_array_equal(rays.free_length, of_class.free_length)


@pytest.mark.usefixtures("platform")
def test_rays_over_boxes_end_as_in_the_reference(cases):
    rng = np.random.default_rng(0)
    for case in cases:
        found = [done.box for _, done in case.boxes if done is not None]
        boxes = np.concatenate([random_boxes(512, rng), np.array(found, np.float32)])
        raised = np.arange(len(boxes)) % 3 == 0
        expected = reference.cast_rays(case.evidence, boxes.astype(float), num_rays=NUM_RAYS, raised=raised)
        seen = case.evidence_as_input()
        rays = parity.on_host(cast_rays(seen, parity.pad(boxes, 1024), parity.pad(raised, 1024), NUM_RAYS))
        differ = np.zeros(len(boxes), bool)
        for kind in ("hit", "free", "deep", "occluded", "free_length", "open"):
            gap = np.abs(getattr(rays, kind)[: len(boxes)] - getattr(expected, kind))
            differ |= gap > 1e-6
            parity.assert_share(
                np.sum(gap > 2.5 / NUM_RAYS), len(boxes), 0.005, f"rays {kind}, more than two"
            )
        # A ray on the edge of an azimuth cell, or a range on that of a range cell, may round either way.
        parity.assert_share(differ.sum(), len(boxes), 0.005, "boxes with a ray that ends otherwise")
        low = reference.cast_rays(case.evidence, boxes.astype(float), num_rays=NUM_RAYS)
        assert np.all(expected.hit >= low.hit)
        assert np.all(expected.hit[~raised] == low.hit[~raised])
        assert np.any(expected.hit > low.hit)
        assert (expected.hit > 0.25).sum() > 10
        assert (expected.free > 0.25).sum() > 10


def rectangles_of(proposals, angles):
    extents = np.array([p.extents[a] for p, a in zip(proposals, angles, strict=True)])
    worth = np.array([p.curve[a] for p, a in zip(proposals, angles, strict=True)])
    low, high = extents[:, [0, 2]], extents[:, [1, 3]]
    rows = np.column_stack([low, high, np.array(angles) * math.pi / 2 / 90, worth])
    return Rectangles(parity.pad(rows, parity.MAX_CLUSTERS))


def rows_of(boxes: Boxes, expected):
    """Boxes, measured sizes and J of the stage and of the reference, which agree on what is a box."""
    is_box = np.array([e is not None for e in expected])
    np.testing.assert_array_equal(boxes.objective[: len(expected)] > NOT_A_BOX, is_box)
    parts = boxes.center, boxes.length, boxes.width, boxes.yaw, boxes.measured, boxes.objective
    done = [e for e in expected if e is not None]
    assert len(done) > 10
    return np.column_stack(parts)[: len(expected)][is_box], np.array(list(map(row_of, done)))


def row_of(done):
    """Box, measured size and J of a completed box of the reference."""
    return np.array([*done.box, done.measured_length_m, done.measured_width_m, done.objective])


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("number", [0, 1])
def test_completed_boxes_are_those_of_the_reference(cases, number):
    vehicle = parity.CONFIG.vehicles.classes[number]
    rng = np.random.default_rng(number)
    pairs, equals = [], []
    for case in cases:
        # The best rotation for cars; any for vans, so that bad rectangles are completed alike too. And a
        # second reading of each, at any rotation.
        angles = [int(np.argmax(p.curve)) if number == 0 else rng.integers(90) for p in case.proposals]
        others = list(rng.integers(90, size=len(angles)))
        rectangles = [list(map(parity.rectangle_of, case.proposals, each)) for each in (angles, others)]
        rows = range(len(angles) if number == 0 else 0)
        in_row = reference.sides_in_rows(rows, rectangles, vehicle, parity.CONFIG.completion)
        expected = [
            equal_boxes(p, pair, vehicle, case.evidence, {(i, side) for at, i, side in in_row if at == row})
            for row, (p, *pair) in enumerate(zip(case.proposals, *rectangles, strict=True))
        ]
        points, count = parity.padded_points([case])
        boxes = complete(
            [rectangles_of(case.proposals, angles), rectangles_of(case.proposals, others)],
            parity.point_lists(
                parity.pad(points, parity.MAX_CLUSTERS), parity.pad(count, parity.MAX_CLUSTERS)
            ),
            case.evidence_as_input(),
            number,
        )
        pairs.append(rows_of(parity.on_host(boxes), [best[0] if best else None for best in expected]))
        equals += [[row_of(box)[:-1] for box in best] for best in expected if best]
    ours, theirs = (np.concatenate(rows) for rows in zip(*pairs, strict=True))
    gap = np.abs(ours[:, -1] - theirs[:, -1])
    # A ray that ends otherwise moves J by a step of 1 / 32, and by the length that it had free.
    parity.assert_share(np.sum(gap > 1e-4), len(gap), 0.005, f"J of boxes completed {number}")
    parity.assert_within(gap, 0.3, f"J of boxes completed {number}")
    # Rays come in thirty-seconds, so that hypotheses may be worth the same: then any of them will do.
    other = [
        np.abs(box - best).max(axis=1).min() > 1e-4 for box, best in zip(ours[:, :-1], equals, strict=True)
    ]
    parity.assert_share(np.sum(other), len(other), 0.005, f"boxes completed {number}")


def equal_boxes(proposal, rectangles, vehicle, evidence, in_row):
    """The reference's box of a proposal, and those it would answer where J is the same to 1e-5."""
    config = parity.CONFIG.completion
    assignments = reference.complete_assignments(
        proposal.xy, rectangles, vehicle, evidence, config, in_row=in_row
    )
    bests = [max(placed, key=lambda box: box.objective) for placed in assignments]
    highest = max((box.objective for box in bests), default=0.0)
    equal = []
    for i, placed in enumerate(assignments):
        others = bests[:i] + bests[i + 1 :]
        chosen = [box for box in placed if box.objective > highest - 1e-5]
        raised = [dataclasses.replace(box, objective=highest) for box in chosen]
        equal += [reference.blend_boxes([box, *others], max_loss=config.blend_objective) for box in raised]
    return equal


@pytest.mark.parametrize("mode", ["away", "none"])
def test_boxes_without_evidence_are_those_of_the_reference(cases, mode):
    vehicle = parity.CONFIG.vehicles.classes[0]
    prior = jax.tree.map(lambda value: jnp.full(parity.MAX_CLUSTERS, value), vehicle)

    @jax.jit
    def stage(rectangles):
        sides = _assignments.longer_side(rectangles)
        if mode == "none":
            return _assignments.keep_measured(sides, prior)
        return _assignments.extend_away(sides, prior, parity.CONFIG.completion)

    for case in cases:
        angles = [int(np.argmax(p.curve)) for p in case.proposals]
        expected = [
            parity.complete(p, a, vehicle, None, mode) for p, a in zip(case.proposals, angles, strict=True)
        ]
        boxes = parity.on_host(stage(rectangles_of(case.proposals, angles)))
        ours, theirs = rows_of(boxes, expected)
        parity.assert_within((ours - theirs)[:, :-1], 1e-4, f"boxes {mode}")
        assert np.all(ours[:, -1] == _assignments.CERTAIN)
