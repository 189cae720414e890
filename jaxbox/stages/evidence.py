"""What the beams say about a box: hit, seen through or hidden, on a polar grid."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.loops import store
from jaxbox.xla.masked import lookup

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

BLOCK_BITS = 4
BLOCK = 2**BLOCK_BITS
"""Range cells of one word of the evidence: a bit of its low half each; the high half tells of the others."""

NEVER = 2**BLOCK - 1
"""Range cell of the next hit where there is none."""

MIN_ENTRY_M = 1.0
"""Rays that enter a box nearer than this say nothing: the sensor is all but inside."""

MIN_SLOPE = 1e-9
"""Rays along a face are taken to run away from it by this."""


ARCTAN = (
    0.00262224281, -0.015132529, 0.0411218476, -0.07366705,
    0.105739315, -0.141859752, 0.199903966, -0.333329871,
)  # fmt: skip
"""(atan t / t - 1) / t^2 as a polynomial of t^2, highest power first: within 1e-8 of atan t on [0, 1]."""

SINE = (2.60005475e-6, -1.98066152e-4, 8.33301729e-3, -0.166666571)
"""(sin t / t - 1) / t^2 likewise, within 5e-9 of sin t up to a quarter turn."""

COSINE = (-2.60771053e-7, 2.47618862e-5, -1.38884035e-3, 0.0416666407, -0.499999995)
"""(cos t - 1) / t^2 likewise, within 3e-10 of cos t up to a quarter turn."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Evidence:
    """Words of 16 range cells on a polar grid: few enough to stay in the cache, one look-up an end."""

    free: jax.Array
    """(B, A) uint32: which cells of a block are free, and, from bit 16 on, how many before the block."""
    hit: jax.Array
    """(B, A) uint32: which cells of a block have a return of vehicle height, and, from bit 16 on, the
    first cell beyond the block that has one, or `NEVER`."""
    support: jax.Array
    """(200, 200) float32: ground points in the 7 x 7 m round each 1 m cell."""
    num_ranges: int = dataclasses.field(metadata={"static": True})
    """static, R: range cells of the grid, the last block's being more."""


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
    rho = jnp.sqrt(xyz[:, 0] ** 2 + xyz[:, 1] ** 2)
    seen = mask & (rho >= min_range_m)
    # Stored, or each scatter would work it out again.
    azimuth = store(azimuth_cell(_arctan2(xyz[:, 1], xyz[:, 0]), num_azimuths))
    num_blocks = num_ranges // BLOCK + 1
    size = num_blocks * BLOCK * num_azimuths

    def place(there: jax.Array, range_cell: jax.Array) -> jax.Array:
        return jnp.where(there, range_cell * num_azimuths + azimuth, size)

    is_hit = seen & (hit_min_height_m < height) & (height < hit_max_height_m)
    is_hit = is_hit & (rho < num_ranges * range_cell_m)
    hit_range = (rho / range_cell_m).astype(jnp.int32)
    hits = jnp.zeros(size, bool).at[place(is_hit, hit_range)].set(True, mode="drop")

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
    ends = place(is_free, first), place(is_free, last)
    beams = _count_changes(jnp.zeros(size, jnp.int32), ends)

    shape = (num_blocks, BLOCK, num_azimuths)
    return Evidence(
        free=_free_words(beams.reshape(shape)),
        hit=_hit_words(hits.reshape(shape)),
        support=_ground_support(xyz, height, mask, support_height_m),
        num_ranges=num_ranges,
    )


def _arctan2(y: jax.Array, x: jax.Array) -> jax.Array:
    """As `jnp.arctan2` to 3e-7 rad; 0 at the origin. That of XLA does not vectorise on a CPU."""
    near, far = jnp.minimum(jnp.abs(x), jnp.abs(y)), jnp.maximum(jnp.abs(x), jnp.abs(y))
    ratio = near / jnp.where(far > 0, far, 1)
    square = ratio**2
    angle = ratio + ratio * square * _polynomial(ARCTAN, square)
    angle = jnp.where(jnp.abs(y) > jnp.abs(x), math.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, math.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)


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


def _count_changes(beams: jax.Array, ends: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Beams that begin in each cell less those that end there."""
    if on_accelerator():
        # One scatter reads and writes the cells once, which counts in a batch.
        return beams.at[jnp.stack(ends)].add(jnp.array([[1], [-1]], jnp.int32), mode="drop")
    return beams.at[ends[0]].add(1, mode="drop").at[ends[1]].add(-1, mode="drop")


def _free_words(beams: jax.Array) -> jax.Array:
    """From how many more beams begin than end in each cell (B, 16, A), what `Evidence.free` holds."""
    running = _sum_before(functools.reduce(jnp.add, (beams[:, k] for k in range(BLOCK))))
    free = jnp.zeros_like(running, jnp.uint32)
    for k in range(BLOCK):
        running = running + beams[:, k]
        free = free | ((running > 0).astype(jnp.uint32) << k)
    before = _sum_before(jax.lax.population_count(free).astype(jnp.int32))
    return free | (before.astype(jnp.uint32) << BLOCK)


def _sum_before(blocks: jax.Array) -> jax.Array:
    """Sums of the rows before each row. A scan over few wide rows is the fastest of its kind (XLA, CPU)."""
    if on_accelerator():
        return jnp.cumsum(blocks, axis=0) - blocks
    return jax.lax.scan(lambda total, row: (total + row, total), jnp.zeros_like(blocks[0]), blocks)[1]


def _hit_words(hits: jax.Array) -> jax.Array:
    """From which cells have a hit (B, 16, A), what `Evidence.hit` holds."""
    hit = jnp.zeros((hits.shape[0], hits.shape[2]), jnp.uint32)
    for k in range(BLOCK):
        hit = hit | (hits[:, k].astype(jnp.uint32) << k)
    start = jnp.arange(hits.shape[0], dtype=jnp.uint32)[:, None] * BLOCK
    first = jnp.where(hit > 0, start + _lowest_bit(hit), NEVER)

    def step(beyond: jax.Array, first: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.minimum(beyond, first), beyond

    if on_accelerator():
        least = jax.lax.cummin(first, axis=0, reverse=True)
        beyond = jnp.pad(least[1:], ((0, 1), (0, 0)), constant_values=NEVER)
    else:
        beyond = jax.lax.scan(step, jnp.full_like(first[0], NEVER), first, reverse=True)[1]
    return hit | (beyond << BLOCK)


def flagged_cells(words: jax.Array | np.ndarray) -> np.ndarray:
    """Which cells the words of `Evidence` flag, as free or as hit, for pictures and tests.

    Args:
      words: (B, A) uint32.

    Returns:
      (16 B, A) bool, by range and azimuth.
    """
    bits = np.asarray(words)[:, None] >> np.arange(BLOCK, dtype=np.uint32)[:, None]
    return (bits & 1).astype(bool).reshape(-1, words.shape[1])


def _lowest_bit(word: jax.Array) -> jax.Array:
    """Place of the lowest bit of words that are not zero."""
    return jax.lax.population_count((word & -word) - 1)


def _ground_support(
    xyz: jax.Array, height: jax.Array, mask: jax.Array, support_height_m: jax.Array | float
) -> jax.Array:
    n = round(2 * SUPPORT_HALF_M)
    i, j = (jnp.clip(jnp.floor(xyz[:, a] + SUPPORT_HALF_M).astype(jnp.int32), 0, n - 1) for a in (0, 1))
    on_ground = mask & (jnp.abs(height) < support_height_m)
    place = jnp.where(on_ground, i * n + j, n * n)
    count = jnp.zeros(n * n, jnp.int32).at[place].add(1, mode="drop").reshape(n, n)
    for axis in (0, 1):
        pad = [(SUPPORT_REACH, SUPPORT_REACH) if a == axis else (0, 0) for a in (0, 1)]
        padded = jnp.pad(count, pad)
        slices = (jax.lax.slice_in_dim(padded, k, k + n, axis=axis) for k in range(2 * SUPPORT_REACH + 1))
        count = functools.reduce(jnp.add, slices)
    return count.astype(jnp.float32)


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
      length: float32, m, broadcasts to (...).
      width: likewise.
      yaw: likewise, rad.
      num_rays: static.
      range_cell_m: static, as the evidence was built with.

    Returns:
      The fractions.

    Reference: oracle `jaxbox.reference.box_evidence`.
    """
    shape = center.shape[:-1]
    length, width, yaw = (jnp.broadcast_to(a, shape).reshape(-1) for a in (length, width, yaw))
    # Stored, or what is the same for all rays of a box would be worked out for each.
    fan = store(_ray_fan(center.reshape(-1, 2), length / 2, width / 2, yaw))
    # The axis along which the rays of a box lie: on a CPU sums along the first vectorise, on an accelerator
    # those along the last are the faster ones.
    axis = 1 if on_accelerator() else 0
    azimuth, enter, leave = store(_ray_stretches(fan, num_rays, axis))
    met = store(_sort_rays(evidence, azimuth, enter, leave, range_cell_m))
    # Sums of integers take several kernels, those of floats one (XLA, CPU), and these are exact.
    sums = (jnp.sum(a, axis=axis, dtype=jnp.float32).reshape(shape) for a in met)
    hit, free, deep, crosses, free_cells, cells = sums
    total = jnp.maximum(crosses, 1)
    return RayFractions(
        hit=hit / total,
        free=free / total,
        deep=deep / total,
        occluded=(crosses - hit - free - deep) / total,
        free_length=free_cells / jnp.maximum(cells, 1),
    )


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
    spread = _arctan2(u[None] * corner_v - v[None] * corner_u, u[None] * corner_u + v[None] * corner_v)
    low, high = jnp.min(spread, axis=0), jnp.max(spread, axis=0)
    azimuth = _arctan2(y, x) + (low + high) / 2
    along, across = jnp.cos(azimuth - yaw), jnp.sin(azimuth - yaw)
    return azimuth, (high - low) / 2, along, across, u, v, half_l, half_w


def _ray_stretches(fan: Fan, num_rays: int, axis: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Azimuth of rays over boxes, and the ranges at which they enter and leave, the rays along an axis.

    In the box's frame, with the sensor at the origin, the box is |u - u0| < l / 2 and |v - v0| < w / 2: the
    slab test. A ray that leaves before it enters misses.
    """
    middle, half, along, across, u0, v0, half_l, half_w = (jnp.expand_dims(a, axis) for a in fan)
    # A quarter turn at most, as seen from outside the box; from inside, any direction leads out.
    place = 2 * jnp.arange(num_rays, dtype=jnp.float32) + 1
    offset = jnp.expand_dims(place / num_rays - 1, 1 - axis) * half
    cos, sin = _cos_sin(offset)
    enter_u, leave_u = _slab(u0, along * cos - across * sin, half_l)
    enter_v, leave_v = _slab(v0, across * cos + along * sin, half_w)
    return middle + offset, jnp.maximum(enter_u, enter_v), jnp.minimum(leave_u, leave_v)


def _cos_sin(angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Of angles up to a quarter turn, to 1e-7; those of XLA do not vectorise on a CPU."""
    square = angle**2
    return 1 + square * _polynomial(COSINE, square), angle + angle * square * _polynomial(SINE, square)


def _polynomial(coefficients: tuple[float, ...], x: jax.Array) -> jax.Array:
    total = jnp.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        total = total * x + coefficient
    return total


def _slab(middle: jax.Array, direction: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
    # A ray along the face: any tiny slope has it wholly within, or wholly outside, the slab.
    inverse = 1 / jnp.where(jnp.abs(direction) > MIN_SLOPE, direction, MIN_SLOPE)
    through, reach = middle * inverse, half * jnp.abs(inverse)
    return through - reach, through + reach


def _sort_rays(
    evidence: Evidence,
    azimuth: jax.Array,
    enter: jax.Array,
    leave: jax.Array,
    range_cell_m: float,
) -> tuple[jax.Array, ...]:
    """Whether each ray hit, was free, was deep, crossed at all; its free cells inside, and all there."""
    num_azimuths = evidence.free.shape[1]
    crosses = (leave > enter) & (enter >= MIN_ENTRY_M)
    # Any range will do where the ray misses.
    enter, leave = jnp.where(crosses, enter, MIN_ENTRY_M), jnp.where(crosses, leave, MIN_ENTRY_M)

    def cell(range_m: jax.Array, extra: int) -> jax.Array:
        return jnp.clip((range_m / range_cell_m).astype(jnp.int32) + extra, 0, evidence.num_ranges)

    near, first = cell(enter - HIT_BEFORE_M, 0), cell(enter + FREE_AFTER_M, 1)
    last = jnp.maximum(cell(leave - FREE_BEFORE_M, 0), first)
    column = azimuth_cell(azimuth, num_azimuths)
    # Stored, since what a look-up has to work out first does not vectorise.
    ends = store((near, first, last))
    near_word, first_word, last_word = (
        lookup(table.reshape(-1), place)
        for table, place in zip(
            (evidence.hit, evidence.free, evidence.free),
            store([(end >> BLOCK_BITS) * num_azimuths + column for end in ends]),
            strict=True,
        )
    )
    met_at = _next_hit(near_word, near)
    is_hit = crosses & (met_at < cell(jnp.minimum(enter + HIT_AFTER_M, leave + HIT_BEYOND_M), 1))
    cells = jnp.where(crosses, last - first, 0)
    free_cells = jnp.where(crosses, _free_before(last_word, last) - _free_before(first_word, first), 0)
    is_free = ~is_hit & (free_cells > 0)
    is_deep = crosses & ~is_hit & ~is_free & (met_at < cell(leave + DEEP_BEYOND_M, 1))
    return is_hit, is_free, is_deep, crosses, free_cells, cells


def _next_hit(word: jax.Array, cell: jax.Array) -> jax.Array:
    """Range cell of the first hit in a cell or beyond, from the word of its block in `Evidence.hit`."""
    bit = (cell & (BLOCK - 1)).astype(jnp.uint32)
    rest = (word & NEVER) >> bit
    return jnp.where(rest > 0, cell + _lowest_bit(rest).astype(jnp.int32), (word >> BLOCK).astype(jnp.int32))


def _free_before(word: jax.Array, cell: jax.Array) -> jax.Array:
    """How many cells before one are free, from the word of its block in `Evidence.free`."""
    below = (jnp.uint32(1) << (cell & (BLOCK - 1)).astype(jnp.uint32)) - 1
    return ((word >> BLOCK) + jax.lax.population_count(word & below)).astype(jnp.int32)
