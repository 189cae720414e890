"""Every notebook runs from top to bottom, and is committed without outputs."""

import pathlib

import parity
import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")

NOTEBOOKS = sorted((pathlib.Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
EVALUATION = NOTEBOOKS[0].parent / "02_kitti_evaluation.ipynb"
OPTIMISED = {"01_quickstart", EVALUATION.stem}
"""They run what other tests compile too. What the others compile for themselves need not be fast."""
UNOPTIMISED = {"03_stage_by_stage", "04_tuning_by_vmap"}
"""They compare programs of one detector, which are rounded alike by the usual emitters only."""
TIMEOUT_S = 600


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebook_is_committed_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert not [cell for cell in notebook.cells if cell.get("outputs")], "clear the outputs before you commit"


# The kernel's own sockets are closed by its exit, which the interpreter reports as a resource warning.
quiet_kernel = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)


def run_notebook(path, folder, monkeypatch):
    """The notebook's code cells after a run from top to bottom, in a folder of its own."""
    # The kernel runs elsewhere, and is to meet this tree whether or not it is installed.
    monkeypatch.setenv("PYTHONPATH", str(NOTEBOOKS[0].parents[1]))
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(folder)}}
    nbclient.NotebookClient(notebook, timeout=TIMEOUT_S, resources=resources).execute()
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def shown_text(cells):
    outputs = [output for cell in cells for output in cell.outputs]
    return "\n".join(
        output.get("text", "") + output.get("data", {}).get("text/plain", "") for output in outputs
    )


def count_pictures(cells):
    return sum("image/jpeg" in output.get("data", {}) for cell in cells for output in cell.outputs)


@pytest.mark.slow
@quiet_kernel
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebook_runs_without_data_and_leaves_nothing_behind(path, tmp_path, monkeypatch):
    monkeypatch.delenv("JAXBOX_KITTI", raising=False)
    if path.stem not in OPTIMISED:
        changed = parity.UNOPTIMISED_PROCESS if path.stem in UNOPTIMISED else parity.QUICK_PROCESS
        for name, value in changed.items():
            monkeypatch.setenv(name, value)
    cells = run_notebook(path, tmp_path, monkeypatch)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert count_pictures(cells) > 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@quiet_kernel
def test_the_evaluation_notebook_takes_a_kitti_folder(data_root, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXBOX_KITTI", str(data_root / "kitti_object" / "training"))
    monkeypatch.setenv("JAXBOX_KITTI_FRAMES", "6")
    cells = run_notebook(EVALUATION, tmp_path, monkeypatch)
    text = shown_text(cells)
    assert "6 labelled sweeps, " in text
    assert "synthetic" not in text
    for part in ("Car, 3D", "by range, m", "by LiDAR points", "constant: pooled", "axis swaps"):
        assert part in text
    assert count_pictures(cells) == 3, "figures 12 and 13, and the contact sheet"
