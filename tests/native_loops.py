"""Loops of compiled programs, and which of them are native code."""

import jax


def count_loops(function, *args, **options):
    """Loops of a jitted function's program for a CPU, and how many of them are native code.

    A loop whose step does too much for XLA to call it small takes a hundred times as long.
    """
    args = jax.tree.map(lambda a: jax.device_put(a, jax.devices("cpu")[0]), args)
    return loops_of(function.lower(*args, **options))


def loops_of(lowered):
    """As `count_loops`, of a program that was lowered for a CPU."""
    text = lowered.compile().as_text()
    return text.count(" while("), text.count('xla_cpu_small_call="true"')
