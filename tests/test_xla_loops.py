"""Laws of loops over the rows that count, and of barriers, in both forms."""

import contextlib
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_loops import count_loops

from jaxbox.xla import backend, barriers, chunks, loops

# Barriers.

TREE = {
    "float": np.array([np.nan, -0.0, 1.5], np.float32),
    "pair": (np.int32(7), np.zeros((2, 0), np.float32)),
    "flags": np.array([[True], [False]]),
}


def assert_same_tree(one, other):
    chex.assert_trees_all_equal_shapes_and_dtypes(one, other)
    chex.assert_trees_all_equal(one, other)


@pytest.mark.usefixtures("platform")
def test_materialize_and_store_are_the_identity():
    assert_same_tree(jax.jit(functools.partial(barriers.materialize))(TREE), TREE)
    assert_same_tree(jax.jit(functools.partial(barriers.store))(TREE), TREE)
    values = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(jax.jit(jax.vmap(lambda v: barriers.store(2 * v)))(values), 2 * values)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("shape", [(), (5,), (2, 0, 3)])
def test_opaque_zeros_are_zeros(shape):
    assert_same_tree(jax.jit(lambda: barriers.opaque_zeros(*shape))(), np.zeros(shape, np.float32))


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("call", [barriers.outline, barriers.single_kernel])
def test_an_outlined_function_or_one_in_a_single_kernel_gives_what_it_gives_when_called(call):
    def function(tree, offset):
        return {
            "sums": [tree["float"] + offset, jnp.sum(tree["flags"], dtype=jnp.int32)],
            "rest": tree["pair"],
        }

    called = jax.jit(lambda *operands: call(function, *operands))(TREE, np.float32(2))
    assert_same_tree(called, jax.jit(function)(TREE, np.float32(2)))
    assert_same_tree(jax.jit(lambda: call(lambda: jnp.arange(4)))(), jnp.arange(4))


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("call", [barriers.outline, barriers.single_kernel])
def test_barriers_do_the_same_to_each_of_a_batch(call):
    values = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    of_batch = jax.jit(jax.vmap(lambda v: barriers.materialize(call(lambda v: 2 * v, v))))(values)
    np.testing.assert_array_equal(of_batch, 2 * values)


@pytest.mark.codegen
def test_a_single_kernel_copies_numbers_in_one_native_loop():
    values = jnp.arange(float(chunks.SINGLE_KERNEL_NUMBERS))

    def cut_up(values):
        return barriers.single_kernel(lambda values: [v[0] for v in jnp.split(values, values.size)], values)

    assert cut_up(values) == list(range(chunks.SINGLE_KERNEL_NUMBERS))
    assert count_loops(jax.jit(cut_up), values) == (1, 1)


@pytest.mark.codegen
@pytest.mark.parametrize("wall", ["materialize", "outline", "none"])
def test_what_stands_behind_a_wall_is_computed_once_for_all_who_read_it(wall, platform):
    walls = {
        "materialize": lambda x: barriers.materialize(jnp.sin(x)),
        "outline": lambda x: barriers.outline(jnp.sin, x),
    }
    sine = walls.get(wall, jnp.sin)

    def read_twice(x):
        y = sine(x)
        return jnp.cumsum(y + 1), 2 * y[::-1]

    x = jax.device_put(np.linspace(0, 9, 5000, dtype=np.float32), jax.devices("cpu")[0])
    program = jax.jit(read_twice).lower(x).compile()
    has_wall = not backend.on_accelerator() and wall in walls
    assert program.as_text().count(" sine(") == (1 if has_wall else 2)
    np.testing.assert_array_equal(program(x)[1], 2 * np.asarray(jnp.sin(x))[::-1])


# Loops.


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("chunk", [1, 4, 7])
@pytest.mark.parametrize("capacity", [None, 10])
def test_for_chunks_takes_each_chunk_of_the_rows_that_count_once_and_in_turn(chunk, capacity):
    room = 40

    def visit(num_rows):
        counted = num_rows if capacity is None else jnp.minimum(num_rows, capacity)

        def step(start, state):
            digits, turn = state
            assert start.dtype == jnp.uint32
            there = start.astype(jnp.int32) < counted
            # Where no row counts, nothing must come of the chunk that is done unasked.
            digits = digits.at[turn].set(jnp.where(there, start.astype(jnp.int32), digits[turn]))
            return digits, turn + there.astype(jnp.int32)

        start = jnp.full(room, -1, jnp.int32), jnp.int32(0)
        return loops.for_chunks(num_rows, chunk, step, start, capacity=capacity)

    visit = jax.jit(visit)
    for num_rows in (0, 1, chunk, chunk + 1, 9, 10, 25):
        starts = list(range(0, num_rows if capacity is None else min(num_rows, capacity), chunk))
        digits, turns = visit(jnp.int32(num_rows))
        assert int(turns) == len(starts)
        assert digits.tolist() == starts + [-1] * (room - len(starts))


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


@pytest.mark.parametrize("size", [0, 1, 4, 7, 8])
@pytest.mark.parametrize("axis", [0, -1])
def test_whole_chunks_puts_zeros_after_the_last_row(size, axis):
    along = np.arange(1, size + 1)
    table = along[:, None] * [1.0, 2.0, 3.0] if axis == 0 else np.array([[1.0], [2.0], [3.0]]) * along
    rows = {"line": along.astype(np.int32), "table": table.astype(np.float32)}
    whole = jax.jit(lambda rows: loops.whole_chunks(rows, 4, axis))(rows)
    width = (0, -size % 4)
    chex.assert_trees_all_equal(
        whole,
        {
            "line": np.pad(rows["line"], [width]),
            "table": np.pad(rows["table"], [width, (0, 0)] if axis == 0 else [(0, 0), width]),
        },
    )


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", [1, 3, 8, 9])
def test_map_batches_is_vmap(size):
    values = np.random.default_rng(size).normal(size=(size, 5)).astype(np.float32)
    mapped = jax.jit(lambda rows: loops.map_batches(lambda row: row[::-1] - row[0], rows, chunk=4))(values)
    np.testing.assert_array_equal(mapped, values[:, ::-1] - values[:, :1])


@pytest.mark.parametrize(("together", "num_loops"), [(None, 0), (True, 0), (False, 1)])
def test_on_an_accelerator_rows_go_together_unless_the_caller_says_otherwise(
    together, num_loops, monkeypatch
):
    # Which concerns functions that scatter, as their callers know.
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_deterministic_ops=true")
    with backend.building_for(accelerator=True):
        mapped = jax.jit(lambda rows: loops.map_batches(lambda x: 2 * x, rows, chunk=1, together=together))
        assert mapped.lower(np.arange(3.0)).as_text().count("stablehlo.while") == num_loops


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("times", [0, 1, 5])
def test_repeat_applies_a_function_so_many_times(times):
    last = jax.jit(lambda state: loops.repeat(lambda s: (s[1], s[0] + s[1]), state, times))((1, 1))
    expected = [1, 1]
    for _ in range(times):
        expected = [expected[1], sum(expected)]
    assert [int(number) for number in last] == expected


@pytest.mark.usefixtures("platform")
def test_functions_are_applied_in_turn():
    functions = [lambda s: s + 1, lambda s: 3 * s, lambda s: s[::-1]]
    values = np.arange(6)
    for num in range(4):
        last = jax.jit(lambda state, num=num: loops.apply_in_turn(functions[:num], state))(values)
        expected = values
        for function in functions[:num]:
            expected = function(expected)
        np.testing.assert_array_equal(last, expected)


def test_sums_are_fast_along_the_first_axis_on_a_cpu_and_along_the_last_elsewhere(platform):
    assert loops.fast_axis() == (0 if platform == "cpu" else 1)


# What a program is built for.


def test_what_is_built_for_is_said_until_the_context_ends_and_then_jax_says_it():
    assert not backend.on_accelerator()
    with contextlib.suppress(KeyError), backend.building_for(accelerator=True):
        assert backend.on_accelerator()
        assert backend.on_accelerator(jnp.zeros(1))
        with backend.building_for(accelerator=False):
            assert not backend.on_accelerator()
        assert backend.on_accelerator()
        raise KeyError
    assert not backend.on_accelerator(jnp.zeros(1))


def test_an_array_is_on_a_device_unless_it_is_numpys_or_a_tracer():
    last = jax.local_devices()[-1]
    with jax.default_device(last):
        assert backend.default_device() == last
    assert backend.is_on_device(jnp.zeros(1))
    assert not backend.is_on_device(np.zeros(1))
    assert jax.jit(lambda x: jnp.bool_(backend.is_on_device(x)))(1.0).tolist() is False
    assert backend.platform_of(jnp.zeros(1)) == backend.platform_of(None) == jax.default_backend()


def test_a_batch_goes_together_on_an_accelerator_unless_its_scatters_are_deterministic(monkeypatch, platform):
    monkeypatch.setenv("XLA_FLAGS", "")
    assert backend.batch_together() == (platform == "accelerator")
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_deterministic_ops=true")
    assert not backend.batch_together()
