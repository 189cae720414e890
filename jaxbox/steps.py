"""The steps of `detect`: each picks its settings, hands arrays to its stage, and names what comes back."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox import box, clustering, completion, descriptors, evidence, filtering, ground, hull, vehicles
from jaxbox.config import DetectorConfig
from jaxbox.geometry import wrap_yaw
from jaxbox.masked import compact, map_rows, store, take
from jaxbox.types import (
    NOT_A_BOX,
    Boxes,
    Clusters,
    Counts,
    Detections,
    GroundPlane,
    Hulls,
    Label,
    PointCloud,
    Rectangles,
    Status,
)

PROPOSAL_CHUNK = 256
"""Proposals held against the evidence at a time: a loop over their points has few, wide steps."""

HULL_CHUNK = 16
"""Clusters whose hulls are traced at a time: each compares all pairs of its points."""

INSIDE_TOLERANCE_M = 1e-3
"""A point on the face of its box is inside."""


def _options(config: Any, *drop: str) -> dict[str, Any]:
    """The fields of a sub-config as keyword arguments for its stage."""
    return {f.name: getattr(config, f.name) for f in dataclasses.fields(config) if f.name not in drop}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sweep:
    """The sweep's points: which are finite, in the region, and no outliers."""

    xyz: jax.Array  # (N, 3) m, zero where not valid
    num_points: jax.Array  # () rows that are no padding, as far as they fit
    present: jax.Array  # (N,) no padding
    finite: jax.Array  # (N,) and finite
    valid: jax.Array  # (N,) and in the region
    inlier: jax.Array  # (N,) and no outlier


def select_points(cloud: PointCloud, config: DetectorConfig) -> Sweep:
    region = _options(config.region)
    xyz, present = cloud.xyz1[:, :3], cloud.xyz1[:, 3] > 0
    finite = present & jnp.all(jnp.isfinite(xyz), axis=1)
    valid = finite & jnp.all(jnp.abs(xyz[:, :2]) < jnp.array([*region.values()]), axis=1)
    xyz = jnp.where(valid[:, None], xyz, 0)
    inlier = valid
    if config.filtering.enabled:
        inlier = filtering.filter_outliers(xyz, valid, **region, **_options(config.filtering, "enabled"))
    return Sweep(xyz, cloud.num_points, present, finite, valid, inlier)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Heights:
    """The ground, and every point's height above it."""

    plane: GroundPlane
    planes: jax.Array  # (P, 3)
    surface: jax.Array | None  # (G, G) m over the plane
    height: jax.Array  # (N,) m


_PLANE_FIELDS = ("num_hypotheses", "num_refits", "tolerance_m", "max_slope_deg", "min_inlier_fraction", "max_planes")
_SURFACE_FIELDS = (
    "num_envelope_rounds", "max_grade", "band_below_m", "band_below_grade", "band_above_m", "band_above_grade",
    "blind_radius_m", "envelope_margin_m", "smoothing_m",
)  # fmt: skip


def remove_ground(sweep: Sweep, config: DetectorConfig, key: jax.Array) -> Heights:
    settings = config.ground
    options = _options(settings)
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
            sweep.xyz, sweep.inlier, plane.coefficients, **_surface_grid(config),
            **{k: options[k] for k in _SURFACE_FIELDS},
        )  # fmt: skip
    height = _height_above(sweep.xyz, planes, surface, config)
    return Heights(plane, planes, surface, height)


def _surface_grid(config: DetectorConfig) -> dict[str, float]:
    return {"cell_m": config.ground.surface_cell_m, "half_m": config.ground.surface_half_m}


def _height_above(
    xyz: jax.Array, planes: jax.Array, surface: jax.Array | None, config: DetectorConfig
) -> jax.Array:
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
    capacity = sweep.xyz.shape[0]
    max_obstacles = config.clustering.max_obstacles or -(-3 * capacity // 4)
    between = (heights.height > config.ground.min_height_m) & (heights.height < config.ground.max_height_m)
    row, count = compact(sweep.inlier & between, max_obstacles)
    return Obstacles(row, take(sweep.xyz, row)[:, :2], take(heights.height, row), row < capacity, count, capacity)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Proposals:
    """The clusters of all maps in one list, and the classes each is tried as."""

    maps: tuple[Clusters, ...]
    cluster: jax.Array  # (maps, O) row of each point's cluster in the list, P for none
    num_clusters: jax.Array  # ()
    num_first: jax.Array  # () those of the first map, which come first
    num_points: jax.Array  # (P,)
    min_height: jax.Array  # (P,) m
    max_height: jax.Array  # (P,) m
    fitted: jax.Array  # (maps, O) whether a box is fitted to the point
    num_slab: jax.Array  # () points of the map that has most of those
    large: jax.Array  # (L,) clusters also tried as van and truck, P beyond
    num_large: jax.Array  # () true number


def propose_clusters(obstacles: Obstacles, config: DetectorConfig) -> Proposals:
    settings = config.clustering
    xy = clustering.warp_range(obstacles.xy, start_m=settings.adaptive_start_m, growth=settings.adaptive_growth)
    maps = []
    for m in settings.maps:
        above, below = obstacles.height > m.min_height_m, obstacles.height < m.max_height_m
        index, shape = clustering.cell_index(
            xy, obstacles.height, cell_m=m.cell_m, num_levels=m.num_levels, min_height_m=m.min_height_m,
            **_options(config.region),
        )  # fmt: skip
        component, num_cells = clustering.label_components(
            index, obstacles.present & above & below, shape=shape, max_cells=m.max_cells
        )
        maps.append(
            clustering.select_clusters(
                component, obstacles.xy, obstacles.height, num_cells, max_cells=m.max_cells,
                max_clusters=m.max_clusters, min_points=settings.min_points, max_extent_m=settings.max_extent_m,
            )  # fmt: skip
        )
    return _list_proposals(tuple(maps), obstacles, config)


def _list_proposals(maps: tuple[Clusters, ...], obstacles: Obstacles, config: DetectorConfig) -> Proposals:
    sizes = [m.num_points.shape[0] for m in maps]
    total = sum(sizes)
    kept = [jnp.minimum(m.num_clusters, size) for m, size in zip(maps, sizes, strict=True)]
    # The lists join without gaps, so that work on them ends with the last cluster.
    offset = [sum(kept[:i], jnp.int32(0)) for i in range(len(maps))]
    cluster = jnp.stack(
        [jnp.where(m.slot < size, m.slot + o, total) for m, size, o in zip(maps, sizes, offset, strict=True)]
    )

    def join(field: str) -> jax.Array:
        values = [getattr(m, field) for m in maps]
        joined = jnp.zeros(total, values[0].dtype)
        for value, o, k in zip(values, offset, kept, strict=True):
            slot = jnp.arange(value.shape[0])
            joined = joined.at[jnp.where(slot < k, slot + o, total)].set(value, mode="drop")
        return joined

    max_height = join("max_height")
    large, num_large = compact(max_height > config.vehicles.large_height_m, config.vehicles.max_large)
    fitted = _fitted(cluster, obstacles, total, config)
    num_slab = jnp.max(jnp.sum(fitted, axis=1))
    return Proposals(
        maps, cluster, sum(kept, jnp.int32(0)), kept[0], join("num_points"), join("min_height"), max_height,
        fitted, num_slab, large, num_large,
    )  # fmt: skip


def _fitted(
    cluster: jax.Array, obstacles: Obstacles, num_clusters: int, config: DetectorConfig
) -> jax.Array:
    """(maps, O) points between the slab's heights, or all of the clusters that have few of those."""
    settings = config.box
    in_slab = (obstacles.height > settings.slab_min_height_m) & (obstacles.height < settings.slab_max_height_m)
    count = jnp.zeros(num_clusters + 1)
    for row in cluster:
        count = count.at[row].add(in_slab)
    return (cluster < num_clusters) & (in_slab | (count[cluster] < settings.min_slab_points))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Fits:
    """All rotations of all clusters, and the points that they were fitted to."""

    curve: jax.Array  # (P, A)
    extents: box.Extents
    points: jax.Array  # (P, M, 2) m
    count: jax.Array  # (P,)


def fit_rectangles(obstacles: Obstacles, proposals: Proposals, config: DetectorConfig) -> Fits:
    """Rectangles of all clusters at all rotations, and the points that they were fitted to."""
    settings = config.box
    outline = _hull_points if settings.fit_to == "hull" else _slab_points
    points, count = outline(obstacles, proposals, config)
    curve, extents = box.try_rotations(
        points, count, proposals.num_clusters, criterion=settings.criterion,
        num_angles=settings.num_angles, min_distance_m=settings.min_distance_m,
    )  # fmt: skip
    return Fits(curve, extents, points, count)


def _hull_points(
    obstacles: Obstacles, proposals: Proposals, config: DetectorConfig
) -> tuple[jax.Array, jax.Array]:
    """The hull of each cluster, as the points that its rectangle is fitted to (the paper)."""
    num_obstacles = obstacles.xy.shape[0]
    index = hull.extreme_points(
        proposals.cluster.reshape(-1), jnp.tile(obstacles.xy, (len(proposals.maps), 1)),
        num_clusters=proposals.num_points.shape[0], num_slices=config.hull.num_slices,
    )  # fmt: skip
    index = jnp.where(index < proposals.cluster.size, index % num_obstacles, num_obstacles)
    trace = functools.partial(_hulls, obstacles.xy, config.hull.max_vertices)
    vertices, count = map_rows(trace, index, num_rows=proposals.num_clusters, chunk=HULL_CHUNK)
    return vertices, jnp.minimum(count, config.hull.max_vertices)


def _hulls(xy: jax.Array, max_vertices: int, index: jax.Array) -> tuple[jax.Array, jax.Array]:
    one = functools.partial(hull.convex_hull, max_vertices=max_vertices)
    return jax.vmap(one)(take(xy, index), index < xy.shape[0])


def _slab_points(
    obstacles: Obstacles, proposals: Proposals, config: DetectorConfig
) -> tuple[jax.Array, jax.Array]:
    """The points of each cluster between the slab's heights, or all where those are few."""
    num_clusters, num_obstacles = proposals.num_points.shape[0], obstacles.row.shape[0]
    rows, clusters = [], []
    for cluster, used in zip(proposals.cluster, proposals.fitted, strict=True):
        row, _ = compact(used, _max_slab_points(obstacles.num_rows, config))
        rows.append(row)
        clusters.append(take(cluster, row, num_clusters))
    index, count = box.sample_points(
        jnp.concatenate(clusters), num_clusters=num_clusters, max_points=config.box.max_points
    )
    row = take(jnp.concatenate(rows), index, num_obstacles)
    return take(obstacles.xy, row), count


def _max_slab_points(capacity: int, config: DetectorConfig) -> int:
    return config.box.max_slab_points or -(-capacity // 4)


def build_evidence(sweep: Sweep, heights: Heights, config: DetectorConfig) -> evidence.Evidence | None:
    """What the beams saw, or None where the preset does not ask."""
    if not config.evidence.enabled:
        return None
    sensor_height = -heights.plane.coefficients[2]
    return evidence.build_evidence(
        sweep.xyz, heights.height, sweep.inlier, sensor_height, **_options(config.evidence, "enabled")
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Trials:
    """Each cluster as a car, and the large ones as a van and as a truck too: Q trials."""

    cluster: jax.Array  # (Q,) row of the cluster, P beyond
    label: jax.Array  # (Q,) class
    num: jax.Array  # ()


def list_trials(proposals: Proposals) -> Trials:
    """Lists cars first, then vans, then trucks, without gaps."""
    capacity, max_large = proposals.num_points.shape[0], proposals.large.shape[0]
    num_cars, num_large = proposals.num_clusters, jnp.minimum(proposals.num_large, max_large)
    j = jnp.arange(capacity + 2 * max_large)
    extra = j - num_cars
    is_car, is_van = j < num_cars, extra < num_large
    large = take(proposals.large, jnp.where(is_van, extra, extra - num_large), capacity)
    num = num_cars + 2 * num_large
    return Trials(
        cluster=jnp.where(j >= num, capacity, jnp.where(is_car, j, large)),
        label=jnp.where(is_car, Label.CAR, jnp.where(is_van, Label.VAN, Label.TRUCK)),
        num=num,
    )


def _class_field(config: DetectorConfig, field: str, label: jax.Array) -> jax.Array:
    return jnp.stack([jnp.asarray(getattr(c, field), jnp.float32) for c in config.vehicles.classes])[label]


def complete_boxes(
    fits: Fits, proposals: Proposals, seen: evidence.Evidence | None, config: DetectorConfig
) -> tuple[Trials, Boxes]:
    """The completed box of every trial, with the scene's direction preferred where the preset asks."""
    trials = list_trials(proposals)
    preference = jnp.zeros(config.box.num_angles)
    if config.box.scene_direction and seen is not None:
        preference = _scene_preference(fits, proposals, seen, config)
    rectangles = box.best_rectangles(fits.curve, fits.extents, preference)
    return trials, _complete(trials, rectangles, fits, seen, config)


def _scene_preference(
    fits: Fits, proposals: Proposals, seen: evidence.Evidence, config: DetectorConfig
) -> jax.Array:
    """The direction that the first map's boxes, fitted without a preference, vote for."""
    settings = config.box
    size = proposals.maps[0].num_points.shape[0]
    first = jax.tree.map(lambda a: a[:size], fits)
    j = jnp.arange(size)
    trials = Trials(jnp.where(j < proposals.num_first, j, size), jnp.zeros(size, jnp.int32), proposals.num_first)
    rectangles = box.best_rectangles(first.curve, first.extents, jnp.zeros(settings.num_angles))
    boxes = _complete(trials, rectangles, first, seen, config)
    rays = _cast(boxes, trials.num, seen, config)
    extent = jnp.max(boxes.measured, axis=1)
    voting = (j < trials.num) & (boxes.objective > NOT_A_BOX)
    voting = voting & (extent >= settings.direction_min_extent_m)
    voting = voting & (rays.free_length <= settings.direction_max_free)
    return box.scene_preference(
        boxes.yaw, extent, proposals.num_points[:size], voting, num_angles=settings.num_angles,
        weight=settings.direction_weight, sigma_deg=settings.direction_sigma_deg,
    )  # fmt: skip


def _complete(
    trials: Trials,
    rectangles: Rectangles,
    fits: Fits,
    seen: evidence.Evidence | None,
    config: DetectorConfig,
) -> Boxes:
    settings = config.completion
    limits = ("max_length_m", "max_width_m")
    prior = {name: _class_field(config, name, trials.label) for name in ("length_m", "width_m", *limits)}

    def complete(rows: tuple[jax.Array, dict[str, jax.Array]]) -> Boxes:
        cluster, prior = rows
        rectangle = jax.tree.map(lambda a: take(a, cluster), rectangles)
        if settings.mode == "none":
            return completion.keep_measured(rectangle, **{name: prior[name] for name in limits})
        if settings.mode == "away":
            return completion.extend_away(rectangle, **prior)
        hypotheses = completion.box_hypotheses(rectangle, **prior)
        rays = _cast_chunk(hypotheses, settings.num_rays, seen, config)
        inside, near = completion.point_agreement(
            hypotheses, take(fits.points, cluster), take(fits.count, cluster)
        )
        return completion.choose_hypothesis(
            hypotheses, rectangle.worth, hit=rays.hit, free=rays.free, free_length=rays.free_length,
            inside=inside, near=near, **_options(settings, "mode", "num_rays", "num_final_rays"),
        )  # fmt: skip

    return map_rows(complete, (trials.cluster, prior), num_rows=trials.num, chunk=PROPOSAL_CHUNK)


def _cast_chunk(
    boxes: Boxes, num_rays: int, seen: evidence.Evidence, config: DetectorConfig
) -> evidence.RayFractions:
    return evidence.cast_rays(
        seen, boxes.center, boxes.length, boxes.width, boxes.yaw, num_rays=num_rays,
        range_cell_m=config.evidence.range_cell_m,
    )  # fmt: skip


def _cast(
    boxes: Boxes, num: jax.Array, seen: evidence.Evidence, config: DetectorConfig
) -> evidence.RayFractions:
    cast = functools.partial(
        _cast_chunk, num_rays=config.completion.num_final_rays, seen=seen, config=config
    )
    return map_rows(cast, boxes, num_rows=num, chunk=PROPOSAL_CHUNK)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Candidates:
    """The trials that pass the gates, best score first: C rows."""

    rectangle: jax.Array  # (C, 5) x, y, length, width, yaw
    bottom: jax.Array  # (C,) m, sensor frame
    height: jax.Array  # (C,) m
    score: jax.Array  # (C,)
    label: jax.Array  # (C,)
    cluster: jax.Array  # (C,)
    valid: jax.Array  # (C,)
    num: jax.Array  # () true number


def score_boxes(
    trials: Trials,
    boxes: Boxes,
    proposals: Proposals,
    obstacles: Obstacles,
    heights: Heights,
    seen: evidence.Evidence | None,
    config: DetectorConfig,
) -> Candidates:
    """Scores the boxes by rays and size, then the best of them by what surrounds them."""
    settings = config.vehicles
    score = _early_score(trials, boxes, proposals, seen, config)
    chosen, num = _best(score, settings.max_candidates, settings.min_score)
    rectangle = jnp.concatenate(
        [boxes.center, jnp.stack([boxes.length, boxes.width, wrap_yaw(boxes.yaw)], axis=1)], axis=1
    )
    rectangle = take(rectangle, chosen)
    label, cluster = take(trials.label, chosen), take(trials.cluster, chosen, proposals.num_points.shape[0])
    prior = functools.partial(_class_field, config, label=label)
    around = vehicles.count_points_around(
        rectangle, prior("count_max_height_m"), num, obstacles.xy, obstacles.height, obstacles.present,
        **_options(config.region), max_nearby=settings.max_nearby, margin_m=settings.margin_m,
        ring_m=settings.ring_m,
    )  # fmt: skip
    rho = jnp.linalg.norm(rectangle[:, :2], axis=1)
    late = vehicles.surroundings_score(
        around, rho, top_grade=settings.top_grade, ring_weight=settings.ring_weight,
        overhead_weight=settings.overhead_weight,
        **{name: prior(name) for name in ("height_m", "height_tolerance_m", "min_height_m", "max_height_m")},
    )  # fmt: skip
    height = jnp.maximum(around.top + settings.top_margin_m, prior("min_box_height_m"))
    above = jnp.zeros_like(height)
    if config.completion.mode == "none":
        # The paper keeps the height of the cluster itself.
        above = take(proposals.min_height, cluster)
        height = take(proposals.max_height, cluster) - above
    flat = jnp.concatenate([rectangle[:, :2], jnp.zeros_like(rectangle[:, :1])], axis=1)
    bottom = above - _height_above(flat, heights.planes, heights.surface, config)
    total = jnp.where(chosen < score.shape[0], take(score, chosen) * late, 0)
    order, final = _best(total, settings.max_candidates, settings.min_score)
    unsorted = Candidates(
        rectangle, bottom, height, total, label, cluster, total > settings.min_score, jnp.zeros_like(label)
    )
    ordered = jax.tree.map(lambda a: take(a, order), unsorted)
    return dataclasses.replace(ordered, num=jnp.maximum(num, final))


def _early_score(
    trials: Trials,
    boxes: Boxes,
    proposals: Proposals,
    seen: evidence.Evidence | None,
    config: DetectorConfig,
) -> jax.Array:
    """(Q,) the part of the score that needs no look at the surroundings; no other part exceeds 1."""
    settings = config.vehicles
    prior = functools.partial(_class_field, config, label=trials.label)
    num_points = take(proposals.num_points, trials.cluster)
    ones = jnp.ones_like(boxes.yaw)
    hit, free_length, support = ones, 0 * ones, settings.support_points * ones
    if seen is not None:
        rays = _cast(boxes, trials.num, seen, config)
        hit, free_length = rays.hit, rays.free_length
        support = evidence.ground_support(seen, boxes.center)
    score = vehicles.evidence_score(
        num_points=num_points, hit=hit, free_length=free_length, support=support, objective=boxes.objective,
        **{name: getattr(settings, name) for name in (
            "saturation_points", "sparseness_power", "free_scale", "support_points", "objective_gate",
            "objective_softness")},
    )  # fmt: skip
    score = score * vehicles.size_score(
        jnp.stack([boxes.length, boxes.width], axis=1),
        jnp.stack([prior("length_m"), prior("width_m")], axis=1),
        **{name: prior(name) for name in ("length_below_m", "length_above_m", "width_tolerance_m")},
    )
    present = (jnp.arange(score.shape[0]) < trials.num) & (boxes.objective > NOT_A_BOX)
    return jnp.where(present & (jnp.max(boxes.measured, axis=1) >= settings.min_extent_m), score, 0)


def _best(score: jax.Array, capacity: int, min_score: jax.Array | float) -> tuple[jax.Array, jax.Array]:
    """Rows with the highest scores above the least, best first (ties by row), and their true number."""
    size = score.shape[0]
    above = score > min_score
    _, order = jax.lax.sort((jnp.where(above, -score, 1), jnp.arange(size)), num_keys=1, is_stable=True)
    num = jnp.sum(above)
    row = jnp.arange(capacity)
    order = jnp.pad(order, (0, max(capacity - size, 0)), constant_values=size)[:capacity]
    return jnp.where(row < num, order, size), num


def conclude(
    cloud: PointCloud,
    sweep: Sweep,
    heights: Heights,
    obstacles: Obstacles,
    proposals: Proposals,
    candidates: Candidates,
    config: DetectorConfig,
) -> Detections:
    """Suppresses overlapping boxes, describes the points of the others, and counts everything."""
    settings = config.vehicles
    keep = vehicles.suppress(candidates.rectangle, candidates.valid, max_overlap=settings.max_overlap)
    row, num = compact(keep, settings.max_detections)
    kept = jax.tree.map(lambda a: take(a, row), dataclasses.replace(candidates, num=keep))
    valid = row < keep.shape[0]
    owner = store(_owners(kept, valid, obstacles, proposals), ~jnp.all(cloud.num_points < 0))
    outline = hull.extreme_points(
        owner, obstacles.xy, num_clusters=settings.max_detections, num_slices=config.hull.num_slices
    )
    trace = functools.partial(_hulls, obstacles.xy, config.hull.max_vertices)
    vertices, num_vertices = map_rows(trace, outline, num_rows=num, chunk=HULL_CHUNK)
    num_points = jnp.zeros(settings.max_detections, jnp.int32).at[owner].add(1, mode="drop")
    shapes = descriptors.shape_descriptors(
        owner, obstacles.xy, kept.rectangle[:, :2], hull.polygon_area(vertices), num_vertices
    )
    center = jnp.concatenate([kept.rectangle[:, :2], (kept.bottom + kept.height / 2)[:, None]], axis=1)
    size = jnp.concatenate([kept.rectangle[:, 2:4], kept.height[:, None]], axis=1)
    counts = _counts(cloud, sweep, heights, obstacles, proposals, candidates, num, num_vertices, config)

    def per_point(value: jax.Array, absent: int) -> jax.Array:
        everywhere = jnp.full(sweep.xyz.shape[0], absent, jnp.int32)
        return everywhere.at[obstacles.row].set(value.astype(jnp.int32), mode="drop")

    return Detections(
        center=jnp.where(valid[:, None], center, 0),
        size=jnp.where(valid[:, None], size, 0),
        yaw=kept.rectangle[:, 4],
        score=kept.score,
        label=kept.label,
        valid=valid,
        num_points=num_points,
        hulls=Hulls(vertices, num_vertices),
        descriptors=shapes,
        ground=heights.plane,
        ground_mask=sweep.inlier & (heights.height <= config.ground.min_height_m),
        point_component=per_point(proposals.maps[0].component, -1),
        point_detection=per_point(jnp.where(owner < settings.max_detections, owner, -1), -1),
        status=_status(counts, sweep, heights, obstacles, proposals, config),
        counts=counts,
    )


def _owners(
    kept: Candidates, valid: jax.Array, obstacles: Obstacles, proposals: Proposals
) -> jax.Array:
    """(O,) the detection that each point belongs to, K for none: of its clusters' boxes that hold it the best."""
    num_detections, num_clusters = valid.shape[0], proposals.num_points.shape[0]
    rank = jnp.where(valid, jnp.arange(num_detections), num_detections)
    of_cluster = jnp.full(num_clusters, num_detections).at[kept.cluster].min(rank, mode="drop")
    x, y, length, width, yaw = kept.rectangle.T
    frame = jnp.stack([x, y, jnp.cos(yaw), jnp.sin(yaw), length / 2, width / 2], axis=1)
    owner = jnp.full(obstacles.row.shape, num_detections)
    for cluster in proposals.cluster:
        detection = take(of_cluster, cluster, num_detections)
        x, y, cos, sin, half_length, half_width = take(frame, detection).T
        dx, dy = obstacles.xy[:, 0] - x, obstacles.xy[:, 1] - y
        inside = jnp.abs(dx * cos + dy * sin) <= half_length + INSIDE_TOLERANCE_M
        inside = inside & (jnp.abs(dy * cos - dx * sin) <= half_width + INSIDE_TOLERANCE_M)
        owner = jnp.minimum(owner, jnp.where(inside, detection, num_detections))
    return owner


def _counts(
    cloud: PointCloud,
    sweep: Sweep,
    heights: Heights,
    obstacles: Obstacles,
    proposals: Proposals,
    candidates: Candidates,
    num_detections: jax.Array,
    num_vertices: jax.Array,
    config: DetectorConfig,
) -> Counts:
    num = functools.partial(jnp.sum, dtype=jnp.int32)
    clustered = num(jnp.any(proposals.cluster < proposals.num_points.shape[0], axis=0) & obstacles.present)
    num_obstacles = num(obstacles.present)
    above = heights.height > config.ground.min_height_m
    return Counts(
        dropped_points=cloud.num_points - num(sweep.present),
        nonfinite_points=num(sweep.present & ~sweep.finite),
        out_of_range_points=num(sweep.finite & ~sweep.valid),
        outlier_points=num(sweep.valid & ~sweep.inlier),
        ground_points=num(sweep.inlier & ~above),
        overhead_points=num(sweep.inlier & above & (heights.height >= config.ground.max_height_m)),
        dropped_obstacles=obstacles.count - num_obstacles,
        clustered_points=clustered,
        unclustered_points=num_obstacles - clustered,
        obstacles=obstacles.count,
        slab_points=proposals.num_slab,
        cells=jnp.stack([m.num_cells for m in proposals.maps]),
        clusters=jnp.stack([m.num_clusters for m in proposals.maps]),
        candidates=candidates.num,
        detections=num_detections,
        hull_vertices=jnp.max(num_vertices),
    )


def _status(
    counts: Counts,
    sweep: Sweep,
    heights: Heights,
    obstacles: Obstacles,
    proposals: Proposals,
    config: DetectorConfig,
) -> jax.Array:
    settings = config.vehicles
    capacity = sweep.xyz.shape[0]
    max_clusters = jnp.array([m.max_clusters for m in config.clustering.maps])
    max_cells = jnp.array([m.max_cells for m in config.clustering.maps])
    bits = {
        Status.EMPTY: ~jnp.any(sweep.valid),
        Status.NONFINITE_POINTS: counts.nonfinite_points > 0,
        Status.POINT_OVERFLOW: counts.dropped_points > 0,
        Status.NO_GROUND: ~heights.plane.found,
        Status.OBSTACLE_OVERFLOW: (counts.dropped_obstacles > 0)
        | (counts.slab_points > _max_slab_points(capacity, config)),
        Status.CELL_OVERFLOW: jnp.any(counts.cells > max_cells),
        Status.CLUSTER_OVERFLOW: jnp.any(counts.clusters > max_clusters)
        | (proposals.num_large > settings.max_large),
        Status.CANDIDATE_OVERFLOW: counts.candidates > settings.max_candidates,
        Status.DETECTION_OVERFLOW: counts.detections > settings.max_detections,
        Status.HULL_OVERFLOW: counts.hull_vertices > config.hull.max_vertices,
    }
    return sum((jnp.where(is_set, jnp.int32(bit), 0) for bit, is_set in bits.items()), jnp.int32(0))
