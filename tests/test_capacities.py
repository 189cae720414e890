"""Laws of the one table of capacities: each has a row, and its bit is set where the count exceeds it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbox import DetectorConfig, Status
from jaxbox.config.capacities import CAPACITIES, capacity_sizes, obstacle_capacity, slab_capacity
from jaxbox.config.fields import all_fields, replace_fields, traced_fields
from jaxbox.types import Counts

NUM_ROWS = 1001
NO_CAPACITY = {"ground.max_planes", "box.max_points"}
"""A number of rounds, and a number of points that stand for all: nothing is dropped beyond them."""


def counts(config, **changes):
    """Counts of a sweep without anything, but for what is given."""
    values = {field.name: jnp.int32(0) for field in dataclasses.fields(Counts)}
    per_map = jnp.zeros(len(config.clustering.maps), jnp.int32)
    return Counts(**values | {"cells": per_map, "clusters": per_map} | changes)


@pytest.mark.parametrize("config", DetectorConfig.presets().values(), ids=DetectorConfig.presets())
def test_every_capacity_of_the_configuration_has_a_row(config):
    static = set(all_fields(config)) - set(traced_fields(config))
    capacities = {name for name in static if name.split(".")[-1].startswith("max_")} - NO_CAPACITY
    unused = {"box.max_slab_points"} if config.box.fit_to == "hull" else set()
    assert set(capacity_sizes(config, NUM_ROWS)) == capacities - unused


def test_every_row_has_a_count_of_its_own_and_a_bit():
    assert len({row.count for row in CAPACITIES}) == len({row.field for row in CAPACITIES}) == len(CAPACITIES)
    assert {row.count for row in CAPACITIES} <= {field.name for field in dataclasses.fields(Counts)}
    bits = {bit.name for bit in Status if bit.name.endswith("_OVERFLOW")}
    assert {row.status for row in CAPACITIES} == bits - {"POINT_OVERFLOW"}
    for row in CAPACITIES:
        (sentence,) = Status[row.status].describe()
        assert row.overflow in sentence
        assert row.field.split(".")[-1] in row.overflow


@pytest.mark.parametrize("row", CAPACITIES, ids=lambda row: row.field)
def test_a_bit_is_set_exactly_where_a_count_exceeds_its_capacity(row):
    config = DetectorConfig()
    names = row.sizes(config, NUM_ROWS)
    for i, (name, size) in enumerate(names.items()):
        for excess, is_set in ((-1, False), (0, False), (1, True)):
            needed = np.zeros(len(names), np.int32)
            needed[i] = size + excess
            given = counts(config, **{row.count: jnp.asarray(needed if row.is_per_map else needed[0])})
            bits = given.overflows(config, NUM_ROWS)
            assert {bit for bit in bits if bits[bit]} == ({Status[row.status]} if is_set else set()), name
            traced = jax.jit(Counts.overflows, static_argnums=(2,))(given, config, NUM_ROWS)
            assert all(traced[bit] == bits[bit] for bit in bits)


def test_a_capacity_that_is_not_used_is_never_full():
    paper = DetectorConfig.paper()
    assert not any(counts(paper, slab_points=jnp.int32(10**9)).overflows(paper, NUM_ROWS).values())


def test_capacities_without_a_number_are_a_share_of_the_cloud_rounded_up():
    config = DetectorConfig()
    assert [obstacle_capacity(config, n) for n in (1, 4, 1001)] == [1, 3, 751]
    # A quarter of few rows, an eighth of many.
    sizes = [slab_capacity(config, n) for n in (8, 1001, 2**16, 2**17, 2**18)]
    assert sizes == [2, 252, 2**14, 2**14, 2**15]
    given = replace_fields(config, {"clustering.max_obstacles": 7, "box.max_slab_points": 5})
    assert (obstacle_capacity(given, NUM_ROWS), slab_capacity(given, NUM_ROWS)) == (7, 5)
