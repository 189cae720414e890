"""Settings by dotted name: every threshold has one, and what cannot be changed so is refused."""

import dataclasses

import jax
import pytest

from jaxbox.config import DetectorConfig
from jaxbox.settings import changed_settings, check_traced, parse_change, replace_settings, traced_settings

PRESETS = list(DetectorConfig.presets().values())


@pytest.mark.parametrize("config", PRESETS, ids=DetectorConfig.presets())
def test_the_traced_settings_are_the_leaves_that_jit_sees(config):
    assert list(traced_settings(config).values()) == jax.tree.leaves(config)


@pytest.mark.parametrize("config", PRESETS, ids=DetectorConfig.presets())
def test_each_traced_setting_reaches_its_own_leaf_and_no_other(config):
    for position, name in enumerate(traced_settings(config)):
        changed = replace_settings(config, {name: 123.25})
        differing = [
            i for i, pair in enumerate(zip(jax.tree.leaves(config), jax.tree.leaves(changed), strict=True))
            if pair[0] != pair[1]
        ]  # fmt: skip
        assert differing == [position], name
        assert jax.tree.structure(changed) == jax.tree.structure(config), "a threshold does not recompile"


def test_several_changes_are_made_together_and_the_rest_stays():
    base = DetectorConfig()
    changed = replace_settings(base, {"box.criterion": "closeness", "clustering.maps.2.min_height_m": 0.4})
    assert changed.box == dataclasses.replace(base.box, criterion="closeness")
    assert changed.clustering.maps[2].min_height_m == 0.4
    assert changed.clustering.maps[:2] == base.clustering.maps[:2]
    assert changed.vehicles == base.vehicles


def test_what_was_changed_is_what_changes_the_base_into_it():
    changes = {"box.criterion": "closeness", "clustering.maps.2.min_height_m": 0.4, "box.max_slab_points": 9}
    base = DetectorConfig()
    assert changed_settings(replace_settings(base, changes), base) == changes
    assert changed_settings(base, base) == {}


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("vehicles.ring_wieght", 1.0, "nearest are vehicles.ring_weight"),
        ("clustering.maps.9.min_height_m", 1.0, "there is no setting"),
        ("vehicles", 1.0, "there is no setting"),
        ("vehicles.ring_weight", "much", "must be a finite number"),
        ("vehicles.ring_weight", float("nan"), "must be a finite number"),
        ("vehicles.ring_weight", True, "must be a finite number"),
        ("filtering.enabled", 1, "must be True or False"),
        ("box.num_angles", 45.5, "must be a whole number"),
        ("clustering.max_obstacles", "many", "must be None or a whole number"),
        ("box.criterion", "best", "choose one of area, variance"),
    ],
)
def test_a_change_that_cannot_be_made_is_refused_by_name(name, value, expected):
    with pytest.raises(ValueError, match=expected) as error:
        replace_settings(DetectorConfig(), {name: value})
    assert name in str(error.value)


def test_a_static_setting_is_no_threshold_and_the_nearest_ones_are_named():
    with pytest.raises(ValueError, match="compile the detector anew") as error:
        check_traced(DetectorConfig(), "clustering.maps.0.cell_m")
    assert "clustering.maps.0.min_height_m" in str(error.value)
    with pytest.raises(ValueError, match=r"no setting .*: completion.free_weight"):
        check_traced(DetectorConfig(), "completion.fre_weight")
    check_traced(DetectorConfig(), "completion.free_weight")


def test_a_change_is_a_literal_or_a_word():
    assert parse_change("filtering.enabled = False") == ("filtering.enabled", False)
    assert parse_change("clustering.max_obstacles=None") == ("clustering.max_obstacles", None)
    with pytest.raises(ValueError, match="FIELD=VALUE"):
        parse_change("filtering.enabled")
