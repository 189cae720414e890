"""Whether the status doubts a sweep that weather, a failing sensor or a wrong origin spoils, and no other."""

import dataclasses

import numpy as np
import pytest

from jaxbox import DetectorConfig, PointCloud, Status, detect, reference, summarise, synthetic
from jaxbox.config import HealthConfig
from jaxbox.evaluation.corruptions import CORRUPTIONS
from jaxbox.synthetic.situations import SITUATIONS

CAPACITY = 2**17
"""For which other tests compile the default preset too."""
DOUBTS = Status.DEGRADED | Status.DOUBTFUL_GROUND


@pytest.fixture(scope="module")
def street():
    return synthetic.make_sweep(0, num_azimuths=900).xyz


def answer(xyz, **limits):
    config = dataclasses.replace(DetectorConfig(), health=HealthConfig(**limits))
    return detect(PointCloud.from_numpy(xyz, capacity=CAPACITY), config)


def doubts(xyz, **limits):
    return Status(int(answer(xyz, **limits).status)) & DOUBTS


def spoiled(xyz, kind, amount):
    none = np.zeros(len(xyz), np.float32)
    of_points = CORRUPTIONS[kind].of_points
    assert of_points is not None
    return of_points(xyz, none, amount, np.random.default_rng(0))[0]


def test_a_clear_sweep_is_not_doubted(street):
    assert doubts(street) == Status.OK


def test_a_low_sensor_sees_less_far_and_is_not_doubted_for_it():
    [(xyz, _)] = next(s for s in SITUATIONS if s.name == "sensor 0.6 m high").sweeps(num_azimuths=900)
    assert np.hypot(xyz[:, 0], xyz[:, 1]).max() < HealthConfig().far_m
    assert doubts(xyz) == Status.OK
    assert doubts(xyz, far_m=400.0) == Status.DEGRADED


@pytest.mark.parametrize(
    ("kind", "amount", "off"),
    [
        ("fog", 50, {"min_far_share": 0.0}),
        ("rain", 20, {"min_far_share": 0.0, "max_rough_share": 1.0}),
        ("snow", 0.1, {"max_scattered_share": 1.0}),
        ("clutter", 0.1, {"max_scattered_share": 1.0}),
        ("noise", 0.3, {"max_scattered_share": 1.0, "max_rough_share": 1.0}),
    ],
)
def test_weather_and_noise_degrade_a_sweep_by_the_limit_that_is_meant_for_them(street, kind, amount, off):
    xyz = spoiled(street, kind, amount)
    assert doubts(xyz) == Status.DEGRADED
    assert doubts(xyz, **off) == Status.OK


TILT = np.array([[np.cos(0.14), 0, np.sin(0.14)], [0, 1, 0], [-np.sin(0.14), 0, np.cos(0.14)]])


@pytest.mark.parametrize(
    ("move", "off"),
    [
        (lambda xyz: xyz - [0, 0, 4], {"max_sensor_height_m": 9.0}),
        (lambda xyz: xyz @ TILT, {"max_tilt_deg": 11.0}),
        (lambda xyz: xyz + np.array([10, 0, 0]), {"max_under_share": 1.0}),
    ],
)
def test_ground_that_lies_where_no_road_does_is_doubted(street, move, off):
    xyz = move(street).astype(np.float32)
    assert doubts(xyz) == Status.DOUBTFUL_GROUND
    assert doubts(xyz, **off) == Status.OK


def test_the_summary_has_the_figures_that_the_limits_are_for(street):
    clear, snow = (summarise(answer(xyz)).returns for xyz in (street, spoiled(street, "snow", 0.1)))
    rho = np.hypot(*street[:, :2].T)
    assert clear.far_share == pytest.approx((rho > HealthConfig().far_m).mean(), abs=1e-6)
    assert clear.scattered_share < HealthConfig().max_scattered_share < snow.scattered_share
    assert 0 < clear.rough_share < HealthConfig().max_rough_share
    assert clear.points_under == 0


FIGURES = (
    "far_points",
    "scattered_azimuths",
    "near_ground_points",
    "rough_points",
    "points_under",
    "points_below",
)


@pytest.mark.parametrize("height_m", ["0.6", "1"])
def test_a_road_below_the_ground_that_was_found_is_doubted(height_m):
    [(xyz, _)] = next(s for s in SITUATIONS if s.name == f"cars on a platform of {height_m} m").sweeps(
        num_azimuths=900
    )
    detections = answer(xyz)
    assert Status.DOUBTFUL_GROUND in Status(int(detections.status))
    assert summarise(detections).returns.below_share > 2 * HealthConfig().max_below_share
    assert Status.DOUBTFUL_GROUND not in doubts(xyz, max_below_share=1.0)


@pytest.mark.parametrize("kind", ["clear", "snow", "mirrored", "from below", "from a mast"])
def test_the_reference_counts_the_same(street, kind):
    amount = {"snow": 0.1, "mirrored": 0.03}.get(kind)
    xyz = street if amount is None else spoiled(street, kind, amount)
    # Turned, as the beams of the street lie on the edges of azimuth cells.
    cos, sin = np.cos(0.001), np.sin(0.001)
    xyz = xyz @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    up_m = {"from below": 1.0, "from a mast": -8.0}.get(kind, 0.0)
    xyz = (xyz + np.array([0, 0, up_m])).astype(np.float32)
    ours, theirs = answer(xyz).counts, reference.detect(xyz).counts
    for name in FIGURES:
        # Planes differ in their last digits, and with them what lies on a border.
        assert int(getattr(ours, name)) == pytest.approx(theirs[name], rel=0.001, abs=1), name
    assert int(ours.far_points) > 0
    assert (int(ours.points_under) > 0) == (kind == "from a mast")
    assert (int(ours.points_below) > 0.01 * len(xyz)) == (kind == "mirrored")
