"""Euclidean clustering (paper, 3.2): on grids, and literally by KD-tree and queue (Algorithm II)."""

import collections

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from jaxbox.config import ClusteringConfig, ComponentMap, DetectorConfig, RegionConfig
from jaxbox.reference.state import NO_CLUSTER, Cluster, Clusters, Obstacles

NUM_RANKS = 2**12
"""Ranks of points are numbers below this."""

PLASTIC_RATIO = 1.324717957244746
"""The real root of x^3 = x + 1."""


def propose_clusters(obstacles: Obstacles, config: DetectorConfig) -> list[Clusters]:
    """Labels the components of every map, and lists the clusters that pass the size gates.

    Args:
      obstacles: m points.
      config: of the detector.

    Returns:
      The clusters of each map.
    """
    return [find_clusters(obstacles, component_map, config) for component_map in config.clustering.maps]


def find_clusters(obstacles: Obstacles, component_map: ComponentMap, config: DetectorConfig) -> Clusters:
    """Finds the clusters of one component map.

    Args:
      obstacles: m points.
      component_map: the map.
      config: of the detector.

    Returns:
      The clusters; those beyond the capacity of the map are dropped, and counted.
    """
    height, clustering = obstacles.height, config.clustering
    member = (height > component_map.min_height_m) & (height < component_map.max_height_m)
    xy = obstacles.xyz[member, :2]
    near = compress_range(
        xy, start_m=float(clustering.adaptive_start_m), growth=float(clustering.adaptive_growth)
    )
    cells, shape = find_cells(near, height[member], component_map, config.region)
    component, of_point = np.full(len(member), NO_CLUSTER), np.full(len(member), NO_CLUSTER)
    component[member] = label_components(cells, shape)
    of_point[member], num_found = select_clusters(
        xy, component[member], clustering, min_extent_m=float(config.vehicles.min_extent_m)
    )
    of_point[of_point >= component_map.max_clusters] = NO_CLUSTER
    return Clusters(
        component, of_point, _list_clusters(of_point, height), count_runs(cells, shape), num_found
    )


def sampled_share(num_points: int, max_points: int) -> int:
    """Up to which rank the points of a cluster are looked at: all of few, else about .72 max_points.

    Args:
      num_points: of the cluster.
      max_points: how many are looked at, at most.

    Returns:
      In [0, NUM_RANKS].
    """
    if num_points <= round(0.9 * max_points):
        return NUM_RANKS
    return round(0.72 * max_points) * NUM_RANKS // num_points


def sampling_rank(xyz: np.ndarray) -> np.ndarray:
    """Ranks points by the cells of azimuth (1 / 652 rad) and slope (.005 m/m) that they lie in.

    Cell i, j has rank i / golden ratio + j / plastic ratio, modulo 1.

    Args:
      xyz: (n, 3) m, sensor frame.

    Returns:
      (n,) int, in [0, NUM_RANKS).
    """
    x, y, z = xyz.T
    column = np.floor(np.arctan2(y, x) * 652).astype(int)
    circle = np.floor(z / np.maximum(np.hypot(x, y), 0.1) * 200).astype(int)
    golden, plastic = (int(2**32 / ratio) for ratio in ((1 + 5**0.5) / 2, PLASTIC_RATIO))
    return (column * golden + circle * plastic) % 2**32 * NUM_RANKS // 2**32


def _list_clusters(of_point: np.ndarray, height: np.ndarray) -> list[Cluster]:
    order = np.argsort(of_point, kind="stable")
    order = order[of_point[order] != NO_CLUSTER]
    starts = np.flatnonzero(np.diff(of_point[order])) + 1
    groups = np.split(order, starts) if len(order) else []
    return [Cluster(rows, float(height[rows].min()), float(height[rows].max())) for rows in groups]


def compress_range(xy: np.ndarray, *, start_m: float, growth: float) -> np.ndarray:
    """Draws far points together, so that a fixed cell links over a distance that grows with range.

    rho' = rho up to the start, start + log(1 + growth (rho - start)) / growth beyond.

    Args:
      xy: (n, 2) m, sensor frame.
      start_m: range from which the linking distance grows.
      growth: its growth per metre; 0 changes nothing.

    Returns:
      (n, 2) m.
    """
    if growth == 0:
        return xy
    rho = np.hypot(xy[:, 0], xy[:, 1])
    beyond = np.maximum(rho - start_m, 0.0)
    warped = np.minimum(rho, start_m) + np.log1p(growth * beyond) / growth
    return xy * (warped / np.where(rho > 0, rho, 1.0))[:, None]


def find_cells(
    xy: np.ndarray, height: np.ndarray, component_map: ComponentMap, region: RegionConfig
) -> tuple[np.ndarray, tuple[int, int, int]]:
    """Cell of each point on the grid of a component map.

    Args:
      xy: (n, 2) m, within the region, compressed or not.
      height: (n,) m above the ground.
      component_map: its lowest level starts at its least height; points beyond join the end levels.
      region: that the grid covers.

    Returns:
      (n, 3) int and the grid's shape.
    """
    cell_m, num_levels = component_map.cell_m, component_map.num_levels
    half = np.array([region.half_x_m, region.half_y_m])
    planar = np.floor((xy + half) / cell_m)
    level = np.floor((height - component_map.min_height_m) / cell_m)
    num_x, num_y = np.ceil(2 * half / cell_m).astype(int)
    shape = (int(num_x), int(num_y), num_levels)
    cells = np.column_stack([planar, level])
    return np.clip(cells, 0, np.array(shape) - 1).astype(int), shape


def label_components(cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Connected components of the occupied cells, diagonal neighbours included.

    Args:
      cells: (n, d) int, the cell of each point.
      shape: of the grid, d numbers.

    Returns:
      (n,) int: component of each point, numbered from 0 by its first cell in row-major order.

    >>> label_components(np.array([[5, 5], [0, 1], [1, 2], [5, 6]]), (8, 8)).tolist()
    [1, 0, 0, 1]
    """
    occupied = np.zeros(shape, bool)
    occupied[tuple(cells.T)] = True
    labels = np.zeros(shape, np.int32)
    ndimage.label(occupied, np.ones((3,) * len(shape)), output=labels)
    # Not left to the numbering of ndimage.label, which it does not promise.
    _, first = np.unique(labels[occupied], return_index=True)
    rank = np.argsort(np.argsort(first))
    return rank[labels[tuple(cells.T)] - 1]


def count_runs(cells: np.ndarray, shape: tuple[int, int, int]) -> int:
    """Runs of occupied cells: neighbours along y, or in height where the grid has levels, count once.

    Args:
      cells: (n, 3) int, the cell of each point.
      shape: of the grid.

    Returns:
      Their number.

    >>> count_runs(np.array([[5, 5, 0], [5, 6, 0], [5, 6, 0], [6, 5, 0]]), (8, 8, 1))
    2
    """
    occupied = np.zeros(shape, bool)
    occupied[tuple(cells.T)] = True
    line = np.moveaxis(occupied, 1 if shape[2] == 1 else 2, 0)
    return int(line[0].sum() + (line[1:] & ~line[:-1]).sum())


def select_clusters(
    xy: np.ndarray, component: np.ndarray, config: ClusteringConfig, *, min_extent_m: float
) -> tuple[np.ndarray, int]:
    """Numbers the components that pass the size gates.

    Args:
      xy: (n, 2) m, true, not compressed.
      component: (n,) int, from 0.
      config: components with fewer points, or longer along x or y, are dropped.
      min_extent_m: components whose extents along x and y have a shorter diagonal are dropped.

    Returns:
      (n,) int: cluster of each point in the order of the components, `NO_CLUSTER` where it has none;
      and the number of clusters.
    """
    if len(xy) == 0:
        return np.zeros(0, int), 0
    ids = np.arange(component.max() + 1)
    extents = [
        ndimage.maximum(xy[:, axis], component, ids) - ndimage.minimum(xy[:, axis], component, ids)
        for axis in range(2)
    ]
    kept = (np.bincount(component) >= config.min_points) & (np.max(extents, axis=0) <= config.max_extent_m)
    kept &= np.hypot(*extents) >= min_extent_m
    slot = np.where(kept, np.cumsum(kept) - 1, NO_CLUSTER)
    return slot[component], int(kept.sum())


def euclidean_clusters(xyz: np.ndarray, *, radius_m: float) -> np.ndarray:
    """Clusters of points linked by hops of at most the radius: KD-tree and queue (Algorithm II).

    Args:
      xyz: (n, d) m.
      radius_m: longest hop, inclusive.

    Returns:
      (n,) int: cluster of each point, numbered from 0 by its first point.
    """
    cluster = np.full(len(xyz), NO_CLUSTER)
    if len(xyz) == 0:
        return cluster
    tree = KDTree(xyz)
    count = 0
    for seed in range(len(xyz)):
        if cluster[seed] != NO_CLUSTER:
            continue
        cluster[seed] = count
        queue = collections.deque([seed])
        while queue:
            near = np.array(tree.query_ball_point(xyz[queue.popleft()], radius_m))
            new = near[cluster[near] == NO_CLUSTER]
            cluster[new] = count
            queue.extend(new)
        count += 1
    return cluster
