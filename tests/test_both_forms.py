"""Steps of `detect` in both of their forms, for a CPU and for an accelerator: the same, at the edges too."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import parity
import pytest

from jaxbox import DetectorConfig
from jaxbox.config import ComponentMap
from jaxbox.stages.clustering import propose_clusters
from jaxbox.stages.state import Obstacles
from jaxbox.xla import backend, rows
from jaxbox.xla.chunks import MAP_POINTS as CHUNK

ROOM = CHUNK + 900
"""Rows for obstacles: no whole number of chunks."""


def test_a_function_per_form_keeps_the_program_of_each():
    total = parity.PerForm(rows.prefix_sum)
    values = np.arange(700, dtype=np.int32)
    loops = []
    for accelerator in (False, True, False, True):
        with backend.building_for(accelerator=accelerator):
            np.testing.assert_array_equal(total(values), np.cumsum(values))
            loops.append(total.jitted.lower(values).as_text().count("stablehlo.while"))
    assert loops == [1, 0, 1, 0]


# Proposals.


@functools.cache
def two_maps():
    """Settings of a map seen from above and one in space, with little room for cells and clusters."""
    base = DetectorConfig()
    maps = (
        ComponentMap(cell_m=0.2, max_cells=2048, max_clusters=40),
        ComponentMap(cell_m=0.5, num_levels=8, max_cells=1024, max_clusters=24, max_height_m=3.5),
    )
    # No point is drawn nearer: that rounds otherwise in another form, and so across the edge of a cell.
    clustering = dataclasses.replace(base.clustering, maps=maps, min_points=3.0, adaptive_start_m=1e3)
    return dataclasses.replace(base, clustering=clustering)


@parity.PerForm
def propose(xy, height, num_points):
    obstacles = Obstacles(jnp.arange(ROOM), xy, jnp.zeros_like(height), height, num_points, ROOM)
    return propose_clusters(obstacles, two_maps())


def heaps_of_points(seed, spread_m, num_heaps):
    """(ROOM, 2) and (ROOM,) m: heaps of points about places all over the region, and some beyond it."""
    rng = np.random.default_rng(seed)
    place = rng.uniform([-90, -60], [90, 60], (num_heaps, 2))
    xy = place[rng.integers(num_heaps, size=ROOM)] + rng.normal(0, spread_m, (ROOM, 2))
    return xy.astype(np.float32), rng.uniform(0, 4, ROOM).astype(np.float32)


@pytest.mark.parametrize("num_points", [0, 1, CHUNK - 1, CHUNK, CHUNK + 1, ROOM, 2 * ROOM])
@pytest.mark.parametrize(("spread_m", "num_heaps"), [(0.5, 30), (0.8, 150), (0.0, 1)])
def test_proposals_are_the_same_bits_in_both_forms(num_points, spread_m, num_heaps):
    xy, height = heaps_of_points(num_points, spread_m, num_heaps)
    cpu, other = parity.in_both_forms(propose, xy, height, np.int32(num_points))
    for field in dataclasses.fields(cpu):
        one, two = getattr(cpu, field.name), getattr(other, field.name)
        kept = slice(int(cpu.num)) if field.name in ("num_points", "low", "high") else ...
        np.testing.assert_array_equal(one[kept], two[kept], err_msg=field.name)
    assert (cpu.num > 0) == (num_points > 1 and num_heaps > 1)
    # The last heaps find no room for their cells, nor for their clusters.
    assert (cpu.num_runs.sum() > 3072) == (num_points > 1 and num_heaps == 150)
