"""Laws of the synthetic scenes: exact truth, physical occlusion, stated noise, and repeatability."""

import dataclasses
import functools

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from jaxbox.synthetic import (
    Clutter,
    Scene,
    Vehicle,
    ground_only_sweep,
    make_calibration,
    make_scene,
    make_sweep,
    make_terrain,
    no_ground_sweep,
    one_wall_sweep,
    render_image,
    scan,
)
from jaxbox.synthetic.camera import pixel_rays
from jaxbox.synthetic.scene import Thing, draw_size, vehicle_pose
from jaxbox.synthetic.solids import Foliage, Material, make_solid, vehicle_solids
from jaxbox.synthetic.sweep import beam_directions
from jaxbox.types import Calibration, Label

SEEDS = range(4)
GROUNDS = ("flat", "sloped", "uneven")
TRUTH = Scene(make_terrain(np.random.default_rng(0)))
quick_scan = functools.partial(scan, num_azimuths=500)
CAR = Vehicle(Label.CAR, (15.0, 0.0), 0.3, (3.9, 1.63, 1.5), (0.5, 0.5, 0.5))
sweep_of = functools.cache(functools.partial(make_sweep, num_azimuths=500))
exact_sweep_of = functools.cache(functools.partial(make_sweep, num_azimuths=500, range_noise_m=0.0))


def in_box_frame(sweep, index):
    """Points of a vehicle in its box's frame: along, across and above the middle of its box."""
    points = sweep.xyz[sweep.object_id == index].astype(np.float64) - sweep.boxes.center[index]
    c, s = np.cos(sweep.boxes.yaw[index]), np.sin(sweep.boxes.yaw[index])
    return np.column_stack([points[:, :2] @ np.array([[c, -s], [s, c]]), points[:, 2]])


def reach(solid, direction, extra=None):
    """Largest direction . p over a solid: a linear programme, apart from any ray. -inf where empty."""
    rows, bounds = solid.normals, solid.offsets
    if extra is not None:
        rows, bounds = np.vstack([rows, extra[0]]), np.append(bounds, extra[1])
    result = linprog(-np.asarray(direction, float), rows, bounds, bounds=[(None, None)] * 3)
    return -result.fun if result.success else -np.inf


def test_the_same_seed_gives_the_same_bits():
    first, second = make_sweep(3, num_azimuths=200), make_sweep(3, num_azimuths=200)
    for name in ("xyz", "intensity", "object_id", "is_ground"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()
    for field in dataclasses.fields(first.boxes):
        assert getattr(first.boxes, field.name).tobytes() == getattr(second.boxes, field.name).tobytes()


def test_another_seed_gives_another_street():
    assert not np.array_equal(sweep_of(0).boxes.center, sweep_of(1).boxes.center)


def test_the_sensor_does_not_change_the_street():
    coarse, fine = make_sweep(2, num_beams=8, num_azimuths=50, dropout=0.5), sweep_of(2)
    np.testing.assert_array_equal(coarse.boxes.center, fine.boxes.center)


@pytest.mark.parametrize("seed", SEEDS)
def test_fields_have_one_entry_a_point_and_their_stated_types(seed):
    sweep = sweep_of(seed)
    n = len(sweep.xyz)
    assert sweep.xyz.shape == (n, 3)
    assert sweep.xyz.dtype == np.float32
    assert sweep.intensity.shape == sweep.object_id.shape == sweep.is_ground.shape == (n,)
    assert sweep.intensity.min() >= 0
    assert sweep.intensity.max() <= 1
    assert np.isfinite(sweep.xyz).all()
    assert set(np.unique(sweep.object_id[sweep.object_id < 0])) <= {int(code) for code in Clutter}
    np.testing.assert_array_equal(sweep.is_ground, sweep.object_id == -1)


@pytest.mark.parametrize("seed", SEEDS)
def test_truth_counts_the_points_of_each_vehicle(seed):
    sweep = sweep_of(seed)
    counts = [(sweep.object_id == i).sum() for i in range(len(sweep.boxes))]
    np.testing.assert_array_equal(sweep.boxes.num_points, counts)
    assert len(sweep.boxes) == 12
    assert (sweep.object_id < 12).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_truth_boxes_keep_the_project_s_conventions(seed):
    boxes = sweep_of(seed).boxes
    assert (boxes.size[:, 0] >= boxes.size[:, 1]).all()
    assert (boxes.yaw >= -np.pi / 2).all()
    assert (boxes.yaw < np.pi / 2).all()
    assert ((boxes.visible >= 0) & (boxes.visible <= 1)).all()
    assert set(boxes.label) <= {0, 1, 2}
    ranges = np.hypot(*boxes.center[:, :2].T)
    assert ranges.min() >= 5
    assert ranges.max() <= 55


@pytest.mark.parametrize("seed", SEEDS)
def test_vehicles_never_overlap(seed):
    boxes = make_scene(seed, num_vehicles=25).vehicles
    rectangles = [(v.xy, v.size[:2], np.degrees(v.heading)) for v in boxes]
    for i, first in enumerate(rectangles):
        for second in rectangles[:i]:
            assert cv2.rotatedRectangleIntersection(first, second)[0] == cv2.INTERSECT_NONE


def test_most_vehicles_hold_enough_points_to_be_found():
    # These sweeps have a quarter of the sensor's firings.
    counts = 4 * np.concatenate([sweep_of(seed).boxes.num_points for seed in SEEDS])
    assert np.mean(counts >= 30) > 0.8


def test_all_classes_occur_and_cars_are_most_common():
    labels = np.concatenate(
        [[v.label for v in make_scene(seed, clutter=False).vehicles] for seed in range(40)]
    )
    shares = np.bincount(labels, minlength=3) / len(labels)
    assert shares[Label.CAR] > 0.7
    assert (shares > 0.01).all()


def test_car_sizes_have_the_benchmark_s_median_and_spread():
    rng = np.random.default_rng(0)
    sizes = np.array([draw_size(rng, Label.CAR) for _ in range(4000)])
    np.testing.assert_allclose(np.median(sizes, axis=0), (3.88, 1.63, 1.50), rtol=0.01)
    np.testing.assert_allclose(np.quantile(sizes, 0.05, axis=0), (3.20, 1.47, 1.36), rtol=0.02)
    np.testing.assert_allclose(np.quantile(sizes, 0.95, axis=0), (4.52, 1.80, 1.78), rtol=0.02)


@pytest.mark.parametrize("label", Label)
def test_vehicle_geometry_reaches_every_face_of_its_box_and_no_farther(label):
    rng = np.random.default_rng(int(label))
    for _ in range(3):
        length, width, height = draw_size(rng, label)
        solids = vehicle_solids(label, (length, width, height))
        faces = {(1, 0, 0): length / 2, (-1, 0, 0): length / 2, (0, 1, 0): width / 2, (0, -1, 0): width / 2}
        faces |= {(0, 0, 1): height, (0, 0, -1): 0.0}
        for direction, expected in faces.items():
            farthest = max(reach(solid, direction) for solid in solids)
            assert farthest == pytest.approx(expected, abs=1e-6)


def test_a_car_s_cabin_is_narrower_and_shorter_than_its_body():
    solids = vehicle_solids(Label.CAR, (3.9, 1.63, 1.5))
    above = ((0.0, 0.0, -1.0), -1.3)
    assert max(reach(s, (0, 1, 0), above) for s in solids) < 1.63 / 2 - 0.1
    assert max(reach(s, (1, 0, 0), above) for s in solids) < 3.9 / 2 - 1.0


@pytest.mark.parametrize("seed", SEEDS)
def test_exact_points_of_a_vehicle_lie_within_its_box(seed):
    sweep = exact_sweep_of(seed)
    for i in range(len(sweep.boxes)):
        local = in_box_frame(sweep, i)
        assert (np.abs(local) <= sweep.boxes.size[i] / 2 + 1e-3).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_noisy_points_of_a_vehicle_lie_within_its_box_but_for_the_noise(seed):
    sweep = sweep_of(seed)
    for i in range(len(sweep.boxes)):
        assert (np.abs(in_box_frame(sweep, i)) <= sweep.boxes.size[i] / 2 + 6 * 0.02).all()


@pytest.mark.parametrize("ground", ["sloped", "uneven"])
@pytest.mark.parametrize("seed", SEEDS)
def test_on_a_slope_outlines_stay_exact_and_heights_follow_the_ground(seed, ground):
    sweep = exact_sweep_of(seed, ground=ground, slope_deg=8.0)
    for i, vehicle in enumerate(sweep.scene.vehicles):
        size, local = sweep.boxes.size[i], in_box_frame(sweep, i)
        assert (np.abs(local[:, :2]) <= size[:2] / 2 + 1e-3).all()
        linear, foot = vehicle_pose(vehicle, sweep.scene.terrain)
        points = sweep.xyz[sweep.object_id == i] - foot
        above = (points @ np.linalg.inv(linear).T)[:, 2]
        assert ((above >= -1e-3) & (above <= size[2] + 1e-3)).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_opaque_stands_between_the_sensor_and_a_point(seed):
    sweep = exact_sweep_of(seed, ground="uneven")
    rng = np.random.default_rng(seed)
    # Up to 2 cm before the point, in steps far smaller than a wheel.
    points = sweep.xyz[rng.choice(len(sweep.xyz), 100)].astype(np.float64)
    shares = 1 - 0.02 / np.linalg.norm(points, axis=1)
    walk = (np.linspace(0, 1, 400)[:, None] * shares)[..., None] * points
    solids = [s for thing in sweep.scene.things() for s in thing.shapes if not isinstance(s, Foliage)]
    for solid in (s for s in solids if Material.GLASS not in s.materials):
        inside = (walk @ solid.normals.T < solid.offsets - 0.01).all(axis=-1)
        assert not inside.any()
    assert (walk[..., 2] > sweep.scene.terrain.height(walk[..., 0], walk[..., 1]) - 0.02).all()


def test_a_wall_in_front_of_a_car_leaves_it_no_point():
    wall = Thing(int(Clutter.WALL), (make_solid((8, -9, -2), (8.3, 9, 3), material=Material.WALL),))
    alone = quick_scan(dataclasses.replace(TRUTH, vehicles=(CAR,)))
    hidden = quick_scan(dataclasses.replace(TRUTH, vehicles=(CAR,), clutter=(wall,)))
    assert alone.boxes.visible[0] == 1
    assert alone.boxes.num_points[0] > 100
    assert hidden.boxes.visible[0] == 0
    assert hidden.boxes.num_points[0] == 0
    assert (hidden.object_id == Clutter.WALL).sum() > 1000


def test_a_wall_behind_a_car_hides_nothing_of_it():
    wall = Thing(int(Clutter.WALL), (make_solid((20, -9, -2), (20.3, 9, 3), material=Material.WALL),))
    sweep = quick_scan(dataclasses.replace(TRUTH, vehicles=(CAR,), clutter=(wall,)))
    assert sweep.boxes.visible[0] == 1


def test_half_a_car_is_visible_past_the_edge_of_a_wall():
    car = dataclasses.replace(CAR, heading=0.0)
    wall = Thing(int(Clutter.WALL), (make_solid((8, 0, -2), (8.3, 9, 3), material=Material.WALL),))
    sweep = scan(dataclasses.replace(TRUTH, vehicles=(car,), clutter=(wall,)))
    assert sweep.boxes.visible[0] == pytest.approx(0.5, abs=0.05)
    assert (sweep.xyz[sweep.object_id == 0][:, 1] < 0.05).all()


@pytest.mark.parametrize("draw", [0.0, 0.99])
def test_glass_reflects_or_lets_a_beam_through(draw):
    pane = make_solid((5, -1, -1), (6, 1, 1), material=Material.GLASS)
    distance, material, normal = pane.first_hit(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), np.array([draw]))
    if draw > 0.5:
        assert np.isinf(distance[0])
    else:
        assert distance[0] == pytest.approx(5)
        assert material[0] == Material.GLASS
        np.testing.assert_array_equal(normal[0], (-1, 0, 0))


def test_foliage_is_met_within_its_ellipsoid_at_varied_depths():
    bush = Foliage(np.array([10.0, 0, 0]), np.array([0.5, 2.0, 1.0]))
    draws = np.random.default_rng(0).random(500)
    distance = bush.first_hit(np.zeros((1, 3)), np.tile([1.0, 0, 0], (500, 1)), draws)[0]
    hit = np.isfinite(distance)
    assert ((distance[hit] >= 9.5) & (distance[hit] <= 10.5)).all()
    assert distance[hit].std() > 0.1
    assert 0 < (~hit).sum() < 50


@pytest.mark.parametrize("kerb", [False, True])
@pytest.mark.parametrize("ground", GROUNDS)
def test_ground_points_lie_on_the_height_function_and_all_others_above_it(ground, kerb):
    sweep = exact_sweep_of(1, ground=ground, kerb=kerb)
    x, y, z = sweep.xyz.astype(np.float64).T
    above = z - sweep.scene.terrain.height(x, y)
    # A kerb's face is steep: there 1 mm along the beam is 3 mm in height.
    assert np.abs(above[sweep.is_ground]).max() < (5e-3 if kerb else 1e-3)
    assert above[~sweep.is_ground].min() > -0.01
    assert 0.3 < sweep.is_ground.mean() < 0.9


@pytest.mark.parametrize("ground", GROUNDS)
def test_the_sensor_stands_at_its_height_above_the_ground(ground):
    terrain = make_terrain(np.random.default_rng(4), ground=ground)
    assert terrain.height(np.zeros(1), np.zeros(1))[0] == pytest.approx(-1.73)


@pytest.mark.parametrize(("slope_deg", "azimuth_deg"), [(0.0, 0.0), (3.0, 0.0), (-5.0, 0.0), (8.0, 60.0)])
def test_a_plane_through_sloped_ground_has_the_slope_asked_for(slope_deg, azimuth_deg):
    sweep = make_sweep(
        0,
        num_vehicles=0,
        clutter=False,
        num_azimuths=500,
        ground="sloped",
        slope_deg=slope_deg,
        slope_azimuth_deg=azimuth_deg,
    )
    x, y, z = sweep.xyz.astype(np.float64).T
    a, b, c = np.linalg.lstsq(np.column_stack([x, y, np.ones_like(x)]), z, rcond=None)[0]
    rise, azimuth = np.tan(np.radians(slope_deg)), np.radians(azimuth_deg)
    np.testing.assert_allclose((a, b), (rise * np.cos(azimuth), rise * np.sin(azimuth)), atol=1e-3)
    assert c == pytest.approx(-1.73, abs=5e-3)


@pytest.mark.parametrize("seed", [0, 1])
def test_uneven_ground_is_no_plane(seed):
    x, y, z = ground_only_sweep(seed, ground="uneven").xyz.astype(np.float64).T
    system = np.column_stack([x, y, np.ones_like(x)])
    residual = z - system @ np.linalg.lstsq(system, z, rcond=None)[0]
    assert np.abs(residual).max() > 0.2


def test_a_kerb_raises_the_sidewalk_by_its_height():
    terrain = make_terrain(np.random.default_rng(0), kerb=True)
    inside, outside = terrain.road.to_xy(np.array([10.0, 10.0]), np.array([5.6, 5.8]))
    assert terrain.height(*outside) - terrain.height(*inside) == pytest.approx(0.12)


@pytest.mark.parametrize("num_beams", [16, 32, 64])
def test_points_lie_on_the_sensor_s_beams_and_firings(num_beams):
    sweep = make_sweep(0, num_beams=num_beams, num_azimuths=360)
    x, y, z = sweep.xyz.astype(np.float64).T
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    beams = np.unique(np.degrees(np.arcsin(beam_directions(num_beams, 1)[:, 2])))
    assert len(beams) == num_beams
    nearest = np.abs(elevation[:, None] - beams)
    assert nearest.min(axis=1).max() < 1e-3
    assert len(np.unique(nearest.argmin(axis=1))) == num_beams
    firing = np.degrees(np.arctan2(y, x))
    assert np.abs(firing - np.round(firing)).max() < 1e-3


def test_beams_span_the_sensor_s_field_of_view_from_the_top():
    elevation = np.degrees(np.arcsin(beam_directions(64, 1)[:, 2]))
    assert (np.diff(elevation) < 0).all()
    np.testing.assert_allclose(elevation[[0, 31, 32, 63]], (2.0, -8.33, -8.83, -24.33))


@pytest.mark.parametrize("noise_m", [0.005, 0.02, 0.05])
def test_range_noise_has_the_stated_deviation_and_no_bias(noise_m):
    sweep = make_sweep(0, num_vehicles=0, clutter=False, num_azimuths=1000, range_noise_m=noise_m)
    measured = np.linalg.norm(sweep.xyz.astype(np.float64), axis=1)
    # The direction is exact, so the true range to flat ground follows from it.
    true = 1.73 / -(sweep.xyz[:, 2] / measured)
    residual = (measured - true)[true < 30]
    assert residual.std() == pytest.approx(noise_m, rel=0.02)
    assert abs(residual.mean()) < 5 * noise_m / np.sqrt(len(residual))


@pytest.mark.parametrize("dropout", [0.0, 0.03, 0.5])
def test_the_stated_share_of_strong_returns_is_dropped(dropout):
    wall = Thing(int(Clutter.WALL), (make_solid((10, -20, -6), (11, 20, 6), material=Material.WALL),))
    scene = Scene(make_terrain(np.random.default_rng(0), ground="none"), clutter=(wall,))
    sweep = scan(scene, dropout=dropout)
    azimuth = np.arctan2(sweep.xyz[:, 1], sweep.xyz[:, 0])
    kept = (np.abs(azimuth) < np.radians(45)).sum() / (64 * 499)
    assert kept == pytest.approx(1 - dropout, abs=0.012)


def test_far_and_grazing_returns_are_lost_more_often():
    ranges = np.hypot(*ground_only_sweep().xyz[:, :2].T)
    # The ring of each beam holds 2000 firings; the flat ground's rings lie at 1.73 / tan(elevation).
    radius = 1.73 / np.tan(-np.radians(np.interp([10, 40], [0, 31, 32, 63], [2, -8.33, -8.83, -24.33])))
    far, near = ((np.abs(ranges - r) < 0.15).sum() / 2000 for r in radius)
    assert near > 0.95
    assert far < near - 0.02


def test_degenerate_sweeps_hold_what_they_say():
    ground, floating, wall = ground_only_sweep(), no_ground_sweep(), one_wall_sweep(distance_m=12.0)
    assert ground.is_ground.all()
    assert len(ground.boxes) == 0
    assert ground.boxes.center.shape == (0, 3)
    assert not floating.is_ground.any()
    assert (floating.boxes.num_points > 0).sum() > 5
    assert (wall.object_id == Clutter.WALL).all()
    assert np.abs(wall.xyz[:, 0] - 12).max() < 0.15
    assert min(len(ground.xyz), len(floating.xyz), len(wall.xyz)) > 5000


def test_a_sweep_whose_returns_are_all_dropped_is_empty():
    sweep = make_sweep(0, num_azimuths=50, dropout=1.0)
    assert sweep.xyz.shape == (0, 3)
    assert (sweep.boxes.num_points == 0).all()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"num_vehicles": 500}, "found room"),
        ({"num_vehicles": -1}, "num_vehicles"),
        ({"ground": "hilly"}, "hilly"),
        ({"ground": "sloped", "slope_deg": 40.0}, "slope_deg"),
        ({"num_beams": 0}, "num_beams"),
        ({"num_azimuths": 0}, "num_azimuths"),
        ({"range_noise_m": -0.1}, "range_noise_m"),
        ({"dropout": 1.5}, "dropout"),
    ],
)
def test_an_option_out_of_range_is_named(options, named):
    with pytest.raises(ValueError, match=named):
        make_sweep(0, **options)


def to_pixels(calibration, xyz):
    """Pixels and depth of points, by the pinhole model written out."""
    homogeneous = np.column_stack([xyz, np.ones(len(xyz))])
    u, v, depth = np.asarray(calibration.P_rect) @ np.asarray(calibration.T_rect_velo) @ homogeneous.T
    return np.column_stack([u / depth, v / depth]), depth


def small_camera(factor=8):
    """The synthetic camera with 1/factor of its resolution."""
    full = make_calibration()
    scale = np.diag([1 / factor, 1 / factor, 1]).astype(np.float32)
    size = np.asarray(full.image_size_px) // factor
    return Calibration(jnp.asarray(scale @ np.asarray(full.P_rect)), full.T_rect_velo, jnp.asarray(size))


def test_the_camera_frame_is_rigid_and_looks_along_x():
    T = np.asarray(make_calibration().T_rect_velo, np.float64)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.linalg.det(T) == pytest.approx(1, abs=1e-6)
    (middle, left, up), depth = to_pixels(
        make_calibration(), np.array([[20.0, 0, 0], [20, 3, 0], [20, 0, 2]])
    )
    assert (depth > 19).all()
    assert left[0] < middle[0]
    assert up[1] < middle[1]


def test_the_ray_of_a_pixel_projects_back_to_it():
    calibration = make_calibration()
    origin, directions = pixel_rays(calibration)
    rows = np.random.default_rng(0).choice(len(directions), 200)
    uv, depth = to_pixels(calibration, origin + 25 * directions[rows])
    assert (depth > 0).all()
    np.testing.assert_allclose(uv, np.column_stack([rows % 1242, rows // 1242]), atol=0.05)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_projected_truth_box_frames_the_projected_points_of_its_vehicle(seed):
    sweep = exact_sweep_of(seed)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T / 2
    framed = 0
    for i in range(len(sweep.boxes)):
        c, s = np.cos(sweep.boxes.yaw[i]), np.sin(sweep.boxes.yaw[i])
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        corners, depth = to_pixels(
            sweep.calibration, sweep.boxes.center[i] + signs * sweep.boxes.size[i] @ turn
        )
        if depth.min() < 1:
            continue
        uv, _ = to_pixels(sweep.calibration, sweep.xyz[sweep.object_id == i])
        assert ((uv >= corners.min(axis=0) - 0.5) & (uv <= corners.max(axis=0) + 0.5)).all()
        framed += len(uv) > 0
    assert framed >= 3


def test_the_picture_shows_a_vehicle_where_its_points_project():
    camera = small_camera()
    with_car = render_image(dataclasses.replace(TRUTH, vehicles=(CAR,)), camera)
    without = render_image(TRUTH, camera)
    assert with_car.shape == (46, 155, 3)
    assert with_car.dtype == np.uint8
    sweep = scan(dataclasses.replace(TRUTH, vehicles=(CAR,)), range_noise_m=0.0)
    changed = (with_car != without).any(axis=-1)
    columns, rows = np.round(to_pixels(camera, sweep.xyz[sweep.object_id == 0])[0]).astype(int).T
    assert changed[rows, columns].mean() > 0.95
    assert 0.002 < changed.mean() < 0.1


def test_a_sweep_carries_a_picture_only_when_asked(monkeypatch):
    monkeypatch.setattr("jaxbox.synthetic.sweep.make_calibration", small_camera)
    assert make_sweep(0, num_azimuths=50).image is None
    image = make_sweep(0, num_azimuths=50, image=True).image
    assert image.shape == (46, 155, 3)
    np.testing.assert_array_equal(image, make_sweep(0, num_azimuths=50, image=True).image)
