"""Parity with the reference: points round boxes, scores, overlap and suppression, on equal inputs."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import parity
import pytest

from jaxbox import reference
from jaxbox.geometry import planar
from jaxbox.stages import _priors, _surroundings, scoring
from jaxbox.stages.state import NeighbourhoodCounts, Obstacles, RayFractions
from jaxbox.xla import backend

SETTINGS = parity.CONFIG.vehicles
COUNTS = ("num_inside", "num_above", "num_ring", "num_upper", "num_recessed")
MAX_BOXES = 1024
NUM_RANDOM = 300


@parity.PerForm
def count_points_around(boxes, tops, recess, past_ends, sure, num_boxes, xy, height, num_points):
    fields = {"count_max_height_m": tops, "recess_m": recess, "past_ends_m": past_ends}
    prior = dataclasses.replace(SETTINGS.classes[0], **fields)
    obstacles = Obstacles(
        jnp.arange(len(xy)), xy, jnp.zeros_like(height), height, jnp.int32(num_points), len(xy)
    )
    region = parity.CONFIG.region
    return _surroundings.count_points_around(boxes, prior, sure, num_boxes, obstacles, SETTINGS, region)


non_max_suppression = parity.PerForm(scoring.non_max_suppression)
rectangle_iou = jax.jit(jax.vmap(planar.rectangle_iou))


def boxes_of(case, rng):
    """(n, 5) completed boxes of the case, and as many moved and turned at random."""
    found = np.array([done.box for _, done in case.boxes if done is not None])
    moved = found[rng.integers(len(found), size=NUM_RANDOM)]
    moved = moved + rng.normal(0, [0.5, 0.5, 1, 0.3, 0.3], moved.shape)
    moved[:, 2:4] = np.abs(moved[:, 2:4])
    return np.concatenate([found, moved]).astype(np.float32)


@functools.cache
def counted_by_reference(cases):
    """Of each case: boxes, what else of them `count_points_around` takes, and the counts."""
    rng = np.random.default_rng(0)
    car = SETTINGS.classes[0]
    class_tops = [vehicle.count_max_height_m for vehicle in SETTINGS.classes]
    rows = []
    for case in cases:
        boxes = boxes_of(case, rng)
        tops = rng.choice(class_tops, len(boxes)).astype(np.float32)
        recess = rng.choice([-1, 0.15, 0.3], len(boxes)).astype(np.float32)
        past_ends = rng.choice([0, 2], len(boxes)).astype(np.float32)
        sure = rng.choice([0, 0.5, 1], len(boxes)).astype(np.float32)
        of_boxes = [
            dataclasses.replace(car, count_max_height_m=top, recess_m=recess_m, past_ends_m=past)
            for top, recess_m, past in zip(tops.tolist(), recess.tolist(), past_ends.tolist(), strict=True)
        ]
        counts = [
            reference.count_points_around(box, prior, case.obstacles, SETTINGS, sure=is_sure)
            for box, prior, is_sure in zip(boxes.astype(float), of_boxes, sure.tolist(), strict=True)
        ]
        rows.append((case, boxes, (tops, recess, past_ends, sure), counts))
    return rows


@pytest.mark.usefixtures("platform")
def test_points_round_boxes_are_those_of_the_reference(cases):
    for case, boxes, priors, counted in counted_by_reference(cases):
        xy, height = case.obstacles.xyz[:, :2].astype(np.float32), case.obstacles.height.astype(np.float32)
        around = count_points_around(
            parity.pad(boxes, MAX_BOXES),
            *(parity.pad(column, MAX_BOXES) for column in priors),
            len(boxes),
            parity.pad(xy, parity.MAX_OBSTACLES),
            parity.pad(height, parity.MAX_OBSTACLES),
            len(xy),
        )
        around = parity.on_host(around)
        wrong, seen, tops_m, depths_m = 0, 0, [], []
        for row, expected in enumerate(counted):
            theirs = np.array([getattr(expected, name) for name in COUNTS])
            ours = np.array([getattr(around, name)[row] for name in COUNTS])
            wrong, seen = wrong + np.abs(ours - theirs).sum(), seen + theirs.sum()
            tops_m.append((around.top[row], expected.top))
            depths_m.append((around.deepest[row], expected.deepest))
        # A point on the edge of a box may round to either side of it.
        parity.assert_share(wrong, seen, 1e-4, "points round boxes")
        # A height on the edge of a level may round to either side of it.
        ours_m, theirs_m = np.transpose(tops_m)
        off = np.abs(ours_m - theirs_m) > 1e-4
        parity.assert_share(off.sum(), len(off), 0.02, "tops")
        off = np.abs(np.diff(depths_m, axis=1)) > 1e-4
        parity.assert_share(off.sum(), len(off), 0.02, "farthest points")


@jax.jit
def score_boxes(columns, prior):
    around = NeighbourhoodCounts(jnp.stack(columns["around"], axis=1))
    seen = (columns[name] for name in ("num_points", "hit", "free_length", "objective"))
    where = (columns[name] for name in ("rho", "reach", "seen_width", "is_open", "in_threes"))
    early = scoring.evidence_score(*seen, SETTINGS)
    own = scoring.own_score(around, columns["num_points"], prior)
    late, top_unseen = scoring.neighbourhood_score(around, *where, prior, SETTINGS)
    by_size = scoring.size_score(columns["length"], columns["width"], prior)
    early = early * by_size * prior.prior_weight * scoring.far_score(columns["rho"], prior, SETTINGS)
    return early * own * late, top_unseen


@jax.jit
def end_where_seen(boxes, columns, prior):
    around = NeighbourhoodCounts(columns)
    return scoring.end_where_seen(boxes, around, prior, parity.CONFIG.completion, 0.004)


def test_scores_are_those_of_the_reference_over_all_classes_and_gates():
    rng = np.random.default_rng(0)
    label = rng.integers(0, 3, MAX_BOXES)
    prior = jax.tree.map(lambda *values: np.array(values)[label], *SETTINGS.classes)
    columns = {
        "length": prior.length_m + rng.normal(0, 0.7, MAX_BOXES),
        "width": prior.width_m + rng.normal(0, 0.2, MAX_BOXES),
        "num_points": rng.integers(1, 300, MAX_BOXES),
        "hit": rng.uniform(0, 1, MAX_BOXES),
        "free_length": rng.uniform(0, 0.2, MAX_BOXES) ** 2,
        "objective": rng.uniform(2, 3, MAX_BOXES),
        "rho": rng.uniform(2, 80, MAX_BOXES),
        "reach": rng.uniform(0.5, 4, MAX_BOXES),
        "seen_width": rng.uniform(0, 2.5, MAX_BOXES),
        "is_open": np.maximum(rng.uniform(-0.1, 0.2, MAX_BOXES), 0),
        "in_threes": rng.random(MAX_BOXES) < 0.3,
        "around": [
            rng.integers(1, 400, MAX_BOXES),
            np.where(rng.random(MAX_BOXES) < 0.5, prior.height_m, 1.5) + rng.normal(0, 0.5, MAX_BOXES),
            rng.integers(0, 20, MAX_BOXES),
            rng.integers(0, 20, MAX_BOXES),
            upper := rng.integers(0, 20, MAX_BOXES),
            rng.integers(0, upper + 1),
            rng.uniform(0, 5, MAX_BOXES),
        ],
    }
    floats, prior = jax.tree.map(np.float32, (columns, prior))
    columns = floats | {"in_threes": columns["in_threes"]}
    scores, top_unseen = jax.device_get(score_boxes(columns, prior))
    expected, expected_unseen = [], []
    for row in range(MAX_BOXES):
        around = reference.NeighbourhoodCounts(*(float(value[row]) for value in columns["around"]))
        one = {name: float(columns[name][row]) for name in ("hit", "free_length")}
        length, width, seen_width = (float(columns[name][row]) for name in ("length", "width", "seen_width"))
        box = np.array([columns["rho"][row], 0.0, length, width, 0.0])
        expected.append(
            reference.score_box(
                reference.CompletedBox(box, float(columns["objective"][row]), length, seen_width),
                SETTINGS.classes[label[row]],
                around=around,
                num_points=int(columns["num_points"][row]),
                **one,
                config=SETTINGS,
                reach=float(columns["reach"][row]),
                is_open=float(columns["is_open"][row]),
                in_threes=bool(columns["in_threes"][row]),
            )
        )
        where = [float(columns[name][row]) for name in ("rho", "reach", "seen_width", "is_open")]
        where.append(bool(columns["in_threes"][row]))
        late = reference.neighbourhood_score(around, *where, SETTINGS.classes[label[row]], SETTINGS)
        expected_unseen.append(late[1])
    expected = np.array(expected)
    np.testing.assert_allclose(scores, expected, rtol=2e-4, atol=1e-7)
    assert (expected == 0).sum() > 50
    assert (expected > 0.05).sum() > 50
    np.testing.assert_array_equal(top_unseen, expected_unseen)
    assert 20 < sum(expected_unseen) < MAX_BOXES - 20


def test_a_box_that_others_fill_counts_by_the_share_of_its_own_points():
    inside = np.array([100, 100, 100, 60, 0], np.float32)
    around = NeighbourhoodCounts(np.stack([inside, *np.zeros((6, 5), np.float32)], axis=1))
    truck = SETTINGS.classes[2]
    own = scoring.own_score(around, np.array([100, 50, 20, 90, 3]), truck)
    np.testing.assert_allclose(own, [1, 1, 0.5, 1, 1], atol=1e-6)
    no_gate = dataclasses.replace(truck, own_share=0.0)
    np.testing.assert_array_equal(scoring.own_score(around, np.zeros(5, np.int32), no_gate), 1)


def test_free_space_below_a_body_counts_as_in_the_reference():
    rng = np.random.default_rng(0)
    free, free_length = rng.random((2, MAX_BOXES)).astype(np.float32)
    nothing = np.zeros(MAX_BOXES, np.float32)
    rays = RayFractions(1 - free, free, nothing, nothing, free_length, free)
    for open_below in (0.0, 0.4, 1.0, 1.2):
        prior = dataclasses.replace(SETTINGS.classes[0], open_below=open_below)
        ours = _priors.closed_free_length(rays, prior)
        theirs = reference.closed_free_length(rays, prior)
        np.testing.assert_allclose(ours, theirs, atol=1e-6)
    assert (ours <= free + 1e-6).all()
    unchanged = _priors.closed_free_length(rays, dataclasses.replace(prior, open_below=0.0))
    np.testing.assert_array_equal(unchanged, free_length)


def test_far_ends_are_where_the_reference_sees_them():
    rng = np.random.default_rng(0)
    label = rng.integers(0, 3, MAX_BOXES)
    prior = jax.tree.map(lambda *values: np.array(values, np.float32)[label], *SETTINGS.classes)
    size = np.column_stack(
        [prior.length_m * rng.uniform(0.8, 1.3, MAX_BOXES), rng.uniform(1, 2.5, MAX_BOXES)]
    )
    place = rng.uniform([-60, -60], 60, (MAX_BOXES, 2)) * rng.choice([0.02, 0.2, 1], (MAX_BOXES, 1))
    boxes = np.column_stack([place, size, rng.uniform(-4, 4, MAX_BOXES)]).astype(np.float32)
    columns = np.zeros((MAX_BOXES, 7), np.float32)
    columns[:, 0], columns[:, 6] = rng.integers(0, 500, MAX_BOXES), size[:, 0] * rng.uniform(0, 1, MAX_BOXES)
    rule, beam_angle = parity.CONFIG.completion, 0.004
    ours, sure = end_where_seen(boxes, columns, prior)
    answers = [
        reference.end_where_seen(
            box,
            reference.NeighbourhoodCounts(columns[row, 0], 1.5, 0, 0, deepest=float(columns[row, 6])),
            SETTINGS.classes[label[row]],
            rule,
            beam_angle,
        )
        for row, box in enumerate(boxes.astype(float))
    ]
    expected, expected_sure = zip(*answers, strict=True)
    np.testing.assert_allclose(ours, expected, atol=1e-4)
    np.testing.assert_allclose(sure, expected_sure, atol=1e-4)
    moved = np.abs(np.array(expected) - boxes)[:, 2] > 1e-3
    assert 50 < moved.sum() < MAX_BOXES / 2


def hilly(xyz):
    """z of a made-up ground under points (n, 3), with slopes towards and away from the sensor."""
    x, y, z = xyz.T
    return 0.01 * x + abs(y % 20 - 10) / 20 + 0.1 * z - 1.7


def test_far_vehicles_stand_where_the_reference_says():
    rng = np.random.default_rng(0)
    place = rng.uniform(-80, 80, (MAX_BOXES, 2)) * rng.choice([0.01, 0.3, 1], (MAX_BOXES, 1))
    size, yaw = rng.uniform([2, 1], [9, 3], (MAX_BOXES, 2)), rng.uniform(-4, 4, MAX_BOXES)
    boxes = np.column_stack([place, size, yaw]).astype(np.float32)
    z = rng.uniform(-2, 1, MAX_BOXES).astype(np.float32)

    stand = jax.jit(lambda *rows: _surroundings.stand_on_ground(*rows, hilly, SETTINGS))
    ground, lower = stand(boxes, z)
    rows = zip(boxes.astype(float), z.astype(float), strict=True)
    expected = np.array([reference.stand_on_ground(*row, hilly, SETTINGS) for row in rows])
    np.testing.assert_allclose(np.column_stack([ground, lower]), expected, atol=1e-4)
    np.testing.assert_allclose(ground, hilly(np.column_stack([place, z])), atol=1e-4)
    far = np.hypot(*boxes[:, :2].astype(float).T) - SETTINGS.far_ground_from_m
    assert (expected[far < 0, 1] == 0).all()
    assert (expected[far > 0, 1] >= SETTINGS.far_ground_rise * far[far > 0] - 1e-6).all()
    assert (expected[:, 1] > SETTINGS.far_ground_rise * np.maximum(far, 0) + 0.01).sum() > 20
    alone = dataclasses.replace(SETTINGS, neighbourhood=False)
    assert not np.any(_surroundings.stand_on_ground(boxes, z, hilly, alone)[1])


def test_overlap_of_boxes_is_that_of_opencv(cases):
    rng = np.random.default_rng(0)
    for case in cases:
        boxes = boxes_of(case, rng)[-NUM_RANDOM:]
        others = (boxes + rng.normal(0, [1, 1, 0.5, 0.2, 1], boxes.shape)).astype(np.float32)
        others[:, 2:4] = np.abs(others[:, 2:4])
        expected = [
            reference.bev_iou(a, b) for a, b in zip(boxes.astype(float), others.astype(float), strict=True)
        ]
        parity.assert_within(rectangle_iou(boxes, others) - np.array(expected), 1e-3, "IoU")
        assert np.std(expected) > 0.1


@pytest.mark.usefixtures("platform")
def test_suppression_keeps_the_boxes_that_the_reference_keeps(cases):
    rng = np.random.default_rng(0)
    for case in cases:
        boxes = boxes_of(case, rng)
        scores = np.sort(rng.random(len(boxes)))[::-1]
        boxes = boxes[rng.permutation(len(boxes))]
        kept = reference.non_max_suppression(boxes.astype(float), scores, max_overlap=SETTINGS.max_overlap)
        expected = np.isin(np.arange(len(boxes)), kept)
        keep = non_max_suppression(
            parity.pad(boxes, MAX_BOXES),
            parity.padded_mask(len(boxes), MAX_BOXES),
            max_overlap=SETTINGS.max_overlap,
        )
        keep = np.asarray(keep)
        assert not keep[len(boxes) :].any()
        # Overlaps of just the limit may round to either side of it.
        parity.assert_share(np.sum(keep[: len(boxes)] != expected), len(boxes), 0.01, "kept boxes")
        assert 10 < expected.sum() < len(boxes) / 2


def row_of_boxes(count, step_m):
    """(count, 5) boxes of 4 x 2 m, each so much farther along x than the one before."""
    return np.array([step_m, 0, 0, 0, 0] * np.arange(count)[:, None] + [0, 20, 4, 2, 0], np.float32)


HEAPS = {
    "none": row_of_boxes(0, 1),
    "one": row_of_boxes(1, 1),
    "apart": row_of_boxes(70, 4.5),
    "all the same": row_of_boxes(33, 0),
    # Each overlaps the next and no other: every other one is kept, and of the last that is known last.
    "a chain": row_of_boxes(70, 3),
    "a chain, last first": row_of_boxes(70, 3)[::-1],
    "a chain of pairs": np.repeat(row_of_boxes(40, 3), 2, axis=0),
    "a chain whose links overlap two more": row_of_boxes(70, 1.2),
}


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("heap", HEAPS)
@pytest.mark.parametrize("room", [80, 96])
def test_chains_and_heaps_of_boxes_are_suppressed_as_by_the_reference(heap, room):
    boxes = HEAPS[heap]
    scores = np.arange(len(boxes), 0, -1) / 100
    kept = reference.non_max_suppression(boxes.astype(float), scores, max_overlap=SETTINGS.max_overlap)
    keep = non_max_suppression(
        parity.pad(boxes, room), parity.padded_mask(len(boxes), room), max_overlap=SETTINGS.max_overlap
    )
    np.testing.assert_array_equal(np.flatnonzero(keep), np.sort(kept))


def test_the_chains_are_longer_than_the_rounds_without_a_look(monkeypatch):
    # Or the test above would not need the loop that goes on.
    boxes = HEAPS["a chain"]
    monkeypatch.setattr(jax.lax, "while_loop", lambda _, __, state: state)
    with backend.building_for(accelerator=True):
        suppress = jax.jit(functools.partial(scoring.non_max_suppression))
        keep = suppress(boxes, np.ones(len(boxes), bool), max_overlap=SETTINGS.max_overlap)
    assert not np.array_equal(np.flatnonzero(keep), np.arange(0, len(boxes), 2))


@pytest.mark.parametrize(("num_boxes", "num_points"), [(0, 0), (0, 9000), (1, 1), (200, 0), (200, 20000)])
def test_points_round_crowded_boxes_are_the_same_in_both_forms(num_boxes, num_points):
    # 200 boxes in the midst of 20,000 points take thousands of blocks more than are looked at together.
    rng = np.random.default_rng(num_boxes)
    boxes = rng.uniform([-3, -3, 1, 1, -4], [3, 3, 12, 3, 4], (200, 5)).astype(np.float32)
    xy, height = rng.uniform(-5, 5, (20000, 2)), rng.uniform(0, 3, 20000)
    priors = [
        np.float32(rng.choice(of_class, 200)) for of_class in ([2.2, 4], [-1, 0.3], [0, 2], [0, 0.5, 1])
    ]
    points = np.float32(xy), np.float32(height), num_points
    cpu, other = parity.in_both_forms(count_points_around, boxes, *priors, num_boxes, *points)
    rows, others = cpu.rows[:num_boxes], other.rows[:num_boxes]
    whole = [0, 2, 3, 4, 5]
    np.testing.assert_array_equal(rows[:, whole], others[:, whole])
    np.testing.assert_allclose(rows[:, [1, 6]], others[:, [1, 6]], atol=1e-5)
    assert (rows[:, 0].sum() > 0) == (num_boxes > 1 and num_points > 0)
