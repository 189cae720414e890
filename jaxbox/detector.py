"""detect(): from a sweep to vehicle boxes, as one compiled function. Wiring only."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox import steps
from jaxbox.config import DetectorConfig
from jaxbox.stages.evidence import Evidence
from jaxbox.steps.boxes import Fits
from jaxbox.steps.points import Heights, Obstacles, Sweep
from jaxbox.steps.proposals import Proposals
from jaxbox.types import Detections, PointCloud
from jaxbox.xla.backend import batch_together, building_for, default_device, is_on_device, on_accelerator
from jaxbox.xla.loops import AT_ONCE, apart, at_once


class Segments(NamedTuple):
    """What the first half of `detect` finds, and the second reads."""

    sweep: Sweep
    heights: Heights
    obstacles: Obstacles
    proposals: Proposals
    fits: Fits
    seen: Evidence | None


def detect(
    cloud: PointCloud, config: DetectorConfig | None = None, key: jax.Array | None = None
) -> Detections:
    """Finds the vehicles of one sweep.

    One jitted function of fixed shape: it compiles once for each capacity and set of static settings, and
    never again when sweeps change length or thresholds move. `jax.vmap` it over a batch of clouds, of
    configurations or of keys: on a CPU the batch gives the singles' answers bit for bit; on an accelerator
    it is many times as fast, rounded otherwise, and takes memory for all of them, which
    ``jax.lax.map(jaxbox.detect, clouds, batch_size=64)`` bounds. `detect_batch` spreads a list of clouds
    over devices.

    Args:
      cloud: one sweep, see `PointCloud.from_numpy`.
      config: the settings; None for the default preset.
      key: JAX random key for RANSAC; None for `jax.random.key(0)`. On a CPU the same key gives the same bits.

    Returns:
      The detections, best score first. Whatever was dropped is in `status` and `counts`.

    Raises:
      ValueError: for settings that contradict each other.

    Status bits: all of `Status`; `Detections.raise_if_failed` turns those of full capacities into an error.

    Reference: paper, section 3; oracle `jaxbox.reference.detect`.
    """
    operands = _operands(cloud, config, key)
    detections = None if _programs is None else _programs(*operands)
    return _detect_jit(*operands) if detections is None else detections


class Programs(Protocol):
    """What `detect` asks first, where the cache is on: `jaxbox.run.programs.KeptPrograms`."""

    @property
    def num_compiled(self) -> int:
        """Programs that were compiled, or loaded from the cache, in this process."""
        ...

    def __call__(self, cloud: PointCloud, settings: "PackedSettings", key: jax.Array, /) -> Detections | None:
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


def segment(
    cloud: PointCloud, config: DetectorConfig | None = None, key: jax.Array | None = None
) -> Segments:
    """The first half of `detect`, from the points to rectangles, as a compiled function of its own.

    ``decide(cloud, segment(cloud, config, key), config)`` is ``detect(cloud, config, key)``, bit for bit, and
    takes a twentieth longer. But each half can be compiled while the other is traced.

    Args:
      cloud: as `detect` takes it.
      config: as `detect` takes it.
      key: as `detect` takes it.

    Returns:
      What `decide` reads.

    Raises:
      ValueError: for settings that contradict each other.
    """
    return segment_packed(*_operands(cloud, config, key))


def decide(cloud: PointCloud, segments: Segments, config: DetectorConfig | None = None) -> Detections:
    """The second half of `detect`: completed boxes, their scores, and which of them are vehicles.

    Args:
      cloud: that `segments` are of.
      segments: from `segment`, with the same settings.
      config: as `detect` takes it.

    Returns:
      The detections, as `detect` gives them.

    Raises:
      ValueError: for settings that contradict each other.
    """
    cloud, settings, _ = _operands(cloud, config, None)
    return decide_packed(cloud, segments, settings)


def lower(
    cloud: PointCloud,
    config: DetectorConfig | None = None,
    key: jax.Array | None = None,
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
    if platform is None:
        return _detect_jit.trace(*_operands(cloud, config, key)).lower()  # pyright: ignore[reportFunctionMemberAccess, reportAttributeAccessIssue]
    with building_for(accelerator=platform != "cpu"):
        operands = _operands(cloud, config, key)
    return _detect_jit.trace(*operands).lower(lowering_platforms=(platform,))  # pyright: ignore[reportFunctionMemberAccess, reportAttributeAccessIssue]


def _operands(
    cloud: PointCloud, config: DetectorConfig | None, key: jax.Array | None
) -> tuple[PointCloud, "PackedSettings", jax.Array]:
    config = DetectorConfig() if config is None else config
    steps.check_settings(config)
    settings = PackedSettings.pack(config, accelerator=on_accelerator(cloud.xyz1))
    known, device = settings.thresholds, default_device()
    if isinstance(known, np.ndarray) and is_on_device(cloud.xyz1) and device in cloud.xyz1.devices():
        # Nothing is sent in a call whose arrays are all there, see `jax.transfer_guard`.
        settings = dataclasses.replace(settings, thresholds=_on_device(known.tobytes(), device))
    return cloud, settings, _default_key() if key is None else key


@functools.lru_cache(maxsize=64)
def _on_device(thresholds: bytes, _device: Any) -> jax.Array:
    """Thresholds (T,) float32 on the default device, sent once."""
    with jax.ensure_compile_time_eval():
        return jax.device_put(np.frombuffer(thresholds, np.float32))


@functools.cache
def _default_key() -> jax.Array:
    with jax.ensure_compile_time_eval(), jax.transfer_guard("allow"):
        return jax.random.key(0)


def count_compilations() -> int:
    """How often `detect` has been compiled, or loaded from the cache, in this process."""
    num_jitted: int = _detect_jit._cache_size()  # pyright: ignore[reportFunctionMemberAccess, reportAttributeAccessIssue]
    return num_jitted + (0 if _programs is None else _programs.num_compiled)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PackedSettings:
    """A configuration whose thresholds are one array: to hand over a hundred takes JAX a millisecond."""

    thresholds: jax.Array | np.ndarray  # (T,) float32
    structure: Any = dataclasses.field(metadata={"static": True})
    accelerator: bool = dataclasses.field(metadata={"static": True})  # what the program is built for

    @classmethod
    def pack(cls, config: DetectorConfig, *, accelerator: bool) -> "PackedSettings":
        """Packs settings, with what the program is built for."""
        values, structure = jax.tree.flatten(config)
        traced = {i: jnp.float32(v) for i, v in enumerate(values) if isinstance(v, jax.Array)}
        known = np.array([0 if i in traced else v for i, v in enumerate(values)], np.float32)
        if traced:
            known = jnp.asarray(known).at[np.array(list(traced))].set(jnp.stack(list(traced.values())))
        return cls(known, structure, accelerator)

    def unpack(self) -> DetectorConfig:
        """The settings, with traced thresholds."""
        # Cut up together: each threshold that a loop reads would else be a kernel of its own.
        values = jnp.asarray(self.thresholds)

        def cut_up(numbers: range) -> list[jax.Array]:
            return [jax.lax.squeeze(values[i : i + 1], (0,)) for i in numbers]

        every = range(values.size)
        parts = (every[first : first + AT_ONCE] for first in every[::AT_ONCE])
        thresholds = [value for part in parts for value in at_once(functools.partial(cut_up, part))]
        return jax.tree.unflatten(self.structure, thresholds)


# What a step finds is stored, or the compiler would work it out again in each later step that reads it,
# and its scratch memory is freed: beyond 32 MB, glibc would return it to the system at each call, and
# a sixth of the time would go into getting it back page by page.


def _segment(cloud: PointCloud, config: DetectorConfig, key: jax.Array) -> Segments:
    # 3.1 Statistical filtering, and ground removal by RANSAC (Algorithm I).
    sweep = apart(steps.select_points, cloud, config)
    heights = apart(steps.remove_ground, sweep, config, key)
    obstacles = apart(steps.gather_obstacles, sweep, heights, config)
    # 3.2 Segmentation by 3D grid subdivision (Algorithm II): several maps, several proposals.
    proposals = apart(steps.propose_clusters, obstacles, config)
    # 3.3, 3.4 Convex hull and minimum rectangle over all rotations (Algorithm III).
    fits = apart(steps.fit_rectangles, obstacles, proposals, config)
    # What the beams saw, for the correction.
    seen = apart(steps.build_evidence, sweep, heights, config)
    return Segments(sweep, heights, obstacles, proposals, fits, seen)


def _decide(cloud: PointCloud, segments: Segments, config: DetectorConfig) -> Detections:
    sweep, heights, obstacles, proposals, fits, seen = segments
    # Correction for occluded objects: what the beams saw decides how each box goes on out of sight.
    trials, boxes, num_assignments = apart(steps.complete_boxes, fits, proposals, seen, config)
    # Vehicle decision: score, suppression, and (3.5) the descriptors of what is left.
    candidates = apart(steps.score_boxes, trials, boxes, proposals, obstacles, heights, seen, config)
    return apart(
        steps.conclude, cloud, sweep, heights, obstacles, proposals, fits, candidates, num_assignments, config
    )


def _in_32_bits(cloud: PointCloud) -> PointCloud:
    """The cloud in its documented types, which with ``jax_enable_x64`` a caller's arrays may not have."""
    return PointCloud(
        xyz1=jnp.asarray(cloud.xyz1, jnp.float32),
        intensity=jnp.asarray(cloud.intensity, jnp.float32),
        num_points=jnp.asarray(cloud.num_points, jnp.int32),
    )


def _find_vehicles(cloud: PointCloud, settings: PackedSettings, key: jax.Array) -> Detections:
    with building_for(accelerator=settings.accelerator):
        cloud, config = _in_32_bits(cloud), settings.unpack()
        return _decide(cloud, _segment(cloud, config, key), config)


_one_after_the_other = jax.custom_batching.sequential_vmap(_find_vehicles)
_find = jax.custom_batching.custom_vmap(_find_vehicles)


@jax.custom_jvp
def _find_only(cloud: PointCloud, settings: PackedSettings, key: jax.Array) -> Detections:
    return _find(cloud, settings, key)


@_find_only.defjvp
def _refuse_to_differentiate(_primals: Any, _tangents: Any) -> Any:
    raise TypeError(
        "jaxbox.detect is not differentiable, since it counts, compares and sorts points: differentiate "
        "what follows it, with jax.lax.stop_gradient round what goes in."
    )


_detect_jit = jax.jit(_find_only)


@jax.jit
def segment_packed(cloud: PointCloud, settings: PackedSettings, key: jax.Array) -> Segments:
    """`segment`, of settings that were checked and packed."""
    with building_for(accelerator=settings.accelerator):
        return _segment(_in_32_bits(cloud), settings.unpack(), key)


@jax.jit
def decide_packed(cloud: PointCloud, segments: Segments, settings: PackedSettings) -> Detections:
    """`decide`, of settings that were checked and packed."""
    with building_for(accelerator=settings.accelerator):
        return _decide(_in_32_bits(cloud), segments, settings.unpack())


@_find.def_vmap
def _find_many(
    _size: int, batched: Any, cloud: PointCloud, settings: PackedSettings, key: jax.Array
) -> tuple[Detections, Any]:
    """A batch: on a CPU its sweeps one after the other, on an accelerator all of them step by step.

    On a CPU batched scatters, and loops that end with the largest sweep of the batch, cost more than they
    save. Each step stands behind a wall, see `apart`, so that the compiler makes the same code of it in the
    loop and without, and the batch has the singles' bits. The kernels of one sweep do not fill an
    accelerator, and to launch them takes longer than to run them.
    """
    axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)
    with building_for(accelerator=settings.accelerator):
        find = _find_vehicles if batch_together() else _one_after_the_other
        find_all = _on_each_device(jax.vmap(find, axes), batched, cloud, settings, key)
        found = find_all(cloud, settings, key)
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
