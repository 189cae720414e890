"""What the page draws of tracks: boxes by id, where they were lately, and how fast they are."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from jaxbox.tracking.tracks import Sight
from jaxbox.types import Motion
from jaxbox.viewer.drives import TrackedFrame
from jaxbox.viewer.space import Lines
from jaxbox.viz import BoxGroup
from jaxbox.viz.colors import Color
from jaxbox.viz.tracks import ARROW_S, shown_rows, track_groups

HEAD_M, MIN_SPEED_MPS = 1.0, 0.1
"""Length of an arrow's head, and the speed below which there is no arrow."""


def shown_groups(tracked: TrackedFrame, *, min_score: float) -> dict[int, BoxGroup]:
    """The tracks that pictures show too, each with the colour of its id, and id and state as its caption.

    Args:
      tracked: of the sweep.
      min_score: tracks that score less are hidden.

    Returns:
      A group a track, see `jaxbox.viz.tracks.track_groups`, by its row of `TrackedFrame.tracks`; darker where
      the sweep did not see it.
    """
    rows = shown_rows(tracked.tracks, min_score=min_score)
    groups = track_groups(tracked.tracks, min_score=min_score)
    seen = (np.asarray(tracked.tracks.sight)[rows] == Sight.SEEN).tolist()
    return {
        row: group if is_seen else dataclasses.replace(group, color=darker(group.color))
        for row, group, is_seen in zip(rows, groups, seen, strict=True)
    }


def motion_lines(tracked: TrackedFrame, groups: Mapping[int, BoxGroup]) -> dict[str, Lines]:
    """Trails, and arrows that end where a vehicle will be after `ARROW_S`.

    Args:
      tracked: of the sweep.
      groups: the tracks that are shown, by row.

    Returns:
      Lines by name: ``trails`` and ``arrows``, which vehicles that stand do not have.
    """
    trails, arrows = [], []
    for row, group in groups.items():
        way = tracked.trails.get(int(group.name), np.zeros((0, 3)))
        trails.append(Lines(segments=np.stack([way[:-1], way[1:]], axis=1), color=group.color))
        if tracked.tracks.motion[row] != Motion.STANDING:
            velocity = np.asarray(tracked.tracks.velocity[row], np.float64)
            arrows.append(Lines(segments=_arrow(group, velocity), color=group.color))
    return {"trails": Lines.join(trails), "arrows": Lines.join(arrows)}


def darker(color: Color) -> Color:
    """The colour of a track that the sweep did not see.

    >>> darker((200, 100, 1))
    (100, 50, 0)
    """
    red, green, blue = color
    return red // 2, green // 2, blue // 2


def _arrow(group: BoxGroup, velocity: np.ndarray) -> np.ndarray:
    """(n, 2, 3): from the middle of the roof, along the velocity; nothing where there is none."""
    speed = float(np.linalg.norm(velocity))
    if speed < MIN_SPEED_MPS:
        return np.zeros((0, 2, 3))
    roof = group.boxes.center[0] + np.array([0.0, 0.0, 0.5]) * group.boxes.size[0]
    along = np.array([*velocity / speed, 0.0])
    across = np.array([-along[1], along[0], 0.0])
    end = roof + ARROW_S * speed * along
    heads = [end - HEAD_M * (along + side * across / 2) for side in (1, -1)]
    return np.array([(roof, end), *((head, end) for head in heads)])
