"""Agreement of grid components with Euclidean clusters by KD-tree and queue, on real sweeps."""

import importlib
import itertools
import pathlib

import numpy as np
import parity
import pytest

from jaxbox import DetectorConfig

RADIUS_M = 0.6
"""Corresponds to the paper preset's cells of 0.35 m."""


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(pathlib.Path(__file__).parents[1]))
    return importlib.import_module("benchmarks.bench_clustering_agreement")


@pytest.mark.parametrize("seed", range(5))
def test_rand_index_is_that_of_all_pairs(bench, seed):
    rng = np.random.default_rng(seed)
    first, second = rng.integers(0, 4, (2, 30))
    second[: 6 * seed] = first[: 6 * seed]
    pairs = np.array(list(itertools.combinations(range(30), 2))).T
    in_first, in_second = (labels[pairs[0]] == labels[pairs[1]] for labels in (first, second))
    expected = in_first.mean() * in_second.mean()
    index = (np.mean(in_first & in_second) - expected) / ((in_first.mean() + in_second.mean()) / 2 - expected)
    assert bench.adjusted_rand_index(first, second) == pytest.approx(index)


def test_a_cluster_is_the_same_only_where_both_share_nine_tenths_of_it(bench):
    first = np.repeat([0, 1, 2, -1], [100, 50, 20, 30])
    split = np.where(np.arange(200) < 92, 0, np.where(first == 1, 1, -1))
    split[160:180] = 1
    # The first is cut to 92 of 100, the second is merged into 70 points, the third is gone.
    assert bench.share_in_same_clusters(first, split) == pytest.approx(100 / 170)
    assert bench.share_in_same_clusters(first, first) == 1
    assert bench.share_in_same_clusters(first, np.full(200, -1)) == 0


@pytest.mark.slow
def test_grid_components_of_real_sweeps_agree_with_euclidean_clusters(bench, data_root):
    config = DetectorConfig.paper()
    for case in parity.real_cases(data_root)[2:4]:
        xyz, component = bench.grid_components(case.xyz, config)
        result = bench.agreement(xyz, component, radius_m=RADIUS_M, config=config)
        assert result["rand_index"] > 0.93
        assert result["share_same"] > 0.65
        assert result["grid_clusters"] == pytest.approx(result["euclidean_clusters"], rel=0.1)
