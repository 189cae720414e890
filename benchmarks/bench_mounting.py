"""Tilted sensors, and frames whose origin is not the sensor's: as they are, and seen upright from the sensor.

KITTI's sweeps are turned and moved, with their cameras. The boxes of each are scored where they should be.

    python -m benchmarks.bench_mounting --json benchmarks/results/mounting.json
"""

import argparse
import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks import common
from benchmarks.bench_beams import measure
from jaxbox import DetectorConfig
from jaxbox.evaluation.copies import Frame, labelled_frames
from jaxbox.geometry.mounting import Mounting, measure_mounting
from jaxbox.io import objects_from_detections, open_sweeps

CASES: dict[str, dict[str, float]] = {
    "as recorded": {},
    "pitched 2 degrees": {"pitch_deg": 2},
    "pitched 5": {"pitch_deg": 5},
    "pitched 10": {"pitch_deg": 10},
    "pitched 20": {"pitch_deg": 20},
    "rolled 5": {"roll_deg": 5},
    "rolled 10": {"roll_deg": 10},
    "origin on the ground": {"up_m": 1.73},
    "origin 1 m over the sensor": {"up_m": -1.0},
}
QUICK_FRAMES = 4


def moved(*, roll_deg: float = 0.0, pitch_deg: float = 0.0, up_m: float = 0.0) -> np.ndarray:
    """(4, 4) from the sensor's frame to one that is rolled, then pitched, about the sensor, and moved."""
    (sin_r, sin_p), (cos_r, cos_p) = (f(np.radians([roll_deg, pitch_deg])) for f in (np.sin, np.cos))
    roll = np.array([[1, 0, 0], [0, cos_r, -sin_r], [0, sin_r, cos_r]])
    pitch = np.array([[cos_p, 0, sin_p], [0, 1, 0], [-sin_p, 0, cos_p]])
    T = np.eye(4)
    T[:3, :3], T[2, 3] = pitch @ roll, up_m
    return T


def transformed(frame: Frame, T: np.ndarray) -> Frame:
    """A frame whose points, and whose camera, are seen from another frame."""
    xyz = (frame.xyz @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    T_rect = np.asarray(frame.calibration.T_rect_velo, np.float64) @ np.linalg.inv(T)
    calibration = dataclasses.replace(frame.calibration, T_rect_velo=jnp.asarray(T_rect, jnp.float32))
    return dataclasses.replace(frame, xyz=xyz, calibration=calibration)


def score(frames: Sequence[Frame], config: DetectorConfig) -> dict[str, float]:
    """The figures of `bench_beams` for cars."""
    results = {
        frame.name: objects_from_detections(
            common.detect(frame.xyz, frame.intensity, config), frame.calibration
        )
        for frame in frames
    }
    return measure({frame.name: frame.labels for frame in frames}, results)


def levelled(frame: Frame) -> Frame:
    """A frame seen upright, from a roof's height where its origin is on the ground."""
    mounting = measure_mounting(frame.xyz) or Mounting()
    return transformed(frame, mounting.raised().T_level_points)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = common.parser(__doc__ or "", quick=f"{QUICK_FRAMES} frames")
    options: argparse.Namespace = parser.parse_args(arguments)
    config = common.chosen_config(options)
    sweeps = open_sweeps(common.data_folder("kitti_object"))
    frames = labelled_frames(sweeps)
    if options.quick:
        frames = frames[:: len(frames) // QUICK_FRAMES]
    rows: list[dict[str, Any]] = []
    for name, case in CASES.items():
        seen = [transformed(frame, moved(**case)) for frame in frames]
        rows.append({"case": name, "seen": "as it is"} | score(seen, config))
        rows.append({"case": name, "seen": "upright"} | score([levelled(frame) for frame in seen], config))
    common.print_table(list(rows[0]), [list(row.values()) for row in rows])
    common.write_report({"num_frames": len(frames), "rows": rows}, options)


if __name__ == "__main__":
    main()
