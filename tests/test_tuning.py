"""Tuning: what is tried, what is chosen, and that nothing held out has a say in it."""

import numpy as np
import pytest

from jaxbox.config import DetectorConfig
from jaxbox.config.fields import replace_fields, traced_fields
from jaxbox.tuning import Axis, best_trial, default_axes, latin_hypercube, leave_one_out, parse_axis, refine
from jaxbox.tuning.selection import NOISE, Trial, score_without

AXES = [Axis("a", 0.0, 10.0), Axis("b", 1.0, 100.0, log=True), Axis("c", -1.0, 1.0)]
GROUPS = {"0": "north", "1": "north", "2": "east", "3": "south", "4": "south"}


def mean(scores):
    values = list(scores)
    return float(np.mean(values)) if values else 0.0


def trial(index, *copies, groups=GROUPS, blind=True):
    """A trial whose frames have these scores; the figure of some frames is their mean."""
    matches = [dict(zip(groups, copy, strict=True)) for copy in copies]
    return Trial(
        index=index,
        changes={"a": float(index)},
        blind=blind,
        matches=matches,
        scores=tuple(mean(copy.values()) for copy in matches),
        scores_without=score_without(matches, groups, mean),
    )


def random_trials(seed, count=30, copies=3):
    scores = np.random.default_rng(seed).normal(50, 5, (count, copies, len(GROUPS)))
    return [trial(index, *rows) for index, rows in enumerate(scores)]


def test_a_setting_that_is_great_on_one_drive_alone_gains_nothing_there():
    base = trial(0, [50, 50, 50, 50, 50])
    lucky = trial(1, [100, 100, 40, 40, 40])
    held_out = leave_one_out([base, lucky], GROUPS, mean)
    assert best_trial([base, lucky]) is lucky
    assert held_out.chosen == {"north": 0, "east": 1, "south": 1}
    assert held_out.scores == (mean([50, 50, 40, 40, 40]),)
    assert held_out.keep_base


def test_a_setting_that_is_better_on_every_drive_is_taken():
    trials = [trial(0, [50] * 5, [51] * 5), trial(1, [60] * 5, [61] * 5)]
    held_out = leave_one_out(trials, GROUPS, mean)
    assert held_out.times_chosen == {1: 3}
    assert held_out.gain == pytest.approx(10)
    assert held_out.spread == pytest.approx(0)
    assert not held_out.keep_base


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("group", ["north", "east", "south"])
def test_what_is_chosen_for_a_drive_does_not_depend_on_its_labels(seed, group):
    trials = random_trials(seed)
    chosen = leave_one_out(trials, GROUPS, mean).chosen[group]
    random = np.random.default_rng(seed + 100)
    changed = [
        trial(
            each.index,
            *(
                [random.uniform(0, 100) if GROUPS[name] == group else score for name, score in copy.items()]
                for copy in each.matches
            ),
        )
        for each in trials
    ]
    assert leave_one_out(changed, GROUPS, mean).chosen[group] == chosen


@pytest.mark.parametrize("seed", range(5))
def test_luck_alone_is_told_from_a_gain(seed):
    held_out = leave_one_out(random_trials(seed), GROUPS, mean)
    best = best_trial(random_trials(seed)).mean - random_trials(seed)[0].mean
    assert held_out.gain < best, "the best in sample is flattered"


def test_a_trial_that_saw_the_labels_stands_for_no_drive():
    trials = [trial(0, [50] * 5), trial(1, [90] * 5, blind=False)]
    assert set(leave_one_out(trials, GROUPS, mean).chosen.values()) == {0}
    assert best_trial(trials).index == 1


def test_of_equals_the_base_wins():
    trials = [trial(index, [50] * 5) for index in range(3)]
    assert best_trial(trials).index == 0
    assert set(leave_one_out(trials, GROUPS, mean).chosen.values()) == {0}


def test_a_gain_within_its_spread_over_the_copies_is_noise():
    base = trial(0, [50] * 5, [50] * 5)
    wavering = leave_one_out([base, trial(1, [60] * 5, [45] * 5)], GROUPS, mean)
    assert wavering.gain == pytest.approx(2.5)
    assert wavering.noise == pytest.approx(15 / np.sqrt(2))
    assert wavering.keep_base
    small = leave_one_out([base, trial(1, [50.9] * 5, [50.9] * 5)], GROUPS, mean)
    assert small.noise == NOISE
    assert small.keep_base


def test_a_gain_that_hangs_on_one_drive_is_noise():
    gain = [27, 27, 0, 0, 0]
    base = trial(0, [50] * 5)
    uneven = leave_one_out([base, trial(1, np.add(50, gain))], GROUPS, mean)
    even = leave_one_out([base, trial(1, [50 + np.mean(gain)] * 5)], GROUPS, mean)
    assert even.group_spread == pytest.approx(0)
    assert even.gain > even.noise == NOISE
    # Without the drive that gains, the base is as good and stands for it.
    assert uneven.gain == pytest.approx(0)
    both = leave_one_out([base, trial(1, np.add(51, gain))], GROUPS, mean)
    assert both.gain == pytest.approx(even.gain + 1)
    assert both.noise == both.group_spread > 5


def test_one_drive_cannot_be_left_out():
    groups = dict.fromkeys(GROUPS, "north")
    assert leave_one_out([trial(0, [50] * 5, groups=groups)], groups, mean) is None


@pytest.mark.parametrize("count", [0, 1, 7, 40])
def test_every_part_of_every_range_is_tried_once(count):
    tried = latin_hypercube(AXES, count, seed=3)
    assert len(tried) == count
    for axis in AXES:
        positions = [axis.position(changes[axis.name]) for changes in tried]
        # Values are rounded to four digits, so one may lie just beyond its part's end.
        off_middle = np.abs(np.sort(positions) * count - np.arange(count) - 0.5)
        assert np.all(off_middle < 0.5 + 1e-3 * count)


def test_the_seed_decides_what_is_tried():
    assert latin_hypercube(AXES, 20, seed=1) == latin_hypercube(AXES, 20, seed=1)
    assert latin_hypercube(AXES, 20, seed=1) != latin_hypercube(AXES, 20, seed=2)


def test_refining_climbs_to_the_top_within_the_ranges():
    top = {"a": 7.0, "b": 20.0, "c": 5.0}

    def score(changes):
        return -sum((axis.position(changes[axis.name]) - axis.position(top[axis.name])) ** 2 for axis in AXES)

    best = {"a": 1.0, "b": 2.0, "c": -0.9}
    steps = refine(AXES, best, score(best))
    changes = next(steps)
    for _ in range(500):
        assert all(axis.low <= changes[axis.name] <= axis.high for axis in AXES)
        if score(changes) > score(best):
            best = changes
        try:
            changes = steps.send(score(changes))
        except StopIteration:
            break
    else:
        pytest.fail("the search does not end")
    assert best["a"] == pytest.approx(7, abs=0.2)
    assert best["b"] == pytest.approx(20, rel=0.1)
    assert best["c"] == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("name", DetectorConfig.presets())
def test_the_default_space_is_of_traced_settings_round_the_base(name):
    config = DetectorConfig.presets()[name]
    axes = default_axes(config)
    assert len(axes) > 10
    for axis in axes:
        assert axis.low < traced_fields(config)[axis.name] < axis.high
        assert axis.value(0.5) == pytest.approx(traced_fields(config)[axis.name], rel=1e-3)
    for changes in latin_hypercube(axes, 3, seed=0):
        assert traced_fields(replace_fields(config, changes)) == traced_fields(config) | changes


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("vehicles.ring_weight=2", "FIELD=LOW:HIGH"),
        ("vehicles.ring_weight=2:3:linear", "FIELD=LOW:HIGH"),
        ("vehicles.ring_weight=a:b", "FIELD=LOW:HIGH"),
        ("vehicles.ring_weight=3:2", "the range is empty"),
        ("vehicles.ring_weight=0:2:log", "LOW above 0"),
        ("vehicles.ring_weight=0:inf", "both finite"),
        ("clustering.maps.0.cell_m=0.1:0.3", "static"),
        ("vehicles.rings=0:1", "nearest traced settings: vehicles.ring"),
    ],
)
def test_a_range_that_cannot_be_searched_is_refused(text, expected):
    with pytest.raises(ValueError, match=expected):
        parse_axis(DetectorConfig(), text)


def test_the_default_space_stays_within_what_settings_take_and_leaves_out_what_is_off():
    changes = {"completion.near_weight": 0, "vehicles.objective_gate": -1, "vehicles.max_overlap": 0.9}
    base = replace_fields(DetectorConfig(), changes)
    axes = {axis.name: axis for axis in default_axes(base)}
    off = {"completion.near_weight", "vehicles.objective_gate"}
    assert {axis.name for axis in default_axes(DetectorConfig())} - set(axes) == off
    assert axes["vehicles.max_overlap"].high == 1
    for changed in latin_hypercube(list(axes.values()), 20, seed=0):
        replace_fields(base, changed)


def test_a_range_beyond_what_a_setting_takes_is_refused_before_any_trial():
    with pytest.raises(ValueError, match=r"vehicles.max_overlap is -1.0; it must be .* from 0 to 1"):
        parse_axis(DetectorConfig(), "vehicles.max_overlap=-1:0.5")
