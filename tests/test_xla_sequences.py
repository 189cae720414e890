"""The law of steps one after the other."""

import jax
import numpy as np
import pytest

from jaxbox.xla import sequences


@pytest.mark.parametrize("num_items", [0, 1, 7])
def test_a_scan_is_the_loop(num_items):
    def step(state, item):
        return state * item["a"] + 1, state - item["b"]

    items = {"a": np.arange(num_items, dtype=np.float32), "b": np.ones(num_items, np.float32)}
    last, given = jax.jit(lambda state, items: sequences.scan_sequence(step, state, items))(
        np.float32(2), items
    )
    state, expected = np.float32(2), []
    for i in range(num_items):
        state, one = step(state, {name: array[i] for name, array in items.items()})
        expected.append(one)
    assert float(last) == float(state)
    assert given.tolist() == expected
