"""Vehicle decision: what surrounds a box, its score, and suppression of overlapping boxes."""

import dataclasses
import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.geometry.planar import rectangle_iou
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.loops import for_chunks, map_rows
from jaxbox.xla.masked import WORD_BITS, count, prefix_max, prefix_sum, split_index
from jaxbox.xla.sorting import sort_by_group

NEARBY_CELL_M = 1.0
"""Points are looked up by cells of this size."""

MAX_CELL_ROWS = 24
"""Rows of cells round a box: a vehicle of 18 m, the longest that passes the gates, with its ring."""

BLOCK_POINTS = 32
"""Neighbouring points are looked at in blocks of so many."""

LOOKUP_BLOCKS, LOOKUP_BLOCKS_AT_ONCE = 1024, 8192
"""Blocks looked at in one go, on a CPU and on an accelerator."""

COUNT_BITS = BLOCK_POINTS.bit_length()
"""Bits that hold a count of the points of a block."""

NUM_KINDS = 5
"""Kinds of points that are counted, and counts in a word of the bits of all."""

NUM_LEVELS = 20
"""Levels of height in which the points inside are counted, up to the highest that a vehicle's may have."""

LOWEST_LEVEL = 0.4
"""Where the levels begin, as a share of that height: no vehicle's top is lower."""

DOUBT_POINTS = 5
"""So many upper points, with the share of full worth behind the faces, are taken for granted: of few
points the share says little."""

ROUNDS = 6
"""Rounds of suppression on an accelerator before the host looks whether they were enough."""

BOX_CHUNK = 128
"""Boxes looked at together."""

OVERLAP_TILE = WORD_BITS
"""Rows and columns of the overlap matrix at a time: a word of bits each row."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Surroundings:
    """Points in and round each box."""

    rows: jax.Array
    """(P, 6) float32: what follows, in that order."""

    @property
    def num_inside(self) -> jax.Array:
        """(P,) points of vehicle height inside, give or take the margin."""
        return self.rows[:, 0]

    @property
    def top(self) -> jax.Array:
        """(P,) m above the ground: as high as all but a few of them; 0 where there are none."""
        return self.rows[:, 1]

    @property
    def num_above(self) -> jax.Array:
        """(P,) points higher than the vehicle, within the box."""
        return self.rows[:, 2]

    @property
    def num_ring(self) -> jax.Array:
        """(P,) points of vehicle height just outside."""
        return self.rows[:, 3]

    @property
    def num_upper(self) -> jax.Array:
        """(P,) those inside that are as high as glass, bonnet and roof."""
        return self.rows[:, 4]

    @property
    def num_recessed(self) -> jax.Array:
        """(P,) those of them that lie behind the faces which the sensor sees."""
        return self.rows[:, 5]


def count_points_around(
    boxes: jax.Array,
    count_max_height_m: jax.Array,
    recess_m: jax.Array,
    num_boxes: jax.Array,
    xy: jax.Array,
    height: jax.Array,
    num_points: jax.Array,
    *,
    half_x_m: float,
    half_y_m: float,
    margin_m: jax.Array | float,
    ring_m: jax.Array | float,
    upper_height_m: jax.Array | float,
    stray_share: jax.Array | float,
) -> Surroundings:
    """Counts the points of the whole sweep in and round each box.

    Args:
      boxes: (P, 5) float32: x, y, length, width (m), yaw (rad).
      count_max_height_m: (P,) float32, m: points lower than this belong to the vehicle.
      recess_m: (P,) float32, m: how far behind the faces that the sensor sees a point counts as recessed.
      num_boxes: () int32, rows that hold a box.
      xy: (N, 2) float32, m, all obstacle points.
      height: (N,) float32, m, above the ground.
      num_points: () int32, rows that hold a point.
      half_x_m: static, points lie within |x| below it.
      half_y_m: static, points lie within |y| below it.
      margin_m: a point this far outside still counts as inside, m.
      ring_m: a point farther out than the margin and nearer than this is in the ring, m.
      upper_height_m: points higher than this are glass, bonnet and roof, m.
      stray_share: share of the points inside that may lie above the top: a single return in the air is no
        roof. 0 makes the highest point the top.

    Returns:
      The counts; zero for chunks of boxes beyond `num_boxes`.

    Reference: oracle `jaxbox.reference.count_points_around`.
    """
    shape = (math.ceil(2 * half_x_m / NEARBY_CELL_M), math.ceil(2 * half_y_m / NEARBY_CELL_M))

    def cell(position: jax.Array, axis: int) -> jax.Array:
        index = jnp.floor((position + (half_x_m, half_y_m)[axis]) / NEARBY_CELL_M)
        return jnp.clip(index, 0, shape[axis] - 1).astype(jnp.int32)

    cell_of_point = cell(xy[:, 0], 0) * shape[1] + cell(xy[:, 1], 1)
    order, begin, end = sort_by_group(
        lambda i: i, cell_of_point, num_points, shape[0] * shape[1], room=BLOCK_POINTS
    )
    points = [jnp.take(values, order, mode="clip") for values in (xy[:, 0], xy[:, 1], height)]

    def prepare(rows: tuple[jax.Array, ...]) -> tuple[jax.Array, list[jax.Array], list[jax.Array]]:
        boxes, *others = rows
        frames = _frames(boxes, *others)
        reach = jnp.abs(frames[:, 2:4]) * (frames[:, 4:5] + ring_m)
        reach = reach + jnp.abs(frames[:, 3:1:-1]) * (frames[:, 5:6] + ring_m)
        low = [cell(boxes[:, axis] - reach[:, axis], axis) for axis in (0, 1)]
        return frames, low, [cell(boxes[:, axis] + reach[:, axis], axis) for axis in (0, 1)]

    def look(rows: tuple[jax.Array, list[jax.Array], list[jax.Array]]) -> jax.Array:
        frames, low, high = rows
        i = low[0][:, None] + jnp.arange(MAX_CELL_ROWS, dtype=jnp.int32)[None]
        row = jnp.minimum(i, shape[0] - 1) * shape[1]
        first, after = begin[row + low[1][:, None]], end[row + high[1][:, None]]
        length = jnp.where(i <= high[0][:, None], after - first, 0)
        counts, highest = _count_runs(frames, first, length, points, margin_m, ring_m, upper_height_m)
        inside, above, ring, upper, recessed = counts[:, :NUM_KINDS].T
        top = _top(highest, stray_share * inside, counts[:, NUM_KINDS:], frames[:, -1])
        return jnp.stack([inside, top, above, ring, upper, recessed], axis=1)

    rows = map_rows(prepare, (boxes, count_max_height_m, recess_m), num_rows=num_boxes)
    return Surroundings(map_rows(look, rows, num_rows=num_boxes, chunk=BOX_CHUNK))


def cluster_alone(num_points: jax.Array, top: jax.Array) -> Surroundings:
    """What surrounds boxes of which only the clusters are looked at: nothing.

    Args:
      num_points: (P,) float32, of the clusters.
      top: (P,) float32, m above the ground, of the clusters.

    Returns:
      The surroundings.
    """
    none = jnp.zeros_like(top)
    return Surroundings(jnp.stack([num_points, top, none, none, none, none], axis=1))


def _frames(boxes: jax.Array, count_max_height_m: jax.Array, recess_m: jax.Array) -> jax.Array:
    """(P, 11) what the points round a box are held against, see `_judge`."""
    x, y, length, width, yaw = boxes.T
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    half_l, half_w = length / 2, width / 2
    # The sensor at the origin, in the box's frame: it sees the faces on its side of the box.
    sensor_u, sensor_v = -(x * cos + y * sin), x * sin - y * cos
    face_u = jnp.where(jnp.abs(sensor_u) > half_l, half_l - recess_m, jnp.inf)
    face_v = jnp.where(jnp.abs(sensor_v) > half_w, half_w - recess_m, jnp.inf)
    facing = jnp.sign(sensor_u), jnp.sign(sensor_v)
    return jnp.stack([x, y, cos, sin, half_l, half_w, *facing, face_u, face_v, count_max_height_m], axis=1)


def _count_runs(
    frames: jax.Array,
    first: jax.Array,
    length: jax.Array,
    points: Sequence[jax.Array],
    margin_m: jax.Array | float,
    ring_m: jax.Array | float,
    upper_height_m: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """Counts over runs of neighbouring points, some for each box, (C, runs): block after block of them.

    Returns:
      counts: (C, kinds + levels) float32.
      highest: (C,) float32, m.
    """
    num_boxes, runs = first.shape
    first, length = first.reshape(-1), length.reshape(-1)
    at_once = LOOKUP_BLOCKS_AT_ONCE if on_accelerator() else LOOKUP_BLOCKS
    num_blocks = (length + BLOCK_POINTS - 1) // BLOCK_POINTS
    end = prefix_sum(num_blocks)
    begin = end - num_blocks

    def step(start: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        # The run of each block: that which begins last, before it or with it.
        place = start.astype(jnp.int32) + jnp.arange(at_once, dtype=jnp.int32)
        present = (num_blocks > 0) & (end > place[0]) & (begin <= place[-1])
        at = jnp.where(present, jnp.maximum(begin - place[0], 0), at_once)
        run = jnp.zeros(at_once, jnp.int32).at[at].max(jnp.arange(end.shape[0], dtype=jnp.int32), mode="drop")
        run = prefix_max(run)
        offset = (place - begin[run]) * BLOCK_POINTS
        left = jnp.where(place < end[-1], length[run] - offset, 0)
        box, _ = split_index(run, runs)

        def block(column: jax.Array) -> jax.Array:
            def piece(start: jax.Array) -> jax.Array:
                return jax.lax.dynamic_slice_in_dim(column, start, BLOCK_POINTS)

            return jax.vmap(piece)(first[run] + offset)

        there = jnp.arange(BLOCK_POINTS, dtype=jnp.int32)[None] < left[:, None]
        words, highest = _judge(
            frames[box], there, [block(column) for column in points], margin_m, ring_m, upper_height_m
        )
        digit = jnp.arange(NUM_KINDS, dtype=jnp.int32)[None, None]
        counts = (words[:, :, None] >> digit * COUNT_BITS) & (2**COUNT_BITS - 1)
        return state[0].at[box].add(counts.reshape(at_once, -1)), state[1].at[box].max(highest)

    none = jnp.zeros((num_boxes, NUM_KINDS + NUM_LEVELS), jnp.int32), jnp.zeros(num_boxes, jnp.float32)
    counts, highest = for_chunks(end[-1], at_once, step, none)
    return counts.astype(jnp.float32), highest


def _judge(
    frames: jax.Array,
    there: jax.Array,
    points: Sequence[jax.Array],
    margin_m: jax.Array | float,
    ring_m: jax.Array | float,
    upper_height_m: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """Counts of points in blocks (B, L) of them, packed in words (B, W), and the highest inside (B,).

    The first word holds each kind of point, and the others each level of height of those inside.
    """
    box_x, box_y, cos, sin, half_l, half_w, facing_u, facing_v, face_u, face_v, max_height = (
        frames[:, k, None] for k in range(frames.shape[1])
    )
    x, y, height = points
    dx, dy = x - box_x, y - box_y
    u, v = dx * cos + dy * sin, dy * cos - dx * sin
    out = jnp.where(there, jnp.maximum(jnp.abs(u) - half_l, jnp.abs(v) - half_w), jnp.inf)
    inside, low = out < margin_m, height < max_height
    upper = inside & low & (height > upper_height_m)
    recessed = upper & (jnp.minimum(face_u - facing_u * u, face_v - facing_v * v) > 0)
    # One sum counts all kinds, each in its own bits.
    kinds = (inside & low, inside & ~low, ~inside & (out < ring_m) & low, upper, recessed)
    digits = [jnp.where(kind, jnp.int32(1 << k * COUNT_BITS), 0) for k, kind in enumerate(kinds)]
    first = functools.reduce(jnp.add, digits)
    share = height / max_height - LOWEST_LEVEL
    level = jnp.minimum(share * (NUM_LEVELS / (1 - LOWEST_LEVEL)), NUM_LEVELS - 1).astype(jnp.int32)
    level = jnp.where(inside & low & (share > 0), level, NUM_LEVELS)
    place, digit = split_index(level, NUM_KINDS)
    word = jnp.arange(NUM_LEVELS // NUM_KINDS, dtype=jnp.int32)[:, None, None]
    others = jnp.where(place[None] == word, 1 << digit * COUNT_BITS, 0)
    # Heights are not negative, and the bits of such numbers are in their order: integers' maxima vectorise.
    highest = jax.lax.bitcast_convert_type(jnp.where(inside & low, height, 0), jnp.int32)
    sums = jnp.sum(first, axis=1, dtype=jnp.int32), jnp.sum(others, axis=2, dtype=jnp.int32)
    counts = jnp.concatenate([sums[0][:, None], sums[1].T], axis=1)
    return counts, jax.lax.bitcast_convert_type(jnp.max(highest, axis=1), jnp.float32)


def _top(highest: jax.Array, num_stray: jax.Array, levels: jax.Array, max_height: jax.Array) -> jax.Array:
    """(P,) the height that so many points exceed, evenly spread within their level (P, levels)."""
    # A product is one kernel, a cumulative sum several (XLA, CPU). It is exact of whole numbers, unless
    # an accelerator rounds them first.
    beyond = np.tri(NUM_LEVELS, k=-1, dtype=np.float32)
    higher = jnp.dot(levels, beyond, precision=jax.lax.Precision.HIGHEST)
    num_stray = num_stray[:, None]
    is_top = (higher <= num_stray) & (num_stray < higher + levels)
    above = jnp.arange(NUM_LEVELS, 0, -1, dtype=jnp.float32)[None] - 1
    above = above + (num_stray - higher) / jnp.maximum(levels, 1)
    share = jnp.sum(jnp.where(is_top, 1 - above * ((1 - LOWEST_LEVEL) / NUM_LEVELS), 0), axis=1)
    return jnp.where(jnp.any(is_top, axis=1), jnp.minimum(share * max_height, highest), highest)


def bell(
    value: jax.Array, peak: jax.Array | float, below: jax.Array | float, above: jax.Array | float
) -> jax.Array:
    """exp(-((value - peak) / width)^2), with its own width on either side.

    Args:
      value: any shape.
      peak: where it is 1.
      below: width below the peak.
      above: width above the peak.

    Returns:
      The same shape, in [0, 1].
    """
    return jnp.exp(-(((value - peak) / jnp.where(value < peak, below, above)) ** 2))


def evidence_score(
    *,
    num_points: jax.Array,
    hit: jax.Array,
    free_length: jax.Array,
    support: jax.Array,
    objective: jax.Array,
    saturation_points: jax.Array | float,
    sparseness_power: jax.Array | float,
    free_scale: jax.Array | float,
    support_points: jax.Array | float,
    objective_gate: jax.Array | float,
    objective_softness: jax.Array | float,
) -> jax.Array:
    """The part of the score that the rays and the cluster decide.

    Args:
      num_points: (P,) int32, points of the cluster.
      hit: (P,) float32, fraction of rays.
      free_length: (P,) float32, fraction of the rays' length.
      support: (P,) float32, ground points round the box.
      objective: (P,) float32, J of the box.
      saturation_points: full worth from so many points.
      sparseness_power: below, (points / saturation)^power.
      free_scale: exp(-(free_length / scale)^2).
      support_points: full worth from so many ground points.
      objective_gate: 1 / (1 + exp(-(J - gate) / softness)).
      objective_softness: of the gate.

    Returns:
      (P,) float32 in [0, 1].
    """
    dense = jnp.minimum(num_points.astype(jnp.float32) / saturation_points, 1) ** sparseness_power
    grounded = jnp.minimum((support + 0.5) / support_points, 1)
    gate = jax.nn.sigmoid((objective - objective_gate) / objective_softness)
    return dense * jnp.exp(-((free_length / free_scale) ** 2)) * hit * grounded * gate


def size_score(
    size: jax.Array,
    prior: jax.Array,
    *,
    length_below_m: jax.Array,
    length_above_m: jax.Array,
    width_tolerance_m: jax.Array,
) -> jax.Array:
    """How well the box's length and width match the class.

    Args:
      size: (P, 2) float32, m: length, width.
      prior: (P, 2) float32, m, of the class.
      length_below_m: (P,) float32, m, width of the length's bell below the prior.
      length_above_m: (P,) float32, m, above the prior.
      width_tolerance_m: (P,) float32, m.

    Returns:
      (P,) float32 in [0, 1].
    """
    length = bell(size[:, 0], prior[:, 0], length_below_m, length_above_m)
    return length * bell(size[:, 1], prior[:, 1], width_tolerance_m, width_tolerance_m)


def surroundings_score(
    around: Surroundings,
    rho: jax.Array,
    *,
    height_m: jax.Array,
    height_below_m: jax.Array,
    height_above_m: jax.Array,
    min_height_m: jax.Array,
    max_height_m: jax.Array,
    top_grade: jax.Array | float,
    ring_weight: jax.Array | float,
    overhead_weight: jax.Array | float,
    recess_share: jax.Array | float,
    upright_worth: jax.Array | float,
) -> jax.Array:
    """The part of the score that the points in and round the box decide.

    The true top lies between the top of the points and that plus the beams' spacing; it is held against the
    class at the place in between that suits it best.

    Args:
      around: see `count_points_around`.
      rho: (P,) float32, m, range of the box.
      height_m: (P,) float32, m, the prior.
      height_below_m: (P,) float32, m, width of the height's bell below the prior.
      height_above_m: (P,) float32, m, above the prior.
      min_height_m: (P,) float32, m: lower tops are no such vehicle.
      max_height_m: (P,) float32, m: higher tops are no such vehicle.
      top_grade: how much higher than the points the top may be, m per m of range.
      ring_weight: exp(-weight ring / inside).
      overhead_weight: exp(-weight above / inside).
      recess_share: full worth from this share of the upper points behind the faces on.
      upright_worth: worth where there is none; boxes with few upper points come near to full worth.

    Returns:
      (P,) float32 in [0, 1]; 0 where a gate fails.
    """
    highest = around.top + top_grade * rho
    plausible = (highest > min_height_m) & (around.top < max_height_m)
    top = jnp.clip(height_m, around.top, highest)
    clutter = (ring_weight * around.num_ring + overhead_weight * around.num_above) / jnp.maximum(
        around.num_inside, 1
    )
    score = bell(top, height_m, height_below_m, height_above_m) * jnp.exp(-clutter)
    recessed = (around.num_recessed + DOUBT_POINTS * recess_share) / (around.num_upper + DOUBT_POINTS)
    worth = upright_worth + (1 - upright_worth) * jnp.minimum(recessed / recess_share, 1)
    return jnp.where(plausible, score * worth, 0)


def suppress(boxes: jax.Array, valid: jax.Array, *, max_overlap: jax.Array | float) -> jax.Array:
    """Keeps each box that overlaps no better one that is kept (greedy non-maximum suppression).

    Args:
      boxes: (P, 5) float32: x, y, length, width, yaw; best first.
      valid: (P,) bool, rows that hold a box, all before the others.
      max_overlap: largest bird's-eye view IoU of two boxes that are both kept.

    Returns:
      (P,) bool.

    Reference: oracle `jaxbox.reference.suppress`.
    """
    if on_accelerator():
        return _suppress_at_once(boxes, valid, max_overlap)
    rivals = _overlaps(boxes, count(valid), max_overlap)[: valid.shape[0]]

    def without_rivals(keep: jax.Array) -> jax.Array:
        return valid & ~jnp.any((rivals & keep[None]) != 0, axis=1)

    def step(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        _, keep = state
        return keep, _pack(without_rivals(keep))

    # A box depends on better ones only: after k rounds the first k are right, and where nothing changes all
    # are. A few rounds do: chains of boxes that overlap one after the other are short.
    every = _pack(valid)
    init = jnp.zeros_like(every), every
    return without_rivals(jax.lax.while_loop(lambda s: jnp.any(s[0] != s[1]), step, init)[1])


def _suppress_at_once(boxes: jax.Array, valid: jax.Array, max_overlap: jax.Array | float) -> jax.Array:
    """As `suppress`, all pairs at once, and some rounds before the host looks whether they were enough."""
    row = jnp.arange(valid.shape[0], dtype=jnp.int32)
    iou = jax.vmap(jax.vmap(rectangle_iou, (None, 0)), (0, None))(boxes, boxes)
    rivals = (iou > max_overlap) & (row[None] < row[:, None])

    def step(keep: jax.Array) -> jax.Array:
        return valid & ~jnp.any(rivals & keep[None], axis=1)

    def rounds(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        before_last = functools.reduce(lambda keep, _: step(keep), range(ROUNDS - 1), state[1])
        return before_last, step(before_last)

    return jax.lax.while_loop(lambda s: jnp.any(s[0] != s[1]), rounds, rounds((valid, valid)))[1]


def _overlaps(boxes: jax.Array, num_boxes: jax.Array, max_overlap: jax.Array | float) -> jax.Array:
    """(P, P / 32) uint32: which better boxes each one overlaps, as bits."""
    boxes = jnp.pad(boxes, ((0, -boxes.shape[0] % OVERLAP_TILE), (0, 0)))
    row = jnp.arange(OVERLAP_TILE, dtype=jnp.uint32)

    def tile(i: jax.Array, j: jax.Array, bits: jax.Array) -> jax.Array:
        first, second = (jax.lax.dynamic_slice_in_dim(boxes, k, OVERLAP_TILE) for k in (i, j))
        iou = jax.vmap(jax.vmap(rectangle_iou, (None, 0)), (0, None))(first, second)
        better = j + row[None] < i + row[:, None]
        return jax.lax.dynamic_update_slice(bits, _pack((iou > max_overlap) & better), (i, j // OVERLAP_TILE))

    def tiles(i: jax.Array, bits: jax.Array) -> jax.Array:
        return for_chunks(i + 1, OVERLAP_TILE, functools.partial(tile, i), bits)

    bits = jnp.zeros((boxes.shape[0], boxes.shape[0] // OVERLAP_TILE), jnp.uint32)
    return for_chunks(num_boxes, OVERLAP_TILE, tiles, bits)


def _pack(flags: jax.Array) -> jax.Array:
    """Truth values along the last axis as the bits of words."""
    flags = jnp.pad(flags, [(0, 0)] * (flags.ndim - 1) + [(0, -flags.shape[-1] % WORD_BITS)])
    bits = flags.reshape(*flags.shape[:-1], -1, WORD_BITS)
    values = jnp.uint32(1) << jnp.arange(WORD_BITS, dtype=jnp.uint32)
    return jnp.sum(jnp.where(bits, values, jnp.uint32(0)), axis=-1, dtype=jnp.uint32)
