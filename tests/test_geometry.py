"""Laws of the plane geometry: angles, corners, and the overlap of oriented rectangles."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbox.geometry import planar

iou = jax.jit(jax.vmap(planar.rectangle_iou))
pair_iou = jax.jit(planar.rectangle_iou)
CAR = jnp.array([30.0, -12.0, 3.9, 1.6, 0.4])


def random_boxes(seed: int, count: int, spread_m: float = 4.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [
            40.0 + rng.uniform(-spread_m, spread_m, count),
            -25.0 + rng.uniform(-spread_m, spread_m, count),
            rng.uniform(0.3, 12.0, count),
            rng.uniform(0.3, 4.0, count),
            rng.uniform(-4.0, 4.0, count),
        ]
    ).astype(np.float32)


def corners(box: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(box[4]), np.sin(box[4])
    local = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * box[2:4] / 2
    return local @ np.array([[cos, sin], [-sin, cos]]) + box[:2]


def clipped(polygon: list[np.ndarray], start: np.ndarray, end: np.ndarray) -> list[np.ndarray]:
    """The part of a polygon left of a line (Sutherland and Hodgman 1974)."""
    (dx, dy), kept = end - start, []
    sides = [dx * (p[1] - start[1]) - dy * (p[0] - start[0]) for p in polygon]
    for i in range(len(polygon)):
        p, q, side, next_side = polygon[i - 1], polygon[i], sides[i - 1], sides[i]
        if side * next_side < 0:
            kept.append(p + (q - p) * side / (side - next_side))
        if next_side >= 0:
            kept.append(q)
    return kept


def clipped_iou(box_a: np.ndarray, box_b: np.ndarray) -> float:
    """Polygon clipping in float64."""
    box_a, box_b = box_a.astype(float), box_b.astype(float)
    polygon, window = list(corners(box_a)), corners(box_b)
    for i in range(4):
        polygon = clipped(polygon, window[i - 1], window[i])
    shared = 0.0
    if polygon:
        x, y = (np.array(polygon) - box_b[:2]).T
        shared = float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)
    return shared / (np.prod(box_a[2:4]) + np.prod(box_b[2:4]) - shared)


def opencv_iou(box_a: np.ndarray, box_b: np.ndarray) -> float:
    """OpenCV's own clipping, relative to one centre as it works in float32."""
    a, b = (
        (tuple(map(float, box[:2] - box_b[:2])), tuple(map(float, box[2:4])), float(np.degrees(box[4])))
        for box in (box_a, box_b)
    )
    _, vertices = cv2.rotatedRectangleIntersection(a, b)
    shared = 0.0 if vertices is None else cv2.contourArea(cv2.convexHull(vertices))
    return shared / (float(np.prod(box_a[2:4])) + float(np.prod(box_b[2:4])) - shared)


@pytest.mark.parametrize("seed", range(5))
def test_rectangle_iou_agrees_with_polygon_clipping(seed):
    a, b = random_boxes(seed, 500), random_boxes(seed + 100, 500)
    expected = [clipped_iou(*pair) for pair in zip(a, b, strict=True)]
    assert np.count_nonzero(expected) > 150
    np.testing.assert_allclose(iou(a, b), expected, atol=1e-5)


@pytest.mark.parametrize("noise", [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
def test_rectangle_iou_of_nearly_equal_boxes_agrees_with_polygon_clipping(noise):
    a = random_boxes(11, 300)
    b = (a + np.random.default_rng(12).normal(0, noise, a.shape)).astype(np.float32)
    expected = [clipped_iou(*pair) for pair in zip(a, b, strict=True)]
    np.testing.assert_allclose(iou(a, b), expected, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_rectangle_iou_agrees_with_opencv(seed):
    a, b = random_boxes(seed, 1000), random_boxes(seed + 100, 1000)
    expected = [opencv_iou(*pair) for pair in zip(a, b, strict=True)]
    error = np.abs(np.asarray(iou(a, b)) - expected)
    # OpenCV merges vertices that it takes for equal, which costs it up to 0.01 on a few pairs in a thousand.
    assert np.mean(error < 1e-4) > 0.99
    assert error.max() < 0.02


def test_rectangle_iou_is_one_for_equal_boxes():
    boxes = random_boxes(7, 1000, spread_m=80)
    np.testing.assert_allclose(iou(boxes, boxes), 1, atol=1e-5)


def test_rectangle_iou_is_one_for_the_same_box_with_its_axes_swapped_or_reversed():
    boxes = random_boxes(8, 1000)
    swapped = np.column_stack([boxes[:, :2], boxes[:, [3, 2]], boxes[:, 4] + np.float32(np.pi / 2)])
    turned = boxes + np.float32([0, 0, 0, 0, np.pi])
    np.testing.assert_allclose(iou(boxes, swapped), 1, atol=1e-5)
    np.testing.assert_allclose(iou(boxes, turned), 1, atol=1e-5)


def test_rectangle_iou_is_symmetric():
    a, b = random_boxes(1, 2000), random_boxes(2, 2000)
    np.testing.assert_allclose(iou(a, b), iou(b, a), atol=2e-6)


@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 4, np.pi / 2, 2.0])
@pytest.mark.parametrize(
    ("shift", "size", "expected"),
    [
        ((2.0, 0.0), (4.0, 2.0), 1 / 3),  # shares both long edges
        ((4.0, 0.0), (4.0, 2.0), 0.0),  # touches along an edge
        ((4.0, 2.0), (4.0, 2.0), 0.0),  # touches at a corner
        ((0.0, 0.0), (2.0, 1.0), 1 / 4),  # contained
        ((1.0, 0.5), (2.0, 1.0), 1 / 4),  # contained, sharing two edges
        ((0.0, 0.0), (8.0, 1.0), 1 / 3),  # a cross
        ((9.0, 0.0), (4.0, 2.0), 0.0),  # apart
        ((0.0, 9.0), (4.0, 2.0), 0.0),
    ],
)
def test_rectangle_iou_of_parallel_boxes_is_that_computed_by_hand(turn, shift, size, expected):
    offset = np.asarray(planar.rotate(jnp.array(shift), jnp.float32(turn)))
    a = jnp.array([50.0, 20.0, 4.0, 2.0, turn])
    b = jnp.array([50.0 + offset[0], 20.0 + offset[1], *size, turn])
    np.testing.assert_allclose(pair_iou(a, b), expected, atol=1e-5)
    np.testing.assert_allclose(pair_iou(b, a), expected, atol=1e-5)


def test_rectangle_iou_is_finite_and_zero_where_a_box_has_no_area():
    point = CAR.at[2:4].set(0)
    line = CAR.at[3].set(0)
    for a in (point, line):
        for b in (point, line, CAR):
            assert float(pair_iou(a, b)) == 0
            assert float(pair_iou(b, a)) == 0


def test_rectangle_iou_does_not_change_when_the_scene_is_turned_and_moved():
    a, b = random_boxes(3, 1000), random_boxes(4, 1000)
    turn, shift = 1.1, np.float32([30, -60])

    def moved(boxes: np.ndarray) -> np.ndarray:
        xy = np.asarray(planar.rotate(boxes[:, :2], jnp.full(len(boxes), turn))) + shift
        return np.column_stack([xy, boxes[:, 2:4], boxes[:, 4] + np.float32(turn)])

    # Turning about a far origin rounds coordinates of about 100 m to some 1e-5 m.
    np.testing.assert_allclose(iou(a, b), iou(moved(a), moved(b)), atol=1e-4)


def test_rectangle_iou_of_a_pair_equals_that_pair_in_a_batch():
    a, b = random_boxes(5, 8), random_boxes(6, 8)
    matrix = jax.jit(jax.vmap(jax.vmap(planar.rectangle_iou, (None, 0)), (0, None)))(a, b)
    single = [[float(planar.rectangle_iou(p, q)) for q in jnp.asarray(b)] for p in jnp.asarray(a)]
    np.testing.assert_allclose(matrix, single, atol=1e-6)


def test_rectangle_intersection_never_exceeds_the_smaller_box():
    a, b = random_boxes(9, 5000), random_boxes(10, 5000)
    shared = np.asarray(jax.jit(jax.vmap(planar.rectangle_intersection))(a, b))
    smaller = np.minimum(a[:, 2] * a[:, 3], b[:, 2] * b[:, 3])
    assert (shared >= 0).all()
    assert (shared <= smaller * (1 + 1e-6)).all()


def test_wrap_yaw_is_half_open_and_keeps_the_axis():
    yaw = jnp.linspace(-20, 20, 4001)
    wrapped = planar.wrap_yaw(yaw)
    assert float(wrapped.min()) >= -np.pi / 2
    assert float(wrapped.max()) < np.pi / 2
    np.testing.assert_allclose(jnp.cos(2 * wrapped), jnp.cos(2 * yaw), atol=1e-4)
    assert float(planar.wrap_yaw(jnp.float32(np.pi / 2))) == pytest.approx(-np.pi / 2)


def test_wrap_yaw_beside_its_seam_is_in_range_but_for_the_last_bit():
    seam = np.float32(np.pi * np.arange(-2, 2) + np.pi / 2)
    yaw = [seam]
    for direction in (-np.inf, np.inf):
        beside = seam
        for _ in range(6):
            beside = np.nextafter(beside, np.float32(direction))
            yaw.append(beside)
    wrapped = np.asarray(jax.jit(planar.wrap_yaw)(np.stack(yaw)))
    half = np.float32(np.pi / 2)
    assert wrapped.min() >= np.nextafter(-half, np.float32(-np.inf))
    assert wrapped.max() < half
    np.testing.assert_allclose(np.abs(wrapped), half, atol=1e-5)


def test_rotate_is_counter_clockwise():
    np.testing.assert_allclose(planar.rotate(jnp.array([1.0, 0.0]), jnp.pi / 2), [0, 1], atol=1e-6)


def test_rectangle_corners_run_counter_clockwise_from_front_left():
    corners = planar.rectangle_corners(jnp.array([10.0, 0.0]), jnp.array([4.0, 2.0]), jnp.float32(0))
    np.testing.assert_allclose(corners, [[12, 1], [8, 1], [8, -1], [12, -1]], atol=1e-6)
    x, y = np.asarray(corners).T
    assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2 == pytest.approx(8)
