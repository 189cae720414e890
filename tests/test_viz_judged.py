"""Pictures of evaluated frames: each label and detection is in its group, and every tile in its place."""

import jax.numpy as jnp
import numpy as np
import pytest
from kitti_objects import car

from jaxbox import viz
from jaxbox.evaluation.matching import Selection, select
from jaxbox.types import Calibration
from jaxbox.viz.colors import ESTIMATE, FALSE_ALARM, IGNORED, LOOSE, MISS, TRUTH
from jaxbox.viz.contact_sheet import GAP_PX, HEADER_PX
from jaxbox.viz.judged import FALSE, FOUND, IGNORED_LABEL, LABEL, LOOSE_BOX, MISSED, NOT_JUDGED, STRIP_PX

CAMERA = Calibration(
    P_rect=jnp.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]]),
    T_rect_velo=jnp.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
    image_size_px=jnp.array([1200, 360]),
)
HARD = Selection(difficulty="hard")


def grouped(labels, results, *, min_score=0.2, num_points=None):
    points = None if num_points is None else {"a": np.array(num_points)}
    (scene,) = select({"a": labels}, {"a": results}, HARD, num_points=points)
    groups = viz.group_by_verdict(scene, labels, results, CAMERA, min_score=min_score)
    return {group.name: group.boxes for group in groups if len(group.boxes)}


def left_of(boxes):
    """y of the boxes in the sensor frame: minus what `car` was told for `right`."""
    return boxes.center[:, 1].round(6).tolist()


def test_a_found_label_and_its_box_are_shown_with_their_overlaps():
    groups = grouped([car(right=3.0)], [car(right=3.0, score=0.9)])
    assert groups.keys() == {FOUND, LABEL}
    assert groups[FOUND].captions == ("1.00/1.00",)
    assert left_of(groups[FOUND]) == left_of(groups[LABEL]) == [-3.0]


def test_a_box_that_fits_badly_is_loose_and_a_bad_height_shows_in_3d_only():
    groups = grouped([car()], [car(score=0.9, height=1.0)])
    assert groups.keys() == {LOOSE_BOX, LABEL}
    assert groups[LOOSE_BOX].captions == ("0.67/1.00",)


def test_a_missed_label_is_marked_missed_with_its_points():
    groups = grouped([car(), car(right=10.0)], [car(score=0.9)], num_points=[99, 12])
    assert left_of(groups[MISSED]) == [-10.0]
    assert groups[MISSED].captions == ("12 pts",)
    assert FALSE not in groups


@pytest.mark.parametrize(
    ("box", "caption"),
    [
        ({"score": 0.9, "type": "Van"}, "7 pts, van 0.90"),
        ({"score": 0.1}, "7 pts, car 0.10"),
        ({"score": 0.9, "type": "Van", "right": 3.0}, "7 pts"),
    ],
)
def test_a_missed_label_says_which_box_stands_there(box, caption):
    groups = grouped([car()], [car(**box)], num_points=[7])
    assert groups[MISSED].captions == (caption,)


def test_a_false_alarm_is_marked_false_with_its_score():
    groups = grouped([], [car(right=-4.0, score=0.45)])
    assert groups.keys() == {FALSE}
    assert groups[FALSE].captions == ("0.45",)


def test_a_box_on_too_little_of_a_label_is_false_and_the_label_missed():
    assert grouped([car()], [car(forward=17.0, score=0.9)]).keys() == {FALSE, MISSED}


@pytest.mark.parametrize(
    ("label", "box"),
    [
        ({"type": "Van"}, {}),
        ({"occlusion": 3}, {}),
        ({"box_px": np.array([600.0, 170, 700, 190])}, {}),
    ],
    ids=["van", "too hidden", "too small"],
)
def test_an_ignored_label_and_the_box_on_it_are_grey(label, box):
    groups = grouped([car(**label)], [car(score=0.9, **box)])
    assert groups.keys() == {IGNORED_LABEL, NOT_JUDGED}
    assert grouped([car(**label)], []).keys() == {IGNORED_LABEL}


def test_boxes_in_dont_care_regions_too_small_or_of_another_class_are_grey():
    region = car(
        type="DontCare", length=-1.0, width=-1.0, height=-1.0, location=np.full(3, -1000.0)
    )  # the region covers the default car's 2D box
    assert grouped([region], [car(score=0.9)]).keys() == {NOT_JUDGED}
    low = car(score=0.9, box_px=np.array([0.0, 0, 50, 20]))
    assert grouped([], [low]).keys() == {NOT_JUDGED}
    assert grouped([], [car(score=0.9, type="Truck")])[NOT_JUDGED].captions == ("truck 0.90",)


def test_boxes_below_the_cut_and_other_objects_are_not_shown():
    labels, results = [car(type="Pedestrian")], [car(score=0.19), car(score=0.19, type="Van")]
    assert grouped(labels, results) == {}
    assert grouped(labels, results, min_score=0.1).keys() == {FALSE, NOT_JUDGED}


def every_kind():
    """A frame with each group once, all of it in the picture."""
    labels = [car(), car(right=5.0), car(right=-5.0), car(right=9.0, type="Van")]
    results = [car(score=0.9), car(right=5.8, score=0.8), car(right=-9.0, score=0.7)]
    (scene,) = select({"a": labels}, {"a": results}, HARD)
    return viz.group_by_verdict(scene, labels, results, CAMERA)


def judged_frame(*, image):
    xyz = np.array([[10.0, 0, -1.7], [np.nan, 0, 0]])
    regions = np.array([[20.0, 20, 60, 40]])
    return viz.JudgedFrame(
        name="a", xyz=xyz, groups=every_kind(), calibration=CAMERA, image=image, regions_px=regions
    )


def shows(picture, color):
    """Whether a color occurs, a little dimmed where an anti-aliased line is thin."""
    return bool((np.abs(picture.astype(int) - color).max(axis=-1) < 30).any())


def test_the_summary_counts_the_groups():
    assert judged_frame(image=None).summary == "a: 1 found, 1 loose, 1 missed, 1 false"


@pytest.mark.parametrize("width_px", [600, 1200])
def test_every_kind_has_its_color_in_the_image_and_from_above(width_px):
    image = np.full((360, 1200, 3), 90, np.uint8)
    with_image = viz.draw_judged_frame(judged_frame(image=image), width_px=width_px, legend=False)
    without = viz.draw_judged_frame(judged_frame(image=None), width_px=width_px, legend=False)
    image_px = round(360 * width_px / 1200)
    assert with_image.shape == (without.shape[0] + image_px, width_px, 3)
    kinds = (ESTIMATE, LOOSE, TRUTH, MISS, FALSE_ALARM, IGNORED)
    above, ahead = with_image[-without.shape[0] + STRIP_PX :], with_image[STRIP_PX : STRIP_PX + image_px]
    np.testing.assert_array_equal(above, without[STRIP_PX:])
    assert [color for color in kinds if not shows(above, color)] == []
    assert [color for color in kinds if not shows(ahead, color)] == []
    assert (image == 90).all(), "the image is not drawn on in place"


def test_a_sheet_holds_each_tile_at_its_place():
    tiles = [np.full((20, 30, 3), 40 * i + 30, np.uint8) for i in range(5)]
    sheet = viz.make_contact_sheet(tiles, num_columns=2)
    assert sheet.shape == (3 * (20 + GAP_PX) + GAP_PX + HEADER_PX, 2 * (30 + GAP_PX) + GAP_PX, 3)
    for index, tile in enumerate(tiles):
        top = HEADER_PX + GAP_PX + index // 2 * (20 + GAP_PX)
        left = GAP_PX + index % 2 * (30 + GAP_PX)
        np.testing.assert_array_equal(sheet[top : top + 20, left : left + 30], tile)


def test_a_lower_tile_stands_at_the_bottom_of_its_row():
    sheet = viz.make_contact_sheet([np.full((20, 9, 3), 200, np.uint8), np.full((8, 9, 3), 250, np.uint8)])
    rows, _ = np.nonzero((sheet == 250).all(axis=-1))
    high, _ = np.nonzero((sheet == 200).all(axis=-1))
    assert rows.max() == high.max()
    assert len(np.unique(rows)) == 8


@pytest.mark.parametrize(("tiles", "num_columns"), [([], 4), ([np.zeros((2, 2, 3), np.uint8)], 0)])
def test_a_sheet_of_nothing_is_refused(tiles, num_columns):
    with pytest.raises(ValueError, match="at least 1"):
        viz.make_contact_sheet(tiles, num_columns=num_columns)
