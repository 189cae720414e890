"""Sweeps of a drive through traffic, one after the other, with exact truth about who moves how."""

import collections.abc
import dataclasses
import functools
from collections.abc import Iterator
from typing import overload

import numpy as np

from jaxbox.synthetic.raycast import cast
from jaxbox.synthetic.scene import Clutter, Scene, Vehicle
from jaxbox.synthetic.spinning import Packet, Sway, split_turn
from jaxbox.synthetic.sweep import (
    DROPOUT,
    NUM_BEAMS,
    RANGE_NOISE_M,
    Echoes,
    beam_directions,
    check_sensor,
    echoes_of,
    receive,
)
from jaxbox.synthetic.terrain import MAX_RANGE_M, SENSOR_HEIGHT_M
from jaxbox.synthetic.traffic import SETTINGS, Traffic, TrafficKind, draw_traffic
from jaxbox.synthetic.trajectories import Kinematics

START_NS = 1_700_000_000_000_000_000
"""Time of the first sweep, ns since 1970: as large as a recording's, which 64-bit floats do not hold."""
SEQUENCE_AZIMUTHS = 1800
"""0.2 degrees apart, as most sensors' at 10 turns a second."""
MAX_DURATION_S = 300.0
"""Drawing traffic takes memory and time with the square of its length."""
HIDDEN_BELOW = 0.1
"""A vehicle is hidden where less than this share of its beams gets through to it."""


@dataclasses.dataclass(frozen=True)
class TruthTracks:
    """The K vehicles within the sensor's range at one time, by id."""

    ids: np.ndarray
    """(K,) int64, increasing: the same for a vehicle in all sweeps."""
    center: np.ndarray
    """(K, 3) float64, m, sensor frame."""
    size: np.ndarray
    """(K, 3) float64, m: length, width, height; the same in all sweeps."""
    yaw: np.ndarray
    """(K,) float64, rad, in [-pi, pi), sensor frame: heading, the direction of the front from +x about +z."""
    label: np.ndarray
    """(K,) int64: a `jaxbox.Label`."""
    velocity: np.ndarray
    """(K, 2) float64, m/s: over ground, not relative to the ego vehicle, along the sensor's x and y axes."""
    acceleration: np.ndarray
    """(K,) float64, m/s^2: of the speed along the lane."""
    turn_rate: np.ndarray
    """(K,) float64, rad/s: of the heading over ground, about +z."""
    motion: np.ndarray
    """(K,) int64: a `jaxbox.Motion`, see `jaxbox.synthetic.trajectories.Trajectory.motion`."""
    lateral_shift_m: np.ndarray
    """(K,) float64, m: how far a lane change leads in all, positive to the left; 0 for any other motion."""

    def __len__(self) -> int:
        return len(self.ids)


@dataclasses.dataclass(frozen=True)
class _Returns:
    """What a sweep's beams brought back."""

    xyz: np.ndarray
    intensity: np.ndarray
    object_id: np.ndarray
    time_s: np.ndarray
    met: np.ndarray
    seen: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class SequenceSweep:
    """One turn of the sensor; it is cast where its points are first asked for, and kept then."""

    sequence: "SyntheticSequence"
    """The drive that it is part of."""
    index: int
    """Its place there."""

    @property
    def name(self) -> str:
        """Of the sweep, fit for a file: kind, seed and place."""
        return f"{self.sequence.kind}_{self.sequence.seed}_{self.index:06d}"

    @property
    def start_s(self) -> float:
        """Its reference time, when the turn begins: s since the first sweep's."""
        return self.index / self.sequence.rate_hz

    @property
    def timestamp_ns(self) -> int:
        """The same time, ns since 1970."""
        return START_NS + round(self.index * 1e9 / self.sequence.rate_hz)

    @functools.cached_property
    def T_world_sensor(self) -> np.ndarray:
        """(4, 4) float64: pose of the sensor at the reference time."""
        return self.sequence.pose_at(self.start_s)

    @functools.cached_property
    def truth(self) -> TruthTracks:
        """The vehicles at the reference time, in the sensor frame of that time; nothing is cast for it."""
        return self.sequence.truth_at(self.start_s)

    @property
    def xyz(self) -> np.ndarray:
        """(n, 3) float32, m: points, in the sensor frame of the time when each was measured."""
        return self._returns.xyz

    @property
    def intensity(self) -> np.ndarray:
        """(n,) float32, in [0, 1]."""
        return self._returns.intensity

    @property
    def object_id(self) -> np.ndarray:
        """(n,) int64: id of the vehicle that each point is on, or a `Clutter` code."""
        return self._returns.object_id

    @property
    def time_s(self) -> np.ndarray:
        """(n,) float32, s, in [0, 1 / rate): when each was measured after the reference time; 0 with a
        global shutter."""
        return self._returns.time_s

    @property
    def num_points(self) -> np.ndarray:
        """(K,) int64: points on each vehicle of `truth`."""
        on_vehicle = self.object_id[self.object_id >= 0]
        return np.bincount(on_vehicle, minlength=len(self.sequence.traffic.vehicles))[self.truth.ids]

    @property
    def visible(self) -> np.ndarray:
        """(K,) float64, in [0, 1]: of the beams that would meet each vehicle of `truth` in an empty world,
        the share that do; 0 where none would."""
        return (self._returns.seen / np.maximum(self._returns.met, 1))[self.truth.ids]

    @property
    def hidden(self) -> np.ndarray:
        """(K,) bool: beams would meet the vehicle, but less than `HIDDEN_BELOW` of them get through to it."""
        return (self._returns.met[self.truth.ids] > 0) & (self.visible < HIDDEN_BELOW)

    def read_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) and intensity (n,), as `jaxbox.stream` asks for them."""
        return self.xyz, self.intensity

    @functools.cached_property
    def _returns(self) -> _Returns:
        return self.sequence._cast(self.index)


@dataclasses.dataclass(frozen=True, eq=False)
class SyntheticSequence(collections.abc.Sequence[SequenceSweep]):
    """The sweeps of a drive; each is the same whichever are asked for, and in which order."""

    seed: int
    """What everything is drawn from."""
    kind: TrafficKind
    """Where it drives."""
    num_sweeps: int
    """How many there are."""
    rate_hz: float
    """Turns a second."""
    num_beams: int
    """Of the sensor."""
    num_azimuths: int
    """Firings of each beam a turn."""
    rolling_shutter: bool
    """Whether the azimuths of a turn are measured one after the other, instead of simultaneously."""
    range_noise_m: float
    """Standard deviation of a range, m."""
    dropout: float
    """Share of the returns lost at random."""
    traffic: Traffic
    """The ego vehicle, everybody else, and what stands around."""

    def __len__(self) -> int:
        return self.num_sweeps

    @overload
    def __getitem__(self, index: int) -> SequenceSweep: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[SequenceSweep, ...]: ...
    def __getitem__(self, index: int | slice) -> SequenceSweep | tuple[SequenceSweep, ...]:
        wanted = range(self.num_sweeps)[index]
        if isinstance(wanted, int):
            return SequenceSweep(self, wanted)
        return tuple(SequenceSweep(self, i) for i in wanted)

    def __iter__(self) -> Iterator[SequenceSweep]:
        return (SequenceSweep(self, i) for i in range(self.num_sweeps))

    def pose_at(self, time_s: np.ndarray | float) -> np.ndarray:
        """Where the sensor is.

        Args:
          time_s: (...) s since the first sweep's reference time.

        Returns:
          (..., 4, 4) float64: `T_world_sensor`.
        """
        state = self.traffic.ego.trajectory.at(time_s)
        pose = np.zeros((*np.shape(time_s), 4, 4))
        pose[..., :3, :3] = self._sway.rotation(np.asarray(time_s), state.heading)
        pose[..., :2, 3] = state.xy
        pose[..., 3, 3] = 1
        return pose

    def truth_at(self, time_s: float) -> TruthTracks:
        """The vehicles within the sensor's range at any time, in its frame of that time.

        Boxes stand upright in the sensor frame, which pitches and rolls by up to `SWAY_DEG`; their middles
        are exact.

        Args:
          time_s: s since the first sweep's reference time.

        Returns:
          The truth.
        """
        pose = self.pose_at(time_s)
        ids, states = self._in_range(np.array([time_s]))
        movers = [self.traffic.vehicles[i] for i in ids]
        size = np.array([mover.size for mover in movers]).reshape(-1, 3)
        heading = _stacked(states, "heading")
        ahead = np.column_stack([np.cos(heading), np.sin(heading)]) @ pose[:2, :2]
        yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
        center = np.column_stack([_stacked(states, "xy", 2), size[:, 2] / 2 - SENSOR_HEIGHT_M])
        motions = np.array([mover.trajectory.motion(time_s) for mover in movers]).reshape(-1, 2)
        return TruthTracks(
            ids=ids,
            center=(center - pose[:3, 3]) @ pose[:3, :3],
            size=size,
            yaw=np.where(yaw == np.pi, -np.pi, yaw),
            label=np.array([int(mover.label) for mover in movers], np.int64),
            velocity=_stacked(states, "velocity", 2) @ pose[:2, :2],
            acceleration=_stacked(states, "acceleration"),
            turn_rate=_stacked(states, "turn_rate"),
            motion=motions[:, 0].astype(np.int64),
            lateral_shift_m=motions[:, 1],
        )

    def _in_range(self, times_s: np.ndarray) -> tuple[np.ndarray, list[Kinematics]]:
        """(K,) ids of the vehicles in range at the first of (T,) times, and what they do at all of them."""
        states = [mover.trajectory.at(times_s) for mover in self.traffic.vehicles]
        ego = self.traffic.ego.trajectory.at(times_s[0])
        distance = np.array([np.hypot(*(state.xy[0] - ego.xy)) for state in states])
        ids = np.flatnonzero(distance < MAX_RANGE_M)
        return ids, [states[i] for i in ids]

    @functools.cached_property
    def _sway(self) -> Sway:
        return Sway.draw(np.random.default_rng((self.seed, 3)))

    @functools.cached_property
    def _clutter_spheres(self) -> tuple[np.ndarray, np.ndarray]:
        """Middles (C, 2), m, world frame, and radii (C,), m, of what stands around."""
        spheres = [thing.sphere for thing in self.traffic.clutter]
        middles = np.array([middle[:2] for middle, _ in spheres]).reshape(-1, 2)
        return middles, np.array([radius for _, radius in spheres])

    def _cast(self, index: int) -> _Returns:
        """Casts a sweep: packet by packet, each at a scene of its own time."""
        rng = np.random.default_rng((self.seed, 4, index))
        directions = beam_directions(self.num_beams, self.num_azimuths)
        draw = rng.random(len(directions))
        packets = split_turn(self.num_azimuths, rolling_shutter=self.rolling_shutter)
        times = np.array([packet.phase for packet in packets]) / self.rate_hz
        ids, states = self._in_range(index / self.rate_hz + times)
        object_id, time_s = np.zeros(len(directions), np.int64), np.zeros(len(directions), np.float32)
        echoes = Echoes(*(np.zeros(len(directions), kind) for kind in (float, bool, float, float)))
        met, seen = np.zeros((2, len(self.traffic.vehicles)), np.int64)
        rows = np.arange(len(directions)).reshape(self.num_beams, self.num_azimuths)
        for place, packet in enumerate(packets):
            beams = rows[:, packet.columns].ravel()
            pose = self.pose_at(index / self.rate_hz + times[place])
            chosen, scene = self._scene(packet, pose, ids, states, place)
            rays = directions[beams] @ pose[:3, :3].T
            hits = cast(scene, pose[:3, 3], rays, draw[beams])
            part = echoes_of(scene, hits, rays)
            for field in dataclasses.fields(Echoes):
                getattr(echoes, field.name)[beams] = getattr(part, field.name)
            # Codes of clutter are negative, and stay what they are.
            object_id[beams] = np.append(chosen, np.arange(min(Clutter), 0))[hits.object_id]
            time_s[beams] = times[place]
            met[chosen] += hits.met
            seen[chosen] += hits.seen
        returned, xyz, intensity = receive(
            rng, directions, echoes, draw, range_noise_m=self.range_noise_m, dropout=self.dropout
        )
        return _Returns(xyz, intensity, object_id[returned], time_s[returned], met, seen)

    def _scene(
        self, packet: Packet, pose: np.ndarray, ids: np.ndarray, states: list[Kinematics], place: int
    ) -> tuple[np.ndarray, Scene]:
        """Ids of the vehicles that a packet's beams may meet, and a scene of those and the clutter there."""
        movers = [self.traffic.vehicles[i] for i in ids]
        xy = np.array([state.xy[place] for state in states]).reshape(-1, 2)
        radius = np.array([np.linalg.norm(mover.size) / 2 for mover in movers])
        chosen = np.flatnonzero(packet.may_meet(pose, xy, radius))
        vehicles = []
        for i in chosen:
            mover, heading = movers[i], float(states[i].heading[place])
            vehicles.append(Vehicle(mover.label, tuple(xy[i]), heading, mover.size, mover.paint))
        near = np.flatnonzero(packet.may_meet(pose, *self._clutter_spheres))
        clutter = tuple(self.traffic.clutter[i] for i in near)
        return ids[chosen], Scene(self.traffic.terrain, tuple(vehicles), clutter)


def _stacked(states: list[Kinematics], name: str, *columns: int) -> np.ndarray:
    """(K, ...) of K vehicles at the first of their times."""
    return np.array([getattr(state, name)[0] for state in states]).reshape(-1, *columns)


def make_sequence(
    seed: int = 0,
    *,
    kind: TrafficKind = "street",
    num_sweeps: int = 100,
    rate_hz: float = 10.0,
    rolling_shutter: bool = False,
    ego_turns: bool = False,
    num_beams: int = NUM_BEAMS,
    num_azimuths: int = SEQUENCE_AZIMUTHS,
    range_noise_m: float = RANGE_NOISE_M,
    dropout: float = DROPOUT,
) -> SyntheticSequence:
    """A drive through traffic, swept by a spinning sensor, with exact truth about every vehicle.

    The ego vehicle sways a little. Who drives where and when is drawn from the seed, but all of this happens
    in the first 10 s, within 50 m:

    - both kinds: a car changes to the left lane, overtakes the ego vehicle and stays ahead; one behind moves
      to the right; one ahead changes to the right, is hidden behind a van, and changes back to the left;
      oncoming traffic passes;
    - "street" (30 to 40 km/h): cars stand parked; an oncoming car stops, stands and starts again; another
      turns right into a side street;
    - "highway" (100 to 110 km/h): the ego vehicle passes a slower truck.

    These have the ids 0 (overtakes), 1 (van), 2 (hidden), 3 (from behind), and then 4 (stops, or the truck)
    and 5 (turns).

    After that everybody in the ego vehicle's direction keeps their distance, and oncoming traffic and parked
    cars go on. Sequences of up to `MIN_HORIZON_S` of one seed begin in the same way, whatever their length.

    A sweep's reference time, which timestamp, pose and truth are of, is the beginning of its turn. With a
    rolling shutter the turn begins behind the ego vehicle and runs counter-clockwise, in `NUM_PACKETS`
    packets.

    Args:
      seed: not negative; the same seed and options give the same bits.
      kind: "street" or "highway".
      num_sweeps: how many; 100 show all that is named above.
      rate_hz: turns a second.
      rolling_shutter: whether the points of a turn are measured one after the other.
      ego_turns: whether the ego vehicle turns right into a side street, from 9 to 12 s; only on a street.
      num_beams: see `scan`, as the rest.
      num_azimuths: firings a turn.
      range_noise_m: standard deviation along the beam, m.
      dropout: share of returns lost at random.

    Returns:
      Sweeps that are cast when their points are asked for, which takes about a second each.

    Raises:
      ValueError: for an option out of range, or more than `MAX_DURATION_S`.

    >>> sequence = make_sequence(3, num_sweeps=20)
    >>> len(sequence), sequence[-1].name, sequence[-1].start_s
    (20, 'street_3_000019', 1.9)
    >>> bool((sequence[5].truth.ids == sequence[6].truth.ids).all())
    True
    """
    check_sensor(num_beams, num_azimuths, range_noise_m, dropout)
    if kind not in SETTINGS:
        raise ValueError(f"kind is {kind!r}; it must be one of {', '.join(map(repr, SETTINGS))}.")
    if seed < 0 or num_sweeps < 1 or not 0 < rate_hz < np.inf:
        raise ValueError(
            f"seed is {seed}, num_sweeps {num_sweeps} and rate_hz {rate_hz}; the seed must not be negative, "
            "and the others be positive."
        )
    if num_sweeps / rate_hz > MAX_DURATION_S:
        raise ValueError(
            f"{num_sweeps} sweeps at {rate_hz} Hz last {num_sweeps / rate_hz:.0f} s; at most "
            f"{MAX_DURATION_S:.0f} s can be drawn. Take several seeds."
        )
    if ego_turns and kind != "street":
        raise ValueError(f"ego_turns is set and kind is {kind!r}; only a street has side streets.")
    return SyntheticSequence(
        seed=seed,
        kind=kind,
        num_sweeps=num_sweeps,
        rate_hz=rate_hz,
        num_beams=num_beams,
        num_azimuths=num_azimuths,
        rolling_shutter=rolling_shutter,
        range_noise_m=range_noise_m,
        dropout=dropout,
        traffic=draw_traffic(seed, kind, num_sweeps / rate_hz, ego_turns=ego_turns),
    )
