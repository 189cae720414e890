"""Laws of the fixed-shape toolbox, against NumPy at every awkward size."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbox.xla import backend, loops, masked, sorting

SIZES = (1, 2, masked.BLOCK - 1, masked.BLOCK, masked.BLOCK + 1, 3 * masked.BLOCK + 7)

# Compiled whole: run step by step, each step of each size would compile alone.
compact = jax.jit(masked.compact, static_argnums=1)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", SIZES)
def test_prefix_sum_and_prefix_max_are_those_of_numpy_on_every_platform(size):
    values = np.random.default_rng(size).integers(-9, 9, size)
    total, num_positive, greatest = jax.jit(
        lambda v: (masked.prefix_sum(v), masked.prefix_sum(v > 0), masked.prefix_max(abs(v)))
    )(values)
    assert total.dtype == num_positive.dtype == jnp.int32
    np.testing.assert_array_equal(total, np.cumsum(values))
    np.testing.assert_array_equal(num_positive, np.cumsum(values > 0))
    np.testing.assert_array_equal(greatest, np.maximum.accumulate(abs(values)))


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", SIZES)
def test_count_and_greatest_are_those_of_numpy_on_every_platform(size):
    values = np.random.default_rng(size).normal(size=size).astype(np.float32)
    num, highest, floor = jax.jit(
        lambda v: (masked.count(v > 0), masked.greatest(v, -jnp.inf), masked.greatest(v, 9.0))
    )(values)
    assert num.dtype == jnp.int32
    assert int(num) == np.sum(values > 0)
    assert (float(highest), float(floor)) == (values.max(), 9.0)


def count_loops(function, *args, **options):
    """Loops of a jitted function's program for a CPU, and how many of them are native code.

    A loop whose step does too much for XLA to call it small takes a hundred times as long.
    """
    args = jax.tree.map(lambda a: jax.device_put(a, jax.devices("cpu")[0]), args)
    text = function.lower(*args, **options).compile().as_text()
    return text.count(" while("), text.count('xla_cpu_small_call="true"')


@pytest.mark.codegen
@pytest.mark.parametrize(
    "toolbox",
    [
        masked.prefix_sum,
        masked.prefix_max,
        lambda m: masked.compact(m > 0, 9),
        lambda m: masked.compact(m.reshape(4, -1) > 0, 9, num=m[0]),
        lambda m: masked.count(m > 0),
        lambda m: masked.greatest(m, 0),
    ],
)
def test_a_cpu_runs_the_toolbox_in_native_loops(toolbox):
    assert count_loops(jax.jit(toolbox), jnp.zeros(1000, jnp.int32)) == (1, 1)


@pytest.mark.codegen
def test_at_once_copies_numbers_in_one_native_loop():
    values = jnp.arange(float(loops.AT_ONCE))

    def at_once(values):
        return loops.at_once(lambda values: [v[0] for v in jnp.split(values, values.size)], values)

    assert at_once(values) == list(range(loops.AT_ONCE))
    assert count_loops(jax.jit(at_once), values) == (1, 1)


@pytest.mark.parametrize("size", SIZES)
def test_compact_lists_the_true_entries_in_order_and_then_the_sentinel(size):
    for density in (0.0, 0.3, 1.0):
        mask = np.random.default_rng(size).random(size) < density
        index, count = compact(mask, size + 3)
        expected = np.flatnonzero(mask)
        assert int(count) == len(expected)
        np.testing.assert_array_equal(index, np.append(expected, np.full(size + 3 - len(expected), size)))


@pytest.mark.parametrize("capacity", [1, 2, 40])
def test_compact_keeps_the_first_entries_and_reports_the_true_count(capacity):
    mask = np.random.default_rng(1).random(600) < 0.5
    index, count = compact(jnp.asarray(mask), capacity)
    assert int(count) == mask.sum() > capacity
    np.testing.assert_array_equal(index, np.flatnonzero(mask)[:capacity])


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", [1, 6, 7, 40])
def test_compact_goes_through_rows_as_far_as_they_count_on_every_platform(size):
    compact = jax.jit(lambda mask, num: masked.compact(mask, 3 * size + 1, num=num))
    for num in sorted({0, 1, size - 1, size, size + 5}):
        mask = np.random.default_rng(num).random((3, size)) < 0.6
        mask[:, num:] = False
        index, count = compact(mask, num)
        expected = np.flatnonzero(mask)
        assert int(count) == len(expected)
        np.testing.assert_array_equal(index, np.append(expected, [mask.size] * (len(index) - len(expected))))


def test_take_reads_rows_and_fills_those_that_are_absent():
    rows = jnp.arange(12.0).reshape(4, 3)
    picked = masked.take(rows, jnp.array([[3, 0], [4, 99]]))
    np.testing.assert_array_equal(picked, [[[9, 10, 11], [0, 1, 2]], [[0, 0, 0], [0, 0, 0]]])
    filled = masked.take(jnp.array([5, 6]), jnp.array([2, 1]), -7)
    assert filled.tolist() == [-7, 6]
    assert filled.dtype == jnp.int32
    assert masked.take(jnp.array([False, True]), jnp.array([1, 2])).tolist() == [True, False]


def test_take_after_compact_gathers_and_a_drop_scatter_puts_back():
    mask = jnp.asarray(np.random.default_rng(2).random(50) < 0.4)
    values = jnp.arange(50.0) + 1
    index, _ = compact(mask, 64)
    back = jnp.zeros(50).at[index].set(masked.take(values, index), mode="drop")
    np.testing.assert_array_equal(back, jnp.where(mask, values, 0))


@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_masked_mean_and_deviation_equal_numpy_over_the_masked_values(offset):
    rng = np.random.default_rng(3)
    values = (offset + rng.normal(size=(5, 200))).astype(np.float32)
    mask = rng.random((5, 200)) < np.array([[0.0], [0.02], [0.5], [0.9], [1.0]])
    mask[1, 7] = True
    mean, std = masked.masked_mean(values, mask), masked.masked_std(values, mask)
    assert float(mean[0]) == float(std[0]) == 0
    for row in range(1, 5):
        kept = values[row, mask[row]].astype(np.float64)
        np.testing.assert_allclose(mean[row], kept.mean(), rtol=1e-6, atol=1e-6)
        # In float32 values near 1000 are 6e-5 apart.
        np.testing.assert_allclose(std[row], kept.std(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("size", SIZES)
def test_count_true_counts_every_mask_also_where_all_are_true(size):
    rng = np.random.default_rng(size)
    masks = [rng.random(size) < density for density in (0.0, 0.2, 1.0, 1.0, 0.7)]
    assert masked.count_true(*map(jnp.asarray, masks)).tolist() == [mask.sum() for mask in masks]


@pytest.mark.codegen
@pytest.mark.parametrize("wall", ["store", "apart", "none"])
def test_what_stands_behind_a_wall_is_computed_once_for_all_who_read_it(wall, platform):
    walls = {"store": lambda x: loops.store(jnp.sin(x)), "apart": lambda x: loops.apart(jnp.sin, x)}
    sine = walls.get(wall, jnp.sin)

    def read_twice(x):
        y = sine(x)
        return jnp.cumsum(y + 1), 2 * y[::-1]

    x = jax.device_put(np.linspace(0, 9, 5000, dtype=np.float32), jax.devices("cpu")[0])
    program = jax.jit(read_twice).lower(x).compile()
    has_wall = not backend.on_accelerator() and wall in walls
    assert program.as_text().count(" sine(") == (1 if has_wall else 2)
    np.testing.assert_array_equal(program(x)[1], 2 * np.asarray(jnp.sin(x))[::-1])


@pytest.mark.parametrize("num_rows", [0, 1, 8, 19, 20])
def test_fold_rows_sees_each_row_once_and_no_chunk_beyond_those_that_count(num_rows, platform):
    def add(state, index, rows):
        total, seen = state
        return total + jnp.sum(rows), seen.at[index].add(1)

    start = jnp.int32(0), jnp.zeros(24, jnp.int32)
    rows, count = jnp.arange(20) + 1, jnp.int32(num_rows)
    total, seen = loops.fold_rows(add, start, rows, num_rows=count, chunk=8, absent=0)
    num_seen = -(-num_rows // 8) * 8 if platform == "cpu" else 20
    assert int(total) == num_rows * (num_rows + 1) // 2
    assert seen.tolist() == [1] * num_seen + [0] * (24 - num_seen)


@pytest.mark.parametrize("chunk", [1, 4, 16])
def test_map_rows_equals_the_function_on_all_rows_and_zero_beyond_the_last_chunk(chunk, platform):
    rows = {"a": jnp.arange(1.0, 11), "b": jnp.ones((10, 2), jnp.int32)}
    at_a_time = chunk if platform == "cpu" else 10

    def function(row):
        assert row["a"].shape == (at_a_time,)
        return row["a"][:, None] * row["b"].astype(jnp.float32), row["a"] > 3

    mapped = jax.jit(lambda num_rows: loops.map_rows(function, rows, num_rows=num_rows, chunk=chunk))
    values = np.arange(1.0, 11)
    for num_rows in (0, 1, 4, 5, 9, 10, 99):
        product, large = mapped(num_rows)
        done = np.arange(10) < (-(-min(num_rows, 10) // chunk) * chunk if platform == "cpu" else 10)
        np.testing.assert_array_equal(product, np.where(done, values, 0)[:, None] * np.ones(2))
        np.testing.assert_array_equal(large, done & (values > 3))


def test_map_rows_maps_along_the_last_axis_too(platform):
    values = jnp.arange(20.0).reshape(2, 10)
    mapped = loops.map_rows(lambda v: 2 * v, values, num_rows=jnp.int32(5), chunk=4, axis=-1)
    done = jnp.arange(10) < (8 if platform == "cpu" else 10)
    np.testing.assert_array_equal(mapped, jnp.where(done, 2 * values, 0))


# 13 + 21 bits and 20 + 13 bits do not fit one word: those sort a key with its value.
SORTS = [(1, 1), (2, 1), (1000, 40), (3000, 3000), (4095, 2**20 - 1), (4096, 2**20), (2**19, 2**12)]


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(("size", "num_groups"), SORTS)
def test_sort_by_group_is_a_stable_sort_of_the_first_rows_on_every_platform(size, num_groups):
    num_used = min(num_groups, 40)
    group = np.random.default_rng(size).integers(0, num_used, size, np.int32) * (num_groups // num_used)
    sort = jax.jit(lambda n: sorting.sort_by_group(lambda i: (i, -i), group, n, num_groups, room=3))
    for num_rows in (0, 1, size * 7 // 10, size):
        (rows, minus), begin, end = sort(jnp.int32(num_rows))
        assert rows.shape == minus.shape == (size + 3,)
        np.testing.assert_array_equal(rows[:num_rows], np.argsort(group[:num_rows], kind="stable"))
        np.testing.assert_array_equal(minus[:num_rows], -rows[:num_rows])
        count = np.bincount(group[:num_rows], minlength=num_groups)
        np.testing.assert_array_equal(end, np.cumsum(count))
        np.testing.assert_array_equal(end - begin, count)


def test_both_sorts_of_sort_by_group_are_tried_above():
    def num_operands(size, num_groups):
        order = functools.partial(sorting._stable_order, num_groups=num_groups)
        jaxpr = jax.make_jaxpr(order)(jax.ShapeDtypeStruct((size,), jnp.int32))
        return [len(eqn.invars) for eqn in jaxpr.eqns if eqn.primitive.name == "sort"]

    assert [num_operands(*sort) for sort in SORTS] == [[1]] * 5 + [[2]] * 2


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("max_size", [1, 9, 128])
def test_largest_first_is_a_stable_sort_by_descending_size_on_every_platform(max_size):
    size = np.random.default_rng(max_size).integers(0, max_size + 1, 700, np.int32)
    order, place = sorting.largest_first(jnp.asarray(size), max_size)
    np.testing.assert_array_equal(order, np.argsort(-size, kind="stable"))
    np.testing.assert_array_equal(order[place], np.arange(700))


@pytest.mark.parametrize(("reduce", "combine", "initial"), [("sum", jnp.add, 0), ("max", jnp.maximum, -7)])
def test_fold_points_takes_each_point_of_each_cluster_once(reduce, combine, initial, platform):
    x, y = np.random.default_rng(4).normal(size=(2, 6, 3)).astype(np.float32)

    def update(state, x, y):
        return combine(state, jnp.where(x < 9, jnp.stack([x, y]), initial))

    options = {"absent": (9.0, jnp.zeros(3)), "reduce": getattr(jnp, reduce)}
    init = jnp.full((2, 3), initial, jnp.float32)
    fold = jax.jit(lambda counts: loops.fold_points(x, y, counts, init, update, **options))
    for counts in ([0, 0, 0], [1, 0, 6], [6, 6, 6], [2, 9, 3]):
        found = fold(jnp.array(counts))
        for cluster, count in enumerate(np.minimum(counts, 6)):
            points = np.stack([x, y])[:, :count, cluster]
            expected = getattr(points, reduce)(axis=1, initial=initial)
            np.testing.assert_allclose(found[:, cluster], expected, atol=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 1.0])
@pytest.mark.parametrize("capacity", [1, 300, 2000])
def test_both_ways_to_compact_give_the_same(share, capacity):
    for size in (1, 31, 32, 1000):
        mask = jnp.asarray(np.random.default_rng(size).random(size) < share)
        one = masked._compact_one_by_one(mask[None], jnp.int32(size), capacity)
        other = masked._compact_at_once(mask, capacity)
        np.testing.assert_array_equal(one[0], other[0])
        assert int(one[1]) == int(other[1]) == int(mask.sum())


def test_the_toolbox_gives_the_same_under_jit_and_vmap():
    masks = jnp.asarray(np.random.default_rng(5).random((4, 700)) < 0.3)

    def both(mask):
        index, count = masked.compact(mask, 64)
        order, begin, end = sorting.sort_by_group(lambda i: i, jnp.where(mask, 0, 1), jnp.sum(mask), 2)
        return index, count, order, begin, end

    singles = [both(mask) for mask in masks]
    for batch in (jax.vmap(both)(masks), jax.jit(jax.vmap(both))(masks)):
        for row, single in enumerate(singles):
            for one, other in zip(single, batch, strict=True):
                np.testing.assert_array_equal(one, other[row])
