"""What JAX computes on, where that decides how a program is built; its results change by rounding alone."""

import os

import jax


def at_a_time(on_cpu: int, on_accelerator: int) -> int:
    """How many rows a step of a loop takes: on a CPU what its cache holds, on an accelerator many more.

    An accelerator starts a step for longer than the step takes. It is JAX's default backend that decides.

    Args:
      on_cpu: rows.
      on_accelerator: rows.

    Returns:
      One of the two.
    """
    return on_cpu if jax.default_backend() == "cpu" else on_accelerator


def batches_at_once() -> bool:
    """Whether a batch may go through each step together, and not one sweep after the other.

    On an accelerator; not with ``XLA_FLAGS=--xla_gpu_deterministic_ops=true`` or the like: what is out of
    bounds, ordered scatters write to the next row of a batch (jax 0.11.2, H100).

    Returns:
      True where it may.
    """
    return jax.default_backend() != "cpu" and "deterministic_ops" not in os.environ.get("XLA_FLAGS", "")
