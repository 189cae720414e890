"""Parity with the reference: warp, cells, components, clusters, samples; exact, on equal inputs."""

import functools

import jax
import numpy as np
import parity
import pytest
from scipy import ndimage

from jaxbox import box, clustering, reference
from jaxbox.config import ComponentMap, DetectorConfig
from jaxbox.reference.clusters import NO_CLUSTER

SETTINGS = parity.CONFIG.clustering
WARP = {"start_m": SETTINGS.adaptive_start_m, "growth": SETTINGS.adaptive_growth}
MAPS = {"bird's-eye view": ComponentMap(cell_m=0.35), "3D": DetectorConfig.paper().clustering.maps[0]}
GATES = parity.select_options(SETTINGS, "min_points", "max_extent_m")
MAX_CELLS = 2**15

label_components = jax.jit(clustering.label_components, static_argnames=("shape", "max_cells"))
select_clusters = jax.jit(clustering.select_clusters, static_argnames=("max_cells", "max_clusters"))
sample_points = jax.jit(box.sample_points, static_argnames=("num_clusters", "max_points"))


def cell_options(component_map: ComponentMap):
    return parity.REGION | parity.select_options(component_map, "cell_m", "num_levels", "min_height_m")


def members_of(case, component_map):
    """x, y and height of the obstacles that the map takes, float32."""
    height = case.obstacles.height
    member = (height > component_map.min_height_m) & (height < component_map.max_height_m)
    return case.obstacles.xyz[member, :2].astype(np.float32), height[member].astype(np.float32)


def assert_one_partition(first, second):
    """Fails unless two labellings of the same points group them alike, whatever the labels."""
    pairs = np.unique(np.column_stack([first, second]), axis=0)
    assert len(pairs) == len(np.unique(first)) == len(np.unique(second))


def test_warped_points_are_those_of_the_reference(cases):
    warp = jax.jit(functools.partial(clustering.warp_range))
    for case in cases:
        xy = case.obstacles.xyz[:, :2]
        for growth in (0.0, WARP["growth"], 0.1):
            expected = reference.warp_range(xy, start_m=WARP["start_m"], growth=growth)
            warped = warp(parity.pad(xy, parity.MAX_OBSTACLES), start_m=WARP["start_m"], growth=growth)
            parity.assert_within(np.asarray(warped)[: len(xy)] - expected, 5e-5, "m between warped points")


@pytest.mark.parametrize("name", list(MAPS))
def test_cells_are_those_of_the_reference(cases, name):
    cells = jax.jit(lambda xy, height: clustering.cell_index(xy, height, **cell_options(MAPS[name]))[0])
    for case in cases:
        xy, height = members_of(case, MAPS[name])
        expected, _ = reference.grid_cells(xy.astype(float), height.astype(float), **cell_options(MAPS[name]))
        index = cells(parity.pad(xy, parity.MAX_OBSTACLES), parity.pad(height, parity.MAX_OBSTACLES))
        differ = np.any(np.asarray(index)[: len(xy)] != expected, axis=1)
        # A point on the edge of a cell may round either way; KITTI keeps whole millimetres, so of points on
        # a grid of 35 cm one in 175 lies on an edge.
        parity.assert_share(differ.sum(), len(xy), 0.005, f"cells {name}")
        assert np.max(np.abs(np.asarray(index)[: len(xy)] - expected)) <= 1


@pytest.mark.parametrize("name", list(MAPS))
def test_components_are_exactly_those_of_the_reference(cases, name):
    for case in cases:
        cells, shape = reference.grid_cells(*members_of(case, MAPS[name]), **cell_options(MAPS[name]))
        expected = reference.label_components(cells, shape)
        component, num_cells = label_components(
            parity.pad(cells, parity.MAX_OBSTACLES),
            parity.padded_mask(len(cells), parity.MAX_OBSTACLES),
            shape=shape,
            max_cells=MAX_CELLS,
        )
        component = np.asarray(component)
        assert int(num_cells) == len(np.unique(cells, axis=0)) < MAX_CELLS
        assert np.all(component[len(cells) :] == MAX_CELLS)
        assert_one_partition(component[: len(cells)], expected)
        assert expected.max() > 20


@pytest.mark.parametrize("shape", [(61, 67, 1), (17, 19, 13)])
def test_components_of_random_grids_are_those_of_scipy(shape):
    # From single cells to one component, past the density at which paths are longest.
    rng = np.random.default_rng(0)
    for density in np.linspace(0.02, 0.6, 25):
        occupied = rng.random(shape) < density
        cells = np.argwhere(occupied)
        labels, _ = ndimage.label(occupied, np.ones((3, 3, 3)))
        order = rng.permutation(len(cells))
        component, num_cells = label_components(
            parity.pad(cells[order], occupied.size),
            parity.padded_mask(len(cells), occupied.size),
            shape=shape,
            max_cells=occupied.size,
        )
        assert_one_partition(np.asarray(component)[: len(cells)], labels[occupied][order])
        assert int(num_cells) == len(cells)


@pytest.mark.parametrize("name", list(MAPS))
def test_clusters_that_pass_the_gates_are_exactly_those_of_the_reference(cases, name):
    for case in cases:
        xy, height = members_of(case, MAPS[name])
        component = reference.label_components(*reference.grid_cells(xy, height, **cell_options(MAPS[name])))
        slot, count = reference.keep_clusters(xy, component, **GATES)
        clusters = select_clusters(
            parity.pad(component, parity.MAX_OBSTACLES, fill=MAX_CELLS),
            parity.pad(xy, parity.MAX_OBSTACLES),
            parity.pad(height, parity.MAX_OBSTACLES),
            np.int32(0),
            max_cells=MAX_CELLS,
            max_clusters=parity.MAX_CLUSTERS,
            **GATES,
        )
        clusters = parity.on_host(clusters)
        expected = np.where(slot == NO_CLUSTER, parity.MAX_CLUSTERS, slot)
        np.testing.assert_array_equal(clusters.slot[: len(xy)], expected)
        assert int(clusters.num_clusters) == count > 10
        np.testing.assert_array_equal(clusters.num_points[:count], np.bincount(slot[slot >= 0]))
        heights = [height[slot == k] for k in range(count)]
        np.testing.assert_array_equal(clusters.min_height[:count], [h.min() for h in heights])
        np.testing.assert_array_equal(clusters.max_height[:count], [h.max() for h in heights])


def test_fitted_points_are_exactly_those_of_the_reference(cases):
    settings = parity.CONFIG.box
    limits = parity.select_options(settings, "min_slab_points", "max_points")
    slab = {"min_height_m": settings.slab_min_height_m, "max_height_m": settings.slab_max_height_m}
    for case in cases:
        height = case.obstacles.height
        in_slab = (height > slab["min_height_m"]) & (height < slab["max_height_m"])
        few = np.bincount(case.slot[in_slab & (case.slot >= 0)], minlength=len(case.proposals))
        few = few < settings.min_slab_points
        used = (case.slot >= 0) & (in_slab | few[case.slot])
        index, count = sample_points(
            parity.pad(
                np.where(used, case.slot, parity.MAX_CLUSTERS), parity.MAX_OBSTACLES, parity.MAX_CLUSTERS
            ),
            num_clusters=parity.MAX_CLUSTERS,
            max_points=settings.max_points,
        )
        index, count = np.asarray(index), np.asarray(count)
        assert not count[len(case.proposals) :].any()
        for row, proposal in enumerate(case.proposals):
            expected = reference.fit_points(proposal.members, height, **slab, **limits)
            np.testing.assert_array_equal(index[row, : count[row]], expected)
