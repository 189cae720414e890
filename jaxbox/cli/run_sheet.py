"""One picture of a whole run: some of its sweeps, evenly chosen, side by side."""

import pathlib
import shutil
from collections.abc import Sequence

import numpy as np

from jaxbox import io
from jaxbox._files import check_no_link
from jaxbox.viz import BirdEyeFrame, make_contact_sheet, save_png

SHEET_NAME = "contact_sheet.png"
"""In the folder of the results."""
TILE_FOLDER = ".contact_sheet"
"""There too, until the run is complete: the pictures, so that a run that resumes it has them all."""
NUM_TILES, NUM_COLUMNS = 16, 4
TILE_FRAME = BirdEyeFrame(width_px=560)
"""What each tile shows, at which width captions are legible and four stand in a row."""


class RunSheet:
    """Chooses the sweeps, and writes the sheet of their pictures."""

    def __init__(self, output: pathlib.Path, sweeps: Sequence[io.Sweep], *, shown: bool) -> None:
        """Chooses the sweeps.

        Args:
          output: folder of the results.
          sweeps: all of the run.
          shown: whether a sheet is wanted.

        Raises:
          InputError: where a link stands for the folder of the pictures.
        """
        rows = np.linspace(0, len(sweeps) - 1, NUM_TILES if shown else 0).round().astype(int)
        chosen = [sweeps[row].name for row in np.unique(rows).tolist() if len(sweeps) > 0]
        self.folder = output / TILE_FOLDER
        """Where the pictures go."""
        self.tiles = {name: self.folder / f"{name}.png" for name in chosen}
        """File of the picture of each chosen sweep, in their order."""
        self._output, self._num_sweeps = output, len(sweeps)
        check_no_link(self.folder)

    def write(self, *, min_score: float, is_complete: bool) -> None:
        """Writes the sheet, whole or not at all; without a picture there is none, and an earlier one stays.

        Args:
          min_score: from which boxes are drawn, for the title.
          is_complete: whether nothing is left for a run that resumes this one, which needs the pictures.

        Raises:
          InputError: where a picture cannot be read.
          OSError: where the sheet cannot be written.
        """
        if tiles := [io.read_image(path) for path in self.tiles.values() if path.is_file()]:
            title = f"{len(tiles)} of {self._num_sweeps} sweeps, boxes of score >= {min_score:g}"
            sheet = make_contact_sheet(tiles, num_columns=NUM_COLUMNS, title=title)
            save_png(self._output / SHEET_NAME, sheet)
        if is_complete and self.folder.is_dir():
            shutil.rmtree(self.folder)
