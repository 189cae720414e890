"""``jaxbox info``: versions, devices and presets."""

import importlib.metadata
import platform

import jax
from rich.console import Console
from rich.table import Table

from jaxbox.cli.cache import CACHE_VARIABLE, enable_cache
from jaxbox.config import DetectorConfig
from jaxbox.padding import CAPACITY_BUCKETS
from jaxbox.version import __version__

PACKAGES = ("jax", "jaxlib", "numpy", "opencv-python-headless", "chex", "matplotlib", "scipy")


def print_info(console: Console) -> None:
    """Prints versions, devices, the cache folder, the capacities and what the presets choose."""
    versions = Table("package", "version", title="versions")
    versions.add_row("jaxbox", __version__)
    versions.add_row("python", platform.python_version())
    for package in PACKAGES:
        versions.add_row(package, _version(package))
    console.print(versions)
    console.print(f"devices: {', '.join(str(device) for device in jax.devices())}")
    console.print(f"compiled functions: {enable_cache() or 'not kept'} (set {CACHE_VARIABLE} to change)")
    console.print(f"point capacities: {', '.join(str(bucket) for bucket in CAPACITY_BUCKETS)}")
    presets = Table("preset", "ground", "maps", "rectangle", "completion", title="presets")
    for name, config in DetectorConfig.presets().items():
        presets.add_row(name, *_describe_preset(config))
    console.print(presets)


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _describe_preset(config: DetectorConfig) -> list[str]:
    ground = f"{config.ground.candidates}{' and grid' if config.ground.surface else ''}"
    maps = ", ".join(f"{component_map.cell_m:g} m" for component_map in config.clustering.maps)
    return [ground, maps, config.box.criterion, config.completion.mode]
