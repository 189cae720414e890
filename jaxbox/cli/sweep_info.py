"""``jaxbox info FILE``: what a sweep looks like, from a rough look in NumPy, and which settings fit it."""

import dataclasses
import json
from collections.abc import Sequence

import numpy as np
from rich.console import Console

from jaxbox import io
from jaxbox.config import DetectorConfig
from jaxbox.padding import fitting_capacity
from jaxbox.settings import changed_settings

NUM_BEAMS = (16, 32, 40, 64, 80, 128)
"""What spinning sensors have."""
TUNED_BEAMS = 64
"""The default preset was chosen on sweeps of so many beams."""
MIN_SENSOR_HEIGHT_M = 0.7
"""Sensors of road vehicles stand higher."""
_MIN_TURN_POINTS = 100
_MAX_TURNS = 256
_NEAR_M, _FAR_M = 3.0, 30.0
_ELEVATION_STEP_DEG = 0.02
_ELEVATION_SIGMA_STEPS = 3
_MIN_PEAK = 0.25
_GROUND_CELL_M = 1.0
_NUM_PLANES = 256
_PLANE_TOLERANCE_M = 0.1
_MAX_PLANE_TILT = 0.3


@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepInfo:
    """What a sweep looks like; None where there are too few points to say."""

    name: str
    """Of the sweep."""
    timestamp_ns: int | None
    """ns since 1970, or None where it is unknown."""
    num_points: int
    """All points."""
    num_nonfinite: int
    """Points with NaN or infinity."""
    num_zero: int
    """Points at the origin, which some drivers write for beams without a return."""
    has_intensity: bool
    """Whether any intensity is not 0."""
    range_m: tuple[float, ...] | None
    """Nearest, median and farthest horizontal range."""
    height_m: tuple[float, ...] | None
    """1 %, median and 99 % of z."""
    elevation_deg: tuple[float, ...] | None
    """0.5 % and 99.5 % of the beams' elevation."""
    num_beams: int | None
    """About how many beams the sensor has."""
    sensor_height_m: float | None
    """Of the sensor above the ground round it."""
    tilt_deg: float | None
    """Between z and the ground's normal."""


def look_at(
    name: str, xyz: np.ndarray, intensity: np.ndarray, *, timestamp_ns: int | None = None
) -> SweepInfo:
    """Looks at a sweep.

    Args:
      name: of the sweep.
      xyz: (n, 3) m, sensor frame.
      intensity: (n,).
      timestamp_ns: ns since 1970, or None.

    Returns:
      What it looks like.
    """
    finite = np.isfinite(xyz).all(axis=1)
    zero = finite & ~xyz.any(axis=1)
    seen = xyz[finite & ~zero].astype(np.float64)
    rho = np.hypot(seen[:, 0], seen[:, 1])
    elevation = np.degrees(np.arctan2(seen[:, 2], rho))
    plane = fit_ground(seen)
    some = len(seen) > 0

    def quantiles(values: np.ndarray, *shares: float) -> tuple[float, ...]:
        return tuple(round(float(value), 3) for value in np.quantile(values, shares))

    return SweepInfo(
        name=name,
        timestamp_ns=timestamp_ns,
        num_points=len(xyz),
        num_nonfinite=int(np.sum(~finite)),
        num_zero=int(np.sum(zero)),
        has_intensity=bool(np.any(intensity)),
        range_m=quantiles(rho, 0, 0.5, 1) if some else None,
        height_m=quantiles(seen[:, 2], 0.01, 0.5, 0.99) if some else None,
        elevation_deg=quantiles(elevation, 0.005, 0.995) if some else None,
        num_beams=estimate_beams(seen),
        sensor_height_m=None if plane is None else round(float(-plane[2]), 2),
        tilt_deg=None if plane is None else round(float(np.degrees(np.arctan(np.hypot(*plane[:2])))), 1),
    )


def estimate_beams(xyz: np.ndarray) -> int | None:
    """About how many beams made a sweep.

    Files that go beam by beam show one turn of the azimuth a beam, which is counted. In others, the peaks of
    the elevations' histogram are, and the nearest number that is made is answered: that is right to a class.

    Args:
      xyz: (n, 3) finite, m.

    Returns:
      The number, or None for too few points.
    """
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    turns = 1 + int(np.sum(np.abs(np.diff(np.arctan2(xyz[:, 1], xyz[:, 0]))) > np.pi))
    if NUM_BEAMS[0] // 2 <= turns <= _MAX_TURNS and len(xyz) > _MIN_TURN_POINTS * turns:
        # A first beam that begins at the cut itself is a turn more.
        return min((turns - 1, turns), key=lambda n: min(abs(n - known) for known in NUM_BEAMS))
    elevation = np.degrees(np.arctan2(xyz[:, 2], rho))[rho > _NEAR_M]
    if len(elevation) < _MIN_TURN_POINTS * NUM_BEAMS[0]:
        return None
    low, high = np.quantile(elevation, (0.002, 0.998))
    counts, _ = np.histogram(elevation, np.arange(low - 0.5, high + 0.5, _ELEVATION_STEP_DEG))
    steps = np.arange(-10, 11) / _ELEVATION_SIGMA_STEPS
    window = np.exp(-(steps**2) / 2)
    smooth = np.convolve(counts, window / window.sum(), "same")
    inner = smooth[1:-1]
    peaks = (
        (inner > smooth[:-2]) & (inner >= smooth[2:]) & (inner > _MIN_PEAK * np.median(smooth[smooth > 0]))
    )
    return min(NUM_BEAMS, key=lambda known: abs(np.log(known / max(peaks.sum(), 1))))


def fit_ground(xyz: np.ndarray) -> np.ndarray | None:
    """The plane z = a x + b y + c through most of the lowest points of 1 m cells near the sensor.

    Args:
      xyz: (n, 3) finite, m.

    Returns:
      (3,) a, b, c; or None where no plane has enough of them.
    """
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    near = xyz[(rho > _NEAR_M) & (rho < _FAR_M)]
    cells = np.floor(near[:, :2] / _GROUND_CELL_M).astype(int)
    order = np.lexsort((near[:, 2], cells[:, 1], cells[:, 0]))
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(cells[order], axis=0) != 0).any(axis=1)
    lowest = near[order][first]
    if len(lowest) < 2 * len("xyz"):
        return None
    ones = np.column_stack([lowest[:, :2], np.ones(len(lowest))])
    samples = np.random.default_rng(0).integers(len(lowest), size=(_NUM_PLANES, 3))
    regular = np.abs(np.linalg.det(ones[samples])) > 1
    if not regular.any():
        return None
    planes = np.linalg.solve(ones[samples][regular], lowest[samples][regular][..., 2:])[..., 0]
    inliers = np.abs(ones @ planes.T - lowest[:, 2:]) < _PLANE_TOLERANCE_M
    inliers &= np.hypot(planes[:, 0], planes[:, 1]) < _MAX_PLANE_TILT
    best = inliers[:, inliers.sum(axis=0).argmax()]
    if best.sum() < max(len("xyz"), 0.1 * len(lowest)):
        return None
    return np.linalg.lstsq(ones[best], lowest[best, 2], rcond=None)[0]


def fitting_settings(sweeps: Sequence[np.ndarray]) -> dict[str, object]:
    """Capacities that sweeps need, as changes of the default preset: none where it holds them.

    Args:
      sweeps: (n, 3) each, m.

    Returns:
      Values by dotted name, only of those that are larger than the preset's.
    """
    base = DetectorConfig()
    capacity = fitting_capacity(max(len(xyz) for xyz in sweeps))
    usual = {
        "clustering.max_obstacles": base.clustering.max_obstacles or 3 * capacity // 4,
        "box.max_slab_points": base.box.max_slab_points or capacity // 4,
    }
    usual |= {f"clustering.maps.{i}.max_cells": m.max_cells for i, m in enumerate(base.clustering.maps)}
    needed = changed_settings(DetectorConfig.for_sweeps(sweeps, margin=1), base)
    proposed = changed_settings(DetectorConfig.for_sweeps(sweeps), base)
    return {name: proposed[name] for name, value in needed.items() if value > usual[name]}


def print_sweep_info(
    paths: Sequence[str], *, topic: str | None, num_sweeps: int, as_json: bool, console: Console
) -> None:
    """Looks at some sweeps and prints what they are like.

    Args:
      paths: what `jaxbox.io.open_sweeps` takes.
      topic: of the points in recordings.
      num_sweeps: how many are looked at, spread over all.
      as_json: whether JSON is printed.
      console: where it goes.

    Raises:
      InputError: where there are no sweeps, or one cannot be read.
    """
    sweeps = io.open_sweeps(paths, topic=topic)
    step = max(1, -(-len(sweeps) // num_sweeps))
    clouds, infos = [], []
    for sweep in sweeps[::step]:
        xyz, intensity = sweep.read_points()
        clouds.append(xyz)
        infos.append(look_at(sweep.name, xyz, intensity, timestamp_ns=sweep.timestamp_ns))
    changes = fitting_settings(clouds)
    capacity = fitting_capacity(max(len(xyz) for xyz in clouds))
    if as_json:
        found = [dataclasses.asdict(info) for info in infos]
        fits = {"preset": "default", "capacity": capacity, "settings": changes}
        console.out(json.dumps({"num_sweeps": len(sweeps), "sweeps": found, "fits": fits}), highlight=False)
        return
    console.print(f"{len(sweeps)} sweeps, {len(infos)} looked at", markup=False)
    for info in infos:
        for line in describe(info):
            console.print(line, markup=False)
    console.print(f"fits: preset default, padded to {capacity} points", markup=False)
    for name, value in changes.items():
        console.print(f"  {name} = {value}", markup=False)
    if changes:
        console.print("  (the preset's capacities are too small: put these lines in a file for --config)")


def describe(info: SweepInfo) -> list[str]:
    """A sweep in words.

    Args:
      info: what it looks like.

    Returns:
      A few lines, and what to beware of.
    """
    lines = [
        f"{info.name}: {info.num_points} points, {info.num_nonfinite} NaN or infinite, "
        f"{info.num_zero} at the origin, {'with' if info.has_intensity else 'without'} intensity"
    ]
    if info.range_m is None or info.height_m is None or info.elevation_deg is None:
        return [*lines, "  no point to look at"]
    near, middle, far = info.range_m
    low, _, high = info.height_m
    lines.append(
        f"  range {near:.1f} to {far:.1f} m, half within {middle:.1f} m; z {low:.1f} to {high:.1f} m"
    )
    beams = "too few points to count beams" if info.num_beams is None else f"about {info.num_beams} beams"
    down, up = info.elevation_deg
    lines.append(f"  {beams}, elevation {down:.1f} to {up:.1f} degrees")
    if info.sensor_height_m is None:
        lines.append("  no ground plane round the sensor: is z up, and the sensor at the origin?")
    else:
        height, tilt = info.sensor_height_m, info.tilt_deg
        lines.append(f"  sensor {height:.2f} m above the ground, tilted {tilt:.1f} degrees")
    if info.sensor_height_m is not None and info.sensor_height_m < MIN_SENSOR_HEIGHT_M:
        lines.append(
            "  the origin is close to the ground: is this a vehicle's frame? The detector looks from the "
            "origin, so subtract the sensor's position first"
        )
    if info.num_beams is not None and info.num_beams < TUNED_BEAMS // 2 + 1:
        lines.append(
            f"  the default preset was chosen on {TUNED_BEAMS} beams: expect to miss far vehicles, and lower "
            "clustering.min_points"
        )
    return lines
