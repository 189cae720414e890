"""Laws of rows by group and by score, in both forms, against NumPy's stable sorts."""

import functools
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import parity
import pytest

from jaxbox.xla import rows, sorting

# 13 + 21 bits and 20 + 13 bits do not fit one word: those sort a key with its value.
SORTS = [(1, 1), (2, 1), (1000, 40), (3000, 3000), (4095, 2**20 - 1), (4096, 2**20), (2**19, 2**12)]


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(("size", "num_groups"), SORTS)
def test_sort_by_group_is_a_stable_sort_of_the_first_rows_on_every_platform(size, num_groups):
    num_used = min(num_groups, 40)
    group = np.random.default_rng(size).integers(0, num_used, size, np.int32) * (num_groups // num_used)
    sort = jax.jit(lambda n: sorting.sort_by_group(lambda i: (i, -i), group, n, num_groups, room=3))
    for num_rows in (0, 1, size * 7 // 10, size):
        (row, minus), begin, end = sort(jnp.int32(num_rows))
        assert row.shape == minus.shape == (size + 3,)
        np.testing.assert_array_equal(row[:num_rows], np.argsort(group[:num_rows], kind="stable"))
        np.testing.assert_array_equal(minus[:num_rows], -row[:num_rows])
        count = np.bincount(group[:num_rows], minlength=num_groups)
        np.testing.assert_array_equal(end, np.cumsum(count))
        np.testing.assert_array_equal(end - begin, count)


def test_both_sorts_of_sort_by_group_are_tried_above():
    def num_operands(size, num_groups):
        order = functools.partial(sorting._stable_order, num_groups=num_groups)
        jaxpr = jax.make_jaxpr(order)(jax.ShapeDtypeStruct((size,), jnp.int32))
        return [len(eqn.invars) for eqn in jaxpr.eqns if eqn.primitive.name == "sort"]

    assert [num_operands(*sort) for sort in SORTS] == [[1]] * 5 + [[2]] * 2


largest_first = parity.PerForm(sorting.largest_first, static_argnums=1)
compact_groups = parity.PerForm(sorting.compact_groups, static_argnums=2)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("max_size", [1, 9, 128])
def test_largest_first_is_a_stable_sort_by_descending_size_on_every_platform(max_size):
    size = np.random.default_rng(max_size).integers(0, max_size + 1, 700, np.int32)
    order, place = largest_first(size, max_size)
    np.testing.assert_array_equal(order, np.argsort(-size, kind="stable"))
    np.testing.assert_array_equal(order[place], np.arange(700))


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("capacities", [(3,), (1, 4), (100, 2, 1, 50)])
@pytest.mark.parametrize("density", [0.0, 0.4, 1.0])
def test_groups_are_compacted_each_to_its_capacity_and_joined(capacities, density):
    rng, size = np.random.default_rng(len(capacities)), 90
    for last in (1, 30, size):
        inner = np.sort(rng.integers(1, last + 1, len(capacities) - 1))
        first = np.array([1, *inner, last], np.int32)
        place = np.arange(size)
        keep = (rng.random(size) < density) & (place >= 1) & (place < last)
        found = [np.flatnonzero(keep[a:b]) + a for a, b in itertools.pairwise(first)]
        kept = [rows[:capacity] for rows, capacity in zip(found, capacities, strict=True)]
        member = np.concatenate(kept)
        row = np.full(size, sum(capacities))
        row[member] = np.arange(len(member))
        listed = compact_groups(keep, first, capacities)
        np.testing.assert_array_equal(listed.row, row)
        np.testing.assert_array_equal(listed.member[: len(member)], member)
        np.testing.assert_array_equal(listed.member[len(member) :], size)
        np.testing.assert_array_equal(listed.found, [len(rows) for rows in found])
        np.testing.assert_array_equal(listed.kept, [len(rows) for rows in kept])
        assert int(listed.num) == len(member)


@pytest.mark.usefixtures("platform")
def test_the_toolbox_gives_the_same_under_jit_and_vmap():
    masks = jnp.asarray(np.random.default_rng(5).random((4, 700)) < 0.3)

    def both(mask):
        index, count = rows.compact(mask, 64)
        order, begin, end = sorting.sort_by_group(lambda i: i, jnp.where(mask, 0, 1), jnp.sum(mask), 2)
        return index, count, order, begin, end

    single = jax.jit(both)
    singles = jax.tree.map(lambda *each: np.stack(each), *map(single, masks))
    for batch in (jax.vmap(single)(masks), jax.jit(jax.vmap(both))(masks)):
        chex.assert_trees_all_equal(batch, singles)


select_highest = parity.PerForm(sorting.select_highest, static_argnames="capacity")
best_first = parity.PerForm(sorting.best_first)

NUM_ROWS = 37
"""No whole number of the steps of `best_first`."""


def scores_of(kind):
    rng = np.random.default_rng(0)
    score = {
        "none": np.zeros(NUM_ROWS),
        "one": np.arange(NUM_ROWS) == 7,
        "the last": np.arange(NUM_ROWS) == NUM_ROWS - 1,
        "all the same": np.ones(NUM_ROWS),
        "ties": rng.integers(0, 5, NUM_ROWS) / 4,
        "all different": rng.permutation(NUM_ROWS) / NUM_ROWS,
        "some the least": np.where(rng.random(NUM_ROWS) < 0.5, LEAST, rng.random(NUM_ROWS)),
    }
    return score[kind].astype(np.float32)


LEAST = 0.25
KINDS = ("none", "one", "the last", "all the same", "ties", "all different", "some the least")


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("capacity", [1, 5, NUM_ROWS, NUM_ROWS + 4])
def test_the_highest_scores_above_the_least_are_selected_and_of_ties_the_first(kind, capacity):
    score = scores_of(kind)
    row, num = select_highest(score, capacity=capacity, min_score=np.float32(LEAST))
    above = np.flatnonzero(score > LEAST)
    assert int(num) == len(above)
    best = above[np.argsort(-score[above], kind="stable")][:capacity]
    assert row.shape == (capacity,)
    np.testing.assert_array_equal(row[: len(best)], np.sort(best))
    np.testing.assert_array_equal(row[len(best) :], NUM_ROWS)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("kind", KINDS)
def test_rows_with_a_score_come_best_first_and_of_ties_the_first_row_first(kind):
    score = scores_of(kind)
    num = rows.rows_in_use(jnp.asarray(score > 0))
    expected = np.argsort(-score, kind="stable")[: np.sum(score > 0)]
    order = best_first(score, num)
    np.testing.assert_array_equal(order[: len(expected)], expected)
    np.testing.assert_array_equal(order[len(expected) :], NUM_ROWS)
