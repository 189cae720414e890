"""Many pictures on one: tiles in rows, under a line of title and legend."""

from collections.abc import Sequence

import numpy as np

from jaxbox.viz.canvas import blank, draw_swatches
from jaxbox.viz.colors import Color

GAP_PX = 6
HEADER_PX = 34


def make_contact_sheet(
    tiles: Sequence[np.ndarray],
    *,
    num_columns: int = 4,
    title: str = "",
    legend: Sequence[tuple[str, Color]] = (),
) -> np.ndarray:
    """Lays pictures out in rows from the top left, in their order.

    Args:
      tiles: at least one (h, w, 3) uint8; smaller ones stand at the lower left of their place.
      num_columns: places a row; fewer tiles make a narrower sheet.
      title: text at the top left.
      legend: texts and their colours, behind the title.

    Returns:
      (h, w, 3) uint8, red green blue.

    Raises:
      ValueError: without tiles, or without a column.

    >>> make_contact_sheet([np.zeros((20, 30, 3), np.uint8)] * 5, num_columns=3).shape
    (92, 114, 3)
    """
    if not tiles or num_columns < 1:
        raise ValueError(f"{len(tiles)} tiles in {num_columns} columns; both must be at least 1.")
    num_columns = min(num_columns, len(tiles))
    num_rows = -(-len(tiles) // num_columns)
    height = max(tile.shape[0] for tile in tiles) + GAP_PX
    width = max(tile.shape[1] for tile in tiles) + GAP_PX
    sheet = blank(width_px=width * num_columns + GAP_PX, height_px=height * num_rows + GAP_PX + HEADER_PX)
    draw_swatches(sheet, legend, title=title, row_px=HEADER_PX - 12)
    for index, tile in enumerate(tiles):
        row, column = divmod(index, num_columns)
        bottom, left = HEADER_PX + (row + 1) * height, GAP_PX + column * width
        sheet[bottom - tile.shape[0] : bottom, left : left + tile.shape[1]] = tile
    return sheet
