"""Front and back: parity with the reference, the law of the turned box, and real cars."""

import jax
import jax.numpy as jnp
import numpy as np
import parity
import pytest

from jaxbox import Label, PointCloud, detect, io, reference
from jaxbox.evaluation.iou import pairwise_overlaps
from jaxbox.stages import fronts
from jaxbox.stages.state import Kept, Obstacles, Owners

NUM_POINTS, NUM_BOXES, NUM_VALID = 6000, 12, 9
MIN_POINTS = 100

find_fronts = parity.PerForm(fronts.find_fronts)


def car_profile(share):
    """Height of a car's top, as a share of its own, at shares of its length from rear to front."""
    profile = Label.CAR.front_profile
    return np.interp(share, (np.arange(len(profile)) + 0.5) / len(profile), profile)


def scene(seed):
    """Detections and points on them: (xy, height, owner), and the boxes, in NumPy."""
    rng = np.random.default_rng(seed)
    yaw = rng.uniform(-np.pi / 2, np.pi / 2, NUM_BOXES)
    size = rng.uniform([3, 1.5, 1.0], [6, 2.2, 2.4], (NUM_BOXES, 3))
    center = rng.uniform(-40, 40, (NUM_BOXES, 3))
    # Rows beyond those that count hold other points; one box has hardly any.
    owner = rng.integers(0, NUM_VALID + 1, NUM_POINTS)
    owner = np.where(owner == NUM_VALID, NUM_BOXES, owner)
    owner[owner == 3] = np.where(np.arange((owner == 3).sum()) < 4, 3, NUM_BOXES)
    box = np.minimum(owner, NUM_BOXES - 1)
    share, aside = rng.uniform(-0.5, 0.5, (2, NUM_POINTS))
    front = np.where(rng.random(NUM_BOXES) < 0.5, 1, -1)
    top = size[box, 2] * car_profile(0.5 + front[box] * share)
    cos, sin = np.cos(yaw[box]), np.sin(yaw[box])
    u, v = share * size[box, 0], aside * size[box, 1]
    xy = np.stack([cos * u - sin * v, sin * u + cos * v], axis=1) + center[box, :2]
    height = top * rng.uniform(0.2, 1.05, NUM_POINTS)
    label = rng.integers(0, len(Label), NUM_BOXES)
    return xy, height, owner, center, size, yaw, label, front


def kept_of(center, size, yaw, label):
    rows = [np.asarray(a, np.float32) for a in (center, size, yaw)]
    valid = np.arange(NUM_BOXES) < NUM_VALID
    zeros = np.zeros(NUM_BOXES, np.float32)
    return jax.tree.map(
        jnp.asarray,
        Kept(
            *rows,
            score=zeros,
            label=np.asarray(label, np.int32),
            cluster=np.zeros(NUM_BOXES, np.int32),
            frame=np.zeros((NUM_BOXES, 6), np.float32),
            valid=valid,
            num=np.int32(NUM_VALID),
        ),
    )


def operands(seed, *, rows=None, **fields):
    """What the stage takes of a scene, with its points in any order and some boxes changed."""
    xy, height, owner, center, size, yaw, label, _ = scene(seed)
    box = {"center": center, "size": size, "yaw": yaw, "label": label} | fields
    row = np.arange(NUM_POINTS, dtype=np.int32) if rows is None else rows
    num = jnp.int32(NUM_POINTS - 500)
    obstacles = Obstacles(
        jnp.arange(NUM_POINTS),
        jnp.asarray(xy, jnp.float32),
        jnp.zeros(NUM_POINTS, jnp.float32),
        jnp.asarray(height, jnp.float32),
        jnp.int32(NUM_POINTS),
        NUM_POINTS,
    )
    return Owners(jnp.asarray(row), jnp.asarray(owner[row], jnp.int32), num), obstacles, kept_of(**box)


@pytest.mark.parametrize("seed", range(5))
def test_fronts_are_those_of_the_reference(platform, seed):
    xy, height, owner, center, size, yaw, label, _ = scene(seed)
    heading, probability = find_fronts(*operands(seed))
    mine = [np.flatnonzero(owner[: NUM_POINTS - 500] == k) for k in range(NUM_BOXES)]
    boxes = np.column_stack([center[:, :2], size[:, :2], yaw])
    expected = reference.find_fronts(
        [xy[rows] for rows in mine], [height[rows] for rows in mine], boxes, size[:, 2], label
    )
    np.testing.assert_allclose(probability, expected[1], atol=1e-4)
    np.testing.assert_allclose(np.cos(heading - expected[0]), 1, atol=1e-6)
    assert (np.abs(heading) <= np.float32(np.pi)).all()


def test_fronts_are_found_where_they_are_and_not_where_nothing_tells():
    *_, label, front = scene(0)
    cars = np.zeros_like(label)
    heading, probability = jax.jit(fronts.find_fronts)(*operands(0, label=cars))
    yaw = scene(0)[5]
    told = (np.arange(NUM_BOXES) < NUM_VALID) & (np.arange(NUM_BOXES) != 3)
    assert (probability[told] > 0.8).all()
    np.testing.assert_allclose(np.cos(heading - yaw)[told], front[told], atol=1e-5)
    # Without points, and of classes that look alike from both ends, nothing is known, and the yaw stays.
    trucks = jax.jit(fronts.find_fronts)(*operands(0, label=cars + Label.TRUCK))
    for angle, likely, rows in ((heading, probability, ~told), (*trucks, np.ones(NUM_BOXES, bool))):
        np.testing.assert_array_equal(likely[rows], 0.5)
        np.testing.assert_array_equal(angle[rows], np.float32(yaw)[rows])


@pytest.mark.parametrize("seed", range(3))
def test_half_a_turn_of_the_box_and_another_order_of_its_points_change_nothing(seed):
    rows = np.arange(NUM_POINTS, dtype=np.int32)
    counted = rows[: NUM_POINTS - 500]
    np.random.default_rng(seed).shuffle(counted)
    # Sure ones: a box whose points do not tell keeps its yaw, whichever end that is.
    run = jax.jit(fronts.find_fronts)
    heading, probability = run(*operands(seed))
    turned, likely = run(*operands(seed, rows=rows, yaw=scene(seed)[5] + np.pi))
    np.testing.assert_allclose(likely, probability, atol=1e-3)
    sure = probability > 0.51
    np.testing.assert_allclose(np.cos(turned - heading)[sure], 1, atol=1e-6)


def test_the_fronts_of_real_cars_are_found(data_root):
    root = data_root / "kitti_object" / "training"
    right = []
    for path in sorted((root / "velodyne").glob("*.bin")):
        points = np.fromfile(path, np.float32).reshape(-1, 4)
        found = detect(PointCloud.from_numpy(points[:, :3], points[:, 3], capacity=2**17)).on_host()
        labels = io.read_labels(root / "label_2" / f"{path.stem}.txt")
        cars = [label for label in labels if label.type == "Car"]
        calibration = io.read_calibration(root / "calib" / f"{path.stem}.txt")
        center, size, heading = io.boxes_from_objects(cars, calibration, keep_heading=True)
        boxes = np.column_stack([found.center, found.size, found.yaw]).astype(float)
        overlap, _ = pairwise_overlaps(np.column_stack([center, size, heading]), boxes)
        for car, row in zip(*np.nonzero(overlap > 0.5), strict=True):
            if found.num_points[row] >= MIN_POINTS and found.score[row] > 0.1:
                right.append(np.cos(found.heading[row] - heading[car]) > 0)
    assert len(right) >= 30
    assert np.mean(right) > 0.9
