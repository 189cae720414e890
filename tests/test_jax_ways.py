"""JAX's own ways, one test each: 64 bits, strict promotion, meshes, gradients, export, transfer guards."""

import collections
import dataclasses
import re

import chex
import jax
import jax.experimental
import jax.export
import jax.numpy as jnp
import numpy as np
import parity
import pytest

from jaxbox import DetectorConfig, PointCloud, detect, stack_clouds, synthetic
from jaxbox.run import compiled
from jaxbox.xla import backend
from quality import bad_input

CAPACITY = bad_input.CAPACITY
"""For which other tests compile the presets too, so that a run compiles them once."""
WIDE = {"int64", "uint64", "float64", "complex128"}
SWEEPS = jax.sharding.PartitionSpec("sweeps")

enable_x64 = jax.enable_x64 if hasattr(jax, "enable_x64") else jax.experimental.enable_x64


def street(seed=0):
    sweep = synthetic.make_sweep(seed, num_beams=16, num_azimuths=200)
    return PointCloud.from_numpy(sweep.xyz, capacity=CAPACITY)


def paper(cloud):
    return detect(cloud, DetectorConfig.paper())


def assert_same_bits(one, other):
    chex.assert_trees_all_equal_dtypes(one, other)
    chex.assert_trees_all_equal(one, other)


def row_of(batch, row):
    return jax.tree.map(lambda leaf: leaf[row], jax.device_get(batch))


def avals_in(jaxpr):
    """Types of all values of a jaxpr and of those within it."""
    for equation in jaxpr.eqns:
        yield from (var.aval for var in (*equation.invars, *equation.outvars))
        inner = jax.tree.leaves(equation.params, is_leaf=lambda p: hasattr(p, "eqns") or hasattr(p, "jaxpr"))
        for part in (getattr(param, "jaxpr", param) for param in inner):
            if hasattr(part, "eqns"):
                yield from avals_in(part)


def widened(cloud, config):
    """The same numbers in 64 bits."""
    cloud = jax.tree.map(lambda a: jnp.asarray(a, a.dtype.kind + "8"), cloud)
    assert cloud.xyz1.dtype == jnp.float64
    return cloud, jax.tree.map(jnp.float64, config)


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "wide"), [("default", False), ("paper", True)])
def test_with_64_bits_enabled_the_bits_are_those_without(preset, wide):
    config, cloud = DetectorConfig.presets()[preset], street()
    expected = jax.device_get(detect(cloud, config))
    with enable_x64(True):
        given = widened(cloud, config) if wide else (cloud, config)
        assert_same_bits(detect(*given), expected)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_with_64_bits_enabled_arrays_of_64_bits_are_converted_and_else_the_program_is_the_same(preset):
    # So that one of the two need be compiled.
    given = street(), DetectorConfig.presets()[preset]
    with enable_x64(True):
        narrow, wide = (operations_of(compiled.lower(*each)) for each in (given, widened(*given)))
    assert narrow - wide == collections.Counter()
    added = (wide - narrow).elements()
    assert sorted(operation.split()[2] for operation in added) == 3 * ["stablehlo.convert"]


def operations_of(lowered):
    """How often a program has each operation, whatever the names of its values."""
    lines = (line for line in lowered.as_text().splitlines() if "@main" not in line)
    return collections.Counter(re.sub(r"%\w+", "%", line).strip() for line in lines)


@pytest.mark.slow
def test_with_64_bits_enabled_a_batch_has_the_bits_of_the_singles():
    clouds = [street(seed) for seed in (0, 1)]
    with enable_x64(True):
        many = jax.vmap(paper)(stack_clouds(clouds))
    for row, cloud in enumerate(clouds):
        assert_same_bits(row_of(many, row), paper(cloud))


@pytest.mark.parametrize("accelerator", [False, True])
@pytest.mark.parametrize("preset", parity.slow_but_first(DetectorConfig.presets()))
def test_with_64_bits_enabled_the_program_computes_in_32_and_promotes_no_type_and_no_rank(
    preset, accelerator
):
    strict = jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise")
    config, clouds = DetectorConfig.presets()[preset], stack_clouds([street(), street()])
    with backend.building_for(accelerator=accelerator), enable_x64(True), strict[0], strict[1]:
        many = jax.make_jaxpr(jax.vmap(lambda cloud: detect(cloud, config)))(clouds)
        single, answer = jax.make_jaxpr(lambda cloud: detect(cloud, config), return_shape=True)(street())
    assert answer.valid.shape == (config.vehicles.max_detections,)
    for program in (single, many):
        avals = [aval for aval in avals_in(program.jaxpr) if hasattr(aval, "dtype")]
        assert len(avals) > 1000
        # Python's numbers, and in JAX 0.6 the place of an entry that is known, are of 64 bits.
        assert not [aval for aval in avals if str(aval.dtype) in WIDE and aval.size > 2]


def assert_same_boxes(many, clouds):
    """Those of the singles, but for rounding: XLA makes a program for several devices by other passes."""
    for row, cloud in enumerate(clouds):
        found, expected = row_of(many, row), paper(cloud)
        for name in ("center", "size", "yaw", "score"):
            np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-4)
        for name in ("label", "valid", "status"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        assert found.valid.any()


def spread(clouds, axis_type):
    """The clouds as a batch over two devices, and their mesh."""
    mesh = jax.make_mesh((2,), ("sweeps",), axis_types=(axis_type,))
    sharding = jax.sharding.NamedSharding(mesh, SWEEPS)
    return jax.device_put(stack_clouds(clouds), sharding), mesh


@pytest.mark.slow
@pytest.mark.skipif(jax.__version_info__ < (0, 10), reason="explicit meshes of older JAX know no scatters")
def test_a_batch_over_an_explicit_mesh_is_found_where_it_is():
    clouds = [street(seed) for seed in range(4)]
    batch, mesh = spread(clouds, jax.sharding.AxisType.Explicit)
    many = jax.jit(jax.vmap(paper), compiler_options=parity.QUICKLY)(batch)
    assert many.valid.sharding.is_equivalent_to(jax.sharding.NamedSharding(mesh, SWEEPS), 2)
    assert_same_boxes(many, clouds)


def unspread_lines(lowered):
    """What a program computes, without what says how arrays are spread: its values by their first appearance.

    JAX 0.12 says within a function, too, how an array is to be spread, as one more value.
    """
    lines, names, same = [], {}, {}

    def renamed(value):
        # One of several results is %5#2.
        name, *result = same.get(value[0], value[0]).split("#")
        return "#".join([names.setdefault(name, f"%{len(names)}"), *result])

    for line in lowered.as_text().splitlines():
        if "func.func" in line:
            names, same = {}, {}
        if spread := re.match(r"\s*(%\w+) = sdy\.sharding_constraint (%[\w#]+)", line):
            same[spread[1]] = same.get(spread[2], spread[2])
        elif "@main" not in line:
            lines.append(re.sub(r"%[\w#]+", renamed, line))
    return lines


# The third type, Manual, is what a mesh becomes within shard_map.
def test_a_batch_over_a_mesh_of_any_type_goes_through_shard_map():
    clouds = [street(seed) for seed in range(4)]
    bodies = []
    for axis_type in (jax.sharding.AxisType.Explicit, jax.sharding.AxisType.Auto):
        batch, mesh = spread(clouds, axis_type)
        find = jax.shard_map(jax.vmap(paper), mesh=mesh, in_specs=SWEEPS, out_specs=SWEEPS, check_vma=False)
        program = jax.jit(find).lower(batch)
        bodies.append(unspread_lines(program))
    # All but how the arguments and the answer are said to be spread: so that one of them need be compiled.
    assert any("stablehlo.while" in line for line in bodies[0])
    assert bodies[0] == bodies[1]
    many = program.compile(parity.QUICKLY)(batch)
    assert many.valid.sharding.device_set == set(mesh.devices.flat)
    assert_same_boxes(many, clouds)


@pytest.mark.parametrize("through", ["grad", "jit", "vmap", "jvp"])
def test_a_gradient_is_refused_in_a_sentence(through):
    cloud, x = street(), jnp.float32(1)

    def total_score(scale):
        return paper(dataclasses.replace(cloud, xyz1=scale * cloud.xyz1)).score.sum()

    asked = {
        "grad": jax.grad(total_score),
        "jit": jax.jit(jax.grad(total_score)),
        "vmap": lambda x: jax.grad(lambda scales: jax.vmap(total_score)(scales).sum())(x[None]),
        "jvp": lambda x: jax.jvp(total_score, (x,), (x,)),
    }
    with pytest.raises(TypeError, match=r"jaxbox\.detect is not differentiable, since"):
        asked[through](x)


def test_a_gradient_of_what_follows_is_there():
    cloud = street()

    def weighted(scale):
        held = jax.lax.stop_gradient(scale) * cloud.xyz1
        return scale * paper(dataclasses.replace(cloud, xyz1=held)).score.sum()

    assert jax.grad(weighted)(1.0) == weighted(1.0) > 0


@pytest.mark.slow
def test_an_exported_function_of_clouds_and_settings_is_serialized_and_called_again():
    cloud, config = street(), DetectorConfig.paper()
    written = jax.export.export(jax.jit(detect))(cloud, config).serialize()
    again = jax.export.deserialize(written)
    found = again.call(cloud, config)
    assert jax.tree.structure(found) == jax.tree.structure(paper(cloud))
    assert_same_bits(found, paper(cloud))
    # The static settings are part of what it takes.
    with pytest.raises(ValueError, match="structure"):
        again.call(cloud, DetectorConfig())


def test_where_all_is_on_the_device_nothing_is_transferred():
    cloud, config = street(), DetectorConfig.paper()
    expected, on_device = paper(cloud), jax.device_put(cloud)
    with jax.transfer_guard("disallow"):
        with pytest.raises(Exception, match=r"[Dd]isallowed host-to-device transfer"):
            jnp.zeros(3) + np.ones(3, np.float32)
        # The second call has its thresholds there already.
        first, second = detect(on_device, config), detect(on_device, config)
        keyed = jax.jit(paper)(on_device)
    for found in (first, second, keyed):
        assert_same_bits(found, expected)
