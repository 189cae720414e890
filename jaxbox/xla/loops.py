"""Loops over rows and points at a fixed shape, and walls between what XLA would else work out twice."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox.xla.backend import on_accelerator

AT_ONCE = 62
"""Numbers that `at_once` may copy: what reads and writes more than a kilobyte is no small loop to XLA."""

FOLD_UNROLL = 4
"""Points folded in one step of the loop over them, on a CPU."""


def store(values: Any) -> Any:
    """Has values computed once and stored, where the compiler would compute them in every reader.

    XLA fuses a producer into each of its consumers. A loop is a wall that fusion does not cross, even one of
    no turn: barriers keep the compiler from seeing that it has none, and that a turn would change nothing.
    (A conditional would copy what goes through it.) There are no walls on an accelerator, whose host would
    wait at each.

    Args:
      values: pytree of arrays.

    Returns:
      The values.
    """
    if on_accelerator():
        return values
    never = jax.lax.optimization_barrier(jnp.bool_(False))

    def turn(state: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        return jax.lax.optimization_barrier(state)

    return jax.lax.while_loop(lambda state: state[0], turn, (never, values))[1]


def apart(function: Callable[..., Any], *operands: Any) -> Any:
    """Calls a function in a room of its own: its scratch memory lives while it runs, and no longer.

    XLA makes constants, such as the zeros that a scatter starts from, as early as it can: those of a long
    program would all be there from its start, beside the scratch of whatever comes first. What is inside a
    conditional is made when it is needed, and stored. On an accelerator the function is simply called.

    Args:
      function: of the operands.
      *operands: whatever it takes.

    Returns:
      The function's result.
    """
    if on_accelerator():
        return function(*operands)
    function = jax.jit(function, inline=True)  # Traced once, for both branches.
    always = jax.lax.optimization_barrier(jnp.bool_(True))
    return jax.lax.cond(always, lambda: function(*operands), lambda: _zeros_of(function, *operands))


def at_once(function: Callable[..., Any], *operands: Any) -> Any:
    """Computes a few dozen numbers in one kernel, where each would have its own.

    XLA compiles so small a loop, here of one turn, to native code on the CPU, see `AT_ONCE`. On an
    accelerator the function is simply called.

    Args:
      function: of the operands.
      *operands: whatever it takes.

    Returns:
      The function's result.
    """
    if on_accelerator():
        return function(*operands)
    function = jax.jit(function, inline=True)  # Traced once, for its shapes and for the loop.
    once = jax.lax.optimization_barrier(jnp.bool_(True))

    def turn(_: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        return jnp.bool_(False), function(*operands)

    return jax.lax.while_loop(lambda state: state[0], turn, (once, _zeros_of(function, *operands)))[1]


def _zeros_of(function: Callable[..., Any], *operands: Any) -> Any:
    """Zeros in the shapes of a function's result."""
    return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(function, *operands))


def for_chunks(
    num_rows: jax.Array,
    chunk: int,
    step: Callable[[jax.Array, Any], Any],
    state: Any,
    *,
    capacity: int | None = None,
) -> Any:
    """Calls a step with each chunk of the rows that count, one after the other.

    The loop counts rows and not chunks, and without a sign: to divide, to multiply, and to look whether an
    index counts from the end would be a kernel each (XLA, CPU). On an accelerator the first chunk is done
    unasked, since its host waits for each answer: where no row counts, the step must do nothing.

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

    Work is proportional to the rows that are there, not to the capacity, and what a chunk needs
    stays in the cache. Row by row, XLA compiles the loop to native code on a CPU as long as a row reads and
    writes little: for some hundred rows that is as fast as a dozen kernels, and far less to compile. On an
    accelerator the function is called once, for all rows.

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
    whole = _whole_chunks(rows, chunk, axis)
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


def _whole_chunks(rows: Any, chunk: int, axis: int = 0) -> Any:
    """Rows with zeros after the last, so that they are so many whole chunks."""
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
        there = index < num_rows
        return update(state, index, jax.tree.map(lambda a, none: jnp.where(there, a, none), rows, absent))

    if on_accelerator():
        return fold(state, jnp.arange(size, dtype=jnp.int32), rows)
    whole = _whole_chunks(rows, chunk)

    def step(start: jax.Array, state: Any) -> Any:
        index = start.astype(jnp.int32) + jnp.arange(chunk, dtype=jnp.int32)
        return fold(
            state, index, jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, start, chunk), whole)
        )

    return for_chunks(num_rows, chunk, step, state)


def fold_points(
    x: jax.Array,
    y: jax.Array,
    count: jax.Array,
    init: Any,
    update: Callable[[Any, jax.Array, jax.Array], Any],
    *,
    absent: tuple[Any, Any],
    reduce: Callable[..., jax.Array] = jnp.sum,
) -> Any:
    """Sums up the points of many clusters, or finds what is greatest among them.

    On an accelerator it is what each point makes of the first state, reduced over the points. A CPU folds a
    few points of each cluster at a time into a wide state, with the clusters along the last axis: so all
    arithmetic vectorises, which a reduction over an inner axis does not (XLA, CPU), and the loop ends with
    the largest cluster of the batch.

    Args:
      x: (M, C) float32.
      y: (M, C) float32.
      count: (C,) int32, points of each cluster.
      init: pytree of (..., C) arrays, the state before the first point.
      update: maps the state and x (C,), y (C,) to the next state.
      absent: x and y, () or (C,) each, of the points that a cluster does not have, for a CPU: such that
        `update` makes nothing of them.
      reduce: static, `jnp.sum` or `jnp.max`, whichever `update` does, and `init` the neutral state of it.

    Returns:
      The state after the last point of each cluster.
    """
    capacity = x.shape[0]
    if on_accelerator():
        # Points along the last axis, which reductions read without transposing, see `PointLists.table`.
        of_point = jax.vmap(functools.partial(update, init), out_axes=-1)(x, y)
        exists = jnp.arange(capacity, dtype=jnp.int32)[None] < count[:, None]
        return jax.tree.map(
            lambda values, none: reduce(jnp.where(exists, values, none[..., None]), axis=-1), of_point, init
        )

    there, unroll = jnp.arange(capacity, dtype=jnp.int32)[:, None] < count[None], FOLD_UNROLL

    def fill(values: jax.Array, value: Any) -> jax.Array:
        filled = jnp.where(there, values, value)
        more = jnp.broadcast_to(jnp.asarray(value, values.dtype), (-capacity % unroll, values.shape[1]))
        return jnp.concatenate([filled, more])

    filled = fill(x, absent[0]), fill(y, absent[1])
    most = jnp.minimum(jnp.max(count, initial=0), capacity)

    def step(loop: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        first, state = loop
        # A point by its own index: a slice of several is ten times slower (XLA, CPU).
        for k in range(unroll):
            state = update(state, filled[0][first + k], filled[1][first + k])
        return first + unroll, state

    return jax.lax.while_loop(lambda loop: loop[0] < most, step, (jnp.int32(0), init))[1]


def fast_max(a: Any, b: Any) -> jax.Array:
    """The greater of two numbers, neither of which is NaN.

    `jnp.maximum` hands NaN on, for which XLA takes five instructions on a CPU instead of one: this is for
    loops that do little else.

    >>> fast_max(jnp.array([1, 3]), 2).tolist()
    [2, 3]
    """
    return jnp.where(a > b, a, b)


def fast_min(a: Any, b: Any) -> jax.Array:
    """The lesser of two numbers, neither of which is NaN; see `fast_max`.

    >>> fast_min(jnp.array([1, 3]), 2).tolist()
    [1, 2]
    """
    return jnp.where(a < b, a, b)
