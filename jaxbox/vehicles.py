"""Vehicle decision: what surrounds a box, its score, and suppression of overlapping boxes."""

import dataclasses
import math

import jax
import jax.numpy as jnp

from jaxbox.geometry import rectangle_iou
from jaxbox.masked import group_by, map_by_size, map_rows, take

NEARBY_CELL_M = 1.0
"""Points are looked up by cells of this size."""

MAX_CELL_ROWS = 24
"""Rows of cells round a box: a vehicle of 18 m, the longest that passes the gates, with its ring."""

LOOKUP_STEP = 128
"""Points looked at in one go."""

COUNT_BITS = 10
"""Bits that hold a count of up to `LOOKUP_STEP` points."""

DOUBT_POINTS = 5
"""So many upper points, with the share of full worth behind the faces, are taken for granted: of few
points the share says little."""

BOX_CHUNK = 32
"""Boxes looked at together: the loop over their points ends with the one that has most."""

OVERLAP_CHUNK = 32
"""Rows of the overlap matrix at a time."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Surroundings:
    """Points in and round each box."""

    num_inside: jax.Array
    """(P,) float32: points of vehicle height inside, give or take the margin."""
    top: jax.Array
    """(P,) float32, m above the ground: the highest of them; 0 where there are none."""
    num_above: jax.Array
    """(P,) float32: points higher than the vehicle, within the box."""
    num_ring: jax.Array
    """(P,) float32: points of vehicle height just outside."""
    num_upper: jax.Array
    """(P,) float32: those inside that are as high as glass, bonnet and roof."""
    num_recessed: jax.Array
    """(P,) float32: those of them that lie behind the faces which the sensor sees."""


def count_points_around(
    boxes: jax.Array,
    count_max_height_m: jax.Array,
    recess_m: jax.Array,
    num_boxes: jax.Array,
    xy: jax.Array,
    height: jax.Array,
    member: jax.Array,
    *,
    half_x_m: float,
    half_y_m: float,
    max_nearby: int,
    margin_m: jax.Array | float,
    ring_m: jax.Array | float,
    upper_height_m: jax.Array | float,
) -> Surroundings:
    """Counts the points of the whole sweep in and round each box.

    Args:
      boxes: (P, 5) float32: x, y, length, width (m), yaw (rad).
      count_max_height_m: (P,) float32, m: points lower than this belong to the vehicle.
      recess_m: (P,) float32, m: how far behind the faces that the sensor sees a point counts as recessed.
      num_boxes: () int32, rows that hold a box.
      xy: (N, 2) float32, m, all obstacle points.
      height: (N,) float32, m, above the ground.
      member: (N,) bool.
      half_x_m: static, points lie within |x| below it.
      half_y_m: static, points lie within |y| below it.
      max_nearby: static; of more points near a box every so many are looked at, and count so often.
      margin_m: a point this far outside still counts as inside, m.
      ring_m: a point farther out than the margin and nearer than this is in the ring, m.
      upper_height_m: points higher than this are glass, bonnet and roof, m.

    Returns:
      The counts; zero beyond `num_boxes`.

    Reference: oracle `jaxbox.reference.count_points_around`.
    """
    shape = (math.ceil(2 * half_x_m / NEARBY_CELL_M), math.ceil(2 * half_y_m / NEARBY_CELL_M))
    index = jnp.floor((xy + jnp.array([half_x_m, half_y_m])) / NEARBY_CELL_M).astype(jnp.int32)
    index = jnp.clip(index, 0, jnp.array(shape) - 1)
    num_cells = shape[0] * shape[1]
    order, start = group_by(jnp.where(member, index[:, 0] * shape[1] + index[:, 1], num_cells), num_cells)
    points = jnp.concatenate([xy, height[:, None]], axis=1)[order]

    first, length = _cell_runs(boxes, start, shape, half_x_m, half_y_m, ring_m)

    def look(rows: tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]) -> Surroundings:
        return _count_runs(*rows, points, max_nearby, margin_m, ring_m, upper_height_m)

    num_steps = (jnp.minimum(jnp.sum(length, axis=1), max_nearby) + LOOKUP_STEP - 1) // LOOKUP_STEP
    return map_by_size(
        look,
        (boxes, count_max_height_m, recess_m, first, length),
        num_steps,
        max_size=-(-max_nearby // LOOKUP_STEP),
        num_rows=num_boxes,
        chunk=BOX_CHUNK,
    )


def _cell_runs(
    boxes: jax.Array,
    start: jax.Array,
    shape: tuple[int, int],
    half_x_m: float,
    half_y_m: float,
    ring_m: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """The sorted points near each box, as one run for each row of cells: first and length, (C, rows)."""
    cos, sin = jnp.abs(jnp.cos(boxes[:, 4])), jnp.abs(jnp.sin(boxes[:, 4]))
    half_l, half_w = boxes[:, 2] / 2 + ring_m, boxes[:, 3] / 2 + ring_m
    reach_x, reach_y = cos * half_l + sin * half_w, sin * half_l + cos * half_w

    def cell(position: jax.Array, half: float, size: int) -> jax.Array:
        return jnp.clip(jnp.floor((position + half) / NEARBY_CELL_M).astype(jnp.int32), 0, size - 1)

    x, y = boxes[:, 0], boxes[:, 1]
    low_i, high_i = cell(x - reach_x, half_x_m, shape[0]), cell(x + reach_x, half_x_m, shape[0])
    low_j, high_j = cell(y - reach_y, half_y_m, shape[1]), cell(y + reach_y, half_y_m, shape[1])
    i = low_i[:, None] + jnp.arange(MAX_CELL_ROWS)
    row = jnp.minimum(i, shape[0] - 1) * shape[1]
    first = start[row + low_j[:, None]]
    end = start[row + high_j[:, None] + 1]
    return first, jnp.where(i <= high_i[:, None], end - first, 0)


def _count_runs(
    boxes: jax.Array,
    count_max_height_m: jax.Array,
    recess_m: jax.Array,
    first: jax.Array,
    length: jax.Array,
    points: jax.Array,
    max_nearby: int,
    margin_m: jax.Array | float,
    ring_m: jax.Array | float,
    upper_height_m: jax.Array | float,
) -> Surroundings:
    """Counts over the runs of points, every `stride`-th where they are too many."""
    end = jnp.cumsum(length, axis=1)
    total = end[:, -1]
    stride = jnp.maximum((total + max_nearby - 1) // max_nearby, 1)
    num_looks = (total + stride - 1) // stride
    cos, sin = jnp.cos(boxes[:, 4])[:, None], jnp.sin(boxes[:, 4])[:, None]
    half_l, half_w = boxes[:, 2:3] / 2, boxes[:, 3:4] / 2
    # The sensor at the origin, in the box's frame: it sees the faces on its side of the box.
    sensor_u = -(boxes[:, :1] * cos + boxes[:, 1:2] * sin)
    sensor_v = boxes[:, :1] * sin - boxes[:, 1:2] * cos
    face_u = jnp.where(jnp.abs(sensor_u) > half_l, half_l, jnp.inf)
    face_v = jnp.where(jnp.abs(sensor_v) > half_w, half_w, jnp.inf)

    def step(k: jax.Array, state: Surroundings) -> Surroundings:
        place = (k * LOOKUP_STEP + jnp.arange(LOOKUP_STEP)) * stride[:, None]
        run = jnp.minimum(jnp.sum(place[:, :, None] >= end[:, None, :], axis=2), MAX_CELL_ROWS - 1)
        base = jnp.take_along_axis(first - (end - length), run, axis=1)
        p = take(points, base + place)
        dx, dy = p[..., 0] - boxes[:, :1], p[..., 1] - boxes[:, 1:2]
        u, v = dx * cos + dy * sin, dy * cos - dx * sin
        out_u, out_v = jnp.abs(u) - half_l, jnp.abs(v) - half_w
        out = jnp.where(place < total[:, None], jnp.maximum(out_u, out_v), jnp.inf)
        low = p[..., 2] < count_max_height_m[:, None]
        inside = out < margin_m
        # A point is of one kind at most, so that one sum counts all three: each has its own bits.
        kind = jnp.where(inside, jnp.where(low, 1, 1 << COUNT_BITS), 0)
        kind = jnp.where(~inside & (out < ring_m) & low, 1 << 2 * COUNT_BITS, kind)
        counts = jnp.sum(kind, axis=1)
        top = jnp.max(jnp.where(inside & low, p[..., 2], 0), axis=1)
        upper = inside & low & (p[..., 2] > upper_height_m)
        depth = jnp.minimum(face_u - jnp.sign(sensor_u) * u, face_v - jnp.sign(sensor_v) * v)
        recessed = jnp.where(upper & (depth > recess_m[:, None]), 1 << COUNT_BITS, 0)
        high_counts = jnp.sum(upper + recessed, axis=1)

        def add(packed: jax.Array, place: int) -> jax.Array:
            return stride * ((packed >> place * COUNT_BITS) & (2**COUNT_BITS - 1)).astype(jnp.float32)

        return Surroundings(
            num_inside=state.num_inside + add(counts, 0),
            top=jnp.maximum(state.top, top),
            num_above=state.num_above + add(counts, 1),
            num_ring=state.num_ring + add(counts, 2),
            num_upper=state.num_upper + add(high_counts, 0),
            num_recessed=state.num_recessed + add(high_counts, 1),
        )

    zero = jnp.zeros(boxes.shape[0])
    steps = (jnp.max(num_looks) + LOOKUP_STEP - 1) // LOOKUP_STEP
    return jax.lax.fori_loop(0, steps, step, Surroundings(*[zero] * len(dataclasses.fields(Surroundings))))


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
    dense = jnp.minimum(num_points / saturation_points, 1) ** sparseness_power
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

    The true top lies between the highest return and that plus the beams' spacing; it is held against the
    class at the place in between that suits it best.

    Args:
      around: see `count_points_around`.
      rho: (P,) float32, m, range of the box.
      height_m: (P,) float32, m, the prior.
      height_below_m: (P,) float32, m, width of the height's bell below the prior.
      height_above_m: (P,) float32, m, above the prior.
      min_height_m: (P,) float32, m: lower tops are no such vehicle.
      max_height_m: (P,) float32, m: higher tops are no such vehicle.
      top_grade: how much higher than the highest return the top may be, m per m of range.
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
    num_boxes = jnp.sum(valid)

    def overlaps(rows: jax.Array) -> jax.Array:
        return jax.vmap(jax.vmap(rectangle_iou, (None, 0)), (0, None))(rows, boxes) > max_overlap

    overlap = map_rows(overlaps, boxes, num_rows=num_boxes, chunk=OVERLAP_CHUNK)

    def step(i: jax.Array, keep: jax.Array) -> jax.Array:
        # Rows after i are not kept yet, so only better boxes can stand in the way.
        return keep.at[i].set(~jnp.any(overlap[i] & keep))

    return jax.lax.fori_loop(0, num_boxes, step, jnp.zeros_like(valid)) & valid
