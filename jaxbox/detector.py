"""The pipeline: from a sweep to vehicle boxes, each line a section of the paper.

What users call is `jaxbox.detect`, the same compiled (`jaxbox.run.compiled`). Each stage is outlined: what it
finds is stored, and its scratch memory is freed, before the next one begins.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxbox.config import DetectorConfig
from jaxbox.stages import (
    assembly,
    clustering,
    completion,
    descriptors,
    direction,
    evidence,
    filtering,
    fronts,
    ground,
    health,
    hull,
    readings,
    rectangles,
    scoring,
)
from jaxbox.stages.state import (
    Candidates,
    Clusters,
    Completed,
    Evidence,
    Ground,
    GroundElevation,
    Obstacles,
    Outlines,
    Rotations,
    Sweep,
)
from jaxbox.types import Detections, PointCloud
from jaxbox.xla.backend import batch_together
from jaxbox.xla.barriers import opaque_zeros, outline
from jaxbox.xla.loops import map_batches


class Segments(NamedTuple):
    """What the first half of the pipeline finds, and the second reads."""

    sweep: Sweep
    ground: Ground
    obstacles: Obstacles
    clusters: Clusters
    outlines: Outlines
    rotations: Rotations
    evidence: Evidence | None


def find_vehicles(cloud: PointCloud, config: DetectorConfig, key: jax.Array) -> Detections:
    """Finds the vehicles of one sweep, read once or several times.

    Args:
      cloud: of N rows.
      config: of the detector.
      key: JAX random key.

    Returns:
      The detections, best score first.
    """
    num_readings = config.vehicles.num_readings
    if num_readings == 1:
        return read(cloud, config, key)

    def read_turned(angle: jax.Array) -> Detections:
        turned = outline(readings.turn_sweep, cloud, angle, config.region)
        return outline(readings.turn_back, read(turned, config, key), angle)

    angles = jnp.deg2rad(readings.TURN_DEG * jnp.arange(num_readings, dtype=jnp.float32))
    found = map_batches(read_turned, angles, chunk=1, together=batch_together())
    return outline(readings.merge_readings, found, config)


def read(cloud: PointCloud, config: DetectorConfig, key: jax.Array) -> Detections:
    """One reading of a sweep.

    Args:
      cloud: of N rows.
      config: of the detector.
      key: JAX random key.

    Returns:
      The detections, best score first.
    """
    return decide(cloud, segment(cloud, config, key), config)


def segment(cloud: PointCloud, config: DetectorConfig, key: jax.Array) -> Segments:
    """The first half: from the points to rectangles, and what the beams saw.

    Args:
      cloud: of N rows.
      config: of the detector.
      key: JAX random key.

    Returns:
      What `decide` reads.
    """
    # 3.1 Statistical filtering.
    sweep = outline(filtering.select_points, cloud, config.filtering, config.region)
    # 3.1 Ground removal by RANSAC (Algorithm I).
    terrain = outline(ground.remove_ground, sweep, config.ground, key)
    obstacles = outline(ground.gather_obstacles, sweep, terrain, config)
    # 3.2 Segmentation by 3D grid subdivision (Algorithm II): several maps, several proposals.
    clusters = outline(clustering.propose_clusters, obstacles, config)
    # 3.3, 3.4 Convex hull, and rectangles at all rotations (Algorithm III).
    outlines, rotations = outline(fit_rectangles, obstacles, clusters, config)
    # What the beams saw, for the correction.
    seen = outline(observe, sweep, terrain, config)
    return Segments(sweep, terrain, obstacles, clusters, outlines, rotations, seen)


def decide(cloud: PointCloud, segments: Segments, config: DetectorConfig) -> Detections:
    """The second half: completed boxes, their scores, and which of them are vehicles.

    Args:
      cloud: that `segments` are of.
      segments: from `segment`, with the same configuration.
      config: of the detector.

    Returns:
      The detections, best score first.
    """
    # Correction for occluded objects: the evidence decides how each box goes on out of sight.
    completed = outline(complete_boxes, segments, config)
    # Vehicle decision: by the rays, the size, and what surrounds the box.
    candidates = outline(score_boxes, completed, segments, config)
    # Non-maximum suppression, 3.5 descriptors, counts and status.
    return outline(assemble, cloud, segments, completed, candidates, config)


def fit_rectangles(
    obstacles: Obstacles, clusters: Clusters, config: DetectorConfig
) -> tuple[Outlines, Rotations]:
    """Convex hulls, or the points of the slab, and the rectangles round them at all rotations.

    Args:
      obstacles: O points.
      clusters: of the points.
      config: of the detector.

    Returns:
      The points of each cluster, and its rectangles.
    """
    outlines = hull.outline_clusters(obstacles, clusters, config)
    return outlines, rectangles.fit_rectangles(outlines, clusters.num, config.box)


def observe(sweep: Sweep, terrain: Ground, config: DetectorConfig) -> Evidence | None:
    """What the beams saw.

    Args:
      sweep: of N rows.
      terrain: below them.
      config: of the detector.

    Returns:
      The evidence; None where the preset does not ask for it.
    """
    ground_elevation = elevation_of(terrain, config)

    def elevation(xyz: jax.Array) -> jax.Array:
        return outline(ground_elevation, xyz)

    return evidence.observe(sweep, terrain, elevation, config.evidence)


def complete_boxes(segments: Segments, config: DetectorConfig) -> Completed:
    """Completed boxes of all class hypotheses, along the scene's direction where the preset prefers it.

    Args:
      segments: of the first half.
      config: of the detector.

    Returns:
      The hypotheses and their boxes.
    """
    clusters, rotations, seen = segments.clusters, segments.rotations, segments.evidence
    cast = None if seen is None else functools.partial(evidence.cast_rays, seen, config=config.evidence)
    preference = opaque_zeros(config.box.num_angles)
    if config.box.scene_direction and cast is not None:
        unbiased = rectangles.choose_rectangles(rotations, clusters.num, preference)
        preference = direction.scene_preference(unbiased, clusters, cast, config)
    points = segments.outlines.points
    candidates = rectangles.rectangle_candidates(rotations, points, clusters.num, preference, config)
    return completion.complete_boxes(candidates, points, clusters, cast, config)


def score_boxes(completed: Completed, segments: Segments, config: DetectorConfig) -> Candidates:
    """The boxes that may be vehicles, best score first.

    Args:
      completed: the boxes.
      segments: of the first half.
      config: of the detector.

    Returns:
      The candidates.
    """
    seen, terrain = segments.evidence, segments.ground
    rays = None
    if seen is not None:
        rays = evidence.weigh_boxes(seen, completed.boxes, completed.hypotheses, config)
    elevation = elevation_of(terrain, config)
    clusters, obstacles, lowest_z = segments.clusters, segments.obstacles, None
    if config.ground.max_planes > 1:
        lowest_z = clustering.lowest_z(segments.sweep.xyz[:, 2], obstacles, clusters)
    steepest = None if seen is None else seen.steepest
    return scoring.score_boxes(completed, rays, clusters, obstacles, elevation, lowest_z, steepest, config)


def elevation_of(terrain: Ground, config: DetectorConfig) -> GroundElevation:
    """A function that knows the ground of one sweep.

    Args:
      terrain: of the sweep.
      config: of the detector.

    Returns:
      z of the ground under points, see `jaxbox.stages.ground.ground_elevation`.
    """
    return functools.partial(
        ground.ground_elevation, planes=terrain.planes, surface=terrain.surface, config=config.ground
    )


def assemble(
    cloud: PointCloud,
    segments: Segments,
    completed: Completed,
    candidates: Candidates,
    config: DetectorConfig,
) -> Detections:
    """The answer: what suppression leaves of the candidates, described, and the counts of everything.

    Args:
      cloud: that all is of.
      segments: of the first half.
      completed: the boxes.
      candidates: those with a score, best first.
      config: of the detector.

    Returns:
      The detections.
    """
    sweep, terrain, obstacles, clusters, outlines, *_ = segments
    kept = scoring.keep_best(candidates, config.vehicles)
    owners = assembly.assign_points(kept, obstacles, clusters)
    hulls, area = hull.trace_owned(owners, obstacles.xy, kept, config.hull)
    num_points, shapes = descriptors.describe(owners, obstacles.xy, kept, hulls, area)
    facing = fronts.find_fronts(owners, obstacles, kept)
    trust = health.measure_health(sweep, terrain, segments.evidence, config.health, config.ground)
    found = assembly.Found(sweep, terrain, obstacles, clusters, outlines, completed, candidates, kept, trust)
    first_return_m = evidence.first_returns(segments.evidence, config.evidence)
    return assembly.assemble(cloud, found, owners, hulls, num_points, shapes, facing, first_return_m, config)
