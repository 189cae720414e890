"""Each setting has a range, and a number outside it is refused, wherever it comes from."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbox import DetectorConfig, PointCloud, TrackConfig, detect, detect_batch, stream, track
from jaxbox.cli.config_options import chosen_config, chosen_track_config
from jaxbox.config import ComponentMap, ConfigError
from jaxbox.config.checks import check_config, check_ranges
from jaxbox.config.fields import all_fields, check_static, traced_fields, traced_ranges
from jaxbox.config.ranges import COUNT, NON_NEGATIVE, POSITIVE, SHARE, SIGNED, named_ranges
from jaxbox.io import InputError
from jaxbox.viewer.thresholds import THRESHOLDS

CONFIGS = (*DetectorConfig.presets().values(), TrackConfig())
CLOUD = PointCloud.from_numpy(np.zeros((0, 3)), capacity=1)
NEVER = (math.nan, math.inf, -math.inf, 1e39, True, "0.1", None)
"""No threshold is any of them; 1e39 is infinite in float32."""
OUTSIDE = {SIGNED: (), NON_NEGATIVE: (-1.0,), POSITIVE: (-1.0, 0.0, 1e-40), SHARE: (-0.1, 1.5)}


def with_leaf(config, index, value):
    leaves, structure = jax.tree.flatten(config)
    leaves[index] = value
    return jax.tree.unflatten(structure, leaves)


def stage_with(stage, **changes):
    config = DetectorConfig()
    return dataclasses.replace(config, **{stage: dataclasses.replace(getattr(config, stage), **changes)})


@pytest.mark.parametrize("config", [DetectorConfig(), TrackConfig()])
def test_every_threshold_refuses_what_would_silently_find_nothing(config):
    for index, (name, allowed) in enumerate(traced_ranges(config).items()):
        for value in (*NEVER, *OUTSIDE[allowed]):
            with pytest.raises(ConfigError) as refused:
                check_ranges(with_leaf(config, index, value))
            assert str(refused.value).startswith(f"{name} is "), name
            assert allowed.text in str(refused.value)


def test_the_presets_and_the_ends_of_the_sliders_are_within_their_ranges():
    for config in CONFIGS:
        check_ranges(config)
        ranges = traced_ranges(config)
        for slider in (slider for sliders in THRESHOLDS.values() for slider in sliders):
            if slider.name in ranges:
                for end in (slider.low, slider.high):
                    assert ranges[slider.name].minimum <= end <= ranges[slider.name].maximum, slider.name


def test_the_table_names_settings_that_there_are():
    names = {name for config in CONFIGS for name in all_fields(config)}
    known = {".".join(part for part in name.split(".") if not part.isdecimal()) for name in names}
    assert named_ranges() <= known


@pytest.mark.parametrize(
    ("config", "name"),
    [
        (stage_with("region", half_x_m=-1.0), "region.half_x_m"),
        (stage_with("region", half_y_m=math.nan), "region.half_y_m"),
        (stage_with("filtering", cell_m=0.0), "filtering.cell_m"),
        (stage_with("vehicles", max_detections=0), "vehicles.max_detections"),
        (stage_with("vehicles", max_detections=1.5), "vehicles.max_detections"),
        (stage_with("clustering", max_obstacles=-5), "clustering.max_obstacles"),
        (stage_with("clustering", maps=(ComponentMap(cell_m=0.0),)), "clustering.maps.0.cell_m"),
        (stage_with("clustering", maps=[ComponentMap(max_height_m=-1.0)]), "clustering.maps.0.max_height_m"),
        (stage_with("box", criterion="best"), "box.criterion"),
    ],
)
def test_static_settings_from_python_are_checked_as_those_from_files(config, name):
    with pytest.raises(ConfigError, match=f"^{name} is "):
        check_config(config)


@pytest.mark.parametrize(
    ("stage", "changes", "name"),
    [
        ("region", {"half_x_m": 1e9}, "filtering.cell_m"),
        ("filtering", {"cell_m": 1e-4}, "filtering.cell_m"),
        ("ground", {"surface_cell_m": 1e-3}, "ground.surface_cell_m"),
        ("ground", {"candidate_half_x_m": 1e9}, "ground.candidate_half_x_m"),
        ("clustering", {"maps": (ComponentMap(), ComponentMap(cell_m=1e-3))}, "clustering.maps.1.cell_m"),
    ],
)
def test_grids_of_more_cells_than_can_be_numbered_are_refused(stage, changes, name):
    with pytest.raises(ConfigError, match=f"^{name}: cells of .* Take larger cells"):
        check_config(stage_with(stage, **changes))


def test_numpys_numbers_are_as_good_as_pythons():
    check_config(stage_with("vehicles", max_detections=np.int64(7), min_score=np.float32(0.5)))
    check_static(stage_with("region", half_x_m=np.float64(70)))
    check_config(stage_with("vehicles", min_score=jnp.float32(0.5), ring_weight=np.array(3.0)))


@pytest.mark.parametrize("value", [math.nan, jnp.float32(jnp.nan), np.float32(-1), jnp.array([0.1, 0.2])])
def test_whoever_takes_settings_refuses_a_bad_threshold_at_once(value):
    config = stage_with("vehicles", min_score=value)
    for call in (
        lambda: detect(CLOUD, config),
        lambda: detect_batch([CLOUD], config),
        lambda: stream([], config),
        lambda: track([], config),
    ):
        with pytest.raises(ConfigError, match=r"vehicles\.min_score is .* from 0 to 1"):
            call()
    with pytest.raises(ConfigError, match="gate is "):
        track([], None, TrackConfig(gate=0.0))


def test_thresholds_that_are_traced_are_taken_as_they_come():
    leaves, structure = jax.tree.flatten(DetectorConfig())
    spread = jax.tree.unflatten(structure, [np.full(2, leaf, np.float32) for leaf in leaves])
    checked = jax.vmap(lambda config: check_config(config) or config.vehicles.min_score)(spread)
    assert checked.tolist() == pytest.approx([traced_fields(DetectorConfig())["vehicles.min_score"]] * 2)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ("region.half_x_m=-1", "region.half_x_m is -1; it must be a finite number above 0"),
        ("vehicles.max_detections=0", f"it must be {COUNT.text}"),
        ("vehicles.min_score=1e400", "vehicles.min_score is inf"),
        ("vehicles.min_score=" + "[" * 5000, "it must be a finite number from 0 to 1"),
        ("vehicles.min_score=" + "-" * 50000 + "1", "it must be a finite number from 0 to 1"),
    ],
)
def test_the_command_line_refuses_them_in_a_sentence(change, text):
    with pytest.raises(InputError, match=r"^--set: ") as refused:
        chosen_config(None, None, [change])
    assert text in str(refused.value)
    assert len(str(refused.value)) < 300
    with pytest.raises(InputError, match=r"^--track-set: gate is 0"):
        chosen_track_config(["gate=0"])
