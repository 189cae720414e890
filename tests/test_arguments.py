"""What people try first: arrays for clouds and sweeps, names for presets, integers for keys, and mistakes."""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbox
from jaxbox import DetectorConfig, PointCloud, Status, synthetic
from jaxbox.run.arguments import as_config, as_key, as_sweeps
from jaxbox.run.compiled import count_compilations

# The smallest capacity, whose compiled function other tests use too.
NUM_AZIMUTHS = 250


@pytest.fixture(scope="module")
def sweep():
    return synthetic.make_sweep(6, num_azimuths=NUM_AZIMUTHS)


@pytest.fixture(scope="module")
def xyz(sweep):
    return sweep.xyz


@pytest.fixture(scope="module")
def found(sweep):
    """The answer for the cloud, without padding."""
    return jaxbox.detect(PointCloud.from_numpy(sweep.xyz, sweep.intensity))[:]


def test_an_array_has_the_answer_of_its_cloud(sweep, xyz, found):
    wide = np.column_stack([xyz, sweep.intensity, np.arange(len(xyz))])
    for points in (xyz, xyz.astype(np.float64), jnp.asarray(xyz), wide, np.asfortranarray(wide)):
        detections = jaxbox.detect(points)
        assert detections == found
        assert isinstance(detections.score, np.ndarray)
    assert len(found) > 0


def test_masked_points_of_an_array_are_ignored_as_nan_is(sweep, xyz):
    points = np.ma.masked_array(np.column_stack([xyz, sweep.intensity]), mask=False)
    points[::3] = np.ma.masked
    missing = xyz.copy()
    missing[::3] = np.nan
    found = jaxbox.detect(points)
    assert found == jaxbox.detect(missing)
    assert found.counts.nonfinite_points == len(points[::3])
    (streamed,) = jaxbox.stream([points], devices=jax.devices()[:1])
    assert streamed.detections[:] == found


def test_arrays_of_other_lengths_and_other_seeds_compile_nothing(xyz, found):
    before = count_compilations()
    for stop in (len(xyz) - 1, len(xyz) // 2, 10, 0):
        assert jaxbox.detect(xyz[:stop], None, stop).counts.num_points == stop
    assert count_compilations() == before


def test_an_integer_is_a_seed(xyz):
    cloud = PointCloud.from_numpy(xyz)
    for seed in (7, np.int64(7)):
        assert jaxbox.detect(cloud, None, seed) == jaxbox.detect(cloud, None, jax.random.key(7))
    assert jaxbox.detect(cloud, None, 0) == jaxbox.detect(cloud)


def test_a_seed_may_be_traced():
    seeds = jax.vmap(as_key)(jnp.arange(3))
    for seed in range(3):
        np.testing.assert_array_equal(jax.random.key_data(seeds[seed]), jax.random.key_data(as_key(seed)))
    key = jax.random.PRNGKey(3)
    assert as_key(key) is key


@pytest.mark.parametrize(
    "keys",
    [
        jax.random.split(jax.random.key(0), 3),
        jax.random.split(jax.random.PRNGKey(0), 3),
        jnp.arange(3),
        np.arange(2),
    ],
)
def test_several_keys_are_refused_and_vmap_takes_them_one_by_one(xyz, keys):
    """They would be hashed into one key, and all sweeps read with it."""
    with pytest.raises(ValueError, match=r"key holds several, of shape \([23],.*jax.vmap"):
        jaxbox.detect(PointCloud.from_numpy(xyz), key=keys)
    one_by_one = jax.vmap(as_key)(jnp.asarray(keys))
    for row, key in enumerate(keys):
        np.testing.assert_array_equal(jax.random.key_data(one_by_one[row]), jax.random.key_data(as_key(key)))


def test_a_key_of_other_numbers_is_refused():
    for key in (jnp.float32(0), np.zeros(2), True, "0"):
        with pytest.raises(TypeError, match="give an integer, or a key from"):
            as_key(key)


def test_a_name_is_a_preset():
    for name, preset in DetectorConfig.presets().items():
        assert as_config(name) == preset
    assert as_config(None) == DetectorConfig()
    config = DetectorConfig.fast()
    assert as_config(config) is config


def test_settings_by_name_reach_the_detector(xyz):
    cloud = PointCloud.from_numpy(xyz)
    named = jaxbox.run.compiled.lower(cloud, "paper", 3).as_text()
    assert named == jaxbox.run.compiled.lower(cloud, DetectorConfig.paper()).as_text()
    assert named != jaxbox.run.compiled.lower(cloud).as_text()
    assert jaxbox.summarise(jaxbox.detect(cloud), "default") == jaxbox.summarise(jaxbox.detect(cloud))


@pytest.mark.parametrize("call", [jaxbox.detect, lambda *a: jaxbox.detect_batch([a[0]], *a[1:])])
@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ((np.zeros((3, 50)),), ValueError, r"transpose it, points\.T"),
        ((np.zeros((2, 50, 3)),), ValueError, "one sweep at a time"),
        ((np.zeros(40),), ValueError, r"np\.fromfile"),
        ((np.zeros((50, 2)),), ValueError, r"\(n, 3\) or more columns"),
        (("sweep.bin",), TypeError, r"jaxbox\.io\.read_points\('sweep.bin'\)"),
        ((pathlib.Path("sweep.bin"),), TypeError, r"jaxbox\.io\.read_points"),
        ((None,), TypeError, "NoneType"),
        (
            (np.zeros((50, 3)), "papr"),
            ValueError,
            "not a preset; choose one of default, accurate, fast, paper",
        ),
        ((np.zeros((50, 3)), 7), TypeError, r"A seed is key=\.\.\."),
        ((np.zeros((50, 3)), None, "7"), TypeError, "give an integer"),
        ((np.zeros((50, 3)), None, True), TypeError, "give an integer"),
    ],
)
def test_what_cannot_be_used_is_refused_with_what_to_do(call, arguments, error, text):
    with pytest.raises(error, match=text):
        call(*arguments)


def test_an_array_inside_a_compiled_function_is_to_be_a_cloud(xyz):
    with pytest.raises(TypeError, match="hand over a PointCloud"):
        jax.jit(jaxbox.detect)(xyz)


def test_batches_and_streams_of_arrays_are_those_of_clouds(xyz, found):
    halves = [xyz, xyz[::2]]
    clouds = [PointCloud.from_numpy(half) for half in halves]
    alone = [jaxbox.detect(cloud) for cloud in clouds]
    assert jaxbox.detect_batch(halves, devices=jax.devices()[:1]) == alone
    for sweeps in (halves, clouds, iter(halves), np.stack([xyz, xyz])[:1]):
        results = list(jaxbox.stream(sweeps, devices=jax.devices()[:1]))
        assert [result.name for result in results] == ["000000", "000001"][: len(results)]
        assert [result.detections for result in results] == alone[: len(results)]
        assert results[0].num_points == len(xyz)
    assert found == alone[0][:]


@pytest.mark.parametrize("poses", ["none", np.eye(4)[None].repeat(2, axis=0)])
def test_what_a_cloud_had_no_room_for_is_counted_in_streams_too(xyz, poses):
    num_kept = 1000
    cloud = PointCloud.from_numpy(xyz, capacity=num_kept)
    options = {"devices": jax.devices()[:1]}
    streamed, tracked = (
        jaxbox.stream([cloud] * 2, **options),
        jaxbox.track([cloud] * 2, poses=poses, **options),
    )
    for result in (*streamed, *tracked):
        assert result.num_points == result.detections.counts.num_points == len(xyz)
        assert result.detections.counts.dropped_points == len(xyz) - num_kept
        assert Status.POINT_OVERFLOW in Status(int(result.detections.status))


def test_what_streams_yield_says_what_it_is_in_a_few_lines(xyz):
    (result,) = jaxbox.stream([xyz], devices=jax.devices()[:1])
    assert repr(result).startswith("StreamedSweep 000000: Detections: ")
    assert len(repr(result).splitlines()) <= 8
    failed = jaxbox.StreamedSweep("a", 0, None, "InputError: no file")
    assert repr(failed) == "StreamedSweep a: InputError: no file"
    assert failed == jaxbox.StreamedSweep("a", 0, None, "InputError: no file")
    assert result != failed


def test_arrays_are_tracked(xyz):
    tracked = list(jaxbox.track([xyz, xyz], key=0, poses="none", devices=jax.devices()[:1]))
    assert [sweep.name for sweep in tracked] == ["000000", "000001"]
    assert 0 < tracked[1].tracks.confirmed.sum() <= len(tracked[1].tracks)
    assert repr(tracked[1]).startswith("TrackedSweep 000001: Tracks: ")


def test_streams_ask_for_sweeps_and_say_so(xyz):
    for call in (jaxbox.stream, jaxbox.track):
        for one in (xyz, PointCloud.from_numpy(xyz)):
            with pytest.raises(TypeError, match=r"a list \[xyz\]"):
                call(one)
        with pytest.raises(TypeError, match=r"jaxbox\.io\.open_sweeps\('drive'\)"):
            call("drive")
    with pytest.raises(TypeError, match=r"jaxbox\.io\.read_points"):
        list(as_sweeps(["a.bin"], called="jaxbox.stream"))
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        list(jaxbox.stream([xyz[:, :2]]))
    sweep = synthetic.make_sweep(0, num_azimuths=8)
    ready = jaxbox.run.arguments.ReadSweep("a", sweep.xyz, None)
    assert list(as_sweeps([ready], called="jaxbox.stream")) == [ready]
    with pytest.raises(TypeError, match=r"sweep\.read_points\(\)"):
        jaxbox.detect(ready)
