"""What holds with a bus in the table of classes; `test_classes` runs it on a package that has one."""

import dataclasses
import pathlib
import sys

import numpy as np
from test_io_kitti import make_detections

import jaxbox
from jaxbox import DetectorConfig, Label, io, reference, synthetic, viz
from jaxbox.config.class_priors import classes_in_words
from jaxbox.config.fields import all_fields, config_from_toml, config_to_toml
from jaxbox.evaluation.matching import NEIGHBOURS
from jaxbox.io.foxglove import COLORS
from jaxbox.io.kitti import VEHICLE_TYPES, objects_from_detections
from jaxbox.synthetic.camera import make_calibration
from jaxbox.synthetic.scene import draw_size
from jaxbox.synthetic.solids import vehicle_solids
from jaxbox.types import Counts, GroundPlane


def check_config(bus):
    """Its prior is one of the configuration's, under names of its own."""
    config = DetectorConfig()
    assert (len(config.vehicles.classes), int(bus)) == (4, 3)
    assert config.vehicles.classes[bus] is bus.prior
    assert config_from_toml(config_to_toml(config)) == config
    assert all_fields(config)["vehicles.classes.3.length_m"] == bus.prior.length_m == 12.0
    longer = config_from_toml("[[vehicles.classes]]\n" * 4 + "length_m = 12.5").vehicles.classes
    assert [prior.length_m for prior in longer] == [3.9, 4.98, 8.5, 12.5]


def check_words(bus):
    """Summaries, files and pictures name it."""
    assert classes_in_words(np.array([3, 0, 3])) == "1 car, 2 buses"
    assert classes_in_words(np.array([3])) == "1 bus"
    found = make_detections([[20, 0, -1]], [[12, 2.5, 3]], [0.3], [0.7], [bus])
    numbers = {field.name: np.int32(0) for field in dataclasses.fields(Counts)}
    per_map = np.zeros(len(DetectorConfig().clustering.maps), np.int32)
    numbers |= {"cells": per_map, "clusters": per_map}
    plane = GroundPlane(np.zeros(3), np.bool_(True), np.int32(0))
    found = dataclasses.replace(found, counts=Counts(**numbers), ground=plane)
    assert io.detections_record("a", found)["boxes"][0]["label"] == "bus"
    assert viz.BoxSet.from_detections(found, min_score=0.0).captions == ("bus 0.70",)
    assert jaxbox.summarise(found).boxes == {"car": 0, "van": 0, "truck": 0, "bus": 1}
    (item,) = objects_from_detections(found, make_calibration())
    io.write_labels("a.txt", [item])
    assert pathlib.Path("a.txt").read_text().startswith("Bus ")
    assert "Bus" in VEHICLE_TYPES
    assert "bus" in NEIGHBOURS["car"]
    assert COLORS["bus"] not in [COLORS[label.word] for label in Label if label is not bus]


def check_synthetic(bus):
    """It can stand in a street, and the reference takes it for a class."""
    rng = np.random.default_rng(0)
    lengths = [draw_size(rng, bus)[0] for _ in range(400)]
    assert np.isclose(np.mean(lengths), bus.prior.length_m, rtol=0.02)
    assert vehicle_solids(bus, draw_size(rng, bus))
    sweep = synthetic.make_sweep(0, num_beams=16, num_azimuths=256)
    assert set(reference.detect(sweep.xyz).label) <= set(Label)


def check_detection(bus):
    """The compiled detector tries it, and calls a box so that no other class fits."""
    sweep = synthetic.make_sweep(3, num_beams=32, num_azimuths=512)
    cloud = jaxbox.PointCloud.from_numpy(sweep.xyz, capacity=2**14)
    found = jaxbox.detect(cloud).on_host()
    assert found.valid.any()
    assert set(found.label[found.valid]) <= set(Label)
    # As if nothing else drove there: what was a car is taken for the only class that has a car's size.
    config = DetectorConfig()
    car, *others, _ = config.vehicles.classes
    nothing = [dataclasses.replace(prior, prior_weight=0.0) for prior in (car, *others)]
    vehicles = dataclasses.replace(config.vehicles, classes=(*nothing, car), large_height_m=0.5)
    found = jaxbox.detect(cloud, dataclasses.replace(config, vehicles=vehicles)).on_host()
    assert found.valid.any()
    assert set(found.label[found.valid]) == {bus}


if __name__ == "__main__":
    assert jaxbox.__file__.startswith(sys.argv[1]), jaxbox.__file__
    for check in (check_config, check_words, check_synthetic, check_detection):
        check(Label["BUS"])
