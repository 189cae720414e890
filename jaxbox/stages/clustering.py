"""Clustering by grid subdivision: connected components as proposals (paper, section 3.2, Algorithm II)."""

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp

from jaxbox.config import BoxConfig, ClusteringConfig, DetectorConfig, RegionConfig, VehicleConfig
from jaxbox.stages.state import Clusters, Obstacles
from jaxbox.xla.arithmetic import arctan2
from jaxbox.xla.components import NONE, CellGrids, label_components
from jaxbox.xla.hashing import lattice_numbers
from jaxbox.xla.indexing import lookup_pair, pack_pairs, take
from jaxbox.xla.loops import map_rows
from jaxbox.xla.maps import flag_cells, map_tables
from jaxbox.xla.rows import compact, stored_columns
from jaxbox.xla.segments import reduce_segments, segment_minima
from jaxbox.xla.sorting import compact_groups

NUM_RANKS = 4096
"""Points are ranked by numbers below this."""

SHARE_BITS = 14
"""Of twice as many numbers, and some more."""

COLUMNS_PER_RAD, CIRCLES_PER_UNIT = 652, 200
"""Cells that points are ranked by: .088 degrees of azimuth, half the angle between two beams of most sensors,
and .005 m/m of slope, which holds the points of one circle of beams or a few."""

MIN_RANGE_M = 0.1
"""Nearer points are ranked as if at this range: their slope has no bound."""

SAMPLED_FROM, SAMPLED_SHARE = 0.9, 0.72
"""Of clusters with more points than this share of `max_points` so much of it is looked at in the mean. The
rest is room for those that have more than their share: no cluster of 83 real sweeps needs all of it."""


def propose_clusters(obstacles: Obstacles, config: DetectorConfig) -> Clusters:
    """Labels the components of every map, and lists the clusters that pass the size gates.

    Args:
      obstacles: O points.
      config: of the detector: the maps, the region, the slab's heights, and what large clusters are.

    Returns:
      The clusters, map after map, and which of them each point belongs to.
    """
    maps, num = config.clustering.maps, obstacles.height.shape[0]
    chex.assert_shape([obstacles.row, obstacles.height, obstacles.xy], [(num,), (num,), (num, 2)])
    grids = arrange_grids(config.clustering, config.region)
    cell, flags = _find_cells(obstacles, grids, config)
    components = label_components(flags, grids, max_runs=sum(m.max_cells for m in maps))
    component = map_tables(
        lambda cell, _: components.at(cell), cell, num_rows=obstacles.count, init=jnp.zeros_like(cell)
    )
    statistics = find_statistics(
        component[:, :num],
        obstacles.count,
        obstacles.xy,
        obstacles.height,
        _in_slab(obstacles.height, config.box),
        max_components=components.of_run.shape[0],
    )
    chosen = select_clusters(
        statistics, components.first, config.clustering, min_extent_m=config.vehicles.min_extent_m
    )
    least = jnp.maximum(
        config.box.min_slab_points, config.box.min_slab_share * chosen.num_points.astype(jnp.float32)
    )
    fit_all = chosen.num_slab.astype(jnp.float32) < least
    num_fitted = jnp.where(fit_all, chosen.num_points, chosen.num_slab)
    share = sampled_share(num_fitted, config.box.max_points)
    of_point, fitted = _find_clusters(obstacles, component, chosen.row, fit_all, share, config.box)
    large, num_large = _large_clusters(chosen, config.vehicles)
    return Clusters(
        component=component[0, :num] - 1,
        of_point=of_point[:, :num],
        fitted=fitted[:, :num],
        num=jnp.sum(chosen.kept, dtype=jnp.int32),
        num_first=chosen.kept[0],
        num_points=chosen.num_points,
        low=chosen.low,
        high=chosen.high,
        large=large,
        num_large=num_large,
        num_runs=components.num_runs,
        num_found=chosen.found,
        num_slab=jnp.max(jnp.sum(fitted, axis=1, dtype=jnp.int32)),
    )


def arrange_grids(config: ClusteringConfig, region: RegionConfig) -> CellGrids:
    """Arranges the cells of the maps, which cover the region, in one row.

    Args:
      config: the maps.
      region: that they cover.

    Returns:
      The grids, which are static.
    """

    def num_cells(half_m: float, cell_m: float) -> int:
        return math.ceil(2 * half_m / cell_m)

    sides = [
        (num_cells(region.half_x_m, m.cell_m), num_cells(region.half_y_m, m.cell_m)) for m in config.maps
    ]
    return CellGrids(tuple((*side, m.num_levels) for side, m in zip(sides, config.maps, strict=True)))


def _find_cells(
    obstacles: Obstacles, grids: CellGrids, config: DetectorConfig
) -> tuple[jax.Array, jax.Array]:
    """The cell of each point on each map, (maps, O), and the flags of the occupied cells."""

    def compress(columns: tuple[jax.Array, jax.Array]) -> jax.Array:
        return compress_range(
            columns[0],
            start_m=config.clustering.adaptive_start_m,
            growth=config.clustering.adaptive_growth,
        )

    def find(xy: jax.Array, columns: tuple[jax.Array, jax.Array], valid: jax.Array) -> list[jax.Array]:
        return find_cells(xy, columns[1], valid, grids, config.clustering, config.region)

    return flag_cells(find, compress, (obstacles.xy, obstacles.height), obstacles.count, grids)


def compress_range(xy: jax.Array, *, start_m: jax.Array | float, growth: jax.Array | float) -> jax.Array:
    """Compresses far ranges, so that a fixed grid links farther apart where beams spread.

    The range becomes start + log(1 + growth (range - start)) / growth beyond the start, so a step dr out
    there shrinks by 1 + growth (range - start): the linking distance grows by that factor along the beam,
    and by somewhat less across it.

    Args:
      xy: (N, 2) float32, m, sensor frame.
      start_m: range from which the linking distance grows, m.
      growth: per metre; 0 changes nothing.

    Returns:
      (N, 2) float32, m, same direction, shorter range.

    Reference: oracle `jaxbox.reference.compress_range`.
    """
    x, y = stored_columns(xy)
    rho = jnp.sqrt(x**2 + y**2)
    beyond = jnp.maximum(rho - start_m, 0)
    # The limit of log(1 + k d) / k for k -> 0 is d.
    safe_growth = jnp.maximum(growth, 1e-6)
    drawn = jnp.where(growth > 1e-6, jnp.log1p(safe_growth * beyond) / safe_growth, beyond)
    scale = jnp.where(beyond > 0, (start_m + drawn) / jnp.maximum(rho, 1e-6), 1)
    return xy * scale[:, None]


def find_cells(
    xy: jax.Array,
    height: jax.Array,
    valid: jax.Array,
    grids: CellGrids,
    config: ClusteringConfig,
    region: RegionConfig,
) -> list[jax.Array]:
    """Cells of points on each map.

    Args:
      xy: (N, 2) float32, m; points beyond the border of the region join its edge.
      height: (N,) float32, m, above the ground; points beyond the levels join the end levels.
      valid: (N,) bool, points that count on any map.
      grids: static, see `arrange_grids`.
      config: the maps: points outside a map's heights do not count on it, and its lowest level starts at the
        least.
      region: that the maps cover.

    Returns:
      (N,) int32 of each map, `NONE` for points that do not count.
    """
    cells = []
    for i, on_map in enumerate(config.maps):
        cell = jnp.int32(grids.starts[i])
        low, high = on_map.min_height_m, on_map.max_height_m
        distances = xy[:, 0] + region.half_x_m, xy[:, 1] + region.half_y_m, height - low
        for distance, count, stride in zip(distances, grids.shapes[i], grids.strides[i], strict=True):
            index = jnp.floor(distance / on_map.cell_m).astype(jnp.int32)
            cell = cell + jnp.clip(index, 0, count - 1) * stride
        cells.append(jnp.where(valid & (height > low) & (height < high), cell, NONE))
    return cells


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
        return self.table[:, :6]

    @property
    def num_points(self) -> jax.Array:
        """(C,) int32."""
        return self.table[:, 6].astype(jnp.int32)

    @property
    def num_slab(self) -> jax.Array:
        """(C,) int32: points between the slab's heights."""
        return self.table[:, 7].astype(jnp.int32)


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
      num_points: () int32; how many points count, from the first on.
      xy: (N, 2) float32, m.
      height: (N,) float32, m, above the ground.
      in_slab: (N,) bool.
      max_components: static, C.

    Returns:
      The statistics; no points, and bounds of minus infinity, where there are none.
    """

    def describe(point: tuple[jax.Array, ...]) -> tuple[list[jax.Array], list[jax.Array]]:
        xy, height, in_slab = point
        x, y = xy[..., 0], xy[..., 1]
        return [x, y, height, -x, -y, -height], [jnp.ones_like(height), in_slab.astype(jnp.float32)]

    rows = xy, height, in_slab
    return Statistics(
        reduce_segments(describe, rows, component, num_rows=num_points, num_segments=max_components)
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ChosenComponents:
    """The components that pass the size gates, in one list of P rows: map by map, without gaps."""

    row: jax.Array
    """(C,) int32: row of each component, or P where it is not a cluster."""
    num_points: jax.Array
    """(P,) int32: points of each cluster; 0 for an empty row."""
    num_slab: jax.Array
    """(P,) int32: those of them between the slab's heights."""
    low: jax.Array
    """(P, 3) float32, m: least x, y and height above the ground of each cluster; 0 for an empty row."""
    high: jax.Array
    """(P, 3) float32, m: greatest ones."""
    found: jax.Array
    """(maps,) int32: clusters of each map that pass the gates, which may exceed its capacity."""
    kept: jax.Array
    """(maps,) int32: those in the list."""


def select_clusters(
    statistics: Statistics, first: jax.Array, config: ClusteringConfig, *, min_extent_m: jax.Array | float
) -> ChosenComponents:
    """Keeps the components that may be a vehicle: enough points, not too short, and not too long.

    Args:
      statistics: of the C components.
      first: (maps + 1,) int32: first component of each map, and one past the last.
      config: capacities of the maps, beyond which clusters are dropped, and the gates on points and extent.
      min_extent_m: least diagonal of the extents along x and y, m: no rectangle has a longer side.

    Returns:
      The clusters, in the order of the components.
    """
    upper, num_points = statistics.upper, statistics.num_points
    component = jnp.arange(num_points.shape[0], dtype=jnp.int32)
    enough = num_points.astype(jnp.float32) >= jnp.maximum(config.min_points, 1.0)
    keep = enough & (component >= first[0]) & (component < first[-1])
    extent_x, extent_y = upper[:, 0] + upper[:, 3], upper[:, 1] + upper[:, 4]
    keep = keep & (jnp.maximum(extent_x, extent_y) <= config.max_extent_m)
    keep = keep & (extent_x**2 + extent_y**2 >= min_extent_m**2)
    listed = compact_groups(keep, first, [m.max_clusters for m in config.maps])

    def describe(member: jax.Array) -> tuple[jax.Array, ...]:
        bounds = take(upper, member)
        return take(num_points, member), take(statistics.num_slab, member), -bounds[:, 3:6], bounds[:, :3]

    rows = map_rows(describe, listed.member, num_rows=listed.num)
    return ChosenComponents(listed.row, *rows, found=listed.found, kept=listed.kept)


def _find_clusters(
    obstacles: Obstacles,
    component: jax.Array,
    row: jax.Array,
    fit_all: jax.Array,
    share: jax.Array,
    config: BoxConfig,
) -> tuple[jax.Array, jax.Array]:
    """The cluster of each point on each map, and whether a rectangle is fitted to it.

    Rectangles are fitted to points between the slab's heights, or to all of the clusters with few of those;
    of many points to a share.
    """
    num_clusters = fit_all.shape[0]
    # Shares beyond the greatest say that points outside the slab count, too.
    share_and_all = jnp.where(fit_all, share + NUM_RANKS + 1, share)
    packed = pack_pairs(row, take(share_and_all, row), SHARE_BITS)

    def prepare(columns: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        xy, z, height = columns
        return _in_slab(height, config), sampling_rank(xy, z)

    def find(component: jax.Array, shared: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        in_slab, rank = shared
        cluster, share = lookup_pair(packed, component, SHARE_BITS)
        every = share > NUM_RANKS
        sampled = rank < jnp.where(every, share - (NUM_RANKS + 1), share)
        return cluster, (cluster < num_clusters) & (in_slab | every) & sampled

    return map_tables(
        find,
        component,
        num_rows=obstacles.count,
        init=(jnp.full(component.shape, num_clusters, jnp.int32), jnp.zeros(component.shape, bool)),
        prepare=prepare,
        columns=(obstacles.xy, obstacles.z, obstacles.height),
    )


def sampled_share(num_points: jax.Array, max_points: int) -> jax.Array:
    """Up to which rank the points of clusters are looked at: all of few, else about .72 `max_points`.

    Args:
      num_points: (P,) int32.
      max_points: static, M.

    Returns:
      (P,) int32, in [0, NUM_RANKS].

    Reference: oracle `jaxbox.reference.sampled_share`.
    """
    aim = jnp.int32(round(SAMPLED_SHARE * max_points) * NUM_RANKS)
    share = jax.lax.div(aim, jnp.maximum(num_points, 1))
    return jnp.where(num_points <= round(SAMPLED_FROM * max_points), NUM_RANKS, share)


def sampling_rank(xy: jax.Array, z: jax.Array) -> jax.Array:
    """Ranks points by their direction, so that those up to any rank are spread evenly over the sweep.

    The azimuth cells of one circle of beams are ranked by multiples of the golden ratio, modulo 1: of any n
    neighbours the first ones are nearly as far apart as they can be. Each circle begins elsewhere. So the
    same points are looked at in any order of the sweep, and one that moves, comes or goes changes no other.

    Args:
      xy: (N, 2) float32, m, sensor frame.
      z: (N,) float32, m, likewise.

    Returns:
      (N,) int32, in [0, NUM_RANKS).

    Reference: oracle `jaxbox.reference.sampling_rank`.
    """
    x, y = stored_columns(xy)
    column = jnp.floor(arctan2(y, x) * COLUMNS_PER_RAD)
    rho = jnp.maximum(jnp.sqrt(x**2 + y**2), MIN_RANGE_M)
    circle = jnp.floor(z / rho * CIRCLES_PER_UNIT)
    return lattice_numbers(column.astype(jnp.int32), circle.astype(jnp.int32), NUM_RANKS)


def lowest_z(z: jax.Array, obstacles: Obstacles, clusters: Clusters) -> jax.Array:
    """z of the lowest point of each cluster.

    Args:
      z: (N,) float32, m, of the sweep.
      obstacles: O of its points.
      clusters: of those.

    Returns:
      (P,) float32, m; 0 where a cluster has no point.
    """
    num_maps, num_clusters = clusters.of_point.shape[0], clusters.num_points.shape[0]
    of_point = jnp.tile(take(z, obstacles.row), num_maps)
    cluster = clusters.of_point.reshape(-1)
    lowest = segment_minima(of_point, cluster, cluster < num_clusters, num_segments=num_clusters)
    return jnp.where(jnp.isfinite(lowest), lowest, 0)


def _in_slab(height: jax.Array, config: BoxConfig) -> jax.Array:
    return (height > config.slab_min_height_m) & (height < config.slab_max_height_m)


def _large_clusters(chosen: ChosenComponents, config: VehicleConfig) -> tuple[jax.Array, jax.Array]:
    """Rows of the clusters that are high, stand on the ground and have many points; their true number."""
    stands = chosen.low[:, 2] < config.large_clearance_m
    enough = chosen.num_points.astype(jnp.float32) >= config.large_min_points
    return compact((chosen.high[:, 2] > config.large_height_m) & stands & enough, config.max_large)
