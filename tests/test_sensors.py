"""Settings for sensors of fewer and more beams, and which of them fits a sweep."""

import dataclasses
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from jaxbox import DEFAULT_SCORE_THRESHOLD, DetectorConfig, io, synthetic
from jaxbox.cli import app, sweep_info
from jaxbox.cli.config_options import chosen_config
from jaxbox.config.fields import changed_fields, config_from_toml
from jaxbox.config.presets import CAPACITY_STEP
from jaxbox.config.sensors import SENSORS, fitting_sensor
from jaxbox.evaluation import thin_beams


@pytest.mark.parametrize("preset", DetectorConfig.presets())
def test_the_presets_are_for_64_beams(preset):
    base = DetectorConfig.presets()[preset]
    assert DetectorConfig.for_sensor(64, base=base) == base
    assert DetectorConfig.presets(num_beams=64)[preset] == base


@pytest.mark.parametrize("num_beams", SENSORS)
@pytest.mark.parametrize("preset", DetectorConfig.presets())
def test_a_sensor_changes_what_its_table_says_and_the_maps_capacities(preset, num_beams):
    base, sensor = DetectorConfig.presets()[preset], SENSORS[num_beams]
    config = DetectorConfig.presets(num_beams=num_beams)[preset]
    wanted = {
        f"{stage}.{name}": value for stage, row in sensor.changes.items() for name, value in row.items()
    }
    changed = changed_fields(config, base)
    cells = {name: value for name, value in changed.items() if name.endswith(".max_cells")}
    assert {name: value for name, value in changed.items() if name not in cells} == wanted
    if num_beams == 64:
        assert not changed
    else:
        assert len(cells) == len(base.clustering.maps)
        for before, after in zip(base.clustering.maps, config.clustering.maps, strict=True):
            assert after.max_cells % CAPACITY_STEP == 0
            assert 0 <= after.max_cells - sensor.cells * before.max_cells < CAPACITY_STEP


def test_fewer_beams_ask_for_fewer_points_and_a_wider_ground():
    points = [DetectorConfig.for_sensor(n).vehicles.saturation_points for n in sorted(SENSORS)]
    assert points == sorted(points)
    assert points[0] < points[1] < points[2]
    smoothing = {n: DetectorConfig.for_sensor(n).ground.smoothing_m for n in SENSORS}
    assert min(smoothing[16], smoothing[32]) > smoothing[64]


@pytest.mark.parametrize("num_beams", [0, 63, -16])
def test_other_numbers_of_beams_are_refused(num_beams):
    with pytest.raises(ValueError, match="choose one of 16, 32, 64, 128"):
        DetectorConfig.for_sensor(num_beams)
    with pytest.raises(io.InputError, match=f"--sensor {num_beams}: "):
        chosen_config(None, None, [], sensor=num_beams)


def test_a_settings_file_names_its_sensor_and_the_command_line_goes_before_it(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text('preset = "fast"\nsensor = 16\nbox.slab_max_height_m = 0.7\n')
    fast16 = DetectorConfig.for_sensor(16, base=DetectorConfig.fast())
    expected = dataclasses.replace(fast16, box=dataclasses.replace(fast16.box, slab_max_height_m=0.7))
    assert io.read_config(file) == config_from_toml(file.read_text()) == expected
    assert chosen_config(None, file, []) == expected
    # The file's changes come after the sensor, single changes after the file.
    config = chosen_config("default", file, ["vehicles.top_grade=0.02"], sensor=32)
    default32 = DetectorConfig.for_sensor(32)
    changes = {"box.slab_max_height_m": 0.7, "vehicles.top_grade": 0.02}
    assert changed_fields(config, default32) == changes
    # What is written is exact: it names every value and no sensor, so that reading it changes nothing.
    io.write_config(tmp_path / "exact.toml", config)
    assert io.read_config(tmp_path / "exact.toml") == config


@pytest.mark.parametrize(
    ("text", "expected"), [("sensor = 20", "20: "), ('sensor = "32"', "number of beams")]
)
def test_a_sensor_that_is_none_is_refused_by_file(text, expected, tmp_path):
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(io.InputError, match=rf"a\.toml: .*{expected}"):
        io.read_config(tmp_path / "a.toml")


def fits(xyz):
    info = sweep_info.look_at("a", xyz, np.zeros(len(xyz)))
    return info, sweep_info.fitting_beams([info])


@pytest.mark.parametrize("num_beams", SENSORS)
def test_info_finds_the_sensor_of_a_sweep(num_beams):
    xyz = synthetic.make_sweep(2, num_beams=num_beams, num_azimuths=400).xyz
    info, beams = fits(xyz)
    assert (info.num_beams, beams) == (num_beams, num_beams)
    options = sweep_info.advised_options([info], beams)
    assert options == ([] if num_beams == 64 else ["--sensor", str(num_beams)])


def test_info_finds_the_sensor_of_real_and_of_thinned_sweeps(data_root):
    xyz, _ = io.open_sweeps(data_root / "kitti_object")[0].read_points()
    for num_beams in (64, 32, 16):
        keep = thin_beams(xyz, num_beams=64, keep_every=64 // num_beams)
        info, beams = fits(xyz[keep])
        assert (info.num_beams, beams) == (num_beams, num_beams)


def test_what_counts_is_how_far_apart_the_beams_are():
    # 32 beams over 40 degrees, and 64 over 13: what a 16 and a 128 of KITTI's view see.
    assert fitting_sensor(40 / 30) == 16
    assert fitting_sensor(13 / 63) == 128
    assert sweep_info.fitting_beams([]) == 64


@pytest.mark.parametrize(
    ("pitch_deg", "up_m", "options"), [(0, 0, []), (10, 0, ["--level"]), (0, 1.73, ["--level"])]
)
def test_info_advises_to_level_what_is_tilted_or_seen_from_the_ground(pitch_deg, up_m, options):
    sin, cos = np.sin(np.radians(pitch_deg)), np.cos(np.radians(pitch_deg))
    pitch = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    xyz = synthetic.make_sweep(2, num_azimuths=400).xyz @ pitch.T + np.array([0, 0, up_m])
    info, _ = fits(xyz)
    assert info.tilt_deg == pytest.approx(pitch_deg, abs=0.2)
    assert sweep_info.advised_options([info], 64) == options


@pytest.mark.slow
def test_detect_sees_a_tilted_sweep_from_the_ground_upright(tmp_path):
    sweep = synthetic.make_sweep(0, num_beams=32, num_azimuths=520)
    sin, cos = np.sin(np.radians(15)), np.cos(np.radians(15))
    pitch = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    sensor_at = np.array([1.0, 0.5, 1.73])
    np.save(tmp_path / "upright.npy", sweep.xyz)
    np.save(tmp_path / "tilted.npy", sweep.xyz @ pitch.T + sensor_at)
    options = ["--preset", "fast", "--capacity", "16384", "--format", "jsonl", "--no-pictures", "--quiet"]
    mounted = ["--level", "--sensor-at", *map(str, sensor_at)]
    boxes = {}
    for name, more in (("upright", []), ("tilted", mounted)):
        words = [tmp_path / f"{name}.npy", "--output", tmp_path / name, *options, *more]
        result = CliRunner().invoke(app, ["detect", *map(str, words)])
        assert result.exit_code == 0, result.output
        record = io.read_jsonl(tmp_path / name / "detections.jsonl")[0]
        boxes[name] = np.array(
            [b["center"] for b in record["boxes"] if b["score"] >= DEFAULT_SCORE_THRESHOLD]
        )
    assert len(boxes["tilted"]) >= len(boxes["upright"]) - 1 >= 2
    # Of boxes worth acting on, at most one is another's: the points differ by a hair.
    distance = np.linalg.norm(boxes["tilted"][:, None] - boxes["upright"], axis=-1).min(axis=0)
    assert np.sum(distance < 0.3) >= len(boxes["upright"]) - 1
    T = np.array(json.loads((tmp_path / "tilted" / "run.json").read_text())["mounting"]["T_level_points"])
    np.testing.assert_allclose(T[:3, :3] @ pitch, np.eye(3), atol=0.01)
    np.testing.assert_allclose(T @ [*sensor_at, 1], [0, 0, 0, 1], atol=1e-5)


@pytest.mark.slow
def test_resuming_where_the_archive_grew_goes_on_in_the_level_frame_of_the_earlier_run(tmp_path):
    xyz = synthetic.make_sweep(0, num_beams=32, num_azimuths=520).xyz
    output, sweeps = tmp_path / "out", tmp_path / "sweeps"

    def detect(*more):
        words = ["--preset", "fast", "--capacity", "16384", "--format", "jsonl", "--no-pictures", "--resume"]
        return CliRunner().invoke(app, ["detect", str(sweeps), "--output", str(output), *words, *more])

    sweeps.mkdir()
    for number, tilt in enumerate((0.2, 0.1)):
        pitch = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
        np.save(sweeps / f"{number}.npy", xyz @ pitch.T)
        result = detect("--level")
        assert result.exit_code == 0, result.output
        assert "tilted 11.5 degrees" in result.stdout
    assert [record["name"] for record in io.read_jsonl(output / "detections.jsonl")] == ["0", "1"]
    for options, expected in (
        ((), "level differ"),
        (("--level", "--sensor-at", "0", "0", "1"), "sensor_at differ"),
    ):
        result = detect(*options)
        assert result.exit_code == 2
        assert expected in result.stderr
    account = json.loads((output / "run.json").read_text())
    (output / "run.json").write_text(json.dumps(account | {"mounting": {"up": [0, 1]}}))
    assert "does not say how the sensor stood" in detect("--level").stderr
