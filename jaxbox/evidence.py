"""What the beams say about a box: hit, seen through or hidden, on a polar grid."""

import dataclasses
import math

import jax
import jax.numpy as jnp

from jaxbox.masked import lookup, store

SUPPORT_HALF_M = 100.0
"""The ground support grid covers |x|, |y| below this, in cells of 1 m."""

SUPPORT_REACH = 3
"""Cells on either side that count as the ground round a cell: 7 x 7."""

HIT_BEFORE_M, HIT_AFTER_M, HIT_BEYOND_M = 0.35, 0.6, 0.25
"""A ray hits a box with a return from this before its entry to this after, or this past its exit."""

FREE_AFTER_M, FREE_BEFORE_M = 0.3, 0.2
"""Free space counts from this behind the entry to this before the exit: bodies are rounded."""

DEEP_BEYOND_M = 0.1
"""A return later than a hit, up to this past the exit, is a deep one: through a window, say."""

MAX_HITS = 32_000
"""Hits of one azimuth that the sums can hold."""

MIN_ENTRY_M = 1.0
"""Rays that enter a box nearer than this say nothing: the sensor is all but inside."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Evidence:
    """Prefix sums over range, so that any stretch of a ray costs two look-ups."""

    free: jax.Array
    """(R + 1, A) int16: free cells among the first r of each azimuth."""
    hit: jax.Array
    """(R + 1, A) int16: returns of vehicle height in the first r cells of each azimuth."""
    support: jax.Array
    """(200, 200) float32: ground points in the 7 x 7 m round each 1 m cell."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RayFractions:
    """How the rays over a box ended, each in [0, 1]; the first four sum to 1, or to 0 without rays."""

    hit: jax.Array
    """(...) float32: a return at the entry."""
    free: jax.Array
    """(...) float32: no hit, but free space inside."""
    deep: jax.Array
    """(...) float32: neither, but a return farther inside."""
    occluded: jax.Array
    """(...) float32: nothing is known."""
    free_length: jax.Array
    """(...) float32: length of free space inside the box over the length of all rays inside."""


def build_evidence(
    xyz: jax.Array,
    height: jax.Array,
    mask: jax.Array,
    sensor_height_m: jax.Array,
    *,
    num_azimuths: int,
    num_ranges: int,
    range_cell_m: float,
    min_range_m: jax.Array | float,
    hit_min_height_m: jax.Array | float,
    hit_max_height_m: jax.Array | float,
    free_min_height_m: jax.Array | float,
    free_max_height_m: jax.Array | float,
    end_gap_m: jax.Array | float,
    support_height_m: jax.Array | float,
) -> Evidence:
    """Draws every beam into a polar grid: where it was free, and where it returned.

    A beam from the sensor at height s to a return at range rho and height h < s is at height
    s + t (h - s) at the fraction t of its way. Where that lies between the two free heights, no vehicle
    stands.

    Args:
      xyz: (N, 3) float32, m, sensor frame.
      height: (N,) float32, m, above the ground.
      mask: (N,) bool, points that count.
      sensor_height_m: () float32, m, above the ground.
      num_azimuths: static, A, all round.
      num_ranges: static, R.
      range_cell_m: static, length of a range cell.
      min_range_m: nearer returns are the carrier vehicle, m.
      hit_min_height_m: returns higher than this are hits, m.
      hit_max_height_m: returns lower than this are hits, m.
      free_min_height_m: m.
      free_max_height_m: m.
      end_gap_m: a beam that ends between the free heights is free up to this before its return, m.
      support_height_m: points within this of the ground support it, m.

    Returns:
      The evidence; all zero where no point counts.

    Reference: oracle `jaxbox.reference.build_evidence`.
    """
    rho = jnp.hypot(xyz[:, 0], xyz[:, 1])
    azimuth = azimuth_cell(jnp.arctan2(xyz[:, 1], xyz[:, 0]), num_azimuths)
    seen = mask & (rho >= min_range_m)

    def scatter(range_cell: jax.Array, value: jax.Array, grid: jax.Array) -> jax.Array:
        return grid.at[range_cell * num_azimuths + azimuth].add(value.astype(jnp.int32), mode="drop")

    empty = jnp.zeros((num_ranges + 1) * num_azimuths, jnp.int32)
    is_hit = seen & (hit_min_height_m < height) & (height < hit_max_height_m)
    hit_range = (rho / range_cell_m).astype(jnp.int32)
    hits = scatter(jnp.minimum(hit_range, num_ranges), is_hit & (hit_range < num_ranges), empty)

    drop = height - sensor_height_m
    downward = seen & (drop < -1e-3)
    drop = jnp.where(downward, drop, -1.0)
    enter = jnp.maximum((free_max_height_m - sensor_height_m) / drop, 0)
    leave = jnp.minimum((free_min_height_m - sensor_height_m) / drop, 1)
    first_m = rho * enter
    last_m = rho * leave - jnp.where(leave >= 1 - 1e-6, end_gap_m, 0)
    first = jnp.minimum((first_m / range_cell_m).astype(jnp.int32) + 1, num_ranges)
    last = jnp.minimum((last_m / range_cell_m).astype(jnp.int32), num_ranges)
    is_free = downward & (last_m > first_m) & (last > first)
    beams = scatter(first, is_free, empty)
    beams = scatter(jnp.maximum(last, 0), -is_free.astype(jnp.int32), beams)

    # Clipped, so that the sums over range stay within int16 whatever the sweep repeats.
    hits = jnp.minimum(hits, MAX_HITS // num_ranges)
    shape = (num_ranges + 1, num_azimuths)
    free, hit = _prefix_over_range(beams.reshape(shape), hits.reshape(shape))
    return Evidence(free, hit, _ground_support(xyz, height, mask, support_height_m))


def azimuth_cell(azimuth: jax.Array, num_azimuths: int) -> jax.Array:
    """Cell of an azimuth.

    Args:
      azimuth: (...) float32, rad, within two turns of 0.
      num_azimuths: static.

    Returns:
      (...) int32, in [0, num_azimuths); cell 0 begins at -pi.
    """
    turns = (azimuth + math.pi) / (2 * math.pi)
    # A remainder would divide integers, which costs more than all else here (XLA, CPU). The product may be
    # rounded up to the whole turn.
    whole = jnp.floor(turns).astype(jnp.int32)
    cell = jnp.floor(turns * num_azimuths).astype(jnp.int32) - num_azimuths * whole
    return jnp.where(cell < num_azimuths, cell, 0)


def _prefix_over_range(beams: jax.Array, hits: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Turns beam starts (+1) and ends (-1) into free cells, and sums them and the hits over range."""

    def step(carry: tuple[jax.Array, ...], row: tuple[jax.Array, jax.Array]) -> tuple:
        running, free, hit = carry
        beam, hit_here = row
        running = running + beam
        out = free.astype(jnp.int16), hit.astype(jnp.int16)
        return (running, free + (running > 0), hit + hit_here), out

    zero = jnp.zeros(beams.shape[1], jnp.int32)
    return jax.lax.scan(step, (zero, zero, zero), (beams, hits))[1]


def _ground_support(
    xyz: jax.Array, height: jax.Array, mask: jax.Array, support_height_m: jax.Array | float
) -> jax.Array:
    n = round(2 * SUPPORT_HALF_M)
    i, j = (jnp.clip(jnp.floor(xyz[:, a] + SUPPORT_HALF_M).astype(jnp.int32), 0, n - 1) for a in (0, 1))
    on_ground = (mask & (jnp.abs(height) < support_height_m)).astype(jnp.float32)
    count = jnp.zeros(n * n).at[i * n + j].add(on_ground).reshape(n, n)
    for axis in (0, 1):
        pad = [(SUPPORT_REACH, SUPPORT_REACH) if a == axis else (0, 0) for a in (0, 1)]
        padded = jnp.pad(count, pad)
        slices = [jax.lax.slice_in_dim(padded, k, k + n, axis=axis) for k in range(2 * SUPPORT_REACH + 1)]
        count = jnp.sum(jnp.stack(slices), axis=0)
    return count


def ground_support(evidence: Evidence, xy: jax.Array) -> jax.Array:
    """Ground points in the 7 x 7 m round a place.

    Args:
      evidence: of the sweep.
      xy: (..., 2) float32, m.

    Returns:
      (...) float32.
    """
    n = evidence.support.shape[0]
    index = jnp.clip(jnp.floor(xy + SUPPORT_HALF_M).astype(jnp.int32), 0, n - 1)
    return lookup(evidence.support, index[..., 0], index[..., 1])


def cast_rays(
    evidence: Evidence,
    center: jax.Array,
    length: jax.Array,
    width: jax.Array,
    yaw: jax.Array,
    *,
    num_rays: int,
    range_cell_m: float,
) -> RayFractions:
    """Casts rays evenly over the azimuths that a box spans, and sorts them by what they met.

    A ray enters the box at e and leaves it at x. It hits where there is a return about e; else it is
    free where free space lies between; else deep where there is a return up to x; else occluded.

    Args:
      evidence: of the sweep.
      center: (..., 2) float32, m.
      length: (...) float32, m.
      width: (...) float32, m.
      yaw: (...) float32, rad.
      num_rays: static.
      range_cell_m: static, as the evidence was built with.

    Returns:
      The fractions.

    Reference: oracle `jaxbox.reference.box_evidence`.
    """
    there = jnp.any(length >= 0)
    azimuth, du, dv = store(_ray_directions(center, length, width, yaw, num_rays), there)
    enter, leave = store(_ray_stretches(center, length, width, yaw, du, dv), there)
    met_inside = _sort_rays(evidence, azimuth, enter, leave, range_cell_m)
    crosses, met, free_cells, span = store(met_inside, there)
    total = jnp.maximum(jnp.sum(crosses, axis=-1), 1)

    def share(kind: int) -> jax.Array:
        return jnp.sum(crosses & (met == kind), axis=-1) / total

    free_length = jnp.sum(free_cells, axis=-1) / jnp.maximum(jnp.sum(span, axis=-1), 1)
    return RayFractions(
        hit=share(_HIT),
        free=share(_FREE),
        deep=share(_DEEP),
        occluded=share(_OCCLUDED),
        free_length=free_length,
    )


_HIT, _FREE, _DEEP, _OCCLUDED = range(4)


def _sort_rays(
    evidence: Evidence, azimuth: jax.Array, enter: jax.Array, leave: jax.Array, range_cell_m: float
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Whether each ray crosses its box, what it met there, its free cells inside, and all its cells there."""
    crosses = (leave > enter) & (enter >= MIN_ENTRY_M)
    num_ranges, num_azimuths = evidence.free.shape[0] - 1, evidence.free.shape[1]
    column = azimuth_cell(azimuth, num_azimuths)

    def cell(range_m: jax.Array, extra: int) -> jax.Array:
        return jnp.clip(jnp.trunc(range_m / range_cell_m).astype(jnp.int32) + extra, 0, num_ranges)

    def between(prefix: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
        return lookup(prefix, high, column) - lookup(prefix, low, column)

    near = cell(enter - HIT_BEFORE_M, 0)
    hit_end = cell(jnp.minimum(enter + HIT_AFTER_M, leave + HIT_BEYOND_M), 1)
    is_hit = between(evidence.hit, near, hit_end) > 0
    is_inside = between(evidence.hit, near, cell(leave + DEEP_BEYOND_M, 1)) > 0
    first, last = cell(enter + FREE_AFTER_M, 1), cell(leave - FREE_BEFORE_M, 0)
    span = jnp.where(crosses, jnp.maximum(last - first, 0), 0)
    free_cells = jnp.where(span > 0, between(evidence.free, first, last), 0)
    blocked = jnp.where(is_inside, _DEEP, _OCCLUDED)
    met = jnp.where(is_hit, _HIT, jnp.where(free_cells > 0, _FREE, blocked))
    return crosses, met, free_cells.astype(jnp.int32), span


def _ray_directions(
    center: jax.Array, length: jax.Array, width: jax.Array, yaw: jax.Array, num_rays: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Azimuth of the rays over a box, and their directions in its frame, each (..., num_rays)."""
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    x, y = center[..., 0], center[..., 1]
    middle = jnp.arctan2(y, x)
    side_l, side_w = jnp.array([1.0, 1.0, -1.0, -1.0]), jnp.array([1.0, -1.0, 1.0, -1.0])
    along, across = side_l * length[..., None] / 2, side_w * width[..., None] / 2
    corner_x = x[..., None] + cos[..., None] * along - sin[..., None] * across
    corner_y = y[..., None] + sin[..., None] * along + cos[..., None] * across
    spread = jnp.arctan2(corner_y, corner_x) - middle[..., None]
    spread = spread - 2 * math.pi * jnp.round(spread / (2 * math.pi))
    low, high = jnp.min(spread, axis=-1), jnp.max(spread, axis=-1)
    fraction = (jnp.arange(num_rays) + 0.5) / num_rays
    azimuth = middle[..., None] + low[..., None] + (high - low)[..., None] * fraction
    return azimuth, jnp.cos(azimuth - yaw[..., None]), jnp.sin(azimuth - yaw[..., None])


def _ray_stretches(
    center: jax.Array, length: jax.Array, width: jax.Array, yaw: jax.Array, du: jax.Array, dv: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Entry and exit range of rays over a box, each (..., num_rays); exit < entry: a miss.

    In the box's frame the box is |u| < length / 2, |v| < width / 2: the slab test.
    """
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    x, y = center[..., 0], center[..., 1]
    origin_u, origin_v = -(x * cos + y * sin), x * sin - y * cos
    enter_u, leave_u = _slab(origin_u[..., None], du, length[..., None] / 2)
    enter_v, leave_v = _slab(origin_v[..., None], dv, width[..., None] / 2)
    return jnp.maximum(enter_u, enter_v), jnp.minimum(leave_u, leave_v)


def _slab(origin: jax.Array, direction: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
    parallel = jnp.abs(direction) < 1e-9
    safe = jnp.where(parallel, 1.0, direction)
    a, b = (-half - origin) / safe, (half - origin) / safe
    far = jnp.float32(1e9)
    return jnp.where(parallel, -far, jnp.minimum(a, b)), jnp.where(parallel, far, jnp.maximum(a, b))
