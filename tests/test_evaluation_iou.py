"""Overlaps of boxes: values worked by hand, and laws."""

import math

import numpy as np
import pytest

from jaxbox.evaluation import iou

BOX = np.array([20.0, 5.0, -1.0, 4.0, 2.0, 1.5, 0.3])


def moved(x=0.0, y=0.0, z=0.0):
    return BOX + np.array([x, y, z, 0, 0, 0, 0])


def test_equal_boxes_overlap_fully():
    bev, box = iou.pairwise_overlaps([BOX], [BOX])
    np.testing.assert_allclose([bev, box], 1, atol=1e-6)


@pytest.mark.parametrize(
    ("up", "expected"), [(0.0, 1.0), (0.5, 1 / 2), (-0.75, 1 / 3), (1.5, 0.0), (3.0, 0.0)]
)
def test_a_raised_box_loses_3d_overlap_only(up, expected):
    bev, box = iou.pairwise_overlaps([moved(z=up)], [BOX])
    np.testing.assert_allclose(bev, 1, atol=1e-6)
    np.testing.assert_allclose(box, expected, atol=1e-6)


def test_boxes_apart_do_not_overlap():
    bev, box = iou.pairwise_overlaps([moved(x=9)], [BOX])
    np.testing.assert_allclose([bev, box], 0, atol=1e-6)


def test_a_taller_box_overlaps_by_the_ratio_of_heights():
    taller = BOX.copy()
    taller[5] = 3.0
    bev, box = iou.pairwise_overlaps([taller], [BOX])
    np.testing.assert_allclose(bev, 1, atol=1e-6)
    np.testing.assert_allclose(box, 0.5, atol=1e-6)


def test_empty_boxes_overlap_nothing():
    empty = np.array([20.0, 5.0, -1.0, 0, 0, 0, 0.3])
    for a, b in ((empty, BOX), (BOX, empty), (empty, empty)):
        assert not np.any(iou.pairwise_overlaps([a], [b]))


def test_map_coordinates_lose_nothing():
    far = np.array([650_000.0, 4_800_000.0, 300.0, 0, 0, 0, 0])
    near = iou.pairwise_overlaps([moved(0.5, 0.2, 0.1)], [BOX])
    np.testing.assert_allclose(
        iou.pairwise_overlaps([moved(0.5, 0.2, 0.1) + far], [BOX + far]), near, atol=1e-6
    )


def test_pairs_are_the_diagonal_of_the_matrix_at_any_number():
    rng = np.random.default_rng(0)
    for count in (0, 1, 7, 40):
        a = moved() + rng.normal(0, 1, (count, 7)) * [2, 2, 0.5, 0.1, 0.1, 0.1, 1]
        b = moved() + rng.normal(0, 1, (count, 7)) * [2, 2, 0.5, 0.1, 0.1, 0.1, 1]
        pairs, matrix = iou.paired_overlaps(a, b), iou.pairwise_overlaps(a, b)
        for row, square in zip(pairs, matrix, strict=True):
            assert square.shape == (count, count)
            np.testing.assert_array_equal(row, np.diagonal(square))


def test_lists_of_other_shapes_are_refused():
    with pytest.raises(ValueError, match=r"\(P, 7\)"):
        iou.paired_overlaps(np.zeros((2, 7)), np.zeros((3, 7)))
    with pytest.raises(ValueError, match=r"\(P, 7\)"):
        iou.paired_overlaps(np.zeros((2, 5)), np.zeros((2, 5)))


def test_image_overlaps_are_those_worked_by_hand():
    boxes = np.array([[0.0, 0, 4, 2], [2, 0, 6, 2], [4, 0, 6, 2], [1, 1, 1, 1]])
    expected = [[1, 1 / 3, 0, 0], [1 / 3, 1, 1 / 2, 0], [0, 1 / 2, 1, 0], [0, 0, 0, 0]]
    np.testing.assert_allclose(iou.image_iou(boxes, boxes), expected)
    fractions = [[1, 1 / 2, 0, 0], [1 / 2, 1, 1 / 2, 0], [0, 1, 1, 0], [0, 0, 0, 0]]
    np.testing.assert_allclose(iou.image_fractions(boxes, boxes), fractions)
    assert iou.image_iou(np.zeros((0, 4)), boxes).shape == (0, 4)


def test_a_dimension_overlaps_by_the_shorter_over_the_longer():
    np.testing.assert_allclose(
        iou.dimension_iou(np.array([2.0, 4, 0, 0]), np.array([4.0, 2, 3, 0])), [0.5, 0.5, 0, 1]
    )


def test_two_boxes_overlap_in_height_by_what_they_share_of_it_wherever_they_stand():
    a = np.array([3.0, 7.0, 2.0, 4.0, 2.0, 1.0, 0.0])
    b = np.array([3.0, 7.0, 2.5, 4.0, 2.0, 2.0, 0.0])
    # From 1.5 to 2.5 m and from 1.5 to 3.5 m: one metre of two.
    bev, box = iou.box_overlaps(a, b)
    assert float(bev) == pytest.approx(1, abs=1e-6)
    assert float(box) == pytest.approx(0.5, abs=1e-6)
    assert float(iou.box_overlaps(b, a)[1]) == pytest.approx(0.5, abs=1e-6)


def test_boxes_of_less_than_a_unit_overlap_like_larger_ones():
    small = BOX * [1, 1, 1, 0.1, 0.1, 0.1, 1]
    shifted = small + np.array([0.1 * math.cos(0.3), 0.1 * math.sin(0.3), 0, 0, 0, 0, 0])
    bev, box = iou.pairwise_overlaps([shifted], [small])
    # A quarter of the length of 0.4 m along it: three of five parts are shared.
    np.testing.assert_allclose([bev, box], 0.6, atol=1e-4)
    pixels, beside = np.array([[0.0, 0, 0.5, 0.5]]), np.array([[0.25, 0, 0.75, 0.5]])
    np.testing.assert_allclose(iou.image_iou(pixels, beside), 1 / 3)
    np.testing.assert_allclose(iou.image_fractions(pixels, beside), 1 / 2)
    assert float(iou.dimension_iou(np.array(0.3), np.array(0.4))) == pytest.approx(0.75)


def test_frames_keep_their_own_boxes():
    rng = np.random.default_rng(0)
    frames = [
        (BOX + rng.normal(0, 0.5, (a, 7)), BOX + rng.normal(0, 0.5, (b, 7)))
        for a, b in ((2, 3), (0, 4), (1, 1), (3, 2))
    ]
    for (bev, box), (a, b) in zip(iou.framewise_overlaps(frames), frames, strict=True):
        assert bev.shape == box.shape == (len(a), len(b))
        for together, alone in zip((bev, box), iou.pairwise_overlaps(a, b), strict=True):
            np.testing.assert_array_equal(together, alone)
    assert iou.framewise_overlaps([]) == []
