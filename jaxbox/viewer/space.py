"""Lines and texts in space: what scenes are made of."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbox.viz import BoxGroup, BoxSet
from jaxbox.viz.colors import Color


@dataclasses.dataclass(frozen=True, kw_only=True)
class Caption:
    """A short text in space."""

    text: str
    """The text."""
    position: tuple[float, float, float]
    """m, sensor frame."""
    below: bool = False
    """Whether it hangs from the position, and does not stand on it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lines:
    """Lines in space, of one colour or of one each."""

    segments: np.ndarray
    """(n, 2, 3) float32, m, sensor frame."""
    color: Color | np.ndarray
    """Red, green, blue; or (n, 3) uint8, of each line."""

    @property
    def end_colors(self) -> np.ndarray:
        """(n, 2, 3) uint8: of both ends of each line."""
        colors = np.broadcast_to(np.asarray(self.color, np.uint8), (len(self.segments), 3))
        return np.repeat(colors[:, None], 2, axis=1)

    @classmethod
    def join(cls, parts: Sequence["Lines"]) -> "Lines":
        """The lines of all parts, each with its own colour.

        >>> red = Lines(segments=np.zeros((2, 2, 3), np.float32), color=(255, 0, 0))
        >>> Lines.join([red, red]).end_colors.shape
        (4, 2, 3)
        """
        segments = [np.zeros((0, 2, 3)), *(part.segments for part in parts)]
        colors = [np.zeros((0, 3)), *(part.end_colors[:, 0] for part in parts)]
        return cls(
            segments=np.concatenate(segments).astype(np.float32),
            color=np.concatenate(colors).astype(np.uint8),
        )


def edges(boxes: BoxSet) -> np.ndarray:
    """The edges of boxes, as segments.

    Args:
      boxes: K of them.

    Returns:
      (12 K, 2, 3) float32, m, sensor frame.
    """
    return boxes.segments().reshape(-1, 2, 3).astype(np.float32)


def colored_edges(groups: Sequence[BoxGroup]) -> Lines:
    """The edges of all boxes of some groups, each in the colour of its group.

    Args:
      groups: any number.

    Returns:
      The lines.
    """
    return Lines.join([Lines(segments=edges(group.boxes), color=group.color) for group in groups])
