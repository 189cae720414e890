"""What JAX computes on, where that decides how a program is built. It changes results by rounding only."""

import os

import jax


def on_accelerator() -> bool:
    """Whether JAX's default backend is no CPU: a CPU beside an accelerator has the accelerator's program."""
    return jax.default_backend() != "cpu"


def at_a_time(on_cpu: int, with_accelerator: int) -> int:
    """How many rows a step of a loop takes: on a CPU what its cache holds, on an accelerator many more.

    To launch a kernel takes an accelerator longer than to run so small a one.

    Args:
      on_cpu: rows.
      with_accelerator: rows.

    Returns:
      One of the two.
    """
    return with_accelerator if on_accelerator() else on_cpu


def batch_together() -> bool:
    """Whether a batch goes through each step together, and not one sweep after the other.

    On an accelerator; not with ``XLA_FLAGS=--xla_gpu_deterministic_ops=true`` or the like: in a batch, XLA's
    deterministic scatters write updates that are to be dropped, as their index is out of bounds, to the next
    row (seen with jax 0.11.2 on an H100). Nothing shows the same option where it is given to the compiler.

    Returns:
      True where it does.
    """
    return on_accelerator() and "deterministic_ops" not in os.environ.get("XLA_FLAGS", "")
