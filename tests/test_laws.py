"""Laws under random input, searched by hypothesis: symmetry, padding, batches, containment, and round trips.

The suite runs the profile "ci", a few fixed examples. New ones are looked for by hand:
`pytest tests/test_laws.py --hypothesis-profile=long`.
"""

import functools

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from test_detector import CAPACITY, assert_same_bits, run
from test_projection import make_calibration, oracle_uvw

from jaxbox import DetectorConfig, PointCloud, Status, detect, detect_batch, io, stack_clouds, synthetic
from jaxbox.config import BoxConfig
from jaxbox.config.fields import config_from_toml, config_to_toml
from jaxbox.evaluation import pairwise_overlaps
from jaxbox.geometry.projection import project_boxes
from jaxbox.io.kitti import KittiObject
from jaxbox.stages.hull import convex_hulls, polygon_area
from jaxbox.stages.rectangles import best_rectangles, try_rotations
from jaxbox.xla.ragged import PointLists
from quality import bad_input

SWEEPS = settings(max_examples=max(settings.default.max_examples // 5, 1))
"""A sweep takes longer than a cluster."""
NUM_POINTS, NUM_ANGLES = 32, 90
STEP = np.pi / 2 / NUM_ANGLES
CLEAR_SCORE = 0.3
"""Boxes of vehicles in the open that score so much are found again when the world moves."""
FOUND_IOU = 0.5
"""And at least as well as this; most far better. Order decides which 128 points of a cluster are fitted to.
The cells of filter, ground and maps, and the rays, are anchored at the sensor: in a world that moves, points
fall into other cells. A side that is then seen whole, or no longer, lengthens or shortens a box."""

# Points a sixty-fourth of a metre apart: sums and differences of such numbers are exact.
GRID_M = 1 / 64
shapes = st.tuples(st.integers(1, NUM_POINTS), st.just(2))
grid_points = arrays(np.int16, shapes, elements=st.integers(-512, 512))
float_points = arrays(np.float32, shapes, elements=st.floats(-60, 60, width=32, allow_subnormal=False))
clusters = st.one_of(grid_points.map(lambda points: points.astype(np.float32) * GRID_M), float_points)
seeds = st.integers(0, 2**20)

_hulls = jax.jit(functools.partial(convex_hulls, max_vertices=2 * NUM_POINTS))


def padded(xy):
    rows = np.zeros((NUM_POINTS, 2), np.float32)
    rows[: len(xy)] = xy
    return rows


def hull_of(xy):
    """(h, 2) vertices of the hull of one cluster."""
    x, y, count = _hulls(*padded(xy).T[..., None], np.arange(NUM_POINTS)[:, None] < len(xy))
    return np.column_stack([x, y])[: count[0]]


@jax.jit
def _rectangle(rows, count):
    lists = PointLists(rows[:, 0], rows[:, 1], jnp.zeros(1, jnp.int32), count[None], NUM_POINTS)
    first = jnp.zeros(1, jnp.int32)
    curve, extents, _ = try_rotations(
        lists, first, jnp.int32(1), BoxConfig(criterion="area", num_angles=NUM_ANGLES)
    )
    return best_rectangles(curve, extents, jnp.zeros(NUM_ANGLES))


def rectangle_of(xy):
    """Angle, lower and upper bounds of the smallest rectangle of one cluster."""
    best = _rectangle(padded(xy), jnp.int32(len(xy)))
    return float(best.angle[0]), np.asarray(best.low[0], float), np.asarray(best.high[0], float)


def area_of(xy):
    _, low, high = rectangle_of(xy)
    return np.prod(high - low)


def turned(xy, angle):
    """Points in float64, turned by minus an angle: their coordinates in the frame that is turned by it."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(xy, float) @ np.array([[cos, -sin], [sin, cos]])


# Clusters: the hull.


@given(clusters)
def test_a_hull_holds_its_points_turns_left_and_is_made_of_them(xy):
    hull = hull_of(xy).astype(float)
    assert set(map(tuple, hull.tolist())) <= set(map(tuple, xy.tolist()))
    edge = np.roll(hull, -1, axis=0) - hull
    offset = xy.astype(float)[:, None] - hull
    # Twice the area to the right of an edge, over its length, is how far a point lies outside.
    outside = edge[:, 1] * offset[..., 0] - edge[:, 0] * offset[..., 1]
    assert (outside <= 1e-4 * np.maximum(np.linalg.norm(edge, axis=1), 1e-3)).all()
    assert polygon_area(jnp.asarray(hull, jnp.float32)) >= -1e-3


@given(clusters, seeds)
def test_a_hull_is_the_same_bits_in_any_order_of_its_points(xy, seed):
    shuffled = np.random.default_rng(seed).permutation(xy)
    np.testing.assert_array_equal(hull_of(shuffled), hull_of(xy))


@given(grid_points, st.integers(-3000, 3000), st.integers(-3000, 3000))
def test_a_hull_moves_with_its_points_exactly(points, x, y):
    shift = np.array([x, y])
    moved = hull_of((points + shift).astype(np.float32) * GRID_M)
    np.testing.assert_array_equal(moved - shift * GRID_M, hull_of(points.astype(np.float32) * GRID_M))


@given(grid_points)
def test_a_hull_turns_with_its_points_by_quarters(points):
    xy = points.astype(np.float32) * GRID_M
    quarter = np.array([[0, 1], [-1, 0]], np.float32)
    expected = {tuple(vertex) for vertex in (hull_of(xy) @ quarter).tolist()}
    assert {tuple(vertex) for vertex in hull_of(xy @ quarter).tolist()} == expected


# Clusters: the rectangle.


@given(clusters)
def test_a_rectangle_holds_its_points_and_no_rotation_that_is_tried_has_a_smaller_one(xy):
    angle, low, high = rectangle_of(xy)
    local = turned(xy, angle)
    assert (local >= low - 1e-4).all()
    assert (local <= high + 1e-4).all()
    tried = [np.prod(np.ptp(turned(xy, i * STEP), axis=0)) for i in range(NUM_ANGLES)]
    # float32 keeps an extent of up to 170 m to a hundredth of a millimetre.
    assert np.prod(high - low) <= min(tried) + 1e-4 * (1 + np.ptp(local))


@given(clusters)
def test_a_rectangle_is_hardly_larger_than_the_smallest_at_any_rotation(xy):
    (_, (length, width), _) = cv2.minAreaRect(hull_of(xy))
    # At most half a step from the best rotation, whose rectangle the tried one has to hold.
    cos, sin = np.cos(STEP / 2), np.sin(STEP / 2)
    bound = (length * cos + width * sin) * (width * cos + length * sin)
    assert area_of(xy) <= bound + 1e-3 * (1 + length)


@given(clusters, seeds)
def test_a_rectangle_is_the_same_bits_in_any_order_of_its_points(xy, seed):
    shuffled = np.random.default_rng(seed).permutation(xy)
    for one, other in zip(rectangle_of(shuffled), rectangle_of(xy), strict=True):
        np.testing.assert_array_equal(one, other)


@given(clusters, st.integers(0, 4 * NUM_ANGLES), st.floats(-40, 40), st.floats(-40, 40))
def test_a_rectangle_keeps_its_area_where_the_cluster_moves_and_turns_by_whole_steps(xy, steps, x, y):
    moved = (turned(xy, steps * STEP) + np.array([x, y])).astype(np.float32)
    extent = 1 + np.ptp(xy, axis=0).max()
    assert abs(area_of(moved) - area_of(xy)) <= 2e-4 * extent


# Sweeps.


@st.composite
def worlds(draw):
    """Any sweep of up to a capacity: part of a street, noise, points twice, some not finite or far away."""
    rng = np.random.default_rng(draw(seeds))
    street = bad_input.street(draw(st.integers(0, 3)))
    points = street[rng.random(len(street)) < draw(st.floats(0, 1))] * np.float32(draw(st.floats(0.2, 1.5)))
    reach = [draw(st.floats(1, 90)), draw(st.floats(1, 70)), draw(st.floats(0.1, 5))]
    noise = rng.uniform(-1, 1, (draw(st.integers(0, 6000)), 3)) * reach
    points = np.concatenate([points, noise.astype(np.float32)])
    if len(points):
        points = np.concatenate([points, points[rng.integers(0, len(points), draw(st.integers(0, 2000)))]])
    bad = rng.choice(np.float32([np.nan, np.inf, -np.inf, 1e30, -1e30]), (draw(st.integers(0, 50)), 3))
    return rng.permutation(np.concatenate([points, bad]))


@st.composite
def open_streets(draw):
    """Eight vehicles on a street without anything else, all within the region however it is turned."""
    seed = draw(seeds)
    xyz = synthetic.make_sweep(seed, num_vehicles=8, clutter=False, num_beams=32, num_azimuths=480).xyz
    return xyz[np.hypot(xyz[:, 0], xyz[:, 1]) < DetectorConfig().region.half_y_m - 2]


def clear_boxes(detections):
    """(k, 7) boxes of clear vehicles, and (n, 7) all boxes."""
    d = detections
    rows = np.column_stack([d.center, d.size, d.yaw])[d.valid].astype(float)
    return rows[d.score[d.valid] >= CLEAR_SCORE], rows


def assert_found_again(expected, detections):
    _, rows = clear_boxes(detections)
    overlap, _ = pairwise_overlaps(expected, rows)
    assert (overlap.max(axis=1, initial=0) >= FOUND_IOU).all()


@SWEEPS
@given(worlds())
def test_any_world_has_a_lawful_answer(xyz):
    assert bad_input.broken_laws(run(xyz), xyz, CAPACITY, DetectorConfig()) == []


@SWEEPS
@given(worlds())
def test_more_padding_changes_no_bit_of_the_boxes(xyz):
    # A larger cloud holds more points, obstacles and points of slabs: only where none were dropped.
    narrow, wide = run(xyz), run(xyz, capacity=2 * CAPACITY)
    if not Status(int(narrow.status)) & (Status.POINT_OVERFLOW | Status.OBSTACLE_OVERFLOW):
        for name in ("center", "size", "yaw", "score", "label", "valid", "num_points", "status", "counts"):
            assert_same_bits(getattr(wide, name), getattr(narrow, name))


@SWEEPS
@given(st.lists(worlds(), min_size=4, max_size=4), seeds)
def test_a_batch_has_the_bits_of_its_sweeps_one_by_one(sweeps, seed):
    clouds = [PointCloud.from_numpy(xyz, capacity=CAPACITY) for xyz in sweeps]
    keys = jax.random.split(jax.random.key(seed), len(clouds))
    scales = (1.0, 0.9, 1.2, 1.0)
    configs = [jax.tree.map(lambda value, s=scale: s * value, DetectorConfig()) for scale in scales]
    batch = jax.tree.map(lambda *values: jnp.array(values), *configs)
    many = jax.device_get(jax.vmap(detect)(stack_clouds(clouds), batch, keys))
    for row, (cloud, config, key) in enumerate(zip(clouds, configs, keys, strict=True)):
        single = jax.device_get(detect(cloud, config, key))
        assert_same_bits(jax.tree.map(lambda leaf, row=row: leaf[row], many), single)
    together = detect_batch(clouds, devices=jax.local_devices()[:1])
    assert_same_bits(jax.device_get(together[0]), run(sweeps[0]))


@SWEEPS
@given(worlds())
def test_a_box_holds_its_hull_and_the_hull_its_points(xyz):
    found, config = run(xyz), DetectorConfig()
    xyz = np.asarray(PointCloud.from_numpy(xyz, capacity=CAPACITY).xyz1)[:, :3]
    for row in np.flatnonzero(found.valid & (found.num_points > 0)):
        hull = found.hulls.vertices[row, : found.hulls.num_vertices[row]].astype(float)
        local = turned(hull - found.center[row, :2], found.yaw[row])
        # A millimetre outside is inside to the detector, and float32 keeps 80 m to a hundredth of that.
        assert (np.abs(local) <= found.size[row, :2] / 2 + 2e-3).all()
        points = xyz[np.flatnonzero(found.point_detection[: len(xyz)] == row), :2].astype(float)
        # The hull is that of the extremes of thin slices: a point may lie outside by a slice.
        slices_m = np.ptp(points, axis=0).max() / config.hull.num_slices + 1e-3
        signed = [cv2.pointPolygonTest(hull.astype(np.float32), tuple(map(float, p)), True) for p in points]
        if found.hulls.num_vertices[row] <= config.hull.max_vertices:
            assert min(signed) >= -slices_m


@SWEEPS
@given(open_streets(), seeds)
def test_in_any_order_of_the_points_the_clear_vehicles_are_found_again(xyz, seed):
    boxes, _ = clear_boxes(run(xyz))
    assert_found_again(boxes, run(np.random.default_rng(seed).permutation(xyz)))


@SWEEPS
@given(open_streets(), st.floats(-np.pi, np.pi))
def test_clear_vehicles_turn_with_the_world(xyz, angle):
    boxes, _ = clear_boxes(run(xyz))
    world = run(np.column_stack([turned(xyz[:, :2], -angle), xyz[:, 2]]))
    expected = np.column_stack([turned(boxes[:, :2], -angle), boxes[:, 2:6], boxes[:, 6] + angle])
    assert_found_again(expected, world)


@SWEEPS
@given(open_streets(), st.floats(-1, 1), st.floats(-1, 1), st.floats(-0.5, 0.5))
def test_clear_vehicles_move_with_the_world(xyz, x, y, z):
    boxes, _ = clear_boxes(run(xyz))
    shift = np.array([x, y, z])
    expected = np.column_stack([boxes[:, :3] + shift, boxes[:, 3:]])
    assert_found_again(expected, run(xyz + shift))


# The camera.

_project = jax.jit(project_boxes)


@given(
    seed=seeds,
    center=st.tuples(st.floats(-15, 60), st.floats(-30, 30), st.floats(-4, 3)),
    size=st.tuples(st.floats(0.1, 12), st.floats(0.1, 4), st.floats(0.1, 4)),
    yaw=st.floats(-np.pi, np.pi),
)
def test_the_image_of_a_box_holds_the_images_of_the_points_in_it(seed, center, size, yaw):
    rng, calibration = np.random.default_rng(seed), make_calibration(seed=seed % 7)
    box = (np.float32(center)[None], np.float32(size)[None], np.float32(yaw)[None])
    image = _project(*box, calibration)
    local = rng.uniform(-0.5, 0.5, (300, 3)) * size
    xyz = np.column_stack([turned(local[:, :2], -yaw), local[:, 2]]) + center
    uvw = oracle_uvw(xyz, calibration)
    # Farther than the near plane, and far enough from it for float32 pixels.
    uvw = uvw[uvw[:, 2] > 0.2]
    uv = uvw[:, :2] / uvw[:, 2:]
    in_image = (uv > 0).all(axis=1) & (uv < np.asarray(calibration.image_size_px) - 1).all(axis=1)
    if in_image.any():
        left, top, right, bottom = np.asarray(image.boxes_px[0])
        assert bool(image.visible[0])
        assert (uv[in_image] >= np.array([left, top]) - 0.1).all()
        assert (uv[in_image] <= np.array([right, bottom]) + 0.1).all()


# Files.

finite = functools.partial(st.floats, allow_nan=False, allow_infinity=False)
angles = finite(-np.pi, np.pi)
KITTI_STEP = 5.1e-7
"""The files hold six decimals."""
objects = st.builds(
    KittiObject,
    type=st.sampled_from(["Car", "Van", "Truck", "Pedestrian", "Tram"]),
    truncation=finite(0, 1),
    occlusion=st.integers(-1, 3),
    alpha=angles,
    box_px=arrays(np.float64, 4, elements=finite(0, 2000)),
    height=finite(0, 20),
    width=finite(0, 20),
    length=finite(0, 40),
    location=arrays(np.float64, 3, elements=finite(-200, 200)),
    rotation_y=angles,
    score=st.none() | finite(0, 1, width=32),
)


@given(st.lists(objects, max_size=5))
def test_kitti_objects_written_and_read_are_the_objects_to_what_the_file_holds(tmp_path_factory, items):
    path = tmp_path_factory.getbasetemp() / "objects.txt"
    io.write_labels(path, items)
    again = io.read_labels(path)
    assert [(item.type, item.occlusion) for item in again] == [(item.type, item.occlusion) for item in items]
    for one, other in zip(again, items, strict=True):
        for name in ("truncation", "alpha", "box_px", "height", "width", "length", "location", "rotation_y"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=KITTI_STEP)
        assert (one.score is None) == (other.score is None)
        assert one.score is None or np.float32(one.score) == np.float32(other.score)
    # What a file holds it keeps.
    text = path.read_text()
    io.write_labels(path, again)
    assert path.read_text() == text


@st.composite
def configurations(draw):
    """Any preset with every threshold moved, and some of what is static."""
    config = DetectorConfig.presets()[draw(st.sampled_from(sorted(DetectorConfig.presets())))]
    values, structure = jax.tree.flatten(config)
    # Smaller, which no range forbids: a file with a number outside is refused.
    shares = draw(st.lists(finite(0.01, 1), min_size=len(values), max_size=len(values)))
    return jax.tree.unflatten(structure, [share * value for share, value in zip(shares, values, strict=True)])


@given(configurations(), st.sampled_from(sorted(DetectorConfig.presets())))
def test_settings_written_and_read_are_the_settings_from_any_base(config, base):
    assert config_from_toml(config_to_toml(config), base=DetectorConfig.presets()[base]) == config
