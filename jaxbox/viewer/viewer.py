"""The loop that keeps a page in step with what its user asks for.

The page's events only record what is requested; one thread answers. While it detects, only the last request
is kept: a slider that is dragged shows as many results as there is time for, and none of them late.
"""

import dataclasses
import threading
import time
import traceback
from collections.abc import Mapping
from typing import Any, Protocol

from jaxbox.config import DetectorConfig
from jaxbox.config.fields import preset_config, replace_fields
from jaxbox.io import InputError
from jaxbox.viewer import words
from jaxbox.viewer.config_text import config_text
from jaxbox.viewer.drives import TrackMemory
from jaxbox.viewer.frames import Frame
from jaxbox.viewer.scene import Scene, View, build_scene
from jaxbox.viewer.session import Session, Shown

SWEEPS_PER_S = 10.0
"""Rate of playing to begin with: that of most sensors."""
TELL_S = 0.3
"""Tracking that takes longer than this tells how far it is, s."""


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
    def config_text(self) -> str:
        """The settings as TOML, see `jaxbox.viewer.config_text`."""
        return config_text(self.config, self.preset, min_score=self.view.min_score)


class Page(Protocol):
    """What the loop needs of a page."""

    def show_scene(self, scene: Scene | None) -> None:
        """Draws a scene, or nothing."""

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
    ) -> None:
        self._session, self._page, self._tracks = session, page, tracks
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
        frame = self._session.frame(wanted.index)
        config = wanted.config
        if not self._session.is_compiled(frame, config):
            self._show_compiling(frame, wanted)
        shown = self._session.detect(frame, config)
        tracked, problems = None, []
        if wanted.view.tracks and self._tracks is not None:
            if not self._track_up_to(self._tracks, shown, wanted):
                return
            tracked, problems = self._tracks.find(wanted.index, config)
        self._page.show_scene(build_scene(frame, shown.detections, wanted.view, tracked))
        min_score = wanted.view.min_score
        answer = words.describe(shown, self._session, index=wanted.index, min_score=min_score)
        self._page.show_words(
            answer + ("" if tracked is None else words.describe_tracks(tracked, min_score=min_score)),
            status=words.describe_status(shown, tracked, problems=problems),
            points=words.describe_points(shown),
        )

    def _track_up_to(self, tracks: TrackMemory, shown: Shown, wanted: Wanted) -> bool:
        """Tracks what is missing up to the sweep; False where another wish came meanwhile."""
        done, total = tracks.progress(wanted.index, shown.config)
        # The first sweep of a drive looks for poses and compiles, and a jump takes many sweeps.
        told_s = 0.0 if done == 0 or total - done > 1 else time.monotonic()
        while done < total:
            if self._is_superseded():
                return False
            if time.monotonic() - told_s > TELL_S:
                self._show_tracking(done, total, shown, wanted)
                told_s = time.monotonic()
            tracks.step(wanted.index, shown.config)
            done, _ = tracks.progress(wanted.index, shown.config)
        return True

    def _is_superseded(self) -> bool:
        return self._stopped or (self._answered is not None and self._wanted is not self._answered)

    def _show_tracking(self, done: int, total: int, shown: Shown, wanted: Wanted) -> None:
        self._page.show_scene(build_scene(shown.frame, shown.detections, wanted.view))
        text = f"tracking: {done} of {total} sweeps, once; the timeline goes back without it"
        count = len(self._session)
        self._page.show_words(
            words.describe_work(text, index=wanted.index, count=count, frame=shown.frame),
            points=words.describe_points(shown),
        )

    def _show_compiling(self, frame: Frame, wanted: Wanted) -> None:
        self._page.show_scene(build_scene(frame, None, wanted.view))
        text = f"compiling for {frame.cloud.capacity:,} points, once; later runs load it from the cache"
        words_so_far = words.describe_work(text, index=wanted.index, count=len(self._session), frame=frame)
        self._page.show_words(words_so_far)

    def _show_error(self, message: str, wanted: Wanted) -> None:
        self._page.show_scene(None)
        text = words.describe_error(message, index=wanted.index, count=len(self._session))
        self._page.show_words(text)
