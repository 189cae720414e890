"""Laws of the pictures: where things land, what colour they have, and that files are whole."""

import builtins

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxbox import viz
from jaxbox.geometry import projection
from jaxbox.io import read_image
from jaxbox.types import Calibration
from jaxbox.viz.boxes import bird_eye_iou, find_matches
from jaxbox.viz.colors import ESTIMATE, FALSE_ALARM, MISS, TRUTH
from jaxbox.viz.perspective import NEAR_M, cut_segments, project, transform
from jaxbox.viz.plots import DIMENSIONS
from jaxbox.viz.verdict import group_boxes

CAR = (4.0, 1.8, 1.5)
CAMERA = Calibration(
    P_rect=jnp.array([[700.0, 0, 600, 40], [0, 700, 180, 0], [0, 0, 1, 0]]),
    T_rect_velo=jnp.array([[0.0, -1, 0, 0], [0, 0, -1, -0.1], [1, 0, 0, -0.3], [0, 0, 0, 1]]),
    image_size_px=jnp.array([1200, 360]),
)


def one_box(center=(20.0, 5.0, -1.0), yaw=0.3, **options):
    return viz.BoxSet(center=[center], size=[CAR], yaw=[yaw], **options)


def count_pixels(picture, color):
    return int((picture == np.array(color)).all(axis=-1).sum())


def test_corners_agree_with_scipy_rotation():
    box = one_box()
    signs = np.array([[x, y] for x, y in [(1, 1), (-1, 1), (-1, -1), (1, -1)]])
    local = np.concatenate([np.c_[signs, np.full(4, z)] for z in (-1, 1)]) * np.array(CAR) / 2
    expected = Rotation.from_euler("z", 0.3).apply(local) + np.array([20.0, 5.0, -1.0])
    np.testing.assert_allclose(box.corners()[0], expected, atol=1e-12)


def test_edges_join_corners_that_differ_in_one_axis():
    lengths = np.linalg.norm(np.diff(one_box().segments()[0], axis=1)[:, 0], axis=-1)
    np.testing.assert_allclose(np.sort(lengths), np.repeat(np.sort(CAR), 4), atol=1e-12)


def test_boxes_with_different_row_counts_are_refused():
    with pytest.raises(ValueError, match="2, 1 and 1 rows"):
        viz.BoxSet(center=np.zeros((2, 3)), size=[CAR], yaw=[0])


def test_bird_eye_puts_forward_right_and_left_up():
    frame = viz.BirdEyeFrame()
    origin, ahead, left = frame.to_pixels(np.array([[0.0, 0], [1, 0], [0, 1]]))
    assert ahead[0] > origin[0]
    assert ahead[1] == origin[1]
    assert left[1] < origin[1]
    assert left[0] == origin[0]


def test_bird_eye_draws_a_point_where_its_frame_says():
    frame = viz.BirdEyeFrame()
    xyz = np.array([[33.0, 12.0, 0.0]])
    red = np.array([[255, 0, 0]], np.uint8)
    column, row = np.floor(frame.to_pixels(xyz)[0]).astype(int)
    picture = viz.draw_bird_eye(xyz, colors=red, frame=frame)
    assert tuple(picture[row, column]) == (255, 0, 0)
    assert count_pixels(picture, (255, 0, 0)) == 4


def test_bird_eye_ignores_points_that_are_not_finite_or_far_away():
    empty = viz.draw_bird_eye(np.zeros((0, 3)))
    wild = viz.draw_bird_eye(np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e30, -1e30, 0], [500, 500, np.nan]]))
    np.testing.assert_array_equal(wild, empty)
    assert empty.shape == (720, 1200, 3)
    assert empty.dtype == np.uint8


def test_box_outline_stays_within_a_line_width_of_its_footprint():
    frame = viz.BirdEyeFrame()
    box = one_box()
    plain = viz.draw_bird_eye(np.zeros((0, 3)), frame=frame)
    drawn = viz.draw_bird_eye(np.zeros((0, 3)), boxes=box, frame=frame)
    legend = 150
    changed = np.argwhere((plain != drawn).any(axis=-1))
    changed = changed[(changed[:, 1] > legend)][:, ::-1]
    outline = frame.to_pixels(box.footprints()[0]).astype(np.float32)
    distances = [abs(cv2.pointPolygonTest(outline, (float(u), float(v)), True)) for u, v in changed]
    assert len(distances) > 50
    assert max(distances) < 3


@pytest.mark.parametrize(
    ("estimate_x", "judged", "expected"),
    [
        (20.2, None, (ESTIMATE, TRUTH)),
        (40.0, None, (FALSE_ALARM, MISS)),
        (40.0, [False], (ESTIMATE, MISS)),
    ],
)
def test_colors_tell_right_wrong_missed_and_unjudged(estimate_x, judged, expected):
    estimate, truth = one_box((estimate_x, 5.0, -1.0)), one_box()
    judged = None if judged is None else np.array(judged)
    groups = group_boxes(estimate, truth, judged)
    assert [group.color for group in groups if len(group.boxes)] == list(expected)


def test_without_truth_nothing_is_marked():
    (group,) = group_boxes(one_box(), None, None)
    assert (group.color, len(group.boxes)) == (ESTIMATE, 1)


def test_a_true_box_is_found_once_and_by_the_best():
    twins = viz.BoxSet(center=[[20, 5, -1]] * 2, size=[CAR] * 2, yaw=[0.3] * 2, rank=np.array([0.2, 0.9]))
    hit, found = find_matches(twins, one_box())
    assert hit.tolist() == [False, True]
    assert found.tolist() == [True]


def test_iou_is_one_on_itself_and_half_shifted_is_a_third():
    box = one_box(yaw=0.0)
    shifted = one_box((20.0 + CAR[0] / 2, 5.0, -1.0), yaw=0.0)
    assert bird_eye_iou(box, box)[0, 0] == pytest.approx(1.0, abs=1e-5)
    assert bird_eye_iou(box, shifted)[0, 0] == pytest.approx(1 / 3, abs=1e-5)


def test_cut_segments_lie_on_the_line_and_in_front():
    rng = np.random.default_rng(0)
    segments = rng.normal(size=(200, 2, 3)) * 5
    cut = cut_segments(segments)
    touched = (segments[..., 2] > NEAR_M).any(axis=1)
    assert len(cut) == touched.sum()
    assert cut[..., 2].min() >= NEAR_M - 1e-12
    direction = np.diff(segments[touched], axis=1)[:, 0]
    offset = cut - segments[touched][:, :1]
    assert np.abs(np.cross(offset, direction[:, None])).max() < 1e-9


def test_image_edges_agree_with_the_projection_stage_where_all_is_ahead():
    box = one_box((15.0, 2.0, -1.0))
    corners = transform(box.corners(), np.asarray(CAMERA.T_rect_velo, np.float64))
    uv = project(corners, np.asarray(CAMERA.P_rect, np.float64))
    expected, _ = projection.project_points(jnp.asarray(box.corners(), jnp.float32), CAMERA)
    np.testing.assert_allclose(uv, expected, atol=0.01)


def test_a_box_behind_the_camera_leaves_the_image_as_it_is():
    image = np.full((360, 1200, 3), 90, np.uint8)
    drawn = viz.draw_image_boxes(image, CAMERA, boxes=one_box((-20.0, 0.0, -1.0)))
    np.testing.assert_array_equal(drawn, image)


def test_a_box_partly_behind_the_camera_is_drawn_and_the_input_is_not_changed():
    image = np.full((360, 1200, 3), 90, np.uint8)
    drawn = viz.draw_image_boxes(image, CAMERA, boxes=one_box((1.5, -2.0, -0.5), yaw=0.0))
    assert count_pixels(drawn, ESTIMATE) > 100
    assert (image == 90).all()


def test_lidar_view_shows_left_boxes_on_the_left():
    left = viz.draw_lidar_view(np.zeros((0, 3)), boxes=one_box((15.0, 8.0, -1.0)))
    columns = np.argwhere((left == np.array(ESTIMATE)).all(axis=-1))[:, 1]
    columns = columns[columns > 150]  # next to the legend
    assert len(columns) > 100
    assert columns.max() < left.shape[1] / 2


def test_colors_are_stable_distinct_and_grey_for_none():
    colors = viz.color_by_id(np.arange(-1, 40))
    assert len(np.unique(colors, axis=0)) == 41
    np.testing.assert_array_equal(viz.color_by_id(np.array([7])), colors[8:9])
    assert viz.color_by_id(np.zeros(0, int)).shape == (0, 3)


def test_height_colors_saturate_and_take_nan():
    colors = viz.color_by_height(np.array([-99.0, -0.3, 3.0, 99.0, np.nan]))
    assert (colors[0] == colors[1]).all()
    assert (colors[2] == colors[3]).all()
    assert (colors[0] != colors[3]).any()


def test_png_keeps_red_red_and_leaves_no_temporary_file(tmp_path):
    picture = np.zeros((4, 5, 3), np.uint8)
    picture[..., 0] = 200
    path = viz.save_png(tmp_path / "new" / "a.png", picture)
    np.testing.assert_array_equal(read_image(path), picture)
    assert [p.name for p in path.parent.iterdir()] == ["a.png"]


@pytest.mark.parametrize(
    "picture",
    [np.zeros((4, 4)), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8), np.zeros((4, 4, 4), np.uint8)],
)
def test_png_refuses_what_is_no_picture(tmp_path, picture):
    with pytest.raises(ValueError, match=r"must be \(h, w, 3\) uint8"):
        viz.save_png(tmp_path / "a.png", picture)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("plot", [viz.plot_dimensions, viz.plot_residuals])
def test_plots_show_each_dimension_and_are_written(tmp_path, plot):
    true = np.array([[4.0, 1.7, 1.5], [4.4, 1.8, 1.6]])
    figure = plot(true - 0.1, true)
    text = " ".join(
        [axes.get_ylabel() for axes in figure.axes]
        + [line.get_text() for axes in figure.axes for line in axes.get_legend().get_texts()]
    )
    assert all(name in text for name in DIMENSIONS)
    path = viz.save_figure(tmp_path / "plot.png", figure)
    assert read_image(path).shape[2] == 3


def test_residual_plot_shows_estimated_minus_true():
    true = np.array([[4.0, 1.7, 1.5]])
    figure = viz.plot_residuals(true - 0.1, true)
    lines = {line.get_label().split(",")[0]: line.get_ydata() for line in figure.axes[0].get_lines()}
    assert lines["length"][0] == pytest.approx(-0.1)


def test_plots_refuse_unpaired_sizes():
    with pytest.raises(ValueError, match="both must be"):
        viz.plot_dimensions(np.zeros((2, 3)), np.zeros((3, 3)))


def test_without_matplotlib_the_error_names_the_extra(monkeypatch):
    real_import = builtins.__import__

    def without_matplotlib(name, *args, **kwargs):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_matplotlib)
    with pytest.raises(ImportError, match=r"pip install 'jaxbox\[plots\]'"):
        viz.plot_residuals(np.zeros((1, 3)), np.zeros((1, 3)))
