"""From the points to clusters, and the classes each is tried as."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxbox import clustering
from jaxbox.config import DetectorConfig
from jaxbox.masked import compact, take
from jaxbox.steps.common import stage_options
from jaxbox.steps.points import Obstacles
from jaxbox.types import Clusters, Label


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


def list_trials(proposals: Proposals) -> Trials:
    """Lists cars first, then vans, then trucks, without gaps."""
    capacity, max_large = proposals.num_points.shape[0], proposals.large.shape[0]
    num_cars, num_large = proposals.num_clusters, jnp.minimum(proposals.num_large, max_large)
    j = jnp.arange(capacity + 2 * max_large)
    extra = j - num_cars
    is_car, is_van = j < num_cars, extra < num_large
    large = take(proposals.large, jnp.where(is_van, extra, extra - num_large), capacity)
    num = num_cars + 2 * num_large
    return Trials(
        cluster=jnp.where(j >= num, capacity, jnp.where(is_car, j, large)),
        label=jnp.where(is_car, Label.CAR, jnp.where(is_van, Label.VAN, Label.TRUCK)),
        num=num,
    )
