"""Assembly of the answer: which points each detection has, and the counts of everything."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxbox.config import DetectorConfig, VehicleConfig
from jaxbox.reference.completion import is_large
from jaxbox.reference.fronts import find_fronts
from jaxbox.reference.ground import ground_elevation
from jaxbox.reference.hull import sampled_points
from jaxbox.reference.rectangles import wrap_yaw
from jaxbox.reference.state import (
    NO_CLUSTER,
    Candidate,
    Cluster,
    Clusters,
    Completed,
    Ground,
    Kept,
    Obstacles,
    ShapeDescriptors,
    Sweep,
)
from jaxbox.reference.surroundings import distance_outside, stand_on_ground

INSIDE_TOLERANCE_M = 1e-3
"""A detection's points may lie this far outside its box: the box goes through the outermost of them."""


@dataclasses.dataclass(frozen=True)
class ReferenceDetections:
    """Vehicle boxes of one sweep of n points, best score first; the names are those of `Detections`."""

    center: np.ndarray
    """(k, 3) m, sensor frame."""
    size: np.ndarray
    """(k, 3) m: length, width, height."""
    yaw: np.ndarray
    """(k,) rad, in [-pi/2, pi/2)."""
    heading: np.ndarray
    """(k,) rad, in [-pi, pi]: where the front points."""
    front_probability: np.ndarray
    """(k,) in [.5, 1]."""
    score: np.ndarray
    """(k,) in [0, 1]."""
    label: np.ndarray
    """(k,) int: a `Label`."""
    num_points: np.ndarray
    """(k,) int: points of the box's cluster inside the box."""
    hulls: tuple[np.ndarray, ...]
    """k hulls of those points, (h, 2) m, counter-clockwise."""
    descriptors: tuple[ShapeDescriptors, ...]
    """k descriptors of those points."""
    coefficients: np.ndarray
    """(3,): a, b, c of the ground plane z = a x + b y + c."""
    found: bool
    """Whether the plane had enough support."""
    num_inliers: int
    """Candidates within the tolerance of the plane."""
    height: np.ndarray
    """(n,) m above the ground; NaN for points that are not valid or are outliers."""
    ground_mask: np.ndarray
    """(n,) bool: points on or below the ground."""
    point_component: np.ndarray
    """(n,) int: connected component in the first map, -1 where there is none."""
    point_detection: np.ndarray
    """(n,) int: row of the box that the point belongs to, -1 where there is none."""
    first_return_m: np.ndarray
    """(azimuths,) m: range of the first return at a vehicle's height."""
    counts: dict[str, Any]
    """The fields of `jaxbox.types.Counts`; a tuple where there is one number a map."""


def assign_points(
    kept: Kept, obstacles: Obstacles, clusters: Sequence[Cluster]
) -> tuple[list[np.ndarray], np.ndarray]:
    """The points of each detection's cluster that its box holds; the better detection has a point.

    Args:
      kept: k detections.
      obstacles: m points.
      clusters: of all maps.

    Returns:
      (j, 2) m of each detection, and (m,) int, the detection of each obstacle, `NO_CLUSTER` for none.
    """
    owned, owner = [], np.full(len(obstacles.row), NO_CLUSTER)
    for detection, candidate in enumerate(kept.candidates):
        members = clusters[candidate.hypothesis.cluster].members
        outside = distance_outside(obstacles.xyz[members, :2], candidate.completed.box)
        claimed = members[(outside <= INSIDE_TOLERANCE_M) & (owner[members] == NO_CLUSTER)]
        owner[claimed] = detection
        owned.append(obstacles.xyz[claimed, :2])
    return owned, owner


class Found(NamedTuple):
    """What all stages found, of which the answer is made."""

    sweep: Sweep
    ground: Ground
    obstacles: Obstacles
    maps: list[Clusters]
    clusters: list[Cluster]
    completed: Completed
    candidates: list[Candidate]
    kept: Kept
    health: dict[str, int]


def assemble(
    found: Found,
    owner: np.ndarray,
    hulls: Sequence[np.ndarray],
    num_points: np.ndarray,
    descriptors: Sequence[ShapeDescriptors],
    first_return_m: np.ndarray,
    config: DetectorConfig,
) -> ReferenceDetections:
    """Counts where everything went, and gathers the answer.

    Args:
      found: by all stages.
      owner: (m,) int, see `assign_points`.
      hulls: (h, 2) m, of the points of k detections.
      num_points: (k,) int, how many they are.
      descriptors: of their shapes.
      first_return_m: (azimuths,) m.
      config: of the detector.

    Returns:
      The detections.
    """
    ground, obstacles, winners = found.ground, found.obstacles, found.kept.candidates
    boxes = np.array([winner.completed.box for winner in winners]).reshape(-1, 5)
    vertical = np.array([_vertical(winner, found, config) for winner in winners]).reshape(-1, 2)
    component, point_detection = (np.full(len(found.sweep.xyz), NO_CLUSTER) for _ in range(2))
    component[obstacles.row], point_detection[obstacles.row] = found.maps[0].component, owner
    # NaN, the height of points that do not count, compares False.
    ground_mask = ground.height <= config.ground.min_height_m
    yaw = np.array([wrap_yaw(yaw) for yaw in boxes[:, 4]])
    labels = np.array([winner.hypothesis.label for winner in winners], int)
    owned = [owner == detection for detection in range(len(winners))]
    heading, front_probability = find_fronts(
        [obstacles.xyz[mine, :2] for mine in owned],
        [obstacles.height[mine] for mine in owned],
        np.column_stack([boxes[:, :4], yaw]),
        vertical[:, 1],
        labels,
    )
    counts = (
        _count_points(found, config)
        | found.health
        | {
            "ground_points": int(ground_mask.sum()),
            "hull_vertices": max((len(hull) for hull in hulls), default=0),
        }
    )
    return ReferenceDetections(
        center=np.column_stack([boxes[:, :2], vertical[:, 0]]),
        size=np.column_stack([boxes[:, 2:4], vertical[:, 1]]),
        yaw=yaw,
        heading=heading,
        front_probability=front_probability,
        score=np.array([winner.score for winner in winners]),
        label=labels,
        num_points=num_points,
        hulls=tuple(hulls),
        descriptors=tuple(descriptors),
        coefficients=ground.planes[0],
        found=ground.found,
        num_inliers=ground.num_inliers,
        height=ground.height,
        ground_mask=ground_mask,
        point_component=component,
        point_detection=point_detection,
        first_return_m=first_return_m,
        counts=counts,
    )


def _vertical(winner: Candidate, found: Found, config: DetectorConfig) -> tuple[float, float]:
    """Middle and height of a box along z."""
    cluster = found.clusters[winner.hypothesis.cluster]
    # z tells which of several planes the vehicle stands on.
    z = float(found.obstacles.xyz[cluster.members, 2].min())

    def elevation(xyz: np.ndarray) -> np.ndarray:
        return ground_elevation(xyz, found.ground.planes, found.ground.surface, config.ground)

    ground_z, lower = stand_on_ground(winner.completed.box, z, elevation, config.vehicles)
    bottom, height = _standing(winner, cluster, config.vehicles)
    return ground_z + bottom + (height - lower) / 2, height + lower


def _standing(winner: Candidate, cluster: Cluster, config: VehicleConfig) -> tuple[float, float]:
    """Bottom above the ground, and height, of a box; the paper keeps those of the cluster itself."""
    if not config.neighbourhood:
        return cluster.bottom_m, cluster.top_m - cluster.bottom_m
    prior = config.classes[winner.hypothesis.label]
    least = max(prior.min_box_height_m, prior.height_m if winner.top_unseen else 0.0)
    return 0.0, float(max(winner.around.top + config.top_margin_m, least))


def _count_points(found: Found, config: DetectorConfig) -> dict[str, Any]:
    """Most fields of `jaxbox.types.Counts`."""
    sweep, obstacles, box, maps = found.sweep, found.obstacles, config.box, found.maps
    height = obstacles.height
    clustered = int(np.any([of_map.of_point != NO_CLUSTER for of_map in maps], axis=0).sum())
    slab = [
        sum(len(sampled_points(cluster.members, obstacles.xyz, height, box)) for cluster in of_map.clusters)
        for of_map in maps
    ]
    return {
        "dropped_points": 0,
        "nonfinite_points": int((~sweep.finite).sum()),
        "out_of_range_points": int((sweep.finite & ~sweep.in_region).sum()),
        "outlier_points": int((sweep.in_region & ~sweep.inlier).sum()),
        "overhead_points": int((found.ground.height >= config.ground.max_height_m).sum()),
        "dropped_obstacles": obstacles.count - len(obstacles.row),
        "clustered_points": clustered,
        "unclustered_points": len(height) - clustered,
        "slab_points": max(slab),
        "cells": tuple(of_map.num_runs for of_map in maps),
        "clusters": tuple(of_map.num_found for of_map in maps),
        "large_clusters": sum(is_large(cluster, config.vehicles) for cluster in found.clusters),
        "obstacles": obstacles.count,
        "assignments": found.completed.num_assignments,
        "candidates": len(found.candidates),
        "detections": found.kept.num,
    }
