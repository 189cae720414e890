"""Turned and mirrored copies: turning back undoes turning, for boxes as for points."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxbox
from jaxbox import synthetic
from jaxbox.evaluation.copies import COPIES, Copy, turn_back, turn_points


@pytest.fixture(scope="module")
def detections():
    sweep = synthetic.make_sweep(0, num_azimuths=250)
    return jaxbox.detect(jaxbox.PointCloud.from_numpy(sweep.xyz, sweep.intensity))


def corners(center, size, yaw):
    """(K, 4, 2) corners from above, in any order."""
    half = np.asarray(size)[:, None, :2] / 2 * [[1, 1], [-1, 1], [-1, -1], [1, -1]]
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y = half[..., 0], half[..., 1]
    return np.asarray(center)[:, None, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


@pytest.mark.parametrize("copy", COPIES, ids=lambda copy: copy.name)
def test_a_box_turned_back_has_the_corners_of_the_recorded_sweep(copy, detections):
    count = int(detections.valid.sum())
    assert count > 0
    size = np.asarray(detections.size, np.float64)
    turned = corners(detections.center, size, np.asarray(detections.yaw, np.float64))
    back = turn_back(detections, copy)
    assert bool(jnp.all((back.yaw >= -np.pi / 2) & (back.yaw < np.pi / 2)))
    np.testing.assert_allclose(np.abs(np.sin(back.heading - back.yaw)), 0, atol=1e-5)
    ahead = np.stack([np.cos(back.heading), np.sin(back.heading), 0 * back.heading], axis=-1)
    expected = np.stack([np.cos(detections.heading), np.sin(detections.heading)], axis=-1)
    np.testing.assert_allclose(turn_points(ahead, copy)[:count, :2], expected[:count], atol=1e-5)
    found = corners(back.center, size, np.asarray(back.yaw, np.float64))
    for k in range(count):
        again = turn_points(np.c_[found[k], np.zeros(4)], copy)[:, :2]
        gaps = np.linalg.norm(again[:, None] - turned[k], axis=-1)
        assert gaps.min(axis=0).max() < 1e-4, "each corner comes back to where it was found"


def test_turning_keeps_distances_and_heights_and_mirrors_handedness():
    xyz = np.random.default_rng(0).normal(size=(20, 3)) * 30
    for copy in COPIES:
        turned = turn_points(xyz, copy).astype(float)
        np.testing.assert_allclose(turned @ turned.T, xyz @ xyz.T, atol=2e-2)
        np.testing.assert_allclose(turned[:, 2], xyz[:, 2], rtol=1e-6)
        side = np.sign(np.linalg.det(turned[:3])) * np.sign(np.linalg.det(xyz[:3]))
        assert side == (-1 if copy.mirrored else 1)


def test_the_copies_differ_and_begin_with_the_recorded_sweep():
    assert COPIES[0] == Copy()
    assert len({copy.name for copy in COPIES}) == len(COPIES)
    assert dataclasses.astuple(Copy()) == (0.0, False)
