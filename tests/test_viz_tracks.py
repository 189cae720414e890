"""Pictures of tracks and videos: what is drawn, where, and in which colour."""

import types

import cv2
import numpy as np

from jaxbox.viz import BirdEyeFrame, color_by_id, draw_tracks, open_video
from jaxbox.viz.tracks import track_groups


def make_tracks(**fields):
    """Three tracks: one seen and moving, one hidden lately, one hidden for long."""
    defaults = {
        "id": [4, 5, 6], "valid": [True] * 3, "confirmed": [True] * 3, "score": [0.9, 0.8, 0.7],
        "age": [5, 10, 30], "hits": [5, 8, 3], "sight": [0, 1, 1], "motion": [2, 0, 2],
        "center": [[10, 0, -1], [20, 10, -1], [30, -10, -1]], "size": [[4, 2, 1.5]] * 3,
        "heading": [0.0, 0.0, 0.0], "front_probability": [0.9, 0.5, 0.5],
        "velocity": [[10.0, 0], [0, 0], [30, 0]],
    }  # fmt: skip
    return types.SimpleNamespace(**{k: np.array(v) for k, v in (defaults | fields).items()})


def test_tracks_are_captioned_by_id_state_and_speed_and_old_guesses_are_left_out():
    groups = track_groups(make_tracks())
    captions = [group.boxes.captions[0] for group in groups]
    assert captions == ["4 moving 10 m/s", "5 standing (hidden)"]
    assert [group.thickness_px for group in groups] == [2, 1]
    assert groups[0].color == tuple(color_by_id(np.array([4]))[0].tolist())
    assert track_groups(make_tracks(confirmed=[False] * 3)) == []
    assert [group.name for group in track_groups(make_tracks(), min_score=0.85)] == ["4"]


def test_a_track_is_drawn_where_it_is_with_its_trail_and_its_arrow():
    color = np.array(color_by_id(np.array([4]))[0])
    frame = BirdEyeFrame()

    def has_color(picture, place):
        column, row = np.round(frame.to_pixels(np.array(place))).astype(int)
        near = picture[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3).astype(int)
        return np.abs(near - color).sum(axis=1).min() < 60

    trail = {4: np.array([[0.0, 5, 0], [5, 5, 0], [10, 0, 0]])}
    bare = draw_tracks(np.zeros((0, 3)), make_tracks(motion=[0, 0, 0]))
    drawn = draw_tracks(np.zeros((0, 3)), make_tracks(), trails=trail)
    assert has_color(bare, [12, 1])
    assert has_color(drawn, [12, 1])
    assert has_color(drawn, [2.5, 5])
    assert has_color(drawn, [20, 0])
    assert not has_color(bare, [2.5, 5])
    assert not has_color(bare, [20, 0])
    assert has_color(drawn, [11, 0.5]), "the line before the front"
    assert not has_color(draw_tracks(np.zeros((0, 3)), make_tracks(heading=[np.pi] * 3)), [11, 0.5])


def test_a_video_keeps_its_first_size_and_one_without_pictures_is_not_written(tmp_path):
    with open_video(tmp_path / "none.mp4", rate_hz=10):
        pass
    assert list(tmp_path.iterdir()) == []
    with open_video(tmp_path / "a.mp4", rate_hz=20) as write:
        for shape in ((41, 61, 3), (41, 61, 3), (20, 90, 3)):
            write(np.full(shape, 200, np.uint8))
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    pictures = []
    while (read := video.read())[0]:
        pictures.append(read[1])
    assert [picture.shape for picture in pictures] == [(40, 60, 3)] * 3
    assert pictures[1].min() > 180
    assert pictures[2][:16].min() > 150 > 60 > pictures[2][24:].max()
