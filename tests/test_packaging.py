"""What an installation brings along: the time of its import, what that loads, the version."""

import importlib.metadata
import json
import pathlib
import re
import subprocess
import sys
import tomllib

import pytest
import yaml

import jaxbox

PROJECT = pathlib.Path(__file__).parents[1]
HEAVY = {
    "IPython", "cv2", "foxglove", "laspy", "matplotlib", "mcap", "open3d", "ouster", "pandas", "polars",
    "pyarrow", "pypcd4", "ray", "rerun", "rich", "rosbags", "scipy", "typer", "velodyne_decoder", "viser",
}  # fmt: skip
"""Optional, or of one part only: imported where they are used."""
MAX_IMPORT_S = 1.0
"""CPU time of jaxbox's import beyond JAX's; about 0.2 s on the machine that the benchmarks ran on."""

PROGRAM = """
import json, sys, time
import jax, jax.numpy, numpy
before = set(sys.modules)
start = time.process_time()
import jaxbox
seconds = time.process_time() - start
loaded = {name.partition(".")[0] for name in set(sys.modules) - before}
later = [jaxbox.io.read_points.__name__, jaxbox.synthetic.make_sweep.__name__, hasattr(jaxbox, "images")]
print(json.dumps({"seconds": seconds, "loaded": sorted(loaded), "file": jaxbox.__file__, "later": later}))
"""


@pytest.fixture(scope="module")
def imported():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_the_import_loads_nothing_heavy(imported):
    assert "jaxbox" in imported["loaded"]
    assert not HEAVY & set(imported["loaded"])


def test_what_messages_and_pages_name_is_there_after_the_import_alone(imported):
    assert imported["later"] == ["read_points", "make_sweep", False]


def test_the_import_takes_less_than_a_second_beyond_jax(imported):
    assert 0 < imported["seconds"] < MAX_IMPORT_S


def test_types_are_marked_and_shipped():
    assert (pathlib.Path(jaxbox.__file__).parent / "py.typed").is_file()
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())
    assert "py.typed" in project["tool"]["setuptools"]["package-data"]["jaxbox"]


def test_the_version_is_written_in_one_place():
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "jaxbox._version.__version__"}
    assert project["project"]["dynamic"] == ["version"]
    assert importlib.metadata.version("jaxbox") == jaxbox.__version__
    written = [
        path.name
        for path in (PROJECT / "jaxbox").rglob("*.py")
        if f'"{jaxbox.__version__}"' in path.read_text()
    ]
    assert written == ["_version.py"]


def test_every_extra_is_in_the_documentation():
    extras = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    table = (PROJECT / "docs" / "install.md").read_text()
    missing = [name for name in extras if f"| `{name}` |" not in table]
    assert not missing, "add them to the table in docs/install.md"


CONDA_NAMES = {"flatbuffers": "python-flatbuffers", "opencv-python-headless": "py-opencv"}
"""Of conda-forge, where they differ from PyPI's."""


def test_the_conda_recipe_says_what_the_project_says():
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())
    about, recipe = project["project"], yaml.safe_load((PROJECT / "recipe" / "recipe.yaml").read_text())
    needed = [re.fullmatch(r"([\w-]+)(.*)", text).groups() for text in about["dependencies"]]
    wanted = {f"{CONDA_NAMES.get(name, name)} {bound}" for name, bound in needed}
    assert set(recipe["requirements"]["run"]) == {"python >=${{ python_min }}", *wanted}
    assert f">={recipe['context']['python_min']}" == about["requires-python"]
    assert recipe["context"]["version"] == jaxbox.__version__
    assert recipe["about"]["license"] == about["license"]
    assert recipe["about"]["summary"] == about["description"]
    built_with = [text.replace(" ", "") for text in recipe["requirements"]["host"]]
    assert set(project["build-system"]["requires"]) <= set(built_with)
    commands = recipe["build"]["python"]["entry_points"]
    assert commands == [f"{name} = {target}" for name, target in about["scripts"].items()]
