"""From components to clusters: how many points, how large, and the gates of size (paper, section 3.2)."""

import dataclasses
import functools
import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.types import Clusters
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.loops import at_once, map_rows, store
from jaxbox.xla.masked import lookup, prefix_sum, take

NUM_COLUMNS = 8
"""Columns of the table of statistics: a row of eight is a vector of the processor."""

NUM_BOUNDS = 6
"""Columns that hold a maximum; the others, a sum."""

IS_BOUND = np.arange(NUM_COLUMNS) < NUM_BOUNDS
"""Which columns hold a maximum."""

MAPS_PER_LOOP = 4
"""Maps gone through in one native loop: with too much to do in a step, it would not be native any more."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Statistics:
    """What the size gates ask of each component."""

    table: jax.Array
    """(C, 8) float32: greatest x, y, height, -x, -y and -height, m; points, and those of them between the
    slab's heights, which float32 counts exactly up to 2^24."""

    @property
    def upper(self) -> jax.Array:
        """(C, 6) float32, m: greatest x, y, height, -x, -y and -height."""
        return self.table[:, :NUM_BOUNDS]

    @property
    def num_points(self) -> jax.Array:
        """(C,) int32."""
        return self.table[:, NUM_BOUNDS].astype(jnp.int32)

    @property
    def num_slab(self) -> jax.Array:
        """(C,) int32: points between the slab's heights."""
        return self.table[:, NUM_BOUNDS + 1].astype(jnp.int32)


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
    num_points = jnp.minimum(num_points, height.shape[0])
    none = jnp.broadcast_to(jnp.where(IS_BOUND, jnp.float32(-jnp.inf), 0), (max_components, NUM_COLUMNS))
    points = xy, height, in_slab
    add = _add_at_once if on_accelerator() else _add_one_by_one
    return Statistics(add(none, component, num_points, points))


Points = tuple[jax.Array, jax.Array, jax.Array]
"""x and y (N, 2), heights (N,), m, and whether they are between the slab's heights (N,)."""


def _add_one_by_one(
    table: jax.Array, component: jax.Array, num_points: jax.Array, points: Points
) -> jax.Array:
    """Point after point: XLA compiles so small a loop to native code on the CPU, which adds a row at once."""
    xy, height, in_slab = points

    def add(maps: range, i: jax.Array, table: jax.Array) -> jax.Array:
        own = _own_row(xy[i], height[i], in_slab[i])
        for on_map in maps:
            row = component[on_map, i]
            table = jax.lax.dynamic_update_index_in_dim(table, _joined(table[row], own), row, 0)
        return table

    maps = range(component.shape[0])
    for first in maps[::MAPS_PER_LOOP]:
        some = maps[first : first + MAPS_PER_LOOP]
        table = jax.lax.fori_loop(0, num_points, functools.partial(add, some), table)
    return table


def _add_at_once(table: jax.Array, component: jax.Array, num_points: jax.Array, points: Points) -> jax.Array:
    xy, height, in_slab = points
    there = jnp.arange(height.shape[0], dtype=jnp.int32) < num_points
    row = jnp.where(there, component, table.shape[0])
    own = jnp.broadcast_to(_own_row(xy, height, in_slab), (*row.shape, NUM_COLUMNS))
    bounds = table[:, :NUM_BOUNDS].at[row].max(own[..., :NUM_BOUNDS], mode="drop")
    # Whole numbers: ordered scatters of floats cost accelerators more.
    counts = jnp.zeros((table.shape[0], NUM_COLUMNS - NUM_BOUNDS), jnp.int32)
    counts = counts.at[row].add(own[..., NUM_BOUNDS:].astype(jnp.int32), mode="drop")
    return jnp.concatenate([bounds, counts.astype(jnp.float32)], axis=1)


def _own_row(xy: jax.Array, height: jax.Array, in_slab: jax.Array) -> jax.Array:
    """(..., 8) the table's row of a point alone. Chosen column by column, as a stack does not vectorise."""
    x, y = xy[..., 0], xy[..., 1]
    values = [x, y, height, -x, -y, -height, jnp.ones_like(height), in_slab.astype(jnp.float32)]
    column = np.arange(NUM_COLUMNS)
    row = values[-1][..., None]
    for k, value in enumerate(values[:-1]):
        row = jnp.where(column == k, value[..., None], row)
    return row


def _joined(row: jax.Array, other: jax.Array) -> jax.Array:
    return jnp.where(IS_BOUND, jnp.maximum(row, other), row + other)


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
    upper, num_points = statistics.upper, statistics.num_points
    component = jnp.arange(num_points.shape[0], dtype=jnp.int32)
    enough = num_points.astype(jnp.float32) >= jnp.maximum(min_points, 1.0)
    keep = enough & (component >= first[0]) & (component < first[-1])
    extent_x, extent_y = upper[:, 0] + upper[:, 3], upper[:, 1] + upper[:, 4]
    keep = keep & (jnp.maximum(extent_x, extent_y) <= max_extent_m)
    keep = keep & (extent_x**2 + extent_y**2 >= min_extent_m**2)
    keep, order = store((keep, prefix_sum(keep)))

    def count() -> tuple[list[jax.Array], jax.Array, list[jax.Array], list[jax.Array]]:
        end = [lookup(order, first[i] - 1) for i in range(len(max_clusters) + 1)]
        found = [after - before for before, after in itertools.pairwise(end)]
        kept = [jnp.minimum(each, size) for each, size in zip(found, max_clusters, strict=True)]
        return end, jnp.stack(found), kept, list(itertools.accumulate(kept))

    end, found, kept, kept_up_to = at_once(count)
    # The lists of the maps join without gaps.
    row = jnp.full_like(order, capacity)
    for i, size in enumerate(max_clusters):
        place = order - end[i]
        listed = keep & (place > 0) & (place <= size)
        row = jnp.where(listed, place - 1 + kept_up_to[i] - kept[i], row)
    member = jnp.full(capacity, num_points.shape[0], jnp.int32).at[row].set(component, mode="drop")

    def describe(member: jax.Array) -> tuple[jax.Array, ...]:
        bounds = take(upper, member)
        return take(num_points, member), take(statistics.num_slab, member), -bounds[:, 3:6], bounds[:, :3]

    rows = map_rows(describe, member, num_rows=kept_up_to[-1])
    return Clusters(row, *rows, found=found, kept=jnp.stack(kept))
