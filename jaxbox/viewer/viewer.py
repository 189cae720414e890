"""The loop that keeps a page in step with what its user asks for.

The page's events only record what is requested; one thread answers. While it detects, only the last request
is kept: a slider that is dragged shows as many results as there is time for, and none of them late.
"""

import contextlib
import dataclasses
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

from jaxbox._box_rows import AnyRows
from jaxbox.config import DetectorConfig
from jaxbox.config.fields import preset_config, replace_fields
from jaxbox.io import InputError
from jaxbox.viewer import words
from jaxbox.viewer.config_text import config_text
from jaxbox.viewer.drives import TrackedFrame, TrackMemory
from jaxbox.viewer.frames import Frame
from jaxbox.viewer.scene import Scene, View, build_scene
from jaxbox.viewer.session import Session, Shown

SWEEPS_PER_S = 10.0
"""Rate of playing to begin with: that of most sensors."""
TELL_S = 0.3
"""Work that takes longer than this tells how far it is, and again so often, s."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Wanted:
    """What the user asks for."""

    index: int = 0
    """Number of the sweep, from 0."""
    preset: str | None = "default"
    """Name of the settings to start from; None for `given`."""
    given: DetectorConfig | None = None
    """Settings of no preset, as from a file."""
    changes: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Thresholds that differ from them, by dotted name."""
    view: View = dataclasses.field(default_factory=View)
    """What is to be seen."""
    playing: bool = False
    """Whether the sweeps follow each other by themselves."""
    sweeps_per_s: float = SWEEPS_PER_S
    """How fast, at most."""

    @property
    def config(self) -> DetectorConfig:
        """The detector's settings.

        Raises:
          ValueError: for a change that does not fit.
        """
        base = self.given if self.preset is None else preset_config(self.preset)
        assert base is not None, "settings of no preset must be given"
        return replace_fields(base, self.changes)

    @property
    def title(self) -> str:
        """The settings in a few words: the preset, and whether thresholds differ from it."""
        return (self.preset or "given") + (", changed" if self.changes else "")

    @property
    def config_text(self) -> str:
        """The settings as TOML, see `jaxbox.viewer.config_text`."""
        return config_text(self.config, self.preset, min_score=self.view.min_score)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Side:
    """Sweeps, and who detects in them: those of a page, or those that it compares with them."""

    session: Session
    """The sweeps and the detector."""
    tracks: TrackMemory | None = None
    """Their tracks, where there can be any."""
    title: str = ""
    """What it is, where two are compared; empty for the name of the preset."""
    config: DetectorConfig | None = None
    """Settings that the page does not change; None for those of the page."""
    same_sweeps: bool = False
    """Whether its sweeps are those that it is compared with."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Answer:
    """What there is to show of one side."""

    shown: Shown
    tracked: TrackedFrame | None
    problems: list[str]


class KeepRows(Protocol):
    """Which boxes and tracks are shown."""

    def __call__(self, boxes: AnyRows, /) -> AnyRows:
        """The same rows, of which those that are not shown are no longer valid."""
        ...


def _keep_all(boxes: AnyRows, /) -> AnyRows:
    return boxes


class Page(Protocol):
    """What the loop needs of a page."""

    def show_scene(self, scene: Scene | None, compared: Scene | None = None) -> None:
        """Draws a scene, and one that is compared with it; or nothing."""

    def show_words(self, answer: str, *, status: str = "", points: str = "") -> None:
        """Shows texts, HTML."""

    def follow(self, wanted: Wanted) -> None:
        """Sets the controls that move without the user: the timeline, and the thresholds of a preset."""


class Viewer:
    """A session, a page, and what is wanted of them."""

    def __init__(
        self,
        session: Session,
        page: Page,
        wanted: Wanted | None = None,
        *,
        tracks: TrackMemory | None = None,
        title: str = "",
        compared: Side | None = None,
        keep: KeepRows | None = None,
    ) -> None:
        self._session, self._page = session, page
        self._side, self._compared = Side(session=session, tracks=tracks, title=title), compared
        self._keep: KeepRows = keep if keep is not None else _keep_all
        self._changed = threading.Condition()
        self._wanted = Wanted() if wanted is None else wanted
        self._answered: Wanted | None = None
        self._due_s = 0.0
        self._stopped = False

    @property
    def wanted(self) -> Wanted:
        """What is asked for now."""
        return self._wanted

    def want(self, **changes: Any) -> None:
        """Asks for something else; any thread may.

        Args:
          **changes: fields of `Wanted`.
        """
        with self._changed:
            self._wanted = dataclasses.replace(self._wanted, **changes)
            self._changed.notify()

    def want_threshold(self, name: str, value: float) -> None:
        """Asks for another threshold; any thread may.

        Args:
          name: dotted.
          value: of it.
        """
        with self._changed:
            self.want(changes={**self._wanted.changes, name: value})

    def want_view(self, **changes: Any) -> None:
        """Asks for another view; any thread may.

        Args:
          **changes: fields of `View`.
        """
        with self._changed:
            self.want(view=dataclasses.replace(self._wanted.view, **changes))

    def step(self, count: int) -> None:
        """Asks for the sweep that many further on, round the end; any thread may."""
        with self._changed:
            self.want(index=(self._wanted.index + count) % len(self._session))

    def stop(self) -> None:
        """Ends `run` after the answer that it is at; any thread may."""
        with self._changed:
            self._stopped = True
            self._changed.notify()

    def run(self) -> None:
        """Answers what is wanted, until `stop`."""
        while (wanted := self._next()) is not None:
            # The controls follow the last wish, not the one that is answered: they would jump back under
            # the hand that moves them.
            self._page.follow(self._wanted)
            self.answer(wanted)

    def answer(self, wanted: Wanted) -> None:
        """Shows one thing, or why it cannot be shown; no sweep ends the loop.

        Args:
          wanted: what to show.
        """
        try:
            self._show(wanted)
        except (InputError, ImportError, OSError, ValueError) as error:
            self._show_error(str(error), wanted)
        except Exception as error:
            # A fault of this program: the page says so and goes on, the traceback is for its authors.
            traceback.print_exc()
            self._show_error(f"unexpected {type(error).__name__}: {error}", wanted)

    def _next(self) -> Wanted | None:
        """Waits for a wish, or for the next sweep to be due; None at the end."""
        with self._changed:
            while not self._stopped and self._wanted == self._answered:
                left_s = self._due_s - time.monotonic() if self._wanted.playing else None
                if left_s is not None and left_s <= 0 and len(self._session) > 1:
                    self.step(1)
                    break
                self._changed.wait(left_s if left_s is None or left_s > 0 else None)
            moved = self._answered is None or self._wanted.index != self._answered.index
            if moved or not self._wanted.playing:
                self._due_s = time.monotonic() + 1 / self._wanted.sweeps_per_s
            self._answered = self._wanted
            return None if self._stopped else self._wanted

    def _show(self, wanted: Wanted) -> None:
        first = self._find(self._side, wanted)
        if first is None:
            return
        scene, second, other = self._scene(self._side, first, wanted), None, None
        if self._compared is not None:
            second = self._find(self._compared, wanted)
            if second is None:
                return
            other = self._scene(self._compared, second, wanted)
        self._page.show_scene(scene, other)
        min_score = wanted.view.min_score
        text = words.describe(first.shown, self._session, index=wanted.index, min_score=min_score)
        text += "" if first.tracked is None else words.describe_tracks(first.tracked, min_score=min_score)
        status = words.describe_status(first.shown, first.tracked, problems=first.problems)
        if second is not None and other is not None:
            is_same = second.shown.frame is first.shown.frame
            text += words.describe_compared(second.shown, other, scene, is_same_sweep=is_same)
            status += words.describe_status(
                second.shown, second.tracked, problems=second.problems, title=other.title
            )
        self._page.show_words(text, status=status, points=words.describe_points(first.shown))

    def _find(self, side: Side, wanted: Wanted) -> _Answer | None:
        """Detects and tracks what is missing; None where another wish came meanwhile."""
        config = wanted.config if side.config is None else side.config
        frame = self._frame(side, wanted.index)
        with contextlib.ExitStack() as stack:
            if not side.session.is_compiled(frame, config):
                stack.enter_context(self._compiling(side, frame, wanted))
            shown = side.session.detect(frame, config)
        shown = dataclasses.replace(shown, detections=self._keep(shown.detections))
        if not wanted.view.tracks or side.tracks is None:
            return _Answer(shown=shown, tracked=None, problems=[])
        if not self._track_up_to(side, side.tracks, shown, wanted):
            return None
        tracked, problems = side.tracks.find(wanted.index, config)
        if tracked is not None:
            tracked = dataclasses.replace(tracked, tracks=self._keep(tracked.tracks))
        return _Answer(shown=shown, tracked=tracked, problems=problems)

    def _frame(self, side: Side, index: int) -> Frame:
        session = self._session if side.same_sweeps else side.session
        if index >= len(session):
            raise InputError(f"{side.title} has {len(session)} sweeps, and none to compare with this one.")
        return session.frame(index)

    def _scene(self, side: Side, answer: _Answer, wanted: Wanted) -> Scene:
        is_second = side is self._compared
        view, frame = wanted.view, answer.shown.frame
        title = side.title or (wanted.title if self._compared is not None else "")
        if is_second and side.same_sweeps and not view.apart_m:
            # In the same place, points and labels would be drawn twice.
            view = dataclasses.replace(view, labels=False, points=False)
        return build_scene(
            frame, answer.shown.detections, view, answer.tracked, title=title, compared=is_second
        )

    def _track_up_to(self, side: Side, tracks: TrackMemory, shown: Shown, wanted: Wanted) -> bool:
        """Tracks what is missing up to the sweep; False where another wish came meanwhile."""
        done, total = tracks.progress(wanted.index, shown.config)
        # The first sweep of a drive looks for poses and compiles, and a jump takes many sweeps.
        is_long = done == 0 or total - done > 1

        def tell(seconds: float) -> None:
            text = f"tracking: {done} of {total} sweeps, {seconds:.0f} s; the timeline goes back without it"
            self._tell(side, text, shown.frame, wanted, points=words.describe_points(shown))

        if done < total and is_long and side is self._side:
            self._page.show_scene(build_scene(shown.frame, shown.detections, wanted.view))
        with telling(tell, at_once=is_long) if done < total else contextlib.nullcontext():
            while done < total:
                if self._is_superseded():
                    return False
                tracks.step(wanted.index, shown.config)
                done, _ = tracks.progress(wanted.index, shown.config)
        return True

    def _is_superseded(self) -> bool:
        return self._stopped or (self._answered is not None and self._wanted is not self._answered)

    @contextlib.contextmanager
    def _compiling(self, side: Side, frame: Frame, wanted: Wanted) -> Iterator[None]:
        """Says that it compiles, and for how long, until the block ends."""
        if side is self._side:
            self._page.show_scene(build_scene(frame, None, wanted.view))
        what = f"compiling for {frame.cloud.capacity:,} points, once; later runs load it from the cache"
        with telling(lambda seconds: self._tell(side, f"{what}: {seconds:.0f} s", frame, wanted)):
            yield

    def _tell(self, side: Side, text: str, frame: Frame, wanted: Wanted, *, points: str = "") -> None:
        text = f"{side.title}: {text}" if side is self._compared else text
        index, count = wanted.index, len(self._session)
        self._page.show_words(words.describe_work(text, index=index, count=count, frame=frame), points=points)

    def _show_error(self, message: str, wanted: Wanted) -> None:
        self._page.show_scene(None)
        text = words.describe_error(message, index=wanted.index, count=len(self._session))
        self._page.show_words(text)


@contextlib.contextmanager
def telling(tell: Callable[[float], None], *, at_once: bool = True) -> Iterator[None]:
    """Tells again and again, from another thread, for how long a block has been running.

    Args:
      tell: is called with seconds, every `TELL_S`.
      at_once: whether it is also called before the block runs.

    Yields:
      Nothing; `tell` is never called after the block.
    """
    start, is_over = time.monotonic(), threading.Event()

    def repeat() -> None:
        while not is_over.wait(TELL_S):
            tell(time.monotonic() - start)

    if at_once:
        tell(0.0)
    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
