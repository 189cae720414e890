"""The benchmarks of time and memory: what they count, and when the guard of CI bites."""

import importlib.util
import json
import pathlib

import numpy as np
import pytest

from jaxbox.cluster import DatasetReport, PartitionReport

CAR = [10.0, 2.0, 4.0, 1.8, 0.3]


@pytest.fixture
def benchmark(monkeypatch):
    """Imports a benchmark by its name."""
    monkeypatch.syspath_prepend(str(pathlib.Path(__file__).parents[1]))
    return lambda name: importlib.import_module(f"benchmarks.{name}")


def points_on(box, height=1.5, count=400):
    """(count, 3) points on two sides of a box, as a sensor sees them."""
    rng = np.random.default_rng(0)
    x, y, length, width, yaw = box
    along, side = rng.uniform(-0.5, 0.5, count), np.arange(count) % 2 == 0
    local = np.where(side[:, None], [[1, 0]], [[0, 1]]) * along[:, None] + np.where(
        side[:, None], [[0, -0.5]], [[-0.5, 0]]
    )
    local = local * [length, width]
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return np.column_stack([local @ turn + [x, y], rng.uniform(0, height, count)])


def test_a_car_is_found_by_a_box_that_covers_it_well(benchmark):
    peers = benchmark("bench_peers")
    half_off = [CAR[0] + 2 * np.cos(0.3), CAR[1] + 2 * np.sin(0.3), *CAR[2:]]
    assert peers.overlap(np.array(CAR), np.array(CAR)) == pytest.approx(1, abs=1e-3)
    assert peers.overlap(np.array(CAR), np.array(half_off)) == pytest.approx(1 / 3, abs=1e-3)
    assert peers.overlap(np.array(CAR), np.array([-9.0, *CAR[1:]])) == 0
    cars = np.array([CAR, [-20.0, *CAR[1:]]])
    assert peers.count_found(cars, np.array([half_off, CAR])) == 1
    assert peers.count_found(cars, np.zeros((0, 5))) == 0


def test_the_chains_rectangle_is_that_of_the_sides_and_the_gate_lets_vehicles_pass(benchmark):
    chains = benchmark("peers.chains")
    row = chains.fit_rectangle(points_on(CAR))
    assert row[:4] == pytest.approx(CAR[:4], abs=0.05)
    assert np.sin(2 * (row[4] - CAR[4])) == pytest.approx(0, abs=0.05)
    wall = [0, 0, 30.0, 0.5, 0, 2.0, 0]
    assert chains.gate_sizes(np.array([row, wall])).shape == (1, 5)
    assert chains.gate_sizes(np.zeros(0)).shape == (0, 5)


def test_clusters_become_boxes_and_those_with_few_points_do_not(benchmark):
    chains = benchmark("peers.chains")
    xyz = np.concatenate([points_on(CAR), points_on([30.0, *CAR[1:]]), [[0, 0, 0]] * 5])
    cluster = np.repeat([4, 1, 2, -1], [400, 400, 3, 2])
    answer = chains.box_clusters(xyz, cluster)
    assert (answer.kept, answer.clusters, len(answer.boxes)) == (805, 2, 2)
    np.testing.assert_array_equal(
        chains.voxel_clusters(xyz[:400], lambda p: np.arange(len(p)) * 0 + 7), np.full(400, 7)
    )


def test_a_missing_peer_is_named_with_the_command_that_installs_it(benchmark, monkeypatch):
    chains = benchmark("peers.chains")

    def absent():
        raise chains.MissingPeer("pip install it")

    monkeypatch.setattr(chains, "PEERS", {"there": lambda: len, "absent": absent})
    assert chains.make_peers(["there", "absent"]) == ({"there": len}, {"absent": "pip install it"})


def test_the_guard_bites_below_its_share_of_the_recorded_ratio(benchmark, tmp_path):
    peers = benchmark("bench_peers")
    file = tmp_path / "guard.json"
    file.write_text(json.dumps({"times_faster_than_reference": {"jaxbox default": 100.0, "other": 1.0}}))
    limit = 100 * peers.GUARD_SHARE
    assert peers.check_guard({"jaxbox default": limit + 1}, file) == []
    (failure,) = peers.check_guard({"jaxbox default": limit - 1}, file)
    assert failure.startswith("jaxbox default: ")
    assert peers.ratios({"reference": {"median": 9.0}, "jaxbox paper": {"median": 3.0}}) == {
        "jaxbox paper": 3.0
    }


def test_sweeps_of_any_size_are_made_of_real_ones(benchmark):
    scaling = benchmark("bench_scaling")
    clouds = [np.full((10, 3), i, np.float32) for i in range(2)]
    assert scaling.resize(clouds, 4).shape == (4, 3)
    assert scaling.resize(clouds, 35).shape == (35, 3)


def test_throughput_is_measured_by_cores_on_a_cpu_and_by_devices_on_accelerators(benchmark, monkeypatch):
    scaling = benchmark("bench_scaling")
    assert [on for call, on, *_ in scaling.ways_on_a_cpu(2) if call == "stream"] == [
        "one core",
        "all cores",
        "2 devices",
        "2 workers",
    ]
    assert [way[:2] for way in scaling.ways_on_accelerators(16, 1)] == [
        ("detect_batch", "devices: 1"),
        ("stream", "devices: 1"),
    ]

    def called(function, arguments):
        return ("cuda", 2) if function is scaling.describe_devices else float(arguments[4])

    monkeypatch.setattr(scaling, "in_a_process", called)
    rows = scaling.throughput([], "fast", 10, 2)
    assert [(row["sweeps_per_s"], row["times_the_first"]) for row in rows] == [(1, 1), (2, 2)] * 2


def test_checkouts_that_take_turns_are_held_against_each_other(benchmark, tmp_path):
    in_turn = benchmark("in_turn")
    calls = []

    class Fake:
        def __init__(self, name, ms, boxes):
            self.name, self.ms, self.boxes = name, ms, boxes

        def detect(self, sweep):
            calls.append((self.name, sweep))
            return self.ms, self.boxes.get(sweep, "same")

    one, other = Fake("one", 3.0, {"b": "moved"}), Fake("other", 4.0, {})
    found = in_turn.take_turns((one, other), ["a", "b"], 2)
    assert found["mean_of_least_ms"] == [3.0, 4.0]
    assert (found["ratio_of_means"], found["ratio_quartiles"]) == (0.75, [0.75] * 3)
    assert found["sweeps_with_other_boxes"] == 1
    turns = [[name for name, _ in calls[2 + k : 4 + k]] for k in range(0, 8, 2)]
    assert turns == [["one", "other"], ["other", "one"], ["other", "one"], ["one", "other"]]
    assert [sweep for _, sweep in calls[2:]] == list("aabb") * 2


def test_the_least_times_and_the_ratios_of_turns_are_told(benchmark):
    in_turn = benchmark("in_turn")
    spent_ms = np.array([[[1.0, 4.0], [3.0, 2.0]], [[2.0, 4.0], [2.0, 8.0]]])
    found = in_turn.summarize_turns(spent_ms)
    assert found["mean_of_least_ms"] == [1.5, 3.0]
    assert found["median_ms"] == [2.5, 3.0]
    assert found["ratio_quartiles"] == np.percentile([0.5, 1.0, 1.5, 0.25], [25, 50, 75]).tolist()


FAKE_JAXBOX = """
import dataclasses, types
import numpy as np
class DetectorConfig:
    presets = staticmethod(lambda: {"default": 0.0})
class PointCloud:
    from_numpy = staticmethod(lambda xyz, intensity: xyz)
def detect(cloud, config):
    return types.SimpleNamespace(**dict.fromkeys(["center", "size", "yaw", "score", "label", "valid"], cloud))
"""


def test_a_checkout_runs_its_own_jaxbox_and_says_what_is_wrong(benchmark, tmp_path):
    in_turn = benchmark("in_turn")
    with pytest.raises(SystemExit, match="not a checkout of jaxbox"):
        in_turn.Checkout(tmp_path, "default")
    (tmp_path / "jaxbox").mkdir()
    (tmp_path / "jaxbox" / "__init__.py").write_text(FAKE_JAXBOX)
    np.save(tmp_path / "a.npy", np.zeros((5, 4), np.float32))
    np.save(tmp_path / "b.npy", np.ones((5, 4), np.float32))
    with in_turn.Checkout(tmp_path, "default") as checkout:
        zeros, ones, again = (checkout.detect(tmp_path / f"{name}.npy") for name in "aba")
        assert zeros[0] > 0
        assert zeros[1] == again[1] != ones[1]
        with pytest.raises(SystemExit, match="ended with exit code 1"):
            checkout.detect(tmp_path / "absent.npy")


def test_every_chunk_size_has_a_benchmark_or_what_chose_it(benchmark):
    sizes, stages = benchmark("bench_chunks"), benchmark("bench_stages")
    names = {name for name in vars(sizes.chunks) if name.isupper()}
    assert names == sizes.USES.keys() | sizes.FIXED.keys()
    assert not sizes.USES.keys() & sizes.FIXED.keys()
    assert {use.step for use in sizes.USES.values()} <= set(stages.STEPS)


def test_a_step_is_compiled_with_another_chunk_size_and_the_table_is_as_before(benchmark):
    sizes = benchmark("bench_chunks")
    before = sizes.chunks.RAYS

    def step(values):
        return values + sizes.chunks.RAYS

    assert int(sizes.compile_with("RAYS", 7, step, (np.int32(1),))(np.int32(1))) == 8
    assert before == sizes.chunks.RAYS
    times = sizes.time_sizes("RAYS", step, [(np.int32(1),), (np.int32(2),)], 2)
    assert list(times) == [before // 2, before, 2 * before]
    assert all(0 < ms < 1e3 for ms in times.values())
    with pytest.raises(SystemExit, match="NOTHING: choose from FILTER_BLOCKS"):
        sizes.main(["NOTHING"])


def test_bits_of_a_batch_are_compared_with_each_single(benchmark):
    scaling = benchmark("bench_scaling")
    batch = {"a": np.array([[1.0, 2.0], [3.0, 4.0]])}
    singles = [{"a": np.array([1.0, 2.0])}, {"a": np.array([3.0, 4.0])}]
    assert scaling.same_bits(batch, singles)
    singles[1]["a"][0] = np.nextafter(3.0, 4.0)
    assert not scaling.same_bits(batch, singles)


def test_a_run_of_a_cluster_is_put_in_numbers_and_carried_to_an_archive(benchmark):
    cluster = benchmark("bench_cluster")
    common = {"key": "", "num_sweeps": 30, "num_boxes": 60, "num_bytes": 60_000, "detect_s": 1.0}
    parts = [
        PartitionReport(name="a", worker="n:1", seconds=2.0, compile_s=5.0, peak_mb=600, **common),
        PartitionReport(name="b", worker="n:1", seconds=2.0, **common),
        PartitionReport(name="c", worker="n:2", seconds=2.0, compile_s=4.0, peak_mb=700, **common),
    ]
    figures = cluster.summarise(DatasetReport(partitions=parts, elapsed_s=12.0), 9000)
    assert figures["sweeps_per_second_per_worker"] == 15
    assert figures["sweeps_per_second"] == 30
    assert figures["waiting_for_detector_share"] == 0.5
    assert (figures["compile_s"], figures["start_and_end_s"], figures["peak_mb_per_worker"]) == (5, 3, 700)
    assert (figures["bytes_read_per_sweep"], figures["bytes_written_per_sweep"]) == (2000, 100)
    million = cluster.archives(figures)["1000000"]
    assert million["core_hours"] == pytest.approx(1e6 / 15 / 3600)
    assert million["hours_on_1000_cores"] == pytest.approx(million["core_hours"] / 1000)
    assert (million["terabytes_read"], million["gigabytes_written"]) == pytest.approx((0.002, 0.1))
    assert cluster.worker_counts(6) == [1, 2, 4, 6]


def test_the_report_of_a_cluster_fills_the_tables_of_its_page(benchmark, tmp_path, monkeypatch, capsys):
    cluster = benchmark("bench_cluster")
    names = [name for _, name, _ in load_hook().CLUSTER_ROWS]
    monkeypatch.setattr(cluster, "link_sweeps", lambda folder, count: None)
    monkeypatch.setattr(cluster, "run_cluster", lambda *_: {name: 2e3 for name in names})
    monkeypatch.setattr(cluster, "run_stream", lambda *_: 3.0)
    cluster.main(["--quick", "--json", str(tmp_path / "cluster.json")])
    assert "1e+09" in capsys.readouterr().out
    hook = load_hook()
    assert "sweeps a second and worker" in hook.cluster()
    hook.RESULTS = {"cluster": tmp_path / "cluster.json"}
    page = hook.on_page_markdown("<!-- table: cluster -->\n<!-- table: archives -->")
    assert "| read, MB a sweep | 0.002 |" in page
    assert "| 1,000,000,000 | 138.9 |" in page


def load_hook():
    """The module that fills the pages' tables."""
    path = pathlib.Path(__file__).parents[1] / "docs" / "hooks" / "figures.py"
    spec = importlib.util.spec_from_file_location("figures", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_times_of_a_sequence_are_put_in_order_by_sweep_and_pass(benchmark):
    tracking = benchmark("bench_tracking_step")
    # Two sequences of two and three sweeps, three passes each, of which the first compiles.
    rows = [
        (length, 100.0 if number == 0 else 10 * sweep + number, 1.0, 2.0)
        for length in (3, 2)
        for number in range(3)
        for sweep in range(length)
    ]
    figures = tracking.summarise(np.array(rows), 2)
    assert figures["num_sweeps"] == 5
    assert (figures["ms"]["detect"]["runs"], figures["ms"]["detect"]["min"]) == (10, 1)
    # The best of each sweep: 1, 11, 21 and 1, 11.
    assert figures["ms"]["detect"]["median_of_best"] == 11
    assert figures["ms"]["track_step"]["p99"] == 2
    # The loop that an accelerator's host waits for is that of the assignment.
    assert tracking.count_loops() == 1
