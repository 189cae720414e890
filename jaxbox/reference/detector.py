"""The whole pipeline: one sweep in, vehicle boxes out."""

import dataclasses
from typing import Any

import numpy as np

from jaxbox.config import DetectorConfig
from jaxbox.reference.boxes import ShapeDescriptors, convex_hull, shape_descriptors, wrap_yaw
from jaxbox.reference.clusters import NO_CLUSTER
from jaxbox.reference.evidence import Evidence, build_evidence
from jaxbox.reference.filtering import filter_outliers, select_points
from jaxbox.reference.ground import (
    cell_minima,
    fit_ground_planes,
    fit_ground_surface,
    ground_elevation,
    height_above_ground,
    spread_candidates,
)
from jaxbox.reference.proposals import (
    Candidate,
    Obstacles,
    find_clusters,
    index_obstacles,
    is_large,
    judge_candidates,
    make_proposals,
    select_options,
)
from jaxbox.reference.vehicles import distance_outside, suppress

INSIDE_SLACK_M = 1e-3
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
    counts: dict[str, Any]
    """The fields of `jaxbox.types.Counts`; a tuple where there is one number a map."""


@dataclasses.dataclass(frozen=True)
class _Ground:
    planes: np.ndarray
    found: bool
    num_inliers: int
    grid: np.ndarray | None


def detect(xyz: np.ndarray, config: DetectorConfig | None = None, seed: int = 0) -> ReferenceDetections:
    """Detects vehicles in one sweep: the oracle and the baseline of `jaxbox.detect`.

    Everything is float64, and no capacity binds but those that choose what is looked at:
    clustering.max_obstacles, a map's max_clusters, box.max_points, and max_large, max_candidates and
    max_detections of the vehicles.

    Args:
      xyz: (n, 3) m, sensor frame; NaN and infinity allowed.
      config: the settings; None is the default preset. Every threshold is a plain number.
      seed: of the RANSAC samples.

    Returns:
      The boxes, where every point went, and the true counts.

    >>> len(detect(np.zeros((0, 3))).score)
    0
    """
    # Thresholds may be arrays for the compiled detector; here they are numbers, and need no type.
    config = config or DetectorConfig()
    xyz = np.asarray(xyz, np.float64)
    finite, valid = select_points(xyz, half_x_m=config.region.half_x_m, half_y_m=config.region.half_y_m)
    inlier = _filter(xyz, valid, config)
    ground = _fit_ground(xyz, inlier, config, np.random.default_rng(seed))
    height = np.full(len(xyz), np.nan)
    height[inlier] = _height(xyz[inlier], ground, config)
    # NaN, the height of points that are left out, is on no side.
    is_ground = height <= config.ground.min_height_m
    is_overhead = height >= config.ground.max_height_m
    obstacle_rows = np.flatnonzero(inlier & ~is_ground & ~is_overhead)
    obstacles = index_obstacles(xyz, height, obstacle_rows[: config.clustering.max_obstacles])

    maps = [find_clusters(obstacles, component_map, config) for component_map in config.clustering.maps]
    proposals = [make_proposals(obstacles, slot, config) for _, slot, _ in maps]
    evidence = _evidence(xyz[inlier], height[inlier], ground, config)
    candidates, num_assignments = judge_candidates(proposals, obstacles, evidence, config)
    best = candidates[: config.vehicles.max_candidates]
    boxes = np.array([candidate.completed.box for candidate in best]).reshape(-1, 5)
    scores = np.array([candidate.score for candidate in best])
    rows = suppress(boxes, scores, max_overlap=float(config.vehicles.max_overlap))

    counts = {
        "dropped_points": 0,
        "nonfinite_points": int((~finite).sum()),
        "out_of_range_points": int((finite & ~valid).sum()),
        "outlier_points": int((valid & ~inlier).sum()),
        "ground_points": int(is_ground.sum()),
        "overhead_points": int(is_overhead.sum()),
        "dropped_obstacles": len(obstacle_rows) - len(obstacles.rows),
        **_cluster_counts(obstacles, maps, config),
        "large_clusters": sum(is_large(p, config) for of_map in proposals for p in of_map),
        "obstacles": len(obstacle_rows),
        "assignments": num_assignments,
        "candidates": len(candidates),
        "detections": len(rows),
    }
    component = np.full(len(xyz), NO_CLUSTER)
    component[obstacles.rows] = maps[0][0]
    winners = [best[row] for row in rows[: config.vehicles.max_detections]]
    points = {"height": height, "ground_mask": is_ground, "point_component": component}
    return _assemble(winners, obstacles, ground, counts, config=config, points=points)


def _filter(xyz: np.ndarray, valid: np.ndarray, config: Any) -> np.ndarray:
    inlier = valid.copy()
    if config.filtering.enabled:
        names = ("cell_m", "num_levels", "num_iterations", "bandwidth_m", "num_std", "min_density")
        options = select_options(config.filtering, *names) | select_options(
            config.region, "half_x_m", "half_y_m"
        )
        inlier[valid] = filter_outliers(xyz[valid], **options)
    return inlier


def _fit_ground(xyz: np.ndarray, inlier: np.ndarray, config: Any, rng: np.random.Generator) -> _Ground:
    ground = config.ground
    if ground.candidates == "cell_minima":
        half = {"half_x_m": ground.candidate_half_x_m, "half_y_m": ground.candidate_half_y_m}
        candidates = cell_minima(xyz[inlier], **half)
    else:
        candidates = spread_candidates(xyz, inlier, num_candidates=ground.num_candidates)
    names = (
        "max_planes",
        "tolerance_m",
        "num_hypotheses",
        "num_refits",
        "max_slope_deg",
        "min_inlier_fraction",
    )
    fits = fit_ground_planes(candidates, rng=rng, **select_options(ground, *names))
    planes = np.array([plane for plane, _, _ in fits])
    grid = None
    if ground.surface:
        names = ("num_envelope_rounds", "max_grade", "band_below_m", "band_below_grade", "band_above_m")
        names += ("band_above_grade", "blind_radius_m", "envelope_margin_m", "smoothing_m", "min_height_m")
        grid = fit_ground_surface(
            xyz[inlier], planes, **select_options(ground, *names), **_surface_grid(config)
        )
    return _Ground(planes, fits[0][1], fits[0][2], grid)


def _surface_grid(config: Any) -> dict[str, Any]:
    return {"cell_m": config.ground.surface_cell_m, "half_m": config.ground.surface_half_m}


def _height(xyz: np.ndarray, ground: _Ground, config: Any) -> np.ndarray:
    options = _surface_grid(config) | select_options(config.ground, "min_height_m")
    return height_above_ground(xyz, ground.planes, ground.grid, **options)


def _cluster_counts(obstacles: Obstacles, maps: list[Any], config: Any) -> dict[str, Any]:
    clustered = int(np.any([slot != NO_CLUSTER for _, slot, _ in maps], axis=0).sum())
    box, height = config.box, obstacles.height
    return {
        "clustered_points": clustered,
        "unclustered_points": len(height) - clustered,
        "slab_points": int(((height > box.slab_min_height_m) & (height < box.slab_max_height_m)).sum()),
        "cells": tuple(cells for _, _, (cells, _) in maps),
        "clusters": tuple(clusters for _, _, (_, clusters) in maps),
    }


def _evidence(xyz: np.ndarray, height: np.ndarray, ground: _Ground, config: Any) -> Evidence | None:
    if not config.evidence.enabled:
        return None
    fields = {field.name for field in dataclasses.fields(config.evidence)} - {"enabled"}
    sensor_height_m = -float(ground.planes[0, 2])
    return build_evidence(
        xyz, height, sensor_height_m=sensor_height_m, **select_options(config.evidence, *fields)
    )


def _vertical(
    candidate: Candidate, obstacles: Obstacles, ground: _Ground, config: Any
) -> tuple[float, float]:
    """Middle and height of a box along z."""
    # z tells which of several planes the vehicle stands on.
    z = obstacles.xyz[candidate.proposal.members, 2].min()
    options = _surface_grid(config) | select_options(config.ground, "min_height_m")
    place = np.append(candidate.completed.box[:2], z)[None]
    ground_z = ground_elevation(place, ground.planes, ground.grid, **options)[0]
    if not config.vehicles.neighbourhood:
        bottom, top = candidate.proposal.bottom_m, candidate.proposal.top_m
        return ground_z + (bottom + top) / 2, top - bottom
    prior = config.vehicles.classes[candidate.label]
    height = max(candidate.around.top_m + config.vehicles.top_margin_m, prior.min_box_height_m)
    return ground_z + height / 2, height


def _assemble(
    winners: list[Candidate],
    obstacles: Obstacles,
    ground: _Ground,
    counts: dict[str, Any],
    *,
    config: Any,
    points: dict[str, np.ndarray],
) -> ReferenceDetections:
    own, point_detection = _own_points(winners, obstacles, len(points["height"]))
    hulls = tuple(convex_hull(xy) for xy in own)
    boxes = np.array([w.completed.box for w in winners]).reshape(-1, 5)
    vertical = np.array([_vertical(w, obstacles, ground, config) for w in winners]).reshape(-1, 2)
    return ReferenceDetections(
        center=np.column_stack([boxes[:, :2], vertical[:, 0]]),
        size=np.column_stack([boxes[:, 2:4], vertical[:, 1]]),
        yaw=np.array([wrap_yaw(yaw) for yaw in boxes[:, 4]]),
        score=np.array([w.score for w in winners]),
        label=np.array([w.label for w in winners], int),
        num_points=np.array([len(xy) for xy in own], int),
        hulls=hulls,
        descriptors=tuple(shape_descriptors(xy, hull) for xy, hull in zip(own, hulls, strict=True)),
        coefficients=ground.planes[0],
        found=ground.found,
        num_inliers=ground.num_inliers,
        point_detection=point_detection,
        counts=counts | {"hull_vertices": max((len(hull) for hull in hulls), default=0)},
        **points,
    )


def _own_points(
    winners: list[Candidate], obstacles: Obstacles, num_points: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """x, y of the points of each box, and the box of each point of the sweep; the better box has it."""
    own, point_detection = [], np.full(num_points, NO_CLUSTER)
    for row, winner in enumerate(winners):
        members = winner.proposal.members
        inside = distance_outside(obstacles.xyz[members, :2], winner.completed.box) <= INSIDE_SLACK_M
        unclaimed = point_detection[obstacles.rows[members]] == NO_CLUSTER
        claimed = members[inside & unclaimed]
        point_detection[obstacles.rows[claimed]] = row
        own.append(obstacles.xyz[claimed, :2])
    return own, point_detection
