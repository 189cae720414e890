"""The detector's traced programs, kept between runs: tracing takes seconds, reading what was traced does not.

JAX's compilation cache keeps what the compiler makes of a program, but to find it there JAX traces the
program first, in every process again.
"""

import contextlib
import dataclasses
import enum
import functools
import gc
import hashlib
import pathlib
import threading
import typing
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from typing import Any

import jax
import jax.core
import jax.export
import jax.numpy as jnp
import jaxlib.version
import numpy as np

from jaxbox import detector
from jaxbox.run import compiled
from jaxbox.run.compiled import PackedConfig
from jaxbox.run.program_files import SUFFIX, read_program, write_program
from jaxbox.types import Detections, PointCloud
from jaxbox.xla.backend import building_for, default_device

SHIPPED = pathlib.Path(__file__).parents[1] / "data" / "programs"
"""Programs that came with the installation, see `jaxbox.run.shipping`."""

TRACED_WITH = (
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
)
"""What of JAX's configuration a traced program depends on."""

KEY_IMPL = "threefry2x32"
"""JAX's own kind of random key, the only one that kept programs take."""
_KEY_WORDS = 2
_NO_LOCATIONS = {
    "jax_traceback_in_locations_limit": 0,
    "jax_hlo_source_file_canonicalization_regex": ".*",
}
"""No lines of source; JAX 0.6 names one all the same, and no file then."""

_Compiled = Callable[..., list[jax.Array]]


class Half(enum.StrEnum):
    """Of `detect`, see `jaxbox.detector`: one is compiled while the other is traced."""

    SEGMENT = "segment"
    DECIDE = "decide"


@dataclasses.dataclass(frozen=True)
class Build:
    """What decides how `detect` is traced. Thresholds and the random key do not: they are inputs."""

    structure: Any
    """Tree of a `DetectorConfig`, with its static settings."""
    capacity: int
    """N, points that every sweep is padded to."""
    accelerator: bool
    """Whether it is built for an accelerator, see `jaxbox.xla.backend`."""
    platform: str
    """That it is lowered for: "cpu", "cuda", "rocm" or "tpu"."""
    options: tuple[str, ...]
    """Values of `TRACED_WITH`."""

    def made_of(self, half: Half) -> dict[str, str]:
        """All that a program depends on, to be compared with that of a file."""
        return {
            "source": source_digest(),
            "jax": jax.__version__,
            "jaxlib": jaxlib.version.__version__,
            "platform": self.platform,
            "capacity": str(self.capacity),
            "half": str(half),
            "build": _digest(repr((self.accelerator, self.options, str(self.structure))).encode()),
        }

    def file_name(self, half: Half) -> str:
        """Another one for each thing that it is made of."""
        return _digest(repr(self.made_of(half)).encode())[:32] + SUFFIX

    def operands(self) -> list[jax.ShapeDtypeStruct]:
        """Points, intensities, their number, thresholds, and the data of the random key."""
        shapes = (self.capacity, 4), (self.capacity,), (), (self.structure.num_leaves,), (_KEY_WORDS,)
        dtypes = np.float32, np.float32, np.int32, np.float32, np.uint32
        return list(map(jax.ShapeDtypeStruct, shapes, dtypes))


class KeptPrograms:
    """What `detect` asks for a program that needs no tracing; see `jaxbox.run.compiled.use_programs`.

    A program comes with the installation, or lies in the folder, or is traced and left there for the next
    run. Each half of it is compiled by a thread of its own, or loaded from JAX's cache.
    """

    def __init__(self, folder: pathlib.Path | None, *, shipped: pathlib.Path | None = None) -> None:
        """Reads nothing yet.

        Args:
          folder: where traced programs are kept; None to keep none.
          shipped: where those that came with the installation are; None for `SHIPPED`.
        """
        self.folder = folder
        self._shipped = SHIPPED if shipped is None else shipped
        self._compiled: dict[tuple[Any, ...], list[_Compiled]] = {}
        self._lock = threading.Lock()

    @property
    def num_compiled(self) -> int:
        """Programs that were compiled, or loaded from the cache, in this process."""
        return len(self._compiled)

    def __call__(self, cloud: PointCloud, settings: PackedConfig, key: jax.Array, /) -> Detections | None:
        """The bits of `detect`, or None where JAX has to trace it: for tracers, or other operands."""
        operands = cloud.xyz1, cloud.intensity, cloud.num_points, settings.thresholds, _key_data(key)
        device = _common_device(operands)
        if device is None or jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
            return None
        # The halves are those of one reading.
        if _num_readings(settings.structure) > 1:
            return None
        num_rows = cloud.intensity.size
        if [operand.shape for operand in operands[:3]] != [(num_rows, 4), (num_rows,), ()]:
            return None
        key_of_build = settings.structure, cloud.capacity, settings.accelerator, device, _options()
        compiled = self._compiled.get(key_of_build)
        if compiled is None:
            build = Build(*key_of_build[:3], _platform(device), key_of_build[4])
            if [(x.shape, x.dtype) for x in operands] != [(x.shape, x.dtype) for x in build.operands()]:
                return None
            with self._lock:  # another thread may have compiled it meanwhile
                compiled = self._compiled.get(key_of_build) or self._compile(build, device)
                self._compiled[key_of_build] = compiled
        segment, decide = compiled
        return jax.tree.unflatten(_structure_of_answer(), decide(*operands, *segment(*operands)))

    def _compile(self, build: Build, device: Any) -> list[_Compiled]:
        where = jax.sharding.SingleDeviceSharding(device)
        with _without_garbage_collection(), futures.ThreadPoolExecutor(len(Half)) as threads:
            compiled = []
            for half in Half:
                exported = self._load(build, half) or self._trace(build, half)
                operands = [
                    jax.ShapeDtypeStruct(aval.shape, aval.dtype, sharding=where) for aval in exported.in_avals
                ]
                # Not by the thread, which the tracing of the next half would keep from Python's lock.
                lowered = jax.jit(exported.call).lower(*operands)
                compiled.append(threads.submit(lowered.compile))
            return [future.result() for future in compiled]

    def _load(self, build: Build, half: Half) -> jax.export.Exported | None:
        folders = [folder for folder in (self._shipped, self.folder) if folder is not None]
        paths = [folder / build.file_name(half) for folder in folders]
        found = (read_program(path, build.made_of(half)) for path in paths)
        return next((exported for exported in found if exported is not None), None)

    def _trace(self, build: Build, half: Half) -> jax.export.Exported:
        exported = trace(build, half)
        if self.folder is not None:
            # A folder that cannot be written costs time, not the answer.
            with contextlib.suppress(OSError):
                write_program(self.folder / build.file_name(half), exported, build.made_of(half))
        return exported


def build_for(structure: Any, capacity: int, platform: str) -> Build:
    """What a process that computes on a platform asks for.

    Args:
      structure: tree of a `DetectorConfig`.
      capacity: N, points that every sweep is padded to.
      platform: "cpu", "cuda", "rocm" or "tpu", which need not be there.

    Returns:
      With JAX's options as they are here.
    """
    return Build(structure, capacity, platform != "cpu", platform, _options())


def trace(build: Build, half: Half) -> jax.export.Exported:
    """Traces one half of `detect`.

    Args:
      build: what decides how.
      half: which.

    Returns:
      A function of `Build.operands`, for the second half followed by the first one's results. It returns
      a list of arrays.
    """

    def inputs(
        xyz1: jax.Array, intensity: jax.Array, num_points: jax.Array, thresholds: jax.Array, key: jax.Array
    ) -> tuple[PointCloud, PackedConfig, jax.Array]:
        settings = PackedConfig(thresholds, build.structure, build.accelerator)
        return PointCloud(xyz1, intensity, num_points), settings, jax.random.wrap_key_data(key, impl=KEY_IMPL)

    def segment(*operands: jax.Array) -> detector.Segments:
        return compiled.segment_packed(*inputs(*operands))

    operands = build.operands()
    export = functools.partial(jax.export.export, platforms=[build.platform])
    with building_for(accelerator=build.accelerator), _without_locations():
        if half is Half.SEGMENT:
            return export(jax.jit(lambda *operands: jax.tree.leaves(segment(*operands))))(*operands)
        found, structure = jax.tree.flatten(jax.eval_shape(segment, *operands))

        def decide(*values: jax.Array) -> list[jax.Array]:
            cloud, settings, _ = inputs(*values[: len(operands)])
            segments = jax.tree.unflatten(structure, values[len(operands) :])
            return jax.tree.leaves(compiled.decide_packed(cloud, segments, settings))

        return export(jax.jit(decide))(*operands, *found)


@contextlib.contextmanager
def _without_locations() -> Iterator[None]:
    """Leaves out which lines of which files a program came from: the same program is then the same bytes."""
    before = {name: jax.config.values[name] for name in _NO_LOCATIONS}
    try:
        for name, value in _NO_LOCATIONS.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


@functools.cache
def source_digest() -> str:
    """Of all modules of jaxbox: a change in any may be a change of the program."""
    root = pathlib.Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root).as_posix()}\0".encode() + path.read_bytes())
    return digest.hexdigest()


@functools.lru_cache(maxsize=64)
def _num_readings(structure: Any) -> int:
    """How often a sweep is read by a configuration of this structure."""
    return jax.tree.unflatten(structure, range(structure.num_leaves)).vehicles.num_readings


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _options() -> tuple[str, ...]:
    return tuple(str(getattr(jax.config, name)) for name in TRACED_WITH)


def _key_data(key: Any) -> Any:
    """The words of JAX's own kind of key; None for another kind, or a batch."""
    is_key = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    if not is_key or isinstance(key, jax.core.Tracer) or key.shape:
        return None
    return jax.random.key_data(key) if str(jax.random.key_impl(key)) == KEY_IMPL else None


def _common_device(operands: Sequence[Any]) -> Any:
    """Where JAX computes with these arrays; None where one is traced or no array, or they disagree."""
    committed = set()
    for operand in operands:
        is_array = isinstance(operand, jax.Array | np.ndarray | np.generic)
        if not is_array or isinstance(operand, jax.core.Tracer):
            return None
        if isinstance(operand, jax.Array) and operand.committed:
            committed |= operand.devices()
    if len(committed) > 1:
        return None
    return committed.pop() if committed else default_device()


def _platform(device: Any) -> str:
    """What JAX calls the device's platform where it lowers a program for it."""
    if device.platform != "gpu":
        return device.platform
    return "rocm" if "rocm" in device.client.platform_version.lower() else "cuda"


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


@functools.cache
def _structure_of_answer() -> Any:
    return jax.tree.structure(_example(Detections))


def _example(cls: type) -> Any:
    """An instance with zeros for its arrays, which tells the structure of an answer without tracing one."""
    kinds = typing.get_type_hints(cls)
    values = {
        field.name: _example(kinds[field.name]) if dataclasses.is_dataclass(kinds[field.name]) else 0
        for field in dataclasses.fields(cls)
    }
    return cls(**values)
