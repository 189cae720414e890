"""``jaxbox info FILE``: what a sweep looks like, from a rough look in NumPy, and which settings fit it."""

import dataclasses
import json
from collections.abc import Sequence

import numpy as np
from rich.console import Console

from jaxbox import io
from jaxbox._padding import fitting_capacity
from jaxbox.config import DetectorConfig, propose_capacities
from jaxbox.config.capacities import capacity_sizes
from jaxbox.config.fields import changed_fields
from jaxbox.config.sensors import TUNED_BEAMS, fitting_sensor
from jaxbox.evaluation.beams import beam_of_points, goes_beam_by_beam
from jaxbox.geometry.mounting import MIN_SENSOR_HEIGHT_M, Mounting, measure_mounting
from jaxbox.types import GROUND_ABOVE_M

NUM_BEAMS = (16, 32, 40, 64, 80, 128)
"""What spinning sensors have."""
VEHICLE_ELEVATION_DEG = (-10.0, 0.0)
"""Beams between these meet the vehicles: from a roof, those from 10 m on."""
MAX_LEVEL_TILT_DEG = 3.0
"""A sensor tilted more is better seen upright: ``python -m benchmarks.bench_mounting``."""
LEVEL_OPTION = "--level"
_MIN_TURN_POINTS = 100
_MAX_TURNS = 256
_NEAR_M = 3.0
_ELEVATION_STEP_DEG = 0.02
_ELEVATION_SIGMA_STEPS = 3
_MIN_PEAK = 0.25


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
    spacing_deg: float | None
    """Mean step in elevation between its beams below the horizon."""
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
    mounting = measure_mounting(seen)
    num_beams, spacing_deg = estimate_beams(seen)
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
        num_beams=num_beams,
        spacing_deg=spacing_deg,
        sensor_height_m=None if mounting is None else round(mounting.height_m or 0.0, 2),
        tilt_deg=None if mounting is None else round(mounting.tilt_deg, 1),
    )


def estimate_beams(xyz: np.ndarray) -> tuple[int | None, float | None]:
    """About how many beams made a sweep, and how far apart they lie below the horizon.

    Files that go beam by beam show one turn of the azimuth a beam, which is counted. In others, the peaks of
    the elevations' histogram are, and the nearest number that is made is answered: that is right to a class.

    Args:
      xyz: (n, 3) finite, m.

    Returns:
      The number, and the mean step in elevation between beams from -10 to 0 degrees; each None for too few
      points to say.
    """
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    elevation = np.degrees(np.arctan2(xyz[:, 2], rho))
    beam = beam_of_points(xyz)
    num = int(beam.max(initial=0)) + 1
    many = len(xyz) > _MIN_TURN_POINTS * num
    if many and NUM_BEAMS[0] // 2 <= num <= _MAX_TURNS and goes_beam_by_beam(xyz):
        # A first beam that begins at the cut itself is a turn more.
        count = min((num - 1, num), key=lambda n: min(abs(n - known) for known in NUM_BEAMS))
        return count, _spacing(np.array([np.median(elevation[beam == k]) for k in range(num)]))
    elevation = elevation[rho > _NEAR_M]
    if len(elevation) < _MIN_TURN_POINTS * NUM_BEAMS[0]:
        return None, None
    peaks = _peaks(elevation)
    return min(NUM_BEAMS, key=lambda known: abs(np.log(known / max(len(peaks), 1)))), _spacing(peaks)


def _spacing(elevation_deg: np.ndarray) -> float | None:
    """Mean step between beams in the part of the view that meets vehicles."""
    low, high = VEHICLE_ELEVATION_DEG
    met = np.sort(elevation_deg[(elevation_deg > low) & (elevation_deg < high)])
    return round(float(np.ptp(met) / (len(met) - 1)), 3) if len(met) > 1 else None


def _peaks(elevation_deg: np.ndarray) -> np.ndarray:
    """Elevations at which many points lie."""
    low, high = np.quantile(elevation_deg, (0.002, 0.998))
    counts, edges = np.histogram(elevation_deg, np.arange(low - 0.5, high + 0.5, _ELEVATION_STEP_DEG))
    steps = np.arange(-10, 11) / _ELEVATION_SIGMA_STEPS
    window = np.exp(-(steps**2) / 2)
    smooth = np.convolve(counts, window / window.sum(), "same")
    inner = smooth[1:-1]
    is_peak = (
        (inner > smooth[:-2]) & (inner >= smooth[2:]) & (inner > _MIN_PEAK * np.median(smooth[smooth > 0]))
    )
    return edges[1:-2][is_peak] + _ELEVATION_STEP_DEG / 2


def fitting_beams(infos: Sequence[SweepInfo]) -> int:
    """The sensor of `jaxbox.config.sensors` that sees as these sweeps' does; 64 beams where that is unknown.

    Args:
      infos: of sweeps of one sensor.

    Returns:
      One of `jaxbox.config.sensors.SENSORS`.
    """
    spacings = [info.spacing_deg for info in infos if info.spacing_deg is not None]
    return fitting_sensor(float(np.median(spacings))) if spacings else TUNED_BEAMS


def capacity_changes(
    sweeps: Sequence[np.ndarray], *, base: DetectorConfig | None = None
) -> dict[str, object]:
    """Capacities that sweeps need, as changes of a preset: none where it holds them.

    Args:
      sweeps: (n, 3) each, m.
      base: the preset for their sensor; None for the default one.

    Returns:
      Values by dotted name, only of those that are larger than the preset's.
    """
    base = DetectorConfig() if base is None else base
    capacity = fitting_capacity(max(len(xyz) for xyz in sweeps))
    sizes = capacity_sizes(base, capacity)
    needed = changed_fields(propose_capacities(sweeps, base=base, margin=1), base)
    proposed = changed_fields(propose_capacities(sweeps, base=base), base)
    return {name: proposed[name] for name, value in needed.items() if value > sizes.get(name, value)}


def print_sweep_info(sweeps: Sequence[io.Sweep], *, num_sweeps: int, as_json: bool, console: Console) -> None:
    """Looks at some sweeps and prints what they are like.

    Args:
      sweeps: as `jaxbox.io.open_sweeps` gives them.
      num_sweeps: how many are looked at, spread over all.
      as_json: whether JSON is printed.
      console: where it goes.

    Raises:
      InputError: where one cannot be read.
    """
    step = max(1, -(-len(sweeps) // num_sweeps))
    clouds, infos = [], []
    for sweep in sweeps[::step]:
        xyz, intensity = sweep.read_points()
        clouds.append(xyz)
        infos.append(look_at(sweep.name, xyz, intensity, timestamp_ns=sweep.timestamp_ns))
    beams = fitting_beams(infos)
    options = advised_options(infos, beams)
    if LEVEL_OPTION in options:
        clouds = [(measure_mounting(xyz) or Mounting()).raised().level(xyz) for xyz in clouds]
    changes = capacity_changes(clouds, base=DetectorConfig.for_sensor(beams))
    capacity = fitting_capacity(max(len(xyz) for xyz in clouds))
    if as_json:
        found = [dataclasses.asdict(info) for info in infos]
        fits = {
            "preset": "default",
            "sensor": beams,
            "capacity": capacity,
            "settings": changes,
            "options": options,
        }
        console.out(json.dumps({"num_sweeps": len(sweeps), "sweeps": found, "fits": fits}), highlight=False)
        return
    console.print(f"{len(sweeps)} sweeps, {len(infos)} looked at", markup=False)
    for info in infos:
        for line in describe(info):
            console.print(line, markup=False)
    console.print(f"fits: preset default for {beams} beams, padded to {capacity} points", markup=False)
    if options:
        console.print(f"  jaxbox detect ... {' '.join(options)}", markup=False)
    for name, value in changes.items():
        console.print(f"  {name} = {value}", markup=False)
    if changes:
        console.print("  (the preset's capacities are too small: put these lines in a file for --config)")


def advised_options(infos: Sequence[SweepInfo], beams: int) -> list[str]:
    """Options of `jaxbox detect` that fit sweeps.

    Args:
      infos: of sweeps of one sensor.
      beams: as `fitting_beams` answers.

    Returns:
      None of them for the sensor that the presets were chosen on, mounted upright.
    """
    tilts = np.array([info.tilt_deg for info in infos if info.tilt_deg is not None])
    options = [] if beams == TUNED_BEAMS else ["--sensor", str(beams)]
    heights = [info.sensor_height_m for info in infos if info.sensor_height_m is not None]
    low = any(-GROUND_ABOVE_M <= height < MIN_SENSOR_HEIGHT_M for height in heights)
    tilted = len(tilts) > 0 and np.median(tilts) > MAX_LEVEL_TILT_DEG
    return options + ([LEVEL_OPTION] if low or tilted else [])


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
    beams += f", {info.spacing_deg:.2f} degrees apart" if info.spacing_deg else ""
    down, up = info.elevation_deg
    lines.append(f"  {beams}, elevation {down:.1f} to {up:.1f} degrees")
    height = info.sensor_height_m
    if height is None:
        return [*lines, "  no ground plane round the sensor: is z up, and the sensor at the origin?"]
    if height < -GROUND_ABOVE_M:
        return [*lines, f"  the ground lies {-height:.2f} m above the sensor: upside down, or z points down?"]
    lines.append(f"  sensor {height:.2f} m above the ground, tilted {info.tilt_deg:.1f} degrees")
    if height < MIN_SENSOR_HEIGHT_M:
        lines.append(
            "  the origin is close to the ground: is this a vehicle's frame? The detector looks from the "
            "origin: --level lifts it to a roof's height, --sensor-at X Y Z says exactly where the sensor is"
        )
    return lines
