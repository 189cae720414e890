"""What colours and lines mean: the legend of a page, as HTML."""

import html
from collections.abc import Sequence

import numpy as np

from jaxbox.tracking.trails import TRAIL_S
from jaxbox.viewer.motion import darker
from jaxbox.viewer.scene import COMPARED, GROUND_COLOR, OBSTACLE_COLOR, Scene, View, on_page
from jaxbox.viz.colors import (
    ESTIMATE,
    HIGH_M,
    HULL,
    IGNORED,
    LOW_M,
    TRUTH,
    UNASSIGNED,
    Color,
    color_by_height,
    color_by_id,
)
from jaxbox.viz.tracks import ARROW_S

_STOPS = 16
_MARK = "display: inline-block; width: 1.6em; margin-right: 0.6em; vertical-align: middle; flex-shrink: 0;"
_POINTS, _LINE = "height: 10px; border-radius: 2px;", "height: 3px;"
_IDS: Sequence[Color] = tuple(tuple(color) for color in color_by_id(np.arange(4)).tolist())


def describe_legend(scene: Scene, compared: Scene | None = None) -> str:
    """A line for every colour that the page shows now.

    Args:
      scene: what it shows.
      compared: what it compares with that.

    Returns:
      HTML.
    """
    view, drawn = scene.view, {name for name, lines in scene.lines.items() if len(lines.segments)}
    entries = [*_points(view), *_boxes(scene, compared)]
    if "hulls" in drawn:
        entries.append(_entry("hull of the points", [HULL], view, _LINE))
    if "labels" in drawn:
        entries.append(_entry("labelled vehicle", [TRUTH], view, _LINE))
    if "other_labels" in drawn:
        entries.append(_entry("other label", [IGNORED], view, _LINE))
    if "trails" in drawn:
        entries.append(_entry(f"trail: the last {TRAIL_S:g} s", _IDS, view, _LINE))
    if "arrows" in drawn:
        entries.append(_entry(f"arrow: in {ARROW_S:g} s", _IDS, view, _LINE))
    return (
        "<div data-jaxbox='legend' style='padding: 0.4em 0.75em 0.6em; font-size: 0.85em; "
        f"line-height: 1.6'>{''.join(entries)}</div>"
    )


def _points(view: View) -> list[str]:
    scale: list[Color] = [tuple(c) for c in color_by_height(np.linspace(LOW_M, HIGH_M, _STOPS)).tolist()]
    entries: dict[str, list[tuple[str, Sequence[Color]]]] = {
        "height": [(f"{LOW_M:g} to {HIGH_M:g} m above ground", scale)],
        "intensity": [("intensity, low to high", scale)],
        "cluster": [("a colour a cluster", _IDS), ("in no cluster", [UNASSIGNED])],
        "ground": [("ground", [GROUND_COLOR]), ("not ground", [OBSTACLE_COLOR])],
        "vehicle": [("a colour a vehicle", _IDS), ("on none", [UNASSIGNED])],
        "label": [
            ("on a labelled vehicle", [TRUTH]),
            ("on another label", [IGNORED]),
            ("on none", [UNASSIGNED]),
        ],
    }
    return [_entry(text, colors, view, _POINTS) for text, colors in entries[view.coloring]]


def _boxes(scene: Scene, compared: Scene | None) -> list[str]:
    view = scene.view
    if not view.boxes:
        return []
    by_id = view.tracks and "trails" in scene.lines
    text = "track" if by_id else "box"
    entries = [_entry(_named(text, scene.title), _IDS if by_id else [ESTIMATE], view, _LINE)]
    if by_id:
        hidden = [darker(color) for color in _IDS]
        entries.append(_entry("track that is hidden now", hidden, view, _LINE))
    if compared is not None:
        entries.append(_entry(_named(text, compared.title), [COMPARED], view, _LINE))
    return entries


def _named(text: str, title: str) -> str:
    return f"{text}: {title}" if title else text


def _entry(text: str, colors: Sequence[Color], view: View, shape: str) -> str:
    shades = [f"rgb({r}, {g}, {b})" for r, g, b in on_page(np.array(colors), view).tolist()]
    # Each colour by itself: between those of two ids there are none.
    stops = [
        f"{shade} {100 * (k + end) / len(shades):.1f}%" for k, shade in enumerate(shades) for end in (0, 1)
    ]
    paint = f"linear-gradient(to right, {', '.join(stops)})"
    return (
        "<div style='display: flex; align-items: center; overflow-wrap: anywhere'>"
        f"<span style='{_MARK} {shape} background: {paint}'></span><span>{html.escape(text)}</span></div>"
    )
