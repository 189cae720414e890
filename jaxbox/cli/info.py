"""``jaxbox info``: versions, devices and presets."""

import dataclasses
import json

import jax
from rich.console import Console
from rich.table import Table

from jaxbox._padding import CAPACITY_BUCKETS
from jaxbox.config import DetectorConfig
from jaxbox.run.cache import CACHE_VARIABLE, CacheFolders
from jaxbox.run.shipping import shipped_state
from jaxbox.run.versions import versions


def print_info(console: Console, *, as_json: bool = False) -> None:
    """Prints versions, devices, the cache folder, the capacities and what the presets choose.

    Args:
      console: where it goes.
      as_json: whether JSON is printed.
    """
    devices, presets = [str(device) for device in jax.devices()], DetectorConfig.presets()
    if as_json:
        found = {
            "versions": versions(formats=True),
            "devices": devices,
            "presets": list(presets),
            "shipped_programs": dataclasses.asdict(shipped_state()),
        }
        console.out(json.dumps(found), highlight=False)
        return
    table = Table("package", "version", title="versions")
    for package, version in versions(formats=True).items():
        table.add_row(package, version)
    console.print(table)
    console.print(f"devices: {', '.join(devices)}")
    kept = CacheFolders.of_this_process()
    console.print(f"compiled programs: {kept.compiled or 'not kept'} (set {CACHE_VARIABLE} to change)")
    console.print(f"traced programs: {kept.programs or 'not kept'}; shipped with jaxbox: {shipped_state()}")
    console.print(f"point capacities: {', '.join(str(bucket) for bucket in CAPACITY_BUCKETS)}")
    table = Table("preset", "ground", "maps", "rectangle", "completion", title="presets")
    for name, config in presets.items():
        table.add_row(name, *_describe_preset(config))
    console.print(table)


def _describe_preset(config: DetectorConfig) -> list[str]:
    ground = f"{config.ground.candidates}{' and grid' if config.ground.surface else ''}"
    maps = ", ".join(f"{component_map.cell_m:g} m" for component_map in config.clustering.maps)
    return [ground, maps, config.box.criterion, config.completion.mode]
