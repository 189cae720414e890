"""Kept programs: the bits of `detect`, read and not traced the second time, traced again when broken."""

import dataclasses
import gc
import pathlib
import platform
import subprocess
import sys
import threading
import zlib

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from test_detector import CAPACITY, assert_same_bits, found, street

import jaxbox
from jaxbox import DetectorConfig, PointCloud
from jaxbox.run import compiled, program_files, programs
from jaxbox.run.program_files import SUFFIX, BrokenProgramError, read_made_of
from jaxbox.run.programs import Half, KeptPrograms

PROJECT = pathlib.Path(__file__).parents[1]
BASE = DetectorConfig()
CLOUD = PointCloud.from_numpy(street(0).xyz, capacity=CAPACITY)


def changed(room, **values):
    return dataclasses.replace(BASE, **{room: dataclasses.replace(getattr(BASE, room), **values)})


def run(kept, cloud=CLOUD, config=BASE, key=None):
    """The answer, or None where `detect` would have to trace."""
    return kept(*compiled._operands(cloud, config, key))


def load(folder, config=BASE, *, capacity=CAPACITY, shipped=pathlib.Path("none")):
    """Runs the program as a new process would, on a sweep of no points."""
    empty = PointCloud.from_numpy(np.zeros((0, 3)), capacity=capacity)
    return run(KeptPrograms(folder, shipped=shipped), empty, config)


def halves(*capacities):
    return [(half, capacity) for capacity in capacities for half in Half]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the program of the default preset is kept."""
    return tmp_path_factory.mktemp("programs")


@pytest.fixture(scope="module")
def kept(folder):
    """The default preset's program, compiled once for this file."""
    kept = KeptPrograms(folder)
    run(kept)
    return kept


@pytest.fixture
def traced(monkeypatch):
    """A quick stand-in for the detector's trace, and what it was asked for."""
    asked = []
    num_outputs = jax.tree.structure(programs._example(jaxbox.Detections)).num_leaves

    def trace(build, half):
        asked.append((half, build.capacity))
        outputs = {Half.SEGMENT: 0, Half.DECIDE: num_outputs}[half]
        # The operands have to stay operands, though nothing is made of them.
        program = jax.jit(lambda *operands: [jnp.zeros(())] * outputs, keep_unused=True)
        return jax.export.export(program)(*build.operands())

    monkeypatch.setattr(programs, "trace", trace)
    return asked


def test_traced_or_read_it_has_the_bits_of_detect_and_thresholds_are_inputs(kept, folder):
    assert_same_bits(run(kept), found(0))
    assert gc.isenabled()
    paths = sorted(folder.iterdir())
    written = [path.stat().st_mtime_ns for path in paths]
    again, strict = KeptPrograms(folder), changed("vehicles", min_score=0.05)
    answer = run(again, config=strict)
    assert [path.stat().st_mtime_ns for path in paths] == written
    assert paths == sorted(folder.iterdir())
    assert_same_bits(answer, jaxbox.detect(CLOUD, strict))
    assert 0 < answer.valid.sum() < found(0).valid.sum()
    assert kept.num_compiled == again.num_compiled == 1


def test_the_random_key_is_an_input(kept):
    key = jax.random.key(7)
    assert_same_bits(run(kept, key=key), jaxbox.detect(CLOUD, key=key))
    assert kept.num_compiled == 1


def test_without_evidence_and_on_another_device_it_has_the_bits_of_detect_and_stays_there(tmp_path):
    kept, second = KeptPrograms(tmp_path), jax.devices("cpu")[1]
    cloud, paper = PointCloud.from_numpy(street(1).xyz, capacity=CAPACITY), DetectorConfig.paper()
    expected = jax.device_get(jaxbox.detect(cloud, paper))
    assert_same_bits(run(kept, cloud, paper), expected)
    answer = run(kept, jax.device_put(cloud, second), paper)
    assert answer.center.devices() == {second}
    assert_same_bits(answer, expected)
    with jax.default_device(second):
        assert run(kept, cloud, paper).center.devices() == {second}
    assert kept.num_compiled == 2


def test_what_it_has_no_program_for_is_left_to_detect(traced, tmp_path):
    kept = KeptPrograms(tmp_path)
    first, second = jax.devices("cpu")
    apart = dataclasses.replace(
        jax.device_put(CLOUD, first), intensity=jax.device_put(CLOUD.intensity, second)
    )
    assert run(kept, apart) is None
    assert run(kept, dataclasses.replace(CLOUD, num_points=5)) is None
    assert run(kept, dataclasses.replace(CLOUD, num_points=np.int16(5))) is None
    assert run(kept, jaxbox.stack_clouds([CLOUD, CLOUD])) is None
    assert run(kept, key=jax.random.key(0, impl="rbg")) is None
    assert run(kept, key=jax.random.PRNGKey(0)) is None
    with jax.disable_jit():
        assert run(kept) is None
    assert not traced
    assert kept.num_compiled == 0


@pytest.mark.usefixtures("traced")
def test_other_shapes_are_left_to_detect_also_where_there_is_a_program(tmp_path):
    kept = KeptPrograms(tmp_path)
    assert run(kept) is not None
    for wrong in ({"xyz1": CLOUD.xyz1[:, :3]}, {"xyz1": CLOUD.xyz1.T}, {"intensity": CLOUD.intensity[1:]}):
        assert run(kept, dataclasses.replace(CLOUD, **wrong)) is None
    assert run(kept, jaxbox.stack_clouds([CLOUD, CLOUD])) is None
    assert kept.num_compiled == 1


def test_tracers_are_left_to_detect(traced, tmp_path):
    kept, asked = KeptPrograms(tmp_path), []

    def detect(cloud, config, key):
        asked.append(run(kept, cloud, config, key))
        return 0

    jax.jit(detect)(CLOUD, BASE, jax.random.key(0))
    jax.jit(lambda key: detect(CLOUD, BASE, key))(jax.random.key(0))
    jax.jit(lambda config: detect(CLOUD, config, None))(BASE)
    jax.vmap(lambda cloud: detect(cloud, BASE, None))(jaxbox.stack_clouds([CLOUD, CLOUD]))
    jax.vmap(lambda key: detect(CLOUD, BASE, key))(jax.random.split(jax.random.key(0)))
    assert asked == [None] * 5
    assert not traced


def test_it_is_traced_once_for_its_static_settings_and_capacity(traced, tmp_path):
    load(tmp_path)
    load(tmp_path)
    load(tmp_path, changed("clustering", min_points=3.0))
    assert traced == halves(CAPACITY)
    load(tmp_path, capacity=2 * CAPACITY)
    load(tmp_path, changed("vehicles", max_detections=16))
    assert traced == halves(CAPACITY, 2 * CAPACITY, CAPACITY)
    with jax.default_matmul_precision("highest"):
        load(tmp_path)
    assert len(traced) == len(list(tmp_path.iterdir())) == 8


def test_within_a_process_jax_options_make_another_program(traced, tmp_path):
    kept = KeptPrograms(tmp_path)
    run(kept)
    with jax.default_matmul_precision("highest"):
        run(kept)
    run(kept)
    assert traced == 2 * halves(CAPACITY)
    assert kept.num_compiled == 2


def test_threads_that_ask_together_compile_once(traced, tmp_path):
    kept = KeptPrograms(tmp_path)
    threads = [threading.Thread(target=run, args=(kept,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert traced == halves(CAPACITY)
    assert kept.num_compiled == 1


def flipped(data, place):
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


@pytest.mark.parametrize("half", Half)
def test_a_broken_file_is_traced_anew(traced, tmp_path, half):
    load(tmp_path)
    path = next(path for path in tmp_path.iterdir() if read_made_of(path)["half"] == half)
    whole = path.read_bytes()
    places = (0, 20, len(whole) // 2, len(whole) - 1)
    damaged = [b"", whole[: len(whole) // 2], b"\xff" * 64, *(flipped(whole, place) for place in places)]
    for broken in damaged:
        path.write_bytes(broken)
        with pytest.raises(BrokenProgramError, match=path.name):
            read_made_of(path)
        load(tmp_path)
        load(tmp_path)
    assert traced == halves(CAPACITY) + len(damaged) * [(half, CAPACITY)]
    assert read_made_of(path)["half"] == half


def test_a_program_under_the_name_of_another_is_not_run(traced, tmp_path):
    load(tmp_path)
    one, other = tmp_path.iterdir()
    one.write_bytes(other.read_bytes())
    load(tmp_path)
    assert len(traced) == 3


@pytest.mark.parametrize("name", ["source_digest", "version"])
def test_a_program_of_another_source_or_version_is_not_run(traced, tmp_path, monkeypatch, name):
    load(tmp_path)
    if name == "version":
        monkeypatch.setattr(jax, "__version__", "0.0.1")
    else:
        monkeypatch.setattr(programs, "source_digest", lambda: "another")
    load(tmp_path)
    assert traced == 2 * halves(CAPACITY)


def test_programs_that_were_shipped_are_read_first_and_never_written(traced, tmp_path):
    shipped, folder = tmp_path / "shipped", tmp_path / "kept"
    load(shipped)
    written = {path: path.read_bytes() for path in shipped.iterdir()}
    load(folder, shipped=shipped)
    load(None, shipped=shipped)
    assert traced == halves(CAPACITY)
    assert not folder.exists()
    load(folder, capacity=2 * CAPACITY, shipped=shipped)
    assert len(list(folder.iterdir())) == 2
    assert {path: path.read_bytes() for path in shipped.iterdir()} == written


def test_a_folder_that_cannot_be_written_does_not_matter(traced, tmp_path):
    (tmp_path / "file").touch()
    assert load(tmp_path / "file") is not None
    assert load(None) is not None
    assert traced == halves(CAPACITY, CAPACITY)


def test_what_is_traced_does_not_depend_on_where_the_source_lies(folder, kept):
    for path in folder.iterdir():
        made_of, program = program_files._read(path)
        program = zlib.decompress(program)
        assert str(PROJECT).encode() not in program
        assert b".py" not in program
        assert str(PROJECT) not in str(made_of)


def test_nothing_is_written_half(traced, tmp_path, monkeypatch):
    def fail(path, data):
        with path.open("wb") as file:
            file.write(data[: len(data) // 2])
        raise OSError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(pathlib.Path, "write_bytes", fail)
        assert load(tmp_path) is not None
    assert list(tmp_path.iterdir()) == []
    load(tmp_path)
    assert {path.suffix for path in tmp_path.iterdir()} == {SUFFIX}


FREED = """
import pathlib, numpy as np
from jaxbox.cli.memory import giving_memory_back

def resident_mb():
    status = pathlib.Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1000

before = resident_mb()
blocks = [np.full(8000, 1.0) for _ in range(3000)]  # 192 MB, each too small to be mapped by itself
held = resident_mb()
with giving_memory_back():
    # One that stays near the end keeps the heap from shrinking by itself.
    blocks = blocks[-1:]
assert blocks[0].sum() == 8000
print(held - before, resident_mb() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries give memory back themselves")
def test_memory_that_was_freed_goes_back_to_the_system():
    # In a process of its own: one that ran other tests has memory to spare.
    done = subprocess.run([sys.executable, "-c", FREED], check=True, capture_output=True, text=True)
    held, left = map(float, done.stdout.split())
    assert held > 150
    assert left < 50


def test_several_readings_have_no_halves(tmp_path, traced):
    assert load(tmp_path, changed("vehicles", num_readings=2)) is None
    assert not traced
