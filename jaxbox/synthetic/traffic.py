"""Traffic round an ego vehicle that drives along a road: who drives how, in two kinds of scenario.

Every vehicle has a trajectory in closed form. Each is drawn until it keeps its distance from all that were
placed before, at all times, so none ever touches another. "Along" is the distance along the road from where
the ego vehicle starts, "across" the distance left of the road's centre line.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Literal

import numpy as np

from jaxbox.synthetic.scene import (
    LABEL_SHARES,
    SPACING_M,
    STREET_ROWS,
    ClutterRow,
    Thing,
    are_apart,
    draw_clutter,
    draw_garden,
    draw_kerbside,
    draw_paint,
    draw_size,
    make_wall,
    rectangle,
)
from jaxbox.synthetic.terrain import Road, Terrain
from jaxbox.synthetic.trajectories import LaneChange, SpeedProfile, Trajectory, Turn
from jaxbox.types import Label

TrafficKind = Literal["street", "highway"]

EGO_SIZE_M = (4.6, 1.85, 1.6)
"""Length, width and height of the vehicle that carries the sensor, over its middle."""
LANE_M = 3.5
"""Width of a lane."""
TIME_STEP_S = 0.05
"""Distances are kept at times this far apart; vehicles of one lane come 2 m closer in it at most."""
MIN_HORIZON_S = 20.0
"""Shorter sequences of a seed have the traffic of one of this length, so that each begins like any other."""
MAX_TRIES = 300
"""Draws of a vehicle of the script until it counts as a fault that there is no room for it."""
BEHIND_M, BEYOND_M = 60.0, 130.0
"""The road is lined from this far behind the ego vehicle's start to this far beyond its end."""
SIDE_STREET_WIDTH_M, SIDE_STREET_M = 9.0, 90.0
"""Width that is left free of clutter, and length of a side street that is lined with it."""
MOUTH_M = 9.0
"""Nobody parks so near the middle of a side street."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """What a kind of road has: lanes as distances across, m, and speeds, m/s."""

    half_width_m: float
    """Centre line to kerb, m."""
    own_lanes: tuple[float, ...]
    """Lanes of the ego vehicle's direction, from the right."""
    ego_lane: int
    """Which of them is the ego vehicle's; the script needs the one to the left of it."""
    oncoming_lanes: tuple[float, ...]
    """Lanes of the other direction, from the centre line."""
    speeds: tuple[float, float]
    """Of the ego vehicle, m/s."""
    oncoming_speeds: tuple[float, float]
    """m/s."""
    oncoming_gaps_m: tuple[float, float]
    """From one oncoming vehicle of a lane to the next."""
    parked_gaps_m: tuple[float, float]
    """From one parked vehicle of a side to the next."""
    clutter: tuple[ClutterRow, ...]
    """What lines it."""


SETTINGS: dict[TrafficKind, Setting] = {
    "street": Setting(
        half_width_m=9.6,
        own_lanes=(-5.25, -1.75),
        ego_lane=0,
        oncoming_lanes=(1.75, 5.25),
        speeds=(8.5, 11.0),
        oncoming_speeds=(7.5, 9.0),
        oncoming_gaps_m=(25.0, 70.0),
        parked_gaps_m=(6.5, 18.0),
        clutter=STREET_ROWS,
    ),
    "highway": Setting(
        half_width_m=16.0,
        own_lanes=(-10.75, -7.25, -3.75),
        ego_lane=1,
        oncoming_lanes=(3.75, 7.25, 10.75),
        speeds=(27.5, 30.5),
        oncoming_speeds=(25.0, 33.0),
        oncoming_gaps_m=(40.0, 120.0),
        parked_gaps_m=(90.0, 250.0),
        clutter=((draw_garden, 4.0, (8.0, 30.0)), (draw_kerbside, 1.0, (15.0, 40.0))),
    ),
}
"""A street of 30 to 40 km/h with two lanes and a parking bay each way, and a highway with three lanes and a
hard shoulder each way, and a barrier between."""


@dataclasses.dataclass(frozen=True)
class Mover:
    """A vehicle and its way."""

    label: Label
    """Its class."""
    size: tuple[float, float, float]
    """m: length, width, height."""
    paint: tuple[float, float, float]
    """Linear RGB in [0, 1]."""
    trajectory: Trajectory
    """World frame."""


@dataclasses.dataclass(frozen=True)
class Traffic:
    """All that a sequence shows; the world frame's origin is the sensor's height above flat ground."""

    terrain: Terrain
    """The road."""
    ego: Mover
    """The vehicle with the sensor over its middle."""
    vehicles: tuple[Mover, ...]
    """All others; the index is their id."""
    clutter: tuple[Thing, ...]
    """What lines the road and the side streets."""


class _Draft:
    """Traffic while it is drawn: what is placed keeps `SPACING_M` from all before it, at all times."""

    def __init__(self, seed: int, kind: TrafficKind, duration_s: float) -> None:
        self.rng = np.random.default_rng((seed, 2))
        self.setting = SETTINGS[kind]
        self.road = Road(
            heading=float(self.rng.uniform(-np.pi, np.pi)),
            center_offset_m=-self.setting.own_lanes[self.setting.ego_lane],
            half_width_m=self.setting.half_width_m,
        )
        self.horizon_s = max(duration_s, MIN_HORIZON_S)
        self.times = np.arange(0.0, self.horizon_s + TIME_STEP_S, TIME_STEP_S)
        self.cruise = self._draw_cruise()
        self.movers: list[Mover] = []
        self.places: list[tuple[np.ndarray, np.ndarray]] = []

    def _draw_cruise(self) -> SpeedProfile:
        """What the ego vehicle drives where nothing stops it: a speed that wanders a little, then stays."""
        speed = self.rng.uniform(*self.setting.speeds)
        speeds = speed + self.rng.uniform(-0.5, 0.5, 3)
        return SpeedProfile((0.0, 3.0, 6.0), tuple(speeds.tolist()))

    def path(
        self, along: float, across: float, *, oncoming: bool = False
    ) -> tuple[tuple[float, float], float]:
        """Start (2,), m, and course, rad, in the world frame of who starts somewhere on the road."""
        x, y = self.road.to_xy(np.array(along), np.array(across))
        return (float(x), float(y)), self.road.heading + (np.pi if oncoming else 0.0)

    def mover(
        self, label: Label, trajectory: Trajectory, size: tuple[float, float, float] | None = None
    ) -> Mover:
        """A vehicle of a class, with a size and a paint of its own."""
        return Mover(label, size or draw_size(self.rng, label), draw_paint(self.rng), trajectory)

    def label(self, *, parked: bool = False) -> Label:
        """The class of somebody that the script has no part for."""
        label = Label(int(self.rng.choice(list(LABEL_SHARES), p=list(LABEL_SHARES.values()))))
        return Label.VAN if parked and label is Label.TRUCK else label

    def place(self, draw: Callable[[], Mover]) -> Mover:
        """Places a vehicle that must be there.

        Raises:
          RuntimeError: where no draw of it finds room.
        """
        for _ in range(MAX_TRIES):
            if self.offer(mover := draw()):
                return mover
        raise RuntimeError("a vehicle of the script found no room; please report the seed.")

    def offer(self, mover: Mover) -> bool:
        """Places a vehicle if there is room for it."""
        state = mover.trajectory.at(self.times)
        reach = math.hypot(*mover.size[:2]) / 2 + SPACING_M
        for other, (xy, heading) in zip(self.movers, self.places, strict=True):
            distance_sq = ((state.xy - xy) ** 2).sum(axis=-1)
            near = np.flatnonzero(distance_sq < (reach + math.hypot(*other.size[:2]) / 2) ** 2)
            if not len(near):
                continue
            mine = rectangle(state.xy[near], *mover.size[:2], state.heading[near])
            theirs = rectangle(xy[near], *other.size[:2], heading[near])
            if not are_apart(mine, theirs).all():
                return False
        self.movers.append(mover)
        self.places.append((state.xy, state.heading))
        return True


@dataclasses.dataclass(frozen=True)
class _SideStreet:
    """A street that meets the road at a right angle."""

    along: float
    """Its middle, m along the road."""
    side: int
    """1 where it leads off to the left, -1 to the right."""
    length_m: float
    """How far it is lined, m from the kerb of the road."""


def draw_traffic(seed: int, kind: TrafficKind, duration_s: float, *, ego_turns: bool) -> Traffic:
    """Draws what happens round the ego vehicle; see `jaxbox.synthetic.make_sequence`.

    Args:
      seed: non-negative.
      kind: "street" or "highway".
      duration_s: how long it must last.
      ego_turns: whether the ego vehicle leaves the street.

    Returns:
      The traffic.
    """
    draft = _Draft(seed, kind, duration_s)
    side_streets = _place_ego(draft, turns=ego_turns)
    _place_overtaking(draft)
    _place_hiding(draft)
    _place_merging(draft)
    if kind == "street":
        _place_stop_and_go(draft)
        side_streets.append(_place_turning(draft))
    else:
        _place_slow_truck(draft)
    _fill_lanes(draft)
    _fill_kerbs(draft, side_streets)
    terrain = Terrain(road=draft.road)
    clutter = _line_roads(draft, terrain, side_streets, barrier=kind == "highway")
    return Traffic(terrain, draft.movers[0], tuple(draft.movers[1:]), clutter)


TURN_RADIUS_M = (6.5, 8.0)
"""Of the middle of a car at a crossing."""
EGO_BRAKES_S, EGO_TURNS_S, EGO_LEAVES_S = 7.0, 9.0, 12.0
"""When an ego vehicle that turns brakes, begins to turn, and drives on."""


def _place_ego(draft: _Draft, *, turns: bool) -> list[_SideStreet]:
    """The ego vehicle, and the side street that it turns right into."""
    across = draft.setting.own_lanes[draft.setting.ego_lane]
    start, course = draft.path(0.0, across)
    speed, turn, streets = draft.cruise, None, []
    if turns:
        times = (*draft.cruise.times_s, EGO_BRAKES_S, EGO_TURNS_S, EGO_LEAVES_S, 14.0)
        cruise = draft.cruise.speeds
        speed = SpeedProfile(times, (*cruise, cruise[-1], 5.0, 5.0, 8.0))
        turn = Turn(float(speed.distance(EGO_TURNS_S)), 7.0, -np.pi / 2)
        length = float(speed.distance(draft.horizon_s)) - turn.after_m + BEYOND_M
        streets = [_SideStreet(turn.after_m + turn.radius_m + LANE_M / 2, -1, length)]
    path = Trajectory(start, course, speed, turn)
    draft.place(lambda: Mover(Label.CAR, EGO_SIZE_M, (0.5, 0.5, 0.5), path))
    return streets


def _place_overtaking(draft: _Draft) -> None:
    """A car behind the ego vehicle changes to the lane on its left, passes it and stays some metres ahead."""
    rng = draft.rng
    across = draft.setting.own_lanes[draft.setting.ego_lane]

    def draw() -> Mover:
        start, course = draft.path(rng.uniform(-17, -14), across)
        change = LaneChange(rng.uniform(0.5, 1.0), rng.uniform(3.0, 3.4), LANE_M)
        faster = rng.uniform(3.9, 4.3)
        speed = draft.cruise.plus((0.0, 3.5, 5.0, 7.5, 10.0), (2.0, 2.0, faster, faster, 0.0))
        return draft.mover(Label.CAR, Trajectory(start, course, speed, lane_changes=(change,)))

    draft.place(draw)


def _place_hiding(draft: _Draft) -> None:
    """A car changes to the right, before a van that hides it from the ego vehicle for 2 to 3 s, and back."""
    rng, setting = draft.rng, draft.setting
    across = setting.own_lanes[setting.ego_lane]
    size = draw_size(rng, Label.VAN)
    along = EGO_SIZE_M[0] / 2 + rng.uniform(8.0, 11.0) + size[0] / 2
    path = Trajectory(*draft.path(along, across), draft.cruise)
    draft.place(lambda: draft.mover(Label.VAN, path, size))

    def draw() -> Mover:
        own = draw_size(rng, Label.CAR)
        ahead = along + size[0] / 2 + rng.uniform(5.0, 7.0) + own[0] / 2
        first = LaneChange(rng.uniform(1.6, 2.2), rng.uniform(2.9, 3.2), -LANE_M)
        returns = first.start_s + first.duration_s + rng.uniform(0.1, 0.4)
        second = LaneChange(returns, rng.uniform(2.9, 3.2), LANE_M)
        changes = (first, second)
        start, course = draft.path(ahead, across + LANE_M)
        return draft.mover(Label.CAR, Trajectory(start, course, draft.cruise, lane_changes=changes), own)

    draft.place(draw)


def _place_merging(draft: _Draft) -> None:
    """A car behind, in the lane to the left, changes to the right and follows the ego vehicle."""
    rng = draft.rng
    across = draft.setting.own_lanes[draft.setting.ego_lane]

    def draw() -> Mover:
        path = draft.path(rng.uniform(-30.0, -25.0), across + LANE_M)
        change = LaneChange(rng.uniform(3.5, 5.0), rng.uniform(3.0, 3.6), -LANE_M)
        return draft.mover(Label.CAR, Trajectory(*path, draft.cruise, lane_changes=(change,)))

    draft.place(draw)


def _place_stop_and_go(draft: _Draft) -> None:
    """An oncoming car of the inner lane brakes, stands where the ego vehicle passes it, and starts again."""
    rng = draft.rng

    def draw() -> Mover:
        speed = rng.uniform(7.0, 8.5)
        brakes = rng.uniform(0.6, 1.2)
        stands = brakes + speed / rng.uniform(2.2, 2.8)
        starts = stands + rng.uniform(1.8, 2.4)
        drives = starts + speed / rng.uniform(1.5, 2.0)
        profile = SpeedProfile((0.0, brakes, stands, starts, drives), (speed, speed, 0.0, 0.0, speed))
        place = float(draft.cruise.distance((stands + starts) / 2)) + rng.uniform(2.0, 8.0)
        along = place + float(profile.distance(stands))
        path = draft.path(along, draft.setting.oncoming_lanes[0], oncoming=True)
        return draft.mover(Label.CAR, Trajectory(*path, profile))

    draft.place(draw)


def _place_turning(draft: _Draft) -> _SideStreet:
    """An oncoming car of the outer lane brakes and turns right into a side street."""
    rng = draft.rng

    def draw() -> Mover:
        turns, slow = rng.uniform(3.0, 4.5), rng.uniform(4.5, 5.5)
        speed = rng.uniform(8.0, 9.5)
        radius = rng.uniform(*TURN_RADIUS_M)
        brakes, leaves = turns - (speed - slow) / 2.0, turns + radius * np.pi / 2 / slow
        times = (0.0, brakes, turns, leaves, leaves + 2.5)
        profile = SpeedProfile(times, (speed, speed, slow, slow, 8.0))
        before = float(profile.distance(turns))
        along = float(draft.cruise.distance(turns)) + rng.uniform(16.0, 26.0) + before
        path = draft.path(along, draft.setting.oncoming_lanes[-1], oncoming=True)
        return draft.mover(Label.CAR, Trajectory(*path, profile, Turn(before, radius, -np.pi / 2)))

    path = draft.place(draw).trajectory
    assert path.turn is not None
    middle = float(draft.road.along(*np.array(path.start))) - path.turn.after_m - path.turn.radius_m
    return _SideStreet(middle - LANE_M / 2, 1, SIDE_STREET_M)


def _place_slow_truck(draft: _Draft) -> None:
    """The ego vehicle passes a truck in the lane on its right."""
    rng, setting = draft.rng, draft.setting

    def draw() -> Mover:
        path = draft.path(rng.uniform(24.0, 34.0), setting.own_lanes[setting.ego_lane - 1])
        speed = draft.cruise.plus((0.0,), (rng.uniform(-3.0, -2.4),))
        return draft.mover(Label.TRUCK, Trajectory(*path, speed))

    draft.place(draw)


AHEAD_M, AFTER_M = (44.0, 80.0), (-50.0, -28.0)
"""Others of the ego vehicle's direction keep these distances from it along the road."""


def _fill_lanes(draft: _Draft) -> None:
    """Others, before and behind the script's vehicles, and oncoming ones, as far as there is room."""
    rng, setting = draft.rng, draft.setting
    for across in setting.own_lanes:
        for reach in (AHEAD_M, AFTER_M):
            path = draft.path(rng.uniform(*reach), across)
            draft.offer(draft.mover(draft.label(), Trajectory(*path, draft.cruise)))
    for across in setting.oncoming_lanes:
        speed = rng.uniform(*setting.oncoming_speeds)
        end = float(draft.cruise.distance(draft.horizon_s)) + speed * draft.horizon_s + BEYOND_M
        along = -rng.uniform(0.0, BEHIND_M)
        while along < end:
            path = draft.path(along, across, oncoming=True)
            draft.offer(draft.mover(draft.label(), Trajectory(*path, SpeedProfile((0.0,), (speed,)))))
            along += rng.uniform(*setting.oncoming_gaps_m)


STANDING = SpeedProfile((0.0,), (0.0,))


def _fill_kerbs(draft: _Draft, side_streets: list[_SideStreet]) -> None:
    """Parked vehicles on both sides, where nobody drives and no side street begins."""
    rng, setting = draft.rng, draft.setting
    end = float(draft.cruise.distance(draft.horizon_s)) + BEYOND_M
    for side in (-1, 1):
        mouths = [street.along for street in side_streets if street.side == side]
        along = -BEHIND_M + rng.uniform(0.0, setting.parked_gaps_m[0])
        while along < end:
            label = draft.label(parked=True)
            size = draw_size(rng, label)
            across = side * (setting.half_width_m - size[1] / 2 - rng.uniform(0.15, 0.4))
            start, course = draft.path(along, across, oncoming=side > 0)
            wobble = np.radians(rng.normal(0.0, 1.0))
            if all(abs(along - mouth) > MOUTH_M for mouth in mouths):
                draft.offer(draft.mover(label, Trajectory(start, course + wobble, STANDING), size))
            along += rng.uniform(*setting.parked_gaps_m)


BARRIER_M, BARRIER_PIECE_M, BARRIER_HEIGHT_M = 0.5, 20.0, 0.9
"""Width, length of a piece, and height of the barrier between the directions of a highway."""


def _line_roads(
    draft: _Draft, terrain: Terrain, side_streets: list[_SideStreet], *, barrier: bool
) -> tuple[Thing, ...]:
    """What stands along the road and the side streets, out of the way of all that drive."""
    road, half = terrain.road, terrain.road.half_width_m
    end = float(draft.cruise.distance(draft.horizon_s)) + BEYOND_M
    reach = (-BEHIND_M, end)
    middle, length = (reach[0] + reach[1]) / 2, reach[1] - reach[0]
    taken = [rectangle(road.to_xy(np.array(middle), np.array(0.0)), length, 2 * half, road.heading)]
    for street in side_streets:
        across = street.side * (half + street.length_m / 2)
        xy = road.to_xy(np.array(street.along), np.array(across))
        taken.append(rectangle(xy, SIDE_STREET_WIDTH_M, street.length_m, road.heading))
    things = draw_clutter(draft.rng, terrain, taken, rows=draft.setting.clutter, reach_m=reach)
    for street in side_streets:
        side_road = _side_road(road, street)
        along = float(side_road.along(*road.to_xy(np.array(street.along), np.array(0.0))))
        lined = (along + half, along + half + street.length_m)
        others = [*taken, *(footprint for _, footprint in things)]
        things += draw_clutter(draft.rng, dataclasses.replace(terrain, road=side_road), others, reach_m=lined)
    pieces = np.arange(*reach, BARRIER_PIECE_M) if barrier else ()
    return (*(thing for thing, _ in things), *(_barrier(draft, terrain, along) for along in pieces))


def _side_road(road: Road, street: _SideStreet) -> Road:
    """The side street as a road that leads away from the main one."""
    heading = road.heading + street.side * np.pi / 2
    # The centre line's offset is the distance across of any of its points, from a line through the origin.
    through = Road(heading=heading, center_offset_m=0.0)
    offset = through.across(*road.to_xy(np.array(street.along), np.array(0.0)))
    return Road(heading=heading, center_offset_m=float(offset), half_width_m=SIDE_STREET_WIDTH_M / 2)


def _barrier(draft: _Draft, terrain: Terrain, along: float) -> Thing:
    xy = terrain.road.to_xy(np.array(along), np.array(0.0))
    footprint = rectangle(xy, BARRIER_PIECE_M, BARRIER_M, terrain.road.heading)
    return make_wall(draft.rng, terrain, footprint, BARRIER_HEIGHT_M)
