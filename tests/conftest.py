"""Shared fixtures: the real sweeps, and compiled functions that the tests share."""

import gc
import importlib
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import hypothesis
import jax
import parity
import pytest

from jaxbox.run import batching, streaming
from jaxbox.run.batching import checked_devices
from jaxbox.xla import backend

DATA = pathlib.Path(os.environ.get("JAXBOX_DATA", pathlib.Path(__file__).parents[2] / "shared" / "data"))

FAST = {
    "test_ablation.py", "test_annotations.py", "test_capacities.py", "test_classes.py", "test_config.py",
    "test_config_fields.py", "test_conventions.py", "test_docs.py", "test_doubts.py",
    "test_evaluation_beams.py", "test_evaluation_corruptions.py", "test_evaluation_iou.py",
    "test_evaluation_kitti.py", "test_evaluation_objectives.py", "test_evaluation_report.py",
    "test_evaluation_sizes.py", "test_evaluation_tracking.py", "test_fuzz_readers.py", "test_geometry.py",
    "test_hostile_files.py", "test_io_drives.py", "test_io_files.py", "test_io_formats.py",
    "test_io_kitti.py", "test_io_kitti_tracking.py", "test_io_other_sensors.py", "test_io_poses.py",
    "test_io_velodyne.py", "test_lidar_packets.py", "test_live.py", "test_live_benchmark.py",
    "test_live_libraries.py", "test_live_packets.py", "test_output.py", "test_packaging.py",
    "test_paper_table.py", "test_point_convention.py", "test_point_times.py", "test_reference.py",
    "test_reliability_benchmarks.py", "test_sensors_benchmark.py", "test_speed_benchmarks.py",
    "test_synthetic.py", "test_tracking_poses.py", "test_tuning.py", "test_types.py", "test_viz.py",
    "test_viz_judged.py", "test_viz_tracks.py", "test_xla_laws.py",
}  # fmt: skip
"""Files whose tests make up ``pytest -m fast``, but for those in `COMPILING` and those marked slow."""
COMPILING = {
    "test_files_made_to_fill_the_memory_are_refused",
    "test_files_that_claim_or_unpack_to_too_much_are_refused_within_time_and_memory",
    "rounds",
    "test_the_readme_python_example_runs",
}
"""Tests and fixtures that compile the whole detector, or go through many real sweeps or large files."""
FIRST = "test_arguments.py"
"""A file that compiles the default preset for the smallest capacity, and little else."""

MAX_MAPS = 40_000
"""Memory maps of a process at the end of a file of tests, above which it forgets its compiled programs. No
file adds more than 15,000."""
GC_THRESHOLDS = 50_000, 20, 50
"""To trace a detector makes a million objects that stay: by Python's own thresholds, a tenth of the time goes
into looking for garbage among them."""


# The same few examples each time; `--hypothesis-profile=long` draws many new ones.
_options = {"deadline": None, "database": None, "suppress_health_check": list(hypothesis.HealthCheck)}
hypothesis.settings.register_profile("ci", max_examples=20, derandomize=True, **_options)
hypothesis.settings.register_profile("long", max_examples=1000, print_blob=True, **_options)
hypothesis.settings.load_profile("ci")


def pytest_configure(config: pytest.Config) -> None:
    """Keeps compiled functions in pytest's cache: the notebook's kernel and the next run share them.

    They are compiled with `parity.SMALL_CODE`, here and in the processes that tests start.

    `pytest --cache-clear` starts from nothing.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    # Once only, though a worker of `-n` has its parent's: JAX looks for what is compiled by all flags given.
    if parity.SMALL_CODE not in flags:
        os.environ["XLA_FLAGS"] = f"{parity.SMALL_CODE} {flags}".strip()
    folder = os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(config.cache.mkdir("jax")))
    jax.config.update("jax_compilation_cache_dir", folder)
    # The user's own cache is left alone, also by the processes that tests start.
    os.environ["JAXBOX_CACHE_DIR"] = ""
    # Two, so that work over several devices can be tested; the first is the default as ever. In the processes
    # that tests start too, as programs are kept for so many devices.
    jax.config.update("jax_num_cpu_devices", 2)
    os.environ["JAX_NUM_CPU_DEVICES"] = "2"
    # What a user may ask for, the library must do, and the tests with it.
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks the fast tests, and has them follow the file whose program nearly all others take.

    With `-n 2` one process compiles it while the other goes through the fast tests: else both would. Those of
    the toolbox, which are long, come next: of two processes the last file keeps but one busy.
    """
    items.sort(
        key=lambda item: (item.path.name != FIRST, item.path.name not in FAST, not _is_of_toolbox(item))
    )
    for item in items:
        # Doctests have no fixtures.
        names = {getattr(item, "originalname", item.name), *getattr(item, "fixturenames", ())}
        if item.path.name in FAST and not names & COMPILING and not item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.fast)


def _is_of_toolbox(item: pytest.Item) -> bool:
    return item.path.name.startswith("test_xla")


def pytest_collection_finish() -> None:
    """Has the garbage collector leave alone what was imported, and look seldom."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*GC_THRESHOLDS)


def pytest_unconfigure() -> None:
    """Gives it all back: nanobind, which JAX is bound by, complains of what is left when Python ends."""
    gc.unfreeze()


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Between two files, forgets the compiled programs when they take up many memory maps.

    A process may have 65,530 of them on Linux (``vm.max_map_count``), a compiled detector takes some hundred,
    and without them the compiler ends the process with a segmentation fault.
    """
    if nextitem is None or nextitem.path != item.path:
        maps = pathlib.Path("/proc/self/maps")
        if maps.exists() and maps.read_bytes().count(b"\n") > MAX_MAPS:
            jax.clear_caches()
            gc.collect()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With `-n`, of one file all tests run in one process: they share compiled functions."""
    # Files in their order: by the number of their tests, the slowest, with few, would all come last.
    config.option.loadscopereorder = False
    return importlib.import_module("xdist.scheduler").LoadFileScheduling(config, log)


def _of_first_device(devices: Sequence[Any] | None) -> Sequence[Any]:
    return checked_devices(jax.local_devices()[:1] if devices is None else devices)


@pytest.fixture(scope="session", autouse=True)
def _one_device() -> Iterator[None]:
    """Has sweeps for which no devices are named go to the first: each compiles every program once more."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (batching, streaming):
            patch.setattr(module, "checked_devices", _of_first_device)
        yield


@pytest.fixture
def _all_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has them go to all devices, as they do for a user."""
    for module in (batching, streaming):
        monkeypatch.setattr(module, "checked_devices", checked_devices)


@pytest.fixture(scope="session")
def data_root() -> pathlib.Path:
    """The folder of real sweeps; tests that need it skip, saying so, where it is absent."""
    if not DATA.is_dir():
        pytest.skip(f"no real sweeps: {DATA} is not a folder; set JAXBOX_DATA")
    return DATA


@pytest.fixture(params=["synthetic", "real"])
def cases(request: pytest.FixtureRequest) -> tuple[parity.Case, ...]:
    """The sweeps of `parity`, with the reference's results: twenty seeds, then five real ones."""
    if request.param == "synthetic":
        return parity.synthetic_cases()
    return parity.real_cases(request.getfixturevalue("data_root"))


@pytest.fixture(params=["cpu", "accelerator"])
def platform(request, monkeypatch):
    """Either form of what is done otherwise on a CPU, whatever the tests run on.

    Functions that were jitted before would keep the form that they were traced in: a test jits its own, or
    shares one a form, a `parity.PerForm`.
    """
    asked = []
    chosen = backend._for_accelerator

    class Watched:
        """The context variable, which notes that it was read."""

        def get(self):
            asked.append(request.param)
            return chosen.get()

        set, reset = chosen.set, chosen.reset

    monkeypatch.setattr(backend, "_for_accelerator", Watched())
    with backend.building_for(accelerator=request.param == "accelerator"):
        yield request.param
    assert asked, "Traced before: jit a function of the test's own, or a parity.PerForm."
