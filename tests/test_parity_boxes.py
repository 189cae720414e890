"""Parity with the reference and OpenCV: hulls, rectangles, the scene's direction, descriptors."""

import dataclasses
import functools
import math
import types

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import parity
import pytest
from native_loops import count_loops

from jaxbox import DetectorConfig, detector, reference
from jaxbox.config import HullConfig
from jaxbox.stages import descriptors, direction, hull, rectangles
from jaxbox.xla import chunks
from jaxbox.xla.loops import map_rows
from jaxbox.xla.ragged import PointLists

SETTINGS = parity.CONFIG.box
CRITERIA = ("area", "variance", "closeness", "visible_closeness")
NUM_SLICES = parity.CONFIG.hull.num_slices
MAX_VERTICES = 128
MAX_FITS = 1024
"""Rows for the clusters of all cases of a kind."""


@parity.PerForm
def find_bounds(*rows):
    return hull.find_bounds(*rows, num_clusters=parity.MAX_CLUSTERS)


@parity.PerForm
def extreme_points(*rows):
    return hull.extreme_points(*rows, *find_bounds(*rows), num_slices=NUM_SLICES)


def trace_hulls(points, valid):
    """Hulls (C, H, 2) of clusters (C, M, 2)."""
    *vertices, count = hull.convex_hulls(*points.T, valid.T, max_vertices=MAX_VERTICES)
    return jnp.array(vertices).T, count


trace = parity.PerForm(trace_hulls)
few_vertices = parity.PerForm(functools.partial(hull.convex_hulls, max_vertices=7))


@parity.PerForm
def convex_hulls(points, valid, num_clusters):
    # In chunks, or the work would be that of all rows.
    return map_rows(lambda rows: trace_hulls(*rows), (points, valid), num_rows=num_clusters, chunk=16)


polygon_area = jax.jit(hull.polygon_area)
try_rotations = parity.PerForm(rectangles.try_rotations)
principal_rotations = parity.PerForm(rectangles.principal_rotations, static_argnums=1)
along_axis = parity.PerForm(rectangles.along_axis, static_argnums=3)
count_votes = parity.PerForm(direction.count_votes)
point_moments = parity.PerForm(descriptors.point_moments)
shape_descriptors = jax.jit(descriptors.shape_descriptors)


def random_clouds(count, size):
    """(count, size, 2) m: discs, lines, rings and L shapes, near and far."""
    rng = np.random.default_rng(0)
    clouds = []
    for number in range(count):
        u, v = rng.uniform(-1, 1, (2, size))
        shape = number % 4
        if shape == 1:
            v = 1e-3 * v
        elif shape == 2:
            u, v = np.cos(np.pi * u), np.sin(np.pi * u)
        elif shape == 3:
            u, v = np.where(v > 0, u, -1), np.where(v > 0, -1, u)
        turn = rng.uniform(0, np.pi)
        xy = np.column_stack(
            [2 * u * np.cos(turn) - v * np.sin(turn), 2 * u * np.sin(turn) + v * np.cos(turn)]
        )
        clouds.append(xy + rng.uniform(-60, 60, 2))
    return np.array(clouds, np.float32)


def opencv_hull(xy):
    """(h, 2) float32 vertices of a set without repeated points."""
    return cv2.convexHull(np.unique(xy, axis=0)).reshape(-1, 2)


def distance_to_outline(points, polygon):
    """(n,) m, from points to the nearest edge of a closed polygon."""
    start, edge = polygon, np.roll(polygon, -1, axis=0) - polygon
    along = np.einsum("nhd,hd->nh", points[:, None] - start, edge) / np.maximum((edge**2).sum(axis=1), 1e-18)
    nearest = start + np.clip(along, 0, 1)[..., None] * edge
    return np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1)


def assert_same_hull(vertices, expected, what):
    """The same vertices, but for those less than 0.1 mm off the line between their neighbours."""
    vertices, expected = vertices.astype(float), expected.astype(float)
    # Rounding drops points less than a nanometre off a line: in areas below a square centimetre it shows.
    scale = max(1e-3 * np.prod(np.ptp(expected, axis=0)), 1e-4)
    area, expected_area = reference.polygon_area(vertices), abs(reference.polygon_area(expected))
    parity.assert_within((area - expected_area) / max(expected_area, scale), 1e-5, f"area {what}")
    ours, theirs = set(map(tuple, vertices)), set(map(tuple, expected))
    for extra, polygon in ((ours - theirs, expected), (theirs - ours, vertices)):
        if extra:
            parity.assert_within(distance_to_outline(np.array(list(extra)), polygon), 1e-4, f"vertex {what}")


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", [3, 10, 128])
def test_hulls_of_random_points_are_those_of_opencv(size):
    clouds = random_clouds(400, size)
    vertices, count = convex_hulls(clouds, np.ones(clouds.shape[:2], bool), len(clouds))
    areas = polygon_area(vertices)
    for xy, ours, num, area in zip(clouds, np.asarray(vertices), np.asarray(count), areas, strict=True):
        assert 3 <= num <= MAX_VERTICES
        assert_same_hull(ours[:num], opencv_hull(xy), "random")
        assert float(area) == pytest.approx(
            reference.polygon_area(ours[:num].astype(float)), rel=1e-4, abs=1e-6
        )


@pytest.mark.usefixtures("platform")
def test_hulls_of_no_point_of_one_and_of_two_are_those_points():
    points = np.array([[[5, 7], [5, 7], [9, 8]]] * 3, np.float32)
    valid = np.array([[False] * 3, [True, True, False], [True] * 3])
    vertices, count = trace(points, valid)
    assert count.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(vertices[0], np.zeros((MAX_VERTICES, 2)))
    np.testing.assert_array_equal(vertices[1], np.full((MAX_VERTICES, 2), [5, 7]))
    np.testing.assert_array_equal(vertices[2, :2], [[5, 7], [9, 8]])


def strict_hull(points):
    """Vertices of the hull of whole numbers (n, 2), from the leftmost and lowest point on; none on an edge.

    Andrew's monotone chain, in whole numbers.
    """
    points = sorted(set(map(tuple, points.tolist())))

    def chain(points):
        kept = []
        for x, y in points:
            while len(kept) > 1:
                (ax, ay), (bx, by) = kept[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                kept.pop()
            kept.append((x, y))
        return kept[:-1]

    return points if len(points) < 2 else chain(points) + chain(points[::-1])


def whole_clusters(size=60):
    """Points of whole numbers (K, size, 2) of every awkward kind, and which are there: all, some, few."""
    rng, k = np.random.default_rng(0), np.arange(size)
    kinds = [
        np.zeros((size, 2)),
        np.stack([k, 0 * k], axis=1),
        np.stack([0 * k, k], axis=1),
        np.stack([k - 7, -k], axis=1),
        np.stack([3 * k, k], axis=1)[::-1],
        np.stack([k % 5, k // 5 % 5], axis=1),
        np.stack([k % 2, k % 3], axis=1),
        np.stack([k, k**2], axis=1),
        np.stack([np.rint(900 * np.cos(k)), np.rint(900 * np.sin(k))], axis=1),
    ]
    kinds += [rng.integers(-reach, reach + 1, (size, 2)) for reach in (1, 2, 3, 9, 50) for _ in range(6)]
    points = np.stack(kinds * 3)
    valid = np.ones(points.shape[:2], bool)
    valid[len(kinds) :] = rng.random(valid[len(kinds) :].shape) < 0.6
    valid[2 * len(kinds) :] &= rng.random(valid[2 * len(kinds) :].shape) < 0.05
    assert {0, 1, 2, 3} < set(valid.sum(axis=1))
    return points.astype(np.int64), valid


@pytest.mark.usefixtures("platform")
def test_hulls_of_whole_numbers_are_exact_and_begin_at_the_leftmost_point():
    points, valid = whole_clusters()
    vertices, num = map(np.asarray, trace(points.astype(np.float32), valid))
    for xy, ours, count in zip(
        [p[v] for p, v in zip(points, valid, strict=True)], vertices, num, strict=True
    ):
        expected = np.array(strict_hull(xy)).reshape(-1, 2)
        assert count == len(expected)
        np.testing.assert_array_equal(ours[:count], expected)
        last = expected[-1] if count else np.zeros(2)
        np.testing.assert_array_equal(ours[count:], np.tile(last, (MAX_VERTICES - count, 1)))


@pytest.mark.usefixtures("platform")
def test_a_hull_beyond_its_capacity_keeps_every_so_many_of_its_vertices():
    points, valid = whole_clusters()
    x, y = points.astype(np.float32).T
    *few, num = few_vertices(x, y, valid.T)
    every, _ = map(np.asarray, trace(points.astype(np.float32), valid))
    assert (np.asarray(num) > 7).sum() > 5
    for k in np.flatnonzero(np.asarray(num) > 7):
        pick = np.arange(7) * int(num[k]) // 7
        np.testing.assert_array_equal(np.array(few)[:, :, k].T, every[k, pick])


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("garbage", [np.nan, np.inf, -np.inf])
def test_what_absent_points_hold_does_not_reach_a_hull(garbage):
    clouds = random_clouds(4, 10)
    valid = np.arange(10) % 3 != 0  # the first point is absent
    expected = trace(clouds[:, valid], np.ones((4, valid.sum()), bool))
    spoilt = np.where(valid[:, None], clouds, np.float32(garbage))
    found = trace(spoilt, np.tile(valid, (4, 1)))
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_hulls_of_clusters_are_those_of_opencv(cases, platform):
    # An accelerator's form takes all rows, of which few hold a cluster: fewer sweeps do.
    for case in cases if platform == "cpu" else cases[::4]:
        points, count = parity.padded_points([case])
        valid = np.arange(points.shape[1]) < count[:, None]
        rows = (parity.pad(values, parity.MAX_CLUSTERS) for values in (points, valid))
        vertices, num = map(np.asarray, convex_hulls(*rows, len(count)))
        for k, proposal in enumerate(case.proposals):
            if count[k] >= 3:
                ours = vertices[k, : num[k]]
                assert_same_hull(ours, opencv_hull(points[k, : count[k]]), "cluster")
                # The reference's own hull, of all the same points.
                expected = reference.convex_hull(proposal.xy)
                assert (
                    abs(reference.polygon_area(ours.astype(float)) - reference.polygon_area(expected)) < 1e-3
                )


@pytest.mark.usefixtures("platform")
def test_extreme_points_lose_at_most_a_slice_of_the_hull(cases):
    for case in cases:
        xy = case.obstacles.xyz[:, :2].astype(np.float32)
        slot = np.where(case.slot < 0, parity.MAX_CLUSTERS, case.slot)
        rows = (
            parity.pad(slot, parity.MAX_OBSTACLES, parity.MAX_CLUSTERS),
            jnp.arange(parity.MAX_OBSTACLES),
            len(xy),
            parity.pad(xy, parity.MAX_OBSTACLES),
        )
        index = np.asarray(extreme_points(*rows)).T
        for k in range(len(case.proposals)):
            kept = index[k][index[k] < len(xy)]
            assert np.all(case.slot[kept] == k)
            members = xy[case.slot == k].astype(float)
            polygon = opencv_hull(xy[kept])
            outside = np.array([cv2.pointPolygonTest(polygon, p, False) < 0 for p in members.tolist()])
            far = distance_to_outline(members, polygon.astype(float))[outside]
            extent = np.ptp(members, axis=0).max()
            bound = extent / NUM_SLICES + extent / 2**11
            parity.assert_within(np.append(far, 0) / bound, 1, "of the bound of a slice")


@pytest.mark.usefixtures("platform")
def test_what_a_list_holds_beyond_its_end_joins_no_cluster():
    rng = np.random.default_rng(0)
    size, num = chunks.HULL_POINTS + 900, chunks.HULL_POINTS + 300
    xy = jnp.asarray(rng.normal(size=(size, 2)), jnp.float32)
    slot = jnp.asarray(rng.integers(0, parity.MAX_CLUSTERS, size))
    row, origin = jnp.arange(size), jnp.zeros((parity.MAX_CLUSTERS, 2))
    whole = 2 * chunks.HULL_POINTS - num
    listed = (
        jnp.pad(slot[:num], (0, whole), constant_values=parity.MAX_CLUSTERS),
        jnp.pad(row[:num], (0, whole)),
    )
    expected = extreme_points(*listed, num, xy)
    np.testing.assert_array_equal(extreme_points(slot, row, num, xy), expected)
    expected = point_moments(*listed, num, xy, origin)
    np.testing.assert_array_equal(point_moments(slot, row, num, xy, origin), expected)
    assert expected[:, 0].sum() == num


@pytest.mark.codegen
def test_a_cpu_describes_clusters_in_native_loops():
    rows = jnp.zeros(900, jnp.int32), jnp.zeros(900, jnp.int32), jnp.int32(9), jnp.zeros((1000, 2))
    assert count_loops(find_bounds.jitted, *rows) == (1, 1)
    assert count_loops(point_moments.jitted, *rows, jnp.zeros((parity.MAX_CLUSTERS, 2))) == (1, 1)


def fits_of(cases):
    points, count = parity.padded_points(cases)
    lists = parity.point_lists(parity.pad(points, MAX_FITS), parity.pad(count, MAX_FITS))
    return points, count, (lists, jnp.arange(MAX_FITS), np.int32(len(count)))


second_peak = parity.PerForm(rectangles.second_peak)


def test_the_second_peak_of_a_curve_is_far_from_the_best_and_nearly_as_good(platform):
    rng = np.random.default_rng(0)
    # Some with one peak, some with two, of which one may be across the end of the quarter turn.
    at, height, width = rng.integers(0, 90, (2, 200)), rng.uniform(0.9, 1, (2, 200)), rng.uniform(3, 12, 200)
    turn = np.abs(np.arange(90)[:, None, None] - at)
    turn = np.minimum(turn, 90 - turn)
    curve = np.max(height * np.exp(-((turn / width) ** 2)), axis=1, initial=1e-3).astype(np.float32)
    num_points = rng.integers(20, 60, 200).astype(np.int32)
    # Too wide over an eighth of a turn, always, or never.
    narrow = np.abs(np.arange(90)[:, None] - rng.integers(0, 90, 200)) > rng.choice([-1, 22, 90], 200)
    max_loss = np.float32(0.03)
    rows = curve, narrow, num_points
    left = np.asarray(second_peak(*rows, max_loss=max_loss))
    each_row = list(zip(curve.T, narrow.T, num_points, strict=True))
    expected = [reference.second_peak(*row, max_loss=max_loss) for row in each_row]
    np.testing.assert_array_equal(left, np.stack(expected, axis=1))
    changed = (left != curve).any(axis=0)
    assert 20 < changed.sum() < 150
    assert (num_points[changed] >= 30).all()
    apart = np.abs(left.argmax(axis=0) - curve.argmax(axis=0))[changed]
    assert (np.minimum(apart, 90 - apart) >= 6).all()
    peaks = np.isfinite(left[:, changed])
    neighbours = np.maximum(np.roll(curve, 1, axis=0), np.roll(curve, -1, axis=0))[:, changed]
    assert (curve[:, changed][peaks] >= neighbours[peaks]).all()
    narrow = narrow | ~narrow.any(axis=0)
    assert narrow[:, changed][peaks].all()
    assert (left.max(axis=0) > np.where(narrow, curve, -np.inf).max(axis=0) - 0.03).all()
    # Where the best rotation is too wide, a peak may be worse by more.
    assert (left.max(axis=0) < curve.max(axis=0) - 0.03).any()
    without = np.asarray(second_peak(*rows, max_loss=np.float32(0)))
    np.testing.assert_array_equal(without, curve)
    same = [reference.second_peak(*row, max_loss=0.0) for row in each_row]
    np.testing.assert_array_equal(np.stack(same, axis=1), curve)


trim_strays = parity.PerForm(rectangles.trim_strays)
STRAYS = dataclasses.replace(SETTINGS, stray_m=0.03, min_stray_points=1)


def trimmed(rows, xy):
    """One rectangle (6,) without strays, of points (n, 2)."""
    table = *np.float32(xy.T)[..., None], np.array([len(xy)], np.int32)
    rows = np.asarray(trim_strays(np.float32(rows)[:, None, None], table, np.float32(STRAYS.stray_m)))
    return rows[:, 0, 0]


def row_of(rectangle):
    """A rectangle of the reference as a row."""
    u0, u1, v0, v1 = rectangle.extents
    return np.array([u0, v0, u1, v1, rectangle.angle, rectangle.score])


@pytest.mark.usefixtures("platform")
def test_edges_without_strays_are_those_of_the_reference(cases):
    points, count, (lists, all_clusters, num) = fits_of(cases)
    rng = np.random.default_rng(0)
    outlines = [xy[:n].astype(float) for xy, n in zip(points, count, strict=True)]
    rotations = reference.fit_rectangles(outlines, SETTINGS)
    no_preference = np.zeros(SETTINGS.num_angles)
    # Two rectangles of each cluster, as the candidates are several.
    turns = rng.integers(0, SETTINGS.num_angles, (2, len(outlines)))
    before = [reference.rectangles_at(index, rotations, no_preference) for index in turns]
    rows = np.zeros((6, 2, MAX_FITS), np.float32)
    rows[..., :num] = np.array([[row_of(each) for each in of_turn] for of_turn in before]).transpose(2, 0, 1)
    ours = trim_strays(rows, lists.table(all_clusters), np.float32(STRAYS.stray_m))[..., :num]
    after = [
        [reference.trim_strays(each, xy, STRAYS) for each, xy in zip(of_turn, outlines, strict=True)]
        for of_turn in before
    ]
    expected = np.array([[row_of(each) for each in of_turn] for of_turn in after]).transpose(2, 0, 1)
    assert (np.abs(expected - rows[..., :num]).max(axis=0) > 0.01).sum() > 100
    # Points .1 mm from the edge may be on it or not.
    off = np.abs(np.asarray(ours) - expected).max(axis=0)
    assert np.mean(off > 1e-4) < 5e-3


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("yaw_deg", [0, 20, 77])
@pytest.mark.parametrize("place", [(12, 3), (-12, 3), (-3, -12), (9, 0)])
def test_only_a_single_point_ahead_of_a_side_that_faces_the_sensor_is_a_stray(yaw_deg, place):
    yaw = np.radians(yaw_deg)
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    sides = np.linspace(-1, 1, 41)
    square = np.concatenate([np.stack([sides, np.full(41, end)], axis=1) for end in (-1, 1)])
    square = np.concatenate([square, square[:, ::-1]])

    def fitted(uv):
        """The rectangle along the axes round the points, as it is and without strays, (2, 2) m each."""
        xy = uv @ axes + place
        along = xy @ axes.T
        rows = np.concatenate([along.min(axis=0), along.max(axis=0), [yaw, 0]])
        ours = trimmed(rows, xy)
        rectangle = reference.Rectangle(rows[[0, 2, 1, 3]], yaw, 0.0)
        np.testing.assert_allclose(ours, row_of(reference.trim_strays(rectangle, xy, STRAYS)), atol=1e-5)
        return rows[:4].reshape(2, 2), ours[:4].reshape(2, 2)

    before, after = fitted(square)
    np.testing.assert_allclose(after, before, atol=1e-5)
    for axis in (0, 1):
        for is_high in (0, 1):
            stray = np.zeros((1, 2))
            stray[0, axis] = 1.4 if is_high else -1.4
            with_stray, without = fitted(np.concatenate([square, stray]))
            is_nearer = np.abs(with_stray[is_high, axis]) < np.abs(with_stray[1 - is_high, axis])
            ahead = np.abs(without - before)
            assert ahead[is_high, axis] == pytest.approx(0.03 if is_nearer else 0.4, abs=1e-4)
            assert np.delete(ahead, 2 * is_high + axis).max() < 1e-4
            # Two of them side by side are no stray.
            _, of_two = fitted(np.concatenate([square, stray, stray + 0.1 * (stray[:, ::-1] != 0)]))
            np.testing.assert_allclose(of_two, with_stray, atol=1e-5)


@pytest.mark.usefixtures("platform")
def test_an_edge_that_all_points_lie_on_stays():
    one, line = np.array([[5.0, 1.0]]), np.array([[5.0, 1.0], [5.0, 2.0]])
    for xy, low_v in ((one, 1), (np.repeat(one, 3, axis=0), 1), (line, 1.97)):
        rows = np.array([5, xy[:, 1].min(), 5, xy[:, 1].max(), 0, 0.5])
        np.testing.assert_allclose(trimmed(rows, xy), [5, low_v, *rows[2:]], atol=1e-6)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("criterion", CRITERIA)
def test_curves_extents_and_best_rectangles_are_those_of_the_reference(cases, criterion):
    config = dataclasses.replace(SETTINGS, criterion=criterion)
    points, count, fits = fits_of(cases)
    curves, extents, _ = try_rotations(*fits, config)
    best = rectangles.best_rectangles(curves, extents, jnp.zeros(SETTINGS.num_angles))
    angle, low, high = (np.asarray(values) for values in (best.angle, best.low, best.high))
    curves, extents = np.asarray(curves).T, np.stack(extents).transpose(2, 1, 0)
    angles = np.round(angle / (math.pi / 2 / SETTINGS.num_angles)).astype(int)
    wrong = worse = 0
    for k in range(len(count)):
        xy = points[k, : count[k]].astype(float)
        expected, bounds = reference.try_rotations(xy, config)
        parity.assert_within(extents[k] - bounds, 3e-5, "m of extents")
        scale = 1 if "closeness" in criterion else max(np.ptp(expected), 0.1)
        wrong += np.sum(np.abs(curves[k] - expected) > 1e-3 * scale)
        worse += expected[angles[k]] < expected.max() - 1e-3 * scale
        best = np.stack([low[k], high[k]], axis=1).reshape(4)
        parity.assert_within(best - bounds[angles[k]], 3e-5, "m of the best extents")
    # Which of two equally near edges faces the sensor, or is nearest to a point, may round either way.
    parity.assert_share(wrong, len(count) * SETTINGS.num_angles, 1e-3, f"curve {criterion}")
    parity.assert_share(worse, len(count), 2e-3, f"best {criterion}")


@pytest.mark.usefixtures("platform")
def test_smallest_area_is_that_of_opencv_within_the_bound_of_the_step(cases):
    points, count, fits = fits_of(cases)
    curve, *_ = try_rotations(*fits, dataclasses.replace(SETTINGS, criterion="area"))
    step = math.pi / 2 / SETTINGS.num_angles
    for k in range(len(count)):
        _, (length, width), _ = reference.min_area_rectangle(points[k, : count[k]])
        area = -float(np.max(curve[:, k]))
        # Turned by half a step off the best, l w grows to at most l w + (l^2 + w^2) / 2 sin(step).
        bound = (length**2 + width**2) / 2 * math.sin(step)
        assert length * width - 1e-3 <= area <= length * width + bound + 1e-3


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("criterion", CRITERIA)
def test_a_cluster_without_points_has_no_extents_and_a_finite_curve(criterion):
    x, y = jnp.array([1.0, 2, 3]), jnp.array([1.0, 1, 2])
    lists = PointLists(x, y, start=jnp.array([0, 3]), total=jnp.array([3, 0]), max_points=16)
    config = dataclasses.replace(SETTINGS, criterion=criterion, num_angles=6)
    curve, extents, principal = try_rotations(lists, jnp.arange(2), jnp.int32(2), config)
    u0, u1, v0, v1 = extents
    assert np.isfinite(curve).all()
    assert principal[1] == 0
    np.testing.assert_array_equal([(u1 - u0)[0, 0], (v1 - v0)[0, 0]], [2, 1])
    np.testing.assert_array_equal(np.stack(extents)[:, :, 1], 0)


@pytest.mark.usefixtures("platform")
def test_principal_rotations_are_those_of_the_reference(cases):
    points, count, fits = fits_of(cases)
    ours = np.asarray(try_rotations(*fits, SETTINGS)[2])
    off = []
    for k in np.flatnonzero(count >= 3):
        xy = points[k, : count[k]].astype(float)
        moments = np.linalg.eigvalsh(np.cov(xy.T))
        # Points as far across as along have no principal axis.
        if moments[0] < 0.8 * moments[1]:
            turn = abs(ours[k] - reference.principal_rotations([xy], SETTINGS.num_angles)[0])
            off.append(min(turn, SETTINGS.num_angles - turn))
    assert len(off) > 100
    assert max(off) <= 1
    # A direction halfway between two rotations may round to either.
    assert np.mean(off) < 5e-3


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("yaw_deg", [0, 1, 33.4, 45, 71, 89, 89.8])
def test_the_principal_rotation_of_what_is_symmetric_is_its_axis(yaw_deg):
    rng = np.random.default_rng(0)
    # A rounded front, both halves alike, somewhere, with more or less noise.
    across = np.linspace(-0.8, 0.8, 60)
    front = np.stack([-0.6 * across**2, across], axis=1)
    yaw = np.radians(yaw_deg)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    for noise_m in (0, 0.02):
        xy = (front + rng.normal(0, noise_m, front.shape)) @ turn.T + [-12, 3]
        table = xy.T[..., None].astype(np.float32), np.array([len(xy)], np.int32)
        rotation = int(principal_rotations((*table[0], table[1]), 90)[0])
        assert abs((rotation - yaw_deg + 45) % 90 - 45) <= (0.51 if noise_m == 0 else 1.5)


def test_many_points_are_tried_along_their_axis_where_it_is_apart_from_the_best_rotation(platform):
    rng = np.random.default_rng(0)
    best, principal, num_points = rng.integers(0, [90, 90, 160], (300, 3)).astype(np.int32).T
    ours = np.asarray(along_axis(best, principal, num_points, 90, np.float32(80)))
    for rotation, *row in zip(ours.tolist(), best, principal, num_points, strict=True):
        curve = -np.abs(np.arange(90.0) - row[0])
        rotations = reference.Rotations(curve, np.zeros((90, 4)), int(row[2]), int(row[1]))
        assert rotation == reference.along_axis(rotations, dataclasses.replace(SETTINGS, min_axis_points=80))
    turn = np.abs(ours - best)
    assert (num_points[ours != best] >= 80).all()
    assert (np.minimum(turn, 90 - turn)[ours != best] >= 5).all()
    assert 80 < (ours != best).sum() < 160


@pytest.mark.usefixtures("platform")
def test_scene_direction_is_that_of_the_reference():
    rng = np.random.default_rng(0)
    for _ in range(50):
        count = rng.integers(0, 12)
        yaw, extent = rng.uniform(-4, 4, count), rng.uniform(0, 9, count)
        num_points, free = rng.integers(5, 400, count), rng.uniform(0, 0.3, count)
        score = rng.uniform(0, 1, count) * rng.integers(0, 2, count)
        least, most = SETTINGS.direction_min_extent_m, SETTINGS.direction_max_free
        voting = (extent >= least) & (free <= most)
        np.testing.assert_array_equal(reference.may_vote(extent, free, SETTINGS), voting)
        expected = reference.count_votes(yaw, extent, num_points, score, voting, SETTINGS)
        rows = (parity.pad(value, 16) for value in (yaw, extent, num_points, score, voting))
        preference = count_votes(*rows, SETTINGS)
        parity.assert_within(preference - expected, 1e-4, "preference")


def test_scene_direction_of_sweeps_is_that_of_the_reference(cases):
    for case in cases:
        fits = [(p, done) for p, done in case.boxes if done is not None]
        yaw = np.array([done.box[4] for _, done in fits])
        extent = np.array([max(done.measured_length_m, done.measured_width_m) for _, done in fits])
        num_points = np.array([len(p.members) for p, _ in fits])
        votes = yaw, extent, num_points, np.ones(len(yaw)), extent >= SETTINGS.direction_min_extent_m
        expected = reference.count_votes(*votes, SETTINGS)
        preference = count_votes(*(parity.pad(value, parity.MAX_CLUSTERS) for value in votes), SETTINGS)
        assert np.argmax(expected) == np.argmax(np.asarray(preference))


@pytest.mark.usefixtures("platform")
def test_descriptors_are_those_of_the_reference(cases):
    for case in cases:
        xy = case.obstacles.xyz[:, :2].astype(np.float32)
        slot = np.where(case.slot < 0, parity.MAX_CLUSTERS, case.slot)
        members = [xy[case.slot == k].astype(float) for k in range(len(case.proposals))]
        hulls = reference.convex_hulls(members)
        expected = [reference.shape_descriptors(m, h) for m, h in zip(members, hulls, strict=True)]
        moments = point_moments(
            parity.pad(slot, parity.MAX_OBSTACLES, parity.MAX_CLUSTERS),
            jnp.arange(parity.MAX_OBSTACLES),
            len(xy),
            parity.pad(xy, parity.MAX_OBSTACLES),
            # Up to a metre next to the middle, as that of a completed box may be.
            parity.pad(np.array([m.mean(axis=0) + 0.7 for m in members]), parity.MAX_CLUSTERS),
        )
        ours = shape_descriptors(
            moments,
            parity.pad(np.array([abs(reference.polygon_area(h)) for h in hulls]), parity.MAX_CLUSTERS),
            parity.pad(np.array([len(h) for h in hulls]), parity.MAX_CLUSTERS),
        )
        ours, count = parity.on_host(ours), len(members)
        moments = np.array([e.moment_of_inertia for e in expected])
        parity.assert_within(ours.moment_of_inertia[:count] - moments, 1e-4, "m^2 of moments")
        for name in ("density", "complexity"):
            values = np.array([getattr(e, name) for e in expected])
            np.testing.assert_allclose(getattr(ours, name)[:count], values, rtol=1e-5)
        values = np.array([e.eccentricity for e in expected])
        wide = moments[:, 1] > 1e-3
        np.testing.assert_allclose(ours.eccentricity[:count][wide], values[wide], rtol=1e-2)
        assert wide.sum() > 10
        assert np.all(ours.eccentricity[count:] == 1)


def test_descriptors_of_a_rectangle_a_point_and_none_are_those_worked_by_hand():
    # Sums of 1, x, y, x^2, y^2 and x y of the corners (+-2, +-1), of one point, then of nothing, next to what
    # an earlier cluster of that row left behind.
    moments = jnp.array([[4.0, 0, 0, 16, 4, 0], [1.0, 3, 0, 9, 0, 0], [0.0, 0, 0, 0, 0, 0]])
    found = shape_descriptors(moments, jnp.array([8.0, 0.0, 8.0]), jnp.array([4, 1, 4]))
    np.testing.assert_allclose(found.moment_of_inertia, [[4, 1], [0, 0], [0, 0]])
    np.testing.assert_allclose(found.eccentricity, [2, 1, 1])
    np.testing.assert_allclose(found.density, [0.5, 0, 0])
    np.testing.assert_allclose(found.complexity, [1, 1, 0])


@pytest.mark.usefixtures("platform")
def test_a_hull_beyond_its_capacity_is_fitted_to_by_its_own_vertices():
    config = dataclasses.replace(DetectorConfig.paper(), hull=HullConfig(max_vertices=4))
    angle = np.arange(40) * (2 * np.pi / 40)
    disc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    away = np.array([10, 0])
    xy = jnp.float32(np.concatenate([disc + away, disc - away]))
    obstacles = types.SimpleNamespace(xy=xy, height=jnp.ones(len(xy)), count=jnp.int32(len(xy)))
    clusters = types.SimpleNamespace(
        of_point=jnp.repeat(jnp.arange(2), 40)[None],
        fitted=jnp.ones((1, 80), bool),
        num_points=jnp.array([40, 40]),
        num=jnp.int32(2),
        low=jnp.array([[9.0, -1], [-11, -1]]),
        high=jnp.array([[11.0, 1], [-9, 1]]),
    )
    outlines, _ = jax.jit(lambda: detector.fit_rectangles(obstacles, clusters, config))()
    assert int(outlines.hull_vertices) == 40
    assert outlines.points.count.tolist() == [4, 4]
    x, _, _ = outlines.points.table(jnp.arange(2))
    assert (x[:, 0] > 8).all()
    assert (x[:, 1] < -8).all()
