"""From the points to clusters, and the classes each is tried as."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox.config import DetectorConfig
from jaxbox.config.class_priors import ClassPrior
from jaxbox.stages import clustering, selection
from jaxbox.steps.common import stage_options
from jaxbox.steps.points import Obstacles
from jaxbox.types import Clusters, Label, Rectangles
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.loops import fold_rows, for_chunks, map_rows, store
from jaxbox.xla.masked import compact, lookup, split_index, take

CHUNK = 8192
"""Points looked up at a time."""

LOWER_PART_M = 0.5
"""A cluster may be so much lower than its vehicle: the rest is another cluster, or outside the map."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Proposals:
    """The clusters of all maps in one list, and the classes each is tried as."""

    component: jax.Array  # (O,) connected component of each point on the first map, -1 for none
    cluster: jax.Array  # (maps, O) row of each point's cluster in the list, P for none
    num_runs: jax.Array  # (maps,) runs of occupied cells
    num_found: jax.Array  # (maps,) clusters that pass the gates
    num_clusters: jax.Array  # ()
    num_first: jax.Array  # () those of the first map, which come first
    num_points: jax.Array  # (P,)
    low: jax.Array  # (P, 3) m: least x, y and height
    high: jax.Array  # (P, 3) m: greatest ones
    fitted: jax.Array  # (maps, O) whether a box is fitted to the point
    num_slab: jax.Array  # () points of the map that has most of those
    large: jax.Array  # (L,) clusters also tried as van and truck, P beyond
    num_large: jax.Array  # () true number


def propose_clusters(obstacles: Obstacles, config: DetectorConfig) -> Proposals:
    """Labels the components of every map, and lists the clusters that pass the size gates."""
    settings, maps = config.clustering, config.clustering.maps
    cells = clustering.arrange_cells(
        [m.cell_m for m in maps], [m.num_levels for m in maps], **stage_options(config.region)
    )
    cell, flags = _find_cells(obstacles, cells, config)
    components = clustering.label_components(flags, cells, max_runs=sum(m.max_cells for m in maps))
    component = _find_components(obstacles, cell, components)
    num = obstacles.height.shape[0]
    statistics = selection.find_statistics(
        component[:, :num],
        obstacles.count,
        obstacles.xy,
        obstacles.height,
        _in_slab(obstacles.height, config),
        max_components=components.of_run.shape[0],
    )
    clusters = selection.select_clusters(
        statistics,
        components.first,
        max_clusters=[m.max_clusters for m in maps],
        min_points=settings.min_points,
        min_extent_m=config.vehicles.min_extent_m,
        max_extent_m=settings.max_extent_m,
    )
    all_fitted = clusters.num_slab.astype(jnp.float32) < config.box.min_slab_points
    cluster, fitted = _find_clusters(obstacles, component, clusters.row, all_fitted, config)
    num_fitted = jnp.where(all_fitted, clusters.num_points, clusters.num_slab)
    large, num_large = _large_clusters(clusters, config)
    return Proposals(
        component=component[0, :num] - 1,
        cluster=cluster[:, :num],
        num_runs=components.num_runs,
        num_found=clusters.found,
        num_clusters=jnp.sum(clusters.kept, dtype=jnp.int32),
        num_first=clusters.kept[0],
        num_points=clusters.num_points,
        low=clusters.low,
        high=clusters.high,
        fitted=fitted[:, :num],
        num_slab=jnp.max(clusters.sum_by_map(num_fitted)),
        large=large,
        num_large=num_large,
    )


def _fold_chunks(step: Callable[[jax.Array, Any], Any], init: Any, obstacles: Obstacles) -> Any:
    """Calls a step with the first row of each chunk that holds points, and its state.

    On an accelerator once, with all points: the host would wait for the end of each chunk.
    """
    if on_accelerator():
        return step(jnp.uint32(0), init)
    return for_chunks(obstacles.count, CHUNK, step, init, capacity=obstacles.height.shape[0])


def _for_maps(num_maps: int, step: Callable[[jax.Array, Any], Any], state: Any) -> Any:
    """Map after map: what is written out for each would have kernels for each."""
    if on_accelerator():
        return functools.reduce(lambda state, i: step(jnp.uint32(i), state), range(num_maps), state)
    return jax.lax.fori_loop(jnp.uint32(0), jnp.uint32(num_maps), step, state)


def _chunk_size(num_rows: int) -> int:
    """Points taken at a time: on an accelerator all."""
    return num_rows if on_accelerator() else CHUNK


def _chunk(values: jax.Array, start: jax.Array) -> jax.Array:
    """Rows of a chunk; zeros beyond the last."""
    if on_accelerator():
        return values
    whole = jnp.pad(values, [(0, -values.shape[0] % CHUNK)] + [(0, 0)] * (values.ndim - 1))
    return jax.lax.dynamic_slice_in_dim(whole, start, CHUNK)


def _on_map(table: jax.Array, i: jax.Array, start: jax.Array) -> jax.Array:
    """(CHUNK,) what a table (maps, O) says of a chunk of points on map i."""
    return jax.lax.dynamic_slice(table, (i, start), (1, _chunk_size(table.shape[1])))[0]


def _store(table: jax.Array, i: jax.Array, start: jax.Array, values: jax.Array) -> jax.Array:
    return jax.lax.dynamic_update_slice(table, jnp.atleast_2d(values), (i, start))


def _find_cells(
    obstacles: Obstacles, cells: clustering.CellRow, config: DetectorConfig
) -> tuple[jax.Array, jax.Array]:
    """The cell of each point on each map, (maps, O), and the flags of the occupied cells."""
    settings, maps = config.clustering, config.clustering.maps
    warp = functools.partial(
        clustering.warp_range, start_m=settings.adaptive_start_m, growth=settings.adaptive_growth
    )
    find = functools.partial(
        clustering.find_cells,
        row=cells,
        cell_m=[m.cell_m for m in maps],
        min_height_m=[m.min_height_m for m in maps],
        max_height_m=[m.max_height_m for m in maps],
        **stage_options(config.region),
    )

    size = obstacles.height.shape[0]
    row = jnp.arange(_chunk_size(size), dtype=jnp.int32)

    def step(start: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        table, flags = state
        present = start.astype(jnp.int32) + row < obstacles.count
        # Stored, or each map would draw the points together anew.
        xy = store(warp(_chunk(obstacles.xy, start)))
        found = find(xy, _chunk(obstacles.height, start), present)
        # One scatter for all maps reads and writes the flags once, which counts in a batch on an accelerator.
        for i, cell in enumerate([jnp.stack(found)] if on_accelerator() else found):
            flags = flags.at[cells.flag(cell)].set(1, mode="promise_in_bounds")
            table = _store(table, jnp.uint32(i), start, cell)
        return table, flags

    table = jnp.zeros((len(maps), size + -size % _chunk_size(size)), jnp.int32)
    return _fold_chunks(step, (table, jnp.zeros(cells.num_flags, jnp.uint8)), obstacles)


def _find_components(obstacles: Obstacles, cell: jax.Array, components: clustering.Components) -> jax.Array:
    """The component of each point on each map, (maps, O)."""

    def step(start: jax.Array, table: jax.Array) -> jax.Array:
        def on_map(i: jax.Array, table: jax.Array) -> jax.Array:
            # Look-ups do not vectorise within the write of a chunk (XLA, CPU).
            return _store(table, i, start, store(components.at(_on_map(cell, i, start))))

        return _for_maps(len(cell), on_map, table)

    return _fold_chunks(step, jnp.zeros_like(cell), obstacles)


def _in_slab(height: jax.Array, config: DetectorConfig) -> jax.Array:
    return (height > config.box.slab_min_height_m) & (height < config.box.slab_max_height_m)


def _find_clusters(
    obstacles: Obstacles, component: jax.Array, row: jax.Array, all_fitted: jax.Array, config: DetectorConfig
) -> tuple[jax.Array, jax.Array]:
    """The cluster of each point on each map, and whether a box is fitted to it.

    Boxes are fitted to points between the slab's heights, or to all of the clusters that have few of those.
    """
    num_clusters = all_fitted.shape[0]
    # One look-up answers both.
    code = 2 * row + take(all_fitted, row).astype(jnp.int32)

    def step(start: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        in_slab = store(_in_slab(_chunk(obstacles.height, start), config))

        def on_map(i: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            table, fitted = state
            found = lookup(code, _on_map(component, i, start))
            cluster, every = found >> 1, found & 1 == 1
            is_fitted = (cluster < num_clusters) & (in_slab | every)
            return _store(table, i, start, cluster), _store(fitted, i, start, is_fitted)

        return _for_maps(len(component), on_map, state)

    init = jnp.full(component.shape, num_clusters, jnp.int32), jnp.zeros(component.shape, bool)
    return _fold_chunks(step, init, obstacles)


def _large_clusters(clusters: Clusters, config: DetectorConfig) -> tuple[jax.Array, jax.Array]:
    settings = config.vehicles
    stands = clusters.low[:, 2] < settings.large_clearance_m
    enough = clusters.num_points.astype(jnp.float32) >= settings.large_min_points
    return compact((clusters.high[:, 2] > settings.large_height_m) & stands & enough, settings.max_large)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Trials:
    """Each cluster as a car, and the large ones as a van and as a truck too: Q trials."""

    cluster: jax.Array  # (Q,) row of the cluster, P beyond
    label: jax.Array  # (Q,) class
    num: jax.Array  # ()


def list_trials(proposals: Proposals, readings: Sequence[Rectangles], config: DetectorConfig) -> Trials:
    """Lists cars first, then vans, then trucks, without gaps: those that a gate would not refuse anyway."""
    capacity, max_large = proposals.num_points.shape[0], proposals.large.shape[0]
    is_large = fold_rows(
        lambda flags, _, row: flags.at[row].set(True, mode="drop"),
        jnp.zeros(capacity, bool),
        proposals.large,
        num_rows=proposals.num_large,
        absent=capacity,
    )

    def is_worth_trying(rows: tuple[jax.Array, ...]) -> jax.Array:
        is_large, high, *each = rows
        rectangles = [Rectangles(rows) for rows in each]
        fits = [_fits(prior, rectangles, config) for prior in config.vehicles.classes]
        tried = jnp.stack([fits[0], *(is_large & other for other in fits[1:])], axis=1)
        return tried & _tall(high[:, 2], rectangles[0], config)[:, None]

    rows = is_large, proposals.high, *(rectangles.rows for rectangles in readings)
    worth_trying = map_rows(is_worth_trying, rows, num_rows=proposals.num_clusters).T
    worth_trying = worth_trying & (jnp.arange(capacity, dtype=jnp.int32) < proposals.num_clusters)[None]
    index, num = compact(worth_trying.reshape(-1), capacity + 2 * max_large)
    present = index < worth_trying.size
    label, cluster = split_index(index, capacity)
    return Trials(
        cluster=jnp.where(present, cluster, capacity),
        label=jnp.where(present, label, Label.CAR),
        num=num,
    )


def _fits(prior: ClassPrior, readings: Sequence[Rectangles], config: DetectorConfig) -> jax.Array:
    """(P,) whether some reading of a cluster is no larger than a class, and not too small to tell."""
    fits = jnp.zeros_like(readings[0].angle, bool)
    for rectangles in readings:
        long, short = longest_side(rectangles), jnp.min(rectangles.high - rectangles.low, axis=1)
        small = (long <= prior.max_length_m) & (short <= prior.max_width_m)
        fits = fits | (small & (long >= config.vehicles.min_extent_m))
    return fits


def _tall(high: jax.Array, rectangles: Rectangles, config: DetectorConfig) -> jax.Array:
    """(P,) whether a cluster can be (the lower part of) the lowest class, given the beams' spacing."""
    vehicles = config.vehicles
    rho = jnp.linalg.norm((rectangles.low + rectangles.high) / 2, axis=1)
    lowest = functools.reduce(jnp.minimum, [prior.min_height_m for prior in vehicles.classes])
    return high + vehicles.top_grade * rho > lowest - LOWER_PART_M


def longest_side(rectangles: Rectangles) -> jax.Array:
    """(P,) float32, m."""
    return jnp.max(rectangles.high - rectangles.low, axis=1)
