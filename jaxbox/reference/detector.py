"""The whole pipeline: one sweep in, vehicle boxes out."""

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from jaxbox.config import ClassPrior, ComponentMap, DetectorConfig
from jaxbox.reference.boxes import (
    ShapeDescriptors,
    convex_hull,
    criterion_curve,
    fit_points,
    shape_descriptors,
    wrap_yaw,
)
from jaxbox.reference.clusters import NO_CLUSTER, grid_cells, keep_clusters, label_components, warp_range
from jaxbox.reference.completion import CompletedBox, complete_box, direction_preference, scene_direction
from jaxbox.reference.evidence import Evidence, box_evidence, build_evidence, support_at
from jaxbox.reference.filtering import filter_outliers, select_points
from jaxbox.reference.ground import (
    cell_minima,
    fit_ground_planes,
    fit_ground_surface,
    ground_elevation,
    height_above_ground,
    spread_candidates,
)
from jaxbox.reference.vehicles import (
    PointsAround,
    count_points_around,
    distance_outside,
    score_box,
    suppress,
)
from jaxbox.types import Label

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


@dataclasses.dataclass(frozen=True)
class _Obstacles:
    rows: np.ndarray
    xyz: np.ndarray
    height: np.ndarray
    tree: KDTree | None


@dataclasses.dataclass(frozen=True)
class _Proposal:
    members: np.ndarray
    xy: np.ndarray
    curve: np.ndarray
    extents: np.ndarray
    top_m: float


@dataclasses.dataclass(frozen=True)
class _Candidate:
    proposal: _Proposal
    completed: CompletedBox
    around: PointsAround
    label: Label
    score: float


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
    settings: Any = config or DetectorConfig()
    xyz = np.asarray(xyz, np.float64)
    finite, valid = select_points(xyz, half_x_m=settings.region.half_x_m, half_y_m=settings.region.half_y_m)
    inlier = _filter(xyz, valid, settings)
    ground = _fit_ground(xyz, inlier, settings, np.random.default_rng(seed))
    height = np.full(len(xyz), np.nan)
    height[inlier] = _height(xyz[inlier], ground, settings)
    is_ground = inlier & (np.nan_to_num(height, nan=np.inf) <= settings.ground.min_height_m)
    is_overhead = inlier & (np.nan_to_num(height, nan=-np.inf) >= settings.ground.max_height_m)
    obstacle_rows = np.flatnonzero(inlier & ~is_ground & ~is_overhead)
    obstacles = _obstacles(xyz, height, obstacle_rows[: settings.clustering.max_obstacles])

    maps = [_clusters(obstacles, component_map, settings) for component_map in settings.clustering.maps]
    proposals = [_proposals(obstacles, slot, settings) for _, slot, _ in maps]
    evidence = _evidence(xyz[inlier], height[inlier], ground, settings)
    candidates = _candidates(proposals, obstacles, evidence, settings)
    boxes = np.array([c.completed.box for c in candidates]).reshape(-1, 5)
    scores = np.array([c.score for c in candidates])
    rows = suppress(boxes, scores, max_overlap=settings.vehicles.max_overlap)
    winners = [candidates[row] for row in rows[: settings.vehicles.max_detections]]

    counts = {
        "dropped_points": 0,
        "nonfinite_points": int((~finite).sum()),
        "out_of_range_points": int((finite & ~valid).sum()),
        "outlier_points": int((valid & ~inlier).sum()),
        "ground_points": int(is_ground.sum()),
        "overhead_points": int(is_overhead.sum()),
        "dropped_obstacles": len(obstacle_rows) - len(obstacles.rows),
        **_cluster_counts(obstacles, maps, settings),
        "obstacles": len(obstacle_rows),
        "candidates": len(candidates),
        "detections": len(rows),
    }
    component = np.full(len(xyz), NO_CLUSTER)
    component[obstacles.rows] = maps[0][0]
    return _assemble(
        winners,
        obstacles,
        ground,
        counts,
        settings,
        height=height,
        ground_mask=is_ground,
        component=component,
    )


def _options(config: Any, *names: str) -> dict[str, Any]:
    """The named fields of a config as keyword arguments."""
    return {name: getattr(config, name) for name in names}


def _filter(xyz: np.ndarray, valid: np.ndarray, settings: Any) -> np.ndarray:
    inlier = valid.copy()
    if settings.filtering.enabled:
        names = ("cell_m", "num_levels", "num_iterations", "bandwidth_m", "num_std", "min_density")
        options = _options(settings.filtering, *names) | _options(settings.region, "half_x_m", "half_y_m")
        inlier[valid] = filter_outliers(xyz[valid], **options)
    return inlier


def _fit_ground(xyz: np.ndarray, inlier: np.ndarray, settings: Any, rng: np.random.Generator) -> _Ground:
    ground = settings.ground
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
    fits = fit_ground_planes(candidates, rng=rng, **_options(ground, *names))
    planes = np.array([plane for plane, _, _ in fits])
    grid = None
    if ground.surface:
        names = ("num_envelope_rounds", "max_grade", "band_below_m", "band_below_grade", "band_above_m")
        names += ("band_above_grade", "blind_radius_m", "envelope_margin_m", "smoothing_m", "min_height_m")
        grid = fit_ground_surface(xyz[inlier], planes, **_options(ground, *names), **_surface_grid(settings))
    return _Ground(planes, fits[0][1], fits[0][2], grid)


def _surface_grid(settings: Any) -> dict[str, Any]:
    return {"cell_m": settings.ground.surface_cell_m, "half_m": settings.ground.surface_half_m}


def _height(xyz: np.ndarray, ground: _Ground, settings: Any) -> np.ndarray:
    options = _surface_grid(settings) | _options(settings.ground, "min_height_m")
    return height_above_ground(xyz, ground.planes, ground.grid, **options)


def _obstacles(xyz: np.ndarray, height: np.ndarray, rows: np.ndarray) -> _Obstacles:
    tree = KDTree(xyz[rows, :2]) if len(rows) else None
    return _Obstacles(rows, xyz[rows], height[rows], tree)


def _clusters(
    obstacles: _Obstacles, component_map: ComponentMap, settings: Any
) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Component and cluster of each obstacle in one map, and its numbers of cells and clusters."""
    fields: Any = component_map
    clustering = settings.clustering
    member = (obstacles.height > fields.min_height_m) & (obstacles.height < fields.max_height_m)
    xy = obstacles.xyz[member, :2]
    cells, shape = grid_cells(
        warp_range(xy, start_m=clustering.adaptive_start_m, growth=clustering.adaptive_growth),
        obstacles.height[member],
        **_options(settings.region, "half_x_m", "half_y_m"),
        **_options(fields, "cell_m", "num_levels", "min_height_m"),
    )
    component = np.full(len(member), NO_CLUSTER)
    slot = np.full(len(member), NO_CLUSTER)
    component[member] = label_components(cells, shape)
    gates = _options(clustering, "min_points", "max_extent_m")
    slot[member], num_clusters = keep_clusters(xy, component[member], **gates)
    slot[slot >= fields.max_clusters] = NO_CLUSTER
    return component, slot, (len(np.unique(cells, axis=0)), num_clusters)


def _cluster_counts(obstacles: _Obstacles, maps: list[Any], settings: Any) -> dict[str, Any]:
    clustered = int(np.any([slot != NO_CLUSTER for _, slot, _ in maps], axis=0).sum())
    box, height = settings.box, obstacles.height
    return {
        "clustered_points": clustered,
        "unclustered_points": len(height) - clustered,
        "slab_points": int(((height > box.slab_min_height_m) & (height < box.slab_max_height_m)).sum()),
        "cells": tuple(cells for _, _, (cells, _) in maps),
        "clusters": tuple(clusters for _, _, (_, clusters) in maps),
    }


def _proposals(obstacles: _Obstacles, slot: np.ndarray, settings: Any) -> list[_Proposal]:
    """The clusters of one map, each with its rectangles at all rotations."""
    box = settings.box
    order = np.argsort(slot, kind="stable")
    order = order[slot[order] != NO_CLUSTER]
    starts = np.flatnonzero(np.diff(slot[order])) + 1
    proposals = []
    for members in np.split(order, starts) if len(order) else []:
        chosen = fit_points(
            members,
            obstacles.height,
            min_height_m=box.slab_min_height_m,
            max_height_m=box.slab_max_height_m,
            **_options(box, "min_slab_points", "max_points"),
        )
        xy = obstacles.xyz[chosen, :2]
        curve, extents = criterion_curve(xy, **_options(box, "criterion", "num_angles", "min_distance_m"))
        proposals.append(_Proposal(members, xy, curve, extents, float(obstacles.height[members].max())))
    return proposals


def _evidence(xyz: np.ndarray, height: np.ndarray, ground: _Ground, settings: Any) -> Evidence | None:
    if not settings.evidence.enabled:
        return None
    fields = {field.name for field in dataclasses.fields(settings.evidence)} - {"enabled"}
    sensor_height_m = -float(ground.planes[0, 2])
    return build_evidence(
        xyz, height, sensor_height_m=sensor_height_m, **_options(settings.evidence, *fields)
    )


def _complete(
    proposal: _Proposal, preference: np.ndarray, prior: ClassPrior, evidence: Evidence | None, settings: Any
) -> CompletedBox | None:
    value = proposal.curve + preference
    best = int(np.argmax(value))
    names = ("mode", "num_rays", "free_weight", "free_length_weight", "inside_weight", "near_weight")
    names += ("closeness_weight", "not_away_cost")
    return complete_box(
        proposal.xy,
        proposal.extents[best],
        angle=best * np.pi / 2 / len(value),
        criterion_value=float(value[best]),
        evidence=evidence,
        **_options(prior, "length_m", "width_m", "max_length_m", "max_width_m"),
        **_options(settings.completion, *names),
    )


def _preference(proposals: list[_Proposal], evidence: Evidence | None, settings: Any) -> np.ndarray:
    """The gain of each rotation from the direction that the first map's clusters share."""
    box, car = settings.box, settings.vehicles.classes[Label.CAR]
    none = np.zeros(box.num_angles)
    fits = (
        [(p, _complete(p, none, car, evidence, settings)) for p in proposals] if box.scene_direction else []
    )
    fits = [(p, fit) for p, fit in fits if fit is not None]
    if not fits:
        return none
    boxes = np.array([fit.box for _, fit in fits])
    rays = box_evidence(boxes, evidence, num_rays=settings.completion.num_final_rays)
    direction = scene_direction(
        boxes[:, 4],
        np.array([max(fit.measured_length_m, fit.measured_width_m) for _, fit in fits]),
        np.array([len(p.members) for p, _ in fits]),
        rays.free_length,
        num_angles=box.num_angles,
        sigma_deg=box.direction_sigma_deg,
        min_extent_m=box.direction_min_extent_m,
        max_free=box.direction_max_free,
    )
    return direction_preference(
        direction, num_angles=box.num_angles, weight=box.direction_weight, sigma_deg=box.direction_sigma_deg
    )


def _candidates(
    proposals: list[list[_Proposal]], obstacles: _Obstacles, evidence: Evidence | None, settings: Any
) -> list[_Candidate]:
    """Every proposal as a car, the high ones as van and truck too: what scores, best first."""
    vehicles = settings.vehicles
    preference = _preference(proposals[0], evidence, settings)
    every = [proposal for of_map in proposals for proposal in of_map]
    large = [p for p in every if p.top_m > vehicles.large_height_m][: vehicles.max_large]
    candidates = []
    for label, chosen in ((Label.CAR, every), (Label.VAN, large), (Label.TRUCK, large)):
        prior = vehicles.classes[label]
        for proposal in chosen:
            completed = _complete(proposal, preference, prior, evidence, settings)
            if completed is not None:
                judged = _judge(
                    proposal, completed, label, obstacles=obstacles, evidence=evidence, settings=settings
                )
                candidates.append(judged)
    candidates = [c for c in candidates if c.score > vehicles.min_score]
    return sorted(candidates, key=lambda c: -c.score)[: vehicles.max_candidates]


def _judge(
    proposal: _Proposal,
    completed: CompletedBox,
    label: Label,
    *,
    obstacles: _Obstacles,
    evidence: Evidence | None,
    settings: Any,
) -> _Candidate:
    vehicles, box = settings.vehicles, completed.box
    prior = vehicles.classes[label]
    assert obstacles.tree is not None
    near = obstacles.tree.query_ball_point(box[:2], np.hypot(box[2], box[3]) / 2 + 2 * vehicles.ring_m)
    around = count_points_around(
        box,
        obstacles.xyz[near],
        obstacles.height[near],
        **_options(vehicles, "margin_m", "ring_m"),
        **_options(settings.ground, "min_height_m", "max_height_m"),
        count_max_height_m=prior.count_max_height_m,
    )
    rays = box_evidence(box[None], evidence, num_rays=settings.completion.num_final_rays)
    names = (
        "top_grade",
        "min_extent_m",
        "saturation_points",
        "sparseness_power",
        "free_scale",
        "ring_weight",
    )
    names += ("overhead_weight", "support_points", "objective_gate", "objective_softness")
    score = score_box(
        box,
        prior,
        around=around,
        **_options(completed, "objective", "measured_length_m", "measured_width_m"),
        num_members=len(proposal.members),
        hit=float(rays.hit[0]),
        free_length=float(rays.free_length[0]),
        support=None if evidence is None else support_at(box[:2], evidence),
        **_options(vehicles, *names),
    )
    return _Candidate(proposal, completed, around, label, score)


def _vertical(
    candidate: _Candidate, obstacles: _Obstacles, ground: _Ground, settings: Any
) -> tuple[float, float]:
    """Middle and height of a box along z."""
    z = obstacles.xyz[candidate.proposal.members, 2]
    if settings.completion.mode == "none":
        return (z.min() + z.max()) / 2, z.max() - z.min()
    vehicles = settings.vehicles
    prior = vehicles.classes[candidate.label]
    height = max(candidate.around.top_m + vehicles.top_margin_m, prior.min_box_height_m)
    # z tells which of several planes the vehicle stands on.
    place = np.append(candidate.completed.box[:2], z.min())[None]
    options = _surface_grid(settings) | _options(settings.ground, "min_height_m")
    return ground_elevation(place, ground.planes, ground.grid, **options)[0] + height / 2, height


def _assemble(
    winners: list[_Candidate],
    obstacles: _Obstacles,
    ground: _Ground,
    counts: dict[str, Any],
    settings: Any,
    *,
    height: np.ndarray,
    ground_mask: np.ndarray,
    component: np.ndarray,
) -> ReferenceDetections:
    point_detection = np.full(len(height), NO_CLUSTER)
    own, hulls = [], []
    for row, winner in enumerate(winners):
        members = winner.proposal.members
        inside = distance_outside(obstacles.xyz[members, :2], winner.completed.box) <= INSIDE_SLACK_M
        free = point_detection[obstacles.rows[members]] == NO_CLUSTER
        own.append(obstacles.xyz[members[inside & free], :2])
        point_detection[obstacles.rows[members[inside & free]]] = row
        hulls.append(convex_hull(own[-1]))
    boxes = np.array([w.completed.box for w in winners]).reshape(-1, 5)
    vertical = np.array([_vertical(w, obstacles, ground, settings) for w in winners]).reshape(-1, 2)
    return ReferenceDetections(
        center=np.column_stack([boxes[:, :2], vertical[:, 0]]),
        size=np.column_stack([boxes[:, 2:4], vertical[:, 1]]),
        yaw=np.array([wrap_yaw(yaw) for yaw in boxes[:, 4]]),
        score=np.array([w.score for w in winners]),
        label=np.array([w.label for w in winners], int),
        num_points=np.array([len(xy) for xy in own], int),
        hulls=tuple(hulls),
        descriptors=tuple(shape_descriptors(xy, hull) for xy, hull in zip(own, hulls, strict=True)),
        coefficients=ground.planes[0],
        found=ground.found,
        num_inliers=ground.num_inliers,
        height=height,
        ground_mask=ground_mask,
        point_component=component,
        point_detection=point_detection,
        counts=counts | {"hull_vertices": max((len(hull) for hull in hulls), default=0)},
    )
