"""Synthetic sweeps in KITTI's object layout, for the viewer's tests and its picture."""

import dataclasses
import pathlib

import numpy as np
from test_detector import street

from jaxbox import Label, io
from jaxbox.synthetic import SyntheticSweep
from jaxbox.viz import save_png


def write_kitti(
    folder: pathlib.Path, name: str, sweep: SyntheticSweep, *, pedestrian: bool = True
) -> pathlib.Path:
    """Writes points, calibration and image, and the truth in it as labels, the last one as a pedestrian."""
    truth = sweep.boxes
    types = [Label(int(label)).name.capitalize() for label in truth.label]
    found = io.objects_from_boxes(truth.center, truth.size, truth.yaw, sweep.calibration, types=types)
    objects = [item for item in found if item is not None]
    if pedestrian:
        objects[-1] = dataclasses.replace(objects[-1], type="Pedestrian")
    io.write_bin(folder / "velodyne" / f"{name}.bin", sweep.xyz, sweep.intensity)
    io.write_calibration(folder / "calib" / f"{name}.txt", sweep.calibration)
    io.write_labels(folder / "label_2" / f"{name}.txt", objects)
    if sweep.image is not None:
        save_png(folder / "image_2" / f"{name}.png", sweep.image)
    return folder


def write_three_streets(root: pathlib.Path) -> pathlib.Path:
    """Three sparse streets with grey images; the second one's points are cut off."""
    for seed in range(3):
        grey = np.full((375, 1242, 3), 90, np.uint8)
        write_kitti(root, f"{seed:06d}", dataclasses.replace(street(seed), image=grey))
    (root / "velodyne" / "000001.bin").write_bytes(b"cut off")
    return root
