"""Simulated traffic, as detections of successive sweeps: what the tracker's tests run on."""

import dataclasses
import itertools
from typing import Any

import numpy as np

from jaxbox.tracking import Observations

CAPACITY, NUM_AZIMUTHS, NUM_SWEEPS = 32, 720, 80
FAR_M = 200.0
"""Range of an azimuth cell without a return."""


@dataclasses.dataclass
class Recording:
    """F sweeps with D rows of detections each."""

    seen: Observations
    """(F, D, ...) in NumPy arrays."""
    dt: np.ndarray
    """(F,) float32, s."""
    T_previous_current: np.ndarray
    """(F, 4, 4) float32."""

    def __len__(self):
        return len(self.dt)

    def sweep(self, index) -> tuple[Observations, np.ndarray, np.ndarray]:
        """What a step takes: of one sweep, or of a slice of them."""
        rows = dataclasses.replace(self.seen, **{k: v[index] for k, v in vars(self.seen).items()})
        return rows, self.dt[index], self.T_previous_current[index]


def padded(recording: Recording, num_sweeps=NUM_SWEEPS, capacity=CAPACITY) -> Recording:
    """The same recording, with rows without a detection, and empty sweeps of a standing sensor at its end."""
    more = num_sweeps - len(recording)
    rows = {}
    for name, values in vars(recording.seen).items():
        more_rows = 0 if name == "first_return_m" else capacity - values.shape[1]
        rows[name] = np.pad(values, [(0, more), (0, more_rows), (0, 0)][: values.ndim])
    moved = np.tile(np.eye(4, dtype=np.float32), (more, 1, 1))
    return Recording(
        Observations(**rows),
        np.concatenate([recording.dt, np.full(more, 0.1, np.float32)]),
        np.concatenate([recording.T_previous_current, moved]),
    )


def observations(center, **fields: Any) -> Observations:
    """Observations of (..., D, 3) centres, all else of a usual car that is seen well unless given."""
    center = np.asarray(center, np.float32)
    shape = center.shape[:-1]

    def filled(value, *more, dtype: Any = np.float32):
        return np.broadcast_to(np.asarray(value, dtype), (*shape, *more)).copy()

    usual = {
        "size": filled([4.2, 1.8, 1.5], 3),
        "yaw": filled(0),
        "score": filled(0.8),
        "label": filled(0, dtype=np.int32),
        "num_points": filled(200, dtype=np.int32),
        "extent": filled([4.0, 1.6], 2),
        "front_log_odds": filled(0),
        "valid": filled(True, dtype=bool),
        "first_return_m": np.full((*shape[:-1], NUM_AZIMUTHS), FAR_M, np.float32),
    }
    given = {name: np.asarray(value, usual[name].dtype) for name, value in fields.items()}
    return Observations(center=center.copy(), **(usual | given))


def pose(x=0.0, y=0.0, yaw=0.0, z=0.0):
    """(4, 4) float64 transform."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def drive(start, yaw, speed, turn_rate, times, *, stops=False, lane_m=0.0):
    """(F, 4) x, y, yaw and speed of a car on an arc.

    In the middle of the time it may slow down, stand and start again, or change lanes by some metres.
    """
    speeds = np.full(len(times), speed)
    from_middle = times - times.mean()
    if stops:
        speeds = speed * np.clip(np.abs(from_middle) - 1, 0, 2) / 2
    steps = np.diff(times, prepend=times[0])
    yaws = yaw + np.cumsum(steps * turn_rate * (speeds > 0))
    ways = steps * speeds
    shift = lane_m / 2 * np.tanh(from_middle / 0.6)
    x = start[0] + np.cumsum(ways * np.cos(yaws)) - shift * np.sin(yaw)
    y = start[1] + np.cumsum(ways * np.sin(yaws)) + shift * np.cos(yaw)
    return np.stack([x, y, yaws, speeds], axis=1)


def simulate(seed, num_sweeps=NUM_SWEEPS, dt=0.1, num_cars=14, capacity=CAPACITY) -> Recording:
    """Cars that drive, turn, stop and stand, seen from an ego vehicle that turns, with all that goes wrong.

    Noise, quarter turns of boxes, misses, false alarms, and a wall that hides some of them.
    """
    rng = np.random.default_rng(seed)
    steps = (dt * rng.uniform(0.9, 1.1, num_sweeps)).astype(np.float32)
    times = np.cumsum(steps.astype(float))
    ego = drive((0, 0), 0.3, 8.0, 0.2 * np.sin(times), times)
    poses = [pose(x, y, yaw, 0.02 * i) for i, (x, y, yaw, _) in enumerate(ego)]
    cars = [
        drive(
            rng.uniform(-40, 40, 2),
            rng.uniform(-np.pi, np.pi),
            rng.choice([0.0, 4.0, 12.0]),
            rng.normal(0, 0.2) * (i % 4 != 1),
            times,
            stops=i % 4 == 0,
            lane_m=rng.choice([-3.5, 3.5]) * (i % 4 == 1),
        )
        for i in range(num_cars)
    ]
    sizes = rng.normal([4.2, 1.8, 1.5], [0.4, 0.1, 0.1], (num_cars, 3))
    wall = rng.uniform(-np.pi, np.pi)
    rows = [
        _look(rng, np.linalg.inv(poses[i]), np.array([car[i] for car in cars]), sizes, wall, capacity)
        for i in range(num_sweeps)
    ]
    seen = Observations(
        **{
            field.name: np.stack([getattr(row, field.name) for row in rows])
            for field in dataclasses.fields(Observations)
        }
    )
    moved = [np.eye(4)] + [np.linalg.inv(a) @ b for a, b in itertools.pairwise(poses)]
    return Recording(seen, steps, np.array(moved, np.float32))


def _look(rng, T_sensor_world, cars, sizes, wall, capacity):
    """Detections of one sweep, in any order."""
    num_cars = len(cars)
    xyz = np.concatenate([cars[:, :2], np.zeros((num_cars, 1)), np.ones((num_cars, 1))], axis=1)
    xyz = (T_sensor_world @ xyz.T).T[:, :3]
    turn = np.arctan2(T_sensor_world[1, 0], T_sensor_world[0, 0])
    azimuth, range_m = np.arctan2(xyz[:, 1], xyz[:, 0]), np.linalg.norm(xyz[:, :2], axis=1)
    edges = -np.pi + 2 * np.pi * np.arange(NUM_AZIMUTHS) / NUM_AZIMUTHS
    is_wall = np.abs(np.angle(np.exp(1j * (edges - wall - turn)))) < 0.3
    behind = (np.abs(np.angle(np.exp(1j * (azimuth - wall - turn)))) < 0.3) & (range_m > 12)
    found = (rng.random(num_cars) < 0.9) & ~behind & (range_m < 60)
    num_false = rng.integers(0, 5)
    count = found.sum() + num_false
    assert count <= capacity
    center = np.concatenate([xyz[found], rng.uniform(-50, 50, (num_false, 3))])
    quarter = np.where(rng.random(count) < 0.05, np.pi / 2, 0)
    rows = observations(
        np.zeros((capacity, 3)),
        size=rng.uniform(1, 5, (capacity, 3)),
        yaw=rng.uniform(-9, 9, capacity),
        label=rng.integers(0, 3, capacity),
        num_points=rng.integers(0, 800, capacity),
        score=rng.uniform(0, 0.2, capacity),
        valid=np.zeros(capacity, bool),
        extent=rng.uniform(1, 5, (capacity, 2)),
        # Of a generator of its own.
        front_log_odds=rng.spawn(1)[0].normal(0.5, 1, capacity),
        first_return_m=np.where(is_wall, 10.0, FAR_M),
    )
    of_cars = slice(0, found.sum())
    rows.center[:count] = center + rng.normal(0, 0.1, (count, 3))
    rows.valid[:count] = True
    rows.yaw[of_cars] = cars[found, 2] + turn + rng.normal(0, 0.05, found.sum())
    rows.yaw[:count] += quarter
    rows.size[of_cars] = sizes[found] + rng.normal(0, 0.2, (found.sum(), 3))
    rows.extent[of_cars] = rows.size[of_cars, :2] - rng.uniform(0, 1, (found.sum(), 2))
    rows.score[of_cars] = rng.uniform(0.05, 1, found.sum())
    order = rng.permutation(capacity)
    return dataclasses.replace(
        rows,
        **{name: value[order] for name, value in vars(rows).items() if name != "first_return_m"},
    )
