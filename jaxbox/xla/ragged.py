"""Points of clusters as lists of different lengths, one after the other, and folds over them."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp

from jaxbox.xla import chunks
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.barriers import materialize
from jaxbox.xla.indexing import gather, take
from jaxbox.xla.sorting import sort_by_group

PointTable = tuple[jax.Array, jax.Array, jax.Array]
"""x and y of points (M, C) m, and how many of them count (C,)."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PointLists:
    """The points of each cluster, one list after the other."""

    x: jax.Array
    """(E,) float32, m."""
    y: jax.Array
    """(E,) float32, m."""
    start: jax.Array
    """(K,) int32, where the points of each cluster begin."""
    total: jax.Array
    """(K,) int32, how many they are."""
    max_points: int = dataclasses.field(metadata={"static": True})
    """static, M: that many of a cluster are looked at."""

    @property
    def count(self) -> jax.Array:
        """(K,) int32, points of each cluster that are looked at."""
        return jnp.minimum(self.total, self.max_points)

    def count_of(self, cluster: jax.Array) -> jax.Array:
        """(C,) int32, the `count` of some clusters: (C,) int32, in [0, K]; the latter has none."""
        return jnp.minimum(take(self.total, cluster), self.max_points)

    def table(self, cluster: jax.Array) -> PointTable:
        """The points of some clusters, spread evenly over all they have: every (total / M)-th.

        Args:
          cluster: (C,) int32, in [0, K]; the latter has none.

        Returns:
          The points, in their order; those beyond the count may be anything finite.
        """
        start, total = take(self.start, cluster), take(self.total, cluster)
        index = jnp.arange(self.max_points, dtype=jnp.int32)
        if on_accelerator():
            # Cluster by cluster, as the points lie in the lists and as `fold_points` reads them there.
            row = self._row(start[:, None], total[:, None], index[None])
            xy = gather(jnp.stack([self.x, self.y], axis=1), row)
            x, y = xy[:, :, 0].T, xy[:, :, 1].T
        else:
            # Stored, since what a look-up has to work out first does not vectorise.
            row = materialize(self._row(start[None], total[None], index[:, None]))
            x, y = (jnp.take(values, row, mode="clip") for values in (self.x, self.y))
        return x, y, self.count_of(cluster)

    def _row(self, start: jax.Array, total: jax.Array, j: jax.Array) -> jax.Array:
        """The row of the j-th point that is looked at of each cluster."""
        # floor(j total / M). The remainder's part by a product, exact up to M = 1,600: an accelerator would
        # store what a division makes.
        rest = (j * (total % self.max_points)).astype(jnp.float32) + 0.5
        spread = j * (total // self.max_points) + (rest * (1 / self.max_points)).astype(jnp.int32)
        return start + jnp.where(total > self.max_points, spread, j)


def list_points(
    cluster: jax.Array,
    row: jax.Array,
    num_entries: jax.Array,
    xy: jax.Array,
    *,
    num_clusters: int,
    max_points: int,
) -> PointLists:
    """Lists the points of each cluster. Law: ``xy[row[cluster == k]]``, of the entries that count.

    Args:
      cluster: (E,) int32, in [0, num_clusters).
      row: (E,) int32, of the point in `xy`.
      num_entries: () int32; how many entries count, from the first on.
      xy: (N, 2) float32, m.
      num_clusters: static, K.
      max_points: static, M.

    Returns:
      The lists, each in the order of its entries.
    """

    def read(i: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, y = (values.at[row[i]].get(mode="promise_in_bounds") for values in columns)
        return x, y

    def read_pair(i: jax.Array) -> jax.Array:
        return gather(xy, gather(row, i))

    columns = xy[:, 0], xy[:, 1]
    if on_accelerator():
        # In pairs, as `PointLists.table` looks them up.
        pairs, begin, end = sort_by_group(read_pair, cluster, num_entries, num_clusters)
        x, y = pairs[:, 0], pairs[:, 1]
    else:
        (x, y), begin, end = sort_by_group(read, cluster, num_entries, num_clusters)
    return PointLists(x, y, begin, end - begin, max_points)


def fold_points(
    x: jax.Array,
    y: jax.Array,
    count: jax.Array,
    init: Any,
    update: Callable[[Any, jax.Array, jax.Array], Any],
    *,
    absent: tuple[Any, Any],
    operation: Literal["add", "max"] = "add",
) -> Any:
    """Reduces the points of many clusters to sums or maxima.

    Law: `update` sees each point that counts once, with its cluster.

    On an accelerator it is what each point makes of the first state, reduced over the points. A CPU folds a
    few points of each cluster at a time into a wide state, with the clusters along the last axis: so all
    arithmetic vectorises, which a reduction over an inner axis does not (XLA, CPU), and the loop ends with
    the largest cluster of the batch.

    Args:
      x: (M, C) float32.
      y: (M, C) float32.
      count: (C,) int32, points of each cluster.
      init: pytree of float32 arrays, all (..., C) of one shape: the state before the first point.
      update: maps the state and x (C,), y (C,) to the next state.
      absent: x and y, () or (C,) each, of the points that a cluster does not have, for a CPU: such that
        `update` makes nothing of them.
      operation: static, whichever `update` does, and `init` the neutral state of it.

    Returns:
      The state after the last point of each cluster.
    """
    capacity = x.shape[0]
    if on_accelerator():
        return _fold_at_once(x, y, count, init, update, operation)

    valid, unroll = jnp.arange(capacity, dtype=jnp.int32)[:, None] < count[None], chunks.FOLDED_POINTS

    def fill(values: jax.Array, value: Any) -> jax.Array:
        filled = jnp.where(valid, values, value)
        more = jnp.broadcast_to(jnp.asarray(value, values.dtype), (-capacity % unroll, values.shape[1]))
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


def _fold_at_once(
    x: jax.Array,
    y: jax.Array,
    count: jax.Array,
    init: Any,
    update: Callable[[Any, jax.Array, jax.Array], Any],
    operation: Literal["add", "max"],
) -> Any:
    """As `fold_points`: the whole state in one reduction, which reads a point once for all of it."""
    # Points along the last axis, which reductions read without transposing, see `PointLists.table`.
    of_point = jax.vmap(functools.partial(update, init), out_axes=-1)(x, y)
    valid = jnp.arange(x.shape[0], dtype=jnp.int32)[None] < count[:, None]
    of_point = jax.tree.map(lambda values, none: jnp.where(valid, values, none[..., None]), of_point, init)
    leaves, tree = jax.tree.flatten(of_point)
    join, neutral = (jnp.add, 0) if operation == "add" else (jnp.maximum, -jnp.inf)

    def join_all(some: Sequence[jax.Array], others: Sequence[jax.Array]) -> list[jax.Array]:
        return [join(a, b) for a, b in zip(some, others, strict=True)]

    none = [jnp.asarray(neutral, leaf.dtype) for leaf in leaves]
    return jax.tree.unflatten(tree, jax.lax.reduce(leaves, none, join_all, (leaves[0].ndim - 1,)))
