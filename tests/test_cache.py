"""enable_cache(): where programs are kept, whom the folder belongs to, and that detect goes through it."""

import os
import pathlib
import subprocess
import sys

import jax
import pytest
from test_detector import CAPACITY, assert_same_bits, street
from typer.testing import CliRunner

import jaxbox
from jaxbox import PointCloud
from jaxbox.cli import app
from jaxbox.config.fields import replace_fields
from jaxbox.run import cache, compiled, programs
from jaxbox.run.cache import CacheFolders, CacheWarning, cache_folder, make_private
from jaxbox.run.compiled import count_compilations

PROJECT = pathlib.Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def _as_it_was(monkeypatch):
    """Afterwards the cache is off again, and JAX's where the tests have it."""
    monkeypatch.setattr(compiled, "_programs", None)
    users = jax.config.values["jax_compilation_cache_dir"]
    yield
    cache._move_jaxs(users)


def modes(folder):
    return [oct(path.stat().st_mode & 0o777) for path in (folder, folder / cache.PROGRAMS)]


def test_the_folder_follows_the_environment():
    home = pathlib.Path.home()
    assert cache_folder({}) == home / ".cache" / "jaxbox"
    assert cache_folder({"XDG_CACHE_HOME": "/x"}) == pathlib.Path("/x/jaxbox")
    assert cache_folder({"XDG_CACHE_HOME": "/x", "JAXBOX_CACHE_DIR": "/y"}) == pathlib.Path("/y")


@pytest.mark.parametrize("umask", [0o022, 0o000])
def test_the_folder_is_made_for_its_owner_alone_whatever_the_umask(tmp_path, umask):
    before = os.umask(umask)
    try:
        assert jaxbox.enable_cache(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    finally:
        os.umask(before)
    assert modes(tmp_path / "a" / "b") == ["0o700", "0o700"]


def test_the_variable_names_the_folder_or_switches_the_cache_off(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.CACHE_VARIABLE, "")
    assert jaxbox.enable_cache() is None
    assert compiled.kept_programs() is None
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path / "named"))
    assert jaxbox.enable_cache() == tmp_path / "named"
    assert compiled.kept_programs().folder == tmp_path / "named" / cache.PROGRAMS


def check_refused(folder, match):
    """Nothing is kept, and the reason is said; `detect` goes through programs that were shipped."""
    users = jax.config.values["jax_compilation_cache_dir"]
    with pytest.warns(CacheWarning, match=match):
        assert jaxbox.enable_cache(folder) is None
    assert compiled.kept_programs().folder is None
    assert jax.config.values["jax_compilation_cache_dir"] == users


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777, 0o720])
@pytest.mark.parametrize("inner", [False, True])
def test_a_folder_that_others_may_write_to_is_refused(tmp_path, mode, inner):
    folder = tmp_path / "cache"
    (folder / cache.PROGRAMS).mkdir(parents=True)
    (folder / cache.PROGRAMS if inner else folder).chmod(mode)
    check_refused(folder, "Others may write to .*chmod 700")


def test_a_folder_that_others_may_read_is_taken(tmp_path):
    tmp_path.chmod(0o755)
    assert jaxbox.enable_cache(tmp_path) == tmp_path


def test_a_folder_of_another_user_is_refused(tmp_path, monkeypatch):
    owner = tmp_path.stat().st_uid
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "users"))
    monkeypatch.setattr(cache, "_ROOT", owner + 2)
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    check_refused(tmp_path, "belongs to another user")
    # Root's own is as good as one's own: root can do as it likes anyway.
    monkeypatch.setattr(cache, "_ROOT", owner)
    assert jaxbox.enable_cache(tmp_path) == tmp_path


def test_a_folder_that_cannot_be_made_is_said(tmp_path):
    (tmp_path / "file").touch()
    check_refused(tmp_path / "file" / "cache", r"file: File exists.*JAXBOX_CACHE_DIR")
    check_refused(tmp_path / "file", "File exists")


def test_systems_without_owners_are_not_asked_for_them(tmp_path, monkeypatch):
    tmp_path.chmod(0o777)
    monkeypatch.delattr(os, "getuid")
    assert make_private(tmp_path) is None


def test_the_command_line_says_in_one_line_why_nothing_is_kept(tmp_path, monkeypatch):
    tmp_path.chmod(0o777)
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path))
    result = CliRunner().invoke(app, ["info"])
    assert result.exit_code == 0
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"warning: Others may write to {tmp_path}")


def test_detect_goes_through_what_is_kept_and_counts_it(tmp_path):
    cloud, paper = PointCloud.from_numpy(street(0).xyz, capacity=CAPACITY), jaxbox.DetectorConfig.paper()
    expected = jax.device_get(jaxbox.detect(cloud, paper))
    before = count_compilations()
    jaxbox.enable_cache(tmp_path)
    for _ in range(2):
        assert_same_bits(jaxbox.detect(cloud, paper), expected)
        assert count_compilations() == before + 1
    assert len(list((tmp_path / cache.PROGRAMS).iterdir())) == len(programs.Half)
    batch = jaxbox.detect_batch([cloud, cloud], paper, devices=jax.devices()[:1])
    assert_same_bits(batch[1], expected)
    jax.eval_shape(jax.vmap(jaxbox.detect, (0, None)), jaxbox.stack_clouds([cloud, cloud]), paper)
    assert count_compilations() == before + 1
    blind = replace_fields(jaxbox.DetectorConfig(), {"evidence.enabled": False})
    with pytest.raises(ValueError, match=r"evidence\.enabled"):
        jaxbox.detect(cloud, blind)


def test_jaxs_own_cache_stays_where_the_user_has_it(tmp_path):
    users = jax.config.values["jax_compilation_cache_dir"]
    assert users is not None
    jaxbox.enable_cache(tmp_path)
    assert jax.config.values["jax_compilation_cache_dir"] == users
    jax.config.update("jax_compilation_cache_dir", None)
    jaxbox.enable_cache(tmp_path / "first")
    jaxbox.enable_cache(tmp_path / "second")
    assert jax.config.values["jax_compilation_cache_dir"] == str(tmp_path / "second")


LATE = """
import os, sys
import jax, jax.numpy as jnp
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.jit(lambda x: x + 1)(1.0)
import jaxbox
jaxbox.enable_cache(sys.argv[1])
jax.jit(lambda x: x + 2)(1.0)
print([name for name in os.listdir(sys.argv[1]) if name.endswith("-cache")])
"""


def test_it_works_after_jax_has_compiled_something(tmp_path):
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment["PYTHONPATH"] = str(PROJECT)
    command = [sys.executable, "-c", LATE, str(tmp_path / "cache")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert "jit_" in done.stdout


def test_processes_that_are_started_get_the_same_folders(tmp_path):
    assert CacheFolders.of_this_process().is_enabled is False
    CacheFolders.of_this_process().apply()
    assert compiled.kept_programs() is None
    jaxbox.enable_cache(tmp_path)
    folders = CacheFolders.of_this_process()
    compiled.use_programs(None)
    folders.apply()
    assert CacheFolders.of_this_process() == folders
    (tmp_path / cache.PROGRAMS).chmod(0o777)
    folders.apply()
    assert compiled.kept_programs().folder is None


DAMAGED = """
import pathlib, shutil, sys, warnings
import jax, jax.numpy as jnp
import jaxbox
from jaxbox.run.cache import CacheFolders
warnings.simplefilter("error")
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
folder = pathlib.Path(sys.argv[1])
jaxbox.enable_cache(folder)
# What a worker of this process gets.
CacheFolders.of_this_process().apply()
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name.endswith("/cache_hits")))

x = jnp.arange(9.0)

def is_found():
    # Compiles again, or takes the entry; the value is right in any case.
    jax.clear_caches()
    hits.clear()
    assert jax.jit(lambda x: jnp.sort(x * 3) + 1)(x).tolist()[-1] == 25
    return any(hits)

def entry():
    (path,) = folder.glob("jit__lambda-*-cache")
    return path

assert not is_found() and is_found()
good = entry().read_bytes()
flipped = [good[:at] + bytes([good[at] ^ 1]) + good[at + 1 :] for at in range(0, len(good), len(good) // 9)]
for damage in (good[: len(good) // 2], b"", good + b"x", *flipped):
    entry().write_bytes(damage)
    assert not is_found(), "it was taken for a program"
    assert entry().read_bytes() == good or is_found(), "another is kept in its place"
# A good entry, of another program.
jax.jit(lambda y: y - 7)(1.0).block_until_ready()
other = next(path for path in folder.glob("jit__lambda-*-cache") if path.read_bytes() != good)
mine = next(path for path in folder.glob("jit__lambda-*-cache") if path != other)
shutil.copy(other, mine)
other.unlink()
assert not is_found()
assert is_found()
print("whole")
"""


def test_a_damaged_entry_of_jaxs_cache_or_one_under_anothers_name_is_made_again(tmp_path):
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment["PYTHONPATH"] = str(PROJECT)
    command = [sys.executable, "-c", DAMAGED, str(tmp_path / "cache")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "whole", done.stderr


@pytest.mark.parametrize("mode", [0o777, 0o775])
def test_a_folder_of_jaxs_own_that_others_may_write_to_is_not_used(tmp_path, mode):
    users = tmp_path / "users"
    users.mkdir()
    users.chmod(mode)
    jax.config.update("jax_compilation_cache_dir", str(users))
    with pytest.warns(CacheWarning, match=f"{users} .*JAX's compilation cache is off"):
        jaxbox.enable_cache(tmp_path / "ours")
    assert jax.config.values["jax_compilation_cache_dir"] is None
    assert compiled.kept_programs().folder == tmp_path / "ours" / cache.PROGRAMS


@pytest.mark.parametrize("place", ["missing", "gs://bucket/cache"])
def test_a_folder_of_jaxs_own_that_is_not_there_or_is_a_url_is_left_to_jax(tmp_path, place):
    folder = place if "://" in place else str(tmp_path / place)
    jax.config.update("jax_compilation_cache_dir", folder)
    jaxbox.enable_cache(tmp_path / "ours")
    assert jax.config.values["jax_compilation_cache_dir"] == folder
