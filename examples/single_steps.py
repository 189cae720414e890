"""Draws what each single step makes of a sweep: the pictures of docs/tutorial.md.

    python examples/single_steps.py docs

The sweep is synthetic, so that the pictures can be published under the project's own licence.
"""

import argparse
import pathlib
from collections.abc import Sequence

import numpy as np

import jaxbox
from jaxbox import synthetic
from jaxbox.viz import BirdEyeFrame, BoxSet, color_by_height, color_by_id, draw_bird_eye, save_png
from jaxbox.viz.colors import Color

FRAME = BirdEyeFrame(x_range_m=(-22.0, 42.0), y_range_m=(-14.0, 14.0), width_px=900)
GROUND: Color = (58, 63, 72)
MIN_POINTS = 20
"""Clusters of fewer points have no box in the picture."""


def draw_steps(xyz: np.ndarray) -> dict[str, np.ndarray]:
    """The pictures of the steps.

    Args:
      xyz: (n, 3) m, sensor frame.

    Returns:
      By name, (h, w, 3) uint8, red green blue.
    """
    ground = jaxbox.remove_ground(xyz)
    cluster = jaxbox.cluster_points(xyz)
    boxes = jaxbox.fit_boxes(xyz, cluster)
    large = boxes.num_points >= MIN_POINTS
    fitted = BoxSet(center=boxes.center[large], size=boxes.size[large], yaw=boxes.yaw[large])

    def draw(shown: np.ndarray, colors: np.ndarray, boxes: BoxSet | None, title: str) -> np.ndarray:
        colors = np.where(shown[:, None], colors, np.array(GROUND, np.uint8))
        return draw_bird_eye(xyz, colors=colors, boxes=boxes, frame=FRAME, title=title)

    by_cluster = color_by_id(cluster)
    return {
        "step_ground": draw(
            ~ground.is_ground,
            color_by_height(ground.height_m),
            None,
            "remove_ground: height above it",
        ),
        "step_clusters": draw(cluster >= 0, by_cluster, None, "cluster_points: a colour for each"),
        "step_boxes": draw(cluster >= 0, by_cluster, fitted, f"fit_boxes: from {MIN_POINTS} points on"),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes the pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=pathlib.Path, help="where the PNG files go")
    folder = parser.parse_args(arguments).folder
    for name, picture in draw_steps(synthetic.make_sweep(seed=0).xyz).items():
        save_png(folder / f"{name}.png", picture)


if __name__ == "__main__":
    main()
