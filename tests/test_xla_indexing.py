"""Laws of look-ups and updates by index, in both forms, one by one and in batches."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbox.xla import indexing, rows

OPERATIONS = {"add": np.add, "max": np.maximum, "min": np.minimum}


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("shape", [(9,), (9, 3)])
@pytest.mark.parametrize("num_batched", [0, 1, 2])
def test_gathered_rows_are_those_at_the_indices_in_a_batch_too(shape, num_batched):
    rng = np.random.default_rng(len(shape))
    batch = (2, 4)[:num_batched]
    table = rng.normal(size=(*batch, *shape)).astype(np.float32)
    index = rng.integers(0, 9, (*batch, 5, 6), np.int32)
    gather = functools.partial(indexing.gather)
    for _ in batch:
        gather = jax.vmap(gather)
    expected = np.empty((*index.shape, *shape[1:]), np.float32)
    for one in np.ndindex(batch):
        expected[one] = table[one][index[one]]
    np.testing.assert_array_equal(jax.jit(gather)(table, index), expected)


@pytest.mark.usefixtures("platform")
def test_a_batch_of_more_rows_than_an_index_counts_is_the_same(monkeypatch):
    rng = np.random.default_rng(0)
    table, index = rng.normal(size=(4, 9)).astype(np.float32), rng.integers(0, 12, (4, 5), np.int32)

    def both(table, index):
        found = indexing.gather(table, jnp.minimum(index, 8))
        return found, indexing.scatter("max", table, index, 2 * found)

    few = jax.jit(jax.vmap(functools.partial(both)))(table, index)
    monkeypatch.setattr(indexing, "MAX_ROWS", 4 * 9 - 1)
    many = jax.jit(jax.vmap(functools.partial(both)))(table, index)
    jax.tree.map(np.testing.assert_array_equal, few, many)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(("of_rows", "of_index"), [(0, None), (None, 0)])
def test_a_batch_shares_the_rows_or_the_indices(of_rows, of_index):
    rng = np.random.default_rng(0)
    table = rng.normal(size=(3, 9) if of_rows == 0 else 9).astype(np.float32)
    index = rng.integers(0, 9, (3, 5) if of_index == 0 else 5, np.int32)
    found = jax.jit(jax.vmap(indexing.gather, (of_rows, of_index)))(table, index)
    np.testing.assert_array_equal(found, table[:, index] if of_rows == 0 else table[index])


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("operation", sorted(OPERATIONS))
@pytest.mark.parametrize("columns", [(), (3,)])
@pytest.mark.parametrize("num_batched", [0, 1, 2])
def test_updates_are_those_of_numpy_and_none_is_beyond_the_rows(operation, columns, num_batched):
    rng = np.random.default_rng(num_batched)
    batch = (2, 3)[:num_batched]
    # Whole numbers: their sums are exact in any order. Some indices are of no row, and not the next sweep's.
    table = rng.integers(-9, 9, (*batch, 6, *columns)).astype(np.float32)
    index = rng.integers(0, 9, (*batch, 40), np.int32)
    values = rng.integers(-9, 9, (*batch, 40, *columns)).astype(np.float32)
    update = functools.partial(indexing.scatter, operation)
    for _ in batch:
        update = jax.vmap(update)
    expected = table.copy()
    for one in np.ndindex(batch):
        inside = index[one] < 6
        OPERATIONS[operation].at(expected[one], index[one][inside], values[one][inside])
    np.testing.assert_array_equal(jax.jit(update)(table, index, values), expected)


@pytest.mark.usefixtures("platform")
def test_what_is_set_is_one_value_for_all_or_each_its_own_and_may_be_shared_by_a_batch():
    index = np.array([[1, 4, 9], [0, 0, 3]], np.int32)
    flags = jax.jit(jax.vmap(lambda i: indexing.scatter("set", jnp.zeros(5, bool), i, True)))(index)
    np.testing.assert_array_equal(flags, [[0, 1, 0, 0, 1], [1, 0, 0, 1, 0]])
    place = np.array([3, 1, 7], np.int32)
    rows_of = np.zeros((2, 4), np.int32)
    each = jax.jit(jax.vmap(lambda r: indexing.scatter("set", r, place, jnp.arange(3) + 5)))(rows_of)
    np.testing.assert_array_equal(each, [[0, 6, 0, 5]] * 2)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("columns", [(), (indexing.FEW_COLUMNS,), (indexing.FEW_COLUMNS + 1,), (2, 3)])
def test_take_fills_in_both_forms_and_in_batches(columns):
    rng = np.random.default_rng(0)
    table = rng.normal(size=(2, 7, *columns)).astype(np.float32)
    index = rng.integers(0, 10, (2, 4, 5), np.int32)
    padded = np.concatenate([table, np.full((2, 3, *columns), -7, np.float32)], axis=1)
    found = jax.jit(jax.vmap(lambda rows, index: indexing.take(rows, index, -7)))(table, index)
    np.testing.assert_array_equal(found, np.stack([padded[i][index[i]] for i in (0, 1)]))


def test_take_reads_rows_and_fills_those_that_are_absent():
    table = jnp.arange(12.0).reshape(4, 3)
    picked = indexing.take(table, jnp.array([[3, 0], [4, 99]]))
    np.testing.assert_array_equal(picked, [[[9, 10, 11], [0, 1, 2]], [[0, 0, 0], [0, 0, 0]]])
    filled = indexing.take(jnp.array([5, 6]), jnp.array([2, 1]), -7)
    assert filled.tolist() == [-7, 6]
    assert filled.dtype == jnp.int32
    assert indexing.take(jnp.array([False, True]), jnp.array([1, 2])).tolist() == [True, False]


@pytest.mark.usefixtures("platform")
def test_take_after_compact_gathers_and_a_drop_scatter_puts_back():
    mask = jnp.asarray(np.random.default_rng(2).random(50) < 0.4)
    values = jnp.arange(50.0) + 1
    index, _ = jax.jit(lambda mask: rows.compact(mask, 64))(mask)
    back = jnp.zeros(50).at[index].set(indexing.take(values, index), mode="drop")
    np.testing.assert_array_equal(back, jnp.where(mask, values, 0))


@pytest.mark.parametrize("shape", [(1,), (7,), (5, 3), (1, 1, 1), (4, 6, 5)])
@pytest.mark.parametrize("places", [(), (1,), (9,), (2, 4)])
def test_lookup_is_what_numpy_indexes(shape, places):
    rng = np.random.default_rng(len(shape))
    table = rng.normal(size=shape).astype(np.float32)
    index = [rng.integers(0, size, places, np.int32) for size in shape]
    found = indexing.lookup(jnp.asarray(table), *map(jnp.asarray, index))
    assert found.shape == places
    np.testing.assert_array_equal(found, table[tuple(index)])


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("shape", [(7,), (5, 3), (4, 6, 5)])
def test_the_same_entries_are_looked_up_in_each_table(shape):
    rng = np.random.default_rng(len(shape))
    tables = rng.normal(size=(3, *shape)).astype(np.float32)
    index = [rng.integers(0, size, (2, 4), np.int32) for size in shape]
    found = jax.jit(lambda tables, *index: indexing.lookup_each(list(tables), *index))(tables, *index)
    np.testing.assert_array_equal(found, tables[:, *index])


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("num_places", [1, 200])
def test_corners_are_the_entries_of_two_by_two_cells(num_places):
    rng = np.random.default_rng(num_places)
    table = rng.normal(size=(6, 9)).astype(np.float32)
    i, j = (rng.integers(0, size - 1, num_places, np.int32) for size in table.shape)
    i[-1], j[-1] = 4, 7
    found = jax.jit(functools.partial(indexing.lookup_corners))(table, i, j)
    expected = [table[i, j], table[i, j + 1], table[i + 1, j], table[i + 1, j + 1]]
    np.testing.assert_array_equal(found, expected)
    tables = np.stack([table, -table])
    batched = jax.jit(jax.vmap(indexing.lookup_corners))(tables, np.stack([i, i]), np.stack([j, j]))
    np.testing.assert_array_equal(batched, [(corner, -corner) for corner in expected])


@pytest.mark.parametrize("size", [1, 2, 1000])
@pytest.mark.parametrize("num_bits", [1, 14])
def test_a_pair_is_looked_up_as_its_two_numbers(size, num_bits):
    rng = np.random.default_rng(size)
    number, small = (rng.integers(0, 2**bits, size, np.int32) for bits in (31 - num_bits, num_bits))
    number[0], small[0], index = 2 ** (31 - num_bits) - 1, 2**num_bits - 1, rng.integers(0, size, (9, 7))
    packed = indexing.pack_pairs(jnp.asarray(number), jnp.asarray(small), num_bits)
    found = indexing.lookup_pair(packed, jnp.asarray(index, jnp.int32), num_bits)
    np.testing.assert_array_equal(found[0], number[index])
    np.testing.assert_array_equal(found[1], small[index])
