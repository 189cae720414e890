"""The detector as a file: it runs where jaxbox is not, and gives the same bits."""

import json
import subprocess
import sys

import jax
import numpy as np
import pytest
from test_detector import CAPACITY, found, street
from typer.testing import CliRunner

from jaxbox import PointCloud
from jaxbox.cli import app
from jaxbox.run import export

LOAD = """
import sys
sys.modules["jaxbox"] = None  # importing it now fails
import jax, jax.export, numpy as np
folder = sys.argv[1]
exported = jax.export.deserialize(bytearray(open(folder + "/detector.jax", "rb").read()))
arrays = jax.jit(exported.call)(np.load(folder + "/xyz1.npy"), np.int32(sys.argv[2]))
np.savez(folder + "/found.npz", **jax.device_get(arrays))
"""
"""What docs/export.md shows."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    result = CliRunner().invoke(app, ["export", "--output", str(folder), "--capacity", str(CAPACITY)])
    assert result.exit_code == 0, result.output
    assert result.stdout.count("wrote ") == 3
    return folder


@pytest.mark.slow
def test_an_exported_detector_runs_without_jaxbox_and_gives_the_same_bits(folder):
    xyz = street(0).xyz
    np.save(folder / "xyz1.npy", PointCloud.from_numpy(xyz, capacity=CAPACITY).xyz1)
    subprocess.run([sys.executable, "-c", LOAD, str(folder), str(len(xyz))], check=True, cwd=folder)
    expected, arrays = export.named_arrays(found(0)), np.load(folder / "found.npz")
    assert sorted(arrays.files) == sorted(expected)
    for name, value in expected.items():
        np.testing.assert_array_equal(arrays[name], value, err_msg=name)


def test_the_interface_names_the_arrays_of_the_module_in_their_order(folder):
    exported = jax.export.deserialize(bytearray((folder / export.JAX_NAME).read_bytes()))
    interface = json.loads((folder / export.INTERFACE_NAME).read_text())
    assert [array["name"] for array in interface["inputs"]] == ["xyz1", "num_points"]
    for arrays, avals in (("inputs", exported.in_avals), ("outputs", exported.out_avals)):
        shapes = [(tuple(array["shape"]), array["dtype"]) for array in interface[arrays]]
        assert shapes == [(aval.shape, str(aval.dtype)) for aval in avals]
    named = export.named_arrays(found(0))
    for array in interface["outputs"]:
        assert list(named[array["name"]].shape) == array["shape"]
    assert (folder / export.STABLEHLO_NAME).read_bytes() == exported.mlir_module_serialized


def test_what_cannot_be_exported_is_refused(tmp_path):
    with pytest.raises(ValueError, match="capacity is 0"):
        export.export_detector(0)
    (file := tmp_path / "file").touch()
    taken = CliRunner().invoke(app, ["export", "--output", str(file)])
    assert taken.exit_code == 2
    assert f"{file}: cannot be written (File exists)" in taken.output.replace("\n", "")
    assert "it is a folder" in taken.output.replace("\n", " ")
    unknown = CliRunner().invoke(app, ["export", "--output", str(tmp_path), "--platform", "abacus"])
    assert unknown.exit_code == 2
