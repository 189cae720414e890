"""Seeded ray-cast street scenes with exact truth: no data needed, nothing left to a label's taste.

A scene is a terrain, vehicles made of convex pieces, and clutter. `scan` casts the beams of a spinning
sensor at it, `render_image` the pixels of a camera; the nearest surface wins, so occlusion is exact.
`make_sequence` drives the sensor through traffic whose motion is known in closed form.
"""

from jaxbox.synthetic.camera import make_calibration, render_image
from jaxbox.synthetic.scene import Clutter, Scene, Vehicle, make_scene
from jaxbox.synthetic.sequence import SequenceSweep, SyntheticSequence, TruthTracks, make_sequence
from jaxbox.synthetic.sweep import (
    SyntheticSweep,
    TruthBoxes,
    ground_only_sweep,
    make_sweep,
    no_ground_sweep,
    one_wall_sweep,
    scan,
)
from jaxbox.synthetic.terrain import Road, Terrain, make_terrain

__all__ = [
    "Clutter",
    "Road",
    "Scene",
    "SequenceSweep",
    "SyntheticSequence",
    "SyntheticSweep",
    "Terrain",
    "TruthBoxes",
    "TruthTracks",
    "Vehicle",
    "ground_only_sweep",
    "make_calibration",
    "make_scene",
    "make_sequence",
    "make_sweep",
    "make_terrain",
    "no_ground_sweep",
    "one_wall_sweep",
    "render_image",
    "scan",
]
