"""The viewer without a browser: frames, scenes, thresholds, the loop, and what the server refuses."""

import base64
import dataclasses
import http.client
import re
import socket
import threading

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import viser
from test_cli import run
from test_detector import street
from viewer_sweeps import write_kitti, write_three_streets
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from jaxbox import DetectorConfig, PointCloud, _extras, io
from jaxbox.cli import view as view_command
from jaxbox.cli.box_filter import BoxFilter
from jaxbox.config import propose_capacities
from jaxbox.config.fields import check_traced
from jaxbox.run.compiled import count_compilations
from jaxbox.types import Status
from jaxbox.viewer import (
    COLORINGS,
    THRESHOLDS,
    Frames,
    Session,
    View,
    Viewer,
    Wanted,
    build_scene,
    config_text,
    words,
)
from jaxbox.viewer.frames import FAR_M
from jaxbox.viewer.server import is_own_page, open_server, page_url
from jaxbox.viz import BoxSet
from jaxbox.viz.boxes import find_matches
from jaxbox.viz.colors import TRUTH

ALL = [threshold for thresholds in THRESHOLDS.values() for threshold in thresholds]
PRESETS = DetectorConfig.presets()
SOME = 0.02
"""A score that several boxes of these sparse streets have."""
WAIT_S = 120
"""Longer than any answer takes; only a test that fails waits for so long."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three streets of KITTI's layout; the second one's points are cut off."""
    return write_three_streets(tmp_path_factory.mktemp("streets") / "training")


@pytest.fixture(scope="module")
def frame(folder):
    return Frames(io.open_sweeps(folder)).read(0)


@pytest.fixture(scope="module")
def detections(frame):
    return Session(Frames(())).detect(frame, DetectorConfig()).detections


# Frames.


def test_a_frame_has_what_belongs_to_its_sweep(frame):
    assert frame.name == "000000"
    assert len(frame.xyz) == frame.num_points == len(street(0).xyz)
    np.testing.assert_array_equal(frame.xyz, street(0).xyz)
    np.testing.assert_array_equal(frame.intensity, street(0).intensity)
    assert frame.image.shape == (375, 1242, 3)
    assert set(frame.vehicles.captions) <= {"Car", "Van", "Truck"}
    assert frame.others.captions == ("Pedestrian",)
    assert frame.problems == ()


def test_points_that_cannot_be_drawn_are_left_to_the_detector(tmp_path):
    xyz = np.array([[1, 2, 3], [np.nan, 0, 0], [4, 5, 6], [0, np.inf, 0], [FAR_M, 0, 0]], np.float32)
    np.save(tmp_path / "few.npy", xyz)
    frame = Frames(io.open_sweeps(tmp_path)).read(0)
    assert frame.num_points == 5
    assert frame.rows.tolist() == [0, 2]
    assert frame.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert frame.vehicles is frame.others is frame.image is None


@pytest.mark.parametrize("part", ["image_2/000000.png", "calib/000000.txt", "label_2/000000.txt"])
def test_a_frame_goes_without_what_is_broken_beside_its_points(part, tmp_path):
    root = write_kitti(
        tmp_path, "000000", dataclasses.replace(street(0), image=np.zeros((9, 9, 3), np.uint8))
    )
    (root / part).write_text("what is this?")
    frame = Frames(io.open_sweeps(root)).read(0)
    assert len(frame.xyz) == len(street(0).xyz)
    assert len(frame.problems) == 1
    assert part in frame.problems[0]


class Recording:
    """Sweeps that cost a pass, as those of a bag do, and the number of passes that were begun."""

    def __init__(self, sweeps, length=None):
        self.sweeps, self.length, self.passes = sweeps, length or len(sweeps), 0

    def __len__(self):
        return self.length

    def __iter__(self):
        self.passes += 1
        return iter(self.sweeps)


def test_a_recording_is_read_on_and_only_from_its_start_to_go_back(folder):
    recording = Recording([sweep for sweep in io.open_sweeps(folder) if sweep.name != "000001"] * 3, length=8)
    frames = Frames(recording)
    assert [frames.read(index).name for index in (0, 1, 3, 4)] == ["000000", "000002", "000002", "000000"]
    assert recording.passes == 1
    assert frames.read(2).name == "000000"
    assert recording.passes == 2
    with pytest.raises(io.InputError, match="sweep 7: the recording ends before it"):
        frames.read(7)
    assert frames.read(5).name == "000002", "after the end it begins again"


# Scenes.


def test_the_scene_has_the_edges_of_the_boxes_and_the_hulls_of_their_points(frame, detections):
    scene = build_scene(frame, detections, View(min_score=SOME))
    boxes = BoxSet.from_detections(detections, min_score=SOME)
    assert scene.num_boxes == len(boxes) > 3
    np.testing.assert_allclose(scene.lines["boxes"].segments.reshape(len(boxes), 12, 2, 3), boxes.segments())
    hulls = scene.lines["hulls"].segments
    corners = np.asarray(detections.hulls.vertices)[: len(boxes)].reshape(-1, 2)
    assert set(map(tuple, hulls[:, 0, :2].tolist())) <= set(map(tuple, corners.tolist()))
    # Closed rings: each vertex begins a side and ends another.
    assert sorted(map(tuple, hulls[:, 0].tolist())) == sorted(map(tuple, hulls[:, 1].tolist()))
    assert len(hulls) == 2 * np.asarray(detections.hulls.num_vertices)[: len(boxes)].sum()


def test_the_scene_has_the_labels_where_the_vehicles_are(frame, detections):
    scene = build_scene(frame, detections, View(min_score=SOME))
    found = BoxSet.from_detections(detections, min_score=SOME)
    hit, was_found = find_matches(found, frame.vehicles)
    assert hit.sum() >= 2, "boxes and labels are in one frame"
    np.testing.assert_allclose(
        scene.lines["labels"].segments, frame.vehicles.segments().reshape(-1, 2, 3), rtol=1e-6
    )
    # One caption an object: labels that a box stands for are not named again.
    texts = [caption.text for caption in scene.captions]
    alone = [name for name, seen in zip(frame.vehicles.captions, was_found, strict=True) if not seen]
    assert texts[len(found) :] == [*(f"label: {name}" for name in alone), "label: Pedestrian"]
    assert [text.split(" (label")[0] for text in texts[: len(found)]] == list(found.captions)
    assert [caption.below for caption in scene.captions] == [row >= len(found) for row in range(len(texts))]


def test_a_box_names_the_label_of_another_class_that_it_stands_for(frame, detections):
    boxes = BoxSet.from_detections(detections, min_score=SOME)
    row = int(np.flatnonzero([text.startswith("car") for text in boxes.captions])[0])
    for name, said in (("Car", boxes.captions[row]), ("Van", f"{boxes.captions[row]} (label: Van)")):
        label = dataclasses.replace(boxes.take(np.array([row])), captions=(name,))
        labelled = dataclasses.replace(frame, vehicles=label, others=None)
        captions = build_scene(labelled, detections, View(min_score=SOME)).captions
        assert len(captions) == len(boxes)
        assert captions[row].text == said


def test_each_switch_takes_its_own_away(frame, detections):
    full = build_scene(frame, detections, View())
    for field, names in {
        "boxes": ["boxes"],
        "hulls": ["hulls"],
        "labels": ["labels", "other_labels"],
    }.items():
        scene = build_scene(frame, detections, View(**{field: False}))
        for name in full.lines:
            assert (len(scene.lines[name].segments) == 0) == (name in names), (field, name)
    assert build_scene(frame, detections, View(captions=False)).captions == ()
    assert build_scene(frame, detections, View(min_score=1.0)).num_boxes == 0
    plain = build_scene(frame, detections, View(boxes=False, labels=False)).image
    np.testing.assert_array_equal(plain, frame.image)
    assert (full.image != frame.image).any()


@pytest.mark.parametrize("coloring", COLORINGS)
def test_every_colouring_takes_every_frame(coloring, frame, detections, tmp_path):
    np.save(tmp_path / "none.npy", np.zeros((0, 3), np.float32))
    empty = Frames(io.open_sweeps(tmp_path)).read(0)
    for some, answer in ((frame, detections), (frame, None), (empty, None)):
        scene = build_scene(some, answer, View(coloring=coloring))
        assert scene.colors.shape == scene.points.shape
        assert scene.colors.dtype == np.uint8
    different = len(np.unique(build_scene(frame, detections, View(coloring=coloring)).colors, axis=0))
    assert different > 1, "the colours tell something apart"


def test_the_colours_mean_what_they_say(frame, detections):
    colors = {name: build_scene(frame, detections, View(coloring=name)).colors for name in COLORINGS}
    by_ground = np.unique(colors["ground"], axis=0, return_inverse=True)[1].ravel()
    mask = np.asarray(detections.ground_mask)[: len(frame.xyz)]
    assert np.array_equal(by_ground == by_ground[mask.argmax()], mask)
    # The truth knows which points are on which vehicle; those in the image are the labelled ones.
    on_label = (colors["label"] == TRUTH).all(axis=1)
    on_vehicle = street(0).object_id >= 0
    assert on_label.sum() > 100
    assert (on_vehicle | street(0).is_ground)[on_label].mean() > 0.98
    assert on_vehicle[on_label].mean() > 0.8
    ids = np.asarray(detections.point_detection)[: len(frame.xyz)]
    score = np.asarray(detections.score)[ids]
    hidden = (ids < 0) | (score < View().min_score)
    # Points of vehicles that are not shown are as grey as those of none.
    grey = np.ptp(colors["vehicle"].astype(int), axis=1) < 20
    assert np.array_equal(grey, hidden)
    assert len(np.unique(colors["vehicle"][ids == 0], axis=0)) == 1


# Thresholds and settings.


@pytest.mark.parametrize("threshold", ALL, ids=lambda threshold: threshold.name)
def test_the_sliders_are_thresholds_in_range(threshold):
    for config in PRESETS.values():
        check_traced(config, threshold.name)
        assert threshold.low <= threshold.value(config) <= threshold.high
        assert 0 < threshold.step < threshold.high - threshold.low


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_the_sliders_change_the_answer_where_they_matter_and_none_compiles(preset, frame):
    session = Session(Frames(()))
    # The range from which the linking distance grows matters where it grows.
    base = Wanted(preset=preset, changes={"clustering.adaptive_growth": 0.01})
    usual = session.detect(frame, base.config).detections
    before = count_compilations()
    for threshold in ALL:
        wishes = [
            dataclasses.replace(base, changes={**base.changes, threshold.name: end})
            for end in (threshold.low, threshold.high)
        ]
        answers = [session.detect(frame, wanted.config).detections for wanted in wishes]
        same = all(same_boxes(usual, answer) for answer in answers)
        if not threshold.matters(base.config):
            assert same, threshold.name
        elif preset == "default":
            assert not same, threshold.name
    assert count_compilations() == before
    assert session.num_compiles <= 1


def same_boxes(one, other):
    fields = ("center", "size", "yaw", "score", "valid", "ground_mask", "point_component", "point_detection")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in fields)


def test_a_session_counts_what_it_compiles_and_asks_nothing_twice(folder, frame, monkeypatch):
    # A detector that compiles in no time, by the same rules: shapes and static settings.
    traces = []

    @jax.jit
    def quick(cloud, config):
        traces.append(cloud)
        return cloud.num_points + jnp.int32(config.clustering.min_points)

    monkeypatch.setattr("jaxbox.viewer.session.detect", quick)
    monkeypatch.setattr("jaxbox.viewer.session.count_compilations", lambda: len(traces))
    session = Session(Frames(io.open_sweeps(folder)))
    assert not session.is_compiled(frame, DetectorConfig())
    shown = session.detect(frame, DetectorConfig())
    assert (session.num_compiles, session.is_compiled(frame, DetectorConfig())) == (1, True)
    assert session.compile_s > shown.detect_s > 0
    assert session.detect(frame, DetectorConfig()) is shown
    moved = session.detect(frame, Wanted(changes={"clustering.min_points": 3.0}).config)
    assert moved.detections == shown.detections - 5
    assert session.num_compiles == 1, "a threshold compiles nothing"
    session.detect(frame, DetectorConfig.paper())
    larger = dataclasses.replace(frame, cloud=PointCloud.from_numpy(frame.xyz, capacity=20_000))
    assert not session.is_compiled(larger, DetectorConfig())
    session.detect(larger, DetectorConfig())
    assert session.num_compiles == 3, "a preset and a capacity do, once each"
    session.detect(frame, DetectorConfig())
    assert session.num_compiles == 3
    assert session.frame(0) is session.frame(0)
    assert session.frame(2).name == "000002"


@pytest.mark.parametrize("preset", PRESETS)
def test_the_copied_settings_are_read_back(preset, tmp_path):
    changes = {"vehicles.max_overlap": 0.25, "filtering.num_std": 3.0, "clustering.adaptive_growth": 0.001}
    wanted = Wanted(preset=preset, changes=changes)
    file = tmp_path / "copied.toml"
    file.write_text(wanted.config_text)
    assert io.read_config(file) == wanted.config
    assert wanted.config != PRESETS[preset]
    lines = [line for line in wanted.config_text.splitlines() if not line.startswith("#")]
    assert lines[0] == f'preset = "{preset}"'
    assert {line.split(" = ")[0] for line in lines[1:]} <= set(changes)


def test_settings_of_no_preset_are_copied_whole(tmp_path):
    given = propose_capacities([street(0).xyz], base=DetectorConfig.fast())
    file = tmp_path / "copied.toml"
    file.write_text(config_text(given, None, min_score=0.3))
    assert io.read_config(file) == given
    assert "--min-score 0.3" in file.read_text()
    wish = view_command.initial_wish(given, min_score=0.3)
    assert (wish.preset, wish.config) == (None, given)


# Words.


def test_the_words_tell_counts_times_and_what_was_dropped(frame, tmp_path):
    session = Session(Frames((None,) * 4))
    shown = session.detect(frame, DetectorConfig())
    text = words.describe(shown, session, index=1, min_score=SOME)
    boxes = BoxSet.from_detections(shown.detections, min_score=SOME)
    assert f"<span data-jaxbox='vehicles'>{len(boxes)}</span> vehicles" in text
    assert "000000" in text
    assert "2 of 4" in text
    assert re.search(r"<span data-jaxbox='milliseconds'>[\d.]+</span> ms", text)
    assert "nothing was dropped" in words.describe_status(shown)
    table = re.sub("<[^>]*>", " ", words.describe_points(shown)).replace(",", "")
    assert sum(map(int, re.findall(r" (\d+) ", table))) == frame.num_points

    bad = dataclasses.replace(frame, num_points=4, problems=("the image <is> broken",))
    status = Status.CELL_OVERFLOW | Status.NONFINITE_POINTS
    answer = dataclasses.replace(shown.detections, status=np.int32(status))
    text = words.describe_status(dataclasses.replace(shown, frame=bad, detections=answer))
    for sentence in status.describe():
        assert sentence in text
    assert "the image &lt;is&gt; broken" in text


def test_names_of_files_are_no_html(frame):
    hostile = "<img src=x onerror='alert(1)'>"
    session = Session(Frames((None,)))
    shown = session.detect(dataclasses.replace(frame, name=hostile, problems=(hostile,)), DetectorConfig())
    texts = [
        words.describe(shown, session, index=0, min_score=0.1),
        words.describe_status(shown),
        words.describe_error(hostile, index=0, count=1),
        words.describe_work("compiling", index=0, count=1, frame=shown.frame),
        words.copy_box(hostile),
    ]
    for text in texts:
        assert "<img" not in text


def test_the_picture_is_within_the_text(frame):
    data = re.search("src='data:image/jpeg;base64,([^']+)'", words.picture(frame.image))[1]
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape == frame.image.shape
    assert abs(decoded.astype(int) - frame.image).max() < 8


def test_a_time_is_told_in_utc(frame):
    timed = dataclasses.replace(frame, timestamp_ns=1_317_000_000_123_456_789)
    text = words.describe_work("compiling", index=0, count=1, frame=timed)
    assert "2011-09-26 01:20:00.123 UTC" in text


# The loop.


class FakePage:
    """Keeps what it is shown, and tells when there is something new."""

    def __init__(self):
        self.changed = threading.Condition()
        self.scenes, self.compared, self.answers, self.followed = [], [], [], []

    def show_scene(self, scene, compared=None):
        self.scenes.append(scene)
        self.compared.append(compared)

    def show_words(self, answer, *, status="", points=""):
        with self.changed:
            self.answers.append(answer)
            self.changed.notify_all()

    def follow(self, wanted):
        self.followed.append(wanted)

    def wait_for(self, text, count=1):
        with self.changed:
            assert self.changed.wait_for(
                lambda: sum(text in answer for answer in self.answers) >= count, timeout=WAIT_S
            ), f"no {text} in {self.answers}"


@pytest.fixture
def started(folder):
    """A viewer at work on the three streets, the second of them broken."""
    page = FakePage()
    viewer = Viewer(Session(Frames(io.open_sweeps(folder))), page)
    thread = threading.Thread(target=viewer.run)
    thread.start()
    yield viewer, page
    viewer.stop()
    thread.join(WAIT_S)
    assert not thread.is_alive()


def test_the_loop_answers_what_is_wanted(started):
    viewer, page = started
    page.wait_for("ms</b> to detect")
    many = page.scenes[-1].num_boxes
    viewer.want_view(min_score=0.28)
    page.wait_for("ms</b> to detect", count=2)
    assert 0 < page.scenes[-1].num_boxes < many
    viewer.want_threshold("clustering.min_points", 5000.0)
    page.wait_for("vehicles'>0<")
    assert page.followed[-1].config.clustering.min_points == 5000
    assert page.followed[-1].view.min_score == 0.28, "one wish keeps the others"


def test_only_boxes_of_the_chosen_area_are_shown(folder):
    session, near = Session(Frames(io.open_sweeps(folder))), BoxFilter.chosen(classes="car", within="12")
    scenes = []
    for keep in (None, near):
        page = FakePage()
        Viewer(session, page, keep=keep).answer(Wanted())
        scenes.append(page.scenes[-1])
        assert f"'vehicles'>{scenes[-1].num_boxes}<" in page.answers[-1]
    everywhere, within = (np.linalg.norm(scene.boxes.center[:, :2], axis=1) for scene in scenes)
    assert 0 < len(within) < len(everywhere)
    np.testing.assert_array_equal(within, everywhere[everywhere <= 12])
    np.testing.assert_array_equal(scenes[1].points, scenes[0].points)


def test_an_unreadable_sweep_is_told_and_the_others_go_on(started):
    viewer, page = started
    viewer.want(index=1)
    page.wait_for("000001.bin")
    assert "data-jaxbox='error'" in page.answers[-1]
    assert page.scenes[-1] is None, "nothing of the sweep before is left on the page"
    viewer.step(1)
    page.wait_for("000002")
    assert page.scenes[-1].num_boxes > 0


def test_a_fault_of_the_program_is_told_too(started, monkeypatch, capfd):
    viewer, page = started
    with monkeypatch.context() as patch:
        patch.setattr("jaxbox.viewer.viewer.build_scene", lambda *_: 1 / 0)
        viewer.want(index=2)
        page.wait_for("unexpected ZeroDivisionError")
    assert "Traceback" in capfd.readouterr().err
    viewer.want(index=0)
    page.wait_for("1 of 3")


def test_settings_that_contradict_each_other_are_told(folder):
    page = FakePage()
    given = dataclasses.replace(
        DetectorConfig(), evidence=dataclasses.replace(DetectorConfig().evidence, enabled=False)
    )
    Viewer(Session(Frames(io.open_sweeps(folder))), page).answer(Wanted(preset=None, given=given))
    assert "enable the evidence" in page.answers[-1]


def test_playing_goes_round(started):
    viewer, page = started
    viewer.want(sweeps_per_s=30.0, playing=True)
    # Past the broken one and the end, twice.
    page.wait_for("000002", count=2)
    page.wait_for("000001.bin", count=2)
    assert viewer.wanted.playing
    viewer.want(playing=False)


def test_wishes_pile_up_to_the_last(folder):
    page, asked = FakePage(), []
    session = Session(Frames(io.open_sweeps(folder)))
    busy, go_on = threading.Event(), threading.Event()
    usual = session.detect

    def slow(frame, config):
        asked.append(config.clustering.min_points)
        busy.set()
        assert go_on.wait(WAIT_S)
        return usual(frame, config)

    session.detect = slow
    viewer = Viewer(session, page)
    thread = threading.Thread(target=viewer.run)
    thread.start()
    assert busy.wait(WAIT_S)
    for value in range(10, 30):
        viewer.want_threshold("clustering.min_points", float(value))
    go_on.set()
    page.wait_for("ms</b> to detect", count=2)
    viewer.stop()
    thread.join(WAIT_S)
    assert asked == [DetectorConfig().clustering.min_points, 29.0]


# The server.


@pytest.fixture(scope="module")
def server():
    server = open_server(host="127.0.0.1", port=0)
    yield server
    server.stop()


@pytest.mark.parametrize(
    ("origin", "asked", "listens", "own"),
    [
        ("http://localhost:8080", "localhost:8080", "127.0.0.1", True),
        ("http://127.0.0.1:8080", "127.0.0.1:8080", "127.0.0.1", True),
        ("http://localhost:9000", "localhost:9000", "127.0.0.1", True),  # A forwarded port.
        ("http://[::1]:8080", "[::1]:8080", "::1", True),
        ("https://example.org", "localhost:8080", "127.0.0.1", False),
        ("http://localhost:3000", "localhost:8080", "127.0.0.1", False),
        ("http://rebound.example:8080", "rebound.example:8080", "127.0.0.1", False),
        ("null", "localhost:8080", "127.0.0.1", False),
        ("http://lab.example:8080", "lab.example:8080", "0.0.0.0", True),
        ("http://other.example", "lab.example:8080", "0.0.0.0", False),
    ],
)
def test_only_the_servers_own_pages_may_talk_to_it(origin, asked, listens, own):
    assert is_own_page({"Origin": origin, "Host": asked}, host=listens) == own
    assert is_own_page({"Host": asked}, host=listens), "no browser"


def talk(server, **options):
    protocols = [f"viser-v{viser.__version__}"]
    address = f"ws://127.0.0.1:{server.get_port()}"
    return connect(address, subprotocols=protocols, max_size=None, **options)


def test_a_page_from_elsewhere_gets_nothing(server):
    with talk(server, origin="https://example.org") as stranger, pytest.raises(ConnectionClosed) as closed:
        stranger.recv(timeout=WAIT_S)
    assert closed.value.rcvd.code == 1008
    with talk(server, origin=page_url(server)) as own:
        assert len(own.recv(timeout=WAIT_S)) > 0


def test_the_server_never_shares_itself(server):
    assert server.request_share_url() is None


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../../../etc/passwd",
        "/..%2f..%2f..%2f..%2f..%2fetc/passwd",
        "/%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd",
        "/..\\..\\..\\..\\etc\\passwd",
        "//etc/passwd",
        "/etc/passwd",
        "/../__init__.py",
        "/./../../infra/_infra.py",
    ],
)
def test_no_path_leads_out_of_the_page(server, path):
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=WAIT_S)
    # As it stands: a client that tidied the path up would test itself.
    connection.putrequest("GET", path, skip_host=False)
    connection.endheaders()
    response = connection.getresponse()
    body = response.read()
    connection.close()
    assert response.status == 404
    assert b"root:" not in body
    assert len(body) < 100


def test_the_page_itself_is_served(server):
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=WAIT_S)
    connection.request("GET", "/")
    response = connection.getresponse()
    assert response.status == 200
    assert b"<!doctype html>" in response.read().lower()
    connection.close()


def test_the_server_is_reached_from_this_machine_only(server):
    probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with probe:
        # No packet is sent: it only asks the system which of its addresses it would send from.
        probe.connect(("192.0.2.1", 9))
        own_address = probe.getsockname()[0]
    assert not own_address.startswith("127.")
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((own_address, server.get_port()), timeout=WAIT_S)


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
def test_an_address_of_another_machine_is_refused(host):
    with pytest.raises(io.InputError, match=f"cannot listen at {host}"):
        open_server(host=host, port=0)


# The command.


def test_a_taken_port_is_an_error_and_not_the_next_one(server, folder):
    result = run("view", folder, "--port", server.get_port())
    assert result.exit_code == 2
    assert f"port {server.get_port()}" in result.stderr
    assert "--port" in result.stderr


def test_bad_input_ends_before_anything_is_served(tmp_path):
    result = run("view", tmp_path / "nothing")
    assert result.exit_code == 2
    assert "there is no such file" in result.stderr
    result = run("view", tmp_path, "--set", "vehicles.max_overlop=1")
    assert result.exit_code == 2
    assert "vehicles.max_overlap" in result.stderr


def test_the_missing_extra_is_named(folder, monkeypatch):
    there = _extras.importlib.import_module

    def missing(name, package=None):
        # What the command line itself imports late is there.
        if name.partition(".")[0] == "viser":
            raise ImportError(name)
        return there(name, package)

    monkeypatch.setattr(_extras.importlib, "import_module", missing)
    result = run("view", folder)
    assert result.exit_code == 2
    assert "pip install 'jaxbox[view]'" in result.stderr


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_the_command_tells_the_address_and_ends_on_interrupt(host, folder, monkeypatch):
    asked = []

    def interrupted(viewer):
        asked.append(viewer.wanted)
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "run", interrupted)
    result = run("view", folder, "--port", 0, "--host", host, "--preset", "paper", "--min-score", 0.4)
    assert result.exit_code == 0
    assert re.search(r"3 sweeps at http://[\w.]+:\d+ ", result.stdout)
    assert ("everybody" in result.stderr) == (host == "0.0.0.0")
    assert (asked[0].preset, asked[0].view.min_score) == ("paper", 0.4)


def test_the_command_shows_a_tilted_sweep_upright(tmp_path, monkeypatch):
    sin, cos = np.sin(0.2), np.cos(0.2)
    np.save(tmp_path / "a.npy", street(0).xyz @ np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]).T)
    seen = []

    def interrupted(viewer):
        seen.append(viewer._session.frame(0).xyz)
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "run", interrupted)
    result = run("view", tmp_path, "--port", 0, "--level", "--sensor-at", 0, 0, 0.5)
    assert result.exit_code == 0, result.output
    assert "tilted 11." in result.stdout
    # Half a degree at the farthest point.
    np.testing.assert_allclose(seen[0], street(0).xyz - [-0.5 * sin, 0, 0.5 * cos], atol=0.4)
