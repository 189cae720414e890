"""Watches the detector at work: reads sweeps, detects, and says when something drifts.

    python examples/monitor.py recording.mcap --deadline-ms 100
    python examples/monitor.py --synthetic 30 --fault-at 15

For each sweep it prints a line of JSON: the signals, and the alarms if there are any. A signal drifts where
its fast mean over the last few sweeps has left its slow mean over the last hundred by more than a limit; each
limit is a figure of the sensor and its mount, not of the detector, and should be chosen for yours. The exit
code is 1 where there was an alarm.
"""

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Iterable, Iterator, Sequence

import jax
import numpy as np

import jaxbox
from jaxbox import Detections, DetectorConfig, PointCloud, Status, io, synthetic
from jaxbox.run.cache import enable_cache
from jaxbox.run.summary import Summary

FAST_SWEEPS, SLOW_SWEEPS = 4, 100
"""Sweeps over which the two means forget."""
WARM_UP_SWEEPS = 5
"""No drift is judged before that many."""
LIMITS = {
    "sensor_height_m": 0.15,  # a mount that sinks, a load, a kerb under one wheel
    "tilt_deg": 1.0,
    "outlier_share": 0.05,  # rain, dust, crosstalk
    "out_of_range_share": 0.2,  # a wrong frame or unit
    "ground_share": 0.2,  # a sensor that looks elsewhere, or is covered
    "ground_inlier_share": 0.2,
    "boxes": 8.0,  # per sweep, from `jaxbox.DEFAULT_SCORE_THRESHOLD` on
}
"""How far the fast mean of a signal may be from its slow mean."""
MAX_CAPACITY_SHARE = 0.9
"""A fuller capacity is worth a larger one before it drops anything."""
MAX_MISSED_SHARE = 0.05
"""Of the last hundred sweeps, weighed as the slow mean does."""
SERIOUS = ~(Status.NONFINITE_POINTS | Status.HULL_OVERFLOW)
"""Bits that are an alarm: many sensors mark beams without a return by NaN, and a hull keeps its shape."""


@dataclasses.dataclass
class Mean:
    """An exponentially weighted mean over about that many sweeps; the plain mean until there are as many."""

    sweeps: int
    value: float = 0.0
    seen: int = 0

    def update(self, value: float) -> float:
        """Takes the next value and returns the mean."""
        self.seen += 1
        self.value += (value - self.value) / min(self.seen, self.sweeps)
        return self.value


def signals_of(summary: Summary) -> dict[str, float]:
    """What is watched for drift; the ground only where there is one."""
    signals = {
        "outlier_share": summary.point_share("outlier_points"),
        "out_of_range_share": summary.point_share("out_of_range_points"),
        "ground_share": summary.point_share("ground_points"),
        "boxes": float(summary.num_boxes),
    }
    if summary.ground.found:
        signals |= {
            "sensor_height_m": summary.ground.sensor_height_m,
            "tilt_deg": summary.ground.tilt_deg,
            "ground_inlier_share": summary.ground.inlier_share,
        }
    return signals


class Monitor:
    """Keeps the means, and judges each sweep by them."""

    def __init__(self, *, deadline_ms: float) -> None:
        self._deadline_ms = deadline_ms
        self._means = {name: (Mean(FAST_SWEEPS), Mean(SLOW_SWEEPS)) for name in LIMITS}
        self._missed = Mean(SLOW_SWEEPS)

    def judge(self, summary: Summary, latency_ms: float) -> list[str]:
        """Takes the next sweep and returns its alarms, in words."""
        alarms = [text for bit in Status if bit & summary.status & SERIOUS for text in bit.describe()]
        alarms += [
            f"{use.field} is {use.share:.0%} full"
            for use in summary.capacities
            if MAX_CAPACITY_SHARE < use.share <= 1 and "capacity=" not in use.field
        ]
        for name, value in signals_of(summary).items():
            fast, slow = (mean.update(value) for mean in self._means[name])
            ready = self._means[name][1].seen > WARM_UP_SWEEPS
            if ready and abs(fast - slow) > LIMITS[name]:
                alarms.append(f"{name} drifts: {fast:.3g} lately, {slow:.3g} before")
        missed = self._missed.update(float(latency_ms > self._deadline_ms))
        if self._missed.seen > WARM_UP_SWEEPS and missed > MAX_MISSED_SHARE:
            alarms.append(f"{missed:.0%} of the sweeps missed the deadline of {self._deadline_ms:g} ms")
        return alarms


def detect_each(
    sweeps: Iterable[tuple[str, np.ndarray, np.ndarray | None]], config: DetectorConfig
) -> Iterator[tuple[str, Detections, float]]:
    """Name, detections and milliseconds of each sweep; compiling, once a capacity, is not counted."""
    compiled = set()
    for name, xyz, intensity in sweeps:
        start = time.perf_counter()
        cloud = PointCloud.from_numpy(xyz, intensity)
        if cloud.capacity not in compiled:
            jax.block_until_ready(jaxbox.detect(cloud, config))
            compiled.add(cloud.capacity)
            start = time.perf_counter()
        detections = jaxbox.detect(cloud, config).on_host()
        yield name, detections, (time.perf_counter() - start) * 1e3


def recorded_sweeps(paths: Sequence[str]) -> Iterator[tuple[str, np.ndarray, np.ndarray | None]]:
    """Sweeps of files, folders and recordings."""
    for sweep in io.open_sweeps(paths):
        yield sweep.name, *sweep.read_points()


def synthetic_sweeps(
    count: int, *, fault_at: int | None, num_azimuths: int
) -> Iterator[tuple[str, np.ndarray, np.ndarray | None]]:
    """A drive of synthetic streets; from `fault_at` on, the mount is loose and the sensor stands tilted."""
    tilt = np.radians(6)
    turn = np.array(
        [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]], np.float32
    )
    for number in range(count):
        sweep = synthetic.make_sweep(number, num_azimuths=num_azimuths)
        faulty = fault_at is not None and number >= fault_at
        yield f"{number:06d}", sweep.xyz @ turn.T if faulty else sweep.xyz, sweep.intensity


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints a line a sweep and a last one with totals; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("paths", nargs="*", help="what `jaxbox detect` takes")
    parser.add_argument("--synthetic", type=int, metavar="N", help="N synthetic sweeps instead")
    parser.add_argument("--fault-at", type=int, metavar="SWEEP", help="tilt the sensor from this sweep on")
    parser.add_argument("--num-azimuths", type=int, default=2000, help="of the synthetic sweeps")
    parser.add_argument("--deadline-ms", type=float, default=100.0, help="a sweep's time")
    options = parser.parse_args(arguments)
    if bool(options.paths) == (options.synthetic is not None):
        parser.error("give paths, or --synthetic N.")
    enable_cache()
    sweeps = (
        recorded_sweeps(options.paths)
        if options.paths
        else synthetic_sweeps(options.synthetic, fault_at=options.fault_at, num_azimuths=options.num_azimuths)
    )
    config, monitor, totals = DetectorConfig(), Monitor(deadline_ms=options.deadline_ms), [0, 0, 0]
    for name, detections, latency_ms in detect_each(sweeps, config):
        summary = jaxbox.summarise(detections, config)
        alarms = monitor.judge(summary, latency_ms)
        totals = [totals[0] + 1, totals[1] + bool(alarms), totals[2] + (latency_ms > options.deadline_ms)]
        line = {"sweep": name, "latency_ms": round(latency_ms, 1), **signals_of(summary), "alarms": alarms}
        print(json.dumps(line), flush=True)
    print(json.dumps(dict(zip(("sweeps", "with_alarms", "missed_deadlines"), totals, strict=True))))
    return int(totals[1] > 0)


if __name__ == "__main__":
    sys.exit(main())
