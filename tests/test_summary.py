"""The summary of a sweep's answer, and the example that watches a stream by it."""

import dataclasses
import importlib.util
import json
import math
import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbox
from jaxbox import DetectorConfig, PointCloud, Status, synthetic
from jaxbox.config import ClusteringConfig, ComponentMap
from jaxbox.run import summary
from jaxbox.stages import ground

# The smallest capacity, whose compiled function other tests use too.
CAPACITY, NUM_AZIMUTHS = 16384, 250
EXAMPLE = pathlib.Path(__file__).parents[1] / "examples" / "monitor.py"


@pytest.fixture(scope="module")
def found():
    """The answer to one street, some of whose boxes are above the cut."""
    sweep = synthetic.make_sweep(6, num_azimuths=NUM_AZIMUTHS)
    cloud = PointCloud.from_numpy(sweep.xyz, sweep.intensity)
    assert cloud.capacity == CAPACITY
    return sweep, jax.device_get(jaxbox.detect(cloud))


@pytest.fixture(scope="module")
def monitor():
    spec = importlib.util.spec_from_file_location("monitor", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_point_is_in_one_place_and_the_shares_sum_to_one(found):
    sweep, detections = found
    result = jaxbox.summarise(detections)
    assert result.num_points == len(sweep.xyz) == sum(result.points.values())
    assert sum(map(result.point_share, summary.POINT_PLACES)) == pytest.approx(1)
    assert set(result.points) < {field.name for field in dataclasses.fields(detections.counts)}
    ground_share = result.point_share("ground_points")
    assert ground_share == pytest.approx(sweep.is_ground.mean(), abs=0.1)


def test_boxes_are_those_from_the_cut_on(found):
    _, detections = found
    for cut in (0.0, 0.05, jaxbox.DEFAULT_SCORE_THRESHOLD):
        result = jaxbox.summarise(detections, min_score=cut)
        keep = detections.valid & (detections.score >= cut)
        assert result.num_boxes == keep.sum() == sum(result.boxes.values())
        assert result.num_boxes > 0
        assert result.score.minimum == pytest.approx(detections.score[keep].min())
        assert result.score.minimum >= cut
        assert result.length_m.median == pytest.approx(np.median(detections.size[keep, 0]))
        assert result.width_m.maximum == pytest.approx(detections.size[keep, 1].max())
        assert result.height_m.minimum == pytest.approx(detections.size[keep, 2].min())
        assert result.range_m.minimum == pytest.approx(
            np.linalg.norm(detections.center[keep, :2], axis=1).min()
        )
    assert jaxbox.summarise(detections).min_score == jaxbox.DEFAULT_SCORE_THRESHOLD


def test_no_box_above_the_cut_leaves_the_spreads_empty(found):
    result = jaxbox.summarise(found[1], min_score=2.0)
    assert (result.num_boxes, result.boxes) == (0, {"car": 0, "van": 0, "truck": 0})
    assert result.score == result.length_m == summary.Spread(None, None, None)


def test_the_ground_is_the_plane_as_the_mount_has_it(found):
    _, detections = found
    result = jaxbox.summarise(detections).ground
    assert result.found
    assert result.sensor_height_m == pytest.approx(-synthetic_ground_height(), abs=0.05)
    assert result.tilt_deg < 0.5
    assert 0 < result.inlier_share < 1
    # A plane that falls by 3 in 4 forward, whose foot is 5 m below the sensor along z.
    slanted = dataclasses.replace(
        detections.ground, coefficients=jnp.array([-0.75, 0, -5.0]), num_inliers=jnp.int32(800)
    )
    result = jaxbox.summarise(dataclasses.replace(detections, ground=slanted)).ground
    assert result.sensor_height_m == pytest.approx(4.0)
    assert result.tilt_deg == pytest.approx(math.degrees(math.atan(0.75)))
    assert result.inlier_share == pytest.approx(0.25)


def synthetic_ground_height():
    return float(synthetic.make_sweep(6, num_azimuths=8).scene.terrain.height(np.zeros(1), np.zeros(1))[0])


def test_the_share_of_inliers_is_of_as_many_candidates_as_the_ground_has():
    config = DetectorConfig().ground
    candidates, _ = jax.eval_shape(
        lambda xyz: ground.cell_minima(xyz, jnp.ones(4, bool), config), jnp.zeros((4, 3))
    )
    assert summary._num_candidates(DetectorConfig()) == candidates.shape[0]
    assert summary._num_candidates(DetectorConfig.paper()) == DetectorConfig.paper().ground.num_candidates


def test_capacities_are_those_of_the_configuration_and_say_what_was_dropped(found):
    _, detections = found
    uses = {use.field: use for use in jaxbox.summarise(detections).capacities}
    assert uses["clustering.max_obstacles"].capacity == 3 * CAPACITY // 4
    assert uses["clustering.maps.2.max_cells"].capacity == DetectorConfig().clustering.maps[2].max_cells
    assert uses["vehicles.max_detections"].needed == detections.valid.sum()
    assert jaxbox.summarise(detections).dropped == {}
    small = DetectorConfig(
        clustering=ClusteringConfig(maps=(ComponentMap(max_cells=10), ComponentMap(), ComponentMap()))
    )
    # As a run with this capacity would have counted.
    cells = int(detections.counts.cells[0])
    assert jaxbox.summarise(detections, small).dropped == {"clustering.maps.0.max_cells": cells - 10}
    use = {use.field: use for use in jaxbox.summarise(detections, small).capacities}[
        "clustering.maps.0.max_cells"
    ]
    assert use.share == cells / 10


def test_the_capacities_of_a_hull_fit_have_no_slab(found):
    config = DetectorConfig.paper()
    maps = DetectorConfig().clustering.maps
    config = dataclasses.replace(config, clustering=dataclasses.replace(config.clustering, maps=maps))
    assert "box.max_slab_points" not in {use.field for use in jaxbox.summarise(found[1], config).capacities}


def test_the_dictionary_is_json_and_has_the_status_in_words(found):
    detections = dataclasses.replace(found[1], status=jnp.int32(Status.NO_GROUND | Status.NONFINITE_POINTS))
    text = json.dumps(jaxbox.summarise(detections).to_dict(), allow_nan=False)
    back = json.loads(text)
    assert [sentence.split(":")[0] for sentence in back["status"]] == ["NONFINITE_POINTS", "NO_GROUND"]
    assert back["capacities"]["hull.max_vertices"]["dropped"] == 0
    assert back["ground"]["found"] is True
    assert back["points"]["clustered_points"] > 0


def test_an_empty_sweep_has_a_summary(found):
    cloud = PointCloud.from_numpy(np.zeros((0, 3), np.float32), capacity=CAPACITY)
    result = jaxbox.summarise(jax.device_get(jaxbox.detect(cloud)))
    assert result.num_points == result.num_boxes == 0
    assert result.status == Status.EMPTY | Status.NO_GROUND
    assert result.point_share("ground_points") == 0
    assert not result.ground.found


def run_monitor(monitor, capsys, *arguments):
    code = monitor.main([str(argument) for argument in arguments])
    *lines, totals = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    return code, lines, totals


# Of a run on a busy machine, no deadline is asked.
SYNTHETIC = ("--num-azimuths", NUM_AZIMUTHS, "--deadline-ms", 1e9)


def test_the_monitor_is_quiet_while_all_is_well_and_rings_when_the_mount_comes_loose(monitor, capsys):
    code, lines, totals = run_monitor(monitor, capsys, "--synthetic", 14, "--fault-at", 9, *SYNTHETIC)
    assert code == 1
    assert totals["sweeps"] == len(lines) == 14
    drifts = [[text for text in line["alarms"] if "drifts" in text] for line in lines]
    assert not any(drifts[:9]), "no false alarm"
    rung = [line["sweep"] for line, texts in zip(lines, drifts, strict=True) if "tilt_deg" in str(texts)]
    assert rung
    assert rung[0] <= "000011", "within three sweeps"


def test_the_monitor_reads_recordings_counts_missed_deadlines_and_names_status_bits(
    monitor, capsys, tmp_path
):
    sweep = synthetic.make_sweep(1, num_azimuths=NUM_AZIMUTHS)
    for number in range(8):
        np.save(tmp_path / f"{number}.npy", sweep.xyz if number < 7 else np.zeros((0, 3), np.float32))
    code, lines, totals = run_monitor(monitor, capsys, tmp_path, "--deadline-ms", 0)
    assert code == 1
    assert totals == {"sweeps": 8, "with_alarms": 3, "missed_deadlines": 8}
    assert lines[4]["alarms"] == []
    assert lines[5]["alarms"] == ["100% of the sweeps missed the deadline of 0 ms"]
    assert any(text.startswith("EMPTY: ") for text in lines[7]["alarms"])
    assert "tilt_deg" not in lines[7], "without a ground there is none to watch"


def test_the_monitor_asks_for_sweeps(monitor, capsys):
    with pytest.raises(SystemExit):
        monitor.main([])
    assert "give paths, or --synthetic N" in capsys.readouterr().err


def test_the_example_of_the_page_runs(capsys):
    page = (EXAMPLE.parents[1] / "docs" / "reliability.md").read_text()
    section = page[page.index("\n## Monitoring\n") :]
    (example,) = re.findall(r"```python\n(.*?)```", section[: section.index("\n## ", 4)], re.DOTALL)
    # A sparser sweep, whose detector is compiled already.
    small = example.replace("seed=0", f"seed=6, num_azimuths={NUM_AZIMUTHS}")
    assert small != example
    exec(compile(small, "reliability.md", "exec"), {})
    assert "'ground_points': " in capsys.readouterr().out
