"""The ablation: each row is a valid change of the preset, and differences are taken copy by copy."""

import importlib
import pathlib

import jax
import numpy as np
import pytest

from jaxbox import DetectorConfig
from jaxbox.config.checks import check_config
from jaxbox.config.fields import replace_fields


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(pathlib.Path(__file__).parents[1]))
    return importlib.import_module("benchmarks.bench_ablation")


def test_every_ablation_changes_the_default_preset_to_one_that_detect_takes(bench):
    seen = [DetectorConfig()]
    for ablation in bench.ABLATIONS:
        config = replace_fields(DetectorConfig(), ablation.changes)
        check_config(config)
        assert config not in seen, f"{ablation.name} repeats another row"
        seen.append(config)
    assert len({ablation.name for ablation in bench.ABLATIONS}) == len(bench.ABLATIONS)


def test_most_ablations_share_the_compiled_program_of_the_preset(bench):
    static = jax.tree.structure(DetectorConfig())
    changed = [replace_fields(DetectorConfig(), ablation.changes) for ablation in bench.ABLATIONS]
    shared = [config for config in changed if jax.tree.structure(config) == static]
    assert len(shared) > len(changed) / 2


def figures(bench, values):
    return {str(copy): dict.fromkeys(bench.COLUMNS, value) for copy, value in enumerate(values)}


def test_a_spread_that_both_share_is_not_in_the_error_of_their_difference(bench):
    full = np.array([60.0, 70.0, 80.0])
    summary = bench.compare(figures(bench, full - 2), figures(bench, full))["SOFT"]
    assert summary == pytest.approx({"mean": 68, "sd": 10, "difference": -2, "difference_error": 0})


def test_the_error_of_a_difference_is_that_of_a_mean_of_differences(bench):
    difference = np.array([1.0, 2.0, 6.0, 7.0])
    summary = bench.compare(figures(bench, 50 + difference), figures(bench, [50.0] * 4))["SOFT"]
    assert summary["difference"] == pytest.approx(4)
    assert summary["difference_error"] == pytest.approx(np.std(difference, ddof=1) / 2)


def test_one_copy_has_no_spread(bench):
    summary = bench.compare(figures(bench, [50.0]), figures(bench, [51.0]))["SOFT"]
    assert (summary["sd"], summary["difference_error"], summary["difference"]) == (None, None, -1)
