"""Input that nobody would wish for, and what has to hold of the answer to any of it.

`CASES` is the one list: `tests/test_bad_input.py` runs it, and `bad_input_table` writes the documentation's
table from it. `REFUSED` is what never reaches the compiled function, with the error that says so.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxbox import DEFAULT_SCORE_THRESHOLD, Detections, DetectorConfig, Label, PointCloud, Status, synthetic
from jaxbox.evaluation import count_points_in_boxes

CAPACITY = 2**14
"""The smallest bucket, unless a case names another."""

PRESETS = ("default", "paper")
"""Each input is given to both."""

MILLION = 1_000_000

FAINT_SUPPORT, LEAST_CLAIM = 0.5, 0.001
"""A box worth acting on holds as many points of the input as a cluster needs. One that scores less may hold
this share of them: the evidence may shift a box so that it leaves some of its cluster's points outside. And
one that scores less than the second claims nothing: its middle may lie so far behind its points that the
ground there is another."""

Points = tuple[Any, Any]
"""What a caller hands to `PointCloud.from_numpy`: points, and intensities or None."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One bad input, and the status that each preset has to answer with."""

    name: str
    make: Callable[[], Points]
    status: Mapping[str, Status]
    same_as: str = ""
    """Of another case whose boxes this one must have, bit for bit."""
    best_score: float = 1.0
    """No box may score more: 0 where there can be none at all, the cut where there is no vehicle."""
    capacity: int = CAPACITY
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Settings that differ from the preset's, as where a capacity is to be met."""

    @property
    def compiles_anew(self) -> bool:
        """Whether the case needs programs of its own."""
        return bool(self.changes) or self.capacity != CAPACITY


@functools.cache
def street(seed: int = 0) -> np.ndarray:
    """About 15,500 points round the sensor, and twelve vehicles."""
    return synthetic.make_sweep(seed, num_beams=32, num_azimuths=520).xyz


# The laws.


def box_support(detections: Detections, xyz: np.ndarray, config: DetectorConfig) -> np.ndarray:
    """How many points of the input each valid box holds, counted apart from the detector.

    Boxes are widened by the margin of the detector, and up and down by the spacing of the beams, by which a
    top is known no better.

    Args:
      detections: of one sweep, on the host.
      xyz: (n, 3) m, the input itself.
      config: the settings.

    Returns:
      (K,) int64, of the valid boxes.
    """
    center, size, yaw = (
        np.asarray(of_all, np.float64)[detections.valid]
        for of_all in (detections.center, detections.size, detections.yaw)
    )
    margin_m = np.full_like(size, config.vehicles.margin_m)
    margin_m[:, 2] += float(config.vehicles.top_grade) * np.hypot(center[:, 0], center[:, 1])
    return count_points_in_boxes(xyz, center, size + 2 * margin_m, yaw)


def broken_laws(detections: Detections, xyz: np.ndarray, capacity: int, config: DetectorConfig) -> list[str]:
    """What does not hold of an answer though it must, whatever the input.

    Args:
      detections: of one sweep, on the host.
      xyz: (n, 3) m, the input itself.
      capacity: that it was padded to.
      config: the settings.

    Returns:
      A sentence each; none where all is well.
    """
    laws = {
        **_box_laws(detections, xyz, config),
        **_point_laws(detections, len(xyz), capacity),
        "every number is finite": all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(detections)),
    }
    return [law for law, holds in laws.items() if not holds]


def _box_laws(d: Detections, xyz: np.ndarray, config: DetectorConfig) -> dict[str, Any]:
    valid = np.asarray(d.valid)
    score = np.asarray(d.score)[valid]
    share = np.where(score >= DEFAULT_SCORE_THRESHOLD, 1, np.where(score >= LEAST_CLAIM, FAINT_SUPPORT, 0))
    support = box_support(d, xyz, config) / config.clustering.min_points
    rows = (d.center, d.size, d.yaw, d.score, d.label, d.num_points, d.hulls.num_vertices)
    return {
        "every box is supported by points of the input": bool((support >= share).all()),
        "the boxes are as many as were found and fit": valid.sum()
        == min(int(d.counts.detections), len(valid)),
        "the boxes come first": not valid[valid.sum() :].any(),
        "the best score comes first": bool((np.diff(d.score) <= 0).all()),
        "scores are in (0, 1]": bool(((d.score[valid] > 0) & (d.score[valid] <= 1)).all()),
        "sizes are positive": bool((d.size[valid] > 0).all()),
        "no box is wider than long": bool((d.size[:, 0] >= d.size[:, 1]).all()),
        "yaw is in [-pi/2, pi/2)": bool(((d.yaw >= -np.pi / 2) & (d.yaw < np.pi / 2)).all()),
        "labels are known": set(np.asarray(d.label)[valid].tolist()) <= set(Label),
        "a row without a box is zero": not any(np.asarray(row)[~valid].any() for row in rows),
    }


def _point_laws(d: Detections, num_points: int, capacity: int) -> dict[str, Any]:
    tables = (d.point_detection, d.point_component, d.ground_mask)
    owned = np.bincount(np.asarray(d.point_detection) + 1, minlength=len(d.valid) + 1)[1:]
    return {
        "every point of the input is in exactly one place": d.counts.num_points == num_points,
        "points beyond the capacity are counted": d.counts.dropped_points == max(num_points - capacity, 0),
        "there is an answer for every row": all(table.shape == (capacity,) for table in tables),
        "the mask of the ground has the count of the ground": d.ground_mask.sum() == d.counts.ground_points,
        "no point of the ground is in a component": not (d.ground_mask & (d.point_component >= 0)).any(),
        "a box has the points that name it": bool((owned == d.num_points).all()),
    }


# What the inputs are made of.


def _fixed(array: Any, intensity: Any = None) -> Callable[[], Points]:
    return lambda: (array, intensity)


def _uniform(low: Sequence[float], high: Sequence[float], count: int, seed: int = 7) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def _with_rows(rows: Sequence[Sequence[float]], count: int) -> np.ndarray:
    """The street with bad points between its own."""
    rng = np.random.default_rng(0)
    bad = np.asarray(rows, np.float32)[rng.integers(0, len(rows), count)]
    return np.insert(street(), np.sort(rng.integers(0, len(street()), count)), bad, axis=0)


def _ground(count: int, half_m: float = 40.0) -> np.ndarray:
    return _uniform([-half_m, -half_m, -1.7], [half_m, half_m, -1.7], count)


def _places(count: int, step_m: float) -> np.ndarray:
    """(count, 2) places on a lattice over the region, those nearest to the sensor, but for its own."""
    x, y = np.arange(-79, 79, step_m) + step_m / 2, np.arange(-59, 59, step_m) + step_m / 2
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    distance = np.linalg.norm(places, axis=1)
    return places[np.argsort(np.where(distance < 5, np.inf, distance), kind="stable")[:count]]


def _rails(count: int, points: int, top_m: float, step_m: float) -> np.ndarray:
    """Rails that rise from the ground over a metre, that many points each."""
    height = np.linspace(0.3, top_m, points) - 1.7
    xy = np.repeat(_places(count, step_m), points, axis=0)
    xy[:, 0] += np.tile(np.linspace(0, 1.05, points), count)
    return np.column_stack([xy, np.tile(height, count)])


def _disc(count: int) -> np.ndarray:
    """A round thing: every point is a corner of its hull."""
    angle = np.arange(count) * (2 * np.pi / count)
    height = np.random.default_rng(0).uniform(0.25, 1.4, count) - 1.7
    return np.column_stack([8 + 1.6 * np.cos(angle), 3 + 1.6 * np.sin(angle), height])


def _million() -> Points:
    """A street so often over, each time a little next to itself."""
    xyz = np.resize(street(), (MILLION, 3))
    return xyz + np.random.default_rng(0).normal(0, 0.02, xyz.shape).astype(np.float32), None


def _turned_over() -> Points:
    return street() * np.array([1, -1, -1], np.float32), None


def _tilted() -> Points:
    xyz = _uniform([-40, -40, 0], [40, 40, 0], 5000)
    return xyz + np.outer(xyz[:, 0], [0, 0, np.tan(np.radians(20))]) - [0, 0, 1.7], None


def _mixed() -> Points:
    rng = np.random.default_rng(7)
    return np.where(rng.random((9000, 3)) < 0.1, rng.choice([np.nan, np.inf, 1e30], (9000, 3)), 5.0), None


def _read_only() -> Points:
    xyz = street().copy()
    xyz.setflags(write=False)
    return xyz, None


OK = Status.OK
LOST = Status.NO_GROUND
EMPTY = Status.EMPTY | Status.NO_GROUND
NONFINITE = Status.NONFINITE_POINTS
ABOVE = Status.GROUND_ABOVE
DEGRADED = Status.DEGRADED
DOUBTFUL = Status.DOUBTFUL_GROUND


def _both(status: Status) -> dict[str, Status]:
    return dict.fromkeys(PRESETS, status)


def _each(default: Status, paper: Status) -> dict[str, Status]:
    return {"default": default, "paper": paper}


STREET = Case("a street, for comparison", lambda: (street(), None), _both(OK))

VALUES = (
    Case("NaN alone", _fixed(np.full((500, 3), np.nan)), _both(EMPTY | NONFINITE), best_score=0),
    Case("-Inf alone", _fixed(np.full((500, 3), -np.inf)), _both(EMPTY | NONFINITE), best_score=0),
    Case(
        "300 points of NaN or Inf in a street",
        lambda: (_with_rows([[np.nan, 1, 1], [1, np.inf, 1], [1, 1, -np.inf], [np.nan] * 3], 300), None),
        _both(NONFINITE),
    ),
    Case("1e30", _fixed(_uniform([-1e30] * 3, [1e30] * 3, 500)), _both(EMPTY), best_score=0),
    Case(
        "300 points of 1e30 in a street",
        lambda: (_with_rows([[1e30, 1, 1], [1, -1e30, 1], [1, 1, 1e30]], 300), None),
        _both(OK),
    ),
    Case(
        "the largest float32", _fixed(np.full((500, 3), np.finfo(np.float32).max)), _both(EMPTY), best_score=0
    ),
    Case("1e300, beyond float32", _fixed(np.full((500, 3), 1e300)), _both(EMPTY | NONFINITE), best_score=0),
    Case("1e-30", _fixed(_uniform([-1e-30] * 3, [1e-30] * 3, 500)), _both(LOST), best_score=0),
    Case("NaN, Inf, 1e30 and one place, mixed", _mixed, _both(LOST | NONFINITE), best_score=0),
    Case("beyond the region", _fixed(_uniform([90] * 3, [99] * 3, 500)), _both(EMPTY), best_score=0),
    Case("intensity zero", lambda: (street(), np.zeros(len(street()))), _both(OK), same_as=STREET.name),
    Case("intensity NaN", lambda: (street(), np.full(len(street()), np.nan)), _both(OK), same_as=STREET.name),
)

WORLDS = (
    Case("empty", _fixed(np.zeros((0, 3))), _both(EMPTY), best_score=0),
    Case("one point", _fixed(np.array([[8.0, 2, -1]])), _both(LOST), best_score=0),
    Case("two points", _fixed(np.array([[8.0, 2, -1], [8.2, 2, -1]])), _both(LOST), best_score=0),
    Case(
        "three points",
        _fixed(np.array([[8.0, 2, -1], [8.2, 2, -1], [8, 2.1, -0.9]])),
        _both(LOST),
        best_score=0,
    ),
    Case("one point 500 times", _fixed(np.tile([9.0, 3, -1], (500, 1))), _both(LOST), best_score=0),
    Case("all at the sensor", _fixed(np.zeros((500, 3))), _both(LOST), best_score=0),
    Case("each point twice", lambda: (np.repeat(street()[::2], 2, axis=0), None), _both(OK)),
    Case(
        "collinear, level",
        _fixed(np.linspace([-50, -20, -1.7], [50, 20, -1.7], 5000)),
        _both(DOUBTFUL),
        best_score=0,
    ),
    Case("collinear, upright", _fixed(np.linspace([9, 3, -2], [9, 3, 2], 500)), _both(LOST), best_score=0),
    Case(
        "coplanar, level", _fixed(_uniform([-50, -50, -1.7], [50, 50, -1.7], 5000)), _both(OK), best_score=0
    ),
    Case(
        "coplanar, upright",
        _fixed(_uniform([9, -20, -2], [9, 20, 6], 5000)),
        _both(LOST),
        best_score=DEFAULT_SCORE_THRESHOLD,
    ),
    Case("coplanar, at 20 degrees", _tilted, _both(LOST), best_score=DEFAULT_SCORE_THRESHOLD),
    Case("all ground", lambda: (synthetic.ground_only_sweep().xyz[::8], None), _both(OK), best_score=0),
    Case("no ground", lambda: (synthetic.no_ground_sweep().xyz[::8], None), _each(DEGRADED | DOUBTFUL, OK)),
    Case(
        "one wall",
        lambda: (synthetic.one_wall_sweep().xyz[::4], None),
        _each(DEGRADED, LOST),
        best_score=DEFAULT_SCORE_THRESHOLD,
    ),
    Case("sensor upside down", _turned_over, _both(ABOVE), best_score=DEFAULT_SCORE_THRESHOLD),
    Case(
        "sensor on its side",
        lambda: (street()[:, [0, 2, 1]], None),
        _each(DOUBTFUL, LOST),
        best_score=DEFAULT_SCORE_THRESHOLD,
    ),
    Case(
        "one beam",
        lambda: (street()[np.abs(street()[:, 2] + 0.9) < 0.05], None),
        _both(DEGRADED),
        best_score=DEFAULT_SCORE_THRESHOLD,
    ),
    Case(
        "rounded to 1 m",
        lambda: (np.round(street()), None),
        _both(OK),
        best_score=DEFAULT_SCORE_THRESHOLD,
    ),
    Case(
        "noise", _fixed(_uniform([-70] * 3, [70] * 3, 16000)), _both(LOST), best_score=DEFAULT_SCORE_THRESHOLD
    ),
    Case(
        "dense noise",
        _fixed(_uniform([-15, -15, -2], [15, 15, 2], 16000)),
        _each(Status.OBSTACLE_OVERFLOW | DEGRADED, DEGRADED),
        best_score=DEFAULT_SCORE_THRESHOLD,
    ),
)


def _stored(change: Callable[[np.ndarray], Any]) -> Callable[[], Points]:
    return lambda: (change(street()), None)


STORAGE = tuple(
    Case(name, make, _both(OK), same_as=STREET.name)
    for name, make in {
        "float64": _stored(lambda xyz: xyz.astype(np.float64)),
        "big-endian float32": _stored(lambda xyz: xyz.astype(">f4")),
        "big-endian float64": _stored(lambda xyz: xyz.astype(">f8")),
        "column-major": _stored(np.asfortranarray),
        "every second row of an array": _stored(lambda xyz: np.repeat(xyz, 2, axis=0)[::2]),
        "three columns of a wider array": _stored(
            lambda xyz: np.column_stack([xyz, np.ones(len(xyz))])[:, :3]
        ),
        "negative strides": _stored(lambda xyz: xyz[::-1].copy()[::-1]),
        "read-only": _read_only,
        "list of lists": _stored(np.ndarray.tolist),
        "JAX array": _stored(jax.numpy.asarray),
    }.items()
)

SMALL_ANSWER = {"hull.max_vertices": 4, "vehicles.max_candidates": 4, "vehicles.max_detections": 1}
"""Capacities that no sweep of so few points would fill are met by small ones."""

TOO_MANY = (
    Case(
        "more points than capacity",
        lambda: (np.concatenate([street(), street(1) + np.array([0, 0, 0.001], np.float32)]), None),
        _both(Status.POINT_OVERFLOW),
    ),
    Case(
        "1,000,000 points for 16,384",
        _million,
        _each(
            Status.POINT_OVERFLOW | Status.OBSTACLE_OVERFLOW | DEGRADED,
            Status.POINT_OVERFLOW | Status.OBSTACLE_OVERFLOW | LOST,
        ),
    ),
    Case("1,000,000 points", _million, _both(OK), capacity=2**20),
    Case(
        "more obstacles",
        lambda: (np.concatenate([_ground(3500), _uniform([-30, -30, -1.4], [30, 30, 1], 12884)]), None),
        _each(Status.OBSTACLE_OVERFLOW | Status.CELL_OVERFLOW, Status.OBSTACLE_OVERFLOW),
    ),
    Case(
        "more cells",
        lambda: (np.concatenate([_ground(6000), _rails(8000, 1, 0.6, 1.1)]), None),
        _each(Status.CELL_OVERFLOW, OK),
    ),
    Case(
        "more clusters",
        lambda: (np.concatenate([_ground(8000), _rails(560, 9, 1.1, 2.4)]), None),
        _both(Status.CLUSTER_OVERFLOW),
    ),
    Case(
        "more clusters that are high",
        lambda: (np.concatenate([_ground(8000), _rails(400, 20, 2.5, 2.4)]), None),
        _each(Status.CLUSTER_OVERFLOW, OK),
    ),
    Case(
        "more corners of a hull",
        lambda: (np.concatenate([_ground(6000), _disc(600)]), None),
        _each(DOUBTFUL, Status.HULL_OVERFLOW | DOUBTFUL),
    ),
    Case(
        "more candidates, detections and corners",
        lambda: (street(), None),
        _both(Status.CANDIDATE_OVERFLOW | Status.DETECTION_OVERFLOW | Status.HULL_OVERFLOW),
        changes=SMALL_ANSWER,
    ),
)

GROUPS: dict[str, tuple[Case, ...]] = {
    "values": (STREET, *VALUES),
    "worlds": WORLDS,
    "storage": STORAGE,
    "too many": TOO_MANY,
}
CASES: tuple[Case, ...] = tuple(case for group in GROUPS.values() for case in group)


def pad(case: Case) -> tuple[np.ndarray, PointCloud]:
    """The points of a case as (n, 3) float32, and the cloud that its caller gets."""
    xyz, intensity = case.make()
    with np.errstate(over="ignore"):
        plain = np.asarray(xyz).astype(np.float32)
    return plain, PointCloud.from_numpy(xyz, intensity, capacity=case.capacity)


_POINTS = np.zeros((5, 3))
REFUSED: dict[str, tuple[tuple[Any, ...], dict[str, Any], str]] = {
    "four columns": ((np.zeros((5, 4)),), {}, r"\(5, 4\).*\(n, 3\).*points\[:, :3\]"),
    "one row": ((np.zeros(3),), {}, r"\(3,\).*\(n, 3\)"),
    "a batch": ((np.zeros((2, 5, 3)),), {}, r"\(2, 5, 3\).*\(n, 3\)"),
    "an empty list": (([],), {}, r"\(0,\).*\(n, 3\)"),
    "complex": ((np.zeros((5, 3), complex),), {}, "xyz has dtype complex128.*real"),
    "text": ((np.full((5, 3), "1"),), {}, "xyz has dtype <U1.*real"),
    "bool": ((np.zeros((5, 3), bool),), {}, "xyz has dtype bool.*real"),
    "objects": ((np.full((5, 3), None),), {}, "xyz has dtype object.*real"),
    "too few intensities": ((_POINTS, np.zeros(4)), {}, r"intensity has shape \(4,\).*\(5,\)"),
    "a column of intensities": ((_POINTS, np.zeros((5, 1))), {}, r"intensity has shape \(5, 1\)"),
    "complex intensity": ((_POINTS, np.zeros(5, complex)), {}, "intensity has dtype complex128"),
    "no capacity": ((_POINTS,), {"capacity": 0}, "capacity is 0.*at least 1"),
    "negative capacity": ((_POINTS,), {"capacity": -8}, "capacity is -8.*at least 1"),
}
"""Arguments of `PointCloud.from_numpy`, and what the error says."""
