"""Laws of detect(): one trace, padding, batches, symmetry, bounds. Bad input has tests of its own."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import parity
import pytest
from native_loops import count_loops, loops_of

from jaxbox import DetectorConfig, PointCloud, Status, detect, stack_clouds, synthetic
from jaxbox.config import BoxConfig, EvidenceConfig
from jaxbox.config.fields import replace_fields
from jaxbox.geometry.planar import rectangle_iou
from jaxbox.io import open_sweeps
from jaxbox.run import compiled
from jaxbox.xla import backend
from quality import bad_input

CAPACITY = 2**14
SEEDS = range(5)
GOOD_SCORE = 0.2
"""Boxes that a user would act on; the others may come and go with the order of the points."""
SAME_IOU, SAME_SIZE_M, SAME_YAW = 0.75, (0.6, 0.15), np.radians(3)
"""What counts as the same box: grids and samples of points fall otherwise when the sweep is turned, and a
point more or less can decide whether a side was seen whole, and so its length."""

iou = jax.jit(jax.vmap(jax.vmap(rectangle_iou, (None, 0)), (0, None)))


@functools.cache
def street(seed):
    """About 15,500 points round the sensor, and twelve vehicles."""
    return synthetic.make_sweep(seed, num_beams=32, num_azimuths=520)


def run(xyz, *, capacity=CAPACITY, config=None, key=None):
    cloud = PointCloud.from_numpy(np.asarray(xyz, np.float32), capacity=capacity)
    return jax.device_get(detect(cloud, config, key))


@functools.cache
def found(seed):
    return run(street(seed).xyz)


def rectangles(detections, least_score=0.0):
    rows = np.column_stack([detections.center[:, :2], detections.size[:, :2], detections.yaw])
    return rows[detections.valid & (detections.score > least_score)].astype(np.float32)


def assert_same_bits(one, other):
    chex.assert_trees_all_equal(jax.tree.leaves(one), jax.tree.leaves(other))


def assert_well_formed(detections, xyz, capacity=CAPACITY):
    """What holds of every answer, whatever the sweep."""
    assert bad_input.broken_laws(detections, xyz, capacity, DetectorConfig()) == []


# One trace.


def allow_traces(monkeypatch, num):
    """Has the pipeline refuse to be traced once more often."""
    chex.clear_trace_counter()
    limited = chex.assert_max_traces(compiled.find_vehicles, n=num)
    monkeypatch.setattr(compiled, "find_vehicles", limited)


def test_one_trace_serves_sweeps_of_any_length_and_any_thresholds_and_keys(monkeypatch):
    xyz = street(0).xyz
    run(xyz)
    allow_traces(monkeypatch, 0)
    num_compiled = compiled.count_compilations()
    for length in (0, 1, 777, len(xyz), CAPACITY + 5):
        run(np.resize(xyz, (length, 3)))
    number_types = (lambda v: 1.1 * v, lambda v: int(v) + 1, np.float32, np.float64, np.asarray)
    for seed, convert in enumerate(number_types):
        run(xyz, config=jax.tree.map(convert, DetectorConfig()), key=jax.random.key(seed))
    assert compiled.count_compilations() == num_compiled
    with pytest.raises(AssertionError, match="traced > 0 times"):
        run(xyz, capacity=CAPACITY + 1)


def test_a_length_that_nothing_shows_costs_its_share_of_the_score_and_one_that_is_seen_nothing():
    shares, lengths = [], []
    for seed in SEEDS:
        one, other = (
            run(
                street(seed).xyz, config=replace_fields(DetectorConfig(), {"vehicles.hidden_length_score": s})
            )
            for s in (1.0, 0.5)
        )
        scores = {box.tobytes(): score for box, score in zip(rectangles(one), one.score, strict=False)}
        for box, score, label in zip(rectangles(other), other.score, other.label, strict=False):
            if label == 0 and box.tobytes() in scores:
                shares.append(score / scores[box.tobytes()])
                lengths.append(box[2])
    shares, lengths = np.array(shares), np.array(lengths)
    usual_m = DetectorConfig().vehicles.classes[0].length_m
    # A car whose length nothing shows has the usual one; one that is much longer was measured so.
    hidden, measured = shares < 0.5 + 1e-5, lengths > 1.1 * usual_m
    assert (shares > 0.5 - 1e-5).all()
    assert (shares < 1 + 1e-5).all()
    assert min(hidden.sum(), measured.sum()) > 5
    np.testing.assert_allclose(lengths[hidden], usual_m, atol=1e-5)
    np.testing.assert_allclose(shares[measured], 1, atol=1e-5)


def test_one_trace_serves_all_real_sweeps(data_root, monkeypatch):
    folders = ("kitti_object/training", "pandaset", "argoverse2", "kitti_tracking/training")
    sweeps = [sweep for folder in folders for sweep in open_sweeps(data_root / folder)]
    allow_traces(monkeypatch, 1)
    lengths = set()
    for sweep in sweeps[:23] + sweeps[23::8]:
        xyz = sweep.read_points()[0]
        lengths.add(len(xyz))
        assert_well_formed(run(xyz, capacity=2**17), xyz, 2**17)
    assert len(lengths) > 20


def test_a_cloud_that_was_put_on_the_device_is_nothing_to_compile_for_and_has_the_same_bits():
    expected, events = found(0), []
    cloud = jax.device_put(PointCloud.from_numpy(street(0).xyz, capacity=CAPACITY))

    def listen(event, *_, **__):
        events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        detections = detect(cloud)
        jax.jit(lambda x: x + 2.5)(1.0)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert_same_bits(jax.device_get(detections), expected)
    assert sum("backend_compile" in event for event in events) == 1  # that of the line after detect


def test_nothing_calls_back_to_the_host():
    cloud = PointCloud.from_numpy(street(0).xyz, capacity=CAPACITY)
    assert "callback" not in str(jax.make_jaxpr(detect)(cloud))


# The same answer.


@pytest.mark.codegen
@pytest.mark.parametrize("preset", DetectorConfig.presets().values())
def test_thresholds_go_in_as_one_array_that_native_loops_cut_up(preset):
    settings = compiled.PackedConfig.pack(preset, accelerator=False)
    unpack = jax.jit(compiled.PackedConfig.unpack)
    assert unpack(settings) == jax.tree.map(jnp.float32, preset)
    num_loops, num_native = count_loops(unpack, settings)
    assert num_native == num_loops > 1


@pytest.mark.codegen
@pytest.mark.parametrize(
    ("preset", "most"), parity.slow_but_first([("default", 41), ("fast", 41), ("paper", 22)])
)
def test_a_cpu_runs_no_more_loops_operation_by_operation(preset, most):
    # A loop over rows whose step grows is native code no longer, and says so by nothing but its time.
    cloud = PointCloud.from_numpy(np.zeros((1, 3), np.float32), capacity=2**17)
    with jax.default_device("cpu"):
        num_loops, num_native = loops_of(compiled.lower(cloud, preset))
    assert num_native <= num_loops <= num_native + most


def test_the_same_key_gives_the_same_bits_and_none_is_key_zero():
    assert_same_bits(run(street(0).xyz, key=jax.random.key(0)), found(0))
    assert_same_bits(run(street(0).xyz), found(0))


@pytest.mark.parametrize("seed", SEEDS)
def test_twice_the_padding_gives_the_same_boxes_bit_for_bit(seed):
    wide, narrow = run(street(seed).xyz, capacity=2 * CAPACITY), found(seed)
    for name in (
        "center",
        "size",
        "yaw",
        "score",
        "label",
        "valid",
        "num_points",
        "ground",
        "status",
        "counts",
    ):
        assert_same_bits(getattr(wide, name), getattr(narrow, name))
    for name in ("ground_mask", "point_component", "point_detection"):
        np.testing.assert_array_equal(getattr(wide, name)[:CAPACITY], getattr(narrow, name))
    # The extremes of a hull are compared in fewer bits where there are more points: a slice wide.
    slice_m = narrow.size[:, :1].max() / DetectorConfig().hull.num_slices
    np.testing.assert_allclose(wide.hulls.vertices, narrow.hulls.vertices, atol=slice_m)


def test_a_batch_of_sweeps_thresholds_and_keys_gives_the_bits_of_the_singles():
    sweeps = [street(0).xyz, np.zeros((0, 3)), street(1).xyz, street(0).xyz]
    scales = (1.0, 0.8, 1.2, 0.9)
    configs = [jax.tree.map(lambda v, s=scale: s * v, DetectorConfig()) for scale in scales]
    keys = jax.random.split(jax.random.key(3), len(scales))
    clouds = stack_clouds([PointCloud.from_numpy(xyz, capacity=CAPACITY) for xyz in sweeps])
    batch = jax.tree.map(lambda *values: jnp.array(values), *configs)
    many = jax.device_get(jax.vmap(detect)(clouds, batch, keys))
    for row, (xyz, config, key) in enumerate(zip(sweeps, configs, keys, strict=True)):
        single = run(xyz, config=config, key=key)
        assert_same_bits(jax.tree.map(lambda leaf, row=row: leaf[row], many), single)
    assert len({row.tobytes() for row in many.score}) == len(sweeps)


def test_a_batch_of_clouds_alone_has_the_shapes_of_the_singles_and_an_axis_more():
    clouds = stack_clouds([PointCloud.from_numpy(street(seed).xyz, capacity=CAPACITY) for seed in (0, 1)])
    assert_shapes_of_singles(jax.eval_shape(jax.vmap(detect), clouds), 2)


def assert_shapes_of_singles(batch, size):
    def with_axis(single):
        return jax.ShapeDtypeStruct((size, *single.shape), single.dtype)

    chex.assert_trees_all_equal_shapes_and_dtypes(batch, jax.tree.map(with_axis, found(0)))


def batch_anew(clouds, **options):
    """A batch of clouds by a program of its own: tests that change how it is built leave nothing behind."""
    find = jax.jit(jax.vmap(compiled._find, (0, None, None)), **options)
    return find, compiled._operands(clouds, None, None)


@pytest.mark.slow
def test_a_batch_on_an_accelerator_finds_what_the_singles_do_on_a_cpu_in_their_shapes():
    sweeps = [street(0).xyz, np.zeros((0, 3)), street(1).xyz]
    clouds = stack_clouds([PointCloud.from_numpy(xyz, capacity=CAPACITY) for xyz in sweeps])
    # Run here, where it is slower: all sweeps at once, and each loop in its form for accelerators.
    with backend.building_for(accelerator=True):
        find, operands = batch_anew(clouds, compiler_options=parity.UNOPTIMISED)
        many = jax.device_get(find(*operands))
    assert_shapes_of_singles(many, len(sweeps))
    for row, xyz in enumerate(sweeps):
        single = run(xyz)
        # Rounded otherwise, so that a point on a border may fall to the other side of it, and one piece of a
        # wall, which scores next to nothing, is as close to the next rotation.
        of_row = jax.tree.map(lambda a, row=row: a[row], many)
        boxes = [np.column_stack([f.center, f.size, f.yaw]) for f in (of_row, single)]
        differ = (np.abs(boxes[0] - boxes[1]) > 1e-4).any(axis=1)
        assert differ.sum() <= 1
        assert (single.score[differ] < 1e-3).all()
        np.testing.assert_allclose(many.score[row], single.score, atol=1e-4)
        for name in ("label", "valid", "status"):
            np.testing.assert_array_equal(getattr(many, name)[row], getattr(single, name))
        for name in ("ground_mask", "point_component", "point_detection"):
            assert np.mean(getattr(many, name)[row] != getattr(single, name)) < 1e-3
    assert len({row.tobytes() for row in many.score}) == len(sweeps)


@pytest.mark.parametrize(
    ("accelerator", "flags", "together"),
    [(False, "", False), (True, "", True), (True, "--xla_gpu_deterministic_ops=true", False)],
)
def test_only_an_accelerator_takes_a_batch_at_once_and_not_where_scatters_are_ordered(
    accelerator, flags, together, monkeypatch
):
    monkeypatch.setenv("XLA_FLAGS", flags)
    monkeypatch.setattr(compiled, "_one_after_the_other", lambda a, _, b: a + b)
    monkeypatch.setattr(compiled, "_find_vehicles", lambda a, _, b: a - b)
    a, b = jnp.arange(3.0), jnp.float32(2)
    settings = compiled.PackedConfig.pack(DetectorConfig(), accelerator=accelerator)
    found, batched = compiled._find_many(3, (True, False, False), a, settings, b)
    assert batched
    np.testing.assert_array_equal(found, a - b if together else a + b)


def test_assignments_beyond_their_capacity_are_counted_and_the_largest_clusters_are_kept():
    full, few = found(0), 24
    completion = dataclasses.replace(DetectorConfig().completion, max_assignments=few)
    cut = run(street(0).xyz, config=dataclasses.replace(DetectorConfig(), completion=completion))
    needed = int(full.counts.assignments)
    assert int(full.status) == 0
    assert few < needed == int(cut.counts.assignments) < DetectorConfig().completion.max_assignments
    assert Status(int(cut.status)) == Status.ASSIGNMENT_OVERFLOW
    with pytest.raises(RuntimeError, match=rf"completion\.max_assignments must be at least {needed}\."):
        cut.raise_if_failed()
    # Boxes that are still found are those of before, and none of them has fewer points than one that is lost.
    again = {tuple(box) for box in rectangles(cut).tolist()}
    points = np.array(full.num_points[full.valid])
    kept = np.array([tuple(box) in again for box in rectangles(full).tolist()])
    assert 0 < kept.sum() < len(kept)
    assert points[kept].min() > np.median(points[~kept])


# The same boxes.

TURNS = {
    "a quarter turn": [[0, -1], [1, 0]],
    "half a turn": [[-1, 0], [0, -1]],
    "three quarters": [[0, 1], [-1, 0]],
    "left and right swapped": [[1, 0], [0, -1]],
}


def moved(boxes, turn):
    """Boxes in a world that is turned or mirrored."""
    heading = np.column_stack([np.cos(boxes[:, 4]), np.sin(boxes[:, 4])]) @ turn.T
    return np.column_stack([boxes[:, :2] @ turn.T, boxes[:, 2:4], np.arctan2(heading[:, 1], heading[:, 0])])


def assert_all_found_again(boxes, detections):
    candidates = rectangles(detections)
    overlap = np.asarray(iou(boxes.astype(np.float32), candidates))
    again = candidates[overlap.argmax(axis=1)]
    assert (overlap.max(axis=1) > SAME_IOU).all()
    assert (np.abs(again[:, 2:4] - boxes[:, 2:4]) < SAME_SIZE_M).all()
    between = (again[:, 4] - boxes[:, 4] + np.pi / 2) % np.pi - np.pi / 2
    assert (np.abs(between) < SAME_YAW).all()


@pytest.mark.parametrize("name", TURNS)
@pytest.mark.parametrize("seed", SEEDS)
def test_in_a_turned_or_mirrored_world_the_good_boxes_turn_with_it(seed, name):
    xyz, turn = street(seed).xyz, np.array(TURNS[name], np.float32)
    # The region is a rectangle: only what lies within it either way.
    xyz = xyz[np.linalg.norm(xyz[:, :2], axis=1) < DetectorConfig().region.half_y_m - 1]
    straight = rectangles(run(xyz), GOOD_SCORE)
    assert len(straight) > 0
    turned = run(np.column_stack([xyz[:, :2] @ turn.T, xyz[:, 2]]))
    assert_all_found_again(moved(straight, turn), turned)


@pytest.mark.parametrize("seed", SEEDS)
def test_in_any_order_of_the_points_the_boxes_are_the_same(seed):
    shuffled = run(np.random.default_rng(seed).permutation(street(seed).xyz))
    assert np.sum(found(seed).valid) > 10
    for name in ("center", "size", "yaw", "score", "label", "valid"):
        np.testing.assert_allclose(getattr(shuffled, name), getattr(found(seed), name), atol=1e-5)


def test_points_that_are_not_finite_change_no_box():
    xyz = street(0).xyz
    rng = np.random.default_rng(0)
    bad = np.where(rng.random((300, 3)) < 0.5, rng.choice([np.nan, np.inf, -np.inf], (300, 3)), 1).astype(
        np.float32
    )
    bad[:, 0] = np.nan
    rows = np.sort(rng.integers(0, len(xyz), 300))
    with_bad = run(np.insert(xyz, rows, bad, axis=0))
    assert Status(int(with_bad.status)) == Status(int(found(0).status)) | Status.NONFINITE_POINTS
    assert with_bad.counts.nonfinite_points == 300
    for name in ("center", "size", "yaw", "score"):
        np.testing.assert_allclose(getattr(with_bad, name), getattr(found(0), name), atol=1e-4)


@pytest.mark.parametrize("z", [150.0, 1e10, 1e25, 3e38, -1e25])
def test_a_point_out_of_this_world_changes_no_box(z):
    xyz = street(0).xyz
    high = [[5.0, 5.0, 3.5]]
    clean = run(np.concatenate([xyz, high]))
    worse = run(np.concatenate([xyz, high, [[5.0, 5.0, z]]]))
    assert worse.counts.out_of_range_points == clean.counts.out_of_range_points + 1
    for name in ("center", "size", "yaw", "score", "status"):
        assert_same_bits(getattr(worse, name), getattr(clean, name))


# The form of the answer.


@pytest.mark.parametrize("seed", SEEDS)
def test_streets_give_well_formed_answers_with_a_clean_status(seed):
    assert_well_formed(found(seed), street(seed).xyz)
    assert Status(int(found(seed).status)) == Status.OK
    found(seed).raise_if_failed()


def test_the_answer_has_the_documented_shapes_and_types():
    d, config = found(0), DetectorConfig()
    k, h, n, maps = (
        config.vehicles.max_detections,
        config.hull.max_vertices,
        CAPACITY,
        len(config.clustering.maps),
    )
    expected = {
        "center": ((k, 3), "float32"), "size": ((k, 3), "float32"), "yaw": ((k,), "float32"),
        "heading": ((k,), "float32"), "front_probability": ((k,), "float32"),
        "score": ((k,), "float32"), "label": ((k,), "int32"), "valid": ((k,), "bool"),
        "num_points": ((k,), "int32"), "hulls.vertices": ((k, h, 2), "float32"),
        "hulls.num_vertices": ((k,), "int32"), "descriptors.moment_of_inertia": ((k, 2), "float32"),
        "descriptors.eccentricity": ((k,), "float32"), "descriptors.density": ((k,), "float32"),
        "descriptors.complexity": ((k,), "float32"), "ground.coefficients": ((3,), "float32"),
        "ground.found": ((), "bool"), "ground.num_inliers": ((), "int32"), "ground_mask": ((n,), "bool"),
        "point_component": ((n,), "int32"), "point_detection": ((n,), "int32"),
        "first_return_m": ((config.evidence.num_azimuths,), "float32"), "status": ((), "int32"),
        "counts.cells": ((maps,), "int32"), "counts.clusters": ((maps,), "int32"),
    }  # fmt: skip
    for field in dataclasses.fields(d.counts):
        expected.setdefault(f"counts.{field.name}", ((), "int32"))
    paths = jax.tree_util.tree_flatten_with_path(d)[0]
    assert {jax.tree_util.keystr(path)[1:]: (leaf.shape, leaf.dtype) for path, leaf in paths} == expected


@pytest.mark.parametrize("seed", SEEDS)
def test_hulls_turn_left_and_lie_within_their_boxes(seed):
    d = found(seed)
    for row in np.flatnonzero(d.valid):
        hull = d.hulls.vertices[row, : d.hulls.num_vertices[row]].astype(np.float64)
        cos, sin = np.cos(d.yaw[row]), np.sin(d.yaw[row])
        local = (hull - d.center[row, :2]) @ np.array([[cos, -sin], [sin, cos]])
        # A point on the face, give or take a millimetre, is inside; so is float32 at 80 m.
        assert (np.abs(local) <= d.size[row, :2] / 2 + 2e-3).all()
        edge, following = np.roll(hull, -1, 0) - hull, np.roll(hull, -2, 0) - np.roll(hull, -1, 0)
        assert (edge[:, 0] * following[:, 1] - edge[:, 1] * following[:, 0] > -1e-5).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_points_of_a_detection_lie_within_its_box(seed):
    d, xyz = found(seed), street(seed).xyz
    rows = d.point_detection[: len(xyz)]
    assert (d.point_detection[len(xyz) :] == -1).all()
    points, rows = xyz[rows >= 0], rows[rows >= 0]
    offset = points[:, :2] - d.center[rows, :2]
    cos, sin = np.cos(d.yaw[rows]), np.sin(d.yaw[rows])
    local = np.column_stack(
        [offset[:, 0] * cos + offset[:, 1] * sin, offset[:, 1] * cos - offset[:, 0] * sin]
    )
    assert (np.abs(local) <= d.size[rows, :2] / 2 + 2e-3).all()


def test_vehicles_with_many_points_are_found():
    hits, total = 0, 0
    for seed in SEEDS:
        truth = street(seed).boxes
        boxes = np.column_stack([truth.center[:, :2], truth.size[:, :2], truth.yaw])[truth.num_points >= 60]
        overlap = np.asarray(iou(boxes.astype(np.float32), rectangles(found(seed), 0.05)))
        hits, total = hits + (overlap.max(axis=1) > 0.5).sum(), total + len(boxes)
    assert total > 20
    assert hits / total > 0.85


def test_the_ground_is_the_streets():
    for seed in SEEDS:
        sweep, d = street(seed), found(seed)
        mask = d.ground_mask[: len(sweep.xyz)]
        assert bool(d.ground.found)
        assert mask[sweep.is_ground].mean() > 0.99
        assert sweep.is_ground[mask].mean() > 0.9


# Where it is hard.


def test_vehicles_are_found_where_the_ground_returns_nothing():
    sweep = synthetic.no_ground_sweep()
    detections = run(sweep.xyz[::4], capacity=2 * CAPACITY)
    assert rectangles(detections, GOOD_SCORE).shape[0] > 0


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"evidence": EvidenceConfig(enabled=False)}, "evidence.enabled"),
        ({"box": BoxConfig(criterion="area")}, "box.criterion"),
    ],
)
def test_settings_that_contradict_each_other_are_refused_by_name(change, field):
    cloud = PointCloud.from_numpy(np.zeros((1, 3)))
    with pytest.raises(ValueError, match=field):
        detect(cloud, DetectorConfig(**change))
