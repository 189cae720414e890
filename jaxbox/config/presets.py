"""`DetectorConfig`, the configuration of all stages, and its presets."""

import dataclasses
import math
from collections.abc import Sequence

from jaxbox.config.schema import (
    BoxConfig,
    ClusteringConfig,
    CompletionConfig,
    ComponentMap,
    EvidenceConfig,
    FilterConfig,
    GroundConfig,
    HealthConfig,
    HullConfig,
    RegionConfig,
    VehicleConfig,
    config_class,
)
from jaxbox.config.sensors import sensor_changes

CAPACITY_STEP = 1024
"""Proposed capacities are multiples of this, so that proposals from similar sweeps share one compile."""


@config_class
class DetectorConfig:
    """All configuration of `jaxbox.detect`: a sub-config a stage.

    >>> DetectorConfig.paper().box.criterion
    'area'
    """

    region: RegionConfig = RegionConfig()
    filtering: FilterConfig = FilterConfig()
    ground: GroundConfig = GroundConfig()
    clustering: ClusteringConfig = ClusteringConfig()
    evidence: EvidenceConfig = EvidenceConfig()
    hull: HullConfig = HullConfig()
    box: BoxConfig = BoxConfig()
    completion: CompletionConfig = CompletionConfig()
    vehicles: VehicleConfig = VehicleConfig()
    health: HealthConfig = HealthConfig()

    @classmethod
    def paper(cls) -> "DetectorConfig":
        """The paper's own choices: one plane, fixed tolerance, smallest area, no completion."""
        return cls(
            ground=GroundConfig(candidates="points", surface=False, tolerance_m=0.2),
            clustering=ClusteringConfig(
                maps=(ComponentMap(cell_m=0.35, num_levels=13, max_cells=14336, max_height_m=4.5),),
                adaptive_growth=0.0,
            ),
            evidence=EvidenceConfig(enabled=False),
            box=BoxConfig(criterion="area", fit_to="hull", scene_direction=False),
            completion=CompletionConfig(mode="none"),
            vehicles=VehicleConfig(neighbourhood=False, row_extent=1.0, far_score_power=0.0),
        )

    @classmethod
    def accurate(cls) -> "DetectorConfig":
        """The sweep is read twice: more of the boxes are right and fewer false, in twice the time."""
        base = cls()
        return dataclasses.replace(base, vehicles=dataclasses.replace(base.vehicles, num_readings=2))

    @classmethod
    def fast(cls) -> "DetectorConfig":
        """Two maps instead of three: faster, a little less accurate."""
        base = cls()
        maps = ComponentMap(cell_m=0.13, max_cells=9216), base.clustering.maps[2]
        return dataclasses.replace(base, clustering=dataclasses.replace(base.clustering, maps=maps))

    @classmethod
    def presets(cls, *, num_beams: int = 64) -> dict[str, "DetectorConfig"]:
        """The named presets that the command line offers, for a sensor of that many beams."""
        presets = {"default": cls(), "accurate": cls.accurate(), "fast": cls.fast(), "paper": cls.paper()}
        return {name: cls.for_sensor(num_beams, base=preset) for name, preset in presets.items()}

    @classmethod
    def for_sensor(cls, num_beams: int, *, base: "DetectorConfig | None" = None) -> "DetectorConfig":
        """A preset for a sensor of fewer or more beams than the 64 that it was chosen on.

        Which settings depend on the beams, and how their values were measured, is in
        `jaxbox.config.sensors`. They replace those of the base; all others, and with 64 beams all, stay.

        Args:
          num_beams: 16, 32, 64 or 128; `jaxbox info FILE` says which of them sees like another sensor.
          base: where all else comes from; None for the default preset.

        Returns:
          The settings. The maps' max_cells are static and differ, so each sensor is a compile.

        Raises:
          ValueError: for another number of beams.

        >>> DetectorConfig.for_sensor(64) == DetectorConfig()
        True
        """
        base = cls() if base is None else base
        sensor = sensor_changes(num_beams)
        stages = {
            stage: dataclasses.replace(getattr(base, stage), **values)
            for stage, values in sensor.changes.items()
        }
        config = dataclasses.replace(base, **stages)
        cells = [rounded_up(sensor.cells * m.max_cells) for m in config.clustering.maps]
        return config if sensor.cells == 1 else with_max_cells(config, cells)


def rounded_up(size: float) -> int:
    """Rounds up to a multiple of `CAPACITY_STEP`."""
    return CAPACITY_STEP * math.ceil(size / CAPACITY_STEP)


def with_max_cells(config: DetectorConfig, cells: Sequence[int]) -> DetectorConfig:
    """The maps with other capacities for their occupied cells."""
    maps = zip(config.clustering.maps, cells, strict=True)
    maps = tuple(dataclasses.replace(m, max_cells=size) for m, size in maps)
    return dataclasses.replace(config, clustering=dataclasses.replace(config.clustering, maps=maps))
