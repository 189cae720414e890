"""What a page says beside the 3D view: legend, table of boxes, tooltips, progress; and two compared."""

import dataclasses
import re
import time

import numpy as np
import pytest
from test_cli import run
from test_viewer import SOME, FakePage
from viewer_sweeps import write_three_streets

from jaxbox import DetectorConfig, io
from jaxbox.cli.view import distinct_names
from jaxbox.config.fields import replace_fields, traced_ranges
from jaxbox.viewer import (
    THRESHOLDS,
    Comparison,
    Frames,
    Session,
    View,
    Viewer,
    Wanted,
    build_scene,
    open_viewer,
)
from jaxbox.viewer import (
    viewer as viewer_module,
)
from jaxbox.viewer.box_table import box_rows, describe_boxes
from jaxbox.viewer.legend import describe_legend
from jaxbox.viewer.scene import COLORINGS, COMPARED, LIGHT_SHARE
from jaxbox.viewer.viewer import Side, telling
from jaxbox.viz.boxes import find_matches
from jaxbox.viz.colors import ESTIMATE, TRUTH

STRICT = replace_fields(DetectorConfig(), {"clustering.min_points": 40.0})
"""Fewer boxes, by the same compiled detector."""
WANTED = Wanted(view=View(min_score=SOME))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_three_streets(tmp_path_factory.mktemp("streets") / "training")


@pytest.fixture(scope="module")
def frame(folder):
    return Frames(io.open_sweeps(folder)).read(0)


@pytest.fixture(scope="module")
def detections(frame):
    return Session(Frames(())).detect(frame, DetectorConfig()).detections


# Colours and the legend.


def words_of(html):
    return " ".join(re.sub("<[^>]*>", " ", html).split())


def test_the_legend_names_what_is_drawn_and_nothing_else(frame, detections):
    full = words_of(describe_legend(build_scene(frame, detections, View(min_score=SOME))))
    for text in ("0.3 to 3 m above ground", "box", "hull of the points", "labelled vehicle", "other label"):
        assert text in full
    bare = View(min_score=SOME, boxes=False, hulls=False, labels=False)
    assert words_of(describe_legend(build_scene(frame, detections, bare))) == "-0.3 to 3 m above ground"
    texts = {
        words_of(describe_legend(build_scene(frame, detections, dataclasses.replace(bare, coloring=name))))
        for name in COLORINGS
    }
    assert len(texts) == len(COLORINGS)


def test_a_light_page_has_darker_colours_and_its_legend_too(frame, detections):
    dark, light = (build_scene(frame, detections, View(light=light)) for light in (False, True))
    np.testing.assert_allclose(light.colors, LIGHT_SHARE * dark.colors, atol=0.51)
    for name, lines in dark.lines.items():
        np.testing.assert_allclose(light.lines[name].end_colors, LIGHT_SHARE * lines.end_colors, atol=0.51)
    assert "rgb(255, 190, 40)" in describe_legend(dark)
    assert "rgb(178, 133, 28)" in describe_legend(light)
    assert "rgb(255, 190, 40)" not in describe_legend(light)


# The table of boxes.


def test_the_table_has_every_box_nearest_first(frame, detections):
    scene = build_scene(frame, detections, View(min_score=SOME))
    rows = box_rows([scene])
    ranges = [row.distance_m for row in rows]
    assert ranges == sorted(ranges)
    assert sorted(row.center for row in rows) == sorted(map(tuple, scene.boxes.center.tolist()))
    np.testing.assert_allclose(ranges, [np.hypot(*row.center[:2]) for row in rows])
    html = describe_boxes(rows)
    assert re.findall(r'data-box="(\d+)"', html) == [str(number + 1) for number in range(len(rows))]
    first = rows[0]
    size = " × ".join(f"{metres:.1f}" for metres in first.size)
    assert f"1 {first.text} {first.distance_m:.1f} {size}" in words_of(html)
    assert words_of(describe_boxes([])) == "no box of the shown score"


def test_the_camera_looks_at_a_box_from_where_it_is_seen_whole(frame, detections):
    for row in box_rows([build_scene(frame, detections, View(min_score=SOME))]):
        position, target = map(np.array, row.look())
        assert tuple(target) == row.center
        distance = np.linalg.norm(position - target)
        assert max(row.size) < distance < max(30, 3 * max(row.size))
        assert position[2] > row.center[2] + row.size[2] / 2, "from above its roof"


def test_names_are_no_html_in_table_and_legend(frame, detections):
    hostile = "<img src=x>"
    scene = build_scene(frame, detections, View(min_score=SOME, tracks=True), title=hostile)
    for text in (describe_boxes(box_rows([scene])), describe_legend(scene, scene)):
        assert "<img" not in text
        assert "&lt;img" in text


# Tooltips.


def test_tooltips_say_what_in_which_unit_in_which_range_and_the_name_in_files():
    ranges = traced_ranges(DetectorConfig())
    units = {"m": "In m; ", "grade": "In m/m; "}
    labels = []
    for thresholds in THRESHOLDS.values():
        for threshold in thresholds:
            tooltip = threshold.tooltip
            assert tooltip.startswith(f"{threshold.hint} ")
            assert tooltip.endswith(f"{ranges[threshold.name].text[1:]}. Setting: {threshold.name}.")
            assert units.get(threshold.name.rsplit("_", 1)[-1], "") in tooltip
            labels.append(threshold.label)
    assert len(set(labels)) == len(labels)


# Progress.


def test_work_tells_for_how_long_and_nothing_after_it_ended(monkeypatch):
    monkeypatch.setattr(viewer_module, "TELL_S", 0.01)
    told = []
    with telling(told.append):
        assert told == [0.0]
        while len(told) < 3:
            time.sleep(0.005)
    count = len(told)
    assert told == sorted(told)
    time.sleep(0.05)
    assert len(told) == count
    quick = []
    with telling(quick.append, at_once=False):
        pass
    assert quick == [], "what is quick is not told"


def test_the_page_counts_the_seconds_of_compiling(folder, monkeypatch):
    monkeypatch.setattr(viewer_module, "TELL_S", 0.01)
    page, session = FakePage(), Session(Frames(io.open_sweeps(folder)))
    usual = session.detect

    def slow(frame, config):
        page.wait_for("from the cache: 1 s")
        return usual(frame, config)

    session.detect = slow
    Viewer(session, page).answer(WANTED)
    assert any("from the cache: 0 s" in answer for answer in page.answers)
    assert "ms</b> to detect" in page.answers[-1]


# Two things compared.


def compare(folder, wanted=WANTED, *, config=STRICT, sweeps=None):
    """The page after one answer; `sweeps` are other ones, or the same with `config`."""
    page = FakePage()
    session = Session(Frames(io.open_sweeps(folder)))
    if sweeps is None:
        compared = Side(session=Session(Frames(())), title="strict", config=config, same_sweeps=True)
        viewer = Viewer(session, page, compared=compared)
    else:
        compared = Side(session=Session(Frames(sweeps)), title="other")
        viewer = Viewer(session, page, title="first", compared=compared)
    viewer.answer(wanted)
    return page


def test_settings_are_compared_in_one_place_and_the_boxes_of_both_are_counted(folder, frame, detections):
    page = compare(folder)
    scene, other = page.scenes[-1], page.compared[-1]
    assert 0 < other.num_boxes < scene.num_boxes
    assert scene.points is not other.points
    assert len(other.points) == 0, "the points are there once"
    assert len(other.lines["labels"].segments) == 0
    assert (scene.lines["boxes"].end_colors == ESTIMATE).all()
    assert (other.lines["boxes"].end_colors == COMPARED).all()
    assert all(caption.below for caption in other.captions)
    both = find_matches(scene.boxes, other.boxes)[0].sum()
    text = words_of(page.answers[-1])
    assert f"compared: strict {other.num_boxes} vehicles" in text
    expected = (
        f"{both} in both, {scene.num_boxes - both} only in default, {other.num_boxes - both} only in strict"
    )
    assert expected in text
    legend = words_of(describe_legend(scene, other))
    assert "box: default box: strict" in legend
    rows = box_rows([scene, other])
    assert [row.title for row in rows] == ["default"] * scene.num_boxes + ["strict"] * other.num_boxes


def test_the_page_s_thresholds_leave_the_compared_settings_alone(folder):
    moved = dataclasses.replace(WANTED, changes={"clustering.min_points": 5000.0})
    page, usual = compare(folder, moved), compare(folder)
    assert page.scenes[-1].num_boxes == 0
    assert page.compared[-1].num_boxes == usual.compared[-1].num_boxes
    assert "only in default, changed" in words_of(page.answers[-1])


def test_apart_both_have_their_points_and_the_rows_fly_to_the_other_place(folder):
    apart = dataclasses.replace(WANTED, view=View(min_score=SOME, apart_m=50.0))
    page = compare(folder, apart)
    scene, other = page.scenes[-1], page.compared[-1]
    np.testing.assert_array_equal(other.points, scene.points)
    assert (other.lines["labels"].end_colors == TRUTH).all()
    assert len(other.lines["labels"].segments) > 0
    assert [scene.captions[-1].text, other.captions[-1].text] == ["default", "strict"]
    row = box_rows([scene, other], apart_m=50.0)[-1]
    found = other.boxes.center - np.array([0, 50.0, 0])
    assert np.abs(found - row.center).sum(axis=1).min() < 1e-9


def test_recordings_are_compared_by_number_and_one_that_ends_is_told(folder):
    sweeps = tuple(reversed(io.open_sweeps(folder)))
    page = compare(folder, sweeps=sweeps)
    text = words_of(page.answers[-1])
    assert "000000 1 of 3" in text
    assert "compared: other 000002" in text
    assert "in both" not in text, "boxes of different sweeps are not matched"
    page = compare(folder, dataclasses.replace(WANTED, index=2), sweeps=sweeps[:1])
    assert "other has 1 sweeps, and none to compare with this one" in page.answers[-1]


def test_a_real_page_draws_both_flies_and_turns_light(folder):
    comparison = Comparison(title="strict", config=STRICT)
    with open_viewer(io.open_sweeps(folder), wanted=WANTED, comparison=comparison) as (viewer, _):
        viewer.answer(WANTED)
        page = viewer._page
        scene, other = page._canvas.scene, page._compared.scene
        assert "points" in page._canvas.nodes
        assert "points" not in page._compared.nodes
        assert page._flights.options == tuple(map(str, range(1, scene.num_boxes + other.num_boxes + 1)))
        assert page._view_controls["apart_m"].visible
        apart = dataclasses.replace(WANTED, view=View(min_score=SOME, apart_m=30.0, light=True))
        page.follow(apart)
        viewer.answer(apart)
        assert page._light
        assert page._compared._frame.position.tolist() == [0, -30, 0]
        assert "points" in page._compared.nodes
    with open_viewer(io.open_sweeps(folder), wanted=WANTED) as (viewer, _):
        viewer.answer(WANTED)
        assert not viewer._page._view_controls["apart_m"].visible
        assert not viewer._page._compared._frame.visible


def test_the_command_compares_presets_files_and_sweeps(folder, tmp_path, monkeypatch):
    asked = []

    def interrupted(viewer):
        asked.append((viewer._compared, viewer._side.title, viewer.wanted.view))
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "run", interrupted)
    file = tmp_path / "strict.toml"
    file.write_text("clustering.min_points = 40")
    for value in ("paper", file, folder / "velodyne" / "000002.bin"):
        result = run("view", folder, "--port", 0, "--light", "--compare", value)
        assert result.exit_code == 0, result.output
    preset, settings, sweeps = (side for side, _, _ in asked)
    assert (preset.title, preset.config, preset.same_sweeps) == ("paper", DetectorConfig.paper(), True)
    assert (settings.title, settings.config, settings.same_sweeps) == ("strict.toml", STRICT, True)
    assert (len(sweeps.session), sweeps.config, sweeps.same_sweeps) == (1, None, False)
    assert [view.apart_m > 0 for _, _, view in asked] == [False, False, True]
    assert all(view.light for _, _, view in asked)
    wrong = run("view", folder, "--compare", "papr")
    assert wrong.exit_code == 2
    message = " ".join(wrong.stderr.split())
    assert "--compare: " in message
    assert "papr: there is no such file" in message
    assert "a preset (default, accurate, fast, paper)" in message


@pytest.mark.parametrize(
    ("path", "other", "names"),
    [
        ("/a/b/0000", "/a/b/0003", ("0000", "0003")),
        ("/a/0000/x", "/a/0003/x", ("0000/x", "0003/x")),
        ("/a/b", "/a/b", ("b", "b")),
        ("/a/b", "/a/b/c", ("b", "c")),
        ("one.bag", "/a/two.bag", ("one.bag", "/a/two.bag")),
    ],
)
def test_titles_leave_out_what_both_paths_begin_with(path, other, names):
    assert distinct_names(path, other) == names
