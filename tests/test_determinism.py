"""The same bits every time, other keys, and a soak: the short versions of both programs."""

import dataclasses
import functools

import numpy as np
import pytest
from test_detector import CAPACITY, found, run, street

import jaxbox
from jaxbox import DetectorConfig
from jaxbox.run import compiled
from jaxbox.tracking.poses import PoseSource
from quality import determinism, soak

BOX = np.array([10.0, 2, -1, 4, 1.8, 1.5, 0.1, 0.5])


@pytest.mark.slow
def test_a_hundred_repeats_have_the_same_bits():
    sweeps = [determinism.Given(f"street {seed}", street(seed).xyz) for seed in range(2)]
    assert determinism.repeat(sweeps, DetectorConfig(), 100) == 0
    assert determinism.digests(sweeps, DetectorConfig()) == [
        determinism.digest(found(seed)) for seed in range(2)
    ]


def test_a_digest_tells_one_bit_a_shape_and_a_type():
    answer = found(0)
    digest = determinism.digest
    last_bit = np.nextafter(answer.score, np.float32(1), dtype=np.float32)
    others = [
        dataclasses.replace(answer, score=score)
        for score in (last_bit, answer.score[None], answer.score.astype(np.float64))
    ]
    assert len({digest(answer), *map(digest, others)}) == 4


@pytest.mark.slow
def test_another_process_has_the_same_bits_and_so_have_the_compilers_own_options():
    options = determinism.common.parser("", preset=False, quick="small").parse_args(["--quick"])
    expected = [determinism.digest(found(seed)) for seed in range(determinism.NUM_SWEEPS)]
    # A user's, which are not those of these tests: see parity.SMALL_CODE.
    environment = {"NPROC": "1", "XLA_FLAGS": ""}
    assert determinism.by_process(environment, options, "default") == expected


def test_boxes_of_other_keys_are_followed_to_the_object_they_are_of():
    there, beside = BOX.copy(), BOX + np.array([30, 0, 0, 0, 0, 0, 0, 0])
    turned = BOX + np.array([0.1, 0, 0, 0, 0, 0, np.pi - 0.02, -0.1])
    objects = determinism.follow_objects([np.stack([there]), np.stack([turned, beside]), np.zeros((0, 8))])
    assert objects.shape == (2, 3, 8)
    np.testing.assert_array_equal(~np.isnan(objects[..., 0]), [[True, True, False], [False, True, False]])
    moves = determinism.deviations(objects[0, :2])
    # Two boxes are half their difference from their median; half a turn is not a turn.
    assert moves["centre, m"] == pytest.approx([0.05, 0.05])
    assert moves["yaw, degrees"] == pytest.approx(np.degrees([0.01, 0.01]))
    assert moves["score"] == pytest.approx([0.05, 0.05])


def test_clear_vehicles_are_there_with_every_key():
    spread = determinism.spread_over_keys([("street", street(0).xyz)], DetectorConfig(), 8)
    assert spread["objects"] > 0
    clear = spread["by_median_score"]["0.3 to 1"]
    assert clear["objects"] == clear["with_every_key_at_some_score"]
    assert spread["moves"]["centre, m"]["p95"] < 0.5


def test_a_soak_of_small_sweeps_of_any_size_recompiles_nothing_and_loses_no_point():
    run(street(0).xyz)
    programs = compiled.count_compilations()
    sweeps = soak.varied_sweeps(street(0).xyz, CAPACITY, 200)
    assert {0, 1, CAPACITY} <= {sweep.size for sweep in sweeps}
    report = soak.soak(sweeps, sweeps[:1], DetectorConfig(), CAPACITY)
    assert (report["frames"], report["recompiles"], report["points"]["minimum"]) == (200, 0, 0)
    assert report["points"]["maximum"] == CAPACITY
    assert compiled.count_compilations() == programs
    assert 0 < report["frame_ms"]["p50"] <= report["frame_ms"]["p99.9"] <= report["frame_ms"]["max"]


def test_tracks_of_a_drive_are_the_same_again_and_a_soak_of_them_recompiles_nothing():
    options = determinism.common.parser("", preset=False, quick="small").parse_args(["--quick"])
    first, again = (determinism.track_digests(options) for _ in range(2))
    assert first == again
    assert len(set(first)) == determinism.NUM_SWEEPS
    sweeps = [soak.Untimed(sweep) for sweep in determinism.sweeps_to_compare(True)]
    track = functools.partial(jaxbox.track, poses=PoseSource.BOXES)
    report = soak.soak(sweeps * 20, sweeps, DetectorConfig(), CAPACITY, run=track)
    assert (report["frames"], report["recompiles"]) == (20 * len(sweeps), 0)


def test_a_soak_ends_where_a_sweep_fails_and_the_slope_is_that_of_the_memory():
    failed = jaxbox.StreamedSweep("bad", 0, None, "the disk is gone")
    with pytest.raises(SystemExit, match="bad: the disk is gone"):
        soak._check(failed)
    memory = [(frame, 500_000 + (0 if frame < 100 else 2 * frame)) for frame in range(0, 1000, 10)]
    grown = soak.growth(memory, 1000)
    assert grown["growth_kb_per_1000_frames"] == pytest.approx(2000)
    assert grown["median_mb_of_tenths"] == pytest.approx(
        [500 + (0.2 * k + 0.09 if k else 0) for k in range(10)]
    )
    assert soak.latency(range(1001))["p99.9"] == pytest.approx(999)
