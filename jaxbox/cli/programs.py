"""The detector's traced programs, kept between runs: tracing takes seconds, reading what was traced does not.

JAX's compilation cache keeps what the compiler makes of a program, but to find it there JAX traces the
program first, in every process anew.
"""

import dataclasses
import functools
import gc
import hashlib
import pathlib
import typing
from collections.abc import Callable
from typing import Any

import jax
import jax.export
import jaxlib.version
import numpy as np

import jaxbox
from jaxbox import io
from jaxbox.config import DetectorConfig
from jaxbox.steps import check_settings
from jaxbox.types import Detections, PointCloud

FOLDER = "programs"
"""Within the folder of the compilation cache."""

TRACED_WITH = (
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
)
"""What of JAX's configuration a traced program depends on."""

Program = Callable[[PointCloud], Detections]


def kept_program(config: DetectorConfig, *, capacity: int, folder: pathlib.Path) -> Program:
    """The detector for one capacity, from the folder, or traced and left there for the next run.

    What is kept is StableHLO with the thresholds as an input. Its name tells the code of jaxbox, the
    versions, the device and the static settings that it was made of: another of them makes another.

    Args:
      config: the settings.
      capacity: N, points that every sweep is padded to.
      folder: of the compilation cache; it need not exist.

    Returns:
      A function of a cloud of this capacity: the answer of `jaxbox.detect`, bit for bit.

    Raises:
      ValueError: for settings that contradict each other.
    """
    check_settings(config)
    values, settings = jax.tree.flatten(config)
    thresholds = np.array(values, np.float32)
    answer = jax.tree.structure(_example(Detections))
    run = _load_or_trace(settings, capacity, folder / FOLDER, answer.num_leaves)

    def program(cloud: PointCloud) -> Detections:
        return jax.tree.unflatten(answer, run(cloud.xyz1, cloud.intensity, cloud.num_points, thresholds))

    return program


@functools.cache  # a process compiles it once, as JAX does of the function itself
def _load_or_trace(
    settings: Any, capacity: int, folder: pathlib.Path, num_outputs: int
) -> Callable[..., Any]:
    path = folder / f"{_fingerprint(settings, capacity)}.stablehlo"
    exported = _read(path, num_outputs=num_outputs)
    if exported is None:
        exported = _trace(settings, capacity)
        _write(path, exported)
    return jax.jit(exported.call)


def _trace(settings: Any, capacity: int) -> jax.export.Exported:
    def run(
        xyz1: jax.Array, intensity: jax.Array, num_points: jax.Array, thresholds: jax.Array
    ) -> list[jax.Array]:
        config = jax.tree.unflatten(settings, list(thresholds))
        return jax.tree.leaves(jaxbox.detect(PointCloud(xyz1, intensity, num_points), config))

    shapes = (capacity, 4), (capacity,), (), (settings.num_leaves,)
    dtypes = np.float32, np.float32, np.int32, np.float32
    # A million objects, hardly any of them garbage: to look for it would take a tenth of the time.
    was_collecting = gc.isenabled()
    gc.disable()
    try:
        return jax.export.export(jax.jit(run))(*map(jax.ShapeDtypeStruct, shapes, dtypes))
    finally:
        if was_collecting:
            gc.enable()


def _example(cls: type) -> Any:
    """An instance with zeros for its arrays, which tells the structure of an answer without tracing one."""
    kinds = typing.get_type_hints(cls)
    values = {
        field.name: _example(kinds[field.name]) if dataclasses.is_dataclass(kinds[field.name]) else 0
        for field in dataclasses.fields(cls)
    }
    return cls(**values)


def _fingerprint(settings: Any, capacity: int) -> str:
    device = jax.devices()[0]
    made_of = (
        _source_digest(),
        (jax.__version__, jaxlib.version.__version__),
        tuple(str(jax.config.values.get(name)) for name in TRACED_WITH),
        (device.platform, device.device_kind),
        (capacity, str(settings)),
    )
    return hashlib.sha256(repr(made_of).encode()).hexdigest()[:32]


@functools.cache
def _source_digest() -> str:
    """Of all modules of jaxbox: a change in any may be a change of the program."""
    root = pathlib.Path(jaxbox.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def _read(path: pathlib.Path, *, num_outputs: int) -> jax.export.Exported | None:
    """What was kept, or None where nothing was, or it is broken."""
    try:
        exported = jax.export.deserialize(bytearray(path.read_bytes()))
    except Exception:
        # Whatever is wrong with a kept file, tracing replaces it.
        return None
    return exported if len(exported.out_avals) == num_outputs else None


def _write(path: pathlib.Path, exported: jax.export.Exported) -> None:
    try:
        with io.atomic_path(path) as temporary:
            temporary.write_bytes(exported.serialize())
    except OSError:
        # A folder that cannot be written costs time, not the answer.
        return
