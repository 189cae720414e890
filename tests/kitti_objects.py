"""KITTI objects that several tests of the evaluation are about."""

import dataclasses

import numpy as np

from jaxbox.io import KittiObject


def car(right=0.0, forward=20.0, *, score=None, **changes) -> KittiObject:
    """A fully visible car 60 px high; in the image cars that are 5 m apart do not overlap."""
    left = 600 + 40 * right
    item = KittiObject(
        type="Car",
        truncation=0.0,
        occlusion=0,
        alpha=0.0,
        box_px=np.array([left, 170.0, left + 100, 230.0]),
        height=1.5,
        width=1.6,
        length=3.9,
        location=np.array([right, 1.7, forward]),
        rotation_y=0.0,
        score=score,
    )
    return dataclasses.replace(item, **changes)
