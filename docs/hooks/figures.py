"""MkDocs hook: fills ``<!-- table: NAME -->`` from the recorded results and from the code."""

import dataclasses
import inspect
import json
import pathlib
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jaxbox
from jaxbox.config.ranges import range_of
from jaxbox.evaluation.corruptions import CORRUPTIONS
from jaxbox.tracking import TrackConfig, Tracks, TrackStatus, motion
from jaxbox.types import Counts, Motion, Status

PROJECT = pathlib.Path(__file__).parents[2]
RESULTS = {
    path.stem: path
    for folder in ("benchmarks", "quality")
    for path in (PROJECT / folder / "results").glob("*.json")
}


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by MkDocs for each page."""
    return re.sub(r"<!-- table: (\w+) -->", lambda match: TABLES[match[1]](), markdown)


def load(name: str) -> dict[str, Any]:
    """One of the recorded results."""
    return json.loads(RESULTS[name].read_text("utf-8"))


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell(value) for value in line) + " |" for line in lines)


def cell(value: Any) -> str:
    """Figures to three places at most."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"


def made_with(report: dict[str, Any]) -> str:
    """What a result was measured on."""
    at = report["circumstances"]
    device = at.get("device_kind", "cpu")
    machine = f"{at['processor']}, {at['cpus']} cores, jax {at['packages']['jax']}"
    machine = machine if device == "cpu" else f"{device} next to {machine}"
    return f"\n\n*Recorded at commit {at['commit'][:8]}, {machine}.*"


def accuracy() -> str:
    """AP of the presets."""
    default, paper = load("accuracy_default"), load("accuracy_paper")
    names = ["bev easy", "bev moderate", "bev hard", "3d easy", "3d moderate", "3d hard"]
    ceiling = default["copies"]["as recorded"]["ap_ceiling"]
    rows = [
        ("default, as recorded", *ap(default["copies"]["as recorded"]["ap"], names)),
        ("default, mean of copies", *ap(default["summary"]["mean of all"], names)),
        ("default, deviation", *ap(default["summary"]["sd of all"], names)),
        ("paper, as recorded", *ap(paper["copies"]["as recorded"]["ap"], names)),
        ("ceiling", *ap(ceiling, names)),
    ]
    return table(["", *names], rows) + made_with(default)


def readings() -> str:
    """The default next to the preset that reads a sweep twice."""
    columns = [_preset_figures("accuracy_default", ""), _preset_figures("accuracy_accurate", "_accurate")]
    rows = [(name, *(column[name] for column in columns)) for name in columns[0]]
    return table(["", "default", "accurate"], rows) + made_with(load("accuracy_accurate"))


def _preset_figures(accuracy_of_20: str, ending: str) -> dict[str, float]:
    """Accuracy of a preset, what it finds with other sensors, and how steady it is, in % each."""
    names = ["SOFT", "3d easy", "3d moderate", "3d hard", "bev moderate"]
    figures = {
        f"{frames} frames: {name}": load(report)["summary"]["mean of all"][name]
        for frames, report in ((20, accuracy_of_20), (58, f"accuracy_unseen{ending}"))
        for name in names
    }
    pooled = load(f"sensors{ending}")["pooled"]
    cut = next(row for row in pooled["cuts"] if row["min_score"] == pooled["library_cut"])
    figures["other sensors: recall of cars"] = 100 * cut["recall_cars"]
    figures["other sensors: precision"] = 100 * cut["precision"]
    for change, by_score in load(f"steadiness{ending}")["boxes"].items():
        figures[f"boxes that stay: {change}"] = 100 * by_score["0.3"]["stay"]
    rows = load(f"situations{ending}")["rows"]
    return figures | {
        f"situations: vehicles {outcome}": 100
        * sum(row[outcome] for row in rows)
        / sum(row["vehicles"] for row in rows)
        for outcome in ("found", "silent")
    }


def classes() -> str:
    """What is found of each class, and how many boxes of it are right."""
    report = load("classes")

    def share(part: int, whole: int) -> str:
        return f"{part} of {whole}"

    def cut(score: float | None) -> float | str:
        return "none" if score is None else score

    rows = [
        (
            kind,
            share(row["found 30"], row["labels 30"]),
            share(row["found 100"], row["labels 100"]),
            share(row["right"], row["boxes"]),
            row["false"],
            cut(row["cut 0.9"]),
            share(row["found 100 from 0.9"], row["labels 100"]),
            cut(row["cut 0.95"]),
            share(row["found 30 from 0.95"], row["labels 30"]),
        )
        for kind, row in report["classes"].items()
    ]
    header = [
        "",
        "found, 30 points",
        "found, 100 points",
        "right",
        "false",
        "90 % right from",
        "found then, 100 points",
        "95 % right from",
        "found then, 30 points",
    ]
    return table(header, rows) + made_with(report)


def ablation() -> str:
    """What is gained or lost without each part, in the mean of copies."""
    report = load("ablation")
    columns = ["SOFT of 20", "SOFT of 58", "3d moderate", "vehicles bev", "false a frame"]
    full, *others = report["rows"].items()

    def mean(row: dict[str, Any], name: str) -> float:
        return sum(copy[name] for copy in row["copies"].values()) / len(row["copies"])

    rows = [
        (name, *(mean(row, column) - mean(full[1], column) for column in columns)) for name, row in others
    ]
    whole = (full[0], *(mean(full[1], column) for column in columns))
    return table(["", *columns], [whole, *rows]) + made_with(report)


def ap(values: dict[str, float], names: Sequence[str]) -> list[float]:
    """In the order of the header."""
    return [values[name] for name in names]


def sizes() -> str:
    """Size errors next to the constant row's."""
    report = load("accuracy_default")["copies"]["as recorded"]
    names = ["mae", "rmse", "percent", "pearson", "mean_iou"]
    rows = [(kind, *(values[n] for n in names)) for kind, values in report["sizes"].items()]
    rows += [(f"{kind}, constant", *(v[n] for n in names)) for kind, v in report["constant_sizes"].items()]
    return table(["", "MAE m", "RMSE m", "% error", "Pearson", "1D IoU"], rows)


def paper_table() -> str:
    """The paper's table, next to its own figures."""
    report = load("paper_table")
    rows = []
    for preset in ("default", "paper"):
        pooled = report[preset]["window"]["errors"]["estimated"]["pooled"]
        rows.append((preset, *(pooled[n] for n in ("mae", "rmse", "percent", "pearson", "mean_iou"))))
    rows.append(("the paper", 0.167, 0.186, 8.5, 0.9995, 0.936))
    return table(["", "MAE m", "RMSE m", "% error", "Pearson", "1D IoU"], rows) + made_with(report)


def sensors() -> str:
    """Recall by data set."""
    report = load("sensors")
    rows = [
        (name, *recall.values())
        for name in ("argoverse2", "pandaset", "semantic_kitti")
        for recall in [report[name]["recall"]["cars"]]
    ]
    return table(["", *report["argoverse2"]["recall"]["cars"]], rows) + made_with(report)


def cuts() -> str:
    """Precision and recall by cut."""
    rows = load("sensors")["pooled"]["cuts"]
    return table(list(rows[0]), [list(row.values()) for row in rows])


def sensor_classes() -> str:
    """Boxes of each class, and how many are right, with other sensors."""
    rows = [
        (name, count["boxes"], count["right"]) for name, count in load("sensors")["pooled"]["classes"].items()
    ]
    return table(["called", "boxes", "right"], rows)


def ground() -> str:
    """F1 by data set and method."""
    report = load("ground")
    means = report["mean_f1"]
    methods = list(means["semantic_kitti"]["f1"])
    rows = [(name, *(values["f1"].get(m, "") for m in methods)) for name, values in means.items()]
    return table(["", *methods], rows) + made_with(report)


def speed() -> str:
    """Whole sweeps and steps of the default preset, and the whole of the paper's."""
    report, paper = load("stages"), load("stages_paper")
    names = ("min", "median", "p90", "p99")
    rows = [(f"default, {name}", *(report["whole"][name][n] for n in names)) for name in WHOLES]
    rows += [(f"paper, {name}", *(paper["whole"][name][n] for n in names)) for name in WHOLES]
    rows += [(f"`{name}`", *(values[n] for n in names)) for name, values in report["steps"].items()]
    return table(["", "min ms", "median ms", "p90 ms", "p99 ms"], rows) + made_with(report)


WHOLES = ("host to host", "on the device")


def gpu() -> str:
    """Whole sweeps on a GPU, one by one and in batches."""
    one_by_one = {"default": load("stages_h200"), "paper": load("stages_paper_h200")}
    scaling = load("scaling_h200")
    rows = [
        (f"{preset}, {name}", r["whole"][name]["median"])
        for preset, r in one_by_one.items()
        for name in WHOLES
    ]
    for row in scaling["batches"]:
        ways = ("loop", "vmap") if "vmap" in row else ()
        rows += [(f"default, {row['batch']} sweeps by a {way}", row[way]) for way in ways]
    return table(["", "median ms a sweep"], rows) + made_with(scaling)


def launches() -> str:
    """What a GPU would be asked to do, by step: the default program before and now, a sweep and a batch."""
    one = load("launches_before"), load("launches")
    many = load("launches_batch_before"), load("launches_batch")
    names = [*many[0]["steps"], "all"]

    def values(report: dict[str, Any], name: str, *fields: str) -> str:
        counts = {**report["steps"], "all": report["whole"]}.get(name, {})
        return f"{sum(counts.get(field, 0) for field in fields):,.0f}"

    def gigabytes(report: dict[str, Any], name: str) -> float:
        counts = {**report["steps"], "all": report["whole"]}.get(name, {})
        return (counts.get("bytes_read", 0) + counts.get("bytes_written", 0)) / 1e9

    rows = [
        (
            name if name in ("all", "other") else f"`{name}`",
            *(values(report, name, "launches") for report in one),
            *(values(report, name, "waits") for report in one),
            *(values(report, name, "launches") for report in many),
            *(f"{gigabytes(report, name):.1f}" for report in many),
        )
        for name in names
    ]
    header = ["", "launches, before", "now", "waits, before", "now"]
    header += ["launches of 64 sweeps, before", "now", "their GB, before", "now"]
    return table(header, rows) + counted_for(one[1])


def launch_totals() -> str:
    """The whole of each program that launches were counted for."""
    programs = {
        "default, before": load("launches_before"),
        "default": load("launches"),
        "fast": load("launches_fast"),
        "paper": load("launches_paper"),
        "default, 64 sweeps, before": load("launches_batch_before"),
        "default, 64 sweeps": load("launches_batch"),
    }
    fields = ("kernels", "copies", "in_graphs", "graphs", "waits")
    rows = []
    for name, report in programs.items():
        whole = report["whole"]
        moved = (whole["bytes_read"] / 1e9, whole["bytes_written"] / 1e9)
        rows.append((name, *(f"{whole[f]:,.0f}" for f in fields), *moved, report["model_ms_a_sweep"]))
    header = ["", "kernels", "copies", "of both in graphs", "graphs", "waits"]
    return table([*header, "GB read", "GB written", "model, ms a sweep"], rows)


def counted_for(report: dict[str, Any]) -> str:
    """What launches were counted for."""
    at = report["circumstances"]
    return (
        f"\n\n*Counted, not measured, at commit {at['commit'][:8]} for an {report['target']}, "
        f"jax {at['packages']['jax']}.*"
    )


def frontier() -> str:
    """Accuracy against time of the presets."""
    report = load("frontier")
    names = list(report["presets"]["default"])
    rows = [(preset, *(row[n] for n in names)) for preset, row in report["presets"].items()]
    return table(["", *names], rows) + made_with(report)


def peers() -> str:
    """Other libraries on the same sweeps."""
    report = load("peers")
    names = ("median", "p99", "clusters", "boxes", "recall")
    rows = [(chain, *(row[n] for n in names)) for chain, row in report["chains"].items()]
    return table(["", "median ms", "p99 ms", "clusters", "boxes", "recall"], rows) + made_with(report)


def fuzz() -> str:
    """What each reader was fed with, and how much of it is still a finding."""
    report = load("fuzz")
    rows = [
        (f"`{name}`", *(r[n] for n in ("minutes", "cpu_minutes", "executions")), len(r["findings"]) or "none")
        for name, r in report["readers"].items()
    ]
    header = ["reader", "minutes", "processor minutes", "files read", "open findings"]
    return table(header, rows) + made_with(report)


def faults() -> str:
    """Kills, and what they did."""
    report = load("faults")
    rows = [("runs killed", report["kills"])]
    rows += [(f"... {stage}", count) for stage, count in report["reached"].items()]
    rows += [
        ("runs that ended before their kill", report["ended_by_themselves"]),
        ("files that were half written", len(report["half_written"])),
        ("files compared at the end", report["files"]),
        ("files that differ", len(report["differing"])),
    ]
    return table(["", "count"], rows) + made_with(report)


def corruption() -> str:
    """Accuracy of corrupted sweeps, the clean ones first."""
    report = load("corruption")
    names = {"3d": "3D AP", "bev": "BEV AP", "SOFT": "SOFT", "recall": "recall"}
    names |= {"recall at the cut": "recall at the cut", "well seen": "of 100 points"}
    names |= {"false a frame": "false a frame"}
    names |= {"length": "too long m", "height": "too high m"}
    rows = [("clean", "", *(report["clean"]["mean"][n] for n in names))]
    for name, kind in report["corruptions"].items():
        what = CORRUPTIONS[name]
        rows += [
            (what.title, f"{rung['amount']:g} {what.unit}", *(rung["mean"][n] for n in names))
            for rung in kind["severities"]
        ]
    return table(["", "amount", *names.values()], rows) + made_with(report)


def steadiness() -> str:
    """Shares of boxes that stay, by what is done to the sweep."""
    report = load("steadiness")
    rows = [
        (part, change, score, shares["boxes"], 100 * shares["stay"], 100 * shares["found"])
        for part in ("boxes", "tracks")
        for change, by_score in report[part].items()
        for score, shares in by_score.items()
    ]
    header = ["of", "change", "from score", "boxes", "% that stay", "% with a box of IoU .5"]
    return table(header, rows) + made_with(report)


def mutation() -> str:
    """Mutants by module and outcome."""
    report = load("mutation")
    modules = report["modules"]
    names = list(next(iter(modules.values())))
    rows = [(f"`{module}`", *(row[n] for n in names)) for module, row in modules.items()]
    rows.append(("all", *(sum(row[n] for row in modules.values()) for n in names)))
    return table(["", *names], rows) + made_with(report)


def coverage() -> str:
    """Lines and branches by package, those with the most uncovered first."""
    report = load("coverage")
    names = ("lines", "lines missed", "branches", "branches missed", "percent")
    rows = [(f"`{part}`", *(row[n] for n in names)) for part, row in report["parts"].items()]
    return table(["", *names], rows) + f"\n\nOf {report['tests']}." + made_with(report)


def cluster() -> str:
    """Rates of the workers of a cluster, by their number."""
    report = load("cluster")
    rows = [
        (text, *(run[name] * scale for run in report["workers"].values()))
        for text, name, scale in CLUSTER_ROWS
    ]
    rows.append(("`jaxbox.stream`: sweeps a second", *report["stream_sweeps_per_second"].values()))
    header = [f"{number} worker{'s' * (number != '1')}" for number in report["workers"]]
    return table(["", *header], rows) + made_with(report)


CLUSTER_ROWS = (
    ("sweeps a second and worker", "sweeps_per_second_per_worker", 1),
    ("sweeps a second", "sweeps_per_second", 1),
    ("share of the time in the detector", "waiting_for_detector_share", 1),
    ("compiling, or loading from the cache, s", "compile_s", 1),
    ("starting and ending Ray and the workers, s", "start_and_end_s", 1),
    ("memory of a worker, peak, MB", "peak_mb_per_worker", 1),
    ("read, MB a sweep", "bytes_read_per_sweep", 1e-6),
    ("written, kB a sweep", "bytes_written_per_sweep", 1e-3),
)
"""Words, name in the report, and factor of the unit."""


def archives() -> str:
    """What archives of some sizes take."""
    report = load("cluster")
    rows = [(f"{int(size):,}", *row.values()) for size, row in report["archives"].items()]
    columns = [name.replace("_", " ") for name in next(iter(report["archives"].values()))]
    return table(["sweeps", *columns], rows)


def beams() -> str:
    """KITTI thinned: the preset of 64 beams against the sensor's."""
    report = load("beams")
    rows = [tuple(row.values()) for row in report["kitti"]]
    return table(list(report["kitti"][0]), rows) + made_with(report)


def beams_recall() -> str:
    """Recall by number of beams on the 58 frames that chose a part of the settings."""
    report = load("beams")
    others = [row for row in report["kitti"] if row["set"] == "58 frames"]
    found = {(row["sensor"], row["preset for"]): row["recall bev 0.5"] for row in others}
    beams = sorted({sensor for sensor, _ in found}, reverse=True)
    rows = [(n, found[n, "64 beams"], found[n, f"{n} beams"]) for n in beams]
    return table(["beams over 27 degrees", "recall, default preset", "with `--sensor`"], rows) + made_with(
        report
    )


def beams_synthetic() -> str:
    """The same on ray-cast streets."""
    rows = load("beams")["synthetic"]
    return table(list(rows[0]), [tuple(row.values()) for row in rows])


def mounting() -> str:
    """Accuracy of tilted and moved sweeps, as they are and upright."""
    rows = load("mounting")["rows"]
    by_case: dict[str, dict[str, dict[str, Any]]] = {}
    for row in rows:
        by_case.setdefault(row["case"], {})[row["seen"]] = row
    names, sides = ("AP 3d", "SOFT"), ("as it is", "upright")
    lines = [(case, *(found[side][n] for n in names for side in sides)) for case, found in by_case.items()]
    header = ["", *(f"{name}, {side}" for name in names for side in sides)]
    return table(header, lines) + made_with(load("mounting"))


def situations() -> str:
    """What is found in hard situations: before the rules that they led to, now, and from other places."""
    now, before, aside = load("situations"), load("situations_before"), load("situations_draws")
    was, elsewhere = (
        {f"{row['group']}: {row['situation']}": row for row in of["rows"]} for of in (before, aside)
    )
    names = ("vehicles", "found", "loud", "silent", "false")
    rows = []
    for row in now["rows"]:
        title = f"{row['group']}: {row['situation']}"
        found_aside = "{found} of {vehicles}".format_map(elsewhere[title])
        rows.append((title, was[title]["found"], *(row[n] for n in names), found_aside))
    header = ["situation", "found before", *names, f"found from {len(aside['places'])} places aside"]
    return table(header, rows) + made_with(now)


def status() -> str:
    """Every bit and its sentence."""
    return table_of_bits(Status)


def track_status() -> str:
    """Every bit of the tracker and its sentence."""
    return table_of_bits(TrackStatus)


def table_of_bits(kind: type[Status] | type[TrackStatus]) -> str:
    """Name, value and sentence of each bit."""
    rows = [(f"`{b.name}`", b.value, b.describe()[0].partition(": ")[2]) for b in kind if b.value]
    return table(["bit", "value", "what happened, and the fix"], rows)


def counts() -> str:
    """The fields of `Counts` and what they count."""
    return table(["count", ""], field_texts(Counts))


def track_fields() -> str:
    """The fields of `Tracks` and what they mean, those that hold further fields apart."""
    rows = [row for row in field_texts(Tracks) if row[0] not in ("`counts`", "`status`")]
    return table(["field", "shape, type, unit and frame, and meaning"], rows)


def field_texts(kind: type) -> list[tuple[str, str]]:
    """The arrays of a dataclass, each with the string that stands under it, which only the source has."""
    source = inspect.getsource(kind)
    pattern = r'^    (\w+): (?:jax\.Array|TrackCounts)\n    """(.*?)"""'
    texts = dict(re.findall(pattern, source, re.MULTILINE | re.DOTALL))
    return [(f"`{f.name}`", " ".join(texts[f.name].split())) for f in dataclasses.fields(kind)]


def track_settings() -> str:
    """Every setting of the tracker."""
    rows = [
        (name.replace("track.", ""), value, meaning)
        for name, value, *_, meaning in setting_rows(TrackConfig(), "track")
    ]
    return table(["setting", "default", "meaning"], rows)


def motion_states() -> str:
    """Every state of motion and when a track is in it; the later ones take precedence."""
    c, second = TrackConfig(), f"{motion.MEMORY_S:g} s"
    texts = {
        Motion.STANDING: "does not move",
        Motion.MOVING: f"faster than {c.moving_speed_mps:g} m/s and than {motion.SPEED_SDS:g} standard "
        f"deviations of its speed, until it is slower than {c.standing_speed_mps:g} m/s",
        Motion.STARTING: f"moves, faster by more than {c.starting_mps2:g} m/s² than {second} ago, when it "
        f"was slower than {motion.STARTING_SPEED_MPS:g} m/s",
        Motion.STOPPING: f"moves, slower by more than {c.starting_mps2:g} m/s² than {second} ago, and than "
        f"{motion.STOPPING_SPEED_MPS:g} m/s",
        Motion.TURNING: f"moved for {second} and is faster than {motion.TURNING_SPEED_MPS:g} m/s, and its "
        f"course changed by more than {c.turning_deg_per_s:g} degrees a second",
        Motion.LANE_CHANGE: f"moved for {motion.LANE_S:g} s, its courses at both ends agree within "
        f"{c.lane_course_deg:g} degrees, and its path ends more than {c.lane_change_m:g} m to the side of "
        "either; `lateral_shift_m` has the metres, positive to its left",
    }
    rows = [(state.word, f"`{state.name}`", text) for state, text in texts.items()]
    return table(["state", "`jaxbox.Motion`", "when"], rows)


def tracking() -> str:
    """Single sweeps, tracks and smoothed tracks side by side: the parts that were recorded."""
    if "tracking" not in RESULTS:
        return "*Not recorded yet.*"
    report = load("tracking")
    parts = [part(report[name]) for name, part in TRACKING_PARTS.items() if name in report]
    return "\n\n".join(parts) + made_with(report)


def tracking_drives(title: str, drives: dict[str, Any]) -> str:
    """A table of drives, three rows each."""
    names = list(next(iter(drives.values()))["online"]["figures"])
    rows = []
    for drive, kinds in drives.items():
        for kind in ("single sweep", "online", "offline"):
            moving = kinds[kind]["motion"].get("velocity_moving") or {}
            extra = (kinds[kind]["motion"]["headings"]["within_90_deg"], moving.get("median"))
            values = [*(kinds[kind]["figures"].get(name) for name in names), *extra]
            rows.append((drive, kind, *("" if value is None else value for value in values)))
    header = ["drive", "", *names, "headings within 90 degrees", "velocity error m/s, median of movers"]
    poses = sorted({kinds["poses"] for kinds in drives.values() if "poses" in kinds})
    parts = [f"### {title}", table(header, rows)] + ([f"Poses: {', '.join(poses)}."] if poses else [])
    rooms = [(drive, *kinds["room"].values()) for drive, kinds in drives.items()]
    counts = list(next(iter(drives.values()))["room"])
    parts.append(
        "What the detector missed and tracks expect, and standing boxes that other sweeps saw through:"
    )
    return "\n\n".join([*parts, table(["drive", *counts], rooms)])


def tracking_real(drives: dict[str, Any]) -> str:
    """Drives of KITTI."""
    return tracking_drives("Real drives: Car and Van, where camera 2 sees them", drives)


def tracking_synthetic(drives: dict[str, Any]) -> str:
    """Ray-cast drives, and the states found on all of them together."""
    words = [state.word for state in Motion]
    tables = []
    for kind in ("online", "offline"):
        each = [kinds[kind]["motion"]["states"]["confusion"] for kinds in drives.values()]
        total = [[sum(cells) for cells in zip(*lines, strict=True)] for lines in zip(*each, strict=True)]
        rows = [(word, *line) for word, line in zip(words, total, strict=True)]
        tables.append(f"States, {kind}: truth in rows, found in columns.\n\n{table(['', *words], rows)}")
    return "\n\n".join([tracking_drives("Ray-cast drives, with exact truth", drives), *tables])


def tracking_boxes(found: dict[str, Any]) -> str:
    """The association alone, on the boxes of a trained detector."""
    rows = []
    for kind, item in found.items():
        hota, clear = item["figures"]["hota"], item["figures"]["clear"]
        shares = (hota["hota"], hota["det_a"], hota["ass_a"], clear["mota"])
        rows.append((kind, *(100 * share for share in shares), clear["idsw"], clear["frag"]))
    header = ["", "HOTA", "DetA", "AssA", "MOTA", "switches", "fragmentations"]
    return "### Ten sequences with the boxes of a trained detector: Car, 2D\n\n" + table(header, rows)


TRACKING_PARTS = {"real": tracking_real, "synthetic": tracking_synthetic, "boxes": tracking_boxes}


def bad_input() -> str:
    """Every bad input, and what both presets make of it."""
    report = load("bad_input")
    rows = []
    for group, inputs in report["answers"].items():
        rows.append((f"**{group}**", *[""] * 6))
        for name, answers in inputs.items():
            cells = [cell for preset in ("default", "paper") for cell in bad_input_cells(answers[preset])]
            laws = all(not answer["broken"] for answer in answers.values())
            rows.append((name, f"{answers['default']['points']:,}", *cells, "held" if laws else "broken"))
    names = ["status", "boxes, above the cut"]
    header = [
        "input",
        "points",
        *(f"{preset}: {n}" for preset in ("default", "paper") for n in names),
        "laws",
    ]
    return table(header, rows) + made_with(report)


def bad_input_cells(answer: dict[str, Any]) -> list[str]:
    """The status, and how many boxes there were and were worth acting on."""
    status = ", ".join(f"`{bit}`" for bit in answer["status"]) or "OK"
    return [status, f"{answer['boxes']}, {answer['boxes_above_cut']}"]


def refused() -> str:
    """The error of every input that is refused."""
    return table(["input", "`ValueError`"], load("bad_input")["refused"].items())


def same_bits() -> str:
    """Where answers came about, and whether their bits are those of the first."""
    report = load("determinism")
    both = report["same_bits"]
    first = next(iter(both.values()))
    repeats = [f"{both[preset]['different_answers']} differ" for preset in both]
    rows = [(f"{first['repeats']} repeats of {len(first['sweeps'])} sweeps", *repeats)]
    for group in ("same_in_batches", "same_in_processes", "same_in_other_programs"):
        for name in first[group]:
            rows.append((name, *("same bits" if both[preset][group][name] else "differs" for preset in both)))
    rows += [
        (f"tracks of a drive, {name}", "same bits" if same else "differs", *[""] * (len(both) - 1))
        for name, same in report.get("same_tracks", {}).items()
    ]
    return table(["", *both], rows) + made_with(report)


def keys() -> str:
    """How often objects are there with other keys."""
    report = load("determinism")
    rows = []
    for preset, spread in report["keys"].items():
        for scores, row in {"all": spread, **spread["by_median_score"]}.items():
            shares = [share(row[name], row["objects"]) for name in PRESENCE]
            rows.append((preset, scores, row["objects"], *shares))
    names = ("above the cut with every key", "with nine of ten keys", "there at some score with every key")
    return table(["preset", "median score", "objects", *names], rows)


PRESENCE = ("above_cut_with_every_key", "above_cut_with_nine_of_ten_keys", "with_every_key_at_some_score")


def share(part: int, whole: int) -> str:
    """In percent."""
    return f"{100 * part / whole:.1f} %" if whole else ""


def moves() -> str:
    """How far boxes are from the median box of their object."""
    spreads = load("determinism")["keys"]
    first = next(iter(spreads.values()))["moves"]
    names = list(next(iter(first.values())))
    rows = [
        (preset, quantity, *values.values())
        for preset, spread in spreads.items()
        for quantity, values in spread["moves"].items()
    ]
    return table(["preset", "distance from the median box", *names], rows)


def soak() -> str:
    """The figures of the runs of the soak."""
    report = load("soak")
    first = "small synthetic sweeps" if report["circumstances"]["options"]["quick"] else "real sweeps"
    names = {"real": first, "varied": "any size", "tracked": "drives, tracked"}
    runs = {name: report[run] for run, name in names.items() if run in report}
    points = ["{:,} to {:,}".format(*sorted(run["points"].values())[::2]) for run in runs.values()]
    memory = [" ".join(f"{median:.0f}" for median in run["median_mb_of_tenths"]) for run in runs.values()]
    rows: list[tuple[Any, ...]] = [
        ("frames", *(f"{run['frames']:,}" for run in runs.values())),
        ("points of a frame", *points),
        ("recompiles", *(run["recompiles"] for run in runs.values())),
        (
            "growth of memory, kB per 1,000 frames",
            *(run["growth_kb_per_1000_frames"] for run in runs.values()),
        ),
        ("memory, tenths, MB", *memory),
        ("peak of memory, MB", *(run["peak_mb"] for run in runs.values())),
    ]
    for name in report["real"]["frame_ms"]:
        rows.append((f"a frame, {name}, ms", *(run["frame_ms"][name] for run in runs.values())))
    return table(["", *runs], rows) + made_with(report)


def soak_sizes() -> str:
    """Time of a frame by the capacity that its sweep was padded to."""
    report = load("soak")["varied"]
    rows = [(f"{int(c):,}", *values.values()) for c, values in report["frame_ms_by_capacity"].items()]
    return table(["capacity", *(f"{name}, ms" for name in report["frame_ms"])], rows)


def settings() -> str:
    """Every setting of the default preset: a table a stage."""
    config, parts = jaxbox.DetectorConfig(), []
    for field in dataclasses.fields(config):
        stage = getattr(config, field.name)
        rows = setting_rows(stage, field.name)
        parts += [f"## `{field.name}`", summary(type(stage)), table(SETTING_COLUMNS, rows)]
    return "\n\n".join(parts)


SETTING_COLUMNS = ("setting", "default", "range", "unit", "kind", "meaning")
UNITS = {"_m": "m", "_deg": "degrees", "_grade": "m/m"}
"""By the last part of a name."""


def summary(node: type) -> str:
    """The first paragraph of a docstring."""
    return " ".join((inspect.getdoc(node) or "").split("\n\n")[0].split())


def setting_rows(node: Any, prefix: str) -> list[tuple[str, ...]]:
    """Rows of a stage; the items of a list, such as the component maps, share theirs."""
    # Under each field stands a string, which only the source has.
    texts = dict(
        re.findall(
            r'^    (\w+): (?:(?!^    \w+:).)*?^    """(.*?)"""',
            inspect.getsource(type(node)),
            re.MULTILINE | re.DOTALL,
        )
    )
    rows: list[tuple[str, ...]] = []
    for field in dataclasses.fields(node):
        name, value = f"{prefix}.{field.name}", getattr(node, field.name)
        if isinstance(value, tuple):
            tables = [setting_rows(item, f"{name}.N") for item in value]
            rows += [
                (first, ", ".join(dict.fromkeys(row[1] for row in same)), *rest)
                for same in zip(*tables, strict=True)
                for first, _, *rest in same[:1]
            ]
            continue
        unit = next((unit for end, unit in UNITS.items() if field.name.endswith(end)), "")
        kind = "static" if field.metadata.get("static") else "traced"
        meaning = " ".join(texts[field.name].split()).removeprefix("static: ")
        rows.append((f"`{name}`", f"`{value}`", takes(name, field), unit, kind, meaning.replace("|", "\\|")))
    return rows


def takes(name: str, field: dataclasses.Field[Any]) -> str:
    """The numbers that a setting takes, by its dotted name; empty for other kinds of values."""
    of_numbers = {"float": False, "int": True, "int | None": True, "Scalar": False}
    kind = str(getattr(field.type, "__name__", field.type))
    if kind not in of_numbers and "Array" not in kind:
        return ""
    found = range_of(
        name.replace(".N.", "."),
        is_static=bool(field.metadata.get("static")),
        is_whole=of_numbers.get(kind, False),
    )
    return re.sub("a (finite|whole) number,? ?", "", found.text) or "any"


TABLES: dict[str, Callable[[], str]] = {
    "accuracy": accuracy,
    "ablation": ablation,
    "readings": readings,
    "classes": classes,
    "sizes": sizes,
    "paper": paper_table,
    "sensors": sensors,
    "cuts": cuts,
    "sensor_classes": sensor_classes,
    "ground": ground,
    "speed": speed,
    "gpu": gpu,
    "launches": launches,
    "launch_totals": launch_totals,
    "frontier": frontier,
    "peers": peers,
    "fuzz": fuzz,
    "faults": faults,
    "corruption": corruption,
    "steadiness": steadiness,
    "mutation": mutation,
    "coverage": coverage,
    "cluster": cluster,
    "archives": archives,
    "beams": beams,
    "beams_recall": beams_recall,
    "beams_synthetic": beams_synthetic,
    "mounting": mounting,
    "situations": situations,
    "status": status,
    "counts": counts,
    "track_status": track_status,
    "track_fields": track_fields,
    "track_settings": track_settings,
    "motion_states": motion_states,
    "tracking": tracking,
    "bad_input": bad_input,
    "refused": refused,
    "same_bits": same_bits,
    "keys": keys,
    "moves": moves,
    "soak": soak,
    "soak_sizes": soak_sizes,
    "settings": settings,
}
