"""Euclidean clustering (paper, 3.2): on grids, and literally by KD-tree and queue (Algorithm II)."""

import collections

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

NO_CLUSTER = -1
"""Component or slot of a point that has none."""


def warp_range(xy: np.ndarray, *, start_m: float, growth: float) -> np.ndarray:
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


def grid_cells(
    xy: np.ndarray,
    height: np.ndarray,
    *,
    cell_m: float,
    num_levels: int,
    half_x_m: float,
    half_y_m: float,
    min_height_m: float,
) -> tuple[np.ndarray, tuple[int, int, int]]:
    """Cell of each point on the grid of a component map.

    Args:
      xy: (n, 2) m, within the region, warped or not.
      height: (n,) m above the ground.
      cell_m: edge of the cells.
      num_levels: cells in height; points beyond join the end levels.
      half_x_m: the grid covers |x| below this.
      half_y_m: the grid covers |y| below this.
      min_height_m: height at which the lowest level starts.

    Returns:
      (n, 3) int and the grid's shape.
    """
    half = np.array([half_x_m, half_y_m])
    planar = np.floor((xy + half) / cell_m)
    level = np.floor((height - min_height_m) / cell_m)
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


def keep_clusters(
    xy: np.ndarray, component: np.ndarray, *, min_points: float, min_extent_m: float, max_extent_m: float
) -> tuple[np.ndarray, int]:
    """Numbers the components that pass the size gates.

    Args:
      xy: (n, 2) m, true, not warped.
      component: (n,) int, from 0.
      min_points: components with fewer points are left out.
      min_extent_m: components whose extents along x and y have a shorter diagonal are left out.
      max_extent_m: components longer along x or y are left out.

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
    kept = (np.bincount(component) >= min_points) & (np.max(extents, axis=0) <= max_extent_m)
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
