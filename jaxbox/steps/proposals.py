"""From the points to clusters, and the classes each is tried as."""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxbox import clustering
from jaxbox.class_priors import ClassPrior
from jaxbox.config import DetectorConfig
from jaxbox.masked import compact
from jaxbox.steps.common import stage_options
from jaxbox.steps.points import Obstacles
from jaxbox.types import Clusters, Label, Rectangles

LOWER_PART_M = 0.5
"""A cluster may be so much lower than its vehicle: the rest is another cluster, or outside the map."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Proposals:
    """The clusters of all maps in one list, and the classes each is tried as."""

    maps: tuple[Clusters, ...]
    cluster: jax.Array  # (maps, O) row of each point's cluster in the list, P for none
    num_clusters: jax.Array  # ()
    num_first: jax.Array  # () those of the first map, which come first
    num_points: jax.Array  # (P,)
    min_height: jax.Array  # (P,) m
    max_height: jax.Array  # (P,) m
    fitted: jax.Array  # (maps, O) whether a box is fitted to the point
    num_slab: jax.Array  # () points of the map that has most of those
    large: jax.Array  # (L,) clusters also tried as van and truck, P beyond
    num_large: jax.Array  # () true number


def propose_clusters(obstacles: Obstacles, config: DetectorConfig) -> Proposals:
    """Labels the components of every map, and lists the clusters that pass the size gates."""
    settings = config.clustering
    xy = clustering.warp_range(
        obstacles.xy, start_m=settings.adaptive_start_m, growth=settings.adaptive_growth
    )
    maps = []
    for m in settings.maps:
        above, below = obstacles.height > m.min_height_m, obstacles.height < m.max_height_m
        index, shape = clustering.cell_index(
            xy,
            obstacles.height,
            cell_m=m.cell_m,
            num_levels=m.num_levels,
            min_height_m=m.min_height_m,
            **stage_options(config.region),
        )
        component, num_cells = clustering.label_components(
            index, obstacles.present & above & below, shape=shape, max_cells=m.max_cells
        )
        maps.append(
            clustering.select_clusters(
                component,
                obstacles.xy,
                obstacles.height,
                num_cells,
                max_cells=m.max_cells,
                max_clusters=m.max_clusters,
                min_points=settings.min_points,
                max_extent_m=settings.max_extent_m,
            )
        )
    return _list_proposals(tuple(maps), obstacles, config)


def _list_proposals(maps: tuple[Clusters, ...], obstacles: Obstacles, config: DetectorConfig) -> Proposals:
    sizes = [m.num_points.shape[0] for m in maps]
    total = sum(sizes)
    kept = [jnp.minimum(m.num_clusters, size) for m, size in zip(maps, sizes, strict=True)]
    # The lists join without gaps, so that work on them ends with the last cluster.
    offset = [sum(kept[:i], jnp.int32(0)) for i in range(len(maps))]
    cluster = jnp.stack(
        [jnp.where(m.slot < size, m.slot + o, total) for m, size, o in zip(maps, sizes, offset, strict=True)]
    )

    def join(field: str) -> jax.Array:
        values = [getattr(m, field) for m in maps]
        joined = jnp.zeros(total, values[0].dtype)
        for value, o, k in zip(values, offset, kept, strict=True):
            slot = jnp.arange(value.shape[0])
            joined = joined.at[jnp.where(slot < k, slot + o, total)].set(value, mode="drop")
        return joined

    max_height = join("max_height")
    min_height, num_points = join("min_height"), join("num_points")
    settings = config.vehicles
    is_large = (max_height > settings.large_height_m) & (min_height < settings.large_clearance_m)
    is_large = is_large & (num_points >= settings.large_min_points)
    large, num_large = compact(is_large, settings.max_large)
    fitted = _fitted(cluster, obstacles, total, config)
    num_slab = jnp.max(jnp.sum(fitted, axis=1))
    return Proposals(
        maps,
        cluster,
        sum(kept, jnp.int32(0)),
        kept[0],
        num_points,
        min_height,
        max_height,
        fitted,
        num_slab,
        large,
        num_large,
    )


def _fitted(cluster: jax.Array, obstacles: Obstacles, num_clusters: int, config: DetectorConfig) -> jax.Array:
    """(maps, O) points between the slab's heights, or all of the clusters that have few of those."""
    settings = config.box
    in_slab = (obstacles.height > settings.slab_min_height_m) & (
        obstacles.height < settings.slab_max_height_m
    )
    count = jnp.zeros(num_clusters + 1)
    for row in cluster:
        count = count.at[row].add(in_slab)
    return (cluster < num_clusters) & (in_slab | (count[cluster] < settings.min_slab_points))


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
    row = jnp.arange(capacity)
    present = jnp.stack([row < proposals.num_clusters, *[_is_among(proposals.large, capacity)] * 2])
    fits = jnp.stack([_fits(prior, readings, config) for prior in config.vehicles.classes])
    worth_trying = present & fits & _tall(proposals, readings[0], config)
    index, num = compact(worth_trying.reshape(-1), capacity + 2 * max_large)
    present = index < worth_trying.size
    return Trials(
        cluster=jnp.where(present, index % capacity, capacity),
        label=jnp.where(present, index // capacity, Label.CAR),
        num=num,
    )


def _is_among(rows: jax.Array, size: int) -> jax.Array:
    return jnp.zeros(size, bool).at[rows].set(True, mode="drop")


def _fits(prior: ClassPrior, readings: Sequence[Rectangles], config: DetectorConfig) -> jax.Array:
    """(P,) whether some reading of a cluster is no larger than a class, and not too small to tell."""
    fits = jnp.zeros_like(readings[0].angle, bool)
    for rectangles in readings:
        long, short = longest_side(rectangles), jnp.min(rectangles.high - rectangles.low, axis=1)
        small = (long <= prior.max_length_m) & (short <= prior.max_width_m)
        fits = fits | (small & (long >= config.vehicles.min_extent_m))
    return fits


def _tall(proposals: Proposals, rectangles: Rectangles, config: DetectorConfig) -> jax.Array:
    """(P,) whether a cluster can be (the lower part of) the lowest class, given the beams' spacing."""
    vehicles = config.vehicles
    rho = jnp.linalg.norm((rectangles.low + rectangles.high) / 2, axis=1)
    lowest = functools.reduce(jnp.minimum, [prior.min_height_m for prior in vehicles.classes])
    return proposals.max_height + vehicles.top_grade * rho > lowest - LOWER_PART_M


def longest_side(rectangles: Rectangles) -> jax.Array:
    """(P,) float32, m."""
    return jnp.max(rectangles.high - rectangles.low, axis=1)
