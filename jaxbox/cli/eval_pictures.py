"""The pictures of ``jaxbox eval``: what was found, missed and false in each labelled frame."""

import pathlib
from collections.abc import Sequence

import numpy as np

from jaxbox import viz
from jaxbox.evaluation.matching import Selection, select
from jaxbox.evaluation.report import LabelledResults, count_label_points
from jaxbox.io import InputError, KittiObject, Sweep
from jaxbox.viz.judged import LEGEND

SELECTION = Selection(difficulty="hard")
"""The labels that must be found: cars within KITTI's limits; beyond them a label is ignored."""
TILES_PER_SHEET, TILES_PER_ROW, TILE_WIDTH_PX = 20, 4, 700
"""At this width the captions are legible and twenty tiles fit one sheet."""


def write_judged_pictures(
    read: LabelledResults, folder: pathlib.Path, *, min_score: float
) -> list[pathlib.Path]:
    """Writes one picture a labelled frame, and contact sheets of all of them.

    Args:
      read: sweeps, labels and results.
      folder: where to: ``NAME_eval.png``, and ``contact_sheet.png`` or, for many frames,
        ``contact_sheet_1.png`` and so on.
      min_score: boxes with lower scores are not drawn.

    Returns:
      The contact sheets.

    Raises:
      InputError: where a sweep, its calibration or its image cannot be read.
    """
    tiles = []
    for sweep in read.sweeps:
        labels, results = read.labels[sweep.name], read.results[sweep.name]
        frame = judge_frame(sweep, labels, results, min_score=min_score)
        viz.save_png(folder / f"{sweep.name}_eval.png", viz.draw_judged_frame(frame))
        tiles.append(viz.draw_judged_frame(frame, width_px=TILE_WIDTH_PX, legend=False))
    groups = [tiles[i : i + TILES_PER_SHEET] for i in range(0, len(tiles), TILES_PER_SHEET)]
    paths = []
    for number, group in enumerate(groups, start=1):
        name = "contact_sheet.png" if len(groups) == 1 else f"contact_sheet_{number}.png"
        title = f"boxes of score >= {min_score:g}"
        sheet = viz.make_contact_sheet(group, num_columns=TILES_PER_ROW, title=title, legend=LEGEND)
        paths.append(viz.save_png(folder / name, sheet))
    return paths


def judge_frame(
    sweep: Sweep, labels: Sequence[KittiObject], results: Sequence[KittiObject], *, min_score: float
) -> viz.JudgedFrame:
    """Reads a frame's points and image and says what became of its labels and detections.

    Args:
      sweep: a labelled sweep.
      labels: its labels.
      results: what was found in it.
      min_score: boxes with lower scores are not drawn.

    Returns:
      The frame, ready to be drawn.

    Raises:
      InputError: where the sweep has no calibration, or a file cannot be read.
    """
    calibration = sweep.read_calibration()
    if calibration is None:
        raise InputError(f"{sweep.points_path}: no calibration belongs to it; labels cannot be drawn.")
    points = {sweep.name: count_label_points(sweep, labels)}
    (scene,) = select({sweep.name: labels}, {sweep.name: results}, SELECTION, num_points=points)
    regions = [label.box_px for label in labels if label.is_dont_care]
    return viz.JudgedFrame(
        name=sweep.name,
        xyz=sweep.read_points()[0],
        groups=viz.group_by_verdict(scene, labels, results, calibration, min_score=min_score),
        calibration=calibration,
        image=sweep.read_image(),
        regions_px=np.array(regions, float).reshape(-1, 4),
    )
