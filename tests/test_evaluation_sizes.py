"""Errors of size and direction: values worked by hand, degenerate input, the constant answer."""

import json

import numpy as np
import pytest

from jaxbox.evaluation import sizes

TRUE = np.array([[4.0, 1.6, 1.5], [5.0, 2.0, 2.0]])
ESTIMATED = np.array([[3.0, 1.6, 1.8], [5.5, 1.0, 2.0]])


def test_dimension_errors_are_those_worked_by_hand():
    errors = sizes.size_errors(ESTIMATED, TRUE)["length"]
    assert errors.num == 2
    assert errors.mae == pytest.approx(0.75)
    assert errors.rmse == pytest.approx(np.sqrt((1 + 0.25) / 2))
    assert errors.bias == pytest.approx(-0.25)
    assert errors.percent == pytest.approx((25 + 10) / 2)
    assert errors.pearson == pytest.approx(1)
    assert errors.mean_iou == pytest.approx((3 / 4 + 5 / 5.5) / 2)
    assert (errors.min_iou, errors.max_iou) == pytest.approx((3 / 4, 5 / 5.5))


def test_pooled_errors_are_over_all_three_dimensions():
    errors = sizes.size_errors(ESTIMATED, TRUE)
    assert errors["pooled"].num == 6
    means = [errors[name].mae for name in sizes.DIMENSIONS]
    assert errors["pooled"].mae == pytest.approx(np.mean(means))
    assert errors["pooled"].pearson == pytest.approx(np.corrcoef(ESTIMATED.ravel(), TRUE.ravel())[0, 1])
    assert errors["width"].pearson == pytest.approx(-1)


def test_exact_sizes_have_no_error():
    errors = sizes.size_errors(TRUE, TRUE)["pooled"]
    assert errors.mae == errors.rmse == errors.bias == errors.percent == 0
    assert errors.mean_iou == errors.min_iou == 1


def test_no_matches_give_none_and_not_nan():
    for errors in sizes.size_errors(np.zeros((0, 3)), np.zeros((0, 3))).values():
        assert errors.num == 0
        assert set(errors.to_dict().values()) == {0, None}


def test_correlation_is_none_where_one_side_does_not_vary():
    assert sizes.dimension_errors(np.full(3, 3.88), np.array([3.0, 4.0, 5.0])).pearson is None
    json.dumps(sizes.size_errors(sizes.constant_sizes(2), TRUE)["length"].to_dict(), allow_nan=False)


def test_the_constant_answers_the_median_car_for_every_label():
    """One car of median size but for .1 m in each dimension."""
    true = sizes.constant_sizes(1) + 0.1
    errors = sizes.size_errors(sizes.constant_sizes(1), true)["pooled"]
    assert errors.mae == errors.rmse == pytest.approx(0.1)
    assert errors.bias == pytest.approx(-0.1)


def test_bad_sizes_are_refused():
    with pytest.raises(ValueError, match="above 0"):
        sizes.dimension_errors(np.ones(2), np.array([1.0, -1.0]))
    with pytest.raises(ValueError, match="2 estimated"):
        sizes.dimension_errors(np.ones(2), np.ones(3))


@pytest.mark.parametrize(
    ("yaw_deg", "expected_deg"),
    [(0, 0), (10, 10), (-10, 10), (90, 90), (135, 45), (180, 0), (359, 1), (-725, 5)],
)
def test_axes_differ_by_at_most_a_right_angle_and_have_no_front(yaw_deg, expected_deg):
    for base in (0.0, 1.0, -2.0):
        difference = sizes.axis_differences(base + np.radians(yaw_deg), base)
        assert float(np.degrees(difference)) == pytest.approx(expected_deg, abs=1e-9)


def test_yaw_errors_count_swapped_axes():
    errors = sizes.yaw_errors(np.radians([1.0, -3.0, 182.0, 90.0]), np.zeros(4))
    assert errors.num_axis_swaps == 1
    assert errors.median_deg == pytest.approx(2.5)
    assert errors.p90_deg == pytest.approx(3 + 0.7 * 87)
    assert sizes.yaw_errors(np.zeros(0), np.zeros(0)) == sizes.YawErrors(0, None, None, 0)
