"""From a device to the host: an accelerator takes as long for a number as for a hundred kilobytes."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.xla.backend import platform_of


def to_host(tree: Any, status: jax.Array) -> Any:
    """A tree in NumPy arrays. Law: `jax.device_get`.

    On a CPU they are views of JAX's own memory; from an accelerator all arrays come in one transfer.

    Args:
      tree: of arrays.
      status: one of them.

    Returns:
      The same tree.
    """
    if not isinstance(status, jax.Array) or platform_of(status) == "cpu":
        return jax.tree.map(np.asarray, tree)
    return transfer_together(tree, status.sharding)


def transfer_together(tree: Any, sharding: Any) -> Any:
    """A tree in NumPy arrays, of which those of one sharding come in one transfer. Law: `jax.device_get`.

    To put their bytes into one array is a small program, compiled once for each shape of the tree.

    Args:
      tree: of arrays.
      sharding: of the arrays that come together; all others come one by one.

    Returns:
      The same tree.
    """
    leaves, structure = jax.tree.flatten(tree)
    together = [i for i, a in enumerate(leaves) if isinstance(a, jax.Array) and a.sharding == sharding]
    arrays = [None if i in together else np.asarray(leaf) for i, leaf in enumerate(leaves)]
    if together:
        joined = np.asarray(_join_bytes([leaves[i] for i in together]))
        ends = np.cumsum([leaves[i].size * leaves[i].dtype.itemsize for i in together])
        for i, part in zip(together, np.split(joined, ends[:-1]), strict=True):
            # A copy: a view would keep the bytes of all the others.
            arrays[i] = part.copy().view(leaves[i].dtype).reshape(leaves[i].shape)
    return jax.tree.unflatten(structure, arrays)


@jax.jit
def _join_bytes(arrays: Sequence[jax.Array]) -> jax.Array:
    return jnp.concatenate([array.reshape(-1).view(jnp.uint8) for array in arrays])
