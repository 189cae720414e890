"""What the beams say about a box: hit, seen through or hidden, on a polar grid."""

import math

import chex
import jax
import jax.numpy as jnp

from jaxbox.config import DetectorConfig, EvidenceConfig
from jaxbox.stages._priors import is_raised, prior_of
from jaxbox.stages.state import (
    Boxes,
    ClassHypotheses,
    Evidence,
    FlatBoxes,
    Ground,
    GroundElevation,
    RayFractions,
    Sweep,
)
from jaxbox.xla import chunks
from jaxbox.xla.arithmetic import arctan2, cos_sin
from jaxbox.xla.bits import sum_packed
from jaxbox.xla.indexing import scatter
from jaxbox.xla.loops import apply_in_turn, fast_axis, map_rows
from jaxbox.xla.range_bits import draw_beams, next_set, set_before, words_at
from jaxbox.xla.rows import sum_after

HIT_BEFORE_M, HIT_AFTER_M, HIT_BEYOND_M = 0.35, 0.6, 0.25
"""A ray hits a box with a return from this before its entry to this after, or this past its exit."""


FREE_AFTER_M, FREE_BEFORE_M = 0.3, 0.2
"""Free space counts from this behind the entry to this before the exit: bodies are rounded."""


DEEP_BEYOND_M = 0.1
"""A return later than a hit, up to this past the exit, is a deep one: through a window, say."""


MIN_ENTRY_M = 1.0
"""Rays that enter a box nearer than this are ignored: the sensor is almost inside it."""


MIN_DROP_M = 1e-3
"""Beams that sink by less than this on their way are level, and cross no height."""


ENDS_AT_RETURN = 1 - 1e-6
"""From this fraction of its way on, the free part of a beam ends at the return itself."""


LEAST_RISE, RISES_PER_UNIT, NUM_RISES = 0.03, 200, 64
"""Rises of beams are counted from the first on, in that many levels of .005. Every sensor has a beam that
rises at least so much, and those that rise beyond the last, 19 degrees, cut no vehicle off."""


NUM_STEEPEST, STEEP_FROM_M = 30, 8.0
"""So many points rise as much as the highest beam, a few strays apart. Nearer ones say less: the lasers of a
sensor are some centimetres above or below its origin."""


MIN_SLOPE = 1e-9
"""Least slope of a ray against a face: a ray along it lies wholly within the slab, or wholly outside."""


def observe(
    sweep: Sweep, ground: Ground, ground_elevation: GroundElevation, config: EvidenceConfig
) -> Evidence | None:
    """What the beams saw.

    Args:
      sweep: of N rows.
      ground: below them.
      ground_elevation: asks for the ground under other places.
      config: of the evidence.

    Returns:
      The evidence; None where the preset does not ask for it.
    """
    if not config.enabled:
        return None
    chex.assert_shape([sweep.inlier, ground.height], sweep.xyz.shape[:1])
    sensor_height_m = -ground.plane.coefficients[2]
    return build_evidence(sweep.xyz, ground.height, sweep.inlier, sensor_height_m, ground_elevation, config)


def build_evidence(
    xyz: jax.Array,
    height: jax.Array,
    mask: jax.Array,
    sensor_height_m: jax.Array,
    ground_elevation: GroundElevation,
    config: EvidenceConfig,
) -> Evidence:
    """Draws every beam into a polar grid: where it was free, and where it returned.

    Over even ground, a beam from the sensor at height s to a return at range rho and height h < s is at
    height s + t (h - s) at the fraction t of its way. Where that lies between the two free heights, no
    vehicle stands. Where the ground falls on the way, the height is measured in the middle of that part, and
    what it is more than this is added.

    Args:
      xyz: (N, 3) float32, m, sensor frame.
      height: (N,) float32, m, above the ground.
      mask: (N,) bool, points that count.
      sensor_height_m: () float32, m, above the ground.
      ground_elevation: asks for the ground under the beams.
      config: the grid, A azimuths by R ranges, and the heights of what is a hit and what is free.

    Returns:
      The evidence; all zero where no point counts.

    Reference: oracle `jaxbox.reference.build_evidence`.
    """
    num_azimuths, num_ranges, range_cell_m = config.num_azimuths, config.num_ranges, config.range_cell_m
    rho = jnp.sqrt(xyz[:, 0] ** 2 + xyz[:, 1] ** 2)
    returned = mask & (rho >= config.min_range_m)
    may_hit = returned & (config.hit_min_height_m < height) & (rho < num_ranges * range_cell_m)
    tops = config.hit_max_height_m, config.raised_hit_max_height_m

    drop = height - sensor_height_m
    downward = returned & (drop < -MIN_DROP_M)
    drop = jnp.where(downward, drop, -1.0)
    middle_height_m = (config.free_min_height_m + config.free_max_height_m) / 2
    middle = jnp.clip((middle_height_m - sensor_height_m) / drop, 0, 1)
    place = middle[:, None] * xyz
    rise = place[:, 2] - ground_elevation(place) - (sensor_height_m + middle * drop)
    # A beam that only seems low, where the ground is a guess, must not show free space nearer by.
    rise = jnp.maximum(rise, 0)
    enter = jnp.maximum((config.free_max_height_m - rise - sensor_height_m) / drop, 0)
    leave = jnp.minimum((config.free_min_height_m - rise - sensor_height_m) / drop, 1)
    first_m = rho * enter
    last_m = rho * leave - jnp.where(leave >= ENDS_AT_RETURN, config.end_gap_m, 0)
    first = jnp.minimum((first_m / range_cell_m).astype(jnp.int32) + 1, num_ranges)
    last = jnp.minimum((last_m / range_cell_m).astype(jnp.int32), num_ranges)
    is_free = downward & (last_m > first_m) & (last > first)
    free, hit = draw_beams(
        azimuth_cell(arctan2(xyz[:, 1], xyz[:, 0]), num_azimuths),
        ([may_hit & (height < top) for top in tops], (rho / range_cell_m).astype(jnp.int32)),
        (is_free, first, last),
        num_columns=num_azimuths,
        num_cells=num_ranges,
    )
    return Evidence(
        free=free,
        hit=hit,
        steepest=steepest_beam(xyz[:, 2], rho, mask),
        num_ranges=num_ranges,
    )


def steepest_beam(z: jax.Array, rho: jax.Array, mask: jax.Array) -> jax.Array:
    """The rise of the highest beam, as far as points show it.

    Args:
      z: (N,) float32, m, sensor frame.
      rho: (N,) float32, m.
      mask: (N,) bool, points that count.

    Returns:
      () float32, m/m: what 30 points have or exceed, and at least .03. Where the highest beams meet nothing,
      it is that of the highest that returns.

    Reference: oracle `jaxbox.reference.steepest_beam`.
    """
    level = jnp.floor((z / jnp.maximum(rho, STEEP_FROM_M) - LEAST_RISE) * RISES_PER_UNIT).astype(jnp.int32)
    counted = mask & (rho > STEEP_FROM_M) & (level >= 0)
    place = jnp.where(counted, jnp.minimum(level, NUM_RISES - 1), NUM_RISES)
    count = scatter("add", jnp.zeros(NUM_RISES, jnp.int32), place, 1).astype(jnp.float32)
    higher = sum_after(count[None])[0]
    share = jnp.clip((NUM_STEEPEST - higher) / jnp.maximum(count, 1), 0, 1)
    top = jnp.arange(1, NUM_RISES + 1, dtype=jnp.float32) - share
    return LEAST_RISE + jnp.max(jnp.where(higher + count >= NUM_STEEPEST, top, 0)) / RISES_PER_UNIT


def first_returns(evidence: Evidence | None, config: EvidenceConfig) -> jax.Array:
    """Range of the first return at a vehicle's height in each azimuth cell: what may hide vehicles behind it.

    Args:
      evidence: of the sweep; None where there is none.
      config: that the evidence was built with.

    Returns:
      (A,) float32, m: where the cell of that return begins; the end of the grid where nothing returned.

    Reference: oracle `jaxbox.reference.evidence.first_returns`.
    """
    end = jnp.full(config.num_azimuths, config.num_ranges, jnp.int32)
    if evidence is not None:
        end = jnp.minimum(next_set(evidence.low_hit[0], jnp.zeros_like(end)), end)
    return end.astype(jnp.float32) * config.range_cell_m


def azimuth_cell(azimuth: jax.Array, num_azimuths: int) -> jax.Array:
    """Cell of an azimuth.

    Args:
      azimuth: (...) float32, rad, within two turns of 0.
      num_azimuths: static.

    Returns:
      (...) int32, in [0, num_azimuths); cell 0 begins at -pi.
    """
    turns = (azimuth + math.pi) / (2 * math.pi)
    # The product may be rounded up to the whole turn.
    whole = jnp.floor(turns).astype(jnp.int32)
    cell = jnp.floor(turns * num_azimuths).astype(jnp.int32) - num_azimuths * whole
    return jnp.where(cell < num_azimuths, cell, 0)


def cast_rays(
    evidence: Evidence,
    boxes: FlatBoxes,
    config: EvidenceConfig,
    *,
    num_rays: int,
    raised: jax.Array | bool = False,
) -> RayFractions:
    """Casts rays evenly over the azimuths that a box spans, and classifies them by what they met.

    A ray enters the box at e and leaves it at x. It hits where there is a return about e; else it is
    free where free space lies between; else deep where there is a return up to x; else occluded.

    Args:
      evidence: of the sweep.
      boxes: centres (..., 2), and sizes and yaw that broadcast to (...).
      config: that the evidence was built with.
      num_rays: static.
      raised: bool, broadcasts to (...): whether beams pass below the body, so that higher returns are hits.

    Returns:
      The fractions.

    Reference: oracle `jaxbox.reference.cast_rays`.
    """
    center, shape = boxes.center.reshape(-1, 2), boxes.center.shape[:-1]
    sides = (jnp.broadcast_to(a, shape).reshape(-1) for a in (boxes.length, boxes.width, boxes.yaw))
    length, width, yaw = sides
    axis = fast_axis()
    raised = jnp.expand_dims(jnp.broadcast_to(raised, shape).reshape(-1), axis)
    met = apply_in_turn(
        [
            lambda boxes: _ray_fan(*boxes),
            lambda fan: _ray_intervals(fan, num_rays, axis),
            lambda intervals: _classify_rays(
                evidence, *intervals, raised=raised, range_cell_m=config.range_cell_m
            ),
        ],
        (center, length / 2, width / 2, yaw),
    )
    most = *[1] * 5, evidence.num_ranges, evidence.num_ranges
    sums = (a.astype(jnp.float32).reshape(shape) for a in sum_packed(met, most, axis=axis))
    hit, free, deep, is_open, crosses, free_cells, cells = sums
    total = jnp.maximum(crosses, 1)
    return RayFractions(
        hit=hit / total,
        free=free / total,
        deep=deep / total,
        occluded=(crosses - hit - free - deep) / total,
        free_length=free_cells / jnp.maximum(cells, 1),
        open=is_open / total,
    )


def weigh_boxes(
    evidence: Evidence, boxes: Boxes, hypotheses: ClassHypotheses, config: DetectorConfig
) -> RayFractions:
    """What the rays over each box met.

    Args:
      evidence: of the sweep.
      boxes: (Q,) of them.
      hypotheses: that they are of: their classes, and how many count.
      config: the classes, the rays over each box, and what the evidence was built with.

    Returns:
      (Q,) fractions.
    """

    num_rays = config.completion.num_final_rays

    def weigh(rows: tuple[Boxes, jax.Array]) -> RayFractions:
        boxes, label = rows
        raised = is_raised(prior_of(config.vehicles.classes, label))
        return cast_rays(evidence, boxes, config.evidence, num_rays=num_rays, raised=raised)

    return map_rows(weigh, (boxes, hypotheses.label), num_rows=hypotheses.num, chunk=chunks.RAYS)


Fan = tuple[jax.Array, ...]
"""Azimuth of the middle ray over each box and half the angle between the outer ones, rad; direction of the
middle ray, the box's centre from the sensor, m, and half its size, m, all three along and across the box."""


def _ray_fan(center: jax.Array, half_l: jax.Array, half_w: jax.Array, yaw: jax.Array) -> Fan:
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    x, y = center[:, 0], center[:, 1]
    u, v = x * cos + y * sin, y * cos - x * sin
    # The azimuths of the corners, from that of the centre on.
    to_front, to_left = jnp.array([[-1, -1, 1, 1], [-1, 1, -1, 1]], jnp.float32)[..., None]
    corner_u, corner_v = u[None] + to_front * half_l[None], v[None] + to_left * half_w[None]
    spread = arctan2(u[None] * corner_v - v[None] * corner_u, u[None] * corner_u + v[None] * corner_v)
    low, high = jnp.min(spread, axis=0), jnp.max(spread, axis=0)
    azimuth = arctan2(y, x) + (low + high) / 2
    along, across = jnp.cos(azimuth - yaw), jnp.sin(azimuth - yaw)
    return azimuth, (high - low) / 2, along, across, u, v, half_l, half_w


def _ray_intervals(fan: Fan, num_rays: int, axis: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Azimuth of rays over boxes, and the ranges at which they enter and leave, the rays along an axis.

    In the box's frame, with the sensor at the origin, the box is |u - u0| < l / 2 and |v - v0| < w / 2: the
    slab test. A ray that leaves before it enters misses.
    """
    middle, half, along, across, u0, v0, half_l, half_w = (jnp.expand_dims(a, axis) for a in fan)
    # A quarter turn at most, as seen from outside the box; from inside, any direction leads out.
    place = 2 * jnp.arange(num_rays, dtype=jnp.float32) + 1
    offset = jnp.expand_dims(place / num_rays - 1, 1 - axis) * half
    cos, sin = cos_sin(offset)
    enter_u, leave_u = _slab(u0, along * cos - across * sin, half_l)
    enter_v, leave_v = _slab(v0, across * cos + along * sin, half_w)
    return middle + offset, jnp.maximum(enter_u, enter_v), jnp.minimum(leave_u, leave_v)


def _slab(middle: jax.Array, direction: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
    inverse = 1 / jnp.where(jnp.abs(direction) > MIN_SLOPE, direction, MIN_SLOPE)
    through, reach = middle * inverse, half * jnp.abs(inverse)
    return through - reach, through + reach


def _classify_rays(
    evidence: Evidence,
    azimuth: jax.Array,
    enter: jax.Array,
    leave: jax.Array,
    *,
    raised: jax.Array,
    range_cell_m: float,
) -> tuple[jax.Array, ...]:
    """Whether each ray is a hit, free, deep, open, and crosses the box; its free and all its cells inside."""
    num_azimuths = evidence.free.shape[1]
    crosses = (leave > enter) & (enter >= MIN_ENTRY_M)
    # Where the ray misses, any valid range.
    enter, leave = jnp.where(crosses, enter, MIN_ENTRY_M), jnp.where(crosses, leave, MIN_ENTRY_M)

    def cell(range_m: jax.Array, extra: int) -> jax.Array:
        return jnp.clip((range_m / range_cell_m).astype(jnp.int32) + extra, 0, evidence.num_ranges)

    near, first = cell(enter - HIT_BEFORE_M, 0), cell(enter + FREE_AFTER_M, 1)
    last = jnp.maximum(cell(leave - FREE_BEFORE_M, 0), first)
    column = azimuth_cell(azimuth, num_azimuths)
    tables = evidence.hit, evidence.free, evidence.free
    columns = column + raised.astype(jnp.int32) * num_azimuths, column, column
    near_word, first_word, last_word = words_at(tables, (near, first, last), columns)
    met_at = next_set(near_word, near)
    is_hit = crosses & (met_at < cell(jnp.minimum(enter + HIT_AFTER_M, leave + HIT_BEYOND_M), 1))
    cells = jnp.where(crosses, last - first, 0)
    free_cells = jnp.where(crosses, set_before(last_word, last) - set_before(first_word, first), 0)
    is_open = free_cells > 0
    is_free = ~is_hit & is_open
    is_deep = crosses & ~is_hit & ~is_free & (met_at < cell(leave + DEEP_BEYOND_M, 1))
    return is_hit, is_free, is_deep, is_open, crosses, free_cells, cells
