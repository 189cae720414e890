"""Corrupted sweeps: nothing at the amount "none", more at each severity, the same again for the same seed."""

import itertools
import math

import numpy as np
import pytest

from jaxbox import synthetic
from jaxbox.evaluation import corruptions
from jaxbox.evaluation.beams import beam_of_points
from jaxbox.evaluation.corruptions import CORRUPTIONS

OF_POINTS = sorted(name for name, kind in CORRUPTIONS.items() if kind.of_points)
OF_CALIBRATION = sorted(name for name, kind in CORRUPTIONS.items() if kind.of_calibration)
NUM_BEAMS = 64


@pytest.fixture(scope="module")
def sweep():
    return synthetic.make_sweep(3, num_azimuths=300, dropout=0.0)


def corrupted(name, sweep, amount, seed=0):
    return CORRUPTIONS[name].of_points(sweep.xyz, sweep.intensity, amount, np.random.default_rng(seed))


def ranges(xyz):
    return np.linalg.norm(xyz.astype(float), axis=1)


@pytest.mark.parametrize("name", OF_POINTS)
def test_the_amount_that_is_none_changes_nothing(name, sweep):
    xyz, intensity = corrupted(name, sweep, CORRUPTIONS[name].none)
    np.testing.assert_array_equal(xyz, sweep.xyz)
    np.testing.assert_array_equal(intensity, sweep.intensity)


@pytest.mark.parametrize("name", OF_POINTS)
def test_every_severity_is_seeded_finite_float32_and_adds_no_point(name, sweep):
    for amount in CORRUPTIONS[name].amounts:
        xyz, intensity = corrupted(name, sweep, amount)
        again = corrupted(name, sweep, amount)
        np.testing.assert_array_equal(xyz, again[0])
        np.testing.assert_array_equal(intensity, again[1])
        assert xyz.dtype == intensity.dtype == np.float32
        assert xyz.shape == (len(intensity), 3)
        assert 0 < len(xyz) <= len(sweep.xyz)
        assert np.isfinite(xyz).all()
        assert np.isfinite(intensity).all()


@pytest.mark.parametrize("name", ["beams", "dropout", "fog", "rain"])
def test_each_severity_leaves_fewer_points(name, sweep):
    counts = [len(sweep.xyz), *(len(corrupted(name, sweep, a)[0]) for a in CORRUPTIONS[name].amounts)]
    assert all(after < before for before, after in itertools.pairwise(counts))


@pytest.mark.parametrize(
    "name", ["noise", "clutter", "snow", "spray", "reflections", "mirrored", "speed", "turning"]
)
def test_each_severity_moves_points_farther(name, sweep):
    moved = [
        np.linalg.norm(corrupted(name, sweep, a)[0] - sweep.xyz, axis=1).mean()
        for a in CORRUPTIONS[name].amounts
    ]
    assert moved[0] > 0
    assert all(after > before for before, after in itertools.pairwise(moved))


@pytest.mark.parametrize("name", ["noise", "fog", "rain", "snow", "spray", "clutter", "dropout"])
def test_another_seed_draws_otherwise(name, sweep):
    amount = CORRUPTIONS[name].amounts[2]
    assert not np.array_equal(corrupted(name, sweep, amount)[0], corrupted(name, sweep, amount, seed=1)[0])


def test_five_severities_that_go_from_none_one_way():
    for kind in CORRUPTIONS.values():
        steps = np.diff([1e9 if math.isinf(kind.none) else kind.none, *kind.amounts])
        assert len(kind.amounts) == 5
        assert np.all(steps > 0) or np.all(steps < 0)
        assert (kind.of_points is None) != (kind.of_calibration is None)


def test_thin_beams_keeps_the_lowest_beam_and_its_share(sweep):
    beam = beam_of_points(sweep.xyz)
    for one_in in (2, 4, 16):
        xyz, _ = corrupted("beams", sweep, one_in)
        kept = np.unique(beam_of_points(xyz))
        assert len(kept) == (beam.max() + 1) // one_in
    lowest = sweep.xyz[beam == NUM_BEAMS - 1]
    np.testing.assert_array_equal(corrupted("beams", sweep, 16)[0][-len(lowest) :], lowest)


def test_lost_points_are_the_share(sweep):
    left = len(corrupted("dropout", sweep, 0.75)[0]) / len(sweep.xyz)
    assert left == pytest.approx(0.25, abs=4 * math.sqrt(0.75 * 0.25 / len(sweep.xyz)))


def test_range_noise_has_the_deviation_and_keeps_directions(sweep):
    xyz, _ = corrupted("noise", sweep, 0.1)
    before, after = ranges(sweep.xyz), ranges(xyz)
    assert np.std(after - before) == pytest.approx(0.1, rel=0.03)
    np.testing.assert_allclose(xyz / after[:, None], sweep.xyz / before[:, None], atol=1e-6)


def test_fog_takes_the_far_first_and_what_it_gives_back_lies_before_the_surface(sweep):
    visibility_m = 100
    rng = np.random.default_rng(0)
    near, far = np.full((4000, 3), [10.0, 0, 0]), np.full((4000, 3), [60.0, 0, 0])
    kept_near = corruptions.add_fog(near, np.ones(4000), visibility_m, rng)[0]
    xyz, intensity = corruptions.add_fog(far, np.ones(4000), visibility_m, rng)
    alpha = math.log(20) / visibility_m
    least = (10 / corruptions.REACH_M) ** 2
    seen = (1 - least * math.exp(2 * alpha * 10)) / (1 - least)
    at_surface = np.isclose(kept_near[:, 0], 10)
    assert at_surface.sum() / 4000 == pytest.approx(seen, abs=0.01)
    # At 60 m even what reflects everything is too weak: only the fog itself returns.
    assert np.all((xyz[:, 0] >= corruptions.MIN_RANGE_M) & (xyz[:, 0] < 60))
    assert len(xyz) / 4000 == pytest.approx(corruptions.BACKSCATTER_SHARE, abs=0.03)
    assert np.all(intensity == 0)
    # The mean of exp(-2 alpha r) from 2 to 60 m.
    width = 60 - corruptions.MIN_RANGE_M
    mean = 1 / (2 * alpha) - width / math.expm1(2 * alpha * width)
    assert np.mean(xyz[:, 0] - corruptions.MIN_RANGE_M) == pytest.approx(mean, rel=0.1)


def test_clutter_is_the_share_of_beams_and_nearer_than_the_surface(sweep):
    xyz, intensity = corrupted("clutter", sweep, 0.2)
    shorter = ranges(xyz) < ranges(sweep.xyz) - 1e-4
    able = ranges(sweep.xyz) > corruptions.MIN_RANGE_M
    assert shorter.sum() / able.sum() == pytest.approx(0.2, abs=0.02)
    assert np.all(intensity[shorter] == 0)
    np.testing.assert_allclose(ranges(xyz)[~shorter], ranges(sweep.xyz)[~shorter], rtol=1e-5)
    assert ranges(xyz)[shorter].min() >= corruptions.MIN_RANGE_M - 1e-4


def test_rain_takes_the_far_and_blurs_the_others_by_their_range():
    far, near = np.full((4000, 3), [100.0, 0, 0]), np.full((4000, 3), [0.0, 20.0, 0])
    rng, rate_mm_h = np.random.default_rng(0), 1.0
    left, weaker = corruptions.add_rain(near, np.ones(4000), rate_mm_h, rng)
    assert len(corruptions.add_rain(far, np.ones(4000), 20.0, rng)[0]) == 0
    std_m = corruptions.RAIN_NOISE * 20 * (1 - math.exp(-rate_mm_h)) ** 2
    assert np.std(left[:, 1]) == pytest.approx(std_m, rel=0.05)
    np.testing.assert_allclose(weaker, math.exp(-2 * corruptions.RAIN_EXTINCTION * 20), rtol=1e-5)


def test_snow_returns_near_the_sensor_from_no_more_than_the_share():
    distant = np.full((4000, 3), [60.0, 0, 0])
    xyz, intensity = corruptions.add_snow(distant, np.ones(4000), 0.3, np.random.default_rng(0))
    flakes = intensity == 0
    assert flakes.mean() == pytest.approx(0.3, abs=0.03)
    assert xyz[flakes, 0].min() >= corruptions.MIN_RANGE_M
    beyond_m = xyz[flakes, 0].mean() - corruptions.MIN_RANGE_M
    assert beyond_m == pytest.approx(corruptions.SNOW_RANGE_M, rel=0.1)
    np.testing.assert_array_equal(xyz[~flakes], distant[~flakes])


def test_spray_returns_from_within_its_plumes_alone(sweep):
    xyz, intensity = corruptions.add_spray(sweep.xyz, np.ones(len(sweep.xyz)), 1, np.random.default_rng(0))
    drops = xyz[intensity == 0]
    assert len(drops) > 10
    assert np.ptp(drops, axis=0).max() <= 2 * corruptions.PLUME_RADIUS_M
    assert abs(drops[:, 2] - corruptions.PLUME_Z_M).max() <= corruptions.PLUME_RADIUS_M
    np.testing.assert_allclose(xyz[intensity > 0], sweep.xyz[intensity > 0], rtol=1e-6)


def test_images_lie_below_the_road_as_far_as_things_above_it_on_beams_that_met_it(sweep):
    xyz, intensity = corrupted("mirrored", sweep, 0.02)
    moved = (xyz != sweep.xyz).any(axis=1)
    assert moved.sum() == round(0.02 * len(xyz))
    np.testing.assert_array_equal(intensity, sweep.intensity)
    met, image = sweep.xyz[moved].astype(float), xyz[moved].astype(float)
    assert (met[:, 2] < -corruptions.ROAD_BELOW_M).all()
    road_z = np.median(sweep.xyz[sweep.xyz[:, 2] < -corruptions.ROAD_BELOW_M, 2])
    assert (image[:, 2] < road_z - corruptions.MIRRORED_FROM_M + 1e-4).all()
    # Each is the image of a point of the sweep, seen where the beam went, beyond the road.
    things = image * [1, 1, -1] + [0, 0, 2 * road_z]
    assert max(np.linalg.norm(sweep.xyz - thing, axis=1).min() for thing in things) < 1e-3
    cosine = (met * image).sum(axis=1) / (ranges(met) * ranges(image))
    assert np.arccos(np.minimum(cosine, 1)).max() < 1.01 * corruptions.SAME_BEAM_RAD
    assert (ranges(image) > ranges(met)).mean() > 0.9


def test_motion_leaves_what_is_straight_ahead_and_carries_the_sides_by_the_way_gone():
    xyz = np.array([[10, 0, 0], [0, 10, 0], [0, -10, 0]], np.float32)
    driven, _ = corruptions.drive_during_sweep(xyz, np.zeros(3), 20.0, np.random.default_rng(0))
    # A quarter turn is a fortieth of a second: half a metre at 20 m/s, before or after.
    np.testing.assert_allclose(driven, [[10, 0, 0], [-0.5, 10, 0], [0.5, -10, 0]], atol=1e-5)
    turned, _ = corruptions.turn_during_sweep(xyz, np.zeros(3), 40.0, np.random.default_rng(0))
    # One degree clockwise for what comes a quarter turn later, since the ego vehicle turned left by it.
    sin, cos = math.sin(math.radians(1)), math.cos(math.radians(1))
    expected = [[10, 0, 0], [10 * sin, 10 * cos, 0], [10 * sin, -10 * cos, 0]]
    np.testing.assert_allclose(turned, expected, atol=1e-5)


@pytest.mark.parametrize("name", OF_CALIBRATION)
def test_a_corrupted_calibration_is_rigid_and_off_by_the_amount(name):
    clean = np.asarray(synthetic.make_calibration().T_rect_velo, np.float64)
    kind = CORRUPTIONS[name]
    unchanged = kind.of_calibration(clean, kind.none, np.random.default_rng(0))
    np.testing.assert_allclose(unchanged, clean, atol=1e-7)
    for amount in kind.amounts:
        off = kind.of_calibration(clean, amount, np.random.default_rng(0))
        error = np.linalg.inv(clean) @ off.astype(float)
        np.testing.assert_allclose(error[:3, :3] @ error[:3, :3].T, np.eye(3), atol=1e-6)
        angle = math.degrees(math.acos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)))
        shift = np.linalg.norm(error[:3, 3])
        assert (angle if kind.unit == "degrees" else shift) == pytest.approx(amount, rel=1e-2)
        assert (shift if kind.unit == "degrees" else angle) == pytest.approx(0, abs=0.03)


def test_reflections_lie_below_the_road_on_their_beams(sweep):
    share = 0.01
    xyz, _ = corrupted("reflections", sweep, share)
    moved = np.flatnonzero((xyz != sweep.xyz).any(axis=1))
    assert len(moved) == round(share * len(sweep.xyz))
    before, after = sweep.xyz[moved].astype(float), xyz[moved].astype(float)
    cosine = (before * after).sum(axis=1) / ranges(before) / ranges(after)
    np.testing.assert_allclose(cosine, 1, atol=1e-6)
    depth = before[:, 2] - after[:, 2]
    low, high = corruptions.REFLECTION_DEPTHS_M
    assert ((depth > low - 1e-5) & (depth < high + 1e-5)).all()
