"""`jaxbox info` names the option that mends wrong units, axes and origins, and doubts no good sweep."""

import numpy as np
import pytest
from typer.testing import CliRunner

from jaxbox import io, synthetic
from jaxbox.cli.app import app
from jaxbox.cli.doubts import doubts_about
from jaxbox.geometry.mounting import measure_mounting

WRONG = {
    "mm": (lambda x, y, z: (1000 * x, 1000 * y, 1000 * z), "--scale 0.001 "),
    "cm": (lambda x, y, z: (100 * x, 100 * y, 100 * z), "--scale 0.01 "),
    "feet": (lambda x, y, z: (x / 0.3048, y / 0.3048, z / 0.3048), "--scale 0.3048 "),
    "camera": (lambda x, y, z: (-y, -z, x), "--axes camera "),
    "ned": (lambda x, y, z: (x, -y, -z), "--axes ned "),
    "z_down": (lambda x, y, z: (x, y, -z), "--flip z"),
    "y_up": (lambda x, y, z: (-y, z, -x), "--axes=-z,-x,y "),
    "camera_mm": (lambda x, y, z: (-1000 * y, -1000 * z, 1000 * x), "--scale 0.001 --axes camera "),
    "map": (lambda x, y, z: (x + 461_000, y + 5_430_000, z + 112), "--sensor-at X Y Z .* lost centimetres"),
    "yard": (lambda x, y, z: (x + 350, y - 200, z), "at 3.. -2.. .*--sensor-at X Y Z"),
    "altitude": (lambda x, y, z: (x, y, z + 112), r"--sensor-at 0 0 11[12]"),
    "mast": (lambda x, y, z: (x, y, z - 20), r"--sensor-at 0 0 -(20|19.9)"),
}


def doubts(xyz):
    return doubts_about(xyz, measure_mounting(xyz))


@pytest.fixture(scope="module")
def sweeps(data_root):
    """Sweeps of four data sets; about 30,000 points each."""
    files = sorted((data_root / "kitti_object").rglob("*.bin"))[::10]
    files += [sorted((data_root / name).rglob("*.bin"))[0] for name in ("kitti_raw", "semantic_kitti")]
    return [io.read_points(file)[0][::4] for file in files]


def test_no_real_sweep_is_doubted(data_root, sweeps):
    assert [doubts(xyz) for xyz in sweeps] == [()] * len(sweeps)
    others = [*(data_root / "pandaset").rglob("*.bin"), *(data_root / "argoverse2").rglob("*.bin")]
    others += (data_root / "pcd").rglob("*.pcd")
    assert len(others) > 2
    for file in others:
        # The origins of two are on the vehicle's ground, which is said elsewhere.
        assert doubts(io.read_points(file)[0]) == ()


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_with_a_real_sweep_is_told_with_its_mend(sweeps, name):
    wrong, expected = WRONG[name]
    for xyz in sweeps[1::3]:
        (doubt,) = doubts(np.stack(wrong(*xyz.T), axis=1))
        assert_told(doubt, expected)


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_with_a_synthetic_sweep_is_told_with_its_mend(name):
    wrong, expected = WRONG[name]
    xyz = synthetic.make_sweep(1, num_azimuths=300).xyz
    assert doubts(xyz) == ()
    (doubt,) = doubts(np.stack(wrong(*xyz.T), axis=1))
    assert_told(doubt, expected)


def assert_told(doubt, expected):
    with pytest.raises(ValueError, match=expected):
        raise ValueError(doubt)


def test_points_without_any_ground_are_asked_about():
    ball = np.random.default_rng(0).normal(size=(3000, 3)) * 20
    (doubt,) = doubts(ball)
    assert all(option in doubt for option in ("--scale", "--axes", "--flip", "--sensor-at"))
    assert doubts(np.zeros((0, 3))) == ()


def test_info_says_that_something_fits_only_where_there_is_a_ground(tmp_path):
    xyz = synthetic.make_sweep(1, num_azimuths=300).xyz
    for name, scale, more in (("mm", 1000, ()), ("mended", 1000, ("--scale", "0.001")), ("m", 1, ())):
        io.write_bin(tmp_path / f"{name}.bin", scale * xyz)
        done = CliRunner().invoke(app, ["info", str(tmp_path / f"{name}.bin"), *more])
        assert done.exit_code == 0, done.output
        assert ("fits: preset default" in done.stdout) == (name != "mm")
        assert ("nothing fits yet" in done.stdout) == (name == "mm")
        assert ("--scale 0.001 the sensor stands" in done.stdout.replace("\n", " ")) == (name == "mm")
        as_json = CliRunner().invoke(app, ["info", str(tmp_path / f"{name}.bin"), *more, "--json"])
        assert ('"fits": null' in as_json.stdout) == (name == "mm")
