"""What surrounds a box: the points of the whole sweep in it, above it and round it, and the ground below."""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxbox.config import ClassPrior, RegionConfig, VehicleConfig
from jaxbox.stages.state import GroundElevation, NeighbourhoodCounts, Obstacles
from jaxbox.xla import chunks
from jaxbox.xla.indexing import gather, scatter
from jaxbox.xla.loops import map_rows
from jaxbox.xla.rows import sum_after
from jaxbox.xla.runs import count_kinds, fold_runs, maximum_nonnegative
from jaxbox.xla.sorting import sort_by_group

NEARBY_CELL_M = 1.0
"""Points are looked up by cells of this size."""


MAX_CELL_ROWS = 25
"""Rows of cells round a box: a vehicle of 18 m, the longest that passes the gates, with its ring."""


NUM_KINDS = 5
"""Kinds of points that are counted, see `NeighbourhoodCounts`."""


NUM_LEVELS = 20
"""Levels of height in which the points inside are counted, up to the highest that a vehicle's may have."""


LOWEST_LEVEL = 0.4
"""Where the levels begin, as a share of that height: no vehicle's top is lower."""


SIDE_DEPTH_M, SIDE_HALF_M = 0.1, 0.25
"""Points beyond the far end whose depth behind the long side that the sensor sees is the first, give or take
the second, go on along that side: they are of what the box holds a part of."""


END_OVERHANG_M, SIDE_OVERHANG_M = 0.6, 0.3
"""Where points past the ends speak against a vehicle (`ClassPrior.past_ends_m`), those up to here before the
end and the side that the sensor sees are its own: bodies reach beyond the bumpers and sills that a box is
fitted to."""


BEFORE_M, FAR_RAMP_M = 1.0, 15.0
"""Far vehicles stand on the ground so much before them, in full from so much beyond the least range on."""


def count_points_around(
    boxes: jax.Array,
    prior: ClassPrior,
    sure: jax.Array,
    num_boxes: jax.Array,
    obstacles: Obstacles,
    config: VehicleConfig,
    region: RegionConfig,
) -> NeighbourhoodCounts:
    """Counts the points of the whole sweep in and round each box.

    Args:
      boxes: (P, 5) float32: x, y, length, width (m), yaw (rad).
      prior: fields of (P,) float32: points lower than `count_max_height_m` belong to the vehicle, and
        those farther than `recess_m` behind the faces that the sensor sees are recessed; the ring reaches
        `past_ends_m` farther past the ends.
      sure: (P,) float32, in [0, 1]: how sure it is that the box ends where it does. Points beyond a face that
        the sensor does not see are of another thing, and not counted: from the ring's end on where nothing is
        sure, from the margin before the face where all is.
      num_boxes: () int32, rows that hold a box.
      obstacles: all points above the ground.
      config: margin, ring, and what upper points and strays are. A `top_quantile` of 0 makes the highest
        point the top.
      region: that the points lie in.

    Returns:
      The counts; zero for chunks of boxes beyond `num_boxes`.

    Reference: oracle `jaxbox.reference.count_points_around`.
    """
    halves_m, xy, ring_m = (region.half_x_m, region.half_y_m), obstacles.xy, config.ring_m
    shape = [math.ceil(2 * half_m / NEARBY_CELL_M) for half_m in halves_m]

    def cell(position: jax.Array, axis: int) -> jax.Array:
        index = jnp.floor((position + halves_m[axis]) / NEARBY_CELL_M)
        return jnp.clip(index, 0, shape[axis] - 1).astype(jnp.int32)

    cell_of_point = cell(xy[:, 0], 0) * shape[1] + cell(xy[:, 1], 1)
    order, begin, end = sort_by_group(
        lambda i: i, cell_of_point, obstacles.count, shape[0] * shape[1], room=chunks.RUN_ROWS
    )
    points = [gather(values, order) for values in (xy[:, 0], xy[:, 1], obstacles.height)]

    def prepare(rows: tuple[jax.Array, ...]) -> tuple[jax.Array, list[jax.Array], list[jax.Array]]:
        boxes, *others = rows
        frames = _frames(boxes, *others)
        half_l, half_w, ring_half_l = (frames[:, k, None] for k in (4, 5, 6))
        ring_half_w = half_w + jnp.minimum(ring_half_l - half_l, SIDE_OVERHANG_M)
        reach = jnp.abs(frames[:, 2:4]) * (ring_half_l + ring_m)
        reach = reach + jnp.abs(frames[:, 3:1:-1]) * (ring_half_w + ring_m)
        low = [cell(boxes[:, axis] - reach[:, axis], axis) for axis in (0, 1)]
        return frames, low, [cell(boxes[:, axis] + reach[:, axis], axis) for axis in (0, 1)]

    def look(rows: tuple[jax.Array, list[jax.Array], list[jax.Array]]) -> jax.Array:
        frames, low, high = rows
        i = low[0][:, None] + jnp.arange(MAX_CELL_ROWS, dtype=jnp.int32)[None]
        row = jnp.minimum(i, shape[0] - 1) * shape[1]
        first, after = begin[row + low[1][:, None]], end[row + high[1][:, None]]
        length = jnp.where(i <= high[0][:, None], after - first, 0)
        counts, highest, deepest = _count_runs(frames, first, length, points, config)
        inside, above, ring, upper, recessed = counts[:, :NUM_KINDS].T
        top = _top(highest, config.top_quantile * inside, counts[:, NUM_KINDS:], frames[:, -1])
        return jnp.stack([inside, top, above, ring, upper, recessed, deepest], axis=1)

    behind_m = ring_m - (ring_m + config.margin_m) * sure
    columns = boxes, prior.count_max_height_m, prior.recess_m, prior.past_ends_m, behind_m
    rows = map_rows(prepare, columns, num_rows=num_boxes)
    return NeighbourhoodCounts(map_rows(look, rows, num_rows=num_boxes, chunk=chunks.BOXES))


def cluster_alone(num_points: jax.Array, top: jax.Array) -> NeighbourhoodCounts:
    """What surrounds boxes of which only the clusters are looked at: nothing.

    Args:
      num_points: (P,) float32, of the clusters.
      top: (P,) float32, m above the ground, of the clusters.

    Returns:
      The counts.
    """
    none = jnp.zeros_like(top)
    return NeighbourhoodCounts(jnp.stack([num_points, top, none, none, none, none, none], axis=1))


def sensor_from(boxes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where the sensor, at the origin, is in the frames of boxes.

    Args:
      boxes: (P, 5) float32: x, y, length, width (m), yaw (rad).

    Returns:
      (P,) float32 each, m from their centres: along and across.
    """
    x, y, _, _, yaw = boxes.T
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return -(x * cos + y * sin), x * sin - y * cos


def sensor_outside(boxes: jax.Array) -> list[jax.Array]:
    """How far the sensor, at the origin, is outside boxes.

    Args:
      boxes: (P, 5) float32: x, y, length, width (m), yaw (rad).

    Returns:
      (P,) float32 each, m: along and across; 0 where it is beside them.

    Reference: oracle `jaxbox.reference.sensor_outside`.
    """
    half = boxes[:, 2:4].T / 2
    sensor = sensor_from(boxes)
    return [jnp.maximum(jnp.abs(place) - size, 0) for place, size in zip(sensor, half, strict=True)]


def stand_on_ground(
    rectangles: jax.Array, z: jax.Array, ground_elevation: GroundElevation, config: VehicleConfig
) -> tuple[jax.Array, jax.Array]:
    """Where vehicles stand: far ones lower than what is taken for the ground below their middle.

    No ground is seen below them; and a beam that grazes the ground returns from where its lower edge meets
    it, nearer and so higher than its middle says.

    Args:
      rectangles: (P, 5) float32: x, y, length, width (m), yaw (rad).
      z: (P,) float32, m: tells which of several planes a vehicle stands on.
      ground_elevation: asks for the ground under points.
      config: from which range on they stand on the ground before them, where that is lower, and lower by how
        much for each metre more. Without ``neighbourhood`` none does.

    Returns:
      ground: (P,) float32, m: z of the ground below the middle.
      lower: (P,) float32, m, 0 or above.

    Reference: oracle `jaxbox.reference.stand_on_ground`.
    """
    middle = rectangles[:, :2]
    if not config.neighbourhood:
        return ground_elevation(jnp.concatenate([middle, z[:, None]], axis=1)), jnp.zeros_like(z)
    rho, nearest = jnp.linalg.norm(middle, axis=1), jnp.hypot(*sensor_outside(rectangles))
    before = middle * (jnp.maximum(nearest - BEFORE_M, 0) / jnp.maximum(rho, 1e-3))[:, None]
    places = jnp.concatenate([jnp.concatenate([place, z[:, None]], axis=1) for place in (middle, before)])
    ground, ground_before = jnp.split(ground_elevation(places), 2)
    beyond = jnp.maximum(rho - config.far_ground_from_m, 0)
    lower = jnp.maximum(ground - ground_before, 0) * jnp.minimum(beyond / FAR_RAMP_M, 1)
    return ground, lower + config.far_ground_rise * beyond


def _frames(
    boxes: jax.Array,
    count_max_height_m: jax.Array,
    recess_m: jax.Array,
    past_ends_m: jax.Array,
    behind_m: jax.Array,
) -> jax.Array:
    """(P, 15) the frames that points round a box are compared in, see `_judge`."""
    x, y, length, width, yaw = boxes.T
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    half_l, half_w = length / 2, width / 2
    # The sensor sees the faces on its side of the box.
    sensor_u, sensor_v = sensor_from(boxes)
    sides = (sensor_u, half_l), (sensor_v, half_w)
    near = [jnp.where(jnp.abs(sensor) > half, half - recess_m, jnp.inf) for sensor, half in sides]
    far = [jnp.where(jnp.abs(sensor) > half, -half - behind_m, -jnp.inf) for sensor, half in sides]
    facing = jnp.sign(sensor_u), jnp.sign(sensor_v)
    side_v = jnp.where(jnp.abs(sensor_v) > half_w, half_w - SIDE_DEPTH_M, jnp.inf)
    half = half_l, half_w, half_l + past_ends_m
    columns = x, y, cos, sin, *half, *facing, *near, *far, side_v, count_max_height_m
    return jnp.stack(columns, axis=1)


def _count_runs(
    frames: jax.Array,
    first: jax.Array,
    length: jax.Array,
    points: Sequence[jax.Array],
    config: VehicleConfig,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Counts over runs of neighbouring points, some for each box, (C, runs).

    Returns:
      counts: (C, kinds + levels) float32.
      highest: (C,) float32, m.
      deepest: (C,) float32, m.
    """

    def update(
        state: tuple[jax.Array, jax.Array], box: jax.Array, valid: jax.Array, columns: list[jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        counts, greatest = _judge(frames[box], valid, columns, config)
        return scatter("add", state[0], box, counts), scatter("max", state[1], box, greatest)

    num_boxes = first.shape[0]
    none = jnp.zeros((num_boxes, NUM_KINDS + NUM_LEVELS), jnp.int32), jnp.zeros((num_boxes, 2), jnp.float32)
    counts, greatest = fold_runs(update, none, first, length, points)
    return counts.astype(jnp.float32), *greatest.T


def _judge(
    frames: jax.Array, valid: jax.Array, points: Sequence[jax.Array], config: VehicleConfig
) -> tuple[jax.Array, jax.Array]:
    """Counts of each kind and level of points in blocks (B, L) of them; the highest and deepest (B, 2)."""
    columns = [frames[:, k, None] for k in range(frames.shape[1])]
    box_x, box_y, cos, sin, half_l, half_w, ring_half_l, facing_u, facing_v, *faces, max_height = columns
    near_u, near_v, far_u, far_v, side_v = faces
    x, y, height = points
    dx, dy = x - box_x, y - box_y
    u, v = dx * cos + dy * sin, dy * cos - dx * sin
    toward_u, toward_v = facing_u * u, facing_v * v
    is_along = jnp.abs(toward_v - side_v) < SIDE_HALF_M
    is_behind = (toward_v < far_v) | (toward_u < far_u) & ~is_along
    # The depth behind a face is finite where the sensor sees the face.
    end, side = (
        jnp.where((toward > 0) & (near < jnp.inf), jnp.minimum(ring_half_l - half_l, overhang_m), 0)
        for toward, near, overhang_m in (
            (toward_u, near_u, END_OVERHANG_M),
            (toward_v, near_v, SIDE_OVERHANG_M),
        )
    )
    out_u, out_v = jnp.abs(u), jnp.where(valid & ~is_behind, jnp.abs(v) - (half_w + side), jnp.inf)
    inside, low = jnp.maximum(out_u - (half_l + end), out_v) < config.margin_m, height < max_height
    upper = inside & low & (height > config.upper_height_m)
    recessed = upper & (toward_u < near_u) & (toward_v < near_v)
    ring = ~inside & low & (jnp.maximum(out_u - ring_half_l, out_v) < config.ring_m)
    kinds = inside & low, inside & ~low, ring, upper, recessed
    share = height / max_height - LOWEST_LEVEL
    level = jnp.minimum(share * (NUM_LEVELS / (1 - LOWEST_LEVEL)), NUM_LEVELS - 1).astype(jnp.int32)
    level = jnp.where(inside & low & (share > 0), level, NUM_LEVELS)
    counts = count_kinds(kinds, level, NUM_LEVELS)
    within = valid & low & (jnp.maximum(out_u - half_l, jnp.abs(v) - half_w) < config.margin_m)
    depth = jnp.maximum(half_l - toward_u, 0)
    greatest = jnp.where(inside & low, height, 0), jnp.where(within, depth, 0)
    return counts, jnp.stack([maximum_nonnegative(values) for values in greatest], axis=1)


def _top(highest: jax.Array, num_stray: jax.Array, levels: jax.Array, max_height: jax.Array) -> jax.Array:
    """(P,) the height that that many points exceed, evenly spread within their level (P, levels)."""
    higher = sum_after(levels)
    num_stray = num_stray[:, None]
    is_top = (higher <= num_stray) & (num_stray < higher + levels)
    above = jnp.arange(NUM_LEVELS, 0, -1, dtype=jnp.float32)[None] - 1
    above = above + (num_stray - higher) / jnp.maximum(levels, 1)
    share = jnp.sum(jnp.where(is_top, 1 - above * ((1 - LOWEST_LEVEL) / NUM_LEVELS), 0), axis=1)
    return jnp.where(jnp.any(is_top, axis=1), jnp.minimum(share * max_height, highest), highest)
