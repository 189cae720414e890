"""What the page says, as HTML. Names come from files and may hold anything, so every word is escaped."""

import base64
import datetime
import html
from collections.abc import Sequence

import cv2
import numpy as np

from jaxbox.config.class_priors import classes_in_words
from jaxbox.types import Detections, Motion, Status
from jaxbox.viewer.drives import TrackedFrame
from jaxbox.viewer.frames import Frame
from jaxbox.viewer.scene import Scene
from jaxbox.viewer.session import Session, Shown
from jaxbox.viz.boxes import find_matches
from jaxbox.viz.tracks import shown_rows

_COUNTS = (
    ("ground_points", "ground"),
    ("clustered_points", "clustered"),
    ("unclustered_points", "in no cluster"),
    ("overhead_points", "overhead"),
    ("out_of_range_points", "out of range"),
    ("outlier_points", "outliers"),
    ("nonfinite_points", "not finite"),
    ("dropped_points", "beyond the capacity"),
    ("dropped_obstacles", "beyond max_obstacles"),
)
_STYLE = "padding: 0.3em 0.75em; font-size: 0.9em; line-height: 1.45; overflow-wrap: anywhere;"
_JPEG_QUALITY = 85
# Each on a light page, and on a dark one.
_QUIET, _WARNING, _ERROR = (
    f"light-dark({light}, {dark})"
    for light, dark in (("#5b6470", "#98a1ad"), ("#8a5200", "#ffbe28"), ("#c22727", "#ff7b7b"))
)


def describe(shown: Shown, session: Session, *, index: int, min_score: float) -> str:
    """The sweep, the vehicles, the times and the compiles.

    Args:
      shown: what is on the page.
      session: that made it.
      index: number of the sweep, from 0.
      min_score: boxes that score less are hidden.

    Returns:
      HTML.
    """
    frame = shown.frame
    keep = _keep(shown.detections, min_score)
    total = int(np.asarray(shown.detections.valid).sum())
    noun = "vehicle" if keep.sum() == 1 else "vehicles"
    return _block(
        [
            _heading(frame, index, len(session)),
            f"<b><span data-jaxbox='vehicles'>{int(keep.sum())}</span> {noun}</b>: "
            f"{classes_in_words(np.asarray(shown.detections.label)[keep]) or 'none'}",
            _quiet(f"{total} boxes of any score in the answer"),
            *_times(shown, session),
        ]
    )


def _times(shown: Shown, session: Session) -> list[str]:
    frame = shown.frame
    taken = f"<b><span data-jaxbox='milliseconds'>{shown.detect_s * 1e3:.1f}</span> ms</b>"
    if not session.detects:
        return [f"{taken} from the end of the sweep to its boxes, {frame.num_points:,} points"]
    times = "time" if session.num_compiles == 1 else "times"
    return [
        f"{taken} to detect, {frame.read_s * 1e3:.0f} ms to read {frame.num_points:,} points",
        _quiet(
            f"compiled <span data-jaxbox='compiles'>{session.num_compiles}</span> {times}, "
            f"{session.compile_s:.1f} s in all"
        ),
    ]


def describe_compared(shown: Shown, scene: Scene, first: Scene, *, is_same_sweep: bool) -> str:
    """What is compared: its vehicles and time; of the same sweep, how many boxes both have.

    Args:
      shown: the answer that is compared.
      scene: of it.
      first: the scene that it is compared with.
      is_same_sweep: whether both are of one sweep.

    Returns:
      HTML.
    """
    noun = "vehicle" if scene.num_boxes == 1 else "vehicles"
    name = "" if is_same_sweep else _quiet(html.escape(shown.frame.name))
    lines = [
        f"compared: <b>{html.escape(scene.title)}</b> {name}",
        f"<b><span data-jaxbox='compared-vehicles'>{scene.num_boxes}</span> {noun}</b>, "
        f"{shown.detect_s * 1e3:.1f} ms to detect",
    ]
    if is_same_sweep:
        both = int(find_matches(first.boxes, scene.boxes)[0].sum())
        lines.append(
            f"<span data-jaxbox='both'>{both}</span> in both, {first.num_boxes - both} only in "
            f"{html.escape(first.title)}, {scene.num_boxes - both} only in {html.escape(scene.title)}"
        )
    return _block(lines, name="compared")


def describe_tracks(tracked: TrackedFrame, *, min_score: float) -> str:
    """How many vehicles are followed, and what they do.

    Args:
      tracked: the tracks of the sweep.
      min_score: tracks that score less are hidden.

    Returns:
      HTML.
    """
    rows = shown_rows(tracked.tracks, min_score=min_score)
    counts = np.bincount(tracked.tracks.motion[rows], minlength=len(Motion)).tolist()
    states = [f"{count} {state.word}" for state, count in zip(Motion, counts, strict=True) if count]
    noun, does = "track" if len(rows) == 1 else "tracks", ", ".join(states) or "none"
    return _block(
        [
            f"<b><span data-jaxbox='tracks'>{len(rows)}</span> {noun}</b>: {does}",
            _quiet(f"poses: {html.escape(str(tracked.pose_source))}"),
        ],
        name="tracking",
    )


def describe_status(
    shown: Shown, tracked: TrackedFrame | None = None, *, problems: Sequence[str] = (), title: str = ""
) -> str:
    """What was dropped, and what could not be read besides the points.

    Args:
      shown: what is on the page.
      tracked: its tracks, where they are wanted.
      problems: of the tracking, in words.
      title: of what is compared; empty for the page's own.

    Returns:
      HTML: a sentence each, or one that says that there is nothing.
    """
    sentences = [*Status(int(shown.detections.status)).describe(), *shown.frame.problems]
    sentences += [*([] if tracked is None else tracked.status.describe()), *problems]
    start = f"{title}: " if title else ""
    if not sentences:
        return _block([_quiet(html.escape(f"{start}nothing was dropped"))], name="status")
    return _block([_colored(html.escape(start + text), _WARNING) for text in sentences], name="status")


def describe_points(shown: Shown) -> str:
    """Where every point of the sweep went.

    Args:
      shown: what is on the page.

    Returns:
      HTML: a table.
    """
    total = max(shown.frame.num_points, 1)
    counts = [(word, int(getattr(shown.detections.counts, name))) for name, word in _COUNTS]
    rows = "".join(
        f"<tr><td>{word}</td><td style='text-align: right; padding-left: 1em'>{count:,}</td>"
        f"<td style='text-align: right; padding-left: 1em'>{count / total:.1%}</td></tr>"
        for word, count in counts
        if count
    )
    return _block([f"<table>{rows}</table>"], name="points")


def describe_work(text: str, *, index: int, count: int, frame: Frame | None = None) -> str:
    """What is being done, while there is no answer.

    Args:
      text: what, in words.
      index: number of the sweep, from 0.
      count: how many there are.
      frame: the sweep, where it is read already.

    Returns:
      HTML.
    """
    heading = _quiet(f"{index + 1} of {count}") if frame is None else _heading(frame, index, count)
    return _block([heading, html.escape(text)])


def describe_error(message: str, *, index: int, count: int) -> str:
    """An error in place of an answer.

    Args:
      message: what went wrong, and the fix.
      index: number of the sweep, from 0.
      count: how many there are.

    Returns:
      HTML.
    """
    return _block([_quiet(f"{index + 1} of {count}"), _colored(html.escape(message), _ERROR)], name="error")


def copy_box(text: str) -> str:
    """A text that can be read, and a button that puts it on the clipboard.

    Args:
      text: any.

    Returns:
      HTML. Where the browser refuses the clipboard to the page, as it does without encryption from another
      machine, the text is selected, and the browser's own command copies it.
    """
    copy = (
        "const text = this.parentElement.querySelector('textarea'); text.select();"
        "(navigator.clipboard ? navigator.clipboard.writeText(text.value)"
        " : Promise.resolve(document.execCommand('copy')))"
        ".then(() => { this.textContent = 'copied'; },"
        " () => { this.textContent = 'selected: copy it with Ctrl+C'; });"
    )
    lines = min(max(text.count("\n") + 1, 4), 24)
    return (
        f"<div><textarea data-jaxbox='settings' readonly rows='{lines}' spellcheck='false' "
        "style='width: 100%; font-family: monospace; font-size: 0.85em'>"
        f"{html.escape(text)}</textarea>"
        f'<button style="padding: 0.3em 1em; cursor: pointer" onclick="{copy}">copy</button></div>'
    )


def picture(image: np.ndarray) -> str:
    """A camera's image within the text itself.

    Viser's own element for images fetches each from the browser's memory, and complains of those that are
    replaced before they have been fetched, as in playing they are.

    Args:
      image: (h, w, 3) uint8, RGB.

    Returns:
      HTML.
    """
    _, encoded = cv2.imencode(".jpg", image[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))
    data = base64.b64encode(encoded.tobytes()).decode()
    # Decoded synchronously, or the panel would be empty for a moment between two images.
    return f"<img alt='camera' decoding='sync' style='width: 100%' src='data:image/jpeg;base64,{data}'>"


def _block(lines: Sequence[str], *, name: str = "answer") -> str:
    body = "".join(f"<div>{line}</div>" for line in lines)
    return f"<div data-jaxbox='{name}' style='{_STYLE}'>{body}</div>"


def _colored(text: str, color: str) -> str:
    return f"<span style='color: {color}'>{text}</span>"


def _quiet(text: str) -> str:
    return _colored(text, _QUIET)


def _heading(frame: Frame, index: int, count: int) -> str:
    place = f"{index + 1} of {count}"
    if frame.timestamp_ns is not None:
        seconds, nanoseconds = divmod(frame.timestamp_ns, 10**9)
        moment = datetime.datetime.fromtimestamp(seconds, tz=datetime.UTC)
        place += f", {moment:%Y-%m-%d %H:%M:%S}.{nanoseconds // 10**6:03d} UTC"
    return f"<b data-jaxbox='name'>{html.escape(frame.name)}</b> {_quiet(place)}"


def _keep(detections: Detections, min_score: float) -> np.ndarray:
    return np.asarray(detections.valid) & (np.asarray(detections.score, np.float64) >= min_score)
