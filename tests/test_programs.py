"""The kept program: the bits of `detect`, read and not traced the second time, traced anew when broken."""

import dataclasses
import gc
import pathlib
import platform

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from test_detector import CAPACITY, found, street

import jaxbox
from jaxbox import DetectorConfig, PointCloud
from jaxbox.cli import cache, programs
from jaxbox.cli.memory import giving_memory_back
from jaxbox.cli.programs import Half
from jaxbox.cli.timing import TimedDetector

BASE = DetectorConfig()


def changed(room, **values):
    return dataclasses.replace(BASE, **{room: dataclasses.replace(getattr(BASE, room), **values)})


def load(folder, config=BASE, *, capacity=CAPACITY):
    """The program, as a new process gets it."""
    programs._compile_halves.cache_clear()
    return programs.kept_program(config, capacity=capacity, folder=folder)


def halves(*capacities):
    return [(half, capacity) for capacity in capacities for half in Half]


@pytest.fixture
def traced(monkeypatch):
    """A quick stand-in for the detector's trace, and what it was asked for."""
    asked = []

    def trace(half, settings, capacity):
        asked.append((half, capacity))
        shapes = (capacity, 4), (capacity,), (), (settings.num_leaves,)
        dtypes = np.float32, np.float32, np.int32, np.float32
        operands = map(jax.ShapeDtypeStruct, shapes, dtypes)
        num_outputs = jax.tree.structure(programs._example(jaxbox.Detections)).num_leaves
        outputs = {Half.SEGMENT: 0, Half.DECIDE: num_outputs}[half]
        return jax.export.export(jax.jit(lambda *_: [jnp.zeros(())] * outputs))(*operands)

    monkeypatch.setattr(programs, "_trace", trace)
    return asked


def test_traced_or_read_it_has_the_bits_of_detect_and_thresholds_are_inputs(tmp_path):
    cloud = PointCloud.from_numpy(street(0).xyz, capacity=CAPACITY)
    jax.tree.map(np.testing.assert_array_equal, load(tmp_path)(cloud), found(0))
    assert gc.isenabled()
    paths = sorted((tmp_path / programs.FOLDER).iterdir())
    written = [path.stat().st_mtime_ns for path in paths]
    strict = changed("vehicles", min_score=0.05)
    answer = load(tmp_path, strict)(cloud)
    assert [path.stat().st_mtime_ns for path in paths] == written
    assert paths == sorted((tmp_path / programs.FOLDER).iterdir())
    jax.tree.map(np.testing.assert_array_equal, answer, jaxbox.detect(cloud, strict))
    assert 0 < answer.valid.sum() < found(0).valid.sum()


def test_without_evidence_it_has_the_bits_of_detect(tmp_path):
    cloud = PointCloud.from_numpy(street(1).xyz, capacity=CAPACITY)
    paper = DetectorConfig.paper()
    jax.tree.map(np.testing.assert_array_equal, load(tmp_path, paper)(cloud), jaxbox.detect(cloud, paper))


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
    assert len(traced) == len(list((tmp_path / programs.FOLDER).iterdir())) == 8


@pytest.mark.parametrize("half", Half)
def test_a_broken_file_is_traced_anew(traced, tmp_path, half):
    load(tmp_path)
    (path,) = (tmp_path / programs.FOLDER).glob(f"*.{half}.*")
    whole = path.read_bytes()
    for broken in (b"", whole[: len(whole) // 2], b"\xff" * 64):
        path.write_bytes(broken)
        load(tmp_path)
        load(tmp_path)
    assert traced == halves(CAPACITY) + 3 * [(half, CAPACITY)]


def test_a_folder_that_cannot_be_made_does_not_matter(traced, tmp_path):
    (tmp_path / "file").touch()
    load(tmp_path / "file")
    assert traced == halves(CAPACITY)


def test_settings_that_contradict_each_other_are_refused_though_a_program_is_kept(traced, tmp_path):
    with pytest.raises(ValueError, match=r"evidence\.enabled"):
        load(tmp_path, changed("evidence", enabled=False))
    assert not traced


def test_the_command_line_keeps_programs_in_its_own_cache_only(traced, tmp_path, monkeypatch):
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path))
    users = jax.config.values["jax_compilation_cache_dir"]
    cloud = PointCloud.from_numpy(street(0).xyz, capacity=CAPACITY)
    assert users != str(tmp_path)
    jax.tree.map(np.testing.assert_array_equal, TimedDetector(BASE)(cloud)[0], found(0))
    assert not traced
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path))
        programs._compile_halves.cache_clear()
        TimedDetector(BASE)(cloud)
    finally:
        jax.config.update("jax_compilation_cache_dir", users)
    assert traced == halves(CAPACITY)


def resident_mb():
    status = pathlib.Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1000


def test_memory_that_was_freed_goes_back_to_the_system():
    # Other C libraries give memory back by themselves.
    glibc = platform.libc_ver()[0] == "glibc"
    before = resident_mb() if glibc else 0
    blocks = [np.full(8000, 1.0) for _ in range(3000)]  # 192 MB, each too small to be mapped by itself
    held = resident_mb() if glibc else 192
    with giving_memory_back():
        # One that stays near the end keeps the heap from shrinking by itself.
        blocks = blocks[-1:]
    left = resident_mb() if glibc else 0
    assert held - before > 150
    assert left - before < 50
    assert blocks[0].sum() == 8000
