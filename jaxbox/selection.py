"""From components to clusters: how many points, how large, and the gates of size (paper, section 3.2)."""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxbox.masked import lookup, prefix_sum, store, take
from jaxbox.types import Clusters

NUM_BOUNDS = 8
"""Columns of the table of bounds, of which six are used: a row of eight is a vector of the processor."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Statistics:
    """What the size gates ask of each component."""

    count: jax.Array
    """(C, 2) int32: points, and those of them between the slab's heights."""
    upper: jax.Array
    """(C, 8) float32, m: greatest x, y, height, -x, -y and -height; the last two are not used."""


def find_statistics(
    component: jax.Array,
    num_points: jax.Array,
    xy: jax.Array,
    height: jax.Array,
    in_slab: jax.Array,
    *,
    max_components: int,
) -> Statistics:
    """Counts the points of each component, and finds its bounds.

    Args:
      component: (maps, N) int32 of each point on each map.
      num_points: () int32; only the first so many points count.
      xy: (N, 2) float32, m.
      height: (N,) float32, m, above the ground.
      in_slab: (N,) bool.
      max_components: static, C.

    Returns:
      The statistics; no points, and bounds of minus infinity, where there are none.
    """
    none = Statistics(
        jnp.zeros((max_components, 2), jnp.int32), jnp.full((max_components, NUM_BOUNDS), -jnp.inf)
    )
    return jax.lax.platform_dependent(
        none, component, num_points, xy, height, in_slab, cpu=_add_one_by_one, default=_add_at_once
    )


def _add_one_by_one(
    statistics: Statistics,
    component: jax.Array,
    num_points: jax.Array,
    xy: jax.Array,
    height: jax.Array,
    in_slab: jax.Array,
) -> Statistics:
    """Point after point: XLA compiles so small a loop to native code on the CPU, which adds a row at once.

    Map after map, so that a step is small however many there are.
    """

    def add(on_map: int, i: jax.Array, before: Statistics) -> Statistics:
        row = component[on_map, i]
        counted = jnp.stack([jnp.int32(1), in_slab[i].astype(jnp.int32)])
        reached = _reach(xy[i, 0], xy[i, 1], height[i])
        return Statistics(
            jax.lax.dynamic_update_index_in_dim(before.count, before.count[row] + counted, row, 0),
            jax.lax.dynamic_update_index_in_dim(
                before.upper, jnp.maximum(before.upper[row], reached), row, 0
            ),
        )

    for on_map in range(component.shape[0]):
        statistics = jax.lax.fori_loop(0, num_points, functools.partial(add, on_map), statistics)
    return statistics


def _add_at_once(
    statistics: Statistics,
    component: jax.Array,
    num_points: jax.Array,
    xy: jax.Array,
    height: jax.Array,
    in_slab: jax.Array,
) -> Statistics:
    row = jnp.where(jnp.arange(height.shape[0]) < num_points, component, statistics.count.shape[0])
    counted = jnp.stack([jnp.ones_like(in_slab, jnp.int32), in_slab.astype(jnp.int32)], axis=1)
    reached = _reach(xy[:, 0], xy[:, 1], height)
    counted, reached = (jnp.broadcast_to(a, (*row.shape, a.shape[1])) for a in (counted, reached))
    return Statistics(
        statistics.count.at[row].add(counted, mode="drop"),
        statistics.upper.at[row].max(reached, mode="drop"),
    )


def _reach(x: jax.Array, y: jax.Array, height: jax.Array) -> jax.Array:
    """(..., 8) what a point adds to `Statistics.upper`."""
    columns = [x, y, height, -x, -y, -height]
    return jnp.stack(columns + columns[-1:] * (NUM_BOUNDS - len(columns)), axis=-1)


def select_clusters(
    statistics: Statistics,
    first: jax.Array,
    *,
    max_clusters: Sequence[int],
    min_points: jax.Array | float,
    min_extent_m: jax.Array | float,
    max_extent_m: jax.Array | float,
) -> Clusters:
    """Keeps the components that may be a vehicle: enough points, not too short, and not too long.

    Args:
      statistics: of the C components.
      first: (maps + 1,) int32: first component of each map, and one past the last.
      max_clusters: static, of each map; the clusters beyond it are left out.
      min_points: least number of points.
      min_extent_m: least diagonal of the extents along x and y, m: no rectangle has a longer side.
      max_extent_m: greatest extent along x and along y, m.

    Returns:
      The clusters, in the order of the components.
    """
    capacity = sum(max_clusters)
    upper, num_points = statistics.upper, statistics.count[:, 0]
    component = jnp.arange(num_points.shape[0])
    keep = (num_points >= jnp.maximum(min_points, 1)) & (component >= first[0]) & (component < first[-1])
    extent_x, extent_y = upper[:, 0] + upper[:, 3], upper[:, 1] + upper[:, 4]
    keep = keep & (jnp.maximum(extent_x, extent_y) <= max_extent_m)
    keep = keep & (extent_x**2 + extent_y**2 >= min_extent_m**2)
    keep, order = store((keep, prefix_sum(keep)), first[0] >= 0)
    end = lookup(order, first - 1)
    found = end[1:] - end[:-1]
    kept = jnp.minimum(found, jnp.array(max_clusters))
    # The lists of the maps join without gaps.
    row = jnp.full_like(order, capacity)
    for i, size in enumerate(max_clusters):
        place = order - end[i]
        listed = keep & (place > 0) & (place <= size)
        row = jnp.where(listed, place - 1 + jnp.sum(kept[:i]), row)
    member = jnp.full(capacity, num_points.shape[0]).at[row].set(component, mode="drop")
    upper = take(upper, member)
    return Clusters(
        row=row,
        num_points=take(num_points, member),
        num_slab=take(statistics.count[:, 1], member),
        low=-upper[:, 3:6],
        high=upper[:, :3],
        found=found,
        kept=kept,
    )
