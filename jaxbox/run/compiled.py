"""jaxbox.detect: the pipeline compiled, and how it behaves under `jax.vmap`, `jax.grad` and over devices."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Protocol

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxbox import detector
from jaxbox.config import DetectorConfig
from jaxbox.config.checks import check_config
from jaxbox.detector import Segments, find_vehicles
from jaxbox.run.arguments import as_cloud, as_config, as_key
from jaxbox.types import Detections, PointCloud
from jaxbox.xla import chunks
from jaxbox.xla.backend import batch_together, building_for, default_device, is_on_device, on_accelerator
from jaxbox.xla.barriers import single_kernel


def detect(
    cloud: PointCloud | ArrayLike,
    config: DetectorConfig | str | None = None,
    key: jax.Array | int | None = None,
) -> Detections:
    """Finds the vehicles of one sweep.

    At the prompt: ``jaxbox.detect(xyz)``, ``jaxbox.detect(xyz, "fast")``. An array is padded to a usual
    capacity, and its answer is that of the cloud, on the host and without padding.

    One jitted function of fixed shape: it compiles once for each capacity and set of static fields, and
    never again when sweeps change length or thresholds move. `jax.vmap` it over a batch of clouds, of
    configurations or of keys: on a CPU the batch gives the singles' answers bit for bit; on an accelerator
    it is many times as fast, rounded otherwise, and takes memory for all of them, which
    ``jax.lax.map(jaxbox.detect, clouds, batch_size=64)`` bounds. `detect_batch` spreads a list of clouds
    over devices.

    Args:
      cloud: one sweep, see `PointCloud.from_numpy`; or an array (n, 3 or more) of x, y, z in m, sensor frame,
        and where there are more columns the intensity.
      config: the configuration, or the name of a preset: "default", "accurate", "fast" or "paper"; None
        for the default.
      key: JAX random key for RANSAC, or an integer, its seed; None for 0. On a CPU the same key gives the
        same bits.

    Returns:
      The detections, best score first. Whatever was dropped is in `status` and `counts`.

    Raises:
      ValueError: for fields that contradict each other, a name that no preset has, several keys, or arrays of
        other shapes than `PointCloud` says.
      TypeError: for anything but a cloud or array, a configuration or preset, and a key or seed.

    Status bits: all of `Status`; `Detections.raise_if_failed` turns those of full capacities into an error.

    Reference: paper, section 3; oracle `jaxbox.reference.detect`.
    """
    if not isinstance(cloud, PointCloud):
        return detect(as_cloud(cloud, called="jaxbox.detect"), config, key)[:]
    operands = _operands(cloud, config, key)
    detections = None if _programs is None else _programs(*operands)
    return _detect_jit(*operands) if detections is None else detections


class Programs(Protocol):
    """What `detect` asks first, where the cache is on: `jaxbox.run.programs.KeptPrograms`."""

    @property
    def num_compiled(self) -> int:
        """Programs that were compiled, or loaded from the cache, in this process."""
        ...

    def __call__(self, cloud: PointCloud, packed: "PackedConfig", key: jax.Array, /) -> Detections | None:
        """The bits of `detect`, or None for what it has no program for, such as operands being traced."""
        ...


_programs: Programs | None = None


def use_programs(programs: Programs | None) -> None:
    """Has `detect` ask for a program that needs no tracing before it traces one.

    Args:
      programs: who is asked; None for nobody.
    """
    global _programs  # noqa: PLW0603 - one a process, as JAX's cache is
    _programs = programs


def kept_programs() -> Programs | None:
    """Who `detect` asks for a program that needs no tracing."""
    return _programs


def lower(
    cloud: PointCloud,
    config: DetectorConfig | str | None = None,
    key: jax.Array | int | None = None,
    *,
    platform: str | None = None,
) -> jax.stages.Lowered:
    """The program of `detect` before it is compiled, for its text, its cost and its memory.

    Args:
      cloud: any of the capacity.
      config: as `detect` takes it.
      key: as `detect` takes it.
      platform: "cpu", "cuda", "rocm" or "tpu", which need not be there; None for what JAX computes on.

    Returns:
      What `jax.jit(...).lower` gives.
    """
    # To pyright what `jax.jit` returns is a function without these methods.
    if platform is None:
        return _detect_jit.trace(*_operands(cloud, config, key)).lower()  # pyright: ignore[reportFunctionMemberAccess, reportAttributeAccessIssue]
    with building_for(accelerator=platform != "cpu"):
        operands = _operands(cloud, config, key)
    return _detect_jit.trace(*operands).lower(lowering_platforms=(platform,))  # pyright: ignore[reportFunctionMemberAccess, reportAttributeAccessIssue]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PackedConfig:
    """A configuration whose thresholds are one array: to hand over a hundred takes JAX a millisecond."""

    thresholds: jax.Array | np.ndarray
    """(T,) float32."""
    structure: Any = dataclasses.field(metadata={"static": True})
    """Tree of the `DetectorConfig`, with its static fields."""
    accelerator: bool = dataclasses.field(metadata={"static": True})
    """What the program is built for."""

    @classmethod
    def pack(cls, config: DetectorConfig, *, accelerator: bool) -> "PackedConfig":
        """Packs a configuration, with what the program is built for."""
        values, structure = jax.tree.flatten(config)
        traced = {i: jnp.float32(v) for i, v in enumerate(values) if isinstance(v, jax.Array)}
        known = np.array([0 if i in traced else v for i, v in enumerate(values)], np.float32)
        if traced:
            known = jnp.asarray(known).at[np.array(list(traced))].set(jnp.stack(list(traced.values())))
        return cls(known, structure, accelerator)

    def unpack(self) -> DetectorConfig:
        """The configuration, with traced thresholds."""
        # Cut up together, or each threshold that a loop reads would be a kernel of its own.
        values = jnp.asarray(self.thresholds)

        def cut_up(numbers: range) -> list[jax.Array]:
            return [jax.lax.squeeze(values[i : i + 1], (0,)) for i in numbers]

        every = range(values.size)
        parts = (
            every[first : first + chunks.SINGLE_KERNEL_NUMBERS]
            for first in every[:: chunks.SINGLE_KERNEL_NUMBERS]
        )
        thresholds = [value for part in parts for value in single_kernel(functools.partial(cut_up, part))]
        return jax.tree.unflatten(self.structure, thresholds)


def _operands(
    cloud: PointCloud, config: DetectorConfig | str | None, key: jax.Array | int | None
) -> tuple[PointCloud, PackedConfig, jax.Array]:
    config = as_config(config)
    check_config(config)
    if isinstance(cloud.num_points, np.ndarray | np.generic | int) and np.any(cloud.num_points < 0):
        raise ValueError(
            f"jaxbox.detect was given a cloud with num_points={cloud.num_points}; it is the number of points "
            "in the sweep, 0 or above. PointCloud.from_numpy counts them."
        )
    packed = PackedConfig.pack(config, accelerator=on_accelerator(cloud.xyz1))
    known, device = packed.thresholds, default_device()
    if isinstance(known, np.ndarray) and is_on_device(cloud.xyz1) and device in cloud.xyz1.devices():
        # Nothing is sent in a call whose arrays are all there, see `jax.transfer_guard`.
        packed = dataclasses.replace(packed, thresholds=_on_device(known.tobytes(), device))
    return cloud, packed, as_key(key)


@functools.lru_cache(maxsize=64)
def _on_device(thresholds: bytes, _device: Any) -> jax.Array:
    """Thresholds (T,) float32 on the default device, sent once."""
    with jax.ensure_compile_time_eval():
        return jax.device_put(np.frombuffer(thresholds, np.float32))


def count_compilations() -> int:
    """How often `detect` has been compiled, or loaded from the cache, in this process."""
    num_jitted: int = _detect_jit._cache_size()  # pyright: ignore[reportFunctionMemberAccess, reportAttributeAccessIssue]
    return num_jitted + (0 if _programs is None else _programs.num_compiled)


def _checked(cloud: PointCloud) -> PointCloud:
    """The cloud in its documented types, which with ``jax_enable_x64`` a caller's arrays may not have.

    Raises:
      ValueError: where its arrays have other shapes than `PointCloud` says. That is looked at where a program
        is traced, and so once for each shape.
    """
    cloud = PointCloud(
        xyz1=jnp.asarray(cloud.xyz1, jnp.float32),
        intensity=jnp.asarray(cloud.intensity, jnp.float32),
        num_points=jnp.asarray(cloud.num_points, jnp.int32),
    )
    try:
        chex.assert_shape(cloud.xyz1, (None, 4))
        chex.assert_shape([cloud.intensity, cloud.num_points], [cloud.xyz1.shape[:1], ()])
    except AssertionError as error:
        names = (field.name for field in dataclasses.fields(cloud))
        shapes = ", ".join(f"{name} {getattr(cloud, name).shape}" for name in names)
        raise ValueError(
            f"jaxbox.detect was given a cloud of shapes {shapes}; they must be xyz1 (N, 4), intensity (N,) "
            "and num_points (). PointCloud.from_numpy makes a cloud of points (n, 3); a batch of clouds goes "
            "through jax.vmap(jaxbox.detect)."
        ) from error
    return cloud


def _find_vehicles(cloud: PointCloud, packed: PackedConfig, key: jax.Array) -> Detections:
    with building_for(accelerator=packed.accelerator):
        return find_vehicles(_checked(cloud), packed.unpack(), key)


_one_after_the_other = jax.custom_batching.sequential_vmap(_find_vehicles)

_find = jax.custom_batching.custom_vmap(_find_vehicles)


@jax.custom_jvp
def _find_only(cloud: PointCloud, packed: PackedConfig, key: jax.Array) -> Detections:
    return _find(cloud, packed, key)


@_find_only.defjvp
def _refuse_to_differentiate(_primals: Any, _tangents: Any) -> Any:
    raise TypeError(
        "jaxbox.detect is not differentiable, since it counts, compares and sorts points: differentiate "
        "what follows it, with jax.lax.stop_gradient round what goes in."
    )


_detect_jit = jax.jit(_find_only)


@jax.jit
def segment_packed(cloud: PointCloud, packed: PackedConfig, key: jax.Array) -> Segments:
    """The first half of `detect`, of a configuration that was checked and packed.

    Where a sweep is read once, ``decide_packed(cloud, segment_packed(cloud, packed, key), packed)`` is
    `detect`, bit for bit, and takes a twentieth longer. But each half can be compiled while the other is
    traced.

    Args:
      cloud: as `detect` takes it.
      packed: the configuration.
      key: as `detect` takes it.

    Returns:
      What `decide_packed` reads.
    """
    with building_for(accelerator=packed.accelerator):
        return detector.segment(_checked(cloud), packed.unpack(), key)


@jax.jit
def decide_packed(cloud: PointCloud, segments: Segments, packed: PackedConfig) -> Detections:
    """The second half of `detect`, see `segment_packed`.

    Args:
      cloud: that `segments` are of.
      segments: from the first half, with the same configuration.
      packed: the configuration.

    Returns:
      The detections, as `detect` gives them.
    """
    with building_for(accelerator=packed.accelerator):
        return detector.decide(_checked(cloud), segments, packed.unpack())


@_find.def_vmap
def _find_many(
    _size: int, batched: Any, cloud: PointCloud, packed: PackedConfig, key: jax.Array
) -> tuple[Detections, Any]:
    """A batch: on a CPU its sweeps one after the other, on an accelerator all of them step by step.

    On a CPU batched scatters, and loops that end with the largest sweep of the batch, cost more than they
    save. Each stage is outlined, see `jaxbox.xla.barriers`, so that the compiler makes the same code of it in
    the loop and without, and the batch has the singles' bits. The kernels of one sweep do not fill an
    accelerator, and to launch them takes longer than to run them.
    """
    axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)
    with building_for(accelerator=packed.accelerator):
        find = _find_vehicles if batch_together() else _one_after_the_other
        find_all = _on_each_device(jax.vmap(find, axes), batched, cloud, packed, key)
        found = find_all(cloud, packed, key)
    return found, jax.tree.map(lambda _: True, found)


def _on_each_device(find_all: Callable[..., Detections], batched: Any, *operands: Any) -> Any:
    """Lets each device find the vehicles of its own sweeps, where a batch is spread over a mesh.

    Only the axes of a mesh whose type is `Explicit` are known while a program is traced.
    """
    leaves = zip(jax.tree.leaves(operands), jax.tree.leaves(batched), strict=True)
    # `jax.vmap` has seen to it that all which is batched is spread alike.
    sharding = next(jax.typeof(leaf).sharding for leaf, is_batched in leaves if is_batched)
    if not sharding.spec or sharding.spec[0] is None:
        return find_all
    whole, rows = jax.sharding.PartitionSpec(), jax.sharding.PartitionSpec(sharding.spec[0])
    specs = jax.tree.map(lambda is_batched: rows if is_batched else whole, batched)
    # What varies over the mesh is not checked: the loops start from constants, which do not.
    return jax.shard_map(find_all, mesh=sharding.mesh, in_specs=tuple(specs), out_specs=rows, check_vma=False)
