"""The boxes of a scene as a table: a row each, nearest first, and where the camera goes to see one."""

import dataclasses
import html
from collections.abc import Sequence

import numpy as np

from jaxbox.viewer.scene import Scene

_BEHIND, _ABOVE, _LEAST_M = 2.2, 1.2, 8.0
"""The camera stands so many lengths behind and above a box, and at least this far."""
_NUMBER = "text-align: right; white-space: nowrap"
_FLY = (
    "const name = this.dataset.box; Array.from(document.querySelectorAll('button'))"
    ".filter(button => button.textContent === name)[0].click()"
)
"""A click on a row presses the page's own button of that number."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BoxRow:
    """One box."""

    text: str
    """Class and score, or id and state of the track."""
    center: tuple[float, float, float]
    """m, as it is drawn."""
    size: tuple[float, float, float]
    """m: length, width, height."""
    distance_m: float
    """From its sensor, in the bird's-eye view."""
    title: str = ""
    """Of its scene, where another is compared with it."""

    def look(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Where the camera is, and what it looks at, m: from the side of the sensor's back, at the box.

        >>> BoxRow(text="", center=(20.0, 0.0, -1.0), size=(4.0, 2.0, 1.5), distance_m=20.0).look()[0]
        (11.2, 0.0, 3.8)
        """
        x, y, z = self.center
        reach = max(*self.size, _LEAST_M / _BEHIND)
        return (x - _BEHIND * reach, y, z + _ABOVE * reach), self.center


def box_rows(scenes: Sequence[Scene], *, apart_m: float = 0.0) -> list[BoxRow]:
    """The boxes of scenes that are compared, scene by scene.

    Args:
      scenes: one or two.
      apart_m: how far to the right of the first the second is drawn, m.

    Returns:
      Rows, those of each scene nearest first.
    """
    rows = []
    for place, scene in enumerate(scenes):
        distance = np.hypot(scene.boxes.center[:, 0], scene.boxes.center[:, 1])
        for row in np.argsort(distance, kind="stable").tolist():
            x, y, z = scene.boxes.center[row].tolist()
            length, width, height = scene.boxes.size[row].tolist()
            rows.append(
                BoxRow(
                    text=scene.boxes.captions[row],
                    center=(x, y - place * apart_m, z),
                    size=(length, width, height),
                    distance_m=float(distance[row]),
                    title=scene.title,
                )
            )
    return rows


def describe_boxes(rows: Sequence[BoxRow]) -> str:
    """The table.

    Args:
      rows: of `box_rows`; the number of a row, from 1, is that of the button that flies to it.

    Returns:
      HTML.
    """
    if not rows:
        return "<div data-jaxbox='boxes' style='padding: 0.3em 0.75em'>no box of the shown score</div>"
    head = _cells(("", "box", "range (m)", "size (m)"))
    return (
        "<style>[data-box]:hover { background: rgba(128, 128, 128, 0.25); }</style>"
        "<div style='padding: 0 0.75em'><table data-jaxbox='boxes' style='width: 100%; font-size: 0.85em; "
        "border-collapse: collapse; font-variant-numeric: tabular-nums'>"
        f"<tr style='font-weight: 600'>{head}</tr>{''.join(_lines(rows))}</table></div>"
    )


def _lines(rows: Sequence[BoxRow]) -> list[str]:
    lines, title = [], ""
    for number, row in enumerate(rows, 1):
        if row.title != title:
            title = row.title
            lines.append(f"<tr><td colspan='4' style='padding: 0.4em'><b>{html.escape(title)}</b></td></tr>")
        size = " × ".join(f"{metres:.1f}" for metres in row.size)
        cells = _cells((str(number), html.escape(row.text), f"{row.distance_m:.1f}", size))
        lines.append(f'<tr data-box="{number}" style="cursor: pointer" onclick="{_FLY}">{cells}</tr>')
    return lines


def _cells(texts: Sequence[str]) -> str:
    return "".join(
        f"<td style='{style}; padding: 0.2em 0.4em'>{text}</td>"
        for style, text in zip((_NUMBER, "text-align: left", _NUMBER, _NUMBER), texts, strict=True)
    )
