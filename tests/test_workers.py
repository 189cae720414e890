"""Work over processes: order, errors, processes that die, and leaving early; without the detector."""

import functools
import multiprocessing
import os
import pathlib
import signal
import time

import numpy as np
import pytest

from jaxbox.run import processes
from jaxbox.run.processes import ProcessPool, WorkerDied, ahead


class NoPickle(Exception):
    """An error that cannot be made again from what it holds."""

    def __init__(self, first, second):
        super().__init__(f"{first} {second}")


def work(marks, item):
    """What a process does with each kind of item."""
    kind, value = item
    if kind == "kill once" and not (pathlib.Path(marks) / str(value)).exists():
        (pathlib.Path(marks) / str(value)).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "exit":
        os._exit(value)
    if kind == "raise":
        raise ValueError(f"value {value}")
    if kind == "raise oddly":
        raise NoPickle("no", value)
    if kind == "sleep":
        time.sleep(value)
    if kind == "return oddly":
        return lambda: value
    return value, os.getpid()


def start(marks):
    """What each process is started with; at module level, so that it can be sent there."""
    return functools.partial(work, marks)


def make_arrays(seed):
    """Arrays of every kind of memory, large ones and small."""
    large = np.random.default_rng(seed).normal(size=(300, 200))
    fixed = large.astype(np.float32)
    fixed.flags.writeable = False
    return {
        "rows": large,
        "columns": np.asfortranarray(large),
        "every other": large[::2, ::3],
        "small": large[:2, :2].copy(),
        "empty": np.zeros((0, 3)),
        "flags": large > 0,
        "fixed": fixed,
    }


def start_making_arrays():
    return make_arrays


def outcome(future):
    try:
        return future.result()
    except Exception as error:
        return error


@pytest.mark.slow
def test_every_item_gets_its_answer_whatever_happens_to_the_others(tmp_path):
    kinds = ["ok", "raise", "kill once", "ok", "exit", "ok", "raise oddly", "return oddly", "ok"]
    items = [(kind, number) for number, kind in enumerate(kinds)] + [("ok", lambda: 0)]
    with ProcessPool(functools.partial(start, str(tmp_path)), 2) as pool:
        answers = [outcome(future) for _, future in ahead(items, pool.submit, 4)]
        deaths = pool.take_deaths()
    assert [answer[0] for answer, kind in zip(answers, kinds, strict=False) if kind == "ok"] == [0, 3, 5, 8]
    assert answers[2][0] == 2, "an item whose process was killed is done by the next"
    assert isinstance(answers[1], ValueError)
    assert str(answers[1]) == "value 1"
    assert "in work" in answers[1].__notes__[0], "it says where in the process it was raised"
    assert isinstance(answers[4], WorkerDied)
    assert "exit code 4" in str(answers[4])
    assert str(answers[6]) == "NoPickle: no 6"
    assert all("pickle" in str(answer) for answer in (answers[7], answers[9]))
    assert {item: how for item, how in deaths} == {
        ("kill once", 2): "killed by SIGKILL, perhaps for want of memory",
        ("exit", 4): "exit code 4",
    }
    assert len({answer[1] for answer in answers if isinstance(answer, tuple)}) > 1, "they share the work"
    assert multiprocessing.active_children() == []


def test_arrays_arrive_as_they_were_sent():
    with ProcessPool(start_making_arrays, 1) as pool:
        answers = [pool.submit(seed).result() for seed in range(3)]
    for seed, arrays in enumerate(answers):
        for name, expected in make_arrays(seed).items():
            np.testing.assert_array_equal(arrays[name], expected, err_msg=name)
            assert arrays[name].dtype == expected.dtype
            assert arrays[name].flags.writeable == expected.flags.writeable, name


def test_leaving_early_ends_the_processes_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "_END_S", 1e6)
    begun = []

    def work_and_leave():
        with ProcessPool(functools.partial(start, str(tmp_path)), 1) as pool:
            _, number = pool.submit(("ok", 1)).result()
            # A terminal sends Ctrl-C to the processes too, and they leave it to the parent.
            os.kill(number, signal.SIGINT)
            assert pool.submit(("ok", 2)).result() == (2, number)
            begun.extend(pool.submit(("sleep", 1000)) for _ in range(3))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work_and_leave()
    assert multiprocessing.active_children() == []
    assert all(future.done() for future in begun)


def test_what_was_there_before_the_source_broke_off_is_handed_out_first():
    def source():
        yield from range(3)
        raise OSError("the recording ends here")

    begun = []
    pairs = ahead(source(), lambda item: begun.append(item) or len(begun), 2)
    assert next(pairs) == (0, 1)
    assert begun == [0, 1, 2]
    assert [next(pairs), next(pairs)] == [(1, 2), (2, 3)]
    with pytest.raises(OSError, match="ends here"):
        next(pairs)


def test_a_system_without_signal_masks_is_asked_for_none(monkeypatch):
    # Windows has neither the function nor what the tracker of resources is started with.
    monkeypatch.delattr(signal, "pthread_sigmask")
    monkeypatch.setattr(processes.resource_tracker, "ensure_running", lambda: pytest.fail("not there"))
    processes._keep_interrupts_away()
