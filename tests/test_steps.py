"""Laws of the single steps on arrays: they are the detector's own, and boxes hold their clusters."""

import chex
import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbox
from jaxbox import DetectorConfig, synthetic
from jaxbox.config import ClusteringConfig, ComponentMap
from jaxbox.run import steps

# The smallest capacity, whose compiled detector other tests use too.
NUM_AZIMUTHS = 250


@pytest.fixture(scope="module")
def xyz():
    return synthetic.make_sweep(6, num_azimuths=NUM_AZIMUTHS).xyz


@pytest.fixture(scope="module")
def found(xyz):
    return jaxbox.detect(xyz)


@pytest.fixture(scope="module")
def split(xyz):
    return jaxbox.remove_ground(xyz)


@pytest.fixture(scope="module")
def cluster(xyz):
    return jaxbox.cluster_points(xyz)


def test_the_ground_is_the_detectors(xyz, found, split):
    np.testing.assert_array_equal(split.is_ground, found.ground_mask[: len(xyz)])
    assert split.plane == found.ground
    assert split.is_ground.sum() == found.counts.ground_points
    assert split.is_obstacle.sum() == found.counts.obstacles
    assert not (split.is_ground & split.is_obstacle).any()


def test_heights_are_over_the_ground_of_the_scene(split):
    truth = synthetic.make_sweep(6, num_azimuths=NUM_AZIMUTHS).is_ground
    assert np.abs(np.nanmedian(split.height_m[truth])) < 0.05
    assert (split.is_ground == truth).mean() > 0.95


def test_points_that_are_nowhere_have_no_height(xyz):
    odd = np.concatenate([xyz[:500], [[np.nan, 0, 0], [500, 0, 0], [np.inf, 0, 0]]])
    result = jaxbox.remove_ground(odd)
    assert len(result.is_ground) == len(odd)
    assert np.isnan(result.height_m[-3:]).all()
    assert not (result.is_ground | result.is_obstacle)[-3:].any()


def test_clusters_are_the_detectors_components_of_obstacles(xyz, found, split, cluster):
    np.testing.assert_array_equal(cluster, found.point_component[: len(xyz)])
    assert cluster.dtype == np.int32
    assert (cluster[~split.is_obstacle] == -1).all()
    assert (cluster >= 0).sum() > 1000


def test_a_box_holds_its_cluster_and_touches_it_on_all_sides(xyz, cluster):
    boxes = jaxbox.fit_boxes(xyz)
    assert boxes == jaxbox.fit_boxes(xyz, cluster)
    np.testing.assert_array_equal(boxes.cluster, np.unique(cluster[cluster >= 0]))
    assert (boxes.size[:, 0] >= boxes.size[:, 1]).all()
    assert ((boxes.yaw >= -np.pi / 2) & (boxes.yaw < np.pi / 2)).all()
    for number, center, size, yaw, count in zip(*vars(boxes).values(), strict=True):
        points = xyz[cluster == number].astype(np.float64) - center
        assert len(points) == count
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        local = points @ turn
        np.testing.assert_allclose(local.max(axis=0), size / 2, atol=1e-6)
        np.testing.assert_allclose(local.min(axis=0), -size / 2, atol=1e-6)


def test_the_smallest_rectangle_is_opencvs(xyz, cluster):
    """To within the step of the rotations, one degree."""
    large = [number for number in np.unique(cluster[cluster >= 0]) if (cluster == number).sum() >= 20]
    assert len(large) > 5
    boxes = jaxbox.fit_boxes(xyz, np.where(np.isin(cluster, large), cluster, -1), "paper")
    for number, size in zip(boxes.cluster, boxes.size, strict=True):
        _, sides, _ = cv2.minAreaRect(xyz[cluster == number, :2])
        area = np.prod(sides)
        length, width = max(sides), min(sides)
        slack = np.radians(1.0) * (length**2 + width**2)
        assert area - 1e-3 <= size[0] * size[1] <= area + slack


def test_a_turned_car_is_found_turned():
    """Two sides of a box of 4 by 2 m, seen from the sensor, at several angles."""
    along, across = np.linspace(-2, 2, 60), np.linspace(-1, 1, 30)
    sides = np.concatenate(
        [np.stack([along, -np.ones(60)], axis=1), np.stack([-2 * np.ones(30), across], axis=1)]
    )
    for degrees in (-80, -45, -10, 0, 25, 60):
        yaw = np.radians(degrees)
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        center = turn @ [12.0, 8.0]
        xyz = np.column_stack([sides @ turn.T + center, np.linspace(-1.6, -0.2, 90)])
        boxes = jaxbox.fit_boxes(xyz, np.full(90, 7))
        assert boxes.cluster.tolist() == [7]
        assert np.degrees(boxes.yaw[0]) == pytest.approx(degrees, abs=0.6)
        np.testing.assert_allclose(boxes.size[0], [4, 2, 1.4], atol=0.1)
        np.testing.assert_allclose(boxes.center[0], [*center, -0.9], atol=0.1)


def test_numbers_of_clusters_may_be_any_and_order_does_not_matter(xyz, cluster):
    boxes = jaxbox.fit_boxes(xyz, cluster)
    renamed = jaxbox.fit_boxes(xyz, np.where(cluster >= 0, 10 * cluster.astype(np.int64) + 3, -5))
    np.testing.assert_array_equal(renamed.cluster, 10 * boxes.cluster + 3)
    np.testing.assert_array_equal(renamed.center, boxes.center)
    turned = jaxbox.fit_boxes(xyz[::-1], cluster[::-1])
    few = boxes.num_points <= DetectorConfig().box.max_points
    # Of larger clusters other points are looked at.
    np.testing.assert_allclose(turned.size[few], boxes.size[few], atol=0.3)
    np.testing.assert_array_equal(turned.num_points, boxes.num_points)


def test_steps_of_other_lengths_trace_nothing(xyz, monkeypatch):
    for name in ("_find_ground", "_find_clusters", "_find_angles"):
        once = chex.assert_max_traces(getattr(steps, name).__wrapped__, n=1)
        monkeypatch.setattr(steps, name, jax.jit(once))
    for stop in (len(xyz), len(xyz) - 7, len(xyz) // 2):
        jaxbox.remove_ground(xyz[:stop], key=stop)
        jaxbox.fit_boxes(jnp.asarray(xyz[:stop]))


def test_nothing_gives_nothing():
    nothing = np.zeros((0, 3))
    assert jaxbox.remove_ground(nothing).is_ground.shape == (0,)
    assert jaxbox.cluster_points(nothing).shape == (0,)
    boxes = jaxbox.fit_boxes(nothing)
    assert len(boxes) == 0
    assert boxes.center.shape == boxes.size.shape == (0, 3)


def test_what_cannot_be_used_is_refused_with_what_to_do(xyz, cluster, monkeypatch):
    for call in (jaxbox.remove_ground, jaxbox.cluster_points, jaxbox.fit_boxes):
        with pytest.raises(ValueError, match=r"\(n, 3\)"):
            call(xyz[:, :2])
        with pytest.raises(ValueError, match="is not a preset"):
            call(xyz, config="papr")
        with pytest.raises(TypeError, match=r"takes none inside jax\.jit or jax\.vmap\.\n"):
            jax.jit(call)(xyz)
        with pytest.raises(TypeError, match=r"an array and no PointCloud: cloud\.xyz1\["):
            call(jaxbox.PointCloud.from_numpy(xyz))
        with pytest.raises(TypeError, match="real numbers; this is NoneType"):
            call(None)
    with pytest.raises(ValueError, match="1048576 points at most"):
        jaxbox.remove_ground(np.zeros((2**20 + 1, 3), np.float32))
    for wrong in (cluster[1:], cluster.astype(float)):
        with pytest.raises(ValueError, match="-1 for none"):
            jaxbox.fit_boxes(xyz, wrong)
    with pytest.raises(ValueError, match="not finite"):
        jaxbox.fit_boxes(np.full((4, 3), np.nan), np.zeros(4, int))


def test_a_capacity_that_is_too_small_is_named(xyz):
    small = DetectorConfig(
        clustering=ClusteringConfig(maps=(ComponentMap(max_cells=10), ComponentMap(), ComponentMap()))
    )
    with pytest.raises(RuntimeError, match=r"max_cells must be at least \[\d\d+, "):
        jaxbox.cluster_points(xyz, small)
