"""One picture of a whole run: some of its sweeps, evenly chosen, side by side."""

import pathlib
from collections.abc import Sequence

import numpy as np

from jaxbox import io
from jaxbox.viz import BirdEyeFrame, make_contact_sheet, save_png

SHEET_NAME = "contact_sheet.png"
"""In the folder of the results."""
NUM_TILES, NUM_COLUMNS = 16, 4
TILE_FRAME = BirdEyeFrame(width_px=560)
"""What each tile shows, at which width captions are legible and four stand in a row."""


class RunSheet:
    """Takes the pictures of the chosen sweeps, and writes the sheet."""

    def __init__(self, output: pathlib.Path, sweeps: Sequence[io.Sweep], *, shown: bool) -> None:
        """Chooses the sweeps.

        Args:
          output: folder of the results.
          sweeps: all of the run.
          shown: whether a sheet is wanted.
        """
        rows = np.linspace(0, len(sweeps) - 1, NUM_TILES if shown else 0).round().astype(int)
        self.names = frozenset(sweeps[row].name for row in np.unique(rows).tolist() if len(sweeps) > 0)
        """Of the chosen sweeps."""
        self._output, self._num_sweeps = output, len(sweeps)
        self._tiles: list[np.ndarray] = []

    def add(self, tile: np.ndarray | None) -> None:
        """Takes the picture (h, w, 3) uint8 of the next chosen sweep; None is passed over."""
        self._tiles += [] if tile is None else [tile]

    def write(self, *, min_score: float) -> None:
        """Writes the sheet, whole or not at all; without a tile there is none, and an earlier one stays.

        Args:
          min_score: from which boxes are drawn, for the title.

        Raises:
          OSError: where it cannot be written.
        """
        if self._tiles:
            title = f"{len(self._tiles)} of {self._num_sweeps} sweeps, boxes of score >= {min_score:g}"
            sheet = make_contact_sheet(self._tiles, num_columns=NUM_COLUMNS, title=title)
            save_png(self._output / SHEET_NAME, sheet)
