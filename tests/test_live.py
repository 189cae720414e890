"""`jaxbox live`: the newest sweep wins, silences are reported, and results are served."""

import contextlib
import dataclasses
import functools
import itertools
import json
import socket
import threading
import time
import types

import numpy as np
import pytest
import websockets.sync.client

from jaxbox import io, synthetic
from jaxbox._padding import fitting_capacity
from jaxbox.io import InputError, TimedPoints, mcap_results
from jaxbox.io.results import SweepResult
from jaxbox.live import (
    Fault,
    Latencies,
    LiveRun,
    LiveSweep,
    RecordedSource,
    foxglove,
    loop,
    page,
    recorded,
)
from jaxbox.live.mailbox import Closed, Mailbox
from jaxbox.live.mounted import MountedSource
from jaxbox.run.streaming import StreamedSweep

NS = 10**9


def points(count=1):
    return TimedPoints(np.zeros((count, 3), np.float32), np.zeros(count, np.float32))


def sweep(frame, *, count=1):
    return LiveSweep(
        name=f"{frame:06d}",
        frame=frame,
        timestamp_ns=frame * NS // 10,
        arrived_ns=time.time_ns(),
        points=points(count),
    )


# The mailbox, and the figures.


def test_the_newest_wins_and_what_it_replaces_is_counted():
    mailbox = Mailbox()
    for item in "abc":
        mailbox.put(item)
    assert (mailbox.take(), mailbox.num_skipped) == ("c", 2)
    assert mailbox.take(0.01) is None


def test_the_last_item_is_fetched_before_the_end_or_the_error_is_told():
    mailbox = Mailbox()
    mailbox.put("a")
    mailbox.close()
    assert mailbox.take() == "a"
    with pytest.raises(Closed):
        mailbox.take()
    broken = Mailbox()
    broken.close(InputError("cut off"))
    with pytest.raises(InputError, match="cut off"):
        broken.take()


def test_latencies_are_of_the_last_sweeps_only():
    latencies = Latencies(window=10)
    for seconds in [9.0] * 100 + [0.5] * 10:
        latencies.add(seconds)
    assert (len(latencies), latencies.quantiles_ms()) == (10, (500.0, 500.0))
    assert all(map(np.isnan, Latencies().quantiles_ms()))


# Recordings.


def recording(times_s, *, broken=()):
    """Sweeps of one point each, taken at some times; None for no time."""

    def read(index):
        if index in broken:
            raise InputError("cut off")
        return points()

    return [
        types.SimpleNamespace(
            name=str(index),
            timestamp_ns=None if time_s is None else round(time_s * NS),
            read_timed_points=functools.partial(read, index),
        )
        for index, time_s in enumerate(times_s)
    ]


def came(source):
    """The sweeps and faults of a source."""
    return [item for item in source if item is not None]


def test_a_recording_keeps_its_own_pace_and_times():
    begin_ns = time.time_ns()
    found = came(RecordedSource(recording([5, 5.03, 5.15]), name="a"))
    assert [item.timestamp_ns for item in found] == [5 * NS, 5.03 * NS, 5.15 * NS]
    assert [item.frame for item in found] == [0, 1, 2]
    came_s = np.array([item.arrived_ns - begin_ns for item in found]) / NS
    assert (came_s >= [0, 0.03, 0.15]).all()
    # A busy machine may be late, but no later sweep pays for it.
    assert came_s[-1] < 1


def test_without_times_sweeps_come_by_the_rate():
    found = came(RecordedSource(recording([None] * 4), name="a", rate_hz=100))
    assert np.diff([item.timestamp_ns for item in found]).tolist() == [NS // 100] * 3
    with pytest.raises(ValueError, match="rate_hz"):
        RecordedSource([], name="a", rate_hz=0)


def test_where_time_goes_back_another_drive_begins_at_once():
    found = came(RecordedSource(recording([1000, 1000.02, 3, 3.02, 900]), name="a", rate_hz=100))
    steps_s = np.diff([item.timestamp_ns for item in found]) / NS
    gap_s = recorded.DRIVE_GAP_S
    np.testing.assert_allclose(steps_s, [0.02, gap_s, 0.02, gap_s])
    assert found[-1].arrived_ns - found[0].arrived_ns < NS


def test_a_loop_begins_again_as_another_drive():
    source = RecordedSource(recording([1, 1.01]), name="a", rate_hz=100, loop=True)
    found = list(itertools.islice((item for item in source if item is not None), 5))
    steps_s = np.diff([item.timestamp_ns for item in found]) / NS
    np.testing.assert_allclose(steps_s, [0.01, recorded.DRIVE_GAP_S, 0.01, recorded.DRIVE_GAP_S])
    assert [item.frame for item in found] == [0, 1, 2, 3, 4]
    assert came(RecordedSource([], name="a", loop=True)) == []


def test_a_broken_sweep_is_a_fault_and_the_others_come():
    first, fault, last = came(RecordedSource(recording([0, 0.01, 0.02], broken={1}), name="a"))
    assert fault == Fault("1: cut off")
    assert last.timestamp_ns - first.timestamp_ns == 0.02 * NS


# The loop.


class FakeSource:
    """Hands out what it is given; a number is a silence of so many seconds."""

    name, hint, is_open = "fake://", "is it on?", False

    def __init__(self, items, *, can_wait=False):
        self.items, self.can_wait = items, can_wait

    def __iter__(self):
        for item in self.items:
            if isinstance(item, float):
                time.sleep(item)
                yield None
            elif isinstance(item, Exception):
                raise item
            else:
                yield item


@pytest.fixture
def compiled(monkeypatch):
    """The capacities of the pipelines that were made, which find nothing, slowly."""
    capacities = []

    class FakePipeline:
        def __init__(self, config, *, capacity):
            self.detector, self.capacity = config.detector, capacity
            capacities.append(capacity)

        def __call__(self, item):
            time.sleep(0.03)
            return StreamedSweep(item.name, item.num_points, None, None)

    monkeypatch.setattr(loop, "Pipeline", FakePipeline)
    return capacities


def run_live(items, *, can_wait=False, capacity=None, timeout_s=5.0):
    told = []
    run = LiveRun(
        FakeSource(items, can_wait=can_wait), capacity=capacity, timeout_s=timeout_s, report=told.append
    )
    return run, list(run), told


def test_every_sweep_is_done_or_counted_and_the_last_one_is_done(compiled):
    items = [item for frame in range(30) for item in (sweep(frame), 0.005)]
    run, results, _ = run_live(items, capacity=64)
    frames = [result.sweep.frame for result in results]
    assert frames == sorted(set(frames))
    assert frames[-1] == 29
    assert 0 < run.num_skipped == 30 - len(frames)
    assert all(0.03 <= result.latency_s < 1 for result in results)
    assert compiled == [64]


def test_the_capacity_holds_the_first_sweep_with_headroom(compiled):
    _, results, told = run_live([sweep(0, count=16_384), 0.1], can_wait=True)
    assert compiled == [fitting_capacity(round(16_384 * loop.HEADROOM))] == [32_768]
    assert "32,768" in told[0]
    # A recording waited for the compiler, and lost nothing.
    assert [result.sweep.frame for result in results] == [0]


def test_what_a_sensor_sends_while_all_is_compiled_is_skipped(compiled):
    run, results, _ = run_live([sweep(0), 0.1, sweep(1)])
    assert [result.sweep.frame for result in results] == [1]
    assert run.num_skipped == 1


def test_larger_sweeps_are_reported_once(compiled):
    _, results, told = run_live([sweep(0, count=99), 0.5, sweep(1, count=99), 0.1], capacity=64)
    assert len(results) == 2
    assert [
        sentence for sentence in told if "99 points" in sentence and "--capacity 16384" in sentence
    ] == told
    assert len(told) == 1


def test_a_silence_is_reported_once_and_its_end(compiled):
    _, results, told = run_live([sweep(0), 0.5, sweep(1)], capacity=64, timeout_s=0.1)
    assert [result.sweep.frame for result in results] == [0, 1]
    silent, again = told
    assert "nothing from fake:// for 0.1 s: is it on?" in silent
    assert "there again" in again


def test_faults_are_counted_and_the_first_are_told(compiled):
    run, results, told = run_live([Fault("odd packet")] * 20 + [sweep(0)], capacity=64)
    assert (run.num_faults, len(results), results[0].num_faults) == (20, 1, 20)
    assert told == ["odd packet"] * 4 + ["odd packet; more of them are counted only"]


def test_what_ends_the_source_ends_the_run_after_its_last_sweep(compiled):
    run = LiveRun(FakeSource([sweep(0), InputError("cut off")]), capacity=64)
    results = iter(run)
    assert next(results).sweep.frame == 0
    with pytest.raises(InputError, match="cut off"):
        next(results)


def test_a_run_that_is_left_ends_its_thread(compiled):
    before = threading.active_count()
    with contextlib.closing(iter(LiveRun(FakeSource([sweep(0)] + [0.05] * 200), capacity=64))) as results:
        next(results)
        assert threading.active_count() == before + 1
    assert threading.active_count() == before


def test_other_settings_are_used_from_the_next_sweep_on(compiled):
    run = LiveRun(FakeSource([sweep(0), 0.5, sweep(1)]), capacity=64)
    seen = []
    for _ in run:
        run.use("other")
        seen.append(run._config.detector)
    assert seen == ["other", "other"]


def test_a_sensor_with_other_axes_and_units_is_turned():
    item = dataclasses.replace(sweep(0), points=TimedPoints(np.array([[0.0, 1500, 9000]]), np.zeros(1)))
    convention = io.PointConvention(scale=0.001, axes="camera")
    source = MountedSource(
        FakeSource([item]), position=(0, 0, -1), level=False, convention=convention, report=print
    )
    (found,) = came(source)
    np.testing.assert_allclose(found.points.xyz, [[9, 0, -0.5]], atol=1e-6)


def test_a_tilted_sensor_is_levelled_after_its_first_sweeps():
    street = synthetic.make_sweep(0, num_azimuths=250)
    # 5 degrees about y: the ground ahead seems to fall.
    tilt = np.radians(5)
    turn = np.array(
        [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]], np.float32
    )
    tilted = TimedPoints(street.xyz @ turn.T, street.intensity)
    items = [sweep(frame) for frame in range(7)]
    items = [LiveSweep(**{**vars(item), "points": tilted}) for item in items]
    told = []
    source = MountedSource(FakeSource(items), position=(0.0, 0.0, 0.0), level=True, report=told.append)
    found = came(source)
    assert [item.frame for item in found] == [5, 6]
    assert told[0].tilt_deg == pytest.approx(5, abs=0.5)
    np.testing.assert_allclose(found[0].points.xyz[:, 2], street.xyz[:, 2], atol=0.5)


# Sinks.


RECORD = {
    "name": "000007",
    "timestamp_ns": 1_700_000_000_500_000_000,
    "T_world_sensor": np.eye(4).tolist(),
    "boxes": [
        {
            "id": 3,
            "label": "car",
            "score": 0.5,
            "center": [1.0, 2.0, 3.0],
            "size": [4.0, 2.0, 1.5],
            "yaw": 0.25,
            "heading": 0.5,
            "state": "moving",
            "sight": "seen",
            "speed": 5.0,
            "velocity": [5.0, 0.0],
        }
    ],
}
TRAILS = {3: np.array([[0.0, 2, 3], [1, 2, 3]])}
RESULT = SweepResult(record=RECORD, xyz=np.ones((5, 3), np.float32), intensity=None, trails=TRAILS)


def live_result(**fields):
    return types.SimpleNamespace(sweep=types.SimpleNamespace(**fields))


def test_foxglove_is_served_points_boxes_poses_and_records():
    with foxglove.open_foxglove(port=0) as (send, url):
        send(live_result(), RESULT)
        with websockets.sync.client.connect(url, subprotocols=["foxglove.sdk.v1"]) as client:
            server = json.loads(client.recv(5))
            channels = {item["topic"]: item["id"] for item in json.loads(client.recv(5))["channels"]}
            wanted = channels[mcap_results.TRACKS_TOPIC]
            client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": wanted}]}))
            data = None
            for _ in range(50):
                send(live_result(), RESULT)
                with contextlib.suppress(TimeoutError):
                    data = client.recv(0.1)
                    if isinstance(data, bytes):
                        break
    assert url.startswith("ws://127.0.0.1:")
    assert server["name"] == "jaxbox"
    assert set(channels) == {
        mcap_results.POINTS_TOPIC,
        mcap_results.BOXES_TOPIC,
        mcap_results.POSE_TOPIC,
        mcap_results.TRACKS_TOPIC,
    }
    # One byte of operation, four of the subscription and eight of the time.
    assert int.from_bytes(data[5:13], "little") == RECORD["timestamp_ns"]
    assert json.loads(data[13:]) == RECORD


def test_a_port_that_foxglove_cannot_have_is_said():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with (
            pytest.raises(InputError, match=f"cannot listen at 127.0.0.1, port {port}"),
            foxglove.open_foxglove(port=port),
        ):
            pass


def test_the_page_holds_the_rows_that_the_detector_had():
    points = np.random.default_rng(0).uniform(1, 20, (100, 3)), None
    sweep = types.SimpleNamespace(name="a", frame=0, timestamp_ns=0, read_points=lambda: points)
    detections = types.SimpleNamespace(ground_mask=np.zeros(64, bool))
    found = types.SimpleNamespace(detections=detections)
    newest = page._Newest(lambda config: None)
    newest.put(types.SimpleNamespace(sweep=sweep, found=found, num_skipped=0), None)  # pyright: ignore
    frame = newest.frame(0)
    assert frame.cloud.capacity == 64
    assert frame.rows.max() < 64
    assert frame.num_points == 100
