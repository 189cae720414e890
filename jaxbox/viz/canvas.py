"""Drawing on a picture: points, anti-aliased lines, text, legend, and PNG files."""

import os
import pathlib
from collections.abc import Sequence

import cv2
import numpy as np

from jaxbox._files import atomic_path
from jaxbox.viz.colors import BACKGROUND, INK, Color

SHIFT = 4
"""Binary digits of a pixel that OpenCV's anti-aliased lines are placed to."""
FAR_PX = 1e6
"""Coordinates are held within this, so that the fixed-point numbers fit in 32 bits."""
FONT = cv2.FONT_HERSHEY_SIMPLEX
LINE_STEP_PX = 24
"""Height of a line of the legend."""


def blank(*, width_px: int, height_px: int) -> np.ndarray:
    """An empty picture: (height_px, width_px, 3) uint8."""
    return np.full((height_px, width_px, 3), BACKGROUND, np.uint8)


def draw_points(picture: np.ndarray, uv: np.ndarray, colors: np.ndarray, *, dot_px: int = 2) -> None:
    """Draws square dots in place; later points cover earlier ones.

    Args:
      picture: (h, w, 3) uint8, changed.
      uv: (n, 2) real numbers, px: column, row; points outside or not finite are not drawn.
      colors: (n, 3) uint8.
      dot_px: edge of a dot.
    """
    height, width = picture.shape[:2]
    finite = np.isfinite(uv).all(axis=1) & (np.abs(uv) < FAR_PX).all(axis=1)
    base, colors = np.floor(uv[finite]).astype(np.int64), colors[finite]
    for shift in np.ndindex(dot_px, dot_px):
        column, row = (base + shift).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        picture[row[inside], column[inside]] = colors[inside]


def _fixed_point(uv: np.ndarray) -> np.ndarray:
    return np.round(np.clip(uv, -FAR_PX, FAR_PX) * 2**SHIFT).astype(np.int32)


def draw_polygon(
    picture: np.ndarray, uv: np.ndarray, color: Color, *, thickness_px: int = 2, closed: bool = True
) -> None:
    """Draws one anti-aliased line through points in place.

    Args:
      picture: (h, w, 3) uint8, changed.
      uv: (n, 2) finite real numbers, px.
      color: red, green, blue.
      thickness_px: width of the line.
      closed: whether the last point is joined to the first.
    """
    if len(uv):
        cv2.polylines(picture, [_fixed_point(uv)], closed, color, thickness_px, cv2.LINE_AA, SHIFT)


def draw_segments(picture: np.ndarray, uv: np.ndarray, color: Color, *, thickness_px: int = 2) -> None:
    """Draws anti-aliased segments in place: uv is (n, 2, 2), px, start and end."""
    for start, end in _fixed_point(uv).tolist():
        cv2.line(picture, start, end, color, thickness_px, cv2.LINE_AA, SHIFT)


def draw_text(
    picture: np.ndarray, text: str, position: Sequence[float], color: Color = INK, *, scale: float = 0.5
) -> None:
    """Draws one line of text in place with a dark edge, its lower left corner at a pixel."""
    column, row = round(position[0]), round(position[1])
    # A thicker stroke would space the letters differently, so the edge is the same text, shifted.
    for right, down in ((-1, 0), (1, 0), (0, -1), (0, 1), (1, 1)):
        cv2.putText(picture, text, (column + right, row + down), FONT, scale, BACKGROUND, 1, cv2.LINE_AA)
    cv2.putText(picture, text, (column, row), FONT, scale, color, 1, cv2.LINE_AA)


def draw_legend(picture: np.ndarray, entries: Sequence[tuple[str, Color]], *, title: str = "") -> None:
    """Draws a title and one line an entry, text and colour, at the top left, in place."""
    row = 28
    if title:
        draw_text(picture, title, (16, row), scale=0.7)
        row += LINE_STEP_PX
    for text, color in entries:
        cv2.rectangle(picture, (14, row - 13), (36, row + 1), BACKGROUND, -1)
        cv2.rectangle(picture, (16, row - 11), (34, row - 1), color, -1)
        draw_text(picture, text, (44, row))
        row += LINE_STEP_PX


def draw_swatches(
    picture: np.ndarray, entries: Sequence[tuple[str, Color]], *, title: str = "", row_px: int = 22
) -> None:
    """Draws a title and a legend on one line in place, its lower edge at a row."""
    column = 16
    draw_text(picture, title, (column, row_px), scale=0.6)
    column += cv2.getTextSize(title, FONT, 0.6, 1)[0][0] + LINE_STEP_PX * bool(title)
    for text, color in entries:
        cv2.rectangle(picture, (column, row_px - 11), (column + 18, row_px - 1), color, -1)
        draw_text(picture, text, (column + 26, row_px))
        column += 26 + cv2.getTextSize(text, FONT, 0.5, 1)[0][0] + LINE_STEP_PX


def encode_png(picture: np.ndarray) -> bytes:
    """A picture as the bytes of a PNG file.

    Args:
      picture: (h, w, 3) uint8, red green blue.

    Returns:
      The bytes.

    Raises:
      ValueError: for another shape or type.
    """
    picture = np.asarray(picture)
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8 or picture.size == 0:
        raise ValueError(
            f"the picture has shape {picture.shape} and type {picture.dtype}; it must be (h, w, 3) uint8."
        )
    _, encoded = cv2.imencode(".png", picture[..., ::-1])
    return encoded.tobytes()


def save_png(path: str | os.PathLike[str], picture: np.ndarray) -> pathlib.Path:
    """Writes a picture as PNG, under a temporary name first.

    Args:
      path: file to write; its folder is made where it is missing.
      picture: (h, w, 3) uint8, red green blue.

    Returns:
      The path.

    Raises:
      ValueError: for another shape or type.
    """
    encoded = encode_png(picture)
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded)
    return pathlib.Path(path)
