"""The steadiness benchmark: which boxes stay, and that its changes are seeded and change what they say."""

import json
import pathlib

import numpy as np

from benchmarks import bench_steadiness as bench

RESULTS = pathlib.Path(__file__).parents[1] / "benchmarks" / "results"


def box(x, *, label=0, score=0.5, yaw=0.0):
    return [x, 0.0, 0.0, 4.0, 2.0, 1.5, yaw, score, label]


def test_a_box_stays_by_class_and_overlap_and_is_found_by_less_overlap():
    before = np.array([box(0), box(20), box(40), box(60)])
    after = np.array([box(0.1), box(20, label=1), box(40.8), box(90)])
    stay, found = bench.judge(before, after)
    assert stay.tolist() == [True, False, False, False]
    assert found.tolist() == [True, True, True, False]
    assert [part.tolist() for part in bench.judge(before[:1], after[:0])] == [[False], [False]]


def test_shares_are_of_the_boxes_from_each_score_on():
    tally = bench.Tally()
    before = np.array([box(0, score=0.2), box(20, score=0.4)])
    tally.add(before, np.array([True, False]), np.array([True, True]))
    shares = tally.to_dict()
    assert shares["0.15"] == {"boxes": 2, "stay": 0.5, "found": 1.0}
    assert shares["0.3"] == {"boxes": 1, "stay": 0.0, "found": 1.0}
    assert shares["0.5"] == {"boxes": 0, "stay": 0.0, "found": 0.0}


def test_changes_are_seeded_and_no_larger_than_they_say():
    xyz = np.random.default_rng(0).uniform(-40, 40, (20_000, 3)).astype(np.float32)
    for name, change in bench.CHANGES.items():
        once, again = (change(xyz, bench.seeded("a", name, 0)) for _ in range(2))
        np.testing.assert_array_equal(once, again)
        assert not np.array_equal(once, change(xyz, bench.seeded("a", name, 1)))
    shuffled = bench.CHANGES["order"](xyz, bench.seeded("a"))
    np.testing.assert_array_equal(np.sort(shuffled, axis=0), np.sort(xyz, axis=0))
    for name, std_m in (("1 mm", 0.001), ("1 cm", 0.01)):
        moved = bench.CHANGES[name](xyz, bench.seeded("a")) - xyz
        np.testing.assert_allclose(moved.std(axis=0), std_m, rtol=0.03)


def test_the_record_is_of_these_changes_and_scores():
    report = json.loads((RESULTS / "steadiness.json").read_text())
    for part in bench.PARTS:
        assert list(report[part]) == list(bench.CHANGES)
        assert all(list(by_score) == ["0.15", "0.3", "0.5"] for by_score in report[part].values())
