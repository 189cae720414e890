"""From the sweep to the points above the ground."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxbox.config import DetectorConfig
from jaxbox.stages import filtering, ground
from jaxbox.steps.common import stage_options
from jaxbox.types import GroundPlane, PointCloud
from jaxbox.xla.loops import store
from jaxbox.xla.masked import compact, take

MAX_ABS_Z_M = 100.0
"""Points farther above or below the sensor are faults: one alone would stretch the spread of the whole
sweep, by which outliers are told, and beyond 1e19 m its square overflows."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sweep:
    """The sweep's points: which are finite, in the region, and no outliers."""

    xyz1: jax.Array  # (N, 4) m and 1, zero where not valid
    num_points: jax.Array  # () of the source sweep, which may exceed N
    present: jax.Array  # (N,) no padding
    finite: jax.Array  # (N,) and finite
    valid: jax.Array  # (N,) and in the region
    inlier: jax.Array  # (N,) and no outlier

    @property
    def xyz(self) -> jax.Array:
        """(N, 3) m, zero where not valid."""
        return self.xyz1[:, :3]


def select_points(cloud: PointCloud, config: DetectorConfig) -> Sweep:
    """Picks the finite points in the region, and those of them that are no outliers."""
    region = stage_options(config.region)
    limits = (*region.values(), MAX_ABS_Z_M)
    xyz1, present, finite, valid = store(_in_region(limits, jnp.asarray(cloud.xyz1)))
    inlier = valid
    if config.filtering.enabled:
        inlier = filtering.filter_outliers(xyz1, **region, **stage_options(config.filtering, "enabled"))
    return Sweep(xyz1, jnp.asarray(cloud.num_points), present, finite, valid, inlier)


def _in_region(limits: tuple[float, ...], xyz1: jax.Array) -> tuple[jax.Array, ...]:
    """The points within the limits, and which are there, are finite, are within."""
    present = xyz1[:, 3] > 0
    finite = valid = present
    # Axis by axis: a reduction over so short a row is slow (XLA, CPU).
    for axis, limit in enumerate(limits):
        finite &= jnp.isfinite(xyz1[:, axis])
        valid &= jnp.abs(xyz1[:, axis]) < limit
    return jnp.where(valid[:, None], xyz1, 0), present, finite, valid


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Heights:
    """The ground, and every point's height above it."""

    plane: GroundPlane
    planes: jax.Array  # (P, 3)
    surface: jax.Array | None  # (G, G) m over the plane
    height: jax.Array  # (N,) m


_PLANE_FIELDS = (
    "num_hypotheses",
    "num_refits",
    "tolerance_m",
    "max_slope_deg",
    "min_inlier_fraction",
    "max_planes",
)


_SURFACE_FIELDS = (
    "num_envelope_rounds",
    "max_grade",
    "band_below_m",
    "band_below_grade",
    "band_above_m",
    "band_above_grade",
    "blind_radius_m",
    "envelope_margin_m",
    "smoothing_m",
)


def remove_ground(sweep: Sweep, config: DetectorConfig, key: jax.Array) -> Heights:
    """Fits the ground, and measures every point's height above it."""
    settings = config.ground
    options = stage_options(settings)
    if settings.candidates == "cell_minima":
        candidates, mask = ground.cell_minima(
            sweep.xyz,
            sweep.inlier,
            half_x_m=settings.candidate_half_x_m,
            half_y_m=settings.candidate_half_y_m,
        )
    else:
        candidates, mask = ground.spread_points(
            sweep.xyz, sweep.inlier, sweep.num_points, num_candidates=settings.num_candidates
        )
    plane, planes = ground.fit_ground_planes(candidates, mask, key, **{k: options[k] for k in _PLANE_FIELDS})
    surface = None
    if settings.surface:
        surface = ground.fit_ground_surface(
            sweep.xyz,
            sweep.inlier,
            plane.coefficients,
            **_surface_grid(config),
            **{k: options[k] for k in _SURFACE_FIELDS},
        )
    height = height_above_ground(sweep.xyz, planes, surface, config)
    return Heights(plane, planes, surface, height)


def _surface_grid(config: DetectorConfig) -> dict[str, float]:
    return {"cell_m": config.ground.surface_cell_m, "half_m": config.ground.surface_half_m}


def height_above_ground(
    xyz: jax.Array, planes: jax.Array, surface: jax.Array | None, config: DetectorConfig
) -> jax.Array:
    """Height above the planes, or above the ground grid where there is one."""
    height = ground.height_above_planes(xyz, planes, tolerance_m=config.ground.min_height_m)
    if surface is None:
        return height
    return height - ground.surface_height(surface, xyz[:, :2], **_surface_grid(config))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Obstacles:
    """The points above the ground, compacted."""

    row: jax.Array  # (O,) row of the sweep, N beyond
    xy: jax.Array  # (O, 2) m
    height: jax.Array  # (O,) m
    present: jax.Array  # (O,)
    count: jax.Array  # () true number
    num_rows: int = dataclasses.field(metadata={"static": True})  # N


def gather_obstacles(sweep: Sweep, heights: Heights, config: DetectorConfig) -> Obstacles:
    """Compacts the points between the ground and the height of the tallest vehicle."""
    capacity = sweep.xyz.shape[0]
    max_obstacles = config.clustering.max_obstacles or -(-3 * capacity // 4)
    between = (heights.height > config.ground.min_height_m) & (heights.height < config.ground.max_height_m)
    row, count = compact(sweep.inlier & between, max_obstacles)
    return Obstacles(
        row, take(sweep.xyz, row)[:, :2], take(heights.height, row), row < capacity, count, capacity
    )
