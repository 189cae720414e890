"""What of a sweep's units, axes and origin looks wrong, and the option of the command line that mends it.

A sweep of a road vehicle has a ground round the sensor, some metres below it. Where there is none, the units
and axes that sources have are tried: the ones with the clearest ground are the guess.
"""

from collections.abc import Iterator

import numpy as np

from jaxbox.geometry.mounting import MIN_SENSOR_HEIGHT_M, ROOF_HEIGHT_M, Mounting, measure_mounting
from jaxbox.io.convention import ORDINARY, PointConvention
from jaxbox.types import GROUND_ABOVE_M

MAX_SENSOR_HEIGHT_M = 4.0
"""No road vehicle carries its sensor higher."""
MAX_TILT_DEG = 15.0
UNITS = {1.0: "", 0.001: "millimetres", 0.01: "centimetres", 0.3048: "feet"}
"""What recordings are in, by the metres of a unit."""
UPS = {
    "ros": "",
    "ned": "z points down (where y points left and not right, it is --flip z)",
    "camera": "y points down, as a camera's",
    "-z,-x,y": "y points up",
}
"""Where up is, by the axes that mend it."""

_MAX_TRIED = 10_000
_FAR_RATIO = 5.0
"""Of the middle of the points from the origin, by their spread round it: a sensor is in their middle."""
_FLOAT32_LIMIT = 1e5
"""From here on float32 steps by a centimetre or more."""
_GROUND_M, _BELOW_M = 0.15, 0.5


def doubts_about(xyz: np.ndarray, mounting: Mounting | None) -> tuple[str, ...]:
    """Says what looks wrong.

    Args:
      xyz: (n, 3) finite, as they were read, without points at the origin.
      mounting: as `measure_mounting` finds it there.

    Returns:
      Sentences that name options; none where the ground lies where that of a road vehicle does.
    """
    height_m = None if mounting is None else mounting.height_m
    if not len(xyz) or (height_m is not None and -GROUND_ABOVE_M <= height_m <= MAX_SENSOR_HEIGHT_M):
        return ()
    few = xyz[:: -(-len(xyz) // _MAX_TRIED)]
    if (offset := _offset(few)) is not None:
        return (offset,)
    as_it_is = -1.0 if mounting is None else _clearness(few, mounting)
    clearness, convention, mended = max(_tried(few), key=lambda item: item[0], default=(-1.0, None, None))
    if convention is not None and mended is not None and clearness > as_it_is:
        return (_described(convention, mended),)
    if height_m is None:
        return (
            "no ground plane round the sensor: are the points in metres (--scale), is z up (--axes, --flip), "
            "and the sensor at the origin (--sensor-at)?",
        )
    z = float(np.round(ROOF_HEIGHT_M - height_m, 2))
    where = f"{height_m:.2f} m below" if height_m > 0 else f"{-height_m:.2f} m above"
    return (
        f"the ground lies {where} the origin: where that is not the sensor, --sensor-at 0 0 {z:g} would be "
        "one on a roof",
    )


def _offset(xyz: np.ndarray) -> str | None:
    """Whether the points lie somewhere else than round the origin."""
    middle = np.median(xyz, axis=0)
    spread = np.median(np.linalg.norm(xyz - middle, axis=1))
    if np.linalg.norm(middle[:2]) <= _FAR_RATIO * spread:
        return None
    place = " ".join(f"{value:.0f}" for value in middle)
    text = (
        f"the middle of the points is {np.linalg.norm(middle):.0f} m from the origin, at {place}, as in the "
        "frame of a map: --sensor-at X Y Z says where the sensor is there"
    )
    if np.abs(middle).max() > _FLOAT32_LIMIT:
        text += "; numbers so large have lost centimetres, so better subtract that before they are stored"
    return text


def _tried(xyz: np.ndarray) -> Iterator[tuple[float, PointConvention, Mounting]]:
    """Conventions with which the ground lies where a vehicle's does, and how clear it is."""
    for convention in (PointConvention(scale, axes) for scale in UNITS for axes in UPS):
        moved = convention.apply(xyz)
        mounting = None if convention == ORDINARY else measure_mounting(moved)
        if mounting is not None and _is_a_vehicles(mounting):
            yield _clearness(moved, mounting), convention, mounting


def _is_a_vehicles(mounting: Mounting) -> bool:
    height_m = mounting.height_m or 0.0
    return MIN_SENSOR_HEIGHT_M <= height_m <= MAX_SENSOR_HEIGHT_M and mounting.tilt_deg <= MAX_TILT_DEG


def _clearness(xyz: np.ndarray, mounting: Mounting) -> float:
    """Share of the points on the ground, less that of those below it: of a wall, half lie behind."""
    above = mounting.level(xyz)[:, 2] + (mounting.height_m or 0.0)
    return float(np.mean(np.abs(above) < _GROUND_M) - np.mean(above < -_BELOW_M))


def _described(convention: PointConvention, mounting: Mounting) -> str:
    axes = next(name for name in UPS if PointConvention(axes=name).axes == convention.axes)
    reasons, options = [], []
    if convention.scale != 1.0:
        reasons.append(f"the points are in {UNITS[convention.scale]}")
        options.append(f"--scale {convention.scale:g}")
    if axes != "ros":
        reasons.append(UPS[axes])
        options.append(f"--axes={axes}" if axes.startswith("-") else f"--axes {axes}")
    return (
        f"it looks as if {' and '.join(reasons)}: with {' '.join(options)} the sensor stands "
        f"{mounting.height_m:.2f} m above the ground"
    )
