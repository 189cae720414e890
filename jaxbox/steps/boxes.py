"""From the clusters to boxes, completed where the sensor does not see."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox.config import CompletionConfig, DetectorConfig
from jaxbox.stages import completion, evidence, hull
from jaxbox.stages import rectangles as box
from jaxbox.steps.common import class_values, stage_options
from jaxbox.steps.points import Heights, Obstacles, Sweep
from jaxbox.steps.proposals import Proposals, Trials, list_trials, longest_side
from jaxbox.types import NOT_A_BOX, Boxes, Label, Rectangles
from jaxbox.xla.loops import fold_rows, map_rows, store
from jaxbox.xla.masked import compact, split_index, take
from jaxbox.xla.sorting import largest_first, sort_by_group

INSISTENCE = 5.0
"""How often the scene's direction counts for the second reading of a cluster: it bends a closeness only."""

PROPOSAL_CHUNK = 256
"""Proposals held against the evidence at a time: a loop over their points has few, wide steps."""

RAY_CHUNK = 128
"""Boxes that rays are cast over at a time, for votes as for scores: equal kernels are compiled once."""

HULL_CHUNK = 32
"""Clusters whose hulls are traced at a time."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Fits:
    """All rotations of all clusters, and the points that they were fitted to."""

    curve: jax.Array  # (A, P), the clusters with most points first
    extents: jax.Array  # (4, A, P) likewise
    place: jax.Array  # (P,) where each cluster is in those
    points: box.PointLists  # of P clusters
    hull_vertices: jax.Array  # () of the largest hull that was fitted to; 0 where none was


def fit_rectangles(obstacles: Obstacles, proposals: Proposals, config: DetectorConfig) -> Fits:
    """Rectangles of all clusters at all rotations, and the points that they were fitted to."""
    settings = config.box
    outline = _hull_points if settings.fit_to == "hull" else _slab_points
    points, hull_vertices = outline(obstacles, proposals, config)
    order, place = largest_first(points.count, points.max_points)
    curve, extents = box.try_rotations(
        points,
        order,
        proposals.num_clusters,
        criterion=settings.criterion,
        num_angles=settings.num_angles,
        min_distance_m=settings.min_distance_m,
    )
    return Fits(curve, extents, place, points, hull_vertices)


def best_rectangles(
    fits: Fits, num_clusters: jax.Array, preference: jax.Array, insistence: float = 1.0
) -> Rectangles:
    """The rectangle of each cluster at its best rotation, see `box.best_rectangles`."""

    def best(rotations: tuple[jax.Array, jax.Array]) -> jax.Array:
        return box.best_rectangles(*rotations, preference, insistence=insistence).rows.T

    columns = fits.curve, fits.extents
    rows = map_rows(best, columns, num_rows=num_clusters, chunk=PROPOSAL_CHUNK, axis=-1)
    return Rectangles(rows.T[fits.place])


def _hull_points(
    obstacles: Obstacles, proposals: Proposals, config: DetectorConfig
) -> tuple[box.PointLists, jax.Array]:
    """The hull of each cluster, as the points that its rectangle is fitted to (the paper)."""
    num_clusters = proposals.num_points.shape[0]
    listed, capacity = proposals.cluster < num_clusters, proposals.cluster.size
    cluster, row, num = _list_points(obstacles, proposals, listed, capacity)
    bounds = proposals.low[:, :2], proposals.high[:, :2]
    index = hull.extreme_points(cluster, row, num, obstacles.xy, *bounds, num_slices=config.hull.num_slices)
    x, y, count = trace_hulls(obstacles.xy, index, proposals.num_clusters, config)
    capacity = x.shape[0]
    start, listed = jnp.arange(num_clusters, dtype=jnp.int32) * capacity, jnp.minimum(count, capacity)
    points = box.PointLists(x.T.reshape(-1), y.T.reshape(-1), start, listed, capacity)
    return points, jnp.max(count)


def trace_hulls(
    xy: jax.Array, index: jax.Array, num_clusters: jax.Array, config: DetectorConfig
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Hulls of the clusters whose points (M, C) are listed, see `hull.convex_hulls`."""

    def trace(index: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        # Stored, or each of the hulls' steps that read them would look them up.
        x, y = store([jnp.take(xy[:, axis], index, mode="clip") for axis in (0, 1)])
        return hull.convex_hulls(x, y, index < xy.shape[0], max_vertices=config.hull.max_vertices)

    return map_rows(trace, index, num_rows=num_clusters, chunk=HULL_CHUNK, axis=-1)


def _slab_points(
    obstacles: Obstacles, proposals: Proposals, config: DetectorConfig
) -> tuple[box.PointLists, jax.Array]:
    """The points of each cluster between the slab's heights, or all where those are few."""
    num_maps = proposals.cluster.shape[0]
    capacity = num_maps * max_slab_points(obstacles.num_rows, config)
    cluster, row, num = _list_points(obstacles, proposals, proposals.fitted, capacity)
    lists = box.list_points(
        cluster,
        row,
        num,
        obstacles.xy,
        num_clusters=proposals.num_points.shape[0],
        max_points=config.box.max_points,
    )
    return lists, jnp.int32(0)


def _list_points(
    obstacles: Obstacles, proposals: Proposals, listed: jax.Array, capacity: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The points (maps, O) of all maps that are to be listed, in one list without gaps.

    Returns:
      cluster: (capacity,) int32.
      row: (capacity,) int32 of the obstacle.
      num: () int32; only the first so many count.
    """
    num_maps, num_obstacles = proposals.cluster.shape
    entry, num = compact(listed, capacity, num=obstacles.count)
    # The remainder by the number of obstacles, without the division.
    maps_before = [(entry >= num_obstacles * i).astype(jnp.int32) for i in range(1, num_maps)]
    row = entry - num_obstacles * sum(maps_before)
    return jnp.take(proposals.cluster.reshape(-1), entry, mode="clip"), row, num


def max_slab_points(capacity: int, config: DetectorConfig) -> int:
    """Capacity for the points that boxes are fitted to, from that of the cloud unless it is set."""
    return config.box.max_slab_points or -(-capacity // 4)


def build_evidence(sweep: Sweep, heights: Heights, config: DetectorConfig) -> evidence.Evidence | None:
    """What the beams saw, or None where the preset does not ask."""
    if not config.evidence.enabled:
        return None
    sensor_height = -heights.plane.coefficients[2]
    return evidence.build_evidence(
        sweep.xyz, heights.height, sweep.inlier, sensor_height, **stage_options(config.evidence, "enabled")
    )


def complete_boxes(
    fits: Fits, proposals: Proposals, seen: evidence.Evidence | None, config: DetectorConfig
) -> tuple[Trials, Boxes, jax.Array]:
    """The completed box of every trial, with the scene's direction preferred where the preset asks.

    Last, how many assignments the evidence had to weigh, which completion.max_assignments must hold.
    """
    preference = jnp.zeros(config.box.num_angles, jnp.float32)
    if config.box.scene_direction and seen is not None:
        preference = _scene_preference(fits, proposals, seen, config)
    readings = [best_rectangles(fits, proposals.num_clusters, preference)]
    if config.box.scene_direction and config.completion.along_scene:
        readings.append(best_rectangles(fits, proposals.num_clusters, preference, INSISTENCE))
    trials = list_trials(proposals, readings, config)
    return trials, *complete_trials(trials, readings, fits.points, seen, config)


def _scene_preference(
    fits: Fits, proposals: Proposals, seen: evidence.Evidence, config: DetectorConfig
) -> jax.Array:
    """The direction that the first map's boxes, fitted without a preference, vote for."""
    settings = config.box
    size = config.clustering.maps[0].max_clusters
    # Stored: what the compiler knows to be zeros would have kernels of its own.
    no_preference = store(jnp.zeros(settings.num_angles, jnp.float32))
    rectangles = best_rectangles(fits, proposals.num_clusters, no_preference)
    rectangles = Rectangles(rectangles.rows[:size])
    long = longest_side(rectangles) >= settings.direction_min_extent_m
    cluster, num = compact(long & (jnp.arange(size, dtype=jnp.int32) < proposals.num_first), size)
    voters = Rectangles(take(rectangles.rows, cluster))

    def complete(voter: Rectangles) -> Boxes:
        """Both ways that it may lie, completed away from the sensor."""
        ways = completion.way_to_lie(voter, jnp.arange(completion.NUM_WAYS, dtype=jnp.int32)[:, None])
        car = jnp.full_like(ways.yaw, Label.CAR, jnp.int32)
        boxes = completion.extend_away(ways, **_class_options(car, config), **_limits(car, config))
        return jax.tree.map(lambda a: jnp.moveaxis(a, 0, 1), boxes)

    boxes = map_rows(complete, voters, num_rows=num)
    one_list = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), boxes)
    rays = cast_rays(one_list, num * completion.NUM_WAYS, seen, config)
    free_length = rays.free_length.reshape(boxes.objective.shape)
    free = jnp.min(jnp.where(boxes.objective > NOT_A_BOX, free_length, jnp.inf), axis=1)
    return box.scene_preference(
        voters.angle,
        longest_side(voters),
        take(proposals.num_points, cluster),
        (jnp.arange(size, dtype=jnp.int32) < num) & (free <= settings.direction_max_free),
        num_angles=settings.num_angles,
        weight=settings.direction_weight,
        sigma_deg=settings.direction_sigma_deg,
    )


def _limits(label: jax.Array, config: DetectorConfig) -> dict[str, jax.Array]:
    return {name: class_values(config, name, label) for name in ("max_length_m", "max_width_m")}


def _usual_size(label: jax.Array, config: DetectorConfig) -> dict[str, jax.Array]:
    return {name: class_values(config, name, label) for name in ("length_m", "width_m")}


def _class_options(label: jax.Array, config: DetectorConfig) -> dict[str, jax.Array]:
    """What `completion.likely_sizes` asks for."""
    return _usual_size(label, config) | _fields(config.completion, _SIDE_FIELDS)


def complete_trials(
    trials: Trials,
    readings: Sequence[Rectangles],
    points: box.PointLists,
    seen: evidence.Evidence | None,
    config: DetectorConfig,
) -> tuple[Boxes, jax.Array]:
    """The box (Q,) of each trial that there is, of those that the readings of its cluster allow.

    And how many assignments the evidence had to weigh.
    """
    if config.completion.mode == "evidence":
        assert seen is not None  # see check_settings
        return _complete_by_evidence(trials, readings, points, seen, config)

    def complete(rows: tuple[jax.Array, jax.Array]) -> Boxes:
        cluster, label = rows
        limits = _limits(label, config)
        longer = completion.longer_side(Rectangles(take(readings[0].rows, cluster)))
        if config.completion.mode == "none":
            return completion.keep_measured(longer, **limits)
        return completion.extend_away(longer, **_class_options(label, config), **limits)

    return map_rows(complete, (trials.cluster, trials.label), num_rows=trials.num), jnp.int32(0)


def _complete_by_evidence(
    trials: Trials,
    readings: Sequence[Rectangles],
    points: box.PointLists,
    seen: evidence.Evidence,
    config: DetectorConfig,
) -> tuple[Boxes, jax.Array]:
    placement, objective, num_assignments = _judge_ways(trials, readings, points, seen, config)

    def complete(of_trial: tuple[jax.Array, ...]) -> Boxes:
        cluster, label, placement, objective = of_trial
        best = jax.lax.argmax(objective, 1, jnp.int32)
        placement, objective = (
            jnp.take_along_axis(a, best[:, None], axis=1)[:, 0] for a in (placement, objective)
        )
        way = _way(readings, best, cluster)
        sizes = completion.likely_sizes(way, **_class_options(label, config))
        return completion.place(way, sizes, placement, objective)

    rows = trials.cluster, trials.label, placement, objective
    return map_rows(complete, rows, num_rows=trials.num), num_assignments


def _way(readings: Sequence[Rectangles], way: jax.Array, cluster: jax.Array) -> completion.Ways:
    """A way of some reading of each cluster, by its number: both of the first reading, then of the second."""
    number, side = split_index(way, completion.NUM_WAYS)
    rows = take(readings[0].rows, cluster)
    for i, rectangles in enumerate(readings[1:], start=1):
        rows = jnp.where(number[:, None] == i, take(rectangles.rows, cluster), rows)
    return completion.way_to_lie(Rectangles(rows), side)


def _judge_ways(
    trials: Trials,
    readings: Sequence[Rectangles],
    points: box.PointLists,
    seen: evidence.Evidence,
    config: DetectorConfig,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The best placement of each way of each trial, and its J: (Q, W) each; how many ways are possible."""
    settings = config.completion
    num_ways = completion.NUM_WAYS * len(readings)
    entry, num = _largest_first(trials, readings, points, config)
    num_entries, entry = entry.shape[0], entry[: settings.max_assignments]

    def prepare(entry: jax.Array) -> tuple[completion.Hypotheses, jax.Array, jax.Array]:
        trial, number = split_index(entry, num_ways)
        cluster, label = take(trials.cluster, trial), take(trials.label, trial)
        way = _way(readings, number, cluster)
        return completion.hypotheses(way, **_usual_size(label, config)), way.worth, cluster

    def judge(rows: tuple[completion.Hypotheses, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        boxes, worth, cluster = rows
        rays = _cast(boxes, settings.num_rays, seen, config)
        agreement = completion.point_agreement(
            boxes, *points.table(cluster), **_fields(settings, _POINT_FIELDS)
        )
        return completion.choose_placement(
            worth,
            agreement,
            hit=rays.hit,
            free=rays.free,
            free_length=rays.free_length,
            **_fields(settings, _OBJECTIVE_FIELDS),
        )

    def note(tables: Any, _: jax.Array, rows: tuple[jax.Array, ...]) -> Any:
        entry, *found = rows
        return tuple(a.at[entry].set(value, mode="drop") for a, value in zip(tables, found, strict=True))

    prepared = map_rows(prepare, entry, num_rows=num)
    judged = map_rows(judge, prepared, num_rows=num, chunk=PROPOSAL_CHUNK)
    nothing = jnp.zeros(num_entries, jnp.int32), jnp.full(num_entries, NOT_A_BOX, jnp.float32)
    of_entry = fold_rows(note, nothing, (entry, *judged), num_rows=num, absent=(num_entries, 0, 0.0))
    placement, objective = (a.reshape(-1, num_ways) for a in of_entry)
    return placement, objective, num


def _largest_first(
    trials: Trials, readings: Sequence[Rectangles], points: box.PointLists, config: DetectorConfig
) -> tuple[jax.Array, jax.Array]:
    """The possible ways of all trials, those of trials with many points first; their number.

    A loop over the points of a chunk of them ends with the largest: so like sizes belong together.
    """
    sides = [jnp.int32(side) for side in range(completion.NUM_WAYS)]

    def rank(rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        cluster, label = rows
        first, *others = (Rectangles(take(rectangles.rows, cluster)) for rectangles in readings)
        limits = _limits(label, config)
        # A second reading at the angle of the first has nothing to add.
        new = [jnp.ones_like(first.angle, bool), *(other.angle != first.angle for other in others)]
        possible = [
            is_new & completion.fits(completion.way_to_lie(rectangle, side), **limits)
            for rectangle, is_new in zip((first, *others), new, strict=True)
            for side in sides
        ]
        missing = points.max_points - jnp.minimum(take(points.total, cluster), points.max_points)
        return jnp.where(jnp.stack(possible, axis=1), missing[:, None], points.max_points)

    ranks = map_rows(rank, (trials.cluster, trials.label), num_rows=trials.num)
    num_entries = trials.num * ranks.shape[1]
    entry, begin, _ = sort_by_group(lambda i: i, ranks.reshape(-1), num_entries, points.max_points + 1)
    # Clusters have points, so that only what is not possible comes last.
    return entry, begin[points.max_points]


_SIDE_FIELDS = ("seen_length", "seen_width", "seen_weight", "length_margin_m", "width_margin_m")
_POINT_FIELDS = ("inside_weight", "near_weight")
_OBJECTIVE_FIELDS = ("free_weight", "free_length_weight", "closeness_weight", "not_away_cost")


def _fields(settings: CompletionConfig, names: Sequence[str]) -> dict[str, Any]:
    return {name: getattr(settings, name) for name in names}


def _cast(
    boxes: Boxes | completion.Hypotheses, num_rays: int, seen: evidence.Evidence, config: DetectorConfig
) -> evidence.RayFractions:
    return evidence.cast_rays(
        seen,
        boxes.center,
        boxes.length,
        boxes.width,
        boxes.yaw,
        num_rays=num_rays,
        range_cell_m=config.evidence.range_cell_m,
    )


def cast_rays(
    boxes: Boxes, num: jax.Array, seen: evidence.Evidence, config: DetectorConfig
) -> evidence.RayFractions:
    """What the rays over each box met, finely enough for its score."""
    cast = functools.partial(_cast, num_rays=config.completion.num_final_rays, seen=seen, config=config)
    return map_rows(cast, boxes, num_rows=num, chunk=RAY_CHUNK)
