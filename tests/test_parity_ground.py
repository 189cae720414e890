"""Parity with the reference: filter, ground plane, ground surface, heights; each on equal inputs."""

import dataclasses

import jax
import numpy as np
import parity
import pytest

from jaxbox import reference, synthetic
from jaxbox.config import RegionConfig
from jaxbox.evaluation.corruptions import mirror_in_road, reflect_below_road
from jaxbox.stages import _sheets, _support, filtering, ground
from jaxbox.synthetic.terrain import SENSOR_HEIGHT_M

GROUND = parity.CONFIG.ground
MAX_CANDIDATES = 3200

filter_outliers = parity.PerForm(filtering.filter_outliers)
cell_minima = jax.jit(ground.cell_minima)
fit_ground_plane = parity.PerForm(ground.fit_ground_plane)
fit_ground_surface = jax.jit(ground.fit_ground_surface)
on_sheets = jax.jit(_sheets.on_sheets)
planes_through_windows = jax.jit(_sheets.planes_through_windows)
least_supported = jax.jit(_support.least_supported, static_argnums=(3, 4))
levels_with_area = jax.jit(_support.levels_with_area, static_argnums=1)
in_pits = jax.jit(_support.in_pits)
height_above_ground = jax.jit(ground.height_above_ground)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("changes", [{}, {"num_std": 1.5, "min_density": 3.0, "bandwidth_m": 0.7}])
def test_filter_keeps_the_points_that_the_reference_keeps(cases, changes):
    config = dataclasses.replace(parity.CONFIG.filtering, **changes)
    for case in cases:
        expected = reference.filter_outliers(case.xyz, config, parity.CONFIG.region)
        xyz1 = np.pad(case.xyz, ((0, 0), (0, 1)), constant_values=1)
        keep = np.asarray(filter_outliers(parity.pad(xyz1, parity.CAPACITY), config, parity.CONFIG.region))
        assert 0 < (~expected).sum() < len(expected) / 3
        assert not keep[len(case.xyz) :].any()
        # A centroid, or a distance, on the very edge of a cell, or of the threshold, may round either way.
        differ = keep[: len(case.xyz)] != expected
        parity.assert_share(differ.sum(), len(expected), 1e-4, f"inliers {changes}")


def test_cell_minima_are_those_of_the_reference(cases):
    for case in cases:
        mask = parity.pad(case.inlier, parity.CAPACITY)
        candidates, occupied = cell_minima(parity.pad(case.xyz, parity.CAPACITY), mask, GROUND)
        candidates, occupied = np.asarray(candidates), np.asarray(occupied)
        # Both go through the cells in row-major order; a point on the edge of a cell may round into either.
        np.testing.assert_array_equal(candidates[occupied][:, :2], case.candidates[:, :2])
        differ = candidates[occupied][:, 2] != case.candidates[:, 2]
        parity.assert_share(differ.sum(), len(differ), 2e-3, "cell minima")


@pytest.mark.parametrize("levels", [_support.SENSOR_LEVELS, _support.PLANE_LEVELS], ids=["sensor", "plane"])
@pytest.mark.parametrize("changes", [{}, {"min_support_share": 0.25, "min_support_points": 9.0}])
def test_ground_has_the_support_that_the_reference_asks_for(cases, changes, levels):
    config, halves_m = dataclasses.replace(GROUND, **changes), np.array([40.0, 20.0])
    for case in cases:
        xyz = case.xyz[(np.abs(case.xyz[:, :2]) < halves_m).all(axis=1)]
        expected = reference.least_supported(xyz[:, 2], xyz[:, :2], halves_m, levels, config)
        padded, mask = parity.pad(xyz, parity.CAPACITY), parity.padded_mask(len(xyz), parity.CAPACITY)
        least = least_supported(padded[:, 2], padded[:, :2], mask, tuple(halves_m), levels, config)
        assert np.unique(expected).size > 3
        np.testing.assert_allclose(np.asarray(least)[: len(xyz)], expected, atol=1e-6)


def judged_cells(lowest, config):
    """Row, column and level of the cells that are not empty, and whether the reference, and jaxbox with it,
    takes their level for ground."""
    num_squares = 80
    expected = reference.levels_with_area(lowest, 80.0, config)
    levels = np.asarray(levels_with_area(lowest, 80.0, config))
    levels = levels.reshape(-1, num_squares + 1, num_squares + 1)[:, :num_squares, :num_squares]
    # A height on the border of a level may round into either.
    parity.assert_share(np.sum(np.moveaxis(levels, 0, 2) != expected), expected.size, 1e-4, "levels")
    row, column = np.nonzero(np.isfinite(lowest))
    level = np.floor(10 * lowest[row, column]).astype(int).clip(-13, 10)
    return row, column, level, expected[row // 4, column // 4, level + 13]


@pytest.mark.parametrize("share", [1.0, 3.0])
def test_levels_deep_below_the_plane_have_the_area_that_the_reference_asks_for(cases, share):
    config = dataclasses.replace(GROUND, min_deep_ratio=share)
    of_road, of_strays = [], []
    for case in cases:
        lowest = np.full((320, 320), np.inf, np.float32)
        cell = np.floor((case.xyz[:, :2] + 80) / 0.5).astype(int).clip(0, 319)
        # As if the plane lay .5 m above the road.
        np.minimum.at(lowest, tuple(cell.T), case.height - np.float32(0.5))
        _, _, level, may_be_ground = judged_cells(lowest, config)
        of_road.append(may_be_ground[(level == -6) | (level == -5)])
        of_strays.append(may_be_ground[level < -8])
    assert np.mean(np.concatenate(of_road)) > 0.9
    assert np.mean(np.concatenate(of_strays)) < 0.95


@pytest.mark.parametrize("ratio", [GROUND.min_low_ratio, 1.5])
def test_levels_at_the_plane_have_the_area_that_the_reference_asks_for(cases, ratio):
    config = dataclasses.replace(GROUND, min_low_ratio=ratio)
    of_road, of_strays = [], []
    for case in cases:
        lowest = np.full((320, 320), np.inf, np.float32)
        cell = np.floor((case.xyz[:, :2] + 80) / 0.5).astype(int).clip(0, 319)
        # As if the plane lay .15 m below the road, and one in 100 points .3 m.
        is_stray = np.random.default_rng(0).random(len(cell)) < 0.01
        height = case.height + np.where(is_stray, -0.15, 0.15).astype(np.float32)
        np.minimum.at(lowest, tuple(cell.T), height)
        row, column, level, may_be_ground = judged_cells(lowest, config)
        # Farther away the real ground lies as much lower.
        is_near = np.hypot(row - 160, column - 160) < 40
        of_road.append(may_be_ground[is_near & (level == 1)])
        of_strays.append(may_be_ground[is_near & (level >= -3) & (level < 0)])
    assert np.mean(np.concatenate(of_road)) > 0.9
    assert np.mean(np.concatenate(of_strays)) < 0.5


def test_few_returns_below_the_road_do_not_move_the_ground():
    sweep = synthetic.make_sweep(5, num_azimuths=1000)
    # Support alone: that low levels are lowest in few cells, or in pits, would do, too.
    config = dataclasses.replace(GROUND, min_deep_ratio=0.0, min_low_ratio=0.0, min_pit_neighbours=9.0)
    far = np.hypot(*sweep.xyz[:, :2].T) > 3
    mask, plane = far, np.array([[0, 0, -SENSOR_HEIGHT_M]], np.float32)
    xyz, _ = reflect_below_road(sweep.xyz, sweep.intensity, 0.01, np.random.default_rng(0))
    square = np.abs(np.mgrid[-79.5:80, -79.5:80]).max(axis=0) < 20
    surfaces = {}
    for share in (0.0, config.min_support_share):
        some = dataclasses.replace(config, min_support_share=share, min_support_points=40 * share)
        surfaces[share] = np.asarray(fit_ground_surface(xyz, mask, plane, some))[square]
    clean = np.asarray(fit_ground_surface(sweep.xyz, mask, plane, config))[square]
    errors = {share: np.abs(surface - clean).mean() for share, surface in surfaces.items()}
    assert errors[config.min_support_share] < 0.02 < 0.2 < errors[0.0], errors


def test_mirror_images_in_a_wet_road_do_not_move_the_ground_below_cars():
    sweep = synthetic.make_sweep(5, num_azimuths=1000)
    far = np.hypot(*sweep.xyz[:, :2].T) > 3
    plane = np.array([[0, 0, -SENSOR_HEIGHT_M]], np.float32)
    xyz, _ = mirror_in_road(sweep.xyz, sweep.intensity, 0.06, np.random.default_rng(0))
    error_m = {}
    for share in (0.0, GROUND.min_deep_ratio):
        config = dataclasses.replace(GROUND, min_deep_ratio=share)
        surface = fit_ground_surface(xyz, far, plane, config)
        error_m[share] = np.abs(ground.surface_height(surface, sweep.boxes.center[:, :2], config)).max()
    assert error_m[GROUND.min_deep_ratio] < 0.08 < 0.5 < error_m[0.0], error_m


@pytest.mark.parametrize("seed", [5, 6])
def test_returns_at_a_plane_below_the_road_do_not_move_the_ground_below_cars(seed):
    sweep = synthetic.make_sweep(seed, num_azimuths=1000)
    far = np.hypot(*sweep.xyz[:, :2].T) > 3
    plane = np.array([[0, 0, -SENSOR_HEIGHT_M - 0.2]], np.float32)
    xyz, _ = reflect_below_road(sweep.xyz, sweep.intensity, 0.06, np.random.default_rng(0))
    error_m = {}
    for ratio in (0.0, GROUND.min_low_ratio):
        config = dataclasses.replace(GROUND, min_low_ratio=ratio, min_pit_neighbours=9.0)
        clean, below = (
            np.asarray(
                ground.surface_height(
                    fit_ground_surface(points, far, plane, config), sweep.boxes.center[:, :2], config
                )
            )
            for points in (sweep.xyz, xyz)
        )
        error_m[ratio] = np.abs(below - clean).mean()
    assert 3 * error_m[GROUND.min_low_ratio] < error_m[0.0], error_m
    assert error_m[GROUND.min_low_ratio] < 0.01, error_m


def test_pits_are_those_of_the_reference(cases):
    rng, num_pits = np.random.default_rng(0), 0
    for case in cases:
        lowest = np.full((320, 320), np.inf, np.float32)
        cell = np.floor((case.xyz[:, :2] + 80) / 0.5).astype(int).clip(0, 319)
        is_stray = rng.random(len(cell)) < 0.01
        depth_m = rng.uniform(0.2, 0.8, len(cell))
        np.minimum.at(lowest, tuple(cell.T), case.height - np.where(is_stray, depth_m, 0).astype(np.float32))
        expected = reference.in_pits(lowest, GROUND)
        np.testing.assert_array_equal(in_pits(lowest, GROUND), expected)
        assert not expected[np.isinf(lowest)].any()
        num_pits += expected.sum()
    assert num_pits > 20 * len(cases)


def test_single_low_cells_are_pits_and_trenches_hollows_and_the_road_beside_things_are_not():
    rng = np.random.default_rng(1)
    lowest = rng.uniform(-0.03, 0.03, (60, 60)).astype(np.float32)
    single = np.zeros(lowest.shape, bool)
    single[2:18:4, 2::4] = True
    lowest[single] -= 0.25
    lowest[20] -= 0.25
    lowest[24:26, 10:12] -= 0.25
    lowest[40:58] += 1
    lowest[42:56:4, 2::4] -= 1
    np.testing.assert_array_equal(in_pits(lowest, GROUND), single)
    # With two neighbours nothing is known.
    lowest[1:19][~single[1:19]] = np.inf
    lowest[2:18:4, 3::4], lowest[2:18:4, 1::4] = 0, 0
    assert not in_pits(lowest, GROUND).any()


def test_single_low_cells_do_not_move_the_ground():
    rng = np.random.default_rng(2)
    road = np.column_stack([rng.uniform(-20, 20, (40_000, 2)), rng.normal(-1.7, 0.01, 40_000)])
    # Five points in the middle of one cell in twelve support each other.
    middle = np.mgrid[-19.75:20, -19.75:20].reshape(2, -1).T[::3]
    low = np.repeat(np.pad(middle, ((0, 0), (0, 1)), constant_values=-1.95), 5, axis=0)
    xyz, plane = np.concatenate([road, low]).astype(np.float32), np.array([[0, 0, -1.7]], np.float32)
    error_m = {}
    for num in (9.0, GROUND.min_pit_neighbours):
        config = dataclasses.replace(GROUND, min_support_share=0, min_low_ratio=0, min_pit_neighbours=num)
        surface = fit_ground_surface(xyz, np.ones(len(xyz), bool), plane, config)
        error_m[num] = np.abs(np.asarray(surface))[62:98, 62:98].mean()
    assert error_m[GROUND.min_pit_neighbours] < 0.03 < 0.1 < error_m[9.0], error_m


@pytest.mark.parametrize("seed", [5, 6])
def test_a_road_deep_below_the_plane_is_ground_all_the_same(seed):
    sweep = synthetic.make_sweep(seed, num_azimuths=1000)
    rho = np.hypot(*sweep.xyz[:, :2].T)
    plane = np.array([[0, 0, 0.45 - SENSOR_HEIGHT_M]], np.float32)
    surface = fit_ground_surface(sweep.xyz, rho > 3, plane, GROUND)
    center = sweep.boxes.center[:, :2]
    # Nearer than 8 m a road so deep is none of this plane's; where it is seldom seen it is filled in.
    center = center[(np.hypot(*center.T) > 10) & (np.hypot(*center.T) < 30)]
    height = np.asarray(ground.surface_height(surface, center, GROUND))
    parity.assert_within(height + 0.45, 0.05, "m between the road and the ground below cars")


@pytest.mark.usefixtures("platform")
def test_planes_of_different_draws_agree_where_one_has_decisive_support(cases):
    decisive = []
    for number, case in enumerate(cases):
        plane = fit_ground_plane(
            parity.pad(case.candidates, MAX_CANDIDATES),
            parity.padded_mask(len(case.candidates), MAX_CANDIDATES),
            jax.random.key(number),
            GROUND,
        )
        ours, theirs = np.asarray(plane.coefficients, float), case.plane.astype(float)
        support, their_support = (
            np.sum(np.abs(case.candidates @ [-a, -b, 1.0] - c) < GROUND.tolerance_m)
            for a, b, c in (ours, theirs)
        )
        assert plane.found
        # Counted again in float64: no more than rounding at the tolerance.
        assert abs(int(plane.num_inliers) - support) <= 1
        # Where a kerb parts two levels either may win, but neither by much.
        parity.assert_within(support / their_support - 1, 0.35, "support of the planes")
        if min(support, their_support) > 0.7 * len(case.candidates):
            near = case.candidates[np.hypot(*case.candidates[:, :2].T) < 20]
            decisive.append(np.abs((near * [1, 1, 0] + [0, 0, 1]) @ (ours - theirs)).max())
    # Decisive where the street has one level; the real ones have banks, tracks and pavements.
    if case.name.startswith("seed"):
        assert len(decisive) >= parity.NUM_SEEDS / 4
        parity.assert_within(decisive, 1e-3, "m between decisive planes, within 20 m")


def test_sheets_are_those_of_the_reference(cases):
    judged = 0
    for case in cases:
        rng = np.random.default_rng(0)
        cell = np.floor((case.xyz[case.inlier, :2] + 80) / 0.5).astype(int).clip(0, 319)
        lowest = np.full((320, 320), np.inf, np.float32)
        np.minimum.at(lowest, tuple(cell.T), case.height[case.inlier])
        # Fewer returns, and a ramp to one side, whose steepness passes the limit.
        lowest[rng.random(lowest.shape) < 0.1] = np.inf
        lowest += (np.arange(320, dtype=np.float32) / 320)[:, None] ** 4 * 30
        ours, expected = (
            np.asarray(on_sheets(lowest, GROUND)),
            reference.on_sheets(lowest.astype(float), GROUND),
        )
        judged += expected.sum()
        # A window on the edge of a limit may round to either side of it: that is four cells.
        parity.assert_share((ours != expected).sum(), expected.sum(), 5e-3, "cells on sheets")
    assert judged > 400 * len(cases)


def test_windows_without_a_plane_say_so():
    square = np.full((12, 12), np.inf, np.float32)
    square[2, 2:9], square[9, 9] = 0.5, 0.3
    for module, compiled in (
        (reference, reference.planes_through_windows),
        (_sheets, planes_through_windows),
    ):
        num, level, rise, rms = map(np.asarray, compiled(square))
        assert num.max() == 5, module
        assert (level == 0).all()
        assert np.isinf(rise).all()
        assert np.isfinite(rms).all()


# Gaussians of the default reach as far as the band of their matrix, the wider ones beyond it.
@pytest.mark.parametrize(("wider", "num_planes"), [(0.5, 1), (1, 1), (2, 1), (1, 2)])
def test_surface_is_that_of_the_reference_on_the_same_planes(cases, wider, num_planes):
    config = dataclasses.replace(GROUND, smoothing_m=wider * GROUND.smoothing_m)
    for case in cases:
        xyz = parity.pad(case.xyz, parity.CAPACITY)
        mask = parity.pad(case.inlier, parity.CAPACITY)
        planes = np.stack([case.plane, case.plane + np.float32([0.01, 0, 0.8])])[:num_planes]
        surface = np.asarray(fit_ground_surface(xyz, mask, planes, config))
        inliers = case.xyz[case.inlier].astype(float)
        expected = reference.fit_ground_surface(inliers, planes, config)
        # A point on the edge of a cell may round into either: that moves the ground a little, round about.
        differ = np.abs(surface - expected)
        parity.assert_share(np.sum(differ > 2e-5), differ.size, 0.01, "surface")
        parity.assert_within(differ, 2e-2, "m between the surfaces")
        assert np.ptp(expected) > 0.01


def test_heights_are_those_of_the_reference_on_one_plane_and_on_two(cases):
    for case in cases:
        xyz = case.xyz.astype(float)
        for planes in (case.plane[None], np.stack([case.plane, case.plane + np.float32([0.01, 0, 0.8])])):
            expected = reference.height_above_ground(xyz, planes, case.surface, GROUND)
            height = height_above_ground(parity.pad(case.xyz, parity.CAPACITY), planes, case.surface, GROUND)
            differ = np.asarray(height)[: len(xyz)] - expected
            # 6e-5 on the border of the grid only: the compiled stage stops a thousandth of a cell short.
            parity.assert_within(differ, 6e-5, f"m of heights over {len(planes)} planes")


def test_what_rounding_puts_past_the_last_cell_is_no_minimum_of_another():
    xyz = np.tile(np.array([[2.1, 0, -9]], np.float32), (8, 1))
    config = dataclasses.replace(GROUND, candidate_half_x_m=2.2, candidate_half_y_m=2.2)
    _, occupied = jax.jit(lambda *points: ground.cell_minima(*points, config))(xyz, np.ones(8, bool))
    assert not occupied.any()


def crowds():
    """Point sets of every awkward kind, (n, 3) m."""
    rng = np.random.default_rng(0)
    some = rng.normal(0, [9, 9, 0.3], (400, 3))
    on_a_line = np.linspace(0, 1, 50)[:, None] * [7.0, 3, 0.2]
    return {
        "none": np.zeros((0, 3)),
        "one": some[:1],
        "two": some[:2],
        "on a line": on_a_line,
        "on a wall": on_a_line + rng.uniform(0, 3, (50, 1)) * [0, 0, 1],
        "all in one place": np.tile(some[:1], (60, 1)),
        "beyond the border": some * [9, 9, 1],
        "many": some,
        "two levels": np.concatenate([some * [1, 1, 0], some * [1, 1, 0] + [0, 0, 1]]),
    }


CROWDS = crowds()


# As many as do not fill the last batch of a CPU, and one alone.
@pytest.mark.parametrize(("num_hypotheses", "num_refits"), [(33, 2), (1, 0)])
@pytest.mark.parametrize("crowd", CROWDS)
def test_the_plane_is_the_same_in_both_forms(crowd, num_hypotheses, num_refits):
    xyz = CROWDS[crowd]
    config = dataclasses.replace(
        GROUND, num_hypotheses=num_hypotheses, num_refits=num_refits, min_inlier_fraction=0.02
    )
    points = parity.pad(xyz, 1024), parity.padded_mask(len(xyz), 1024)
    for seed in range(3):
        plane, other = parity.in_both_forms(fit_ground_plane, *points, jax.random.key(seed), config)
        assert (plane.found, plane.num_inliers) == (other.found, other.num_inliers)
        np.testing.assert_allclose(plane.coefficients, other.coefficients, rtol=0, atol=1e-5)
        assert plane.found or crowd not in ("many", "two levels") or num_hypotheses == 1


@pytest.mark.parametrize("crowd", CROWDS)
def test_the_filter_keeps_the_same_points_in_both_forms(crowd):
    xyz = CROWDS[crowd]
    region = RegionConfig(half_x_m=16.0, half_y_m=12.0)
    xyz1 = parity.pad(np.pad(xyz, ((0, 0), (0, 1)), constant_values=1), 1024)
    keep, other = parity.in_both_forms(filter_outliers, xyz1, parity.CONFIG.filtering, region)
    np.testing.assert_array_equal(keep, other)
    assert not keep[len(xyz) :].any()
    assert keep.any() == (len(xyz) > 2)
