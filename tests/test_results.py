"""Laws of detections and tracks in people's hands: length, boxes, choices, tables, pictures, conversions."""

import dataclasses
import pathlib
import re
import sys
import types

import jax
import numpy as np
import pytest

import jaxbox
from jaxbox import Detections, Label, PointCloud, io, synthetic, viz
from jaxbox.cli.box_filter import BoxFilter
from jaxbox.config import RegionConfig
from jaxbox.io.parquet import box_rows
from jaxbox.tracking import TrackerState, observe, track_step
from jaxbox.viz.boxes import BoxSet

# The smallest capacity, whose compiled function other tests use too.
CAPACITY, NUM_AZIMUTHS = 16384, 250


@pytest.fixture(scope="module")
def sweep():
    return synthetic.make_sweep(6, num_azimuths=NUM_AZIMUTHS)


@pytest.fixture(scope="module")
def found(sweep):
    """As `detect` gives them, on the device and padded."""
    detections = jaxbox.detect(PointCloud.from_numpy(sweep.xyz, sweep.intensity))
    assert len(detections) >= 3
    return detections


@pytest.fixture(scope="module")
def tracks(found):
    """Of two sweeps, so that all that were seen twice are confirmed."""
    state, step = TrackerState.empty(16), jax.jit(track_step)
    seen = jax.jit(observe)(found)
    for _ in range(2):
        state, result = step(state, seen, 0.1, np.eye(4, dtype=np.float32))
    assert len(result) >= 3
    return result


def test_the_length_is_of_valid_rows_and_the_boxes_are_those_in_their_order(found):
    host = found.on_host()
    assert len(found) == len(list(found)) == host.valid.sum() < len(host.valid)
    for row, box in enumerate(found):
        assert box.label is Label(host.label[row])
        for name in ("score", "yaw", "heading", "front_probability", "num_points"):
            assert getattr(box, name) == getattr(host, name)[row]
        np.testing.assert_array_equal(box.center, host.center[row])
        np.testing.assert_array_equal(box.size, host.size[row])
    assert found[-1] == list(found)[-1]


def test_all_of_them_are_the_same_without_padding(found):
    every = found[:]
    assert len(every) == len(found) == len(every.score)
    assert every.valid.all()
    assert list(every) == list(found)
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(every))
    np.testing.assert_array_equal(every.point_detection, found.point_detection)


def test_boxes_are_chosen_as_numpy_chooses(found):
    every, scores = list(found), found[:].score
    assert list(found[1:3]) == every[1:3]
    assert list(found[[2, 0]]) == [every[2], every[0]]
    assert list(found[scores < scores.max()]) == [box for box in every if box.score < scores.max()]
    # A mask of the padded rows chooses none of the padding.
    assert list(found[found.score >= 0]) == every
    assert list(found[[]]) == []
    assert found[np.int64(1)] == every[1]


@pytest.mark.parametrize(
    ("index", "error", "text"),
    [
        (99, IndexError, "no box 99"),
        ([0, -99], IndexError, "numbered from 0"),
        (np.ones(2, bool), IndexError, "one value a box"),
        ("car", TypeError, r"\.of\(.car.\)"),
        (0.5, TypeError, r"\.above"),
        (np.zeros((1, 1), int), TypeError, "not an index"),
    ],
)
def test_what_is_no_box_is_refused_in_words(found, index, error, text):
    with pytest.raises(error, match=text):
        found[index]


def test_points_of_boxes_that_are_left_out_belong_to_none(found, sweep):
    chosen = found[[1]]
    every = np.asarray(found.point_detection)
    np.testing.assert_array_equal(chosen.point_detection, np.where(every == 1, 0, -1))
    np.testing.assert_array_equal(chosen[0].point_rows, found[1].point_rows)
    for box in found:
        assert len(box.point_rows) == box.num_points
        assert (box.point_rows < len(sweep.xyz)).all()


def test_the_points_of_a_box_are_inside_it_and_inside_its_hull(found, sweep):
    box = max(found, key=lambda box: box.num_points)
    inside = box.contains(sweep.xyz)
    # The detector's box reaches a little farther for its points than its faces.
    assert inside[box.point_rows].mean() > 0.9
    xy = sweep.xyz[box.point_rows][:, :2].astype(np.float64)
    edges = np.roll(box.hull, -1, axis=0) - box.hull
    offset = xy[:, None] - box.hull
    assert (edges[:, 0] * offset[..., 1] - edges[:, 1] * offset[..., 0] > -1e-3).all()


def test_corners_are_those_of_pictures_from_the_front_on(found):
    host = found[:]
    drawn = BoxSet(center=host.center, size=host.size, yaw=host.heading)
    for box, corners, footprint in zip(host, drawn.corners(), drawn.footprints(), strict=True):
        np.testing.assert_allclose(box.corners, corners, atol=1e-5)
        np.testing.assert_allclose(box.footprint, footprint, atol=1e-5)
        assert box.range_m == pytest.approx(np.hypot(*box.center[:2]))
        shrunk = box.center + 0.99 * (box.corners - box.center)
        grown = box.center + 1.01 * (box.corners - box.center)
        assert box.contains(shrunk).all()
        assert not box.contains(grown).any()
        assert not box.contains(np.full((1, 3), np.nan)).any()


def test_filters_keep_what_they_say(found):
    every = list(found)
    cut = every[1].score
    assert list(found.above(cut)) == [box for box in every if box.score >= cut]
    for word in ("car", "Cars", Label.CAR):
        assert list(found.of(word)) == [box for box in every if box.label is Label.CAR]
    assert list(found.of("car", "van", "truck")) == every
    with pytest.raises(ValueError, match='"car", "van", "truck"'):
        found.of("bicycle")
    by_class = found.above({"cars": cut, Label.VAN.word: 2.0})
    assert list(by_class) == [
        box for box in every if box.label is Label.TRUCK or (box.label is Label.CAR and box.score >= cut)
    ]
    with pytest.raises(ValueError, match="'bus' is not a class"):
        found.above({"bus": 0.5})
    for names in (("car", "cars"), (Label.CAR, "Car")):
        with pytest.raises(ValueError, match=f"{names[1]!r} is 'car' again: give one score a class"):
            found.above(dict.fromkeys(names, 0.5))
    for nothing in (np.nan, {"car": np.nan}):
        with pytest.raises(ValueError, match="no box reaches"):
            found.above(nothing)


def test_a_filter_keeps_rows_and_leaves_the_points_of_other_boxes_to_none(found):
    host = found.on_host()
    near = np.hypot(*host.center[:, :2].T) <= 15
    kept = BoxFilter.chosen(classes=None, within="15")(host)
    np.testing.assert_array_equal(kept.valid, host.valid & near)
    assert 0 < kept.valid.sum() < host.valid.sum()
    row = host.point_detection
    np.testing.assert_array_equal(kept.point_detection, np.where((row >= 0) & near[row], row, -1))
    assert 0 < (kept.point_detection >= 0).sum() < (row >= 0).sum()


def test_boxes_within_a_region_or_a_polygon_are_those_whose_centres_are(found):
    every = list(found)
    near = RegionConfig(half_x_m=15.0, half_y_m=6.0)
    kept = [box for box in every if abs(box.center[0]) < 15 and abs(box.center[1]) < 6]
    assert 0 < len(kept) < len(every)
    assert list(found.within(near)) == kept
    rectangle = np.array([[-15, -6], [15, -6], [15, 6], [-15, 6]])
    assert list(found.within(rectangle)) == list(found.within(rectangle[::-1])) == kept
    # A polygon with a notch round the first of them.
    x, y = kept[0].center[:2]
    notch = [[-15, -6], [x - 0.1, -6], [x - 0.1, y + 0.1], [x + 0.1, y + 0.1], [x + 0.1, -6]]
    assert list(found.within([*notch, *rectangle[1:]])) == kept[1:]
    for wrong in (rectangle[:2], rectangle[:, 0]):
        with pytest.raises(ValueError, match="three corners"):
            found.within(wrong)
    for nowhere in (np.nan, np.inf):
        with pytest.raises(ValueError, match="NaN or infinite"):
            found.within([*rectangle, [nowhere, 0]])


def test_equal_is_what_has_the_same_values(found):
    host = found.on_host()
    assert found == host
    assert found[:] == host[:]
    assert found != found[:]
    assert host != dataclasses.replace(host, score=host.score + 1)
    assert host != dataclasses.replace(host, counts=dataclasses.replace(host.counts, cells=np.zeros(3)))
    assert host != "host"
    with pytest.raises(TypeError, match="unhashable"):
        hash(host)


def test_a_batch_says_so_and_is_taken_apart(found):
    batch = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), found.on_host())
    assert repr(batch) == "<Detections of a batch (2,); unstack() gives its sweeps>"
    assert batch._repr_html_() is None
    for use in (len, list, lambda batch: batch.above(0.5), lambda batch: batch[0]):
        with pytest.raises(ValueError, match=r"unstack\(\)"):
            use(batch)
    assert batch.unstack() == [found, found]
    with pytest.raises(ValueError, match="nothing to unstack"):
        found.unstack()


def test_inside_a_compiled_function_arrays_are_to_be_used(found):
    with pytest.raises(TypeError, match="`valid`"):
        jax.jit(len)(found)
    assert repr(jax.eval_shape(lambda found: found, found)).startswith("<Detections of ShapeDtypeStruct")
    texts = []
    jax.jit(lambda found: texts.append(repr(found)))(found)
    assert texts[0].startswith("<Detections of ")


def test_the_text_is_of_a_few_lines(found):
    lines = repr(found).splitlines()
    assert len(lines) <= 8
    assert lines[0].startswith("Detections: ")
    assert f"{found.counts.num_points} points; OK" in lines[0]
    assert lines[1].strip() == str(found[0])
    assert ("more" in lines[-1]) == (len(found) > 6)
    assert repr(found[:0]).startswith("Detections: no box; ")
    assert len({len(line) for line in map(str, found)}) == 1


def test_a_notebook_shows_text_and_picture(found):
    page = found.above(0.15)._repr_html_()
    assert page.count("data:image/png;base64,") == 1
    assert "Detections: " in page


def test_pictures_have_the_boxes_and_the_points_where_there_are_any(found, sweep):
    frame = viz.BirdEyeFrame(width_px=400)
    empty, without, with_points = (
        detections.draw(xyz, frame=frame)
        for detections, xyz in ((found[:0], None), (found, None), (found, sweep.xyz))
    )
    assert empty.shape == (*frame.shape, 3)
    box = found[0]
    column, row = np.round(frame.to_pixels(box.footprint[:2].mean(axis=0))).astype(int)
    region = np.s_[row - 3 : row + 4, column - 3 : column + 4]
    assert (without[region] != empty[region]).any()
    assert (with_points != without).mean() > 0.02
    np.testing.assert_array_equal(found.draw(sweep.xyz), viz.draw_detections(found, sweep.xyz))


def test_first_returns_are_points_of_the_sweep_in_their_directions(found, sweep):
    points = viz.answer.first_returns(found)
    assert 10 < len(points) < len(found.first_return_m)
    distance = np.linalg.norm(sweep.xyz[:, None, :2] - points[None, ::10, :2], axis=2).min(axis=0)
    assert np.median(distance) < 0.5


def columns_of(record, names):
    rows = box_rows(record)
    return {name: [row[name] for row in rows] for name in names}


def assert_same_columns(ours, theirs):
    for name, values in theirs.items():
        assert np.asarray(ours[name]).tolist() == pytest.approx(values), name


def test_tables_have_the_columns_and_values_of_the_parquet_files(found):
    columns = found.to_columns()
    theirs = columns_of(io.detections_record("000001", found), columns)
    assert set(columns) | {"sweep", "timestamp_ns"} == set(io.parquet.PARQUET_COLUMNS)
    for table in (columns, found.to_pandas(), found.to_arrow()):
        assert_same_columns(table, theirs)
    assert len(found[:0].to_pandas()) == 0
    assert found[:0].to_arrow().schema == found.to_arrow().schema
    arrow = pytest.importorskip("pyarrow")
    assert arrow.table(found) == found.to_arrow()


def test_tracks_are_held_alike(tracks):
    host = tracks.on_host()
    assert len(tracks) == host.valid.sum()
    assert [track.id for track in tracks] == host.id[host.valid].tolist()
    assert [track.id for track in tracks[tracks.confirmed]] == host.id[host.valid & host.confirmed].tolist()
    assert tracks[0].speed == pytest.approx(np.hypot(*host.velocity[host.valid][0]))
    assert tracks == host
    assert tracks != tracks[1:]
    assert repr(tracks).startswith("Tracks: ")
    assert tracks[0].motion.word in repr(tracks).splitlines()[1]
    assert tracks.draw().shape == (*viz.BirdEyeFrame().shape, 3)
    assert "data:image/png" in tracks._repr_html_()
    columns = tracks.to_columns()
    of_the_drive = {"sequence", "frame", "time_s", "sweep", "timestamp_ns", "num_points"}
    in_the_world = {"world_x", "world_y", "world_z"}
    assert set(columns) == set(io.parquet.TRACK_COLUMNS) - of_the_drive - in_the_world
    assert tracks.to_pandas()["id"].tolist() == [track.id for track in tracks]


def straight_camera():
    """A camera at the sensor that looks along x, whose image is wide enough for all before it."""
    T = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    P = np.array([[300, 0, 600, 0], [0, 300, 200, 0], [0, 0, 1, 0.0]])
    return jaxbox.Calibration(
        P_rect=np.float32(P), T_rect_velo=np.float32(T), image_size_px=np.int32([1200, 400])
    )


def test_kitti_gets_the_boxes_before_the_camera(found, tracks):
    camera = straight_camera()
    for boxes, objects in (
        (found, found.to_kitti(camera)),
        (tracks, tracks.to_kitti(camera, frame=3)),
    ):
        centers, _, _ = io.boxes_from_objects(objects, camera)
        assert 0 < len(objects) <= len(boxes)
        for item, center in zip(objects, centers, strict=True):
            nearest = min(boxes, key=lambda box, center=center: np.linalg.norm(box.center - center))
            np.testing.assert_allclose(center, nearest.center, atol=1e-3)
            assert item.type.lower() == nearest.label.word
            assert item.score == nearest.score
            assert item.track_id == getattr(nearest, "id", None)


def test_nuscenes_gets_sizes_by_width_and_turns_to_the_front(found, tracks):
    turn = np.array([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1.0]])
    results = found.to_nuscenes(T_global_sensor=turn, sample_token="abc")
    for box, result in zip(found, results, strict=True):
        x, y, z = box.center
        np.testing.assert_allclose(result["translation"], [10 - y, 20 + x, 30 + z], rtol=1e-5)
        assert result["size"] == [box.size[1], box.size[0], box.size[2]]
        w, *_, k = result["rotation"]
        difference = 2 * np.arctan2(k, w) - (box.heading + np.pi / 2)
        assert np.cos(difference) == pytest.approx(1)
        assert result["detection_name"] == ("truck" if box.label is Label.TRUCK else "car")
        assert result["sample_token"] == "abc"
    for track, result in zip(tracks, tracks.to_nuscenes(), strict=True):
        assert (result["tracking_id"], result["tracking_score"]) == (str(track.id), track.score)
        np.testing.assert_allclose(result["velocity"], track.velocity)


def test_open3d_and_polars_get_what_they_take(found, monkeypatch):
    """Their constructors' arguments, by stand-ins, as they are large and optional."""
    geometry = types.SimpleNamespace(OrientedBoundingBox=lambda *arguments: arguments)
    monkeypatch.setitem(sys.modules, "open3d", types.SimpleNamespace(geometry=geometry))
    monkeypatch.setitem(sys.modules, "polars", types.SimpleNamespace(DataFrame=dict))
    for box, (center, rotation, extent) in zip(found, found.to_open3d(), strict=True):
        corners = center + (np.array([[1, 1, -1], [-1, 1, -1]]) * extent / 2) @ rotation.T
        np.testing.assert_allclose(corners, box.corners[:2], atol=1e-5)
    assert_same_columns(found.to_polars(), found.to_columns())


@pytest.mark.parametrize(
    ("method", "library"), [("to_pandas", "pandas"), ("to_polars", "polars"), ("to_open3d", "open3d")]
)
def test_what_is_not_installed_is_named(found, monkeypatch, method, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=rf"pip install 'jaxbox\[{library}\]'"):
        getattr(found, method)()


def test_the_examples_of_the_tutorial_run(tmp_path, monkeypatch, capsys):
    page = (pathlib.Path(__file__).parents[1] / "docs" / "tutorial.md").read_text()
    page = page[: page.index("\n## Thresholds never recompile\n")]
    # A sparser sweep, whose detector is compiled already.
    small = page.replace("make_sweep(seed=0)", f"make_sweep(6, num_azimuths={NUM_AZIMUTHS})")
    assert small != page
    monkeypatch.chdir(tmp_path)
    scope = {}
    for example in re.findall(r"```python\n(.*?)```", small, re.DOTALL):
        exec(compile(example, "tutorial.md", "exec"), scope)
    assert (tmp_path / "boxes.png").stat().st_size > 10_000
    assert capsys.readouterr().out.endswith("True\n"), "the cloud has the answer of its array"


def test_detections_are_still_a_tree_of_the_same_leaves(found):
    leaves, tree = jax.tree.flatten(found)
    again = jax.tree.unflatten(tree, leaves)
    assert isinstance(again, Detections)
    assert again == found
