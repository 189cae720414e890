"""Single steps of the detector on an array of points: the ground, the clusters, and boxes round clusters.

Each is the pipeline's own stages, compiled once for each capacity and preset, with what goes before it.
"""

import dataclasses
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxbox._box import ByValue
from jaxbox._padding import fitting_capacity
from jaxbox.config import DetectorConfig
from jaxbox.config.capacities import CAPACITIES
from jaxbox.config.checks import check_config
from jaxbox.run.arguments import as_config, as_key, as_points
from jaxbox.run.compiled import PackedConfig
from jaxbox.stages import clustering, filtering, ground, rectangles
from jaxbox.stages.state import Ground, Obstacles, Outlines, Sweep
from jaxbox.types import GroundPlane, PointCloud
from jaxbox.xla.backend import building_for, on_accelerator
from jaxbox.xla.barriers import outline
from jaxbox.xla.ragged import PointLists
from jaxbox.xla.transfer import to_host

_MIN_CLUSTERS = 64
"""Boxes are fitted to this many clusters, twice as many, and so on: one compile each."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class GroundPoints(ByValue):
    """Which points of a sweep are ground, and how high the others are above it."""

    is_ground: np.ndarray
    """(n,) bool: lower than ``ground.min_height_m`` above the ground."""
    is_obstacle: np.ndarray
    """(n,) bool: higher than that, and lower than ``ground.max_height_m``: what may be a vehicle."""
    height_m: np.ndarray
    """(n,) float32, m, above the ground; NaN for points that are not finite or out of the region."""
    plane: GroundPlane
    """The plane that carries the most support."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ClusterBoxes(ByValue):
    """The upright box round each cluster's points, as they were measured."""

    cluster: np.ndarray
    """(k,) int: number of the cluster, ascending."""
    center: np.ndarray
    """(k, 3) float64, m, sensor frame."""
    size: np.ndarray
    """(k, 3) float64, m: length >= width, height."""
    yaw: np.ndarray
    """(k,) float64, rad, in [-pi/2, pi/2): length axis from +x about +z."""
    num_points: np.ndarray
    """(k,) int: points of the cluster."""

    def __len__(self) -> int:
        """k."""
        return len(self.cluster)


def remove_ground(
    xyz: ArrayLike, config: DetectorConfig | str | None = None, key: jax.Array | int | None = None
) -> GroundPoints:
    """Finds the ground of a sweep: RANSAC planes, and a grid over them for uneven roads.

    ``xyz[~jaxbox.remove_ground(xyz).is_ground]`` is the sweep without it.

    Args:
      xyz: (n, 3 or more) m, sensor frame.
      config: as `jaxbox.detect` takes it: its region, filtering and ground count.
      key: as `jaxbox.detect` takes it.

    Returns:
      What each point is; ``is_ground`` is `Detections.ground_mask`.

    Raises:
      TypeError: for anything but an array.
      ValueError: for another shape, or more points than the largest usual capacity.

    Reference: paper, 3.1 and Algorithm I; oracle `jaxbox.reference.ground`.
    """
    config = as_config(config)
    cloud, packed = _operands(xyz, config, "jaxbox.remove_ground")
    sweep, terrain = _on_host(_find_ground(cloud, packed, as_key(key)))
    rows, height = slice(0, int(cloud.num_points)), terrain.height
    low_m, high_m = (np.float32(limit) for limit in (config.ground.min_height_m, config.ground.max_height_m))
    return GroundPoints(
        is_ground=(sweep.inlier & (height <= low_m))[rows],
        is_obstacle=(sweep.inlier & (height > low_m) & (height < high_m))[rows],
        height_m=np.where(sweep.in_region, height, np.float32(np.nan))[rows],
        plane=terrain.plane,
    )


def cluster_points(
    xyz: ArrayLike, config: DetectorConfig | str | None = None, key: jax.Array | int | None = None
) -> np.ndarray:
    """Clusters the points of a sweep that stand above its ground: connected components of fine cells.

    Args:
      xyz: (n, 3 or more) m, sensor frame, with the ground, which is removed first.
      config: as `jaxbox.detect` takes it: its region, filtering, ground and first map count.
      key: as `jaxbox.detect` takes it.

    Returns:
      (n,) int32: number of each point's cluster, -1 for none; it is `Detections.point_component`.

    Raises:
      TypeError: for anything but an array.
      ValueError: for another shape, or more points than the largest usual capacity.
      RuntimeError: where a capacity of the configuration is too small, naming it.

    Reference: paper, 3.2 and Algorithm II; oracle `jaxbox.reference.clustering`.
    """
    config = as_config(config)
    cloud, packed = _operands(xyz, config, "jaxbox.cluster_points")
    cluster, counted = _on_host(_find_clusters(cloud, packed, as_key(key)))
    for row in CAPACITIES:
        if row.count in counted and row.is_exceeded(types.SimpleNamespace(**counted), config, cloud.capacity):
            needed = np.atleast_1d(counted[row.count]).tolist()
            raise RuntimeError(f"{row.overflow}: {row.field} must be at least {needed}.")
    return cluster[: int(cloud.num_points)]


def fit_boxes(
    xyz: ArrayLike,
    cluster: ArrayLike | None = None,
    config: DetectorConfig | str | None = None,
    key: jax.Array | int | None = None,
) -> ClusterBoxes:
    """Fits an upright box to each cluster: the rotation that the preset's criterion likes best, of all.

    The boxes hold the points and no more: hidden sides are not completed, and no box is a class. With
    ``config="paper"`` it is the rectangle of the smallest area.

    Args:
      xyz: (n, 3 or more) m, sensor frame.
      cluster: (n,) int, the number of each point's cluster, negative for none, from any source; None for
        those of `cluster_points`.
      config: as `jaxbox.detect` takes it: its ``box`` counts, but for the slab and the scene's direction.
      key: for `cluster_points`, where it is asked.

    Returns:
      A box for each cluster that has points.

    Raises:
      TypeError: for anything but an array.
      ValueError: for another shape, clusters of another number of points, or points that are not finite.
      RuntimeError: as `cluster_points`.

    Reference: paper, 3.4 and Algorithm III; oracle `jaxbox.reference.rectangles`.
    """
    config = as_config(config)
    points, _ = as_points(xyz, called="jaxbox.fit_boxes", takes_clouds=False)
    numbers = (
        cluster_points(points, config, key) if cluster is None else _checked_numbers(cluster, len(points))
    )
    chosen = np.flatnonzero(numbers >= 0)
    order = chosen[np.argsort(numbers[chosen], kind="stable")]
    ordered = points[order].astype(np.float64)
    if not np.isfinite(ordered).all():
        raise ValueError("points of a cluster are not finite; give them the number -1, for none.")
    names, start, total = np.unique(numbers[order], return_index=True, return_counts=True)
    if not len(names):
        return ClusterBoxes(
            cluster=names, center=np.zeros((0, 3)), size=np.zeros((0, 3)), yaw=np.zeros(0), num_points=total
        )
    angle = _best_angles(ordered[:, :2], start, total, config)
    return ClusterBoxes(cluster=names, num_points=total, **_boxes_along(angle, ordered, start, total))


def _operands(xyz: ArrayLike, config: DetectorConfig, called: str) -> tuple[PointCloud, PackedConfig]:
    check_config(config)
    points, _ = as_points(xyz, called=called, takes_clouds=False)
    cloud = PointCloud.from_numpy(points)
    if len(points) > cloud.capacity:
        raise ValueError(f"{called} takes {cloud.capacity} points at most, and these are {len(points)}.")
    return cloud, PackedConfig.pack(config, accelerator=on_accelerator(cloud.xyz1))


def _on_host(tree: Any) -> Any:
    return to_host(tree, jax.tree.leaves(tree)[0])


def _ground_of(cloud: PointCloud, config: DetectorConfig, key: jax.Array) -> tuple[Sweep, Ground]:
    sweep = outline(filtering.select_points, cloud, config.filtering, config.region)
    return sweep, outline(ground.remove_ground, sweep, config.ground, key)


@jax.jit
def _find_ground(cloud: PointCloud, packed: PackedConfig, key: jax.Array) -> tuple[Sweep, Ground]:
    with building_for(accelerator=packed.accelerator):
        return _ground_of(cloud, packed.unpack(), key)


@jax.jit
def _find_clusters(
    cloud: PointCloud, packed: PackedConfig, key: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The cluster (N,) of each point, and what the capacities had to hold."""
    with building_for(accelerator=packed.accelerator):
        config = packed.unpack()
        sweep, terrain = _ground_of(cloud, config, key)
        obstacles: Obstacles = outline(ground.gather_obstacles, sweep, terrain, config)
        clusters = outline(clustering.propose_clusters, obstacles, config)
        nowhere = jnp.full(cloud.capacity, -1, jnp.int32)
        cluster = nowhere.at[obstacles.row].set(clusters.component, mode="drop")
        return cluster, {"obstacles": obstacles.count, "cells": clusters.num_runs}


@jax.jit
def _find_angles(points: PointLists, num_clusters: jax.Array, packed: PackedConfig) -> jax.Array:
    with building_for(accelerator=packed.accelerator):
        config = packed.unpack().box
        rotations = rectangles.fit_rectangles(Outlines(points, jnp.int32(0)), num_clusters, config)
        no_preference = jnp.zeros(config.num_angles, jnp.float32)
        return rectangles.choose_rectangles(rotations, num_clusters, no_preference).angle


def _best_angles(xy: np.ndarray, start: np.ndarray, total: np.ndarray, config: DetectorConfig) -> np.ndarray:
    """(k,) rad, in [0, pi/2), of clusters whose points (n, 2) lie one after the other, padded."""
    if config.box.fit_to == "hull":
        xy, start, total = _hulls(xy, start, total)
    num_clusters, capacity = len(start), _MIN_CLUSTERS
    while capacity < num_clusters:
        capacity *= 2

    def padded(values: np.ndarray, size: int, dtype: Any) -> np.ndarray:
        return np.pad(values.astype(dtype), (0, size - len(values)))

    num_entries = max(fitting_capacity(len(xy)), len(xy))
    x, y = (padded(column, num_entries, np.float32) for column in xy.T)
    begin, count = (padded(values, capacity, np.int32) for values in (start, total))
    # NumPy's arrays, which a compiled function takes as well.
    lists = PointLists(x, y, begin, count, config.box.max_points)  # pyright: ignore[reportArgumentType]
    packed = PackedConfig.pack(config, accelerator=on_accelerator())
    return np.asarray(_find_angles(lists, np.int32(num_clusters), packed), np.float64)[:num_clusters]


def _hulls(xy: np.ndarray, start: np.ndarray, total: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The convex hulls of clusters, given as their points are: the smallest rectangle is that of the hull."""
    import cv2  # noqa: PLC0415 (heavy: `import jaxbox` goes without)

    points = xy.astype(np.float32)
    hulls = [cv2.convexHull(points[i : i + n])[:, 0] for i, n in zip(start, total, strict=True)]
    sizes = np.array([len(vertices) for vertices in hulls])
    return np.concatenate(hulls), np.cumsum(sizes) - sizes, sizes


def _boxes_along(
    angle: np.ndarray, xyz: np.ndarray, start: np.ndarray, total: np.ndarray
) -> dict[str, np.ndarray]:
    """The boxes at those angles that hold all points."""
    cos, sin = np.repeat(np.cos(angle), total), np.repeat(np.sin(angle), total)
    x, y, z = xyz.T
    local = np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=1)
    low, high = np.minimum.reduceat(local, start), np.maximum.reduceat(local, start)
    (u, v, w), size = ((low + high) / 2).T, high - low
    center = np.stack(
        [np.cos(angle) * u - np.sin(angle) * v, np.sin(angle) * u + np.cos(angle) * v, w], axis=1
    )
    across = size[:, 1] > size[:, 0]
    size[across, :2] = size[across, 1::-1]
    yaw = angle + np.where(across, np.pi / 2, 0)
    return {"center": center, "size": size, "yaw": np.where(yaw >= np.pi / 2, yaw - np.pi, yaw)}


def _checked_numbers(cluster: ArrayLike, num_points: int) -> np.ndarray:
    numbers = np.asarray(cluster)
    if numbers.shape != (num_points,) or numbers.dtype.kind not in "iu":
        raise ValueError(
            f"cluster has shape {numbers.shape} and type {numbers.dtype}; it must be ({num_points},) "
            "integers, the number of each point's cluster, -1 for none."
        )
    return numbers
