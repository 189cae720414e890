"""Laws of pairs of rows and columns: taken as the least cost again and again."""

import jax
import numpy as np
import pytest

from jaxbox.xla import assignment

assign = jax.jit(assignment.assign_greedily)


def take_the_least_again_and_again(cost, allowed):
    """The law, spelled out."""
    cost = np.where(allowed, cost, np.inf).astype(float)
    columns = np.full(len(cost), cost.shape[1])
    while cost.size and np.isfinite(cost.min()):
        row, column = np.unravel_index(cost.argmin(), cost.shape)
        columns[row] = column
        cost[row], cost[:, column] = np.inf, np.inf
    return columns


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 1.0])
@pytest.mark.parametrize("digits", [0, 6], ids=["many ties", "no ties"])
def test_pairs_are_those_of_the_least_cost_again_and_again(share, digits):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        cost = rng.uniform(0, 9, (24, 17)).round(digits).astype(np.float32)
        allowed = rng.random(cost.shape) < share
        expected = take_the_least_again_and_again(cost, allowed)
        np.testing.assert_array_equal(assign(cost, allowed), expected)
        assert (expected < 17).any() == allowed.any()


def test_without_columns_no_row_has_one():
    assert (
        assignment.assign_greedily(np.zeros((3, 0), np.float32), np.zeros((3, 0), bool)).tolist() == [0] * 3
    )


def test_far_from_zero_costs_are_told_apart():
    cost = np.array([[-1e6, 5.0], [-1e6 - 1, 1e9]], np.float32)
    assert assign(cost, np.ones((2, 2), bool)).tolist() == [1, 0]
