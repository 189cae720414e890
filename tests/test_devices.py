"""One decision about what a program is built for, and what the program for accelerators may hold."""

import functools
import math
import re

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import parity
import pytest

from jaxbox import DetectorConfig, PointCloud, detect, synthetic
from jaxbox.run import compiled, export
from jaxbox.xla import backend

CAPACITY = 2**14
MAX_LOOPS = 3
"""Loops until nothing changes: hooking of components, counting of neighbours, suppression."""
MERGE_LOOPS = 1
"""Suppression once more, where several readings are merged."""
REDUCTION = re.compile(
    r"stablehlo\.reduce\(%\w+ init: %\w+\)(?: applies \S+)?"
    r" across dimensions = \[(\d+)\] : \(tensor<([\dx]+)x\w+>"
)
"""A reduction of one array along one axis: the axis, and the array's shape."""
MAX_REDUCED, MANY = 256, 2**20
"""Numbers that one result may be made of where an array has so many."""


@functools.cache
def text_for(platform, preset="default"):
    cloud = PointCloud.from_numpy(np.zeros((1, 3), np.float32), capacity=CAPACITY)
    return compiled.lower(cloud, DetectorConfig.presets()[preset], platform=platform).as_text()


@pytest.mark.codegen
@pytest.mark.parametrize("preset", parity.slow_but_first(DetectorConfig.presets()))
def test_the_program_for_accelerators_hardly_waits_for_its_host(preset):
    # The host of a GPU waits at each turn of a loop, and at each conditional.
    text = text_for("cuda", preset)
    several = DetectorConfig.presets()[preset].vehicles.num_readings > 1
    assert text.count("stablehlo.while") <= MAX_LOOPS + several * MERGE_LOOPS
    assert text.count("stablehlo.case") == text.count("stablehlo.if") == 0


@pytest.mark.codegen
@pytest.mark.parametrize("preset", parity.slow_but_first(DetectorConfig.presets()))
def test_triton_is_given_no_reduction_of_all_pairs_of_rows(preset):
    # In a batch its code for them is compiled for minutes, see `barriers.reduce_pairs`.
    found = [
        (shape, int(axis))
        for axis, dimensions in REDUCTION.findall(text_for("cuda", preset))
        if math.prod(shape := [int(size) for size in dimensions.split("x")]) >= MANY
    ]
    assert found
    assert not [(shape, axis) for shape, axis in found if shape[axis] > MAX_REDUCED]


@pytest.mark.codegen
def test_the_program_for_a_cpu_is_another_one():
    assert text_for("cpu").count("stablehlo.while") > 50
    assert text_for("cpu") == text_for(None)


@pytest.mark.codegen
def test_what_is_lowered_for_cuda_on_a_cpu_has_no_form_of_a_cpu():
    # Hidden truth values keep walls up and loops of one turn alive: forms that a CPU alone has.
    text, hidden = text_for("cuda"), re.compile(r"optimization_barrier %\w+ : tensor<i1>")
    assert len(hidden.findall(text_for("cpu"))) > 50
    assert not hidden.search(text)
    # Loops of a row at a time count without a sign, see `loops.for_chunks`.
    counters = re.findall(r"stablehlo\.while.*?: tensor<(\w+)>", text)
    assert len(counters) == text.count("stablehlo.while")


@pytest.mark.parametrize("platforms", [["cuda"], ["cpu"], ["cpu", "cuda"], ["cuda", "rocm"]])
def test_an_export_holds_the_program_of_each_kind_of_platform_once(platforms):
    exported = export.export_detector(CAPACITY, DetectorConfig.paper(), platforms=platforms)
    kinds = {"cpu", "cuda"} & set(platforms)
    loops = sum(text_for(kind, "paper").count("stablehlo.while") for kind in kinds)
    assert exported.mlir_module().count("stablehlo.while") == loops
    assert exported.platforms == tuple(platforms)


def test_an_export_for_both_kinds_gives_the_bits_of_detect_on_a_cpu():
    sweep = synthetic.make_sweep(0, num_beams=32, num_azimuths=520)
    cloud = PointCloud.from_numpy(sweep.xyz, capacity=CAPACITY)
    config = DetectorConfig.paper()
    exported = export.export_detector(CAPACITY, config, platforms=["cpu", "cuda"])
    arrays = exported.call(cloud.xyz1, cloud.num_points)
    for name, value in export.named_arrays(detect(cloud, config)).items():
        np.testing.assert_array_equal(arrays[name], value, err_msg=name)


def test_the_decision_is_by_the_context_then_the_arrays_device_then_the_default():
    here = jax.device_put(jnp.zeros(3), jax.devices("cpu")[0])
    assert not backend.on_accelerator()
    with backend.building_for(accelerator=True):
        assert backend.on_accelerator()
        assert backend.on_accelerator(here)
        with backend.building_for(accelerator=False):
            assert not backend.on_accelerator()
    assert not backend.on_accelerator(here)


def test_an_array_is_computed_with_where_it_is_and_all_else_by_default(monkeypatch):
    monkeypatch.setattr(backend, "default_device", lambda: jax.devices("cpu")[1])
    assert backend.platform_of(np.zeros(3)) == "cpu"

    class Gpu:
        platform = "gpu"

    monkeypatch.setattr(backend, "default_device", Gpu)
    assert backend.platform_of(np.zeros(3)) == backend.platform_of(None) == "gpu"
    assert backend.platform_of(jax.device_put(1.0, jax.devices("cpu")[0])) == "cpu"
    # A tracer is nowhere yet.
    assert jax.eval_shape(lambda x: jnp.int32(backend.on_accelerator(x)) + x, 0).dtype == jnp.int32


def test_the_default_device_is_the_one_that_jax_is_told():
    first, second = jax.devices("cpu")[:2]
    assert backend.default_device() == first
    with jax.default_device(second):
        assert backend.default_device() == second
    with jax.default_device("cpu"):
        assert backend.default_device() == first
