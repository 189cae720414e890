"""Compiles the program of `jaxbox.detect` for an H100 that need not be there, and has XLA dump it."""

import importlib.util
import pathlib
import time
from typing import Any

import jax
import numpy as np
from jax.experimental import topologies
from jax.sharding import NamedSharding, PartitionSpec

from benchmarks import common
from jaxbox import DetectorConfig, PointCloud
from jaxbox.run import compiled
from jaxbox.xla.backend import building_for

WHEELS = ("jax-cuda12-pjrt", "jax-cuda12-plugin", "nvidia-cuda-nvcc-cu12")
"""Packages with the compiler: of 223 MB, without a driver or CUDA's libraries."""

TARGET = "NVIDIA H100 80GB HBM3"

TARGET_CONFIG = f"""
gpu_device_info {{
  threads_per_block_limit: 1024
  threads_per_warp: 32
  shared_memory_per_block: 49152
  shared_memory_per_core: 233472
  threads_per_core_limit: 2048
  core_count: 132
  fpus_per_core: 128
  block_dim_limit_x: 2147483647
  block_dim_limit_y: 65535
  block_dim_limit_z: 65535
  memory_bandwidth: 3352320000000
  l2_cache_size: 52428800
  clock_rate_ghz: 1.98
  device_memory_size: 84942979072
  shared_memory_per_block_optin: 232448
  cuda_compute_capability {{ major: 9 }}
  registers_per_core_limit: 65536
  registers_per_block_limit: 65536
}}
platform_name: "CUDA"
dnn_version_info {{ major: 9 minor: 10 }}
runtime_version {{ major: 12 minor: 9 patch: 0 }}
device_description_str: "{TARGET}"
"""
"""The H100's data for XLA, a `GpuTargetConfigProto`: XLA dumps it as gpu_target_config where there is one."""

PROGRAM = "counted_detect"
"""Name of the program in the dump."""

FRAMES = 20
"""Stack frames that JAX keeps for each instruction: enough to reach the step from within its helpers."""


def require_compiler() -> None:
    """Ends the program, naming the command that helps, where JAX lacks the compiler for GPUs."""
    versions = {name: common.installed_version(name) for name in WHEELS}
    fits = all(versions[name] == jax.__version__ for name in WHEELS[:2]) and versions[WHEELS[2]] is not None
    if not fits or importlib.util.find_spec("jax_plugins.xla_cuda12") is None:
        found = ", ".join(f"{name} {version or 'missing'}" for name, version in versions.items())
        raise SystemExit(
            f"Counting launches takes XLA's compiler for NVIDIA GPUs, of the version of jax ({found}): "
            + install_command(jax.__version__)
        )


def prepare() -> None:
    """Sets JAX up before it computes anything: on the CPU, with stacks, and without a cache of programs."""
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_traceback_in_locations_limit", FRAMES)
    jax.config.update("jax_enable_compilation_cache", False)


def install_command(version: str) -> str:
    """The command that installs the compiler next to a version of jax."""
    return "pip install " + " ".join([*(f"{name}=={version}" for name in WHEELS[:2]), WHEELS[2]])


def compile_for_gpu(
    config: DetectorConfig, folder: pathlib.Path, *, batch: int, capacity: int
) -> dict[str, float]:
    """Compiles the program and dumps it, see `xla_dump.read_program`.

    Args:
      config: the settings.
      folder: where XLA writes its dump.
      batch: sweeps of a `jax.vmap`; 0 for a single sweep.
      capacity: points of a sweep.

    Returns:
      Seconds of tracing and of compiling, and the scratch memory.
    """
    topology = topologies.get_topology_desc(platform="cuda", target_config=TARGET_CONFIG, topology="1x1x1")
    device = NamedSharding(topologies.make_mesh(topology, (1,), ("x",)), PartitionSpec())
    cloud = PointCloud.from_numpy(np.zeros((1, 3), np.float32), capacity=capacity)
    with building_for(accelerator=True):
        first, *others = compiled._operands(cloud, config, None)
    lead = (batch,) if batch else ()

    def described(array: Any, lead: tuple[int, ...]) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((*lead, *array.shape), array.dtype, sharding=device)

    def counted_detect(*operands: Any) -> Any:
        return compiled._find(*operands)

    function = jax.vmap(counted_detect, (0, None, None)) if batch else counted_detect
    operands = [
        jax.tree.map(lambda a: described(a, lead), first),
        *jax.tree.map(lambda a: described(a, ()), others),
    ]
    start = time.perf_counter()
    lowered = jax.jit(function, out_shardings=device).lower(*operands)
    traced = time.perf_counter()
    options = {"xla_dump_to": str(folder), "xla_dump_hlo_as_text": True}
    memory: Any = lowered.compile(compiler_options=options).memory_analysis()
    return {
        "tracing_s": traced - start,
        "compiling_s": time.perf_counter() - traced,
        "scratch_mb": memory.temp_size_in_bytes / 1e6,
    }
