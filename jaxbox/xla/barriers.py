"""Barriers: they change no value, only what XLA fuses, computes twice or keeps alive."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox.xla.backend import on_accelerator


def materialize(values: Any) -> Any:
    """Has values computed once and stored, where the compiler would compute them in every reader.

    Law: the identity.

    XLA fuses a producer into each of its consumers. Fusion does not cross a loop, even one of no iteration:
    barriers keep the compiler from seeing that it has none, and that one would change nothing. (A conditional
    would copy what goes through it.) On an accelerator, whose host would wait at each loop, nothing is done.

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


def store(values: Any) -> Any:
    """Has an accelerator store values once, where XLA would compute them in each of several readers.

    Law: the identity.

    For what is made of much more than it is, as sums of many tables are, or is read by many, as coordinates
    are. It takes no loop there; on a CPU nothing is done, see `materialize`.

    Args:
      values: pytree of arrays.

    Returns:
      The values.
    """
    return jax.lax.optimization_barrier(values) if on_accelerator() else values


def opaque_zeros(*shape: int) -> jax.Array:
    """Zeros that the compiler does not know to be zeros. Law: `jnp.zeros`.

    A function that is called with them, and again with other numbers, is compiled once and not twice.

    Args:
      *shape: static.

    Returns:
      float32 zeros.
    """
    return materialize(jnp.zeros(shape, jnp.float32))


def outline(function: Callable[..., Any], *operands: Any) -> Any:
    """Calls a function in a scope of its own: its scratch memory lives only while it runs.

    Law: ``function(*operands)``.

    XLA makes constants, such as the zeros that a scatter starts from, as early as it can: those of a long
    program would all be there from its start, next to the scratch of whatever comes first. What is inside a
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


def single_kernel(function: Callable[..., Any], *operands: Any) -> Any:
    """Computes a few dozen numbers in one kernel, where each would have its own.

    Law: ``function(*operands)``.

    XLA compiles a loop this small, here of one iteration, to native code on the CPU, see
    `chunks.SINGLE_KERNEL_NUMBERS`. On an accelerator the function is simply called.

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


def reduce_pairs(values: jax.Array, combine: Callable[[Any, Any], Any], axis: int) -> jax.Array:
    """Reduces what is worked out of all pairs of rows, on a GPU without Triton.

    Law: ``jax.lax.reduce(values, 0, combine, (axis,))``.

    XLA for GPUs tries Triton for every reduction of one array. What that makes of all pairs of the rows of a
    batch is straight-line code of any length: jax 0.11.2 compiled it for minutes. For a reduction of two
    arrays, here of zeros besides, it has only the kernels that it writes itself.

    Args:
      values: numbers or words.
      combine: of two of them, such as `jax.lax.add`, which 0 leaves as they are.
      axis: static.

    Returns:
      The values without the axis.
    """
    zero = jnp.zeros((), values.dtype)
    if not on_accelerator():
        return jax.lax.reduce(values, zero, combine, (axis,))

    def both(one: Any, other: Any) -> Any:
        return combine(one[0], other[0]), combine(one[1], other[1])

    return combine(*jax.lax.reduce((values, jnp.zeros_like(values)), (zero, zero), both, (axis,)))


def _zeros_of(function: Callable[..., Any], *operands: Any) -> Any:
    """Zeros in the shapes of a function's result."""
    return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(function, *operands))
