"""Settings by dotted name: every threshold has one, and what cannot be changed so is refused."""

import dataclasses

import jax
import pytest

from jaxbox import io
from jaxbox.config import ComponentMap, DetectorConfig
from jaxbox.config.fields import (
    changed_fields,
    check_traced,
    config_from_toml,
    config_to_toml,
    parse_change,
    replace_fields,
    traced_fields,
)

PRESETS = list(DetectorConfig.presets().values())


@pytest.mark.parametrize("config", PRESETS, ids=DetectorConfig.presets())
def test_the_traced_settings_are_the_leaves_that_jit_sees(config):
    assert list(traced_fields(config).values()) == jax.tree.leaves(config)


@pytest.mark.parametrize("config", PRESETS, ids=DetectorConfig.presets())
def test_each_traced_setting_reaches_its_own_leaf_and_no_other(config):
    for position, name in enumerate(traced_fields(config)):
        changed = replace_fields(config, {name: 0.59375})
        differing = [
            i for i, pair in enumerate(zip(jax.tree.leaves(config), jax.tree.leaves(changed), strict=True))
            if pair[0] != pair[1]
        ]  # fmt: skip
        assert differing == [position], name
        assert jax.tree.structure(changed) == jax.tree.structure(config), "a threshold does not recompile"


def test_several_changes_are_made_together_and_the_rest_stays():
    base = DetectorConfig()
    changed = replace_fields(base, {"box.criterion": "closeness", "clustering.maps.2.min_height_m": 0.4})
    assert changed.box == dataclasses.replace(base.box, criterion="closeness")
    assert changed.clustering.maps[2].min_height_m == 0.4
    assert changed.clustering.maps[:2] == base.clustering.maps[:2]
    assert changed.vehicles == base.vehicles


def test_what_was_changed_is_what_changes_the_base_into_it():
    changes = {"box.criterion": "closeness", "clustering.maps.2.min_height_m": 0.4, "box.max_slab_points": 9}
    base = DetectorConfig()
    assert changed_fields(replace_fields(base, changes), base) == changes
    assert changed_fields(base, base) == {}


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
        ("region.half_x_m", -1, "must be a finite number above 0"),
        ("vehicles.ring_weight", 10**400, "must be a finite number, 0 or above"),
        ("box.num_angles", 10**30, "must be a whole number, 1 or above"),
        ("vehicles.max_detections", 0, "must be a whole number, 1 or above"),
    ],
)
def test_a_change_that_cannot_be_made_is_refused_by_name(name, value, expected):
    with pytest.raises(ValueError, match=expected) as error:
        replace_fields(DetectorConfig(), {name: value})
    assert name in str(error.value)


def test_a_static_setting_is_no_threshold_and_the_nearest_ones_are_named():
    with pytest.raises(ValueError, match="compile the detector again") as error:
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


# --- settings files -------------------------------------------------------------------------------


@pytest.mark.parametrize("config", PRESETS, ids=DetectorConfig.presets())
@pytest.mark.parametrize("base", PRESETS, ids=DetectorConfig.presets())
def test_a_written_file_makes_the_same_settings_from_any_base(tmp_path, config, base):
    config = replace_fields(config, {"clustering.max_obstacles": 9, "vehicles.min_score": 1e-9})
    assert config_from_toml(config_to_toml(config), base=base) == config
    io.write_config(tmp_path / "a.toml", config)
    assert io.read_config(tmp_path / "a.toml", base=base) == config


def test_tables_dotted_names_and_arrays_of_tables_say_the_same():
    changed = replace_fields(
        DetectorConfig(), {"vehicles.min_score": 0.5, "clustering.maps.1.min_height_m": 0.4}
    )
    for text in (
        "[vehicles]\nmin_score = 0.5\n[[clustering.maps]]\n[[clustering.maps]]\nmin_height_m = 0.4\n"
        "[[clustering.maps]]\n",
        "vehicles.min_score = 0.5\nclustering.maps.1.min_height_m = 0.4\n",
        '"vehicles.min_score" = 0.5\n"clustering.maps.1.min_height_m" = 0.4\n',
    ):
        assert config_from_toml(text) == changed


def test_a_file_names_its_preset_and_its_arrays_set_their_length():
    assert config_from_toml('preset = "paper"') == DetectorConfig.paper()
    assert config_from_toml('preset = "paper"', base=DetectorConfig()) == DetectorConfig()
    maps = config_from_toml("[[clustering.maps]]\n" * 4).clustering.maps
    assert maps == (*DetectorConfig().clustering.maps, ComponentMap())
    assert config_from_toml('box.max_slab_points = "none"').box.max_slab_points is None


def test_a_whole_number_for_a_threshold_compiles_nothing_anew():
    changed = config_from_toml("vehicles.ring_weight = 7")
    assert type(changed.vehicles.ring_weight) is float
    assert type(replace_fields(changed, {"region.half_x_m": 70}).region.half_x_m) is float


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[vehicles]\nmin_scor = 0.5", "no setting vehicles.min_scor; nearest are vehicles.min_score"),
        ("[vehicle]\nmin_score = 0.5", "no setting vehicle.min_score; nearest are vehicles.min_score"),
        ("[[clustering.mapz]]", "clustering.mapz is not a list; nearest lists are clustering.maps"),
        ("[[vehicles.classes]]", "vehicles.classes has 1 entries; it must have 3"),
        ("clustering.maps = []", "clustering.maps has 0 entries; it must have at least 1"),
        ("vehicles = 3", "no setting vehicles"),
        ("vehicles.min_score = [1, 2]", "must be a finite number"),
        ("vehicles.min_score = nan", "must be a finite number"),
        ("vehicles.min_score = 'none'", "must be a finite number"),
        ("preset = 'best'", "best: there is no such preset; choose one of default"),
        ("preset = ['best']", "there is no such preset"),
        ("a = = 1", "line 1"),
    ],
)
def test_a_file_that_cannot_be_taken_is_refused_with_its_name_and_the_setting(tmp_path, text, expected):
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(io.InputError, match=rf"a\.toml: .*{expected}"):
        io.read_config(tmp_path / "a.toml")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.toml", ".".join(["a"] * 5000) + " = 1"),
        ("a.toml", "[" + ".".join(["vehicles"] * 5000) + "]"),
        ("a.toml", '["".' + '"".' * 5000 + '""]'),
        ("a.toml", "vehicles.min_score = " + "[" * 5000 + "]" * 5000),
        ("a.json", '{"vehicles":' * 5000 + "1" + "}" * 5000),
        ("a.json", '{"vehicles.min_score":' + "[" * 900 + "]" * 900 + "}"),
        ("a.json", '{"preset":' + "[" * 900 + "]" * 900 + "}"),
        ("a.json", '{"sensor":' + "[" * 900 + "]" * 900 + "}"),
    ],
)
def test_tables_within_tables_without_end_are_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(io.InputError, match=name) as refused:
        io.read_config(tmp_path / name)
    assert len(str(refused.value)) < 500 + len(str(tmp_path))


def test_json_settings_are_taken_and_named_so(tmp_path):
    (tmp_path / "a.json").write_text('{"vehicles.min_score": 0.5, "box": {"max_slab_points": null}}')
    assert io.read_config(tmp_path / "a.json").vehicles.min_score == 0.5
    (tmp_path / "a.json").write_text("[1]")
    with pytest.raises(io.InputError, match="must be one object"):
        io.read_config(tmp_path / "a.json")
    (tmp_path / "a.json").write_text("vehicles.min_score = 0.5")
    with pytest.raises(io.InputError, match="no JSON"):
        io.read_config(tmp_path / "a.json")
