"""From a device to the host: an accelerator takes as long for a number as for a hundred kilobytes."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def to_host(tree: Any, status: jax.Array) -> Any:
    """A tree in NumPy arrays: on a CPU views of JAX's own memory, from an accelerator in one transfer.

    Args:
      tree: of arrays.
      status: one of them.

    Returns:
      The same tree.
    """
    devices = status.devices() if isinstance(status, jax.Array) else ()
    if all(device.platform == "cpu" for device in devices):
        return jax.tree.map(np.asarray, tree)
    return transfer_together(tree)


def transfer_together(tree: Any) -> Any:
    """A tree in NumPy arrays, whose bytes are put into one array on the device. Law: `jax.device_get`.

    Args:
      tree: of arrays of numbers or bool, on one device.

    Returns:
      The same tree, of views of one array.
    """
    leaves, structure = jax.tree.flatten(tree)
    # Widest numbers first, so that each array lies at a multiple of its numbers' bytes.
    order = sorted(range(len(leaves)), key=lambda i: -leaves[i].dtype.itemsize)
    joined = np.asarray(_join_bytes([leaves[i] for i in order]))
    ends = np.cumsum([leaves[i].size * leaves[i].dtype.itemsize for i in order])
    parts = dict(zip(order, np.split(joined, ends[:-1]), strict=True))
    arrays = [parts[i].view(leaf.dtype).reshape(leaf.shape) for i, leaf in enumerate(leaves)]
    return jax.tree.unflatten(structure, arrays)


@jax.jit
def _join_bytes(arrays: Sequence[jax.Array]) -> jax.Array:
    return jnp.concatenate([_bytes_of(array) for array in arrays])


def _bytes_of(array: jax.Array) -> jax.Array:
    if array.dtype == jnp.bool_:
        return array.reshape(-1).astype(jnp.uint8)
    return jax.lax.bitcast_convert_type(array, jnp.uint8).reshape(-1)
