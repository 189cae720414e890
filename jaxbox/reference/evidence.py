"""What each beam says about a box: hit, seen through (free) or hidden."""

from collections.abc import Callable

import numpy as np

from jaxbox.config import ClassPrior, EvidenceConfig, Scalar
from jaxbox.reference.state import Evidence, Ground, RayFractions, Sweep

MIN_DESCENT_M = 1e-3
"""A beam that falls less than this before its return is level and shows nothing below it."""
FULL_BEAM = 1 - 1e-6
"""A beam that is still above the lower height after this share of its length ends at its return."""
MIN_ENTRY_M = 1.0
"""Rays that enter a box nearer to the sensor than this are not counted."""
HIT_BEFORE_M = 0.35
"""A return this far before the entry is still a hit."""
HIT_BEHIND_M = 0.6
"""A return this far behind the entry is still a hit,"""
HIT_EXIT_M = 0.25
"""unless it is this far behind the exit."""
DEEP_EXIT_M = 0.1
"""A ray that hits nothing at the entry but something up to this behind the exit is deep."""
FREE_BEHIND_M = 0.3
"""Free space counts from this far behind the entry,"""
FREE_BEFORE_M = 0.2
"""up to this far before the exit."""
LEAST_RISE, RISES_PER_UNIT, NUM_RISES = 0.03, 200, 64
"""Rises of beams are counted from the first on, in levels of .005."""
NUM_STEEPEST, STEEP_FROM_M = 30, 8.0
"""So many points, farther than this, are of the highest beam."""


GroundElevation = Callable[[np.ndarray], np.ndarray]
"""z of the ground, (n,) m, under points (n, 3) m."""


def observe(
    sweep: Sweep, ground: Ground, ground_elevation: GroundElevation, config: EvidenceConfig
) -> Evidence | None:
    """What the beams saw.

    Args:
      sweep: of n points.
      ground: below them.
      ground_elevation: of the ground under other places.
      config: of the evidence.

    Returns:
      The evidence; None where the preset does not ask for it.
    """
    if not config.enabled:
        return None
    sensor_height_m = -float(ground.planes[0, 2])
    seen = sweep.xyz[sweep.inlier], ground.height[sweep.inlier]
    return build_evidence(*seen, sensor_height_m, ground_elevation, config)


def build_evidence(
    xyz: np.ndarray,
    height: np.ndarray,
    sensor_height_m: float,
    ground_elevation: GroundElevation,
    config: EvidenceConfig,
) -> Evidence:
    """Collects what the beams hit and what they passed through.

    Over even ground, a beam to a return at range rho and height h is at height hs + t (h - hs) at range
    t rho, where hs is the sensor's height. The space below it is free where that is between the free heights.
    Over lower ground its height is measured at one place, in the middle of those.

    Args:
      xyz: (n, 3) finite, m, sensor frame: all returns, ground included.
      height: (n,) m above the ground.
      sensor_height_m: height of the sensor above the ground.
      ground_elevation: of the ground under the beams.
      config: the grid, and the heights, all exclusive, of what is a hit and what is free.

    Returns:
      The evidence.
    """
    num_azimuths, num_ranges, range_cell_m = config.num_azimuths, config.num_ranges, config.range_cell_m
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    far = rho >= config.min_range_m
    xyz, height, rho = xyz[far], height[far], rho[far]
    azimuth = azimuth_cell(np.arctan2(xyz[:, 1], xyz[:, 0]), num_azimuths)

    def hits_below(top_m: Scalar) -> np.ndarray:
        hits = np.zeros((num_azimuths, num_ranges + 1), int)
        hit = (height > config.hit_min_height_m) & (height < top_m) & (rho < num_ranges * range_cell_m)
        np.add.at(hits, (azimuth[hit], (rho[hit] / range_cell_m).astype(int)), 1)
        return _sums_before(hits)

    start, end = _free_interval(xyz, height, sensor_height_m, ground_elevation, config)
    # Only cells that lie wholly within the interval are free.
    first = np.minimum((start / range_cell_m).astype(int) + 1, num_ranges)
    last = np.minimum((end / range_cell_m).astype(int), num_ranges)
    passes = (end > start) & (last > first)
    steps = np.zeros((num_azimuths, num_ranges + 1), int)
    np.add.at(steps, (azimuth[passes], first[passes]), 1)
    np.add.at(steps, (azimuth[passes], last[passes]), -1)
    free = np.cumsum(steps, axis=1) > 0
    steepest = steepest_beam(xyz[:, 2], rho)
    hits, raised_hits = hits_below(config.hit_max_height_m), hits_below(config.raised_hit_max_height_m)
    return Evidence(hits, raised_hits, _sums_before(free), steepest, range_cell_m)


def steepest_beam(z: np.ndarray, rho: np.ndarray) -> float:
    """The rise that 30 points farther than 8 m have or exceed, and at least .03: that of the highest beam.

    Args:
      z: (n,) m, sensor frame.
      rho: (n,) m.

    Returns:
      m/m, to within a level of .005, in which rises count as evenly spread; at most the last level's end.

    >>> round(steepest_beam(np.full(30, 1.02), np.full(30, 10.0)), 3)
    0.1
    """
    rise = z[rho > STEEP_FROM_M] / rho[rho > STEEP_FROM_M]
    edges = LEAST_RISE + np.arange(NUM_RISES + 1) / RISES_PER_UNIT
    counts, _ = np.histogram(np.clip(rise[rise >= LEAST_RISE], None, edges[-1]), edges)
    left = NUM_STEEPEST
    for count, low, high in zip(counts[::-1], edges[-2::-1], edges[:0:-1], strict=True):
        if count >= left:
            return float(high - (high - low) * left / count)
        left -= count
    return LEAST_RISE


def first_returns(evidence: Evidence | None, config: EvidenceConfig) -> np.ndarray:
    """Range of the first return at a vehicle's height in each azimuth cell.

    Args:
      evidence: of the sweep; None where there is none.
      config: that it was built with.

    Returns:
      (azimuths,) m: where the cell of that return begins; the end of the grid where nothing returned.
    """
    if evidence is None:
        return np.full(config.num_azimuths, config.num_ranges * config.range_cell_m)
    # All cells before the first return have no return before them, and it has none either.
    return ((evidence.hit_sums == 0).sum(axis=1) - 1) * evidence.range_cell_m


def azimuth_cell(angle: np.ndarray, num_azimuths: int) -> np.ndarray:
    """Azimuth cell of angles in rad, from -pi, all round.

    >>> azimuth_cell(np.array([-np.pi, 0.0, np.pi]), 4).tolist()
    [0, 2, 0]
    """
    return np.floor((angle + np.pi) / (2 * np.pi) * num_azimuths).astype(int) % num_azimuths


def _sums_before(cells: np.ndarray) -> np.ndarray:
    return np.cumsum(cells, axis=1) - cells


def _free_interval(
    xyz: np.ndarray,
    height: np.ndarray,
    sensor_height_m: float,
    ground_elevation: GroundElevation,
    config: EvidenceConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Ranges between which each beam is within the heights; empty for beams that do not fall."""
    heights = float(config.free_min_height_m), float(config.free_max_height_m)
    descent = height - sensor_height_m
    falls = descent < -MIN_DESCENT_M
    descent = np.where(falls, descent, -1.0)
    half_way = np.clip((np.mean(heights) - sensor_height_m) / descent, 0.0, 1.0)
    there = half_way[:, None] * xyz
    above_even = there[:, 2] - ground_elevation(there) - (sensor_height_m + half_way * descent)
    above_even = np.maximum(above_even, 0.0)
    leaves, enters = ((h - above_even - sensor_height_m) / descent for h in heights)
    enters, leaves = np.maximum(enters, 0.0), np.minimum(leaves, 1.0)
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    end = rho * leaves - np.where(leaves >= FULL_BEAM, config.end_gap_m, 0.0)
    return np.where(falls, rho * enters, 0.0), np.where(falls, end, 0.0)


def cast_rays(
    evidence: Evidence, boxes: np.ndarray, *, num_rays: int, raised: np.ndarray | bool = False
) -> RayFractions:
    """Sends rays over each box, evenly over the azimuths that it spans, and asks the evidence.

    Args:
      evidence: of the sweep.
      boxes: (B, 5): x, y, length, width in m and yaw in rad.
      num_rays: rays a box.
      raised: (B,) or one for all: whether beams pass below the body, so that higher returns are hits too.

    Returns:
      The fractions.
    """
    angle = _ray_angles(boxes, num_rays)
    entry, exit_ = _intersect(boxes, angle)
    counted = (exit_ > entry) & (entry >= MIN_ENTRY_M)
    azimuth = azimuth_cell(angle, len(evidence.hit_sums))
    # Any range will do where the ray is not counted.
    entry, exit_ = np.where(counted, entry, MIN_ENTRY_M), np.where(counted, exit_, MIN_ENTRY_M)

    def cell(distance: np.ndarray, offset: int) -> np.ndarray:
        index = np.floor(distance / evidence.range_cell_m).astype(int) + offset
        return np.clip(index, 0, evidence.hit_sums.shape[1] - 1)

    def between(sums: np.ndarray, first: np.ndarray, end: np.ndarray) -> np.ndarray:
        return sums[azimuth, end] - sums[azimuth, first]

    def returns(first: np.ndarray, end: np.ndarray) -> np.ndarray:
        low, high = (between(sums, first, end) for sums in (evidence.hit_sums, evidence.raised_hit_sums))
        return np.where(np.broadcast_to(raised, len(boxes))[:, None], high, low)

    front = cell(entry - HIT_BEFORE_M, 0)
    hits = returns(front, cell(np.minimum(entry + HIT_BEHIND_M, exit_ + HIT_EXIT_M), 1))
    all_hits = returns(front, cell(exit_ + DEEP_EXIT_M, 1))
    first, end = cell(entry + FREE_BEHIND_M, 1), cell(exit_ - FREE_BEFORE_M, 0)
    length = counted * np.maximum(end - first, 0)
    free = counted * between(evidence.free_sums, first, np.maximum(first, end))

    hit = counted & (hits > 0)
    through = counted & ~hit & (free > 0)
    deep = counted & ~hit & ~through & (all_hits > 0)
    total = np.maximum(counted.sum(axis=1), 1)
    return RayFractions(
        hit=hit.sum(axis=1) / total,
        free=through.sum(axis=1) / total,
        occluded=(counted & ~hit & ~through & ~deep).sum(axis=1) / total,
        deep=deep.sum(axis=1) / total,
        free_length=free.sum(axis=1) / np.maximum(length.sum(axis=1), 1),
        open=(free > 0).sum(axis=1) / total,
    )


def is_raised(prior: ClassPrior) -> bool:
    """Whether beams pass below the bodies of a class."""
    return float(prior.open_below) > 0


def closed_free_length(rays: RayFractions, prior: ClassPrior) -> np.ndarray:
    """The free space that speaks against a class: not that behind hits where beams pass below the body.

    Args:
      rays: (B,) fractions.
      prior: `open_below` is the share that does not count.

    Returns:
      (B,).
    """
    beside = np.minimum(rays.free_length, rays.free)
    return rays.free_length + min(float(prior.open_below), 1.0) * (beside - rays.free_length)


def _ray_angles(boxes: np.ndarray, num_rays: int) -> np.ndarray:
    """(B, rays) azimuths, rad, in the middle of equal parts of the box's span."""
    x, y, length, width, yaw = boxes.T[..., None]
    ahead, left = np.array([1, -1, -1, 1]) * length / 2, np.array([1, 1, -1, -1]) * width / 2
    corner_x = x + np.cos(yaw) * ahead - np.sin(yaw) * left
    corner_y = y + np.sin(yaw) * ahead + np.cos(yaw) * left
    middle = np.arctan2(y, x)
    offset = np.arctan2(corner_y, corner_x) - middle
    offset = (offset + np.pi) % (2 * np.pi) - np.pi
    low, high = offset.min(axis=1, keepdims=True), offset.max(axis=1, keepdims=True)
    return middle + low + (high - low) * (np.arange(num_rays) + 0.5) / num_rays


def _intersect(boxes: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(B, rays) distances from the sensor at which rays enter and leave; entry > exit for a miss."""
    x, y, length, width, yaw = boxes.T[..., None]
    cos, sin = np.cos(yaw), np.sin(yaw)
    entry, exit_ = np.full(angle.shape, -np.inf), np.full(angle.shape, np.inf)
    for half, position, direction in (
        (length / 2, x * cos + y * sin, np.cos(angle - yaw)),
        (width / 2, -x * sin + y * cos, np.sin(angle - yaw)),
    ):
        # A ray along the face: any tiny slope has it wholly within, or wholly outside, the slab.
        slope = np.where(np.abs(direction) > 1e-9, direction, 1e-9)
        sides = np.stack([(position - half) / slope, (position + half) / slope])
        entry, exit_ = np.maximum(entry, sides.min(axis=0)), np.minimum(exit_, sides.max(axis=0))
    return entry, exit_
