"""Tracks in the viewer: each drive by itself, computed once, and drawn where the vehicles are."""

import dataclasses

import numpy as np
import pytest
from test_cli import run
from test_detector import street
from test_viewer import FakePage

import jaxbox
from jaxbox import DetectorConfig, Motion, TrackStatus, io
from jaxbox.tracking import Poses, PoseSource, Sight
from jaxbox.tracking.trails import TRAIL_S
from jaxbox.viewer import (
    Frames,
    Session,
    TrackMemory,
    View,
    Viewer,
    Wanted,
    build_scene,
    drives,
    open_viewer,
    words,
)
from jaxbox.viewer.drives import split_drives
from jaxbox.viewer.legend import describe_legend
from jaxbox.viewer.scene import COMPARED
from jaxbox.viz.colors import color_by_id
from jaxbox.viz.tracks import ARROW_S

NUM_SWEEPS, STEP_M = 6, 1.0
CONFIG = DetectorConfig()
OTHER = dataclasses.replace(
    CONFIG, clustering=dataclasses.replace(CONFIG.clustering, min_points=CONFIG.clustering.min_points + 5)
)


def known_poses(sweeps):
    """Those of a sensor that goes on along x."""
    T = np.tile(np.eye(4), (len(sweeps), 1, 1))
    T[:, 0, 3] = STEP_M * np.arange(len(sweeps))
    return Poses(T, PoseSource.OXTS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two drives past one standing street; the second is shorter."""
    root = tmp_path_factory.mktemp("drives")
    for name, count in (("first", NUM_SWEEPS), ("second", 3)):
        (root / name).mkdir()
        for k in range(count):
            np.save(root / name / f"{k}.npy", street(0).xyz - np.float32([STEP_M * k, 0, 0]))
    return root


@pytest.fixture(autouse=True)
def _poses(monkeypatch):
    monkeypatch.setattr(drives.io, "find_poses", known_poses)


@pytest.fixture
def two_drives(folder):
    return split_drives(io.open_sweeps([folder / "first", folder / "second"]))


@pytest.fixture
def steps(monkeypatch):
    """Names of the sweeps that a tracker was given, in that order."""
    names = []
    usual = drives.track

    def counted(*arguments, **options):
        for tracked in usual(*arguments, **options):
            names.append(tracked.name)
            yield tracked

    monkeypatch.setattr(drives, "track", counted)
    return names


def track_up_to(memory, index, config=CONFIG):
    """The tracks of a sweep, and how many sweeps that took."""
    done, total = memory.progress(index, config)
    for _ in range(total - done):
        memory.step(index, config)
    assert memory.progress(index, config) == (total, total)
    return memory.find(index, config)[0], total - done


def test_the_timeline_has_each_drive_in_one_piece(folder):
    names = [folder / "first" / "0.npy", folder / "second" / "0.npy", folder / "first" / "1.npy"]
    ordered, parts = split_drives(io.open_sweeps(names))
    assert [sweep.points_path for sweep in ordered] == [names[0], names[2], names[1]]
    assert [len(part) for part in parts] == [2, 1]


def test_tracks_are_those_of_the_drive_in_whatever_order_sweeps_are_asked_for(two_drives, steps):
    sweeps, parts = two_drives
    expected = [tracked for part in parts for tracked in jaxbox.track(part, CONFIG, poses=known_poses(part))]
    memory = TrackMemory(parts)
    asked = [3, 1, NUM_SWEEPS + 2, 5, 0]
    found = {index: track_up_to(memory, index) for index in asked}
    memory.close()
    assert [count for _, count in found.values()] == [4, 0, 3, 2, 0], "nothing is tracked twice"
    assert steps == [sweeps[index].name for index in (0, 1, 2, 3, 6, 7, 8, 4, 5)]
    for index, (tracked, _) in found.items():
        tracks = expected[index].tracks
        assert tracked.pose_source is PoseSource.OXTS
        assert len(tracked.tracks.id) > 3
        for field in ("id", "center", "velocity", "motion", "score", "label_probability"):
            np.testing.assert_array_equal(
                getattr(tracked.tracks, field), getattr(tracks, field)[tracks.valid], err_msg=field
            )


def test_another_setting_of_the_detector_forgets(two_drives, steps):
    memory = TrackMemory(two_drives[1])
    track_up_to(memory, 2)
    assert memory.progress(2, OTHER) == (0, 3)
    track_up_to(memory, 1, OTHER)
    assert memory.progress(2, CONFIG) == (0, 3), "of one setting at a time"
    memory.close()
    assert len(steps) == 5


def test_a_drive_that_breaks_off_keeps_what_there_is_and_says_so(two_drives):
    sweeps, _ = two_drives

    class Cut(tuple):
        def __iter__(self):
            yield from self[:2]
            raise io.InputError("drive.bag: it is cut off.")

    memory = TrackMemory([Cut(sweeps)])
    while memory.progress(4, CONFIG)[0] < 5:
        memory.step(4, CONFIG)
    found, problems = memory.find(4, CONFIG)
    assert found is None
    assert "drive.bag: it is cut off" in problems[0]
    assert memory.find(0, CONFIG)[0] is not None
    memory.close()


def test_broken_poses_are_told_and_estimated_instead(two_drives, monkeypatch):
    def broken(_):
        raise io.InputError("oxts/0000.txt, line 3: no number.")

    monkeypatch.setattr(drives.io, "find_poses", broken)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    memory = TrackMemory(two_drives[1])
    tracked, _ = track_up_to(memory, 1)
    assert tracked.status == TrackStatus.POSE_FROM_BOXES
    assert "line 3: no number. Poses are estimated" in memory.find(1, CONFIG)[1][0]
    memory.close()


# Scenes.


@pytest.fixture(scope="module")
def last(folder):
    """The last sweep of the first drive, its detections and tracks, one of which moves and one is hidden."""
    sweeps = io.open_sweeps(folder / "first")
    memory = TrackMemory([sweeps])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drives.io, "find_poses", known_poses)
        tracked, _ = track_up_to(memory, NUM_SWEEPS - 1)
    memory.close()
    frame = Frames(sweeps).read(NUM_SWEEPS - 1)
    tracks = tracked.tracks
    rows = np.argsort(-tracks.score)[:2]
    assert tracks.confirmed[rows].all()
    motion, velocity, sight = tracks.motion * 0, tracks.velocity.copy(), tracks.sight * 0
    motion[rows[0]], velocity[rows[0]], sight[rows[1]] = Motion.LANE_CHANGE, (3.0, 4.0), Sight.HIDDEN
    changed = dataclasses.replace(tracks, motion=motion, velocity=velocity, sight=sight)
    detections = Session(Frames(())).detect(frame, CONFIG).detections
    return frame, detections, dataclasses.replace(tracked, tracks=changed), rows


def shown_rows(tracked, min_score):
    tracks = tracked.tracks
    is_guess = (tracks.sight != Sight.SEEN) & (2 * tracks.hits < tracks.age)
    return np.flatnonzero(tracks.confirmed & (tracks.score >= min_score) & ~is_guess)


def test_the_scene_has_boxes_in_the_colours_of_ids_and_says_who_they_are_and_what_they_do(last):
    frame, detections, tracked, (mover, hidden) = last
    view = View(tracks=True, labels=False)
    scene = build_scene(frame, detections, view, tracked)
    rows = shown_rows(tracked, view.min_score)
    ids = tracked.tracks.id[rows]
    assert scene.num_boxes == len(rows) >= 2
    middle = scene.lines["boxes"].segments.reshape(len(rows), -1, 3).mean(axis=1)
    np.testing.assert_allclose(middle, tracked.tracks.center[rows], atol=1e-4)
    colors = scene.lines["boxes"].end_colors.reshape(len(rows), -1, 3)
    full = color_by_id(ids) // np.where(rows == hidden, 2, 1)[:, None]
    np.testing.assert_array_equal(colors, np.broadcast_to(full[:, None], colors.shape))
    texts = dict(zip(rows.tolist(), (caption.text for caption in scene.captions), strict=True))
    assert texts[mover] == f"{tracked.tracks.id[mover]} lane change 5 m/s"
    assert texts[hidden] == f"{tracked.tracks.id[hidden]} standing (hidden)"
    assert build_scene(frame, detections, View(tracks=True, min_score=1.0), tracked).num_boxes == 0


def test_trails_end_at_the_vehicles_and_an_arrow_where_one_will_be(last):
    frame, detections, tracked, (mover, _) = last
    view = View(tracks=True)
    scene = build_scene(frame, detections, view, tracked)
    trails = scene.lines["trails"].segments
    for row in shown_rows(tracked, view.min_score):
        assert (np.abs(trails[:, 1] - tracked.tracks.center[row]).max(axis=1) < 1e-3).any()
        # What stands stays where it is in the frame of this sweep, though the sensor went on.
        way = tracked.trails[int(tracked.tracks.id[row])]
        assert np.linalg.norm(way - way[-1], axis=1).max() < 0.5 * STEP_M
        assert len(way) <= TRAIL_S * 10 + 1
    start, end = scene.lines["arrows"].segments[0]
    np.testing.assert_allclose(end - start, [3 * ARROW_S, 4 * ARROW_S, 0], atol=1e-5)
    np.testing.assert_allclose(start[:2], tracked.tracks.center[mover, :2], atol=1e-5)
    assert len(scene.lines["arrows"].segments) == 3, "what stands has none"


def test_without_tracks_or_the_wish_for_them_the_scene_has_boxes_as_ever(last):
    frame, detections, tracked, _ = last
    usual = build_scene(frame, detections, View())
    for scene in (
        build_scene(frame, detections, View(), tracked),
        build_scene(frame, detections, View(tracks=True)),
    ):
        assert scene.captions == usual.captions
        assert set(scene.lines) == set(usual.lines)
        for name, lines in usual.lines.items():
            np.testing.assert_array_equal(scene.lines[name].segments, lines.segments)
    hidden = build_scene(frame, detections, View(tracks=True, boxes=False, labels=False), tracked)
    assert (len(hidden.lines["boxes"].segments), hidden.captions) == (0, ())


def test_the_legend_tells_tracks_and_those_compared_have_one_colour(last):
    frame, detections, tracked, _ = last
    scene = build_scene(frame, detections, View(tracks=True), tracked, title="one")
    other = build_scene(frame, detections, View(tracks=True), tracked, title="two", compared=True)
    legend = describe_legend(scene, other)
    for text in (
        "track: one",
        "track that is hidden now",
        "track: two",
        "trail: the last 2 s",
        "arrow: in 1 s",
    ):
        assert f"<span>{text}</span>" in legend
    for name in ("boxes", "trails", "arrows"):
        assert (other.lines[name].end_colors == COMPARED).all()
        assert len(other.lines[name].segments) == len(scene.lines[name].segments) > 0


def test_the_words_count_what_tracks_do(last):
    _, _, tracked, _ = last
    text = words.describe_tracks(tracked, min_score=0.0)
    rows = shown_rows(tracked, 0.0)
    assert (
        f"<span data-jaxbox='tracks'>{len(rows)}</span> tracks</b>: {len(rows) - 1} standing, 1 lane" in text
    )
    assert "poses: oxts" in text
    assert "0</span> tracks</b>: none" in words.describe_tracks(tracked, min_score=1.0)


# The loop.


@pytest.fixture
def viewer(two_drives):
    ordered, parts = two_drives
    memory, page = TrackMemory(parts), FakePage()
    yield Viewer(Session(Frames(ordered)), page, tracks=memory), page, memory
    memory.close()


def test_the_page_shows_tracks_where_they_are_wanted(viewer, steps):
    viewer, page, _ = viewer
    viewer.answer(Wanted(index=2))
    assert "data-jaxbox='tracks'" not in page.answers[-1]
    assert steps == [], "whoever does not want them waits for none"
    viewer.answer(Wanted(index=2, view=View(tracks=True)))
    assert any("tracking: 0 of 3 sweeps" in answer for answer in page.answers)
    assert "data-jaxbox='tracks'" in page.answers[-1]
    assert "trails" in page.scenes[-1].lines
    viewer.answer(Wanted(index=1, view=View(tracks=True)))
    assert "tracking: " not in page.answers[-1]
    assert len(steps) == 3


def test_a_wish_ends_the_tracking_that_it_makes_needless_and_what_is_done_is_kept(viewer, steps):
    viewer, page, memory = viewer
    usual = memory.step

    def interrupted(index, config):
        usual(index, config)
        viewer.want(index=0)

    memory.step = interrupted
    viewer.want(index=NUM_SWEEPS - 1, view=View(tracks=True))
    viewer.answer(viewer._next())
    assert len(steps) == 1
    assert "data-jaxbox='tracks'" not in page.answers[-1]
    viewer.answer(viewer._next())
    assert "data-jaxbox='tracks'" in page.answers[-1]
    assert len(steps) == 1


def test_the_command_begins_with_tracks(folder, monkeypatch):
    asked = []

    def interrupted(viewer):
        asked.append((viewer.wanted.view.tracks, [len(drive) for drive in viewer._side.tracks._drives]))
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "run", interrupted)
    for options in ([], ["--track"]):
        result = run("view", folder / "first", folder / "second", "--port", 0, *options)
        assert result.exit_code == 0, result.output
    assert asked == [(False, [NUM_SWEEPS, 3]), (True, [NUM_SWEEPS, 3])]


def test_a_real_page_draws_tracks_each_line_in_its_colour(folder):
    wanted = Wanted(index=2, view=View(tracks=True))
    with open_viewer(io.open_sweeps(folder / "first"), wanted=wanted) as (viewer, _):
        viewer.answer(wanted)
        page = viewer._page
        assert page._view_controls["tracks"].value
        assert "data-jaxbox='tracks'" in page._answer.content
        boxes = page._canvas.nodes["boxes"]
        assert boxes.colors.shape == boxes.points.shape
        assert len(np.unique(boxes.colors.reshape(-1, 3), axis=0)) == len(boxes.points) / 12
        assert "trails" in page._canvas.nodes
        viewer.answer(dataclasses.replace(wanted, view=View()))
        assert "trails" not in page._canvas.nodes, "nothing of the tracks is left"
