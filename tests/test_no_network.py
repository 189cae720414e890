"""Nothing connects anywhere at run time, and no pickle is read from a file."""

import ast
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

import jaxbox
from jaxbox import synthetic
from jaxbox.io import write_bin

ROOT = pathlib.Path(jaxbox.__file__).parent

# An audit hook cannot be taken out again, so each run has a process of its own. Python raises these events
# before it looks a name up, connects, sends or listens, whatever library asks.
GUARD = """
import sys

FORBIDDEN = (
    "socket.connect", "socket.bind", "socket.sendto", "socket.sendmsg", "socket.getaddrinfo",
    "socket.gethostbyname", "urllib.Request", "http.client.connect", "ftplib.connect", "smtplib.connect",
)

def forbid(event, arguments):
    if event in FORBIDDEN:
        raise PermissionError(f"network at run time: {event}{arguments[1:]}")

sys.addaudithook(forbid)
"""
PROVOKED = """
import socket
try:
    socket.create_connection(("127.0.0.1", 9), timeout=1)
except PermissionError as error:
    assert "network at run time" in str(error)
else:
    raise SystemExit("the guard does not guard")
"""
COMMAND = "from jaxbox.__main__ import main\nsys.argv = ['jaxbox', *sys.argv[1:]]\nmain()\n"


def run_guarded(code, *arguments):
    # As many devices as in `conftest`, so that the child takes the compiled functions of this run.
    environment = {**os.environ, "PYTHONPATH": str(ROOT.parent), "JAX_NUM_CPU_DEVICES": "2"}
    command = [sys.executable, "-c", GUARD + code, *(str(argument) for argument in arguments)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900, check=False)


def test_the_guard_stops_a_connection():
    done = run_guarded(PROVOKED)
    assert done.returncode == 0, done.stderr


def test_importing_every_module_connects_nowhere():
    code = """
import importlib, pkgutil, jaxbox
for module in pkgutil.walk_packages(jaxbox.__path__, "jaxbox."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
print("imported")
"""
    done = run_guarded(code)
    assert (done.returncode, done.stdout) == (0, "imported\n"), done.stderr


def test_detect_connects_nowhere(tmp_path):
    sweep = synthetic.make_sweep(0, num_azimuths=250)
    write_bin(tmp_path / "sweep.bin", sweep.xyz, sweep.intensity)
    output = tmp_path / "out"
    # The preset that compiles fastest: whoever connects does not ask which it is.
    options = ("--output", output, "--format", "jsonl", "--preset", "paper")
    done = run_guarded(COMMAND, "detect", tmp_path / "sweep.bin", *options)
    assert done.returncode == 0, done.stderr
    assert (output / "detections.jsonl").is_file()
    assert list((output / "pictures").iterdir())


def calls(path):
    """Names of what a file calls, and the keywords of each call."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call):
            keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            yield ast.unparse(node.func), keywords, node.lineno


BETWEEN_PROCESSES = {"run/processes.py", "cluster/run.py", "cluster/worker.py"}
"""Here pickle carries items to processes that jaxbox started itself, and nothing from a file."""


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT)))
def test_no_file_is_unpickled_or_executed(path):
    carries = path.relative_to(ROOT).as_posix() in BETWEEN_PROCESSES
    assert carries or "import pickle" not in path.read_text()
    forbidden = {"eval", "exec", "yaml.load", "pickle.load"} | (set() if carries else {"pickle.loads"})
    for name, keywords, line in calls(path):
        where = f"{path.name}:{line}"
        assert name not in forbidden, where
        if name in ("np.load", "numpy.load"):
            assert keywords.get("allow_pickle") == "False", where
        if name.startswith("subprocess."):
            assert keywords.get("shell", "False") == "False", where


def test_a_pickled_array_is_refused_and_not_run(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pathlib.Path.touch, (tmp_path / "sprung",))

    np.save(tmp_path / "cloud.npy", np.array([Trap()], dtype=object), allow_pickle=True)
    with pytest.raises(jaxbox.io.InputError, match=r"cloud\.npy"):
        jaxbox.io.open_sweeps(tmp_path / "cloud.npy")[0].read_points()
    assert not (tmp_path / "sprung").exists()
