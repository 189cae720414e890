"""The detector's traced programs, kept between runs: tracing takes seconds, reading what was traced does not.

JAX's compilation cache keeps what the compiler makes of a program, but to find it there JAX traces the
program first, in every process anew.
"""

import contextlib
import dataclasses
import enum
import functools
import gc
import hashlib
import pathlib
import typing
from collections.abc import Callable, Iterator
from concurrent import futures
from typing import Any

import jax
import jax.export
import jaxlib.version
import numpy as np

import jaxbox
from jaxbox import detector, io
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


class Half(enum.StrEnum):
    """Of `detect`, see `jaxbox.detector`: one is compiled while the other is traced."""

    SEGMENT = "segment"
    DECIDE = "decide"


def kept_program(config: DetectorConfig, *, capacity: int, folder: pathlib.Path) -> Program:
    """The compiled detector for one capacity, from the folder, or traced and left there for the next run.

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
    segment, decide = _compile_halves(settings, capacity, folder / FOLDER)

    def program(cloud: PointCloud) -> Detections:
        operands = cloud.xyz1, cloud.intensity, cloud.num_points, thresholds
        return jax.tree.unflatten(answer, decide(*operands, *segment(*operands)))

    return program


@functools.cache  # a process compiles it once, as JAX does of the function itself
def _compile_halves(settings: Any, capacity: int, folder: pathlib.Path) -> list[Callable[..., Any]]:
    name = _fingerprint(settings, capacity)
    with _without_garbage_collection(), futures.ThreadPoolExecutor(len(Half)) as threads:
        compiled = []
        for half in Half:
            path = folder / f"{name}.{half}.stablehlo"
            kept = _read(path)
            exported = kept or _trace(half, settings, capacity)
            # Here and not by the thread, which the tracing of the next half would keep from Python's lock.
            lowered = jax.jit(exported.call).lower(*exported.in_avals)
            compiled.append(threads.submit(lowered.compile))
            if kept is None:
                _write(path, exported)
        return [future.result() for future in compiled]


@contextlib.contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Tracing makes a million objects, hardly any of them garbage, and looking for it takes a tenth of it."""
    was_collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_collecting:
            gc.enable()


def _trace(half: Half, settings: Any, capacity: int) -> jax.export.Exported:
    def inputs(
        xyz1: jax.Array, intensity: jax.Array, num_points: jax.Array, thresholds: jax.Array
    ) -> tuple[PointCloud, DetectorConfig]:
        config: DetectorConfig = jax.tree.unflatten(settings, list(thresholds))
        return PointCloud(xyz1, intensity, num_points), config

    def segment(*operands: jax.Array) -> detector.Segments:
        return detector.segment(*inputs(*operands))

    shapes = (capacity, 4), (capacity,), (), (settings.num_leaves,)
    dtypes = np.float32, np.float32, np.int32, np.float32
    operands = list(map(jax.ShapeDtypeStruct, shapes, dtypes))
    if half is Half.SEGMENT:
        return jax.export.export(jax.jit(lambda *operands: jax.tree.leaves(segment(*operands))))(*operands)
    found, structure = jax.tree.flatten(jax.eval_shape(segment, *operands))

    def decide(*values: jax.Array) -> list[jax.Array]:
        cloud, config = inputs(*values[: len(operands)])
        segments = jax.tree.unflatten(structure, values[len(operands) :])
        return jax.tree.leaves(detector.decide(cloud, segments, config))

    return jax.export.export(jax.jit(decide))(*operands, *found)


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


def _read(path: pathlib.Path) -> jax.export.Exported | None:
    """What was kept, or None where nothing was, or it is broken."""
    try:
        return jax.export.deserialize(bytearray(path.read_bytes()))
    except Exception:
        # Whatever is wrong with a kept file, tracing replaces it.
        return None


def _write(path: pathlib.Path, exported: jax.export.Exported) -> None:
    try:
        with io.atomic_path(path) as temporary:
            temporary.write_bytes(exported.serialize())
    except OSError:
        # A folder that cannot be written costs time, not the answer.
        return
