"""The one table of capacities: where each is set, what counts its need, and what says that it was full.

Whoever sizes an array, sets a status bit, words an error or reports how full a capacity was reads a row here.
Capacities are Python numbers and counts may be traced, so that all of it works under `jax.jit`.
"""

import dataclasses
import fractions
import math
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox.config.presets import DetectorConfig

CLOUD_CAPACITY = "PointCloud.from_numpy(capacity=...)"
"""What sets N, the only capacity outside the configuration, which has no row here; `Status.POINT_OVERFLOW`
says that it was too small."""
PER_MAP = "clustering.maps[i]."
"""Prefix of the fields that each component map has."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Capacity:
    """One row of the table."""

    field: str
    """Where it is set: a name in `DetectorConfig`, after `PER_MAP` one of each component map."""
    count: str
    """The field of `jaxbox.types.Counts` that counts what it had to hold: () or, one a map, (maps,)."""
    status: str
    """Name of the bit of `jaxbox.Status` that says that it was too small; two capacities may share one."""
    overflow: str
    """That sentence, in words."""
    share: fractions.Fraction | None = None
    """Of the cloud's capacity N: what None in the configuration stands for, rounded up."""
    at_least: int = 0
    """Or as many as this, up to twice the share: of sweeps with few points a larger part is needed."""
    only_if: tuple[str, Any] | None = None
    """A field and its value for which the capacity is used; None where it always is."""

    @property
    def is_per_map(self) -> bool:
        """Whether each component map has its own."""
        return self.field.startswith(PER_MAP)

    def sizes(self, config: DetectorConfig, num_rows: int) -> dict[str, int]:
        """How much it holds.

        Args:
          config: the configuration.
          num_rows: N, capacity of the cloud.

        Returns:
          By dotted name: one number or, in the maps' order, one a map; none where it is not used.

        >>> CAPACITIES[0].sizes(DetectorConfig(), 1001)
        {'clustering.max_obstacles': 751}
        """
        if self.only_if is not None and _value(config, self.only_if[0]) != self.only_if[1]:
            return {}
        if not self.is_per_map:
            size = _value(config, self.field)
            return {self.field: self._share_of(num_rows) if size is None else size}
        name = self.field.removeprefix(PER_MAP)
        return {f"clustering.maps.{i}.{name}": getattr(m, name) for i, m in enumerate(config.clustering.maps)}

    def _share_of(self, num_rows: int) -> int:
        assert self.share is not None, f"{self.field} is None, and the table says no share of the cloud"
        size = math.ceil(self.share * num_rows)
        return max(size, min(2 * size, self.at_least))

    def is_exceeded(self, counts: Any, config: DetectorConfig, num_rows: int) -> jax.Array:
        """Whether more was needed than it holds, on any map.

        Args:
          counts: `jaxbox.types.Counts` of a sweep, traced or not.
          config: the configuration that counted.
          num_rows: N, capacity of the cloud.

        Returns:
          () bool; False where the capacity is not used.
        """
        needed, sizes = getattr(counts, self.count), list(self.sizes(config, num_rows).values())
        if not sizes:
            return jnp.zeros((), bool)
        return jnp.any(needed > jnp.array(sizes, jnp.int32)) if self.is_per_map else needed > sizes[0]


CAPACITIES = (
    Capacity(
        field="clustering.max_obstacles",
        count="obstacles",
        status="OBSTACLE_OVERFLOW",
        overflow="more points are above the ground than clustering.max_obstacles, and the last in the "
        "sweep's order were dropped",
        share=fractions.Fraction(3, 4),
    ),
    Capacity(
        field=f"{PER_MAP}max_cells",
        count="cells",
        status="CELL_OVERFLOW",
        overflow="a component map has more runs of occupied cells than its max_cells, and points in runs "
        "beyond those of all maps belong to no cluster",
    ),
    Capacity(
        field=f"{PER_MAP}max_clusters",
        count="clusters",
        status="CLUSTER_OVERFLOW",
        overflow="a component map has more clusters than its max_clusters, and those beyond it were not "
        "examined",
    ),
    Capacity(
        field="box.max_slab_points",
        count="slab_points",
        status="OBSTACLE_OVERFLOW",
        overflow="boxes are fitted to more points of a map than box.max_slab_points, and the last in the "
        "sweep's order were dropped",
        share=fractions.Fraction(1, 8),
        at_least=16384,
        only_if=("box.fit_to", "slab"),
    ),
    Capacity(
        field="vehicles.max_large",
        count="large_clusters",
        status="CLUSTER_OVERFLOW",
        overflow="more clusters are high than vehicles.max_large, and those beyond it were tried as cars "
        "only",
    ),
    Capacity(
        field="completion.max_assignments",
        count="assignments",
        status="ASSIGNMENT_OVERFLOW",
        overflow="the evidence has more boxes to weigh, each side of a cluster's rectangle as the length of "
        "each class, than completion.max_assignments, and those of the clusters with the fewest points were "
        "not weighed",
    ),
    Capacity(
        field="vehicles.max_candidates",
        count="candidates",
        status="CANDIDATE_OVERFLOW",
        overflow="more boxes scored well by rays and size than vehicles.max_candidates, and the "
        "lowest-scoring were dropped",
    ),
    Capacity(
        field="vehicles.max_detections",
        count="detections",
        status="DETECTION_OVERFLOW",
        overflow="more detections than vehicles.max_detections, and the lowest-scoring were dropped",
    ),
    Capacity(
        field="hull.max_vertices",
        count="hull_vertices",
        status="HULL_OVERFLOW",
        overflow="a hull has more vertices than hull.max_vertices, and every n-th was kept, evenly round it",
    ),
)
"""Every capacity of the configuration, in the order of the stages."""


def capacity_sizes(config: DetectorConfig, num_rows: int) -> dict[str, int]:
    """Every capacity that a configuration uses, by dotted name.

    Args:
      config: the configuration.
      num_rows: N, capacity of the cloud.

    Returns:
      How much each holds, in the order of the stages.

    >>> list(capacity_sizes(DetectorConfig.paper(), 2**17).items())[:2]
    [('clustering.max_obstacles', 98304), ('clustering.maps.0.max_cells', 14336)]
    """
    return {name: size for row in CAPACITIES for name, size in row.sizes(config, num_rows).items()}


def obstacle_capacity(config: DetectorConfig, num_rows: int) -> int:
    """How many points above the ground a cloud of capacity N = num_rows may have."""
    return _size_of("clustering.max_obstacles", config, num_rows)


def slab_capacity(config: DetectorConfig, num_rows: int) -> int:
    """How many points between the slab's heights boxes are fitted to, for a cloud of capacity N = num_rows.

    Only where ``box.fit_to`` is "slab".
    """
    return _size_of("box.max_slab_points", config, num_rows)


def _size_of(name: str, config: DetectorConfig, num_rows: int) -> int:
    (size,) = (row.sizes(config, num_rows)[name] for row in CAPACITIES if row.field == name)
    return size


def _value(config: DetectorConfig, name: str) -> Any:
    stage, field = name.split(".")
    return getattr(getattr(config, stage), field)
