"""Settings as Python hands them over: numbers outside their range, and fields that contradict each other."""

import functools
from typing import Any

import jax
import jax.core

from jaxbox.config.fields import check_static, traced_fields, traced_ranges
from jaxbox.config.presets import DetectorConfig
from jaxbox.config.ranges import LARGEST_WHOLE, ConfigError, Range, checked_number
from jaxbox.config.schema import GROUND_CANDIDATE_CELL_M
from jaxbox.config.tracking import TrackConfig


def check_config(config: DetectorConfig) -> None:
    """Rejects invalid settings.

    Args:
      config: of the detector. Thresholds that are being traced have no values yet, and are not looked at.

    Raises:
      ConfigError: naming the fields and what to do.
    """
    check_ranges(config)
    if config.completion.mode != "evidence":
        return
    if not config.evidence.enabled:
        raise ConfigError(
            'completion.mode is "evidence" but evidence.enabled is False; '
            'enable the evidence, or set completion.mode to "away" or "none".'
        )
    if config.box.criterion not in ("closeness", "visible_closeness"):
        raise ConfigError(
            f'completion.mode "evidence" weighs closeness, but box.criterion is {config.box.criterion!r}; '
            'choose a closeness criterion, or set completion.mode to "away" or "none".'
        )


def check_ranges(config: DetectorConfig | TrackConfig) -> None:
    """Refuses numbers outside the range of their setting, see `jaxbox.config.ranges`.

    Args:
      config: of the detector or the tracker, as for `check_config`.

    Raises:
      ConfigError: naming the setting and what it takes.
    """
    values, structure = jax.tree.flatten(config)
    for (name, allowed), value in zip(_thresholds(structure), values, strict=True):
        # Most are such floats: this is part of every call of `detect`.
        if type(value) is float and allowed.minimum <= value <= allowed.maximum:
            continue
        if not isinstance(value, jax.core.Tracer):
            checked_number(name, jax.device_get(value), allowed)


@functools.lru_cache(maxsize=64)
def _thresholds(structure: Any) -> list[tuple[str, Range]]:
    """Name and range of each leaf of a configuration whose static fields are sound."""
    config = jax.tree.unflatten(structure, [0.0] * structure.num_leaves)
    check_static(config)
    if isinstance(config, DetectorConfig):
        _check_grids(config)
    ranges = traced_ranges(config)
    for name, value in traced_fields(config).items():
        # JAX does not count None as a leaf.
        if value is None:
            checked_number(name, value, ranges[name])
    return list(ranges.items())


def _check_grids(config: DetectorConfig) -> None:
    """Refuses grids with more cells than an int32 numbers."""
    region, points, ground = config.region, config.filtering, config.ground
    grids = {
        "filtering.cell_m": (region.half_x_m, region.half_y_m, points.cell_m, points.num_levels),
        "ground.surface_cell_m": (ground.surface_half_m, ground.surface_half_m, ground.surface_cell_m, 1),
        "ground.candidate_half_x_m": (
            ground.candidate_half_x_m, ground.candidate_half_y_m, GROUND_CANDIDATE_CELL_M, 1
        ),
    }  # fmt: skip
    for index, grid in enumerate(config.clustering.maps):
        size = (region.half_x_m, region.half_y_m, grid.cell_m, grid.num_levels)
        grids[f"clustering.maps.{index}.cell_m"] = size
    for name, (half_x_m, half_y_m, cell_m, num_levels) in grids.items():
        num_cells = (2 * half_x_m / cell_m) * (2 * half_y_m / cell_m) * num_levels
        if num_cells > LARGEST_WHOLE:
            raise ConfigError(
                f"{name}: cells of {cell_m:g} m over {2 * half_x_m:g} x {2 * half_y_m:g} m, in {num_levels} "
                f"levels, are {num_cells:.2g}; at most {LARGEST_WHOLE} are possible. Take larger cells or a "
                "smaller region."
            )
