"""Laws of `jaxbox.xla.transfer`."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.xla import transfer


def trees():
    """Of one device; of two; with NumPy's arrays among them; of none."""
    first, second = jax.devices()[:2]
    numbers = {"bool": jnp.array([True, False]), "words": jnp.uint32(7), "none": jnp.zeros((0, 3))}
    yield numbers | {
        "nan": jnp.array([[np.nan, -0.0]]),
        "half": jnp.float16(1.5),
        "byte": jnp.uint8([3, 255]),
    }
    yield {"here": jax.device_put(jnp.arange(3), first), "there": jax.device_put(jnp.arange(4.0), second)}
    yield {"device": jnp.arange(3), "host": np.float64([1, 2]), "scalar": np.int64(5)}
    yield {}


def test_arrays_come_as_they_are():
    for tree in trees():
        sharding = jnp.zeros(1).sharding
        brought, expected = transfer.transfer_together(tree, sharding), jax.device_get(tree)
        chex.assert_trees_all_equal(brought, expected)
        chex.assert_trees_all_equal_shapes_and_dtypes(brought, expected)
        chex.assert_trees_all_equal(transfer.to_host(tree, jnp.zeros(1)), expected)
    # No array keeps the memory of the others.
    assert all(leaf.base is None or leaf.base.nbytes == leaf.nbytes for leaf in jax.tree.leaves(brought))
