"""Labels for annotation tools and back: what is written is read as it was, in every form of each tool."""

import functools
import json
import math
import shutil
import zipfile

import numpy as np
import pytest

from jaxbox import DEFAULT_SCORE_THRESHOLD, Label, io
from jaxbox.evaluation import evaluate_folders
from jaxbox.io import InputError
from jaxbox.io.annotation_results import (
    CVAT,
    LABELCLOUD,
    XTREME1,
    chosen_boxes,
    open_cvat,
    open_labelcloud,
    open_xtreme1,
)
from jaxbox.io.annotations import is_annotations, read_annotations
from jaxbox.io.kitti import ALL_ROUND
from jaxbox.io.results import SweepResult

TOOLS = {
    "labelcloud": open_labelcloud,
    "xtreme1": open_xtreme1,
    "scene_xtreme1": functools.partial(open_xtreme1, scene=True),
    "cvat": open_cvat,
}
NAMES = ("0000_000000", "0000_000001", "0000_000002")


def make_boxes(seed, num=5, tracked=True):
    """Boxes all round the sensor, as the records of tracks or detections have them."""
    rng = np.random.default_rng(seed)
    tracks = {"confirmed": True, "sight": "seen"}
    return [
        {
            "label": Label(int(rng.integers(len(Label)))).word,
            "score": float(rng.uniform(DEFAULT_SCORE_THRESHOLD, 1)),
            "center": rng.uniform(-50, 50, 3).tolist(),
            "size": [float(rng.uniform(3, 9)), float(rng.uniform(1.5, 2.5)), float(rng.uniform(1, 3))],
            "heading": float(rng.uniform(-np.pi, np.pi)),
            "num_points": 10,
            **({"id": int(10 * seed + row), **tracks} if tracked else {}),
        }
        for row in range(num)
    ]


def make_points(seed):
    return np.random.default_rng(seed).normal(0, 20, (50, 4)).astype(np.float32)


def write(open_tool, path, *, tracked=True, names=NAMES, **options):
    written = {}
    with open_tool(path, **options) as add:
        for seed, name in enumerate(names):
            written[name] = make_boxes(seed, num=seed, tracked=tracked)
            points = make_points(seed)
            record = {"name": name, "boxes": written[name]}
            add(SweepResult(record=record, xyz=points[:, :3], intensity=points[:, 3]))
    return written


def check(sweep, boxes, *, has_ids):
    objects = sweep.read_labels()
    center, size, heading = io.boxes_from_objects(objects, sweep.read_calibration(), keep_heading=True)
    np.testing.assert_allclose(center, np.reshape([box["center"] for box in boxes], (-1, 3)), atol=1e-6)
    np.testing.assert_allclose(size, np.reshape([box["size"] for box in boxes], (-1, 3)), atol=1e-6)
    turn = heading - np.array([box["heading"] for box in boxes])
    np.testing.assert_allclose(np.cos(turn), 1, atol=1e-6)
    assert [item.type for item in objects] == [box["label"].capitalize() for box in boxes]
    assert [item.track_id for item in objects] == [box["id"] if has_ids else None for box in boxes]


@pytest.mark.parametrize("tool", TOOLS)
def test_what_is_written_for_a_tool_is_read_as_labelled_sweeps(tmp_path, tool):
    written = write(TOOLS[tool], tmp_path / f"drive_{tool}")
    sweeps = io.open_sweeps(tmp_path / f"drive_{tool}")
    assert [sweep.name for sweep in sweeps] == list(NAMES)
    for seed, sweep in enumerate(sweeps):
        xyz, intensity = sweep.read_points()
        np.testing.assert_array_equal(np.column_stack([xyz, intensity]), make_points(seed))
        check(sweep, written[sweep.name], has_ids=tool != "labelcloud")


@pytest.mark.parametrize("tool", [LABELCLOUD, XTREME1, CVAT])
def test_a_run_of_single_sweeps_is_continued(tmp_path, tool):
    assert tool.finished is not None
    whole = {}
    for count in (1, 3):
        with tool.open(tmp_path / tool.name, True) as add:
            for seed in range(len(whole), count):
                whole[NAMES[seed]] = make_boxes(seed, num=seed, tracked=False)
                points = make_points(seed)
                record = {"name": NAMES[seed], "boxes": whole[NAMES[seed]]}
                add(SweepResult(record=record, xyz=points[:, :3], intensity=points[:, 3]))
        assert tool.finished(tmp_path / tool.name) == set(NAMES[:count]), "also sweeps without boxes"
    for sweep in io.open_sweeps(tmp_path / tool.name):
        found = [box.size for box in read_annotations(sweep.labels_path, sweep.name)]
        np.testing.assert_allclose(found, [box["size"] for box in whole[sweep.name]])


def test_only_boxes_that_are_worth_a_look_are_written():
    good, low, new, hidden = make_boxes(0, 4)
    low["score"], new["confirmed"], hidden["sight"] = DEFAULT_SCORE_THRESHOLD - 0.01, False, "hidden"
    record = {"boxes": [good, low, new, hidden]}
    assert chosen_boxes(record) == [good]
    assert chosen_boxes(record, coasting=True) == [good, hidden]


def test_labelclouds_other_forms_are_read(tmp_path):
    (box,) = make_boxes(3, 1)
    with open_labelcloud(tmp_path) as add:
        add(SweepResult(record={"name": "a", "boxes": [box]}))
    file, classes = tmp_path / "labels" / "a.json", tmp_path / "labels" / "_classes.json"
    (expected,) = read_annotations(file, "a")
    content = json.loads(file.read_text())
    length, width, height = box["size"]
    turn = np.array([[math.cos(box["heading"]), -math.sin(box["heading"])],
                     [math.sin(box["heading"]), math.cos(box["heading"])]])  # fmt: skip
    corners = [(-1, -1), (-1, 1), (1, 1), (1, -1)]
    flat = [turn @ (np.array(corner) * [length / 2, width / 2]) for corner in corners]
    vertices = [
        [*(xy + box["center"][:2]), box["center"][2] + side * height / 2] for side in (-1, 1) for xy in flat
    ]
    in_degrees = content["objects"][0] | {
        "rotations": {"x": 0, "y": 0, "z": math.degrees(box["heading"]) % 360}
    }
    forms = {
        "vertices": {"name": box["label"], "vertices": np.array(vertices).tolist()},
        "centroid_abs": in_degrees,
    }
    for name, item in forms.items():
        classes.write_text(json.dumps({"format": name}))
        file.write_text(json.dumps({"objects": [item]}))
        (found,) = read_annotations(file, "a")
        np.testing.assert_allclose(found.center, expected.center, atol=1e-9)
        np.testing.assert_allclose(found.size, expected.size, atol=1e-9)
        assert math.cos(found.heading - expected.heading) == pytest.approx(1)
    classes.unlink()
    in_degrees["rotations"]["z"] = 350
    file.write_text(json.dumps({"objects": [in_degrees]}))
    assert read_annotations(file, "a")[0].heading == pytest.approx(math.radians(350)), "no angle of radians"


def test_what_xtreme1_exports_is_read(tmp_path):
    (box,) = make_boxes(3, 1)
    with open_xtreme1(tmp_path) as add:
        add(SweepResult(record={"name": "a", "boxes": [box]}))
    file = tmp_path / "result" / "a.json"
    (expected,) = read_annotations(file, "a")
    written = json.loads(file.read_text())
    (item,) = written["objects"]
    # One part a source, 2D boxes of the cameras between, and no class of the data set yet.
    flat = item | {"type": "2D_BOX"}
    parts = [{"objects": [flat, item | {"className": None}]}, {"objects": []}]
    file.write_text(json.dumps(parts))
    assert read_annotations(file, "a") == [expected]


def test_what_cvat_exports_is_read_packed_or_not(tmp_path):
    written = write(open_cvat, tmp_path / "packed")
    with zipfile.ZipFile(tmp_path / "packed" / "annotations.zip") as archive:
        content = json.loads(archive.read("annotations/default.json"))
    # Frames in which a track is outside, folders of the upload before the names, other shapes.
    for item in content["items"]:
        item["id"] = f"pointclouds/{item['id']}"
        item["annotations"] += [
            {"type": "cuboid_3d", "attributes": {"outside": True}, "label_id": 0},
            {"type": "label", "label_id": 0},
        ]
    (tmp_path / "plain" / "annotations").mkdir(parents=True)
    (tmp_path / "plain" / "annotations" / "job_7.json").write_text(json.dumps(content))
    shutil.copytree(tmp_path / "packed" / "pointclouds", tmp_path / "plain" / "pointclouds")
    for sweep in io.open_sweeps(tmp_path / "plain"):
        check(sweep, written[sweep.name], has_ids=True)


def test_a_sweep_without_labels_is_a_sweep_without_a_camera(tmp_path):
    write(open_labelcloud, tmp_path / "a")
    (tmp_path / "a" / "labels" / f"{NAMES[1]}.json").unlink()
    sweeps = io.open_sweeps(tmp_path / "a")
    assert [sweep.is_annotated for sweep in sweeps] == [True, False, True]
    assert sweeps[1].read_labels() is None
    assert sweeps[1].read_calibration() is None
    write(open_cvat, tmp_path / "b", names=NAMES[:2])
    points = tmp_path / "b" / "pointclouds"
    (points / f"{NAMES[1]}.pcd").rename(points / "other.pcd")
    assert [sweep.read_labels() is None for sweep in io.open_sweeps(tmp_path / "b")] == [False, True]


def test_labels_all_round_are_evaluated_in_space_alone(tmp_path):
    write(open_cvat, tmp_path / "a")
    results = tmp_path / "results"
    for sweep in io.open_sweeps(tmp_path / "a"):
        center, size, heading = io.boxes_from_objects(sweep.read_labels(), ALL_ROUND, keep_heading=True)
        types = [item.type for item in sweep.read_labels()]
        found = io.objects_from_boxes(center, size, heading, ALL_ROUND, types=types)
        assert None not in found, "behind the sensor too"
        scored = [io.KittiObject(**{**vars(item), "score": 0.5}) for item in found]
        io.write_labels(results / f"{sweep.name}.txt", scored)
    report = evaluate_folders(tmp_path / "a", results)
    assert {curve["metric"] for curve in report["kitti"]["curves"]} == {"bev", "3d"}
    for curve in report["vehicles"]:
        assert curve["num_labels"] == 3
        assert curve["r40"] == curve["ceiling_r40"] > 0
    rates = report["selections"]["all"]["rates"]
    assert all(rate["recall"] == 1 for rate in rates if rate["num_labels"])
    # One that is nowhere is a false alarm, wherever it lies.
    wrong = io.objects_from_boxes(
        np.array([[-30.0, 5, 0]]), np.array([[4, 2, 1.5]]), np.zeros(1), ALL_ROUND, types=["Car"]
    )
    io.write_labels(results / f"{NAMES[0]}.txt", [io.KittiObject(**{**vars(wrong[0]), "score": 0.9})])
    assert evaluate_folders(tmp_path / "a", results)["selections"]["all"]["rates"][0]["num_false"] == 1


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("labels/a.json", "[]", "no list of objects"),
        ("labels/a.json", '{"objects": [3]}', "object 1: not a box of the tool"),
        ("labels/a.json", '{"objects": [{"name": "car"}]}', "object 1: not a box of the tool"),
        (
            "labels/a.json",
            '{"objects": [{"name": "car", "vertices": [[1, 2, 3]]}]}',
            "vertices must be 8 rows",
        ),
        ("result/a.json", '{"objects": [{"type": "3D_BOX", "className": "car", "contour": {}}]}', "object 1"),
        ("annotations/a.json", '{"items": {}}', "no list of items"),
        ("annotations/a.json", '{"items": [{"id": "a"}]}', "its items must have annotations"),
        ("annotations.zip", "PK", "not a zip of annotations"),
    ],
)
def test_labels_that_cannot_be_read_say_where(tmp_path, file, text, words):
    path = tmp_path / file
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    assert is_annotations(path)
    with pytest.raises(InputError) as error:
        read_annotations(path, "a")
    assert str(path) in str(error.value)
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("part", "value", "words"),
    [
        (("name",), " ", "it has no class"),
        (("dimensions", "width"), 0, "lengths must be above 0"),
        (("centroid", "y"), "there", "y is 'there'; it must be a finite number"),
    ],
)
def test_a_box_that_cannot_be_says_which(tmp_path, part, value, words):
    with open_labelcloud(tmp_path) as add:
        add(SweepResult(record={"name": "a", "boxes": make_boxes(0, 2)}))
    file = tmp_path / "labels" / "a.json"
    content = json.loads(file.read_text())
    place = content["objects"][1]
    for key in part[:-1]:
        place = place[key]
    place[part[-1]] = value
    file.write_text(json.dumps(content))
    with pytest.raises(InputError) as error:
        read_annotations(file, "a")
    assert f"{file}, object 2" in str(error.value)
    assert words in str(error.value)


def test_a_zip_of_several_files_of_annotations_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "annotations.zip", "w") as archive:
        for name in ("a", "b"):
            archive.writestr(f"annotations/{name}.json", "{}")
    with pytest.raises(InputError, match="2 files"):
        read_annotations(tmp_path / "annotations.zip", "a")
