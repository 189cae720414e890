"""Laws of the reference: each stage against a hand calculation, a brute-force loop or another library."""

import dataclasses
import functools
import importlib
import inspect
import itertools
import pathlib
import pkgutil
import re

import cv2
import numpy as np
import pytest
from scipy import sparse, spatial

from jaxbox import reference, stages
from jaxbox.config import (
    BoxConfig,
    ClusteringConfig,
    CompletionConfig,
    ComponentMap,
    DetectorConfig,
    EvidenceConfig,
    FilterConfig,
    GroundConfig,
    RegionConfig,
    VehicleConfig,
)
from jaxbox.types import NUM_POINT_COUNTS, Counts, Label

SENSOR_HEIGHT_M = 1.73
CAR = VehicleConfig().classes[Label.CAR]
SQUARE = RegionConfig(half_x_m=20.0, half_y_m=20.0)
FILTER = FilterConfig(num_std=4.0)
GROUND, BOX, EVIDENCE = GroundConfig(), BoxConfig(), EvidenceConfig()
COMPLETION, SCORE = CompletionConfig(), VehicleConfig()
AROUND = VehicleConfig(margin_m=0.1, ring_m=0.5, upper_height_m=0.9, top_quantile=0.0)
LOW_CAR = dataclasses.replace(CAR, count_max_height_m=2.0, recess_m=0.3)


def turned(xy, yaw):
    return xy @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])


def moved(box, *, x=0.0, length=0.0, width=0.0):
    return np.add(box, [x, 0, length, width, 0])


def lidar_sweep(boxes, *, noise_m=0.01, seed=0):
    """A 64-beam sweep of flat ground and upright boxes (x, y, length, width, yaw, height), from the
    ground or from a seventh number on."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-60, 60, 0.2)), np.radians(np.linspace(-24.9, 2, 64))
    )
    ray = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    ray = ray.reshape(3, -1).T
    distance = np.where(ray[:, 2] < 0, SENSOR_HEIGHT_M / np.maximum(-ray[:, 2], 1e-9), np.inf)
    for x, y, length, width, yaw, height, *above in boxes:
        start = np.append(turned(np.array([-x, -y]), -yaw), 0.0)
        local = np.column_stack([turned(ray[:, :2], -yaw), ray[:, 2]])
        low = np.array([-length / 2, -width / 2, sum(above) - SENSOR_HEIGHT_M])
        high = np.array([length / 2, width / 2, height - SENSOR_HEIGHT_M])
        sides = np.stack([(low - start) / local, (high - start) / local])
        entry, leave = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
        distance = np.where((entry < leave) & (entry > 0), np.minimum(distance, entry), distance)
    seen = distance < 70
    return (distance[seen] + rng.normal(0, noise_m, seen.sum()))[:, None] * ray[seen]


# ---------------------------------------------------------------- filtering


def test_filter_keeps_dense_points_and_drops_the_lone_one():
    dense = np.random.default_rng(0).normal(0, 0.3, (200, 3))
    inlier = reference.filter_outliers(np.vstack([dense, [[15.5, 15.5, 0.5]]]), FILTER, SQUARE)
    assert inlier[:200].all()
    assert not inlier[200]


@pytest.mark.parametrize("offset", list(itertools.product((0, 1), repeat=3)))
def test_window_weight_is_the_gaussian_of_the_cells_between(offset):
    pair = np.array([[0.5, 0.5, 0.5], np.array([0.5, 0.5, 0.5]) + offset])
    weight = 1 + np.exp(-0.5) ** sum(offset)
    for shift, expected in ((-1e-9, True), (1e-9, False)):
        inlier = reference.filter_outliers(
            pair, dataclasses.replace(FILTER, min_density=weight + shift, num_std=1e9), SQUARE
        )
        assert inlier.tolist() == [expected, expected]


def test_one_mean_shift_step_reaches_the_centroid_of_the_window():
    # 9 points in one cell and one at the far corner of the next: only that one is far from its centroid.
    xyz = np.vstack([np.full((9, 3), 0.1), [[1.9, 0.1, 0.1]]])
    w = np.exp(-0.5)
    distance = np.array([*[1.8 * w / (9 + w)] * 9, 1.8 * 9 * w / (9 * w + 1)])
    t = (distance[9] - distance.mean()) / distance.std()
    for shift, expected in ((1e-6, True), (-1e-6, False)):
        config = dataclasses.replace(FILTER, num_iterations=1, num_std=t + shift)
        assert reference.filter_outliers(xyz, config, SQUARE)[9] == expected


def test_selection_counts_nan_as_not_finite_and_the_border_as_outside():
    xyz = np.array(
        [[0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0], [80, 0, 0], [0, -59.9, 99], [0, 0, 1e30]], np.float32
    )
    sweep = reference.select_points(xyz, FILTER, RegionConfig(half_x_m=80.0, half_y_m=60.0))
    assert sweep.finite.tolist() == [True, False, False, True, True, True]
    assert sweep.in_region.tolist() == [True, False, False, False, True, False]
    # Points alone in their windows are outliers.
    assert not sweep.inlier.any()


# ---------------------------------------------------------------- ground


@pytest.mark.parametrize("seed", range(5))
def test_ransac_recovers_a_tilted_plane_among_a_third_of_clutter(seed):
    rng = np.random.default_rng(seed)
    truth = np.array([0.05, -0.03, -1.7])
    xy = rng.uniform(-30, 30, (600, 2))
    z = xy @ truth[:2] + truth[2] + rng.normal(0, 0.02, 600)
    z[:200] += rng.uniform(0.5, 3, 200)
    plane, found, count = reference.fit_ground_plane(np.column_stack([xy, z]), GROUND, rng=rng)
    assert found
    assert count == 400
    assert (np.abs(plane - truth) < [3e-4, 3e-4, 5e-3]).all()


@pytest.mark.parametrize("slope", [0.3, 50.0])
def test_no_ground_is_found_on_a_slope_steeper_than_the_gate(slope):
    xy = np.random.default_rng(0).uniform(-5, 5, (300, 2))
    z = slope * xy[:, 0]
    plane, found, _ = reference.fit_ground_plane(
        np.column_stack([xy, z]), GROUND, rng=np.random.default_rng(0)
    )
    assert not found
    np.testing.assert_array_equal(plane, [0, 0, z.min()])


@pytest.mark.parametrize("points", [[], [[1, 2, -3]], [[1, 2, -3], [4, 5, 6]], [[1, 1, -3]] * 5])
def test_too_few_or_repeated_candidates_give_a_level_plane_at_the_lowest(points):
    candidates = np.array(points, float).reshape(-1, 3)
    plane, found, _ = reference.fit_ground_plane(candidates, GROUND, rng=np.random.default_rng(0))
    assert not found
    assert plane.tolist() == [0, 0, -3 if len(points) else 0]


def test_repeated_ransac_finds_both_levels_and_points_stand_on_the_one_below_them():
    rng = np.random.default_rng(1)
    xy = rng.uniform(-20, 20, (500, 2))
    z = np.where(np.arange(500) < 300, -1.7, -0.7)
    config = dataclasses.replace(GROUND, max_planes=3)
    fits = reference.fit_ground_planes(np.column_stack([xy, z]), config, rng=rng)
    planes = np.array([plane for plane, _, _ in fits])
    np.testing.assert_allclose(planes[:, 2], [-1.7, -0.7], atol=1e-9)
    probes = np.array([[0, 0, -1.0], [0, 0, -0.8], [0, 0, 0.5], [0, 0, -5]])
    elevation = reference.plane_elevation(probes, planes, tolerance_m=0.2)
    np.testing.assert_allclose(elevation, [-1.7, -0.7, -0.7, -1.7], atol=1e-9)
    height = reference.height_above_planes(probes, planes, tolerance_m=0.2)
    np.testing.assert_allclose(height, [0.7, -0.1, 1.2, -3.3], atol=1e-9)


def test_obstacles_are_the_inliers_between_both_heights_in_order_up_to_the_capacity():
    height = np.array([0.2, 0.21, np.nan, 4.5, 4.49, 1.0, 2.0])
    xyz = np.column_stack([np.arange(7.0), np.zeros(7), height])
    inlier = np.array([True, True, False, True, True, False, True])
    sweep = reference.Sweep(xyz, np.ones(7, bool), np.ones(7, bool), inlier)
    ground = reference.Ground(np.zeros((1, 3)), True, 9, None, height)
    obstacles = reference.gather_obstacles(sweep, ground, DetectorConfig())
    assert (obstacles.row.tolist(), obstacles.count) == ([1, 4, 6], 3)
    clustering = dataclasses.replace(DetectorConfig().clustering, max_obstacles=2)
    few = dataclasses.replace(DetectorConfig(), clustering=clustering)
    obstacles = reference.gather_obstacles(sweep, ground, few)
    assert (obstacles.row.tolist(), obstacles.count) == ([1, 4], 3)


def test_cell_minima_match_a_loop_over_the_cells():
    xyz = np.random.default_rng(2).uniform([-50, -30, -2], [50, 30, 2], (3000, 3))
    lowest = {}
    for x, y, z in xyz[(np.abs(xyz[:, 0]) < 40) & (np.abs(xyz[:, 1]) < 20)]:
        cell = (np.floor(x) + 0.5, np.floor(y) + 0.5)
        lowest[cell] = min(z, lowest.get(cell, np.inf))
    expected = np.array([(*cell, z) for cell, z in sorted(lowest.items())])
    alone = dataclasses.replace(GROUND, min_support_share=0, min_support_points=0)
    np.testing.assert_allclose(reference.cell_minima(xyz, alone), expected)


def test_surface_of_a_flat_ground_is_the_plane_and_follows_a_gentle_rise():
    rng = np.random.default_rng(3)
    xy = rng.uniform(-40, 40, (60000, 2))
    rise = np.clip((xy[:, 0] - 10) * 0.03, 0, 0.4)
    plane = np.array([0.01, 0.02, -1.7])
    for deviation, tolerance in ((np.zeros(len(xy)), 1e-9), (rise, 0.05)):
        xyz = np.column_stack([xy, xy @ plane[:2] + plane[2] + deviation])
        grid = reference.fit_ground_surface(xyz, plane, GROUND)
        height = reference.height_above_ground(xyz, plane, grid, GROUND)
        inner = (np.abs(xy) < 35).all(axis=1) & (np.hypot(*xy.T) > 5)
        assert np.abs(height[inner]).max() < tolerance


def test_envelope_keeps_a_steep_block_out_of_the_ground():
    xy = np.random.default_rng(4).uniform(-30, 30, (60000, 2))
    block = (np.abs(xy - [12, 0]) < 1).all(axis=1)
    xyz = np.column_stack([xy, np.where(block, -0.9, -1.7)])
    plane = np.array([0.0, 0.0, -1.7])
    grid = reference.fit_ground_surface(xyz, plane, GROUND)
    height = reference.height_above_ground(xyz, plane, grid, GROUND)
    assert height[block].min() > 0.75


@pytest.mark.parametrize("grade", [0.1, 0.2])
def test_a_ramp_is_ground_and_a_car_on_it_is_not(grade):
    xy = np.random.default_rng(5).uniform(-30, 30, (60000, 2))
    # A car with its road about it out of sight on the far side.
    is_car = (np.abs(xy - [16, 0]) < [2, 0.8]).all(axis=1)
    hidden = (np.abs(xy - [17, 2]) < [2, 1.2]).all(axis=1) & ~is_car
    rise = np.maximum(xy[:, 0] - 6, 0) * grade
    xyz = np.column_stack([xy, rise - 1.7 + np.where(is_car, 0.9, 0)])[~hidden]
    is_car, plane = is_car[~hidden], np.array([0.0, 0.0, -1.7])
    inner = (np.abs(xyz[:, :2]) < 17).all(axis=1) & (np.hypot(*xyz[:, :2].T) > 5)
    for config, found in ((GROUND, 0.97), (dataclasses.replace(GROUND, sheet_tolerance_m=0.0), 0.0)):
        grid = reference.fit_ground_surface(xyz, plane, config)
        height = reference.height_above_ground(xyz, plane, grid, config)
        on_ramp = inner & ~is_car & (xyz[:, 0] > 12)
        assert (np.abs(height[on_ramp]) < config.min_height_m).mean() >= found
        assert height[is_car].min() > 0.6
    assert (np.abs(height[on_ramp]) < config.min_height_m).mean() < 0.5


def test_surface_is_bilinear_between_cell_centres_and_constant_beyond_the_border():
    centers = np.arange(8) - 3.5
    grid = 2 * centers[:, None] + 3 * centers[None, :]
    xy = np.array([[0.2, 0.9], [-3.5, 3.5], [100, -100]])
    # The grid's squares are of 2 x 2 cells.
    config = dataclasses.replace(GROUND, surface_cell_m=0.5, surface_half_m=4.0)
    deviation = reference.surface_height(grid, xy, config)
    np.testing.assert_allclose(deviation, [3.1, 3.5, -3.5])


# ---------------------------------------------------------------- clusters


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("shape", [(30, 20), (12, 10, 6)])
def test_components_match_a_flood_fill_from_each_cell_in_row_major_order(shape, seed):
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, shape, (np.prod(shape) // 6, len(shape)))
    occupied = {tuple(cell) for cell in cells.tolist()}
    expected, count = {}, 0
    for start in sorted(occupied):
        stack = [] if start in expected else [start]
        while stack:
            cell = stack.pop()
            if cell in occupied and cell not in expected:
                expected[cell] = count
                steps = itertools.product((-1, 0, 1), repeat=len(shape))
                stack += [tuple(np.add(cell, step).tolist()) for step in steps]
        count = max(expected.values()) + 1
    component = reference.label_components(cells, shape)
    assert component.tolist() == [expected[tuple(cell)] for cell in cells.tolist()]


@pytest.mark.parametrize("seed", range(5))
def test_algorithm_two_matches_the_components_of_the_radius_graph(seed):
    xyz = np.random.default_rng(seed).uniform(0, 10, (300, 3))
    graph = spatial.distance.squareform(spatial.distance.pdist(xyz)) <= 1.2
    count, expected = sparse.csgraph.connected_components(graph)
    cluster = reference.euclidean_clusters(xyz, radius_m=1.2)
    assert 1 < count == cluster.max() + 1
    assert cluster.tolist() == expected.tolist()


def test_points_linked_within_one_cell_edge_share_a_grid_component():
    xy = np.random.default_rng(0).uniform(-10, 10, (800, 2))
    cluster = reference.euclidean_clusters(xy, radius_m=0.5)
    region = RegionConfig(half_x_m=10.0, half_y_m=10.0)
    cells, shape = reference.find_cells(xy, np.zeros(800), ComponentMap(cell_m=0.5), region)
    component = reference.label_components(cells, shape)
    assert cluster.max() > component.max() > 0
    for index in range(cluster.max() + 1):
        assert len(set(component[cluster == index])) == 1


def test_levels_of_a_three_dimensional_map_part_what_is_stacked():
    xy, height = np.zeros((3, 2)), np.array([0.3, 0.7, 3.9])
    region = RegionConfig(half_x_m=4.0, half_y_m=4.0)
    flat, flat_shape = reference.find_cells(xy, height, ComponentMap(cell_m=0.4, num_levels=1), region)
    tall, tall_shape = reference.find_cells(xy, height, ComponentMap(cell_m=0.4, num_levels=8), region)
    assert reference.label_components(flat, flat_shape).tolist() == [0, 0, 0]
    assert tall[:, 2].tolist() == [0, 1, 7]
    assert reference.label_components(tall, tall_shape).tolist() == [0, 0, 1]


def test_warp_keeps_directions_and_near_points_and_grows_the_linking_distance_linearly():
    direction = np.array([np.cos(0.7), np.sin(0.7)])
    rho = np.array([0.0, 5.0, 20.0, 40.0, 70.0])
    warped = reference.compress_range(rho[:, None] * direction, start_m=20.0, growth=0.02)
    np.testing.assert_allclose(warped[:3], rho[:3, None] * direction)
    np.testing.assert_allclose(np.arctan2(warped[1:, 1], warped[1:, 0]), 0.7)
    step = 1e-4
    near, far = (
        np.hypot(*reference.compress_range((rho[3:] + s)[:, None] * direction, start_m=20.0, growth=0.02).T)
        for s in (0, step)
    )
    np.testing.assert_allclose(step / (far - near), 1 + 0.02 * (rho[3:] - 20), rtol=1e-4)
    assert reference.compress_range(warped, start_m=20.0, growth=0.0) is warped


def test_size_gates_keep_their_limits_and_number_what_is_left_in_order():
    component = np.repeat([0, 1, 2, 3, 4], [3, 8, 8, 9, 8])
    xy = np.zeros((36, 2))
    xy[3, 1], xy[11, 0], xy[19], xy[28] = 12.0, 12.5, (0.6, 0.8), (0.6, 0.7)
    config = ClusteringConfig(min_points=8, max_extent_m=12.0)
    slot, count = reference.select_clusters(xy, component, config, min_extent_m=1.0)
    assert count == 2
    assert slot.tolist() == [-1] * 3 + [0] * 8 + [-1] * 8 + [1] * 9 + [-1] * 8


# ---------------------------------------------------------------- hull, rectangle, descriptors


@pytest.mark.parametrize("seed", range(5))
def test_hull_is_counter_clockwise_and_that_of_qhull(seed):
    xy = np.random.default_rng(seed).normal(0, 3, (100, 2)).astype(np.float32)
    hull = reference.convex_hull(xy)
    expected = spatial.ConvexHull(xy)
    assert reference.polygon_area(hull) == pytest.approx(expected.volume)
    assert {tuple(v) for v in hull.tolist()} == {
        tuple(v) for v in xy[expected.vertices].astype(float).tolist()
    }


@pytest.mark.parametrize("points", [[], [[1, 2]], [[1, 2]] * 4, [[0, 0], [1, 1], [2, 2], [3, 3]]])
def test_hull_and_descriptors_of_degenerate_points_are_finite(points):
    xy = np.array(points, float).reshape(-1, 2)
    hull = reference.convex_hull(xy)
    descriptors = reference.shape_descriptors(xy, hull)
    assert len(hull) <= 2
    assert descriptors.density == 0
    assert descriptors.eccentricity >= 1
    assert np.isfinite(
        [*descriptors.moment_of_inertia, descriptors.eccentricity, descriptors.complexity]
    ).all()


@pytest.mark.parametrize("yaw", [-1.5, -0.4, 0.3, 1.2])
def test_min_area_rectangle_recovers_a_turned_rectangle(yaw):
    corners = np.array([[2.0, 0.8], [-2.0, 0.8], [-2.0, -0.8], [2.0, -0.8]])
    center, size, found_yaw = reference.min_area_rectangle(np.add(turned(corners, yaw), [20, -7]))
    np.testing.assert_allclose(center, [20, -7], atol=1e-5)
    np.testing.assert_allclose(size, [4.0, 1.6], atol=1e-5)
    assert found_yaw == pytest.approx(yaw, abs=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_area_curve_reaches_rotating_calipers_within_the_bound_of_its_step(seed):
    xy = np.add(turned(np.random.default_rng(seed).uniform([-2, -1], [2, 1], (60, 2)), seed), [15, 4])
    curve, extents = reference.try_rotations(xy, BoxConfig(criterion="area"))
    _, (length, width), _ = reference.min_area_rectangle(xy)
    half_step = np.radians(0.5)
    bound = (length + width * half_step) * (width + length * half_step)
    assert length * width - 1e-4 <= -curve.max() <= bound
    np.testing.assert_allclose(-curve, (extents[:, 1] - extents[:, 0]) * (extents[:, 3] - extents[:, 2]))


def slow_criterion(xy, criterion, angle, min_distance):
    cos, sin = np.cos(angle), np.sin(angle)
    uv = [(x * cos + y * sin, -x * sin + y * cos) for x, y in xy]
    edges = [(min(c), max(c)) for c in zip(*uv, strict=True)]
    distances = [[min(abs(c - e) for e in edges[k]) for k, c in enumerate(point)] for point in uv]
    if criterion == "variance":
        groups = [[d[0] for d in distances if d[0] < d[1]], [d[1] for d in distances if d[1] <= d[0]]]
        return -sum(np.var(group) for group in groups if group)
    if criterion == "visible_closeness":
        faces = [min(e, key=abs) for e in edges]
        distances = [[abs(c - f) for c, f in zip(point, faces, strict=True)] for point in uv]
    return np.mean([min_distance / max(min(d), min_distance) for d in distances])


@pytest.mark.parametrize("criterion", ["variance", "closeness", "visible_closeness"])
def test_the_curve_of_every_criterion_matches_a_loop_over_points_and_angles(criterion):
    xy = np.add(turned(np.random.default_rng(5).uniform([-2, -1], [2, 1], (40, 2)), 0.4), [-9, 6])
    curve, _ = reference.try_rotations(xy, BoxConfig(criterion=criterion, num_angles=18))
    expected = [slow_criterion(xy, criterion, np.radians(5 * i), 0.05) for i in range(18)]
    np.testing.assert_allclose(curve, expected, atol=1e-12)


@pytest.mark.parametrize("criterion", ["area", "variance", "closeness", "visible_closeness"])
def test_every_criterion_finds_the_angle_of_a_corner_facing_the_sensor(criterion):
    along = np.column_stack([np.linspace(0, 4, 41), np.zeros(41)])
    across = np.column_stack([np.zeros(17), np.linspace(0, 1.6, 17)])
    xy = np.add(turned(np.vstack([along, across]), np.radians(27)), [10, 8])
    curve, _ = reference.try_rotations(xy, BoxConfig(criterion=criterion))
    assert np.argmax(curve) == 27


def test_unknown_criterion_is_refused_by_name():
    with pytest.raises(ValueError, match="criterion is 'perimeter'; it must be area"):
        reference.try_rotations(np.ones((3, 2)), BoxConfig(criterion="perimeter"))


def test_fit_points_are_the_slab_or_all_and_of_many_those_of_the_lowest_ranks():
    members = np.arange(100, 120)
    xyz = np.zeros((200, 3))
    xyz[members, :2] = 10 * directions(np.arange(0.5, 20) / 652)
    height = np.zeros(200)
    height[104:] = 0.5
    rule = functools.partial(BoxConfig, slab_min_height_m=0.2, slab_max_height_m=0.8, min_slab_points=5)
    many, few = rule(max_points=99), rule(max_points=5)
    assert reference.fit_points(members, xyz, height, many).tolist() == list(range(104, 120))
    assert reference.fit_points(members[:8], xyz, height, many).tolist() == list(range(100, 108))
    # 16 of 20 are in the slab.
    for share, chosen in ((0.8, range(104, 120)), (0.81, range(100, 120))):
        config = rule(max_points=99, min_slab_share=share)
        assert reference.fit_points(members, xyz, height, config).tolist() == list(chosen)
    # Multiples of the golden ratio, modulo 1, below 4 / 16.
    golden = np.arange(20) * (5**0.5 - 1) / 2 % 1
    lowest = [100 + i for i in range(4, 20) if golden[i] < 4 / 16]
    assert reference.fit_points(members, xyz, height, few).tolist() == lowest
    assert len(lowest) == 4


def directions(azimuth):
    return np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)


@pytest.mark.parametrize("cells_apart", [0.25, 0.5, 1, 1.94, 2, 3, 3.75, 4, 5])
@pytest.mark.parametrize("num_points", [256, 1024])
def test_points_of_the_lowest_ranks_are_about_as_many_as_asked_for_and_spread_over_all(
    cells_apart, num_points
):
    azimuth = np.arange(num_points // 4) * cells_apart / 652 + 0.3
    z = np.repeat([-0.7, -0.5, -0.3, -0.1], len(azimuth))
    xyz = np.column_stack([np.tile(10 * directions(azimuth), (4, 1)), z])
    chosen = reference.sampling_rank(xyz) < reference.sampled_share(num_points, 160)
    assert 90 <= chosen.sum() <= 144
    assert chosen.reshape(4, 4, -1).sum(axis=(0, 2)).min() >= 16


@pytest.mark.parametrize("yaw", [0.0, 0.5, 2.0])
def test_descriptors_of_a_filled_rectangle_are_those_of_the_textbook(yaw):
    grid = np.stack(np.meshgrid(np.linspace(-2, 2, 401), np.linspace(-0.5, 0.5, 101)), -1).reshape(-1, 2)
    xy = turned(grid, yaw)
    descriptors = reference.shape_descriptors(xy, reference.convex_hull(xy[[0, 400, -401, -1]]))
    np.testing.assert_allclose(descriptors.moment_of_inertia, [16 / 12, 1 / 12], rtol=0.03)
    assert descriptors.eccentricity == pytest.approx(4, rel=0.02)
    assert descriptors.density == pytest.approx(len(xy) / 4, rel=1e-6)
    assert descriptors.complexity == 4 / len(xy)


# ---------------------------------------------------------------- evidence


def even_ground(xyz):
    return np.full(len(xyz), -SENSOR_HEIGHT_M)


def test_one_beam_to_the_ground_frees_the_cells_where_it_is_between_the_heights():
    xyz = np.array([[20.1, 0.0, -SENSOR_HEIGHT_M]])
    evidence = reference.build_evidence(xyz, np.zeros(1), SENSOR_HEIGHT_M, even_ground, EVIDENCE)
    free = np.diff(evidence.free_sums, axis=1) > 0
    start, end = (20.1 * (SENSOR_HEIGHT_M - h) / SENSOR_HEIGHT_M for h in (0.8, 0.35))
    wholly = [k for k in range(320) if k * 0.25 >= start and (k + 1) * 0.25 <= end]
    azimuth, cells = np.nonzero(free)
    assert set(azimuth) == {720}
    assert cells.tolist() == wholly
    assert evidence.hit_sums.max() == 0


def test_over_a_dip_a_beam_is_as_high_as_over_its_bottom_and_over_a_hill_as_on_even_ground():
    # The road falls by 1 m between 10 and 20 m, where the beam would be between the heights, and rises again.
    def dip(xyz):
        return -SENSOR_HEIGHT_M - ((xyz[:, 0] > 10) & (xyz[:, 0] < 20))

    xyz = np.array([[20.1, 0.0, -SENSOR_HEIGHT_M]])
    free = [
        reference.build_evidence(xyz, np.zeros(1), SENSOR_HEIGHT_M, ground, EVIDENCE).free_sums
        for ground in (even_ground, dip, lambda xyz: even_ground(xyz) + 1)
    ]
    assert np.any(free[0])
    assert not np.any(free[1])
    # A hill, which may be an obstacle taken for ground, does not bring the free space nearer.
    np.testing.assert_array_equal(free[2], free[0])


def test_a_beam_that_ends_between_the_heights_is_free_up_to_the_gap_and_hits():
    xyz = np.array([[0.0, 12.6, -1.23]])
    evidence = reference.build_evidence(xyz, np.array([0.5]), SENSOR_HEIGHT_M, even_ground, EVIDENCE)
    _, cells = np.nonzero(np.diff(evidence.free_sums, axis=1))
    assert cells.min() == int(12.6 * 0.93 / 1.23 / 0.25) + 1
    assert cells.max() == int((12.6 - 0.3) / 0.25) - 1
    azimuth, hit = np.nonzero(np.diff(evidence.hit_sums, axis=1))
    assert (azimuth.tolist(), hit.tolist()) == ([1080], [50])


def wall_evidence():
    """A wall 10 m ahead, 4 m wide, with ground up to 40 m elsewhere."""
    xyz = lidar_sweep([(10.1, 0.0, 0.2, 4.0, 0.0, 3.0)], noise_m=0.0)
    height = xyz[:, 2] + SENSOR_HEIGHT_M
    return reference.build_evidence(xyz, height, SENSOR_HEIGHT_M, even_ground, EVIDENCE)


def test_boxes_at_before_and_behind_a_wall_and_in_the_open_are_hit_free_hidden_and_free():
    boxes = np.array([[11.0, 0, 2, 3, 0], [12.0, 12, 3, 2, 0.3], [25.0, 0, 3.9, 1.6, 0.2]])
    rays = reference.cast_rays(wall_evidence(), boxes, num_rays=48)
    np.testing.assert_allclose(rays.hit, [1, 0, 0])
    np.testing.assert_allclose(rays.open, rays.free)
    # Rays over the corners of a box are too short to cover a whole range cell.
    assert rays.free[1] > 0.7
    np.testing.assert_allclose(rays.free + rays.occluded, [0, 1, 1])
    np.testing.assert_allclose(rays.free_length > 0.9, [False, True, False])
    assert rays.free_length[2] == 0
    deep = reference.cast_rays(wall_evidence(), np.array([[8.5, 0, 4.0, 2.0, 0]]), num_rays=48)
    assert deep.hit[0] == 0
    assert deep.free_length[0] > 0.4


def test_ray_shares_sum_to_one_and_a_mirrored_sweep_gives_mirrored_shares():
    rng = np.random.default_rng(7)
    xyz = rng.uniform([-40, -40, -1.7], [40, 40, 0], (4000, 3))
    boxes = np.column_stack(
        [rng.uniform(5, 35, 50), rng.uniform(-30, 30, 50), rng.uniform(1, 5, (50, 2)), rng.uniform(-3, 3, 50)]
    )
    shares = []
    for sign in (1, -1):
        height = xyz[:, 2] + SENSOR_HEIGHT_M
        evidence = reference.build_evidence(
            xyz * [1, sign, 1], height, SENSOR_HEIGHT_M, even_ground, EVIDENCE
        )
        rays = reference.cast_rays(evidence, boxes * [1, sign, 1, 1, sign], num_rays=33)
        shares.append([rays.hit, rays.free, rays.occluded, rays.deep, rays.free_length, rays.open])
        assert (rays.free <= rays.open).all()
    np.testing.assert_allclose(np.sum(shares[0][:4], axis=0), 1)
    # The middle ray of a box may fall on the border of two azimuth cells: one ray of 33.
    np.testing.assert_allclose(shares[0], shares[1], atol=1.01 / 33)
    assert np.std(shares[0], axis=1).min() > 0.01


def test_beams_below_a_body_leave_its_rays_hit_and_open_and_a_wall_leaves_them_closed():
    azimuth = np.linspace(-0.1, 0.1, 200)
    face, behind = (
        np.column_stack([rho * np.cos(azimuth), rho * np.sin(azimuth), np.full(200, height)])
        for rho, height in ((10.0, 1.0), (14.0, 0.0))
    )
    box = np.array([[11.3, 0.0, 2.6, 1.6, 0.0]])
    # Rays through the sides leave the box before a whole cell of it is free.
    for xyz, least, most in ((face, 0.0, 0.0), (np.concatenate([face, behind]), 0.8, 1.0)):
        height = xyz[:, 2]
        evidence = reference.build_evidence(
            xyz - [0, 0, SENSOR_HEIGHT_M], height, SENSOR_HEIGHT_M, even_ground, EVIDENCE
        )
        rays = reference.cast_rays(evidence, box, num_rays=16)
        assert (rays.hit[0], rays.free[0]) == (1, 0)
        assert least <= rays.open[0] <= most


def test_the_share_of_hit_rays_is_the_share_of_the_span_that_holds_returns():
    box = np.array([[-12.0, 0.4, 4.0, 1.6, 0.5]])
    corners = turned(np.array([[2, 0.8], [-2, 0.8], [-2, -0.8], [2, -0.8]]), 0.5) + box[0, :2]
    # The box lies across the cut of the azimuths: measured from -x there is none.
    span = np.arctan2(-corners[:, 1], -corners[:, 0])
    middle = np.arctan2(-0.4, 12.0)
    azimuth = np.pi + np.linspace(middle, span.max(), 2000)
    faces = [rho * np.array([np.cos(azimuth), np.sin(azimuth)]) for rho in np.arange(9.5, 14.5, 0.1)]
    xy = np.concatenate(faces, axis=1).T
    xyz = np.column_stack([xy, np.full(len(xy), 0.6)])
    evidence = reference.build_evidence(xyz, xyz[:, 2], 0.0, lambda xyz: np.zeros(len(xyz)), EVIDENCE)
    share = (span.max() - middle) / np.ptp(span)
    assert abs(share - 0.5) > 0.02
    rays = reference.cast_rays(evidence, box, num_rays=400)
    assert rays.hit[0] == pytest.approx(share, abs=0.015)


def test_without_evidence_every_ray_counts_as_hit():
    cluster = reference.Cluster(np.arange(50), 0.2, 1.5)
    box = reference.CompletedBox(np.array([10.0, 0, 3.9, 1.63, 0]), np.inf, 3.9, 1.63)
    completed = reference.Completed([reference.ClassHypothesis(0, Label.CAR)], [box], 1)
    config = DetectorConfig.paper()
    nothing = reference.index_obstacles(np.zeros((0, 3)), np.zeros(0), np.zeros(0, int))
    (candidate,) = reference.score_boxes(completed, None, lambda *_: np.inf, [cluster], nothing, config)
    around = reference.cluster_alone(50, 1.5)
    found = {"hit": 1.0, "free_length": 0.0}
    expected = reference.score_box(box, CAR, around=around, num_points=50, **found, config=config.vehicles)
    assert candidate.score == expected > 0


# ---------------------------------------------------------------- completion


@pytest.mark.parametrize("sign", [1, -1])
def test_extents_grow_away_from_the_sensor_towards_it_or_both_ways(sign):
    low, high = sorted((5.0 * sign, 7.0 * sign))
    assert reference.extend((low, high), 4.0) == ((7.0 * sign, 5.0 * sign, 6.0 * sign), 4.0)
    assert reference.extend((low, high), 1.0) == ((6.0 * sign,) * 3, 2.0)
    (away, _, _), length = reference.extend((5.0 * sign, 5.0 * sign), 4.0)
    assert (away, length) == (7.0 * sign, 4.0)


def test_a_side_that_may_be_hidden_has_the_usual_size_and_one_seen_whole_nears_the_measured():
    prior = dataclasses.replace(CAR, length_m=4.0, whole_from_m=4.0)
    rule = dataclasses.replace(COMPLETION, length_margin_m=0.3, seen_length=0.7, seen_weight=0.8)

    def likely_length(measured_m, config=rule):
        sides = reference.Assignment((0.0, measured_m), (3.0, 4.0), 0.0)
        return reference.likely_sizes(sides, prior, config)[0]

    sizes = [likely_length(m) for m in (0.0, 2.8, 3.0, 3.7, 5.0)]
    np.testing.assert_allclose(sizes, [4, 4, 4 - 0.8 * 0.7, 4, 5.04])
    measured = np.linspace(0, 8, 50)
    assert all(likely_length(m) >= m for m in measured)
    unweighed = [likely_length(m, dataclasses.replace(rule, seen_weight=0.0)) for m in measured]
    np.testing.assert_allclose(unweighed, np.maximum(measured, 4))


def test_where_lengths_differ_a_vehicle_may_be_as_long_as_it_is_seen():
    prior = dataclasses.replace(CAR, length_m=8.0, whole_from_m=4.0, max_length_m=18.0)
    rule = dataclasses.replace(COMPLETION, length_margin_m=0.3, seen_length=0.7, seen_weight=0.8)

    def lengths(measured_m):
        sides = reference.Assignment((3.0, 3.0 + measured_m), (3.0, 4.0), 0.0)
        judged = reference.place_widths(sides, prior)
        assert np.ptp(judged[:, 2]) == 0
        return judged[0, 2], reference.likely_sizes(sides, prior, rule)[0]

    # Between 4 and 4.4 m it goes from hidden in part to seen whole.
    for measured_m, judged, answered in ((3.9, 8, 8), (4.2, 6.1, 8 - 0.4 * 3.5), (5, 5, 8 - 0.8 * 2.7)):
        np.testing.assert_allclose(lengths(measured_m), (judged, answered))
    np.testing.assert_allclose(lengths(9.0)[0], 9)
    usual = dataclasses.replace(prior, whole_from_m=8.0)
    sides = reference.Assignment((3.0, 9.0), (3.0, 4.0), 0.0)
    assert reference.place_widths(sides, usual)[0, 2] == 8


def test_a_width_has_limits_of_its_own():
    prior = dataclasses.replace(CAR, width_m=2.0)
    rule = dataclasses.replace(COMPLETION, width_margin_m=0.1, seen_width=0.8, seen_weight=0.5)
    widths = [
        reference.likely_sizes(reference.Assignment((5.0, 6.0), (3.0, 3.0 + m), 0.0), prior, rule)[1]
        for m in (1.6, 1.7, 2.4)
    ]
    np.testing.assert_allclose(widths, [2, 2 - 0.5 * 0.2, 2.4])


def complete(xy, *, mode, evidence=None, angle_deg=0, prior=CAR, **changes):
    curve, extents = reference.try_rotations(xy, BOX)
    rectangle = reference.Rectangle(extents[angle_deg], np.radians(angle_deg), curve[angle_deg])
    config = dataclasses.replace(COMPLETION, mode=mode, **changes)
    return reference.complete_box(xy, [rectangle], prior, evidence, config)


def test_away_keeps_the_visible_faces_and_extends_the_hidden_ones_to_the_prior():
    rear_and_side = np.array([[10.0, 3.0], [10.0, 4.2], [12.5, 3.0]])
    completed = complete(rear_and_side, mode="away")
    np.testing.assert_allclose(completed.box, [10 + 3.9 / 2, 3 + 1.63 / 2, 3.9, 1.63, 0])
    assert (completed.measured_length_m, completed.measured_width_m) == pytest.approx((2.5, 1.2))


@pytest.mark.parametrize("long_axis", [0, 1])
def test_none_is_the_rectangle_as_measured_with_the_longer_side_as_length(long_axis):
    xy = np.array([[10.0, 3.0], [10.0, 4.2], [12.5, 3.0]])[:, :: 1 - 2 * long_axis]
    completed = complete(xy, mode="none")
    np.testing.assert_allclose(completed.box[2:4], [2.5, 1.2])
    np.testing.assert_allclose(completed.box[:2], (xy.min(axis=0) + xy.max(axis=0)) / 2)
    assert completed.box[4] == pytest.approx(long_axis * np.pi / 2)


def test_a_cluster_larger_than_the_class_is_no_box():
    for mode in ("none", "away", "evidence"):
        xy = np.array([[10.0, -4.0], [10.0, 4.0], [17.0, 0.0]])
        assert complete(xy, mode=mode, evidence=wall_evidence()) is None


def test_evidence_turns_a_rear_face_into_a_car_that_points_away_from_the_sensor():
    xyz = lidar_sweep([(14.0, 2.0, 3.9, 1.6, 0.0, 1.5)], noise_m=0.0)
    height = xyz[:, 2] + SENSOR_HEIGHT_M
    evidence = reference.build_evidence(xyz, height, SENSOR_HEIGHT_M, even_ground, EVIDENCE)
    rear = xyz[(height > 0.2) & (height < 0.8) & (np.abs(xyz[:, 0] - 12.05) < 0.02), :2]
    completed = complete(rear, mode="evidence", evidence=evidence)
    np.testing.assert_allclose(completed.box[:2], [14.0, 2.0], atol=0.1)
    assert np.cos(completed.box[4]) ** 2 == pytest.approx(1)
    assert completed.objective > 2.4


def test_the_chosen_hypothesis_has_the_objective_that_its_parts_add_up_to():
    xyz = lidar_sweep([(14.0, 2.0, 3.9, 1.2, 0.4, 1.5), (9.0, 2.9, 0.3, 1.0, 0.0, 1.0)])
    height = xyz[:, 2] + SENSOR_HEIGHT_M
    evidence = reference.build_evidence(xyz, height, SENSOR_HEIGHT_M, even_ground, EVIDENCE)
    xy = xyz[(height > 0.2) & (height < 0.8) & (xyz[:, 0] > 10), :2]
    curve, _ = reference.try_rotations(xy, BOX)
    weights = {"free_weight": 0.7, "free_length_weight": 3.0, "inside_weight": 0.4, "near_weight": 0.9}
    prior = dataclasses.replace(CAR, length_m=6.0, whole_from_m=6.0, width_m=2.2)
    boxes = {}
    for cost in (-9.0, 9.0):
        changes = weights | {"closeness_weight": 1.3, "not_away_cost": cost}
        completed = complete(xy, mode="evidence", evidence=evidence, angle_deg=23, prior=prior, **changes)
        rays = reference.cast_rays(evidence, completed.box[None], num_rays=COMPLETION.num_rays)
        inside, near = agreement_parts(completed.box[None], xy)
        parts = (
            rays.hit - 0.7 * rays.free - 3 * rays.free_length + 0.4 * inside + 0.9 * near + 1.3 * curve[23]
        )
        assert completed.objective == pytest.approx(parts[0] - min(cost, 0))
        assert min(rays.hit[0], rays.free[0], rays.free_length[0]) > 0
        boxes[cost] = completed.box
    # A high cost leaves only the placement that grows away from the sensor, a gain only the others.
    assert np.hypot(*boxes[9.0][:2]) > np.hypot(*boxes[-9.0][:2]) + 0.05


def agreement_parts(boxes, xy):
    """Share of the points inside, and their mean closeness to the visible faces."""
    weights = ({"inside_weight": 1.0, "near_weight": 0.0}, {"inside_weight": 0.0, "near_weight": 1.0})
    return [reference.point_agreement(boxes, xy, dataclasses.replace(COMPLETION, **w)) for w in weights]


def test_points_on_the_visible_faces_agree_fully_and_points_behind_agree_less():
    box = np.array([[10.0, 5.0, 4.0, 2.0, 0.0]])
    faces = np.array([[8.0, 4.5], [8.0, 5.5], [9.0, 4.0], [11.0, 4.0]])
    inside, near = agreement_parts(box, faces)
    assert (inside[0], near[0]) == (1, 1)
    inside, near = agreement_parts(box, np.array([[11.5, 5.5], [13.0, 9.0]]))
    assert inside[0] == 0.5
    assert near[0] == pytest.approx(0.1 / 1.5 / 2)


def test_scene_direction_is_the_heavier_vote_modulo_a_quarter_turn():
    config = BoxConfig(
        direction_sigma_deg=3.0, direction_min_extent_m=2.2, direction_max_free=0.15, direction_weight=0.2
    )

    def vote(yaw_deg, extent, points, free, score=1.0):
        voting, score = reference.may_vote(extent, free, config), np.full(len(extent), score)
        return reference.count_votes(np.radians(yaw_deg), extent, points, score, voting, config)

    yaw_deg, extent, points = np.array([20, 110, -70, 50, 51, 52]), np.full(6, 4.0), np.full(6, 100)
    free = np.array([0, 0, 0, 0, 0.5, 0.5])
    assert np.argmax(vote(yaw_deg, extent, points, free)) == 20
    assert np.argmax(vote(yaw_deg, extent, points * [1, 0, 0, 9, 1, 1], free)) == 50
    assert np.argmax(vote(yaw_deg, extent, points, free, score=[0.1, 0.1, 0.1, 0.9, 1, 1])) == 50
    assert not vote(yaw_deg, extent * 0.5, points, free).any()
    assert not vote(yaw_deg, extent, points, free, score=0.0).any()
    gain = vote(np.array([89]), np.full(1, 4.0), np.full(1, 100), np.zeros(1))
    np.testing.assert_allclose(gain[[89, 0, 86]], 0.2 * np.exp([0, -1 / 9, -1]))


# ---------------------------------------------------------------- vehicles


def obstacles_of(xyz, height):
    return reference.index_obstacles(xyz, height, np.arange(len(xyz)))


def test_points_round_a_box_are_shared_out_by_margin_ring_and_height():
    box = np.array([10.0, 0.0, 4.0, 2.0, np.pi / 2])
    xyz = np.array(
        [[10, 0, 0], [11.05, 0, 0], [11.2, 0, 0], [10, 2.4, 0], [11.6, 0, 0], [10, 0, 0], [10, 1, 0.0]]
    )
    height = np.array([1.0, 1.4, 1.0, 0.5, 1.0, 2.5, 4.4])
    around = reference.count_points_around(box, LOW_CAR, obstacles_of(xyz, height), AROUND)
    # Those from 4.5 m on are not obstacles, see above.
    assert (around.num_inside, around.top, around.num_above, around.num_ring) == (2, 1.4, 2, 2)


def test_the_ring_of_a_long_vehicle_reaches_farther_past_its_ends_but_not_its_sides():
    # From the middle of the side neither end is hidden.
    box = np.array([0.0, 10.0, 8.0, 2.0, 0.0])
    xyz = np.array([[0, 10, 0], [6.4, 10.5, 0], [-6.4, 8.6, 0], [6.6, 10, 0], [0, 11.6, 0.0]])
    for past_ends_m, num_ring in ((0, 0), (2, 2)):
        prior = dataclasses.replace(LOW_CAR, past_ends_m=past_ends_m)
        around = reference.count_points_around(box, prior, obstacles_of(xyz, np.ones(5)), AROUND)
        assert (around.num_inside, around.num_ring) == (1, num_ring)


def test_what_overhangs_the_visible_end_of_a_long_vehicle_is_its_own():
    box = np.array([10.0, 2.0, 8.0, 2.0, 0.0])
    xyz = np.array([[10, 2, 0], [5.65, 2, 0], [5.31, 2.5, 0], [5.25, 2, 0], [5.65, 0.85, 0], [14.35, 1.1, 0]])
    for past_ends_m, counts in ((0, (1, 3)), (0.3, (3, 3)), (2, (4, 2))):
        prior = dataclasses.replace(LOW_CAR, past_ends_m=past_ends_m)
        around = reference.count_points_around(box, prior, obstacles_of(xyz, np.ones(6)), AROUND)
        assert (around.num_inside, around.num_ring) == counts, past_ends_m
    # From beside it the sensor sees neither end.
    prior = dataclasses.replace(LOW_CAR, past_ends_m=2.0)
    aside = reference.count_points_around(
        np.array([0.0, 2.0, 8.0, 2.0, 0.0]), prior, obstacles_of(xyz - [10, 0, 0], np.ones(6)), AROUND
    )
    assert aside.num_inside == 1


def test_what_overhangs_the_visible_side_of_a_van_is_its_own_and_the_ring_begins_there():
    box = np.array([0.0, 10.0, 8.0, 2.0, 0.0])
    xyz = np.array([[0, 8.65, 0], [0, 8.55, 0], [0, 8.25, 0], [0, 11.35, 0], [0, 11.55, 0.0]])
    for past_ends_m, counts in ((0, (0, 3)), (0.2, (0, 3)), (0.3, (1, 3)), (2, (1, 3))):
        prior = dataclasses.replace(LOW_CAR, past_ends_m=past_ends_m)
        around = reference.count_points_around(box, prior, obstacles_of(xyz, np.ones(5)), AROUND)
        assert (around.num_inside, around.num_ring) == counts, past_ends_m


def test_what_is_behind_a_box_counts_the_less_the_surer_the_box_is():
    # The sensor sees the right side and the rear; points lie behind the left side and the front, and along
    # the right side.
    box = np.array([10.0, 5.0, 4.0, 2.0, 0.0])
    left, front, along, before = [9.0, 6.3, 0], [12.3, 5.5, 0], [12.3, 4.2, 0], [9.0, 3.7, 0]
    on_the_face = [9.0, 5.95, 0]
    obstacles = obstacles_of(np.array([left, front, along, before, on_the_face]), np.full(5, 1.0))

    def counts(sure):
        around = reference.count_points_around(box, LOW_CAR, obstacles, AROUND, sure=sure)
        return around.num_inside, around.num_ring

    assert counts(0.0) == (1, 4)
    assert counts(0.5) == (1, 2)
    assert counts(1.0) == (0, 2)
    xy = np.array([left, front, along, before])[:, :2]
    assert reference.is_behind(xy, box, 0.29).tolist() == [True, True, False, False]
    assert reference.is_behind(xy, box, 0.31).tolist() == [False, False, False, False]
    # From the middle of the side neither end is hidden.
    aside = np.array([0.0, 5.0, 4.0, 2.0, 0.0])
    assert reference.is_behind(np.array([[2.3, 5.5], [0.0, 6.3]]), aside, 0.1).tolist() == [False, True]


def test_depth_is_behind_the_nearest_visible_face_and_endless_round_the_sensor():
    box = np.array([10.0, 0.0, 4.0, 2.0, 0.0])
    rear_only = reference.depth_behind_faces(np.array([[8.0, 0.0], [8.5, 0.9], [7.9, 0.0]]), box)
    np.testing.assert_allclose(rear_only, [0, 0.5, -0.1], atol=1e-12)
    aside = np.array([10.0, 5.0, 4.0, 2.0, 0.0])
    rear_and_side = reference.depth_behind_faces(np.array([[9.0, 4.2], [8.1, 5.0]]), aside)
    np.testing.assert_allclose(rear_and_side, [0.2, 0.1])
    assert np.isinf(reference.depth_behind_faces(np.zeros((1, 2)), np.array([0.5, 0.0, 4.0, 2.0, 0.3])))


def test_upper_points_behind_the_faces_are_recessed():
    box = np.array([10.0, 0.0, 4.0, 2.0, 0.0])
    xyz = np.array([[8.0, 0, 0], [8.2, 0, 0], [8.4, 0, 0], [9.0, 0, 0], [9.0, 0, 0]])
    obstacles = obstacles_of(xyz, np.array([1.0, 1.0, 1.0, 1.4, 0.6]))
    around = reference.count_points_around(box, LOW_CAR, obstacles, AROUND)
    assert (around.num_upper, around.num_recessed) == (4, 2)


CORNERS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])


def test_the_far_end_of_a_side_that_is_seen_is_at_its_last_point_and_a_hidden_one_stays():
    rule = dataclasses.replace(COMPLETION, end_length=0.6, end_slope=0.2, end_points=50.0)
    around = reference.NeighbourhoodCounts(num_inside=150, top=1.5, num_above=0, num_ring=0, deepest=3.2)

    def length(box, **changes):
        seen = dataclasses.replace(around, **changes)
        answered, sure = reference.end_where_seen(np.array(box), seen, CAR, rule, 0.004)
        assert (sure > 0) == (answered[2] != box[2])
        nearest = [
            np.linalg.norm(turned(each[2:4] / 2 * CORNERS, each[4]) + each[:2], axis=1).min()
            for each in (answered, np.array(box))
        ]
        assert nearest[0] == pytest.approx(nearest[1])
        np.testing.assert_array_equal(answered[3:], box[3:])
        return answered[2]

    aside, ahead = [10.0, 5.0, 3.9, 1.6, 0.0], [15.0, 0.0, 3.9, 1.6, 0.0]
    # The nearest corner is 8.05 m ahead and 4.2 m aside, so that beams are .079 m apart on the side.
    spacing_m = 0.004 * (8.05**2 + 4.2**2) / 4.2
    assert length(aside) == pytest.approx(3.9 + 0.75 * (3.2 + spacing_m / 2 - 3.9))
    assert length(aside, num_inside=50) == pytest.approx(3.9 + 0.5 * (3.2 + spacing_m / 2 - 3.9))
    assert length(aside, deepest=2.3) == 3.9
    assert length(ahead) == 3.9
    assert length([*aside[:4], np.pi]) == pytest.approx(length(aside))
    assert length([-10.0, *aside[1:]]) == pytest.approx(length(aside))
    assert 3.9 > length([15.0, 1.5, 3.9, 1.6, 0.0]) > length(aside)


def test_the_farthest_point_counts_from_the_near_end_and_behind_hidden_faces_too():
    box = np.array([10.0, 5.0, 4.0, 2.0, 0.0])
    xyz = np.array([[8.1, 4.1, 0], [12.05, 4.5, 0], [12.2, 4.5, 0], [9.0, 5.0, 0]])
    height = np.array([1.0, 1.0, 1.0, 2.5])
    for sure, deepest in ((0.0, 4.05), (1.0, 4.05)):
        around = reference.count_points_around(box, LOW_CAR, obstacles_of(xyz, height), AROUND, sure=sure)
        assert around.deepest == pytest.approx(deepest)
    nothing = reference.count_points_around(box, LOW_CAR, obstacles_of(xyz[2:], height[2:]), AROUND)
    assert nothing.deepest == 0


def test_a_few_stray_returns_above_a_roof_are_not_its_top():
    roof = np.random.default_rng(0).uniform(0.3, 1.5, 400)
    options = {"max_height_m": 2.2, "top_quantile": 0.01}
    highest = options | {"top_quantile": 0.0}
    assert reference.top_of(roof, **highest) == roof.max()
    clean = reference.top_of(roof, **options)
    assert abs(clean - np.quantile(roof, 0.99)) < 0.02
    for num_stray in (1, 2, 4):
        with_strays = np.append(roof, np.linspace(1.8, 2.1, num_stray))
        assert reference.top_of(with_strays, **highest) == with_strays.max()
        assert clean <= reference.top_of(with_strays, **options) < roof.max() + 0.07


def test_the_top_of_few_points_is_within_a_level_of_the_highest():
    for height in ([1.4], [0.5, 0.6], [0.3, 1.0, 1.41]):
        top = reference.top_of(np.array(height), 2.2, 0.01)
        assert max(height) - 0.6 * 2.2 / 20 < top <= max(height)
    assert reference.top_of(np.empty(0), 2.2, 0.01) == 0


PERFECT = {
    "around": reference.NeighbourhoodCounts(num_inside=100, top=1.5, num_above=0, num_ring=0),
    "num_points": 100,
    "hit": 1.0,
    "free_length": 0.0,
}
PERFECT_BOX = np.array([10.0, 0.0, 3.9, 1.63, 0.0])


def score_of(box=PERFECT_BOX, prior=CAR, *, objective=np.inf, measured=(3.9, 1.63), **faults):
    completed = reference.CompletedBox(box, objective, *measured)
    return reference.score_box(completed, prior, **(PERFECT | faults), config=SCORE)


def test_the_highest_beam_is_where_it_passes_the_nearest_point_of_a_box():
    def even(xyz):
        return np.full(len(xyz), -1.7)

    for box, nearest_m in (
        ([12.0, 0, 4, 2, 0], 10),
        ([0, 12.0, 4, 2, 0], 11),
        ([15.0, 10, 4, 2, 0], 13 * np.hypot(1, 9 / 13)),
    ):
        reach = reference.reach_of_beams(np.array(box), 0.0, 0.1, even)
        assert reach == pytest.approx(1.7 + 0.1 * nearest_m)
    assert reference.reach_of_beams(np.array([12.0, 0, 4, 2, 0]), 0.0, None, even) == np.inf


def test_a_perfect_car_scores_one_and_each_fault_costs_its_factor():
    score, around = score_of, PERFECT["around"]
    assert score() == 1
    assert score(moved(PERFECT_BOX, length=-0.8)) == pytest.approx(np.exp(-1))
    assert score(moved(PERFECT_BOX, length=2.0)) == pytest.approx(np.exp(-1))
    assert score(moved(PERFECT_BOX, width=0.4)) == pytest.approx(np.exp(-1))
    assert score(num_points=50) == pytest.approx(0.5**0.3)
    assert score(hit=0.25) == 0.25
    assert score(prior=dataclasses.replace(CAR, prior_weight=0.5)) == 0.5
    assert score(free_length=0.15) == pytest.approx(np.exp(-1))
    assert score(moved(PERFECT_BOX, x=30)) == 1
    assert score(moved(PERFECT_BOX, x=80)) == pytest.approx((50 / 90) ** 3)
    assert score(objective=2.4) == pytest.approx(0.5)
    assert score(around=dataclasses.replace(around, num_ring=25)) == pytest.approx(np.exp(-2))
    assert score(around=dataclasses.replace(around, top=2.1)) == pytest.approx(np.exp(-1))
    # What is above counts as far as it is connected: from a gap of .25 m to one of .5 m below 2.2 m.
    overhead = [score(around=dataclasses.replace(around, num_above=n, top=2.1)) for n in (0, 50)]
    assert overhead[1] / overhead[0] == pytest.approx(np.exp(-3))
    halfway = [score(around=dataclasses.replace(around, num_above=n, top=1.75)) for n in (0, 50)]
    assert halfway[1] / halfway[0] == pytest.approx(np.exp(-1.5))
    assert score(around=dataclasses.replace(around, num_above=50)) == 1
    assert score(around=dataclasses.replace(around, num_upper=50, num_recessed=20)) == 1
    assert score(around=dataclasses.replace(around, num_upper=50, num_recessed=10)) == pytest.approx(
        0.2 + 0.8 * 12 / 55 / 0.4
    )
    assert score(around=dataclasses.replace(around, num_upper=50)) == pytest.approx(0.2 + 0.8 * 2 / 55 / 0.4)
    assert score(around=dataclasses.replace(around, num_upper=10**6)) == pytest.approx(0.2, abs=1e-4)
    # Where the highest beam cuts the top off, the height says nothing, if half the width was measured.
    cut = dataclasses.replace(around, top=0.8)
    assert score(around=cut) == 0
    assert score(around=cut, reach=0.8) == pytest.approx(0.7)
    assert score(around=cut, reach=0.85) == pytest.approx(0.35)
    assert score(around=cut, reach=0.95) == 0
    assert score(around=cut, reach=0.8, measured=(3.9, 1.63 / 4)) == pytest.approx(0.35)
    # A top that reads low far away may be higher by the range allowance.
    low = dataclasses.replace(around, top=1.2)
    assert score(around=low) == pytest.approx(np.exp(-((0.225 / 0.3) ** 2)))
    assert score(moved(PERFECT_BOX, x=30), around=low) == 1
    # Or by any, where the highest beam passes there: then its height is not known.
    assert score(around=low, reach=1.2) == score(around=dataclasses.replace(low, top=0.5), reach=0.5) == 0.7
    assert score(around=low, reach=1.31) == score(around=low)
    assert score(around=dataclasses.replace(low, top=0.39), reach=0.39) == 0
    assert score(reach=1.5) == 1
    # Far away a bumper may be all that returns, if it is as wide as the class.
    bumper = dataclasses.replace(around, top=0.6)
    assert score(moved(PERFECT_BOX, x=20), around=bumper) == pytest.approx(0.7)
    assert score(moved(PERFECT_BOX, x=15), around=bumper) == pytest.approx(0.35)
    assert score(moved(PERFECT_BOX, x=10), around=bumper) == 0
    narrow = (3.9, 0.7 * 1.63)
    assert score(moved(PERFECT_BOX, x=30), around=bumper, measured=narrow) == pytest.approx(0.35)
    assert score(moved(PERFECT_BOX, x=30), around=dataclasses.replace(around, top=0.39)) == 0
    as_vans = dataclasses.replace(CAR, min_bumper_m=10.0)
    assert score(moved(PERFECT_BOX, x=30), around=bumper, prior=as_vans) == 0


def test_the_rear_of_a_high_car_may_be_upright_where_its_width_was_measured():
    around = dataclasses.replace(PERFECT["around"], num_upper=10**6)

    def upright(top, *, measured_m=1.63, prior=CAR):
        high = dataclasses.replace(around, top=top)
        by_height = np.exp(-(((top - 1.5) / 0.6) ** 2))
        return score_of(prior=prior, around=high, measured=(1.2, measured_m)) / by_height

    np.testing.assert_allclose(
        [upright(top) for top in (1.5, 1.75, 1.8, 1.85, 2.1)], [0.2, 0.2, 0.3, 0.4, 0.4], rtol=1e-4
    )
    assert upright(1.9, measured_m=0.7 * 1.63) == pytest.approx(0.3, rel=1e-4)
    assert upright(1.9, measured_m=0.6 * 1.63) == pytest.approx(0.2, rel=1e-4)
    assert upright(1.9, prior=dataclasses.replace(CAR, upright_from_m=10.0)) == pytest.approx(0.2, rel=1e-4)


def test_what_may_be_a_wall_is_a_truck_as_far_as_beams_pass_below():
    truck = dataclasses.replace(SCORE.classes[2], prior_weight=1.0, min_open=0.06)
    box = np.array([10.0, 5.0, truck.length_m, truck.width_m, 0.0])

    def score(is_open, *, top=truck.height_m, measured_m=truck.width_m, reach=9.0, prior=truck):
        around = dataclasses.replace(PERFECT["around"], top=top)
        measured = truck.length_m, measured_m
        return score_of(box, prior, around=around, measured=measured, reach=reach, is_open=is_open)

    shares = 0, 0.03, 0.06, 0.2
    # Seen to its top, and from two sides: nothing is asked.
    assert [score(share) for share in shares] == [1, 1, 1, 1]
    one_side = [score(share, measured_m=0.0) for share in shares]
    np.testing.assert_allclose(one_side, [0, 0.5, 1, 1])
    assert score(0, measured_m=0.2 * truck.width_m) == pytest.approx(0.5)
    cut_off = [score(share, top=2.2, reach=2.2) for share in shares]
    np.testing.assert_allclose(cut_off, [0, 0.35, 0.7, 0.7])
    # A top that suits the class tells nothing either where the highest beam passes there.
    np.testing.assert_allclose([score(share, reach=truck.height_m) for share in shares], [0, 0.5, 1, 1])
    indifferent = dataclasses.replace(truck, min_open=0.0)
    assert score(0, measured_m=0.0, prior=indifferent) == 1


@pytest.mark.parametrize(
    "fault",
    [
        {"around": reference.cluster_alone(9, 0.92)},
        {"around": reference.cluster_alone(9, 2.3)},
        {"measured": (0.99, 0.99)},
        {"measured": (0.59, 0.59), "in_threes": True},
    ],
)
def test_each_gate_closes(fault):
    assert score_of(**fault) == 0


@pytest.mark.parametrize("fault", [{"measured": (1.0, 0.0)}, {"measured": (0.6, 0.6), "in_threes": True}])
def test_the_gate_on_extent_is_lower_in_rows(fault):
    assert score_of(**fault) > 0.1


def test_overlap_is_one_on_itself_symmetric_and_that_of_two_squares_at_45_degrees():
    square, turned_square = np.array([50.0, -30.0, 1, 1, 0]), np.array([50.0, -30.0, 1, 1, np.pi / 4])
    shared = 2 * (np.sqrt(2) - 1)
    assert reference.bev_iou(square, square) == pytest.approx(1, abs=1e-5)
    assert reference.bev_iou(square, turned_square) == pytest.approx(shared / (2 - shared), abs=1e-5)
    rng = np.random.default_rng(9)
    for first, second in rng.uniform([0, 0, 1, 1, -3], [2, 2, 4, 4, 3], (20, 2, 5)):
        assert reference.bev_iou(first, second) == pytest.approx(reference.bev_iou(second, first), abs=1e-5)
    assert reference.bev_iou(square, moved(square, x=3)) == 0


def test_suppression_keeps_the_best_of_each_group_in_order_of_score():
    box = np.array([10.0, 0.0, 4.0, 2.0, 0.1])
    boxes = np.array([box, moved(box, x=1), moved(box, x=20), moved(box, x=3.9)])
    scores = np.array([0.5, 0.7, 0.9, 0.1])
    assert reference.non_max_suppression(boxes, scores, max_overlap=0.1).tolist() == [2, 1]
    assert reference.non_max_suppression(boxes, scores, max_overlap=0.2).tolist() == [2, 1, 3]
    assert reference.non_max_suppression(np.zeros((0, 5)), np.zeros(0), max_overlap=0.1).tolist() == []


# ---------------------------------------------------------------- detect

CARS = [
    (12.0, 3.0, 3.9, 1.63, 0.3, 1.5),
    (18.0, -6.0, 3.9, 1.63, 0.3, 1.5),
    (22.0, 14.0, 3.9, 1.63, 0.3, 1.5),
]


@pytest.fixture(scope="module")
def car_scene():
    sweep = lidar_sweep(CARS)
    return sweep, reference.detect(sweep)


def test_cars_on_flat_ground_are_found_where_they_stand(car_scene):
    sweep, detections = car_scene
    assert detections.found
    np.testing.assert_allclose(detections.coefficients, [0, 0, -SENSOR_HEIGHT_M], atol=0.02)
    for x, y, length, width, yaw, height in CARS:
        row = np.argmin(np.hypot(*(detections.center[:, :2] - [x, y]).T))
        # Cuboids are as upright as walls, which costs them most of their score.
        assert detections.score[row] > 0.15
        assert detections.label[row] == Label.CAR
        np.testing.assert_allclose(detections.center[row], [x, y, height / 2 - SENSOR_HEIGHT_M], atol=0.15)
        # It reads no shorter than it is, but sides seen whole are taken to.
        assert detections.size[row, 0] == pytest.approx(length, abs=0.3)
        np.testing.assert_allclose(detections.size[row, 1:], [width, height], atol=0.1)
        assert np.degrees(detections.yaw[row]) == pytest.approx(np.degrees(yaw), abs=1.1)
        own = sweep[detections.point_detection == row]
        assert len(own) == detections.num_points[row] > 30
        outside = reference.distance_outside(own[:, :2], np.array([x, y, length, width, yaw]))
        assert outside.max() < 0.25


def test_a_truck_is_called_a_truck_and_a_car_is_not():
    # Beams pass below a truck's body: one that stood on the ground would be a wall.
    truck = (28.0, 6.0, 10.8, 2.6, -0.3, 3.3, 0.6)
    # All points: the far end of so long a side has few of them, and a sample may end before it.
    config = DetectorConfig(box=BoxConfig(max_points=2000))
    detections = reference.detect(lidar_sweep([truck, CARS[1]]), config)
    for label, body in ((Label.TRUCK, truck), (Label.CAR, CARS[1])):
        row = np.argmin(np.hypot(*(detections.center[:, :2] - body[:2]).T))
        assert detections.label[row] == label
        np.testing.assert_allclose(detections.center[row, :2], body[:2], atol=0.3)
        # A cuboid reads no shorter than it is, but sides seen whole are taken to.
        np.testing.assert_allclose(detections.size[row, :2], body[2:4], atol=0.3)


def test_a_sweep_turned_half_round_gives_boxes_turned_half_round(car_scene):
    sweep, first = car_scene
    second = reference.detect(sweep * [-1, -1, 1])
    for detections, other in ((first, second), (second, first)):
        assert (detections.score > 0.15).sum() >= len(CARS)
        for center in detections.center[detections.score > 0.15]:
            gap = np.linalg.norm(other.center - center * [-1, -1, 1], axis=1)
            assert gap.min() < 0.1


def test_the_paper_preset_keeps_the_extent_of_the_cluster():
    sweep = lidar_sweep([(12.0, 3.0, 3.9, 1.63, 1.0, 1.5)])
    detections = reference.detect(sweep, DetectorConfig.paper())
    own = sweep[detections.point_detection == 0]
    # The extent over the ground, and the noise tilts the ground a little.
    assert detections.size[0, 2] == pytest.approx(np.ptp(own[:, 2]), abs=1e-3)
    center, (length, width), _ = reference.min_area_rectangle(own[:, :2])
    np.testing.assert_allclose(detections.center[0, :2], center, atol=0.1)
    assert length * width <= detections.size[0, 0] * detections.size[0, 1] + 1e-4
    np.testing.assert_allclose(detections.size[0, :2], [length, width], atol=0.15)


DEGENERATE = {
    "empty": np.zeros((0, 3)),
    "one point": np.array([[5.0, 1.0, 0.0]]),
    "all points equal": np.full((500, 3), 3.0),
    "all NaN": np.full((50, 3), np.nan),
    "out of range": np.full((50, 3), 500.0),
    "all ground": np.random.default_rng(0).uniform([-30, -30, -1.71], [30, 30, -1.69], (5000, 3)),
    "a wall": np.random.default_rng(0).uniform([9.99, -10, -1], [10.01, 10, 2], (5000, 3)),
    "noise": np.random.default_rng(0).uniform(-20, 20, (5000, 3)),
}


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_sweeps_give_finite_boxes_and_account_for_every_point(name, preset):
    sweep = DEGENERATE[name]
    detections = reference.detect(sweep, DetectorConfig.presets()[preset])
    fields = [field.name for field in dataclasses.fields(Counts)]
    assert sorted(detections.counts) == sorted(fields)
    assert sum(detections.counts[field] for field in fields[:NUM_POINT_COUNTS]) == len(sweep)
    for array in (detections.center, detections.size, detections.yaw, detections.score):
        assert np.isfinite(array).all()
    assert detections.ground_mask.sum() == detections.counts["ground_points"]
    assert np.bincount(detections.point_detection + 1, minlength=len(detections.score) + 1)[1:].tolist() == (
        detections.num_points.tolist()
    )


def test_the_same_seed_gives_the_same_boxes(car_scene):
    sweep, first = car_scene
    second = reference.detect(sweep, seed=0)
    np.testing.assert_array_equal(first.center, second.center)
    np.testing.assert_array_equal(first.score, second.score)


def test_nan_points_change_nothing_but_their_count(car_scene):
    sweep, clean = car_scene
    dirty = reference.detect(np.vstack([sweep, np.full((7, 3), np.nan)]))
    np.testing.assert_array_equal(clean.center, dirty.center)
    assert dirty.counts["nonfinite_points"] == 7
    assert (dirty.point_component[-7:] == reference.NO_CLUSTER).all()


@pytest.fixture(scope="module")
def real_detections(data_root):
    folder = data_root / "kitti_object" / "training"
    xyz = np.fromfile(folder / "velodyne" / "000008.bin", np.float32).reshape(-1, 4)[:, :3]
    return folder, xyz, reference.detect(xyz)


def test_labelled_cars_of_a_real_sweep_are_found(real_detections):
    folder, _, detections = real_detections
    calibration = dict(
        line.split(":", 1) for line in (folder / "calib" / "000008.txt").read_text().splitlines() if line
    )
    rect = np.array(calibration["R0_rect"].split(), float).reshape(3, 3)
    velo = np.array(calibration["Tr_velo_to_cam"].split(), float).reshape(3, 4)
    camera = detections.center @ (rect @ velo[:, :3]).T + rect @ velo[:, 3]
    labels = [line.split() for line in (folder / "label_2" / "000008.txt").read_text().splitlines()]
    cars = [np.array(label[11:14], float) for label in labels if label[0] == "Car"]
    gaps = [np.hypot(*(camera[:, [0, 2]] - car[[0, 2]]).T).min() for car in cars]
    assert len(cars) == 6
    assert sum(gap < 0.5 for gap in gaps) >= 5


def test_components_of_a_real_sweep_hold_each_detection_in_one_piece(real_detections):
    _, xyz, detections = real_detections
    obstacle = detections.point_component != reference.NO_CLUSTER
    np.testing.assert_array_less(0.2, detections.height[obstacle])
    best = detections.point_detection == 0
    assert len(set(detections.point_component[best])) == 1
    hull = detections.hulls[0].astype(np.float32)
    for point in xyz[best, :2]:
        assert cv2.pointPolygonTest(hull, point.tolist(), measureDist=True) > -1e-4


# ---------------------------------------------------------------- twins

NO_TWIN = {
    "clustering.arrange_grids": "lays the cells of all maps in one row",
    "clustering.find_statistics": "fills a table; select_clusters of the reference goes by the points",
    "clustering.lowest_z": "a minimum over the points of each cluster",
    "descriptors.point_moments": "sums over lists; shape_descriptors of the reference goes by the points",
    "evidence.weigh_boxes": "cast_rays in chunks, with the hits of the class",
    "hull.extreme_points": "thins out what cannot reach the hull",
    "hull.find_bounds": "the frame of those",
    "hull.trace_hulls": "convex_hulls in chunks",
    "hull.trace_owned": "convex_hulls of lists of points",
    "rectangles.choose_rectangles": "best_rectangles in chunks",
    "state.longest_side": "a property of Rectangle",
}
"""Functions of the stages without a twin: what is about arrays of a fixed shape only."""


def stage_functions():
    for info in pkgutil.iter_modules(stages.__path__):
        if not info.name.startswith("_"):
            module = importlib.import_module(f"jaxbox.stages.{info.name}")
            for name, item in vars(module).items():
                if inspect.isfunction(item) and item.__module__ == module.__name__ and name[0] != "_":
                    yield info.name, name


def test_every_function_of_a_stage_has_a_twin_of_its_name_in_the_file_of_its_name():
    functions = list(stage_functions())
    assert len(functions) > 50
    missing = set()
    for module, name in functions:
        twin = getattr(reference, name, None)
        if twin is None or twin.__module__ != f"jaxbox.reference.{module}":
            missing.add(f"{module}.{name}")
    assert missing == set(NO_TWIN)


def test_every_oracle_that_a_docstring_names_exists():
    package = pathlib.Path(reference.__file__).parents[1]
    named = {
        name
        for path in package.rglob("*.py")
        for name in re.findall(r"`jaxbox\.reference\.(\w+)`", path.read_text())
    }
    assert len(named) > 10
    assert {name for name in named if not hasattr(reference, name)} == set()
