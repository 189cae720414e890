"""Corruption, mutants and coverage: the logic of their programs, and that what is recorded fits it."""

import json
import pathlib
import shlex
import subprocess
import tomllib

import numpy as np
import pytest

from benchmarks import bench_corruption, common
from jaxbox import synthetic
from jaxbox.evaluation.copies import Frame
from jaxbox.evaluation.corruptions import CORRUPTIONS
from jaxbox.io import KittiObject, read_image
from quality import coverage_table, mutation

RESULTS = pathlib.Path(__file__).parents[1] / "benchmarks" / "results"


@pytest.fixture(scope="module")
def frame():
    sweep = synthetic.make_sweep(0, num_azimuths=100)
    return Frame("000000", sweep.xyz, sweep.intensity, sweep.calibration, [])


@pytest.mark.parametrize(
    ("text", "least"), [("0", 1), ("-1", 0), ("1.5", 1), ("many", 1), ("--1", 0), ("", 0)]
)
def test_an_option_below_its_least_number_is_named(text, least, capsys):
    parser = common.parser("")
    parser.add_argument("--draws", type=common.at_least(least))
    with pytest.raises(SystemExit, match="2"):
        parser.parse_args([f"--draws={text}"])
    assert f"--draws: {text!r} is no whole number from {least} on" in capsys.readouterr().err
    assert parser.parse_args([f"--draws={least}"]).draws == least


@pytest.mark.parametrize("name", sorted(CORRUPTIONS))
def test_a_corrupted_frame_differs_in_its_points_or_its_calibration_and_is_seeded(name, frame):
    kind = CORRUPTIONS[name]

    def corrupted():
        rng = bench_corruption.seeded(frame.name, name, 3)
        return bench_corruption.corrupt(frame, kind, kind.amounts[2], rng)

    one, other = corrupted(), corrupted()
    np.testing.assert_array_equal(one.xyz, other.xyz)
    np.testing.assert_array_equal(one.calibration.T_rect_velo, other.calibration.T_rect_velo)
    same_points = one.xyz.shape == frame.xyz.shape and np.array_equal(one.xyz, frame.xyz)
    same_camera = np.array_equal(one.calibration.T_rect_velo, frame.calibration.T_rect_velo)
    assert (same_points, same_camera) == (kind.of_points is None, kind.of_calibration is None)


def car(*, score=None, height=1.5, length=4.0, forward=20.0):
    return KittiObject(
        type="Car", truncation=0.0, occlusion=0, alpha=0.0, box_px=np.array([500.0, 150, 600, 220]),
        height=height, width=1.6, length=length, location=np.array([0.0, 1.6, forward]), rotation_y=0.0,
        score=score,
    )  # fmt: skip


def test_the_score_of_a_frame_is_that_worked_by_hand():
    labels = {"a": [car(), car(forward=30.0)]}
    found = {"a": [car(score=0.9, height=1.9, length=4.1), car(score=0.8, forward=50.0)]}
    figures = bench_corruption.score(labels, found, {"a": np.array([99, 100])})
    assert figures["well seen"] == 0
    assert bench_corruption.score(labels, found, {"a": np.array([100, 99])})["well seen"] == 1
    assert figures["recall"] == figures["recall at the cut"] == 0.5
    assert figures["false a frame"] == 1
    assert figures["height"] == pytest.approx(0.4)
    assert figures["length"] == pytest.approx(0.1)
    few = {"a": np.array([3, 3])}
    low = {"a": [car(score=0.1)]}
    assert bench_corruption.score(labels, low, few)["recall at the cut"] == 0
    assert bench_corruption.score(labels, {"a": []}, few)["height"] == 0


def test_the_recorded_corruptions_are_those_of_the_code_and_can_be_drawn(tmp_path):
    path = RESULTS / "corruption.json"
    report = json.loads(path.read_text())
    assert list(report["corruptions"]) == list(CORRUPTIONS)
    for name, kind in CORRUPTIONS.items():
        rungs = report["corruptions"][name]["severities"]
        assert tuple(rung["amount"] for rung in rungs) == kind.amounts
        assert all(set(bench_corruption.COLUMNS) <= set(rung["mean"]) for rung in rungs)
    bench_corruption.main(["--redraw", str(path), "--plot", str(tmp_path / "corruption.png")])
    assert read_image(tmp_path / "corruption.png").shape[1] > 800
    assert (tmp_path / "corruption.png").stat().st_size < 200_000


def mutant(module, occurrence):
    return {"module": module, "operator": "AddNot", "occurrence": occurrence, "line": 1, "change": ""}


def test_survivors_are_found_again_and_other_modules_are_kept(tmp_path):
    path = tmp_path / "mutation.json"
    modules = {"a.py": {"run": 2}, "b.py": {"run": 1}}
    path.write_text(json.dumps({"modules": modules, "survivors": [mutant("a.py", 3), mutant("b.py", 5)]}))
    assert mutation.survivors_of(path) == {
        "a.py": frozenset({("core/AddNot", 3)}),
        "b.py": frozenset({("core/AddNot", 5)}),
    }
    kept = mutation.earlier_report(path, ["a.py"])
    assert kept == {"modules": {"b.py": {"run": 1}}, "survivors": [mutant("b.py", 5)]}
    assert mutation.earlier_report(tmp_path / "none.json", []) == {"modules": {}, "survivors": []}


def test_every_mutated_module_and_its_tests_exist():
    root = RESULTS.parents[1]
    for module, arguments in mutation.TESTS.items():
        assert (root / module).is_file()
        files = [word for word in arguments.split() if word.endswith(".py")]
        assert files
        assert all((root / file).is_file() for file in files)


def test_coverage_is_summed_by_part():
    def entry(lines, missing_lines, branches, missing_branches):
        summary = {
            "num_statements": lines,
            "missing_lines": missing_lines,
            "num_branches": branches,
            "missing_branches": missing_branches,
        }
        missing = {"missing_lines": [7] * missing_lines, "missing_branches": [[7, -1]] * missing_branches}
        return {"summary": summary, **missing}

    files = {
        "jaxbox/detector.py": entry(10, 0, 2, 0),
        "jaxbox/io/a.py": entry(20, 2, 8, 2),
        "jaxbox/io/b.py": entry(30, 0, 2, 0),
    }
    parts = coverage_table.by_part(files)
    assert list(parts) == ["io", "detector", "all"]
    assert parts["io"] | {"percent": 0} == {
        "lines": 50, "lines missed": 2, "branches": 10, "branches missed": 2, "percent": 0,
    }  # fmt: skip
    assert parts["io"]["percent"] == pytest.approx(100 * 56 / 60)
    assert parts["all"]["lines"] == 60
    assert list(coverage_table.uncovered(files)) == ["jaxbox/io/a.py"]


@pytest.mark.parametrize("module", sorted(mutation.TESTS))
def test_the_command_of_a_module_is_one_shell_line_with_a_limit_of_time(module, tmp_path):
    mutation.write_config(module, tmp_path / "config.toml")
    settings = tomllib.loads((tmp_path / "config.toml").read_text())["cosmic-ray"]
    shell, flag, line = shlex.split(settings["test-command"])
    assert (shell, flag) == ("bash", "-c")
    limit, tests = line.split("; exec ")
    assert limit == f"ulimit -t {mutation.MAX_CPU_S}"
    assert shlex.split(tests)[1:3] == ["-m", "pytest"]
    assert shlex.split(tests)[-1] in mutation.TESTS[module].replace("'", "")
    subprocess.run([shell, "-n", flag, line], check=True)
