"""From obstacle points to scored boxes: every cluster of every map as every class that it may be."""

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from jaxbox.config import ComponentMap
from jaxbox.config.class_priors import ClassPrior
from jaxbox.reference.boxes import convex_hull, criterion_curve, fit_points
from jaxbox.reference.clusters import (
    NO_CLUSTER,
    count_runs,
    grid_cells,
    keep_clusters,
    label_components,
    warp_range,
)
from jaxbox.reference.completion import (
    CompletedBox,
    Reading,
    boxes_away,
    complete_box,
    count_assignments,
    direction_preference,
    scene_direction,
)
from jaxbox.reference.evidence import Evidence, box_evidence, support_at
from jaxbox.reference.vehicles import PointsAround, count_points_around, score_box
from jaxbox.types import Label

INSISTENCE = 5.0
"""How often the scene's direction counts where the second rectangle's rotation is chosen."""
LOWER_PART_M = 0.5
"""A cluster may be so much lower than its vehicle."""


@dataclasses.dataclass(frozen=True)
class Obstacles:
    """The m points above the ground that are looked at, in sweep order."""

    rows: np.ndarray
    """(m,) int: their rows in the sweep."""
    xyz: np.ndarray
    """(m, 3) m, sensor frame."""
    height: np.ndarray
    """(m,) m above the ground."""
    tree: KDTree | None
    """Of their x and y; None without obstacles."""


@dataclasses.dataclass(frozen=True)
class Proposal:
    """A cluster, and its rectangles at all rotations."""

    members: np.ndarray
    """(k,) int: rows of its points among the obstacles."""
    xy: np.ndarray
    """(j, 2) m: the points that rectangles are fitted to."""
    curve: np.ndarray
    """(A,): criterion at each rotation."""
    extents: np.ndarray
    """(A, 4) m: see `criterion_curve`."""
    bottom_m: float
    """Height of its lowest member above the ground."""
    top_m: float
    """Height of its highest member above the ground."""


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A cluster as a vehicle of one class."""

    proposal: Proposal
    """The cluster."""
    completed: CompletedBox
    """Its box."""
    around: PointsAround
    """Points in and round the box."""
    label: Label
    """The class."""
    score: float
    """In [0, 1]."""


def select_options(config: Any, *names: str) -> dict[str, Any]:
    """The named fields of a config as keyword arguments.

    >>> select_options(ComponentMap(), "cell_m", "num_levels")
    {'cell_m': 0.2, 'num_levels': 1}
    """
    return {name: getattr(config, name) for name in names}


def index_obstacles(xyz: np.ndarray, height: np.ndarray, rows: np.ndarray) -> Obstacles:
    """Gathers obstacles and indexes them by place.

    Args:
      xyz: (n, 3) m, the sweep.
      height: (n,) m above the ground.
      rows: (m,) int, the obstacles among them.

    Returns:
      The obstacles.
    """
    return Obstacles(rows, xyz[rows], height[rows], KDTree(xyz[rows, :2]) if len(rows) else None)


def find_clusters(
    obstacles: Obstacles, component_map: ComponentMap, config: Any
) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Finds the clusters of one component map.

    Args:
      obstacles: of the sweep, m of them.
      component_map: the map.
      config: of the detector.

    Returns:
      Component (m,) and cluster (m,) of each obstacle, `NO_CLUSTER` where it has none, and the
      numbers of runs of occupied cells and of clusters.
    """
    fields: Any = component_map
    clustering = config.clustering
    member = (obstacles.height > fields.min_height_m) & (obstacles.height < fields.max_height_m)
    xy = obstacles.xyz[member, :2]
    cells, shape = grid_cells(
        warp_range(xy, start_m=clustering.adaptive_start_m, growth=clustering.adaptive_growth),
        obstacles.height[member],
        **select_options(config.region, "half_x_m", "half_y_m"),
        **select_options(fields, "cell_m", "num_levels", "min_height_m"),
    )
    component = np.full(len(member), NO_CLUSTER)
    slot = np.full(len(member), NO_CLUSTER)
    component[member] = label_components(cells, shape)
    gates = select_options(clustering, "min_points", "max_extent_m")
    gates |= select_options(config.vehicles, "min_extent_m")
    slot[member], num_clusters = keep_clusters(xy, component[member], **gates)
    slot[slot >= fields.max_clusters] = NO_CLUSTER
    return component, slot, (count_runs(cells, shape), num_clusters)


def make_proposals(obstacles: Obstacles, slot: np.ndarray, config: Any) -> list[Proposal]:
    """Fits rectangles to the clusters of one map.

    Args:
      obstacles: of the sweep, m of them.
      slot: (m,) int, cluster of each, from `find_clusters`.
      config: of the detector.

    Returns:
      One proposal a cluster, in the order of the clusters.
    """
    order = np.argsort(slot, kind="stable")
    order = order[slot[order] != NO_CLUSTER]
    starts = np.flatnonzero(np.diff(slot[order])) + 1
    proposals = []
    for members in np.split(order, starts) if len(order) else []:
        xy = _outline(members, obstacles, config)
        curve, extents = criterion_curve(
            xy, **select_options(config.box, "criterion", "num_angles", "min_distance_m")
        )
        height = obstacles.height[members]
        proposals.append(Proposal(members, xy, curve, extents, float(height.min()), float(height.max())))
    return proposals


def _outline(members: np.ndarray, obstacles: Obstacles, config: Any) -> np.ndarray:
    """(j, 2) m: the points of a cluster that its rectangle is fitted to."""
    box = config.box
    if box.fit_to == "hull":
        return convex_hull(obstacles.xyz[members, :2])
    chosen = fit_points(
        members,
        obstacles.height,
        min_height_m=box.slab_min_height_m,
        max_height_m=box.slab_max_height_m,
        **select_options(box, "min_slab_points", "max_points"),
    )
    return obstacles.xyz[chosen, :2]


def is_large(proposal: Proposal, config: Any) -> bool:
    """Whether a cluster is tried as the larger classes too: high, and standing on the ground.

    Args:
      proposal: the cluster.
      config: of the detector.

    Returns:
      True for those.
    """
    vehicles = config.vehicles
    stands = proposal.bottom_m < vehicles.large_clearance_m
    enough = len(proposal.members) >= vehicles.large_min_points
    return stands and enough and proposal.top_m > vehicles.large_height_m


def _reading(proposal: Proposal, preference: np.ndarray, insistence: float = 1.0) -> Reading:
    """The rectangle at the best rotation, where the preference counts `insistence` times."""
    best = int(np.argmax(proposal.curve + insistence * preference))
    value = float(proposal.curve[best] + preference[best])
    return Reading(proposal.extents[best], best * np.pi / 2 / len(preference), value)


def _complete(
    proposal: Proposal,
    readings: list[Reading],
    prior: ClassPrior,
    evidence: Evidence | None,
    config: Any,
) -> CompletedBox | None:
    names = ("mode", "num_rays", "free_weight", "free_length_weight", "inside_weight", "near_weight")
    names += ("closeness_weight", "not_away_cost", "seen_length", "seen_width", "seen_weight")
    names += ("length_margin_m", "width_margin_m")
    return complete_box(
        proposal.xy,
        readings,
        evidence=evidence,
        **select_options(prior, "length_m", "width_m", "max_length_m", "max_width_m"),
        **select_options(config.completion, *names),
    )


def _preference(proposals: list[Proposal], evidence: Evidence | None, config: Any) -> np.ndarray:
    """The gain of each rotation from the direction that the first map's clusters share."""
    box, car = config.box, config.vehicles.classes[Label.CAR]
    none = np.zeros(box.num_angles)
    if not box.scene_direction:
        return none
    names = ("seen_length", "seen_width", "seen_weight", "length_margin_m", "width_margin_m")
    options = select_options(config.completion, *names)
    options |= select_options(car, "length_m", "width_m", "max_length_m", "max_width_m")
    fits = [(p, boxes_away(_reading(p, none), **options)) for p in proposals]
    fits = [(p, boxes) for p, boxes in fits if boxes]
    if not fits:
        return none

    def free_length(boxes: list[CompletedBox]) -> float:
        places = np.array([fit.box for fit in boxes])
        rays = box_evidence(places, evidence, num_rays=config.completion.num_final_rays)
        return rays.free_length.min()

    # Modulo a quarter turn either way to lie votes for the same.
    direction = scene_direction(
        np.array([boxes[0].box[4] for _, boxes in fits]),
        np.array([max(boxes[0].measured_length_m, boxes[0].measured_width_m) for _, boxes in fits]),
        np.array([len(p.members) for p, _ in fits]),
        np.array([free_length(boxes) for _, boxes in fits]),
        num_angles=box.num_angles,
        sigma_deg=box.direction_sigma_deg,
        min_extent_m=box.direction_min_extent_m,
        max_free=box.direction_max_free,
    )
    return direction_preference(
        direction, num_angles=box.num_angles, weight=box.direction_weight, sigma_deg=box.direction_sigma_deg
    )


def judge_candidates(
    proposals: list[list[Proposal]], obstacles: Obstacles, evidence: Evidence | None, config: Any
) -> tuple[list[Candidate], int]:
    """Scores every proposal as a car, and the high ones as each other class too.

    Args:
      proposals: of each map; the first also gives the scene's direction.
      obstacles: of the sweep.
      evidence: of the sweep, or None.
      config: of the detector.

    Returns:
      What scores more than the least score, best first; how many assignments the evidence had to weigh.
    """
    vehicles = config.vehicles
    preference = _preference(proposals[0], evidence, config)
    along_scene = config.box.scene_direction and config.completion.along_scene
    every = [proposal for of_map in proposals for proposal in of_map]
    large = [p for p in every if is_large(p, config)][: vehicles.max_large]
    candidates, num_assignments = [], 0
    for label, prior in zip(Label, vehicles.classes, strict=True):
        for proposal in every if label is Label.CAR else large:
            readings = [_reading(proposal, preference)]
            if not _is_tall(proposal, readings[0], config):
                continue
            if along_scene:
                readings.append(_reading(proposal, preference, INSISTENCE))
            if config.completion.mode == "evidence":
                num_assignments += count_assignments(readings, prior.max_length_m, prior.max_width_m)
            completed = _complete(proposal, readings, prior, evidence, config)
            if completed is not None:
                judged = _judge(
                    proposal, completed, label, obstacles=obstacles, evidence=evidence, config=config
                )
                candidates.append(judged)
    candidates = [c for c in candidates if c.score > vehicles.min_score]
    return sorted(candidates, key=lambda c: -c.score), num_assignments


def _is_tall(proposal: Proposal, reading: Reading, config: Any) -> bool:
    """Whether a cluster can be (the lower part of) a vehicle of the lowest class."""
    u0, u1, v0, v1 = reading.extents
    allowance = config.vehicles.top_grade * np.hypot((u0 + u1) / 2, (v0 + v1) / 2)
    lowest = min(prior.min_height_m for prior in config.vehicles.classes)
    return proposal.top_m + allowance > lowest - LOWER_PART_M


def _judge(
    proposal: Proposal,
    completed: CompletedBox,
    label: Label,
    *,
    obstacles: Obstacles,
    evidence: Evidence | None,
    config: Any,
) -> Candidate:
    vehicles, box = config.vehicles, completed.box
    prior = vehicles.classes[label]
    around = _look_around(proposal, box, prior, obstacles, config)
    rays = box_evidence(box[None], evidence, num_rays=config.completion.num_final_rays)
    names = (
        "top_grade",
        "min_extent_m",
        "saturation_points",
        "sparseness_power",
        "free_scale",
        "ring_weight",
    )
    names += ("overhead_weight", "support_points", "objective_gate", "objective_softness")
    names += ("recess_share", "upright_score")
    score = score_box(
        box,
        prior,
        around=around,
        **select_options(completed, "objective", "measured_length_m", "measured_width_m"),
        num_members=len(proposal.members),
        hit=float(rays.hit[0]),
        free_length=float(rays.free_length[0]),
        support=None if evidence is None else support_at(box[:2], evidence),
        **select_options(vehicles, *names),
    )
    return Candidate(proposal, completed, around, label, score)


def _look_around(
    proposal: Proposal, box: np.ndarray, prior: Any, obstacles: Obstacles, config: Any
) -> PointsAround:
    vehicles = config.vehicles
    if not vehicles.neighbourhood:
        return PointsAround(inside=len(proposal.members), top_m=proposal.top_m, overhead=0, ring=0)
    assert obstacles.tree is not None
    near = obstacles.tree.query_ball_point(box[:2], np.hypot(box[2], box[3]) / 2 + 2 * vehicles.ring_m)
    return count_points_around(
        box,
        obstacles.xyz[near],
        obstacles.height[near],
        **select_options(vehicles, "margin_m", "ring_m", "upper_height_m", "top_quantile"),
        **select_options(config.ground, "min_height_m", "max_height_m"),
        count_max_height_m=prior.count_max_height_m,
        recess_m=prior.recess_m,
    )
