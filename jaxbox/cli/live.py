"""``jaxbox live``: vehicles while the sensor runs, to a page, to Foxglove, to ROS, or as lines of JSON."""

import contextlib
import dataclasses
import time
import webbrowser
from collections.abc import Callable, Iterator
from typing import Any

from rich.live import Live
from rich.text import Text

from jaxbox import io
from jaxbox._interrupts import heard, stoppable
from jaxbox.cli.console import ExitCode, counted, exit_code, print_warning, printable, stderr, stdout
from jaxbox.cli.inputs import print_json
from jaxbox.cli.mounted import describe_mounting, seen_from_sensor
from jaxbox.cli.report import SHOWN_MIN_SCORE
from jaxbox.cli.view import initial_wish, warn_of_watchers
from jaxbox.geometry.mounting import Mounting
from jaxbox.io.results import SweepResult
from jaxbox.live import Latencies, LiveConfig, LiveResult, LiveRun, RecordedSource, Source
from jaxbox.live.foxglove import open_foxglove
from jaxbox.live.mounted import MountedSource
from jaxbox.live.page import open_page
from jaxbox.live.records import LiveRecords
from jaxbox.live.ros2 import open_ros2
from jaxbox.live.sinks import Sink
from jaxbox.live.sources import is_sensor, open_sensor

STATUS_S = 0.25
"""How often the status line is drawn, s."""
LINE_S = 10.0
"""How often there is a line where stderr is not a terminal, s."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """The options of ``jaxbox live``; the command's help explains them."""

    config: LiveConfig
    """Settings of detector, poses and tracker."""
    topic: str | None
    """Topic of the points in recordings."""
    convention: io.PointConvention
    """How the numbers of the points are to be taken."""
    rate_hz: float
    """Sweeps a second of recordings without times."""
    loop: bool
    """Whether a recording begins again where it ends."""
    sensor_at: tuple[float, float, float] | None
    """Where the sensor is in the frame of the points, m; None for the origin."""
    level: bool
    """Whether its tilt is measured, and the sweeps are seen upright."""
    capacity: int | None
    """Points a sweep is padded to; None for what holds the first one."""
    timeout_s: float
    """A silence of so long is reported, s."""
    min_score: float
    """Boxes that score less are left out."""
    confirmed: bool
    """Whether tracks that are not confirmed are left out."""
    host: str
    """Address that servers listen at."""
    foxglove_port: int | None
    """Port of the server for Foxglove; None for no server."""
    page_port: int | None
    """Port of the viewer's page; None for no page."""
    open_browser: bool
    """Whether the browser is opened at the page."""
    points: bool
    """Whether the points are served, too."""
    ros2: bool
    """Whether boxes are published in ROS 2."""
    quiet: bool
    """Whether only errors are printed."""
    json: bool
    """Whether stdout is JSON Lines."""


@dataclasses.dataclass
class LiveAccount:
    """What a run has done so far, in a room of fixed size."""

    num_done: int = 0
    """Sweeps that went through."""
    num_skipped: int = 0
    """Sweeps that nobody looked at."""
    num_faults: int = 0
    """What came and was no sweep."""
    num_boxes: int = 0
    """Of the last sweep."""
    name: str = ""
    """Of the last sweep."""
    latencies: Latencies = dataclasses.field(default_factory=Latencies)
    """Of the last sweeps."""
    start_s: float = dataclasses.field(default_factory=time.monotonic)
    """When it began; of the first sweep once there is one."""

    def add(self, result: LiveResult, written: SweepResult) -> None:
        """Counts a sweep."""
        if not self.num_done:
            self.start_s = time.monotonic()
        self.num_done += 1
        self.num_skipped, self.num_faults = result.num_skipped, result.num_faults
        self.num_boxes, self.name = len(written.record["boxes"]), result.sweep.name
        self.latencies.add(result.latency_s)

    def to_json(self) -> dict[str, Any]:
        """The figures of a run, as JSON can hold them."""
        median, high = self.latencies.quantiles_ms() if self.num_done else (None, None)
        counts = {"done": self.num_done, "skipped": self.num_skipped, "faults": self.num_faults}
        return counts | {"latency_p50_ms": median, "latency_p99_ms": high, "latency_of": len(self.latencies)}

    def describe(self) -> str:
        """The status line."""
        return f"sweep {self.name}: {counted(self.num_boxes, 'vehicle')}; {self.describe_run()}"

    def describe_run(self) -> str:
        """Its second half, of all sweeps."""
        if not self.num_done:
            return f"no sweep went through; {self.num_skipped} skipped, {counted(self.num_faults, 'fault')}"
        median, high = self.latencies.quantiles_ms()
        rate = (self.num_done - 1) / max(time.monotonic() - self.start_s, 1e-9)
        faults = f", {counted(self.num_faults, 'fault')}" if self.num_faults else ""
        return (
            f"{counted(self.num_done, 'sweep')}, {self.num_skipped} skipped{faults}, {rate:.1f}/s; latency "
            f"p50 {median:.0f} ms, p99 {high:.0f} ms (the last {len(self.latencies)})"
        )


def run_live(source: str, options: LiveOptions) -> ExitCode:
    """Detects until the source ends or it is interrupted (Ctrl-C or SIGTERM).

    Args:
      source: as `jaxbox.live.open_source` takes it.
      options: the command's options.

    Returns:
      `ExitCode.INTERRUPTED`, or `FRAME_FAILED` where something came that was no sweep.

    Raises:
      InputError: where the source or an address cannot be opened, or a recording breaks off.
      ImportError: without an extra that is needed.
    """
    opened = _open(source, options)
    if not options.quiet:
        _warn_of_others(opened, options)
    run = LiveRun(
        opened,
        options.config,
        capacity=options.capacity,
        timeout_s=options.timeout_s,
        report=(lambda _: None) if options.quiet else _tell,
    )
    account = LiveAccount()
    records = LiveRecords(source, min_score=options.min_score, confirmed=options.confirmed)
    interrupted = False
    with contextlib.ExitStack() as stack:
        sinks = list(_open_sinks(stack, run, options))
        show = stack.enter_context(_status_line(shown=not options.quiet))
        results = stack.enter_context(contextlib.closing(iter(run)))
        try:
            with stoppable():
                for result in results:
                    written = records.result(result)
                    for sink in sinks:
                        sink(result, written)
                    account.add(result, written)
                    show(account)
        except KeyboardInterrupt:
            heard()
            interrupted = True
    account.num_skipped, account.num_faults = run.num_skipped, run.num_faults
    _summarise(account, options, interrupted=interrupted)
    return exit_code(failed=run.num_faults > 0, interrupted=interrupted)


def _warn_of_others(source: Source, options: LiveOptions) -> None:
    """Says who else can send, and who can see."""
    if source.is_open:
        print_warning(f"whoever reaches {source.name} can send points; ?from=ADDRESS names the sensor.")
    if (options.foxglove_port, options.page_port) != (None, None):
        warn_of_watchers(options.host)


def _tell(sentence: str) -> None:
    stderr().print(sentence, markup=False)


def _open(source: str, options: LiveOptions) -> Source:
    """The source, seen upright from its sensor where that is asked for."""

    def tell(mounting: Mounting) -> None:
        if options.level and not options.quiet:
            _tell(describe_mounting(mounting))

    position = options.sensor_at or (0.0, 0.0, 0.0)
    if is_sensor(source):
        sensor = open_sensor(source)
        return MountedSource(
            sensor, position=position, level=options.level, convention=options.convention, report=tell
        )
    sweeps, mounting = seen_from_sensor(
        io.open_sweeps(source, topic=options.topic, convention=options.convention),
        sensor_at=options.sensor_at,
        level=options.level,
    )
    if mounting is not None:
        tell(mounting)
    return RecordedSource(sweeps, name=source, rate_hz=options.rate_hz, loop=options.loop)


def _open_sinks(stack: contextlib.ExitStack, run: LiveRun, options: LiveOptions) -> Iterator[Sink]:
    if options.json:
        yield lambda _, written: print_json(written.record)
    if options.foxglove_port is not None:
        sink, url = stack.enter_context(
            open_foxglove(host=options.host, port=options.foxglove_port, points=options.points)
        )
        if not options.quiet:
            _tell(f"Foxglove: open a connection to {url}")
        yield sink
    if options.ros2:
        yield stack.enter_context(open_ros2())
    if options.page_port is not None:
        yield _open_page(stack, run, options, options.page_port)


def _open_page(stack: contextlib.ExitStack, run: LiveRun, options: LiveOptions, port: int) -> Sink:
    is_tracked = options.config.tracker is not None
    min_score = max(options.min_score, SHOWN_MIN_SCORE)
    wanted = initial_wish(options.config.detector, min_score=min_score, track=is_tracked)
    sink, url = stack.enter_context(open_page(wanted, run.use, host=options.host, port=port))
    if not options.quiet:
        _tell(f"the page: {url}")
    if options.open_browser:
        webbrowser.open(url)
    return sink


@contextlib.contextmanager
def _status_line(*, shown: bool) -> Iterator[Callable[[LiveAccount], None]]:
    """A line that stays in its place on a terminal, and elsewhere a line once in a while."""
    console = stderr()
    if not shown:
        yield lambda account: None
    elif console.is_terminal:
        with Live(console=console, refresh_per_second=1 / STATUS_S, transient=True) as line:
            yield lambda account: line.update(Text(printable(account.describe())))
    else:
        due_s = time.monotonic() + LINE_S

        def show(account: LiveAccount) -> None:
            nonlocal due_s
            if time.monotonic() >= due_s:
                due_s = time.monotonic() + LINE_S
                console.print(account.describe(), markup=False)

        yield show


def _summarise(account: LiveAccount, options: LiveOptions, *, interrupted: bool) -> None:
    """The end of the run, in a sentence or as the last line of JSON."""
    if options.json:
        print_json({"summary": account.to_json() | {"interrupted": interrupted}})
    elif not options.quiet:
        stdout().print(account.describe_run(), markup=False)
