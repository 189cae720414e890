"""What people take away of a run, apart from the detector: filters, tables, contact sheets and films."""

import importlib.util
import types

import cv2
import numpy as np
import pytest

from jaxbox import io
from jaxbox.cli.box_filter import BoxFilter, parse_min_score
from jaxbox.cli.run_sheet import NUM_COLUMNS, NUM_TILES, SHEET_NAME, RunSheet
from jaxbox.io import InputError
from jaxbox.io.csv_table import CSV, open_csv
from jaxbox.io.parquet import TRACK_COLUMNS
from jaxbox.io.results import SweepResult
from jaxbox.viz import open_gif, open_video, save_png, video
from jaxbox.viz.contact_sheet import HEADER_PX

BOX = {
    "label": "car", "score": 0.5, "center": [1.0, 2.0, 3.0], "size": [4.0, 2.0, 1.5], "yaw": 0.1,
    "heading": 0.1, "front_probability": 0.5, "num_points": 7,
}  # fmt: skip


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"classes": "car,bus"}, "--classes car,bus: 'bus' is none; choose from"),
        ({"classes": ""}, "'' is none"),
        ({"within": "0"}, "--within 0: give a radius above 0"),
        ({"within": "nan"}, "--within nan: give finite numbers"),
        ({"within": "5,1,-2,2"}, "with each least before its greatest"),
        ({"within": "1,2,3"}, "X_MIN,X_MAX,Y_MIN,Y_MAX"),
        ({"within": "nowhere.txt"}, "--within nowhere.txt: neither numbers nor a file"),
    ],
)
def test_a_filter_that_cannot_be_says_so(options, words):
    with pytest.raises(InputError) as error:
        BoxFilter.chosen(**{"classes": None, "within": None, **options})
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("2", "'2' is no score from 0 to 1"),
        ("nan", "'nan' is no score"),
        ("car", "'car' is no score"),
        ("car=", "'' is no score"),
        ("bus=0.5", "'bus' is no class; choose from car, van, truck"),
        ("car=0.5,cars=0.4", "'cars=0.4' says again"),
        ("0.1,0.2", "'0.2' says again"),
        ("0.1,", "'' is no score"),
        ("=0.5", "'' is no class"),
    ],
)
def test_a_least_score_that_cannot_be_says_so(text, words):
    with pytest.raises(InputError) as error:
        parse_min_score(text)
    assert f"--min-score {text}: " in str(error.value)
    assert words in str(error.value)


def test_a_filter_does_not_change_with_what_it_was_made_of():
    scores = {"van": 0.2}
    keep = BoxFilter.chosen(classes="cars", within="30", min_scores=scores)
    same = BoxFilter.chosen(classes="car", within="30", min_scores=dict(scores))
    scores["van"] = 0.9
    assert keep == same
    assert hash(keep) == hash(same)


def test_a_class_that_is_named_may_have_a_lower_score_than_the_others():
    assert parse_min_score("0.3, Cars = 0.1") == (0.1, {"car": 0.1, "van": 0.3, "truck": 0.3})
    assert parse_min_score("van=0.2") == (0.0, {"car": 0.0, "van": 0.2, "truck": 0.0})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 2\n3 4\n", "area.txt: 2 corners"),
        ("1 2\n3 4 5\n0 0\n", "area.txt, line 2: 3 numbers"),
        ("1 2\n\nx 4\n0 0\n", "area.txt, line 3: x is 'x'"),
    ],
)
def test_a_polygon_that_cannot_be_says_where(tmp_path, text, words):
    (tmp_path / "area.txt").write_text(text)
    with pytest.raises(InputError) as error:
        BoxFilter.chosen(classes=None, within=str(tmp_path / "area.txt"))
    assert words in str(error.value)


def test_a_table_of_another_kind_is_not_continued(tmp_path):
    path = tmp_path / CSV.name
    other = "sweep,label\na,car\n"
    for text, words in ((other, "its columns are not those"), (None, "more or fewer columns")):
        with open_csv(path) as write:
            write(SweepResult(record={"name": "a", "boxes": [BOX]}))
        path.write_text(path.read_text() + "b,car\n" if text is None else text)
        with pytest.raises(InputError, match=words):
            CSV.finished(path)
        with pytest.raises(InputError, match=words), open_csv(path, True):
            pass


def test_an_empty_table_of_tracks_has_its_columns(tmp_path):
    with open_csv(tmp_path / "a.csv", columns=TRACK_COLUMNS):
        pass
    assert (tmp_path / "a.csv").read_text().strip().split(",") == list(TRACK_COLUMNS)


@pytest.mark.parametrize("num_points", [0, 1, 1000])
def test_pcd_is_read_back_bit_by_bit(tmp_path, num_points):
    points = np.random.default_rng(0).normal(0, 50, (num_points, 4)).astype(np.float32)
    io.write_pcd(tmp_path / "a.pcd", points[:, :3], points[:, 3])
    xyz, intensity = io.read_points(tmp_path / "a.pcd")
    np.testing.assert_array_equal(np.column_stack([xyz, intensity]), points)


@pytest.mark.parametrize("num_sweeps", [0, 1, 5, NUM_TILES, 1000])
def test_a_contact_sheet_has_few_sweeps_from_all_over_the_run(tmp_path, num_sweeps):
    names = [f"{number:04d}" for number in range(num_sweeps)]
    sweeps = [types.SimpleNamespace(name=name) for name in names]
    sheet = RunSheet(tmp_path, sweeps, shown=True)
    assert len(sheet.tiles) == min(num_sweeps, NUM_TILES)
    if num_sweeps:
        chosen = list(map(int, sheet.tiles))
        assert (chosen[0], chosen[-1]) == (0, num_sweeps - 1)
        assert np.ptp(np.diff(chosen)) <= 1 if len(chosen) > 1 else True
    for row, path in enumerate(sheet.tiles.values()):
        save_png(path, np.full((30, 40, 3), row, np.uint8))
        sheet.write(min_score=0.2, is_complete=False)
    # What resumes the run has the pictures of the run before.
    RunSheet(tmp_path, sweeps, shown=True).write(min_score=0.2, is_complete=True)
    names = [SHEET_NAME] if num_sweeps else []
    assert [path.name for path in tmp_path.iterdir()] == names
    assert RunSheet(tmp_path, sweeps, shown=False).tiles == {}
    if num_sweeps:
        sheet = io.read_image(tmp_path / SHEET_NAME)
        places = [divmod(row, NUM_COLUMNS) for row in range(len(chosen))]
        middles = [sheet[HEADER_PX + y * 36 + 20, 6 + x * 46 + 20, 0] for y, x in places]
        assert middles == list(range(len(chosen)))


def read_film(path):
    film, pictures = cv2.VideoCapture(str(path)), []
    while (read := film.read())[0]:
        pictures.append(read[1])
    return film, pictures


@pytest.mark.parametrize("has_encoder", [True, False])
def test_a_video_is_h264_with_the_extra_and_mpeg4_without(tmp_path, monkeypatch, has_encoder):
    if has_encoder:
        pytest.importorskip("imageio_ffmpeg")
    else:
        monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with open_video(tmp_path / "a.mp4", rate_hz=12.5) as add:
        for value in (250, 250, 10):
            add(np.full((41, 61, 3), value, np.uint8))
    film, pictures = read_film(tmp_path / "a.mp4")
    code = int(film.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little")
    assert code == (b"h264" if has_encoder else b"FMP4")
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5)
    assert [picture.shape for picture in pictures] == [(40, 60, 3)] * 3
    assert pictures[0].min() > 200
    assert pictures[2].max() < 60


def test_a_gif_keeps_flat_colours_and_its_size(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    pictures = np.zeros((4, 31, 45, 3), np.uint8)
    for index, color in enumerate([(255, 0, 0), (0, 200, 30), (20, 30, 240), (90, 90, 90)]):
        pictures[index, 5:20, index * 8 : index * 8 + 8] = color
    with open_gif(tmp_path / "a.gif", rate_hz=10) as add:
        for picture in pictures:
            add(picture)
    film, found = read_film(tmp_path / "a.gif")
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    np.testing.assert_allclose(np.array(found)[..., ::-1].astype(int), pictures, atol=4)


def test_what_the_encoder_refuses_is_an_error_and_no_file(tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(video, "GIF_COLORS", 100_000)

    def write():
        with open_gif(tmp_path / "a.gif", rate_hz=10) as add:
            add(np.zeros((10, 10, 3), np.uint8))

    with pytest.raises(OSError, match=r"ffmpeg ended with code .*max_colors"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_an_encoder_that_ends_early_is_an_error_that_names_the_film(tmp_path):
    pytest.importorskip("imageio_ffmpeg")

    def write():
        # It refuses no pictures a second, and its input breaks while pictures come.
        with open_video(tmp_path / "film.mp4", rate_hz=0.0) as add:
            for _ in range(100):
                add(np.zeros((400, 600, 3), np.uint8))

    with pytest.raises(OSError, match=r"film\.mp4: ffmpeg ended with code"):
        write()
    assert list(tmp_path.iterdir()) == []
