"""Laws of the settings: what is static, what is traced, and the capacities proposed for sweeps."""

import dataclasses

import jax
import numpy as np
import parity
import pytest

from jaxbox import DetectorConfig, PointCloud, Status, detect
from jaxbox.config import (
    BoxConfig,
    ClusteringConfig,
    CompletionConfig,
    ComponentMap,
    EvidenceConfig,
    RegionConfig,
    propose_capacities,
)
from jaxbox.config.presets import CAPACITY_STEP
from jaxbox.io import open_sweeps
from jaxbox.synthetic import make_sweep

NO_OVERFLOW = Status.EMPTY | Status.NONFINITE_POINTS | Status.NO_GROUND

# The maps of the default preset and its heights, and little else: it compiles sooner.
LIGHT = dataclasses.replace(
    DetectorConfig(),
    clustering=ClusteringConfig(maps=DetectorConfig().clustering.maps[:2]),
    evidence=EvidenceConfig(enabled=False),
    box=BoxConfig(scene_direction=False),
    completion=CompletionConfig(mode="none"),
)


def fields_of(config):
    """All fields of the sub-configs, with the value of each."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        for part in value if isinstance(value, tuple) else (value,):
            if dataclasses.is_dataclass(part):
                yield from fields_of(part)
            else:
                yield field, part


@pytest.mark.parametrize("preset", DetectorConfig.presets())
def test_traced_settings_are_floats_and_static_ones_decide_the_tree(preset):
    config = DetectorConfig.presets()[preset]
    traced = [value for field, value in fields_of(config) if not field.metadata.get("static")]
    assert all(type(value) is float for value in traced)
    assert sorted(jax.tree.leaves(config)) == sorted(traced)
    hash(jax.tree.structure(config))


@pytest.mark.parametrize("preset", DetectorConfig.presets())
def test_a_threshold_keeps_the_tree_and_a_capacity_changes_it(preset):
    config = DetectorConfig.presets()[preset]
    vehicles = dataclasses.replace(config.vehicles, min_score=0.3)
    moved = dataclasses.replace(config, vehicles=vehicles)
    larger = dataclasses.replace(config, vehicles=dataclasses.replace(vehicles, max_detections=7))
    assert jax.tree.structure(moved) == jax.tree.structure(config)
    assert jax.tree.structure(larger) != jax.tree.structure(config)


def test_settings_are_frozen_and_keyword_only():
    with pytest.raises(dataclasses.FrozenInstanceError):
        DetectorConfig().region.half_x_m = 1.0
    with pytest.raises(TypeError):
        RegionConfig(1.0)


def test_the_paper_preset_is_the_papers():
    paper = DetectorConfig.paper()
    assert (paper.ground.max_planes, paper.ground.surface, paper.ground.candidates) == (1, False, "points")
    assert (paper.box.criterion, paper.box.fit_to) == ("area", "hull")
    assert (paper.completion.mode, paper.evidence.enabled) == ("none", False)
    assert not paper.vehicles.neighbourhood
    assert paper.clustering.adaptive_growth == 0
    assert [m.num_levels for m in paper.clustering.maps] == [13]


def proposed(config):
    return (
        config.clustering.max_obstacles,
        config.box.max_slab_points,
        *(m.max_cells for m in config.clustering.maps),
    )


def without_proposals(config):
    """The configuration with everything that is proposed set to one."""
    maps = tuple(dataclasses.replace(m, max_cells=1) for m in config.clustering.maps)
    return dataclasses.replace(
        config,
        clustering=dataclasses.replace(config.clustering, maps=maps, max_obstacles=1),
        box=dataclasses.replace(config.box, max_slab_points=1),
    )


def blocks(count, height_m):
    """Flat ground of 40 x 40 points 0.5 m apart, and over the first `count` of them a point so high."""
    ground = np.stack(np.meshgrid(np.arange(40) / 2 + 1.25, np.arange(40) / 2 + 1.25, [-1.7]), -1).reshape(
        -1, 3
    )
    return np.concatenate([ground, ground[:count] + np.array([0, 0, height_m])])


def one_map(**options):
    config = DetectorConfig()
    clustering = dataclasses.replace(config.clustering, maps=(ComponentMap(**options),), adaptive_growth=0.0)
    return dataclasses.replace(config, clustering=clustering)


def test_proposals_count_points_above_the_lowest_near_them():
    base = one_map(cell_m=0.25, max_height_m=1.0)
    counts = {}
    for height_m in (0.1, 0.5, 2.0, 5.0):
        sizes = proposed(propose_capacities([blocks(1500, height_m)], base=base, margin=1))
        counts[height_m] = tuple(size // CAPACITY_STEP for size in sizes)
    # 1500 points take two steps: ground, within the slab and the map, above both, and overhead.
    assert counts == {0.1: (1, 1, 1), 0.5: (2, 2, 2), 2.0: (2, 1, 1), 5.0: (1, 1, 1)}


def test_proposals_count_cells_not_points():
    base = one_map(cell_m=2.0)
    assert proposed(propose_capacities([blocks(1500, 0.5)], base=base))[2] == CAPACITY_STEP


def test_proposals_hold_the_largest_sweep_times_the_margin():
    base = one_map(cell_m=0.25)
    sweeps = [blocks(10, 0.5), blocks(1000, 0.5), blocks(0, 0.5)]
    assert proposed(propose_capacities(sweeps, base=base, margin=1)) == (1024, 1024, 1024)
    assert proposed(propose_capacities(iter(sweeps), base=base)) == (2048, 2048, 2048)
    assert proposed(propose_capacities(sweeps, base=base, margin=2.5)) == (3072, 3072, 3072)


@pytest.mark.parametrize("preset", DetectorConfig.presets())
def test_proposals_leave_everything_else_as_in_the_base(preset):
    base = DetectorConfig.presets()[preset]
    config = propose_capacities([blocks(900, 0.5)], base=base)
    assert without_proposals(config) == without_proposals(base)
    assert all(type(size) is int for size in proposed(config))
    assert propose_capacities([blocks(900, 0.5)]).completion == DetectorConfig().completion


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 3)), np.full((9, 3), np.nan), np.full((9, 3), 1e30), np.ones((9, 3), np.int16)],
    ids=["empty", "NaN", "far away", "integers"],
)
def test_sweeps_without_anything_get_the_least_capacity(points):
    config = propose_capacities([points])
    assert set(proposed(config)) == {CAPACITY_STEP}


def test_points_far_away_or_not_finite_change_no_proposal():
    sweep = blocks(900, 0.5)
    worse = np.concatenate([sweep, [[np.nan, 0, 0], [np.inf, 0, 0], [500, 0, 1], [0, -500, 1]]])
    assert propose_capacities([worse]) == propose_capacities([sweep])


def test_bad_arguments_of_proposals_are_refused_saying_which():
    with pytest.raises(ValueError, match="no sweeps"):
        propose_capacities([])
    with pytest.raises(ValueError, match=r"sweep 1 has shape \(5, 4\).*points\[:, :3\]"):
        propose_capacities([np.zeros((5, 3)), np.zeros((5, 4))])
    for margin in (0.9, -1, float("nan")):
        with pytest.raises(ValueError, match=r"margin is .*at least 1"):
            propose_capacities([np.zeros((5, 3))], margin=margin)


@pytest.mark.slow
def test_the_proposed_capacities_hold_the_sweeps_they_were_proposed_for():
    sweeps = [make_sweep(seed, num_beams=32, num_azimuths=520).xyz for seed in range(3)]
    config = propose_capacities(sweeps, base=LIGHT)
    # Smaller than the base's, or there would be no need to propose.
    assert all(
        size < m.max_cells for size, m in zip(proposed(config)[2:], LIGHT.clustering.maps, strict=True)
    )
    for xyz in sweeps:
        detections = parity.detect_quickly(PointCloud.from_numpy(xyz, capacity=2**14), config)
        detections.raise_if_failed()
        assert not Status(int(detections.status)) & ~NO_OVERFLOW
        assert int(detections.counts.obstacles) > 0.5 * config.clustering.max_obstacles / 1.25 - CAPACITY_STEP


@pytest.mark.slow
def test_the_rough_look_at_real_sweeps_proposes_enough(data_root):
    frames = open_sweeps(data_root / "kitti_object" / "training")[::4]
    default = DetectorConfig()
    for frame in frames:
        xyz = frame.read_points()[0]
        config = propose_capacities([xyz])
        counts = detect(PointCloud.from_numpy(xyz, capacity=2**17), default).counts
        true = np.array([counts.obstacles, counts.slab_points, *counts.cells])
        assert (true <= proposed(config)).all(), frame
