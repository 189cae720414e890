"""Correction for occluded vehicles: hypotheses for the sides out of sight, and the scene's direction."""

import dataclasses

import numpy as np

from jaxbox.reference.evidence import Evidence, box_evidence

NEUTRAL_OBJECTIVE = np.inf
"""Objective of a box that was not chosen among hypotheses: it passes every gate."""
INSIDE_MARGIN_M = 0.1
"""A fitted point this far outside a hypothesis still counts as inside."""
FACE_OVERHANG_M = 0.3
"""A face speaks for the points up to this beyond its ends."""
NEAR_M = 0.1
"""Fitted points nearer to a visible face than this count as on it."""
MAX_VOTE_POINTS = 150
"""A cluster with more points has no more say about the scene's direction."""
MAX_VOTE_EXTENT_M = 6.0
"""A longer cluster has no more say about the scene's direction."""
KEEP_NEAR, KEEP_FAR, KEEP_CENTRE = 0, 1, 2
"""What stays where it was measured when an extent is completed."""


SEEN_RAMP = 0.05
"""Share of the usual size over which a side goes from partly hidden to seen whole."""


@dataclasses.dataclass(frozen=True)
class Reading:
    """A cluster's rectangle at one rotation."""

    extents: np.ndarray
    """(4,) m: smallest and largest u, smallest and largest v (see `criterion_curve`)."""
    angle: float
    """rad, of the u axis."""
    value: float
    """Criterion of the rectangle, with the preference for the scene's direction."""


@dataclasses.dataclass(frozen=True)
class CompletedBox:
    """A rectangle in the bird's-eye view, its hidden sides completed."""

    box: np.ndarray
    """(5,): x, y, length, width in m and yaw in rad, not wrapped."""
    objective: float
    """J, or `NEUTRAL_OBJECTIVE`."""
    measured_length_m: float
    """Extent of the fitted points along the box."""
    measured_width_m: float
    """Extent of the fitted points across the box."""


def likely_size(
    measured_m: float, usual_m: float, *, margin_m: float, seen: float, seen_weight: float
) -> float:
    """The usual size of a side that may be hidden in part; between it and the measured for the others.

    Args:
      measured_m: extent of the fitted points.
      usual_m: of the class.
      margin_m: measured sides read short by this.
      seen: share of the usual size from which a side may be seen whole.
      seen_weight: what the measured size of such a side weighs.

    Returns:
      m, at least as measured.

    >>> likely_size(1.0, 4.0, margin_m=0.2, seen=0.7, seen_weight=0.5)
    4.0
    >>> likely_size(3.0, 4.0, margin_m=0.2, seen=0.7, seen_weight=0.5)
    3.6
    """
    whole = np.clip((measured_m / usual_m - seen) / SEEN_RAMP, 0, 1)
    return float(max(usual_m + seen_weight * whole * (measured_m + margin_m - usual_m), measured_m))


def complete_extent(low: float, high: float, prior_m: float, keep: int) -> tuple[float, float]:
    """Grows an interval to a length, if it is shorter.

    Args:
      low: m, coordinate along an axis through the sensor.
      high: m.
      prior_m: the length.
      keep: `KEEP_NEAR` or `KEEP_FAR`, the end nearer to or farther from the sensor, or `KEEP_CENTRE`.

    Returns:
      Middle and length, m.

    >>> complete_extent(5.0, 7.0, 4.0, KEEP_NEAR)
    (7.0, 4.0)
    """
    length = max(prior_m, high - low)
    if keep == KEEP_CENTRE:
        return (low + high) / 2, length
    # The nearer end is the lower one where the middle is positive, also for an interval of no length.
    if (keep == KEEP_NEAR) == (low + high > 0):
        return low + length / 2, length
    return high - length / 2, length


def complete_box(
    xy: np.ndarray,
    rectangles: list[Reading],
    *,
    evidence: Evidence | None,
    mode: str,
    length_m: float,
    width_m: float,
    max_length_m: float,
    max_width_m: float,
    num_rays: int,
    free_weight: float,
    free_length_weight: float,
    inside_weight: float,
    near_weight: float,
    closeness_weight: float,
    not_away_cost: float,
    seen_length: float,
    seen_width: float,
    seen_weight: float,
    length_margin_m: float,
    width_margin_m: float,
) -> CompletedBox | None:
    """Completes a rectangle round a cluster to the size of a vehicle class.

    "evidence" tries each axis of each rectangle as the length, extended away from the sensor, with the
    width extended away from it, towards it, or to both sides, and takes the largest objective
    J = hit - free_weight free - free_length_weight free_length + inside_weight inside
    + near_weight near + closeness_weight criterion - (not_away_cost unless the width extends away).
    Boxes are judged at the class's size, and answered at their likely size (see `likely_size`).
    "away" takes the longer extent of the first rectangle as the length and extends both away; "none"
    changes nothing.

    Args:
      xy: (n, 2) m, sensor frame: the fitted points.
      rectangles: of the cluster, at one rotation or more.
      evidence: of the sweep, or None.
      mode: "none", "away" or "evidence".
      length_m: of the class.
      width_m: of the class.
      max_length_m: no such vehicle measures longer.
      max_width_m: no such vehicle measures wider.
      num_rays: rays a hypothesis.
      free_weight: see above.
      free_length_weight: see above.
      inside_weight: see above.
      near_weight: see above.
      closeness_weight: see above.
      not_away_cost: see above.
      seen_length: see `likely_size`.
      seen_width: see there.
      seen_weight: see there.
      length_margin_m: see there.
      width_margin_m: see there.

    Returns:
      The box, or None where the measured extents are too large for the class.
    """
    ways = [way for rectangle in rectangles for way in _ways(rectangle)]
    if mode != "evidence":
        ways = ways[:1] if ways[0].length >= ways[0].width else ways[1:2]
    ways = [way for way in ways if way.length <= max_length_m and way.width <= max_width_m]
    if not ways:
        return None
    if mode == "none":
        return _completed(ways[0], _place(ways[0], 0.0, 0.0, KEEP_NEAR), NEUTRAL_OBJECTIVE)

    def answer(way: _Way, keep: int, objective: float) -> CompletedBox:
        length, width = _likely_sides(
            way,
            length_m=length_m,
            width_m=width_m,
            seen_length=seen_length,
            seen_width=seen_width,
            seen_weight=seen_weight,
            length_margin_m=length_margin_m,
            width_margin_m=width_margin_m,
        )
        return _completed(way, _place(way, length, width, keep), objective)

    if mode == "away":
        return answer(ways[0], KEEP_NEAR, NEUTRAL_OBJECTIVE)
    trials = [(way, keep) for way in ways for keep in (KEEP_NEAR, KEEP_FAR, KEEP_CENTRE)]
    boxes = np.array([_place(way, length_m, width_m, keep) for way, keep in trials])
    rays = box_evidence(boxes, evidence, num_rays=num_rays)
    inside, near = point_agreement(boxes, xy)
    objective = rays.hit - free_weight * rays.free - free_length_weight * rays.free_length
    objective += inside_weight * inside + near_weight * near
    objective += closeness_weight * np.array([way.value for way, _ in trials])
    objective -= not_away_cost * np.array([keep != KEEP_NEAR for _, keep in trials])
    best = int(np.argmax(objective))
    return answer(*trials[best], float(objective[best]))


def count_assignments(rectangles: list[Reading], max_length_m: float, max_width_m: float) -> int:
    """Sides of the rectangles that may be the length of a class; those at one rotation count once.

    Args:
      rectangles: of a cluster.
      max_length_m: no such vehicle measures longer.
      max_width_m: no such vehicle measures wider.

    Returns:
      None to two a rectangle.
    """
    ways = [way for r in {r.angle: r for r in rectangles}.values() for way in _ways(r)]
    return sum(way.length <= max_length_m and way.width <= max_width_m for way in ways)


def boxes_away(
    rectangle: Reading, *, max_length_m: float, max_width_m: float, **sides: float
) -> list[CompletedBox]:
    """The boxes with either side as length, completed away from the sensor.

    Args:
      rectangle: of the cluster.
      max_length_m: no such vehicle measures longer.
      max_width_m: no such vehicle measures wider.
      **sides: length_m, width_m, seen_length, seen_width, seen_weight, length_margin_m and width_margin_m,
        see `complete_box`.

    Returns:
      Those that the class allows: none to two.
    """
    ways = [way for way in _ways(rectangle) if way.length <= max_length_m and way.width <= max_width_m]
    return [
        _completed(way, _place(way, *_likely_sides(way, **sides), KEEP_NEAR), NEUTRAL_OBJECTIVE)
        for way in ways
    ]


@dataclasses.dataclass(frozen=True)
class _Way:
    """A rectangle with one of its axes as the length."""

    along: tuple[float, float]
    across: tuple[float, float]
    yaw: float
    value: float

    @property
    def length(self) -> float:
        return self.along[1] - self.along[0]

    @property
    def width(self) -> float:
        return self.across[1] - self.across[0]


def _ways(rectangle: Reading) -> list[_Way]:
    u0, u1, v0, v1 = rectangle.extents
    # Turning the axes by a quarter turn takes (u, v) to (v, -u).
    return [
        _Way((u0, u1), (v0, v1), rectangle.angle, rectangle.value),
        _Way((v0, v1), (-u1, -u0), rectangle.angle + np.pi / 2, rectangle.value),
    ]


def _likely_sides(
    way: _Way,
    *,
    length_m: float,
    width_m: float,
    seen_length: float,
    seen_width: float,
    seen_weight: float,
    length_margin_m: float,
    width_margin_m: float,
) -> tuple[float, float]:
    return (
        likely_size(
            way.length, length_m, margin_m=length_margin_m, seen=seen_length, seen_weight=seen_weight
        ),
        likely_size(way.width, width_m, margin_m=width_margin_m, seen=seen_width, seen_weight=seen_weight),
    )


def _place(way: _Way, length_m: float, width_m: float, keep_width: int) -> np.ndarray:
    """(5,) box grown to a size."""
    along, length = complete_extent(*way.along, length_m, KEEP_NEAR)
    across, width = complete_extent(*way.across, width_m, keep_width)
    cos, sin = np.cos(way.yaw), np.sin(way.yaw)
    return np.array([cos * along - sin * across, sin * along + cos * across, length, width, way.yaw])


def _completed(way: _Way, box: np.ndarray, objective: float) -> CompletedBox:
    return CompletedBox(box, objective, way.length, way.width)


def point_agreement(boxes: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How well points agree with boxes: share inside, and mean closeness to the visible faces.

    Args:
      boxes: (B, 5): x, y, length, width in m and yaw in rad.
      xy: (n, 2) m, sensor frame, n >= 1.

    Returns:
      (B,) share of the points within the box and its margin, and (B,) mean of
      .1 / max(distance to the nearest visible face, .1); both in [0, 1].
    """
    inside, near = np.zeros(len(boxes)), np.zeros(len(boxes))
    for row, (x, y, length, width, yaw) in enumerate(boxes):
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        local, sensor = (xy - [x, y]) @ turn, np.array([-x, -y]) @ turn
        half = np.array([length, width]) / 2
        inside[row] = np.mean((np.abs(local) < half + INSIDE_MARGIN_M).all(axis=1))
        distance = np.full(len(xy), np.inf)
        for axis in range(2):
            beside = np.abs(local[:, 1 - axis]) < half[1 - axis] + FACE_OVERHANG_M
            if abs(sensor[axis]) > half[axis]:
                face = half[axis] if sensor[axis] > 0 else -half[axis]
                to_face = np.where(beside, np.abs(local[:, axis] - face), np.inf)
                distance = np.minimum(distance, to_face)
        near[row] = np.mean(NEAR_M / np.maximum(distance, NEAR_M))
    return inside, near


def scene_direction(
    yaw: np.ndarray,
    extent_m: np.ndarray,
    num_points: np.ndarray,
    free_length: np.ndarray,
    *,
    num_angles: int,
    sigma_deg: float,
    min_extent_m: float,
    max_free: float,
) -> float | None:
    """The direction modulo 90 degrees that most boxes of the sweep share, by a weighted vote.

    Args:
      yaw: (k,) rad.
      extent_m: (k,) longer measured extent.
      num_points: (k,) members of the cluster.
      free_length: (k,) share of the box seen to be free.
      num_angles: directions that are voted on: i 90 / num_angles degrees.
      sigma_deg: a vote for d weighs exp(-(d / sigma)^2) at distance d.
      min_extent_m: boxes with a shorter extent do not vote.
      max_free: boxes with a larger share do not vote.

    Returns:
      Degrees in [0, 90), or None without voters.
    """
    votes = (extent_m >= min_extent_m) & (free_length <= max_free)
    if not votes.any():
        return None
    weight = np.minimum(num_points[votes], MAX_VOTE_POINTS) * np.minimum(extent_m[votes], MAX_VOTE_EXTENT_M)
    angles = np.arange(num_angles) * 90 / num_angles
    distance = _turn_between_deg(angles[:, None], np.degrees(yaw[votes]))
    return float(angles[np.argmax(np.exp(-((distance / sigma_deg) ** 2)) @ weight)])


def direction_preference(
    direction_deg: float | None, *, num_angles: int, weight: float, sigma_deg: float
) -> np.ndarray:
    """What each rotation of a rectangle gains for lying along the scene's direction.

    Args:
      direction_deg: from `scene_direction`; None gives zeros.
      num_angles: A, rotations over 90 degrees.
      weight: gain on the direction itself.
      sigma_deg: width of the preference.

    Returns:
      (A,) weight exp(-(d / sigma)^2).
    """
    if direction_deg is None:
        return np.zeros(num_angles)
    distance = _turn_between_deg(np.arange(num_angles) * 90 / num_angles, direction_deg)
    return weight * np.exp(-((distance / sigma_deg) ** 2))


def _turn_between_deg(first: np.ndarray, second: np.ndarray | float) -> np.ndarray:
    """Signed turn between axes of rectangles, modulo 90 degrees, in [-45, 45)."""
    return (first - second + 45) % 90 - 45
