"""Tracks from above and in the camera's image: ids, states, speeds, trails, and where they are driving."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxbox.tracking.tracks import Sight, Tracks
from jaxbox.types import Calibration, Motion
from jaxbox.viz.bird_eye import SENSOR_HEIGHT_M, BirdEyeFrame, draw_bird_eye
from jaxbox.viz.boxes import BoxGroup, BoxSet
from jaxbox.viz.canvas import draw_polygon
from jaxbox.viz.colors import Color, color_by_id, shade_by_height
from jaxbox.viz.image_boxes import draw_image_boxes, scale_camera

ARROW_S = 1.0
"""The arrow of a velocity ends where the vehicle is after this time."""
MIN_FRONT_PROBABILITY = 0.75
"""From this P(front) on the front is marked: without motion or a clear profile it is a guess."""
_HEAD_M = 1.2
_MIN_SPEED_MPS = 1e-3
_HIDDEN_PX = 1
"""Width of the lines of tracks that were not detected in the sweep."""


def shown_rows(tracks: Tracks, *, min_score: float = 0.0, confirmed: bool = True) -> list[int]:
    """Rows of the tracks that pictures show.

    Args:
      tracks: of one sweep, on the host.
      min_score: tracks that score less are left out.
      confirmed: whether tracks that are not confirmed are left out.

    Returns:
      The rows, ascending. A track that was not detected is left out once it was missed more often than
      detected: its way is a guess.
    """
    keep = np.asarray(tracks.valid) & (np.asarray(tracks.score) >= min_score)
    hits, age = np.asarray(tracks.hits), np.asarray(tracks.age)
    keep &= (np.asarray(tracks.sight) == Sight.SEEN.value) | (2 * hits >= age)
    keep &= np.asarray(tracks.confirmed) | (not confirmed)
    return np.flatnonzero(keep).tolist()


def track_groups(tracks: Tracks, *, min_score: float = 0.0, confirmed: bool = True) -> list[BoxGroup]:
    """One group a track, with the colour of its id, and id, state and speed as its caption.

    Args:
      tracks: of one sweep, on the host.
      min_score: as `shown_rows`.
      confirmed: as `shown_rows`.

    Returns:
      The groups of `shown_rows`; their lines are thin where the track was not detected.
    """
    rows = shown_rows(tracks, min_score=min_score, confirmed=confirmed)
    return [_group(tracks, row) for row in rows]


def _group(tracks: Tracks, row: int) -> BoxGroup:
    track_id, speed = int(tracks.id[row]), float(np.hypot(*tracks.velocity[row]))
    motion = Motion(int(tracks.motion[row]))
    words = [str(track_id), motion.word]
    words += [f"{speed:.0f} m/s"] if motion is not Motion.STANDING else []
    sight = Sight(int(tracks.sight[row]))
    words += [f"({sight.name.lower()})"] if sight is not Sight.SEEN else []
    rows = slice(row, row + 1)
    return BoxGroup(
        name=str(track_id),
        boxes=BoxSet(
            center=np.asarray(tracks.center)[rows],
            size=np.asarray(tracks.size)[rows],
            yaw=np.asarray(tracks.heading)[rows],
            captions=(" ".join(words),),
        ),
        color=_color(track_id),
        thickness_px=2 if sight is Sight.SEEN else _HIDDEN_PX,
    )


def _color(track_id: int) -> Color:
    red, green, blue = color_by_id(np.array([track_id]))[0].tolist()
    return red, green, blue


def draw_tracks(
    xyz: np.ndarray,
    tracks: Tracks,
    *,
    trails: Mapping[int, np.ndarray] | None = None,
    frame: BirdEyeFrame | None = None,
    title: str = "",
    min_score: float = 0.0,
    confirmed: bool = True,
) -> np.ndarray:
    """Draws a sweep from above with its tracks: boxes by id, trails, and arrows of velocity.

    Args:
      xyz: (n, 3) real numbers, m, sensor frame.
      tracks: of the sweep, on the host.
      trails: for each id (m, 3) m, where it was lately, see `jaxbox.tracking.trails`.
      frame: the part of the world; None is 40 m behind to 60 m ahead.
      title: first line.
      min_score: tracks that score less are left out.
      confirmed: whether tracks that are not confirmed are left out.

    Returns:
      (h, w, 3) uint8, red green blue.
    """
    frame = frame or BirdEyeFrame()
    rows = shown_rows(tracks, min_score=min_score, confirmed=confirmed)
    groups = [_group(tracks, row) for row in rows]
    colors = shade_by_height(np.asarray(xyz)[:, 2] + SENSOR_HEIGHT_M)
    picture = draw_bird_eye(xyz, colors=colors, groups=groups, frame=frame, title=title, legend=False)
    for row, group in zip(rows, groups, strict=True):
        trail = (trails or {}).get(int(group.name), np.zeros((0, 3)))
        draw_polygon(picture, frame.to_pixels(trail), group.color, thickness_px=1, closed=False)
        if tracks.front_probability[row] >= MIN_FRONT_PROBABILITY:
            _draw_front(picture, frame, group)
        if int(tracks.motion[row]) != Motion.STANDING:
            _draw_arrow(picture, frame, group, np.asarray(tracks.velocity[row], np.float64))
    return picture


def _draw_front(picture: np.ndarray, frame: BirdEyeFrame, group: BoxGroup) -> None:
    """A line across the box before its front."""
    front_left, rear_left, rear_right, front_right = group.boxes.footprints()[0]
    share = 0.25
    line = np.array(
        [front_left + share * (rear_left - front_left), front_right + share * (rear_right - front_right)]
    )
    draw_polygon(picture, frame.to_pixels(line), group.color, thickness_px=1, closed=False)


def _draw_arrow(picture: np.ndarray, frame: BirdEyeFrame, group: BoxGroup, velocity: np.ndarray) -> None:
    start = group.boxes.center[0, :2]
    end = start + ARROW_S * velocity
    along = velocity / max(float(np.linalg.norm(velocity)), _MIN_SPEED_MPS)
    across = np.array([-along[1], along[0]])
    head = [end - _HEAD_M * (along + side * across / 2) for side in (1, -1)]
    for line in ([start, end], [head[0], end, head[1]]):
        draw_polygon(picture, frame.to_pixels(np.array(line)), group.color, thickness_px=1, closed=False)


def draw_image_tracks(
    image: np.ndarray,
    calibration: Calibration,
    tracks: Tracks,
    *,
    min_score: float = 0.0,
    confirmed: bool = True,
) -> np.ndarray:
    """Draws the tracks' boxes in the camera's image, with the colours and captions of `draw_tracks`.

    Args:
      image: (h, w, 3) uint8, red green blue; not changed.
      calibration: of the camera that took it.
      tracks: of the sweep, on the host.
      min_score: tracks that score less are left out.
      confirmed: whether tracks that are not confirmed are left out.

    Returns:
      (h, w, 3) uint8: a copy of the image with the boxes.
    """
    groups = track_groups(tracks, min_score=min_score, confirmed=confirmed)
    return draw_image_boxes(image, calibration, groups=groups, legend=False)


def draw_drive(
    xyz: np.ndarray,
    tracks: Tracks,
    *,
    image: np.ndarray | None = None,
    calibration: Calibration | None = None,
    min_score: float = 0.0,
    confirmed: bool = True,
    **options: Any,
) -> np.ndarray:
    """One picture of a sweep's tracks: in the camera's image, where there is one, and from above.

    Args:
      xyz: as `draw_tracks`.
      tracks: as `draw_tracks`.
      image: (h, w, 3) uint8, red green blue; None for none.
      calibration: of the camera that took it; None for none.
      min_score: as `draw_tracks`.
      confirmed: as `draw_tracks`.
      **options: more of `draw_tracks`.

    Returns:
      (h, w, 3) uint8, red green blue.
    """
    above = draw_tracks(xyz, tracks, min_score=min_score, confirmed=confirmed, **options)
    if image is None or calibration is None:
        return above
    scaled, camera = scale_camera(image, calibration, width_px=above.shape[1])
    front = draw_image_tracks(scaled, camera, tracks, min_score=min_score, confirmed=confirmed)
    return np.concatenate([front, above])
