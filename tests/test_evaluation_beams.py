"""Which beam made a point, and sweeps as a sensor of fewer beams would have seen them."""

import numpy as np
import pytest

from jaxbox.evaluation import beam_of_points, thin_beams
from jaxbox.io import open_sweeps
from jaxbox.synthetic import make_sweep
from jaxbox.synthetic.sweep import beam_directions


def elevation_deg(xyz):
    return np.degrees(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))


@pytest.mark.parametrize("num_beams", [16, 64])
def test_beams_are_those_that_were_cast(num_beams):
    xyz = make_sweep(1, num_beams=num_beams, num_azimuths=240).xyz
    cast = np.degrees(np.arcsin(beam_directions(num_beams, 1)[:, 2]))
    truth = np.abs(elevation_deg(xyz)[:, None] - cast).argmin(axis=1)
    # Range noise moves a point along its beam, never to another one.
    np.testing.assert_array_equal(beam_of_points(xyz), truth)


def test_real_sweeps_have_64_beams_each_lower_than_the_one_before(data_root):
    sweeps = [sweep for name in ("kitti_object", "semantic_kitti") for sweep in open_sweeps(data_root / name)]
    for sweep in sweeps:
        xyz, _ = sweep.read_points()
        beam = beam_of_points(xyz)
        assert beam.max() == 63, sweep.name
        middles = [np.median(elevation_deg(xyz[beam == k])) for k in range(64)]
        assert np.all(np.diff(middles) < 0), sweep.name


def test_the_direction_of_the_turn_and_bad_points_do_not_matter():
    xyz = make_sweep(1, num_beams=16, num_azimuths=240).xyz
    beam = beam_of_points(xyz)
    np.testing.assert_array_equal(beam_of_points(xyz[::-1]), (beam.max() - beam)[::-1])
    holes = np.insert(xyz, [0, 500], np.nan, axis=0)
    np.testing.assert_array_equal(np.delete(beam_of_points(holes), [0, 501]), beam)
    assert beam_of_points(np.zeros((0, 3))).shape == (0,)


def test_thinning_keeps_whole_beams_and_every_beam_once():
    xyz = make_sweep(1, num_beams=64, num_azimuths=240).xyz
    beam = beam_of_points(xyz)
    parts = [thin_beams(xyz, num_beams=64, keep_every=4, first=first) for first in range(4)]
    np.testing.assert_array_equal(np.sum(parts, axis=0), 1)
    for first, kept in enumerate(parts):
        assert np.unique(beam[kept]).tolist() == list(range(first, 64, 4))
    assert thin_beams(xyz, num_beams=64, keep_every=1).all()


def test_a_sweep_in_another_order_is_refused():
    xyz = make_sweep(1, num_beams=64, num_azimuths=240).xyz
    shuffled = np.random.default_rng(0).permutation(xyz)
    with pytest.raises(ValueError, match="not in the order of beams"):
        thin_beams(shuffled, num_beams=64, keep_every=2)
    with pytest.raises(ValueError, match="not in the order of beams"):
        thin_beams(xyz, num_beams=32, keep_every=2)
    for keep_every, first in ((0, 0), (2, 2), (2, -1)):
        with pytest.raises(ValueError, match=f"keep_every is {keep_every} and first {first}"):
            thin_beams(xyz, num_beams=64, keep_every=keep_every, first=first)
