"""Another vehicle class is one entry in one file: a copy of the package gets a bus, and all else knows it."""

import os
import pathlib
import re
import shutil
import subprocess
import sys

import pytest
from parity import QUICK_PROCESS

import jaxbox
from jaxbox import DetectorConfig, Label

PACKAGE = pathlib.Path(jaxbox.__file__).parent
TABLE = pathlib.Path("config", "class_priors.py")
"""The one file, in the package."""
TESTS = pathlib.Path(__file__).parent


def copy_with_a_bus(folder):
    """A copy of the package in whose table a bus comes last: the truck's entry, somewhat longer."""
    shutil.copytree(PACKAGE, folder / "jaxbox", ignore=shutil.ignore_patterns("__pycache__"))
    table = folder / "jaxbox" / TABLE
    text = table.read_text()
    (truck,) = re.findall(r"^    TRUCK = ClassPrior\(.*?^    \)\n", text, re.MULTILINE | re.DOTALL)
    assert text.endswith(truck), "classes are added at the end"
    table.write_text(text + truck.replace("TRUCK", "BUS").replace("length_m=8.5", "length_m=12.0"))


@pytest.mark.slow
def test_another_class_is_one_entry_in_one_file(tmp_path):
    copy_with_a_bus(tmp_path)
    result = subprocess.run(
        [sys.executable, TESTS / "four_classes.py", tmp_path],
        # No other test has this program, and none of its bits is looked at: it need not be fast.
        env={**os.environ, **QUICK_PROCESS, "PYTHONPATH": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr


def test_the_priors_of_the_configuration_are_those_of_the_labels_in_their_order():
    assert DetectorConfig().vehicles.classes == tuple(label.prior for label in Label)
    assert [int(label) for label in Label] == list(range(len(Label)))


NAMED = re.compile(r"\bLabel\.(?:VAN|TRUCK)\b|[\"'](?:van|truck|Van|Truck)[\"']")
OWN = {
    "_box_rows.py": "an example of scores by class",
    "cli/box_filter.py": "likewise",
    "evaluation/kitti.py": "the benchmark's own rule for vans",
    "evaluation/tracking/protocol.py": "likewise",
    "io/foxglove.py": "chosen colours",
    "io/nuscenes.py": "its name for vans",
    "synthetic/scene.py": "sizes and shares of a street's vehicles",
    "synthetic/situations.py": "trucks and box vans among the situations",
    "synthetic/solids.py": "shapes",
    "synthetic/traffic.py": "who plays which part in a drive",
}
"""What some classes have to themselves; another class gets what no class in particular has."""


def test_no_other_file_names_a_class_but_those_where_one_has_something_of_its_own():
    files = {path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if NAMED.search(path.read_text())}
    assert {file.as_posix() for file in files - {TABLE}} == set(OWN)
