"""The detector as a file: StableHLO that runs without jaxbox's source, in JAX or in a C++ runtime.

What is exported takes plain arrays and gives a dictionary of plain arrays, because a class of jaxbox in its
interface would have to be there when it is loaded. ``docs/export.md`` tells how to run it.
"""

import functools
import json
import os
import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.export
import jax.numpy as jnp

from jaxbox._files import atomic_path
from jaxbox._version import __version__
from jaxbox.config import DetectorConfig
from jaxbox.run.compiled import detect
from jaxbox.types import Detections, PointCloud
from jaxbox.xla.backend import building_for, on_accelerator

__all__ = [
    "INTERFACE_NAME",
    "JAX_NAME",
    "STABLEHLO_NAME",
    "export_detector",
    "named_arrays",
    "write_exported",
]

JAX_NAME = "detector.jax"
"""File that `jax.export.deserialize` reads."""
STABLEHLO_NAME = "detector.stablehlo"
"""File of portable StableHLO bytecode."""
INTERFACE_NAME = "detector.json"
"""File that describes inputs and outputs, in their order."""


def export_detector(
    capacity: int,
    config: DetectorConfig | None = None,
    key: jax.Array | None = None,
    *,
    platforms: Sequence[str] | None = None,
) -> jax.export.Exported:
    """Lowers `jaxbox.detect` for one capacity to StableHLO, with its settings and key inside.

    Args:
      capacity: N, points that every sweep is padded to.
      config: the settings; None for the default preset.
      key: JAX random key; None for `jax.random.key(0)`.
      platforms: "cpu", "cuda", "rocm", "tpu"; None for the one that JAX runs on here. The program of a CPU
        is another than that of accelerators: where both are asked for, both are inside.

    Returns:
      A function of `xyz1` (N, 4) float32 and `num_points` () int32, see `PointCloud`. Its result is a
      dictionary of the arrays of `Detections` by dotted name, such as "counts.obstacles", with the bits
      that `detect` gives.

    Raises:
      ValueError: for settings that contradict each other or a capacity below 1.
    """
    if capacity < 1:
        raise ValueError(f"capacity is {capacity}; it must be at least 1.")
    config = DetectorConfig() if config is None else config
    key = jax.random.key(0) if key is None else key
    values, structure = jax.tree.flatten(config)

    def run(accelerator: bool, xyz1: jax.Array, num_points: jax.Array) -> dict[str, jax.Array]:
        # Behind the barrier the compiler takes the thresholds for inputs, as `detect` has them: arithmetic
        # with constants would be ordered otherwise.
        held = jax.lax.optimization_barrier([jnp.float32(value) for value in values])
        cloud = PointCloud(xyz1, jnp.zeros(capacity), num_points)
        with building_for(accelerator=accelerator):
            return named_arrays(detect(cloud, jax.tree.unflatten(structure, held), key))

    kinds = {on_accelerator()} if platforms is None else {platform != "cpu" for platform in platforms}

    def program(*inputs: jax.Array) -> dict[str, jax.Array]:
        if len(kinds) == 1:
            return run(True in kinds, *inputs)
        forms = {"cpu": functools.partial(run, False), "default": functools.partial(run, True)}
        return jax.lax.platform_dependent(*inputs, **forms)

    inputs = jax.ShapeDtypeStruct((capacity, 4), jnp.float32), jax.ShapeDtypeStruct((), jnp.int32)
    return jax.export.export(jax.jit(program), platforms=platforms)(*inputs)


def named_arrays(detections: Detections) -> dict[str, Any]:
    """The arrays of detections by dotted name, as an exported detector gives them.

    Args:
      detections: of a sweep.

    Returns:
      Such as "center" and "counts.obstacles".
    """
    leaves = jax.tree_util.tree_leaves_with_path(detections)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def write_exported(folder: str | os.PathLike[str], exported: jax.export.Exported) -> list[pathlib.Path]:
    """Writes an exported detector for JAX and for other runtimes, and what its arrays are.

    Args:
      folder: made where it is missing.
      exported: what `export_detector` gives.

    Returns:
      The files: `JAX_NAME`, `STABLEHLO_NAME` and `INTERFACE_NAME`.
    """
    contents = {
        JAX_NAME: bytes(exported.serialize()),
        STABLEHLO_NAME: exported.mlir_module_serialized,
        INTERFACE_NAME: json.dumps(_interface(exported), indent=1).encode(),
    }
    paths = [pathlib.Path(folder) / name for name in contents]
    for path, content in zip(paths, contents.values(), strict=True):
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
    return paths


def _interface(exported: jax.export.Exported) -> dict[str, Any]:
    """Inputs and outputs in the order in which the StableHLO module has them."""
    outputs = jax.tree.unflatten(exported.out_tree, range(len(exported.out_avals)))
    names = sorted(outputs, key=outputs.__getitem__)
    return {
        "jaxbox": __version__,
        "jax": jax.__version__,
        "platforms": list(exported.platforms),
        "calling_convention": exported.calling_convention_version,
        "inputs": [
            _array(name, aval) for name, aval in zip(("xyz1", "num_points"), exported.in_avals, strict=True)
        ],
        "outputs": [_array(name, aval) for name, aval in zip(names, exported.out_avals, strict=True)],
    }


def _array(name: str, aval: Any) -> dict[str, Any]:
    return {"name": name, "shape": list(aval.shape), "dtype": str(aval.dtype)}
