"""Which boxes a command writes and draws, by class, score and place; nothing compiles."""

import dataclasses
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import typer

from jaxbox._box_rows import MIN_CORNERS, AnyRows, in_polygon, reaches
from jaxbox._files import InputError, finite_number, read_text
from jaxbox.types import Detections, Label

ClassesOption = Annotated[
    str | None,
    typer.Option(
        metavar="CLASS,...", help=f"Only boxes of these: {', '.join(label.word for label in Label)}."
    ),
]
WithinOption = Annotated[
    str | None,
    typer.Option(
        metavar="AREA",
        help="Only boxes whose centre lies in an area round the sensor, m: a radius, as 30; "
        "X_MIN,X_MAX,Y_MIN,Y_MAX, as -10,60,-20,20; or a text file of a polygon, x y a line.",
    ),
]
MIN_SCORE_METAVAR = "SCORE|CLASS=SCORE,..."
_RECTANGLE = 4


@dataclasses.dataclass(frozen=True)
class BoxFilter:
    """Which boxes are kept.

    >>> BoxFilter.chosen(classes="cars", within="30", min_scores={"van": 0.2}).recorded()
    {'classes': ['car'], 'within': 30.0, 'min_scores': {'van': 0.2}}
    """

    classes: tuple[str, ...] | None = None
    """`Label.word` of each class; None is all."""
    within: float | tuple[tuple[float, ...], ...] | None = None
    """Radius from the sensor, m, or the corners of a polygon, m, sensor frame; None is everywhere."""
    min_scores: tuple[tuple[str, float], ...] = ()
    """`Label.word` and least score of some classes."""

    @classmethod
    def chosen(
        cls, *, classes: str | None, within: str | None, min_scores: Mapping[str, float] | None = None
    ) -> "BoxFilter":
        """The filter of options of the command line.

        Args:
          classes: as `ClassesOption`.
          within: as `WithinOption`.
          min_scores: by class, from `parse_min_score`.

        Raises:
          InputError: naming the option.
        """
        return cls(
            None if classes is None else _parse_classes(classes),
            None if within is None else _parse_area(within),
            tuple((min_scores or {}).items()),
        )

    def recorded(self) -> dict[str, Any]:
        """The filter as JSON can hold it, for the account of the run."""
        area = self.within if not isinstance(self.within, tuple) else [list(corner) for corner in self.within]
        classes = None if self.classes is None else list(self.classes)
        return {"classes": classes, "within": area, "min_scores": dict(self.min_scores) or None}

    def __call__(self, boxes: AnyRows) -> AnyRows:
        """The boxes with the others no longer valid: shapes and rows stay. Points left out belong to none.

        Args:
          boxes: of one sweep, on the host.
        """
        keep = np.array(boxes.valid)
        center = np.asarray(boxes.center, np.float64)
        if self.classes is not None:
            keep &= np.isin(boxes.label, [label.value for label in Label if label.word in self.classes])
        keep &= reaches(boxes.score, boxes.label, dict(self.min_scores))
        if isinstance(self.within, tuple):
            keep &= in_polygon(center, self.within)
        elif self.within is not None:
            keep &= np.hypot(center[:, 0], center[:, 1]) <= self.within
        changes: dict[str, Any] = {"valid": keep}
        if isinstance(boxes, Detections):
            # The last place is that of -1, for points of no box.
            row, stays = np.asarray(boxes.point_detection), np.append(keep, False)
            changes["point_detection"] = np.where(stays[row], row, -1)
        return dataclasses.replace(boxes, **changes)  # pyright: ignore[reportArgumentType]


EVERY_BOX = BoxFilter()
"""All are kept."""


def parse_min_score(text: str) -> tuple[float, dict[str, float]]:
    """Reads ``--min-score``: one score, or scores of classes, and one at most of the others.

    Args:
      text: such as "0.15", "car=0.15,van=0.2" or "0.1,van=0.2".

    Returns:
      The least score of any class, and of each class where they differ.

    Raises:
      InputError: for an unknown class, a score that is none, or a class that stands twice.

    >>> parse_min_score("0.15")
    (0.15, {})
    >>> parse_min_score("0.15,van=0.2")
    (0.15, {'car': 0.15, 'van': 0.2, 'truck': 0.15})
    """
    scores: dict[Label | None, float] = {}
    for part in text.split(","):
        name, of_class, number = part.rpartition("=")
        label = Label.named(name.strip()) if of_class else None
        if of_class and label is None:
            raise InputError(f"--min-score {text}: {name.strip()!r} is no class; choose from {_words()}.")
        score = _parse_score(number, text)
        if label in scores:
            raise InputError(f"--min-score {text}: {part.strip()!r} says again what stands before it.")
        scores[label] = score
    by_class = {label.word: scores.get(label, scores.get(None, 0.0)) for label in Label}
    return min(by_class.values()), by_class if set(scores) != {None} else {}


def _parse_score(number: str, text: str) -> float:
    try:
        score = float(number)
    except ValueError:
        score = math.nan
    if not 0 <= score <= 1:
        raise InputError(
            f"--min-score {text}: {number.strip()!r} is no score from 0 to 1; give one, or CLASS=SCORE,..."
        )
    return score


def _words() -> str:
    return ", ".join(label.word for label in Label)


def _parse_classes(text: str) -> tuple[str, ...]:
    labels = {word.strip(): Label.named(word.strip()) for word in text.lower().split(",")}
    if unknown := [word for word, label in labels.items() if label is None]:
        raise InputError(f"--classes {text}: {unknown[0]!r} is none; choose from {_words()}.")
    return tuple(label.word for label in Label if label in labels.values())


def _parse_area(text: str) -> float | tuple[tuple[float, ...], ...]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        return _read_polygon(text)
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"--within {text}: give finite numbers, in metres.")
    if len(numbers) == 1 and numbers[0] > 0:
        return numbers[0]
    if len(numbers) == _RECTANGLE and numbers[0] < numbers[1] and numbers[2] < numbers[3]:
        x_min, x_max, y_min, y_max = numbers
        return ((x_max, y_max), (x_min, y_max), (x_min, y_min), (x_max, y_min))
    raise InputError(
        f"--within {text}: give a radius above 0, or X_MIN,X_MAX,Y_MIN,Y_MAX with each least before its "
        "greatest, in metres."
    )


def _read_polygon(text: str) -> tuple[tuple[float, ...], ...]:
    if not pathlib.Path(text).is_file():
        raise InputError(
            f"--within {text}: neither numbers nor a file; give a radius, X_MIN,X_MAX,Y_MIN,Y_MAX, or a text "
            "file with a corner a line, x y."
        )
    rows = enumerate(read_text(text).replace(",", " ").splitlines(), start=1)
    corners = [_parse_corner(line.split(), f"{text}, line {row}") for row, line in rows if line.strip()]
    if len(corners) < MIN_CORNERS:
        raise InputError(f"{text}: {len(corners)} corners; a polygon has at least three, x y a line.")
    return tuple(corners)


def _parse_corner(words: Sequence[str], where: str) -> tuple[float, float]:
    if len(words) != 2:
        raise InputError(f"{where}: {len(words)} numbers; a corner is x y, in metres.")
    return finite_number(words[0], "x", where), finite_number(words[1], "y", where)
