"""Launches counted without a GPU: what is read of XLA's dump, turns of loops, and the model of the time."""

import importlib.util
import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import bench_launches, compile_ahead, hlo_text, launch_model, loop_turns, xla_dump
from benchmarks.launch_model import Counts, Turns
from benchmarks.xla_dump import Thunk
from jaxbox import DetectorConfig, PointCloud, detector
from jaxbox.run import compiled
from jaxbox.xla.backend import building_for

TREE = """\
000: kCommandBuffer [source | next=003 (1)]
    001: kCustomKernel [source | sink] loop_add_fusion grid: [8, 1, 1] threads: [128, 1, 1]
    002: kCopy         [source | sink] kCopy
003: kWhile         [prev=000 (1) | next=000 (1)]
condition:
    004: kCustomKernel [source | sink] wrapped_compare grid: [1, 1, 1] threads: [1, 1, 1]
  body:
    000: kCommandBuffer [source | sink]
        005: kCustomKernel [source | sink] input_scatter_fusion grid: [8, 1, 1] threads: [128, 1, 1]
        006: kCustomKernel [source | sink] loop_slice_fusion grid: [8, 1, 1] threads: [128, 1, 1]
    007: kWhile        [prev=006 (1) | next=009 (1)]
condition:
        No thunks.      body:
        008: kCustomKernel [source | sink] loop_add_fusion_1 grid: [1, 1, 1] threads: [32, 1, 1]
    009: kCustomKernel [prev=007 (1) | sink] loop_add_fusion_2 grid: [1, 1, 1] threads: [32, 1, 1]
010: kConditional   [prev=003 (1) | next=000 (1)]
  false_branch:
    011: kCustomKernel [source | sink] loop_add_fusion_3 grid: [1, 1, 1] threads: [32, 1, 1]
    012: kCustomKernel [source | sink] loop_add_fusion_4 grid: [1, 1, 1] threads: [32, 1, 1]
  true_branch:
    013: kCopy [source | sink] kCopy
"""
"""A graph; a loop, with a graph and a loop of known length in it; and a conditional. As XLA indents them."""

NAMES = {
    1: "loop_add_fusion", 2: "copy.1", 3: "while.1", 4: "wrapped_compare", 5: "input_scatter_fusion",
    6: "loop_slice_fusion", 7: "while.2", 8: "loop_add_fusion.1",
}  # fmt: skip

BLOCK = """\
thunk_metadata {
  thunk_info {
    profile_annotation: "%s"
    thunk_id: %d
  }
}
"""

METADATA = "".join(BLOCK % (name, number) for number, name in NAMES.items())

HLO = """\
HloModule jit_counted_detect, is_scheduled=true

FileNames
1 "/somewhere/jaxbox/detector.py"
2 "/somewhere/jaxbox/stages/ground.py"
3 "/somewhere/jaxbox/xla/loops.py"

FunctionNames
1 "_segment"
2 "remove_ground"
3 "fit_ground_plane"
4 "for_chunks"
5 "fit_rectangles"

FileLocations
1 {file_name_id=1 function_name_id=1 line=180 end_line=180 column=4 end_column=10}
2 {file_name_id=2 function_name_id=2 line=20 end_line=20 column=4 end_column=10}
3 {file_name_id=2 function_name_id=3 line=30 end_line=30 column=4 end_column=10}
4 {file_name_id=3 function_name_id=4 line=125 end_line=125 column=4 end_column=10}
5 {file_name_id=2 function_name_id=5 line=50 end_line=50 column=4 end_column=10}

StackFrames
1 {file_location_id=1 parent_frame_id=1}
2 {file_location_id=2 parent_frame_id=2}
3 {file_location_id=3 parent_frame_id=3}
4 {file_location_id=4 parent_frame_id=4}
5 {file_location_id=5 parent_frame_id=2}

%fused_add (p.1: f32[100], p.2: f32[100]) -> f32[100] {
  %p.1 = f32[100]{0} parameter(0)
  %p.2 = f32[100]{0} parameter(1)
  ROOT %add.1 = f32[100]{0} add(%p.1, %p.2), metadata={op_name="add" stack_frame_id=3}
}

%fused_slice (p.3: f32[100]) -> f32[10] {
  %p.3 = f32[100]{0} parameter(0)
  %bitcast.1 = f32[100]{0} bitcast(%p.3)
  %slice.1 = f32[10]{0} slice(%bitcast.1), slice={[0:10]}
  ROOT %negate.1 = f32[10]{0} negate(%slice.1), metadata={op_name="neg" stack_frame_id=5}
}

%fused_gather (p.10: f32[100], p.11: f32[100], p.12: s32[4,1]) -> f32[4] {
  %p.10 = f32[100]{0} parameter(0)
  %p.11 = f32[100]{0} parameter(1)
  %add.2 = f32[100]{0} add(%p.10, %p.11)
  %p.12 = s32[4,1]{1,0} parameter(2)
  ROOT %gather.1 = f32[4]{0} gather(%add.2, %p.12), slice_sizes={1}
}

%fused_scatter (p.4: f32[100], p.5: s32[7,1], p.6: f32[7]) -> f32[100] {
  %p.4 = f32[100]{0} parameter(0)
  %p.5 = s32[7,1]{1,0} parameter(1)
  %p.6 = f32[7]{0} parameter(2)
  ROOT %scatter.1 = f32[100]{0} scatter(%p.4, %p.5, %p.6), to_apply=%region_0
}

%fused_update (p.7: f32[100], p.8: f32[10], p.9: s32[]) -> (f32[100], f32[10]) {
  %p.7 = f32[100]{0} parameter(0)
  %p.8 = f32[10]{0} parameter(1)
  %p.9 = s32[] parameter(2)
  %dynamic-update-slice.1 = f32[100]{0} dynamic-update-slice(%p.7, %p.8, %p.9)
  ROOT %tuple.1 = (f32[100]{0}, f32[10]{0}) tuple(%dynamic-update-slice.1, %p.8)
}

ENTRY %main.1 (a: f32[100], b: f32[100], i: s32[7,1], u: f32[7], v: f32[10], k: s32[]) -> f32[100] {
  %a = f32[100]{0} parameter(0)
  %b = f32[100]{0} parameter(1)
  %i = s32[7,1]{1,0} parameter(2)
  %u = f32[7]{0} parameter(3)
  %v = f32[10]{0} parameter(4)
  %k = s32[] parameter(5)
  %loop_add_fusion = f32[100]{0} fusion(%a, %b), kind=kLoop, calls=%fused_add, metadata={op_name="add"}
  %copy.1 = f32[100]{0} copy(%loop_add_fusion)
  %tuple.2 = (f32[100]{0}, s32[]) tuple(%copy.1, %k)
  %while.1 = (f32[100]{0}, /*index=1*/s32[]) while(%tuple.2), condition=%c, metadata={stack_frame_id=4}
  %get-tuple-element.1 = f32[100]{0} get-tuple-element(%while.1), index=0
  %input_scatter_fusion = f32[100]{0} fusion(%get-tuple-element.1, %i, %u), kind=kInput, calls=%fused_scatter
  %loop_slice_fusion = f32[10]{0} fusion(%input_scatter_fusion), kind=kLoop, calls=%fused_slice
  %while.2 = (f32[100]{0}, s32[]) while(%tuple.2), condition=%c, config={"known_trip_count":{"n":"3"}}
  %loop_update_fusion = (f32[100]{0}, f32[10]{0}) fusion(%a, %v, %k), kind=kLoop, calls=%fused_update
  %loop_gather_fusion = f32[4]{0} fusion(%a, %b, %i), kind=kLoop, calls=%fused_gather
  %dynamic-slice.1 = f32[5]{0} dynamic-slice(%a, %k), dynamic_slice_sizes={5}
  ROOT %multiply.1 = f32[100]{0} multiply(%a, %a)
}
"""

OUTER = "loops.py:125 < ground.py:30 < remove_ground"
"""The key of the excerpt's loop whose turns depend on data."""


@pytest.fixture
def program():
    return xla_dump.parse_program(TREE, METADATA, HLO)


@pytest.fixture
def instructions():
    return hlo_text.parse_instructions(HLO)


def moved(instruction):
    return instruction.bytes_read, instruction.bytes_written


def test_the_tree_of_thunks_is_that_of_the_indentation():
    graph, loop, conditional = xla_dump.parse_thunks(TREE)
    assert [thunk.number for thunk in graph.parts[""]] == [1, 2]
    assert [thunk.number for thunk in loop.parts["condition"]] == [4]
    assert [thunk.kind for thunk in loop.parts["body"]] == ["kCommandBuffer", "kWhile", "kCustomKernel"]
    inner = loop.parts["body"][1]
    assert inner.parts["condition"] == []
    assert [thunk.number for thunk in inner.parts["body"]] == [8]
    assert [len(part) for part in conditional.parts.values()] == [2, 1]


def test_every_thunk_of_the_text_is_in_the_tree_once():
    numbers = [thunk.number for thunk in xla_dump.walk(xla_dump.parse_thunks(TREE)) if thunk.number]
    assert numbers == list(range(1, 14))


def test_names_go_by_the_numbers_of_thunks():
    assert xla_dump.parse_names(METADATA) == NAMES


def test_a_stack_goes_from_the_line_outward():
    stack = hlo_text.Stacks(HLO)(4)
    assert [frame.function for frame in stack] == [
        "for_chunks",
        "fit_ground_plane",
        "remove_ground",
        "_segment",
    ]
    assert stack[0] == ("/somewhere/jaxbox/xla/loops.py", 125, "for_chunks")
    assert hlo_text.step_of(stack) == "remove_ground"
    assert xla_dump.key_of(stack) == OUTER
    assert hlo_text.Stacks(HLO)(0) == ()
    assert hlo_text.step_of(()) == ""


@pytest.mark.parametrize(
    ("shape", "size"),
    [("f32[]", 4), ("pred[3]{0}", 3), ("bf16[2,3]{1,0}", 12), ("f64[0,5]{1,0}", 0), ("token[]", 0)],
)
def test_the_size_of_an_array_is_its_elements_by_their_type(shape, size):
    assert hlo_text.bytes_of(shape) == size


def test_the_size_of_a_tuple_is_that_of_its_parts():
    assert hlo_text.bytes_of("(f32[2,3]{1,0}, /*index=1*/s32[4]{0}, pred[])") == 24 + 16 + 1


def test_what_is_read_whole_counts_whole_and_once(instructions):
    assert moved(instructions["loop_add_fusion"]) == (800, 400)
    assert moved(instructions["copy.1"]) == (400, 400)
    assert moved(instructions["multiply.1"]) == (400, 400)


def test_of_a_slice_only_the_slice_is_read(instructions):
    assert moved(instructions["loop_slice_fusion"]) == (40, 40)
    assert moved(instructions["dynamic-slice.1"]) == (20 + 4, 20)


def test_what_a_fusion_works_out_to_look_up_some_of_it_is_worked_out_for_those(instructions):
    # Four entries of a sum of two arrays, at four places.
    assert moved(instructions["loop_gather_fusion"]) == (16 + 16 + 16, 16)


def test_what_is_updated_in_place_counts_by_its_updates(instructions):
    # A scatter reads the seven elements that it adds to, their places and the values.
    assert moved(instructions["input_scatter_fusion"]) == (28 + 28 + 28, 28)
    read, written = moved(instructions["loop_update_fusion"])
    assert (read, written) == (40 + 4, 40)


def test_turns_that_the_compiler_knows_are_read(instructions):
    assert instructions["while.2"].trip_count == 3
    assert instructions["while.1"].trip_count is None


def test_a_fusion_without_a_stack_has_that_of_what_it_fuses(instructions):
    assert hlo_text.step_of(instructions["loop_add_fusion"].frames) == "remove_ground"
    assert hlo_text.step_of(instructions["loop_slice_fusion"].frames) == "fit_rectangles"


def test_what_the_compiler_made_up_goes_with_the_step_before_it(program):
    steps = {thunk.number: thunk.step for thunk in xla_dump.walk(program) if thunk.kind != "kCommandBuffer"}
    assert steps[2] == steps[5] == "remove_ground"
    assert steps[8] == steps[13] == "fit_rectangles"


def test_a_dump_of_another_kind_is_an_error(tmp_path):
    with pytest.raises(SystemExit, match="0 files jit_counted_detect"):
        xla_dump.read_program(tmp_path, "counted_detect")


def test_a_dump_is_read_from_its_three_files(tmp_path, program):
    for name, text in (
        ("thunk_sequence_after_thunk_passes", TREE),
        ("thunk_metadata", METADATA),
        ("sm_9.0a_gpu_after_optimizations", HLO),
    ):
        (tmp_path / f"module_0001.jit_counted_detect.{name}.txt").write_text(text)
    assert xla_dump.read_program(tmp_path, "counted_detect") == program


@pytest.mark.parametrize("turns", [0, 1, 2.5])
def test_a_loop_costs_its_body_by_turns_and_its_condition_once_more(program, turns):
    counts = launch_model.total(launch_model.count(program, {OUTER: Turns(2 * turns, 2)}))
    in_body, in_condition, outside, inner_turns = 3, 1, 1, 3
    assert counts.kernels == outside + turns * (in_body + inner_turns) + (turns + 1) * in_condition
    # One more for the conditional, which the host waits for as well.
    assert counts.waits == turns + 1 + 1
    assert counts.graphs == 1 + turns
    assert counts.in_graphs == 2 + 2 * turns


def test_of_a_conditional_the_short_branch_counts(program):
    counts = launch_model.total(launch_model.count(program[2:], {}))
    assert (counts.kernels, counts.copies, counts.waits) == (0, 1, 1)


def test_loops_without_counted_turns_count_once_and_are_named(program):
    assert launch_model.count(program, {}) == launch_model.count(program, {OUTER: Turns(1, 1)})
    sources = {loop.source: loop.turns for loop in launch_model.list_loops(program, {})}
    assert sources == {"unknown": 1, "compiler": 3}
    assert launch_model.list_loops(program, {OUTER: Turns(6, 3)})[0].turns == 2


def test_in_a_graph_no_host_waits():
    loop = Thunk("kWhile", 1, parts={"condition": [Thunk("kCustomKernel", 2)], "body": [Thunk("kCopy", 3)]})
    alone = launch_model.total(launch_model.count([loop], {}))
    in_graph = launch_model.total(launch_model.count([Thunk("kCommandBuffer", 0, parts={"": [loop]})], {}))
    assert (alone.waits, alone.in_graphs) == (2, 0)
    assert (in_graph.waits, in_graph.in_graphs) == (0, alone.launches)


def test_the_model_is_linear_and_each_thing_takes_its_time():
    counts = Counts(kernels=5, copies=2, in_graphs=4, graphs=1, waits=3, bytes_read=1e9, bytes_written=2e9)
    assert (counts + counts).model_ms == pytest.approx(2 * counts.model_ms)
    assert (counts * 0.5).model_ms == pytest.approx(counts.model_ms / 2)
    assert Counts().model_ms == 0
    assert Counts(kernels=1000).model_ms == pytest.approx(launch_model.KERNEL_US)
    assert Counts(kernels=1000, in_graphs=1000).model_ms == pytest.approx(launch_model.NODE_US)
    assert Counts(waits=1000).model_ms == pytest.approx(launch_model.WAIT_US)
    assert Counts(bytes_read=1.5e9, bytes_written=1e9).model_ms == pytest.approx(1)


def test_the_report_adds_up_and_lists_the_heaviest_first(program):
    report = bench_launches.report_of(program, {OUTER: Turns(2, 1)}, 4)
    for name in ("kernels", "copies", "waits", "bytes_read", "bytes_written", "model_ms"):
        assert report["whole"][name] == pytest.approx(sum(step[name] for step in report["steps"].values()))
    assert report["model_ms_a_sweep"] == report["whole"]["model_ms"] / 4
    heaviest = [launch["bytes"] for launch in report["heaviest"]]
    assert heaviest == sorted(heaviest, reverse=True)
    assert report["heaviest"][0]["name"] == "loop_add_fusion"


def test_the_table_has_a_line_for_each_step_and_the_whole(program, capsys):
    bench_launches.show(bench_launches.report_of(program, {}, 2), 2)
    printed = capsys.readouterr().out
    assert [line.split()[0] for line in printed.splitlines()[1:4]] == [
        "remove_ground",
        "fit_rectangles",
        "all",
    ]
    assert "2 sweeps" in printed
    assert OUTER in printed


def test_more_launches_than_wanted_are_an_error():
    bench_launches.fail_above(10, None)
    bench_launches.fail_above(10, 10)
    with pytest.raises(SystemExit, match="11 kernels and copies, more than 10"):
        bench_launches.fail_above(11, 10)


@pytest.mark.parametrize("version", [None, "0.0.1"])
def test_without_the_compiler_the_command_that_installs_it_is_named(monkeypatch, version):
    monkeypatch.setattr(compile_ahead.common, "installed_version", lambda name: version)
    with pytest.raises(SystemExit) as error:
        bench_launches.main([])
    at = jax.__version__
    assert str(error.value).endswith(
        f"pip install jax-cuda12-pjrt=={at} jax-cuda12-plugin=={at} nvidia-cuda-nvcc-cu12"
    )
    assert f"jax-cuda12-plugin {version or 'missing'}" in str(error.value)


def halvings(number):
    return jax.lax.while_loop(lambda n: n > 0, lambda n: n // 2, number)


def tally_of(function, *values):
    program = jax.make_jaxpr(function)(*values)
    empty = loop_turns.no_turns(program.jaxpr)
    return loop_turns.evaluate(program.jaxpr, program.consts, values, empty)


def count_sorted(tally):
    return sorted(tuple(int(n) for n in counts) for counts in tally.values())


@pytest.fixture
def named(monkeypatch):
    """Names loops by their lines of this file."""
    monkeypatch.setattr(detector, "__file__", __file__.replace(pathlib.Path(__file__).name, "detector.py"))


@pytest.mark.parametrize("number", [0, 1, 5, 1000])
def test_turns_are_counted_as_they_happen(named, number):
    results, tally = tally_of(lambda n: halvings(n) + 7, jnp.int32(number))
    assert int(results[0]) == 7
    assert count_sorted(tally) == [(number.bit_length(), 1)]


def test_turns_of_loops_in_loops_and_calls_add_up_over_their_calls(named):
    def outer(count):
        return jax.lax.while_loop(
            lambda state: state[0] < count,
            lambda state: (state[0] + 1, state[1] + jax.jit(halvings)(state[0])),
            (jnp.int32(0), jnp.int32(0)),
        )

    _, tally = tally_of(outer, jnp.int32(5))
    inner = sum(number.bit_length() for number in range(5))
    assert count_sorted(tally) == sorted([(5, 1), (inner, 5)])


def test_evaluating_with_counters_gives_the_functions_own_results(named):
    def function(x):
        sorted_x = jnp.sort(x)[::-1]
        return jnp.cumsum(sorted_x), jax.nn.softplus(x), jnp.where(x > 0, halvings(jnp.int32(9)), 1)

    x = jnp.array([3.0, -1.0, 2.0])
    results, _ = tally_of(function, x)
    for result, wanted in zip(results, jax.jit(function)(x), strict=True):
        np.testing.assert_allclose(result, wanted, rtol=1e-6)


def test_a_loop_that_cannot_be_counted_is_an_error(named):
    def scanned(numbers):
        return jax.lax.scan(lambda total, n: (total + halvings(n), n), jnp.int32(0), numbers)

    with pytest.raises(SystemExit, match="loops within scan are not counted"):
        tally_of(scanned, jnp.arange(3))


def test_a_batch_turns_as_long_as_any_of_its_sweeps():
    tallies = [np.array([2, 1]), np.array([5, 1])]
    assert loop_turns._merge(tallies, together=True) == Turns(5, 1)
    assert loop_turns._merge(tallies, together=False) == Turns(3.5, 1)
    assert loop_turns.turns_of_sweeps([], DetectorConfig(), together=False) == {}


@pytest.mark.slow
def test_every_loop_of_the_program_for_an_accelerator_is_in_a_step_and_can_be_counted():
    cloud = PointCloud.from_numpy(np.zeros((1, 3), np.float32), capacity=16384)
    with building_for(accelerator=True):
        operands = compiled._operands(cloud, DetectorConfig(), None)
    tally = loop_turns.no_turns(jax.make_jaxpr(compiled._find_vehicles)(*operands).jaxpr)
    assert all(key.split(" < ")[-1] in bench_launches.STEPS for key in tally)
    assert len(tally) <= 3


def test_the_page_has_both_programs_by_step_and_says_that_they_were_counted():
    path = pathlib.Path(__file__).parents[1] / "docs" / "hooks" / "figures.py"
    spec = importlib.util.spec_from_file_location("figures", path)
    hook = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hook)
    page = hook.on_page_markdown("<!-- table: launches -->\n<!-- table: launch_totals -->")
    assert all(f"| `{step}` |" in page for step in bench_launches.STEPS)
    assert "Counted, not measured" in page
    assert "| default, 64 sweeps |" in page


@pytest.mark.parametrize("name", ["launches", "launches_fast", "launches_paper", "launches_batch"])
def test_the_recorded_counts_add_up_and_have_no_unknown_loop(name):
    path = bench_launches.common.PROJECT / "benchmarks" / "results" / f"{name}.json"
    report = json.loads(path.read_text())
    launches = sum(step["launches"] for step in report["steps"].values())
    assert report["whole"]["launches"] == pytest.approx(launches)
    assert "unknown" not in {loop["source"] for loop in report["loops"]}
    assert report["target"] == compile_ahead.TARGET
