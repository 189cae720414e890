"""Laws of the data: how a sweep is taken in, and what the status bits say."""

import dataclasses
import functools
import itertools
import operator
import re

import jax
import numpy as np
import parity
import pytest

from jaxbox import Label, PointCloud, Status, stack_clouds, summarise
from jaxbox._padding import CAPACITY_BUCKETS
from jaxbox.config import (
    BoxConfig,
    ClusteringConfig,
    CompletionConfig,
    ComponentMap,
    DetectorConfig,
    EvidenceConfig,
    FilterConfig,
    GroundConfig,
    HullConfig,
    VehicleConfig,
)
from jaxbox.config.capacities import CAPACITIES
from jaxbox.synthetic import make_sweep

POINTS = np.random.default_rng(0).normal(0, 20, (50, 3)).astype(np.float32)


def rows(cloud):
    return np.asarray(cloud.xyz1)[:, :3], np.asarray(cloud.xyz1)[:, 3], np.asarray(cloud.intensity)


def test_a_cloud_holds_the_points_then_zeros():
    intensity = np.arange(50) / 50
    xyz, one, brightness = rows(PointCloud.from_numpy(POINTS, intensity, capacity=64))
    np.testing.assert_array_equal(xyz[:50], POINTS)
    np.testing.assert_array_equal(brightness[:50], intensity.astype(np.float32))
    np.testing.assert_array_equal(one, np.arange(64) < 50)
    assert not xyz[50:].any()
    assert not brightness[50:].any()


def test_a_cloud_has_the_documented_types_and_true_count():
    cloud = PointCloud.from_numpy(POINTS)
    assert (cloud.xyz1.dtype, cloud.intensity.dtype, cloud.num_points.dtype) == (
        "float32",
        "float32",
        "int32",
    )
    assert int(cloud.num_points) == 50
    assert not np.asarray(cloud.intensity).any()


def test_nobody_can_write_to_the_points_that_jax_computes_with():
    cloud = PointCloud.from_numpy(POINTS)
    for array in (cloud.xyz1, cloud.intensity):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize("size", [0, 1, 2**14 - 1, 2**14, 2**14 + 1, 2**17, 2**20, 2**20 + 1])
def test_the_default_capacity_is_the_least_bucket_that_holds_the_sweep(size):
    cloud = PointCloud.from_numpy(np.zeros((size, 3), np.float32))
    fitting = [b for b in CAPACITY_BUCKETS if b >= size] or [CAPACITY_BUCKETS[-1]]
    assert cloud.capacity == min(fitting)
    assert int(cloud.num_points) == size


@pytest.mark.parametrize("kind", ["int8", "int64", "uint16", ">i4", "float16"])
def test_other_real_types_become_float32(kind):
    values = np.arange(12).reshape(4, 3).astype(kind)
    xyz, _, brightness = rows(PointCloud.from_numpy(values, values[:, 0], capacity=4))
    np.testing.assert_array_equal(xyz, np.arange(12).reshape(4, 3))
    np.testing.assert_array_equal(brightness, [0, 3, 6, 9])


def test_read_only_points_are_taken_and_left_alone():
    points = POINTS.copy()
    points.setflags(write=False)
    cloud = PointCloud.from_numpy(points, points[:, 0], capacity=20)
    assert int(cloud.num_points) == 50
    np.testing.assert_array_equal(points, POINTS)


FOUR = np.random.default_rng(4).normal(size=(21, 4)).astype(np.float32)


@pytest.mark.parametrize(
    "points",
    [
        FOUR[:, :3],
        FOUR[:, 1:],
        FOUR[3:9, :3],
        FOUR[3:, 1:],
        FOUR[::2, :3],
        FOUR[::-1, :3],
        FOUR[:0, :3],
        FOUR.T[:3, :7].T,
    ],
    ids=["first", "last", "some", "last of some", "every other", "backwards", "none", "columns of columns"],
)
def test_points_beside_another_number_are_those_points_and_one(points):
    xyz, one, _ = rows(PointCloud.from_numpy(points, capacity=32))
    np.testing.assert_array_equal(xyz[: len(points)], points)
    np.testing.assert_array_equal(xyz[len(points) :], 0)
    np.testing.assert_array_equal(one, np.arange(32) < len(points))


def test_later_changes_of_the_array_do_not_reach_the_cloud():
    points = POINTS.copy()
    cloud = PointCloud.from_numpy(points, capacity=50)
    points[:] = 0
    np.testing.assert_array_equal(cloud.xyz1[:, :3], POINTS)


def test_doubles_beyond_float32_become_infinite_without_a_warning():
    cloud = PointCloud.from_numpy(np.array([[1e300, -1e300, 1e-300]]), np.array([1e300]), capacity=1)
    assert cloud.xyz1[0].tolist() == [np.inf, -np.inf, 0, 1]


@pytest.mark.parametrize("capacity", [1, 7, 49, 50])
def test_over_capacity_the_nearest_points_stay_in_their_order(capacity):
    intensity = np.arange(50)
    xyz, one, brightness = rows(PointCloud.from_numpy(POINTS, intensity, capacity=capacity))
    kept = np.sort(np.argsort(np.linalg.norm(POINTS, axis=1))[:capacity])
    np.testing.assert_array_equal(xyz, POINTS[kept])
    np.testing.assert_array_equal(brightness, kept)
    assert one.all()


def test_over_capacity_points_that_are_not_finite_go_first():
    points = np.concatenate([[[np.nan, 0, 0], [0, -np.inf, 0]], POINTS, [[3e38, 3e38, 3e38]]])
    cloud = PointCloud.from_numpy(points, capacity=51)
    np.testing.assert_array_equal(cloud.xyz1[:50, :3], POINTS)
    assert int(cloud.num_points) == 53


def test_stacked_clouds_are_the_clouds_along_a_leading_axis():
    clouds = [PointCloud.from_numpy(POINTS[:n], capacity=64) for n in (0, 3, 50)]
    batch = stack_clouds(clouds)
    assert batch.capacity == 64
    assert batch.num_points.tolist() == [0, 3, 50]
    for row, cloud in enumerate(clouds):
        single = jax.tree.map(lambda leaf, row=row: leaf[row], batch)
        np.testing.assert_array_equal(single.xyz1, cloud.xyz1)
        np.testing.assert_array_equal(single.intensity, cloud.intensity)


def test_clouds_of_different_capacity_or_none_are_no_batch():
    clouds = [PointCloud.from_numpy(POINTS, capacity=capacity) for capacity in (64, 32)]
    with pytest.raises(ValueError, match=r"\[32, 64\].*same capacity"):
        stack_clouds(clouds)
    with pytest.raises(ValueError, match=r"\[\]"):
        stack_clouds([])


def test_each_status_bit_is_a_bit_of_its_own_and_has_a_sentence():
    bits = [bit for bit in Status if bit]
    assert len({int(bit) for bit in bits}) == len(bits) == 14
    assert all(int(bit).bit_count() == 1 for bit in bits)
    for bit in bits:
        (text,) = bit.describe()
        assert text.startswith(f"{bit.name}: ")
        assert text.endswith(".")


def test_a_clean_run_says_nothing_and_several_bits_say_a_sentence_each():
    assert Status.OK.describe() == []
    assert [text.split(":")[0] for text in (Status.NO_GROUND | Status.EMPTY).describe()] == [
        "EMPTY",
        "NO_GROUND",
    ]


def test_labels_are_the_order_of_the_priors():
    assert [label.name for label in Label] == ["CAR", "VAN", "TRUCK"]
    lengths = [prior.length_m for prior in DetectorConfig().vehicles.classes]
    assert lengths == sorted(lengths)


STREET = make_sweep(0, num_beams=32, num_azimuths=520).xyz

# A light detector with every capacity, each somewhat too small for that street: what is dropped hides
# little of what comes later, so that the sizes first named suffice or nearly so.
SMALL = DetectorConfig(
    filtering=FilterConfig(enabled=False),
    ground=GroundConfig(surface=False),
    clustering=ClusteringConfig(
        maps=(
            ComponentMap(cell_m=0.35, max_cells=640, max_clusters=16),
            ComponentMap(cell_m=0.5, max_cells=480, max_clusters=16),
        ),
        max_obstacles=6500,
    ),
    evidence=EvidenceConfig(enabled=False),
    hull=HullConfig(max_vertices=8),
    box=BoxConfig(scene_direction=False, num_angles=18, max_slab_points=1900),
    completion=CompletionConfig(mode="none"),
    vehicles=VehicleConfig(max_large=8, max_candidates=4, max_detections=2),
)
CAPACITY_BITS = (
    Status.OBSTACLE_OVERFLOW
    | Status.CELL_OVERFLOW
    | Status.CLUSTER_OVERFLOW
    | Status.CANDIDATE_OVERFLOW
    | Status.DETECTION_OVERFLOW
    | Status.HULL_OVERFLOW
)
SEEN_WHOLE = ("clustering.max_obstacles", "clustering.maps[i].max_cells")
"""Counted before anything is dropped here; the others count what is left of the stage before."""
HIDDEN = 3
"""Dropped points hide clusters, and those hide boxes: sizes of what may hide are enlarged by more."""
MAX_ROUNDS = 4
"""A run that sees more may ask for more; as a rule the second is clean."""


def sizes_named(message):
    """The sizes that an error asks for, by configuration field."""
    found = re.findall(r"([\w.\[\]]+(?:\(capacity=\.\.\.\))?) (?:must be )?at least ([\d, ]*\d)", message)
    return {field: [int(size) for size in sizes.split(",")] for field, sizes in found}


def enlarged(config, sizes):
    """The configuration with each field that is named large enough, and none smaller than it was."""
    for field, exact in sizes.items():
        needed = exact if field in SEEN_WHOLE else [HIDDEN * size for size in exact]
        part, name = field.split(".")[0], field.split(".")[-1]
        old = getattr(config, part)
        if "maps[i]" in field:
            maps = tuple(
                dataclasses.replace(m, **{name: max(size, getattr(m, name))})
                for m, size in zip(old.maps, needed, strict=True)
            )
            new = dataclasses.replace(old, maps=maps)
        else:
            new = dataclasses.replace(old, **{name: max(needed[0], getattr(old, name))})
        config = dataclasses.replace(config, **{part: new})
    return config


@pytest.fixture(scope="module")
def rounds():
    """Runs with ever larger capacities, as the errors ask for, until nothing overflows."""
    cloud, config, runs = PointCloud.from_numpy(STREET, capacity=2**14), SMALL, []
    for _ in range(MAX_ROUNDS):
        detections = parity.detect_quickly(cloud, config).on_host()
        runs.append((config, detections))
        if not Status(int(detections.status)) & CAPACITY_BITS:
            break
        with pytest.raises(RuntimeError) as error:
            detections.raise_if_failed()
        config = enlarged(config, sizes_named(str(error.value)))
    return runs


def test_detections_on_the_host_are_numpy_arrays_of_the_same_numbers(rounds):
    config, detections = rounds[-1]
    again = parity.detect_quickly(PointCloud.from_numpy(STREET, capacity=2**14), config)
    for host in (detections, detections.on_host()):
        for ours, theirs in zip(jax.tree.leaves(host), jax.tree.leaves(jax.device_get(again)), strict=True):
            assert isinstance(ours, np.ndarray)
            np.testing.assert_array_equal(ours, theirs)


def test_each_capacity_that_is_too_small_sets_its_bit(rounds):
    _, detections = rounds[0]
    assert Status(int(detections.status)) == CAPACITY_BITS


def test_a_capacity_is_told_full_exactly_where_it_is(rounds):
    for config, detections in rounds:
        uses = {use.field: use.dropped > 0 for use in summarise(detections, config).capacities}
        full = Status.OK
        for row in CAPACITIES:
            if any(uses[name] for name in row.sizes(config, 2**14)):
                full |= Status[row.status]
        assert Status(int(detections.status)) == full
        over = detections.counts.overflows(config, 2**14)
        assert functools.reduce(operator.or_, [bit for bit in over if over[bit]], Status.OK) == full


def test_the_error_of_a_full_capacity_names_its_field_and_the_true_count(rounds):
    _, detections = rounds[0]
    counts = detections.counts
    with pytest.raises(RuntimeError) as error:
        detections.raise_if_failed()
    assert sizes_named(str(error.value)) == {
        "clustering.max_obstacles": [counts.obstacles],
        "box.max_slab_points": [counts.slab_points],
        "clustering.maps[i].max_cells": counts.cells.tolist(),
        "clustering.maps[i].max_clusters": counts.clusters.tolist(),
        "vehicles.max_large": [counts.large_clusters],
        "vehicles.max_candidates": [counts.candidates],
        "vehicles.max_detections": [counts.detections],
        "hull.max_vertices": [counts.hull_vertices],
    }
    assert str(error.value).count("\n") == 5


def test_an_overflowing_run_is_finite_within_its_capacities_and_counts_every_point(rounds):
    for config, detections in rounds:
        assert detections.valid.sum() == min(detections.counts.detections, config.vehicles.max_detections)
        assert detections.hulls.vertices.shape[1] == config.hull.max_vertices
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(detections))
        assert detections.counts.num_points == len(STREET)


def test_capacities_enlarged_as_the_errors_ask_clear_every_bit(rounds):
    _, detections = rounds[-1]
    assert Status(int(detections.status)) == Status.OK
    detections.raise_if_failed()
    assert len(rounds) > 1


@pytest.mark.slow
def test_a_capacity_for_obstacles_that_suffices_changes_nothing(rounds):
    config, _ = rounds[-1]
    cloud = PointCloud.from_numpy(STREET[::6], capacity=2**14)

    def found(max_obstacles):
        clustering = dataclasses.replace(config.clustering, max_obstacles=max_obstacles)
        return jax.device_get(
            parity.detect_quickly(cloud, dataclasses.replace(config, clustering=clustering))
        )

    # Points are gone through in chunks of 4,096: one capacity is a whole number of them.
    odd, even = found(2500), found(8192)
    assert odd.valid.any()
    assert int(odd.counts.obstacles) < 2500
    for ours, theirs in zip(jax.tree.leaves(odd), jax.tree.leaves(even), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_field_is_named_again_only_where_more_was_seen(rounds):
    for (_, before), (config, after) in itertools.pairwise(rounds):
        status = Status(int(after.status))
        assert config.clustering.max_obstacles >= after.counts.obstacles == before.counts.obstacles
        assert Status.OBSTACLE_OVERFLOW not in status or after.counts.slab_points > config.box.max_slab_points
        for bit, size, capacity in (
            (Status.CANDIDATE_OVERFLOW, "candidates", config.vehicles.max_candidates),
            (Status.DETECTION_OVERFLOW, "detections", config.vehicles.max_detections),
            (Status.HULL_OVERFLOW, "hull_vertices", config.hull.max_vertices),
        ):
            assert capacity >= getattr(before.counts, size)
            assert (bit in status) == (getattr(after.counts, size) > capacity)


def test_a_sweep_larger_than_its_cloud_sets_the_bit_and_names_the_capacity(rounds):
    config, clean = rounds[-1]
    more = np.concatenate([STREET, STREET + np.float32(0.001)])
    detections = parity.detect_quickly(PointCloud.from_numpy(more, capacity=2**14), config)
    assert Status.POINT_OVERFLOW in Status(int(detections.status))
    assert Status.POINT_OVERFLOW not in Status(int(clean.status))
    assert int(detections.counts.dropped_points) == len(more) - 2**14
    assert detections.counts.num_points == len(more)
    needed = rf"POINT_OVERFLOW: PointCloud.from_numpy\(capacity=\.\.\.\) must be at least {len(more)}\."
    with pytest.raises(RuntimeError, match=needed):
        detections.raise_if_failed()
