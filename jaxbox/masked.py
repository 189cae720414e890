"""The fixed-shape toolbox: compaction, masked statistics, work in chunks.

Every function keeps static shapes. A row that is absent is marked by the sentinel index N, one past
the last; `take` reads zeros there and scatters with ``mode="drop"`` ignore it.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.devices import at_a_time, on_accelerator

BLOCK = 512
"""Columns of sums in two levels."""

PREFIX_UNROLL = 4
"""Numbers taken in one step of the loop of a prefix sum: twice as fast as one."""

WORD_BITS = 32
"""Bits of a word of a set of flags."""

BYTE_BITS = 8
"""Flags that are compacted at a time."""

_PLACES_OF_BYTE = np.array(
    [
        [k for k in range(BYTE_BITS) if value >> k & 1] + [0] * (BYTE_BITS - value.bit_count())
        for value in range(2**BYTE_BITS)
    ],
    np.uint8,
)
"""(256, 8): where the set bits of each byte are, lowest first; 0 beyond."""

AT_ONCE = 62
"""Numbers that `at_once` may copy: what reads and writes more than a kilobyte is no small loop to XLA."""

FOLD_UNROLL = 4, 16
"""Points folded in one step of the loop over them, on a CPU and on an accelerator."""


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


def prefix_sum(values: jax.Array) -> jax.Array:
    """Inclusive prefix sum of a vector of integers.

    Args:
      values: (N,) bool or int32.

    Returns:
      (N,) int32.

    >>> prefix_sum(jnp.array([1, 0, 2])).tolist()
    [1, 1, 3]
    """
    one_by_one = functools.partial(_scan_one_by_one, jnp.add)
    return jax.lax.platform_dependent(values, cpu=one_by_one, default=_sum_in_blocks)


def prefix_max(values: jax.Array) -> jax.Array:
    """The greatest up to each number of a vector of integers.

    Args:
      values: (N,) int32, not negative.

    Returns:
      (N,) int32.

    >>> prefix_max(jnp.array([1, 0, 2])).tolist()
    [1, 1, 2]
    """
    one_by_one = functools.partial(_scan_one_by_one, jnp.maximum)
    return jax.lax.platform_dependent(values, cpu=one_by_one, default=jax.lax.cummax)


def _scan_one_by_one(combine: Callable[..., jax.Array], values: jax.Array) -> jax.Array:
    """Number after number: XLA compiles so small a loop to native code on the CPU."""

    def step(i: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        total, totals = state
        total = combine(total, values[i].astype(jnp.int32))
        return total, totals.at[i].set(total, mode="promise_in_bounds")

    init = jnp.int32(0), jnp.zeros(values.shape, jnp.int32)
    return jax.lax.fori_loop(0, values.shape[0], step, init, unroll=PREFIX_UNROLL)[1]


def _sum_in_blocks(values: jax.Array) -> jax.Array:
    size = values.shape[0]
    if values.dtype == bool and size > BLOCK:
        return _count_before(values)
    blocks = jnp.pad(values.astype(jnp.int32), (0, -size % BLOCK)).reshape(-1, BLOCK)
    inside = jnp.cumsum(blocks, axis=1)
    before = jnp.cumsum(inside[:, -1]) - inside[:, -1]
    return (inside + before[:, None]).reshape(-1)[:size]


def _count_before(mask: jax.Array) -> jax.Array:
    """(N,) prefix sum of truth values, as the bits of words: a sum over words, and bits counted in one."""
    size = mask.shape[0]
    bit = jnp.arange(WORD_BITS, dtype=jnp.uint32)
    words = _words(mask)
    population = jax.lax.population_count(words).astype(jnp.int32)
    before = _sum_in_blocks(population) - population
    up_to = (jnp.uint32(2) << bit) - 1
    inside = jax.lax.population_count(words[:, None] & up_to).astype(jnp.int32)
    return (before[:, None] + inside).reshape(-1)[:size]


def compact(mask: jax.Array, capacity: int) -> tuple[jax.Array, jax.Array]:
    """Indices of the True entries, in order, at a fixed capacity.

    Args:
      mask: (N,) bool.
      capacity: static; entries beyond it are left out.

    Returns:
      index: (capacity,) int32, ascending; N where there is no entry.
      count: () int32, the true number of entries, which may exceed the capacity.

    >>> compact(jnp.array([False, True, True]), 4)[0].tolist()
    [1, 2, 3, 3]
    """
    return jax.lax.platform_dependent(
        mask,
        cpu=functools.partial(_compact_by_bytes, capacity=capacity),
        default=functools.partial(_compact_at_once, capacity=capacity),
    )


def _compact_at_once(mask: jax.Array, *, capacity: int) -> tuple[jax.Array, jax.Array]:
    size = mask.shape[0]
    order = prefix_sum(mask)
    target = jnp.where(mask, order - 1, capacity)
    index = jnp.full(capacity, size, jnp.int32)
    index = index.at[target].set(jnp.arange(size, dtype=jnp.int32), mode="drop")
    return index, order[-1]


def _compact_by_bytes(mask: jax.Array, *, capacity: int) -> tuple[jax.Array, jax.Array]:
    """Byte after byte of flags: XLA compiles so small a loop to native code on the CPU.

    Each writes eight indices, of which as many count as it has flags: the next byte writes over the others.
    """
    size = mask.shape[0]
    flags = jnp.pad(mask, (0, -size % BYTE_BITS)).reshape(-1, BYTE_BITS)
    values = jnp.sum(jnp.where(flags, 1 << jnp.arange(BYTE_BITS), 0), axis=1).astype(jnp.uint8)
    places = jnp.asarray(_PLACES_OF_BYTE)

    def step(i: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        index, count = state
        value = values[i].astype(jnp.int32)
        new = i * BYTE_BITS + places[value].astype(jnp.int32)
        # Beyond the capacity the start is moved back, to the room at the end.
        index = jax.lax.dynamic_update_slice(index, new, (count,))
        return index, count + jax.lax.population_count(value)

    none = jnp.full(capacity + BYTE_BITS, size, jnp.int32)
    init = none, jnp.int32(0)
    index, count = jax.lax.fori_loop(0, values.shape[0], step, init)
    # Over what the last byte wrote beyond its flags.
    index = jax.lax.dynamic_update_slice(index, none[:BYTE_BITS], (count,))
    return index[:capacity], count


def _words(mask: jax.Array) -> jax.Array:
    """(W,) uint32: the flags as the bits of words."""
    bits = jnp.pad(mask, (0, -mask.shape[0] % WORD_BITS)).reshape(-1, WORD_BITS)
    bit = jnp.arange(WORD_BITS, dtype=jnp.uint32)
    return jnp.sum(jnp.where(bits, jnp.uint32(1) << bit, jnp.uint32(0)), axis=1, dtype=jnp.uint32)


def rows_in_use(present: jax.Array) -> jax.Array:
    """How many rows there are up to the last one that is present.

    Args:
      present: (N,) bool.

    Returns:
      () int32.

    >>> int(rows_in_use(jnp.array([False, True, False])))
    2
    """
    return jnp.max(jnp.where(present, jnp.arange(1, present.shape[0] + 1), 0), initial=0)


def take(rows: jax.Array, index: jax.Array, fill: Any = 0) -> jax.Array:
    """Rows at the indices, and `fill` at the sentinel or any other index beyond.

    Args:
      rows: (N, ...).
      index: (...) int32, not negative.
      fill: what an absent row holds.

    Returns:
      (..., ...) of the type of `rows`.
    """
    return rows.at[index].get(mode="fill", fill_value=fill)


def lookup(table: jax.Array, *index: jax.Array) -> jax.Array:
    """Entries of a table at indices that are known to lie inside.

    One flat index: several would first be joined to rows, which costs more than the look-up (XLA, CPU).

    Args:
      table: (A, B, ...), as many axes as there are indices.
      *index: int32 arrays of one shape, each within its axis.

    Returns:
      The shape of the indices.
    """
    flat = index[0]
    for size, along in zip(table.shape[1:], index[1:], strict=True):
        flat = flat * size + along
    return jnp.take(table.reshape(-1), flat, mode="clip")


def split_index(index: jax.Array, size: int) -> tuple[jax.Array, jax.Array]:
    """Row and column of flat indices into a table of rows of a size.

    Args:
      index: int32, not negative: `//` and `%` of numbers that may be take several times as much code.
      size: static.

    Returns:
      The quotients and the remainders.

    >>> [part.tolist() for part in split_index(jnp.array([1, 7]), 3)]
    [[0, 2], [1, 1]]
    """
    return jax.lax.div(index, jnp.int32(size)), jax.lax.rem(index, jnp.int32(size))


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
    traced_once = jax.jit(function, inline=True)
    shapes = jax.eval_shape(traced_once, *operands)
    always = jax.lax.optimization_barrier(jnp.bool_(True))
    return jax.lax.cond(
        always,
        lambda: traced_once(*operands),
        lambda: jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes),
    )


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
    once = jax.lax.optimization_barrier(jnp.bool_(True))
    shapes = jax.eval_shape(function, *operands)
    nothing = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    turn = jax.lax.while_loop(
        lambda state: state[0], lambda _: (jnp.bool_(False), function(*operands)), (once, nothing)
    )
    return turn[1]


def for_chunks(num_rows: jax.Array, chunk: int, step: Callable[[jax.Array, Any], Any], state: Any) -> Any:
    """Calls a step with each chunk of the rows that count, one after the other.

    The loop counts rows and not chunks, and without a sign: to divide, to multiply, and to look whether an
    index counts from the end would be a kernel each (XLA, CPU).

    Args:
      num_rows: () int32, how many rows count.
      chunk: static, rows at a time.
      step: maps the first row () uint32 of a chunk, and the state, to the next state.
      state: pytree of arrays.

    Returns:
      The state after the last chunk.
    """
    end = num_rows.astype(jnp.uint32)

    def turn(loop: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        start, state = loop
        return start + chunk, step(start, state)

    return jax.lax.while_loop(lambda loop: loop[0] < end, turn, (jnp.uint32(0), state))[1]


def count_true(*masks: jax.Array) -> jax.Array:
    """How many entries of each mask are True.

    A sum of words counts five masks, each in bits of its own. The sums of those are of floats, since XLA
    makes a tree of kernels of each long sum of integers.

    Args:
      *masks: (N,) bool each, of any sizes up to 2^24.

    Returns:
      (number of masks,) int32.

    >>> count_true(jnp.array([True, False]), jnp.array([True, True, True])).tolist()
    [1, 3]
    """
    bits = WORD_BITS.bit_length()
    per_word = WORD_BITS // bits
    size = max(mask.shape[0] for mask in masks)
    size += -size % WORD_BITS
    of_mask = [
        jnp.where(jnp.pad(mask, (0, size - mask.shape[0])), 1 << k % per_word * bits, 0)
        for k, mask in enumerate(masks)
    ]
    words = [functools.reduce(jnp.add, of_mask[k : k + per_word]) for k in range(0, len(masks), per_word)]
    sums = jnp.stack([jnp.sum(word.reshape(-1, WORD_BITS), axis=1) for word in words])
    counts = (sums[:, None] >> jnp.arange(per_word)[:, None] * bits) & (2**bits - 1)
    return jnp.sum(counts.astype(jnp.float32), axis=-1).astype(jnp.int32).reshape(-1)[: len(masks)]


def masked_mean(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean of the masked values along the last axis; 0 where there are none.

    Args:
      values: (..., N) float32.
      mask: (..., N) bool.

    Returns:
      (...) float32.
    """
    total = jnp.sum(jnp.where(mask, values, 0), axis=-1)
    # Counted in float32, exact to 2^24: a sum of integers is several times slower (XLA, CPU).
    return total / jnp.maximum(jnp.sum(mask, axis=-1, dtype=jnp.float32), 1)


def masked_std(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Population standard deviation of the masked values along the last axis.

    The mean is taken off first: E[v^2] - E[v]^2 would cancel in float32.

    Args:
      values: (..., N) float32.
      mask: (..., N) bool.

    Returns:
      (...) float32; 0 where there are none.
    """
    centred = values - masked_mean(values, mask)[..., None]
    return jnp.sqrt(masked_mean(centred**2, mask))


def map_rows(
    function: Callable[[Any], Any], rows: Any, *, num_rows: jax.Array, chunk: int, axis: int = 0
) -> Any:
    """Applies a batched function to the first `num_rows` rows, a chunk at a time.

    Work is proportional to the rows that are there, not to the capacity, and what a chunk needs
    stays in the cache. On an accelerator all rows are one chunk.

    Args:
      function: maps a pytree of (chunk, ...) arrays to another one.
      rows: pytree of (P, ...) arrays.
      num_rows: () int32, how many rows count.
      chunk: static, rows at a time on a CPU.
      axis: static, 0 or -1: the axis of all arrays along which the rows lie; -1 for (..., P) arrays.

    Returns:
      Pytree of (P, ...) arrays; rows of chunks beyond `num_rows` are zero.
    """
    function = jax.jit(function, inline=True)  # Traced once, for its shapes and for the loop.
    capacity = jax.tree.leaves(rows)[0].shape[axis]
    chunk = at_a_time(chunk, max(chunk, capacity))
    missing = -capacity % chunk

    def extended(a: jax.Array) -> jax.Array:
        width = [(0, 0)] * a.ndim
        width[axis] = (0, missing)
        return jnp.pad(a, width)

    padded = jax.tree.map(extended, rows)

    def part(start: jax.Array) -> Any:
        return jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, start, chunk, axis), padded)

    def step(start: jax.Array, out: Any) -> Any:
        new = function(part(start))
        return jax.tree.map(lambda o, n: jax.lax.dynamic_update_slice_in_dim(o, n, start, axis), out, new)

    def empty(shape: jax.ShapeDtypeStruct) -> jax.Array:
        size = list(shape.shape)
        size[axis] = capacity + missing
        return jnp.zeros(size, shape.dtype)

    out = jax.tree.map(empty, jax.eval_shape(function, jax.eval_shape(part, jnp.uint32(0))))
    out = for_chunks(jnp.minimum(num_rows, capacity), chunk, step, out)
    return jax.tree.map(lambda a: jax.lax.slice_in_dim(a, 0, capacity, axis=axis), out)


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

    Row by row, XLA compiles the loop to native code on a CPU as long as a row reads and writes little: one
    kernel instead of one for each operation. On an accelerator all rows are one chunk.

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
    chunk = at_a_time(chunk, max(chunk, size))
    num_rows = jnp.minimum(num_rows, size)
    padded = jax.tree.map(lambda a: jnp.pad(a, (0, -size % chunk)), rows)

    def step(start: jax.Array, state: Any) -> Any:
        index = start.astype(jnp.int32) + jnp.arange(chunk)

        def part(values: jax.Array, value: Any) -> jax.Array:
            return jnp.where(index < num_rows, jax.lax.dynamic_slice_in_dim(values, start, chunk), value)

        return update(state, index, jax.tree.map(part, padded, absent))

    return for_chunks(num_rows, chunk, step, state)


def fold_points(
    x: jax.Array,
    y: jax.Array,
    count: jax.Array,
    init: Any,
    update: Callable[[Any, jax.Array, jax.Array], Any],
    *,
    absent: tuple[Any, Any],
) -> Any:
    """Folds the points of many clusters into a wide state, a few points of each cluster at a time.

    With the clusters along the last axis all arithmetic vectorises, which a reduction over an inner axis
    does not (XLA, CPU). The loop ends with the largest cluster of the batch.

    Args:
      x: (M, C) float32.
      y: (M, C) float32.
      count: (C,) int32, points of each cluster.
      init: pytree of (..., C) arrays, the state before the first point.
      update: maps the state and x (C,), y (C,) to the next state.
      absent: x and y, () or (C,) each, of the points that a cluster does not have: such that `update`
        makes nothing of them.

    Returns:
      The state after the last point of each cluster.
    """
    capacity, unroll = x.shape[0], at_a_time(*FOLD_UNROLL)
    there = jnp.arange(capacity)[:, None] < count

    def fill(values: jax.Array, value: Any) -> jax.Array:
        filled = jnp.where(there, values, value)
        more = jnp.broadcast_to(value, (-capacity % unroll, values.shape[1]))
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
