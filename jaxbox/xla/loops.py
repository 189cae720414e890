"""Loops at a fixed shape over the rows that count."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.barriers import materialize


def for_chunks(
    num_rows: jax.Array,
    chunk: int,
    step: Callable[[jax.Array, Any], Any],
    state: Any,
    *,
    capacity: int | None = None,
) -> Any:
    """Calls a step with each chunk of the valid rows, one after the other.

    Law: ``for start in range(0, num_rows, chunk): state = step(start, state)``.

    The loop counts rows and not chunks, and without a sign: to divide, to multiply, and to look whether an
    index counts from the end would be a kernel each (XLA, CPU). On an accelerator the first chunk is
    processed without a test, since its host waits for each result: where no row counts, the step must do
    nothing.

    Args:
      num_rows: () int32, how many rows count.
      chunk: static, rows at a time.
      step: maps the first row () uint32 of a chunk, and the state, to the next state.
      state: pytree of arrays.
      capacity: static, how many rows there are, where `num_rows` may say more.

    Returns:
      The state after the last chunk.
    """
    end = jnp.uint32(num_rows)

    def more(loop: tuple[jax.Array, Any]) -> jax.Array:
        return loop[0] < end if capacity is None else (loop[0] < end) & (loop[0] < capacity)

    def turn(loop: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        start, state = loop
        return start + chunk, step(start, state)

    start = jnp.uint32(0), state
    return jax.lax.while_loop(more, turn, turn(start) if on_accelerator() else start)[1]


def map_rows(
    function: Callable[[Any], Any], rows: Any, *, num_rows: jax.Array, chunk: int = 1, axis: int = 0
) -> Any:
    """Applies a batched function to the first `num_rows` rows, a chunk at a time.

    Law: ``function(rows)``, on the rows that count.

    Work is proportional to the rows that are there, not to the capacity, and what a chunk needs
    stays in the cache. Row by row, XLA compiles the loop to native code on a CPU as long as a row reads and
    writes little: for some hundred rows that is as fast as a dozen kernels, and far less to compile. To look
    something up counts as reading all of the table: with a large one, each operation on each row would be a
    call. On an accelerator the function is called once, for all rows.

    Args:
      function: maps a pytree of (chunk, ...) arrays to another one.
      rows: pytree of (P, ...) arrays.
      num_rows: () int32, how many rows count.
      chunk: static, rows at a time on a CPU.
      axis: static, 0 or -1: the axis of all arrays along which the rows lie; -1 for (..., P) arrays.

    Returns:
      Pytree of (P, ...) arrays; rows of chunks beyond `num_rows` are zero on a CPU, and what the function
      makes of them on an accelerator.
    """
    if on_accelerator():
        return function(rows)
    function = jax.jit(function, inline=True)  # Traced once, for its shapes and for the loop.
    capacity = jax.tree.leaves(rows)[0].shape[axis]
    whole = whole_chunks(rows, chunk, axis)
    room = jax.tree.leaves(whole)[0].shape[axis]

    def part(start: jax.Array) -> Any:
        return jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, start, chunk, axis), whole)

    def step(start: jax.Array, out: Any) -> Any:
        new = function(part(start))
        return jax.tree.map(lambda o, n: jax.lax.dynamic_update_slice_in_dim(o, n, start, axis), out, new)

    def empty(shape: jax.ShapeDtypeStruct) -> jax.Array:
        size = list(shape.shape)
        size[axis] = room
        return jnp.zeros(size, shape.dtype)

    out = jax.tree.map(empty, jax.eval_shape(function, jax.eval_shape(part, jnp.uint32(0))))
    out = for_chunks(num_rows, chunk, step, out, capacity=capacity)
    if room == capacity:
        return out
    return jax.tree.map(lambda a: jax.lax.slice_in_dim(a, 0, capacity, axis=axis), out)


def whole_chunks(rows: Any, chunk: int, axis: int = 0) -> Any:
    """Puts zeros after the last row, so that the rows are whole chunks.

    Law: ``np.pad(rows, (0, -P % chunk))``, along the axis.

    Args:
      rows: pytree of arrays with P rows along the axis.
      chunk: static, rows at a time.
      axis: static, that of all arrays along which the rows lie.

    Returns:
      Pytree of arrays with P or up to ``chunk - 1`` more rows.
    """
    missing = -jax.tree.leaves(rows)[0].shape[axis] % chunk

    def extended(a: jax.Array) -> jax.Array:
        width = [(0, 0)] * a.ndim
        width[axis] = (0, missing)
        return jnp.pad(a, width)

    return jax.tree.map(extended, rows) if missing else rows


def fold_rows(
    update: Callable[[Any, jax.Array, Any], Any],
    state: Any,
    rows: Any,
    *,
    num_rows: jax.Array,
    absent: Any,
    chunk: int = 1,
) -> Any:
    """Folds rows into a state, chunk by chunk, and skips chunks beyond the rows that count.

    Law: `update` sees each row that counts once, with its index, in order.

    Row by row, the loop is native code on a CPU, see `map_rows`. On an accelerator all rows are one chunk.

    Args:
      update: maps the state, the indices of the rows of a chunk, and those rows, a pytree of (chunk,)
        arrays, to the next state.
      state: pytree of arrays.
      rows: pytree of (P,) arrays.
      num_rows: () int32, how many rows count.
      absent: pytree of numbers, what the last chunk holds beyond the rows that count: such that `update`
        makes nothing of it.
      chunk: static, rows at a time on a CPU.

    Returns:
      The state after the last chunk.
    """
    size = jax.tree.leaves(rows)[0].shape[0]
    num_rows = jnp.minimum(num_rows, size)

    def fold(state: Any, index: jax.Array, rows: Any) -> Any:
        valid = index < num_rows
        return update(state, index, jax.tree.map(lambda a, none: jnp.where(valid, a, none), rows, absent))

    if on_accelerator():
        return fold(state, jnp.arange(size, dtype=jnp.int32), rows)
    whole = whole_chunks(rows, chunk)

    def step(start: jax.Array, state: Any) -> Any:
        index = start.astype(jnp.int32) + jnp.arange(chunk, dtype=jnp.int32)
        return fold(
            state, index, jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, start, chunk), whole)
        )

    return for_chunks(num_rows, chunk, step, state)


def map_batches(
    function: Callable[[Any], Any], rows: Any, *, chunk: int, together: bool | None = None
) -> Any:
    """Applies a function to all rows, a chunk at a time on a CPU. Law: `jax.vmap(function)(rows)`.

    Args:
      function: of one row.
      rows: pytree of (P, ...) arrays.
      chunk: static, rows at a time; a single one is not batched, so that its scatters stay as fast.
      together: static, whether all rows are taken at once; None for on an accelerator. A function that
        scatters asks `batch_together`.

    Returns:
      Pytree of (P, ...) arrays.
    """
    if on_accelerator() if together is None else together:
        return jax.vmap(function)(rows)
    return jax.lax.map(function, rows, batch_size=None if chunk == 1 else chunk)


def repeat(function: Callable[[Any], Any], state: Any, times: int) -> Any:
    """Applies a function a number of times. Law: ``f(f(... f(state)))``.

    Args:
      function: of the state.
      state: pytree of arrays.
      times: static.

    Returns:
      The last state.
    """
    if on_accelerator():
        return functools.reduce(lambda state, _: function(state), range(times), state)
    return jax.lax.scan(lambda state, _: (function(state), None), state, length=times)[0]


def apply_in_turn(functions: Sequence[Callable[[Any], Any]], state: Any) -> Any:
    """Applies functions one after the other. Law: ``functions[-1](... functions[0](state))``.

    Each result is materialized, or the compiler would compute each cell again for every reader of the next.

    Args:
      functions: of the state.
      state: pytree of arrays.

    Returns:
      The last state.
    """
    return functools.reduce(lambda state, function: materialize(function(state)), functions, state)


def fast_axis() -> int:
    """The axis of a table (items, rows) or (rows, items) along which sums over the items are fast.

    Sums along the first axis vectorise on a CPU; on an accelerator those along the last are the faster ones.

    Returns:
      0 for a CPU, 1 for an accelerator.
    """
    return 1 if on_accelerator() else 0
