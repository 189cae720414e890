"""The whole pipeline: one sweep in, vehicle boxes out, each line a stage of `jaxbox.detector`."""

import functools

import numpy as np

from jaxbox.config import DetectorConfig
from jaxbox.reference import (
    assembly,
    clustering,
    completion,
    direction,
    evidence,
    filtering,
    ground,
    health,
    hull,
    readings,
    scoring,
)
from jaxbox.reference import descriptors as shapes
from jaxbox.reference import rectangles as fitting


def detect(
    xyz: np.ndarray, config: DetectorConfig | None = None, seed: int = 0
) -> assembly.ReferenceDetections:
    """Detects vehicles in one sweep: the oracle and the baseline of `jaxbox.detect`.

    Everything is float64, and no capacity binds but those that choose what is looked at:
    clustering.max_obstacles, a map's max_clusters, box.max_points, and max_large, max_candidates and
    max_detections of the vehicles.

    Args:
      xyz: (n, 3) m, sensor frame; NaN and infinity allowed.
      config: the settings; None is the default preset. Every threshold is a plain number.
      seed: of the RANSAC samples.

    Returns:
      The boxes, where every point went, and the true counts.

    >>> len(detect(np.zeros((0, 3))).score)
    0
    """
    config, xyz = DetectorConfig() if config is None else config, np.asarray(xyz, np.float64)
    if config.vehicles.num_readings == 1:
        return _read(xyz, config, seed)
    found = []
    for reading in range(config.vehicles.num_readings):
        angle = np.radians(reading * readings.TURN_DEG)
        turned = readings.turn_sweep(xyz, angle, config.region) if reading else xyz
        found.append(readings.turn_back(_read(turned, config, seed), angle))
    return readings.merge_readings(found, config)


def _read(xyz: np.ndarray, config: DetectorConfig, seed: int) -> assembly.ReferenceDetections:
    """One reading of a sweep.

    Args:
      xyz: (n, 3) float64, m, sensor frame.
      config: the settings.
      seed: of the RANSAC samples.

    Returns:
      What was found in it.
    """
    # 3.1 Statistical filtering, and ground removal by RANSAC (Algorithm I).
    sweep = filtering.select_points(xyz, config.filtering, config.region)
    terrain = ground.remove_ground(sweep, config.ground, np.random.default_rng(seed))
    obstacles = ground.gather_obstacles(sweep, terrain, config)
    # 3.2 Segmentation by 3D grid subdivision (Algorithm II).
    maps = clustering.propose_clusters(obstacles, config)
    clusters = [cluster for of_map in maps for cluster in of_map.clusters]
    # 3.3, 3.4 Convex hull, and rectangles at all rotations (Algorithm III).
    outlines = hull.outline_clusters(obstacles, clusters, config)
    rotations = fitting.fit_rectangles(outlines, config.box)
    # Correction for occluded objects.
    elevation = functools.partial(
        ground.ground_elevation, planes=terrain.planes, surface=terrain.surface, config=config.ground
    )
    seen = evidence.observe(sweep, terrain, elevation, config.evidence)
    preference = np.zeros(config.box.num_angles)
    if config.box.scene_direction and seen is not None:
        first = maps[0].clusters
        unbiased = fitting.best_rectangles(rotations[: len(first)], preference)
        preference = direction.scene_preference(unbiased, first, seen, config)
    rectangles = fitting.rectangle_candidates(rotations, outlines, preference, config)
    completed = completion.complete_boxes(rectangles, outlines, clusters, seen, config)
    # Vehicle decision, and non-maximum suppression.
    rays = None
    if seen is not None:
        boxes = np.array([box.box for box in completed.boxes]).reshape(-1, 5)
        priors = [config.vehicles.classes[hypothesis.label] for hypothesis in completed.hypotheses]
        raised = np.array([evidence.is_raised(prior) for prior in priors], bool)
        num_rays = config.completion.num_final_rays
        rays = evidence.cast_rays(seen, boxes, num_rays=num_rays, raised=raised)
    steepest = None if seen is None else seen.steepest
    reach = functools.partial(scoring.reach_of_beams, steepest=steepest, elevation=elevation)
    candidates = scoring.score_boxes(completed, rays, reach, clusters, obstacles, config)
    kept = scoring.keep_best(candidates, config.vehicles)
    # 3.5 Descriptors, and the counts.
    owned, owner = assembly.assign_points(kept, obstacles, clusters)
    hulls = hull.convex_hulls(owned)
    num_points, described = shapes.describe(owned, hulls)
    trust = health.measure_health(sweep, terrain, seen, config.health, config.ground)
    found = assembly.Found(sweep, terrain, obstacles, maps, clusters, completed, candidates, kept, trust)
    first_return_m = evidence.first_returns(seen, config.evidence)
    return assembly.assemble(found, owner, hulls, num_points, described, first_return_m, config)
