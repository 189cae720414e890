"""Ctrl-C ends every command once, soon and with exit code 130, also where a library swallows it."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest
from test_cli import make_small_sweep, write_points
from test_cli_formats import heard_ctrl_c

from jaxbox import io
from jaxbox.cli import console
from jaxbox.run import cache

SLOWEST_S = 120
"""Of a process among others that keep the machine busy."""


def start(*command):
    with heard_ctrl_c():
        return subprocess.Popen(
            [sys.executable, *map(str, command)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, cache.CACHE_VARIABLE: "", "JAX_COMPILATION_CACHE_DIR": ""},
        )


def run_code(code):
    """The exit code, stdout and stderr of a program that interrupts itself."""
    process = start("-c", "import os, signal, sys, time\nfrom jaxbox import _interrupts\n" + code)
    out, err = process.communicate(timeout=SLOWEST_S)
    return process.returncode, out, err


SWALLOWED = """
class Trap:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)
with _interrupts.interruptible():
    Trap()
    print("forgotten", flush=True)
    time.sleep(60)
    print("went on")
"""
CONVERTED = """
with _interrupts.interruptible():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)
    except KeyboardInterrupt:
        raise RuntimeError("a library's own words")
"""
CLOSING = """
with _interrupts.interruptible():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)
    finally:
        # Much longer than an interrupt takes to be raised again.
        try:
            raise OSError
        except OSError:
            time.sleep(1)
        print("closed", flush=True)
"""
TOGETHER = """
with _interrupts.interruptible():
    with _interrupts.undisturbed():
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)
        print("together", flush=True)
    print("went on")
"""
HEARD = """
with _interrupts.interruptible():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)
    except KeyboardInterrupt:
        _interrupts.heard()
    time.sleep(1)
    print("went on", flush=True)
    sys.exit(3)
"""


@pytest.mark.parametrize(
    ("code", "exit_code", "stdout"),
    [
        (SWALLOWED, 130, "forgotten"),
        (CONVERTED, 130, ""),
        (CLOSING, 130, "closed"),
        (TOGETHER, 130, "together"),
        (HEARD, 3, "went on"),
    ],
)
def test_an_interrupt_is_raised_until_it_is_heard_and_only_until_then(code, exit_code, stdout):
    found, out, err = run_code(code)
    assert (found, out.strip()) == (exit_code, stdout), err
    assert ("interrupted." in err) == (exit_code == 130)


def test_a_program_that_imports_jaxbox_keeps_its_own_signals():
    code, out, _ = run_code("print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)")
    assert (code, out.strip()) == (0, "True")


def test_who_ignores_ctrl_c_goes_on_to_do_so():
    code, out, _ = run_code(
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "with _interrupts.interruptible():\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    print('went on')"
    )
    assert (code, out.strip()) == (0, "went on")


def wait_for_import(process):
    """Until a process imports NumPy, which jaxbox does after it has taken over Ctrl-C."""
    maps, end = pathlib.Path(f"/proc/{process.pid}/maps"), time.monotonic() + SLOWEST_S
    while "numpy" not in maps.read_text():
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.02)


def test_commands_interrupted_at_any_time_on_a_busy_machine_end_and_leave_whole_files(tmp_path):
    sweep = make_small_sweep(0)
    for folder in ("velodyne", "calib", "label_2"):
        (tmp_path / "kitti" / folder).mkdir(parents=True)
    write_points(tmp_path / "kitti" / "velodyne" / "0.bin", sweep)
    io.write_calibration(tmp_path / "kitti" / "calib" / "0.txt", sweep.calibration)
    for text in (tmp_path / "kitti" / "label_2" / "0.txt", tmp_path / "found" / "0.txt"):
        io.write_labels(text, [])
    score = ("eval", "--labels", tmp_path / "kitti", "--results", tmp_path / "found", "--json")
    # Seconds after jaxbox has begun, and command, whose output follows; all at once, so that they keep each
    # other waiting.
    plan = [
        *((after_s, ("export", "--output")) for after_s in (0.0, 0.5, 1.5, 3.5, 7.5)),
        *((after_s, score) for after_s in (0.0, 1.5)),
        (6.0, ("detect", tmp_path / "kitti", "--output")),
    ]
    running = [
        (after_s, start("-m", "jaxbox", *command, tmp_path / f"out{index}"))
        for index, (after_s, command) in enumerate(plan)
    ]
    for _, process in running:
        wait_for_import(process)
    begun = time.monotonic()
    for after_s, process in sorted(running, key=lambda pair: pair[0]):
        time.sleep(max(0.0, begun + after_s - time.monotonic()))
        process.send_signal(signal.SIGINT)
    ended = [(after_s, process, process.communicate(timeout=SLOWEST_S)[1]) for after_s, process in running]
    for after_s, process, err in ended:
        assert process.returncode == console.ExitCode.INTERRUPTED, (process.args, after_s, err)
        assert "interrupted" in err
        assert 'Traceback (most recent call last):\n  File "<frozen runpy>' not in err
    for index in range(len(plan)):
        for path in (tmp_path / f"out{index}").rglob("*"):
            assert not path.name.startswith(".jaxbox-"), "a temporary file is left"
            if path.suffix == ".json":
                json.loads(path.read_text())
