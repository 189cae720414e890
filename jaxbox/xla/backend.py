"""What a program is built for, a CPU or an accelerator: one decision. It changes results by rounding only."""

import contextlib
import contextvars
import os
from collections.abc import Iterator
from typing import Any, TypeGuard

import jax
import jax.core

_for_accelerator: contextvars.ContextVar[bool | None] = contextvars.ContextVar(
    "for_accelerator", default=None
)
"""Whether what is traced in this context is for an accelerator; None for what JAX computes on here."""


@contextlib.contextmanager
def building_for(*, accelerator: bool) -> Iterator[None]:
    """Traces programs for a CPU or for an accelerator, whatever JAX computes on here.

    JAX keeps what it has traced by the arguments of a function, and this is none of them: a function that
    was traced outside must not be traced again within. `detect` carries the decision in its operands.

    Args:
      accelerator: whether for an accelerator.

    Yields:
      Nothing.
    """
    token = _for_accelerator.set(accelerator)
    try:
        yield
    finally:
        _for_accelerator.reset(token)


def on_accelerator(array: Any = None) -> bool:
    """Whether a program is built for an accelerator: the only place that decides it.

    Args:
      array: what the program is called with, if it is at hand: an array that is on a device already is
        computed with there.

    Returns:
      What `building_for` says; else by the array's device; else by JAX's default device.
    """
    chosen = _for_accelerator.get()
    return platform_of(array) != "cpu" if chosen is None else chosen


def platform_of(array: Any) -> str:
    """The platform that JAX computes on with an array: for NumPy's, tracers or None its default."""
    if is_on_device(array):
        return next(iter(array.devices())).platform
    return default_device().platform


def is_on_device(array: Any) -> TypeGuard[jax.Array]:
    """Whether an array is on a device: NumPy's are on the host, and tracers nowhere yet."""
    return isinstance(array, jax.Array) and not isinstance(array, jax.core.Tracer)


def default_device() -> Any:
    """The JAX device that is computed on unless it is told otherwise."""
    # A device, the name of a platform, or None.
    default = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    return default if isinstance(default, jax.Device) else jax.local_devices(backend=default)[0]


def batch_together() -> bool:
    """Whether a batch goes through each step together, and not one sweep after the other.

    On an accelerator; not with ``XLA_FLAGS=--xla_gpu_deterministic_ops=true`` or the like: in a batch, XLA's
    deterministic scatters write updates that are to be dropped, as their index is out of bounds, to the next
    row (seen with jax 0.11.2 on an H100). Nothing shows the same option where it is given to the compiler.

    Returns:
      True where it does.
    """
    return on_accelerator() and "deterministic_ops" not in os.environ.get("XLA_FLAGS", "")
