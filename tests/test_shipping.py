"""Programs that come with an installation: made by a command, used where they fit, told where they do not."""

import os
import pathlib
import shutil
import subprocess
import sys
import tomllib

import jax
import jax.export
import numpy as np
import pytest
from test_detector import CAPACITY, run, street

import jaxbox
from jaxbox import DetectorConfig
from jaxbox.run import programs, shipping
from jaxbox.run.program_files import SUFFIX
from jaxbox.run.shipping import ship_programs, shipped_state

PROJECT = pathlib.Path(__file__).parents[1]

INSTALLED = """
import pathlib, sys
import jax, numpy as np
jax.config.update("jax_num_cpu_devices", 2)  # as the other tests, whose compiled functions it takes
import jaxbox
from jaxbox.run import programs
from jaxbox.run import shipping
config, root = jaxbox.DetectorConfig.paper(), pathlib.Path(jaxbox.__file__).parent
assert root == pathlib.Path(sys.argv[1]), root
if sys.argv[2] == "ship":
    shipping.ship_programs(programs.SHIPPED, [config], capacity=int(sys.argv[3]), platforms=["cpu"])
else:
    def trace(*_):
        raise SystemExit("it was traced")
    programs.trace = trace
    jaxbox.enable_cache(sys.argv[4])
    cloud = jaxbox.PointCloud.from_numpy(np.load(sys.argv[5]), capacity=int(sys.argv[3]))
    np.savez(sys.argv[6], *jax.tree.leaves(jax.device_get(jaxbox.detect(cloud, config))))
"""


@pytest.fixture
def quick(monkeypatch):
    """A quick stand-in for the detector's trace."""

    def trace(build, half):
        return jax.export.export(jax.jit(lambda x: x + len(half)))(build.operands()[1])

    monkeypatch.setattr(shipping, "trace", trace)


def test_an_installation_runs_what_was_shipped_with_it_and_writes_nothing_into_it(tmp_path):
    package = tmp_path / "site" / "jaxbox"
    leave = shutil.ignore_patterns("__pycache__", "data")
    shutil.copytree(pathlib.Path(jaxbox.__file__).parent, package, ignore=leave)
    environment = {**os.environ, "PYTHONPATH": str(package.parent), "PYTHONDONTWRITEBYTECODE": "1"}
    sweep, answer, kept = tmp_path / "sweep.npy", tmp_path / "answer.npz", tmp_path / "kept"
    np.save(sweep, street(0).xyz)

    def start(task):
        command = [sys.executable, "-c", INSTALLED, package, task, CAPACITY, kept, sweep, answer]
        subprocess.run([str(part) for part in command], env=environment, check=True, cwd=tmp_path)

    start("ship")
    files = {path: path.stat().st_mtime_ns for path in package.rglob("*")}
    for path in files:
        path.chmod(0o555 if path.is_dir() else 0o444)
    start("detect")
    assert {path: path.stat().st_mtime_ns for path in package.rglob("*")} == files
    assert list((kept / "programs").iterdir()) == []
    expected = jax.tree.leaves(run(street(0).xyz, config=DetectorConfig.paper()))
    with np.load(answer) as arrays:
        for name, leaf in zip(arrays.files, expected, strict=True):
            np.testing.assert_array_equal(arrays[name], leaf)


def test_each_preset_has_two_files_a_platform_and_they_fit(quick, tmp_path):
    presets = shipping.shipped_presets().values()
    assert DetectorConfig() in presets
    assert DetectorConfig.accurate() not in presets
    assert str(shipped_state(tmp_path)) == "none"
    written = ship_programs(tmp_path, list(presets))
    assert len(set(written)) == 2 * len(presets) * len(shipping.PLATFORMS)
    assert str(shipped_state(tmp_path)) == f"{len(written)} of {len(written)} fit"
    assert ship_programs(tmp_path, list(presets)) == written
    assert sorted(tmp_path.iterdir()) == sorted(written)


def test_what_does_not_fit_is_told_and_replaced(quick, tmp_path, monkeypatch):
    config = [DetectorConfig()]
    first, *_ = ship_programs(tmp_path, config, platforms=["cpu"])
    with monkeypatch.context() as patch:
        patch.setattr(programs, "source_digest", lambda: "another")
        ship_programs(tmp_path / "other", config, platforms=["cpu"])
    for path in (tmp_path / "other").iterdir():
        shutil.copy(path, tmp_path)
    first.write_bytes(first.read_bytes()[:-1])
    state = shipped_state(tmp_path)
    assert (state.num_files, state.num_fitting) == (4, 1)
    assert set(state.misfits) == {"damaged", "made of another source"}
    ship_programs(tmp_path, config, platforms=["cpu"])
    assert shipped_state(tmp_path).num_files == shipped_state(tmp_path).num_fitting == 2


def test_programs_of_several_versions_of_jax_lie_side_by_side(quick, tmp_path, monkeypatch):
    config, here = [DetectorConfig()], jax.__version__
    with monkeypatch.context() as patch:
        patch.setattr(jax, "__version__", "0.0.1")
        ship_programs(tmp_path, config, platforms=["cpu"])
    assert str(shipped_state(tmp_path)) == f"0 of 2 fit (made by jax 0.0.1, not {here})"
    ship_programs(tmp_path, config, platforms=["cpu"])
    assert str(shipped_state(tmp_path)) == f"2 of 4 fit (made by jax 0.0.1, not {here})"


def test_the_command_writes_what_the_wheel_takes(quick, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shipping, "SHIPPED", tmp_path)
    shipping.main(["--presets", "fast", "--platforms", "cpu"])
    assert len(capsys.readouterr().out.splitlines()) == len(list(tmp_path.iterdir())) == 2
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())
    (pattern,) = (p for p in project["tool"]["setuptools"]["package-data"]["jaxbox"] if "programs" in p)
    package = pathlib.Path(jaxbox.__file__).parent
    assert (programs.SHIPPED / f"0{SUFFIX}").relative_to(package).match(pattern)


def test_no_program_is_under_version_control():
    # They would have to change with every change of the source.
    assert "/jaxbox/data/" in (PROJECT / ".gitignore").read_text().splitlines()
