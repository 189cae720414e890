"""A whole archive: listing, partitions that are whole or absent, workers that die; a local Ray of two."""

import collections
import functools
import http.server
import json
import os
import pathlib
import pickle
import shutil
import signal
import sys
import threading
import zipfile

import fsspec
import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from test_cli import make_small_sweep, run, write_points
from test_io_formats import write_foxglove

from jaxbox import io
from jaxbox.cli import detect_ray, ray_engine
from jaxbox.cluster import (
    ClusterError,
    DatasetReport,
    DriveReport,
    PartitionReport,
    detect_dataset,
    detect_worker,
    sources,
    track_dataset,
    worker,
)
from jaxbox.cluster.detect_worker import DetectTask, DetectWorker
from jaxbox.cluster.run import MANIFEST, joined_ray, plan
from jaxbox.cluster.sources import SweepReader, SweepRef, group_refs, list_sweeps
from jaxbox.cluster.store import Store
from jaxbox.cluster.track_worker import TrackTask, TrackWorker
from jaxbox.cluster.worker import Attempt, Partition
from jaxbox.config import DetectorConfig, TrackConfig
from jaxbox.io.parquet import PARQUET_COLUMNS
from jaxbox.run import batching, compiled
from jaxbox.run.cache import CACHE_VARIABLE, CacheFolders
from jaxbox.run.pose_providers import estimated_source
from jaxbox.run.versions import versions
from jaxbox.tracking.poses import PoseSource

# Ray Data's settings warn of their own old names.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:ray")

NAMES = ["000", "001", "002", "003", "004", "005"]
BROKEN = "003"
KILLED_AT = "005"
SETTINGS = ("--preset", "paper", "--min-score", "0.05")


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch):
    # What the workers set for themselves, and that is put back here.
    monkeypatch.setenv("NPROC", os.environ.get("NPROC", "1"))
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")


@pytest.fixture(scope="module", autouse=True)
def _kept_programs(tmp_path_factory):
    """Has the workers take the programs that this process has traced: each would trace and load its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(tmp_path_factory.mktemp("cache")))
        # As here, or they are other programs.
        patch.setenv("JAX_NUMPY_DTYPE_PROMOTION", "strict")
        # Afterwards the tests of other modules keep none again.
        patch.setattr(compiled, "_programs", None)
        yield


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """Six streets in folders of two; the points of one were cut short."""
    root = tmp_path_factory.mktemp("archive")
    for number, name in enumerate(NAMES):
        write_points(root / f"drive_{number // 2}" / f"{name}.bin", make_small_sweep(number % 3))
    (root / "drive_1" / f"{BROKEN}.bin").write_bytes(b"\0" * 17)
    return root


def rows_of(folder):
    """The boxes of all files of a folder, in the order of their names."""
    tables = [pq.read_table(path) for path in sorted(folder.glob("*.parquet"))]
    return pa.concat_tables(tables).replace_schema_metadata(None)


@pytest.fixture(scope="module")
def local(archive, tmp_path_factory):
    """What one process writes."""
    output = tmp_path_factory.mktemp("local")
    paths = [str(path) for path in sorted(archive.iterdir())]
    result = run("detect", *paths, "--output", output, *SETTINGS, "--format", "parquet", "--no-pictures")
    assert result.exit_code == 1
    table = rows_of(output)
    assert table.column_names == list(PARQUET_COLUMNS)
    assert len(table) > 10
    return table


# --- where sweeps lie -----------------------------------------------------------------------------


def serially(function, arguments):
    return [function(argument) for argument in arguments]


def test_sweeps_of_a_url_have_the_names_and_points_of_local_ones(archive, tmp_path):
    shutil.copytree(archive / "drive_0", tmp_path / "training" / "velodyne" / "0007")
    shutil.copytree(archive / "drive_2", tmp_path / "training" / "velodyne" / "0008")
    with zipfile.ZipFile(tmp_path / "archive.zip", "w") as archived:
        for path in sorted((tmp_path / "training").rglob("*.bin")):
            archived.write(path, path.relative_to(tmp_path))
        archived.writestr("training/calib/0007.txt", "P2: 1 2 3")
        archived.writestr("training/velodyne/0008/.hidden.bin", "")
    expected = list_sweeps([str(tmp_path / "training")], None, serially)
    assert [ref.name for ref in expected] == ["0007_000000", "0007_000001", "0008_000004", "0008_000005"]
    assert [ref.name for ref in expected] == [sweep.name for sweep in io.open_sweeps(tmp_path / "training")]
    found = list_sweeps([f"zip://training::{tmp_path}/archive.zip"], None, serially)
    assert [ref.name for ref in found] == [ref.name for ref in expected]
    assert list_sweeps([f"zip://*/*/0007/*.bin::{tmp_path}/archive.zip"], None, serially) == found[:2]
    reader = SweepReader(None)
    for here, there in zip(expected, found, strict=True):
        np.testing.assert_array_equal(reader.read(here).points[0], reader.read(there).points[0])
        assert reader.read(here).num_bytes == reader.read(there).num_bytes > 0


def test_times_and_poses_beside_the_points_are_fetched_with_them():
    memory = fsspec.filesystem("memory")
    points = np.zeros((2, 4), "<f4").tobytes()
    memory.pipe("/day/drive/velodyne_points/data/0000000001.bin", points)
    memory.pipe("/day/drive/velodyne_points/timestamps.txt", b"1970-01-01 00:00:01\n1970-01-01 00:00:02\n")
    (ref,) = list_sweeps(["memory://day"], None, serially)
    assert ref.name == "drive_0000000001"
    assert SweepReader(None).read(ref).timestamp_ns == 2 * 10**9
    assert sources._companion(pathlib.Path("a/sensors/lidar/1.feather")) == (
        3,
        "calibration/egovehicle_SE3_sensor.feather",
    )
    memory.rm("/day", recursive=True)


def test_same_names_get_their_folder_and_what_is_no_sweep_is_refused(tmp_path):
    memory = fsspec.filesystem("memory")
    for name in ("a/x/1.bin", "a/y/1.bin", "a/y/2.bin", "b/y/1.bin", "c/notes.md"):
        memory.pipe(f"/{name}", b"")
    names = [ref.name for ref in list_sweeps(["memory://a"], None, serially)]
    assert names == ["x_1", "y_1", "2"]
    names = [ref.name for ref in list_sweeps(["memory://a", "memory://b"], None, serially)]
    assert names == ["x_1", "a_y_1", "2", "b_y_1"]
    memory.pipe("/a_b/1.bin", b"")
    memory.pipe("/a/b/1.bin", b"")
    memory.pipe("/b/1.bin", b"")
    with pytest.raises(io.InputError, match="would be named a_b_1"):
        list_sweeps(["memory://a_b/1.bin", "memory://a/b/1.bin", "memory://b/1.bin"], None, serially)
    with pytest.raises(io.InputError, match="memory://c: no points there"):
        list_sweeps(["memory://c"], None, serially)
    with pytest.raises(io.InputError, match="nosuch://a: cannot be opened"):
        list_sweeps(["nosuch://a"], None, serially)
    memory.pipe("/d/1.bin", b"\0" * 17)
    with pytest.raises(io.InputError, match=r"^memory:///?d/1\.bin: 17 bytes"):
        SweepReader(None).read(SweepRef("1", "memory://d/1.bin"))
    for folder in "abcd":
        memory.rm(f"/{folder}", recursive=True)


def test_messages_of_a_recording_are_read_by_number_in_one_pass(tmp_path, monkeypatch):
    write_foxglove(tmp_path / "drive.mcap", ["/front", "/rear"])
    refs = list_sweeps([str(tmp_path / "drive.mcap")], "/front", serially)
    sweeps = list(io.open_sweeps(tmp_path / "drive.mcap", topic="/front"))
    assert [ref.name for ref in refs] == [sweep.name for sweep in sweeps]
    passes = []
    opened = io.open_sweeps
    monkeypatch.setattr(io, "open_sweeps", lambda *a, **o: passes.append(a) or opened(*a, **o))
    reader = SweepReader("/front")
    for ref, sweep in zip(refs, sweeps, strict=True):
        read = reader.read(ref)
        np.testing.assert_array_equal(read.points[0], sweep.read_points()[0])
        assert read.timestamp_ns == sweep.timestamp_ns
    assert len(passes) == 1
    with pytest.raises(io.InputError, match="ends before its message 9"):
        reader.read(SweepRef("x", refs[0].url, 9))
    assert reader.read(refs[1]).timestamp_ns == sweeps[1].timestamp_ns


# --- partitions -----------------------------------------------------------------------------------


@pytest.mark.parametrize("url", ["{tmp}/out", "memory://store"])
def test_a_file_of_a_store_is_whole_or_absent(tmp_path, url):
    store = pickle.loads(pickle.dumps(Store(url.format(tmp=tmp_path))))
    assert store.names() == []
    store.make()
    store.write_text("a.txt", "one")
    store.write_text("a.txt", "two")
    assert (store.read_text("a.txt"), store.read_text("b.txt"), store.names()) == ("two", None, ["a.txt"])
    with pytest.raises(TypeError), store.writing("a.txt") as path, path.open("w") as file:
        file.write("half") + file.write(None)
    with pytest.raises(FileNotFoundError), store.writing("b.txt"):
        pass
    assert (store.read_text("a.txt"), store.names()) == ("two", ["a.txt"])
    store.remove("a.txt")
    store.remove("a.txt")
    assert store.names() == []


def test_what_a_killed_writer_sent_in_part_is_removed(tmp_path, monkeypatch):
    store = Store(tmp_path)
    with monkeypatch.context() as patch:
        # As where it is killed between sending and renaming.
        patch.setattr(store._system, "mv", _fail)
        patch.setattr(store._system, "rm_file", _fail)
        with pytest.raises(OSError, match="disk"):
            store.write_text("part-000000.parquet", "whole")
    assert [name.startswith(".part-000000.parquet.") for name in store.names()] == [True]
    (tmp_path / ".hidden").touch()
    (tmp_path / "drive.part").touch()
    store.remove_partials()
    assert store.names() == [".hidden", "drive.part"]


def test_a_store_that_cannot_be_renamed_in_leaves_nothing(tmp_path, monkeypatch):
    store = Store(tmp_path / "out")
    store.make()
    monkeypatch.setattr(store._system, "mv", _fail)
    with pytest.raises(OSError, match="disk"), store.writing("a.txt") as path:
        path.write_text("whole")
    assert store.names() == []


def _fail(*_, **__):
    raise OSError("the disk is full")


def task_for(output, **changes):
    fields = {
        "config": DetectorConfig.paper(), "capacity": None, "min_score": 0.05, "topic": None, "batch": 4,
        "num_threads": 1, "versions": versions(),
        "cache_folders": CacheFolders.of_this_process(),
    }  # fmt: skip
    return DetectTask(output=str(output), **{**fields, **changes})


def partition_of(archive):
    paths = sorted(archive.rglob("*.bin"))
    refs = tuple(SweepRef(path.stem, str(path)) for path in paths)
    return Partition(name="part-000000", key="k", refs=refs)


def test_a_worker_writes_the_rows_of_the_local_run_and_its_report_is_in_the_file(archive, local, tmp_path):
    report = DetectWorker(task_for(tmp_path)).work(partition_of(archive))
    assert rows_of(tmp_path).equals(local)
    assert (report.error, report.num_done, report.num_boxes) == (None, 5, len(local))
    assert [item["sweep"] for item in report.failures] == [BROKEN]
    assert report.num_bytes == sum(path.stat().st_size for path in archive.rglob("*.bin")) - 17
    assert report.num_deaths == 0
    metadata = pq.read_metadata(tmp_path / "part-000000.parquet").metadata
    assert json.loads(metadata[b"jaxbox.sweeps"]) == [name for name in NAMES if name != BROKEN]
    assert PartitionReport.from_json(metadata[worker.REPORT_KEY.encode()]) == report
    assert [path.name for path in tmp_path.iterdir()] == ["part-000000.parquet"]


@pytest.mark.slow
@pytest.mark.usefixtures("_all_devices")
def test_a_worker_prepares_every_device_that_its_batches_go_to(archive, local, tmp_path, monkeypatch):
    prepared, used = [], []

    def detect_batch(clouds, config):
        answers = batching.detect_batch(clouds, config)
        devices = {device for answer in answers for device in answer.score.devices()}
        (used if any(cloud.num_points for cloud in clouds) else prepared).append(devices)
        return answers

    monkeypatch.setattr(detect_worker, "detect_batch", detect_batch)
    DetectWorker(task_for(tmp_path)).work(partition_of(archive))
    assert prepared == [set(jax.local_devices())]
    assert set.union(*used) == prepared[0]
    assert len(prepared[0]) > 1
    assert rows_of(tmp_path).equals(local)


def test_after_a_death_each_sweep_goes_alone_and_one_that_kills_again_is_given_up(archive, local, tmp_path):
    store = Store(tmp_path)
    assert not Attempt(store, "part-000000").one_by_one
    # What attempts leave whose workers died: the first in a batch, and two with a sweep alone.
    for number in (1, 2):
        attempt = Attempt(store, "part-000000")
        assert (attempt.one_by_one, attempt.num_before) == (True, number)
        assert not attempt.gives_up(KILLED_AT)
        attempt.begin(KILLED_AT)
    report = DetectWorker(task_for(tmp_path)).work(partition_of(archive))
    assert report.num_deaths == 3
    assert [item["sweep"] for item in report.failures] == [BROKEN, KILLED_AT]
    assert "died 2 times" in report.failures[1]["reason"]
    kept = [name != KILLED_AT for name in local["sweep"].to_pylist()]
    assert rows_of(tmp_path).equals(local.filter(kept))
    assert store.names() == ["part-000000.parquet"]


def test_a_partition_that_cannot_be_written_is_reported_and_absent(archive, tmp_path, monkeypatch):
    monkeypatch.setattr(worker, "open_parquet", _fail)
    report = DetectWorker(task_for(tmp_path)).work(partition_of(archive))
    assert (report.error, report.num_done) == ("OSError: the disk is full", 0)
    assert list(tmp_path.glob("*.parquet")) == []
    other = {**versions(), "jax": "0.0.1"}
    report = DetectWorker(task_for(tmp_path, versions=other)).work(partition_of(archive))
    assert f"the worker has jax {jax.__version__} for 0.0.1" in report.error


# --- Ray ------------------------------------------------------------------------------------------


class Server(http.server.ThreadingHTTPServer):
    """The archive over HTTP; `before` is called with each path that is asked for."""

    def __init__(self, folder):
        self.before, self.asked = lambda path: None, collections.Counter()
        super().__init__(("127.0.0.1", 0), functools.partial(Handler, directory=folder))


class Handler(http.server.SimpleHTTPRequestHandler):
    def do_GET(self):
        self.server.asked[self.path] += 1
        self.server.before(self.path)
        super().do_GET()

    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def served(archive, tmp_path_factory):
    """A copy of the archive, and its server."""
    folder = tmp_path_factory.mktemp("served") / "archive"
    shutil.copytree(archive, folder)
    with Server(folder.parent) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield folder, server
        server.shutdown()


@pytest.fixture(scope="module")
def ray():
    """A local Ray of two cores, for all tests of this module."""
    with joined_ray(None, 2, 1) as started:
        yield started


def manifest_of(output):
    return json.loads((output / MANIFEST).read_text())


def kill_worker_of(output, partition):
    """Sends SIGKILL to the worker that has begun a partition."""
    os.kill(json.loads((output / f".{partition}.attempt.json").read_text())["pid"], signal.SIGKILL)


@pytest.mark.slow
def test_an_archive_on_ray_interrupted_killed_and_resumed_has_the_boxes_of_one_process(
    ray, served, local, tmp_path, monkeypatch
):
    folder, server = served
    url = f"http://127.0.0.1:{server.server_port}/archive"
    command = ("detect", url, "--output", tmp_path, *SETTINGS, "--engine", "ray", "--jobs", "2")
    command += ("--sweeps-per-partition", "2", "--json")
    check_interrupted(command, tmp_path, monkeypatch)
    check_killed_and_broken(command, url, server, tmp_path, local)
    check_fixed(command, folder, server, tmp_path)
    check_others_are_refused(command)


def check_interrupted(command, output, monkeypatch):
    """Ctrl-C after the first partition."""
    with monkeypatch.context() as patch:
        patch.setattr(ray_engine, "_tell", _interrupt)
        result = run(*command)
    assert result.exit_code == 130, result.output
    assert "--resume goes on" in result.stderr
    manifest = manifest_of(output)
    assert (manifest["finished"], manifest["interrupted"], len(manifest["partitions"])) == (False, True, 1)
    assert run(*command).exit_code == 2, "an output that is not empty is not written over"


def check_killed_and_broken(command, url, server, output, expected):
    """A worker is killed in the middle of a partition, and another has a broken sweep."""
    target = f"/archive/drive_2/{KILLED_AT}.bin"
    for path in output.glob("part-000002*"):
        path.unlink()
    # What a worker leaves that is killed while it sends its file.
    (output / ".part-000002.parquet.0a1b.part").write_bytes(b"half")
    killed = []

    def kill_once(path):
        if path == target and not killed:
            killed.append(path)
            kill_worker_of(output, "part-000002")

    server.before = kill_once
    server.asked.clear()
    result = run(*command, "--resume")
    assert result.exit_code == 1, result.output
    assert killed
    assert server.asked[target] == 2, "and is read again by the worker that took its place"
    assert rows_of(output).equals(expected)
    manifest = manifest_of(output)
    counts = (manifest["num_done"], manifest["num_failed"], manifest["num_boxes"])
    assert counts == (5, 1, len(expected))
    assert manifest["deaths"] == {"part-000002": 1}
    assert "part-000002: a worker died on it; it was begun again" in result.stderr
    (failure,) = manifest["failures"]
    assert failure["url"] == f"{url}/drive_1/{BROKEN}.bin"
    assert failure["reason"].startswith(f"{failure['url']}: 17 bytes is not a multiple of 16")
    summary = json.loads(result.stdout.splitlines()[-1])["summary"]
    assert summary["done"] == 5
    assert summary["repeated"] == [{"partition": "part-000002", "deaths": 1}]
    assert [path.name for path in sorted(output.iterdir())] == [
        "config.toml", "manifest.json", "part-000000.parquet", "part-000001.parquet", "part-000002.parquet",
    ]  # fmt: skip


def check_fixed(command, folder, server, output):
    """The sweep is fixed, and only its partition is done again."""
    server.asked.clear()
    before = {path.name: path.stat().st_mtime_ns for path in output.glob("*.parquet")}
    shutil.copy(folder / "drive_0" / "000.bin", folder / "drive_1" / f"{BROKEN}.bin")
    result = run(*command, "--resume", "--quiet")
    assert result.exit_code == 0, result.output
    changed = [name for name, time in before.items() if (output / name).stat().st_mtime_ns != time]
    assert changed == ["part-000001.parquet"]
    assert [path for path in server.asked if path.endswith(".bin") and "drive_1" not in path] == []
    manifest = manifest_of(output)
    assert (manifest["finished"], manifest["num_done"], manifest["num_skipped"]) == (True, 6, 2)
    assert manifest["num_done_before"] == 4
    assert sum(len(part["status"]) for part in manifest["partitions"]) == 6
    assert manifest["versions"]["jax"] == jax.__version__
    assert io.read_config(output / "config.toml") == DetectorConfig.paper()


def check_others_are_refused(command):
    """Other settings, and other partitions, are not mixed with these."""
    result = run(*command, "--resume", "--set", "vehicles.max_overlap=0.11", "--capacity", "20000")
    assert result.exit_code == 2
    assert "vehicles.max_overlap, capacity differ" in result.stderr.replace("\n", "")
    result = run(*command, "--resume", "--sweeps-per-partition", "4")
    assert result.exit_code == 2
    assert "part-000002.parquet belongs to" in result.stderr.replace("\n", "")


def _interrupt(*_):
    raise KeyboardInterrupt


def test_what_the_workers_cannot_do_is_refused(tmp_path):
    common = ("detect", tmp_path, "--output", tmp_path / "out")
    for arguments, expected in (
        (
            ("--engine", "ray", "--format", "kitti"),
            "--format kitti: the workers of --engine ray write parquet",
        ),
        (("--engine", "ray", "--pictures"), "draw nothing"),
        (("--engine", "ray", "--no-points"), "--points and --no-points: the workers"),
        (("--sweeps-per-partition", "9"), "only --engine ray writes partitions"),
        (("--address", "auto"), "only --engine ray"),
        (("--output", "s3://bucket/out"), "only --engine ray"),
    ):
        result = run(*common, *arguments)
        assert result.exit_code == 2, result.output
        assert expected in result.stderr
    with pytest.raises(ValueError, match="sweeps_per_partition is 0"):
        detect_dataset(tmp_path, tmp_path / "out", sweeps_per_partition=0)
    with pytest.raises(ValueError, match="'fats' is not a preset"):
        detect_dataset(tmp_path, tmp_path / "out", "fats")


# --- drives ---------------------------------------------------------------------------------------

LENGTHS = {"00": 4, "plain": 3}
STEP_M = 1.0
TRACKED = (*SETTINGS, "--track-set", "max_misses=3")


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """A drive past a street with poses, as the odometry benchmark has them, and one without."""
    root = tmp_path_factory.mktemp("drives")
    odometry = root / "sequences" / "00"
    folders = (odometry / "velodyne", root / "plain")
    for seed, folder, length in zip((0, 1), folders, LENGTHS.values(), strict=True):
        street = make_small_sweep(seed)
        for frame in range(length):
            shifted = street.xyz - np.float32([STEP_M * frame, 0, 0])
            folder.mkdir(parents=True, exist_ok=True)
            io.write_bin(folder / f"{frame:06d}.bin", shifted, street.intensity)
    (odometry / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    poses = [f"1 0 0 0 0 1 0 0 0 0 1 {STEP_M * frame}" for frame in range(LENGTHS["00"])]
    (odometry / "poses.txt").write_text("\n".join(poses) + "\n")
    return root


def sources_of(root):
    return [str(root / "sequences" / "00"), str(root / "plain")]


def tracked_here(root, output, *arguments):
    """What one process writes: the rows and the names of the sweeps, of each drive."""
    arguments = ("--output", output, *TRACKED, "--format", "parquet", *arguments)
    result = run("track", *sources_of(root), *arguments)
    assert result.exit_code in (0, 1), result.output
    return tables_of(output)


def tables_of(output):
    tables = {}
    for path in output.glob("*.parquet"):
        names = json.loads(pq.read_metadata(path).metadata[b"jaxbox.sweeps"])
        tables[path.stem] = names, pq.read_table(path).replace_schema_metadata(None)
    return tables


def track_task_for(output, **changes):
    fields = {
        "config": DetectorConfig.paper(), "capacity": None, "min_score": 0.05, "topic": None,
        "num_threads": 1, "versions": versions(), "cache_folders": CacheFolders.of_this_process(),
        "track_config": TrackConfig(max_misses=3.0), "poses": "auto", "estimator": PoseSource.BOXES,
        "rate_hz": 10.0, "max_tracks": 128, "smooth": False, "confirmed": False,
    }  # fmt: skip
    Store(output).make()
    return TrackTask(output=str(output), **{**fields, **changes})


def partitions_of(task, *given):
    return plan(task, group_refs(list_sweeps(list(map(str, given)), None, serially)))


def test_sweeps_are_grouped_by_drive_as_one_process_groups_them(drives, tmp_path):
    write_foxglove(tmp_path / "00.mcap", ["/front"])
    given = [*sources_of(drives), str(tmp_path / "00.mcap")]
    expected = io.group_sequences(io.open_sweeps(given))
    found = group_refs(list_sweeps(given, None, serially))
    assert [name for name, _ in found] == [name for name, _ in expected]
    assert len(found) == 3
    for (_, refs), (_, sweeps) in zip(found, expected, strict=True):
        assert [ref.url for ref in refs] == [str(sweep.points_path) for sweep in sweeps]


def test_sweeps_at_urls_are_grouped_by_folder_and_archive(tmp_path):
    for archive, number in (("a", 0), ("b", 1)):
        with zipfile.ZipFile(tmp_path / f"{archive}.zip", "w") as archived:
            archived.writestr(f"day/{number}.bin", b"")
            archived.writestr(f"{number + 2}.bin", b"")
    # By its name the second is the earlier one.
    names = [f"log__LIDAR_TOP__{time}.pcd.bin" for time in (1533151603547590, 1533151603047590)]
    refs = [SweepRef(name, f"memory://samples/LIDAR_TOP/{name}") for name in names]
    patterns = ("zip://*.bin", "zip://day/*.bin")
    urls = [f"{pattern}::{tmp_path}/{archive}.zip" for pattern in patterns for archive in "ab"]
    refs += list_sweeps(urls, None, serially)
    found = dict(group_refs(refs))
    assert list(found) == ["log", "a.zip", "b.zip", "a.zip_day_day", "b.zip_day_day"]
    assert [ref.name for ref in found["log"]] == names[::-1]
    assert [ref.name for ref in found["b.zip_day_day"]] == ["1"]


@pytest.mark.parametrize("options", [(), ("--smooth", "--confirmed")])
def test_a_worker_writes_the_tracks_of_one_process(drives, tmp_path, options):
    local = tracked_here(drives, tmp_path / "local", "--poses", "auto", *options)
    assert {name: len(names) for name, (names, _) in local.items()} == LENGTHS
    changes = {"smooth": True, "confirmed": True} if options else {}
    task = track_task_for(tmp_path / "out", estimator=estimated_source(), **changes)
    reports = [TrackWorker(task).work(part) for part in partitions_of(task, *sources_of(drives))]
    assert [report.error for report in reports] == [None, None]
    assert tables_of(tmp_path / "out") == local
    first, second = reports
    assert (first.pose_source, second.pose_source) == ("pose file", str(estimated_source()))
    assert "poses.txt" in first.notes[0]
    for name, report in zip(LENGTHS, reports, strict=True):
        names, table = local[name]
        assert (report.num_done, report.num_boxes) == (LENGTHS[name], len(table))
        assert list(report.status) == list(report.track_status) == names
        assert report.num_tracks == len(set(table["id"].to_pylist())) > 1
        metadata = pq.read_metadata(tmp_path / "out" / f"{name}.parquet").metadata
        assert DriveReport.from_json(metadata[worker.REPORT_KEY.encode()]) == report
    assert second.num_bytes == sum(path.stat().st_size for path in (drives / "plain").glob("*.bin"))


def test_a_drive_at_a_url_has_the_tracks_of_local_points_with_estimated_poses(drives, tmp_path):
    local = tracked_here(drives, tmp_path / "local", "--poses", "boxes")
    with zipfile.ZipFile(tmp_path / "archive.zip", "w") as archived:
        for path in sorted(drives.rglob("*.bin")):
            archived.write(path, path.relative_to(drives))
    task = track_task_for(tmp_path / "out")
    urls = [f"zip://{folder}::{tmp_path}/archive.zip" for folder in ("sequences/00", "plain")]
    reports = [TrackWorker(task).work(part) for part in partitions_of(task, *urls)]
    assert tables_of(tmp_path / "out") == local
    for report in reports:
        assert report.pose_source == "boxes"
        assert "at a URL are not fetched" in report.notes[0]
    assert reports[1].num_bytes == sum(path.stat().st_size for path in (drives / "plain").glob("*.bin"))
    task = track_task_for(tmp_path / "registered", poses="kiss-icp")
    if estimated_source() is PoseSource.KISS_ICP:
        local = tracked_here(drives, tmp_path / "here", "--poses", "kiss-icp")
        for part in partitions_of(task, *urls):
            assert TrackWorker(task).work(part).error is None
        assert tables_of(tmp_path / "registered") == local


def test_a_recording_is_a_drive_and_what_is_read_before_it_breaks_off_is_there(tmp_path, monkeypatch):
    write_foxglove(tmp_path / "drive.mcap", ["/front"])
    arguments = ("--output", tmp_path / "local", *TRACKED, "--format", "parquet", "--poses", "boxes")
    assert run("track", tmp_path / "drive.mcap", *arguments).exit_code == 0
    task = track_task_for(tmp_path / "out")
    (part,) = partitions_of(task, tmp_path / "drive.mcap")
    report = TrackWorker(task).work(part)
    assert report.error is None
    assert report.num_bytes > 0
    assert tables_of(tmp_path / "out") == tables_of(tmp_path / "local")
    iterate = io.RecordedSweeps.__iter__

    def break_off(self):
        for index, sweep in enumerate(iterate(self)):
            if index == len(self) - 1:
                raise io.InputError(f"{self.path}: it is cut short")
            yield sweep

    monkeypatch.setattr(io.RecordedSweeps, "__iter__", break_off)
    report = TrackWorker(task).work(part)
    assert report.error is None
    assert report.num_done == len(part.refs) - 1
    assert [item["sweep"] for item in report.failures] == ["drive"]
    assert report.failures[0]["reason"].endswith("it is cut short")


def test_a_drive_that_kills_its_workers_is_given_up_and_one_without_points_has_no_file(drives, tmp_path):
    task = track_task_for(tmp_path / "out")
    store = Store(task.output)
    parts = partitions_of(task, *sources_of(drives))
    for _ in range(worker.MAX_DEATHS):
        # What an attempt leaves whose worker died.
        Attempt(store, "plain").begin("plain")
    report = TrackWorker(task).work(parts[1])
    assert (report.num_deaths, report.num_done) == (2, 0)
    assert "died 2 times" in report.error
    assert store.names() == []
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "0.bin").write_bytes(b"abc")
    report = TrackWorker(task).work(partitions_of(task, tmp_path / "empty")[0])
    assert "none of its sweeps went through" in report.error
    assert [item["sweep"] for item in report.failures] == ["0"]
    assert list((tmp_path / "out").glob("*.parquet")) == []


@pytest.mark.slow
def test_drives_on_ray_broken_mended_killed_and_resumed_have_the_tracks_of_one_process(ray, drives, tmp_path):
    root, output = tmp_path / "drives", tmp_path / "out"
    shutil.copytree(drives, root)
    broken = root / "plain" / "000001.bin"
    whole = broken.read_bytes()
    broken.write_bytes(whole[:-3])
    local = tracked_here(root, tmp_path / "local", "--poses", "boxes")
    assert {name: len(names) for name, (names, _) in local.items()} == {"00": 4, "plain": 2}
    with Server(tmp_path) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}/drives/plain"
        command = ("track", root / "sequences" / "00", url, "--output", output, *TRACKED, "--poses", "boxes")
        command += ("--engine", "ray", "--jobs", "2")
        result = run(*command, "--json")
        assert result.exit_code == 1, result.output
        assert tables_of(output) == local
        lines = [json.loads(line) for line in result.stdout.splitlines()]
        assert {line["name"]: line["num_sweeps"] for line in lines[:-1]} == LENGTHS
        assert lines[-1]["summary"]["done"] == 6
        manifest = manifest_of(output)
        (failure,) = manifest["failures"]
        assert (failure["sweep"], failure["url"]) == ("plain_000001", f"{url}/000001.bin")
        assert "is not a multiple of 16" in failure["reason"]
        assert (manifest["options"]["poses"], manifest["options"]["track"]["max_misses"]) == ("boxes", 3.0)
        assert not manifest["finished"]

        # The sweep is repaired, only its drive is done again, and its worker dies in the middle.
        broken.write_bytes(whole)
        before = {path.name: path.stat().st_mtime_ns for path in output.glob("*.parquet")}
        target, killed = "/drives/plain/000002.bin", []

        def kill_once(path):
            if path == target and not killed:
                killed.append(path)
                kill_worker_of(output, "plain")

        server.before = kill_once
        server.asked.clear()
        result = run(*command, "--resume")
        other = run(*command, "--resume", "--track-set", "max_misses=6", "--confirmed")
        server.shutdown()
    assert result.exit_code == 0, result.output
    assert killed
    assert server.asked[target] == 2, "and is read again by the worker that took its place"
    assert "plain: 3 of 3 sweeps" in result.stdout
    changed = [name for name, time in before.items() if (output / name).stat().st_mtime_ns != time]
    assert changed == ["plain.parquet"]
    manifest = manifest_of(output)
    assert (manifest["finished"], manifest["num_skipped"], manifest["deaths"]) == (True, 1, {"plain": 1})
    assert tables_of(output) == tracked_here(root, tmp_path / "repaired", "--poses", "boxes")
    names = ["00.parquet", "config.toml", "manifest.json", "plain.parquet"]
    assert sorted(path.name for path in output.iterdir()) == names

    # Other settings, and other drives, are not mixed with these.
    assert other.exit_code == 2
    assert "confirmed, track differ" in other.stderr.replace("\n", "")
    result = run("track", root / "plain", *command[3:], "--resume")
    assert result.exit_code == 2
    assert "00.parquet belongs to" in result.stderr.replace("\n", "")


def test_what_the_workers_cannot_do_for_drives_is_refused(drives, tmp_path):
    common = ("track", drives / "plain", "--output", tmp_path / "out")
    for arguments, expected in (
        (
            ("--engine", "ray", "--format", "kitti"),
            "--format kitti: the workers of --engine ray write parquet",
        ),
        (("--engine", "ray", "--pictures"), "--pictures: the workers"),
        (("--engine", "ray", "--video"), "--video: the workers"),
        (("--engine", "ray", "--gif"), "--gif: the workers"),
        (("--engine", "ray", "--no-points"), "--points and --no-points: the workers"),
        (("--engine", "ray", "--coasting"), "--coasting: the workers"),
        (("--engine", "ray", "--level"), "--level: the workers"),
        (("--engine", "ray", "--min-score", "0.1,van=0.2"), "--min-score by class: the workers"),
        (("--engine", "ray", "--sensor-at", "0", "0", "1"), "--sensor-at: the workers"),
        (("--engine", "ray", "--axes", "enu"), "--scale, --axes, --flip and --columns: the workers"),
        (("--engine", "ray", "--poses", "nowhere.txt"), "nowhere.txt: no such file or folder of poses"),
        (("--engine", "ray", "--rate-hz", "0"), "--rate-hz is 0"),
        (("--address", "auto"), "only --engine ray"),
        (("--output", "s3://bucket/out"), "only --engine ray"),
    ):
        result = run(*common, *arguments)
        assert result.exit_code == 2, result.output
        assert expected in result.stderr
    with pytest.raises(io.InputError, match=r"poses of a file are for points on a disk, and memory://a is"):
        track_dataset("memory://a", tmp_path / "out", poses=drives / "sequences" / "00" / "poses.txt")
    with pytest.raises(ValueError, match="max_tracks is 0"):
        track_dataset(drives / "plain", tmp_path / "out", max_tracks=0)
    with pytest.raises(ValueError, match="rate_hz is 0"):
        track_dataset(drives / "plain", tmp_path / "out", rate_hz=0)
    with pytest.raises(ValueError, match="gate is -1"):
        track_dataset(drives / "plain", tmp_path / "out", track_config=TrackConfig(gate=-1))
    with pytest.raises(ValueError, match="'fats' is not a preset"):
        track_dataset(drives / "plain", tmp_path / "out", "fats")


# --- errors ---------------------------------------------------------------------------------------


def test_without_ray_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    result = run("detect", tmp_path, "--output", tmp_path / "out", "--engine", "ray")
    assert result.exit_code == 2
    assert "pip install 'jaxbox[ray]'" in result.stderr


def test_the_rate_counts_the_sweeps_of_this_run_alone(tmp_path, monkeypatch):
    parts = [
        PartitionReport(name=f"part-{number:06d}", key="", num_sweeps=3, status=dict.fromkeys("abc", 0))
        for number in range(3)
    ]
    report = DatasetReport(partitions=parts, num_skipped=2, num_done_before=6, workers=1, elapsed_s=6.0)
    monkeypatch.setattr(detect_ray, "detect_dataset", lambda *_, **__: report)
    result = run("detect", tmp_path, "--output", tmp_path / "out", "--engine", "ray", "--resume")
    assert result.exit_code == 0, result.output
    assert "3 sweeps done, 0 failed, 6 done before" in result.stdout
    assert "6.0 s in all with starting and compiling, 0.5 sweeps a second" in result.stdout


def test_where_ray_gives_up_the_command_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(detect_ray, "detect_dataset", _give_up)
    result = run("detect", tmp_path, "--output", tmp_path / "out", "--engine", "ray")
    assert result.exit_code == 1
    assert "no node is left. The partitions that are done stay" in result.stderr.replace("\n", " ")


def _give_up(*_, **__):
    raise ClusterError("no node is left.")


def test_the_report_counts_lost_partitions_among_the_failures():
    lost = PartitionReport(name="part-000001", key="", num_sweeps=2, error="OSError: full")
    done = PartitionReport(name="part-000000", key="", num_sweeps=2, status={"a": 0, "b": 4}, num_deaths=2)
    report = DatasetReport(partitions=[done, lost])
    assert report.failures == [{"sweep": "part-000001", "url": "", "reason": "OSError: full"}]
    assert (report.num_done, report.deaths) == (2, {"part-000000": 2})
    # Each of its sweeps is missing, and not one.
    assert (report.num_failed, report.summary()["num_failed"]) == (2, 2)


def test_what_became_of_the_poses_of_a_drive_is_said(monkeypatch, tmp_path):
    note = "Poses are estimated: those next to points at a URL are not fetched."
    part = DriveReport(name="drive", key="", num_sweeps=1, status={"a": 0}, notes=[note])

    def track_all(*_, on_report, **__):
        on_report(part, 1)
        return DatasetReport(partitions=[part])

    monkeypatch.setattr("jaxbox.cli.track_ray.track_dataset", track_all)
    result = run("track", tmp_path, "--output", tmp_path / "out", "--engine", "ray")
    assert result.exit_code == 0, result.output
    assert f"drive: {note}" in result.stdout.splitlines()


def test_what_is_no_report_of_a_partition_is_refused():
    with pytest.raises(ValueError, match="not the report"):
        PartitionReport.from_json('{"name": "a"}')
