"""When each point of a sweep was measured, as far as the formats say."""

import pathlib
from collections.abc import Callable, Mapping

import numpy as np

from jaxbox._files import InputError
from jaxbox.io.points import TimedPoints, named_points

TIME_NAMES = ("time", "t", "timestamp", "offset_time", "offset_ns", "time_offset", "time_stamp")
"""Names that drivers and data sets give to the time of a point; the first that is there is taken: Velodyne
(time, float32 s from the sweep's stamp), Ouster (t, uint32 ns), Hesai and RoboSense (timestamp, float64 s
since 1970), Livox (offset_time, uint32 ns; timestamp, float64 ns since 1970), Argoverse 2 (offset_ns)."""

MAX_SWEEP_S = 2.0
"""No sweep lasts longer; a column that spans more has another unit."""
MIN_SWEEP_S = 1e-3
"""Whole numbers that span less as nanoseconds are likely microseconds or milliseconds."""
_CLOCK_NS = 1e17
"""Numbers beyond this are nanoseconds since 1970: of seconds it would be three billion years."""
_FLOAT32_CLOCK_S = 1e4
"""From here on float32 steps by a millisecond."""
_NS, _S = 1e-9, 1.0


def timed_points(
    columns: Mapping[str, np.ndarray], where: str, *, sweep_ns: int | None = None
) -> TimedPoints:
    """Picks coordinates, intensity and times out of named columns.

    Args:
      columns: n values each; names in any case.
      where: the file, for the error.
      sweep_ns: the sweep's own time, ns since 1970; None where it is not known.

    Returns:
      The points.

    Raises:
      InputError: as `named_points`, and where the unit of the times is not clear.
    """
    xyz, intensity = named_points(columns, where)
    return TimedPoints(xyz, intensity, point_times_s(columns, len(xyz), where, sweep_ns=sweep_ns))


def timed_reader(
    columns: Callable[[pathlib.Path], Mapping[str, np.ndarray]],
) -> Callable[[pathlib.Path], TimedPoints]:
    """Makes a `PointFormat.read_timed` of what reads the named columns of a file.

    Args:
      columns: reads them.

    Returns:
      What reads the points, with times where a column is named so.
    """
    return lambda path: timed_points(columns(path), str(path))


def point_times_s(
    columns: Mapping[str, np.ndarray], num_points: int, where: str, *, sweep_ns: int | None = None
) -> np.ndarray | None:
    """The time of each point in seconds.

    Whole numbers are nanoseconds, other numbers seconds, or nanoseconds where they can only be those since
    1970. What is within `MAX_SWEEP_S` of 0 counts from the sweep's time; what is not is a clock.

    Args:
      columns: n values each; names in any case.
      num_points: n.
      where: the file, for the error.
      sweep_ns: the sweep's own time, ns since 1970; None where it is not known.

    Returns:
      (n,) float64, s from the sweep's time, or from the first point where a clock differs from the sweep's by
      more than `MAX_SWEEP_S`, or the sweep's time is not known. NaN stays. None where no column is named so.

    Raises:
      InputError: for another number of values, or where they span what no sweep does: the unit is another
        one.

    >>> point_times_s({"t": np.array([0, 50_000_000, 100_000_000], np.uint32)}, 3, "a").tolist()
    [0.0, 0.05, 0.1]
    """
    known = {name.lower(): values for name, values in columns.items()}
    name = next((name for name in TIME_NAMES if name in known), None)
    if name is None:
        return None
    values = known[name]
    if values.dtype.kind not in "fiu" or values.shape != (num_points,):
        raise InputError(f"{where}: field {name} is not one real number a point.")
    finite = values[np.isfinite(values)]
    if not finite.size:
        return np.full(num_points, np.nan)
    first, last = finite.min(), finite.max()
    unit = _NS if values.dtype.kind in "iu" or first >= _CLOCK_NS else _S
    _check_span(name, first, last, unit, where)
    start_s = float(first) * unit
    if abs(start_s) > MAX_SWEEP_S:
        start_s = _since_sweep_s(first, unit, sweep_ns)
    # Whole numbers are subtracted as such: of ns since 1970 float64 keeps some hundreds.
    return (values - first).astype(np.float64) * unit + start_s


def _check_span(name: str, first: np.generic, last: np.generic, unit: float, where: str) -> None:
    is_whole = first.dtype.kind in "iu"
    span_s = (int(last) - int(first) if is_whole else float(last) - float(first)) * unit
    word = "nanoseconds" if unit == _NS else "seconds"
    if span_s > MAX_SWEEP_S or (is_whole and 0 < span_s < MIN_SWEEP_S):
        raise InputError(
            f"{where}: field {name} spans {span_s:g} s as {word}, which no sweep does; its unit is not "
            "clear. Store it in seconds as a floating-point number, or in whole nanoseconds."
        )
    if first.dtype == np.float32 and abs(float(first)) > _FLOAT32_CLOCK_S:
        raise InputError(
            f"{where}: field {name} is a clock in float32, which steps by milliseconds or more there. "
            "Store it in float64, or from the sweep's start."
        )


def _since_sweep_s(first: np.generic, unit: float, sweep_ns: int | None) -> float:
    """The first point's time from the sweep's, by one clock; 0 where it is another, or is not known."""
    if sweep_ns is None:
        return 0.0
    is_whole = first.dtype.kind in "iu"
    start_s = (int(first) - sweep_ns) * _NS if is_whole else float(first) * unit - sweep_ns * _NS
    return start_s if abs(start_s) <= MAX_SWEEP_S else 0.0
