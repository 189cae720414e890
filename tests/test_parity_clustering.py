"""Parity with the reference: warp, cells, components, clusters, samples; exact, on equal inputs."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import parity
import pytest
from native_loops import count_loops
from scipy import ndimage

from jaxbox import reference
from jaxbox.config import ComponentMap, DetectorConfig
from jaxbox.stages import clustering
from jaxbox.xla import backend, chunks, ragged
from jaxbox.xla.components import NONE, STRIP_WORDS, CellGrids, _prefix, label_components

SETTINGS = parity.CONFIG.clustering
WARP = {"start_m": SETTINGS.adaptive_start_m, "growth": SETTINGS.adaptive_growth}
MAPS = {"bird's-eye view": ComponentMap(cell_m=0.35), "3D": DetectorConfig.paper().clustering.maps[0]}
MIN_EXTENT_M = parity.CONFIG.vehicles.min_extent_m
MAX_RUNS = 2**14


@functools.partial(parity.PerForm, static_argnames=("row", "max_runs"))
def label_cells(cells, *, row, max_runs):
    """Components of the maps' cells, (maps, N), and what else is known of them."""
    flags = jnp.zeros(row.num_flags, jnp.uint8).at[row.flag(cells)].set(1)
    components = label_components(flags, row, max_runs=max_runs)
    return components.at(cells), components


@parity.PerForm
def select_clusters(component, xy, height, in_slab, first, config, min_extent_m):
    statistics = clustering.find_statistics(
        component, height.size, xy, height, in_slab, max_components=MAX_RUNS
    )
    return clustering.select_clusters(statistics, first, config, min_extent_m=min_extent_m)


def with_room(config, sizes):
    """The configuration with maps of these capacities for clusters."""
    return dataclasses.replace(config, maps=tuple(ComponentMap(max_clusters=size) for size in sizes))


find_statistics = parity.PerForm(clustering.find_statistics, static_argnames="max_components")
sampling_rank = parity.PerForm(clustering.sampling_rank)
sampled_share = parity.PerForm(clustering.sampled_share, static_argnames="max_points")
list_points = parity.PerForm(ragged.list_points, static_argnames=("num_clusters", "max_points"))


def reference_cells(xy, height, component_map):
    return reference.find_cells(xy, height, component_map, parity.CONFIG.region)


def in_row(cells, row, i):
    """Where cells of map i, (n, 3), lie in the row of all maps."""
    return row.starts[i] + cells @ np.array(row.strides[i])


def members_of(case, component_map):
    """x, y and height of the obstacles that the map takes, float32."""
    height = case.obstacles.height
    member = (height > component_map.min_height_m) & (height < component_map.max_height_m)
    return case.obstacles.xyz[member, :2].astype(np.float32), height[member].astype(np.float32)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("num_points", [0, 1, 700, 1000, 1200])
def test_statistics_are_those_of_the_first_points_on_every_platform(num_points):
    rng = np.random.default_rng(num_points)
    component = rng.integers(0, 40, (2, 1000), np.int32)
    component[1] += 40
    xyz, in_slab = rng.normal(size=(1000, 3)).astype(np.float32), rng.random(1000) < 0.5
    points = component, jnp.int32(num_points), xyz[:, :2], xyz[:, 2], in_slab
    statistics = jax.device_get(find_statistics(*points, max_components=81))
    for i in range(81):
        member = (component == i)[:, :num_points].any(axis=0)
        own = xyz[:num_points][member]
        counts = len(own), in_slab[:num_points][member].sum()
        assert (statistics.num_points[i], statistics.num_slab[i]) == counts
        bounds = np.concatenate([own.max(axis=0, initial=-np.inf), (-own).max(axis=0, initial=-np.inf)])
        np.testing.assert_array_equal(statistics.upper[i], bounds)


def test_warped_points_are_those_of_the_reference(cases):
    warp = jax.jit(functools.partial(clustering.compress_range))
    for case in cases:
        xy = case.obstacles.xyz[:, :2]
        for growth in (0.0, WARP["growth"], 0.1):
            expected = reference.compress_range(xy, start_m=WARP["start_m"], growth=growth)
            warped = warp(parity.pad(xy, parity.MAX_OBSTACLES), start_m=WARP["start_m"], growth=growth)
            parity.assert_within(np.asarray(warped)[: len(xy)] - expected, 5e-5, "m between warped points")


def test_cells_are_those_of_the_reference(cases):
    maps = list(MAPS.values())
    config = dataclasses.replace(SETTINGS, maps=tuple(maps))
    row = clustering.arrange_grids(config, parity.CONFIG.region)
    find = functools.partial(clustering.find_cells, grids=row, config=config, region=parity.CONFIG.region)
    for case in cases:
        xy, height = case.obstacles.xyz[:, :2].astype(np.float32), case.obstacles.height.astype(np.float32)
        padded = [parity.pad(values, parity.MAX_OBSTACLES) for values in (xy, height)]
        found = jax.jit(find)(*padded, parity.padded_mask(len(xy), parity.MAX_OBSTACLES))
        for i, component_map in enumerate(maps):
            cells, shape = reference_cells(xy.astype(float), height.astype(float), component_map)
            assert shape == row.shapes[i]
            member = (height > component_map.min_height_m) & (height < component_map.max_height_m)
            expected = np.where(member, in_row(cells, row, i), NONE)
            cell = np.asarray(found[i])
            assert (cell[len(xy) :] == NONE).all()
            assert ((cell == NONE)[: len(xy)] == ~member).all()
            # A point on the edge of a cell may round either way; KITTI keeps whole millimetres, so of points
            # on a grid of 35 cm one in 175 lies on an edge.
            differ = cell[: len(xy)] != expected
            parity.assert_share(differ.sum(), member.sum(), 0.005, f"cells of map {i}")
            steps = np.abs(cell[: len(xy)] - expected)[differ]
            assert np.isin(steps, row.strides[i]).all()


@pytest.mark.usefixtures("platform")
def test_components_are_exactly_those_of_the_reference(cases):
    for case in cases:
        grids = [reference_cells(*members_of(case, m), m) for m in MAPS.values()]
        row = CellGrids(tuple(shape for _, shape in grids))
        cells = [
            parity.pad(in_row(cells, row, i), parity.MAX_OBSTACLES) for i, (cells, _) in enumerate(grids)
        ]
        component, components = label_cells(np.stack(cells), row=row, max_runs=MAX_RUNS)
        component, first = np.asarray(component), np.asarray(components.first)
        for i, (cells, shape) in enumerate(grids):
            expected = reference.label_components(cells, shape)
            np.testing.assert_array_equal(component[i, : len(cells)], first[i] + expected)
            assert (component[i, len(cells) :] == NONE).all()
            assert int(components.num_runs[i]) == reference.count_runs(cells, shape)
            assert first[i + 1] - first[i] == expected.max() + 1 > 20


SHAPES = {
    "one map": ((61, 67, 1),),
    "one line": ((1, 500, 1),),
    "lines of one": ((500, 1, 1),),
    "3D": ((17, 19, 13),),
    "many": ((61, 67, 1), (17, 19, 13), (40, 31, 2), (5, 1000, 1)),
}


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("name", SHAPES)
def test_components_of_random_grids_are_those_of_scipy_on_every_platform(name):
    # From single cells to one component, past the density at which paths are longest.
    rng = np.random.default_rng(0)
    row = CellGrids(SHAPES[name])
    size = max(np.prod(shape) for shape in SHAPES[name])
    for density in np.linspace(0.02, 0.6, 25):
        grids = [rng.random(shape) < density for shape in SHAPES[name]]
        where = [rng.permutation(np.argwhere(grid)) for grid in grids]
        cells = np.stack([parity.pad(in_row(c, row, i), size) for i, c in enumerate(where)])
        component, components = label_cells(cells, row=row, max_runs=MAX_RUNS)
        for i, grid in enumerate(grids):
            labels = np.zeros(grid.shape, np.int32)
            ndimage.label(grid, np.ones((3, 3, 3)), output=labels)
            # Numbered by the first cell.
            _, place, number = np.unique(labels[grid], return_index=True, return_inverse=True)
            labels[grid] = np.argsort(np.argsort(place))[number]
            expected = int(components.first[i]) + labels[tuple(where[i].T)]
            np.testing.assert_array_equal(np.asarray(component)[i, : len(expected)], expected)


def spiral(size):
    """(size, size) bool: one path of cells from a corner to the middle, a cell apart from itself."""
    grid, place, step = np.zeros((size, size), bool), np.zeros(2, int), np.array([0, 1])
    grid[0, 0] = True
    for side in [size - 1, *np.repeat(np.arange(size - 1, 0, -2), 2)]:
        for _ in range(side):
            place += step
            grid[tuple(place)] = True
        step = np.array([step[1], -step[0]])
    return grid


def snake(size):
    """(size, size) bool: every other line, joined at its end to the next."""
    grid = np.arange(size)[:, None] % 2 == np.zeros(size)
    grid[1::4, -1] = grid[3::4, 0] = True
    return grid


def comb(bits):
    """Teeth that begin in the order of their numbers' bits reversed, each joined to the next further down.

    In each round every other of the trees that are left hooks onto a lower one: `bits` rounds in all.
    """
    num = 2**bits
    grid = np.zeros((num + 4, 4 * num), bool)
    for i in range(2 * num):
        start = int(f"{i // 2:0{bits}b}"[::-1], 2) if i % 2 == 0 else num
        grid[start : num + 1, 2 * i] = True
    for i in range(2 * num - 1):
        grid[num + 1 + 2 * (i % 2), 2 * i : 2 * i + 3] = True
    grid[num + 2, 2:-2:2] = True
    return grid


LONG_WAYS = {"spiral": spiral(71), "snake": snake(71), "comb": comb(6), "comb on its side": comb(4).T}
LONG_ROW = CellGrids(((72, 256, 1),))


def label_grid(grid, label=label_cells):
    cells = np.argwhere(grid[..., None])
    padded = parity.pad(in_row(cells, LONG_ROW, 0), 2**13)
    return np.asarray(label(padded[None], row=LONG_ROW, max_runs=MAX_RUNS)[0])[0, : len(cells)]


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("name", LONG_WAYS)
def test_long_and_winding_ways_are_one_component_each_on_every_platform(name):
    grid = LONG_WAYS[name]
    assert ndimage.label(grid, np.ones((3, 3)))[1] == 1
    np.testing.assert_array_equal(label_grid(grid), 1)
    # And cut in two, two.
    cut = grid.copy()
    cut[:, grid.shape[1] // 2] = False
    labels, num = ndimage.label(cut, np.ones((3, 3)))
    found = label_grid(cut)
    assert len(set(found)) == num > 1
    assert len(set(zip(found, labels[cut], strict=True))) == num


def test_the_first_rounds_are_not_enough_for_the_comb(monkeypatch):
    # Or the test above would not need the loop that goes on.
    label = parity.PerForm(label_cells.function, static_argnames=("row", "max_runs"))
    monkeypatch.setattr(jax.lax, "while_loop", lambda _, __, state: state)
    with backend.building_for(accelerator=True):
        assert len(set(label_grid(LONG_WAYS["comb"], label))) > 1


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("num_strips", [1, 2, 9])
def test_counts_of_words_are_summed_up_strip_after_strip_on_every_platform(num_strips):
    count = np.random.default_rng(num_strips).integers(0, 17, (STRIP_WORDS, num_strips), np.int32)
    before, total = jax.jit(functools.partial(_prefix))(count)
    expected = np.cumsum(count.T).reshape(num_strips, -1).T - count
    np.testing.assert_array_equal(before, expected)
    assert int(total) == count.sum()


@pytest.mark.codegen
@pytest.mark.parametrize("name", SHAPES)
def test_a_cpu_joins_runs_in_native_loops(name):
    row = CellGrids(SHAPES[name])
    cells = jnp.zeros((len(row.shapes), 9), jnp.int32)
    num_loops, num_native = count_loops(label_cells.jitted, cells, row=row, max_runs=MAX_RUNS)
    assert num_native == num_loops > 2 * max(map(len, row.lines_back))


@pytest.mark.codegen
@pytest.mark.parametrize("num_maps", [1, 4, 5, 9])
def test_a_cpu_finds_statistics_in_native_loops(num_maps):
    find = jax.jit(clustering.find_statistics, static_argnames="max_components")
    component = jnp.zeros((num_maps, 9), jnp.int32)
    points = component, jnp.int32(9), jnp.zeros((9, 2)), jnp.zeros(9), jnp.zeros(9, bool)
    num_loops, num_native = count_loops(find, *points, max_components=MAX_RUNS)
    assert num_native == num_loops == -(-num_maps // chunks.STATISTICS_MAPS)


@pytest.mark.usefixtures("platform")
def test_runs_beyond_the_capacity_belong_to_no_component():
    cells = np.stack([np.arange(0, 400, 2) % 20, np.arange(0, 400, 2) // 20 * 2, np.zeros(200)], axis=1)
    row = CellGrids(((20, 40, 1),))
    cells = in_row(cells.astype(np.int32), row, 0)[None]
    for capacity in (201, 200, 1):
        component, components = label_cells(cells, row=row, max_runs=capacity)
        assert int(components.num_runs[0]) == 200
        assert (np.asarray(component) == NONE).sum() == max(201 - capacity, 0)


@pytest.mark.usefixtures("platform")
def test_runs_beyond_the_capacity_join_nothing():
    row = CellGrids(((20, 40, 1),))
    # The third touches the first, and nothing the second.
    cells = in_row(np.array([[0, 1, 0], [0, 30, 0], [1, 0, 0]], np.int32), row, 0)[None]
    for capacity, expected in ((4, [1, 2, 1]), (3, [1, 2, 0]), (2, [1, 0, 0])):
        assert label_cells(cells, row=row, max_runs=capacity)[0].tolist() == [expected]


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("name", list(MAPS))
def test_clusters_that_pass_the_gates_are_exactly_those_of_the_reference(cases, name):
    for case in cases:
        xy, height = members_of(case, MAPS[name])
        component = reference.label_components(*reference_cells(xy, height, MAPS[name]))
        slot, count = reference.select_clusters(xy, component, SETTINGS, min_extent_m=MIN_EXTENT_M)
        in_slab = np.arange(len(xy)) % 3 == 0
        clusters = select_clusters(
            parity.pad(1 + component, parity.MAX_OBSTACLES)[None],
            parity.pad(xy, parity.MAX_OBSTACLES),
            parity.pad(height, parity.MAX_OBSTACLES),
            parity.pad(in_slab, parity.MAX_OBSTACLES),
            np.array([1, 2 + component.max()]),
            with_room(SETTINGS, [parity.MAX_CLUSTERS]),
            MIN_EXTENT_M,
        )
        clusters = parity.on_host(clusters)
        expected = np.where(slot == reference.NO_CLUSTER, parity.MAX_CLUSTERS, slot)
        np.testing.assert_array_equal(clusters.row[1 + component], expected)
        assert clusters.row[0] == parity.MAX_CLUSTERS
        assert clusters.found[0] == clusters.kept[0] == count > 10
        np.testing.assert_array_equal(clusters.num_points[:count], np.bincount(slot[slot >= 0]))
        np.testing.assert_array_equal(
            clusters.num_slab[:count], np.bincount(slot[slot >= 0], in_slab[slot >= 0])
        )
        members = [np.column_stack([xy, height])[slot == k] for k in range(count)]
        np.testing.assert_array_equal(clusters.low[:count], [points.min(axis=0) for points in members])
        np.testing.assert_array_equal(clusters.high[:count], [points.max(axis=0) for points in members])


@pytest.mark.usefixtures("platform")
def test_the_lists_of_the_maps_join_without_gaps_and_end_at_their_capacities():
    # Map 0 has components 1 to 4, map 1 has 5 and 6, map 2 has 7 to 9; each of one point but 2 and 7.
    component = np.array([1, 3, 4, 5, 6, 8, 9, 2, 2, 7, 7], np.int32)
    xy = np.zeros((11, 2), np.float32)
    xy[[8, 10]] = 50.0
    for sizes, rows in (
        ((4, 4, 4), {1: 0, 3: 1, 4: 2, 5: 3, 6: 4, 8: 5, 9: 6}),
        ((2, 1, 3), {1: 0, 3: 1, 5: 2, 8: 3, 9: 4}),
    ):
        config = with_room(dataclasses.replace(SETTINGS, min_points=1.0, max_extent_m=12.0), sizes)
        first = np.array([1, 5, 7, 10])
        points = component[None], xy, np.zeros(11, np.float32), np.ones(11, bool)
        clusters = select_clusters(*points, first, config, 0.0)
        none = sum(sizes)
        assert clusters.found.tolist() == [3, 2, 2]
        assert clusters.kept.tolist() == np.minimum([3, 2, 2], sizes).tolist()
        assert clusters.row[:10].tolist() == [rows.get(c, none) for c in range(10)]
        assert clusters.num_points.tolist() == [1] * len(rows) + [0] * (none - len(rows))


@pytest.mark.usefixtures("platform")
def test_fitted_points_are_exactly_those_of_the_reference(cases):
    settings = parity.CONFIG.box
    for case in cases:
        height = case.obstacles.height
        in_slab = (height > settings.slab_min_height_m) & (height < settings.slab_max_height_m)
        few = np.bincount(case.slot[in_slab & (case.slot >= 0)], minlength=len(case.proposals))
        share = np.float32(settings.min_slab_share)
        size = np.bincount(case.slot[case.slot >= 0], minlength=len(case.proposals)).astype(np.float32)
        few = few < np.maximum(settings.min_slab_points, share * size)
        used = (case.slot >= 0) & (in_slab | few[case.slot])
        xy, z = np.split(case.obstacles.xyz.astype(np.float32), [2], axis=1)
        places = (parity.pad(values, parity.MAX_OBSTACLES) for values in (xy, z[:, 0]))
        rank = np.asarray(sampling_rank(*places))[: len(xy)]
        num = np.bincount(case.slot[used], minlength=parity.MAX_CLUSTERS).astype(np.int32)
        used &= rank < np.asarray(sampled_share(num, max_points=settings.max_points))[case.slot]
        rows = np.flatnonzero(used)
        lists = list_points(
            parity.pad(case.slot[rows], parity.MAX_OBSTACLES),
            parity.pad(rows, parity.MAX_OBSTACLES),
            np.int32(len(rows)),
            parity.pad(xy, parity.MAX_OBSTACLES),
            num_clusters=parity.MAX_CLUSTERS,
            max_points=settings.max_points,
        )
        x, y, count = map(np.asarray, lists.table(np.arange(parity.MAX_CLUSTERS)))
        assert not count[len(case.proposals) :].any()
        # Points on the edges of cells, which single precision puts into either.
        on_edges = set(np.flatnonzero(rank != reference.sampling_rank(case.obstacles.xyz)))
        assert len(on_edges) < 1e-3 * len(rank)
        for row, proposal in enumerate(case.proposals):
            expected = reference.fit_points(proposal.members, case.obstacles.xyz, height, settings)
            if set(proposal.members) & on_edges:
                continue
            points = np.stack([x[: count[row], row], y[: count[row], row]], axis=1)
            np.testing.assert_array_equal(points, xy[expected])
