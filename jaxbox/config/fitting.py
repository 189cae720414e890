"""A rough look at sample sweeps in NumPy: how much each capacity of the detector has to hold."""

import dataclasses
from collections.abc import Iterable

import numpy as np

from jaxbox._padding import unmasked
from jaxbox.config.presets import DetectorConfig, rounded_up, with_max_cells
from jaxbox.config.schema import ClusteringConfig, ComponentMap, GroundConfig


def propose_capacities(
    sweeps: Iterable[np.ndarray], base: DetectorConfig | None = None, *, margin: float = 1.25
) -> DetectorConfig:
    """Proposes capacities for sweeps like these, from a rough look at each.

    The ground is taken to be the lowest point within a metre or two; the points above it, those that
    boxes are fitted to and the occupied cells of each map are counted. It is a proposal, not a bound:
    `Detections.raise_if_failed` checks each sweep's answer, and names the size that was missing.

    Args:
      sweeps: at least one (n, 3) array, m, sensor frame; NaN and infinity are ignored.
      base: where all else comes from; None for the default preset.
      margin: the largest count of any sweep times this is proposed, at least 1.

    Returns:
      `base` with other clustering.max_obstacles, box.max_slab_points and max_cells of each map:
      multiples of 1024, so that proposals from similar sweeps share one compile.

    Raises:
      ValueError: for no sweeps, an array of another shape, or a margin below 1.

    >>> propose_capacities([np.zeros((100, 3))]).box.max_slab_points
    1024
    """
    base = DetectorConfig() if base is None else base
    if not margin >= 1:
        raise ValueError(f"margin is {margin}; it must be at least 1.")
    counts = [_rough_counts(base, index, xyz) for index, xyz in enumerate(sweeps)]
    if not counts:
        raise ValueError("there are no sweeps; pass at least one (n, 3) array.")
    largest = np.maximum(margin * np.max(counts, axis=0), 1)
    obstacles, slab, *cells = (rounded_up(size) for size in largest)
    base = with_max_cells(base, cells)
    return dataclasses.replace(
        base,
        clustering=dataclasses.replace(base.clustering, max_obstacles=obstacles),
        box=dataclasses.replace(base.box, max_slab_points=slab),
    )


def _rough_counts(config: DetectorConfig, index: int, xyz: np.ndarray) -> list[int]:
    """Counts what the capacities of `propose_capacities` have to hold.

    Args:
      config: heights, region and maps.
      index: which sweep this is, for the error.
      xyz: (n, 3) m, sensor frame; NaN and infinity are ignored.

    Returns:
      Points above the ground, points that boxes are fitted to, and runs of occupied cells of each map.

    Raises:
      ValueError: for another shape.
    """
    xyz = np.asarray(unmasked(xyz, np.nan))
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ValueError(f"sweep {index} has shape {xyz.shape}; it must be (n, 3). Pass points[:, :3].")
    region = np.array([config.region.half_x_m, config.region.half_y_m])
    within = np.isfinite(xyz).all(axis=1) & (np.abs(xyz[:, :2]) < region).all(axis=1)
    xyz = xyz[within].astype(np.float64)
    xy, height = xyz[:, :2], _rough_height(xyz)

    def between(limits: GroundConfig | ComponentMap) -> np.ndarray:
        return (height > limits.min_height_m) & (height < limits.max_height_m)

    slab = (height > config.box.slab_min_height_m) & (height < config.box.slab_max_height_m)
    drawn = _rough_warp(xy, config.clustering)
    counts = [np.sum(between(config.ground)), np.sum(slab & between(config.ground))]
    for m in config.clustering.maps:
        level = np.minimum((height - m.min_height_m) // m.cell_m, m.num_levels - 1)
        cells = np.unique(np.column_stack([drawn // m.cell_m, level])[between(m)], axis=0)
        next_in_line = [0, 1, 0] if m.num_levels == 1 else [0, 0, 1]
        counts.append(len(cells) - np.sum(np.all(np.diff(cells, axis=0) == next_in_line, axis=1)))
    return [int(count) for count in counts]


def _rough_height(xyz: np.ndarray) -> np.ndarray:
    """(n,) m: height over the lowest point of the 1 m cell and the eight round it."""
    if len(xyz) == 0:
        return np.zeros(0)
    cell = np.floor(xyz[:, :2]).astype(int)
    cell -= cell.min(axis=0)
    lowest = np.full(cell.max(axis=0) + 3, np.inf)
    for i, j in np.ndindex(3, 3):
        np.minimum.at(lowest, (cell[:, 0] + i, cell[:, 1] + j), xyz[:, 2])
    return xyz[:, 2] - lowest[cell[:, 0] + 1, cell[:, 1] + 1]


def _rough_warp(xy: np.ndarray, config: ClusteringConfig) -> np.ndarray:
    """Compresses far ranges as the maps do, so that cells beyond the start hold more points."""
    rho = np.linalg.norm(xy, axis=1)
    beyond, growth = (
        np.maximum(rho - config.adaptive_start_m, 0),
        max(float(config.adaptive_growth), 1e-9),
    )
    return xy * (1 + (np.log1p(growth * beyond) / growth - beyond) / np.maximum(rho, 1e-9))[:, None]
