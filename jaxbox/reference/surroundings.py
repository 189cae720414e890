"""What surrounds a box: the points of the whole sweep in it, above it and round it, and the ground below."""

from collections.abc import Callable

import numpy as np

from jaxbox.config import ClassPrior, Scalar, VehicleConfig
from jaxbox.reference.state import NeighbourhoodCounts, Obstacles

NUM_LEVELS = 20
"""Levels of height by which the top is found."""
SIDE_DEPTHS_M = -0.15, 0.35
"""Points at these depths behind the long side that the sensor sees lie along it."""
OVERHANGS_M = 0.6, 0.3
"""Points so far before the end and the side that the sensor sees are of the vehicle, where those past its
ends speak against it."""
LOWEST_LEVEL = 0.4
"""Where the levels begin, as a share of the highest that points of the vehicle may have."""
BEFORE_M, FAR_RAMP_M = 1.0, 15.0
"""Far vehicles stand on the ground so much before them, in full from so much beyond the least range on."""


def distance_outside(xy: np.ndarray, box: np.ndarray) -> np.ndarray:
    """How far points lie outside a box, along its worse axis; negative inside.

    Args:
      xy: (n, 2) m.
      box: (5,): x, y, length, width in m and yaw in rad.

    Returns:
      (n,) m.
    """
    return np.max(np.abs(in_box_frame(xy, box)) - box[2:4] / 2, axis=1)


def count_points_around(
    box: np.ndarray, prior: ClassPrior, obstacles: Obstacles, config: VehicleConfig, *, sure: float = 0.0
) -> NeighbourhoodCounts:
    """Counts the points of the whole sweep in and round a box.

    Args:
      box: (5,): x, y, length, width in m and yaw in rad.
      prior: points lower than `count_max_height_m` belong to the vehicle, and those farther than `recess_m`
        behind each face that the sensor sees are recessed; the ring reaches `past_ends_m` farther past the
        ends.
      obstacles: all points above the ground.
      config: a point less than the margin outside counts as inside, one farther but less than the ring is in
        the ring; which points are upper ones, and which share of those inside may lie above the top.
      sure: in [0, 1], that the box ends where it does: points behind it are not counted, from the ring's end
        on at 0, from the margin before the hidden face at 1.

    Returns:
      The counts.
    """
    if obstacles.tree is None:
        return cluster_alone(0, 0.0)
    longer = np.array([*box[:2], box[2] + 2 * prior.past_ends_m, *box[3:]])
    reach_m = np.hypot(longer[2], longer[3]) / 2 + 2 * config.ring_m
    near = obstacles.tree.query_ball_point(box[:2], reach_m)
    xy, height = obstacles.xyz[near, :2], obstacles.height[near]
    held = xy[(distance_outside(xy, box) < config.margin_m) & (height < prior.count_max_height_m)]
    counted = ~is_behind(xy, box, config.ring_m - (config.ring_m + config.margin_m) * sure)
    xy, height = xy[counted], height[counted]
    along, across = _outside_body(xy, box, prior).T
    within = np.maximum(along, across) < config.margin_m
    past_ends = np.abs(in_box_frame(xy, box)[:, 0]) - longer[2] / 2
    ring = ~within & (np.maximum(past_ends, across) < config.ring_m)
    counted = height < prior.count_max_height_m
    upper = within & counted & (height > config.upper_height_m)
    top = top_of(height[within & counted], float(prior.count_max_height_m), float(config.top_quantile))
    return NeighbourhoodCounts(
        num_inside=int((within & counted).sum()),
        top=top,
        num_above=int((within & ~counted).sum()),
        num_ring=int((ring & counted).sum()),
        num_upper=int(upper.sum()),
        num_recessed=int((upper & (depth_behind_faces(xy, box) > prior.recess_m)).sum()),
        deepest=float(np.max(depth_behind_end(held, box), initial=0.0)),
    )


def _outside_body(xy: np.ndarray, box: np.ndarray, prior: ClassPrior) -> np.ndarray:
    """(n, 2) m: how far points lie outside, along and across, of a box that overhangs towards the sensor."""
    local, sensor = in_box_frame(xy, box), in_box_frame(np.zeros(2), box)
    seen = (np.abs(sensor) > box[2:4] / 2) & (local * np.sign(sensor) > 0)
    overhangs = seen * np.minimum(float(prior.past_ends_m), OVERHANGS_M)
    return np.abs(local) - (box[2:4] / 2 + overhangs)


def cluster_alone(num_points: int, top: float) -> NeighbourhoodCounts:
    """What surrounds a box of which only the cluster is looked at: nothing.

    Args:
      num_points: of the cluster.
      top: m above the ground, of the cluster.

    Returns:
      The counts.
    """
    return NeighbourhoodCounts(num_inside=num_points, top=top, num_above=0, num_ring=0)


def top_of(height: np.ndarray, max_height_m: float, top_quantile: float) -> float:
    """The height that a share of the points of a vehicle exceed, so that a stray return is not a roof.

    Args:
      height: (n,) m above the ground, below the next.
      max_height_m: highest that they may have; points above 0.4 of it are counted in 20 levels.
      top_quantile: of the points; those of a level count as spread evenly over it.

    Returns:
      m; at most the highest, and that where no point is in a level.
    """
    if len(height) == 0:
        return 0.0
    edges = np.linspace(LOWEST_LEVEL * max_height_m, max_height_m, NUM_LEVELS + 1)
    left = top_quantile * len(height)
    counts, _ = np.histogram(height, edges)
    for count, low, high in zip(counts[::-1], edges[-2::-1], edges[:0:-1], strict=True):
        if count > left:
            return float(min(high - (high - low) * left / count, height.max()))
        left -= count
    return float(height.max())


def is_behind(xy: np.ndarray, box: np.ndarray, behind_m: Scalar) -> np.ndarray:
    """Points beyond the faces that a sensor at the origin does not see, because the box hides them.

    Args:
      xy: (n, 2) m.
      box: (5,): x, y, length, width in m and yaw in rad.
      behind_m: how far beyond.

    Returns:
      (n,) bool; not those beyond the far end that go on along the long side that the sensor sees.

    >>> is_behind(np.array([[12.4, 0.9], [7.6, 0.0]]), np.array([10.0, 0, 4, 2, 0]), 0.1).tolist()
    [True, False]
    """
    length, width = box[2:4]
    local, sensor = in_box_frame(xy, box), in_box_frame(np.zeros(2), box)
    sees = np.abs(sensor) > [length / 2, width / 2]
    toward = local * np.sign(sensor)
    beyond = sees & (toward < [-length / 2 - behind_m, -width / 2 - behind_m])
    depth = width / 2 - toward[:, 1]
    goes_on = sees[1] & (depth > SIDE_DEPTHS_M[0]) & (depth < SIDE_DEPTHS_M[1])
    return beyond[:, 1] | (beyond[:, 0] & ~goes_on)


def depth_behind_faces(xy: np.ndarray, box: np.ndarray) -> np.ndarray:
    """How far points lie behind the nearest face that a sensor at the origin sees; negative in front.

    Args:
      xy: (n, 2) m.
      box: (5,): x, y, length, width in m and yaw in rad.

    Returns:
      (n,) m; infinite where the sensor is inside the box.
    """
    local, sensor = in_box_frame(xy, box), in_box_frame(np.zeros(2), box)
    depth = np.full(len(xy), np.inf)
    for axis, half in enumerate((box[2] / 2, box[3] / 2)):
        if abs(sensor[axis]) > half:
            depth = np.minimum(depth, half - np.sign(sensor[axis]) * local[:, axis])
    return depth


def depth_behind_end(xy: np.ndarray, box: np.ndarray) -> np.ndarray:
    """How far points lie behind the end of a box that is nearer to a sensor at the origin, along the box.

    Args:
      xy: (n, 2) m.
      box: (5,): x, y, length, width in m and yaw in rad.

    Returns:
      (n,) m, negative before that end.

    >>> depth_behind_end(np.array([[9.0, 0.3]]), np.array([10.0, 0, 4, 2, np.pi])).round(6).tolist()
    [1.0]
    """
    facing = np.sign(in_box_frame(np.zeros(2), box)[0])
    return box[2] / 2 - facing * in_box_frame(xy, box)[:, 0]


def sensor_outside(box: np.ndarray) -> np.ndarray:
    """How far a sensor at the origin is outside a box.

    Args:
      box: (5,): x, y, length, width in m and yaw in rad.

    Returns:
      (2,) m: along and across; 0 where it is beside the box.

    >>> sensor_outside(np.array([10.0, 0, 4, 2, 0])).tolist()
    [8.0, 0.0]
    """
    return np.maximum(np.abs(in_box_frame(np.zeros(2), box)) - box[2:4] / 2, 0)


def stand_on_ground(
    box: np.ndarray, z: float, elevation: Callable[[np.ndarray], np.ndarray], config: VehicleConfig
) -> tuple[float, float]:
    """Where a vehicle stands: lower, where it is far, than the ground below its middle.

    Args:
      box: (5,): x, y, length, width in m and yaw in rad.
      z: m: tells which of several planes it stands on.
      elevation: z of the ground, m, under points.
      config: from `far_ground_from_m` on it stands on the ground `BEFORE_M` before it, where that is lower,
        in full `FAR_RAMP_M` farther, and lower by `far_ground_rise` for each metre.

    Returns:
      z of the ground below its middle, and how much lower it stands, m.
    """
    ground = float(elevation(np.array([[*box[:2], z]]))[0])
    if not config.neighbourhood:
        return ground, 0.0
    rho = float(np.hypot(*box[:2]))
    away = max(float(np.hypot(*sensor_outside(box))) - BEFORE_M, 0.0)
    before = float(elevation(np.array([[*(box[:2] * away / max(rho, 1e-3)), z]]))[0])
    beyond = max(rho - float(config.far_ground_from_m), 0.0)
    rise = max(ground - before, 0.0) * min(beyond / FAR_RAMP_M, 1.0)
    return ground, rise + float(config.far_ground_rise) * beyond


def in_box_frame(xy: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Places along and across a box, from its centre.

    Args:
      xy: (..., 2) m.
      box: (5,): x, y, length, width in m and yaw in rad.

    Returns:
      (..., 2) m.
    """
    cos, sin = np.cos(box[4]), np.sin(box[4])
    return (xy - box[:2]) @ np.array([[cos, -sin], [sin, cos]])
