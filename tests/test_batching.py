"""Many sweeps at once: in turns over devices, and as a stream; the same bits as one by one."""

import dataclasses
import os

import jax
import numpy as np
import pytest
from test_detector import CAPACITY, assert_same_bits, found, run, street

import jaxbox
from jaxbox import DetectorConfig, PointCloud, detect_batch
from jaxbox.config import EvidenceConfig
from jaxbox.run import batching, compiled, streaming

SEEDS = (0, 1, 2)
PAPER = DetectorConfig.paper()
"""The preset that each device and process has soonest."""


@dataclasses.dataclass(frozen=True)
class Recorded:
    """A sweep as `stream` takes it; at module level, so that it can be sent to a process."""

    name: str
    xyz: np.ndarray
    failure: str = ""

    def read_points(self):
        if self.failure == "unreadable":
            raise OSError("the disk is gone")
        if self.failure == "deadly":
            os._exit(1)
        return self.xyz, None


def recorded(failures=None):
    """Three streets, and what does not go well with them."""
    sweeps = [Recorded(f"street {seed}", street(seed).xyz) for seed in SEEDS]
    for place, failure in (failures or {}).items():
        sweeps.insert(place, Recorded(failure, np.zeros((0, 3)), failure))
    return sweeps


def cloud(seed):
    return PointCloud.from_numpy(street(seed).xyz, capacity=CAPACITY)


def first_device():
    """The one that the single calls have been compiled for."""
    return jax.local_devices()[:1]


def test_a_batch_has_the_bits_of_the_singles_in_their_order_and_compiles_nothing_more():
    found(0)
    before = compiled.count_compilations()
    batch = detect_batch([cloud(seed) for seed in SEEDS], devices=first_device())
    assert compiled.count_compilations() == before
    for seed, detections in zip(SEEDS, batch, strict=True):
        assert_same_bits(jax.device_get(detections), found(seed))


def test_a_batch_takes_a_key_and_settings_for_all():
    key, config = jax.random.key(5), jax.tree.map(lambda value: 1.1 * value, DetectorConfig())
    (detections,) = detect_batch([cloud(0)], config, key, first_device())
    assert_same_bits(jax.device_get(detections), run(street(0).xyz, config=config, key=key))


@pytest.mark.usefixtures("_all_devices")
def test_devices_take_turns_and_each_gets_the_cloud_and_the_key(monkeypatch):
    # Each device would compile once more; the bits are those of the test that follows.
    monkeypatch.setattr(batching, "detect", lambda cloud, config, key: (cloud, config, key))
    clouds, config = [cloud(seed) for seed in SEEDS], DetectorConfig()
    calls = detect_batch(clouds, config, jax.random.key(5))
    for number, (sent, settings, key) in enumerate(calls):
        device = jax.local_devices()[number % 2]
        assert batching._devices_of(sent.xyz1) == key.devices() == {device}
        assert settings is config
        np.testing.assert_array_equal(sent.xyz1, clouds[number].xyz1)


@pytest.mark.slow
@pytest.mark.usefixtures("_all_devices")
def test_each_device_has_the_bits_of_the_singles():
    for seed, detections in zip(SEEDS, detect_batch([cloud(seed) for seed in SEEDS], PAPER), strict=True):
        assert detections.center.devices() == {jax.local_devices()[seed % 2]}
        assert_same_bits(jax.device_get(detections), run(street(seed).xyz, config=PAPER))


def test_arrays_of_the_host_are_computed_with_on_the_default_device():
    _, other = jax.local_devices()
    assert batching._devices_of(np.zeros(1)) == set(first_device())
    with jax.default_device(other):
        assert batching._devices_of(np.zeros(1)) == jax.jit(lambda a: a + 1)(np.zeros(1)).devices() == {other}
    assert batching._devices_of(jax.device_put(np.zeros(1), other)) == {other}


def test_a_batch_of_nothing_is_nothing_and_one_without_devices_is_refused():
    assert detect_batch([]) == []
    with pytest.raises(ValueError, match="devices is empty"):
        detect_batch([cloud(0)], devices=[])


def test_a_stream_has_the_bits_of_the_singles_and_compiles_nothing_more():
    found(0)
    before = compiled.count_compilations()
    streamed = list(jaxbox.stream(recorded() * 2, capacity=CAPACITY, devices=first_device()))
    assert [result.name for result in streamed] == [f"street {seed}" for seed in SEEDS] * 2
    for seed, result in zip(SEEDS * 2, streamed, strict=True):
        assert result.num_points == len(street(seed).xyz)
        assert_same_bits(result.detections, found(seed))
    assert compiled.count_compilations() == before


@pytest.mark.usefixtures("_all_devices")
def test_a_stream_takes_the_devices_in_turns_and_keeps_the_order(monkeypatch):
    used = []

    def detect_on(device, cloud, config, key):
        used.append(device)
        return jaxbox.detect(cloud, config, key)

    # Each device would compile once more; that clouds are sent to theirs is shown above.
    monkeypatch.setattr(streaming, "detect_on", detect_on)
    streamed = list(jaxbox.stream(recorded() * 3, capacity=CAPACITY))
    assert used == (jax.local_devices() * 5)[:9]
    for seed, result in zip(SEEDS * 3, streamed, strict=True):
        assert_same_bits(result.detections, found(seed))


def test_a_stream_reports_a_sweep_that_cannot_be_read_and_goes_on():
    wrong = Recorded("wrong", np.zeros((5, 2), np.float32))
    sweeps = [*recorded({1: "unreadable"}), wrong]
    results = list(jaxbox.stream(sweeps, capacity=CAPACITY, devices=first_device()))
    assert [result.name for result in results] == ["street 0", "unreadable", "street 1", "street 2", "wrong"]
    assert [result.detections is None for result in results] == [False, True, False, False, True]
    assert results[1].error == "OSError: the disk is gone"
    assert "shape (5, 2)" in results[4].error
    assert_same_bits(results[2].detections, found(1))


def test_a_stream_reads_ahead_no_farther_than_its_buffers_and_can_be_left():
    asked = []

    def source():
        for sweep in recorded() * 3:
            asked.append(sweep.name)
            yield sweep

    results = jaxbox.stream(source(), capacity=CAPACITY, devices=first_device())
    next(results)
    assert len(asked) <= streaming.NUM_BUFFERS
    results.close()
    assert list(jaxbox.stream([])) == []


def test_a_stream_refuses_what_cannot_work_before_it_starts():
    with pytest.raises(ValueError, match="workers is 0"):
        jaxbox.stream([], workers=0)
    with pytest.raises(ValueError, match="devices is empty"):
        jaxbox.stream([], devices=[])
    with pytest.raises(ValueError, match="workers is 2 and devices are named"):
        jaxbox.stream([], workers=2, devices=first_device())
    with pytest.raises(ValueError, match=r"evidence\.enabled"):
        jaxbox.stream([], DetectorConfig(evidence=EvidenceConfig(enabled=False)))


@pytest.mark.slow
def test_processes_keep_the_order_and_the_bits_and_survive_a_deadly_sweep():
    failures = {1: "deadly", 3: "unreadable"}
    results = list(
        jaxbox.stream(recorded(failures), PAPER, key=jax.random.key(0), capacity=CAPACITY, workers=2)
    )
    assert [r.name for r in results] == ["street 0", "deadly", "street 1", "unreadable", "street 2"]
    assert "its process ended" in results[1].error
    assert results[3].error == "OSError: the disk is gone"
    for seed, result in zip(SEEDS, results[::2], strict=True):
        assert_same_bits(result.detections, run(street(seed).xyz, config=PAPER))
