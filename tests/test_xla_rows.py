"""Laws of rows at a fixed shape, in both forms, against NumPy at every awkward size."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import parity
import pytest
from native_loops import count_loops

from jaxbox.xla import chunks, rows

BLOCK = chunks.SUM_BLOCK
SIZES = (1, 2, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 7)

# Compiled whole: run step by step, each step of each size would compile alone.
compact = parity.PerForm(rows.compact, static_argnums=1)
compact_sequential = jax.jit(rows._compact_sequential, static_argnums=2)
compact_parallel = jax.jit(rows._compact_parallel, static_argnums=1)
running_sum = jax.jit(rows.running_sum, static_argnums=1)
count_each = jax.jit(rows.count_each)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", SIZES)
def test_prefix_sum_and_prefix_max_are_those_of_numpy_on_every_platform(size):
    values = np.random.default_rng(size).integers(-9, 9, size)
    total, num_positive, greatest = jax.jit(
        lambda v: (rows.prefix_sum(v), rows.prefix_sum(v > 0), rows.prefix_max(abs(v)))
    )(values)
    assert total.dtype == num_positive.dtype == jnp.int32
    np.testing.assert_array_equal(total, np.cumsum(values))
    np.testing.assert_array_equal(num_positive, np.cumsum(values > 0))
    np.testing.assert_array_equal(greatest, np.maximum.accumulate(abs(values)))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("dtype", [np.int32, np.uint32])
def test_running_sums_are_those_of_numpy_along_either_axis(dtype, size):
    values = np.random.default_rng(size).integers(0, 9, (size, 3)).astype(dtype)
    for axis in (0, 1):
        total = running_sum(values, axis)
        assert total.dtype == dtype
        np.testing.assert_array_equal(total, np.cumsum(values, axis=axis))
    batch = jax.vmap(functools.partial(rows.running_sum, axis=0))(jnp.asarray(values))
    np.testing.assert_array_equal(batch, np.cumsum(values, axis=1))


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", SIZES)
def test_count_true_and_maximum_are_those_of_numpy_on_every_platform(size):
    values = np.random.default_rng(size).normal(size=size).astype(np.float32)
    num, highest, floor = jax.jit(
        lambda v: (rows.count_true(v > 0), rows.maximum(v, -jnp.inf), rows.maximum(v, 9.0))
    )(values)
    assert num.dtype == jnp.int32
    assert int(num) == np.sum(values > 0)
    assert (float(highest), float(floor)) == (values.max(), 9.0)


@pytest.mark.codegen
@pytest.mark.parametrize(
    "toolbox",
    [
        rows.prefix_sum,
        rows.prefix_max,
        lambda m: rows.compact(m > 0, 9),
        lambda m: rows.compact(m.reshape(4, -1) > 0, 9, num=m[0]),
        lambda m: rows.count_true(m > 0),
        lambda m: rows.maximum(m, 0),
        lambda m: rows.rows_in_use(m > 0),
    ],
)
def test_a_cpu_runs_the_toolbox_in_native_loops(toolbox):
    assert count_loops(jax.jit(toolbox), jnp.zeros(1000, jnp.int32)) == (1, 1)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", SIZES)
def test_compact_lists_the_true_entries_in_order_and_then_the_sentinel(size):
    for density in (0.0, 0.3, 1.0):
        mask = np.random.default_rng(size).random(size) < density
        index, count = compact(mask, size + 3)
        expected = np.flatnonzero(mask)
        assert int(count) == len(expected)
        np.testing.assert_array_equal(index, np.append(expected, np.full(size + 3 - len(expected), size)))


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("capacity", [1, 2, 40])
def test_compact_keeps_the_first_entries_and_reports_the_true_count(capacity):
    mask = np.random.default_rng(1).random(600) < 0.5
    index, count = compact(jnp.asarray(mask), capacity)
    assert int(count) == mask.sum() > capacity
    np.testing.assert_array_equal(index, np.flatnonzero(mask)[:capacity])


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", [1, 6, 7, 40])
def test_compact_goes_through_rows_as_far_as_they_count_on_every_platform(size):
    compact = jax.jit(lambda mask, num: rows.compact(mask, 3 * size + 1, num=num))
    for num in sorted({0, 1, size - 1, size, size + 5}):
        mask = np.random.default_rng(num).random((3, size)) < 0.6
        mask[:, num:] = False
        index, count = compact(mask, num)
        expected = np.flatnonzero(mask)
        assert int(count) == len(expected)
        np.testing.assert_array_equal(index, np.append(expected, [mask.size] * (len(index) - len(expected))))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 1.0])
@pytest.mark.parametrize("capacity", [1, 300, 2000])
def test_both_ways_to_compact_give_the_same(share, capacity):
    for size in (1, 31, 32, 1000):
        mask = jnp.asarray(np.random.default_rng(size).random(size) < share)
        one = compact_sequential(mask[None], jnp.int32(size), capacity)
        other = compact_parallel(mask, capacity)
        np.testing.assert_array_equal(one[0], other[0])
        assert int(one[1]) == int(other[1]) == int(mask.sum())


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", [1, 5, 40])
def test_rows_in_use_end_with_the_last_that_is_present(size):
    in_use = jax.jit(functools.partial(rows.rows_in_use))
    assert int(in_use(np.zeros(size, bool))) == 0
    for last in range(size):
        present = np.random.default_rng(last).random(size) < 0.3
        present[last:] = [True] + [False] * (size - last - 1)
        assert int(in_use(present)) == last + 1


@pytest.mark.usefixtures("platform")
def test_stored_columns_are_the_columns():
    table = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    np.testing.assert_array_equal(jax.jit(functools.partial(rows.stored_columns))(table), table.T)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("density", [0.0, 0.5, 1.0])
def test_rows_that_are_not_kept_are_zeros_whatever_they_hold(density):
    rng = np.random.default_rng(0)
    values, keep = rng.normal(size=(50, 4)).astype(np.float32), rng.random(50) < density
    values[~keep] = np.nan
    kept = jax.jit(functools.partial(rows.keep_rows))(values, keep)
    np.testing.assert_array_equal(kept, np.where(keep[:, None], values, 0))


@pytest.mark.parametrize("size", [1, 2, 7, 2**20])
def test_split_index_is_divmod(size):
    index = np.append(np.random.default_rng(size).integers(0, 2**31, 50), [0, size - 1, size, 2**31 - 1])
    quotient, remainder = rows.split_index(jnp.asarray(index, jnp.int32), size)
    np.testing.assert_array_equal(quotient, index // size)
    np.testing.assert_array_equal(remainder, index % size)


@pytest.mark.parametrize("size", SIZES)
def test_count_each_counts_every_mask_also_where_all_are_true(size):
    rng = np.random.default_rng(size)
    masks = [rng.random(size) < density for density in (0.0, 0.2, 1.0, 1.0, 0.7)]
    assert count_each(*masks).tolist() == [mask.sum() for mask in masks]


def test_count_each_takes_any_number_of_masks_of_any_sizes():
    masks = [np.arange(size) % 3 == 0 for size in (1, 32, 33, 1000, 2, 64, 31)]
    for num in range(1, 8):
        counts = count_each(*masks[:num])
        assert counts.dtype == jnp.int32
        assert counts.tolist() == [mask.sum() for mask in masks[:num]]


@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_masked_mean_and_deviation_equal_numpy_over_the_masked_values(offset):
    rng = np.random.default_rng(3)
    values = (offset + rng.normal(size=(5, 200))).astype(np.float32)
    mask = rng.random((5, 200)) < np.array([[0.0], [0.02], [0.5], [0.9], [1.0]])
    mask[1, 7] = True
    mean, std = rows.masked_mean(values, mask), rows.masked_std(values, mask)
    assert float(mean[0]) == float(std[0]) == 0
    for row in range(1, 5):
        kept = values[row, mask[row]].astype(np.float64)
        np.testing.assert_allclose(mean[row], kept.mean(), rtol=1e-6, atol=1e-6)
        # In float32 values near 1000 are 6e-5 apart.
        np.testing.assert_allclose(std[row], kept.std(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (8, 1), (50, 30)])
@pytest.mark.parametrize("kind", ["different", "ties", "the same", "infinite"])
def test_first_argmax_is_that_of_numpy_and_of_ties_the_first_row(shape, kind):
    rng = np.random.default_rng(5)
    values = {
        "different": rng.normal(size=shape),
        "ties": rng.integers(0, 4, shape),
        "the same": np.zeros(shape),
        "infinite": np.full(shape, -np.inf),
    }[kind].astype(np.float32)
    row, greatest = rows.first_argmax(jnp.asarray(values))
    assert row.dtype == jnp.int32
    np.testing.assert_array_equal(row, values.argmax(axis=0))
    np.testing.assert_array_equal(greatest, values.max(axis=0))


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("chunk", [1, 4, 30])
def test_map_selected_gives_the_function_of_the_selected_rows_at_their_index(chunk):
    columns = {"a": np.arange(1.0, 24, dtype=np.float32), "b": np.arange(46, dtype=np.int32).reshape(23, 2)}

    def of_selected(columns, chosen, num_rows):
        return rows.map_selected(
            lambda part: part["a"][:, None] * part["b"].astype(jnp.float32),
            columns,
            lambda: chosen,
            num_rows=num_rows,
            absent={"a": 0, "b": 0},
            chunk=chunk,
        )

    of_selected = jax.jit(of_selected)
    for num_rows in (0, 1, 4, 22, 23):
        chosen = (np.random.default_rng(num_rows).random(23) < 0.5) & (np.arange(23) < num_rows)
        index, values, num = of_selected(columns, chosen, np.int32(num_rows))
        counts = np.asarray(index)[: int(num)]
        assert set(np.flatnonzero(chosen)) <= set(counts)
        expected = columns["a"][counts, None] * columns["b"][counts]
        np.testing.assert_array_equal(values[: int(num)], expected)


@pytest.mark.parametrize("size", [1, 2, 33])
def test_sum_after_is_exact_for_whole_numbers(size):
    values = np.random.default_rng(size).integers(0, 2000, (7, size))
    after = jax.jit(rows.sum_after)(values.astype(np.float32))
    np.testing.assert_array_equal(after, values.sum(axis=1, keepdims=True) - values.cumsum(axis=1))
