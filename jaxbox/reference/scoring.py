"""Vehicle decision: the score of a box, what surrounds it, and non-maximum suppression."""

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from scipy.special import expit

from jaxbox.config import ClassPrior, CompletionConfig, DetectorConfig, Scalar, VehicleConfig
from jaxbox.reference.completion import share_of_length_seen
from jaxbox.reference.evidence import GroundElevation, closed_free_length
from jaxbox.reference.rows import find_lines, hit_share
from jaxbox.reference.state import (
    Candidate,
    ClassHypothesis,
    Cluster,
    Completed,
    CompletedBox,
    Kept,
    NeighbourhoodCounts,
    Obstacles,
    RayFractions,
)
from jaxbox.reference.surroundings import cluster_alone, count_points_around, in_box_frame, sensor_outside

PSEUDO_COUNT = 5
"""Pseudo-count: upper points that are added, with the share of the full score behind the faces."""
CUT_SLACK_M = 0.1
"""Tops from so much below the highest beam on are more and more taken to be cut off by it."""
UPRIGHT_RAMP_M = 0.1
"""Over so much height a rear becomes one that may be upright."""
BUMPER_RAMP_M, NEARLY_WIDE = 10.0, (0.6, 0.8)
"""A far box may be a bumper alone: the more the farther over so much range, and the wider between these
shares of the class's width; likewise the rear of a high car."""
WIDE = 0.4
"""A box of less than this share of the class's width is seen from one side: it may be a wall."""
MAX_END_MARGIN_M = 0.4
"""An end lies no farther beyond the last point than this."""


def score_boxes(
    completed: Completed,
    rays: RayFractions | None,
    reach: Callable[[np.ndarray, float], float],
    clusters: Sequence[Cluster],
    obstacles: Obstacles,
    config: DetectorConfig,
) -> list[Candidate]:
    """Scores the boxes by rays, size, and what surrounds them.

    Args:
      completed: q boxes.
      rays: what the rays over each box met; None without evidence.
      reach: how high the highest beam is over a box (5,) whose lowest point has some z, see
        `reach_of_beams`.
      clusters: of all maps.
      obstacles: all points above the ground.
      config: of the detector.

    Returns:
      What scores more than the least score, best first.
    """
    in_row = np.array([box.in_row for box in completed.boxes], bool)
    early = _early_scores(completed, rays, clusters, in_row, config.vehicles)
    in_threes = in_row | _in_lines(completed, early, config.vehicles)
    is_open = np.ones(len(early)) if rays is None else rays.open

    def judge(row: int, hypothesis: ClassHypothesis, box: CompletedBox) -> Candidate:
        cluster, prior = clusters[hypothesis.cluster], config.vehicles.classes[hypothesis.label]
        score, threes = float(early[row]), bool(in_threes[row])
        around = _look_around(box.box, prior, cluster, score, threes, obstacles, config.vehicles)
        is_sliver = box.longest_m < config.vehicles.min_extent_m
        score = 0.0 if is_sliver and not threes else score
        if config.vehicles.neighbourhood and config.completion.mode != "none":
            ended, seen = _end_where_seen(box, around, prior, config)
            box = box if box.in_row else dataclasses.replace(box, box=ended)
            seen = 1.0 if is_sliver else seen
            score *= seen + float(config.vehicles.hidden_length_score) * (1 - seen)
        rho = float(np.hypot(box.box[0], box.box[1]))
        lowest_z = obstacles.xyz[cluster.members, 2].min() if config.ground.max_planes > 1 else 0.0
        where = rho, reach(box.box, lowest_z), box.measured_width_m, float(is_open[row]), threes
        late, top_unseen = neighbourhood_score(around, *where, prior, config.vehicles)
        late *= own_score(around, len(cluster.members), prior)
        return Candidate(hypothesis, box, around, top_unseen, score * late)

    pairs = zip(completed.hypotheses, completed.boxes, strict=True)
    candidates = [judge(row, *pair) for row, pair in enumerate(pairs)]
    candidates = [candidate for candidate in candidates if candidate.score > config.vehicles.min_score]
    return sorted(candidates, key=lambda candidate: -candidate.score)


def _early_scores(
    completed: Completed,
    rays: RayFractions | None,
    clusters: Sequence[Cluster],
    in_row: np.ndarray,
    config: VehicleConfig,
) -> np.ndarray:
    """(q,) the part of the scores that needs no look at the surroundings."""
    early = []
    hits = None if rays is None else hit_share(rays, in_row)
    for row, (hypothesis, box) in enumerate(zip(completed.hypotheses, completed.boxes, strict=True)):
        prior = config.classes[hypothesis.label]
        hit, free_length = 1.0, 0.0
        if rays is not None and hits is not None:
            hit, free_length = float(hits[row]), float(closed_free_length(rays, prior)[row])
        num_points = len(clusters[hypothesis.cluster].members)
        rates = {"hit": hit, "free_length": free_length}
        early.append(early_score(box, prior, num_points=num_points, **rates, config=config))
    return np.array(early)


def _in_lines(completed: Completed, early: np.ndarray, config: VehicleConfig) -> np.ndarray:
    """(q,) bool: boxes of the first class in lines of vehicles nose to tail."""
    found = np.zeros(len(early), bool)
    rows = [row for row, hypothesis in enumerate(completed.hypotheses) if hypothesis.label == 0]
    boxes = np.array([completed.boxes[row].box for row in rows]).reshape(-1, 5)
    found[rows] = find_lines(boxes, early[rows], config)
    return found


def reach_of_beams(
    box: np.ndarray, lowest_z: float, steepest: float | None, elevation: GroundElevation
) -> float:
    """How high the highest beam is at the nearest point of a box.

    Args:
      box: (5,): x, y, length, width in m and yaw in rad.
      lowest_z: m, of its points: it tells which of several planes it stands on.
      steepest: rise of that beam, m/m; None where nothing is known of it.
      elevation: z of the ground, m, under points.

    Returns:
      m above the ground under the middle of the box; infinite where nothing is known.
    """
    if steepest is None:
        return np.inf
    nearest = np.hypot(*sensor_outside(box))
    return float(steepest * nearest - elevation(np.array([[*box[:2], lowest_z]]))[0])


def _look_around(
    box: np.ndarray,
    prior: ClassPrior,
    cluster: Cluster,
    early: float,
    between_others: bool,
    obstacles: Obstacles,
    config: VehicleConfig,
) -> NeighbourhoodCounts:
    if not config.neighbourhood:
        return cluster_alone(len(cluster.members), cluster.top_m)
    sure = early * min(len(cluster.members) / float(config.saturation_points), 1.0) ** 2
    around = count_points_around(box, prior, obstacles, config, sure=sure)
    return dataclasses.replace(around, num_ring=(1 - sure) * around.num_ring) if between_others else around


def _end_where_seen(
    box: CompletedBox, around: NeighbourhoodCounts, prior: ClassPrior, config: DetectorConfig
) -> tuple[np.ndarray, float]:
    """The box (5,) with its end where it is seen, and how sure its length is."""
    beam_angle = 2 * np.pi / config.evidence.num_azimuths
    ended, seen = end_where_seen(box.box, around, prior, config.completion, beam_angle)
    whole = share_of_length_seen(box.measured_length_m, prior, config.completion.seen_length)
    return ended, max(seen, whole)


def own_score(around: NeighbourhoodCounts, num_points: int, prior: ClassPrior) -> float:
    """What a box counts of whose points its cluster holds a small share only.

    Args:
      around: points in and round the box.
      num_points: of the cluster.
      prior: from which share on it counts in full.

    Returns:
      In [0, 1].
    """
    own = num_points / max(float(around.num_inside), 1.0)
    return 1.0 if own >= prior.own_share else own / float(prior.own_share)


def keep_best(candidates: Sequence[Candidate], config: VehicleConfig) -> Kept:
    """The candidates that overlap no better one.

    Args:
      candidates: best score first.
      config: the overlap, and how many are looked at and kept at most.

    Returns:
      Those that stay.
    """
    best = candidates[: config.max_candidates]
    boxes = np.array([candidate.completed.box for candidate in best]).reshape(-1, 5)
    scores = np.array([candidate.score for candidate in best])
    rows = non_max_suppression(boxes, scores, max_overlap=float(config.max_overlap))
    return Kept([best[row] for row in rows[: config.max_detections]], len(rows))


def end_where_seen(
    box: np.ndarray,
    around: NeighbourhoodCounts,
    prior: ClassPrior,
    config: CompletionConfig,
    beam_angle: float,
) -> tuple[np.ndarray, float]:
    """Moves the far end of a box to where all points inside say that it is, as far as the sensor sees it.

    Args:
      box: (5,): x, y, length, width in m and yaw in rad.
      around: all points inside; the farthest tells where the end is.
      prior: of the class.
      config: `end_length` of the class's length is the least that shows an end; from `end_slope` on beams
        show it for sure, and `end_points` points half so.
      beam_angle: rad, between neighbouring beams: an azimuth cell of the evidence.

    Returns:
      The box (5,) with the same near end; how sure it is that the end is seen, in [0, 1].
    """
    along, across = sensor_outside(box)
    view = np.arctan2(across, along)
    weight = min(np.tan(min(view, 1.5)) / float(config.end_slope), 1.0)
    weight *= share_of_length_seen(around.deepest, prior, config.end_length)
    weight *= around.num_inside / (around.num_inside + float(config.end_points))
    # Beams that meet the side at that angle, so far away, are so far apart on it.
    spacing_m = beam_angle * np.hypot(along, across) / np.sin(view) if view > 0 else np.inf
    length = box[2] + weight * (around.deepest + min(spacing_m / 2, MAX_END_MARGIN_M) - box[2])
    facing = np.sign(in_box_frame(np.zeros(2), box)[0]) * np.array([np.cos(box[4]), np.sin(box[4])])
    return np.array([*(box[:2] + facing * (box[2] - length) / 2), length, *box[3:]]), float(weight)


def score_box(
    box: CompletedBox,
    prior: ClassPrior,
    *,
    around: NeighbourhoodCounts,
    num_points: int,
    hit: float,
    free_length: float,
    config: VehicleConfig,
    reach: float = np.inf,
    is_open: float = 1.0,
    in_threes: bool = False,
) -> float:
    """How much a box looks like a vehicle of a class: a product of factors in [0, 1].

    Args:
      box: completed.
      prior: the class.
      around: points in and round the box.
      num_points: points of the cluster.
      hit: share of the rays that end at the box.
      free_length: share of the box seen to be free.
      config: of the score.
      reach: m above the ground, height of the highest beam where the box begins.
      is_open: share of the rays that see free space in the box.
      in_threes: whether it is one of three or more in a row or line.

    Returns:
      The score, without what a hidden length costs; 0 where a gate of the class closes.
    """
    if box.longest_m < config.min_extent_m and not in_threes:
        return 0.0
    early = early_score(
        box,
        prior,
        num_points=num_points,
        hit=hit,
        free_length=free_length,
        config=config,
    )
    rho = float(np.hypot(box.box[0], box.box[1]))
    where = rho, reach, box.measured_width_m, is_open, in_threes
    own = own_score(around, num_points, prior)
    return early * own * neighbourhood_score(around, *where, prior, config)[0]


def early_score(
    box: CompletedBox,
    prior: ClassPrior,
    *,
    num_points: int,
    hit: float,
    free_length: float,
    config: VehicleConfig,
) -> float:
    """The part of the score that needs no look at what surrounds the box; see `score_box`."""
    if box.longest_m < config.row_extent * config.min_extent_m:
        return 0.0
    rho = float(np.hypot(box.box[0], box.box[1]))
    score = evidence_score(num_points, hit, free_length, box.objective, config)
    score *= far_score(rho, prior, config)
    return float(score * size_score(box.box[2:4], prior) * prior.prior_weight)


def asymmetric_gaussian(value: Scalar, peak: Scalar, below: Scalar, above: Scalar) -> float:
    """exp(-((value - peak) / width)^2), with its own width on either side."""
    return float(np.exp(-(((value - peak) / (below if value < peak else above)) ** 2)))


def evidence_score(
    num_points: int,
    hit: float,
    free_length: float,
    objective: float,
    config: VehicleConfig,
) -> float:
    """The part of the score that the rays and the cluster decide.

    Args:
      num_points: points of the cluster.
      hit: share of the rays that end at the box.
      free_length: share of the box seen to be free.
      objective: J of the completion.
      config: (points / saturation)^power, exp(-(free_length / scale)^2), and
        1 / (1 + exp(-(J - gate) / softness)).

    Returns:
      In [0, 1].
    """
    score = hit * min(1.0, num_points / config.saturation_points) ** config.sparseness_power
    score *= np.exp(-((free_length / config.free_scale) ** 2))
    return float(score * expit((objective - config.objective_gate) / config.objective_softness))


def far_score(rho: float, prior: ClassPrior, config: VehicleConfig) -> float:
    """The part of the score that falls with the range, as fewer beams meet a vehicle.

    Args:
      rho: m, range of the box.
      prior: of the class.
      config: the power.

    Returns:
      In [0, 1].
    """
    from_m = float(prior.far_score_from_m)
    return (from_m / max(rho, from_m)) ** float(config.far_score_power)


def size_score(size: np.ndarray, prior: ClassPrior) -> float:
    """How well the box's length and width match the class.

    Args:
      size: (2,) m: length, width.
      prior: of the class.

    Returns:
      In [0, 1].
    """
    length, width = size
    score = asymmetric_gaussian(length, prior.length_m, prior.length_below_m, prior.length_above_m)
    tolerance_m = prior.width_tolerance_m
    return score * asymmetric_gaussian(width, prior.width_m, tolerance_m, tolerance_m)


def neighbourhood_score(
    around: NeighbourhoodCounts,
    rho: float,
    reach: float,
    seen_width_m: float,
    is_open: float,
    in_threes: bool,
    prior: ClassPrior,
    config: VehicleConfig,
) -> tuple[float, bool]:
    """The part of the score that the points in and round the box decide.

    Args:
      around: see `count_points_around`.
      rho: m, range of the box: it may be higher than its top by `top_grade` times this.
      reach: m above the ground: where the box begins, the highest beam passes there, and cuts off what is
        higher. A top that comes near to it may lie anywhere above, for `unseen_top_score` of the score; so
        may that of a vehicle of which only a bumper returns, beyond `bumper_from_m`.
      seen_width_m: m, measured: the first falls with the width below half the class's, a bumper is as wide as
        the class.
      is_open: share of the rays that see free space in the box: where it is less than `min_open`, what is cut
        off, or was measured to less than `WIDE` of the class's width, is rather a wall.
      in_threes: whether it is one of three or more in a row or line, which hide all but one face of each.
      prior: of the class.
      config: exp(-(ring weight x ring + overhead weight x above) / inside), and a factor from
        `upright_score`, or `tall_upright_score` of what is high or in threes, where no upper point is
        recessed, to 1 from the share `recess_share` on. Points above do not count where the top is twice
        `overhead_gap_m` below `count_max_height_m`.

    Returns:
      In [0, 1], 0 where a gate of the class closes; and whether it is that of a box whose top is out of
      sight.
    """
    highest = around.top + config.top_grade * rho
    widths = prior.height_m, prior.height_below_m, prior.height_above_m
    no_wall = min(is_open / float(prior.min_open), 1.0) if prior.min_open > 0 else 1.0
    seen_width = seen_width_m / float(prior.width_m)
    cut = np.interp(around.top - reach, [-CUT_SLACK_M, 0], [0, 1])
    seen = unseen = 0.0
    if prior.min_height_m < highest and around.top < prior.max_height_m:
        seen = asymmetric_gaussian(min(max(prior.height_m, around.top), highest), *widths)
        seen *= max(no_wall, (1 - cut) * min(seen_width / WIDE, 1.0))
    if around.top < prior.max_height_m:
        unseen = _share_unseen(around.top, rho, cut * no_wall, seen_width, prior, config)
        unseen *= asymmetric_gaussian(max(prior.height_m, around.top), *widths)
    score = max(seen, unseen)
    gap = prior.count_max_height_m - highest
    connected = min(max(2 - gap / config.overhead_gap_m, 0.0), 1.0)
    clutter = config.ring_weight * around.num_ring + config.overhead_weight * connected * around.num_above
    score *= np.exp(-clutter / max(around.num_inside, 1))
    share = around.num_recessed + PSEUDO_COUNT * config.recess_share
    share = share / (around.num_upper + PSEUDO_COUNT)
    tall = np.interp(around.top - prior.upright_from_m, [0, UPRIGHT_RAMP_M], [0, 1])
    tall *= np.interp(seen_width, NEARLY_WIDE, [0, 1])
    may_be = 1.0 if in_threes else tall
    least = config.upright_score + (config.tall_upright_score - config.upright_score) * may_be
    upright = least + (1 - least) * min(1.0, share / config.recess_share)
    return float(score * upright), unseen > seen


def _share_unseen(
    top: float, rho: float, is_cut: float, share: float, prior: ClassPrior, config: VehicleConfig
) -> float:
    """What the class's height counts where the top is out of sight: above the highest beam or a bumper."""
    cut = bumper = 0.0
    if top > prior.min_cut_height_m:
        cut = is_cut * min(2 * share, 1.0)
    if top > prior.min_bumper_m:
        bumper = np.interp(rho - float(config.bumper_from_m), [0, BUMPER_RAMP_M], [0, 1])
        bumper *= np.interp(share, NEARLY_WIDE, [0, 1])
    return float(config.unseen_top_score * max(cut, bumper))


def bev_iou(first: np.ndarray, second: np.ndarray) -> float:
    """Overlap of two rectangles in the bird's-eye view: intersection over union.

    Args:
      first: (5,): x, y, length, width in m and yaw in rad.
      second: (5,).

    Returns:
      In [0, 1]; 0 for two boxes without area.
    """
    # OpenCV works in float32: keep the numbers small.
    offset = second[:2] - first[:2]
    rectangles = [
        ((0.0, 0.0), (first[2], first[3]), np.degrees(first[4])),
        ((offset[0], offset[1]), (second[2], second[3]), np.degrees(second[4])),
    ]
    kind, corners = cv2.rotatedRectangleIntersection(*rectangles)
    if kind == cv2.INTERSECT_NONE or corners is None:
        return 0.0
    shared = cv2.contourArea(cv2.convexHull(corners))
    union = first[2] * first[3] + second[2] * second[3] - shared
    return float(np.clip(shared / union, 0.0, 1.0)) if union > 0 else 0.0


def non_max_suppression(boxes: np.ndarray, scores: np.ndarray, *, max_overlap: float) -> np.ndarray:
    """Greedy suppression: of two overlapping boxes the one with the higher score stays.

    Args:
      boxes: (k, 5): x, y, length, width in m and yaw in rad.
      scores: (k,); of equal ones the first goes first.
      max_overlap: a larger IoU with a better box that stays suppresses.

    Returns:
      (d,) int, rows of the boxes that stay, best score first.
    """
    kept: list[int] = []
    reach = np.hypot(boxes[:, 2], boxes[:, 3]) / 2
    for row in np.argsort(-scores, kind="stable"):
        gap = np.hypot(*(boxes[kept, :2] - boxes[row, :2]).T)
        rivals = np.array(kept, int)[gap <= reach[kept] + reach[row]]
        if all(bev_iou(boxes[row], boxes[rival]) <= max_overlap for rival in rivals):
            kept.append(int(row))
    return np.array(kept, int)
