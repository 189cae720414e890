"""Objectives to choose settings by: those of the protocol, of any frames of any settings."""

import dataclasses

import numpy as np
import pytest
from kitti_objects import car

from jaxbox.evaluation import kitti
from jaxbox.evaluation.objectives import OBJECTIVES

SEEDS = range(4)


def random_frames(seed, count=12):
    """Labels and noisy detections, with some missed and some made up."""
    rng = np.random.default_rng(seed)
    labels, results = {}, {}
    for index in range(count):
        cars = [car(right=5.0 * i, occlusion=int(rng.integers(0, 4))) for i in range(rng.integers(0, 4))]
        found = [
            dataclasses.replace(
                item, location=item.location + rng.normal(0, 0.1, 3), score=float(rng.uniform(0.1, 1))
            )
            for item in cars
            if rng.uniform() < 0.8
        ]
        found += [car(right=40.0, score=float(rng.uniform()))] * int(rng.integers(0, 2))
        labels[f"{index:06d}"], results[f"{index:06d}"] = cars, found
    return labels, results


@pytest.mark.parametrize("seed", SEEDS)
def test_each_objective_is_the_protocols_own_figure(seed):
    labels, results = random_frames(seed)
    evaluation = kitti.evaluate(labels, results, min_overlap={"Car": 0.7})
    expected = {
        "soft": kitti.soft_score(labels, results),
        "3d": evaluation.curve("Car", "3d", "moderate").r40,
        "bev": evaluation.curve("Car", "bev", "moderate").r40,
    }
    assert min(expected.values()) > 0
    for name, objective in OBJECTIVES.items():
        found = objective.score(objective.match(labels, results).values())
        assert found == pytest.approx(expected[name], abs=1e-9), name


@pytest.mark.parametrize("seed", SEEDS)
def test_frames_matched_once_score_as_if_their_subset_were_evaluated_alone(seed):
    labels, results = random_frames(seed)
    objective = OBJECTIVES["soft"]
    matched = objective.match(labels, results)
    some = list(labels)[::2]
    alone = kitti.soft_score({name: labels[name] for name in some}, {name: results[name] for name in some})
    assert objective.score(matched[name] for name in some) == pytest.approx(alone, abs=1e-9)


def test_no_frames_and_frames_without_labels_score_nothing():
    objective = OBJECTIVES["soft"]
    assert objective.score([]) == 0
    assert objective.score(objective.match({"a": []}, {"a": [car(score=0.5)]}).values()) == 0
